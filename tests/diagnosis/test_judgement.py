"""What a diagnosis may say of the model that stands, by the proof."""

from types import SimpleNamespace

import numpy as np
import pytest
from passed import PASSED

from jaxbl.diagnosis.judgement import judge

NAME, OTHER = "motor.coulomb_friction", "motor.cogging"


def judge_model(names=(NAME,), theta=0.0, verdict="explained", share=1.0, contradicting=False, **proof):
    fitted = SimpleNamespace(names=names, theta=np.array([theta]), free=[SimpleNamespace(path="drive.motor_inertia")])
    chosen = SimpleNamespace(fitted=fitted, verdict=verdict, prior=np.array([0.02]))
    test = {"failed": [], "worse": False, "untested": {}, "has_power": True, "weak": []} | proof
    held_out = SimpleNamespace(**test)
    return judge(chosen, held_out, share, contradicting)  # type: ignore[arg-type]


def test_a_verdict_that_the_proof_supports_stays():
    judgement = judge_model()
    assert judgement.verdict == "explained"
    assert judgement.test == PASSED
    assert judge_model((), verdict="no_discrepancy", share=None).verdict == "no_discrepancy"


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"failed": ["torque_motor"]}, {"failed": ["torque_motor"]}),
        ({"theta": -0.11}, {"far": {"drive.motor_inertia": pytest.approx(-5.5)}}),
        ({"verdict": "unknown_effect"}, {"remainder": True}),
        ({"worse": True}, {"worse": True}),
        ({"share": 0.2}, {"little": True}),
        ({"contradicting": True}, {"contradicting": True}),
    ],
    ids=["errors", "numbers", "search", "before", "share", "logs"],
)
def test_one_reason_is_enough_against_it(changes, reason):
    judgement = judge_model(**changes)
    assert judgement.verdict == "unknown_effect"
    assert judgement.test == PASSED | reason


def test_what_the_proof_cannot_test_is_not_said_to_be_explained():
    untested = {NAME: {"torque": 1e-3, "on_log": 0.3}}
    # the share says nothing of what is not there
    judgement = judge_model(untested=untested, share=0.0)
    assert judgement.verdict == "not_tested" and not judgement.test["little"]
    assert judgement.test["untested"] == {NAME: {"torque": 1e-3, "on_log": 0.3}}
    assert judge_model((NAME, OTHER), untested=untested).verdict == "not_tested"
    # of the other effect the proof speaks
    assert judge_model((NAME, OTHER), untested=untested, share=0.2).verdict == "unknown_effect"
    # without power nothing is: neither an effect nor that none is missing
    assert judge_model(has_power=False).test["untested"] == {NAME: {}}
    assert judge_model((), verdict="no_discrepancy", share=None, has_power=False).verdict == "not_tested"
    # what contradicts the model does so whatever is not tested
    assert judge_model(untested=untested, failed=["theta_e"]).verdict == "unknown_effect"
