"""Quality of sampled signals: resolution, noise, bandwidth, saturation, jumps."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .linear_filters import butterworth_coefficients, filter_both_ways, welch_spectrum

MIN_SAMPLES = 64
"""Samples that a log needs, and a segment to be filtered and regressed: ten samples for each of six terms of a regression.

Other segments need half as many.
"""


@dataclass(frozen=True)
class ChannelStatistics:
    """Figures on one measured channel, in SI units.

    Attributes:
        unit: rad, m, N m or N.
        least: smallest value.
        largest: largest value.
        resolution: step between neighbouring values; 0 where they are continuous.
        noise: rms of a white noise with the spectral density found above a third of the sampling rate; of uneven stamps
            that of the resampled signal, which is a little less.
        bandwidth: frequency in Hz below which 95 % of the power lies (of a position: of its velocity's), noise left out.
        saturated: share of samples at the saturation level, or in stays at an extreme value.
        jumps: isolated outliers and steps, as of dropped counts.
        skew: by how much the stamps are later than the readings, s: of theta_s against theta_e, of u against the motion
            that it makes; None where the log does not show it.
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


def measure_channel(
    values: np.ndarray,
    period: float,
    parts: Sequence[np.ndarray],
    stamps: Sequence[np.ndarray] | None,
    *,
    unit: str,
    is_position: bool,
    saturated: float,
) -> ChannelStatistics:
    """Figures on a channel.

    Noise and bandwidth are those of `values`, its longest segment at even spacing; all else is that of the `parts` between
    gaps, with `stamps` (s) where these are uneven. `saturated` is the share of samples at a known saturation level.
    """
    every = np.concatenate(parts)
    step = find_resolution(every)
    frequency, density = power_spectrum(values, period)
    found = sum(map(count_jumps, parts, [step] * len(parts), stamps or [None] * len(parts))) if is_position else 0
    return ChannelStatistics(
        unit=unit,
        least=float(every.min()),
        largest=float(every.max()),
        resolution=step,
        noise=float(np.sqrt(noise_floor(frequency, density) * 0.5 / period)),
        bandwidth=find_bandwidth(values, period, differentiate=is_position) if np.ptp(values) else 0.0,
        saturated=saturated or (0.0 if is_position else saturated_share(every, step)),
        jumps=found,
    )


def find_resolution(values: np.ndarray) -> float:
    """Step of which all differences between values are multiples; 0 where there is none."""
    span = float(np.ptp(values)) if len(values) else 0.0
    steps = np.diff(np.unique(values))
    # what is left of arithmetic in floating point is no step
    steps = steps[steps > max(1e-9 * span, 1e-13 * float(np.abs(values).max(initial=0.0)))]
    if len(steps) == 0 or len(steps) > 0.98 * (len(values) - 1):
        return 0.0
    step = float(np.quantile(steps, 0.02)) if len(steps) > 200 else float(steps.min())
    # the smallest steps first, so that the rounding of large ones is not taken for a remainder
    for most in (1.5, 10.5, 100.5):
        few = steps[steps < most * step]
        step = float(few.sum() / max(np.round(few / step).sum(), 1.0))
    remainder = np.abs(steps / step - np.round(steps / step))
    return step if np.mean(remainder[steps < 1000.0 * step] < 0.1) > 0.97 else 0.0


def power_spectrum(values: np.ndarray, period: float, *, differentiate: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """One-sided power spectral density of evenly spaced values, or of their slope, by Welch's method.

    Frequencies in Hz without 0, and densities in unit²/Hz; (unit/s)²/Hz of the slope.
    """
    # differences first: a slow motion of large range would leak over the whole band
    differences = np.diff(values)
    length = min(max(len(differences) // 4, 16), 4096, len(differences))
    frequency, density = welch_spectrum(differences, length)
    frequency, density = frequency[1:], density[1:]
    density = density * period / (4.0 * np.sin(np.pi * frequency) ** 2)
    frequency = frequency / period
    return frequency, density * (2.0 * np.pi * frequency) ** 2 if differentiate else density


def noise_floor(frequency: np.ndarray, density: np.ndarray) -> float:
    """Median density above a third of the sampling rate, unit²/Hz, from :func:`power_spectrum`."""
    return float(np.median(density[frequency >= 2.0 / 3.0 * frequency[-1]]))


def estimate_white_noise(parts: Sequence[np.ndarray]) -> float:
    """Estimate the standard deviation of white noise on a signal, which may be in several parts.

    Fourth differences hold nothing of what is smooth, and their median nothing of jumps, of which there are few.
    """
    fourth = np.concatenate([np.diff(part, n=4) for part in parts])
    return float(np.median(np.abs(fourth)) / 0.6745 / np.sqrt(70.0))


def find_bandwidth(values: np.ndarray, period: float, *, differentiate: bool) -> float:
    """Frequency in Hz below which 95 % of the power lies that stands out of the noise, of values or their slope; 0: none."""
    frequency, density = power_spectrum(values, period)
    # steps of the resolution make noise of their own, and not always up to the end of the band
    floor = max(noise_floor(frequency, density), find_resolution(values) ** 2 / 6.0 * period)
    # differences of noise leak into the first two frequencies
    clear = np.where(np.arange(len(density)) < 2, 24.0, 6.0) * floor
    power = np.where(density > clear, density - floor, 0.0) * (frequency**2 if differentiate else 1.0)
    if not power.any():
        return 0.0
    total = np.cumsum(power)
    return float(frequency[np.searchsorted(total, 0.95 * total[-1])])


def saturated_share(values: np.ndarray, step: float) -> float:
    """Share of samples in stays of five or more at the least or the largest value (within half a `step`)."""
    if np.ptp(values) == 0.0:
        return 0.0
    share = 0
    for extreme in (values.min(), values.max()):
        at = np.concatenate([[False], np.abs(values - extreme) <= 0.5 * step, [False]])
        lengths = np.diff(np.flatnonzero(np.diff(at)))[::2]
        # one stay may be a rest; a signal that is cut off comes back to the same value
        if np.count_nonzero(lengths >= 5) >= 2:
            share += int(lengths[lengths >= 5].sum())
    return share / len(values)


def count_jumps(positions: np.ndarray, step: float, stamps: np.ndarray | None = None) -> int:
    """Isolated outliers and steps of a position: differences far off those around them, and more than a few steps.

    Positions without time stamps (s) are evenly spaced.
    """
    from scipy.ndimage import median_filter, percentile_filter

    differences = np.diff(positions)
    if stamps is not None:
        intervals = np.diff(stamps)
        differences = differences * (np.median(intervals) / intervals)
    odd = np.abs(differences - median_filter(differences, 7, mode="nearest"))
    # what the motion itself does nearby, an outlier or two left out
    nearby = percentile_filter(differences, 90, 31, mode="nearest") - percentile_filter(differences, 10, 31, mode="nearest")
    usual = 1.4826 * float(np.median(odd))
    at = np.flatnonzero(odd > np.maximum(2.0 * nearby, max(12.0 * usual, 4.5 * step, 1e-9 * float(np.ptp(positions)))))
    # an outlier makes two differences odd
    return int(np.count_nonzero(np.diff(at, prepend=-10) > 2))


def low_pass(values: np.ndarray, cutoff: float, period: float) -> np.ndarray:
    """Values without what is above a frequency (Hz), without delay: 2nd-order Butterworth forwards and backwards.

    Samples run along the first axis. Where the cutoff is near the end of the band, values stay as they are.
    """
    if 2.0 * cutoff * period > 0.8:
        return values
    return filter_both_ways(
        values, *butterworth_coefficients(2.0 * cutoff * period), min(len(values) - 1, round(2.0 / (cutoff * period)))
    )


def trim_filter_ends(samples: int, cutoff: float, period: float) -> slice:
    """The samples of a segment without its ends, where :func:`low_pass` and differences have not settled."""
    edge = min(round(1.0 / (cutoff * period)), samples // 8) + 2
    return slice(edge, samples - edge)


def interpolate_spline(times: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Values at other times by a cubic spline; beyond the ends the value at the end."""
    from scipy.interpolate import CubicSpline

    return CubicSpline(times, values)(np.clip(at, times[0], times[-1]))


def longest_segment(segments: Sequence[slice]) -> slice:
    """The longest segment."""
    return max(segments, key=lambda s: s.stop - s.start)
