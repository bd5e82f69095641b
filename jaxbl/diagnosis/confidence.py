"""How sure a finding is: against other effects in its place, against its size, by blocks of the log, and by
what is held out."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.special import expit, ndtr

from jaxbl.chain import Experiment
from jaxbl.drive.effects import EFFECTS, Numbers
from jaxbl.drive.parameters import get_leaf

from .effect_search import Explanation
from .expected_errors import Expected
from .reference_log import Errors
from .refit import FittedModel
from .thresholds import LIMITS

LEAST_CHANCE = 0.01
"""Alternatives of a lower probability are not listed."""


class Finding(NamedTuple):
    """An effect that is missing.

    Attributes:
        effect: its name.
        confidence: probability that it is this one.
        numbers: of the effect.
        alternatives: other effects that the log does not rule out in its place, and their probabilities.
    """

    effect: str
    confidence: float
    numbers: Numbers
    alternatives: tuple[tuple[str, float], ...]

    @property
    def chance(self) -> float:
        """Probability that it is this one, or another effect that is listed in its place."""
        return self.confidence + sum(chance for _, chance in self.alternatives)

    @property
    def is_likely(self) -> bool:
        """True if one of these is likelier than none."""
        return self.chance > 1.0 - self.chance

    def confirm(self, z: float) -> "Finding":
        """The finding no surer than held-out data alone make an effect of the same prior odds; `z`: standard errors by which
        they are predicted better with it."""
        # nats of a normal number of mean z over one of mean 0
        part = min(1.0, float(expit(LIMITS.effect_odds + 0.5 * z * abs(z))) / max(self.chance, 1e-300))
        alternatives = tuple((name, part * chance) for name, chance in self.alternatives)
        return self._replace(confidence=part * self.confidence, alternatives=alternatives)


def weigh(explanation: Explanation, left: float = 0.0) -> tuple[Finding, ...]:
    """Weigh the effects that were found; `left`: torque that is still missing, over the driving torque."""
    fitted, findings = explanation.fitted, []
    for name, gain in explanation.gains.items():
        odds = {trial.added[0]: float(np.exp(-trial.gain.worth)) for trial in explanation.rivals[name]}
        # what is still unknown may stand in its place, or what laws of other effects miss: odds by the squares of gains, and
        # of torques, part right from wrong on generated logs
        parts = [
            explanation.largest_gain / max(gain.nats, 1.0),
            left / max(fitted.share(name), 1e-300),
            fitted.missed_share(name) / max(fitted.own_share(name), 1e-300),
        ]
        unknown = max(parts) ** 2
        odds |= {trial.added[0]: explanation.odds_of(trial) for trial in explanation.plainer[name] if trial.added[0] != name}
        total = 1.0 + sum(odds.values()) + unknown
        # no surer than that its torque is not zero, nor than that it makes the model better by blocks
        least = min(_certainty(fitted, name), float(ndtr(gain.standard_errors)))
        weighed = sorted(((other, chance / total) for other, chance in odds.items()), key=lambda pair: -pair[1])
        alternatives = tuple(pair for pair in weighed if pair[1] > LEAST_CHANCE)
        findings.append(Finding(name, min(1.0 / total, least), fitted.numbers[name], alternatives))
    return tuple(findings)


def _certainty(fitted: FittedModel, name: str) -> float:
    """Return the probability that some size of an effect is not zero; of an effect without sizes, some other number."""
    cls, errors = EFFECTS[name], fitted.errors()
    paths = [f"effects.{name}.{leaf}" for leaf in cls.sizes() or cls.roles()]
    z = [abs(float(get_leaf(fitted.experiment, path))) / max(errors[path], 1e-300) for path in paths if path in errors]
    return float(2.0 * ndtr(max(z)) - 1.0) if z else 1.0


def missing_power(experiment: Experiment, errors: Errors, expected: Mapping[str, Expected]) -> float:
    """Mean square of the torque that is missing beyond noise and smoothing, both sides at the motor, (N m)^2.

    What the fit leaves open of a model's numbers counts as missing.
    """
    total = 0.0
    for side in experiment.sides:
        channel = expected[f"torque_{side}"]
        more = errors[f"torque_{side}"] ** 2 - channel.noise**2 - channel.rounding**2
        total += max(more, 0.0) / float(experiment.drive.ratio(side)) ** 2
    return total


def explained_share(experiment: Experiment, before: Errors, after: Errors, expected: Mapping[str, Expected]) -> float | None:
    """Share of the missing torque's power that a model takes away; None where nothing is missing."""
    missing = missing_power(experiment, before, expected)
    return 1.0 - missing_power(experiment, after, expected) / missing if missing > 0.0 else None
