"""What lanes share, computed ahead of them: input, noise, and all of the plant where no lane differs in it."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.simulate import unit_noise

from .llvm import Loop
from .split import Unsupported, recursion

Block = tuple[list[Any], list[Any], list[Any]]
"""Next state of what lanes share, what follows a block of samples reads of it, and what each sample does."""
_FIRST = jax.ShapeDtypeStruct((), jnp.uint32), jax.ShapeDtypeStruct((), jnp.int32)
"""Seed, and index of a block's first sample."""


class Shared(NamedTuple):
    """What lanes share: from its state and a sample to the next one and what lanes read; the same at the end of a block."""

    inner: Callable[[Sequence[Any], Any], tuple[list[Any], list[Any]]]
    outer: Callable[[Sequence[Any], Any], tuple[list[Any], list[Any]]]
    state: list[jax.ShapeDtypeStruct]
    sides: tuple[str, ...]

    def given(self, seed: Any, first: Any, length: int) -> tuple[Any, Any]:
        """Indices and noise of a block's samples."""
        indices = first + jnp.arange(length, dtype=jnp.int32)
        return indices, unit_noise(seed, indices, self.sides)


class Ahead(Protocol):
    """From the state of what lanes share, seed, first sample and length of a block."""

    def __call__(self, state: list[Any], seed: int, first: int, length: int) -> Block: ...


class Scanned:
    """By XLA, sample by sample."""

    def __init__(self, shared: Shared, lengths: set[int]):
        def block(state: list[Any], seed: Any, first: Any, length: int) -> Block:
            state, handed = jax.lax.scan(shared.inner, state, shared.given(seed, first, length))
            return *shared.outer(state, ()), handed

        self._blocks = {n: jax.jit(partial(block, length=n)).lower(shared.state, *_FIRST).compile() for n in lengths}

    def __call__(self, state: list[Any], seed: int, first: int, length: int) -> Block:
        return self._blocks[length](state, np.uint32(seed), np.int32(first))


class Looped:
    """By XLA what needs no state, for all samples of a block at once; by a loop of scalars the rest.

    Raises:
        Unsupported: there can be no such loop.
    """

    def __init__(self, shared: Shared, lengths: set[int]):
        block = jax.eval_shape(lambda: shared.given(jnp.uint32(0), jnp.int32(0), 1))
        sample = jax.tree.map(lambda x: jax.ShapeDtypeStruct((), x.dtype), block)
        parts = recursion(shared.inner, shared.state, sample)
        self._direct = parts.direct
        self._dtypes = [out.dtype for out in parts.step.out_avals[len(shared.state) :]]

        def ahead(seed: Any, first: Any, length: int) -> tuple[list[Any], list[Any]]:
            return jax.vmap(parts.ahead)(shared.given(seed, first, length))

        self._parallel = {n: jax.jit(partial(ahead, length=n)).lower(*_FIRST).compile() for n in lengths}
        self._loop = None
        if shared.state:
            self._loop = Loop(parts.step, np.dtype(float), carry=len(shared.state), lanes=1)
        self._outer = jax.jit(lambda state: shared.outer(state, ())).lower(shared.state).compile()

    def __call__(self, state: list[Any], seed: int, first: int, length: int) -> Block:
        direct, read = self._parallel[length](np.uint32(seed), np.int32(first))
        carry = [np.array([leaf]) for leaf in state]
        kept = [np.empty(length, dtype) for dtype in self._dtypes]
        if self._loop is not None:
            self._loop([*carry, *map(np.asarray, read), *kept], length, 0, 1)
        direct, rest = iter(direct), iter(kept)
        handed = [next(direct) if alone else next(rest) for alone in self._direct]
        return *self._outer([leaf[0] for leaf in carry]), handed


def ahead_of_lanes(shared: Shared, lengths: set[int]) -> Ahead:
    """For blocks of these lengths, by the loop if there can be one."""
    try:
        return Looped(shared, lengths)
    except Unsupported:
        return Scanned(shared, lengths)
