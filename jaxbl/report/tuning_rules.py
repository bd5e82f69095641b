"""Public tuning rules beside the exact condition: figure, sentence and table of `jaxbl verify`."""

from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from jaxbl.gains.rules import RULES, Intervals, allows_gains
from jaxbl.gains.under_tuned import SINE_LIMIT
from jaxbl.json_types import JsonObject
from jaxbl.observer.conditions import least_lambda_exact
from jaxbl.sweeps.elementwise import apply_elementwise

from .figures import COLOURS, FAINT, MISSING, Drawn, decades, style, subplots
from .page import PageTable

_ALPHA, _LAMBDA = (0.3, 20.0), (0.15, 25.0)
"""Ends of the plane, alpha / f⁺ and lambda / √f⁺."""
_DASHES = ("-", "--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1, 1, 1)), (0, (8, 2)), (0, (3, 1)))
_RULE_COLOURS = (*COLOURS[:6], FAINT)
_MARKERS = ("D", "o", "s", "^")


@style()
def draw_rules(rules: list[JsonObject]) -> Drawn:
    """The plane of gains with the exact border and the borders of all rules (`rules` of a verdict) at f⁺ = 1 rad/s²."""
    figure, axes = subplots(10.4, 6.4, columns=2, beside=True, sharex=True, sharey=True)
    wrong = [rule for rule in rules if not rule["sufficient"]]
    for ax, shown, title in (
        (axes[0], [rule for rule in rules if rule["sufficient"]], "Sufficient: all gains that they allow converge"),
        (axes[1], wrong, "Not sufficient: where shaded, gains that they allow do not converge"),
    ):
        handles = _plane(ax)
        looks = zip(_RULE_COLOURS, _DASHES, strict=False)
        for rule, (colour, dashes) in zip([rule for rule in shown if rule["kind"] == "region"], looks, strict=False):
            handles.append(_region(ax, rule, colour, dashes))
        for rule, marker in zip([rule for rule in shown if rule["kind"] == "gains"], _MARKERS, strict=False):
            look: Any = {"ls": "", "marker": marker, "mfc": "white", "mec": "black", "mew": 1.2}
            ax.plot(rule["gains"]["alpha"], rule["gains"]["lambda"], zorder=6, ms=7, **look)
            handles.append(Line2D([], [], label=rule["title"], **look))
        ax.set_title(title)
        ax.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=2, handlelength=3.2)
    axes[0].set_ylabel("λ / √f⁺")
    caption = (
        "Rules for gains at f⁺ = 1 rad/s²: each allows what is above its line, or between its two lines; "
        "λ²/2α − λ⁴/16 < f⁺² allows what is below it. Grey: gains that do not converge under the worst disturbance. ×: "
        "gains that the rule allows, simulated; a rule that depends on units may fail only at another f⁺ (its × is in units "
        "of that). Dotted: below it a sine within f⁺ upholds a limit cycle, if there is no friction."
    )
    return Drawn("tuning_rules", figure, caption)


def _plane(ax: Axes) -> list[Any]:
    """Exact border, what does not converge, and where a sine upholds a cycle. Returns the legend's handles."""
    alpha = np.geomspace(1.0001, _ALPHA[1], 400)
    with jax.enable_x64(True):
        exact = apply_elementwise(least_lambda_exact, [alpha, np.ones_like(alpha)])
    ax.grid(False)
    ax.set(xscale="log", yscale="log", xlim=_ALPHA, ylim=_LAMBDA, xlabel="α / f⁺")
    decades(ax)
    for axis, ticks in ((ax.xaxis, (0.5, 1, 2, 5, 10, 20)), (ax.yaxis, (0.2, 0.5, 1, 2, 5, 10, 20))):
        axis.set_ticks(ticks)
    below = {"color": MISSING, "alpha": 0.55, "lw": 0}
    ax.axvspan(_ALPHA[0], 1.0, **below)
    ax.fill_between(np.r_[1.0, alpha], _LAMBDA[0], np.r_[exact[0], exact], **below)
    border: JsonObject = {"color": "black", "lw": 2.4, "label": "exact, ρ < 1"}
    ax.plot(np.r_[1.0, alpha], np.r_[_LAMBDA[1], exact], **border)
    sine: JsonObject = {"color": "black", "lw": 1.2, "ls": ":", "label": "a sine's limit cycle"}
    ax.plot(alpha, SINE_LIMIT / np.sqrt(alpha), **sine)
    return [Line2D([], [], **border), Line2D([], [], **sine), Patch(**below, label="does not converge")]


def _spans(name: str, alpha: np.ndarray) -> Intervals:
    spans = RULES[name].intervals
    assert spans is not None
    return spans(alpha, np.ones_like(alpha))


def _region(ax: Axes, one: JsonObject, colour: str, dashes: Any) -> Line2D:
    """Borders of a rule's region; where it is wrong it is shaded. Returns the legend's handle."""
    alpha = np.geomspace(*_ALPHA, 1201)
    look: JsonObject = {"color": colour, "ls": dashes, "lw": 2.0, "label": one["title"]}
    for low, high in _spans(one["name"], alpha):
        given = low < high
        ax.plot(alpha, np.where(given & (low > 0.0), low, np.nan), **look)
        ax.plot(alpha, np.where(given & np.isfinite(high), high, np.nan), **look)
    if (wrong := one["counterexample"]) is not None:
        lambda_ = np.geomspace(*_LAMBDA, 401)
        with jax.enable_x64(True):
            exact = apply_elementwise(least_lambda_exact, [alpha, np.ones_like(alpha)])
        fails = allows_gains(RULES[one["name"]], lambda_[:, None], alpha[None, :], 1.0) & (lambda_[:, None] <= exact)
        ax.contourf(alpha, lambda_, fails, levels=[0.5, 1.5], colors=[colour], alpha=0.25)
        place = wrong["alpha"] / wrong["f_plus"], wrong["lambda"] / np.sqrt(wrong["f_plus"])
        ax.plot(*place, "x", color=colour, ms=9, mew=2.5, zorder=7)
    return Line2D([], [], **look)


def rule_lines(rules: list[JsonObject]) -> list[str]:
    """What was found about the rules, in sentences."""
    good = [rule for rule in rules if rule["sufficient"]]
    shares = "; ".join(
        f"{rule['title']} {_covers(rule)}"
        if rule["kind"] == "region"
        else f"{rule['title']} one pair, λ {rule['margin']:.3g} times the least"
        for rule in good
    )
    lines = [
        f"{len(good)} of {len(rules)} public tuning rules are sufficient. Of the converging gains of the map they allow: "
        f"{shares}."
    ]
    return lines + [
        f"Tuning rule {rule['title']}: not sufficient. {_wrong(rule)}" for rule in rules if not rule["sufficient"]
    ]


def _covers(one: JsonObject) -> str:
    shares = [entry["share"] for entry in one["covers"]]
    if one["scale_free"]:
        return f"{100.0 * shares[0]:.0f} %"
    ends = one["covers"][0]["f_plus"], one["covers"][-1]["f_plus"]
    return f"{100.0 * min(shares):.0f} to {100.0 * max(shares):.0f} %, by units (f⁺ from {ends[0]:g} to {ends[1]:g} rad/s²)"


def _wrong(one: JsonObject) -> str:
    """A counterexample in a sentence."""
    found = one["counterexample"]
    gains = f"It allows λ = {found['lambda']:.3g} √rad/s, α = {found['alpha']:.3g} rad/s² at f⁺ = {found['f_plus']:g} rad/s²"
    rho = found["peak_ratio_simulated"]
    if rho is None or not np.isfinite(rho):
        return f"{gains}: α is below f⁺, and under a constant disturbance f⁺ the error does not come back."
    return f"{gains}: simulated under the worst disturbance, each peak of the error is {rho:.3g} times the last."


def rule_table(rules: list[JsonObject]) -> PageTable:
    """All rules, with what was read of each."""
    rows = [
        [
            rule["title"],
            # lines break between conditions
            rule["states"].replace(" ", "\u00a0").replace(",\u00a0", ", "),
            rule["sufficient"],
            rule["margin"],
            _covers(rule) if rule["kind"] == "region" else None,
            rule["cells"]["counterexamples"] if rule["kind"] == "region" else None,
            None if rule["counterexample"] is None else _wrong(rule),
            rule["source"],
        ]
        for rule in rules
    ]
    head = ["rule", "asks for", "sufficient", "least λ / exact", "covers", "wrong cells", "counterexample", "source"]
    return PageTable("Public tuning rules, judged by the exact condition", head, rows)
