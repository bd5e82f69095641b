"""Super-twisting observers (7)-(8) of one side, in continuous form discretised explicitly or implicitly.

Both take the measured position and the nominal acceleration, and know nothing of where the measurement comes from.
"""

import abc
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbl.drive.parameters import Scalar, parameter


class ObserverState(NamedTuple):
    """Position (rad) and velocity (rad/s) predicted for the coming sample."""

    position: Scalar
    velocity: Scalar


class Estimate(NamedTuple):
    """Position (rad), velocity (rad/s) and equivalent control z_2 (rad/s^2, unfiltered) at the sample."""

    position: Scalar
    velocity: Scalar
    control: Float[Array, ""]


class AbstractSuperTwisting(eqx.Module):
    """A super-twisting observer; `position_error` and `velocity_error` are x - x_hat at t = 0."""

    name: ClassVar[str]
    lambda_: Scalar = parameter("√rad/s", "gain lambda of the square-root term (8)", minimum=0.0)
    alpha: Scalar = parameter("rad/s²", "gain alpha of the switching term (8)", minimum=0.0)
    position_error: Scalar = parameter("rad", "position error x - x_hat at t = 0", default=0.0)
    velocity_error: Scalar = parameter("rad/s", "velocity error x - x_hat at t = 0", default=0.0)

    def init(self, position: Scalar, velocity: Scalar) -> ObserverState:
        """State that misses the given position (rad) and velocity (rad/s) by the configured errors."""
        return ObserverState(position - self.position_error, velocity - self.velocity_error)

    @abc.abstractmethod
    def step(
        self, state: ObserverState, measured: Float[Array, ""], acceleration: Callable[[Scalar], Scalar], step: Scalar
    ) -> tuple[ObserverState, Estimate]:
        """Take in one sample and predict the next.

        Args:
            state: prediction for this sample.
            measured: position in rad.
            acceleration: nominal acceleration (rad/s^2) as a function of velocity, the input held at its present value.
            step: sampling period in s.
        """


class ExplicitSuperTwisting(AbstractSuperTwisting):
    """Forward Euler of (7)-(8); the estimate at a sample is the prediction for it."""

    name: ClassVar[str] = "explicit"

    def step(self, state, measured, acceleration, step):
        error = measured - state.position
        magnitude, switch = jnp.abs(error), jnp.sign(error)
        # the slope of the root is infinite at zero; where() keeps it out of derivatives
        root = switch * jnp.sqrt(jnp.where(magnitude > 0.0, magnitude, 1.0))
        control = self.alpha * switch
        new = ObserverState(
            state.position + step * (state.velocity + self.lambda_ * root),
            state.velocity + step * (acceleration(state.velocity) + control),
        )
        return new, Estimate(state.position, state.velocity, control)


class ImplicitSuperTwisting(AbstractSuperTwisting):
    """Backward Euler of the set-valued correction, in proximal form: no numerical chattering.

    The correction solves e + h lambda sqrt|e| sign(e) + h^2 alpha s = b with s in sign(e), b the innovation, in closed
    form; alpha s is the equivalent control itself. The estimate at a sample includes its measurement.
    Reference: V. Acary, B. Brogliato, Y. Orlov, IEEE Trans. Autom. Control 57 (2012), for the method; the form is design's.
    """

    name: ClassVar[str] = "implicit"

    def step(self, state, measured, acceleration, step):
        innovation = measured - state.position
        reach = step * step * self.alpha
        damping = step * self.lambda_
        # what is left of the innovation in the sliding set, alpha s h^2, is its clip
        sliding = jnp.clip(innovation, -reach, reach)
        beyond = innovation - sliding
        # sqrt|e| = 2 c / (b + sqrt(b^2 + 4 c)): the root without cancellation; the floor is for lambda = 0 at rest
        denominator = damping + jnp.sqrt(damping * damping + 4.0 * jnp.abs(beyond))
        half = beyond / jnp.maximum(denominator, jnp.finfo(denominator.dtype).tiny)
        error = 4.0 * half * jnp.abs(half)
        control = sliding / (step * step)
        position = measured - error
        velocity = state.velocity + step * control
        # the estimate lags by half a step of the perturbation; the mean velocity over the coming step makes up for it,
        # else viscous friction of that lag would be taken for perturbation
        predicted = acceleration(velocity + step * (control + 0.5 * acceleration(velocity)))
        new = ObserverState(position + step * (velocity + 0.5 * step * predicted), velocity + step * predicted)
        return new, Estimate(position, velocity, control)


OBSERVERS: dict[str, type[AbstractSuperTwisting]] = {
    observer.name: observer for observer in (ExplicitSuperTwisting, ImplicitSuperTwisting)
}


class Observers(eqx.Module):
    """The observers of both sides; `load` is None on a rigid drive."""

    motor: AbstractSuperTwisting
    load: AbstractSuperTwisting | None = None
