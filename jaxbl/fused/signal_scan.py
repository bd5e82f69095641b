"""Scan a function of a sample's scalars along a signal, by a loop for this machine's processor: one loop for all lengths."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from . import Arrays, Leaves, program_cache

SampleFunction = Callable[[Leaves, Leaves, Leaves], tuple[Leaves, Leaves]]
"""From values, carry and a sample's inputs to the next carry and the sample's outputs."""
_NUMBER = jax.ShapeDtypeStruct((), np.dtype(float))


def scan_signal(
    sample: SampleFunction, values: Sequence[np.ndarray], carry: Sequence[np.ndarray], inputs: Sequence[np.ndarray]
) -> Arrays:
    """Scan a function along a signal for several lanes; by XLA where it cannot be compiled otherwise.

    Args:
        sample: a function of a module.
        values: numbers of each lane that stay the same, shape (lanes,).
        carry: numbers of each lane before the first sample, shape (lanes,).
        inputs: of each sample, shape (samples,), or of each sample and lane, shape (samples, lanes).

    Returns:
        The outputs of the function, each of shape (samples, lanes).
    """
    lanes, samples = len(carry[0]), len(inputs[0])
    inputs = [column[:, 0] if lanes == 1 and column.ndim == 2 else column for column in map(np.asarray, inputs)]
    loop = _compile_loop(sample, len(values), len(carry), len(inputs), lanes == 1, inputs[0].ndim == 2)
    if loop is None:
        with jax.enable_x64(True):
            arguments = [[jnp.asarray(column, float) for column in columns] for columns in (values, carry, inputs)]
            return [np.asarray(column) for column in _scan_by_xla(sample, *arguments)]
    width = -(-lanes // loop.lanes) * loop.lanes
    padding = (0, width - lanes)
    lane_columns = [np.pad(np.asarray(column, float), padding, "edge") for column in (*values, *carry)]
    padded_inputs = [
        np.ascontiguousarray(column if column.ndim == 1 else np.pad(column, ((0, 0), padding)), float) for column in inputs
    ]
    outputs = [np.empty((samples, width)) for spec in loop.signature if spec.name.startswith("sample output")]
    loop([*lane_columns, *padded_inputs, *outputs], samples, width)
    return [output[:, :lanes] for output in outputs]


@program_cache.compile_once
def _compile_loop(
    sample: SampleFunction, values: int, carry: int, inputs: int, has_single_lane: bool, has_lane_inputs: bool
) -> Any:
    """The loop for these numbers of arguments; None if it is not supported."""
    lanes, lane_inputs = 1 if has_single_lane else None, inputs if has_lane_inputs else 0
    examples = [[_NUMBER] * size for size in (values, carry, inputs)]
    return sample, examples, {"values": values, "carry": carry, "lane_inputs": lane_inputs, "lanes": lanes}


@partial(jax.jit, static_argnums=0)
def _scan_by_xla(
    sample: SampleFunction, values: list[jax.Array], carry: list[jax.Array], inputs: list[jax.Array]
) -> list[jax.Array]:
    return jax.lax.scan(lambda carry, inputs: sample(values, carry, inputs), carry, inputs)[1]
