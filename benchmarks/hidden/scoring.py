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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from jaxbl.workers import map_jobs

from .cases import ALONE, KINDS, Case, Log
from .figures import draw
from .outcomes import TARGETS, Outcome, calibration, calibration_error, confusion, wilson_interval
from .proof import proofs

VERDICTS = ("explained", "no_discrepancy", "unknown_effect")
CONFIDENT = 0.9
Diagnose = Callable[[list[Log], dict[str, Any], Log], Mapping[str, Any]]
"""diagnose(logs, model, holdout) -> what stands in diagnosis.json; `model`, the extended study, lets the bench prove it."""


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
    results = []
    for i, (one, model) in enumerate(map_jobs(partial(_one, diagnose=diagnose, oracle=oracle), found, jobs)):
        results.append((one, model))
        said = "right" if one.is_right and not one.spurious_effects else "WRONG"
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


def scores(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """All figures; rates as `{"value", "count", "interval"}`, None where there is no such case."""

    def rate(group: Sequence[Outcome], hit: Callable[[Outcome], bool]) -> dict[str, Any] | None:
        hits = sum(hit(one) for one in group)
        if not group:
            return None
        return {"value": hits / len(group), "count": len(group), "interval": wilson_interval(hits, len(group))}

    def number(values: list[float]) -> dict[str, Any] | None:
        return {"value": float(np.median(values)), "count": len(values)} if values else None

    by = {kind: [one for one in outcomes if one.kind == kind] for kind in (*KINDS, *ALONE)}
    weak = [one for one in by["single"] if one.weak]
    known = [one for one in outcomes if one.hidden]
    curve = calibration(outcomes)
    error = calibration_error(curve)
    return {
        "single": rate(by["single"], lambda one: one.is_right),
        "single_strong": rate([one for one in by["single"] if not one.weak], lambda one: one.is_right),
        "weak": rate(weak, lambda one: one.is_right),
        "single_tied": rate(by["single"], lambda one: one.is_tied),
        "single_spurious": rate(by["single"], lambda one: bool(one.hidden and one.is_right and one.spurious_effects)),
        "new": rate(by["new"], lambda one: one.is_right),
        "new_tied": rate(by["new"], lambda one: one.is_tied),
        "clutter": rate(by["clutter"], lambda one: one.is_right),
        "clutter_spurious": rate(by["clutter"], lambda one: bool(one.spurious_effects)),
        "clutter_overstated": rate(by["clutter"], lambda one: bool(one.spurious_effects) and one.verdict == "explained"),
        "hard": rate(by["hard"], lambda one: one.is_right),
        "hard_weak": rate([one for one in by["hard"] if one.weak], lambda one: one.is_right),
        "hard_tied": rate(by["hard"], lambda one: one.is_tied),
        "pairs": rate(by["pairs"], lambda one: one.is_right),
        "pairs_one": rate(by["pairs"], lambda one: bool(set(one.hidden) & set(one.named_effects))),
        "pairs_spurious": rate(by["pairs"], lambda one: bool(one.spurious_effects)),
        "false_alarms": rate(by["none"], lambda one: not one.is_right),
        "abstentions": rate(by["unknown"], lambda one: one.is_right),
        "unknown_missed": rate(by["unknown"], lambda one: one.verdict == "no_discrepancy"),
        "confidently_wrong": rate(by["unknown"], lambda one: bool(one.named_effects) and one.findings[0][1] >= CONFIDENT),
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
    missed = [one for one in outcomes if not one.is_right]
    if missed:
        lines += ["", "Wrong: " + "; ".join(f"{one.name} ({_tells(one)})" for one in missed)]
    return "\n".join(lines) + "\n"


def _agrees(truth: str, said: str) -> bool:
    return truth == said or (truth.startswith("unknown.") and said == "unknown_effect")


def _tells(one: Outcome) -> str:
    truth = " + ".join(one.hidden) or one.unknown or "nothing"
    said = (
        " + ".join(f"{effect} {confidence:.2f}" for effect, confidence, _ in one.findings)
        if one.named_effects
        else one.verdict
    )
    return f"{truth}, said {said}{': ' + one.error if one.error else ''}"


def _by_condition(ones: Sequence[Outcome]) -> list[str]:
    lines: list[str] = []
    for key in ("plant", "loop", "excitation", "initial_state", "period"):
        values = sorted({str(one.conditions[key]) for one in ones})
        for value in values:
            group = [one for one in ones if str(one.conditions[key]) == value]
            right = sum(one.is_right for one in group)
            lines.append(f"| {key} | {value} | {100 * right / len(group):.0f} % | {len(group)} |")
    return ["", "| single and hard, by | | right | cases |", "| --- | --- | ---: | ---: |", *lines] if lines else []


def write(outcomes: Sequence[Outcome], folder: Path, heading: str = "") -> list[Path]:
    """Leave scores.md, scores.json, outcomes.json and the figures in a folder. Returns the figures' paths."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scores.md").write_text(markdown(outcomes, heading), encoding="utf-8")
    figures = {"scores": scores(outcomes), "calibration": calibration(outcomes)}
    (folder / "scores.json").write_text(json.dumps(figures, indent=1), encoding="utf-8")
    (folder / "outcomes.json").write_text(json.dumps([asdict(one) for one in outcomes], indent=1), encoding="utf-8")
    return draw(outcomes, folder)
