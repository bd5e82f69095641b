"""The low-pass on the equivalent control."""

import jax.numpy as jnp
import numpy as np

from jaxbl.observer import EquivalentControl


def test_step_response_is_exact_at_any_period():
    """1 - exp(-t / T) at the samples, for periods from far below to far above the time constant."""
    low_pass = EquivalentControl(jnp.asarray(0.02))
    for period in (1e-4, 5e-3, 0.1):
        filtered = jnp.asarray(0.0)
        for i in range(1, 6):
            filtered = low_pass.filter(filtered, jnp.asarray(3.0), period)
            np.testing.assert_allclose(filtered, -3.0 * np.expm1(-i * period / 0.02), rtol=1e-12)


def test_time_constant_zero_lets_everything_through():
    low_pass = EquivalentControl(jnp.asarray([0.0, 0.02]))
    filtered = low_pass.filter(jnp.asarray([5.0, 5.0]), jnp.asarray([-2.0, -2.0]), 1e-3)
    assert filtered[0] == -2.0
    assert filtered[1] > 4.0
