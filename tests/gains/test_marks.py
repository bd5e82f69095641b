"""Marked gains that miss the exact condition: what the run's own disturbance does to them."""

import numpy as np
import pytest
from small_study import rigid_study

from jaxbl.config import read_config
from jaxbl.gains.own_disturbance import judge_marks
from jaxbl.gains.stages import Stages
from jaxbl.sweeps.trial import run

MARKS = [
    {"name": "good", "lambda": 6.0, "alpha": 9.0},
    {"name": "small", "lambda": 0.02, "alpha": 2.3},
    {"name": "below", "lambda": 3.0, "alpha": 1.9},
]
# friction that the observer does not know: 2 rad/s^2 where it slips, less where it sticks
STUDY = read_config(
    rigid_study(
        {"observer.motor.velocity_error": 0.05, "encoders.noise": 0.0, "run.duration": 6.0, "run.sample_period": 1e-3},
        effects=[{"kind": "motor.coulomb_friction", "torque": 0.1}],
        verify={"marks": MARKS},
    )
)


@pytest.fixture(autouse=True, scope="module")
def _few_digits():
    """Predictions are compared to some per cent: simulations need no nine digits."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxbl.gains.under_tuned._TOLERANCE", 1e-6)
        yield


@pytest.fixture(scope="module")
def judged_marks(_few_digits):
    return {mark["name"]: mark for mark in judge_marks(STUDY, Stages(STUDY, "verify"))}


def test_gains_that_hold_the_exact_condition_need_no_explanation(judged_marks):
    assert judged_marks["good"]["peak_ratio"] < 1.0
    assert judged_marks["good"]["on_this_disturbance"] is None


def test_alpha_below_the_disturbance(judged_marks):
    trace = run(STUDY).trace
    missing = np.abs(trace["motor.acceleration"] - (trace["u"] - 0.15 * trace["motor.velocity"]) / 0.05)
    explanation = judged_marks["below"]["on_this_disturbance"]
    assert explanation["largest_disturbance"] == pytest.approx(missing.max())
    assert explanation["share_above_alpha"] == pytest.approx((missing > 1.9).mean())
    assert 0.05 < explanation["share_above_alpha"] < 0.5
    assert explanation["excursion_predicted"] == pytest.approx(explanation["excursion_simulated"], rel=1e-4)
    # friction takes some of what a pulse makes; two pulses are the largest of it
    assert 0.0 < explanation["excursion_predicted"] < ((missing - 1.9).clip(lower=0.0) * 1e-3).sum()
    # lambda alone is too large for the cycle of a sine
    assert explanation["sine_cycle"] == {"least_predicted": np.inf, "least_simulated": None}


def test_alpha_above_the_disturbance_but_too_small_a_lambda(judged_marks):
    mark = judged_marks["small"]
    explanation = mark["on_this_disturbance"]
    assert mark["peak_ratio"] > 3.0 and mark["converged"]
    assert explanation["share_above_alpha"] == 0.0
    # jumps of dry friction are no slow disturbance; a tenth is what they cost here
    assert explanation["largest_predicted"] == pytest.approx(explanation["largest_simulated"], rel=0.1)
    assert explanation["tenth_predicted"] == pytest.approx(explanation["tenth_simulated"], rel=0.05)
    cycle = explanation["sine_cycle"]
    assert cycle["frequency"] == 2.0 * cycle["least_predicted"]
    assert 0.6 * cycle["least_predicted"] < cycle["least_simulated"] < cycle["least_predicted"]
    for name in ("stable", "threshold"):
        assert cycle["predicted"][name] == pytest.approx(cycle["simulated"][name], rel=0.15)


def explain_position_error(position_error):
    """The explanation of the small gains from a position error."""
    data = STUDY.to_dict() | {"verify": {"marks": MARKS[1:2]}}
    data["observer"]["motor"] |= {"position_error": position_error, "velocity_error": 0.0}
    study = read_config(data)
    (mark,) = judge_marks(study, Stages(study, "verify"))
    return mark["on_this_disturbance"]


def test_a_start_beside_its_place_counts_by_its_energy():
    explanation = explain_position_error(-0.0003)
    assert explanation["largest_predicted"] == pytest.approx(np.sqrt(2.0 * 2.3 * 0.0003), rel=0.05)
    assert explanation["tenth_predicted"] == pytest.approx(explanation["tenth_simulated"], rel=0.1)


def test_a_larger_start_ends_in_a_limit_cycle():
    """Friction of this size under 2 Hz is no slow disturbance: only the simulation shows that."""
    explanation = explain_position_error(-0.01)
    assert explanation["sine_cycle"]["least_simulated"] < 2.0
    assert explanation["largest_predicted"] > 0.2
    assert explanation["tenth_simulated"] == np.inf


def test_without_alpha_there_is_nothing_to_explain():
    study = read_config(STUDY.to_dict() | {"verify": {"marks": [{"name": "none", "lambda": 1.0, "alpha": 0.0}]}})
    (mark,) = judge_marks(study, Stages(study, "verify"))
    assert mark["on_this_disturbance"] is None
