"""What a diagnosis may say of the model that stands, by the proof and the model's own numbers."""

from typing import NamedTuple

from jaxbl.json_types import JsonObject

from .choice import Chosen
from .confidence import is_little
from .effect_search import VerdictName
from .proof import Proof
from .thresholds import LIMITS


class Judgement(NamedTuple):
    """What the proof leaves of an explanation.

    Attributes:
        verdict: as in `diagnosis.json`.
        test: what was asked, and the answers, as in `diagnosis.json`: `failed`, the channels in which the model leaves more
            than a complete one would; `far`, its own numbers that had to leave what is known of them, and by how many
            standard deviations; whether the added torque does as well shuffled in time (`chance`), something else is missing
            by the search (`remainder`), the model as given predicts the proof better (`worse`), the effects take away less
            than half of what is missing there (`little`), the logs do not agree (`contradicting`); `weak`, the channels that
            test nothing, and `untested`, the effects that the proof says nothing of.
    """

    verdict: VerdictName
    test: JsonObject


def judge(chosen: Chosen, proof: Proof, share: float | None, contradicting: bool = False) -> Judgement:
    """Judge the model that stands by the proof.

    Args:
        chosen: the model.
        proof: what was held out.
        share: of the missing torque that it explains (:func:`.confidence.explained_share`).
        contradicting: whether the logs do not agree on its numbers (:mod:`.numbers_by_log`).
    """
    fitted = chosen.fitted
    away = fitted.theta[: len(chosen.prior)] / chosen.prior
    far = {number.path: float(z) for number, z in zip(fitted.free, away, strict=False) if abs(z) > LIMITS.far}
    untested = list(proof.untested) if proof.has_power else list(fitted.names)
    tested = [name for name in fitted.names if name not in untested]
    chance = bool(tested) and any(control.kind == "permuted" and control.z < LIMITS.sure for control in proof.controls)
    little, remainder = bool(tested) and is_little(share), chosen.verdict == "unknown_effect"
    against = proof.failed or far or chance or proof.worse or little or contradicting or remainder
    verdict = "unknown_effect" if against else "not_tested" if untested or not proof.has_power else chosen.verdict
    torques = {name: proof.untested[name]._asdict() if name in proof.untested else {} for name in untested}
    reasons = {"chance": chance, "remainder": remainder, "worse": proof.worse, "little": little}
    tested_by = {"level": LIMITS.failing, "failed": proof.failed, "far": far, "weak": proof.weak, "untested": torques}
    return Judgement(verdict, tested_by | reasons | {"contradicting": contradicting})
