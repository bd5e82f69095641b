"""The lanes' part of a step as machine code: one loop over time with the state of a vector of lanes in registers.

Every equation of the jaxpr becomes an instruction on vectors; nothing is left to automatic vectorisation. The code is that
of the machine it runs on. Calls into it release the interpreter's lock, so that threads can share the lanes.
"""

import ctypes
from array import array
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from llvmlite import binding, ir

from . import Unsupported
from .dependence import LoopHooks
from .elementary import FUNCTIONS
from .jaxprs import ClosedJaxpr, JaxprEqn, Literal, Var, callee, equation_parameter, scan_parameters, trace_scalar_function

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
_NUMBERS = 7
"""That a loop is given beside its arrays."""
Vector = Any
"""A value of LLVM (which has no types that a checker could use): a number in all lanes, or an index."""
_FLAGS = ("contract",)
"""A product and a sum may become one instruction; nothing is reordered, as sums are compensated."""
_BOOL = np.dtype(bool)


def _dtype(v: Any) -> np.dtype:
    """Of a variable or literal of a jaxpr."""
    if str(v.aval.dtype) not in _KINDS:
        raise Unsupported(f"numbers of type {v.aval.dtype}")
    return np.dtype(v.aval.dtype)


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


class ArraySpec(NamedTuple):
    """An array that a loop reads or writes where it lies: its group and place there (`input 2`), type, and how many numbers
    it holds: "one", one for each of "lanes", of "samples" or of "blocks" of samples, or "both": one for each sample of each
    lane; "marks": for each block of each lane. So many, from this one on, are of one type and hold as many."""

    name: str
    dtype: np.dtype
    holds: str
    alike: int

    def check(self, array: np.ndarray, counts: dict[str, int]) -> None:
        """Refuse an array of wrong type or length, or with gaps, by `ValueError`."""
        count = counts[self.holds]
        if array.dtype != self.dtype or array.size != count or not array.flags.c_contiguous:
            wrong = f"not {array.size} of {array.dtype}"
            raise ValueError(f"{self.name} of a loop needs {count} contiguous numbers of type {self.dtype}, {wrong}")


def loop_signature(
    body: ClosedJaxpr,
    after: ClosedJaxpr | None,
    finish: ClosedJaxpr | None,
    values: int,
    carry: int,
    fixed: int,
    beside: int = 0,
) -> list[ArraySpec]:
    """The arrays of a loop in their order; arguments as of :class:`Loop` and :class:`LoopHooks`."""
    own, read = values + carry, body.jaxpr.invars
    groups: list[tuple[str, str, Sequence[Any]]] = [
        ("value", "lanes", read[:values]),
        ("carry", "lanes", read[values:own]),
        ("fixed number", "one", read[own : own + fixed]),
        ("input", "samples", read[own + fixed : len(read) - beside]),
        ("lane's input", "both", read[len(read) - beside :]),
        ("input of a block", "blocks", after.jaxpr.invars[own:] if after else []),
        ("input at the end", "one", finish.jaxpr.invars[own:] if finish else []),
        ("kept number", "both", body.jaxpr.outvars[carry:]),
        ("mark of a block", "marks", after.jaxpr.outvars[carry:] if after else []),
        ("result", "lanes", finish.jaxpr.outvars if finish else []),
    ]
    found: list[ArraySpec] = []
    every = [(f"{name} {i}", _dtype(v), holds) for name, holds, some in groups for i, v in enumerate(some)]
    for one in reversed(every):
        found.append(ArraySpec(*one, 1 + found[-1].alike if found and found[-1][1:3] == one[1:] else 1))
    return found[::-1]


class Loop:
    """A compiled loop over samples, and what is done around it.

    Args:
        body: jaxpr of one sample, scalars of one lane: values, carry, fixed, one sample's inputs, the last of them of this
            lane alone -> carry, and what is kept.
        dtype: of the lanes' numbers.
        values, carry, fixed, beside: how many differ from lane to lane, a lane carries, all lanes read unchanged in a call,
            and a lane alone reads at each sample.
        around: left out, nothing; or `after` alone, what follows each block.
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
        beside: int = 0,
        around: LoopHooks | None = None,
        after: ClosedJaxpr | None = None,
        lanes: int | None = None,
    ):
        self.lanes = lanes or vector_lanes(dtype)
        after = around.after if around else after
        self.signature = loop_signature(body, after, around and around.finish, values, carry, fixed, beside)
        module = ir.Module("loop")
        _Writer(module, self.lanes).loop(body, around, after, self.signature)
        parsed = binding.parse_assembly(str(module))
        options = binding.create_pipeline_tuning_options(speed_level=3)
        passes = binding.create_pass_builder(_machine(), options)
        passes.getModulePassManager().run(parsed, passes)
        self._load(_machine().emit_object(parsed))

    def _load(self, code: bytes) -> None:
        self._code = code
        self._engine = binding.create_mcjit_compiler(binding.parse_assembly(""), _machine())
        self._engine.add_object_file(binding.ObjectFileRef.from_data(code))
        self._engine.finalize_object()
        address = self._engine.get_function_address("loop")
        self._call = ctypes.CFUNCTYPE(None, ctypes.c_void_p, *[ctypes.c_int64] * _NUMBERS)(address)

    def __getstate__(self) -> tuple[int, list[ArraySpec], bytes]:
        return self.lanes, self.signature, self._code

    def __setstate__(self, state: tuple[int, list[ArraySpec], bytes]) -> None:
        self.lanes, self.signature, code = state
        self._load(code)

    def __call__(
        self,
        arrays: "LoopArrays | ArrayGroups",
        steps: int,
        first: int,
        last: int,
        *,
        start: int = 0,
        block: int | None = None,
        begins: bool = False,
        ends: bool = False,
    ) -> None:
        """Take lanes from `first` up to `last` (multiples of `lanes`) through samples; the carry's arrays are overwritten.

        What is kept is written `(steps, lanes)`, marks `(blocks, lanes)`, with no more lanes than run. Samples come in
        blocks of `block`, all in one where it is left out; `start`, where a block begins, is the first of those up to
        `steps` that are run. What `begins` a run does not read the carry; what `ends` it writes results in its place.
        `ValueError` for arrays that do not fit the signature.
        """
        given = arrays if isinstance(arrays, LoopArrays) else LoopArrays(self.signature, arrays, steps, last, block)
        if steps > given.steps or last > given.lanes:
            raise ValueError(f"{steps} samples of lanes up to {last}: arrays were made for {given.steps} and {given.lanes}")
        if start % given.block:
            raise ValueError(f"no block of {given.block} samples begins at {start}")
        self._call(given.table, start, steps, given.block, first, last, begins, ends)


class ArrayRows(NamedTuple):
    """In the place of several arrays for a loop: the rows of one, which lie one behind the other."""

    array: np.ndarray


class AddressedArrays:
    """In the place of several arrays for a loop: these, and where they lie, which takes NumPy long to say."""

    def __init__(self, arrays: Sequence[np.ndarray]):
        self.arrays, self.addresses = arrays, [_address(one) for one in arrays]


ArrayGroups = Sequence[np.ndarray | ArrayRows | AddressedArrays]


class LoopArrays:
    """Arrays for a loop, which reads where they lie: checked against its signature for so many samples, in blocks of so
    many, and lanes."""

    def __init__(
        self, signature: Sequence[ArraySpec], arrays: ArrayGroups, steps: int, lanes: int, block: int | None = None
    ):
        self.steps, self.lanes, self.block = steps, lanes, block or max(steps, 1)
        blocks = -(-steps // self.block)
        counts = {
            "one": 1, "lanes": lanes, "samples": steps, "blocks": blocks, "both": steps * lanes, "marks": blocks * lanes
        }  # fmt: skip
        count = sum(_count(one) for one in arrays)
        if count != len(signature):
            raise ValueError(f"a loop needs {len(signature)} arrays, not {count}")
        addresses: list[int] = []
        for one in arrays:
            each = signature[len(addresses) : len(addresses) + _count(one)]
            if isinstance(one, AddressedArrays):
                for argument, own in zip(each, one.arrays, strict=True):
                    argument.check(own, counts)
                addresses += one.addresses
            elif not isinstance(one, ArrayRows):
                each[0].check(one, counts)
                addresses.append(_address(one))
            elif each:
                each[0].check(one.array[:1], counts)
                if each[0].alike < len(each) or not one.array.flags.c_contiguous:
                    odd = each[each[0].alike] if each[0].alike < len(each) else each[0]
                    raise ValueError(f"{odd.name} of a loop is no row of one array")
                begin, stride = _address(one.array), one.array.strides[0]
                addresses += range(begin, begin + len(each) * stride, stride)
        # an array of ctypes takes twenty times as long to make
        self._kept, self._table = list(arrays), array("Q", addresses)
        self.table = self._table.buffer_info()[0]


def _count(one: np.ndarray | ArrayRows | AddressedArrays) -> int:
    return len(one.array) if isinstance(one, ArrayRows) else len(one.arrays) if isinstance(one, AddressedArrays) else 1


def _address(one: np.ndarray) -> int:
    return one.__array_interface__["data"][0]


class _Writer:
    """Writes jaxprs as LLVM assembly, every number a vector of lanes."""

    def __init__(self, module: ir.Module, lanes: int):
        self.module, self.lanes = module, lanes
        self.constant: set[Vector] = set()
        """Those that do not change in the loop over time."""

    def loop(
        self, body: ClosedJaxpr, around: LoopHooks | None, after: ClosedJaxpr | None, signature: Sequence[ArraySpec]
    ) -> None:
        function = ir.Function(self.module, ir.FunctionType(ir.VoidType(), [_POINTER, *[_INT] * _NUMBERS]), "loop")
        # what registers have no room for lies on the stack: no vector of it over two lines of the cache
        function.attributes.alignstack = 64
        function.attributes.add("nounwind")  # without another one it is not written
        table, start, steps, length, first, last, begins, ends = function.args
        build: Any = ir.IRBuilder(function.append_basic_block("entry"))
        self.build = build
        group: defaultdict[str, list[int]] = defaultdict(list)
        for i, one in enumerate(signature):
            group[one.name.rpartition(" ")[0]].append(i)
        own, carry = [*group["value"], *group["carry"]], len(group["carry"])
        dtypes = [one.dtype for one in signature]
        kinds = [_KINDS[str(dtype)] for dtype in dtypes]
        if any(not jnp.issubdtype(dtypes[i], jnp.floating) for i in own):
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

        steady = [scalar(i, _INT(0)) for i in group["fixed number"]]
        at_end = [scalar(i, _INT(0)) for i in group["input at the end"]]
        width = build.sub(last, first)

        def lanes(lane: Vector, _: list[Vector]) -> list[Vector]:
            def read(name: str, place: Vector = lane) -> list[Vector]:
                places = {i: build.gep(arrays[i], [place], source_etype=kinds[i]) for i in group[name]}
                return [build.load(at, align=dtypes[i].itemsize, typ=self.vector(kinds[i])) for i, at in places.items()]

            def write(name: str, values: Sequence[Vector], at: Vector) -> list[Vector]:
                for i, value in zip(group[name], values, strict=True):
                    value = build.zext(value, self.vector(kinds[i])) if dtypes[i] == _BOOL else value
                    build.store(value, build.gep(arrays[i], [at], source_etype=kinds[i]), align=dtypes[i].itemsize)
                return []

            numbers = read("value")
            self.constant = {*numbers, *steady}

            def sample(index: Vector, state: list[Vector]) -> list[Vector]:
                place = build.add(build.mul(index, width), build.sub(lane, first))
                own = read("lane's input", place)
                found = self.run(body, [*numbers, *state, *steady, *(scalar(i, index) for i in group["input"]), *own])
                write("kept number", found[carry:], place)
                return found[:carry]

            if after is None:
                return write("carry", self.count(start, steps, read("carry"), sample), lane)

            def block(begin: Vector, state: list[Vector]) -> list[Vector]:
                end = build.add(begin, length)
                state = self.count(begin, build.select(build.icmp_signed("<", end, steps), end, steps), state, sample)
                number = build.sdiv(begin, length)
                found = self.run(after, [*numbers, *state, *(scalar(i, number) for i in group["input of a block"])])
                write("mark of a block", found[carry:], build.add(build.mul(number, width), build.sub(lane, first)))
                return found[:carry]

            if around is None:
                return write("carry", self.count(start, steps, read("carry"), block, by=length), lane)
            before, finish = around.before, around.finish
            state = self.either(begins, lambda: self.run(before, numbers), lambda: read("carry"))
            state = self.count(start, steps, state, block, by=length)
            return self.either(
                ends,
                lambda: write("result", self.run(finish, [*numbers, *state, *at_end]), lane),
                lambda: write("carry", state, lane),
            )

        self.count(first, last, [], lanes, by=self.lanes)
        build.ret_void()

    def either(self, which: Vector, yes: Callable[[], list[Vector]], no: Callable[[], list[Vector]]) -> list[Vector]:
        """yes() if which else no()."""
        build = self.build
        *cases, behind = (build.append_basic_block(name) for name in ("yes", "no", "behind"))
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
        by: Vector = 1,
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
        new = [build.add(index, _INT(by) if isinstance(by, int) else by), *new]
        for phi, value in zip((index, *carried), new, strict=True):
            phi.add_incoming(value, build.block)
        build.branch(head)
        build.position_at_end(behind)
        return carried

    def run(self, closed: ClosedJaxpr, arguments: Sequence[Vector]) -> list[Vector]:
        """The equations of a jaxpr of scalars."""
        jaxpr = closed.jaxpr
        env: dict[Var, Vector] = dict(zip(jaxpr.invars, arguments, strict=True))
        if any(v.aval.shape for v in jaxpr.constvars):
            raise Unsupported("steps that read tables")
        env |= {v: self.number(value, _dtype(v)) for v, value in zip(jaxpr.constvars, closed.consts, strict=True)}

        def read(v: Var | Literal) -> Vector:
            return self.number(v.val, _dtype(v)) if isinstance(v, Literal) else env[v]

        for eqn in jaxpr.eqns:
            made: list[Any] = eqn.outvars
            if any(v.aval.shape for v in made):
                raise Unsupported(f"{eqn.primitive.name} of shape {made[0].aval.shape}")
            given = [read(v) for v in eqn.invars]
            results = self.equation(eqn, given)
            if all(self.is_constant(value) for value in given):
                self.constant |= set(results)
            env |= dict(zip(made, results, strict=True))
        return [read(v) for v in jaxpr.outvars]

    def equation(self, eqn: JaxprEqn, given: list[Vector]) -> list[Vector]:
        name = eqn.primitive.name
        if name == "scan":
            # a loop of fixed length that carries a state: the substeps of a plant
            length, inner, fixed = scan_parameters(eqn)
            still, state = given[:fixed], given[fixed:]
            return self.count(_INT(0), _INT(length), state, lambda _, state: self.run(inner, [*still, *state]))
        if (called := callee(eqn)) is not None:
            return self.run(called, given)
        dtype = _dtype(eqn.invars[0])
        if name in FUNCTIONS and jnp.issubdtype(dtype, jnp.floating):
            return self.run(trace_scalar_function(FUNCTIONS[name], dtype), given)
        rule = (_OF_FLOATS if jnp.issubdtype(dtype, jnp.floating) else _OF_INTEGERS).get(name) or _OF_ALL.get(name)
        if rule is None:
            raise Unsupported(f"{name} of {dtype}")
        return [rule(self, eqn, *given)]

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
    power = equation_parameter(eqn, "y")
    if not 1 <= abs(power) <= 8:
        raise Unsupported(f"integer_pow by {power}")
    result = reduce(lambda x, y: w.build.fmul(x, y, flags=_FLAGS), [a] * abs(power))
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


def _instruction(name: str, **options: Any) -> Callable[..., Vector]:
    return lambda w, eqn, *given: getattr(w.build, name)(*given, **options)


def _intrinsic(name: str) -> Callable[..., Vector]:
    return lambda w, eqn, *given: w.intrinsic(name, *given)


_OF_FLOATS: dict[str, Callable[..., Vector]] = {
    "add": _instruction("fadd", flags=_FLAGS),
    "add_any": _instruction("fadd", flags=_FLAGS),
    "sub": _instruction("fsub", flags=_FLAGS),
    "mul": _instruction("fmul", flags=_FLAGS),
    "div": _divide,
    "neg": _instruction("fneg"),
    "square": lambda w, eqn, a: w.build.fmul(a, a, flags=_FLAGS),
    # JAX 0.11's, in derivatives of tanh
    "one_minus_square": lambda w, eqn, a: w.build.fmul(w.build.fadd(w.like(a, 1.0), a), w.build.fsub(w.like(a, 1.0), a)),
    "integer_pow": _power,
    "abs": _intrinsic("fabs"),
    **{name: _intrinsic(name) for name in ("sqrt", "floor", "ceil")},
    # lax.RoundingMethod: away from zero, to nearest even
    "round": lambda w, eqn, a: w.intrinsic(("round", "rint")[int(equation_parameter(eqn, "rounding_method"))], a),
    "sign": _sign,
    "max": _LARGER,
    "min": _SMALLER,
    "clamp": _clamp,
    "is_finite": lambda w, eqn, a: w.build.fcmp_ordered("<", w.intrinsic("fabs", a), w.like(a, float("inf"))),
}
_OF_INTEGERS: dict[str, Callable[..., Vector]] = {
    **{name: _instruction(name) for name in ("add", "sub", "mul", "xor")},
    **{name: _instruction(f"{name}_") for name in ("and", "or", "not")},
    "shift_left": _instruction("shl"),
    "shift_right_logical": _instruction("lshr"),
}
_OF_ALL: dict[str, Callable[..., Vector]] = {
    **dict(zip(("gt", "lt", "ge", "le", "eq", "ne"), map(_comparison, (">", "<", ">=", "<=", "==", "!=")), strict=True)),
    "select_n": _select,
    "convert_element_type": _convert,
    "bitcast_convert_type": lambda w, eqn, a: w.build.bitcast(a, w.vector(_KINDS[str(_dtype(eqn.outvars[0]))])),
    **dict.fromkeys(("copy", "copy_p", "broadcast_in_dim", "reshape", "squeeze"), lambda w, eqn, a: a),
}
