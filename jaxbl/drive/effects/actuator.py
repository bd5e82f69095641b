"""The actuator: what becomes of the commanded torque."""

from typing import ClassVar

import jax.numpy as jnp

from ..parameters import Scalar
from .base import EFFECTS, ActuatorEffect, shape, size

_LIMITS = 0.98, 0.95, 0.92, 0.88, 0.84, 0.8, 0.75, 0.7, 0.65, 0.6, 0.55, 0.5, 0.45, 0.4, 0.35, 0.3
"""Limits tried, over the largest commanded torque."""
_LAGS = 0.3, 0.6, 1.2, 2.4, 5.0, 10.0, 20.0, 40.0, 80.0, 160.0
"""Time constants tried, in samples: by factors of about 2."""


@EFFECTS.add
class GainError(ActuatorEffect):
    """Torque constant off by a relative error: u (1 + e)."""

    kind: ClassVar[str] = "gain_error"
    rank: ClassVar[int] = 1
    relative: Scalar = size("", "relative error e of the torque", minimum=-1.0)

    def actuate(self, state, torque, step):
        return state, (1.0 + self.relative) * torque


@EFFECTS.add
class Saturation(ActuatorEffect):
    """Torque limit: clip(u, -limit, limit)."""

    kind: ClassVar[str] = "saturation"
    rank: ClassVar[int] = 2
    limit: Scalar = shape(
        "N m", "largest torque", lambda log: [share * log.torque for share in _LIMITS], neutral=1e30, above=0.0
    )

    def actuate(self, state, torque, step):
        return state, jnp.clip(torque, -self.limit, self.limit)


@EFFECTS.add
class Lag(ActuatorEffect):
    """First-order lag of the torque: T du_a/dt = u - u_a, advanced exactly for a held u; starts at zero torque."""

    kind: ClassVar[str] = "lag"
    rank: ClassVar[int] = 3
    time_constant: Scalar = shape(
        "s", "time constant T", lambda log: [samples * log.period for samples in _LAGS], neutral=1e-30, above=0.0
    )

    def init(self):
        return (jnp.zeros_like(self.time_constant),)

    def settled(self, torque):
        return (jnp.zeros_like(self.time_constant) + torque,)

    def actuate(self, state, torque, step):
        (lagged,) = state
        steps = step / self.time_constant
        new = torque + (lagged - torque) * jnp.exp(-steps)
        # the mean over the step keeps the impulse
        return (new,), torque + (lagged - torque) * -jnp.expm1(-steps) / steps
