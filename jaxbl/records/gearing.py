"""Relation of motor and load position: ratio, skew, lost motion."""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from jaxbl.quantity import Quantity

from .least_squares import BlockRegression, fit_residual, fit_with_jackknife, mean_error, rms
from .lost_motion import LostMotion, fit_lost_motion_by_direction, fit_lost_motion_by_load
from .resampling import Grid
from .rigid_body import smooth_sign
from .signal_quality import (
    MIN_SAMPLES,
    ChannelStatistics,
    find_bandwidth,
    interpolate_spline,
    long_segments,
    longest_segment,
    low_pass,
    low_pass_motion,
    trim_filter_ends,
)

HARMONICS = 8
"""Terms of the cosine series over position: eccentricity and the first harmonics of gear and encoder errors."""
UNRELATED = 0.2
"""Share of the motor's motion that the load's motion does not explain, from which on the two count as unrelated."""
WIDE_TWIST = 0.25
"""Twist over the motor's motion, from which on the load follows the motor only loosely."""
_FLANK_MIXTURES = np.array([(np.cos(angle), np.sin(angle)) for angle in np.radians(range(0, 91, 15))])
"""Mixtures of velocity and acceleration, each over its rms, whose sign may be that of the torque."""


@dataclass(frozen=True)
class Gearing(LostMotion):
    """Motor position as a function of the load's: theta_e = ratio theta_s + constant + half the lost motion by flank.

    Attributes:
        ratio: motor over load motion.
        ratio_error: standard error; with a wide twist, the share of the twist in the motion counts as well.
        skew: delay of the stamps of theta_s against its readings, s, compared with theta_e; None if the log does not show
            it.
        skew_error: standard error.
        residual: rms of the residual, at the motor, over the rms of theta_e about its mean; `twist_residual` likewise.
        twist: range of theta_e - ratio theta_s with the expected ratio, if there is one; at the motor.
        least_twist: range of the twist with the fitted ratio.
        motion: range of theta_e.
    """

    ratio: float
    ratio_error: float
    skew: float | None
    skew_error: float | None
    residual: float
    twist: float
    least_twist: float
    motion: float

    @property
    def is_loose(self) -> bool:
        """True if the twist is a large part of the motion for any ratio, so that the load follows only loosely."""
        return min(self.twist, self.least_twist) > WIDE_TWIST * self.motion

    def describe_lost_motion(self, unit: str) -> str:
        """Describe value, error and interval; for rad also in degrees."""
        low, high = self.lost_motion_interval
        size, degrees = Quantity(self.lost_motion, self.lost_motion_error, unit=unit), ""
        if unit == "rad":
            degrees = f"; {Quantity(math.degrees(self.lost_motion), math.degrees(self.lost_motion_error))}°"
        return f"{size} (95 %: {low:.5g} to {high:.5g}{degrees})"

    def exceeds_noise(self, noise: float) -> bool:
        """Return True if the lost motion exceeds its error and the noise (:func:`twist_noise`)."""
        return self.lost_motion > max(4.0 * self.lost_motion_error, noise)


def fit_gearing(grid: Grid, *, expected: float | None = None, turn: float = math.inf) -> Gearing | None:
    """Regress motor on load position, its velocity, acceleration and flank; None if the motion is too small.

    A delay of the load's stamps adds a part to theta_e that is proportional to the velocity; lost motion adds a part with
    the sign of the transmitted torque. They can be separated if the speed varies. The sign of the torque is that of a
    mixture of velocity (friction) and acceleration (inertia) of the load, the mixture that explains most. Viscous friction
    at the load winds up the shaft in proportion to velocity, too, and cannot be separated from a delay. Errors of encoders
    and gear that repeat with position (eccentricity) are removed by a cosine series over the range of theta_s.

    Lost motion is found with the `expected` ratio, if there is one. Gear and encoders repeat after a `turn` of the load,
    which is infinite on a linear axis.
    """
    period, motor, load = grid.period, grid.values["theta_e"], grid.values["theta_s"]
    usable, width = long_segments(grid.segments), _velocity_bandwidth(grid, "theta_s")
    fit = _fit_with_skew(grid, width) if width and usable else None
    if fit is None:
        return None
    (target, rows, coefficients, errors), skew, has_skew = fit
    # the ratio is that of the whole motion, with the parts that repeat within it
    slopes, slope_errors = _fit_terms(target, rows[:, :4])
    residuals, slope = target - rows[:, :4] @ slopes, float(slopes[0])
    spread = float(np.std(target)) + 1e-300
    residual = _rms(residuals) / spread
    # encoders are not late by many periods, and at a constant speed, to and fro, a delay looks like lost motion
    velocity, flank = rows[:, 1:3].T
    speed = _rms(velocity)
    correlation = abs(velocity @ flank) / (len(rows) * speed * _rms(flank))
    has_skew = has_skew and residual < UNRELATED and abs(skew) < 10.0 * period and correlation < 0.97
    # only a significant skew is undone
    undone_skew = skew if has_skew and abs(skew) > 4.0 * errors[1] / abs(coefficients[0]) else 0.0
    ratio = slope if expected is None else expected
    aligned = [
        interpolate_spline(grid.time[s], load[s], grid.time[s] + undone_skew) if undone_skew else load[s] for s in usable
    ]
    motor_there, load_there = np.concatenate([motor[s] for s in usable]), np.concatenate(aligned)
    twist, least_twist = (float(np.ptp(motor_there - r * load_there)) for r in (ratio, slope))
    motion = float(np.ptp(motor_there))
    is_wide = min(twist, least_twist) > WIDE_TWIST * motion
    # with stick and slip, or a coarse encoder, the load shows its direction no sooner than the motor
    slow = min(width, _velocity_bandwidth(grid, "theta_e") or width)
    lost_motion_fit = _fit_lost_motion(grid, aligned, 4.0 * slow, ratio, turn, is_wide=is_wide)
    if lost_motion_fit is None:
        # no flank is in contact for long: the rough regression has to do
        lost_motion_fit = LostMotion.from_motion(
            float(2.0 * coefficients[2] * np.sign(coefficients[0])), 2.0 * float(errors[2])
        )
    # the crossing of the gap is not modelled: an error of 0.5 % of the gap, by motions of several frequencies
    skew_error = float(np.hypot(errors[1], 0.005 * lost_motion_fit.lost_motion / speed) / abs(coefficients[0]))
    # with a gap as large as the motion a delay cannot be found
    has_skew = has_skew and not is_wide
    return Gearing(
        **vars(replace(lost_motion_fit, twist_residual=lost_motion_fit.twist_residual / spread)),
        ratio=slope,
        ratio_error=float(np.hypot(slope_errors[0], slope * least_twist / motion if is_wide else 0.0)),
        skew=skew if has_skew else None,
        skew_error=skew_error if has_skew else None,
        residual=residual,
        twist=twist,
        least_twist=least_twist,
        motion=motion,
    )


_MotorFit = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Results of :func:`_regress_motor`."""


def _fit_with_skew(grid: Grid, width: float) -> tuple[_MotorFit, float, bool] | None:
    """Repeat :func:`_regress_motor` until the skew of the load converges.

    Returns:
        Its results, the skew, and True if there is one.
    """
    skew, first, fit = 0.0, None, None
    # converges quadratically: five steps are ample
    for _ in range(5):
        fit = _regress_motor(grid, 4.0 * width, skew)
        if fit is None:
            return None
        first = first or fit
        step = float(fit[2][1] / fit[2][0])
        if abs(step) < 1e-3 * grid.period:
            break
        skew += step
        # a quarter of the fastest period: a load that moves on its own, no delay of an encoder
        if abs(skew) > 0.25 / width:
            return first, 0.0, False
    assert fit is not None
    return fit, skew, True


class Drift(NamedTuple):
    """Growth of the skew of theta_s against theta_e over a log.

    Attributes:
        value: s/s.
        error: standard error.
        reach: change of the skew over half of the log, s.
    """

    value: float
    error: float
    reach: float


_FOLDS = 10
"""Blocks of the log, each left out in turn, on which a drift has to predict better."""


def fit_drift(grid: Grid, skew: float) -> Drift | None:
    """Fit a drift of the load's stamps; None if it predicts parts left out of the log no better than the constant `skew`.

    The log is one that :func:`fit_gearing` can fit.
    """
    period = grid.period
    width = _velocity_bandwidth(grid, "theta_s")
    constant = _regress_motor(grid, 4.0 * width, skew)
    if constant is None:
        return None
    drift, fit, error, reach = 0.0, constant, np.inf, 0.0
    half = 0.5 * (grid.time[-1] - grid.time[0])
    # converges quadratically, as the skew does
    for _ in range(6):
        fit = _regress_motor(grid, 4.0 * width, skew, drift)
        if fit is None:
            return None
        *_, values, errors = fit
        step, drift_step, error = (float(x / values[0]) for x in (values[1], values[-1], errors[-1]))
        skew, drift = skew + step, drift + drift_step
        reach = abs(drift) * half
        if not reach <= 0.5 / width:
            return None
        if abs(step) + abs(drift_step) * half < 1e-3 * period:
            break
    # of what a fit leaves, since squares of a position hide those of its errors
    before, after = (
        BlockRegression.of(target - rows @ values, rows, _FOLDS).held_out() for target, rows, values, _ in (constant, fit)
    )
    gains = np.log(before / after)
    better = np.mean(gains) > 2.0 * mean_error(gains)
    if not better or abs(drift) < 6.0 * abs(error) or reach < 0.05 * period:
        return None
    return Drift(drift, abs(error), reach)


def _velocity_bandwidth(grid: Grid, channel: str) -> float:
    """Return the bandwidth of a velocity, Hz; for motion too slow for a spectrum, ten over its duration."""
    positions, period = grid.values[channel][longest_segment(grid.segments)], grid.period
    width = find_bandwidth(positions, period, differentiate=True)
    slow = 10.0 / (len(positions) * period)
    if width or len(positions) < MIN_SAMPLES:
        return width
    fast = positions - low_pass(positions, 4.0 * slow, period)
    return slow if np.std(fast) < 0.03 * np.ptp(positions) else 0.0


def _fit_terms(target: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit like :func:`fit_with_jackknife`; without the velocity, in column 1, if it is proportional to the flank."""
    coefficients, errors = fit_with_jackknife(target, rows)
    if np.isfinite(coefficients).all():
        return coefficients, errors
    coefficients, errors = fit_with_jackknife(target, np.delete(rows, 1, axis=1))
    return np.insert(coefficients, 1, 0.0), np.insert(errors, 1, np.inf)


def _fit_lost_motion(
    grid: Grid, aligned: list[np.ndarray], cutoff: float, ratio: float, turn: float, *, is_wide: bool
) -> LostMotion | None:
    """Fit the lost motion by the direction of motion, or by changes of the sign of the load torque.

    `aligned` is theta_s without its skew, of each long segment; `cutoff` is that of the low-pass before differentiation, Hz.
    If the twist `is_wide`, a large part of the motion, errors that repeat with position cannot be separated.
    """
    from scipy.ndimage import minimum_filter1d

    period, parts = grid.period, []
    for s, load in zip(long_segments(grid.segments), aligned, strict=True):
        motion = low_pass_motion(load, cutoff, period)
        signals = np.stack([grid.time[s], grid.values["theta_e"][s] - ratio * load, *motion])
        parts.append(signals[:, trim_filter_ends(len(load), cutoff, period)])
    time, twist, position, velocity, acceleration = np.concatenate(parts, axis=1)
    ends = np.cumsum([part.shape[1] for part in parts])[:-1]
    rows = [np.ones_like(position), velocity, acceleration]
    if not is_wide:
        way, span = position - position.min(), np.ptp(position)
        repeats = span > 1.5 * turn
        phases = _count_phases(way * (2.0 * np.pi / turn if repeats else np.pi / span))
        rows += [way, np.cos(phases), *([np.sin(phases)] if repeats else [])]
    terms = np.column_stack(rows)
    # the filter reacts to a corner of the motion within this time
    guard = round(0.5 / (cutoff * period))

    def list_flanks() -> Flanks:
        for mixture in _FLANK_MIXTURES / (_rms(velocity), _rms(acceleration)):
            flank = mixture @ (velocity, acceleration)
            is_clear = np.abs(flank) > 0.3
            if np.mean(is_clear) >= 0.25:
                pieces = [minimum_filter1d(piece, 2 * guard + 1, mode="nearest") for piece in np.split(is_clear, ends)]
                yield np.sign(flank), np.concatenate(pieces)

    best = find_flank(twist, terms, list_flanks())
    if best is None:
        return None if is_wide else fit_lost_motion_by_load(time, twist, position, velocity, turn)
    flank, is_clear = best
    fit_by_direction = partial(fit_lost_motion_by_direction, twist, flank=flank, is_clear=is_clear)
    fit = fit_by_direction(terms)
    if is_wide:
        # the wind-up of the shaft is part of this shift, and its share is unknown in so few cycles
        constant_fit = fit_by_direction(terms[:, :1])
        return fit.enclose(constant_fit) if fit and constant_fit else fit
    if fit is None or fit.lost_motion_error > 0.25 * abs(fit.lost_motion):
        # at a constant speed, delays and wind-up look like lost motion: a delay is assumed to be at most a period
        other = fit_by_direction(np.delete(terms, 1, axis=1), other_error=ratio * period * _rms(velocity))
        if other is not None and (fit is None or other.lost_motion_error < 0.5 * fit.lost_motion_error):
            fit = other
    if fit is not None and fit.twist_residual < 0.25 * abs(fit.lost_motion):
        return fit
    # flanks by the direction of motion explain little: the load may change them
    return fit_lost_motion_by_load(time, twist, position, velocity, turn) or fit


def _rms(values: np.ndarray) -> float:
    """Return the root mean square, which is never zero here, so that it can be a divisor."""
    return rms(values) + 1e-300


def _count_phases(place: np.ndarray) -> np.ndarray:
    """Return the phases, rad, of all harmonics at a phase of the first one, shape (samples, HARMONICS)."""
    return np.outer(place, np.arange(1, HARMONICS + 1))


Flanks = Iterator[tuple[np.ndarray, np.ndarray]]
"""Pairs of a column that tells the flank and whether one is surely in contact, shape (samples,) each."""


def find_flank(target: np.ndarray, terms: np.ndarray, flanks: Flanks) -> tuple[np.ndarray, np.ndarray] | None:
    """Find the flanks that explain most of a target beside other terms; None if too few samples are clear of the gap."""
    best = None
    for flank, is_clear in flanks:
        sample = np.flatnonzero(is_clear)[:: max(is_clear.sum() // 20_000, 1)]
        if len(sample) >= 3 * terms.shape[1] and is_clear.sum() >= 0.1 * len(is_clear):
            residual = rms(fit_residual(target[sample], np.column_stack([flank[sample], terms[sample]])))
            if best is None or residual < best[0]:
                best = residual, flank, is_clear
    return None if best is None else best[1:]


def twist_noise(ratio: float, channels: Mapping[str, ChannelStatistics]) -> float:
    """Return the rms noise and resolution of both encoders together, or of one, at the motor, in their unit."""
    encoders = [(factor, channels[name]) for name, factor in (("theta_e", 1.0), ("theta_s", ratio)) if name in channels]
    sizes = [(factor * encoder.noise, factor * encoder.resolution / 12.0**0.5) for factor, encoder in encoders]
    return float(np.linalg.norm(sizes))


def _regress_motor(grid: Grid, cutoff: float, skew: float, drift: float | None = None) -> _MotorFit | None:
    """Regress motor on load position for :func:`fit_gearing`, at a skew (s) and a drift (s/s) about the middle of the log.

    Returns:
        Motor positions, shape (rows,). Terms, shape (rows, terms): position, velocity, flank, 1, acceleration, HARMONICS
        terms of the series, and with a `drift` velocity times time. Coefficients and standard errors, shape (terms,).
    """
    period, load = grid.period, grid.values["theta_s"]
    middle = 0.5 * (grid.time[0] + grid.time[-1])
    parts = []
    for s in long_segments(grid.segments):
        times, offset = grid.time[s], grid.time[s] - middle
        moved = interpolate_spline(times, load[s], times + skew + (drift or 0.0) * offset)
        motor = low_pass(grid.values["theta_e"][s], cutoff, period)
        parts.append(np.stack([motor, offset, *low_pass_motion(moved, cutoff, period)]))

    def join_segments(signals: Iterable[np.ndarray]) -> np.ndarray:
        """Join signals of the segments, samples last, without the ends of each."""
        inner = [signal[..., trim_filter_ends(signal.shape[-1], cutoff, period)] for signal in signals]
        return np.concatenate(inner, axis=-1)

    target, offset, position, velocity, acceleration = join_segments(parts)
    way = position - load.min()
    series = np.cos(_count_phases(np.pi * way / np.ptp(load)))
    rows = np.column_stack([way, velocity, np.ones_like(way), acceleration, series])

    def list_flanks() -> Flanks:
        for mixture in _FLANK_MIXTURES / (_rms(velocity), _rms(acceleration)):
            mixed = [mixture @ part[3:] for part in parts]
            # between the flanks the twist may have any value in the gap
            is_clear = np.abs(join_segments(mixed)) > 0.3
            if np.mean(is_clear) >= 0.25:
                yield join_segments(low_pass(smooth_sign(m), cutoff, period) for m in mixed), is_clear

    best = find_flank(target, rows, list_flanks())
    if best is None:
        return None
    flank, is_clear = best
    drifting = [] if drift is None else [velocity * offset]
    rows, target = np.column_stack([rows[:, :2], flank, rows[:, 2:], *drifting])[is_clear], target[is_clear]
    coefficients, errors = _fit_terms(target, rows)
    if not np.isfinite(coefficients).all() or coefficients[0] == 0.0:
        return None
    return target, rows, coefficients, errors
