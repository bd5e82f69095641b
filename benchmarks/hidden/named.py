"""Names that each effect of a workshop may be given, and what answers are worth by them.

The table is `NAMES`. An effect is named if some finding has one of its names (of cogging also the right number of waves). An
answer names the main effect if the one with the largest rms torque is named, and all if each is. A finding that no effect of
the truth allows, and that the truth does not list as `optional`, is wrong; surely wrong above `SURE`.

Friction that bends before it slides contains dry friction, and the bench's does bend: both names are right. A Stribeck
friction is right where the friction falls with speed; where it does not, dry friction is named, and more besides, which is
wrong: it counts as both. Friction under load is dry friction to a
model with one inertia. Cogging may be named by its multiples. One wave a turn is the weight of an unbalanced wheel.

Of numbers alone an answer is right if it names no effect, or says that numbers are further off than stated.
"""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .bristle import Axis, Drive
from .outcomes import NUMBERS_FURTHER_OFF, bets_calibration, calibration_error, wilson_interval

_DRY = ("coulomb_friction", "presliding_friction")
_COGGING = ("motor.cogging", "motor.cogging_harmonics")
NAMES: dict[str, tuple[str, ...]] = {
    "dry": tuple(f"motor.{kind}" for kind in _DRY),
    "under_load": ("transmission.load_friction",),
    "cogging": _COGGING,
    "gravity": ("load.gravity",),
    "offset": ("motor.constant_torque",),
    "eccentricity": ("transmission.eccentricity",),
}
"""Effect of the truth -> names that are right on any machine; :func:`admissible_names` adds those of some."""
TRUTH = "the machine itself"
"""What has the true numbers and laws, beside the tools."""
SURE = 0.95
"""Confidence above which a wrong name is surely wrong."""
_SEEN = 2.0
"""Steps of both encoders by which friction has to wind up a gear, or its side cannot be told."""


def admissible_names(effect: str, axis: Axis, drive: Drive) -> dict[str, Any]:
    """`names` of an effect on a machine and, of cogging, `waves`: the numbers a turn that are right."""
    names = list(NAMES[effect])
    dry = list(NAMES["dry"]) + ["motor.stribeck_friction"] * (axis.rise >= 1.05)
    if effect == "dry":
        names = dry
        if axis.geared and axis.friction / axis.stiffness < _SEEN * (drive.motor_step + axis.ratio * drive.load_step):
            names = names + [name.replace("motor.", "load.") for name in names]
    if effect == "under_load" and not axis.geared:
        names += dry
    if effect == "offset" and axis.geared:
        names.append("load.constant_torque")
    if effect == "gravity" and not axis.geared:
        return {"names": [*names, *_COGGING], "waves": [1]}
    return {"names": names} | (
        {"waves": [round(axis.waves)] + [round(2 * axis.waves)] * (axis.double > 0.0)} if effect == "cogging" else {}
    )


def is_named(effect: Mapping[str, Any], finding: Mapping[str, Any]) -> bool:
    """Return True if a finding names an effect of the truth."""
    name = finding["effect"]
    if name not in effect["names"]:
        return False
    if name not in _COGGING:
        return True
    number = finding["parameters"]["harmonic"]
    base = round(number["value"] if isinstance(number, Mapping) else number)
    multiples = (1, 2, 3) if name == "motor.cogging_harmonics" else (1,)
    return any(base * k in effect["waves"] for k in multiples)


def overstates(effect: Mapping[str, Any], finding: Mapping[str, Any]) -> bool:
    """Return True if a finding names a friction of the truth, and says that it falls with speed, which it does not."""
    name = finding["effect"]
    return name not in effect["names"] and name.replace("stribeck", "coulomb") in effect["names"]


def score(truth: Mapping[str, Any], answer: Mapping[str, Any]) -> dict[str, Any]:
    """What an answer is worth: `main`, `all` (bool), `wrong` (indices of findings), `bets` (confidence, right), `missed`.

    Args:
        truth: `effects` (largest first, with their `names`), `optional`, as in truth.json.
        answer: `findings` (effect, confidence, parameters), `lines` of the report, `error`.
    """
    findings, effects = answer.get("findings", []), truth["effects"]
    hits = [(finding, any(is_named(effect, finding) for effect in effects)) for finding in findings]
    named = [any(is_named(effect, finding) or overstates(effect, finding) for finding in findings) for effect in effects]
    optional = truth["optional"]
    wrong = [i for i, (finding, hit) in enumerate(hits) if not hit and finding["effect"] not in optional]
    says_rough = NUMBERS_FURTHER_OFF in " ".join(answer.get("lines", []))
    alone = not effects
    right_alone = not answer.get("error") and (not wrong or says_rough)
    return {
        "main": right_alone if alone else named[0],
        "all": right_alone if alone else all(named),
        "wrong": [] if alone and says_rough else wrong,
        "bets": [
            (finding["confidence"], hit) for finding, hit in hits
            if finding["effect"] not in optional and not (alone and says_rough) and math.isfinite(finding["confidence"])
        ],
        "missed": [effect["effect"] for effect, hit in zip(effects, named, strict=True) if not hit],
    }  # fmt: skip


_TERMS = {
    "Coulomb": "motor.coulomb_friction",
    "constant": "motor.constant_torque",
    "quadratic drag": "motor.quadratic_drag",
    "viscous by direction": "motor.asymmetric_friction",
    "viscous": "motor.viscous_friction",
    "twist rate": "transmission.damping",
    "twist cubed": "transmission.hardening",
    "friction under load": "transmission.load_friction",
}


def findings_of_terms(
    names: Sequence[str], base: Sequence[str], geared: bool, known: Sequence[str] = ()
) -> list[dict[str, Any]]:
    """The terms that a regression added to a nominal model with some `known` effects, as findings without confidence."""
    findings, of_model = [], [name for effect in known for name in NAMES[effect]]
    for name in names:
        if name in base:
            continue
        finding: dict[str, Any] = {"confidence": math.nan, "parameters": {}}
        waves = re.fullmatch(r"(\d+) a (load )?turn", name)
        if waves and waves[2]:
            finding["effect"] = "transmission.eccentricity"
        elif waves and waves[1] == "1" and not geared:
            finding["effect"] = "load.gravity"
        elif waves:
            finding |= {"effect": "motor.cogging", "parameters": {"harmonic": int(waves[1])}}
        else:
            finding["effect"] = _TERMS.get(name, "motor.stribeck_friction" if name.startswith("Stribeck") else name)
        if finding["effect"] not in of_model:
            findings.append(finding)
    return findings


# ---- tables ----


def rate_text(hits: int, count: int) -> str:
    """Count of hits with its 95 % interval by Wilson."""
    low, high = wilson_interval(hits, count)
    return f"{hits} of {count} ({100 * low:.0f}-{100 * high:.0f} %)"


Answers = Mapping[str, Mapping[str, Any]]
"""Case -> answer of a tool, with the `score` of :func:`score`."""


def _left_text(tool: str, names: Sequence[str], left: Mapping[str, Mapping[str, Any]], rivals: Sequence[str]) -> str:
    """Median over cases of the torque that a tool leaves over the least of the other rivals."""
    ratios = []
    for name in names:
        torques = left.get(name, {})
        others = [value for rival in rivals if rival != tool and (value := torques.get(rival)) is not None]
        if others and torques.get(tool) is not None:
            ratios.append(torques[tool] / min(others))
    return f"{np.median(ratios):.2f} ({sum(ratio < 1.0 for ratio in ratios)} of {len(ratios)} less)" if ratios else "-"


def _tool_row(
    tool: str, truths: Answers, answers: Answers, left: Mapping[str, Mapping[str, float]], rivals: Sequence[str]
) -> str:
    scores = {name: score(truths[name], answer) for name, answer in answers.items()}
    with_effects = [name for name in answers if truths[name]["effects"]]
    alone = [name for name in answers if not truths[name]["effects"]]
    wrong = [answers[name]["findings"][i]["confidence"] for name, result in scores.items() for i in result["wrong"]]
    sure = sum(confidence > SURE for confidence in wrong)
    with_wrong = sum(bool(result["wrong"]) for result in scores.values())
    error = calibration_error(bets_calibration([bet for result in scores.values() for bet in result["bets"]]))
    seconds = [answer["seconds"] for answer in answers.values() if answer.get("seconds")]
    failures = [answer["failure"] for answer in answers.values() if answer.get("failure")]
    cells = [
        rate_text(sum(scores[name]["main"] for name in with_effects), len(with_effects)),
        rate_text(sum(scores[name]["all"] for name in with_effects), len(with_effects)),
        rate_text(sum(scores[name]["all"] for name in alone), len(alone)) if alone else "-",
        f"{len(wrong)} in {rate_text(with_wrong, len(answers))}",
        str(sure) if any(math.isfinite(confidence) for confidence in wrong) or not wrong else "-",
        f"{failures.count('refused')} + {failures.count('traceback')}",
        f"{np.median(seconds):.0f}" if seconds else "-",
        _left_text(tool, list(answers), left, rivals),
        "-" if error is None else f"{error:.3f}",
    ]
    return f"| {tool} | {' | '.join(cells)} |"


def tables(
    truths: Answers,
    tools: Mapping[str, Answers],
    left: Mapping[str, Mapping[str, float]],
    rivals: Sequence[str],
    heading: str,
) -> str:
    """All tables as Markdown: tools, recipes, pairs of tools, cases.

    Args:
        truths: case -> truth.json.
        tools: tool -> case -> answer; all that follows is over the cases that every tool has answered.
        left: case -> tool -> rms torque error on the held-out part, N m.
        rivals: tools with which the torque that is left is compared.
        heading: of the whole.
    """
    names = [name for name in truths if all(name in answers for answers in tools.values())]
    tools = {tool: {name: answers[name] for name in names} for tool, answers in tools.items()}
    lines = (
        [f"## {heading}", "", f"{len(names)} cases that all tools have answered."]
        if len(names) < len(truths)
        else [f"## {heading}"]
    )
    lines += [
        "",
        "| tool | main effect | all effects | numbers alone | wrong effects | of them sure | refused + traceback | s | ",
    ]
    lines[-1] += "torque left, over the best rival's | calibration error |"
    lines.append("|---|---|---|---|---|---:|---:|---:|---|---:|")
    lines += [_tool_row(tool, truths, answers, left, rivals) for tool, answers in tools.items()]
    # the others name nothing
    nameless = [tool for tool in rivals if tool not in tools]
    nameless += [TRUTH] if any(TRUTH in torques for torques in left.values()) else []
    lines += [f"| {tool} |{' - |' * 7} {_left_text(tool, names, left, rivals)} | - |" for tool in nameless]
    scores = {
        tool: {name: score(truths[name], answer) for name, answer in answers.items()} for tool, answers in tools.items()
    }
    recipes = list(dict.fromkeys(truths[name]["recipe"] for name in names))
    lines += ["", f"| recipe: main, all of | cases | {' | '.join(tools)} |", f"|---|---:|{'---|' * len(tools)}"]
    for recipe in recipes:
        group = [name for name in names if truths[name]["recipe"] == recipe]
        cells = [
            f"{sum(results[name]['main'] for name in group)}, {sum(results[name]['all'] for name in group)}"
            for results in scores.values()
        ]
        lines.append(f"| {recipe} | {len(group)} | {' | '.join(cells)} |")
    first, *others = tools
    if others:
        lines += ["", f"| {first} against | main: both, first alone, other alone, neither | all |", "|---|---|---|"]
        for other in others:
            cells = []
            for key in ("main", "all"):
                pairs = [(scores[first][name][key], scores[other][name][key]) for name in names]
                cells.append(
                    ", ".join(
                        str(pairs.count(pair)) for pair in ((True, True), (True, False), (False, True), (False, False))
                    )
                )
            lines.append(f"| {other} | {' | '.join(cells)} |")
    lines += ["", f"| case | truth | {' | '.join(tools)} |", f"|---|---|{'---|' * len(tools)}"]
    for name in names:
        truth = truths[name]
        effects = ", ".join(f"{effect['effect']} {effect['share']:.2f}{_waves_text(effect)}" for effect in truth["effects"])
        cells = [_answer_text(answers[name], scores[tool][name]) for tool, answers in tools.items()]
        lines.append(f"| {name} {truth['recipe']} | {effects or 'numbers alone'} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _waves_text(effect: Mapping[str, Any]) -> str:
    return f" ({effect['waves'][0]} waves)" if effect["effect"] == "cogging" else ""


_SHOWN = 10
"""Findings of an answer that a table shows."""


def _answer_text(answer: Mapping[str, Any], result: Mapping[str, Any]) -> str:
    if answer.get("error"):
        return f"{answer.get('failure', 'failed')}: {answer['error'].splitlines()[-1][:90]}".replace("|", "/")
    mark = "all" if result["all"] else "main" if result["main"] else "**missed**"
    found = []
    for i, finding in enumerate(answer.get("findings", [])):
        harmonic = finding["parameters"].get("harmonic", "")
        harmonic = harmonic["value"] if isinstance(harmonic, Mapping) else harmonic
        text = finding["effect"].split(".", 1)[-1] + (f" {harmonic:.4g}" if harmonic else "")
        text += f" {finding['confidence']:.2f}" if math.isfinite(finding["confidence"]) else ""
        found.append(f"_{text}_" if i in result["wrong"] else text)
    more = [f"and {len(found) - _SHOWN} more"] if len(found) > _SHOWN else []
    return f"{mark}: {', '.join([*found[:_SHOWN], *more]) or 'nothing'}"
