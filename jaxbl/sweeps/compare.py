"""Two studies side by side: what differs in their configs, and where their metrics differ by more than noise.

Points are matched by the values of their axes, runs by their seeds. A seed has the same noise in both studies, so that a
change must exceed the spread of the differences seed by seed (a paired t-test at each point). With fewer than two common
seeds, means are compared by the spread over the seeds of each study (Welch's t-test).

Thousands of points are tested, and their differences depend on one another, since they have the same seeds. Points are
therefore selected by the rule of Benjamini and Yekutieli (Annals of Statistics 29, 2001), which holds for any dependence: on
average at most :data:`FALSE_DISCOVERY_RATE` of the selected points do not differ. For the same reason each point is tested
with its own spread alone.
"""

# pandas' and SciPy's own annotations are wider than what their functions return
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false

import dataclasses
import functools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

from jaxbl.config import Config, is_boolean
from jaxbl.files import to_jsonable
from jaxbl.json_types import JsonObject

from .metrics import ROUNDING, find_metric, is_magnitude
from .store import Store
from .sweep import StudyResult, open_study

FALSE_DISCOVERY_RATE = 0.05
"""Largest share, on average, of the points selected as different that are not."""
_CONFIDENCE = 0.99
"""Confidence of the intervals over all points: some forty metrics have one."""
_AXIS_TOLERANCE = 1e-9
"""Relative difference up to which two values of an axis are the same."""
_ignore_undefined = functools.partial(np.errstate, divide="ignore", invalid="ignore")
"""Context in which numbers that are not defined become NaN or infinite without a warning."""
_IGNORED_KEYS = "title", "notes", "figures"
"""Keys on which no number depends."""


class MeanChange(NamedTuple):
    """Mean change of a metric over all common points.

    It is the factor from the first study to the second (geometric mean over points); for `converged` and `finite` the
    difference of the shares.

    Attributes:
        value: the factor or difference; NaN if no point has one.
        low: lower end of its 99 % interval, by the spread over seeds of the mean over points; NaN with fewer than two seeds.
        high: upper end of the interval.
    """

    value: float
    low: float
    high: float

    def is_sure(self, neutral: float) -> bool:
        """True if the interval excludes `neutral`, the value for no change."""
        return self.low > neutral or self.high < neutral


@dataclasses.dataclass(frozen=True)
class MetricChange:
    """Change of a metric between two studies at their common points.

    Attributes:
        metric: column.
        better: the better one of two values, `less` or `more`; empty if neither is.
        points: number of points with a number in both studies.
        only: number of runs with a number in the first study alone, and in the second alone.
        changed: number of points that differ by more than rounding; for `converged` and `finite`, whose share crosses half.
        differs: number of points that differ by more than noise; None if there are too few seeds, and for `converged` and
            `finite`.
        up: number of differing points (see `count`) with the larger value in the second study.
        size: absolute logarithm of the factor at differing points, as a mean over points; for `converged` and `finite` the
            absolute difference. Metrics are sorted by it.
        moved: mean change over all common points.
        where: range of the differing points along each axis of which they cover a part: least and largest value, or words.
        most: the point that differs most: axis values, `first` and `second` (means over seeds); None if no point differs.
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
    most: JsonObject | None

    @property
    def count(self) -> int:
        """Number of differing points: by more than noise if that is known, else by more than rounding."""
        return self.changed if self.differs is None else self.differs

    @property
    def is_sure(self) -> bool:
        """True if any point, or the mean over all points, differs by more than noise."""
        return bool(self.differs) or self.moved.is_sure(0.0 if is_boolean(self.metric) else 1.0)


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Differences between two studies.

    Attributes:
        names: names of the studies.
        config: first and second value of each key that differs, None if it is missing; without keys on which no number
            depends.
        made_by: the same for backend and versions, which decide the rounding.
        points: number of points in both studies, in the first alone, in the second alone.
        axes: paths of the axes of both studies.
        seeds: number of common seeds.
        paired: True if runs are compared seed by seed.
        unfinished: number of runs that are stored, and of all runs, of each unfinished study by name.
        metrics: changes of the metrics of both studies, the largest first.
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
    _studies: "tuple[_MatchedStudy, _MatchedStudy]" = dataclasses.field(repr=False)

    @property
    def first_config(self) -> Config:
        """The first study."""
        return self._studies[0].study.config

    @property
    def knows_noise(self) -> bool:
        """True if there are enough seeds to estimate the noise."""
        return any(change.differs is not None for change in self.metrics)

    def to_dict(self) -> JsonObject:
        """The comparison as plain data for `comparison.json`."""
        table = {name: entry for name, entry in vars(self).items() if not name.startswith("_")}
        table["points"] = dict(zip(("both", "first_only", "second_only"), self.points, strict=True))
        table["metrics"] = [dataclasses.asdict(change) | {"moved": change.moved._asdict()} for change in self.metrics]
        return to_jsonable(table)

    def frame(self, metric: str) -> pd.DataFrame:
        """A metric at the common points.

        The columns are the axes, `first` and `second` (means over the seeds compared), and `differs`, which is True for
        points that differ by more than noise, or by more than rounding if the noise is not known.
        """
        matched = _MatchedMetric(metric, *self._studies, self.paired)
        first, second = matched.means
        return matched.axis_values.reset_index(drop=True).assign(first=first, second=second, differs=matched.differs)


def compare(first: str | Path | StudyResult, second: str | Path | StudyResult) -> Comparison:
    """Compare two studies at their common points; of unfinished studies, the points that are stored.

    An axis that only one study has is compared at the value that the other study's config has for its path. Memory grows
    with the number of runs.

    Args:
        first: a study, or its folder.
        second: the study that it is compared with, or its folder.

    Raises:
        InputError: a folder holds no study, or a part of it is damaged.
    """
    studies = [study if isinstance(study, StudyResult) else open_study(study) for study in (first, second)]
    names = _study_names(*studies)
    paths = list(dict.fromkeys(axis.path for study in studies for axis in study.config.axes))
    matched, point_counts, seed_count, paired = _match_points(studies, paths)
    columns = [name for name in studies[0].columns if name in studies[1].columns and name not in (*paths, "seed")]
    changes = [_MatchedMetric(metric, *matched, paired).change() for metric in columns] if point_counts[0] else []
    # metrics without a change come last, in the order of the columns
    changes.sort(key=lambda change: -change.size)
    unfinished = {
        name: (rows.row_count, rows.study.runs)
        for name, rows in zip(names, matched, strict=True)
        if not rows.study.is_finished(rows.row_count)
    }
    configs = [
        _flatten_tables({key: table for key, table in study.config.to_dict().items() if key not in _IGNORED_KEYS})
        for study in studies
    ]
    return Comparison(
        names=names,
        config=_differing_keys(*configs),
        made_by=_compare_versions(*studies),
        points=point_counts,
        axes=tuple(paths),
        seeds=seed_count,
        paired=paired,
        unfinished=unfinished,
        metrics=tuple(changes),
        _studies=matched,
    )


def _study_names(*studies: StudyResult) -> tuple[str, str]:
    """Names of the studies: their folders, or their titles."""
    names = [
        str(study.source.folder) if isinstance(study.source, Store) else study.config.title or ordinal
        for ordinal, study in zip(("first", "second"), studies, strict=True)
    ]
    return (names[0], names[1]) if names[0] != names[1] else (f"{names[0]} (first)", f"{names[1]} (second)")


def _compare_versions(*studies: StudyResult) -> dict[str, tuple[Any, Any]]:
    """Backend and versions that differ, if both studies are stored."""
    manifests = [study.source.manifest for study in studies if isinstance(study.source, Store)]
    if len(manifests) < 2:
        return {}
    return _differing_keys(*({"backend": manifest["backend"], **manifest["versions"]} for manifest in manifests))


def _flatten_tables(tree: Any, prefix: str = "") -> JsonObject:
    """Leaves of nested tables by dotted key; a table of a list by its path or kind if that is unique, else by its number."""
    if isinstance(tree, list) and tree and all(isinstance(table, Mapping) for table in tree):
        labels = [str(table.get("path", table.get("kind", i))) for i, table in enumerate(tree)]
        labels = [label if labels.count(label) == 1 else str(i) for i, label in enumerate(labels)]
        tree = dict(zip(labels, tree, strict=True))
    if not isinstance(tree, Mapping):
        return {prefix: tree}
    leaves: JsonObject = {}
    for key, branch in tree.items():
        leaves |= _flatten_tables(branch, f"{prefix}.{key}".lstrip("."))
    return leaves


def _differing_keys(first: JsonObject, second: JsonObject) -> dict[str, tuple[Any, Any]]:
    """Both values of each key that differs; None if it is missing."""
    pairs = {key: (first.get(key), second.get(key)) for key in dict.fromkeys([*first, *second])}
    return {key: pair for key, pair in pairs.items() if pair[0] != pair[1]}


@dataclasses.dataclass(frozen=True)
class _MatchedStudy:
    """The rows of a study at the common points.

    Attributes:
        study: the study.
        row_count: number of all its rows.
        row_index: positions of the rows, `(points, seeds)`; -1 if there is none.
        axis_values: values of all axes, a row for each point.
    """

    study: StudyResult
    row_count: int
    row_index: np.ndarray
    axis_values: pd.DataFrame

    def read_metric(self, metric: str) -> np.ndarray:
        """A metric `(points, seeds)`; NaN if it is not finite. Signed errors are returned as absolute values."""
        column = self.study.read([metric])[metric].to_numpy(float)
        values = np.where(self.row_index >= 0, column[self.row_index], np.nan)
        values[~np.isfinite(values)] = np.nan
        return np.abs(values) if is_magnitude(metric) else values


def _match_points(
    studies: list[StudyResult], paths: list[str]
) -> tuple[tuple[_MatchedStudy, _MatchedStudy], tuple[int, int, int], int, bool]:
    """Match the rows of two studies by axis values and seeds.

    Returns:
        The matched studies; the number of points in both, in the first and in the second alone; the number of common seeds;
        True if runs are compared seed by seed.
    """
    frames = [_read_keys(study, paths) for study in studies]
    joint = pd.concat(frames, ignore_index=True)
    # without axes all rows are of one point
    groups = joint[paths].apply(_number_values).groupby(paths).ngroup() if paths else np.zeros(len(joint), int)
    # the last row of each point and seed
    first, second = (
        frame.assign(point=point, row=np.arange(len(frame))).pivot_table("row", "point", "seed", "last")
        for frame, point in zip(frames, np.split(np.asarray(groups), [len(frames[0])]), strict=True)
    )
    points, seeds = first.index.intersection(second.index), first.columns.intersection(second.columns)
    paired = len(seeds) >= 2 or min(first.shape[1], second.shape[1]) < 2
    matched = []
    for study, frame, rows in zip(studies, frames, (first, second), strict=True):
        rows = rows.loc[points].fillna(-1).astype(int)
        row_index = rows[seeds] if paired else rows
        matched.append(_MatchedStudy(study, len(frame), row_index.to_numpy(), frame[paths].iloc[rows.max(axis=1)]))
    counts = len(points), len(first) - len(points), len(second) - len(points)
    return (matched[0], matched[1]), counts, len(seeds), paired


def _read_keys(study: StudyResult, paths: list[str]) -> pd.DataFrame:
    """Values at all paths, and seeds, of a study's rows; its config has the value of a path that is none of its axes."""
    axis_paths = [axis.path for axis in study.config.axes]
    leaves = _flatten_tables(study.config.to_dict())
    constants = {path: leaves.get(path, math.nan) for path in paths if path not in axis_paths}
    return study.read([*axis_paths, "seed"]).assign(**constants).reset_index(drop=True)


def _number_values(column: pd.Series) -> np.ndarray:
    """Number the values of a column so that equal values, within a tolerance, have equal numbers; NaN has its own."""
    if column.dtype == object or not pd.api.types.is_numeric_dtype(column):
        return pd.factorize(column)[0]
    values, index = np.unique(column.to_numpy(float), return_inverse=True)
    steps = np.diff(values) > _AXIS_TOLERANCE * np.maximum(np.abs(values[1:]), np.abs(values[:-1]))
    return np.concatenate([[0], np.cumsum(steps | np.isnan(values[1:]))])[index]


class _MatchedMetric:
    """A metric of two studies at their common points.

    Attributes:
        metric: column.
        boolean: True if its values are true or false.
        paired: True if runs are compared seed by seed.
        axis_values: values of all axes, a row for each point.
        first, second: the metric, `(points, seeds)`; if paired, NaN unless both studies have a number.
        only: number of runs with a number in the first study alone, and in the second alone.
        means: mean over the seeds with a number, `(points,)` for each study.
        changed: points that differ by more than rounding.
        knows_noise: True if any point has enough seeds to estimate the noise.
        differs: points that differ by more than noise; without noise, `changed`.
    """

    def __init__(self, metric: str, first: _MatchedStudy, second: _MatchedStudy, paired: bool):
        self.metric, self.boolean, self.paired, self.axis_values = metric, is_boolean(metric), paired, first.axis_values
        a, b = first.read_metric(metric), second.read_metric(metric)
        self.only: Any = (0, 0)
        if paired:
            finite = np.isfinite(a) & np.isfinite(b)
            stored = (first.row_index >= 0) & (second.row_index >= 0)
            self.only = tuple(int((np.isfinite(values) & ~finite & stored).sum()) for values in (a, b))
            a, b = np.where(finite, a, np.nan), np.where(finite, b, np.nan)
        self.first, self.second = a, b
        self.means = _row_means(a), _row_means(b)
        difference = self.means[1] - self.means[0]
        if self.boolean:
            self.knows_noise = False
            self.changed = (self.means[0] >= 0.5) != (self.means[1] >= 0.5)
            self.changed &= np.isfinite(difference)
        else:
            self.changed = np.abs(difference) > self._rounding_errors(first, second)
            p = _t_test(*_mean_differences(a, b, paired))
            self.knows_noise = bool(np.isfinite(p).any())
            p = np.where(np.isfinite(difference) & ~self.changed, 1.0, p)
        self.differs = _select_significant(p) & self.changed if self.knows_noise else self.changed

    def _rounding_errors(self, first: _MatchedStudy, second: _MatchedStudy) -> np.ndarray:
        """Largest differences by rounding `(points,)`: relative, with a floor for points far below the median."""
        precision = max((rows.study.config.run.precision for rows in (first, second)), key=ROUNDING.__getitem__)
        sizes = np.maximum(*(np.abs(mean) for mean in self.means))
        median = np.nanmedian(sizes) if np.isfinite(sizes).any() else 0.0
        return ROUNDING[precision] * sizes + np.finfo(precision).eps * median

    def change(self) -> MetricChange:
        """The change from the first study to the second."""
        a, b = self.means
        with _ignore_undefined():
            change = b - a if self.boolean else np.log(b / a)
        size = np.abs(np.where(np.isfinite(change), change, 0.0))
        differs, compared, most = self.differs, int(np.isfinite(b - a).sum()), None
        if differs.any():
            # the factor is not defined between numbers of opposite sign: NaN counts as no change
            i = int(np.argmax(np.where(differs, np.abs(np.where(np.isnan(change), 0.0, change)), -1.0)))
            most = {**self.axis_values.iloc[i].to_dict(), "first": float(a[i]), "second": float(b[i])}
        return MetricChange(
            metric=self.metric,
            better=find_metric(self.metric).better,
            points=compared,
            only=self.only,
            changed=int(self.changed.sum()),
            differs=int(differs.sum()) if self.knows_noise else None,
            up=int((b > a)[differs].sum()),
            size=float((size if self.boolean else np.where(differs, size, 0.0)).sum() / max(compared, 1)),
            moved=self._mean_change(),
            where=_partial_ranges(self.axis_values, differs),
            most=most,
        )

    def _mean_change(self) -> MeanChange:
        """Mean change over the points at which all seeds have a number; its interval by the spread over seeds."""
        with _ignore_undefined():
            a, b = (values if self.boolean else np.log(values) for values in (self.first, self.second))
        complete = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
        if not complete.any():
            return MeanChange(math.nan, math.nan, math.nan)
        a, b = a[complete].mean(axis=0), b[complete].mean(axis=0)
        mean, variance, freedom = (float(statistic[0]) for statistic in _mean_differences(a[None], b[None], self.paired))
        half = float(stats.t.ppf(0.5 + 0.5 * _CONFIDENCE, freedom)) * math.sqrt(variance)
        ends = mean, mean - half, mean + half
        return MeanChange(*(float(end) if self.boolean else math.exp(end) for end in ends))


def _row_means(values: np.ndarray) -> np.ndarray:
    """Mean of the numbers of each row; NaN if there are none."""
    return pd.DataFrame(values).mean(axis=1).to_numpy()


def _row_statistics(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Count, mean and variance of the mean of the numbers of each row; the variance is NaN with fewer than two."""
    rows = pd.DataFrame(values)
    return rows.count(axis=1).to_numpy(), _row_means(values), rows.sem(axis=1).to_numpy() ** 2


def _mean_differences(first: np.ndarray, second: np.ndarray, paired: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Difference of the means of each row, its variance and its degrees of freedom, by pairs or else by Welch's formula."""
    if paired:
        count, mean, variance = _row_statistics(second - first)
        return mean, variance, count - 1.0
    (m, a, u), (n, b, v) = _row_statistics(first), _row_statistics(second)
    with _ignore_undefined():
        freedom = (u + v) ** 2 / (u**2 / (m - 1.0) + v**2 / (n - 1.0))
    # without any spread the formula is 0 / 0
    return b - a, u + v, np.where(u + v == 0.0, 1.0, freedom)


def _t_test(mean: np.ndarray, variance: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    """Two-sided p-values of means; NaN if the variance is not known."""
    with _ignore_undefined():
        t = np.abs(mean) / np.sqrt(variance)
    p = 2.0 * stats.t.sf(t, np.maximum(freedom, 1.0))
    return np.where(np.isfinite(variance), np.where(mean == 0.0, 1.0, p), np.nan)


def _select_significant(p: np.ndarray) -> np.ndarray:
    """True for significant p-values by Benjamini and Yekutieli's rule; False for NaN."""
    significant, finite = np.zeros(len(p), bool), np.isfinite(p)
    significant[finite] = stats.false_discovery_control(p[finite], method="by") <= FALSE_DISCOVERY_RATE
    return significant


def _partial_ranges(axis_values: pd.DataFrame, selected: np.ndarray) -> dict[str, list[Any]]:
    """Ranges of the selected points along the axes of which they do not cover the full range."""
    if not selected.any():
        return {}
    ranges = {path: _value_range(axis_values.loc[selected, path]) for path in axis_values}
    return {path: part for path, part in ranges.items() if part != _value_range(axis_values[path])}


def _value_range(column: pd.Series) -> list[Any]:
    """Least and largest number of a column, or all its words."""
    if pd.api.types.is_numeric_dtype(column):
        return [float(column.min()), float(column.max())]
    return sorted(map(str, column.unique()))
