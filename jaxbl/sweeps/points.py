"""The points of a study: its axes are crossed, zipped or sampled quasi-randomly.

Axes over leaves of the experiment vary the lanes of one compiled program. Structural axes, over numbers that are fixed at
compile time (sampling period, substeps, discretisation, ...), are outermost and split the study into groups; each group is
compiled once.

A refined study has the points of its fine grid, which include those of the coarse grid where it begins.
"""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from jaxbl.chain import Experiment
from jaxbl.config import KIND, TOLERANCE, AxisTable, Config, numeric_paths, with_values
from jaxbl.drive.parameters import leaf_paths
from jaxbl.errors import InputError
from jaxbl.files import to_jsonable
from jaxbl.json_types import JsonObject

from .metrics import explain_missing_metric, metric_columns
from .refine import CellGrid, Criterion

AxisColumns = dict[str, np.ndarray]
"""Values by axis path, columns of equal length: a row is a point, or a step of axes that advance together."""

PointIndices = Sequence[int] | np.ndarray
"""Indices of points in a group."""

_MAX_RUNS = 1e10
"""A day of computing on two cores, for runs of 20 000 samples (docs/speed.md): more is a mistake in the axes."""
_MAX_AXIS_VALUES = 10_000_000
"""All values of an axis are held in memory."""


class Group(NamedTuple):
    """Points that share a compiled program: the config with their structural values, and these values by path."""

    config: Config
    structural: JsonObject


class Refinement(NamedTuple):
    """The refined axes of a study, the grid of all leaf axes, and the criterion by which neighbours disagree."""

    paths: list[str]
    grid: CellGrid
    criterion: Criterion


class Points:
    """All points of a study, first axis slowest, structural axes outermost.

    Attributes:
        paths: paths of all axes, in the order of the config.
        leaves: paths of all leaves of the experiment.
        metrics: metric columns of all groups; a metric that does not apply to the observers of a group is NaN there.
        dimensions: values of each axis in the order of the config; axes that advance together share a dimension.
        groups: one for each combination of structural values.
        group_size: number of points of a group.
        coarse_size: number of these that are always simulated: all, or the coarse grid of a refined study.
        refinement: None unless the study is refined.
    """

    def __init__(self, config: Config):
        self.paths = [axis.path for axis in config.axes]
        for i, path in enumerate(self.paths):
            if path in self.paths[:i]:
                raise InputError(f"axes[{i}]: path '{path}' has an axis already; each path may have one")
        base, self.leaves = self._take_first_values(config)
        self.metrics = metrics = metric_columns(base.build(), config.sweep.metrics, self._build_kinds(config, base))
        refined = self._refined_paths(config)
        depth = config.sweep.refine or 0
        self.dimensions = dimensions = self._build_dimensions(config, dict.fromkeys(refined, depth))
        structural = [columns for columns in dimensions if not self.leaves.issuperset(columns)]
        self._leaf_dimensions = [columns for columns in dimensions if self.leaves.issuperset(columns)]
        self.group_size = _count_points(self._leaf_dimensions)
        self.refinement: Refinement | None = None
        self.coarse_size = self.group_size
        if refined:
            is_refined = [next(iter(columns)) in refined for columns in self._leaf_dimensions]
            grid = CellGrid([*map(_length, self._leaf_dimensions)], is_refined, depth)
            self.coarse_size = math.prod(grid.coarse_sizes)
            self.refinement = Refinement(refined, grid, _build_criterion(config, base, metrics, refined))
        runs_per_point = _count_points(structural) * config.sweep.seeds
        if (runs := runs_per_point * self.coarse_size) > _MAX_RUNS:
            raise InputError(f"axes: {runs:.2g} runs are more than {_MAX_RUNS:.0e}; fewer values, or a quasi-random design")
        if (runs := runs_per_point * self.group_size) > _MAX_RUNS:
            raise InputError(
                f"sweep.refine: {depth} makes a fine grid of {runs:.2g} runs, more than {_MAX_RUNS:.0e}; "
                "it should be less, or the axes should have fewer values"
            )
        self.groups = []
        for index in range(_count_points(structural)):
            values = {path: to_jsonable(column[0]) for path, column in _take_points(structural, np.array([index])).items()}
            self.groups.append(Group(with_values(base, values), values))

    def __len__(self) -> int:
        return len(self.groups) * self.group_size

    def columns(self, indices: PointIndices) -> AxisColumns:
        """Values of the leaf axes at some points of a group, by path; float64 arrays of the shape of `indices`."""
        return _take_points(self._leaf_dimensions, np.asarray(indices))

    def coarse_points(self, positions: PointIndices) -> PointIndices:
        """Indices of points of a group that are always simulated, by their positions 0 ... coarse_size - 1 among these."""
        return positions if self.refinement is None else self.refinement.grid.coarse_indices(np.asarray(positions))

    def axis_values(self, path: str) -> np.ndarray:
        """All values of a leaf axis in their order; those of the fine grid if it is refined."""
        return next(columns[path] for columns in self._leaf_dimensions if path in columns)

    def on_coarse_grid(self, columns: Mapping[str, Any]) -> np.ndarray:
        """True for rows of a frame, or of its columns by name, at points that are always simulated."""
        if self.refinement is None:
            return np.ones(len(columns["seed"]), bool)
        stride = 1 << self.refinement.grid.depth
        paths = self.refinement.paths
        return np.logical_and.reduce([np.isin(columns[path], self.axis_values(path)[::stride]) for path in paths])

    def _refined_paths(self, config: Config) -> list[str]:
        """Paths of the refined axes."""
        depth = config.sweep.refine
        if depth is None:
            return []
        axes = [axis for axis in config.axes if axis.num and axis.zip is None and axis.path in self.leaves]
        if not axes:
            raise InputError(
                "sweep.refine: no axis can be refined; an axis is needed with start, stop and num, not zipped and not "
                "fixed at compile time"
            )
        for axis in axes:
            assert axis.num is not None
            max_depth = ((_MAX_AXIS_VALUES - 1) // (axis.num - 1)).bit_length() - 1
            if depth > max_depth:
                limit = f"should be at most {max_depth}" if max_depth > 0 else "does not fit here: num is too large"
                raise InputError(
                    f"sweep.refine: {depth} makes more than {_MAX_AXIS_VALUES:.0e} values of '{axis.path}'; it {limit}"
                )
        return [axis.path for axis in axes]

    @staticmethod
    def _build_kinds(config: Config, base: Config) -> list[Experiment]:
        """An experiment with each kind of observer, where that is an axis; all must have the gains that other axes vary."""
        kinds = (kind for axis in config.axes if axis.path == KIND for kind in axis.values or ())
        variants = [with_values(base, {KIND: kind}) for kind in kinds]
        for variant in variants:
            valid = numeric_paths(variant)
            for i, axis in enumerate(config.axes):
                if axis.path not in valid:
                    raise InputError(
                        f"axes[{i}]: '{axis.path}' is no gain of kind '{variant.observer.kind}', a value of {KIND}; "
                        "vary a gain that all these kinds have, or make a study of its own for it"
                    )
        return [variant.build() for variant in variants]

    @staticmethod
    def _take_first_values(config: Config) -> tuple[Config, set[str]]:
        """The config with each axis at its first value (so that optional numbers exist), and the paths of its leaves.

        The values of all axes are checked on the way.
        """
        first = {}
        # the kind of observer first: it decides which gains exist
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

    def _build_dimensions(self, config: Config, depths: Mapping[str, int]) -> list[AxisColumns]:
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
            raise InputError("sweep.points belongs to designs other than 'grid'; a grid has num on its axes")
        for axis in sampled:
            if axis.path not in self.leaves:
                raise InputError(f"axes: '{axis.path}' is fixed at compile time; list its values instead of sampling it")
            if axis.zip is not None:
                raise InputError(
                    f"axes: '{axis.path}' is sampled quasi-randomly and cannot be zipped; leave zip out, or list its values"
                )
        # by label; the axes that are sampled together have none
        dimensions: dict[str | None, AxisColumns] = {}
        for axis in config.axes:
            if axis in sampled:
                if axis is sampled[0]:
                    dimensions[None] = _sample_points(sampled, config)
                continue
            label = axis.path if axis.zip is None else axis.zip
            columns = dimensions.setdefault(label, {})
            columns[axis.path] = values = axis.grid(depths.get(axis.path, 0))
            if len(values) != (length := _length(columns)):
                raise InputError(
                    f"axes: '{axis.path}' has {len(values)} values, the others zipped as '{label}' have {length}; "
                    "they should have equally many"
                )
        for label in dict.fromkeys(axis.zip for axis in config.axes if axis.zip is not None):
            columns = dimensions[label]
            if len(columns) < 2 or label in (*self.paths, "seed"):
                raise InputError(f"axes: zip = '{label}' should stand on two axes or more, and be neither a path nor 'seed'")
            if len(set(zip(*(column.tolist() for column in columns.values()), strict=True))) < _length(columns):
                raise InputError(f"axes: the axes zipped as '{label}' list a point twice; their points should differ")
        return list(dimensions.values())


def _extremes(values: list[Any]) -> list[Any]:
    """Values of an axis to check: of many numbers the first, least and largest, since a key's range is an interval."""
    # each check builds a config, which takes milliseconds
    if len(values) <= 16 or any(isinstance(value, str) for value in values):
        return values
    return [values[0], min(values), max(values)]


def _length(columns: AxisColumns) -> int:
    return len(next(iter(columns.values())))


def _count_points(dimensions: list[AxisColumns]) -> int:
    """Number of points of a product of dimensions."""
    return math.prod(_length(columns) for columns in dimensions)


def _take_points(dimensions: list[AxisColumns], indices: np.ndarray) -> AxisColumns:
    """Values of a product of dimensions at flat indices, last dimension fastest."""
    out: AxisColumns = {}
    remaining = indices
    for columns in reversed(dimensions):
        out |= {path: column[remaining % _length(columns)] for path, column in columns.items()}
        remaining = remaining // _length(columns)
    return out


def _build_criterion(config: Config, base: Config, metrics: list[str], refined: list[str]) -> Criterion:
    """Compare neighbours in the metric that the study names, or in convergence.

    Without a name these are the observers whose gains are refined, or else both observers.
    """
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
        raise InputError(f"sweep.refine_metric: {explain_missing_metric(metric, base.build(), metrics)}")
    return Criterion.of([metric], TOLERANCE if tolerance is None else tolerance)


def draw_sobol(dimensions: int, count: int, seed: int) -> np.ndarray:
    """Draw points of the unit cube from Sobol's sequence, `(count, dimensions)`; each seed has different ones."""
    from scipy.stats import qmc  # its import takes 0.3 s, which only such designs need

    # the first 2^m points are balanced; any number of them is a prefix
    return qmc.Sobol(dimensions, rng=np.random.default_rng(seed)).random_base2(math.ceil(math.log2(count)))[:count]


def _draw_saltelli(dimensions: int, count: int, seed: int) -> np.ndarray:
    """Draw Saltelli's design, `(count, dimensions)`: two samples of Sobol's sequence, and their mixtures."""
    samples, remainder = divmod(count, dimensions + 2)
    if remainder or samples & (samples - 1) or samples < 2:
        fitting = (dimensions + 2) * 2 ** max(round(math.log2(max(count / (dimensions + 2), 1))), 1)
        raise InputError(
            f"sweep.points: {count} make no Saltelli design of {dimensions} axes, which has {dimensions + 2} times a power "
            f"of two; {fitting} do"
        )
    from SALib.sample import sobol  # its import takes 0.5 s

    problem = {"num_vars": dimensions, "bounds": [[0.0, 1.0]] * dimensions}
    return sobol.sample(problem, samples, calc_second_order=False, seed=seed)


def _sample_points(axes: list[AxisTable], config: Config) -> AxisColumns:
    """Sample Sobol or Latin hypercube points over the ranges of axes, uniform in their scale."""
    assert config.sweep.points is not None
    design, count, seed = config.sweep.design, config.sweep.points, config.sweep.design_seed
    if design == "sobol":
        unit = draw_sobol(len(axes), count, seed)
    elif design == "saltelli":
        unit = _draw_saltelli(len(axes), count, seed)
    else:
        from scipy.stats import qmc

        unit = qmc.LatinHypercube(len(axes), rng=np.random.default_rng(seed)).random(count)
    columns = {}
    for axis, u in zip(axes, unit.T, strict=True):
        assert axis.start is not None and axis.stop is not None
        if axis.scale == "log":
            columns[axis.path] = axis.start * (axis.stop / axis.start) ** u
        else:
            columns[axis.path] = axis.start + (axis.stop - axis.start) * u
    return columns
