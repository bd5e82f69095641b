"""How well fitted numbers are known: covariance with correlated residuals, intervals, what a record does not show.

References: W. Newey, K. West, Econometrica 55 (1987); D. Andrews, Econometrica 59 (1991), for the bandwidth.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import stats

from .smoother import running_sum
from .trajectory import Fit, Free

UNSEEN = 0.5
"""Relative standard deviation beyond which a direction counts as not shown by the record."""


class Spread(NamedTuple):
    """Covariance of a fit.

    Attributes:
        covariance: of theta, shape (parameters, parameters).
        information: J^T J over the residuals' variance, shape (parameters, parameters).
        variance: mean square of the whitened residuals; 1 where noise alone is left.
        inflation: factor on the standard errors by the correlation of the residuals, shape (parameters,).
        bandwidth: samples over which the residuals' correlation is summed.
    """

    covariance: Float[Array, "parameters parameters"]
    information: Float[Array, "parameters parameters"]
    variance: Float[Array, ""]
    inflation: Float[Array, " parameters"]
    bandwidth: Float[Array, ""]


@eqx.filter_jit
def spread(fit: Fit) -> Spread:
    """Covariance of theta by the sandwich J+ E[r r^T] J+^T, the middle by Newey and West with Andrews' bandwidth.

    Works under `vmap` over fits.
    """
    windows, samples, _, parameters = fit.jacobian.shape
    states = sum(1 for _ in fit.start.position) * 2
    freedom = fit.residual.size - parameters - windows * states
    normal = jnp.einsum("wtsp,wtsq->pq", fit.jacobian, fit.jacobian)
    size = jnp.sqrt(jnp.diag(normal))
    size = jnp.where(size > 0.0, size, 1.0)
    scores = jnp.einsum("wtsp,wts->wtp", fit.jacobian / size[None, None, None, :], fit.residual).reshape(
        windows * samples, parameters
    )
    variance = jnp.sum(fit.residual**2) / freedom
    middle, bandwidth = _long_run(scores)
    middle = middle * fit.residual.size / freedom
    inverse = _pseudo_inverse(normal / jnp.outer(size, size))
    plain = variance * inverse / jnp.outer(size, size)
    sandwich = inverse @ middle @ inverse / jnp.outer(size, size)
    inflation = jnp.sqrt(jnp.diag(sandwich) / jnp.diag(plain))
    # elimination of the initial states leaves a little negative correlation behind: nothing to gain confidence from
    more = jnp.maximum(1.0 / inflation, 1.0)
    covariance = sandwich * jnp.outer(more, more)
    return Spread(covariance, normal / variance, variance, inflation * more, bandwidth)


def _pseudo_inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Of a symmetric matrix, as `jnp.linalg.pinv`, which takes four times as long to compile."""
    values, vectors = jnp.linalg.eigh(matrix)
    size = jnp.abs(values)
    kept = size > 10.0 * len(values) * jnp.finfo(values.dtype).eps * jnp.max(size, initial=0.0)
    return (vectors * jnp.where(kept, 1.0 / jnp.where(kept, values, 1.0), 0.0)[None, :]) @ vectors.T


def _long_run(scores: Float[Array, "samples parameters"]) -> tuple[Array, Array]:
    """Sum of the autocovariances of a series under Bartlett's weights, times its length, and the bandwidth."""
    count = len(scores)
    square = jnp.sum(scores**2, axis=0)
    rho = jnp.sum(scores[1:] * scores[:-1], axis=0) / jnp.where(square > 0.0, square, 1.0)
    rho = jnp.clip(rho, -0.99, 0.999)
    weight = square**2
    top = jnp.sum(weight * 4.0 * rho**2 / ((1.0 - rho) ** 6 * (1.0 + rho) ** 2))
    bottom = jnp.sum(weight / (1.0 - rho) ** 4)
    wide = 1.1447 * (top / jnp.where(bottom > 0.0, bottom, 1.0) * count) ** (1.0 / 3.0)
    length = jnp.clip(jnp.ceil(wide), 1, count // 10).astype(int)
    # Bartlett's weights are those of all sums over `length` neighbours
    total = jnp.concatenate([jnp.zeros((1, scores.shape[1])), running_sum(scores)])
    last = jnp.arange(2 * count)
    sums = total[jnp.clip(last, 0, count)] - total[jnp.clip(last - length, 0, count)]
    return sums.T @ sums / length, length


def interval(one: Free, theta: float, deviation: float, level: float = 0.95) -> tuple[float, float]:
    """Confidence interval of a value, from its theta; never below zero where the value must be positive."""
    reach = stats.norm.ppf(0.5 + 0.5 * level) * deviation
    low, high = (float(one.value(theta + side * reach)) for side in (-1.0, 1.0))
    return min(low, high), max(low, high)


class Refusal(NamedTuple):
    """A combination of numbers that the record does not show: relative changes by path, and how uncertain it is."""

    direction: dict[str, float]
    deviation: float


def refusals(free: Sequence[Free], found: Spread) -> tuple[list[Refusal], float]:
    """Directions of theta with a standard deviation above :data:`UNSEEN`, and the condition number of the information.

    Directions are eigenvectors of the covariance, components below a tenth of the largest left out.
    """
    information = np.asarray(found.information)
    values, vectors = np.linalg.eigh(information)
    condition = float(np.sqrt(values[-1] / values[0])) if values[0] > 0.0 else float("inf")
    inflation = float(np.max(np.nan_to_num(np.asarray(found.inflation), nan=1.0)))
    refused = []
    for value, vector in zip(values, vectors.T, strict=True):
        deviation = max(inflation, 1.0) / np.sqrt(value) if value > 0.0 else float("inf")
        if deviation > UNSEEN:
            vector = vector / vector[np.argmax(np.abs(vector))]
            shown = {one.path: float(x) for one, x in zip(free, vector, strict=True) if abs(x) >= 0.1}
            refused.append(Refusal(shown, float(deviation)))
    return refused, condition
