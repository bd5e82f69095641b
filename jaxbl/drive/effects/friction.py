"""Friction of a side: dry, falling with speed, with contacts that bend before they slide, drifting, viscous, different by
direction, and drag."""

from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp

from ..mujoco_parts import IMPEDANCE, Bristles, exactly, nearly, unsaid
from ..parameters import Scalar
from .base import EFFECTS, SideEffect, held, shape, size

_BRISTLES, _BEND, _SHORTER = 0.06, 0.15, 4.0
"""Of contacts that stand for dry friction: the rate at which they swing times the time step, at most, and how far they bend
over the way of a step at the Stribeck speed, at least; stiffer ones lag behind at high speed. Steps are so much shorter."""


@EFFECTS.add
class CoulombFriction(SideEffect):
    """Dry friction of constant level: sticks below it, F_c sign(v) in motion."""

    kind: ClassVar[str] = "coulomb_friction"
    exclusive: ClassVar[str | None] = "dry friction"
    torque: Scalar = size("N m", "friction torque F_c", minimum=0.0)

    def dry_friction(self, state, motion):
        return self.torque

    def to_mujoco(self, parts, side):
        one = parts.sides[side]
        one.dry += self.torque
        # within MuJoCo's law of a friction row at rest: (1 - d) of the free acceleration, against the damping 1 / step
        creep = (1.0 - IMPEDANCE) * parts.step * self.torque / one.inertia
        return nearly(
            f"frictionloss of the joint: exact while it slides; where it should stick it creeps by up to {creep:.2g} rad/s"
        )


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

    def dry_friction(self, state, motion):
        fall = jnp.exp(-((motion.velocity / self.stribeck_velocity) ** 2))
        return self.torque + (self.breakaway_torque - self.torque) * fall

    @classmethod
    def directions(cls):
        # sliding friction, and what break-away has more than that
        return [{"torque": 1.0, "breakaway_torque": 1.0}, {"breakaway_torque": 1.0}]

    @classmethod
    def possible(cls, numbers: Mapping[str, float]) -> bool:
        return super().possible(numbers) and numbers["breakaway_torque"] > numbers["torque"]

    def to_mujoco(self, parts, side):
        if self.torque <= 0.0:
            return unsaid("the friction of the dcmotor (LuGre) needs a sliding torque above 0")
        # contacts as stiff as steps allow; damped ones would need much shorter steps at high speed
        step, level = parts.shorten(_SHORTER), self.torque
        stiffness = min(parts.sides[side].inertia * (_BRISTLES / step) ** 2, level / (_BEND * step * self.stribeck_velocity))
        parts.friction(side, Bristles(stiffness, 0.0, level, self.breakaway_torque, self.stribeck_velocity))
        bend = max(self.torque, self.breakaway_torque) / stiffness
        return nearly(f"LuGre friction of a passive dcmotor: contacts bend by up to {bend:.2g} rad before they slide")


_LENGTHS = 0.001, 0.003, 0.01, 0.03, 0.1
"""Pre-sliding lengths tried, over the position's standard deviation: a shorter one is dry friction on most logs, a longer
one a spring."""


@EFFECTS.add
class PreslidingFriction(SideEffect):
    """Dry friction of contacts that bend before they slide (LuGre): torque F_c w + sigma_1 l dw/dt with
    l dw/dt = v - |v| w / s(v), s = 1 + (F_s / F_c - 1) exp(-(v / v_s)^2); stiffness F_c / l at a reversal. By its torque
    and length alone it is Dahl's model.

    References: P. R. Dahl, Solid friction damping of mechanical vibrations, AIAA Journal 14 (1976); C. Canudas de Wit et
    al., A new model for control of systems with friction, IEEE TAC 40 (1995). There sigma_0 = F_c / l, z = l w.
    Steps must resolve the bending: step * sqrt(F_c / (l J)) < 2, J the side's inertia.
    """

    kind: ClassVar[str] = "presliding_friction"
    velocity_dependent: ClassVar[bool] = True
    exclusive: ClassVar[str | None] = "dry friction"
    special_cases: ClassVar = {"coulomb_friction": lambda numbers: {"torque": numbers["torque"]}}
    torque: Scalar = size("N m", "sliding friction torque F_c", minimum=0.0)
    length: Scalar = shape(
        "rad",
        "pre-sliding length l = F_c over the stiffness of the contacts",
        lambda log: [share * log.spread for share in _LENGTHS],
        above=0.0,
    )
    # seen only in how a drive comes to rest or leaves it
    breakaway_ratio: Scalar = held("", "break-away torque over F_c", 1.0, above=0.0)
    stribeck_velocity: Scalar = held("rad/s", "speed v_s over which friction falls from break-away to F_c", 1.0, above=0.0)
    damping: Scalar = held("N m s/rad", "damping sigma_1 of the bending contacts", 0.0, minimum=0.0)

    def init(self):
        return (jnp.zeros_like(self.length),)

    def advance(self, state, motion, step):
        # exact at a steady velocity: w tends to +-s exponentially over the way
        forward = jnp.where(motion.velocity < 0.0, -1.0, 1.0)
        most = self._most(motion.velocity)
        left = jnp.exp(-forward * motion.velocity * step / (self.length * most))
        return (forward * most + (state[0] - forward * most) * left,)

    def resist(self, state, motion):
        v = motion.velocity
        return self.torque * state[0] + self.damping * (v - jnp.abs(v) * state[0] / self._most(v))

    def holds(self):
        return self.torque * jnp.maximum(self.breakaway_ratio, 1.0)

    def bent(self, torque):
        most = jnp.maximum(self.breakaway_ratio, 1.0)
        # at the neutral torque, zero, any state does
        return (jnp.clip(torque / jnp.where(self.torque == 0.0, 1.0, self.torque), -most, most),)

    def _most(self, velocity):
        """Steady friction over F_c."""
        return 1.0 + (self.breakaway_ratio - 1.0) * jnp.exp(-((velocity / self.stribeck_velocity) ** 2))

    def to_mujoco(self, parts, side):
        if self.torque <= 0.0:
            return unsaid("the friction of the dcmotor (LuGre) needs a sliding torque above 0")
        stiffness, breakaway = self.torque / self.length, self.torque * self.breakaway_ratio
        parts.friction(side, Bristles(stiffness, self.damping, self.torque, breakaway, self.stribeck_velocity))
        return exactly("LuGre friction of a passive dcmotor, while it moves by less than the length within a time step")


@EFFECTS.add
class DriftingFriction(SideEffect):
    """Dry friction that changes as the machine warms up: F + (F_0 - F) exp(-t / tau).

    Reference: L. Simoni, M. Beschi, G. Legnani, A. Visioli, Friction modeling with temperature effects for industrial robot
    manipulators, IROS (2015): one thermal time constant.
    """

    kind: ClassVar[str] = "drifting_friction"
    in_time: ClassVar[bool] = True
    exclusive: ClassVar[str | None] = "dry friction"
    special_cases: ClassVar = {"coulomb_friction": lambda one: {"torque": 0.5 * (one["torque"] + one["initial_torque"])}}
    torque: Scalar = size("N m", "friction torque F in the end, when warm", minimum=0.0)
    initial_torque: Scalar = size("N m", "friction torque F_0 at t = 0", minimum=0.0)
    time_constant: Scalar = shape(
        "s",
        "time constant tau of the change",
        # from a change over the log's first part to one that is all but linear in time
        lambda log: [share * log.duration for share in (0.1, 0.3, 1.0)],
        above=0.0,
    )

    def dry_friction(self, state, motion):
        return self.torque + (self.initial_torque - self.torque) * jnp.exp(-motion.time / self.time_constant)

    @classmethod
    def directions(cls):
        # steady friction, and what there is more at the start
        return [{"torque": 1.0, "initial_torque": 1.0}, {"initial_torque": 1.0}]

    def to_mujoco(self, parts, side):
        return unsaid("no friction of MuJoCo changes with time; set dof_frictionloss while it runs")


@EFFECTS.add
class ViscousFriction(SideEffect):
    """Error of the nominal viscous friction: an additional torque f v."""

    kind: ClassVar[str] = "viscous_friction"
    velocity_dependent: ClassVar[bool] = True
    corrects: ClassVar[str | None] = "viscous"
    viscous: Scalar = size("N m s/rad", "viscous friction on top of the nominal one; may be negative")

    def resist(self, state, motion):
        return self.viscous * motion.velocity

    def to_mujoco(self, parts, side):
        parts.sides[side].viscous += self.viscous
        return exactly("damping of the joint")


@EFFECTS.add
class AsymmetricFriction(SideEffect):
    """Friction that differs by direction: forwards half of each difference more than the drive and other effects say,
    backwards half less, (d_F + d_f |v|) / 2.

    For F+ + f+ v forwards and F- + f- |v| backwards: viscous friction (f+ + f-) / 2 of the drive, dry friction
    (F+ + F-) / 2, and the differences f+ - f- and F+ - F- here. A difference of dry friction alone is a constant torque.
    """

    kind: ClassVar[str] = "asymmetric_friction"
    velocity_dependent: ClassVar[bool] = True
    viscous_difference: Scalar = size("N m s/rad", "viscous friction forwards less that backwards, d_f")
    torque_difference: Scalar = held("N m", "dry friction forwards less that backwards, d_F", 0.0)

    def resist(self, state, motion):
        return 0.5 * (self.torque_difference + self.viscous_difference * jnp.abs(motion.velocity))

    def to_mujoco(self, parts, side):
        if self.viscous_difference:
            return unsaid("the damping of a joint is odd in the velocity; no element has a torque in proportion to |v|")
        parts.constant(side, 0.5 * self.torque_difference)
        return exactly("constant torque of a passive dcmotor")


@EFFECTS.add
class QuadraticDrag(SideEffect):
    """Fluid drag b v |v|."""

    kind: ClassVar[str] = "quadratic_drag"
    velocity_dependent: ClassVar[bool] = True
    drag: Scalar = size("N m s²/rad²", "drag coefficient b", minimum=0.0)

    def resist(self, state, motion):
        return self.drag * motion.velocity * jnp.abs(motion.velocity)

    def to_mujoco(self, parts, side):
        parts.sides[side].drag += self.drag
        return exactly("damping of the joint, its second coefficient")
