"""Traced functions of scalars, written equation by equation in another language.

Calls are opened, elementary functions become the polynomials of :mod:`.elementary`, and other primitives become a few
operations, for which each language has its own words.
"""

import abc
from collections.abc import Callable, Collection, Sequence
from functools import reduce
from typing import Any, ClassVar

import numpy as np

from . import Unsupported
from .elementary import FUNCTIONS
from .jaxprs import (
    ClosedJaxpr,
    JaxprEqn,
    Literal,
    callee,
    cond_branches,
    equation_parameter,
    scan_parameters,
    trace_scalar_function,
)

COMPARISONS = ("lt", "le", "gt", "ge", "eq", "ne")
"""Operations that make truth values."""
Rule = Callable[..., Any]
"""`rule(writer, eqn, dtype, *operands)` writes a primitive of numbers of type `dtype`, and returns its result."""


class ScalarWriter(abc.ABC):
    """Writes jaxprs of scalars.

    Attributes:
        number_types: of the numbers that the language has.
        arrays: what a message calls numbers that are no scalars.
    """

    number_types: ClassVar[Collection[str]]
    arrays = "arrays"

    # what a language says

    @abc.abstractmethod
    def literal(self, number: Any, dtype: Any) -> Any:
        """Write a number of a type."""

    @abc.abstractmethod
    def emit(self, name: str, dtype: Any, *operands: Any) -> Any:
        """Write an operation that makes or compares numbers of a type, and return its result."""

    @abc.abstractmethod
    def convert(self, number: Any, old: np.dtype, new: np.dtype) -> Any:
        """Write a number in another type."""

    @abc.abstractmethod
    def bitcast(self, number: Any, new: np.dtype) -> Any:
        """Write the bits of a number as a number of another type."""

    @abc.abstractmethod
    def write_scan(self, times: int, body: ClosedJaxpr, constants: list[Any], state: list[Any]) -> list[Any]:
        """Write a loop of fixed length, `state = body(constants, state)`, and return the last state."""

    @abc.abstractmethod
    def write_cond(self, branches: Sequence[ClosedJaxpr], index: Any, operands: list[Any]) -> list[Any]:
        """Write a choice among branches by their index, and return its results."""

    def write_call(self, called: ClosedJaxpr, operands: list[Any]) -> list[Any]:
        """Write the equations of a function that an equation calls."""
        return self.write_jaxpr(called, operands)

    def write_unknown(self, eqn: JaxprEqn, operands: list[Any], kind: str) -> list[Any]:
        """Write an equation that has no rule, of a kind of numbers; raises `Unsupported`."""
        raise Unsupported(f"{eqn.primitive.name} of {kind}")

    # what they have in common

    @classmethod
    def check_type(cls, dtype: Any) -> np.dtype:
        """Return a type of numbers; raises `Unsupported` if the language lacks it."""
        if str(dtype) not in cls.number_types:
            raise Unsupported(f"numbers of type {dtype}")
        return np.dtype(dtype)

    def write_jaxpr(self, closed: ClosedJaxpr, arguments: Sequence[Any]) -> list[Any]:
        """Write the equations of a jaxpr, and return its results."""
        jaxpr = closed.jaxpr
        env: dict[Any, Any] = dict(zip(jaxpr.invars, arguments, strict=True))
        env |= {v: self.literal(number, _type_of(v)) for v, number in zip(jaxpr.constvars, closed.consts, strict=True)}

        def read(v: Any) -> Any:
            return self.literal(v.val, _type_of(v)) if isinstance(v, Literal) else env[v]

        for eqn in jaxpr.eqns:
            results = self.write_equation(eqn, [read(v) for v in eqn.invars])
            env |= dict(zip(eqn.outvars, results, strict=True))
        return [read(v) for v in jaxpr.outvars]

    def write_equation(self, eqn: JaxprEqn, operands: list[Any]) -> list[Any]:
        """Write an equation, and return its results."""
        name, variables = eqn.primitive.name, [*eqn.invars, *eqn.outvars]
        if any(v.aval.shape for v in variables):
            return self.write_unknown(eqn, operands, self.arrays)
        if name == "scan":
            times, body, count = scan_parameters(eqn)
            return self.write_scan(times, body, operands[:count], operands[count:])
        if name == "cond":
            return self.write_cond(cond_branches(eqn), operands[0], operands[1:])
        if (called := callee(eqn)) is not None:
            return self.write_call(called, operands)
        dtype = self.check_type(_type_of(variables[0]))
        is_float = dtype.kind == "f"
        if name in FUNCTIONS and is_float:
            return self.write_call(trace_scalar_function(FUNCTIONS[name], dtype), operands)
        rule = (_FLOAT_RULES if is_float else _INTEGER_RULES).get(name) or _COMMON_RULES.get(name)
        return self.write_unknown(eqn, operands, str(dtype)) if rule is None else [rule(self, eqn, dtype, *operands)]


def _type_of(v: Any) -> Any:
    """The type of a variable or literal of a jaxpr."""
    return v.aval.dtype


def _operation_rules(*names: str) -> dict[str, Rule]:
    """Rules of primitives that are an operation of the same name."""
    return {name: lambda w, eqn, dtype, *operands, name=name: w.emit(name, dtype, *operands) for name in names}


def _sign(w: ScalarWriter, eqn: JaxprEqn, dtype: np.dtype, a: Any) -> Any:
    zero, result = w.literal(0, dtype), a
    for comparison, sign in (("lt", -1), ("gt", 1)):
        result = w.emit("select", dtype, w.emit(comparison, dtype, a, zero), w.literal(sign, dtype), result)
    return result


def _integer_power(w: ScalarWriter, eqn: JaxprEqn, dtype: np.dtype, a: Any) -> Any:
    exponent = equation_parameter(eqn, "y")
    if not 1 <= abs(exponent) <= 8:
        raise Unsupported(f"integer_pow by {exponent}")
    power = reduce(lambda x, y: w.emit("mul", dtype, x, y), [a] * abs(exponent))
    return power if exponent > 0 else w.emit("div", dtype, w.literal(1, dtype), power)


def _one_minus_square(w: ScalarWriter, eqn: JaxprEqn, dtype: np.dtype, a: Any) -> Any:
    """1 - a², in JAX 0.11's derivatives of tanh."""
    unit = w.literal(1, dtype)
    return w.emit("mul", dtype, w.emit("add", dtype, unit, a), w.emit("sub", dtype, unit, a))


def _select(w: ScalarWriter, eqn: JaxprEqn, dtype: np.dtype, condition: Any, *cases: Any) -> Any:
    if len(cases) != 2 or dtype != np.dtype(bool):
        raise Unsupported("select_n among more than two")
    return w.emit("select", _type_of(eqn.outvars[0]), condition, cases[1], cases[0])


_FLOAT_RULES: dict[str, Rule] = {
    **_operation_rules("add", "sub", "mul", "div", "neg", "abs", "sqrt", "floor", "ceil"),
    "add_any": lambda w, eqn, dtype, a, b: w.emit("add", dtype, a, b),
    "square": lambda w, eqn, dtype, a: w.emit("mul", dtype, a, a),
    "one_minus_square": _one_minus_square,
    "integer_pow": _integer_power,
    # lax.RoundingMethod: away from zero, to nearest even
    "round": lambda w, eqn, dtype, a: w.emit(
        ("round_away", "round_even")[int(equation_parameter(eqn, "rounding_method"))], dtype, a
    ),
    "is_finite": lambda w, eqn, dtype, a: w.emit(
        "le", dtype, w.emit("abs", dtype, a), w.literal(np.finfo(dtype).max, dtype)
    ),
}
_INTEGER_RULES = _operation_rules(
    *("add", "sub", "mul", "div", "rem", "neg", "and", "or", "xor", "not", "shift_left", "shift_right_logical")
)
_COMMON_RULES: dict[str, Rule] = {
    **_operation_rules(*COMPARISONS, "max", "min"),
    "sign": _sign,
    "clamp": lambda w, eqn, dtype, low, a, high: w.emit("min", dtype, w.emit("max", dtype, low, a), high),
    "select_n": _select,
    "convert_element_type": lambda w, eqn, dtype, a: w.convert(a, dtype, w.check_type(_type_of(eqn.outvars[0]))),
    "bitcast_convert_type": lambda w, eqn, dtype, a: w.bitcast(a, w.check_type(_type_of(eqn.outvars[0]))),
    **dict.fromkeys(("copy", "copy_p", "broadcast_in_dim", "reshape", "squeeze"), lambda w, eqn, dtype, a: a),
}
