"""What lanes share, computed ahead of them: input, noise, and all of the plant where no lane differs in it."""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.simulate import LONGEST_BLOCK, unit_noise

from . import Unsupported
from .llvm import Loop
from .split import recursion

SharedBlock = tuple[list[Any], list[Any], list[Any]]
"""Next state of what lanes share, what follows a block of samples reads of it, and what each sample does."""


def host() -> Any:
    """This machine's processor; where JAX has been told to leave it alone, the device that there is."""
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        return jax.local_devices()[0]


@cache
def _drawing() -> Callable[..., dict[str, Any]]:
    """From a seed and a first sample to noise of as many as a block can have: compiled once for all studies."""

    def draw(seed: Any, first: Any) -> dict[str, Any]:
        return unit_noise(seed, first + jnp.arange(LONGEST_BLOCK, dtype=jnp.int32), ("motor", "load"))

    with jax.default_device(host()):
        return jax.jit(draw).lower(np.uint32(0), np.int32(0)).compile()


class Shared(NamedTuple):
    """What lanes share: from its state and a sample to the next one and what lanes read; the same at the end of a block."""

    inner: Callable[[Sequence[Any], Any], tuple[list[Any], list[Any]]]
    outer: Callable[[Sequence[Any], Any], tuple[list[Any], list[Any]]]
    state: list[jax.ShapeDtypeStruct]
    sides: tuple[str, ...]

    def given(self, seed: int, first: int, length: int) -> tuple[Any, Any]:
        """Indices and noise of a block's samples."""
        noise = _drawing()(np.uint32(seed), np.int32(first))
        return np.arange(first, first + length, dtype=np.int32), {
            side: np.asarray(noise[side])[:length] for side in self.sides
        }

    def shapes(self, *length: int) -> tuple[Any, Any]:
        """Of what is given."""
        noise = jax.ShapeDtypeStruct(length, jnp.float32)
        return jax.ShapeDtypeStruct(length, jnp.int32), dict.fromkeys(self.sides, noise)


Ahead = Callable[[list[Any], int, int, int], SharedBlock]
"""From the state of what lanes share, seed, first sample and length of a block."""


class Scanned:
    """By XLA, sample by sample."""

    def __init__(self, shared: Shared, lengths: set[int]):
        def block(state: list[Any], given: Any) -> SharedBlock:
            state, handed = jax.lax.scan(shared.inner, state, given)
            return *shared.outer(state, ()), handed

        self._given = shared.given
        self._blocks = {n: jax.jit(block).lower(shared.state, shared.shapes(n)).compile() for n in lengths}

    def __call__(self, state: list[Any], seed: int, first: int, length: int) -> SharedBlock:
        return self._blocks[length](state, self._given(seed, first, length))


class Looped:
    """By XLA what needs no state, for all samples of a block at once; by a loop of scalars the rest. `Unsupported` where
    there can be no such loop."""

    def __init__(self, shared: Shared, lengths: set[int]):
        parts = recursion(shared.inner, shared.state, shared.shapes())
        self._given, self._direct = shared.given, parts.direct
        self._dtypes = [out.dtype for out in parts.step.out_avals[len(shared.state) :]]
        parallel = jax.jit(jax.vmap(parts.ahead))
        self._parallel = {n: parallel.lower(shared.shapes(n)).compile() for n in lengths}
        self._loop = None
        if shared.state:
            self._loop = Loop(parts.step, np.dtype(float), carry=len(shared.state), lanes=1)
        self._outer = jax.jit(lambda state: shared.outer(state, ())).lower(shared.state).compile()

    def __call__(self, state: list[Any], seed: int, first: int, length: int) -> SharedBlock:
        direct, read = self._parallel[length](self._given(seed, first, length))
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
