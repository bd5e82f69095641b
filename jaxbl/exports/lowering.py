"""A traced function of scalars as a list of simple operations, from which code in other languages is written.

Calls are opened and elementary functions become the polynomials of :mod:`jaxbl.fused.elementary`, as in the fused loop.
What depends on constants alone is computed here, each operation rounded once in the precision of the code. What is computed
twice, and what nothing reads, is left out. No other change is made that could alter a number.
"""

import operator
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import chain, count
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.fused import Unsupported
from jaxbl.fused.elementary import FUNCTIONS
from jaxbl.fused.jaxprs import (
    ClosedJaxpr,
    JaxprEqn,
    Literal,
    Var,
    callee,
    cond_branches,
    equation_parameter,
    equation_source,
    scan_parameters,
    trace_scalar_function,
)

TYPES = ("float32", "float64", "int32", "uint32", "int64", "uint64", "bool")
"""Types of numbers that the code may have."""
_LONGEST_FORMULA = 90
"""Letters of a formula in a comment."""


class Variable:
    """A number that the code computes or takes as an argument; `name` is "" for a numbered one."""

    def __init__(self, dtype: np.dtype, number: int, name: str = ""):
        self.dtype, self.number, self.name = dtype, number, name

    def __repr__(self) -> str:
        return self.name or f"v{self.number}"


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
    """A loop: `carried` begin as `start`; the body runs `times` times, and each time they become `results`, all at once."""

    times: int
    carried: tuple[Variable, ...]
    start: tuple[Value, ...]
    body: "tuple[Statement, ...]"
    results: tuple[Value, ...]
    source: str


class Choice(NamedTuple):
    """A choice: `outs` become the results of the first body if the condition is true, else of the second."""

    condition: Value
    outs: tuple[Variable, ...]
    bodies: "tuple[tuple[Statement, ...], tuple[Statement, ...]]"
    results: tuple[tuple[Value, ...], tuple[Value, ...]]
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
    lowering = _Lowering()
    results = lowering.lower_jaxpr(closed, arguments)
    return Routine(tuple(lowering.statements), tuple(results))


def drop_unread(routine: Routine) -> Routine:
    """Drop the statements that no result reads."""
    statements, _ = _find_needed(routine.statements, routine.results)
    return Routine(statements, routine.results)


def select_variables(values: Iterable[Value]) -> set[Variable]:
    """Return the variables among some values."""
    return {value for value in values if isinstance(value, Variable)}


def find_read_variables(routine: Routine) -> set[Variable]:
    """Find the variables that a routine reads and does not compute."""
    return _find_needed(routine.statements, routine.results)[1]


def find_constants(routine: Routine) -> list[Constant]:
    """Find the constants of a routine, in the order in which they are first read."""
    values = chain(_read_values(routine.statements), routine.results)
    return list(dict.fromkeys(value for value in values if isinstance(value, Constant)))


def count_operations(routine: Routine) -> Counter[str]:
    """Count how often each operation is done, by name; of a choice the longer body counts."""
    return _count_in(routine.statements)


def _count_in(statements: Iterable[Statement]) -> Counter[str]:
    counts: Counter[str] = Counter()
    for statement in statements:
        if isinstance(statement, Operation):
            counts[statement.name] += 1
        elif isinstance(statement, Repeat):
            counts.update({name: number * statement.times for name, number in _count_in(statement.body).items()})
        else:
            counts.update(max(map(_count_in, statement.bodies), key=Counter.total))
    return counts


def _read_values(statements: Iterable[Statement]) -> Iterable[Value]:
    for statement in statements:
        if isinstance(statement, Operation):
            yield from statement.operands
        elif isinstance(statement, Repeat):
            yield from chain(statement.start, _read_values(statement.body), statement.results)
        else:
            yield statement.condition
            for body, results in zip(statement.bodies, statement.results, strict=True):
                yield from chain(_read_values(body), results)


def _find_needed(statements: Sequence[Statement], results: Iterable[Value]) -> tuple[tuple[Statement, ...], set[Variable]]:
    """Find the statements that the results need, and the variables that these read and do not compute."""
    needed, needed_statements = select_variables(results), []
    for statement in reversed(statements):
        if isinstance(statement, Operation):
            if statement.out not in needed:
                continue
            needed = needed - {statement.out} | select_variables(statement.operands)
            needed_statements.append(statement)
        elif isinstance(statement, Repeat):
            alive = [variable in needed for variable in statement.carried]
            while True:
                body, inside = _find_needed(statement.body, _select_marked(statement.results, alive))
                before, alive = (
                    alive,
                    [is_alive or variable in inside for is_alive, variable in zip(alive, statement.carried, strict=True)],
                )
                if before == alive:
                    break
            if any(alive):
                carried, start = _select_marked(statement.carried, alive), _select_marked(statement.start, alive)
                needed = (needed | inside) - set(carried) | select_variables(start)
                needed_statements.append(
                    statement._replace(
                        carried=carried, start=start, body=body, results=_select_marked(statement.results, alive)
                    )
                )
        else:
            alive = [variable in needed for variable in statement.outs]
            if any(alive):
                outs = _select_marked(statement.outs, alive)
                branch_results_alive = tuple(_select_marked(branch_results, alive) for branch_results in statement.results)
                bodies, inside = zip(*map(_find_needed, statement.bodies, branch_results_alive), strict=True)
                needed = needed.difference(outs).union(*inside, select_variables([statement.condition]))
                needed_statements.append(statement._replace(outs=outs, bodies=bodies, results=branch_results_alive))
    return tuple(reversed(needed_statements)), needed


def are_same(first: Value, second: Value) -> bool:
    """Return True if two values are the same variable or the same number."""
    if isinstance(first, Constant) and isinstance(second, Constant):
        return first.key[:2] == second.key[:2]
    return first is second


def _select_marked(candidates: Sequence[Any], marks: Sequence[bool]) -> tuple[Any, ...]:
    return tuple(candidate for candidate, marked in zip(candidates, marks, strict=True) if marked)


def _dtype_of(v: Any) -> np.dtype:
    """Return the dtype of a variable or literal of a jaxpr."""
    return np.dtype(v.aval.dtype)


class _Lowering:
    """Writes statements as it goes through equations."""

    def __init__(self) -> None:
        self.statements: list[Statement] = []
        self._variable_by_operation: dict[Any, Variable] = {}
        """The variable that holds the result of an operation, by the operation's name, type and operands."""
        self.operation_by_variable: dict[Value, Operation] = {}
        self._numbers = count()
        self._source = ""

    def variable(self, dtype: Any, name: str = "") -> Variable:
        return Variable(np.dtype(dtype), next(self._numbers), name)

    # jaxprs

    def lower_jaxpr(self, closed: ClosedJaxpr, arguments: Sequence[Value], outside: bool = True) -> list[Value]:
        """Lower a jaxpr and return its results. Within a call (`outside` is False) the source stays that of the call."""
        jaxpr = closed.jaxpr
        env: dict[Var, Value] = dict(zip(jaxpr.invars, arguments, strict=True))
        env |= {v: Constant(np.asarray(value)) for v, value in zip(jaxpr.constvars, closed.consts, strict=True)}

        def read(v: Var | Literal) -> Value:
            return Constant(np.asarray(v.val, _dtype_of(v))) if isinstance(v, Literal) else env[v]

        for eqn in jaxpr.eqns:
            if outside:
                self._source = equation_source(eqn)
            values = [read(v) for v in eqn.invars]
            results = self.lower_equation(eqn, values, outside)
            if all(isinstance(value, Constant) for value in values):
                results = [_add_formula(result, eqn.primitive.name, values) for result in results]  # type: ignore[arg-type]
            env |= dict(zip(eqn.outvars, results, strict=True))
        return [read(v) for v in jaxpr.outvars]

    def lower_equation(self, eqn: JaxprEqn, operands: list[Value], outside: bool = True) -> list[Value]:
        name, all_constant = eqn.primitive.name, all(isinstance(value, Constant) for value in operands)
        variables: list[Any] = [*eqn.invars, *eqn.outvars]
        if any(v.aval.shape for v in variables):
            if all_constant:
                return self._evaluate(eqn, operands)
            raise Unsupported(f"{name} of arrays: what runs in real time should be made of scalars")
        if name == "scan":
            return self._lower_scan(*scan_parameters(eqn), operands, outside)
        if name == "cond":
            return self._lower_cond(cond_branches(eqn), operands, outside)
        if (called := callee(eqn)) is not None:
            return self.lower_jaxpr(called, operands, False)
        dtype = _dtype_of(eqn.invars[0]) if operands else np.dtype(bool)
        if str(dtype) not in TYPES:
            raise Unsupported(f"numbers of type {dtype}")
        real = jnp.issubdtype(dtype, jnp.floating)
        if name in FUNCTIONS and real:
            return self.lower_jaxpr(trace_scalar_function(FUNCTIONS[name], dtype), operands, False)
        rule = (_OF_FLOATS if real else _OF_INTEGERS).get(name) or _OF_ALL.get(name)
        if rule is None:
            if all_constant:
                return self._evaluate(eqn, operands)
            raise Unsupported(f"{name} of {dtype}")
        return [rule(self, eqn, *operands)]

    def _evaluate(self, eqn: JaxprEqn, constants: Sequence[Value]) -> list[Value]:
        """Compute an equation of constants by JAX."""
        results = eqn.primitive.bind(*(jnp.asarray(constant.value) for constant in constants), **eqn.params)  # type: ignore[union-attr]
        return [Constant(np.asarray(constant)) for constant in (results if eqn.primitive.multiple_results else [results])]

    def _lower_scan(self, times: int, body: ClosedJaxpr, fixed: int, operands: list[Value], outside: bool) -> list[Value]:
        fixed_values, state = operands[:fixed], operands[fixed:]
        if times == 1 or all(isinstance(value, Constant) for value in operands):
            for _ in range(times):
                state = self.lower_jaxpr(body, [*fixed_values, *state], outside)
            return state
        source = self._source
        carried = tuple(self.variable(value.dtype) for value in state)
        statements, results = self._lower_body(lambda: self.lower_jaxpr(body, [*fixed_values, *carried], outside))
        self.statements.append(Repeat(times, carried, tuple(state), statements, results, source))
        return list(carried)

    def _lower_cond(self, branches: Sequence[ClosedJaxpr], operands: list[Value], outside: bool) -> list[Value]:
        condition, *branch_operands = operands
        if isinstance(condition, Constant):
            return self.lower_jaxpr(branches[int(np.clip(condition.value, 0, len(branches) - 1))], branch_operands, outside)
        if len(branches) != 2:
            raise Unsupported("cond among more than two")
        condition, source = self.emit("ne", bool, condition, _make_constant_like(condition, 0)), self._source
        no, yes = (self._lower_body(lambda body=body: self.lower_jaxpr(body, branch_operands, outside)) for body in branches)
        # what is the same on both ways is no choice
        differ = [not are_same(a, b) for a, b in zip(yes[1], no[1], strict=True)]
        merged = [self.variable(a.dtype) if differs else a for a, differs in zip(yes[1], differ, strict=True)]
        outs = tuple(out for out, differs in zip(merged, differ, strict=True) if differs and isinstance(out, Variable))
        results = _select_marked(yes[1], differ), _select_marked(no[1], differ)
        self.statements.append(Choice(condition, outs, (yes[0], no[0]), results, source))
        return merged

    def _lower_body(self, lower_body: Callable[[], list[Value]]) -> tuple[tuple[Statement, ...], tuple[Value, ...]]:
        """Lower a body apart: variables that it defines cannot be used after it."""
        outer_statements, outer_variables = self.statements, self._variable_by_operation
        self.statements, self._variable_by_operation = [], dict(outer_variables)
        results = lower_body()
        statements, self.statements, self._variable_by_operation = self.statements, outer_statements, outer_variables
        return tuple(statements), tuple(results)

    # operations

    def emit(self, name: str, dtype: Any, *operands: Value) -> Value:
        """Write an operation and return its result: a new variable, or a value that is known to be the same."""
        dtype = np.dtype(dtype)
        if all(isinstance(value, Constant) for value in operands):
            with np.errstate(all="ignore"):
                numbers: list[Any] = [constant.value[()] for constant in operands]  # type: ignore[union-attr]
                typed = _TYPED_EVALUATIONS.get(name)
                value = np.asarray(typed(dtype, *numbers) if typed else _EVALUATIONS[name](*numbers), dtype)
            return Constant(value, paths=_find_paths(operands))
        if (simpler := self._simplify(name, dtype, operands)) is not None:
            return simpler
        key = (name, dtype, *operands)
        if key not in self._variable_by_operation:
            out = self._variable_by_operation[key] = self.variable(dtype)
            self.operation_by_variable[out] = Operation(out, name, operands, self._source)
            self.statements.append(self.operation_by_variable[out])
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
                pair = _make_constant_like(b, 1), b
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
            inner = self.operation_by_variable.get(a)
            if inner is not None and inner.name == "convert" and inner.operands[0].dtype == bool:
                return inner.operands[0]
        return None


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


def _evaluate_conversion(dtype: np.dtype, a: Any) -> Any:
    return np.trunc(a) if dtype.kind in "iu" and a.dtype.kind == "f" else a


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
    "convert": _evaluate_conversion,
    "bitcast": lambda dtype, a: np.asarray(a).view(dtype),
    "power_of_two": lambda dtype, n: np.ldexp(dtype.type(1), int(n)),
}
"""The same for operations that depend on the type of their result, which comes first."""


# rules: what a primitive becomes

Rule = Callable[..., Value]


def _make_operation_rule(name: str) -> Rule:
    return lambda w, eqn, *operands: w.emit(name, operands[0].dtype, *operands)


def _make_constant_like(like: Value, value: float) -> Constant:
    return Constant(np.asarray(value, like.dtype))


def _make_comparison_rule(name: str) -> Rule:
    return lambda w, eqn, a, b: w.emit(name, bool, a, b)


def _sign(w: _Lowering, eqn: JaxprEqn, a: Value) -> Value:
    zero = _make_constant_like(a, 0)
    below = w.emit("select", a.dtype, w.emit("lt", bool, a, zero), _make_constant_like(a, -1), a)
    return w.emit("select", a.dtype, w.emit("gt", bool, a, zero), _make_constant_like(a, 1), below)


def _clamp(w: _Lowering, eqn: JaxprEqn, low: Value, a: Value, high: Value) -> Value:
    return w.emit("min", a.dtype, w.emit("max", a.dtype, a, low), high)


def _power(w: _Lowering, eqn: JaxprEqn, a: Value) -> Value:
    power = equation_parameter(eqn, "y")
    if not 1 <= abs(power) <= 8:
        raise Unsupported(f"integer_pow by {power}")
    result = reduce(lambda x, y: w.emit("mul", a.dtype, x, y), [a] * abs(power))
    return result if power > 0 else w.emit("div", a.dtype, _make_constant_like(a, 1), result)


def _select(w: _Lowering, eqn: JaxprEqn, condition: Value, *cases: Value) -> Value:
    if len(cases) != 2 or condition.dtype != bool:
        raise Unsupported("select_n among more than two")
    return w.emit("select", cases[0].dtype, condition, cases[1], cases[0])


def _convert(w: _Lowering, eqn: JaxprEqn, a: Value) -> Value:
    new = _dtype_of(eqn.outvars[0])
    if new.kind == "b" and a.dtype.kind != "b":
        return w.emit("ne", bool, a, _make_constant_like(a, 0))
    return w.emit("convert", new, a)


def _bitcast(w: _Lowering, eqn: JaxprEqn, a: Value) -> Value:
    """The bits of a number as another one; of an exponent that is put together from an integer, a power of two."""
    new = _dtype_of(eqn.outvars[0])
    bias, bits = (1023, 52) if new == np.float64 else (127, 23)
    shift = w.operation_by_variable.get(a) if new.kind == "f" else None
    if shift is not None and shift.name == "shift_left" and _is_number(shift.operands[1], bits):
        sum_ = w.operation_by_variable.get(shift.operands[0])
        if sum_ is not None and sum_.name == "add" and _is_number(sum_.operands[1], bias):
            exponent = sum_.operands[0]
            before = w.operation_by_variable.get(exponent)
            if before is not None and before.name == "convert":
                exponent = before.operands[0]
            return w.emit("power_of_two", new, w.emit("convert", np.int32, exponent))
    return w.emit("bitcast", new, a)


def _is_number(value: Value, number: int) -> bool:
    return isinstance(value, Constant) and value.value == number


def _finite(w: _Lowering, eqn: JaxprEqn, a: Value) -> Value:
    return w.emit("le", bool, w.emit("abs", a.dtype, a), _make_constant_like(a, float(jnp.finfo(a.dtype).max)))


def _one_minus_square(w: _Lowering, eqn: JaxprEqn, a: Value) -> Value:
    unit = _make_constant_like(a, 1)
    return w.emit("mul", a.dtype, w.emit("add", a.dtype, unit, a), w.emit("sub", a.dtype, unit, a))


_OF_FLOATS: dict[str, Rule] = {
    **{name: _make_operation_rule(name) for name in ("add", "sub", "mul", "div", "neg", "abs", "sqrt", "floor", "ceil")},
    "add_any": _make_operation_rule("add"),
    "square": lambda w, eqn, a: w.emit("mul", a.dtype, a, a),
    "one_minus_square": _one_minus_square,
    "integer_pow": _power,
    # lax.RoundingMethod: away from zero, to nearest even
    "round": lambda w, eqn, a: w.emit(
        ("round_away", "round_even")[int(equation_parameter(eqn, "rounding_method"))], a.dtype, a
    ),
    "is_finite": _finite,
}
_OF_INTEGERS: dict[str, Rule] = {
    name: _make_operation_rule(name)
    for name in ("add", "sub", "mul", "div", "rem", "neg", "and", "or", "xor", "not", "shift_left", "shift_right_logical")
}
_OF_ALL: dict[str, Rule] = {
    **{name: _make_comparison_rule(name) for name in ("gt", "lt", "ge", "le", "eq", "ne")},
    "sign": _sign,
    "max": _make_operation_rule("max"),
    "min": _make_operation_rule("min"),
    "clamp": _clamp,
    "select_n": _select,
    "convert_element_type": _convert,
    "bitcast_convert_type": _bitcast,
    **dict.fromkeys(("copy", "copy_p", "broadcast_in_dim", "reshape", "squeeze"), lambda w, eqn, a: a),
}


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
