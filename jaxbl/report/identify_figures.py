"""Figures of `jaxbl identify`: torque over twist or velocity, and what the model leaves."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.estimation.identify import Identification
from jaxbl.records import POSITION_CHANNELS
from jaxbl.records.linear_filters import filter_forwards
from jaxbl.records.signal_quality import longest_segment

from .motor_alone_figures import draw_motor_alone
from .panels import (
    BLACK,
    GREEN,
    PURPLE,
    SIDE_COLOURS,
    SIDES,
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

_SETTLING = 0.1
"""Share of the record left to the observers to converge: shown, but not in rms values and scales."""


class LogSignals:
    """Signals of a log, of the observers that ran on it and of the fitted model, as the figures compare them.

    Attributes:
        sides: that have an observer.
        geared: whether there is a load with an encoder of its own.
        unit: of positions, by side.
        observed: the longest part without gaps, which the observers ran on.
        settled: the observed part without its beginning, in which the observers converge.
    """

    def __init__(self, result: Identification):
        self.result, self.trace, self.record = result, result.trace, result.record
        self.time = self.trace["t"].to_numpy()
        self.sides = [side for side in SIDES if f"{side}.velocity" in self.trace]
        self.geared = "twist" in self.trace
        channels = self.record.statistics.channels
        self.unit = {side: channels[POSITION_CHANNELS[side]].unit for side in self.sides}
        self.torque_unit = "N" if self.unit["motor"] == "m" else "N m"
        experiment = result.model.build()
        self.plant, self.time_constant = experiment.plant, float(experiment.equivalent_control.time_constant)
        self.observed = longest_segment(self.record.segments)
        first, last = self.observed.start, self.observed.stop
        self.settled = slice(first + int(_SETTLING * (last - first)), last)

    def __getitem__(self, name: str) -> Array:
        """A column of the trace."""
        return self.trace[name].to_numpy(dtype=float)

    def low_passed(self, values: Array) -> Array:
        """Values behind the low-pass of the equivalent control, for the same lag; NaN outside the observed part."""
        filtered, part = np.full(len(values), np.nan), values[self.observed]
        if self.time_constant > 0.0 and np.isfinite(part).all():
            share = -np.expm1(-self.record.sample_period / self.time_constant)
            part = filter_forwards(part, [share], [share - 1.0])
        filtered[self.observed] = part
        return filtered

    def law_at(self, twist: Array) -> Array:
        """Torque of the fitted transmission at rest, without transmission errors."""
        # without a transmission error an effect answers the number 0.0, whatever the position
        effects = tuple(
            effect
            for effect in self.plant.effects
            if not isinstance(effect.transmission_error(effect.init(), jnp.zeros(())), jax.Array)
        )
        plant = dataclasses.replace(self.plant, effects=effects)
        with jax.enable_x64(True):
            still = {side: jnp.asarray(0.0) for side in SIDES}
            states = tuple(effect.init() for effect in effects)
            position = {"motor": jnp.asarray(twist), "load": jnp.zeros(len(twist))}
            torque, _ = jax.vmap(lambda angles: plant.transmitted_torque(angles, still, states))(position)
        return np.asarray(torque)

    def torque_by(self, side: str) -> Array:
        """Transmitted torque by a side: its observer's estimate less the fitted effects on that side."""
        estimate, effects = self[f"{side}.torque_estimate"], f"{side}.effects"
        if effects not in self.trace:
            return estimate
        return estimate + self.low_passed(self[effects]) / float(self.plant.drive.torque_gain(side))


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
    count, edges = np.histogram(twist[rows], bins, span)
    total, _ = np.histogram(twist[rows], bins, span, weights=torque[rows])
    return 0.5 * (edges[1:] + edges[:-1]), np.where(count >= 4, total / np.maximum(count, 1), np.nan)


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
    torques = {f"by the {side} side": log.torque_by(side) for side in log.sides}
    if "transmitted" in log.trace:
        torques["measured"] = log.low_passed(log["transmitted"])
    rate = log["motor.velocity"] - float(log.plant.drive.ratio("load")) * log["load.velocity"]
    twist, rate = map(log.low_passed, (log["twist"], rate))
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
    estimate = log["motor.torque_estimate"]
    velocity, quantity = log.low_passed(log["motor.velocity"]), missing_quantity(unit)
    across = limits(velocity[rows])
    # a line of the observer's own torque, which chatters, would fill the panel
    parts = _means(log, velocity, estimate, np.gradient(velocity), "velocity", across)
    if "motor.effects" in log.trace:
        parts.append(Line(velocity[rows], log.low_passed(log["motor.effects"])[rows], "fitted effects", width=1.2))
    x = Axis(f"velocity by the smoother ({log.unit['motor']}/s)", ends=across)
    y = Axis(f"resisting {quantity} ({unit})", ends=limits(estimate[rows]))
    return Figure(
        "friction",
        [Panel(x, y, parts)],
        f"The {quantity} beyond inertia and viscous friction over velocity, behind the same low-pass: friction as the log "
        "shows it (grey: samples by the observer, without the first tenth; lines: their means for either direction of the "
        "acceleration), and as fitted. The low-pass slants the reversals.",
    )
