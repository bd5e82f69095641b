"""Signals over time in a browser: a log and what models make of it, a simulated run, and what a watch saw."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from pandas import DataFrame

from jaxbl.diagnosis.coordinates import within_turn
from jaxbl.errors import InputError
from jaxbl.files import check_result, checksum, read_result
from jaxbl.json_types import JsonObject
from jaxbl.records import POSITION_CHANNELS
from jaxbl.report.panels import missing_quantity
from jaxbl.report.watch import LABELS

from .folder import Source, colours_of, write_page, write_points


def log_source(file: Path, title: str, sentences: Sequence[str]) -> Source:
    """Results of `jaxbl identify`, `diagnose`, `simulate` or `watch`, by their summary, with what their page says.

    Raises:
        InputError: files are damaged or missing.
    """
    summary, table = read_result(file), "watch.csv" if file.name == "watch.json" else "trace.parquet"
    # a run and a watch keep no model beside their signals
    model = "model.toml" if file.name in ("diagnosis.json", "identification.json") else file.name

    def write(out: Path, served: bool) -> bool:
        text, points = check_result(file.with_name(model)).read_text(encoding="utf-8"), check_result(file.with_name(table))
        frame = pd.read_csv(points) if points.suffix == ".csv" else pd.read_parquet(points)
        content = write_log(summary, frame, out)
        content |= {"title": title, "lead": sentences, "config": text, "file": model}
        write_page(out, ("log",), content, served=served)
        return False

    return Source(str(summary.get("identity") or checksum(file.read_bytes())), sentences, write)


def write_log(summary: JsonObject, trace: DataFrame, out: Path) -> JsonObject:
    """Write `points.parquet`, and return what the page says of its columns.

    Args:
        summary: as in `diagnosis.json`, `identification.json`, `summary.json` or `watch.json`.
        trace: as in `trace.parquet` or `watch.csv`.
        out: folder.
    """
    units = _units(summary)
    frame = trace.assign(**_turns(trace, units))
    if "single_run" in summary:
        frame = frame.assign(**observer_errors(frame)).rename(columns={"z": "twist"})
    coordinates = _coordinates(frame, units)
    is_watch = "alarm_gap" in summary
    asked = _watch_groups(summary) if is_watch else _groups(summary, frame, units)
    groups = [
        {"name": name, "quantity": quantity, "unit": unit, "bandwidth": bandwidth, "lines": there}
        for name, quantity, unit, lines, bandwidth in asked
        if (there := [{"column": column, "label": label} for column, label in lines.items() if column in frame])
    ]
    if is_watch:
        coordinates += [group["lines"][0] | {"unit": group["unit"]} for group in groups]
    if not groups:
        raise InputError(
            "explore: trace.parquet has no column that the page could draw; run the command that wrote it again"
        )
    drawn = {line["column"] for lines in (coordinates, *(group["lines"] for group in groups)) for line in lines}
    drawn.add("held_out")
    # float32 would round times; what is not there stays nan, which a page reads as a number
    write_points(out, {name: np.float64 if name == "t" else np.float32 for name in frame if name in drawn}, [frame])
    return {
        "rows": len(frame),
        "period": summary.get("every") or summary.get("sample_period") or float(np.median(np.diff(frame["t"]))),
        "held": "held_out" in frame and bool(frame["held_out"].any()),
        "coordinates": coordinates,
        "over": _first(summary, frame) or [line["column"] for line in coordinates[1:3]],
        "groups": groups,
        "colours": colours_of("PuOr_r"),
    }


def observer_errors(trace: DataFrame) -> JsonObject:
    """Compute what the observers of a simulated run are off by: true less observed."""
    names = [f"{side}.{name}" for side in POSITION_CHANNELS for name in ("position", "velocity")]
    return {f"{name}_error": trace[name] - trace[f"{name}_estimate"] for name in names if f"{name}_estimate" in trace}


_Group = tuple[str, str, str, Mapping[str, str], float | None]
"""A figure: its name, quantity and unit, columns with their labels, and the bandwidth that is shown at first, if any."""


def _watch_groups(summary: JsonObject) -> Iterable[_Group]:
    """The figures of a watch: each number by both observers."""
    for name, label in LABELS.items():
        lines = {f"{side}.{name}": f"{label} by the {side} observer" for side in POSITION_CHANNELS}
        lines |= {f"{name}_{end}": f"{label} {end}, with 95 %" for end in ("from", "to")}
        yield label, label, summary["units"]["motor"][name], lines, None


def _units(summary: JsonObject) -> dict[str, str]:
    """Unit of each side's position: m on a linear axis."""
    channels, residual = summary.get("gap", {}).get("units", {}), summary.get("residual", {})
    return {
        side: channels.get(name) or residual.get(side, {}).get("unit", "rad") for side, name in POSITION_CHANNELS.items()
    }


def _force(unit: str) -> str:
    return "N" if unit == "m" else "N m"


def _turns(trace: DataFrame, units: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Positions within a turn."""
    return {
        f"{side}.turn": turns
        for side, name in POSITION_CHANNELS.items()
        if name in trace and units[side] == "rad" and (turns := within_turn(trace[name].to_numpy())) is not None
    }


def _coordinates(frame: DataFrame, units: Mapping[str, str]) -> list[dict[str, str]]:
    """The coordinates that a log may be looked at over."""
    motor = units["motor"]
    columns = [
        ("t", "time", "s"), ("u", "input u", _force(motor)), ("theta_e", "motor position θe", motor),
        ("theta_s", "load position θs", units["load"]), ("twist", "twist z", motor), ("displacement", "displacement", "rad"),
    ]  # fmt: skip
    kinds = ("velocity", "speed", "/s"), ("acceleration", "acceleration", "/s²"), ("turn", "position within a turn", "")
    columns += [
        (f"{side}.{name}", f"{side} {label}", units[side] + per) for side in POSITION_CHANNELS for name, label, per in kinds
    ]
    return [{"column": column, "label": label, "unit": unit} for column, label, unit in columns if column in frame]


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


def _groups(summary: JsonObject, frame: DataFrame, units: Mapping[str, str]) -> Iterable[_Group]:
    """The figures of a log, the first two lines of each at the beginning."""
    law, speed = ("true", "true") if "single_run" in summary else ("by the fitted law", "smoothed")
    bandwidths = summary.get("gap", {}).get("holdout", {}).get("bandwidth", {})
    last = summary["findings"][-1]["effect"] if summary.get("findings") else ""
    for side, unit in units.items():
        quantity = f"missing {missing_quantity(_force(unit))}"
        lines = {
            f"{side}.missing_before": "model as given",
            f"{side}.missing_after": "with the missing effects" if last else "numbers fitted",
        }
        for column in map(str, frame):
            kind, _, effect = column.removeprefix(f"{side}.").partition(".")
            if kind == "missing_without":
                lines[column] = f"with the missing effects, without {effect}"
            elif kind == "missing_with":
                lines[column] = f"with {effect} in place of {last}"
        lines[f"{side}.observed_before"] = "model as given, by the observer"
        yield f"{side}: {quantity}", quantity, _force(unit), lines, bandwidths.get(side)
    for side, unit in units.items():
        for name, quantity, per, label in (
            ("residual", "position residual", "", "measured less the model's"),
            ("velocity_error", "velocity error", "/s", "true less observed"),
            ("position_error", "position error", "", "true less observed"),
        ):
            yield f"{side}: {quantity}", quantity, unit + per, {f"{side}.{name}": label}, None
    force = _force(units["motor"])
    lines = {"transmitted": "measured", "torque": law, "torque_by_motor": "by the motor's side"}
    lines |= {f"{side}.torque_estimate": f"by the {side} observer" for side in units}
    if summary.get("kind") == "element":
        lines = {"u": "measured", "torque": "by the fitted law"}
    name = "torque in the transmission" if {"transmitted", "torque"} & {*frame} else "disturbance torque"
    yield name, missing_quantity(force), force, lines, None
    for side, unit in units.items():
        lines = {f"{side}.velocity": speed, f"{side}.velocity_estimate": "by the observer"}
        if f"{side}.velocity_estimate" in frame:
            yield f"{side}: speed", "speed", f"{unit}/s", lines, None
