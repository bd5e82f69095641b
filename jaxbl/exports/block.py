"""A block to write code for: a state, a step from sample to sample, and names for all inputs and outputs."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from itertools import compress
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

        traced_start = trace(start_in_order, [*numbers.values()], [*begin.values()])
        traced_step = trace(step_in_order, [*numbers.values()], state, [*sample.values()])
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
    outer = {name: Variable(double, name) for origin in references for name in origin.inputs}
    new_states = list(states)

    def add(statements: list[Any], name: str, *operands: Any, out: Variable | None = None, dtype: Any = double) -> Variable:
        out = out or Variable(dtype)
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
        way, place = add(moves, "mul", steps, reference.step), Variable(double)
        outs[place] = add(moves, "add", origin, way), origin
        places |= dict.fromkeys(reference.inputs, place)
        for i, variable in enumerate(states):
            if program.state[i].name in reference.states:
                # the variable becomes a numbered one
                new_states[i], variable.name = Variable(variable.dtype, variable.name), ""
                near = add(moves, "sub", add(moves, "convert", new_states[i]), way)
                outs[variable] = add(moves, "convert", near, dtype=variable.dtype), new_states[i]
    yes, no = zip(*outs.values(), strict=True)
    before.append(Choice(far, tuple(outs), (Routine(tuple(moves), yes), Routine((), no)), ""))
    variables = {variable.name: variable for variable in drop_unread(routine)[1]}
    # in the order of the block: that of a set is another one in each process
    for name, place in places.items():
        if variable := variables.get(name):
            variable.name = ""
            add(before, "convert", add(before, "sub", outer[name], place), out=variable)
    count = len(program.state)
    outputs = list(routine.results[count:])
    for i, port in enumerate(program.block.outputs[: len(outputs)]):
        if (position := port.name.removesuffix("_estimate")) in places and port.name != position:
            outputs[i] = add(after, "add", places[position], add(after, "convert", outputs[i]))
    results = *routine.results[:count], *(places[reference.inputs[0]] for reference in references), *outputs
    full = Routine((*before, *routine.statements, *after), results)
    return drop_unread(full)[0], (*new_states, *(origin for origin in origins if isinstance(origin, Variable)))
