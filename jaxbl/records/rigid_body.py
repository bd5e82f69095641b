"""Rough fit of a rigid drive to a log: torque against acceleration, velocity, its sign, position and a constant."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .least_squares import column_rms, fit_with_jackknife, rms
from .signal_quality import find_motion_bandwidth, long_segments, low_pass, low_pass_motion, trim_filter_ends


@dataclass(frozen=True)
class RigidFit:
    """Rough regression of the torque on the motion of a rigid drive. It serves to judge a log, not to identify a drive.

    The terms are acceleration, velocity, its sign, position and a constant.

    Attributes:
        names: of the terms.
        values: coefficients, SI units, shape (terms,).
        errors: their standard errors, shape (terms,).
        inflation: variance inflation factors: 1 if a term is uncorrelated with all others, shape (terms,).
        shares: rms of each term over that of the torque, shape (terms,).
        residual: rms of the residual over the rms of the torque about its mean.
        torque: rms, N m (N).
        acceleration: rms of the low-passed motion, rad/s² (m/s²).
        power: mean power of the torque, W.
        square: mean of the squared low-passed speed, rad²/s² (m²/s²).
        slowing: fall of the squared speed from begin to end of the segments, over their duration, rad²/s³ (m²/s³).
    """

    names = "inertia", "viscous", "coulomb", "spring", "constant"
    values: np.ndarray
    errors: np.ndarray
    inflation: np.ndarray
    shares: np.ndarray
    residual: float
    torque: float
    acceleration: float
    power: float
    square: float
    slowing: float

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of `inspection.json`."""
        keys = "value", "standard_error", "inflation", "share"
        rows = np.stack([self.values, self.errors, self.inflation, self.shares], axis=1).tolist()
        terms = {name: dict(zip(keys, row, strict=True)) for name, row in zip(self.names, rows, strict=True)}
        return {"terms": terms, "residual": self.residual}


MIN_SPEED_SHARE = 0.05
"""Share of the rms speed below which a drive may stick: its torque then does not depend on its motion."""


def smooth_sign(velocity: np.ndarray) -> np.ndarray:
    """Return the sign of a velocity, +1 or -1, smooth through zero; shape (samples,)."""
    # 2 % of the rms velocity: standstill then counts as neither direction
    return velocity / np.hypot(velocity, 0.02 * rms(velocity) + 1e-300)


def fit_rigid_drive(
    torque: np.ndarray, position: np.ndarray, segments: Sequence[slice], period: float, beside: np.ndarray | None = None
) -> RigidFit | None:
    """Regress a torque, held from each stamp to the next, on the motion of an encoder; None if that is too small.

    `beside` is the position of another side that the same torque moves: its inertia and friction then take part.
    """
    bandwidth = find_motion_bandwidth(position, segments, period)
    if bandwidth == 0.0 or np.ptp(torque) == 0.0:
        return None
    # three times the bandwidth: the corners of the motion stay, noise of the second derivative goes
    cutoff = 3.0 * bandwidth
    parts = []
    for segment in long_segments(segments):
        smooth, velocity, acceleration = low_pass_motion(position[segment], cutoff, period)
        direction = low_pass(smooth_sign(velocity), cutoff, period)
        smooth_torque = low_pass(torque[segment], cutoff, period)
        # the slope of the torque takes a lateness of it
        slope = np.gradient(smooth_torque, period)
        columns = [acceleration, velocity, direction, smooth, np.ones_like(smooth), slope]
        if beside is not None:
            _, velocity, acceleration = low_pass_motion(beside[segment], cutoff, period)
            columns += [acceleration, velocity, low_pass(smooth_sign(velocity), cutoff, period)]
        parts.append(np.stack([*columns, smooth_torque], axis=1)[trim_filter_ends(len(smooth), cutoff, period)])
    if not parts:
        return None
    signals = np.concatenate(parts)
    acceleration, velocity, target = signals[:, 0], signals[:, 1], signals[:, -1]
    # what holds a drive at rest is no function of its motion
    moving = signals[np.abs(velocity) > MIN_SPEED_SHARE * rms(velocity)]
    rows, moving_target, terms = moving[:, :-1], moving[:, -1], moving[:, :5]
    varying = np.delete(rows, (4, 5), axis=1)
    if not len(moving) or np.ptp(moving_target) == 0.0:
        return None
    coefficients, errors = fit_with_jackknife(moving_target, rows)
    if not np.isfinite(coefficients).all():
        # two terms are proportional to each other
        coefficients, errors = np.zeros(rows.shape[1]), np.full(rows.shape[1], np.inf)
    inflation = np.full(5, np.inf)
    if np.isfinite(errors).all() and np.ptp(varying, axis=0).all():
        inflation = np.append(np.diag(np.linalg.inv(np.corrcoef(varying.T)))[:4], 1.0)
    return RigidFit(
        values=coefficients[:5],
        errors=errors[:5],
        inflation=inflation,
        shares=np.abs(coefficients[:5]) * column_rms(terms) / rms(moving_target),
        residual=float(np.std(moving_target - rows @ coefficients) / np.std(moving_target)),
        torque=rms(target),
        acceleration=rms(acceleration),
        power=float(np.mean(target * velocity)),
        square=float(np.mean(velocity**2)),
        slowing=float(sum(part[0, 1] ** 2 - part[-1, 1] ** 2 for part in parts)) / (len(signals) * period),
    )
