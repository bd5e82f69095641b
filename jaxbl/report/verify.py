"""What `jaxbl verify` leaves to be read: maps of the error system and of the drive, counterexamples, tables."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false
# pyright: reportReturnType=false

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.lines import Line2D

from jaxbl.files import to_jsonable
from jaxbl.gains.error_system import list_conditions
from jaxbl.gains.verify import Verdict, sides_with_gain_axes
from jaxbl.json_types import JsonObject
from jaxbl.lines import Lines
from jaxbl.observer.conditions import CONDITIONS

from .error_plane import draw_worst_planes
from .figures import COLOURS, MAP, MISSING, Drawn, literal, mark, style, subplots
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
    damping = [_damping(verdict)] if verdict.error_map.boundary_by_damping else []
    levels = [_levels(verdict, side) for side in sides_with_gain_axes(verdict.config)]
    planes = draw_worst_planes(verdict.summary["marks"])
    return [
        _atlas(verdict),
        draw_rules(verdict.summary["rules"]),
        *([] if planes is None else [planes]),
        *damping,
        *levels,
        _conservatism(verdict),
        _claimed(verdict),
    ]


def _marks(ax: Axes, verdict: Verdict, colour: str = "white") -> list[Line2D]:
    """Mark the usual pair and the study's marks. Returns the legend's handles."""
    marks = [one for one in verdict.summary["marks"] if one["alpha_ratio"] is not None]
    places = [_USUAL, *((literal(one["name"]), one["alpha_ratio"], one["lambda_ratio"]) for one in marks)]
    return [
        mark(ax, place, marker, name, 12, colour)
        for (name, *place), marker in zip(places, itertools.cycle(_MARKERS), strict=False)
    ]


def _axes_of_plane(ax: Axes, xs: np.ndarray, ys: np.ndarray) -> None:
    ax.set(xscale="log", yscale="log", xlim=(xs[0], xs[-1]), ylim=(ys[0], ys[-1]), xlabel=_ALPHA)
    ticks = [t for t in (1.1, 1.5, 2, 3, 5, 10, 20, 50, 100) if xs[0] <= t <= xs[-1]]
    ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
    ax.set_xticks([], minor=True)


def _atlas(verdict: Verdict) -> Drawn:
    found = verdict.error_map
    figure, (ax,) = subplots(7.6, 6.6, beside=True)
    ax.grid(False)
    norm = LogNorm(0.05, 20.0)
    shown = np.clip(found.ratio, 1e-6, 1e6)
    ax.pcolormesh(found.alpha, found.lambda_, shown, cmap="PuOr_r", norm=norm, rasterized=True, shading="nearest")
    _axes_of_plane(ax, found.alpha, found.lambda_)
    handles: list[Any] = condition_curves(ax, list_conditions(verdict.config), 1.0, (found.alpha[0], found.alpha[-1]))
    step = max(len(found.alpha) // 24, 1)
    look = {"marker": "o", "ms": 5, "mfc": "white", "mec": "black", "ls": ""}
    ax.plot(found.alpha[::step], found.boundary[::step], **look, zorder=5)
    handles += [Line2D([], [], label="simulated boundary", **look), *_marks(ax, verdict)]
    ax.set(ylabel=_LAMBDA, title="Error system under its worst disturbance: below the boundary it grows")
    bar = figure.colorbar(ScalarMappable(norm, "PuOr_r"), ax=ax, pad=0.02, aspect=30, extend="both")
    bar.set_label("ratio ρ of successive velocity peaks, simulated")
    bar.ax.axhline(1.0, color="black", lw=1.0)
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    caption = (
        f"Simulated ratio of successive velocity peaks over {found.ratio.size} cells; every condition demands a λ above its "
        "curve. White is ρ = 1, where the exact condition and the simulated boundary (found by bisection) lie."
    )
    return Drawn("atlas", figure, caption)


def _damping(verdict: Verdict) -> Drawn:
    found = verdict.error_map
    figure, (ax,) = subplots(7.0, 4.8, beside=True)
    for i, (damping, boundary) in enumerate(sorted({0.0: found.boundary, **found.boundary_by_damping}.items())):
        label = "no friction (exact condition)" if damping == 0.0 else f"friction number {damping:g}"
        least = np.where(boundary > 0.0, boundary, np.nan)
        ax.plot(found.alpha, least, color=COLOURS[i % len(COLOURS)], lw=2.0, label=label)
    _axes_of_plane(ax, found.alpha, found.lambda_)
    handles = [*ax.get_legend_handles_labels()[0], *_marks(ax, verdict, COLOURS[4])]
    ax.set_ylabel("least λ / √f⁺ that shrinks the error")
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    caption = (
        "Least λ at which the worst disturbance no longer enlarges a velocity error v, simulated with viscous friction. "
        "The friction number is (friction / inertia) v / f⁺: friction shrinks large errors, not small ones."
    )
    return Drawn("friction", figure, caption)


def _normalised(frame: pd.DataFrame, side: str) -> tuple[pd.Series, pd.Series]:
    """Gains of runs in units of each run's own true f_plus."""
    bound = frame[f"{side}.f_plus"]
    return frame[f"observer.{side}.alpha"] / bound, frame[f"observer.{side}.lambda"] / np.sqrt(bound)


def _levels(verdict: Verdict, side: str) -> Drawn:
    """Share of converged runs over the gains in units of each run's own true f_plus."""
    figure, axes = subplots(9.4, 5.2, columns=len(verdict.levels), beside=True, sharex=True, sharey=True)
    planes = {}
    for level, frame in verdict.levels.items():
        alpha, lambda_ = _normalised(frame, side)
        good = np.isfinite(alpha) & np.isfinite(lambda_) & (lambda_ > 0.0)
        planes[level] = (alpha[good], lambda_[good], frame[f"{side}.converged"].astype(float)[good])
    alphas, lambdas, _ = (np.concatenate(parts) for parts in zip(*planes.values(), strict=True))
    if not alphas.size:
        axes[0].text(0.5, 0.5, "no run has a finite bound f⁺ and lambda > 0", ha="center", transform=axes[0].transAxes)
        return Drawn(f"levels_{side}", figure, f"Runs of the drive, {side} observer: none to be drawn.")
    ends = [np.quantile(values, [0.005, 0.995]) for values in (alphas, lambdas)]
    bins = [np.geomspace(low / 1.01, high * 1.01, 45) for low, high in ends]
    handles: list[Any] = []
    for ax, (level, (alpha, lambda_, converged)) in zip(axes, planes.items(), strict=True):
        runs, _, _ = np.histogram2d(alpha, lambda_, bins)
        share, _, _ = np.histogram2d(alpha, lambda_, bins, weights=converged)
        ax.grid(False)
        ax.set_facecolor(MISSING)
        with np.errstate(invalid="ignore"):
            ax.pcolormesh(*bins, (share / runs).T, cmap=MAP, vmin=0.0, vmax=1.0, rasterized=True)
        ax.set(xscale="log", yscale="log", xlim=bins[0][[0, -1]], ylim=bins[1][[0, -1]], xlabel=_ALPHA)
        handles = condition_curves(ax, list_conditions(verdict.config), 1.0, (max(bins[0][0], 1.0001), bins[0][-1]))
        wrong = verdict.counterexamples
        if len(wrong):
            about = {"level": level, "side": side, "bound": "true", "condition": "exact"}
            wrong = wrong[np.logical_and.reduce([wrong[name] == value for name, value in about.items()])]
            ax.plot(*_normalised(wrong, side), "x", ms=2.5, mew=0.7, color=COLOURS[1])
        ax.set_title(f"{_LEVELS[level]}\n{len(wrong)} failed though ρ < 1")
    axes[0].set_ylabel(_LAMBDA)
    handles.append(Line2D([], [], ls="", marker="x", color=COLOURS[1], label="failed though ρ < 1"))
    label = f"share of runs in which the {side} observer converged"
    figure.colorbar(ScalarMappable(Normalize(0.0, 1.0), MAP), ax=axes, pad=0.02, aspect=30, label=label)
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    caption = (
        f"Runs of the drive, {side} observer, each in units of its own true f⁺, on the axes of the atlas. A real input is "
        "not the worst disturbance: runs converge below the curves as well. Grey: no run."
    )
    return Drawn(f"levels_{side}", figure, caption)


def _name(level: JsonObject) -> str:
    return ", ".join(level[key] for key in ("level", "side") if level.get(key))


def _conservatism(verdict: Verdict) -> Drawn:
    levels = verdict.summary["levels"]
    figure, (ax,) = subplots(7.0, 0.9 + 0.62 * len(CONDITIONS), beside=True)
    for i, level in enumerate(levels):
        colour, shift = COLOURS[i % len(COLOURS)], 0.16 * (i - 0.5 * (len(levels) - 1))
        for k, entry in enumerate(level["conditions"]):
            median, largest = entry["conservatism"]["median"], entry["conservatism"]["max"]
            if median is None:
                continue
            ax.plot([median, largest], [k + shift] * 2, color=colour, lw=2.0)
            ax.plot(median, k + shift, "o", color=colour, ms=7, label=_name(level) if k == 0 else None)
            censored = entry["conservatism"]["at_least"] > 0
            ax.plot(largest, k + shift, ">" if censored else "|", color=colour, ms=6 if censored else 9)
    ax.axvline(1.0, color="black", lw=0.8)
    ax.set(xscale="log", xlabel="λ demanded over the least λ that works")
    ax.set_yticks(range(len(CONDITIONS)), [condition.title for condition in list_conditions(verdict.config).values()])
    ax.invert_yaxis()
    ax.grid(axis="y", visible=False)
    figure.legend(loc="outside lower center", ncols=3)
    caption = (
        "λ that each condition demands over the least λ that works: dot median, line to the largest. Arrow head: the least "
        "λ on the study's axis worked as well, so that the true ratio is larger."
    )
    return Drawn("conservatism", figure, caption)


def _claimed(verdict: Verdict) -> Drawn:
    figure, (ax,) = subplots(7.0, 3.4)
    ratios = {}
    for side in sides_with_gain_axes(verdict.config):
        for level, frame in verdict.levels.items():
            part = frame[frame[f"{side}.converged"].astype(bool)]
            ratio = part[f"{side}.f_plus"] / part[f"{side}.f_plus_acceleration"]
            ratios[f"{level}, {side}"] = ratio[np.isfinite(ratio) & (ratio > 0.0)].to_numpy()
    every = np.concatenate([*ratios.values(), [1.0]])
    bins = np.geomspace(0.9 * every.min(), 1.1 * every.max(), 40)
    for i, (label, ratio) in enumerate(ratios.items()):
        if len(ratio):
            counts = np.full(len(ratio), 1.0 / len(ratio))
            share = f"{label}: too small in {100.0 * np.mean(ratio > 1.0):.0f} %"
            ax.hist(ratio, bins, weights=counts, histtype="step", lw=2.0, color=COLOURS[i % len(COLOURS)], label=share)
    ax.axvline(1.0, color="black", lw=1.0)
    ax.set(xscale="log", xlabel="true f⁺ along the run / twice the largest acceleration", ylabel="share of converged runs")
    if ax.patches:
        ax.legend(loc="upper left", bbox_to_anchor=(0.0, 1.2), ncols=2)
    else:
        ax.text(0.5, 0.5, "no run converged", ha="center", transform=ax.transAxes)
    caption = (
        "The true bound over that of the paper's text, twice the largest acceleration. Right of the line the paper's bound "
        "is too small, and gains chosen by it may meet none of the conditions."
    )
    return Drawn("claimed_bound", figure, caption)


def write_verify_report(verdict: Verdict, folder: Path) -> Lines:
    """Draw the figures of a verification and write `report.html` into its folder. Returns the lines for the terminal."""
    lead = [*_headline(verdict), *rule_lines(verdict.summary["rules"])]
    remarks = [*verdict.config.notes, *_mark_lines(verdict)]
    tables = [_level_table(level) for level in verdict.summary["levels"]]
    tables += [t for level in verdict.summary["levels"] for t in _claimed_tables(level)]
    tables.append(rule_table(verdict.summary["rules"]))
    if verdict.summary["marks"]:
        tables.append(_mark_table(verdict))
    if len(verdict.counterexamples):
        tables.append(_counterexample_table(verdict))
    title, config = verdict.config.title or "Gain conditions", verdict.config.to_toml()
    return write_report(folder, title, lead, draw_verdict(verdict), tables, config, remarks)


def _headline(verdict: Verdict) -> Lines:
    lines = []
    for level in verdict.summary["levels"]:
        wrong = [entry for entry in level["conditions"] if entry["counterexamples"]]
        kind = "cells" if level.get("side") is None else "runs"
        line = f"{_name(level)}: {level['cells']} {kind}, of which {level['converged']} converge, "
        if not wrong:
            line += "with no counterexample to any condition."
        else:
            counts = ", ".join(f"{e['title']} {e['counterexamples']} of {e['holds']}" for e in wrong)
            line += f"and the observer failed although a condition held: {counts}."
            causes = level["causes"].get("true", {})
            found = ", ".join(f"{cause} ({count})" for cause, count in list(causes.items())[:4])
            line += f" Causes, by experiment: {found}."
        lines.append(line)
    first = verdict.summary["levels"][0]
    ratios = "; ".join(
        f"{e['title']} {e['conservatism']['median']:.3g} ({e['conservatism']['max']:.3g})"
        for e in first["conditions"]
        if e["name"] != "exact"
    )
    lines.append(f"λ demanded over the least λ that works against the worst disturbance, median (largest): {ratios}.")
    closed = verdict.summary["closed_form"]
    lines.append(f"Closed form of ρ and simulation differ by {closed['largest_difference']:.2g} at most.")
    for level in verdict.summary["levels"][1:]:
        claimed = level["claimed_bound"]
        if claimed["too_small"] is not None and level["level"] == "drive":
            # where nothing accelerates there is no factor
            most = claimed["true_over_claimed"]["max"]
            share = f"is too small in {100.0 * claimed['too_small']:.0f} % of the converged runs"
            if claimed["too_small"] == 0.0:
                share = "is large enough in all converged runs"
            size = "" if most is None else f"; the true bound is up to {most:.3g} times as large"
            lines.append(f"{level['side']}: the bound f⁺ as twice the largest acceleration {share}{size}.")
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


def _mark_lines(verdict: Verdict) -> Lines:
    lines = []
    for one in verdict.summary["marks"]:
        rho = one["peak_ratio"]
        if one["alpha_ratio"] is None:
            lines.append(f"{one['name']}: the run diverged.")
            continue
        line = f"{one['name']}: α / f⁺ = {one['alpha_ratio']:.3g}, λ / √f⁺ = {one['lambda_ratio']:.3g}; "
        if rho is None:
            line += f"α is below the true f⁺: no condition can hold.{_by_disturbance(one)}"
        elif rho < 1.0:
            line += f"ρ = {rho:.3g}: any disturbance within f⁺ dies out in finite time."
        else:
            ended = "; the run did not converge."
            if one["converged"]:
                ended = f": the run here converged, after {one['convergence_time']:.3g} s."
            line += (
                f"ρ = {rho:.3g}: the worst disturbance enlarges the velocity error to "
                f"{one['upheld_velocity_error']:.3g} rad/s, where friction balances it. Under a constant disturbance each "
                f"peak is {one['peak_ratio_constant']:.3g} times the last (friction number {one['damping']:.2g}){ended}"
                f"{_by_disturbance(one)}"
            )
        lines.append(line)
    return lines


def _by_disturbance(one: JsonObject) -> str:
    """What the run's own disturbance d does to gains that miss the exact condition, in sentences."""
    found = one["on_this_disturbance"]
    if found is None:
        return ""
    share = found["share_above_alpha"]
    said = f" On this disturbance |d| exceeds α during {100.0 * share:.3g} % of the time"
    if share > 0.0:
        said += (
            f"; its largest excursion from zero is {found['excursion_predicted']:.3g} rad/s predicted, "
            f"{found['excursion_simulated']:.3g} rad/s simulated."
        )
    elif "tenth_predicted" in found:
        largest, times = ([found[f"{what}_{how}"] for how in ("predicted", "simulated")] for what in ("largest", "tenth"))
        # at the end of a run peaks may still be larger
        after = ["not in this run" if time is None else f"after {time:.3g} s" for time in times]
        said += f". By the law of slow disturbances (simulated in continuous time) peaks are {largest[0]:.3g} rad/s at most "
        said += f"({largest[1]:.3g}) and fall to a tenth {after[0]} ({after[1]})."
    else:
        said += "."
    cycle = found["sine_cycle"]
    if cycle["least_simulated"]:
        said += f" A sine of this size upholds a limit cycle from {cycle['least_simulated']:.3g} Hz on"
        if (known := cycle["predicted"]) and (exact := cycle["simulated"]):
            said += f": at {cycle['frequency']:.3g} Hz one of {known['stable']:.3g} rad/s predicted, {exact['stable']:.3g} "
            said += f"rad/s simulated, beside an unstable one of {exact['threshold']:.3g} rad/s"
        said += "."
    return said


def _level_table(level: JsonObject) -> PageTable:
    name = "Normalised error system, worst disturbance"
    if level["level"] != "normalised":
        name = f"{_LEVELS[level['level']].capitalize()}; {level['side']} observer"
    rows = []
    for entry in level["conditions"]:
        counts, ratio = (entry[key] for key in ("holds", "counterexamples", "fails_but_converged")), entry["conservatism"]
        rows.append([entry["title"], *counts, ratio["median"], ratio["max"], ratio["at_least"] > 0])
    kind = "cells" if level["level"] == "normalised" else "runs"
    head = ["condition", "holds", "holds, but failed", "fails, but converged", "λ demanded / least: median", "largest"]
    return PageTable(f"{name}: {level['cells']} {kind}, {level['converged']} converged", [*head, "at least"], rows)


def _claimed_tables(level: JsonObject) -> list[PageTable]:
    if not (inputs := level.get("claimed_bound", {}).get("by_input")):
        return []
    keys = list(inputs[0]["input"])
    rows = [[*row["input"].values(), row["converged_runs"], row["true"], row["claimed"], row["too_small"]] for row in inputs]
    heading = f"True and claimed bound by input: {level['level']}, {level['side']}"
    return [PageTable(heading, [*keys, "runs", "median true f⁺", "2 max |acceleration|", "share too small"], rows)]


def _mark_table(verdict: Verdict) -> PageTable:
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
    rows = [[one["name"], *(one[key] for key in keys)] for one in verdict.summary["marks"]]
    return PageTable("Marked gains, run on the study's drive with ideal encoders", ["", *keys.values()], rows)


def _counterexample_table(verdict: Verdict) -> PageTable:
    found = verdict.counterexamples[verdict.counterexamples["bound"] == "true"]
    paths = [axis.path for axis in verdict.config.axes if axis.path in found]
    keys = ["level", "side", "condition", "cause"]
    rows = []
    for key, part in sorted(found.groupby(keys, sort=False), key=lambda pair: -len(pair[1])):
        rows.append([*key, len(part), *(to_jsonable(part[path].iloc[0]) for path in paths)])
    head = [*keys, "runs", *(f"e.g. {path}" for path in paths)]
    return PageTable("Counterexamples by cause (all of them, with all figures: counterexamples.parquet)", head, rows)
