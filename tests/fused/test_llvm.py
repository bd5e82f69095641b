"""A loop reads and writes where arrays lie: what does not fit its signature is refused before it runs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbl.fused.jaxprs import trace_inlined
from jaxbl.fused.llvm import ArrayRows, Loop, LoopArrays

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
        "value 0": np.array([1.0, 2.0]),
        "carry 0": np.zeros(2),
        "constant 0": np.array(10.0),
        "sample input 0": np.arange(5, dtype=np.int32),
        "sample input 1": np.arange(5.0),
        "sample output 0": np.empty(10),
    }


def test_a_loop_says_what_it_takes(sum_loop):
    assert [arg.name for arg in sum_loop.signature] == list(loop_buffers())
    assert [arg.extent for arg in sum_loop.signature] == [
        "lanes",
        "lanes",
        "scalar",
        "samples",
        "samples",
        "samples and lanes",
    ]
    inputs = loop_buffers()
    sum_loop(list(inputs.values()), 5, 2)
    np.testing.assert_array_equal(inputs["carry 0"], [110.0, 120.0])
    np.testing.assert_array_equal(inputs["sample output 0"].reshape(5, 2)[2], [33.0, 36.0])


BAD_BUFFERS = {
    "shorter": lambda array: array.ravel()[:-1],
    "longer": lambda array: np.append(array, array.ravel()[0]),
    "of another type": lambda array: array.astype(np.float32 if array.dtype == float else np.int64),
    "with gaps": lambda array: np.repeat(array.ravel(), 2)[::2] if array.size > 1 else array.astype(np.float32),
}


@pytest.mark.parametrize("name", loop_buffers())
@pytest.mark.parametrize("wrong", BAD_BUFFERS)
def test_what_does_not_fit_is_refused(sum_loop, name, wrong):
    inputs = loop_buffers()
    inputs[name] = BAD_BUFFERS[wrong](inputs[name])
    with pytest.raises(ValueError, match=rf"^{name} of a loop needs \d+ contiguous numbers of type"):
        sum_loop(list(inputs.values()), 5, 2)


def test_arrays_serve_no_more_samples_and_lanes_than_they_were_made_for(sum_loop):
    loop_arrays = LoopArrays(sum_loop.signature, list(loop_buffers().values()), 5, 2)
    with pytest.raises(ValueError, match="arrays were made for 5 and 2"):
        sum_loop(loop_arrays, 6, 2)
    with pytest.raises(ValueError, match="arrays were made for 5 and 2"):
        sum_loop(loop_arrays, 5, 4)
    with pytest.raises(ValueError, match="needs 6 arrays, not 5"):
        sum_loop(list(loop_buffers().values())[:-1], 5, 2)


def test_rows_of_one_array_stand_for_several(sum_loop):
    inputs = loop_buffers()
    stacked = np.array([inputs["value 0"], inputs["carry 0"]])
    other_buffers = list(inputs.values())[2:]
    sum_loop([ArrayRows(stacked), *other_buffers], 5, 2)
    np.testing.assert_array_equal(stacked, [[1.0, 2.0], [110.0, 120.0]])
    with pytest.raises(ValueError, match="sample input 0 of a loop needs 5 contiguous numbers of type int32"):
        sum_loop([ArrayRows(stacked), other_buffers[0], ArrayRows(np.zeros((2, 5))), other_buffers[3]], 5, 2)
    with pytest.raises(ValueError, match="constant 0 of a loop is no row of one array"):
        sum_loop([ArrayRows(np.zeros((3, 2))), *other_buffers[1:]], 5, 2)
    with pytest.raises(ValueError, match="value 0 of a loop is no row of one array"):
        sum_loop([ArrayRows(np.zeros((4, 2))[::2]), *other_buffers], 5, 2)
    with pytest.raises(ValueError, match="needs 6 arrays, not 7"):
        sum_loop([ArrayRows(np.zeros((3, 2))), *other_buffers], 5, 2)
