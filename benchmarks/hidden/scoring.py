"""Scores of a diagnosis over many cases: what was named, how sure, and what became of the gap on held-out data.

What counts as right:

- single, new and hard: the verdict is `explained` and the first finding is the hidden effect;
- clutter: the first finding is the hidden effect, whatever the verdict; clutter that is named is not spurious;
- pairs: both hidden effects are among the findings; any other finding is spurious;
- none: the verdict is `no_discrepancy`; everything else is a false alarm;
- unknown: the verdict is `unknown_effect`; `explained` with a first confidence of at least `CONFIDENT` is confidently wrong.

Gap of a case: the mean over channels of 1 - e(after) / e(before), where e² = rmse² - floor² on held-out data, nought where
that is negative; only channels with e(before) of at least the floor. Worse: some channel's rmse after is more than 5 % above
the larger of before and floor. Ratio to the oracle: the median over channels of rmse after over the oracle's. That is by
the tool's own account; by the bench's, where the extended model is given, see benchmarks/hidden/proof.py. Calibration:
every finding of an `explained` verdict, and every one of a case with clutter, is a bet that pays where the effect was really
there.
"""

import json
import math
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from .cases import ALONE, KINDS, Case, Log
from .effects import EFFECTS, NEW, UNKNOWN
from .proof import proofs

Diagnose = Callable[[list[Log], dict[str, Any], Log], Mapping[str, Any]]
"""diagnose(logs, model, holdout) -> what stands in diagnosis.json; `model`, the extended study, lets the bench prove it."""

VERDICTS = ("explained", "no_discrepancy", "unknown_effect")
CONFIDENT = 0.9
BINS = 10

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
"""What must hold, and whether more is better."""


@dataclass
class Outcome:
    """What a diagnosis said about a case, beside the truth.

    Attributes:
        clutter: small effects that are there besides.
        findings: effect, confidence and alternatives of each, as they were ordered.
        reduction, worse, ratio: of the held-out gap by its own account; None where it was not given.
        reachable: reduction by the oracle, by the same account.
        proved, proved_worse: reduction of the gap by the bench's account, and whether there is more of it.
        error: why there is no diagnosis.
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
    def named(self) -> list[str]:
        """Effects that are said to be there."""
        return [effect for effect, _, _ in self.findings] if self.verdict == "explained" or self.kind == "clutter" else []

    @property
    def said(self) -> str:
        """The first finding, or the verdict without one."""
        return (self.named or [self.verdict])[0]

    @property
    def right(self) -> bool:
        if self.kind == "none":
            return self.verdict == "no_discrepancy"
        if self.kind == "unknown":
            return self.verdict == "unknown_effect"
        if self.kind == "pairs":
            return set(self.hidden) <= set(self.named)
        return self.said in self.hidden

    @property
    def tied(self) -> bool:
        """Whether the hidden effect is the first finding or among its alternatives."""
        offered = {self.said, *(self.findings[0][2] if self.named else ())}
        return bool(offered & set(self.hidden))

    @property
    def spurious(self) -> list[str]:
        return [effect for effect in self.named if effect not in (*self.hidden, *self.clutter)]


Oracle = Callable[[Case], Mapping[str, float]]
"""Held-out rmse by channel of the true effects, fitted."""


def _one(case: Case, diagnose: Diagnose, oracle: Oracle | None) -> tuple[Outcome, Mapping[str, Any] | None]:
    """Outcome of a case, and the extended model; one that fails is an outcome too."""
    start = time.perf_counter()
    try:
        diagnosis, error = diagnose([case.log], case.model, case.holdout), ""
    except Exception as failure:
        traceback.print_exc()
        diagnosis, error = {}, f"{type(failure).__name__}: {failure}"
    seconds = time.perf_counter() - start
    best = None
    if oracle is not None and case.hidden and diagnosis:
        try:
            best = oracle(case)
        except Exception:
            traceback.print_exc()
    return outcome(case, diagnosis, best, seconds, error), diagnosis.get("model")


def run(found: Sequence[Case], diagnose: Diagnose, oracle: Oracle | None = None, jobs: int = 1) -> list[Outcome]:
    """Diagnose every case.

    Args:
        found: cases.
        diagnose: what is put to the test.
        oracle: what the true effects can reach.
        jobs: processes that share the work; functions must then be importable.
    """
    from jaxbl.workers import map_jobs

    results = []
    for i, (one, model) in enumerate(map_jobs(partial(_one, diagnose=diagnose, oracle=oracle), found, jobs)):
        results.append((one, model))
        said = "right" if one.right and not one.spurious else "WRONG"
        print(
            f"{i + 1} of {len(found)}: {one.name} {said} ({_tells(one)}), {one.seconds:.0f} s", file=sys.stderr, flush=True
        )
    outcomes = [one for one, _ in results]
    prove(found, outcomes, [model for _, model in results])
    return outcomes


def prove(found: Sequence[Case], outcomes: Sequence[Outcome], models: Sequence[Mapping[str, Any] | None]) -> None:
    """Add the bench's own account of the gap to outcomes, where there is an extended model."""
    given = [i for i, model in enumerate(models) if model]
    results = proofs([(found[i], models[i] or {}) for i in given])
    for i, (reduction, worse) in zip(given, results, strict=True):
        outcomes[i].proved, outcomes[i].proved_worse = reduction, worse


def outcome(
    case: Case,
    diagnosis: Mapping[str, Any],
    oracle: Mapping[str, float] | None = None,
    seconds: float = 0.0,
    error: str = "",
) -> Outcome:
    """What a diagnosis says about a case.

    Raises:
        ValueError: a verdict that there is not.
    """
    verdict = diagnosis.get("verdict", "failed")
    if verdict not in (*VERDICTS, "failed"):
        raise ValueError(f"{case.name}: verdict {verdict!r} is none of {', '.join(VERDICTS)}")
    result = Outcome(
        name=case.name,
        kind=case.kind,
        level=case.truth["level"],
        weak=case.weak,
        hidden=sorted(case.hidden),
        unknown=next(iter(case.truth["effects"])) if case.kind == "unknown" else "",
        conditions=case.conditions,
        verdict=verdict,
        clutter=list(case.truth.get("clutter", ())),
        findings=[
            (one["effect"], float(one["confidence"]), [other["effect"] for other in one.get("alternatives", [])])
            for one in diagnosis.get("findings", [])
        ],
        seconds=seconds,
        error=error,
    )
    gap = diagnosis.get("gap")
    if gap:
        _gap(result, gap["holdout_rmse_before"], gap["holdout_rmse_after"], gap.get("noise_floor") or {}, oracle)
    return result


def _gap(
    result: Outcome,
    before: Mapping[str, float],
    after: Mapping[str, float],
    floor: Mapping[str, float],
    oracle: Mapping[str, float] | None,
) -> None:
    def given(numbers: Mapping[str, float], channel: str) -> float:
        value = numbers.get(channel)
        return math.nan if value is None else float(value)

    reductions, best, ratios, worse = [], [], [], False
    for channel in before:
        b, a = given(before, channel), given(after, channel)
        f = given(floor, channel) if channel in floor else 0.0
        if not math.isfinite(b):
            continue
        worse = worse or not a <= 1.05 * max(b, f)  # nan is worse
        o = math.nan if oracle is None else given(oracle, channel)
        if b > 0.0 and b**2 - f**2 >= f**2:
            for found, left in ((reductions, a), (best, o)):
                found.append(1.0 - math.sqrt(max(left**2 - f**2, 0.0) / (b**2 - f**2)))
        if o > 0.0:
            ratios.append(a / o)
    result.worse = worse
    result.reduction = float(np.mean(reductions)) if reductions else None
    result.reachable = float(np.mean(best)) if best and np.isfinite(best).all() else None
    result.ratio = float(np.median(ratios)) if ratios else None


def wilson(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a rate."""
    if count == 0:
        return 0.0, 1.0
    z, rate = 1.96, hits / count
    middle, spread = rate + z * z / (2 * count), z * math.sqrt(rate * (1 - rate) / count + z * z / (4 * count * count))
    return max(0.0, (middle - spread) / (1 + z * z / count)), min(1.0, (middle + spread) / (1 + z * z / count))


def calibration(outcomes: Iterable[Outcome]) -> list[dict[str, float]]:
    """Findings by confidence, in `BINS` bins of equal width: `confidence` and `right` are means, `count` how many."""
    bets = [
        (confidence, effect in (*one.hidden, *one.clutter))
        for one in outcomes
        for effect, confidence, _ in one.findings
        if one.named
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
    """Rows: what is hidden in cases with one thing or nothing; columns: what was said; counts."""
    ones = [one for one in outcomes if one.kind != "pairs"]
    truths = [one.hidden[0] if one.hidden else one.unknown or "no_discrepancy" for one in ones]
    every = *EFFECTS, *NEW
    rows = [name for name in (*every, *UNKNOWN, "no_discrepancy") if name in truths]
    said = {one.said for one in ones}
    columns = [name for name in (*every, "unknown_effect", "no_discrepancy", "failed") if name in said | set(rows)]
    columns += sorted(said - set(columns))
    counts = np.zeros((len(rows), len(columns)), int)
    for truth, one in zip(truths, ones, strict=True):
        counts[rows.index(truth), columns.index(one.said)] += 1
    return rows, columns, counts


def scores(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """All figures; rates as `{"value", "count", "interval"}`, None where there is no such case."""

    def rate(group: Sequence[Outcome], hit: Callable[[Outcome], bool]) -> dict[str, Any] | None:
        hits = sum(hit(one) for one in group)
        if not group:
            return None
        return {"value": hits / len(group), "count": len(group), "interval": wilson(hits, len(group))}

    def number(values: list[float]) -> dict[str, Any] | None:
        return {"value": float(np.median(values)), "count": len(values)} if values else None

    by = {kind: [one for one in outcomes if one.kind == kind] for kind in (*KINDS, *ALONE)}
    weak = [one for one in by["single"] if one.weak]
    known = [one for one in outcomes if one.hidden]
    curve = calibration(outcomes)
    error = calibration_error(curve)
    return {
        "single": rate(by["single"], lambda one: one.right),
        "single_strong": rate([one for one in by["single"] if not one.weak], lambda one: one.right),
        "weak": rate(weak, lambda one: one.right),
        "single_tied": rate(by["single"], lambda one: one.tied),
        "single_spurious": rate(by["single"], lambda one: bool(one.hidden and one.right and one.spurious)),
        "new": rate(by["new"], lambda one: one.right),
        "new_tied": rate(by["new"], lambda one: one.tied),
        "clutter": rate(by["clutter"], lambda one: one.right),
        "clutter_spurious": rate(by["clutter"], lambda one: bool(one.spurious)),
        "clutter_overstated": rate(by["clutter"], lambda one: bool(one.spurious) and one.verdict == "explained"),
        "hard": rate(by["hard"], lambda one: one.right),
        "hard_weak": rate([one for one in by["hard"] if one.weak], lambda one: one.right),
        "hard_tied": rate(by["hard"], lambda one: one.tied),
        "pairs": rate(by["pairs"], lambda one: one.right),
        "pairs_one": rate(by["pairs"], lambda one: bool(set(one.hidden) & set(one.named))),
        "pairs_spurious": rate(by["pairs"], lambda one: bool(one.spurious)),
        "false_alarms": rate(by["none"], lambda one: not one.right),
        "abstentions": rate(by["unknown"], lambda one: one.right),
        "unknown_missed": rate(by["unknown"], lambda one: one.verdict == "no_discrepancy"),
        "confidently_wrong": rate(by["unknown"], lambda one: bool(one.named) and one.findings[0][1] >= CONFIDENT),
        "gap_reduction": number([one.reduction for one in known if one.reduction is not None]),
        "reachable": number([one.reachable for one in known if one.reachable is not None]),
        "oracle_ratio": number([one.ratio for one in known if one.ratio is not None]),
        "proved": number([one.proved for one in known if one.proved is not None]),
        "proved_worse": rate([one for one in outcomes if one.proved_worse is not None], lambda one: bool(one.proved_worse)),
        "worse": rate([one for one in outcomes if one.worse is not None], lambda one: bool(one.worse)),
        "calibration_error": None if error is None else {"value": error, "count": sum(int(row["count"]) for row in curve)},
        "failed": rate(list(outcomes), lambda one: one.verdict == "failed"),
        "seconds": number([one.seconds for one in outcomes]),
    }


_TITLES = {
    "single": "single effects: first finding right",
    "single_strong": "- 10 and 30 %",
    "weak": "- weak (3 %)",
    "single_tied": "- first finding or one tied with it",
    "single_spurious": "- named, with a spurious second",
    "new": "single effects learnt since: first finding right",
    "new_tied": "- first finding or one tied with it",
    "clutter": "single effects with clutter: first finding right",
    "clutter_spurious": "- spurious finding beside them",
    "clutter_overstated": "- and the verdict is `explained`",
    "hard": "hard set: first finding right",
    "hard_weak": "- weak (3 %)",
    "hard_tied": "- first finding or one tied with it",
    "pairs": "pairs: both named",
    "pairs_one": "- at least one named",
    "pairs_spurious": "- spurious finding beside them",
    "false_alarms": "clean machines: false alarms",
    "abstentions": "unknown effects: abstains",
    "unknown_missed": "- sees nothing",
    "confidently_wrong": f"- explains them at confidence {CONFIDENT:g} or more",
    "gap_reduction": "gap reduction on held-out data, median",
    "reachable": "- by the true effects, fitted (the oracle), median",
    "worse": "- made worse",
    "proved": "- the same by the bench's simulator, median",
    "proved_worse": "- made worse by the bench's simulator",
    "oracle_ratio": "- ratio to the oracle, median",
    "calibration_error": "expected calibration error",
    "failed": "no diagnosis",
    "seconds": "seconds a case, median",
}
_PLAIN = ("oracle_ratio", "calibration_error", "seconds")


def met(key: str, value: float) -> bool | None:
    """Whether a figure is what it must be; None where nothing is asked of it."""
    if key not in TARGETS:
        return None
    target, more = TARGETS[key]
    return value >= target if more else value <= target


def markdown(outcomes: Sequence[Outcome], heading: str = "") -> str:
    """The published table: figures, confusions, accuracy by condition, and what went wrong."""
    lines = [f"## {heading}", ""] if heading else []
    lines += ["| what | value | 95 % | cases | asked for | |", "| --- | ---: | ---: | ---: | ---: | --- |"]
    for key, figure in ((key, figure) for key, figure in scores(outcomes).items() if figure is not None):
        value = figure["value"]
        text = f"{value:.3g}" if key in _PLAIN else f"{100 * value:.1f} %"
        low, high = figure.get("interval", (None, None))
        interval = "" if low is None else f"{100 * low:.0f}-{100 * high:.0f} %"
        asked, mark = "", ""
        if key in TARGETS:
            target, more = TARGETS[key]
            shown = f"{target:g}" if key in _PLAIN else f"{100 * target:g} %"
            asked, mark = f"{'≥' if more else '≤'} {shown}", "met" if met(key, value) else "**not met**"
        lines.append(f"| {_TITLES[key]} | {text} | {interval} | {figure['count']} | {asked} | {mark} |")
    rows, columns, counts = confusion(outcomes)
    wrong = Counter(
        {
            (rows[i], columns[j]): int(counts[i, j])
            for i, j in zip(*np.nonzero(counts), strict=True)
            if not _agrees(rows[i], columns[j])
        }
    )
    if wrong:
        lines += ["", "| hidden | said | times | of |", "| --- | --- | ---: | ---: |"]
        for (truth, said), times in wrong.most_common():
            lines.append(f"| {truth} | {said} | {times} | {counts[rows.index(truth)].sum()} |")
    lines += _by_condition([one for one in outcomes if one.kind in ("single", "hard")])
    missed = [one for one in outcomes if not one.right]
    if missed:
        lines += ["", "Wrong: " + "; ".join(f"{one.name} ({_tells(one)})" for one in missed)]
    return "\n".join(lines) + "\n"


def _agrees(truth: str, said: str) -> bool:
    return truth == said or (truth.startswith("unknown.") and said == "unknown_effect")


def _tells(one: Outcome) -> str:
    truth = " + ".join(one.hidden) or one.unknown or "nothing"
    said = " + ".join(f"{effect} {confidence:.2f}" for effect, confidence, _ in one.findings) if one.named else one.verdict
    return f"{truth}, said {said}{': ' + one.error if one.error else ''}"


def _by_condition(ones: Sequence[Outcome]) -> list[str]:
    lines: list[str] = []
    for key in ("plant", "loop", "excitation", "initial_state", "period"):
        values = sorted({str(one.conditions[key]) for one in ones})
        for value in values:
            group = [one for one in ones if str(one.conditions[key]) == value]
            right = sum(one.right for one in group)
            lines.append(f"| {key} | {value} | {100 * right / len(group):.0f} % | {len(group)} |")
    return ["", "| single and hard, by | | right | cases |", "| --- | --- | ---: | ---: |", *lines] if lines else []


def write(outcomes: Sequence[Outcome], folder: Path, heading: str = "") -> list[Path]:
    """Leave scores.md, scores.json, outcomes.json and the figures in a folder. Returns the figures' paths."""
    from .figures import draw

    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scores.md").write_text(markdown(outcomes, heading), encoding="utf-8")
    figures = {"scores": scores(outcomes), "calibration": calibration(outcomes)}
    (folder / "scores.json").write_text(json.dumps(figures, indent=1), encoding="utf-8")
    (folder / "outcomes.json").write_text(json.dumps([asdict(one) for one in outcomes], indent=1), encoding="utf-8")
    return draw(outcomes, folder)
