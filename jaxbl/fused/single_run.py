"""One run with a record of its samples, by loops for this machine's processor.

The same as :func:`jaxbl.simulate.scan` computes with a record: XLA starts some kernels for each sample of a single lane, and
takes longer to compile them than a study of that size takes to run.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.simulate import (
    Experiment,
    Reducer,
    Signals,
    State,
    advance_sample,
    block_length,
    compute_metrics,
    end_block,
    initial_carry,
)

from . import Unsupported
from .jaxprs import trace_inlined
from .llvm import Loop
from .noise import host_device
from .shared_part import SharedPart, compile_shared_part


def record_run(
    experiment: Experiment,
    seed: int,
    reducers: tuple[Reducer, ...],
    record: Callable[[State, Signals], dict[str, Any]],
    every: int = 1,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Simulate one experiment, in its precision: the reducers' figures `()` and the record `(samples,)`, both by name.
    Arguments as of :func:`jaxbl.simulate.scan`."""
    with jax.default_device(host_device()):
        start = jax.eval_shape(lambda: initial_carry(experiment, reducers))
        tree, leaves = jax.tree.structure(start), jax.tree.leaves(start)
        names: list[str] = []

        def sample(state: Any, given: Any) -> tuple[list[Any], list[Any]]:
            carry, signals = advance_sample(experiment, reducers, tree.unflatten(state), *given)
            row = record(carry[0], signals)
            names[:] = row
            return jax.tree.leaves(carry), list(row.values())

        def settle(state: Any, _: Any) -> tuple[list[Any], list[Any]]:
            return jax.tree.leaves(end_block(experiment, tree.unflatten(state))), []

        def result(*state: Any) -> dict[str, Any]:
            return compute_metrics(experiment, reducers, tree.unflatten(state))

        steps = experiment.run.steps
        shared = SharedPart(sample, settle, leaves, experiment.sides, steps, block_length(steps))
        ahead = compile_shared_part(shared)
        state, columns = _once(lambda: jax.tree.leaves(initial_carry(experiment, reducers))), [[] for _ in names]
        for first in range(0, steps, shared.stretch):
            state, _, handed = ahead(state, seed, first, min(shared.stretch, steps - first))
            for column, part in zip(columns, handed, strict=True):
                # copied: what is kept of a stretch does not keep the rest of it
                column.append(np.array(part[-first % every :: every]))
        found = dict(zip(sorted(jax.eval_shape(result, *leaves)), _once(result, *state), strict=True))
    return found, {name: np.concatenate(column) for name, column in zip(names, columns, strict=True)}


def _once(function: Callable[..., Any], *numbers: Any) -> list[Any]:
    """Leaves of a function of numbers."""
    closed = trace_inlined(function, *(jax.ShapeDtypeStruct((), jnp.result_type(number)) for number in numbers))
    try:
        loop = Loop(closed, np.dtype(float), values=len(numbers), lanes=1)
    except Unsupported:
        return [np.asarray(x) for x in jax.tree.leaves(jax.jit(function)(*numbers))]
    kept = [np.empty(1, aval.dtype) for aval in closed.out_avals]
    loop([*(np.array([number]) for number in numbers), *kept], 1, 0, 1)
    return [column[0] for column in kept]
