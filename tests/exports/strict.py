"""A traced block as generated Python, each operation rounded once: written for these tests, apart from the lowering."""

import math
import struct

import numpy as np
from jax.extend.core import Literal

from jaxbl.fused.elementary import FUNCTIONS
from jaxbl.fused.jaxprs import callee, cond_branches, equation_parameter, scan_parameters, trace_scalar_function

_CODES = {"float32": "f", "float64": "d", "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q"}


def _divide(a, b):
    with np.errstate(all="ignore"):
        return type(a)(np.divide(a, b))


def _square_root(x):
    return math.sqrt(x) if x >= 0.0 else math.nan


def _cast_bits(value, from_type, to_type):
    return struct.unpack(f"<{_CODES[to_type]}", struct.pack(f"<{_CODES[from_type]}", value))[0]


def _round_to_nearest(x):
    return math.copysign(float(round(x)), x)


class Strict:
    """`start(first)` gives the state as a list, `step(state, inputs)` the new state and the outputs."""

    def __init__(self, block):
        self.single = block.dtype == np.float32
        numbers = [self.real(number.value) for number in block.study_numbers.values()]
        self._start = self._compile(block.start, len(numbers))(*numbers)
        self._step = self._compile(block.step, len(numbers))(*numbers)
        self._count = len(block.state)

    def real(self, value):
        return np.float32(value) if self.single else float(value)

    def start(self, first):
        return list(self._start(*map(self.real, first)))

    def step(self, state, inputs):
        leaves = self._step(*state, *inputs)
        return list(leaves[: self._count]), list(leaves[self._count :])

    def _compile(self, closed_jaxpr, fixed_count):
        """Return a function of the first `fixed_count` numbers, which gives that of the rest."""
        names = [f"a{i}" for i in range(len(closed_jaxpr.jaxpr.invars))]
        self._within = False
        self._lines, self._number, self._constants = ([], []), 0, {}
        results = self._write(closed_jaxpr, [(name, i >= fixed_count) for i, name in enumerate(names)], "    ")
        fixed_lines, varying_lines = self._lines
        text = "\n".join(
            [
                f"def make({', '.join(names[:fixed_count])}):",
                *fixed_lines,
                f"    def run({', '.join(names[fixed_count:])}):",
                *(f"    {line}" for line in varying_lines),
                f"        return ({', '.join(name for name, _ in results)},)",
                "    return run",
            ]
        )
        scope = {"sqrt": np.sqrt if self.single else _square_root, "over_zero": _divide, "cast": _cast_bits, "math": math}
        scope |= {"f32": np.float32, "np": np, "nearest": _round_to_nearest} | self._constants
        exec(compile(text, "strict", "exec"), scope)
        return scope["make"]

    def _constant(self, value, dtype):
        if dtype.kind == "f":
            name = f"c{len(self._constants)}"
            self._constants[name] = np.float32(value) if dtype == np.float32 else float(value)
            return name
        return repr(np.asarray(value).item())

    def _write(self, closed_jaxpr, operands, indent):
        """Write lines for a jaxpr. Values are names, and True if they depend on more than fixed numbers."""
        jaxpr = closed_jaxpr.jaxpr
        env = dict(zip(jaxpr.invars, operands, strict=True))
        for v, value in zip(jaxpr.constvars, closed_jaxpr.consts, strict=True):
            env[v] = self._constant(np.asarray(value)[()], np.dtype(v.aval.dtype)), False

        def read(v):
            return (self._constant(v.val, np.dtype(v.aval.dtype)), False) if isinstance(v, Literal) else env[v]

        for eqn in jaxpr.eqns:
            env |= dict(zip(eqn.outvars, self._equation(eqn, [read(v) for v in eqn.invars], indent), strict=True))
        return [read(v) for v in jaxpr.outvars]

    def _new(self):
        self._number += 1
        return f"t{self._number}"

    def _put(self, varies, line, indent):
        self._lines[varies or self._within].append(f"{indent}{line}")

    def _equation(self, eqn, operands, indent):
        name, dtype = eqn.primitive.name, np.dtype(eqn.invars[0].aval.dtype)
        varies = any(operand_varies for _, operand_varies in operands)
        texts = [text for text, _ in operands]
        if (called := callee(eqn)) is not None:
            return self._write(called, operands, indent)
        if name in FUNCTIONS and dtype.kind == "f":
            return self._write(trace_scalar_function(FUNCTIONS[name], dtype), operands, indent)
        if name == "scan":
            times, body, fixed = scan_parameters(eqn)
            state = [self._new() for _ in texts[fixed:]]
            self._put(varies, f"{', '.join(state)}, = {', '.join(texts[fixed:])},", indent)
            self._put(varies, f"for _ in range({times}):", indent)
            inside = [(text, varies) for text in (*texts[:fixed], *state)]
            results = self._body(body, inside, varies, indent)
            self._put(varies, f"{', '.join(state)}, = {', '.join(text for text, _ in results)},", f"{indent}    ")
            return [(name, varies) for name in state]
        if name == "cond" and not eqn.outvars:
            return []
        if name == "cond":
            outs = [self._new() for _ in eqn.outvars]
            for i, branch in enumerate(cond_branches(eqn)):
                self._put(varies, f"if {texts[0]} == {i}:", indent)
                results = self._body(branch, [(text, varies) for text in texts[1:]], varies, indent)
                self._put(varies, f"{', '.join(outs)}, = {', '.join(text for text, _ in results)},", f"{indent}    ")
            return [(name, varies) for name in outs]
        out = self._new()
        self._put(varies, f"{out} = {self._expression(eqn, name, dtype, texts)}", indent)
        return [(out, varies)]

    def _body(self, closed_jaxpr, operands, varies, indent):
        """Write the lines of a loop or a choice: if it varies, all of them stay in it."""
        before, self._within = self._within, self._within or varies
        results = self._write(closed_jaxpr, operands, f"{indent}    ")
        self._within = before
        return results

    def _expression(self, eqn, name, dtype, x):
        constant = self._constant(1.0, dtype) if dtype.kind == "f" else "1"
        if name in _INFIX:
            return f"{x[0]} {_INFIX[name]} {x[1]}"
        if name == "div":
            return (
                f"{x[0]} / {x[1]} if {x[1]} else over_zero({x[0]}, {x[1]})" if dtype.kind == "f" else f"int({x[0]} / {x[1]})"
            )
        if name == "integer_pow":
            power = equation_parameter(eqn, "y")
            product = " * ".join([x[0]] * abs(power))
            return product if power > 0 else f"{constant} / ({product})"
        if name == "select_n":
            return f"{x[2]} if {x[0]} else {x[1]}"
        if name == "convert_element_type":
            new = np.dtype(eqn.outvars[0].aval.dtype)
            return {"f": f"f32({x[0]})" if new == np.float32 else f"float({x[0]})", "b": f"{x[0]} != 0"}.get(
                new.kind, f"int({x[0]})"
            )
        if name == "bitcast_convert_type":
            cast = f"cast({x[0]}, {str(dtype)!r}, {str(eqn.outvars[0].aval.dtype)!r})"
            return f"f32({cast})" if eqn.outvars[0].aval.dtype == np.float32 else cast
        if name == "round":
            rounded = (
                "nearest({})"
                if int(equation_parameter(eqn, "rounding_method"))
                else "math.copysign(math.floor(abs({0}) + 0.5), {0})"
            )
            return f"f32({rounded.format(x[0])})" if self.single else rounded.format(x[0])
        if name == "clamp":
            return f"min(max({x[1]}, {x[0]}), {x[2]})"
        if name == "sign":
            return f"({constant} if {x[0]} > 0 else -{constant} if {x[0]} < 0 else {x[0]})"
        rules = {
            "neg": "-{0}",
            "abs": "abs({0})",
            "square": "{0} * {0}",
            "sqrt": "sqrt({0})",
            "floor": "f32(math.floor({0}))" if self.single else "float(math.floor({0}))",
            "ceil": "f32(math.ceil({0}))" if self.single else "float(math.ceil({0}))",
            "is_finite": "math.isfinite({0})",
            "not": "(not {0})" if dtype.kind == "b" else "~{0}",
            "copy": "{0}",
            **dict.fromkeys(("max", "min"), f"{name}({{0}}, {{1}})"),
            **dict.fromkeys(("broadcast_in_dim", "reshape", "squeeze"), "{0}"),
        }
        assert name in rules, f"strict evaluation does not know {name}"
        return rules[name].format(*x)


_INFIX = {
    "add": "+", "add_any": "+", "sub": "-", "mul": "*", "gt": ">", "ge": ">=", "lt": "<", "le": "<=", "eq": "==", "ne": "!=",
    "and": "&", "or": "|", "xor": "^", "shift_left": "<<", "shift_right_logical": ">>", "rem": "%",
}  # fmt: skip
