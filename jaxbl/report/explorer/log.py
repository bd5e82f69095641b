"""A log and what models make of it, in a browser: results of `jaxbl identify` and `jaxbl diagnose`."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from pandas import DataFrame

from jaxbl.diagnosis.coordinates import within_turn
from jaxbl.errors import InputError
from jaxbl.files import check_result, read_result, to_path
from jaxbl.json_types import JsonObject
from jaxbl.records import POSITION_CHANNELS
from jaxbl.report.diagnose import describe_diagnosis
from jaxbl.report.element import describe_element
from jaxbl.report.figures import missing_quantity
from jaxbl.report.identify import describe_identification

from .folder import Source, colours_of, points_writer, write_page

_LABELS = {"t": "time", "u": "input u", "theta_e": "motor position θe", "theta_s": "load position θs", "twist": "twist z",
           "displacement": "displacement"}  # fmt: skip
_RESULTS = "diagnosis.json", "identification.json"


def _summary_file(folder: str | Path) -> Path | None:
    """The newest summary in a folder: identify and diagnose may have written into one, the trace is of the last."""
    files = [file for name in _RESULTS if (file := to_path(folder) / name).is_file()]
    return max(files, key=lambda file: file.stat().st_mtime_ns, default=None)


def log_source(folder: str | Path) -> Source | None:
    """Results of `jaxbl identify` or `jaxbl diagnose`, to be explored; None where a folder holds none.

    Raises:
        InputError: files are damaged or missing.
    """
    file = _summary_file(folder)
    if file is None:
        return None
    summary = read_result(file)
    describe = describe_diagnosis if file.name == "diagnosis.json" else describe_identification
    card = (describe_element if summary.get("kind") == "element" else describe)(summary)
    lead = card.sentences

    def write(out: Path, served: bool) -> bool:
        model, trace = (check_result(file.with_name(name)) for name in ("model.toml", "trace.parquet"))
        frame, model = pd.read_parquet(trace), model.read_text(encoding="utf-8")
        content = write_log(summary, frame, out)
        content |= {"title": card.title, "lead": lead, "config": model, "file": "model.toml"}
        write_page(out, ("log",), content, scripts=not served)
        return False

    return Source(str(summary["identity"]), lead, write, {}, lambda: None, lambda: None)


def write_log(summary: JsonObject, trace: DataFrame, out: Path) -> JsonObject:
    """Write `points.parquet`, and return what the page says of its columns.

    Args:
        summary: as in `diagnosis.json` or `identification.json`.
        trace: as in `trace.parquet`.
        out: folder.
    """
    units = _units(summary)
    frame = trace.assign(**_turns(trace, units))
    coordinates = list(_coordinates(frame, units))
    groups = [group for group in _groups(summary, frame, units) if group["lines"]]
    if not groups:
        raise InputError(
            "explore: trace.parquet has no column that the page could draw; run the command that wrote it again"
        )
    lines = [*coordinates, *(line for group in groups for line in group["lines"])]
    drawn = {"held_out", *(line["column"] for line in lines)}
    # float32 would round times; what is not there stays nan, which a page reads as a number
    with points_writer(out, {name: np.float64 if name == "t" else np.float32 for name in frame if name in drawn}) as write:
        write(frame)
    return {
        "rows": len(frame),
        "period": summary["sample_period"],
        "held": "held_out" in frame and bool(frame["held_out"].any()),
        "coordinates": coordinates,
        "over": _first(summary, frame),
        "groups": groups,
        "colours": colours_of("PuOr_r"),
    }


def _units(summary: JsonObject) -> dict[str, str]:
    """Unit of each side's position: m on a linear axis."""
    if "gap" in summary:
        return {side: summary["gap"]["units"].get(name, "rad") for side, name in POSITION_CHANNELS.items()}
    return {side: summary.get("residual", {}).get(side, {}).get("unit", "rad") for side in POSITION_CHANNELS}


def _force(unit: str) -> str:
    return "N" if unit == "m" else "N m"


def _turns(trace: DataFrame, units: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Positions within a turn."""
    turns = {
        f"{side}.turn": within_turn(trace[name].to_numpy())
        for side, name in POSITION_CHANNELS.items()
        if name in trace and units[side] == "rad"
    }
    return {name: values for name, values in turns.items() if values is not None}


def _coordinates(frame: DataFrame, units: Mapping[str, str]) -> Iterable[dict[str, str]]:
    """The coordinates that a log may be looked at over."""
    motor = units["motor"]
    unit_by_name = zip(_LABELS, ("s", _force(motor), motor, units["load"], motor, "rad"), strict=True)
    for name, unit in unit_by_name:
        if name in frame:
            yield {"column": name, "label": _LABELS[name], "unit": unit}
    for side in POSITION_CHANNELS:
        for name, label, per in (
            ("velocity", "speed", "/s"),
            ("acceleration", "acceleration", "/s²"),
            ("turn", "position within a turn", ""),
        ):
            if f"{side}.{name}" in frame:
                yield {"column": f"{side}.{name}", "label": f"{side} {label}", "unit": units[side] + per}


_NAMES = {
    "speed": "motor.velocity", "turn": "motor.turn", "position": "theta_e", "load position": "theta_s",
    "load turn": "load.turn", "twist": "twist", "input": "u", "displacement": "displacement",
}  # fmt: skip
"""Columns of what a diagnosis looks at missing torques along."""


def _first(summary: JsonObject, frame: DataFrame) -> list[str]:
    """Two coordinates that a log is looked at over at first: of a diagnosis those that explain most on the motor's side."""
    coordinates = summary.get("where", {}).get("motor", {}).get("coordinates", {})
    names = [name for name, column in _NAMES.items() if column in frame]
    names.sort(key=lambda name: -(coordinates.get(name, {}).get("explained") or 0.0))
    return [_NAMES[name] for name in names[:2]]


def _groups(summary: JsonObject, frame: DataFrame, units: Mapping[str, str]) -> Iterable[JsonObject]:
    """The figures of a log: each has a quantity, and its lines, the first two at the beginning."""

    def group(name: str, quantity: str, unit: str, lines: Mapping[str, str], bandwidth: float | None = None) -> JsonObject:
        drawn = [{"column": column, "label": label} for column, label in lines.items() if column in frame]
        return {"name": name, "quantity": quantity, "unit": unit, "bandwidth": bandwidth, "lines": drawn}

    bandwidths = summary.get("gap", {}).get("holdout", {}).get("bandwidth", {})
    last = summary["findings"][-1]["effect"] if summary.get("findings") else ""
    for side, unit in units.items():
        quantity = f"missing {missing_quantity(_force(unit))}"
        lines = {f"{side}.missing_before": "model as given", f"{side}.missing_after": _AFTER if last else "numbers fitted"}
        for column in map(str, frame):
            kind, _, effect = column.removeprefix(f"{side}.").partition(".")
            if kind == "missing_without":
                lines[column] = f"with the missing effects, without {effect}"
            elif kind == "missing_with":
                lines[column] = f"with {effect} in place of {last}"
        lines[f"{side}.observed_before"] = "model as given, by the observer"
        yield group(f"{side}: {quantity}", quantity, _force(unit), lines, bandwidths.get(side))
    for side, unit in units.items():
        lines = {f"{side}.residual": "measured less the model's"}
        yield group(f"{side}: position residual", "residual", unit, lines)
    force = _force(units["motor"])
    lines = {"transmitted": "measured", "torque": "by the fitted law", "torque_by_motor": "by the motor's side"}
    lines |= {f"{side}.torque_estimate": f"by the {side} observer" for side in units}
    if summary.get("kind") == "element":
        lines = {"u": "measured", "torque": "by the fitted law"}
    name = "torque in the transmission" if {"transmitted", "torque"} & {*frame} else "disturbance torque"
    yield group(name, missing_quantity(force), force, lines)
    for side, unit in units.items():
        lines = {f"{side}.velocity": "smoothed", f"{side}.velocity_estimate": "by the observer"}
        if f"{side}.velocity_estimate" in frame:
            yield group(f"{side}: speed", "speed", f"{unit}/s", lines)


_AFTER = "with the missing effects"
