"""Figures of a sweep: heatmaps with gain conditions over them, and lines over one axis."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false
# pyright: reportReturnType=false, reportAssignmentType=false

import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import numpy as np
from matplotlib.colors import ListedColormap, LogNorm, Normalize
from matplotlib.patheffects import withStroke
from pandas import DataFrame, Series

from jaxbl.config import Config, FigureTable, is_boolean, numeric_paths
from jaxbl.config.figures import filter_rows, resolve_where
from jaxbl.gains.accuracy_laws import Law, PowerLawFit, accuracy_laws
from jaxbl.gains.best_gains import AS_GOOD, BestGains, find_best_gains
from jaxbl.observer.conditions import CONDITIONS, Condition
from jaxbl.sweeps.elementwise import apply_elementwise
from jaxbl.sweeps.metrics import find_metric, is_magnitude
from jaxbl.sweeps.points import Points
from jaxbl.sweeps.sweep import StudyResult

from .aggregates import Column, Groups, Rows
from .checks import MOST_PARTS, check_figures, has_words, values_of
from .figures import (
    COLOURS,
    MAP,
    MARKERS,
    MISSING,
    SIDES,
    Axes,
    Drawn,
    Figure,
    Line2D,
    Pair,
    Patch,
    arrange,
    colour_bar,
    legend_below,
    style,
    subplots,
    with_unit,
    write_inside,
)
from .refined_maps import Filling, on_coarse_values

Array = np.ndarray

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
    varying = [axis for axis in config.axes if not has_words(axis) and (axis.values is None or len(axis.values) > 1)]
    if not varying:
        return []
    value = min((name for name in columns if name.startswith("motor.")), key=lambda name: name != "motor.velocity_rmse")
    *facets, x = (axis.path for axis in varying[-3:])
    if not facets:
        return [FigureTable(kind="line", x=x, value=value)]
    y = facets.pop()
    facet = facets[0] if facets and values_of(config, varying[-3]) <= MOST_PARTS else None
    return [FigureTable(kind="heatmap", x=x, y=y, value=value, facet=facet)]


laws_of = lru_cache(maxsize=1)(accuracy_laws)
"""Laws of a study, found once for its sentences, its figures and its file."""


@style()
def draw(result: StudyResult) -> list[Drawn]:
    """All figures of a study, in memory that does not grow with its number of runs (of a refined study, with its points).

    Raises:
        InputError: a figure names an axis or a metric that the study does not have.
    """
    config = result.config
    figures = config.figures or default_figures(config, result.columns)
    check_figures(config, figures, result.columns)
    points = Points(config) if config.sweep.refine is not None else None
    drawn: list[Drawn] = []
    runs = sum(map(len, result.batches(["seed"]))) if figures else 0
    for i, spec in enumerate(figures):
        dots = _dots(result, spec)
        if spec.theory is not None:
            figure, caption = _laws(config, spec, [law for law in laws_of(result) if law.figure == i])
        elif spec.kind == "heatmap":
            figure, caption = _heatmap(config, _rows(result, spec, points, dots), spec, points)
        else:
            figure, caption = _lines(config, _rows(result, spec, points, dots), spec)
        caption = f"{value_label(spec.value)} over {spec.x}{caption}"
        if dots is not None:
            caption += f" The first {len(dots)} points of the design are shown."
        if not result.is_finished(runs):
            caption += f" The study is not finished: {runs} runs so far, white where none is."
        name = re.sub(r"[^A-Za-z0-9]+", "_", f"{spec.kind}_{spec.value}").strip("_")
        same = sum(earlier.name.partition("-")[0] == name for earlier in drawn)
        drawn.append(Drawn(f"{name}-{same + 1}" if same else name, figure, caption))
    return drawn


def _rows(result: StudyResult, figure: FigureTable, points: Points | None, dots: Series | None) -> Rows:
    """The rows that a figure shows, with the columns that it needs."""
    config = result.config
    metrics = {f"{side}.{name}" for side in SIDES for name in ("converged", "f_plus", "margin_alpha")}
    metrics |= {figure.value, "finite"}
    columns = [*config.axis_paths, *(name for name in result.columns if name in metrics)]

    def select(frame: DataFrame) -> DataFrame:
        if points is not None:
            frame = on_coarse_values(points, frame, [figure.x, figure.y])
        if dots is not None:
            frame = frame[frame[dots.name].isin(dots)]
        return filter_rows(frame, resolve_where(config, figure))

    needs = [*(figure.where or {}), *([] if dots is None else [dots.name]), *([] if points is None else columns)]
    return Rows(result, columns, select, needs)


def _dots(result: StudyResult, figure: FigureTable) -> Series | None:
    """The dots of a figure that has one for each run of a quasi-random design that has more of them than can be seen: the
    values that one axis has at the points that are drawn."""
    config, sampled = result.config, _sampled_axes(result.config)
    dotted = bool(sampled) and (figure.kind == "heatmap" or {figure.x, figure.facet, figure.series} & set(sampled))
    if not dotted or figure.theory is not None or result.runs <= _MOST_DOTS:
        return None
    values = Points(config).axis_values(sampled[0])
    # the first points of a design cover its ranges evenly, too
    return Series(values[: max(len(values) * _MOST_DOTS // result.runs, 1)], name=sampled[0])


def axis_label(config: Config, path: str) -> str:
    """A path with its unit, if the study has it as a number."""
    return with_unit(path, unit_of(config, path))


def unit_of(config: Config, path: str) -> str:
    """The unit of what an axis varies; none of words."""
    parameter = numeric_paths(config).get(path)
    return "" if parameter is None else parameter.unit


def _with_value(config: Config, path: str, value: Any) -> str:
    return f"{path} = {_text(value)} {unit_of(config, path)}".rstrip()


def _panel_title(config: Config, spec: FigureTable, value: Any) -> str:
    return "" if spec.facet is None else _with_value(config, spec.facet, value)


def _text(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def value_label(value: str) -> str:
    """The words of an axis or a colour bar for a metric: side, label, unit."""
    side, _, _ = value.rpartition(".")
    metric = find_metric(value)
    label = f"|{metric.label}|" if is_magnitude(value) else metric.label
    return with_unit(f"{side}: {label}" if side else label, metric.unit)


def _over(config: Config, varied: set[str], spec: FigureTable) -> str:
    """Say what was averaged over, of the axes that varied, for the caption."""
    keys = (spec.x, spec.y, spec.facet, spec.series)
    zipped = {axis.zip for axis in config.axes if axis.path in keys and axis.zip}
    sampled = _sampled_axes(config)
    # one point of the design at each place
    single = {*keys, *(sampled if {*keys} & {*sampled} else ())}
    averaged = [axis.path for axis in config.axes if axis.path in varied - single and axis.zip not in zipped]
    if config.sweep.seeds > 1:
        averaged.append(f"{config.sweep.seeds} seeds")
    return f"; {'share' if is_boolean(spec.value) else 'median'} over {', '.join(averaged)}" if averaged else ""


def _sampled_axes(config: Config) -> list[str]:
    """Axes of a quasi-random design."""
    return [axis.path for axis in config.axes if axis.values is None and axis.num is None]


def flat_remark(values: Array) -> str:
    """Return what a map says whose values differ by too little to count; "" for others."""
    finite = values[np.isfinite(values)]
    is_flat = finite.size > 1 and np.ptp(finite) <= AS_GOOD * np.abs(finite).max()
    return f"flat: within {100 * AS_GOOD:g} %" if is_flat else ""


def color_norm(values: Array, scale: str) -> Normalize:
    """Colour scale: logarithmic where values are positive and span more than a factor of 30, one colour where they are
    flat."""
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return Normalize(0.0, 1.0)
    low, high = map(float, (finite.min(), finite.max()))
    if low == high or flat_remark(values):
        return Normalize(low - 0.5 * abs(low) - 1e-12, high + 0.5 * abs(high) + 1e-12)
    if scale == "log" or (scale == "auto" and low > 0.0 and high / low > 30.0):
        positive = finite[finite > 0.0]
        return LogNorm(float(positive.min()), high) if positive.size else Normalize(low, high)
    return Normalize(low, high)


def cell_edges(centres: Array, log: bool) -> Array:
    """Cell edges halfway between centres, in the axis's own scale."""
    points = np.log(centres) if log else centres
    if len(points) == 1:
        half = 0.5 if log else 0.5 * (abs(points[0]) or 1.0)
        edges = points[0] + np.array([-half, half])
    else:
        middle = 0.5 * (points[1:] + points[:-1])
        edges = np.concatenate([[2 * points[0] - middle[0]], middle, [2 * points[-1] - middle[-1]]])
    return np.exp(edges) if log else edges


def is_log(config: Config, path: str, values: Array) -> bool:
    """True if an axis is drawn logarithmically: as declared, or listed values that grow geometrically."""
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
    table: Series
    finite: Series
    converged: Series | None
    best: Pair | None
    bound: float | None
    dots: DataFrame | None


def _split(table: Any, spec: FigureTable) -> list[tuple[Any, Any]]:
    """The value of each panel, and the panel's part of a table or of rows; None and all where there is one panel."""
    if spec.facet is None:
        return [(None, table)]
    parts = table.groupby(spec.facet, sort=True)
    return [(value, part.droplevel(0) if spec.facet in part.index.names else part) for value, part in parts]


def _map_panels(
    config: Config, rows: Rows, spec: FigureTable, points: Points | None
) -> tuple[list[_Panel], Filling | None, set[str]]:
    """The panels of a map, of a refined study what fills its places, and the axes that varied."""
    assert spec.y is not None
    keys, paths = [spec.y, spec.x], config.axis_paths
    group_paths = keys if spec.facet is None else [spec.facet, *keys]
    simulated = groups = Groups(rows, group_paths, paths)
    filling, filled, varied = None, rows, groups.varied
    if points is not None:
        # a refined study has its points for their places: all of them are filled
        filling = Filling(points, rows.frame, spec.x, spec.y)
        unseen = [path for path in paths if path not in group_paths]
        filled = [filling.complete(part, unseen) for _, part in _split(rows.frame, spec)]
        groups = Groups(filled, group_paths, paths)
    side = spec.value.partition(".")[0]
    columns = next(iter(filled)).columns
    numbers = {name: _number_column(name) for name in ("finite", f"{side}.converged") if name in columns}
    shares = groups.means(numbers)
    column = _drawn_column(spec.value)
    # one number for each group: the median over what else varies, or the share that is true
    tables = groups.means({"middle": column})["middle"] if is_boolean(spec.value) else groups.medians(column)
    # an average of the runs that did not diverge would hide that one did
    shares["table"] = tables if spec.value == "finite" else tables.where(shares["finite"] == 1.0)
    bounds = _bounds(filled, spec, points) if spec.overlays else None
    gridded, errors = config.sweep.design == "grid", None
    if (
        gridded
        and f"{side}.converged" in numbers
        and re.search(r"rmse|chatter|convergence_time$", spec.value)
        and all(path.startswith(f"observer.{side}.") for path in keys)
    ):
        # of a refined study those that were simulated
        errors = dict(_split(worst_runs(simulated, spec.value, f"{side}.margin_alpha" in columns), spec))
    dots = None if gridded else dict(_split(rows.frame, spec))
    panels = [
        _Panel(
            title=_panel_title(config, spec, value),
            table=part["table"],
            finite=part["finite"],
            converged=part.get(f"{side}.converged"),
            best=errors and _place_of_best(errors[value]),
            bound=None if bounds is None else float(bounds.iloc[i]),
            dots=dots and dots[value],
        )
        for i, (value, part) in enumerate(_split(shares, spec))
    ]
    return panels, filling, varied


def _bounds(rows: Iterable[DataFrame], spec: FigureTable, points: Points | None) -> Series:
    """The f_plus that conditions are drawn for: by panel, the median of the true bounds of its converged points, or of all
    if none did."""
    side = spec.x.split(".")[1]
    converged, bound = f"{side}.converged", f"{side}.f_plus"
    paths = [] if points is None or points.refinement is None else points.refinement.paths
    needs = [converged, bound, *paths]

    def is_bounded(frame: DataFrame) -> Series:
        # most points of a refined study lie at its boundary: the median is that of the coarse grid
        return frame[bound].notna() & (True if points is None else points.on_coarse_grid(frame))

    groups = Groups(rows, [] if spec.facet is None else [spec.facet])
    good = Column(needs, lambda frame: frame[bound].where(is_bounded(frame) & frame[converged].astype(bool)))
    medians = groups.medians(good)
    if medians.isna().any():
        medians = medians.fillna(groups.medians(Column(needs, lambda frame: frame[bound].where(is_bounded(frame)))))
    return medians


def _grid_of_axes(
    config: Config,
    spec: FigureTable,
    count: int,
    panel: Pair,
    ylabel: str,
    *,
    single: Pair | None = None,
    beside: float = 0.0,
) -> tuple[Figure, list[Axes]]:
    """Axes of so many panels, y label and numbers on the outer ones only; sizes (inches) of a panel, of one alone, and
    beside all."""
    rows, columns = arrange(count)
    size = (panel[0] * columns + beside, panel[1] * rows + 0.7) if single is None or count > 1 else single
    figure, axes = subplots(*size, rows, columns, beside=True, sharex=True, sharey=True)
    for i, ax in enumerate(axes):
        ax.tick_params(labelbottom=i + columns >= count)
        ax.set(visible=i < count, xlabel=axis_label(config, spec.x), ylabel="" if i % columns else ylabel)
    return figure, axes[:count]


def _heatmap(config: Config, rows: Rows, spec: FigureTable, points: Points | None) -> tuple[Figure, str]:
    """A map; with `points` of a refined study, those that were not simulated show the nearest that was."""
    assert spec.y is not None
    panels, filling, varied = _map_panels(config, rows, spec, points)
    values = np.concatenate([panel.table.to_numpy(float) for panel in panels])
    norm = Normalize(0.0, 1.0) if is_boolean(spec.value) else color_norm(values, spec.scale)
    figure, axes = _grid_of_axes(config, spec, len(panels), (3.5, 3.4), axis_label(config, spec.y), beside=1.0)
    hatches, curves = [], []
    missing = diverged = 0
    for ax, panel in zip(axes, panels, strict=True):
        cells, hatch = _map_panel(ax, config, panel, spec, norm, filling)
        hatches = hatches or hatch
        is_missing = panel.table.isna()
        missing += int(is_missing.sum())
        diverged += int((panel.finite[is_missing] < 1.0).sum())
        under = [flat_remark(panel.table.to_numpy(float))]
        if panel.best is not None:
            ax.plot(*panel.best[::-1], "*", ms=13, mfc="white", mec="black", mew=1.0, clip_on=False, zorder=5)
            under.append(f"best ★ {panel.table[panel.best]:.2g} {find_metric(spec.value).unit}".rstrip())
        if panel.bound is not None:
            alpha_is_x = spec.x.endswith(".alpha")
            alphas = cells.centres[0 if alpha_is_x else 1]
            conditions = {name: CONDITIONS[name] for name in spec.overlays}
            curves = condition_curves(ax, conditions, panel.bound, (alphas[0], alphas[-1]), alpha_is_x)
            under.append(f"f⁺ = {panel.bound:.3g} rad/s²")
        ax.set_title("\n".join(filter(None, (panel.title, ",  ".join(filter(None, under))))))
    handles: list[Any] = [*hatches, *curves]
    if missing:
        word = "diverged" if diverged == missing else "not converged" if "time" in spec.value else "undefined"
        label = f"{word} ({missing} points)"
        cross = Line2D([], [], color=MISSING, ls="", marker="x", label=label)
        handles.append(Patch(facecolor=MISSING, label=label) if config.sweep.design == "grid" else cross)
    # a logarithmic scale begins at the smallest positive value
    extend = "min" if np.nanmin(values, initial=np.inf) < norm.vmin else "neither"  # type: ignore[operator]
    colour_bar(figure, axes, norm, _wrap(value_label(spec.value)), extend=extend)
    if handles:
        most = max(int(figure.get_figwidth() / 2.4), 1)
        legend_below(figure, handles, min(len(handles), most))
    return figure, f" and {spec.y}{_over(config, varied, spec)}."


class Cells(NamedTuple):
    """The cells of a map: centres along x and y, and their edges."""

    centres: Sequence[Array]
    edges: Sequence[Array]

    def out_to_edges(self, values: Array) -> tuple[Array, Array, Array]:
        """Centres along x and y with the outer edges, and values `(rows, columns)` at all of them."""
        xs, ys = (np.r_[edges[0], centres, edges[-1]] for centres, edges in zip(*self, strict=True))
        return xs, ys, np.pad(values, 1, mode="edge")


def set_up_map(ax: Axes, centres: Sequence[Array], logs: Sequence[bool] = (True, True)) -> Cells:
    """Set up axes for cells about centres along x and y, some on a logarithmic scale."""
    edges = [cell_edges(*axis) for axis in zip(centres, logs, strict=True)]
    ax.grid(False)
    for name, log, ends in zip("xy", logs, edges, strict=True):
        if log:
            ax.set(**{f"{name}scale": "log"})
        ax.set(**{f"{name}lim": ends[[0, -1]]})
    return Cells(centres, edges)


def _map_panel(
    ax: Axes, config: Config, panel: _Panel, spec: FigureTable, norm: Normalize, filling: Filling | None
) -> tuple[Cells, list[Patch]]:
    """Cells of a grid, or dots of a quasi-random design. Returns the cells and the legend's handles."""
    assert spec.y is not None
    table, dots, handles, grid = panel.table, panel.dots, [], np.empty(0)
    if dots is None:
        *centres, grid = _dense(table, filling)
    else:
        centres = [np.unique(dots[path].to_numpy(float)) for path in (spec.x, spec.y)]
    cells = set_up_map(ax, centres, list(map(is_log, (config, config), (spec.x, spec.y), centres)))
    if dots is None:
        ax.pcolormesh(*cells.edges, grid, cmap=MAP, norm=norm, rasterized=True)
        # what an unfinished study has not computed yet stays white
        undefined = np.isnan(grid) if filling is not None else table.isna().unstack(fill_value=False).to_numpy(bool)
        if undefined.any():
            missing = np.ma.masked_array(np.zeros(grid.shape), ~undefined)
            ax.pcolormesh(*cells.edges, missing, cmap=ListedColormap([MISSING]), rasterized=True)
        side = spec.value.partition(".")[0]
        if panel.converged is not None and spec.value != f"{side}.converged":
            *_, share = _dense(panel.converged, filling)
            handles = hatch_failures(ax, cells, share, f"{side} not converged")
    else:
        values = drawn_values(dots, spec.value)
        there, gone = dots[values.notna()], dots[values.isna()]
        ax.scatter(there[spec.x], there[spec.y], c=values.dropna(), cmap=MAP, norm=norm, s=16, linewidths=0)
        ax.plot(gone[spec.x], gone[spec.y], "x", ms=4, color=MISSING)
    return cells, handles


def _dense(table: Series, filling: Filling | None) -> tuple[Array, Array, Array]:
    """Values of x `(columns,)` and y `(rows,)`, and a table over (y, x) as a matrix `(rows, columns)`."""
    if filling is not None:
        return filling.dense(table)
    grid = table.unstack()
    return grid.columns.to_numpy(float), grid.index.to_numpy(float), grid.to_numpy(float)


def hatch_failures(ax: Axes, cells: Cells, share: Array, label: str, colour: Any = _HATCH) -> list[Patch]:
    """Hatch the cells of a map in which at most half of the runs pass, by their share `(rows, columns)`. Returns the
    legend's handles."""
    if not share.min() < 0.5:
        return []
    padded = cells.out_to_edges(share)
    hatched = ax.contourf(*padded, levels=[-1.0, 0.5], colors="none", hatches=["//"])
    hatched.set(edgecolor=colour, linewidth=0.0)
    if share.max() >= 0.5:
        lines = ax.contour(*padded, levels=[0.5], colors="white", linewidths=1.8)
        lines.set_path_effects(outline_effects(3.2))
    return [Patch(facecolor="#808080", edgecolor="white", hatch="///", label=label)]


def outline_effects(width: float, colour: str = "black") -> list[Any]:
    """Draw a line over a wider one."""
    return [withStroke(linewidth=width, foreground=colour)]


def drawn_values(part: DataFrame, value: str) -> Series:
    """The values to draw, of a frame that has `finite`: sizes of what has a sign, and nan where a lane diverged."""
    values = part[value].astype(float)
    if value == "finite":
        return values
    values = values.abs() if is_magnitude(value) else values
    return values.where(part["finite"].astype(bool)).replace([np.inf, -np.inf], np.nan)


def _drawn_column(value: str) -> Column:
    return Column([value, "finite"], lambda frame: drawn_values(frame, value))


def _number_column(name: str) -> Column:
    return Column([name], lambda frame: frame[name].astype(float))


def worst_runs(groups: Groups, value: str, has_margin: bool) -> DataFrame:
    """The worst run of each group: its `error`, the least `margin_alpha` of observers that have one, the share that
    `converged`, and the relative standard error of the mean (`scatter`) where its runs differ by the noise alone."""
    side, column = value.partition(".")[0], _drawn_column(value)
    means = groups.means(
        {
            "converged": _number_column(f"{side}.converged"),
            "mean": column,
            "square": column._replace(of=lambda frame: column.of(frame) ** 2),
        }
    )
    scatter = 0.0
    if not groups.varied - set(groups.index.names):
        with np.errstate(invalid="ignore", divide="ignore"):
            variance = np.maximum(means["square"] / means["mean"] ** 2 - 1.0, 0.0) / (means["rows"] - 1.0)
        scatter = np.sqrt(variance.where(means["rows"] > 1, 0.0))
    if has_margin:
        means["margin_alpha"] = groups.spread(_number_column(f"{side}.margin_alpha")).least
    return means.assign(error=groups.spread(column).largest, scatter=scatter)


def _place_of_best(runs: DataFrame) -> Pair | None:
    best = best_gains(runs)
    return None if best is None else runs.index[best.index]


def best_gains(runs: DataFrame) -> BestGains | None:
    """The best gains (:func:`jaxbl.gains.best_gains.find_best_gains`) of :func:`worst_runs` over them."""
    return find_best_gains(
        DataFrame({path.rpartition(".")[2]: runs.index.get_level_values(path) for path in runs.index.names}),
        runs["error"].to_numpy(),
        (runs["converged"] == 1.0).to_numpy(),
        alpha_ratio=runs["margin_alpha"].to_numpy() if "margin_alpha" in runs else None,
        scatter=runs["scatter"].to_numpy(),
    )


def condition_curves(
    ax: Axes, conditions: Mapping[str, Condition], bound: float, alphas: Pair, alpha_is_x: bool = True
) -> list[Line2D]:
    """Draw the least lambda of gain conditions over a range of alpha, for one f_plus. Returns the legend's handles."""
    low, high = max(alphas[0], bound * 1.0001), alphas[1]
    fine = np.geomspace(low, high, 400) if high > bound else np.array([])
    handles = []
    for name, condition in conditions.items():
        dashes, colour = _CURVES[name]
        line = [fine, least_lambdas(condition, fine, bound) if fine.size else fine]
        # the label is what the pointer says on a page
        handles += ax.plot(
            *line[:: 1 if alpha_is_x else -1], ls=dashes, color=colour, lw=2.0, path_effects=outline_effects(3.6),
            label=condition.title,
        )  # fmt: skip
    return handles


def least_lambdas(condition: Condition, alphas: Array, bound: float) -> Array:
    """The least lambda of a condition at each alpha, for one f_plus."""
    with jax.enable_x64(True):
        return apply_elementwise(condition.least_lambda, [alphas, np.full_like(alphas, bound)])


def _lines(config: Config, rows: Rows, spec: FigureTable) -> tuple[Figure, str]:
    keys = [path for path in (spec.facet, spec.series, spec.x) if path is not None]
    groups = Groups(rows, keys, config.axis_paths)
    column = _drawn_column(spec.value)
    spread = groups.spread(column)
    table = groups.means({"middle": column}).assign(least=spread.least, largest=spread.largest)
    if not is_boolean(spec.value):
        table["middle"] = spread.quantiles[0]
    panels = _split(table.reset_index(), spec)
    figure, axes = _grid_of_axes(config, spec, len(panels), (4.2, 3.4), _wrap(value_label(spec.value)), single=(6.4, 4.2))
    sampled, band = spec.x in _sampled_axes(config), ""
    for ax, (facet, part) in zip(axes, panels, strict=True):
        lines = [(None, part)] if spec.series is None else part.groupby(spec.series, sort=True)
        for i, (value, line) in enumerate(lines):
            x, colour = line[spec.x], COLOURS[i % len(COLOURS)]
            label = None if value is None else _text(value)
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
        ax.set(xlim=cell_edges(xs, log)[[0, -1]], title=_panel_title(config, spec, facet))
    if spec.series is not None:
        axes[-1].legend(title=axis_label(config, spec.series))
    return figure, f"{_where(config, spec)}{_over(config, groups.varied, spec)}{band}."


def _laws(config: Config, spec: FigureTable, laws: list[Law]) -> tuple[Figure, str]:
    """Points of lines that theory gives a slope for, with the lines fitted."""
    facets = list(dict.fromkeys(None if spec.facet is None else law.where[spec.facet] for law in laws))
    figure, axes = _grid_of_axes(config, spec, len(facets), (4.2, 3.8), _wrap(value_label(spec.value)), single=(7.2, 4.8))
    for ax, facet in zip(axes, facets, strict=True):
        members = [law for law in laws if spec.facet is None or law.where[spec.facet] == facet]
        ax.set(xscale="log", yscale="log", title=_panel_title(config, spec, facet))
        ys = np.concatenate([_law(ax, law, i) for i, law in enumerate(members)])
        xs = np.concatenate([law.x_values for law in members])
        if len(xs):
            ax.set_xlim(*cell_edges(np.unique(xs), log=True)[[0, -1]])
        if len(ys):
            # the lines of theory run on beyond the points
            ax.set_ylim(ys.min() / 2.0, ys.max() * 2.0)
        else:
            write_inside(ax, "nothing above zero to draw")
        ax.legend(loc="best", handlelength=1.6, title=f"slope (theory {spec.theory:g}, dashed)")
    seeds = config.sweep.seeds
    return figure, (
        f"{_where(config, spec)}; geometric mean over {seeds} seed{'s' * (seeds != 1)}. Lines: least squares over the "
        "filled points; hollow points lie outside the law's range; dashed: theory's slope. The table says why each law ends."
    )


def _law(ax: Axes, law: Law, i: int) -> Array:
    """One line: points, fit, and theory's slope through the middle of the fit. Returns the y drawn."""
    colour, marker = COLOURS[i % len(COLOURS)], MARKERS[i % len(MARKERS)]
    x, y, inside = law.x_values, law.y_values, law.in_range
    name = ", ".join(map(_text, law.series.values()))
    lead = f"{name}: " if name else ""
    positive = np.isfinite(y) & (y > 0.0)
    outside = positive & ~inside
    ax.plot(x[outside], y[outside], marker, ms=6, mfc="none", color=colour)
    ax.plot(x[inside], y[inside], marker, ms=6 if i == 0 else 3.5, color=colour)
    if law.fit is None:
        reasons = dict.fromkeys(law.stops[end].partition(":")[0] for end in ("below", "above"))
        ax.plot([], [], marker, mfc="none", color=colour, label=f"{lead}no law ({', then '.join(reasons)})")
        return y[positive]
    ends = x[[law.fit.first, law.fit.last]]
    ax.plot(ends, law.fit(ends), "-", color=colour, marker=marker, markevery=[], label=f"{lead}{slope_text(law.fit)}")
    centre = float(np.sqrt(ends[0] * ends[1]))
    around = np.array([x[0] / 10.0, x[-1] * 10.0])
    slope = law.fit(centre) * (around / centre) ** law.theory
    ax.plot(around, slope, "--", lw=0.8, color=colour, scalex=False, scaley=False)
    return y[positive]


def slope_text(fit: PowerLawFit) -> str:
    """The slope of a law with its standard error."""
    return f"{fit.slope:.3f} ± {fit.standard_error:.1g}"


def _where(config: Config, spec: FigureTable) -> str:
    """Say what a figure fixes, for its caption."""
    fixed = [_with_value(config, path, value) for path, value in resolve_where(config, spec).items()]
    return f" where {', '.join(fixed)}" if fixed else ""


def _wrap(label: str) -> str:
    return "\n".join(textwrap.wrap(label, 48))
