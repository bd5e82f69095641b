"""How well fitted numbers are known: covariance with correlated residuals, intervals, what a record does not show.

Profile-likelihood intervals say how far one number can go before the fit, all others following, becomes too bad: right where
the fit is not quadratic over the width of an interval, at the price of a few fits for each end.
References: W. Newey, K. West, Econometrica 55 (1987); D. Andrews, Econometrica 59 (1991), for the bandwidth; D. Bates,
D. Watts, Nonlinear Regression Analysis (1988), 6.1; D. Venzon, S. Moolgavkar, Appl. Stat. 37 (1988).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, ndtri

from jaxbl.chain import Experiment

from .free_parameters import FreeParameter, set_free_parameters
from .trajectory import Fit, Windows, fit

NORMAL = float(ndtri(0.975))
"""Standard errors on either side of a value that a 95 % interval reaches to."""
LIMIT = float(chdtri(1.0, 0.05))
"""Deviance at the ends of a 95 % interval of one number."""
UNSEEN = 0.5
"""Relative standard deviation beyond which a direction counts as not shown by the record."""
_PASSES = 4
"""Points on each side of the best value: as the root of the deviance is nearly straight, the last is close to the limit."""
_FURTHEST = 3.0
"""Largest step of theta from the best value: a factor of e^3."""
_MOST_STEPS = 15
"""Of the solver at each point: it starts where the one before ended."""


class Spread(NamedTuple):
    """Covariance of a fit.

    Attributes:
        covariance: of theta, shape (parameters, parameters).
        information: J^T J over the residuals' variance, shape (parameters, parameters).
        variance: mean square of the whitened residuals; 1 where noise alone is left.
        inflation: factor on the standard errors by the correlation of the residuals, shape (parameters,).
    """

    covariance: np.ndarray
    information: np.ndarray
    variance: float | np.floating
    inflation: np.ndarray

    @property
    def deviations(self) -> np.ndarray:
        """Standard errors of theta, shape (parameters,)."""
        return np.sqrt(np.diag(self.covariance))

    def with_error(self, *changes: np.ndarray) -> "Spread":
        """Count changes of theta, each of shape (parameters,), as further errors."""
        wide = self.covariance + sum(np.outer(change, change) for change in changes)
        more = np.sqrt(np.diag(wide) / np.diag(self.covariance))
        return self._replace(covariance=wide, inflation=self.inflation * more)

    def only(self, places: np.ndarray) -> "Spread":
        """The spread of some numbers; what is left open of the others is no information."""
        covariance = self.covariance[np.ix_(places, places)]
        return Spread(covariance, invert(covariance), self.variance, self.inflation[places])


def spread(fit: Fit, least: int = 1) -> Spread:
    """Covariance of theta by the sandwich J+ E[r r^T] J+^T, the middle by Newey and West with Andrews' bandwidth.

    `least`: samples over which residuals may be correlated, at least.
    """
    return spread_of(fit.residual, fit.jacobian, 2 * len(fit.start.position), least)


# of what diverges nothing is finite
@np.errstate(all="ignore")
def spread_of(
    residual: np.ndarray, jacobian: np.ndarray, states: int, least: int = 1, precision: np.ndarray | float = 0.0
) -> Spread:
    """The same of residuals, their derivatives (shapes as of a fit), the number of a window's initial states, and the
    precision of a prior of theta, shape (parameters,)."""
    windows, samples, _, parameters = jacobian.shape
    freedom = residual.size - parameters - windows * states
    variance, flat = np.sum(residual**2) / freedom, jacobian.reshape(-1, parameters)
    prior = np.diag(np.broadcast_to(precision, parameters))
    information = flat.T @ flat / variance + prior
    size = np.sqrt(np.diag(information))
    size = np.where(size > 0.0, size, 1.0)
    scores = np.einsum("wtsp,wts->wtp", jacobian / size, residual).reshape(windows * samples, parameters) / variance
    middle = long_run(scores, least) * np.outer(size, size) * residual.size / freedom + prior
    plain, (sizes, ways) = invert(information), np.linalg.eigh(middle)
    # by a root of the middle: never negative, whatever rounding does
    half = plain @ (ways * np.sqrt(np.maximum(sizes, 0.0)))
    sandwich = half @ half.T
    inflation = np.sqrt(np.maximum(np.diag(sandwich), np.finfo(float).tiny) / np.diag(plain))
    # elimination of initial states leaves a little negative correlation behind: nothing to gain confidence from
    more = np.maximum(1.0 / inflation, 1.0)
    return Spread(sandwich * np.outer(more, more), information, variance, inflation * more)


def invert(matrix: np.ndarray) -> np.ndarray:
    """Invert a symmetric positive matrix; directions that are lost in rounding keep what rounding leaves."""
    if not len(matrix) or not np.isfinite(matrix).all():
        return matrix
    size = np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(matrix / np.outer(size, size))
    values = np.maximum(values, 1e-14 * len(values) * values[-1])
    return (vectors / values) @ vectors.T / np.outer(size, size)


def long_run(scores: np.ndarray, least: int = 1) -> np.ndarray:
    """Sum of a series' autocovariances under Bartlett's weights over `least` samples or more, times its length."""
    count = len(scores)
    square = np.sum(scores**2, axis=0)
    rho = np.sum(scores[1:] * scores[:-1], axis=0) / np.where(square > 0.0, square, 1.0)
    rho = np.clip(rho, -0.99, 0.999)
    weight = square**2
    top = np.sum(weight * 4.0 * rho**2 / ((1.0 - rho) ** 6 * (1.0 + rho) ** 2))
    bottom = np.sum(weight / (1.0 - rho) ** 4)
    wide = 1.1447 * (top / np.where(bottom > 0.0, bottom, 1.0) * count) ** (1.0 / 3.0)
    # nothing is known where the fit diverged
    length = int(np.clip(np.ceil(wide), least, count // 10)) if np.isfinite(wide) else 1
    # Bartlett's weights are those of all sums over `length` neighbours
    total = np.concatenate([np.zeros((1, scores.shape[1])), np.cumsum(scores, axis=0)])
    last = np.arange(2 * count)
    sums = total[np.clip(last, 0, count)] - total[np.clip(last - length, 0, count)]
    return sums.T @ sums / length


def interval(parameter: FreeParameter, theta: float, deviation: float) -> tuple[float, float]:
    """95 % interval of a value, from its theta; never below zero where the value must be positive."""
    reach = NORMAL * deviation
    return float(parameter.value(theta - reach)), float(parameter.value(theta + reach))


class Refusal(NamedTuple):
    """A combination of numbers that the record does not show: relative changes by path, how uncertain it is, and the reason;
    "" where that follows from the path."""

    direction: dict[str, float]
    deviation: float
    reason: str = ""


def refusals(free: Sequence[FreeParameter], width: Spread) -> tuple[list[Refusal], float]:
    """Directions of theta with a standard deviation above :data:`UNSEEN`, and the condition number of the information.

    Directions are eigenvectors of the covariance, components below a tenth of the largest left out.
    """
    values, vectors = np.linalg.eigh(width.information)
    condition = float(np.sqrt(values[-1] / values[0])) if values[0] > 0.0 else float("inf")
    inflation = float(np.max(np.nan_to_num(width.inflation, nan=1.0)))
    refused = []
    for value, vector in zip(values, vectors.T, strict=True):
        deviation = max(inflation, 1.0) / np.sqrt(value) if value > 0.0 else float("inf")
        if deviation > UNSEEN:
            vector = vector / vector[np.argmax(np.abs(vector))]
            direction = {parameter.path: float(x) for parameter, x in zip(free, vector, strict=True) if abs(x) >= 0.1}
            refused.append(Refusal(direction, float(deviation)))
    return refused, condition


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
    experiment: Experiment, free: Sequence[FreeParameter], windows: Windows, best: Fit, width: Spread
) -> dict[str, Profile]:
    """Profile every fitted number, for intervals of 95 %.

    The likelihood counts residuals as many times as they are independent: its curvature is that of the covariance of
    :func:`spread`.
    """
    centre, covariance = best.theta, width.covariance
    # residuals of noise alone have variance 1; what one of them counts follows from its correlation with its neighbours
    worth, profiles = float(width.variance) * width.inflation**2, {}
    for i, parameter in enumerate(free):
        ends, profile_points = [], [(0.0, 0.0)]
        for sign in (-1.0, 1.0):
            step, direction = np.sqrt(LIMIT * covariance[i, i]), covariance[:, i] / covariance[i, i]
            points = [(0.0, 0.0)]
            for _ in range(_PASSES):
                step = min(step, _FURTHEST)
                theta = centre + sign * step * direction
                model = set_free_parameters(experiment, [parameter._replace(minimum=None)], theta[[i]])
                end = fit(model, [*free[:i], *free[i + 1 :]], windows, np.delete(theta, i), _MOST_STEPS)
                deviance = 2.0 * (end.cost - best.cost) / worth[i]
                points.append((step, deviance))
                # the next fit starts where this one ended
                direction = (np.insert(end.theta, i, theta[i]) - centre) / (sign * step)
                # rounding may leave less than none, and a fit that diverged no number
                factor = np.sqrt(LIMIT / deviance) if deviance > 0.0 else 0.3
                step *= np.clip(factor, 0.3, 3.0)
            reach = sign * step_at_limit(points)
            ends.append(float(parameter.value(centre[i] + reach)) if np.isfinite(reach) else reach)
            profile_points += [(sign * step, deviance) for step, deviance in points[1:]]
        low = ends[0] if parameter.minimum is None else max(ends[0], parameter.minimum)
        steps, deviances = np.array(sorted(profile_points)).T
        profiles[parameter.path] = Profile((low, ends[1]), parameter.value(centre[i] + steps), deviances)
    return profiles


def step_at_limit(points: list[tuple[float, float]]) -> float:
    """Step of theta at which the root of the deviance, which is nearly straight, reaches that of its limit, :data:`LIMIT`;
    from steps and the deviances there."""
    steps, deviances = np.array(sorted(points)).T
    roots, goal = np.sqrt(np.maximum(deviances, 0.0)), np.sqrt(LIMIT)
    beyond = np.flatnonzero(roots >= goal)
    if len(beyond) == 0:
        return np.inf if steps[-1] >= _FURTHEST else float(steps[-1] * goal / max(roots[-1], 1e-9))
    around = slice(beyond[0] - 1, beyond[0] + 1)
    return float(np.interp(goal, roots[around], steps[around]))
