"""A program in structured text (IEC 61131-3): one function block, with no functions but SQRT, ABS, MIN, MAX, SEL and
conversions between DINT and real numbers."""

from collections.abc import Sequence

import numpy as np

from jaxbl.fused import Unsupported

from .block import Program
from .c import said_of
from .lowering import Constant, Operation, Value, Variable
from .writer import Writer, plain_text, shortest

_TYPES = {"float64": "LREAL", "float32": "REAL", "int32": "DINT", "uint32": "UDINT", "int64": "LINT", "uint64": "ULINT",
          "bool": "BOOL"}  # fmt: skip


def st_code(program: Program, about: Sequence[str]) -> str:
    """A program as a function block.

    Args:
        program: of a block.
        about: lines for the beginning of the file.

    Raises:
        Unsupported: it does something that structured text has no exact words for.
    """
    return plain_text(_St(program).block(about))


def st_type(dtype: np.dtype) -> str:
    """The type of structured text for numbers of a type."""
    return _TYPES[str(dtype)]


class _St(Writer):
    def __init__(self, program: Program):
        super().__init__(program)
        self._temporary: list[tuple[str, np.dtype]] = []
        self._made: dict[Variable, Operation] = {}
        """Operations by what they make."""
        for name in ("restart", "started"):
            self.unique(name)

    def block(self, about: Sequence[str]) -> str:
        """The whole file."""
        program, block = self.program, self.program.block
        for one, variable in zip(program.state, program.state_variables, strict=True):
            self.call(variable, f"{one.name}")
        self._depth = 1
        self.line("IF restart OR NOT started THEN")
        self._depth += 1
        self.statements(program.start.statements)
        for variable, value in zip(program.state_variables, program.start.results, strict=True):
            self.assign(self.name(variable), self.text(value))
        self.assign("started", "TRUE")
        self._depth -= 1
        self.line("END_IF;")
        self.line()
        self._source = ""
        self.statements(program.step.statements)
        self.line()
        count = len(program.state)
        # outputs first: some are states as they were
        for one, value in zip(block.outputs, program.step.results[count:], strict=True):
            self.assign(one.name, self.text(value))
        self.line()
        self._assigned(program.state_variables, program.step.results[:count])
        body = self.lines
        inputs = {one.name: one for one in (*block.first, *block.inputs)}.values()
        self.lines, self._depth = [f"(* {about[0]}", *(f"   {line}".rstrip() for line in about[1:]), "*)"], 0
        self.line(f"FUNCTION_BLOCK {block.name}")
        self._variables(
            "VAR_INPUT", [(one.name, one.dtype, "", one) for one in inputs], "restart: BOOL := FALSE; (* begin anew *)"
        )
        self._variables("VAR_OUTPUT", [(one.name, one.dtype, "", one) for one in block.outputs])
        constants = [
            f"{name}: {st_type(one.dtype)} := {self.literal(one)}; (* {said_of(program, one)} *)"
            for one, name in self.constants.items()
        ]
        self._variables("VAR CONSTANT", [], *constants)
        states = [(self.name(variable), variable.dtype, "", None) for variable in program.state_variables]
        self._variables("VAR", states, "started: BOOL := FALSE;")
        self._variables("VAR_TEMP", [(name, dtype, "", None) for name, dtype in self._temporary])
        return "\n".join([*self.lines, *body, "END_FUNCTION_BLOCK", ""])

    def _variables(self, kind: str, every: Sequence[tuple], *more: str) -> None:
        if not every and not more:
            return
        self.line(kind)
        for name, dtype, start, about in every:
            said = f" (* {about.about}{f', {about.unit}' if about.unit else ''} *)" if about is not None else ""
            self.line(f"    {name}: {st_type(dtype)}{start};{said}")
        for line in more:
            self.line(f"    {line}")
        self.line("END_VAR")

    def literal(self, constant):
        kind, value = st_type(constant.dtype), constant.value.item()
        if kind == "BOOL":
            return "TRUE" if value else "FALSE"
        if constant.dtype.kind != "f":
            return f"{kind}#{value}"
        if not np.isfinite(value):
            raise Unsupported("numbers that are not finite")
        text = shortest(constant.value).upper()
        mantissa, mark, exponent = text.partition("E")
        # the standard wants a point in each real number
        return f"{kind}#{mantissa if '.' in mantissa else f'{mantissa}.0'}{mark}{exponent}"

    def remark(self, text):
        return f"(* {text} *)"

    def define(self, out, text):
        self._temporary.append((self.name(out), out.dtype))
        self.assign(self.name(out), text)

    def declare(self, out, text):
        self._temporary.append((self.name(out), out.dtype))
        if text is not None:
            self.assign(self.name(out), text)

    def assign(self, name, text):
        self.line(f"{name} := {text};")

    def begin_repeat(self, times):
        index = self._more(np.dtype(np.int32), "turn")
        self.line(f"FOR {index} := 1 TO {times} DO")

    def begin_if(self, which):
        self.line(f"IF {which} THEN")

    def begin_else(self):
        self.line("ELSE")

    def end(self, what):
        self.line("END_FOR;" if what == "repeat" else "END_IF;")

    def _more(self, dtype: np.dtype, name: str) -> str:
        """A variable more."""
        found = self.unique(name)
        self._temporary.append((found, dtype))
        return found

    def operation(self, one: Operation):
        given, name, out = one.given, one.name, one.out
        texts = [self.text(value) for value in given]
        kind, logical = st_type(out.dtype), given[0].dtype == bool
        if name == "div" and out.dtype.kind == "f" and not isinstance(given[1], Constant):
            # controllers stop at a division by zero
            self._temporary.append((self.name(out), out.dtype))
            zero = f"{kind}#0.0"
            self._lines(
                f"IF {texts[1]} <> {zero} THEN",
                f"    {self.name(out)} := {texts[0]} / {texts[1]};",
                "ELSE",
                f"    {self.name(out)} := {zero};",
                "END_IF;",
            )
        elif name in _INFIX and (name not in ("and", "or", "xor") or logical):
            self.define(out, f"{texts[0]} {_INFIX[name]} {texts[1]}")
        elif name == "not" and logical:
            self.define(out, f"NOT {texts[0]}")
        elif name == "neg":
            self.define(out, f"-{texts[0]}" if not isinstance(given[0], Constant) else f"-({texts[0]})")
        elif name in ("abs", "sqrt", "min", "max"):
            self.define(out, f"{name.upper()}({', '.join(texts)})")
        elif name == "select":
            self.define(out, f"SEL({texts[0]}, {texts[2]}, {texts[1]})")
        elif name == "convert" and logical:
            no, yes = (self.literal(Constant(np.asarray(value, out.dtype))) for value in (0, 1))
            self.define(out, f"SEL({texts[0]}, {no}, {yes})")
        elif name == "convert" and (given[0].dtype.kind != "f" or out.dtype.kind == "f" or _is_whole(self._made, given[0])):
            self.define(out, f"{st_type(given[0].dtype)}_TO_{kind}({texts[0]})")
        elif name in ("floor", "ceil", "round_even"):
            self._rounded(one, texts[0])
        elif name == "power_of_two":
            self._power_of_two(one, texts[0])
        else:
            raise Unsupported(f"{name} of {given[0].dtype} in structured text")
        self._made[out] = one

    def _lines(self, *lines: str) -> None:
        for line in lines:
            self.line(line)

    def _rounded(self, one: Operation, x: str) -> None:
        """By a conversion, whichever neighbour it takes; numbers beyond 2^30 are left as they are."""
        kind, out = st_type(one.out.dtype), self.name(one.out)
        self._temporary.append((out, one.out.dtype))
        n, rest = self._more(np.dtype(np.int32), "near"), self._more(one.out.dtype, "rest")
        up, down = f"{out} := {out} + {kind}#1.0;", f"{out} := {out} - {kind}#1.0;"
        odd = f"{n} MOD DINT#2 <> DINT#0"
        fits = {
            "floor": [f"IF {rest} < {kind}#0.0 THEN", f"    {down}", "END_IF;"],
            "ceil": [f"IF {rest} > {kind}#0.0 THEN", f"    {up}", "END_IF;"],
            "round_even": [
                f"IF ({rest} > {kind}#0.5) OR (({rest} = {kind}#0.5) AND ({odd})) THEN",
                f"    {up}",
                f"ELSIF ({rest} < {kind}#-0.5) OR (({rest} = {kind}#-0.5) AND ({odd})) THEN",
                f"    {down}",
                "END_IF;",
            ],
        }[one.name]
        self._lines(
            f"{out} := {x};",
            f"IF ABS({x}) < {kind}#1073741824.0 THEN",
            f"    {n} := {kind}_TO_DINT({x});",
            f"    {out} := DINT_TO_{kind}({n});",
            f"    {rest} := {x} - {out};",
            *(f"    {line}" for line in fits),
            "END_IF;",
        )

    def _power_of_two(self, one: Operation, n: str) -> None:
        """By squares of 2 or 1 / 2, which are exact."""
        kind, out = st_type(one.out.dtype), self.name(one.out)
        self._temporary.append((out, one.out.dtype))
        left, factor = self._more(np.dtype(np.int32), "remaining"), self._more(one.out.dtype, "factor")
        self._lines(
            f"{out} := {kind}#1.0;",
            f"{factor} := SEL({n} < DINT#0, {kind}#2.0, {kind}#0.5);",
            f"{left} := ABS({n});",
            f"WHILE {left} > DINT#0 DO",
            f"    IF {left} MOD DINT#2 <> DINT#0 THEN",
            f"        {out} := {out} * {factor};",
            "    END_IF;",
            f"    {left} := {left} / DINT#2;",
            f"    IF {left} > DINT#0 THEN",
            f"        {factor} := {factor} * {factor};",
            "    END_IF;",
            "END_WHILE;",
        )


def _is_whole(made: dict[Variable, Operation], value: Value) -> bool:
    """Whether a number is known to be an integer, which every conversion keeps."""
    return isinstance(value, Variable) and value in made and made[value].name in ("floor", "ceil", "round_even")


_INFIX = {
    "add": "+", "sub": "-", "mul": "*", "div": "/", "rem": "MOD", "lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "=",
    "ne": "<>", "and": "AND", "or": "OR", "xor": "XOR",
}  # fmt: skip
