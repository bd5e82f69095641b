"""Figures of `jaxbl identify`: torque over twist or velocity, and what the model leaves."""

import numpy as np

from jaxbl.estimation.identify import Identification

from .log_signals import LogSignals
from .motor_alone_figures import draw_motor_alone
from .panels import (
    BLACK,
    GREEN,
    PURPLE,
    SIDE_COLOURS,
    TIME,
    Array,
    Axis,
    Figure,
    Line,
    Pair,
    Panel,
    Part,
    Span,
    cloud,
    join,
    limits,
    missing_quantity,
    shade_gap,
    stack,
)


def draw(result: Identification) -> list[Figure]:
    """All figures of an identification."""
    log = LogSignals(result)
    if "backlash" in result.summary:
        return [draw_motor_alone(result), _residuals(log)]
    first = _hysteresis if log.geared else _friction
    return [first(log), _residuals(log)]


def _residuals(log: LogSignals) -> Figure:
    panels = []
    for side, sizes in log.result.summary["residual"].items():
        unit, rms, noise = log.unit[side], sizes["rms"], sizes["noise"]
        name = f"rms {rms:.2g} {unit}, {rms / noise:.3g} times the noise"
        time, residual = join(log.time, log.record.segments, log[f"{side}.residual"])
        parts: list[Part] = [Line(time, residual, name, SIDE_COLOURS[side], 0.7)]
        parts += [Span(end, end, "± 2 noise", along="y", width=0.9) for end in (-2.0 * noise, 2.0 * noise)]
        panels.append(Panel(TIME, Axis(f"{side}: measured\n− model ({unit})"), parts))
    return stack(
        "residuals",
        panels,
        "Measured position less that of the fitted model, window by window. Noise alone crosses the lines at ± 2 in one "
        "sample of twenty; longer swings beyond them are an effect that the model lacks.",
        2.0,
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


def _friction(log: LogSignals) -> Figure:
    """The torque of a rigid drive beyond its nominal equation, over velocity."""
    unit, rows = log.torque_unit, log.settled
    estimate, effects = log["motor.torque_estimate"], log.effects("motor")
    velocity, quantity = log.low_passed(log["motor.velocity"]), missing_quantity(unit)
    across = limits(velocity[rows])
    # a line of the observer's own torque, which chatters, would fill the panel
    parts = _means(log, velocity, estimate, np.gradient(velocity), "velocity", across)
    if effects is not None:
        parts.append(Line(velocity[rows], effects[rows], "fitted effects", width=1.2))
    x = Axis(f"velocity by the smoother ({log.unit['motor']}/s)", ends=across)
    y = Axis(f"resisting {quantity} ({unit})", ends=limits(estimate[rows]))
    return Figure(
        "friction",
        [Panel(x, y, parts)],
        f"The {quantity} beyond inertia and viscous friction over velocity, behind the same low-pass: friction as the log "
        "shows it (grey: samples by the observer, without the first tenth; lines: their means for either direction of the "
        "acceleration), and as fitted. The low-pass slants the reversals.",
    )
