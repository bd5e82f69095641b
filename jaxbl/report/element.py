"""What `jaxbl identify` leaves of a transmission on a test rig: numbers with intervals, torque over displacement."""

from collections.abc import Iterator
from pathlib import Path

import tomli_w

from jaxbl.estimation.element import ElementIdentification
from jaxbl.json_types import JsonObject
from jaxbl.lines import percent
from jaxbl.quantity import read_quantities
from jaxbl.result import Result

from .numbers import lead_with_doubt, number_figures, number_table, write as write_fit
from .panels import BLUE, ORANGE, Axis, Figure, Panel, Span, cloud, draw_signals, missing_quantity


def write(result: ElementIdentification, folder: Path) -> str:
    """Write `model.toml` and `trace.parquet`. Returns the TOML of the transmission."""
    model = "# Of a transmission alone: a study with [drive] can include it.\n" + tomli_w.dumps(result.tables)
    return write_fit(result, folder, model)


def describe(summary: JsonObject) -> Result:
    """Say how well the transmission explains the torque, and its numbers, from an `identification.json`."""
    numbers, torque = summary["parameters"], summary["torque"]["element"]
    headline = (
        f"{' and '.join(summary['method']['element']['terms'])} explain the torque but for {_size(torque, torque['unit'])}."
    )
    figures, remarks = number_figures(read_quantities(numbers)), [*summary["warnings"], *_remarks(summary)]
    return lead_with_doubt(
        Result(summary["title"], "good", headline, figures, remarks, summary["notes"], [number_table("Numbers", numbers)])
    )


def _remarks(summary: JsonObject) -> Iterator[str]:
    element, unit = summary["method"]["element"], summary["torque"]["element"]["unit"]
    for refusal in summary["refused"]:
        yield f"Not identifiable: {next(iter(refusal['direction']))}: {refusal['why']}."
    for term, gain in element["gains"].items():
        yield f"Without {term} the torque error on parts of the log left out is {(1 + gain) ** 0.5:.3g} times as large."
    yield f"{element['reversals']} reversals."
    if "holdout" in summary:
        name, error = Path(summary["holdout"]["file"]).name, summary["holdout"]["torque"]
        result = "the displacement never turns back, or hardly moves"
        if error["rms"] is not None:
            result = f"torque error {_size(error, unit)}"
        yield f"On {name}: {result}."


def _size(error: JsonObject, unit: str) -> str:
    return f"{error['rms']:.3g} {unit} rms, {percent(error['relative'])} of the torque"


def draw(result: ElementIdentification) -> Iterator[Figure]:
    """All figures of a transmission on a test rig."""
    record, numbers = result.task.record, result.element.numbers
    unit, torque_unit = (record.statistics.channels[name].unit for name in ("theta_e", "u"))
    time, x, u, fitted = (result.trace[name] for name in ("t", "displacement", "u", "torque"))
    parts = [cloud(x, u, "measured"), cloud(x, fitted, "found", BLUE)]
    if {"half_gap", "centre"} <= numbers.keys():
        middle, half = numbers["centre"].value, numbers["half_gap"].value
        parts += [Span(middle - half, middle + half, "gap", ORANGE)]
    axes = Axis(f"displacement ({unit})"), Axis(f"{missing_quantity(torque_unit)} ({torque_unit})")
    signals = (u, "torque", torque_unit, BLUE), (u - fitted, "not explained", torque_unit, BLUE)
    panels = draw_signals(time, record.segments, signals)
    caption = "Torque over displacement: as measured, and of the transmission that was found."
    yield Figure("loop", [Panel(*axes, parts)], caption)
    yield Figure("residual", panels, "The torque over time, and what of it is not explained.", height=1.7)
