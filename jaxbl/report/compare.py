"""What `jaxbl compare` leaves: a text of 80 columns, `comparison.json`, and a figure of where metrics moved most."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false

import math
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.colors import LogNorm, Normalize

from jaxbl.config import Config, is_boolean
from jaxbl.files import json_with_checksum, write_atomic
from jaxbl.lines import TERMINAL_WIDTH, Lines, format_table
from jaxbl.sweeps.compare import FALSE_DISCOVERY_RATE, Comparison, MetricChange
from jaxbl.sweeps.metrics import find_metric

from .figures import COLOURS, MISSING, Axes, Drawn, Figure, Patch, colour_bar, legend_below, style, subplots, with_unit
from .maps import axis_label, color_norm, hatch_failures, is_log, set_up_map
from .page import save_all

_FIGURE = "comparison"
_PANELS = 3
_LISTED = 12
"""Rows of a list in the text; `comparison.json` has all."""


def write_comparison(comparison: Comparison, config: Config, folder: Path) -> Lines:
    """Write `comparison.json` and a figure into a folder that exists; `config` is the first study's.

    Returns the lines for the terminal.
    """
    # of an earlier comparison
    (folder / "figures" / f"{_FIGURE}.png").unlink(missing_ok=True)
    saved = save_all(draw_comparison(comparison, config), folder)
    write_atomic(folder / "comparison.json", json_with_checksum(comparison.to_dict()))
    return [*comparison_lines(comparison), *(_wrap(f"{path}: {caption}", "  ") for path, caption in saved)]


def comparison_lines(comparison: Comparison) -> Lines:
    """The comparison as text, no line over 80 columns but for what is longer in itself."""
    common, first, second = comparison.points
    lines = [f"first:  {comparison.names[0]}", f"second: {comparison.names[1]}"]
    lines += [
        _wrap(f"{name} is not finished: {there} of {total} runs are compared.")
        for name, (there, total) in comparison.unfinished.items()
    ]
    lines += ["", "Config:" if comparison.config else "Config: no difference that decides a number."]
    changes = [f"  {key}: {_value(old)} -> {_value(new)}" for key, (old, new) in comparison.config.items()]
    lines += [_wrap(change, "    ") for change in changes[:_LISTED]]
    if len(changes) > _LISTED:
        lines.append(f"  and {len(changes) - _LISTED} more, in comparison.json")
    if comparison.made_by:
        changes_ = ", ".join(f"{key} {_value(old)} -> {_value(new)}" for key, (old, new) in comparison.made_by.items())
        lines.append(_wrap(f"Computed by: {changes_}"))
    alone = f"; {first} in the first alone, {second} in the second alone" if first or second else ""
    lines += ["", f"Points: {common} in both{alone}."]
    if not common:
        return [*lines, "No point is in both: no metric is compared."]
    return [*lines, _wrap(_noise(comparison)), *_metric_lines(comparison)]


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


def _metric_lines(comparison: Comparison) -> Lines:
    """Say what became of the metrics, those that changed most first."""
    changed = [change for change in comparison.metrics if change.count or change.is_sure]
    lines, numbers = [], []
    for change in changed:
        moved = change.moved
        if not is_boolean(change.metric):
            numbers.append(change)
            continue
        unsure = "" if math.isnan(moved.low) else f" ({_share(moved.low)} to {_share(moved.high)})"
        line = f"{change.metric}: {_share(moved.value)} of the runs{unsure}; {change.up} points gained, "
        lines.append(_wrap(f"{line}{change.count - change.up} lost (of {change.points}).", "  "))
    # what says how well an observer does comes first
    numbers.sort(key=lambda change: not change.better)
    if numbers and numbers[0].most is not None:
        lines += ["", *_changed_most(comparison, numbers[0])]
    if numbers:
        head = "metric", "points", "better", "worse", "factor (99 %)"
        lines += ["", *format_table([head, *map(_row, numbers[: 2 * _LISTED])])]
        if len(numbers) > 2 * _LISTED:
            lines.append(f"and {len(numbers) - 2 * _LISTED} more, in comparison.json")
    for i, study in enumerate(comparison.names):
        gone = [f"{change.metric} ({change.only[i]} runs)" for change in comparison.metrics if change.only[i]]
        if gone:
            lines.append(_wrap(f"A number in {study} alone: {', '.join(gone)}."))
    same = [change.metric for change in comparison.metrics if change not in changed]
    if same:
        line = f"No difference beyond {_noise_name(comparison)} in {len(same)} of {len(comparison.metrics)} metrics"
        names = f": {', '.join(same)}" if len(same) <= _LISTED else ""
        lines += ["", _wrap(f"{line}{names}.")]
    return lines


def _changed_most(comparison: Comparison, change: MetricChange) -> Lines:
    """The metric that changed most, and where."""
    assert change.most is not None
    place = ", ".join(f"{path} = {_value(change.most[path])}" for path in comparison.axes)
    beyond = "rounding" if change.differs is None else "noise"
    better, worse = _split(change)
    way = f"better at {better}, worse at {worse}" if change.better else f"larger at {better}, smaller at {worse}"
    unit = find_metric(change.metric).unit
    line = (
        f"Changed most: {change.metric}, beyond {beyond} at {change.count} of {change.points} points, "
        f"{way}. Largest change: {change.most['first']:.3g} -> {change.most['second']:.3g} {unit}"
    ).rstrip()
    lines = [_wrap(f"{line}, at {place}." if place else f"{line}.", "  ")]
    spans = [
        f"{path} {_value(span[0])} to {_value(span[1])}" if isinstance(span[0], float) else f"{path} {', '.join(span)}"
        for path, span in change.where.items()
    ]
    return [*lines, _wrap(f"These points lie at {', '.join(spans)}.", "  ")] if spans else lines


def _split(change: MetricChange) -> tuple[int, int]:
    """At how many points a metric is better and worse, or larger and smaller where neither is better."""
    up, down = change.up, change.count - change.up
    return (down, up) if change.better and change.better != "more" else (up, down)


def _row(change: MetricChange) -> tuple[str, ...]:
    better, worse = _split(change) if change.better else ("–", "–")
    moved = change.moved
    factor = f"{moved.value:.3g}" if math.isfinite(moved.value) else "–"
    if not math.isnan(moved.low):
        factor += f" ({moved.low:.3g} to {moved.high:.3g})"
    # numbers end below one another, factors begin so
    return change.metric, f"{change.count:>6}", f"{better:>6}", f"{worse:>5}", factor


def _noise_name(comparison: Comparison) -> str:
    return "noise" if comparison.knows_noise else "rounding"


def _share(value: float) -> str:
    return f"{100 * value:+.2f} %"


def _value(value: Any) -> str:
    if value is None:
        return "(none)"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _wrap(text: str, indent: str = "") -> str:
    return textwrap.fill(text, TERMINAL_WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)


@style()
def draw_comparison(comparison: Comparison, config: Config) -> list[Drawn]:
    """Show where the metrics that changed most did so: a map over the last two axes, or lines over one; nothing where none
    did, or no axis has several numbers."""
    changes = sorted((change for change in comparison.metrics if change.count), key=lambda change: not change.better)
    changes = changes[:_PANELS]
    if not changes:
        return []
    frames = [comparison.frame(change.metric) for change in changes]
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
    return [Drawn(_FIGURE, figure, caption)]


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
