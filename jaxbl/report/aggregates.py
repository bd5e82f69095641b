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

from jaxbl.sweeps.sweep import StudyResult

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
        changed: Callable[[pd.DataFrame], pd.DataFrame] = lambda frame: frame,
        needs: Iterable[str] = (),
    ):
        self._result, self._columns, self._changed = result, list(dict.fromkeys(columns)), changed
        self._needs = tuple(needs)

    def __iter__(self) -> Iterator[pd.DataFrame]:
        return self.some(self._columns)

    def some(self, columns: Iterable[str]) -> Iterator[pd.DataFrame]:
        """Some of the columns, or more."""
        if self._result.runs * len(self._columns) <= _MOST_KEPT:
            return iter([self.frame])
        return map(self._changed, self._result.batches([*columns, *self._needs]))

    @functools.cached_property
    def frame(self) -> pd.DataFrame:
        """All of them at once."""
        parts = [self._changed(part) for part in self._result.batches(self._columns)]
        return pd.concat(parts, ignore_index=True)


class Distinct:
    """Rows that differ from one another, of frames that come one after the other."""

    def __init__(self):
        self._members: list[pd.DataFrame] = []
        self._known = self._new = 0

    def add(self, frame: pd.DataFrame) -> None:
        """Note the rows of another frame."""
        self._members.append(frame.drop_duplicates())
        self._new += len(self._members[-1])
        if self._new > self._known + 10_000:
            self.frame()

    def frame(self) -> pd.DataFrame:
        """All that differ, in the order of their first appearance."""
        together = pd.concat(self._members, ignore_index=True).drop_duplicates(ignore_index=True)
        self._members, self._known, self._new = [together], len(together), 0
        return together


class Spread(NamedTuple):
    """Numbers of each group, NaN left out: count, least, largest `(groups,)` and quantiles `(quantiles, groups)`."""

    count: np.ndarray
    least: np.ndarray
    largest: np.ndarray
    quantiles: np.ndarray


def _some(rows: Iterable[pd.DataFrame], columns: Iterable[str]) -> Iterable[pd.DataFrame]:
    return rows.some(columns) if isinstance(rows, Rows) else rows


class Column(NamedTuple):
    """Numbers of each row, from some columns of it."""

    needs: Sequence[str]
    of: Callable[[pd.DataFrame], Any]


class Groups:
    """Rows that have the same values of some columns, sorted by these; one group of all rows without any.

    Attributes:
        index: values of the columns, a level each.
        varied: columns of the rows that have more than one value.
        rows: number of all rows.
    """

    def __init__(self, rows: Iterable[pd.DataFrame], keys: Sequence[str], others: Sequence[str] = ()):
        self._rows, self._keys = rows, list(keys)
        distinct, first = Distinct(), {}
        self.varied: set[str] = set()
        self.rows = 0
        for frame in _some(rows, [*self._keys, *others]):
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
        found = distinct.frame().sort_values(self._keys, ignore_index=True)
        self.index = pd.MultiIndex.from_frame(found) if len(self._keys) > 1 else pd.Index(found[self._keys[0]])
        self._values = [pd.Index(np.sort(found[key].unique())) for key in self._keys]
        self._known = self._flat(found)

    def __len__(self) -> int:
        return len(self.index)

    def _flat(self, frame: pd.DataFrame) -> np.ndarray:
        """One number for the keys of each row, growing as they are sorted."""
        flat = np.zeros(len(frame), np.int64)
        for key, values in zip(self._keys, self._values, strict=True):
            flat = flat * len(values) + values.get_indexer(frame[key])
        return flat

    def of(self, frame: pd.DataFrame) -> np.ndarray:
        """The group of each row."""
        return np.searchsorted(self._known, self._flat(frame)) if self._keys else np.zeros(len(frame), np.int64)

    def means(self, columns: dict[str, Column]) -> pd.DataFrame:
        """Means of numbers by group, NaN left out, and the number of rows in `rows`."""
        sums = {name: np.zeros(len(self)) for name in columns}
        counts = {name: np.zeros(len(self), np.int64) for name in ("rows", *columns)}
        needs = [name for column in columns.values() for name in column.needs]
        for frame in _some(self._rows, [*self._keys, *needs]):
            groups = self.of(frame)
            np.add.at(counts["rows"], groups, 1)
            for name, column in columns.items():
                values = np.asarray(column.of(frame), float)
                there = ~np.isnan(values)
                np.add.at(sums[name], groups[there], values[there])
                np.add.at(counts[name], groups[there], 1)
        with np.errstate(invalid="ignore"):
            found = {name: sums[name] / counts[name] for name in columns}
        return pd.DataFrame({"rows": counts["rows"], **found}, index=self.index)

    def spread(self, column: Column, quantiles: Sequence[float] = (0.5,)) -> Spread:
        """How the numbers of a column are spread in each group."""

        def numbers() -> Iterator[tuple[np.ndarray, np.ndarray]]:
            for frame in _some(self._rows, [*self._keys, *column.needs]):
                yield self.of(frame), np.asarray(column.of(frame), float)

        return spread(numbers, len(self), quantiles)

    def medians(self, column: Column) -> pd.Series:
        """The median of a column in each group."""
        return pd.Series(self.spread(column).quantiles[0], self.index)


Stream = Callable[[], Iterable[tuple[np.ndarray, np.ndarray]]]
"""Gives groups and numbers of rows, part by part, the same each time."""


def spread(stream: Stream, groups: int, quantiles: Sequence[float]) -> Spread:
    """How numbers are spread in groups 0 ... groups - 1; NaN where a group has none."""
    count, total = np.zeros(groups, np.int64), 0
    least, largest = np.full(groups, np.inf), np.full(groups, -np.inf)
    kept: list[tuple[np.ndarray, np.ndarray]] = []
    for of, values in _numbers(stream):
        np.add.at(count, of, 1)
        np.minimum.at(least, of, values)
        np.maximum.at(largest, of, values)
        total += len(values)
        if total <= MOST_VALUES:
            kept.append((of, values))
        else:
            kept.clear()
    empty = count == 0
    place = np.asarray(quantiles, float)[:, None] * np.maximum(count - 1, 0)
    # each quantile lies between two ranks
    ranks = np.stack([np.floor(place), np.ceil(place)], axis=1).astype(np.int64).reshape(-1, groups)
    if total <= MOST_VALUES:
        of, values = (np.concatenate(one) for one in zip(*kept, strict=True)) if kept else (empty[:0], least[:0])
        values = np.append(values[np.lexsort((values, of))], np.nan)
        first = np.cumsum(count) - count
        found = values[np.where(empty, len(values) - 1, first + ranks)]
    else:
        found = _ranked(stream, count, least, largest, ranks)
    below, above = found[::2], found[1::2]
    share = place - np.floor(place)
    with np.errstate(invalid="ignore"):
        # as NumPy interpolates
        between = np.where(share < 0.5, below + (above - below) * share, above - (above - below) * (1.0 - share))
        between = np.where(share == 0.5, 0.5 * (below + above), between)
    least[empty] = largest[empty] = between[:, empty] = np.nan
    return Spread(count, least, largest, between)


def _numbers(stream: Stream) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    for of, values in stream():
        there = ~np.isnan(values)
        yield of[there], values[there]


_SIGN = np.uint64(1 << 63)


def _keys(values: np.ndarray) -> np.ndarray:
    """Whole numbers in the order of floating-point ones."""
    bits = (values + 0.0).view(np.uint64)
    return np.where(bits & _SIGN, ~bits, bits | _SIGN)


def _floats(keys: np.ndarray) -> np.ndarray:
    return np.where(keys & _SIGN, keys ^ _SIGN, ~keys).view(np.float64)


def _ranked(stream: Stream, count: np.ndarray, least: np.ndarray, largest: np.ndarray, ranks: np.ndarray) -> np.ndarray:
    """The values of some ranks `(ranks, groups)`, growing along the first axis, in each group."""
    some = count > 0
    shape = ranks.shape
    low, high = (np.broadcast_to(_keys(np.where(some, one, 0.0)), shape).copy() for one in (least, largest))
    inside = np.broadcast_to(count, shape).copy()
    ranks = ranks.copy()
    while True:
        # ranks in the same interval share it, as they lie side by side
        sought = (low < high) & some
        fresh = sought.copy()
        fresh[1:] &= (low[1:] != low[:-1]) | (high[1:] != high[:-1])
        numbers = np.cumsum(fresh, axis=0) + np.r_[0, np.cumsum(fresh.sum(axis=0))[:-1]] - 1
        owners, left = int(fresh.sum()), int(inside[fresh].sum())
        if left <= MOST_VALUES:
            break
        bins = int(np.clip(MOST_VALUES // owners, 4, 4096))
        width = (high - low) // np.uint64(bins) + np.uint64(1)
        counts = np.zeros(owners * bins, np.int64)
        for t, of, keys in _within(stream, low, high, fresh):
            which = ((keys - low[t, of]) // width[t, of]).astype(np.int64)
            np.add.at(counts, numbers[t, of] * bins + which, 1)
        below = np.cumsum(counts.reshape(owners, bins), axis=1)
        for t in range(len(ranks)):
            at = np.flatnonzero(sought[t])
            own = below[numbers[t, at]]
            found = (own <= ranks[t, at, None]).sum(axis=1)
            before = np.where(found > 0, own[np.arange(len(at)), found - 1], 0)
            inside[t, at] = own[np.arange(len(at)), found] - before
            ranks[t, at] -= before
            low[t, at] += found.astype(np.uint64) * width[t, at]
            high[t, at] = np.minimum(low[t, at] + (width[t, at] - np.uint64(1)), high[t, at])
    parts = [(numbers[t, of], keys) for t, of, keys in _within(stream, low, high, fresh)] if left else []
    result = low.copy()
    if parts:
        of, keys = (np.concatenate(one) for one in zip(*parts, strict=True))
        keys = keys[np.lexsort((keys, of))]
        sizes = np.bincount(of, minlength=owners)
        first = np.cumsum(sizes) - sizes
        result[sought] = keys[first[numbers[sought]] + ranks[sought]]
    return _floats(result)


def _within(
    stream: Stream, low: np.ndarray, high: np.ndarray, fresh: np.ndarray
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Of each part, for each rank: groups and keys of the numbers that lie in the group's interval for that rank."""
    wanted = [t for t in range(len(low)) if fresh[t].any()]
    for of, values in _numbers(stream):
        keys = _keys(values)
        for t in wanted:
            there = fresh[t, of] & (keys >= low[t, of]) & (keys <= high[t, of])
            yield t, of[there], keys[there]
