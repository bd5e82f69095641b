"""A transmission alone on a test rig, from its log: what `jaxbl identify` does where `[log] kind` is `element`."""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pandas as pd

from jaxbl.drive.effects import CoulombFriction, Damping, Hysteresis, LoadFriction
from jaxbl.drive.transmission import DeadZone, LinearShaft
from jaxbl.errors import InputError
from jaxbl.files import to_jsonable
from jaxbl.json_types import JsonObject
from jaxbl.quantity import Quantity
from jaxbl.records import LogTable, Record, check_positions, read_log_table, read_record
from jaxbl.records.element import Element, element_error, fit_element
from jaxbl.records.inspection import make_rig_log

from .logs import SealedRecord, hash_task

_PATHS = {
    "stiffness": "transmission.stiffness",
    "half_gap": "transmission.half_gap",
    "damping": f"effects.transmission.{Damping.kind}.damping",
    "dry_friction": f"effects.motor.{CoulombFriction.kind}.torque",
    "hysteresis": f"effects.transmission.{Hysteresis.kind}.torque",
    "length": f"effects.transmission.{Hysteresis.kind}.length",
    "friction_coefficient": f"effects.transmission.{LoadFriction.kind}.coefficient",
}
"""Paths in a study."""
_SLIP_NOTE = "play, spring and slip lie in series here: studies have no slip, so that their table has play and spring alone"


@dataclass(frozen=True)
class ElementTask:
    """A log of a transmission on a test rig, and how it was read: everything that decides the result.

    Attributes:
        table: how the logs are read.
        gear_ratio: of the displacements of both sides; None where there is one.
        record: the log.
        holdout: another log, on which what was found is tried out, or None.
    """

    table: LogTable
    gear_ratio: float | None
    record: Record
    holdout: SealedRecord | None

    @property
    def identity(self) -> str:
        """Hash of everything that decides the result."""
        return hash_task([self.table.model_dump(), self.gear_ratio, version("jaxbl")], self.record, self.holdout)


@dataclass(frozen=True)
class ElementIdentification:
    """A transmission on a test rig as its log shows it.

    Attributes:
        task: the log.
        element: its numbers.
        summary: as in `identification.json`.
        trace: one row a sample: `t`, `u`, `displacement`, `torque` of what was found (empty before the first reversal).
        tables: `[transmission]` and `[[effects]]` of a study with these numbers, to be included in one that has `[drive]`.
    """

    task: ElementTask
    element: Element
    summary: JsonObject
    trace: pd.DataFrame
    tables: JsonObject


def read_element_task(
    log: str | Path, table: LogTable, gear_ratio: float | None = None, *, holdout: str | Path | None = None
) -> ElementTask:
    """Read the logs; `gear_ratio` is that of the displacements of both sides, 1 if left out.

    Raises:
        InputError: an unfit log.
    """
    record, other = read_record(log, table), None if holdout is None else read_record(holdout, table)
    if other is not None:
        check_positions(record, other)
        check_positions(other, record)
    ratio = None if len(record.positions) < 2 else gear_ratio or 1.0
    return ElementTask(table, ratio, record, None if other is None else SealedRecord(other))


def identify_element(
    log: str | Path,
    table: LogTable | Mapping[str, Any],
    *,
    gear_ratio: float | None = None,
    holdout: str | Path | None = None,
) -> ElementIdentification:
    """Find stiffness, gap, friction and hysteresis of a transmission alone on a test rig.

    Args:
        log: the file.
        table: the `[log]` table, or its keys; of the kind `element`, whatever it says.
        gear_ratio: displacement of theta_e for 1 of theta_s, where both are recorded; left out: 1.
        holdout: another log of the rig, on which what was found is tried out.

    Raises:
        InputError: an unfit log or table, or a log that shows no stiffness.
    """
    keys = table.model_dump(exclude_unset=True) if isinstance(table, LogTable) else dict(table)
    return run_element(read_element_task(log, read_log_table(keys | {"kind": "element"}), gear_ratio, holdout=holdout))


def run_element(task: ElementTask) -> ElementIdentification:
    """Do what :func:`read_element_task` read.

    Raises:
        InputError: a log that shows no stiffness.
    """
    record = task.record
    log = make_rig_log(record, task.gear_ratio)
    element = fit_element(log)
    if element is None:
        raise InputError(
            f"{record.path}: the displacement never turns back, or hardly moves; a log of a transmission should load it to "
            "and fro"
        )
    stiffness = element.numbers["stiffness"]
    determined = {name: number for name, number in element.numbers.items() if name not in element.open}
    if "stiffness" not in determined or stiffness.value <= 0.0:
        names = sorted(determined.keys() - {"stiffness", "offset", "centre"})
        remark = "".join(f"; what it shows: {name} {determined[name]}" for name in names)
        raise InputError(
            f"{record.path}: the torque does not follow the displacement (stiffness {stiffness}){remark}; "
            "see columns and signs in [log]"
        )
    trace = pd.DataFrame({"t": record.time, "u": log.torque, "displacement": log.position, "torque": element.torque})
    return ElementIdentification(task, element, to_jsonable(_summary(task, element, determined)), trace, _tables(determined))


def _summary(task: ElementTask, element: Element, determined: Mapping[str, Quantity]) -> JsonObject:
    record = task.record
    summary = {
        "title": f"Transmission of {record.path.name}",
        "kind": "element",
        "identity": task.identity,
        "file": str(record.path.resolve()),
        "samples": len(record.time),
        "sample_period": record.sample_period,
        "parameters": {_PATHS.get(name, name): number.to_dict() | {"nominal": None} for name, number in determined.items()},
        "refused": [
            {"direction": {_PATHS.get(name, name): 1.0}, "why": "this log leaves it open by more than half of its value"}
            for name in element.open
        ],
        "method": {"element": {"terms": element.model.terms, "gains": element.gains, "reversals": element.reversals}},
        "torque": {"element": {"rms": element.residual, "relative": element.share, "unit": element.numbers["offset"].unit}},
        "warnings": record.warnings,
        "notes": [*record.notes, *([_SLIP_NOTE] if "slip" in determined else [])],
    }
    if task.holdout is not None:
        error = element_error(element, make_rig_log(task.holdout.open(), task.gear_ratio))
        rms, relative = error or (None, None)
        summary["holdout"] = {"file": str(task.holdout.path.resolve()), "torque": {"rms": rms, "relative": relative}}
    return summary


def _tables(determined: Mapping[str, Quantity]) -> JsonObject:
    transmission: JsonObject = {"law": (DeadZone if "half_gap" in determined else LinearShaft).name}
    effects: dict[str, JsonObject] = {}
    for name, path in _PATHS.items():
        if name in determined:
            owner, _, key = path.removeprefix("effects.").rpartition(".")
            table = transmission if owner == "transmission" else effects.setdefault(owner, {"kind": owner})
            table[key] = determined[name].value
    # a hysteresis whose length is open has no torque that a study could simulate
    complete = [effect for kind, effect in effects.items() if not kind.endswith(Hysteresis.kind) or len(effect) == 3]
    return {"transmission": transmission} | ({"effects": complete} if complete else {})
