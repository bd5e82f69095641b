"""Rewritten functions do what they did."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import jaxpr_as_fun

from jaxbl.fused.jaxprs import join_multiply_add, replace_primitives, trace_inlined


def function(x, y, z):
    p, q = x * y, y * z
    first = p + z  # joined
    second = x - q  # the product with the other sign
    third = (x * z) - y  # the rest with the other sign
    pair = x * x + y * y  # the first of two
    shared = x * z * z  # read twice: stays

    def substep(state, _):
        return 0.5 * state + x, None

    inside, _ = jax.lax.scan(substep, z, length=3)
    return first, second, third, pair, shared + first, shared - second, inside, jax.jit(jnp.tanh)(x)


def test_products_are_joined_with_sums():
    inputs = [jnp.asarray(value) for value in (0.7, -1.3, 2.1)]
    calls = []

    def multiply_add(a, b, c, *, minus_product, minus_rest):
        calls.append((minus_product, minus_rest))
        return (-1 if minus_product else 1) * a * b + (-1 if minus_rest else 1) * c

    closed = trace_inlined(function, *inputs)
    result = jaxpr_as_fun(join_multiply_add(closed, multiply_add))(*inputs)
    np.testing.assert_allclose(result, function(*inputs), rtol=1e-14)
    plain, negative_product, negative_sum = (False, False), (True, False), (False, True)
    assert calls == [plain, negative_product, negative_sum, plain, plain]


def test_operations_are_replaced_inside_of_calls_and_loops():
    inputs = [jnp.asarray(value) for value in (0.7, -1.3, 2.1)]
    replaced = replace_primitives(trace_inlined(function, *inputs), {"tanh": lambda x: 10.0 * x, "add": lambda a, b: a - b})
    result = jaxpr_as_fun(replaced)(*inputs)
    x, y, z = map(float, inputs)
    assert not {"jit", "pjit", "add", "tanh"} & {eqn.primitive.name for eqn in replaced.jaxpr.eqns}
    np.testing.assert_allclose(result[0], x * y - z)
    np.testing.assert_allclose(result[6], 0.125 * z - x * (1.0 + 0.5 + 0.25), rtol=1e-12)
    np.testing.assert_allclose(result[7], 10.0 * x)
