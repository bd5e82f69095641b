"""Time stamps of a log: the rows that are read, gaps between them, and whether they lie on an even grid."""

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .files import LogFile
from .signal_quality import MIN_SAMPLES, find_resolution, longest_segment
from .table import LogTable, TimeTable

GAP_PERIODS = 3.5
"""Intervals longer than this many periods are gaps: up to two lost samples in a row are interpolated."""
SECONDS_PER_UNIT = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Unit of the stamps -> s."""
_SLOW = 0.5
"""Period in s from which a remark asks for the unit of the stamps: drives are sampled much faster."""
_SHORTEST_PERIOD, _LONGEST_PERIOD = 1e-9, 1e10
"""Periods in s that are possible at all; the longest are seconds in stamps of nanoseconds that pass for seconds."""


@dataclass(frozen=True)
class Sampling:
    """Figures on the time stamps of a log.

    Attributes:
        samples: rows that were read.
        median_period: median of the intervals, s.
        jitter: rms deviation of the intervals from their mean, without gaps, s.
        longest_interval: s; gaps included.
        gaps: intervals longer than three and a half periods.
        repeated: rows whose stamp is that of the row before.
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
    """The rows that are read, and their times.

    Attributes:
        times: s from the first stamp of the file, shape (rows,).
        start: first stamp of the file, s.
        rows: their numbers in the file, counted from 0, shape (rows,).
        file_rows: rows of the file.
        median_interval: median interval of the file, s.
        max_interval: longest interval that is no gap, s.
    """

    times: np.ndarray
    start: float
    rows: np.ndarray
    file_rows: int
    median_interval: float
    max_interval: float


class SegmentedStamps(NamedTuple):
    """Parts of a log between its gaps.

    Attributes:
        times: s, shape (rows,); where the stamps are even, those of their grid.
        distinct: False for rows left out as their stamp is that of the row before, shape (rows of the time stamps,).
        segments: rows of each.
        period: of the grid where the stamps are even, else their median interval, s.
        sampling: figures on the stamps.
    """

    times: np.ndarray
    distinct: np.ndarray
    segments: list[slice]
    period: float
    sampling: Sampling


def read_time_stamps(file: LogFile, table: LogTable) -> TimeStamps:
    """The rows that `[log]` selects, and their times; InputError where time does not increase, or too few are left."""
    stamps = _read_stamps(file, table)
    start = float(stamps[0])
    stamps = stamps - start
    rows = _select_rows(file, table, stamps)
    intervals = np.diff(stamps)
    median = float(np.median(intervals)) or float(np.mean(intervals))
    # stamps that were rounded to more than a period come in groups
    group = 0.0 if np.median(intervals) else float(np.median(intervals[intervals > 0.0]))
    if not _SHORTEST_PERIOD <= median <= _LONGEST_PERIOD:
        raise file.error(f"the period of the time stamps is {median:g} s, as no drive is sampled; see [log] t.unit")
    if median >= _SLOW:
        file.warnings.append(f"Doubtful: the period is {median:g} s; if the stamps are not in s, set [log] t.unit.")
    # 2.5: one group may be missing
    return TimeStamps(stamps[rows], start, rows, len(stamps), median, max(GAP_PERIODS * median, 2.5 * group))


def _read_stamps(file: LogFile, table: LogTable) -> np.ndarray:
    """Of all rows, s, shape (rows of the file,)."""
    time = table.t or TimeTable()
    if time.period is not None:
        # other vectors of the file may be longer
        read = (table.list_columns() & {*file.columns, *range(len(file.columns))}) - {"t", *(table.absent or ())}
        length = max(file.count_values(file.find_column(one)) for one in read or file.columns)
        stamps = np.arange(length, dtype=float) * time.period
    else:
        stamps = file.load_seconds(time.column_or("t"), SECONDS_PER_UNIT[time.unit], "t.column")
    if len(stamps) < MIN_SAMPLES:
        raise file.error(f"has {len(stamps)} rows; a log needs at least {MIN_SAMPLES}")
    back = np.diff(stamps) < 0.0
    if back.any() or stamps[0] == stamps[-1]:
        wrong = f" is {stamps[0]:g} s in all rows"
        if back.any():
            row = int(np.argmax(back)) + 1
            wrong = f", data row {row + 1}: time goes back from {stamps[row - 1]:.9g} s to {stamps[row]:.9g} s"
        raise file.error(f"column {file.find_column(time.column_or('t'))!r}{wrong}; stamps should increase")
    return stamps


def _select_rows(file: LogFile, table: LogTable, stamps: np.ndarray) -> np.ndarray:
    """Numbers of the rows that `where`, `start` and `stop` leave; stamps from the first one on."""
    keep = np.ones(len(stamps), dtype=bool)
    for column, value in (table.where or {}).items():
        file.check_length(file.find_column(column), len(stamps))
        given = file.load_values(file.find_column(column))
        keep &= given == value
        if not keep.any():
            found = ", ".join(repr(v.item() if hasattr(v, "item") else v) for v in np.unique(given.astype(object))[:6])
            raise file.error(f"[log] where leaves no row: '{column}' is never {value!r}; values: {found}")
    for limit, outside in ((table.start, np.less), (table.stop, np.greater)):
        if limit is not None:
            keep &= ~outside(stamps, limit)
    rows = np.flatnonzero(keep)
    if len(rows) < MIN_SAMPLES:
        raise file.error(
            f"[log] where, start and stop leave {len(rows)} of {len(stamps)} rows; at least {MIN_SAMPLES} are needed"
        )
    if len(rows) < len(stamps):
        file.notes.append(f"{len(rows)} of {len(stamps)} rows are read, by [log] where, start and stop.")
    return rows


def split_at_gaps(file: LogFile, stamps: TimeStamps) -> SegmentedStamps:
    """Parts between gaps, without those that are too short and without repeated stamps; InputError where few are left."""
    times, rows = stamps.times, stamps.rows
    parts = _split_at_intervals(times, stamps.max_interval)
    grids = [fit_even_stamps(times[p]) for p in parts if _is_long_enough(p)]
    even = bool(grids) and all(grid.is_even for grid in grids)
    distinct = np.ones(len(times), dtype=bool)
    if not even:
        # no spline takes a stamp twice
        distinct = np.diff(times, prepend=-1.0) != 0.0
    repeated = len(times) - int(distinct.sum())
    if repeated:
        row = rows[int(np.argmin(distinct))] + 1
        file.notes.append(f"{repeated} rows have the stamp of the row before and were left out (data row {row} first).")
        times, rows = times[distinct], rows[distinct]
        parts = _split_at_intervals(times, stamps.max_interval)
    kept = [p for p in parts if _is_long_enough(p)]
    samples = sum(map(_count_samples, kept))
    if samples < MIN_SAMPLES:
        most = max(map(_count_samples, parts))
        raise file.error(f"gaps leave no {MIN_SAMPLES} samples in a row (the longest part has {most}); a log needs them")
    intervals = np.diff(times)
    if len(parts) > 1:
        widest = int(np.argmax(intervals))
        left_out = len(times) - samples
        file.notes.append(
            f"Gaps: {len(parts) - 1}; segments: {len(kept)}; the longest gap is {intervals[widest]:.4g} s, "
            f"after data row {rows[widest] + 1}" + (f"; {left_out} samples between gaps were left out." if left_out else ".")
        )
    inside = intervals[intervals <= stamps.max_interval]
    period = stamps.median_interval
    if even:
        times = times.copy()
        for p, grid in zip(kept, grids, strict=True):
            times[p] = grid.first + grid.period * np.arange(_count_samples(p))
        period = grids[kept.index(longest_segment(kept))].period
    sampling = Sampling(
        samples=len(stamps.times),
        median_period=stamps.median_interval,
        jitter=float(np.std(inside)) if len(inside) else 0.0,
        longest_interval=float(intervals.max()),
        gaps=len(parts) - 1,
        repeated=repeated,
        even=even,
    )
    return SegmentedStamps(times, distinct, kept, period, sampling)


def _count_samples(part: slice) -> int:
    return part.stop - part.start


def _is_long_enough(part: slice) -> bool:
    return _count_samples(part) >= MIN_SAMPLES // 2


def _split_at_intervals(stamps: np.ndarray, gap: float) -> list[slice]:
    ends = np.flatnonzero(np.diff(stamps) > gap) + 1
    return [slice(a, b) for a, b in itertools.pairwise([0, *ends.tolist(), len(stamps)])]


class StampFit(NamedTuple):
    """The even grid that fits stamps best: whether they lie on it, its period and its first time, s."""

    is_even: bool
    period: float
    first: float


def fit_even_stamps(stamps: np.ndarray) -> StampFit:
    """The even grid that fits increasing stamps best, in s, shape (samples,), by least squares."""
    index = np.arange(len(stamps)) - 0.5 * (len(stamps) - 1)
    middle = stamps.mean()
    period = float(index @ (stamps - middle) / (index @ index))
    largest = float(np.abs(stamps - middle - period * index).max())
    # 2 % of a period changes no result; stamps that were rounded, say to milliseconds, are off by up to half a step
    rounding = find_resolution(np.diff(stamps))
    even = period > 0.0 and (largest <= 0.02 * period or largest <= 0.55 * min(rounding, 20.0 * period))
    return StampFit(even, period, float(middle + period * index[0]))
