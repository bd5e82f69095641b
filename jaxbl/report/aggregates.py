"""Medians, means and extremes of a study's runs by groups, in memory that does not grow with the number of runs.

Few rows are kept; many are read part by part as often as is needed. Medians and quantiles are exact either way: many values
are sorted in a file.
"""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportReturnType=false

import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
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


class Rows:
    """Some columns of a study's rows, to be gone through several times: kept where they are few, else read each time.

    Args:
        result: the study.
        columns: names.
        changed: applied to each part.
        needs: columns that this looks at.
    """

    def __init__(
        self,
        result: StudyResult,
        columns: Iterable[str],
        changed: Callable[[DataFrame], DataFrame] = lambda frame: frame,
        needs: Iterable[str] = (),
    ):
        self._result, self._columns, self._changed = result, list(dict.fromkeys(columns)), changed
        self._needs = tuple(needs)

    def __iter__(self) -> Iterator[DataFrame]:
        return self.some(self._columns)

    def some(self, columns: Iterable[str]) -> Iterator[DataFrame]:
        """Some of the columns, or more."""
        if self._result.runs * len(self._columns) <= _MOST_KEPT:
            return iter([self.frame])
        return map(self._changed, self._result.batches([*columns, *self._needs]))

    @functools.cached_property
    def frame(self) -> DataFrame:
        """All of them at once."""
        parts = [self._changed(part) for part in self._result.batches(self._columns)]
        return pd.concat(parts, ignore_index=True)


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
    """Numbers of each group, NaN left out: count, least, largest `(groups,)` and quantiles `(quantiles, groups)`."""

    count: Array
    least: Array
    largest: Array
    quantiles: Array


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
        rows: number of all rows.
    """

    def __init__(self, rows: Iterable[DataFrame], keys: Sequence[str], further: Sequence[str] = ()):
        self._rows, self._keys = rows, list(keys)
        distinct, first = Distinct(), {}
        self.varied: set[str] = set()
        self.rows = 0
        for frame in _read_columns(rows, [*self._keys, *further]):
            self.rows += len(frame)
            if self._keys:
                distinct.add(frame[self._keys])
            for name in further if len(frame) else ():
                column = frame[name].to_numpy()
                if (column != first.setdefault(name, column[0])).any():
                    self.varied.add(name)
        if not self._keys:
            self.index: pd.Index = pd.RangeIndex(1)
            return
        groups = distinct.frame().sort_values(self._keys, ignore_index=True)
        self.index = pd.MultiIndex.from_frame(groups) if len(self._keys) > 1 else pd.Index(groups[self._keys[0]])
        self._values = [pd.Index(np.sort(groups[key].unique())) for key in self._keys]
        self._numbers = self._number(groups)

    def __len__(self) -> int:
        return len(self.index)

    def _number(self, frame: DataFrame) -> Array:
        """One number for the keys of each row, growing as they are sorted."""
        number = np.zeros(len(frame), np.int64)
        for key, values in zip(self._keys, self._values, strict=True):
            number = number * len(values) + values.get_indexer(frame[key])
        return number

    def of(self, frame: DataFrame) -> Array:
        """The group of each row."""
        return np.searchsorted(self._numbers, self._number(frame)) if self._keys else np.zeros(len(frame), np.int64)

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

    def spread(self, column: Column, quantiles: Sequence[float] = (0.5,)) -> Spread:
        """The spread of a column's numbers in each group."""
        return spread(lambda: ((groups, values) for groups, (values,) in self._read([column])), len(self), quantiles)

    def medians(self, column: Column) -> Series:
        """The median of a column in each group."""
        return Series(self.spread(column).quantiles[0], self.index)


Stream = Callable[[], Iterable[tuple[Array, Array]]]
"""Gives groups and numbers of rows, part by part, the same each time."""


def spread(stream: Stream, groups: int, quantiles: Sequence[float]) -> Spread:
    """The spread of numbers in groups 0 ... groups - 1; NaN where a group has none."""
    count = np.zeros(groups, np.int64)
    for of, _ in _numbers(stream):
        count += np.bincount(of, minlength=groups)
    ends, total, empty = np.cumsum(count), int(count.sum()), count == 0
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
        place = np.asarray([0.0, 1.0, *quantiles])[:, None] * np.maximum(count - 1, 0)
        # each quantile lies between two ranks
        below, above = (
            grouped[np.where(empty, total, first + rank(place).astype(np.int64))] for rank in (np.floor, np.ceil)
        )
    share = place - np.floor(place)
    with np.errstate(invalid="ignore"):
        # as NumPy interpolates
        between = np.where(share < 0.5, below + (above - below) * share, above - (above - below) * (1.0 - share))
        between = np.where(share == 0.5, 0.5 * (below + above), between)
    return Spread(count, between[0], between[1], between[2:])


def _numbers(stream: Stream) -> Iterator[tuple[Array, Array]]:
    for of, values in stream():
        there = ~np.isnan(values)
        yield of[there], values[there]
