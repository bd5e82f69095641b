"""The gear beyond its law: free play, hardening, damping, kinematic error."""

from typing import ClassVar

import jax.numpy as jnp

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


@EFFECTS.add
class Damping(TransmissionEffect):
    """Damping of the shaft: + D dz/dt of the elastic deflection (none inside a hard gap)."""

    kind: ClassVar[str] = "damping"
    velocity_dependent: ClassVar[bool] = True
    damping: Scalar = size("N m s/rad", "damping D", minimum=0.0)

    def transmit(self, state, deflection, rate):
        return self.damping * rate


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
