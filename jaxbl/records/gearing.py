"""Motor against load position: ratio, skew, lost motion."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import lost_motion, quality
from .lost_motion import Flank, LostMotion
from .quality import SHORTEST, Array, Slices

HARMONICS = 8
"""Terms of the series over position that takes out what repeats with it."""


UNLIKE = 0.2
"""Share of the motor's motion that the load's leaves unexplained, beyond which they are not said to go together."""


@dataclass(frozen=True)
class Gearing:
    """Motor position as a function of the load's: theta_e = ratio theta_s + constant + half the lost motion by flank.

    Attributes:
        ratio: motor over load motion.
        ratio_error: standard error; beside a twist as large as the motion it takes that share of the ratio.
        lost_motion: shift of theta_e against theta_s from flank to flank of the gap, at the motor; rad or m.
        lost_motion_error: standard error.
        skew: by how much the stamps of theta_s are later than its readings, s, against those of theta_e; None where it
            cannot be told.
        skew_error: standard error.
        residual: rms of what is left, at the motor, over the rms of theta_e about its mean.
        lost_motion_interval: 95 %.
        flank: what tells the flank: the direction of motion, or a load that changes sides.
        flank_changes: on which the lost motion rests.
        flank_times: of these, s from the first sample, where the load made them.
        lost_motion_range: what a tenth of the places falls below, and a tenth exceeds, where the load changes sides.
        twist: range of theta_e - ratio theta_s, with the ratio that is expected, if one is; at the motor.
        twist_residual: rms of the twist that lost motion and wind-up leave over the rms of theta_e about its mean.
        least_twist: range of the twist with the ratio that was found.
        motion: range of theta_e.
    """

    ratio: float
    ratio_error: float
    lost_motion: float
    lost_motion_error: float
    skew: float | None
    skew_error: float | None
    residual: float
    lost_motion_interval: tuple[float, float]
    flank: Flank
    flank_changes: int
    flank_times: tuple[float, ...]
    lost_motion_range: tuple[float, float]
    twist: float
    twist_residual: float
    least_twist: float
    motion: float

    @property
    def wide(self) -> bool:
        """Whether the twist is of the size of the motion whatever the ratio, so that the load hardly follows the motor."""
        return min(self.twist, self.least_twist) > WIDE * self.motion

    def lost_motion_text(self, unit: str) -> str:
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

    def stands_out(self, noise: float) -> bool:
        """Whether the lost motion is more than its error and the noise (:func:`seen`)."""
        return self.lost_motion > max(4.0 * self.lost_motion_error, noise)


def _decimals(error: float) -> int:
    """Decimals that show two digits of an error."""
    return int(np.clip(1 - np.floor(np.log10(error)), 0, 9)) if 0.0 < error < np.inf else 6


def gearing(
    times: Array,
    motor: Array,
    load: Array,
    segments: Slices,
    period: float,
    *,
    expected: float | None = None,
    turn: float | None = None,
) -> Gearing | None:
    """Regress motor on load position, its velocity, acceleration and flank; None where the motion does not tell.

    A delay of the load's stamps adds to theta_e what is proportional to the velocity, lost motion what has the sign of the
    transmitted torque; so they part wherever the speed varies. That sign is taken as the sign of a mixture of velocity
    (friction) and acceleration (inertia) of the load, the one that explains most. Viscous friction at the load winds up the
    shaft in proportion to velocity too, and cannot be told from a delay. Errors of the encoders and the gear that repeat
    with position (eccentricity) are taken out of both by a cosine series over the range of theta_s.

    Args:
        times: shape (samples,), s.
        motor: theta_e, shape (samples,).
        load: theta_s, shape (samples,).
        segments: contiguous parts.
        period: s.
        expected: ratio of motor over load motion, as far as it is known; lost motion is then that beside it.
        turn: of the load, after which gear and encoders repeat; None on a linear axis.
    """
    longest = max(segments, key=lambda s: s.stop - s.start)
    width = _width(load[longest], period)
    usable = [s for s in segments if s.stop - s.start >= SHORTEST]
    if width == 0.0 or not usable:
        return None
    skew, known = 0.0, True
    fit = None
    for _ in range(5):
        fit = _gear_fit(times, motor, load, usable, period, 4.0 * width, skew)
        if fit is None:
            return None
        _, _, found, _ = fit
        step = float(found[1] / found[0])
        if not known or abs(step) < 1e-3 * period:
            break
        skew += step
        # a quarter of the fastest period: no delay of an encoder, but a load that moves on its own
        if abs(skew) > 0.25 / width:
            skew, known = 0.0, False
    assert fit is not None
    target, rows, found, errors = fit
    # the ratio is that of the whole motion, whatever repeats within it
    slopes, slope_errors = _fitted(target, rows[:, :4])
    if not np.isfinite(slopes).all():
        return None
    left = target - rows[:, :4] @ slopes
    spread = float(np.std(target))
    residual = float(np.sqrt(np.mean(left**2))) / spread if spread else np.inf
    # encoders do not wait for long; and at one speed, to and fro, a delay looks like lost motion
    alike = abs(float(rows[:, 1] @ rows[:, 2])) / float(np.linalg.norm(rows[:, 1]) * np.linalg.norm(rows[:, 2]) + 1e-300)
    known = known and residual < UNLIKE and abs(skew) < 10.0 * period and alike < 0.97
    # what is not clearly there is better not undone
    undone = skew if known and abs(skew) > 4.0 * errors[1] / abs(found[0]) else 0.0
    ratio = float(slopes[0]) if expected is None else expected
    aligned = [_aligned(times[s], load[s], undone) for s in usable]
    motor_there = np.concatenate([motor[s] for s in usable])
    load_there, motion = np.concatenate(aligned), float(np.ptp(motor_there))
    twist, least = (float(np.ptp(motor_there - r * load_there)) for r in (ratio, float(slopes[0])))
    wide = min(twist, least) > WIDE * motion
    # a load that sticks and slips, or a coarse encoder, shows its direction no sooner than the motor does
    slow = min(width, _width(motor[longest], period) or width)
    lost = _lost_motion(times, motor, aligned, usable, period, 4.0 * slow, ratio, turn, wide=wide)
    if lost is None:
        value, error = 2.0 * float(found[2]) * float(np.sign(found[0])), 2.0 * float(errors[2])
        lost = LostMotion.unsure(value, error)
    # how the gap is crossed is not modelled: what that was found to be worth, on motions of several frequencies
    speed = float(np.sqrt(np.mean(rows[:, 1] ** 2)))
    skew_error = float(np.hypot(errors[1], 0.005 * lost.value / speed) / abs(found[0]))
    # beside a gap as large as the motion nothing is told of delays
    known = known and not wide
    return Gearing(
        ratio=float(slopes[0]),
        ratio_error=float(np.hypot(slope_errors[0], slopes[0] * least / motion if wide else 0.0)),
        lost_motion=lost.value,
        lost_motion_error=lost.error,
        skew=skew if known else None,
        skew_error=skew_error if known else None,
        residual=residual,
        lost_motion_interval=lost.interval,
        flank=lost.flank,
        flank_changes=lost.changes,
        flank_times=lost.at,
        lost_motion_range=(lost.least, lost.largest),
        twist=twist,
        twist_residual=lost.residual / spread if spread else np.inf,
        least_twist=least,
        motion=motion,
    )


def _width(positions: Array, period: float) -> float:
    """Bandwidth of the velocity, Hz; of motion that is slower than a spectrum shows, a few times one over its duration."""
    width = quality.bandwidth(positions, period, slope=True)
    slow = 10.0 / (len(positions) * period)
    if width or len(positions) < SHORTEST:
        return width
    left = positions - quality.low_passed(positions, 4.0 * slow, period)
    return slow if np.std(left) < 0.03 * np.ptp(positions) else 0.0


def _fitted(target: Array, rows: Array) -> tuple[Array, Array]:
    """As :func:`quality.jackknifed`; without the velocity, in column 1, where it is nothing but the flank."""
    found, errors = quality.jackknifed(target, rows)
    if np.isfinite(found).all():
        return found, errors
    found, errors = quality.jackknifed(target, np.delete(rows, 1, axis=1))
    return np.insert(found, 1, 0.0), np.insert(errors, 1, np.inf)


def _aligned(times: Array, load: Array, skew: float) -> Array:
    """Load positions at the times of the motor's."""
    from scipy.interpolate import CubicSpline

    return CubicSpline(times, load)(np.clip(times + skew, times[0], times[-1])) if skew else load


def _lost_motion(
    times: Array,
    motor: Array,
    aligned: list[Array],
    segments: Slices,
    period: float,
    cutoff: float,
    ratio: float,
    turn: float | None,
    *,
    wide: bool,
) -> LostMotion | None:
    """By the load's changes of side, where there are any, else by the direction of motion.

    Args:
        times: shape (samples,), s.
        motor: theta_e, shape (samples,).
        aligned: theta_s without its skew, of each segment.
        segments: contiguous parts.
        period: s.
        cutoff: of the low-pass that velocities are taken behind, Hz.
        ratio: of motor over load motion.
        turn: of the load.
        wide: whether the twist is about as large as the motion; what repeats with position cannot be told from it then.
    """
    parts = []
    for s, load in zip(segments, aligned, strict=True):
        smooth = quality.low_passed(load, cutoff, period)
        velocity = np.gradient(smooth, period)
        edge = min(round(1.0 / (cutoff * period)), len(smooth) // 8) + 2
        cut = slice(edge, len(smooth) - edge)
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
    sizes = [np.sqrt(np.mean(v**2)) + 1e-300 for v in (velocity, acceleration)]
    # the filter takes as long to notice a corner of the motion
    guard = round(0.5 / (cutoff * period))
    best = None
    for angle in _MIXTURES:
        flank = np.cos(angle) * velocity / sizes[0] + np.sin(angle) * acceleration / sizes[1]
        clear = np.abs(flank) > 0.3
        if clear.sum() < 0.25 * len(clear):
            continue
        for part in np.split(np.arange(len(clear)), ends):
            clear[part] = ~_widened(~clear[part], guard)
        few = np.flatnonzero(clear)[:: max(int(clear.sum()) // 20_000, 1)]
        if len(few) < 3 * terms.shape[1] or clear.sum() < 0.1 * len(clear):
            continue
        chosen = np.column_stack([np.sign(flank[few]), terms[few]])
        chosen /= np.abs(chosen).max(axis=0) + 1e-300
        fitted = chosen @ np.linalg.lstsq(chosen, twist[few], rcond=1e-10)[0]
        size = float(np.mean((twist[few] - fitted) ** 2))
        if best is None or size < best[0]:
            best = (size, flank, clear)
    found = None if best is None else lost_motion.by_motion(twist, terms, best[1], best[2])
    if wide and best is not None and found is not None:
        # a shaft winds up as its load is moved: part of this shift, and in so few cycles nothing tells how much
        alone = lost_motion.by_motion(twist, terms[:, :1], best[1], best[2])
        return found if alone is None else found.between(alone)
    if best is not None and not wide and (found is None or found.error > 0.25 * abs(found.value)):
        # at one speed, delays and wind-up look like lost motion: take a delay to be no more than a period
        delay = ratio * period * float(np.sqrt(np.mean(velocity**2)))
        still = lost_motion.by_motion(twist, np.delete(terms, 1, axis=1), best[1], best[2], beside=delay)
        if still is not None and (found is None or still.error < 0.5 * found.error):
            found = still
    if wide or (found is not None and found.residual < 0.25 * abs(found.value)):
        return found
    # what two flanks by the direction of motion leave is no less than they are
    return lost_motion.by_load(time, twist, position, velocity, turn) or found


def _widened(at: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    """True within some samples of where it is."""
    count = np.concatenate([[0], np.cumsum(at)])
    index = np.arange(len(at))
    return count[np.minimum(index + by + 1, len(at))] > count[np.maximum(index - by, 0)]


def seen(ratio: float, motor: quality.Channel, load: quality.Channel) -> float:
    """Twist that stands out of noise and resolution of both encoders, rms, at the motor."""
    noise = [motor.noise, ratio * load.noise, motor.resolution / 12.0**0.5, ratio * load.resolution / 12.0**0.5]
    return float(np.hypot.reduce(noise))


WIDE = 0.25
"""Share of the motor's motion that the twist takes, beyond which motor and load are not said to move alike."""


_MIXTURES = np.radians([0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 90.0])
"""From velocity alone to acceleration alone, each over its rms."""


def _gear_fit(
    times: Array, motor: Array, load: Array, segments: Slices, period: float, cutoff: float, skew: float
) -> tuple[Array, Array, Array, Array] | None:
    """One regression of :func:`gearing` at a given skew.

    Returns:
        Motor positions, shape (rows,); terms (position, velocity, flank, 1, acceleration, series), shape
        (rows, 5 + HARMONICS); coefficients and standard errors, shape (5 + HARMONICS,).
    """
    from scipy.interpolate import CubicSpline

    targets, parts = [], []
    lowest, highest = float(load.min()), float(load.max())
    for s in segments:
        inside = np.clip(times[s] + skew, times[s][0], times[s][-1])
        smooth = quality.low_passed(CubicSpline(times[s], load[s])(inside), cutoff, period)
        velocity = np.gradient(smooth, times[s])
        edge = min(round(1.0 / (cutoff * period)), len(smooth) // 8) + 2
        cut = slice(edge, len(smooth) - edge)
        parts.append((smooth, velocity, np.gradient(velocity, times[s]), cut))
        targets.append(quality.low_passed(motor[s], cutoff, period)[cut])
    target = np.concatenate(targets)
    sizes = [np.sqrt(np.mean(np.concatenate([part[i][part[3]] for part in parts]) ** 2)) + 1e-300 for i in (1, 2)]
    position, velocity, acceleration = (np.concatenate([part[i][part[3]] for part in parts]) for i in range(3))
    place = np.pi * (position - lowest) / (highest - lowest)
    series = [np.cos(k * place) for k in range(1, HARMONICS + 1)]
    rows = np.stack(
        [position - lowest, velocity, np.zeros_like(position), np.ones_like(position), acceleration, *series], axis=1
    )
    best = None
    for angle in _MIXTURES:
        mixed = [np.cos(angle) * part[1] / sizes[0] + np.sin(angle) * part[2] / sizes[1] for part in parts]
        directions = [quality.low_passed(quality.direction_of(m), cutoff, period) for m in mixed]
        flank = np.concatenate([d[part[3]] for d, part in zip(directions, parts, strict=True)])
        # on its way from flank to flank it is anywhere in the gap
        clear = np.abs(np.concatenate([m[part[3]] for m, part in zip(mixed, parts, strict=True)])) > 0.3
        few = np.flatnonzero(clear)[:: max(len(position) // 20_000, 1)]
        if len(few) < 3 * rows.shape[1] or clear.sum() < 0.25 * len(clear):
            continue
        rows[:, 2] = flank
        scaled = rows[few] / (np.abs(rows[few]).max(axis=0) + 1e-300)
        best_fit = np.linalg.lstsq(scaled.T @ scaled, scaled.T @ target[few], rcond=1e-12)[0]
        size = float(np.mean((target[few] - scaled @ best_fit) ** 2))
        if best is None or size < best[0]:
            best = (size, flank, clear)
    if best is None:
        return None
    rows[:, 2] = best[1]
    rows, target = rows[best[2]], target[best[2]]
    found, errors = _fitted(target, rows)
    if not np.isfinite(found).all() or found[0] == 0.0:
        return None
    return target, rows, found, errors
