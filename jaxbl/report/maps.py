"""Figures of a sweep: maps with gain conditions over them, and lines over one axis."""

# pandas' and SciPy's own annotations are wider than what their methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false
# pyright: reportReturnType=false, reportAssignmentType=false

import re
from collections.abc import Iterable
from functools import lru_cache, partial
from itertools import cycle, groupby, repeat
from operator import itemgetter
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.ticker import EngFormatter
from pandas import DataFrame, Series
from scipy.spatial import KDTree

from jaxbl.config import Config, FigureTable, is_boolean, numeric_paths
from jaxbl.config.figures import filter_rows, resolve_where
from jaxbl.gains.accuracy_laws import Law, PowerLawFit, accuracy_laws
from jaxbl.gains.best_gains import AS_GOOD, BestGains, find_best_gains
from jaxbl.observer.conditions import CONDITIONS
from jaxbl.sweeps.metrics import find_metric, is_magnitude
from jaxbl.sweeps.points import Points
from jaxbl.sweeps.sweep import StudyResult

from .aggregates import Groups, Rows
from .checks import MOST_PARTS, check_figures, has_words, values_of
from .gain_plane import condition_curves
from .panels import COLOURS, Array, Axis, Band, Figure, Line, Map, Panel, Scale, arrange, mark, with_unit


def default_figures(config: Config, columns: list[str]) -> list[FigureTable]:
    """Figures for a study that asks for none: a heatmap over its last two axes, or lines over its one, of the motor's
    velocity error, or else of the first metric among its columns."""
    varying = [axis for axis in config.axes if not has_words(axis) and (axis.values is None or len(axis.values) > 1)]
    if not varying:
        return []
    value = min((name for name in columns if name.startswith("motor.")), key=lambda name: name != "motor.velocity_rmse")
    paths = {key: axis.path for key, axis in zip(("x", "y", "facet"), reversed(varying), strict=False)}
    if "facet" in paths and values_of(config, varying[-3]) > MOST_PARTS:
        del paths["facet"]
    return [FigureTable(kind="heatmap" if "y" in paths else "line", value=value, **paths)]


laws_of = lru_cache(maxsize=1)(accuracy_laws)
"""Laws of a study, found once for its sentences, its figures and its file."""


def draw(result: StudyResult) -> list[Figure]:
    """All figures of a study, in memory that does not grow with its number of runs (of a refined study, with its points).

    Raises:
        InputError: a figure names an axis or a metric that the study does not have.
    """
    config, points, figures = result.config, Points(result.config), []
    specs = config.figures or default_figures(config, result.columns)
    check_figures(config, specs, result.columns)
    for i, spec in enumerate(specs):
        rows = _rows(result, spec, points)
        if spec.theory is not None:
            panels, caption = _laws(config, spec, [law for law in laws_of(result) if law.figure == i])
        elif spec.kind == "heatmap":
            panels, caption = _heatmap(config, rows, spec, points)
        else:
            panels, caption = _lines(config, rows, spec)
        caption = f"{value_label(spec.value)} over {path_words(config, spec.x)}{caption}"
        name = re.sub(r"[^A-Za-z0-9]+", "_", f"{spec.kind}_{spec.value}").strip("_")
        same = sum(earlier.name.partition("-")[0] == name for earlier in figures)
        columns = arrange(len(panels))
        size = (3.4 * columns + 0.6, 3.0) if len(panels) > 1 else (5.6, 4.0)
        figures.append(Figure(f"{name}-{same + 1}" if same else name, panels, caption, columns, *size))
    return figures


def _rows(result: StudyResult, figure: FigureTable, points: Points) -> Rows:
    """The rows that a figure shows, with the columns that it needs; of a quasi-random design at the middles of bins."""
    config = result.config
    names = "finite", "converged", "f_plus", *MARGINS
    metrics = (column for column in result.columns if column == figure.value or column.rpartition(".")[2] in names)
    drawn = [axis for axis in config.axes if axis.path in (figure.x, figure.y)]
    # about four points in each bin of a map
    bins = int(np.clip(np.sqrt(config.sweep.points or 0) / 2.0, 6, 64))

    # of a refined study what lies on the coarse grid along all axes but those drawn
    starts = {axis.path: axis.start for axis in drawn}

    def select(frame: DataFrame) -> DataFrame:
        frame = filter_rows(frame[points.on_coarse_grid(frame.assign(**starts))], resolve_where(config, figure))
        for axis in drawn:
            if axis.values is None and axis.num is None:
                halves = axis.model_copy(update={"num": 2 * bins + 1}).grid()
                frame = frame.assign(**{axis.path: halves[1::2][np.searchsorted(halves[2:-1:2], frame[axis.path])]})
        return frame

    return Rows(result, [*config.axis_paths, "seed", *metrics], select)


_WORDS = {
    "lambda": "λ, correction gain",
    "alpha": "α, switching gain",
    "encoders": "encoder",
    "equivalent_control": "low-pass",
}
_UNSAID = {"drive", "transmission", "observer", "run", "identifier", "effects"}


def path_words(config: Config, path: str) -> str:
    """Words for what an axis varies; of gains with the side only where those of both vary."""
    parts = [part for part in path.split(".") if part not in _UNSAID]
    sides = {axis.split(".")[1] for axis in config.axis_paths if axis.startswith("observer.")}
    if path.startswith("observer.") and len(sides) == 1 and len(parts) > 1:
        del parts[0]
    return " ".join(_WORDS.get(part, part.replace("_", " ")) for part in parts)


def axis_label(config: Config, path: str) -> str:
    """Words for what an axis varies, with its unit if the study has it as a number."""
    return with_unit(path_words(config, path), unit_of(config, path))


def axis_of(config: Config, path: str, values: Array, log: bool | None = None) -> tuple[Axis, Array]:
    """An axis of a figure that shows the cells about some values of a study's axis, which rise, and their edges; it is
    logarithmic as declared, or where listed values grow geometrically."""
    if log is None:
        axis = next(axis for axis in config.axes if axis.path == path)
        grows = len(values) > 2 and values[0] > 0.0 and values[-1] / values[0] > 20.0
        log = axis.scale == "log" if axis.values is None else bool(grows)
    edges = cell_edges(values, log)
    return Axis(axis_label(config, path), path, log, (edges[0], edges[-1])), edges


def axis_words(config: Config, path: str) -> dict[str, str]:
    """Path, label and unit of an axis, for a page."""
    return {"path": path, "label": axis_label(config, path), "unit": unit_of(config, path)}


def unit_of(config: Config, path: str) -> str:
    """The unit of what an axis varies; none of words."""
    return getattr(numeric_paths(config).get(path), "unit", "")


def with_value(config: Config, path: str | None, value: Any) -> str:
    """Words for a value of an axis, in milli, micro, nano where that is small; "" of no axis."""
    if path is None:
        return ""
    unit = unit_of(config, path)
    small = unit and not isinstance(value, str) and 1e-9 <= abs(value) < 1e-2
    text = EngFormatter(unit).format_data(value) if small else f"{value_text(value)} {unit}".rstrip()
    return f"{path_words(config, path)} {text}"


def value_text(value: Any) -> str:
    """A value of a config as text."""
    if value is None:
        return "(none)"
    return f"{value:g}" if isinstance(value, float) else str(value)


def value_words(value: str) -> str:
    """The words for a metric: side and label."""
    side, label = value.rpartition(".")[0], find_metric(value).label
    label = f"|{label}|" if is_magnitude(value) else label
    return f"{side}: {label}" if side else label


def value_label(value: str) -> str:
    """The words of an axis or a colour bar for a metric: side, label, unit."""
    return with_unit(value_words(value), find_metric(value).unit)


def _over(config: Config, varied: set[str], spec: FigureTable) -> str:
    """Say what was averaged over, of the axes that varied, for the caption."""
    keys = (spec.x, spec.y, spec.facet, spec.series)
    zipped = {axis.zip for axis in config.axes if axis.path in keys and axis.zip}
    averaged = [
        path_words(config, axis.path) for axis in config.axes if axis.path in varied - {*keys} and axis.zip not in zipped
    ]
    if config.sweep.seeds > 1:
        averaged.append(f"{config.sweep.seeds} seeds")
    return f"; {'share' if is_boolean(spec.value) else 'median'} over {', '.join(averaged)}" if averaged else ""


def flat_remark(values: Array) -> str:
    """Return what a map says whose values differ by too little to count; "" for others."""
    finite = values[np.isfinite(values)]
    return (
        f"flat: within {100 * AS_GOOD:g} %" if finite.size > 1 and np.ptp(finite) <= AS_GOOD * np.abs(finite).max() else ""
    )


def colour_scale(values: Array, label: str, scale: str) -> Scale:
    """Colours of values: logarithmic where they are positive and span more than a factor of 30, one colour where they are
    flat."""
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return Scale(0.0, 1.0, label)
    low, high = finite.min(), finite.max()
    if low == high or flat_remark(values):
        return Scale(low - 0.5 * abs(low) - 1e-12, high + 0.5 * abs(high) + 1e-12, label)
    if (scale == "log" or (scale == "auto" and low > 0.0 and high / low > 30.0)) and high > 0.0:
        # it begins at the smallest positive value
        return Scale(finite[finite > 0.0].min(), high, label, log=True)
    return Scale(low, high, label)


def cell_edges(centres: Array, log: bool) -> Array:
    """Cell edges halfway between centres, in the axis's own scale."""
    points = np.log(centres) if log else centres
    # one more centre at either end, as far away as the one inside
    extended = np.pad(points, 1, "reflect", reflect_type="odd")
    edges = 0.5 * (extended[1:] + extended[:-1])
    if len(points) == 1:
        edges += np.array([-0.5, 0.5]) * (1.0 if log else abs(points[0]) or 1.0)
    return np.exp(edges) if log else edges


def _split(table: Any, path: str | None) -> list[tuple[Any, Any]]:
    """The value of each panel or line, and its part of a table or of rows; None and all where there is one alone."""
    if path is None:
        return [(None, table)]
    return [(value, part.droplevel(0) if path in part.index.names else part) for value, part in table.groupby(path)]


def _bounds(rows: Iterable[DataFrame], spec: FigureTable, points: Points) -> Series:
    """The f_plus that conditions are drawn for: by panel, the median of the true bounds of its converged points, or of all
    if none did."""
    side = spec.x.split(".")[1]

    # most points of a refined study lie at its boundary: the median is that of the coarse grid
    def bounds(frame: DataFrame) -> Series:
        return frame[f"{side}.f_plus"].where(points.on_coarse_grid(frame))

    groups = Groups(rows, [*filter(None, [spec.facet])])
    medians = groups.spread(lambda frame: bounds(frame).where(frame[f"{side}.converged"].astype(bool)))["median"]
    return medians.fillna(groups.spread(bounds)["median"]) if medians.isna().any() else medians


def _heatmap(config: Config, rows: Rows, spec: FigureTable, points: Points) -> tuple[list[Panel], str]:
    """A map; points of a refined study that were not simulated show the nearest that was."""
    assert spec.y is not None
    metric, paths, axes = spec.value, config.axis_paths, (spec.x, spec.y)
    side = metric.partition(".")[0]
    keys = [*filter(None, (spec.facet, spec.y, spec.x))]
    simulated = groups = Groups(rows, keys, paths)
    filling, filled = None, rows
    if points.refinement is not None:
        # a refined study has its points for their places: all of them are filled
        filling = Filling(points, rows.frame, *axes)
        unseen = [path for path in paths if path not in keys]
        filled = [filling.complete(part, unseen) for _, part in _split(rows.frame, spec.facet)]
        groups = Groups(filled, keys, paths)
    table, converged = _map_table(groups, metric), f"{side}.converged"
    bounds = _bounds(filled, spec, points) if spec.overlays else repeat(None)
    errors, judged = {}, re.search(r"rmse|chatter|convergence_time$", metric) and converged in table
    if config.sweep.design == "grid" and judged and all(path.startswith(f"observer.{side}.") for path in axes):
        # of a refined study those that were simulated
        errors = dict(_split(worst_runs(simulated, metric), spec.facet))
    # what failed sets no colour
    table["shown"] = table["value"].where(~table["failed"])
    scale = colour_scale(table["shown"].to_numpy(float), value_label(metric), spec.scale)
    if is_boolean(metric):
        scale = scale._replace(low=0.0, high=1.0, log=False)
    failure, drawn, failures = "", [], table[table["failed"]]
    if len(failures):
        word = "not converged" if converged in failures or "time" in metric else "undefined"
        failure = f"{'diverged' if (failures['finite'] < 1.0).all() else word} ({len(failures)} points)"
    for (value, part), bound in zip(_split(table, spec.facet), bounds, strict=False):
        plane = part[["value", "failed"]].astype(float)
        # what an unfinished study has not computed yet stays white
        plane = plane if filling is None else filling.fill(plane).fillna({"failed": 1.0})
        grid, failed = (plane[name].unstack() for name in plane)
        x, x_edges = axis_of(config, spec.x, grid.columns.to_numpy(float))
        y, y_edges = axis_of(config, spec.y, grid.index.to_numpy(float))
        parts = [Map(x_edges, y_edges, grid.to_numpy(), scale, failed.to_numpy() > 0.5, failure)]
        under = [flat_remark(part["shown"].to_numpy(float))]
        if errors and (best := best_gains(errors[value])):
            place = errors[value].index[best.index]
            parts += [mark(*place[::-1], "best", size=13.0)]
            under.append(f"best ★ {part['value'][place]:.2g} {find_metric(metric).unit}".rstrip())
        if bound is not None:
            alpha_is_x = spec.x.endswith(".alpha")
            alphas = (x if alpha_is_x else y).ends
            parts += condition_curves({key: CONDITIONS[key] for key in spec.overlays}, bound, alphas, alpha_is_x)
            under.append(f"f⁺ = {bound:.3g} rad/s²")
        title = "\n".join(filter(None, (with_value(config, spec.facet, value), ",  ".join(filter(None, under)))))
        drawn.append(Panel(x, y, parts, title))
    return drawn, f" and {path_words(config, spec.y)}{_over(config, groups.varied, spec)}."


_MOST_SHOWN = 1025
"""Places along an axis of a map; finer ones would not be seen."""


class Filling:
    """The plane of a map over two axes (paths `x` and `y`) of a refined study, by the rows that it has: every place of the
    fine grid is shown by the nearest point that was simulated.

    Without refinement in its neighbourhood that is a point of the coarse grid: its block is one coarse cell, centred on it.
    """

    def __init__(self, points: Points, frame: DataFrame, x: str, y: str):
        assert points.refinement is not None
        # values of each axis, and how many of them a coarse cell has
        self._axes = {}
        for path in (y, x):
            refined = path in points.refinement.paths
            values = points.axis_values(path) if refined else np.unique(frame[path].to_numpy(float))
            self._axes[path] = values, 1 << refined * points.refinement.grid.depth

    def _places(self, frame: DataFrame) -> Array:
        """Positions `(rows, 2)` of a frame's rows in the plane, in coarse cells."""
        return np.column_stack([np.searchsorted(values, frame[path]) / cell for path, (values, cell) in self._axes.items()])

    def _nearest(self, simulated: DataFrame, asked: DataFrame) -> Array:
        """The simulated row nearest to each row asked for, within half a coarse cell; their number where there is none."""
        # of two that are as near the upper one
        return KDTree(self._places(simulated)).query(self._places(asked) + 1e-6, p=np.inf, distance_upper_bound=0.50001)[1]

    def fill(self, table: DataFrame) -> DataFrame:
        """A table over (y, x) on the whole plane: rows of the nearest places, NaN where there is none."""
        # all values of an axis, or every 2nd, 4th, ...
        drawn = [
            values[:: min(1 << ((len(values) - 1) // _MOST_SHOWN).bit_length(), cell)]
            for values, cell in self._axes.values()
        ]
        plane = pd.MultiIndex.from_product(drawn, names=[*self._axes])
        nearest = self._nearest(table.index.to_frame(), plane.to_frame())
        return table.reset_index(drop=True).reindex(nearest).set_axis(plane)

    def complete(self, frame: DataFrame, paths: list[str]) -> DataFrame:
        """A frame in which each vertex that was simulated at any values of the other axes has rows at all of them.

        Medians and shares over these axes would else be over those alone at which the vertex lies on a boundary.
        """
        if not paths or frame.empty:
            return frame
        vertices, parts = frame[[*self._axes]].drop_duplicates(), []
        for _, part in frame.groupby([*paths, "seed"], sort=False):
            nearest = self._nearest(part, vertices)
            there = nearest < len(part)
            parts.append(part.iloc[nearest[there]].assign(**vertices[there].to_dict("list")))
        return pd.concat(parts, ignore_index=True)


def _map_table(groups: Groups, value: str) -> DataFrame:
    """The places of a map: `value`, whether it is none that means something (`failed`: too few of its runs converged, or
    one diverged), and the shares of runs that are `finite` and converged, of the columns that there are."""
    converged, column = f"{value.partition('.')[0]}.converged", partial(drawn_values, value=value)
    table = groups.means({name: itemgetter(name) for name in ("finite", converged) if name in groups.columns})
    # one number for each group: the median over what else varies, or the share that is true
    middle = groups.means({"middle": column})["middle"] if is_boolean(value) else groups.spread(column)["median"]
    # an average of the runs that did not diverge would hide that one did
    table["value"] = middle if value == "finite" else middle.where(table["finite"] == 1.0)
    table["failed"] = table["value"].isna()
    if converged in table and value != converged:
        table["failed"] |= table[converged] < 0.5
    return table


def drawn_values(part: DataFrame, value: str) -> Series:
    """The values to draw, of a frame that has `finite`: sizes of what has a sign, and nan where a lane diverged."""
    values = part[value].astype(float)
    if value == "finite":
        return values
    values = values.abs() if is_magnitude(value) else values
    return values.where(part["finite"].astype(bool)).replace([np.inf, -np.inf], np.nan)


MARGINS = "margin_alpha", "margin_exact"
"""Metrics of how far gains are from where α is no larger than f⁺, and from where the exact condition fails."""


def worst_runs(groups: Groups, value: str) -> DataFrame:
    """The worst run of each group: its `error`, the least of each of `MARGINS` that the observers have, the share that
    `converged`, and the relative standard error of the mean (`scatter`) where its runs differ by the noise alone."""
    side, column = value.partition(".")[0], partial(drawn_values, value=value)
    means = groups.means({
        "mean": column, "square": lambda frame: column(frame) ** 2, "converged": itemgetter(f"{side}.converged"),
    })  # fmt: skip
    scatter = 0.0
    if not groups.varied - set(groups.index.names):
        variance = (means["square"] / means["mean"] ** 2 - 1.0).clip(lower=0.0) / (means["rows"] - 1.0)
        scatter = np.sqrt(variance.where(means["rows"] > 1, 0.0))
    for margin in MARGINS:
        if f"{side}.{margin}" in groups.columns:
            means[margin] = groups.spread(itemgetter(f"{side}.{margin}"))["least"]
    return means.assign(error=groups.spread(column)["largest"], scatter=scatter)


def best_gains(runs: DataFrame) -> BestGains | None:
    """The best gains (:func:`jaxbl.gains.best_gains.find_best_gains`) of :func:`worst_runs` over them, of those that also
    converge at every other input with this f⁺: by the exact condition."""
    margins = {name: runs[name].to_numpy() for name in MARGINS if name in runs}
    works = (runs["converged"] == 1.0).to_numpy()
    return find_best_gains(
        runs.index.to_frame(index=False).rename(columns=lambda path: path.rpartition(".")[2]),
        runs["error"].to_numpy(),
        works,
        allowed=margins.get("margin_exact", np.inf) > 1.0,
        alpha_ratio=margins.get("margin_alpha"),
        scatter=runs["scatter"].to_numpy(),
    )


def _lines(config: Config, rows: Rows, spec: FigureTable) -> tuple[list[Panel], str]:
    groups = Groups(rows, [*filter(None, (spec.facet, spec.series, spec.x))], config.axis_paths)
    metric, is_share = spec.value, is_boolean(spec.value)
    column = partial(drawn_values, value=metric)
    spread = groups.spread(column)
    band, drawn = "", []
    scale = colour_scale(spread.to_numpy(), value_label(metric), spec.scale)
    for facet, part in _split(groups.means({"mean": column}).join(spread).reset_index(), spec.facet):
        parts = []
        for (value, line), colour in zip(_split(part, spec.series), cycle(COLOURS), strict=False):
            x, name = line[spec.x], with_value(config, spec.series, value)
            if (line["rows"] > 1).any() and not is_share:
                band = "; band: least to largest"
                parts.append(Band(x, line["least"], line["largest"], "", colour, 0.18))
            parts.append(Line(x, line["mean" if is_share else "median"], name, colour, marker="o", size=3.5))
        x, _ = axis_of(config, spec.x, np.unique(part[spec.x].to_numpy(float)))
        drawn.append(Panel(x, Axis(scale.label, metric, scale.log), parts, with_value(config, spec.facet, facet)))
    return drawn, f"{_where(config, spec)}{_over(config, groups.varied, spec)}{band}."


def _laws(config: Config, spec: FigureTable, laws: list[Law]) -> tuple[list[Panel], str]:
    """Points of lines that theory gives a slope for, with the lines fitted; a line without a law has its name."""
    panels = []
    for facet, members in groupby(laws, lambda law: law.where.get(spec.facet)):
        parts, places = [], []
        for law, colour in zip(members, cycle(COLOURS), strict=False):
            lead = "".join(f"{value_text(value)}: " for value in law.series.values())
            slope, x, y, fit = "no law", [], [], law.fit
            if fit is not None:
                slope, x = slope_text(fit), law.x_values[[fit.first, fit.last]]
                y = fit(x)
            errors = np.where(law.y_values > 0.0, law.y_values, np.nan)
            parts += [
                Line(law.x_values, errors, colour=colour, width=0.0, marker="o", size=3.5),
                Line(x, y, lead + slope, colour),
            ]
            places.append(law.x_values)
        x, _ = axis_of(config, spec.x, np.unique(np.concatenate(places)), log=True)
        y = Axis(value_label(spec.value), spec.value, log=True)
        panels.append(Panel(x, y, parts, with_value(config, spec.facet, facet)))
    seeds = config.sweep.seeds
    return panels, (
        f"{_where(config, spec)}; geometric mean over {seeds} seed{'s' * (seeds != 1)}. Lines with their slopes: least "
        f"squares over the law's range; theory's slope is {spec.theory:g}. The table says why each law ends."
    )


def slope_text(fit: PowerLawFit) -> str:
    """The slope of a law with its standard error."""
    return f"{fit.slope:.3f} ± {fit.standard_error:.1g}"


def _where(config: Config, spec: FigureTable) -> str:
    """Say what a figure fixes, for its caption."""
    fixed = [with_value(config, path, value) for path, value in resolve_where(config, spec).items()]
    return f" where {', '.join(fixed)}" if fixed else ""
