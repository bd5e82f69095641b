"""Zero positions of two logs: an incremental encoder is at zero wherever it was switched on.

Torques that repeat with the turn (cogging, ripple, gravity) are the same in all logs of a machine. Those of one log predict
another log if its positions are shifted by the difference of the zeros.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .least_squares import BLOCKS, fit_with_jackknife, rms
from .rigid_body import smooth_sign
from .signal_quality import long_segments, low_pass, trim_filter_ends

_MAX_HARMONIC = 40
"""Largest number of periods a turn: more than poles, slots and balls of small drives make."""
_MIN_TURNS = 2.0
"""Turns that each log has to cover: over fewer ones a wave of one period a turn does not repeat."""
_CUTOFF = 50.0
"""Cutoff of the low-pass for accelerations, Hz: above it their noise is larger than the torques of most drives."""
_MIN_SPEED_SHARE = 0.05
"""Share of the rms speed below which a drive may stick: its torque then does not depend on its position."""
_SURE_WAVE_ERRORS = 6.0
"""Standard errors from which on a wave is sure: one of eighty numbers exceeds them by chance in 1 log of 100."""
_SURE_SHIFT_ERRORS, _BETTER_ERRORS = 4.0, 3.0
"""Standard errors by which shifted waves have to be better than no waves, among a hundred shifts, and than unshifted."""
_SHIFTS_PER_PERIOD = 8
"""Shifts that are compared in each period of the fastest wave."""


class TurningLog(NamedTuple):
    """Signals of a log in which torques over the turn are searched.

    Attributes:
        torque: N m, shape (samples,).
        motor, load: positions, rad on the motor's side, shape (samples,); load is None if it was not recorded.
        segments: parts without gaps.
        period: of the samples, s.
    """

    torque: np.ndarray
    motor: np.ndarray
    load: np.ndarray | None
    segments: Sequence[slice]
    period: float


class ZeroShift(NamedTuple):
    """Shift to be added to the positions of a log, rad, so that they have the zero of another log.

    Attributes:
        value: the smallest of the shifts that are about equally good.
        error: standard error.
        waves: periods a turn of the waves from which it was found.
    """

    value: float
    error: float
    waves: tuple[int, ...]


class _MovingRows(NamedTuple):
    """Low-passed rows in motion: torque, acceleration and other columns, cos(n position), sin(n position), n = 1, 2, ..."""

    torque: np.ndarray
    columns: np.ndarray
    cosine: np.ndarray
    sine: np.ndarray


def find_zero_shift(first: TurningLog, second: TurningLog) -> ZeroShift | None:
    """Find the shift that gives the positions of the second log the zero of the first.

    None if torques over the turn do not show a sure shift.
    """
    cutoff = min(_CUTOFF, 0.1 / max(first.period, second.period))
    first_rows, rows = (_select_moving_rows(log, cutoff) for log in (first, second))
    if first_rows is None or rows is None:
        return None
    return _find_shift(first_rows, rows) or _find_shift(*map(_exchange_acceleration, (first_rows, rows)))


def _exchange_acceleration(rows: "_MovingRows") -> "_MovingRows":
    """Exchange torque and acceleration: under a constant torque the acceleration shows what repeats with the turn."""
    # a constant torque is the column of ones once more
    varying_torque = rows.torque[:, None][:, : int(np.ptp(rows.torque) > 1e-6 * rms(rows.torque))]
    return rows._replace(torque=rows.columns[:, 0], columns=np.hstack([varying_torque, rows.columns[:, 1:]]))


def _find_shift(first_rows: "_MovingRows", rows: "_MovingRows") -> ZeroShift | None:
    regressors = np.hstack([first_rows.columns, first_rows.cosine, first_rows.sine])
    values, errors = fit_with_jackknife(first_rows.torque, regressors)
    if not np.isfinite(values).all():
        return None
    motion_terms = first_rows.columns.shape[1]
    cosine_error, sine_error = errors[motion_terms:].reshape(2, -1)
    cosine, sine = values[motion_terms:].reshape(2, -1)
    waves = np.flatnonzero(np.hypot(cosine / cosine_error, sine / sine_error) > _SURE_WAVE_ERRORS)
    if not len(waves):
        return None
    # torque a_n cos(n q) + b_n sin(n q) = Re((a_n - i b_n) exp(i n q))
    size = cosine[waves] - 1j * sine[waves]
    harmonics = waves + 1
    shifts = np.linspace(-np.pi, np.pi, 2 * (_SHIFTS_PER_PERIOD * int(harmonics[-1]) // 2), endpoint=False)
    turns = np.exp(1j * harmonics[:, None] * shifts) * size[:, None]
    signals = np.hstack([rows.torque[:, None], rows.cosine[:, waves] @ turns.real - rows.sine[:, waves] @ turns.imag])
    # without the part that the motion explains
    residuals = signals - rows.columns @ np.linalg.lstsq(rows.columns, signals, rcond=1e-10)[0]
    blocks = np.array_split(np.arange(len(residuals)), BLOCKS)
    squares_without_waves = np.array([np.sum(residuals[block, 0] ** 2) for block in blocks])
    squares = np.array([np.sum((residuals[block, :1] - residuals[block, 1:]) ** 2, axis=0) for block in blocks])
    total = squares.sum(axis=0)
    best, squares_unshifted = int(np.argmin(total)), squares[:, len(shifts) // 2]
    if not (
        _error_reduction(squares_without_waves, squares[:, best]) > _SURE_SHIFT_ERRORS
        and _error_reduction(squares_unshifted, squares[:, best]) > _BETTER_ERRORS
    ):
        return None
    lowest = np.flatnonzero((total <= np.roll(total, 1)) & (total <= np.roll(total, -1)))
    equal_shifts = [i for i in lowest if i == best or _error_reduction(squares[:, i], squares[:, best]) < _BETTER_ERRORS]
    chosen = min(equal_shifts, key=lambda i: abs(shifts[i]))
    # shifts within half a period of the fastest wave
    near = (chosen + np.arange(-(_SHIFTS_PER_PERIOD // 2), _SHIFTS_PER_PERIOD // 2 + 1)) % len(shifts)
    step = shifts[1] - shifts[0]
    value, *without = (
        shifts[chosen] + step * (_parabola_minimum(sums[near]) - _SHIFTS_PER_PERIOD // 2)
        for sums in (total, *(total - block_squares for block_squares in squares))
    )
    error = float(np.sqrt((BLOCKS - 1) / BLOCKS * np.sum((np.array(without) - np.mean(without)) ** 2)))
    if not abs(value) > _BETTER_ERRORS * error:
        return None
    return ZeroShift(float(value), error, tuple(int(n) for n in harmonics))


def _select_moving_rows(log: TurningLog, cutoff: float) -> _MovingRows | None:
    """Select the rows of a log in motion; None if it does not turn far enough."""
    parts = []
    for s in long_segments(log.segments):
        place = low_pass(log.motor[s], cutoff, log.period)
        velocity = np.gradient(place, log.period)
        columns = [np.gradient(velocity, log.period), velocity, smooth_sign(velocity), np.ones(len(place))]
        if log.load is not None:
            twist = place - low_pass(log.load[s], cutoff, log.period)
            columns += [twist, np.gradient(twist, log.period)]
        # long logs: only as many samples as the low-pass needs
        inner = trim_filter_ends(len(place), cutoff, log.period)
        rows = slice(inner.start, inner.stop, max(int(0.1 / (cutoff * log.period)), 1))
        cosine, sine = (
            np.stack(
                [low_pass(wave(n * log.motor[s]), cutoff, log.period)[rows] for n in range(1, _MAX_HARMONIC + 1)], axis=1
            )
            for wave in (np.cos, np.sin)
        )
        torque = low_pass(log.torque[s], cutoff, log.period)[rows]
        parts.append((torque, np.stack(columns, axis=1)[rows], cosine, sine))
    if not parts or sum(float(np.ptp(log.motor[s])) for s in log.segments) < _MIN_TURNS * 2.0 * np.pi:
        return None
    rows_in_segments = _MovingRows(*map(np.concatenate, zip(*parts, strict=True)))
    speed = np.abs(rows_in_segments.columns[:, 1])
    rows = speed > _MIN_SPEED_SHARE * rms(speed)
    moving_rows = _MovingRows(*(columns_of_rows[rows] for columns_of_rows in rows_in_segments))
    if np.ptp(np.sign(moving_rows.columns[:, 1])) == 0.0:
        # in one direction the sign of the velocity is the column of ones once more
        moving_rows = moving_rows._replace(columns=np.delete(moving_rows.columns, 2, axis=1))
    return moving_rows if len(moving_rows.torque) > BLOCKS * 2 * _MAX_HARMONIC else None


def _parabola_minimum(squares: np.ndarray) -> float:
    """Return the index at which squares are least, interpolated by a parabola."""
    best = int(np.clip(np.argmin(squares), 1, len(squares) - 2))
    before, middle, after = squares[best - 1 : best + 2]
    bend = before - 2.0 * middle + after
    return best + (float(np.clip(0.5 * (before - after) / bend, -1.0, 1.0)) if bend > 0.0 else 0.0)


def _error_reduction(squares: np.ndarray, reduced: np.ndarray) -> float:
    """Return by how many standard errors squares fall from `squares` to `reduced`, which are sums over blocks."""
    gains = squares - reduced
    # a difference by rounding is none
    return float(np.mean(gains) / max(np.std(gains, ddof=1) / np.sqrt(len(gains)), 1e-6 * np.mean(squares), 1e-300))
