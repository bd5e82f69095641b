"""Public tuning rules beside the exact condition: figure, sentence and table of `jaxbl verify`."""

import numpy as np

from jaxbl.gains.rules import RULES
from jaxbl.gains.under_tuned import SINE_LIMIT
from jaxbl.json_types import JsonObject
from jaxbl.observer.conditions import CONDITIONS
from jaxbl.result import ResultTable

from .gain_plane import least_lambdas
from .panels import COLOURS, FAINT, MISSING, Axis, Band, Figure, Line, Panel, Part, Span, mark

_ALPHA, _LAMBDA = (0.3, 20.0), (0.15, 25.0)
"""Ends of the plane, alpha / f⁺ and lambda / √f⁺."""
_LOOKS = tuple(zip((*COLOURS[:6], FAINT), ("-", "--", "-.", ":", "--", "-", "-."), strict=True))
_MARKERS = ("D", "o", "s", "^")


def draw_rules(rules: list[JsonObject]) -> Figure:
    """The plane of gains with the exact border and the borders of all rules (`rules` of a verdict) at f⁺ = 1 rad/s²."""
    x, y = Axis("α / f⁺", log=True, ends=_ALPHA), Axis("λ / √f⁺", log=True, ends=_LAMBDA)
    titles = {True: "Sufficient: all gains allowed converge", False: "Not sufficient: where shaded, gains allowed fail"}
    panels = []
    for sufficient, title in titles.items():
        alpha = np.geomspace(1.0001, _ALPHA[1], 400)
        exact = least_lambdas(CONDITIONS["exact"], alpha, 1.0)
        parts: list[Part] = [
            Span(_ALPHA[0], 1.0, "does not converge", MISSING, opacity=0.55),
            Band(alpha, np.full(400, _LAMBDA[0]), exact, "does not converge", MISSING, 0.55),
        ]
        looks, markers = iter(_LOOKS), iter(_MARKERS)
        for rule in sorted(rules, key=lambda rule: rule["kind"] == "gains"):
            if rule["sufficient"] != sufficient:
                continue
            if rule["kind"] == "region":
                parts += _draw_region(rule, *next(looks))
            else:
                gains = rule["gains"]
                parts.append(mark(gains["alpha"], gains["lambda"], rule["title"], next(markers), 7.0))
        parts += [
            Line([1.0, *alpha], [_LAMBDA[1], *exact], "exact, ρ < 1", width=2.4),
            Line(alpha, SINE_LIMIT / np.sqrt(alpha), "a sine's limit cycle", width=1.2, dashes=":"),
        ]
        panels.append(Panel(x, y, parts, title))
    caption = (
        "Rules for gains at f⁺ = 1 rad/s²: each allows what is above its line, or between its two lines; "
        "λ²/2α − λ⁴/16 < f⁺² allows what is below it. Grey: gains that do not converge under the worst disturbance. ×: "
        "gains that the rule allows, simulated; a rule that depends on units may fail only at another f⁺ (its × is in units "
        "of that). Dotted: below it a sine within f⁺ upholds a limit cycle, if there is no friction."
    )
    return Figure("tuning_rules", panels, caption, 2, 10.4, 5.4)


def _draw_region(judged: JsonObject, colour: str, dashes: str) -> list[Part]:
    """Borders of a rule's region; where it is wrong it is shaded."""
    alpha, rule = np.geomspace(*_ALPHA, 1201), RULES[judged["name"]]
    assert rule.intervals is not None
    parts: list[Part] = []
    wrong, failing = judged["counterexample"], least_lambdas(CONDITIONS["exact"], alpha, 1.0)
    for low, high in rule.intervals(alpha, np.ones_like(alpha)):
        for border, is_border in ((low, low > 0.0), (high, np.isfinite(high))):
            parts.append(
                Line(alpha, np.where((low < high) & is_border, border, np.nan), judged["title"], colour, 2.0, dashes)
            )
        if wrong is not None:
            # what a rule allows although it fails
            bottom, top = (np.clip(border, *_LAMBDA) for border in (low, np.minimum(high, failing)))
            parts.append(Band(alpha, bottom, np.where(bottom < top, top, np.nan), "", colour))
    if wrong is not None:
        x, y = wrong["alpha"] / wrong["f_plus"], wrong["lambda"] / np.sqrt(wrong["f_plus"])
        parts.append(Line([x], [y], colour=colour, width=0.0, marker="x", size=9.0))
    return parts


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
