"""Computes the points of a study in chunks of one shape, on all local devices.

A chunk has several seeds at a slice of the points. The scan is vmapped over points inside and over seeds outside: what all
lanes share (the excitation, in a gain map also the plant) is computed once, and noise once for each seed.
"""

import dataclasses
import functools
import itertools
import math
import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import jax
import numpy as np
import pandas as pd

from jaxbl.chain import NamedArrays
from jaxbl.config import Config, precision, prepare
from jaxbl.workers import check_cost

from .costs import Operations, count_operations, lanes_at_once, load_costs
from .metrics import add_gain_metrics, compile_gain_metrics
from .points import PointIndices, Points
from .programs import (
    BACKENDS,
    MAX_PROGRAMS,
    Backend,
    Layout,
    Program,
    RecentPrograms,
    can_run_fused,
    check_backend,
    compile_program,
    computed_metrics,
    without_cache_writes,
)


class Chunk(NamedTuple):
    """The lanes of one call of a compiled program: all its seeds at all its points.

    Attributes:
        index: number of the chunk, and of the part that stores it.
        group: index of the points' group.
        seeds: noise seeds, at most as many as the layout has.
        points: indices of points in the group, at most as many as the layout has; a range where these follow one another,
            since a study may have millions of chunks.
    """

    index: int
    group: int
    seeds: range
    points: PointIndices

    @property
    def shape(self) -> tuple[int, int]:
        """Number of seeds and of points."""
        return len(self.seeds), len(self.points)

    @property
    def lanes(self) -> int:
        """Number of lanes."""
        return math.prod(self.shape)


_REFINED_LANES_PER_DEVICE = 1024
"""Lanes that a device computes at once in a refined study: its batches are small, and would leave larger chunks mostly
empty (benchmarks/NOTES.md)."""


_CHUNK_BYTES = 100
"""Bytes of a chunk in the list of all."""
_LANE_BYTES = 200
"""Least bytes of a lane: its numbers, state and metrics."""
_TIMED_SAMPLES, _TIMED_SECONDS = 100, 0.5
"""Least length of the short runs that an estimate is made from; of large chunks 2000 samples take minutes."""
_COUNTED_GROUPS = 24
"""Largest number of groups whose operations an estimate counts."""


def _rank_coarse_first(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rank indices 0 ... count - 1 so that the first ranks cover them coarsely; return rank and level of each `(count,)`.

    Level 0 is one index, and each level doubles their number, so that each part of the range has one. This is van der
    Corput's sequence, scrambled (Owen 1995): indices at even distances would coincide with the rows of a map.
    """
    rng, bits = np.random.default_rng(0), max(count - 1, 0).bit_length()
    index = np.arange(count)
    rank = np.zeros(count, int)
    for level in range(bits):
        swapped = rng.integers(0, 2, 1 << level)[index >> bits - level]
        rank |= (index >> bits - 1 - level & 1 ^ swapped) << level
    return rank, np.frexp(rank)[1]


class Engine:
    """Compiles and runs the chunks of a study.

    Args:
        config: the study.
        layout: chunk shape; left out, one that suits the devices.
        devices: JAX devices to use; left out, all local ones.
        backend: required; left out, the faster one here, and the scan where the fused loop does not support a group.

    Attributes:
        require_backend: refuse a study that the fused loop cannot run; otherwise `fallback_reasons` says why the scan does.
        cost: seconds of compilation and of computing, and number of lanes, so far.
        fallback_reasons: what the fused loop does not support, of groups that the scan computed in its place.
    """

    def __init__(
        self,
        config: Config,
        layout: Layout | None = None,
        devices: list[Any] | None = None,
        backend: Backend | None = None,
    ):
        self.config = config
        self.points = Points(config)
        self.devices = devices or jax.local_devices()
        self.require_backend = backend is not None
        self.cost: dict[str, float] = {"compile_seconds": 0.0, "run_seconds": 0.0, "lanes": 0}
        self.fallback_reasons: dict[str, None] = {}
        chosen = check_backend(backend) or self._choose_backend()
        self.use_layout(layout or self._choose_layout(chosen, config.sweep.chunk), chosen)

    def use_layout(self, layout: Layout, backend: Backend) -> None:
        """Compute chunks of another shape, or by another backend, from now on."""
        check_cost("a chunk", _LANE_BYTES * math.prod(layout), "[sweep] chunk should be smaller, or left out")
        self.layout = layout
        self.backend: Backend = backend
        self._programs = RecentPrograms()

    @contextmanager
    def _count_seconds(self, name: str) -> Iterator[None]:
        """Add the time that the `with` block takes to the cost of this name."""
        start = time.perf_counter()
        yield
        self.cost[name] += time.perf_counter() - start

    def _choose_backend(self) -> Backend:
        """The faster backend; it must not depend on the chunk size that is set, since backends round differently."""
        # the fused loop does not support lanes that differ only in their seed
        if not self._varied_paths or not can_run_fused(self.devices):
            return "scan"
        groups, costs = self.points.groups, load_costs(self.devices)
        steps = sum(group.config.run.steps for group in groups)

        def study_seconds(backend: Backend) -> float:
            layout = self._choose_layout(backend, None)
            samples = steps * self.count_chunks(self.points.coarse_size, layout)
            return costs.study_seconds(backend, self._operations[backend], layout, samples, len(groups))

        return min(BACKENDS, key=study_seconds)

    def _choose_layout(self, backend: Backend, chunk: int | None) -> Layout:
        """Choose the chunk shape for the number of lanes that is set, or else for the number that suits the devices.

        All points come before a second seed, or in a refined study all seeds before further points. Every device gets at
        least two lanes: a program for a single lane would round differently.
        """
        count, size, seeds = len(self.devices), self.points.group_size, self.config.sweep.seeds
        if self.points.refinement is not None:
            capacity = chunk or _REFINED_LANES_PER_DEVICE * count
            # a batch has few points and needs all their seeds; each device still gets 64 points of a chunk
            seeds = min(seeds, max(capacity // (64 * count), 1))
            return Layout(seeds, max(math.ceil(capacity / seeds / count), 2) * count)
        capacity = chunk or count * lanes_at_once(self.devices, backend, self._operations[backend])
        # chunks of equal size need little padding; devices share the points or else the seeds, in a multiple of their number
        per_chunk = math.ceil(size / math.ceil(size / capacity))
        if size >= count and size > 1:
            per_chunk = max(math.ceil(per_chunk / count), 2) * count
        seeds = min(seeds, max(capacity // per_chunk, 1))
        if size == 1:
            seeds = max(math.ceil(seeds / count), 2) * count
        elif size < count:
            seeds = math.ceil(seeds / count) * count
        return Layout(seeds, per_chunk)

    @functools.cached_property
    def _operations(self) -> dict[Backend, Operations]:
        """Operations of a sample by backend, in the group with most samples."""
        return {backend: self._count_operations(backend, self._longest_config) for backend in BACKENDS}

    @property
    def _longest_config(self) -> Config:
        """The study of the group with most samples."""
        return max((group.config for group in self.points.groups), key=lambda config: config.run.steps)

    def _count_operations(self, backend: Backend, config: Config) -> Operations:
        """Count the operations of a sample in a group."""
        return count_operations(config, self._varied_paths, computed_metrics(backend, config.sweep.requested_metrics))

    @property
    def _varied_paths(self) -> list[str]:
        """Paths whose values differ from lane to lane."""
        return list(self.points.columns(np.arange(1)))

    def __len__(self) -> int:
        """Number of chunks; of a refined study, those of its coarse grid."""
        return math.prod(self._slice_counts)

    @property
    def _slice_counts(self) -> tuple[int, int, int]:
        """Numbers of groups, of slices of the seeds, and of slices of a group's points, or of its coarse grid."""
        return len(self.points.groups), self._seed_slices, math.ceil(self.points.coarse_size / self.layout.points)

    def count_chunks(self, points: int, layout: Layout | None = None) -> int:
        """Number of chunks for a number of points of a group, with all seeds; `layout` is the engine's if left out."""
        layout = layout or self.layout
        return math.ceil(self.config.sweep.seeds / layout.seeds) * math.ceil(points / layout.points)

    def chunk(self, index: int) -> Chunk:
        """The chunk with an index; of a refined study, one of its coarse grid."""
        group, seed_slice, point_slice = map(int, np.unravel_index(index, self._slice_counts))
        first = point_slice * self.layout.points
        positions = range(self.points.coarse_size)[first : first + self.layout.points]
        return Chunk(index, group, self._seed_slice(seed_slice), self.points.coarse_points(positions))

    def chunk_order(self) -> list[int]:
        """Indices of all chunks in the order in which they are computed, so that the grid is covered coarsely first.

        The first seeds come first, slices of points by their rank (:func:`_rank_coarse_first`); then the next seeds. Groups
        take turns if the programs of all groups can be held in memory.
        """
        check_cost("the list of chunks", _CHUNK_BYTES * len(self), "[sweep] chunk should be larger, or left out")
        group, seed_slice, point_slice = np.unravel_index(np.arange(len(self)), self._slice_counts)
        rank, level = _rank_coarse_first(self._slice_counts[2])
        if len(self.points.groups) <= MAX_PROGRAMS:
            keys = seed_slice, level[point_slice], group, rank[point_slice]
        else:
            keys = group, seed_slice, rank[point_slice]
        # lexsort takes the last key first
        return np.lexsort(keys[::-1]).tolist()

    def split_points(self, group: int, points: np.ndarray, first_index: int = 0) -> list[Chunk]:
        """Make chunks for points of a group with all seeds.

        They run by the same compiled program as all chunks. The chunks of the first seeds come first.

        Args:
            group: index of the group.
            points: indices of the points, `(points,)`.
            first_index: index of the first chunk; the others count up from it.
        """
        seed_slices = map(self._seed_slice, range(self._seed_slices))
        ends = range(self.layout.points, len(points), self.layout.points)
        pairs = itertools.product(seed_slices, np.split(points, ends))
        return [Chunk(index, group, seeds, point_slice) for index, (seeds, point_slice) in enumerate(pairs, first_index)]

    @property
    def _seed_slices(self) -> int:
        """Number of slices of the seeds, each for one chunk."""
        return math.ceil(self.config.sweep.seeds / self.layout.seeds)

    def _seed_slice(self, index: int) -> range:
        """Return the seeds of a slice."""
        sweep, first = self.config.sweep, index * self.layout.seeds
        return range(sweep.first_seed, sweep.first_seed + sweep.seeds)[first : first + self.layout.seeds]

    @property
    def rows(self) -> int:
        """Number of rows of all chunks: points times seeds."""
        return len(self.points.groups) * self.points.coarse_size * self.config.sweep.seeds

    def run(self, chunk: Chunk) -> pd.DataFrame:
        """Compute a chunk; the frame has one row for each seed and point, without padding."""
        group = self.points.groups[chunk.group]
        program = self._program(chunk.group)
        with precision(group.config):
            arguments = self._pad_arguments(group.config, self.points.columns(chunk.points), chunk.seeds)
            with self._count_seconds("run_seconds"):
                metrics, gains = jax.block_until_ready(program.run(*arguments))
            # compiled only now, so that the first chunk starts earlier
            self._compile_gain_metrics(group.config.run.precision)
            with self._count_seconds("run_seconds"):
                metrics = add_gain_metrics(metrics, gains, self.config.sweep.requested_metrics)
        self.cost["lanes"] += chunk.lanes
        columns = self.row_labels(chunk)
        for name in self.points.metrics:
            padded = np.asarray(metrics.get(name, np.full(chunk.shape, np.nan)))
            columns[name] = padded[: len(chunk.seeds), : len(chunk.points)].ravel()
        return pd.DataFrame(columns)

    def row_labels(self, chunk: Chunk) -> NamedArrays:
        """Axis values by path, and seeds, of the rows of a chunk."""
        group = self.points.groups[chunk.group]
        values = group.structural | self.points.columns(chunk.points)
        columns = {path: np.broadcast_to(values[path], chunk.shape).ravel() for path in self.points.paths}
        columns["seed"] = np.repeat(chunk.seeds, len(chunk.points))
        return columns

    def _pad_arguments(self, config: Config, columns: NamedArrays, seeds: range) -> tuple[Any, Any]:
        """Arguments of a compiled program, padded to the layout: values by path, and seeds."""

        def pad(values: np.ndarray, size: int) -> np.ndarray:
            return np.pad(values, (0, size - len(values)), "edge")

        dtype = config.run.precision
        padded = {path: pad(np.asarray(column, dtype), self.layout.points) for path, column in columns.items()}
        return padded, pad(np.asarray(seeds, np.uint32), self.layout.seeds)

    def compile_all(self) -> None:
        """Compile the programs of all groups. Raises `InputError` if the required backend cannot run one."""
        for group in reversed(range(len(self.points.groups))):
            self._program(group)

    def _program(self, group: int) -> Program:
        """The compiled program of a group; the last ones used stay in memory."""
        return self._programs.take(group, lambda: self._compile(self.points.groups[group].config))

    def _compile(self, config: Config) -> Program:
        with precision(config):
            experiment = prepare(config)
            columns, _ = self._pad_arguments(config, self.points.columns(np.arange(1)), range(1))
            with self._count_seconds("compile_seconds"):
                program = compile_program(
                    experiment,
                    self.layout,
                    self.devices,
                    self.backend,
                    columns,
                    metric_names=config.sweep.requested_metrics,
                    require_backend=self.require_backend,
                )
            check_cost("a chunk", 1e6 * program.megabytes, "[sweep] chunk should be smaller, or left out")
            if program.fallback_reason is not None:
                self.fallback_reasons[program.fallback_reason] = None
            return program

    def _compile_gain_metrics(self, dtype: str) -> None:
        """Compile the gain metrics for a precision, unless none are requested."""
        with self._count_seconds("compile_seconds"):
            compile_gain_metrics(self.config.sweep.requested_metrics, dtype, math.prod(self.layout))

    def estimate(self) -> "SweepEstimate":
        """Estimate memory and time of all chunks, by a compilation and short runs of the group with most samples."""
        groups, config, chunk = self.points.groups, self._longest_config, self.chunk(0)
        with without_cache_writes():
            program = self._compile(config)
            program_seconds = self.cost["compile_seconds"]
            with precision(config):
                self._compile_gain_metrics(config.run.precision)
        compile_seconds = program_seconds * (len(groups) - 1) + self.cost["compile_seconds"]
        backend: Backend = "scan" if program.fallback_reason is not None else self.backend
        # so long that the overhead of a call does not count
        predicted = self._predict_seconds(backend, config)
        steps = min(config.run.steps, max(_TIMED_SAMPLES, int(_TIMED_SECONDS / (predicted / config.run.steps))))
        short_config = config.with_keys("run", duration=steps * config.run.sample_period)
        short_program = self._compile(short_config)
        loop_seconds, gain_metric_seconds = [], []
        with precision(config):
            arguments = self._pad_arguments(short_config, self.points.columns(chunk.points), chunk.seeds)
            for _ in range(3):
                start = time.perf_counter()
                metrics, gains = jax.block_until_ready(short_program.run(*arguments))
                end = time.perf_counter()
                add_gain_metrics(metrics, gains, config.sweep.requested_metrics)
                loop_seconds.append(end - start)
                gain_metric_seconds.append(time.perf_counter() - end)
        # groups differ in plant steps, say; of many groups a selection is counted
        counted = groups[:: math.ceil(len(groups) / _COUNTED_GROUPS)]
        predicted_sum = sum(self._predict_seconds(backend, group.config) for group in counted) * len(groups) / len(counted)
        measured = statistics.median(loop_seconds) / steps * config.run.steps
        chunks, lanes = len(self) // len(groups), math.prod(self.layout)
        run_seconds = chunks * (measured * predicted_sum / predicted + statistics.median(gain_metric_seconds) * len(groups))
        return SweepEstimate(
            points=len(groups) * self.points.coarse_size,
            rows=self.rows,
            max_points=len(self.points),
            chunks=len(self),
            lanes_a_chunk=lanes,
            compile_seconds=compile_seconds,
            run_seconds=run_seconds,
            lane_steps_per_second=chunks * lanes * sum(group.config.run.steps for group in groups) / run_seconds,
            megabytes=program.megabytes,
            backend=backend,
        )

    def _predict_seconds(self, backend: Backend, config: Config) -> float:
        """Seconds that a chunk of a group should take."""
        operations = self._count_operations(backend, config)
        return load_costs(self.devices).sample_seconds(backend, operations, self.layout) * config.run.steps


@dataclasses.dataclass(frozen=True)
class SweepEstimate:
    """Estimated time and memory of a study; of a refined study, for its coarse grid.

    Attributes:
        points: number of points that are simulated in any case.
        rows: number of these points with all seeds.
        max_points: number of points of the study; of a refined study, those of its fine grid.
        chunks: number of chunks for `rows`.
        lanes_a_chunk: number of lanes of a chunk.
        compile_seconds: time of all compilations, s.
        run_seconds: time of all chunks, s.
        lane_steps_per_second: rate over all chunks.
        megabytes: memory of a chunk, MB.
        backend: backend that was timed.
    """

    points: int
    rows: int
    max_points: int
    chunks: int
    lanes_a_chunk: int
    compile_seconds: float
    run_seconds: float
    lane_steps_per_second: float
    megabytes: float
    backend: Backend
