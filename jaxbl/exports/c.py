"""A program in C99: one source file and one header, without allocation and without libm beyond sqrt and fabs."""

import re
import textwrap
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from .block import Port, Program, describe_number
from .lowering import Constant, Operation, Routine, Value, Variable, find_constants
from .writer import Writer, find_unread_names, write_comment, write_shortest

_TYPES = {"float64": "double", "float32": "float", "bool": "bool"}
C_MARKS = "/*", "*/"


class Code(NamedTuple):
    """Texts of the source file and of the header."""

    source: str
    header: str


def c_type(dtype: np.dtype) -> str:
    """Return the C type for numbers of a dtype."""
    return _TYPES.get(str(dtype), f"{dtype}_t")


def write_c_code(program: Program, head_lines: Sequence[str]) -> Code:
    """Write a program in C.

    Args:
        program: of a block.
        head_lines: lines for the beginning of both files.
    """
    name = program.block.name
    writer = _C(program)
    writer.write_routines()
    head = write_comment(C_MARKS, *head_lines)
    constants = writer.define_constants(writer.shared_constants)
    includes = [f'#include "{name}.h"', "", *(["#include <math.h>", ""] if writer.needs_math else [])]
    parts = [head, "", *includes, *constants, "" if constants else None, *writer.write_helpers(), *writer.lines]
    source = "\n".join(part for part in parts if part is not None)
    return Code(f"{source.rstrip()}\n", _write_header(program, head))


def describe_constant(program: Program, constant: Constant) -> str:
    """Say for a comment which number of the study a constant is, or how it follows from them."""
    study_number = program.block.study_numbers.get(constant.formula)
    if study_number is None:
        return constant.formula.removeprefix("(").removesuffix(")") if constant.formula.startswith("(") else constant.formula
    return f"{constant.formula}: {describe_number(study_number)}"


def _write_header(program: Program, head: str) -> str:
    block, name = program.block, program.block.name
    guard = f"{name.upper()}_H"
    start, step = write_signatures(program)
    state = "\n".join(_write_struct(f"{name}_state", program.state))
    outputs = "\n".join(_write_struct(f"{name}_outputs", block.outputs))
    return f"""{head}

#ifndef {guard}
#define {guard}

#include <stdbool.h>
#include <stdint.h>

/* What is carried from sample to sample: for init and step alone. */
{state}
/* What step finds. */
{outputs}
/* Before the first sample. */
{start};

/* At every sample, at the period of the study. */
{step};

#endif /* {guard} */
"""


def write_signatures(program: Program) -> tuple[str, str]:
    """Write the declarations of init and step, without semicolons."""
    block, name = program.block, program.block.name
    first, inputs = (
        [f"{c_type(quantity.dtype)} {quantity.name}" for quantity in quantities]
        for quantities in (block.start_inputs, block.inputs)
    )
    outputs = f"{name}_outputs *outputs"
    start = ", ".join([f"{name}_state *state", *first, *[outputs] * (len(program.start.results) > len(program.state))])
    step = ", ".join([f"{name}_state *state", *inputs, outputs])
    return f"void {name}_init({start})", f"void {name}_step({step})"


def _write_struct(name: str, members: Sequence[Port]) -> list[str]:
    lines = ["typedef struct", "{"]
    for member in members:
        remark = f" {write_comment(C_MARKS, describe_number(member))}" if member.description else ""
        lines.append(f"    {c_type(member.dtype)} {member.name};{remark}")
    return [*lines, f"}} {name};", ""]


class _C(Writer):
    marks, assignment = C_MARKS, "="
    choice, otherwise = "if (%s)\n{", "}\nelse\n{"
    end_choice = end_repeat = "}"

    def __init__(self, program: Program):
        super().__init__(program)
        self.needs_math = False
        self._helper_types: dict[str, tuple[np.dtype, ...]] = {}
        """Argument and result type of each helper function that the code calls, by its name."""
        self.shared_constants = set(find_constants(program.start)).intersection(find_constants(program.step))

    def write_routines(self) -> None:
        """Write init and step."""
        program, block = self.program, self.program.block
        start, step = write_signatures(program)
        self._write_function(start, program.start, block.start_inputs, ())
        self.add_lines("")
        self._write_function(step, program.step, block.inputs, program.state_variables)

    def _write_function(
        self, head: str, routine: Routine, arguments: Sequence[Port], state_variables: Sequence[Variable]
    ) -> None:
        """One of the two; `state_variables` are variables for the state that it finds."""
        program, block = self.program, self.program.block
        self.add_lines(head, "{")
        self._depth += 1
        # constants that only this routine reads
        definitions = self.define_constants(set(find_constants(routine)) - self.shared_constants)
        self.add_lines(*definitions, *([""] if definitions else []))
        self.add_lines(*(f"(void){name};" for name in find_unread_names(routine, arguments)))
        for quantity, variable in zip(program.state, state_variables, strict=False):
            self.give_name(variable, f"old_{quantity.name}")
            self.define(variable, f"state->{quantity.name}")
        self.add_lines("")
        self._source = ""
        self.write_statements(routine.statements)
        self.add_lines("")
        places = [f"state->{quantity.name}" for quantity in program.state]
        outputs = [f"outputs->{quantity.name}" for quantity in block.outputs]
        output_count = len(routine.results) - len(places)
        for place, value in zip((*places, *outputs[:output_count]), routine.results, strict=True):
            self.assign(place, self.text(value))
        self._depth -= 1
        self.add_lines("}")

    def define_constants(self, constants: Collection[Constant]) -> list[str]:
        """Write definitions of constants, in the order of the code."""
        return [
            f"static const {c_type(constant.dtype)} {name} = {self.literal(constant)}; "
            f"{write_comment(C_MARKS, describe_constant(self.program, constant))}"
            for constant, name in self.constants.items()
            if constant in constants
        ]

    def literal(self, constant):
        kind, value = str(constant.dtype), constant.value.item()
        if kind == "bool":
            return "true" if value else "false"
        if constant.dtype.kind == "f":
            if np.isfinite(value):
                text = write_shortest(constant.value) + ("f" if kind == "float32" else "")
            else:
                self.needs_math = True
                text = "NAN" if np.isnan(value) else "INFINITY" if value > 0 else "-INFINITY"
                text = text if kind == "float32" else f"(double){text}"
        else:
            text = {"uint32": f"{value}u", "int64": f"INT64_C({value})", "uint64": f"UINT64_C({value})"}.get(
                kind, str(value)
            )
        return f"({text})" if text.startswith("-") else text

    def define(self, out, text):
        self.add_lines(f"const {c_type(out.dtype)} {self.name(out)} = {text};")

    def declare(self, out, text):
        zero = self.literal(Constant(np.asarray(0, out.dtype)))
        self.add_lines(f"{c_type(out.dtype)} {self.name(out)} = {text or zero};")

    def begin_repeat(self, times):
        index = self.make_unique("i")
        self.add_lines(f"for (uint32_t {index} = 0u; {index} < {times}u; {index}++)", "{")

    def write_operation(self, operation):
        self.define(operation.out, self._write_expression(operation))

    def _write_expression(self, operation: Operation) -> str:
        operands, name, real = operation.operands, operation.name, operation.out.dtype.kind == "f"
        texts = [self.text(value) for value in operands]
        logical = operands[0].dtype == bool
        if name in C_INFIX and not (logical and name in ("and", "or", "xor")):
            return f"{texts[0]} {C_INFIX[name]} {texts[1]}"
        if name in _LOGICAL and logical:
            return f"{texts[0]} {_LOGICAL[name]} {texts[1]}"
        if name == "not":
            return f"{'!' if logical else '~'}{texts[0]}"
        if name == "neg":
            return f"-{texts[0]}"
        if name in ("abs", "sqrt") and real:
            self.needs_math = True
            return f"{'fabs' if name == 'abs' else 'sqrt'}{'f' if operation.out.dtype == np.float32 else ''}({texts[0]})"
        if name == "abs":
            return f"({texts[0]} < 0) ? -{texts[0]} : {texts[0]}"
        if name in ("max", "min"):
            return _write_extreme(name, operands, texts)
        if name == "select":
            return f"{texts[0]} ? {texts[1]} : {texts[2]}"
        if name == "convert":
            if logical:
                yes, no = (self.literal(Constant(np.asarray(value, operation.out.dtype))) for value in (1, 0))
                # small whole literals would have a narrower type
                cast = f"({c_type(operation.out.dtype)})"
                return f"{texts[0]} ? {cast}{yes} : {cast}{no}"
            if (operands[0].dtype, operation.out.dtype) == (self.program.block.dtype, np.int32):
                return self._call_helper(operation, texts)
            return f"({c_type(operation.out.dtype)}){texts[0]}"
        if name in ("shift_left", "shift_right_logical"):
            wide = c_type(np.dtype(f"uint{8 * operation.out.dtype.itemsize}"))
            sign = "<<" if name == "shift_left" else ">>"
            return f"({c_type(operation.out.dtype)})(({wide}){texts[0]} {sign} ({wide}){texts[1]})"
        return self._call_helper(operation, texts)

    def _call_helper(self, operation: Operation, texts: Sequence[str]) -> str:
        types = (operation.operands[0].dtype, operation.out.dtype)
        name = f"bits_of_{c_type(types[0])}" if operation.name == "bitcast" else operation.name
        self._helper_types[name] = types
        if operation.name in ("ceil", "round_even", "round_away"):
            self._helper_types["floor"] = types
        self.needs_math = self.needs_math or not self._helper_types.keys().isdisjoint(("floor", "convert"))
        return f"{_HELPER.get(operation.name, name)}({texts[0]})"

    def write_helpers(self) -> list[str]:
        """Write the helper functions that the routines call."""
        real = c_type(self.program.block.dtype)
        single = real == "float"
        words = {
            "real": real,
            "fabs": "fabsf" if single else "fabs",
            "integer": "int32_t" if single else "int64_t",
            "whole": "8388608.0" if single else "4503599627370496.0",
        }
        lines = list[str]()
        # those that call floor after it
        for name in sorted(self._helper_types, key="floor".__ne__):
            argument_type, result_type = self._helper_types[name]
            template = _HELPERS["bitcast" if name.startswith("bits_of_") else name]
            text = template % (words | {"given": c_type(argument_type), "made": c_type(result_type)})
            text = re.sub(r"\d\.\d", r"\g<0>f", text) if single else text
            lines += [*textwrap.dedent(text).strip("\n").split("\n"), ""]
        return lines


def _write_extreme(name: str, operands: Sequence[Value], texts: Sequence[str]) -> str:
    """Write the larger or smaller of two numbers, NaN if either is NaN."""
    (a, b), (x, y) = operands, texts
    sign = "<=" if name == "max" else ">="
    if isinstance(b, Constant) or a.dtype.kind != "f":
        return f"({x} {sign} {y}) ? {y} : {x}"
    if isinstance(a, Constant):
        return f"({y} {sign} {x}) ? {x} : {y}"
    return f"(({x} {'>' if name == 'max' else '<'} {y}) || ({x} != {x})) ? {x} : {y}"


C_INFIX = {
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
    return (%(fabs)s(x) < 2147483648.0) ? (int32_t)x : 0;
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
            y = whole - 1.0;
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
    const %(real)s half = floor_of(y * 0.5);
    if ((rest > 0.5) || ((rest >= 0.5) && ((2.0 * half) < y)))
    {
        y = y + 1.0;
    }
    if (x < 0.0)
    {
        y = -y;
    }
    return (size > 0.0) ? y : x;
}
""",
    "round_away": """
/* The nearest integer, the larger one of two. */
static %(real)s nearest_away(%(real)s x)
{
    const %(real)s size = %(fabs)s(x);
    %(real)s y = floor_of(size);
    if ((size - y) >= 0.5)
    {
        y = y + 1.0;
    }
    if (x < 0.0)
    {
        y = -y;
    }
    return (size > 0.0) ? y : x;
}
""",
    "power_of_two": """
/* 2 to the power n, exactly; n within the range of exponents. */
static %(real)s power_of_two(int32_t n)
{
    %(real)s power = 1.0;
    %(real)s factor = (n < 0) ? 0.5 : 2.0;
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
