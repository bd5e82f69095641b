"""matplotlib's drawing of figures: PNG files, and SVG for pages."""

import base64
import contextlib
import textwrap
import warnings
from collections.abc import Iterator, Sequence
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, LogNorm, Normalize
from matplotlib.figure import Figure as Canvas
from matplotlib.layout_engine import TightLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from jaxbl.json_types import JsonObject

from .panels import (
    BLACK,
    MISSING,
    Band,
    Bars,
    Figure,
    Line,
    Map,
    Panel,
    Scale,
    Span,
    describe_panel,
    panel_json,
    round_ticks,
    thin,
    tick_text,
)

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
    # of figures that are made elsewhere under these settings
    "figure.constrained_layout.use": True,
    "savefig.dpi": 150,
    "svg.fonttype": "path",
    # names are no mathematics
    "text.parse_math": False,
}
_NAME, _HALO, _NAME_SIZE = "#111111", "#fefefe", 8.5
"""Of names that are written along lines: colours, and size in points."""
_INK = (
    (BLACK, "currentColor"), (_NAME, "currentColor"), ("#ffffff", "var(--paper)"), (_HALO, "var(--back)"),
    ("#dddddd", "var(--grid)"),
)  # fmt: skip
"""Colours of a drawing that follow the page's."""
_DARK = """svg { color: #000000; --paper: #ffffff; --back: #ffffff; --grid: #dddddd; fill: currentColor }
@media (prefers-color-scheme: dark) { svg { color: #e8e8ea; --paper: transparent; --back: #17181b; --grid: #43464c }
  .cloud { filter: brightness(1.9) } }
</style>"""
_LETTER, _ROW, _KEY = 0.075, 0.19, 0.5
"""Width of a letter of a legend, height of a row, and width of what stands before a name, inches."""


class Picture(NamedTuple):
    """A figure as a page shows it.

    Attributes:
        svg: the drawing.
        size: width and height, CSS pixels.
        caption: what it shows.
        described: caption, axes with their ranges, and names of lines: the text in its place.
        panels: where each of its axes lies, and its numbers (:func:`jaxbl.report.panels.panel_json`).
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


@contextlib.contextmanager
def style() -> Iterator[None]:
    """The settings that figures are made under; also a decorator of what makes them."""
    with mpl.rc_context(_SETTINGS), warnings.catch_warnings():
        # a name may have letters that the font lacks, drawn as boxes
        warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)
        yield


@style()
def save_canvas(canvas: Canvas, path: Path) -> Path:
    """Write what matplotlib has drawn as PNG, making its folder. Returns the path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    canvas.savefig(path, format="png")
    return path


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG, making its folder. Returns the path."""
    return save_canvas(draw_canvas(figure)[0], path)


@style()
def picture(figure: Figure, path: Path | None = None) -> Picture:
    """Return a figure as a page shows it, and write it as PNG into a file, if one is given."""
    canvas, axes = draw_canvas(figure)
    if path is not None:
        save_canvas(canvas, path)
    file = BytesIO()
    # names of its parts must not be those of another figure, and are the same each time
    with mpl.rc_context({"svg.hashsalt": figure.name}):
        canvas.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    svg = file.getvalue().decode()
    for colour, follows in _INK:
        svg = svg.replace(f": {colour}", f": {follows}")
    if not _scales(figure.panels):
        # dots that are drawn as an image, which cannot follow the page's colours
        svg = svg.replace("<image ", '<image class="cloud" ')
    panels, texts = [], [figure.caption]
    for ax, panel in zip(axes, figure.panels, strict=True):
        place, ends = ax.get_position(), (ax.get_xlim(), ax.get_ylim())
        panels.append(panel_json(panel, (place.x0, 1.0 - place.y1, place.width, place.height), ends))
        texts.append(describe_panel(panel, ends))
    width, height = (round(96 * inches) for inches in canvas.get_size_inches())
    return Picture(svg.replace("</style>", _DARK, 1).encode(), (width, height), figure.caption, " ".join(texts[:7]), panels)


@style()
def draw_canvas(figure: Figure) -> tuple[Canvas, list[Axes]]:
    """Draw a figure. Returns it, and the axes of its panels."""
    panels, columns = figure.panels, figure.columns
    rows = -(-len(panels) // columns)
    names = [_legend_handles(panel) for panel in panels]
    scales = _scales(panels)
    shared = len(scales) == 1
    # one legend for all panels where one of them has all names, for maps, and where a second scale stands above
    below = {name: handle for handles in names for name, handle in handles.items()}
    if not scales and len(below) > max(map(len, names)) and not any(panel.x.ratio for panel in panels):
        below = {}
    fit, height = _size_legend(below, figure.width)
    foot = height + 0.1 if below else 0.0
    canvas = Canvas(figsize=(figure.width, figure.height * rows + foot), layout="none")  # pyright: ignore[reportArgumentType]
    grid = canvas.add_gridspec(rows, columns + shared, width_ratios=[*[1.0] * columns, *[0.035 * columns] * shared])
    axes, axes_by_axis = [], {}
    for i, panel in enumerate(panels):
        how = {f"share{name}": axes_by_axis.get((name, axis)) for name, axis in panel.axes.items() if axis.label}
        ax = canvas.add_subplot(grid[i // columns, i % columns], **how)
        axes_by_axis |= dict.fromkeys(panel.axes.items(), ax)
        axes.append(ax)
        _draw_panel(ax, panel)
        above = 0.0 if below else _legend_above(ax, names[i], figure.width / columns)
        ax.set_title(panel.title, loc="left", pad=6.0 + 72.0 * above)
        # the panels below and on the left, on which the same axis stands
        neighbours = {"x": panels[i + columns :][:1], "y": panels[i - 1 : i] if i % columns else ()}
        for name, axis in panel.axes.items():
            if axis.label and any(neighbour.axes[name] == axis for neighbour in neighbours[name]):
                ax.tick_params(axis=name, labelbottom=False, labelleft=False)  # type: ignore[arg-type]
                ax.set(**{f"{name}label": ""})
        if not shared:
            for scale in _scales([panel]):
                _draw_bar(canvas, scale, ax=ax)
    if shared:
        _draw_bar(canvas, scales[0], cax=canvas.add_subplot(grid[:, columns]))
    if below:
        canvas.legend(below.values(), below, loc="lower center", ncols=fit)
    # before each drawing: what writes SVG would lay out anew, without room for the legend below
    canvas.set_layout_engine(TightLayoutEngine(pad=0.5, rect=(0.0, foot / canvas.get_figheight(), 1.0, 1.0)))
    return canvas, axes


def _scales(panels: Sequence[Panel]) -> list[Scale]:
    """Scales of maps that have a colour bar."""
    maps = (part for panel in panels for part in panel.parts if isinstance(part, Map) and part.scale.label)
    return list(dict.fromkeys(part.scale for part in maps))


def _size_legend(handles: dict[str, Any], width: float) -> tuple[int, float]:
    """Columns of a legend, and its height, inches."""
    fit = max(min(int(width / (_LETTER * max(map(len, handles), default=1) + _KEY)), len(handles)), 1)
    return fit, _ROW * -(-len(handles) // fit)


def _legend_above(ax: Axes, handles: dict[str, Any], width: float) -> float:
    """Draw a legend above the axes, where it hides no line. Returns its height, inches."""
    fit, height = _size_legend(handles, width - 0.6)
    if handles:
        ax.legend(
            handles.values(), handles, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=fit, borderaxespad=0.1,
            columnspacing=1.2,
        )  # fmt: skip
    return height


def _draw_bar(canvas: Canvas, scale: Scale, **where: Any) -> None:
    """Draw the colour bar of a scale."""
    label = "\n".join(textwrap.wrap(scale.label, 44))
    bar = canvas.colorbar(ScalarMappable(_norm(scale), scale.colours), label=label, **where)
    bar.outline.set_visible(False)  # type: ignore[operator]
    if scale.log:
        _set_log_ticks(bar.ax.yaxis, (scale.low, scale.high))


def _norm(scale: Scale) -> Normalize:
    return (LogNorm if scale.log else Normalize)(scale.low, scale.high)


def _set_log_ticks(axis: Any, ends: Sequence[float]) -> None:
    places = round_ticks(*ends)
    axis.set_ticks(places, map(tick_text, places))
    # the many small ticks take longer than all else in a figure
    axis.set_ticks([], minor=True)


def _draw_panel(ax: Axes, panel: Panel) -> None:
    """Draw the parts of a panel, and set up its axes."""
    for name, axis in panel.axes.items():
        ax.set(**{f"{name}label": axis.label, f"{name}scale": "log" if axis.log else "linear"})
        if axis.ends is not None:
            ax.set(**{f"{name}lim": axis.ends})
    width, height = np.divide(ax.bbox.size, ax.figure.dpi)
    ticks = {"x": int(np.clip(1.4 * width, 2, 8)), "y": int(np.clip(2.5 * height, 2, 6))}
    # those that are held on the edge of the axes last, as these have to be known
    for layer, part in enumerate(sorted(panel.parts, key=lambda part: getattr(part, "held", False))):
        _DRAWERS[type(part)](ax, thin(part), 1.0 + layer / len(panel.parts))
    _name_lines(ax, [part for part in panel.parts if isinstance(part, Line) and part.at_line and len(part.x) > 1])
    ax.grid(not any(isinstance(part, Map) for part in panel.parts))
    for name, axis in panel.axes.items():
        drawn = getattr(ax, f"{name}axis")
        if axis.names:
            drawn.set_ticks(*zip(*axis.names, strict=True))
            drawn.grid(False)
        elif axis.log:
            _set_log_ticks(drawn, drawn.get_view_interval())
        else:
            drawn.set_major_locator(MaxNLocator(ticks[name], steps=[1, 2, 5, 10]))
        if axis.ratio is not None:
            _draw_ratio(drawn, *axis.ratio)


def _draw_ratio(axis: Any, unit: float, label: str) -> None:
    """Draw the second scale of an axis, on the top or on the right."""
    name, scales = axis.axis_name, (lambda values: values / unit, lambda values: values * unit)
    second = getattr(axis.axes, f"secondary_{name}axis")({"x": "top", "y": "right"}[name], functions=scales)
    second_axis = getattr(second, f"{name}axis")
    second_axis.set_label_text(label)
    _set_log_ticks(second_axis, axis.get_view_interval() / unit)


def _line_look(line: Line) -> dict[str, Any]:
    return {
        "ls": line.dashes if line.width else "", "lw": line.width, "color": line.colour, "marker": line.marker,
        "ms": line.size, "mfc": line.fill or line.colour, "mew": 1.1 if line.fill else 1.0,
        "mec": line.colour if line.marker in "x|+" or line.fill else "none",
    }  # fmt: skip


def _draw_line(ax: Axes, line: Line, layer: float) -> None:
    if line.held:
        x, y = np.clip(np.transpose([line.x, line.y]), ax.viewLim.min, ax.viewLim.max).T
        line = line._replace(x=x, y=y)
    look = _line_look(line) | {"alpha": line.opacity, "zorder": layer, "clip_on": not line.held}
    (artist,) = ax.plot(line.x, line.y, **look)
    # one by one, markers would be larger than an image of them
    artist.set_rasterized(bool(line.marker) and len(line.x) > 800)
    place: Any = {"xytext": (6, 0), "textcoords": "offset points"} if line.marker else {"ha": "center"}
    for x, y, text in zip(line.x, line.y, line.texts):  # noqa: B905
        ax.annotate(text, (x, y), va="center", fontsize=8, zorder=6, **place)


def _name_lines(ax: Axes, lines: Sequence[Line]) -> None:
    """Write the names of lines along them, each where its line is farthest from the others."""
    paths = [_follow(ax, line) for line in lines]
    for line, path in zip(lines, paths, strict=True):
        # half of its length, at 5 points a letter, on both sides of a place where the line is nearly straight
        room = 2.5 * len(line.name) * ax.figure.dpi / 72.0
        half = int(np.clip(room / max(np.hypot(*(path[1] - path[0])), 1e-9), 1, (len(path) - 1) // 2))
        first, middle, last = path[: -2 * half], path[half:-half], path[2 * half :]
        across, up = np.abs(last - first).T
        margin = np.array([room, 2.0 * _NAME_SIZE])
        fit = ((middle > ax.bbox.min + margin) & (middle < ax.bbox.max - margin)).all(axis=1) & (up < across)
        beside = np.concatenate([[2 * [np.inf]], *(neighbour for neighbour in paths if neighbour is not path)])
        apart = np.hypot(*(middle[:, None] - beside).transpose(2, 0, 1)).min(axis=1).clip(max=10.0 * _NAME_SIZE)
        worth = np.where(fit, apart - 4.0 * np.hypot(*(middle - 0.5 * (first + last)).T), -np.inf)
        if fit.any():
            i = int(np.argmax(worth))
            turn = float(np.arctan2(*(last - first)[i, ::-1]))
            ax.annotate(
                line.name, tuple(ax.transData.inverted().transform(middle[i])),
                (-3.0 * np.sin(turn), 3.0 * np.cos(turn)),
                textcoords="offset points", fontsize=_NAME_SIZE, ha="center", va="bottom", zorder=6, color=_NAME,
                rotation=np.degrees(turn), rotation_mode="anchor",
                path_effects=[withStroke(linewidth=2.5, foreground=_HALO)],
            )  # fmt: skip


def _follow(ax: Axes, line: Line) -> np.ndarray:
    """Places along a line in pixels, evenly, shape (places, 2); what is far outside of the axes is nearer."""
    with np.errstate(all="ignore"):
        path = ax.transData.transform(np.column_stack([line.x, line.y]))
    path = np.clip(np.nan_to_num(path), *ax.bbox.padded(100.0).get_points())
    way = np.r_[0.0, np.cumsum(np.hypot(*np.diff(path, axis=0).T))]
    return np.transpose([np.interp(np.linspace(0.0, way[-1], 301), way, places) for places in path.T])


def _draw_band(ax: Axes, band: Band, layer: float) -> None:
    ax.fill_between(band.x, band.low, band.high, color=band.colour, alpha=band.opacity, lw=0.0, zorder=layer)


def _draw_span(ax: Axes, span: Span, layer: float) -> None:
    lines, areas = (ax.axvline, ax.axvspan) if span.along == "x" else (ax.axhline, ax.axhspan)
    if span.low == span.high:
        lines(span.low, color=span.colour, lw=span.width, ls=span.dashes, zorder=layer)
    else:
        areas(span.low, span.high, color=span.colour, alpha=span.opacity, lw=0.0, zorder=layer)


def _draw_map(ax: Axes, cells: Map, layer: float) -> None:
    draw = partial(ax.pcolormesh, cells.x, cells.y, rasterized=True, zorder=layer)
    if np.any(cells.failed):
        draw(np.where(cells.failed, 0.0, np.nan), cmap=ListedColormap([MISSING]))
    draw(np.where(cells.failed, np.nan, cells.values), cmap=cells.scale.colours, norm=_norm(cells.scale))


def _draw_bars(ax: Axes, bars: Bars, layer: float) -> None:
    ax.barh(bars.places, bars.lengths, bars.thickness, color=bars.colour, alpha=bars.opacity, zorder=layer)
    for place, length, text in zip(bars.places, bars.lengths, bars.texts):  # noqa: B905
        ax.annotate(f" {text}", (length, place), va="center", fontsize=9)


_DRAWERS: Any = {Line: _draw_line, Band: _draw_band, Span: _draw_span, Map: _draw_map, Bars: _draw_bars}


def _legend_handles(panel: Panel) -> dict[str, Any]:
    """The legend's handle of each name in a panel that does not stand beside its line."""
    handles = {}
    for part in panel.parts:
        is_hidden = part.at_line if isinstance(part, Line) else isinstance(part, Map) and not np.any(part.failed)
        if is_hidden or not part.name or part.name in handles:
            continue
        if isinstance(part, Span) and part.low == part.high:
            part = Line([], [], part.name, part.colour, part.width, part.dashes)
        if isinstance(part, Line):
            handles[part.name] = Line2D([], [], **_line_look(part._replace(size=max(min(part.size, 9.0), 4.0))))
        else:
            handles[part.name] = Patch(color=getattr(part, "colour", MISSING), alpha=getattr(part, "opacity", 1.0), lw=0.0)
    return handles
