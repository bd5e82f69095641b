"""Motor against load position: ratio, skew, lost motion."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from . import lost_motion
from .least_squares import fit_with_jackknife
from .lost_motion import LostMotion
from .rigid_body import smooth_sign
from .signal_quality import (
    MIN_SAMPLES,
    ChannelStatistics,
    find_bandwidth,
    interpolate_spline,
    longest_segment,
    low_pass,
    trim_filter_ends,
)

HARMONICS = 8
"""Terms of the cosine series over position: eccentricity and the first harmonics of gear and encoder errors."""
UNRELATED = 0.2
"""Share of the motor's motion that the load's leaves unexplained, beyond which the two count as unrelated."""
WIDE_TWIST = 0.25
"""Share of the motor's motion that the twist takes, beyond which the load follows the motor only loosely."""
_MIXTURES = np.radians([0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 90.0])
"""Mixtures of velocity and acceleration, each over its rms, whose sign is tried as that of the transmitted torque."""


@dataclass(frozen=True)
class Gearing(LostMotion):
    """Motor position as a function of the load's: theta_e = ratio theta_s + constant + half the lost motion by flank.

    Attributes:
        ratio: motor over load motion.
        ratio_error: standard error; beside a twist as large as the motion it takes that share of the ratio.
        skew: by how much the stamps of theta_s are later than its readings, s, against those of theta_e; None where the
            log does not show it.
        skew_error: standard error.
        residual: rms of the residual, at the motor, over the rms of theta_e about its mean; so is `twist_residual`.
        twist: range of theta_e - ratio theta_s, with the ratio that is expected, if one is; at the motor.
        least_twist: range of the twist with the ratio that was found.
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
        """Whether the twist is a large part of the motion whatever the ratio, so that the load follows only loosely."""
        return min(self.twist, self.least_twist) > WIDE_TWIST * self.motion

    def describe_lost_motion(self, unit: str) -> str:
        """Value, error and interval; in degrees as well."""
        low, high = self.lost_motion_interval
        digits = _decimals(self.lost_motion_error)
        text = f"{self.lost_motion:.{digits}f} ± {self.lost_motion_error:.{digits}f} {unit}"
        text += f" (95 %: {low:.{digits}f} to {high:.{digits}f}"
        if unit == "rad":
            value, error = np.degrees(self.lost_motion), np.degrees(self.lost_motion_error)
            digits = _decimals(error)
            text += f"; {value:.{digits}f} ± {error:.{digits}f}°"
        return f"{text})"

    def exceeds_noise(self, noise: float) -> bool:
        """Whether the lost motion is more than its error and the noise (:func:`twist_noise`)."""
        return self.lost_motion > max(4.0 * self.lost_motion_error, noise)


def _decimals(error: float) -> int:
    """Decimals that show two digits of an error."""
    return int(np.clip(1 - np.floor(np.log10(error)), 0, 9)) if 0.0 < error < np.inf else 6


def fit_gearing(
    times: np.ndarray,
    motor: np.ndarray,
    load: np.ndarray,
    segments: Sequence[slice],
    period: float,
    *,
    expected: float | None = None,
    turn: float | None = None,
) -> Gearing | None:
    """Regress motor on load position, its velocity, acceleration and flank; None where the motion is too small.

    A delay of the load's stamps adds to theta_e what is proportional to the velocity, lost motion what has the sign of the
    transmitted torque; so they can be separated wherever the speed varies. That sign is taken as the sign of a mixture of
    velocity (friction) and acceleration (inertia) of the load, the one that explains most. Viscous friction at the load
    winds up the shaft in proportion to velocity too, and cannot be separated from a delay. Errors of the encoders and the
    gear that repeat with position (eccentricity) are removed from both by a cosine series over the range of theta_s.

    Lost motion is found with the ratio that is `expected`, if one is. Gear and encoders repeat after a `turn` of the load;
    None on a linear axis.
    """
    part = longest_segment(segments)
    width = _velocity_bandwidth(load[part], period)
    usable = [s for s in segments if s.stop - s.start >= MIN_SAMPLES]
    fit = _fit_with_skew(times, motor, load, usable, period, width) if width and usable else None
    if fit is None:
        return None
    target, rows, found, errors, skew, known = fit
    # the ratio is that of the whole motion, whatever repeats within it
    slopes, slope_errors = _fit_terms(target, rows[:, :4])
    if not np.isfinite(slopes).all():
        return None
    left, slope = target - rows[:, :4] @ slopes, float(slopes[0])
    spread = float(np.std(target))
    residual = _rms(left) / spread if spread else np.inf
    # encoders are not late by many periods; and at one speed, to and fro, a delay looks like lost motion
    alike = abs(float(rows[:, 1] @ rows[:, 2])) / float(np.linalg.norm(rows[:, 1]) * np.linalg.norm(rows[:, 2]) + 1e-300)
    known = known and residual < UNRELATED and abs(skew) < 10.0 * period and alike < 0.97
    # only a significant skew is undone
    undone = skew if known and abs(skew) > 4.0 * errors[1] / abs(found[0]) else 0.0
    ratio = slope if expected is None else expected
    aligned = [interpolate_spline(times[s], load[s], times[s] + undone) if undone else load[s] for s in usable]
    motor_there, load_there = np.concatenate([motor[s] for s in usable]), np.concatenate(aligned)
    twist, least = (float(np.ptp(motor_there - r * load_there)) for r in (ratio, slope))
    motion = float(np.ptp(motor_there))
    wide = min(twist, least) > WIDE_TWIST * motion
    # a load that sticks and slips, or a coarse encoder, shows its direction no sooner than the motor does
    slow = min(width, _velocity_bandwidth(motor[part], period) or width)
    lost = _fit_lost_motion(times, motor, aligned, usable, period, 4.0 * slow, ratio, turn, wide=wide)
    if lost is None:
        # no flank is in contact for long: from the rough regression
        lost = LostMotion.from_motion(2.0 * float(found[2]) * float(np.sign(found[0])), 2.0 * float(errors[2]))
    # how the gap is crossed is not modelled: 0.5 % of the gap, as found on motions of several frequencies
    speed = _rms(rows[:, 1])
    skew_error = float(np.hypot(errors[1], 0.005 * lost.lost_motion / speed) / abs(found[0]))
    # with a gap as large as the motion a delay cannot be found
    known = known and not wide
    return Gearing(
        **vars(replace(lost, twist_residual=lost.twist_residual / spread if spread else np.inf)),
        ratio=slope,
        ratio_error=float(np.hypot(slope_errors[0], slope * least / motion if wide else 0.0)),
        skew=skew if known else None,
        skew_error=skew_error if known else None,
        residual=residual,
        twist=twist,
        least_twist=least,
        motion=motion,
    )


def _fit_with_skew(
    times: np.ndarray, motor: np.ndarray, load: np.ndarray, segments: Sequence[slice], period: float, width: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float, bool] | None:
    """Repeats :func:`_regress_motor` until the skew of the load stays; its results, the skew, and whether there is one."""
    skew, known, fit = 0.0, True, None
    # converges quadratically: five steps are ample
    for _ in range(5):
        fit = _regress_motor(times, motor, load, segments, period, 4.0 * width, skew)
        if fit is None:
            return None
        step = float(fit[2][1] / fit[2][0])
        if not known or abs(step) < 1e-3 * period:
            break
        skew += step
        # a quarter of the fastest period: no delay of an encoder, but a load that moves on its own
        if abs(skew) > 0.25 / width:
            skew, known = 0.0, False
    assert fit is not None
    return *fit, skew, known


@dataclass(frozen=True)
class Drift:
    """How the skew of theta_s against theta_e grows over a log.

    Attributes:
        value: s/s.
        error: standard error.
        skew: in the middle of the log, s.
        reach: by how much the skew changes over half of the log, s.
    """

    value: float
    error: float
    skew: float
    reach: float


_FOLDS = 10
"""Blocks of the log, each left out in turn, on which a drift has to prove itself."""


def fit_drift(
    times: np.ndarray, motor: np.ndarray, load: np.ndarray, segments: Sequence[slice], period: float, skew: float
) -> Drift | None:
    """A drift of the load's stamps that explains parts of the log left out better than the constant `skew` does; else None.

    Arguments as of :func:`fit_gearing`.
    """
    width = _velocity_bandwidth(load[longest_segment(segments)], period)
    usable = [s for s in segments if s.stop - s.start >= MIN_SAMPLES]
    if not width or not usable:
        return None
    constant = _regress_motor(times, motor, load, usable, period, 4.0 * width, skew)
    drift, fit, error = 0.0, None, np.inf
    half = 0.5 * float(times[-1] - times[0])
    # converges quadratically, as the skew does
    for _ in range(6):
        fit = _regress_motor(times, motor, load, usable, period, 4.0 * width, skew, drift)
        if fit is None or constant is None:
            return None
        values, errors = fit[2], fit[3]
        steps = float(values[1] / values[0]), float(values[-1] / values[0])
        skew, drift, error = skew + steps[0], drift + steps[1], float(errors[-1] / abs(values[0]))
        if not np.isfinite(drift) or abs(drift) * half > 0.5 / width:
            return None
        if abs(steps[0]) + abs(steps[1]) * half < 1e-3 * period:
            break
    assert fit is not None and constant is not None
    gains = np.log(_held_out_errors(*constant[:2]) / _held_out_errors(fit[0], fit[1]))
    better = float(np.mean(gains)) > 2.0 * float(np.std(gains, ddof=1)) / _FOLDS**0.5
    if not better or abs(drift) < 6.0 * error or abs(drift) * half < 0.05 * period:
        return None
    return Drift(drift, error, skew, abs(drift) * half)


def _held_out_errors(target: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Mean square error on each block of a regression on the others, shape (blocks,)."""
    scaled, found = rows / (np.abs(rows).max(axis=0) + 1e-300), []
    blocks = np.array_split(np.arange(len(target)), _FOLDS)
    grams, moments = [scaled[b].T @ scaled[b] for b in blocks], [scaled[b].T @ target[b] for b in blocks]
    for block, gram, moment in zip(blocks, grams, moments, strict=True):
        values = np.linalg.lstsq(sum(grams) - gram, sum(moments) - moment, rcond=1e-12)[0]
        found.append(float(np.mean((target[block] - scaled[block] @ values) ** 2)))
    return np.array(found)


def _velocity_bandwidth(positions: np.ndarray, period: float) -> float:
    """Bandwidth of the velocity, Hz; of motion that is slower than a spectrum shows, a few times one over its duration."""
    width = find_bandwidth(positions, period, differentiate=True)
    slow = 10.0 / (len(positions) * period)
    if width or len(positions) < MIN_SAMPLES:
        return width
    fast = positions - low_pass(positions, 4.0 * slow, period)
    return slow if np.std(fast) < 0.03 * np.ptp(positions) else 0.0


def _fit_terms(target: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """As :func:`fit_with_jackknife`; without the velocity, in column 1, where it is nothing but the flank."""
    found, errors = fit_with_jackknife(target, rows)
    if np.isfinite(found).all():
        return found, errors
    found, errors = fit_with_jackknife(target, np.delete(rows, 1, axis=1))
    return np.insert(found, 1, 0.0), np.insert(errors, 1, np.inf)


def _fit_lost_motion(
    times: np.ndarray,
    motor: np.ndarray,
    aligned: list[np.ndarray],
    segments: Sequence[slice],
    period: float,
    cutoff: float,
    ratio: float,
    turn: float | None,
    *,
    wide: bool,
) -> LostMotion | None:
    """By changes of the load torque's sign, where there are any, else by the direction of motion.

    `aligned` is theta_s without its skew, of each segment; `cutoff` that of the low-pass before differences are taken, Hz.
    Where the twist is `wide`, a large part of the motion, errors that repeat with position cannot be separated.
    """
    from scipy.ndimage import minimum_filter1d

    parts = []
    for s, load in zip(segments, aligned, strict=True):
        smooth = low_pass(load, cutoff, period)
        velocity = np.gradient(smooth, period)
        cut = trim_filter_ends(len(smooth), cutoff, period)
        parts.append(
            np.stack([times[s], motor[s] - ratio * load, smooth, velocity, np.gradient(velocity, period)], axis=1)[cut]
        )
    time, twist, position, velocity, acceleration = np.concatenate(parts).T
    ends = np.cumsum([len(part) for part in parts])[:-1]
    rows = [np.ones_like(position), velocity, acceleration]
    if not wide:
        low, span = float(position.min()), float(np.ptp(position))
        around = turn is not None and span > 1.5 * turn
        place = (position - low) * (2.0 * np.pi / turn if around and turn else np.pi / span)
        rows += [position - low, *(np.cos(k * place) for k in range(1, HARMONICS + 1))]
        rows += [np.sin(k * place) for k in range(1, HARMONICS + 1)] if around else []
    terms = np.stack(rows, axis=1)
    sizes = _rms(velocity), _rms(acceleration)
    # the filter takes as long to notice a corner of the motion
    guard = round(0.5 / (cutoff * period))
    best = None
    for angle in _MIXTURES:
        flank = _flank_signal(angle, velocity, acceleration, sizes)
        clear = np.abs(flank) > 0.3
        if clear.sum() < 0.25 * len(clear):
            continue
        for part in np.split(np.arange(len(clear)), ends):
            clear[part] = minimum_filter1d(clear[part], 2 * guard + 1, mode="nearest")
        few = np.flatnonzero(clear)[:: max(int(clear.sum()) // 20_000, 1)]
        if len(few) < 3 * terms.shape[1] or clear.sum() < 0.1 * len(clear):
            continue
        chosen = np.column_stack([np.sign(flank[few]), terms[few]])
        chosen /= np.abs(chosen).max(axis=0) + 1e-300
        fitted = chosen @ np.linalg.lstsq(chosen, twist[few], rcond=1e-10)[0]
        size = float(np.mean((twist[few] - fitted) ** 2))
        if best is None or size < best[0]:
            best = (size, flank, clear)
    if best is None:
        return None if wide else lost_motion.fit_lost_motion_by_load(time, twist, position, velocity, turn)
    _, flank, clear = best
    found = lost_motion.fit_lost_motion_by_direction(twist, terms, flank, clear)
    if wide:
        # a shaft winds up as its load is moved: part of this shift, and in so few cycles it is unknown how much
        alone = lost_motion.fit_lost_motion_by_direction(twist, terms[:, :1], flank, clear)
        return found.enclose(alone) if found and alone else found
    if found is None or found.lost_motion_error > 0.25 * abs(found.lost_motion):
        # at one speed, delays and wind-up look like lost motion: take a delay to be no more than a period
        delay = ratio * period * _rms(velocity)
        still = lost_motion.fit_lost_motion_by_direction(twist, np.delete(terms, 1, axis=1), flank, clear, beside=delay)
        if still is not None and (found is None or still.lost_motion_error < 0.5 * found.lost_motion_error):
            found = still
    if found is not None and found.twist_residual < 0.25 * abs(found.lost_motion):
        return found
    # two flanks by the direction of motion explain little: the load may change them
    return lost_motion.fit_lost_motion_by_load(time, twist, position, velocity, turn) or found


def _rms(values: np.ndarray) -> float:
    """Root mean square; never zero, so that one can divide by it."""
    return float(np.sqrt(np.mean(values**2))) + 1e-300


def _flank_signal(angle: float, velocity: np.ndarray, acceleration: np.ndarray, sizes: tuple[float, float]) -> np.ndarray:
    """One of :data:`_MIXTURES`, by the rms of both."""
    return np.cos(angle) * velocity / sizes[0] + np.sin(angle) * acceleration / sizes[1]


def twist_noise(ratio: float, motor: ChannelStatistics, load: ChannelStatistics) -> float:
    """Noise and resolution of both encoders together, rms, at the motor, in their unit."""
    noise = [motor.noise, ratio * load.noise, motor.resolution / 12.0**0.5, ratio * load.resolution / 12.0**0.5]
    return float(np.hypot.reduce(noise))


def _regress_motor(
    times: np.ndarray,
    motor: np.ndarray,
    load: np.ndarray,
    segments: Sequence[slice],
    period: float,
    cutoff: float,
    skew: float,
    drift: float | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """One regression of :func:`fit_gearing` at a given skew, and a drift (s/s) about the middle of the log, if it is sought.

    Motor positions, shape (rows,); terms (position, velocity, flank, 1, acceleration, series; velocity times time where a
    drift is sought), shape (rows, 5 + HARMONICS or one more); coefficients and standard errors, shape (terms,).
    """
    middle = 0.5 * float(times[0] + times[-1])
    parts, smooth_motor = [], []
    for s in segments:
        late = skew + (drift or 0.0) * (times[s] - middle)
        smooth = low_pass(interpolate_spline(times[s], load[s], times[s] + late), cutoff, period)
        velocity = np.gradient(smooth, times[s])
        parts.append(np.stack([smooth, velocity, np.gradient(velocity, times[s])]))
        smooth_motor.append(low_pass(motor[s], cutoff, period))
    inner = [trim_filter_ends(len(signal), cutoff, period) for signal in smooth_motor]

    def joined(signals: list[np.ndarray]) -> np.ndarray:
        return np.concatenate([signal[..., cut] for signal, cut in zip(signals, inner, strict=True)], axis=-1)

    target = joined(smooth_motor)
    position, velocity, acceleration = joined(parts)
    sizes = _rms(velocity), _rms(acceleration)
    lowest = float(load.min())
    place = np.pi * (position - lowest) / (float(load.max()) - lowest)
    series = [np.cos(k * place) for k in range(1, HARMONICS + 1)]
    rows = np.stack(
        [position - lowest, velocity, np.zeros_like(position), np.ones_like(position), acceleration, *series], axis=1
    )
    best = None
    for angle in _MIXTURES:
        mixed = [_flank_signal(angle, velocity, acceleration, sizes) for _, velocity, acceleration in parts]
        # between the flanks the twist is anywhere in the gap
        clear = np.abs(joined(mixed)) > 0.3
        few = np.flatnonzero(clear)[:: max(len(position) // 20_000, 1)]
        if len(few) < 3 * rows.shape[1] or clear.sum() < 0.25 * len(clear):
            continue
        flank = rows[:, 2] = joined([low_pass(smooth_sign(m), cutoff, period) for m in mixed])
        scaled = rows[few] / (np.abs(rows[few]).max(axis=0) + 1e-300)
        fitted = np.linalg.lstsq(scaled.T @ scaled, scaled.T @ target[few], rcond=1e-12)[0]
        size = float(np.mean((target[few] - scaled @ fitted) ** 2))
        if best is None or size < best[0]:
            best = (size, flank, clear)
    if best is None:
        return None
    rows[:, 2] = best[1]
    if drift is not None:
        about = np.concatenate([times[s][cut] for s, cut in zip(segments, inner, strict=True)]) - middle
        rows = np.column_stack([rows, velocity * about])
    rows, target = rows[best[2]], target[best[2]]
    found, errors = _fit_terms(target, rows)
    if not np.isfinite(found).all() or found[0] == 0.0:
        return None
    return target, rows, found, errors
