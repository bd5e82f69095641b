"""Public tuning rules: their regions against what they state, counterexamples against SciPy, coverage against a count."""

import jax
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from tuning_rules import RULES, allows_gains, draw_rules, judge_rules

from jaxbl.observer.conditions import least_lambda_exact, peak_ratio

EXACT = jax.jit(least_lambda_exact)
ALPHA, LAMBDA = np.geomspace(1.02, 20.0, 96), np.geomspace(0.02, 25.0, 96)

# as each source has it, in its own letters
REGIONS = {
    "davila_fridman": lambda k1, k2, f: k2 > f and k1 > np.sqrt(2.0 / (k2 - f)) * (k2 + f),
    "levant": lambda k1, k2, f: k2 > f and k1**2 > 4.0 * f * (k2 + f) / (k2 - f),
    "seeber_horn": lambda k1, k2, f: k2 > f and k1 > np.sqrt(k2 + f),
    # |2 / (s^2 + k1 s + 2 k2)| f < 1 on the imaginary axis
    "moreno_osorio": lambda k1, k2, f: (
        k1 > 0.0 and np.abs(2.0 / (2.0 * k2 - ROOT_RATES**2 + 1j * k1 * ROOT_RATES)).max() * f < 1.0
    ),
    "oxictl": lambda k1, k2, w: k1 > 2.0 * np.sqrt(w) and k2 > w + k1**2 / 2.0,
    "root_of_alpha": lambda k1, k2, delta: k2 > delta and k1**2 > 4.0 * k2,
    "transcribed": lambda k1, k2, delta: k1**2 / (2.0 * k2) - k1**4 / 16.0 < delta**2 and 4.0 * k2 > k1**2,
    "ordered": lambda k1, k2, f: k1 > k2 > 0.0,
    "ordered_and_root": lambda k1, k2, a: k1 > k2 > 0.0 and k1**2 > 2.0 * a,
    "ordered_and_above": lambda k1, k2, d: k1 > 2.0 * np.sqrt(2.0 * d) and k2 > d and k1 > k2,
    "quotient": lambda a, b, big: a > np.sqrt(2.0 * big) and b > a**2 / (2.0 * (a - np.sqrt(2.0 * big))),
}
ROOT_RATES = np.geomspace(1e-4, 1e4, 20_001)
SCALE_FREE = {"davila_fridman", "levant", "seeber_horn", "moreno_osorio", "oxictl", "root_of_alpha"}
SUFFICIENT = SCALE_FREE | {"ordered_and_above", "usual_pair", "small_pair"}


@pytest.fixture(scope="module")
def judged_rules():
    """Judgements of all rules on a map, by name."""
    lambda_, alpha = np.meshgrid(LAMBDA, ALPHA, indexing="ij")
    ratio = np.asarray(peak_ratio(lambda_, alpha, np.ones_like(alpha)))
    return {judgement["name"]: judgement for judgement in judge_rules(ALPHA, LAMBDA, ratio)}


def test_all_rules_are_judged(judged_rules):
    assert list(judged_rules) == list(RULES)
    assert {name for name, judgement in judged_rules.items() if judgement["kind"] == "region"} == set(REGIONS)
    assert all(judgement["source"] and judgement["states"] for judgement in judged_rules.values())


@pytest.mark.parametrize("name", REGIONS)
def test_region_is_the_one_that_is_stated(name):
    draw = np.random.default_rng(5)
    f_plus = 10.0 ** draw.uniform(-1.5, 1.5, 300)
    # half of them in the units of f_plus, half as numbers
    unit = np.where(np.arange(300) % 2, f_plus, 1.0)
    alpha, lambda_ = unit * 10.0 ** draw.uniform(-1.0, 1.5, 300), np.sqrt(unit) * 10.0 ** draw.uniform(-1.0, 1.5, 300)
    actual = [
        bool(allows_gains(RULES[name], *np.array([[trial_lambda], [trial_alpha]]), f)[0])
        for trial_lambda, trial_alpha, f in zip(lambda_, alpha, f_plus, strict=True)
    ]
    expected = [bool(REGIONS[name](*numbers)) for numbers in zip(lambda_, alpha, f_plus, strict=True)]
    assert 5 < sum(expected) < 295
    assert actual == expected


def test_which_are_sufficient_and_which_depend_on_units(judged_rules):
    assert {name for name, judgement in judged_rules.items() if judgement["sufficient"]} == SUFFICIENT
    assert {name for name, judgement in judged_rules.items() if judgement.get("scale_free")} == SCALE_FREE
    for name, judgement in judged_rules.items():
        assert (judgement["counterexample"] is None) == (name in SUFFICIENT)
        assert judgement.get("alpha_below_f_plus", False) == (name not in SUFFICIENT)
        if name in SUFFICIENT:
            assert judgement["margin"] > 1.0
            assert judgement.get("cells", {}).get("counterexamples", 0) == 0


@pytest.mark.parametrize("name", sorted(SUFFICIENT & set(REGIONS)))
def test_no_gains_of_a_sufficient_rule_fail(name):
    draw = np.random.default_rng(6)
    f_plus = 10.0 ** draw.uniform(-2.0, 2.0, 30)
    for bound in f_plus:
        alpha = bound * (1.0 + 10.0 ** draw.uniform(-3.0, 2.5, 300))
        # from the exact border on: most of what a rule could have wrong
        lambda_ = np.asarray(EXACT(alpha, np.full(300, bound))) * 10.0 ** draw.uniform(-0.3, 1.0, 300)
        allowed = allows_gains(RULES[name], lambda_, alpha, bound)
        ratios = np.asarray(peak_ratio(lambda_, alpha, np.full(300, bound)))
        assert (ratios[allowed] < 1.0).all()
        assert (ratios >= 1.0).any()
        small_alpha = bound * 10.0 ** draw.uniform(-2.0, 0.0, 300)
        assert not allows_gains(RULES[name], lambda_, small_alpha, bound).any()


@pytest.mark.parametrize("name", sorted(set(RULES) - SUFFICIENT))
def test_counterexamples_in_the_observers_own_states(name, judged_rules):
    """An adversary who sees the error: its largest push outward, then homeward."""
    counterexample = judged_rules[name]["counterexample"]
    f_plus, alpha, lambda_ = (counterexample[key] for key in ("f_plus", "alpha", "lambda"))
    assert REGIONS[name](lambda_, alpha, f_plus)

    def derivatives(t, s):
        rate = s[1] - lambda_ * np.sqrt(abs(s[0])) * np.sign(s[0])
        return [rate, f_plus * np.sign(rate) - alpha * np.sign(s[0])]

    def crosses_zero(t, s):
        return s[0]

    crosses_zero.terminal, crosses_zero.direction = True, -1
    unit = np.sqrt(f_plus)
    solution = solve_ivp(
        derivatives,
        (0.0, 40.0 / unit),
        [0.0, unit],
        events=crosses_zero,
        rtol=1e-8,
        atol=1e-10 * f_plus,
        max_step=0.01 / unit,
    )
    if alpha < f_plus:
        assert counterexample["peak_ratio_simulated"] == np.inf
        assert solution.status == 0
        assert solution.y[1, -1] > 1.5 * unit
        return
    assert solution.status == 1
    ratio = -solution.y[1, -1] / unit
    assert ratio > 1.0
    assert ratio == pytest.approx(counterexample["peak_ratio_simulated"], rel=2e-3)
    assert counterexample["peak_ratio"] == pytest.approx(counterexample["peak_ratio_simulated"], rel=1e-5)


@pytest.mark.parametrize("name", REGIONS)
def test_coverage_is_the_share_of_cells(name, judged_rules):
    """The share is counted again by points drawn evenly over the logarithmic map."""
    draw = np.random.default_rng(7)
    alpha = ALPHA[0] * (ALPHA[-1] / ALPHA[0]) ** draw.random(20_000)
    lambda_ = LAMBDA[0] * (LAMBDA[-1] / LAMBDA[0]) ** draw.random(20_000)
    converges = np.asarray(peak_ratio(lambda_, alpha, np.ones_like(alpha))) < 1.0
    for entry in judged_rules[name]["covers"]:
        bound = entry["f_plus"]
        allowed = allows_gains(RULES[name], np.sqrt(bound) * lambda_, bound * alpha, bound)
        assert entry["share"] == pytest.approx((allowed & converges).sum() / converges.sum(), abs=0.02)
    cells = judged_rules[name]["cells"]
    grid = allows_gains(RULES[name], LAMBDA[:, None], ALPHA[None, :], 1.0)
    fails = np.asarray(peak_ratio(*np.broadcast_arrays(LAMBDA[:, None], ALPHA[None, :]), np.ones((96, 96)))) >= 1.0
    assert (cells["holds"], cells["counterexamples"]) == (grid.sum(), (grid & fails).sum())


def test_margins(judged_rules):
    """Least lambda over the exact one, where it is known: 1.146 at alpha = f⁺ (docs/theory.md), 0.900 at large alpha."""
    assert judged_rules["seeber_horn"]["margin"] == pytest.approx(np.sqrt(2.0) / 1.146, rel=2e-3)
    assert judged_rules["moreno_osorio"]["margin"] == pytest.approx(0.5 * np.pi, rel=1e-3)
    for name, gain in (("usual_pair", 1.5), ("small_pair", 1.0)):
        assert judged_rules[name]["margin"] == pytest.approx(gain / 0.99122, rel=1e-4)
    gains = judged_rules["small_pair"]["gains"]
    assert (gains["lambda"], gains["alpha"], gains["f_plus"]) == (1.0, 1.1, 1.0)
    assert 0.98 < gains["peak_ratio_simulated"] < 1.0


def test_the_figure_has_every_rule_on_its_side(judged_rules):
    panels = draw_rules(list(judged_rules.values())).panels
    names = [{getattr(part, "name", "") for part in panel.parts} for panel in panels]
    for rule in judged_rules.values():
        assert (rule["title"] in names[0]) == rule["sufficient"]
        assert (rule["title"] in names[1]) != rule["sufficient"]
