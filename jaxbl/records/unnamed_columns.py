"""Tell columns of a log by how they move, where their names do not."""

import re
from collections.abc import Mapping

import numpy as np

from .libraries import ColumnName
from .rigid_body import fit_rigid_drive

_Signals = Mapping[ColumnName, np.ndarray]
_SAME, _GEARED = 0.9, 0.99
"""Correlation from which on columns show one motion, before and behind a controller, or a gear."""
_SAME_SIZE = 0.25
"""Relative difference in size up to which one of two alike is the other's reference, which it may overshoot or cut short;
more is a gear."""
_LATE = 1e-6
"""Slope of the correlation of two columns at no shift, a row, from which on one is later: rounding aside."""
_SPEED = 0.95
"""Share of a column that goes with the velocity, from which on it is a speed."""
_UNEXPLAINED = 0.55
"""Share of a torque that acceleration, velocity and direction do not explain at most, in a plain drive."""
_ROUND = (1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 8.0, 10.0)
"""Digits of usual periods; degrees beside rad/s, or rad beside rpm, give others."""


def rises_evenly(values: np.ndarray) -> bool:
    """Return True for numbers that rise from row to row by about as much, as stamps and row numbers do."""
    steps = np.diff(values) if values.dtype.kind in "iuf" else np.zeros(0)
    return len(steps) > 0 and bool((steps > 0.0).all() and np.ptp(steps) < 3.0 * np.median(steps))


def find_stamps(columns: _Signals) -> ColumnName | None:
    """Find the first column that rises evenly, or holds dates or times; one that only counts rows is none."""
    for column, values in columns.items():
        is_date = values.dtype.kind == "M" or (values.dtype.kind == "O" and re.match(r".*\d[:-]\d", str(values[0])))
        if is_date or (rises_evenly(values) and not (np.diff(values) == 1.0).all()):
            return column
    return None


def find_latest(signals: _Signals) -> ColumnName:
    """Return the latest column of the same motion as the first one: a reference leads what follows it."""
    from scipy.signal import correlate

    latest, *later = signals
    for column in later:
        before, after = (signals[name] - np.mean(signals[name]) for name in (latest, column))
        size = np.linalg.norm(before) * np.linalg.norm(after) or np.inf
        is_same = abs(np.std(after) - np.std(before)) < _SAME_SIZE * np.std(before)
        if is_same and correlate(before, after).max() > _SAME * size and before @ np.gradient(after) > _LATE * size:
            latest = column
    return latest


def find_moving_columns(signals: _Signals, times: np.ndarray | None = None) -> tuple[dict[str, ColumnName], float | None]:
    """Guess positions and torque of a drive; the position is the smoothest column, the motor's side moves further.

    Args:
        signals: finite columns that move, shape (rows,) each.
        times: of the rows, in any unit; None if they are not known.

    Returns:
        Columns by channel, and the period in s by which the speed is the slope of the position; None if there is none.
    """
    if len({len(values) for values in signals.values()}) != 1:
        return {}, None
    period = float(np.median(np.diff(times))) if times is not None and times.dtype.kind in "iuf" else 1.0
    names = [*signals]
    moves = np.stack([signals[name] - np.mean(signals[name]) for name in names])
    size = np.std(moves, axis=1)
    first = np.argmin(np.std(np.diff(moves), axis=1) / size)
    likeness = moves @ moves[first] / (moves.shape[1] * size * size[first])
    is_same = (likeness > _SAME) & (np.abs(size / size[first] - 1.0) < _SAME_SIZE)
    position = find_latest({names[i]: signals[names[i]] for i in np.flatnonzero(is_same)})
    channels: dict[str, ColumnName] = {"theta_e": position}
    geared = np.where(is_same, 0.0, np.abs(likeness))
    if geared.max() > _GEARED:
        motor, load = sorted((position, names[geared.argmax()]), key=lambda name: -np.std(signals[name]))
        channels = {"theta_e": motor, "theta_s": load}
    torques, found_period = dict[float, ColumnName](), None
    for i in np.flatnonzero(~is_same & (geared <= _GEARED)):
        fit = fit_rigid_drive(moves[i], signals[position], [slice(0, moves.shape[1])], period)
        if fit is None or fit.residual > _UNEXPLAINED:
            continue
        # a speed is the slope of the position, and takes no acceleration
        if fit.shares[1] < _SPEED:
            torques[fit.residual] = names[i]
        elif times is None:
            ratio = 1.0 / abs(fit.values[1])
            decade = 10.0 ** np.floor(np.log10(ratio))
            found_period = next((decade * digits for digits in _ROUND if abs(ratio / decade / digits - 1.0) < 0.01), None)
    if torques:
        channels["u"] = torques[min(torques)]
    return channels, found_period
