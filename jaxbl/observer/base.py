"""What all observers of one side have in common, and where they are registered.

An observer takes the measured position and the nominal acceleration, and knows nothing of where the measurement comes from.
It estimates position and velocity, and what acceleration is missing in the nominal model (the equivalent control z_2 of
(15)): the transmitted torque follows from that. Further packages add observers through the entry-point group
`jaxbl.observers`; the entry's name is the observer's.
"""

import abc
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple, Self

import equinox as eqx
from jaxtyping import Array, Float

from jaxbl.drive.parameters import Scalar, config_key, parameter, parameters
from jaxbl.registry import Registry, check_module

Acceleration = Callable[[Scalar], Scalar]
"""Nominal acceleration (rad/s^2) as a function of velocity (rad/s), the input held at its present value."""


class ObserverState(NamedTuple):
    """Position (rad) and velocity (rad/s) predicted for the coming sample, and what else an observer carries."""

    position: Scalar
    velocity: Scalar
    extra_states: tuple[Scalar, ...] = ()


class Estimate(NamedTuple):
    """Position (rad), velocity (rad/s) and equivalent control z_2 (rad/s^2, unfiltered) at the sample."""

    position: Scalar
    velocity: Scalar
    control: Float[Array, ""]


class OperatingConditions(NamedTuple):
    """What gains are chosen for: the bound f_plus (rad/s^2) of the acceleration missing in the nominal model, the sampling
    period (s), and the rms error of the encoder (rad), with that of its resolution."""

    f_plus: float
    period: float
    noise: float


class AbstractObserver(eqx.Module):
    """An observer of one side; `position_error` and `velocity_error` are x - x_hat at t = 0."""

    name: ClassVar[str]
    """Key `kind` of the config."""
    position_error: Scalar = parameter("rad", "position error x - x_hat at t = 0", default=0.0, kw_only=True)
    velocity_error: Scalar = parameter("rad/s", "velocity error x - x_hat at t = 0", default=0.0, kw_only=True)

    @classmethod
    def select_discretisation(cls, discretisation: str) -> type[Self]:
        """The class for a key `discretisation` of the config: one class for all, unless the observer has several."""
        return cls

    @classmethod
    @abc.abstractmethod
    def gain_ranges(cls, conditions: OperatingConditions) -> Mapping[str, tuple[float, float]]:
        """Least and largest value of each gain that a search for gains should try, positive, by its config key; the same
        twice for one that it takes for given."""

    def gains(self) -> dict[str, float]:
        """Gains of this observer by config key."""
        names = [field.name for field, _ in parameters(self) if not field.kw_only]
        return {config_key(name): float(getattr(self, name)) for name in names}

    @abc.abstractmethod
    def start(self, position: Scalar, velocity: Scalar, acceleration: Acceleration, period: Scalar) -> ObserverState:
        """State before the first sample that predicts a position (rad) and a velocity (rad/s).

        Args:
            position, velocity: predicted for the first sample.
            acceleration: nominal acceleration without input.
            period: sampling period in s.
        """

    @abc.abstractmethod
    def step(
        self, state: ObserverState, measured: Float[Array, ""], acceleration: Acceleration, period: Scalar
    ) -> tuple[ObserverState, Estimate]:
        """Take in one sample and predict the next.

        Args:
            state: prediction for this sample.
            measured: position in rad.
            acceleration: nominal acceleration.
            period: sampling period in s.
        """


def predict_next(
    position: Scalar, velocity: Scalar, acceleration: Acceleration, period: Scalar, held: Any = 0.0, missing: Any = 0.0
) -> tuple[Scalar, Scalar]:
    """Position and velocity one sampling period later.

    Friction is that of the mean velocity over the period: that of its beginning would be half a period late, which the
    observer would take for a disturbance.

    Args:
        position, velocity: now.
        acceleration: nominal.
        period: in s.
        held: acceleration (rad/s^2) beside it over the period.
        missing: acceleration that the next correction will make up for; the velocity lags by half a period of it.
    """
    total = held + acceleration(velocity + period * (missing + 0.5 * (held + acceleration(velocity))))
    return position + period * (velocity + 0.5 * period * total), velocity + period * total


def _check(name: str, found: Any) -> None:
    check_module(name, found, AbstractObserver)


OBSERVERS = Registry("jaxbl.observers", _check)
"""Observers by the key `kind` of the config."""


class Observers(eqx.Module):
    """The observers of both sides; `load` is None on a rigid drive."""

    motor: AbstractObserver
    load: AbstractObserver | None = None
