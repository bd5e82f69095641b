"""Medians, means and extremes of a study's runs by groups, in memory that does not grow with the number of runs.

Few rows are kept; many are read part by part as often as is needed. Medians and quantiles are exact either way: of many
values, each pass counts how many fall into narrow intervals about the ranks sought, until what is left fits into memory.
"""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportReturnType=false

import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from pandas import DataFrame, Series

from jaxbl.sweeps.sweep import StudyResult

Array = np.ndarray

MOST_VALUES = 4_000_000
"""Sorted at once: 100 MB with what sorting them takes."""
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

    def __init__(self, rows: Iterable[DataFrame], keys: Sequence[str], others: Sequence[str] = ()):
        self._rows, self._keys = rows, list(keys)
        distinct, first = Distinct(), {}
        self.varied: set[str] = set()
        self.rows = 0
        for frame in _read_columns(rows, [*self._keys, *others]):
            self.rows += len(frame)
            if self._keys:
                distinct.add(frame[self._keys])
            for name in others if len(frame) else ():
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
    count, total = np.zeros(groups, np.int64), 0
    least, largest = np.full(groups, np.inf), np.full(groups, -np.inf)
    parts = [(np.zeros(0, int), np.zeros(0))]
    for of, values in _numbers(stream):
        np.add.at(count, of, 1)
        np.minimum.at(least, of, values)
        np.maximum.at(largest, of, values)
        total += len(values)
        if total <= MOST_VALUES:
            parts.append((of, values))
        else:
            parts.clear()
    empty = count == 0
    place = np.asarray(quantiles, float)[:, None] * np.maximum(count - 1, 0)
    # each quantile lies between two ranks
    ranks = np.stack([np.floor(place), np.ceil(place)], axis=1).astype(np.int64).reshape(-1, groups)
    if total <= MOST_VALUES:
        values = np.append(_sort_by_group(parts), np.nan)
        ranked = values[np.where(empty, len(values) - 1, np.cumsum(count) - count + ranks)]
    else:
        ranked = _select_ranks(stream, count, least, largest, ranks)
    below, above = ranked[::2], ranked[1::2]
    share = place - np.floor(place)
    with np.errstate(invalid="ignore"):
        # as NumPy interpolates
        between = np.where(share < 0.5, below + (above - below) * share, above - (above - below) * (1.0 - share))
        between = np.where(share == 0.5, 0.5 * (below + above), between)
    least[empty] = largest[empty] = between[:, empty] = np.nan
    return Spread(count, least, largest, between)


def _sort_by_group(parts: Iterable[tuple[Array, Array]]) -> Array:
    """Values of all parts, those of the first group first, growing in each group."""
    of, values = map(np.concatenate, zip(*parts, strict=True))
    return values[np.lexsort((values, of))]


def _numbers(stream: Stream) -> Iterator[tuple[Array, Array]]:
    for of, values in stream():
        there = ~np.isnan(values)
        yield of[there], values[there]


_SIGN = np.uint64(1 << 63)


def _keys(values: Array) -> Array:
    """Whole numbers in the order of floating-point ones."""
    bits = (values + 0.0).view(np.uint64)
    return np.where(bits & _SIGN, ~bits, bits | _SIGN)


def _floats(keys: Array) -> Array:
    return np.where(keys & _SIGN, keys ^ _SIGN, ~keys).view(np.float64)


def _select_ranks(stream: Stream, count: Array, least: Array, largest: Array, ranks: Array) -> Array:
    """The values of some ranks `(ranks, groups)`, growing along the first axis, in each group."""
    # an empty group has the same ends
    ends = (np.where(count > 0, values, 0.0) for values in (least, largest))
    low, high, inside = (np.broadcast_to(values, ranks.shape).copy() for values in (*map(_keys, ends), count))
    ranks = ranks.copy()
    while True:
        # ranks in the same interval share it, as they lie side by side
        sought = low < high
        fresh = sought.copy()
        fresh[1:] &= (low[1:] != low[:-1]) | (high[1:] != high[:-1])
        numbers = np.cumsum(fresh, axis=0) + np.r_[0, np.cumsum(fresh.sum(axis=0))[:-1]] - 1
        owners, left = int(fresh.sum()), int(inside[fresh].sum())
        if left <= MOST_VALUES:
            break
        bins = int(np.clip(MOST_VALUES // owners, 4, 4096))
        width = (high - low) // np.uint64(bins) + np.uint64(1)
        counts = np.zeros((owners, bins), np.int64)
        for t, of, keys in _within(stream, low, high, fresh):
            np.add.at(counts, (numbers[t, of], ((keys - low[t, of]) // width[t, of]).astype(np.int64)), 1)
        counts = np.cumsum(counts, axis=1)
        for t, rows in enumerate(sought):
            up_to = counts[numbers[t, rows]]
            bin_, place = (up_to <= ranks[t, rows, None]).sum(axis=1), np.arange(len(up_to))
            before = np.where(bin_ > 0, up_to[place, bin_ - 1], 0)
            inside[t, rows] = up_to[place, bin_] - before
            ranks[t, rows] -= before
            low[t, rows] += bin_.astype(np.uint64) * width[t, rows]
        high[sought] = np.minimum(low + width - np.uint64(1), high)[sought]
    if left:
        parts = [(numbers[t, of], keys) for t, of, keys in _within(stream, low, high, fresh)]
        sizes = inside[fresh][np.argsort(numbers[fresh])]
        low[sought] = _sort_by_group(parts)[(np.cumsum(sizes) - sizes)[numbers[sought]] + ranks[sought]]
    return _floats(low)


def _within(stream: Stream, low: Array, high: Array, fresh: Array) -> Iterator[tuple[int, Array, Array]]:
    """For each rank, of each part: groups and keys of the numbers that lie in the group's interval for that rank."""
    for of, values in _numbers(stream):
        keys = _keys(values)
        for t in np.flatnonzero(fresh.any(axis=1)):
            there = fresh[t, of] & (keys >= low[t, of]) & (keys <= high[t, of])
            yield t, of[there], keys[there]
