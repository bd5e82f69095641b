"""Figures in tests: one of each kind is laid out and drawn, and its picture stands for the others of that kind, also in the
other workers and in the commands that they start."""

import atexit
import hashlib
import os
import shutil
import tempfile
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
    from matplotlib.layout_engine import TightLayoutEngine

_FOLDER = "FIGURE_KINDS"
"""The variable of the environment that names the folder of pictures."""
_draw, _lay_out = Figure.savefig, TightLayoutEngine.execute


def _texts(ax: Axes) -> Iterator[str]:
    yield from (ax.get_xlabel(), ax.get_ylabel(), *(ax.get_title(place) for place in ("left", "center", "right")))
    yield from (text.get_text() for text in ax.texts)
    yield from ax.get_legend_handles_labels()[1]


def _name_kind(figure: Figure, format: str) -> str:
    """Kinds of artists and of texts on each of the axes, with their scales; as SVG, of a page, kinds of artists alone."""
    artists = [{type(artist).__name__ for artist in ax.get_children()} for ax in figure.axes]
    if format == "svg":
        kind = repr(sorted(set().union(*artists)))
    else:
        # what is to be set as mathematics is read by a parser
        mathematics = (any("$" in text for text in _texts(ax)) for ax in figure.axes)
        axes = ((ax.get_visible(), ax.get_xscale(), ax.get_yscale()) for ax in figure.axes)
        kind = repr((list(zip(map(sorted, artists), mathematics, axes, strict=True)), len(figure.legends)))
    return f"{hashlib.sha256(kind.encode()).hexdigest()[:16]}.{format}"


def _save_kind(figure: Figure, file: Any, *, format: str, **options: Any) -> None:
    """`Figure.savefig` in tests."""
    picture_file = Path(os.environ[_FOLDER], _name_kind(figure, format))
    if not picture_file.exists():
        picture = BytesIO()
        _draw(figure, picture, format=format, **options)
        # a constrained layout is found once, not before each drawing
        figure.set_layout_engine("none")
        draft = picture_file.with_suffix(f".{os.getpid()}")
        draft.write_bytes(picture.getvalue())
        draft.replace(picture_file)
    if isinstance(file, BytesIO):
        file.write(picture_file.read_bytes())
    else:
        shutil.copyfile(picture_file, file)


def _lay_out_kind(engine: TightLayoutEngine, figure: Figure) -> None:
    """`TightLayoutEngine.execute` in tests."""
    if not Path(os.environ[_FOLDER], _name_kind(figure, "png")).exists():
        _lay_out(engine, figure)


def _remove_pictures(maker: int) -> None:
    """Remove the folder of pictures where the process ends that made it, not with a fork of it."""
    if os.getpid() == maker:
        shutil.rmtree(os.environ[_FOLDER])


def draw_figures_by_kind() -> None:
    """Draw one figure of each kind from here on."""
    if _FOLDER not in os.environ:
        os.environ[_FOLDER] = tempfile.mkdtemp()
        atexit.register(_remove_pictures, os.getpid())
    Figure.savefig, TightLayoutEngine.execute = _save_kind, _lay_out_kind


@contextmanager
def every_figure() -> Iterator[None]:
    """Draw every figure inside."""
    Figure.savefig, TightLayoutEngine.execute = _draw, _lay_out
    try:
        yield
    finally:
        Figure.savefig, TightLayoutEngine.execute = _save_kind, _lay_out_kind
