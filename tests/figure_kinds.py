"""Figures in tests: one of each kind is drawn in a process, and its picture stands for the others of that kind."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

with warnings.catch_warnings():
    # the oldest Matplotlib calls the newest pyparsing by old names
    warnings.simplefilter("ignore")
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_draw = Figure.savefig
_pictures: dict[tuple[str, Any], bytes] = {}


def _texts(ax: Axes) -> Iterator[str]:
    yield from (ax.get_xlabel(), ax.get_ylabel(), *(ax.get_title(place) for place in ("left", "center", "right")))
    yield from (text.get_text() for text in ax.texts)
    yield from ax.get_legend_handles_labels()[1]


def figure_kind(figure: Figure, format: str) -> Any:
    """Kinds of artists and of texts on each of the axes, with their scales; as SVG, of a page, kinds of artists alone."""
    artists = [frozenset(type(artist).__name__ for artist in ax.get_children()) for ax in figure.axes]
    if format == "svg":
        return frozenset().union(*artists)
    # what is to be set as mathematics is read by a parser
    mathematics = (any("$" in text for text in _texts(ax)) for ax in figure.axes)
    axes = ((ax.get_visible(), ax.get_xscale(), ax.get_yscale()) for ax in figure.axes)
    return tuple(zip(artists, mathematics, axes, strict=True)), len(figure.legends)


def _save_kind(figure: Figure, file: Any, *, format: str, **options: Any) -> None:
    """`Figure.savefig` in tests."""
    kind = format, figure_kind(figure, format)
    if kind not in _pictures:
        picture = BytesIO()
        _draw(figure, picture, format=format, **options)
        # a constrained layout is found once, not before each drawing
        figure.set_layout_engine("none")
        _pictures[kind] = picture.getvalue()
    if isinstance(file, BytesIO):
        file.write(_pictures[kind])
    else:
        Path(file).write_bytes(_pictures[kind])


def draw_figures_by_kind() -> None:
    """Draw one figure of each kind from here on."""
    Figure.savefig = _save_kind


@contextmanager
def every_figure() -> Iterator[None]:
    """Draw every figure inside."""
    before = Figure.savefig
    Figure.savefig = _draw
    try:
        yield
    finally:
        Figure.savefig = before
