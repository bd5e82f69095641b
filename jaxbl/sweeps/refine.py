"""Boundary refinement: a coarse grid first, then only the cells whose corners disagree, halved again and again.

A level's cells are the halves of the cells of the level before; level 0 is the coarse grid. An edge of a cell is hot where
its two ends disagree. Two rules decide what is simulated, a batch at a time:

- a cell with a hot edge is halved as soon as the next level is due;
- every cell around a hot edge has to exist. Where a halved cell has a neighbour that is not, the neighbour is halved too,
  with those that it came from if need be: the boundary is followed where it leaves the cells that were expected to hold it.

At the finest level the second rule alone traces each piece of the boundary that was found from end to end, exactly as on
the full grid. Nothing of the fine grid's size is kept: vertices and cells are sorted arrays of flat indices.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from jaxbl.config import is_boolean

Indices = np.ndarray
"""Flat indices of vertices, or of the lower corners of cells: sorted, int64."""


class Criterion(NamedTuple):
    """When two neighbours disagree: in which metric columns, by more than which relative difference each (0 for columns that
    are true or false)."""

    columns: tuple[str, ...]
    tolerances: tuple[float, ...]

    @classmethod
    def of(cls, columns: Sequence[str], tolerance: float) -> "Criterion":
        """Compare some columns, and whether the runs stayed finite."""
        names = tuple(dict.fromkeys((*columns, "finite")))
        return cls(names, tuple(0.0 if is_boolean(name) else tolerance for name in names))

    def differ(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Whether ends of edges disagree in any seed: `(edges, seeds, columns)` twice to `(edges,)`.

        A number disagrees with NaN and with infinity; those agree with their like.
        """
        numbers = np.isfinite(a) & np.isfinite(b)
        with np.errstate(invalid="ignore"):
            far = np.abs(a - b) > np.array(self.tolerances) * np.maximum(np.abs(a), np.abs(b))
        apart = np.where(numbers, far, (a != b) & ~(np.isnan(a) & np.isnan(b)))
        return np.logical_or.reduce(apart, axis=(1, 2))


class CellGrid:
    """A fine grid of vertices, some of whose axes are refined: every 2^depth-th vertex along them is on the coarse grid.

    Cells span the refined axes; along the others every value has a grid of its own. A cell is known by its lower corner.
    `sizes` are those of the coarse grid, last axis fastest; `depth` says how often the cells of refined axes are halved.
    """

    def __init__(self, sizes: Sequence[int], refined: Sequence[bool], depth: int):
        self.depth = depth
        self.coarse_sizes = tuple(sizes)
        self.sizes = tuple((n - 1 << depth) + 1 if halved else n for n, halved in zip(sizes, refined, strict=True))
        steps = np.cumprod([1, *self.sizes[:0:-1]], dtype=np.int64)[::-1] if sizes else np.array([], np.int64)
        self._refined = list(refined)
        # of the coarse grid: distance of neighbours along each axis
        self._strides = [int(step) << depth if halved else int(step) for step, halved in zip(steps, refined, strict=True)]
        # of the refined axes alone: distance of neighbours as flat indices, and vertices
        self._steps = [int(step) for step, halved in zip(steps, refined, strict=True) if halved]
        self._sizes = [size for size, halved in zip(self.sizes, refined, strict=True) if halved]

    def coarse(self, positions: np.ndarray) -> Indices:
        """Flat indices of vertices of the coarse grid, given by their positions in it."""
        places = np.unravel_index(np.asarray(positions, np.int64), self.coarse_sizes)
        return np.stack(places, axis=-1) @ np.array(self._strides, np.int64)

    def coarse_vertices(self) -> Indices:
        """All vertices of the coarse grid."""
        return self._product(self.coarse_sizes)

    def coarse_cells(self) -> Indices:
        """All cells of level 0."""
        return self._product([n - 1 if halved else n for n, halved in zip(self.coarse_sizes, self._refined, strict=True)])

    def _product(self, counts: Sequence[int]) -> Indices:
        out = np.zeros(1, np.int64)
        for count, stride in zip(counts, self._strides, strict=True):
            out = (out[:, None] + stride * np.arange(count)).ravel()
        return out

    def children(self, cells: Indices, level: int) -> Indices:
        """The cells of `level` that halving some cells of the level before makes."""
        return self._around(cells, level, (0, 1))

    def vertices(self, cells: Indices, level: int) -> Indices:
        """The corners of those."""
        return self._around(cells, level, (0, 1, 2))

    def _around(self, cells: Indices, level: int, choices: tuple[int, ...]) -> Indices:
        offsets = [
            sum(step * choice for step, choice in zip(self._steps, chosen, strict=True))
            for chosen in itertools.product(choices, repeat=len(self._steps))
        ]
        stride = 1 << self.depth - level
        return np.unique(cells[:, None] + stride * np.array(offsets, np.int64))

    def parents(self, cells: Indices, level: int) -> Indices:
        """The cells of the level before whose halves some cells of `level` are."""
        out = cells.copy()
        for step, size in zip(self._steps, self._sizes, strict=True):
            out -= step * (cells // step % size % (2 << self.depth - level))
        return np.unique(out)

    def edges(self, cells: Indices, level: int) -> Iterator[tuple[int, Indices, Indices]]:
        """Edges of some cells of `level`, axis by axis: the axis, lower ends, upper ends."""
        stride = 1 << self.depth - level
        for axis, step in enumerate(self._steps):
            starts = np.unique(cells[:, None] + stride * np.array(self._across(axis), np.int64))
            yield axis, starts, starts + stride * step

    def _across(self, axis: int) -> list[int]:
        """Offsets of the corners of a unit cell that do not lie along an axis."""
        others = [step for a, step in enumerate(self._steps) if a != axis]
        return [sum(chosen) for chosen in itertools.product(*((0, step) for step in others))]

    def around(self, axis: int, starts: Indices, level: int) -> Indices:
        """The cells of `level` around some of its edges."""
        stride = 1 << self.depth - level
        cells = starts
        for other, (step, size) in enumerate(zip(self._steps, self._sizes, strict=True)):
            if other != axis:
                place = cells // step % size
                above, below = cells[place + stride < size], cells[place >= stride] - stride * step
                cells = np.concatenate([above, below])
        return np.unique(cells)


def refine(
    grid: CellGrid,
    evaluate: Callable[[Indices], np.ndarray],
    differ: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> tuple[Indices, np.ndarray]:
    """Simulate a coarse grid and then, a batch at a time, what its boundaries need.

    `evaluate` gives the values of a batch of vertices, `(vertices, ...)`; it is called with the coarse grid first, and never
    twice with a vertex. `differ` says whether the values of two ends disagree, for many edges at once.

    Returns:
        The vertices that were simulated, sorted, and their values.
    """
    vertices = grid.coarse_vertices()
    values = evaluate(vertices)

    def at(some: Indices) -> np.ndarray:
        return values[np.searchsorted(vertices, some)]

    def around_hot_edges(cells: Indices, level: int) -> Indices:
        found = [
            grid.around(axis, starts[differ(at(starts), at(ends))], level) for axis, starts, ends in grid.edges(cells, level)
        ]
        return np.unique(np.concatenate(found))

    none = np.array([], np.int64)
    # of each level: cells around hot edges, and cells that were halved
    hot = [around_hot_edges(grid.coarse_cells(), 0), *[none] * grid.depth]
    halved = [none] * grid.depth
    for target in range(1, grid.depth + 1):
        while True:
            # from the finest level down: a cell that has to exist needs its parent halved
            to_halve = [none] * target
            needed = hot[target]
            for level in range(target, 0, -1):
                wanted = np.union1d(hot[level - 1], grid.parents(needed, level))
                needed = to_halve[level - 1] = np.setdiff1d(wanted, halved[level - 1], assume_unique=True)
            if not any(len(cells) for cells in to_halve):
                break
            batch = np.unique(np.concatenate([grid.vertices(cells, i + 1) for i, cells in enumerate(to_halve)]))
            batch = np.setdiff1d(batch, vertices, assume_unique=True)
            if len(batch):
                new, places = evaluate(batch), np.searchsorted(vertices, batch)
                vertices, values = np.insert(vertices, places, batch), np.insert(values, places, new, axis=0)
            for level, cells in enumerate(to_halve, 1):
                halved[level - 1] = np.union1d(halved[level - 1], cells)
                hot[level] = np.union1d(hot[level], around_hot_edges(grid.children(cells, level), level))
    return vertices, values
