"""Figures of `jaxbl identify`. Those of motion and torque are the analogues of Figs. 18 to 28 of the paper.

Where a log is long they show the few cycles with the largest motion in detail, and the whole of it in outline.
"""

from typing import Any

import numpy as np

from jaxbl.drive.parameters import units_of
from jaxbl.estimation.identify import Identification
from jaxbl.lines import percent
from jaxbl.quantity import Quantity

from .log_signals import LogSignals
from .motor_alone_figures import draw_motor_alone
from .panels import (
    BLACK,
    BLUE,
    FAINT,
    GREEN,
    PURPLE,
    SIDE_COLOURS,
    SKY,
    TIME,
    ZERO,
    Array,
    Axis,
    Figure,
    Line,
    Pair,
    Panel,
    Part,
    Span,
    cloud,
    intervals,
    join,
    limits,
    missing_quantity,
    name_rows,
    shade_gap,
    stack,
    with_unit,
)

_MEASURED = GREEN


def draw_identification(result: Identification) -> list[Figure]:
    """All figures of an identification."""
    log = LogSignals(result)
    if "backlash" in result.summary:
        return [_intervals(result), *draw_motor_alone(result), _residuals(log)]
    first, *more = [_hysteresis, _torque, _limit_cycle] if log.geared else [_friction, _resistance]
    figures = [first(log), _intervals(result), _residuals(log), *(draw(log) for draw in more), _velocities(log)]
    return [*figures, _path(log)] if result.summary["method"]["recursive"] else figures


def _line(log: LogSignals, values: Array, name: str, rows: slice | None = None, **how: Any) -> Line:
    """A signal over time, broken at gaps."""
    time, values = join(log.time, log.parts(rows), values)
    return Line(time, values, name, **how)


def _intervals(result: Identification) -> Figure:
    fitted = {
        path: (number, nominal)
        for path, number in result.parameters.items()
        if (nominal := number.nominal) is not None and number.is_finite
    }
    ends, names, inside = [], [], [0.0]
    for path, (number, nominal) in fitted.items():
        value, (low, high) = number.value, number.ends()
        half, size = 0.5 * abs(high - low), abs(nominal) or abs(value) or 1.0
        low, middle, high = (100.0 * (end - nominal) / size for end in (low, value, high))
        ends.append((low, middle, high))
        inside += [max(low, middle - 100.0), min(high, middle + 100.0)]
        names.append(f"{path}\n{Quantity(value, half, unit=number.unit)} ({percent(half / (abs(value) or 1.0))})")
    held = [path for path in dict.fromkeys(result.summary["held"]) if path not in fitted]
    names += [f"{path}\nheld at nominal: not seen in this log" for path in held]
    room = 0.06 * (max(inside) - min(inside)) or 1.0
    places, count = np.arange(len(names)), len(fitted)
    low, middle, high = np.reshape(ends, (-1, 3)).T
    drawn = [
        Span(0.0, 0.0, width=0.8, dashes="-"),
        *intervals(places[:count], low, middle, high, colour=BLUE),
        Line(np.zeros(len(held)), places[count:], colour=FAINT, width=0.0, marker="o", fill="#FFFFFF"),
    ]
    x = Axis("difference from the nominal value (% of it)", ends=(min(inside) - room, max(inside) + room))
    caption = (
        "Fitted parameters as differences from their nominal values (the line at 0), with 95 % intervals that allow for "
        "correlated residuals; below each name its value, half width of the interval, and its share of the value."
    )
    return Figure("intervals", [Panel(x, name_rows(names), drawn)], caption, height=0.9 + 0.45 * len(names))


def _residuals(log: LogSignals) -> Figure:
    panels = []
    for side, sizes in log.found.summary["residual"].items():
        unit, rms, noise = log.unit[side], sizes["rms"], sizes["noise"]
        name = f"rms {rms:.2g} {unit}, {rms / noise:.3g} times the noise"
        parts = [_line(log, log[f"{side}.residual"], name, colour=SIDE_COLOURS[side], width=0.7)]
        parts += [Span(end, end, "± 2 noise", along="y", width=0.9) for end in (-2.0 * noise, 2.0 * noise)]
        panels.append(Panel(TIME, Axis(f"{side}: measured\n− model ({unit})"), parts))
    return stack(
        "residuals",
        panels,
        "Measured position less that of the fitted model, window by window. Noise alone leaves the dashed lines in one "
        "sample of twenty; longer swings beyond them are an effect that the model lacks.",
        2.0,
    )


def _pair(log: LogSignals, above: tuple[Axis, list[Part]], below: tuple[Axis, list[Part]]) -> list[Panel]:
    """Signals in detail, and below their differences over the whole record."""
    axes, marked = [TIME] * 2, []
    if not log.whole:
        ends = float(log.time[0]), float(log.time[-1])
        axes = [Axis("time (s)", ends=log.span), Axis("time (s), all of the record", ends=ends)]
        marked = [Span(*log.span, colour=SKY)]
    return [Panel(axes[0], *above), Panel(axes[1], below[0], [ZERO, *marked, *below[1]])]


def _where(log: LogSignals) -> str:
    if log.whole:
        return ""
    low, high = log.span
    return f" Above: {low:.4g} to {high:.4g} s, where the motion is largest (shaded below)."


def _velocities(log: LogSignals) -> Figure:
    pairs = []
    for side in log.sides:
        smoothed, estimate, unit = log[f"{side}.velocity"], log[f"{side}.velocity_estimate"], f"{log.unit[side]}/s"
        lines: list[Part] = [
            _line(log, estimate, "observer", log.detail, colour=SIDE_COLOURS[side], width=2.6, opacity=0.75),
            _line(log, smoothed, "smoother", log.detail, width=0.9),
        ]
        above = Axis(f"{side} velocity ({unit})", ends=limits(smoothed[log.detail], estimate[log.line]))
        error = estimate - smoothed
        share = log.rms(error) / (log.rms(smoothed) or 1.0)
        name = f"rms {log.rms(error):.2g} {unit} ({percent(share)})"
        below = Axis(f"difference ({unit})", ends=limits(error[log.settled], room=0.4))
        difference = _line(log, error, name, colour=SIDE_COLOURS[side], width=0.8)
        pairs.append(_pair(log, (above, lines), (below, [difference])))
    return Figure(
        "velocities",
        [panel for row in zip(*pairs, strict=True) for panel in row],
        "Velocities by the observers, which use past samples only, and by the zero-phase smoother, which uses the whole log "
        f"(cf. Figs. 18, 19, 22 and 23). Below: observer − smoother; rms without the first tenth.{_where(log)}",
        columns=len(pairs),
        width=9.0 if len(pairs) > 1 else 6.8,
        height=2.2,
    )


def _torque(log: LogSignals) -> Figure:
    law, measured, unit = log.low_passed(log["torque"]), log.measured_torque, log.torque_unit
    reference, name = (law, "law") if measured is None else (measured, "measured")
    errors = {side: torque - reference for side, torque in log.torques.items()}
    above, below = list[Part](), list[Part]()
    # the noisier one first, so that it does not hide the other
    for side in sorted(log.sides, key=lambda side: -log.rms(errors[side])):
        torque, error, colour = log.torques[side], errors[side], SIDE_COLOURS[side]
        above.append(_line(log, torque, f"by the {side} side", log.detail, colour=colour, width=2.4, opacity=0.75))
        text = f"{side} side − {name}, rms {log.rms(error):.2g} {unit}"
        below.append(_line(log, error, text, colour=colour, width=0.8, opacity=0.8))
    signals, error = [*log.torques.values(), law], law - reference
    if measured is not None:
        signals.append(measured)
        above.append(_line(log, measured, "measured", log.detail, colour=_MEASURED, width=1.6))
        below.append(_line(log, error, f"law − measured, rms {log.rms(error):.2g} {unit}", width=0.8))
    above.append(_line(log, law, "fitted law at the measured twist", log.detail, width=1.0, dashes="--"))
    ends = limits(*(signal[log.settled] - reference[log.settled] for signal in signals), room=0.3)
    axes = Axis(f"transmitted torque ({unit})", ends=limits(*(signal[log.line] for signal in signals)))
    return Figure(
        "torque",
        _pair(log, (axes, above), (Axis(f"difference ({unit})", ends=ends), below)),
        "Transmitted torque: by the equivalent control of each side less the fitted effects on that side, and by the fitted "
        "law at the measured twist, all behind the same low-pass. Where a side differs from the law, the law or that side's "
        f"equation of motion is incomplete.{_where(log)}",
        height=2.4,
    )


def _gap_parts(log: LogSignals) -> list[Part]:
    """The fitted gap, shaded."""
    half = log.plant.half_gap
    return [shade_gap(half, f"fitted gap: half width {half:.4g} {log.unit['motor']}")] if half else []


def _mean_over(twist: Array, torque: Array, rows: Array, span: Pair) -> tuple[Array, Array]:
    """Mean torque of some rows in bins of twist; NaN in bins of fewer than four samples."""
    bins = int(np.clip(len(rows) // 15, 24, 80))
    edges = np.linspace(*span, bins + 1)
    bin_of_row = np.digitize(twist[rows], edges)
    count, total = (np.bincount(bin_of_row, weights, minlength=bins + 2)[1 : bins + 1] for weights in (None, torque[rows]))
    mean = np.where(count >= 4, total / np.maximum(count, 1), np.nan)
    return 0.5 * (edges[1:] + edges[:-1]), mean


def _means(log: LogSignals, x: Array, torque: Array, rate: Array, name: str, span: Pair | None) -> list[Line]:
    """Settled samples of a torque over x, as far as it goes, and their means for both signs of its rate."""
    rows = np.arange(len(rate))[log.settled]
    rows = rows[np.isfinite(torque[rows])]
    if span is None:
        return []
    return [cloud(x[log.settled], torque[log.settled])] + [
        Line(*_mean_over(x, torque, rows[chosen], span), f"mean, {name} {word}", colour, 2.4, opacity=0.9)
        for word, colour, chosen in (("growing", GREEN, rate[rows] > 0.0), ("falling", PURPLE, ~(rate[rows] > 0.0)))
    ]


def _hysteresis(log: LogSignals) -> Figure:
    torques = {f"by the {side} side": log.torques[side] for side in log.sides}
    if log.measured_torque is not None:
        torques["measured"] = log.measured_torque
    twist, rate = map(log.low_passed, (log["twist"], log.rate))
    across = limits(twist[log.settled])
    x = Axis(f"twist θe − N₀ θs ({log.unit['motor']})", ends=across)
    y = Axis(f"transmitted torque ({log.torque_unit})", ends=limits(*(torque[log.settled] for torque in torques.values())))
    panels = []
    for name, torque in torques.items():
        parts = [*_gap_parts(log), *_means(log, twist, torque, rate, "twist", across)]
        if across:
            twists = np.linspace(*across, 400)
            parts.append(Line(twists, log.law_at(twists), "fitted law", BLACK, 1.2, "--"))
        panels.append(Panel(x, y, parts, name))
    return Figure(
        "hysteresis",
        panels,
        "Transmitted torque over the measured twist, both behind the same low-pass (which rounds corners), with the fitted "
        "law (cf. Figs. 26 and 27); grey is all of the record but its first tenth. Where the means of the two directions "
        "differ, the model lacks friction or damping, or there is delay, the observer's included.",
        columns=len(panels),
        width=max(3.4 * len(panels), 5.0),
    )


def _limit_cycle(log: LogSignals) -> Figure:
    unit, twist, rate, rows = log.unit["motor"], log["twist"], log.rate, log.settled
    parts = [*_gap_parts(log), ZERO, cloud(twist[rows], rate[rows])]
    parts.append(Line(twist[log.line], rate[log.line], colour=PURPLE))
    x = Axis(f"twist θe − N₀ θs ({unit})", ends=limits(twist[rows]))
    y = Axis(f"twist rate by the smoother ({unit}/s)", ends=limits(rate[rows]))
    caption = "Limit cycle: rate of the twist over the twist (cf. Fig. 28), run through clockwise. "
    if log.plant.half_gap:
        caption += "Free flight crosses the shaded gap; outside of it the gear is in contact. "
    if log.whole:
        caption += "The line is all of the record but its first tenth."
    else:
        low, high = log.span
        caption += f"The line is {low:.4g} to {high:.4g} s, where the motion is largest; grey is all but the first tenth."
    return Figure("limit_cycle", [Panel(x, y, parts)], caption)


def _resistance(log: LogSignals) -> Figure:
    """The torque of a rigid drive beyond its nominal equation, over time."""
    unit, estimate, effects = log.torque_unit, log["motor.torque_estimate"], log.effects("motor")
    fitted, colour = np.zeros(len(estimate)) if effects is None else effects, SIDE_COLOURS["motor"]
    lines: list[Part] = [
        _line(log, estimate, "observer", log.detail, colour=colour, width=2.2, opacity=0.75),
        _line(log, fitted, "fitted effects", log.detail, width=1.0, dashes="--"),
    ]
    error, quantity = estimate - fitted, missing_quantity(unit)
    difference = _line(log, error, f"rms {log.rms(error):.2g} {unit}", colour=colour, width=0.8)
    above = Axis(f"resisting {quantity} ({unit})", ends=limits(estimate[log.line], fitted[log.line]))
    below = Axis(f"difference ({unit})", ends=limits(error[log.settled], room=0.3))
    return Figure(
        "resistance",
        _pair(log, (above, lines), (below, [difference])),
        f"The {quantity} beyond inertia and viscous friction, by the equivalent control of the observer and by the fitted "
        f"effects, behind the same low-pass. Below: observer − effects; rms without the first tenth.{_where(log)}",
        height=2.3,
    )


def _friction(log: LogSignals) -> Figure:
    """The torque of a rigid drive beyond its nominal equation, over velocity."""
    unit, rows = log.torque_unit, log.settled
    estimate, effects = log["motor.torque_estimate"], log.effects("motor")
    velocity, quantity = log.low_passed(log["motor.velocity"]), missing_quantity(unit)
    across = limits(velocity[rows])
    # a line of the observer's own torque, which chatters, would fill the panel
    parts = _means(log, velocity, estimate, np.gradient(velocity), "velocity", across)
    if effects is not None:
        parts.append(Line(velocity[log.line], effects[log.line], "fitted effects", width=1.2))
    x = Axis(f"velocity by the smoother ({log.unit['motor']}/s)", ends=across)
    y = Axis(f"resisting {quantity} ({unit})", ends=limits(estimate[rows]))
    return Figure(
        "friction",
        [Panel(x, y, parts)],
        f"The {quantity} beyond inertia and viscous friction over velocity, behind the same low-pass: friction as the log "
        "shows it (grey: samples by the observer, without the first tenth; lines: their means for either direction of the "
        "acceleration), and as fitted. The low-pass slants the reversals.",
    )


def _path(log: LogSignals) -> Figure:
    result, panels = log.found, []
    late = slice((log.observed.start + log.observed.stop) // 2, log.observed.stop)
    # what a law derives from its own parameters is an angle, as they are
    units = units_of(log.experiment.transmission)
    for name in result.summary["method"]["recursive"]:
        values, path = {side: log[f"{side}.{name}"] for side in log.sides}, f"transmission.{name}"
        parts: list[Part] = [
            _line(log, signal, f"recursive, {side} side", log.observed, colour=SIDE_COLOURS[side])
            for side, signal in values.items()
        ]
        ends, fitted = [signal[late] for signal in values.values()], result.parameters.get(path)
        if fitted is not None:
            low, high = fitted.ends()
            parts.insert(0, Span(low, high, colour=BLACK, along="y", opacity=0.15))
            parts.append(Span(fitted.value, fitted.value, "trajectory fit, 95 %", along="y"))
            ends.append(np.array(fitted.ends()))
        label = with_unit(name.replace("_", " "), result.record.unit_of(path, units.get(name, "rad")))
        inside = [] if fitted is None else [fitted.value]
        panels.append(Panel(TIME, Axis(label, ends=limits(*ends, share=0.02, room=0.25, inside=inside)), parts))
    return stack(
        "recursive",
        panels,
        "The paper's recursive identification (27)-(28) on the equivalent control of both sides, and the trajectory fit "
        "with its interval. The scale is that of the second half of the record.",
        2.1,
    )
