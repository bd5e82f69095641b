import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbl.control import REFERENCES, FunctionReference

NUMBERS = {
    "sine": (0.3, 0.7, 0.1),
    "ramp": (0.4, 0.55),
    "steps": (0.2, 0.25),
    "moves": (0.5, 0.4, 0.2),
}


@pytest.mark.parametrize("name", REFERENCES)
def test_velocity_and_acceleration_are_derivatives(name):
    reference, step = REFERENCES[name](*NUMBERS[name]), 1e-4
    # away from jumps and corners
    times = jnp.arange(0.003, 2.0, 0.01)
    target = jax.vmap(reference.target)(times)
    before, here, after = (jax.vmap(reference.position)(times + k * step) for k in (-1, 0, 1))
    np.testing.assert_allclose(target.position, here, rtol=1e-9)
    np.testing.assert_allclose(target.velocity, (after - before) / (2.0 * step), atol=2e-5)
    np.testing.assert_allclose(target.acceleration, (after - 2.0 * here + before) / step**2, atol=2e-5)


def test_moves_go_there_and_back_smoothly():
    moves = REFERENCES["moves"](0.5, 0.4, 0.2)
    target = jax.vmap(moves.target)(jnp.array([0.0, 0.2, 0.4, 0.55, 0.8, 1.0, 1.15, 1.2]))
    np.testing.assert_allclose(target.position, [0.0, 0.25, 0.5, 0.5, 0.25, 0.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(
        target.velocity, [0.0, 0.5 * 1.875 / 0.4, 0.0, 0.0, -0.5 * 1.875 / 0.4, 0.0, 0.0, 0.0], atol=1e-9
    )


def test_steps_come_at_their_sample():
    steps = REFERENCES["steps"](1.0, 0.1)
    times = jnp.arange(1000) * 1e-3
    np.testing.assert_array_equal(jax.vmap(steps.position)(times), (np.arange(1000) // 100) % 2)


def test_a_plain_function():
    target = FunctionReference(lambda time: time**3).target(jnp.asarray(2.0))
    np.testing.assert_allclose(target, (8.0, 12.0, 12.0))
