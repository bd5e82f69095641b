"""What `jaxbl simulate` leaves to be read. The figures are the analogues of Figs. 7 to 17, 28 and 29 of the paper."""

from pathlib import Path

import numpy as np
from pandas import DataFrame

from jaxbl.drive.parameters import units_of
from jaxbl.files import write_json
from jaxbl.result import KeyFigure, Result, ResultTable
from jaxbl.sweeps.metrics import SIDE_METRICS
from jaxbl.sweeps.trial import Trial

from .error_plane import error_plane
from .figures import (
    BLACK,
    BLUE,
    SIDE_COLOURS,
    SIDES,
    VERMILION,
    Drawn,
    draw_zero,
    legend,
    stacked,
    style,
    subplots,
    with_unit,
)
from .gain_plane import conditions_line, draw_gain_plane

_TRUE, _OBSERVED = BLACK, VERMILION
_POINTS = 6000
"""Points of a line: a page is about 1000 pixels wide."""


def write_trial(trial: Trial, folder: Path) -> str:
    """Write trace and summary of a run. Returns the study's TOML."""
    write_json(folder / "summary.json", trial.summary)
    trial.trace.to_parquet(folder / "trace.parquet", index=False)
    return trial.config.to_toml()


def describe_trial(trial: Trial) -> Result:
    """Say whether the observers converged, and how large their errors are."""
    summary, metrics, limits = trial.summary, trial.summary["metrics"], trial.config.run
    sides = [side for side in SIDES if f"{side}.converged" in metrics]
    failed = [side for side in sides if not metrics[f"{side}.converged"]]
    verdict, headline = "failed", "The run diverges: a number overflows."
    if metrics["finite"] and failed:
        who = (
            f"The {failed[0]} observer does not converge"
            if sides != failed or len(sides) == 1
            else "Neither observer converges"
        )
        headline = f"{who}: an error exceeds its tolerance in the last quarter of the run."
    elif metrics["finite"]:
        times = ", ".join(f"{metrics[f'{side}.convergence_time']:.3g} s ({side})" for side in sides)
        verdict, headline = "good", f"Converged: the errors stay within their tolerances after {times}."
    ratios = {"motor": 1.0, "load": getattr(trial.config.drive, "gear_ratio", 1.0)}
    units = {"velocity": "rad/s", "torque": "N m"}
    errors = {(side, quantity): metrics[f"{side}.{quantity}_rmse"] for side in sides for quantity in units}
    bounds = {(side, "velocity"): f"; the largest may be {limits.velocity_tolerance / ratios[side]:.3g}" for side in sides}
    figures = [
        KeyFigure(
            "diverges" if error is None else f"{error:.3g} {units[key[1]]}",
            f"{key[0]}: {key[1]} error, rms{bounds.get(key, '')}",
        )
        for key, error in errors.items()
    ]
    rows = [
        [name, *(metrics.get(f"{side}.{name}") for side in sides), metric.unit, metric.doc]
        for name, metric in SIDE_METRICS.items()
        if f"motor.{name}" in metrics
    ]
    tables, remarks = [ResultTable("Metrics", ["", *sides, "unit", "meaning"], rows)], []
    if identified := summary["identified"]:
        rows = [[name, values["true"], *(values[side] for side in sides)] for name, values in identified.items()]
        tables.insert(0, ResultTable("Identified", ["", "true", *sides], rows))
        for name, true, *values in rows:
            texts = ("undetermined" if value is None else f"{value:.4g}" for value in values)
            pairs = ", ".join(f"{text} ({side})" for text, side in zip(texts, sides, strict=True))
            remarks.append(f"{name}: {pairs}; true {true:.4g}")
    judged = summary["conditions"].items()
    remarks += [conditions_line(side, gains, "the true bound along this run") for side, gains in judged]
    title = trial.config.title or "Run"
    return Result(title, verdict, headline, figures, remarks, summary["remarks"], tables)


@style()
def draw_trial(trial: Trial) -> list[Drawn]:
    """All figures of a run."""
    trace = trial.trace.iloc[:: max(len(trial.trace) // _POINTS, 1)]
    sides = [side for side in SIDES if f"{side}.position" in trace]
    drawn = [_torque(trace, sides)]
    drawn += [_draw_observer(trace, side, quantity) for side in sides for quantity in ("velocity", "position")]
    drawn.append(_input(trace))
    judged = trial.summary["conditions"]
    drawn += [draw_gain_plane(side, gains) for side, gains in judged.items() if gains["f_plus"] > 0.0]
    drawn += [error_plane(trial.trace, side, gains) for side, gains in judged.items()]
    if len(sides) == 2:
        last = trace[trace["t"] > 0.5 * trace["t"].iloc[-1]]
        drawn += [_draw_identified(trial, trace, last), _hysteresis(last), _limit_cycle(last)]
    return drawn


def _input(trace: DataFrame) -> Drawn:
    figure, (ax,) = subplots(7.0, 2.4)
    ax.plot(trace["t"], trace["u"], color=_TRUE)
    ax.set(xlabel="time (s)", ylabel="input torque u (N m)")
    return Drawn("input", figure, "Input torque (analogue of Fig. 7).")


_FIGURES = {"motor.velocity": "8-9", "motor.position": "10-11", "load.velocity": "12-13", "load.position": "14-15"}
_UNITS = {"velocity": "rad/s", "position": "rad"}


def _draw_observer(trace: DataFrame, side: str, quantity: str) -> Drawn:
    figure, (above, below) = stacked(2, 1.9, width=7.0)
    name, unit = f"{side}.{quantity}", _UNITS[quantity]
    time, true, estimate = (trace[column] for column in ("t", name, f"{name}_estimate"))
    above.plot(time, estimate, color=_OBSERVED, lw=2.4, alpha=0.8, label="observer")
    above.plot(time, true, color=_TRUE, lw=1.0, label="true")
    above.set(ylabel=f"{side} {quantity} ({unit})")
    legend(above, 2)
    below.plot(time, true - estimate, color=BLUE)
    draw_zero(below)
    below.set(ylabel=f"error ({unit})")
    return Drawn(
        f"{side}_{quantity}",
        figure,
        f"{side.capitalize()} {quantity}, true and observed, and the error (analogue of Figs. {_FIGURES[name]}).",
    )


def _torque(trace: DataFrame, sides: list[str]) -> Drawn:
    figure, (above, below) = stacked(2, 1.9, width=7.0)
    time, torque = trace["t"], trace["torque"]
    for side in sides:
        estimate, colour = trace[f"{side}.torque_estimate"], SIDE_COLOURS[side]
        above.plot(time, estimate, color=colour, lw=2.0, alpha=0.75, label=f"from the {side} observer")
        below.plot(time, torque - estimate, color=colour, lw=1.0, alpha=0.75)
    above.plot(time, torque, color=_TRUE, lw=1.0, label="true")
    name = "transmitted torque C" if len(sides) == 2 else "disturbance torque"
    above.set(ylabel=f"{name} (N m)")
    legend(above, 3)
    draw_zero(below)
    below.set(ylabel="error (N m)")
    return Drawn("torque", figure, f"The {name}, true and by the equivalent controls (17) (analogue of Fig. 16).")


def _draw_identified(trial: Trial, trace: DataFrame, last: DataFrame) -> Drawn:
    identified = trial.summary["identified"]
    # what a law derives from its own parameters is an angle, as they are
    units = units_of(trial.config.build().transmission)
    figure, axes = stacked(len(identified), 2.0, width=7.0)
    for ax, (name, values) in zip(axes, identified.items(), strict=True):
        true = values["true"]
        for side in SIDES:
            ax.plot(trace["t"], trace[f"{side}.{name}"], color=SIDE_COLOURS[side], label=f"{side} identifier")
        ax.axhline(true, color=_TRUE, lw=1.0, ls="--", label="true")
        # the estimates of the first half still converge: the second half sets the scale
        largest = float((last[[f"{side}.{name}" for side in SIDES]] - true).abs().max(axis=None))
        reach = max(2.0 * largest if np.isfinite(largest) else 0.0, 0.02 * abs(true), 1e-12)
        ax.set(ylabel=with_unit(name.replace("_", " "), units.get(name, "rad")), ylim=(true - reach, true + reach))
    legend(axes[0], 3)
    return Drawn("dead_zone", figure, "Identified transmission parameters over time (27)-(28) (analogue of Fig. 16).")


def _hysteresis(last: DataFrame) -> Drawn:
    figure, (left, right) = subplots(7.0, 3.4, columns=2)
    for side in SIDES:
        left.plot(last["z"], last[f"{side}.torque_estimate"], color=SIDE_COLOURS[side], lw=1.6, alpha=0.75, label=side)
    left.plot(last["z"], last["torque"], ".", ms=1.5, color=_TRUE, label="true")
    left.set(xlabel="twist z = θe − N₀ θs (rad)", ylabel="transmitted torque C (N m)")
    legend(left, 3, loc="lower left", bbox_to_anchor=(-0.1, 1.0), columnspacing=0.8)
    right.plot(last["theta_e"], last["theta_s"], color=_OBSERVED, lw=1.8, label="measured")
    right.plot(last["motor.position_estimate"], last["load.position_estimate"], color=_TRUE, lw=0.8, label="observed")
    right.set(xlabel="motor position θe (rad)", ylabel="load position θs (rad)")
    legend(right, 2)
    return Drawn(
        "hysteresis",
        figure,
        "Torque over twist (chatter and lag of the estimates widen the loop), and load over motor position. Second half of "
        "the run (analogue of Fig. 17).",
    )


def _limit_cycle(last: DataFrame) -> Drawn:
    figure, (left, right) = subplots(7.0, 3.4, columns=2)
    for ax, side, angle in ((left, "motor", "θe"), (right, "load", "θs")):
        position, velocity = last[f"{side}.position_estimate"], last[f"{side}.velocity_estimate"]
        ax.plot(position, velocity, color=_OBSERVED, lw=2.2, alpha=0.8, label="observed")
        ax.plot(last[f"{side}.position"], last[f"{side}.velocity"], color=_TRUE, lw=0.9, label="true")
        ax.set(xlabel=f"{side} position {angle} (rad)", ylabel=f"{side} velocity (rad/s)")
    legend(left, 2, loc="lower left", bbox_to_anchor=(0.0, 1.0))
    return Drawn("limit_cycle", figure, "Velocity over position, second half of the run: the limit cycle (cf. Fig. 28).")
