"""Friction of a side: dry, falling with speed, viscous, and drag."""

from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp

from ..parameters import Scalar
from .base import EFFECTS, SideEffect, shape, size


@EFFECTS.add
class CoulombFriction(SideEffect):
    """Dry friction of constant level: sticks below it, F_c sign(v) in motion."""

    kind: ClassVar[str] = "coulomb_friction"
    exclusive: ClassVar[str | None] = "dry friction"
    torque: Scalar = size("N m", "friction torque F_c", minimum=0.0)

    def dry_friction(self, state, velocity):
        return self.torque


@EFFECTS.add
class StribeckFriction(SideEffect):
    """Dry friction that falls from break-away F_s to F_c with speed: F_c + (F_s - F_c) exp(-(v / v_s)^2)."""

    kind: ClassVar[str] = "stribeck_friction"
    velocity_dependent: ClassVar[bool] = True
    exclusive: ClassVar[str | None] = "dry friction"
    special_cases: ClassVar = {"coulomb_friction": lambda numbers: {"torque": numbers["torque"]}}
    torque: Scalar = size("N m", "sliding friction torque F_c", minimum=0.0)
    breakaway_torque: Scalar = size("N m", "break-away torque F_s", minimum=0.0)
    stribeck_velocity: Scalar = shape(
        "rad/s",
        "speed v_s over which friction falls",
        # from a fall that only starts of motion show to one that all of the motion shows
        lambda log: [share * log.speed for share in (0.05, 0.1, 0.2, 0.3, 0.45, 0.7, 1.0)],
        above=0.0,
    )

    def dry_friction(self, state, velocity):
        return self.torque + (self.breakaway_torque - self.torque) * jnp.exp(-((velocity / self.stribeck_velocity) ** 2))

    @classmethod
    def directions(cls):
        # sliding friction, and what break-away has more than that
        return [{"torque": 1.0, "breakaway_torque": 1.0}, {"breakaway_torque": 1.0}]

    @classmethod
    def possible(cls, numbers: Mapping[str, float]) -> bool:
        return super().possible(numbers) and numbers["breakaway_torque"] > numbers["torque"]


@EFFECTS.add
class ViscousFriction(SideEffect):
    """Error of the nominal viscous friction: an additional torque f v."""

    kind: ClassVar[str] = "viscous_friction"
    velocity_dependent: ClassVar[bool] = True
    corrects: ClassVar[str | None] = "viscous"
    viscous: Scalar = size("N m s/rad", "viscous friction on top of the nominal one; may be negative")

    def resist(self, state, motion):
        return self.viscous * motion.velocity


@EFFECTS.add
class QuadraticDrag(SideEffect):
    """Fluid drag b v |v|."""

    kind: ClassVar[str] = "quadratic_drag"
    velocity_dependent: ClassVar[bool] = True
    drag: Scalar = size("N m s²/rad²", "drag coefficient b", minimum=0.0)

    def resist(self, state, motion):
        return self.drag * motion.velocity * jnp.abs(motion.velocity)
