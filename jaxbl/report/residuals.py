"""Figures of residual torques: over speed, position and twist."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxbl.diagnosis.coordinates import CoordinateValues
from jaxbl.diagnosis.localise import Coordinate, Localised
from jaxbl.diagnosis.residuals import Residual, narrow
from jaxbl.diagnosis.sentences import sentence_of
from jaxbl.records.least_squares import rms

from .panels import (
    MISSING,
    SIDE_COLOURS,
    Axis,
    Band,
    Figure,
    Line,
    Panel,
    Part,
    Span,
    cloud,
    intervals,
    missing_label,
    with_unit,
)

_SHOWN = ("speed", "turn", "load turn", "position", "load position", "twist", "acceleration")
_PANELS = 3
"""Coordinates that are drawn: as many as are wide enough side by side."""


def torque_parts(residual: Residual, bandwidth: float, name: str, *, noise: bool = True, **how: Any) -> list[Part]:
    """A residual over time behind the low-pass that the analysis used, and its noise as a band."""
    low, _ = narrow(residual, bandwidth)
    band = [Band(low.time, -2.0 * low.deviation, 2.0 * low.deviation, "± 2 noise", MISSING, 0.75)]
    return [*band * noise, Line(low.time, low.torque, name, **how)]


def draw_residual(
    parts: Sequence[Residual], coordinates: Sequence[Mapping[str, CoordinateValues]], located: Localised, unit: str = "N m"
) -> Figure:
    """Draw the residual torque of a side over the coordinates that explain most of it.

    Args:
        parts: of the record.
        coordinates: of each part, by name.
        located: what was found of these torques.
        unit: theirs.
    """
    by_name = located.coordinates
    names = [name for name in _SHOWN if name in by_name]
    # those that explain most, speed always
    drawn = sorted(names, key=lambda name: (name != "speed", -by_name[name].explained))[:_PANELS]
    lows, rows = zip(*(narrow(part, located.bandwidth) for part in parts), strict=True)
    torque = np.concatenate([low.torque for low in lows])
    noise = rms(np.concatenate([low.deviation for low in lows]))
    limit = 1.15 * max(float(np.quantile(np.abs(torque), 0.998)), 2.5 * noise)
    y, panels = Axis(missing_label(f"{located.name}: ", unit), ends=(-limit, limit)), []
    for name in sorted(drawn, key=names.index):
        coordinate = by_name[name]
        values = np.concatenate([part[name].values[row] for part, row in zip(coordinates, rows, strict=True)])
        band = Span(-2.0 * noise, 2.0 * noise, "± 2 noise", MISSING, "y", 0.6)
        dots = cloud(values, torque, colour=SIDE_COLOURS[located.name])
        x = Axis(with_unit(f"{name} {coordinate.symbol}".rstrip(), coordinate.unit))
        panels.append(Panel(x, y, [band, dots, *_means(coordinate)], f"explains {100.0 * coordinate.explained:.0f} %"))
    sentence = sentence_of(located, unit)
    caption = (
        f"{sentence[:1].upper()}{sentence[1:]}. Dots are samples, marks with strokes the means of bins "
        "with twice their standard errors; hollow where a mean does not differ significantly from zero. Above: share of the "
        "power beyond the noise that a function of this coordinate alone explains, on data that it was not fitted to."
    )
    return Figure(f"residual_{located.name}", panels, caption, len(panels), max(3.2 * len(panels), 4.4))


def _means(coordinate: Coordinate) -> list[Line]:
    rows = [(0.5 * (bin_.low + bin_.high), bin_.mean, bin_.mean_error, bin_.mean_z) for bin_ in coordinate.regions]  # pyright: ignore
    x, y, error, z = np.array(rows).reshape(-1, 4).T
    ends, points = intervals(x, y - 2.0 * error, y, y + 2.0 * error, "bin mean", upright=True, size=4.0)
    unsure = np.abs(z) <= 3.0
    hollow = points._replace(x=x[unsure], y=y[unsure], name="", fill="#FFFFFF")
    return [Line(x, y, width=1.0, opacity=0.7), ends, points, hollow]
