"""What a diagnosis found: `diagnosis.json` with findings, numbers and notes, `trace.parquet`, and the study with what was
missing."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from jaxbl.chain import Experiment, NamedArrays
from jaxbl.config import Config, read_config, with_values
from jaxbl.drive.effects import EFFECTS, Numbers
from jaxbl.drive.parameters import units_of
from jaxbl.estimation.free_parameters import FreeParameter, free_values
from jaxbl.estimation.log_columns import join_columns, recorded_columns
from jaxbl.estimation.logs import run_of
from jaxbl.json_types import JsonObject
from jaxbl.quantity import Quantity
from jaxbl.records import Record

from .candidates import EffectNumbers, are_possible
from .choice import Chosen
from .confidence import Finding
from .diagnosis_task import DiagnosisTask, input_rms
from .effect_search import Trial
from .history import Step, describe_history
from .judgement import Judgement
from .localise import Localised
from .neutral_effects import with_added
from .observer_residual import SideObserved, compare_observers
from .proof import Proof
from .reference_log import BELOW, Errors, ReferenceLog
from .residuals import SideResiduals
from .sentences import sentence_of
from .setup import Setup
from .thresholds import LIMITS


def summary_of(setup: Setup, chosen: Chosen, history: Sequence[Step], holdout_z: Numbers) -> JsonObject:
    """Make the summary but for the gap, the verdict, and what the observers say; `holdout_z` as of a proof."""
    task, record, located = setup.task, setup.task.record, setup.located
    fitted = chosen.fitted
    where = where_lacking(record, located)
    values, errors = free_values(fitted.free, fitted.theta), fitted.errors()
    notes = list(record.notes)
    if task.separate:
        notes += [f"{task.holdout.path.name}: {note}" for note in task.holdout.notes if note not in record.notes]
    for finding in chosen.findings:
        if task.separate and EFFECTS[finding.effect].in_time:
            notes.append(f"{finding.effect} is taken to run from the start of each log in the same way.")
    if chosen.verdict == "no_discrepancy":
        for side, place in located.items():
            least = LIMITS.significant * place.coordinates["all"].regions[0].mean_error
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
                describe_finding(record, finding, errors, where)
                | {
                    "share": fitted.share(finding.effect),
                    "z": chosen.explanation.gains[finding.effect].standard_errors,
                    "holdout_z": holdout_z.get(finding.effect),
                    "in_log": EFFECTS[finding.effect].in_log,
                }
                for finding in chosen.findings
            ),
            key=lambda finding: -finding["share"],
        ),
        "parameters": describe_parameters(record, setup.free, values, errors),
        "numbers_off": chosen.numbers_off,
        "where": where,
        "history": describe_history(history),
        "notes": notes,
    }


def describe_parameters(record: Record, free: Sequence[FreeParameter], values: Numbers, errors: Numbers) -> JsonObject:
    """Describe the model's own numbers, by path, as in `diagnosis.json`; values and standard errors by path."""
    return {
        number.path: Quantity(
            values[number.path], errors[number.path], unit=record.unit_of(number.path, number.unit), nominal=number.nominal
        ).to_dict()
        for number in free
    }


def describe_finding(record: Record, finding: Finding, errors: Numbers, where: JsonObject) -> JsonObject:
    """Describe a finding but for its share; standard errors by path, `where` by side."""
    units = units_of(EFFECTS[finding.effect])
    numbers = {
        leaf: Quantity(
            value,
            errors.get(f"effects.{finding.effect}.{leaf}", 0.0),
            unit=record.unit_of(f"{finding.effect}.{leaf}", units[leaf]),
        ).to_dict()
        for leaf, value in finding.numbers.items()
    }
    place = finding.effect.partition(".")[0]
    side = "motor" if place == "actuator" else place
    sides = [side] if side in where else list(where)
    return {
        "effect": finding.effect,
        "confidence": finding.confidence,
        "likely": finding.is_likely,
        "parameters": numbers,
        "alternatives": [{"effect": name, "confidence": chance} for name, chance in finding.alternatives],
        "where": {"place": place, "sentences": {side: where[side]["sentence"] for side in sides}},
    }


def describe_gap(setup: Setup, proof: Proof, judgement: Judgement) -> JsonObject:
    """Describe the errors on what was held out, before and after, their noise, what those of a complete model would be, and
    which are larger."""
    log, expected, noise = proof.log, proof.expected, proof.log.noise_of(proof.after)
    before, after = proof.before.errors, proof.after.errors
    names = [name for name in after if BELOW not in name]
    reach, there = _reach(setup.fitted), _reach(log)
    return {
        "holdout": {
            "file": str(proof.record.path.resolve()),
            "separate": setup.task.separate,
            "from": log.segments[0].time[0],
            "to": log.segments[-1].time[-1],
            "window": log.samples * log.period,
            "bandwidth": dict(log.bandwidth),
        },
        "units": {name: _unit(proof.record, name) for name in names},
        "driving": {"motor": proof.driving},
        "holdout_rmse_before": {name: before[name] for name in names},
        "holdout_rmse_after": {name: after[name] for name in names},
        "noise_floor": {name: noise[name] for name in names},
        "range": {name: {"log": reach[name], "proof": there[name]} for name in reach},
        "expected": {name: error._asdict() for name, error in expected.items() if name in names},
        "slow_torques": {
            name: {"before": before[name], "after": after[name]} | error._asdict()
            for name, error in expected.items()
            if name not in names
        },
        "test": judgement.test,
    }


def _reach(log: ReferenceLog) -> Errors:
    """Measure how far a log reaches: travel and largest speed of each side, and largest torque of the input."""
    reach = {name: np.ptp(values) for name, values in log.readings().items()}
    for side in log.noise:
        reach[f"velocity_{side}"] = max(np.max(np.abs(segment.smoothed[side].velocity)) for segment in log.segments)
    return reach | {"torque_motor": max(np.max(np.abs(segment.torque)) for segment in log.segments)}


_UNITS = {"theta": "rad", "velocity": "rad/s", "torque": "N m"}


def _unit(record: Record, name: str) -> str:
    side = "load" if name.endswith(("_s", "_load")) else "motor"
    return record.unit_of(f"{side}.position", _UNITS[name.split("_")[0]])


def where_lacking(record: Record, located: Mapping[str, Localised]) -> JsonObject:
    """Describe where a model lacks torque, by side, with sentences in the log's units."""
    return {
        name: dataclasses.asdict(place) | {"sentence": sentence_of(place, record.unit_of(f"{name}.torque", "N m"))}
        for name, place in located.items()
    }


def describe_observers(nominal: Experiment, observed: SideObserved, setup: Setup) -> tuple[JsonObject, list[str]]:
    """Compare the observers of a model, with their gains, to the torques that it lacks as given, by side; notes where they
    say nothing."""
    views, notes = {}, []
    for side, pieces in observed.items():
        gains = getattr(nominal.observer, side).gains()
        views[side] = compare_observers(nominal, pieces, setup.lacking[side], setup.fitted.bandwidth[side]) | {
            "gains": gains,
            "time_constant": float(nominal.equivalent_control.time_constant),
        }
        if not views[side]["converged"]:
            notes.append(
                f"The {side}'s observer does not converge on this log "
                f"({', '.join(f'{key} = {value:.3g}' for key, value in gains.items())}): its "
                "equivalent control says nothing of the missing torque. The verdict does not use it."
            )
    return views, notes


def extended_study(
    task: DiagnosisTask, numbers: EffectNumbers, values: Numbers, tables: Sequence[JsonObject] = ()
) -> Config:
    """The study of a task with effects more, some of them tables of torques, and with these numbers; at the log's period
    where effects cannot be simulated at its own (a dead time of more samples than a model remembers)."""
    data = task.config.to_dict()
    if not are_possible(numbers, task.config.run.sample_period):
        data["run"] = data.get("run", {}) | run_of(task.config, task.record)
    added = [*({"kind": name, **values_of} for name, values_of in numbers.items()), *tables]
    data["effects"] = with_added(data.get("effects", []), added)
    return with_values(read_config(data), values)


def find_tie(summary: JsonObject) -> tuple[str, str] | None:
    """The finding that the rival stands for, and the rival; None where nothing is tied."""
    other = summary.get("rival", {}).get("effect")
    ties = (
        (finding["effect"], other)
        for finding in summary["findings"]
        if other in [rival["effect"] for rival in finding["alternatives"]]
    )
    return next(ties, None)


def rival_tables(setup: Setup, rival: Trial) -> JsonObject:
    """The best model with another effect, as tables of a study."""
    data = extended_study(setup.task, rival.fitted.numbers, free_values(setup.free, rival.fitted.theta)).to_dict()
    tables = {key: data[key] for key in ("run", "drive", "transmission", "effects") if key in data}
    return {"effect": rival.added[0]} | tables


def trace_of(
    setup: Setup,
    proof: Proof,
    missing: Mapping[str, tuple[SideResiduals, SideResiduals]],
    observed: tuple[SideObserved, SideObserved],
) -> pd.DataFrame:
    """One row a sample of the log, its held-out part included; of another log that was held out there is nothing.

    `missing` is what models lack on both parts, by the names of their columns; `observed` what the model as given lacks by
    the observers.
    """
    task = setup.task
    joined = task.record if task.separate else proof.record
    columns = recorded_columns(joined, joined.positions)
    if setup.nominal.transmission is not None:
        columns["twist"] = setup.nominal.plant.twist(joined.positions)
    columns["held_out"] = np.arange(len(joined.time)) >= len(task.record.time)
    segments, pieces = [], []
    for part, log in enumerate([setup.fitted] if task.separate else [setup.fitted, proof.log]):
        for i, segment in enumerate(log.segments):
            piece: NamedArrays = {}
            for side, smoothed in segment.smoothed.items():
                piece |= {f"{side}.velocity": smoothed.velocity, f"{side}.acceleration": smoothed.acceleration}
                residuals = {name: torques[part][side][i] for name, torques in missing.items()}
                piece |= {f"{side}.{name}": residual.torque for name, residual in residuals.items()}
                piece[f"{side}.noise"] = residuals["missing_before"].deviation
                by_observer = observed[part][side][i]
                for name, values in (("before", by_observer.residual.torque), ("noise", by_observer.residual.deviation)):
                    estimate = values if by_observer.has_converged else np.full_like(values, np.nan)
                    piece[f"{side}.observed_{name}"] = np.append(np.full(by_observer.skipped, np.nan), estimate)
            segments.append(segment)
            pieces.append(piece)
    return pd.DataFrame(columns | join_columns(len(joined.time), segments, pieces))
