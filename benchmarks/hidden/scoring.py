"""Scores of a diagnosis over many cases: what was named, how sure, and what became of the gap on held-out data.

What counts as right:

- single, new and hard: the verdict is `explained` and the first finding is the hidden effect;
- clutter: the first finding is the hidden effect, whatever the verdict; clutter that is named is not spurious;
- pairs: both hidden effects are among the findings; any other finding is spurious;
- none: the verdict is `no_discrepancy`; everything else is a false alarm;
- rough: no effect is among the findings, whatever the verdict, the first line is `FIRST_LINE` and the first command proposed
  is `NEXT_STEP` (outcomes.py). That this advice is right is tried out: `identify` has the same log and model, and its
  numbers are compared with the true ones;
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
from .outcomes import FIRST_LINE, NEXT_STEP, TARGETS, Outcome, calibration, calibration_error, confusion, wilson_interval
from .proof import proofs

VERDICTS = ("explained", "no_discrepancy", "unknown_effect", "not_tested", "rough_numbers")
CONFIDENT = 0.9
Diagnose = Callable[[list[Log], dict[str, Any], Log], Mapping[str, Any]]
"""diagnose(logs, model, holdout) -> what stands in diagnosis.json; `model`, the extended study, lets the bench prove it;
`first_line` and `next_step` are what the report says first, and the first command that it proposes."""


Oracle = Callable[[Case], Mapping[str, float]]
"""Held-out rmse by channel of the true effects, fitted."""
Identify = Callable[[Case], dict[str, tuple[float, float]]]
"""Relative error and standard error of each number by an identification."""


def _diagnose(
    case: Case, diagnose: Diagnose, oracle: Oracle | None, identify: Identify | None
) -> tuple[Outcome, Mapping[str, Any] | None]:
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
    result = outcome(case, diagnosis, best, seconds, error)
    if identify is not None and case.kind == "rough":
        try:
            result.identified = identify(case)
        except Exception:
            traceback.print_exc()
    return result, diagnosis.get("model")


def run(
    hidden_cases: Sequence[Case],
    diagnose: Diagnose,
    oracle: Oracle | None = None,
    jobs: int = 1,
    identify: Identify | None = None,
    folder: Path | None = None,
) -> list[Outcome]:
    """Diagnose every case.

    Args:
        hidden_cases: cases.
        diagnose: what is put to the test.
        oracle: what the true effects can reach.
        jobs: processes that share the work; functions must then be importable.
        identify: what the numbers of `rough` are after the advice has been taken.
        folder: of answers that are kept, case by case; what is there is not asked again.
    """
    results = []
    diagnose_case = partial(_diagnose_once, folder=folder, diagnose=diagnose, oracle=oracle, identify=identify)
    for i, (result, model) in enumerate(map_jobs(diagnose_case, hidden_cases, jobs)):
        results.append((result, model))
        judgement = "right" if result.is_right and not result.spurious_effects else "WRONG"
        print(
            f"{i + 1} of {len(hidden_cases)}: {result.name} {judgement} ({_tells(result)}), {result.seconds:.0f} s",
            file=sys.stderr,
            flush=True,
        )
    outcomes = [result for result, _ in results]
    prove(hidden_cases, outcomes, [model for _, model in results])
    return outcomes


def _diagnose_once(
    case: Case, folder: Path | None, diagnose: Diagnose, oracle: Oracle | None, identify: Identify | None
) -> tuple[Outcome, Mapping[str, Any] | None]:
    """The answer to a case that a folder keeps, or a new one, which is kept there."""
    if folder is None:
        return _diagnose(case, diagnose, oracle, identify)
    path = folder / f"{case.name}.json"
    if not path.exists():
        result, model = _diagnose(case, diagnose, oracle, identify)
        draft = path.with_suffix(".draft")
        draft.write_text(json.dumps({"outcome": asdict(result), "model": model}), encoding="utf-8")
        draft.replace(path)
    stored = json.loads(path.read_text(encoding="utf-8"))
    result = Outcome(**stored["outcome"])
    result.findings = [(effect, confidence, rivals) for effect, confidence, rivals in result.findings]
    return result, stored["model"]


def prove(hidden_cases: Sequence[Case], outcomes: Sequence[Outcome], models: Sequence[Mapping[str, Any] | None]) -> None:
    """Add the bench's own account of the gap to outcomes, where there is an extended model."""
    with_model = [i for i, model in enumerate(models) if model]
    results = proofs([(hidden_cases[i], models[i] or {}) for i in with_model])
    for i, (reduction, worse) in zip(with_model, results, strict=True):
        outcomes[i].proved, outcomes[i].proved_worse = reduction, worse


def outcome(
    case: Case,
    diagnosis: Mapping[str, Any],
    oracle: Mapping[str, float] | None = None,
    seconds: float = 0.0,
    error: str = "",
) -> Outcome:
    """Compare a diagnosis with the truth of its case.

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
            (finding["effect"], float(finding["confidence"]), [other["effect"] for other in finding.get("alternatives", [])])
            for finding in diagnosis.get("findings", [])
        ],
        first_line=diagnosis.get("first_line", ""),
        next_step=diagnosis.get("next_step", ""),
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
    def channel_error(numbers: Mapping[str, float], channel: str) -> float:
        value = numbers.get(channel)
        return math.nan if value is None else float(value)

    reductions, best, ratios, worse = [], [], [], False
    for channel in before:
        b, a = channel_error(before, channel), channel_error(after, channel)
        f = channel_error(floor, channel) if channel in floor else 0.0
        if not math.isfinite(b):
            continue
        worse = worse or not a <= 1.05 * max(b, f)  # nan is worse
        o = math.nan if oracle is None else channel_error(oracle, channel)
        if b > 0.0 and b**2 - f**2 >= f**2:
            for reductions_found, left in ((reductions, a), (best, o)):
                reductions_found.append(1.0 - math.sqrt(max(left**2 - f**2, 0.0) / (b**2 - f**2)))
        if o > 0.0:
            ratios.append(a / o)
    result.worse = worse
    result.reduction = float(np.mean(reductions)) if reductions else None
    result.reachable = float(np.mean(best)) if best and np.isfinite(best).all() else None
    result.ratio = float(np.median(ratios)) if ratios else None


def scores(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """All figures; rates as `{"value", "count", "interval"}`, None where there is no such case."""

    def rate(group: Sequence[Outcome], hit: Callable[[Outcome], bool]) -> dict[str, Any] | None:
        hits = sum(hit(case_outcome) for case_outcome in group)
        if not group:
            return None
        return {"value": hits / len(group), "count": len(group), "interval": wilson_interval(hits, len(group))}

    def number(values: list[float]) -> dict[str, Any] | None:
        return {"value": float(np.median(values)), "count": len(values)} if values else None

    by_kind = {kind: [case_outcome for case_outcome in outcomes if case_outcome.kind == kind] for kind in (*KINDS, *ALONE)}
    weak = [case_outcome for case_outcome in by_kind["single"] if case_outcome.weak]
    with_effects = [case_outcome for case_outcome in outcomes if case_outcome.hidden]
    curve = calibration(outcomes)
    error = calibration_error(curve)
    rough = by_kind["rough"]
    errors = [abs(relative) for case_outcome in rough for relative, _ in case_outcome.identified.values()]
    return {
        "single": rate(by_kind["single"], lambda case_outcome: case_outcome.is_right),
        "single_strong": rate(
            [case_outcome for case_outcome in by_kind["single"] if not case_outcome.weak],
            lambda case_outcome: case_outcome.is_right,
        ),
        "weak": rate(weak, lambda case_outcome: case_outcome.is_right),
        "single_tied": rate(by_kind["single"], lambda case_outcome: case_outcome.is_tied),
        "single_spurious": rate(
            by_kind["single"],
            lambda case_outcome: bool(case_outcome.hidden and case_outcome.is_right and case_outcome.spurious_effects),
        ),
        "new": rate(by_kind["new"], lambda case_outcome: case_outcome.is_right),
        "new_tied": rate(by_kind["new"], lambda case_outcome: case_outcome.is_tied),
        "clutter": rate(by_kind["clutter"], lambda case_outcome: case_outcome.is_right),
        "clutter_spurious": rate(by_kind["clutter"], lambda case_outcome: bool(case_outcome.spurious_effects)),
        "clutter_overstated": rate(
            by_kind["clutter"],
            lambda case_outcome: bool(case_outcome.spurious_effects) and case_outcome.verdict == "explained",
        ),
        "hard": rate(by_kind["hard"], lambda case_outcome: case_outcome.is_right),
        "hard_weak": rate(
            [case_outcome for case_outcome in by_kind["hard"] if case_outcome.weak],
            lambda case_outcome: case_outcome.is_right,
        ),
        "hard_tied": rate(by_kind["hard"], lambda case_outcome: case_outcome.is_tied),
        "pairs": rate(by_kind["pairs"], lambda case_outcome: case_outcome.is_right),
        "pairs_one": rate(
            by_kind["pairs"], lambda case_outcome: bool(set(case_outcome.hidden) & set(case_outcome.named_effects))
        ),
        "pairs_spurious": rate(by_kind["pairs"], lambda case_outcome: bool(case_outcome.spurious_effects)),
        "false_alarms": rate(by_kind["none"], lambda case_outcome: not case_outcome.is_right),
        "abstentions": rate(by_kind["unknown"], lambda case_outcome: case_outcome.is_right),
        "unknown_missed": rate(by_kind["unknown"], lambda case_outcome: case_outcome.verdict == "no_discrepancy"),
        "confidently_wrong": rate(
            by_kind["unknown"],
            lambda case_outcome: bool(case_outcome.named_effects) and case_outcome.findings[0][1] >= CONFIDENT,
        ),
        "rough": rate(rough, lambda case_outcome: case_outcome.is_right),
        "rough_named": rate(rough, lambda case_outcome: bool(case_outcome.named_effects)),
        "rough_line": rate(rough, lambda case_outcome: case_outcome.says_rough),
        "rough_step": rate(rough, lambda case_outcome: case_outcome.sends_to_identify),
        "rough_identified": rate(
            rough,
            lambda case_outcome: (
                bool(case_outcome.identified) and case_outcome.worst_identified[1] <= case_outcome.conditions["uncertainty"]
            ),
        ),
        "rough_error": number(errors),
        "rough_worst": {"value": max(errors), "count": len(errors)} if errors else None,
        "gap_reduction": number(
            [case_outcome.reduction for case_outcome in with_effects if case_outcome.reduction is not None]
        ),
        "reachable": number([case_outcome.reachable for case_outcome in with_effects if case_outcome.reachable is not None]),
        "oracle_ratio": number([case_outcome.ratio for case_outcome in with_effects if case_outcome.ratio is not None]),
        "proved": number([case_outcome.proved for case_outcome in with_effects if case_outcome.proved is not None]),
        "proved_worse": rate(
            [case_outcome for case_outcome in outcomes if case_outcome.proved_worse is not None],
            lambda case_outcome: bool(case_outcome.proved_worse),
        ),
        "worse": rate(
            [case_outcome for case_outcome in outcomes if case_outcome.worse is not None],
            lambda case_outcome: bool(case_outcome.worse),
        ),
        "calibration_error": None if error is None else {"value": error, "count": sum(int(row["count"]) for row in curve)},
        "failed": rate(list(outcomes), lambda case_outcome: case_outcome.verdict == "failed"),
        "seconds": number([case_outcome.seconds for case_outcome in outcomes]),
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
    "rough": "rough numbers: no effect named, first line and next step right",
    "rough_named": "- an effect named, though none is missing",
    "rough_line": f"- first line: “{FIRST_LINE}”",
    "rough_step": f"- next step: `{NEXT_STEP}`",
    "rough_identified": "- `identify` finds every number within what the model states",
    "rough_error": "- error of a number by `identify`, median",
    "rough_worst": "- the largest",
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
_FINE = ("rough_error", "rough_worst")


def meets_target(key: str, value: float) -> bool | None:
    """True if a score meets its target; None if it has none."""
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
        text = f"{value:.3g}" if key in _PLAIN else f"{100 * value:{'.3g' if key in _FINE else '.1f'}} %"
        low, high = figure.get("interval", (None, None))
        interval = "" if low is None else f"{100 * low:.0f}-{100 * high:.0f} %"
        asked, mark = "", ""
        if key in TARGETS:
            target, more = TARGETS[key]
            target_text = f"{target:g}" if key in _PLAIN else f"{100 * target:g} %"
            asked, mark = f"{'≥' if more else '≤'} {target_text}", "met" if meets_target(key, value) else "**not met**"
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
        for (truth, finding), times in wrong.most_common():
            lines.append(f"| {truth} | {finding} | {times} | {counts[rows.index(truth)].sum()} |")
    lines += _by_condition([case_outcome for case_outcome in outcomes if case_outcome.kind in ("single", "hard")])
    lines += _identified_numbers([case_outcome for case_outcome in outcomes if case_outcome.identified])
    missed = [case_outcome for case_outcome in outcomes if not case_outcome.is_right]
    if missed:
        lines += ["", "Wrong: " + "; ".join(f"{case_outcome.name} ({_tells(case_outcome)})" for case_outcome in missed)]
    return "\n".join(lines) + "\n"


def _agrees(truth: str, finding: str) -> bool:
    return truth == finding or (truth.startswith("unknown.") and finding == "unknown_effect")


def _tells(case_outcome: Outcome) -> str:
    truth = " + ".join(case_outcome.hidden) or case_outcome.unknown or "nothing"
    text = (
        " + ".join(f"{effect} {confidence:.2f}" for effect, confidence, _ in case_outcome.findings)
        if case_outcome.named_effects
        else case_outcome.verdict
    )
    return f"{truth}, said {text}{': ' + case_outcome.error if case_outcome.error else ''}"


def _by_condition(group_outcomes: Sequence[Outcome]) -> list[str]:
    lines: list[str] = []
    for key in ("plant", "loop", "excitation", "initial_state", "period"):
        values = sorted({str(case_outcome.conditions[key]) for case_outcome in group_outcomes})
        for value in values:
            group = [case_outcome for case_outcome in group_outcomes if str(case_outcome.conditions[key]) == value]
            right = sum(case_outcome.is_right for case_outcome in group)
            lines.append(f"| {key} | {value} | {100 * right / len(group):.0f} % | {len(group)} |")
    return ["", "| single and hard, by | | right | cases |", "| --- | --- | ---: | ---: |", *lines] if lines else []


def _identified_numbers(rough: Sequence[Outcome]) -> list[str]:
    """Number of each case that `identify` finds worst."""
    lines = []
    for case_outcome in rough:
        path, _ = case_outcome.worst_identified
        relative, deviation = case_outcome.identified[path]
        median = float(np.median([abs(error) for error, _ in case_outcome.identified.values()]))
        lines.append(
            f"| {case_outcome.name} | {100 * median:.3g} % | {path} | {100 * relative:+.3g} ± {100 * deviation:.2g} % |"
        )
    header = ["", "| numbers by `identify` | median error | the worst | its error |", "| --- | ---: | --- | ---: |"]
    return [*header, *lines] if lines else []


def write(outcomes: Sequence[Outcome], folder: Path, heading: str = "") -> list[Path]:
    """Leave scores.md, scores.json, outcomes.json and the figures in a folder. Returns the figures' paths."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scores.md").write_text(markdown(outcomes, heading), encoding="utf-8")
    figures = {"scores": scores(outcomes), "calibration": calibration(outcomes)}
    (folder / "scores.json").write_text(json.dumps(figures, indent=1), encoding="utf-8")
    (folder / "outcomes.json").write_text(
        json.dumps([asdict(case_outcome) for case_outcome in outcomes], indent=1), encoding="utf-8"
    )
    return draw(outcomes, folder)
