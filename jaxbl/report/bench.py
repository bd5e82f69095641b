"""What `jaxbl bench` leaves: table, `bench.json`, a bar chart, and throughput against lanes."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import pandas as pd

from jaxbl.files import write_json
from jaxbl.lines import Lines
from jaxbl.throughput.run import CPP_NAME, FUSED_NAME, PRECISIONS, SCAN_NAME, BenchResult

from .drawing import save
from .panels import BLUE, GREEN, VERMILION, Axis, Bars, Figure, Line, Panel

_SPEED = Axis("lane-steps per second", log=True)


def _bars(result: BenchResult) -> Figure:
    names = list(dict.fromkeys(row.name for row in result.rows))
    names.sort(key=lambda name: result.find_speed(name, "float32") or result.find_speed(name, "float64") or 0.0)
    bars, speeds = [], []
    for shift, precision, opacity in ((0.19, "float32", 1.0), (-0.19, "float64", 0.45)):
        for who, colour in (("jaxbl", VERMILION), ("others", BLUE)):
            rows = [
                (i + shift, speed)
                for i, name in enumerate(names)
                if name.startswith("jaxbl") == (who == "jaxbl") and (speed := result.find_speed(name, precision)) is not None
            ]
            if rows:
                places, lengths = zip(*rows, strict=True)
                speeds += lengths
                texts = [f"{speed:.2g}" for speed in lengths]
                bars.append(Bars(places, lengths, f"{who}, {precision}", colour, 0.38, opacity=opacity, texts=texts))
    x = _SPEED._replace(ends=(0.3 * min(speeds), 12.0 * max(speeds)))
    return Figure(
        "throughput",
        [Panel(x, Axis(names=tuple(enumerate(names))), bars)],
        "The paper's chain on many lanes by each program. A lane-step is one sample of one lane: plant, two observers, "
        "filter and both identifiers. Longer bars are faster; from one grid line to the next is a factor of ten.",
        height=0.42 * len(names) + 1.1,
    )


def _curve(result: BenchResult) -> Figure:
    lines = []
    for name, colour in ((CPP_NAME, BLUE), (FUSED_NAME, VERMILION), (SCAN_NAME, GREEN)):
        for precision, dashes in zip(PRECISIONS, ("-", "--"), strict=True):
            points = [point for point in result.curve if (point["name"], point["precision"]) == (name, precision)]
            if points:
                x, y = ([point[key] for point in points] for key in ("lanes", "lane_steps_per_second"))
                lines.append(Line(x, y, f"{name}, {precision}", colour, dashes=dashes, marker="o", size=3.0))
    return Figure(
        "lanes",
        [Panel(Axis("lanes", log=True), _SPEED, lines)],
        "Throughput over the number of lanes. On the left the fixed cost of a call and of a block of samples limits it, on "
        "the right caches and memory.",
    )


def _align(rows: Iterable[Sequence[str]]) -> Lines:
    """Cells in columns that end below one another."""
    return pd.DataFrame(rows).to_string(header=False, index=False).split("\n")


def _table(result: BenchResult, precision: str) -> Iterator[list[str]]:
    """Header and rows of the table of one precision, as text."""
    yield [precision, "lanes", "best", "median", "of C++", "first", "off by"]
    ceiling = result.find_speed(CPP_NAME, precision)
    for row in result.rows:
        if row.precision == precision:
            share = f"{row.lane_steps_per_second / ceiling:.2g}" if ceiling else "–"
            speeds = f"{row.lane_steps_per_second:.3g}", f"{row.median_lane_steps_per_second:.3g}", share
            yield [row.name, str(row.lanes), *speeds, f"{row.first_seconds:.2f} s", f"{row.deviation:.1g}"]


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
    lines += [f"{name}: left out, {reason}" for name, reason in result.left_out.items()]
    return lines + result.failures


def write_bench_report(result: BenchResult, folder: Path) -> Lines:
    """Write `bench.json` and figures into a folder that exists. Returns the lines for the terminal."""
    write_json(folder / "bench.json", asdict(result))
    for figure in (_bars(result), _curve(result)):
        save(figure, folder / "figures" / f"{figure.name}.png")
    return throughput_lines(result)
