"""What `jaxbl verify` leaves to be read: the map of the error system, counterexamples, tables."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false
# pyright: reportReturnType=false

import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxbl.gains.error_system import list_conditions
from jaxbl.gains.verify import Verdict, sides_with_gain_axes
from jaxbl.json_types import JsonObject
from jaxbl.observer.conditions import judge_gains
from jaxbl.result import KeyFigure, Result, ResultTable

from .gain_plane import condition_curves, describe_conditions
from .loop_gains import margin_table
from .maps import cell_edges
from .panels import MARKERS, Axis, Figure, Line, Map, Panel, Scale, literal, mark

_LEVELS = {"drive": "drive: ideal encoders, implicit observer", "sampled": "sampled: as the study has it"}


def draw(verdict: Verdict) -> Iterator[Figure]:
    """The atlas with the study's own gains, the usual pair and the study's marks; the runs of the drive are for
    `jaxbl explore`."""
    plane = verdict.error_map
    scale = Scale(0.05, 20.0, "ratio ρ of successive velocity peaks, simulated", True, "PuOr_r")
    alphas = plane.alpha
    ranges = {"α / f⁺": alphas, "λ / √f⁺": plane.lambda_}
    edges = [cell_edges(values, True) for values in ranges.values()]
    curves = condition_curves(list_conditions(verdict.config.verify.q), 1.0, (alphas[0], alphas[-1]))
    step = max(len(alphas) // 24, 1)
    boundary = Line(alphas[::step], plane.boundary[::step], "simulated boundary", width=0.0, marker="o", fill="#FFFFFF")
    places = [
        *((gains["alpha"] / bound, gains["lambda"] / bound**0.5, f"the study's gains, {side}")
          for side, gains in _judge_own_gains(verdict).items() if (bound := gains["f_plus"]) > 0.0),
        (1.1, 1.5, "usual pair (1.5, 1.1)"),
        *((gains["alpha_ratio"], gains["lambda_ratio"], gains["name"])
          for gains in verdict.summary["marks"] if gains["alpha_ratio"] is not None),
    ]  # fmt: skip
    marks = [
        mark(alpha, lambda_, literal(name), marker, 12.0)
        for (alpha, lambda_, name), marker in zip(places, itertools.cycle(("*", *MARKERS)), strict=False)
    ]
    parts = [Map(*edges, plane.ratio, scale), *curves, boundary, *marks]
    title = "Error system under its worst disturbance: below the boundary it grows"
    caption = (
        f"Simulated ratio of successive velocity peaks over {plane.ratio.size} cells; every condition demands a λ above its "
        "curve. White is ρ = 1, where the exact condition and the simulated boundary (found by bisection) lie."
    )
    axes = (Axis(label, log=True, ends=(values[0], values[-1])) for label, values in ranges.items())
    yield Figure("atlas", [Panel(*axes, parts, title)], caption, height=5.2)


def write(verdict: Verdict, folder: Path) -> None:
    """Write nothing: the command has left the other files."""


def describe(verdict: Verdict) -> Result:
    """Say whether the study's own gains and the marked ones are safe, and which conditions are wrong."""
    marks, levels, own_gains = verdict.summary["marks"], verdict.summary["levels"], _judge_own_gains(verdict)
    unsafe = [gains["name"] for gains in marks if (gains["peak_ratio"] or np.inf) >= 1.0]
    failures = sum(entry["counterexamples"] for level in levels for entry in level["conditions"] if entry["name"] == "exact")
    extent = (
        f"{levels[0]['cells']} cells of the error system and {sum(level['cells'] for level in levels[1:])} runs of the drive"
    )
    missed = [f"the study's gains, {side}" for side, judged in own_gains.items() if not judged["holds"]["exact"]]
    word, headline = "good", f"No counterexample to the exact gain condition in {extent}."
    # marks are there to be compared; the answer is about the user's own gains, if there are any
    if missed or (unsafe and not own_gains):
        word, names = "failed", "; ".join(missed or unsafe)
        headline = f"Not safe: {names}. A disturbance within f⁺ can keep the error from dying out."
    elif own_gains or marks:
        whose = "study's own" if own_gains else "marked"
        headline = f"The {whose} gains are safe: whatever disturbs within f⁺, the error dies out in finite time."
        headline += f" Of those marked not safe: {'; '.join(unsafe)}." if unsafe else ""
    elif failures:
        word, headline = "doubtful", f"The observer failed in {failures} of {extent} although the exact gain condition held."
    margins = [
        (judged["lambda"] / least, f"the study's gains, {side}")
        for side, judged in own_gains.items()
        if (least := judged["least_lambda"]["exact"])
    ]
    margins += [(gains["margin_exact"], gains["name"]) for gains in marks]
    figures = [
        KeyFigure(f"× {margin:.3g}", f"{name}: λ over the least that is safe (exact condition)")
        for margin, name in margins[:4]
        if margin
    ]
    tables = [*[_mark_table(marks)] * bool(marks), *map(_level_table, levels)]
    if margins := verdict.summary["loop_margins"]:
        tables.append(margin_table(margins))
    remarks = [*describe_conditions(own_gains), *_level_lines(verdict)]
    return Result(verdict.config.title or "Gain conditions", word, headline, figures, remarks, verdict.config.notes, tables)


def _judge_own_gains(verdict: Verdict) -> JsonObject:
    """Judge the gains of the study itself, which the axes replace, at the largest f⁺ of all runs of the drive, by side."""
    judged = {}
    for side in sides_with_gain_axes(verdict.config):
        gains, bounds = getattr(verdict.config.observer, side), verdict.levels["drive"][f"{side}.f_plus"]
        if gains.lambda_ is not None and gains.alpha is not None:
            judged[side] = judge_gains(gains.lambda_, gains.alpha, bounds[np.isfinite(bounds)].max())
    return judged


def _level_lines(verdict: Verdict) -> Iterator[str]:
    """Say where the observer failed although a condition held, and why."""
    for level in verdict.summary["levels"]:
        counts = ", ".join(
            f"{entry['title']} {entry['counterexamples']} of {entry['holds']}"
            for entry in level["conditions"]
            if entry["counterexamples"]
        )
        if counts:
            causes = list(level["causes"].get("true", {}).items())[:4]
            text = ", ".join(f"{cause} ({count})" for cause, count in causes)
            name = ", ".join(level[key] for key in ("level", "side") if level.get(key))
            yield f"{name}: the observer failed although a condition held: {counts}. Causes, by experiment: {text}."


def _level_table(level: JsonObject) -> ResultTable:
    name, kind = "Normalised error system, worst disturbance", "cells"
    if level["level"] != "normalised":
        name, kind = f"{_LEVELS[level['level']].capitalize()}; {level['side']} observer", "runs"
    keys = "title", "holds", "counterexamples", "fails_but_converged"
    rows = [
        [*(entry[key] for key in keys), ratio["median"], ratio["max"], ratio["at_least"] > 0]
        for entry in level["conditions"]
        if (ratio := entry["conservatism"])
    ]
    head = ["condition", "holds", "holds, but failed", "fails, but converged", "λ demanded / least: median", "largest",
            "at least"]  # fmt: skip
    return ResultTable(f"{name}: {level['cells']} {kind}, {level['converged']} converged", head, rows)


def _mark_table(marks: list[JsonObject]) -> ResultTable:
    columns = {
        "name": "",
        "lambda": "λ",
        "alpha": "α",
        "f_plus": "true f⁺",
        "alpha_ratio": "α / f⁺",
        "lambda_ratio": "λ / √f⁺",
        "peak_ratio": "ρ",
        "upheld_velocity_error": "sustained error (rad/s)",
        "margin_davila_fridman": "margin to (32)",
        "margin_exact": "margin to ρ < 1",
        "converged": "converged",
        "convergence_time": "after (s)",
    }
    rows = [[gains[key] for key in columns] for gains in marks]
    return ResultTable("Marked gains, run on the study's drive with ideal encoders", [*columns.values()], rows)
