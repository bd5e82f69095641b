"""What is wrong with the figures that a study asks for, said before anything is computed, and without loading what draws."""

from jaxbl.config import AxisTable, Config, FigureTable
from jaxbl.config.figures import check_selection, find_axis
from jaxbl.errors import InputError
from jaxbl.gains.accuracy_laws import signal_size_columns
from jaxbl.sweeps.metrics import explain_missing_metric


def has_words(axis: AxisTable) -> bool:
    """True if values of an axis are words."""
    return any(isinstance(value, str) for value in axis.values or ())


MOST_PARTS = 60
"""Panels or lines of a figure: twenty rows of three panels, more than anyone compares."""


def values_of(config: Config, axis: AxisTable) -> int:
    """The number of values of an axis, of a quasi-random one as many as points."""
    if axis.values is not None:
        return len(set(axis.values))
    return (config.sweep.points or 0) if axis.num is None else axis.size(config.sweep.refine or 0)


def check_figures(config: Config, figures: list[FigureTable], columns: list[str]) -> None:
    """Raise `InputError` where a figure names an axis that does not exist, or needs a metric that is not there."""
    parts = {"x": None, "y": None, "facet": "panel", "series": "line"}
    for i, figure in enumerate(figures):
        for key, part in parts.items():
            path = getattr(figure, key)
            if path is None:
                continue
            place = f"figures[{i}].{key}: '{path}'"
            axis = find_axis(config, path, f"figures[{i}].{key}")
            if part is None:
                if has_words(axis):
                    other = "facet" if figure.kind == "heatmap" else "facet or series"
                    raise InputError(f"{place} has no numeric values; use it as {other}")
            elif (count := values_of(config, axis)) > MOST_PARTS:
                raise InputError(
                    f"{place} has {count} values, each of which would be a {part}; at most "
                    f"{MOST_PARTS} can be drawn; name another axis, or give it fewer values"
                )
        metrics = [column for column in columns if column not in (*config.axis_paths, "seed")]
        needs = [("value", figure.value)]
        if figure.overlays:
            side = figure.x.split(".")[1]
            needs += [("overlays", f"{side}.converged"), ("overlays", f"{side}.f_plus")]
        if figure.theory is not None:
            needs += [("theory", name) for name in signal_size_columns(figure.value)]
        for key, name in needs:
            if name not in metrics:
                raise InputError(f"figures[{i}].{key}: {explain_missing_metric(name, config.build(), metrics)}")
        check_selection(config, figure, i)
