"""Figures of a sweep: heatmaps with gain conditions over them, and lines over one axis."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false
# pyright: reportReturnType=false, reportAssignmentType=false

import re
import textwrap
from collections.abc import Container, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import matplotlib.patheffects as path_effects
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from jaxbl.config import Config, FigureTable, is_boolean, numeric_paths
from jaxbl.config.figures import filter_rows, resolve_where
from jaxbl.gains.accuracy_laws import Law, accuracy_laws
from jaxbl.gains.best_gains import AS_GOOD, BestGains, find_best_gains
from jaxbl.observer.conditions import CONDITIONS, Condition
from jaxbl.sweeps.elementwise import apply_elementwise
from jaxbl.sweeps.metrics import find_metric, is_magnitude
from jaxbl.sweeps.points import Points
from jaxbl.sweeps.sweep import StudyResult

from .aggregates import Column, Groups, Rows
from .checks import MOST_PARTS, check_figures, values_of
from .figures import COLOURS, MAP, MARKERS, MISSING, SIDES, Drawn, style, subplots, with_unit
from .refined_maps import Filling, on_coarse_values

_HATCH = (1.0, 1.0, 1.0, 0.45)
"""White that lets the colour beneath be read."""

_MOST_DOTS = 100_000

_CURVES = {
    "davila_fridman": ("-", "#FF5FA2"),
    "levant": ("-.", "#FF9E4A"),
    "seeber_horn": ("--", "#7FDBFF"),
    "moreno_osorio": ((0, (5, 1, 1, 1)), "#B6F09C"),
    "exact": (":", "#FFD400"),
}
"""Dashes and colour of each gain condition's curve."""


def default_figures(config: Config, columns: list[str]) -> list[FigureTable]:
    """Figures for a study that asks for none: a heatmap over its last two axes, or lines over its one, of the motor's
    velocity error, or else of the first metric among its columns."""
    varying = [
        axis.path
        for axis in config.axes
        if axis.values is None or (len(axis.values) > 1 and not any(isinstance(v, str) for v in axis.values))
    ]
    if not varying:
        return []
    value = "motor.velocity_rmse"
    if value not in columns:
        value = next(name for name in columns if name.startswith("motor."))
    if len(varying) == 1:
        return [FigureTable(kind="line", x=varying[0], value=value)]
    few = [axis.path for axis in config.axes if values_of(config, axis) <= MOST_PARTS]
    facet = varying[-3] if varying[-3:-2] and varying[-3] in few else None
    return [FigureTable(kind="heatmap", x=varying[-1], y=varying[-2], value=value, facet=facet)]


def draw(result: StudyResult, laws: list[Law] | None = None) -> list[Drawn]:
    """All figures of a study, in memory that does not grow with its number of runs (of a refined study, with its points).

    Args:
        result: the study.
        laws: those of its figures, where they are known already.

    Raises:
        InputError: a figure names an axis or a metric that the study does not have.
    """
    config = result.config
    figures = config.figures or default_figures(config, result.columns)
    check_figures(config, figures, result.columns)
    points = Points(config) if config.sweep.refine is not None else None
    drawn: list[Drawn] = []
    laws = accuracy_laws(result, figures) if laws is None else laws
    runs = None
    for i, figure in enumerate(figures):
        if figure.theory is not None:
            drawing = _laws(config, figure, [law for law in laws if law.figure == i])
        elif figure.kind == "heatmap":
            drawing = _heatmap(config, _rows(result, figure, points), figure, points)
        else:
            drawing = _lines(config, _rows(result, figure, points), figure)
        if (dots := _dots(result, figure)) is not None:
            drawing = drawing._replace(caption=f"{drawing.caption} The first {len(dots)} points of the design are shown.")
        runs = sum(map(len, result.batches(["seed"]))) if runs is None else runs
        if not result.is_finished(runs):
            drawing = drawing._replace(
                caption=f"{drawing.caption} The study is not finished: {runs} runs so far, white where none is."
            )
        same = sum(one.name.partition("-")[0] == drawing.name for one in drawn)
        drawn.append(drawing._replace(name=f"{drawing.name}-{same + 1}") if same else drawing)
    return drawn


def _rows(result: StudyResult, figure: FigureTable, points: Points | None) -> Rows:
    """The rows that a figure shows, with the columns that it needs."""
    config = result.config
    wanted = {
        figure.value,
        "finite",
        *(f"{side}.{name}" for side in SIDES for name in ("converged", "f_plus", "margin_alpha")),
    }
    columns = [*(axis.path for axis in config.axes), *(name for name in result.columns if name in wanted)]
    keys = [figure.x, figure.y or figure.x]
    dots = _dots(result, figure)

    def shown(frame: pd.DataFrame) -> pd.DataFrame:
        if points is not None:
            frame = on_coarse_values(points, frame, keys)
        if dots is not None:
            frame = frame[frame[dots.name].isin(dots)]
        return filter_rows(frame, resolve_where(config, figure))

    needs = [*(figure.where or {}), *([] if dots is None else [dots.name]), *([] if points is None else columns)]
    return Rows(result, columns, shown, needs)


def _dots(result: StudyResult, figure: FigureTable) -> pd.Series | None:
    """Where a figure has a dot for each run of a quasi-random design that has more of them than can be seen: the values that
    one axis has at the points that are drawn."""
    config, sampled = result.config, _sampled(result.config)
    dotted = bool(sampled) and (figure.kind == "heatmap" or {figure.x, figure.facet, figure.series} & set(sampled))
    if not dotted or figure.theory is not None or result.runs <= _MOST_DOTS:
        return None
    values = Points(config).axis_values(sampled[0])
    # the first points of a design cover its ranges evenly, too
    return pd.Series(values[: max(len(values) * _MOST_DOTS // result.runs, 1)], name=sampled[0])


def axis_label(config: Config, path: str) -> str:
    """A path with its unit, if the study has it as a number."""
    known = numeric_paths(config)
    return with_unit(path, known[path].unit if path in known else "")


def _with_value(config: Config, path: str, value: Any) -> str:
    return f"{path} = {_text(value)} {numeric_paths(config)[path].unit}".rstrip()


def _text(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def value_label(value: str) -> str:
    """What an axis or a colour bar says of a metric: side, label, unit."""
    side, _, _ = value.rpartition(".")
    about = find_metric(value)
    label = f"|{about.label}|" if is_magnitude(value) else about.label
    return with_unit(f"{side}: {label}" if side else label, about.unit)


def _middle(groups: Groups, value: str) -> pd.Series:
    """One number for each group: the median over what else varies, or the share that is true."""
    shown = _shown_column(value)
    return groups.means({value: shown})[value] if is_boolean(value) else groups.medians(shown)


def _over(config: Config, varied: Container[str], spec: FigureTable) -> str:
    """What was averaged over, of the axes that varied, for the caption."""
    keys = (spec.x, spec.y, spec.facet, spec.series)
    zipped = {axis.zip for axis in config.axes if axis.path in keys and axis.zip}
    others = [axis.path for axis in config.axes if axis.path not in keys and axis.zip not in zipped and axis.path in varied]
    if any(path in _sampled(config) for path in keys):  # one point of the design at each place
        others = [path for path in others if path not in _sampled(config)]
    if config.sweep.seeds > 1:
        others.append(f"{config.sweep.seeds} seeds")
    return f"; {'share' if is_boolean(spec.value) else 'median'} over {', '.join(others)}" if others else ""


def _sampled(config: Config) -> list[str]:
    """Axes of a quasi-random design."""
    return [axis.path for axis in config.axes if axis.values is None and axis.num is None]


def flat_remark(values: np.ndarray) -> str:
    """Return what a map says whose values differ by too little to count; "" for others."""
    finite = values[np.isfinite(values)]
    is_flat = finite.size > 1 and np.ptp(finite) <= AS_GOOD * np.abs(finite).max()
    return f"flat: within {100 * AS_GOOD:g} %" if is_flat else ""


def color_norm(values: np.ndarray, scale: str) -> Normalize:
    """Colour scale: logarithmic where values are positive and span more than a factor of 30, one colour where they are
    flat."""
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return Normalize(0.0, 1.0)
    low, high = float(finite.min()), float(finite.max())
    if low == high or flat_remark(values):
        return Normalize(low - 0.5 * abs(low) - 1e-12, high + 0.5 * abs(high) + 1e-12)
    if scale == "log" or (scale == "auto" and low > 0.0 and high / low > 30.0):
        positive = finite[finite > 0.0]
        return LogNorm(float(positive.min()), high) if positive.size else Normalize(low, high)
    return Normalize(low, high)


def cell_edges(centres: np.ndarray, log: bool) -> np.ndarray:
    """Cell edges halfway between centres, in the axis's own scale."""
    points = np.log(centres) if log else centres
    if len(points) == 1:
        half = 0.5 if log else 0.5 * (abs(points[0]) or 1.0)
        edges = np.array([points[0] - half, points[0] + half])
    else:
        middle = 0.5 * (points[1:] + points[:-1])
        edges = np.concatenate([[2 * points[0] - middle[0]], middle, [2 * points[-1] - middle[-1]]])
    return np.exp(edges) if log else edges


def is_log(config: Config, path: str, values: np.ndarray) -> bool:
    """Whether an axis is drawn logarithmically: as declared, or listed values that grow geometrically."""
    axis = next(a for a in config.axes if a.path == path)
    if axis.values is None:
        return axis.scale == "log"
    values = np.unique(values)
    return bool(len(values) > 2 and values[0] > 0.0 and values[-1] / values[0] > 20.0)


class _Panel(NamedTuple):
    """A panel of a map: its title, values over (y, x), shares of runs that stayed finite and that converged (None where the
    study does not say), the place (y, x) of the best gains on a map of errors over gains, the f_plus that conditions are
    drawn for, and its rows where each is a dot."""

    title: str
    table: pd.Series
    finite: pd.Series
    converged: pd.Series | None
    best: tuple[float, float] | None
    bound: float | None
    dots: pd.DataFrame | None


def _map_panels(
    config: Config, rows: Rows, spec: FigureTable, points: Points | None
) -> tuple[list[_Panel], Filling | None, set[str]]:
    """The panels of a map, of a refined study what fills its places, and the axes that varied."""
    assert spec.y is not None
    keys, facets = [spec.y, spec.x], [] if spec.facet is None else [spec.facet]
    paths = [axis.path for axis in config.axes]
    filling, used, varied = None, rows, None
    if points is not None:
        # a refined study has its points for their places: all of them are filled
        frame = rows.frame
        filling = Filling(points, frame, spec.x, spec.y)
        varied = Groups([frame], [], paths).varied
        others = [path for path in paths if path not in (*keys, *facets)]
        panels = [part for _, part in frame.groupby(facets, sort=True)] if facets else [frame]
        used = [filling.complete(part, others) for part in panels]
    groups = Groups(used, [*facets, *keys], paths)
    side = spec.value.partition(".")[0]
    columns = [name for name in ("finite", f"{side}.converged") if name in next(iter(used))]
    shares = groups.means({name: Column([name], lambda frame, name=name: frame[name].astype(float)) for name in columns})
    tables = _middle(groups, spec.value)
    if spec.value != "finite":
        # an average of the runs that did not diverge would hide that one did
        tables = tables.where(shares["finite"] == 1.0)
    shares = shares.assign(table=tables)
    bounds = _bounds(used, spec, points) if spec.overlays else None
    gridded, errors = config.sweep.design == "grid", None
    if (
        gridded
        and f"{side}.converged" in columns
        and re.search(r"rmse|chatter|convergence_time$", spec.value)
        and all(path.startswith(f"observer.{side}.") for path in keys)
    ):
        # of a refined study those that were simulated
        simulated = groups if points is None else Groups([rows.frame], [*facets, *keys], paths)
        errors = worst_runs(simulated, spec.value, f"{side}.margin_alpha" in next(iter(used)))
    found = []
    for i, value in enumerate(groups.index.unique(level=0) if facets else [None]):
        of = shares.xs(value, level=0) if facets else shares
        dots = None
        if not gridded:
            dots = rows.frame if spec.facet is None else rows.frame[rows.frame[spec.facet] == value]
        found.append(
            _Panel(
                title="" if spec.facet is None else _with_value(config, spec.facet, value),
                table=of["table"],
                finite=of["finite"],
                converged=of[columns[1]] if len(columns) > 1 else None,
                best=None if errors is None else _place_of_best(errors.xs(value, level=0) if facets else errors),
                bound=None if bounds is None else float(bounds.iloc[i]),
                dots=dots,
            )
        )
    return found, filling, groups.varied if varied is None else varied


def _bounds(rows: Iterable[pd.DataFrame], spec: FigureTable, points: Points | None) -> pd.Series:
    """The f_plus that conditions are drawn for: by panel, the median of the true bounds of its converged points, or of all
    if none did."""
    side = spec.x.split(".")[1]

    converged, bound = f"{side}.converged", f"{side}.f_plus"
    paths = [] if points is None or points.refinement is None else points.refinement.paths
    needs = [converged, bound, *paths]

    def known(frame: pd.DataFrame) -> np.ndarray:
        # most points of a refined study lie at its boundary: the median is that of the coarse grid
        kept = np.ones(len(frame), bool) if points is None else points.on_coarse_grid(frame)
        return kept & frame[bound].notna().to_numpy()

    def good(frame: pd.DataFrame) -> np.ndarray:
        return known(frame) & frame[converged].to_numpy(bool)

    groups = Groups(rows, [] if spec.facet is None else [spec.facet])
    shares = groups.means({"converged": Column(needs, lambda frame: frame[converged].where(known(frame)))})
    of_all = np.nan
    if (shares["converged"] == 0.0).any():
        of_all = groups.medians(Column(needs, lambda frame: frame[bound].where(known(frame))))
    medians = groups.medians(Column(needs, lambda frame: frame[bound].where(good(frame))))
    return medians.where(shares["converged"] > 0.0, of_all)


def _grid_of_axes(
    config: Config,
    spec: FigureTable,
    count: int,
    panel: tuple[float, float],
    ylabel: str,
    *,
    single: tuple[float, float] | None = None,
    beside: float = 0.0,
) -> tuple[Figure, list[Axes]]:
    """Axes of so many panels, y label and numbers on the outer ones only; sizes (inches) of a panel, of one alone, and
    beside all."""
    columns = 2 if count == 4 else min(count, 3)
    rows = -(-count // columns)
    size = (panel[0] * columns + beside, panel[1] * rows + 0.7) if single is None or count > 1 else single
    figure, axes = subplots(*size, rows, columns, beside=True, sharex=True, sharey=True)
    for i, ax in enumerate(axes):
        ax.set_visible(i < count)
        ax.tick_params(labelbottom=i + columns >= count)
        ax.set(xlabel=axis_label(config, spec.x), ylabel="" if i % columns else ylabel)
    return figure, list(axes[:count])


@style()
def _heatmap(config: Config, rows: Rows, spec: FigureTable, points: Points | None) -> Drawn:
    """A map; with `points` of a refined study, those that were not simulated show the nearest that was."""
    assert spec.y is not None
    panels, filling, varied = _map_panels(config, rows, spec, points)
    tables = [panel.table for panel in panels]
    values = np.concatenate([table.to_numpy(float) for table in tables])
    norm = Normalize(0.0, 1.0) if is_boolean(spec.value) else color_norm(values, spec.scale)
    figure, axes = _grid_of_axes(config, spec, len(panels), (3.5, 3.4), axis_label(config, spec.y), beside=1.0)
    hatches, curves = [], []
    gridded = config.sweep.design == "grid"
    missing = diverged = 0
    for ax, panel in zip(axes, panels, strict=True):
        xs, ys, hatch = _map_panel(ax, config, panel, spec, norm, filling)
        hatches = hatches or hatch
        missing += int(panel.table.isna().sum())
        diverged += int((panel.finite[panel.table.isna()] < 1.0).sum())
        under = [flat] if (flat := flat_remark(panel.table.to_numpy(float))) else []
        if panel.best is not None:
            ax.plot(*panel.best[::-1], "*", ms=13, mfc="white", mec="black", mew=1.0, clip_on=False, zorder=5)
            under.append(f"best ★ {panel.table[panel.best]:.2g} {find_metric(spec.value).unit}".rstrip())
        if panel.bound is not None:
            alpha_is_x = spec.x.endswith(".alpha")
            alphas = xs if alpha_is_x else ys
            conditions = {name: CONDITIONS[name] for name in spec.overlays}
            curves = condition_curves(ax, conditions, panel.bound, (alphas[0], alphas[-1]), alpha_is_x)
            under.append(f"f⁺ = {panel.bound:.3g} rad/s²")
        ax.set_title("\n".join(line for line in (panel.title, ",  ".join(under)) if line))
    handles: list[Any] = [*hatches, *curves]
    if missing:
        word = "diverged" if diverged == missing else "not converged" if "time" in spec.value else "undefined"
        label = f"{word} ({missing} points)"
        cross = Line2D([], [], color=MISSING, ls="", marker="x", label=label)
        handles.append(Patch(facecolor=MISSING, label=label) if gridded else cross)
    # a logarithmic scale begins at the smallest positive value
    extend = "min" if np.nanmin(values, initial=np.inf) < norm.vmin else "neither"  # type: ignore[operator]
    label = _wrap(value_label(spec.value))
    figure.colorbar(ScalarMappable(norm, MAP), ax=axes, pad=0.02, aspect=28, extend=extend, label=label)
    if handles:
        most = max(int(figure.get_figwidth() / 2.4), 1)
        figure.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), most))
    caption = f"{value_label(spec.value)} over {spec.x} and {spec.y}{_over(config, varied, spec)}."
    return Drawn(_file_name(spec), figure, caption)


def _map_panel(
    ax: Axes,
    config: Config,
    panel: _Panel,
    spec: FigureTable,
    norm: Normalize,
    filling: Filling | None,
) -> tuple[np.ndarray, np.ndarray, list[Patch]]:
    """Cells of a grid, or dots of a quasi-random design. Returns the values of both axes and the legend's handles."""
    assert spec.y is not None
    ax.grid(False)
    table, dots = panel.table, panel.dots
    if dots is None:
        xs, ys, grid = _dense(table, filling)
    else:
        xs, ys = (np.unique(dots[path].to_numpy(float)) for path in (spec.x, spec.y))
    logs = [is_log(config, path, values) for path, values in ((spec.x, xs), (spec.y, ys))]
    ax.set(xscale="log" if logs[0] else "linear", yscale="log" if logs[1] else "linear")
    edges = cell_edges(xs, logs[0]), cell_edges(ys, logs[1])
    handles = []
    if dots is None:
        ax.pcolormesh(*edges, grid, cmap=MAP, norm=norm, rasterized=True)
        # what an unfinished study has not computed yet stays white
        undefined = np.isnan(grid) if filling is not None else table.isna().unstack(fill_value=False).to_numpy(bool)
        if undefined.any():
            cells = np.ma.masked_array(np.zeros(grid.shape), ~undefined)
            ax.pcolormesh(*edges, cells, cmap=ListedColormap([MISSING]), rasterized=True)
        side = spec.value.partition(".")[0]
        if panel.converged is not None and spec.value != f"{side}.converged":
            *_, share = _dense(panel.converged, filling)
            handles = hatch_failures(ax, (xs, ys), edges, share, f"{side} not converged")
    else:
        shown = drawn_values(dots, spec.value)
        there, gone = dots[shown.notna()], dots[shown.isna()]
        ax.scatter(there[spec.x], there[spec.y], c=shown[shown.notna()], cmap=MAP, norm=norm, s=16, linewidths=0)
        ax.plot(gone[spec.x], gone[spec.y], "x", ms=4, color=MISSING)
    fit_axes(ax, edges)
    return xs, ys, handles


def _dense(table: pd.Series, filling: Filling | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values of x `(columns,)` and y `(rows,)`, and a table over (y, x) as a matrix `(rows, columns)`."""
    if filling is not None:
        return filling.dense(table)
    grid = table.unstack()
    return grid.columns.to_numpy(float), grid.index.to_numpy(float), grid.to_numpy(float)


def fit_axes(ax: Axes, edges: Sequence[np.ndarray]) -> None:
    """End axes at the outer edges of the cells of a map."""
    ax.set(xlim=edges[0][[0, -1]], ylim=edges[1][[0, -1]])


def hatch_failures(
    ax: Axes,
    centres: tuple[np.ndarray, np.ndarray],
    edges: tuple[np.ndarray, np.ndarray],
    share: np.ndarray,
    label: str,
    colour: Any = _HATCH,
) -> list[Patch]:
    """Hatch the cells of a map in which at most half of the runs pass. Returns the legend's handles.

    `centres` and `edges` are those of the cells along x and y, `share` of the runs that pass is `(rows, columns)`.
    """
    if not share.min() < 0.5:
        return []
    # out to the edges of the outer cells
    share = np.pad(share, 1, mode="edge")
    xs, ys = (np.concatenate([e[:1], c, e[-1:]]) for c, e in zip(centres, edges, strict=True))
    hatched = ax.contourf(xs, ys, share, levels=[-1.0, 0.5], colors="none", hatches=["//"])
    hatched.set(edgecolor=colour, linewidth=0.0)
    if share.max() >= 0.5:
        lines = ax.contour(xs, ys, share, levels=[0.5], colors="white", linewidths=1.8)
        lines.set_path_effects([path_effects.Stroke(linewidth=3.2, foreground="black"), path_effects.Normal()])
    return [Patch(facecolor="#808080", edgecolor="white", hatch="///", label=label)]


def drawn_values(part: pd.DataFrame, value: str) -> pd.Series:
    """The values to draw, of a frame that has `finite`: sizes of what has a sign, and nan where a lane diverged."""
    values = part[value].astype(float)
    if value == "finite":
        return values
    values = values.abs() if is_magnitude(value) else values
    return values.where(part["finite"].astype(bool)).replace([np.inf, -np.inf], np.nan)


def _shown_column(value: str) -> Column:
    return Column([value, "finite"], lambda frame: drawn_values(frame, value))


def worst_runs(groups: Groups, value: str, has_margin: bool) -> pd.DataFrame:
    """The worst run of each group: its `error`, the least `margin_alpha` of observers that have one, the share that
    `converged`, and the relative standard error of the mean (`scatter`) where its runs differ by the noise alone."""
    side = value.partition(".")[0]
    shown = _shown_column(value)
    converged, margin = (f"{side}.{name}" for name in ("converged", "margin_alpha"))
    means = groups.means(
        {
            "converged": Column([converged], lambda frame: frame[converged].astype(float)),
            "mean": shown,
            "square": shown._replace(of=lambda frame: shown.of(frame) ** 2),
        }
    )
    scatter = 0.0
    if not groups.varied - set(groups.index.names):
        with np.errstate(invalid="ignore", divide="ignore"):
            variance = np.maximum(means["square"] / means["mean"] ** 2 - 1.0, 0.0) / (means["rows"] - 1.0)
        scatter = np.sqrt(variance.where(means["rows"] > 1, 0.0))
    least_margin = {"margin_alpha": groups.spread(Column([margin], lambda frame: frame[margin])).least} if has_margin else {}
    return means.assign(error=groups.spread(shown).largest, scatter=scatter, **least_margin)


def _place_of_best(runs: pd.DataFrame) -> tuple[float, float] | None:
    best = best_gains(runs)
    return None if best is None else runs.index[best.index]


def best_gains(runs: pd.DataFrame) -> BestGains | None:
    """The best gains (:func:`jaxbl.gains.best_gains.find_best_gains`) of :func:`worst_runs` over them."""
    return find_best_gains(
        pd.DataFrame({path.rpartition(".")[2]: runs.index.get_level_values(path) for path in runs.index.names}),
        runs["error"].to_numpy(),
        (runs["converged"] == 1.0).to_numpy(),
        alpha_ratio=runs["margin_alpha"].to_numpy() if "margin_alpha" in runs else None,
        scatter=runs["scatter"].to_numpy(),
    )


def condition_curves(
    ax: Axes, conditions: Mapping[str, Condition], bound: float, alphas: tuple[float, float], alpha_is_x: bool = True
) -> list[Line2D]:
    """Draw the least lambda of gain conditions over a range of alpha, for one f_plus. Returns the legend's handles."""
    low, high = max(alphas[0], bound * 1.0001), alphas[1]
    fine = np.geomspace(low, high, 400) if high > bound else np.array([])
    handles = []
    for name, condition in conditions.items():
        dashes, colour = _CURVES[name]
        with jax.enable_x64(True):
            least = apply_elementwise(condition.least_lambda, [fine, np.full_like(fine, bound)]) if fine.size else fine
        line = (fine, least) if alpha_is_x else (least, fine)
        outlined = [path_effects.Stroke(linewidth=3.6, foreground="black"), path_effects.Normal()]
        # the label is what the pointer says on a page
        ax.plot(*line, ls=dashes, color=colour, lw=2.0, path_effects=outlined, label=condition.title)
        handles.append(Line2D([], [], color=colour, ls=dashes, lw=2.0, label=condition.title, path_effects=outlined))
    return handles


@style()
def _lines(config: Config, rows: Rows, spec: FigureTable) -> Drawn:
    keys = [path for path in (spec.facet, spec.series, spec.x) if path is not None]
    groups = Groups(rows, keys, [axis.path for axis in config.axes])
    spread = groups.spread(_shown_column(spec.value))
    found = groups.means({"middle": _shown_column(spec.value)})
    if not is_boolean(spec.value):
        found["middle"] = spread.quantiles[0]
    found = found.assign(least=spread.least, largest=spread.largest).reset_index()
    panels = [("", found)]
    if spec.facet is not None:
        panels = [(_with_value(config, spec.facet, value), part) for value, part in found.groupby(spec.facet, sort=True)]
    figure, axes = _grid_of_axes(config, spec, len(panels), (4.2, 3.4), _wrap(value_label(spec.value)), single=(6.4, 4.2))
    sampled, band = spec.x in _sampled(config), ""
    for ax, (title, part) in zip(axes, panels, strict=True):
        lines = [("", part)] if spec.series is None else list(part.groupby(spec.series, sort=True))
        for i, (name, line) in enumerate(lines):
            x, colour = line[spec.x], COLOURS[i % len(COLOURS)]
            label = None if spec.series is None else _text(name)
            ax.plot(x, line["middle"], "o" if sampled else "o-", ms=3.5, color=colour, label=label)
            if (line["rows"] > 1).any() and not is_boolean(spec.value):
                band = "; band: least to largest"
                ax.fill_between(x, line["least"], line["largest"], color=colour, alpha=0.18, linewidth=0)
        xs = np.unique(part[spec.x].to_numpy(float))
        log = is_log(config, spec.x, xs)
        if log:
            ax.set_xscale("log")
        if isinstance(color_norm(np.concatenate([spread.least, spread.largest]), spec.scale), LogNorm):
            ax.set_yscale("log")
        ax.set(xlim=cell_edges(xs, log)[[0, -1]], title=title)
    if spec.series is not None:
        axes[-1].legend(title=axis_label(config, spec.series))
    caption = f"{value_label(spec.value)} over {spec.x}{_where(config, spec)}{_over(config, groups.varied, spec)}{band}."
    return Drawn(_file_name(spec), figure, caption)


@style()
def _laws(config: Config, spec: FigureTable, laws: list[Law]) -> Drawn:
    """Points of lines that theory gives a slope for, with the lines fitted."""
    facets = list(dict.fromkeys(None if spec.facet is None else law.where[spec.facet] for law in laws))
    figure, axes = _grid_of_axes(config, spec, len(facets), (4.2, 3.8), _wrap(value_label(spec.value)), single=(7.2, 4.8))
    for ax, facet in zip(axes, facets, strict=True):
        there = [law for law in laws if spec.facet is None or law.where[spec.facet] == facet]
        ax.set(xscale="log", yscale="log", title="" if spec.facet is None else _with_value(config, spec.facet, facet))
        drawn = [_law(ax, law, i) for i, law in enumerate(there)]
        xs = np.concatenate([law.x_values for law in there])
        if len(xs):
            ax.set_xlim(*cell_edges(np.unique(xs), log=True)[[0, -1]])
        if len(ys := np.concatenate(drawn)):
            # the lines of theory run on beyond the points
            ax.set_ylim(ys.min() / 2.0, ys.max() * 2.0)
        else:
            ax.text(0.5, 0.5, "nothing above zero to draw", ha="center", transform=ax.transAxes)
        ax.legend(loc="best", handlelength=1.6, title=f"slope (theory {spec.theory:g}, dashed)")
    caption = (
        f"{value_label(spec.value)} over {spec.x}{_where(config, spec)}; geometric mean over {config.sweep.seeds} "
        f"{'seed' if config.sweep.seeds == 1 else 'seeds'}. Lines: least squares over the filled points; hollow points lie "
        "outside the law's range; dashed: theory's slope. The table says why each law ends."
    )
    return Drawn(_file_name(spec), figure, caption)


def _law(ax: Axes, law: Law, i: int) -> np.ndarray:
    """One line: points, fit, and theory's slope through the middle of the fit. Returns the y drawn."""
    colour, marker = COLOURS[i % len(COLOURS)], MARKERS[i % len(MARKERS)]
    x, y, inside = law.x_values, law.y_values, law.in_range
    name = ", ".join(map(_text, law.series.values()))
    seen = np.isfinite(y) & (y > 0.0)
    ax.plot(x[seen & ~inside], y[seen & ~inside], marker, ms=6, mfc="none", color=colour)
    ax.plot(x[inside], y[inside], marker, ms=6 if i == 0 else 3.5, color=colour)
    if law.fit is None:
        reasons = dict.fromkeys(law.stops[end].partition(":")[0] for end in ("below", "above"))
        label = f"no law ({', then '.join(reasons)})"
        ax.plot([], [], marker, mfc="none", color=colour, label=f"{name}: {label}" if name else label)
        return y[seen]
    ends = x[[law.fit.first, law.fit.last]]
    label = f"{law.fit.slope:.3f} ± {law.fit.standard_error:.1g}"
    ax.plot(ends, law.fit(ends), "-", color=colour, marker=marker, markevery=[], label=f"{name}: {label}" if name else label)
    centre = float(np.sqrt(ends[0] * ends[1]))
    around = np.array([x[0] / 10.0, x[-1] * 10.0])
    ax.plot(
        around, law.fit(centre) * (around / centre) ** law.theory, "--", lw=0.8, color=colour, scalex=False, scaley=False
    )
    return y[seen]


def _where(config: Config, spec: FigureTable) -> str:
    """What a figure fixes, for its caption."""
    fixed = [_with_value(config, path, value) for path, value in resolve_where(config, spec).items()]
    return f" where {', '.join(fixed)}" if fixed else ""


def _wrap(label: str) -> str:
    return "\n".join(textwrap.wrap(label, 48))


def _file_name(spec: FigureTable) -> str:
    return re.sub(r"[^A-Za-z0-9]+", "_", f"{spec.kind}_{spec.value}").strip("_")
