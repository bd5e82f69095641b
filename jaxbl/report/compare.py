"""The comparison of two sweeps: which metrics changed and by what factor, and `comparison.json`."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from jaxbl.config import is_boolean
from jaxbl.files import write_atomic
from jaxbl.result import KeyFigure, Result, ResultTable
from jaxbl.sweeps.compare import FALSE_DISCOVERY_RATE, Comparison, MetricChange

from .maps import value_label, value_text
from .panels import BLUE, Axis, Figure, Panel, Span, intervals, name_rows

_ROWS = 12
"""Metrics of the figure."""


def write(comparison: Comparison, folder: Path) -> str:
    """Write the common points (`comparison.parquet`) and the first study. Returns the study's TOML."""
    tabulate_points(comparison).to_parquet(folder / "comparison.parquet")
    study = comparison.first_config.to_toml()
    write_atomic(folder / "study.toml", study)
    return study


def tabulate_points(comparison: Comparison) -> pd.DataFrame:
    """The common points with each metric that changed: `first`, `second`, and the `factor` between them (of what is true or
    false, the difference of the shares)."""
    columns = {}
    for change in comparison.metrics:
        if change.count:
            frame = comparison.frame(change.metric)
            numbers = frame[["first", "second"]].astype(float)
            numbers.insert(0, "factor", _divide(numbers, change.metric))
            columns |= {**frame[[*comparison.axes]], **numbers.add_prefix(f"{change.metric}.")}
    return pd.DataFrame(columns)


def describe(comparison: Comparison) -> Result:
    """Say which metrics changed by more than noise, whether for the better, and what changed in the config."""
    common, first, second = comparison.points
    names, beyond = comparison.names, "noise" if comparison.knows_noise else "rounding"
    # what says how well an observer does comes first
    changed = sorted(
        (change for change in comparison.metrics if change.count or change.is_sure), key=lambda change: not change.better
    )
    better, worse = (sum(_split(change)[i] for change in changed if change.better) for i in range(2))
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
    changes = ", ".join(f"{key} {value_text(old)} -> {value_text(new)}" for key, (old, new) in comparison.made_by.items())
    alone = f"; {first} in the first alone, {second} in the second alone" if first or second else ""
    remarks += [
        "" if comparison.config else "The configs differ in nothing that decides a number.",
        changes and f"Computed by: {changes}.",
        f"Points: {common} in both{alone}.",
        _noise(comparison) if common else "",
    ]
    for i, study in enumerate(names):
        gone = ", ".join(f"{change.metric} ({change.only[i]} runs)" for change in comparison.metrics if change.only[i])
        remarks.append(gone and f"A number in {study} alone: {gone}.")
    figures = [KeyFigure(_factor(change), f"{change.metric}: {_ways(change)}") for change in changed[:4]]
    rows = [[key, *map(value_text, values)] for key, values in comparison.config.items()]
    tables = [ResultTable("What differs in the config", ["key", *names], rows)] * bool(rows)
    if changed:
        head = ["metric", "points", "better", "worse", "factor from first to second (99 %)"]
        rows = [
            [change.metric, change.count, *(_split(change) if change.better else (None, None)), _factor(change)]
            for change in changed
        ]
        tables.append(ResultTable("Metrics that differ", head, rows))
    return Result(f"{names[0]} and {names[1]}", verdict, headline, figures, [*filter(None, remarks)], tables=tables)


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
    return f"Noise: by {how}. At most {100 * FALSE_DISCOVERY_RATE:g} % of the points said to differ do so by chance.{few}"


def _ways(change: MetricChange) -> str:
    """At how many points a metric changed, and how."""
    better, worse = _split(change)
    ways = ("better", "worse") if change.better else ("larger", "smaller")
    return f"{ways[0]} at {better}, {ways[1]} at {worse} of {change.points} points"


def _split(change: MetricChange) -> tuple[int, int]:
    """At how many points a metric is better and worse, or larger and smaller where neither is better."""
    up, down = change.up, change.count - change.up
    return (down, up) if change.better == "less" else (up, down)


def _factor(change: MetricChange) -> str:
    """The mean change with its interval: a factor, or a difference of the share of runs."""
    ends = [end for end in change.moved if not math.isnan(end)]
    if not math.isfinite(change.moved.value):
        return "–"
    value, *interval = (f"{100 * end:+.2f} %" if is_boolean(change.metric) else f"× {end:.3g}" for end in ends)
    return f"{value} ({' to '.join(interval)})" if interval else value


def draw(comparison: Comparison) -> Iterator[Figure]:
    """Mean and spread of the factor of each metric that changed and has one; nothing where there is none."""
    rows = {}
    for change in sorted(comparison.metrics, key=lambda change: not change.better):
        if not change.count or is_boolean(change.metric):
            continue
        factor = _divide(comparison.frame(change.metric), change.metric).replace([np.inf, 0.0], np.nan)
        if factor.gt(0.0).any():
            rows[value_label(change.metric)] = factor.quantile(0.05), change.moved.value, factor.quantile(0.95)
    if not rows:
        return
    factors = pd.DataFrame(rows).iloc[:, :_ROWS]
    names = [*factors]
    parts = [Span(1.0, 1.0, "no change", dashes="-"), *intervals(range(len(names)), *factors.to_numpy(), colour=BLUE)]
    caption = "Factor from the first study to the second: geometric mean of all points, and the range of nine in ten."
    x = Axis("factor from the first study to the second", log=True)
    yield Figure("factors", [Panel(x, name_rows(names), parts)], caption, height=0.9 + 0.3 * len(names))


def _divide(frame: pd.DataFrame, metric: str) -> Any:
    """The second number over the first; of what is true or false the second less the first."""
    first, second = frame["first"], frame["second"]
    return second - first if is_boolean(metric) else second / first
