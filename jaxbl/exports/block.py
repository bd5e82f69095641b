"""What code is written for: a state, a step from sample to sample, and names for all that goes in and out."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxbl.fused.jaxprs import ClosedJaxpr, trace

from .lowering import Constant, Routine, Value, Variable, alike, lowered, read_by, with_x64, without_unread


class Quantity(NamedTuple):
    """A number that goes in or out: name in the code, unit, description, type."""

    name: str
    unit: str
    about: str
    dtype: np.dtype


class Known(NamedTuple):
    """A number of the study: its value, unit and description."""

    value: float
    unit: str
    about: str


class Block(NamedTuple):
    """Two traced functions of scalars, in one precision.

    Attributes:
        name: of the block, a C identifier.
        dtype: of its real numbers.
        known: numbers of the study by config path; the first arguments of both functions, in this order.
        first: what `start` is given besides.
        state: what is carried from sample to sample.
        inputs, outputs: of each sample.
        start: known numbers, first -> state; outputs before the first step, too, where it is asked for these.
        step: known numbers, state, inputs -> state, outputs.
        starts_with_outputs: whether it is.
    """

    name: str
    dtype: np.dtype
    known: Mapping[str, Known]
    first: Sequence[Quantity]
    state: Sequence[Quantity]
    inputs: Sequence[Quantity]
    outputs: Sequence[Quantity]
    start: ClosedJaxpr
    step: ClosedJaxpr
    starts_with_outputs: bool = False


class Program(NamedTuple):
    """A block as operations, without states that nothing reads or that never change.

    `start` and `step` give the new state, then the outputs (of `start`: where it has any). Variables have the names of their
    quantities.
    """

    block: Block
    state: tuple[Quantity, ...]
    start: Routine
    step: Routine
    state_variables: tuple[Variable, ...]
    """What `step` reads for each state."""


def traced_block(
    name: str,
    dtype: np.dtype,
    known: Mapping[str, Known],
    first: Sequence[Quantity],
    inputs: Sequence[Quantity],
    start: Callable[[dict[str, Any], dict[str, Any]], Any],
    step: Callable[[dict[str, Any], Any, dict[str, Any]], tuple[Any, dict[str, tuple[Any, str, str]]]],
    outputs: Callable[[dict[str, Any], Any, dict[str, Any]], dict[str, Any]] | None = None,
) -> Block:
    """Trace the functions of a block.

    Args:
        name, dtype, known, first, inputs: as of :class:`Block`.
        start: from the numbers of the study by config path, and what it is given by name, to a pytree of scalars.
        step: the same with the state, to the new state and the outputs: value, unit and description by name.
        outputs: values of the same outputs before the first step, where they are asked for: from what `start` is given, and
            the state that it gives.
    """
    with with_x64(dtype):
        numbers = {path: jax.ShapeDtypeStruct((), dtype) for path in known}
        given = {one.name: jax.ShapeDtypeStruct((), one.dtype) for one in (*first, *inputs)}
        begin = {one.name: given[one.name] for one in first}
        sample = {one.name: given[one.name] for one in inputs}
        state = jax.eval_shape(start, numbers, begin)
        said: dict[str, tuple[str, str]] = {}

        def flat_start(numbers: list[Any], begin: list[Any]) -> list[Any]:
            own, given = dict(zip(known, numbers, strict=True)), _named(first, begin)
            found = start(own, given)
            return [*jax.tree.leaves(found), *(outputs(own, found, given).values() if outputs else ())]

        def flat_step(numbers: list[Any], leaves: list[Any], sample: list[Any]) -> list[Any]:
            tree = jax.tree.structure(state).unflatten(leaves)
            new, out = step(dict(zip(known, numbers, strict=True)), tree, _named(inputs, sample))
            said.update({name: (unit, about) for name, (_, unit, about) in out.items()})
            return [*jax.tree.leaves(new), *(value for value, _, _ in out.values())]

        leaves = jax.tree.leaves(state)
        started = trace(flat_start, list(numbers.values()), list(begin.values()))
        stepped = trace(flat_step, list(numbers.values()), leaves, list(sample.values()))
    dtypes = [np.dtype(aval.dtype) for aval in stepped.out_avals]
    found = [Quantity(name, *said[name], dtype) for name, dtype in zip(said, dtypes[len(leaves) :], strict=True)]
    names = [_identifier(path) for path, _ in jax.tree_util.tree_flatten_with_path(state)[0]]
    carried = [Quantity(one, "", "", dtype) for one, dtype in zip(names, dtypes[: len(leaves)], strict=True)]
    return Block(name, dtype, known, first, carried, inputs, found, started, stepped, outputs is not None)


def _named(quantities: Sequence[Quantity], values: Sequence[Any]) -> dict[str, Any]:
    return {one.name: value for one, value in zip(quantities, values, strict=True)}


def _identifier(path: Sequence[Any]) -> str:
    """Of a leaf: `observer_motor_position`."""
    parts = (getattr(one, "name", None) or getattr(one, "key", None) or getattr(one, "idx", None) for one in path)
    return "_".join(str(0 if part is None else part) for part in parts)


def program_of(block: Block) -> Program:
    """The operations of a block. Raises `Unsupported` where one is unknown."""
    known: list[Value] = [Constant(np.asarray(one.value, block.dtype), path, (path,)) for path, one in block.known.items()]
    with with_x64(block.dtype):
        start = lowered(block.start, [*known, *_variables(block.first)])
        # a state that begins as a constant, and is that again after each step, is none, if all such are taken together
        begin = start.results[: len(block.state)]
        fixed = {i: one for i, one in enumerate(begin) if isinstance(one, Constant)}
        while True:
            state = _variables(block.state)
            given = [fixed.get(i, variable) for i, variable in enumerate(state)]
            step = lowered(block.step, [*known, *given, *_variables(block.inputs)])
            still = {i: one for i, one in fixed.items() if alike(step.results[i], one)}
            if len(still) == len(fixed):
                break
            fixed = still
    count = len(state)
    outputs, kept = step.results[count:], set[int]()
    while True:
        wanted = Routine(step.statements, (*(step.results[i] for i in sorted(kept)), *outputs))
        read = read_by(wanted)
        found = {i for i, variable in enumerate(state) if variable in read and i not in fixed}
        if found == kept:
            break
        kept = found
    places = sorted(kept)
    return Program(
        block,
        tuple(block.state[i] for i in places),
        without_unread(Routine(start.statements, (*(start.results[i] for i in places), *start.results[count:]))),
        without_unread(wanted),
        tuple(state[i] for i in places),
    )


def _variables(quantities: Sequence[Quantity]) -> list[Variable]:
    return [Variable(one.dtype, -1, one.name) for one in quantities]
