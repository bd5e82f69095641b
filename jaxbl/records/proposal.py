"""Propose a first study for a log: columns guessed by name and unit, and a nominal drive from a rough fit."""

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxbl.errors import InputError

from .alignment import NominalDrive
from .channels import POSITION_FACTORS, SPEED_FACTORS
from .files import LogFile, read_log_file
from .inspection import Inspection, inspect
from .least_squares import fit_with_jackknife
from .libraries import ColumnName
from .rigid_body import smooth_sign
from .signal_quality import long_segments, low_pass, low_pass_motion, trim_filter_ends
from .table import POSITION_CHANNELS
from .time_stamps import SECONDS_PER_UNIT
from .unnamed_columns import find_latest, find_moving_columns, find_stamps, rises_evenly

_Table = dict[str, Any]
"""A table of a study, by key."""
_ROUGH_UNCERTAINTY = 0.5
"""Relative uncertainty of numbers from a rough fit: inertias and stiffness may be split wrongly between the sides."""
_LARGEST_WHOLE = 100.0
"""Ratio from which on a whole number has to lie within the errors: ratios of several stages are no whole numbers."""
_SURE_RATIO = 0.02
"""Standard error of a large ratio up to which a whole number in its reach is no chance: one of eight ratios has one."""
_NAME_PATTERNS = {
    "t": r"ts?|clock|date|millis|micros|.*(time|zeit|stamp|elapsed).*",
    "u": r"(u|i|i_?q|q_current|tau|trq|curr?|vm|vir)\d*|.*(torque|moment|force|kraft|effort|current|strom|volt).*",
    "load": r"s|l|out|arm|link|secondary|enc(oder)?_?2|.*(load|last|output|abtrieb|joint|gelenk).*",
    "motor": r".*motor.*",
    "omega": r"(vel|velo|spd|rpm|dq|qd)\d*|.*(omega|speed|velocit|drehzahl|geschwindigkeit).*",
    "position": r"(pos|ang|phi|q|qm|enc)\d*|.*(theta|positi|angle|winkel|lage|encod).*",
    "setpoint": r"goal|set|ref|cmd|.*(target|command|desired|soll|demand|setpoint|reference).*",
    "supply": r".*volt.*",
}
"""Kind of a column -> its usual words, or joined words."""
_SPELLINGS = {
    "rad": "rad", "deg": "deg|°|degrees", "turn": "turn|turns|rev", "m": "m", "mm": "mm",
    "counts": "counts|count|inc|tick|ticks",
    "s": "s|sec", "ms": "ms|millis", "us": "us|µs|micros", "ns": "ns", "N m": "nm|n m|n·m", "N": "n", "A": "a", "V": "v",
    "rpm": "rpm|1/min", "rad/s": "rad/s", "deg/s": "deg/s|°/s", "turn/s": "rev/s", "m/s": "m/s", "mm/s": "mm/s",
    "mN m": "mnm|mn m", "%": "%|percent", "mA": "ma",
}  # fmt: skip
_UNIT_NAMES = {spelling: unit for unit, spellings in _SPELLINGS.items() for spelling in spellings.split("|")}
"""Spelling of a unit -> its name in `[log]`."""
_SPEED_UNITS, _POSITION_UNITS = [*SPEED_FACTORS], [*POSITION_FACTORS]
_TORQUE_UNITS = {
    "N m": ("N m", None), "N": ("N", None), "A": ("A", 1.0), "V": ("V", 1.0), "counts": ("counts", 1.0),
    "mN m": ("N m", 1e-3), "%": ("N m", 0.01), "mA": ("A", 1e-3),
}  # fmt: skip
"""Unit of a torque -> unit and factor in `[log]`."""


class _Candidate(NamedTuple):
    """A column that may hold a channel; a second choice stands in for one that is missing."""

    is_second_choice: bool
    column: ColumnName
    name: str
    unit: str
    values: np.ndarray


def _split_unit(file: LogFile, column: ColumnName) -> tuple[str, str]:
    """Split the name of a column: words in lower case without its unit, and the unit as `[log]` calls it, "" for none."""
    name, unit = str(column).strip(), str(file.units.get(column, "")).lower()
    if match := re.search(r"[\[(]\s*(.+?)\s*[\])]\s*$", name):
        # what follows without a blank is a unit that is known, or the index or name of an element
        if match[1].lower() in _UNIT_NAMES or name[: match.start()].endswith(" "):
            unit = unit or match[1].lower()
        name = name[: match.start()]
    # of single letters only these are no index, after a word or a stroke
    if (
        (match := re.search(r"(?:^|[_ /])([^\W_]{2,}|[°%AV]|(?<=/)\w|(?<=time_)s)$", name))
        and not unit
        and match[1].lower() in _UNIT_NAMES
    ):
        name, unit = name[: match.start()], match[1].lower()
    words = re.split(r"[^a-z0-9äöü]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower())
    # the current position is no current
    is_idle = r"\b(present|actual|measured|current (?=(joint|motor|pos|ang|vel|speed|theta)))\s*"
    name = re.sub(is_idle, "", " ".join(filter(None, words))).strip()
    return name, _UNIT_NAMES.get(unit, unit)


def _matches(kind: str, name: str) -> bool:
    """Return True if a name, or a word of it, is usual for a kind of column."""
    return any(re.fullmatch(_NAME_PATTERNS[kind], word) for word in (name.replace(" ", "_"), *name.split()))


def _guess_channel(name: str, unit: str) -> str:
    """Guess the channel of a column from its name and unit; "" for none."""
    if _matches("t", name) or (not name and unit in SECONDS_PER_UNIT):
        return "t"
    side = "s" if _matches("load", name) else "e"
    # an unknown unit fits any quantity
    is_possible = {kind: unit in units or unit not in _UNIT_NAMES.values() for kind, units in
           (("u", _TORQUE_UNITS), ("omega", (*_SPEED_UNITS, "counts")), ("position", _POSITION_UNITS))}  # fmt: skip
    if is_possible["u"] and (_matches("u", name) or (not name and unit in ("mA", "A", "N m"))):
        return "u"
    if unit in _SPEED_UNITS or _matches("omega", name):
        return f"omega_{side}" if is_possible["omega"] else ""
    # motor or load as the only word does not tell the quantity: a temperature is one of the motor, too
    is_bare_side = name in ("motor", "load", "output", "arm", "joint", "link", "secondary") and not unit
    has_position_unit = unit in _POSITION_UNITS and (not name or _matches("motor", name) or _matches("load", name))
    is_position = _matches("position", name) and is_possible["position"]
    return f"theta_{side}" if is_position or is_bare_side or has_position_unit else ""


def _is_servo_load(candidate: _Candidate) -> bool:
    return (candidate.name, candidate.unit) == ("load", "")


def guess_log_table(path: str | Path) -> tuple[_Table, list[str]]:
    """Guess a `[log]` table from names, units and values of columns; it comes with a sentence on each uncertain guess.

    Raises:
        InputError: no column looks like a position or a speed, or like a time.
    """
    file = read_log_file(Path(path))
    candidates: dict[str, list[_Candidate]] = {}
    for column in file.columns:
        name, unit = _split_unit(file, column)
        channel, is_setpoint = _guess_channel(name, unit), _matches("setpoint", name)
        # a commanded torque stands for one that was not measured, a side alone for a position
        is_second_choice = not _matches("position", name)
        if channel == "u":
            is_second_choice = is_setpoint or _matches("load", name) or _matches("supply", name)
        values = file.load_values(column) if channel else np.zeros(0)
        if channel == "t" or (values.dtype.kind in "iuf" and channel and (channel == "u" or not is_setpoint)):
            candidates.setdefault(channel, []).append(_Candidate(is_second_choice, column, name, unit, values))
    if (bare := candidates.get("theta_s")) and any(
        not candidate.is_second_choice for candidate in candidates.get("theta_e", ())
    ):
        # beside a named position it is how much a servo is loaded
        candidates["u"] = [*filter(_is_servo_load, bare), *candidates.get("u", [])]
        candidates["theta_s"] = [candidate for candidate in bare if not _is_servo_load(candidate)]
    guesses: list[str] = []
    table: _Table = {}
    if not candidates.get("t") or not any(map(candidates.get, ("theta_e", "theta_s", "omega_e", "omega_s"))):
        period = _add_candidates_by_values(file, candidates, guesses)
        if period is not None:
            table["t"] = {"period": period}
    chosen: dict[str, _Candidate] = {}
    # the torque is chosen to the position
    for channel in ("t", "theta_e", "theta_s", "omega_e", "omega_s", "u"):
        if candidates.get(channel):
            words = {word for candidate in chosen.values() for word in candidate.name.split()}
            chosen[channel] = _choose(candidates[channel], words)
    for channel, (_, column, name, unit, values) in chosen.items():
        if channel == "t":
            table["t"] = _guess_time_table(column, unit, values, guesses)
        elif channel == "u":
            if _matches("setpoint", name):
                guesses.append(f"u is '{column}', the commanded torque: no column looks like a measured one.")
            table["u"] = _guess_torque_table(column, unit, guesses)
        elif channel.startswith("theta"):
            table[channel] = _guess_position_table(column, unit, values, guesses)
        # a measured position is better than the integral of a speed
        elif channel.replace("omega", "theta") not in chosen:
            table[channel] = _assume_unit(column, unit, _SPEED_UNITS, guesses)
    if not {"theta_e", "theta_s", "omega_e", "omega_s"} & set(table):
        columns = ", ".join(map(str, file.columns))
        raise InputError(f"{path}: no column is called like a position or a speed: {columns}; [log] theta_e can name one")
    if "u" not in table:
        table["absent"] = ["u"]
        guesses.append("No column looks like a torque: u is taken as not recorded.")
    if "t" not in table:
        raise InputError(f"{path}: no column is called like a time; [log] t can name it, or give a period")
    return table, guesses


def _add_candidates_by_values(file: LogFile, candidates: dict[str, list[_Candidate]], guesses: list[str]) -> float | None:
    """Add the time, and where no name is that of a position or speed also these and a torque, by how the columns change.

    Returns:
        The period of a file without a time, s, if a speed shows it.
    """
    signals = {column: file.load_values(column) for column in file.columns}
    found: dict[str, ColumnName] = {}
    if not candidates.get("t") and (stamps := find_stamps(signals)) is not None:
        found["t"] = stamps
    period = None
    if not any(map(candidates.get, ("theta_e", "theta_s", "omega_e", "omega_s"))):
        named = {candidate.column for columns in candidates.values() for candidate in columns}
        moving = {
            column: values.astype(float)
            for column, values in signals.items()
            if values.dtype.kind in "iuf" and not rises_evenly(values) and column not in named
            if not _matches("setpoint", _split_unit(file, column)[0]) and np.isfinite(values).all() and np.ptp(values)
        }
        if len({len(values) for values in moving.values()}) == 1:
            times = (
                signals[found["t"]] if "t" in found else (*(chosen.values for chosen in candidates.get("t", ())), None)[0]
            )
            step = None if times is None or times.dtype.kind not in "iuf" else float(np.median(np.diff(times)))
            channels, period = find_moving_columns(moving, step if times is not None else None)
            found |= {channel: column for channel, column in channels.items() if not candidates.get(channel)}
            if times is not None:
                period = None
    for channel, column in found.items():
        for others in candidates.values():
            others[:] = [candidate for candidate in others if candidate.column != column]
        candidates[channel] = [_Candidate(False, column, *_split_unit(file, column), signals[column])]
        guesses.append(f"{channel} is taken to be column '{column}' by how its numbers change.")
    if period is not None:
        guesses.append(f"The period is taken to be {period:g} s: a speed then is the slope of the position.")
    return period


def _choose(candidates: list[_Candidate], words: set[str]) -> _Candidate:
    """Choose a column that moves: by its name, by words shared with those chosen, or what follows a reference like it."""
    moving = [candidate for candidate in candidates if candidate.values.dtype.kind not in "iuf" or np.ptp(candidate.values)]

    def rank(candidate: _Candidate) -> tuple[bool, int]:
        return candidate.is_second_choice, -len(words & {*candidate.name.split()})

    ranked = sorted(moving or candidates, key=rank)
    alike = {candidate.column: candidate for candidate in ranked if rank(candidate) == rank(ranked[0])}
    numbers = {column: candidate.values for column, candidate in alike.items() if candidate.values.dtype.kind in "iuf"}
    return alike[find_latest(numbers)] if len(numbers) > 1 else ranked[0]


def _guess_time_table(column: ColumnName, unit: str, values: np.ndarray, guesses: list[str]) -> _Table:
    if values.dtype.kind not in "iuf":
        return {"column": column}
    if unit not in SECONDS_PER_UNIT:
        median = float(np.median(np.diff(values.astype(float)))) if len(values) > 1 else 0.0
        # drives are sampled every 10 us to 0.1 s
        unit = next((name for name, seconds in SECONDS_PER_UNIT.items() if median * seconds <= 0.1), "s")
        if unit != "s":
            guesses.append(f"t is taken to be in {unit}, by its period of {median:g}.")
    return {"column": column, "unit": unit}


def _guess_torque_table(column: ColumnName, unit: str, guesses: list[str]) -> _Table:
    if unit not in _TORQUE_UNITS:
        guesses.append(_describe_unit_guess("u", unit, "N m"))
        return {"column": column}
    if unit in ("A", "V", "%", "mA", "counts"):
        guesses.append(f"u.factor: put in the torque of one {unit}; 1 N m for each A or V, or for 100 %, is a placeholder.")
    unit, factor = _TORQUE_UNITS[unit]
    return {"column": column, "unit": unit} | ({} if factor is None else {"factor": factor})


def _describe_unit_guess(quantity: str, unit: str, default: str) -> str:
    fault = f"'{unit}', which is unknown: put in factor; " if unit else "not given: "
    return f"The unit of {quantity} is {fault}{default} is assumed."


def _guess_position_table(column: ColumnName, unit: str, values: np.ndarray, guesses: list[str]) -> _Table:
    is_whole = bool(np.isfinite(values).all() and (values == np.round(values)).all())
    if unit == "counts" or (not unit and is_whole):
        guesses.append(f"'{column}' looks like counts: put in counts_per_turn; 4096 is a placeholder.")
        return {"column": column, "unit": "counts", "counts_per_turn": 4096.0}
    return _assume_unit(column, unit, _POSITION_UNITS, guesses)


def _assume_unit(column: ColumnName, unit: str, units: Sequence[str], guesses: list[str]) -> _Table:
    """Return the table of a column, with the first one of `units` if its unit is not one of them."""
    if unit not in units:
        guesses.append(_describe_unit_guess(f"'{column}'", unit, units[0]))
        unit = units[0]
    return {"column": column, "unit": unit}


def propose_study(
    path: str | Path,
    log: _Table | None = None,
    *,
    gear_ratio: float | None = None,
    nominal: NominalDrive | None = None,
) -> tuple[_Table, list[str], Inspection]:
    """Propose a study of a log for `identify` and `diagnose`.

    Args:
        path: the log.
        log: its `[log]` table; guessed if left out.
        gear_ratio: of the drive, if it is known; that of the log if left out.
        nominal: the drive, if it is known; found by a rough fit if left out.

    Returns:
        The study, a sentence on each guess, and the inspection of the log.

    Raises:
        InputError: the log cannot be read, its columns cannot be guessed, or it is the log of a test rig.
    """
    if log is not None and log.get("kind") == "element":
        raise InputError("--write proposes a drive; a transmission on a test rig has none, and needs only its [log]")
    table, guesses = guess_log_table(path) if log is None else (log, [])
    # a soft shaft changes the ratio of both motions: it is compared with gear_ratio once the stiffness is known
    while (inspection := _inspect_or_mend(path, table, None if log else guesses)) is None:
        pass
    if nominal is None or (gear_ratio is not None and not math.isfinite(nominal.stiffness)):
        rough = _fit_nominal_drive(inspection, guesses, gear_ratio)
        numbers = {name: value for name, value in vars(rough).items() if name not in ("gear_ratio", "dead_time")}
        nominal = replace(rough, **{name: _round_to_3_digits(value) for name, value in numbers.items()})
    else:
        guesses.append("The numbers of the drive are those of the model.")
    ratio = (gear_ratio or nominal.gear_ratio) if math.isfinite(nominal.stiffness) else None
    inspection = inspect(path, table, gear_ratio=ratio, nominal=nominal)
    corrections = inspection.record.corrections
    for channel, key in (("theta_s", "skew"), ("theta_s", "drift"), ("theta_e", "offset"), ("u", "u.skew")):
        if key in corrections:
            name = "u" if channel == "u" else inspection.log.position_source(channel)[0]
            channel_table = table.get(name, name)
            if not isinstance(channel_table, dict):
                channel_table = {"column": channel_table}
            table[name] = channel_table | {key.removeprefix("u."): corrections[key]}
    if corrections.get("u.sampled"):
        table["hold"] = "sampled"
    return _make_study(inspection, nominal, table), guesses, inspection


def _inspect_or_mend(path: str | Path, table: _Table, guesses: list[str] | None) -> Inspection | None:
    """Inspect a log; None if it is refused with a remedy, which the table then has, and `guesses` say."""
    try:
        inspection = inspect(path, table)
        gearing, channel = inspection.record.statistics.gearing, inspection.log.position_source("theta_s")[0]
        if guesses is None or gearing is None or gearing.ratio > 0.0 or "sign" in table.get(channel, {"sign"}):
            return inspection
        reason, key, value = f"{channel} counts against theta_e", "sign", "-1"
    except InputError as error:
        remedy = re.search(r": (.+)[;:] set (\w+) = (-?[\d.e+]+) in \[log\] (\w+)(?! or)", str(error))
        if guesses is None or remedy is None or remedy[2] in table.get(remedy[4], {remedy[2]}):
            raise
        reason, key, value, channel = remedy.groups()
    table[channel][key] = int(value) if value.lstrip("-").isdecimal() else float(value)
    guesses.append(f"{channel}.{key} = {value}: {reason}.")
    return None


def _fit_nominal_drive(inspection: Inspection, guesses: list[str], known_ratio: float | None) -> NominalDrive:
    """Return inertia and friction by the rough fit; with two sides each has half of both, referred to the motor."""
    record = inspection.record
    dynamics, gearing = record.statistics.dynamics, record.statistics.gearing
    inertia, viscous = 1.0, 0.0
    if dynamics is None:
        guesses.append("The log does not show an inertia: 1 is a placeholder.")
    else:
        inertia, viscous = (float(value) for value in dynamics.values[:2])
        if inertia < 2.0 * float(dynamics.errors[0]) or inertia <= 0.0:
            # then the inertia takes a small part of the torque
            inertia = 0.1 * dynamics.torque / dynamics.acceleration
            guesses.append(f"The log hardly shows the inertia: {inertia:.2g} would take a tenth of the torque.")
        viscous = viscous if viscous > 0.0 else 0.01 * dynamics.torque / max(dynamics.square**0.5, 1e-300)
    if gearing is None or inspection.gear_ratio is None or record.torque is None:
        return NominalDrive(inertia, viscous)
    motor, load = record.positions["motor"], record.positions["load"]
    bandwidth = record.statistics.channels["theta_e"].bandwidth
    parts = [
        _load_motion(motor[segment], load[segment], bandwidth, record.sample_period)
        for segment in long_segments(record.segments)
    ]
    motor, rows = (np.concatenate(pieces) for pieces in zip(*parts, strict=True))
    values, errors = fit_with_jackknife(motor, rows)
    if not np.isfinite(values).all() or values[0] <= 0.0:
        channels = " or ".join(inspection.log.position_source(name)[0] for name in POSITION_CHANNELS.values())
        raise InputError(
            f"{record.path}: theta_e moves {gearing.ratio:.4g} for each 1 of theta_s; this should be more than 0: "
            f"set sign = -1 in [log] {channels}, or leave one of them out, and give the file as --model"
        )
    ratio, whole_ratio = float(values[0]), float(round(values[0]))
    if known_ratio is not None:
        ratio = known_ratio
    # most ratios of one stage are whole
    elif whole_ratio and abs(ratio - whole_ratio) < _tolerate_whole(ratio, float(errors[0])):
        guesses.append(f"gear_ratio is {ratio:.4g} by the log, and taken to be {whole_ratio:g}.")
        ratio = whole_ratio
    half_inertia = 0.5 * inertia
    drive = NominalDrive(half_inertia, 0.5 * viscous, half_inertia * ratio**2, 0.5 * viscous * ratio**2, ratio)
    guesses.append("Inertia and friction are divided evenly between the sides, and the stiffness is a rough guess.")
    # the load's inertia winds the shaft up by J_s / (N K) times its acceleration; where it is small, half of the torque does
    windup = max(float(values[2]), 2.0 * float(errors[2]), 1e-300)
    windup_twist = np.std(motor - ratio * rows[:, 0]) - 0.5 * gearing.lost_motion
    min_stiffness = 0.5 * float(np.std(record.torque)) / max(float(windup_twist), 0.1 * gearing.lost_motion, 1e-300)
    # False for nan, too
    if not min_stiffness < 1e12:
        min_stiffness = 0.0
    stiffness = max(drive.load_inertia / ratio / windup, min_stiffness)
    return replace(drive, stiffness=stiffness, half_gap=0.5 * max(gearing.lost_motion, 0.0))


def _tolerate_whole(ratio: float, error: float) -> float:
    """Return the distance at which a ratio counts as whole; of a large one that is not known well, any could be."""
    if ratio < _LARGEST_WHOLE:
        return max(0.005 * ratio, 5.0 * error)
    return 3.0 * error * (error < _SURE_RATIO)


def _load_motion(motor: np.ndarray, load: np.ndarray, bandwidth: float, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Return motor position, and columns of load position, velocity, acceleration, direction and 1; low-passed."""
    cutoff = 4.0 * bandwidth or math.inf
    position, velocity, acceleration = low_pass_motion(load, cutoff, period)
    rows = np.column_stack([position, velocity, acceleration, smooth_sign(velocity), np.ones(len(motor))])
    inner = trim_filter_ends(len(motor), cutoff, period) if bandwidth else slice(None)
    return low_pass(motor, cutoff, period)[inner], rows[inner]


def _make_study(inspection: Inspection, nominal: NominalDrive, table: _Table) -> _Table:
    record = inspection.record
    has_shaft = math.isfinite(nominal.stiffness)
    names = ("motor_inertia", "motor_viscous", *(("load_inertia", "load_viscous", "gear_ratio") if has_shaft else ()))
    study: _Table = {
        "title": record.path.stem,
        "drive": {"kind": "two_inertia" if has_shaft else "rigid"} | {name: getattr(nominal, name) for name in names},
    }
    if has_shaft:
        law = {"law": "dead_zone", "stiffness": nominal.stiffness, "half_gap": nominal.half_gap}
        study["transmission"] = law if nominal.half_gap else {"law": "linear_shaft", "stiffness": law["stiffness"]}
    noise = record.statistics.channels["theta_e" if "motor" in record.positions else "theta_s"].noise
    return study | {
        "encoders": {"noise": _round_to_3_digits(noise)},
        "run": {"sample_period": record.sample_period, "substeps": count_plant_steps(nominal, record.sample_period)},
        "uncertainty": {"relative": _ROUGH_UNCERTAINTY, "exact": ["drive.gear_ratio"] if has_shaft else []},
        "log": table,
    }


def count_plant_steps(drive: NominalDrive, period: float) -> int:
    """Count the plant steps in a sample of `period` s: ten in a period of the oscillation of both inertias."""
    squared_frequency = 0.0
    if math.isfinite(drive.stiffness):
        squared_frequency = drive.stiffness * (1.0 / drive.motor_inertia + drive.gear_ratio**2 / drive.load_inertia)
    return max(math.ceil(10.0 * math.sqrt(squared_frequency) * period / (2.0 * math.pi)), 1)


def _round_to_3_digits(value: float) -> float:
    """Round to three digits: a rough fit has no more."""
    return float(f"{value:.3g}")
