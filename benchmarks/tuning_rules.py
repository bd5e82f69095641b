"""Public rules for the gains of super-twisting, compared with the exact condition: `python benchmarks/tuning_rules.py`.

It prints the table of benchmarks/NOTES.md, and draws docs/figures/tuning_rules.png (`--figure FILE`).

A rule for a region allows intervals of lambda for each alpha and f_plus. The worst case shrinks as lambda grows. A rule is
therefore sufficient if and only if every lambda that it allows is above the exact bound, and every alpha above f_plus.
"""

import argparse
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.gains.error_system import normalised_peak_ratios
from jaxbl.gains.under_tuned import SINE_LIMIT
from jaxbl.json_types import JsonObject
from jaxbl.observer.conditions import CONDITIONS, least_lambda_exact, peak_ratio
from jaxbl.report.drawing import save
from jaxbl.report.gain_plane import least_lambdas
from jaxbl.report.panels import COLOURS, FAINT, MISSING, Axis, Band, Figure, Line, Panel, Part, Span, mark
from jaxbl.sweeps.elementwise import call_in_float64

Intervals = list[tuple[np.ndarray, np.ndarray]]
"""Intervals of lambda (rad^0.5/s), ends left out, for each alpha; empty where the first end is not below the second."""


@dataclasses.dataclass(frozen=True)
class Rule:
    """A public rule.

    Attributes:
        title: its name in figures and tables.
        statement: the rule, in lambda, alpha and f⁺.
        source: where it is stated, and what was read there (code or documentation).
        intervals: function of alpha and f_plus (rad/s^2) that returns the allowed lambda; None for a rule for gains.
        gains: function of f_plus that returns lambda (rad^0.5/s) and alpha (rad/s^2); None for a rule for a region.
    """

    title: str
    statement: str
    source: str
    intervals: Callable[[np.ndarray, np.ndarray], Intervals] | None = None
    gains: Callable[[float], tuple[float, float]] | None = None


def _interval_where(holds: np.ndarray, low: np.ndarray, high: np.ndarray | float = np.inf) -> tuple[np.ndarray, np.ndarray]:
    return np.where(holds, low, np.inf), np.where(holds, high, 0.0)


def _intervals_of_condition(name: str) -> Callable[[np.ndarray, np.ndarray], Intervals]:
    def intervals(alpha: np.ndarray, f_plus: np.ndarray) -> Intervals:
        least = call_in_float64(CONDITIONS[name].least_lambda, alpha, f_plus)
        return [(least, np.full_like(least, np.inf))]

    return intervals


def _intervals_oxictl(alpha: np.ndarray, f_plus: np.ndarray) -> Intervals:
    above = alpha > f_plus
    return [_interval_where(above, 2.0 * np.sqrt(f_plus), np.sqrt(2.0 * np.where(above, alpha - f_plus, 0.0)))]


def _intervals_quotient(alpha: np.ndarray, f_plus: np.ndarray) -> Intervals:
    # lambda^2 - 2 alpha lambda + 2 alpha root < 0
    root = np.sqrt(2.0 * f_plus)
    square = alpha**2 - 2.0 * alpha * root
    half = np.sqrt(np.maximum(square, 0.0))
    return [_interval_where(square > 0.0, alpha - half, alpha + half)]


def _intervals_transcribed(alpha: np.ndarray, f_plus: np.ndarray) -> Intervals:
    # x / (2 alpha) - x^2 / 16 < f^2 with x = lambda^2 < 4 alpha: outside of the roots, or everywhere
    square = 16.0 / alpha**2 - 16.0 * f_plus**2
    half = np.sqrt(np.maximum(square, 0.0))
    low, high = (np.sqrt(np.maximum(4.0 / alpha + sign * half, 0.0)) for sign in (-1.0, 1.0))
    end = 2.0 * np.sqrt(alpha)
    is_parted = square > 0.0
    return [
        _interval_where(alpha > 0.0, np.zeros_like(alpha), np.where(is_parted, np.minimum(low, end), end)),
        _interval_where(is_parted, high, end),
    ]


_SMC_PSO = "github.com/theSadeQ/dip-smc-pso"
_CAMP = (
    "github.com/Keeby-Astro/Constellation-Asteroid-Measurement-Project/docs/algorithm_equations/"
    "Quaternion_Reaction_Wheel_Algorithm.m, "
)

RULES = {
    "davila_fridman": Rule(
        "Davila et al. 2005",
        "λ > √(2 / (α − f⁺)) (α + f⁺), α > f⁺",
        "J. Davila, L. Fridman, A. Levant, IEEE Trans. Autom. Control 50 (2005), as (32) of Merzouki et al. (2007), q → 0",
        _intervals_of_condition("davila_fridman"),
    ),
    "levant": Rule(
        "Levant 1998",
        "λ² > 4 f⁺ (α + f⁺) / (α − f⁺), α > f⁺",
        "A. Levant, Automatica 34 (1998)",
        _intervals_of_condition("levant"),
    ),
    "seeber_horn": Rule(
        "Seeber-Horn 2017",
        "λ > √(α + f⁺), α > f⁺",
        "R. Seeber, M. Horn, Automatica 84 (2017)",
        _intervals_of_condition("seeber_horn"),
    ),
    "moreno_osorio": Rule(
        "Moreno-Osorio 2012",
        "λ² > 4 (α − √(α² − f⁺²)), α > f⁺",
        "J. A. Moreno, M. Osorio, IEEE Trans. Autom. Control 57 (2012); their inequality solved for λ here",
        _intervals_of_condition("moreno_osorio"),
    ),
    "usual_pair": Rule(
        "usual pair 1.5, 1.1",
        "λ = 1.5 √f⁺, α = 1.1 f⁺",
        "code read: github.com/Mojallizadeh/DifferentiationToolbox, E_STD.m; github.com/Wetmelon/damp, "
        "inc/damp/controllers/stsmc.hpp",
        gains=lambda f_plus: (1.5 * f_plus**0.5, 1.1 * f_plus),
    ),
    "small_pair": Rule(
        "pair 1, 1.1",
        "λ = √f⁺, α = 1.1 f⁺",
        "code read: github.com/radarsat1/FOAW, velocity.py, which names Levant (1998)",
        gains=lambda f_plus: (f_plus**0.5, 1.1 * f_plus),
    ),
    "oxictl": Rule(
        "oxictl",
        "λ > 2 √f⁺, α > f⁺ + λ²/2",
        "documentation read: docs.rs/crate/oxictl 0.1.1, src/state_feedback/super_twisting.rs",
        _intervals_oxictl,
    ),
    "root_of_alpha": Rule(
        "λ² > 4 α",
        "λ² > 4 α, α > f⁺",
        f"code read: {_CAMP}(60) and (94)",
        lambda alpha, f_plus: [_interval_where(alpha > f_plus, 2.0 * np.sqrt(alpha))],
    ),
    "transcribed": Rule(
        "λ²/2α − λ⁴/16 < f⁺²",
        "λ²/(2α) − λ⁴/16 < f⁺², λ² < 4 α",
        f"code read: {_CAMP}(61). The bounded real lemma has λ²α/2 − λ⁴/16 > f⁺² there",
        _intervals_transcribed,
    ),
    "ordered": Rule(
        "λ > α",
        "λ > α > 0",
        f"code read: {_SMC_PSO}/src/controllers/smc/algorithms/super_twisting/twisting_algorithm.py",
        lambda alpha, f_plus: [_interval_where(alpha > 0.0, alpha)],
    ),
    "ordered_and_root": Rule(
        "λ > α, λ² > 2 f⁺",
        "λ > α > 0, λ² > 2 f⁺",
        f"documentation read: {_SMC_PSO}/docs/technical/mathematical_foundations.md",
        lambda alpha, f_plus: [_interval_where(alpha > 0.0, np.maximum(alpha, np.sqrt(2.0 * f_plus)))],
    ),
    "ordered_and_above": Rule(
        "λ > α > f⁺, λ² > 8 f⁺",
        "λ > 2 √(2 f⁺), α > f⁺, λ > α",
        f"documentation read: {_SMC_PSO}/docs/theory/lyapunov_stability_proofs.md, with input gain 1. It names the bound "
        "that of the disturbance; here it is read as that of its derivative, f⁺",
        lambda alpha, f_plus: [_interval_where(alpha > f_plus, np.maximum(alpha, np.sqrt(8.0 * f_plus)))],
    ),
    "quotient": Rule(
        "α > λ²/2(λ − √2f⁺)",
        "λ > √(2 f⁺), α > λ² / (2 (λ − √(2 f⁺)))",
        f"documentation read: {_SMC_PSO}/docs/examples/mathematical_notation_standards.md",
        _intervals_quotient,
    ),
}
"""Rules by name. Gains of a controller are for a disturbance whose derivative is within f⁺,
which is the same error system."""

_F_PLUS_TRIALS = (0.01, 0.1, 1.0, 10.0, 100.0)
"""f_plus (rad/s^2) at which rules are checked: a rule may depend on units."""
_ALPHA_RATIOS = np.concatenate([np.geomspace(1e-3, 0.999, 1000), np.geomspace(1.0001, 1e3, 3001)])
"""alpha / f_plus at which rules are checked."""


@jax.jit
def _least_lambda_ratio(ratio: Any) -> Any:
    return least_lambda_exact(ratio, jnp.ones_like(ratio))


def allows_gains(rule: Rule, lambda_: np.ndarray, alpha: np.ndarray, f_plus: float) -> np.ndarray:
    """Return a bool array: True if a rule's region contains the gains.

    Args:
        rule: a rule for a region.
        lambda_: rad^0.5/s. It is broadcast with `alpha`.
        alpha: rad/s^2.
        f_plus: rad/s^2.
    """
    assert rule.intervals is not None
    intervals = rule.intervals(np.asarray(alpha, float), np.asarray(f_plus, float))
    return np.logical_or.reduce([(lambda_ > low) & (lambda_ < high) for low, high in intervals])


def lowest_interval(rule: Rule, alpha: np.ndarray, f_plus: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends (rad^0.5/s) of a rule's lowest interval for each alpha (rad/s^2); `inf` and 0 if there is none."""
    assert rule.intervals is not None
    low, high = np.full_like(alpha, np.inf), np.zeros_like(alpha)
    for begin, end in rule.intervals(alpha, np.asarray(f_plus)):
        lower = (begin < end) & (begin < low)
        low, high = np.where(lower, begin, low), np.where(lower, end, high)
    return low, high


class _RuleCheck(NamedTuple):
    """A rule compared with the exact condition at one f_plus.

    Attributes:
        margin: least lambda that it allows, over the exact one; `inf` if it allows no alpha above f_plus.
        allows_small_alpha: True if it allows an alpha below f_plus.
        counterexample: allowed gains that do not converge: alpha / f_plus, lambda / sqrt(f_plus).
    """

    margin: float
    allows_small_alpha: bool
    counterexample: tuple[float, float] | None


def _check_rule(rule: Rule, exact: np.ndarray, f_plus: float) -> _RuleCheck:
    """Seek gains that a rule allows although the worst case grows, first with alpha above f_plus."""
    low, high = (upper / np.sqrt(f_plus) for upper in lowest_interval(rule, f_plus * _ALPHA_RATIOS, f_plus))
    is_above = _ALPHA_RATIOS > 1.0
    margins = np.where(is_above, low / np.where(is_above, exact, 1.0), np.inf)
    small_alphas = np.flatnonzero(~is_above & np.isfinite(low))
    margin, counterexample = float(margins.min()), None
    if margin < 1.0:
        # well below the exact lambda, with alpha as close to 2 f_plus as possible
        index = int(np.argmin(np.where(margins <= np.sqrt(margin), np.abs(np.log(_ALPHA_RATIOS / 2.0)), np.inf)))
        upper = float(min(high[index], exact[index]))
        lambda_ratio = float(np.sqrt(low[index] * upper)) if low[index] > 0.0 else 0.5 * upper
        counterexample = float(_ALPHA_RATIOS[index]), lambda_ratio
    elif len(small_alphas):
        index = int(small_alphas[np.argmin(np.abs(np.log(2.0 * _ALPHA_RATIOS[small_alphas])))])
        counterexample = float(_ALPHA_RATIOS[index]), float(np.sqrt(low[index] * min(high[index], 2.0 * low[index])))
    return _RuleCheck(margin, len(small_alphas) > 0, counterexample)


def _share_covered(rule: Rule, alpha: np.ndarray, exact: np.ndarray, window: tuple[float, float], f_plus: float) -> float:
    """Return the share of the converging gains that a rule's region contains.

    It is a ratio of areas on the logarithmic map of alpha / f_plus and lambda / sqrt(f_plus); `window` holds the ends of the
    latter.
    """
    assert rule.intervals is not None
    low, high = window
    exact = np.clip(exact, low, high)
    area = np.zeros_like(exact)
    for interval in rule.intervals(alpha * f_plus, np.asarray(f_plus)):
        begin, end = (np.clip(limit / np.sqrt(f_plus), exact, high) for limit in interval)
        area = area + np.maximum(np.log(end / begin), 0.0)
    logarithm = np.log(alpha)
    return float(np.trapezoid(area, logarithm) / np.trapezoid(np.log(high / exact), logarithm))


def judge_rules(alpha: np.ndarray, lambda_: np.ndarray, ratio: np.ndarray) -> list[JsonObject]:
    """Judge every rule.

    Args:
        alpha: alpha / f_plus of the map of the error system, shape (alphas,).
        lambda_: lambda / sqrt(f_plus), shape (lambdas,).
        ratio: simulated ratio of peaks under the worst disturbance, shape (lambdas, alphas).

    Returns:
        A dictionary for each rule:

        - `sufficient`; if it is not, a `counterexample` with its peak ratio in closed form and simulated (`inf`: the error
          does not come back);
        - `margin`: least lambda over the exact one; None if alpha is never above f_plus.

        For a region also `alpha_below_f_plus` (whether it is allowed), `scale_free` (whether the rule is the same in all
        units), the share of the converging gains that it `covers` by f_plus, and counts of `cells` at f_plus = 1 rad/s^2.
    """
    rule_gains = {name: rule.gains(1.0) for name, rule in RULES.items() if rule.gains is not None}
    columns = np.concatenate([_ALPHA_RATIOS, alpha, [rule_alpha for _, rule_alpha in rule_gains.values()]])
    exact = call_in_float64(_least_lambda_ratio, columns)
    exact_trials, exact_map, exact_rules = np.split(exact, [len(_ALPHA_RATIOS), len(_ALPHA_RATIOS) + len(alpha)])
    checks = {
        name: {f_plus: _check_rule(rule, exact_trials, f_plus) for f_plus in _F_PLUS_TRIALS}
        for name, rule in RULES.items()
        if rule.intervals is not None
    }
    # the rules' gains and the counterexamples are simulated: f_plus, lambda / sqrt(f_plus), alpha / f_plus
    points = {name: (1.0, *gains) for name, gains in rule_gains.items()}
    for name, check_by_bound in checks.items():
        # a counterexample at 1 rad/s^2 is easiest to read: it comes last, and replaces others
        for f_plus in sorted(_F_PLUS_TRIALS, key=lambda f_plus: abs(np.log(f_plus)), reverse=True):
            gains = check_by_bound[f_plus].counterexample
            if gains is not None:
                points[name] = (f_plus, gains[1], gains[0])
    bounds, lambdas, alphas = (np.array(column) for column in zip(*points.values(), strict=True))
    ratios = call_in_float64(normalised_peak_ratios, lambdas, alphas)
    table = zip(bounds, bounds * alphas, np.sqrt(bounds) * lambdas, *reversed(ratios), strict=True)
    keys = ("f_plus", "alpha", "lambda", "peak_ratio", "peak_ratio_simulated")
    simulated = {name: dict(zip(keys, map(float, row), strict=True)) for name, row in zip(points, table, strict=True)}
    rule_lambdas = np.array([rule_lambda for rule_lambda, _ in rule_gains.values()])
    margins = dict(zip(rule_gains, rule_lambdas / exact_rules, strict=True))
    window = float(lambda_[0]), float(lambda_[-1])
    judged = []
    for name, rule in RULES.items():
        entry = {"name": name, "title": rule.title, "states": rule.statement, "source": rule.source}
        if rule.intervals is None:
            gains = simulated[name]
            is_sufficient = gains["peak_ratio_simulated"] < 1.0
            entry |= {"kind": "gains", "sufficient": is_sufficient, "margin": float(margins[name]), "gains": gains}
            judged.append(entry | {"counterexample": None if is_sufficient else gains})
            continue
        covers = [_share_covered(rule, alpha, exact_map, window, f_plus) for f_plus in _F_PLUS_TRIALS]
        allowed = allows_gains(rule, lambda_[:, None], alpha[None, :], 1.0)
        least_margin = min(check.margin for check in checks[name].values())
        judged.append(
            entry
            | {
                "kind": "region",
                "sufficient": name not in simulated,
                "margin": least_margin if np.isfinite(least_margin) else None,
                "alpha_below_f_plus": any(check.allows_small_alpha for check in checks[name].values()),
                "scale_free": bool(np.allclose(covers, covers[0], rtol=1e-9)),
                "covers": [{"f_plus": f_plus, "share": share} for f_plus, share in zip(_F_PLUS_TRIALS, covers, strict=True)],
                "cells": {"holds": int(allowed.sum()), "counterexamples": int((allowed & (ratio >= 1.0)).sum())},
                "counterexample": simulated.get(name),
            }
        )
    return judged


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--figure", type=Path, metavar="FILE", help="draw the borders of all rules there, as PNG")
    asked = parser.parse_args()
    alpha, lambda_ = np.geomspace(1.02, 20.0, 256), np.geomspace(0.02, 25.0, 256)
    judged = judge_rules(alpha, lambda_, np.asarray(peak_ratio(lambda_[:, None], alpha[None, :], np.ones((256, 256)))))
    print("| rule | sufficient | least λ / exact | covers | counterexample | source |\n|---|---|---:|---|---|---|")
    for rule in judged:
        wrong = rule["counterexample"]
        margin = None if rule["margin"] is None else f"{rule['margin']:.4g}"
        cells = [rule["states"], "yes" if rule["sufficient"] else "no", margin]
        cells += [_covers(rule) if rule["kind"] == "region" else "one pair", wrong and _wrong(rule), rule["source"]]
        print(f"| {' | '.join('–' if cell is None else cell for cell in cells)} |")
    if asked.figure is not None:
        print(save(draw_rules(judged), asked.figure))


if __name__ == "__main__":
    with jax.enable_x64(True):
        main()
