"""What limits gains towards each side: on searches whose errors are formulas."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from jaxbl.config import TuneTable
from jaxbl.gains.gain_search import GainSearch
from jaxbl.gains.limits import find_limits

RANGE = (1.0, 100.0)
NUM = 9


def build_search(
    error, *, chatter=lambda x, a: 0.0 * x, time=lambda x, a: 0.0 * x, exact=lambda x, a: 10.0 + 0.0 * x, **table
):
    """A search for lambda and alpha from 1 to 100, f_plus = 1, with one zoom; errors, their chatter, convergence times and
    margins to the exact condition are functions of both gains."""
    limits = GainSearch.__new__(GainSearch)
    limits.table = TuneTable.model_validate({"num": NUM, "margin_alpha": 1.001} | table)
    limits.sides, limits.f_plus, limits.limits = ("motor",), {"motor": 1.0}, {"lambda": RANGE, "alpha": RANGE}
    limits.scenarios = SimpleNamespace()
    limits.windows, limits.candidates = [{"motor": limits.limits}], {}
    for stage in range(2):
        if stage:
            limits.windows.append({"motor": limits._zoom_in("motor")})
        values = {gain: np.geomspace(*limits.windows[-1]["motor"][gain], NUM) for gain in ("lambda", "alpha")}
        x, a = (axis.ravel() for axis in np.meshgrid(*values.values()))
        frame = pd.DataFrame({
            "lambda": x, "alpha": a, "converged": True, "velocity_rmse": error(x, a), "chatter": chatter(x, a),
            "convergence_time": time(x, a), "margin_alpha": 1.02 * a, "margin_exact": exact(x, a), "stage": stage,
        })  # fmt: skip
        frame["converged"] = np.isfinite(frame["velocity_rmse"])
        limits.candidates["motor"] = pd.concat(
            [*limits.candidates.values(), limits._mark_feasible("motor", frame)], ignore_index=True
        )
    return limits


def bowl_error(x, a):
    """Least at 10 and 10."""
    return np.cosh(np.log(x / 10.0)) + np.cosh(np.log(a / 10.0))


def test_of_an_optimum_inside_it_is_said_which_parts_of_the_error_balance():
    # mean squares: alpha / 10 of chatter, 10 / alpha of what is slow
    search = build_search(
        lambda x, a: np.sqrt(a / 10.0 + 10.0 / a + np.log(x / 10.0) ** 2), chatter=lambda x, a: np.sqrt(a / 10.0)
    )
    limits = find_limits(search, "motor")
    assert (limits["binding"], limits["range_ends"]) == ([], [])
    ways = limits["towards"]["alpha"]
    assert [ways[way]["by"] for way in ("smaller", "larger")] == ["slow", "chatter"]
    assert [limits["towards"]["lambda"][way]["by"] for way in ("smaller", "larger")] == ["slow", "slow"]
    larger_gain = ways["larger"]["at"]
    # a cell of the coarse map away
    assert larger_gain == pytest.approx(10.0 * 100.0 ** (1.0 / (NUM - 1)))
    assert ways["larger"]["change"] == pytest.approx(np.sqrt((larger_gain / 10.0 + 10.0 / larger_gain) / 2.0) - 1.0)


def test_the_parts_of_another_error_are_not_known():
    search = build_search(bowl_error, chatter=lambda x, a: 0.5 * bowl_error(x, a))
    search.table = search.table.model_copy(update={"objective": "torque"})
    ways = find_limits(search, "motor")["towards"]["alpha"]
    assert [(way["limit"], way["by"]) for way in ways.values()] == [("error", None)] * 2


CONSTRAINTS = {
    # exact margin 1.1 at lambda = 20
    "margin_exact": ({"exact": lambda x, a: 1.1 * x / 20.0}, ("lambda", "smaller")),
    # 1 s at alpha = 20
    "longest_convergence": ({"time": lambda x, a: 20.0 / a, "longest_convergence": 1.0}, ("alpha", "smaller")),
    "margin_alpha": ({"margin_alpha": 20.0}, ("alpha", "smaller")),
}


@pytest.mark.parametrize("name", CONSTRAINTS)
def test_a_constraint_that_forbids_less_error_binds(name):
    constraint, (gain, way) = CONSTRAINTS[name]
    limits = find_limits(build_search(bowl_error, **constraint), "motor")
    assert limits["binding"] == [name]
    assert [key for key, entry in limits["constraints"].items() if entry["binds"]] == [name]
    towards = limits["towards"][gain][way]
    assert (towards["limit"], towards["missed"]) == ("constraint", [name])
    assert towards["change"] < -0.01
    # the limit is within a step of the zoom
    step = 100.0 ** (2.0 / (NUM - 1) ** 2)
    assert 1.0 <= limits["constraints"][name]["room"] <= step * 1.001
    other_limits = [entry["limit"] for ways in limits["towards"].values() for entry in ways.values() if entry is not towards]
    assert other_limits == ["error"] * 3


def test_a_constraint_whose_gains_are_no_better_does_not_bind():
    limits = find_limits(build_search(bowl_error, exact=lambda x, a: 1.1 * x / 9.0), "motor")
    assert limits["binding"] == []
    smaller = limits["towards"]["lambda"]["smaller"]
    # both are said
    assert (smaller["limit"], smaller["missed"]) == ("error", ["margin_exact"])


def test_a_time_of_zero_has_room_without_end():
    limits = find_limits(build_search(bowl_error, longest_convergence=1.0), "motor")
    assert limits["constraints"]["longest_convergence"] == {"value": 0.0, "limit": 1.0, "room": None, "binds": False}


def test_ends_of_the_range_and_runs_that_diverge():
    limits = find_limits(build_search(lambda x, a: np.where(x > 1.2, np.nan, 1.0 + np.log(a))), "motor")
    assert limits["towards"]["lambda"]["smaller"]["limit"] == "range"
    assert limits["towards"]["alpha"]["smaller"]["limit"] == "range"
    assert limits["range_ends"] == ["smaller lambda", "smaller alpha"]
    larger = limits["towards"]["lambda"]["larger"]
    assert (larger["limit"], larger["change"], larger["missed"]) == ("error", None, ["converged"])


def test_a_margin_at_the_end_of_the_range_binds_without_runs_beyond_it():
    limits = find_limits(build_search(lambda x, a: 1.0 + np.log(a) + np.log(x / 10.0) ** 2, margin_alpha=1.02), "motor")
    assert limits["binding"] == ["margin_alpha"]
    assert limits["range_ends"] == []
    assert limits["towards"]["alpha"]["smaller"]["at"] is None


def test_between_two_rows_of_the_coarse_map_errors_are_interpolated():
    search = build_search(lambda x, a: np.sqrt(np.log(x / 13.0) ** 2 + np.log(a / 10.0) ** 2 + 1.0))
    line = pd.DataFrame(find_limits(search, "motor")["profiles"]["alpha"])
    best = search.least_candidate("motor")["lambda"]
    exact = np.sqrt(np.log(best / 13.0) ** 2 + np.log(line["alpha"] / 10.0) ** 2 + 1.0)
    assert best not in search.candidates["motor"].query("stage == 0")["lambda"].to_numpy()
    # a chord of a parabola lies above it by a quarter of its squared width at most
    assert np.all(line["error"] >= exact - 1e-9)
    assert np.all(line["error"] ** 2 - exact**2 <= np.log(100.0 ** (1.0 / (NUM - 1))) ** 2 / 4.0 * 1.001)
