"""Resampling: channels at their own time stamps become evenly spaced samples, moved by their skews."""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from .channels import RawChannel
from .files import LogFile
from .signal_quality import MIN_SAMPLES, interpolate_spline, segments_before, slices_between
from .time_stamps import SegmentedStamps

_MAX_OVERSAMPLING = 100
"""Samples for each sample of the log: more hold nothing new, and fill the memory."""


class Grid(NamedTuple):
    """Evenly spaced samples of all channels.

    Attributes:
        time: s, shape (samples,).
        values: channel -> SI values, shape (samples,).
        segments: samples of each segment.
        period: s.
    """

    time: np.ndarray
    values: dict[str, np.ndarray]
    segments: Sequence[slice]
    period: float

    def first(self, share: float) -> "Grid":
        """Return the grid with the segments of a share of its samples, from the first on."""
        return self._replace(segments=segments_before(self.segments, round(share * len(self.time))))


def resample_channels(
    file: LogFile,
    segmented: SegmentedStamps,
    channels: Mapping[str, RawChannel],
    period: float,
    *,
    interpolate: bool,
) -> Grid:
    """Resample all channels to one grid in each segment: positions by cubic splines, a torque by what holds for a period.

    Without `interpolate` the stamps lie on the grid already, and only delays move values. Segments that are then too short
    are left out.

    Raises:
        InputError: all segments are too short for the period and the skews.
    """
    times, values, short = [], {name: [] for name in channels}, []
    are_late = {name: bool(raw.skew or raw.drift) for name, raw in channels.items()}
    for segment in segmented.segments:
        stamps = segmented.times[segment]
        first = float(stamps[0])
        if not interpolate and not any(are_late.values()):
            grid = first + period * np.arange(len(stamps), dtype=float)
        else:
            grid = _common_times(file, stamps, period, channels.values(), None if interpolate else first)
        if len(grid) < MIN_SAMPLES // 2:
            short.append((len(grid), first))
            continue
        for name, raw in channels.items():
            readings, reading_times = raw.values[segment], raw.undo_delay(stamps)
            is_on_grid = not interpolate and not are_late[name] and len(grid) == len(stamps)
            if raw.hold and not (is_on_grid and raw.hold == "zoh"):
                readings = _hold_over_periods(reading_times, readings, grid, period, raw.hold)
            elif not is_on_grid:
                readings = interpolate_spline(reading_times, readings, grid)
            values[name].append(readings)
        times.append(grid)
    if short:
        count, first = max(short)
        text = (
            f"{len(short)} of {len(segmented.segments)} segments: less than {MIN_SAMPLES // 2} samples with these skews "
            f"and this period; the longest of them, from {first:.4g} s on, has {count}"
        )
        if not times:
            raise file.error(f"{text}; a longer part is needed, or a shorter [log] resample")
        # channels may be resampled more than once
        if (note := f"Left out are {text}.") not in file.notes:
            file.note(note)
    segments = slices_between(itertools.accumulate(map(len, times), initial=0))
    return Grid(np.concatenate(times), {name: np.concatenate(pieces) for name, pieces in values.items()}, segments, period)


def _common_times(
    file: LogFile, stamps: np.ndarray, period: float, channels: Iterable[RawChannel], first: float | None
) -> np.ndarray:
    """Return evenly spaced times at which all channels have values, s; on the grid from `first`, unless it is None."""
    begins, ends = np.transpose([raw.undo_delay(stamps[[0, -1]]) for raw in channels])
    begin, end = begins.max(), ends.min()
    if first is not None:
        # the samples of channels without skew lie on this grid
        begin = first + period * math.ceil((begin - first) / period - 1e-6)
    count = math.floor((end - begin) / period + 1e-6) + 1
    if count > _MAX_OVERSAMPLING * len(stamps) + MIN_SAMPLES:
        raise file.error(
            f"a period of {period:g} s makes {count} samples of {len(stamps)}; at least a hundredth of the log's is needed"
        )
    return begin + period * np.arange(count, dtype=float)


def _hold_over_periods(
    stamps: np.ndarray, values: np.ndarray, grid: np.ndarray, period: float, hold: Literal["zoh", "sampled"]
) -> np.ndarray:
    """Return torques to be held over each period of a grid, which move a drive as torques do that `hold` from `stamps` on.

    The last value holds for one more period. Means keep the impulse, and so the velocity that a torque makes.

    A drive's current loop is much faster than its log, so that a sampled torque is neither held between stamps nor a
    straight line, but smooth: a cubic spline. Its means keep the velocity at the samples. Positions there, which is what
    encoders read, need a twelfth of the second difference less: held values w_k move an inertia by (w_k + w_{k-1}) / 2, and
    a torque of frequency f by sinc²(f T) times its value at t_k, which is the same up to the fourth order of f T.
    """
    edges, bounds = np.append(stamps, max(stamps[-1], grid[-1]) + 2.0 * period), np.append(grid, grid[-1] + period)
    if hold == "zoh":
        integral = np.cumsum(np.append(0.0, values * np.diff(edges)))
        return np.diff(np.interp(bounds, edges, integral)) / period
    from scipy.interpolate import CubicSpline

    torque = CubicSpline(edges, np.append(values, values[-1]))
    means = np.diff(torque.antiderivative()(bounds)) / period
    return means - np.diff(means, n=2, prepend=means[0], append=means[-1]) / 12.0
