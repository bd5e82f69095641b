"""How sure a finding is: what the search found, as far as blocks of the log and the model's own numbers allow."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.special import ndtr

from jaxbl.drive.effects import EFFECTS
from jaxbl.drive.parameters import get_leaf
from jaxbl.simulate import Experiment

from .blocks import SEEN, SURE
from .effect_search import LEAST_CHANCE, Explanation, Finding, Model, contains
from .expected_errors import Expected
from .fitted_model import FittedModel, special_case
from .reference_log import Errors

_LEAST_SHARE = 0.5
"""Of the missing torque, that an explanation takes away: with less it may pass only since its numbers are open."""


def weigh(found: Explanation, fitted: FittedModel, rival: float | None, gains: Mapping[str, float]) -> tuple[Finding, ...]:
    """Findings with their confidences as far as the blocks of the log support them.

    Args:
        found: of the search.
        fitted: the model with it.
        rival: standard errors by which it beats the best model with another effect in place of the last; None of none.
        gains: standard errors by which it beats the model without an effect.
    """
    findings = found.findings
    if rival is not None and found.wrong is not None:
        findings = tuple(
            _shared(finding, found.model, found.wrong, rival) if finding.effect == fitted.names[-1] else finding
            for finding in findings
        )
    return tuple(
        _no_surer(_beside_special_case(finding, fitted), fitted, gains.get(finding.effect, np.inf)) for finding in findings
    )


def _no_surer(finding: Finding, fitted: FittedModel, gain: float) -> Finding:
    """A finding no surer than that its torque is not zero, nor than that it makes the model better by blocks."""
    cls, errors = EFFECTS[finding.effect], fitted.errors()
    # of an effect without sizes its other numbers have to be known
    paths = [f"effects.{finding.effect}.{leaf}" for leaf in cls.sizes() or cls.roles()]
    z = [abs(float(get_leaf(fitted.experiment, path))) / max(errors[path], 1e-300) for path in paths if path in errors]
    chance = min(float(2.0 * ndtr(max(z)) - 1.0) if z else 1.0, float(ndtr(gain)))
    return finding if finding.confidence <= chance else replace(finding, confidence=chance)


def _beside_special_case(finding: Finding, fitted: FittedModel) -> Finding:
    """A finding that shares its probability with a special case of it that it may as well be by the fit."""
    plain = special_case(fitted, finding.effect)
    if plain is None:
        return finding
    half = 0.5 * finding.confidence
    others = ((plain, half), *(one for one in finding.alternatives if one[0] != plain))
    return replace(finding, confidence=half, alternatives=tuple(sorted(others, key=lambda pair: -pair[1])))


def _nats(model: Model, wrong: Model, z: float) -> float:
    """Evidence for a model over one with another effect in place of its last, as far as the blocks agree (nats).

    The better fit counts as far as the blocks say so, too; where they contradict it, they count as a normal deviate.
    """
    if contains(wrong.names[-1], model.names[-1]):
        # a more general effect does as well by its nature
        return np.inf
    if contains(model.names[-1], wrong.names[-1]) and z < -SEEN:
        # what the general one gains in the errors of one step the blocks do not have
        return -0.5 * z**2
    fit = model.log_likelihood - wrong.log_likelihood
    agreed = float(np.clip((z if fit > 0.0 else -z) / SURE, 0.0, 1.0))
    nats = model.log_evidence - wrong.log_evidence - fit * (1.0 - agreed)
    return nats + (0.5 * z * abs(z) if z * fit < 0.0 else 0.0)


def exchanged(found: Explanation, z: float) -> Explanation | None:
    """An explanation with the other effect in place of its last, where log and blocks together prefer that; else None. `z`:
    standard errors by which it beats that one."""
    if found.wrong is None or not found.findings or found.findings[-1].effect != found.model.names[-1]:
        return None
    nats = _nats(found.model, found.wrong, z)
    if not nats < 0.0:
        return None
    *others, last = found.findings
    rival = found.wrong.names[-1]
    both = last.confidence + dict(last.alternatives).get(rival, 0.0)
    chance = both / (1.0 + float(np.exp(nats)))
    alternatives = ((last.effect, both - chance), *(one for one in last.alternatives if one[0] != rival))
    now = Finding(rival, chance, found.wrong.numbers[rival], alternatives)
    return replace(found, model=found.wrong, wrong=found.model, findings=(*others, now))


def _shared(finding: Finding, model: Model, wrong: Model, z: float) -> Finding:
    """A finding whose effect was preferred to another one (`wrong`) by the log, as far as its blocks agree.

    What the numbers' prior says for it stands; what the fit says counts in full only if it shows by blocks, too.
    """
    rival, nats = wrong.names[-1], _nats(model, wrong, z)
    chances = dict(finding.alternatives)
    weight = float(finding.confidence * np.exp(np.clip(-nats, -700.0, 700.0)))
    before = chances.get(rival, 0.0)
    changed_places = model.log_evidence < wrong.log_evidence and rival in chances
    if changed_places or weight <= max(before, LEAST_CHANCE):
        return finding
    total = 1.0 - before + weight
    chances = {name: chance / total for name, chance in (chances | {rival: weight}).items()}
    others = sorted((name for name in chances if name != rival or weight > LEAST_CHANCE), key=lambda name: -chances[name])
    return replace(
        finding,
        confidence=finding.confidence / total,
        alternatives=tuple((name, float(chances[name])) for name in others),
    )


def is_little(share: float | None) -> bool:
    """Whether an explanation takes away less of the missing torque than it has to."""
    return share is not None and share < _LEAST_SHARE


def explained_share(experiment: Experiment, before: Errors, after: Errors, expected: Mapping[str, Expected]) -> float | None:
    """Share of the missing torque's power, beyond noise and smoothing, that a model takes away; both sides at the motor.

    What the fit leaves open of its numbers counts as missing. None where nothing is missing.
    """

    def beyond(errors: Errors) -> float:
        total = 0.0
        for side in experiment.sides:
            one = expected[f"torque_{side}"]
            more = errors[f"torque_{side}"] ** 2 - one.noise**2 - one.rounding**2
            total += max(more, 0.0) / float(experiment.drive.ratio(side)) ** 2
        return total

    missing = beyond(before)
    return 1.0 - beyond(after) / missing if missing > 0.0 else None
