"""Of what was found that stays which is likelier than something unknown, or which blocks show beyond doubt."""

from types import SimpleNamespace

import pytest

from jaxbl.diagnosis import choice
from jaxbl.diagnosis.confidence import Finding
from jaxbl.diagnosis.effect_search import Gain
from jaxbl.diagnosis.thresholds import LIMITS


def explain(confidences, standard_errors=2.0, plain=None):
    """An explanation by effects of some confidence, each better by blocks by so many standard errors.

    `plain`: odds of a plain law of the first, and standard errors by which that is better than it.
    """
    gains = dict.fromkeys(confidences, Gain(50.0, standard_errors))
    plainer = {name: [] for name in confidences}
    if plain is not None:
        plainer[next(iter(plainer))].append(SimpleNamespace(odds=plain[0], gain=Gain(20.0, plain[1])))
    return SimpleNamespace(
        fitted=SimpleNamespace(names=tuple(confidences)), gains=gains, confidences=confidences, plainer=plainer,
        odds_of=lambda trial: trial.odds,
    )  # fmt: skip


@pytest.fixture
def keep_likely(monkeypatch):
    """What is left of an explanation: names of effects, and in which order others went."""
    gone = []

    def leave_out(explanation, name, plain):
        gone.append(name if plain is None else (name, plain.odds))
        if plain is not None:
            return explain(explanation.confidences)
        # what is left is surer without it
        less = {other: min(1.0, 2.0 * chance) for other, chance in explanation.confidences.items() if other != name}
        return explain(less, explanation.gains[name].standard_errors)

    def weigh(explanation, left):
        return tuple(Finding(name, chance, {}, ()) for name, chance in explanation.confidences.items())

    def keep(explanation, expected=()):
        chosen = choice.Choice.__new__(choice.Choice)
        chosen.search = SimpleNamespace(expected=expected, leave_out=leave_out)  # type: ignore[assignment]
        kept, findings = chosen._keep_likely(explanation)
        assert [finding.effect for finding in findings] == list(kept.fitted.names)
        return kept.fitted.names, gone

    monkeypatch.setattr(choice, "weigh", weigh)
    monkeypatch.setattr(choice.Choice, "_find_missing", lambda *_: (0.1, []))
    return keep


def test_the_least_likely_goes_first_and_the_others_are_weighed_anew(keep_likely):
    assert keep_likely(explain({"motor.cogging": 0.3, "load.gravity": 0.1, "motor.inertia": 0.9})) == (
        ("motor.cogging", "motor.inertia"),
        ["load.gravity"],
    )


def test_what_blocks_show_beyond_doubt_stays(keep_likely):
    assert keep_likely(explain({"motor.cogging": 0.1}, 1.1 * LIMITS.far)) == (("motor.cogging",), [])


@pytest.mark.parametrize(("odds", "standard_errors", "goes"), [(2.0, 1.0, True), (0.5, 1.0, False), (2.0, 3.0, False)])
def test_a_plain_law_takes_the_place_of_what_parts_it_from_something_unknown_alone(keep_likely, odds, standard_errors, goes):
    explanation = explain({"motor.stribeck_friction": 0.9}, plain=(odds, standard_errors))
    assert keep_likely(explanation) == (("motor.stribeck_friction",), [("motor.stribeck_friction", odds)] if goes else [])


def test_what_is_known_to_act_stays(keep_likely):
    assert keep_likely(explain({"load.gravity": 0.1}), ("load.gravity",)) == (("load.gravity",), [])
