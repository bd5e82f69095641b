"""A first study for a log: columns guessed by name and unit, and a nominal drive from a rough fit."""

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from jaxbl.errors import InputError

from .alignment import NominalDrive
from .files import LogFile, read_log_file
from .inspection import Inspection, inspect
from .least_squares import fit_with_jackknife
from .rigid_body import smooth_sign
from .signal_quality import MIN_SAMPLES, low_pass, trim_filter_ends

_ROUGH_UNCERTAINTY = 0.5
"""Relative uncertainty of numbers from a rough fit: inertias and stiffness may be split wrongly between the sides."""
_NAMES = {
    "t": r"t|time|timestamp|times|zeit|clock",
    "u": r"u|torque|tau|moment|drehmoment|force|kraft|current|strom|iq|i_q|voltage|volt|vir|vm",
    "load": r"(theta_s|load|output|arm|joint|link|secondary|enc(oder)?_?2)",
    "motor": r"motor",
    "omega": r"(omega|speed|velocity|velo|drehzahl|geschwindigkeit|rpm|vel)",
    "position": r"(theta|theta_[es]|position|pos|angle|winkel|lage|enc|encoder|q|qm|enc(oder)?_?[12])",
    "wanted": r"(goal|target|set|ref|command|cmd|desired|soll|demand)",
}
"""What columns are usually called."""
_UNITS = {
    "rad": "rad", "deg": "deg", "°": "deg", "degrees": "deg", "turn": "turn", "rev": "turn", "m": "m", "mm": "mm",
    "counts": "counts", "inc": "counts", "s": "s", "sec": "s", "ms": "ms", "us": "us", "µs": "us", "ns": "ns", "nm": "N m",
    "n m": "N m", "n·m": "N m", "n": "N", "a": "A", "v": "V", "rpm": "rpm", "1/min": "rpm", "rad/s": "rad/s",
    "deg/s": "deg/s", "°/s": "deg/s", "rev/s": "turn/s", "m/s": "m/s", "mm/s": "mm/s", "mnm": "mN m", "mn m": "mN m",
    "%": "%", "ma": "mA",
}  # fmt: skip
"""How units are written -> what `[log]` calls them."""
_SPEEDS = ("rpm", "rad/s", "deg/s", "turn/s", "m/s", "mm/s")
_POSITIONS = ("rad", "deg", "turn", "counts", "m", "mm")
_TORQUES = ("N m", "N", "A", "V", "counts", "mN m", "%", "mA")


def _split_unit(file: LogFile, column: str | int) -> tuple[str, str]:
    """Name of a column without its unit, in lower case, and the unit that it says, as `[log]` calls it; "" for none."""
    name, unit = str(column).strip().lower(), str(file.units.get(column, "")).lower()
    if found := re.search(r"[\[(]\s*(.+?)\s*[\])]\s*$", name):
        name, unit = name[: found.start()].strip(" _"), unit or found[1]
    elif "_" in name and name.rsplit("_", 1)[1] in _UNITS and name.rsplit("_", 1)[1] not in ("s", "m", "v", "a", "n"):
        name, end = name.rsplit("_", 1)
        unit = unit or end
    return name, _UNITS.get(unit, unit)


def _matches(kind: str, name: str) -> bool:
    """Whether a name, or a word of it, is one of a kind."""
    return any(re.fullmatch(_NAMES[kind], one) for one in (_join_words(name), *re.split(r"[^a-z0-9äöü]+", name)))


def _join_words(name: str) -> str:
    return name.replace(" ", "_")


def _guess_channel(name: str, unit: str) -> str:
    """The channel that a column is by its name and unit; "" for none."""
    if _matches("t", name):
        return "t"
    side = "s" if _matches("load", name) else "e"
    # a unit that is not known may be any
    may = {kind: unit in units or unit not in _UNITS.values() for kind, units in
           (("u", _TORQUES), ("omega", (*_SPEEDS, "counts")), ("position", _POSITIONS))}  # fmt: skip
    speed, place = unit in _SPEEDS or _matches("omega", name), _matches("position", name)
    # current_position is no current
    if may["u"] and (re.fullmatch(_NAMES["u"], _join_words(name)) or (_matches("u", name) and not (speed or place))):
        return "u"
    if speed:
        return f"omega_{side}" if may["omega"] else ""
    # motor and load alone say what moves, and not which quantity it is: a temperature is one of the motor, too
    alone = any(re.fullmatch(_NAMES[one], _join_words(name)) and not unit for one in ("motor", "load"))
    said = unit in _POSITIONS and (_matches("motor", name) or _matches("load", name))
    return f"theta_{side}" if (place and may["position"]) or alone or said else ""


def guess_log_table(path: str | Path) -> tuple[dict[str, Any], list[str]]:
    """A `[log]` table by names and units of columns, and what had to be guessed, in sentences.

    Raises:
        InputError: no column looks like a position or a speed.
    """
    file = read_log_file(Path(path))
    if all(isinstance(column, int) for column in file.columns):
        raise InputError(
            f"{path}: --write goes by the names of columns, and the file has none; a file with [log] for --model can give "
            "their numbers"
        )
    found: dict[str, list[tuple[bool, str | int, str, np.ndarray]]] = {}
    for column in file.columns:
        name, unit = _split_unit(file, column)
        channel, wanted = _guess_channel(name, unit), _matches("wanted", name)
        if not channel:
            continue
        numbers = file.load_values(column)
        # a torque that was asked for stands for one that was not measured, a side alone for a position
        if numbers.dtype.kind in "iuf" and (channel == "u" or not wanted):
            last = wanted or _matches("load", name) if channel == "u" else not _matches("position", name)
            found.setdefault(channel, []).append((last, column, unit, numbers))
    table: dict[str, Any] = {}
    guesses: list[str] = []
    for channel, columns in found.items():
        _, column, unit, numbers = min(columns, key=lambda one: one[0])
        if channel == "t":
            table["t"] = _guess_time_table(column, unit, numbers, guesses)
        elif channel == "u":
            if _matches("wanted", _split_unit(file, column)[0]):
                guesses.append(f"u is '{column}', the torque asked for: no column looks like a measured one.")
            table["u"] = _guess_torque_table(column, unit, guesses)
        elif channel.startswith("theta"):
            table[channel] = _guess_position_table(column, unit, numbers, guesses)
        # a measured position is better than the integral of a speed
        elif channel and channel.replace("omega", "theta") not in found:
            table[channel] = _guess_speed_table(column, unit, guesses)
    if not {"theta_e", "theta_s", "omega_e", "omega_s"} & set(table):
        columns = ", ".join(map(str, file.columns))
        raise InputError(f"{path}: no column is called like a position or a speed: {columns}; [log] theta_e can name one")
    if "u" not in table:
        table["absent"] = ["u"]
        guesses.append("No column looks like a torque: u is taken as not recorded.")
    if "t" not in table:
        raise InputError(f"{path}: no column is called like a time; [log] t can name it, or give a period")
    return table, guesses


def _guess_time_table(column: str | int, unit: str, values: np.ndarray, guesses: list[str]) -> dict[str, Any]:
    if unit not in ("s", "ms", "us", "ns"):
        median = float(np.median(np.diff(values.astype(float)))) if len(values) > 1 else 0.0
        # drives are sampled every 10 us to 0.1 s
        unit = next((u for u, one in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)) if median * one <= 0.1), "s")
        if unit != "s":
            guesses.append(f"t is taken to be in {unit}, by its period of {median:g}.")
    return {"column": column, "unit": unit}


def _guess_torque_table(column: str | int, unit: str, guesses: list[str]) -> dict[str, Any]:
    plain = {"mN m": ("N m", 1e-3), "%": ("N m", 0.01), "mA": ("A", 1e-3)}
    if unit in ("A", "V", "%", "mA", "counts"):
        guesses.append(f"u.factor: put in the torque of one {unit}; 1 is a placeholder for each A or V, and for 100 %.")
    if unit in plain:
        unit, factor = plain[unit]
        return {"column": column, "unit": unit, "factor": factor}
    if unit in ("A", "V", "counts"):
        return {"column": column, "unit": unit, "factor": 1.0}
    if unit in ("N m", "N"):
        return {"column": column, "unit": unit}
    guesses.append(_unit_guess("u", unit, "N m"))
    return {"column": column}


def _unit_guess(what: str, unit: str, default: str) -> str:
    return f"The unit of {what} is " + (f"'{unit}': put in factor; " if unit else "not said: ") + f"{default} is assumed."


def _guess_position_table(column: str | int, unit: str, values: np.ndarray, guesses: list[str]) -> dict[str, Any]:
    whole = bool(np.isfinite(values).all() and (values == np.round(values)).all())
    if unit == "counts" or (not unit and whole):
        guesses.append(f"'{column}' looks like counts: put in counts_per_turn; 4096 is a placeholder.")
        return {"column": column, "unit": "counts", "counts_per_turn": 4096.0}
    if unit not in _POSITIONS:
        guesses.append(_unit_guess(f"'{column}'", unit, "rad"))
    return {"column": column, "unit": unit if unit in _POSITIONS else "rad"}


def _guess_speed_table(column: str | int, unit: str, guesses: list[str]) -> dict[str, Any]:
    if unit not in _SPEEDS:
        guesses.append(_unit_guess(f"'{column}'", unit, "rad/s"))
    return {"column": column, "unit": unit if unit in _SPEEDS else "rad/s"}


def propose_study(
    path: str | Path,
    log: dict[str, Any] | None = None,
    *,
    gear_ratio: float | None = None,
    nominal: NominalDrive | None = None,
) -> tuple[dict[str, Any], list[str], Inspection]:
    """A study of a log for `identify` and `diagnose`, what was guessed, and the log as it reads.

    Args:
        path: the log.
        log: its `[log]` table; left out: guessed.
        gear_ratio: of the drive, if it is known; left out: that of the log.
        nominal: the drive, if it is known; left out: by a rough fit.

    Raises:
        InputError: as of :func:`jaxbl.records.read_record`, or no columns can be guessed, or it is the log of a test rig.
    """
    if log is not None and log.get("kind") == "element":
        raise InputError("--write proposes a drive; a transmission on a test rig has none, and needs no more than its [log]")
    table, guesses = guess_log_table(path) if log is None else (log, [])
    try:
        found = inspect(path, table, gear_ratio=gear_ratio)
    except InputError as error:
        if log is not None or "set sign = -1 in [log] u" not in str(error):
            raise
        table["u"]["sign"] = -1
        guesses.append("u is reversed: with the sign of the file the drive would accelerate against it.")
        found = inspect(path, table, gear_ratio=gear_ratio)
    if nominal is None or (gear_ratio is not None and not math.isfinite(nominal.stiffness)):
        rough = vars(_fit_nominal_drive(found, guesses, gear_ratio))
        nominal = NominalDrive(
            **{name: one if name == "gear_ratio" else _round_to_3_digits(one) for name, one in rough.items()}
        )
    else:
        guesses.append("The numbers of the drive are those of the model that was given.")
    if math.isfinite(nominal.stiffness):
        found = inspect(path, table, gear_ratio=nominal.gear_ratio, nominal=nominal)
        for channel, key in (("theta_s", "skew"), ("theta_s", "drift"), ("theta_e", "offset")):
            if key in found.record.corrections:
                name, _ = found.log.position_source(channel)
                table[name] = _as_table(table.get(name, name)) | {key: found.record.corrections[key]}
    return _make_study(found, nominal, table), guesses, found


def _as_table(given: Any) -> dict[str, Any]:
    return given if isinstance(given, dict) else {"column": given}


def _fit_nominal_drive(found: Inspection, guesses: list[str], known: float | None) -> NominalDrive:
    """Inertia and friction by the rough fit; of two sides half of it each, at the motor."""
    dynamics, gearing = found.record.statistics.dynamics, found.record.statistics.gearing
    inertia, viscous = 1.0, 0.0
    if dynamics is None:
        guesses.append("The log does not show an inertia: 1 is a placeholder.")
    else:
        inertia, viscous = (float(value) for value in dynamics.values[:2])
        if inertia < 2.0 * float(dynamics.errors[0]) or inertia <= 0.0:
            # inertia is then a small part of the torque
            inertia = 0.1 * dynamics.torque / dynamics.acceleration
            guesses.append(f"The log hardly shows the inertia: {inertia:.2g} would take a tenth of the torque.")
        viscous = viscous if viscous > 0.0 else 0.01 * dynamics.torque / max(dynamics.square**0.5, 1e-300)
    period = found.record.sample_period
    if gearing is None or found.gear_ratio is None or found.record.torque is None:
        return NominalDrive(inertia, viscous)
    both = found.record.positions
    parts = [
        _load_motion(both["motor"][s], both["load"][s], found.record.statistics.channels["theta_e"].bandwidth, period)
        for s in found.record.segments
        if s.stop - s.start >= MIN_SAMPLES
    ]
    motor, rows = (np.concatenate(column) for column in zip(*parts, strict=True))
    values, errors = fit_with_jackknife(motor, rows)
    if not np.isfinite(values).all() or values[0] <= 0.0:
        raise InputError(
            f"{found.record.path}: theta_e moves {gearing.ratio:.4g} for each 1 of theta_s; it should be more than 0: set "
            f"sign = -1 in [log] {found.log.position_source('theta_e')[0]} or "
            f"{found.log.position_source('theta_s')[0]}, or leave one of "
            "them out, and give the file as --model"
        )
    ratio, whole = float(values[0]), float(round(values[0]))
    if known is not None:
        ratio = known
    # most ratios of one stage are whole
    elif whole and abs(ratio - whole) < max(0.005 * ratio, 5.0 * float(errors[0])):
        guesses.append(f"gear_ratio is {ratio:.4g} by the log, and taken to be {whole:g}.")
        ratio = whole
    half = 0.5 * inertia
    drive = NominalDrive(half, 0.5 * viscous, half * ratio**2, 0.5 * viscous * ratio**2, ratio)
    guesses.append("Inertia and friction are divided evenly between the sides, and the stiffness is a rough guess.")
    # the load's inertia winds the shaft up by J_s / (N K) times its acceleration; where it is small, half of the torque does
    wound = max(float(values[2]), 2.0 * float(errors[2]), 1e-300)
    beside = np.std(motor - ratio * rows[:, 0]) - 0.5 * gearing.lost_motion
    least = 0.5 * float(np.std(found.record.torque)) / max(float(beside), 0.1 * gearing.lost_motion, 1e-300)
    stiffness = max(drive.load_inertia / ratio / wound, least if math.isfinite(least) and least < 1e12 else 0.0)
    return replace(drive, stiffness=stiffness, half_gap=0.5 * max(gearing.lost_motion, 0.0))


def _load_motion(motor: np.ndarray, load: np.ndarray, width: float, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Motor position, and load position, velocity, acceleration, direction, 1; low-passed."""
    cutoff = 4.0 * width
    smooth = low_pass(np.column_stack([motor, load]), cutoff, period) if width else np.column_stack([motor, load])
    velocity = np.gradient(smooth[:, 1], period)
    acceleration = np.gradient(velocity, period)
    rows = np.column_stack([smooth[:, 1], velocity, acceleration, smooth_sign(velocity), np.ones(len(motor))])
    cut = trim_filter_ends(len(motor), cutoff, period) if width else slice(None)
    return smooth[cut, 0], rows[cut]


def _make_study(found: Inspection, nominal: NominalDrive, table: dict[str, Any]) -> dict[str, Any]:
    record = found.record
    two = math.isfinite(nominal.stiffness)
    names = ("motor_inertia", "motor_viscous", *(("load_inertia", "load_viscous", "gear_ratio") if two else ()))
    study: dict[str, Any] = {
        "title": record.path.stem,
        "drive": {"kind": "two_inertia" if two else "rigid"} | {name: getattr(nominal, name) for name in names},
    }
    if two:
        law = {"law": "dead_zone", "stiffness": nominal.stiffness, "half_gap": nominal.half_gap}
        study["transmission"] = law if nominal.half_gap else {"law": "linear_shaft", "stiffness": law["stiffness"]}
    noise = record.statistics.channels["theta_e" if "motor" in record.positions else "theta_s"].noise
    return study | {
        "encoders": {"noise": _round_to_3_digits(noise)},
        "run": {"sample_period": record.sample_period, "substeps": plant_steps(nominal, record.sample_period)},
        "uncertainty": {"relative": _ROUGH_UNCERTAINTY, "exact": ["drive.gear_ratio"] if two else []},
        "log": table,
    }


def plant_steps(drive: NominalDrive, period: float) -> int:
    """Plant steps in a sample of `period` s: ten in a period of the oscillation of both inertias about the shaft."""
    rate = 0.0
    if math.isfinite(drive.stiffness):
        rate = drive.stiffness * (1.0 / drive.motor_inertia + drive.gear_ratio**2 / drive.load_inertia)
    return max(math.ceil(10.0 * math.sqrt(rate) * period / (2.0 * math.pi)), 1)


def _round_to_3_digits(value: float) -> float:
    """To three digits: no more of a rough fit is meant."""
    return float(f"{value:.3g}")
