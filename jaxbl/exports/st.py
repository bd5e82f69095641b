"""A program in structured text (IEC 61131-3): one function block, with no functions but SQRT, ABS, MIN, MAX, SEL and
conversions between DINT and real numbers."""

from collections.abc import Sequence

import numpy as np

from jaxbl.fused import Unsupported

from .block import Program, describe_number
from .c import C_INFIX, describe_constant
from .lowering import Constant, Operation, Value
from .writer import Writer, write_comment, write_shortest

_TYPES = {"float64": "LREAL", "float32": "REAL", "int32": "DINT", "uint32": "UDINT", "int64": "LINT", "uint64": "ULINT",
          "bool": "BOOL"}  # fmt: skip


def write_st_code(program: Program, head_lines: Sequence[str]) -> str:
    """Write a program as a function block.

    Args:
        program: of a block.
        head_lines: lines for the beginning of the file.

    Raises:
        Unsupported: the program has an operation that structured text cannot express exactly.
    """
    return _St(program).write_block(head_lines)


def st_type(dtype: np.dtype) -> str:
    """Return the type in structured text for numbers of a dtype."""
    return _TYPES[str(dtype)]


class _St(Writer):
    marks = "(*", "*)"

    def __init__(self, program: Program):
        super().__init__(program)
        self._temporary: list[tuple[str, np.dtype]] = []
        self._operation_by_variable: dict[Value, Operation] = {}
        """Operations by the variable that holds their result."""
        for name in ("restart", "started"):
            self.make_unique(name)

    def write_block(self, head_lines: Sequence[str]) -> str:
        """Write the file."""
        program, block = self.program, self.program.block
        for quantity, variable in zip(program.state, program.state_variables, strict=True):
            self.give_name(variable, quantity.name)
        self._depth = 1
        self.add_lines("IF restart OR NOT started THEN")
        self._depth += 1
        self.write_statements(program.start.statements)
        for variable, value in zip(program.state_variables, program.start.results, strict=True):
            self.assign(self.name(variable), self.text(value))
        self.assign("started", "TRUE")
        self._depth -= 1
        self.add_lines("END_IF;", "")
        self._source = ""
        self.write_statements(program.step.statements)
        self.add_lines("")
        count = len(program.state)
        # outputs first: some are states as they were
        for quantity, value in zip(block.outputs, program.step.results[count:], strict=True):
            self.assign(quantity.name, self.text(value))
        self.add_lines("")
        self._assign_together(program.state_variables, program.step.results[:count])
        body = self.lines
        inputs = {quantity.name: quantity for quantity in (*block.start_inputs, *block.inputs)}.values()
        self.lines, self._depth = [write_comment(self.marks, *head_lines)], 0
        self.add_lines(f"FUNCTION_BLOCK {block.name}")
        self._declare_variables(
            "VAR_INPUT",
            [(quantity.name, quantity.dtype, quantity) for quantity in inputs],
            "restart: BOOL := FALSE; (* begin anew *)",
        )
        self._declare_variables("VAR_OUTPUT", [(quantity.name, quantity.dtype, quantity) for quantity in block.outputs])
        constants = [
            f"{name}: {st_type(constant.dtype)} := {self.literal(constant)}; "
            + write_comment(self.marks, describe_constant(program, constant))
            for constant, name in self.constants.items()
        ]
        self._declare_variables("VAR CONSTANT", [], *constants)
        states = [(self.name(variable), variable.dtype, None) for variable in program.state_variables]
        self._declare_variables("VAR", states, "started: BOOL := FALSE;")
        self._declare_variables("VAR_TEMP", [(name, dtype, None) for name, dtype in self._temporary])
        return "\n".join([*self.lines, *body, "END_FUNCTION_BLOCK", ""])

    def _declare_variables(self, kind: str, variables: Sequence[tuple], *more_lines: str) -> None:
        if not variables and not more_lines:
            return
        self.add_lines(kind)
        for name, dtype, quantity in variables:
            remark = f" {write_comment(self.marks, describe_number(quantity))}" if quantity else ""
            self.add_lines(f"    {name}: {st_type(dtype)};{remark}")
        self.add_lines(*(f"    {line}" for line in more_lines), "END_VAR")

    def literal(self, constant):
        kind, value = st_type(constant.dtype), constant.value.item()
        if kind == "BOOL":
            return "TRUE" if value else "FALSE"
        if constant.dtype.kind != "f":
            return f"{kind}#{value}"
        if not np.isfinite(value):
            raise Unsupported("numbers that are not finite")
        text = write_shortest(constant.value).upper()
        mantissa, mark, exponent = text.partition("E")
        # the standard wants a point in each real number
        return f"{kind}#{mantissa if '.' in mantissa else f'{mantissa}.0'}{mark}{exponent}"

    def define(self, out, text):
        self.declare(out, text)

    def declare(self, out, text):
        self._temporary.append((self.name(out), out.dtype))
        if text is not None:
            self.assign(self.name(out), text)

    def assign(self, name, text):
        self.add_lines(f"{name} := {text};")

    def begin_repeat(self, times):
        index = self._add_temporary(np.dtype(np.int32), "turn")
        self.add_lines(f"FOR {index} := 1 TO {times} DO")

    def begin_if(self, condition):
        self.add_lines(f"IF {condition} THEN")

    def begin_else(self):
        self.add_lines("ELSE")

    def end(self, statement):
        self.add_lines("END_FOR;" if statement == "repeat" else "END_IF;")

    def _add_temporary(self, dtype: np.dtype, name: str) -> str:
        """A variable more."""
        unused = self.make_unique(name)
        self._temporary.append((unused, dtype))
        return unused

    def write_operation(self, operation: Operation):
        operands, name, out = operation.operands, operation.name, operation.out
        texts = [self.text(value) for value in operands]
        kind, logical = st_type(out.dtype), operands[0].dtype == bool
        if name == "div" and out.dtype.kind == "f" and not isinstance(operands[1], Constant):
            # controllers stop at a division by zero
            self.declare(out, None)
            zero = f"{kind}#0.0"
            self.add_lines(
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
            self.define(out, f"-{texts[0]}" if not isinstance(operands[0], Constant) else f"-({texts[0]})")
        elif name in ("abs", "sqrt", "min", "max"):
            self.define(out, f"{name.upper()}({', '.join(texts)})")
        elif name == "select":
            self.define(out, f"SEL({texts[0]}, {texts[2]}, {texts[1]})")
        elif name == "convert" and logical:
            no, yes = (self.literal(Constant(np.asarray(value, out.dtype))) for value in (0, 1))
            self.define(out, f"SEL({texts[0]}, {no}, {yes})")
        elif name == "convert" and (operands[0].dtype.kind != "f" or out.dtype.kind == "f" or self._is_integer(operands[0])):
            self.define(out, f"{st_type(operands[0].dtype)}_TO_{kind}({texts[0]})")
        elif name in ("floor", "ceil", "round_even"):
            self._write_rounding(operation, texts[0])
        elif name == "power_of_two":
            self._write_power_of_two(operation, texts[0])
        else:
            raise Unsupported(f"{name} of {operands[0].dtype} in structured text")
        self._operation_by_variable[out] = operation

    def _is_integer(self, value: Value) -> bool:
        """Return True if a value is known to be an integer, which every conversion keeps."""
        operation = self._operation_by_variable.get(value)
        return operation is not None and operation.name in ("floor", "ceil", "round_even")

    def _write_rounding(self, operation: Operation, x: str) -> None:
        """Write a rounding by a conversion, whichever neighbour it takes. Numbers beyond 2^30 stay as they are."""
        kind, out = st_type(operation.out.dtype), self.name(operation.out)
        self.declare(operation.out, None)
        n, remainder = self._add_temporary(np.dtype(np.int32), "near"), self._add_temporary(operation.out.dtype, "rest")
        up, down = f"{out} := {out} + {kind}#1.0;", f"{out} := {out} - {kind}#1.0;"
        odd = f"{n} MOD DINT#2 <> DINT#0"
        fits = {
            "floor": [f"IF {remainder} < {kind}#0.0 THEN", f"    {down}", "END_IF;"],
            "ceil": [f"IF {remainder} > {kind}#0.0 THEN", f"    {up}", "END_IF;"],
            "round_even": [
                f"IF ({remainder} > {kind}#0.5) OR (({remainder} = {kind}#0.5) AND ({odd})) THEN",
                f"    {up}",
                f"ELSIF ({remainder} < {kind}#-0.5) OR (({remainder} = {kind}#-0.5) AND ({odd})) THEN",
                f"    {down}",
                "END_IF;",
            ],
        }[operation.name]
        self.add_lines(
            f"{out} := {x};",
            f"IF ABS({x}) < {kind}#1073741824.0 THEN",
            f"    {n} := {kind}_TO_DINT({x});",
            f"    {out} := DINT_TO_{kind}({n});",
            f"    {remainder} := {x} - {out};",
            *(f"    {line}" for line in fits),
            "END_IF;",
        )

    def _write_power_of_two(self, operation: Operation, n: str) -> None:
        """Write a power of two by squares of 2 or 1 / 2, which are exact."""
        kind, out = st_type(operation.out.dtype), self.name(operation.out)
        self.declare(operation.out, None)
        left, factor = (
            self._add_temporary(np.dtype(np.int32), "remaining"),
            self._add_temporary(operation.out.dtype, "factor"),
        )
        self.add_lines(
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


_INFIX = C_INFIX | {"rem": "MOD", "eq": "=", "ne": "<>", "and": "AND", "or": "OR", "xor": "XOR"}
