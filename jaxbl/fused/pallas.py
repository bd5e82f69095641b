"""The lanes' part of a step as one kernel of a GPU: a lane's state stays in registers through the whole run.

XLA starts several kernels a time step, some microseconds each, so that small studies wait for launches. Here one program of
the grid takes a block of lanes through all samples, and reads what all lanes share as it goes. Pallas lowers it by Triton;
on a CPU it can be interpreted, for tests.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jaxtyping import Array

from . import raising_unsupported
from .dependence import LoopHooks
from .elementary import round_half_even
from .jaxprs import ClosedJaxpr, jaxpr_as_fun, join_multiply_add, replace_primitives, trace_inlined

_REPLACEMENTS = {"round": round_half_even}
"""Functions in place of primitives that Triton's lowering lacks."""
LANES = 128
"""Lanes of a program: four warps, a lane a thread."""


class Kernel:
    """A run of lanes side by side: a loop over samples, and what runs around each block of them.

    Args:
        body: jaxpr of one sample, scalars of one lane: values, carry, inputs of the sample -> carry.
        hooks: what runs before, between and after the blocks.
        values: how many numbers differ from lane to lane.
        lanes: number of lanes, a multiple of `LANES`.
        steps: samples of a run.
        block_length: samples of a block; the last one may be shorter.
        interpret: run it by Pallas's interpreter, on any device.

    Attributes:
        arguments: shapes of the kernel's arguments: values `(lanes,)` each; inputs of samples `(steps,)`, of blocks
            `(blocks,)`, and of the end `()`.
    """

    def __init__(
        self,
        body: ClosedJaxpr,
        hooks: LoopHooks,
        values: int,
        lanes: int,
        steps: int,
        block_length: int,
        *,
        interpret: bool = False,
    ):
        self._values, self._steps, self._block_length, self._interpret = values, steps, block_length, interpret
        lane_count = values + len(body.out_avals)
        self._start, self._body, self._after_block, self._finish = (
            self._vectorise(part, min(lane_count, len(part.in_avals))) for part in (hooks.start, body, *hooks[1:])
        )
        self._results = hooks.finish.out_avals
        shapes = (steps,), (-(-steps // block_length),), ()
        inputs = tuple(
            [jax.ShapeDtypeStruct(shape, aval.dtype) for aval in part.in_avals[lane_count:]]
            for shape, part in zip(shapes, (body, *hooks[1:]), strict=True)
        )
        lane_values = [jax.ShapeDtypeStruct((lanes,), aval.dtype) for aval in body.in_avals[:values]]
        self.arguments = lane_values, inputs

    def _vectorise(self, part: ClosedJaxpr, lane_count: int) -> Callable[..., list[Array]]:
        """The function for a block of lanes: its first `lane_count` arguments differ from lane to lane, the others are
        scalars."""
        part = replace_primitives(part, _REPLACEMENTS)
        axes = (*(0,) * lane_count, *[None] * (len(part.in_avals) - lane_count))
        vectorised = jax.vmap(jaxpr_as_fun(part), axes, axis_size=LANES)
        if self._interpret:
            return vectorised
        examples = [jax.ShapeDtypeStruct((LANES,) * (i < lane_count), aval.dtype) for i, aval in enumerate(part.in_avals)]
        return jaxpr_as_fun(join_multiply_add(trace_inlined(vectorised, *examples), multiply_add))

    def compile(self) -> Callable[..., list[Array]]:
        """Compile the kernel for the device at hand. Raises `Unsupported` where that is not possible."""
        with raising_unsupported("compilation for this device"):
            return jax.jit(self.run).lower(*self.arguments).compile()

    def run(self, values: list[Array], inputs: tuple[list[Array], list[Array], list[Array]]) -> list[Array]:
        """Run the lanes; returns their results `(lanes,)` each. The shapes of the arguments are those of `arguments`."""
        # a scalar becomes an array of one, and a truth value a number: they are read from memory
        shared = [jnp.reshape(x, -1) for part in inputs for x in part]
        is_bool = [x.dtype == jnp.bool_ for x in shared]
        shared = [x.astype(jnp.int32) if as_int else x for x, as_int in zip(shared, is_bool, strict=True)]
        stored_dtypes = [jnp.dtype(jnp.int32) if aval.dtype == jnp.bool_ else aval.dtype for aval in self._results]
        lane_block = pl.BlockSpec((LANES,), lambda i: (i,))
        count = values[0].size
        results = pl.pallas_call(
            partial(self._kernel, [len(part) for part in inputs], is_bool),
            grid=(count // LANES,),
            in_specs=[*[lane_block] * self._values, *(pl.BlockSpec(x.shape, lambda i: (0,)) for x in shared)],
            out_specs=[lane_block] * len(self._results),
            out_shape=[jax.ShapeDtypeStruct((count,), dtype) for dtype in stored_dtypes],
            interpret=self._interpret,
            compiler_params=None if self._interpret else triton.CompilerParams(num_warps=LANES // 32),
        )(*values, *shared)
        return [x.astype(aval.dtype) for x, aval in zip(results, self._results, strict=True)]

    def _kernel(self, counts: list[int], is_bool: list[bool], *refs: Any) -> None:
        """The kernel's code. `counts` are the inputs of a sample, a block and the end; `refs` are all arrays in memory."""
        values = [ref[...] for ref in refs[: self._values]]
        end = len(refs) - len(self._results)
        shared, out = refs[self._values : end], refs[end:]

        def read_inputs(part: int, index: Any) -> list[Array]:
            """Inputs of a sample (part 0), of a block (1), or of the end (2)."""
            first = sum(counts[:part])
            stored = [(shared[i][index], is_bool[i]) for i in range(first, first + counts[part])]
            return [number != 0 if as_int else number for number, as_int in stored]

        def sample(index: Any, carry: list[Array]) -> list[Array]:
            return self._body(*values, *carry, *read_inputs(0, index))

        def block(index: Any, carry: list[Array], end: Any = None) -> list[Array]:
            start = index * self._block_length
            carry = jax.lax.fori_loop(start, start + self._block_length if end is None else end, sample, carry)
            # flags of lanes that are done are of no use here: a program keeps all its lanes
            return self._after_block(*values, *carry, *read_inputs(1, index))[: len(carry)]

        blocks, remainder = divmod(self._steps, self._block_length)
        carry = jax.lax.fori_loop(0, blocks, block, self._start(*values))
        if remainder:
            carry = block(blocks, carry, self._steps)
        for ref, result in zip(out, self._finish(*values, *carry, *read_inputs(2, 0)), strict=True):
            ref[...] = result.astype(ref.dtype)


def multiply_add(a: Any, b: Any, c: Any, *, minus_product: bool, minus_rest: bool) -> Array:
    """a b + c by one instruction with one rounding: Triton's compiler joins no products with sums of its own accord.

    `minus_product` and `minus_rest` change the sign of a b and of c.
    """
    operands = jnp.broadcast_arrays(a, b, c)
    register, bits = {"float32": ("f", 32), "float64": ("d", 64)}[operands[0].dtype.name]
    if not operands[0].shape:
        return (-a if minus_product else a) * b + (-c if minus_rest else c)
    negated, arguments = ("$1", "t, $2, $3") if minus_product else ("$3", "$1, $2, t")
    if minus_product or minus_rest:
        code = f"{{.reg .f{bits} t; neg.f{bits} t, {negated}; fma.rn.f{bits} $0, {arguments};}}"
    else:
        code = f"fma.rn.f{bits} $0, $1, $2, $3;"
    (result,) = triton.elementwise_inline_asm(
        code,
        args=operands,
        constraints=f"={register},{register},{register},{register}",
        pack=1,
        result_shape_dtypes=[jax.ShapeDtypeStruct(operands[0].shape, operands[0].dtype)],
    )
    return result
