"""What `jaxbl compare` leaves: a text of 80 columns, `comparison.json`, and a figure of where metrics moved most."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false
# pyright: reportAssignmentType=false

import math
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from jaxbl.config import Config, is_boolean
from jaxbl.files import json_with_checksum, write_atomic
from jaxbl.lines import TERMINAL_WIDTH, Lines, format_table
from jaxbl.sweeps.compare import FALSE_DISCOVERY_RATE, Comparison, MetricChange
from jaxbl.sweeps.metrics import find_metric

from .figures import COLOURS, MISSING, Drawn, style, subplots, with_unit
from .maps import axis_label, cell_edges, fit_axes, hatch_failures, is_log
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
    return [*comparison_lines(comparison), *(_wrapped(f"{path}: {caption}", "  ") for path, caption in saved)]


def comparison_lines(comparison: Comparison) -> Lines:
    """The comparison as text, no line over 80 columns but for what is longer in itself."""
    both, first, second = comparison.points
    lines = [f"first:  {comparison.names[0]}", f"second: {comparison.names[1]}"]
    lines += [
        _wrapped(f"{name} is not finished: {there} of {total} runs are compared.", "")
        for name, (there, total) in comparison.unfinished.items()
    ]
    lines += ["", "Config:" if comparison.config else "Config: no difference that decides a number."]
    lines += _listed([f"{key}: {_value(old)} -> {_value(new)}" for key, (old, new) in comparison.config.items()])
    if comparison.made_by:
        made = ", ".join(f"{key} {_value(old)} -> {_value(new)}" for key, (old, new) in comparison.made_by.items())
        lines.append(_wrapped(f"Computed by: {made}", ""))
    alone = f"; {first} in the first alone, {second} in the second alone" if first or second else ""
    lines += ["", f"Points: {both} in both{alone}."]
    if not both:
        return [*lines, "No point is in both: no metric is compared."]
    lines.append(_wrapped(_noise(comparison), ""))
    return [*lines, *_metric_lines(comparison)]


def _noise(comparison: Comparison) -> str:
    """How noise is known."""
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
    """What became of the metrics, those that changed most first."""
    counted = [one for one in comparison.metrics if one.count or one.is_sure]
    lines = []
    for one in (change for change in counted if is_boolean(change.metric)):
        unsure = "" if math.isnan(one.moved.low) else f" ({_share(one.moved.low)} to {_share(one.moved.high)})"
        lines.append(
            _wrapped(
                f"{one.metric}: {_share(one.moved.value)} of the runs{unsure}; {one.up} points gained, "
                f"{one.count - one.up} lost (of {one.points}).",
                "  ",
            )
        )
    # what says how well an observer does comes first
    numbers = sorted((one for one in counted if not is_boolean(one.metric)), key=lambda one: not one.better)
    if numbers and numbers[0].most is not None:
        lines += ["", *_changed_most(comparison, numbers[0])]
    if numbers:
        head = "metric", "points", "better", "worse", "factor (99 %)"
        lines += ["", *format_table([head, *map(_row, numbers[: 2 * _LISTED])])]
        if len(numbers) > 2 * _LISTED:
            lines.append(f"and {len(numbers) - 2 * _LISTED} more, in comparison.json")
    for i, side in enumerate(comparison.names):
        gone = [f"{one.metric} ({one.only[i]} runs)" for one in comparison.metrics if one.only[i]]
        if gone:
            lines.append(_wrapped(f"A number in {side} alone: {', '.join(gone)}.", ""))
    same = [one.metric for one in comparison.metrics if one not in counted]
    if same:
        beyond = "noise" if comparison.knows_noise else "rounding"
        what = f"No difference beyond {beyond} in {len(same)} of {len(comparison.metrics)} metrics"
        names = f": {', '.join(same)}" if len(same) <= _LISTED else ""
        lines += ["", _wrapped(f"{what}{names}.", "")]
    return lines


def _changed_most(comparison: Comparison, one: MetricChange) -> Lines:
    """The metric that changed most, and where."""
    assert one.most is not None
    place = {path: one.most[path] for path in comparison.axes}
    at = ", ".join(f"{path} = {_value(value)}" for path, value in place.items())
    beyond = "rounding" if one.differs is None else "noise"
    unit = find_metric(one.metric).unit
    lines = [
        _wrapped(
            f"Changed most: {one.metric}, beyond {beyond} at {one.count} of {one.points} points"
            f"{_direction(one)}. Largest change: {one.most['first']:.3g} -> {one.most['second']:.3g} {unit}".rstrip()
            + (f", at {at}." if at else "."),
            "  ",
        )
    ]
    spans = [
        f"{path} {_value(span[0])} to {_value(span[1])}" if isinstance(span[0], float) else f"{path} {', '.join(span)}"
        for path, span in one.where.items()
    ]
    return [*lines, _wrapped(f"These points lie at {', '.join(spans)}.", "  ")] if spans else lines


def _direction(one: MetricChange) -> str:
    up, down = one.up, one.count - one.up
    if not one.better:
        return f", larger at {up}, smaller at {down}"
    better, worse = (up, down) if one.better == "more" else (down, up)
    return f", better at {better}, worse at {worse}"


def _row(one: MetricChange) -> tuple[str, ...]:
    up, down = one.up, one.count - one.up
    better, worse = ("–", "–") if not one.better else (up, down) if one.better == "more" else (down, up)
    factor = f"{one.moved.value:.3g}" if math.isfinite(one.moved.value) else "–"
    if not math.isnan(one.moved.low):
        factor += f" ({one.moved.low:.3g} to {one.moved.high:.3g})"
    # numbers end below one another, factors begin so
    return one.metric, f"{one.count:>6}", f"{better:>6}", f"{worse:>5}", factor


def _share(value: float) -> str:
    return f"{100 * value:+.2f} %"


def _value(value: Any) -> str:
    if value is None:
        return "(none)"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _listed(items: list[str]) -> Lines:
    """Some items, one a line."""
    lines = [_wrapped(f"  {item}", "    ") for item in items[:_LISTED]]
    return [*lines, f"  and {len(items) - _LISTED} more, in comparison.json"] if len(items) > _LISTED else lines


def _wrapped(text: str, indent: str) -> str:
    wrapped = textwrap.wrap(text, TERMINAL_WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
    return "\n".join(wrapped)


@style()
def draw_comparison(comparison: Comparison, config: Config) -> list[Drawn]:
    """Where the metrics that changed most did so: a map over the last two axes, or lines over one; nothing where none did,
    or no axis has several numbers."""
    shown = sorted((one for one in comparison.metrics if one.count), key=lambda one: not one.better)[:_PANELS]
    if not shown:
        return []
    frames = [comparison.frame(one.metric) for one in shown]
    values = {path: frames[0][path] for path in comparison.axes}
    axes = [path for path, one in values.items() if pd.api.types.is_numeric_dtype(one) and len(one.unique()) > 1]
    # of axes that advance together one is enough
    labels = {axis.path: axis.zip or axis.path for axis in config.axes}
    axes = list({labels.get(path, path): path for path in reversed(axes)}.values())[::-1]
    if not axes:
        return []
    size = (4.4 * len(shown), 3.8) if len(axes) > 1 else (4.2 * len(shown), 3.4)
    figure, panels = subplots(*size, columns=len(shown), beside=True)
    for ax, one, frame in zip(panels, shown, frames, strict=True):
        if len(axes) > 1:
            _map(figure, ax, config, one, frame, axes[-2:])
        else:
            _line(ax, config, frame, axes[0])
        ax.set_title(with_unit(one.metric, "" if len(axes) > 1 else find_metric(one.metric).unit))
    beyond = "noise" if comparison.knows_noise else "rounding"
    drawn = {labels.get(path, path) for path in axes[-2:]}
    others = ", ".join(path for path, one in values.items() if labels.get(path, path) not in drawn and len(one.unique()) > 1)
    others = f", median over {others}" if others else ""
    if len(axes) > 1:
        names = [Patch(facecolor="white", edgecolor="black", hatch="//", label=f"within {beyond}")]
        figure.legend(handles=names, loc="outside lower center")
        what = "Factor from the first study to the second (of what is true or false, difference of the share)"
        hatched = f"hatched: at most half of the points differ by more than {beyond}"
        caption = f"{what} over {axes[-1]} and {axes[-2]}{others}; {hatched}."
    else:
        panels[-1].legend()
        caption = f"Both studies over {axes[0]}{others}; where there are points, they differ by more than {beyond}."
    return [Drawn(_FIGURE, figure, caption)]


def _map(figure: Figure, ax: Axes, config: Config, one: MetricChange, frame: pd.DataFrame, over: list[str]) -> None:
    """Factors over two axes."""
    boolean = is_boolean(one.metric)
    with np.errstate(divide="ignore", invalid="ignore"):
        change = frame["second"] - frame["first"] if boolean else frame["second"] / frame["first"]
    change = change.replace([np.inf, 0.0] if not boolean else [np.inf], np.nan)
    y, x = over
    places = frame[over].assign(change=change, differs=frame["differs"].astype(float)).groupby(over, sort=True)
    table, share = places["change"].median(), places["differs"].mean()
    norm, colours = _norm(table.to_numpy(float), boolean), "RdBu_r" if one.better != "more" else "RdBu"
    xs, ys = (np.unique(frame[path].to_numpy(float)) for path in (x, y))
    logs = [_drawn_log(config, path, values) for path, values in ((x, xs), (y, ys))]
    edges = cell_edges(xs, logs[0]), cell_edges(ys, logs[1])
    ax.grid(False)
    ax.set(xscale="log" if logs[0] else "linear", yscale="log" if logs[1] else "linear")
    if 2 * len(table) > len(xs) * len(ys):
        ax.pcolormesh(*edges, table.unstack().to_numpy(float), cmap=colours, norm=norm, rasterized=True)
        hatch_failures(ax, (xs, ys), edges, share.unstack().fillna(1.0).to_numpy(float), "", colour="black")
    else:
        # points of a design, or of a refined study
        at = table.index.to_frame(index=False)
        far = share.to_numpy() > 0.5
        ax.plot(at.loc[~far, x], at.loc[~far, y], ".", ms=3, color=MISSING)
        ax.scatter(at.loc[far, x], at.loc[far, y], c=table.to_numpy(float)[far], cmap=colours, norm=norm, s=14)
    ax.set(xlabel=axis_label(config, x), ylabel=axis_label(config, y))
    fit_axes(ax, edges)
    figure.colorbar(ScalarMappable(norm, colours), ax=ax, pad=0.02, aspect=28)


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
    frame = groups[["first", "second"]].median()
    x = frame.index.to_numpy(float)
    far = groups["differs"].any().to_numpy(bool)
    for i, name in enumerate(("first", "second")):
        ax.plot(x, frame[name], "-", color=COLOURS[i], label=name)
        ax.plot(x[far], frame.loc[far, name], "o", ms=4, color=COLOURS[i])
    ax.set(xlabel=axis_label(config, path))
    if _drawn_log(config, path, x):
        ax.set_xscale("log")
    drawn = frame[["first", "second"]].to_numpy(float)
    drawn = drawn[np.isfinite(drawn)]
    if len(drawn) and drawn.min() > 0.0 and drawn.max() / drawn.min() > 30.0:
        ax.set_yscale("log")


def _drawn_log(config: Config, path: str, values: np.ndarray) -> bool:
    return any(axis.path == path for axis in config.axes) and is_log(config, path, values)
