"""Clock and zero point of one encoder against those of the other.

A skew or an offset is sure if neither friction, gap nor load torque can cause it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from .gearing import Flanks, Gearing, find_flank
from .least_squares import fit_residual, fit_with_jackknife, rms
from .resampling import Grid
from .signal_quality import (
    find_motion_bandwidth,
    interpolate_spline,
    long_segments,
    low_pass,
    low_pass_motion,
    trim_filter_ends,
)

_SURE_ERRORS = 6.0
"""Standard errors from which on an estimate is sure: errors from 12 blocks are themselves known to 20 %."""
_NOMINAL_FACTOR = 3.0
"""Factor by which a stiffness, friction or gap of a data sheet may be wrong."""
_MIN_HARMONIC_RESIDUAL = 0.5**0.5
"""Share of the residual rms that remains with harmonics of one to three periods a turn, if the log has none."""
_MIN_TORQUE_SHARE = 0.1
"""Share of the input torque that an offset has to cause in the nominal shaft, to be reported."""


@dataclass(frozen=True)
class NominalDrive:
    """Nominal numbers of a drive, in the units of its study (rad or m, N m or N).

    Attributes:
        motor_inertia, motor_viscous: inertia and viscous friction of the motor, or of a rigid drive.
        load_inertia, load_viscous: those of the load; 0 on a rigid drive.
        gear_ratio: motor over load motion.
        stiffness: of the shaft, at the motor; infinite on a rigid drive, and if its law has none.
        half_gap: half of the free play, at the motor; 0 if there is none.
        dead_time: whether u acts later than it is commanded: an effect that is sought, or that the model has.
    """

    motor_inertia: float
    motor_viscous: float
    load_inertia: float = 0.0
    load_viscous: float = 0.0
    gear_ratio: float = 1.0
    stiffness: float = math.inf
    half_gap: float = 0.0
    dead_time: Literal["no", "sought", "modelled"] = "no"

    def refer_to(self, channel: str) -> tuple[float, float]:
        """Return inertia and viscous friction: torque on the motor per acceleration, and speed, of the encoder `channel`."""
        ratio = 1.0 if channel == "theta_e" else self.gear_ratio
        inertia = self.motor_inertia + self.load_inertia / self.gear_ratio**2
        return ratio * inertia, ratio * (self.motor_viscous + self.load_viscous / self.gear_ratio**2)


class Skew(NamedTuple):
    """Delay of the stamps of theta_s against its readings, compared with theta_e, that only a clock can cause.

    Attributes:
        value: s, less the wind-up by the torque in the shaft.
        error: standard error, s.
        max_windup_delay: largest delay that friction can imitate, s: all of the motor's work goes into the load's friction.
    """

    value: float
    error: float
    max_windup_delay: float


class Offset(NamedTuple):
    """Value of theta_e - gear_ratio theta_s without torque, midway between the flanks of the gap.

    Attributes:
        value: rad (m).
        error: standard error, with the offset that a constant torque can cause.
        both_flanks: True if the load presses on both flanks.
        is_sure: True if only zero points of the encoders can cause it.
    """

    value: float
    error: float
    both_flanks: bool
    is_sure: bool


def find_clock_skew(gearing: Gearing, grid: Grid, nominal: NominalDrive) -> Skew | None:
    """Find the skew between both encoders that only a clock can cause; None if there is none.

    Friction of the load winds the shaft up by T / K and so looks like a delay. In the mean over the log the part of T in
    phase with the velocity is at most <u ω> / <ω²> for any law of friction: no passive load takes more work than the
    motor gives.
    """
    max_delay = max_windup_delay(grid, nominal)
    if gearing.skew is None or gearing.skew_error is None or not math.isfinite(max_delay):
        return None
    # friction makes the load lag, never lead
    friction_delay = _NOMINAL_FACTOR * max_delay if gearing.skew > 0.0 else 0.0
    if abs(gearing.skew) <= max(friction_delay + _SURE_ERRORS * gearing.skew_error, 0.05 * grid.period):
        return None
    value = gearing.skew
    if (regression := _regress_twist(grid, nominal, value)) is not None:
        # without the wind-up by the shaft torque, from the motor's equation of motion
        value += regression.values[1] / nominal.gear_ratio
    # friction takes something between nothing and all of it
    value = float(np.clip(value, gearing.skew - max_delay, gearing.skew))
    return Skew(value, float(np.hypot(gearing.skew_error, 0.5 * max_delay)), max_delay)


def max_windup_delay(grid: Grid, nominal: NominalDrive) -> float:
    """Return the largest delay that friction can cause, s: it takes all of the motor's work. Infinite if that is unknown."""
    work = square = 0.0
    for s in grid.segments if "u" in grid.values else ():
        velocity = np.gradient(grid.values["theta_e"][s], grid.period)
        work += grid.values["u"][s] @ velocity
        square += velocity @ velocity
    return float(abs(work) / square / nominal.stiffness) if square else math.inf


def find_encoder_offset(grid: Grid, nominal: NominalDrive) -> Offset | None:
    """Find an offset between the encoders: the constant part of the twist without the wind-up T / K.

    With T = u - J_e dω_e/dt - f_e ω_e the twist is offset + half gap sign T + T / K. Flank, velocity and acceleration are
    regressed along. None if the motion or the offset is too small.
    """
    regression = _regress_twist(grid, nominal)
    if regression is None:
        return None
    torque, load_velocity, load_acceleration, motor_velocity, motor_acceleration = regression.motion
    value, sure_size = float(regression.values[0]), _SURE_ERRORS * float(regression.errors[0])
    terms = [np.ones(len(torque)), motor_velocity, motor_acceleration, np.sign(motor_velocity)]
    bias, bias_error = (float(x[0]) for x in fit_with_jackknife(torque, np.column_stack(terms)))
    constant = max(abs(float(np.mean(torque))), abs(bias) + 2.0 * bias_error if np.isfinite(bias) else np.inf)
    # a constant torque, or a constant error of u, looks like an offset of that torque over the stiffness
    windup = constant / nominal.stiffness
    load_torque = nominal.load_inertia * load_acceleration + nominal.load_viscous * load_velocity
    has_both_flanks = (
        regression.has_both_flanks
        and constant < float(np.quantile(np.abs(load_torque / nominal.gear_ratio), 0.9))
        # the twist has to cover the gap, which is up to a third narrower than a data sheet says
        and regression.twist_range > 1.5 * nominal.half_gap
    )
    gap_share = 0.0 if has_both_flanks else _NOMINAL_FACTOR * nominal.half_gap
    if abs(value) - gap_share < max(sure_size, _MIN_TORQUE_SHARE * rms(torque) / nominal.stiffness):
        return None
    # the constant torque, or a stiffness that is half as large again, may explain all of it
    if abs(value) < (1.0 if has_both_flanks else 0.5) * windup:
        return None
    is_sure = has_both_flanks and abs(value) > sure_size + _NOMINAL_FACTOR * windup
    return Offset(value, float(np.hypot(regression.errors[0], windup)), has_both_flanks, is_sure)


class _Regression(NamedTuple):
    """Regression of the twist, less the nominal wind-up, on 1, load velocity and acceleration, and flank if there are both.

    Errors that repeat with the load's turn are regressed along if they improve the fit much.

    Attributes:
        values, errors: coefficients of 1, velocity, acceleration and others.
        motion: torque, velocity and acceleration of the load and of the motor, low-passed, shape (samples,) each.
        has_both_flanks: True if torque, velocity or acceleration of both signs occur.
        twist_range: of the twist without the wind-up, without a hundredth at each end, rad (m).
    """

    values: np.ndarray
    errors: np.ndarray
    motion: Sequence[np.ndarray]
    has_both_flanks: bool
    twist_range: float


def _regress_twist(grid: Grid, nominal: NominalDrive, skew: float = 0.0) -> _Regression | None:
    """Regress the twist, with theta_s shifted by a skew (s); None if the motion is too small."""
    motor, load = grid.values["theta_e"], grid.values["theta_s"]
    width = find_motion_bandwidth(motor, grid.segments, grid.period)
    segments, cutoff = long_segments(grid.segments), 4.0 * width
    if not width or not segments or "u" not in grid.values:
        return None
    parts = []
    for s in segments:
        moved = interpolate_spline(grid.time[s], load[s], grid.time[s] + skew) if skew else load[s]
        motor_motion, load_motion = (low_pass_motion(x, cutoff, grid.period) for x in (motor[s], moved))
        signals = np.stack([low_pass(grid.values["u"][s], cutoff, grid.period), *motor_motion, *load_motion])
        parts.append(signals[:, trim_filter_ends(len(moved), cutoff, grid.period)])
    torque, motor_place, motor_velocity, motor_acceleration, place, velocity, acceleration = np.concatenate(parts, axis=1)
    twist = motor_place - nominal.gear_ratio * place
    shaft_torque = torque - nominal.motor_inertia * motor_acceleration - nominal.motor_viscous * motor_velocity
    target = twist - shaft_torque / nominal.stiffness
    twist_range = float(np.ptp(np.quantile(target, (0.01, 0.99))))
    terms = np.column_stack([np.ones(len(target)), velocity, acceleration])

    def list_flanks() -> Flanks:
        for flank in (shaft_torque, velocity, acceleration):
            is_clear = np.abs(flank) > 0.3 * rms(flank)
            if np.mean(is_clear) >= 0.25 and 0.05 < np.mean(flank[is_clear] > 0.0) < 0.95:
                yield np.sign(flank), is_clear

    best = find_flank(target, terms, list_flanks())
    rows = terms
    if best is not None:
        flank, is_clear = best
        target, rows, place = target[is_clear], np.column_stack([terms, flank])[is_clear], place[is_clear]
    # over a part of a turn the eccentricity of an encoder or wheel has a mean, too
    with_harmonics = np.column_stack([rows, *(wave(n * place) for n in (1, 2, 3) for wave in (np.sin, np.cos))])
    if rms(fit_residual(target, with_harmonics)) < _MIN_HARMONIC_RESIDUAL * rms(fit_residual(target, rows)):
        rows = with_harmonics
    values, errors = fit_with_jackknife(target, rows)
    if not np.isfinite(values).all():
        return None
    motion = torque, velocity, acceleration, motor_velocity, motor_acceleration
    return _Regression(values, errors, motion, best is not None, twist_range)
