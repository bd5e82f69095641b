"""What `jaxbl bench` leaves: table, `bench.json`, a bar chart, and throughput against lanes."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path

import pandas as pd

from jaxbl.files import write_json
from jaxbl.lines import Lines
from jaxbl.throughput.run import CPP_NAME, FUSED_NAME, PRECISIONS, SCAN_NAME, BenchResult

from .figures import BLUE, GREEN, VERMILION, Drawn, style, subplots
from .page import save_all


@style()
def draw_throughput(result: BenchResult) -> list[Drawn]:
    """The figures of a benchmark."""
    return [_bars(result), _curve(result)]


def _bars(result: BenchResult) -> Drawn:
    names = list(dict.fromkeys(row.name for row in result.rows))
    names.sort(key=lambda name: result.find_speed(name, "float32") or result.find_speed(name, "float64") or 0.0)
    figure, (ax,) = subplots(8.0, 0.42 * len(names) + 1.1)
    for shift, precision, alpha in ((0.19, "float32", 1.0), (-0.19, "float64", 0.45)):
        for i, name in enumerate(names):
            speed = result.find_speed(name, precision)
            if speed is not None:
                ax.barh(i + shift, speed, 0.38, color=VERMILION if name.startswith("jaxbl") else BLUE, alpha=alpha)
                ax.text(1.15 * speed, i + shift, f"{speed:.2g}", va="center", fontsize=7)
    ax.set(xscale="log", xlabel="lane-steps per second (log scale); upper bar float32, lower bar float64")
    ax.set_yticks(range(len(names)), names)
    ax.set_xlim(right=12.0 * max(row.lane_steps_per_second for row in result.rows))
    ax.grid(axis="y", visible=False)
    return Drawn(
        "throughput",
        figure,
        "The paper's chain on many lanes by each program. A lane-step is one sample of one lane: plant, two observers, "
        "filter and both identifiers. Longer bars are faster; from one grid line to the next is a factor of ten.",
    )


def _curve(result: BenchResult) -> Drawn:
    figure, (ax,) = subplots(7.0, 3.8)
    for name, colour in ((CPP_NAME, BLUE), (FUSED_NAME, VERMILION), (SCAN_NAME, GREEN)):
        for precision, line in zip(PRECISIONS, ("-", "--"), strict=True):
            points = [
                (point["lanes"], point["lane_steps_per_second"])
                for point in result.curve
                if (point["name"], point["precision"]) == (name, precision)
            ]
            if points:
                label = f"{name}, {precision}"
                ax.plot(*zip(*points, strict=True), line, color=colour, marker="o", markersize=3, label=label)
    ax.set_xscale("log", base=2)
    ax.set(yscale="log", xlabel="lanes", ylabel="lane-steps per second")
    ax.legend()
    return Drawn(
        "lanes",
        figure,
        "Throughput over the number of lanes. On the left the fixed cost of a call and of a block of samples limits it, on "
        "the right caches and memory.",
    )


def _align(rows: Iterable[Sequence[str]]) -> Lines:
    """Cells in columns that end below one another."""
    return pd.DataFrame(rows).to_string(header=False, index=False).split("\n")


def _table(result: BenchResult, precision: str) -> list[list[str]]:
    """Header and rows of the table of one precision, as text."""
    rows = [[precision, "lanes", "best", "median", "of C++", "first", "off by"]]
    ceiling = result.find_speed(CPP_NAME, precision)
    for row in result.rows:
        if row.precision == precision:
            share = f"{row.lane_steps_per_second / ceiling:.2g}" if ceiling else "–"
            speeds = f"{row.lane_steps_per_second:.3g}", f"{row.median_lane_steps_per_second:.3g}", share
            rows.append([row.name, str(row.lanes), *speeds, f"{row.first_seconds:.2f} s", f"{row.deviation:.1g}"])
    return rows


def throughput_lines(result: BenchResult) -> Lines:
    """The benchmark for the terminal."""
    machine = result.machine
    lines = [
        f"{machine['processor']}, {machine['cores']} cores; jax {machine['versions']['jax']}; {result.rows[0].steps} "
        "samples a run",
        "Lane-steps/s, best and median of the calls; time of the first call; deviation of the results.",
    ]
    for precision in PRECISIONS:
        lines += ["", *_align(_table(result, precision))]
    if result.study:
        study = result.study[0]
        size = f"{study['lanes']} lanes of {study['steps']} samples, {study['precision']}"
        lines += ["", f"A small study from nothing, {size}:"]
        lines += _align([(f"  {row['name']}", f"{row['seconds']:.2f} s") for row in result.study])
    if result.studies:
        lines += ["", "Studies as they stand, float64, every metric, all cores; lane-steps/s:"]
    lines += [
        f"  {row['name']}, {row['seeds']} seeds of {row['lanes']} lanes: jaxbl {row['jaxbl']:.3g}, C++ {row['c++']:.3g}, "
        f"{row['jaxbl'] / row['c++']:.2g} of it"
        for row in result.studies
    ]
    lines += [f"{name}: left out, {reason}" for name, reason in result.left_out.items()]
    return lines + result.failures


def write_bench_report(result: BenchResult, folder: Path) -> Lines:
    """Write `bench.json` and figures into a folder that exists. Returns the lines for the terminal."""
    write_json(folder / "bench.json", asdict(result))
    save_all(draw_throughput(result), folder)
    return throughput_lines(result)
