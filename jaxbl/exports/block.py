"""A block to write code for: a state, a step from sample to sample, and names for all inputs and outputs."""

import operator
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from itertools import compress
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.fused import Leaves
from jaxbl.fused.jaxprs import ClosedJaxpr, jaxpr_as_fun

from .lowering import (
    Constant,
    Routine,
    Value,
    Variable,
    are_same,
    default_precision,
    drop_unread,
    drop_unread_turns,
    lower_to_operations,
)


class Port(NamedTuple):
    """A number that goes in or out: name in the code, unit, description, type."""

    name: str
    unit: str
    description: str
    dtype: np.dtype


def describe_number(number: "Port | StudyNumber") -> str:
    """Describe a number with its unit."""
    return f"{number.description}{f', {number.unit}' if number.unit else ''}"


class StudyNumber(NamedTuple):
    """A number of the study: its value, unit and description."""

    value: float
    unit: str
    description: str


class Reference(NamedTuple):
    """A reference that a position is counted from, where numbers are too short for many turns.

    Attributes:
        inputs: names of the inputs that are counted from it; the first one's estimate is the output `{input}_estimate`.
        name: of the reference.
        states: names of the states that are this position, too.
        step: rad; references of all positions move together, each by as many of its steps.
    """

    inputs: Sequence[str]
    name: str
    states: Collection[str]
    step: float


class Block(NamedTuple):
    """Two traced functions of scalars, in one precision.

    Attributes:
        name: of the block, a C identifier.
        dtype: of its real numbers.
        study_numbers: numbers of the study by config path; the first arguments of both functions, in this order.
        start_inputs: further arguments of `start`.
        state: numbers that are carried from sample to sample.
        inputs, outputs: of each sample.
        start: study numbers, start inputs -> state, and the outputs before the first step if they are asked for.
        step: study numbers, state, inputs -> state, outputs.
        references: of positions that may all move by a step, without a change of what else there is.
    """

    name: str
    dtype: np.dtype
    study_numbers: Mapping[str, StudyNumber]
    start_inputs: Sequence[Port]
    state: Sequence[Port]
    inputs: Sequence[Port]
    outputs: Sequence[Port]
    start: ClosedJaxpr
    step: ClosedJaxpr
    references: Sequence[Reference] = ()


Values = dict[str, Any]
"""Traced numbers by their name or config path."""
Outputs = dict[str, tuple[Any, str, str]]
"""Value, unit and description of each output, by its name."""


class Program(NamedTuple):
    """A block as operations, without states that nothing reads or that never change.

    `start` and `step` give the new state, then the outputs (of `start`: where it has any). Variables have the names of their
    quantities.
    """

    block: Block
    state: tuple[Port, ...]
    start: Routine
    step: Routine
    state_variables: tuple[Variable, ...]
    """What `step` reads for each state."""


def trace_block(
    name: str,
    dtype: np.dtype,
    study_numbers: Mapping[str, StudyNumber],
    start_inputs: Sequence[Port],
    inputs: Sequence[Port],
    start: Callable[[Values, Values], tuple[Any, Outputs]],
    step: Callable[[Values, Any, Values], tuple[Any, Outputs]],
) -> Block:
    """Trace the functions of a block.

    Args:
        name, dtype, study_numbers, start_inputs, inputs: as of :class:`Block`.
        start: from the numbers of the study by config path, and what it is given by name, to the state, a pytree of
            scalars, and the outputs before the first step, if they are asked for.
        step: the same with the state, to the new state and the outputs: value, unit and description by name.
    """
    with default_precision(dtype):
        numbers = dict.fromkeys(study_numbers, jax.ShapeDtypeStruct((), dtype))
        begin, sample = (
            {port.name: jax.ShapeDtypeStruct((), port.dtype) for port in ports} for ports in (start_inputs, inputs)
        )
        state = jax.eval_shape(lambda *arguments: start(*arguments)[0], numbers, begin)
        descriptions: dict[str, tuple[str, str]] = {}

        def start_in_order(study_values: Leaves, start_values: Leaves) -> Any:
            state, out = start(_name_values(numbers, study_values), _name_values(begin, start_values))
            return state, [value for value, _, _ in out.values()]

        def step_in_order(study_values: Leaves, state: Any, sample_values: Leaves) -> Any:
            new, out = step(_name_values(numbers, study_values), state, _name_values(sample, sample_values))
            descriptions.update({name: (unit, description) for name, (_, unit, description) in out.items()})
            return new, [value for value, _, _ in out.values()]

        traced_start = jax.make_jaxpr(start_in_order)([*numbers.values()], [*begin.values()])
        traced_step = jax.make_jaxpr(step_in_order)([*numbers.values()], state, [*sample.values()])
    dtypes = (np.dtype(aval.dtype) for aval in traced_step.out_avals)
    state_ports = [
        Port(jax.tree_util.keystr(path, simple=True, separator="_"), "", "", next(dtypes))
        for path, _ in jax.tree.leaves_with_path(state)
    ]
    outputs = [
        Port(output, *description, dtype) for (output, description), dtype in zip(descriptions.items(), dtypes, strict=True)
    ]
    return Block(name, dtype, study_numbers, start_inputs, state_ports, inputs, outputs, traced_start, traced_step)


def _name_values(names: Iterable[str], values: Sequence[Any]) -> Values:
    return dict(zip(names, values, strict=True))


def lower_block(block: Block) -> Program:
    """Lower both functions of a block to operations. Raises `Unsupported` where an operation is unknown."""
    study_constants: list[Value] = [
        Constant(np.asarray(number.value, block.dtype), path, (path,)) for path, number in block.study_numbers.items()
    ]
    with default_precision(block.dtype):
        start_routine = lower_to_operations(block.start, [*study_constants, *_make_variables(block.start_inputs)])
        # A state that begins as a constant and keeps its value in each step is that constant. Whether it does may depend on
        # other states of the kind: assume all of them, and drop those that change until none does.
        start_values = start_routine.results[: len(block.state)]
        constant_states = {i: start for i, start in enumerate(start_values) if isinstance(start, Constant)}
        while True:
            state = _make_variables(block.state)
            state_values = [constant_states.get(i, variable) for i, variable in enumerate(state)]
            step = lower_to_operations(block.step, [*study_constants, *state_values, *_make_variables(block.inputs)])
            unchanged_states = {
                i: constant for i, constant in constant_states.items() if are_same(step.results[i], constant)
            }
            if len(unchanged_states) == len(constant_states):
                break
            constant_states = unchanged_states
    count = len(state)
    outputs = step.results[count:]
    needed, _, alive = drop_unread_turns(step, [*state, *[None] * len(outputs)], [False] * count + [True] * len(outputs))
    start_results = *compress(start_routine.results[:count], alive), *start_routine.results[count:]
    return Program(
        block,
        tuple(compress(block.state, alive)),
        drop_unread(Routine(start_routine.statements, start_results))[0],
        needed,
        tuple(compress(state, alive)),
    )


def _make_variables(quantities: Sequence[Port]) -> list[Variable]:
    return [Variable(quantity.dtype, quantity.name) for quantity in quantities]


_WHOLE = 1.5 * 2.0**52
"""Doubles of this size have no fraction: once it is added and taken away again, a number is whole."""
_FARTHEST = 2.0**31
"""Steps of a reference beyond which a position is taken for a fault."""


def widen_positions(block: Block) -> Block:
    """Return a block in float whose positions come and go as double, counted from references that move along.

    At any turn it computes with small numbers then, and finds what it finds near zero.
    """
    if block.dtype != np.float32:
        return block
    double, references = np.dtype(float), block.references
    # the place of its reference for each position that is given, carried, or found
    places = {
        name: i
        for i, reference in enumerate(references)
        for name in (*reference.inputs, *reference.states, f"{reference.inputs[0]}_estimate")
    }

    def widen(ports: Sequence[Port]) -> list[Port]:
        return [port._replace(dtype=double) if port.name in places else port for port in ports]

    def shift(change: Callable[..., Any], ports: Sequence[Port], numbers: Leaves, ways: Leaves, dtype: Any) -> Leaves:
        """Change the positions among numbers by the ways of their references."""
        return [
            change(number.astype(double), ways[places[port.name]]).astype(dtype) if port.name in places else number
            for port, number in zip(ports, numbers, strict=True)
        ]

    def widen_routine(routine: ClosedJaxpr, ports: Sequence[Port], state_ports: Sequence[Port]) -> ClosedJaxpr:
        """A routine that first moves the references, or puts them where the positions are if it has no state."""
        leader = [port.name for port in ports].index(references[0].inputs[0])

        def count_from_references(numbers: Leaves, state: Leaves, origins: Leaves, inputs: Leaves) -> Leaves:
            origins = origins or [jnp.zeros((), double)] * len(references)
            steps = (inputs[leader] - origins[0]) / references[0].step

            def follow(state: Leaves, origins: Leaves) -> tuple[Leaves, Leaves]:
                whole_steps = (steps + _WHOLE) - _WHOLE
                ways = [whole_steps * reference.step for reference in references]
                moved = [origin + way for origin, way in zip(origins, ways, strict=True)]
                return shift(operator.sub, state_ports, state, ways, block.dtype), moved

            is_far = (jnp.abs(steps) >= 1.0) & (jnp.abs(steps) < _FARTHEST)
            state, origins = jax.lax.cond(is_far, follow, lambda *unmoved: unmoved, state, origins)
            near = shift(operator.sub, ports, inputs, origins, block.dtype)
            results = jaxpr_as_fun(routine)(*numbers, *state, *near)
            new, outputs = results[: len(block.state)], results[len(block.state) :]
            outer = shift(operator.add, block.outputs[: len(outputs)], outputs, origins, double)
            return [*new, *origins, *outer]

        numbers = [jax.ShapeDtypeStruct((), block.dtype)] * len(block.study_numbers)
        groups = state_ports, origin_ports if state_ports else (), widen(ports)
        examples = ([jax.ShapeDtypeStruct((), port.dtype) for port in group] for group in groups)
        with default_precision(double):
            return jax.make_jaxpr(count_from_references)(numbers, *examples)

    origin_ports = [Port(reference.name, "", "", double) for reference in references]
    start = widen_routine(block.start, block.start_inputs, ())
    step = widen_routine(block.step, block.inputs, block.state)
    ports = {group: widen(getattr(block, group)) for group in ("start_inputs", "inputs", "outputs")}
    return block._replace(**ports, state=[*block.state, *origin_ports], start=start, step=step)
