"""A sweep's lanes through time by the fused loop: what :func:`jaxbl.simulate.scan` computes, many lanes at once."""

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
    unit_noise,
)

from .llvm import Loop
from .split import Kind, carry_kinds, split


class Passage:
    """Simulates lanes of an experiment; compiled for their structure, whatever their number.

    Args:
        experiment: with array leaves (:func:`jaxbl.drive.as_arrays`).
        reducers: figures to compute along the run.
        paths: of the leaves that differ from lane to lane.
        threads: that share the lanes.

    Attributes:
        lanes: that are computed together.
        carried: numbers that a lane carries; what all share is not among them.

    Raises:
        Unsupported: a step does something that the compiler has no instruction for.
    """

    def __init__(self, experiment: Experiment, reducers: tuple[Reducer, ...], paths: tuple[str, ...], threads: int):
        self._paths, self._threads, self._steps = paths, threads, experiment.run.steps
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

        number = jax.ShapeDtypeStruct((), dtype)
        values = [number] * len(paths)
        given = jax.ShapeDtypeStruct((), jnp.int32), dict.fromkeys(experiment.sides, jax.ShapeDtypeStruct((), jnp.float32))
        carry = jax.eval_shape(start, values)
        self._tree = jax.tree.structure(carry)
        kinds = carry_kinds(start, ((sample, given), (settle, ())), values)
        self._of_lane = [kind == Kind.LANE for kind in kinds]
        inner = split(sample, values, carry, given, kinds)
        outer = split(settle, values, carry, (), kinds)
        self._fixed = [np.asarray(value) for value in inner.fixed], [np.asarray(value) for value in outer.fixed]
        counts = len(inner.fixed), len(outer.fixed)
        self.carried = sum(self._of_lane)
        self._loop = Loop(inner.lane, outer.lane, len(values), self.carried, counts, self._dtype)
        self.lanes = self._loop.lanes

        def shared(state: list[Any], seed: Any, first: Any, length: int) -> tuple[list[Any], list[Any], list[Any]]:
            indices = first + jnp.arange(length, dtype=jnp.int32)
            noise = unit_noise(seed, indices, experiment.sides)
            state, handed = jax.lax.scan(inner.shared, state, (indices, noise))
            return *outer.shared(state, ()), handed

        self._shared = jax.jit(shared, static_argnums=3)
        self._start = jax.jit(jax.vmap(start))
        axes = self._tree.unflatten([0 if lane else None for lane in self._of_lane])

        def result(values: list[Any], carry: Any) -> dict[str, Any]:
            return figures(own(values), reducers, carry)

        self._result = jax.jit(jax.vmap(result, (0, axes)))
        self._first = jax.jit(
            lambda: [
                leaf
                for leaf, lane in zip(
                    jax.tree.leaves(start([jnp.zeros((), dtype)] * len(paths))), self._of_lane, strict=True
                )
                if not lane
            ]
        )

    def __call__(self, values: dict[str, np.ndarray], seed: int) -> dict[str, np.ndarray]:
        """Figures `(lanes,)` of one seed; `values` `(lanes,)` by path."""
        lanes = len(next(iter(values.values())))
        padded = -(-lanes // self.lanes) * self.lanes
        given = [np.pad(np.asarray(values[path], self._dtype), (0, padded - lanes), "edge") for path in self._paths]
        carry = [
            np.array(leaf, order="C")
            for leaf, lane in zip(jax.tree.leaves(self._start(given)), self._of_lane, strict=True)
            if lane
        ]
        state = self._first()
        blocks = padded // self.lanes
        edges = [blocks * i // self._threads * self.lanes for i in range(self._threads + 1)]
        with ThreadPoolExecutor(self._threads) as pool:
            first = 0
            ahead = self._ahead(state, seed, first)
            while first < self._steps:
                length = min(self._length, self._steps - first)
                state, last, handed = ahead
                first += length
                inputs = [np.asarray(x) for x in handed]
                arrays = [*given, *carry, *self._fixed[0], *inputs, *self._fixed[1], *map(np.asarray, last)]
                running = [pool.submit(self._loop, arrays, length, *pair) for pair in pairwise(edges)]
                # what all lanes share of the next samples is computed meanwhile
                if first < self._steps:
                    ahead = self._ahead(state, seed, first)
                for one in running:
                    one.result()
        left, right = iter(carry), iter(state)
        whole = self._tree.unflatten([next(left) if lane else next(right) for lane in self._of_lane])
        return {name: np.asarray(figure)[:lanes] for name, figure in self._result(given, whole).items()}

    def _ahead(self, state: Any, seed: int, first: int) -> Any:
        length = min(self._length, self._steps - first)
        return self._shared(state, np.uint32(seed), np.int32(first), length)
