"""What a diagnosis may say of the model that stands: a table of checks, one of which is enough against it."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from jaxbl.json_types import JsonObject

from .choice import Chosen
from .effect_search import VerdictName
from .proof import Proof
from .thresholds import LIMITS

CHECKS = {
    "failed": "More is left on the held-out data than a complete model would leave, in these channels",
    "far": "Numbers of the model had to leave what is known of them, by so many standard deviations",
    "remainder": "Something else is missing by the search",
    "worse": "The model as given predicts the held-out data better",
    "little": "The effects take away less than half of the torque that is missing on the data not used for the fit",
    "contradicting": "Logs do not agree on a number",
    "doubtful": "A gap is called for that the motor's encoder alone does not show",
}
"""What speaks against a model, by the key in `gap.test` of `diagnosis.json`: one is enough for `unknown_effect`."""


class Judgement(NamedTuple):
    """An explanation as the proof leaves it.

    Attributes:
        verdict: as in `diagnosis.json`.
        test: the answers to :data:`CHECKS`, as in `diagnosis.json`; `level`; `weak`, the channels that test nothing, and
            `untested`, the effects that the proof says nothing of.
    """

    verdict: VerdictName
    test: JsonObject


def judge_answers(
    names: Sequence[str],
    answers: Mapping[str, Any],
    untested: JsonObject | None = None,
    weak: Sequence[str] = (),
    has_power: bool = True,
) -> Judgement:
    """Judge a model with effects of some `names` by the `answers` to :data:`CHECKS`; those left out are in its favour."""
    test = {"level": LIMITS.failing, **dict.fromkeys(CHECKS, False), **answers, "weak": weak, "untested": untested or {}}
    verdict: VerdictName = "explained" if names else "no_discrepancy"
    if any(answers.values()):
        verdict = "unknown_effect"
    elif untested or not has_power:
        verdict = "not_tested"
    return Judgement(verdict, test)


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
    untested = list(proof.untested) if proof.has_power else list(fitted.names)
    torques = {name: proof.untested.get(name, {}) for name in untested}
    answers = {
        "failed": proof.failed,
        "far": {number.path: float(z) for number, z in zip(fitted.free, away, strict=False) if abs(z) > LIMITS.far},
        "remainder": chosen.verdict == "unknown_effect",
        "worse": proof.worse,
        "little": len(untested) < len(fitted.names)
        and not proof.failed
        and share is not None
        and share < LIMITS.least_explained,
        "contradicting": contradicting,
    }
    return judge_answers(fitted.names, answers, torques, proof.weak, proof.has_power)
