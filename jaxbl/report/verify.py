"""What `jaxbl verify` leaves to be read: maps of the error system and of the drive, counterexamples, tables."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false
# pyright: reportReturnType=false

import itertools
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from pandas import DataFrame, Series

from jaxbl.files import to_jsonable
from jaxbl.gains.error_system import ErrorSystemMap, list_conditions
from jaxbl.gains.verify import Verdict, sides_with_gain_axes
from jaxbl.json_types import JsonObject
from jaxbl.lines import Lines
from jaxbl.observer.conditions import CONDITIONS
from jaxbl.result import KeyFigure, Result, ResultTable

from .error_plane import draw_worst_planes
from .figures import (
    BLUE,
    COLOURS,
    ORANGE,
    VERMILION,
    Axes,
    Drawn,
    Line2D,
    colour_bar,
    legend_below,
    literal,
    mark,
    style,
    subplots,
    write_inside,
)
from .maps import condition_curves
from .tuning_rules import draw_rules, rule_lines, rule_table

_TWO = {name: CONDITIONS[name] for name in ("davila_fridman", "exact")}
_USUAL = ("usual pair (1.5, 1.1)", 1.1, 1.5)
_MARKERS = ("*", "P", "D", "^", "v", "X", "s")
_LEVELS = {"drive": "drive: ideal encoders, implicit observer", "sampled": "sampled: as the study has it"}
_ALPHA, _LAMBDA = "α / f⁺", "λ / √f⁺"


@style()
def draw_verdict(verdict: Verdict) -> list[Drawn]:
    """All figures of a verification."""
    summary, plane = verdict.summary, verdict.error_map
    damping = [_damping(verdict)] if plane.boundary_by_damping else []
    levels = [_levels(verdict, side) for side in sides_with_gain_axes(verdict.config)]
    planes = draw_worst_planes(summary["marks"])
    return [_atlas(verdict), draw_rules(summary["rules"]), *([planes] if planes else []), *damping, *levels]


def _mark_gains(ax: Axes, verdict: Verdict, colour: str = "white") -> list[Line2D]:
    """Mark the usual pair and the study's marks. Returns the legend's handles."""
    places = [_USUAL]
    for gains in verdict.summary["marks"]:
        if gains["alpha_ratio"] is not None:
            places.append((literal(gains["name"]), gains["alpha_ratio"], gains["lambda_ratio"]))
    pairs = zip(places, itertools.cycle(_MARKERS), strict=False)
    return [mark(ax, place, marker, name, 12, colour) for (name, *place), marker in pairs]


def _set_up_plane(ax: Axes, plane: ErrorSystemMap) -> None:
    xs, ys = plane.alpha, plane.lambda_
    ax.set(xscale="log", yscale="log", xlim=xs[[0, -1]], ylim=ys[[0, -1]], xlabel=_ALPHA)
    ticks = [tick for tick in (1.1, 1.5, 2, 3, 5, 10, 20, 50, 100) if xs[0] <= tick <= xs[-1]]
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    ax.set_xticks([], minor=True)


def _atlas(verdict: Verdict) -> Drawn:
    plane = verdict.error_map
    figure, (ax,) = subplots(7.6, 6.6, beside=True)
    ax.grid(False)
    norm, colours = LogNorm(0.05, 20.0), "PuOr_r"
    ratio = np.clip(plane.ratio, 1e-6, 1e6)
    ax.pcolormesh(plane.alpha, plane.lambda_, ratio, cmap=colours, norm=norm, rasterized=True, shading="nearest")
    _set_up_plane(ax, plane)
    handles: list[Any] = condition_curves(ax, list_conditions(verdict.config), 1.0, tuple(plane.alpha[[0, -1]]))
    step = max(len(plane.alpha) // 24, 1)
    look = {"marker": "o", "ms": 5, "mfc": "white", "mec": "black", "ls": ""}
    ax.plot(plane.alpha[::step], plane.boundary[::step], **look, zorder=5)
    handles += [Line2D([], [], label="simulated boundary", **look), *_mark_gains(ax, verdict)]
    ax.set(ylabel=_LAMBDA, title="Error system under its worst disturbance: below the boundary it grows")
    label = "ratio ρ of successive velocity peaks, simulated"
    colour_bar(figure, ax, norm, label, colours, aspect=30, extend="both").ax.axhline(1.0, color="black", lw=1.0)
    legend_below(figure, handles)
    return Drawn(
        "atlas",
        figure,
        f"Simulated ratio of successive velocity peaks over {ratio.size} cells; every condition demands a λ above its "
        "curve. White is ρ = 1, where the exact condition and the simulated boundary (found by bisection) lie.",
    )


def _damping(verdict: Verdict) -> Drawn:
    plane = verdict.error_map
    figure, (ax,) = subplots(7.0, 4.8, beside=True)
    for i, (damping, boundary) in enumerate(sorted({0.0: plane.boundary, **plane.boundary_by_damping}.items())):
        label = "no friction (exact condition)" if damping == 0.0 else f"friction number {damping:g}"
        least = np.where(boundary > 0.0, boundary, np.nan)
        ax.plot(plane.alpha, least, color=COLOURS[i % len(COLOURS)], lw=2.0, label=label)
    _set_up_plane(ax, plane)
    handles = [*ax.get_legend_handles_labels()[0], *_mark_gains(ax, verdict, ORANGE)]
    ax.set_ylabel("least λ / √f⁺ that shrinks the error")
    legend_below(figure, handles, 2)
    return Drawn(
        "friction",
        figure,
        "Least λ at which the worst disturbance no longer enlarges a velocity error v, simulated with viscous friction. "
        "The friction number is (friction / inertia) v / f⁺: friction shrinks large errors, not small ones.",
    )


def _normalise(frame: DataFrame, side: str) -> tuple[Series, Series]:
    """Gains of runs in units of each run's own true f_plus."""
    bound = frame[f"{side}.f_plus"]
    return frame[f"observer.{side}.alpha"] / bound, frame[f"observer.{side}.lambda"] / np.sqrt(bound)


def _levels(verdict: Verdict, side: str) -> Drawn:
    """The runs that converged and that failed, over the gains in units of each run's own true f_plus."""
    figure, axes = subplots(9.4, 5.2, columns=len(verdict.levels), beside=True, sharex=True, sharey=True)
    wrong, ends = verdict.counterexamples, np.ones((0, 2))
    if len(wrong):
        wrong = wrong[(wrong["side"] == side) & (wrong["bound"] == "true") & (wrong["condition"] == "exact")]
    for ax, (level, frame) in zip(axes, verdict.levels.items(), strict=True):
        places = np.stack(_normalise(frame, side), axis=1)
        places[~(np.isfinite(places).all(axis=1) & (places > 0.0).all(axis=1))] = np.nan
        converged = frame[f"{side}.converged"].to_numpy(bool)
        for rows, marker, colour, name in ((converged, ".", BLUE, "converged"), (~converged, "x", VERMILION, "failed")):
            ax.plot(*places[rows].T, marker, ms=4, mew=0.9, color=colour, alpha=0.6, label=name, rasterized=True)
        ends = np.concatenate([ends, places[np.isfinite(places).all(axis=1)]])
        failures = sum(wrong["level"] == level) if len(wrong) else 0
        ax.set(xscale="log", yscale="log", xlabel=_ALPHA, title=f"{_LEVELS[level]}\n{failures} failed though ρ < 1")
    if not len(ends):
        write_inside(axes[0], "no run has a finite bound f⁺ and lambda > 0")
        return Drawn(f"levels_{side}", figure, f"Runs of the drive, {side} observer: none to be drawn.")
    (left, low), (right, high) = ends.min(axis=0) / 1.2, 1.2 * ends.max(axis=0)
    handles = [*axes[0].get_legend_handles_labels()[0]]
    for ax in axes:
        ax.set(xlim=(left, right), ylim=(low, high))
        curves = condition_curves(ax, _TWO, 1.0, (max(left, 1.0001), max(right, 1.001)))
    axes[0].set_ylabel(_LAMBDA)
    legend_below(figure, [*handles, *curves])
    return Drawn(
        f"levels_{side}",
        figure,
        f"Runs of the drive, {side} observer, each in units of its own true f⁺, on the axes of the atlas. A real input is "
        "not the worst disturbance: runs converge below the curves as well.",
    )


def _name(level: JsonObject) -> str:
    return ", ".join(level[key] for key in ("level", "side") if level.get(key))


def write_verdict(verdict: Verdict, folder: Path) -> str:
    """Return the study's TOML; the command has left the other files."""
    return verdict.config.to_toml()


def describe_verdict(verdict: Verdict) -> Result:
    """Say whether the marked gains are safe, and which conditions are wrong."""
    marks, rules, levels = (verdict.summary[key] for key in ("marks", "rules", "levels"))
    unsafe = [gains["name"] for gains in marks if (gains["peak_ratio"] or np.inf) >= 1.0]
    failures = sum(entry["counterexamples"] for level in levels for entry in level["conditions"] if entry["name"] == "exact")
    extent = (
        f"{levels[0]['cells']} cells of the error system and {sum(level['cells'] for level in levels[1:])} runs of the drive"
    )
    word, headline = "good", f"No counterexample to the exact gain condition in {extent}."
    if unsafe:
        word, headline = (
            "failed",
            f"Not safe: {'; '.join(unsafe)}. A disturbance within f⁺ can keep the error from dying out.",
        )
    elif marks:
        headline = "The marked gains are safe: any disturbance within f⁺ dies out in finite time."
    elif failures:
        word, headline = "doubtful", f"The observer failed in {failures} of {extent} although the exact gain condition held."
    figures = [
        KeyFigure(f"× {gains['margin_exact']:.3g}", f"{gains['name']}: λ over the least that is safe (exact condition)")
        for gains in marks[:4]
        if gains["margin_exact"]
    ]
    tables = [_level_table(level) for level in levels]
    tables += [table for level in levels for table in _claimed_tables(level)]
    tables.append(rule_table(rules))
    if marks:
        tables[:0] = [_mark_table(marks), *_disturbance_tables(marks)]
    if len(verdict.counterexamples):
        tables.append(_counterexample_table(verdict))
    remarks = [*map(_mark_line, marks), *_level_lines(verdict), *rule_lines(rules)]
    title = verdict.config.title or "Gain conditions"
    return Result(title, word, headline, figures, remarks, verdict.config.notes, tables)


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
    for level in levels[1:]:
        if below := level.get("below_f_plus"):
            lines.append(_below_line(verdict, level["side"], below))
    return lines


def _below_line(verdict: Verdict, side: str, below: JsonObject) -> str:
    runs = "" if below["runs"] == below["converged_runs"] else f" {below['runs']} of them were looked at:"
    return (
        f"{side}: {below['converged_runs']} runs converge though α is below the true f⁺, where no condition can hold.{runs} "
        f"In {below['disturbance_exceeds']} the disturbance itself exceeds α, {100.0 * below['share_above_alpha']:.3g} % of "
        f"the time at most. The largest excursion from zero is {below['excursion_predicted']:.3g} rad/s predicted, "
        f"{below['excursion_simulated']:.3g} rad/s simulated; the velocity tolerance is "
        f"{verdict.config.run.velocity_tolerance:.3g} rad/s."
    )


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


_OWN = {
    "largest_disturbance": "largest disturbance (rad/s²)",
    "share_above_alpha": "share of the time above α",
    "excursion_predicted": "largest excursion, predicted (rad/s)",
    "excursion_simulated": "simulated",
    "largest_predicted": "largest peak, predicted (rad/s)",
    "largest_simulated": "simulated",
    "tenth_predicted": "peaks at a tenth after, predicted (s)",
    "tenth_simulated": "simulated",
    "least_simulated": "a sine upholds a limit cycle from (Hz)",
}
"""Numbers of what a run's own disturbance does to gains that miss the exact condition."""


def _disturbance_tables(marks: list[JsonObject]) -> list[ResultTable]:
    """Tables of what the run's own disturbance does to marked gains that miss the exact condition."""
    judged = {gains["name"]: run | run["sine_cycle"] for gains in marks if (run := gains["on_this_disturbance"])}
    rows = [[label, *(run.get(key) for run in judged.values())] for key, label in _OWN.items()]
    return [ResultTable("Gains that are not safe, on the run's own disturbance", ["", *judged], rows)] * bool(judged)


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


def _claimed_tables(level: JsonObject) -> list[ResultTable]:
    if not (inputs := level.get("claimed_bound", {}).get("by_input")):
        return []
    keys = "converged_runs", "true", "claimed", "too_small"
    rows = [[*row["input"].values(), *(row[key] for key in keys)] for row in inputs]
    heading = f"True and claimed bound by input: {level['level']}, {level['side']}"
    head = [*inputs[0]["input"], "runs", "median true f⁺", "2 max |acceleration|", "share too small"]
    return [ResultTable(heading, head, rows)]


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


def _counterexample_table(verdict: Verdict) -> ResultTable:
    wrong = verdict.counterexamples[verdict.counterexamples["bound"] == "true"]
    paths = [path for path in verdict.config.axis_paths if path in wrong]
    keys = ["level", "side", "condition", "cause"]
    parts = sorted(wrong.groupby(keys, sort=False), key=lambda pair: -len(pair[1]))
    rows = [[*key, len(part), *(to_jsonable(part[path].iloc[0]) for path in paths)] for key, part in parts]
    head = [*keys, "runs", *(f"e.g. {path}" for path in paths)]
    return ResultTable("Counterexamples by cause (all of them, with all figures: counterexamples.parquet)", head, rows)
