"""Channels of a log: columns become SI values; what a column shows of a wrong unit, sign of words or wrap-around."""

import math
from typing import NamedTuple

import numpy as np

from jaxbl.validation import suggest_word

from .files import LogFile
from .signal_quality import find_resolution
from .table import POSITION_CHANNELS, SPEED_CHANNELS, LogTable, PositionTable, SpeedTable, TorqueTable
from .time_stamps import TimeStamps

_LEAST_MOTION, _LEAST_TORQUE = 1e-12, 1e-15
"""In rad (m) and N m (N), a millionth of what the finest encoders and sensors show: less is no measurement."""


class RawChannel(NamedTuple):
    """A channel in SI units at its own time stamps.

    Attributes:
        values: shape (rows,).
        unit: rad, m, N m or N.
        saturated: share of rows at the saturation level that `[log]` gives.
        skew: by how much the stamps are later than the values, s; "estimate": to be found.
        held: whether each value holds until the next stamp.
        drift: by how much the skew grows in each second.
    """

    values: np.ndarray
    unit: str
    saturated: float
    skew: float | str
    held: bool
    drift: float = 0.0


def read_channels(file: LogFile, table: LogTable, stamps: TimeStamps) -> dict[str, RawChannel]:
    """Those of theta_e, theta_s, u, transmitted that a log has, at the rows that are read.

    InputError where a column is missing, or its values contradict the `[log]` table.
    """
    found: dict[str, RawChannel] = {}
    linear = False
    for name in POSITION_CHANNELS.values():
        speed = getattr(table, SPEED_CHANNELS[name])
        if speed is not None:
            linear |= speed.si_unit == "m" and not found
            found[name] = _integrate_speed(file, name, speed, stamps)
        elif _is_recorded(file, table, name):
            position = getattr(table, name) or PositionTable()
            linear |= position.si_unit == "m" and not found
            found[name] = _read_position(file, name, position, stamps)
    if not found:
        columns = ", ".join(map(str, file.columns))
        raise file.error(
            f"no column 'theta_e' or 'theta_s'; columns: {columns}; [log] theta_e can name the motor position, "
            "omega_e its speed"
        )
    torques = {"u": table.u or TorqueTable()} if _is_recorded(file, table, "u") else {}
    if table.transmitted is not None:
        torques["transmitted"] = table.transmitted
    for name, torque in torques.items():
        found[name] = _read_torque(file, name, torque, stamps, linear=linear)
    return found


def _is_recorded(file: LogFile, table: LogTable, name: str) -> bool:
    """Whether a channel is to be read: a position that `[log]` does not name may be missing, a misspelt column may not."""
    if name in (table.absent or []):
        return False
    if getattr(table, name) is not None or name in file.columns:
        return True
    if name == "u":
        names = list(file.columns)
        hint = "the file has no header" if all(isinstance(n, int) for n in names) else suggest_word("u", map(str, names))
        raise file.error(f"no column 'u'; {hint}; [log] u can name it, absent = [\"u\"] says that there is none")
    given = (table.t, table.u, table.theta_e, table.theta_s, table.omega_e, table.omega_s)
    used = {t.column for t in given if t is not None}
    for other in file.columns:
        near = isinstance(other, str) and other.lower().replace("_", "").replace(" ", "") == name.replace("_", "")
        if near and other not in used:
            raise file.error(f"no column '{name}', but '{other}'; [log] {name} = \"{other}\" would read it")
    if table.kind == "drive":
        file.notes.append(f"There is no {name} ({'motor' if name == 'theta_e' else 'load'} position) in this log.")
    return False


def _read_numbers(file: LogFile, name: str, column: str | int, bits: int | None, stamps: TimeStamps) -> np.ndarray:
    """Numbers of a column at the rows that are read, unsigned words made signed."""
    file.check_length(file.find_column(column, f"{name}.column"), stamps.file_rows)
    values = file.load_numbers(column, f"{name}.column")
    if bits is not None:
        words = to_signed(values, bits)
        outside = np.isnan(words)
        if outside.any():
            row = int(np.argmax(outside))
            raise file.error(
                f"column {column!r}, data row {row + 1}: {values[row]:g} is no word of {bits} bits; see [log] "
                f"{name}.signed_bits"
            )
        values = words
    return values[stamps.rows]


def to_signed(values: np.ndarray, bits: int) -> np.ndarray:
    """Unsigned words as signed ones; NaN for what is no word of so many bits."""
    word = (values == np.round(values)) & (values >= -(2.0 ** (bits - 1))) & (values < 2.0**bits)
    return np.where(word, np.where(values >= 2.0 ** (bits - 1), values - 2.0**bits, values), np.nan)


def to_si(table: PositionTable | SpeedTable | TorqueTable, values: np.ndarray) -> np.ndarray:
    """Numbers of a column, signed and unwrapped, in SI units as `[log]` says: rad (m), rad/s (m/s), N m (N)."""
    if isinstance(table, TorqueTable):
        one, factor = 1.0, 1.0 if table.factor is None else table.factor
    elif isinstance(table, SpeedTable):
        one, factor = _SPEED_FACTORS[table.unit], table.factor
    else:
        one, factor = _POSITION_FACTORS[table.unit] / (table.counts_per_turn or 1.0), table.factor
    return table.sign * factor * one * values + (table.offset or 0.0)


_POSITION_FACTORS = {
    "rad": 1.0, "deg": math.pi / 180.0, "turn": 2.0 * math.pi, "counts": 2.0 * math.pi, "m": 1.0, "mm": 1e-3,
}  # fmt: skip
"""Unit of a position -> rad (m); of counts, those of a turn."""
_SPEED_FACTORS = {
    "rad/s": 1.0, "deg/s": math.pi / 180.0, "rpm": math.pi / 30.0, "turn/s": 2.0 * math.pi, "m/s": 1.0, "mm/s": 1e-3,
}  # fmt: skip
"""Unit of a speed -> rad/s (m/s)."""


def _read_position(file: LogFile, name: str, table: PositionTable, stamps: TimeStamps) -> RawChannel:
    column = table.column_or(name)
    values = _read_numbers(file, name, column, table.signed_bits, stamps)
    if table.minus is not None:
        values = values - _read_numbers(file, name, table.minus, table.signed_bits, stamps)
    if np.ptp(values) == 0.0:
        raise file.error(
            f'column {column!r} ({name}) is {values[0]:g} in all rows; it should move; absent = ["{name}"] leaves it out'
        )
    if table.wrap is None:
        _check_wrap(file, name, table, values, stamps)
    else:
        values = _unwrap(file, name, table, values)
    _check_unit(file, name, table, values)
    values = to_si(table, values)
    if np.ptp(values) < _LEAST_MOTION:
        raise file.error(f"{name} moves by only {np.ptp(values):.3g} {table.si_unit}; see its unit and factor in [log]")
    return RawChannel(values, table.si_unit, 0.0, table.skew or 0.0, held=False, drift=table.drift or 0.0)


def _integrate_speed(file: LogFile, name: str, table: SpeedTable, stamps: TimeStamps) -> RawChannel:
    """A position from its speed by the trapezoidal rule, 0 at the first row."""
    channel = SPEED_CHANNELS[name]
    column = table.column_or(channel)
    values = _read_numbers(file, channel, column, table.signed_bits, stamps)
    if np.ptp(values) == 0.0:
        raise file.error(f"column {column!r} ({channel}) is {values[0]:g} in all rows; it should change")
    step = find_resolution(values)
    speed = to_si(table, values)
    position = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(stamps.times))])
    coarse = f" in steps of {step * table.factor:.3g} {table.unit}" if step else ""
    file.warnings.append(
        f"{name} is the integral of the speed {channel}{coarse}: its errors add up over time. More than noise may be "
        "left where the model is complete, and what depends on the place of the load is found only roughly."
    )
    return RawChannel(position, table.si_unit, 0.0, table.skew or 0.0, held=False)


def _read_torque(file: LogFile, name: str, table: TorqueTable, stamps: TimeStamps, *, linear: bool) -> RawChannel:
    column = table.column_or(name)
    values = _read_numbers(file, name, column, table.signed_bits, stamps)
    if linear and table.unit == "N m":
        raise file.error(f"[log] {name}.unit is N m, but the position is in m; on a linear axis it should be N")
    if table.signed_bits is None:
        _check_unsigned(file, name, column, values)
    if name == "u" and np.ptp(values) == 0.0:
        file.notes.append(f"u is {values[0]:g} in all rows: free motion, which does not show the inertia by itself.")
    saturated = 0.0
    if table.saturation is not None:
        # the margins are for the rounding of decimal numbers
        if np.abs(values).max() > table.saturation * (1.0 + 1e-9):
            row = int(np.argmax(np.abs(values)))
            raise file.error(
                f"column {column!r}, data row {stamps.rows[row] + 1}: {values[row]:g} exceeds [log] {name}.saturation = "
                f"{table.saturation:g}; saturation should be the largest value that there can be"
            )
        saturated = float(np.mean(np.abs(values) >= table.saturation * (1.0 - 1e-9)))
    values = to_si(table, values)
    if 0.0 < np.abs(values).max() < _LEAST_TORQUE:
        raise file.error(f"{name} is at most {np.abs(values).max():.3g}; see its unit and factor in [log]")
    return RawChannel(values, "N" if linear else "N m", saturated, table.skew, held=name == "u")


# wrap-around


def _unwrap(file: LogFile, name: str, table: PositionTable, values: np.ndarray) -> np.ndarray:
    assert table.wrap is not None
    if np.ptp(values) > 1.001 * table.wrap:
        raise file.error(
            f"column {table.column_or(name)!r} ranges over {np.ptp(values):g}, more than [log] {name}.wrap = "
            f"{table.wrap:g}; wrap should be the period after which it starts again"
        )
    unwrapped = np.unwrap(values, period=table.wrap)
    count = int(np.count_nonzero(np.abs(np.diff(unwrapped) - np.diff(values)) > 0.5 * table.wrap))
    if count:
        file.notes.append(f"{name}: {count} wrap-arounds undone.")
    return unwrapped


def _check_wrap(file: LogFile, name: str, table: PositionTable, values: np.ndarray, stamps: TimeStamps) -> None:
    """Refuse values with a few jumps by a usual period, which are otherwise smooth."""
    size = np.abs(np.diff(values))
    span = float(np.ptp(values))
    at = np.flatnonzero(size > 0.75 * span)
    if not len(at) or len(at) > 0.1 * len(values):
        return
    usual = float(np.quantile(np.delete(size, at), 0.999)) if len(at) < len(size) else np.inf
    # a turn in each unit, and counters of 3 to 32 bits
    periods = [2.0 * math.pi, 360.0, 1.0, *(2.0**k for k in range(3, 33)), table.counts_per_turn or 360.0]
    # without its jump by a period the motion goes on as before
    around = [p for p in periods if p >= span * 0.999 and (np.abs(size[at] - p) <= 3.0 * usual + 1e-9 * p).all()]
    if around and usual < 0.05 * around[0]:
        raise file.error(
            f"column {table.column_or(name)!r} ({name}) jumps by about {around[0]:.10g} at {len(at)} rows (data row "
            f"{stamps.rows[at[0] + 1] + 1} first) and goes on from there: it wraps around; set wrap = {around[0]:.10g} in "
            f"[log] {name}"
        )


# units


def _check_unsigned(file: LogFile, name: str, column: str | int, values: np.ndarray) -> None:
    """Refuse whole numbers from 0 up that leave out the middle of a word's range: negative ones were logged as unsigned."""
    if values.min() < 0.0 or (values != np.round(values)).any():
        return
    for bits in (8, 16, 32):
        top = 2.0**bits
        empty = not ((values > 0.375 * top) & (values < 0.625 * top)).any()
        if 0.625 * top <= values.max() < top and empty and (values <= 0.375 * top).any():
            raise file.error(
                f"column {column!r} ({name}) holds whole numbers up to {values.max():.0f} and none about "
                f"{0.5 * top:.0f}: signed words of {bits} bits, logged as unsigned; "
                f"set signed_bits = {bits} in [log] {name}"
            )


def _check_unit(file: LogFile, name: str, table: PositionTable, values: np.ndarray) -> None:
    """Refuse radians whose steps are an encoder's in degrees, the other way round, and counts."""
    step = find_resolution(values)
    if table.factor != 1.0 or table.unit not in ("rad", "deg") or not step:
        return
    column = f"column {table.column_or(name)!r} ({name})"
    turns = {"rad": 2.0 * math.pi, "deg": 360.0}
    other = "deg" if table.unit == "rad" else "rad"
    long = {"rad": "radians", "deg": "degrees"}
    if _is_encoder_count(turns[other] / step) and not _is_encoder_count(turns[table.unit] / step):
        raise file.error(
            f"{column} has steps of {step:.6g}, a turn of {round(turns[other] / step)} counts in {long[other]}: it is not "
            f'in {long[table.unit]}; set unit = "{other}" in [log] {name}'
        )
    if table.unit == "rad" and math.isclose(step, 1.0, rel_tol=1e-9) and len(np.unique(values)) > 16:
        raise file.error(
            f'{column} holds whole numbers only: counts, not radians; set unit = "counts" and counts_per_turn in [log] '
            + name
        )


def _is_encoder_count(counts: float) -> bool:
    """Whether a number of counts a turn is a power of two, as those of absolute and of interpolated encoders are."""
    if not 2.0**6 <= counts <= 2.0**27:
        return False
    power = math.log2(counts)
    return abs(power - round(power)) < 1e-4
