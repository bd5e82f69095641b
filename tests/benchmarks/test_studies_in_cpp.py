"""C++ gives the same figures of the package's studies."""

import numpy as np
import pytest
from studies_in_cpp import _NAN_SHARE, STUDIES, check_medians, check_run_metrics, compare_study

from jaxbl.errors import NoResult
from jaxbl.throughput.rivals.cpp_chain import find_compiler


@pytest.mark.skipif(find_compiler() is None, reason="no C++ compiler")
@pytest.mark.parametrize("name", STUDIES)
def test_the_same_figures_in_cpp(name, tmp_path_factory):
    # beyond 5 s, where the identifiers begin
    row = compare_study(name, tmp_path_factory.getbasetemp(), 2, 6000, 1, lanes=64)
    assert row["deviation"] < 1e-5
    assert row["lanes"] == 64
    assert min(row["jaxbl"], row["c++"]) > 0.0


def test_other_figures_are_not_timed():
    true = {"motor.velocity_rmse": np.array([1.0, 2.0, np.nan])}
    assert check_run_metrics("study", true, true) == 0.0
    for wrong, fault in (([1.001, 2.002, np.nan], "off by 0.001"), ([np.nan, np.nan, np.nan], "NaN in only one")):
        with pytest.raises(NoResult, match=rf"study: motor.velocity_rmse is {fault}"):
            check_run_metrics("study", {"motor.velocity_rmse": np.array(wrong)}, true)
    check_medians("study", {"motor.velocity_rmse": np.array([1.01, 2.01, 7.0])[:2]}, true)
    with pytest.raises(NoResult, match=r"motor.velocity_rmse has a median of 3, not 1.5"):
        check_medians("study", {"motor.velocity_rmse": np.array([3.0, 3.0, np.nan])}, true)


def test_runs_at_the_border_of_convergence_may_flip():
    def check(ours, reference):
        name = "motor.convergence_time"
        return check_run_metrics("study", {name: np.array(ours)}, {name: np.array(reference)})

    times, runs = np.linspace(1.0, 2.0, 4000), round(4000 * _NAN_SHARE)
    flipped = times.copy()
    flipped[:runs] = np.nan
    # neither side alone, nor both together beyond the bound
    assert check(flipped, times) == check(times, flipped) == 0.0
    flipped[runs] = np.nan
    for ours, reference in ((flipped, times), (times, flipped)):
        with pytest.raises(
            NoResult, match=r"motor.convergence_time is NaN in only one implementation in 0.0013 of the runs"
        ):
            check(ours, reference)
    assert check(flipped, flipped) == 0.0
    # the other runs are compared as before
    within = times.copy()
    within[:runs] = np.nan
    with pytest.raises(NoResult, match=r"off by 0.01 of it"):
        check(1.01 * times, within)
    assert check(np.full(3, np.nan), np.full(3, np.nan)) == 0.0
