"""How every figure looks: sizes for a report page, colour-blind-safe colours, units on axes."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
from cycler import cycler
from matplotlib.figure import Figure

# Okabe and Ito, in an order that also parts in grey
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
MAP = "viridis"
MISSING = "#BDBDBD"
HATCH = (1.0, 1.0, 1.0, 0.45)

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


@contextlib.contextmanager
def style() -> Iterator[None]:
    """The settings that figures are made under."""
    with mpl.rc_context(_SETTINGS):
        yield


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG, making its folder. Returns the path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with style():
        figure.savefig(path)
    return path


def with_unit(label: str, unit: str) -> str:
    """A label with its unit in brackets, if it has one."""
    return f"{label} ({unit})" if unit else label
