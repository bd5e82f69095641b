"""Figures of residual torques: over time with the noise band, over speed, position and twist, and their spectrum."""

from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Any

import numpy as np

from jaxbl.diagnosis.coordinates import CoordinateValues
from jaxbl.diagnosis.localise import Coordinate, Localised, residual_spectrum
from jaxbl.diagnosis.observer_residual import Observed
from jaxbl.diagnosis.residuals import Residual, SideResiduals, narrow
from jaxbl.diagnosis.sentences import sentence_of
from jaxbl.records.least_squares import rms

from .panels import (
    FAINT,
    MISSING,
    SIDE_COLOURS,
    TIME,
    ZERO,
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
    stack,
    with_unit,
)

_SHOWN = ("speed", "turn", "load turn", "position", "load position", "twist", "acceleration")
_PANELS = 3
"""Coordinates that are drawn: as many as are wide enough side by side."""
_WIDTH = 70
"""Characters of a line above a figure."""
_LABELLED = 0.1
"""Least share of the power of a peak with a label; labels of smaller ones would cover each other."""


def draw_residuals(
    residuals: SideResiduals,
    coordinates: Mapping[str, Sequence[Mapping[str, CoordinateValues]]],
    located: Mapping[str, Localised],
    unit: str = "N m",
    observed: Mapping[str, Sequence[Observed]] | None = None,
) -> list[Figure]:
    """All figures of residual torques (in `unit`): by side, of each part of the record; with the same torques by the
    observers (`observed`) where these converge."""
    over = [_over_coordinates(residuals[name], coordinates[name], located[name], unit) for name in residuals]
    return [_over_time(residuals, located, unit, observed or {}), *over, _spectra(residuals, located, unit)]


def torque_parts(residual: Residual, bandwidth: float, name: str, *, noise: bool = True, **how: Any) -> list[Part]:
    """A residual over time behind the low-pass that the analysis used, and its noise as a band."""
    low, _ = narrow(residual, bandwidth)
    band = [Band(low.time, -2.0 * low.deviation, 2.0 * low.deviation, "± 2 noise", MISSING, 0.75)]
    return [*band * noise, Line(low.time, low.torque, name, **how)]


def _over_time(
    residuals: SideResiduals,
    located: Mapping[str, Localised],
    unit: str,
    observed: Mapping[str, Sequence[Observed]],
) -> Figure:
    panels = []
    for name, parts in residuals.items():
        bandwidth, drawn, estimates = located[name].bandwidth, [], observed.get(name, ())
        for part in parts:
            drawn += torque_parts(part, bandwidth, "missing", colour=SIDE_COLOURS[name], width=0.9)
        if estimates and all(part.has_converged for part in estimates):
            first, _ = narrow(estimates[0].residual, bandwidth)
            label = f"by its observer (noise {first.deviation[0]:.2g} {unit})"
            for part in estimates:
                drawn += torque_parts(part.residual, bandwidth, label, noise=False, width=0.5)
        title = fill(sentence_of(located[name], unit), _WIDTH)
        panels.append(Panel(TIME, Axis(missing_label(f"{name}:\n", unit)), [ZERO, *drawn], title))
    caption = (
        "Torque that the model lacks (inertia times acceleration less all modelled torques, positive forward), after the "
        "low-pass that shows it most clearly. The grey band is twice the standard deviation of the noise."
    )
    if observed:
        caption += (
            " Thin dark line: the same torque by the side's super-twisting observer (its equivalent control less the "
            "modelled torques), late by the time constant of its low-pass. Its noise is of its own; no result depends on it."
        )
    return stack("residual_torque", panels, caption, 2.6)


def _over_coordinates(
    parts: Sequence[Residual], coordinates: Sequence[Mapping[str, CoordinateValues]], located: Localised, unit: str
) -> Figure:
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
        f"{sentence[:1].upper()}{sentence[1:]}. Dots are samples, black marks the means of bins "
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


def _spectra(residuals: SideResiduals, located: Mapping[str, Localised], unit: str) -> Figure:
    panels, marked = [], False
    for name, parts in residuals.items():
        longest, bandwidth = max(parts, key=lambda part: len(part.time)), located[name].bandwidth
        frequency, *powers = residual_spectrum(longest)
        inside = (frequency > 0.0) & (frequency <= min(1.5 * longest.bandwidth, frequency[-1]))
        # amplitude of a sine with the power of the line
        size = np.sqrt(2.0 / len(longest.time))
        frequency, missing, noise = frequency[inside], *(size * np.sqrt(power[inside]) for power in powers)
        drawn: list[Part] = [
            Line(frequency, missing, "missing", SIDE_COLOURS[name], 0.9),
            Line(frequency, noise, "noise", width=1.2, dashes="--"),
            Span(bandwidth, bandwidth, "end of the band analysed", FAINT, dashes=":"),
        ]
        narrow_peaks = [peak for peak in located[name].peaks if not peak.in_motion][:3]
        if peaks := [peak for peak in narrow_peaks if peak.power_share >= _LABELLED]:
            x, y = ([getattr(peak, key) for peak in peaks] for key in ("frequency", "amplitude"))
            texts = [f"{peak.frequency:.4g} Hz\n{peak.amplitude:.2g} {unit}" for peak in peaks]
            drawn.append(Line(x, y, width=0.0, marker="v", texts=texts))
            marked = True
        ends = 0.2 * float(noise.min()), 3.0 * float(max(missing.max(), noise.max()))
        y = Axis(with_unit(f"{name}:\namplitude per line", unit), log=True, ends=ends)
        panels.append(Panel(Axis("frequency (Hz)", log=True), y, drawn))
    caption = (
        "Spectrum of the missing torque and of its noise. The noise of an acceleration grows with the square of the "
        "frequency, up to the smoother's bandwidth; power above the dashed line is missing from the model."
    )
    if marked:
        caption += " Marked: narrow peaks that the motion does not have."
    return stack("residual_spectrum", panels, caption, 2.4)
