"""Whether logs of one machine agree on its numbers.

One model for several logs takes a mean of what they show. Here each log says by itself what the numbers should be: by
regression of the torque that the model still lacks there, while the drive moves, on that torque's slopes, with standard
errors by blocks. A dry friction and a steady torque that the model lacks take part in it, since they would go into other
numbers, into other ones in each log.
"""

import dataclasses
import itertools
from os.path import commonpath, relpath
from typing import NamedTuple

import numpy as np

from jaxbl.drive.parameters import set_leaves
from jaxbl.estimation.logs import arrays
from jaxbl.json_types import JsonObject
from jaxbl.quantity import Quantity
from jaxbl.records.least_squares import BlockRegression, column_rms, rms

from .diagnosis_task import DiagnosisTask
from .reference_log import ReferenceLog
from .refit import FittedModel
from .thresholds import LIMITS

_STEP = 1e-3
"""Change of theta by which a slope is found."""
_LEAST = 0.05
"""Share of the driving torque that the difference has to make."""
_LOST = 0.1
"""Share of a number that noise may take off what a log says of it: of a load that hardly moves the acceleration is noise."""
_AGREEING = 0.01
"""Share of the error by noise alone, below which an error by blocks is none."""
_INFLATED = 100.0
"""Variance of a number over what it were if all others were known, from which on it depends on them."""


def contradictions(task: DiagnosisTask, fitted: FittedModel, log: ReferenceLog, driving: float) -> list[JsonObject]:
    """Numbers of a model that its logs surely do not agree on, as in `diagnosis.json`: what the two logs say that are
    furthest apart for their errors, the smaller number first; none of a single log.

    Args:
        task: names the logs.
        fitted: the model, its numbers fitted to all of `log` at once.
        log: what was fitted.
        driving: torque that drives the machine, rms, N m.
    """
    parts = []
    for path, rows in task.record.logs:
        within = [segment for segment in log.segments if rows.start <= segment.rows.start and segment.rows.stop <= rows.stop]
        if within:
            parts.append((path, dataclasses.replace(log, segments=within)))
    if len(parts) < 2 or not fitted.free:
        return []
    folder = commonpath([path.parent for path, _ in parts])
    names, by_log = [relpath(path, folder) for path, _ in parts], [_read_numbers(fitted, part) for _, part in parts]
    contradicting = []
    for k, number in enumerate(fitted.free):
        apart = {
            (first, other): _apart(by_log[first], by_log[other], k, _LEAST * driving)
            for first, other in itertools.combinations(range(len(by_log)), 2)
        }
        pair = max(apart, key=apart.__getitem__)
        if not apart[pair] > LIMITS.contradicting:
            continue
        value, slope = (float(of(fitted.theta[k])) for of in (number.value, number.slope))
        logs = [
            {"log": names[i]}
            | Quantity(value + slope * float(by_log[i].change[k]), abs(slope) * float(by_log[i].error[k])).to_dict()
            for i in pair
        ]
        unit = task.record.unit_of(number.path, number.unit)
        logs.sort(key=lambda of_log: of_log["value"])
        contradicting.append({"parameter": number.path, "unit": unit, "logs": logs})
    return contradicting


class _Reading(NamedTuple):
    """A model's theta as a log shows it: by how much each number should be changed, the standard error, the torque of a
    change of 1 at the motor, rms, N m, and by how much noise in that torque makes the change too small: a regression loses
    the square of noise over size."""

    change: np.ndarray
    error: np.ndarray
    torque: np.ndarray
    lost: np.ndarray


def _read_numbers(fitted: FittedModel, log: ReferenceLog) -> _Reading:
    now, noises = log.missing(fitted.experiment), log.missing(fitted.experiment, "deviation")
    moved = [
        log.missing(set_leaves(fitted.experiment, arrays({number.path: number.value(theta + _STEP)})))
        for number, theta in zip(fitted.free, fitted.theta, strict=True)
    ]
    # of equal weight on both sides, whatever the gear
    sides, torque, lost, count = [], np.zeros(len(moved)), np.full(len(moved), np.inf), 1
    for i, (side, every_row) in enumerate(now.items()):
        friction, moving = log.lacking_friction(fitted.experiment, side)
        missing, noise = every_row[moving], noises[side][moving]
        slopes = np.stack([(torques[side][moving] - missing) / _STEP for torques in moved])
        count += len(missing)
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            size = np.nan_to_num(column_rms(slopes.T))
            torque = np.hypot(torque, size / float(fitted.experiment.drive.ratio(side)))
            # of a number that has nothing to do with this side
            lost = np.fmin(lost, np.mean(noise**2) / size**2)
        # columns of their own for each side
        beside = np.kron(np.eye(len(now))[:, [i]], friction[:, moving])
        size = max(rms(every_row), 1e-300)
        sides.append(BlockRegression.of(-missing / size, np.concatenate([slopes, beside]).T / size))
    regression = BlockRegression(np.sum([side.products for side in sides], axis=0), sides[0].counts)
    columns = slice(len(moved))
    change, error = regression.fit()[columns], regression.errors()[columns]
    # blocks that agree far better than noise allows have not been measured: of a drive that stands still the model says it
    agreeing = error < _AGREEING * np.sqrt(lost / count)
    # what depends on other numbers, or does nothing in this log, is not shown by it
    unit, size = regression.unit_matrix
    inflation = np.diag(np.linalg.pinv(unit, rcond=1e-10, hermitian=True))[columns]
    alone = np.isfinite(size[columns]) & ~agreeing & (lost < _LOST) & (inflation < _INFLATED) & (inflation > 0.0)
    return _Reading(change, np.where(alone, error, np.inf), torque, lost)


def _apart(first: _Reading, other: _Reading, k: int, least: float) -> float:
    """Standard errors between two logs in a number; 0 where the difference makes less than a torque of `least`."""
    apart = abs(first.change[k] - other.change[k]) - first.lost[k] - other.lost[k]
    if not apart * max(first.torque[k], other.torque[k]) > least:
        return 0.0
    return float(apart / max(np.hypot(first.error[k], other.error[k]), 1e-300))
