"""Base class of the observers of one side, and their registry.

An observer takes the measured position and the nominal acceleration. It estimates position, velocity, and the acceleration
that the nominal model lacks: the equivalent control z_2 of (15), from which the transmitted torque follows. Installed
packages add observers by the entry-point group `jaxbl.observers`; the entry point's name is the observer's.
"""

import abc
from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any, ClassVar, NamedTuple, Self

import equinox as eqx

from jaxbl.drive.parameters import Scalar, ScalarArray, config_key, parameter, parameters
from jaxbl.registry import Registry, check_module

Acceleration = Callable[[Scalar], Scalar]
"""Nominal acceleration f(x_2, u) in rad/s^2 as a function of velocity (rad/s), at the present input."""


class ObserverState(NamedTuple):
    """State of an observer between samples.

    Attributes:
        position, velocity: prediction for the next sample, rad and rad/s.
        further: more numbers that the observer carries.
    """

    position: Scalar
    velocity: Scalar
    further: tuple[Scalar, ...] = ()


class Estimate(NamedTuple):
    """Estimates at a sample: position (rad), velocity (rad/s), and unfiltered equivalent control z_2 (rad/s^2)."""

    position: Scalar
    velocity: Scalar
    control: ScalarArray


GainRanges = Mapping[str, tuple[float, float]]
"""The least and the largest value of each gain."""


class OperatingConditions(NamedTuple):
    """Conditions for which gains are chosen.

    Attributes:
        f_plus: bound of the acceleration that the nominal model lacks, rad/s^2.
        period: sampling period, s.
        noise: rms error of the encoder's readings, quantisation included, rad.
    """

    f_plus: float
    period: float
    noise: float


class AbstractObserver(eqx.Module):
    """An observer of one side.

    Attributes:
        name: key `kind` of the config.
        position_error, velocity_error: x - x_hat at t = 0, rad and rad/s.
    """

    name: ClassVar[str]
    position_error: Scalar = parameter("rad", "position error x - x_hat at t = 0", default=0.0, kw_only=True)
    velocity_error: Scalar = parameter("rad/s", "velocity error x - x_hat at t = 0", default=0.0, kw_only=True)

    @classmethod
    def select_discretisation(cls, discretisation: str) -> type[Self]:
        """Return the class for the key `discretisation` of the config: this class, unless the observer has several."""
        return cls

    @classmethod
    @abc.abstractmethod
    def gain_ranges(cls, conditions: OperatingConditions) -> GainRanges:
        """Return the range of each gain, by config key, in which a search for gains should try.

        Args:
            conditions: for which gains are chosen.

        Returns:
            The least and the largest value of each gain, both positive; they are equal for a gain that stays fixed.
        """

    def gains(self) -> dict[str, float]:
        """Gains of this observer, by config key."""
        return {
            config_key(field.name): float(getattr(self, field.name)) for field, _ in parameters(self) if not field.kw_only
        }

    def start(self, position: Scalar, velocity: Scalar, acceleration: Acceleration, period: Scalar) -> ObserverState:
        """Return the state before the first sample.

        Args:
            position, velocity: prediction for the first sample, rad and rad/s.
            acceleration: nominal acceleration without input.
            period: sampling period, s.
        """
        return ObserverState(position, velocity)

    @abc.abstractmethod
    def step(
        self, state: ObserverState, measured: ScalarArray, acceleration: Acceleration, period: Scalar
    ) -> tuple[ObserverState, Estimate]:
        """Estimate the motion at a sample, and predict the next one.

        Args:
            state: prediction for this sample.
            measured: position, rad.
            acceleration: nominal acceleration.
            period: sampling period, s.

        Returns:
            The prediction for the next sample, and the estimates at this one.
        """


def predict_next(
    position: Scalar,
    velocity: Scalar,
    acceleration: Acceleration,
    period: Scalar,
    disturbance: Any = 0.0,
    missing_acceleration: Any = 0.0,
) -> tuple[Scalar, Scalar]:
    """Predict position and velocity one sampling period later.

    Friction is evaluated at the mean velocity over the period. At the velocity of its beginning it would be half a period
    late, and the observer would take the difference for a disturbance.

    Args:
        position, velocity: at this sample, rad and rad/s.
        acceleration: nominal acceleration.
        period: sampling period, s.
        disturbance: acceleration beside the nominal one over the period, rad/s^2.
        missing_acceleration: acceleration that the next correction makes up for, rad/s^2; the velocity lags by half a
            period of it.

    Returns:
        Position and velocity at the next sample.
    """
    mean_velocity = velocity + period * (missing_acceleration + 0.5 * (disturbance + acceleration(velocity)))
    total = disturbance + acceleration(mean_velocity)
    return position + period * (velocity + 0.5 * period * total), velocity + period * total


OBSERVERS = Registry("jaxbl.observers", partial(check_module, base=AbstractObserver))
"""Observers by the key `kind` of the config, those of installed packages included."""


class Observers(eqx.Module):
    """The observers of both sides; `load` is None on a rigid drive."""

    motor: AbstractObserver
    load: AbstractObserver | None = None

    @staticmethod
    def of(**sides: AbstractObserver | None) -> "Observers":
        """Return observers of any sides, by their names: a drive of one's own may have further ones."""
        return _observers_with(tuple(side for side in sides if side not in ("motor", "load")))(**sides)  # type: ignore


@cache
def _observers_with(further: tuple[str, ...]) -> type[Observers]:
    """The class whose fields are both sides and further ones: one for all experiments, as it is part of their programs."""
    fields = {"__annotations__": dict.fromkeys(further, AbstractObserver), "__module__": __name__}
    make: Any = type(Observers)
    return make("Observers", (Observers,), fields | dict.fromkeys(further)) if further else Observers
