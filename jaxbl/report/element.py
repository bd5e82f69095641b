"""What `jaxbl identify` leaves of a transmission on a test rig: numbers with intervals, torque over displacement."""

from pathlib import Path

import tomli_w

from jaxbl.identification.element import ElementIdentification
from jaxbl.json_types import JsonObject
from jaxbl.lines import Lines

from .figures import COLOURS, FAINT, Drawn, legend, outline, stacked, style, subplots
from .page import PageTable, write_results

_POINTS = 6000
"""Points of a cloud: a page is about 1000 pixels wide."""


def write_element_report(found: ElementIdentification, folder: Path) -> Lines:
    """Write `identification.json`, `model.toml`, `trace.parquet`, figures and report into a folder that exists.

    Returns the lines for the terminal.
    """
    lead, remarks = _headline(found.summary), _remarks(found.summary)
    rows = [
        [path, one["value"], one["standard_error"], *one["interval"], one["unit"]]
        for path, one in found.summary["parameters"].items()
    ]
    tables = [PageTable("Numbers", ["path", "value", "standard error", "95 % from", "to", "unit"], rows)]
    model = "# Of a transmission alone: a study with [drive] can include it.\n" + tomli_w.dumps(found.tables)
    title, drawn = found.summary["title"], draw_element(found)
    return write_results(found, folder, "identification", title, lead, drawn, tables, remarks, model=model)


def element_lines(summary: JsonObject) -> Lines:
    """The lines for the terminal, from an `identification.json`."""
    return [*_headline(summary), *_remarks(summary)]


def _headline(summary: JsonObject) -> Lines:
    lines = [*summary["warnings"]]
    for path, one in summary["parameters"].items():
        low, high = one["interval"]
        unit = f" {one['unit']}" if one["unit"] else ""
        lines.append(f"{path} = {one['value']:.5g} ± {one['standard_error']:.2g}{unit}, 95 %: {low:.5g} to {high:.5g}.")
    return lines


def _remarks(summary: JsonObject) -> Lines:
    element, torque = summary["method"]["element"], summary["torque"]["element"]
    lines = [f"Not identifiable: {next(iter(one['direction']))}: {one['why']}." for one in summary["refused"]]
    for term, gain in element["gains"].items():
        lines.append(
            f"Without {term} the torque error on parts of the log left out is {(1 + gain) ** 0.5:.3g} times as large."
        )
    lines.append(
        f"Torque error: {torque['rms']:.3g} {torque['unit']} rms, {100 * torque['relative']:.2g} % of the torque; "
        f"{element['reversals']} reversals."
    )
    if "holdout" in summary:
        name, error = Path(summary["holdout"]["file"]).name, summary["holdout"]["torque"]
        said = "the displacement never turns back, or hardly moves"
        if error["rms"] is not None:
            said = f"torque error {error['rms']:.3g} {torque['unit']} rms, {100 * error['relative']:.2g} % of the torque"
        lines.append(f"On {name}: {said}.")
    return [*lines, *summary["notes"]]


@style()
def draw_element(found: ElementIdentification) -> list[Drawn]:
    """All figures of a transmission on a test rig."""
    trace, record = found.trace, found.task.record
    channels = record.statistics.channels
    unit, torque_unit = channels["theta_e"].unit, channels["u"].unit
    x, u, fitted = (trace[name].to_numpy() for name in ("displacement", "u", "torque"))
    every = max(len(x) // _POINTS, 1)
    figure, (ax,) = subplots(7.0, 4.2)
    ax.plot(x[::every], u[::every], ".", ms=2.0, color=FAINT, alpha=0.6, label="measured")
    ax.plot(x[::every], fitted[::every], ".", ms=1.2, color=COLOURS[0], label="found")
    gap = found.found.numbers.get("half_gap")
    if gap is not None:
        middle = found.found.numbers["centre"].value
        ax.axvspan(middle - gap.value, middle + gap.value, color=COLOURS[4], alpha=0.2, lw=0.0, label="gap")
    ax.set(xlabel=f"displacement ({unit})", ylabel=f"torque ({torque_unit})" if unit == "rad" else f"force ({torque_unit})")
    legend(ax, 3, markerscale=4)
    drawn = [Drawn("loop", figure, "Torque over displacement: as measured, and of the transmission that was found.")]
    figure, axes = stacked(2, 1.8)
    for ax, values, label in zip(axes, (u, u - fitted), ("torque", "not explained"), strict=True):
        for part in record.segments:
            at = part.start + outline(values[part])
            ax.plot(trace["t"].to_numpy()[at], values[at], color=COLOURS[0], lw=0.9)
        ax.set_ylabel(f"{label}\n({torque_unit})")
    return [*drawn, Drawn("residual", figure, "The torque over time, and what of it is not explained.")]
