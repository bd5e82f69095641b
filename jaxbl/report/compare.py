"""The comparison of two sweeps: which metrics changed, `comparison.json`, and a figure of where they moved most."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.colors import LogNorm, Normalize

from jaxbl.config import Config, is_boolean
from jaxbl.files import write_json
from jaxbl.result import KeyFigure, Result, ResultTable
from jaxbl.sweeps.compare import FALSE_DISCOVERY_RATE, Comparison, MetricChange
from jaxbl.sweeps.metrics import find_metric

from .figures import COLOURS, MISSING, Axes, Drawn, Figure, Patch, colour_bar, legend_below, style, subplots, with_unit
from .maps import axis_label, color_norm, hatch_failures, is_log, set_up_map

_PANELS = 3


def write_comparison(comparison: Comparison, folder: Path) -> str:
    """Write `comparison.json`. Returns the first study's TOML."""
    write_json(folder / "comparison.json", comparison.to_dict())
    return comparison.first_config.to_toml()


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


@style()
def draw_comparison(comparison: Comparison) -> list[Drawn]:
    """Show where the metrics that changed most did so: a map over the last two axes, or lines over one; nothing where none
    did, or no axis has several numbers."""
    changes = sorted((change for change in comparison.metrics if change.count), key=lambda change: not change.better)
    changes = changes[:_PANELS]
    if not changes:
        return []
    config, frames = comparison.first_config, [comparison.frame(change.metric) for change in changes]
    varied = [path for path in comparison.axes if frames[0][path].nunique() > 1]
    # of axes that advance together one is enough
    labels = {path: path for path in varied} | {axis.path: axis.zip or axis.path for axis in config.axes}
    numbers = [path for path in varied if pd.api.types.is_numeric_dtype(frames[0][path])]
    axes = list({labels[path]: path for path in reversed(numbers)}.values())[1::-1]
    if not axes:
        return []
    is_map = len(axes) > 1
    size = (4.4 * len(changes), 3.8) if is_map else (4.2 * len(changes), 3.4)
    figure, panels = subplots(*size, columns=len(changes), beside=True)
    for ax, change, frame in zip(panels, changes, frames, strict=True):
        if is_map:
            _map(figure, ax, config, change, frame, axes)
        else:
            _line(ax, config, frame, axes[0])
        ax.set_title(with_unit(change.metric, "" if is_map else find_metric(change.metric).unit))
    beyond = _noise_name(comparison)
    drawn = {labels[path] for path in axes}
    averaged = ", ".join(path for path in varied if labels[path] not in drawn)
    averaged = f", median over {averaged}" if averaged else ""
    if is_map:
        legend_below(figure, [Patch(facecolor="white", edgecolor="black", hatch="//", label=f"within {beyond}")], 1)
        caption = (
            "Factor from the first study to the second (of what is true or false, difference of the share) over "
            f"{axes[1]} and {axes[0]}{averaged}; hatched: at most half of the points differ by more than {beyond}."
        )
    else:
        panels[-1].legend()
        caption = f"Both studies over {axes[0]}{averaged}; where there are points, they differ by more than {beyond}."
    return [Drawn("comparison", figure, caption)]


def _map(figure: Figure, ax: Axes, config: Config, metric: MetricChange, frame: pd.DataFrame, axes: list[str]) -> None:
    """Factors over two axes."""
    y, x = axes
    boolean = is_boolean(metric.metric)
    with np.errstate(divide="ignore", invalid="ignore"):
        change = frame["second"] - frame["first"] if boolean else frame["second"] / frame["first"]
    change = change.replace([np.inf] if boolean else [np.inf, 0.0], np.nan)
    places = frame[axes].assign(change=change, differs=frame["differs"].astype(float)).groupby(axes, sort=True)
    table, share = places["change"].median(), places["differs"].mean()
    values = table.to_numpy(float)
    norm, colours = _norm(values, boolean), "RdBu_r" if metric.better != "more" else "RdBu"
    centres = [np.unique(frame[path].to_numpy(float)) for path in (x, y)]
    logs = [_is_drawn_log(config, *axis) for axis in zip((x, y), centres, strict=True)]
    cells = set_up_map(ax, centres, logs)
    if 2 * len(table) > len(centres[0]) * len(centres[1]):
        ax.pcolormesh(*cells.edges, table.unstack().to_numpy(float), cmap=colours, norm=norm, rasterized=True)
        hatch_failures(ax, cells, share.unstack().fillna(1.0).to_numpy(float), "", colour="black")
    else:
        # points of a design, or of a refined study
        points, far = table.reset_index(), share.to_numpy() > 0.5
        ax.plot(points.loc[~far, x], points.loc[~far, y], ".", ms=3, color=MISSING)
        ax.scatter(points.loc[far, x], points.loc[far, y], c=values[far], cmap=colours, norm=norm, s=14)
    ax.set(xlabel=axis_label(config, x), ylabel=axis_label(config, y))
    colour_bar(figure, ax, norm, colours=colours)


def _norm(values: np.ndarray, boolean: bool) -> Normalize:
    """Colours about no change."""
    finite = values[np.isfinite(values)]
    if boolean:
        most = max(float(np.abs(finite).max(initial=0.0)), 1e-3)
        return Normalize(-most, most)
    most = max(math.exp(min(float(np.abs(np.log(finite)).max(initial=0.0)), 100.0)), 1.0 + 1e-6)
    return LogNorm(1.0 / most, most)


def _line(ax: Axes, config: Config, frame: pd.DataFrame, path: str) -> None:
    """Both studies over one axis."""
    groups = frame.groupby(path, sort=True)
    medians = groups[["first", "second"]].median()
    x = medians.index.to_numpy(float)
    far = groups["differs"].any().to_numpy(bool)
    for name, colour in zip(medians, COLOURS, strict=False):
        ax.plot(x, medians[name], "-", color=colour, label=name)
        ax.plot(x[far], medians.loc[far, name], "o", ms=4, color=colour)
    ax.set(xlabel=axis_label(config, path))
    if _is_drawn_log(config, path, x):
        ax.set_xscale("log")
    if isinstance(color_norm(medians.to_numpy(float), "auto"), LogNorm):
        ax.set_yscale("log")


def _is_drawn_log(config: Config, path: str, values: np.ndarray) -> bool:
    return any(axis.path == path for axis in config.axes) and is_log(config, path, values)
