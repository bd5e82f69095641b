"""The lanes' part of a step as machine code: one loop over time with the state of a vector of lanes in registers.

Every equation of the jaxpr becomes an instruction on vectors; nothing is left to automatic vectorisation. The code is that
of the machine it runs on. Calls into it release the interpreter's lock, so that threads can share the lanes.
"""

import ctypes
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from llvmlite import binding, ir

from . import Unsupported
from .elementary import FUNCTIONS
from .jaxprs import ClosedJaxpr, JaxprEqn, Literal, Var, parameter, repetition, substituted
from .split import Around

_INT, _BIT, _POINTER = ir.IntType(64), ir.IntType(1), ir.PointerType()
_KINDS = {
    "float32": ir.FloatType(),
    "float64": ir.DoubleType(),
    "int32": ir.IntType(32),
    "uint32": ir.IntType(32),
    "int64": ir.IntType(64),
    "bool": ir.IntType(8),
}
"""How numbers lie in memory."""
Vector = Any
"""A value of LLVM (which has no types that a checker could use): a number in all lanes, or an index."""
_FLAGS = ("contract",)
"""A product and a sum may become one instruction; nothing is reordered, as sums are compensated."""


_BOOL = np.dtype(bool)


def _dtype(v: Var | Literal) -> np.dtype:
    dtype = v.aval.dtype  # pyright: ignore[reportAttributeAccessIssue]
    if str(dtype) not in _KINDS:
        raise Unsupported(f"numbers of type {dtype}")
    return np.dtype(dtype)


def _shape(v: Var | Literal) -> tuple[int, ...]:
    return v.aval.shape  # pyright: ignore[reportAttributeAccessIssue]


def _machine() -> Any:
    """The machine at hand; a new one each time, as an engine owns its own."""
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    features = binding.get_host_cpu_features()
    if features.get("avx512f"):
        # some processors have wide registers and compilers that shun them
        features["prefer-256-bit"] = False
    return binding.Target.from_default_triple().create_target_machine(
        cpu=binding.get_host_cpu_name(), features=features.flatten(), opt=3
    )


def vector_lanes(dtype: np.dtype) -> int:
    """Lanes that are computed together: two of the widest registers, so that one's latency hides behind the other's."""
    features = binding.get_host_cpu_features()
    size = 64 if features.get("avx512f") else 32 if features.get("avx2") else 16
    return 2 * size // dtype.itemsize


class Argument(NamedTuple):
    """An array that a loop reads or writes where it lies.

    Attributes:
        name: for messages, e.g. `input 2`.
        dtype: of its numbers.
        holds: how many: "one", one for each of "lanes" or of "samples", or "both": one for each sample of each lane.
    """

    name: str
    dtype: np.dtype
    holds: str

    def check(self, array: np.ndarray, steps: int, lanes: int) -> None:
        """Refuse an array whose end the loop would pass, or whose numbers it would take for others.

        Raises:
            ValueError: wrong type or length, or not contiguous.
        """
        count = {"one": 1, "lanes": lanes, "samples": steps, "both": steps * lanes}[self.holds]
        if array.dtype != self.dtype or array.size != count or not array.flags.c_contiguous:
            wrong = f"not {array.size} of {array.dtype}"
            raise ValueError(f"{self.name} of a loop needs {count} contiguous numbers of type {self.dtype}, {wrong}")


def signature_of(body: ClosedJaxpr, around: Around | None, values: int, carry: int, fixed: int) -> list[Argument]:
    """The arrays of a loop in their order; arguments as of :class:`Loop`."""
    after, finish = ([], []) if around is None else (around.after.jaxpr.invars, around.finish.jaxpr.invars)
    own, kept = values + carry, body.jaxpr.outvars[carry:]
    results = [] if around is None else around.finish.jaxpr.outvars
    groups: list[tuple[str, Sequence[Any], Any]] = [
        ("value", body.jaxpr.invars[:values], "lanes"),
        ("carry", body.jaxpr.invars[values:own], "lanes"),
        ("fixed number", body.jaxpr.invars[own : own + fixed], "one"),
        ("input", body.jaxpr.invars[own + fixed :], "samples"),
        ("input afterwards", [*after[own:], *finish[own:]], "one"),
        ("kept number", kept, "both"),
        ("result", results, "lanes"),
    ]
    return [Argument(f"{name} {i}", _dtype(v), holds) for name, some, holds in groups for i, v in enumerate(some)]


class Loop:
    """A compiled loop over samples, and what is done around it.

    Args:
        body: jaxpr of one sample, scalars of one lane: values, carry, fixed, one sample's inputs -> carry, and what is kept.
        dtype: of the lanes' numbers.
        values: number of values; they differ from lane to lane.
        carry: numbers that a lane carries.
        fixed: number of those that all lanes read and that differ from call to call.
        around: left out, nothing.
        lanes: that are computed together; left out, as many as suit the machine.

    Raises:
        Unsupported: an operation of theirs is unknown here.
    """

    def __init__(
        self,
        body: ClosedJaxpr,
        dtype: np.dtype,
        *,
        values: int = 0,
        carry: int = 0,
        fixed: int = 0,
        around: Around | None = None,
        lanes: int | None = None,
    ):
        self.lanes = lanes or vector_lanes(dtype)
        body = substituted(body, FUNCTIONS)
        around = None if around is None else Around(*(substituted(part, FUNCTIONS) for part in around))
        self.signature = signature_of(body, around, values, carry, fixed)
        module = ir.Module("loop")
        _Writer(module, self.lanes).loop(body, around, self.signature, values, carry, fixed)
        parsed = binding.parse_assembly(str(module))
        options = binding.create_pipeline_tuning_options(speed_level=3)
        passes = binding.create_pass_builder(_machine(), options)
        passes.getModulePassManager().run(parsed, passes)
        self._engine = binding.create_mcjit_compiler(parsed, _machine())
        self._engine.finalize_object()
        address = self._engine.get_function_address("loop")
        self._call = ctypes.CFUNCTYPE(None, ctypes.c_void_p, *[ctypes.c_int64] * 5)(address)

    def __call__(
        self,
        arrays: "Arrays | Sequence[np.ndarray]",
        steps: int,
        first: int,
        last: int,
        *,
        begins: bool = False,
        ends: bool = False,
    ) -> None:
        """Take lanes `first` to `last` (multiples of `lanes`) through samples; the carry's arrays are overwritten.

        Args:
            arrays: as the signature says; what is kept is written `(steps, lanes)` with no more lanes than run.
            steps: samples.
            first: lane.
            last: lane behind the last one.
            begins: first block of a run: the carry is not read.
            ends: last block of a run: results are written, the carry is not.

        Raises:
            ValueError: arrays that do not fit the signature.
        """
        given = arrays if isinstance(arrays, Arrays) else Arrays(self.signature, arrays, steps, last)
        if steps > given.steps or last > given.lanes:
            raise ValueError(f"{steps} samples of lanes up to {last}: arrays were made for {given.steps} and {given.lanes}")
        self._call(ctypes.addressof(given.addresses), steps, first, last, begins, ends)


class Arrays:
    """Arrays for a loop, which reads where they lie: checked against its signature for so many samples and lanes."""

    def __init__(self, signature: Sequence[Argument], arrays: Sequence[np.ndarray], steps: int, lanes: int):
        if len(arrays) != len(signature):
            raise ValueError(f"a loop needs {len(signature)} arrays, not {len(arrays)}")
        for one, array in zip(signature, arrays, strict=True):
            one.check(array, steps, lanes)
        self.steps, self.lanes, self._kept = steps, lanes, list(arrays)
        self.addresses = (ctypes.c_void_p * len(arrays))(*[x.__array_interface__["data"][0] for x in arrays])


class _Writer:
    """Writes jaxprs as LLVM assembly, every number a vector of lanes."""

    def __init__(self, module: ir.Module, lanes: int):
        self.module, self.lanes = module, lanes
        self.constant: set[Vector] = set()
        """Those that do not change in the loop over time."""

    def loop(
        self,
        body: ClosedJaxpr,
        around: Around | None,
        signature: Sequence[Argument],
        values: int,
        carry: int,
        fixed: int,
    ) -> None:
        function = ir.Function(self.module, ir.FunctionType(ir.VoidType(), [_POINTER, *[_INT] * 5]), "loop")
        # what registers have no room for lies on the stack: no vector of it over two lines of the cache
        function.attributes.alignstack = 64
        function.attributes.add("nounwind")  # without another one it is not written
        table, steps, first, last, begins, ends = function.args
        build: Any = ir.IRBuilder(function.append_basic_block("entry"))
        self.build = build
        own = values + carry
        kept = body.jaxpr.outvars[carry:]
        dtypes = [one.dtype for one in signature]
        kinds = [_KINDS[str(dtype)] for dtype in dtypes]
        if any(not jnp.issubdtype(dtype, jnp.floating) for dtype in dtypes[:own]):
            raise Unsupported("lanes that carry other numbers than floating-point ones")
        arrays = [build.load(build.gep(table, [_INT(i)], source_etype=_POINTER), typ=_POINTER) for i in range(len(dtypes))]

        def scalar(i: int, at: Vector) -> Vector:
            """Element of an array in all lanes."""
            value = build.load(build.gep(arrays[i], [at], source_etype=kinds[i]), typ=kinds[i])
            if dtypes[i] == _BOOL:
                value = build.trunc(value, _BIT)
            nothing = ir.Constant(self.vector(value.type), ir.Undefined)
            one = build.insert_element(nothing, value, ir.IntType(32)(0))
            return build.shuffle_vector(one, nothing, ir.Constant(self.vector(ir.IntType(32)), None))

        inputs = range(own + fixed, len(body.jaxpr.invars))
        steady = [scalar(i, _INT(0)) for i in range(own, own + fixed)]
        end = next((i for i, one in enumerate(signature) if one.name.startswith(("kept", "result"))), len(signature))
        afterwards = [scalar(i, _INT(0)) for i in range(len(body.jaxpr.invars), end)]
        width = build.sub(last, first)

        def lanes(lane: Vector, _: list[Vector]) -> list[Vector]:
            sizes = [dtype.itemsize for dtype in dtypes]

            def read(some: range) -> list[Vector]:
                places = {i: build.gep(arrays[i], [lane], source_etype=kinds[i]) for i in some}
                return [build.load(place, align=sizes[i], typ=self.vector(kinds[i])) for i, place in places.items()]

            def write(i: int, value: Vector, at: Vector) -> None:
                value = build.zext(value, self.vector(kinds[i])) if dtypes[i] == _BOOL else value
                build.store(value, build.gep(arrays[i], [at], source_etype=kinds[i]), align=sizes[i])

            numbers = read(range(values))
            self.constant = {*numbers, *steady}

            def sample(index: Vector, state: list[Vector]) -> list[Vector]:
                found = self.run(body, [*numbers, *state, *steady, *(scalar(i, index) for i in inputs)])
                at = build.add(build.mul(index, width), build.sub(lane, first))
                for i, value in enumerate(found[carry:], end):
                    write(i, value, at)
                return found[:carry]

            def leave() -> list[Vector]:
                for i, value in enumerate(state, values):
                    write(i, value, lane)
                return []

            if around is None:
                state = self.count(_INT(0), steps, read(range(values, own)), sample)
                return leave()
            before, after, closing = around
            behind = len(after.in_avals) - own

            def finish() -> list[Vector]:
                found = self.run(closing, [*numbers, *state, *afterwards[behind:]])
                for i, value in enumerate(found, end + len(kept)):
                    write(i, value, lane)
                return []

            state = self.either(begins, lambda: self.run(before, numbers), lambda: read(range(values, own)))
            state = self.count(_INT(0), steps, state, sample)
            state = self.run(after, [*numbers, *state, *afterwards[:behind]])
            return self.either(ends, finish, leave)

        self.count(first, last, [], lanes, by=self.lanes)
        build.ret_void()

    def either(self, which: Vector, yes: Callable[[], list[Vector]], no: Callable[[], list[Vector]]) -> list[Vector]:
        """yes() if which else no()."""
        build = self.build
        cases = [build.append_basic_block(name) for name in ("yes", "no")]
        behind = build.append_basic_block("behind")
        build.cbranch(build.icmp_signed("!=", which, _INT(0)), *cases)
        ways = []
        for block, case in zip(cases, (yes, no), strict=True):
            build.position_at_end(block)
            ways.append((case(), build.block))
            build.branch(behind)
        build.position_at_end(behind)
        merged = []
        for column in zip(*(found for found, _ in ways), strict=True):
            phi = build.phi(column[0].type)
            for value, (_, block) in zip(column, ways, strict=True):
                phi.add_incoming(value, block)
            merged.append(phi)
        return merged

    def count(
        self,
        first: Vector,
        last: Vector,
        state: list[Vector],
        body: Callable[[Vector, list[Vector]], list[Vector]],
        by: int = 1,
    ) -> list[Vector]:
        """for index in range(first, last, by): state = body(index, state)."""
        build = self.build
        before = build.block
        head, inside, behind = (build.append_basic_block(name) for name in ("head", "body", "behind"))
        build.branch(head)
        build.position_at_end(head)
        index, *carried = (build.phi(value.type) for value in (first, *state))
        for phi, value in zip((index, *carried), (first, *state), strict=True):
            phi.add_incoming(value, before)
        build.cbranch(build.icmp_signed("<", index, last), inside, behind)
        build.position_at_end(inside)
        new = body(index, list(carried))
        new = [build.add(index, _INT(by)), *new]
        for phi, value in zip((index, *carried), new, strict=True):
            phi.add_incoming(value, build.block)
        build.branch(head)
        build.position_at_end(behind)
        return carried

    def run(self, closed: ClosedJaxpr, arguments: Sequence[Vector]) -> list[Vector]:
        """The equations of a jaxpr of scalars."""
        jaxpr = closed.jaxpr
        env: dict[Var, Vector] = dict(zip(jaxpr.invars, arguments, strict=True))
        if any(map(_shape, jaxpr.constvars)):
            raise Unsupported("steps that read tables")
        env |= {v: self.number(value, _dtype(v)) for v, value in zip(jaxpr.constvars, closed.consts, strict=True)}

        def read(v: Var | Literal) -> Vector:
            return self.number(v.val, _dtype(v)) if isinstance(v, Literal) else env[v]

        for eqn in jaxpr.eqns:
            if any(map(_shape, eqn.outvars)):
                raise Unsupported(f"{eqn.primitive.name} of shape {_shape(eqn.outvars[0])}")
            given = [read(v) for v in eqn.invars]
            results = self.equation(eqn, given)
            if all(self.is_constant(value) for value in given):
                self.constant |= set(results)
            env |= dict(zip(eqn.outvars, results, strict=True))
        return [read(v) for v in jaxpr.outvars]

    def equation(self, eqn: JaxprEqn, given: list[Vector]) -> list[Vector]:
        name = eqn.primitive.name
        if name == "scan":
            return self.scan(eqn, given)
        dtype = _dtype(eqn.invars[0])
        rule = (_OF_FLOATS if jnp.issubdtype(dtype, jnp.floating) else _OF_INTEGERS).get(name) or _OF_ALL.get(name)
        if rule is None:
            raise Unsupported(f"{name} of {dtype}")
        return [rule(self, eqn, *given)]

    def scan(self, eqn: JaxprEqn, given: list[Vector]) -> list[Vector]:
        """A loop of fixed length that carries a state: the substeps of a plant."""
        length, inner, fixed = repetition(eqn)
        state = given[fixed:]
        return self.count(_INT(0), _INT(length), state, lambda _, state: self.run(inner, [*given[:fixed], *state]))

    def vector(self, kind: ir.Type) -> ir.VectorType:
        return ir.VectorType(kind, self.lanes)

    def number(self, value: Any, dtype: np.dtype) -> Vector:
        """A literal in all lanes."""
        kind = _BIT if dtype == _BOOL else _KINDS[str(dtype)]
        plain = np.asarray(value, dtype).item()
        return ir.Constant(self.vector(kind), [ir.Constant(kind, plain)] * self.lanes)

    def like(self, vector: Vector, value: float) -> Vector:
        """A number of a vector's type."""
        return ir.Constant(vector.type, [ir.Constant(vector.type.element, value)] * self.lanes)

    def is_constant(self, value: Vector) -> bool:
        return isinstance(value, ir.Constant) or value in self.constant

    def intrinsic(self, name: str, *given: Vector) -> Vector:
        kind = given[0].type
        declared = f"llvm.{name}.v{self.lanes}{'f32' if kind.element == ir.FloatType() else 'f64'}"
        function = self.module.globals.get(declared)
        if function is None:
            function = ir.Function(self.module, ir.FunctionType(kind, [kind] * len(given)), declared)
        return self.build.call(function, given)


def _divide(w: _Writer, eqn: JaxprEqn, a: Vector, b: Vector) -> Vector:
    if w.is_constant(b) and not w.is_constant(a):
        # the reciprocal leaves the loop
        return w.build.fmul(a, w.build.fdiv(w.like(b, 1.0), b), flags=_FLAGS)
    return w.build.fdiv(a, b)


def _sign(w: _Writer, eqn: JaxprEqn, a: Vector) -> Vector:
    below = w.build.select(w.build.fcmp_ordered("<", a, w.like(a, 0.0)), w.like(a, -1.0), a)
    return w.build.select(w.build.fcmp_ordered(">", a, w.like(a, 0.0)), w.like(a, 1.0), below)


def _extreme(order: str) -> Callable[..., Vector]:
    """The larger or smaller of two numbers, NaN if either is."""

    def rule(w: _Writer, eqn: JaxprEqn | None, a: Vector, b: Vector) -> Vector:
        chosen = w.build.select(w.build.fcmp_unordered(order, a, b), a, b)
        return w.build.select(w.build.fcmp_unordered("uno", b, b), b, chosen)

    return rule


_LARGER, _SMALLER = _extreme(">"), _extreme("<")


def _clamp(w: _Writer, eqn: JaxprEqn, low: Vector, a: Vector, high: Vector) -> Vector:
    return _SMALLER(w, eqn, _LARGER(w, eqn, low, a), high)


def _power(w: _Writer, eqn: JaxprEqn, a: Vector) -> Vector:
    power = parameter(eqn, "y")
    if not 1 <= abs(power) <= 8:
        raise Unsupported(f"integer_pow by {power}")
    result = a
    for _ in range(abs(power) - 1):
        result = w.build.fmul(result, a, flags=_FLAGS)
    return result if power > 0 else w.build.fdiv(w.like(a, 1.0), result)


def _comparison(order: str) -> Callable[..., Vector]:
    def rule(w: _Writer, eqn: JaxprEqn, a: Vector, b: Vector) -> Vector:
        dtype = _dtype(eqn.invars[0])
        if jnp.issubdtype(dtype, jnp.floating):
            return (w.build.fcmp_unordered if order == "!=" else w.build.fcmp_ordered)(order, a, b)
        signed = jnp.issubdtype(dtype, jnp.signedinteger)
        return (w.build.icmp_signed if signed else w.build.icmp_unsigned)(order, a, b)

    return rule


def _select(w: _Writer, eqn: JaxprEqn, which: Vector, *cases: Vector) -> Vector:
    if len(cases) != 2 or which.type.element != _BIT:
        raise Unsupported("select_n among more than two")
    return w.build.select(which, cases[1], cases[0])


def _convert(w: _Writer, eqn: JaxprEqn, a: Vector) -> Vector:
    old, new = _dtype(eqn.invars[0]), _dtype(eqn.outvars[0])
    if old == new:
        return a
    if new == _BOOL:
        raise Unsupported(f"conversion of {old} to bool")
    target, wider = w.vector(_KINDS[str(new)]), old == _BOOL or new.itemsize > old.itemsize
    signed = jnp.issubdtype(old, jnp.signedinteger)
    was, becomes = (jnp.issubdtype(dtype, jnp.floating) for dtype in (old, new))
    if was and becomes:
        return (w.build.fpext if wider else w.build.fptrunc)(a, target)
    if was:
        return (w.build.fptosi if jnp.issubdtype(new, jnp.signedinteger) else w.build.fptoui)(a, target)
    if becomes:
        return (w.build.sitofp if signed else w.build.uitofp)(a, target)
    if a.type == target:
        return a
    return (w.build.trunc if not wider else w.build.sext if signed else w.build.zext)(a, target)


_OF_FLOATS: dict[str, Callable[..., Vector]] = {
    "add": lambda w, eqn, a, b: w.build.fadd(a, b, flags=_FLAGS),
    "add_any": lambda w, eqn, a, b: w.build.fadd(a, b, flags=_FLAGS),
    "sub": lambda w, eqn, a, b: w.build.fsub(a, b, flags=_FLAGS),
    "mul": lambda w, eqn, a, b: w.build.fmul(a, b, flags=_FLAGS),
    "div": _divide,
    "neg": lambda w, eqn, a: w.build.fneg(a),
    "square": lambda w, eqn, a: w.build.fmul(a, a, flags=_FLAGS),
    # JAX 0.11's, in derivatives of tanh
    "one_minus_square": lambda w, eqn, a: w.build.fmul(w.build.fadd(w.like(a, 1.0), a), w.build.fsub(w.like(a, 1.0), a)),
    "integer_pow": _power,
    "abs": lambda w, eqn, a: w.intrinsic("fabs", a),
    "sqrt": lambda w, eqn, a: w.intrinsic("sqrt", a),
    "floor": lambda w, eqn, a: w.intrinsic("floor", a),
    "ceil": lambda w, eqn, a: w.intrinsic("ceil", a),
    # lax.RoundingMethod: away from zero, to nearest even
    "round": lambda w, eqn, a: w.intrinsic(("round", "rint")[int(parameter(eqn, "rounding_method"))], a),
    "sign": _sign,
    "max": _LARGER,
    "min": _SMALLER,
    "clamp": _clamp,
    "is_finite": lambda w, eqn, a: w.build.fcmp_ordered("<", w.intrinsic("fabs", a), w.like(a, float("inf"))),
}
_OF_INTEGERS: dict[str, Callable[..., Vector]] = {
    "add": lambda w, eqn, a, b: w.build.add(a, b),
    "sub": lambda w, eqn, a, b: w.build.sub(a, b),
    "mul": lambda w, eqn, a, b: w.build.mul(a, b),
    "shift_left": lambda w, eqn, a, b: w.build.shl(a, b),
    "and": lambda w, eqn, a, b: w.build.and_(a, b),
    "or": lambda w, eqn, a, b: w.build.or_(a, b),
    "xor": lambda w, eqn, a, b: w.build.xor(a, b),
    "not": lambda w, eqn, a: w.build.not_(a),
}
_OF_ALL: dict[str, Callable[..., Vector]] = {
    **{
        name: _comparison(order)
        for name, order in {"gt": ">", "lt": "<", "ge": ">=", "le": "<=", "eq": "==", "ne": "!="}.items()
    },
    "select_n": _select,
    "convert_element_type": _convert,
    "bitcast_convert_type": lambda w, eqn, a: w.build.bitcast(a, w.vector(_KINDS[str(_dtype(eqn.outvars[0]))])),
    **dict.fromkeys(("copy", "copy_p", "broadcast_in_dim", "reshape", "squeeze"), lambda w, eqn, a: a),
}
