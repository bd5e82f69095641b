"""Two studies side by side: what differs in their configs, and where their metrics differ by more than noise.

Points are matched by the values of their axes, runs by their seeds. A seed has the same noise in both studies, so that the
spread of the differences seed by seed is the noise that a change has to exceed (a paired t-test at each point). With no two
seeds in common, means are compared by the spread over the seeds of each (Welch's t-test).

Thousands of points are tested, and the same seeds make their differences depend on one another. Points are therefore named
as different by the rule of Benjamini and Yekutieli (Annals of Statistics 29, 2001): whatever the dependence, on average at
most :data:`FALSE` of those named are not. For that reason, too, no spread is borrowed from other points.
"""

# pandas' and SciPy's own annotations are wider than what their functions return
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

from jaxbl.config import Config, is_boolean
from jaxbl.files import to_jsonable

from .metrics import ROUNDING, find_metric, is_magnitude
from .store import Store
from .sweep import StudyResult, open_study

FALSE_DISCOVERY_RATE = 0.05
"""Share of the points named as different that are not, on average and at most."""
_SURE = 0.99
"""Of intervals over all points: some forty metrics have one."""
_SAME = 1e-9
"""Values of an axis this close to each other, relatively, are one."""
_DECIDES_NOTHING = "title", "notes", "figures"
"""Keys that no number depends on."""


class MeanChange(NamedTuple):
    """How a metric moved over all common points: the factor from the first study to the second (geometric mean over points),
    of `converged` and `finite` the difference of the share.

    Attributes:
        value: the factor or difference; NaN where no point has one.
        low: lower end of its 99 % interval, by the spread over seeds of the mean over points; NaN with fewer than two seeds.
        high: upper end.
    """

    value: float
    low: float
    high: float

    def is_sure(self, neutral: float) -> bool:
        """Whether the interval leaves out no change."""
        return self.low > neutral or self.high < neutral


@dataclasses.dataclass(frozen=True)
class MetricChange:
    """A metric of both studies at their common points.

    Attributes:
        metric: column.
        better: which of two values is better, `less`, `more`, or neither (empty).
        points: that have a number in both.
        only: runs that have a number in the first study alone, and in the second alone.
        changed: points that differ by more than rounding; of `converged` and `finite`, where the share crosses half.
        differs: points that differ by more than noise; None where the seeds do not tell it, and of `converged` and `finite`.
        up: how many of these (or, where noise is not known, of `changed`) have the larger value in the second study.
        size: mean over points of the logarithm of the factor, without sign, of points that differ; of `converged` and
            `finite`, of the difference. Metrics are sorted by it.
        moved: over all common points.
        where: least and largest value among the points that differ, or the words, of each axis that they take a part of.
        most: the point that differs most: axis values, `first` and `second` (means over seeds); None where none does.
    """

    metric: str
    better: str
    points: int
    only: tuple[int, int]
    changed: int
    differs: int | None
    up: int
    size: float
    moved: MeanChange
    where: dict[str, list[Any]]
    most: dict[str, Any] | None

    @property
    def count(self) -> int:
        """Points that differ, by noise where that is known, else by rounding."""
        return self.changed if self.differs is None else self.differs

    @property
    def is_sure(self) -> bool:
        """Whether any point, or all together, differ by more than noise."""
        return bool(self.differs) or self.moved.is_sure(0.0 if is_boolean(self.metric) else 1.0)


@dataclasses.dataclass(frozen=True)
class Comparison:
    """What differs between two studies.

    Attributes:
        names: of the studies.
        config: old and new value of each key that differs, None where it is missing; keys that no number depends on are left
            out.
        made_by: the same of what computed the studies: backend and versions, which decide roundings.
        points: in both, in the first alone, in the second alone.
        axes: of both.
        seeds: in common.
        paired: whether runs are compared seed by seed.
        unfinished: runs that are there, and runs in all, of each study that is not finished, by name.
        metrics: those of both studies, the largest change first.
    """

    names: tuple[str, str]
    config: dict[str, tuple[Any, Any]]
    made_by: dict[str, tuple[Any, Any]]
    points: tuple[int, int, int]
    axes: tuple[str, ...]
    seeds: int
    paired: bool
    unfinished: dict[str, tuple[int, int]]
    metrics: tuple[MetricChange, ...]
    _studies: "tuple[_Side, _Side] | None" = dataclasses.field(repr=False, default=None)

    @property
    def knows_noise(self) -> bool:
        """Whether there are seeds enough to tell noise."""
        return any(one.differs is not None for one in self.metrics)

    def to_dict(self) -> dict[str, Any]:
        """Plain data for `comparison.json`."""
        data = {
            field.name: getattr(self, field.name) for field in dataclasses.fields(self) if not field.name.startswith("_")
        }
        data["points"] = dict(zip(("both", "first_only", "second_only"), self.points, strict=True))
        data["metrics"] = [
            dataclasses.asdict(one) | {"moved": one.moved._asdict(), "only": list(one.only)} for one in self.metrics
        ]
        return to_jsonable(data)

    def frame(self, metric: str) -> pd.DataFrame:
        """A metric at the common points: values of the axes, `first` and `second` (means over the seeds compared), and
        whether it `differs` by more than noise, or, where that is not known, than rounding."""
        assert self._studies is not None
        values = _Values(metric, *self._studies, self.paired)
        places = self._studies[0].places.reset_index(drop=True)
        first, second = values.means
        return places.assign(first=first, second=second, differs=values.differs)


def compare(first: str | Path | StudyResult, second: str | Path | StudyResult) -> Comparison:
    """Compare two studies, or folders of such, at the points that both have; unfinished ones as far as they are.

    An axis that only one of them has is compared at the value that the other's config gives this number. Memory grows with
    the number of runs.

    Raises:
        InputError: a folder holds no study, or a part of it is damaged.
    """
    studies = [one if isinstance(one, StudyResult) else open_study(one) for one in (first, second)]
    names = _names(first, second)
    paths = list(dict.fromkeys(axis.path for study in studies for axis in study.config.axes))
    sides, counts, seeds, paired = _matched(studies, paths)
    shared = [name for name in studies[0].columns if name in studies[1].columns and name not in (*paths, "seed")]
    metrics = [_changed(metric, *sides, paired) for metric in shared] if counts[0] else []
    # what moves none of the points comes last, in the order of the columns
    metrics.sort(key=lambda one: -one.size)
    unfinished = {
        name: (side.rows, study.runs)
        for name, side, study in zip(names, sides, studies, strict=True)
        if not study.is_finished(side.rows)
    }
    configs = [_flat({k: v for k, v in one.config.resolved().items() if k not in _DECIDES_NOTHING}) for one in studies]
    return Comparison(
        names=names,
        config=_different(*configs),
        made_by=_made_by(*studies),
        points=counts,
        axes=tuple(paths),
        seeds=seeds,
        paired=paired,
        unfinished=unfinished,
        metrics=tuple(metrics),
        _studies=sides,
    )


def _names(first: Any, second: Any) -> tuple[str, str]:
    """What the studies are called: their folders, or their titles."""
    names = []
    for number, one in zip(("first", "second"), (first, second), strict=True):
        if isinstance(one, StudyResult):
            names.append(str(one.source.folder) if isinstance(one.source, Store) else one.config.title or number)
        else:
            names.append(str(one))
    return (names[0], names[1]) if names[0] != names[1] else (f"{names[0]} (first)", f"{names[1]} (second)")


def _made_by(first: StudyResult, second: StudyResult) -> dict[str, tuple[Any, Any]]:
    """What computed the studies, where it differs and both are stored."""
    if not (isinstance(first.source, Store) and isinstance(second.source, Store)):
        return {}
    manifests = first.source.manifest, second.source.manifest
    return _different(*({"backend": one["backend"], **one["versions"]} for one in manifests))


def _flat(value: Any, prefix: str = "") -> dict[str, Any]:
    """Nested tables by dotted keys; tables of a list by their path or kind where that is theirs alone, else by number."""
    if isinstance(value, list) and value and all(isinstance(one, Mapping) for one in value):
        labels = [str(one.get("path", one.get("kind", i))) for i, one in enumerate(value)]
        labels = [label if labels.count(label) == 1 else str(i) for i, label in enumerate(labels)]
        value = dict(zip(labels, value, strict=True))
    if not isinstance(value, Mapping):
        return {prefix: value}
    return {key: one for name, item in value.items() for key, one in _flat(item, f"{prefix}.{name}".lstrip(".")).items()}


def _different(first: dict[str, Any], second: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    found = {key: (first.get(key), second.get(key)) for key in dict.fromkeys([*first, *second])}
    return {key: pair for key, pair in found.items() if pair[0] != pair[1]}


@dataclasses.dataclass(frozen=True)
class _Side:
    """A study's rows at the common points.

    `index` are the positions of rows, `(points, seeds)`, -1 where there is none; `places` the points' values of the axes.
    """

    study: StudyResult
    rows: int
    index: np.ndarray
    places: pd.DataFrame

    def values(self, metric: str) -> np.ndarray:
        """A metric `(points, seeds)`; NaN where there is no finite number. Signed errors by their size."""
        column = self.study.read([metric])[metric].to_numpy(float)
        found = np.where(self.index >= 0, column[self.index], np.nan)
        found[~np.isfinite(found)] = np.nan
        return np.abs(found) if is_magnitude(metric) else found


def _matched(studies: list[StudyResult], paths: list[str]) -> tuple[tuple[_Side, _Side], tuple[int, int, int], int, bool]:
    """Both studies' rows at common points; points in both, in the first and in the second alone; common seeds; whether pairs
    of them are compared."""
    frames = [_keys(study, paths) for study in studies]
    codes = [np.zeros(len(frame), np.int64) for frame in frames]
    for path in paths:
        codes = _combined(codes, _classes(*(frame[path] for frame in frames)))
    own = [np.unique(code) for code in codes]
    both = np.intersect1d(*own, assume_unique=True)
    seeds = [np.unique(frame["seed"]) for frame in frames]
    common = np.intersect1d(*seeds)
    enough = min(len(one) for one in seeds) >= 2
    paired = len(common) >= 2 or not enough
    sides = []
    for study, frame, code, seed in zip(studies, frames, codes, seeds, strict=True):
        used = common if paired else seed
        point, column = np.searchsorted(both, code), np.searchsorted(used, frame["seed"])
        kept = np.isin(code, both, assume_unique=False) & np.isin(frame["seed"], used)
        index = np.full((len(both), len(used)), -1)
        index[point[kept], column[kept]] = np.flatnonzero(kept)
        there = np.isin(code, both)
        first = np.zeros(len(both), int)
        first[point[there]] = np.flatnonzero(there)
        sides.append(_Side(study, len(frame), index, frame.loc[first, paths]))
    counts = len(both), len(own[0]) - len(both), len(own[1]) - len(both)
    return (sides[0], sides[1]), counts, len(common), paired


def _keys(study: StudyResult, paths: list[str]) -> pd.DataFrame:
    """Values of all axes and seeds of a study's rows; an axis that it does not have by its config."""
    own = [axis.path for axis in study.config.axes]
    frame = study.read([*own, "seed"])
    fixed = {path: _fixed(study.config, path) for path in paths if path not in own}
    return frame.assign(**fixed).reset_index(drop=True)


def _fixed(config: Config, path: str) -> Any:
    """The value that a config gives a path; NaN where it has none."""
    flat = _flat({key: value for key, value in config.resolved().items() if key != "axes"})
    return flat.get(path, math.nan)


def _classes(first: pd.Series, second: pd.Series) -> list[np.ndarray]:
    """Numbers of equal values in both columns, NaN a value of its own."""
    together = pd.concat([first, second], ignore_index=True)
    if together.dtype == object or not pd.api.types.is_numeric_dtype(together):
        found = pd.factorize(together)[0]
    else:
        values, found = np.unique(together.to_numpy(float), return_inverse=True)
        steps = np.diff(values) > _SAME * np.maximum(np.abs(values[1:]), np.abs(values[:-1]))
        found = np.concatenate([[0], np.cumsum(steps | np.isnan(values[1:]))])[found]
    return [found[: len(first)], found[len(first) :]]


def _combined(codes: list[np.ndarray], more: list[np.ndarray]) -> list[np.ndarray]:
    """Numbers of equal pairs of numbers."""
    count = max(int(one.max(initial=0)) for one in more) + 1
    pairs = np.concatenate([code * count + one for code, one in zip(codes, more, strict=True)])
    found = np.unique(pairs, return_inverse=True)[1]
    return [found[: len(codes[0])], found[len(codes[0]) :]]


class _Values:
    """A metric of both studies at their common points.

    Attributes:
        first, second: `(points, seeds)`.
        means: over seeds that have a number, `(points,)` each; of pairs, over those seeds that both have.
        changed: points that differ by more than rounding.
        noise: whether any point has seeds enough to tell noise.
        differs: points that differ by more than noise; without noise, `changed`.
    """

    def __init__(self, metric: str, first: _Side, second: _Side, paired: bool):
        a, b = first.values(metric), second.values(metric)
        both = np.isfinite(a) & np.isfinite(b) if paired else np.zeros(1, bool)
        self.only = (0, 0)
        if paired:
            there = (first.index >= 0) & (second.index >= 0)
            self.only = int((np.isfinite(a) & ~both & there).sum()), int((np.isfinite(b) & ~both & there).sum())
            a, b = np.where(both, a, np.nan), np.where(both, b, np.nan)
        self.first, self.second = a, b
        self.means = _mean(a), _mean(b)
        difference = self.means[1] - self.means[0]
        if is_boolean(metric):
            self.noise = False
            self.changed = (self.means[0] >= 0.5) != (self.means[1] >= 0.5)
            self.changed &= np.isfinite(difference)
        else:
            self.changed = np.abs(difference) > self._rounding(first, second)
            p = _p_paired(b - a) if paired else _p_apart(a, b)
            self.noise = bool(np.isfinite(p).any())
            p = np.where(np.isfinite(difference) & ~self.changed, 1.0, p)
        self.differs = _named(p) & self.changed if self.noise else self.changed

    def _rounding(self, first: _Side, second: _Side) -> np.ndarray:
        """Differences that roundings make: relative, and of what is far below the usual size."""
        precision = max((one.study.config.run.precision for one in (first, second)), key=ROUNDING.__getitem__)
        sizes = np.maximum(*(np.abs(one) for one in self.means))
        usual = np.nanmedian(sizes) if np.isfinite(sizes).any() else 0.0
        return ROUNDING[precision] * sizes + np.finfo(precision).eps * usual


def _mean(values: np.ndarray) -> np.ndarray:
    """Over seeds that have a number; NaN where none has."""
    there = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        return np.where(there, values, 0.0).sum(axis=1) / there.sum(axis=1)


def _spread(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Count, mean and squared standard error of the mean, of the numbers of each row; NaN with fewer than two."""
    there = np.isfinite(values)
    count, mean = there.sum(axis=1), _mean(values)
    square = (np.where(there, values - mean[:, None], 0.0) ** 2).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return count, mean, np.where(count > 1, square / (count - 1) / count, np.nan)


def _p_paired(differences: np.ndarray) -> np.ndarray:
    """Two-sided p-value of a t-test of each row's mean; NaN with fewer than two numbers."""
    count, mean, variance = _spread(differences)
    return _p(mean, variance, count - 1.0)


def _p_apart(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The same of the difference of two means (Welch)."""
    (m, a, u), (n, b, v) = _spread(first), _spread(second)
    with np.errstate(invalid="ignore", divide="ignore"):
        freedom = (u + v) ** 2 / (u**2 / (m - 1.0) + v**2 / (n - 1.0))
    # no spread at all
    return _p(b - a, u + v, np.where(u + v == 0.0, 1.0, freedom))


def _p(mean: np.ndarray, variance: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore", divide="ignore"):
        t = np.abs(mean) / np.sqrt(variance)
    found = 2.0 * stats.t.sf(t, np.maximum(freedom, 1.0))
    return np.where(np.isfinite(variance), np.where(mean == 0.0, 1.0, found), np.nan)


def _named(p: np.ndarray) -> np.ndarray:
    """Which p-values, NaN left out, are named as small: Benjamini and Yekutieli's rule for any dependence."""
    named, there = np.zeros(len(p), bool), np.isfinite(p)
    named[there] = stats.false_discovery_control(p[there], method="by") <= FALSE_DISCOVERY_RATE
    return named


def _changed(metric: str, first: _Side, second: _Side, paired: bool) -> MetricChange:
    """What became of a metric."""
    values, boolean = _Values(metric, first, second, paired), is_boolean(metric)
    a, b = values.means
    with np.errstate(divide="ignore", invalid="ignore"):
        change = b - a if boolean else np.log(b / a)
    size = np.abs(np.where(np.isfinite(change), change, 0.0))
    differs = values.differs
    compared = int(np.isfinite(b - a).sum())
    most = None
    if differs.any():
        # from or to zero: no factor
        largest = np.abs(np.where(differs, np.where(np.isnan(change), 0.0, change), -1.0))
        i = int(np.argmax(np.where(differs, largest, -1.0)))
        most = {**first.places.iloc[i].to_dict(), "first": float(a[i]), "second": float(b[i])}
    return MetricChange(
        metric=metric,
        better=find_metric(metric).better,
        points=compared,
        only=values.only,
        changed=int(values.changed.sum()),
        differs=int(differs.sum()) if values.noise else None,
        up=int((b > a)[differs].sum()),
        size=float((size if boolean else np.where(differs, size, 0.0)).sum() / max(compared, 1)),
        moved=_moved(values, boolean, paired),
        where=_where(first.places, differs),
        most=most,
    )


def _where(places: pd.DataFrame, differs: np.ndarray) -> dict[str, list[Any]]:
    """Where some points lie, by the axes of which they take a part only."""
    if not differs.any():
        return {}
    spans = {path: (_range(places.loc[differs, path]), _range(places[path])) for path in places}
    return {path: part for path, (part, whole) in spans.items() if part != whole}


def _range(column: pd.Series) -> list[Any]:
    if pd.api.types.is_numeric_dtype(column):
        return [float(column.min()), float(column.max())]
    return sorted(map(str, column.unique()))


def _moved(values: _Values, boolean: bool, paired: bool) -> MeanChange:
    """The mean over points of each seed, and what its spread over seeds says."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (one if boolean else np.log(one) for one in (values.first, values.second))
    a, b = (np.where(np.isfinite(one), one, np.nan) for one in (a, b))
    # the same points for all seeds
    whole = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    if not whole.any():
        return MeanChange(math.nan, math.nan, math.nan)
    a, b = a[whole].mean(axis=0), b[whole].mean(axis=0)
    if paired:
        count, mean, variance = (one[0] for one in _spread((b - a)[None]))
        freedom = count - 1.0
    else:
        (m, first, u), (n, second, v) = ([one[0] for one in _spread(side[None])] for side in (a, b))
        mean, variance = second - first, u + v
        freedom = (u + v) ** 2 / (u**2 / (m - 1.0) + v**2 / (n - 1.0)) if u + v > 0.0 else 1.0
    half = float(stats.t.ppf(0.5 + 0.5 * _SURE, freedom)) * math.sqrt(variance) if np.isfinite(variance) else math.nan
    ends = mean, mean - half, mean + half
    return MeanChange(*(float(end) if boolean else math.exp(end) for end in ends))
