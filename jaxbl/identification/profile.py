"""Profile-likelihood intervals: how far one number can go before the fit, all others following, becomes too bad.

Right where the fit is not quadratic over the width of an interval, at the price of a few fits for each end.
References: D. Bates, D. Watts, Nonlinear Regression Analysis (1988), 6.1; D. Venzon, S. Moolgavkar, Appl. Stat. 37 (1988).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from jaxbl.simulate import Experiment

from .intervals import Spread
from .trajectory import Fit, Free, Windows, fits

_PASSES = 4
"""Points on each side of the best value: as the root of the deviance is nearly straight, the last is close to the limit."""
_FURTHEST = 3.0
"""Largest step of theta from the best value: a factor of e^3."""
_MOST_STEPS = 15
"""Of the solver at each point: it starts where the one before ended."""


class Profile(NamedTuple):
    """Profile of one number.

    Attributes:
        interval: where the deviance reaches its limit; an end is infinite (0 for positive numbers) where it does not within
            a factor of e^3.
        values: that were tried, in order, shape (n,).
        deviance: increase of twice the negative log-likelihood there, correlation of the residuals counted, shape (n,).
    """

    interval: tuple[float, float]
    values: np.ndarray
    deviance: np.ndarray


def profile(
    experiment: Experiment, free: Sequence[Free], windows: Windows, best: Fit, width: Spread, level: float = 0.95
) -> dict[str, Profile]:
    """Profile every fitted number.

    The likelihood counts residuals as many times as they are independent: its curvature is that of the covariance of
    :func:`jaxbl.identification.intervals.spread`.

    Args:
        experiment: nominal.
        free: what was fitted.
        windows: the record.
        best: the fit.
        width: its covariance.
        level: of confidence.
    """
    count, limit = len(free), float(stats.chi2.ppf(level, 1))
    centre, covariance = np.asarray(best.theta), np.asarray(width.covariance)
    deviation = np.sqrt(np.diag(covariance))
    # residuals of noise alone have variance 1; what one of them counts follows from its correlation with its neighbours
    worth = float(width.variance) * np.asarray(width.inflation) ** 2

    which = np.repeat(np.arange(count), 2)
    sign = np.tile([-1.0, 1.0], count)
    steps = np.sqrt(limit) * deviation[which]
    others = covariance[:, which].T / np.diag(covariance)[which, None]
    tried = [[(0.0, 0.0)] for _ in which]
    for _ in range(_PASSES):
        steps = np.minimum(steps, _FURTHEST)
        thetas = centre[None, :] + (sign * steps)[:, None] * others
        tries = fits(experiment, free, windows, thetas, _MOST_STEPS, np.eye(count, dtype=bool)[which])
        cost, found = np.array([one.cost for one in tries]), np.array([one.theta for one in tries])
        deviance = 2.0 * (cost - float(best.cost)) / worth[which]
        for i, one in enumerate(deviance):
            tried[i].append((float(steps[i]), float(one)))
        # start the next fits where these ended
        others = (found - centre[None, :]) / (sign * steps)[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = np.sqrt(limit / np.maximum(deviance, 0.0))
        steps = steps * np.clip(np.where(np.isfinite(factor), factor, 0.3), 0.3, 3.0)
    return {one.path: _gathered(one, centre[i], tried[2 * i], tried[2 * i + 1], limit) for i, one in enumerate(free)}


def _gathered(
    one: Free, centre: float, below: list[tuple[float, float]], above: list[tuple[float, float]], limit: float
) -> Profile:
    lower, upper = (_end(points, limit) for points in (below, above))
    points = sorted([(-step, d) for step, d in below] + [(step, d) for step, d in above[1:]])
    low, high = (float(one.value(centre + step)) if np.isfinite(step) else _open(one, step) for step in (-lower, upper))
    values = np.array([float(one.value(centre + step)) for step, _ in points])
    return Profile((low, high), values, np.array([d for _, d in points]))


def _open(one: Free, step: float) -> float:
    return 0.0 if one.positive and step < 0.0 else step


def _end(points: list[tuple[float, float]], limit: float) -> float:
    """Step at which the root of the deviance, which is nearly straight, reaches that of its limit."""
    steps, roots = (np.array(x) for x in zip(*sorted((s, np.sqrt(max(d, 0.0))) for s, d in points), strict=True))
    goal = np.sqrt(limit)
    beyond = np.flatnonzero(roots >= goal)
    if len(beyond) == 0:
        return np.inf if steps[-1] >= _FURTHEST else float(steps[-1] * goal / max(roots[-1], 1e-9))
    at = int(beyond[0])
    share = (goal - roots[at - 1]) / (roots[at] - roots[at - 1])
    return float(steps[at - 1] + share * (steps[at] - steps[at - 1]))
