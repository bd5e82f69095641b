"""Propose a first study for a log: columns guessed by name and unit, and a nominal drive from a rough fit."""

import math
import re
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxbl.errors import InputError

from .alignment import NominalDrive
from .channels import POSITION_FACTORS, SPEED_FACTORS
from .files import LogFile, read_log_file
from .inspection import Inspection, compute_twist, fit_twist, inspect
from .libraries import ColumnName
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
_CHANNEL_UNITS: dict[str, dict[str, _Table]] = {
    "theta": {unit: {"unit": unit} for unit in POSITION_FACTORS} | {"counts": {"unit": "counts", "counts_per_turn": 4096.0}},
    "omega": {unit: {"unit": unit} for unit in SPEED_FACTORS},
    "u": {"N m": {"unit": "N m"}, "mN m": {"unit": "N m", "factor": 1e-3}, "N": {"unit": "N"},
          "%": {"unit": "N m", "factor": 0.01}, "mA": {"unit": "A", "factor": 1e-3}}
    | {unit: {"unit": unit, "factor": 1.0} for unit in ("A", "V", "counts")},
}  # fmt: skip
"""Kind of a channel -> unit of its column -> keys of `[log]`; the first unit is assumed where there is none."""


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


def _find_kinds(name: str) -> set[str]:
    """Return the kinds of columns for which a name, or a word of it, is usual."""
    words = name.replace(" ", "_"), *name.split()
    return {kind for kind, pattern in _NAME_PATTERNS.items() if any(re.fullmatch(pattern, word) for word in words)}


def _guess_channel(name: str, unit: str, kinds: set[str]) -> str:
    """Guess the channel of a column from its name, unit and kinds; "" for none."""
    side = "s" if "load" in kinds else "e"
    if "t" in kinds or (not name and unit in SECONDS_PER_UNIT):
        return "t"
    # an unknown unit fits any quantity
    fitting = [kind for kind, units in _CHANNEL_UNITS.items() if unit in units or unit not in _SPELLINGS]
    if "u" in fitting and ("u" in kinds or unit in ("N m", "mN m") or (not name and unit in ("mA", "A"))):
        return "u"
    if "omega" in kinds or unit in SPEED_FACTORS:
        return f"omega_{side}" if "omega" in fitting or unit == "counts" else ""
    # motor or load as the only word does not tell the quantity: a temperature is one of the motor, too
    is_bare_side = name in ("motor", "load", "output", "arm", "joint", "link", "secondary") and not unit
    has_position_unit = unit in POSITION_FACTORS and (not name or kinds & {"motor", "load"})
    is_position = "position" in kinds and "theta" in fitting
    return f"theta_{side}" if is_position or is_bare_side or has_position_unit else ""


def guess_log_table(path: str | Path) -> tuple[_Table, list[str]]:
    """Guess a `[log]` table from names, units and values of columns; it comes with a sentence on each uncertain guess.

    Raises:
        InputError: no column looks like a position or a speed, or like a time.
    """
    file = read_log_file(Path(path))
    candidates: dict[str, list[_Candidate]] = {}
    for column in file.columns:
        name, unit = _split_unit(file, column)
        kinds = _find_kinds(name)
        channel = _guess_channel(name, unit, kinds)
        if not channel:
            continue
        # a commanded torque stands for one that was not measured, a side alone for a position
        is_second_choice = bool(kinds & {"setpoint", "load", "supply"}) if channel == "u" else "position" not in kinds
        values = file.load_values(column)
        if channel == "t" or (values.dtype.kind in "iuf" and (channel == "u" or "setpoint" not in kinds)):
            candidates.setdefault(channel, []).append(_Candidate(is_second_choice, column, name, unit, values))
    guesses: list[str] = []
    table: _Table = {}
    if "t" not in candidates or candidates.keys().isdisjoint(_POSITIONS):
        table |= _add_candidates_by_values(file, candidates, guesses)
    chosen: dict[str, _Candidate] = {}
    # the torque is chosen to the position
    for channel in filter(candidates.get, ("t", *_POSITIONS, "u")):
        words = {word for candidate in chosen.values() for word in candidate.name.split()}
        chosen[channel] = _choose(candidates[channel], words)
    if "theta_e" in chosen and not chosen["theta_e"].is_second_choice and chosen.get("theta_s", ("",) * 3)[2] == "load":
        # beside a named position it is how much a servo is loaded
        chosen["u"] = chosen.pop("theta_s")
    for channel, candidate in chosen.items():
        if channel == "u" and "setpoint" in _find_kinds(candidate.name):
            guesses.append(f"u is '{candidate.column}', the commanded torque: no column looks like a measured one.")
        # a measured position is better than the integral of a speed
        if channel.replace("omega", "theta") not in {*chosen} - {channel}:
            table[channel] = _make_table(channel, candidate, guesses)
    if table.keys().isdisjoint(_POSITIONS):
        columns = ", ".join(map(str, file.columns))
        raise InputError(f"{path}: no column is called like a position or a speed: {columns}; [log] theta_e can name one")
    if "u" not in table:
        table["absent"] = ["u"]
        guesses.append("No column looks like a torque: put in [log] u, or it is taken as not recorded.")
    if "t" not in table:
        raise InputError(f"{path}: no column is called like a time; [log] t can name it, or give a period")
    return table, guesses


_POSITIONS = "theta_e", "theta_s", "omega_e", "omega_s"
"""Channels of which a log has one at least."""


def _add_candidates_by_values(file: LogFile, candidates: dict[str, list[_Candidate]], guesses: list[str]) -> _Table:
    """Add the time, and where no name is that of a position or speed also these and a torque, by how the columns change.

    Returns:
        `t` with a period for a file without a time, if a speed shows it; else nothing.
    """
    signals = {column: file.load_values(column) for column in file.columns}
    times = next((candidate.values for candidate in candidates.get("t", ())), None)
    by_values: dict[str, ColumnName] = {}
    if times is None and (stamps := find_stamps(signals)) is not None:
        by_values["t"], times = stamps, signals[stamps]
    table: _Table = {}
    if candidates.keys().isdisjoint(_POSITIONS):
        named = {candidate.column for columns in candidates.values() for candidate in columns}
        moving = {
            column: values.astype(float)
            for column, values in signals.items()
            if column not in named and "setpoint" not in _find_kinds(_split_unit(file, column)[0])
            if values.dtype.kind in "iuf" and not rises_evenly(values) and np.isfinite(values).all() and np.ptp(values)
        }
        channels, period = find_moving_columns(moving, times)
        by_values |= {channel: column for channel, column in channels.items() if channel not in candidates}
        if times is None and period is not None:
            table["t"] = {"period": period}
            guesses.append(f"The period is taken to be {period:g} s: a speed then is the slope of the position.")
    for channel, column in by_values.items():
        for columns in candidates.values():
            columns[:] = [candidate for candidate in columns if candidate.column != column]
        candidates[channel] = [_Candidate(False, column, *_split_unit(file, column), signals[column])]
        guesses.append(f"{channel} is taken to be column '{column}' by how its numbers change.")
    return table


def _choose(candidates: list[_Candidate], words: set[str]) -> _Candidate:
    """Choose a column that moves: by its name, by words shared with those chosen, or what follows a reference like it."""
    moving = [candidate for candidate in candidates if candidate.values.dtype.kind not in "iuf" or np.ptp(candidate.values)]

    def rank(candidate: _Candidate) -> tuple[bool, int]:
        return candidate.is_second_choice, -len(words & {*candidate.name.split()})

    ranked = sorted(moving or candidates, key=rank)
    alike = {candidate.column: candidate for candidate in ranked if rank(candidate) == rank(ranked[0])}
    numbers = {column: candidate.values for column, candidate in alike.items() if candidate.values.dtype.kind in "iuf"}
    return alike[find_latest(numbers)] if len(numbers) > 1 else ranked[0]


def _make_table(channel: str, candidate: _Candidate, guesses: list[str]) -> _Table:
    """Make the table of a channel; `guesses` say what its unit is taken to be, and what is to be put in."""
    _, column, _, unit, values = candidate
    keys: _Table = {"column": column}
    if channel == "t":
        return keys | ({"unit": _guess_time_unit(unit, values, guesses)} if values.dtype.kind in "iuf" else {})
    units = _CHANNEL_UNITS[channel.partition("_")[0]]
    if channel.startswith("theta") and not unit and np.isfinite(values).all() and (values == np.round(values)).all():
        unit = "counts"
    quantity = "u" if channel == "u" else f"'{column}'"
    if unit not in units:
        assumed = next(iter(units))
        fault = f"'{unit}', which is unknown: put in factor; " if unit else "not given: "
        guesses.append(f"The unit of {quantity} is {fault}{assumed} is assumed.")
        return keys if channel == "u" else keys | units[assumed]
    keys |= units[unit]
    if channel == "u" and "factor" in keys and unit != "mN m":
        guesses.append(f"u.factor: put in the torque of one {unit} of the column; {keys['factor']:g} N m is a placeholder.")
    elif unit == "counts":
        guesses.append(f"{quantity} looks like counts: put in counts_per_turn; 4096 is a placeholder.")
    return keys


def _guess_time_unit(unit: str, values: np.ndarray, guesses: list[str]) -> str:
    if unit in SECONDS_PER_UNIT:
        return unit
    median = np.median(np.diff(values.astype(float))) if len(values) > 1 else 0.0
    # drives are sampled every 10 us to 0.1 s
    unit = next((name for name, seconds in SECONDS_PER_UNIT.items() if median * seconds <= 0.1), "s")
    if unit != "s":
        guesses.append(f"t is taken to be in {unit}, by its period of {median:g}.")
    return unit


def propose_study(
    path: str | Path, log: _Table | None = None, *, gear_ratio: float | None = None, nominal: NominalDrive | None = None
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
        exact = "gear_ratio", "dead_time"
        rounded = {name: _round_to_3_digits(value) for name, value in vars(rough).items() if name not in exact}
        nominal = replace(rough, **rounded)
    else:
        guesses.append("The numbers of the drive are those of the model.")
    ratio = (gear_ratio or nominal.gear_ratio) if math.isfinite(nominal.stiffness) else None
    inspection = inspect(path, table, gear_ratio=ratio, nominal=nominal)
    if corrections := inspection.record.corrections:
        table = inspection.log.with_corrections(corrections).model_dump(exclude_unset=True, exclude_none=True)
    return _make_study(inspection, nominal, table), guesses, inspection


def _inspect_or_mend(path: str | Path, table: _Table, guesses: list[str] | None) -> Inspection | None:
    """Inspect a log; None if it is refused with a remedy, which the table then has, and `guesses` say."""
    try:
        inspection = inspect(path, table)
        gearing, channel = inspection.record.statistics.gearing, inspection.log.position_source("theta_s")[0]
        if guesses is None or gearing is None or gearing.ratio > 0.0 or "sign" in table.get(channel, {"sign"}):
            return inspection
        reason, key, value, assumed = f"{channel} counts against theta_e", "sign", "-1", ""
    except InputError as error:
        remedy = re.search(r': (.+)[;:] set (\w+) = ("\w+"|-?[\d.e+]+) in \[log\] (\w+)(?! or)', str(error))
        if guesses is None or remedy is None:
            raise
        reason, key, value, channel = remedy.groups()
        # a unit that is assumed may be another one
        start = f"The unit of '{table.get(channel, {}).get('column')}' is not given: "
        assumed = next((guess for guess in guesses if key == "unit" and guess.startswith(start)), "")
        if key in table.get(channel, {key}) and not assumed:
            raise
    table[channel][key] = tomllib.loads(f"value = {value}")["value"]
    if assumed:
        guesses.remove(assumed)
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
        inertia, viscous = dynamics.values[:2].tolist()
        if inertia < 2.0 * dynamics.errors[0] or inertia <= 0.0:
            # then the inertia takes a small part of the torque
            inertia = 0.1 * dynamics.torque / dynamics.acceleration
            guesses.append(f"The log hardly shows the inertia: {inertia:.2g} would take a tenth of the torque.")
        viscous = viscous if viscous > 0.0 else 0.01 * dynamics.torque / max(dynamics.square**0.5, 1e-300)
    if gearing is None or inspection.gear_ratio is None or record.torque is None:
        return NominalDrive(inertia, viscous)
    ratio, error = gearing.ratio, gearing.ratio_error
    whole_ratio = float(round(ratio))
    if ratio <= 0.0:
        channels = " or ".join(inspection.log.position_source(name)[0] for name in POSITION_CHANNELS.values())
        raise InputError(
            f"{record.path}: theta_e moves {ratio:.4g} for each 1 of theta_s; this should be more than 0: "
            f"set sign = -1 in [log] {channels}, or leave one of them out, and give the file as --model"
        )
    # most ratios of one stage are whole; of a large one that is not known well, any could be
    reach = max(0.005 * ratio, 5.0 * error) if ratio < _LARGEST_WHOLE else 3.0 * error * (error < _SURE_RATIO)
    if known_ratio is not None:
        ratio = known_ratio
    elif whole_ratio and abs(ratio - whole_ratio) < reach:
        guesses.append(f"gear_ratio is {ratio:.4g} by the log, and taken to be {whole_ratio:g}.")
        ratio = whole_ratio
    half_inertia = 0.5 * inertia
    drive = NominalDrive(half_inertia, 0.5 * viscous, half_inertia * ratio**2, 0.5 * viscous * ratio**2, ratio)
    guesses.append("Inertia and friction are divided evenly between the sides, and the stiffness is a rough guess.")
    # half of the torque winds the shaft up
    slope, slope_error, _ = fit_twist(record, ratio)
    twist = np.std(compute_twist(record, ratio)) - 0.5 * gearing.lost_motion
    least = 0.5 * np.std(record.torque) / max(twist, 0.1 * gearing.lost_motion, 1e-300)
    # False for nan, too
    stiffness = max(0.5 / max(slope, 2.0 * slope_error, 1e-300), least if least < 1e12 else 0.0)
    return replace(drive, stiffness=stiffness, half_gap=0.5 * max(gearing.lost_motion, 0.0))


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
