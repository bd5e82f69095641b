"""A program in C99: one source file and one header, without allocation and without libm beyond sqrt and fabs."""

import textwrap
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from .block import Program, Quantity
from .lowering import Constant, Operation, Routine, Value, Variable, constants_of
from .writer import Writer, plain_text, shortest, unread

_TYPES = {
    "float64": "double",
    "float32": "float",
    "int32": "int32_t",
    "uint32": "uint32_t",
    "int64": "int64_t",
    "uint64": "uint64_t",
    "bool": "bool",
}
_WIDTH = 110


class Code(NamedTuple):
    """Texts of the source file and of the header."""

    source: str
    header: str


def c_type(dtype: np.dtype) -> str:
    """The type of C for numbers of a type."""
    return _TYPES[str(dtype)]


def c_code(program: Program, about: Sequence[str]) -> Code:
    """A program in C.

    Args:
        program: of a block.
        about: lines for the beginning of both files.
    """
    name = program.block.name
    writer = _C(program)
    writer.routines()
    head = [*comment(about), ""]
    constants = writer.definitions(set.intersection(*writer.read))
    includes = [f'#include "{name}.h"', "", *(["#include <math.h>", ""] if writer.needs_math else [])]
    parts = [*head, *includes, *constants, "" if constants else None, *writer.helpers(), *writer.lines]
    source = "\n".join(part for part in parts if part is not None)
    return Code(plain_text(f"{source.rstrip()}\n"), plain_text(_header(program, head)))


def comment(lines: Sequence[str]) -> list[str]:
    """A comment of several lines."""
    return ["/*", *(f" * {line}".rstrip().replace("*/", "* /").replace("/*", "/ *") for line in lines), " */"]


def said_of(program: Program, constant: Constant) -> str:
    """What a constant is, for a comment."""
    known = program.block.known.get(constant.formula)
    if known is None:
        return constant.formula.removeprefix("(").removesuffix(")") if constant.formula.startswith("(") else constant.formula
    return f"{constant.formula}{f', {known.unit}' if known.unit else ''}: {known.about}"


def _header(program: Program, head: Sequence[str]) -> str:
    block, name = program.block, program.block.name
    guard = f"{name.upper()}_H"
    start, step = signatures(program)
    lines = [*head, f"#ifndef {guard}", f"#define {guard}", "", "#include <stdbool.h>", "#include <stdint.h>", ""]
    lines += [
        "/* What is carried from sample to sample: for init and step alone. */",
        *_struct(f"{name}_state", program.state or [Quantity("unused", "", "", np.dtype(np.int32))]),
        "/* What step finds. */",
        *_struct(f"{name}_outputs", block.outputs),
        "/* Before the first sample. */",
        f"{start};",
        "",
        "/* At every sample, at the period of the study. */",
        f"{step};",
        "",
        f"#endif /* {guard} */",
    ]
    return "\n".join(lines) + "\n"


def signatures(program: Program) -> tuple[str, str]:
    """Declarations of init and step."""
    block, name = program.block, program.block.name
    first = [f"{c_type(one.dtype)} {one.name}" for one in block.first]
    inputs = [f"{c_type(one.dtype)} {one.name}" for one in block.inputs]
    found = f"{name}_outputs *outputs"
    start = ", ".join([f"{name}_state *state", *first, *([found] if block.starts_with_outputs else [])])
    step = ", ".join([f"{name}_state *state", *inputs, found])
    return f"void {name}_init({start})", f"void {name}_step({step})"


def _struct(name: str, members: Sequence[Quantity]) -> list[str]:
    lines = ["typedef struct", "{"]
    for one in members:
        about = f"{one.about}{f', {one.unit}' if one.unit else ''}"
        lines.append(f"    {c_type(one.dtype)} {one.name};{f' /* {about} */' if about else ''}")
    return [*lines, f"}} {name};", ""]


class _C(Writer):
    def __init__(self, program: Program):
        super().__init__(program)
        self.needs_math = False
        self._needed: dict[str, tuple[np.dtype, ...]] = {}
        """Helpers by name, with the types that they are about."""
        self.read = [set(constants_of(routine)) & self.constants.keys() for routine in (program.start, program.step)]
        """Named constants of init and of step."""

    def routines(self) -> None:
        """Write init and step."""
        program, block = self.program, self.program.block
        start, step = signatures(program)
        self._function(start, 0, program.start, block.first, ())
        self.line()
        self._function(step, 1, program.step, block.inputs, program.state_variables)

    def _function(self, head: str, which: int, routine: Routine, given: Sequence[Quantity], old: Sequence[Variable]) -> None:
        """One of the two; `old` are variables for the state that it finds."""
        program, block = self.program, self.program.block
        self.line(head)
        self.line("{")
        self._depth += 1
        self._own_constants(which)
        if not program.state:
            self.line("(void)state;" if which else "state->unused = 0;")
        for name in unread(routine, given):
            self.line(f"(void){name};")
        for one, variable in zip(program.state, old, strict=which == 1):
            self.call(variable, f"old_{one.name}")
            self.define(variable, f"state->{one.name}")
        self.line()
        self._source = ""
        self.statements(routine.statements)
        self.line()
        states = [f"state->{one.name}" for one in program.state]
        outputs = [f"outputs->{one.name}" for one in block.outputs]
        found = len(routine.results) - len(states)
        for place, value in zip((*states, *outputs[:found]), routine.results, strict=True):
            self.line(f"{place} = {self.text(value)};")
        self._depth -= 1
        self.line("}")

    def definitions(self, which: Collection[Constant]) -> list[str]:
        """Those of some constants, in the order of the code."""
        return [
            f"static const {c_type(one.dtype)} {name} = {self.literal(one)}; /* {said_of(self.program, one)} */"
            for one, name in self.constants.items()
            if one in which
        ]

    def _own_constants(self, routine: int) -> None:
        """Those that one function alone reads stand in it."""
        own = self.definitions(self.read[routine] - self.read[1 - routine])
        for line in own:
            self.line(line)
        if own:
            self.line()

    def literal(self, constant):
        kind, value = str(constant.dtype), constant.value.item()
        if kind == "bool":
            return "true" if value else "false"
        if constant.dtype.kind == "f":
            if np.isfinite(value):
                text = shortest(constant.value) + ("f" if kind == "float32" else "")
            else:
                self.needs_math = True
                text = "NAN" if np.isnan(value) else "INFINITY" if value > 0 else "-INFINITY"
                text = text if kind == "float32" else f"(double){text}"
        else:
            text = {"uint32": f"{value}u", "int64": f"INT64_C({value})", "uint64": f"UINT64_C({value})"}.get(
                kind, str(value)
            )
        return f"({text})" if text.startswith("-") else text

    def remark(self, text):
        return f"/* {text} */"

    def define(self, out, text):
        self.line(f"const {c_type(out.dtype)} {self.name(out)} = {text};")

    def declare(self, out, text):
        zero = self.literal(Constant(np.asarray(0, out.dtype)))
        self.line(f"{c_type(out.dtype)} {self.name(out)} = {text or zero};")

    def assign(self, name, text):
        self.line(f"{name} = {text};")

    def begin_repeat(self, times):
        index = self.unique("i")
        self.line(f"for (uint32_t {index} = 0u; {index} < {times}u; {index}++)")
        self.line("{")

    def begin_if(self, which):
        self.line(f"if ({which})")
        self.line("{")

    def begin_else(self):
        self.line("}")
        self.line("else")
        self.line("{")

    def end(self, what):
        self.line("}")

    def operation(self, one):
        self.define(one.out, self._expression(one))

    def _expression(self, one: Operation) -> str:
        given, name, real = one.given, one.name, one.out.dtype.kind == "f"
        texts = [self.text(value) for value in given]
        logical = given[0].dtype == bool
        if name in _INFIX and not (logical and name in ("and", "or", "xor")):
            return f"{texts[0]} {_INFIX[name]} {texts[1]}"
        if name in _LOGICAL and logical:
            return f"{texts[0]} {_LOGICAL[name]} {texts[1]}"
        if name == "not":
            return f"{'!' if logical else '~'}{texts[0]}"
        if name == "neg":
            return f"-{texts[0]}"
        if name in ("abs", "sqrt") and real:
            self.needs_math = True
            return f"{'fabs' if name == 'abs' else 'sqrt'}{'f' if one.out.dtype == np.float32 else ''}({texts[0]})"
        if name == "abs":
            return f"({texts[0]} < 0) ? -{texts[0]} : {texts[0]}"
        if name in ("max", "min"):
            return _extreme(name, given, texts)
        if name == "select":
            return f"{texts[0]} ? {texts[1]} : {texts[2]}"
        if name == "convert":
            if logical:
                yes, no = (self.literal(Constant(np.asarray(value, one.out.dtype))) for value in (1, 0))
                return f"{texts[0]} ? {yes} : {no}"
            if (given[0].dtype, one.out.dtype) == (self.program.block.dtype, np.int32):
                return self._helped(one, texts)
            return f"({c_type(one.out.dtype)}){texts[0]}"
        if name in ("shift_left", "shift_right_logical"):
            wide = c_type(np.dtype(f"uint{8 * one.out.dtype.itemsize}"))
            sign = "<<" if name == "shift_left" else ">>"
            return f"({c_type(one.out.dtype)})(({wide}){texts[0]} {sign} ({wide}){texts[1]})"
        return self._helped(one, texts)

    def _helped(self, one: Operation, texts: Sequence[str]) -> str:
        types = (one.given[0].dtype, one.out.dtype)
        name = f"bits_of_{c_type(types[0])}" if one.name == "bitcast" else one.name
        self._needed[name] = types
        if one.name in ("ceil", "round_even", "round_away"):
            self._needed["floor"] = types
        self.needs_math = self.needs_math or not self._needed.keys().isdisjoint(("floor", "convert"))
        return f"{_HELPER.get(one.name, name)}({texts[0]})"

    def helpers(self) -> list[str]:
        """Functions that the routines call."""
        real = c_type(self.program.block.dtype)
        single = real == "float"
        words = {
            "real": real,
            "fabs": "fabsf" if single else "fabs",
            "integer": "int32_t" if single else "int64_t",
            "whole": "8388608.0f" if single else "4503599627370496.0",
            "largest": "2147483648.0f" if single else "2147483648.0",
            **{f"n{key}": f"{value}{'f' if single else ''}" for key, value in
               {"0": "0.0", "1": "1.0", "2": "2.0", "half": "0.5"}.items()},
        }  # fmt: skip
        lines: list[str] = []
        order = ["floor", "ceil", "round_even", "round_away", "power_of_two"]
        for name in sorted(self._needed, key=lambda name: order.index(name) if name in order else len(order)):
            given, made = self._needed[name]
            template = _HELPERS["bitcast" if name.startswith("bits_of_") else name]
            text = template % (words | {"given": c_type(given), "made": c_type(made)})
            lines += [*textwrap.dedent(text).strip("\n").split("\n"), ""]
        return lines


def _extreme(name: str, given: Sequence[Value], texts: Sequence[str]) -> str:
    """The larger or smaller of two numbers, NaN if either is."""
    (a, b), (x, y) = given, texts
    sign = "<=" if name == "max" else ">="
    if isinstance(b, Constant) or a.dtype.kind != "f":
        return f"({x} {sign} {y}) ? {y} : {x}"
    if isinstance(a, Constant):
        return f"({y} {sign} {x}) ? {x} : {y}"
    return f"(({x} {'>' if name == 'max' else '<'} {y}) || ({x} != {x})) ? {x} : {y}"


_INFIX = {
    "add": "+", "sub": "-", "mul": "*", "div": "/", "rem": "%", "lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==",
    "ne": "!=", "and": "&", "or": "|", "xor": "^",
}  # fmt: skip
_LOGICAL = {"and": "&&", "or": "||", "xor": "!="}
_HELPER = {
    "floor": "floor_of", "ceil": "ceil_of", "round_even": "nearest", "round_away": "nearest_away", "convert": "integer_of",
}  # fmt: skip
_HELPERS = {
    "convert": """
/* x without its fraction; 0 where no integer is that large, or x is not a number: in C such a conversion is undefined. */
static int32_t integer_of(%(real)s x)
{
    return (%(fabs)s(x) < %(largest)s) ? (int32_t)x : 0;
}
""",
    "floor": """
/* The largest integer that is not above x. */
static %(real)s floor_of(%(real)s x)
{
    %(real)s y = x;
    if (%(fabs)s(x) < %(whole)s)
    {
        const %(real)s whole = (%(real)s)(%(integer)s)x;
        if (whole > x)
        {
            y = whole - %(n1)s;
        }
        else if (whole < x)
        {
            y = whole;
        }
        else
        {
            y = x; /* keeps the sign of zero */
        }
    }
    return y;
}
""",
    "ceil": """
/* The smallest integer that is not below x. */
static %(real)s ceil_of(%(real)s x)
{
    return -floor_of(-x);
}
""",
    "round_even": """
/* The nearest integer, the even one of two. */
static %(real)s nearest(%(real)s x)
{
    const %(real)s size = %(fabs)s(x);
    %(real)s y = floor_of(size);
    const %(real)s rest = size - y;
    const %(real)s half = floor_of(y * %(nhalf)s);
    if ((rest > %(nhalf)s) || ((rest >= %(nhalf)s) && ((%(n2)s * half) < y)))
    {
        y = y + %(n1)s;
    }
    if (x < %(n0)s)
    {
        y = -y;
    }
    return (size > %(n0)s) ? y : x;
}
""",
    "round_away": """
/* The nearest integer, the larger one of two. */
static %(real)s nearest_away(%(real)s x)
{
    const %(real)s size = %(fabs)s(x);
    %(real)s y = floor_of(size);
    if ((size - y) >= %(nhalf)s)
    {
        y = y + %(n1)s;
    }
    if (x < %(n0)s)
    {
        y = -y;
    }
    return (size > %(n0)s) ? y : x;
}
""",
    "power_of_two": """
/* 2 to the power n, exactly; n within the range of exponents. */
static %(real)s power_of_two(int32_t n)
{
    %(real)s power = %(n1)s;
    %(real)s factor = (n < 0) ? %(nhalf)s : %(n2)s;
    uint32_t left = (n < 0) ? (uint32_t)(-n) : (uint32_t)n;
    while (left > 0u)
    {
        if ((left & 1u) != 0u)
        {
            power = power * factor;
        }
        left = left >> 1u;
        if (left > 0u)
        {
            factor = factor * factor;
        }
    }
    return power;
}
""",
    "bitcast": """
/* The bits of a number as another one. */
static %(made)s bits_of_%(given)s(%(given)s x)
{
    union
    {
        %(given)s given;
        %(made)s made;
    } bits;
    bits.given = x;
    return bits.made;
}
""",
}
