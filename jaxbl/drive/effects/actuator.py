"""Effects of the actuator, which turns the commanded torque into the one that acts."""

import jax.numpy as jnp

from ..parameters import Scalar, parameter
from .base import EFFECTS, ActuatorEffect, multiples, shape, size

_LIMITS = 0.98, 0.95, 0.92, 0.88, 0.84, 0.8, 0.75, 0.7, 0.65, 0.6, 0.55, 0.5, 0.45, 0.4, 0.35, 0.3
"""Trial values of a torque limit, over the largest commanded torque."""
DELAY_SAMPLES = 16
"""Most samples of a delay, each of which is a state. Few buses and controllers need more than 4."""
_DELAYS = 0.5, 1.0, 2.0, 4.0, 8.0
"""Trial values of a delay, in samples."""
_LAGS = 0.3, 0.6, 1.2, 2.4, 5.0, 10.0, 20.0, 40.0, 80.0, 160.0
"""Trial values of a time constant, in samples, apart by factors of about 2."""


class _TorqueMemory(ActuatorEffect):
    """An effect whose state is torques of the past."""

    def settled(self, torque):
        return tuple(past + torque for past in type(self).init(self))


@EFFECTS.add
class Delay(_TorqueMemory):
    """Dead time of the torque: u(t - T), exact for an input held from sample to sample. Before t = 0 the input was zero."""

    kind = "delay"
    state_from_input = True
    rank = 0
    delay: Scalar = shape("s", "dead time T", multiples("period", _DELAYS), neutral=1e-30, minimum=0.0)

    def init(self):
        return (jnp.zeros_like(self.delay),) * DELAY_SAMPLES

    def receive(self, state, torque, period):
        commanded = (torque, *state)
        samples = jnp.clip(self.delay / period, 0.0, DELAY_SAMPLES)
        full_samples = jnp.minimum(jnp.floor(samples), DELAY_SAMPLES - 1.0)
        # the command that has arrived when the sample begins, and the one that arrives within it
        first, then = (
            sum(jnp.where(full_samples == k, command, 0.0) for k, command in enumerate(commands))
            for commands in (commanded[1:], commanded[:-1])
        )
        return commanded[:-1], first, then, (samples - full_samples) * period

    @classmethod
    def find_fault(cls, numbers, period):
        limit = DELAY_SAMPLES * period
        if numbers["delay"] <= limit * (1.0 + 1e-9):
            return ""
        return f"delay: {numbers['delay']:g} s is longer than {DELAY_SAMPLES} samples; it should be at most {limit:g} s"


@EFFECTS.add
class GainError(ActuatorEffect):
    """Relative error e of the torque constant: u (1 + e)."""

    kind = "gain_error"
    rank = 1
    relative: Scalar = size("", "relative error e of the torque", minimum=-1.0)

    def actuate(self, state, torque, step):
        return state, (1.0 + self.relative) * torque

    @classmethod
    def find_fault(cls, numbers, period):
        return "" if numbers["relative"] > -1.0 else "relative: at -1 no input acts on the drive; it should be above -1"


@EFFECTS.add
class Saturation(ActuatorEffect):
    """Torque limit: clip(u, -limit, limit)."""

    kind = "saturation"
    rank = 2
    limit: Scalar = shape("N m", "largest torque", multiples("torque", _LIMITS), neutral=1e30, above=0.0)

    def actuate(self, state, torque, step):
        return state, jnp.clip(torque, -self.limit, self.limit)


@EFFECTS.add
class Lag(_TorqueMemory):
    """First-order lag of the torque: T du_a/dt = u - u_a, exact for a held input; u_a is zero at t = 0."""

    kind = "lag"
    state_from_measurement = True
    rank = 3
    time_constant: Scalar = shape("s", "time constant T", multiples("period", _LAGS), neutral=1e-30, above=0.0)

    def init(self):
        return (jnp.zeros_like(self.time_constant),)

    def actuate(self, state, torque, step):
        (lagged,) = state
        ratio = step / self.time_constant
        new = torque + (lagged - torque) * jnp.exp(-ratio)
        # the mean over the step has the impulse of the lagged torque
        return (new,), torque + (lagged - torque) * -jnp.expm1(-ratio) / ratio


@EFFECTS.add
class BackEmf(ActuatorEffect):
    """A motor fed by a voltage, the input u in V: torque k_t / R (u - k_t omega), without inductance (see `actuator.lag`).
    For a log in V, `[log] u` has the factor 1. A diagnosis does not try it: back-EMF acts as viscous friction of the motor.
    """

    kind = "back_emf"
    rank = 4
    input_unit = "V"
    velocity_dependent = True
    resistance: Scalar = parameter("ohm", "resistance R of the winding", above=0.0)
    torque_constant: Scalar = parameter("N m/A", "torque constant k_t, which is that of the back-EMF in V s/rad", above=0.0)

    def actuate(self, state, torque, step):
        return state, self.torque_constant / self.resistance * torque

    def resist(self, state, motion):
        return self.torque_constant**2 / self.resistance * motion.velocity
