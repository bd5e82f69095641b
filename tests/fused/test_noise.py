"""Noise of many samples at once is the scan's, number by number."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbl.chain import unit_noise
from jaxbl.fused import noise as module
from jaxbl.fused.noise import LONGEST_SPAN, SIDES, draw_noise


@pytest.mark.parametrize(("seed", "first", "count"), [(0, 0, 500), (7, 1_000_003, 37), (2**32 - 1, 64, LONGEST_SPAN)])
def test_noise_is_that_of_the_scan(seed, first, count):
    noise = draw_noise(seed, first, count)
    expected = jax.jit(unit_noise, static_argnums=2)(jnp.asarray(seed, jnp.uint32), first + jnp.arange(count), SIDES)
    for side in SIDES:
        assert noise[side].dtype == np.float32
        np.testing.assert_array_equal(noise[side], expected[side])


def test_another_generator_of_jax_is_left_to_xla(monkeypatch):
    monkeypatch.setattr(module, "_compile_noise", module._compile_noise.__wrapped__)  # compiled anew
    before = draw_noise(3, 5, 40)
    with jax.threefry_partitionable(False):
        noise = draw_noise(3, 5, 40)
        expected = jax.jit(unit_noise, static_argnums=2)(jnp.asarray(3, jnp.uint32), 5 + jnp.arange(40), SIDES)
    for side in SIDES:
        np.testing.assert_array_equal(noise[side], expected[side])
        assert not np.array_equal(noise[side], before[side])
