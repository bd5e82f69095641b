"""How sure a finding is, by the fit and by blocks of the log."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from jaxbl.diagnosis.confidence import exchanged, explained_share, weigh
from jaxbl.diagnosis.effect_search import Explanation, Finding
from jaxbl.diagnosis.expected_errors import Expected
from jaxbl.drive import make_effect

NAME = "motor.coulomb_friction"


def make_fit(log_likelihood, log_evidence, name=NAME):
    numbers = {name: {"torque": 0.2}}
    return SimpleNamespace(names=(name,), numbers=numbers, log_likelihood=log_likelihood, log_evidence=log_evidence)


def make_search_result(verdict="explained", fit_gain=50.0, prior_gain=0.0, rival="motor.viscous_friction"):
    finding = Finding(NAME, 0.98, {"torque": 0.1}, (("motor.inertia", 0.02),))
    model, wrong = make_fit(0.0, 0.0), make_fit(-fit_gain, -fit_gain - prior_gain, rival)
    return Explanation(verdict, (finding,), model, model, wrong, {})  # type: ignore[arg-type]


def weigh_result(z=None, error=0.001, gain=9.0, **result):
    """Return the finding as the blocks leave it; `z`: standard errors by which its model beats the other one."""
    fitted = SimpleNamespace(
        names=(NAME,),
        theta=np.array([0.0, 1.0]),
        experiment=SimpleNamespace(effects=(make_effect(NAME, torque=0.1),)),
        errors=lambda: {f"effects.{NAME}.torque": error},
    )
    (finding,) = weigh(make_search_result(**result), fitted, z, {NAME: gain})  # type: ignore[arg-type]
    return finding


def test_a_finding_is_no_surer_than_what_blocks_say_for_it():
    assert weigh_result().confidence == pytest.approx(0.98)
    assert weigh_result(gain=0.5).confidence == pytest.approx(stats.norm.cdf(0.5))


@pytest.mark.parametrize(("error", "sure"), [(0.02, True), (0.2, False)])
def test_a_special_case_is_as_likely_where_the_fit_does_not_part_the_two(error, sure):
    name = "motor.presliding_friction"
    fitted = SimpleNamespace(
        names=(name,),
        experiment=SimpleNamespace(effects=(make_effect(name, torque=0.1, length=0.1),)),
        errors=lambda: {f"effects.{name}.torque": 1e-3, f"effects.{name}.length": error},
    )
    finding = Finding(name, 0.98, {"torque": 0.1, "length": 0.1}, ())
    result = SimpleNamespace(findings=(finding,), wrong=None)
    (weighed,) = weigh(result, fitted, None, {})  # type: ignore[arg-type]
    assert weighed == (finding if sure else Finding(name, 0.49, finding.numbers, (("motor.coulomb_friction", 0.49),)))


def test_what_the_fit_says_counts_only_if_blocks_agree():
    def shared(z, **result):
        finding = weigh_result(z, **result)
        return finding.confidence, dict(finding.alternatives)

    assert shared(2.0)[0] == pytest.approx(0.98)
    confidence, alternatives = shared(0.0)
    assert confidence == pytest.approx(alternatives["motor.viscous_friction"]) == pytest.approx(0.5, abs=0.01)
    assert confidence + sum(alternatives.values()) == pytest.approx(1.0)
    assert shared(-3.0)[0] == pytest.approx(1.0 / (1.0 + np.exp(4.5)), abs=2e-3)
    # what the prior says stands
    assert shared(0.0, prior_gain=20.0)[0] == pytest.approx(0.98)
    # a more general effect takes nothing away: dry friction is a Stribeck friction with equal levels
    assert shared(0.0, rival="motor.stribeck_friction") == (0.98, {"motor.inertia": 0.02})


def test_blocks_of_one_log_do_not_make_its_own_fit_surer():
    """They are no other data: a better fit counts once."""
    assert weigh_result(9.0, fit_gain=1.0).confidence <= 0.98


def test_an_effect_that_another_beats_changes_places_with_it():
    explanation = make_search_result()
    assert exchanged(explanation, 3.0) is None
    exchange = exchanged(explanation, -3.0)
    assert exchange is not None and (exchange.model, exchange.wrong) == (explanation.wrong, explanation.model)
    (finding,) = exchange.findings
    assert finding.effect == "motor.viscous_friction" and finding.numbers == {"torque": 0.2}
    assert finding.confidence == pytest.approx(0.98 / (1.0 + np.exp(-4.5)), rel=1e-3)
    assert finding.alternatives == ((NAME, pytest.approx(0.98 - finding.confidence)), ("motor.inertia", 0.02))
    # of a special case and the general effect the latter gains by its nature
    assert exchanged(make_search_result(rival="motor.stribeck_friction"), -3.0) is None


def test_blocks_outweigh_a_better_fit_of_another_effect():
    # a delay and a lag over a start that neither knows
    def exchange_at(z):
        return exchanged(make_search_result(fit_gain=-380.0), z)

    assert exchange_at(5.0) is None and exchange_at(0.5) is None and exchange_at(-0.5) is not None


def test_the_explained_share_is_that_of_the_torques_power_beyond_noise():
    experiment = SimpleNamespace(sides=["motor", "load"], drive=SimpleNamespace(ratio={"motor": 1.0, "load": 5.0}.get))
    limits = {f"torque_{side}": Expected(0.3, 0.4, 0.0, 9.0) for side in experiment.sides}

    def share_between(before, after):
        pair = (
            {f"torque_{side}": value for side, value in zip(experiment.sides, torques, strict=True)}
            for torques in (before, after)
        )
        return explained_share(experiment, *pair, limits)  # type: ignore[arg-type]

    assert share_between((np.sqrt(1.09), 0.3), (0.3, 0.3)) == pytest.approx(1.0)
    # at the motor the load's counts for a twenty-fifth
    assert share_between((np.sqrt(1.09), np.sqrt(25.09)), (np.sqrt(1.09), 0.3)) == pytest.approx(0.5)
    assert share_between((np.sqrt(1.09), 0.3), (np.sqrt(2.09), 0.3)) == pytest.approx(-1.0)
    # what the fit leaves open of its numbers (0.4) excuses nothing
    assert share_between((np.sqrt(1.09), 0.3), (0.5, 0.3)) == pytest.approx(1.0 - 0.16)
    assert share_between((0.3, 0.2), (0.6, 0.5)) is None


def test_no_effect_is_surer_than_that_its_torque_is_not_zero():
    # one standard error
    assert weigh_result(error=0.1).confidence == pytest.approx(0.683, abs=0.001)
