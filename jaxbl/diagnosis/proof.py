"""The proof on what was held out: whether a model with the missing effects predicts it better, beside floor and controls."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxbl.drive.effects import EFFECTS, Numbers
from jaxbl.drive.parameters import get_leaf, leaf_paths, units_of
from jaxbl.identification.free_parameters import FreeParameter
from jaxbl.json_types import JsonObject
from jaxbl.records import Record
from jaxbl.simulate import Experiment

from .candidates import EffectNumbers
from .diagnosis_task import input_rms
from .effect_search import FAR, FLOOR, EffectSearch, Explanation, Model
from .linearised_model import Linear
from .reference_log import PREDICTABLE, Comparison, Errors, ReferenceLog
from .setup import Setup

_WORSE, _WORSE_SPEED = 1.02, 1.05
"""Errors of a model over those of the one given, or over the noise, up to which it is no worse: what numbers fitted on other
data cost; of speeds the noise is known less well."""
_SURELY = 1.1
"""The same from which on it is worse, whatever the blocks of held-out data say."""

_BLOCKS = 16
"""Of held-out data, over which errors are compared: many enough for a standard error, and longer than errors are correlated
in most logs."""
SEEN = 1.0
"""Standard errors by which a channel shows a difference, as a stepwise regression by blocks asks."""
SURE = 2.0
"""Standard errors that count as a difference between two models: 2 % by chance."""


class FittedModel(NamedTuple):
    """A model with some effects, all numbers fitted.

    Attributes:
        names: of the effects.
        experiment: the model.
        free: numbers that were fitted, its own first.
        theta: of these.
        covariance: of theta.
        white: the same if prediction errors are white, as those of a complete model.
        linear: the model along the log; None of the model as given.
    """

    names: tuple[str, ...]
    experiment: Experiment
    free: tuple[FreeParameter, ...]
    theta: np.ndarray
    covariance: np.ndarray
    white: np.ndarray
    linear: Linear | None = None

    def share(self, name: str) -> float:
        """Torque of an effect along the log, rms over the driving torque's."""
        assert self.linear is not None
        return self.linear.share(name)

    @property
    def numbers(self) -> dict[str, Numbers]:
        """All numbers of the effects, those that were not free among them."""
        effects = {name: get_leaf(self.experiment, f"effects.{name}") for name in self.names}
        return {name: {leaf: float(get_leaf(one, leaf)) for leaf in leaf_paths(one)} for name, one in effects.items()}

    def errors(self) -> Numbers:
        """Standard errors of the values."""
        deviation = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return {one.path: float(one.slope(self.theta[i])) * deviation[i] for i, one in enumerate(self.free)}


def special_case(fitted: FittedModel, name: str, noise: Mapping[str, float] | None = None) -> str | None:
    """Name of a special case that an effect of a model may as well be, since the number that parts the two is known no
    better than its size: friction that bends over a length of 0.5 ± 0.6 mrad may as well not bend. With the `noise` of each
    side's readings, rad, nor is a way known that is shorter than that."""
    cls, errors, place = EFFECTS[name], fitted.errors(), name.partition(".")[0]
    least = {} if noise is None else {"rad": noise.get(place, max(noise.values()))}
    units = units_of(cls)
    apart = []
    for leaf, role in cls.roles().items():
        path = f"effects.{name}.{leaf}"
        if role.kind in ("shape", "frequency") and path in errors:
            known = max(errors[path], least.get(units.get(leaf, ""), 0.0))
            apart.append(known < abs(float(get_leaf(fitted.experiment, path))))
    plain = next((f"{place}.{kind}" for kind in cls.special_cases), None)
    return plain if apart and not any(apart) else None


def _least_gain(name: str) -> float:
    """Standard errors by which an effect has to make a model better on held-out data.

    What depends on the time alone imitates whatever is slow or random, and a wave's frequency and phase were chosen among
    many; but then it does not go on in other data.
    """
    return SURE if EFFECTS[name].in_time else SEEN


def free_values(free: Sequence[FreeParameter], theta: np.ndarray) -> Numbers:
    """Values of free numbers, by path; theta may have others behind them."""
    return {one.path: float(one.value(theta[i])) for i, one in enumerate(free)}


def fit_model(search: EffectSearch, numbers: EffectNumbers, theta: np.ndarray) -> FittedModel:
    """A model with some effects, its own numbers and theirs fitted from given ones."""
    found = search.refitted({name: dict(one) for name, one in numbers.items()}, theta)
    return FittedModel(
        tuple(numbers), found.experiment, found.linear.free, found.theta, found.covariance, found.white, found.linear
    )


class Control(NamedTuple):
    """What must not do as well on what was held out as the model with effects.

    Attributes:
        kind: `wrong`, the best model with another effect in place of the last, or `permuted`, the torque that the effects
            add, shuffled in time.
        errors: rms, by channel.
        z: standard errors by which the errors of the model with effects are smaller.
        effect: the other one.
        experiment: the model with it.
    """

    kind: str
    errors: Errors
    z: float
    effect: str = ""
    experiment: Experiment | None = None


class Accepted(NamedTuple):
    """An explanation as far as the held-out data bear it out.

    Attributes:
        fitted: the model with it.
        after: how it compares there.
        withdrawn: effects that were found, and that it is without.
        gains: standard errors by which the model beats the one without an effect, by effect.
        by_torque: standard errors by which numbers of least missing torque beat those of least prediction errors; 0 where
            they are the latter.
    """

    fitted: FittedModel
    after: Comparison
    withdrawn: list[str]
    gains: Numbers
    by_torque: float = 0.0


class Proof:
    """Models fitted on the log, and compared on what was held out.

    Attributes:
        before: the model as given, on what was held out.
        noise: of each channel there, as far as the model as given tells.
    """

    def __init__(self, setup: Setup):
        self.setup, self.other = setup, setup.holdout
        self.before = self.other.compare(setup.nominal)
        self.noise = self.other.noise_floor(self.before.torques)

    def accepted(self, search: EffectSearch, found: Explanation) -> Accepted:
        """The model with what was found, as far as the held-out data bear it out.

        Withdrawn, one after the other, are effects without which a model does about as well there, the one of least torque
        first, since beside it others may only seem needless; and while the model is worse than the one given, the effect
        without which it does best.
        """
        names, withdrawn = list(found.model.names), []
        while names:
            fitted = fit_model(search, {name: found.model.numbers[name] for name in names}, found.model.theta)
            after = self.other.compare(fitted.experiment)
            gains = {name: self._gain(search, fitted, after, name) for name in names}
            needless = [name for name in names if not gains[name] > _least_gain(name)]
            if not needless and not self.worse(after, self.before):
                return Accepted(fitted, after, withdrawn, gains)
            gone = min(needless, key=fitted.share) if needless else min(names, key=lambda name: gains[name])
            withdrawn.append(gone)
            names.remove(gone)
        fitted = fit_model(search, {}, found.nominal.theta)
        after = self.other.compare(fitted.experiment)
        if not self.worse(after, self.before) and is_better(after.errors, self.before.errors):
            return Accepted(fitted, after, withdrawn, {})
        own, known = self.setup.own, np.diag(self.setup.prior**2)
        # if nothing is missing, its numbers are off by as much as the fit says
        off = fitted.white + np.outer(fitted.theta, fitted.theta)
        given = FittedModel((), self.setup.nominal, own, np.zeros(len(own)), known, off)
        return Accepted(given, self.before, withdrawn, {})

    def _gain(self, search: EffectSearch, fitted: FittedModel, after: Comparison, name: str) -> float:
        """Standard errors by which a model beats the one without an effect, all numbers fitted anew.

        Where its own numbers can take the effect's place, the held-out data know nothing of it, and what is known of these
        numbers decides: the deviations from it that they would need, beyond two, are added.
        """
        own, prior = len(self.setup.prior), self.setup.prior
        numbers = {one: values for one, values in fitted.numbers.items() if one != name}
        fewer = fit_model(search, numbers, fitted.theta[:own])
        without, by = (float(np.sum((one.theta[:own] / prior) ** 2)) for one in (fewer, fitted))
        # what two deviations would explain is no sign of anything
        return beaten(self.other, self.other.compare(fewer.experiment), after) + np.sqrt(max(without - by - SURE**2, 0.0))

    def plainer(self, search: EffectSearch, accepted: Accepted, name: str) -> Accepted | None:
        """The model with the special case of an effect in its place, where nothing parts the two: neither the fit
        (:func:`special_case`) nor the held-out data. None where something does."""
        fitted = accepted.fitted
        plain = special_case(fitted, name, self.other.noise)
        if plain is None or plain not in search.lacking or plain in fitted.names:
            return None
        reduced = EFFECTS[name].special_cases[plain.partition(".")[2]]
        numbers = {
            (plain if one == name else one): reduced(values) if one == name else values
            for one, values in fitted.numbers.items()
        }
        less = fit_model(search, numbers, fitted.theta[: len(self.setup.prior)])
        after = self.other.compare(less.experiment)
        if beaten(self.other, after, accepted.after) > SEEN or self.worse(after, self.before):
            return None
        gains = {one: accepted.gains[one] for one in numbers if one != plain} | {
            plain: self._gain(search, less, after, plain)
        }
        return Accepted(less, after, accepted.withdrawn, gains)

    def plausible(self, fitted: FittedModel) -> bool:
        """Whether a model's own numbers are where they may be by what is known of them."""
        return bool(np.all(np.abs(fitted.theta[: len(self.setup.prior)]) < FAR * self.setup.prior))

    def worse(self, after: Comparison, before: Comparison) -> bool:
        """Whether a model is worse than another in a channel: by more than new numbers may cost, and surely so by the blocks
        of held-out data, or by much."""
        for name, value in after.errors.items():
            limit = _WORSE_SPEED if name.startswith("velocity") else _WORSE
            most = max(before.errors[name], self.noise[name])
            if value <= limit * most:
                continue
            if not value <= _SURELY * most:
                return True
            other, own = (_blocks(one.samples[name], self.noise[name]) for one in (before, after))
            if not _standard_errors(other, own) > -SURE:
                return True
        return False

    def controls(self, search: EffectSearch, fitted: FittedModel, after: Comparison, rival: Model | None) -> list[Control]:
        """Controls of a model with effects; `rival`: the best one with a wrong effect, whose numbers are fitted as well."""
        if not fitted.names:
            return []
        found = []
        if rival is not None:
            experiment = fit_model(search, rival.numbers, rival.theta).experiment
            other = self.other.compare(experiment)
            found.append(Control("wrong", other.errors, beaten(self.other, other, after), rival.names[-1], experiment))
        added = {
            side: [one.torque - left.torque for one, left in zip(pieces, after.torques[side], strict=True)]
            for side, pieces in self.before.torques.items()
        }
        shuffled = self.other.permuted(self.setup.nominal, added)
        if shuffled is not None:
            found.append(Control("permuted", shuffled.errors, beaten(self.other, shuffled, after)))
        return found

    def gap(self, fitted: FittedModel, after: Comparison) -> JsonObject:
        """Errors on held-out data before and after, and the noise."""
        task, other, nominal = self.setup.task, self.other, self.setup.nominal
        record, part = task.holdout, task.holdout.segments
        noise = other.noise_of(after)
        found: JsonObject = {
            "holdout": {
                "file": str(record.path.resolve()),
                "separate": task.separate,
                "from": float(record.time[part[0].start]),
                "to": float(record.time[part[-1].stop - 1]),
                "window": other.samples * other.period,
                "bandwidth": dict(other.bandwidth),
            },
            "units": {name: _unit(record, name) for name in after.errors},
            "driving": {"motor": input_rms(record)},
            "holdout_rmse_before": self.before.errors,
            "holdout_rmse_after": after.errors,
            "noise_floor": {name: noise[name] for name in after.errors},
            "free_run": {},
        }
        for name, one in (("before", nominal), ("after", fitted.experiment)):
            errors, growth = other.free_run(one)
            if not growth < PREDICTABLE:
                found["free_run"] = {"why_not": "small changes of the initial speed grow to the size of the motion"}
                break
            found["free_run"][name] = errors
        return found


def beaten(log: ReferenceLog, control: Comparison, after: Comparison) -> float:
    """By how many standard errors a model beats a control, block by block, each channel over its noise.

    All channels together, by the mean of their logarithms, or the channel that shows the difference best if none says
    otherwise: a ripple is seen in the torque, and hardly in windows of the position. Torques are referred to the input: a
    model that multiplies all of them, and the input, by one factor misses the same.
    """
    both = (control, after)
    channels = [name for name in control.samples if not name.startswith("velocity")]
    scales = [{name: one.gain if name.startswith("torque") else 1.0 for name in channels} for one in both]
    floors = [log.noise_floor(one.torques) for one in both]
    noise = {name: np.sqrt(np.prod([floors[i][name] / scales[i][name] for i in range(2)])) for name in channels}
    costs = [
        np.array([_blocks(one.samples[name], scale[name] * noise[name]) for name in channels])
        for one, scale in zip(both, scales, strict=True)
    ]
    together = _standard_errors(*costs)
    each = [_standard_errors(*one) for one in zip(*costs, strict=True)]
    return max(together, *each) if min(each) > -SEEN and max(each) > SEEN else together


def _blocks(errors: np.ndarray, noise: float) -> np.ndarray:
    """Mean squared errors over their noise, by blocks of held-out data."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.array([np.mean(block) for block in np.array_split(np.square(errors / noise).ravel(), _BLOCKS)])


def _standard_errors(control: np.ndarray, model: np.ndarray) -> float:
    """By how many standard errors squared errors of a model over their noise, block by block, are below those of a control;
    shapes (..., blocks), in front channels.

    By logarithms, since a few blocks may have most of the errors, of noise and errors together: what is less than the noise
    counts for nothing, as on a drive that stands still. What structure in the noise may bring is no gain.
    """
    if not (np.isfinite(control).all() and np.isfinite(model).all()):
        return -np.inf if np.isfinite(control).all() else np.inf
    gains = np.mean(np.atleast_2d(np.log1p(control) - np.log1p(model)), axis=0)
    return float(np.mean(gains) / np.hypot(np.std(gains, ddof=1) / np.sqrt(_BLOCKS), 2.0 * FLOOR))


def is_better(new: Errors, old: Errors) -> bool:
    """Whether errors are less, all in all: what new numbers alone have to reach to take the place of those given."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return bool(np.sum(np.log([new[name] for name in old]) - np.log(list(old.values()))) < 0.0)


_UNITS = {"theta": "rad", "velocity": "rad/s", "torque": "N m"}


def _unit(record: Record, name: str) -> str:
    side = "load" if name in ("theta_s", "velocity_load", "torque_load") else "motor"
    return record.unit_of(f"{side}.position", _UNITS[name.split("_")[0]])
