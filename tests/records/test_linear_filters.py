"""Filters beside those of SciPy."""

import numpy as np
import pytest
from scipy import signal

from jaxbl.records.linear_filters import filter_forwards, savitzky_golay_slopes

RANDOM = np.random.default_rng(0)
WALK = np.cumsum(RANDOM.standard_normal((3001, 2)), axis=0)


def test_one_way_begins_as_if_the_first_value_had_lasted():
    expected, _ = signal.lfilter([0.1], [1.0, -0.9], WALK, axis=0, zi=0.9 * WALK[:1])
    assert filter_forwards(WALK, [0.1], [-0.9]) == pytest.approx(expected, rel=1e-12, abs=1e-12)
    assert filter_forwards(np.full(7, 3.0), [0.1], [-0.9]) == pytest.approx(3.0, abs=0.0)


@pytest.mark.parametrize("half", [2, 20, 201])
def test_slopes_are_those_of_scipy_away_from_the_ends(half):
    values = 1e4 + np.cumsum(np.random.default_rng(0).standard_normal(3001))
    inside = slice(half, -half)
    expected = signal.savgol_filter(values, 2 * half + 1, 3, deriv=1)[inside]
    np.testing.assert_allclose(savitzky_golay_slopes(values, half)[inside], expected, atol=1e-10)
