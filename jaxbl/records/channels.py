"""Channels of a log: columns become SI values; wrong units, unsigned words and wrap-around are found and refused."""

import math
from typing import Literal, NamedTuple

import numpy as np

from jaxbl.validation import suggest_word

from .files import LogFile
from .libraries import ColumnName
from .signal_quality import find_resolution, find_runs
from .table import POSITION_CHANNELS, ChannelTable, LogTable, PositionTable, SpeedTable, TorqueTable
from .time_stamps import TimeStamps

_LEAST_MOTION, _LEAST_TORQUE = 1e-12, 1e-15
"""Smallest range, rad (m), and torque, N m (N): a millionth of what the finest encoders and sensors resolve."""


class RawChannel(NamedTuple):
    """A channel in SI units at its own time stamps.

    Attributes:
        values: shape (rows,).
        unit: rad, m, N m or N.
        skew: delay of the stamps against the values at time 0, s; 0 where it is to be estimated.
        saturated: share of rows at the saturation level that `[log]` gives.
        hold: `[log] hold` of a torque that acts on the drive; None for what is only measured.
        drift: growth of the skew, s/s.
    """

    values: np.ndarray
    unit: str
    skew: float
    saturated: float = 0.0
    hold: Literal["zoh", "sampled"] | None = None
    drift: float = 0.0

    def undo_delay(self, stamps: np.ndarray) -> np.ndarray:
        """Return the times of readings with these stamps, s."""
        return stamps - (self.skew + self.drift * stamps)


def read_channels(file: LogFile, table: LogTable, stamps: TimeStamps) -> dict[str, RawChannel]:
    """Read the channels theta_e, theta_s, u and transmitted, as far as the log has them, at the selected rows.

    Raises:
        InputError: a column is missing, or its values contradict the `[log]` table.
    """
    channels: dict[str, RawChannel] = {}
    for name in POSITION_CHANNELS.values():
        channel, source = table.position_source(name)
        if isinstance(source, SpeedTable):
            channels[name] = _integrate_speed(file, name, channel, source, stamps)
        elif _is_recorded(file, table, name):
            channels[name] = _read_position(file, name, source, stamps)
    if not channels:
        columns = ", ".join(map(str, file.columns))
        raise file.error(
            f"no column 'theta_e' or 'theta_s'; columns: {columns}; [log] theta_e can name the motor position, "
            "omega_e its speed"
        )
    is_linear = next(iter(channels.values())).unit == "m"
    torques = {"u": table.u or TorqueTable()} if _is_recorded(file, table, "u") else {}
    if table.transmitted is not None:
        torques["transmitted"] = table.transmitted
    for name, torque in torques.items():
        channels[name] = _read_torque(file, name, torque, stamps, is_linear=is_linear)
    if table.reference is not None:
        channels["reference"] = _read_reference(file, table.reference, stamps)
    # a test rig compares displacement and torque at the same instants
    if "u" in channels and (table.kind == "drive" or table.hold != "sampled"):
        channels["u"] = channels["u"]._replace(hold=table.hold or "zoh")
    return channels


def _is_recorded(file: LogFile, table: LogTable, name: str) -> bool:
    """Return True if a channel is to be read. A position may be missing, unless `[log]` names it or a column is misspelt."""
    if name in (table.absent or []):
        return False
    if getattr(table, name) is not None or name in file.columns:
        return True
    if name == "u":
        names = list(file.columns)
        hint = "the file has no header" if all(isinstance(n, int) for n in names) else suggest_word("u", map(str, names))
        raise file.error(f"no column 'u'; {hint}; [log] u can name it, absent = [\"u\"] says that there is none")
    used_columns = {channel.column for channel in table.channels.values() if channel is not None}
    for column in file.columns:
        is_similar = str(column).lower().replace("_", "").replace(" ", "") == name.replace("_", "")
        if is_similar and column not in used_columns:
            raise file.error(f"no column '{name}', but '{column}'; [log] {name} = \"{column}\" would read it")
    if table.kind == "drive":
        file.note(f"There is no {name} ({'motor' if name == 'theta_e' else 'load'} position) in this log.")
    return False


def _read_numbers(
    file: LogFile,
    name: str,
    table: ChannelTable,
    stamps: TimeStamps,
    other_column: ColumnName | None = None,
) -> np.ndarray:
    """Read the numbers of a channel's column, or of another one, at the selected rows; words become signed numbers."""
    column = table.column_or(name) if other_column is None else other_column
    file.check_length(file.find_column(column, f"{name}.column"), stamps.file_rows)
    values = file.load_numbers(column, f"{name}.column", stamps.rows)
    signed_words = decode_words(table, values)
    is_no_word = np.isnan(signed_words)
    if is_no_word.any():
        row = np.argmax(is_no_word)
        bits, key = (table.signed_bits, "signed_bits") if table.sign_bit is None else (table.sign_bit + 1, "sign_bit")
        raise file.error(
            f"column {column!r}, data row {stamps.rows[row] + 1}: {values[row]:g} is no word of {bits} bits; see [log] "
            f"{name}.{key}"
        )
    return signed_words


def decode_words(table: ChannelTable, values: np.ndarray) -> np.ndarray:
    """Return the numbers of a column, of which words with a sign become signed; NaN for a value that is no such word."""
    if table.sign_bit is not None:
        limit = 2.0**table.sign_bit
        least, negative = 0.0, limit - values
    elif table.signed_bits is not None:
        limit = 2.0 ** (table.signed_bits - 1)
        least, negative = -limit, values - 2.0 * limit
    else:
        return values
    is_word = (values == np.round(values)) & (values >= least) & (values < 2.0 * limit)
    return np.where(is_word, np.where(values >= limit, negative, values), np.nan)


def to_si(table: ChannelTable, values: np.ndarray) -> np.ndarray:
    """Convert signed and unwrapped numbers of a column to SI units by its `[log]` table: rad (m), rad/s (m/s), N m (N)."""
    factor = table.factor or 1.0
    if isinstance(table, SpeedTable):
        factor *= SPEED_FACTORS[table.unit]
    elif isinstance(table, PositionTable):
        factor *= POSITION_FACTORS[table.unit] / (table.counts_per_turn or 1.0)
    return table.sign * factor * values + (table.offset or 0.0)


POSITION_FACTORS = {
    "rad": 1.0, "deg": math.pi / 180.0, "turn": 2.0 * math.pi, "counts": 2.0 * math.pi, "m": 1.0, "mm": 1e-3,
}  # fmt: skip
"""Unit of a position -> rad (m); for counts, rad a turn."""
SPEED_FACTORS = {
    "rad/s": 1.0, "deg/s": math.pi / 180.0, "rpm": math.pi / 30.0, "turn/s": 2.0 * math.pi, "m/s": 1.0, "mm/s": 1e-3,
}  # fmt: skip
"""Unit of a speed -> rad/s (m/s)."""


def _read_position(file: LogFile, name: str, table: PositionTable, stamps: TimeStamps) -> RawChannel:
    values = _read_numbers(file, name, table, stamps)
    if table.minus is not None:
        values = values - _read_numbers(file, name, table, stamps, table.minus)
    if np.ptp(values) == 0.0:
        raise file.error(
            f"column {table.column_or(name)!r} ({name}) is {values[0]:g} in all rows; it should move; "
            f'absent = ["{name}"] leaves it out'
        )
    if table.wrap is None:
        _check_wrap(file, name, table, values, stamps)
    else:
        values = _unwrap(file, name, table, values)
    step = 1.0 / table.factor if table.unit == "counts" else find_resolution(values)
    if step:
        values = _undo_counter_jumps(file, name, values, step, stamps)
    _check_unit(file, name, table, values)
    values = to_si(table, values)
    if np.ptp(values) < _LEAST_MOTION:
        raise file.error(f"{name} moves by only {np.ptp(values):.3g} {table.si_unit}; see its unit and factor in [log]")
    return RawChannel(values, table.si_unit, table.given_skew, drift=table.drift or 0.0)


def _read_reference(file: LogFile, table: PositionTable, stamps: TimeStamps) -> RawChannel:
    """Read what a controller was given: it may stand still or jump."""
    values = _read_numbers(file, "reference", table, stamps)
    values = to_si(table, _unwrap(file, "reference", table, values))
    return RawChannel(values, table.si_unit, table.given_skew)


def _integrate_speed(file: LogFile, name: str, channel: str, table: SpeedTable, stamps: TimeStamps) -> RawChannel:
    """Integrate a speed to a position by the trapezoidal rule, 0 at the first row."""
    from scipy.integrate import cumulative_trapezoid

    values = _read_numbers(file, channel, table, stamps)
    if np.ptp(values) == 0.0:
        raise file.error(f"column {table.column_or(channel)!r} ({channel}) is {values[0]:g} in all rows; it should change")
    step = find_resolution(values)
    position = cumulative_trapezoid(to_si(table, values), stamps.times, initial=0.0)
    step_text = f" in steps of {step * table.factor:.3g} {table.unit}" if step else ""
    file.warn(
        f"{name} is the integral of the speed {channel}{step_text}: its errors add up over time. Even a complete model "
        "may leave more than noise, and effects that depend on the load's position are found only roughly."
    )
    return RawChannel(position, table.si_unit, table.skew or 0.0)


def _read_torque(file: LogFile, name: str, table: TorqueTable, stamps: TimeStamps, *, is_linear: bool) -> RawChannel:
    column = table.column_or(name)
    values = _read_numbers(file, name, table, stamps)
    if is_linear and table.unit == "N m":
        raise file.error(f"[log] {name}.unit is N m, but the position is in m; on a linear axis it should be N")
    if table.signed_bits is None and table.sign_bit is None:
        _check_unsigned(file, name, column, values)
    if name == "u" and np.ptp(values) == 0.0:
        file.note(f"u is {values[0]:g} in all rows: free motion, which does not show the inertia by itself.")
    values = _replace_dropouts(file, name, values, stamps)
    saturated = 0.0
    if table.saturation is not None:
        size = np.abs(values)
        # the margins are for the rounding of decimal numbers
        if size.max() > table.saturation * (1.0 + 1e-9):
            row = np.argmax(size)
            raise file.error(
                f"column {column!r}, data row {stamps.rows[row] + 1}: {values[row]:g} exceeds [log] {name}.saturation = "
                f"{table.saturation:g}; saturation should be the largest possible value"
            )
        saturated = float(np.mean(size >= table.saturation * (1.0 - 1e-9)))
    values = to_si(table, values)
    largest = np.abs(values).max()
    if 0.0 < largest < _LEAST_TORQUE:
        raise file.error(f"{name} is at most {largest:.3g}; see its unit and factor in [log]")
    return RawChannel(values, "N" if is_linear else "N m", table.skew or 0.0, saturated)


_MAX_DROPOUT = 3
"""Samples of a dropout at most: a bus that does not answer for longer stops the drive."""
_MAX_DROPOUT_SHARE = 0.1
"""Share of the samples beyond which a value is a part of the input, which is switched."""
_CLEAR_JUMP = 5.0
"""Size of a dropout or a jump, over what the samples beside it differ by: more than any smooth signal makes."""


def _replace_dropouts(file: LogFile, name: str, values: np.ndarray, stamps: TimeStamps) -> np.ndarray:
    """Replace single samples that return to one value again and again, as of a bus that did not answer.

    The value is 0, or the least or largest. Two samples on each side of a dropout lie on a line that is far from it.
    """
    for filler in (0.0, values.min(), values.max()):
        starts, stops = find_runs(values == filler)
        is_inside = (stops - starts <= _MAX_DROPOUT) & (starts >= 2) & (stops <= len(values) - 2)
        starts, stops = starts[is_inside], stops[is_inside]
        beside = values[np.stack([starts - 2, starts - 1, stops, stops + 1])]
        # two dropouts may be neighbours
        beside = np.where(beside == filler, beside[[1, 0, 3, 2]], beside)
        middle = 0.5 * (beside[1] + beside[2])
        bend = np.abs(2.0 * beside[[1, 2]] - beside[[0, 3]] - middle).max(axis=0)
        is_clear = np.abs(middle - filler) > _CLEAR_JUMP * bend
        # levels of a stepping or random input look like dropouts now and then
        if not max(3.0, 0.5 * len(starts)) <= is_clear.sum() <= _MAX_DROPOUT_SHARE * len(values):
            continue
        rows = np.r_[*map(slice, starts[is_clear], stops[is_clear])]
        kept_times, kept_values = np.delete(stamps.times, rows), np.delete(values, rows)
        values = values.copy()
        values[rows] = np.interp(stamps.times[rows], kept_times, kept_values)
        file.warn(
            f"{name} is {filler:g} in {len(rows)} samples between others that are far from it (data row "
            f"{stamps.rows[rows[0]] + 1} first): dropouts, which were left out."
        )
    return values


_MIN_COUNTER, _MAX_COUNTER = 2.0**8, 2.0**32
"""Powers of two by which a counter jumps: bytes and words. A few lost counts are other numbers."""
_MAX_TOLERANCE = 0.02
"""Uncertainty of a jump, over its size, by the motion about it: a jump of any size meets a power of two in 1 of 25 cases."""


def _undo_counter_jumps(file: LogFile, name: str, values: np.ndarray, step: float, stamps: TimeStamps) -> np.ndarray:
    """Undo jumps of a position by a power of two of its steps, between which it goes on as before."""
    from scipy.ndimage import median_filter

    differences = np.diff(values)
    # without the motion, which hardly changes from sample to sample
    sizes = (differences - median_filter(differences, 9, mode="nearest")) / step
    jumps = np.zeros(len(sizes))
    for row in np.flatnonzero(np.abs(sizes) > 0.9 * _MIN_COUNTER):
        power = 2.0 ** round(math.log2(abs(sizes[row])))
        tolerance = 2.0 + 3.0 * np.median(np.abs(sizes[max(row - 4, 0) : row + 5]))
        # one of another size, and all are of another cause
        if not (power <= _MAX_COUNTER and abs(abs(sizes[row]) - power) < tolerance < _MAX_TOLERANCE * power):
            return values
        jumps[row] = math.copysign(power, sizes[row])
    rows = np.flatnonzero(jumps)
    if not 0 < len(rows) <= 0.01 * len(values):
        return values
    texts = [f"{jumps[row]:+.0f} (data row {stamps.rows[row + 1] + 1})" for row in rows[:6]]
    file.warn(
        f"{name}: {len(rows)} counter jump{'s' * (len(rows) > 1)}, in steps of {step:.4g}: {', '.join(texts)}"
        f"{', ...' * (len(rows) > 6)}. They were undone."
    )
    return values - step * np.cumsum(np.append(0.0, jumps))


# wrap-around


def _unwrap(file: LogFile, name: str, table: PositionTable, values: np.ndarray) -> np.ndarray:
    if table.wrap is None:
        return values
    if np.ptp(values) > 1.001 * table.wrap:
        raise file.error(
            f"column {table.column_or(name)!r} ranges over {np.ptp(values):g}, more than [log] {name}.wrap = "
            f"{table.wrap:g}; wrap should be the period after which it starts again"
        )
    unwrapped = np.unwrap(values, period=table.wrap)
    count = np.count_nonzero(np.abs(np.diff(unwrapped) - np.diff(values)) > 0.5 * table.wrap)
    if count:
        file.note(f"{name}: {count} wrap-arounds undone.")
    return unwrapped


def _check_wrap(file: LogFile, name: str, table: PositionTable, values: np.ndarray, stamps: TimeStamps) -> None:
    """Refuse values that are smooth but for a few jumps by a common period (a turn, or a counter's range)."""
    steps = np.abs(np.diff(values))
    span = np.ptp(values)
    jump_rows = np.flatnonzero(steps > 0.75 * span)
    if not 0 < len(jump_rows) <= 0.1 * len(values):
        return
    usual_step = np.quantile(np.delete(steps, jump_rows), 0.999)
    # a turn in each unit, and counters of 3 to 32 bits
    periods = [2.0 * math.pi, 360.0, 1.0, *(2.0**k for k in range(3, 33)), table.counts_per_turn or 360.0]
    # without its jump by a period the motion goes on as before
    fitting_periods = [
        period
        for period in periods
        if period >= span * 0.999 and (np.abs(steps[jump_rows] - period) <= 3.0 * usual_step + 1e-9 * period).all()
    ]
    if fitting_periods and usual_step < 0.05 * fitting_periods[0]:
        raise file.error(
            f"column {table.column_or(name)!r} ({name}) jumps by about {fitting_periods[0]:.10g} at {len(jump_rows)} rows "
            f"(data row {stamps.rows[jump_rows[0] + 1] + 1} first) and goes on from there: it wraps around; set wrap = "
            f"{fitting_periods[0]:.10g} in [log] {name}"
        )


# units


def _check_unsigned(file: LogFile, name: str, column: ColumnName, values: np.ndarray) -> None:
    """Refuse whole numbers from 0 up without any in the middle of a word's range: negative words, logged as unsigned."""
    if values.min() < 0.0 or (values != np.round(values)).any():
        return
    for bits in (8, 16, 32):
        modulus = 2.0**bits
        middle_is_empty = not ((values > 0.375 * modulus) & (values < 0.625 * modulus)).any()
        if 0.625 * modulus <= values.max() < modulus and middle_is_empty and (values <= 0.375 * modulus).any():
            raise file.error(
                f"column {column!r} ({name}) holds whole numbers up to {values.max():.0f} and none about "
                f"{0.5 * modulus:.0f}: signed words of {bits} bits, logged as unsigned; "
                f"set signed_bits = {bits} in [log] {name}"
            )


def _check_unit(file: LogFile, name: str, table: PositionTable, values: np.ndarray) -> None:
    """Refuse radians with the step of an encoder in degrees, degrees with one in radians, and counts as radians."""
    step = find_resolution(values)
    if table.factor != 1.0 or table.unit not in ("rad", "deg") or not step:
        return
    column = f"column {table.column_or(name)!r} ({name})"
    units = {"rad": (2.0 * math.pi / step, "radians"), "deg": (360.0 / step, "degrees")}
    counts, unit_name = units.pop(table.unit)
    other, (other_counts, other_name) = units.popitem()
    if _is_encoder_count(other_counts) and not _is_encoder_count(counts):
        raise file.error(
            f"{column} has steps of {step:.6g}, a turn of {round(other_counts)} counts in {other_name}: it is not in "
            f'{unit_name}; set unit = "{other}" in [log] {name}'
        )
    if table.unit == "rad" and math.isclose(step, 1.0, rel_tol=1e-9) and len(np.unique(values)) > 16:
        raise file.error(
            f'{column} holds whole numbers only: counts, not radians; set unit = "counts" and counts_per_turn in [log] '
            + name
        )


def _is_encoder_count(counts: float) -> bool:
    """Return True if the counts a turn are a power of two, as with absolute and interpolated encoders."""
    power = math.log2(counts)
    return 6.0 <= power <= 27.0 and abs(power - round(power)) < 1e-4
