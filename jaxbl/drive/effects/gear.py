"""Effects of the gear beyond its law: free play, hardening, damping, hysteresis, kinematic error, friction under load."""

import jax.numpy as jnp

from ..parameters import Scalar
from .base import EFFECTS, Scales, TransmissionEffect, angle, harmonic, multiples, shape, size
from .friction import DryFriction

_GAPS = 0.01, 0.02, 0.04, 0.08, 0.12, 0.18, 0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 0.85, 0.92
"""Trial values of the half gap, over the largest twist: a larger gap leaves no contact, a smaller one hardly any play."""


def _trial_harmonics(log: Scales) -> list[float]:
    """Periods a load turn: 1 for an eccentric wheel of the load, the ratio for one of the motor, twice that for an angled
    coupling. Except for the first, the motion must cover half a radian of the wave."""
    higher = {*map(float, range(2, 9)), log.ratio, 2.0 * log.ratio} - {1.0}
    return [1.0, *(n for n in sorted(higher) if n * log.travel > 0.5)]


@EFFECTS.add
class TwistOffset(TransmissionEffect):
    """Twist without torque, as where the zeros of both encoders do not agree: the law sees z - offset."""

    kind = "offset"
    in_log = "[log] theta_e.offset takes it off"
    offset: Scalar = size("rad", "twist without torque, at the motor", trial=lambda log: 0.02 * log.twist)

    def transmission_error(self, state, load_position):
        return -self.offset


@EFFECTS.add
class Backlash(TransmissionEffect):
    """A hard gap in series with the law: deflection z - clip(z, -b, b), where b is the half gap."""

    kind = "backlash"
    half_gap: Scalar = shape(
        "rad",
        "half of the free play, on the motor side",
        multiples("largest_twist", _GAPS),
        neutral=0.0,
        minimum=0.0,
    )

    def deflect(self, state, z):
        return z - jnp.clip(z, -self.half_gap, self.half_gap)

    def free_play(self):
        return self.half_gap

    @classmethod
    def suits(cls, transmission):
        # the gap of a law and this one cannot be told apart
        return super().suits(transmission) and "half_gap" not in transmission.truth()


@EFFECTS.add
class Hardening(TransmissionEffect):
    """Stiffness that grows with the deflection z: torque K_3 z^3 beside the law."""

    kind = "hardening"
    cubic_stiffness: Scalar = size("N m/rad³", "cubic stiffness K_3")

    def transmit(self, state, deflection, rate):
        return self.cubic_stiffness * deflection**3


@EFFECTS.add
class Damping(TransmissionEffect):
    """Damping of the shaft: torque D dz/dt beside the law, where z is the elastic deflection (none inside a hard gap)."""

    kind = "damping"
    velocity_dependent = True
    damping: Scalar = size("N m s/rad", "damping D", minimum=0.0)

    def transmit(self, state, deflection, rate):
        return self.damping * rate


@EFFECTS.add
class Hysteresis(TransmissionEffect):
    """Friction within the shaft (Bouc-Wen, n = 2): torque T w beside the law. With the deflection z, dw/dz is 1 / length
    while w returns to 0, and (1 - w²) / length while it grows. For small swings the stiffness is higher by T / length."""

    kind = "hysteresis"
    torque: Scalar = size("N m", "largest hysteretic torque T", minimum=0.0)
    length: Scalar = shape(
        "rad",
        "deflection over which it builds up",
        multiples("largest_twist", (0.03, 0.08, 0.2, 0.4, 0.8)),
        above=0.0,
    )

    def init(self):
        return (jnp.zeros_like(self.length),)

    def advance(self, state, motion, step):
        # exact at a steady rate: linear up to w = 0, a hyperbolic tangent from there on
        forward = jnp.where(motion.velocity < 0.0, -1.0, 1.0)
        distance = jnp.abs(motion.velocity) * step / self.length
        w = forward * state[0]
        rise = jnp.tanh(jnp.maximum(distance + jnp.minimum(w, 0.0), 0.0))
        base = jnp.maximum(w, 0.0)
        return (forward * jnp.where(w + distance < 0.0, w + distance, (base + rise) / (1.0 + base * rise)),)

    def transmit(self, state, deflection, rate):
        return self.torque * state[0]


@EFFECTS.add
class Eccentricity(TransmissionEffect):
    """Eccentric gear: transmission error A sin(n theta_s + phase). The torque ratio changes with it, so that no power is
    lost. For an eccentric pinion, which turns with the motor, n is the gear ratio."""

    kind = "eccentricity"
    # a small part of the twist, for which the torque is linear in the amplitude
    amplitude: Scalar = size("rad", "amplitude A, on the motor side", trial=lambda log: 0.02 * log.twist)
    harmonic: Scalar = harmonic("periods n a load turn", _trial_harmonics, default=1.0)
    phase: Scalar = angle("phase at theta_s = 0")

    def transmission_error(self, state, load_position):
        return self.amplitude * jnp.sin(self.harmonic * load_position + self.phase)


@EFFECTS.add
class LoadFriction(TransmissionEffect):
    """Friction of gear teeth or a screw under load: dry friction mu |C| on the motor's side, where C is the transmitted
    torque; on a rigid drive, whose inertia may be on either side, what gravity and other effects on the load take. The
    efficiency is 1 / (1 + mu) while the motor drives, and 1 - mu while the load drives; with mu >= 1 the gear is
    self-locking.

    Reference: M. Duclusaud, G. Passault, V. Padois, O. Ly, Extended friction models for the physics simulation of servo
    actuators, arXiv:2410.08650 (2024): their load-dependent friction.
    """

    kind = "load_friction"
    law_error = DryFriction.law_error
    coefficient: Scalar = size("", "friction torque over transmitted torque, mu", minimum=0.0)

    @classmethod
    def suits(cls, transmission):
        return True

    def gear_friction(self, state, torque):
        return self.coefficient * jnp.abs(torque)
