"""Medians, means and extremes of a study's runs by groups, in memory that does not grow with the number of runs.

Few rows are kept; many are read part by part as often as is needed. Medians are exact either way: many values
are sorted in a file.
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

MOST_VALUES = 4_000_000
"""Sorted in memory: 32 MB."""
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
        distinct, first = list[DataFrame](), {}
        self.varied, self.columns = set[str](), set[str]()
        for frame in rows:
            self.columns |= {*frame}
            if keys:
                distinct.append(frame[keys].drop_duplicates())
                # seldom, as it goes through all that differ
                if sum(map(len, distinct[1:])) > len(distinct[0]) + 10_000:
                    distinct = [pd.concat(distinct).drop_duplicates()]
            for name in further if len(frame) else ():
                column = frame[name].to_numpy()
                if (column != first.setdefault(name, column[0])).any():
                    self.varied.add(name)
        self.index: pd.Index = pd.RangeIndex(1)
        if keys:
            self.index = pd.concat(distinct).drop_duplicates().sort_values(keys).set_index(keys).index

    def __len__(self) -> int:
        return len(self.index)

    def of(self, frame: DataFrame) -> Array:
        """The group of each row."""
        if not self._keys:
            return np.zeros(len(frame), np.int64)
        return self.index.get_indexer(frame.set_index(self._keys).index)

    def _read(self, *columns: Column) -> Iterator[tuple[Array, list[Array]]]:
        """Groups of the rows, and numbers by column, part by part."""
        for frame in self._rows:
            yield self.of(frame), [np.asarray(column(frame), float) for column in columns]

    def _numbers(self, column: Column) -> Iterator[tuple[Array, Array]]:
        """Groups and numbers of the rows that have one, part by part."""
        for groups, (values,) in self._read(column):
            there = ~np.isnan(values)
            yield groups[there], values[there]

    def means(self, columns: dict[str, Column]) -> DataFrame:
        """Means of numbers by group, NaN left out, and the number of rows in `rows`."""
        rows, (sums, counts) = np.zeros(len(self), np.int64), np.zeros((2, len(columns), len(self)))
        for groups, numbers in self._read(*columns.values()):
            np.add.at(rows, groups, 1)
            for total, count, values in zip(sums, counts, numbers, strict=True):
                there = ~np.isnan(values)
                np.add.at(total, groups[there], values[there])
                np.add.at(count, groups[there], 1.0)
        return DataFrame(sums.T, self.index, [*columns]).div(counts.T).assign(rows=rows)

    def spread(self, column: Column) -> DataFrame:
        """The `least`, `median` and `largest` of a column's numbers by group, NaN left out; NaN where a group has none."""
        count = np.zeros(len(self), np.int64)
        for groups, _ in self._numbers(column):
            count += np.bincount(groups, minlength=len(self))
        ends, total, last = np.cumsum(count), count.sum(), np.maximum(count - 1, 0)
        first = ends - count
        with TemporaryFile() as file:
            # values of a group side by side, and one more for groups without any
            size = total + 1
            grouped = np.memmap(file, float, "w+", shape=size) if total > MOST_VALUES else np.empty(size)
            grouped[-1], free = np.nan, first.copy()
            for groups, values in self._numbers(column):
                order = np.argsort(groups, kind="stable")
                groups = groups[order]
                grouped[free[groups] + np.arange(len(groups)) - np.searchsorted(groups, groups)] = values[order]
                free += np.bincount(groups, minlength=len(self))
            for start, end in zip(first, ends, strict=True):
                grouped[start:end].sort()
            # the median lies between two ranks; a group without numbers has the one behind all others
            ranks = (np.where(count == 0, total, first + rank) for rank in (0, last // 2, (last + 1) // 2, last))
            least, below, above, largest = (grouped[rank] for rank in ranks)
        return DataFrame({"least": least, "median": 0.5 * (below + above), "largest": largest}, self.index)
