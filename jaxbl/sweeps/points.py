"""The points of a study: axes crossed, zipped or sampled quasi-randomly, computed a slice at a time.

Axes over leaves of the experiment become lanes of one compiled program. Axes over what is fixed at compile time (sampling
period, substeps, discretisation, ...) are outermost and split the study into groups, each compiled once.

A refined study has the points of its fine grid; those of the coarse grid, where it begins, are among them.
"""

import math
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from jaxbl.config import KIND, TOLERANCE, AxisTable, Config, numeric_paths, with_values
from jaxbl.drive.parameters import leaf_paths
from jaxbl.errors import InputError
from jaxbl.files import plain
from jaxbl.simulate import Experiment

from .metrics import metric_columns, no_metric
from .refine import CellGrid, Criterion

AxisColumns = dict[str, np.ndarray]
"""Values by axis path, columns of equal length: of axes that advance together, or of points."""

_MOST_RUNS = 1e10
"""A day of computing on two cores, of runs of 20 000 samples (docs/speed.md): more is a slip in the axes."""
_MOST_VALUES = 10_000_000
"""Of one axis: its values are kept."""


class Group(NamedTuple):
    """Points that share one compiled program: the config with its structural values set, and those values."""

    config: Config
    structural: dict[str, Any]


class Refinement(NamedTuple):
    """How a study is refined: the axes, their grid with all lane axes, and when neighbours disagree."""

    paths: list[str]
    grid: CellGrid
    criterion: Criterion


class Points:
    """All points of a study, first axis slowest, structural axes outermost.

    Each group, one for each combination of structural values, has `lanes` points. `coarse_lanes` of them are always
    simulated: all, or the coarse grid of a refined study. `blocks` has the values of each axis in the order of the config,
    those that advance together as one.
    `metrics` are the columns of all groups: one that does not apply to the observers of a group is NaN there.
    """

    def __init__(self, config: Config):
        self.paths = [axis.path for axis in config.axes]
        for i, path in enumerate(self.paths):
            if path in self.paths[:i]:
                raise InputError(f"axes[{i}]: path '{path}' has an axis already; each path may have one")
        base, self.leaves = self._check(config)
        self.metrics = metrics = metric_columns(base.build(), config.sweep.metrics, self._kinds(config, base))
        refined = self._refined(config)
        depth = config.sweep.refine or 0
        self.blocks = blocks = self._blocks(config, dict.fromkeys(refined, depth))
        structural = [b for b in blocks if not all(path in self.leaves for path in b)]
        self._blocks_of_leaves = [b for b in blocks if all(path in self.leaves for path in b)]
        self.lanes = _points_of(self._blocks_of_leaves)
        self.refinement: Refinement | None = None
        self.coarse_lanes = self.lanes
        if refined:
            halved = [next(iter(b)) in refined for b in self._blocks_of_leaves]
            fine = [_length(b) for b in self._blocks_of_leaves]
            sizes = [(n - 1 >> depth) + 1 if h else n for n, h in zip(fine, halved, strict=True)]
            self.coarse_lanes = math.prod(sizes)
            self.refinement = Refinement(refined, CellGrid(sizes, halved, depth), _criterion(config, base, metrics, refined))
        outside = _points_of(structural) * config.sweep.seeds
        if (runs := outside * self.coarse_lanes) > _MOST_RUNS:
            raise InputError(f"axes: {runs:.2g} runs are more than {_MOST_RUNS:.0e}; fewer values, or a quasi-random design")
        if (runs := outside * self.lanes) > _MOST_RUNS:
            raise InputError(
                f"sweep.refine: {depth} makes a fine grid of {runs:.2g} runs, more than {_MOST_RUNS:.0e}; "
                "it should be less, or the axes should have fewer values"
            )
        self.groups = []
        for index in range(_points_of(structural)):
            values = {path: column[0] for path, column in _take(structural, np.array([index])).items()}
            values = {path: plain(v) for path, v in values.items()}
            self.groups.append(Group(with_values(base, values), values))

    def __len__(self) -> int:
        return len(self.groups) * self.lanes

    def columns(self, indices: np.ndarray) -> AxisColumns:
        """Values of the lane axes at some points of a group, by path; float64 arrays of the shape of `indices`."""
        return _take(self._blocks_of_leaves, indices)

    def coarse(self, positions: np.ndarray) -> np.ndarray:
        """Points of a group that are always simulated, by their positions 0 ... coarse_lanes - 1 among these."""
        return positions if self.refinement is None else self.refinement.grid.coarse(positions)

    def values(self, path: str) -> np.ndarray:
        """All values of a lane axis in their order, those of the fine grid if it is refined."""
        return next(block[path] for block in self._blocks_of_leaves if path in block)

    def always_simulated(self, columns: Mapping[str, Any]) -> np.ndarray:
        """Which rows of a frame, or of its columns by name, are on points that are always simulated."""
        if self.refinement is None:
            return np.ones(len(columns["seed"]), bool)
        stride = 1 << self.refinement.grid.depth
        on_axes = [np.isin(columns[path], self.values(path)[::stride]) for path in self.refinement.paths]
        return np.logical_and.reduce(on_axes)

    def _refined(self, config: Config) -> list[str]:
        """Paths of the refined axes."""
        depth = config.sweep.refine
        if depth is None:
            return []
        axes = [axis for axis in config.axes if axis.num and axis.zip is None and axis.path in self.leaves]
        if not axes:
            raise InputError(
                "sweep.refine: no axis can be refined; one is needed with start, stop and num, not zipped, and not fixed at "
                "compile time"
            )
        for axis in axes:
            assert axis.num is not None
            most = ((_MOST_VALUES - 1) // (axis.num - 1)).bit_length() - 1
            if depth > most:
                limit = f"should be at most {most}" if most > 0 else "does not fit here: num is too large"
                raise InputError(
                    f"sweep.refine: {depth} makes more than {_MOST_VALUES:.0e} values of '{axis.path}'; it {limit}"
                )
        return [axis.path for axis in axes]

    @staticmethod
    def _kinds(config: Config, base: Config) -> list[Experiment]:
        """An experiment with each kind of observer, where that is an axis; each has the gains that other axes vary."""
        kinds = [axis.values or [] for axis in config.axes if axis.path == KIND]
        found = [with_values(base, {KIND: kind}) for kind in (kinds[0] if kinds else ())]
        for one in found:
            known = numeric_paths(one)
            for i, axis in enumerate(config.axes):
                if axis.path not in known:
                    raise InputError(
                        f"axes[{i}]: '{axis.path}' is no gain of kind '{one.observer.kind}', which is among the values of "
                        f"{KIND}; an axis over it needs gains that all kinds listed have, or a study of its own"
                    )
        return [one.build() for one in found]

    @staticmethod
    def _check(config: Config) -> tuple[Config, set[str]]:
        """The config with every axis at its first value (so that optional numbers exist), and the paths that are leaves."""
        first = {}
        # what gains there are depends on it
        kind = {axis.path: axis.values[0] for axis in config.axes if axis.path == KIND and axis.values}
        with suppress(InputError):
            config = with_values(config, kind)
        for i, axis in enumerate(config.axes):
            ends = axis.values if axis.values is not None else [axis.start, axis.stop]
            for value in _extremes(ends):
                try:
                    with_values(config, {axis.path: value})
                except InputError as error:
                    raise InputError(f"axes[{i}]: {error}") from None
            first[axis.path] = ends[0]
        base = with_values(config, first)
        return base, set(leaf_paths(base.build()))

    def _blocks(self, config: Config, depths: Mapping[str, int]) -> list[AxisColumns]:
        sampled = [axis for axis in config.axes if axis.values is None and axis.num is None]
        if sampled and config.sweep.design == "grid":
            i = config.axes.index(sampled[0])
            raise InputError(f"axes[{i}]: num is missing for '{sampled[0].path}'; how many values should the grid have?")
        if config.sweep.design != "grid":
            if not sampled:
                raise InputError(
                    f"sweep.design: '{config.sweep.design}' needs an axis with start and stop and without num and values"
                )
            if config.sweep.points is None:
                raise InputError("sweep.points is missing: how many quasi-random points?")
        elif config.sweep.points is not None:
            raise InputError("sweep.points belongs to design = 'sobol' or 'latin_hypercube'; a grid has num on its axes")
        for axis in sampled:
            if axis.path not in self.leaves:
                raise InputError(f"axes: '{axis.path}' is fixed at compile time; list its values instead of sampling it")
            if axis.zip is not None:
                raise InputError(
                    f"axes: '{axis.path}' is sampled quasi-randomly and cannot be zipped; leave zip out, or list its values"
                )
        blocks: list[AxisColumns] = []
        labels: dict[str, int] = {}
        for axis in config.axes:
            if axis in sampled:
                if axis is sampled[0]:
                    blocks.append(_quasi_random(sampled, config))
            elif axis.zip is None:
                blocks.append({axis.path: axis.grid(depths.get(axis.path, 0))})
            elif axis.zip not in labels:
                labels[axis.zip] = len(blocks)
                blocks.append({axis.path: axis.grid()})
            else:
                block, values = blocks[labels[axis.zip]], axis.grid()
                if len(values) != (others := _length(block)):
                    raise InputError(
                        f"axes: '{axis.path}' has {len(values)} values, the others zipped as '{axis.zip}' have {others}; "
                        "they should have equally many"
                    )
                block[axis.path] = values
        for label, index in labels.items():
            columns = blocks[index]
            if len(columns) < 2 or label in (*self.paths, "seed"):
                raise InputError(
                    f"axes: zip = '{label}' should be a word of its own, the same on all axes that advance together"
                )
            if len(set(zip(*(column.tolist() for column in columns.values()), strict=True))) < _length(columns):
                raise InputError(f"axes: the axes zipped as '{label}' list a point twice; their points should differ")
        return blocks


def _extremes(values: list[Any]) -> list[Any]:
    """The first, least and largest of many numbers: what a key may be is an interval. Other lists as they are."""
    # each check builds a config, some milliseconds
    if len(values) <= 16 or any(isinstance(value, str) for value in values):
        return values
    return [values[0], min(values), max(values)]


def _length(block: AxisColumns) -> int:
    return len(next(iter(block.values())))


def _points_of(blocks: list[AxisColumns]) -> int:
    """Points of a product of blocks."""
    return math.prod(_length(block) for block in blocks)


def _take(blocks: list[AxisColumns], indices: np.ndarray) -> AxisColumns:
    """Values of a product of blocks at some flat indices, last block fastest."""
    out: AxisColumns = {}
    remaining = indices
    for block in reversed(blocks):
        out |= {path: column[remaining % _length(block)] for path, column in block.items()}
        remaining = remaining // _length(block)
    return out


def _criterion(config: Config, base: Config, metrics: list[str], refined: list[str]) -> Criterion:
    """When neighbours disagree: in the metric that the study names, or in what converges; `metrics` are its columns."""
    metric, tolerance = config.sweep.refine_metric, config.sweep.refine_tolerance
    if metric is None:
        converged = [name for name in metrics if name.endswith(".converged")]
        if not converged:
            raise InputError(
                "sweep.refine_metric is missing: neighbours are compared in 'converged', which sweep.metrics lacks; "
                "add it there, or name another metric"
            )
        of_gains = [
            name for name in converged if any(path.startswith(f"observer.{name.partition('.')[0]}.") for path in refined)
        ]
        return Criterion.of(of_gains or converged, TOLERANCE)
    if metric not in metrics:
        raise InputError(f"sweep.refine_metric: {no_metric(metric, base.build(), metrics)}")
    return Criterion.of([metric], TOLERANCE if tolerance is None else tolerance)


def _quasi_random(axes: list[AxisTable], config: Config) -> AxisColumns:
    """Sobol or Latin hypercube points over the ranges of some axes, uniform in their scale."""
    from scipy.stats import qmc  # a third of a second that only these designs need

    assert config.sweep.points is not None
    rng = np.random.default_rng(config.sweep.design_seed)
    if config.sweep.design == "sobol":
        # the first 2^m points are balanced; any number of them is a prefix
        power = max(math.ceil(math.log2(config.sweep.points)), 0)
        unit = qmc.Sobol(len(axes), rng=rng).random_base2(power)[: config.sweep.points]
    else:
        unit = qmc.LatinHypercube(len(axes), rng=rng).random(config.sweep.points)
    columns = {}
    for axis, u in zip(axes, unit.T, strict=True):
        assert axis.start is not None and axis.stop is not None
        if axis.scale == "log":
            columns[axis.path] = axis.start * (axis.stop / axis.start) ** u
        else:
            columns[axis.path] = axis.start + (axis.stop - axis.start) * u
    return columns
