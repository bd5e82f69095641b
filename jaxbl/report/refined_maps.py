"""Maps of refined studies: every place of the fine grid is shown by the nearest vertex of the finest level known there.

Without refinement in its neighbourhood that is a vertex of the coarse grid: its block is one coarse cell, centred on it.
"""

from typing import NamedTuple

import numpy as np
import pandas as pd
from pandas import DataFrame, Series

from jaxbl.sweeps.points import Points

Array = np.ndarray

_MOST_SHOWN = 2049
"""Places along an axis of a map; finer ones would not be seen."""


class _Axis(NamedTuple):
    """One axis of a map: its values, and the distance of neighbours on each level, coarsest first."""

    path: str
    values: Array
    strides: list[int]

    def positions(self, values: Array) -> Array:
        return np.searchsorted(self.values, values)

    def nearest(self, positions: Array, level: int) -> Array:
        """The nearest vertices of a level."""
        stride = self.strides[level]
        last = (len(self.values) - 1) // stride
        return np.minimum((positions + stride // 2) // stride, last) * stride

    def drawn_positions(self) -> Array:
        """Positions that a figure shows: all, or every 2nd, 4th, ..."""
        positions = np.arange(len(self.values))
        while len(positions) > _MOST_SHOWN and self.strides[0] >= 2 * (positions[1] - positions[0]):
            positions = positions[::2]
        return positions


class Filling:
    """The plane of a map over two axes (paths `x` and `y`) of a refined study, by the rows that it has."""

    def __init__(self, points: Points, frame: DataFrame, x: str, y: str):
        assert points.refinement is not None
        depth = points.refinement.grid.depth
        self.axes = []
        for path in (y, x):
            refined = path in points.refinement.paths
            values = points.axis_values(path) if refined else np.unique(frame[path].to_numpy(float))
            self.axes.append(_Axis(path, values, [1 << refined * (depth - level) for level in range(depth + 1)]))

    def _keys(self, rows: Array, columns: Array) -> Array:
        return rows.astype(np.int64) * len(self.axes[1].values) + columns

    def _owners(self, vertices: Array, rows: Array, columns: Array) -> Array:
        """Index among known vertices (sorted keys) of the one that shows each place; -1 where there is none."""
        owner, (y, x) = np.full(np.broadcast(rows, columns).shape, -1), self.axes
        for level in range(len(x.strides)):
            keys = self._keys(y.nearest(rows, level), x.nearest(columns, level))
            place = np.minimum(np.searchsorted(vertices, keys), len(vertices) - 1)
            owner = np.where(vertices[place] == keys, place, owner)
        return owner

    def dense(self, table: Series) -> tuple[Array, Array, Array]:
        """Values of x `(columns,)` and y `(rows,)`, and a table over (y, x) on the whole plane `(rows, columns)`."""
        (y, x), values = self.axes, table.to_numpy(float)
        vertices = self._keys(y.positions(table.index.get_level_values(0)), x.positions(table.index.get_level_values(1)))
        order = np.argsort(vertices)
        rows, columns = y.drawn_positions(), x.drawn_positions()
        owner = self._owners(vertices[order], rows[:, None], columns)
        return x.values[columns], y.values[rows], np.where(owner >= 0, values[order][owner], np.nan)

    def complete(self, frame: DataFrame, paths: list[str]) -> DataFrame:
        """A frame in which each vertex that was simulated at any values of the other axes has rows at all of them.

        Medians and shares over these axes would else be over those alone at which the vertex lies on a boundary.
        """
        if not paths or frame.empty:
            return frame
        y, x = self.axes
        keys = self._keys(y.positions(frame[y.path]), x.positions(frame[x.path]))
        rows, columns = np.divmod(np.unique(keys), len(x.values))
        parts = []
        for indices in frame.groupby(paths, sort=False).indices.values():
            indices = indices[np.argsort(keys[indices], kind="stable")]
            vertices, first, counts = np.unique(keys[indices], return_index=True, return_counts=True)
            owner = self._owners(vertices, rows, columns)
            place, owner = np.flatnonzero(owner >= 0), owner[owner >= 0]
            # all rows (seeds) of each owner, one after the other
            times = counts[owner]
            within = np.arange(times.sum()) - np.repeat(np.cumsum(times) - times, times)
            part = frame.iloc[indices[np.repeat(first[owner], times) + within]]
            place = np.repeat(place, times)
            parts.append(part.assign(**{y.path: y.values[rows[place]], x.path: x.values[columns[place]]}))
        return pd.concat(parts, ignore_index=True)


def on_coarse_values(points: Points, frame: DataFrame, drawn: list[str]) -> DataFrame:
    """The rows of a refined study whose values are on the coarse grid along all axes but those drawn."""
    assert points.refinement is not None
    stride = 1 << points.refinement.grid.depth
    for path in points.refinement.paths:
        if path not in drawn:
            frame = frame.loc[np.isin(frame[path], points.axis_values(path)[::stride])]
    return frame
