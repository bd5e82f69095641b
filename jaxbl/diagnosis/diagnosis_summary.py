"""What a diagnosis found: `diagnosis.json` with findings, numbers and notes, and the study with what was missing."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from jaxbl.config import Config, read_config, with_values
from jaxbl.drive.effects import EFFECTS
from jaxbl.drive.parameters import parameters
from jaxbl.identification.logs import unit_on
from jaxbl.identification.trajectory import Free
from jaxbl.records import Record
from jaxbl.simulate import Experiment

from .diagnosis_task import DiagnosisTask, input_rms
from .effect_search import FAR, Explanation, Finding, Model
from .localise import SIGNIFICANT, Localised
from .neutral_effects import with_added
from .observer_residual import Observed, compared
from .proof import FittedModel, free_values
from .sentences import sentence_of
from .setup import Setup


def summary_of(
    task: DiagnosisTask, setup: Setup, fitted: FittedModel, found: Explanation, withdrawn: Sequence[str]
) -> dict[str, Any]:
    """The summary but for the proof, and for what the observers say.

    Args:
        task: study and logs.
        setup: of the diagnosis.
        fitted: the model with what was found.
        found: the explanation, without what was withdrawn.
        withdrawn: effects that were found and withdrawn.
    """
    record, located = task.record, setup.located
    where = where_lacking(record, located)
    values, errors = fitted.values, fitted.errors()
    notes = list(record.notes)
    if task.separate:
        notes += [f"{task.holdout.path.name}: {note}" for note in task.holdout.notes if note not in record.notes]
    notes += [f"{name} was found, and withdrawn: with it the held-out data are met no better." for name in withdrawn]
    timed = [
        one.effect for one in found.findings if any(r.kind == "frequency" for r in EFFECTS[one.effect].roles().values())
    ]
    if task.separate:
        notes += [f"The phase of {name} is taken to be the same at the start of both logs." for name in timed]
    if found.verdict == "no_discrepancy":
        notes += _least_seen(record, located)
    own = [one for one in fitted.free if not any(one.path.startswith(f"effects.{name}.") for name in fitted.names)]
    notes += _far_off(own, values, task.config.uncertainty.relative)
    if setup.torque_noise > 0.0:
        notes.append(_noise_note(record, setup.torque_noise))
    return {
        "title": task.config.title,
        "identity": task.identity,
        "file": str(record.path.resolve()),
        "samples": len(record.time),
        "sample_period": record.sample_period,
        "verdict": found.verdict,
        "findings": [_finding(task, one, values, errors, where, located) for one in found.findings],
        "parameters": {
            one.path: {
                "value": values[one.path],
                "standard_error": errors[one.path],
                "nominal": one.nominal,
                "unit": unit_on(record, one.path, one.unit),
            }
            for one in own
        },
        "where": where,
        "rest": {name: {"evidence": gain, "share": share} for name, (gain, share) in found.rest.items()},
        "withdrawn": list(withdrawn),
        "notes": notes,
    }


def _finding(
    task: DiagnosisTask,
    one: Finding,
    values: Mapping[str, float],
    errors: Mapping[str, float],
    where: Mapping[str, Any],
    located: Mapping[str, Localised],
) -> dict[str, Any]:
    prefix, known = f"effects.{one.effect}", dict.fromkeys(one.numbers)
    units = {field.name: about.unit for field, about in parameters(EFFECTS[one.effect])}
    numbers = {
        leaf: {
            "value": values.get(f"{prefix}.{leaf}", one.numbers[leaf]),
            "standard_error": errors.get(f"{prefix}.{leaf}", 0.0),
            "unit": unit_on(task.record, f"{one.effect}.{leaf}", units[leaf]),
        }
        for leaf in known
    }
    place = one.effect.partition(".")[0]
    sides = {"motor": ["motor"], "actuator": ["motor"]}.get(place, ["load"] if place == "load" else list(located))
    sides = [side for side in sides if side in located] or list(located)
    return {
        "effect": one.effect,
        "confidence": one.confidence,
        "parameters": numbers,
        "alternatives": [{"effect": name, "confidence": chance} for name, chance in one.alternatives],
        "where": {"place": place, "sentences": {side: where[side]["sentence"] for side in sides}},
    }


def where_lacking(record: Record, located: Mapping[str, Localised]) -> dict[str, Any]:
    """Where a model lacks torque, by equation, with sentences in the log's units."""
    return {
        name: dataclasses.asdict(one) | {"sentence": sentence_of(one, unit_on(record, f"{name}.torque", "N m"))}
        for name, one in located.items()
    }


def _far_off(own: Sequence[Free], values: Mapping[str, float], uncertainty: float) -> list[str]:
    """Which numbers of the model ended where they hardly can be, as it says itself."""
    lines = []
    for one in own:
        change = values[one.path] / one.nominal - 1.0 if one.nominal else 0.0
        if abs(change) > FAR * uncertainty:
            lines.append(
                f"{one.path} had to change by {change:+.0%}, {abs(change) / uncertainty:.0f} times its [uncertainty]: "
                "findings and it may compensate each other. Noise of the torque channel does it, or too small a relative."
            )
    return lines


def _noise_note(record: Record, noise: float) -> str:
    unit = unit_on(record, "motor.torque", "N m")
    return (
        f"The channel u carries noise of {noise:.2g} {unit} rms ({noise / input_rms(record):.1%} of the input) that the "
        "drive does not feel: models are driven by u smoothed between its jumps."
    )


def _least_seen(record: Record, located: Mapping[str, Localised]) -> list[str]:
    """What would not have been seen."""
    unit = {side: unit_on(record, f"{side}.torque", "N m") for side in located}
    lines = []
    for side, one in located.items():
        least = SIGNIFICANT * one.coordinates["all"].regions[0].mean_error
        lines.append(f"{side}: a steady torque of less than about {least:.2g} {unit[side]} would not have been seen.")
    return lines


def observers_say(
    nominal: Experiment, observed: Mapping[str, Sequence[Observed]], setup: Setup
) -> tuple[dict[str, Any], list[str]]:
    """What the observers say of the torques that the model as given lacks, by side, and notes where they say nothing.

    Args:
        nominal: the model with the observers' gains.
        observed: what they see on the log, segment by segment.
        setup: of the diagnosis.
    """
    found, notes = {}, []
    for side, pieces in observed.items():
        gains = getattr(nominal.observer, side)
        found[side] = compared(nominal, pieces, setup.lacking[side], setup.fitted.bandwidth[side]) | {
            "gains": {"lambda": float(gains.lambda_), "alpha": float(gains.alpha)},
            "time_constant": float(nominal.equivalent_control.time_constant),
        }
        if not found[side]["converged"]:
            notes.append(
                f"The {side}'s observer does not converge on this log (alpha = {float(gains.alpha):.3g}): its "
                "equivalent control says nothing of the missing torque. The verdict does not use it."
            )
    return found, notes


def extended_study(config: Config, numbers: Mapping[str, Mapping[str, float]], values: Mapping[str, float]) -> Config:
    """The study with effects more, and with these numbers."""
    return with_values(_with_effects(config.resolved(), numbers), values)


def _with_effects(data: dict[str, Any], numbers: Mapping[str, Mapping[str, Any]]) -> Config:
    added = [{"kind": name, **one} for name, one in numbers.items()]
    data["effects"] = with_added(data.get("effects", []), added, lambda one: one["kind"])
    return read_config(data)


def rival_tables(config: Config, own: Sequence[Free], rival: Model) -> dict[str, Any]:
    """The best model with another effect, as tables of a study."""
    values = {path: float(value) for path, value in free_values(own, rival.theta).items()}
    data = extended_study(config, {name: rival.numbers[name] for name in rival.names}, values).resolved()
    return {"effect": rival.names[-1]} | {key: data[key] for key in ("drive", "transmission", "effects") if key in data}
