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
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from pandas import DataFrame, Series

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
        needs: columns that this looks at.
    """

    result: StudyResult
    columns: Sequence[str]
    changed: Callable[[DataFrame], DataFrame] = lambda frame: frame
    needs: Sequence[str] = ()

    def __iter__(self) -> Iterator[DataFrame]:
        return self.some(self.columns)

    def some(self, columns: Iterable[str]) -> Iterator[DataFrame]:
        """Some of the columns, or more."""
        if self.result.runs * len(self.columns) <= _MOST_KEPT:
            return iter([self.frame])
        return map(self.changed, self.result.batches([*columns, *self.needs]))

    @functools.cached_property
    def frame(self) -> DataFrame:
        """All of them at once."""
        return pd.concat(map(self.changed, self.result.batches(self.columns)), ignore_index=True)


class Distinct:
    """Rows that differ from one another, of frames that come one after the other."""

    def __init__(self):
        self._frames: list[DataFrame] = []
        self._known = self._new = 0

    def add(self, frame: DataFrame) -> None:
        """Note the rows of another frame."""
        self._frames.append(frame.drop_duplicates())
        self._new += len(self._frames[-1])
        if self._new > self._known + 10_000:
            self.frame()

    def frame(self) -> DataFrame:
        """All that differ, in the order of their first appearance."""
        together = pd.concat(self._frames, ignore_index=True).drop_duplicates(ignore_index=True)
        self._frames, self._known, self._new = [together], len(together), 0
        return together


class Spread(NamedTuple):
    """Numbers of each group `(groups,)`, NaN left out."""

    least: Array
    median: Array
    largest: Array


def _read_columns(rows: Iterable[DataFrame], columns: Iterable[str]) -> Iterable[DataFrame]:
    return rows.some(columns) if isinstance(rows, Rows) else rows


class Column(NamedTuple):
    """Numbers of each row, from some columns of it."""

    needs: Sequence[str]
    of: Callable[[DataFrame], Any]


class Groups:
    """Rows that have the same values of some columns, sorted by these; one group of all rows without any.

    Attributes:
        index: values of the columns, a level each.
        varied: columns of the rows that have more than one value.
    """

    def __init__(self, rows: Iterable[DataFrame], keys: Sequence[str], further: Sequence[str] = ()):
        self._rows, self._keys = rows, list(keys)
        distinct, first = Distinct(), {}
        self.varied: set[str] = set()
        for frame in _read_columns(rows, [*self._keys, *further]):
            if self._keys:
                distinct.add(frame[self._keys])
            for name in further if len(frame) else ():
                column = frame[name].to_numpy()
                if (column != first.setdefault(name, column[0])).any():
                    self.varied.add(name)
        if not self._keys:
            self.index: pd.Index = pd.RangeIndex(1)
            return
        self.index = distinct.frame().sort_values(self._keys).set_index(self._keys).index

    def __len__(self) -> int:
        return len(self.index)

    def of(self, frame: DataFrame) -> Array:
        """The group of each row."""
        if not self._keys:
            return np.zeros(len(frame), np.int64)
        return self.index.get_indexer(frame.set_index(self._keys).index)

    def _read(self, columns: Sequence[Column]) -> Iterator[tuple[Array, list[Array]]]:
        """Groups of the rows, and numbers by column, part by part."""
        for frame in _read_columns(self._rows, [*self._keys, *(name for column in columns for name in column.needs)]):
            yield self.of(frame), [np.asarray(column.of(frame), float) for column in columns]

    def means(self, columns: dict[str, Column]) -> DataFrame:
        """Means of numbers by group, NaN left out, and the number of rows in `rows`."""
        rows, counts = np.zeros(len(self), np.int64), np.zeros((len(columns), len(self)), np.int64)
        sums = np.zeros(counts.shape)
        for groups, numbers in self._read([*columns.values()]):
            np.add.at(rows, groups, 1)
            for i, values in enumerate(numbers):
                there = ~np.isnan(values)
                np.add.at(sums[i], groups[there], values[there])
                np.add.at(counts[i], groups[there], 1)
        with np.errstate(invalid="ignore"):
            means = dict(zip(columns, sums / counts, strict=True))
        return DataFrame({"rows": rows, **means}, index=self.index)

    def spread(self, column: Column) -> Spread:
        """The spread of a column's numbers in each group."""
        return spread(lambda: ((groups, values) for groups, (values,) in self._read([column])), len(self))

    def medians(self, column: Column) -> Series:
        """The median of a column in each group."""
        return Series(self.spread(column).median, self.index)


Stream = Callable[[], Iterable[tuple[Array, Array]]]
"""Gives groups and numbers of rows, part by part, the same each time."""


def spread(stream: Stream, groups: int) -> Spread:
    """The spread of numbers in groups 0 ... groups - 1; NaN where a group has none."""
    count = np.zeros(groups, np.int64)
    for of, _ in _numbers(stream):
        count += np.bincount(of, minlength=groups)
    ends, total, last = np.cumsum(count), int(count.sum()), np.maximum(count - 1, 0)
    first = ends - count
    with TemporaryFile() as file:
        # values of a group side by side, and one more for groups without any
        size = total + 1
        grouped = np.memmap(file, float, "w+", shape=size) if total > MOST_VALUES else np.empty(size)
        grouped[-1], free = np.nan, first.copy()
        for of, values in _numbers(stream):
            order = np.argsort(of, kind="stable")
            of = of[order]
            grouped[free[of] + np.arange(len(of)) - np.searchsorted(of, of)] = values[order]
            free += np.bincount(of, minlength=groups)
        for start, end in zip(first, ends, strict=True):
            grouped[start:end].sort()
        # the median lies between two ranks; a group without numbers has the one behind all others
        ranks = (np.where(count == 0, total, first + rank) for rank in (0, last // 2, (last + 1) // 2, last))
        least, below, above, largest = (grouped[rank] for rank in ranks)
    return Spread(least, 0.5 * (below + above), largest)


def _numbers(stream: Stream) -> Iterator[tuple[Array, Array]]:
    for of, values in stream():
        there = ~np.isnan(values)
        yield of[there], values[there]
