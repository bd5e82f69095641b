"""A program in structured text (IEC 61131-3): one function block, with no functions but SQRT, ABS, MIN, MAX, SEL and
conversions between DINT and real numbers."""

from collections.abc import Sequence

import numpy as np

from jaxbl.fused import Unsupported

from .block import Port, Program, describe_number
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
    marks, assignment = ("(*", "*)"), ":="
    choice, otherwise, end_choice = "IF %s THEN", "ELSE", "END_IF;"
    end_repeat = "END_FOR;"

    def __init__(self, program: Program):
        super().__init__(program)
        self._temporary: list[str] = []
        """Declarations of variables that keep nothing from sample to sample."""
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
        declarations = {
            "VAR_INPUT": [*map(self._declare_port, inputs), "restart: BOOL := FALSE; (* begin anew *)"],
            "VAR_OUTPUT": [*map(self._declare_port, block.outputs)],
            "VAR CONSTANT": [
                f"{name}: {st_type(constant.dtype)} := {self.literal(constant)}; "
                + write_comment(self.marks, describe_constant(program, constant))
                for constant, name in self.constants.items()
            ],
            "VAR": [
                *(f"{self.name(variable)}: {st_type(variable.dtype)};" for variable in program.state_variables),
                "started: BOOL := FALSE;",
            ],
            "VAR_TEMP": self._temporary,
        }
        for kind, lines in declarations.items():
            if lines:
                self.add_lines(kind, *(f"    {line}" for line in lines), "END_VAR")
        return "\n".join([*self.lines, *body, "END_FUNCTION_BLOCK", ""])

    def _declare_port(self, port: Port) -> str:
        return f"{port.name}: {st_type(port.dtype)}; {write_comment(self.marks, describe_number(port))}"

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

    def declare(self, out, text):
        self._temporary.append(f"{self.name(out)}: {st_type(out.dtype)};")
        if text is not None:
            self.assign(self.name(out), text)

    def begin_repeat(self, times):
        index = self._add_temporary("DINT", "turn")
        self.add_lines(f"FOR {index} := 1 TO {times} DO")

    def _add_temporary(self, dtype: str, name: str) -> str:
        """A variable more."""
        unused = self.make_unique(name)
        self._temporary.append(f"{unused}: {dtype};")
        return unused

    def write_operation(self, operation: Operation):
        operands, name, out = operation.operands, operation.name, operation.out
        texts = [self.text(value) for value in operands]
        kind, logical = st_type(out.dtype), operands[0].dtype == bool
        if name == "div" and out.dtype.kind == "f" and not isinstance(operands[1], Constant):
            # controllers stop at a division by zero
            self.declare(out, None)
            self.add_lines(f"""IF {texts[1]} <> {kind}#0.0 THEN
    {self.name(out)} := {texts[0]} / {texts[1]};
ELSE
    {self.name(out)} := {kind}#0.0;
END_IF;""")
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
        n, remainder = self._add_temporary("DINT", "near"), self._add_temporary(kind, "rest")
        odd = f"{n} MOD DINT#2 <> DINT#0"
        fit = {
            "floor": f"""    IF {remainder} < {kind}#0.0 THEN
        {out} := {out} - {kind}#1.0;""",
            "ceil": f"""    IF {remainder} > {kind}#0.0 THEN
        {out} := {out} + {kind}#1.0;""",
            "round_even": f"""    IF ({remainder} > {kind}#0.5) OR (({remainder} = {kind}#0.5) AND ({odd})) THEN
        {out} := {out} + {kind}#1.0;
    ELSIF ({remainder} < {kind}#-0.5) OR (({remainder} = {kind}#-0.5) AND ({odd})) THEN
        {out} := {out} - {kind}#1.0;""",
        }[operation.name]
        self.add_lines(f"""{out} := {x};
IF ABS({x}) < {kind}#1073741824.0 THEN
    {n} := {kind}_TO_DINT({x});
    {out} := DINT_TO_{kind}({n});
    {remainder} := {x} - {out};
{fit}
    END_IF;
END_IF;""")

    def _write_power_of_two(self, operation: Operation, n: str) -> None:
        """Write a power of two by squares of 2 or 1 / 2, which are exact."""
        kind, out = st_type(operation.out.dtype), self.name(operation.out)
        self.declare(operation.out, None)
        left, factor = self._add_temporary("DINT", "remaining"), self._add_temporary(kind, "factor")
        self.add_lines(f"""{out} := {kind}#1.0;
{factor} := SEL({n} < DINT#0, {kind}#2.0, {kind}#0.5);
{left} := ABS({n});
WHILE {left} > DINT#0 DO
    IF {left} MOD DINT#2 <> DINT#0 THEN
        {out} := {out} * {factor};
    END_IF;
    {left} := {left} / DINT#2;
    IF {left} > DINT#0 THEN
        {factor} := {factor} * {factor};
    END_IF;
END_WHILE;""")


_INFIX = C_INFIX | {"rem": "MOD", "eq": "=", "ne": "<>", "and": "AND", "or": "OR", "xor": "XOR"}
