"""Super-twisting observers (7)-(8) of one side, discretised explicitly or implicitly."""

from typing import ClassVar

import jax.numpy as jnp

from jaxbl.drive.parameters import Scalar, parameter

from .base import OBSERVERS, AbstractObserver, Estimate, GainRanges, ObserverState, OperatingConditions, predict_next


class AbstractSuperTwisting(AbstractObserver):
    """Super-twisting observer (7)-(8): x_hat_1' = x_hat_2 + lambda sqrt|e| sign e, x_hat_2' = f(x_hat_2, u) + alpha sign e,
    with the error e = y - x_hat_1.

    Reference: J. Davila, L. Fridman, A. Levant, IEEE Trans. Autom. Control 50 (2005).

    Attributes:
        discretisation: key `discretisation` of the config.
    """

    name = "super_twisting"
    discretisation: ClassVar[str]
    lambda_: Scalar = parameter("√rad/s", "gain lambda of the square-root term (8)", minimum=0.0)
    alpha: Scalar = parameter("rad/s²", "gain alpha of the switching term (8)", minimum=0.0)

    @classmethod
    def select_discretisation(cls, discretisation):
        return DISCRETISATIONS[discretisation]

    @classmethod
    def gain_ranges(cls, conditions: OperatingConditions) -> GainRanges:
        root = conditions.f_plus**0.5
        # with alpha below f_plus the observer does not follow every disturbance exactly, but may have less noise
        return {"lambda": (0.01 * root, 1e3 * root), "alpha": (0.01 * conditions.f_plus, 1e3 * conditions.f_plus)}


OBSERVERS.add(AbstractSuperTwisting)


class ExplicitSuperTwisting(AbstractSuperTwisting):
    """Forward Euler of (7)-(8). The estimate at a sample is the prediction for it, without its measurement."""

    discretisation = "explicit"

    def step(self, state, measured, acceleration, period):
        error = measured - state.position
        magnitude, switch = jnp.abs(error), jnp.sign(error)
        # the slope of the root is infinite at zero: jnp.where keeps it out of derivatives
        root = switch * jnp.sqrt(jnp.where(magnitude > 0.0, magnitude, 1.0))
        control = self.alpha * switch
        new = ObserverState(
            state.position + period * (state.velocity + self.lambda_ * root),
            state.velocity + period * (acceleration(state.velocity) + control),
        )
        return new, Estimate(state.position, state.velocity, control)


class ImplicitSuperTwisting(AbstractSuperTwisting):
    """Backward Euler of the set-valued correction of (7)-(8), in closed form, without numerical chattering.

    With the innovation b and the period h, the error e after the correction solves

        e + h lambda sqrt|e| sign(e) + h^2 alpha s = b,   s in sign(e).

    In the sliding set, |b| <= h^2 alpha, e is zero and the equivalent control alpha s is b / h^2. Outside of it s is
    sign(b), and the equation is quadratic in sqrt|e|. The estimate at a sample includes its measurement.
    Reference: V. Acary, B. Brogliato, Y. Orlov, IEEE Trans. Autom. Control 57 (2012), for the method.
    """

    discretisation = "implicit"

    def step(self, state, measured, acceleration, period):
        innovation = measured - state.position
        reach = period * period * self.alpha
        damping = period * self.lambda_
        # alpha s h^2 is the innovation, clipped to the sliding set
        sliding = jnp.clip(innovation, -reach, reach)
        beyond = innovation - sliding
        # sqrt|e| = 2 c / (d + sqrt(d^2 + 4 c)) without cancellation, with c = beyond and d = damping; it is 0 / 0 at rest if
        # lambda is 0
        denominator = damping + jnp.sqrt(damping * damping + 4.0 * jnp.abs(beyond))
        half = beyond / jnp.maximum(denominator, jnp.finfo(denominator.dtype).tiny)
        error = 4.0 * half * jnp.abs(half)
        control = sliding / (period * period)
        position = measured - error
        velocity = state.velocity + period * control
        new = ObserverState(*predict_next(position, velocity, acceleration, period, missing_acceleration=control))
        return new, Estimate(position, velocity, control)


DISCRETISATIONS: dict[str, type[AbstractSuperTwisting]] = {
    observer.discretisation: observer for observer in (ImplicitSuperTwisting, ExplicitSuperTwisting)
}
"""Super-twisting observers by the key `discretisation` of the config."""
