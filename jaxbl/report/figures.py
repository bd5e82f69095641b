"""What figures share: how they look, their axes, names and files, and long signals in few points."""

import contextlib
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.layout_engine import TightLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch as Patch
from matplotlib.ticker import NullLocator

from jaxbl.errors import escape_unprintable, shorten

SIDES = ("motor", "load")
Pair = tuple[float, float]
"""Two numbers: ends of an axis, or a place."""

# Okabe and Ito, in an order that also parts in grey
BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK = COLOURS = (
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000",
)  # fmt: skip
SIDE_COLOURS = {"motor": BLUE, "load": VERMILION}
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
MAP = "viridis"
MISSING = "#BDBDBD"
FAINT = "#8C8C8C"
"""Grey of zero lines, arrows and clouds of points behind a line."""
LINE_POINTS = 2400
"""Points of a line: a page is about 1000 pixels wide, and each pixel needs a least and a largest value."""

_SETTINGS: Any = {
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.labelsize": 10,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#DDDDDD",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "lines.linewidth": 1.4,
    "figure.constrained_layout.use": True,
    "savefig.dpi": 150,
    "axes.prop_cycle": cycler(color=COLOURS),
}


class Drawn(NamedTuple):
    """A figure, its file name without ending, and its caption."""

    name: str
    figure: Figure
    caption: str


@contextlib.contextmanager
def style() -> Iterator[None]:
    """The settings that figures are made under; also a decorator of what makes them."""
    with mpl.rc_context(_SETTINGS), warnings.catch_warnings():
        # a name may have letters that the font lacks, drawn as boxes
        warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)
        yield


def with_unit(label: str, unit: str) -> str:
    """A label with its unit in brackets, if it has one."""
    return f"{label} ({unit})" if unit else label


def missing_quantity(unit: str) -> str:
    """The quantity that has a unit of torque, or of force on a linear axis."""
    return "force" if unit == "N" else "torque"


def missing_label(lead: str, unit: str) -> str:
    """The label of what a model lacks of torques or forces."""
    return with_unit(f"{lead}missing {missing_quantity(unit)}", unit)


_LONGEST_NAME = 40
"""Characters of a name in a figure: a legend with more leaves no room for the axes."""


def literal(name: str) -> str:
    """A name that a user chose, as text of a figure: no mathematics, one line, not too long."""
    return shorten(escape_unprintable(name), _LONGEST_NAME).replace("$", r"\$")


@style()
def save(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG, making its folder. Returns the path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lay_out(figure)
    figure.savefig(path, format="png")
    return path


@style()
def lay_out(figure: Figure) -> None:
    """Find room for texts once: an engine of matplotlib's own, where a figure has one, does so twice, and before each
    drawing."""
    if figure.get_layout_engine() is not None:
        return
    width, height = figure.get_size_inches()
    figure.subplots_adjust(_MARGIN / width, _MARGIN / height, 1.0 - 0.2 * _MARGIN / width, 1.0 - 0.5 * _MARGIN / height)
    begins: dict[Axes, float] = {ax: ax.bbox.x0 for ax in figure.axes}
    engine: Any = TightLayoutEngine(pad=_PAD, rect=None)  # type: ignore[arg-type]
    engine.execute(figure)
    # labels of y one above the other; those that stay where they are need no search for room when they are drawn
    places = {ax: ax.yaxis.label.get_position()[0] - begin for ax, begin in begins.items() if ax.get_ylabel()}
    columns = max((ax.get_subplotspec().get_gridspec().ncols for ax in begins if ax.get_subplotspec()), default=2)  # type: ignore[union-attr]
    for ax in places if columns == 1 else ():
        ax.yaxis.set_label_coords(min(places.values()) / ax.bbox.width, 0.5)


_MARGIN, _PAD = 0.7, 0.5
"""Margins from which a layout begins, inches, as ticks depend on the size; and room between texts, over the font's size."""


def subplots(
    width: float, height: float, rows: int = 1, columns: int = 1, *, beside: bool = False, **how: Any
) -> tuple[Figure, list[Axes]]:
    """A figure of so many inches, and its axes row by row; `beside`: with colour bars or legends beside the axes; `how` is
    matplotlib's."""
    layout: Any = "constrained" if beside else "none"
    figure = Figure(figsize=(width, height), layout=layout)
    axes = figure.subplots(rows, columns, squeeze=False, **how).ravel().tolist()
    if beside and columns == 1:
        figure.align_ylabels(axes)
    return figure, axes


def arrange(count: int) -> tuple[int, int]:
    """Rows and columns of so many panels."""
    columns = 2 if count == 4 else min(count, 3)
    return -(-count // columns), columns


def stacked(
    count: int, height: float, xlabel: str = "time (s)", *, width: float = 9.0, sharex: bool = True
) -> tuple[Figure, list[Axes]]:
    """A figure of axes one above the other, each so many inches high, and what the lowest says of x."""
    figure, axes = subplots(width, height * count + 0.6, count, sharex=sharex)
    axes[-1].set_xlabel(xlabel)
    return figure, axes


def decades(ax: Axes, names: str = "both") -> None:
    """Plain numbers at the decades of logarithmic axes, and nothing between: powers in mathematical type, and the many small
    ticks, take longer than all else in a figure."""
    for name, axis in (("x", ax.xaxis), ("y", ax.yaxis)):
        if names in (name, "both"):
            axis.set_major_formatter("{x:g}")
            axis.set_minor_locator(NullLocator())


def legend(ax: Axes, columns: int = 1, of: Sequence[Axes] = (), **how: Any) -> None:
    """A legend above the axes, where it hides no line, with each label (also of the axes `of`) once."""
    named = {}
    for other in of or (ax,):
        handles, labels = other.get_legend_handles_labels()
        named |= dict(zip(labels, handles, strict=True))
    place: Any = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.1, "columnspacing": 1.2}
    ax.legend(named.values(), named.keys(), ncols=columns, **place | how)


def legend_below(figure: Figure, handles: Sequence[Any] | None = None, columns: int = 3) -> None:
    """Put a legend below all axes."""
    figure.legend(handles=handles, loc="outside lower center", ncols=columns)


def colour_bar(figure: Figure, axes: Any, norm: Normalize, label: str = "", colours: Any = MAP, **how: Any) -> Colorbar:
    """Put a colour bar beside axes; `how` is matplotlib's."""
    return figure.colorbar(ScalarMappable(norm, colours), ax=axes, **{"pad": 0.02, "aspect": 28, "label": label} | how)


def draw_zero(ax: Axes, zorder: float = 2.0) -> None:
    """Draw a faint line at y = 0."""
    ax.axhline(0.0, color=FAINT, lw=0.8, zorder=zorder)


def shade_gap(ax: Axes, half: float, label: str) -> None:
    """Shade the gap of a transmission over its twist, behind all else; `half` of it lies on either side of 0."""
    ax.axvspan(-half, half, color="#F3E3A1", alpha=0.6, lw=0.0, zorder=0, label=label)


def write_inside(ax: Axes, text: str, **how: Any) -> None:
    """Write into the middle of axes that have nothing to show."""
    ax.text(0.5, 0.5, text, ha="center", transform=ax.transAxes, **how)


def mark(ax: Axes, place: Pair, marker: str, label: str, size: float, colour: str = "white", held: bool = True) -> Line2D:
    """Mark a point; if `held`, on the edge of the axes where it lies outside. Returns the legend's handle."""
    x, y = place
    if held:
        x, y = np.clip(x, *ax.get_xlim()), np.clip(y, *ax.get_ylim())
    look: dict[str, Any] = {"ls": "", "marker": marker, "mfc": colour, "mec": "black", "mew": 1.2}
    ax.plot(x, y, clip_on=False, zorder=6, ms=size, **look)
    off = "" if np.allclose((x, y), place) else ", off the map"
    return Line2D([], [], label=f"{label}{off}", ms=min(size, 10.0), **look)


def outline(values: np.ndarray, points: int = LINE_POINTS, share: float = 1.0) -> np.ndarray:
    """Indices that draw the same line: all, or least and largest of each bin of a signal of over `2 * points` samples.

    Of a line in several parts, each has its share of the points.
    """
    points = max(int(share * points), 8)
    if len(values) <= 2 * points:
        return np.arange(len(values))
    size = -(-len(values) // (points // 2))
    padded = np.pad(np.asarray(values, float), (0, -len(values) % size), constant_values=np.nan)
    bins = padded.reshape(-1, size)
    ends = [
        np.argmin(np.where(np.isnan(bins), np.inf, bins), axis=1),
        np.argmax(np.where(np.isnan(bins), -np.inf, bins), axis=1),
    ]
    samples = np.arange(len(bins)) * size + np.sort(ends, axis=0)
    return np.minimum(samples.T.ravel(), len(values) - 1)


def stretches(there: Any) -> list[tuple[int, int]]:
    """First, and one after the last, index of each stretch that is true."""
    steps = np.flatnonzero(np.diff(there, prepend=False, append=False))
    return list(zip(steps[::2], steps[1::2], strict=True))


def limits(*values: np.ndarray, share: float = 0.001, room: float = 0.12, shown: Sequence[float] = ()) -> Pair | None:
    """Ends of an axis that a few outliers do not set; None (matplotlib's own ends) where no value is finite.

    `share` of the values may lie outside at each end, `room` is added there as a share of the span, and `shown` lie inside
    in any case.
    """
    finite = np.concatenate(values)
    finite = finite[np.isfinite(finite)]
    if not len(finite):
        return None
    low, high = np.quantile(finite, [share, 1.0 - share])
    low, high = min(low, high, *shown), max(low, high, *shown)
    margin = room * (high - low) or 1e-12 + 0.1 * abs(high)
    return float(low - margin), float(high + margin)
