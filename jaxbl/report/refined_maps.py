"""Maps of refined studies: every place of the fine grid is shown by the nearest vertex of the finest level known there.

Without refinement in its neighbourhood that is a vertex of the coarse grid: its block is one coarse cell, centred on it.
"""

from typing import NamedTuple

import numpy as np
import pandas as pd

from jaxbl.sweeps.points import Points

_MOST_SHOWN = 2049
"""Places along an axis of a map; finer ones would not be seen."""


class _Axis(NamedTuple):
    """One axis of a map: its values, and the distance of neighbours on each level, coarsest first."""

    path: str
    values: np.ndarray
    strides: list[int]

    def positions(self, values: np.ndarray) -> np.ndarray:
        return np.searchsorted(self.values, values)

    def nearest(self, positions: np.ndarray, level: int) -> np.ndarray:
        """The nearest vertices of a level."""
        stride = self.strides[level]
        last = (len(self.values) - 1) // stride
        return np.minimum((positions + stride // 2) // stride, last) * stride

    def shown(self) -> np.ndarray:
        """Positions that a figure shows: all, or every 2nd, 4th, ..."""
        positions = np.arange(len(self.values))
        while len(positions) > _MOST_SHOWN and self.strides[0] >= 2 * (positions[1] - positions[0]):
            positions = positions[::2]
        return positions


class Filling:
    """The plane of a map over two axes (paths `x` and `y`) of a refined study, by the rows that it has."""

    def __init__(self, points: Points, frame: pd.DataFrame, x: str, y: str):
        assert points.refinement is not None
        depth = points.refinement.grid.depth
        self.axes = []
        for path in (y, x):
            if path in points.refinement.paths:
                self.axes.append(_Axis(path, points.axis_values(path), [1 << depth - level for level in range(depth + 1)]))
            else:
                self.axes.append(_Axis(path, np.unique(frame[path].to_numpy(float)), [1] * (depth + 1)))
        self.levels = depth + 1

    def _keys(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        return rows.astype(np.int64) * len(self.axes[1].values) + columns

    def _owners(self, known: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Index among known vertices (sorted keys) of the one that shows each place; -1 where there is none."""
        owner = np.full(np.broadcast(rows, columns).shape, -1)
        for level in range(self.levels):
            keys = self._keys(self.axes[0].nearest(rows, level), self.axes[1].nearest(columns, level))
            found = np.minimum(np.searchsorted(known, keys), len(known) - 1)
            owner = np.where(known[found] == keys, found, owner)
        return owner

    def dense(self, table: pd.Series) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Values of x `(columns,)` and y `(rows,)`, and a table over (y, x) on the whole plane `(rows, columns)`."""
        (y, x), values = self.axes, table.to_numpy(float)
        known = self._keys(y.positions(table.index.get_level_values(0)), x.positions(table.index.get_level_values(1)))
        order = np.argsort(known)
        rows, columns = y.shown(), x.shown()
        owner = self._owners(known[order], rows[:, None], columns)
        return x.values[columns], y.values[rows], np.where(owner >= 0, values[order][owner], np.nan)

    def complete(self, frame: pd.DataFrame, others: list[str]) -> pd.DataFrame:
        """A frame in which each vertex that was simulated at any values of the other axes has rows at all of them.

        Medians and shares over these axes would else be over those alone at which the vertex lies on a boundary.
        """
        if not others or frame.empty:
            return frame
        y, x = self.axes
        keys = self._keys(y.positions(frame[y.path]), x.positions(frame[x.path]))
        every = np.unique(keys)
        rows, columns = np.divmod(every, len(x.values))
        parts = []
        for indices in frame.groupby(others, sort=False).indices.values():
            indices = indices[np.argsort(keys[indices], kind="stable")]
            known, first, counts = np.unique(keys[indices], return_index=True, return_counts=True)
            owner = self._owners(known, rows, columns)
            place, owner = np.flatnonzero(owner >= 0), owner[owner >= 0]
            # all rows (seeds) of each owner, one after the other
            times = counts[owner]
            within = np.arange(times.sum()) - np.repeat(np.cumsum(times) - times, times)
            part = frame.iloc[indices[np.repeat(first[owner], times) + within]]
            place = np.repeat(place, times)
            parts.append(part.assign(**{y.path: y.values[rows[place]], x.path: x.values[columns[place]]}))
        return pd.concat(parts, ignore_index=True)


def on_coarse_values(points: Points, frame: pd.DataFrame, drawn: list[str]) -> pd.DataFrame:
    """The rows of a refined study whose values are on the coarse grid along all axes but those drawn."""
    assert points.refinement is not None
    stride = 1 << points.refinement.grid.depth
    kept = np.ones(len(frame), bool)
    for path in points.refinement.paths:
        if path not in drawn:
            kept &= np.isin(frame[path], points.axis_values(path)[::stride])
    return frame.loc[kept]
