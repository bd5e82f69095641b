"""What `jaxbl simulate` leaves to be read. The figures are analogues of figures of the paper."""

import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pandas import DataFrame

from jaxbl.gains.phase_plane import error_peaks, error_slope, majorant
from jaxbl.json_types import JsonObject
from jaxbl.result import KeyFigure, Result, ResultTable
from jaxbl.sweeps.metrics import SIDE_METRICS
from jaxbl.sweeps.trial import Trial

from .gain_plane import describe_conditions, draw_gain_plane
from .panels import SIDE_COLOURS, SIDES, TIME, VERMILION, ZERO, Array, Axis, Figure, Line, Panel


def write(trial: Trial, folder: Path) -> None:
    """Write the trace of a run."""
    trial.trace.to_parquet(folder / "trace.parquet", index=False)


def describe(trial: Trial) -> Result:
    """Say whether the observers converged, and how large their errors are."""
    config, summary, metrics = trial.config, trial.summary, trial.summary["metrics"]
    judged, sides, drive = summary["conditions"], config.sides, config.drive.build()
    failed = [side for side in sides if not metrics[f"{side}.converged"]]
    verdict, headline = "failed", "The run diverges: a number overflows."
    if metrics["finite"] and failed:
        who = "Neither observer converges" if len(failed) > 1 else f"The {failed[0]} observer does not converge"
        headline = f"{who}: an error exceeds its tolerance in the last quarter of the run."
    elif metrics["finite"]:
        times = ", ".join(f"{metrics[f'{side}.convergence_time']:.3g} s ({side})" for side in sides)
        verdict, headline = "good", f"Converged: the errors stay within their tolerances after {times}."
        if unsafe := [side for side, gains in judged.items() if gains["f_plus"] > 0.0 and not gains["holds"]["exact"]]:
            who = f"the {' and '.join(unsafe)} observer{'s' * (len(unsafe) > 1)}"
            verdict = "doubtful"
            headline = f"{headline} By the exact condition, the gains of {who} do not ensure that at another start or input."
    quantities = [*itertools.product(sides, ("velocity", "torque"))]
    if config.controller:
        quantities += [(config.controller.side, "following")]
    figures = []
    for side, quantity in quantities:
        error, largest = metrics[f"{side}.{quantity}_rmse"], config.run.velocity_tolerance / drive.ratio(side)
        bound = f"; at any time at most {largest:.3g} is allowed" if quantity == "velocity" else ""
        text = "diverges" if error is None else f"{error:.3g} {SIDE_METRICS[f'{quantity}_rmse'].unit}"
        figures.append(KeyFigure(text, f"{side}: {quantity} error, rms{bound}"))
    columns, tables = ["true", *sides], []
    if identified := summary["identified"]:
        rows = [[name, *map(values.get, columns)] for name, values in identified.items()]
        tables.append(ResultTable("Identified", ["", *columns], rows))
    rows = [
        [name, *(metrics.get(f"{side}.{name}") for side in sides), metric.unit, metric.doc]
        for name, metric in SIDE_METRICS.items()
        if f"motor.{name}" in metrics
    ]
    tables.append(ResultTable("Metrics", ["", *sides, "unit", "meaning"], rows))
    remarks = [*describe_conditions(judged, "the true bound along this run")]
    return Result(config.title or "Run", verdict, headline, figures, remarks, summary["remarks"], tables)


def draw(trial: Trial) -> Iterator[Figure]:
    """All figures of a run."""
    trace, is_geared = trial.trace, trial.config.is_geared
    name, seen_from = ("transmitted torque C", SIDES) if is_geared else ("disturbance torque", ("motor",))
    estimates = {f"from the {side} observer": (f"{side}.torque_estimate", SIDE_COLOURS[side]) for side in seen_from}
    caption = f"The {name}, true and by the equivalent controls (17) (analogue of Fig. 16)."
    yield _compare("torque", trace, name, "N m", "true", "torque", estimates, caption)
    for side in trial.config.sides:
        name, observed = f"{side}.velocity", {"observer": (f"{side}.velocity_estimate", VERMILION)}
        caption = f"{side.capitalize()} velocity, true and observed, and the error."
        yield _compare(f"{side}_velocity", trace, f"{side} velocity", "rad/s", "true", name, observed, caption)
    if controller := trial.config.controller:
        name, moved = f"{controller.side} position", {"true": (f"{controller.side}.position", VERMILION)}
        caption = f"{controller.side.capitalize()} position, the reference that it is to follow, and the error."
        yield _compare("following", trace, name, "rad", "reference", "reference", moved, caption)
    judged = trial.summary["conditions"].items()
    yield from (draw_gain_plane(side, gains) for side, gains in judged if gains["f_plus"] > 0.0)
    for side, gains in judged:
        yield from error_plane(trace, side, gains)
    if is_geared:
        yield _hysteresis(trace)


def _compare(
    name: str,
    trace: DataFrame,
    quantity: str,
    unit: str,
    label: str,
    column: str,
    estimates: Mapping[str, tuple[str, str]],
    caption: str,
) -> Figure:
    """A signal (its label and column) with what follows it (column and colour by label), over time, and below by how much
    these are off."""
    time, true = trace["t"], trace[column]
    above = [Line(time, trace[estimate], key, colour, 2.0, opacity=0.75) for key, (estimate, colour) in estimates.items()]
    below = [line._replace(y=true - line.y, name="", width=1.0) for line in above]
    panels = [
        Panel(TIME, Axis(f"{quantity} ({unit})"), [*above, Line(time, true, label, width=1.0)]),
        Panel(TIME, Axis(f"error ({unit})"), [ZERO, *below]),
    ]
    return Figure(name, panels, caption, height=1.7)


def _hysteresis(trace: DataFrame) -> Figure:
    last = trace[trace["t"] > 0.5 * trace["t"].iloc[-1]]
    loops = [
        Line(last["z"], last[f"{side}.torque_estimate"], f"by the {side} observer", SIDE_COLOURS[side], 1.6, opacity=0.75)
        for side in SIDES
    ]
    loops.append(Line(last["z"], last["torque"], "true", width=1.2))
    caption = (
        "Torque over twist in the second half of the run; chatter and lag of the estimates widen the loop (analogue of "
        "Fig. 17)."
    )
    return Figure(
        "hysteresis", [Panel(Axis("twist z = θe − N₀ θs (rad)"), Axis("transmitted torque C (N m)"), loops)], caption
    )


_MOST_PEAKS = 40
"""Half cycles of the error that are drawn."""
_MOST_POINTS = 6000
"""Of its line."""


class ErrorPath(NamedTuple):
    """The error of an observer in its phase plane, as far as its peaks stand out from the chatter.

    Attributes:
        error: position error (rad).
        slope: its slope (rad/s), of the same shape.
        peaks: of the velocity error (rad/s), one a half cycle.
        ratio: of a peak to the one before, by the majorant (37); None where there is none.
        majorant: e (rad) and its slope (rad/s) along (36), from the first peak; empty where there is none.
        reach: how far the axes of both go from zero; 0 where no finite error says so.
    """

    error: Array
    slope: Array
    peaks: Array
    ratio: float | None
    majorant: tuple[Array, Array]
    reach: list[float]


def error_path(trace: DataFrame, side: str, judged: JsonObject) -> ErrorPath:
    """The path of an observer's error. Arguments as of :func:`error_plane`."""
    error, rate = (
        (trace[f"{side}.{name}"] - trace[f"{side}.{name}_estimate"]).to_numpy() for name in ("position", "velocity")
    )
    gains = lambda_, *_ = [judged[name] for name in ("lambda", "alpha", "f_plus")]
    slope = error_slope(error, rate, lambda_)
    samples, peaks = error_peaks(error, rate, _MOST_PEAKS)
    end = samples[-1] + 2 if len(samples) > 1 else len(error)
    drawn = np.unique(np.linspace(0, end - 1, min(end, _MOST_POINTS)).astype(int))
    path = error[drawn], slope[drawn]
    least = judged["least_lambda"]["davila_fridman"]
    ratio = None if least is None or lambda_ == 0.0 else least / lambda_
    curve = (np.zeros(0), np.zeros(0)) if ratio is None or not len(peaks) else majorant(peaks[0], *gains)
    return ErrorPath(*path, peaks, ratio, curve, [*map(_reach, path, curve)])


def _reach(error: Array, majorant: Array) -> float:
    """The distance that an axis of the phase plane goes from zero; 0 where no finite error says so."""
    reach = np.nanmax(np.abs(error), initial=0.0)
    if not np.isfinite(reach):
        return 0.0
    # a majorant far outside would leave nothing of the error to be seen
    largest = np.abs(majorant).max(initial=reach)
    return 1.1 * (largest if largest < 4.0 * reach else 1.2 * reach)


def error_plane(trace: DataFrame, side: str, judged: JsonObject) -> Iterator[Figure]:
    """The error of an observer in its phase plane beside the majorant of the proof; no figure where no two
    peaks stand out from the chatter.

    Args:
        trace: of a run, with true values and estimates.
        side: motor or load.
        judged: gains, f_plus, and what follows from them (`conditions` of the run's summary).
    """
    error, slope, peaks, ratio, curve, reaches = error_path(trace, side, judged)
    lambda_, alpha, bound = (judged[name] for name in ("lambda", "alpha", "f_plus"))
    if len(peaks) < 2:
        return
    worst = f", at most {judged['peak_ratio']:.3g}" if judged["peak_ratio"] else ""
    name = f"error: ratio of peaks {np.median(np.abs(peaks[1:] / peaks[:-1])):.3g} (median){worst}"
    parts = [Line(error, slope, name, VERMILION, 1.2)]
    if len(curve[0]):
        parts.append(Line(*curve, f"majorant (36)-(37): ratio {ratio:.3g}", width=1.0))
    x_ends, y_ends = ((-reach, reach) if reach else None for reach in reaches)
    axes = Axis("position error e (rad)", ends=x_ends), Axis("its slope ė (rad/s)", ends=y_ends)
    reason = "" if ratio is not None else f" There is no majorant: {'λ is zero' if alpha > bound else 'α is not above f⁺'}."
    yield Figure(
        f"error_plane_{side}",
        [Panel(*axes, parts)],
        f"Error of the {side} observer (λ = {lambda_:.3g} √rad/s, α = {alpha:.3g} rad/s²) in the phase plane (cf. "
        f"Fig. 29). The majorant of the proof is for the worst disturbance within f⁺ = {bound:.3g} rad/s², without "
        f"friction; a ratio below 1 proves convergence.{reason}",
    )
