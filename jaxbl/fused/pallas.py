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

_ABSENT = {"round": round_half_even}
"""What Triton's lowering lacks."""
LANES = 128
"""Lanes of a program: four warps, a lane a thread."""


class Kernel:
    """A run of lanes side by side: a loop over samples, and what is done around each block of them.

    `body` is the jaxpr of one sample, scalars of one lane: `values` of them, carry, one sample's inputs -> carry. `size` is
    the number of lanes (a multiple of `LANES`), `steps` and `length` are samples of a run and of a block but its last.
    `interpret` runs it by Pallas's interpreter, on any device. `arguments` are the shapes of what it is called with: values
    `(size,)` each; inputs of the body `(steps,)` each, of what follows a block `(blocks,)`, of the finish `()`.
    """

    def __init__(
        self,
        body: ClosedJaxpr,
        around: LoopHooks,
        values: int,
        size: int,
        steps: int,
        length: int,
        *,
        interpret: bool = False,
    ):
        self._values, self._steps, self._length, self._interpret = values, steps, length, interpret
        own = values + len(body.out_avals)
        self._before, self._body, self._after, self._finish = (
            self._side_by_side(part, min(own, len(part.in_avals))) for part in (around.before, body, *around[1:])
        )
        self._results = around.finish.out_avals
        shapes = (steps,), (-(-steps // length),), ()
        inputs = tuple(
            [jax.ShapeDtypeStruct(shape, aval.dtype) for aval in part.in_avals[own:]]
            for shape, part in zip(shapes, (body, *around[1:]), strict=True)
        )
        lanes = [jax.ShapeDtypeStruct((size,), aval.dtype) for aval in body.in_avals[:values]]
        self.arguments = lanes, inputs

    def _side_by_side(self, part: ClosedJaxpr, own: int) -> Callable[..., list[Array]]:
        """For a block of lanes; what they share stays a scalar."""
        part = replace_primitives(part, _ABSENT)
        many = jax.vmap(jaxpr_as_fun(part), (*(0,) * own, *[None] * (len(part.in_avals) - own)), axis_size=LANES)
        if self._interpret:
            return many
        block = [jax.ShapeDtypeStruct((LANES,) * (i < own), aval.dtype) for i, aval in enumerate(part.in_avals)]
        return jaxpr_as_fun(join_multiply_add(trace_inlined(many, *block), multiply_add))

    def compiled(self) -> Callable[..., list[Array]]:
        """For the device at hand. Raises `Unsupported` where there is no such kernel."""
        with raising_unsupported("compilation for this device"):
            return jax.jit(self.run).lower(*self.arguments).compile()

    def run(self, values: list[Array], inputs: tuple[list[Array], list[Array], list[Array]]) -> list[Array]:
        """The lanes' results `(lanes,)` each, of `arguments`."""
        # a scalar becomes an array of one, and a truth value a number: they are read from memory
        shared = [jnp.reshape(x, -1) for part in inputs for x in part]
        truths = [x.dtype == jnp.bool_ for x in shared]
        shared = [x.astype(jnp.int32) if true else x for x, true in zip(shared, truths, strict=True)]
        stored = [jnp.dtype(jnp.int32) if aval.dtype == jnp.bool_ else aval.dtype for aval in self._results]
        lanes = pl.BlockSpec((LANES,), lambda i: (i,))
        count = values[0].size
        found = pl.pallas_call(
            partial(self._kernel, [len(part) for part in inputs], truths),
            grid=(count // LANES,),
            in_specs=[*[lanes] * self._values, *(pl.BlockSpec(x.shape, lambda i: (0,)) for x in shared)],
            out_specs=[lanes] * len(self._results),
            out_shape=[jax.ShapeDtypeStruct((count,), dtype) for dtype in stored],
            interpret=self._interpret,
            compiler_params=None if self._interpret else triton.CompilerParams(num_warps=LANES // 32),
        )(*values, *shared)
        return [x.astype(aval.dtype) for x, aval in zip(found, self._results, strict=True)]

    def _kernel(self, counts: list[int], truths: list[bool], *refs: Any) -> None:
        numbers = [ref[...] for ref in refs[: self._values]]
        end = len(refs) - len(self._results)
        shared, out = refs[self._values : end], refs[end:]

        def read(part: int, at: Any) -> list[Array]:
            """Inputs of the body, of what follows a block, or of the finish."""
            first = sum(counts[:part])
            found = [(shared[i][at], truths[i]) for i in range(first, first + counts[part])]
            return [value != 0 if true else value for value, true in found]

        def sample(index: Any, state: list[Array]) -> list[Array]:
            return self._body(*numbers, *state, *read(0, index))

        def block(number: Any, state: list[Array], end: Any = None) -> list[Array]:
            begin = number * self._length
            state = jax.lax.fori_loop(begin, begin + self._length if end is None else end, sample, state)
            # marks of lanes that are done are of no use here: a program has as many as it has
            return self._after(*numbers, *state, *read(1, number))[: len(state)]

        whole, rest = divmod(self._steps, self._length)
        state = jax.lax.fori_loop(0, whole, block, self._before(*numbers))
        if rest:
            state = block(whole, state, self._steps)
        for ref, value in zip(out, self._finish(*numbers, *state, *read(2, 0)), strict=True):
            ref[...] = value.astype(ref.dtype)


def multiply_add(a: Any, b: Any, c: Any, *, minus_product: bool, minus_rest: bool) -> Array:
    """One instruction, one rounding: Triton's compiler joins no products with sums of its own accord."""
    given = jnp.broadcast_arrays(a, b, c)
    kind, bits = {"float32": ("f", 32), "float64": ("d", 64)}[given[0].dtype.name]
    if not given[0].shape:
        return (-a if minus_product else a) * b + (-c if minus_rest else c)
    turned, other = ("$1", "t, $2, $3") if minus_product else ("$3", "$1, $2, t")
    if minus_product or minus_rest:
        code = f"{{.reg .f{bits} t; neg.f{bits} t, {turned}; fma.rn.f{bits} $0, {other};}}"
    else:
        code = f"fma.rn.f{bits} $0, $1, $2, $3;"
    (result,) = triton.elementwise_inline_asm(
        code,
        args=given,
        constraints=f"={kind},{kind},{kind},{kind}",
        pack=1,
        result_shape_dtypes=[jax.ShapeDtypeStruct(given[0].shape, given[0].dtype)],
    )
    return result
