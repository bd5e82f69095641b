"""Figures in tests: one of each kind is drawn in a process, and its picture stands for the others of that kind."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

_draw = Figure.savefig
_pictures: dict[tuple[str, Any], bytes] = {}


def figure_kind(figure: Figure) -> Any:
    """Axes with their scales, kinds of artists and texts; texts are compared without their numbers."""

    def words(text: str) -> str:
        return re.sub(r"[-+−]?\d[\d.]*(e[-+]?\d+)?", "0", text)

    def texts(legend: Any) -> frozenset[str]:
        return frozenset(words(text.get_text()) for text in legend.get_texts())

    axes = (
        (
            *(ax.get_visible(), ax.get_xscale(), ax.get_yscale(), words(ax.get_xlabel()), words(ax.get_ylabel())),
            *(words(ax.get_title(place)) for place in ("left", "center", "right")),
            frozenset(type(artist).__name__ for artist in ax.get_children()),
            frozenset(words(text.get_text()) for text in ax.texts),
            texts(ax.get_legend()) if ax.get_legend() else None,
        )
        for ax in figure.axes
    )
    return tuple(axes), tuple(map(texts, figure.legends))


def _save_kind(figure: Figure, file: Any, *, format: str, **how: Any) -> None:
    """`Figure.savefig` in tests."""
    kind = format, figure_kind(figure)
    if kind not in _pictures:
        drawn = BytesIO()
        _draw(figure, drawn, format=format, **how)
        # a constrained layout is found once, not before each drawing
        figure.set_layout_engine("none")
        _pictures[kind] = drawn.getvalue()
    if isinstance(file, BytesIO):
        file.write(_pictures[kind])
    else:
        Path(file).write_bytes(_pictures[kind])


@contextmanager
def figures_by_kind() -> Iterator[None]:
    """Draw one figure of each kind inside."""
    Figure.savefig = _save_kind
    try:
        yield
    finally:
        Figure.savefig = _draw


@contextmanager
def every_figure() -> Iterator[None]:
    """Draw every figure inside."""
    before = Figure.savefig
    Figure.savefig = _draw
    try:
        yield
    finally:
        Figure.savefig = before
