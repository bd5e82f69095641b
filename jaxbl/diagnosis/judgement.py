"""What a diagnosis may say: what the search found, as far as held-out data, controls and the model's own numbers allow."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from jaxbl.drive.effects import EFFECTS
from jaxbl.drive.parameters import get_leaf
from jaxbl.simulate import Experiment

from .effect_search import FAR, LEAST_CHANCE, Explanation, Finding, Model, contains
from .expected_errors import Expected, failed
from .proof import SEEN, SURE, Control, FittedModel, special_case
from .reference_log import Errors

_LEAST_SHARE = 0.5
"""Of the missing torque, that an explanation takes away: with less it may pass only since its numbers are open."""


class Judgement(NamedTuple):
    """What the held-out data leave of an explanation.

    Attributes:
        found: the explanation, its verdict and confidences as far as they are supported.
        failed: channels in which the model leaves more than a complete one would.
        far: the model's own numbers that had to leave what is known of them, and by how many of its standard deviations.
        chance: whether the added torque does as well shuffled in time.
        remainder: whether the search found that something else is missing.
        powerless: whether the model as given would pass, too, so that held-out data say nothing for the effects.
        little: whether the effects take away less than half of the torque that is missing on held-out data.
        contradicting: whether the logs do not agree on the model's numbers.
    """

    found: Explanation
    failed: list[str]
    far: dict[str, float]
    chance: bool
    remainder: bool
    powerless: bool
    little: bool
    contradicting: bool


def judged(
    found: Explanation,
    fitted: FittedModel,
    before: Errors,
    errors: Errors,
    expected: Mapping[str, Expected],
    controls: Sequence[Control],
    prior: np.ndarray,
    share: float | None,
    gains: Mapping[str, float],
    contradicting: bool = False,
) -> Judgement:
    """Judge an explanation.

    Args:
        found: of the search.
        fitted: the model with it.
        before, errors: errors of the model as given, and its own, on held-out data, by channel.
        expected: those of a complete model.
        controls: of the model.
        prior: standard deviations of its own numbers, which are the first of `fitted`.
        share: of the missing torque that it explains (:func:`explained_share`).
        gains: standard errors by which the held-out data are met better with each effect than without it.
        contradicting: whether the logs do not agree on its numbers (:mod:`.numbers_by_log`).
    """
    left = failed(errors, expected)
    away = fitted.theta[: len(prior)] / prior
    far = {one.path: float(z) for one, z in zip(fitted.free, away, strict=False) if abs(z) > FAR}
    chance = any(one.kind == "permuted" and one.z < SURE for one in controls)
    findings = found.findings
    for one in controls:
        if one.kind == "wrong" and found.wrong is not None:
            last = fitted.names[-1]
            findings = tuple(
                _shared(each, found.model, found.wrong, one.z) if each.effect == last else each for each in findings
            )
    findings = tuple(_no_surer(_beside_special_case(one, fitted), fitted, gains.get(one.effect, np.inf)) for one in findings)
    powerless = bool(fitted.names) and not failed(before, expected)
    little = bool(fitted.names) and is_little(share)
    verdict = "unknown_effect" if left or far or chance or powerless or little or contradicting else found.verdict
    remainder = found.verdict == "unknown_effect"
    said = replace(found, verdict=verdict, findings=findings)
    return Judgement(said, left, far, chance, remainder, powerless, little, contradicting)


def _no_surer(finding: Finding, fitted: FittedModel, gain: float) -> Finding:
    """A finding no surer than that its torque is not zero, nor than that it makes the model better on held-out data."""
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
    """Evidence for a model over one with another effect in place of its last, as far as held-out data agree (nats).

    The better fit to the log counts as far as that model is the better one there, too; what they say besides is that of
    a normal deviate.
    """
    if contains(wrong.names[-1], model.names[-1]):
        # a more general effect does as well by its nature
        return np.inf
    if contains(model.names[-1], wrong.names[-1]) and z < -SEEN:
        # what the general one gains on the log the held-out data do not have
        return -0.5 * z**2
    fit = model.log_likelihood - wrong.log_likelihood
    agreed = float(np.clip((z if fit > 0.0 else -z) / SURE, 0.0, 1.0))
    nats = model.log_evidence - wrong.log_evidence - fit * (1.0 - agreed)
    return nats + 0.5 * z * abs(z)


def exchanged(found: Explanation, controls: Sequence[Control]) -> Explanation | None:
    """An explanation with the other effect in place of its last, where the held-out data prefer that; else None."""
    z = next((one.z for one in controls if one.kind == "wrong"), np.inf)
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
    """A finding whose effect was preferred to another one (`wrong`) by the log, as far as held-out data agree.

    What the numbers' prior says for it stands; what the fit says counts in full only if it shows on the held-out data, too.
    """
    rival, nats = wrong.names[-1], _nats(model, wrong, z)
    chances = dict(finding.alternatives)
    weight = float(finding.confidence * np.exp(np.clip(-nats, -700.0, 700.0)))
    before = chances.get(rival, 0.0)
    changed_places = model.log_evidence < wrong.log_evidence and rival in chances
    if z > SURE:
        # what the log leaves open the held-out data may decide
        weight = max(weight, before * float(np.exp(-0.5 * z**2)))
    elif changed_places or weight <= max(before, LEAST_CHANCE):
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
    """Share of the missing torque's power, beyond what a complete model leaves, that a model takes away on held-out data;
    both sides at the motor. None where nothing is missing."""

    def beyond(errors: Errors) -> float:
        total = 0.0
        for side in experiment.sides:
            one = expected[f"torque_{side}"]
            more = errors[f"torque_{side}"] ** 2 - one.noise**2 - one.open**2 - one.rounding**2
            total += max(more, 0.0) / float(experiment.drive.ratio(side)) ** 2
        return total

    missing = beyond(before)
    return 1.0 - beyond(after) / missing if missing > 0.0 else None
