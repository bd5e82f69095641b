"""The gear beyond its law: free play, hardening, damping, hysteresis, kinematic error, friction under load."""

from typing import ClassVar

import jax.numpy as jnp

from ..mujoco_parts import exactly, nearly, unsaid
from ..parameters import Scalar
from .base import EFFECTS, Scales, TransmissionEffect, angle, harmonic, shape, size

_GAPS = 0.01, 0.02, 0.04, 0.08, 0.12, 0.18, 0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 0.85, 0.92
"""Half gaps tried, over the largest twist: a larger one leaves no contact, a smaller one next to no free play."""


def _eccentric(log: Scales) -> list[float]:
    """Once a turn is what eccentricity means, of the load's wheel or of the motor's, and twice what an angled coupling does;
    of all but the first half a radian of the wave must be seen."""
    others = {*map(float, range(2, 9)), log.ratio, 2.0 * log.ratio}
    return [1.0, *(n for n in sorted(others - {1.0}) if n * log.travel > 0.5)]


@EFFECTS.add
class Backlash(TransmissionEffect):
    """A hard gap in series with the law: contact only outside of +-half_gap."""

    kind: ClassVar[str] = "backlash"
    half_gap: Scalar = shape(
        "rad",
        "half of the free play, on the motor side",
        lambda log: [share * log.largest_twist for share in _GAPS],
        neutral=0.0,
        minimum=0.0,
    )

    def deflect(self, state, z):
        return z - jnp.clip(z, -self.half_gap, self.half_gap)

    def free_play(self):
        return self.half_gap

    def to_mujoco(self, parts, side):
        parts.half_gap += self.half_gap
        return exactly("the springs of the gear are slack within the gap (springlength)")

    @classmethod
    def suits(cls, transmission):
        # beside a law with a gap of its own the two cannot be told apart
        return "half_gap" not in transmission.truth()


@EFFECTS.add
class Hardening(TransmissionEffect):
    """Stiffness that grows with deflection: + K_3 z^3."""

    kind: ClassVar[str] = "hardening"
    cubic_stiffness: Scalar = size("N m/rad³", "cubic stiffness K_3")

    def transmit(self, state, deflection, rate):
        return self.cubic_stiffness * deflection**3

    def to_mujoco(self, parts, side):
        parts.spring(0.0, self.cubic_stiffness)
        return exactly("cubic stiffness of a tendon")


@EFFECTS.add
class Damping(TransmissionEffect):
    """Damping of the shaft: + D dz/dt of the elastic deflection (none inside a hard gap)."""

    kind: ClassVar[str] = "damping"
    velocity_dependent: ClassVar[bool] = True
    damping: Scalar = size("N m s/rad", "damping D", minimum=0.0)

    def transmit(self, state, deflection, rate):
        return self.damping * rate

    def to_mujoco(self, parts, side):
        parts.damping += self.damping
        if parts.half_gap == 0.0:
            return exactly("damping of the tendon; with a gap its limits, which is only near")
        return nearly(
            "limits of the tendon that act as spring and damper: as the law, but the flanks do not pull as they part"
        )


@EFFECTS.add
class Hysteresis(TransmissionEffect):
    """Friction within the shaft (Bouc-Wen, n = 2), beside the law: T w. With the deflection z, dw/dz = 1 / length where w
    returns to 0, and (1 - w²) / length where it grows. Small swings see a stiffness of T / length more."""

    kind: ClassVar[str] = "hysteresis"
    torque: Scalar = size("N m", "largest hysteretic torque T", minimum=0.0)
    length: Scalar = shape(
        "rad",
        "deflection over which it builds up",
        lambda log: [share * log.largest_twist for share in (0.03, 0.08, 0.2, 0.4, 0.8)],
        above=0.0,
    )

    def init(self):
        return (jnp.zeros_like(self.length),)

    def advance(self, state, motion, step):
        # exact at a steady rate: linear up to w = 0, a hyperbolic tangent from there on
        forward = jnp.where(motion.velocity < 0.0, -1.0, 1.0)
        way = jnp.abs(motion.velocity) * step / self.length
        w = forward * state[0]
        rise = jnp.tanh(jnp.maximum(way + jnp.minimum(w, 0.0), 0.0))
        base = jnp.maximum(w, 0.0)
        return (forward * jnp.where(w + way < 0.0, w + way, (base + rise) / (1.0 + base * rise)),)

    def transmit(self, state, deflection, rate):
        return self.torque * state[0]

    def to_mujoco(self, parts, side):
        return unsaid(
            "a spring that yields (springyield) breaks sharply: it would be up to 24 % of the hysteretic torque off"
        )


@EFFECTS.add
class Eccentricity(TransmissionEffect):
    """Eccentric gear: a transmission error A sin(n theta_s + phase); the torque ratio follows it (no power is lost). Of the
    pinion, once a motor turn: n is the gear ratio."""

    kind: ClassVar[str] = "eccentricity"
    # small beside the twist: the torque is linear in it there
    amplitude: Scalar = size("rad", "amplitude A, on the motor side", trial=lambda log: 0.02 * log.twist)
    harmonic: Scalar = harmonic("periods n a load turn", _eccentric, default=1.0)
    phase: Scalar = angle("phase at theta_s = 0")

    def transmission_error(self, state, load_position):
        return self.amplitude * jnp.sin(self.harmonic * load_position + self.phase)

    def to_mujoco(self, parts, side):
        return unsaid("tendons between joints are linear in the positions")


@EFFECTS.add
class LoadFriction(TransmissionEffect):
    """Friction of gear teeth or a screw under load: dry friction mu |C| on the motor's side, C the transmitted torque.
    Efficiency 1 / (1 + mu) where the motor drives, 1 - mu where the load does; from mu = 1 on the gear locks itself.

    A rigid drive has none: what its gear carries depends on how its inertia is shared, which it does not say.
    Reference: M. Duclusaud, G. Passault, V. Padois, O. Ly, Extended friction models for the physics simulation of servo
    actuators, arXiv:2410.08650 (2024): their load-dependent friction.
    """

    kind: ClassVar[str] = "load_friction"
    coefficient: Scalar = size("", "friction torque over transmitted torque, mu", minimum=0.0)

    def gear_friction(self, state, torque):
        return self.coefficient * jnp.abs(torque)

    def to_mujoco(self, parts, side):
        return unsaid("the friction of a joint does not depend on what its tendon carries")
