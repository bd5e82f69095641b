"""Lateness of the torque u: by how much its stamps are later than the motion that it causes.

A drive that samples its current at each stamp logs a torque that is not held from stamp to stamp: it is half a period late.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .least_squares import column_rms, fit_residual, fit_with_jackknife, rms
from .resampling import Grid
from .signal_quality import (
    MIN_SAMPLES,
    find_motion_bandwidth,
    interpolate_spline,
    long_segments,
    low_pass,
    trim_filter_ends,
)

_CUTOFFS = 1.5, 3.0, 6.0, 12.0
"""Cutoffs of the low-pass that are tried, over the bandwidth of the motion: a low one for noise, a high one for friction."""
_MAX_CUTOFF = 0.3
"""Largest cutoff, cycles a sample: differences of five samples are right within 5 % below it."""
_SLOW_SHARE = 0.3
"""Share of the rms speed below which a drive may stick, or friction depends on its speed."""
_MAX_PERIODS = 16.0
"""Periods beyond which a torque has nothing to do with the motion: buses and controllers are late by four at most."""
_MAX_SAMPLES = 200_000
"""Samples that are used: their error is far below a hundredth of a period, and more would cost seconds."""
_MIN_INERTIA_SHARE = 0.1
"""Share of the torque that accelerates the drive, below which friction may be taken for a part of it."""
_SURE_ERROR = 0.1
"""Error, over the period, below which a lateness is known. Its multiples of half a period are five such errors apart."""


class Lateness(NamedTuple):
    """Delay of the stamps of u against the motion that it causes; less than 0 if they are early.

    Attributes:
        value: s, against a torque that is held from each stamp to the next.
        error: s; the standard error, what a torque that the rough fit lacks can imitate, and what a soft shaft can.
        half_periods: the value in halves of the period, if it is surely such a multiple, as clocks and sampling make it.
        is_known: True if the error is below a tenth of the period.
    """

    value: float
    error: float
    half_periods: int | None
    is_known: bool


def estimate_lateness(grid: Grid, encoders: Sequence[str], period: float) -> Lateness | None:
    """Estimate the lateness of u from the motion of `encoders`; None if the motion does not show it.

    The low-passed torque, moved in time, is regressed on acceleration, velocity, its sign, position and a constant, without
    the rows about reversals, at which friction sticks and gaps are crossed. `period` is that of the log, s.
    """
    bandwidth = find_motion_bandwidth(grid.values[encoders[0]], grid.segments, grid.period)
    segments = [slice(s.start, min(s.stop, s.start + _MAX_SAMPLES)) for s in long_segments(grid.segments)]
    cutoffs = [cutoff for factor in _CUTOFFS if (cutoff := factor * bandwidth) * grid.period < _MAX_CUTOFF]
    if not segments or not bandwidth or np.ptp(grid.values["u"]) == 0.0:
        return None
    # a load that follows exactly adds nothing to the motor's encoder, and spoils the regression
    for names in (encoders, encoders[:1]):
        fits = [fit for cutoff in cutoffs if (fit := _fit_lateness(grid, names, segments, cutoff)) is not None]
        if fits:
            value, error, inertia_share = min(fits, key=lambda fit: fit[1])
            half_periods = round(2.0 * value / period)
            is_known = error < _SURE_ERROR * period and inertia_share > _MIN_INERTIA_SHARE
            is_multiple = is_known and abs(value - 0.5 * half_periods * period) < _SURE_ERROR * period
            return Lateness(value, error, half_periods if is_multiple else None, is_known)
    return None


def _fit_lateness(
    grid: Grid, encoders: Sequence[str], segments: Sequence[slice], cutoff: float
) -> tuple[float, float, float] | None:
    """Return lateness and its error, s, and the share of the torque that accelerates; None if they are not determined."""
    from scipy.ndimage import maximum_filter1d

    period, encoder_count = grid.period, len(encoders)
    columns, moving_rows, torques = [], [], []
    for segment in segments:
        position = low_pass(np.stack([grid.values[name][segment] for name in encoders], axis=1), cutoff, period)
        velocity = _differentiate(position, period)
        acceleration = _differentiate(velocity, period)
        # a soft shaft shows in the second derivative of the acceleration
        snap = _differentiate(_differentiate(acceleration[:, 0], period), period)
        columns.append(np.column_stack([acceleration, snap, np.ones(len(snap)), velocity, np.sign(velocity), position]))
        is_slow = (np.abs(velocity) <= _SLOW_SHARE * column_rms(velocity)).any(axis=1)
        # the low-pass smears a reversal over half a period of its cutoff
        reach = math.ceil(0.5 / (cutoff * period))
        is_inner = np.zeros(len(snap), bool)
        is_inner[trim_filter_ends(len(snap), cutoff, period)] = True
        moving_rows.append(is_inner & ~np.asarray(maximum_filter1d(is_slow, 2 * reach + 1, mode="constant"), bool))
        torques.append((grid.time[segment], low_pass(grid.values["u"][segment], cutoff, period)))
    motion, rows = np.concatenate(columns), np.concatenate(moving_rows)
    if rows.sum() < 3 * MIN_SAMPLES:
        return None
    lateness, step = 0.0, math.inf
    while True:
        moved = [interpolate_spline(times, torque, times + lateness) for times, torque in torques]
        slope = np.concatenate([_differentiate(torque, period) for torque in moved])[rows]
        target, regressors = np.concatenate(moved)[rows], np.column_stack([motion[rows], -slope])
        values, errors = fit_with_jackknife(target, regressors)
        # steps that do not shrink lead nowhere
        if not abs(lateness + values[-1]) < _MAX_PERIODS * period or abs(values[-1]) > 0.7 * abs(step):
            return None
        step = float(values[-1])
        lateness += step
        if abs(step) < 0.01 * period:
            break
    from scipy.signal import welch

    # the torque that no column explains, and the slope that no other one does
    unexplained = np.zeros((2, len(rows)))
    unexplained[:, rows] = target - regressors @ values, fit_residual(slope, regressors[:, :-1])
    missing, own_slope = welch(unexplained, nperseg=min(2048, len(rows) // 4))[1]
    # a torque that the columns lack hides in the slope at most what it leaves at the slope's frequencies
    missing_error = np.sum(np.sqrt(missing * own_slope)) / np.sum(own_slope)
    accelerating_torque = regressors[:, :encoder_count] @ values[:encoder_count]
    inertia = rms(accelerating_torque) / rms(regressors[:, 0])
    # friction f of a load J_s on a shaft K delays it by f / K; J_s² / K is the coefficient of the snap
    velocity = regressors[:, encoder_count + 2]
    friction = max(target @ velocity / (velocity @ velocity), 0.0)
    windup_error = 2.0 * (abs(values[encoder_count]) + errors[encoder_count]) * friction / inertia**2
    error = float(np.linalg.norm([errors[-1], missing_error, windup_error]))
    # a torque that is held for a period acts half a period after its stamp
    return lateness + 0.5 * period, error, rms(accelerating_torque) / rms(target)


def _differentiate(values: np.ndarray, period: float) -> np.ndarray:
    """Differentiate by central differences of fourth order, of second order at the ends."""
    slope = np.gradient(values, period, axis=0)
    slope[2:-2] = (8.0 * (values[3:-1] - values[1:-3]) - (values[4:] - values[:-4])) / (12.0 * period)
    return slope
