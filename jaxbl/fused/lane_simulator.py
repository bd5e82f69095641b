"""Simulate many lanes at once by a compiled loop; the numbers are those of :func:`jaxbl.chain.scan`."""

import abc
from collections import deque
from collections.abc import Collection, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.chain import (
    Experiment,
    NamedArrays,
    Reducers,
    TracedArrays,
    advance_sample,
    all_done,
    block_length,
    compute_metrics,
    end_block,
    initial_carry,
)
from jaxbl.drive.parameters import set_leaves

from . import ArrayGroup, Arrays, Leaves
from .dependence import Dependence, LoopHooks, find_carry_dependences, split_by_lane
from .llvm import Loop, LoopArrays, allocate, vector_lanes
from .noise import host_device
from .shared_part import SharedPart, compile_shared_part

_CACHE_BYTES = 2**24
"""Largest size of the shared inputs, of several seeds, that a simulator keeps for the next lanes."""
_COMPACTION_SHARE = 0.875
"""Lanes that are done are removed once at most this share of the lanes runs: moving the others costs as much as several
samples."""
_THREAD_WORK = 2**18
"""Least work for a thread, some 0.1 ms: lanes times samples times bytes of a number."""
_CALL_WORK = 2**20
"""Work of one call of the loop, some 1 ms: lanes times samples. Lanes that are done are removed after a call."""


class SharedInputs(NamedTuple):
    """Inputs that all lanes share in a span. A span is a number of whole blocks of samples.

    Attributes:
        length: number of samples of the span.
        sample_inputs: arrays `(samples,)` that each sample reads.
        block_inputs: arrays `(blocks,)` that the end of each block reads.
        final_inputs: numbers `()` that the metrics of a lane need; None before the last span.
        shared_metrics: metrics `()` that are the same for all lanes; empty before the last span.
    """

    length: int
    sample_inputs: Arrays
    block_inputs: Arrays
    final_inputs: Arrays | None
    shared_metrics: Arrays

    @property
    def nbytes(self) -> int:
        """Bytes of the inputs of samples and blocks."""
        return sum(array.nbytes for array in (*self.sample_inputs, *self.block_inputs))


class LaneSimulator(abc.ABC):
    """Simulates lanes of an experiment. It is made and called in the experiment's precision (`jax.enable_x64`).

    Args:
        experiment, reducers: as for :func:`jaxbl.chain.scan`.
        paths: paths of the leaves that differ from lane to lane.
        lanes: number of lanes that the code is compiled for; whoever compiles it sets the number that they are padded to.

    Attributes:
        carry_count: number of values that each lane carries from sample to sample, without those that all lanes share.

    Raises:
        Unsupported: a step does something that a compiled loop cannot do.
    """

    _padded_lanes: int

    def __init__(self, experiment: Experiment, reducers: Reducers, paths: tuple[str, ...], lanes: int):
        self._paths, self._lanes, self._steps = paths, lanes, experiment.run.steps
        self._block_length = block_length(self._steps)
        dtype = jnp.result_type(experiment.run.sample_period)
        self._dtype = np.dtype(dtype)

        def place_values(values: Leaves) -> Experiment:
            return set_leaves(experiment, dict(zip(paths, values, strict=True)))

        def start(values: Leaves, *_: Any) -> Any:
            return initial_carry(place_values(values), reducers)

        def step(values: Leaves, carry: Any, sample_inputs: Any) -> Any:
            return advance_sample(place_values(values), reducers, carry, *sample_inputs)[0]

        def finish_block(values: Leaves, carry: Any, _: Any) -> Any:
            carry = end_block(place_values(values), carry)
            return carry, all_done(place_values(values), reducers, carry)

        def finish(values: Leaves, carry: Any, _: Any) -> TracedArrays:
            return compute_metrics(place_values(values), reducers, carry)

        values = [jax.ShapeDtypeStruct((), dtype)] * len(paths)
        noise = dict.fromkeys(experiment.sides, jax.ShapeDtypeStruct((), jnp.float32))
        sample_inputs = jax.ShapeDtypeStruct((), jnp.int32), noise
        carry = jax.eval_shape(start, values)
        dependences = find_carry_dependences(start, ((step, sample_inputs), (finish_block, ())), values)
        leaves = zip(jax.tree.leaves(carry), dependences, strict=True)
        shared_state = [leaf for leaf, dependence in leaves if dependence != Dependence.LANE]
        self.carry_count = len(dependences) - len(shared_state)
        start_split = split_by_lane(start, values, (), (), [], dependences)
        step_split = split_by_lane(step, values, carry, sample_inputs, dependences, dependences)
        # the end of a block also returns whether a lane is done, if the reducers can tell
        flag_count = len(jax.tree.leaves(jax.eval_shape(finish_block, values, carry, ()))) - len(dependences)
        result_dependences = [*dependences, *[Dependence.LANE] * flag_count]
        block_split = split_by_lane(finish_block, values, carry, (), dependences, result_dependences)
        finish_split = split_by_lane(finish, values, carry, (), dependences)
        self._step, self._hooks = step_split.lane, LoopHooks(start_split.lane, block_split.lane, finish_split.lane)
        # compiled now, so that a call only runs
        part = SharedPart(
            step_split.shared, block_split.shared, shared_state, experiment.sides, self._steps, self._block_length
        )
        self._run_shared_part, self._span_length = compile_shared_part(part), part.span_length
        self._cached_inputs: dict[int, list[SharedInputs]] = {}
        self._initial_state = [np.asarray(leaf) for leaf in jax.jit(lambda: start_split.shared([], ())[0])()]
        self._finish_shared_part = jax.jit(lambda state: finish_split.shared(state, ())).lower(shared_state).compile()
        names = sorted(jax.eval_shape(finish, values, carry, ()))
        self._is_lane_metric = dict(zip(names, finish_split.is_lane_result, strict=True))

    def __call__(self, values: NamedArrays, seed: int) -> NamedArrays:
        """Simulate the lanes with one seed.

        Args:
            values: values of the lanes, `(lanes,)` by path, in SI units.
            seed: seed of the encoders' noise.

        Returns:
            Metrics of the lanes, `(lanes,)` by name.
        """
        lane_metrics, shared_metrics = self._simulate(self.pad_lanes(values), self._iterate_inputs(seed))
        next_lane_metric, next_shared_metric = iter(lane_metrics), iter(shared_metrics)
        return {
            name: next(next_lane_metric)[: self._lanes] if is_lane else np.full(self._lanes, next(next_shared_metric))
            for name, is_lane in self._is_lane_metric.items()
        }

    def keep_seeds(self, seeds: Collection[int]) -> None:
        """Keep the cached inputs of these seeds for the next lanes, and drop those of all other seeds."""
        self._cached_inputs = {seed: inputs for seed, inputs in self._cached_inputs.items() if seed in seeds}

    def _iterate_inputs(self, seed: int) -> Iterator[SharedInputs]:
        """Yield the shared inputs of a run, span after span, from the cache; or compute them, and cache them if they fit."""
        if seed in self._cached_inputs:
            yield from self._cached_inputs[seed]
            return
        computed: list[SharedInputs] = []
        room = _CACHE_BYTES - sum(inputs.nbytes for spans in self._cached_inputs.values() for inputs in spans)
        for inputs in self.compute_inputs(seed):
            room -= inputs.nbytes
            computed = [*computed, inputs] if room >= 0 else []
            yield inputs
        if room >= 0:
            self._cached_inputs[seed] = computed

    def pad_lanes(self, values: NamedArrays) -> Arrays:
        """Return the values of the lanes, `(padded lanes,)` for each path in order, padded by repeating the last lane."""
        columns = [np.ascontiguousarray(values[path], self._dtype) for path in self._paths]
        for path, column in zip(self._paths, columns, strict=True):
            if column.shape != (self._lanes,):
                raise ValueError(f"{path}: {self._lanes} lanes need as many values, not an array of shape {column.shape}")
        padding = (0, self._padded_lanes - self._lanes)
        return [np.pad(column, padding, "edge") for column in columns] if any(padding) else columns

    def compute_inputs(self, seed: int) -> Iterator[SharedInputs]:
        """Compute and yield the shared inputs of a run, span after span."""
        state = self._initial_state
        for first in range(0, self._steps, self._span_length):
            length = min(self._span_length, self._steps - first)
            state, block_outputs, sample_outputs = self._run_shared_part(state, seed, first, length)
            final_inputs, shared_metrics = None, []
            if first + length == self._steps:
                shared_metrics, final_inputs = ([np.asarray(x) for x in part] for part in self._finish_shared_part(state))
            sample_inputs, block_inputs = ([np.asarray(x) for x in part] for part in (sample_outputs, block_outputs))
            yield SharedInputs(length, sample_inputs, block_inputs, final_inputs, shared_metrics)

    @abc.abstractmethod
    def _simulate(self, values: Arrays, spans: Iterator[SharedInputs]) -> tuple[Arrays, Arrays]:
        """Simulate the lanes over all spans; return metrics of lanes `(padded lanes,)` and metrics that they share `()`."""


class HostSimulator(LaneSimulator):
    """Simulates lanes by code for this machine's processor; `threads` share the lanes."""

    def __init__(self, experiment: Experiment, reducers: Reducers, paths: tuple[str, ...], lanes: int, threads: int):
        super().__init__(experiment, reducers, paths, lanes)
        # plant steps within a sample: each number waits for the one before, so that wider vectors keep the core busy
        has_substeps = any(eqn.primitive.name == "scan" for eqn in self._step.jaxpr.eqns)
        together = vector_lanes(self._dtype) * (2 if has_substeps else 1)
        self._loop = Loop(
            self._step, self._dtype, values=len(paths), carry=self.carry_count, hooks=self._hooks, lanes=together
        )
        self._padded_lanes = self._loop.whole_vectors(lanes)
        # each pool has one thread, so that its lanes take span after span, whatever the other threads do
        work = self._padded_lanes * self._steps * self._dtype.itemsize
        count = min(threads, self._padded_lanes // together, max(work // _THREAD_WORK, 1))
        self._pools = [ThreadPoolExecutor(1) for _ in range(count)]

    def _simulate(self, values, spans):
        rows = np.asarray(values, self._dtype).reshape(len(values), self._padded_lanes)
        results = allocate(self._loop.signature["results"], (self._padded_lanes,))
        # vectors of lanes are dealt in turns: lanes that are done together are often neighbours, and then leave all threads
        vectors, count = np.arange(self._padded_lanes).reshape(-1, self._loop.lanes), len(self._pools)
        threads = [
            _ThreadLanes(self._loop, vectors[i::count].ravel(), rows, results, self._block_length) for i in range(count)
        ]
        running: deque[list[Future[None]]] = deque()
        inputs = None
        for inputs in spans:
            # this thread computes the shared inputs, a span or two ahead of the lanes
            is_last = inputs.final_inputs is not None
            if not running:
                # prepared here, since threads would wait for the interpreter
                for thread in threads:
                    thread.prepare_arrays(inputs)
            # in the last span this thread has nothing to compute ahead, and simulates the first lanes itself
            submitted = zip(self._pools[int(is_last) :], threads[int(is_last) :], strict=True)
            running.append([pool.submit(thread.simulate_span, inputs) for pool, thread in submitted])
            while len(running) > 2:
                _wait_for(running.popleft())
            if is_last:
                _wait_for(futures[0] for futures in list(running)[:-1])
                threads[0].simulate_span(inputs)
            while is_last and running:
                _wait_for(running.popleft())
        assert inputs is not None
        return [*results], inputs.shared_metrics


def _wait_for(futures: Iterable[Future[None]]) -> None:
    for future in futures:
        future.result()


class _ThreadLanes:
    """The lanes of one thread. Lanes that are done are removed with their carry, and the others move together.

    Args:
        loop: the compiled loop.
        lanes: places of the thread's lanes among all.
        values: values of all lanes, `(paths, all lanes)`.
        results: metrics of all lanes, `(all lanes,)` each; those of the thread's lanes are written.
        block_length: number of samples of a block.
    """

    def __init__(self, loop: Loop, lanes: np.ndarray, values: np.ndarray, results: ArrayGroup, block_length: int):
        self._loop, self._results, self._block_length, self._has_begun = loop, results, block_length, False
        # places of the running lanes, and their values and carry; further columns are padding
        self._lanes = lanes
        self._values_and_carry = np.empty((len(values) + len(loop.signature["carry"]), len(lanes)), values.dtype)
        self._values_and_carry[: len(values)] = values[:, lanes]
        self._prepared: tuple[ArrayGroup, ArrayGroup, LoopArrays] | None = None
        self._done_lanes: list[tuple[np.ndarray, np.ndarray]] = []

    def simulate_span(self, inputs: SharedInputs) -> None:
        """Simulate the lanes over a span; a call of the loop takes several blocks if the lanes are few."""
        start, is_last = 0, inputs.final_inputs is not None
        while start < inputs.length and len(self._lanes):
            flags, results, arrays = self._prepared or self.prepare_arrays(inputs)
            blocks = max(_CALL_WORK // (arrays.lanes * self._block_length), 1)
            end = min(start + blocks * self._block_length, inputs.length)
            is_end = is_last and end == inputs.length
            self._loop(arrays, end, start=start, begins=not self._has_begun, ends=is_end)
            self._has_begun, start = True, end
            if is_end:
                self._store_results(results)
            elif len(flags):
                self._remove_done_lanes(flags[0][(end - 1) // self._block_length])
        self._prepared = None
        if is_last and self._done_lanes:
            # metrics of the lanes that were removed
            self._lanes, self._values_and_carry = (
                np.concatenate(parts, axis=-1) for parts in zip(*self._done_lanes, strict=True)
            )
            self._select_lanes(np.arange(len(self._lanes)))
            _, results, arrays = self.prepare_arrays(inputs)
            self._loop(arrays, 0, ends=True)
            self._store_results(results)

    def prepare_arrays(self, inputs: SharedInputs) -> tuple[ArrayGroup, ArrayGroup, LoopArrays]:
        """Make the arrays of the loop for a span.

        Returns:
            Flags that are true for lanes that are done, `(blocks, lanes)`; results `(lanes,)`; and all arrays of the loop.
        """
        signature, width = self._loop.signature, self._values_and_carry.shape[1]
        blocks, count = -(-inputs.length // self._block_length), len(signature["values"])
        flags, results = allocate(signature["flags"], (blocks, width)), allocate(signature["results"], (width,))
        unread = [np.zeros((), dtype) for dtype in signature["final_inputs"]]
        groups = {
            "values": self._values_and_carry[:count],
            "carry": self._values_and_carry[count:],
            "sample_inputs": inputs.sample_inputs,
            "block_inputs": inputs.block_inputs,
            "final_inputs": unread if inputs.final_inputs is None else inputs.final_inputs,
            "flags": flags,
            "results": results,
        }
        arrays = LoopArrays(signature, groups, inputs.length, width, self._block_length)
        self._prepared = flags, results, arrays
        return self._prepared

    def _store_results(self, results: ArrayGroup) -> None:
        for all_lanes, part in zip(self._results, results, strict=True):
            all_lanes[self._lanes] = part[: len(self._lanes)]

    def _remove_done_lanes(self, flags: np.ndarray) -> None:
        """Remove the lanes that are done, if there are enough of them to pay for moving the others."""
        is_done = flags[: len(self._lanes)]
        remaining = np.flatnonzero(~is_done)
        if self._loop.whole_vectors(len(remaining)) <= _COMPACTION_SHARE * self._values_and_carry.shape[1]:
            done = np.flatnonzero(is_done)
            self._done_lanes.append((self._lanes[done], self._values_and_carry[:, done]))
            self._select_lanes(remaining)

    def _select_lanes(self, places: np.ndarray) -> None:
        """Keep only the lanes at these places, padded to whole vectors."""
        padding = self._loop.whole_vectors(len(places)) - len(places)
        columns = np.pad(places, (0, padding), "edge") if padding else places
        self._lanes, self._values_and_carry = self._lanes[places], np.take(self._values_and_carry, columns, axis=1)
        self._prepared = None


class DeviceSimulator(LaneSimulator):
    """Simulates lanes by one kernel of an accelerator, which computes the whole run.

    Args:
        experiment, reducers, paths, lanes: as for :class:`LaneSimulator`.
        interpret: run the kernel anywhere, slowly.

    Attributes:
        kernel: the compiled kernel; it maps the padded values of the lanes and the joined inputs (:meth:`join_spans`) to
            the metrics of the lanes.
    """

    def __init__(
        self,
        experiment: Experiment,
        reducers: Reducers,
        paths: tuple[str, ...],
        lanes: int,
        *,
        interpret: bool = False,
    ):
        # imported here, as no processor needs it, and it takes a quarter of a second
        from .pallas import LANES, Kernel

        # the shared part runs as a loop of scalars on a processor; a GPU would start a kernel for each of its steps
        with jax.default_device(host_device()):
            super().__init__(experiment, reducers, paths, lanes)
        self._padded_lanes = -(-lanes // LANES) * LANES
        kernel = Kernel(
            self._step, self._hooks, len(paths), self._padded_lanes, self._steps, self._block_length, interpret=interpret
        )
        self.kernel = kernel.compile()

    def _simulate(self, values, spans):
        all_spans = list(spans)
        metrics = self.kernel(values, self.join_spans(all_spans))
        return [np.asarray(metric) for metric in metrics], all_spans[-1].shared_metrics

    @staticmethod
    def join_spans(spans: Iterable[SharedInputs]) -> tuple[Arrays, Arrays, Arrays]:
        """Join the shared inputs of all spans: arrays for samples and for blocks, and the inputs of the metrics."""
        all_spans = list(spans)
        samples = zip(*(inputs.sample_inputs for inputs in all_spans), strict=True)
        blocks = zip(*(inputs.block_inputs for inputs in all_spans), strict=True)
        sample_inputs, block_inputs = ([np.concatenate(column) for column in columns] for columns in (samples, blocks))
        return sample_inputs, block_inputs, all_spans[-1].final_inputs or []
