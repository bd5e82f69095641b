"""What a diagnosis found: `diagnosis.json` with findings, numbers and notes, `trace.parquet`, and the study with what was
missing."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from jaxbl.config import Config, read_config, with_values
from jaxbl.drive.effects import EFFECTS, Numbers
from jaxbl.drive.parameters import units_of
from jaxbl.estimation.free_parameters import FreeParameter
from jaxbl.estimation.logs import run_of
from jaxbl.json_types import JsonObject
from jaxbl.records import POSITION_CHANNELS, Record
from jaxbl.simulate import Experiment

from .candidates import EffectNumbers, are_possible
from .choice import Chosen, Rival
from .confidence import Finding
from .diagnosis_task import input_rms
from .fitted_model import FittedModel, free_values
from .history import Step
from .judgement import Judgement
from .localise import Localised
from .neutral_effects import with_added
from .numbers_by_log import Contradiction
from .observer_residual import Observed, compared
from .proof import Proof
from .residuals import SideResiduals
from .sentences import sentence_of
from .setup import Setup
from .thresholds import LIMITS


def summary_of(setup: Setup, chosen: Chosen, history: Sequence[Step]) -> JsonObject:
    """Make the summary but for the proof, the verdict, and what the observers say."""
    task, record, located = setup.task, setup.task.record, setup.located
    fitted, found = chosen.fitted, chosen.found
    where = where_lacking(record, located)
    values, errors = free_values(fitted.free, fitted.theta), fitted.errors()
    notes = list(record.notes)
    if task.separate:
        notes += [f"{task.holdout.path.name}: {note}" for note in task.holdout.notes if note not in record.notes]
    for one in chosen.findings:
        if task.separate and EFFECTS[one.effect].in_time:
            notes.append(f"{one.effect} is taken to run from the start of each log in the same way.")
    if chosen.verdict == "no_discrepancy":
        for side, one in located.items():
            least = LIMITS.significant * one.coordinates["all"].regions[0].mean_error
            unit = record.unit_of(f"{side}.torque", "N m")
            notes.append(f"{side}: a steady torque of less than about {least:.2g} {unit} would not have been seen.")
    if (noise := setup.input_noise.unfelt) > 0.0:
        # a command is felt whole, if not as a torque
        measured = task.config.log.hold == "sampled" or record.corrections.get("u.sampled")
        not_felt = "that the drive does not feel" if measured else "that this motion does not show"
        notes.append(
            f"The channel u carries noise of {noise:.2g} {record.unit_of('motor.torque', 'N m')} rms "
            f"({noise / input_rms(record):.1%} of the input) {not_felt}: models are driven by u smoothed between its jumps."
        )
    return {
        **task.heading,
        # what has the larger torque matters more
        "findings": sorted(
            (
                describe_finding(record, one, values, errors, where)
                | {
                    "share": fitted.share(one.effect),
                    "z": found.gains[one.effect].standard_errors,
                    "in_log": EFFECTS[one.effect].in_log,
                }
                for one in chosen.findings
            ),
            key=lambda one: -one["share"],
        ),
        "parameters": describe_parameters(record, setup.own, values, errors),
        "numbers_off": chosen.numbers_off,
        "where": where,
        "rest": {name: {"evidence": gain, "share": share} for name, (gain, share) in found.rest.items()},
        "history": [step._asdict() for step in history],
        "notes": notes,
    }


def describe_parameters(record: Record, own: Sequence[FreeParameter], values: Numbers, errors: Numbers) -> JsonObject:
    """Describe the model's own numbers, by path, as in `diagnosis.json`; values and standard errors by path."""
    return {
        number.path: {
            "value": values[number.path],
            "standard_error": errors[number.path],
            "nominal": number.nominal,
            "unit": record.unit_of(number.path, number.unit),
        }
        for number in own
    }


def describe_finding(record: Record, one: Finding, values: Numbers, errors: Numbers, where: JsonObject) -> JsonObject:
    """Describe a finding but for its share and gain; values and standard errors by path, `where` by side."""
    units = units_of(EFFECTS[one.effect])
    numbers = {
        leaf: {
            "value": values.get(f"effects.{one.effect}.{leaf}", value),
            "standard_error": errors.get(f"effects.{one.effect}.{leaf}", 0.0),
            "unit": record.unit_of(f"{one.effect}.{leaf}", units[leaf]),
        }
        for leaf, value in one.numbers.items()
    }
    place = one.effect.partition(".")[0]
    side = "motor" if place == "actuator" else place
    sides = [side] if side in where else list(where)
    return {
        "effect": one.effect,
        "confidence": one.confidence,
        "parameters": numbers,
        "alternatives": [{"effect": name, "confidence": chance} for name, chance in one.alternatives],
        "where": {"place": place, "sentences": {side: where[side]["sentence"] for side in sides}},
    }


def summarise_test(judgement: Judgement, proof: Proof) -> JsonObject:
    """Say what the held-out errors of a complete model would be, which of them are larger, and the control."""
    expected = proof.expected
    before, after = (proof.log.with_slow(each) for each in (proof.before, proof.after))
    return {
        "expected": {name: error._asdict() for name, error in expected.items() if " below " not in name},
        "slow_torques": {
            name: {"before": before[name], "after": after[name]} | error._asdict()
            for name, error in expected.items()
            if " below " in name
        },
        "test": judgement.test,
        "controls": {"wrong": {"effect": one.effect, "rmse": one.errors, "z": one.z}} if (one := proof.control) else {},
    }


def contradictions_of(record: Record, fitted: FittedModel, found: Sequence[Contradiction]) -> list[JsonObject]:
    """Numbers that two logs show to be different, in the log's units."""
    units = {one.path: record.unit_of(one.path, one.unit) for one in fitted.free}
    return [
        {
            "parameter": one.path,
            "unit": units[one.path],
            "logs": [{"log": by.log, "value": by.value, "standard_error": by.error} for by in (one.least, one.most)],
        }
        for one in found
    ]


def where_lacking(record: Record, located: Mapping[str, Localised]) -> JsonObject:
    """Where a model lacks torque, by side, with sentences in the log's units."""
    return {
        name: dataclasses.asdict(one) | {"sentence": sentence_of(one, record.unit_of(f"{name}.torque", "N m"))}
        for name, one in located.items()
    }


def observers_say(
    nominal: Experiment, observed: Mapping[str, Sequence[Observed]], setup: Setup
) -> tuple[JsonObject, list[str]]:
    """What the observers of a model with their gains say of the torques that it lacks as given, by side, and notes where
    they say nothing."""
    found, notes = {}, []
    for side, pieces in observed.items():
        gains = getattr(nominal.observer, side).gains()
        found[side] = compared(nominal, pieces, setup.lacking[side], setup.fitted.bandwidth[side]) | {
            "gains": gains,
            "time_constant": float(nominal.equivalent_control.time_constant),
        }
        if not found[side]["converged"]:
            listed = ", ".join(f"{key} = {value:.3g}" for key, value in gains.items())
            notes.append(
                f"The {side}'s observer does not converge on this log ({listed}): its "
                "equivalent control says nothing of the missing torque. The verdict does not use it."
            )
    return found, notes


def extended_study(
    config: Config,
    numbers: EffectNumbers,
    values: Numbers,
    record: Record,
    tables: Sequence[JsonObject] = (),
) -> Config:
    """The study with effects more, some of them tables of torques, and with these numbers; at the log's period where
    effects cannot be simulated at its own (a dead time of more samples than a model remembers)."""
    data = config.to_dict()
    if not are_possible(numbers, config.run.sample_period):
        data["run"] = data.get("run", {}) | run_of(config, record)
    added = [*({"kind": name, **one} for name, one in numbers.items()), *tables]
    data["effects"] = with_added(data.get("effects", []), added, lambda one: one["kind"])
    return with_values(read_config(data), values)


def tied(summary: JsonObject) -> tuple[str, str] | None:
    """The finding that the rival stands for, and the rival; None where nothing is tied."""
    other = summary.get("rival", {}).get("effect")
    found = (one["effect"] for one in summary["findings"] if other in [each["effect"] for each in one["alternatives"]])
    name = next(found, None)
    return None if name is None else (name, other)


def rival_tables(config: Config, record: Record, own: Sequence[FreeParameter], rival: Rival) -> JsonObject:
    """The best model with another effect, as tables of a study."""
    data = extended_study(config, rival.fitted.numbers, free_values(own, rival.fitted.theta), record).to_dict()
    return {"effect": rival.effect} | {key: data[key] for key in ("run", "drive", "transmission", "effects") if key in data}


def trace_of(
    setup: Setup,
    proof: Proof,
    missing: Mapping[str, tuple[SideResiduals, SideResiduals]],
    observed: tuple[Mapping[str, list[Observed]], Mapping[str, list[Observed]]],
) -> pd.DataFrame:
    """One row a sample of the log, its held-out part included; of another log that was held out there is nothing.

    `missing` is what models lack on both parts, by the names of their columns; `observed` what the model as given lacks by
    the observers.
    """
    task = setup.task
    whole = task.record if task.separate else proof.record
    columns: JsonObject = {"t": whole.time, "u": whole.torque}
    columns |= {POSITION_CHANNELS[side]: whole.positions[side] for side in POSITION_CHANNELS if side in whole.positions}
    if setup.nominal.transmission is not None:
        columns["twist"] = setup.nominal.plant.twist(whole.positions)
    columns["held_out"] = np.arange(len(whole.time)) >= len(task.record.time)
    logs = [(task.record, setup.fitted.segments)] + ([] if task.separate else [(proof.record, proof.log.segments)])
    parts = [rows for record, _ in logs for rows in record.segments]

    def along(values: Iterable[Any]) -> np.ndarray:
        column = np.full(len(whole.time), np.nan)
        for rows, one in zip(parts, values, strict=True):
            column[rows] = one
        return column

    before, _ = missing["missing_before"]
    for side in before:
        for order, name in ((1, "velocity"), (2, "acceleration")):
            columns[f"{side}.{name}"] = along(one.smoothed[side].state[:, order] for _, segments in logs for one in segments)
        for name, torques in missing.items():
            pieces = [one for torque in torques[: len(logs)] for one in torque[side]]
            columns[f"{side}.{name}"] = along(one.torque for one in pieces)
            if name == "missing_before":
                columns[f"{side}.noise"] = along(one.deviation for one in pieces)
    for side in observed[0]:
        torque, noise = np.full((2, len(whole.time)), np.nan)
        for record, pieces in zip((task.record, proof.record), observed, strict=True):
            for part, one in zip(record.segments if pieces else (), pieces.get(side, ()), strict=True):
                if one.converged:
                    rows = slice(part.start + one.skipped, part.stop)
                    torque[rows], noise[rows] = one.residual.torque, one.residual.deviation
        columns |= {f"{side}.observed_before": torque, f"{side}.observed_noise": noise}
    return pd.DataFrame(columns)
