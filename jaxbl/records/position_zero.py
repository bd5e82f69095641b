"""Where the positions of two logs begin to count: an incremental encoder is at zero wherever it was switched on.

Torque that repeats with the turn (cogging, ripple, gravity) is the same in all logs of a machine. What one log shows of it
predicts another one if that is turned by the difference of the zeros.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .least_squares import BLOCKS, fit_with_jackknife
from .rigid_body import smooth_sign
from .signal_quality import MIN_SAMPLES, low_pass, trim_filter_ends

_HARMONICS = 40
"""Most periods a turn: more than poles, slots and balls of small drives make."""
_TURNS = 2.0
"""Of the motion, in each log: with fewer a wave of one period a turn is no wave."""
_CUTOFF = 50.0
"""Hz, of the low-pass for accelerations: above it their noise is larger than most drives' torques."""
_MOVING = 0.05
"""Share of the rms speed below which a drive may stick, and its torque says nothing of its place."""
_LARGE = 6.0
"""Standard errors from which on a wave is there: twelve blocks give one of eighty numbers so by chance in 1 log of 100."""
_SHOWN, _OTHER = 4.0, 3.0
"""Standard errors by which turned waves have to be better than none, out of a hundred places tried, and than unturned."""
_STEPS = 8
"""Places tried for each period of the fastest wave."""


class TurningLog(NamedTuple):
    """A log, as torques over the turn are looked for in it.

    Attributes:
        torque: N m, shape (samples,).
        motor, load: positions, rad on the motor's side, shape (samples,); load is None where it is not known.
        segments: parts without gaps.
        period: of the samples, s.
    """

    torque: np.ndarray
    motor: np.ndarray
    load: np.ndarray | None
    segments: Sequence[slice]
    period: float


class ZeroShift(NamedTuple):
    """By how much positions of a log count less than those of another, rad.

    Attributes:
        value: to be added; the smallest of those that are about as good.
        error: standard error.
        waves: periods a turn by which it is known.
    """

    value: float
    error: float
    waves: tuple[int, ...]


class _MovingRows(NamedTuple):
    """Rows in motion behind the low-pass: torque, columns of the motion, and cos(n position) and sin(n position),
    n = 1, 2, ..."""

    torque: np.ndarray
    columns: np.ndarray
    cosine: np.ndarray
    sine: np.ndarray


def find_zero_shift(first: TurningLog, second: TurningLog) -> ZeroShift | None:
    """By how much the positions of the second log have to be turned to be those of the first; None where torques over the
    turn do not surely say that they have to."""
    cutoff = min(_CUTOFF, 0.1 / max(first.period, second.period))
    one, other = (_select_moving_rows(log, cutoff) for log in (first, second))
    if one is None or other is None:
        return None
    values, errors = fit_with_jackknife(one.torque, np.hstack([one.columns, one.cosine, one.sine]))
    if not np.isfinite(values).all():
        return None
    known = one.columns.shape[1]
    error, error_too = errors[known:].reshape(2, -1)
    cosine, sine = values[known:].reshape(2, -1)
    which = np.flatnonzero(np.hypot(cosine / error, sine / error_too) > _LARGE)
    if not len(which):
        return None
    # torque a_n cos(n q) + b_n sin(n q) = Re((a_n - i b_n) exp(i n q))
    size = cosine[which] - 1j * sine[which]
    harmonics = which + 1
    places = np.linspace(-np.pi, np.pi, 2 * (_STEPS * int(harmonics[-1]) // 2), endpoint=False)
    turns = np.exp(1j * harmonics[:, None] * places) * size[:, None]
    tried = np.hstack([other.torque[:, None], other.cosine[:, which] @ turns.real - other.sine[:, which] @ turns.imag])
    # what the motion explains is not the waves'
    left = tried - other.columns @ np.linalg.lstsq(other.columns, tried, rcond=1e-10)[0]
    blocks = np.array_split(np.arange(len(left)), BLOCKS)
    none = np.array([np.sum(left[rows, 0] ** 2) for rows in blocks])
    squares = np.array([np.sum((left[rows, :1] - left[rows, 1:]) ** 2, axis=0) for rows in blocks])
    total = squares.sum(axis=0)
    best, still = int(np.argmin(total)), squares[:, len(places) // 2]
    if not (_error_reduction(none, squares[:, best]) > _SHOWN and _error_reduction(still, squares[:, best]) > _OTHER):
        return None
    lowest = np.flatnonzero((total <= np.roll(total, 1)) & (total <= np.roll(total, -1)))
    equal = [i for i in lowest if i == best or _error_reduction(squares[:, i], squares[:, best]) < _OTHER]
    at = min(equal, key=lambda i: abs(places[i]))
    # places within half a period of the fastest wave
    near = (at + np.arange(-(_STEPS // 2), _STEPS // 2 + 1)) % len(places)
    step = places[1] - places[0]
    value, *without = (
        places[at] + step * (_parabola_minimum(one[near]) - _STEPS // 2)
        for one in (total, *(total - some for some in squares))
    )
    error = float(np.sqrt((BLOCKS - 1) / BLOCKS * np.sum((np.array(without) - np.mean(without)) ** 2)))
    if not abs(value) > _OTHER * error:
        return None
    return ZeroShift(float(value), error, tuple(int(n) for n in harmonics))


def _select_moving_rows(log: TurningLog, cutoff: float) -> _MovingRows | None:
    """Rows of a log in motion; None where it does not turn far enough."""
    parts = []
    for s in log.segments:
        if s.stop - s.start < MIN_SAMPLES:
            continue
        place = low_pass(log.motor[s], cutoff, log.period)
        velocity = np.gradient(place, log.period)
        columns = [np.gradient(velocity, log.period), velocity, smooth_sign(velocity), np.ones(len(place))]
        if log.load is not None:
            twist = place - low_pass(log.load[s], cutoff, log.period)
            columns += [twist, np.gradient(twist, log.period)]
        # no more samples than the low-pass leaves, wave by wave: logs may be long
        inner = trim_filter_ends(len(place), cutoff, log.period)
        rows = slice(inner.start, inner.stop, max(int(0.1 / (cutoff * log.period)), 1))
        cosine, sine = (
            np.stack([low_pass(wave(n * log.motor[s]), cutoff, log.period)[rows] for n in range(1, _HARMONICS + 1)], axis=1)
            for wave in (np.cos, np.sin)
        )
        torque = low_pass(log.torque[s], cutoff, log.period)[rows]
        parts.append((torque, np.stack(columns, axis=1)[rows], cosine, sine))
    if not parts or sum(float(np.ptp(log.motor[s])) for s in log.segments) < _TURNS * 2.0 * np.pi:
        return None
    whole = _MovingRows(*map(np.concatenate, zip(*parts, strict=True)))
    speed = np.abs(whole.columns[:, 1])
    rows = speed > _MOVING * np.sqrt(np.mean(speed**2))
    found = _MovingRows(*(one[rows] for one in whole))
    return found if len(found.torque) > BLOCKS * 2 * _HARMONICS else None


def _parabola_minimum(squares: np.ndarray) -> float:
    """Where squares are least, between those tried by a parabola; an index."""
    best = int(np.clip(np.argmin(squares), 1, len(squares) - 2))
    before, at, after = squares[best - 1 : best + 2]
    bend = before - 2.0 * at + after
    return best + (float(np.clip(0.5 * (before - after) / bend, -1.0, 1.0)) if bend > 0.0 else 0.0)


def _error_reduction(none: np.ndarray, some: np.ndarray) -> float:
    """Standard errors by which squares are less, by blocks."""
    gains = none - some
    # not by rounding
    return float(np.mean(gains) / max(np.std(gains, ddof=1) / np.sqrt(len(gains)), 1e-6 * np.mean(none), 1e-300))
