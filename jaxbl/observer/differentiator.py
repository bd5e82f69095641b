"""Homogeneous robust exact differentiators of orders 1 to 5 as observers of one side.

With order n the states are position, velocity, the disturbance (acceleration missing in the nominal model) and its first
n - 2 derivatives; of order 1 the disturbance is the switching term alone, as of the super-twisting observer.

The scheme is backward Euler of the differentiator, of which the states kept here are those linear combinations that are
derivatives of a polynomial of degree n exactly (docs/theory.md): what R. Seeber, Proper implicit discretization of
arbitrary-order robust exact differentiators (2024, arXiv 2404.02770), calls proper. Backward Euler's own states z_i are
backward differences in the sliding set, and so lag behind derivatives by some periods.
Reference: A. Levant, Int. J. Control 76 (2003); coefficients of its non-recursive form from A. Levant, M. Livne, IEEE Trans.
Autom. Control 65 (2020).
"""

from collections.abc import Mapping, Sequence
from math import factorial
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from jaxbl.drive.parameters import Scalar, parameter

from .base import OBSERVERS, AbstractObserver, Acceleration, Estimate, ObserverState, OperatingConditions, predict_next
from .super_twisting import ImplicitSuperTwisting

COEFFICIENTS: Mapping[int, tuple[float, ...]] = {
    1: (1.5, 1.1),
    2: (2.0, 2.12, 1.1),
    3: (3.0, 4.16, 3.06, 1.1),
    4: (5.0, 10.03, 9.30, 4.57, 1.1),
    5: (7.0, 23.72, 32.24, 20.26, 6.75, 1.1),
}
"""k_1 ... k_(n+1) by order n, of the correction of each state from the position on."""

_NEWTON_STEPS = 10
"""Newton steps: they reach rounding for innovations of 1e-20 to 1e20 times those of the sliding set (a test)."""


def _powers(base: Any, count: int) -> list[Any]:
    """1, base, base^2, ..."""
    found = [jnp.ones_like(base)]
    for _ in range(count):
        found.append(found[-1] * base)
    return found


def _bound_root(value: Any, power: int) -> Any:
    """A number not below the root of this power of a non-negative value, near it, from square roots alone."""
    half = jnp.sqrt(value)
    quarter = jnp.sqrt(half)
    if power in (1, 2, 4):
        return {1: value, 2: half, 4: quarter}[power]
    eighth = jnp.sqrt(quarter)
    sixteenth = jnp.sqrt(eighth)
    # exponents on both sides of 1 / power: the larger one for values above one, the smaller one below
    above, below = {
        3: (quarter * eighth, quarter * sixteenth),
        5: (eighth * sixteenth * jnp.sqrt(sixteenth), eighth * sixteenth),
        6: (eighth * sixteenth, eighth * jnp.sqrt(sixteenth)),
    }[power]
    return jnp.where(value > 1.0, above, below)


def solve_correction(coefficients: Sequence[float], value: Any) -> Any:
    """The root rho >= 0 of rho^(n+1) + k_1 rho^n + ... + k_n rho = value >= 0, by Newton's method from above."""
    order = len(coefficients) - 1
    whole = (1.0, *coefficients[:order])
    # each term alone is not above the value
    bounds = [_bound_root(value / whole[i], order + 1 - i) for i in range(order + 1)]
    rho = bounds[0]
    for bound in bounds[1:]:
        rho = jnp.minimum(rho, bound)
    for _ in range(_NEWTON_STEPS):
        total, slope = whole[0] * rho + whole[1], jnp.full_like(rho, whole[0])
        # Horner's rule with its derivative; the constant term is zero
        for k in whole[2:]:
            slope = slope * rho + total
            total = total * rho + k
        slope = slope * rho + total
        # the polynomial is convex: no step goes below the root but by rounding
        rho = jnp.maximum(rho - (total * rho - value) / slope, 0.0)
    return rho


def _stirling_numbers(n: int) -> list[int]:
    """Coefficients of x (x + 1) ... (x + n - 1), lowest power first."""
    row = [1]
    for k in range(n):
        row = [k * a + b for a, b in zip([*row, 0], [0, *row], strict=True)]
    return row


def _correction_weights(order: int) -> list[list[float]]:
    """What the correction of state j adds to state i <= j over a period, both from 1 on, in units of h^(j - i + 1).

    In the sliding set, with these alone, the errors of a polynomial of that degree vanish after as many samples: the states
    are then derivatives of the polynomial through the last n + 1 samples.
    """
    found = [[0.0] * (order + 1) for _ in range(order + 1)]
    for j in range(1, order + 2):
        row = _stirling_numbers(j)
        for i in range(1, j + 1):
            found[i - 1][j - 1] = factorial(i - 1) * row[i] / factorial(j - 1)
    return found


class AbstractDifferentiator(AbstractObserver):
    """Differentiator of one order, implicit: the correction solves a set-valued equation and does not chatter.

    With the innovation b, e = |e| s solves e + sum_j h^j k_j L^(j/(n+1)) |e|^((n+1-j)/(n+1)) s = b, s in sign(e). In the
    sliding set, |b| <= h^(n+1) k_(n+1) L, e is zero, and the states follow the polynomial through the last n + 1 samples. As
    k_(n+1) > 1, a signal without noise whose (n+1)-th derivative stays below L never leaves it again.
    """

    order: ClassVar[int]
    lipschitz: eqx.AbstractVar[Scalar]  # pyright: ignore[reportGeneralTypeIssues]

    @classmethod
    def gain_ranges(cls, conditions: OperatingConditions) -> Mapping[str, tuple[float, float]]:
        # f_plus times as many derivatives, of motions from slow to as fast as samples
        slow, fast = (rate ** (cls.order - 1) for rate in (1e-3 / conditions.period, 1.0 / conditions.period))
        return {"lipschitz": (0.01 * conditions.f_plus * slow, 100.0 * conditions.f_plus * fast)}

    def start(self, position, velocity, acceleration, period):
        zero = jnp.zeros_like(jnp.asarray(position + velocity))
        return ObserverState(position, velocity, (zero,) * (self.order - 1))

    def step(self, state, measured, acceleration, period):
        n, coefficients = self.order, COEFFICIENTS[self.order]
        steps = _powers(period, n + 1)
        unit = steps[n + 1] * self.lipschitz
        innovation = measured - state.position
        reach = coefficients[n] * unit
        sliding = jnp.clip(innovation, -reach, reach)
        beyond = innovation - sliding
        # a gain of zero corrects nothing
        least = jnp.finfo(unit.dtype).tiny
        rho = solve_correction(coefficients, jnp.abs(beyond) / jnp.maximum(unit, least))
        rhos, signed = _powers(rho, n + 1), jnp.sign(beyond) * unit
        # h^j times the correction of state j
        corrections = [k * rhos[n + 1 - j] * signed for j, k in enumerate(coefficients[:n], 1)] + [sliding]
        weights = _correction_weights(n)
        states = [state.position, state.velocity, *state.extra_states]
        new = [x + sum(weights[i][j] * corrections[j] for j in range(i, n + 1)) / steps[i] for i, x in enumerate(states)]
        position, velocity, *rest = new
        return _predict_taylor(position, velocity, rest, acceleration, steps), Estimate(position, velocity, rest[0])


def _predict_taylor(
    position: Any, velocity: Any, disturbance: list[Any], acceleration: Acceleration, steps: list[Any]
) -> ObserverState:
    """The state predicted for the next sample, the disturbance by its Taylor series; `steps` are powers of the period."""
    period = steps[1]
    mean = sum(d * steps[m] / factorial(m + 1) for m, d in enumerate(disturbance))
    at, speed = predict_next(position, velocity, acceleration, period, held=mean)
    # what a disturbance that changes moves otherwise than its mean
    for m, d in enumerate(disturbance[1:], 1):
        at = at + d * steps[m + 2] * (1.0 / factorial(m + 2) - 0.5 / factorial(m + 1))
    series = (sum(d * steps[m] / factorial(m) for m, d in enumerate(disturbance[i:])) for i in range(len(disturbance)))
    return ObserverState(at, speed, tuple(series))


class _FirstOrder(AbstractDifferentiator):
    """The implicit super-twisting observer: the same equation, with one gain for both of its own."""

    def step(self, state, measured, acceleration, period):
        first, second = COEFFICIENTS[1]
        observer = ImplicitSuperTwisting(lambda_=first * jnp.sqrt(self.lipschitz), alpha=second * self.lipschitz)
        return observer.step(state, measured, acceleration, period)


def _make_differentiator(n: int, unit: str) -> type[AbstractDifferentiator]:
    base: Any = _FirstOrder if n == 1 else AbstractDifferentiator

    @OBSERVERS.add
    class Differentiator(base):
        __doc__ = AbstractDifferentiator.__doc__
        name: ClassVar[str] = f"differentiator_{n}"
        order: ClassVar[int] = n
        lipschitz: Scalar = parameter(unit, "bound L of the highest derivative that is not estimated", minimum=0.0)

    Differentiator.__name__ = Differentiator.__qualname__ = f"Differentiator{n}"
    return Differentiator


DIFFERENTIATORS = {n: _make_differentiator(n, f"rad/s{power}") for n, power in enumerate("²³⁴⁵⁶", 1)}
"""By order."""
