"""Clock and zero of one encoder against the other's: what is sure to be neither friction, gap nor load torque."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .gearing import Gearing
from .least_squares import fit_with_jackknife
from .resampling import Grid
from .signal_quality import MIN_SAMPLES, find_bandwidth, interpolate_spline, longest_segment, low_pass, trim_filter_ends

_SURELY = 6.0
"""Standard errors beyond which an estimate counts as no chance: errors of 12 blocks are themselves known to 20 %."""
_VAGUE = 3.0
"""Factor by which a stiffness, friction or gap of a data sheet may be wrong."""
_PLAIN = 0.5
"""Share of the mean square left that errors of one to three periods a turn may not take away, or they are in this log."""
_FELT = 0.1
"""Share of the input torque that an offset has to make in the nominal shaft, to be worth a word."""


@dataclass(frozen=True)
class NominalDrive:
    """What a study says of its drive, in its units (rad or m, N m or N); the transmission's at the motor.

    Attributes:
        motor_inertia, motor_viscous: of the motor, or of a rigid drive.
        load_inertia, load_viscous: of the load; 0 on a rigid drive.
        gear_ratio: motor over load motion.
        stiffness: of the shaft; infinite on a rigid drive, and where its law has none.
        half_gap: half of the free play; 0 where there is none.
    """

    motor_inertia: float
    motor_viscous: float
    load_inertia: float = 0.0
    load_viscous: float = 0.0
    gear_ratio: float = 1.0
    stiffness: float = math.inf
    half_gap: float = 0.0

    def inertia(self, channel: str) -> float:
        """Torque on the motor for the acceleration of an encoder's channel, of the whole drive."""
        return self._at(channel, self.motor_inertia + self.load_inertia / self.gear_ratio**2)

    def viscous(self, channel: str) -> float:
        """Torque on the motor for the speed of an encoder's channel, of the whole drive."""
        return self._at(channel, self.motor_viscous + self.load_viscous / self.gear_ratio**2)

    def _at(self, channel: str, at_motor: float) -> float:
        # the torque acts at the motor
        return at_motor if channel == "theta_e" else at_motor * self.gear_ratio


@dataclass(frozen=True)
class Skew:
    """By how much the stamps of theta_s are later than its readings, against theta_e.

    Attributes:
        value: s, less the wind-up by the torque in the shaft.
        error: standard error, s.
        max_windup_delay: largest delay that friction can imitate, s: all of the motor's work goes into the load's friction.
        is_sure: whether it is a clock.
    """

    value: float
    error: float
    max_windup_delay: float
    is_sure: bool


@dataclass(frozen=True)
class Offset:
    """Reading of theta_e - gear_ratio theta_s without torque, midway between the flanks of the gap.

    Attributes:
        value: rad (m).
        error: standard error, with what a constant torque can make of it.
        both_flanks: whether the load presses on both flanks.
        is_sure: whether it is a zero point.
    """

    value: float
    error: float
    both_flanks: bool
    is_sure: bool


def judge_clock_skew(gearing: Gearing, grid: Grid, nominal: NominalDrive) -> Skew | None:
    """Whether the skew found is a clock's, None where none is found.

    Friction of the load winds the shaft up by T / K and so looks like a delay. In the mean over the log the part of T in
    phase with the velocity is at most <u ω> / <ω²>, whatever the law of friction: no passive load takes more than the motor
    gives.
    """
    if gearing.skew is None or gearing.skew_error is None or "u" not in grid.values:
        return None
    most = max_windup_delay(grid, nominal)
    if not math.isfinite(most):
        return None
    size = abs(gearing.skew)
    # a load that lags is what friction makes, one that leads it cannot make
    friction = _VAGUE * most if gearing.skew > 0.0 else 0.0
    sure = size > friction + _SURELY * gearing.skew_error and size > 0.05 * grid.period
    value = _skew_beside_torque(grid, nominal, gearing.skew) if sure else gearing.skew
    # friction takes something between nothing and all of it
    value = float(np.clip(value, gearing.skew - most, gearing.skew))
    return Skew(value, float(np.hypot(gearing.skew_error, 0.5 * most)), most, sure)


def max_windup_delay(grid: Grid, nominal: NominalDrive) -> float:
    """The delay that friction can make at most, s: all of the motor's work done against the load's; inf: none shows."""
    work = square = 0.0
    for s in grid.segments if "u" in grid.values else ():
        velocity = np.gradient(grid.values["theta_e"][s], grid.period)
        work += float(grid.values["u"][s] @ velocity)
        square += float(velocity @ velocity)
    return abs(work) / square / nominal.stiffness if square else math.inf


def _skew_beside_torque(grid: Grid, nominal: NominalDrive, known: float) -> float:
    """The delay in what the torque in the shaft leaves of the twist, by the motor's equation of motion; s."""
    found = _regress_twist(grid, nominal, known)
    return known if found is None else known + float(found.values[2]) / nominal.gear_ratio


def find_encoder_offset(grid: Grid, nominal: NominalDrive) -> Offset | None:
    """What is constant in the twist, beside flank, velocity and acceleration, without the wind-up T / K.

    With T = u - J_e dω_e/dt - f_e ω_e the twist is offset + half gap sign T + T / K. None where the motion is too small, or
    the offset is too small to matter.
    """
    found = _regress_twist(grid, nominal)
    if found is None:
        return None
    values, errors, torque, load_velocity, load_acceleration, motor_velocity, motor_acceleration = found[:7]
    value = float(values[0])
    terms = [np.ones(len(torque)), motor_velocity, motor_acceleration, np.sign(motor_velocity)]
    bias, bias_error = (float(x[0]) for x in fit_with_jackknife(torque, np.column_stack(terms)))
    constant = max(abs(float(np.mean(torque))), abs(bias) + 2.0 * bias_error if np.isfinite(bias) else np.inf)
    # a constant torque of the motor, or of its record, passes for an offset of that torque over the stiffness
    error = float(np.hypot(errors[0], constant / nominal.stiffness))
    load_torque = nominal.load_inertia * load_acceleration + nominal.load_viscous * load_velocity
    both = found.flanks and constant < float(np.quantile(np.abs(load_torque / nominal.gear_ratio), 0.9))
    # a twist that never covers the gap has not been at both ends of it; a data sheet may make it a third too wide
    both = both and found.range > 1.5 * nominal.half_gap
    flank = 0.0 if both else _VAGUE * nominal.half_gap
    drive = float(np.sqrt(np.mean(torque**2)))
    if nominal.stiffness * (abs(value) - flank) < _FELT * drive or abs(value) - flank < _SURELY * float(errors[0]):
        return None
    # that torque, or a stiffness half as large again, may be all there is
    if abs(value) < (1.0 if both else 0.5) * constant / nominal.stiffness:
        return None
    sure = both and found.plain and abs(value) > _SURELY * float(errors[0]) + _VAGUE * constant / nominal.stiffness
    return Offset(value, error, both, sure)


class _Regression(NamedTuple):
    """Twist less the nominal wind-up on 1, flank (where there are two), load velocity and acceleration.

    Attributes:
        values, errors: coefficients of 1, flank, velocity, acceleration; flank 0 where there is one only.
        torque, load_velocity, load_acceleration, motor_velocity, motor_acceleration: low-passed, shape (samples,).
        flanks: whether torque, velocity or acceleration of both signs occur.
        range: of the twist without the wind-up, but for a hundredth at each end, rad (m).
        plain: whether errors that repeat with the load's turn leave the fit as it is.
    """

    values: np.ndarray
    errors: np.ndarray
    torque: np.ndarray
    load_velocity: np.ndarray
    load_acceleration: np.ndarray
    motor_velocity: np.ndarray
    motor_acceleration: np.ndarray
    flanks: bool
    range: float
    plain: bool


def _regress_twist(grid: Grid, nominal: NominalDrive, skew: float = 0.0) -> _Regression | None:
    """With theta_s moved by a skew (s); None where the motion is too small."""
    motor, load = grid.values["theta_e"], grid.values["theta_s"]
    width = find_bandwidth(motor[longest_segment(grid.segments)], grid.period, differentiate=True)
    segments = [s for s in grid.segments if s.stop - s.start >= MIN_SAMPLES]
    if not width or not segments or "u" not in grid.values:
        return None
    parts = []
    for s in segments:
        moved = interpolate_spline(grid.time[s], load[s], grid.time[s] + skew) if skew else load[s]
        parts.append(_motion(motor[s], moved, grid.values["u"][s], nominal, 4.0 * width, grid.period))
    twist, torque, place, velocity, acceleration, motor_velocity, motor_acceleration = np.concatenate(parts).T
    shaft = torque - nominal.motor_inertia * motor_acceleration - nominal.motor_viscous * motor_velocity
    target = twist - shaft / nominal.stiffness
    one = np.ones(len(target))
    best = None
    for flank in (shaft, velocity, acceleration):
        clear = np.abs(flank) > 0.3 * np.sqrt(np.mean(flank**2))
        share = float(np.mean(flank[clear] > 0.0)) if clear.any() else 0.0
        if clear.sum() < 0.25 * len(clear) or not 0.05 < share < 0.95:
            continue
        rows = np.column_stack([one, np.sign(flank), velocity, acceleration])[clear]
        left = _residual_mean_square(target[clear], rows)
        if best is None or left < best[0]:
            best = (left, clear, rows)
    flanks = best is not None
    if best is None:
        rows = np.column_stack([one, velocity, acceleration])
        best = (_residual_mean_square(target, rows), one > 0.0, rows)
    left, clear, rows = best
    # eccentricity of an encoder or wheel over a part of a turn has a mean as well
    around = [wave(n * place[clear]) for n in (1, 2, 3) for wave in (np.sin, np.cos)]
    plain = _residual_mean_square(target[clear], np.column_stack([rows, *around])) > _PLAIN * left
    values, errors = fit_with_jackknife(target[clear], rows)
    if not np.isfinite(values).all():
        return None
    if not flanks:
        values, errors = np.insert(values, 1, 0.0), np.insert(errors, 1, 0.0)
    spread = float(np.ptp(np.quantile(target, (0.01, 0.99))))
    motion = torque, velocity, acceleration, motor_velocity, motor_acceleration
    return _Regression(values, errors, *motion, flanks, spread, plain)


def _motion(
    motor: np.ndarray, load: np.ndarray, torque: np.ndarray, nominal: NominalDrive, cutoff: float, period: float
) -> np.ndarray:
    """Twist, torque, load position, velocity, acceleration, and both of the motor, low-passed; shape (samples, 7)."""
    smooth = low_pass(np.column_stack([motor, load, torque]), cutoff, period)
    rates = np.gradient(smooth[:, :2], period, axis=0)
    accelerations = np.gradient(rates, period, axis=0)
    twist = smooth[:, 0] - nominal.gear_ratio * smooth[:, 1]
    columns = [twist, smooth[:, 2], smooth[:, 1], rates[:, 1], accelerations[:, 1], rates[:, 0], accelerations[:, 0]]
    return np.column_stack(columns)[trim_filter_ends(len(motor), cutoff, period)]


def _residual_mean_square(target: np.ndarray, rows: np.ndarray) -> float:
    """Mean square that a least-squares fit leaves."""
    scaled = rows / (np.abs(rows).max(axis=0) + 1e-300)
    return float(np.mean((target - scaled @ np.linalg.lstsq(scaled, target, rcond=1e-10)[0]) ** 2))
