"""Maps of refined studies: every place of the fine grid is shown by the nearest point that was simulated.

Without refinement in its neighbourhood that is a point of the coarse grid: its block is one coarse cell, centred on it.
"""

import numpy as np
import pandas as pd
from pandas import DataFrame
from scipy.spatial import KDTree

from jaxbl.sweeps.points import Points

# pandas' and SciPy's own annotations are wider than what their methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportReturnType=false, reportAttributeAccessIssue=false

Array = np.ndarray

_MOST_SHOWN = 1025
"""Places along an axis of a map; finer ones would not be seen."""


class Filling:
    """The plane of a map over two axes (paths `x` and `y`) of a refined study, by the rows that it has."""

    def __init__(self, points: Points, frame: DataFrame, x: str, y: str):
        assert points.refinement is not None
        # values of each axis, and how many of them a coarse cell has
        self._axes = {}
        for path in (y, x):
            refined = path in points.refinement.paths
            values = points.axis_values(path) if refined else np.unique(frame[path].to_numpy(float))
            self._axes[path] = values, 1 << refined * points.refinement.grid.depth

    def _places(self, frame: DataFrame) -> Array:
        """Positions `(rows, 2)` of a frame's rows in the plane, in coarse cells."""
        return np.column_stack([np.searchsorted(values, frame[path]) / cell for path, (values, cell) in self._axes.items()])

    def _nearest(self, simulated: DataFrame, asked: DataFrame) -> Array:
        """The simulated row nearest to each row asked for, within half a coarse cell; their number where there is none."""
        # of two that are as near the upper one
        return KDTree(self._places(simulated)).query(self._places(asked) + 1e-6, p=np.inf, distance_upper_bound=0.50001)[1]

    def fill(self, table: DataFrame) -> DataFrame:
        """A table over (y, x) on the whole plane: rows of the nearest places, NaN where there is none."""
        # all values of an axis, or every 2nd, 4th, ...
        drawn = [
            values[:: min(1 << ((len(values) - 1) // _MOST_SHOWN).bit_length(), cell)]
            for values, cell in self._axes.values()
        ]
        plane = pd.MultiIndex.from_product(drawn, names=[*self._axes])
        nearest = self._nearest(table.index.to_frame(), plane.to_frame())
        return table.reset_index(drop=True).reindex(nearest).set_axis(plane)

    def complete(self, frame: DataFrame, paths: list[str]) -> DataFrame:
        """A frame in which each vertex that was simulated at any values of the other axes has rows at all of them.

        Medians and shares over these axes would else be over those alone at which the vertex lies on a boundary.
        """
        if not paths or frame.empty:
            return frame
        vertices, parts = frame[[*self._axes]].drop_duplicates(), []
        for _, part in frame.groupby([*paths, "seed"], sort=False):
            nearest = self._nearest(part, vertices)
            there = nearest < len(part)
            parts.append(part.iloc[nearest[there]].assign(**vertices[there].to_dict("list")))
        return pd.concat(parts, ignore_index=True)
