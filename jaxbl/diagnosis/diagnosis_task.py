"""A diagnosis as a task: study, log, and what is held out of it; and which logs are refused."""

from dataclasses import dataclass, replace

import numpy as np

from jaxbl.config import ConfigSource, read_model
from jaxbl.errors import InputError
from jaxbl.estimation.logs import Logs, LogTask, SealedRecord, read_with_holdout
from jaxbl.estimation.segments import skip_unknown_input
from jaxbl.records import Record
from jaxbl.records.least_squares import rms
from jaxbl.records.plausibility import GEAR_TOLERANCE
from jaxbl.records.signal_quality import segments_before

HELD_OUT = 0.25
"""Share of a log that is held out where there is no other one for it."""
_LEAST_SAMPLES = 100
"""Samples of a part of a log, and of what is held out: the smoother's ends, some ten samples each, are then a small part."""
_SHOWN, _KNOWN = 0.1, 10.0
"""Share of the torque that an inertia takes, and its standard errors, from which on it is compared."""
_LOOSE = 0.1
"""Residual of a gear's ratio from which on it is not compared."""
_ALIKE = 4.0
"""Factor between the inertias that two logs of one machine may show."""


@dataclass(frozen=True)
class DiagnosisTask(LogTask):
    """A study and its log, part of which is held out.

    Attributes:
        holdout: the rest of the log, or another log.
        separate: whether it is another log.
    """

    holdout: SealedRecord
    separate: bool


def read_diagnosis_task(log: Logs, model: ConfigSource, *, holdout: Logs | None = None) -> DiagnosisTask:
    """Read study and logs; arguments as of :func:`jaxbl.diagnosis.diagnose.diagnose`.

    Raises:
        InputError: unfit log or study, or a hold-out log of another machine.
    """
    config, missing = read_model(model)
    share = 1.0 if holdout is not None else 1.0 - HELD_OUT
    record, other = read_with_holdout(config, log, holdout, seeks_delay=True, share=share)
    if other is None:
        record, other = split_off_last_quarter(record)
    else:
        _check_machine(record, other)
    at_rest = config.log.initial_state == "rest"
    record, other = (skip_unknown_input(_long(log), at_rest) for log in (record, other))
    return DiagnosisTask(config, missing, record, SealedRecord(other), holdout is not None)


def input_rms(record: Record) -> float:
    """Return the rms of the input on all segments of a log, N m."""
    assert record.torque is not None
    return rms(record.torque[np.r_[record.segments]])


def _long(record: Record) -> Record:
    """Without parts that are too short for the equations of motion."""
    parts = tuple(part for part in record.segments if part.stop - part.start >= _LEAST_SAMPLES)
    if not parts:
        raise InputError(
            f"{record.path}: its longest part has {max(part.stop - part.start for part in record.segments)} samples; "
            f"at least {_LEAST_SAMPLES} are needed"
        )
    return replace(record, segments=parts)


def can_hold_out(record: Record) -> bool:
    """Tell whether a log is long enough for a quarter of it to be held out."""
    return HELD_OUT * len(np.r_[record.segments]) >= _LEAST_SAMPLES


def split_off_last_quarter(record: Record) -> tuple[Record, Record]:
    """The samples to be fitted, and those held out: the last of the log, at their own times."""
    rows = np.r_[record.segments]
    if not can_hold_out(record):
        raise InputError(
            f"{record.path}: {len(rows)} samples are too few to hold a quarter of them out; at least "
            f"{int(np.ceil(_LEAST_SAMPLES / HELD_OUT))} are needed, or another log: --holdout"
        )
    row = int(rows[round((1.0 - HELD_OUT) * len(rows)) - 1]) + 1
    first = tuple(segments_before(record.segments, row))
    last = tuple(slice(max(part.start, row), part.stop) for part in record.segments if part.stop > row)
    cut = {
        name: None if (values := getattr(record, name)) is None else values[:row]
        for name in ("time", "torque", "transmitted", "reference")
    }
    positions = {side: values[:row] for side, values in record.positions.items()}
    # times count from the log's first sample in both: a disturbance may be periodic in time
    return replace(record, **cut, positions=positions, segments=first), replace(record, segments=last)


def _check_machine(record: Record, other: Record) -> None:
    """Refuse a hold-out log of another machine."""
    if other.path.resolve() == record.path.resolve():
        raise InputError(f"{other.path}: is the log itself; without --holdout its last quarter is held out")
    if not np.isclose(record.sample_period, other.sample_period, rtol=1e-2, atol=0.0):
        raise InputError(
            f"{other.path}: is sampled every {other.sample_period:.6g} s, {record.path} every {record.sample_period:.6g} s; "
            f"set [log] resample = {record.sample_period:.6g} to read both at the same period"
        )
    ratios = [
        gear.ratio
        for gear in (record.statistics.gearing, other.statistics.gearing)
        if gear is not None and not gear.is_loose and gear.residual < _LOOSE
    ]
    if len(ratios) == 2 and abs(ratios[1] / ratios[0] - 1.0) > GEAR_TOLERANCE:
        raise InputError(
            f"{other.path}: theta_e moves {ratios[1]:.4g} for each 1 of theta_s, on {record.path} {ratios[0]:.4g}; it "
            "is of another machine, or a sign or unit differs"
        )
    inertias = [
        float(dynamics.values[0])
        for dynamics in (record.statistics.dynamics, other.statistics.dynamics)
        if dynamics is not None
        and dynamics.shares[0] > _SHOWN
        and _KNOWN * dynamics.errors[0] * dynamics.inflation[0] < abs(dynamics.values[0])
    ]
    if len(inertias) == 2 and not 1.0 / _ALIKE < inertias[1] / inertias[0] < _ALIKE:
        raise InputError(
            f"{other.path}: shows an inertia of {inertias[1]:.3g}, {record.path} of {inertias[0]:.3g} at the motor; it is "
            "of another machine, or a sign or unit differs"
        )
