"""Channels at their own time stamps become samples at even spacing, moved by their skews."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from .channels import RawChannel
from .files import LogFile
from .signal_quality import MIN_SAMPLES, interpolate_spline
from .time_stamps import SegmentedStamps

_FINEST = 100
"""Samples for each of the log: between its own there is nothing new, and memory ends."""


class Grid(NamedTuple):
    """Evenly spaced samples of all channels.

    Attributes:
        time: s, shape (samples,).
        values: channel -> SI values, shape (samples,).
        segments: contiguous parts.
        period: s.
    """

    time: np.ndarray
    values: dict[str, np.ndarray]
    segments: Sequence[slice]
    period: float


class Delay(NamedTuple):
    """By how much the stamps of a channel are later than its readings: `skew` (s) at time 0, and more by `drift` each s."""

    skew: float = 0.0
    drift: float = 0.0

    def at(self, times: np.ndarray) -> np.ndarray:
        """At times, s; shape (times,)."""
        return self.skew + self.drift * times


def resample_channels(
    file: LogFile,
    segmented: SegmentedStamps,
    channels: Mapping[str, RawChannel],
    period: float,
    delays: Mapping[str, Delay],
    *,
    interpolate: bool,
) -> Grid:
    """All channels on one grid within each segment: positions by cubic splines, a held torque by its means.

    Without `interpolate` the stamps lie on the grid already, so that only delays move values. InputError where a segment
    is too short for period and skews.
    """
    times, values, parts, begin = [], {name: [] for name in channels}, [], 0
    for part in segmented.segments:
        stamps = segmented.times[part]
        first = float(stamps[0])
        if not interpolate and not any(map(any, delays.values())):
            grid = first + period * np.arange(len(stamps), dtype=float)
        else:
            grid = _common_times(file, stamps, period, delays.values(), None if interpolate else first)
        for name, raw in channels.items():
            own = stamps - delays[name].at(stamps)
            if not interpolate and not any(delays[name]) and len(grid) == len(stamps):
                values[name].append(raw.values[part])
            elif raw.held:
                values[name].append(_mean_over_periods(own, raw.values[part], grid, period))
            else:
                values[name].append(interpolate_spline(own, raw.values[part], grid))
        times.append(grid)
        parts.append(slice(begin, begin + len(grid)))
        begin += len(grid)
    return Grid(np.concatenate(times), {name: np.concatenate(v) for name, v in values.items()}, tuple(parts), period)


def _common_times(
    file: LogFile, stamps: np.ndarray, period: float, delays: Iterable[Delay], first: float | None
) -> np.ndarray:
    """Times at which all channels have values, s; on the grid that begins at `first`, if it is given."""
    ends = [stamps[[0, -1]] - delay.at(stamps[[0, -1]]) for delay in delays]
    low, high = max(float(one[0]) for one in ends), min(float(one[1]) for one in ends)
    if first is not None:
        # where the channels without skew have their samples
        low = first + period * math.ceil((low - first) / period - 1e-6)
    count = math.floor((high - low) / period + 1e-6) + 1
    if count > _FINEST * len(stamps) + MIN_SAMPLES:
        raise file.error(
            f"a period of {period:g} s makes {count} samples of {len(stamps)}; at least a hundredth of the log's is needed"
        )
    if count < MIN_SAMPLES // 2:
        raise file.error(
            f"with these skews and this period a segment has {max(count, 0)} samples; at least {MIN_SAMPLES // 2} are needed"
        )
    return low + period * np.arange(count, dtype=float)


def _mean_over_periods(stamps: np.ndarray, values: np.ndarray, grid: np.ndarray, period: float) -> np.ndarray:
    """Means, over each period of a grid, of values that are held from each stamp to the next.

    The last value is held for one more period. Means keep the impulse, and with it the velocity that a torque makes.
    """
    edges = np.append(stamps, max(stamps[-1], grid[-1]) + 2.0 * period)
    integral = np.concatenate([[0.0], np.cumsum(values * np.diff(edges))])
    ends = np.append(grid, grid[-1] + period)
    return np.diff(np.interp(ends, edges, integral)) / period
