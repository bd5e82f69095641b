"""Lanes through time by a fused loop: what :func:`jaxbl.simulate.scan` computes, for many lanes at once."""

import abc
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.drive.parameters import set_leaves
from jaxbl.simulate import (
    Experiment,
    Reducer,
    begin,
    block_length,
    figures,
    proceed,
    settled,
    simulated,
    time_of,
)

from .ahead import Shared, ahead_of_lanes
from .llvm import Loop, vector_lanes
from .pallas import LANES, Kernel
from .split import Kind, carry_kinds, split


class Passage(abc.ABC):
    """Simulates lanes of an experiment.

    Made and called in the precision of the experiment (`jax.enable_x64`).

    Args:
        experiment: with array leaves (:func:`jaxbl.drive.as_arrays`).
        reducers: figures to compute along the run.
        paths: of the leaves that differ from lane to lane.
        lanes: how many there are; compiled for this number.
        together: lanes that are computed together; their number is filled up to a multiple.

    Attributes:
        carried: numbers that a lane carries; what all share is not among them.

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

        def start(values: list[Any]) -> Any:
            return begin(own(values), reducers)

        def sample(values: list[Any], carry: Any, given: Any) -> Any:
            index, noise = given
            lane = own(values)
            return proceed(lane, reducers, carry, index, simulated(lane, time_of(lane, index), noise))[0]

        def settle(values: list[Any], carry: Any, given: Any) -> Any:
            return settled(own(values), carry)

        def result(values: list[Any], carry: Any) -> dict[str, Any]:
            return figures(own(values), reducers, carry)

        values = [jax.ShapeDtypeStruct((), dtype)] * len(paths)
        given = jax.ShapeDtypeStruct((), jnp.int32), dict.fromkeys(experiment.sides, jax.ShapeDtypeStruct((), jnp.float32))
        carry = jax.eval_shape(start, values)
        kinds = carry_kinds(start, ((sample, given), (settle, ())), values)
        self._tree = jax.tree.structure(carry)
        self._of_lane = [kind == Kind.LANE for kind in kinds]
        self.carried = sum(self._of_lane)
        self._inner = split(sample, values, carry, given, kinds)
        self._outer = split(settle, values, carry, (), kinds)

        def side_by_side(leaf: Any) -> jax.ShapeDtypeStruct:
            return jax.ShapeDtypeStruct((self._filled,), leaf.dtype)

        # compiled now, so that a call only runs
        many = [side_by_side(value) for value in values]
        one = [leaf for leaf, lane in zip(jax.tree.leaves(carry), self._of_lane, strict=True) if not lane]
        lengths = {min(self._length, self._steps), self._steps % self._length} - {0}
        self._ahead = ahead_of_lanes(Shared(self._inner.shared, self._outer.shared, one, experiment.sides), lengths)
        self._start = jax.jit(jax.vmap(start)).lower(many).compile()
        axes = self._tree.unflatten([0 if lane else None for lane in self._of_lane])
        ends = [side_by_side(x) if lane else x for x, lane in zip(jax.tree.leaves(carry), self._of_lane, strict=True)]
        self._result = jax.jit(jax.vmap(result, (0, axes))).lower(many, self._tree.unflatten(ends)).compile()

    def __call__(self, values: dict[str, np.ndarray], seed: int) -> dict[str, np.ndarray]:
        """Figures `(lanes,)` of one seed, by name; `values` `(lanes,)` by path, in SI units."""
        more = (0, self._filled - self._lanes)
        given = [np.pad(np.asarray(values[path], self._dtype), more, "edge") for path in self._paths]
        leaves = jax.tree.leaves(self._start(given))
        carry = [leaf for leaf, lane in zip(leaves, self._of_lane, strict=True) if lane]
        state = [np.asarray(leaf)[0] for leaf, lane in zip(leaves, self._of_lane, strict=True) if not lane]
        carry, state = map(iter, self._march(given, carry, state, seed))
        whole = self._tree.unflatten([next(carry) if lane else next(state) for lane in self._of_lane])
        return {name: np.asarray(figure)[: self._lanes] for name, figure in self._result(given, whole).items()}

    @abc.abstractmethod
    def _march(self, given: list[Any], carry: list[Any], state: list[Any], seed: int) -> tuple[list[Any], list[Any]]:
        """Carry of the lanes `(lanes,)` each, and state of what they share, after all samples."""


class HostPassage(Passage):
    """By code for this machine's processor; threads share the lanes."""

    def __init__(
        self, experiment: Experiment, reducers: tuple[Reducer, ...], paths: tuple[str, ...], lanes: int, threads: int
    ):
        dtype = np.dtype(jnp.result_type(experiment.run.sample_period))
        self._together, self._threads = vector_lanes(dtype), threads
        self._pool = ThreadPoolExecutor(threads)
        super().__init__(experiment, reducers, paths, lanes, self._together)
        self._loop = Loop(self._inner.lane, self._outer.lane, len(paths), self.carried, self._dtype)

    def _march(self, given, carry, state, seed):
        carry = [np.array(leaf, order="C") for leaf in carry]
        blocks = len(given[0]) // self._together
        edges = [blocks * i // self._threads * self._together for i in range(self._threads + 1)]
        ahead = self._ahead(state, seed, 0, min(self._length, self._steps))
        for first in range(0, self._steps, self._length):
            state, last, handed = ahead
            last, handed = [np.asarray(x) for x in last], [np.asarray(x) for x in handed]
            arrays = [*given, *carry, *handed, *last]
            length = min(self._length, self._steps - first)
            running = [self._pool.submit(self._loop, arrays, length, *pair) for pair in pairwise(edges)]
            # what lanes share of the next samples is computed meanwhile
            if rest := self._steps - first - length:
                ahead = self._ahead(state, seed, first + length, min(self._length, rest))
            for one in running:
                one.result()
        return carry, state


class DevicePassage(Passage):
    """By one kernel of an accelerator, which takes its lanes through the whole run; `interpret` runs it anywhere, slowly."""

    def __init__(
        self,
        experiment: Experiment,
        reducers: tuple[Reducer, ...],
        paths: tuple[str, ...],
        lanes: int,
        *,
        interpret: bool = False,
    ):
        # a loop of scalars is the work of a processor; a GPU would start a kernel for each of its steps
        with jax.default_device(jax.local_devices(backend="cpu")[0]):
            super().__init__(experiment, reducers, paths, lanes, LANES)
        self._kernel = Kernel(self._inner.lane, self._outer.lane, len(paths), self.carried, interpret=interpret)

    def _march(self, given, carry, state, seed):
        blocks, rest = divmod(self._steps, self._length)
        state, parts = [np.asarray(leaf) for leaf in state], []
        for first in range(0, self._steps, self._length):
            state, *part = self._ahead(state, seed, first, min(self._length, self._steps - first))
            parts.append(part)
        for some in (parts[:blocks], parts[blocks:] if rest else []):
            if some:
                last, handed = ([np.stack([np.asarray(x) for x in column]) for column in zip(*one, strict=True)]
                                for one in zip(*some, strict=True))  # fmt: skip
                carry = self._kernel(given, carry, handed, last)
        return [np.asarray(leaf) for leaf in carry], state
