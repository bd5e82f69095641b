"""Figures of a sweep: heatmaps with gain conditions over them, and lines over one axis."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false
# pyright: reportReturnType=false

import re
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.patheffects as path_effects
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from jaxbl.config import Config, FigureTable, is_boolean, numeric_paths
from jaxbl.errors import InputError
from jaxbl.gains.accuracy_laws import Law, accuracy_laws, check_selection, fixed_values, selected
from jaxbl.observer.conditions import CONDITIONS, Condition
from jaxbl.sweeps.metrics import metric_of
from jaxbl.sweeps.points import Points
from jaxbl.sweeps.sweep import StudyResult
from jaxbl.validation import nearest

from .figures import SIDES, Drawn
from .refined_maps import Filling, on_coarse_values
from .style import COLOURS, HATCH, MAP, MISSING, style, with_unit

_CURVES = {
    "davila_fridman": ("-", "#FF5FA2"),
    "levant": ("-.", "#FF9E4A"),
    "seeber_horn": ("--", "#7FDBFF"),
    "moreno_osorio": ((0, (5, 1, 1, 1)), "#B6F09C"),
    "exact": (":", "#FFD400"),
}


def default_figures(config: Config) -> list[FigureTable]:
    """Figures for a study that asks for none: a heatmap over its last two axes, or lines over its one."""
    varying = [
        axis
        for axis in config.axes
        if axis.values is None or (len(axis.values) > 1 and not any(isinstance(v, str) for v in axis.values))
    ]
    if not varying:
        return []
    value = "motor.velocity_rmse"
    if len(varying) == 1:
        return [FigureTable(kind="line", x=varying[0].path, value=value)]
    x, y, *rest = (axis.path for axis in reversed(varying))
    return [FigureTable(kind="heatmap", x=x, y=y, value=value, facet=rest[0] if rest else None)]


def draw(result: StudyResult) -> list[Drawn]:
    """All figures of a study.

    Raises:
        InputError: a figure names an axis or a metric that the study does not have.
    """
    config = result.config
    figures = config.figures or default_figures(config)
    check_figures(config, figures, result.columns)
    points = Points(config) if config.sweep.refine is not None else None
    drawn, names = [], set()
    laws = accuracy_laws(result, figures)
    for i, figure in enumerate(figures):
        wanted = {figure.value, "finite", *(f"{side}.{name}" for side in SIDES for name in ("converged", "f_plus"))}
        frame = result.read([*(axis.path for axis in config.axes), *(c for c in result.columns if c in wanted)])
        if points is not None:
            frame = on_coarse_values(points, frame, [figure.x, figure.y or figure.x])
        if figure.kind == "heatmap":
            drawing = _heatmap(config, frame, figure, points)
        elif figure.theory is not None:
            drawing = _laws(config, frame, figure, [law for law in laws if law.figure == i])
        else:
            drawing = _lines(config, selected(config, frame, figure), figure)
        name, count = drawing.name, 2
        while name in names:
            name, count = f"{drawing.name}-{count}", count + 1
        names.add(name)
        drawn.append(drawing._replace(name=name))
    return drawn


def check_figures(config: Config, figures: list[FigureTable], columns: list[str]) -> None:
    """Raise `InputError` where a figure names an axis or metric that does not exist."""
    axes = [axis.path for axis in config.axes]
    words = [axis.path for axis in config.axes if any(isinstance(value, str) for value in axis.values or ())]
    for i, figure in enumerate(figures):
        for key in ("x", "y", "facet", "series"):
            path = getattr(figure, key)
            if path is not None and path not in axes:
                hint = nearest(path, axes) if axes else "the study has no axes"
                raise InputError(f"figures[{i}].{key}: '{path}' is not an axis of this study; {hint}")
            if path in words and key in ("x", "y"):
                other = "facet" if figure.kind == "heatmap" else "facet or series"
                raise InputError(f"figures[{i}].{key}: '{path}' has no numeric values; use it as {other}")
        metrics = [column for column in columns if column not in (*axes, "seed")]
        if figure.value not in metrics:
            raise InputError(f"figures[{i}].value: '{figure.value}' is no metric; {nearest(figure.value, metrics)}")
        check_selection(config, figure, i)


def _label(config: Config, path: str) -> str:
    return with_unit(path, numeric_paths(config)[path].unit)


def _value_label(value: str) -> str:
    side, _, _ = value.rpartition(".")
    about = metric_of(value)
    label = f"|{about.label}|" if _is_magnitude(value) else about.label
    return with_unit(f"{side}: {label}" if side else label, about.unit)


def _is_magnitude(value: str) -> bool:
    """Signed relative errors are drawn by their size: a median over seeds must not cancel them."""
    return value.endswith("_error")


def _reduce(frame: pd.DataFrame, keys: list[str], value: str) -> pd.Series:
    """One number for each combination of keys: the median over what else varies, or the share that is true."""
    groups = frame.groupby(keys, sort=True)[value]
    return groups.mean() if is_boolean(value) else groups.median()


def _over(config: Config, frame: pd.DataFrame, spec: FigureTable) -> str:
    """What was averaged over, for the caption."""
    keys = (spec.x, spec.y, spec.facet, spec.series)
    zipped = {axis.zip for axis in config.axes if axis.path in keys and axis.zip}
    others = [
        axis.path
        for axis in config.axes
        if axis.path not in keys and axis.zip not in zipped and frame[axis.path].nunique() > 1
    ]
    if any(path in _sampled(config) for path in keys):  # one point of the design at each place
        others = [path for path in others if path not in _sampled(config)]
    if config.sweep.seeds > 1:
        others.append(f"{config.sweep.seeds} seeds")
    return f"; {'share' if is_boolean(spec.value) else 'median'} over {', '.join(others)}" if others else ""


def _sampled(config: Config) -> list[str]:
    """Axes of a quasi-random design."""
    return [axis.path for axis in config.axes if axis.values is None and axis.num is None]


def color_norm(values: np.ndarray, scale: str) -> Normalize:
    """Colour scale: logarithmic where values are positive and span more than a factor of 30."""
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return Normalize(0.0, 1.0)
    low, high = float(finite.min()), float(finite.max())
    if low == high:
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


def _is_log(config: Config, path: str, values: np.ndarray) -> bool:
    """Whether an axis is drawn logarithmically: as declared, or listed values that grow geometrically."""
    axis = next(a for a in config.axes if a.path == path)
    if axis.values is None:
        return axis.scale == "log"
    values = np.unique(values)
    return bool(len(values) > 2 and values[0] > 0.0 and values[-1] / values[0] > 20.0)


def _panels(config: Config, frame: pd.DataFrame, facet: str | None) -> list[tuple[str, pd.DataFrame]]:
    if facet is None:
        return [("", frame)]
    unit = numeric_paths(config)[facet].unit
    return [
        (f"{facet} = {value if isinstance(value, str) else f'{value:g}'} {unit}".strip(), part)
        for value, part in frame.groupby(facet, sort=True)
    ]


def _grid_of_axes(count: int, width: float, height: float, extra: float = 0.0) -> tuple[Figure, list[Axes]]:
    columns = 2 if count == 4 else min(count, 3)
    rows = -(-count // columns)
    figure = Figure(figsize=(width * columns + extra, height * rows + 0.7), layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    flat = list(axes.ravel())
    for unused in flat[count:]:
        unused.set_visible(False)
    for column in range(columns):
        last = max(i for i in range(column, count, columns))
        flat[last].tick_params(labelbottom=True)
    return figure, flat[:count]


def _table(part: pd.DataFrame, keys: list[str], value: str) -> pd.Series:
    """The values of a map; empty where any run diverged: an average of the other runs would hide that."""
    table = _reduce(part.assign(**{value: _shown(part, value)}), keys, value)
    return table if value == "finite" else table.where(_reduce(part, keys, "finite") == 1.0)


def _heatmap(config: Config, frame: pd.DataFrame, spec: FigureTable, points: Points | None) -> Drawn:
    """A map; with `points` of a refined study, those that were not simulated show the nearest that was."""
    assert spec.y is not None
    with style():
        panels = _panels(config, frame, spec.facet)
        keys = [spec.y, spec.x]
        filling = None
        if points is not None:
            filling = Filling(points, frame, spec.x, spec.y)
            others = [axis.path for axis in config.axes if axis.path not in (*keys, spec.facet)]
            panels = [(title, filling.complete(part, others)) for title, part in panels]
        tables = [_table(part, keys, spec.value) for _, part in panels]
        norm = (
            Normalize(0.0, 1.0)
            if is_boolean(spec.value)
            else color_norm(np.concatenate([t.to_numpy(float) for t in tables]), spec.scale)
        )
        figure, axes = _grid_of_axes(len(panels), 3.5, 3.4, extra=1.0)
        handles: list[Any] = []
        curves: list[Any] = []
        gridded = config.sweep.design == "grid"
        missing = diverged = 0
        for ax, (title, part), table in zip(axes, panels, tables, strict=True):
            xs, ys, hatch = _map_panel(ax, config, part, table, spec, norm, filling)
            handles = handles or hatch
            missing += int(table.isna().sum())
            diverged += int((_reduce(part, keys, "finite")[table.isna()] < 1.0).sum())
            under = []
            if gridded and (best := _best(table, part, spec)) is not None:
                ax.plot(best[0], best[1], "*", ms=13, mfc="white", mec="black", mew=1.0, clip_on=False, zorder=5)
                under.append(f"best ★ {best[2]:.2g} {metric_of(spec.value).unit}".rstrip())
            if spec.overlays:
                # most points of a refined study lie at its boundary: the median is that of the coarse grid
                bound = _bound(part if points is None else part[points.always_simulated(part)], spec)
                curves = _overlay(ax, bound, spec, xs, ys)
                under.append(f"f⁺ = {bound:.3g} rad/s²")
            ax.set_title("\n".join(line for line in (title, ",  ".join(under)) if line))
        if missing:
            word = "diverged" if diverged == missing else "not converged" if "time" in spec.value else "undefined"
            label = f"{word} ({missing} points)"
            cross = Line2D([], [], color=MISSING, ls="", marker="x", label=label)
            curves.append(Patch(facecolor=MISSING, label=label) if gridded else cross)
        bar = figure.colorbar(ScalarMappable(norm, MAP), ax=axes, pad=0.02, aspect=28, extend=_extend(tables, norm))
        bar.set_label(_wrap(_value_label(spec.value)))
        if handles := [*handles, *curves]:
            columns = max(int(figure.get_figwidth() / 2.4), 1)
            figure.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), columns))
    caption = f"{_value_label(spec.value)} over {spec.x} and {spec.y}{_over(config, frame, spec)}."
    return Drawn(_file_name(spec), figure, caption)


def _map_panel(
    ax: Axes,
    config: Config,
    part: pd.DataFrame,
    table: pd.Series,
    spec: FigureTable,
    norm: Normalize,
    filling: Filling | None,
) -> tuple[np.ndarray, np.ndarray, list[Patch]]:
    """Cells of a grid, or dots of a quasi-random design. Returns the values of both axes and the legend's handles."""
    assert spec.y is not None
    ax.grid(False)
    if filling is None:
        xs, ys = (np.sort(part[path].unique()).astype(float) for path in (spec.x, spec.y))
    else:
        xs, ys, grid = filling.dense(table)
    logs = [_is_log(config, path, values) for path, values in ((spec.x, xs), (spec.y, ys))]
    ax.set(xscale="log" if logs[0] else "linear", yscale="log" if logs[1] else "linear")
    edges = cell_edges(xs, logs[0]), cell_edges(ys, logs[1])
    handles = []
    if config.sweep.design == "grid":
        if filling is None:
            grid = table.unstack().to_numpy(float)
        ax.set_facecolor(MISSING)
        ax.pcolormesh(*edges, grid, cmap=MAP, norm=norm, rasterized=True)
        side = spec.value.partition(".")[0]
        column = f"{side}.converged"
        if column in part and spec.value != column:
            shares = _reduce(part, [spec.y, spec.x], column)
            share = shares.unstack().to_numpy(float) if filling is None else filling.dense(shares)[2]
            handles = hatch_failures(ax, (xs, ys), edges, share, f"{side} not converged")
    else:
        shown = _shown(part, spec.value)
        there, gone = part[shown.notna()], part[shown.isna()]
        ax.scatter(there[spec.x], there[spec.y], c=shown[shown.notna()], cmap=MAP, norm=norm, s=16, linewidths=0)
        ax.plot(gone[spec.x], gone[spec.y], "x", ms=4, color=MISSING)
    ax.set(xlim=edges[0][[0, -1]], ylim=edges[1][[0, -1]], xlabel=_label(config, spec.x))
    if ax.get_subplotspec().is_first_col():  # type: ignore[union-attr]
        ax.set_ylabel(_label(config, spec.y))
    return xs, ys, handles


def hatch_failures(
    ax: Axes,
    centres: tuple[np.ndarray, np.ndarray],
    edges: tuple[np.ndarray, np.ndarray],
    share: np.ndarray,
    label: str,
) -> list[Patch]:
    """Hatch the cells of a map in which less than half of the runs pass. Returns the legend's handles.

    Args:
        ax: of the map.
        centres: of the cells, along x `(columns,)` and y `(rows,)`.
        edges: of the cells, along x `(columns + 1,)` and y `(rows + 1,)`.
        share: of the runs that pass `(rows, columns)`.
        label: of the hatching.
    """
    if not share.min() < 0.5:
        return []
    # out to the edges of the outer cells
    share = np.pad(share, 1, mode="edge")
    xs, ys = (np.concatenate([e[:1], c, e[-1:]]) for c, e in zip(centres, edges, strict=True))
    hatched = ax.contourf(xs, ys, share, levels=[-1.0, 0.5], colors="none", hatches=["//"])
    hatched.set(edgecolor=HATCH, linewidth=0.0)
    if share.max() >= 0.5:
        lines = ax.contour(xs, ys, share, levels=[0.5], colors="white", linewidths=1.8)
        lines.set_path_effects([path_effects.Stroke(linewidth=3.2, foreground="black"), path_effects.Normal()])
    return [Patch(facecolor="#808080", edgecolor="white", hatch="///", label=label)]


def _shown(part: pd.DataFrame, value: str) -> pd.Series:
    """The values to draw: those of diverged lanes are left out."""
    values = part[value].astype(float)
    if value == "finite":
        return values
    values = values.abs() if _is_magnitude(value) else values
    return values.where(part["finite"].astype(bool)).replace([np.inf, -np.inf], np.nan)


def _extend(tables: list[pd.Series], norm: Normalize) -> str:
    values = np.concatenate([t.to_numpy(float) for t in tables])
    below = bool(np.nanmin(values, initial=np.inf) < norm.vmin)  # type: ignore[operator]
    above = bool(np.nanmax(values, initial=-np.inf) > norm.vmax)  # type: ignore[operator]
    return {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}[below, above]


def _best(table: pd.Series, part: pd.DataFrame, spec: FigureTable) -> tuple[float, float, float] | None:
    """Place and value of the smallest figure, for errors and times, among the points that converged if any did."""
    if not re.search(r"rmse|chatter|convergence_time$", spec.value):
        return None
    assert spec.y is not None
    kept = table[_reduce(part, [spec.y, spec.x], f"{spec.value.partition('.')[0]}.converged") >= 0.5].dropna()
    kept = kept if len(kept) else table.dropna()
    if not len(kept):
        return None
    y, x = kept.idxmin()
    return float(x), float(y), float(kept[(y, x)])


def _bound(part: pd.DataFrame, spec: FigureTable) -> float:
    """The f_plus that conditions are drawn for: median of the true bounds of the panel's converged points."""
    side = spec.x.split(".")[1]
    converged = part[part[f"{side}.converged"].astype(bool)]
    return float((converged if len(converged) else part)[f"{side}.f_plus"].median())


def _overlay(ax: Axes, bound: float, spec: FigureTable, xs: np.ndarray, ys: np.ndarray) -> list[Line2D]:
    """Curves of the gain conditions for one f_plus."""
    alpha_is_x = spec.x.endswith(".alpha")
    alphas = xs if alpha_is_x else ys
    return condition_curves(
        ax, {name: CONDITIONS[name] for name in spec.overlays}, bound, (alphas.min(), alphas.max()), alpha_is_x
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
            least = np.asarray(condition.least_lambda(jnp.asarray(fine), jnp.asarray(bound))) if fine.size else fine
        line = (fine, least) if alpha_is_x else (least, fine)
        outlined = [path_effects.Stroke(linewidth=3.6, foreground="black"), path_effects.Normal()]
        ax.plot(*line, ls=dashes, color=colour, lw=2.0, path_effects=outlined)
        handles.append(Line2D([], [], color=colour, ls=dashes, lw=2.0, label=condition.title, path_effects=outlined))
    return handles


def _lines(config: Config, frame: pd.DataFrame, spec: FigureTable) -> Drawn:
    with style():
        panels = _panels(config, frame, spec.facet)
        figure, axes = _grid_of_axes(len(panels), 4.2, 3.4)
        if len(panels) == 1:
            figure.set_size_inches(6.4, 4.2)
        shown = _shown(frame, spec.value)
        sampled, band = spec.x in _sampled(config), ""
        for ax, (title, part) in zip(axes, panels, strict=True):
            groups = [("", part)] if spec.series is None else list(part.groupby(spec.series, sort=True))
            for i, (name, group) in enumerate(groups):
                values = shown.loc[group.index]
                by_x = values.groupby(group[spec.x], sort=True)
                middle = by_x.mean() if is_boolean(spec.value) else by_x.median()
                colour = COLOURS[i % len(COLOURS)]
                label = None if spec.series is None else f"{name if isinstance(name, str) else f'{name:g}'}"
                ax.plot(middle.index, middle, "o" if sampled else "o-", ms=3.5, color=colour, label=label)
                if (by_x.size() > 1).any() and not is_boolean(spec.value):
                    band = "; band: least to largest"
                    ax.fill_between(middle.index, by_x.min(), by_x.max(), color=colour, alpha=0.18, linewidth=0)
            xs = np.sort(part[spec.x].unique()).astype(float)
            log = _is_log(config, spec.x, xs)
            if log:
                ax.set_xscale("log")
            ax.set_xlim(*cell_edges(xs, log)[[0, -1]])
            if isinstance(color_norm(shown.to_numpy(float), spec.scale), LogNorm):
                ax.set_yscale("log")
            ax.set_title(title)
            ax.set_xlabel(_label(config, spec.x))
            if ax.get_subplotspec().is_first_col():  # type: ignore[union-attr]
                ax.set_ylabel(_wrap(_value_label(spec.value)))
        if spec.series is not None:
            axes[-1].legend(title=_label(config, spec.series))
    caption = f"{_value_label(spec.value)} over {spec.x}{_where(config, spec)}{_over(config, frame, spec)}{band}."
    return Drawn(_file_name(spec), figure, caption)


_MARKERS = ("o", "s", "^", "D", "v", "P", "X")


def _laws(config: Config, frame: pd.DataFrame, spec: FigureTable, laws: list[Law]) -> Drawn:
    """Points of lines that theory gives a slope for, with the lines fitted."""
    with style():
        facets = list(dict.fromkeys(None if spec.facet is None else law.where[spec.facet] for law in laws))
        figure, axes = _grid_of_axes(len(facets), 4.2, 3.8)
        if len(facets) == 1:
            figure.set_size_inches(7.2, 4.8)
        for ax, facet in zip(axes, facets, strict=True):
            there = [law for law in laws if facet is None or law.where[spec.facet] == facet]
            ax.set_xscale("log")
            ax.set_yscale("log")
            drawn = [_law(ax, law, i) for i, law in enumerate(there)]
            xs = np.concatenate([law.x_values for law in there])
            if len(xs):
                ax.set_xlim(*cell_edges(np.unique(xs), log=True)[[0, -1]])
            if len(ys := np.concatenate(drawn)):
                # the lines of theory run on beyond the points
                ax.set_ylim(ys.min() / 2.0, ys.max() * 2.0)
            else:
                ax.text(0.5, 0.5, "nothing above zero to draw", ha="center", transform=ax.transAxes)
            if facet is not None:
                ax.set_title(f"{spec.facet} = {_figure(facet)} {_unit(config, spec.facet)}".strip())
            ax.set_xlabel(_label(config, spec.x))
            if ax.get_subplotspec().is_first_col():  # type: ignore[union-attr]
                ax.set_ylabel(_wrap(_value_label(spec.value)))
            ax.legend(loc="best", handlelength=1.6, title=f"slope (theory {spec.theory:g}, dashed)")
    caption = (
        f"{_value_label(spec.value)} over {spec.x}{_where(config, spec)}; geometric mean over {config.sweep.seeds} "
        f"{'seed' if config.sweep.seeds == 1 else 'seeds'}. Lines: least squares over the filled points; hollow points lie "
        "outside the law's range; dashed: theory's slope. The table says why each law ends."
    )
    return Drawn(_file_name(spec), figure, caption)


def _law(ax: Axes, law: Law, i: int) -> np.ndarray:
    """One line: points, fit, and theory's slope through the middle of the fit. Returns the y drawn."""
    colour, marker = COLOURS[i % len(COLOURS)], _MARKERS[i % len(_MARKERS)]
    x, y, inside = law.x_values, law.y_values, law.inside
    name = ", ".join(map(_figure, law.series.values()))
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
    label = f"{name}: {label}" if name else label
    ax.plot(ends, law.fit(ends), "-", marker=marker, markevery=[], color=colour, label=label)
    centre = float(np.sqrt(ends[0] * ends[1]))
    around = np.array([x[0] / 10.0, x[-1] * 10.0])
    ax.plot(
        around, law.fit(centre) * (around / centre) ** law.theory, "--", lw=0.8, color=colour, scalex=False, scaley=False
    )
    return y[seen]


def _figure(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def _unit(config: Config, path: str | None) -> str:
    return "" if path is None else numeric_paths(config)[path].unit


def _where(config: Config, spec: FigureTable) -> str:
    """What a figure fixes, for its caption."""
    values = fixed_values(config, spec).items()
    fixed = [f"{path} = {_figure(value)} {_unit(config, path)}".rstrip() for path, value in values]
    return f" where {', '.join(fixed)}" if fixed else ""


def _wrap(label: str, width: int = 48) -> str:
    import textwrap

    return "\n".join(textwrap.wrap(label, width))


def _file_name(spec: FigureTable) -> str:
    return re.sub(r"[^A-Za-z0-9]+", "_", f"{spec.kind}_{spec.value}").strip("_")
