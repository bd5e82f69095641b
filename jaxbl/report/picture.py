"""A figure for a page: its drawing as SVG, a text for who cannot see it, and the values that a pointer asks for."""

import base64
import math
from io import BytesIO
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection, QuadMesh
from matplotlib.colors import to_hex
from matplotlib.container import BarContainer
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedFormatter, FuncFormatter

from jaxbl.json_types import JsonObject

from .figures import Drawn, style

_MOST_MARKS = 800
"""Markers of a cloud that are drawn one by one; more become an image."""
_DARK = b"""@media (prefers-color-scheme: dark) {
  svg { fill: #e8e8ea }
  [style*="stroke: #000000"] { stroke: #e8e8ea !important }
  [style*="fill: #000000"] { fill: #e8e8ea !important }
  [style*="fill: #ffffff"] { fill: none !important }
  [style*="stroke: #dddddd"] { stroke: #43464c !important }
}</style>"""
"""Black lines and texts are light, and white is transparent, where the reader has a dark page."""
_MOST_VALUES = 60_000
"""Numbers of a figure that its page holds."""


class Picture(NamedTuple):
    """A figure as a page shows it.

    Attributes:
        svg: the drawing.
        size: width and height, CSS pixels.
        caption: what it shows.
        described: caption, axes with their ranges, and names of lines: the text in its place.
        panels: where each of its axes lies, their scales, and the values of lines and cells (:func:`_panel`).
    """

    svg: bytes
    size: tuple[int, int]
    caption: str
    described: str
    panels: list[JsonObject]

    @property
    def source(self) -> str:
        """The drawing as an address that holds it."""
        return f"data:image/svg+xml;base64,{base64.b64encode(self.svg).decode()}"


@style()
def picture(drawn: Drawn) -> Picture:
    """A figure that was laid out (:func:`jaxbl.report.figures.save`) as a page shows it."""
    figure = drawn.figure
    bars = {ax for ax in figure.axes if getattr(ax, "_colorbar", None) is not None}
    axes = [ax for ax in figure.axes if ax.get_visible() and ax not in bars]
    for ax in axes:
        for artist in ax.get_children():
            if _count_marks(artist) > _MOST_MARKS:
                # one by one they would be larger than an image of them
                artist.set_rasterized(True)
    file = BytesIO()
    # names of its parts must not be those of another figure, and are the same each time
    with mpl.rc_context({"svg.hashsalt": drawn.name, "svg.fonttype": "path"}):
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    width, height = (round(96 * inches) for inches in figure.get_size_inches())
    value = next((_plain(bar.get_ylabel() or bar.get_xlabel()) for bar in bars), None)
    # of the points of each line every n-th is kept, so that a page stays small
    count = sum(len(_xy(line)) for ax in axes for line in _lines(ax))
    step = max(math.ceil(2 * count / _MOST_VALUES), 1)
    panels = [_panel(figure, ax, value, step) for ax in axes]
    described = " ".join([drawn.caption, *map(_describe, panels[:6])])
    svg = file.getvalue().replace(b"</style>", _DARK, 1)
    return Picture(svg, (width, height), drawn.caption, described, panels)


def _count_marks(artist: Any) -> int:
    """Markers that an artist draws."""
    if isinstance(artist, Line2D) and artist.get_marker() not in ("None", "", " ", None):
        return len(_xy(artist))
    return len(np.asarray(artist.get_offsets())) if isinstance(artist, PathCollection) else 0


def _xy(line: Line2D) -> np.ndarray:
    """Points `(points, 2)` of a line, nan where there is none."""
    return np.ma.filled(np.ma.asarray(line.get_xydata(), float), np.nan)


def _lines(ax: Axes) -> list[Line2D]:
    """Lines of values, not those that only mark a place."""
    return [line for line in ax.get_lines() if line.get_transform() == ax.transData and len(_xy(line))]


def _panel(figure: Figure, ax: Axes, value: str | None, step: int) -> JsonObject:
    """The numbers that a page needs to read values off axes.

    Place (left, top, width, height) as shares of the figure; label, ends, scale and named ticks of both axes; lines (names,
    x and y); the cells of a map (edges along x and y, values by row); bars (left, bottom, width, height).
    """
    place = ax.get_position()
    panel: JsonObject = {
        "place": [round(float(number), 5) for number in (place.x0, 1.0 - place.y1, place.width, place.height)],
        "title": _plain(ax.get_title() or ax.get_title("left")).replace("\n", ", "),
    }
    for name, shared in (("x", ax.get_shared_x_axes()), ("y", ax.get_shared_y_axes())):
        panel[name] = _axis(getattr(ax, f"{name}axis"))
        # shared axes are named once, on the outer panels
        siblings = shared.get_siblings(ax)
        labels = (getattr(other, f"get_{name}label")() for other in figure.axes if other in siblings)
        panel[name]["label"] = panel[name]["label"] or next((_plain(label) for label in labels if label), "")
    panel["lines"] = [_line(line, step) for line in _lines(ax)]
    # without a colour bar cells are a cloud behind lines
    mesh = next((mesh for mesh in ax.collections if isinstance(mesh, QuadMesh)), None)
    if mesh is not None and value is not None:
        corners = np.asarray(mesh.get_coordinates())
        cells = np.ma.filled(np.ma.masked_invalid(np.ma.asarray(mesh.get_array(), float)), np.nan)
        if cells.size <= _MOST_VALUES and cells.ndim == 2:
            edges = {"x": packed(corners[0, :, 0]), "y": packed(corners[:, 0, 1])}
            panel["cells"] = {"name": value, **edges, "values": packed(cells.ravel())}
    # those of bar charts and histograms of bars, not what marks a stretch of an axis
    bars = [
        (*bar.get_xy(), bar.get_width(), bar.get_height())
        for container in ax.containers
        if isinstance(container, BarContainer)
        for bar in container.patches
    ]
    panel["bars"] = [[float(f"{number:.6g}") for number in bar] for bar in bars if np.all(np.isfinite(bar))]
    return panel


def _axis(axis: Any) -> JsonObject:
    content: JsonObject = {
        "label": _plain(axis.label.get_text()).replace("\n", " "),
        "ends": [float(f"{end:.8g}") for end in axis.get_view_interval()],
        "log": axis.get_scale() == "log",
    }
    if isinstance(axis.get_major_formatter(), FixedFormatter | FuncFormatter):
        texts = [_plain(label.get_text()).replace("\n", ", ") for label in axis.get_majorticklabels()]
        ticks = zip(axis.get_majorticklocs(), texts, strict=False)
        content["names"] = [[float(place), text] for place, text in ticks if text]
    return content


def _line(line: Line2D, step: int) -> JsonObject:
    label = str(line.get_label())
    x, y = _xy(line)[::step].T
    return {
        "name": "" if label.startswith("_") else _plain(label),
        "colour": to_hex(line.get_color() if line.get_linestyle() != "None" else line.get_markerfacecolor()),
        "x": packed(x),
        "y": packed(y),
        "sorted": bool(np.all(np.diff(x) >= 0.0)),
    }


_LARGEST = float(np.finfo(np.float32).max)


def packed(values: Any) -> str:
    """Numbers for a page: float32, little-endian, in base64; the largest where they are larger."""
    clipped = np.clip(np.asarray(values, float), -_LARGEST, _LARGEST)
    return base64.b64encode(clipped.astype("<f4").tobytes()).decode()


def _plain(text: str) -> str:
    """A label as a reader without mathematical type has it."""
    return text.replace(r"\$", "$")


def _describe(panel: JsonObject) -> str:
    """One panel in words."""
    head = f"{panel['title']}: " if panel["title"] else ""
    axes = [
        f"{name} {axis['label'] or 'without a name'} from {axis['ends'][0]:.3g} to {axis['ends'][1]:.3g}"
        f"{' (logarithmic)' if axis['log'] else ''}"
        for name in ("x", "y")
        if not (axis := panel[name]).get("names")
    ]
    names = [line["name"] for line in panel["lines"] if line["name"]]
    drawn = f" Lines: {', '.join(dict.fromkeys(names))}." if names else ""
    return f"{head}{'; '.join(axes)}.{drawn}" if axes else ""
