"""Selection of a figure's rows: the values of the axes that its `where` fixes."""

# pandas' own annotations are wider than what its methods return
# pyright: reportReturnType=false

import math
from typing import Any

import numpy as np
import pandas as pd

from jaxbl.errors import InputError
from jaxbl.validation import suggest_word

from .study import Config
from .sweep import AxisTable, FigureTable


def check_selection(config: Config, figure: FigureTable, index: int) -> None:
    """Check that `where` names values of axes, and that each line with a `theory` is a single one.

    Args:
        config: the study.
        figure: a figure of it.
        index: of the figure, for the message.

    Raises:
        InputError: `where` names no axis or no value of one, or `theory` asks for a fit to several lines at once.
    """
    fixed = resolve_where(config, figure, index)
    if figure.theory is None:
        return
    if figure.value.rpartition(".")[2] in ("finite", "converged"):
        raise InputError(f"figures[{index}].theory: '{figure.value}' is true or false and has no slope; leave theory out")
    paths = {path for path in (figure.x, figure.series, figure.facet, *fixed) if path is not None}
    labels = {axis.zip for axis in config.axes if axis.path in paths and axis.zip}
    for axis in config.axes:
        is_constant = axis.values is not None and len(axis.values) == 1
        if axis.path not in paths and axis.zip not in labels and not is_constant:
            raise InputError(
                f"figures[{index}].theory: a fit needs single lines, and '{axis.path}' varies along them; "
                "fix it by where, series or facet"
            )


def resolve_where(config: Config, figure: FigureTable, index: int = 0) -> dict[str, Any]:
    """Resolve a figure's `where` to values that the axes have.

    Args:
        config: the study.
        figure: a figure of it.
        index: of the figure, for the message.

    Returns:
        Values by path. 'least' and 'largest' become numbers.

    Raises:
        InputError: no such axis, or no such value of it.
    """
    fixed = {}
    for path, choice in (figure.where or {}).items():
        key = f"figures[{index}].where"
        axis = find_axis(config, path, key)
        if axis.values is None and axis.num is None:
            raise InputError(
                f"{key}: '{path}' is sampled quasi-randomly and repeats no value; fix an axis with num or values"
            )
        values = axis.grid()
        if values.dtype == object:
            if choice not in values.tolist():
                raise InputError(f"{key}: '{path}' has no value {choice!r}; {suggest_word(str(choice), map(str, values))}")
            fixed[path] = choice
        elif choice in ("least", "largest"):
            fixed[path] = float(values.min() if choice == "least" else values.max())
        elif isinstance(choice, str):
            raise InputError(f"{key}: '{path}' has no value {choice!r}; use a number, 'least' or 'largest'")
        else:
            nearest = float(values[np.argmin(np.abs(values - choice))])
            if not math.isclose(nearest, choice, rel_tol=1e-9):
                raise InputError(f"{key}: '{path}' has no value {choice:g}; the nearest is {nearest:g}")
            fixed[path] = nearest
    return fixed


def find_axis(config: Config, path: str, key: str) -> AxisTable:
    """Return the axis with a path that the figure's `key` names. Raises `InputError` if the study has no such axis."""
    axes = {axis.path: axis for axis in config.axes}
    if path not in axes:
        hint = suggest_word(path, axes) if axes else "the study has no axes"
        raise InputError(f"{key}: '{path}' is not an axis of this study; {hint}")
    return axes[path]


def filter_rows(frame: pd.DataFrame, fixed: dict[str, Any]) -> pd.DataFrame:
    """The rows of a table that have the fixed values, by path; numbers may differ by a relative 1e-9."""
    keep = np.ones(len(frame), dtype=bool)
    for path, value in fixed.items():
        column = frame[path].to_numpy()
        keep &= column == value if isinstance(value, str) else np.isclose(column.astype(float), value, rtol=1e-9, atol=0.0)
    return frame[keep]
