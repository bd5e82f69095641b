"""What commands on measured logs share: the task, reading, the study's experiment at a log's period, gains, units."""

# arrays of numpy go where those of jax are asked for
# pyright: reportArgumentType=false

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from jaxbl.chain import Experiment
from jaxbl.config import Config, prepare
from jaxbl.drive.effects import EFFECTS, EncoderEffect
from jaxbl.drive.excitation import Sine
from jaxbl.drive.parameters import as_arrays, get_leaf, leaf_paths
from jaxbl.errors import InputError
from jaxbl.records import POSITION_CHANNELS, Record, TurningLog, check_positions, find_zero_shift, join_records, read_record
from jaxbl.records.signal_quality import segments_before

from .free_parameters import PLANT_TABLES

Logs = str | Path | Record | Sequence[str | Path | Record]


class SealedRecord:
    """A record that can be read once: what is held out until the model stands.

    Attributes:
        path, notes, warnings: of the record.
        hash: of all samples.
    """

    def __init__(self, record: Record):
        self._record: Record | None = record
        self.path, self.notes, self.warnings, self.hash = record.path, record.notes, record.warnings, _hash_of(record)

    def open(self) -> Record:
        """The record.

        Raises:
            RuntimeError: it has been read before.
        """
        record, self._record = self._record, None
        if record is None:
            raise RuntimeError(f"{self.path}: what is held out has been read; a second look would be no proof")
        return record


def _hash_of(record: Record) -> bytes:
    total = hashlib.sha256(str(record.segments).encode())
    for values in (record.time, record.torque, *record.positions.values(), record.transmitted, record.reference):
        total.update(b"" if values is None else values.tobytes())
    return total.digest()


def hash_task(settings: Sequence[Any], record: Record, holdout: SealedRecord | None) -> str:
    """Hash of settings, as JSON, and of the logs that decide a result."""
    hashes = [_hash_of(record), b"" if holdout is None else holdout.hash]
    return hashlib.sha256(b"".join([json.dumps(settings, sort_keys=True).encode(), *hashes])).hexdigest()[:16]


@dataclass(frozen=True)
class LogTask:
    """A study and its log, and what is asked of them: everything that decides the result.

    Attributes:
        config: the study.
        missing: tables that the study does not have (`excitation`, `observer.motor`, `observer.load`).
        record: the log that numbers are fitted to.
        holdout: what the model is tried out on when it stands, or None.
    """

    config: Config
    missing: frozenset[str]
    record: Record
    holdout: SealedRecord | None

    @property
    def heading(self) -> dict[str, Any]:
        """Facts on the logs that every summary has, as in `identification.json` and `diagnosis.json`."""
        other = self.holdout
        separate = () if other is None or other.path == self.record.path else other.warnings
        return {
            "title": self.config.title,
            "identity": self.identity,
            "file": str(self.record.path.resolve()),
            "samples": len(self.record.time),
            "sample_period": self.record.sample_period,
            "warnings": [*self.record.warnings, *(f"Held-out log: {warning}" for warning in separate)],
        }

    @property
    def identity(self) -> str:
        """Hash of everything that decides the result."""
        settings = [self.config.to_dict(), sorted(self.missing), version("jaxbl"), _SUMMARIES]
        return hash_task(settings, self.record, self.holdout)


_SUMMARIES = 8
"""Version of what `identification.json` and `diagnosis.json` hold: results of another one are computed anew."""
_MOST_STEPS = 1000
"""Plant steps between two samples of a log at most: a drive moves through many of its time constants then."""


_NEAR = 1e-2
"""Relative difference of the sampling periods of a log and what is held out that changes no result."""


def read_logs(
    config: Config, logs: Logs, like: Record | None = None, *, seeks_delay: bool = False, share: float = 1.0
) -> Record:
    """Read logs as a study says, with the channels that its drive needs.

    A skew of u, and a skew and an offset between the encoders, that one log of a machine is sure of hold for those that are
    not: that of the first such log, or of the record that they are to be `like`. Logs are read at the longest of their
    sampling periods, the finest that all of them have; a finer log than the record they are to be `like` at the record's. An
    input that is earlier than the motion is corrected, too, unless the command `seeks_delay`. Clocks and zero points are
    found by a share of each log, from its beginning.
    """
    several = [logs] if isinstance(logs, str | Path | Record) else list(logs)
    if not several:
        raise InputError("no log: at least one is needed")
    read = partial(_read_one, seeks_delay=seeks_delay, share=share)
    records = [read(config, log) for log in several]
    periods = [record.sample_period for record in records]
    longest = max(periods)
    if like is not None and _is_longer(like.sample_period, longest):
        longest = like.sample_period
    # those that differ by more than rounding are read again
    differ = [not math.isclose(period, longest, rel_tol=1e-6) for period in periods]
    if any(differ):
        config = config.with_keys("log", resample=longest)
        records = [
            read(config, log) if again else record for log, record, again in zip(several, records, differ, strict=True)
        ]
    shared: dict[str, float] = {}
    for record in [*reversed(records)] if like is None else [like]:
        shared |= record.corrections
    for i, (log, record) in enumerate(zip(several, records, strict=True)):
        corrections = record.corrections
        keys = {*shared, *corrections}
        # an offset changes when a counter is switched off and on, the skew of a clock that drifts with each log
        separate = {"offset"} & {*corrections} | ({"skew", "drift"} if "drift" in keys else set())
        corrections = {key: (corrections if key in separate else shared).get(key, 0.0) for key in keys}
        if not isinstance(log, Record) and corrections != record.corrections:
            corrected = config.model_copy(update={"log": config.log.with_corrections(corrections)})
            # the reader counts what [log] gives as no correction of its own
            records[i] = replace(read(corrected, log), corrections=corrections)
    first, *following = records if like is None else (like, *records)
    following = [_from_zero_of(first, record, config, share) for record in following]
    return join_records([first, *following] if like is None else following)


def _is_longer(period: float, other: float) -> bool:
    """Return True if a sampling period (s) is longer than another one, by enough to change results."""
    return period > other and not math.isclose(period, other, rel_tol=_NEAR)


def read_with_holdout(
    config: Config, logs: Logs, holdout: Logs | None, *, seeks_delay: bool = False, share: float = 1.0
) -> tuple[Record, Record | None]:
    """Logs and what is held out, both at the longest of their sampling periods; as :func:`read_logs`.

    Clocks and zero points of logs that are held out are found by their first fifth, which then does not count.
    """
    record = read_logs(config, logs, seeks_delay=seeks_delay, share=share)
    if holdout is None:
        return record, None
    other = _read_held_out(config, holdout, record, seeks_delay)
    if _is_longer(other.sample_period, record.sample_period):
        config = config.with_keys("log", resample=other.sample_period)
        record = read_logs(config, logs, seeks_delay=seeks_delay, share=share)
        other = _read_held_out(config, holdout, record, seeks_delay)
    check_positions(record, other)
    return record, other


FIRST_FIFTH = 0.2
"""Share of a log that is held out by which its clocks and zero points are found."""


def _read_held_out(config: Config, holdout: Logs, record: Record, seeks_delay: bool) -> Record:
    """Logs that are held out from another record, without the part that their clocks and zero points are found by."""
    other, parts = read_logs(config, holdout, record, seeks_delay=seeks_delay, share=FIRST_FIFTH), []
    for _, rows in other.logs:
        first = rows.start + round(FIRST_FIFTH * (rows.stop - rows.start))
        parts += [slice(max(part.start, first), part.stop) for part in other.segments if first < part.stop <= rows.stop]
    corrected = any(value and value != record.corrections.get(key) for key, value in other.corrections.items())
    return replace(other, segments=tuple(parts)) if corrected else other


def _from_zero_of(first: Record, record: Record, config: Config, share: float) -> Record:
    """A log whose positions count from the zero of another one, as far as torques that repeat with the turn show it in a
    share of it."""
    table, geared = config.log, config.drive.kind == "two_inertia"
    two = geared and all("load" in log.positions for log in (first, record))
    has_offset = any(channel is not None and channel.offset is not None for channel in (table.theta_e, table.theta_s))
    if has_offset or record.statistics.channels["theta_e"].unit != "rad":
        return record
    ratio = config.drive.gear_ratio if geared else 1.0
    motions = []
    for log in (first, record):
        assert log.torque is not None
        load = ratio * log.positions["load"] if two else None
        segments = segments_before(log.segments, round((share if log is record else 1.0) * len(log.time)))
        motions.append(TurningLog(log.torque, log.positions["motor"], load, segments, log.sample_period))
    shift = find_zero_shift(*motions)
    if shift is None:
        return record
    waves = ", ".join(map(str, shift.waves))
    other = f" (to theta_s 1/{ratio:g} of it)" if geared and "load" in record.positions else ""
    warning = (
        f"theta_e counts from another zero than in {first.path.name}, by the torque that repeats {waves} times a turn: "
        f"{shift.value:.4g} ± {shift.error:.1g} rad were added{other}."
        + (" [log] theta_e.offset = 0 corrects nothing." if table.omega_e is None else "")
    )
    positions = {
        side: values + shift.value / (ratio if side == "load" else 1.0) for side, values in record.positions.items()
    }
    corrections = record.corrections | {"zero": shift.value}
    return replace(record, positions=positions, warnings=(*record.warnings, warning), corrections=corrections)


def _read_one(config: Config, log: str | Path | Record, seeks_delay: bool, share: float) -> Record:
    if isinstance(log, Record):
        return _check_record(config, log)
    ratio = config.drive.gear_ratio if config.drive.kind == "two_inertia" else None
    nominal = config.nominal_drive()
    if seeks_delay and nominal.dead_time == "no":
        nominal = replace(nominal, dead_time="sought")
    return _check_record(config, read_record(log, config.log, gear_ratio=ratio, nominal=nominal, share=share))


def _check_record(config: Config, record: Record) -> Record:
    """A log that the study's drive can be fitted to, with what is said first; InputError where it cannot."""
    if record.contradiction:
        raise InputError(f"{record.path}: {record.contradiction}")
    if "motor" not in record.positions:
        raise InputError(
            f"{record.path}: no motor position ({POSITION_CHANNELS['motor']}), which a {config.drive.kind} drive needs; "
            f"the log has {', '.join(record.positions)}; [log] theta_e can name its column"
        )
    if config.drive.kind == "two_inertia" and "load" not in record.positions:
        if record.torque is None:
            raise InputError(
                f"{record.path}: neither a load position (theta_s) nor a torque (u); from the motor's encoder load and gap "
                "show only together with the motor's torque or current: log that, too"
            )
        first = "No load position (theta_s): load, gap and frictions are found from the motor's encoder and u alone."
        record = replace(record, warnings=tuple(dict.fromkeys((*record.warnings, first))))
    step = config.run.sample_period / config.run.substeps
    if record.sample_period > _MOST_STEPS * step:
        raise InputError(
            f"{record.path}: its samples are {record.sample_period:.4g} s apart, more than {_MOST_STEPS} plant steps of "
            f"{step:.3g} s ([run]); where the stamps are not in s, [log] t.unit says so"
        )
    for effect in config.effects:
        if issubclass(cls := EFFECTS[effect.kind], EncoderEffect):
            raise InputError(f"{record.path}: {effect.kind} has no place in a model of a log: {cls.in_log}")
        if fault := EFFECTS[effect.kind].find_fault(effect.model_dump(), record.sample_period):
            raise InputError(f"{record.path}: {effect.kind}: {fault}")
    if record.torque is None:
        if not any(path.endswith("inertia") for path in config.uncertainty.exact):
            raise InputError(
                f"{record.path}: without u a motion shows torques only as multiples of an inertia: put a known one into "
                "[uncertainty] exact ('drive.motor_inertia'), or record u; jaxbl inspect says what the encoders show"
            )
        notes = (*record.notes, "No input torque was recorded: the drive is taken to move freely, without one.")
        record = replace(record, torque=np.zeros(len(record.time)), notes=notes)
    return record


def arrays(values: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Numbers by path as arrays."""
    return {path: np.asarray(value, float) for path, value in values.items()}


def run_of(config: Config, record: Record) -> dict[str, Any]:
    """`sample_period` and `substeps` of the record: its period, and plant steps no longer than the study's."""
    step = config.run.sample_period / config.run.substeps
    substeps = max(int(np.ceil(record.sample_period / step * (1.0 - 1e-9))), 1)
    return {"sample_period": record.sample_period, "substeps": substeps}


def on_record(config: Config, record: Record) -> Experiment:
    """The study's experiment at the record's period, with plant steps no longer than the study's, and without excitation:
    the input is the record's."""
    experiment = prepare(config.with_keys("run", precision="float64"))
    # along a log nothing asks for excitation and steps; programs are compiled for one of them
    run = run_of(config, record) | {"sample_period": np.asarray(record.sample_period, float), "steps": 1}
    return replace(experiment, excitation=as_arrays(Sine(0.0, 1.0), float), run=replace(experiment.run, **run))


def default_paths(config: Config, experiment: Experiment) -> list[str]:
    """All numbers of the plant that are not known exactly, but for frequencies of 0 and what a fit leaves as it is."""
    return [
        path
        for path, parameter in leaf_paths(experiment).items()
        if path.split(".")[0] in PLANT_TABLES
        and path not in config.uncertainty.exact
        and not (
            parameter.role
            and float(get_leaf(experiment, path))
            == {"held": parameter.role.neutral, "frequency": 0.0}.get(parameter.role.kind)
        )
    ]


def decimation(config: Config, record: Record) -> int:
    """Samples that become one where torques are compared."""
    bandwidth = config.identify.bandwidth
    if bandwidth is None:
        return 10
    return max(round(0.5 / (bandwidth * record.sample_period)), 1)
