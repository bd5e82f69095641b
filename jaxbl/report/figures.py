"""Figures before they are placed on a page: names and captions, files, and long signals in few points."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from .style import style

SIDES = ("motor", "load")
LINE_POINTS = 2400
"""Points of a line: a page is about 1000 pixels wide, and each pixel needs a least and a largest value."""


class Drawn(NamedTuple):
    """A figure, its file name without ending, and its caption."""

    name: str
    figure: Figure
    caption: str


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG, making its folder. Returns the path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with style():
        figure.savefig(path)
    return path


def stacked_axes(rows: int, height: float, width: float = 9.0, sharex: bool = True):
    """A figure of axes one above the other. Returns the figure and a flat array of its axes.

    Args:
        rows: number of axes.
        height: of each, in inches.
        width: of the figure, in inches.
        sharex: one time axis for all.
    """
    figure = Figure(figsize=(width, height * rows + 0.6), layout="constrained")
    axes = figure.subplots(rows, 1, sharex=sharex, squeeze=False).ravel()
    figure.align_ylabels(axes)
    return figure, axes


def outline(values: np.ndarray, points: int = LINE_POINTS) -> np.ndarray:
    """Indices `(n,)` that draw the same line: all of a short signal, least and largest of each bin of a long one.

    Args:
        values: a signal `(samples,)`; NaN is skipped.
        points: about as many indices are returned where the signal has more than twice as many samples.
    """
    if len(values) <= 2 * points:
        return np.arange(len(values))
    size = -(-len(values) // (points // 2))
    padded = np.full(-(-len(values) // size) * size, np.nan)
    padded[: len(values)] = values
    bins = padded.reshape(-1, size)
    ends = [
        np.argmin(np.where(np.isnan(bins), np.inf, bins), axis=1),
        np.argmax(np.where(np.isnan(bins), -np.inf, bins), axis=1),
    ]
    at = np.arange(len(bins)) * size + np.sort(ends, axis=0)
    return np.minimum(at.T.ravel(), len(values) - 1)


def limits(
    *values: np.ndarray, share: float = 0.001, room: float = 0.12, shown: Sequence[float] = ()
) -> tuple[float, float] | None:
    """Ends of an axis that a few outliers do not set; None where no value is finite.

    Args:
        values: signals to be drawn, in the axis's unit.
        share: of the values that may lie outside at each end.
        room: added at each end, as a share of the span.
        shown: values that lie inside in any case.
    """
    finite = np.concatenate([one[np.isfinite(one)] for one in values])
    if not len(finite):
        return None
    low, high = np.quantile(finite, [share, 1.0 - share])
    low, high = min((low, *shown)), max((high, *shown))
    margin = room * (high - low) or 1e-12 + 0.1 * abs(high)
    return float(low - margin), float(high + margin)
