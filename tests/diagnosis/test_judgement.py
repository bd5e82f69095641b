"""What a diagnosis may say of what the search found."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from passed import PASSED
from scipy import stats

from jaxbl.diagnosis.effect_search import Explanation, Finding
from jaxbl.diagnosis.expected_errors import Expected
from jaxbl.diagnosis.judgement import exchanged, explained_share, judged
from jaxbl.diagnosis.proof import Control
from jaxbl.drive import make_effect

NAME = "motor.coulomb_friction"
LIMITS = {"theta_e": Expected(1e-4, 0.0, 0.0, 1.2e-4), "torque_motor": Expected(0.01, 0.0, 0.0, 0.012)}
NOISE = {"theta_e": 1e-4, "torque_motor": 0.01}
NOMINAL_ERRORS = {"theta_e": 0.1, "torque_motor": 0.01}


def make_fit(log_likelihood, log_evidence, name=NAME):
    numbers = {name: {"torque": 0.2}}
    return SimpleNamespace(names=(name,), numbers=numbers, log_likelihood=log_likelihood, log_evidence=log_evidence)


def make_search_result(verdict="explained", fit_gain=50.0, prior_gain=0.0, rival="motor.viscous_friction"):
    finding = Finding(NAME, 0.98, {"torque": 0.1}, (("motor.inertia", 0.02),))
    model, wrong = make_fit(0.0, 0.0), make_fit(-fit_gain, -fit_gain - prior_gain, rival)
    return Explanation(verdict, (finding,), model, model, wrong, {})  # type: ignore[arg-type]


def judge(
    errors=NOISE,
    before=NOMINAL_ERRORS,
    theta=0.0,
    controls=(),
    verdict="explained",
    error=0.001,
    share=1.0,
    contradicting=False,
    z=9.0,
    **gains,
):
    fitted = SimpleNamespace(
        names=(NAME,),
        theta=np.array([theta, 1.0]),
        free=[SimpleNamespace(path="drive.motor_inertia")] * 2,
        experiment=SimpleNamespace(effects=(make_effect(NAME, torque=0.1),)),
        errors=lambda: {f"effects.{NAME}.torque": error},
    )
    return judged(
        make_search_result(verdict, **gains),
        fitted,
        before,
        errors,
        LIMITS,
        controls,
        np.array([0.02]),
        share,
        {NAME: z},
        contradicting,
    )  # type: ignore[arg-type]


def test_a_verdict_that_held_out_data_support_stays():
    controls = [Control("wrong", NOISE, 9.0, "motor.viscous_friction"), Control("permuted", NOISE, 4.0)]
    judgement = judge(controls=controls)
    assert judgement.found.verdict == "explained" and judgement.found.findings[0].confidence == pytest.approx(0.98)
    assert not any(getattr(judgement, reason) for reason in PASSED if reason != "level")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"errors": NOISE | {"torque_motor": 0.0121}}, {"failed": ["torque_motor"]}),
        ({"theta": -0.11}, {"far": {"drive.motor_inertia": pytest.approx(-5.5)}}),
        ({"controls": [Control("permuted", NOISE, 1.9)]}, {"chance": True}),
        ({"verdict": "unknown_effect"}, {"remainder": True}),
        ({"before": NOISE}, {"powerless": True}),
        ({"share": 0.2}, {"little": True}),
        ({"contradicting": True}, {"contradicting": True}),
    ],
    ids=["errors", "numbers", "shuffled", "search", "before", "share", "logs"],
)
def test_one_reason_is_enough_against_it(changes, reason):
    judgement = judge(**changes)
    assert judgement.found.verdict == "unknown_effect" and judgement.found.findings == make_search_result().findings
    passed = {key: value for key, value in PASSED.items() if key != "level"}
    assert {key: getattr(judgement, key) for key in passed} == passed | reason


def test_a_finding_is_no_surer_than_what_held_out_data_say_for_it():
    (finding,) = judge(z=0.5).found.findings
    assert finding.confidence == pytest.approx(stats.norm.cdf(0.5))


@pytest.mark.parametrize(("error", "sure"), [(0.02, True), (0.2, False)])
def test_a_special_case_is_as_likely_where_the_fit_does_not_part_the_two(error, sure):
    name = "motor.presliding_friction"
    fitted = SimpleNamespace(
        names=(name,),
        theta=np.array([0.0]),
        free=[SimpleNamespace(path="drive.motor_inertia")],
        experiment=SimpleNamespace(effects=(make_effect(name, torque=0.1, length=0.1),)),
        errors=lambda: {f"effects.{name}.torque": 1e-3, f"effects.{name}.length": error},
    )
    finding = Finding(name, 0.98, {"torque": 0.1, "length": 0.1}, ())
    explanation = dataclasses.replace(make_search_result(), findings=(finding,), wrong=None)
    (judged_finding,) = judged(
        explanation, fitted, NOMINAL_ERRORS, NOISE, LIMITS, (), np.array([0.02]), 1.0, {}
    ).found.findings  # type: ignore[arg-type]
    assert judged_finding == (finding if sure else Finding(name, 0.49, finding.numbers, (("motor.coulomb_friction", 0.49),)))


def judge_shared(z, **gains):
    (finding,) = judge(
        controls=[Control("wrong", NOISE, z, gains.get("rival", "motor.viscous_friction"))], **gains
    ).found.findings
    return finding.confidence, dict(finding.alternatives)


def test_what_the_fit_says_counts_only_if_held_out_data_agree():
    assert judge_shared(2.0)[0] == pytest.approx(0.98)
    confidence, alternatives = judge_shared(0.0)
    assert confidence == pytest.approx(alternatives["motor.viscous_friction"]) == pytest.approx(0.5, abs=0.01)
    assert confidence + sum(alternatives.values()) == pytest.approx(1.0)
    assert judge_shared(-3.0)[0] == pytest.approx(1.0 / (1.0 + np.exp(4.5)), abs=2e-3)


def test_an_effect_that_another_beats_on_held_out_data_changes_places_with_it():
    control = [Control("wrong", NOISE, -3.0, "motor.viscous_friction")]
    explanation = make_search_result()
    assert exchanged(explanation, []) is None and exchanged(explanation, [control[0]._replace(z=3.0)]) is None
    exchange = exchanged(explanation, control)
    assert exchange is not None and (exchange.model, exchange.wrong) == (explanation.wrong, explanation.model)
    (finding,) = exchange.findings
    assert finding.effect == "motor.viscous_friction" and finding.numbers == {"torque": 0.2}
    assert finding.confidence == pytest.approx(0.98 / (1.0 + np.exp(-4.5)), rel=1e-3)
    assert finding.alternatives == ((NAME, pytest.approx(0.98 - finding.confidence)), ("motor.inertia", 0.02))
    # what the log alone said for the other one is no argument any more
    fitted = SimpleNamespace(names=("motor.viscous_friction",), theta=np.zeros(1), free=[], errors=dict)
    reverse_control = [Control("wrong", NOISE, 1.8, NAME)]
    judgement = judged(exchange, fitted, NOMINAL_ERRORS, NOISE, LIMITS, reverse_control, np.array([0.02]), 1.0, {})  # type: ignore[arg-type]
    assert judgement.found.findings == (finding,)
    assert (
        exchanged(
            make_search_result(rival="motor.stribeck_friction"), [control[0]._replace(effect="motor.stribeck_friction")]
        )
        is None
    )


def test_held_out_data_outweigh_a_better_fit_of_another_effect():
    # a delay and a lag over a start that neither knows
    def exchange_at(z):
        return exchanged(make_search_result(fit_gain=-380.0), [Control("wrong", NOISE, z, "motor.viscous_friction")])

    assert exchange_at(5.0) is None and exchange_at(0.5) is None and exchange_at(-0.5) is not None
    finding = judge(controls=[Control("wrong", NOISE, 5.0, "motor.viscous_friction")], fit_gain=-380.0).found.findings[0]
    assert finding.confidence == pytest.approx(0.98, abs=1e-3)


def test_what_a_log_leaves_open_held_out_data_decide():
    tie = Finding(NAME, 0.51, {"torque": 0.1}, (("motor.viscous_friction", 0.49),))
    fitted = SimpleNamespace(names=(NAME,), theta=np.zeros(1), free=[], errors=dict, experiment=None)

    def judge_tie(z):
        explanation = dataclasses.replace(make_search_result(fit_gain=0.0), findings=(tie,))
        controls = [Control("wrong", NOISE, z, "motor.viscous_friction")]
        return judged(
            explanation, fitted, NOMINAL_ERRORS, NOISE, LIMITS, controls, np.array([0.02]), 1.0, {}
        ).found.findings[0]  # type: ignore[arg-type]

    assert judge_tie(5.0).confidence > 0.99 and judge_tie(5.0).alternatives == ()
    assert judge_tie(1.0) == tie


def test_what_the_prior_says_stands():
    assert judge_shared(0.0, prior_gain=20.0)[0] == pytest.approx(0.98)


def test_a_more_general_effect_takes_nothing_away():
    # dry friction is a Stribeck friction with equal levels
    assert judge_shared(0.0, rival="motor.stribeck_friction") == (0.98, {"motor.inertia": 0.02})


def test_the_explained_share_is_that_of_the_torques_power_beyond_what_a_complete_model_leaves():
    experiment = SimpleNamespace(sides=["motor", "load"], drive=SimpleNamespace(ratio={"motor": 1.0, "load": 5.0}.get))
    limits = {f"torque_{side}": Expected(0.3, 0.4, 0.0, 9.0) for side in experiment.sides}

    def share_between(before, after):
        pair = (
            {f"torque_{side}": value for side, value in zip(experiment.sides, torques, strict=True)}
            for torques in (before, after)
        )
        return explained_share(experiment, *pair, limits)  # type: ignore[arg-type]

    assert share_between((np.sqrt(1.25), 0.5), (0.5, 0.5)) == pytest.approx(1.0)
    # at the motor the load's counts for a twenty-fifth
    assert share_between((np.sqrt(1.25), np.sqrt(25.25)), (np.sqrt(1.25), 0.5)) == pytest.approx(0.5)
    assert share_between((np.sqrt(1.25), 0.5), (np.sqrt(2.25), 0.5)) == pytest.approx(-1.0)
    assert share_between((0.5, 0.4), (0.6, 0.5)) is None


def test_no_effect_is_surer_than_that_its_torque_is_not_zero():
    (finding,) = judge(error=0.1).found.findings
    # one standard error
    assert finding.confidence == pytest.approx(0.683, abs=0.001)
