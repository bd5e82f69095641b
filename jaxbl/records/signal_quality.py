"""Quality of sampled signals: resolution, noise, bandwidth, saturation, jumps."""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

MIN_SAMPLES = 64
"""Samples that a log needs, and a segment that is filtered and regressed: ten for each of six terms of a regression.

Other segments need half as many.
"""


@dataclass(frozen=True)
class ChannelStatistics:
    """Statistics of one measured channel, in SI units.

    Attributes:
        unit: rad, m, N m or N.
        least: smallest value.
        largest: largest value.
        resolution: step between neighbouring values; 0 where they are continuous.
        noise: rms of white noise with the spectral density above a third of the sampling rate; with uneven stamps that of
            the resampled signal, which is a little less.
        bandwidth: frequency, Hz, below which 95 % of the power without noise lies; of the velocity, if it is a position.
        saturated: share of samples at the saturation level, or in flat runs at an extreme value.
        jumps: number of isolated outliers and steps, as dropped counts make them.
        skew: delay of the stamps against the readings, s: theta_s against theta_e, u against the motion that it causes;
            None if the log does not show it.
        skew_error: standard error of `skew`, s.
    """

    unit: str
    least: float
    largest: float
    resolution: float
    noise: float
    bandwidth: float
    saturated: float
    jumps: int
    skew: float | None = None
    skew_error: float | None = None


def find_resolution(values: np.ndarray) -> float:
    """Return the step of which all differences between values are multiples; 0 if there is none."""
    span = np.ptp(values) if len(values) else 0.0
    steps = np.diff(np.unique(values))
    # rounding errors of floating-point arithmetic are not steps
    steps = steps[steps > max(1e-9 * span, 1e-13 * np.abs(values).max(initial=0.0))]
    if len(steps) == 0 or len(steps) > 0.98 * (len(values) - 1):
        return 0.0
    step = np.quantile(steps, 0.02) if len(steps) > 200 else steps.min()
    # the smallest steps first, so that the rounding of large ones is not taken for a remainder
    for limit in (1.5, 10.5, 100.5):
        small_steps = steps[steps < limit * step]
        step = float(small_steps.sum() / max(np.round(small_steps / step).sum(), 1.0))
    remainder = np.abs(steps / step - np.round(steps / step))
    return step if np.mean(remainder[steps < 1000.0 * step] < 0.1) > 0.97 else 0.0


def power_spectrum(values: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the one-sided power spectral density of evenly spaced values, by Welch's method.

    Args:
        values: shape (samples,).
        period: s.

    Returns:
        Frequencies, Hz, without 0, and densities, unit²/Hz.
    """
    from scipy.signal import welch

    # differences first: a slow motion of large range would leak over the whole band
    differences = np.diff(values)
    length = min(max(len(differences) // 4, 16), 4096, len(differences))
    frequency, density = welch(differences, nperseg=length)
    frequency, density = frequency[1:], density[1:]
    return frequency / period, density * period / (4.0 * np.sin(np.pi * frequency) ** 2)


def noise_floor(frequency: np.ndarray, density: np.ndarray) -> float:
    """Return the median density above a third of the sampling rate, unit²/Hz, of a :func:`power_spectrum`."""
    return float(np.median(density[frequency >= 2.0 / 3.0 * frequency[-1]]))


def estimate_white_noise(parts: Sequence[np.ndarray]) -> float:
    """Estimate the standard deviation of white noise on a signal, which may be in several parts.

    Fourth differences remove the smooth part of the signal; their median ignores jumps, which are few.
    """
    fourth = np.concatenate([np.diff(part, n=4) for part in parts])
    return float(np.median(np.abs(fourth)) / 0.6745 / np.sqrt(70.0))


def find_bandwidth(values: np.ndarray, period: float, *, differentiate: bool) -> float:
    """Return the frequency, Hz, below which 95 % of the power above the noise lies; 0 if there is none.

    The power is that of the values, or of their slope (`differentiate`).
    """
    frequency, density = power_spectrum(values, period)
    # steps of the resolution make noise of their own, and not always up to the end of the band
    noise_density = max(noise_floor(frequency, density), find_resolution(values) ** 2 / 6.0 * period)
    # differences of noise leak into the first two frequencies
    threshold = np.where(np.arange(len(density)) < 2, 24.0, 6.0) * noise_density
    power = np.where(density > threshold, density - noise_density, 0.0) * (frequency**2 if differentiate else 1.0)
    if not power.any():
        return 0.0
    cumulative = np.cumsum(power)
    return float(frequency[np.searchsorted(cumulative, 0.95 * cumulative[-1])])


def find_motion_bandwidth(position: np.ndarray, segments: Sequence[slice], period: float) -> float:
    """Return the bandwidth of the velocity, Hz, in the longest segment; 0 if the motion does not exceed the noise."""
    return find_bandwidth(position[longest_segment(segments)], period, differentiate=True)


def find_runs(condition: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return first row, and row behind the last one, of each run of rows that meet a condition, shape (runs,)."""
    edges = np.flatnonzero(np.diff(condition, prepend=False, append=False))
    return edges[::2], edges[1::2]


def saturated_share(values: np.ndarray, step: float) -> float:
    """Return the share of samples in runs of five or more at the least or largest value (within half a `step`)."""
    saturated = 0
    for extreme in (values.min(), values.max()):
        starts, stops = find_runs(np.abs(values - extreme) <= 0.5 * step)
        lengths = (stops - starts)[stops - starts >= 5]
        # a single run may be a rest; a clipped signal comes back to the same value
        if len(lengths) >= 2:
            saturated += int(lengths.sum())
    return saturated / len(values)


def count_jumps(positions: np.ndarray, step: float, stamps: np.ndarray) -> int:
    """Count isolated outliers and steps of a position at `stamps` (s): differences far off their neighbours, and more than
    4.5 `step`."""
    from scipy.ndimage import median_filter, percentile_filter

    intervals = np.diff(stamps)
    differences = np.diff(positions) * (np.median(intervals) / intervals)
    deviation = np.abs(differences - median_filter(differences, 7, mode="nearest"))
    # spread of the motion nearby; the quantiles leave out an outlier or two
    high, low = (percentile_filter(differences, percent, 31, mode="nearest") for percent in (90, 10))
    typical = 1.4826 * np.median(deviation)
    outliers = np.flatnonzero(
        deviation > np.maximum(2.0 * (high - low), max(12.0 * typical, 4.5 * step, 1e-9 * np.ptp(positions)))
    )
    # an outlier spoils two differences
    return int(np.count_nonzero(np.diff(outliers, prepend=-10) > 2))


def low_pass(values: np.ndarray, cutoff: float, period: float) -> np.ndarray:
    """Low-pass values without delay: a second-order Butterworth filter forwards and backwards, `cutoff` in Hz.

    Samples run along the first axis. With a cutoff near the end of the band the values are returned unchanged.
    """
    if 2.0 * cutoff * period > 0.8:
        return values
    from scipy.signal import butter, sosfiltfilt

    padding = min(len(values) - 1, round(2.0 / (cutoff * period)))
    return sosfiltfilt(butter(2, 2.0 * cutoff * period, output="sos"), values, axis=0, padlen=padding)


def trim_filter_ends(samples: int, cutoff: float, period: float) -> slice:
    """Return the samples of a segment without its ends, at which :func:`low_pass` and differences have not settled."""
    margin = min(round(1.0 / (cutoff * period)), samples // 8) + 2
    return slice(margin, samples - margin)


def low_pass_motion(positions: np.ndarray, cutoff: float, period: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return position, velocity and acceleration of a low-passed position, or of several in columns."""
    smooth = low_pass(positions, cutoff, period)
    velocity = np.gradient(smooth, period, axis=0)
    return smooth, velocity, np.gradient(velocity, period, axis=0)


def interpolate_spline(times: np.ndarray, values: np.ndarray, new_times: np.ndarray) -> np.ndarray:
    """Interpolate values to new times by a cubic spline; beyond an end the end's value is returned."""
    from scipy.interpolate import CubicSpline

    return CubicSpline(times, values)(np.clip(new_times, times[0], times[-1]))


def slices_between(edges: Iterable[int]) -> list[slice]:
    """Return the slices from each edge to the next."""
    return [slice(start, stop) for start, stop in itertools.pairwise(edges)]


def segments_before(segments: Sequence[slice], end: int) -> list[slice]:
    """Return the parts of segments before a sample."""
    return [slice(segment.start, min(segment.stop, end)) for segment in segments if segment.start < end]


def count_samples(segment: slice) -> int:
    """Return the number of samples of a segment."""
    return segment.stop - segment.start


def longest_segment(segments: Sequence[slice]) -> slice:
    """Return the longest segment."""
    return max(segments, key=count_samples)


def long_segments(segments: Sequence[slice]) -> list[slice]:
    """Return the segments that are long enough to be filtered and regressed."""
    return [segment for segment in segments if count_samples(segment) >= MIN_SAMPLES]
