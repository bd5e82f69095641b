"""How sure a finding is, by the fit and by blocks of the log."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from jaxbl.diagnosis.confidence import explained_share, weigh
from jaxbl.diagnosis.effect_search import Explanation, Gain, Trial
from jaxbl.diagnosis.expected_errors import Expected
from jaxbl.drive import make_effect

NAME, RIVAL = "motor.coulomb_friction", "motor.viscous_friction"


def weigh_effect(rival=None, *, error=0.001, gain=9.0, name=NAME, unknown=0.0, left=0.0, plain=None, missed=0.0, **numbers):
    """Return the finding; `rival`: what it gains over another effect, `plain`: over a plain law; `unknown`: nats that a free
    function still gains; `left`: torque that is still missing over its own; `missed`: by laws of others, over its own
    part."""
    effect = make_effect(name, torque=0.1, **numbers)
    fitted: Any = SimpleNamespace(
        names=(name,),
        numbers={name: {"torque": 0.1} | numbers},
        experiment=SimpleNamespace(effects=(effect,)),
        share=lambda name: 0.2,
        own_share=lambda name: 0.05,
        missed_share=lambda name: 0.05 * missed,
        errors=lambda: {f"effects.{name}.torque": error} | {f"effects.{name}.{leaf}": 0.1 * error for leaf in numbers},
    )
    rivals = [] if rival is None else [Trial((RIVAL,), fitted, Gain(*rival))]
    plainer = [] if plain is None else [Trial((NAME,), fitted, Gain(*plain))]
    explanation = Explanation(fitted, {name: Gain(50.0, gain)}, {name: rivals}, {name: plainer}, unknown)
    (finding,) = weigh(explanation, 0.2 * left)
    return finding


def test_a_finding_is_no_surer_than_what_blocks_say_for_it():
    assert weigh_effect().confidence == pytest.approx(1.0)
    assert weigh_effect(gain=0.5).confidence == pytest.approx(stats.norm.cdf(0.5))


def test_no_effect_is_surer_than_that_its_torque_is_not_zero():
    # one standard error
    assert weigh_effect(error=0.1).confidence == pytest.approx(0.683, abs=0.001)


def test_no_finding_is_surer_than_held_out_data_make_it():
    finding = weigh_effect()
    chances = [finding.confirm(z).confidence for z in (-2.0, 0.0, 2.0, 3.0, 6.0)]
    # nothing there shows it: the prior odds
    assert chances[1] == pytest.approx(1.0 / (1.0 + np.exp(2.0)))
    assert chances[2] == pytest.approx(0.5) and chances[4] == pytest.approx(finding.confidence)
    assert chances == sorted(chances)
    # where it does not act nothing is said of it
    assert finding.confirm(np.inf) == finding
    # two that tie are one torque
    tied = weigh_effect((50.0, 0.0))
    doubted = tied.confirm(2.0)
    assert doubted.confidence == pytest.approx(0.25) and doubted.alternatives == ((RIVAL, pytest.approx(0.25)),)
    assert tied.confirm(6.0).confidence == pytest.approx(0.5)


def test_an_effect_is_no_surer_than_that_laws_of_others_do_not_miss_its_torque():
    chances = [weigh_effect(missed=missed).confidence for missed in (0.0, 0.2, 1.0, 3.0)]
    assert chances == [pytest.approx(chance) for chance in (1.0, 1.0 / 1.04, 0.5, 0.1)]


@pytest.mark.parametrize(("unknown", "odds"), [(0.0, 0.0), (20.0, 1.0), (60.0, 9.0)])
def test_a_finer_law_is_no_likelier_than_something_unknown_in_the_place_of_what_parts_it(unknown, odds):
    finding = weigh_effect(name="motor.presliding_friction", length=0.1, plain=(20.0, 5.0), unknown=unknown)
    # and the effect as a whole, which gains 50 nats
    total = 1.0 + odds + (unknown / 50.0) ** 2
    assert finding.confidence == pytest.approx(1.0 / total)
    assert finding.alternatives == (((NAME, pytest.approx(odds / total)),) if odds else ())


def test_what_the_fit_says_counts_only_if_blocks_agree():
    assert weigh_effect((50.0, 4.0)).alternatives == ()
    # z standard errors are 2 z² nats
    assert weigh_effect((50.0, 1.0)).confidence == pytest.approx(1.0 / (1.0 + np.exp(-2.0)))
    finding = weigh_effect((50.0, 0.0))
    assert finding.confidence == pytest.approx(0.5) and finding.alternatives == ((RIVAL, pytest.approx(0.5)),)
    # and where they contradict it they count as a normal deviate
    finding = weigh_effect((50.0, -1.5))
    assert finding.confidence == pytest.approx(1.0 / (1.0 + np.exp(4.5)), rel=1e-6)
    assert finding.confidence + finding.alternatives[0][1] == pytest.approx(1.0)
    # blocks of one log are no other data than its own fit: a better fit counts once
    assert weigh_effect((1.0, 9.0)).confidence == pytest.approx(1.0 / (1.0 + np.exp(-1.0)))


def test_an_effect_is_no_surer_than_what_is_unknown_leaves():
    # it gains 50 nats; what is unknown, and gains as much, may stand in its place
    assert weigh_effect(unknown=5.0).confidence == pytest.approx(1.0 / 1.01)
    assert weigh_effect(unknown=50.0).confidence == pytest.approx(0.5)
    finding = weigh_effect((50.0, 0.0), unknown=1000.0)
    assert finding.confidence == pytest.approx(1.0 / 402.0) and finding.alternatives == ()
    assert not finding.is_likely


def test_an_effect_smaller_than_the_torque_that_is_left_is_not_likely():
    assert weigh_effect(left=0.1).confidence == pytest.approx(1.0 / 1.01)
    assert not weigh_effect(left=1.1).is_likely
    # two that the log does not part are likely together
    tied = weigh_effect((50.0, 0.0), left=0.2)
    assert tied.confidence < 0.5 and tied.is_likely


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
