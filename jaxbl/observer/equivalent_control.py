"""Equivalent control (15): the slow part of the switching term, by a first-order low-pass."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbl.drive.parameters import Scalar, parameter


class EquivalentControl(eqx.Module):
    """First-order low-pass, advanced exactly for a held input; time constant 0 lets everything through."""

    time_constant: Scalar = parameter("s", "time constant of the low-pass on z_2", default=0.01, minimum=0.0)

    def filter(self, filtered: Float[Array, ""], value: Float[Array, ""], step: Scalar) -> Float[Array, ""]:
        """Next filtered value, in the unit of `value`; `step` in s."""
        positive = jnp.where(self.time_constant > 0.0, self.time_constant, 1.0)
        share = jnp.where(self.time_constant > 0.0, -jnp.expm1(-step / positive), 1.0)
        return filtered + share * (value - filtered)
