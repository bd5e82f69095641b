"""A traced function of scalars as a list of simple operations, from which code in other languages is written.

Calls are opened and elementary functions become the polynomials of :mod:`jaxbl.fused.elementary`, as in the fused loop.
What depends on constants alone is computed here, each operation rounded once in the precision of the code. What is computed
twice, and what nothing reads, is left out. No other change is made that could alter a number.
"""

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
"""Of numbers, in the code that is written."""
_LONGEST = 90
"""Letters of a formula in a comment."""


class Variable:
    """A number that the code computes or is given; `name` where it has one of its own."""

    def __init__(self, dtype: np.dtype, number: int, name: str = ""):
        self.dtype, self.number, self.name = dtype, number, name

    def __repr__(self) -> str:
        return self.name or f"v{self.number}"


@dataclass(frozen=True, eq=False)
class Constant:
    """A number that is known, and how it follows from numbers of the study: a formula, or "" for one that is in the code
    itself."""

    value: Any
    formula: str = ""
    paths: tuple[str, ...] = ()

    @property
    def dtype(self) -> np.dtype:
        """Its type."""
        return self.value.dtype

    @property
    def key(self) -> tuple[str, bytes, str]:
        """What makes it the same as another one."""
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
    given: tuple[Value, ...]
    source: str


class Repeat(NamedTuple):
    """`carried` begin as `start`; so many times the body is run, and they become `results`, all at once."""

    times: int
    carried: tuple[Variable, ...]
    start: tuple[Value, ...]
    body: "tuple[Statement, ...]"
    results: tuple[Value, ...]
    source: str


class Choice(NamedTuple):
    """`outs` become the results of one of two bodies."""

    which: Value
    outs: tuple[Variable, ...]
    bodies: "tuple[tuple[Statement, ...], tuple[Statement, ...]]"
    results: tuple[tuple[Value, ...], tuple[Value, ...]]
    source: str


Statement = Operation | Repeat | Choice


class Routine(NamedTuple):
    """Statements in their order, and the values that they make."""

    statements: tuple[Statement, ...]
    results: tuple[Value, ...]


def lowered(closed: ClosedJaxpr, given: Sequence[Any]) -> Routine:
    """The operations of a traced function of scalars.

    Args:
        closed: the function.
        given: its arguments: variables, or constants.

    Raises:
        Unsupported: an operation of it is unknown here.
    """
    writer = _Lowering()
    results = writer.run(closed, given)
    return Routine(tuple(writer.statements), tuple(results))


def without_unread(routine: Routine) -> Routine:
    """The same without what no result reads."""
    statements, _ = _read(routine.statements, routine.results)
    return Routine(statements, routine.results)


def variables_in(values: Iterable[Value]) -> set[Variable]:
    """Those of some values that are no constants."""
    return {value for value in values if isinstance(value, Variable)}


def read_by(routine: Routine) -> set[Variable]:
    """Variables that a routine reads and does not make."""
    return _read(routine.statements, routine.results)[1]


def constants_of(routine: Routine) -> list[Constant]:
    """Constants in the order in which they are first read."""
    every = chain(_values(routine.statements), routine.results)
    return list(dict.fromkeys(value for value in every if isinstance(value, Constant)))


def operations_of(routine: Routine) -> Counter[str]:
    """How often each operation is done, by name; of a choice, by the longer way."""
    return _counted(routine.statements)


def _counted(statements: Iterable[Statement]) -> Counter[str]:
    found: Counter[str] = Counter()
    for one in statements:
        if isinstance(one, Operation):
            found[one.name] += 1
        elif isinstance(one, Repeat):
            found.update({name: number * one.times for name, number in _counted(one.body).items()})
        else:
            found.update(max(map(_counted, one.bodies), key=Counter.total))
    return found


def _values(statements: Iterable[Statement]) -> Iterable[Value]:
    for one in statements:
        if isinstance(one, Operation):
            yield from one.given
        elif isinstance(one, Repeat):
            yield from chain(one.start, _values(one.body), one.results)
        else:
            yield one.which
            for body, results in zip(one.bodies, one.results, strict=True):
                yield from chain(_values(body), results)


def _read(statements: Sequence[Statement], results: Iterable[Value]) -> tuple[tuple[Statement, ...], set[Variable]]:
    """Statements that make what results read, and the variables that these read and do not make."""
    needed, kept = variables_in(results), []
    for one in reversed(statements):
        if isinstance(one, Operation):
            if one.out not in needed:
                continue
            needed = needed - {one.out} | variables_in(one.given)
            kept.append(one)
        elif isinstance(one, Repeat):
            alive = [variable in needed for variable in one.carried]
            while True:
                body, inside = _read(one.body, _chosen(one.results, alive))
                before, alive = alive, [is_ or one_ in inside for is_, one_ in zip(alive, one.carried, strict=True)]
                if before == alive:
                    break
            if any(alive):
                carried, start = _chosen(one.carried, alive), _chosen(one.start, alive)
                needed = (needed | inside) - set(carried) | variables_in(start)
                kept.append(one._replace(carried=carried, start=start, body=body, results=_chosen(one.results, alive)))
        else:
            alive = [variable in needed for variable in one.outs]
            if any(alive):
                outs = _chosen(one.outs, alive)
                results_ = tuple(_chosen(some, alive) for some in one.results)
                bodies, inside = zip(*map(_read, one.bodies, results_), strict=True)
                needed = needed.difference(outs).union(*inside, variables_in([one.which]))
                kept.append(one._replace(outs=outs, bodies=bodies, results=results_))
    return tuple(reversed(kept)), needed


def alike(one: Value, other: Value) -> bool:
    """Whether two values are the same variable, or the same number."""
    if isinstance(one, Constant) and isinstance(other, Constant):
        return one.key[:2] == other.key[:2]
    return one is other


def _chosen(some: Sequence[Any], which: Sequence[bool]) -> tuple[Any, ...]:
    return tuple(one for one, taken in zip(some, which, strict=True) if taken)


def _type(v: Any) -> np.dtype:
    """Of a variable or literal of a jaxpr."""
    return np.dtype(v.aval.dtype)


def _shape(v: Any) -> tuple[int, ...]:
    return v.aval.shape


class _Lowering:
    """Writes statements as it goes through equations."""

    def __init__(self) -> None:
        self.statements: list[Statement] = []
        self._known: dict[Any, Variable] = {}
        """Variables by the operation that makes them."""
        self.made: dict[Variable, Operation] = {}
        self._numbers = count()
        self._source = ""

    def variable(self, dtype: Any, name: str = "") -> Variable:
        return Variable(np.dtype(dtype), next(self._numbers), name)

    # jaxprs

    def run(self, closed: ClosedJaxpr, given: Sequence[Value], outside: bool = True) -> list[Value]:
        """The results of a jaxpr; inside of a call, what asked for that counts as source."""
        jaxpr = closed.jaxpr
        env: dict[Var, Value] = dict(zip(jaxpr.invars, given, strict=True))
        env |= {v: Constant(np.asarray(value)) for v, value in zip(jaxpr.constvars, closed.consts, strict=True)}

        def read(v: Var | Literal) -> Value:
            return Constant(np.asarray(v.val, _type(v))) if isinstance(v, Literal) else env[v]

        for eqn in jaxpr.eqns:
            if outside:
                self._source = equation_source(eqn)
            values = [read(v) for v in eqn.invars]
            results = self.equation(eqn, values, outside)
            if all(isinstance(value, Constant) for value in values):
                results = [_explained(one, eqn.primitive.name, values) for one in results]  # type: ignore[arg-type]
            env |= dict(zip(eqn.outvars, results, strict=True))
        return [read(v) for v in jaxpr.outvars]

    def equation(self, eqn: JaxprEqn, given: list[Value], outside: bool = True) -> list[Value]:
        name, known = eqn.primitive.name, all(isinstance(value, Constant) for value in given)
        if any(_shape(v) for v in (*eqn.invars, *eqn.outvars)):
            if known:
                return self._bound(eqn, given)
            raise Unsupported(f"{name} of arrays: what runs in real time should be made of scalars")
        if name == "scan":
            return self._repeated(*scan_parameters(eqn), given, outside)
        if name == "cond":
            return self._chosen(cond_branches(eqn), given, outside)
        if (called := callee(eqn)) is not None:
            return self.run(called, given, False)
        dtype = _type(eqn.invars[0]) if given else np.dtype(bool)
        if str(dtype) not in TYPES:
            raise Unsupported(f"numbers of type {dtype}")
        real = jnp.issubdtype(dtype, jnp.floating)
        if name in FUNCTIONS and real:
            return self.run(trace_scalar_function(FUNCTIONS[name], dtype), given, False)
        rule = (_OF_FLOATS if real else _OF_INTEGERS).get(name) or _OF_ALL.get(name)
        if rule is None:
            if known:
                return self._bound(eqn, given)
            raise Unsupported(f"{name} of {dtype}")
        return [rule(self, eqn, *given)]

    def _bound(self, eqn: JaxprEqn, given: Sequence[Value]) -> list[Value]:
        """What is known, as JAX computes it."""
        made = eqn.primitive.bind(*(jnp.asarray(one.value) for one in given), **eqn.params)  # type: ignore[union-attr]
        return [Constant(np.asarray(one)) for one in (made if eqn.primitive.multiple_results else [made])]

    def _repeated(self, times: int, body: ClosedJaxpr, fixed: int, given: list[Value], outside: bool) -> list[Value]:
        still, state = given[:fixed], given[fixed:]
        if times == 1 or all(isinstance(value, Constant) for value in given):
            for _ in range(times):
                state = self.run(body, [*still, *state], outside)
            return state
        source = self._source
        carried = tuple(self.variable(value.dtype) for value in state)
        statements, results = self._inside(lambda: self.run(body, [*still, *carried], outside))
        self.statements.append(Repeat(times, carried, tuple(state), statements, results, source))
        return list(carried)

    def _chosen(self, branches: Sequence[ClosedJaxpr], given: list[Value], outside: bool) -> list[Value]:
        which, *rest = given
        if isinstance(which, Constant):
            return self.run(branches[int(np.clip(which.value, 0, len(branches) - 1))], rest, outside)
        if len(branches) != 2:
            raise Unsupported("cond among more than two")
        which, source = self.emit("ne", bool, which, Constant(np.asarray(0, which.dtype))), self._source
        no, yes = (self._inside(lambda body=body: self.run(body, rest, outside)) for body in branches)
        # what is the same on both ways is no choice
        open_ = [not alike(a, b) for a, b in zip(yes[1], no[1], strict=True)]
        merged = [self.variable(a.dtype) if own else a for a, own in zip(yes[1], open_, strict=True)]
        outs = tuple(one for one, own in zip(merged, open_, strict=True) if own and isinstance(one, Variable))
        results = _chosen(yes[1], open_), _chosen(no[1], open_)
        self.statements.append(Choice(which, outs, (yes[0], no[0]), results, source))
        return merged

    def _inside(self, make: Callable[[], list[Value]]) -> tuple[tuple[Statement, ...], tuple[Value, ...]]:
        """Statements of a body of their own: what they make is not known behind it."""
        outer, known = self.statements, self._known
        self.statements, self._known = [], dict(known)
        results = make()
        found, self.statements, self._known = self.statements, outer, known
        return tuple(found), tuple(results)

    # operations

    def emit(self, name: str, dtype: Any, *given: Value) -> Value:
        """An operation, or what is known to be its result."""
        dtype = np.dtype(dtype)
        if all(isinstance(value, Constant) for value in given):
            with np.errstate(all="ignore"):
                value = np.asarray(_FOLDED[name](dtype, *(one.value[()] for one in given)), dtype)  # type: ignore[union-attr]
            return Constant(value, paths=_paths(given))
        if (same := self._simpler(name, dtype, given)) is not None:
            return same
        key = (name, dtype, *given)
        if key not in self._known:
            out = self._known[key] = self.variable(dtype)
            self.made[out] = Operation(out, name, given, self._source)
            self.statements.append(self.made[out])
        return self._known[key]

    def _simpler(self, name: str, dtype: np.dtype, given: Sequence[Value]) -> Value | None:
        """The result of an operation in a simpler way, the same to the last bit."""
        a, b = given[0], given[-1]
        if name == "mul":
            for one, other in ((a, b), (b, a)):
                if isinstance(one, Constant) and one.value == 1:
                    return other
                if isinstance(one, Constant) and one.value == -1 and dtype.kind == "f":
                    return self.emit("neg", dtype, other)
        if name == "div" and dtype.kind == "f" and isinstance(b, Constant):
            mantissa, exponent = np.frexp(b.value)
            if abs(mantissa) == 0.5 and abs(exponent) < 100:
                # the reciprocal is exact
                inverse = self.emit("div", dtype, Constant(np.asarray(1, dtype)), b)
                assert isinstance(inverse, Constant)
                return self.emit("mul", dtype, a, _explained(inverse, "div", [Constant(np.asarray(1, dtype)), b]))
        if name == "sub" and isinstance(b, Constant) and b.value == 0 and not np.signbit(b.value):
            return a
        if name == "select":
            which, yes, no = given
            if isinstance(which, Constant):
                return yes if which.value else no
            if yes == no:
                return yes
        if name == "convert" and a.dtype == dtype:
            return a
        if name == "ne" and isinstance(b, Constant) and b.value == 0 and isinstance(a, Variable) and a in self.made:
            # a truth value that became a number
            inner = self.made[a]
            if inner.name == "convert" and inner.given[0].dtype == bool:
                return inner.given[0]
        return None


# constants


def _paths(given: Iterable[Value]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(path for one in given if isinstance(one, Constant) for path in one.paths))


_INFIX = {"add": "+", "add_any": "+", "sub": "-", "mul": "*", "div": "/"}


def _explained(result: Value, name: str, given: Sequence[Constant]) -> Value:
    """A constant with the formula of the equation that made it."""
    if not isinstance(result, Constant) or result.formula or not (paths := _paths(given)) or result.value.ndim:
        return result
    texts = [one.formula or f"{one.value.item():.6g}" for one in given]
    if name in _INFIX:
        formula = f"({f' {_INFIX[name]} '.join(texts)})"
    else:
        formula = f"-{texts[0]}" if name == "neg" else f"{name}({', '.join(texts)})"
    if len(formula) > _LONGEST or name not in _SAID:
        formula = f"from {', '.join(paths)}"
    return replace(result, formula=formula, paths=paths)


_SAID = {*_INFIX, "neg", "abs", "sqrt", "square", "integer_pow", "min", "max", *FUNCTIONS}
"""Equations whose formula says something."""


def _folded_power(dtype: np.dtype, n: Any) -> Any:
    return np.ldexp(dtype.type(1), int(n))


def _to_integer(dtype: np.dtype, a: Any) -> Any:
    return np.trunc(a) if dtype.kind in "iu" and a.dtype.kind == "f" else a


_FOLDED: dict[str, Callable[..., Any]] = {
    "add": lambda _, a, b: a + b,
    "sub": lambda _, a, b: a - b,
    "mul": lambda _, a, b: a * b,
    "div": lambda _, a, b: a / b if a.dtype.kind == "f" else np.trunc(a / b),
    "rem": lambda _, a, b: np.fmod(a, b),
    "neg": lambda _, a: -a,
    "abs": lambda _, a: np.abs(a),
    "sqrt": lambda _, a: np.sqrt(a),
    "floor": lambda _, a: np.floor(a),
    "ceil": lambda _, a: np.ceil(a),
    "round_even": lambda _, a: np.rint(a),
    "round_away": lambda _, a: np.copysign(np.floor(np.abs(a)) + (np.abs(a) - np.floor(np.abs(a)) >= 0.5), a),
    "max": lambda _, a, b: np.maximum(a, b),
    "min": lambda _, a, b: np.minimum(a, b),
    "lt": lambda _, a, b: a < b,
    "le": lambda _, a, b: a <= b,
    "gt": lambda _, a, b: a > b,
    "ge": lambda _, a, b: a >= b,
    "eq": lambda _, a, b: a == b,
    "ne": lambda _, a, b: a != b,
    "and": lambda _, a, b: a & b,
    "or": lambda _, a, b: a | b,
    "xor": lambda _, a, b: a ^ b,
    "not": lambda _, a: ~a,
    "shift_left": lambda _, a, b: a << b,
    "shift_right_logical": lambda dtype, a, b: a.view(f"u{dtype.itemsize}") >> b.view(f"u{dtype.itemsize}"),
    "select": lambda _, which, yes, no: yes if which else no,
    "convert": _to_integer,
    "bitcast": lambda dtype, a: np.asarray(a).view(dtype),
    "power_of_two": _folded_power,
}
"""Operations of known numbers, by name: those of a :class:`Operation` are the same."""


# rules: what a primitive becomes

Rule = Callable[..., Value]


def _plain(name: str) -> Rule:
    return lambda w, eqn, *given: w.emit(name, given[0].dtype, *given)


def _number(like: Value, value: float) -> Constant:
    return Constant(np.asarray(value, like.dtype))


def _compared(name: str) -> Rule:
    return lambda w, eqn, a, b: w.emit(name, bool, a, b)


def _sign(w: _Lowering, eqn: JaxprEqn, a: Value) -> Value:
    zero = _number(a, 0)
    below = w.emit("select", a.dtype, w.emit("lt", bool, a, zero), _number(a, -1), a)
    return w.emit("select", a.dtype, w.emit("gt", bool, a, zero), _number(a, 1), below)


def _clamp(w: _Lowering, eqn: JaxprEqn, low: Value, a: Value, high: Value) -> Value:
    return w.emit("min", a.dtype, w.emit("max", a.dtype, a, low), high)


def _power(w: _Lowering, eqn: JaxprEqn, a: Value) -> Value:
    power = equation_parameter(eqn, "y")
    if not 1 <= abs(power) <= 8:
        raise Unsupported(f"integer_pow by {power}")
    result = reduce(lambda x, y: w.emit("mul", a.dtype, x, y), [a] * abs(power))
    return result if power > 0 else w.emit("div", a.dtype, _number(a, 1), result)


def _select(w: _Lowering, eqn: JaxprEqn, which: Value, *cases: Value) -> Value:
    if len(cases) != 2 or which.dtype != bool:
        raise Unsupported("select_n among more than two")
    return w.emit("select", cases[0].dtype, which, cases[1], cases[0])


def _convert(w: _Lowering, eqn: JaxprEqn, a: Value) -> Value:
    new = _type(eqn.outvars[0])
    if new.kind == "b" and a.dtype.kind != "b":
        return w.emit("ne", bool, a, _number(a, 0))
    return w.emit("convert", new, a)


def _bitcast(w: _Lowering, eqn: JaxprEqn, a: Value) -> Value:
    """The bits of a number as another one; of an exponent that is put together from an integer, a power of two."""
    new = _type(eqn.outvars[0])
    bias, bits = (1023, 52) if new == np.float64 else (127, 23)
    shift = w.made.get(a) if isinstance(a, Variable) and new.kind == "f" else None
    if shift is not None and shift.name == "shift_left" and _is(shift.given[1], bits):
        sum_ = w.made.get(shift.given[0])  # type: ignore[call-overload]
        if sum_ is not None and sum_.name == "add" and _is(sum_.given[1], bias):
            exponent = sum_.given[0]
            before = w.made.get(exponent) if isinstance(exponent, Variable) else None
            if before is not None and before.name == "convert":
                exponent = before.given[0]
            return w.emit("power_of_two", new, w.emit("convert", np.int32, exponent))
    return w.emit("bitcast", new, a)


def _is(value: Value, number: int) -> bool:
    return isinstance(value, Constant) and value.value == number


def _finite(w: _Lowering, eqn: JaxprEqn, a: Value) -> Value:
    return w.emit("le", bool, w.emit("abs", a.dtype, a), _number(a, float(jnp.finfo(a.dtype).max)))


def _one_minus_square(w: _Lowering, eqn: JaxprEqn, a: Value) -> Value:
    one = _number(a, 1)
    return w.emit("mul", a.dtype, w.emit("add", a.dtype, one, a), w.emit("sub", a.dtype, one, a))


_OF_FLOATS: dict[str, Rule] = {
    **{name: _plain(name) for name in ("add", "sub", "mul", "div", "neg", "abs", "sqrt", "floor", "ceil")},
    "add_any": _plain("add"),
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
    name: _plain(name)
    for name in ("add", "sub", "mul", "div", "rem", "neg", "and", "or", "xor", "not", "shift_left", "shift_right_logical")
}
_OF_ALL: dict[str, Rule] = {
    **{name: _compared(name) for name in ("gt", "lt", "ge", "le", "eq", "ne")},
    "sign": _sign,
    "max": _plain("max"),
    "min": _plain("min"),
    "clamp": _clamp,
    "select_n": _select,
    "convert_element_type": _convert,
    "bitcast_convert_type": _bitcast,
    **dict.fromkeys(("copy", "copy_p", "broadcast_in_dim", "reshape", "squeeze"), lambda w, eqn, a: a),
}


def named_constants(constants: Iterable[Constant], known: Mapping[str, Any]) -> dict[Constant, str]:
    """Names of those constants that come from numbers of a study: that of its config path for such a
    number itself, `DERIVED_1` and so on for what follows from them."""
    names: dict[Constant, str] = {}
    for one in constants:
        if one.formula in known:
            names[one] = one.formula.replace(".", "_").upper()
        elif one.formula:
            names[one] = f"DERIVED_{1 + sum(name.startswith('DERIVED_') for name in names.values())}"
    return names


def with_x64(dtype: np.dtype) -> Any:
    """Context in which a type is JAX's default."""
    return jax.enable_x64(dtype == np.float64)
