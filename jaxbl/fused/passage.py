"""Lanes through time by a fused loop: what :func:`jaxbl.simulate.scan` computes, for many lanes at once."""

import abc
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.drive.parameters import set_leaves
from jaxbl.simulate import Experiment, Reducer, advance, begin, block_length, end_of_block, figures

from .ahead import Shared, ahead_of_lanes, host
from .llvm import Arrays, Loop, vector_lanes
from .split import Around, Kind, carry_kinds, split


class Block(NamedTuple):
    """What lanes need for a block of samples: inputs of each sample `(length,)`, of what follows the block `()`, and, of the
    last block, of a lane's figures `()`."""

    length: int
    handed: list[np.ndarray]
    last: list[np.ndarray]
    ends: list[np.ndarray] | None


class Passage(abc.ABC):
    """Simulates lanes of an experiment; made and called in its precision (`jax.enable_x64`).

    Args:
        experiment, reducers: as of :func:`jaxbl.simulate.scan`.
        paths: of the leaves that differ from lane to lane.
        lanes: how many there are; compiled for this number, filled up to a multiple of those computed `together`.

    Raises:
        Unsupported: a step does something that a fused loop cannot do.
    """

    def __init__(
        self, experiment: Experiment, reducers: tuple[Reducer, ...], paths: tuple[str, ...], lanes: int, together: int
    ):
        self._paths, self._steps = paths, experiment.run.steps
        self._lanes, self._filled = lanes, -(-lanes // together) * together
        self._length = block_length(self._steps)
        dtype = jnp.result_type(experiment.run.sample_period)
        self._dtype = np.dtype(dtype)

        def own(values: list[Any]) -> Experiment:
            return set_leaves(experiment, dict(zip(paths, values, strict=True)))

        def start(values: list[Any], *_: Any) -> Any:
            return begin(own(values), reducers)

        def sample(values: list[Any], carry: Any, given: Any) -> Any:
            return advance(own(values), reducers, carry, *given)[0]

        def settle(values: list[Any], carry: Any, given: Any) -> Any:
            return end_of_block(own(values), carry)

        def result(values: list[Any], carry: Any, given: Any) -> dict[str, Any]:
            return figures(own(values), reducers, carry)

        values = [jax.ShapeDtypeStruct((), dtype)] * len(paths)
        given = jax.ShapeDtypeStruct((), jnp.int32), dict.fromkeys(experiment.sides, jax.ShapeDtypeStruct((), jnp.float32))
        carry = jax.eval_shape(start, values)
        kinds = carry_kinds(start, ((sample, given), (settle, ())), values)
        one = [leaf for leaf, kind in zip(jax.tree.leaves(carry), kinds, strict=True) if kind != Kind.LANE]
        # by each lane; what all share is not among them
        self.carried = len(kinds) - len(one)
        begins, inner = split(start, values, (), (), [], kinds), split(sample, values, carry, given, kinds, kinds)
        outer, ends = split(settle, values, carry, (), kinds, kinds), split(result, values, carry, (), kinds)
        self._body, self._around = inner.lane, Around(begins.lane, outer.lane, ends.lane)
        # compiled now, so that a call only runs
        lengths = {min(self._length, self._steps), self._steps % self._length} - {0}
        self._ahead = ahead_of_lanes(Shared(inner.shared, outer.shared, one, experiment.sides), lengths)
        self._first = [np.asarray(leaf) for leaf in jax.jit(lambda: begins.shared([], ())[0])()]
        self._closing = jax.jit(lambda state: ends.shared(state, ())).lower(one).compile()
        names = sorted(jax.eval_shape(result, values, carry, ()))
        self._of_lane = dict(zip(names, ends.of_lane, strict=True))
        self._figure_dtypes = [np.dtype(aval.dtype) for aval in ends.lane.out_avals]

    def __call__(self, values: dict[str, np.ndarray], seed: int) -> dict[str, np.ndarray]:
        """Figures `(lanes,)` of one seed, by name; `values` `(lanes,)` by path, in SI units."""
        # the figures that lanes share come with the last block
        shared: list[np.ndarray] = []
        lanes = iter(self._march(self.filled_up(values), self.blocks(seed, shared)))
        others = iter(shared)
        return {
            name: next(lanes)[: self._lanes] if own else np.full(self._lanes, next(others))
            for name, own in self._of_lane.items()
        }

    def filled_up(self, values: dict[str, np.ndarray]) -> list[np.ndarray]:
        """Values of as many lanes as are computed."""
        given = [np.ascontiguousarray(values[path], self._dtype) for path in self._paths]
        for path, one in zip(self._paths, given, strict=True):
            if one.shape != (self._lanes,):
                raise ValueError(f"{path}: {self._lanes} lanes need as many values, not an array of shape {one.shape}")
        more = (0, self._filled - self._lanes)
        return [np.pad(one, more, "edge") for one in given] if any(more) else given

    def blocks(self, seed: int, shared: list[np.ndarray]) -> Iterator[Block]:
        """Block after block of a run; figures that lanes share are added to `shared` with the last one."""
        state = self._first
        for first in range(0, self._steps, self._length):
            length = min(self._length, self._steps - first)
            state, last, handed = self._ahead(state, seed, first, length)
            ends = None
            if first + length == self._steps:
                figures, read = self._closing(state)
                shared += map(np.asarray, figures)
                ends = [np.asarray(x) for x in read]
            yield Block(length, [np.asarray(x) for x in handed], [np.asarray(x) for x in last], ends)

    @abc.abstractmethod
    def _march(self, given: list[np.ndarray], blocks: Iterator[Block]) -> list[np.ndarray]:
        """The lanes' figures `(lanes,)` each."""


class HostPassage(Passage):
    """By code for this machine's processor; threads share the lanes."""

    def __init__(
        self, experiment: Experiment, reducers: tuple[Reducer, ...], paths: tuple[str, ...], lanes: int, threads: int
    ):
        dtype = np.dtype(jnp.result_type(experiment.run.sample_period))
        self._together = vector_lanes(dtype)
        super().__init__(experiment, reducers, paths, lanes, self._together)
        # a thread a share: its blocks come one after the other, whatever the others do
        shares = min(threads, self._filled // self._together)
        self._threads = [ThreadPoolExecutor(1) for _ in range(shares)]
        self._loop = Loop(self._body, self._dtype, values=len(paths), carry=self.carried, around=self._around)
        self._unread = [np.zeros((), aval.dtype) for aval in self._around.finish.in_avals[len(paths) + self.carried :]]

    def _march(self, given, blocks):
        carry = [np.empty(self._filled, self._dtype) for _ in range(self.carried)]
        found = [np.empty(self._filled, dtype) for dtype in self._figure_dtypes]
        parts = self._filled // self._together
        edges = [parts * i // len(self._threads) * self._together for i in range(len(self._threads) + 1)]
        running: deque[list[Future[None]]] = deque()
        for number, block in enumerate(blocks):
            ends = self._unread if block.ends is None else block.ends
            every = [*given, *carry, *block.handed, *block.last, *ends, *found]
            arrays = Arrays(self._loop.signature, every, block.length, self._filled)
            run = partial(self._loop, arrays, block.length, begins=number == 0, ends=block.ends is not None)
            running.append([thread.submit(run, *part) for thread, part in zip(self._threads, pairwise(edges), strict=True)])
            # what lanes share is computed meanwhile, a block or two ahead of them
            while len(running) > (2 if block.ends is None else 0):
                for one in running.popleft():
                    one.result()
        return found


class DevicePassage(Passage):
    """By one kernel of an accelerator, which takes its lanes through the whole run; `interpret` runs it anywhere, slowly.

    `kernel`, compiled, gives the lanes' figures from values `(lanes,)`, lanes filled up, and :meth:`inputs`.
    """

    def __init__(
        self,
        experiment: Experiment,
        reducers: tuple[Reducer, ...],
        paths: tuple[str, ...],
        lanes: int,
        *,
        interpret: bool = False,
    ):
        # here, as no processor needs it, and it takes a quarter of a second
        from .pallas import LANES, Kernel

        # a loop of scalars is the work of a processor; a GPU would start a kernel for each of its steps
        with jax.default_device(host()):
            super().__init__(experiment, reducers, paths, lanes, LANES)
        kernel = Kernel(self._body, self._around, len(paths), self._filled, self._steps, self._length, interpret=interpret)
        self.kernel = kernel.compiled()

    def _march(self, given, blocks):
        return [np.asarray(figure) for figure in self.kernel(given, self.inputs(blocks))]

    @staticmethod
    def inputs(blocks: Iterator[Block]) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
        """What the kernel reads of all blocks: each sample's, each block's, and the figures' own."""
        every = list(blocks)
        # a rest of samples stands behind the whole blocks
        handed = [np.concatenate(column) for column in zip(*(block.handed for block in every), strict=True)]
        last = [np.stack(column) for column in zip(*(block.last for block in every), strict=True)]
        return handed, last, every[-1].ends or []
