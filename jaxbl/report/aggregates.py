"""Medians, means and extremes of a study's runs by groups, in memory that does not grow with the number of runs.

Few rows are kept; many are read part by part as often as is needed. Medians are exact either way: values are sorted in a
file.
"""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportReturnType=false

import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from tempfile import TemporaryFile
from typing import Any

import numpy as np
import pandas as pd
from pandas import DataFrame

from jaxbl.sweeps.sweep import StudyResult

Array = np.ndarray

_MOST_KEPT = 20_000_000
"""Values of rows that are kept: 160 MB."""


@dataclass
class Rows:
    """Some columns of a study's rows, to be gone through several times: kept where they are few, else read each time.

    Attributes:
        result: the study.
        columns: names.
        changed: applied to each part.
    """

    result: StudyResult
    columns: Sequence[str]
    changed: Callable[[DataFrame], DataFrame] = lambda frame: frame

    def __iter__(self) -> Iterator[DataFrame]:
        few = self.result.runs * len(self.columns) <= _MOST_KEPT
        return iter([self.frame]) if few else map(self.changed, self.result.batches(self.columns))

    @functools.cached_property
    def frame(self) -> DataFrame:
        """All of them at once."""
        return pd.concat(map(self.changed, self.result.batches(self.columns)), ignore_index=True)


Column = Callable[[DataFrame], Any]
"""Gives a number of each row of a frame."""


class Groups:
    """Rows that have the same values of some columns, sorted by these; one group of all rows without any.

    Attributes:
        index: values of the columns, a level each.
        varied: columns of the rows that have more than one value.
        columns: all columns of the rows.
    """

    def __init__(self, rows: Iterable[DataFrame], keys: Sequence[str], further: Sequence[str] = ()):
        keys = self._keys = list(keys)
        self._rows = rows
        index, first = None, {}
        self.varied, self.columns = set[str](), set[str]()
        for frame in rows:
            self.columns = {*frame}
            if keys:
                there = frame.set_index(keys).index.unique()
                index = there if index is None else index.union(there)
            for name in further if len(frame) else ():
                column = frame[name].to_numpy()
                if (column != first.setdefault(name, column[0])).any():
                    self.varied.add(name)
        self.index: pd.Index = pd.RangeIndex(1) if index is None else index.sort_values()

    def __len__(self) -> int:
        return len(self.index)

    def of(self, frame: DataFrame) -> Array:
        """The group of each row."""
        if not self._keys:
            return np.zeros(len(frame), np.int64)
        return self.index.get_indexer(frame.set_index(self._keys).index)

    def means(self, columns: dict[str, Column]) -> DataFrame:
        """Means of numbers by group, NaN left out, and the number of rows in `rows`."""
        columns = columns | {"rows": lambda frame: np.ones(len(frame))}
        sums, counts = np.zeros((2, len(columns), len(self)))
        for frame in self._rows:
            groups = self.of(frame)
            for i, column in enumerate(columns.values()):
                values = np.asarray(column(frame), float)
                there = ~np.isnan(values)
                sums[i] += np.bincount(groups, np.where(there, values, 0.0), len(self))
                counts[i] += np.bincount(groups, there, len(self))
        return DataFrame(sums.T, self.index, [*columns]).div(counts.T).assign(rows=counts[-1].astype(int))

    def spread(self, column: Column) -> DataFrame:
        """The `least`, `median` and `largest` of a column's numbers by group, NaN left out; NaN where a group has none.
        They are sorted in a temporary file of 16 bytes a number."""
        count = np.zeros(len(self), np.int64)
        with TemporaryFile() as file:
            for frame in self._rows:
                values = np.asarray(column(frame), float)
                there = ~np.isnan(values)
                groups = self.of(frame)[there]
                count += np.bincount(groups, minlength=len(self))
                np.column_stack([groups, values[there]]).tofile(file)
            np.full(2, np.nan).tofile(file)
            # complex numbers are sorted by their real parts, the groups, and then by the others; nan is behind all
            pairs = np.memmap(file, complex, "r+")
            pairs.sort()
            first, last = np.cumsum(count) - count, np.maximum(count - 1, 0)
            # the median lies between two ranks; a group without numbers has the nan
            ranks = (np.where(count == 0, len(pairs) - 1, first + rank) for rank in (0, last // 2, (last + 1) // 2, last))
            least, below, above, largest = (np.imag(pairs[rank]) for rank in ranks)
        return DataFrame({"least": least, "median": 0.5 * (below + above), "largest": largest}, self.index)
