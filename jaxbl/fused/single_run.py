"""One run with a record of its samples, by loops for this machine's processor.

The numbers are those of :func:`jaxbl.chain.scan` with a record. XLA starts some kernels for each sample of a single lane,
and takes longer to compile them than a study of that size takes to run.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.chain import (
    Experiment,
    NamedArrays,
    Reducers,
    Signals,
    State,
    TracedArrays,
    advance_sample,
    block_length,
    compute_metrics,
    end_block,
    initial_carry,
)

from . import Leaves, Unsupported
from .jaxprs import trace_inlined
from .llvm import Loop
from .noise import host_device
from .shared_part import SharedPart, compile_shared_part


def record_run(
    experiment: Experiment,
    seed: int,
    reducers: Reducers,
    record: Callable[[State, Signals], TracedArrays],
    stride: int = 1,
) -> tuple[NamedArrays, NamedArrays]:
    """Simulate one experiment, in its precision; arguments as for :func:`jaxbl.chain.scan`.

    Returns:
        The reducers' metrics `()` and the record `(samples,)`, both by name.
    """
    with jax.default_device(host_device()):
        start = jax.eval_shape(lambda: initial_carry(experiment, reducers))
        tree, leaves = jax.tree.structure(start), jax.tree.leaves(start)
        names: list[str] = []

        def step(state: Any, sample_inputs: Any) -> tuple[Leaves, Leaves]:
            carry, signals = advance_sample(experiment, reducers, tree.unflatten(state), *sample_inputs)
            row = record(carry[0], signals)
            names[:] = row
            return jax.tree.leaves(carry), list(row.values())

        def finish_block(state: Any, _: Any) -> tuple[Leaves, Leaves]:
            return jax.tree.leaves(end_block(experiment, tree.unflatten(state))), []

        def finish(*state: Any) -> TracedArrays:
            return compute_metrics(experiment, reducers, tree.unflatten(state))

        steps = experiment.run.steps
        # a single lane shares everything
        part = SharedPart(step, finish_block, leaves, experiment.sides, steps, block_length(steps))
        run_span = compile_shared_part(part)
        state, columns = _call_once(lambda: jax.tree.leaves(initial_carry(experiment, reducers))), [[] for _ in names]
        for first in range(0, steps, part.span_length):
            state, _, outputs = run_span(state, seed, first, min(part.span_length, steps - first))
            for column, output in zip(columns, outputs, strict=True):
                # copied, so that the samples that are dropped free their memory
                column.append(np.array(output[-first % stride :: stride]))
        metrics = dict(zip(sorted(jax.eval_shape(finish, *leaves)), _call_once(finish, *state), strict=True))
    return metrics, {name: np.concatenate(column) for name, column in zip(names, columns, strict=True)}


def _call_once(function: Callable[..., Any], *numbers: Any) -> Leaves:
    """Call a function of numbers; returns the leaves of its result. A loop compiles faster than XLA."""
    closed = trace_inlined(function, *(jax.ShapeDtypeStruct((), jnp.result_type(number)) for number in numbers))
    try:
        loop = Loop(closed, np.dtype(float), values=len(numbers), lanes=1)
    except Unsupported:
        return [np.asarray(x) for x in jax.tree.leaves(jax.jit(function)(*numbers))]
    return [output[0, 0] for output in loop.run(1, values=[*map(np.array, numbers)])[1]]
