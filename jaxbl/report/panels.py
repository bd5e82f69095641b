"""Figures as data: panels of lines, bands, maps and bars, in words and units, without matplotlib.

:mod:`jaxbl.report.drawing` draws them as PNG and SVG; a page gets the same numbers as JSON.
"""

import base64
import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxbl.errors import escape_unprintable, shorten
from jaxbl.files import to_jsonable
from jaxbl.json_types import JsonObject

Array = np.ndarray
Pair = tuple[float, float]
"""Two numbers: ends of an axis, or a place."""
SIDES = ("motor", "load")

# Okabe and Ito, in an order that also parts in grey
BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK = COLOURS = (
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000",
)  # fmt: skip
SIDE_COLOURS = defaultdict(lambda: GREEN, {"motor": BLUE, "load": VERMILION})
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
MAP = "viridis"
MISSING = "#BDBDBD"
FAINT = "#8C8C8C"
"""Grey of zero lines and of clouds of points behind a line."""
_LINE_POINTS, _CLOUD_POINTS = 2400, 4000
"""Points of a line (a page is about 1000 pixels wide, and each pixel needs a least and a largest value), and of a cloud,
where more would cover each other."""


class Axis(NamedTuple):
    """An axis of a panel; panels of a figure with equal ones share it.

    Attributes:
        label: words, with the unit.
        key: the path in the config, for a tooltip.
        log: whether it is logarithmic.
        ends: left and right, or lower and upper; left out, those of what is drawn.
        names: places with words in place of numbers.
        ratio: a second scale on the other side: its unit on this one, and its label.
    """

    label: str = ""
    key: str = ""
    log: bool = False
    ends: Pair | None = None
    names: Sequence[tuple[float, str]] = ()
    ratio: tuple[float, str] | None = None


TIME = Axis("time (s)")


def name_rows(names: Sequence[str]) -> Axis:
    """An axis of rows from the top down, each with a name."""
    return Axis(ends=(len(names) - 0.5, -0.5), names=tuple(enumerate(names)))


class Line(NamedTuple):
    """A line through points `(n,)`, NaN where it breaks, or points alone.

    Attributes:
        name: in the legend.
        width: in points; 0 is no line.
        dashes: as matplotlib names them.
        marker, size, fill: of each point, by matplotlib's names; "" is none, and a `fill` of "" the line's colour.
        texts: words beside each point, or on it if there is no marker.
        at_line: whether the name stands beside the line, too.
        held: whether points outside of the axes are drawn on their edge.
    """

    x: Any
    y: Any
    name: str = ""
    colour: str = BLACK
    width: float = 1.4
    dashes: str = "-"
    marker: str = ""
    size: float = 5.0
    fill: str = ""
    opacity: float = 1.0
    texts: Sequence[str] = ()
    at_line: bool = False
    held: bool = False

    @property
    def is_sorted(self) -> bool:
        """True if x does not fall."""
        return bool(np.all(np.diff(self.x) >= 0.0))


class Band(NamedTuple):
    """The area between two curves `(n,)`."""

    x: Any
    low: Any
    high: Any
    name: str = ""
    colour: str = MISSING
    opacity: float = 0.25


class Span(NamedTuple):
    """A stretch of the axis `along`, across the panel; a line where its ends are the same."""

    low: float
    high: float
    name: str = ""
    colour: str = BLACK
    along: str = "x"
    opacity: float = 0.25
    width: float = 1.0
    dashes: str = "--"


class Scale(NamedTuple):
    """Colours of numbers from `low` to `high`, by a name of matplotlib's; beyond its ends they stay the same."""

    low: float
    high: float
    label: str
    log: bool = False
    colours: str = MAP


class Map(NamedTuple):
    """Cells between edges along x and y, of values `(rows, columns)`; NaN is none.

    Attributes:
        failed: cells that are of one grey, whatever they hold.
        name: of these in the legend.
    """

    x: Any
    y: Any
    values: Any
    scale: Scale
    failed: Any = False
    name: str = ""


class Bars(NamedTuple):
    """Lying bars from 0 at places `(n,)`, with words at their ends."""

    places: Any
    lengths: Any
    name: str = ""
    colour: str = BLUE
    thickness: float = 0.6
    opacity: float = 1.0
    texts: Sequence[str] = ()


Part = Line | Band | Span | Map | Bars


class Panel(NamedTuple):
    """One pair of axes: what is drawn, from behind to the front."""

    x: Axis
    y: Axis
    parts: Sequence[Part]
    title: str = ""

    @property
    def axes(self) -> dict[str, Axis]:
        """Both axes, by letter."""
        return {"x": self.x, "y": self.y}


class Figure(NamedTuple):
    """Panels row by row, with a caption.

    Attributes:
        name: of its file, without ending.
        width, height: of the figure, and of each row of panels, inches.
    """

    name: str
    panels: Sequence[Panel]
    caption: str
    columns: int = 1
    width: float = 6.8
    height: float = 3.6


def arrange(count: int) -> int:
    """Columns of so many panels."""
    return 2 if count == 4 else min(count, 3)


def join(axis: Any, parts: Iterable[slice], *signals: Any) -> list[Array]:
    """Values of an axis and of signals over it, part by part, with a NaN between parts where lines break."""
    # the place of a break does not matter, but lines are thinned along it: the last sample once more
    samples = [np.r_[part, part.stop - 1] for part in parts]
    columns = [np.asarray(values, float)[np.concatenate(samples)] for values in (axis, *signals)]
    for column in columns[1:]:
        column[np.cumsum([*map(len, samples)]) - 1] = np.nan
    return columns


def draw_signals(time: Any, segments: Iterable[slice], signals: Sequence[tuple[Any, str, str, str]]) -> list[Panel]:
    """A panel over time for each signal: its values, label, unit and colour; lines break between segments."""
    time, *joined = join(time, segments, *(values for values, *_ in signals))
    return [
        Panel(TIME, Axis(f"{label}\n({unit})"), [Line(time, values, colour=colour, width=0.9)])
        for values, (_, label, unit, colour) in zip(joined, signals, strict=True)
    ]


def intervals(
    places: Any, low: Any, middle: Any, high: Any, name: str = "", *, upright: bool = False, **how: Any
) -> list[Line]:
    """Points with intervals `(n,)`, lying unless `upright`; `how` is of the points (:class:`Line`)."""
    ends = np.column_stack([low, high, np.full(len(low), np.nan)]).ravel()
    bars = Line(ends, np.repeat(places, 3), colour=how.get("colour", BLACK), width=1.8, opacity=0.6)
    lines = [bars, Line(middle, places, name, **{"width": 0.0, "marker": "o"} | how)]
    return [line._replace(x=line.y, y=line.x) for line in lines] if upright else lines


def mark(x: float, y: float, name: str, marker: str = "*", size: float = 14.0) -> Line:
    """A point with a name; on the edge of the axes where it lies outside."""
    return Line([x], [y], name, width=0.0, marker=marker, size=size, fill="#FFFFFF", held=True)


def cloud(x: Any, y: Any, name: str = "", colour: str = FAINT, **how: Any) -> Line:
    """Points of a signal over another one."""
    return Line(x, y, name, colour, **{"width": 0.0, "marker": ".", "size": 2.5, "opacity": 0.5} | how)


ZERO = Span(0.0, 0.0, colour=FAINT, along="y", width=0.8, dashes="-")
"""A faint line at y = 0."""


def shade_gap(half: float, name: str) -> list[Span]:
    """The gap of a transmission over its twist, if it has one; `half` of it lies on either side of 0."""
    return [Span(-half, half, name, "#F3E3A1", opacity=0.6)] if half else []


def thin(part: Part) -> Part:
    """A line or a band with as many points as can be seen: of a signal least and largest of each of its bins, of a path or
    a cloud every n-th."""
    if isinstance(part, Band):
        x, low, high = map(np.asarray, part[:3])
        least, largest = _list_extremes(low, high)
        return part._replace(x=x[least], low=low[least], high=high[largest])
    if not isinstance(part, Line) or len(part.x) <= _LINE_POINTS:
        return part
    x, y = np.asarray(part.x, float), np.asarray(part.y, float)
    if part.width and part.is_sorted:
        rows = np.sort(np.concatenate(_list_extremes(y, y)))
    else:
        count = _CLOUD_POINTS * (2 if part.width else 1)
        rows = np.unique(np.linspace(0, len(x) - 1, min(count, len(x))).astype(int))
    return part._replace(x=x[rows], y=y[rows])


def _list_extremes(low: Array, high: Array) -> list[Array]:
    """Indices of the least of one signal, and of the largest of another, in each bin of the points of a line."""
    size = -(-len(low) // (_LINE_POINTS // 2))
    rows = []
    for values in (low, -high):
        # the first of a bin that is a break, so that it stays one
        there = np.where(np.isnan(values), np.inf, values)
        bins = np.pad(there, (0, -len(values) % size), constant_values=np.inf).reshape(-1, size)
        rows.append(np.arange(len(bins)) * size + bins.argmin(axis=1))
    return rows


def limits(*values: Any, inside: Sequence[float] = ()) -> Pair | None:
    """Ends of an axis that a few outliers do not set; None (those of what is drawn) where no value is finite.

    A thousandth of the values may lie outside at each end, and 12 % of the span is added; `inside` lie within in any case.
    """
    finite = np.concatenate(values)
    finite = finite[np.isfinite(finite)]
    if not len(finite):
        return None
    ends = [*np.quantile(finite, [0.001, 0.999]), *inside]
    low, high = min(ends), max(ends)
    margin = 0.12 * (high - low) or 1e-12 + 0.1 * abs(high)
    return low - margin, high + margin


def round_ticks(low: float, high: float) -> list[float]:
    """Round places on a logarithmic axis: its decades, or of fewer than two 1, 2 and 5 in each."""
    first, last = sorted(map(math.log10, (low, high)))
    leads = (1.0,) if last - first >= 2.0 else (1.0, 2.0, 5.0)
    step = max(math.ceil((last - first) / 8.0), 1)
    decades = range(step * math.floor(first / step), math.ceil(last) + 1, step)
    places = (lead * 10.0**decade for decade in decades for lead in leads)
    return [place for place in places if first - 1e-9 <= math.log10(place) <= last + 1e-9]


def tick_text(value: float) -> str:
    """A number of an axis: a power of ten where zeros would be counted."""
    if value == 0.0 or 1e-3 <= abs(value) < 1e5:
        return f"{value:g}"
    lead, _, power = f"{value:.2e}".partition("e")
    raised = str(int(power)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{float(lead):g}·10{raised}".removeprefix("1·")


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
    """A name that a user chose, as text of a figure: one line, not too long."""
    return shorten(escape_unprintable(name), _LONGEST_NAME)


_LARGEST = np.finfo(np.float32).max


def pack_numbers(values: Any) -> str:
    """Numbers for a page: float32, little-endian, in base64; the largest where they are larger."""
    clipped = np.clip(np.asarray(values, float), -_LARGEST, _LARGEST)
    return base64.b64encode(clipped.astype("<f4").tobytes()).decode()


_MOST_CELLS = 60_000
"""Cells of a map whose values its page holds."""


def panel_json(panel: Panel, place: Sequence[float], ends: Sequence[Pair]) -> JsonObject:
    """Return what a page needs to draw a panel and to read values off it.

    Args:
        panel: whose lines are thinned.
        place: left, top, width and height, as shares of the figure.
        ends: of x and y, as they are drawn.
    """
    content: JsonObject = {"place": [round(number, 5) for number in place], "title": panel.title}
    for (name, axis), drawn_ends in zip(panel.axes.items(), ends, strict=True):
        content[name] = axis._asdict() | {"ends": [float(f"{end:.8g}") for end in drawn_ends]}
    content |= {kind: [] for kind in ("lines", "bands", "spans")}
    for part in map(thin, panel.parts):
        if isinstance(part, Line | Band | Span):
            fields = part._asdict()
            if not isinstance(part, Span):
                fields |= {key: pack_numbers(fields[key]) for key in fields.keys() & {"x", "y", "low", "high"}}
            content[f"{type(part).__name__.lower()}s"].append(fields)
        elif isinstance(part, Map) and np.size(part.values) <= _MOST_CELLS:
            cells = {key: pack_numbers(getattr(part, key)) for key in ("x", "y", "values")}
            content["cells"] = part.scale._asdict() | cells
    return to_jsonable(content)


def describe_panel(panel: Panel, ends: Sequence[Pair]) -> str:
    """One panel in words."""
    head = f"{panel.title}: ".replace("\n", ", ") if panel.title else ""
    axes = [
        f"{name} {axis.label or 'without a name'} from {low:.3g} to {high:.3g}{' (logarithmic)' if axis.log else ''}"
        for (name, axis), (low, high) in zip(panel.axes.items(), ends, strict=True)
        if not axis.names
    ]
    names = [part.name for part in panel.parts if isinstance(part, Line) and part.name]
    drawn = f" Lines: {', '.join(dict.fromkeys(names))}." if names else ""
    return f"{head}{'; '.join(axes)}.{drawn}".replace("\n", " ") if axes else ""
