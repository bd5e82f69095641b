"""Public rules for the gains of super-twisting, and which of them the exact condition bears out.

A rule that gives a region does so as an interval of lambda for each alpha and f_plus. As the worst case shrinks with lambda,
it is sufficient exactly where the lower end of each interval is not below the least lambda of the exact condition, and where
no interval has an alpha up to f_plus.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.observer.conditions import CONDITIONS, Condition, least_lambda_exact, peak_ratio

from .worst_case import half_cycle

Spans = list[tuple[np.ndarray, np.ndarray]]
"""Intervals of lambda (rad^0.5/s), ends left out, for each alpha; empty where the first end is not below the second."""


@dataclasses.dataclass(frozen=True)
class Rule:
    """A public rule.

    Attributes:
        title: what figures and tables call it.
        states: the rule, in lambda, alpha and f⁺.
        source: where it is stated, and what of it was read.
        spans: lambda that it allows, of alpha and f_plus (rad/s^2); None for a rule that gives gains.
        gives: lambda (rad^0.5/s) and alpha (rad/s^2) that it gives, of f_plus; None for a rule that gives a region.
    """

    title: str
    states: str
    source: str
    spans: Callable[[np.ndarray, np.ndarray], Spans] | None = None
    gives: Callable[[float], tuple[float, float]] | None = None


def _where(holds: np.ndarray, low: np.ndarray, high: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    return np.where(holds, low, np.inf), np.where(holds, high, 0.0)


def _of_condition(condition: Condition) -> Callable[[np.ndarray, np.ndarray], Spans]:
    def spans(alpha: np.ndarray, f_plus: np.ndarray) -> Spans:
        with jax.enable_x64(True):
            least = np.asarray(condition.least_lambda(jnp.asarray(alpha), jnp.asarray(f_plus)))
        return [(least, np.full_like(least, np.inf))]

    return spans


def _oxictl(alpha: np.ndarray, f_plus: np.ndarray) -> Spans:
    above = alpha > f_plus
    return [_where(above, 2.0 * np.sqrt(f_plus), np.sqrt(2.0 * np.where(above, alpha - f_plus, 0.0)))]


def _ordered(alpha: np.ndarray, f_plus: np.ndarray) -> Spans:
    return [_where(alpha > 0.0, alpha, np.inf)]


def _ordered_and_root(alpha: np.ndarray, f_plus: np.ndarray) -> Spans:
    return [_where(alpha > 0.0, np.maximum(alpha, np.sqrt(2.0 * f_plus)), np.inf)]


def _ordered_and_above(alpha: np.ndarray, f_plus: np.ndarray) -> Spans:
    return [_where(alpha > f_plus, np.maximum(alpha, np.sqrt(8.0 * f_plus)), np.inf)]


def _quotient(alpha: np.ndarray, f_plus: np.ndarray) -> Spans:
    # lambda^2 - 2 alpha lambda + 2 alpha root < 0
    root = np.sqrt(2.0 * f_plus)
    square = alpha**2 - 2.0 * alpha * root
    half = np.sqrt(np.maximum(square, 0.0))
    return [_where(square > 0.0, alpha - half, alpha + half)]


def _above_twice_root(alpha: np.ndarray, f_plus: np.ndarray) -> Spans:
    return [_where(alpha > f_plus, 2.0 * np.sqrt(alpha), np.inf)]


def _transcribed(alpha: np.ndarray, f_plus: np.ndarray) -> Spans:
    # x / (2 alpha) - x^2 / 16 < f^2 with x = lambda^2 < 4 alpha: outside of the roots, or everywhere
    square = 16.0 / alpha**2 - 16.0 * f_plus**2
    half = np.sqrt(np.maximum(square, 0.0))
    low, high = (np.sqrt(np.maximum(4.0 / alpha + sign * half, 0.0)) for sign in (-1.0, 1.0))
    end = 2.0 * np.sqrt(alpha)
    parted = square > 0.0
    return [
        _where(alpha > 0.0, np.zeros_like(alpha), np.where(parted, np.minimum(low, end), end)),
        _where(parted, high, end),
    ]


_SMC_PSO = "github.com/theSadeQ/dip-smc-pso, "
_CAMP = (
    "github.com/Keeby-Astro/Constellation-Asteroid-Measurement-Project, "
    "docs/algorithm_equations/Quaternion_Reaction_Wheel_Algorithm.m, "
)

RULES = {
    "davila_fridman": Rule(
        "Davila et al. 2005",
        "λ > √(2 / (α − f⁺)) (α + f⁺), α > f⁺",
        "J. Davila, L. Fridman, A. Levant, IEEE Trans. Autom. Control 50 (2005), as (32) of Merzouki et al. (2007), q → 0",
        _of_condition(CONDITIONS["davila_fridman"]),
    ),
    "levant": Rule(
        "Levant 1998",
        "λ² > 4 f⁺ (α + f⁺) / (α − f⁺), α > f⁺",
        "A. Levant, Automatica 34 (1998)",
        _of_condition(CONDITIONS["levant"]),
    ),
    "seeber_horn": Rule(
        "Seeber-Horn 2017",
        "λ > √(α + f⁺), α > f⁺",
        "R. Seeber, M. Horn, Automatica 84 (2017)",
        _of_condition(CONDITIONS["seeber_horn"]),
    ),
    "moreno_osorio": Rule(
        "Moreno-Osorio 2012",
        "λ² > 4 (α − √(α² − f⁺²)), α > f⁺",
        "J. A. Moreno, M. Osorio, IEEE Trans. Autom. Control 57 (2012); their inequality solved for λ here",
        _of_condition(CONDITIONS["moreno_osorio"]),
    ),
    "usual_pair": Rule(
        "usual pair 1.5, 1.1",
        "λ = 1.5 √f⁺, α = 1.1 f⁺",
        "code read: github.com/Mojallizadeh/DifferentiationToolbox, E_STD.m; github.com/Wetmelon/damp, "
        "inc/damp/controllers/stsmc.hpp",
        gives=lambda f_plus: (1.5 * f_plus**0.5, 1.1 * f_plus),
    ),
    "small_pair": Rule(
        "pair 1, 1.1",
        "λ = √f⁺, α = 1.1 f⁺",
        "code read: github.com/radarsat1/FOAW, velocity.py, which names Levant (1998)",
        gives=lambda f_plus: (f_plus**0.5, 1.1 * f_plus),
    ),
    "oxictl": Rule(
        "oxictl",
        "λ > 2 √f⁺, α > f⁺ + λ²/2",
        "documentation read: docs.rs/crate/oxictl 0.1.1, src/state_feedback/super_twisting.rs",
        _oxictl,
    ),
    "root_of_alpha": Rule(
        "λ² > 4 α",
        "λ² > 4 α, α > f⁺",
        f"code read: {_CAMP}(60) and (94)",
        _above_twice_root,
    ),
    "transcribed": Rule(
        "λ²/2α − λ⁴/16 < f⁺²",
        "λ²/(2α) − λ⁴/16 < f⁺², λ² < 4 α",
        f"code read: {_CAMP}(61). The bounded real lemma has λ²α/2 − λ⁴/16 > f⁺² there",
        _transcribed,
    ),
    "ordered": Rule(
        "λ > α",
        "λ > α > 0",
        f"code read: {_SMC_PSO}src/controllers/smc/algorithms/super_twisting/twisting_algorithm.py",
        _ordered,
    ),
    "ordered_and_root": Rule(
        "λ > α, λ² > 2 f⁺",
        "λ > α > 0, λ² > 2 f⁺",
        f"documentation read: {_SMC_PSO}docs/technical/mathematical_foundations.md",
        _ordered_and_root,
    ),
    "ordered_and_above": Rule(
        "λ > α > f⁺, λ² > 8 f⁺",
        "λ > 2 √(2 f⁺), α > f⁺, λ > α",
        f"documentation read: {_SMC_PSO}docs/theory/lyapunov_stability_proofs.md, with input gain 1. It names the bound "
        "that of the disturbance; here it is read as that of its derivative, f⁺",
        _ordered_and_above,
    ),
    "quotient": Rule(
        "α > λ²/2(λ − √2f⁺)",
        "λ > √(2 f⁺), α > λ² / (2 (λ − √(2 f⁺)))",
        f"documentation read: {_SMC_PSO}docs/examples/mathematical_notation_standards.md",
        _quotient,
    ),
}
"""Rules by the names that `verdict.json` uses. A controller's gains are for a disturbance whose derivative is within f⁺: the
same error system."""

_BOUNDS = (0.01, 0.1, 1.0, 10.0, 100.0)
"""f_plus in rad/s^2 at which rules are tried: a rule may depend on units."""
_TRIED = np.concatenate([np.geomspace(1e-3, 0.999, 1000), np.geomspace(1.0001, 1e3, 3001)])
"""alpha / f_plus that are tried."""


@jax.jit
def _exact(ratio: Any) -> Any:
    return least_lambda_exact(ratio, jnp.ones_like(ratio))


@jax.jit
def _ratios(lambda_: Any, alpha: Any) -> tuple[Any, Any]:
    one = jnp.ones_like(alpha)
    return peak_ratio(lambda_, alpha, one), half_cycle(lambda_, alpha, one).ratio


def holds(rule: Rule, lambda_: np.ndarray, alpha: np.ndarray, f_plus: float) -> np.ndarray:
    """Whether a rule's region has some gains (arrays that broadcast; rad^0.5/s, rad/s^2)."""
    assert rule.spans is not None
    spans = rule.spans(np.asarray(alpha, float), np.asarray(f_plus, float))
    return np.logical_or.reduce([(lambda_ > low) & (lambda_ < high) for low, high in spans])


def least(rule: Rule, alpha: np.ndarray, f_plus: float) -> tuple[np.ndarray, np.ndarray]:
    """Ends (rad^0.5/s) of the lowest interval of a rule's region for each alpha (rad/s^2); `inf` and 0 without one."""
    assert rule.spans is not None
    low, high = np.full_like(alpha, np.inf), np.zeros_like(alpha)
    for begin, end in rule.spans(alpha, np.asarray(f_plus)):
        lower = (begin < end) & (begin < low)
        low, high = np.where(lower, begin, low), np.where(lower, end, high)
    return low, high


class _Found(NamedTuple):
    """A rule at one f_plus: the least lambda that it allows over the exact one (`inf` where none with alpha above f_plus),
    whether it allows alpha below f_plus, and gains (alpha / f_plus, lambda / sqrt(f_plus)) that do not converge."""

    margin: float
    below: bool
    wrong: tuple[float, float] | None


def _find(rule: Rule, exact: np.ndarray, f_plus: float) -> _Found:
    """Seek gains that a rule allows and the worst case does not; of those, such as have alpha above f_plus go first."""
    low, high = (end / np.sqrt(f_plus) for end in least(rule, f_plus * _TRIED, f_plus))
    above = _TRIED > 1.0
    margins = np.where(above, low / np.where(above, exact, 1.0), np.inf)
    below = np.flatnonzero(~above & np.isfinite(low))
    margin, wrong = float(margins.min()), None
    if margin < 1.0:
        # clearly wrong, as near to alpha = 2 f_plus as may be, midway between what the rule asks for and the worst case
        at = int(np.argmin(np.where(margins <= np.sqrt(margin), np.abs(np.log(_TRIED / 2.0)), np.inf)))
        end = float(min(high[at], exact[at]))
        wrong = float(_TRIED[at]), float(np.sqrt(low[at] * end)) if low[at] > 0.0 else 0.5 * end
    elif len(below):
        at = int(below[np.argmin(np.abs(np.log(2.0 * _TRIED[below])))])
        wrong = float(_TRIED[at]), float(np.sqrt(low[at] * min(high[at], 2.0 * low[at])))
    return _Found(margin, len(below) > 0, wrong)


def _covered(rule: Rule, alpha: np.ndarray, exact: np.ndarray, window: tuple[float, float], f_plus: float) -> float:
    """Share of the converging gains that a rule's region has, by area of the logarithmic map of alpha / f_plus and lambda /
    sqrt(f_plus), whose ends `window` are."""
    assert rule.spans is not None
    low, high = window
    exact = np.clip(exact, low, high)
    spans = [
        (begin / np.sqrt(f_plus), end / np.sqrt(f_plus)) for begin, end in rule.spans(alpha * f_plus, np.asarray(f_plus))
    ]
    lengths = [np.log(np.clip(end, exact, high) / np.clip(begin, exact, high)) for begin, end in spans]
    area = np.sum([np.maximum(length, 0.0) for length in lengths], axis=0)
    logarithm = np.log(alpha)
    return float(np.trapezoid(area, logarithm) / np.trapezoid(np.log(high / exact), logarithm))


def judge_rules(alpha: np.ndarray, lambda_: np.ndarray, ratio: np.ndarray) -> list[dict[str, Any]]:
    """Judge every rule (`rules` of `verdict.json`).

    Args:
        alpha: alpha / f_plus of the map of the error system, shape (alphas,).
        lambda_: lambda / sqrt(f_plus), shape (lambdas,).
        ratio: simulated ratio of peaks under the worst disturbance, shape (lambdas, alphas).

    Returns:
        For each rule whether it is `sufficient`; if not, a `counterexample` with its peak ratio in closed form and simulated
        (`inf`: the error does not come back); its least `margin` (lambda over the exact one, None where alpha is never above
        f_plus); whether it allows alpha below f_plus, and whether it is the same in all units. Of a region also the share of
        the converging gains of the map that it `covers`, by f_plus, and counts of cells at f_plus = 1 rad/s^2.
    """
    given = {name: rule.gives(1.0) for name, rule in RULES.items() if rule.gives is not None}
    columns = np.concatenate([_TRIED, alpha, [at for _, at in given.values()]])
    with jax.enable_x64(True):
        exact = np.asarray(_exact(jnp.asarray(columns)))
    tried, mapped, exact_given = np.split(exact, [len(_TRIED), len(_TRIED) + len(alpha)])
    found = {
        name: {bound: _find(rule, tried, bound) for bound in _BOUNDS}
        for name, rule in RULES.items()
        if rule.spans is not None
    }
    # gains to be simulated, as f_plus, lambda / sqrt(f_plus) and alpha / f_plus: those given, and the counterexamples
    points = {name: (1.0, *gains) for name, gains in given.items()}
    for name, by_bound in found.items():
        # the one at 1 rad/s^2 is easiest to read
        for bound in sorted(_BOUNDS, key=lambda bound: abs(np.log(bound)), reverse=True):
            if (wrong := by_bound[bound].wrong) is not None:
                points[name] = (bound, wrong[1], wrong[0])
    bounds, lambdas, alphas = (np.array(column) for column in zip(*points.values(), strict=True))
    with jax.enable_x64(True):
        ratios = [np.asarray(one) for one in _ratios(jnp.asarray(lambdas), jnp.asarray(alphas))]
    table = zip(bounds, bounds * alphas, np.sqrt(bounds) * lambdas, *ratios, strict=True)
    keys = ("f_plus", "alpha", "lambda", "peak_ratio", "peak_ratio_simulated")
    simulated = {name: dict(zip(keys, map(float, row), strict=True)) for name, row in zip(points, table, strict=True)}
    margins = dict(zip(given, np.array([one for one, _ in given.values()]) / exact_given, strict=True))
    window = float(lambda_[0]), float(lambda_[-1])
    judged = []
    for name, rule in RULES.items():
        entry = {"name": name, "title": rule.title, "states": rule.states, "source": rule.source}
        if rule.spans is None:
            gains = simulated[name]
            good = gains["peak_ratio_simulated"] < 1.0
            entry |= {"kind": "gains", "sufficient": good, "margin": float(margins[name]), "gains": gains}
            judged.append(entry | {"counterexample": None if good else gains})
            continue
        covers = [_covered(rule, alpha, mapped, window, bound) for bound in _BOUNDS]
        allowed = holds(rule, lambda_[:, None], alpha[None, :], 1.0)
        least_margin = min(one.margin for one in found[name].values())
        judged.append(
            entry
            | {
                "kind": "region",
                "sufficient": name not in simulated,
                "margin": least_margin if np.isfinite(least_margin) else None,
                "alpha_below_f_plus": any(one.below for one in found[name].values()),
                "scale_free": bool(np.allclose(covers, covers[0], rtol=1e-9)),
                "covers": [{"f_plus": bound, "share": share} for bound, share in zip(_BOUNDS, covers, strict=True)],
                "cells": {"holds": int(allowed.sum()), "counterexamples": int((allowed & (ratio >= 1.0)).sum())},
                "counterexample": simulated.get(name),
            }
        )
    return judged
