"""Lost motion from two encoders: how far the motor shifts against the load from flank to flank of the gap."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from .least_squares import BLOCKS, fit_with_jackknife
from .signal_quality import MIN_SAMPLES

Flank = Literal["motion", "load"]


@dataclass(frozen=True)
class LostMotion:
    """Shift of theta_e - ratio theta_s between the flanks of the gap, at the motor, in rad or m.

    Attributes:
        lost_motion: the shift.
        lost_motion_error: standard error, valid for residuals that are correlated in time and over position.
        lost_motion_interval: 95 %.
        flank: what decides the flank: the direction of motion (with the load's inertia), or a load torque that changes its
            sign at some times, beside errors that repeat with position and direction.
        flank_changes: number of changes of the flank, from which the lost motion is found.
        flank_times: times of these where the load made them, s; in a record from its first sample.
        lost_motion_range: 10 % and 90 % quantiles over the positions, where the load torque changes its sign; else the
            value.
        twist_residual: rms of the twist that lost motion and wind-up do not explain.
    """

    lost_motion: float
    lost_motion_error: float
    lost_motion_interval: tuple[float, float]
    flank: Flank
    flank_changes: int
    flank_times: tuple[float, ...]
    lost_motion_range: tuple[float, float]
    twist_residual: float

    @staticmethod
    def from_motion(
        value: float, error: float, residual: float = math.inf, changes: int = 0, freedom: int = BLOCKS - 1
    ) -> "LostMotion":
        """Where the direction of motion decides the flank."""
        return LostMotion(value, error, _interval(value, error, freedom), "motion", changes, (), (value, value), residual)

    def enclose(self, other: "LostMotion") -> "LostMotion":
        """Anywhere between two that rest on different assumptions."""
        value, error = 0.5 * (self.lost_motion + other.lost_motion), 0.5 * abs(self.lost_motion - other.lost_motion)
        error = math.hypot(error, max(self.lost_motion_error, other.lost_motion_error))
        return self.from_motion(value, error, self.twist_residual, self.flank_changes)


def _interval(value: float, error: float, freedom: int) -> tuple[float, float]:
    from scipy.special import stdtrit

    reach = float(stdtrit(max(freedom, 1), 0.975)) * error
    return value - reach, value + reach


# by the direction of motion


def fit_lost_motion_by_direction(
    twist: np.ndarray, rows: np.ndarray, flank: np.ndarray, clear: np.ndarray, *, beside: float = 0.0
) -> LostMotion | None:
    """From the twist theta_e - ratio theta_s on both flanks, wherever one of them is surely in contact.

    `rows` are other terms of the twist, shape (samples, terms); `flank` has the sign of the torque; `clear` is False where
    the gap is crossed; `beside` is the standard error of other causes.
    """
    signs = np.sign(flank[clear])
    changes = int(np.count_nonzero(np.diff(signs)))
    if changes < 2 or len(signs) < MIN_SAMPLES:
        return None
    terms = np.column_stack([0.5 * signs, rows[clear]])
    found, errors = fit_with_jackknife(twist[clear], terms)
    if not np.isfinite(found).all():
        return None
    value = float(found[0])
    rest = twist[clear] - terms @ found
    left = float(np.sqrt(np.mean(rest**2)))
    # a drift leaves each stretch on one flank at a level of its own
    stretch = np.concatenate([[0], np.cumsum(np.diff(signs) != 0)])
    levels = np.bincount(stretch, rest) / np.bincount(stretch)
    between = 2.0 * float(np.sqrt(np.mean(levels**2) / max(len(levels) - 2, 1)))
    # corners of the motion are rounded by the filter: an error of 1e-4 at most
    error = math.hypot(max(float(errors[0]), between), 1e-4 * value, beside)
    return LostMotion.from_motion(value, error, left, changes, min(BLOCKS, len(levels)) - 1)


# by the sign of the load torque


BINS = 60
"""Places over the range, or the turn, of the load: 6 degrees of a turn, finer than eccentricity and first harmonics."""


@dataclass(frozen=True)
class _Cells:
    """Mean twist wherever a pass over the range crosses a place, in the order of time."""

    twist: np.ndarray
    time: np.ndarray
    place: np.ndarray
    passing: np.ndarray
    group: np.ndarray  # of the same place and direction

    def centred(self, values: np.ndarray) -> np.ndarray:
        """Values of the cells less the mean of those of the same place and direction."""
        return values - (np.bincount(self.group, values) / np.maximum(np.bincount(self.group), 1))[self.group]


def _average_passes(
    times: np.ndarray, twist: np.ndarray, position: np.ndarray, velocity: np.ndarray, turn: float | None
) -> _Cells | None:
    moving = np.abs(velocity) > 0.25 * np.sqrt(np.mean(velocity**2))
    low, high = float(position.min()), float(position.max())
    if high == low:
        return None
    around = turn is not None and high - low > 1.5 * turn
    span = turn if around and turn is not None else (high - low) * (1.0 + 1e-9)
    turns = np.floor((position - low) / span) if around else np.zeros(len(position))
    place = np.clip(((position - low) / span - turns) * BINS, 0, BINS - 1).astype(int)
    forwards = velocity > 0.0
    at = np.flatnonzero(moving)
    if len(at) < MIN_SAMPLES:
        return None
    # a long rest may hide a change of the load
    rests = np.diff(times[at]) > 0.02 * (times[at[-1]] - times[at[0]])
    passing = np.concatenate([[0], np.cumsum((np.diff(forwards[at]) != 0) | (np.diff(turns[at]) != 0) | rests)])
    key = passing * BINS + place[at]
    _, first, inverse, count = np.unique(key, return_index=True, return_inverse=True, return_counts=True)
    enough = count >= max(3, 0.1 * np.median(count))
    mean = np.bincount(inverse, twist[at]) / count
    when = np.bincount(inverse, times[at]) / count
    order = np.argsort(when)
    order = order[enough[order]]
    first = first[order]
    return _Cells(mean[order], when[order], place[at][first], passing[first], 2 * place[at][first] + forwards[at][first])


def _shift_between_states(cells: _Cells, late: np.ndarray, kept: np.ndarray | bool = True) -> tuple[float, np.ndarray]:
    """Biweight location of the shifts of the places that were crossed in both states, and these shifts.

    Where the load hardly pulls, the gap is not crossed in full: such places fall short, and count less.
    """
    size = 2 * BINS
    sums, counts = [], []
    for state in (~late & kept, late & kept):
        counts.append(np.bincount(cells.group[state], minlength=size))
        sums.append(np.bincount(cells.group[state], cells.twist[state], minlength=size))
    both = (counts[0] > 0) & (counts[1] > 0)
    if both.sum() < 4:
        return math.nan, np.zeros(0)
    shifts = sums[1][both] / counts[1][both] - sums[0][both] / counts[0][both]
    weights = 1.0 / (1.0 / counts[0][both] + 1.0 / counts[1][both])
    # start at the shortest half: what falls short lies to one side, and would draw a median and widen its scale; 3.44 is the
    # usual constant of an MM-estimate (85 % of the efficiency of a mean)
    ordered, half = np.sort(shifts), len(shifts) // 2
    widths = ordered[half:] - ordered[: len(shifts) - half]
    start = int(np.argmin(widths))
    found = float(ordered[start : start + half + 1].mean())
    # of a normal distribution half lies within 0.674 standard deviations
    scale = float(widths[start]) / 1.349 + 1e-300
    for _ in range(30):
        size = weights * np.clip(1.0 - ((shifts - found) / (3.44 * scale)) ** 2, 0.0, None) ** 2
        found = float(size @ shifts / size.sum())
    return found, shifts


def _find_states(cells: _Cells) -> np.ndarray | None:
    """Which of two states each cell is in: the assignment that leaves least, with few changes."""
    count = len(cells.twist)
    plain = cells.centred(cells.twist)
    # one change: the step, less its mean in each place and direction, that goes along best
    changes = np.arange(2, count - 1, max(count // 400, 1))
    before = np.cumsum(np.arange(2 * BINS) == cells.group[:, None], axis=0)[changes - 1]
    crossed = np.bincount(cells.group, minlength=2 * BINS)
    size = np.sum(before * (1.0 - before / np.maximum(crossed, 1)), axis=1)
    gain = np.where(size > 1e-9, np.cumsum(plain)[changes - 1] ** 2 / np.maximum(size, 1e-9), 0.0)
    starts = [np.arange(count) >= changes[np.argmax(gain)]] if gain.max(initial=0.0) > 0.0 else []
    smooth = np.nanmedian(np.lib.stride_tricks.sliding_window_view(np.pad(plain, 4, constant_values=np.nan), 9), axis=1)
    starts.append(smooth > 0.5 * (smooth.min() + smooth.max()))
    chosen = None
    for state in starts:
        for _ in range(12):
            shift, _ = _shift_between_states(cells, state)
            if not math.isfinite(shift) or shift == 0.0:
                break
            left = cells.centred(cells.twist - shift * state)
            again = _viterbi(left + shift * state, shift, float(np.var(left)))
            if (again == state).all():
                break
            state = again
        shift, _ = _shift_between_states(cells, state)
        size = float(np.sum(cells.centred(cells.twist - shift * state) ** 2))
        if math.isfinite(shift) and (chosen is None or size < chosen[0]):
            chosen = (size, state)
    return None if chosen is None else chosen[1]


def _viterbi(values: np.ndarray, shift: float, variance: float) -> np.ndarray:
    """The sequence of levels 0 and shift that fits best, each change at the price of 20 log-likelihoods."""
    price = 40.0 * max(variance, 1e-12 * shift**2)
    cost = np.stack([values**2, (values - shift) ** 2], axis=1)
    came = np.zeros((len(values), 2), dtype=bool)
    total = cost[0]
    for i in range(1, len(values)):
        change = total[::-1] + price
        came[i] = change < total
        total = np.minimum(total, change) + cost[i]
    state = np.zeros(len(values), dtype=bool)
    now = int(np.argmin(total))
    for i in range(len(values) - 1, -1, -1):
        state[i] = bool(now)
        now = 1 - now if came[i][now] else now
    return state


def fit_lost_motion_by_load(
    times: np.ndarray, twist: np.ndarray, position: np.ndarray, velocity: np.ndarray, turn: float | None
) -> LostMotion | None:
    """From what changes between passes over the same places in the same direction; None where nothing clearly does.

    Position and velocity are the load's; gear and encoders repeat after a `turn` of it, None on a linear axis.
    """
    cells = _average_passes(times, twist, position, velocity, turn)
    if cells is None or len(cells.twist) < 24:
        return None
    state = _find_states(cells)
    if state is None or state.all() or not state.any():
        return None
    value, shifts = _shift_between_states(cells, state)
    if not math.isfinite(value):
        return None
    left = cells.centred(cells.twist - value * state)
    residual = float(np.std(left))
    # two levels stand apart; a drift does not
    if abs(value) < 6.0 * residual or not _better_than_drift(cells, left):
        return None
    passes = np.unique(cells.passing)
    groups = np.array_split(np.arange(BINS), BLOCKS)
    without_passes = [_shift_between_states(cells, state, cells.passing != p)[0] for p in passes]
    without_places = [
        _shift_between_states(cells, state, ~np.isin(cells.place, g))[0] for g in groups if np.isin(cells.place, g).any()
    ]
    variance = 0.0
    for without in (without_passes, without_places):
        finite = np.array([w for w in without if math.isfinite(w)])
        if len(finite) < max(3, len(without) - 1):
            return None
        variance += (len(finite) - 1) / len(finite) * float(np.sum((finite - finite.mean()) ** 2))
    size, error = abs(value), math.sqrt(variance)
    turned = np.flatnonzero(np.diff(state))
    if size < 8.0 * error or len(turned) > len(passes):
        return None
    at = tuple(float(0.5 * (cells.time[i] + cells.time[i + 1])) for i in turned)
    least, largest = np.quantile(math.copysign(1.0, value) * shifts, [0.1, 0.9])
    interval = _interval(size, error, min(len(passes), BLOCKS) - 1)
    return LostMotion(size, error, interval, "load", len(at), at, (float(least), float(largest)), residual)


def _better_than_drift(cells: _Cells, left: np.ndarray) -> bool:
    """Whether two states leave much less than a steady drift over time does."""
    plain, time = cells.centred(cells.twist), cells.centred(cells.time)
    slope = float(time @ plain) / max(float(time @ time), 1e-300)
    return float(np.sum(left**2)) < 0.5 * float(np.sum((plain - slope * time) ** 2))
