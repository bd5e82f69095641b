"""A block to write code for: a state, a step from sample to sample, and names for all inputs and outputs."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxbl.fused import Leaves
from jaxbl.fused.jaxprs import ClosedJaxpr, trace

from .lowering import (
    Choice,
    Constant,
    Operation,
    Routine,
    Value,
    Variable,
    are_same,
    default_precision,
    drop_unread,
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
        start: study numbers, start inputs -> state, and the outputs before the first step if `start_gives_outputs`.
        step: study numbers, state, inputs -> state, outputs.
        start_gives_outputs: True if `start` gives outputs, too.
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
    start_gives_outputs: bool = False
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
    start: Callable[[Values, Values], Any],
    step: Callable[[Values, Any, Values], tuple[Any, Outputs]],
    outputs: Callable[[Values, Any, Values], Values] | None = None,
) -> Block:
    """Trace the functions of a block.

    Args:
        name, dtype, study_numbers, start_inputs, inputs: as of :class:`Block`.
        start: from the numbers of the study by config path, and what it is given by name, to a pytree of scalars.
        step: the same with the state, to the new state and the outputs: value, unit and description by name.
        outputs: values of the same outputs before the first step, where they are asked for: from what `start` is given, and
            the state that it gives.
    """
    with default_precision(dtype):
        numbers = {path: jax.ShapeDtypeStruct((), dtype) for path in study_numbers}
        start_avals, sample_avals = (
            {quantity.name: jax.ShapeDtypeStruct((), quantity.dtype) for quantity in quantities}
            for quantities in (start_inputs, inputs)
        )
        state = jax.eval_shape(start, numbers, start_avals)
        output_descriptions: dict[str, tuple[str, str]] = {}

        def flat_start(numbers: Leaves, begin: Leaves) -> Leaves:
            study_values, start_values = dict(zip(study_numbers, numbers, strict=True)), _name_values(start_inputs, begin)
            state = start(study_values, start_values)
            return [*jax.tree.leaves(state), *(outputs(study_values, state, start_values).values() if outputs else ())]

        def flat_step(numbers: Leaves, leaves: Leaves, sample: Leaves) -> Leaves:
            tree = jax.tree.structure(state).unflatten(leaves)
            new, out = step(dict(zip(study_numbers, numbers, strict=True)), tree, _name_values(inputs, sample))
            output_descriptions.update({name: (unit, description) for name, (_, unit, description) in out.items()})
            return [*jax.tree.leaves(new), *(value for value, _, _ in out.values())]

        leaves = jax.tree.leaves(state)
        traced_start = trace(flat_start, list(numbers.values()), list(start_avals.values()))
        traced_step = trace(flat_step, list(numbers.values()), leaves, list(sample_avals.values()))
    dtypes = [np.dtype(aval.dtype) for aval in traced_step.out_avals]
    output_quantities = [
        Port(name, *output_descriptions[name], dtype)
        for name, dtype in zip(output_descriptions, dtypes[len(leaves) :], strict=True)
    ]
    leaf_names = [_name_leaf(path) for path, _ in jax.tree_util.tree_flatten_with_path(state)[0]]
    state_quantities = [
        Port(quantity, "", "", dtype) for quantity, dtype in zip(leaf_names, dtypes[: len(leaves)], strict=True)
    ]
    return Block(
        name,
        dtype,
        study_numbers,
        start_inputs,
        state_quantities,
        inputs,
        output_quantities,
        traced_start,
        traced_step,
        outputs is not None,
    )


def _name_values(quantities: Sequence[Port], values: Sequence[Any]) -> Values:
    return {quantity.name: value for quantity, value in zip(quantities, values, strict=True)}


def _name_leaf(path: Sequence[Any]) -> str:
    """Name a leaf of the state by its path: `observer_motor_position`."""
    parts = (getattr(key, "name", None) or getattr(key, "key", None) or getattr(key, "idx", None) for key in path)
    return "_".join(str(0 if part is None else part) for part in parts)


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
    outputs, read_states = step.results[count:], set[int]()
    while True:
        needed = Routine(step.statements, (*(step.results[i] for i in sorted(read_states)), *outputs))
        needed, read = drop_unread(needed)
        states_read_now = {i for i, variable in enumerate(state) if variable in read and i not in constant_states}
        if states_read_now == read_states:
            break
        read_states = states_read_now
    kept_indices = sorted(read_states)
    start_results = *(start_routine.results[i] for i in kept_indices), *start_routine.results[count:]
    return Program(
        block,
        tuple(block.state[i] for i in kept_indices),
        drop_unread(Routine(start_routine.statements, start_results))[0],
        needed,
        tuple(state[i] for i in kept_indices),
    )


def _make_variables(quantities: Sequence[Port]) -> list[Variable]:
    return [Variable(quantity.dtype, -1, quantity.name) for quantity in quantities]


_WHOLE = 1.5 * 2.0**52
"""Doubles of this size have no fraction: once it is added and taken away again, a number is whole."""
_FARTHEST = 2.0**31
"""Steps of a reference beyond which a position is taken for a fault."""


def widen_positions(program: Program) -> Program:
    """Return a program in float whose positions come and go as double, counted from references that move along.

    At any turn it computes with small numbers then, and finds what it finds near zero.
    """
    block, double = program.block, np.dtype(float)
    if block.dtype != np.float32:
        return program
    names = {name for origin in block.references for name in (*origin.inputs, f"{origin.inputs[0]}_estimate")}
    ports = {
        kind: [port._replace(dtype=double) if port.name in names else port for port in getattr(block, kind)]
        for kind in ("start_inputs", "inputs", "outputs")
    }
    origins = [Port(origin.name, "", "", double) for origin in block.references]
    state, zero = (*program.state, *origins), Constant(np.zeros((), double))
    start, _ = _count_from_references(program, program.start, [zero] * len(origins), ())
    step, variables = _count_from_references(program, program.step, _make_variables(origins), program.state_variables)
    return Program(block._replace(**ports), state, start, step, variables)


def _count_from_references(
    program: Program, routine: Routine, origins: Sequence[Any], states: Sequence[Variable]
) -> tuple[Routine, tuple[Variable, ...]]:
    """Return a routine that first moves the references from `origins`, and the variables of all states that it reads."""
    references, double, flag = program.block.references, np.dtype(float), np.dtype(bool)
    outer = {name: Variable(double, -1, name) for origin in references for name in origin.inputs}
    new_states = list(states)

    def add(statements: list[Any], name: str, *operands: Any, out: Variable | None = None, dtype: Any = double) -> Variable:
        out = out or Variable(dtype, -1)
        values = (
            value if isinstance(value, Variable | Constant) else Constant(np.asarray(value, double)) for value in operands
        )
        statements.append(Operation(out, name, tuple(values), ""))
        return out

    before: list[Any] = []
    moves: list[Any] = []
    after: list[Any] = []
    away = add(before, "sub", outer[references[0].inputs[0]], origins[0])
    away = add(before, "div", away, references[0].step)
    size = add(before, "abs", away)
    far, possible = add(before, "ge", size, 1.0, dtype=flag), add(before, "lt", size, _FARTHEST, dtype=flag)
    far = add(before, "and", far, possible, dtype=flag)
    steps = add(moves, "sub", add(moves, "add", away, _WHOLE), _WHOLE)
    outs: dict[Variable, tuple[Any, Any]] = {}
    places: dict[str, Variable] = {}
    for reference, origin in zip(references, origins, strict=True):
        way, place = add(moves, "mul", steps, reference.step), Variable(double, -1)
        outs[place] = add(moves, "add", origin, way), origin
        places |= dict.fromkeys(reference.inputs, place)
        for i, variable in enumerate(states):
            if program.state[i].name in reference.states:
                new_states[i] = _free_name(variable)
                near = add(moves, "sub", add(moves, "convert", new_states[i]), way)
                outs[variable] = add(moves, "convert", near, dtype=variable.dtype), new_states[i]
    yes, no = zip(*outs.values(), strict=True)
    before.append(Choice(far, tuple(outs), (Routine(tuple(moves), yes), Routine((), no)), ""))
    for variable in drop_unread(routine)[1]:
        if variable.name in places:
            name = _free_name(variable).name
            add(before, "convert", add(before, "sub", outer[name], places[name]), out=variable)
    count = len(program.state)
    outputs = list(routine.results[count:])
    for i, port in enumerate(program.block.outputs[: len(outputs)]):
        if (position := port.name.removesuffix("_estimate")) in places and port.name != position:
            outputs[i] = add(after, "add", places[position], add(after, "convert", outputs[i]))
    results = *routine.results[:count], *(places[reference.inputs[0]] for reference in references), *outputs
    full = Routine((*before, *routine.statements, *after), results)
    return drop_unread(full)[0], (*new_states, *(origin for origin in origins if isinstance(origin, Variable)))


def _free_name(variable: Variable) -> Variable:
    """Return a variable that has the name of another one, which becomes a numbered one."""
    named, variable.name = Variable(variable.dtype, -1, variable.name), ""
    return named
