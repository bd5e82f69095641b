"""What `jaxbl tune` leaves to be read: the objective over the gains, error over convergence time, comparisons."""

from itertools import product
from pathlib import Path
from typing import Any

import matplotlib.patheffects as path_effects
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from jaxbl.files import write_atomic, write_json
from jaxbl.gains.best_gains import NEARLY_AS_GOOD, describe_margins
from jaxbl.gains.limits import CONSTRAINT_COLUMNS
from jaxbl.gains.tune import Tuning
from jaxbl.gains.tune_summary import describe_gains
from jaxbl.json_types import JsonObject
from jaxbl.lines import doubts_among
from jaxbl.observer.conditions import CONDITIONS
from jaxbl.sweeps.metrics import SIDE_METRICS

from .certificate import certificate_lines, certificate_tables, draw_certificates, is_refuted, write_certificates
from .figures import COLOURS, MAP, MARKERS, MISSING, SIDES, Drawn, literal, mark, style, subplots, with_unit
from .gain_plane import conditions_line, name_gains, name_ratio
from .maps import cell_edges, color_norm, condition_curves, fit_axes, flat_remark, hatch_failures
from .page import PageTable, write_report

_CONDITIONS = {name: CONDITIONS[name] for name in ("davila_fridman", "seeber_horn", "exact")}


@style()
def draw_tuning(tuning: Tuning) -> list[Drawn]:
    """All figures of a tuning."""
    sides = [side for side in SIDES if side in tuning.candidates]
    maps = [draw(tuning, side) for side in sides for draw in (_map, _limits)]
    fronts = [_front(tuning, side) for side in sides]
    return [*maps, *fronts, _comparison(tuning, sides), *draw_certificates(tuning.summary)]


def _label(tuning: Tuning) -> str:
    about = SIDE_METRICS[f"{tuning.summary['objective']}_rmse"]
    return with_unit(f"worst {about.label}", about.unit)


def _others(tuning: Tuning, side: str) -> list[tuple[str, str, JsonObject]]:
    """Name, marker and figures on the study's own excitation of the gains that the tuned ones are compared with."""
    rows = [row for row in tuning.summary["named"] if row["side"] == side and row["name"] != "tuned"]
    return [(literal(row["name"]), MARKERS[i % len(MARKERS)], row) for i, row in enumerate(rows)]


def _map(tuning: Tuning, side: str) -> Drawn:
    summary, bound = tuning.summary, tuning.summary["f_plus"][side]
    coarse = tuning.candidates[side].query("stage == 0")
    constraints, binding = (summary["limits"][side][key] for key in ("constraints", "binding"))
    tables = coarse.astype({"feasible": float, "converged": float}).pivot_table(
        index="lambda",
        columns="alpha",
        values=["error", "feasible", *(CONSTRAINT_COLUMNS[name] for name in binding)],
        dropna=False,
    )
    grid, feasible = tables["error"].to_numpy(float), tables["feasible"].to_numpy(float)
    xs, ys = tables["error"].columns.to_numpy(float), tables.index.to_numpy(float)
    norm = color_norm(grid, "log")
    edges = cell_edges(xs, True), cell_edges(ys, True)
    figure, (ax,) = subplots(7.2, 6.0, beside=True)
    ax.grid(False)
    ax.set_facecolor(MISSING)
    ax.set(xscale="log", yscale="log")
    fit_axes(ax, edges)
    ax.pcolormesh(*edges, grid, cmap=MAP, norm=norm, rasterized=True)
    handles: list[Any] = [*hatch_failures(ax, (xs, ys), edges, feasible, "constraints not met")]
    lines = {name: _binding_line(ax, edges, tables, name, constraints[name]) for name in binding}
    handles += [handle for line in lines.values() for handle in line]
    handles += condition_curves(ax, _CONDITIONS, bound, (edges[0][0], edges[0][-1]))
    for window in summary["stages"][1:2]:
        (left, right), (low, high) = (
            np.array(window[side][f"{gain}_ratio"]) * unit for gain, unit in (("alpha", bound), ("lambda", np.sqrt(bound)))
        )
        ax.add_patch(Rectangle((left, low), right - left, high - low, fill=False, ec="white", ls="--", lw=1.2))
        handles.append(Patch(fill=False, ec="#777777", ls="--", label="first zoom"))
    gains = summary["gains"][side]
    fit_axes(ax, edges)
    for name, marker, row in _others(tuning, side):
        handles.append(mark(ax, (row["alpha"], row["lambda"]), marker, name, 8))
    handles.append(mark(ax, (gains["alpha"], gains["lambda"]), "*", "tuned", 15))
    name_gains(ax, bound)
    ax.set_title(
        f"{side}: tuned ★ λ = {gains['lambda']:.3g} √rad/s, α = {gains['alpha']:.3g} rad/s²,  f⁺ = {bound:.3g} rad/s²"
        + (f"\n{flat}" if (flat := flat_remark(grid)) else "")
    )
    figure.colorbar(ScalarMappable(norm, MAP), ax=ax, pad=0.02, aspect=28, label=_label(tuning))
    if np.isnan(grid).any():
        handles.append(Patch(facecolor=MISSING, label=f"diverged ({int(np.isnan(grid).sum())} points)"))
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    drawn = [name for name, line in lines.items() if line]
    bold = f" Bold line: {' and '.join(drawn)}, which bind{'s' * (len(drawn) == 1)}." if drawn else ""
    caption = (
        f"{side}: {_label(tuning)} over all runs, on the coarse map; above and on the right the axes of the atlas "
        f"(jaxbl verify). Hatched: not converged, or a margin not met.{bold} Curves: least λ of the gain conditions at the "
        "f⁺ of the pilot run. The other gains are compared below."
    )
    return Drawn(f"tuning_{side}", figure, caption)


def _binding_line(ax: Axes, edges: Any, tables: pd.DataFrame, name: str, found: JsonObject) -> list[Line2D]:
    """The line on the coarse map along which a constraint that binds is just met. Returns the legend's handles."""
    values = tables[CONSTRAINT_COLUMNS[name]]
    xs, ys, level = values.columns.to_numpy(float), values.index.to_numpy(float), found.get("limit", 0.5)
    shown = values.to_numpy(float)
    if not np.nanmin(shown) < level < np.nanmax(shown):
        return []
    # out to the edges of the outer cells
    xs, ys = (np.concatenate([e[:1], c, e[-1:]]) for c, e in zip((xs, ys), edges, strict=True))
    lines = ax.contour(xs, ys, np.pad(shown, 1, mode="edge"), levels=[level], colors=_LIMITS[name], linewidths=3.0, zorder=3)
    outlined = [path_effects.Stroke(linewidth=5.0, foreground="white"), path_effects.Normal()]
    lines.set_path_effects(outlined)
    return [Line2D([], [], color=_LIMITS[name], lw=3.0, path_effects=outlined, label=_called(name, found))]


_LIMITS = {"converged": "#7F7F7F", "margin_alpha": "#3F51B5", "margin_exact": "#E8000B", "longest_convergence": "#8B4513"}
"""Colours of constraints."""


def _called(name: str, found: JsonObject) -> str:
    """A constraint with its limit, and whether it binds."""
    limit = f" = {found['limit']:g}" if "limit" in found else ""
    return f"{name}{limit}{' (binds)' if found['binds'] else ''}"


def _missing(names: list[str]) -> str:
    """What gains do that miss constraints."""
    margins = [name for name in names if name != "converged"]
    parts = [f"misses {' and '.join(margins)}"] if margins else []
    return " and ".join([*parts, "does not converge"] if "converged" in names else parts)


def _limits(tuning: Tuning, side: str) -> Drawn:
    """The error along each gain through the optimum, and what ends the way to each side."""
    summary, bound = tuning.summary, tuning.summary["f_plus"][side]
    found, gains, error = summary["limits"][side], summary["gains"][side], summary["achieved"][side]
    velocity = summary["objective"] == "velocity"
    figure, axes = subplots(9.6, 4.6, columns=2, beside=True, sharey=True)
    shaded: JsonObject = {}
    handles: JsonObject = {}
    for ax, (gain, symbol, unit, label, ratio) in zip(axes, _PLANES, strict=True):
        line = pd.DataFrame(found["profiles"][gain])
        x, y = line[gain].to_numpy(float), line["error"].to_numpy(float)
        edges = cell_edges(x, True)
        ax.set(xscale="log", yscale="log", xlim=edges[[0, -1]])
        for name, one in found["constraints"].items():
            look: JsonObject = {"facecolor": _LIMITS[name], "alpha": 0.4 if one["binds"] else 0.15, "lw": 0.0}
            missed = line["missed"].map(lambda names, name=name: name in names).to_numpy(bool)
            for first, last in _stretches(missed):
                ax.axvspan(edges[first], edges[last], **look)
                shaded[name] = Patch(**look, label=f"not met: {_called(name, one)}")
        (handles["error"],) = ax.plot(x, y, color=COLOURS[0], lw=2.0, label=_label(tuning))
        if velocity:
            chatter = line["chatter"].to_numpy(float)
            with np.errstate(invalid="ignore"):
                slow = np.sqrt(y**2 - chatter**2)
            (handles["chatter"],) = ax.plot(x, chatter, color=COLOURS[4], lw=1.2, label="its chatter, sample to sample")
            (handles["slow"],) = ax.plot(x, slow, color=COLOURS[2], lw=1.2, label="its slow part, the rest")
        ax.axvline(gains[gain], color="black", lw=0.8)
        handles["tuned"] = mark(ax, (gains[gain], error[f"{summary['objective']}_rmse"]), "*", "tuned", 15, held=False)
        smaller, larger = (f"{way} {symbol}: {_short(one)}" for way, one in found["towards"][gain].items())
        ax.set_title(f"← {smaller}", loc="left", fontsize=9)
        ax.set_title(f"{larger} →", loc="right", fontsize=9)
        ax.set_xlabel(f"{symbol} ({unit})")
        name_ratio(ax, "x", ratio(bound), label)
    axes[0].set_ylabel(_label(tuning))
    figure.suptitle(f"{side}: what limits the gains", fontsize=10)
    figure.legend(handles=[*shaded.values(), *handles.values()], loc="outside lower center", ncols=3)
    caption = (
        f"{side}: the error along each gain, with the other one as tuned, from the runs of all maps (between two rows of a "
        "map, interpolated). "
    )
    if velocity:
        caption += (
            "Chatter is the rms change from sample to sample over √2; the slow part is the rest of the mean square, where "
            "chatter is not above the error. "
        )
    caption += f"What limits the gains: {_limits_text(found)}"
    return Drawn(f"limits_{side}", figure, caption)


_PLANES = (
    ("lambda", "λ", "√rad/s", "λ / √f⁺", np.sqrt),
    ("alpha", "α", "rad/s²", "α / f⁺", float),
)


def _stretches(there: np.ndarray) -> list[tuple[int, int]]:
    """First, and one after the last, index of each stretch that is true."""
    steps = np.flatnonzero(np.diff(np.concatenate([[False], there, [False]]).astype(int)))
    return list(zip(steps[::2], steps[1::2], strict=True))


def _short(way: JsonObject) -> str:
    """What limits a gain towards one side, in few words."""
    if way["limit"] == "constraint":
        return " and ".join(way["missed"])
    if way["limit"] == "range":
        return "end of the range"
    if way["change"] is None:
        return "diverges"
    return f"error {_size(way['change'])}"


def _size(change: float) -> str:
    """A relative change in few characters."""
    return f"× {1.0 + change:.2g}" if change >= 1.0 else f"{100.0 * change:+.2g} %"


def _limits_text(found: JsonObject) -> str:
    """What limits gains towards smaller and larger values (`limits` of a side), in sentences."""
    binding = [f"{_called(name, one | {'binds': False})} (here {one['value']:.4g})" if "limit" in one else name
               for name, one in found["constraints"].items() if one["binds"]]  # fmt: skip
    if binding:
        lines = [f"{' and '.join(binding)} bind{'s' * (len(binding) == 1)}."]
    elif found["range_ends"]:
        lines = ["no constraint binds beside the optimum, but the range searched ends there."]
    else:
        lines = ["no constraint binds beside the optimum, which lies inside of the range searched."]
    for gain, symbol, unit, *_ in _PLANES:
        ways = found["towards"][gain]
        text = "; ".join(_way(way, symbol, unit, one) for way, one in ways.items())
        lines.append(f"{text[0].upper()}{text[1:]}.")
        if [one["by"] for one in ways.values()] == ["slow", "chatter"]:
            lines.append(f"So for {symbol} the slow part of the error balances its chatter.")
    return " ".join(lines)


def _way(way: str, symbol: str, unit: str, found: JsonObject) -> str:
    """What limits a gain towards one side, as part of a sentence."""
    if found["limit"] == "range":
        return f"{way} {symbol}: outside of the range searched (tune.{'lambda' if symbol == 'λ' else 'alpha'}_ratio)"
    if found["at"] is None:
        return f"{way} {symbol}: {_missing(found['missed'])}"
    at = f"{symbol} = {found['at']:.3g} {unit}"
    if found["change"] is None:
        return f"{way} {symbol}: runs diverge (at {at})"
    size = f"error {_size(found['change'])} at {at}"
    by = {"chatter": ", as its chatter grows", "slow": ", as its slow part grows", None: ""}[found["by"]]
    joint = ", but it" if found["limit"] == "constraint" else ", and it"
    missed = f"{joint} {_missing(found['missed'])}" if found["missed"] else ""
    return f"{way} {symbol}: {size}{by}{missed}"


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


def _bars(ax: Axes, key: str, rows: list[JsonObject]) -> None:
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
    certified = certificate_lines(summary)
    lead = [*certified, *tune_headline(summary)] if is_refuted(summary) else [*tune_headline(summary), *certified]
    write_atomic(folder / "gains.toml", gains_toml(summary))
    write_certificates(summary, folder)
    write_json(folder / "tuning.json", summary, allow_nan=False)
    tables = [
        _gains_table(summary),
        *certificate_tables(summary),
        _comparison_table(f"{_where(summary).capitalize()}, worst and median of all runs", summary["holdout"]["rows"]),
        _comparison_table("On the study's own excitation, worst and median of all runs", summary["named"]),
        *_pareto_tables(summary),
    ]
    title, config = tuning.config.title or "Gains", tuning.config.to_toml()
    return write_report(folder, title, lead, draw_tuning(tuning), tables, config, summary["remarks"])


def gains_toml(summary: JsonObject) -> str:
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


def _runs_behind(summary: JsonObject) -> str:
    first, last = summary["seeds"]
    seeds, drives = last - first + 1, len(summary["scenarios"])
    return f"{seeds} noise seed{'s' * (seeds > 1)} and {drives} drive{'s' * (drives > 1)}"


def _where(summary: JsonObject) -> str:
    """Which runs were held out."""
    held = summary["holdout"]
    other = f"on the held-out excitation ({held['excitation']['kind']})"
    return "on the study's excitation with other noise" if held["same_excitation"] else other


def tune_headline(summary: JsonObject) -> list[str]:
    """Say whether gains matter, the chosen ones, and their errors on the held-out runs."""
    metric = f"{summary['objective']}_rmse"
    unit = SIDE_METRICS[metric].unit
    lines = doubts_among(summary["remarks"])
    lines += [f"{side}: {describe_verdict(verdict)}" for side, verdict in summary["verdict"].items()]
    for side, gains in summary["gains"].items():
        found, verdict = summary["achieved"][side], summary["verdict"][side]
        lines.append(
            f"{side}: lambda = {gains['lambda']:.4g} √rad/s, alpha = {gains['alpha']:.4g} rad/s² "
            f"({gains['lambda_ratio']:.3g} √f⁺, {gains['alpha_ratio']:.3g} f⁺): {summary['objective']} error "
            f"{found[metric]:.3g} {unit} rms, converged after {found['convergence_time']:.3g} s, the worst of "
            f"{_runs_behind(summary)}. {describe_margins(verdict['margins'])} "
            f"{verdict['nearly_as_good']} of {verdict['tried']} gains are as good within {100 * NEARLY_AS_GOOD:g} %."
        )
    limits = {side: found for side, found in summary["limits"].items() if summary["verdict"][side]["gains_matter"] != "no"}
    lines += [f"{side}, what limits the gains: {_limits_text(found)}" for side, found in limits.items()]
    if any(way["by"] for found in limits.values() for ways in found["towards"].values() for way in ways.values()):
        lines[-1] += " (Chatter is what changes from sample to sample, the slow part is the rest.)"
    lines += [conditions_line(side, one, "the largest of all runs") for side, one in summary["conditions"].items()]
    where = _where(summary)
    rows = {(row["name"], row["side"]): row for row in summary["holdout"]["rows"]}
    for side, others in summary["holdout"]["factors"].items():
        parts = []
        for name, factors in others.items():
            called, row = describe_gains(name), rows[name, side]
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


def describe_verdict(verdict: JsonObject) -> str:
    """Say whether gains matter (`verdict` of a side), and what limits the error."""
    factor, shares = verdict["worst_over_least"], verdict["causes"]
    more = f"{100 * (factor - 1):.2g} %"
    limits = ", ".join(f"{part} {100 * share:.2g} %" for part, share in sorted(shares.items(), key=lambda part: -part[1]))
    sentences = {
        "yes": f"gains matter: the worst that meet all constraints have {factor:.3g} times the least error.",
        "no": f"gains do not matter: all that meet the constraints are within {more} of the least error.",
        "range": "limited by the range searched: better gains may lie beyond it.",
    }
    return f"{sentences[verdict['gains_matter']]} What the mean square error is due to: {limits}."


def _gains_table(summary: JsonObject) -> PageTable:
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


def _comparison_table(heading: str, found: list[JsonObject]) -> PageTable:
    rows = [
        [row["side"], row["name"], row["lambda"], row["alpha"], 100.0 * row["converged"],
         *(row[name][how] for name in ("velocity_rmse", "torque_rmse") for how in ("worst", "median")),
         row["convergence_time"]["worst"], row["margin_alpha"], row["margin_exact"], row["peak_ratio"]]
        for row in sorted(found, key=lambda row: SIDES.index(row["side"]))
    ]  # fmt: skip
    columns = ["side", "gains", "λ", "α", "converged (%)", "velocity error (rad/s)", "median", "torque error (N m)",
               "median", "convergence (s)", "margin α", "margin exact", "ρ"]  # fmt: skip
    return PageTable(heading, columns, rows)


def _pareto_tables(summary: JsonObject) -> list[PageTable]:
    unit = SIDE_METRICS[f"{summary['objective']}_rmse"].unit
    columns = ["λ", "α", "λ/√f⁺", "α/f⁺", "convergence time (s)", f"{summary['objective']} error ({unit})"]
    return [
        PageTable(
            f"No gains beat these in both convergence time and error: {side}", columns, [list(row.values()) for row in rows]
        )
        for side, rows in summary["pareto"].items()
    ]
