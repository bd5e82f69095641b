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
from .gain_plane import conditions_line, draw_gain_plane
from .panels import (
    BLACK,
    BLUE,
    SIDE_COLOURS,
    SIDES,
    TIME,
    VERMILION,
    ZERO,
    Axis,
    Figure,
    Line,
    Panel,
    Span,
    cloud,
    stack,
    with_unit,
)


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
    if trial.config.controller is not None:
        side, units["following"] = trial.config.controller.side, "rad"
        errors[side, "following"] = metrics[f"{side}.following_rmse"]
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


def draw_trial(trial: Trial) -> list[Figure]:
    """All figures of a run."""
    trace = trial.trace
    sides = [side for side in SIDES if f"{side}.position" in trace]
    figures = [_torque(trace, sides)]
    figures += [_draw_observer(trace, side, quantity) for side in sides for quantity in ("velocity", "position")]
    panel = Panel(TIME, Axis("input torque u (N m)"), [Line(trace["t"], trace["u"])])
    figures.append(Figure("input", [panel], "Input torque (analogue of Fig. 7).", height=2.4))
    if trial.config.controller is not None:
        figures.append(_draw_following(trace, trial.config.controller.side))
    judged = trial.summary["conditions"]
    figures += [draw_gain_plane(side, gains) for side, gains in judged.items() if gains["f_plus"] > 0.0]
    figures += [error_plane(trace, side, gains) for side, gains in judged.items()]
    if len(sides) == 2:
        last = DataFrame(trace[trace["t"] > 0.5 * trace["t"].iloc[-1]])
        figures += [_draw_identified(trial, last), _hysteresis(last), _limit_cycle(last)]
    return figures


_FIGURES = {"motor.velocity": "8-9", "motor.position": "10-11", "load.velocity": "12-13", "load.position": "14-15"}
_UNITS = {"velocity": "rad/s", "position": "rad"}


def _draw_observer(trace: DataFrame, side: str, quantity: str) -> Figure:
    name, unit = f"{side}.{quantity}", _UNITS[quantity]
    time, true, estimate = (trace[column] for column in ("t", name, f"{name}_estimate"))
    lines = [Line(time, estimate, "observer", VERMILION, 2.4, opacity=0.8), Line(time, true, "true", width=1.0)]
    panels = [
        Panel(TIME, Axis(f"{side} {quantity} ({unit})"), lines),
        Panel(TIME, Axis(f"error ({unit})"), [ZERO, Line(time, true - estimate, colour=BLUE)]),
    ]
    caption = f"{side.capitalize()} {quantity}, true and observed, and the error (analogue of Figs. {_FIGURES[name]})."
    return stack(f"{side}_{quantity}", panels, caption)


def _draw_following(trace: DataFrame, side: str) -> Figure:
    time, target, true = trace["t"], trace["reference"], trace[f"{side}.position"]
    lines = [Line(time, target, "reference", VERMILION, 2.4, opacity=0.8), Line(time, true, "true", width=1.0)]
    panels = [
        Panel(TIME, Axis(f"{side} position (rad)"), lines),
        Panel(TIME, Axis("following error (rad)"), [ZERO, Line(time, target - true, colour=BLUE)]),
    ]
    return stack("following", panels, f"{side.capitalize()} position, the reference that it is to follow, and the error.")


def _torque(trace: DataFrame, sides: list[str]) -> Figure:
    time, torque = trace["t"], trace["torque"]
    above = [
        Line(time, trace[f"{side}.torque_estimate"], f"from the {side} observer", SIDE_COLOURS[side], 2.0, opacity=0.75)
        for side in sides
    ]
    below = [line._replace(y=torque - line.y, name="", width=1.0) for line in above]
    name = "transmitted torque C" if len(sides) == 2 else "disturbance torque"
    panels = [
        Panel(TIME, Axis(f"{name} (N m)"), [*above, Line(time, torque, "true", width=1.0)]),
        Panel(TIME, Axis("error (N m)"), [ZERO, *below]),
    ]
    return stack("torque", panels, f"The {name}, true and by the equivalent controls (17) (analogue of Fig. 16).")


def _draw_identified(trial: Trial, last: DataFrame) -> Figure:
    trace, panels = trial.trace, []
    # what a law derives from its own parameters is an angle, as they are
    units = units_of(trial.config.build().transmission)
    for name, values in trial.summary["identified"].items():
        true = values["true"]
        lines = [Line(trace["t"], trace[f"{side}.{name}"], f"{side} identifier", SIDE_COLOURS[side]) for side in SIDES]
        # the estimates of the first half still converge: the second half sets the scale
        largest = float((last[[f"{side}.{name}" for side in SIDES]] - true).abs().max(axis=None))
        reach = max(2.0 * largest if np.isfinite(largest) else 0.0, 0.02 * abs(true), 1e-12)
        axis = Axis(with_unit(name.replace("_", " "), units.get(name, "rad")), ends=(true - reach, true + reach))
        panels.append(Panel(TIME, axis, [*lines, Span(true, true, "true", along="y")]))
    return stack("dead_zone", panels, "Identified transmission parameters over time (27)-(28) (analogue of Fig. 16).")


def _hysteresis(last: DataFrame) -> Figure:
    twist = last["z"]
    loops = [
        Line(twist, last[f"{side}.torque_estimate"], f"by the {side} observer", SIDE_COLOURS[side], 1.6, opacity=0.75)
        for side in SIDES
    ]
    loops.append(cloud(twist, last["torque"], "true", BLACK, opacity=1.0))
    positions = [
        Line(last["theta_e"], last["theta_s"], "measured", VERMILION, 1.8),
        Line(last["motor.position_estimate"], last["load.position_estimate"], "observed", width=0.8),
    ]
    panels = [
        Panel(Axis("twist z = θe − N₀ θs (rad)"), Axis("transmitted torque C (N m)"), loops),
        Panel(Axis("motor position θe (rad)"), Axis("load position θs (rad)"), positions),
    ]
    caption = (
        "Torque over twist (chatter and lag of the estimates widen the loop), and load over motor position. Second half of "
        "the run (analogue of Fig. 17)."
    )
    return Figure("hysteresis", panels, caption, columns=2)


def _limit_cycle(last: DataFrame) -> Figure:
    panels = []
    for side, angle in zip(SIDES, ("θe", "θs"), strict=True):
        looks = {"_estimate": ("observed", VERMILION, 2.2, 0.8), "": ("true", BLACK, 0.9, 1.0)}
        lines = [
            Line(last[f"{side}.position{end}"], last[f"{side}.velocity{end}"], name, colour, width, opacity=opacity)
            for end, (name, colour, width, opacity) in looks.items()
        ]
        panels.append(Panel(Axis(f"{side} position {angle} (rad)"), Axis(f"{side} velocity (rad/s)"), lines))
    caption = "Velocity over position, second half of the run: the limit cycle (cf. Fig. 28)."
    return Figure("limit_cycle", panels, caption, columns=2)
