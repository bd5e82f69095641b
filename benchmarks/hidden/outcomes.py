"""Outcomes of diagnoses beside the truth, and their statistics: intervals of rates, calibration, confusions."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .effects import EFFECTS, NEW, UNKNOWN

BINS = 10
"""Bins of the calibration curve, over confidences from 0 to 1."""

NUMBERS_FURTHER_OFF = "numbers are further off than stated"
FIRST_LINE = f"The {NUMBERS_FURTHER_OFF}; no effect is needed."
"""First line that a case of `rough` should get; scored by the words of `NUMBERS_FURTHER_OFF`."""
NEXT_STEP = "jaxbl identify LOG --model TOML"
"""First of the next steps that a case of `rough` should get; scored by its first two words."""

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
        first_line, next_step: first line of the report (after warnings about the log) and first command that it proposes.
        identified: of `rough`, dotted path -> relative error of the number by `identify` from the same log and model, and
            the standard error that it states, over the true value.
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
    first_line: str = ""
    next_step: str = ""
    identified: dict[str, tuple[float, float]] = field(default_factory=dict)
    seconds: float = 0.0
    error: str = ""

    @property
    def truth(self) -> str:
        """The first hidden effect, known or not, or the verdict where none is missing."""
        if self.kind == "rough":
            return "rough_numbers"
        return self.hidden[0] if self.hidden else self.unknown or "no_discrepancy"

    @property
    def named_effects(self) -> list[str]:
        """Effects that the diagnosis asserts."""
        partly = self.kind in ("clutter", "rough")
        says = self.verdict in ("explained", "not_tested") or partly
        return [effect for effect, _, _ in self.findings] if says else []

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
        if self.kind == "rough":
            return not self.named_effects and self.says_rough and self.sends_to_identify
        if self.kind == "pairs":
            return set(self.hidden) <= set(self.named_effects)
        return self.answer in self.hidden

    @property
    def is_tied(self) -> bool:
        """True if a hidden effect is the first finding or among its alternatives."""
        alternatives = self.findings[0][2] if self.named_effects else ()
        return not {self.answer, *alternatives}.isdisjoint(self.hidden)

    @property
    def says_rough(self) -> bool:
        """True if the first line says that the numbers, and no effect, are the reason."""
        return NUMBERS_FURTHER_OFF in self.first_line

    @property
    def sends_to_identify(self) -> bool:
        """True if the first command that the diagnosis proposes is an identification."""
        return re.search(rf"\b{' '.join(NEXT_STEP.split()[:2])} ", self.next_step) is not None

    @property
    def worst_identified(self) -> tuple[str, float]:
        """Path of the number whose identified value is furthest off, and the size of its relative error."""
        return max(((path, abs(relative)) for path, (relative, _) in self.identified.items()), key=lambda pair: pair[1])

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
    return bets_calibration(
        [
            (confidence, effect in (*outcome.hidden, *outcome.clutter))
            for outcome in outcomes
            for effect, confidence, _ in outcome.findings
            if outcome.named_effects
        ]
    )


def bets_calibration(bets: Sequence[tuple[float, bool]]) -> list[dict[str, float]]:
    """The same of confidences, and whether each was right."""
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
    truths = [outcome.truth for outcome in outcomes]
    answers = {outcome.answer for outcome in outcomes}
    effects, complete = (*EFFECTS, *NEW), ("no_discrepancy", "rough_numbers")
    rows = [name for name in (*effects, *UNKNOWN, *complete) if name in truths]
    columns = [name for name in (*effects, "unknown_effect", *complete, "failed") if name in answers | set(rows)]
    columns += sorted(answers - set(columns))
    counts = np.zeros((len(rows), len(columns)), int)
    for truth, outcome in zip(truths, outcomes, strict=True):
        counts[rows.index(truth), columns.index(outcome.answer)] += 1
    return rows, columns, counts
