"""A log and what models make of it, in a browser: results of `jaxbl identify` and `jaxbl diagnose`."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from matplotlib import colormaps
from matplotlib.colors import to_hex

from jaxbl.diagnosis.coordinates import within_turn
from jaxbl.errors import InputError
from jaxbl.files import read_json, to_path
from jaxbl.json_types import JsonObject
from jaxbl.records import POSITION_CHANNELS
from jaxbl.report.diagnose import diagnosis_lines
from jaxbl.report.element import element_lines
from jaxbl.report.identify import identification_lines
from jaxbl.report.residuals import missing_quantity
from jaxbl.units import on_a_line

from .folder import ROW_GROUP, Source, write_page

_LABELS = {"t": "time", "u": "input u", "theta_e": "motor position θe", "theta_s": "load position θs", "twist": "twist z",
           "displacement": "displacement"}  # fmt: skip
_RESULTS = {"diagnosis.json": "Diagnosis of", "identification.json": "Identification from"}


def _summary_file(folder: str | Path) -> Path | None:
    """The newest summary in a folder: identify and diagnose may have written into one, the trace is of the last."""
    files = [file for name in _RESULTS if (file := to_path(folder) / name).is_file()]
    return max(files, key=lambda one: one.stat().st_mtime_ns, default=None)


def log_source(folder: str | Path) -> Source | None:
    """Results of `jaxbl identify` or `jaxbl diagnose`, to be explored; None where a folder holds none.

    Raises:
        InputError: files are damaged or missing.
    """
    file = _summary_file(folder)
    if file is None:
        return None
    summary = read_json(file)
    if summary.get("kind") == "element":
        lead = element_lines(summary)
    else:
        lead = (diagnosis_lines if file.name == "diagnosis.json" else identification_lines)(summary)
    title = summary["title"] or f"{_RESULTS[file.name]} {Path(summary['file']).name}"

    def write(out: Path, served: bool) -> bool:
        model, frame = (_read(file.with_name(name)) for name in ("model.toml", "trace.parquet"))
        about = write_log(summary, frame, out)
        about |= {"title": title, "lead": lead, "config": model, "file": "model.toml"}
        write_page(out, ("log",), about, scripts=not served)
        return False

    return Source(str(summary["identity"]), lead, write, {}, lambda: None, lambda: None)


def _read(file: Path) -> Any:
    """Text, or a table. Raises `InputError` where it cannot be read."""
    try:
        return pd.read_parquet(file) if file.suffix == ".parquet" else file.read_text(encoding="utf-8")
    except (OSError, ValueError, pa.ArrowException) as error:
        raise InputError(
            f"{file}: cannot be read ({error}); run the command that wrote it again, with --overwrite"
        ) from None


def write_log(summary: JsonObject, trace: pd.DataFrame, out: Path) -> JsonObject:
    """Write `points.parquet`, and return what the page says of its columns.

    Args:
        summary: as in `diagnosis.json` or `identification.json`.
        trace: as in `trace.parquet`.
        out: folder.
    """
    units = _units(summary)
    frame = trace.assign(**_turns(trace, units))
    coordinates = list(_coordinates(frame, units))
    groups = [one for one in _groups(summary, frame, units) if one["lines"]]
    if not groups:
        raise InputError(
            "explore: trace.parquet has no column that the page could draw; run the command that wrote it again"
        )
    kept = {one["column"] for one in (*coordinates, *(line for group in groups for line in group["lines"]))} | {"held_out"}
    # float32 would round times; what is not there stays nan, which a page reads as a number
    shown = {str(name): np.asarray(frame[name], np.float64 if name == "t" else np.float32) for name in frame if name in kept}
    pq.write_table(pa.table(shown), out / "points.parquet", row_group_size=ROW_GROUP, use_dictionary=False)
    return {
        "rows": len(frame),
        "period": summary["sample_period"],
        "held": "held_out" in frame and bool(frame["held_out"].any()),
        "coordinates": coordinates,
        "over": _first(summary, frame),
        "groups": groups,
        "colours": [to_hex(one) for one in colormaps["PuOr_r"](np.linspace(0.0, 1.0, 256))],
    }


def _units(summary: JsonObject) -> dict[str, str]:
    """Unit of each side's position: m on a linear axis."""
    if "gap" in summary:
        return {side: summary["gap"]["units"].get(name, "rad") for side, name in POSITION_CHANNELS.items()}
    return {side: summary.get("residual", {}).get(side, {}).get("unit", "rad") for side in POSITION_CHANNELS}


def _force(unit: str) -> str:
    return on_a_line("N m") if unit == "m" else "N m"


def _turns(trace: pd.DataFrame, units: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Positions within a turn."""
    found = {}
    for side, name in POSITION_CHANNELS.items():
        if name in trace and units[side] == "rad" and (turned := within_turn(trace[name].to_numpy())) is not None:
            found[f"{side}.turn"] = turned
    return found


def _coordinates(frame: pd.DataFrame, units: Mapping[str, str]) -> Iterable[dict[str, str]]:
    """What a log may be looked at over."""
    motor = units["motor"]
    known = {"t": "s", "u": _force(motor), "theta_e": motor, "theta_s": units["load"], "twist": motor, "displacement": "rad"}
    for name, unit in known.items():
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


def _first(summary: JsonObject, frame: pd.DataFrame) -> list[str]:
    """Two coordinates that a log is looked at over at first: of a diagnosis those that explain most on the motor's side."""
    explained = {
        name: one["explained"] for name, one in summary.get("where", {}).get("motor", {}).get("coordinates", {}).items()
    }
    names = [name for name, column in _NAMES.items() if column in frame]
    return [_NAMES[name] for name in sorted(names, key=lambda name: -(explained.get(name) or 0.0))[:2]]


def _groups(summary: JsonObject, frame: pd.DataFrame, units: Mapping[str, str]) -> Iterable[JsonObject]:
    """What is drawn in one figure: a quantity, and its lines, the first two at the beginning."""

    def group(name: str, quantity: str, unit: str, lines: Mapping[str, str], bandwidth: float | None = None) -> JsonObject:
        kept = [{"column": column, "label": label} for column, label in lines.items() if column in frame]
        return {"name": name, "quantity": quantity, "unit": unit, "bandwidth": bandwidth, "lines": kept}

    bandwidths = summary.get("gap", {}).get("holdout", {}).get("bandwidth", {})
    last = summary["findings"][-1]["effect"] if summary.get("findings") else ""
    for side, unit in units.items():
        quantity = f"missing {missing_quantity(_force(unit))}"
        lines = {f"{side}.missing_before": "model as given", f"{side}.missing_after": _AFTER if last else "numbers fitted"}
        for column in frame:
            _, without, name = str(column).partition(f"{side}.missing_without.")
            _, other, rival = str(column).partition(f"{side}.missing_with.")
            if without:
                lines[str(column)] = f"with the missing effects, without {name}"
            elif other:
                lines[str(column)] = f"with {rival} in place of {last}"
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
    inside = "transmitted" in frame or "torque" in frame
    yield group(
        "torque in the transmission" if inside else "disturbance torque",
        "torque" if force == "N m" else "force",
        force,
        lines,
    )
    for side, unit in units.items():
        lines = {f"{side}.velocity": "smoothed", f"{side}.velocity_estimate": "by the observer"}
        if f"{side}.velocity_estimate" in frame:
            yield group(f"{side}: speed", "speed", f"{unit}/s", lines)


_AFTER = "with the missing effects"
