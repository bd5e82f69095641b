"""What the samples of a log say about the log itself: stamps, resolution, noise, saturation, jumps, skew."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Slices = Sequence[slice]


@dataclass(frozen=True)
class Sampling:
    """The time stamps of a log.

    Attributes:
        samples: rows that were read.
        median_period: median of the intervals, s.
        jitter: rms deviation of the stamps from an even grid, s.
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


@dataclass(frozen=True)
class Channel:
    """One measured channel, in SI units.

    Attributes:
        unit: rad, m, N m or N.
        least: smallest value.
        largest: largest value.
        resolution: step between neighbouring values; 0 where there is none to be seen.
        noise: rms of a white noise with the spectral density found above a third of the sampling rate; of uneven stamps
            that of the resampled signal, which is a little less.
        bandwidth: frequency in Hz below which 95 % of the power lies (of a position: of its velocity's), noise left out.
        saturated: share of samples at the saturation level, or in stays at an extreme value.
        jumps: isolated outliers and steps, as of dropped counts.
        skew: by how much the stamps are later than the readings, s: of theta_s against theta_e, of u against the motion
            that it makes; None where it cannot be told.
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


GAP = 3.5
"""Intervals longer than this many periods are gaps."""


def even_grid(stamps: Array) -> tuple[bool, float, float, float]:
    """Whether stamps lie on an even grid.

    Args:
        stamps: increasing times, shape (samples,), s.

    Returns:
        Whether they do; the period in s and the first stamp of the grid that fits best, s; rms deviation from it, s.
    """
    index = np.arange(len(stamps)) - 0.5 * (len(stamps) - 1)
    middle = stamps.mean()
    period = float(index @ (stamps - middle) / (index @ index))
    deviation = stamps - middle - period * index
    largest = float(np.abs(deviation).max())
    # stamps that were rounded, say to milliseconds, are off by up to half a step
    rounding = resolution(np.diff(stamps))
    even = largest <= 0.02 * period or largest <= 0.55 * min(rounding, 20.0 * period)
    return even, period, float(middle + period * index[0]), float(np.sqrt(np.mean(deviation**2)))


def resolution(values: Array) -> float:
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


def spectrum(values: Array, period: float, *, slope: bool = False) -> tuple[Array, Array]:
    """One-sided power spectral density by Welch's method, of the values or of their slope.

    Args:
        values: shape (samples,), evenly spaced.
        period: s.
        slope: of the rate of change.

    Returns:
        Frequencies in Hz without 0, and densities in unit²/Hz; (unit/s)²/Hz of the slope.
    """
    from scipy.signal import welch

    # differences first: a slow motion of large range would leak over the whole band
    differences = np.diff(values)
    length = min(max(len(differences) // 4, 16), 4096, len(differences))
    frequency, density = welch(differences, fs=1.0, nperseg=length, detrend="constant")
    frequency, density = frequency[1:], density[1:]
    density = density * period / (4.0 * np.sin(np.pi * frequency) ** 2)
    frequency = frequency / period
    return frequency, density * (2.0 * np.pi * frequency) ** 2 if slope else density


def noise_floor(frequency: Array, density: Array) -> float:
    """Median density above a third of the sampling rate, unit²/Hz, from :func:`spectrum`."""
    return float(np.median(density[frequency >= 2.0 / 3.0 * frequency[-1]]))


def bandwidth(values: Array, period: float, *, slope: bool) -> float:
    """Frequency in Hz below which 95 % of the power that stands out of the noise lies; 0 where none does.

    Args:
        values: shape (samples,), evenly spaced.
        period: s.
        slope: of the rate of change (a position's velocity).
    """
    frequency, density = spectrum(values, period)
    # steps of the resolution make noise of their own, and not always up to the end of the band
    floor = max(noise_floor(frequency, density), resolution(values) ** 2 / 6.0 * period)
    # differences of noise leak into the first two frequencies
    clear = np.where(np.arange(len(density)) < 2, 24.0, 6.0) * floor
    power = np.where(density > clear, density - floor, 0.0) * (frequency**2 if slope else 1.0)
    if not power.any():
        return 0.0
    total = np.cumsum(power)
    return float(frequency[np.searchsorted(total, 0.95 * total[-1])])


def stays(values: Array, step: float) -> float:
    """Share of samples in stays of five or more at the least or the largest value (within half a `step`)."""
    if np.ptp(values) == 0.0:
        return 0.0
    share = 0
    for extreme in (values.min(), values.max()):
        at = np.concatenate([[False], np.abs(values - extreme) <= 0.5 * step, [False]])
        starts, ends = np.flatnonzero(np.diff(at.astype(int)) == 1), np.flatnonzero(np.diff(at.astype(int)) == -1)
        lengths = ends - starts
        # one stay may be a rest; a signal that is cut off comes back to the same value
        if np.count_nonzero(lengths >= 5) >= 2:
            share += int(lengths[lengths >= 5].sum())
    return share / len(values)


def jumps(positions: Array, step: float, stamps: Array | None = None) -> int:
    """Isolated outliers and steps of a position: differences far off those around them.

    Args:
        positions: shape (samples,).
        step: resolution, of which motion leaves differences of a few.
        stamps: times of the positions, s, shape (samples,); left out: evenly spaced.
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


def low_passed(values: Array, cutoff: float, period: float) -> Array:
    """Values without what is above a frequency, without delay: 2nd-order Butterworth forwards and backwards.

    Args:
        values: shape (samples,) or (samples, columns), evenly spaced.
        cutoff: Hz; values are left as they are where it is near the end of the band.
        period: s.
    """
    from scipy.signal import butter, sosfiltfilt

    if 2.0 * cutoff * period > 0.8:
        return values
    sections = butter(2, 2.0 * cutoff * period, output="sos")
    return sosfiltfilt(sections, values, axis=0, padlen=min(len(values) - 1, round(2.0 / (cutoff * period))))


BLOCKS = 12
SHORTEST = 64
"""Samples that a log needs, as does a segment to be filtered and regressed; others need half as many."""


def jackknifed(target: Array, regressors: Array) -> tuple[Array, Array]:
    """Least squares with standard errors that hold for residuals of any correlation in time.

    Args:
        target: shape (samples,).
        regressors: shape (samples, terms).

    Returns:
        Coefficients and standard errors (delete-a-block jackknife), shape (terms,) each; nan where undetermined.
    """
    scale = np.sqrt(np.mean(regressors**2, axis=0))
    scale[scale == 0.0] = 1.0
    scaled = regressors / scale
    blocks = np.array_split(np.arange(len(target)), BLOCKS)
    grams = np.array([scaled[b].T @ scaled[b] for b in blocks])
    moments = np.array([scaled[b].T @ target[b] for b in blocks])
    gram, moment = grams.sum(axis=0), moments.sum(axis=0)
    if np.linalg.cond(gram) > 1e13:
        return np.full(len(scale), np.nan), np.full(len(scale), np.nan)
    best = np.linalg.solve(gram, moment)
    without = np.array([np.linalg.lstsq(gram - g, moment - m, rcond=1e-12)[0] for g, m in zip(grams, moments, strict=True)])
    count = len(without)
    error = np.sqrt((count - 1) / count * ((without - without.mean(axis=0)) ** 2).sum(axis=0))
    return best / scale, error / scale


@dataclass(frozen=True)
class Dynamics:
    """A rough rigid-drive regression of the torque, to judge a log by; no identification.

    The terms are acceleration, velocity, its sign, position and a constant.

    Attributes:
        names: of the terms.
        values: coefficients, SI units, shape (terms,).
        errors: their standard errors, shape (terms,).
        inflation: how often the variance of each is what it would be if its term were unlike all others, shape (terms,).
        shares: rms of each term over that of the torque, shape (terms,).
        skew: by how much the stamps of u are later than the torque, s.
        skew_error: standard error.
        residual: rms of what is left over the rms of the torque about its mean.
    """

    names: tuple[str, ...]
    values: Array
    errors: Array
    inflation: Array
    shares: Array
    skew: float
    skew_error: float
    residual: float


def direction_of(velocity: Array) -> Array:
    """+1 or -1 where it moves, between them where it hardly does."""
    return velocity / np.hypot(velocity, 0.02 * np.sqrt(np.mean(velocity**2)) + 1e-300)


def dynamics(times: Array, torque: Array, position: Array, segments: Slices, period: float) -> Dynamics | None:
    """Regress torque on the motion of one encoder; None where there is too little motion.

    Args:
        times: shape (samples,), s.
        torque: held from each stamp to the next, shape (samples,).
        position: shape (samples,).
        segments: contiguous parts.
        period: s.
    """
    longest = max(segments, key=lambda s: s.stop - s.start)
    width = bandwidth(position[longest], period, slope=True)
    if width == 0.0 or np.ptp(torque) == 0.0:
        return None
    cutoff = 3.0 * width
    targets, all_rows = [], []
    for s in segments:
        if s.stop - s.start < SHORTEST:
            continue
        smooth = low_passed(position[s], cutoff, period)
        velocity = np.gradient(smooth, period)
        acceleration = np.gradient(velocity, period)
        direction = low_passed(direction_of(velocity), cutoff, period)
        held = low_passed(torque[s], cutoff, period)
        edge = min(round(1.0 / (cutoff * period)), len(smooth) // 8) + 2
        cut = slice(edge, len(smooth) - edge)
        columns = [acceleration, velocity, direction, smooth, np.ones_like(smooth), -np.gradient(held, period)]
        all_rows.append(np.stack(columns, axis=1)[cut])
        targets.append(held[cut])
    if not targets:
        return None
    target, rows = np.concatenate(targets), np.concatenate(all_rows)
    if np.ptp(target) == 0.0:
        return None
    found, errors = jackknifed(target, rows)
    if not np.isfinite(found).all():
        # terms that are the same but for a factor
        found, errors = np.zeros(6), np.full(6, np.inf)
    terms = rows[:, :5]
    centred = terms[:, :4] - terms[:, :4].mean(axis=0)
    spread = np.sqrt(np.mean(centred**2, axis=0))
    inflation = np.full(5, np.inf)
    if np.isfinite(errors).all() and (spread > 0.0).all():
        inflation = np.append(np.diag(np.linalg.inv(np.corrcoef(centred.T))), 1.0)
    left = target - rows @ found
    return Dynamics(
        names=("inertia", "viscous", "coulomb", "spring", "constant"),
        values=found[:5],
        errors=errors[:5],
        inflation=inflation,
        shares=np.abs(found[:5]) * np.sqrt(np.mean(terms**2, axis=0)) / np.sqrt(np.mean(target**2)),
        # a torque that is held for a period acts half a period after its stamp
        skew=float(found[5]) + 0.5 * period,
        skew_error=float(errors[5]),
        residual=float(np.std(left) / np.std(target)),
    )
