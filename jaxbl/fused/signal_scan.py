"""Scan a function of a sample's scalars along a signal, by a loop for this machine's processor: one loop for all lengths."""

from collections.abc import Callable, Sequence

import numpy as np

from . import Arrays, Leaves
from .compiled_loop import NUMBER, LoopDefinition, compile_once

SampleFunction = Callable[[Leaves, Leaves, Leaves], tuple[Leaves, Leaves]]
"""From values, carry and a sample's inputs to the next carry and the sample's outputs."""


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
    lanes = len(carry[0])
    columns = [column[:, 0] if lanes == 1 and column.ndim == 2 else column for column in map(np.asarray, inputs)]
    by_kind = (columns, ()) if columns[0].ndim == 1 else ((), columns)
    groups = [np.ascontiguousarray(group, float) for group in (values, carry, *by_kind)]
    loop = compile_signal_loop(sample, *map(len, groups), lanes == 1)
    names = "values", "carry", "sample_inputs", "lane_inputs"
    return [*loop.run(len(columns[0]), lanes, **dict(zip(names, groups, strict=True)))[1]]


@compile_once
def compile_signal_loop(
    sample: SampleFunction, values: int, carry: int, shared_inputs: int, lane_inputs: int, has_single_lane: bool
) -> LoopDefinition:
    """The loop for these numbers of arguments: inputs of each sample come before those of each sample and lane."""

    def advance(values: Leaves, carry: Leaves, shared_inputs: Leaves, lane_inputs: Leaves) -> tuple[Leaves, Leaves]:
        return sample(values, carry, [*shared_inputs, *lane_inputs])

    counts = {"values": values, "carry": carry, "sample_inputs": shared_inputs, "lane_inputs": lane_inputs}
    return advance, {group: [NUMBER] * count for group, count in counts.items()}, 1 if has_single_lane else None
