"""Runs the points of a study: chunks of one static shape over all local devices, one atomic file per chunk.

A chunk is a block of seeds times a block of points. The lane function is vmapped over points inside and seeds outside, so
that what depends on neither (the excitation, the plant in a gain map) is computed once, and noise once a seed.
"""

import dataclasses
import functools
import math
import statistics
import time
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
import pandas as pd

from jaxbl.config import Config, precision, prepare

from .costs import Operations, choose_backend, count_operations, lanes_at_once, load_costs
from .metrics import MetricNames, ObserverGains, add_gain_metrics, compile_gain_metrics, needs_gain_metrics
from .points import Points
from .programs import (
    BACKENDS,
    Backend,
    Layout,
    Program,
    check_backend,
    compile_program,
    computed_metrics,
    without_cache_writes,
)


class Chunk(NamedTuple):
    """One call of a compiled program: every one of some seeds at every one of some points of a group (their indices), as
    many of both as the layout's, or fewer."""

    index: int
    group: int
    seeds: np.ndarray
    points: np.ndarray


_REFINED_LANES_PER_DEVICE = 1024
"""Lanes that a device computes at once in a refined study: its batches are small, and fill larger chunks badly
(benchmarks/NOTES.md)."""


def layout_for(config: Config, points: Points, count: int, capacity: int) -> Layout:
    """Chunk shape of at most so many lanes for so many devices: whole rows of points before several seeds.

    Every device gets two lanes or more: one alone is compiled to other roundings than a row of them.
    """
    if points.refinement is not None:
        # several seeds before whole rows of points: a batch has few points, and needs all seeds of them; as many seeds as
        # leave every device 64 points of a chunk
        seeds = min(config.sweep.seeds, max(capacity // (64 * count), 1))
        return Layout(seeds, max(math.ceil(capacity / seeds / count), 2) * count)
    # chunks of equal size waste no padding on the last one; a multiple of the devices, along the longer side, suits them
    per_chunk = math.ceil(points.group_size / math.ceil(points.group_size / capacity))
    if points.group_size >= count and points.group_size > 1:
        per_chunk = max(math.ceil(per_chunk / count), 2) * count
    seeds = min(config.sweep.seeds, max(capacity // per_chunk, 1))
    if points.group_size == 1:
        seeds = max(math.ceil(seeds / count), 2) * count
    elif points.group_size < count:
        seeds = math.ceil(seeds / count) * count
    return Layout(seeds, per_chunk)


_PROGRAMS = 16
"""Compiled programs that are kept, one a group."""
_TRIED_SAMPLES, _TRIED_SECONDS = 2000, 0.3
"""Of the short runs that an estimate is made from, at least."""
_COUNTED_GROUPS = 24
"""Groups whose steps an estimate counts, at most."""


def _coarse_first(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Place of each of some blocks in an order that covers them coarsely first, and its level `(count,)`.

    Level 0 is one block, and each further level doubles their number, one in each part of the whole: van der Corput's
    sequence, scrambled (Owen 1995), as blocks at even distances would fall together with rows of a map.
    """
    rng, bits = np.random.default_rng(0), max(count - 1, 0).bit_length()
    index = np.arange(count)
    place = np.zeros(count, int)
    for level in range(bits):
        swapped = rng.integers(0, 2, 1 << level)[index >> bits - level]
        place |= (index >> bits - 1 - level & 1 ^ swapped) << level
    return place, np.frexp(place)[1]


class Engine:
    """Compiles and runs the chunks of a study.

    Args:
        config: the study.
        layout: chunk shape; left out, one that suits the devices.
        devices: JAX devices to use; left out, all local ones.
        backend: left out, the faster one here.
        require_backend: refuse a study that the fused loop cannot run; otherwise the scan runs it, and `fallback_reasons`
            says why.
    """

    def __init__(
        self,
        config: Config,
        layout: Layout | None = None,
        devices: list[Any] | None = None,
        backend: Backend | None = None,
        require_backend: bool = False,
    ):
        self.config = config
        self.points = Points(config)
        self.devices = devices or jax.local_devices()
        self.backend: Backend = check_backend(backend) or self._faster()
        self.require_backend = require_backend
        self.layout = layout or self._layout(self.backend, config.sweep.chunk)
        self.compile_seconds = 0.0
        self.run_seconds = 0.0
        self.fallback_reasons: list[str] = []
        self._compiled: OrderedDict[int, Program] = OrderedDict()
        self._judging: set[str] = set()

    def _faster(self) -> Backend:
        """By the study, however it is cut: roundings differ between backends."""
        if not self._varied:
            # lanes that differ only in their seed
            return "scan"
        layouts: dict[Backend, Layout] = {backend: self._layout(backend, None) for backend in BACKENDS}
        steps = sum(group.config.run.steps for group in self.points.groups)
        samples: dict[Backend, int] = {
            b: steps * self._chunks(layout, self.points.coarse_size) for b, layout in layouts.items()
        }
        return choose_backend(self.devices, self._works, layouts, samples, len(self.points.groups))

    def _layout(self, backend: Backend, chunk: int | None) -> Layout:
        """Chunk shape: as many lanes as asked for, or as the devices want at once."""
        if chunk is None and self.points.refinement is not None:
            chunk = _REFINED_LANES_PER_DEVICE * len(self.devices)
        capacity = chunk or len(self.devices) * lanes_at_once(self.devices, backend, self._works[backend])
        return layout_for(self.config, self.points, len(self.devices), capacity)

    @functools.cached_property
    def _works(self) -> dict[Backend, Operations]:
        """Of a sample by either backend, in the group that has most of them."""
        config = max(self.points.groups, key=lambda group: group.config.run.steps).config
        asked: dict[Backend, MetricNames] = {
            backend: computed_metrics(backend, config.sweep.requested_metrics) for backend in BACKENDS
        }
        found = {names: count_operations(config, self._varied, names) for names in set(asked.values())}
        return {backend: found[names] for backend, names in asked.items()}

    @property
    def _varied(self) -> list[str]:
        """Paths that differ from lane to lane."""
        return list(self.points.columns(np.arange(1)))

    def __len__(self) -> int:
        """Number of chunks; of a refined study, those of its coarse grid."""
        return len(self.points.groups) * self.count_chunks(self.points.coarse_size)

    def count_chunks(self, points: int) -> int:
        """Number of chunks that some points of a group take."""
        return self._chunks(self.layout, points)

    def _chunks(self, layout: Layout, points: int) -> int:
        return math.ceil(self.config.sweep.seeds / layout.seeds) * math.ceil(points / layout.points)

    def chunk(self, index: int) -> Chunk:
        """A chunk by its index; of a refined study, one of its coarse grid."""
        blocks = math.ceil(self.points.coarse_size / self.layout.points)
        group, rest = divmod(index, len(self._seeds) * blocks)
        seeds, block = divmod(rest, blocks)
        first = block * self.layout.points
        last = min(first + self.layout.points, self.points.coarse_size)
        return Chunk(index, group, self._seeds[seeds], self.points.coarse_points(np.arange(first, last)))

    def lanes(self, index: int) -> int:
        """Lanes of a chunk."""
        chunk = self.chunk(index)
        return len(chunk.seeds) * len(chunk.points)

    def chunk_order(self) -> list[int]:
        """Indices of all chunks, those first that cover the grid coarsely: the first seeds of every second block of points,
        of those between, and so on, then the next seeds. Groups take turns where their programs can all be kept."""
        blocks = math.ceil(self.points.coarse_size / self.layout.points)
        shape = len(self.points.groups), len(self._seeds), blocks
        group, seeds, block = np.unravel_index(np.arange(math.prod(shape)), shape)
        place, level = _coarse_first(blocks)
        turns = level[block] if shape[0] <= _PROGRAMS else np.zeros_like(block)
        outer = (seeds, turns, group) if shape[0] <= _PROGRAMS else (group, seeds, turns)
        # the last key is the first one to be sorted by
        return np.lexsort((place[block], *reversed(outer))).tolist()

    def split(self, group: int, points: np.ndarray, first_index: int = 0) -> list[Chunk]:
        """Chunks for any points of a group, given by their indices `(points,)`, with all seeds; numbered from `first_index`.

        They share the compiled program of all chunks. Points come in their order, all of them for some seeds first.
        """
        parts = [points[first : first + self.layout.points] for first in range(0, len(points), self.layout.points)]
        crossed = [(seeds, part) for seeds in self._seeds for part in parts]
        return [Chunk(index, group, *both) for index, both in enumerate(crossed, first_index)]

    @functools.cached_property
    def _seeds(self) -> list[np.ndarray]:
        """All seeds, as many at once as a chunk takes."""
        end = self.config.sweep.first_seed + self.config.sweep.seeds
        return [
            np.arange(first, min(first + self.layout.seeds, end))
            for first in range(self.config.sweep.first_seed, end, self.layout.seeds)
        ]

    @property
    def rows(self) -> int:
        """Rows of all chunks: points times seeds."""
        return len(self.points.groups) * self.points.coarse_size * self.config.sweep.seeds

    def run(self, chunk: Chunk) -> pd.DataFrame:
        """Compute one chunk: a frame of one row for each seed and point, padding taken off."""
        group = self.points.groups[chunk.group]
        program = self._program(chunk.group)
        with precision(group.config):
            given = self._arguments(group.config, self.points.columns(chunk.points), chunk.seeds)
            start = time.perf_counter()
            found = jax.block_until_ready(program.run(*given))
            self.run_seconds += time.perf_counter() - start
            # only now, as the first lanes need not wait for them
            self._compile_gain_metrics(group.config.run.precision)
            start = time.perf_counter()
            figures = self._judged(*found)
            self.run_seconds += time.perf_counter() - start
        data = self.row_labels(chunk)
        for name in self.points.metrics:
            own = np.asarray(figures.get(name, np.full((len(chunk.seeds), len(chunk.points)), np.nan)))
            data[name] = own[: len(chunk.seeds), : len(chunk.points)].ravel()
        return pd.DataFrame(data)

    def row_labels(self, chunk: Chunk) -> dict[str, np.ndarray]:
        """What tells the rows of a chunk apart: values by axis path, and seeds."""
        group = self.points.groups[chunk.group]
        values = group.structural | self.points.columns(chunk.points)
        shape = (len(chunk.seeds), len(chunk.points))
        data = {path: np.broadcast_to(values[path], shape).ravel() for path in self.points.paths}
        data["seed"] = np.broadcast_to(chunk.seeds[:, None], shape).ravel()
        return data

    def _arguments(self, config: Config, columns: dict[str, np.ndarray], seeds: np.ndarray) -> tuple[Any, Any]:
        """Padded arrays for a compiled program: values by path, seeds."""

        def pad(values: np.ndarray, size: int) -> np.ndarray:
            return np.concatenate([values, np.repeat(values[-1:], size - len(values), axis=0)])

        dtype = config.run.precision
        padded = {path: pad(np.asarray(v, dtype), self.layout.points) for path, v in columns.items()}
        return padded, pad(seeds.astype(np.uint32), self.layout.seeds)

    def compile_all(self) -> None:
        """Compile the programs of all groups; the first ones are kept. Raises `InputError` if the backend cannot be had."""
        for group in reversed(range(len(self.points.groups))):
            self._program(group)

    def _program(self, group: int) -> Program:
        """The compiled program of a group; those used last are kept."""
        if group not in self._compiled:
            self._compiled[group] = self._compile(self.points.groups[group].config)
        self._compiled.move_to_end(group)
        while len(self._compiled) > _PROGRAMS:
            self._compiled.popitem(last=False)
        return self._compiled[group]

    def _compile(self, config: Config) -> Program:
        with precision(config):
            experiment = prepare(config)
            columns, _ = self._arguments(config, self.points.columns(np.arange(1)), np.arange(1))
            start = time.perf_counter()
            program = compile_program(
                experiment,
                self.layout,
                self.devices,
                self.backend,
                columns,
                metric_names=config.sweep.requested_metrics,
                require_backend=self.require_backend,
            )
            self.compile_seconds += time.perf_counter() - start
            if program.fallback_reason is not None and program.fallback_reason not in self.fallback_reasons:
                self.fallback_reasons.append(program.fallback_reason)
            return program

    def _judged(self, figures: dict[str, Any], gains: dict[str, ObserverGains]) -> Mapping[str, Any]:
        """Figures of a chunk with those that follow from them, if any of these is asked for."""
        return add_gain_metrics(figures, gains) if needs_gain_metrics(self.config.sweep.requested_metrics) else figures

    def _compile_gain_metrics(self, dtype: str) -> None:
        if dtype not in self._judging and needs_gain_metrics(self.config.sweep.requested_metrics):
            self._judging.add(dtype)
            start = time.perf_counter()
            compile_gain_metrics(dtype, self.layout.seeds * self.layout.points)
            self.compile_seconds += time.perf_counter() - start

    def estimate(self) -> "SweepEstimate":
        """Memory and time of all chunks, from a compilation and short runs of a chunk of the group that has most samples."""
        groups = self.points.groups
        group = max(range(len(groups)), key=lambda index: groups[index].config.run.steps)
        config, chunk = groups[group].config, self.chunk(group * (len(self) // len(groups)))
        with without_cache_writes():
            program = self._compile(config)
            a_program = self.compile_seconds
            with precision(config):
                self._compile_gain_metrics(config.run.precision)
        compiling = a_program * len(groups) + self.compile_seconds - a_program
        backend: Backend = "scan" if program.fallback_reason is not None else self.backend
        # long enough for what a call costs not to count
        expected = self._seconds(backend, config) / config.run.steps
        steps = min(config.run.steps, max(_TRIED_SAMPLES, int(_TRIED_SECONDS / expected)))
        brief = config.model_copy(
            update={"run": config.run.model_copy(update={"duration": steps * config.run.sample_period})}
        )
        tried = self._compile(brief)
        running, judging = [], []
        with precision(config):
            given = self._arguments(brief, self.points.columns(chunk.points), chunk.seeds)
            for _ in range(3):
                begun = time.perf_counter()
                found = jax.block_until_ready(tried.run(*given))
                ended = time.perf_counter()
                self._judged(*found)
                running.append(ended - begun)
                judging.append(time.perf_counter() - ended)
        # other groups take other numbers of plant steps, say; where there are many, some stand for all
        counted = groups[:: math.ceil(len(groups) / _COUNTED_GROUPS)]
        all_groups = sum(self._seconds(backend, one.config) for one in counted) * len(groups) / len(counted)
        a_chunk = statistics.median(running) / steps * config.run.steps * all_groups / self._seconds(backend, config)
        chunks, lanes = len(self) // len(groups), math.prod(self.layout)
        run_seconds = chunks * (a_chunk + statistics.median(judging) * len(groups))
        return SweepEstimate(
            points=len(groups) * self.points.coarse_size,
            rows=self.rows,
            most_points=len(self.points),
            chunks=len(self),
            lanes_a_chunk=lanes,
            compile_seconds=compiling,
            run_seconds=run_seconds,
            lane_steps_per_second=chunks * lanes * sum(one.config.run.steps for one in groups) / run_seconds,
            megabytes=program.megabytes,
            backend=backend,
        )

    def _seconds(self, backend: Backend, config: Config) -> float:
        """That a chunk of a group should take."""
        work = count_operations(config, self._varied, computed_metrics(backend, config.sweep.requested_metrics))
        return load_costs(self.devices).sample(backend, work, self.layout) * config.run.steps


@dataclasses.dataclass(frozen=True)
class SweepEstimate:
    """What a study will cost; a refined one, what its coarse grid will cost.

    Attributes:
        points: points that are simulated in any case.
        rows: these with all seeds.
        most_points: points of the study; of a refined one, those of its fine grid.
        chunks: chunks for `rows`, of `lanes_a_chunk` lanes each.
        compile_seconds: time of all compilations; `run_seconds`, of all chunks.
        lane_steps_per_second: rate over all chunks, with `backend`.
        megabytes: memory of a chunk, MB.
    """

    points: int
    rows: int
    most_points: int
    chunks: int
    lanes_a_chunk: int
    compile_seconds: float
    run_seconds: float
    lane_steps_per_second: float
    megabytes: float
    backend: Backend
