"""Outcomes of diagnoses beside the truth, and their statistics: intervals of rates, calibration, confusions."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .effects import EFFECTS, NEW, UNKNOWN

BINS = 10
"""Bins of the calibration curve, over confidences from 0 to 1."""

TARGETS = {
    "single": (0.97, True),
    "weak": (0.93, True),
    "new": (0.97, True),
    "hard": (0.88, True),
    "pairs": (0.93, True),
    "pairs_spurious": (0.05, False),
    "false_alarms": (0.01, False),
    "abstentions": (0.92, True),
    "confidently_wrong": (0.03, False),
    "gap_reduction": (0.99, True),
    "oracle_ratio": (1.5, False),
    "worse": (0.0, False),
    "proved": (0.99, True),
    "proved_worse": (0.0, False),
    "calibration_error": (0.05, False),
}
"""Target of each score, and True where larger scores are better."""


@dataclass
class Outcome:
    """The answer of a diagnosis about a case, beside the truth.

    Attributes:
        clutter: small effects that act besides the hidden ones.
        findings: effect, confidence and alternatives of each finding, in the diagnosis's order.
        reduction, worse, ratio: change of the held-out gap by the diagnosis's own account; None if it states none.
        reachable: reduction by the oracle, by the same account.
        proved, proved_worse: reduction of the gap by the bench's simulator; True if the gap has grown there.
        error: the reason why there is no diagnosis.
    """

    name: str
    kind: str
    level: float
    weak: bool
    hidden: list[str]
    unknown: str
    conditions: dict[str, Any]
    verdict: str
    clutter: list[str] = field(default_factory=list)
    findings: list[tuple[str, float, list[str]]] = field(default_factory=list)
    reduction: float | None = None
    worse: bool | None = None
    ratio: float | None = None
    reachable: float | None = None
    proved: float | None = None
    proved_worse: bool | None = None
    seconds: float = 0.0
    error: str = ""

    @property
    def named_effects(self) -> list[str]:
        """Effects that the diagnosis asserts."""
        return [effect for effect, _, _ in self.findings] if self.verdict == "explained" or self.kind == "clutter" else []

    @property
    def answer(self) -> str:
        """The first finding, or the verdict if there is none."""
        return (self.named_effects or [self.verdict])[0]

    @property
    def is_right(self) -> bool:
        if self.kind == "none":
            return self.verdict == "no_discrepancy"
        if self.kind == "unknown":
            return self.verdict == "unknown_effect"
        if self.kind == "pairs":
            return set(self.hidden) <= set(self.named_effects)
        return self.answer in self.hidden

    @property
    def is_tied(self) -> bool:
        """True if a hidden effect is the first finding or among its alternatives."""
        alternatives = self.findings[0][2] if self.named_effects else ()
        return not {self.answer, *alternatives}.isdisjoint(self.hidden)

    @property
    def spurious_effects(self) -> list[str]:
        return [effect for effect in self.named_effects if effect not in (*self.hidden, *self.clutter)]


def wilson_interval(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a rate by Wilson's score."""
    if count == 0:
        return 0.0, 1.0
    z, rate = 1.96, hits / count
    middle, spread = rate + z * z / (2 * count), z * math.sqrt(rate * (1 - rate) / count + z * z / (4 * count * count))
    return max(0.0, (middle - spread) / (1 + z * z / count)), min(1.0, (middle + spread) / (1 + z * z / count))


def calibration(outcomes: Iterable[Outcome]) -> list[dict[str, float]]:
    """Calibration curve in `BINS` bins of equal width: mean `confidence`, share that is `right`, `count` of findings."""
    bets = [
        (confidence, effect in (*outcome.hidden, *outcome.clutter))
        for outcome in outcomes
        for effect, confidence, _ in outcome.findings
        if outcome.named_effects
    ]
    rows = []
    for i in range(BINS):
        inside = [(c, r) for c, r in bets if min(int(c * BINS), BINS - 1) == i]
        if inside:
            confidence, right = np.mean(inside, axis=0)
            rows.append({"confidence": float(confidence), "right": float(right), "count": len(inside)})
    return rows


def calibration_error(rows: Sequence[Mapping[str, float]]) -> float | None:
    """Expected calibration error: mean of |right - confidence| over all findings."""
    total = sum(row["count"] for row in rows)
    return sum(row["count"] * abs(row["right"] - row["confidence"]) for row in rows) / total if total else None


def confusion(outcomes: Sequence[Outcome]) -> tuple[list[str], list[str], np.ndarray]:
    """Confusion matrix of cases with one hidden effect or none: row names (truths), column names (answers), and counts."""
    outcomes = [outcome for outcome in outcomes if outcome.kind != "pairs"]
    truths = [outcome.hidden[0] if outcome.hidden else outcome.unknown or "no_discrepancy" for outcome in outcomes]
    answers = {outcome.answer for outcome in outcomes}
    effects = *EFFECTS, *NEW
    rows = [name for name in (*effects, *UNKNOWN, "no_discrepancy") if name in truths]
    columns = [name for name in (*effects, "unknown_effect", "no_discrepancy", "failed") if name in answers | set(rows)]
    columns += sorted(answers - set(columns))
    counts = np.zeros((len(rows), len(columns)), int)
    for truth, outcome in zip(truths, outcomes, strict=True):
        counts[rows.index(truth), columns.index(outcome.answer)] += 1
    return rows, columns, counts
