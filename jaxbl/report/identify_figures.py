"""Figures of `jaxbl identify`. Those of motion and torque are the analogues of Figs. 18 to 28 of the paper.

Where a log is long they show the few cycles with the largest motion in detail, and the whole of it in outline.
"""

from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.colors import ListedColormap, LogNorm

from jaxbl.drive.parameters import units_of
from jaxbl.estimation.identify import Identification
from jaxbl.lines import percent
from jaxbl.quantity import Quantity

from .figures import (
    BLACK,
    BLUE,
    FAINT,
    GREEN,
    ORANGE,
    PURPLE,
    SIDE_COLOURS,
    SKY,
    Axes,
    Drawn,
    Figure,
    Pair,
    draw_zero,
    legend,
    limits,
    missing_quantity,
    outline,
    shade_gap,
    stacked,
    style,
    subplots,
    with_unit,
)
from .log_signals import LogSignals
from .motor_alone_figures import draw_motor_alone

Array = np.ndarray

_CLOUD = 4000
"""Points of a cloud; of more than these, which would cover each other, the density is drawn."""
_CYCLE_POINTS = 30_000
"""Points of a limit cycle that is drawn as a line; a longer one would fill its area, and its density is drawn."""
_MODEL, _MEASURED = BLACK, GREEN
_GROWING, _FALLING = GREEN, PURPLE
_DENSITY = ListedColormap(mpl.colormaps["Greys"](np.linspace(0.25, 0.75, 64)))


@style()
def draw_identification(result: Identification) -> list[Drawn]:
    """All figures of an identification."""
    log = LogSignals(result)
    if "backlash" in result.summary:
        return [_intervals(result), *draw_motor_alone(result), _residuals(log)]
    first, *more = [_hysteresis, _torque, _limit_cycle] if log.geared else [_friction, _resistance]
    drawn = [first(log), _intervals(result), _residuals(log), *(draw(log) for draw in more), _velocities(log)]
    return [*drawn, _path(log)] if result.summary["method"]["recursive"] else drawn


def _draw(ax: Axes, log: LogSignals, values: Array, rows: slice | None = None, **how: Any) -> None:
    """A signal over time: broken at gaps, and by the extremes of its bins where it is long."""
    parts = list(log.parts(rows))
    total = sum(part.stop - part.start for part in parts)
    for part in parts:
        samples = part.start + outline(values[part], share=(part.stop - part.start) / total)
        ax.plot(log.time[samples], values[samples], **how)


def _finish(ax: Axes, label: str, ends: Pair | None, columns: int = 1) -> None:
    """Label, ends and legend of an axis of values."""
    ax.set(ylabel=label, ylim=ends)
    legend(ax, columns)


def _intervals(result: Identification) -> Drawn:
    fitted = {
        path: (number, nominal)
        for path, number in result.parameters.items()
        if (nominal := number.nominal) is not None and number.is_finite
    }
    names = list(dict.fromkeys([*fitted, *result.summary["held"]]))
    figure, (ax,) = subplots(9.0, 1.1 + 0.4 * len(names))
    beside: Any = {"xycoords": ("axes fraction", "data"), "va": "center", "fontsize": 9}
    inside = [0.0]
    for i, (number, nominal) in enumerate(fitted.values()):
        value, (low, high) = number.value, number.ends()
        half, size = 0.5 * abs(high - low), abs(nominal) or abs(value) or 1.0
        low, middle, high = (100.0 * (end - nominal) / size for end in (low, value, high))
        ax.plot([low, high], [i, i], color=BLUE, lw=5.0, alpha=0.45, solid_capstyle="butt")
        ax.plot([low, middle, high], [i] * 3, "|", color=BLUE, ms=11, mew=1.6)
        ax.plot(middle, i, "o", color=BLUE, ms=5)
        inside += [max(low, middle - 100.0), min(high, middle + 100.0)]
        text = f"{Quantity(value, half, unit=number.unit)} ({percent(half / (abs(value) or 1.0))})"
        ax.annotate(text, (1.01, i), **beside)
    for i in range(len(fitted), len(names)):
        ax.plot(0.0, i, "o", mfc="white", mec=FAINT, ms=6)
        ax.annotate("held at nominal: not seen in this log", (1.01, i), color="#555555", **beside)
    ax.axvline(0.0, color="black", lw=0.8, zorder=0)
    room = 0.06 * (max(inside) - min(inside)) or 1.0
    ax.set_yticks(range(len(names)), names)
    ax.set(xlabel="difference from the nominal value (% of it)", xlim=(min(inside) - room, max(inside) + room))
    ax.set_ylim(len(names) - 0.5, -0.5)
    return Drawn(
        "intervals",
        figure,
        "Fitted parameters as differences from their nominal values (the line at 0), with 95 % intervals that allow for "
        "correlated residuals. On the right: value, half width of the interval, and its "
        "share of the value.",
    )


def _residuals(log: LogSignals) -> Drawn:
    residual = log.found.summary["residual"]
    figure, axes = stacked(len(residual), 2.0)
    for ax, (side, sizes) in zip(axes, residual.items(), strict=True):
        unit, rms, noise = log.unit[side], sizes["rms"], sizes["noise"]
        label = f"rms {rms:.2g} {unit}, {rms / noise:.3g} times the noise"
        _draw(ax, log, log[f"{side}.residual"], color=SIDE_COLOURS[side], lw=0.7, label=label)
        for end in (-2.0 * noise, 2.0 * noise):
            ax.axhline(end, color=_MODEL, lw=0.9, ls="--", label="± 2 noise")
        ax.set_ylabel(f"{side}:\nmeasured − model ({unit})")
        legend(ax, 2)
    return Drawn(
        "residuals",
        figure,
        "Measured position less that of the fitted model, window by window. Noise alone leaves the dashed lines in one "
        "sample of twenty; longer swings beyond them are an effect that the model lacks.",
    )


def _pair_axes(log: LogSignals, columns: int, height: float) -> tuple[Figure, list[tuple[Axes, Axes]]]:
    """Pairs of axes: the detail above differences over the whole record; one time axis if they are the same."""
    figure, axes = subplots(9.0, height, 2, columns, sharex="col" if log.whole else False, height_ratios=(3, 2))
    pairs = list(zip(axes[:columns], axes[columns:], strict=True))
    for above, below in pairs:
        draw_zero(below, 0)
        if log.whole:
            below.set_xlabel("time (s)")
        else:
            above.set(xlim=log.span, xlabel="time (s)")
            below.set(xlim=(log.time[0], log.time[-1]), xlabel="time (s), all of the record")
            below.axvspan(*log.span, color=SKY, alpha=0.25, lw=1.5)
    return figure, pairs


def _where(log: LogSignals) -> str:
    if log.whole:
        return ""
    low, high = log.span
    return f" Above: {low:.4g} to {high:.4g} s, where the motion is largest (shaded below)."


def _velocities(log: LogSignals) -> Drawn:
    figure, pairs = _pair_axes(log, len(log.sides), 4.6)
    for side, (above, below) in zip(log.sides, pairs, strict=True):
        smoothed, estimate, unit = log[f"{side}.velocity"], log[f"{side}.velocity_estimate"], f"{log.unit[side]}/s"
        _draw(above, log, estimate, log.detail, color=SIDE_COLOURS[side], lw=2.6, alpha=0.75, label="observer")
        _draw(above, log, smoothed, log.detail, color=_MODEL, lw=0.9, label="smoother")
        _finish(above, f"{side} velocity ({unit})", limits(smoothed[log.detail], estimate[log.line]), 2)
        error = estimate - smoothed
        share = log.rms(error) / (log.rms(smoothed) or 1.0)
        label = f"rms {log.rms(error):.2g} {unit} ({percent(share)})"
        _draw(below, log, error, color=SIDE_COLOURS[side], lw=0.8, label=label)
        _finish(below, f"difference ({unit})", limits(error[log.settled], room=0.4))
    return Drawn(
        "velocities",
        figure,
        "Velocities by the observers, which use past samples only, and by the zero-phase smoother, which uses the whole log "
        f"(cf. Figs. 18, 19, 22 and 23). Below: observer − smoother; rms without the first tenth.{_where(log)}",
    )


def _torque(log: LogSignals) -> Drawn:
    figure, ((above, below),) = _pair_axes(log, 1, 5.4)
    law, measured = log.low_passed(log["torque"]), log.measured_torque
    reference, name = (law, "law") if measured is None else (measured, "measured")
    errors = {side: torque - reference for side, torque in log.torques.items()}
    # the noisier one first, so that it does not hide the other
    for side in sorted(log.sides, key=lambda side: -log.rms(errors[side])):
        torque, error = log.torques[side], errors[side]
        _draw(above, log, torque, log.detail, color=SIDE_COLOURS[side], lw=2.4, alpha=0.75, label=f"by the {side} side")
        label = f"{side} side − {name}, rms {log.rms(error):.2g} {log.torque_unit}"
        _draw(below, log, error, color=SIDE_COLOURS[side], lw=0.8, alpha=0.8, label=label)
    signals, error = [*log.torques.values(), law], law - reference
    if measured is not None:
        signals.append(measured)
        _draw(above, log, measured, log.detail, color=_MEASURED, lw=1.6, label="measured")
        _draw(below, log, error, color=_MODEL, lw=0.8, label=f"law − measured, rms {log.rms(error):.2g} {log.torque_unit}")
    _draw(above, log, law, log.detail, color=_MODEL, lw=1.0, ls="--", label="fitted law at the measured twist")
    _finish(above, f"transmitted torque ({log.torque_unit})", limits(*(signal[log.line] for signal in signals)), 4)
    ends = limits(*(signal[log.settled] - reference[log.settled] for signal in signals), room=0.3)
    _finish(below, f"difference ({log.torque_unit})", ends, 3)
    return Drawn(
        "torque",
        figure,
        "Transmitted torque: by the equivalent control of each side less the fitted effects on that side, and by the fitted "
        "law at the measured twist, all behind the same low-pass. Where a side differs from the law, the law or that side's "
        f"equation of motion is incomplete.{_where(log)}",
    )


def _cloud(ax: Axes, log: LogSignals, x: Array, y: Array, span: tuple[Pair, Pair]) -> None:
    """All settled points of a plane, as far as it goes: as points, or as their density where they are many."""
    ax.set(xlim=span[0], ylim=span[1])
    x, y = x[log.settled], y[log.settled]
    finite = np.isfinite(x) & np.isfinite(y)
    x, y = x[finite], y[finite]
    if len(x) <= _CLOUD:
        ax.plot(x, y, ".", ms=2.0, mew=0.0, color=FAINT, zorder=1)
        return
    counts, *edges = np.histogram2d(x, y, bins=(280, 190), range=span)
    if counts.any():
        cells = np.where(counts > 0.0, counts, np.nan).T
        scale = LogNorm(1.0, max(float(counts.max()), 2.0))
        ax.pcolormesh(*edges, cells, cmap=_DENSITY, norm=scale, rasterized=True, zorder=1)


def _shade_gap(ax: Axes, log: LogSignals) -> None:
    """The fitted gap, shaded, with its edges."""
    half = log.plant.half_gap
    if half:
        shade_gap(ax, half, f"fitted gap: half width {half:.4g} {log.unit['motor']}")
        for edge in (-half, half):
            ax.axvline(edge, color=ORANGE, lw=1.0, zorder=0.5)


def _mean_over(twist: Array, torque: Array, rows: Array, span: Pair) -> tuple[Array, Array]:
    """Mean torque of some rows in bins of twist; NaN in bins of fewer than four samples."""
    bins = int(np.clip(len(rows) // 15, 24, 80))
    edges = np.linspace(*span, bins + 1)
    bin_of_row = np.digitize(twist[rows], edges)
    count, total = (np.bincount(bin_of_row, weights, minlength=bins + 2)[1 : bins + 1] for weights in (None, torque[rows]))
    mean = np.where(count >= 4, total / np.maximum(count, 1), np.nan)
    return 0.5 * (edges[1:] + edges[:-1]), mean


def _means(ax: Axes, log: LogSignals, x: Array, torque: Array, rate: Array, name: str, span: Pair) -> None:
    """The mean torque over x of settled samples, for both signs of its rate."""
    rows = np.arange(len(rate))[log.settled]
    rows = rows[np.isfinite(torque[rows])]
    for word, shade, chosen in (("growing", _GROWING, rate[rows] > 0.0), ("falling", _FALLING, ~(rate[rows] > 0.0))):
        mean = _mean_over(x, torque, rows[chosen], span)
        ax.plot(*mean, color=shade, lw=2.4, alpha=0.9, zorder=3, label=f"mean, {name} {word}")


def _hysteresis(log: LogSignals) -> Drawn:
    panels = [(f"by the {side} side", log.torques[side], SIDE_COLOURS[side]) for side in log.sides]
    if log.measured_torque is not None:
        panels.append(("measured", log.measured_torque, _MEASURED))
    twist, rate = map(log.low_passed, (log["twist"], log.rate))
    across, up = limits(twist[log.settled]), limits(*(torque[log.settled] for _, torque, _ in panels))
    figure, axes = subplots(9.0, 4.4, columns=len(panels), beside=True, sharex=True, sharey=True)
    for ax, (name, torque, colour) in zip(axes, panels, strict=True):
        _shade_gap(ax, log)
        if across and up:
            _cloud(ax, log, twist, torque, (across, up))
            _means(ax, log, twist, torque, rate, "twist", across)
            twists = np.linspace(*across, 400)
            ax.plot(twists, log.law_at(twists), color=_MODEL, lw=1.2, ls="--", zorder=4, label="fitted law")
        ax.set_title(name, color=colour, loc="left")
        ax.set_xlabel(f"twist θe − N₀ θs ({log.unit['motor']})")
    axes[0].set_ylabel(f"transmitted torque ({log.torque_unit})")
    figure.legend(*axes[0].get_legend_handles_labels(), ncols=4, loc="outside upper right", columnspacing=1.2)
    return Drawn(
        "hysteresis",
        figure,
        "Transmitted torque over the measured twist, both behind the same low-pass (which rounds corners), with the fitted "
        "law (cf. Figs. 26 and 27); grey is all of the record but its first tenth. Where the means of the two directions "
        "differ, the model lacks friction or damping, or there is delay, the observer's included.",
    )


def _limit_cycle(log: LogSignals) -> Drawn:
    unit, twist, rate, rows = log.unit["motor"], log["twist"], log.rate, log.settled
    figure, (ax,) = subplots(9.0, 4.2)
    across, up = limits(twist[rows]), limits(rate[rows])
    _shade_gap(ax, log)
    if across and up:
        if rows.stop - rows.start <= _CYCLE_POINTS:
            ax.plot(twist[rows], rate[rows], color=FAINT, lw=0.6, alpha=0.5, zorder=1)
        else:
            _cloud(ax, log, twist, rate, (across, up))
        ax.set(xlim=across, ylim=up)
    ax.plot(twist[log.line], rate[log.line], color=PURPLE, lw=1.4, zorder=3)
    draw_zero(ax, 0.6)
    ax.set(xlabel=f"twist θe − N₀ θs ({unit})", ylabel=f"twist rate by the smoother ({unit}/s)")
    caption = "Limit cycle: rate of the twist over the twist (cf. Fig. 28), run through clockwise. "
    if log.plant.half_gap:
        legend(ax)
        caption += "Free flight crosses the shaded gap; outside of it the gear is in contact. "
    if log.whole:
        caption += "The line is all of the record but its first tenth."
    else:
        low, high = log.span
        caption += f"The line is {low:.4g} to {high:.4g} s, where the motion is largest; grey is all but the first tenth."
    return Drawn("limit_cycle", figure, caption)


def _resistance(log: LogSignals) -> Drawn:
    """The torque of a rigid drive beyond its nominal equation, over time."""
    unit, estimate, effects = log.torque_unit, log["motor.torque_estimate"], log.effects("motor")
    figure, ((above, below),) = _pair_axes(log, 1, 5.0)
    _draw(above, log, estimate, log.detail, color=SIDE_COLOURS["motor"], lw=2.2, alpha=0.75, label="observer")
    fitted = np.zeros(len(estimate)) if effects is None else effects
    _draw(above, log, fitted, log.detail, color=_MODEL, lw=1.0, ls="--", label="fitted effects")
    error = estimate - fitted
    _draw(below, log, error, color=SIDE_COLOURS["motor"], lw=0.8, label=f"rms {log.rms(error):.2g} {unit}")
    quantity = missing_quantity(unit)
    _finish(above, f"resisting {quantity} ({unit})", limits(estimate[log.line], fitted[log.line]), 2)
    _finish(below, f"difference ({unit})", limits(error[log.settled], room=0.3))
    return Drawn(
        "resistance",
        figure,
        f"The {quantity} beyond inertia and viscous friction, by the equivalent control of the observer and by the fitted "
        f"effects, behind the same low-pass. Below: observer − effects; rms without the first tenth.{_where(log)}",
    )


def _friction(log: LogSignals) -> Drawn:
    """The torque of a rigid drive beyond its nominal equation, over velocity."""
    unit, rows = log.torque_unit, log.settled
    estimate, effects = log["motor.torque_estimate"], log.effects("motor")
    velocity = log.low_passed(log["motor.velocity"])
    across, up, quantity = limits(velocity[rows]), limits(estimate[rows]), missing_quantity(unit)
    figure, (ax,) = subplots(9.0, 4.2)
    if across and up:
        _cloud(ax, log, velocity, estimate, (across, up))
        # a line of the observer's own torque, which chatters, would fill the panel
        _means(ax, log, velocity, estimate, np.gradient(velocity), "velocity", across)
    if effects is not None:
        ax.plot(velocity[log.line], effects[log.line], color=_MODEL, lw=1.2, zorder=4, label="fitted effects")
    ax.set(xlabel=f"velocity by the smoother ({log.unit['motor']}/s)", ylabel=f"resisting {quantity} ({unit})")
    legend(ax, 3)
    return Drawn(
        "friction",
        figure,
        f"The {quantity} beyond inertia and viscous friction over velocity, behind the same low-pass: friction as the log "
        "shows it (grey: samples by the observer, without the first tenth; lines: their means for either direction of the "
        "acceleration), and as fitted. The low-pass slants the reversals.",
    )


def _path(log: LogSignals) -> Drawn:
    result, names = log.found, list(log.found.summary["method"]["recursive"])
    figure, axes = stacked(len(names), 2.1)
    late = slice((log.observed.start + log.observed.stop) // 2, log.observed.stop)
    # what a law derives from its own parameters is an angle, as they are
    units = units_of(log.experiment.transmission)
    for ax, name in zip(axes, names, strict=True):
        ends, lines = [], []
        for side in log.sides:
            values = log[f"{side}.{name}"]
            _draw(ax, log, values, log.observed, color=SIDE_COLOURS[side], label=f"recursive, {side} side")
            ends.append(values[late])
        path = f"transmission.{name}"
        fitted = result.parameters.get(path)
        if fitted is not None:
            interval = fitted.ends()
            ax.axhspan(*interval, color=_MODEL, alpha=0.15, lw=0.0)
            ax.axhline(fitted.value, color=_MODEL, lw=1.0, ls="--", label="trajectory fit, 95 %")
            ends.append(np.array(interval))
            lines.append(fitted.value)
        label = with_unit(name.replace("_", " "), result.record.unit_of(path, units.get(name, "rad")))
        ax.set(ylabel=label, ylim=limits(*ends, share=0.02, room=0.25, shown=lines))
    legend(axes[0], 3, of=axes)
    return Drawn(
        "recursive",
        figure,
        "The paper's recursive identification (27)-(28) on the equivalent control of both sides, and the trajectory fit "
        "with its interval. The scale is that of the second half of the record.",
    )
