"""Base class of the controllers, and their registry.

A controller takes readings and estimates of a sample and the target there. Its torque acts from the next sample on, as in a
drive, whose processor needs the time between. Installed packages add controllers by the entry-point group
`jaxbl.controllers`; the entry point's name is the controller's.
"""

import abc
from functools import partial
from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxbl.drive.effects.base import AbstractEffect, Motion
from jaxbl.drive.parameters import Scalar, ScalarArray, option, parameter
from jaxbl.drive.plant import AbstractDrive
from jaxbl.registry import Registry, check_module

from .references import Target


class Feedback(NamedTuple):
    """Holds what a controller sees at a sample, by side.

    Attributes:
        measured: readings, rad; a missed one is replaced by the observer's prediction.
        position, velocity: estimates of the observers, rad and rad/s.
        control: filtered equivalent control: the acceleration that the nominal model lacks, rad/s^2.
        effects: those of the experiment, which a controller may know.
    """

    measured: dict[str, Any]
    position: dict[str, Any]
    velocity: dict[str, Any]
    control: dict[str, Any]
    effects: tuple[AbstractEffect, ...] = ()


class ControllerState(NamedTuple):
    """State of a controller between samples: the torque (N m) that acts until the next one, and numbers of its own."""

    torque: Any
    further: tuple[Any, ...] = ()


class AbstractController(eqx.Module):
    """A controller of the motor's torque.

    Attributes:
        name: key `kind` of the config.
        side: whose position follows the reference.
    """

    name: ClassVar[str]
    side: Literal["motor", "load"] = option("side whose position follows the reference", default="motor", kw_only=True)
    torque_limit: Scalar | None = parameter("N m", "largest torque; left out: none", default=None, above=0.0, kw_only=True)
    torque_rate: Scalar | None = parameter(
        "N m/s", "fastest change of the torque; left out: none", default=None, above=0.0, kw_only=True
    )

    @property
    def reads_observers(self) -> bool:
        """True if the torque depends on estimates, so that the motion changes with the observers' gains."""
        return True

    @abc.abstractmethod
    def start(self, measured: dict[str, Any]) -> ControllerState:
        """Return the state before the first sample, at the sides' readings (rad)."""

    @abc.abstractmethod
    def step(
        self, state: ControllerState, feedback: Feedback, target: Target, drive: AbstractDrive, period: Scalar
    ) -> ControllerState:
        """Compute the torque that acts from the next sample on.

        Args:
            state: before the sample.
            feedback: readings and estimates of the sample.
            target: of :attr:`side`.
            drive: nominal drive.
            period: sampling period, s.
        """

    def effect_torque(
        self, state: ControllerState, feedback: Feedback, target: Target, drive: AbstractDrive, period: Scalar
    ) -> Any:
        """Compute the torque (N m, on the motor side) that known effects on the sides resist when the next one acts.

        Waves are taken at the readings, moved on to the middle of the torque's sample; friction, inertia and loads at the
        target's velocity and acceleration. Effects with a memory or a clock are left out.
        """
        total = jnp.zeros_like(state.torque)
        for effect in feedback.effects:
            if effect.place not in drive.sides or effect.in_time or jax.tree.leaves(effect.init()):
                continue
            side = effect.place
            turns = drive.ratio(self.side) / drive.ratio(side)
            velocity = turns * target.velocity
            motion = Motion(0.0, feedback.measured[side] + 1.5 * period * velocity, velocity, state.torque)
            friction = jnp.sign(velocity) * effect.dry_friction((), motion)
            inertia = turns * effect.added_inertia() * target.acceleration
            total = total + (effect.resist((), motion) + friction + inertia) / drive.ratio(side)
        return total

    def limit(self, last: Any, torque: Any, period: Scalar) -> ScalarArray:
        """Limit a torque (N m) in size, and in its change from the last one."""
        if self.torque_limit is not None:
            torque = jnp.clip(torque, -self.torque_limit, self.torque_limit)
        if self.torque_rate is not None:
            torque = last + jnp.clip(torque - last, -self.torque_rate * period, self.torque_rate * period)
        return torque


CONTROLLERS = Registry("jaxbl.controllers", partial(check_module, base=AbstractController))
"""Controllers by the key `kind` of the config, those of installed packages included."""
