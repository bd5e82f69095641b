"""Fast compilation gives the same numbers, in other programs as well, and where JAX does not know its options."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbl.fused import compilation


@pytest.fixture(params=[compilation._FAST, {"xla_cpu_no_such_option": True}], ids=["known", "unknown"])
def function(request, monkeypatch):
    monkeypatch.setattr(compilation, "_FAST", request.param)
    compilation._options.cache_clear()
    yield compilation.jit(lambda x, power=2: jnp.cumsum(jnp.sin(x) ** power))
    compilation._options.cache_clear()


def test_numbers_are_those_of_the_function(function):
    x = jnp.linspace(0.0, 3.0, 200)
    expected = np.cumsum(np.sin(x) ** 3)
    np.testing.assert_allclose(function(x, power=3), expected, rtol=1e-12)
    np.testing.assert_allclose(jax.jit(lambda x: function(x, power=3))(x), expected, rtol=1e-12)
    np.testing.assert_allclose(jax.vmap(function)(jnp.stack([x, x]))[1], np.cumsum(np.sin(x) ** 2), rtol=1e-12)
    np.testing.assert_allclose(jax.grad(lambda x: function(x)[-1])(x), np.sin(2.0 * x), rtol=0.0, atol=1e-12)


def test_options_that_jax_does_not_know_are_left_out(monkeypatch):
    monkeypatch.setattr(compilation, "_FAST", {"xla_cpu_no_such_option": True})
    compilation._options.cache_clear()
    assert compilation._options() == {}
    compilation._options.cache_clear()
