"""What `jaxbl verify` leaves to be read: maps of the error system and of the drive, counterexamples, tables."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false
# pyright: reportReturnType=false

import itertools
from pathlib import Path

import numpy as np
from pandas import DataFrame, Series

from jaxbl.gains.error_system import list_conditions
from jaxbl.gains.verify import Verdict, sides_with_gain_axes
from jaxbl.json_types import JsonObject
from jaxbl.lines import Lines
from jaxbl.observer.conditions import judge_gains
from jaxbl.result import KeyFigure, Result, ResultTable

from .error_plane import draw_worst_planes
from .gain_plane import EXACT, condition_curves, conditions_line, usual_rule_curve
from .loop_gains import margin_table
from .maps import cell_edges
from .panels import BLUE, MARKERS, VERMILION, Axis, Figure, Line, Map, Panel, Part, Scale, cloud, literal, mark

_USUAL = ("usual pair (1.5, 1.1)", 1.1, 1.5)
_LEVELS = {"drive": "drive: ideal encoders, implicit observer", "sampled": "sampled: as the study has it"}
_ALPHA, _LAMBDA = "α / f⁺", "λ / √f⁺"


def draw_verdict(verdict: Verdict) -> list[Figure]:
    """All figures of a verification."""
    levels = itertools.chain(*(_levels(verdict, side) for side in sides_with_gain_axes(verdict.config)))
    return [_atlas(verdict), *draw_worst_planes(verdict.summary["marks"]), *levels]


def _mark_gains(verdict: Verdict) -> list[Line]:
    """Marks of the usual pair and of the study's marks."""
    places = [_USUAL]
    for gains in verdict.summary["marks"]:
        if gains["alpha_ratio"] is not None:
            places.append((literal(gains["name"]), gains["alpha_ratio"], gains["lambda_ratio"]))
    pairs = zip(places, itertools.cycle(("*", *MARKERS)), strict=False)
    return [mark(x, y, name, marker, 12.0) for (name, x, y), marker in pairs]


def _atlas(verdict: Verdict) -> Figure:
    plane = verdict.error_map
    scale = Scale(0.05, 20.0, "ratio ρ of successive velocity peaks, simulated", True, "PuOr_r")
    edges = [cell_edges(values, True) for values in (plane.alpha, plane.lambda_)]
    curves = condition_curves(list_conditions(verdict.config), 1.0, (plane.alpha[0], plane.alpha[-1]))
    step = max(len(plane.alpha) // 24, 1)
    boundary = Line(plane.alpha[::step], plane.boundary[::step], "simulated boundary", width=0.0, marker="o", fill="#FFFFFF")
    parts = [Map(*edges, plane.ratio, scale), *curves, boundary, *_mark_gains(verdict)]
    title = "Error system under its worst disturbance: below the boundary it grows"
    caption = (
        f"Simulated ratio of successive velocity peaks over {plane.ratio.size} cells; every condition demands a λ above its "
        "curve. White is ρ = 1, where the exact condition and the simulated boundary (found by bisection) lie."
    )
    pairs = ((_ALPHA, plane.alpha), (_LAMBDA, plane.lambda_))
    axes = (Axis(label, log=True, ends=(float(values[0]), float(values[-1]))) for label, values in pairs)
    return Figure("atlas", [Panel(*axes, parts, title)], caption, height=5.2)


def _normalise(frame: DataFrame, side: str) -> tuple[Series, Series]:
    """Gains of runs in units of each run's own true f_plus."""
    bound = frame[f"{side}.f_plus"]
    return frame[f"observer.{side}.alpha"] / bound, frame[f"observer.{side}.lambda"] / np.sqrt(bound)


def _levels(verdict: Verdict, side: str) -> list[Figure]:
    """The runs that converged and that failed, over the gains in units of each run's own true f_plus; nothing where no run
    has a finite one, and a λ above 0."""
    wrong, places = verdict.counterexamples, {}
    if len(wrong):
        wrong = wrong[(wrong["side"] == side) & (wrong["bound"] == "true") & (wrong["condition"] == "exact")]
    for level, frame in verdict.levels.items():
        gains = np.stack(_normalise(frame, side), axis=1)
        there = np.isfinite(gains).all(axis=1) & (gains > 0.0).all(axis=1)
        places[level] = gains[there], frame[f"{side}.converged"].to_numpy(bool)[there]
    ends = np.concatenate([gains for gains, _ in places.values()])
    if not len(ends):
        return []
    (left, low), (right, high) = ends.min(axis=0) / 1.2, 1.2 * ends.max(axis=0)
    alphas, panels = (max(left, 1.0001), max(right, 1.001)), []
    for level, (gains, converged) in places.items():
        parts: list[Part] = [
            cloud(*gains[rows].T, name, colour, marker=marker, size=size, opacity=0.7)
            for rows, marker, colour, name, size in (
                (converged, "o", BLUE, "converged", 3.0), (~converged, "x", VERMILION, "failed", 4.0)
            )
        ]  # fmt: skip
        parts += [*condition_curves(EXACT, 1.0, alphas), usual_rule_curve(1.0, alphas)]
        failures = sum(wrong["level"] == level) if len(wrong) else 0
        axes = (Axis(_ALPHA, log=True, ends=(left, right)), Axis(_LAMBDA, log=True, ends=(low, high)))
        panels.append(Panel(*axes, parts, f"{_LEVELS[level]}\n{failures} failed though ρ < 1"))
    caption = (
        f"Runs of the drive, {side} observer, each in units of its own true f⁺, on the axes of the atlas. A real input is "
        "not the worst disturbance: runs converge below the curves as well."
    )
    return [Figure(f"levels_{side}", panels, caption, len(panels), 4.4 * len(panels), 4.2)]


def _name(level: JsonObject) -> str:
    return ", ".join(level[key] for key in ("level", "side") if level.get(key))


def write_verdict(verdict: Verdict, folder: Path) -> str:
    """Return the study's TOML; the command has left the other files."""
    return verdict.config.to_toml()


def describe_verdict(verdict: Verdict) -> Result:
    """Say whether the study's own gains and the marked ones are safe, and which conditions are wrong."""
    marks, levels, own_gains = verdict.summary["marks"], verdict.summary["levels"], _judge_own_gains(verdict)
    unsafe = [gains["name"] for gains in marks if (gains["peak_ratio"] or np.inf) >= 1.0]
    exact = [(level, entry) for level in levels for entry in level["conditions"] if entry["name"] == "exact"]
    failures = sum(entry["counterexamples"] for _, entry in exact)
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
        headline = f"The {whose} gains are safe: any disturbance within f⁺ dies out in finite time."
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
    figures = figures or [
        KeyFigure(f"{entry['counterexamples']} of {entry['holds']}", f"{_name(level)}: failed though the condition held")
        for level, entry in exact[:4]
    ]
    tables = [_level_table(level) for level in levels]
    if marks:
        tables.insert(0, _mark_table(marks))
    if margins := verdict.summary["loop_margins"]:
        tables.append(margin_table(margins))
    remarks = [conditions_line(side, judged, "the largest of all runs") for side, judged in own_gains.items()]
    remarks += [*map(_mark_line, marks), *_level_lines(verdict)]
    title = verdict.config.title or "Gain conditions"
    return Result(title, word, headline, figures, remarks, verdict.config.notes, tables)


def _judge_own_gains(verdict: Verdict) -> JsonObject:
    """Judge the gains of the study itself, which the axes replace, at the largest f⁺ of all runs of the drive, by side."""
    judged = {}
    for side in sides_with_gain_axes(verdict.config):
        gains, bounds = getattr(verdict.config.observer, side), verdict.levels["drive"][f"{side}.f_plus"]
        if gains.lambda_ is not None and gains.alpha is not None:
            judged[side] = judge_gains(gains.lambda_, gains.alpha, float(bounds[np.isfinite(bounds)].max()))
    return judged


def _level_lines(verdict: Verdict) -> Lines:
    """Say which conditions have counterexamples on each level, and why runs converge where none can hold."""
    lines, levels = [], verdict.summary["levels"]
    for level in levels:
        wrong = [entry for entry in level["conditions"] if entry["counterexamples"]]
        kind = "cells" if level.get("side") is None else "runs"
        line = f"{_name(level)}: {level['cells']} {kind}, of which {level['converged']} converge, "
        if not wrong:
            line += "with no counterexample to any condition."
        else:
            counts = ", ".join(f"{entry['title']} {entry['counterexamples']} of {entry['holds']}" for entry in wrong)
            causes = list(level["causes"].get("true", {}).items())[:4]
            line += f"and the observer failed although a condition held: {counts}. Causes, by experiment: "
            line += ", ".join(f"{cause} ({count})" for cause, count in causes) + "."
        lines.append(line)
    return lines


def _mark_line(gains: JsonObject) -> str:
    """Say whether marked gains are safe, and what they did here."""
    rho = gains["peak_ratio"]
    if gains["alpha_ratio"] is None:
        return f"{gains['name']}: the run diverged."
    here = f"it converged here after {gains['convergence_time']:.3g} s" if gains["converged"] else "it did not converge here"
    if rho is None:
        return f"{gains['name']}: not safe, as α is below the true f⁺ (α / f⁺ = {gains['alpha_ratio']:.3g}); {here}."
    judged = "safe: any disturbance within f⁺ dies out" if rho < 1.0 else "not safe: the worst disturbance upholds the error"
    return f"{gains['name']}: {judged} (ratio of successive peaks ρ = {rho:.3g}); {here}."


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
    keys = {
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
    rows = [[gains["name"], *(gains[key] for key in keys)] for gains in marks]
    return ResultTable("Marked gains, run on the study's drive with ideal encoders", ["", *keys.values()], rows)
