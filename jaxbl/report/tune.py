"""What `jaxbl tune` leaves to be read: the objective over the gains, error over convergence time, comparisons."""

from itertools import cycle, product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.patches import Patch, Rectangle
from pandas import DataFrame

from jaxbl.files import write_atomic, write_json
from jaxbl.gains.best_gains import NEARLY_AS_GOOD
from jaxbl.gains.limits import CONSTRAINT_COLUMNS
from jaxbl.gains.tune import Tuning
from jaxbl.gains.tune_summary import describe_gains
from jaxbl.json_types import JsonObject
from jaxbl.lines import Lines, doubts_among, percent
from jaxbl.observer.conditions import CONDITIONS
from jaxbl.result import KeyFigure, Result, ResultTable
from jaxbl.sweeps.metrics import SIDE_METRICS

from .certificate import certificate_lines, certificate_tables, draw_certificates, is_refuted, write_certificates
from .figures import (
    BLUE,
    GREEN,
    MAP,
    MARKERS,
    MISSING,
    ORANGE,
    SIDES,
    SKY,
    VERMILION,
    Axes,
    Drawn,
    Line2D,
    colour_bar,
    legend_below,
    literal,
    mark,
    stretches,
    style,
    subplots,
    with_unit,
)
from .gain_plane import conditions_line, name_gains, name_ratio
from .maps import Cells, cell_edges, color_norm, condition_curves, flat_remark, hatch_failures, outline_effects, set_up_map
from .numbers import lead_with_doubt

_CONDITIONS = {name: CONDITIONS[name] for name in ("davila_fridman", "seeber_horn", "exact")}


@style()
def draw_tuning(tuning: Tuning) -> list[Drawn]:
    """All figures of a tuning."""
    sides = [side for side in SIDES if side in tuning.candidates]
    maps = [draw(tuning, side) for side in sides for draw in (_map, _limits)]
    fronts = [_front(tuning, side) for side in sides]
    return [*maps, *fronts, _comparison(tuning.summary, sides), *draw_certificates(tuning.summary)]


def error_label(summary: JsonObject) -> str:
    """The error that is compared, with its unit."""
    metric = SIDE_METRICS[f"{summary['objective']}_rmse"]
    return with_unit(metric.label, metric.unit)


def _compared_gains(summary: JsonObject, side: str) -> list[tuple[str, str, JsonObject]]:
    """Name, marker and figures on the study's own excitation of the gains that the tuned ones are compared with."""
    rows = [row for row in summary["named"] if row["side"] == side and row["name"] != "tuned"]
    return [(literal(row["name"]), marker, row) for row, marker in zip(rows, cycle(MARKERS), strict=False)]


def _map(tuning: Tuning, side: str) -> Drawn:
    summary, bound = tuning.summary, tuning.summary["f_plus"][side]
    gains, limits, label = summary["gains"][side], summary["limits"][side], f"worst {error_label(summary)}"
    coarse = tuning.candidates[side].query("stage == 0")
    tables = coarse.astype({"feasible": float, "converged": float}).pivot_table(
        index="lambda",
        columns="alpha",
        values=["error", "feasible", *(CONSTRAINT_COLUMNS[name] for name in limits["binding"])],
        dropna=False,
    )
    grid = tables["error"].to_numpy(float)
    norm = color_norm(grid, "log")
    figure, (ax,) = subplots(7.2, 6.0, beside=True)
    ax.set_facecolor(MISSING)
    cells = set_up_map(ax, [axis.to_numpy(float) for axis in (tables["error"].columns, tables.index)])
    ax.pcolormesh(*cells.edges, grid, cmap=MAP, norm=norm, rasterized=True)
    handles: list[Any] = hatch_failures(ax, cells, tables["feasible"].to_numpy(float), "constraints not met")
    bold = []
    for name in limits["binding"]:
        if line := _binding_line(ax, cells, tables, name, limits["constraints"][name]):
            handles += line
            bold.append(name)
    handles += condition_curves(ax, _CONDITIONS, bound, tuple(cells.edges[0][[0, -1]]))
    for window in summary["stages"][1:2]:
        left, right = np.array(window[side]["alpha_ratio"]) * bound
        low, high = np.array(window[side]["lambda_ratio"]) * np.sqrt(bound)
        ax.add_patch(Rectangle((left, low), right - left, high - low, fill=False, ec="white", ls="--", lw=1.2))
        handles.append(Patch(fill=False, ec="#777777", ls="--", label="first zoom"))
    for name, marker, row in _compared_gains(summary, side):
        handles.append(mark(ax, (row["alpha"], row["lambda"]), marker, name, 8))
    handles.append(mark(ax, (gains["alpha"], gains["lambda"]), "*", "tuned", 15))
    name_gains(ax, bound)
    ax.set_title(
        f"{side}: tuned ★ λ = {gains['lambda']:.3g} √rad/s, α = {gains['alpha']:.3g} rad/s²,  f⁺ = {bound:.3g} rad/s²"
        + (f"\n{flat}" if (flat := flat_remark(grid)) else "")
    )
    colour_bar(figure, ax, norm, label)
    if missing := np.isnan(grid).sum():
        handles.append(Patch(facecolor=MISSING, label=f"diverged ({missing} points)"))
    legend_below(figure, handles)
    remark = f" Bold line: {' and '.join(bold)}, which bind{'s' * (len(bold) == 1)}." if bold else ""
    return Drawn(
        f"tuning_{side}",
        figure,
        f"{side}: {label} over all runs, on the coarse map; above and on the right the axes of the atlas "
        f"(jaxbl verify). Hatched: not converged, or a margin not met.{remark} Curves: least λ of the gain conditions at "
        "the f⁺ of the pilot run. The other gains are compared below.",
    )


def _binding_line(ax: Axes, cells: Cells, tables: DataFrame, name: str, constraint: JsonObject) -> list[Line2D]:
    """The line on the coarse map along which a constraint that binds is just met. Returns the legend's handles."""
    values, level = tables[CONSTRAINT_COLUMNS[name]].to_numpy(float), constraint.get("limit", 0.5)
    if not np.nanmin(values) < level < np.nanmax(values):
        return []
    colour, effects = _LIMITS[name], outline_effects(5.0, "white")
    lines = ax.contour(*cells.out_to_edges(values), levels=[level], colors=colour, linewidths=3.0, zorder=3)
    lines.set_path_effects(effects)
    return [Line2D([], [], color=colour, lw=3.0, path_effects=effects, label=_with_limit(name, constraint))]


_LIMITS = {"converged": "#7F7F7F", "margin_alpha": "#3F51B5", "margin_exact": "#E8000B", "longest_convergence": "#8B4513"}
"""Colours of constraints."""


def _with_limit(name: str, constraint: JsonObject) -> str:
    """A constraint with its limit, and whether it binds."""
    limit = f" = {constraint['limit']:g}" if "limit" in constraint else ""
    return f"{name}{limit}{' (binds)' if constraint['binds'] else ''}"


def _missing(names: list[str]) -> str:
    """Say what gains do that miss constraints."""
    margins = " and ".join(name for name in names if name != "converged")
    parts = [f"misses {margins}"] if margins else []
    return " and ".join([*parts, "does not converge"] if "converged" in names else parts)


def _limits(tuning: Tuning, side: str) -> Drawn:
    """The error along each gain through the optimum, and what ends the way to each side."""
    summary, bound = tuning.summary, tuning.summary["f_plus"][side]
    limits, gains, objective = summary["limits"][side], summary["gains"][side], summary["objective"]
    error = summary["achieved"][side][f"{objective}_rmse"]
    figure, axes = subplots(9.6, 4.6, columns=2, beside=True, sharey=True)
    shaded: JsonObject = {}
    handles: list[Any] = []
    for ax, (gain, symbol, unit, label, ratio) in zip(axes, _PLANES, strict=True):
        line = DataFrame(limits["profiles"][gain])
        x, y = (line[name].to_numpy(float) for name in (gain, "error"))
        edges = cell_edges(x, True)
        ax.set(xscale="log", yscale="log", xlim=edges[[0, -1]], xlabel=f"{symbol} ({unit})")
        for name, constraint in limits["constraints"].items():
            look: JsonObject = {"facecolor": _LIMITS[name], "alpha": 0.4 if constraint["binds"] else 0.15, "lw": 0.0}
            for first, last in stretches(line["missed"].map(lambda names, name=name: name in names)):
                ax.axvspan(edges[first], edges[last], **look)
                shaded[name] = Patch(**look, label=f"not met: {_with_limit(name, constraint)}")
        handles = ax.plot(x, y, color=BLUE, lw=2.0, label=f"worst {error_label(summary)}")
        if objective == "velocity":
            chatter = line["chatter"].to_numpy(float)
            with np.errstate(invalid="ignore"):
                slow = np.sqrt(y**2 - chatter**2)
            handles += ax.plot(x, chatter, color=ORANGE, lw=1.2, label="its chatter, sample to sample")
            handles += ax.plot(x, slow, color=GREEN, lw=1.2, label="its slow part, the rest")
        ax.axvline(gains[gain], color="black", lw=0.8)
        handles.append(mark(ax, (gains[gain], error), "*", "tuned", 15, held=False))
        smaller, larger = (f"{way} {symbol}: {_short(limit)}" for way, limit in limits["towards"][gain].items())
        ax.set_title(f"← {smaller}", loc="left", fontsize=9)
        ax.set_title(f"{larger} →", loc="right", fontsize=9)
        name_ratio(ax, "x", ratio(bound), label)
    axes[0].set_ylabel(f"worst {error_label(summary)}")
    figure.suptitle(f"{side}: what limits the gains", fontsize=10)
    legend_below(figure, [*shaded.values(), *handles])
    caption = (
        f"{side}: the error along each gain, with the other one as tuned, from the runs of all maps (between two rows of a "
        "map, interpolated). "
    )
    if objective == "velocity":
        caption += (
            "Chatter is the rms change from sample to sample over √2; the slow part is the rest of the mean square, where "
            "chatter is not above the error. "
        )
    return Drawn(f"limits_{side}", figure, caption)


_PLANES = (
    ("lambda", "λ", "√rad/s", "λ / √f⁺", np.sqrt),
    ("alpha", "α", "rad/s²", "α / f⁺", float),
)


def _short(way: JsonObject) -> str:
    """Say what limits a gain towards one side, in few words."""
    if way["limit"] == "constraint":
        return " and ".join(way["missed"])
    if way["limit"] == "range":
        return "end of the range"
    return "diverges" if way["change"] is None else f"error {_size(way['change'])}"


def _size(change: float) -> str:
    """A relative change in few characters."""
    return f"× {1.0 + change:.2g}" if change >= 1.0 else f"{100.0 * change:+.2g} %"


def _way(symbol: str, unit: str, way: JsonObject) -> str:
    """Say what limits a gain towards one side, as part of a sentence."""
    if way["limit"] == "range":
        return f"outside of the range searched (tune.{'lambda' if symbol == 'λ' else 'alpha'}_ratio)"
    missed = _missing(way["missed"])
    if way["at"] is None:
        return missed
    place = f"{symbol} = {way['at']:.3g} {unit}"
    if way["change"] is None:
        return f"runs diverge (at {place})"
    cause = {"chatter": ", as its chatter grows", "slow": ", as its slow part grows", None: ""}[way["by"]]
    joint = "but" if way["limit"] == "constraint" else "and"
    return f"error {_size(way['change'])} at {place}{cause}{f', {joint} it {missed}' if missed else ''}"


def _front(tuning: Tuning, side: str) -> Drawn:
    summary, data = tuning.summary, (tuning.candidates[side].query("feasible"), DataFrame(tuning.summary["pareto"][side]))
    feasible, front = ([table[name] for name in ("convergence_time", "error")] for table in data)
    figure, (ax,) = subplots(6.6, 4.4, beside=True)
    ax.plot(*feasible, ".", ms=3.5, color=MISSING, label="gains that meet all constraints")
    ax.step(*front, "o-", where="post", ms=3.5, color=BLUE, label="none better in both")
    handles = ax.get_legend_handles_labels()[0]
    keys, margins = ("convergence_time", f"{summary['objective']}_rmse"), summary["margins"]
    for name, marker, row in _compared_gains(summary, side):
        place = tuple(row[key]["worst"] for key in keys)
        if None in place:
            handles.append(Line2D([], [], ls="", marker="", label=f"{name}: {100 * row['converged']:.3g} % converge"))
            continue
        met = all(row[f"margin_{key}"] >= margin for key, margin in margins.items())
        handles.append(mark(ax, place, marker, name if met else f"{name}, margins not met", 8, held=False))
    handles.append(mark(ax, tuple(summary["achieved"][side][key] for key in keys), "*", "tuned", 15, held=False))
    for (low, high), scale in ((ax.dataLim.intervalx, ax.set_xscale), (ax.dataLim.intervaly, ax.set_yscale)):
        if low > 0.0 and high > 10.0 * low:
            scale("log")
    ax.set(xlabel="worst convergence time (s)", ylabel=f"worst {error_label(summary)}", title=side)
    legend_below(figure, handles, 2)
    return Drawn(
        f"pareto_{side}",
        figure,
        f"{side}: error against convergence time, each the worst of all runs on the study's excitation.",
    )


def _comparison(summary: JsonObject, sides: list[str]) -> Drawn:
    rows, metric = summary["holdout"]["rows"], f"{summary['objective']}_rmse"
    names = list(dict.fromkeys(row["name"] for row in rows))
    figure, axes = subplots(4.6 * len(sides) + 0.6, 1.8 + 0.62 * len(names), 2, len(sides), sharey=True)
    compared = ((metric, f"worst {error_label(summary)}"), ("convergence_time", "worst convergence time (s)"))
    for ax, ((key, label), side) in zip(axes, product(compared, sides), strict=True):
        _bars(ax, key, [row for row in rows if row["side"] == side])
        ax.set(xlabel=label, title=side if key == metric else "")
    axes[0].set_yticks(range(len(names)), [literal(name) for name in names])
    axes[0].invert_yaxis()
    first, last = summary["holdout"]["seeds"]
    seeds = f"seeds {first} to {last}" if last > first else f"seed {first}"
    return Drawn(
        "tuning_holdout",
        figure,
        f"The gains {_where(summary)}, noise {seeds}: worst of all runs, and the median (stroke). Hatched: some runs "
        "did not converge.",
    )


def _bars(ax: Axes, key: str, rows: list[JsonObject]) -> None:
    """Bars of a figure's worst value for each of the gains, with a stroke at the median."""
    lengths = [row[key]["worst"] for row in rows if row[key]["worst"] is not None]
    log = bool(lengths) and min(lengths) > 0.0 and max(lengths) > 30.0 * min(lengths)
    ax.set_xscale("log" if log else "linear")
    for i, row in enumerate(rows):
        worst, median = row[key]["worst"], row[key]["median"]
        if worst is None:
            text = f"converged in {100 * row['converged']:.3g} %" if row["finite"] == 1.0 else "diverged"
            ax.annotate(text, (0.01, i), xycoords=("axes fraction", "data"), va="center", color="#555555", fontsize=9)
            continue
        colour, hatch = VERMILION if row["name"] == "tuned" else SKY, None if row["converged"] == 1.0 else "//"
        ax.barh(i, worst, 0.62, color=colour, hatch=hatch, edgecolor="white", linewidth=0.0)
        if median is not None:
            ax.plot(median, i, "|", ms=12, mew=1.6, color="black")
        ax.annotate(f" {worst:.3g}", (worst, i), va="center", fontsize=9)
    if lengths:
        low = 0.5 * min(row[key]["median"] or row[key]["worst"] for row in rows if row[key]["worst"]) if log else 0.0
        ax.set_xlim(low, max(lengths) * (3.0 if log else 1.22) or 1.0)
    ax.grid(axis="y", visible=False)


def write_tuning(tuning: Tuning, folder: Path) -> str:
    """Write `gains.toml`, `tuning.json` and certificates. Returns the study's TOML."""
    summary = tuning.summary
    write_atomic(folder / "gains.toml", gains_toml(summary))
    write_certificates(summary, folder)
    write_json(folder / "tuning.json", summary, allow_nan=False)
    return tuning.config.to_toml()


def describe_tuning(tuning: Tuning) -> Result:
    """Say which gains to take, whether they matter, and what limits them."""
    summary = tuning.summary
    chosen = "; ".join(
        f"λ = {gains['lambda']:.4g} √rad/s, α = {gains['alpha']:.4g} rad/s² ({side})"
        for side, gains in summary["gains"].items()
    )
    matter = {verdict["gains_matter"] for verdict in summary["verdict"].values()}
    verdict, headline = "good", f"Take {chosen}."
    if matter == {"no"}:
        headline = f"The gains hardly matter here; take {chosen}."
    elif "range" in matter:
        verdict, headline = "doubtful", f"Better gains may lie beyond the range searched; of those in it take {chosen}."
    certified = certificate_lines(summary)
    if beaten := _better_gains(summary):
        verdict, headline = "doubtful", f"{beaten[0]} err less on the held-out runs than the gains that the search found."
    remarks = [*doubts_among(summary["remarks"]), *_reasons(summary)]
    if is_refuted(summary):
        verdict, headline = "failed", "The search found an error above what was proven."
    details = [line for line in summary["remarks"] if line not in remarks]
    tables = [
        _gains_table(summary),
        *certificate_tables(summary),
        _comparison_table(f"{_where(summary).capitalize()}, worst and median of all runs", summary["holdout"]["rows"]),
    ]
    title = tuning.config.title or "Gains"
    remarks = [*certified, *remarks] if is_refuted(summary) else [*remarks, *certified]
    return lead_with_doubt(Result(title, verdict, headline, _key_figures(summary), remarks, details, tables))


def _better_gains(summary: JsonObject) -> list[str]:
    """Gains with the margins asked for that err less on the held-out runs than the tuned ones, by more than a little."""
    metric, factors = f"{summary['objective']}_rmse", summary["holdout"]["factors"]
    return [
        f"{row['side']}: {describe_gains(row['name'])}"
        for row in summary["holdout"]["rows"]
        if (factor := factors[row["side"]].get(row["name"], {}).get(metric)) is not None
        and (factor["worst"] or 1.0) < 1.0 / (1.0 + NEARLY_AS_GOOD)
        and all((row[f"margin_{key}"] or 0.0) >= margin for key, margin in summary["margins"].items())
    ]


def _key_figures(summary: JsonObject) -> list[KeyFigure]:
    """The error of each side's gains beside that of the others, and how far the gains may change."""
    metric, figures = f"{summary['objective']}_rmse", []
    for side, verdict in summary["verdict"].items():
        worst, factors = summary["achieved"][side][metric], summary["holdout"]["factors"][side]
        factors_text = [
            f"{factor[metric]['worst']:.3g} times as much with {describe_gains(name)}"
            for name, factor in factors.items()
            if "why_none" not in factor and factor[metric]["worst"] is not None
        ]
        besides = f" ({factors_text[0]})" if factors_text else ""
        meaning = f"{side}: worst {summary['objective']} error, rms{besides}"
        figures.append(KeyFigure(f"{worst:.3g} {SIDE_METRICS[metric].unit}", meaning))
        reach = min(verdict["margins"].values())
        figures.append(KeyFigure(f"× {reach:.3g}", f"{side}: change of the gains until they fail or err twice as much"))
    return figures


def gains_toml(summary: JsonObject) -> str:
    """The chosen gains as TOML that a study can `include`; comments say what they were chosen for."""
    margins = summary["margins"]
    lines = [
        f"# Gains chosen by 'jaxbl tune'{for_title(summary)}",
        f"# Objective: {summary['objective_metric']}; {_runs_behind(summary)}.",
        f"# Margins asked for: alpha / f+ {margins['alpha']:g}, lambda over the least of the exact condition "
        f"{margins['exact']:g}.",
        '# To use them, put include = "gains.toml" at the top of a study and leave its own gains out.',
    ]
    for side, gains in summary["gains"].items():
        achieved = summary["achieved"][side]
        lines += [
            "",
            f"# f+ = {summary['f_plus'][side]:.4g} rad/s^2. Reached, the worst of all runs: velocity error "
            f"{achieved['velocity_rmse']:.3g} rad/s rms,",
            f"# torque error {achieved['torque_rmse']:.3g} N m rms, converged after {achieved['convergence_time']:.3g} s; "
            f"margins {achieved['margin_alpha']:.3g} (alpha), {achieved['margin_exact']:.3g} (exact).",
            f"[observer.{side}]",
            f"lambda = {gains['lambda']!r}",
            f"alpha = {gains['alpha']!r}",
        ]
    return "\n".join(lines) + "\n"


def for_title(summary: JsonObject) -> str:
    """Say what gains were chosen for, in one line."""
    title = " ".join(summary["title"].split())
    return f" for: {title}" if title else ""


def _runs_behind(summary: JsonObject) -> str:
    first, last = summary["seeds"]
    seeds, drives = last - first + 1, len(summary["scenarios"])
    return f"{seeds} noise seed{'s' * (seeds > 1)} and {drives} drive{'s' * (drives > 1)}"


def _where(summary: JsonObject) -> str:
    """Which runs were held out."""
    runs = summary["holdout"]
    other = f"on the held-out excitation ({runs['excitation']['kind']})"
    return "on the study's excitation with other noise" if runs["same_excitation"] else other


def _reasons(summary: JsonObject) -> Lines:
    """Say whether gains matter, what binds, and how far the gains are from where the exact condition fails."""
    lines = [f"{side}: {describe_verdict(verdict)}" for side, verdict in summary["verdict"].items()]
    for side, limits in summary["limits"].items():
        if binding := [name for name, constraint in limits["constraints"].items() if constraint["binds"]]:
            lines.append(f"{side}: a smaller error is forbidden by {' and '.join(binding)}.")
        elif limits["range_ends"]:
            keys = " and ".join(f"tune.{end.split()[1]}_ratio" for end in limits["range_ends"])
            lines.append(f"{side}: the error still falls, or stays level, where the searched range ends; widen {keys}.")
    return lines + [conditions_line(side, gains, "the largest of all runs") for side, gains in summary["conditions"].items()]


def describe_verdict(verdict: JsonObject) -> str:
    """Say whether gains matter (`verdict` of a side), and what limits the error."""
    factor = verdict["worst_over_least"]
    excess = percent(factor - 1.0)
    causes = sorted(verdict["causes"].items(), key=lambda cause: -cause[1])
    limits = ", ".join(f"{part} {percent(share)}" for part, share in causes)
    sentences = {
        "yes": f"gains matter: the worst that meet all constraints have {factor:.3g} times the least error.",
        "no": f"gains do not matter: all that meet the constraints are within {excess} of the least error.",
        "range": "limited by the range searched: better gains may lie beyond it.",
    }
    return f"{sentences[verdict['gains_matter']]} What the mean square error is due to: {limits}."


_MARGINS = {"margin α": "margin_alpha", "margin exact": "margin_exact", "ρ": "peak_ratio"}
"""Columns of tables, and keys of their values."""


def _gains_table(summary: JsonObject) -> ResultTable:
    """Each gain, and what speaks against a smaller and a larger one."""
    rows = [
        [f"{side}: {symbol} ({unit})", gains[gain], gains[f"{gain}_ratio"],
         *(_way(symbol, unit, limit) for limit in summary["limits"][side]["towards"][gain].values())]
        for side, gains in summary["gains"].items()
        for gain, symbol, unit, *_ in _PLANES
    ]  # fmt: skip
    return ResultTable("Gains", ["gain", "value", "over f⁺, λ over √f⁺", "a smaller one", "a larger one"], rows)


def _comparison_table(heading: str, gains: list[JsonObject]) -> ResultTable:
    rows = [
        [*(row[key] for key in ("side", "name", "lambda", "alpha")), 100.0 * row["converged"],
         *(row[name][how] for name in ("velocity_rmse", "torque_rmse") for how in ("worst", "median")),
         row["convergence_time"]["worst"], *(row[key] for key in _MARGINS.values())]
        for row in sorted(gains, key=lambda row: SIDES.index(row["side"]))
    ]  # fmt: skip
    columns = ["side", "gains", "λ", "α", "converged (%)", "velocity error (rad/s)", "median", "torque error (N m)",
               "median", "convergence (s)", *_MARGINS]  # fmt: skip
    return ResultTable(heading, columns, rows)
