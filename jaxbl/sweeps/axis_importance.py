"""Which axes of a quasi-random study matter: shares of an error's variance (Sobol' indices), estimated by SALib."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from .sweep import StudyResult

_LEAST_POINTS = 100
"""Points below which no index is estimated: a tenth of them lies beside each of the ten harmonics that RBD-FAST counts."""
_MOST_RUNS = 2**20
"""Runs that are read at most, from the first on: their indices are known to about 0.01."""


class AxisImportance(NamedTuple):
    """Shares of the variance of log10(error) that an axis explains, with half widths of their 95 % intervals.

    Attributes:
        path: of the axis.
        alone: by this axis alone (first-order index), and its half width.
        total: with all that it does together with others (total index), and its half width; None unless the design is
            Saltelli's.
    """

    path: str
    alone: tuple[float, float]
    total: tuple[float, float] | None


def rank_axes(result: StudyResult, error: str) -> list[AxisImportance]:
    """Rank the axes that a study draws at random by what they explain of a metric's variance, the largest first.

    A point's error is the mean of log10(error) over its noise seeds and the values of listed axes. A run without a finite
    error counts as the worst of all, one of 0 as the least above it. By RBD-FAST (Tarantola, Gatelli, Mara, 2006); of
    Saltelli's design by the estimators of Saltelli et al. (2010).

    Args:
        result: a study with a design that is no grid.
        error: metric, e.g. `motor.velocity_rmse`.

    Returns:
        One item an axis; none of a grid, of fewer than 100 points, or if all errors are alike.
    """
    sweep = result.config.sweep
    axes = [axis for axis in result.config.axes if axis.values is None and axis.num is None]
    if sweep.design == "grid":
        return []
    paths = [axis.path for axis in axes]
    points = _read_points(result, paths, error)
    inputs, outcomes = points[paths].to_numpy(), points[error].to_numpy()
    if len(points) < _LEAST_POINTS or np.ptp(outcomes) == 0.0:
        return []
    problem = {"num_vars": len(paths), "names": paths, "bounds": [[axis.start, axis.stop] for axis in axes]}
    if sweep.design == "saltelli" and len(points) == sweep.points:  # its estimators need all of it
        from SALib.analyze import sobol

        indices = sobol.analyze(problem, outcomes, calc_second_order=False, seed=0)
    else:
        from SALib.analyze import rbd_fast

        indices = rbd_fast.analyze(problem, inputs, outcomes, seed=0)
    ranked = [AxisImportance(path, _pair(indices, "S1", i), _pair(indices, "ST", i)) for i, path in enumerate(paths)]
    return sorted(ranked, key=lambda axis: -(axis.total or axis.alone)[0])


def _read_points(result: StudyResult, paths: list[str], error: str) -> pd.DataFrame:
    """Read mean log10 errors by point, in the design's order."""
    frames, runs = [], 0
    for frame in result.batches([*paths, "finite", error]):
        frames.append(frame)
        runs += len(frame)
        if runs >= _MOST_RUNS:
            break
    rows = pd.concat(frames, ignore_index=True)
    errors = rows[error].where(rows["finite"] & np.isfinite(rows[error]))
    logs = np.log10(errors.clip(lower=errors[errors > 0.0].min()))
    rows[error] = logs.fillna(logs.max())
    return rows.groupby(paths, sort=False)[error].mean().reset_index()


def _pair(indices: Mapping[str, Any], key: str, i: int) -> Any:
    return (float(indices[key][i]), float(indices[f"{key}_conf"][i])) if key in indices else None
