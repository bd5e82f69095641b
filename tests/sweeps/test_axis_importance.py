"""Shares of variance of random designs, beside closed forms."""

import numpy as np
import pytest
from small_study import ALPHA, LAMBDA, NOISE, listed_axis, make_result, rigid_study, spaced_axis

from jaxbl.config import read_config
from jaxbl.errors import InputError
from jaxbl.sweeps.axis_importance import rank_axes
from jaxbl.sweeps.points import Points

ERROR = "motor.velocity_rmse"
AXES = [spaced_axis(ALPHA, 1.0, 10.0), spaced_axis(LAMBDA, 2.0, 3.0, scale="linear"), spaced_axis(NOISE, 1e-5, 1e-4)]


def error_of(log_error):
    """The error as a function of all axes in units of their ranges."""

    def make_error(frame):
        return 10.0 ** log_error(np.log10(frame[ALPHA]), frame[LAMBDA] - 2.0, np.log10(frame.get(NOISE, 1e-5)) + 5.0)

    return make_error


def rank(log_error, axes=AXES, **sweep):
    result = make_result(rigid_study(axes=axes, sweep=sweep), motor__velocity_rmse=error_of(log_error))
    return {axis.path: axis for axis in rank_axes(result, ERROR)}


@pytest.mark.parametrize("design", ["sobol", "latin_hypercube"])
def test_shares_of_a_sum_are_those_of_its_terms(design):
    ranked = rank(lambda a, b, c: 3.0 * a + b, design=design, points=1024)
    assert list(ranked)[:2] == [ALPHA, LAMBDA]
    for path, share in ((ALPHA, 0.9), (LAMBDA, 0.1), (NOISE, 0.0)):
        found, half_width = ranked[path].alone
        assert found == pytest.approx(share, abs=1.5 * half_width + 0.01)
        assert half_width < 0.1
        assert ranked[path].total is None


def test_total_shares_of_a_product_hold_what_axes_do_together():
    # variance of a b over the unit square: 7/144; of its mean over b: 3/144
    ranked = rank(lambda a, b, c: a * b, design="saltelli", points=5 * 1024)
    for path in (ALPHA, LAMBDA):
        assert ranked[path].alone[0] == pytest.approx(3.0 / 7.0, abs=0.03)
        assert ranked[path].total[0] == pytest.approx(4.0 / 7.0, abs=0.03)
    assert ranked[NOISE].total[0] == pytest.approx(0.0, abs=0.01)


def test_runs_without_a_finite_error_are_the_worst_and_listed_axes_are_averaged():
    def log_error(a, b, c):
        return np.where(a > 0.5, np.inf, 0.0)

    axes = [AXES[0], listed_axis(NOISE, 1e-5, 1e-4), AXES[1]]
    assert rank(log_error, axes, design="sobol", points=256) == {}, "all finite errors are alike"
    ranked = rank(lambda a, b, c: np.where(a > 0.5, np.inf, a), axes, design="sobol", points=512)
    assert list(ranked) == [ALPHA, LAMBDA]
    assert ranked[ALPHA].alone[0] > 0.8 > 0.1 > ranked[LAMBDA].alone[0]


@pytest.mark.parametrize(
    ("sweep", "axes"),
    [
        ({"design": "sobol", "points": 64}, AXES),
        ({}, [spaced_axis(ALPHA, 1.0, 10.0, 12), spaced_axis(LAMBDA, 1.0, 10.0, 12)]),
    ],
    ids=["few points", "grid"],
)
def test_no_shares_of_few_points_or_a_grid(sweep, axes):
    assert rank(lambda a, b, c: a + b, axes, **sweep) == {}


def test_a_saltelli_design_has_a_number_of_points_of_its_own():
    with pytest.raises(InputError, match=r"1000 make no Saltelli design of 3 axes.*1280 do"):
        Points(read_config(rigid_study(axes=AXES, sweep={"design": "saltelli", "points": 1000})))
    assert len(Points(read_config(rigid_study(axes=AXES, sweep={"design": "saltelli", "points": 1280})))) == 1280
