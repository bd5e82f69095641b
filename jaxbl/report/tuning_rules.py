"""Public tuning rules beside the exact condition: figure, sentence and table of `jaxbl verify`."""

from typing import Any

import numpy as np

from jaxbl.gains.rules import RULES, allows_gains
from jaxbl.gains.under_tuned import SINE_LIMIT
from jaxbl.json_types import JsonObject
from jaxbl.observer.conditions import CONDITIONS
from jaxbl.result import ResultTable

from .figures import COLOURS, FAINT, MISSING, Axes, Drawn, Line2D, Patch, decades, style, subplots
from .maps import least_lambdas

_ALPHA, _LAMBDA = (0.3, 20.0), (0.15, 25.0)
"""Ends of the plane, alpha / f⁺ and lambda / √f⁺."""
_DASHES = ("-", "--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1, 1, 1)), (0, (8, 2)), (0, (3, 1)))
_RULE_COLOURS = (*COLOURS[:6], FAINT)
_MARKERS = ("D", "o", "s", "^")


@style()
def draw_rules(rules: list[JsonObject]) -> Drawn:
    """The plane of gains with the exact border and the borders of all rules (`rules` of a verdict) at f⁺ = 1 rad/s²."""
    figure, axes = subplots(10.4, 6.4, columns=2, beside=True, sharex=True, sharey=True)
    titles = {
        True: "Sufficient: all gains that they allow converge",
        False: "Not sufficient: where shaded, gains that they allow do not converge",
    }
    for ax, (sufficient, title) in zip(axes, titles.items(), strict=True):
        handles = _draw_border(ax)
        looks, markers = zip(_RULE_COLOURS, _DASHES, strict=False), iter(_MARKERS)
        for rule in sorted(rules, key=lambda rule: rule["kind"] == "gains"):
            if rule["sufficient"] != sufficient:
                continue
            if rule["kind"] == "region":
                handles.append(_draw_region(ax, rule, *next(looks)))
                continue
            look: Any = {"ls": "", "marker": next(markers), "mfc": "white", "mec": "black", "mew": 1.2}
            ax.plot(rule["gains"]["alpha"], rule["gains"]["lambda"], zorder=6, ms=7, **look)
            handles.append(Line2D([], [], label=rule["title"], **look))
        ax.set_title(title)
        ax.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=2, handlelength=3.2)
    axes[0].set_ylabel("λ / √f⁺")
    return Drawn(
        "tuning_rules",
        figure,
        "Rules for gains at f⁺ = 1 rad/s²: each allows what is above its line, or between its two lines; "
        "λ²/2α − λ⁴/16 < f⁺² allows what is below it. Grey: gains that do not converge under the worst disturbance. ×: "
        "gains that the rule allows, simulated; a rule that depends on units may fail only at another f⁺ (its × is in units "
        "of that). Dotted: below it a sine within f⁺ upholds a limit cycle, if there is no friction.",
    )


def _draw_border(ax: Axes) -> list[Any]:
    """Exact border, what does not converge, and where a sine upholds a cycle. Returns the legend's handles."""
    alpha = np.geomspace(1.0001, _ALPHA[1], 400)
    exact = least_lambdas(CONDITIONS["exact"], alpha, 1.0)
    ax.grid(False)
    ax.set(xscale="log", yscale="log", xlim=_ALPHA, ylim=_LAMBDA, xlabel="α / f⁺")
    decades(ax)
    for axis, ticks in ((ax.xaxis, (0.5, 1, 2, 5, 10, 20)), (ax.yaxis, (0.2, 0.5, 1, 2, 5, 10, 20))):
        axis.set_ticks(ticks)
    below = {"color": MISSING, "alpha": 0.55, "lw": 0}
    ax.axvspan(_ALPHA[0], 1.0, **below)
    ax.fill_between(np.r_[1.0, alpha], _LAMBDA[0], np.r_[exact[0], exact], **below)
    handles = ax.plot(np.r_[1.0, alpha], np.r_[_LAMBDA[1], exact], color="black", lw=2.4, label="exact, ρ < 1")
    handles += ax.plot(alpha, SINE_LIMIT / np.sqrt(alpha), color="black", lw=1.2, ls=":", label="a sine's limit cycle")
    return [*handles, Patch(**below, label="does not converge")]


def _draw_region(ax: Axes, judged: JsonObject, colour: str, dashes: Any) -> Line2D:
    """Borders of a rule's region; where it is wrong it is shaded. Returns the legend's handle."""
    alpha, rule = np.geomspace(*_ALPHA, 1201), RULES[judged["name"]]
    assert rule.intervals is not None
    look: JsonObject = {"color": colour, "ls": dashes, "lw": 2.0, "label": judged["title"]}
    for low, high in rule.intervals(alpha, np.ones_like(alpha)):
        for border, is_border in ((low, low > 0.0), (high, np.isfinite(high))):
            ax.plot(alpha, np.where((low < high) & is_border, border, np.nan), **look)
    if (wrong := judged["counterexample"]) is not None:
        lambda_ = np.geomspace(*_LAMBDA, 401)
        rows = lambda_[:, None]
        fails = allows_gains(rule, rows, alpha[None, :], 1.0) & (rows <= least_lambdas(CONDITIONS["exact"], alpha, 1.0))
        ax.contourf(alpha, lambda_, fails, levels=[0.5, 1.5], colors=[colour], alpha=0.25)
        place = wrong["alpha"] / wrong["f_plus"], wrong["lambda"] / np.sqrt(wrong["f_plus"])
        ax.plot(*place, "x", color=colour, ms=9, mew=2.5, zorder=7)
    return Line2D([], [], **look)


def rule_lines(rules: list[JsonObject]) -> list[str]:
    """Say what was found about the rules, in sentences."""
    lines, shares = [], []
    for rule in rules:
        if not rule["sufficient"]:
            lines.append(f"Tuning rule {rule['title']}: not sufficient. {_wrong(rule)}")
            continue
        pair = f"one pair, λ {rule['margin']:.3g} times the least"
        shares.append(f"{rule['title']} {_covers(rule) if rule['kind'] == 'region' else pair}")
    answer = (
        f"{len(shares)} of {len(rules)} public tuning rules are sufficient. Of the converging gains of the map they allow: "
        f"{'; '.join(shares)}."
    )
    return [answer, *lines]


def _covers(rule: JsonObject) -> str:
    covers = rule["covers"]
    shares = [100.0 * entry["share"] for entry in covers]
    if rule["scale_free"]:
        return f"{shares[0]:.0f} %"
    ends = f"{covers[0]['f_plus']:g} to {covers[-1]['f_plus']:g}"
    return f"{min(shares):.0f} to {max(shares):.0f} %, by units (f⁺ from {ends} rad/s²)"


def _wrong(rule: JsonObject) -> str:
    """A counterexample in a sentence."""
    wrong = rule["counterexample"]
    gains = f"It allows λ = {wrong['lambda']:.3g} √rad/s, α = {wrong['alpha']:.3g} rad/s² at f⁺ = {wrong['f_plus']:g} rad/s²"
    rho = wrong["peak_ratio_simulated"]
    if rho is None or not np.isfinite(rho):
        return f"{gains}: α is below f⁺, and under a constant disturbance f⁺ the error does not come back."
    return f"{gains}: simulated under the worst disturbance, each peak of the error is {rho:.3g} times the last."


def rule_table(rules: list[JsonObject]) -> ResultTable:
    """All rules, with what was read of each."""
    rows = []
    for rule in rules:
        is_region, wrong = rule["kind"] == "region", rule["counterexample"]
        rows.append([
            rule["title"],
            # lines break between conditions
            rule["states"].replace(" ", "\u00a0").replace(",\u00a0", ", "),
            rule["sufficient"],
            rule["margin"],
            _covers(rule) if is_region else None,
            rule["cells"]["counterexamples"] if is_region else None,
            None if wrong is None else _wrong(rule),
            rule["source"],
        ])  # fmt: skip
    columns = ["rule", "asks for", "sufficient", "least λ / exact", "covers", "wrong cells", "counterexample", "source"]
    return ResultTable("Public tuning rules, judged by the exact condition", columns, rows)
