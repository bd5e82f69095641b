"""Time stamps of a log: the selected rows, gaps between them, and whether the stamps are even."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from jaxbl.lines import DOUBT
from jaxbl.workers import check_cost

from .files import LogFile, read_log_file
from .libraries import Column, ColumnName, read_at
from .signal_quality import MIN_SAMPLES, count_samples, find_resolution, longest_segment, slices_between
from .table import LogTable, TimeTable

GAP_PERIODS = 3.5
"""Periods beyond which an interval is a gap: up to two lost samples in a row are interpolated."""
SECONDS_PER_UNIT = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Unit of the stamps -> s."""
_DOUBTFUL_PERIOD = 0.5
"""Period, s, from which the unit of the stamps is doubtful: drives are sampled much faster."""
_ROW_BYTES, _ROW_SECONDS = 1000.0, 8e-6
"""Bytes and seconds that reading takes for each row of four channels, on one core."""
_SHORTEST_PERIOD, _LONGEST_PERIOD = 1e-9, 1e10
"""Possible periods, s; the longest are seconds in nanoseconds that were read as seconds."""


@dataclass(frozen=True)
class Sampling:
    """Statistics of the time stamps of a log.

    Attributes:
        samples: rows that were read.
        median_period: median of the intervals, s.
        jitter: rms deviation of the intervals from their mean, without gaps, s.
        longest_interval: s; gaps included.
        gaps: intervals longer than three and a half periods.
        repeated: rows with the stamp of the row before.
        even: whether the stamps lie on an even grid, apart from their rounding.
    """

    samples: int
    median_period: float
    jitter: float
    longest_interval: float
    gaps: int
    repeated: int
    even: bool


class TimeStamps(NamedTuple):
    """The selected rows and their times.

    Attributes:
        times: s from the first stamp of the file, shape (rows,).
        start: first stamp of the file, s.
        rows: row numbers in the file, counted from 0, shape (rows,).
        file_rows: rows of the file.
        median_interval: median interval of the file, s.
        max_interval: longest interval without a gap, s.
    """

    times: np.ndarray
    start: float
    rows: np.ndarray
    file_rows: int
    median_interval: float
    max_interval: float


class SegmentedStamps(NamedTuple):
    """Segments of a log: the rows between its gaps.

    Attributes:
        times: s, shape (rows,); the times of the even grid if the stamps lie on one.
        distinct: False for rows that repeat the stamp of the row before, shape (rows of the time stamps,).
        segments: rows of each segment.
        period: of the even grid, or the median interval of uneven stamps, s.
        sampling: statistics of the stamps.
    """

    times: np.ndarray
    distinct: np.ndarray
    segments: list[slice]
    period: float
    sampling: Sampling


def read_time_stamps(file: LogFile, table: LogTable) -> TimeStamps:
    """Read the times of the rows that `[log]` selects.

    Raises:
        InputError: time does not increase, or too few rows remain.
    """
    stamps = _read_stamps(file, table)
    start = float(stamps[0])
    stamps = stamps - start
    is_full = _find_full_rows(file, table, len(stamps))
    rows = _select_rows(file, table, stamps, is_full)
    # the time is of correcting clocks and zeros, and of statistics
    check_cost(
        f"{file.path}: a log of {len(rows)} rows",
        _ROW_BYTES * len(rows),
        "[log] start and stop select a part of it",
        _ROW_SECONDS * len(rows),
    )
    intervals = np.diff(stamps[is_full])
    median = float(np.median(intervals)) or float(np.mean(intervals))
    # stamps that were rounded to more than a period come in groups
    group_interval = 0.0 if np.median(intervals) else np.median(intervals[intervals > 0.0])
    if not _SHORTEST_PERIOD <= median <= _LONGEST_PERIOD:
        raise file.error(f"the period of the time stamps is {median:g} s, as no drive is sampled; see [log] t.unit")
    if median >= _DOUBTFUL_PERIOD:
        file.warn(f"{DOUBT}the period is {median:g} s; if the stamps are not in s, set [log] t.unit.")
    # 2.5: one group may be missing
    return TimeStamps(stamps[rows], start, rows, len(stamps), median, max(GAP_PERIODS * median, 2.5 * group_interval))


def join_file(file: LogFile, table: LogTable, name: str) -> None:
    """Add the columns of a file that `[log] join` names, at the stamps of the log.

    Columns with times of their own are interpolated to these, and have no value outside of them; columns that start again
    (`wrap`) have their readings at the nearest times.

    Raises:
        InputError: the file is missing or unfit, or its times are not those of the log.
    """
    counters = {encoder.column for encoder in (table.theta_e, table.theta_s) if encoder is not None and encoder.wrap}
    stem = Path(name).stem + "/"
    if any(str(column).startswith(stem) for column in file.columns):
        raise file.error(f"[log] join: two files are named {stem[:-1]}; rename one of them")
    columns = [column.removeprefix(stem) for column in map(str, table.list_columns()) if column.startswith(stem)]
    stamps = _read_stamps(file, table)
    other = read_log_file(file.path.parent / name, {*columns, (table.t or TimeTable()).column_or("t")})
    other_stamps = _read_stamps(other, table)
    if (file.date is None) != (other.date is None):
        raise other.error(f"has {'numbers' if file.date else 'dates'} as stamps, and {file.path} has not")
    other_stamps = other_stamps + 1e-9 * ((other.date or 0) - (file.date or 0))
    if max(stamps[0], other_stamps[0]) >= min(stamps[-1], other_stamps[-1]):
        raise other.error(
            f"its times, {other_stamps[0]:g} to {other_stamps[-1]:g} s, and those of {file.path}, {stamps[0]:g} to "
            f"{stamps[-1]:g} s, do not overlap"
        )
    if not np.array_equal(stamps, other_stamps):
        file.note(f"{name} has times of its own; its columns are read at those of the log.")

    def load_column(column: ColumnName) -> np.ndarray:
        """Load a column of the other file at the stamps of the log, shape (stamps,); NaN outside of its own."""
        other.check_length(column, len(other_stamps))
        values = other.load_numbers(column)
        if f"{stem}{column}" in counters:
            middles = 0.5 * (other_stamps[1:] + other_stamps[:-1])
            is_outside = (stamps < other_stamps[0]) | (stamps > other_stamps[-1])
            return np.where(is_outside, np.nan, values[np.searchsorted(middles, stamps)])
        return read_at(stamps, other_stamps, values)

    for column in other.columns:
        file.columns[f"{stem}{column}"] = Column(partial(load_column, column), len(stamps))


def _read_stamps(file: LogFile, table: LogTable) -> np.ndarray:
    """Read the time stamps of all rows of the file, s, shape (rows of the file,)."""
    time_table = table.t or TimeTable()
    if time_table.period is not None:
        # other vectors of the file may be longer
        channel_columns = (table.list_columns() & {*file.columns, *range(len(file.columns))}) - {"t", *(table.absent or ())}
        length = max(file.count_values(file.find_column(column)) for column in channel_columns or file.columns)
        stamps = np.arange(length, dtype=float) * time_table.period
    else:
        stamps = file.load_seconds(time_table.column_or("t"), SECONDS_PER_UNIT[time_table.unit], "t.column")
    if len(stamps) < MIN_SAMPLES:
        raise file.error(f"has {len(stamps)} rows; a log needs at least {MIN_SAMPLES}")
    goes_back = np.diff(stamps) < 0.0
    if goes_back.any() or stamps[0] == stamps[-1]:
        fault = f" is {stamps[0]:g} s in all rows"
        if goes_back.any():
            row = np.argmax(goes_back) + 1
            fault = f", data row {row + 1}: time goes back from {stamps[row - 1]:.16g} s to {stamps[row]:.16g} s"
        raise file.error(f"column {file.find_column(time_table.column_or('t'))!r}{fault}; stamps should increase")
    return stamps


def _find_full_rows(file: LogFile, table: LogTable, count: int) -> np.ndarray:
    """Tell which rows have a value in every channel: one that is logged less often has none in most rows."""
    is_full, needed_columns = np.ones(count, dtype=bool), table.list_columns() - {*(table.absent or ())}
    for column in file.columns:
        if column in needed_columns and file.count_values(column) == count:
            has_value = pd.notna(file.load_values(column))
            if has_value.sum() >= MIN_SAMPLES and not has_value.all():
                is_full &= has_value
                empty = np.flatnonzero(~has_value)
                file.note(f"{len(empty)} rows without a value of '{column}' are left out (data row {empty[0] + 1} first).")
    return is_full


def _select_rows(file: LogFile, table: LogTable, stamps: np.ndarray, is_full: np.ndarray) -> np.ndarray:
    """Return the numbers of the rows that `where`, `start` and `stop` select; `stamps` are s from the first one."""
    is_selected = is_full.copy()
    for column, required in (table.where or {}).items():
        name = file.find_column(column)
        file.check_length(name, len(stamps))
        column_values = file.load_values(name)
        is_selected &= column_values == required
        if not is_selected.any():
            examples = ", ".join(map(repr, np.unique(column_values.astype(object))[:6].tolist()))
            raise file.error(f"[log] where leaves no row: '{column}' is never {required!r}; values: {examples}")
    stop = np.inf if table.stop is None else table.stop
    rows = np.flatnonzero(is_selected & (stamps >= (table.start or 0.0)) & (stamps <= stop))
    if len(rows) < MIN_SAMPLES:
        raise file.error(
            f"[log] where, start and stop leave {len(rows)} of {len(stamps)} rows; at least {MIN_SAMPLES} are needed"
        )
    if len(rows) < is_full.sum():
        file.note(f"{len(rows)} of {len(stamps)} rows are read, by [log] where, start and stop.")
    return rows


_MOST_LOST = 0.1
"""Rows that are missing, over those that are there, from which on coarse stamps are likelier: buses lose a few in 100."""


def split_at_gaps(file: LogFile, stamps: TimeStamps) -> SegmentedStamps:
    """Split a log at its gaps; segments that are too short and repeated stamps are left out.

    Raises:
        InputError: too few samples remain.
    """
    times, rows = stamps.times, stamps.rows
    pieces, segments = _split_at_intervals(times, stamps.max_interval)
    fits = [fit_even_stamps(times[segment]) for segment in segments]
    # of parts with different periods none can be read with that of another; stamps may be rounded to a period
    is_even = all(
        fit.is_even and abs(fit.period / fits[0].period - 1.0) < 1e-3 + 1.0 / count_samples(segment)
        for fit, segment in zip(fits, segments, strict=True)
    )
    # a spline needs increasing stamps
    distinct = (np.diff(times, prepend=-1.0) != 0.0) | is_even
    repeated = len(times) - int(distinct.sum())
    if repeated:
        row = rows[np.argmin(distinct)] + 1
        file.note(f"{repeated} rows have the stamp of the row before and were left out (data row {row} first).")
    times, rows = times[distinct], rows[distinct]
    pieces, segments = _split_at_intervals(times, stamps.max_interval)
    samples = sum(map(count_samples, segments))
    if samples < MIN_SAMPLES:
        longest_piece = max(map(count_samples, pieces))
        raise file.error(
            f"gaps leave no {MIN_SAMPLES} samples in a row (the longest part has {longest_piece}); a log needs them"
        )
    intervals = np.diff(times)
    if len(pieces) > 1:
        longest_gap = np.argmax(intervals)
        left_out = len(times) - samples
        file.note(
            f"Gaps: {len(pieces) - 1}; segments: {len(segments)}; the longest gap is {intervals[longest_gap]:.4g} s, "
            f"after data row {rows[longest_gap] + 1}"
            + (f"; {left_out} samples between gaps were left out." if left_out else ".")
        )
    within, period = intervals <= stamps.max_interval, stamps.median_interval
    # stamps that are as coarse as the period say nothing
    lost = within * (np.round(intervals / period) - 1.0)
    off = within * (intervals - (lost + 1.0) * period)
    if not is_even and 0.0 < lost.mean() < _MOST_LOST and abs(off).max() < 0.1 * period:
        first = np.argmax(lost > 0.0)
        file.note(f"{lost.sum():.0f} rows are missing, after data row {rows[first] + 1} first; they are interpolated.")
    if is_even:
        for piece, fit in zip(segments, fits, strict=True):
            times[piece] = fit.first + fit.period * np.arange(count_samples(piece))
        period = fits[segments.index(longest_segment(segments))].period
    sampling = Sampling(
        samples=len(stamps.times),
        median_period=stamps.median_interval,
        jitter=float(np.std(intervals[within])),
        longest_interval=float(intervals.max()),
        gaps=len(pieces) - 1,
        repeated=repeated,
        even=is_even,
    )
    return SegmentedStamps(times, distinct, segments, period, sampling)


def _split_at_intervals(stamps: np.ndarray, max_interval: float) -> tuple[list[slice], list[slice]]:
    """Return the pieces between longer intervals, and those of them that are long enough for a segment."""
    starts = np.flatnonzero(np.diff(stamps) > max_interval) + 1
    pieces = slices_between([0, *starts.tolist(), len(stamps)])
    return pieces, [piece for piece in pieces if count_samples(piece) >= MIN_SAMPLES // 2]


class StampFit(NamedTuple):
    """Even grid that fits stamps best: whether they lie on it, its period and its first time, s."""

    is_even: bool
    period: float
    first: float


def fit_even_stamps(stamps: np.ndarray) -> StampFit:
    """Fit an even grid to increasing stamps, s, shape (samples,), by least squares."""
    index = np.arange(len(stamps)) - 0.5 * (len(stamps) - 1)
    middle = stamps.mean()
    period = float(index @ (stamps - middle) / (index @ index))
    deviation = np.abs(stamps - middle - period * index).max()
    # 2 % of a period changes no result; stamps that were rounded, say to milliseconds, are off by up to half a step
    intervals = np.diff(stamps)
    rounding = find_resolution(intervals)
    # a row or two that were lost or repeated are likelier than a period that is off by as much as their stamps say
    irregular = np.count_nonzero(np.abs(intervals - np.median(intervals)) > 0.5 * period)
    is_rounded = irregular not in (1, 2) and deviation <= 0.55 * min(rounding, 20.0 * period)
    is_even = period > 0.0 and (deviation <= 0.02 * period or is_rounded)
    return StampFit(is_even, period, float(middle + period * index[0]))
