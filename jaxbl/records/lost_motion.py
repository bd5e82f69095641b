"""Lost motion from two encoders: the shift of the motor against the load from flank to flank of the gap."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from .least_squares import BLOCKS, fit_with_jackknife, jackknife_variance, rms, student_interval
from .signal_quality import MIN_SAMPLES


@dataclass(frozen=True)
class LostMotion:
    """Shift of theta_e - ratio theta_s between the flanks of the gap, at the motor, in rad or m.

    Attributes:
        lost_motion: the shift.
        lost_motion_error: standard error, valid for residuals that are correlated in time and over position.
        lost_motion_interval: 95 %.
        flank: cause of the flank: the direction of motion (with the load's inertia), or the sign of a load torque, which is
            separated from errors that repeat with position and direction.
        flank_changes: number of changes of the flank, from which the lost motion was found.
        flank_times: times of these changes if the load caused them, s; in a record from its first sample.
        lost_motion_range: 10 % and 90 % quantiles over the positions, if the load torque decides the flank; else the value.
        twist_residual: rms of the twist without lost motion and wind-up.
    """

    lost_motion: float
    lost_motion_error: float
    lost_motion_interval: tuple[float, float]
    flank: Literal["motion", "load"]
    flank_changes: int
    flank_times: tuple[float, ...]
    lost_motion_range: tuple[float, float]
    twist_residual: float

    @staticmethod
    def from_motion(
        value: float, error: float, residual: float = math.inf, changes: int = 0, freedom: int = BLOCKS - 1
    ) -> "LostMotion":
        """Return a lost motion whose flank is decided by the direction of motion."""
        return LostMotion(
            value, error, student_interval(value, error, freedom), "motion", changes, (), (value, value), residual
        )

    def enclose(self, other: "LostMotion") -> "LostMotion":
        """Return an interval that encloses this estimate and another one, which rests on different assumptions."""
        value, error = 0.5 * (self.lost_motion + other.lost_motion), 0.5 * abs(self.lost_motion - other.lost_motion)
        error = math.hypot(error, max(self.lost_motion_error, other.lost_motion_error))
        return self.from_motion(value, error, self.twist_residual, self.flank_changes)


# by the direction of motion


def fit_lost_motion_by_direction(
    twist: np.ndarray, rows: np.ndarray, flank: np.ndarray, is_clear: np.ndarray, *, other_error: float = 0.0
) -> LostMotion | None:
    """Fit the twist theta_e - ratio theta_s on both flanks, at samples where one of them is surely in contact.

    `rows` are other terms of the twist, shape (samples, terms); `flank` has the sign of the torque; `is_clear` is False
    while the gap is crossed; `other_error` is the standard error by other causes.
    """
    signs = np.sign(flank[is_clear])
    changes = int(np.count_nonzero(np.diff(signs)))
    if changes < 2 or len(signs) < MIN_SAMPLES:
        return None
    terms = np.column_stack([0.5 * signs, rows[is_clear]])
    coefficients, errors = fit_with_jackknife(twist[is_clear], terms)
    if not np.isfinite(coefficients).all():
        return None
    value = float(coefficients[0])
    residuals = twist[is_clear] - terms @ coefficients
    residual = rms(residuals)
    # with a drift each stretch on one flank has a different level
    stretch = np.cumsum(np.append(0, np.diff(signs) != 0))
    levels = np.bincount(stretch, residuals) / np.bincount(stretch)
    level_error = 2.0 * rms(levels) / math.sqrt(max(len(levels) - 2, 1))
    # corners of the motion are rounded by the filter: an error of 1e-4 at most
    error = math.hypot(max(errors[0], level_error), 1e-4 * value, other_error)
    return LostMotion.from_motion(value, error, residual, changes, min(BLOCKS, len(levels)) - 1)


# by the sign of the load torque


BINS = 60
"""Cells over the range, or the turn, of the load: 6 degrees of a turn, finer than eccentricity and first harmonics."""


@dataclass(frozen=True)
class _Cells:
    """Mean twist of each crossing of a place by a pass over the range, in the order of time.

    `group` numbers the pairs of place and direction: twice the place, and 1 more forwards.
    """

    twist: np.ndarray
    time: np.ndarray
    pass_number: np.ndarray
    group: np.ndarray

    def subtract_group_means(self, values: np.ndarray) -> np.ndarray:
        """Subtract from the values of the cells their means over the same place and direction."""
        return values - (np.bincount(self.group, values) / np.maximum(np.bincount(self.group), 1))[self.group]


def _average_passes(
    times: np.ndarray, twist: np.ndarray, position: np.ndarray, velocity: np.ndarray, turn: float
) -> _Cells | None:
    span = np.ptp(position)
    moving = np.abs(velocity) > 0.25 * rms(velocity)
    if span == 0.0 or moving.sum() < MIN_SAMPLES:
        return None
    # over less than a turn nothing repeats
    span = turn if span > 1.5 * turn else span * (1.0 + 1e-9)
    turns, share = np.divmod((position - position.min())[moving] / span, 1.0)
    place, forwards, times = (BINS * share).astype(int), velocity[moving] > 0.0, times[moving]
    # a long rest may hide a change of the load
    rests = np.diff(times) > 0.02 * (times[-1] - times[0])
    pass_number = np.cumsum(np.append(0, (np.diff(forwards) != 0) | (np.diff(turns) != 0) | rests))
    _, first, inverse, count = np.unique(
        pass_number * BINS + place, return_index=True, return_inverse=True, return_counts=True
    )
    mean, when = (np.bincount(inverse, signal) / count for signal in (twist[moving], times))
    order = np.argsort(when)
    order = order[(count >= max(3, 0.1 * np.median(count)))[order]]
    first = first[order]
    return _Cells(mean[order], when[order], pass_number[first], (2 * place + forwards)[first])


def _shift_between_states(
    cells: _Cells, is_late: np.ndarray, selection: np.ndarray | slice = slice(None)
) -> tuple[float, np.ndarray]:
    """Return the biweight location of the shifts at places that were crossed in both states, and these shifts.

    Where the load hardly pulls, the gap is not crossed in full: the shifts of such places are smaller, and count less.
    """
    index, twist = (cells.group + 2 * BINS * is_late)[selection], cells.twist[selection]
    counts, sums = (np.bincount(index, weights, 4 * BINS).reshape(2, -1) for weights in (None, twist))
    crossed_twice = (counts > 0).all(axis=0)
    if crossed_twice.sum() < 4:
        return math.nan, np.zeros(0)
    counts, means = counts[:, crossed_twice], sums[:, crossed_twice] / counts[:, crossed_twice]
    shifts, weights = means[1] - means[0], 1.0 / (1.0 / counts[0] + 1.0 / counts[1])
    # start at the shortest half: small shifts lie to one side, and would move a median and widen its scale; 3.44 is the
    # usual constant of an MM-estimate (85 % of the efficiency of a mean)
    ordered, half = np.sort(shifts), len(shifts) // 2
    widths = ordered[half:] - ordered[: len(shifts) - half]
    start = np.argmin(widths)
    location = float(ordered[start : start + half + 1].mean())
    # half of a normal distribution lies within 0.674 standard deviations
    scale = widths[start] / 1.349 + 1e-120
    for _ in range(30):
        size = weights * np.clip(1.0 - ((shifts - location) / (3.44 * scale)) ** 2, 0.0, None) ** 2
        location = float(size @ shifts / size.sum())
    return location, shifts


def _find_states(cells: _Cells) -> np.ndarray | None:
    """Assign one of two states to each cell, with the least residuals and few changes; None if no shift is between them."""
    count = len(cells.twist)
    centred_twist = cells.subtract_group_means(cells.twist)
    # a single change: the step, less its mean in each place and direction, that fits best
    changes = np.arange(2, count - 1, max(count // 400, 1))
    passed = np.cumsum(np.arange(2 * BINS) == cells.group[:, None], axis=0)
    before = passed[changes - 1]
    size = np.sum(before * (1.0 - before / np.maximum(passed[-1], 1)), axis=1)
    gain = np.cumsum(centred_twist)[changes - 1] ** 2 / np.maximum(size, 1e-9)
    smooth = np.nanmedian(
        np.lib.stride_tricks.sliding_window_view(np.pad(centred_twist, 4, constant_values=np.nan), 9), axis=1
    )
    best = None
    for state in (np.arange(count) >= changes[np.argmax(gain)], smooth > 0.5 * (smooth.min() + smooth.max())):
        for _ in range(12):
            shift, _ = _shift_between_states(cells, state)
            if not math.isfinite(shift) or shift == 0.0:
                break
            residuals = cells.subtract_group_means(cells.twist - shift * state)
            next_state = _find_best_levels(residuals + shift * state, shift, float(np.var(residuals)))
            if (next_state == state).all():
                break
            state = next_state
        shift, _ = _shift_between_states(cells, state)
        size = np.sum(cells.subtract_group_means(cells.twist - shift * state) ** 2)
        if math.isfinite(shift) and (best is None or size < best[0]):
            best = (size, state)
    return None if best is None else best[1]


def _find_best_levels(values: np.ndarray, shift: float, variance: float) -> np.ndarray:
    """Find the sequence of levels 0 and `shift` that fits best (Viterbi); each change costs 20 log-likelihoods."""
    change_cost = 40.0 * max(variance, 1e-12 * shift**2)
    cost = np.stack([values**2, (values - shift) ** 2], axis=1)
    total, changes = cost[0], []
    for level_cost in cost[1:]:
        change = total[::-1] + change_cost
        changes.append(change < total)
        total = np.minimum(total, change) + level_cost
    # backwards from the better end
    levels = [np.argmin(total)]
    for has_changed in reversed(changes):
        levels.append(levels[-1] ^ has_changed[levels[-1]])
    return np.array(levels[::-1], dtype=bool)


def fit_lost_motion_by_load(
    times: np.ndarray, twist: np.ndarray, position: np.ndarray, velocity: np.ndarray, turn: float
) -> LostMotion | None:
    """Fit the change between passes over the same places in the same direction; None if there is no clear one.

    Position and velocity are the load's. Gear and encoders repeat after a `turn` of it; infinite on a linear axis.
    """
    cells = _average_passes(times, twist, position, velocity, turn)
    if cells is None or len(cells.twist) < 24 or (state := _find_states(cells)) is None:
        return None
    value, shifts = _shift_between_states(cells, state)
    residuals = cells.subtract_group_means(cells.twist - value * state)
    residual = float(np.std(residuals))
    # two levels stand apart; a drift does not
    if abs(value) < 6.0 * residual or not _explains_more_than_drift(cells, residuals):
        return None
    variance, passes = 0.0, len(np.unique(cells.pass_number))
    # by passes, and by neighbouring places
    for blocks in (cells.pass_number, cells.group // (2 * BINS // BLOCKS)):
        without = [_shift_between_states(cells, state, blocks != block)[0] for block in np.unique(blocks)]
        finite = [value for value in without if math.isfinite(value)]
        if len(finite) < max(3, len(without) - 1):
            return None
        variance += float(jackknife_variance(finite))
    size, error = abs(value), math.sqrt(variance)
    changes = np.flatnonzero(np.diff(state))
    if size < 8.0 * error or len(changes) > passes:
        return None
    change_times = tuple(float(0.5 * (cells.time[i] + cells.time[i + 1])) for i in changes)
    least, largest = np.quantile(math.copysign(1.0, value) * shifts, [0.1, 0.9]).tolist()
    interval = student_interval(size, error, min(passes, BLOCKS) - 1)
    return LostMotion(size, error, interval, "load", len(change_times), change_times, (least, largest), residual)


def _explains_more_than_drift(cells: _Cells, residuals: np.ndarray) -> bool:
    """Return True if the residuals of two states are much smaller than those of a steady drift over time."""
    twist, time = cells.subtract_group_means(cells.twist), cells.subtract_group_means(cells.time)
    slope = time @ twist / max(time @ time, 1e-300)
    return bool(np.sum(residuals**2) < 0.5 * np.sum((twist - slope * time) ** 2))
