"""The lanes' part of a step as one kernel of a GPU: a lane's state stays in registers through the whole run.

XLA starts several kernels a time step, some microseconds each, so that small studies wait for launches. Here one program of
the grid takes a block of lanes through all samples, and reads what all lanes share as it goes. Pallas lowers it by Triton;
on a CPU it can be interpreted, for tests.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jax.typing import ArrayLike
from jaxtyping import Array

from .elementary import rounded
from .split import substituted

_ABSENT = {"round": rounded}
"""What Triton's lowering lacks."""
LANES = 128
"""Lanes of a program: four warps, a lane a thread."""


class Kernel:
    """A loop over blocks of samples and what follows each, for lanes side by side.

    Args:
        body: jaxpr of one sample, scalars of one lane: values, carry, one sample's inputs -> carry.
        after: the same of what is done once after every block of samples.
        values: number of values; they differ from lane to lane.
        carry: numbers that a lane carries.
        interpret: run by Pallas's interpreter, on any device.
    """

    def __init__(self, body: ClosedJaxpr, after: ClosedJaxpr, values: int, carry: int, *, interpret: bool = False):
        self._values, self._carry, self._interpret = values, carry, interpret
        body, after = substituted(body, _ABSENT), substituted(after, _ABSENT)
        own = (0,) * (values + carry)
        self._body = jax.vmap(jaxpr_as_fun(body), (*own, *[None] * (len(body.in_avals) - len(own))))
        self._after = jax.vmap(jaxpr_as_fun(after), (*own, *[None] * (len(after.in_avals) - len(own))))
        self._run = jax.jit(self._called)

    def __call__(
        self,
        values: Sequence[ArrayLike],
        carry: Sequence[ArrayLike],
        inputs: Sequence[ArrayLike],
        ends: Sequence[ArrayLike],
    ) -> list[Array]:
        """The carry after all blocks of samples.

        Args:
            values: `(lanes,)` each, lanes a multiple of `LANES`.
            carry: `(lanes,)` each.
            inputs: of the body `(blocks, samples)` each.
            ends: inputs of what follows `(blocks,)` each.
        """
        return self._run(list(values), list(carry), list(inputs), list(ends))

    def _called(self, values: Any, carry: Any, inputs: Any, ends: Any) -> list[Array]:
        blocks, samples = inputs[0].shape
        shared = [jnp.reshape(x, -1) for x in (*inputs, *ends)]
        # a truth value becomes a number: they are read from memory
        truths = [x.dtype == jnp.bool_ for x in shared]
        shared = [x.astype(jnp.int32) if true else x for x, true in zip(shared, truths, strict=True)]
        lanes = pl.BlockSpec((LANES,), lambda i: (i,))
        whole = [pl.BlockSpec(x.shape, lambda i: (0,)) for x in shared]
        kernel = partial(self._kernel, len(inputs), truths, blocks, samples)
        return pl.pallas_call(
            kernel,
            grid=(carry[0].size // LANES,),
            in_specs=[*[lanes] * (self._values + self._carry), *whole],
            out_specs=[lanes] * self._carry,
            out_shape=[jax.ShapeDtypeStruct(x.shape, x.dtype) for x in carry],
            interpret=self._interpret,
            compiler_params=None if self._interpret else triton.CompilerParams(num_warps=LANES // 32),
        )(*values, *carry, *shared)

    def _kernel(self, inputs: int, truths: list[bool], blocks: int, samples: int, *refs: Any) -> None:
        own = self._values + self._carry
        numbers = [ref[...] for ref in refs[: self._values]]
        state = [ref[...] for ref in refs[self._values : own]]
        shared, out = refs[own : -self._carry], refs[-self._carry :]

        def read(i: int, at: Any) -> Array:
            value = shared[i][at]
            return value != 0 if truths[i] else value

        def sample(index: Any, state: list[Array]) -> list[Array]:
            return self._body(*numbers, *state, *[read(i, index) for i in range(inputs)])

        def block(number: Any, state: list[Array]) -> list[Array]:
            begin = number * samples
            state = jax.lax.fori_loop(begin, begin + samples, sample, state)
            return self._after(*numbers, *state, *[read(i, number) for i in range(inputs, len(shared))])

        for ref, value in zip(out, jax.lax.fori_loop(0, blocks, block, state), strict=True):
            ref[...] = value
