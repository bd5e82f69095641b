"""What a diagnosis may say: what the search found, as far as held-out data, controls and the model's own numbers allow."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from jaxbl.drive.effects import EFFECTS
from jaxbl.simulate import Experiment

from .effect_search import FAR, Explanation, Finding
from .expected_errors import Expected, failed
from .proof import Control, FittedModel

_BEATEN = 2.0
"""Standard errors by which the shuffled torque must be beaten: 2 % by chance."""


class Judgement(NamedTuple):
    """What the held-out data leave of an explanation.

    Attributes:
        found: the explanation, its verdict and confidences as far as they are supported.
        failed: channels in which the model leaves more than a complete one would.
        far: the model's own numbers that had to leave what is known of them, and by how many of its standard deviations.
        chance: whether the added torque does as well shuffled in time.
        remainder: whether the search found that something else is missing.
    """

    found: Explanation
    failed: list[str]
    far: dict[str, float]
    chance: bool
    remainder: bool


def judged(
    found: Explanation,
    fitted: FittedModel,
    errors: Mapping[str, float],
    expected: Mapping[str, Expected],
    controls: Sequence[Control],
    prior: np.ndarray,
) -> Judgement:
    """Judge an explanation.

    Args:
        found: of the search.
        fitted: the model with it.
        errors: its errors on held-out data, by channel.
        expected: those of a complete model.
        controls: of the model.
        prior: standard deviations of its own numbers, which are the first of `fitted`.
    """
    left = failed(errors, expected)
    away = fitted.theta[: len(prior)] / prior
    far = {one.path: float(z) for one, z in zip(fitted.free, away, strict=False) if abs(z) > FAR}
    chance = any(one.kind == "permuted" and one.z < _BEATEN for one in controls)
    findings = found.findings
    for one in controls:
        if one.kind == "wrong":
            findings = tuple(_shared(each, one) if each.effect == fitted.names[-1] else each for each in findings)
    verdict = "unknown_effect" if left or far or chance else found.verdict
    return Judgement(
        dataclasses.replace(found, verdict=verdict, findings=findings), left, far, chance, found.verdict == "unknown_effect"
    )


def _shared(finding: Finding, rival: Control) -> Finding:
    """A finding that is no surer than held-out data say: by them its effect is better with the probability of its z."""
    name = finding.effect.partition(".")[2]
    if name in EFFECTS[rival.effect].special_cases or rival.effect == finding.effect:
        # a more general effect does as well by its nature
        return finding
    most = float(ndtr(rival.z))
    if finding.confidence <= most:
        return finding
    others = dict(finding.alternatives)
    others[rival.effect] = others.get(rival.effect, 0.0) + finding.confidence - most
    return dataclasses.replace(
        finding, confidence=most, alternatives=tuple(sorted(others.items(), key=lambda pair: -pair[1]))
    )


def explained_share(
    experiment: Experiment, before: Mapping[str, float], after: Mapping[str, float], expected: Mapping[str, Expected]
) -> float | None:
    """Share of the missing torque's power, beyond what a complete model leaves, that a model takes away on held-out data;
    both sides at the motor. None where nothing is missing."""

    def beyond(errors: Mapping[str, float]) -> float:
        total = 0.0
        for side in experiment.sides:
            one = expected[f"torque_{side}"]
            more = errors[f"torque_{side}"] ** 2 - one.noise**2 - one.open**2
            total += max(more, 0.0) / float(experiment.drive.ratio(side)) ** 2
        return total

    missing = beyond(before)
    return 1.0 - beyond(after) / missing if missing > 0.0 else None
