"""A loop reads and writes where arrays lie: what does not fit its signature is refused before it runs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbl.fused.jaxprs import trace_inlined
from jaxbl.fused.llvm import Loop, LoopArrays

NUMBER, INDEX = jax.ShapeDtypeStruct((), float), jax.ShapeDtypeStruct((), np.int32)


@pytest.fixture(scope="module")
def sum_loop():
    """Sums of a factor times the samples, and the sums so far."""

    def sample(factor, total, first, index, value):
        total = total + factor * value + first * index.astype(jnp.float64)
        return total, total

    return Loop(
        trace_inlined(sample, NUMBER, NUMBER, NUMBER, INDEX, NUMBER),
        np.dtype(float),
        values=1,
        carry=1,
        constants=1,
        lanes=2,
    )


def loop_buffers():
    return {
        "values": [np.array([1.0, 2.0])],
        "carry": [np.zeros(2)],
        "constants": [np.array(10.0)],
        "sample_inputs": [np.arange(5, dtype=np.int32), np.arange(5.0)],
        "outputs": [np.empty(10)],
    }


def run_loop(loop, groups):
    loop(LoopArrays(loop.signature, groups, 5, 2), 5)


def test_a_loop_says_what_it_takes(sum_loop):
    inputs = loop_buffers()
    types = {name: [array.dtype for array in arrays] for name, arrays in inputs.items()}
    assert {name: members for name, members in sum_loop.signature.items() if members} == types
    run_loop(sum_loop, inputs)
    np.testing.assert_array_equal(inputs["carry"][0], [110.0, 120.0])
    np.testing.assert_array_equal(inputs["outputs"][0].reshape(5, 2)[2], [33.0, 36.0])


BAD_BUFFERS = {
    "shorter": lambda array: array.ravel()[:-1],
    "longer": lambda array: np.append(array, array.ravel()[0]),
    "of another type": lambda array: array.astype(np.float32 if array.dtype == float else np.int64),
    "with gaps": lambda array: np.repeat(array.ravel(), 2)[::2] if array.size > 1 else array.astype(np.float32),
}


@pytest.mark.parametrize(
    ("name", "place"), [(name, i) for name, arrays in loop_buffers().items() for i in range(len(arrays))]
)
@pytest.mark.parametrize("wrong", BAD_BUFFERS)
def test_what_does_not_fit_is_refused(sum_loop, name, place, wrong):
    inputs = loop_buffers()
    inputs[name][place] = BAD_BUFFERS[wrong](inputs[name][place])
    with pytest.raises(ValueError, match=rf"^{name} of a loop: \d+ contiguous numbers of type"):
        run_loop(sum_loop, inputs)


def test_a_group_that_is_not_full_is_refused(sum_loop):
    inputs = loop_buffers()
    with pytest.raises(ValueError, match="a loop needs 2 sample_inputs, not 1"):
        run_loop(sum_loop, inputs | {"sample_inputs": inputs["sample_inputs"][:1]})
    with pytest.raises(ValueError, match="a loop needs 1 outputs, not 0"):
        run_loop(sum_loop, {name: arrays for name, arrays in inputs.items() if name != "outputs"})


def test_arrays_serve_no_more_samples_than_they_were_made_for(sum_loop):
    loop_arrays = LoopArrays(sum_loop.signature, loop_buffers(), 5, 2)
    with pytest.raises(ValueError, match="samples 0 to 6: not of 5 in blocks of 5"):
        sum_loop(loop_arrays, 6)
    with pytest.raises(ValueError, match="samples 2 to 5: not of 5 in blocks of 5"):
        sum_loop(loop_arrays, 5, start=2)


def test_rows_of_one_array_stand_for_several(sum_loop):
    inputs = loop_buffers()
    stacked = np.array([inputs["values"][0], inputs["carry"][0]])
    run_loop(sum_loop, inputs | {"values": stacked[:1], "carry": stacked[1:]})
    np.testing.assert_array_equal(stacked, [[1.0, 2.0], [110.0, 120.0]])
    for name, rows in (
        ("sample_inputs", np.zeros((2, 5))),
        ("values", np.zeros((1, 4))[:, ::2]),
        ("carry", np.zeros((1, 3))),
    ):
        with pytest.raises(ValueError, match=rf"^{name} of a loop: \d+ contiguous numbers of type"):
            run_loop(sum_loop, inputs | {name: rows[: len(inputs[name])]})


def test_vectors_are_filled_and_nothing_of_it_is_returned(sum_loop):
    inputs = loop_buffers()
    inputs |= {"values": [np.array([1.0, 2.0, 3.0])], "carry": np.zeros((1, 3))}
    del inputs["outputs"]
    (carry,), (outputs,), flags = sum_loop.run(5, 3, **inputs)
    np.testing.assert_array_equal(carry, [110.0, 120.0, 130.0])
    np.testing.assert_array_equal(outputs[2], [33.0, 36.0, 39.0])
    assert not len(flags) and not inputs["carry"].any()
