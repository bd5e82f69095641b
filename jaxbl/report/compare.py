"""The comparison of two sweeps: which metrics changed, `comparison.json`, and a figure of where they moved most."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from jaxbl.config import Config, is_boolean
from jaxbl.files import write_atomic, write_json
from jaxbl.result import KeyFigure, Result, ResultTable
from jaxbl.sweeps.compare import FALSE_DISCOVERY_RATE, Comparison, MetricChange
from jaxbl.sweeps.metrics import find_metric

from .maps import axis_of, cell_edges, colour_scale, is_log, path_words, value_label
from .panels import (
    BLUE,
    COLOURS,
    MISSING,
    Array,
    Axis,
    Dots,
    Figure,
    Line,
    Map,
    Panel,
    Part,
    Scale,
    Span,
    intervals,
    name_rows,
)

_PANELS = 3
_ROWS = 12
_FEW = 0.05
"""Share of points up to which a map of where a metric changed would be empty."""
_EVEN = 1.1
"""Factor within which a change is the same everywhere: a map of it would have one colour."""


def write_comparison(comparison: Comparison, folder: Path) -> str:
    """Write `comparison.json`, the common points (`comparison.parquet`) and the first study. Returns the study's TOML."""
    tabulate_points(comparison).to_parquet(folder / "comparison.parquet")
    write_atomic(folder / "study.toml", comparison.first_config.to_toml())
    write_json(folder / "comparison.json", comparison.to_dict())
    return comparison.first_config.to_toml()


def tabulate_points(comparison: Comparison) -> pd.DataFrame:
    """The common points with each metric that changed: `first`, `second`, and the `factor` between them (of what is true or
    false, the difference of the shares)."""
    columns: dict[str, Any] = {}
    for change in comparison.metrics:
        if change.count:
            frame = comparison.frame(change.metric)
            columns |= {path: frame[path] for path in comparison.axes}
            numbers = frame[["first", "second"]].astype(float)
            numbers.insert(0, "factor", _divide(numbers, change.metric))
            columns |= {f"{change.metric}.{name}": column for name, column in numbers.items()}
    return pd.DataFrame(columns)


def describe_comparison(comparison: Comparison) -> Result:
    """Say which metrics changed by more than noise, whether for the better, and what changed in the config."""
    common, first, second = comparison.points
    names, beyond = comparison.names, _noise_name(comparison)
    # what says how well an observer does comes first
    changed = sorted(
        (change for change in comparison.metrics if change.count or change.is_sure), key=lambda change: not change.better
    )
    judged = [_split(change) for change in changed if change.better]
    better, worse = (sum(counts) for counts in zip(*judged, strict=True)) if judged else (0, 0)
    verdict, headline = "good", f"No metric differs by more than {beyond} at {common} common points."
    if not common:
        verdict, headline = "no answer", "No point is in both studies: no metric is compared."
    elif changed:
        verdict = "good" if better and not worse else "failed" if worse and not better else "doubtful"
        differ = f"{len(changed)} of {len(comparison.metrics)} metrics differ by more than {beyond}"
        headline = f"{differ}, {changed[0].metric} most."
    remarks = [
        f"{name} is not finished: {there} of {total} runs are compared."
        for name, (there, total) in comparison.unfinished.items()
    ]
    if not comparison.config:
        remarks.append("The configs differ in nothing that decides a number.")
    if comparison.made_by:
        changes = ", ".join(f"{key} {_value(old)} -> {_value(new)}" for key, (old, new) in comparison.made_by.items())
        remarks.append(f"Computed by: {changes}.")
    alone = f"; {first} in the first alone, {second} in the second alone" if first or second else ""
    remarks += [
        f"Points: {common} in both{alone}.",
        *([_noise(comparison)] if common else []),
        *(_most(comparison, change) for change in changed[:1] if change.most),
    ]
    for i, study in enumerate(names):
        gone = [f"{change.metric} ({change.only[i]} runs)" for change in comparison.metrics if change.only[i]]
        if gone:
            remarks.append(f"A number in {study} alone: {', '.join(gone)}.")
    same = [change.metric for change in comparison.metrics if change not in changed]
    details = [f"No difference beyond {beyond}: {', '.join(same)}."] if same else []
    figures = [KeyFigure(_factor(change), f"{change.metric}: {_ways(change)}") for change in changed[:4]]
    rows = [[key, _value(old), _value(new)] for key, (old, new) in comparison.config.items()]
    tables = [ResultTable("What differs in the config", ["key", *names], rows)] * bool(rows)
    if changed:
        head = ["metric", "points", "better", "worse", "factor from first to second (99 %)"]
        rows = [
            [change.metric, change.count, *(_split(change) if change.better else (None, None)), _factor(change)]
            for change in changed
        ]
        tables.append(ResultTable("Metrics that differ", head, rows))
    return Result(f"{names[0]} and {names[1]}", verdict, headline, figures, remarks, details, tables)


def _noise(comparison: Comparison) -> str:
    """Say how noise is known."""
    seeds = comparison.seeds
    if not comparison.knows_noise:
        common = "one common seed" if seeds == 1 else "no two seeds in common" if seeds == 0 else f"{seeds} common seeds"
        return (
            f"Noise: not known ({common}); points are counted that differ by more than rounding. With 4 or more seeds in "
            "both studies (sweep.seeds) it is known."
        )
    how = f"differences seed by seed, {seeds} seeds" if comparison.paired else "means over seeds, none of them in common"
    few = " So few seeds show only what is far beyond it." if comparison.paired and seeds < 4 else ""
    return (
        f"Noise: by {how}; of the points counted at most {100 * FALSE_DISCOVERY_RATE:g} % on average are not different.{few}"
    )


def _most(comparison: Comparison, change: MetricChange) -> str:
    """The largest change of a metric, and the point where it is."""
    assert change.most is not None
    place = ", ".join(f"{path} = {_value(change.most[path])}" for path in comparison.axes)
    ends = f"{change.most['first']:.3g} -> {change.most['second']:.3g} {find_metric(change.metric).unit}".rstrip()
    return f"Largest change of {change.metric}: {ends}{f' at {place}' if place else ''}."


def _ways(change: MetricChange) -> str:
    """At how many points a metric changed, and how."""
    better, worse = _split(change)
    ways = ("better", "worse") if change.better else ("larger", "smaller")
    return f"{ways[0]} at {better}, {ways[1]} at {worse} of {change.points} points"


def _split(change: MetricChange) -> tuple[int, int]:
    """At how many points a metric is better and worse, or larger and smaller where neither is better."""
    up, down = change.up, change.count - change.up
    return (down, up) if change.better and change.better != "more" else (up, down)


def _factor(change: MetricChange) -> str:
    """The mean change with its interval: a factor, or a difference of the share of runs."""
    ends = [end for end in change.moved if not math.isnan(end)]
    if is_boolean(change.metric):
        value, *interval = (f"{100 * end:+.2f} %" for end in ends)
    elif not math.isfinite(change.moved.value):
        return "–"
    else:
        value, *interval = (f"× {end:.3g}" for end in ends)
    return f"{value} ({' to '.join(interval)})" if interval else value


def _noise_name(comparison: Comparison) -> str:
    return "noise" if comparison.knows_noise else "rounding"


def _value(value: Any) -> str:
    if value is None:
        return "(none)"
    return f"{value:g}" if isinstance(value, float) else str(value)


def draw_comparison(comparison: Comparison) -> list[Figure]:
    """The factors of the metrics that changed, and maps over the last two axes of those whose change is not the same
    everywhere, or lines over one; nothing where none changed."""
    changes = sorted((change for change in comparison.metrics if change.count), key=lambda change: not change.better)
    if not changes:
        return []
    config, frames = comparison.first_config, {change.metric: comparison.frame(change.metric) for change in changes}
    figures = _factors(frames, {change.metric: change.moved.value for change in changes})
    frame = next(iter(frames.values()))
    varied = [path for path in comparison.axes if frame[path].nunique() > 1]
    # of axes that advance together one is enough
    labels = {path: path for path in varied} | {axis.path: axis.zip or axis.path for axis in config.axes}
    numbers = [path for path in varied if pd.api.types.is_numeric_dtype(frame[path])]
    axes = list({labels[path]: path for path in reversed(numbers)}.values())[1::-1]
    if not axes:
        return figures
    is_map, beyond = len(axes) > 1, _noise_name(comparison)
    drawn = {labels[path] for path in axes}
    words = [path_words(config, path) for path in axes]
    averaged = ", ".join(path_words(config, path) for path in varied if labels[path] not in drawn)
    averaged = f", median over {averaged}" if averaged else ""
    if is_map:
        uneven = [
            change
            for change in changes
            if change.count > _FEW * change.points and _spread(frames[change.metric], change.metric) > _EVEN
        ]
        panels = [_map(config, change, frames[change.metric], axes, beyond) for change in uneven[:_PANELS]]
        caption = (
            "Factor from the first study to the second (of what is true or false, difference of the share) over "
            f"{words[1]} and {words[0]}{averaged}; grey: at most half of the points differ by more than {beyond}."
        )
    else:
        panels = [_line(config, change.metric, frames[change.metric], axes[0]) for change in changes[:_PANELS]]
        caption = f"Both studies over {words[0]}{averaged}; where there are points, they differ by more than {beyond}."
    columns = len(panels)
    return figures + [Figure("comparison", panels, caption, columns, max(3.9 * columns, 5.0), 3.2)] * bool(panels)


def _change(frame: pd.DataFrame, metric: str) -> Any:
    """The factor at each point, NaN where there is none; of what is true or false the difference."""
    return _divide(frame, metric).replace([np.inf] if is_boolean(metric) else [np.inf, 0.0], np.nan)


def _divide(frame: pd.DataFrame, metric: str) -> Any:
    """The second number over the first; of what is true or false the second less the first."""
    first, second = frame["first"], frame["second"]
    with np.errstate(divide="ignore", invalid="ignore"):
        return second - first if is_boolean(metric) else second / first


def _spread(frame: pd.DataFrame, metric: str) -> float:
    """The factor between large and small changes of a metric; of what is true or false, infinitely many."""
    if is_boolean(metric):
        return math.inf
    low, high = _change(frame, metric).quantile([0.05, 0.95])
    return high / low


def _factors(frames: dict[str, pd.DataFrame], means: dict[str, float]) -> list[Figure]:
    """Mean and spread of the factor of each metric that has one."""
    rows = {
        value_label(metric): (change.quantile(0.05), means[metric], change.quantile(0.95))
        for metric, frame in list(frames.items())[:_ROWS]
        if not is_boolean(metric) and (change := _change(frame, metric)).gt(0.0).any()
    }
    if not rows:
        return []
    places = list(range(len(rows)))
    parts = [Span(1.0, 1.0, "no change", dashes="-"), *intervals(places, *zip(*rows.values(), strict=True), colour=BLUE)]
    caption = "Factor from the first study to the second: geometric mean of all points, and the range of nine in ten."
    x = Axis("factor from the first study to the second", log=True)
    return [Figure("factors", [Panel(x, name_rows(list(rows)), parts)], caption, height=0.9 + 0.3 * len(rows))]


def _map(config: Config, metric: MetricChange, frame: pd.DataFrame, axes: list[str], beyond: str) -> Panel:
    """Factors over two axes."""
    boolean = is_boolean(metric.metric)
    change = _change(frame, metric.metric)
    places = frame[axes].assign(change=change, differs=frame["differs"].astype(float)).groupby(axes, sort=True)
    table, share = places["change"].median(), places["differs"].mean()
    values = table.to_numpy(float)
    scale = _scale(values, boolean, "RdBu_r" if metric.better != "more" else "RdBu")
    y, x = (np.unique(frame[path].to_numpy(float)) for path in axes)
    drawn = [
        axis_of(config, path, numbers, _is_drawn_log(config, path, numbers))
        for path, numbers in zip(axes[::-1], (x, y), strict=True)
    ]
    name = f"within {beyond}"
    if 2 * len(table) > len(x) * len(y):
        across, up = (cell_edges(numbers, axis.log) for numbers, axis in zip((x, y), drawn, strict=True))
        same = share.unstack().fillna(1.0).to_numpy(float) <= 0.5
        parts: list[Part] = [Map(across, up, table.unstack().to_numpy(float), scale, same, name)]
    else:
        # points of a design, or of a refined study
        points, far = table.reset_index(), share.to_numpy() > 0.5
        near, differing = points[~far], points[far]
        parts = [
            Line(near[axes[1]], near[axes[0]], name, MISSING, 0.0, marker=".", size=3.0),
            Dots(differing[axes[1]], differing[axes[0]], values[far], scale),
        ]
    return Panel(*drawn, parts, metric.metric)


def _scale(values: Array, boolean: bool, colours: str) -> Scale:
    """Colours about no change."""
    finite = values[np.isfinite(values)]
    if boolean:
        most = max(float(np.abs(finite).max(initial=0.0)), 1e-3)
        return Scale(-most, most, "difference of the share", colours=colours)
    # a few extremes would leave no colour for all else
    sizes = np.abs(np.log(finite[finite > 0.0])) if finite.size else np.zeros(1)
    most = max(math.exp(min(float(np.quantile(sizes, 0.98)), 100.0)), 1.0 + 1e-6)
    return Scale(1.0 / most, most, "factor", True, colours)


def _line(config: Config, metric: str, frame: pd.DataFrame, path: str) -> Panel:
    """Both studies over one axis."""
    groups = frame.groupby(path, sort=True)
    medians, far = groups[["first", "second"]].median(), groups["differs"].any().to_numpy(bool)
    x, parts = medians.index.to_numpy(float), list[Part]()
    for name, colour in zip(medians, COLOURS, strict=False):
        values = medians[name].to_numpy(float)
        parts += [Line(x, values, name, colour), Line(x[far], values[far], colour=colour, width=0.0, marker="o", size=4.0)]
    scale = colour_scale(medians.to_numpy(float), value_label(metric))
    return Panel(axis_of(config, path, x, _is_drawn_log(config, path, x)), Axis(scale.label, metric, scale.log), parts)


def _is_drawn_log(config: Config, path: str, values: Array) -> bool:
    return any(axis.path == path for axis in config.axes) and is_log(config, path, values)
