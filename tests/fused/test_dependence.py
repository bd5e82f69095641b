"""What all lanes share is found, and both parts together do what the function does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbl.fused.dependence import Dependence, find_carry_dependences, split_by_lane


def begin(values):
    return {"shared": jnp.asarray(0.0), "own": values[0], "kept": jnp.asarray(2.0), "led": jnp.asarray(1.0)}


def step(values, carry, sample_input):
    # `led` becomes a lane's only by way of `own`
    shared = carry["shared"] + jnp.tanh(sample_input) * carry["kept"]
    own_state = jax.lax.fori_loop(0, 3, lambda i, x: 0.5 * x + shared * values[1], carry["own"])
    return {"shared": shared, "own": own_state, "kept": carry["kept"], "led": carry["led"] + carry["own"]}


@pytest.fixture
def split_step():
    values = [jnp.asarray(1.0), jnp.asarray(3.0)]
    kinds = find_carry_dependences(begin, ((step, jnp.asarray(0.0)),), values)
    return kinds, split_by_lane(step, values, begin(values), jnp.asarray(0.0), kinds, kinds)


def test_kinds_of_a_carry(split_step):
    names = sorted(begin([jnp.asarray(1.0)]))
    assert [name for name, kind in zip(names, split_step[0], strict=True) if kind == Dependence.LANE] == ["led", "own"]


def test_parts_make_the_whole(split_step):
    kinds, (shared, lane, of_lane) = split_step
    assert of_lane == [kind == Dependence.LANE for kind in kinds]
    values = [jnp.asarray(0.3), jnp.asarray(-1.2)]
    carry = begin(values)
    leaves, tree = jax.tree.flatten(carry)
    lane_leaves = [leaf for leaf, kind in zip(leaves, kinds, strict=True) if kind == Dependence.LANE]
    state = [leaf for leaf, kind in zip(leaves, kinds, strict=True) if kind != Dependence.LANE]
    for inputs in jnp.linspace(0.1, 2.0, 5):
        carry = step(values, carry, inputs)
        state, handed = shared(state, inputs)
        lane_leaves = jax.core.eval_jaxpr(lane.jaxpr, lane.consts, *values, *lane_leaves, *handed)
    leaf_iterators = iter(lane_leaves), iter(state)
    joined_carry = tree.unflatten(
        [next(leaf_iterators[0] if kind == Dependence.LANE else leaf_iterators[1]) for kind in kinds]
    )
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-14), joined_carry, carry)


def test_the_lanes_part_leaves_the_shared_work_to_the_other(split_step):
    names = {eqn.primitive.name for eqn in split_step[1].lane.jaxpr.eqns}
    assert "tanh" not in names


def test_a_recursion_leaves_what_needs_no_state_to_be_done_at_once():
    table = jnp.linspace(-1.0, 1.0, 7)

    def sample(state, inputs):
        index, noise = inputs
        driving = jnp.sin(0.3 * index) + table[index % 7]
        speed = state[0] + 0.1 * (driving - jnp.tanh(state[1]) + noise)
        return [speed, state[1] + 0.1 * speed], [driving, state[1], index > 3, speed > 0.0]

    state = [jnp.asarray(0.2), jnp.asarray(-0.1)]
    inputs = jnp.arange(9), jnp.linspace(-0.5, 0.5, 9)
    first_inputs, needing = jax.tree.map(lambda x: x[0], inputs), [Dependence.LANE] * 2
    parts = split_by_lane(lambda _, state, inputs: sample(state, inputs), [], state, first_inputs, needing, needing)
    assert parts.is_lane_result == [True, True, False, True, False, True]
    # neither the table nor a sine is left to the loop
    assert not {eqn.primitive.name for eqn in parts.lane.jaxpr.eqns} & {"sin", "gather", "rem"}
    stateless_outputs, loop_inputs = jax.vmap(lambda inputs: parts.shared((), inputs))(inputs)
    last, handed = jax.lax.scan(sample, state, inputs)
    for i in range(9):
        step_outputs = jax.core.eval_jaxpr(
            parts.lane.jaxpr, parts.lane.consts, *state, *(column[i] for column in loop_inputs)
        )
        state, outputs = (
            step_outputs[:2],
            {False: iter(column[i] for column in stateless_outputs), True: iter(step_outputs[2:])},
        )
        for needs_state, output in zip(parts.is_lane_result[2:], handed, strict=True):
            np.testing.assert_allclose(next(outputs[needs_state]), output[i], rtol=1e-6)
    np.testing.assert_allclose(state, last, rtol=1e-6)
