"""Equivalent control (15): the slow part of the switching term z_2, taken by a first-order low-pass."""

import equinox as eqx
import jax.numpy as jnp

from jaxbl.drive.parameters import Scalar, ScalarArray, parameter


class EquivalentControl(eqx.Module):
    """First-order low-pass T dz/dt = z_2 - z, exact for an input that is held; with time constant 0, z = z_2."""

    time_constant: Scalar = parameter("s", "time constant of the low-pass on z_2", default=0.01, minimum=0.0)

    def filter(self, filtered: ScalarArray, value: ScalarArray, step: Scalar) -> ScalarArray:
        """Advance the filtered value by `step` seconds with the input `value`, in the same unit."""
        positive = jnp.where(self.time_constant > 0.0, self.time_constant, 1.0)
        share = jnp.where(self.time_constant > 0.0, -jnp.expm1(-step / positive), 1.0)
        return filtered + share * (value - filtered)
