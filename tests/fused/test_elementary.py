"""Elementary functions from arithmetic alone, against NumPy in more digits than they have."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbl.fused.elementary import FUNCTIONS, LIMIT, round_half_even

TRUE = {
    "exp": np.exp,
    "expm1": np.expm1,
    "tanh": np.tanh,
    "sin": np.sin,
    "cos": np.cos,
    "logistic": lambda x: 1.0 / (1.0 + np.exp(-x)),
}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", list(FUNCTIONS))
def test_accurate_to_some_units_in_the_last_place(name, dtype):
    small = np.geomspace(1e-12, 1.0, 4001)
    large = np.linspace(0.0, 80.0 if name in ("exp", "expm1", "logistic") else 1e3, 40001)
    x = np.concatenate([-large, -small, small, large]).astype(dtype)
    longdouble = np.asarray(jax.jit(FUNCTIONS[name])(jnp.asarray(x))).astype(np.longdouble)
    truth = TRUE[name](x.astype(np.longdouble))
    # near its zeros a sine is as accurate as its argument's reduction: one unit of the largest value
    scale = np.maximum(np.abs(truth), 1.0 if name in ("sin", "cos") else 0.0)
    worst = np.max(np.abs(longdouble - truth) / np.spacing(scale.astype(dtype)))
    assert worst < LIMIT


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_edges(dtype):
    x = jnp.asarray([np.inf, -np.inf, np.nan, 0.0, 1e4, -1e4], dtype)
    y = jax.jit(lambda x: {name: FUNCTIONS[name](x) for name in ("exp", "expm1", "sin")})(x)
    np.testing.assert_array_equal(y["exp"], np.array([np.inf, 0, np.nan, 1, np.inf, 0], dtype))
    np.testing.assert_array_equal(FUNCTIONS["tanh"](x)[:4], np.array([1, -1, np.nan, 0], dtype))
    np.testing.assert_array_equal(y["expm1"], np.array([np.inf, -1, np.nan, 0, np.inf, -1], dtype))
    assert np.isnan(y["sin"][:3]).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_rounded_to_the_even_one_of_two(dtype):
    x = np.array([0.5, 1.5, 2.5, -0.5, -1.5, 0.49999, 1e6 + 0.5, 3e9, -7.7], dtype)
    np.testing.assert_array_equal(jax.jit(round_half_even)(jnp.asarray(x)), np.round(x))
