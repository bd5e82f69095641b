"""What `jaxbl tune` leaves to be read: the objective over the gains, what limits them, comparisons, certificates."""

from collections.abc import Iterator
from decimal import ROUND_CEILING, ROUND_FLOOR, Context
from itertools import cycle
from pathlib import Path

import numpy as np

from jaxbl.files import write_atomic, write_json
from jaxbl.gains.best_gains import NEARLY_AS_GOOD
from jaxbl.gains.tune import Tuning
from jaxbl.gains.tune_summary import describe_gains
from jaxbl.json_types import JsonObject
from jaxbl.lines import doubts_among, percent
from jaxbl.result import KeyFigure, Result, ResultTable
from jaxbl.sweeps.metrics import SIDE_METRICS

from .gain_plane import (
    EXACT,
    RESERVE_WORDS,
    condition_curves,
    describe_conditions,
    gain_axes,
    say_thin_reserve,
    usual_rule_curve,
)
from .maps import cell_edges, colour_scale, flat_remark
from .numbers import lead_with_doubt
from .panels import MARKERS, Figure, Line, Map, Panel, literal, mark, with_unit


def draw(tuning: Tuning) -> list[Figure]:
    """All figures of a tuning."""
    return [_map(tuning, side) for side in tuning.config.sides if side in tuning.candidates]


def error_label(summary: JsonObject) -> str:
    """The error that is compared, with its unit."""
    metric = SIDE_METRICS[f"{summary['objective']}_rmse"]
    return with_unit(metric.label, metric.unit)


def _map(tuning: Tuning, side: str) -> Figure:
    summary, bound = tuning.summary, tuning.summary["f_plus"][side]
    gains, label = summary["gains"][side], f"worst {error_label(summary)}"
    # the coarse map
    runs = tuning.candidates[side].query("stage == 0").pivot(index="lambda", columns="alpha")
    error = runs["error"]
    longest = np.inf if (table := tuning.config.tune) is None else table.longest_convergence or np.inf
    # gains that do not converge have no time
    grid, failed = error.to_numpy(float), ~(runs["convergence_time"].to_numpy(float) <= longest)
    values = np.where(failed, np.nan, grid)
    x, y = (cell_edges(axis.to_numpy(float), True) for axis in (error.columns, error.index))
    alphas, lambdas = ((edges[0], edges[-1]) for edges in (x, y))
    cells = Map(x, y, grid, colour_scale(values, label, "log"), failed, "not converged in time")
    curves, asked = condition_curves(EXACT, bound, alphas), summary["margins"]
    x_asked = np.maximum([alphas[0], *curves[-1].x], asked["alpha"] * bound)
    margins = Line(x_asked, [lambdas[1], *(asked["exact"] * curves[-1].y)], "", "#FFFFFF", 2.0, ":")
    parts = [cells, *curves, margins, usual_rule_curve(bound, alphas)]
    # on the study's own excitation
    compared = [row for row in summary["named"] if row["side"] == side and row["name"] != "tuned"]
    for row, marker in zip(compared, cycle(MARKERS), strict=False):
        # a mark outside stands on the edge
        inside = alphas[0] <= row["alpha"] <= alphas[1] and lambdas[0] <= row["lambda"] <= lambdas[1]
        parts += [mark(row["alpha"], row["lambda"], literal(row["name"]) + " (off the map)" * (not inside), marker, 8.0)]
    parts += [mark(gains["alpha"], gains["lambda"], "tuned")]
    title = f"{side}: tuned ★ λ = {gains['lambda']:.3g} √rad/s, α = {gains['alpha']:.3g} rad/s²,  f⁺ = {bound:.3g} rad/s²"
    if flat := flat_remark(values):
        title = f"{title}\n{flat}"
    caption = (
        f"{side}: {label} over all runs, on the coarse map; above and on the right the axes of the atlas "
        "(jaxbl verify). Curves: the exact gain condition at the f⁺ of the pilot run, dotted with the margins "
        "asked for; the usual rule's gains for this f⁺ and larger ones. The other gains are compared below."
    )
    panel = Panel(*gain_axes(bound, alphas, lambdas), parts, title)
    return Figure(f"tuning_{side}", [panel], caption, width=6.4, height=4.8)


_GAINS = ("lambda", "λ", "√rad/s"), ("alpha", "α", "rad/s²")


def _size(change: float) -> str:
    """A relative change in few characters."""
    return f"× {1.0 + change:.2g}" if change >= 1.0 else f"{'+' * (change > 0.0)}{percent(change)}"


def _way(symbol: str, unit: str, way: JsonObject) -> str:
    """Say what limits a gain towards one side, as part of a sentence."""
    if way["limit"] == "range":
        return f"outside of the range searched (tune.{'lambda' if symbol == 'λ' else 'alpha'}_ratio)"
    missed = " and ".join("does not converge" if name == "converged" else f"misses {name}" for name in way["missed"])
    if way["at"] is None:
        return missed
    place = f"{symbol} = {way['at']:.3g} {unit}"
    if way["change"] is None:
        return f"runs diverge (at {place})"
    cause = {"chatter": ", as its chatter grows", "slow": ", as its slow part grows", None: ""}[way["by"]]
    joint = "but" if way["limit"] == "constraint" else "and"
    return f"error {_size(way['change'])} at {place}{cause}{f', {joint} it {missed}' if missed else ''}"


def write(tuning: Tuning, folder: Path) -> None:
    """Write `gains.toml`, and `certificate.json` of the sides of which something is proven, if there is one."""
    summary = tuning.summary
    if proven := _proven(summary):
        data = {"title": summary["title"], "observer": "super_twisting", "assumptions": ASSUMPTIONS, "sides": proven}
        write_json(folder / "certificate.json", data)
    write_atomic(folder / "gains.toml", gains_toml(summary))


def describe(tuning: Tuning) -> Result:
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
    doubts, reasons, certified = doubts_among(summary["remarks"]), [*_reasons(summary)], [*certificate_lines(summary)]
    remarks = [*doubts, *reasons, *certified]
    if thin := say_thin_reserve({side: entry["margin"] for side, entry in summary["verdict"].items()}):
        verdict, headline = "doubtful", f"{headline} {thin}"
    if beaten := _better_gains(summary):
        verdict, headline = "doubtful", f"{beaten[0]} err less on the held-out runs than the gains that the search found."
    if any(proof.get("search", {}).get("violations") for proof in summary.get("certificates", {}).values()):
        # before all else
        verdict, headline = "failed", "The search found an error above what was proven."
        remarks = [*certified, *doubts, *reasons]
    details = [line for line in summary["remarks"] if line not in doubts]
    tables = [_gains_table(summary), *certificate_tables(summary), _comparison_table(summary["holdout"])]
    title, figures = tuning.config.title or "Gains", [*_key_figures(summary)]
    return lead_with_doubt(Result(title, verdict, headline, figures, remarks, details, tables))


def _better_gains(summary: JsonObject) -> list[str]:
    """Gains with the margins asked for that err less on the held-out runs than the tuned ones, by more than a little."""
    metric, factors = f"{summary['objective']}_rmse", summary["holdout"]["factors"]
    return [
        f"{row['side']}: {describe_gains(row['name'])}"
        for row in summary["holdout"]["rows"]
        if (factors[row["side"]].get(row["name"], {}).get(metric, {}).get("worst") or 1.0) < 1.0 / (1.0 + NEARLY_AS_GOOD)
        and all((row[f"margin_{key}"] or 0.0) >= margin for key, margin in summary["margins"].items())
    ]


def _key_figures(summary: JsonObject) -> Iterator[KeyFigure]:
    """The error of each side's gains beside that of the others, and how far the gains may change."""
    metric = f"{summary['objective']}_rmse"
    for side, verdict in summary["verdict"].items():
        worst, factors = summary["achieved"][side][metric], summary["holdout"]["factors"][side]
        texts = (
            f" ({factor[metric]['worst']:.3g} times this with {describe_gains(name)})"
            for name, factor in factors.items()
            if "why_none" not in factor and factor[metric]["worst"] is not None
        )
        size = f"{worst:.3g} {SIDE_METRICS[metric].unit}"
        yield KeyFigure(size, f"{side}: worst {summary['objective']} error, rms{next(texts, '')}")
        yield KeyFigure(f"× {verdict['margin']:.3g}", f"{side}: {RESERVE_WORDS}")


def gains_toml(summary: JsonObject) -> str:
    """The chosen gains as TOML that a study can `include`; comments say what they were chosen for."""
    margins, (first, last) = summary["margins"], summary["seeds"]
    seeds, drives = last - first + 1, len(summary["scenarios"])
    lines = [
        f"# Gains chosen by 'jaxbl tune'{for_title(summary)}",
        f"# Objective: {summary['objective_metric']}; {seeds} noise seed{'s' * (seeds > 1)} and {drives} "
        f"drive{'s' * (drives > 1)}.",
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


def _reasons(summary: JsonObject) -> Iterator[str]:
    """Say whether gains matter, what binds, and how far the gains are from where the exact condition fails."""
    for side, verdict in summary["verdict"].items():
        yield f"{side}: {describe_verdict(verdict)}"
    for side, limits in summary["limits"].items():
        if binding := [name for name, constraint in limits["constraints"].items() if constraint["binds"]]:
            yield f"{side}: a smaller error is forbidden by {' and '.join(binding)}."
        elif limits["range_ends"]:
            keys = " and ".join(f"tune.{end.split()[1]}_ratio" for end in limits["range_ends"])
            yield f"{side}: the error still falls, or stays level, where the searched range ends; widen {keys}."
    yield from describe_conditions(summary["conditions"])


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
        for gain, symbol, unit in _GAINS
    ]  # fmt: skip
    return ResultTable("Gains", ["gain", "value", "over f⁺, λ over √f⁺", "a smaller one", "a larger one"], rows)


def _comparison_table(holdout: JsonObject) -> ResultTable:
    """The gains that were compared on the held-out runs, those of the motor first."""
    held_out = f"the held-out excitation ({holdout['excitation']['kind']})"
    where = "the study's excitation with other noise" if holdout["same_excitation"] else held_out
    rows = [
        [*(row[key] for key in ("side", "name", "lambda", "alpha")), 100.0 * row["converged"],
         *(row[name][how] for name in ("velocity_rmse", "torque_rmse") for how in ("worst", "median")),
         row["convergence_time"]["worst"], *(row[key] for key in _MARGINS.values())]
        for row in sorted(holdout["rows"], key=lambda row: row["side"] != "motor")
    ]  # fmt: skip
    columns = ["side", "gains", "λ", "α", "converged (%)", "velocity error (rad/s)", "median", "torque error (N m)",
               "median", "convergence (s)", *_MARGINS]  # fmt: skip
    return ResultTable(f"On {where}, worst and median of all runs", columns, rows)


ASSUMPTIONS = (
    "The acceleration of the shaft less the nominal one that the observer takes for a period (unknown torque over inertia, "
    "and what friction makes of the velocity error) stays within ±f_plus at all times; it may change at any time.",
    "The error of each reading, with its rounding to counts, stays within ±noise.",
    "The sampling period is fixed, and arithmetic is exact.",
    "At the first sample the errors are at most position_error and velocity_error.",
    "With the explicit discretisation the nominal acceleration stays within ±acceleration.",
    "It is about the velocity that the super-twisting observer estimates, not about the torque behind the low-pass.",
)
"""Of every certificate, in words; the numbers are beside them."""


def _proven(summary: JsonObject) -> JsonObject:
    """Certificates of the sides of which something is proven."""
    return {side: proof for side, proof in summary.get("certificates", {}).items() if proof["certified"]}


def _above(value: float, rounding: str = ROUND_CEILING) -> float:
    """Rounded up to four digits (to rounding errors): what is printed as proven must not say more than the proof."""
    return float(Context(4, rounding).create_decimal(f"{value:.12g}"))


def certificate_lines(summary: JsonObject) -> Iterator[str]:
    """Say what the certificates promise of each side, what was tried, and whether that is what was asked for."""
    for side, proof in summary.get("certificates", {}).items():
        if not proof["certified"]:
            yield f"{side}: no certificate: {proof['why_none']}."
            continue
        missed = [
            f"{name.replace('_', ' ')} {limit['asked']:.3g} {'s' if name == 'reaching_time' else 'rad/s'}"
            for name, limit in proof["limits"].items()
            if not limit["met"]
        ]
        if missed:
            yield f"{side}, certificate: what was asked for is not proven: {', '.join(missed)}."
        search, assumed = proof["search"], proof["assumptions"]
        # what is assumed is rounded down
        bounds = {name: _above(value, ROUND_FLOOR) for name, value in assumed.items() if name != "discretisation"}
        nominal = f", nominal acceleration of {bounds['acceleration']:.4g} rad/s²" if "acceleration" in bounds else ""
        promise = f"{_above(proof['accuracy']):.4g} rad/s"
        yield (
            f"{side}, promised: a velocity error of at most {promise} from {_above(proof['reaching_time']):.4g} s on, "
            f"proven (with {_above(proof['final_accuracy']):.4g} rad/s from {_above(proof['curve']['time'][-1]):.4g} s on) "
            f"for any noise within ±{bounds['noise']:.4g} rad and any missing acceleration within "
            f"±{bounds['f_plus']:.4g} rad/s²{nominal}, sampled every {assumed['period']:.4g} s, from errors of "
            f"{bounds['velocity_error']:.4g} rad/s and {bounds['position_error']:.4g} rad."
        )
        yield (
            f"{side}, tried: the worst of {search['runs']} adversarial runs errs by {search['worst']:.3g} rad/s. Another "
            f"search may find more, but not more than the {promise} that are promised."
        )
        if proof["limits"] and not missed:
            passed_over = summary["passed_over"][side]
            gains = f"; {passed_over} gains with less error in the runs do not" if passed_over else ""
            yield f"{side}, certificate: the gains keep what was asked for{gains}."


def certificate_tables(summary: JsonObject) -> list[ResultTable]:
    """A table of what the certificates assume, if there are any."""
    assumptions = [[line] for line in ASSUMPTIONS]
    return [ResultTable("What the certificates assume", ["assumption"], assumptions)] if _proven(summary) else []
