"""The lanes' part of a step as machine code: one loop over time with the state of a vector of lanes in registers.

Every equation of the jaxpr becomes an instruction on vectors; nothing is left to automatic vectorisation. The code is that
of the machine it runs on. Calls into it release the interpreter's lock, so that threads can share the lanes.
"""

import ctypes
from array import array as array_of_numbers
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
from llvmlite import binding, ir

from . import ArrayGroup, Unsupported
from .dependence import EXTENTS, NO_HOOKS, LoopHooks
from .jaxprs import ClosedJaxpr, JaxprEqn
from .scalar_writer import COMPARISONS, ScalarWriter

_INT, _BIT, _POINTER = ir.IntType(64), ir.IntType(1), ir.PointerType()
_MEMORY_TYPES = {
    "float32": ir.FloatType(),
    "float64": ir.DoubleType(),
    "int32": ir.IntType(32),
    "uint32": ir.IntType(32),
    "int64": ir.IntType(64),
    "bool": ir.IntType(8),
}
"""Types of numbers in memory."""
_SCALAR_ARGUMENTS = 6
"""Integers that the code takes beside the table of its arrays."""
Vector = Any
"""A value of LLVM (which has no types that a checker could use): a number in all lanes, or an index."""
_FLAGS = ("contract",)
"""A product and a sum may become one instruction; nothing is reordered, as sums are compensated."""
_BOOL = np.dtype(bool)


def _target_machine() -> Any:
    """The machine at hand; a new object each time, as an engine owns its own."""
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


Signature = dict[str, list[np.dtype]]
"""Types of the numbers in a loop's arrays, by group."""


class Loop:
    """A compiled loop over samples, and what runs around it.

    Args:
        body: jaxpr of one sample, scalars of one lane: values, carry, constants, inputs of the sample, and inputs of the
            sample for this lane alone -> carry, and outputs of the sample.
        dtype: type of the lanes' numbers.
        counts: how many `values` differ from lane to lane; how many numbers a lane takes as its `carry` from sample to
            sample; how many `constants` all lanes read unchanged in a call; how many `lane_inputs` of a sample each lane
            has for itself. What remains are inputs of the sample.
        hooks: what runs before, between and after the blocks.
        lanes: that are computed together; left out, as many as suit the machine.

    Attributes:
        signature: what the arrays of each group hold.

    Raises:
        Unsupported: an operation of these functions is unknown here.
    """

    def __init__(
        self,
        body: ClosedJaxpr,
        dtype: np.dtype,
        *,
        hooks: LoopHooks = NO_HOOKS,
        lanes: int | None = None,
        **counts: int,
    ):
        self.lanes = lanes or vector_lanes(dtype)
        read = iter(body.jaxpr.invars)
        counts = {"sample_inputs": len(body.jaxpr.invars) - sum(counts.values())} | counts
        # the groups that a sample reads are the first ones
        groups = {group: [*islice(read, counts.get(group, 0))] for group in EXTENTS}
        carry, lane_count = len(groups["carry"]), len(groups["values"]) + len(groups["carry"])
        groups["outputs"] = body.jaxpr.outvars[carry:]
        if hooks.after_block:
            after_block = hooks.after_block.jaxpr
            groups |= {"block_inputs": after_block.invars[lane_count:], "flags": after_block.outvars[carry:]}
        if hooks.finish:
            groups |= {"final_inputs": hooks.finish.jaxpr.invars[lane_count:], "results": hooks.finish.jaxpr.outvars}
        self.signature: Signature = {
            group: [_LoopWriter.check_type(v.aval.dtype) for v in variables] for group, variables in groups.items()
        }
        module = ir.Module("loop")
        _LoopWriter(module, self.lanes).write_loop(body, hooks, self.signature)
        parsed = binding.parse_assembly(str(module))
        options = binding.create_pipeline_tuning_options(speed_level=3)
        passes = binding.create_pass_builder(_target_machine(), options)
        passes.getModulePassManager().run(parsed, passes)
        self._load(_target_machine().emit_object(parsed))

    def _load(self, code: bytes) -> None:
        self._code = code
        self._engine = binding.create_mcjit_compiler(binding.parse_assembly(""), _target_machine())
        self._engine.add_object_file(binding.ObjectFileRef.from_data(code))
        self._engine.finalize_object()
        address = self._engine.get_function_address("loop")
        self._call = ctypes.CFUNCTYPE(None, ctypes.c_void_p, *[ctypes.c_int64] * _SCALAR_ARGUMENTS)(address)

    def __getstate__(self) -> tuple[int, Signature, bytes]:
        return self.lanes, self.signature, self._code

    def __setstate__(self, state: tuple[int, Signature, bytes]) -> None:
        self.lanes, self.signature, code = state
        self._load(code)

    def __call__(self, arrays: "LoopArrays", end: int, *, start: int = 0, begins: bool = False, ends: bool = False) -> None:
        """Take lanes through samples; the carry's arrays are overwritten.

        Args:
            arrays: those that are read and written.
            end: the sample before which the loop ends.
            start: the first sample, with which a block must begin.
            begins: the run begins here: the carry is made, not read.
            ends: the run ends here: results are written, not the carry.

        Raises:
            ValueError: the arrays have fewer samples, or no block begins at `start`.
        """
        if end > arrays.steps or start % arrays.block_length:
            raise ValueError(f"samples {start} to {end}: not of {arrays.steps} in blocks of {arrays.block_length}")
        self._call(arrays.table, start, end, arrays.block_length, arrays.lanes, begins, ends)

    def whole_vectors(self, lanes: int) -> int:
        """The number of lanes, rounded up to one that fills the vectors."""
        return -(-lanes // self.lanes) * self.lanes

    def run(
        self, steps: int, lanes: int = 1, block_length: int | None = None, **inputs: ArrayGroup
    ) -> tuple[ArrayGroup, ArrayGroup, ArrayGroup]:
        """Take lanes through all samples; vectors are filled with repetitions of the last lane.

        Args:
            steps: number of samples.
            lanes: number of lanes.
            block_length: samples of a block; left out, all samples are one block.
            inputs: arrays of the groups that are read; and `outputs`, if there are arrays for them, as for whole vectors.

        Returns:
            The carry `(lanes,)`, outputs `(samples, lanes)`, and flags `(blocks, lanes)`.
        """
        width = self.whole_vectors(lanes)
        blocks, padding = -(-steps // (block_length or max(steps, 1))), (0, width - lanes)
        groups: dict[str, ArrayGroup] = {"flags": allocate(self.signature["flags"], (blocks, width))}
        if "outputs" not in inputs:
            groups["outputs"] = allocate(self.signature["outputs"], (steps, width))
        for name, arrays in inputs.items():
            if any(padding) and len(arrays) and "lanes" in EXTENTS.get(name, ""):
                stack = np.asarray(arrays)
                arrays = np.pad(stack, [*[(0, 0)] * (stack.ndim - 1), padding], "edge")
            groups[name] = [*map(np.array, arrays)] if name == "carry" else arrays
        self(LoopArrays(self.signature, groups, steps, width, block_length), steps)
        carry, outputs, flags = (groups.get(name, ()) for name in ("carry", "outputs", "flags"))
        if any(padding):
            carry, outputs, flags = ([array[..., :lanes] for array in arrays] for arrays in (carry, outputs, flags))
        return carry, outputs, flags


def allocate(dtypes: Sequence[np.dtype], shape: tuple[int, ...]) -> ArrayGroup:
    """New arrays of these types, as rows of one array if the types are the same."""
    if len(set(dtypes)) == 1:
        return np.empty((len(dtypes), *shape), dtypes[0])
    return [np.empty(shape, dtype) for dtype in dtypes]


class LoopArrays:
    """Arrays that were checked against a loop's signature, for a number of samples and lanes and a length of block.

    Raises:
        ValueError: an array is missing, has gaps, or is of the wrong type or length.
    """

    def __init__(
        self,
        signature: Signature,
        groups: Mapping[str, ArrayGroup],
        steps: int,
        lanes: int,
        block_length: int | None = None,
    ):
        self.steps, self.lanes, self.block_length = steps, lanes, block_length or max(steps, 1)
        blocks = -(-steps // self.block_length)
        counts = {
            "scalar": 1, "lanes": lanes, "samples": steps, "blocks": blocks,
            "samples and lanes": steps * lanes, "blocks and lanes": blocks * lanes,
        }  # fmt: skip
        addresses: list[int] = []
        for name, dtypes in signature.items():
            arrays, count = groups.get(name, ()), counts[EXTENTS[name]]
            if len(arrays) != len(dtypes):
                raise ValueError(f"a loop needs {len(dtypes)} {name}, not {len(arrays)}")
            # rows of one array are checked at once: NumPy takes long to find an address
            is_stack = isinstance(arrays, np.ndarray) and len(set(dtypes)) == 1
            members: Any = [(arrays, dtypes[0])] if is_stack else zip(arrays, dtypes, strict=True)
            for array, dtype in members:
                rows = len(dtypes) if is_stack else 1
                if array.dtype != dtype or array.size != rows * count or not array.flags.c_contiguous:
                    wrong = f"not {array.size} of {array.dtype}"
                    raise ValueError(f"{name} of a loop: {rows * count} contiguous numbers of type {dtype} needed, {wrong}")
                first = array.__array_interface__["data"][0]
                addresses += [first + row * count * dtype.itemsize for row in range(rows)]
        # an array of ctypes takes twenty times as long to make
        self._groups, self._table = groups, array_of_numbers("Q", addresses)
        self.table = self._table.buffer_info()[0]


class _LoopWriter(ScalarWriter):
    """Writes jaxprs as LLVM assembly; every number is a vector of lanes."""

    number_types = _MEMORY_TYPES

    def __init__(self, module: ir.Module, lanes: int):
        self.module, self.lanes = module, lanes
        self.invariants: set[Vector] = set()
        """Vectors that do not change in the loop over time."""

    def write_loop(self, body: ClosedJaxpr, hooks: LoopHooks, signature: Signature) -> None:
        function_type = ir.FunctionType(ir.VoidType(), [_POINTER, *[_INT] * _SCALAR_ARGUMENTS])
        function = ir.Function(self.module, function_type, "loop")
        # what registers have no room for lies on the stack: no vector of it over two lines of the cache
        function.attributes.alignstack = 64
        function.attributes.add("nounwind")  # without another one it is not written
        table, start, steps, block_length, width, begins, ends = function.args
        build: Any = ir.IRBuilder(function.append_basic_block("entry"))
        self.build = build
        places: dict[str, range] = {}
        dtypes: list[np.dtype] = []
        for name, members in signature.items():
            places[name] = range(len(dtypes), len(dtypes) + len(members))
            dtypes += members
        carry_count = len(places["carry"])
        types = [_MEMORY_TYPES[str(dtype)] for dtype in dtypes]
        if any(dtypes[i].kind != "f" for i in (*places["values"], *places["carry"])):
            raise Unsupported("lanes that carry other numbers than floating-point ones")
        arrays = [build.load(build.gep(table, [_INT(i)], source_etype=_POINTER), typ=_POINTER) for i in range(len(dtypes))]

        def broadcast(i: int, index: Vector) -> Vector:
            """Element of an array in all lanes."""
            number = build.load(build.gep(arrays[i], [index], source_etype=types[i]), typ=types[i])
            if dtypes[i] == _BOOL:
                number = build.trunc(number, _BIT)
            undefined = ir.Constant(self.vector_type(number.type), ir.Undefined)
            first = build.insert_element(undefined, number, ir.IntType(32)(0))
            return build.shuffle_vector(first, undefined, ir.Constant(self.vector_type(ir.IntType(32)), None))

        constants = [broadcast(i, _INT(0)) for i in places["constants"]]
        final_inputs = [broadcast(i, _INT(0)) for i in places["final_inputs"]]

        def write_lanes(lane: Vector, _: list[Vector]) -> list[Vector]:
            def read(name: str, index: Vector = lane) -> list[Vector]:
                addresses = {i: build.gep(arrays[i], [index], source_etype=types[i]) for i in places[name]}
                return [
                    build.load(address, align=dtypes[i].itemsize, typ=self.vector_type(types[i]))
                    for i, address in addresses.items()
                ]

            def write(name: str, vectors: Sequence[Vector], index: Vector) -> list[Vector]:
                for i, vector in zip(places[name], vectors, strict=True):
                    vector = build.zext(vector, self.vector_type(types[i])) if dtypes[i] == _BOOL else vector
                    build.store(vector, build.gep(arrays[i], [index], source_etype=types[i]), align=dtypes[i].itemsize)
                return []

            values = read("values")
            self.invariants = {*values, *constants}

            def write_sample(sample: Vector, carry: list[Vector]) -> list[Vector]:
                index = build.add(build.mul(sample, width), lane)
                lane_inputs = read("lane_inputs", index)
                inputs = (broadcast(i, sample) for i in places["sample_inputs"])
                results = self.write_jaxpr(body, [*values, *carry, *constants, *inputs, *lane_inputs])
                write("outputs", results[carry_count:], index)
                return results[:carry_count]

            def write_block(block_start: Vector, carry: list[Vector]) -> list[Vector]:
                block_end = build.add(block_start, block_length)
                last = build.select(build.icmp_signed("<", block_end, steps), block_end, steps)
                carry = self.write_for(block_start, last, carry, write_sample)
                block = build.sdiv(block_start, block_length)
                inputs = (broadcast(i, block) for i in places["block_inputs"])
                results = self.write_jaxpr(hooks.after_block, [*values, *carry, *inputs])
                index = build.add(build.mul(block, width), lane)
                write("flags", results[carry_count:], index)
                return results[:carry_count]

            if hooks.start is None:
                carry = read("carry")
            else:
                carry = self.write_if(begins, lambda: self.write_jaxpr(hooks.start, values), lambda: read("carry"))
            if hooks.after_block is None:
                carry = self.write_for(start, steps, carry, write_sample)
            else:
                carry = self.write_for(start, steps, carry, write_block, step=block_length)
            if hooks.finish is None:
                return write("carry", carry, lane)
            return self.write_if(
                ends,
                lambda: write("results", self.write_jaxpr(hooks.finish, [*values, *carry, *final_inputs]), lane),
                lambda: write("carry", carry, lane),
            )

        self.write_for(_INT(0), width, [], write_lanes, step=self.lanes)
        build.ret_void()

    def write_if(self, condition: Vector, yes: Callable[[], list[Vector]], no: Callable[[], list[Vector]]) -> list[Vector]:
        """yes() if condition else no()."""
        build = self.build
        *cases, behind = (build.append_basic_block(name) for name in ("yes", "no", "behind"))
        build.cbranch(build.icmp_signed("!=", condition, _INT(0)), *cases)
        branches = []
        for block, write_case in zip(cases, (yes, no), strict=True):
            build.position_at_end(block)
            branches.append((write_case(), build.block))
            build.branch(behind)
        build.position_at_end(behind)
        merged = []
        for column in zip(*(vectors for vectors, _ in branches), strict=True):
            phi = build.phi(column[0].type)
            for vector, (_, block) in zip(column, branches, strict=True):
                phi.add_incoming(vector, block)
            merged.append(phi)
        return merged

    def write_for(
        self,
        first: Vector,
        end: Vector,
        state: list[Vector],
        body: Callable[[Vector, list[Vector]], list[Vector]],
        step: Vector = 1,
    ) -> list[Vector]:
        """for index in range(first, end, step): state = body(index, state)."""
        build = self.build
        before = build.block
        head, inside, behind = (build.append_basic_block(name) for name in ("head", "body", "behind"))
        build.branch(head)
        build.position_at_end(head)
        index, *carried = (build.phi(vector.type) for vector in (first, *state))
        for phi, vector in zip((index, *carried), (first, *state), strict=True):
            phi.add_incoming(vector, before)
        build.cbranch(build.icmp_signed("<", index, end), inside, behind)
        build.position_at_end(inside)
        new = body(index, list(carried))
        new = [build.add(index, _INT(step) if isinstance(step, int) else step), *new]
        for phi, vector in zip((index, *carried), new, strict=True):
            phi.add_incoming(vector, build.block)
        build.branch(head)
        build.position_at_end(behind)
        return carried

    def write_equation(self, eqn: JaxprEqn, operands: list[Vector]) -> list[Vector]:
        results = super().write_equation(eqn, operands)
        if all(self.is_invariant(operand) for operand in operands):
            self.invariants |= set(results)
        return results

    def write_scan(self, times, body, constants, state):
        # the substeps of a plant
        return self.write_for(_INT(0), _INT(times), state, lambda _, state: self.write_jaxpr(body, [*constants, *state]))

    def write_cond(self, branches, index, operands):
        raise Unsupported("cond")

    def emit(self, name, dtype, *operands):
        instruction = (_FLOAT_INSTRUCTIONS if dtype.kind == "f" else _INTEGER_INSTRUCTIONS).get(name)
        if instruction is None:
            raise Unsupported(f"{name} of {dtype}")
        return instruction(self, dtype, *operands)

    def convert(self, number, old, new):
        if old == new:
            return number
        if new == _BOOL:
            raise Unsupported(f"conversion of {old} to bool")
        build, target = self.build, self.vector_type(_MEMORY_TYPES[str(new)])
        is_wider, is_signed = old == _BOOL or new.itemsize > old.itemsize, old.kind == "i"
        from_float, to_float = (dtype.kind == "f" for dtype in (old, new))
        if from_float and to_float:
            return (build.fpext if is_wider else build.fptrunc)(number, target)
        if from_float:
            return (build.fptosi if new.kind == "i" else build.fptoui)(number, target)
        if to_float:
            return (build.sitofp if is_signed else build.uitofp)(number, target)
        if number.type == target:
            return number
        return (build.trunc if not is_wider else build.sext if is_signed else build.zext)(number, target)

    def bitcast(self, number, new):
        return self.build.bitcast(number, self.vector_type(_MEMORY_TYPES[str(new)]))

    def vector_type(self, element: ir.Type) -> ir.VectorType:
        return ir.VectorType(element, self.lanes)

    def literal(self, number: Any, dtype: np.dtype) -> Vector:
        """A number of a type in all lanes."""
        if np.ndim(number):
            raise Unsupported("steps that read tables")
        element = _BIT if dtype == _BOOL else _MEMORY_TYPES[str(self.check_type(dtype))]
        python_number = np.asarray(number, dtype).item()
        return ir.Constant(self.vector_type(element), [ir.Constant(element, python_number)] * self.lanes)

    def is_invariant(self, vector: Vector) -> bool:
        return isinstance(vector, ir.Constant) or vector in self.invariants

    def call_intrinsic(self, name: str, *operands: Vector) -> Vector:
        vector_type = operands[0].type
        full_name = f"llvm.{name}.v{self.lanes}{'f32' if vector_type.element == ir.FloatType() else 'f64'}"
        function = self.module.globals.get(full_name)
        if function is None:
            function = ir.Function(self.module, ir.FunctionType(vector_type, [vector_type] * len(operands)), full_name)
        return self.build.call(function, operands)


Instruction = Callable[..., Vector]
"""`instruction(writer, dtype, *operands)` writes an operation on numbers of type `dtype`."""


def _divide(w: _LoopWriter, dtype: np.dtype, a: Vector, b: Vector) -> Vector:
    if w.is_invariant(b) and not w.is_invariant(a):
        # the reciprocal leaves the loop
        return w.build.fmul(a, w.build.fdiv(w.literal(1, dtype), b), flags=_FLAGS)
    return w.build.fdiv(a, b)


def _write_extremum(order: str, w: _LoopWriter, dtype: np.dtype, a: Vector, b: Vector) -> Vector:
    """The larger or smaller of two numbers, NaN if either is."""
    extremum = w.build.select(w.build.fcmp_unordered(order, a, b), a, b)
    return w.build.select(w.build.fcmp_unordered("uno", b, b), b, extremum)


def _compare(order: str, w: _LoopWriter, dtype: np.dtype, a: Vector, b: Vector) -> Vector:
    if dtype.kind == "f":
        return (w.build.fcmp_unordered if order == "!=" else w.build.fcmp_ordered)(order, a, b)
    return (w.build.icmp_signed if dtype.kind == "i" else w.build.icmp_unsigned)(order, a, b)


def _instruction(name: str, **options: Any) -> Instruction:
    return lambda w, dtype, *operands: getattr(w.build, name)(*operands, **options)


def _intrinsic(name: str) -> Instruction:
    return lambda w, dtype, *operands: w.call_intrinsic(name, *operands)


_COMMON_INSTRUCTIONS = {
    **{name: partial(_compare, order) for name, order in zip(COMPARISONS, ("<", "<=", ">", ">=", "==", "!="), strict=True)},
    "select": _instruction("select"),
}
_FLOAT_INSTRUCTIONS: dict[str, Instruction] = _COMMON_INSTRUCTIONS | {
    **{name: _instruction(f"f{name}", flags=_FLAGS) for name in ("add", "sub", "mul")},
    "div": _divide,
    "neg": _instruction("fneg"),
    "abs": _intrinsic("fabs"),
    **{name: _intrinsic(name) for name in ("sqrt", "floor", "ceil")},
    "round_away": _intrinsic("round"),
    "round_even": _intrinsic("rint"),
    "max": partial(_write_extremum, ">"),
    "min": partial(_write_extremum, "<"),
}
_INTEGER_INSTRUCTIONS: dict[str, Instruction] = _COMMON_INSTRUCTIONS | {
    **{name: _instruction(name) for name in ("add", "sub", "mul", "xor")},
    **{name: _instruction(f"{name}_") for name in ("and", "or", "not")},
    "shift_left": _instruction("shl"),
    "shift_right_logical": _instruction("lshr"),
}
