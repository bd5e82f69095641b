"""What a diagnosis may say of the model that stands, by the proof and the model's own numbers."""

from typing import NamedTuple

import numpy as np

from .blocks import SURE
from .choice import Chosen
from .confidence import is_little
from .effect_search import FAR, VerdictName
from .proof import Proof


class Judgement(NamedTuple):
    """What the proof leaves of an explanation.

    Attributes:
        verdict: as in `diagnosis.json`.
        failed: channels in which the model leaves more than a complete one would.
        far: the model's own numbers that had to leave what is known of them, and by how many of its standard deviations.
        chance: whether the added torque does as well shuffled in time.
        remainder: whether the search found that something else is missing.
        worse: whether the model as given predicts the proof better.
        little: whether the effects take away less than half of the torque that is missing on the proof.
        contradicting: whether the logs do not agree on the model's numbers.
        untested: effects that the proof says nothing of; all of them, and the model itself, where it has no power.
    """

    verdict: VerdictName
    failed: list[str]
    far: dict[str, float]
    chance: bool
    remainder: bool
    worse: bool
    little: bool
    contradicting: bool
    untested: list[str]


def judge(chosen: Chosen, proof: Proof, prior: np.ndarray, share: float | None, contradicting: bool = False) -> Judgement:
    """Judge the model that stands by the proof.

    Args:
        chosen: the model.
        proof: what was held out.
        prior: standard deviations of its own numbers, which are the first of the fitted ones.
        share: of the missing torque that it explains (:func:`explained_share`).
        contradicting: whether the logs do not agree on its numbers (:mod:`.numbers_by_log`).
    """
    fitted = chosen.fitted
    away = fitted.theta[: len(prior)] / prior
    far = {number.path: float(z) for number, z in zip(fitted.free, away, strict=False) if abs(z) > FAR}
    untested = list(proof.untested) if proof.has_power else list(fitted.names)
    tested = [name for name in fitted.names if name not in untested]
    chance = bool(tested) and any(control.kind == "permuted" and control.z < SURE for control in proof.controls)
    little, remainder = bool(tested) and is_little(share), chosen.found.verdict == "unknown_effect"
    against = proof.failed or far or chance or proof.worse or little or contradicting or remainder
    open_ = untested or not proof.has_power
    verdict = "unknown_effect" if against else "not_tested" if open_ else chosen.found.verdict
    return Judgement(verdict, proof.failed, far, chance, remainder, proof.worse, little, contradicting, untested)
