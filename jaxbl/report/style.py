"""How every figure looks: sizes for a report page, colour-blind-safe colours, units on axes."""

import contextlib
from collections.abc import Iterator
from typing import Any

import matplotlib as mpl
from cycler import cycler

# Okabe and Ito, in an order that also parts in grey
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
SIDE_COLOURS = {"motor": COLOURS[0], "load": COLOURS[1], "transmission": COLOURS[2]}
MAP = "viridis"
MISSING = "#BDBDBD"
FAINT = "#8C8C8C"
"""Grey of zero lines, arrows and clouds of points behind a line."""
HATCH = (1.0, 1.0, 1.0, 0.45)
LEGEND_ABOVE: Any = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.1, "columnspacing": 1.2}
"""Where a legend hides no line."""

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


def with_unit(label: str, unit: str) -> str:
    """A label with its unit in brackets, if it has one."""
    return f"{label} ({unit})" if unit else label
