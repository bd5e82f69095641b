"""Rough fit of a rigid drive to a log: torque against acceleration, velocity, its sign, position and a constant."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxbl.quantity import Quantity

from .least_squares import column_rms, fit_with_jackknife, rms
from .signal_quality import find_bandwidth, long_segments, longest_segment, low_pass, low_pass_motion, trim_filter_ends


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

    names: tuple[str, ...]
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
        columns = (x.tolist() for x in (self.values, self.errors, self.inflation, self.shares))
        terms = {
            name: Quantity(value, error).to_dict() | {"inflation": inflation, "share": share}
            for name, value, error, inflation, share in zip(self.names, *columns, strict=True)
        }
        return {"terms": terms, "residual": self.residual}


MIN_SPEED_SHARE = 0.05
"""Share of the rms speed below which a drive may stick: its torque then does not depend on its motion."""


def smooth_sign(velocity: np.ndarray) -> np.ndarray:
    """Return the sign of a velocity, +1 or -1, smooth through zero; shape (samples,)."""
    # 2 % of the rms velocity: standstill then counts as neither direction
    return velocity / np.hypot(velocity, 0.02 * rms(velocity) + 1e-300)


def fit_rigid_drive(torque: np.ndarray, position: np.ndarray, segments: Sequence[slice], period: float) -> RigidFit | None:
    """Regress a torque, held from each stamp to the next, on the motion of an encoder; None if that is too small."""
    bandwidth = find_bandwidth(position[longest_segment(segments)], period, differentiate=True)
    if bandwidth == 0.0 or np.ptp(torque) == 0.0:
        return None
    # three times the bandwidth: the corners of the motion stay, noise of the second derivative goes
    cutoff = 3.0 * bandwidth
    targets, all_rows, slowing = [], [], 0.0
    for segment in long_segments(segments):
        smooth, velocity, acceleration = low_pass_motion(position[segment], cutoff, period)
        direction = low_pass(smooth_sign(velocity), cutoff, period)
        smooth_torque = low_pass(torque[segment], cutoff, period)
        inner = trim_filter_ends(len(smooth), cutoff, period)
        # the last column takes a lateness of the torque
        columns = [acceleration, velocity, direction, smooth, np.ones_like(smooth), np.gradient(smooth_torque, period)]
        all_rows.append(np.stack(columns, axis=1)[inner])
        slowing += float(velocity[inner][0] ** 2 - velocity[inner][-1] ** 2)
        targets.append(smooth_torque[inner])
    if not targets:
        return None
    target, rows = np.concatenate(targets), np.concatenate(all_rows)
    # what holds a drive at rest is no function of its motion
    moves = np.abs(rows[:, 1]) > MIN_SPEED_SHARE * rms(rows[:, 1])
    if not moves.any() or np.ptp(target[moves]) == 0.0:
        return None
    coefficients, errors = fit_with_jackknife(target[moves], rows[moves])
    if not np.isfinite(coefficients).all():
        # two terms are proportional to each other
        coefficients, errors = np.zeros(6), np.full(6, np.inf)
    terms = rows[moves, :5]
    centred = terms[:, :4] - terms[:, :4].mean(axis=0)
    inflation = np.full(5, np.inf)
    if np.isfinite(errors).all() and (column_rms(centred) > 0.0).all():
        inflation = np.append(np.diag(np.linalg.inv(np.corrcoef(centred.T))), 1.0)
    residuals = (target - rows @ coefficients)[moves]
    return RigidFit(
        names=("inertia", "viscous", "coulomb", "spring", "constant"),
        values=coefficients[:5],
        errors=errors[:5],
        inflation=inflation,
        shares=np.abs(coefficients[:5]) * column_rms(terms) / rms(target[moves]),
        residual=float(np.std(residuals) / np.std(target[moves])),
        torque=rms(target),
        acceleration=rms(rows[:, 0]),
        power=float(np.mean(target * rows[:, 1])),
        square=float(np.mean(rows[:, 1] ** 2)),
        slowing=slowing / (len(rows) * period),
    )
