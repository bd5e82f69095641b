"""What a model lacks, from the motor's encoder and torque alone: a gap, and dry friction on either side of it.

Other effects are not sought: without the load's encoder most of them look alike. All of these are put into the model at
once and fitted (:mod:`jaxbl.estimation.unseen_load`); then those without which the log is met as well are taken out, one
after the other. The held-out data are predicted with the numbers found, initial states alone fitted.
Reference: R. Kass, A. Raftery, Bayes factors, J. American Statistical Association 90 (1995), for the probabilities.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.special import expit

from jaxbl.chain import Experiment, with_effects
from jaxbl.config import Config
from jaxbl.drive.effects import EFFECTS, AbstractEffect, Numbers, make_effect
from jaxbl.drive.parameters import as_arrays, units_of
from jaxbl.estimation.free_parameters import FreeParameter, make_free_parameters
from jaxbl.estimation.logs import default_paths, on_record
from jaxbl.estimation.motor_alone import Alone, alone_of, alone_on_holdout, columns_alone, gap_summary, search_gap
from jaxbl.estimation.segments import segments_of, signal_sizes
from jaxbl.estimation.unseen_load import SHOWN, Point, UnseenLoad, widths
from jaxbl.json_types import JsonObject
from jaxbl.lines import percent
from jaxbl.records import Record
from jaxbl.workers import announce

from .candidates import EffectNumbers
from .confidence import Finding
from .diagnosis_summary import describe_finding, describe_parameters, extended_study
from .diagnosis_task import DiagnosisTask, input_rms
from .history import Step, describe_history
from .judgement import judge_answers
from .neutral_effects import candidates, with_added
from .thresholds import LIMITS

_SMALL = 1e-6
"""Dry friction that stands for none, over the input's rms."""
_NOISE_ERROR = 0.25
"""Relative error of an estimated noise."""
_LEAST = 0.01
"""Torque over the driving torque that is too small to be named: without the load's encoder ten times that with it."""


class _Search(NamedTuple):
    """The model with all effects that are sought.

    Attributes:
        model: with its own numbers and theirs free.
        effects: name -> place of its number among these.
        none: theta of the model as given: effects at next to nothing.
        expected: names of effects that surely act.
    """

    model: UnseenLoad
    effects: dict[str, int]
    none: np.ndarray
    expected: Collection[str] = ()

    @property
    def free(self) -> Sequence[FreeParameter]:
        """The model's own numbers, which are the first."""
        return self.model.free[: len(self.none) - len(self.effects)]

    @property
    def play(self) -> list[str]:
        """Name of the effect that is a gap, if one is sought."""
        return [name for name, i in self.effects.items() if i == self.model.gap]

    def without(self, names: Sequence[str]) -> UnseenLoad:
        """The model in which some effects do nothing."""
        return replace(self.model, held=[self.effects[name] for name in names])

    def finish(self, point: Point, names: Sequence[str]) -> Point:
        """Fit without some effects, from a point with them."""
        model, theta = self.without(names), point.theta.copy()
        theta[model.held] = self.none[model.held]
        return model.finish(model.evaluate(point._replace(theta=theta)))


def list_sought(experiment: Experiment, exact: Collection[str] = ()) -> list[str]:
    """Names of the effects that the motor alone can show and a model lacks: free play, and dry friction of one level.

    `exact`: names of effects that are surely not missing.
    """
    names = []
    taken = {(effect.exclusive, effect.place) for effect in experiment.effects}
    for name in candidates(experiment):
        if name in exact:
            continue
        cls, place = EFFECTS[name], name.partition(".")[0]
        numbers = [role.kind for role in cls.roles().values()]
        play = cls.free_play is not AbstractEffect.free_play and cls.suits(experiment.transmission)
        dry = cls.dry_friction is not AbstractEffect.dry_friction and numbers == ["size"]
        if play or (dry and place in ("motor", "load") and (cls.exclusive, place) not in taken):
            names.append(name)
    return names


def _set_up(task: DiagnosisTask) -> _Search:
    config, record = task.config, task.record
    bare = on_record(config, record)
    names, size, ratio = list_sought(bare, config.uncertainty.exact), input_rms(record), float(bare.drive.ratio("load"))
    # the fit chooses where it begins; these are scales
    first = {
        name: dict.fromkeys(units_of(EFFECTS[name]), 0.1 * size * (ratio if name.startswith("load.") else 1.0))
        for name in names
    }
    added = [as_arrays(make_effect(name, **numbers), float) for name, numbers in first.items()]
    model = with_effects(bare, tuple(with_added(bare.effects, added)))
    own_paths = default_paths(config, bare)
    paths = [f"effects.{name}.{next(iter(numbers))}" for name, numbers in first.items()]
    at_rest = config.log.initial_state == "rest"
    segments = segments_of(record, ["motor"], at_rest)
    free = make_free_parameters(model, [*own_paths, *paths], signal_sizes(bare, segments))
    width = widths(free, np.e)
    width[: len(own_paths)] = config.uncertainty.relative
    effects = {name: len(own_paths) + i for i, name in enumerate(names)}
    # what the model as given has: its own numbers, and next to none of the effects
    none = np.array([0.0 if i < len(own_paths) else np.log(_SMALL) for i in range(len(free))])
    return _Search(UnseenLoad(model, free, width, segments, at_rest), effects, none, config.uncertainty.expected)


def diagnose_alone(task: DiagnosisTask, done: Callable[[], None]) -> tuple[Config, Record, JsonObject, pd.DataFrame]:
    """Do a diagnosis without the load's encoder; `done` is called after each of its three stages.

    Returns:
        The study with what was missing, what was held out, `diagnosis.json`, and the trace.

    Raises:
        InputError: a model that diverges.
    """
    search = _set_up(task)
    # the model's own, or one that it lacks
    gap, point = search_gap(search.model, task.record)
    done()
    announce("comparing effects")
    history: list[Step] = []
    # a gap of its own stays as free as it is
    out, point = ([], gap.best) if gap is not None and (gap.is_needed or not search.play) else (search.play, point)
    # frictions without which the log is met as well go one after the other
    while True:
        frictions = [name for name in search.effects if name not in (*out, *search.play)]
        points = {name: search.finish(point, [*out, name]) for name in frictions}
        inflation, gains = search.without(out).spread(point).inflation, dict[str, float]()
        # minus twice the log-likelihood by which a friction makes the fit better, correlation of the errors counted; without
        # the prior of its level: none at all is far from any level that a fit begins with
        for name, less in points.items():
            i = search.effects[name]
            prior = (less.theta[i] ** 2 - point.theta[i] ** 2) / search.model.width[i] ** 2
            gains[name] = float((less.deviance - point.deviance - prior) / max(inflation[i] ** 2, 1.0))
        least = min(gains.keys() - {*search.expected}, key=lambda name: gains[name], default=None)
        needless = None if least is None or gains[least] >= SHOWN else least
        for name, gain in gains.items():
            history.append(Step(f"remove {name}", -0.5 * gain, None, name == needless, f"{0.5 * SHOWN:g} nats are asked"))
        if needless is None:
            break
        out.append(needless)
        point = points[needless]
    gains |= {name: gap.gain for name in search.play if gap is not None}
    model = search.without(out)
    alone = alone_of(search.model, *model.settle(point), model.held, gap, np.e, task.record)
    done()
    announce("testing on held-out data")
    # names and numbers stand: only the verdict depends on what was held out
    held_out = task.holdout.open()
    paths = {name: model.free[i].path for name, i in search.effects.items() if name not in out}
    numbers = {name: {path.rpartition(".")[2]: alone.values[path]} for name, path in paths.items()}
    summary = _summary(task, held_out, search, alone, gains, numbers) | {"history": describe_history(history)}
    numbers_of_model = {number.path: alone.values[number.path] for number in search.free}
    study = extended_study(task, numbers, numbers_of_model)
    done()
    return study, held_out, summary, pd.DataFrame(columns_alone(task.record, alone))


def _summary(
    task: DiagnosisTask, held_out: Record, search: _Search, alone: Alone, gains: Numbers, numbers: EffectNumbers
) -> JsonObject:
    """Make `diagnosis.json`, but for the history; `numbers` of the effects that are left."""
    record, model, values = task.record, search.model, alone.values
    noise, unit = model.noise, record.unit_of("motor.position", "rad")
    deviations, errors = alone.search_fit.spread.deviations, dict.fromkeys(values, float("nan"))
    errors |= {number.path: values[number.path] * deviations[i] for i, number in enumerate(alone.search_fit.free)}
    holdout = alone_on_holdout(held_out, alone, search.none)["position"]["motor"]
    limit = (1.0 + _NOISE_ERROR) * max(alone.point.variance**0.5, noise)
    left, size = model.measure_unexplained(alone.point), input_rms(record)
    # noise of the recorded torque, which is known within a factor of two
    allowed = max(2.0 * model.torque_noise, _LEAST * size)
    away = alone.point.theta / task.config.uncertainty.relative
    far = {number.path: z for number, z in zip(search.free, away, strict=False) if abs(z) > LIMITS.far}
    names = [name for name in numbers if not (alone.doubtful and name in search.play)]
    failed, remainder = ["theta_e"] if holdout["rms"] > limit else [], left > allowed
    # where no more is left than a complete model leaves, neither model is better
    worse = bool(failed) and holdout["rms"] > holdout["nominal_rms"]
    answers = {"failed": failed, "far": far, "remainder": remainder, "worse": worse, "doubtful": alone.doubtful}
    judgement = judge_answers(names, answers)
    force = record.unit_of("motor.torque", "N m")
    before, after = holdout["nominal_rms"] ** 2, holdout["rms"] ** 2
    sentence = (
        f"motor side: the model as given predicts it to {holdout['nominal_rms']:.2g} {unit} rms (noise {noise:.2g}); "
        f"fitted, it leaves a torque of {left:.2g} {force} rms a sample unexplained ({percent(left / size)} of the "
        f"driving torque; {allowed:.2g} {force} may be noise)"
    )
    findings = []
    for name in sorted(names, key=lambda name: -gains[name]):
        chance = float(expit(0.5 * (gains[name] - np.log(model.count))))
        # of a friction its level, of a gap what the shaft would take instead
        (value,), drive = numbers[name].values(), alone.experiment.drive
        if name in search.play:
            share = min(value * model.number("transmission.stiffness", alone.point.theta) / size, 1.0)
        else:
            share = value / float(drive.ratio(name.partition(".")[0])) / size
        finding = Finding(name, chance, numbers[name], ())
        findings.append(describe_finding(record, finding, errors, {}) | {"share": share, "z": max(gains[name], 0.0) ** 0.5})
    notes = list(record.notes)
    notes.append(f"From the motor's encoder alone these effects are sought and no others: {', '.join(search.effects)}.")
    if alone.reason:
        fitted_gap = " model.toml has the one that fits best." if alone.gap is not None and alone.gap.is_needed else ""
        notes.append(f"No gap is shown: {alone.reason}.{fitted_gap}")
    part, gap = held_out.segments, gap_summary(alone)
    return {
        **task.heading,
        "verdict": judgement.verdict,
        "findings": findings,
        "parameters": describe_parameters(record, search.free, values, errors),
        "where": {"motor": {"sentence": sentence}},
        "contradictions": [],
        "notes": notes,
        # of the squared error beyond noise; where the model as given leaves no more than a complete one, nothing is missing
        "explained_share": None if before <= limit**2 else 1.0 - min(max(after - noise**2, 0.0) / (before - noise**2), 1.0),
        "backlash": gap and gap | {"nominal": None},
        "gap": {
            "holdout": {
                "file": str(held_out.path.resolve()), "separate": task.separate, "window": None,
                "from": held_out.time[part[0].start], "to": held_out.time[part[-1].stop - 1],
            },
            "holdout_rmse_before": {"theta_e": holdout["nominal_rms"]},
            "holdout_rmse_after": {"theta_e": holdout["rms"]},
            "noise_floor": {"theta_e": noise},
            "units": {"theta_e": unit},
            "expected": {"theta_e": {"limit": limit}},
            "test": judgement.test,
        },
    }  # fmt: skip
