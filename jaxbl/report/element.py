"""What `jaxbl identify` leaves of a transmission on a test rig: numbers with intervals, torque over displacement."""

from pathlib import Path

import tomli_w

from jaxbl.estimation.element import ElementIdentification
from jaxbl.json_types import JsonObject
from jaxbl.lines import Lines, percent
from jaxbl.quantity import read_quantities
from jaxbl.result import Result

from .figures import BLUE, FAINT, ORANGE, Drawn, legend, outline, stacked, style, subplots
from .numbers import lead_with_doubt, number_figures, number_table, write_fit

_POINTS = 6000
"""Points of a cloud: a page is about 1000 pixels wide."""


def write_element(result: ElementIdentification, folder: Path) -> str:
    """Write `identification.json`, `model.toml` and `trace.parquet`. Returns the TOML of the transmission."""
    model = "# Of a transmission alone: a study with [drive] can include it.\n" + tomli_w.dumps(result.tables)
    return write_fit(result, folder, "identification", model)


def describe_element(summary: JsonObject) -> Result:
    """Say how well the transmission explains the torque, and its numbers, from an `identification.json`."""
    numbers, torque = read_quantities(summary["parameters"]), summary["torque"]["element"]
    headline = (
        f"{' and '.join(summary['method']['element']['terms'])} explain the torque but for {_size(torque, torque['unit'])}."
    )
    tables = [number_table("Numbers", numbers)]
    figures, remarks = number_figures(numbers), [*summary["warnings"], *_remarks(summary)]
    return lead_with_doubt(Result(summary["title"], "good", headline, figures, remarks, summary["notes"], tables))


def _remarks(summary: JsonObject) -> Lines:
    element, torque = summary["method"]["element"], summary["torque"]["element"]
    unit = torque["unit"]
    lines = [f"Not identifiable: {next(iter(refusal['direction']))}: {refusal['why']}." for refusal in summary["refused"]]
    for term, gain in element["gains"].items():
        lines.append(
            f"Without {term} the torque error on parts of the log left out is {(1 + gain) ** 0.5:.3g} times as large."
        )
    lines.append(f"{element['reversals']} reversals.")
    if "holdout" in summary:
        name, error = Path(summary["holdout"]["file"]).name, summary["holdout"]["torque"]
        result = "the displacement never turns back, or hardly moves"
        if error["rms"] is not None:
            result = f"torque error {_size(error, unit)}"
        lines.append(f"On {name}: {result}.")
    return lines


def _size(error: JsonObject, unit: str) -> str:
    return f"{error['rms']:.3g} {unit} rms, {percent(error['relative'])} of the torque"


@style()
def draw_element(result: ElementIdentification) -> list[Drawn]:
    """All figures of a transmission on a test rig."""
    trace, record = result.trace, result.task.record
    channels = record.statistics.channels
    unit, torque_unit = channels["theta_e"].unit, channels["u"].unit
    time, x, u, fitted = (trace[name].to_numpy() for name in ("t", "displacement", "u", "torque"))
    points = slice(None, None, max(len(x) // _POINTS, 1))
    figure, (ax,) = subplots(7.0, 4.2)
    ax.plot(x[points], u[points], ".", ms=2.0, color=FAINT, alpha=0.6, label="measured")
    ax.plot(x[points], fitted[points], ".", ms=1.2, color=BLUE, label="found")
    numbers = result.element.numbers
    if "half_gap" in numbers:
        middle, half = numbers["centre"].value, numbers["half_gap"].value
        ax.axvspan(middle - half, middle + half, color=ORANGE, alpha=0.2, lw=0.0, label="gap")
    quantity = "torque" if unit == "rad" else "force"
    ax.set(xlabel=f"displacement ({unit})", ylabel=f"{quantity} ({torque_unit})")
    legend(ax, 3, markerscale=4)
    drawn = [Drawn("loop", figure, "Torque over displacement: as measured, and of the transmission that was found.")]
    figure, axes = stacked(2, 1.8)
    for ax, values, label in zip(axes, (u, u - fitted), ("torque", "not explained"), strict=True):
        for part in record.segments:
            samples = part.start + outline(values[part])
            ax.plot(time[samples], values[samples], color=BLUE, lw=0.9)
        ax.set_ylabel(f"{label}\n({torque_unit})")
    return [*drawn, Drawn("residual", figure, "The torque over time, and what of it is not explained.")]
