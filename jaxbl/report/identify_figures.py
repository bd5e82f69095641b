"""Figures of `jaxbl identify`. Those of motion and torque are the analogues of Figs. 18 to 28 of the paper.

Where a log is long they show the few cycles with the largest motion in detail, and the whole of it in outline.
"""

from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure

from jaxbl.drive.parameters import units_of
from jaxbl.identification.identify import Identification

from .figures import COLOURS, FAINT, SIDE_COLOURS, Drawn, legend, limits, outline, stacked, style, subplots, with_unit
from .log_signals import LogSignals
from .motor_alone_figures import draw_motor_alone

Array = np.ndarray

_CLOUD = 4000
"""Points of a cloud; of more than these, which would cover each other, the density is drawn."""
_CYCLE_POINTS = 30_000
"""Points of a limit cycle that is drawn as a line; a longer one would fill its area, and its density is drawn."""
_MODEL, _MEASURED, _GAP = COLOURS[6], COLOURS[2], "#F3E3A1"
_GROWING, _FALLING = COLOURS[2], COLOURS[3]
_DENSITY = ListedColormap(mpl.colormaps["Greys"](np.linspace(0.25, 0.75, 64)))


@style()
def draw_identification(found: Identification) -> list[Drawn]:
    """All figures of an identification."""
    log = LogSignals(found)
    if "backlash" in found.summary:
        return [_intervals(found), *draw_motor_alone(found), _residuals(log)]
    drawn = [_intervals(found), _residuals(log), _velocities(log)]
    drawn += [_torque(log), _hysteresis(log), _limit_cycle(log)] if log.geared else [_resistance(log), _friction(log)]
    return [*drawn, _path(log)] if found.summary["method"]["recursive"] else drawn


def _draw(ax: Axes, log: LogSignals, values: Array, rows: slice | None = None, **how: Any) -> None:
    """A signal over time: broken at gaps, and by the extremes of its bins where it is long."""
    total = sum(part.stop - part.start for part in log.parts(rows))
    for part in log.parts(rows):
        at = part.start + outline(values[part], share=(part.stop - part.start) / total)
        ax.plot(log.time[at], values[at], **how)


def _finish(ax: Axes, label: str, ends: tuple[float, float] | None, columns: int = 1) -> None:
    """Label, ends and legend of an axis of values."""
    ax.set(ylabel=label, ylim=ends)
    legend(ax, columns)


def _with_error(value: float, error: float, unit: str) -> str:
    """A value to the digits that its error leaves, the error, and its share."""
    known = value and error and np.isfinite(error)
    digits = int(np.clip(np.ceil(np.log10(abs(value) / error)) + 1, 1, 9)) if known else 4
    share = f" ({100.0 * error / abs(value):.2g} %)" if known else ""
    width = f" ± {error:.1g}" if error else ""
    return f"{value:.{digits}g}{width}{f' {unit}' if unit else ''}{share}"


def _intervals(found: Identification) -> Drawn:
    fitted = {
        path: one
        for path, one in found.summary["parameters"].items()
        if None not in (one.get("nominal"), one["value"], one["standard_error"])
    }
    held = [path for path in found.summary["held"] if path not in fitted]
    names = [*fitted, *held]
    figure, (ax,) = subplots(9.0, 1.1 + 0.4 * len(names))
    beside: Any = {"xycoords": ("axes fraction", "data"), "va": "center", "fontsize": 9}
    shown, drawn = [0.0], []
    for i, one in enumerate(fitted.values()):
        size = abs(one["nominal"]) or abs(one["value"]) or 1.0
        ends = [one["value"] if end is None else end for end in one["interval"]]
        low, middle, high = (100.0 * (end - one["nominal"]) / size for end in (ends[0], one["value"], ends[1]))
        ax.plot([low, high], [i, i], color=COLOURS[0], lw=5.0, alpha=0.45, solid_capstyle="butt")
        ax.plot([low, middle, high], [i] * 3, "|", color=COLOURS[0], ms=11, mew=1.6)
        ax.plot(middle, i, "o", color=COLOURS[0], ms=5)
        drawn.append((low, high))
        shown += [max(low, middle - 100.0), min(high, middle + 100.0)]
        half = 0.5 * abs(ends[1] - ends[0])
        ax.annotate(_with_error(one["value"], half, one.get("unit", "")), (1.01, i), **beside)
    for i in range(len(fitted), len(names)):
        ax.plot(0.0, i, "o", mfc="white", mec=FAINT, ms=6)
        ax.annotate("held at nominal: not seen in this log", (1.01, i), color="#555555", **beside)
    ax.axvline(0.0, color="black", lw=0.8, zorder=0)
    room = 0.06 * (max(shown) - min(shown)) or 1.0
    left, right = min(shown) - room, max(shown) + room
    for i, (low, high) in enumerate(drawn):
        for beyond, end, arrow in ((low < left, left, "<"), (high > right, right, ">")):
            if beyond:
                ax.plot(end, i, arrow, color=COLOURS[0], ms=8, clip_on=False, zorder=5)
    ax.set_yticks(range(len(names)), names)
    ax.set(xlabel="difference from the nominal value (% of it)", xlim=(left, right), ylim=(len(names) - 0.5, -0.5))
    caption = (
        "Fitted parameters as differences from their nominal values (the line at 0), with 95 % intervals that allow for "
        "correlated residuals; an arrow: the interval goes on. On the right: value, half width of the interval, and its "
        "share of the value."
    )
    return Drawn("intervals", figure, caption)


def _residuals(log: LogSignals) -> Drawn:
    residual = log.found.summary["residual"]
    figure, axes = stacked(len(residual), 2.0)
    for ax, (side, one) in zip(axes, residual.items(), strict=True):
        unit, values = log.unit[side], log[f"{side}.residual"]
        label = f"rms {one['rms']:.2g} {unit}, {one['rms'] / one['noise']:.3g} times the noise"
        _draw(ax, log, values, color=SIDE_COLOURS[side], lw=0.7, label=label)
        for sign in (-2.0, 2.0):
            ax.axhline(sign * one["noise"], color=_MODEL, lw=0.9, ls="--", label="± 2 noise")
        ax.set_ylabel(f"{side}:\nmeasured − model ({unit})")
        legend(ax, 2)
    caption = (
        "Measured position less that of the fitted model, window by window. Noise alone leaves the dashed lines in one "
        "sample of twenty; longer swings beyond them are an effect that the model lacks."
    )
    return Drawn("residuals", figure, caption)


def _both(log: LogSignals, columns: int, height: float) -> tuple[Figure, list[tuple[Axes, Axes]]]:
    """Pairs of axes: the detail above differences over the whole record; one time axis if they are the same."""
    shared = "col" if log.whole else False
    figure, axes = subplots(9.0, height, 2, columns, sharex=shared, height_ratios=(3, 2))
    pairs = list(zip(axes[:columns], axes[columns:], strict=True))
    for above, below in pairs:
        below.axhline(0.0, color=FAINT, lw=0.8, zorder=0)
        if log.whole:
            below.set_xlabel("time (s)")
        else:
            above.set(xlim=log.span, xlabel="time (s)")
            below.set(xlim=(log.time[0], log.time[-1]), xlabel="time (s), all of the record")
            below.axvspan(*log.span, color=COLOURS[5], alpha=0.25, lw=1.5)
    return figure, pairs


def _where(log: LogSignals) -> str:
    if log.whole:
        return ""
    low, high = log.span
    return f" Above: {low:.4g} to {high:.4g} s, where the motion is largest (shaded below)."


def _velocities(log: LogSignals) -> Drawn:
    figure, pairs = _both(log, len(log.sides), 4.6)
    for side, (above, below) in zip(log.sides, pairs, strict=True):
        smoothed, estimate, unit = log[f"{side}.velocity"], log[f"{side}.velocity_estimate"], f"{log.unit[side]}/s"
        _draw(above, log, estimate, log.detail, color=SIDE_COLOURS[side], lw=2.6, alpha=0.75, label="observer")
        _draw(above, log, smoothed, log.detail, color=_MODEL, lw=0.9, label="smoother")
        _finish(above, f"{side} velocity ({unit})", limits(smoothed[log.detail], estimate[log.line]), 2)
        error = estimate - smoothed
        share = log.rms(error) / (log.rms(smoothed) or 1.0)
        label = f"rms {log.rms(error):.2g} {unit} ({100.0 * share:.2g} %)"
        _draw(below, log, error, color=SIDE_COLOURS[side], lw=0.8, label=label)
        _finish(below, f"difference ({unit})", limits(error[log.settled], room=0.4))
    caption = (
        "Velocities by the observers, which use past samples only, and by the zero-phase smoother, which uses the whole log "
        f"(cf. Figs. 18, 19, 22 and 23). Below: observer − smoother; rms without the first tenth.{_where(log)}"
    )
    return Drawn("velocities", figure, caption)


def _torque(log: LogSignals) -> Drawn:
    figure, ((above, below),) = _both(log, 1, 5.4)
    reference, name = (log.law, "law") if log.measured is None else (log.measured, "measured")
    # the noisier one first, so that it does not hide the other
    for side in sorted(log.sides, key=lambda side: -log.rms(log.torques[side] - reference)):
        values = log.torques[side]
        _draw(above, log, values, log.detail, color=SIDE_COLOURS[side], lw=2.4, alpha=0.75, label=f"by the {side} side")
        error = values - reference
        label = f"{side} side − {name}, rms {log.rms(error):.2g} {log.torque_unit}"
        _draw(below, log, error, color=SIDE_COLOURS[side], lw=0.8, alpha=0.8, label=label)
    if log.measured is not None:
        _draw(above, log, log.measured, log.detail, color=_MEASURED, lw=1.6, label="measured")
        error = log.law - log.measured
        _draw(below, log, error, color=_MODEL, lw=0.8, label=f"law − measured, rms {log.rms(error):.2g} {log.torque_unit}")
    _draw(above, log, log.law, log.detail, color=_MODEL, lw=1.0, ls="--", label="fitted law at the measured twist")
    signals = [*log.torques.values(), log.law, *([] if log.measured is None else [log.measured])]
    errors = [one[log.settled] - reference[log.settled] for one in signals]
    _finish(above, f"transmitted torque ({log.torque_unit})", limits(*(one[log.line] for one in signals)), 4)
    _finish(below, f"difference ({log.torque_unit})", limits(*errors, room=0.3), 3)
    caption = (
        "Transmitted torque: by the equivalent control of each side less the fitted effects on that side, and by the fitted "
        "law at the measured twist, all behind the same low-pass. Where a side differs from the law, the law or that side's "
        f"equation of motion is incomplete.{_where(log)}"
    )
    return Drawn("torque", figure, caption)


def _cloud(ax: Axes, log: LogSignals, x: Array, y: Array, span: tuple[tuple[float, float], tuple[float, float]]) -> None:
    """All settled points of a plane: as points, or as their density where they are many."""
    x, y = x[log.settled], y[log.settled]
    finite = np.isfinite(x) & np.isfinite(y)
    x, y = x[finite], y[finite]
    if len(x) <= _CLOUD:
        ax.plot(x, y, ".", ms=2.0, mew=0.0, color=FAINT, zorder=1)
        return
    counts, *edges = np.histogram2d(x, y, bins=(280, 190), range=span)
    shown = np.where(counts > 0.0, counts, np.nan).T
    if np.isfinite(shown).any():
        scale = LogNorm(1.0, max(float(counts.max()), 2.0))
        ax.pcolormesh(*edges, shown, cmap=_DENSITY, norm=scale, rasterized=True, zorder=1)


def _shade_gap(ax: Axes, log: LogSignals) -> None:
    """The fitted gap, shaded, with its edges."""
    if not log.plant.half_gap:
        return
    label = f"fitted gap: half width {log.plant.half_gap:.4g} {log.unit['motor']}"
    ax.axvspan(-log.plant.half_gap, log.plant.half_gap, color=_GAP, alpha=0.6, lw=0.0, zorder=0, label=label)
    for sign in (-1.0, 1.0):
        ax.axvline(sign * log.plant.half_gap, color=COLOURS[4], lw=1.0, zorder=0.5)


def _plane_note(log: LogSignals) -> str:
    if log.whole:
        return "The line is all of the record but its first tenth."
    low, high = log.span
    return f"The line is {low:.4g} to {high:.4g} s, where the motion is largest; grey is all but the first tenth."


def _mean_over(twist: Array, torque: Array, rows: Array, span: tuple[float, float]) -> tuple[Array, Array]:
    """Mean torque of some rows in bins of twist; NaN in bins of fewer than four samples."""
    bins = int(np.clip(len(rows) // 15, 24, 80))
    edges = np.linspace(*span, bins + 1)
    at = np.digitize(twist[rows], edges)
    count = np.bincount(at, minlength=bins + 2)[1 : bins + 1]
    total = np.bincount(at, torque[rows], minlength=bins + 2)[1 : bins + 1]
    mean = np.where(count >= 4, total / np.maximum(count, 1), np.nan)
    return 0.5 * (edges[1:] + edges[:-1]), mean


def _means(ax: Axes, log: LogSignals, x: Array, torque: Array, rate: Array, name: str, span: tuple[float, float]) -> None:
    """The mean torque over x of settled samples, for both signs of its rate."""
    rows = np.arange(len(rate))[log.settled]
    rows = rows[np.isfinite(torque[rows])]
    for word, shade, chosen in (("growing", _GROWING, rate[rows] > 0.0), ("falling", _FALLING, ~(rate[rows] > 0.0))):
        mean = _mean_over(x, torque, rows[chosen], span)
        ax.plot(*mean, color=shade, lw=2.4, alpha=0.9, zorder=3, label=f"mean, {name} {word}")


def _hysteresis(log: LogSignals) -> Drawn:
    panels = [(f"by the {side} side", log.torques[side], SIDE_COLOURS[side]) for side in log.sides]
    if log.measured is not None:
        panels.append(("measured", log.measured, _MEASURED))
    across, up = limits(log.twist[log.settled]), limits(*(one[log.settled] for _, one, _ in panels))
    figure, axes = subplots(9.0, 4.4, columns=len(panels), beside=True, sharex=True, sharey=True)
    rate = log.low_passed(log.rate)
    for ax, (name, torque, colour) in zip(axes, panels, strict=True):
        _shade_gap(ax, log)
        if across and up:
            _cloud(ax, log, log.twist, torque, (across, up))
            ax.set(xlim=across, ylim=up)
            _means(ax, log, log.twist, torque, rate, "twist", across)
            twist = np.linspace(*across, 400)
            ax.plot(twist, log.law_at(twist), color=_MODEL, lw=1.2, ls="--", zorder=4, label="fitted law")
        ax.set_title(name, color=colour, loc="left")
        ax.set_xlabel(f"twist θe − N₀ θs ({log.unit['motor']})")
    axes[0].set_ylabel(f"transmitted torque ({log.torque_unit})")
    figure.legend(*axes[0].get_legend_handles_labels(), ncols=4, loc="outside upper right", columnspacing=1.2)
    caption = (
        "Transmitted torque over the measured twist, both behind the same low-pass (which rounds corners), with the fitted "
        "law (cf. Figs. 26 and 27); grey is all of the record but its first tenth. Where the means of the two directions "
        "differ, the model lacks friction or damping, or there is delay, the observer's included."
    )
    return Drawn("hysteresis", figure, caption)


def _limit_cycle(log: LogSignals) -> Drawn:
    unit, twist = log.unit["motor"], log["twist"]
    figure, (ax,) = subplots(9.0, 4.2)
    across, up = limits(twist[log.settled]), limits(log.rate[log.settled])
    _shade_gap(ax, log)
    if across and up:
        if log.settled.stop - log.settled.start <= _CYCLE_POINTS:
            ax.plot(twist[log.settled], log.rate[log.settled], color=FAINT, lw=0.6, alpha=0.5, zorder=1)
        else:
            _cloud(ax, log, twist, log.rate, (across, up))
        ax.set(xlim=across, ylim=up)
    ax.plot(twist[log.line], log.rate[log.line], color=COLOURS[3], lw=1.4, zorder=3)
    ax.axhline(0.0, color=FAINT, lw=0.8, zorder=0.6)
    ax.set(xlabel=f"twist θe − N₀ θs ({unit})", ylabel=f"twist rate by the smoother ({unit}/s)")
    if log.plant.half_gap:
        legend(ax)
    caption = (
        "Limit cycle: rate of the twist over the twist (cf. Fig. 28), run through clockwise. "
        + ("Free flight crosses the shaded gap; outside of it the gear is in contact. " if log.plant.half_gap else "")
        + _plane_note(log)
    )
    return Drawn("limit_cycle", figure, caption)


def _resistance(log: LogSignals) -> Drawn:
    """Of a rigid drive: the torque beyond its nominal equation, over time."""
    unit, estimate, effects = log.torque_unit, log["motor.torque_estimate"], log.effects("motor")
    figure, ((above, below),) = _both(log, 1, 5.0)
    _draw(above, log, estimate, log.detail, color=SIDE_COLOURS["motor"], lw=2.2, alpha=0.75, label="observer")
    fitted = np.zeros(len(estimate)) if effects is None else effects
    _draw(above, log, fitted, log.detail, color=_MODEL, lw=1.0, ls="--", label="fitted effects")
    error = estimate - fitted
    _draw(below, log, error, color=SIDE_COLOURS["motor"], lw=0.8, label=f"rms {log.rms(error):.2g} {unit}")
    what = "force" if unit == "N" else "torque"
    _finish(above, f"resisting {what} ({unit})", limits(estimate[log.line], fitted[log.line]), 2)
    _finish(below, f"difference ({unit})", limits(error[log.settled], room=0.3))
    caption = (
        f"The {what} beyond inertia and viscous friction, by the equivalent control of the observer and by the fitted "
        f"effects, behind the same low-pass. Below: observer − effects; rms without the first tenth.{_where(log)}"
    )
    return Drawn("resistance", figure, caption)


def _friction(log: LogSignals) -> Drawn:
    """Of a rigid drive: the torque beyond its nominal equation, over velocity."""
    unit, rows = log.torque_unit, log.settled
    estimate, effects = log["motor.torque_estimate"], log.effects("motor")
    velocity = log.low_passed(log["motor.velocity"])
    across, up = limits(velocity[rows]), limits(estimate[rows])
    what = "force" if unit == "N" else "torque"
    figure, (ax,) = subplots(9.0, 4.2)
    if across and up:
        _cloud(ax, log, velocity, estimate, (across, up))
        ax.set(xlim=across, ylim=up)
        # a line of the observer's own torque, which chatters, would fill the panel
        _means(ax, log, velocity, estimate, np.gradient(velocity), "velocity", across)
    shown = log.line
    if effects is not None:
        ax.plot(velocity[shown], effects[shown], color=_MODEL, lw=1.2, zorder=4, label="fitted effects")
    ax.set(xlabel=f"velocity by the smoother ({log.unit['motor']}/s)", ylabel=f"resisting {what} ({unit})")
    legend(ax, 3)
    caption = (
        f"The {what} beyond inertia and viscous friction over velocity, behind the same low-pass: friction as the log "
        "shows it (grey: samples by the observer, without the first tenth; lines: their means for either direction of the "
        "acceleration), and as fitted. The low-pass slants the reversals."
    )
    return Drawn("friction", figure, caption)


def _path(log: LogSignals) -> Drawn:
    found, names = log.found, list(log.found.summary["method"]["recursive"])
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
        fitted = found.summary["parameters"].get(path)
        if fitted is not None:
            interval = [fitted["value"] if end is None else end for end in fitted["interval"]]
            ax.axhspan(*interval, color=_MODEL, alpha=0.15, lw=0.0)
            ax.axhline(fitted["value"], color=_MODEL, lw=1.0, ls="--", label="trajectory fit, 95 %")
            ends.append(np.array(interval))
            lines.append(fitted["value"])
        label = with_unit(name.replace("_", " "), found.record.unit_of(path, units.get(name, "rad")))
        ax.set(ylabel=label, ylim=limits(*ends, share=0.02, room=0.25, shown=lines))
    legend(axes[0], 3, of=axes)
    caption = (
        "The paper's recursive identification (27)-(28) on the equivalent control of both sides, and the trajectory fit "
        "with its interval. The scale is that of the second half of the record."
    )
    return Drawn("recursive", figure, caption)
