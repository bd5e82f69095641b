"""Errors of encoders: zero point, clock, eccentricity.

They change readings, not the motion. A log is corrected for them when it is read (`[log]`), so that no model of a log has
them.
"""

import jax.numpy as jnp

from ..parameters import Scalar, parameter
from .base import EFFECTS, EncoderEffect


@EFFECTS.add
class Offset(EncoderEffect):
    """Zero point of the motor's encoder: the reading is theta_e + offset."""

    kind = "offset"
    encoder = "motor"
    in_log = "[log] theta_e.offset takes it off"
    offset: Scalar = parameter("rad", "reading at position 0")

    def read(self, position, velocity):
        return position + self.offset


@EFFECTS.add
class Skew(EncoderEffect):
    """Clock of the load's encoder: readings are older than their time stamps, theta - skew dtheta/dt."""

    kind = "skew"
    in_log = "[log] theta_s.skew takes it off"
    skew: Scalar = parameter("s", "age of a reading at its stamp; short beside the changes of the velocity")

    def read(self, position, velocity):
        return position - self.skew * velocity


@EFFECTS.add
class EncoderEccentricity(EncoderEffect):
    """Eccentric disk of the load's encoder: theta + A sin(n theta + phase)."""

    kind = "eccentricity"
    amplitude: Scalar = parameter("rad", "amplitude A")
    harmonic: Scalar = parameter("1/turn", "periods n a turn; 2 of a tilted disk", default=1.0, above=0.0)
    phase: Scalar = parameter("rad", "phase at theta = 0", default=0.0)

    def read(self, position, velocity):
        return position + self.amplitude * jnp.sin(self.harmonic * position + self.phase)
