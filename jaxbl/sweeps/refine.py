"""Boundary refinement: simulate a coarse grid, then halve only the cells whose corners disagree, again and again.

The cells of a level are the halves of cells of the level before; level 0 is the coarse grid. An edge of a cell is hot if
its two ends disagree. Two rules decide which vertices are simulated, a batch at a time:

- a cell with a hot edge is halved when the next level begins;
- all cells around a hot edge must exist. If a halved cell has a neighbour that is not halved, the neighbour is halved too,
  and its ancestors if needed: so the boundary is followed where it leaves the cells in which it was expected.

At the finest level the second rule traces each piece of the boundary from end to end, exactly as on the full grid. No array
has the size of the fine grid: vertices and cells are sorted arrays of flat indices.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from jaxbl.config import is_boolean

Indices = np.ndarray
"""Flat indices of vertices, or of the lower corners of cells: sorted, int64."""


class Criterion(NamedTuple):
    """Neighbours disagree if a metric column differs by more than its relative tolerance (0 for boolean columns)."""

    columns: tuple[str, ...]
    tolerances: tuple[float, ...]

    @classmethod
    def of(cls, columns: Sequence[str], tolerance: float) -> "Criterion":
        """Compare columns with one tolerance, and `finite` as well."""
        names = tuple(dict.fromkeys((*columns, "finite")))
        return cls(names, tuple(0.0 if is_boolean(name) else tolerance for name in names))

    def disagree(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """True for edges `(edges,)` whose ends disagree in any seed; `a` and `b` are `(edges, seeds, columns)`.

        A finite number disagrees with NaN and with infinity; NaN agrees with NaN, infinity with equal infinity.
        """
        finite = np.isfinite(a) & np.isfinite(b)
        with np.errstate(invalid="ignore"):
            far = np.abs(a - b) > np.array(self.tolerances) * np.maximum(np.abs(a), np.abs(b))
        different = np.where(finite, far, (a != b) & ~(np.isnan(a) & np.isnan(b)))
        return np.logical_or.reduce(different, axis=(1, 2))


class CellGrid:
    """A fine grid of vertices; along its refined axes every 2^depth-th vertex is on the coarse grid.

    Cells span the refined axes; each combination of values of the other axes has cells of its own. The index of a cell is
    that of its lower corner.

    Args:
        sizes: vertices along each axis, last axis fastest.
        is_refined: for each axis, True if its cells are halved.
        depth: number of times that they are halved.
    """

    def __init__(self, sizes: Sequence[int], is_refined: Sequence[bool], depth: int):
        self.depth = depth
        self.sizes = tuple(sizes)
        self.coarse_sizes = tuple((n - 1 >> depth) + 1 if halved else n for n, halved in zip(sizes, is_refined, strict=True))
        refined, fine_sizes = np.array(is_refined, bool), np.array(sizes, np.int64)
        steps = np.cumprod([1, *fine_sizes[:0:-1]], dtype=np.int64)[::-1][: len(sizes)]
        # flat distance of neighbours on the coarse grid, and number of cells on it, along each axis
        self._strides = np.where(refined, steps << depth, steps)
        self._coarse_cell_counts = (np.array(self.coarse_sizes, np.int64) - refined).tolist()
        # of the refined axes alone: flat distance of neighbours on the fine grid, and number of vertices
        self._steps, self._sizes = steps[refined].tolist(), fine_sizes[refined].tolist()

    def coarse_indices(self, positions: np.ndarray) -> Indices:
        """Flat indices of vertices of the coarse grid by their positions in it."""
        return np.stack(np.unravel_index(np.asarray(positions, np.int64), self.coarse_sizes), axis=-1) @ self._strides

    def coarse_cells(self) -> Indices:
        """All cells of level 0."""
        counts = zip(self._coarse_cell_counts, self._strides, strict=True)
        return _all_sums(stride * np.arange(count) for count, stride in counts)

    def shift_cells(self, cells: Indices, level: int, shifts: tuple[int, ...], along: int | None = None) -> Indices:
        """Cells moved by all combinations of shifts along the refined axes but `along`, in units of cells of `level`.

        By (0, 1), cells of the level before become the cells of `level` into which they are halved; by (0, 1, 2), the
        corners of these.
        """
        offsets = _all_sums(step * np.array(shifts) for axis, step in enumerate(self._steps) if axis != along)
        return np.unique(cells[:, None] + (offsets << self.depth - level))

    def parents(self, cells: Indices, level: int) -> Indices:
        """The cells of the level before that contain cells of `level`."""
        out = cells.copy()
        for step, size in zip(self._steps, self._sizes, strict=True):
            out -= step * (cells // step % size % (2 << self.depth - level))
        return np.unique(out)

    def edges(self, cells: Indices, level: int) -> Iterator[tuple[int, Indices, Indices]]:
        """Yield the edges of cells of `level`, axis by axis: the axis, lower ends, upper ends."""
        stride = 1 << self.depth - level
        for axis, step in enumerate(self._steps):
            starts = self.shift_cells(cells, level, (0, 1), axis)
            yield axis, starts, starts + stride * step

    def cells_around(self, axis: int, starts: Indices, level: int) -> Indices:
        """The cells of `level` that share edges along an axis, by the lower ends of these edges."""
        stride = 1 << self.depth - level
        cells = starts
        for other, (step, size) in enumerate(zip(self._steps, self._sizes, strict=True)):
            if other != axis:
                coordinate = cells // step % size
                above, below = cells[coordinate + stride < size], cells[coordinate >= stride] - stride * step
                cells = np.concatenate([above, below])
        return np.unique(cells)


def _all_sums(columns: Iterable[np.ndarray]) -> Indices:
    """All sums of one number of each column, those of the last column fastest."""
    return np.asarray(sum(np.ix_(*columns)), np.int64).ravel()


def refine_boundary(
    grid: CellGrid,
    evaluate: Callable[[Indices], np.ndarray],
    disagree: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> tuple[Indices, np.ndarray]:
    """Evaluate a coarse grid and then, a batch at a time, the vertices that refine its boundaries.

    Args:
        grid: coarse and fine grid.
        evaluate: gives the values `(vertices, ...)` of a batch of vertices; called with the coarse grid first, and with no
            vertex twice.
        disagree: takes the values of the lower and upper ends of edges, and is True `(edges,)` where they disagree.

    Returns:
        The vertices that were evaluated, sorted, and their values.
    """
    vertices = grid.coarse_indices(np.arange(math.prod(grid.coarse_sizes)))
    values = evaluate(vertices)

    def values_of(indices: Indices) -> np.ndarray:
        return values[np.searchsorted(vertices, indices)]

    def cells_around_hot_edges(cells: Indices, level: int) -> Indices:
        around = []
        for axis, starts, ends in grid.edges(cells, level):
            hot_starts = starts[disagree(values_of(starts), values_of(ends))]
            around.append(grid.cells_around(axis, hot_starts, level))
        return np.unique(np.concatenate(around))

    no_cells = np.array([], np.int64)
    # by level: cells around hot edges, and cells that were halved
    hot = [cells_around_hot_edges(grid.coarse_cells(), 0), *[no_cells] * grid.depth]
    halved = [no_cells] * grid.depth
    for target in range(1, grid.depth + 1):
        while True:
            # from the finest level down: a cell that has to exist needs its parent halved
            to_halve = [no_cells] * target
            needed = hot[target]
            for level in range(target, 0, -1):
                due = np.union1d(hot[level - 1], grid.parents(needed, level))
                needed = to_halve[level - 1] = np.setdiff1d(due, halved[level - 1], assume_unique=True)
            if not any(len(cells) for cells in to_halve):
                break
            batch = np.unique(np.concatenate([grid.shift_cells(cells, i, (0, 1, 2)) for i, cells in enumerate(to_halve, 1)]))
            batch = np.setdiff1d(batch, vertices, assume_unique=True)
            if len(batch):
                batch_values, positions = evaluate(batch), np.searchsorted(vertices, batch)
                vertices, values = np.insert(vertices, positions, batch), np.insert(values, positions, batch_values, axis=0)
            for level, cells in enumerate(to_halve, 1):
                halved[level - 1] = np.union1d(halved[level - 1], cells)
                hot[level] = np.union1d(hot[level], cells_around_hot_edges(grid.shift_cells(cells, level, (0, 1)), level))
    return vertices, values
