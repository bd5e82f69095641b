"""What `jaxbl bench` leaves: table, `bench.json`, a bar chart, and throughput against lanes."""

from dataclasses import asdict
from pathlib import Path

from jaxbl.files import write_json
from jaxbl.lines import Lines, format_table
from jaxbl.throughput.run import CPP_NAME, FUSED_NAME, PRECISIONS, SCAN_NAME, BenchResult

from .figures import COLOURS, Drawn, style, subplots
from .page import save_all


@style()
def draw_throughput(result: BenchResult) -> list[Drawn]:
    """The figures of a benchmark."""
    return [_bars(result), _curve(result)]


def _bars(result: BenchResult) -> Drawn:
    names = list(dict.fromkeys(row.name for row in result.rows))
    names.sort(key=lambda name: result.find_speed(name, "float32") or result.find_speed(name, "float64") or 0.0)
    figure, (ax,) = subplots(8.0, 0.42 * len(names) + 1.1)
    height = 0.38
    for shift, precision, alpha in ((height / 2, "float32", 1.0), (-height / 2, "float64", 0.45)):
        for i, name in enumerate(names):
            speed = result.find_speed(name, precision)
            if speed is not None:
                colour = COLOURS[1] if name.startswith("jaxbl") else COLOURS[0]
                ax.barh(i + shift, speed, height, color=colour, alpha=alpha)
                ax.text(1.15 * speed, i + shift, f"{speed:.2g}", va="center", fontsize=7)
    label = "lane-steps per second (log scale); upper bar float32, lower bar float64"
    ax.set(xscale="log", xlabel=label)
    ax.set_yticks(range(len(names)), names)
    ax.set_xlim(right=12.0 * max(row.lane_steps_per_second for row in result.rows))
    ax.grid(axis="y", visible=False)
    caption = (
        "The paper's chain on many lanes by each program. A lane-step is one sample of one lane: plant, two observers, "
        "filter and both identifiers. Longer bars are faster; from one grid line to the next is a factor of ten."
    )
    return Drawn("throughput", figure, caption)


def _curve(result: BenchResult) -> Drawn:
    figure, (ax,) = subplots(7.0, 3.8)
    for name, colour in ((CPP_NAME, COLOURS[0]), (FUSED_NAME, COLOURS[1]), (SCAN_NAME, COLOURS[2])):
        for precision, line in zip(PRECISIONS, ("-", "--"), strict=True):
            points = [point for point in result.curve if (point["name"], point["precision"]) == (name, precision)]
            lanes, speeds = [p["lanes"] for p in points], [p["lane_steps_per_second"] for p in points]
            if points:
                ax.plot(lanes, speeds, line, color=colour, marker="o", markersize=3, label=f"{name}, {precision}")
    ax.set_xscale("log", base=2)
    ax.set(yscale="log", xlabel="lanes", ylabel="lane-steps per second")
    ax.legend()
    caption = (
        "Throughput over the number of lanes. On the left the fixed cost of a call and of a block of samples limits it, on "
        "the right caches and memory."
    )
    return Drawn("lanes", figure, caption)


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
    lines = ["Lane-steps/s, best and median of the calls; time of the first call; deviation of the results."]
    for precision in PRECISIONS:
        lines += ["", *format_table(_table(result, precision), numbers=True)]
    machine = result.machine
    on = f"{machine['processor']}, {machine['cores']} cores; jax {machine['versions']['jax']}"
    lines.insert(0, f"{on}; {result.rows[0].steps} samples a run")
    if result.study:
        study = result.study[0]
        lines += [
            "",
            f"A small study from nothing, {study['lanes']} lanes of {study['steps']} samples, {study['precision']}:",
        ]
        lines += format_table([(f"  {row['name']}", f"{row['seconds']:.2f} s") for row in result.study], numbers=True)
    if result.studies:
        lines += ["", "Studies as they stand, float64, every metric, all cores; lane-steps/s:"]
    for row in result.studies:
        about = f"{row['name']}, {row['seeds']} seeds of {row['lanes']} lanes"
        share = f"{row['jaxbl'] / row['c++']:.2g}"
        lines.append(f"  {about}: jaxbl {row['jaxbl']:.3g}, C++ {row['c++']:.3g}, {share} of it")
    lines += [f"{name}: left out, {why}" for name, why in result.left_out.items()]
    return lines + result.failures


def write_bench_report(result: BenchResult, folder: Path) -> Lines:
    """Write `bench.json` and figures into a folder that exists. Returns the lines for the terminal."""
    write_json(folder / "bench.json", asdict(result))
    save_all(draw_throughput(result), folder)
    return throughput_lines(result)
