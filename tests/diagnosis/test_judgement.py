"""What a diagnosis may say of what the search found."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxbl.diagnosis.effect_search import Explanation, Finding
from jaxbl.diagnosis.expected_errors import Expected
from jaxbl.diagnosis.judgement import explained_share, judged
from jaxbl.diagnosis.proof import Control

NAME = "motor.coulomb_friction"
LIMITS = {"theta_e": Expected(1e-4, 0.0, 0.0, 1.2e-4), "torque_motor": Expected(0.01, 0.0, 0.0, 0.012)}
NOISE = {"theta_e": 1e-4, "torque_motor": 0.01}


def found(verdict="explained"):
    nothing = SimpleNamespace()
    finding = Finding(NAME, 0.98, {"torque": 0.1}, (("motor.viscous_friction", 0.02),))
    return Explanation(verdict, (finding,), nothing, nothing, None, {})  # type: ignore[arg-type]


def judge(errors=NOISE, theta=0.0, controls=(), verdict="explained"):
    fitted = SimpleNamespace(
        names=(NAME,), theta=np.array([theta, 1.0]), free=[SimpleNamespace(path="drive.motor_inertia")] * 2
    )
    return judged(found(verdict), fitted, errors, LIMITS, controls, np.array([0.02]))  # type: ignore[arg-type]


def test_a_verdict_that_held_out_data_support_stays():
    controls = [Control("wrong", NOISE, 9.0, "motor.viscous_friction"), Control("permuted", NOISE, 4.0)]
    said = judge(controls=controls)
    assert said.found == found() and (said.failed, said.far, said.chance, said.remainder) == ([], {}, False, False)


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({"errors": NOISE | {"torque_motor": 0.0121}}, {"failed": ["torque_motor"]}),
        ({"theta": -0.11}, {"far": {"drive.motor_inertia": pytest.approx(-5.5)}}),
        ({"controls": [Control("permuted", NOISE, 1.9)]}, {"chance": True}),
        ({"verdict": "unknown_effect"}, {"remainder": True}),
    ],
    ids=["errors", "numbers", "shuffled", "search"],
)
def test_one_reason_is_enough_against_it(given, reason):
    said = judge(**given)
    assert said.found.verdict == "unknown_effect" and said.found.findings == found().findings
    none = {"failed": [], "far": {}, "chance": False, "remainder": False}
    assert {key: getattr(said, key) for key in none} == none | reason


def test_a_name_is_shared_with_an_effect_that_does_as_well():
    (one,) = judge(controls=[Control("wrong", NOISE, 0.0, "motor.viscous_friction")]).found.findings
    assert one.confidence == pytest.approx(0.5)
    assert one.alternatives == (("motor.viscous_friction", pytest.approx(0.5)),)
    (one,) = judge(controls=[Control("wrong", NOISE, -3.0, "motor.inertia")]).found.findings
    assert one.confidence < 0.01 and one.alternatives[0] == ("motor.inertia", pytest.approx(0.98, abs=0.01))
    # dry friction is a Stribeck friction with equal levels
    assert judge(controls=[Control("wrong", NOISE, 0.0, "motor.stribeck_friction")]).found == found()


def test_the_explained_share_is_that_of_the_torques_power_beyond_what_a_complete_model_leaves():
    experiment = SimpleNamespace(sides=["motor", "load"], drive=SimpleNamespace(ratio={"motor": 1.0, "load": 5.0}.get))
    limits = {f"torque_{side}": Expected(0.3, 0.4, 0.0, 9.0) for side in experiment.sides}

    def share(before, after):
        pair = (
            {f"torque_{side}": value for side, value in zip(experiment.sides, one, strict=True)} for one in (before, after)
        )
        return explained_share(experiment, *pair, limits)  # type: ignore[arg-type]

    assert share((np.sqrt(1.25), 0.5), (0.5, 0.5)) == pytest.approx(1.0)
    # at the motor the load's counts for a twenty-fifth
    assert share((np.sqrt(1.25), np.sqrt(25.25)), (np.sqrt(1.25), 0.5)) == pytest.approx(0.5)
    assert share((np.sqrt(1.25), 0.5), (np.sqrt(2.25), 0.5)) == pytest.approx(-1.0)
    assert share((0.5, 0.4), (0.6, 0.5)) is None
