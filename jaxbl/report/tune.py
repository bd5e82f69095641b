"""What `jaxbl tune` leaves to be read: the objective over the gains, error over convergence time, comparisons."""

import json
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from jaxbl.files import write_atomic
from jaxbl.gains.tune import Tuning
from jaxbl.gains.tune_summary import called_gains
from jaxbl.observer.conditions import CONDITIONS
from jaxbl.sweeps.metrics import SIDE_METRICS

from .figures import COLOURS, MAP, MARKERS, MISSING, SIDES, Drawn, literal, mark, style, subplots, with_unit
from .maps import cell_edges, color_norm, condition_curves, hatch_failures
from .page import PageTable, write_report

_CONDITIONS = {name: CONDITIONS[name] for name in ("davila_fridman", "seeber_horn", "exact")}


@style()
def draw_tuning(tuning: Tuning) -> list[Drawn]:
    """All figures of a tuning."""
    sides = [side for side in SIDES if side in tuning.candidates]
    return [*(_map(tuning, side) for side in sides), *(_front(tuning, side) for side in sides), _comparison(tuning, sides)]


def _label(tuning: Tuning) -> str:
    about = SIDE_METRICS[f"{tuning.summary['objective']}_rmse"]
    return with_unit(f"worst {about.label}", about.unit)


def _others(tuning: Tuning, side: str) -> list[tuple[str, str, dict[str, Any]]]:
    """Name, marker and figures on the study's own excitation of the gains that the tuned ones are compared with."""
    rows = [row for row in tuning.summary["named"] if row["side"] == side and row["name"] != "tuned"]
    return [(literal(row["name"]), MARKERS[i % len(MARKERS)], row) for i, row in enumerate(rows)]


def _map(tuning: Tuning, side: str) -> Drawn:
    summary, bound = tuning.summary, tuning.summary["f_plus"][side]
    coarse = tuning.candidates[side].query("stage == 0")
    tables = coarse.astype({"feasible": float}).pivot_table(
        index="lambda_ratio", columns="alpha_ratio", values=["error", "feasible"], dropna=False
    )
    grid, feasible = tables["error"].to_numpy(float), tables["feasible"].to_numpy(float)
    xs, ys = tables["error"].columns.to_numpy(float), tables.index.to_numpy(float)
    norm = color_norm(grid, "log")
    edges = cell_edges(xs, True), cell_edges(ys, True)
    figure, (ax,) = subplots(6.6, 5.4, beside=True)
    ax.grid(False)
    ax.set_facecolor(MISSING)
    ax.set(xscale="log", yscale="log", xlabel="α / f⁺", ylabel="λ / √f⁺ (λ in √rad/s)")
    ax.pcolormesh(*edges, grid, cmap=MAP, norm=norm, rasterized=True)
    handles: list[Any] = [*hatch_failures(ax, (xs, ys), edges, feasible, "constraints not met")]
    handles += condition_curves(ax, _CONDITIONS, 1.0, (edges[0][0], edges[0][-1]))
    for window in summary["stages"][1:2]:
        (left, right), (low, high) = window[side]["alpha_ratio"], window[side]["lambda_ratio"]
        ax.add_patch(Rectangle((left, low), right - left, high - low, fill=False, ec="white", ls="--", lw=1.2))
        handles.append(Patch(fill=False, ec="#777777", ls="--", label="first zoom"))
    gains = summary["gains"][side]
    ax.set(xlim=edges[0][[0, -1]], ylim=edges[1][[0, -1]])
    for name, marker, row in _others(tuning, side):
        handles.append(mark(ax, (row["alpha"] / bound, row["lambda"] / np.sqrt(bound)), marker, name, 8))
    handles.append(mark(ax, (gains["alpha_ratio"], gains["lambda_ratio"]), "*", "tuned", 15))
    ax.set_title(
        f"{side}: tuned ★ λ = {gains['lambda']:.3g} √rad/s, α = {gains['alpha']:.3g} rad/s²,  f⁺ = {bound:.3g} rad/s²"
    )
    figure.colorbar(ScalarMappable(norm, MAP), ax=ax, pad=0.02, aspect=28, label=_label(tuning))
    if np.isnan(grid).any():
        handles.append(Patch(facecolor=MISSING, label=f"diverged ({int(np.isnan(grid).sum())} points)"))
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    caption = (
        f"{side}: {_label(tuning)} over all runs, on the coarse map of normalised gains. Hatched: not converged, or a "
        "margin not met. Curves: least λ of the gain conditions. The other gains are compared below."
    )
    return Drawn(f"tuning_{side}", figure, caption)


def _front(tuning: Tuning, side: str) -> Drawn:
    summary = tuning.summary
    feasible = tuning.candidates[side].query("feasible")
    front = pd.DataFrame(summary["pareto"][side])
    figure, (ax,) = subplots(6.6, 4.4, beside=True)
    ax.plot(
        feasible["convergence_time"], feasible["error"], ".", ms=3.5, color=MISSING, label="gains that meet all constraints"
    )
    ax.step(front["convergence_time"], front["error"], "o-", where="post", ms=3.5, color=COLOURS[0],
            label="none better in both")  # fmt: skip
    handles = ax.get_legend_handles_labels()[0]
    metric, margins = f"{summary['objective']}_rmse", summary["margins"]
    for name, marker, row in _others(tuning, side):
        time, error = row["convergence_time"]["worst"], row[metric]["worst"]
        if time is None or error is None:
            handles.append(Line2D([], [], ls="", marker="", label=f"{name}: {100 * row['converged']:.3g} % converge"))
            continue
        kept = row["margin_alpha"] >= margins["alpha"] and row["margin_exact"] >= margins["exact"]
        label = name if kept else f"{name}, margins not met"
        handles.append(mark(ax, (time, error), marker, label, 8, held=False))
    found = summary["achieved"][side]
    handles.append(mark(ax, (found["convergence_time"], found[metric]), "*", "tuned", 15, held=False))
    for (low, high), scale in ((ax.dataLim.intervalx, ax.set_xscale), (ax.dataLim.intervaly, ax.set_yscale)):
        if low > 0.0 and high > 10.0 * low:
            scale("log")
    ax.set(xlabel="worst convergence time (s)", ylabel=_label(tuning), title=side)
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    caption = f"{side}: error against convergence time, each the worst of all runs on the study's excitation."
    return Drawn(f"pareto_{side}", figure, caption)


def _comparison(tuning: Tuning, sides: list[str]) -> Drawn:
    rows, metric = tuning.summary["holdout"]["rows"], f"{tuning.summary['objective']}_rmse"
    names = list(dict.fromkeys(row["name"] for row in rows))
    figure, axes = subplots(4.6 * len(sides) + 0.6, 1.8 + 0.62 * len(names), 2, len(sides), sharey=True)
    compared = ((metric, _label(tuning)), ("convergence_time", "worst convergence time (s)"))
    for ax, ((key, label), side) in zip(axes, product(compared, sides), strict=True):
        _bars(ax, key, [row for row in rows if row["side"] == side])
        ax.set(xlabel=label, title=side if key == metric else "")
    axes[0].set_yticks(range(len(names)), [literal(name) for name in names])
    axes[0].invert_yaxis()
    first, last = tuning.summary["holdout"]["seeds"]
    seeds = f"seeds {first} to {last}" if last > first else f"seed {first}"
    caption = (
        f"The gains {_where(tuning.summary)}, noise {seeds}: worst of all runs, and the median (stroke). Hatched: some runs "
        "did not converge."
    )
    return Drawn("tuning_holdout", figure, caption)


def _bars(ax: Axes, key: str, rows: list[dict[str, Any]]) -> None:
    """Bars of a figure's worst value for each of the gains, with a stroke at the median."""
    shown = [row[key]["worst"] for row in rows if row[key]["worst"] is not None]
    log = bool(shown) and min(shown) > 0.0 and max(shown) > 30.0 * min(shown)
    ax.set_xscale("log" if log else "linear")
    for i, row in enumerate(rows):
        worst, median = row[key]["worst"], row[key]["median"]
        if worst is None:
            text = f"converged in {100 * row['converged']:.3g} %" if row["finite"] == 1.0 else "diverged"
            ax.annotate(text, (0.01, i), xycoords=("axes fraction", "data"), va="center", color="#555555", fontsize=9)
            continue
        colour, hatch = COLOURS[1] if row["name"] == "tuned" else COLOURS[5], None if row["converged"] == 1.0 else "//"
        ax.barh(i, worst, 0.62, color=colour, hatch=hatch, edgecolor="white", linewidth=0.0)
        if median is not None:
            ax.plot(median, i, "|", ms=12, mew=1.6, color="black")
        ax.annotate(f" {worst:.3g}", (worst, i), va="center", fontsize=9)
    if shown:
        low = 0.5 * min(row[key]["median"] or row[key]["worst"] for row in rows if row[key]["worst"]) if log else 0.0
        ax.set_xlim(low, max(shown) * (3.0 if log else 1.22) or 1.0)
    ax.grid(axis="y", visible=False)


def write_tune_report(tuning: Tuning, folder: Path) -> list[str]:
    """Write `gains.toml`, `tuning.json`, figures and report into a folder that exists. Returns lines for the terminal."""
    summary = tuning.summary
    lead = _tune_headline(summary)
    write_atomic(folder / "gains.toml", gains_toml(summary))
    write_atomic(folder / "tuning.json", json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False))
    tables = [
        _gains_table(summary),
        _comparison_table(f"{_where(summary).capitalize()}, worst and median of all runs", summary["holdout"]["rows"]),
        _comparison_table("On the study's own excitation, worst and median of all runs", summary["named"]),
        *_pareto_tables(summary),
    ]
    title, config = tuning.config.title or "Gains", tuning.config.to_toml()
    return write_report(folder, title, lead, draw_tuning(tuning), tables, config, summary["remarks"])


def gains_toml(summary: dict[str, Any]) -> str:
    """The chosen gains as TOML that a study can `include`; comments say what they were chosen for."""
    margins, title = summary["margins"], " ".join(summary["title"].split())
    lines = [
        f"# Gains chosen by 'jaxbl tune'{f' for: {title}' if title else ''}",
        f"# Objective: {summary['objective_metric']}; {_runs_behind(summary)}.",
        f"# Margins asked for: alpha / f+ {margins['alpha']:g}, lambda over the least of the exact condition "
        f"{margins['exact']:g}.",
        '# To use them, put include = "gains.toml" at the top of a study and leave its own gains out.',
    ]
    for side, gains in summary["gains"].items():
        found = summary["achieved"][side]
        lines += [
            "",
            f"# f+ = {summary['f_plus'][side]:.4g} rad/s^2. Reached, the worst of all runs: velocity error "
            f"{found['velocity_rmse']:.3g} rad/s rms,",
            f"# torque error {found['torque_rmse']:.3g} N m rms, converged after {found['convergence_time']:.3g} s; "
            f"margins {found['margin_alpha']:.3g} (alpha), {found['margin_exact']:.3g} (exact).",
            f"[observer.{side}]",
            f"lambda = {gains['lambda']!r}",
            f"alpha = {gains['alpha']!r}",
        ]
    return "\n".join(lines) + "\n"


def _runs_behind(summary: dict[str, Any]) -> str:
    first, last = summary["seeds"]
    seeds, drives = last - first + 1, len(summary["scenarios"])
    return f"{seeds} noise seed{'s' * (seeds > 1)} and {drives} drive{'s' * (drives > 1)}"


def _where(summary: dict[str, Any]) -> str:
    """Which runs were held out."""
    held = summary["holdout"]
    other = f"on the held-out excitation ({held['excitation']['kind']})"
    return "on the study's excitation with other noise" if held["same_excitation"] else other


def _tune_headline(summary: dict[str, Any]) -> list[str]:
    """The chosen gains and their errors on the held-out runs, in sentences."""
    lines, metric = [], f"{summary['objective']}_rmse"
    unit = SIDE_METRICS[metric].unit
    for side, gains in summary["gains"].items():
        found = summary["achieved"][side]
        lines.append(
            f"{side}: lambda = {gains['lambda']:.4g} √rad/s, alpha = {gains['alpha']:.4g} rad/s² "
            f"({gains['lambda_ratio']:.3g} √f⁺, {gains['alpha_ratio']:.3g} f⁺): {summary['objective']} error "
            f"{found[metric]:.3g} {unit} rms, converged after "
            f"{found['convergence_time']:.3g} s, the worst of {_runs_behind(summary)}."
        )
    where = _where(summary)
    rows = {(row["name"], row["side"]): row for row in summary["holdout"]["rows"]}
    for side, others in summary["holdout"]["factors"].items():
        parts = []
        for name, factors in others.items():
            called, row = called_gains(name), rows[name, side]
            if "why_none" in factors:
                parts.append(f"{called} converge in {100 * row['converged']:.3g} % of the runs")
            else:
                error, time = factors[metric]["worst"], row["convergence_time"]["worst"]
                times = "as much" if error is None or f"{error:.3g}" == "1" else f"{error:.3g} times as much"
                parts.append(f"{times} with {called} (converged after {time:.3g} s)")
        tuned = rows["tuned", side]
        error, time = tuned[metric]["worst"], tuned["convergence_time"]["worst"]
        own = "none: runs diverge" if error is None else f"{error:.3g} {unit} rms"
        after = "not converged in all runs" if time is None else f"converged after {time:.3g} s"
        lines.append(f"{side}, {where}: worst {summary['objective']} error {own} ({after}); {'; '.join(parts)}.")
    return lines


def _gains_table(summary: dict[str, Any]) -> PageTable:
    rows = []
    for side, gains in summary["gains"].items():
        found, step = summary["achieved"][side], summary["resolution"][side]
        rows.append(
            [side, gains["lambda"], gains["alpha"], gains["lambda_ratio"], gains["alpha_ratio"], summary["f_plus"][side],
             found["velocity_rmse"], found["torque_rmse"], found["convergence_time"], found["margin_alpha"],
             found["margin_exact"], found["peak_ratio"], 100 * max(step.values())]
        )  # fmt: skip
    columns = ["side", "λ (√rad/s)", "α (rad/s²)", "λ/√f⁺", "α/f⁺", "f⁺ (rad/s²)", "velocity error (rad/s)",
               "torque error (N m)", "convergence (s)", "margin α", "margin exact", "ρ", "last step (%)"]  # fmt: skip
    return PageTable("Chosen gains, worst of all runs", columns, rows)


def _comparison_table(heading: str, found: list[dict[str, Any]]) -> PageTable:
    rows = [
        [row["side"], row["name"], row["lambda"], row["alpha"], 100.0 * row["converged"],
         *(row[name][how] for name in ("velocity_rmse", "torque_rmse") for how in ("worst", "median")),
         row["convergence_time"]["worst"], row["margin_alpha"], row["margin_exact"], row["peak_ratio"]]
        for row in sorted(found, key=lambda row: SIDES.index(row["side"]))
    ]  # fmt: skip
    columns = ["side", "gains", "λ", "α", "converged (%)", "velocity error (rad/s)", "median", "torque error (N m)",
               "median", "convergence (s)", "margin α", "margin exact", "ρ"]  # fmt: skip
    return PageTable(heading, columns, rows)


def _pareto_tables(summary: dict[str, Any]) -> list[PageTable]:
    unit = SIDE_METRICS[f"{summary['objective']}_rmse"].unit
    columns = ["λ", "α", "λ/√f⁺", "α/f⁺", "convergence time (s)", f"{summary['objective']} error ({unit})"]
    return [
        PageTable(
            f"No gains beat these in both convergence time and error: {side}", columns, [list(row.values()) for row in rows]
        )
        for side, rows in summary["pareto"].items()
    ]
