"""Homogeneous robust exact differentiators of orders 1 to 5 as observers of one side.

The states of order n are position, velocity, the disturbance (the acceleration that the nominal model lacks) and its first
n - 2 derivatives. With order 1 the disturbance is the switching term, as in the super-twisting observer.

The scheme is backward Euler. Its own states z_i are backward differences in the sliding set, and thus lag behind derivatives
by some periods. The states here are linear combinations of the z_i that are exact derivatives of a polynomial of degree n
(docs/theory_appendix.md); R. Seeber, Proper implicit discretization of arbitrary-order robust exact differentiators (2024,
arXiv 2404.02770), calls such a discretisation proper.

References: A. Levant, Int. J. Control 76 (2003); coefficients of the non-recursive form: A. Levant, M. Livne, IEEE Trans.
Autom. Control 65 (2020).
"""

from collections.abc import Mapping, Sequence
from math import factorial
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from numpy.polynomial.polynomial import polyfromroots

from jaxbl.drive.parameters import Scalar, parameter

from .base import (
    OBSERVERS,
    AbstractObserver,
    Acceleration,
    Estimate,
    GainRanges,
    ObserverState,
    OperatingConditions,
    predict_next,
)
from .super_twisting import ImplicitSuperTwisting

COEFFICIENTS: Mapping[int, tuple[float, ...]] = {
    1: (1.5, 1.1),
    2: (2.0, 2.12, 1.1),
    3: (3.0, 4.16, 3.06, 1.1),
    4: (5.0, 10.03, 9.30, 4.57, 1.1),
    5: (7.0, 23.72, 32.24, 20.26, 6.75, 1.1),
}
"""Coefficients k_1 ... k_(n+1) of the corrections by order n, for the states from the position on."""

_NEWTON_STEPS = 10
"""Newton steps: they reach rounding for innovations of 1e-20 to 1e20 times those of the sliding set (a test)."""


def _powers(base: Any, count: int) -> list[Any]:
    """1, base, base^2, ... base^count."""
    powers = [jnp.ones_like(base)]
    for _ in range(count):
        powers.append(powers[-1] * base)
    return powers


def _bound_root(x: Any, degree: int) -> Any:
    """An upper bound of x^(1 / degree), x >= 0, which is near it and needs square roots only."""
    half = jnp.sqrt(x)
    quarter = jnp.sqrt(half)
    if degree in (1, 2, 4):
        return {1: x, 2: half, 4: quarter}[degree]
    eighth = jnp.sqrt(quarter)
    sixteenth = jnp.sqrt(eighth)
    # exponents on both sides of 1 / degree: the larger one for x above 1, the smaller one below
    above, below = {
        3: (quarter * eighth, quarter * sixteenth),
        5: (eighth * sixteenth * jnp.sqrt(sixteenth), eighth * sixteenth),
        6: (eighth * sixteenth, eighth * jnp.sqrt(sixteenth)),
    }[degree]
    return jnp.where(x > 1.0, above, below)


def solve_correction(coefficients: Sequence[float], beyond: Any) -> Any:
    """Solve rho^(n+1) + k_1 rho^n + ... + k_n rho = beyond for rho >= 0, by Newton's method from above.

    Args:
        coefficients: k_1 ... k_(n+1).
        beyond: innovation beyond the sliding set, in units of h^(n+1) L; not negative.

    Returns:
        The root rho, from which the error is e = h^(n+1) L rho^(n+1).
    """
    order = len(coefficients) - 1
    polynomial = (1.0, *coefficients[:order])
    # no term alone exceeds the right-hand side
    bounds = [_bound_root(beyond / polynomial[i], order + 1 - i) for i in range(order + 1)]
    rho = bounds[0]
    for bound in bounds[1:]:
        rho = jnp.minimum(rho, bound)
    for _ in range(_NEWTON_STEPS):
        total, slope = polynomial[0] * rho + polynomial[1], jnp.full_like(rho, polynomial[0])
        # Horner's rule with its derivative; the constant term is zero
        for k in polynomial[2:]:
            slope = slope * rho + total
            total = total * rho + k
        slope = slope * rho + total
        # the polynomial is convex: only rounding can take a step below the root
        rho = jnp.maximum(rho - (total * rho - beyond) / slope, 0.0)
    return rho


def _correction_weights(order: int) -> list[list[float]]:
    """Weights w[i][j], i <= j, with which the correction of state j is added to state i, in units of h^(j - i + 1).

    They are (i!/j!) [j + 1, i + 1] with Stirling numbers of the first kind, where state 0 is the position. With these
    weights, and no others, the states in the sliding set are derivatives of the polynomial through the last n + 1 samples.
    """
    weights = np.zeros((order + 1, order + 1))
    for j in range(order + 1):
        # coefficients of x (x + 1) ... (x + j), lowest power first
        stirling_numbers = polyfromroots(-np.arange(j + 1))
        for i in range(j + 1):
            weights[i, j] = factorial(i) * stirling_numbers[i + 1] / factorial(j)
    # Python's numbers leave the precision to JAX's arrays
    return weights.tolist()


class AbstractDifferentiator(AbstractObserver):
    """Implicit differentiator of order n: its correction solves a set-valued equation and does not chatter.

    With the innovation b and the period h, the error e = |e| s solves

        e + sum_j h^j k_j L^(j/(n+1)) |e|^((n+1-j)/(n+1)) s = b,   s in sign(e),   j = 1 ... n+1.

    In the sliding set, |b| <= h^(n+1) k_(n+1) L, e is zero, and the states are derivatives of the polynomial through the
    last n + 1 samples. As k_(n+1) > 1, a signal without noise whose (n+1)-th derivative stays below L never leaves it again.
    With n = 1 it is the implicit super-twisting observer with lambda = k_1 sqrt(L) and alpha = k_2 L.

    Attributes:
        order: n.
        lipschitz: L, bound of the (n+1)-th derivative.
    """

    order: ClassVar[int]
    lipschitz: eqx.AbstractVar[Scalar]  # pyright: ignore[reportGeneralTypeIssues]

    @classmethod
    def gain_ranges(cls, conditions: OperatingConditions) -> GainRanges:
        # L is f_plus times n - 1 rates, of motions from slow ones to those as fast as the sampling
        slow, fast = (rate ** (cls.order - 1) for rate in (1e-3 / conditions.period, 1.0 / conditions.period))
        return {"lipschitz": (0.01 * conditions.f_plus * slow, 100.0 * conditions.f_plus * fast)}

    def start(self, position, velocity, acceleration, period):
        zero = jnp.zeros_like(jnp.asarray(position + velocity))
        return ObserverState(position, velocity, (zero,) * (self.order - 1))

    def step(self, state, measured, acceleration, period):
        n, coefficients = self.order, COEFFICIENTS[self.order]
        if n == 1:
            first, second = coefficients
            observer = ImplicitSuperTwisting(lambda_=first * jnp.sqrt(self.lipschitz), alpha=second * self.lipschitz)
            return observer.step(state, measured, acceleration, period)
        periods = _powers(period, n + 1)
        unit = periods[n + 1] * self.lipschitz
        innovation = measured - state.position
        reach = coefficients[n] * unit
        sliding = jnp.clip(innovation, -reach, reach)
        beyond = innovation - sliding
        # with a gain of zero the unit is zero, and nothing is corrected
        tiny = jnp.finfo(unit.dtype).tiny
        rho = solve_correction(coefficients, jnp.abs(beyond) / jnp.maximum(unit, tiny))
        rhos, signed = _powers(rho, n + 1), jnp.sign(beyond) * unit
        # h^j times the correction of state j
        corrections = [k * rhos[n + 1 - j] * signed for j, k in enumerate(coefficients[:n], 1)] + [sliding]
        weights = _correction_weights(n)
        states = [state.position, state.velocity, *state.further]
        position, velocity, *disturbance = [
            x + sum(weights[i][j] * corrections[j] for j in range(i, n + 1)) / periods[i] for i, x in enumerate(states)
        ]
        new = _predict_taylor(position, velocity, disturbance, acceleration, periods)
        return new, Estimate(position, velocity, disturbance[0])


def _predict_taylor(
    position: Any, velocity: Any, disturbance: list[Any], acceleration: Acceleration, periods: list[Any]
) -> ObserverState:
    """Predict the state at the next sample.

    `disturbance` is the disturbance and its derivatives, predicted by its Taylor series; `periods` are powers of the period.
    """
    period = periods[1]
    mean = sum(d * periods[m] / factorial(m + 1) for m, d in enumerate(disturbance))
    new_position, new_velocity = predict_next(position, velocity, acceleration, period, disturbance=mean)
    # a disturbance that changes over the period moves the position otherwise than its mean
    for m, d in enumerate(disturbance[1:], 1):
        new_position = new_position + d * periods[m + 2] * (1.0 / factorial(m + 2) - 0.5 / factorial(m + 1))
    series = (sum(d * periods[m] / factorial(m) for m, d in enumerate(disturbance[i:])) for i in range(len(disturbance)))
    return ObserverState(new_position, new_velocity, tuple(series))


def _make_differentiator(n: int, unit: str) -> type[AbstractDifferentiator]:
    @OBSERVERS.add
    class Differentiator(AbstractDifferentiator):
        __doc__ = AbstractDifferentiator.__doc__
        name = f"differentiator_{n}"
        order = n
        lipschitz: Scalar = parameter(unit, "bound L of the highest derivative that is not estimated", minimum=0.0)

    Differentiator.__name__ = Differentiator.__qualname__ = f"Differentiator{n}"
    return Differentiator


DIFFERENTIATORS = {n: _make_differentiator(n, f"rad/s{power}") for n, power in enumerate("²³⁴⁵⁶", 1)}
"""Differentiator classes by order."""
