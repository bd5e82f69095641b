"""What `jaxbl verify` leaves to be read: maps of the error system and of the drive, counterexamples, tables."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false
# pyright: reportReturnType=false

import itertools
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm, Normalize
from pandas import DataFrame, Series

from jaxbl.files import to_jsonable
from jaxbl.gains.error_system import ErrorSystemMap, list_conditions
from jaxbl.gains.verify import Verdict, sides_with_gain_axes
from jaxbl.json_types import JsonObject
from jaxbl.lines import Lines
from jaxbl.observer.conditions import CONDITIONS

from .error_plane import draw_worst_planes
from .figures import (
    COLOURS,
    MAP,
    MISSING,
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
from .page import PageTable, write_report
from .tuning_rules import draw_rules, rule_lines, rule_table

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
    drawn = [_atlas(verdict), draw_rules(summary["rules"]), *([planes] if planes else []), *damping, *levels]
    return [*drawn, _conservatism(verdict), _claimed_bound(verdict)]


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
    """Share of converged runs over the gains in units of each run's own true f_plus."""
    figure, axes = subplots(9.4, 5.2, columns=len(verdict.levels), beside=True, sharex=True, sharey=True)
    planes = {}
    for level, frame in verdict.levels.items():
        alpha, lambda_ = _normalise(frame, side)
        good = np.isfinite(alpha) & np.isfinite(lambda_) & (lambda_ > 0.0)
        planes[level] = (alpha[good], lambda_[good], frame[f"{side}.converged"].astype(float)[good])
    alphas, lambdas, _ = map(np.concatenate, zip(*planes.values(), strict=True))
    if not alphas.size:
        write_inside(axes[0], "no run has a finite bound f⁺ and lambda > 0")
        return Drawn(f"levels_{side}", figure, f"Runs of the drive, {side} observer: none to be drawn.")
    ends = [np.quantile(values, [0.005, 0.995]) for values in (alphas, lambdas)]
    bins = [np.geomspace(low / 1.01, high * 1.01, 45) for low, high in ends]
    handles: list[Any] = []
    wrong = verdict.counterexamples
    if len(wrong):
        wrong = wrong[(wrong["side"] == side) & (wrong["bound"] == "true") & (wrong["condition"] == "exact")]
    for ax, (level, (alpha, lambda_, converged)) in zip(axes, planes.items(), strict=True):
        runs, _, _ = np.histogram2d(alpha, lambda_, bins)
        share, _, _ = np.histogram2d(alpha, lambda_, bins, weights=converged)
        ax.grid(False)
        ax.set_facecolor(MISSING)
        with np.errstate(invalid="ignore"):
            ax.pcolormesh(*bins, (share / runs).T, cmap=MAP, vmin=0.0, vmax=1.0, rasterized=True)
        ax.set(xscale="log", yscale="log", xlim=bins[0][[0, -1]], ylim=bins[1][[0, -1]], xlabel=_ALPHA)
        handles = condition_curves(ax, list_conditions(verdict.config), 1.0, (max(bins[0][0], 1.0001), bins[0][-1]))
        failed = wrong
        if len(verdict.counterexamples):
            failed = wrong[wrong["level"] == level]
            ax.plot(*_normalise(failed, side), "x", ms=2.5, mew=0.7, color=VERMILION)
        ax.set_title(f"{_LEVELS[level]}\n{len(failed)} failed though ρ < 1")
    axes[0].set_ylabel(_LAMBDA)
    handles.append(Line2D([], [], ls="", marker="x", color=VERMILION, label="failed though ρ < 1"))
    label = f"share of runs in which the {side} observer converged"
    colour_bar(figure, axes, Normalize(0.0, 1.0), label, aspect=30)
    legend_below(figure, handles)
    return Drawn(
        f"levels_{side}",
        figure,
        f"Runs of the drive, {side} observer, each in units of its own true f⁺, on the axes of the atlas. A real input is "
        "not the worst disturbance: runs converge below the curves as well. Grey: no run.",
    )


def _name(level: JsonObject) -> str:
    return ", ".join(level[key] for key in ("level", "side") if level.get(key))


def _conservatism(verdict: Verdict) -> Drawn:
    levels = verdict.summary["levels"]
    figure, (ax,) = subplots(7.0, 0.9 + 0.62 * len(CONDITIONS), beside=True)
    for i, level in enumerate(levels):
        colour, shift = COLOURS[i % len(COLOURS)], 0.16 * (i - 0.5 * (len(levels) - 1))
        for k, entry in enumerate(level["conditions"]):
            median, largest, censored = (entry["conservatism"][key] for key in ("median", "max", "at_least"))
            if median is None:
                continue
            y = k + shift
            ax.plot([median, largest], [y, y], color=colour, lw=2.0)
            ax.plot(median, y, "o", color=colour, ms=7, label=_name(level) if k == 0 else None)
            ax.plot(largest, y, ">" if censored else "|", color=colour, ms=6 if censored else 9)
    ax.axvline(1.0, color="black", lw=0.8)
    ax.set(xscale="log", xlabel="λ demanded over the least λ that works")
    ax.set_yticks(range(len(CONDITIONS)), [condition.title for condition in list_conditions(verdict.config).values()])
    ax.invert_yaxis()
    ax.grid(axis="y", visible=False)
    legend_below(figure)
    return Drawn(
        "conservatism",
        figure,
        "λ that each condition demands over the least λ that works: dot median, line to the largest. Arrow head: the least "
        "λ on the study's axis worked as well, so that the true ratio is larger.",
    )


def _claimed_bound(verdict: Verdict) -> Drawn:
    figure, (ax,) = subplots(7.0, 3.4)
    ratios = {}
    for side in sides_with_gain_axes(verdict.config):
        for level, frame in verdict.levels.items():
            part = frame[frame[f"{side}.converged"].astype(bool)]
            ratio = part[f"{side}.f_plus"] / part[f"{side}.f_plus_acceleration"]
            ratios[f"{level}, {side}"] = ratio[np.isfinite(ratio) & (ratio > 0.0)].to_numpy()
    together = np.concatenate([*ratios.values(), [1.0]])
    bins = np.geomspace(0.9 * together.min(), 1.1 * together.max(), 40)
    for i, (label, ratio) in enumerate(ratios.items()):
        if len(ratio):
            shares = np.full(len(ratio), 1.0 / len(ratio))
            label += f": too small in {100.0 * np.mean(ratio > 1.0):.0f} %"
            ax.hist(ratio, bins, weights=shares, histtype="step", lw=2.0, color=COLOURS[i % len(COLOURS)], label=label)
    ax.axvline(1.0, color="black", lw=1.0)
    ax.set(xscale="log", xlabel="true f⁺ along the run / twice the largest acceleration", ylabel="share of converged runs")
    if ax.patches:
        ax.legend(loc="upper left", bbox_to_anchor=(0.0, 1.2), ncols=2)
    else:
        write_inside(ax, "no run converged")
    return Drawn(
        "claimed_bound",
        figure,
        "The true bound over that of the paper's text, twice the largest acceleration. Right of the line the paper's bound "
        "is too small, and gains chosen by it may meet none of the conditions.",
    )


def write_verify_report(verdict: Verdict, folder: Path) -> Lines:
    """Draw the figures of a verification and write `report.html` into its folder. Returns the lines for the terminal."""
    marks, rules, levels = (verdict.summary[key] for key in ("marks", "rules", "levels"))
    lead = [*_headline(verdict), *rule_lines(rules)]
    remarks = [*verdict.config.notes, *map(_mark_line, marks)]
    tables = [_level_table(level) for level in levels]
    tables += [table for level in levels for table in _claimed_tables(level)]
    tables.append(rule_table(rules))
    if marks:
        tables.append(_mark_table(marks))
    if len(verdict.counterexamples):
        tables.append(_counterexample_table(verdict))
    return write_report(folder, "Gain conditions", lead, draw_verdict(verdict), tables, verdict.config, remarks)


def _headline(verdict: Verdict) -> Lines:
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
    ratios = "; ".join(
        f"{entry['title']} {entry['conservatism']['median']:.3g} ({entry['conservatism']['max']:.3g})"
        for entry in levels[0]["conditions"]
        if entry["name"] != "exact"
    )
    lines.append(f"λ demanded over the least λ that works against the worst disturbance, median (largest): {ratios}.")
    difference = verdict.summary["closed_form"]["largest_difference"]
    lines.append(f"Closed form of ρ and simulation differ by {difference:.2g} at most.")
    for level in levels[1:]:
        share = level["claimed_bound"]["too_small"]
        if share is not None and level["level"] == "drive":
            # where nothing accelerates there is no factor
            factor = level["claimed_bound"]["true_over_claimed"]["max"]
            line = f"is too small in {100.0 * share:.0f} % of the converged runs"
            if share == 0.0:
                line = "is large enough in all converged runs"
            if factor is not None:
                line += f"; the true bound is up to {factor:.3g} times as large"
            lines.append(f"{level['side']}: the bound f⁺ as twice the largest acceleration {line}.")
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
    rho = gains["peak_ratio"]
    if gains["alpha_ratio"] is None:
        return f"{gains['name']}: the run diverged."
    line = f"{gains['name']}: α / f⁺ = {gains['alpha_ratio']:.3g}, λ / √f⁺ = {gains['lambda_ratio']:.3g}; "
    if rho is None:
        return f"{line}α is below the true f⁺: no condition can hold.{_by_disturbance(gains)}"
    if rho < 1.0:
        return f"{line}ρ = {rho:.3g}: any disturbance within f⁺ dies out in finite time."
    end = "; the run did not converge."
    if gains["converged"]:
        end = f": the run here converged, after {gains['convergence_time']:.3g} s."
    return (
        f"{line}ρ = {rho:.3g}: the worst disturbance enlarges the velocity error to "
        f"{gains['upheld_velocity_error']:.3g} rad/s, where friction balances it. Under a constant disturbance each "
        f"peak is {gains['peak_ratio_constant']:.3g} times the last (friction number {gains['damping']:.2g}){end}"
        f"{_by_disturbance(gains)}"
    )


def _by_disturbance(gains: JsonObject) -> str:
    """Say what the run's own disturbance d does to gains that miss the exact condition, in sentences."""
    run = gains["on_this_disturbance"]
    if run is None:
        return ""
    share = run["share_above_alpha"]
    text = f" On this disturbance |d| exceeds α during {100.0 * share:.3g} % of the time"
    if share > 0.0:
        text += (
            f"; its largest excursion from zero is {run['excursion_predicted']:.3g} rad/s predicted, "
            f"{run['excursion_simulated']:.3g} rad/s simulated."
        )
    elif "tenth_predicted" in run:
        # at the end of a run peaks may still be larger
        predicted, simulated = (
            "not in this run" if (time := run[f"tenth_{how}"]) is None else f"after {time:.3g} s"
            for how in ("predicted", "simulated")
        )
        text += (
            f". By the law of slow disturbances (simulated in continuous time) peaks are {run['largest_predicted']:.3g} "
            f"rad/s at most ({run['largest_simulated']:.3g}) and fall to a tenth {predicted} ({simulated})."
        )
    else:
        text += "."
    cycle = run["sine_cycle"]
    if cycle["least_simulated"]:
        text += f" A sine of this size upholds a limit cycle from {cycle['least_simulated']:.3g} Hz on"
        if (law := cycle["predicted"]) and (exact := cycle["simulated"]):
            text += f": at {cycle['frequency']:.3g} Hz one of {law['stable']:.3g} rad/s predicted, {exact['stable']:.3g} "
            text += f"rad/s simulated, beside an unstable one of {exact['threshold']:.3g} rad/s"
        text += "."
    return text


def _level_table(level: JsonObject) -> PageTable:
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
    return PageTable(f"{name}: {level['cells']} {kind}, {level['converged']} converged", head, rows)


def _claimed_tables(level: JsonObject) -> list[PageTable]:
    if not (inputs := level.get("claimed_bound", {}).get("by_input")):
        return []
    keys = "converged_runs", "true", "claimed", "too_small"
    rows = [[*row["input"].values(), *(row[key] for key in keys)] for row in inputs]
    heading = f"True and claimed bound by input: {level['level']}, {level['side']}"
    head = [*inputs[0]["input"], "runs", "median true f⁺", "2 max |acceleration|", "share too small"]
    return [PageTable(heading, head, rows)]


def _mark_table(marks: list[JsonObject]) -> PageTable:
    keys = {
        "lambda": "λ",
        "alpha": "α",
        "f_plus": "true f⁺",
        "alpha_ratio": "α / f⁺",
        "lambda_ratio": "λ / √f⁺",
        "peak_ratio": "ρ",
        "damping": "friction number",
        "peak_ratio_damped": "ρ with friction",
        "peak_ratio_constant": "ratio, constant disturbance",
        "upheld_velocity_error": "sustained error (rad/s)",
        "margin_davila_fridman": "margin to (32)",
        "margin_exact": "margin to ρ < 1",
        "converged": "converged",
        "convergence_time": "after (s)",
    }
    rows = [[gains["name"], *(gains[key] for key in keys)] for gains in marks]
    return PageTable("Marked gains, run on the study's drive with ideal encoders", ["", *keys.values()], rows)


def _counterexample_table(verdict: Verdict) -> PageTable:
    wrong = verdict.counterexamples[verdict.counterexamples["bound"] == "true"]
    paths = [path for path in verdict.config.axis_paths if path in wrong]
    keys = ["level", "side", "condition", "cause"]
    parts = sorted(wrong.groupby(keys, sort=False), key=lambda pair: -len(pair[1]))
    rows = [[*key, len(part), *(to_jsonable(part[path].iloc[0]) for path in paths)] for key, part in parts]
    head = [*keys, "runs", *(f"e.g. {path}" for path in paths)]
    return PageTable("Counterexamples by cause (all of them, with all figures: counterexamples.parquet)", head, rows)
