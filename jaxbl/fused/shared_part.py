"""What lanes share, computed ahead of them: input, noise, and all of the plant where no lane differs in it."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from . import Unsupported
from .dependence import split_by_state
from .jaxprs import trace_inlined
from .llvm import Loop
from .noise import LONGEST_SPAN, draw_noise

SharedValues = tuple[list[Any], list[Any], list[Any]]
"""Next state of what lanes share, what follows each block of a stretch of samples reads of it `(blocks,)`, and what each
sample does `(samples,)`."""


class SharedPart(NamedTuple):
    """What lanes share: from its state and a sample to the next one and what lanes read; the same at the end of a block of
    `length` of a run's `steps`. Samples are computed in stretches of whole blocks."""

    inner: Callable[[Sequence[Any], Any], tuple[list[Any], list[Any]]]
    outer: Callable[[Sequence[Any], Any], tuple[list[Any], list[Any]]]
    state: list[jax.ShapeDtypeStruct]
    sides: tuple[str, ...]
    steps: int
    length: int

    @property
    def stretch(self) -> int:
        """Samples of a stretch, but the last one."""
        return min(LONGEST_SPAN // self.length * self.length, self.steps)

    def given(self, seed: int, first: int, count: int) -> tuple[Any, Any]:
        """Indices and noise of some samples."""
        noise = draw_noise(seed, first, count)
        return np.arange(first, first + count, dtype=np.int32), {side: noise[side] for side in self.sides}

    def shapes(self, *length: int) -> tuple[Any, Any]:
        """Of what is given."""
        noise = jax.ShapeDtypeStruct(length, jnp.float32)
        return jax.ShapeDtypeStruct(length, jnp.int32), dict.fromkeys(self.sides, noise)


SharedPartRunner = Callable[[list[Any], int, int, int], SharedValues]
"""From the state of what lanes share, seed, first sample and number of samples of a stretch."""


class SharedPartScan:
    """By XLA, sample by sample."""

    def __init__(self, shared: SharedPart):
        def block(state: list[Any], given: Any) -> SharedValues:
            state, handed = jax.lax.scan(shared.inner, state, given)
            return *shared.outer(state, ()), handed

        self._shared = shared
        lengths = {min(shared.length, shared.steps), shared.steps % shared.length} - {0}
        self._blocks = {n: jax.jit(block).lower(shared.state, shared.shapes(n)).compile() for n in lengths}

    def __call__(self, state: list[Any], seed: int, first: int, count: int) -> SharedValues:
        parts = []
        for begin in range(0, count, self._shared.length):
            length = min(self._shared.length, count - begin)
            state, *read = self._blocks[length](state, self._shared.given(seed, first + begin, length))
            parts.append(read)
        last = [np.stack(column) for column in zip(*(last for last, _ in parts), strict=True)]
        return state, last, [np.concatenate(column) for column in zip(*(handed for _, handed in parts), strict=True)]


class SharedPartLoop:
    """By XLA what needs no state, for all samples of a stretch at once; by a loop of scalars the rest. `Unsupported` where
    there can be no such loop."""

    def __init__(self, shared: SharedPart):
        parts = split_by_state(shared.inner, shared.state, shared.shapes())
        self._shared, self._direct = shared, parts.direct
        # one program for all stretches, what it computes beyond the last sample is left unread; and few arrays, as each
        # takes XLA and NumPy some microseconds
        given, ahead = shared.shapes(shared.stretch), jax.vmap(parts.ahead)
        dtypes = [one.dtype for one in jax.tree.leaves(jax.eval_shape(ahead, given))]
        self._groups = [[i for i, one in enumerate(dtypes) if one == dtype] for dtype in dict.fromkeys(dtypes)]

        def stacked(given: Any) -> list[Any]:
            made = jax.tree.leaves(ahead(given))
            return [jnp.stack([made[i] for i in group]) for group in self._groups]

        self._parallel = jax.jit(stacked).lower(given).compile()
        self._loop = None
        self._dtypes: list[list[np.dtype]] = [[], []]
        if shared.state:
            after = trace_inlined(lambda *state: jax.tree.leaves(shared.outer(state, ())), *shared.state)
            count = len(shared.state)
            self._dtypes = [[out.dtype for out in part.out_avals[count:]] for part in (after, parts.step)]
            self._loop = Loop(parts.step, np.dtype(float), carry=count, lanes=1, after=after)

    def __call__(self, state: list[Any], seed: int, first: int, count: int) -> SharedValues:
        shared = self._shared
        made: dict[int, np.ndarray] = {}
        for group, rows in zip(self._groups, self._parallel(shared.given(seed, first, shared.stretch)), strict=True):
            made |= zip(group, np.asarray(rows)[:, :count], strict=True)
        alone = sum(self._direct)
        direct, read = ([made[i] for i in some] for some in (range(alone), range(alone, len(made))))
        sizes = -(-count // shared.length), count
        state = [np.array([leaf]) for leaf in state]
        last, kept = ([np.empty(size, dtype) for dtype in some] for size, some in zip(sizes, self._dtypes, strict=True))
        if self._loop is not None:
            self._loop([*state, *read, *kept, *last], count, 0, 1, block=shared.length)
        own, rest = iter(direct), iter(kept)
        return [leaf[0] for leaf in state], last, [next(own) if one else next(rest) for one in self._direct]


def compile_shared_part(shared: SharedPart) -> SharedPartRunner:
    """By the loop if there can be one."""
    try:
        return SharedPartLoop(shared)
    except Unsupported:
        return SharedPartScan(shared)
