"""Friction of a side: dry friction in four forms, viscous friction, friction that differs by direction, and fluid drag."""

from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp

from ..parameters import Scalar
from .base import EFFECTS, SideEffect, held, multiples, shape, size


class DryFriction(SideEffect):
    """A law of dry friction. The finest of them, fitted to the friction of 60 generated machines (bristles whose level falls
    with speed), leaves 6 % of its torque on a quarter of them and 8 % on half; an effect of another form takes up a part."""

    exclusive = "dry friction"
    law_error = 0.05


@EFFECTS.add
class CoulombFriction(DryFriction):
    """Dry friction of constant level: F_c sign(v) in motion; at rest it holds against torques up to F_c."""

    kind = "coulomb_friction"
    torque: Scalar = size("N m", "friction torque F_c", minimum=0.0)

    def dry_friction(self, state, motion):
        return self.torque


_FALLS = multiples("speed", (0.05, 0.1, 0.2, 0.3, 0.45, 0.7, 1.0))
"""Trial values of a Stribeck speed: from a fall that shows only where motion starts to one that shows in all of it."""


@EFFECTS.add
class StribeckFriction(DryFriction):
    """Dry friction whose level falls with speed, from break-away F_s to F_c: F_c + (F_s - F_c) exp(-(v / v_s)^2)."""

    kind = "stribeck_friction"
    velocity_dependent = True
    special_cases: ClassVar = {"coulomb_friction": lambda numbers: {"torque": numbers["torque"]}}
    torque: Scalar = size("N m", "sliding friction torque F_c", minimum=0.0)
    breakaway_torque: Scalar = size("N m", "break-away torque F_s", minimum=0.0)
    stribeck_velocity: Scalar = shape("rad/s", "speed v_s over which friction falls", _FALLS, above=0.0)

    def dry_friction(self, state, motion):
        fall = jnp.exp(-((motion.velocity / self.stribeck_velocity) ** 2))
        return self.torque + (self.breakaway_torque - self.torque) * fall

    @classmethod
    def directions(cls):
        # sliding friction alone, and the excess of break-away
        return [{"torque": 1.0, "breakaway_torque": 1.0}, {"breakaway_torque": 1.0}]

    @classmethod
    def possible(cls, numbers: Mapping[str, float]) -> bool:
        return super().possible(numbers) and numbers["breakaway_torque"] > numbers["torque"]


_LENGTHS = {"noise": (1.0, 5.0), "spread": (0.001, 0.003, 0.01, 0.03, 0.1)}
"""Trial values of the pre-sliding length, over the noise of the readings and over the position's standard deviation. A
shorter length looks like dry friction, a longer one like a spring."""


@EFFECTS.add
class PreslidingFriction(DryFriction):
    """Dry friction of contacts that bend before they slide (LuGre): torque F_c w + sigma_1 l dw/dt with
    l dw/dt = v - |v| w / s(v), s = 1 + (F_s / F_c - 1) exp(-(v / v_s)^2). Its stiffness at a reversal is F_c / l. With
    torque and length alone it is Dahl's model.

    In the notation of Canudas de Wit, sigma_0 = F_c / l and z = l w. Steps must resolve the bending of the contacts:
    step * sqrt(F_c / (l J)) < 2, where J is the side's inertia.

    References: P. R. Dahl, Solid friction damping of mechanical vibrations, AIAA Journal 14 (1976); C. Canudas de Wit et
    al., A new model for control of systems with friction, IEEE TAC 40 (1995).
    """

    kind = "presliding_friction"
    velocity_dependent = True
    special_cases: ClassVar = {"coulomb_friction": lambda numbers: {"torque": numbers["torque"]}}
    torque: Scalar = size("N m", "sliding friction torque F_c", minimum=0.0)
    length: Scalar = shape(
        "rad",
        "pre-sliding length l = F_c over the stiffness of the contacts",
        lambda log: [factor * getattr(log, scale) for scale, factors in _LENGTHS.items() for factor in factors],
        above=0.0,
    )
    # lubricated contacts take 1.1 to 2 times as much to break away
    breakaway_ratio: Scalar = held("", "break-away torque over F_c", 1.0, lambda log: (1.2, 1.5), above=0.0)
    stribeck_velocity: Scalar = held(
        "rad/s", "speed v_s over which friction falls from break-away to F_c", 1.0, _FALLS, above=0.0
    )
    damping: Scalar = held("N m s/rad", "damping sigma_1 of the bending contacts", 0.0, minimum=0.0)

    @classmethod
    def possible(cls, numbers: Mapping[str, float]) -> bool:
        # a study may have a level that rises with speed; a finding with that name falls
        return super().possible(numbers) and numbers["breakaway_ratio"] >= 1.0

    def init(self):
        return (jnp.zeros_like(self.length),)

    def advance(self, state, motion, step):
        # exact at a steady velocity: w tends to +-s exponentially with the distance
        forward = jnp.where(motion.velocity < 0.0, -1.0, 1.0)
        steady = self._steady_friction(motion.velocity)
        decay = jnp.exp(-forward * motion.velocity * step / (self.length * steady))
        return (forward * steady + (state[0] - forward * steady) * decay,)

    def resist(self, state, motion):
        v = motion.velocity
        return self.torque * state[0] + self.damping * (v - jnp.abs(v) * state[0] / self._steady_friction(v))

    def holds(self):
        return self.torque * jnp.maximum(self.breakaway_ratio, 1.0)

    def bent(self, torque):
        limit = jnp.maximum(self.breakaway_ratio, 1.0)
        # with the neutral torque, zero, all states are alike
        return (jnp.clip(torque / jnp.where(self.torque == 0.0, 1.0, self.torque), -limit, limit),)

    def _steady_friction(self, velocity):
        """Friction s at a steady velocity, over F_c."""
        return 1.0 + (self.breakaway_ratio - 1.0) * jnp.exp(-((velocity / self.stribeck_velocity) ** 2))


@EFFECTS.add
class DriftingFriction(DryFriction):
    """Dry friction whose level changes as the machine warms up: F + (F_0 - F) exp(-t / tau).

    Reference: L. Simoni, M. Beschi, G. Legnani, A. Visioli, Friction modeling with temperature effects for industrial robot
    manipulators, IROS (2015): one thermal time constant.
    """

    kind = "drifting_friction"
    in_time = True
    special_cases: ClassVar = {
        "coulomb_friction": lambda numbers: {"torque": 0.5 * (numbers["torque"] + numbers["initial_torque"])}
    }
    torque: Scalar = size("N m", "friction torque F in the end, when warm", minimum=0.0)
    initial_torque: Scalar = size("N m", "friction torque F_0 at t = 0", minimum=0.0)
    time_constant: Scalar = shape(
        "s",
        "time constant tau of the change",
        # from a change at the beginning of the log to one that is nearly linear in time
        multiples("duration", (0.1, 0.3, 1.0)),
        above=0.0,
    )

    def dry_friction(self, state, motion):
        return self.torque + (self.initial_torque - self.torque) * jnp.exp(-motion.time / self.time_constant)

    @classmethod
    def directions(cls):
        # steady friction alone, and the excess at the start
        return [{"torque": 1.0, "initial_torque": 1.0}, {"initial_torque": 1.0}]


@EFFECTS.add
class ViscousFriction(SideEffect):
    """Error f of the nominal viscous friction: torque f v."""

    kind = "viscous_friction"
    velocity_dependent = True
    corrects = "viscous"
    viscous: Scalar = size("N m s/rad", "viscous friction on top of the nominal one; may be negative")

    def resist(self, state, motion):
        return self.viscous * motion.velocity


@EFFECTS.add
class AsymmetricFriction(SideEffect):
    """Friction that differs by direction: torque (d_F + d_f |v|) / 2, beside the friction of the drive and other effects.

    Friction of F+ + f+ v forwards and F- + f- |v| backwards is the sum of viscous friction (f+ + f-) / 2, dry friction
    (F+ + F-) / 2, and this effect with d_f = f+ - f- and d_F = F+ - F-. A difference of dry friction alone is a constant
    torque.
    """

    kind = "asymmetric_friction"
    velocity_dependent = True
    viscous_difference: Scalar = size("N m s/rad", "viscous friction forwards less that backwards, d_f")
    torque_difference: Scalar = held("N m", "dry friction forwards less that backwards, d_F", 0.0)

    def resist(self, state, motion):
        return 0.5 * (self.torque_difference + self.viscous_difference * jnp.abs(motion.velocity))


@EFFECTS.add
class QuadraticDrag(SideEffect):
    """Fluid drag: torque b v |v|."""

    kind = "quadratic_drag"
    velocity_dependent = True
    drag: Scalar = size("N m s²/rad²", "drag coefficient b", minimum=0.0)

    def resist(self, state, motion):
        return self.drag * motion.velocity * jnp.abs(motion.velocity)
