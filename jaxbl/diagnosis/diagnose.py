"""What a model lacks, from a log: the function behind `jaxbl diagnose`.

Where model and log disagree, which effect is missing, the model with it, and the proof on data that neither the choice nor
the fit has seen.
"""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from jaxbl.config import Config, read_config, read_model, with_values
from jaxbl.diagnosis.effect_search import FAR, Explainer, Explanation, Finding, Model
from jaxbl.diagnosis.holdout import WINDOW, Ground, Proof, foretold
from jaxbl.diagnosis.input_noise import noise_of, smoothed_input, unfelt
from jaxbl.diagnosis.linearised_model import Linear
from jaxbl.diagnosis.localise import SIGNIFICANT, Localised, Values, as_json, coordinates_of, describe, where
from jaxbl.diagnosis.neutral_effects import complete, joined
from jaxbl.diagnosis.observer_residual import Observed, compared, observed_torques
from jaxbl.diagnosis.residuals import Residual
from jaxbl.drive.effects import EFFECTS
from jaxbl.drive.parameters import get_leaf, leaf_paths, parameters, set_leaves
from jaxbl.errors import InputError
from jaxbl.files import plain
from jaxbl.identification.logs import (
    Logs,
    arrays,
    default_paths,
    gains_for,
    identity_of,
    kinematics_of,
    on_record,
    read_logs,
    unit_on,
)
from jaxbl.identification.regression import Kinematics
from jaxbl.identification.search import smoothed_channels
from jaxbl.identification.trajectory import Free, free_parameters
from jaxbl.records import POSITION_CHANNELS, Record
from jaxbl.simulate import Experiment
from jaxbl.workers import Progress

HELD_OUT = 0.25
"""Share of a log that is held out where there is no other one for it."""
GEAR_TOLERANCE = 0.25
"""A missing effect (a soft shaft, a gap) shifts the ratio of both motions, on a short log by a fifth."""
_FEWEST = 100
"""Samples of a part of a log, and of what is held out."""
_WORSE, _WORSE_SPEED = 1.02, 1.05
_DIVERGED = 10.0
"""Errors on short windows over the motion's range from which on a model counts as diverging."""
_ALIKE = 4.0
"""Factor between the inertias that two logs of one machine may show."""
_BOUND = 4.0
"""Standard deviations that the model's own numbers may be off where they are held."""
_NOISY = 1e-3
"""Noise over the input's rms from which on it is asked whether the drive felt it."""
_TOLD = 3.0
"""Nats by which it has to be told that it did not."""
_HIDDEN = 0.3
"""Share of the input: where a torque of that size would not have been seen, noise hides everything."""


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """What a log says that a model lacks.

    Attributes:
        config: the study, as given.
        model: the study with the missing effects and all numbers fitted anew; it runs in every other command.
        record: the part of the log that was fitted.
        holdout: what was held out: the rest of the log, or another one.
        summary: as in `diagnosis.json`.
        trace: one row a sample of the log: `t`, `u`, positions, `held_out`, and on each side the torque that the model lacks
            as given (`motor.missing_before`) and with the effects (`motor.missing_after`) with its `motor.noise`, N m; and
            what the model as given lacks by the observers (`motor.observed_before`, `motor.observed_noise`), N m, empty
            while they converge.
        residuals: torques that the model as given lacks, by side, of each part that was fitted.
        observed: the same by the observers' equivalent control.
        coordinates: along them, by side, of each part.
        located: where they live, by side.
        pairs: torques that the model lacks as given and with the effects, by side, of each part, and whether it was held
            out; where that is another log, of that alone.
        replays: whether the model's excitation is to be the log's, for want of one in the study.
    """

    config: Config
    model: Config
    record: Record
    holdout: Record
    summary: dict[str, Any]
    trace: pd.DataFrame
    residuals: dict[str, list[Residual]]
    observed: dict[str, list[Observed]]
    coordinates: dict[str, list[dict[str, Values]]]
    located: dict[str, Localised]
    pairs: dict[str, list[tuple[Residual, Residual, bool]]]
    replays: bool


@dataclasses.dataclass(frozen=True)
class Task:
    """A study and its log: everything that decides the result.

    Attributes:
        config: the study.
        missing: tables that the study does not have (`excitation`, `observer.motor`, `observer.load`).
        record: the part of the log that may be fitted.
        holdout: the rest of it, or another log.
        separate: whether it is another log.
    """

    config: Config
    missing: frozenset[str]
    record: Record
    holdout: Record
    separate: bool

    @property
    def identity(self) -> str:
        """Hash of everything that decides the result."""
        return identity_of(self.config, self.missing, self.record, self.holdout)


def read_task(log: Logs, model: str | Path | Mapping[str, Any] | Config, *, holdout: Logs | None = None) -> Task:
    """Read study and logs; arguments as of :func:`diagnose`.

    Raises:
        InputError: unfit log or study, or a hold-out log of another machine.
    """
    config, missing = read_model(model)
    record = read_logs(config, log, GEAR_TOLERANCE)
    if holdout is None:
        record, other = _split(record)
    else:
        other = read_logs(config, holdout, GEAR_TOLERANCE)
        _check_machine(record, other)
    return Task(config, missing, _long(record), _long(other), holdout is not None)


def diagnose(log: Logs, model: str | Path | Mapping[str, Any] | Config, *, holdout: Logs | None = None) -> Diagnosis:
    """Find what a model lacks, add it, and prove on held-out data that the gap shrinks.

    Args:
        log: the file, read as the study's `[log]` table says, or a record; or several of them, of one machine.
        model: study with nominal numbers: TOML file, mapping or config; `[uncertainty]` says how well they are known.
            `[excitation]` and `[observer]` may be missing.
        holdout: another log (or several) of the machine, on which it is proved; left out: the last quarter of the log.

    Raises:
        InputError: unfit log or study, a hold-out log of another machine, or a model that diverges.
    """
    return run_task(read_task(log, model, holdout=holdout))


def _long(record: Record) -> Record:
    """Without parts that are too short for the equations of motion."""
    parts = tuple(part for part in record.segments if part.stop - part.start >= _FEWEST)
    if not parts:
        raise InputError(
            f"{record.path}: its longest part has {max(part.stop - part.start for part in record.segments)} samples; "
            f"at least {_FEWEST} are needed"
        )
    return dataclasses.replace(record, segments=parts)


def _split(record: Record) -> tuple[Record, Record]:
    """The samples to be fitted, and those held out: the last of the log, at their own times."""
    total = sum(part.stop - part.start for part in record.segments)
    left = round((1.0 - HELD_OUT) * total)
    if HELD_OUT * total < _FEWEST:
        raise InputError(
            f"{record.path}: {total} samples are too few to hold a quarter of them out; at least "
            f"{int(np.ceil(_FEWEST / HELD_OUT))} are needed, or another log: --holdout"
        )
    row = record.segments[-1].stop
    for part in record.segments:
        if left <= part.stop - part.start:
            row = part.start + left
            break
        left -= part.stop - part.start
    first = tuple(slice(part.start, min(part.stop, row)) for part in record.segments if part.start < row)
    last = tuple(slice(max(part.start, row), part.stop) for part in record.segments if part.stop > row)
    cut = {name: None if (one := getattr(record, name)) is None else one[:row] for name in ("time", "torque", "transmitted")}
    positions = {side: values[:row] for side, values in record.positions.items()}
    # times count from the log's first sample in both: a disturbance may be periodic in time
    return dataclasses.replace(record, **cut, positions=positions, segments=first), dataclasses.replace(
        record, segments=last
    )


def _check_machine(record: Record, other: Record) -> None:
    """Refuse a hold-out log of another machine."""
    if other.path.resolve() == record.path.resolve():
        raise InputError(f"{other.path}: is the log itself; without --holdout its last quarter is held out")
    if not np.isclose(record.sample_period, other.sample_period, rtol=1e-2, atol=0.0):
        raise InputError(
            f"{other.path}: is sampled every {other.sample_period:.6g} s, {record.path} every {record.sample_period:.6g} s; "
            f"[log] resample = {record.sample_period:.6g} reads both alike"
        )
    for side in record.positions:
        if side not in other.positions:
            raise InputError(f"{other.path}: has no {side} position, which {record.path} has; it is of another machine")
    gears = record.findings.gearing, other.findings.gearing
    if gears[0] is not None and gears[1] is not None and not (gears[0].wide or gears[1].wide):
        ratios = gears[0].ratio, gears[1].ratio
        clear = all(one.residual < 0.1 for one in gears if one is not None)
        if clear and abs(ratios[1] / ratios[0] - 1.0) > GEAR_TOLERANCE:
            raise InputError(
                f"{other.path}: theta_e moves {ratios[1]:.4g} for each 1 of theta_s, on {record.path} {ratios[0]:.4g}; it "
                "is of another machine, or a sign or unit differs"
            )
    inertias = []
    for one in (record.findings.dynamics, other.findings.dynamics):
        if one is not None and one.shares[0] > 0.1 and 10.0 * one.errors[0] * one.inflation[0] < abs(one.values[0]):
            inertias.append(float(one.values[0]))
    if len(inertias) == 2 and not 1.0 / _ALIKE < inertias[1] / inertias[0] < _ALIKE:
        raise InputError(
            f"{other.path}: shows an inertia of {inertias[1]:.3g}, {record.path} of {inertias[0]:.3g} at the motor; it is "
            "of another machine, or a sign or unit differs"
        )


class _Fitted(NamedTuple):
    """A model with some effects, all numbers fitted."""

    names: tuple[str, ...]
    experiment: Experiment
    free: tuple[Free, ...]
    theta: np.ndarray
    deviation: np.ndarray

    @property
    def values(self) -> dict[str, float]:
        return {one.path: float(one.value(self.theta[i])) for i, one in enumerate(self.free)}

    @property
    def own(self) -> dict[str, float]:
        """Values of the nominal model's own numbers."""
        added = tuple(f"effects.{name}." for name in self.names)
        return {path: value for path, value in self.values.items() if not path.startswith(added)}

    @property
    def numbers(self) -> dict[str, dict[str, float]]:
        """All numbers of the effects, those that were not free among them."""
        effects = {name: get_leaf(self.experiment, f"effects.{name}") for name in self.names}
        return {name: {leaf: float(get_leaf(one, leaf)) for leaf in leaf_paths(one)} for name, one in effects.items()}

    def errors(self) -> dict[str, float]:
        """Standard errors of the values."""
        return {one.path: float(one.slope(self.theta[i])) * self.deviation[i] for i, one in enumerate(self.free)}


_STAGES = 6


def run_task(task: Task, progress: Progress | None = None) -> Diagnosis:
    """Do what :func:`read_task` read.

    Args:
        task: what to do.
        progress: called with finished and total stages after each.

    Raises:
        InputError: a model that diverges.
    """
    config, record = task.config, task.record
    assert record.torque is not None
    stages = iter(range(1, _STAGES + 1))

    def done() -> None:
        stage = next(stages)
        if progress is not None:
            progress(stage, _STAGES)

    with jax.enable_x64(True):
        setting = _setting(task)
        bare, nominal, own, _, seen, other, lacking, located, noise = setting
        coordinates = _coordinates(nominal, seen, lacking)
        before = other.prove(_at(nominal, task.holdout))
        done()
        explainer, found = _explained(setting)
        done()
        proving = _Proving(task, setting, explainer, before)
        fitted, after, withdrawn = proving.extended(found)
        done()
        if withdrawn:
            found = explainer.without(found, withdrawn)
        verdict, rival = found.verdict, found.wrong
        gap = proving.gap(fitted, after, rival)
        done()
        missing_after = seen.torques(fitted.experiment)
        left: dict[str, Localised] = {}
        if verdict == "unknown_effect":
            left = where(fitted.experiment, missing_after, seen.parts, seen.smoothed, rotating=_rotating(record, nominal))
        trace = _trace(task, (lacking, missing_after), (before.torques, after.torques))
        done()
        _, gain_values = gains_for(task.missing, fitted.experiment, record, seen.channels)
        witness = _Witness(task, set_leaves(bare, arrays(gain_values)), seen, other)
        trace = trace.assign(**witness.columns(len(trace)))
        model = _model(config, fitted.numbers, fitted.own | gain_values)
        summary = _summary(task, fitted, found, withdrawn, located)
        if noise > 0.0:
            summary["notes"].append(_noise_said(record, noise))
        witness.tell(summary, lacking)
        summary["gap"] = gap
        if left:
            summary["where_after"] = _lives(record, left)
        if rival is not None:
            summary["rival"] = _rival(config, own, rival)
        done()
    replays = "excitation" in task.missing
    pairs = {
        side: [
            *((one, left, False) for one, left in zip(lacking[side], missing_after[side], strict=True) if not task.separate),
            *((one, left, True) for one, left in zip(before.torques[side], after.torques[side], strict=True)),
        ]
        for side in lacking
    }
    return Diagnosis(
        config, model, record, task.holdout, plain(summary), trace, lacking, witness.observed, coordinates, located, pairs,
        replays,
    )  # fmt: skip


def with_known(task: Task, effects: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """What a diagnosis that names just these effects would reach: rms errors on what is held out, by channel.

    Args:
        task: study and logs.
        effects: numbers of each, from which all are fitted.
    """
    with jax.enable_x64(True):
        setting = _setting(task)
        fitted = _fitted(_explainer(setting), effects, np.zeros(len(setting.own)))
        return setting.other.prove(_at(fitted.experiment, task.holdout)).errors


class _Setting(NamedTuple):
    """The nominal model and the logs.

    Attributes:
        bare: the model as given.
        nominal: the same with all effects at neutral numbers.
        own: its numbers that are not exactly known.
        prior: relative standard deviation of each.
        seen: the log.
        other: what was held out.
        lacking: torques that the model lacks on the log, by side.
        located: where they live.
        torque_noise: of the channel that recorded the input, N m, which `seen` and `other` are without; 0 where it drives.
    """

    bare: Experiment
    nominal: Experiment
    own: tuple[Free, ...]
    prior: np.ndarray
    seen: Ground
    other: Ground
    lacking: dict[str, list[Residual]]
    located: dict[str, Localised]
    torque_noise: float


def _setting(task: Task) -> _Setting:
    config, record = task.config, task.record
    assert record.torque is not None
    bare = on_record(config, record)
    # one structure for all models, so that they share their compiled programs
    nominal = complete(bare)
    _check_order(bare, nominal)
    own = free_parameters(bare, default_paths(config, bare), float(np.std(record.torque)))
    prior = np.full(len(own), config.uncertainty.relative)
    rest = config.log.initial_state == "rest"
    seen, other = (_ground(nominal, one, rest) for one in (record, task.holdout))
    other = dataclasses.replace(other, rest=rest and task.separate)
    _check_stable(task, nominal, seen)
    noise = _torque_noise(record, nominal, own, seen)
    if noise > 0.0:
        seen, other = (_driven(one, smoothed_input(one.record, noise)) for one in (seen, other))
    lacking = seen.torques(nominal)
    located = where(nominal, lacking, seen.parts, seen.smoothed, rotating=_rotating(record, nominal))
    bandwidth = {name: one.bandwidth for name, one in located.items()}
    seen, other = (dataclasses.replace(one, bandwidth=bandwidth) for one in (seen, other))
    return _Setting(bare, nominal, own, prior, seen, other, lacking, located, noise)


def _torque_noise(record: Record, nominal: Experiment, own: Sequence[Free], seen: Ground) -> float:
    """Noise of the channel that recorded the input, N m, where the drive does not feel it; 0 where it does."""
    noise, size = noise_of(record), _rms_of(record)
    if not _NOISY * size < noise:
        return 0.0
    # the model as given: numbers that may change would make up for some of the noise
    none, width = np.zeros(len(own)), np.ones(len(own))
    given, smooth = (
        Linear(nominal, own, none, width, none, one, seen.channels.smoothed, none)
        for one in (record, smoothed_input(record, noise))
    )
    smoothness, _ = given.choose(())
    return noise if unfelt(given.left(smoothness), smooth.left(smoothness)) > _TOLD else 0.0


def _explainer(setting: _Setting, bound: float = np.inf) -> Explainer:
    smoothed = setting.seen.channels.smoothed
    return Explainer(setting.bare, setting.own, setting.prior.tolist(), setting.seen.record, smoothed, bound)


def _explained(setting: _Setting) -> tuple[Explainer, Explanation]:
    """What the log says that the model lacks.

    For want of two effects at once the model's own numbers may go astray, and hide both. If they do, effects are sought with
    these numbers held near to what is known of them; what that finds counts if it explains the log, with numbers that are
    there without being held.
    """
    explainer = _explainer(setting)
    found = explainer.run()
    if not explainer.plausible(found):
        other = _explainer(setting, _BOUND)
        again = other.run()
        if again.verdict != "unknown_effect" and other.plausible(again):
            explainer, found = other, again
    if found.verdict == "no_discrepancy":
        _check_shown(setting, explainer.shown())
    return explainer, found


def _check_shown(setting: _Setting, shown: float) -> None:
    """Refuse to say that nothing is missing where noise hides everything.

    Args:
        setting: of the diagnosis.
        shown: standard deviations by which the log shows its input.
    """
    record = setting.seen.record
    if shown * _HIDDEN >= SIGNIFICANT:
        return
    noise = ", ".join(
        f"{value:.2g} {record.findings.channels[POSITION_CHANNELS[side]].unit} ({POSITION_CHANNELS[side]})"
        for side, value in setting.seen.channels.noise.items()
    )
    least = SIGNIFICANT / max(shown, 1e-12)
    raise InputError(
        f"{record.path}: noise hides everything: with readings as noisy as {noise}, no torque of less than "
        f"{100.0 * least:.0f} % of the input would be seen; noise {least / _HIDDEN:.2g} times smaller, or torques as many "
        "times larger, are needed"
    )


def _fitted(explainer: Explainer, numbers: Mapping[str, Mapping[str, float]], theta: np.ndarray) -> _Fitted:
    """A model with some effects, its own numbers and theirs fitted from given ones."""
    free, found = explainer.polished({name: dict(one) for name, one in numbers.items()}, theta)
    return _Fitted(tuple(numbers), found.experiment, free, found.theta, found.deviation)


def _ground(nominal: Experiment, record: Record, rest: bool) -> Ground:
    return _driven(Ground(record, smoothed_channels(record, nominal.sides), (), {}, rest), record)


def _driven(ground: Ground, record: Record) -> Ground:
    """A record with another input in place of a ground's."""
    # nothing is decimated here
    return dataclasses.replace(ground, record=record, parts=kinematics_of(record, ground.channels, 1))


def _rotating(record: Record, nominal: Experiment) -> dict[str, bool]:
    return {side: record.findings.channels[POSITION_CHANNELS[side]].unit != "m" for side in nominal.sides}


def _coordinates(
    nominal: Experiment, ground: Ground, residuals: Mapping[str, Sequence[Residual]]
) -> dict[str, list[dict[str, Values]]]:
    rotating = _rotating(ground.record, nominal)
    each: Sequence[Kinematics] = ground.parts
    return {
        side: [
            coordinates_of(nominal, part, smoothed, one, rotating=rotating)
            for part, smoothed, one in zip(each, ground.smoothed, pieces, strict=True)
        ]
        for side, pieces in residuals.items()
    }


def _check_order(bare: Experiment, nominal: Experiment) -> None:
    """Refuse a model of which two effects share a name, and are called by positions that others would shift."""
    names = [effect.name for effect in bare.effects]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None and [effect.name for effect in nominal.effects[: len(names)]] != names:
        raise InputError(f"effects: two are {twice}; list them before those of the actuator")


def _check_stable(task: Task, nominal: Experiment, ground: Ground) -> None:
    for side, apart in ground.strays(nominal).items():
        if not apart < _DIVERGED:
            raise InputError(
                f"{task.record.path}: the model diverges under this log's input: within {WINDOW:g} s its {side} leaves the "
                f"measured motion by {apart:.2g} times the whole of it; a number of it, or its sign, is wrong"
            )


def _at(experiment: Experiment, record: Record) -> Experiment:
    return eqx.tree_at(lambda e: e.run.sample_period, experiment, jnp.asarray(record.sample_period))


class _Witness:
    """What the observers say of the torques that the model as given lacks; nothing is decided by it."""

    def __init__(self, task: Task, nominal: Experiment, seen: Ground, other: Ground):
        self.task, self.nominal, self.seen = task, nominal, seen
        self.observed = observed_torques(nominal, seen.record, seen.parts, seen.smoothed)
        self.held = {}
        if not task.separate:
            self.held = observed_torques(_at(nominal, other.record), other.record, other.parts, other.smoothed)

    def columns(self, samples: int) -> dict[str, np.ndarray]:
        """Of the trace."""
        found = {}
        for side in self.observed:
            torque, noise = np.full((2, samples), np.nan)
            for record, pieces in ((self.task.record, self.observed), (self.task.holdout, self.held)):
                for part, one in zip(record.segments if pieces else (), pieces.get(side, ()), strict=True):
                    if not one.converged:
                        continue
                    torque[part.start + one.skipped : part.stop] = one.residual.torque
                    noise[part.start + one.skipped : part.stop] = one.residual.deviation
            found |= {f"{side}.observed_before": torque, f"{side}.observed_noise": noise}
        return found

    def tell(self, summary: dict[str, Any], lacking: Mapping[str, list[Residual]]) -> None:
        """Add what the observers say to where the torques live, and a note where they say nothing."""
        for side, pieces in self.observed.items():
            about = compared(self.nominal, pieces, lacking[side], self.seen.bandwidth[side])
            gains = getattr(self.nominal.observer, side)
            about["gains"] = {"lambda": float(gains.lambda_), "alpha": float(gains.alpha)}
            about["time_constant"] = float(self.nominal.equivalent_control.time_constant)
            summary["where"][side]["observed"] = about
            if not about["converged"]:
                summary["notes"].append(
                    f"The {side}'s observer does not converge on this log (alpha = {float(gains.alpha):.3g}): its "
                    "equivalent control says nothing of the missing torque. The verdict does not use it."
                )


class _Proving:
    """Models fitted on the log, and held against what was held out."""

    def __init__(self, task: Task, setting: _Setting, explainer: Explainer, before: Proof):
        self.task, self.setting, self.explainer, self.before = task, setting, explainer, before
        self.nominal, self.own, self.other = setting.nominal, setting.own, setting.other
        self.floor = self.other.floor(before.torques)

    def extended(self, found: Explanation) -> tuple[_Fitted, Proof, list[str]]:
        """The model with what was found, its proof, and the effects that did not earn their place."""
        names, withdrawn = found.model.names, []
        while True:
            base = found.model if names else found.nominal
            fitted = _fitted(self.explainer, {name: base.numbers[name] for name in names}, base.theta)
            after = self.other.prove(self.at(fitted.experiment))
            if not self.worse(after) and (names or self.better(after)):
                return fitted, after, withdrawn
            if not names:
                break
            withdrawn.append(names[-1])
            names = names[:-1]
        given = _Fitted((), self.nominal, self.own, np.zeros(len(self.own)), self.setting.prior)
        return given, self.before, withdrawn

    def worse(self, after: Proof) -> bool:
        """Whether a model is worse than the one given on what was held out, by more than noise."""
        return any(
            # of speeds the floor is known less well
            not value
            <= (_WORSE_SPEED if name.startswith("velocity") else _WORSE) * max(self.before.errors[name], self.floor[name])
            for name, value in after.errors.items()
        )

    def better(self, after: Proof) -> bool:
        """Whether a model is better than the one given, all in all: what new numbers alone have to be to take its place."""
        old, new = (np.array([proof.errors[name] for name in self.before.errors]) for proof in (self.before, after))
        with np.errstate(divide="ignore", invalid="ignore"):
            return bool(np.sum(np.log(new) - np.log(old)) < 0.0)

    def at(self, experiment: Experiment) -> Experiment:
        """A model at the period of what was held out."""
        return _at(experiment, self.other.record)

    def gap(self, fitted: _Fitted, after: Proof, rival: Model | None) -> dict[str, Any]:
        """What is left on held-out data before and after, the floor, and controls."""
        record, other = self.task.holdout, self.other
        part = record.segments
        found: dict[str, Any] = {
            "holdout": {
                "file": str(record.path.resolve()),
                "separate": self.task.separate,
                "from": float(record.time[part[0].start]),
                "to": float(record.time[part[-1].stop - 1]),
                "window": other.samples * record.sample_period,
                "bandwidth": dict(other.bandwidth),
            },
            "units": {name: _unit(record, name) for name in self.floor},
            "driving": {"motor": _rms_of(record)},
            "holdout_rmse_before": self.before.errors,
            "holdout_rmse_after": after.errors,
            "noise_floor": self.floor,
            "free_run": {},
            "controls": {},
        }
        runs = {"before": self.nominal, "after": fitted.experiment}
        for name, one in runs.items():
            errors, growth = other.free_run(self.at(one))
            if not foretold(growth):
                found["free_run"] = {"why_not": "small changes of the initial speed grow to the size of the motion"}
                break
            found["free_run"][name] = errors
        if rival is not None:
            wrong = set_leaves(rival.experiment, arrays(_values(self.own, rival.theta)))
            found["controls"]["wrong"] = {"effect": rival.names[-1], "rmse": other.prove(self.at(wrong)).errors}
        if fitted.names:
            added = {
                side: [one.torque - left.torque for one, left in zip(pieces, after.torques[side], strict=True)]
                for side, pieces in self.before.torques.items()
            }
            found["controls"]["permuted"] = {"rmse": other.permuted(self.at(self.nominal), added).errors}
        return found


def _rms_of(record: Record) -> float:
    """Of the input on what is held out, N m."""
    assert record.torque is not None
    return float(np.sqrt(np.mean(np.concatenate([np.square(record.torque[part]) for part in record.segments]))))


def _values(free: Sequence[Free], theta: np.ndarray) -> dict[str, Any]:
    return {one.path: jnp.asarray(one.value(theta[i])) for i, one in enumerate(free)}


_UNITS = {"theta": "rad", "velocity": "rad/s", "torque": "N m"}


def _unit(record: Record, name: str) -> str:
    side = "load" if name in ("theta_s", "velocity_load", "torque_load") else "motor"
    return unit_on(record, f"{side}.position", _UNITS[name.split("_")[0]])


def _model(config: Config, numbers: Mapping[str, Mapping[str, float]], values: Mapping[str, float]) -> Config:
    """The study with effects more, and with these numbers."""
    return with_values(_with_effects(config.resolved(), numbers), values)


def _with_effects(data: dict[str, Any], numbers: Mapping[str, Mapping[str, Any]]) -> Config:
    added = [{"kind": name, **one} for name, one in numbers.items()]
    data["effects"] = joined(data.get("effects", []), added, lambda one: one["kind"])
    return read_config(data)


def _rival(config: Config, own: Sequence[Free], rival: Model) -> dict[str, Any]:
    """The best model with another effect, as tables of a study."""
    values = {path: float(value) for path, value in _values(own, rival.theta).items()}
    data = _model(config, {name: rival.numbers[name] for name in rival.names}, values).resolved()
    return {"effect": rival.names[-1]} | {key: data[key] for key in ("drive", "transmission", "effects") if key in data}


def _trace(
    task: Task,
    fitted: tuple[Mapping[str, list[Residual]], Mapping[str, list[Residual]]],
    held: tuple[Mapping[str, list[Residual]], Mapping[str, list[Residual]]],
) -> pd.DataFrame:
    """One row a sample of the log; of another one that was held out there is nothing."""
    whole = task.record if task.separate else task.holdout
    names = {side: POSITION_CHANNELS[side] for side in ("motor", "load") if side in whole.positions}
    columns: dict[str, Any] = {"t": whole.time, "u": whole.torque}
    columns |= {name: whole.positions[side] for side, name in names.items()}
    columns["held_out"] = np.arange(len(whole.time)) >= len(task.record.time)
    sources = [(task.record, fitted)] + ([] if task.separate else [(task.holdout, held)])
    for side in fitted[0]:
        for name, which, attribute in (
            ("missing_before", 0, "torque"), ("missing_after", 1, "torque"), ("noise", 0, "deviation"),
        ):  # fmt: skip
            column = np.full(len(whole.time), np.nan)
            for record, pair in sources:
                for part, one in zip(record.segments, pair[which][side], strict=True):
                    column[part] = getattr(one, attribute)
            columns[f"{side}.{name}"] = column
    return pd.DataFrame(columns)


def _summary(
    task: Task,
    fitted: _Fitted,
    found: Explanation,
    withdrawn: Sequence[str],
    located: Mapping[str, Localised],
) -> dict[str, Any]:
    record = task.record
    lives = _lives(record, located)
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
    return {
        "title": task.config.title,
        "identity": task.identity,
        "file": str(record.path.resolve()),
        "samples": len(record.time),
        "sample_period": record.sample_period,
        "verdict": found.verdict,
        "findings": [_finding(task, one, values, errors, lives, located) for one in found.findings],
        "parameters": {
            one.path: {
                "value": values[one.path],
                "standard_error": errors[one.path],
                "nominal": one.nominal,
                "unit": unit_on(record, one.path, one.unit),
            }
            for one in own
        },
        "where": lives,
        "rest": {name: {"evidence": gain, "share": share} for name, (gain, share) in found.rest.items()},
        "withdrawn": list(withdrawn),
        "notes": notes,
    }


def _finding(
    task: Task,
    one: Finding,
    values: Mapping[str, float],
    errors: Mapping[str, float],
    lives: Mapping[str, Any],
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
        "where": {"place": place, "sentences": {side: lives[side]["sentence"] for side in sides}},
    }


def _lives(record: Record, located: Mapping[str, Localised]) -> dict[str, Any]:
    """Where missing torques live, with sentences in the log's units."""
    told = {name: describe(one, unit_on(record, f"{name}.torque", "N m")) for name, one in located.items()}
    return {name: one | {"sentence": told[name]} for name, one in as_json(located).items()}


def _far_off(own: Sequence[Free], values: Mapping[str, float], uncertainty: float) -> list[str]:
    """Which numbers of the model ended where they hardly can be, as it says itself."""
    lines = []
    for one in own:
        change = values[one.path] / one.nominal - 1.0 if one.nominal else 0.0
        if abs(change) > FAR * uncertainty:
            lines.append(
                f"{one.path} had to change by {change:+.0%}, {abs(change) / uncertainty:.0f} times its [uncertainty]: "
                "findings may make up for it, or it for them. Noise of the torque channel does it, or too small a relative."
            )
    return lines


def _noise_said(record: Record, noise: float) -> str:
    unit = unit_on(record, "motor.torque", "N m")
    return (
        f"The channel u carries noise of {noise:.2g} {unit} rms ({noise / _rms_of(record):.1%} of the input) that the drive "
        "does not feel: models are driven by u smoothed between its jumps."
    )


def _least_seen(record: Record, located: Mapping[str, Localised]) -> list[str]:
    """What would not have been seen."""
    unit = {side: unit_on(record, f"{side}.torque", "N m") for side in located}
    lines = []
    for side, one in located.items():
        least = SIGNIFICANT * one.coordinates["all"].regions[0].mean_error
        lines.append(f"{side}: a steady torque of less than about {least:.2g} {unit[side]} would not have been seen.")
    return lines
