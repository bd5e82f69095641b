"""Lanes through time by a fused loop: what :func:`jaxbl.simulate.scan` computes, for many lanes at once."""

import abc
from collections import deque
from collections.abc import Collection, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import groupby
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.drive.parameters import set_leaves
from jaxbl.simulate import (
    Experiment,
    Reducer,
    advance_sample,
    all_done,
    block_length,
    compute_metrics,
    end_block,
    initial_carry,
)

from .dependence import Dependence, LoopHooks, carry_dependences, split_by_lane
from .llvm import AddressedArrays, ArrayRows, Loop, LoopArrays, vector_lanes
from .noise import host_device
from .shared_part import SharedPart, compile_shared_part

_KEPT = 2**24
"""Bytes of what lanes share, of some seeds, that a program keeps for the next lanes."""
_WORTH = 0.875
"""Share of lanes down to which those that are done stay: to move the others costs as much as some samples."""
_SHARE = 2**18
"""Samples of lanes times their bytes, some 0.1 ms, that are worth a thread."""
_CALL = 2**20
"""Samples of lanes that a call of the loop takes, some 1 ms: after it, lanes that are done leave."""


class SharedInputs(NamedTuple):
    """What lanes need for a stretch of samples, in whole blocks: inputs of each sample `(samples,)` and of what follows each
    block `(blocks,)`; of the last stretch those of a lane's figures `()`, and the figures that lanes share `()`."""

    length: int
    handed: AddressedArrays
    last: AddressedArrays
    ends: list[np.ndarray] | None
    figures: list[np.ndarray]

    @property
    def size(self) -> int:
        """Bytes."""
        return sum(one.nbytes for part in (self.handed, self.last) for one in part.arrays)


class LaneSimulator(abc.ABC):
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
            return initial_carry(own(values), reducers)

        def sample(values: list[Any], carry: Any, given: Any) -> Any:
            return advance_sample(own(values), reducers, carry, *given)[0]

        def settle(values: list[Any], carry: Any, given: Any) -> Any:
            carry = end_block(own(values), carry)
            return carry, all_done(own(values), reducers, carry)

        def result(values: list[Any], carry: Any, given: Any) -> dict[str, Any]:
            return compute_metrics(own(values), reducers, carry)

        values = [jax.ShapeDtypeStruct((), dtype)] * len(paths)
        given = jax.ShapeDtypeStruct((), jnp.int32), dict.fromkeys(experiment.sides, jax.ShapeDtypeStruct((), jnp.float32))
        carry = jax.eval_shape(start, values)
        kinds = carry_dependences(start, ((sample, given), (settle, ())), values)
        one = [leaf for leaf, kind in zip(jax.tree.leaves(carry), kinds, strict=True) if kind != Dependence.LANE]
        # by each lane; what all share is not among them
        self.carried = len(kinds) - len(one)
        begins, inner = (
            split_by_lane(start, values, (), (), [], kinds),
            split_by_lane(sample, values, carry, given, kinds, kinds),
        )
        # whether a lane is done, where that can be known
        marks = [Dependence.LANE] * (len(jax.tree.leaves(jax.eval_shape(settle, values, carry, ()))) - len(kinds))
        outer, ends = (
            split_by_lane(settle, values, carry, (), kinds, [*kinds, *marks]),
            split_by_lane(result, values, carry, (), kinds),
        )
        self._body, self._around = inner.lane, LoopHooks(begins.lane, outer.lane, ends.lane)
        # compiled now, so that a call only runs
        shared = SharedPart(inner.shared, outer.shared, one, experiment.sides, self._steps, self._length)
        self._ahead, self._stretch = compile_shared_part(shared), shared.stretch
        self._kept: dict[int, list[SharedInputs]] = {}
        self._first = [np.asarray(leaf) for leaf in jax.jit(lambda: begins.shared([], ())[0])()]
        self._closing = jax.jit(lambda state: ends.shared(state, ())).lower(one).compile()
        names = sorted(jax.eval_shape(result, values, carry, ()))
        self._of_lane = dict(zip(names, ends.of_lane, strict=True))

    def __call__(self, values: dict[str, np.ndarray], seed: int) -> dict[str, np.ndarray]:
        """Figures `(lanes,)` of one seed, by name; `values` `(lanes,)` by path, in SI units."""
        found, shared = self._march(self.filled_up(values), self._run(seed))
        lanes, others = iter(found), iter(shared)
        return {
            name: next(lanes)[: self._lanes] if own else np.full(self._lanes, next(others))
            for name, own in self._of_lane.items()
        }

    def keep(self, seeds: Collection[int]) -> None:
        """What lanes share is kept for the next lanes of these seeds, as far as there is room, and of no others."""
        self._kept = {seed: run for seed, run in self._kept.items() if seed in seeds}

    def _run(self, seed: int) -> Iterator[SharedInputs]:
        if seed in self._kept:
            yield from self._kept[seed]
            return
        made, room = [], _KEPT - sum(one.size for run in self._kept.values() for one in run)
        for stretch in self.stretches(seed):
            room -= stretch.size
            made = [*made, stretch] if room >= 0 else []
            yield stretch
        if room >= 0:
            self._kept[seed] = made

    def filled_up(self, values: dict[str, np.ndarray]) -> list[np.ndarray]:
        """Values of as many lanes as are computed."""
        given = [np.ascontiguousarray(values[path], self._dtype) for path in self._paths]
        for path, one in zip(self._paths, given, strict=True):
            if one.shape != (self._lanes,):
                raise ValueError(f"{path}: {self._lanes} lanes need as many values, not an array of shape {one.shape}")
        more = (0, self._filled - self._lanes)
        return [np.pad(one, more, "edge") for one in given] if any(more) else given

    def stretches(self, seed: int) -> Iterator[SharedInputs]:
        """Stretch after stretch of a run."""
        state = self._first
        for first in range(0, self._steps, self._stretch):
            length = min(self._stretch, self._steps - first)
            state, last, handed = self._ahead(state, seed, first, length)
            ends, figures = None, []
            if first + length == self._steps:
                figures, ends = ([np.asarray(x) for x in some] for some in self._closing(state))
            each, blocks = (AddressedArrays([np.asarray(x) for x in part]) for part in (handed, last))
            yield SharedInputs(length, each, blocks, ends, figures)

    @abc.abstractmethod
    def _march(
        self, given: list[np.ndarray], stretches: Iterator[SharedInputs]
    ) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """The lanes' figures `(lanes,)` each, and those that they share `()`."""


class HostSimulator(LaneSimulator):
    """By code for this machine's processor; threads share the lanes."""

    def __init__(
        self, experiment: Experiment, reducers: tuple[Reducer, ...], paths: tuple[str, ...], lanes: int, threads: int
    ):
        dtype = np.dtype(jnp.result_type(experiment.run.sample_period))
        self._together = vector_lanes(dtype)
        super().__init__(experiment, reducers, paths, lanes, self._together)
        if any(eqn.primitive.name == "scan" for eqn in self._body.jaxpr.eqns):
            # plant steps of a sample: few numbers, each of which waits for the one before
            self._together *= 2
            self._filled = -(-lanes // self._together) * self._together
        self._loop = Loop(
            self._body, self._dtype, values=len(paths), carry=self.carried, around=self._around, lanes=self._together
        )
        self._of = {
            name: [one.dtype for one in self._loop.signature if one.name.startswith(name)]
            for name in ("input at the end", "mark of a block", "result")
        }
        # a thread a share: its stretches come one after the other, whatever the others do
        shares = min(threads, self._filled // self._together, max(self._filled * self._steps * dtype.itemsize // _SHARE, 1))
        self._threads = [ThreadPoolExecutor(1) for _ in range(shares)]

    def _march(self, given, stretches):
        # dealt in turns: lanes that are done together, as neighbours often are, are then missed by all threads
        count = len(self._threads)
        rows = np.stack(given) if given else np.empty((0, self._filled), self._dtype)
        dealt = [rows.reshape(len(given), -1, self._together)[:, i::count].reshape(len(given), -1) for i in range(count)]
        shares = [_ThreadLanes(self._loop, self._of, values, self.carried, self._length) for values in dealt]
        running: deque[list[Future[None]]] = deque()
        stretch = None
        for stretch in stretches:
            # what lanes share is computed meanwhile, a stretch or two ahead of them
            own = int(stretch.ends is not None)
            if not running:
                # threads do nothing then but compute: they would wait for the interpreter
                for share in shares:
                    share.prepare(stretch)
            running.append([t.submit(s.run, stretch) for t, s in zip(self._threads[own:], shares[own:], strict=True)])
            while len(running) > 2:
                _wait(running.popleft())
            if own:
                # nothing is left to do here
                _wait(one[0] for one in list(running)[:-1])
                shares[0].run(stretch)
            while own and running:
                _wait(running.popleft())
        assert stretch is not None
        found = [np.empty((len(rows), self._filled), rows.dtype) for rows in shares[0].results]
        for i, share in enumerate(shares):
            for whole, part in zip(found, share.results, strict=True):
                dealt = whole.reshape(len(whole), -1, self._together)
                dealt[:, i::count] = part.reshape(len(part), -1, self._together)
        return [one for rows in found for one in rows], stretch.figures


def _wait(futures: Iterable[Future[None]]) -> None:
    for one in futures:
        one.result()


class _ThreadLanes:
    """Lanes of one thread on their way, with `values` `(paths, lanes)`. Those that are done leave, with what they carry
    then, and the others move together."""

    def __init__(self, loop: Loop, of: dict[str, list[np.dtype]], values: np.ndarray, carried: int, block: int):
        self._loop, self._of, self._block, self._begun = loop, of, block, False
        # of the lanes that are computed: their places, values and carry; behind them others only fill up
        self._lanes = np.arange(values.shape[1])
        self._own = np.empty((len(values) + carried, values.shape[1]), values.dtype)
        self._own[: len(values)] = values
        self._given: tuple[list[np.ndarray], list[np.ndarray], LoopArrays] | None = None
        self._left: list[tuple[np.ndarray, np.ndarray]] = []
        self._results: list[tuple[np.ndarray, list[np.ndarray]]] = []

    def run(self, stretch: SharedInputs) -> None:
        """Take lanes through a stretch, in calls of so many blocks as are worth one."""
        at = 0
        while at < stretch.length and len(self._lanes):
            marks, results, arrays = self._given or self.prepare(stretch)
            size = self._own.shape[1]
            upto = min(at + max(_CALL // (size * self._block), 1) * self._block, stretch.length)
            ends = stretch.ends is not None and upto == stretch.length
            self._loop(arrays, upto, 0, size, start=at, block=self._block, begins=not self._begun, ends=ends)
            self._begun, at = True, upto
            if ends:
                self._results.append((self._lanes, results))
            elif len(marks):
                self._leave(marks[0][(upto - 1) // self._block])
        self._given = None
        if stretch.ends is not None and self._left:
            self._lanes, self._own = (np.concatenate(one, axis=-1) for one in zip(*self._left, strict=True))
            self._move(np.arange(len(self._lanes)))
            _, results, arrays = self.prepare(stretch)
            self._loop(arrays, 0, 0, self._own.shape[1], block=self._block, ends=True)
            self._results.append((self._lanes, results))

    def prepare(self, stretch: SharedInputs) -> tuple[list[np.ndarray], list[np.ndarray], LoopArrays]:
        """Marks of a stretch, results `(figures of one type, lanes)`, and all that the loop is given."""
        size = self._own.shape[1]
        marks = [np.empty((-(-stretch.length // self._block), size), dtype) for dtype in self._of["mark of a block"]]
        found = [np.empty((len(list(some)), size), dtype) for dtype, some in groupby(self._of["result"])]
        unread = [np.zeros((), dtype) for dtype in self._of["input at the end"]]
        ends = unread if stretch.ends is None else stretch.ends
        every = [ArrayRows(self._own), stretch.handed, stretch.last, *ends, *marks, *map(ArrayRows, found)]
        arrays = LoopArrays(self._loop.signature, every, stretch.length, size, self._block)
        self._given = marks, found, arrays
        return self._given

    @property
    def results(self) -> list[np.ndarray]:
        """Of all lanes, `(figures of one type, lanes)` each."""
        if not self._left:
            return self._results[0][1]
        count = sum(len(lanes) for lanes, _ in self._results)
        merged = [np.empty((len(rows), count), rows.dtype) for rows in self._results[0][1]]
        for lanes, found in self._results:
            for one, own in zip(merged, found, strict=True):
                one[:, lanes] = own[:, : len(lanes)]
        return merged

    def _leave(self, marks: np.ndarray) -> None:
        """Lanes that are done, if so many are that the move is worth while."""
        done = marks[: len(self._lanes)]
        others = np.flatnonzero(~done)
        if -(-len(others) // self._loop.lanes) * self._loop.lanes <= _WORTH * self._own.shape[1]:
            gone = np.flatnonzero(done)
            self._left.append((self._lanes[gone], self._own[:, gone]))
            self._move(others)

    def _move(self, lanes: np.ndarray) -> None:
        """Only these stay."""
        whole = -(-len(lanes) // self._loop.lanes) * self._loop.lanes
        filled = np.pad(lanes, (0, whole - len(lanes)), "edge") if len(lanes) else lanes
        self._lanes, self._own, self._given = self._lanes[lanes], np.take(self._own, filled, axis=1), None


class DeviceSimulator(LaneSimulator):
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
        with jax.default_device(host_device()):
            super().__init__(experiment, reducers, paths, lanes, LANES)
        kernel = Kernel(self._body, self._around, len(paths), self._filled, self._steps, self._length, interpret=interpret)
        self.kernel = kernel.compiled()

    def _march(self, given, stretches):
        every = list(stretches)
        return [np.asarray(figure) for figure in self.kernel(given, self.inputs(every))], every[-1].figures

    @staticmethod
    def inputs(stretches: Iterable[SharedInputs]) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
        """What the kernel reads of all stretches: each sample's, each block's, and the figures' own."""
        every = list(stretches)
        handed = [np.concatenate(column) for column in zip(*(one.handed.arrays for one in every), strict=True)]
        last = [np.concatenate(column) for column in zip(*(one.last.arrays for one in every), strict=True)]
        return handed, last, every[-1].ends or []
