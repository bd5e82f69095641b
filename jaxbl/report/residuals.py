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

from .figures import (
    BLACK,
    FAINT,
    MISSING,
    SIDE_COLOURS,
    Axes,
    Drawn,
    decades,
    draw_zero,
    legend,
    missing_label,
    outline,
    stacked,
    style,
    subplots,
    with_unit,
)

_CLOUD = 4000
"""Dots of a cloud; more would cover each other."""
_MEAN = BLACK
_SHOWN = ("speed", "turn", "load turn", "position", "load position", "twist", "acceleration")
_PANELS = 3
"""Coordinates that are drawn: as many as are wide enough side by side."""
_WIDTH = 118
"""Characters of a line above a figure of 9 inches."""
_LABELLED = 0.1
"""Least share of the power of a peak with a label; labels of smaller ones would cover each other."""


@style()
def draw_residuals(
    residuals: SideResiduals,
    coordinates: Mapping[str, Sequence[Mapping[str, CoordinateValues]]],
    located: Mapping[str, Localised],
    unit: str = "N m",
    observed: Mapping[str, Sequence[Observed]] | None = None,
) -> list[Drawn]:
    """All figures of residual torques (in `unit`): by side, of each part of the record; with the same torques by the
    observers (`observed`) where these converge."""
    over = [_over_coordinates(residuals[name], coordinates[name], located[name], unit) for name in residuals]
    return [_over_time(residuals, located, unit, observed or {}), *over, _spectra(residuals, located, unit)]


def plot_torque(ax: Axes, residual: Residual, bandwidth: float, *, noise: bool = True, **how: Any) -> None:
    """Plot a residual over time behind the low-pass that the analysis used, and its noise as a band."""
    low, _ = narrow(residual, bandwidth)
    samples = outline(low.torque)
    time = low.time[samples]
    ax.plot(time, low.torque[samples], **how)
    if noise:
        band = 2.0 * low.deviation[samples]
        ax.fill_between(time, -band, band, color=MISSING, alpha=0.75, lw=0.0, zorder=3, label="± 2 noise")


def _over_time(
    residuals: SideResiduals,
    located: Mapping[str, Localised],
    unit: str,
    observed: Mapping[str, Sequence[Observed]],
) -> Drawn:
    figure, axes = stacked(len(residuals), 2.3)
    for ax, (name, parts) in zip(axes, residuals.items(), strict=True):
        bandwidth = located[name].bandwidth
        for part in parts:
            plot_torque(ax, part, bandwidth, color=SIDE_COLOURS[name], lw=0.9, label="missing")
        estimates = observed.get(name, ())
        if estimates and all(part.has_converged for part in estimates):
            first, _ = narrow(estimates[0].residual, bandwidth)
            label = f"by its observer (noise {first.deviation[0]:.2g} {unit})"
            for part in estimates:
                plot_torque(ax, part.residual, bandwidth, noise=False, color=_MEAN, lw=0.5, label=label, zorder=4)
        draw_zero(ax, 1)
        ax.set_ylabel(missing_label(f"{name}:\n", unit))
        ax.set_title(f"{fill(sentence_of(located[name], unit), _WIDTH)}\n", loc="left", fontsize=9)
        legend(ax, 3)
    caption = (
        "Torque that the model lacks (inertia times acceleration less all modelled torques, positive forward), after the "
        "low-pass that shows it most clearly. The grey band is twice the standard deviation of the noise."
    )
    if observed:
        caption += (
            " Thin dark line: the same torque by the side's super-twisting observer (its equivalent control less the "
            "modelled torques), late by the time constant of its low-pass. Its noise is of its own; no result depends on it."
        )
    return Drawn("residual_torque", figure, caption)


def _over_coordinates(
    parts: Sequence[Residual], coordinates: Sequence[Mapping[str, CoordinateValues]], located: Localised, unit: str
) -> Drawn:
    by_name = located.coordinates
    names = [name for name in _SHOWN if name in by_name]
    # those that explain most, speed always
    drawn = sorted(names, key=lambda name: (name != "speed", -by_name[name].explained))[:_PANELS]
    panels = [by_name[name] for name in names if name in drawn]
    figure, axes = subplots(3.2 * len(panels) + 0.6, 3.5, columns=len(panels), sharey=True)
    lows, rows = zip(*(narrow(part, located.bandwidth) for part in parts), strict=True)
    torque = np.concatenate([low.torque for low in lows])
    noise = rms(np.concatenate([low.deviation for low in lows]))
    points = slice(None, None, max(len(torque) // _CLOUD, 1))
    best = max(panels, key=lambda panel: panel.explained)
    dots: Any = {"ms": 2.0, "mew": 0.0, "color": SIDE_COLOURS[located.name], "alpha": 0.45, "zorder": 1, "rasterized": True}
    for ax, panel in zip(axes, panels, strict=True):
        values = np.concatenate([part[panel.name].values[row] for part, row in zip(coordinates, rows, strict=True)])
        ax.axhspan(-2.0 * noise, 2.0 * noise, color=MISSING, alpha=0.6, lw=0.0, zorder=0, label="± 2 noise")
        ax.plot(values[points], torque[points], ".", **dots)
        _means(ax, panel)
        ax.locator_params(axis="x", nbins=5)
        ax.set_xlabel(with_unit(f"{panel.name} {panel.symbol}".rstrip(), panel.unit))
        weight = "bold" if panel is best and panel.explained > 0.0 else "normal"
        ax.set_title(f"explains {100.0 * panel.explained:.0f} %\n", loc="left", fontsize=10, fontweight=weight)
    axes[0].set_ylabel(missing_label(f"{located.name}: ", unit))
    limit = 1.15 * max(float(np.quantile(np.abs(torque), 0.998)), 2.5 * noise)
    axes[0].set_ylim(-limit, limit)
    legend(axes[-1], 2)
    sentence = sentence_of(located, unit)
    return Drawn(
        f"residual_{located.name}",
        figure,
        f"{sentence[:1].upper()}{sentence[1:]}. Dots are samples, black marks the means of bins "
        "with twice their standard errors; hollow where a mean does not differ significantly from zero. Above: share of the "
        "power beyond the noise that a function of this coordinate alone explains, on data that it was not fitted to.",
    )


def _means(ax: Axes, coordinate: Coordinate) -> None:
    rows = [(0.5 * (bin_.low + bin_.high), bin_.mean, bin_.mean_error, bin_.mean_z) for bin_ in coordinate.regions]  # pyright: ignore
    x, y, error, z = np.array(rows).reshape(-1, 4).T
    sure = np.abs(z) > 3.0
    ax.plot(x, y, color=_MEAN, lw=1.0, alpha=0.7, zorder=3)
    ax.errorbar(x, y, 2.0 * error, fmt="none", ecolor=_MEAN, elinewidth=1.2, zorder=3)
    ax.plot(x[sure], y[sure], "o", ms=4.0, color=_MEAN, zorder=4, label="bin mean")
    ax.plot(x[~sure], y[~sure], "o", ms=4.0, mfc="white", mec=_MEAN, mew=0.9, zorder=4)


def _spectra(residuals: SideResiduals, located: Mapping[str, Localised], unit: str) -> Drawn:
    marked = False
    figure, axes = stacked(len(residuals), 2.5, "frequency (Hz)", sharex=False)
    for ax, (name, parts) in zip(axes, residuals.items(), strict=True):
        longest = max(parts, key=lambda part: len(part.time))
        frequency, *powers = residual_spectrum(longest)
        inside = (frequency > 0.0) & (frequency <= min(1.5 * longest.bandwidth, frequency[-1]))
        # amplitude of a sine with the power of the line
        size = np.sqrt(2.0 / len(longest.time))
        frequency, missing, noise = frequency[inside], *(size * np.sqrt(power[inside]) for power in powers)
        ax.loglog(frequency, missing, color=SIDE_COLOURS[name], lw=0.9, label="missing")
        ax.loglog(frequency, noise, color=_MEAN, lw=1.2, ls="--", label="noise")
        ax.set_ylim(0.2 * noise.min(), 3.0 * max(missing.max(), noise.max()))
        decades(ax)
        ax.axvline(located[name].bandwidth, color=FAINT, lw=0.9, ls=":", label="end of the band analysed")
        narrow = [peak for peak in located[name].peaks if not peak.in_motion]
        for peak in narrow[:3]:
            if peak.power_share < _LABELLED:
                continue
            place, text = (peak.frequency, peak.amplitude), f"{peak.frequency:.4g} Hz\n{peak.amplitude:.2g} {unit}"
            ax.annotate(text, place, xytext=(5, 2), textcoords="offset points", fontsize=8, va="center")
            ax.plot(*place, "v", ms=5, color=_MEAN)
            marked = True
        ax.set_ylabel(with_unit(f"{name}:\namplitude per line", unit))
        legend(ax, 3)
    caption = (
        "Spectrum of the missing torque and of its noise. The noise of an acceleration grows with the square of the "
        "frequency, up to the smoother's bandwidth; power above the dashed line is missing from the model."
    )
    if marked:
        caption += " Marked: narrow peaks that the motion does not have."
    return Drawn("residual_spectrum", figure, caption)
