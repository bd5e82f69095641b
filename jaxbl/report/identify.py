"""What `jaxbl identify` leaves to be read: numbers with intervals, and what the log shows of motion, torque and gap."""

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.estimation.identify import Identification
from jaxbl.estimation.search import is_noise
from jaxbl.json_types import JsonObject
from jaxbl.lines import DOUBT, Lines, percent
from jaxbl.quantity import Quantity, read_quantities
from jaxbl.records.linear_filters import filter_forwards
from jaxbl.records.signal_quality import longest_segment
from jaxbl.result import KeyFigure, Result

from .numbers import lead_with_doubt, number_figures, number_table, write as write
from .panels import (
    BLACK,
    BLUE,
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
    Span,
    cloud,
    join,
    limits,
    missing_quantity,
    shade_gap,
)


def describe(summary: JsonObject) -> Result:
    """Say whether the model explains the log, and which numbers it has, from an `identification.json`."""
    parameters = read_quantities(summary["parameters"])
    numbers = {path: number for path, number in parameters.items() if number.is_finite}
    size = "; ".join(f"{side}: {_size(residual)}" for side, residual in summary["residual"].items())
    verdict, headline = "good", f"The model explains the log: no more than noise is left of the positions ({size})."
    if not numbers:
        verdict, headline = "no answer", "This log identifies none of the model's numbers."
    elif not all(map(is_noise, summary["residual"].values())):
        verdict = "doubtful"
        headline = f"The model does not explain the log, so its numbers may be wrong: more than noise is left ({size})."
    heading, rejected = "Parameters", summary.get("rejected")

    remarks = [*summary["warnings"], *_far_off(parameters)]
    if rejected:
        heading = "Parameters of a fit that leaves more than noise"
        if lacks := rejected["lacks"]:
            remarks.append(
                f"{percent(lacks['share'])} of the torque left over on the {lacks['equation']} goes with its "
                f"{lacks['channel']}: an effect is missing."
            )
    remarks += [f"{path}: not identifiable from this log." for path in parameters if path not in numbers]
    title = summary["title"] or f"Identification from {Path(summary['file']).name}"
    figures = [*_backlash(summary), *number_figures(numbers)][:4]
    tables = [number_table(heading, summary["parameters"])]
    return lead_with_doubt(Result(title, verdict, headline, figures, remarks, [*_details(summary)], tables))


_FAR = 10.0
"""Factor between an inertia or a stiffness and its nominal value from which on a unit is rather wrong: data sheets and CAD
know them within a factor of two."""


def _far_off(parameters: Mapping[str, Quantity]) -> Lines:
    """Say which inertias and stiffnesses cannot be what was given."""
    far = [
        f"{path} is {number.factor:.3g} times its nominal value"
        for path, number in parameters.items()
        if path.endswith(("inertia", ".stiffness")) and (number.factor <= 1.0 / _FAR or number.factor >= _FAR)
    ]
    return [f"{DOUBT}{', '.join(far)}: a unit, a factor or a sign in [log] may be wrong."] if far else []


def _backlash(summary: JsonObject) -> Iterator[KeyFigure]:
    """Say what a log without the load's encoder shows of a gap."""
    gap = summary.get("backlash")
    if gap and gap["shown"]:
        unit, count = summary["residual"]["motor"]["unit"], gap["crossings"]
        meaning = f"half gap at the motor, from {count} crossings; without it its readings cannot be met"
        yield KeyFigure(f"{gap['half_gap']:.4g} {unit}", meaning)
    elif gap:
        yield KeyFigure("No gap is shown", gap["why"])


def _details(summary: JsonObject) -> Iterator[str]:
    """Say what cannot be identified, how the fit was made, and what it leaves."""
    fit, gap = summary["method"]["trajectory"], summary.get("backlash")
    for refusal in summary["refused"]:
        shares = ", ".join(f"{path} {share:+.2f}" for path, share in refusal["direction"].items())
        # what the gap's figure says already is left out
        if not gap or refusal["why"] != gap["why"]:
            yield f"Not identifiable: {shares}: {refusal['why']}."
    if summary["held"]:
        yield f"Held at the nominal value, which the other numbers depend on: {', '.join(summary['held'])}."
    meanings = ["the model is incomplete", "noise alone"]
    how = (
        f"{fit['windows']} windows of {fit['window']:.3g} s with free initial states; {fit['starts_agreeing']} of "
        f"{fit['starts']} starts agree."
    )
    if "backlash" in summary:
        how = "Fitted to the prediction errors of the motor over all of the log; the load moves as the model says."
        meanings[0] = "noise of the torque, or something that the model lacks"
    for side, residual in summary["residual"].items():
        yield f"{side}: position residual {_size(residual)}: {meanings[is_noise(residual)]}."
    yield how
    if not fit["converged"]:
        yield "The fit stopped before it reached its tolerance."
    if summary["torque"]:
        yield f"Torque error of the model, rms: {_shares(summary['torque'])}."
    for side, gains in summary.get("gains", {}).items():
        error = gains["velocity_error"]
        yield (
            f"{side} observer: no gains that were tried follow the log; those in model.toml do not, either."
            if error is None
            else f"{side} observer: lambda = {gains['lambda_']:.3g}, alpha = {gains['alpha']:.3g}, chosen on the log for "
            f"f⁺ = {gains['f_plus']:.3g}; its velocity differs from the smoothed one by {error:.2g} rms."
        )
    if "holdout" in summary:
        yield from _on_holdout(summary["holdout"])
    yield from summary["notes"]


def _size(residual: JsonObject) -> str:
    return f"{residual['rms']:.2g} {residual['unit']} rms, {residual['rms'] / residual['noise']:.3g} times the noise"


def _shares(torque: JsonObject) -> str:
    return ", ".join(f"{_share(error)} ({name})" for name, error in torque.items())


def _share(error: JsonObject, model: str = "") -> str:
    """A torque error as a share of the driving torque, or in its unit where nothing drives."""
    relative = error[f"{model}relative"]
    return f"{error[f'{model}rms']:.2g} {error['unit']} rms" if relative is None else percent(relative)


def _on_holdout(holdout: JsonObject) -> Iterator[str]:
    name = Path(holdout["file"]).name
    for side, residual in holdout["position"].items():
        yield (
            f"On {name}, {side}: position residual over {holdout['window']:.3g} s {_size(residual)}; with the nominal "
            f"numbers {residual['nominal_rms']:.2g}."
        )
    if holdout["torque"]:
        before = ", ".join(_share(error, "nominal_") for error in holdout["torque"].values())
        yield f"On {name}, torque error rms: {_shares(holdout['torque'])}; with the nominal numbers {before}."


_SETTLING = 0.1
"""Share of the record left to the observers to converge: shown, but not in rms values and scales."""


class LogSignals:
    """Signals of a log's longest part without gaps, which the observers ran on, and of the fitted model, as the figures
    compare them.

    Attributes:
        sides: that have an observer.
        unit: of the motor's position.
        settled: the rows without those at the beginning, in which the observers converge.
    """

    def __init__(self, result: Identification):
        self.record = result.record
        self.trace = result.trace.iloc[longest_segment(self.record.segments)]
        self.sides = [side for side in SIDES if f"{side}.velocity" in self.trace]
        self.unit = self.record.unit_of("motor.position", "rad")
        self.torque_unit = self.record.unit_of("motor.torque", "N m")
        experiment = result.model.build()
        self.plant, self.time_constant = experiment.plant, float(experiment.equivalent_control.time_constant)
        self.settled = slice(int(_SETTLING * len(self.trace)), None)

    def __getitem__(self, name: str) -> Array:
        """A column of the trace."""
        return self.trace[name].to_numpy(dtype=float)

    def low_passed(self, values: Array) -> Array:
        """Values behind the low-pass of the equivalent control, for the same lag."""
        if self.time_constant == 0.0 or not np.isfinite(values).all():
            return values
        share = -np.expm1(-self.record.sample_period / self.time_constant)
        return filter_forwards(values, [share], [share - 1.0])

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
            still = {side: jnp.zeros(len(twist)) for side in SIDES}
            states = tuple(effect.init() for effect in effects)
            torque, _ = plant.transmitted_torque(still | {"motor": jnp.asarray(twist)}, still, states)
        return np.asarray(torque)

    def torque_by(self, side: str) -> Array:
        """Transmitted torque by a side: its observer's estimate less the fitted effects on that side."""
        estimate, effects = self[f"{side}.torque_estimate"], f"{side}.effects"
        if effects not in self.trace:
            return estimate
        return estimate + self.low_passed(self[effects]) / float(self.plant.drive.torque_gain(side))


def draw(result: Identification) -> Iterator[Figure]:
    """All figures of an identification."""
    if "backlash" in result.summary:
        yield draw_motor_alone(result)
    elif "twist" in result.trace:
        # of a load with an encoder of its own
        yield _hysteresis(LogSignals(result))
    else:
        yield _friction(LogSignals(result))
    yield _residuals(result)


def _residuals(result: Identification) -> Figure:
    panels = []
    for side, sizes in result.summary["residual"].items():
        noise = sizes["noise"]
        name = f"rms {sizes['rms']:.2g} {sizes['unit']}, {sizes['rms'] / noise:.3g} times the noise"
        time, residual = join(result.trace["t"], result.record.segments, result.trace[f"{side}.residual"])
        line = Line(time, residual, name, SIDE_COLOURS[side], 0.7)
        limits_of_noise = [Span(end, end, "± 2 noise", along="y", width=0.9) for end in (-2.0 * noise, 2.0 * noise)]
        panels.append(Panel(TIME, Axis(f"{side}: measured\n− model ({sizes['unit']})"), [line, *limits_of_noise]))
    return Figure(
        "residuals",
        panels,
        "Measured position less that of the fitted model, window by window. Noise alone crosses the lines at ± 2 in one "
        "sample of twenty; longer swings beyond them are an effect that the model lacks.",
        height=2.0,
    )


def _means(log: LogSignals, x: Array, torque: Array, rate: Array, name: str, span: Pair | None) -> Iterator[Line]:
    """Settled samples of a torque over x, as far as it goes, and their means for both signs of its rate, in bins of at least
    four samples."""
    if span is None:
        return
    x, torque, rate = (signal[log.settled] for signal in (x, torque, rate))
    yield cloud(x, torque)
    finite, grows = np.isfinite(torque), rate > 0.0
    for word, colour, rows in (("growing", GREEN, finite & grows), ("falling", PURPLE, finite & ~grows)):
        bins = int(np.clip(np.sum(rows) // 15, 24, 80))
        count, edges = np.histogram(x[rows], bins, span)
        total, _ = np.histogram(x[rows], bins, span, weights=torque[rows])
        mean = np.where(count >= 4, total / np.maximum(count, 1), np.nan)
        yield Line(0.5 * (edges[1:] + edges[:-1]), mean, f"mean, {name} {word}", colour, 2.4, opacity=0.9)


def _hysteresis(log: LogSignals) -> Figure:
    torques = {f"by the {side} side": log.torque_by(side) for side in log.sides}
    if "transmitted" in log.trace:
        torques["measured"] = log.low_passed(log["transmitted"])
    rate = log.low_passed(log["motor.velocity"] - float(log.plant.drive.ratio("load")) * log["load.velocity"])
    twist = log.low_passed(log["twist"])
    across = limits(twist[log.settled])
    x = Axis(f"twist θe − N₀ θs ({log.unit})", ends=across)
    y = Axis(f"transmitted torque ({log.torque_unit})", ends=limits(*(torque[log.settled] for torque in torques.values())))
    panels, half = [], log.plant.half_gap
    gap = shade_gap(half, f"fitted gap: half width {half:.4g} {log.unit}")
    for name, torque in torques.items():
        parts = [*gap, *_means(log, twist, torque, rate, "twist", across)]
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
    parts = [*_means(log, velocity, estimate, np.gradient(velocity), "velocity", across)]
    if "motor.effects" in log.trace:
        parts.append(Line(velocity[rows], log.low_passed(log["motor.effects"])[rows], "fitted effects", width=1.2))
    x = Axis(f"velocity by the smoother ({log.unit}/s)", ends=across)
    y = Axis(f"resisting {quantity} ({unit})", ends=limits(estimate[rows]))
    return Figure(
        "friction",
        [Panel(x, y, parts)],
        f"The {quantity} beyond inertia and viscous friction over velocity, behind the same low-pass: friction as the log "
        "shows it (grey: samples by the observer, without the first tenth; lines: their means for either direction of the "
        "acceleration), and as fitted. The low-pass slants the reversals.",
    )


def draw_motor_alone(result: Any) -> Figure:
    """Draw what the motor alone shows in an `Identification` or a `Diagnosis`: the torque in the gear over the twist, by
    the motor's side and of the model, with the gap if there is one."""
    unit, torque_unit = result.record.unit_of("motor.position", "rad"), result.record.unit_of("motor.torque", "N m")
    trace, gap = result.trace.iloc[len(result.trace) // 10 :], result.summary["backlash"]
    ratio = float(result.model.build().plant.drive.ratio("load"))
    twist = trace["theta_e"] - ratio * trace["load.modelled_position"]
    by_motor, law = trace["torque_by_motor"], trace["torque"]
    half = (gap and gap["half_gap"]) or 0.0
    parts = [
        *shade_gap(half, f"gap: half width {half:.4g} {unit}"),
        cloud(twist, by_motor, "by the motor's side", BLUE),
        cloud(twist, law, "model", BLACK),
    ]
    x = Axis(f"twist θe − N₀ θs, the load's position by the model ({unit})", ends=limits(twist))
    return Figure(
        "hysteresis",
        [Panel(x, Axis(f"torque in the gear ({torque_unit})", ends=limits(by_motor, law)), parts)],
        "Torque in the gear over the twist. Blue: what the motor's torque, smoothed acceleration and friction leave for the "
        "gear, which uses the motor's encoder only. Black: the model. Within the gap the motor drives nothing but itself. "
        "Smoothing rounds the impacts.",
    )
