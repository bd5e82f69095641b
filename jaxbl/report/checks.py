"""What is wrong with the figures that a study asks for, said before anything is computed, and without loading what draws."""

from jaxbl.config import AxisTable, Config, FigureTable
from jaxbl.config.figures import check_selection
from jaxbl.errors import InputError
from jaxbl.gains.accuracy_laws import signal_size_columns
from jaxbl.sweeps.metrics import explain_missing_metric
from jaxbl.validation import suggest_word

MOST_PARTS = 60
"""Panels or lines of a figure: twenty rows of three panels, more than anyone compares."""


def values_of(config: Config, axis: AxisTable) -> int:
    """How many values an axis has, of a quasi-random one as many as points."""
    if axis.values is not None:
        return len(set(axis.values))
    return (config.sweep.points or 0) if axis.num is None else axis.size(config.sweep.refine or 0)


def check_figures(config: Config, figures: list[FigureTable], columns: list[str]) -> None:
    """Raise `InputError` where a figure names an axis that does not exist, or needs a metric that is not there."""
    axes = [axis.path for axis in config.axes]
    counts = {axis.path: values_of(config, axis) for axis in config.axes}
    parts = {"facet": "panel", "series": "line"}
    words = [axis.path for axis in config.axes if any(isinstance(value, str) for value in axis.values or ())]
    for i, figure in enumerate(figures):
        for key in ("x", "y", "facet", "series"):
            path = getattr(figure, key)
            if path is not None and path not in axes:
                hint = suggest_word(path, axes) if axes else "the study has no axes"
                raise InputError(f"figures[{i}].{key}: '{path}' is not an axis of this study; {hint}")
            if path in words and key in ("x", "y"):
                other = "facet" if figure.kind == "heatmap" else "facet or series"
                raise InputError(f"figures[{i}].{key}: '{path}' has no numeric values; use it as {other}")
            if path is not None and key in parts and (count := counts[path]) > MOST_PARTS:
                raise InputError(
                    f"figures[{i}].{key}: '{path}' has {count} values, each of which would be a {parts[key]}; at most "
                    f"{MOST_PARTS} can be drawn; name another axis, or give it fewer values"
                )
        metrics = [column for column in columns if column not in (*axes, "seed")]
        of_curves = ("converged", "f_plus") if figure.overlays else ()
        needed = {
            "value": [figure.value],
            "overlays": [f"{figure.x.split('.')[1]}.{name}" for name in of_curves],
            "theory": [] if figure.theory is None else signal_size_columns(figure.value),
        }
        for key, names in needed.items():
            for name in names:
                if name not in metrics:
                    raise InputError(f"figures[{i}].{key}: {explain_missing_metric(name, config.build(), metrics)}")
        check_selection(config, figure, i)
