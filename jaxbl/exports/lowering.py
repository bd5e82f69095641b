"""A traced function of scalars as a list of simple operations, from which code in other languages is written.

Calls are opened and elementary functions become the polynomials of :mod:`jaxbl.fused.elementary`, as in the fused loop.
What depends on constants alone is computed here, each operation rounded once in the precision of the code. What is computed
twice, and what nothing reads, is left out. No other change is made that could alter a number.
"""

import operator
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, compress
from typing import Any, NamedTuple, TypeGuard

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.fused import Unsupported
from jaxbl.fused.elementary import FUNCTIONS
from jaxbl.fused.jaxprs import ClosedJaxpr, JaxprEqn, equation_source
from jaxbl.fused.scalar_writer import COMPARISONS, ScalarWriter

_LONGEST_FORMULA = 90
"""Letters of a formula in a comment."""


@dataclass(frozen=True, eq=False)
class Variable:
    """A number that the code computes or takes as an argument; `name` is "" for a numbered one."""

    dtype: np.dtype
    name: str = ""


@dataclass(frozen=True, eq=False)
class Constant:
    """A number that is known when the code is written.

    Attributes:
        value: scalar array.
        formula: how it follows from numbers of the study; "" for a number of the code itself.
        paths: config paths of those numbers.
    """

    value: Any
    formula: str = ""
    paths: tuple[str, ...] = ()

    @property
    def dtype(self) -> np.dtype:
        """Type of the number."""
        return self.value.dtype

    @property
    def key(self) -> tuple[str, bytes, str]:
        """Two constants are the same if this is equal."""
        return str(self.value.dtype), self.value.tobytes(), self.formula

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Constant) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


Value = Variable | Constant


class Operation(NamedTuple):
    """`out = name(*given)`; `source` is the file and function that asked for it."""

    out: Variable
    name: str
    operands: tuple[Value, ...]
    source: str


class Repeat(NamedTuple):
    """A loop: `carried` begin as `start`; the body runs `times` times, each time they become its results, all at once."""

    times: int
    carried: tuple[Variable, ...]
    start: tuple[Value, ...]
    body: "Routine"
    source: str


class Choice(NamedTuple):
    """A choice: `outs` become the results of the first body if the condition is true, else of the second."""

    condition: Value
    outs: tuple[Variable, ...]
    bodies: "tuple[Routine, Routine]"
    source: str


Statement = Operation | Repeat | Choice


class Routine(NamedTuple):
    """Statements in their order, and the values that they compute."""

    statements: tuple[Statement, ...]
    results: tuple[Value, ...]


def lower_to_operations(closed: ClosedJaxpr, arguments: Sequence[Any]) -> Routine:
    """Lower a traced function of scalars to operations.

    Args:
        closed: the function.
        arguments: its arguments: variables, or constants.

    Raises:
        Unsupported: an operation of it is unknown here.
    """
    return _Lowering().lower_body(closed, arguments)


def select_variables(values: Iterable[Value]) -> set[Variable]:
    """Return the variables among some values."""
    return {value for value in values if isinstance(value, Variable)}


def find_constants(routine: Routine) -> list[Constant]:
    """Find the constants of a routine, in the order in which they are first read."""
    return list(dict.fromkeys(value for value in _read_values(routine) if isinstance(value, Constant)))


def _read_values(routine: Routine) -> Iterable[Value]:
    for statement in routine.statements:
        if isinstance(statement, Operation):
            yield from statement.operands
        elif isinstance(statement, Repeat):
            yield from chain(statement.start, _read_values(statement.body))
        else:
            yield from chain([statement.condition], *map(_read_values, statement.bodies))
    yield from routine.results


def count_operations(routine: Routine) -> Counter[str]:
    """Count how often each operation is done, by name; of a choice the longer body counts."""
    counts: Counter[str] = Counter()
    for statement in routine.statements:
        if isinstance(statement, Operation):
            counts[statement.name] += 1
        elif isinstance(statement, Repeat):
            counts.update({name: number * statement.times for name, number in count_operations(statement.body).items()})
        else:
            counts.update(max(map(count_operations, statement.bodies), key=Counter.total))
    return counts


def drop_unread(routine: Routine) -> tuple[Routine, set[Variable]]:
    """Drop the statements that no result reads, and find the variables that the others read and do not compute."""
    needed, needed_statements = select_variables(routine.results), []
    for statement in reversed(routine.statements):
        if isinstance(statement, Operation):
            if statement.out not in needed:
                continue
            needed = needed - {statement.out} | select_variables(statement.operands)
            needed_statements.append(statement)
        elif isinstance(statement, Repeat):
            carried = statement.carried
            body, inside, alive = drop_unread_turns(statement.body, carried, [variable in needed for variable in carried])
            if any(alive):
                carried, start = tuple(compress(carried, alive)), tuple(compress(statement.start, alive))
                needed = (needed | inside) - set(carried) | select_variables(start)
                needed_statements.append(statement._replace(carried=carried, start=start, body=body))
        else:
            alive = [variable in needed for variable in statement.outs]
            if any(alive):
                outs = tuple(compress(statement.outs, alive))
                bodies, inside = zip(*(drop_unread(_select_results(body, alive)) for body in statement.bodies), strict=True)
                needed = needed.difference(outs).union(*inside, select_variables([statement.condition]))
                needed_statements.append(statement._replace(outs=outs, bodies=bodies))
    return Routine(tuple(reversed(needed_statements)), routine.results), needed


def drop_unread_turns(
    body: Routine, carried: Sequence[Variable | None], alive: Sequence[bool]
) -> tuple[Routine, set[Variable], Sequence[bool]]:
    """Drop what nothing reads in any turn of a routine that is repeated.

    Args:
        body: the routine.
        carried: for each of its results, the variable that it becomes in the next turn, or None.
        alive: for each of them True if it is read after the last turn.

    Returns:
        The routine, the variables that it reads and does not compute, and which of the results are kept.
    """
    while True:
        needed, inside = drop_unread(_select_results(body, alive))
        before, alive = alive, [is_alive or carry in inside for is_alive, carry in zip(alive, carried, strict=True)]
        if before == alive:
            return needed, inside, alive


def are_same(first: Value, second: Value) -> bool:
    """Return True if two values are the same variable or the same number."""
    if isinstance(first, Constant) and isinstance(second, Constant):
        return first.key[:2] == second.key[:2]
    return first is second


def _select_results(routine: Routine, marks: Sequence[bool]) -> Routine:
    return routine._replace(results=tuple(compress(routine.results, marks)))


class _Lowering(ScalarWriter):
    """Writes statements as it goes through equations."""

    number_types = ("float32", "float64", "int32", "uint32", "int64", "uint64", "bool")
    arrays = "arrays: what runs in real time should be made of scalars"

    def __init__(self) -> None:
        self.statements: list[Statement] = []
        self._variable_by_operation: dict[Any, Variable] = {}
        """The variable that holds the result of an operation, by the operation's name, type and operands."""
        self._operation_by_variable: dict[Value, Operation] = {}
        self._source = ""
        self._is_in_call = False
        """Within a call the source stays that of the call."""

    # jaxprs

    def write_equation(self, eqn: JaxprEqn, operands: list[Value]) -> list[Value]:
        if not self._is_in_call:
            self._source = equation_source(eqn)
        results = super().write_equation(eqn, operands)
        if not _are_constant(operands):
            return results
        return [_add_formula(result, eqn.primitive.name, operands) for result in results]

    def write_call(self, called, operands):
        was_in_call, self._is_in_call = self._is_in_call, True
        results = super().write_call(called, operands)
        self._is_in_call = was_in_call
        return results

    def write_unknown(self, eqn, operands, kind):
        """Compute an equation of constants by JAX."""
        if not _are_constant(operands):
            return super().write_unknown(eqn, operands, kind)
        results = eqn.primitive.bind(*(jnp.asarray(constant.value) for constant in operands), **eqn.params)  # type: ignore[union-attr]
        return [Constant(np.asarray(constant)) for constant in (results if eqn.primitive.multiple_results else [results])]

    def write_scan(self, times, body, constants, state):
        if times == 1 or _are_constant([*constants, *state]):
            for _ in range(times):
                state = self.write_jaxpr(body, [*constants, *state])
            return state
        source = self._source
        carried = tuple(Variable(value.dtype) for value in state)
        self.statements.append(Repeat(times, carried, tuple(state), self.lower_body(body, [*constants, *carried]), source))
        return list(carried)

    def write_cond(self, branches, index, operands):
        if isinstance(index, Constant):
            return self.write_jaxpr(branches[int(np.clip(index.value, 0, len(branches) - 1))], operands)
        if len(branches) != 2:
            raise Unsupported("cond among more than two")
        condition, source = self._convert_to_bool(index), self._source
        no, yes = (self.lower_body(branch, operands) for branch in branches)
        # what is the same on both ways is no choice
        differ = [not are_same(a, b) for a, b in zip(yes.results, no.results, strict=True)]
        merged: list[Any] = [Variable(a.dtype) if differs else a for a, differs in zip(yes.results, differ, strict=True)]
        bodies = _select_results(yes, differ), _select_results(no, differ)
        self.statements.append(Choice(condition, tuple(compress(merged, differ)), bodies, source))
        return merged

    def lower_body(self, body: ClosedJaxpr, arguments: Sequence[Value]) -> Routine:
        """Lower a body apart: variables that it defines cannot be used after it."""
        outer_statements, outer_variables = self.statements, self._variable_by_operation
        self.statements, self._variable_by_operation = [], dict(outer_variables)
        results = self.write_jaxpr(body, arguments)
        statements, self.statements, self._variable_by_operation = self.statements, outer_statements, outer_variables
        return Routine(tuple(statements), tuple(results))

    # operations

    def literal(self, number: Any, dtype: Any) -> Constant:
        return Constant(np.asarray(number, dtype))

    def emit(self, name: str, dtype: Any, *operands: Value) -> Value:
        """Write an operation and return its result: a new variable, or a value that is known to be the same."""
        dtype = np.dtype(bool if name in COMPARISONS else dtype)
        if _are_constant(operands):
            with np.errstate(all="ignore"):
                numbers = [constant.value[()] for constant in operands]
                typed = _TYPED_EVALUATIONS.get(name)
                value = np.asarray(typed(dtype, *numbers) if typed else _EVALUATIONS[name](*numbers), dtype)
            return Constant(value, paths=_find_paths(operands))
        if (simpler := self._simplify(name, dtype, operands)) is not None:
            return simpler
        key = (name, dtype, *operands)
        if key not in self._variable_by_operation:
            out = self._variable_by_operation[key] = Variable(dtype)
            self._operation_by_variable[out] = Operation(out, name, operands, self._source)
            self.statements.append(self._operation_by_variable[out])
        return self._variable_by_operation[key]

    def _simplify(self, name: str, dtype: np.dtype, operands: Sequence[Value]) -> Value | None:
        """Return the result of an operation by a simpler one if there is one with the same bits, else None."""
        a, b = operands[0], operands[-1]
        if name == "mul":
            for factor, other in ((a, b), (b, a)):
                if _is_number(factor, 1):
                    return other
                if _is_number(factor, -1) and dtype.kind == "f":
                    return self.emit("neg", dtype, other)
        if name == "div" and dtype.kind == "f" and isinstance(b, Constant):
            mantissa, exponent = np.frexp(b.value)
            if abs(mantissa) == 0.5 and abs(exponent) < 100:
                # the reciprocal is exact
                pair = self.literal(1, dtype), b
                return self.emit("mul", dtype, a, _add_formula(self.emit("div", dtype, *pair), "div", pair))
        if name == "sub" and isinstance(b, Constant) and b.value == 0 and not np.signbit(b.value):
            return a
        if name == "select":
            condition, yes, no = operands
            if isinstance(condition, Constant):
                return yes if condition.value else no
            if yes == no:
                return yes
        if name == "convert" and a.dtype == dtype:
            return a
        if name == "ne" and _is_number(b, 0):
            # a truth value that became a number
            inner = self._operation_by_variable.get(a)
            if inner is not None and inner.name == "convert" and inner.operands[0].dtype == bool:
                return inner.operands[0]
        return None

    def convert(self, number, old, new):
        if new.kind == "b" and old.kind != "b":
            return self._convert_to_bool(number)
        return self.emit("convert", new, number)

    def _convert_to_bool(self, number: Value) -> Value:
        return self.emit("ne", number.dtype, number, self.literal(0, number.dtype))

    def bitcast(self, number, new):
        """The bits of a number as another one; of an exponent that is put together from an integer, a power of two."""
        bias, bits = (1023, 52) if new == np.float64 else (127, 23)
        shift = self._operation_by_variable.get(number) if new.kind == "f" else None
        if shift is not None and shift.name == "shift_left" and _is_number(shift.operands[1], bits):
            sum_ = self._operation_by_variable.get(shift.operands[0])
            if sum_ is not None and sum_.name == "add" and _is_number(sum_.operands[1], bias):
                exponent = sum_.operands[0]
                before = self._operation_by_variable.get(exponent)
                if before is not None and before.name == "convert":
                    exponent = before.operands[0]
                return self.emit("power_of_two", new, self.emit("convert", np.int32, exponent))
        return self.emit("bitcast", new, number)


# constants


def _find_paths(values: Iterable[Value]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(path for constant in values if isinstance(constant, Constant) for path in constant.paths))


_INFIX = {"add": "+", "add_any": "+", "sub": "-", "mul": "*", "div": "/"}


def _add_formula(result: Value, name: str, operands: Sequence[Constant]) -> Value:
    """Give a constant the formula of the equation that it is the result of."""
    if not isinstance(result, Constant) or result.formula or not (paths := _find_paths(operands)) or result.value.ndim:
        return result
    texts = [operand.formula or f"{operand.value.item():.6g}" for operand in operands]
    if name in _INFIX:
        formula = f"({f' {_INFIX[name]} '.join(texts)})"
    else:
        formula = f"-{texts[0]}" if name == "neg" else f"{name}({', '.join(texts)})"
    if len(formula) > _LONGEST_FORMULA or name not in _READABLE_EQUATIONS:
        formula = f"from {', '.join(paths)}"
    return replace(result, formula=formula, paths=paths)


_READABLE_EQUATIONS = {*_INFIX, "neg", "abs", "sqrt", "square", "integer_pow", "min", "max", *FUNCTIONS}
"""Equations with a formula that a reader understands."""


_EVALUATIONS: dict[str, Callable[..., Any]] = {
    **{name: getattr(operator, name) for name in ("add", "sub", "mul", "neg", "lt", "le", "gt", "ge", "eq", "ne", "xor")},
    **{name: getattr(np, name) for name in ("abs", "sqrt", "floor", "ceil")},
    "div": lambda a, b: a / b if a.dtype.kind == "f" else np.trunc(a / b),
    "rem": np.fmod,
    "round_even": np.rint,
    "round_away": lambda a: np.copysign(np.floor(np.abs(a)) + (np.abs(a) - np.floor(np.abs(a)) >= 0.5), a),
    "max": np.maximum,
    "min": np.minimum,
    "and": operator.and_,
    "or": operator.or_,
    "not": operator.invert,
    "shift_left": operator.lshift,
    "select": lambda condition, yes, no: yes if condition else no,
}
"""How an operation is computed for constants, by the name of the :class:`Operation`."""
_TYPED_EVALUATIONS: dict[str, Callable[..., Any]] = {
    "shift_right_logical": lambda dtype, a, b: a.view(f"u{dtype.itemsize}") >> b.view(f"u{dtype.itemsize}"),
    "convert": lambda dtype, a: np.trunc(a) if dtype.kind in "iu" and a.dtype.kind == "f" else a,
    "bitcast": lambda dtype, a: np.asarray(a).view(dtype),
    "power_of_two": lambda dtype, n: np.ldexp(dtype.type(1), int(n)),
}
"""The same for operations that depend on the type of their result, which comes first."""


def _are_constant(values: Sequence[Value]) -> TypeGuard[Sequence[Constant]]:
    return all(isinstance(value, Constant) for value in values)


def _is_number(value: Value, number: int) -> bool:
    return isinstance(value, Constant) and value.value == number


def name_constants(constants: Iterable[Constant], study_numbers: Mapping[str, Any]) -> dict[Constant, str]:
    """Name the constants that come from numbers of the study: a number by its config path, what follows from several
    numbers `DERIVED_1` and so on."""
    names: dict[Constant, str] = {}
    for constant in constants:
        if constant.formula in study_numbers:
            names[constant] = constant.formula.replace(".", "_").upper()
        elif constant.formula:
            names[constant] = f"DERIVED_{1 + sum(name.startswith('DERIVED_') for name in names.values())}"
    return names


def default_precision(dtype: np.dtype) -> Any:
    """Return a context in which a floating-point type is JAX's default."""
    return jax.enable_x64(dtype == np.float64)
