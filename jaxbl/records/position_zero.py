"""Zero positions of two logs: an incremental encoder is at zero wherever it was switched on.

Torques that repeat with the turn (cogging, ripple, gravity) are the same in all logs of a machine. Those of one log predict
another log if its positions are shifted by the difference of the zeros.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .least_squares import BLOCKS, column_rms, fit_residual, fit_with_jackknife, jackknife_variance, mean_error, rms
from .rigid_body import MIN_SPEED_SHARE, smooth_sign
from .signal_quality import long_segments, low_pass, low_pass_motion, trim_filter_ends

_MAX_HARMONIC = 40
"""Largest number of periods a turn: more than poles, slots and balls of small drives make."""
_MIN_PERIODS = 2.0
"""Periods of a wave that a log has to cover to show it: over fewer ones it does not repeat."""
_CUTOFF = 50.0
"""Cutoff of the low-pass for accelerations, Hz: above it their noise is larger than the torques of most drives."""
_MIN_ROWS = 10 * BLOCKS
"""Rows of a log in motion at least: some ten in each block."""
_SURE_ERRORS = 6.0
"""Standard errors from which on a wave or a shift is sure: one of eighty numbers exceeds them by chance in 1 log of 100."""
_MOST_WAVES = 8
"""Waves that are sought: the largest of them are enough to tell a shift."""
_SURE_SHIFT_ERRORS, _BETTER_ERRORS = 4.0, 3.0
"""Standard errors by which shifted waves have to be better than no waves, among a hundred shifts, and than another shift."""
_SHIFTS_PER_PERIOD = 8
"""Shifts that are compared in each period of the fastest wave."""


class TurningLog(NamedTuple):
    """Signals of a log in which torques over the turn are searched.

    Attributes:
        torque: held from each sample to the next, N m, shape (samples,).
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
    """Low-passed rows in motion.

    Attributes:
        signals: torque, acceleration, velocity, its sign, and with a load the twist and its rate, shape (rows, 4 or 6).
        waves: exp(i n position), n = 1, 2, ..., shape (rows, waves).
    """

    signals: np.ndarray
    waves: np.ndarray


def find_zero_shift(first: TurningLog, second: TurningLog) -> ZeroShift | None:
    """Find the shift that gives the positions of the second log the zero of the first.

    None if torques over the turn do not show a sure shift.
    """
    cutoff = min(_CUTOFF, 0.1 / max(first.period, second.period))
    first_rows, rows = (_select_moving_rows(log, cutoff) for log in (first, second))
    if first_rows is None or rows is None:
        return None
    # the arc, however often it was gone over
    turns = np.ptp(np.concatenate([first.motor[segment] for segment in first.segments])) / (2.0 * np.pi)
    if turns * _MAX_HARMONIC < _MIN_PERIODS:
        return None
    lowest = int(np.ceil(_MIN_PERIODS / turns))
    # under a constant torque the acceleration shows what repeats with the turn
    order = [1, 0, *range(2, rows.signals.shape[1])]
    first_exchanged, exchanged = (log._replace(signals=log.signals[:, order]) for log in (first_rows, rows))
    return _find_shift(first_rows, rows, lowest) or _find_shift(first_exchanged, exchanged, lowest)


def _find_shift(first_rows: _MovingRows, rows: _MovingRows, lowest_wave: int) -> ZeroShift | None:
    """Find the shift of the second rows by the waves of the first, which are of `lowest_wave` periods a turn and more."""
    # a column that does not vary is a constant, and a torque that does not vary shows no waves
    torque_varies, *varies = np.ptp(first_rows.signals, axis=0) > 1e-6 * column_rms(first_rows.signals)
    if not torque_varies:
        return None
    # what does not repeat within the log, such as gravity over part of a turn, is no wave, and would be taken for one
    motion, slow = first_rows.signals[:, 1:][:, varies], slice(lowest_wave - 1)
    beside = np.column_stack([motion, _find_basis(first_rows.waves[:, slow])])
    waves, values = _find_waves(first_rows, beside, lowest_wave - 1)
    if not waves:
        return None
    cosine, sine = values[beside.shape[1] :].reshape(-1, 2).T
    # torque a_n cos(n q) + b_n sin(n q) = Re((a_n - i b_n) exp(i n q))
    size, harmonics = cosine - 1j * sine, np.array(waves) + 1
    shifts = np.linspace(-np.pi, np.pi, 2 * (_SHIFTS_PER_PERIOD * int(harmonics.max()) // 2), endpoint=False)
    turns = np.exp(1j * harmonics[:, None] * shifts) * size[:, None]
    # what the motion takes is known by the first log, but for constants and what depends on the zero
    columns, constant = rows.signals[:, 1:], np.logical_not(varies)
    torque = rows.signals[:, 0] - columns[:, varies] @ values[: motion.shape[1]]
    signals = np.column_stack([torque, (rows.waves[:, waves] @ turns).real])
    residuals = fit_residual(signals, np.column_stack([columns[:, constant], _find_basis(rows.waves[:, slow])]))
    # without waves, and with those at each shift
    residuals[:, 1:] -= residuals[:, :1]
    block_squares = np.array([np.sum(part**2, axis=0) for part in np.array_split(residuals, BLOCKS)])
    squares_without_waves, squares = block_squares[:, 0], block_squares[:, 1:]
    total = squares.sum(axis=0)
    best = np.argmin(total)
    if not _error_reduction(squares_without_waves, squares[:, best]) > _SURE_SHIFT_ERRORS:
        return None
    lowest = np.flatnonzero((total <= np.roll(total, 1)) & (total <= np.roll(total, -1)))
    equal_shifts = [i for i in lowest if i == best or _error_reduction(squares[:, i], squares[:, best]) < _BETTER_ERRORS]
    chosen = min(equal_shifts, key=lambda i: abs(shifts[i]))
    # shifts within half a period of the fastest wave
    near = (chosen + np.arange(-(_SHIFTS_PER_PERIOD // 2), _SHIFTS_PER_PERIOD // 2 + 1)) % len(shifts)
    step = shifts[1] - shifts[0]
    value, *without = (
        shifts[chosen] + step * (_parabola_minimum(sums[near]) - _SHIFTS_PER_PERIOD // 2)
        for sums in (total, *(total - squares))
    )
    error = float(np.sqrt(jackknife_variance(without)))
    if not abs(value) > _SURE_ERRORS * error:
        return None
    return ZeroShift(float(value), error, tuple(sorted(harmonics.tolist())))


def _find_basis(waves: np.ndarray) -> np.ndarray:
    """Return orthonormal columns that span a constant and some waves, as far as numbers tell these apart."""
    from scipy.linalg import orth

    return orth(np.column_stack([np.ones(len(waves)), np.real(waves), np.imag(waves)]), rcond=1e-6)


def _find_waves(rows: _MovingRows, motion: np.ndarray, lowest: int) -> tuple[list[int], np.ndarray]:
    """Find the waves that a log surely shows, the one that takes away most first, and fit them beside the motion.

    All at once would not do: over a few turns neighbouring waves look alike.

    Returns:
        Columns of the waves, and coefficients of the motion and of each wave's cosine and sine.
    """
    waves: list[int] = []
    columns, values = motion, np.zeros(0)
    while len(waves) < _MOST_WAVES:
        basis = np.linalg.qr(columns)[0]
        torque, candidates = (part - basis @ (basis.T @ part) for part in (rows.signals[:, 0], rows.waves[:, lowest:]))
        pairs = [np.linalg.qr(np.column_stack([wave.real, wave.imag]))[0] for wave in candidates.T]
        wave = lowest + int(np.argmax([np.sum((pair.T @ torque) ** 2) for pair in pairs]))
        columns = np.column_stack([columns, np.real(rows.waves[:, wave]), np.imag(rows.waves[:, wave])])
        coefficients, errors = fit_with_jackknife(rows.signals[:, 0], columns)
        if not np.hypot(*(coefficients[-2:] / errors[-2:])) > _SURE_ERRORS:
            break
        waves, values = [*waves, wave], coefficients
    return waves, values


def _select_moving_rows(log: TurningLog, cutoff: float) -> _MovingRows | None:
    """Select the rows of a log in motion; None if there are too few."""
    parts = []
    for s in long_segments(log.segments):
        place, velocity, acceleration = low_pass_motion(log.motor[s], cutoff, log.period)
        held = log.torque[s]
        torque = low_pass(0.5 * (np.append(held[:1], held[:-1]) + held), cutoff, log.period)
        signals = [torque, acceleration, velocity, smooth_sign(velocity)]
        if log.load is not None:
            twist = place - low_pass(log.load[s], cutoff, log.period)
            signals += [twist, np.gradient(twist, log.period)]
        # long logs: only as many samples as the low-pass needs
        inner = trim_filter_ends(len(place), cutoff, log.period)
        rows = slice(inner.start, inner.stop, max(int(0.1 / (cutoff * log.period)), 1))
        turns = (np.exp(1j * n * log.motor[s]) for n in range(1, _MAX_HARMONIC + 1))
        waves = np.stack([low_pass(turn, cutoff, log.period)[rows] for turn in turns], axis=1)
        parts.append((np.column_stack(signals)[rows], waves))
    if not parts:
        return None
    signals, waves = (np.concatenate(pieces) for pieces in zip(*parts, strict=True))
    velocity = signals[:, 2]
    is_moving = np.abs(velocity) > MIN_SPEED_SHARE * rms(velocity)
    signals, waves = signals[is_moving], waves[is_moving]
    if len(signals) <= _MIN_ROWS:
        return None
    if np.ptp(np.sign(signals[:, 2])) == 0.0:
        # in one direction the sign of the velocity is a constant
        signals[:, 3] = 1.0
    return _MovingRows(signals, waves)


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
    return float(np.mean(gains) / max(mean_error(gains), 1e-6 * np.mean(squares), 1e-300))
