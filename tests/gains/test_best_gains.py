"""The best gains: nearly the least error, and as far as possible from where they fail."""

import itertools

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, strategies as st

from jaxbl.gains.best_gains import AS_GOOD, find_best_gains

ALPHA, LAMBDA = np.geomspace(0.5, 128.0, 17), np.geomspace(0.25, 64.0, 17)
"""α / f⁺ and λ / √f⁺."""
GRID = pd.DataFrame(itertools.product(LAMBDA, ALPHA), columns=["lambda", "alpha"])
EVERYWHERE = np.ones(len(GRID), bool)


def find(error, works=EVERYWHERE, **options):
    options = {"allowed": works, "scatter": np.zeros(len(GRID)), "alpha_ratio": GRID["alpha"].to_numpy()} | options
    return find_best_gains(GRID, np.asarray(error, float), works, **options)


def test_equal_errors_are_not_told_apart_by_rounding():
    """Where gains do not matter, the best lie in the middle of those tried, and never at a corner."""
    rounding = np.random.default_rng(0).uniform(1.0, 1.0 + 1e-12, len(GRID))
    best = find(0.243 * rounding)
    row = GRID.iloc[best.index]
    # alpha as far from f⁺ as from the end
    assert row["alpha"] == pytest.approx(np.sqrt(128.0), rel=0.25) and 1.0 < row["lambda"] < 16.0
    assert best.margin == pytest.approx(best.margins["f_plus"]) or best.margin == pytest.approx(best.margins["failure"])
    assert best.nearly_as_good == (GRID["alpha"] > 1.0).sum() and best.ends == {}


def test_alpha_below_the_disturbance_is_never_the_best():
    best = find(GRID["alpha"])
    assert GRID["alpha"][best.index] > 1.0
    assert best.least_error == ALPHA[ALPHA > 1.0].min()


def test_the_border_of_failure_is_kept_away_from():
    works = (GRID["lambda"] > 4.0).to_numpy()
    best = find(np.where(works, 1.0, np.nan), works)
    assert best.margins["failure"] == pytest.approx(np.sqrt(64.0 / 4.0), rel=0.2)


def test_twice_the_error_is_kept_away_from():
    """Noise: beyond alpha = 16 the error is larger than twice the least one."""
    best = find(np.where(GRID["alpha"] > 17.0, 2.1, 1.0))
    assert best.margins["error"] == pytest.approx(np.sqrt(16.0 * np.sqrt(2.0)), rel=0.3)
    assert best.margins["error"] < best.margins["failure"]


def test_differences_between_seeds_do_not_count():
    # less error towards f⁺
    error = 1.0 + 0.05 * np.log(GRID["alpha"])
    sharp, blurred = find(error), find(error, scatter=np.full(len(GRID), 0.2))
    assert blurred.margin > sharp.margin


def test_an_end_of_the_range_is_told():
    assert find(1.0 / GRID["alpha"]).ends == {"alpha": "larger"}
    assert find(GRID["lambda"]).ends == {"lambda": "smaller"}


def test_without_gains_that_work_there_are_no_best():
    assert find(np.ones(len(GRID)), ~EVERYWHERE) is None
    assert find(np.full(len(GRID), np.nan)) is None


@given(st.integers(0, 2**32 - 1))
def test_no_gains_that_are_as_good_have_a_larger_margin(seed):
    """Against the definition, gains by gains."""
    random = np.random.default_rng(seed)
    error, works = random.uniform(1.0, 3.0, len(GRID)), random.uniform(size=len(GRID)) < 0.9
    error[: len(GRID) // 2] = random.uniform(1.0, 1.03, len(GRID) // 2)
    best = find(error, works)
    works &= (GRID["alpha"] > 1.0).to_numpy()
    place = np.log(GRID.to_numpy())

    def distance(index, others):
        return np.exp(np.abs(place[others] - place[index]).max(axis=1).min(initial=np.inf))

    def margin(index):
        lambda_, alpha = GRID.iloc[index]
        ends = min(128.0 / alpha, 64.0 / lambda_, lambda_ / 0.25)
        failing, doubled = distance(index, ~works), distance(index, works & (error >= 2.0 * best.least_error))
        return min(alpha, failing, doubled, ends)

    as_good = np.flatnonzero(works & (error <= (1.0 + AS_GOOD) * error[works].min()))
    assert best.index in as_good
    assert best.margin == pytest.approx(margin(best.index)) == pytest.approx(max(map(margin, as_good)))
