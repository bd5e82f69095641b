"""The proof on what was held out: whether a model with the missing effects predicts it better, beside floor and controls."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxbl.drive.parameters import get_leaf, leaf_paths
from jaxbl.identification.logs import unit_on
from jaxbl.identification.trajectory import Free
from jaxbl.records import Record
from jaxbl.simulate import Experiment

from .diagnosis_task import input_rms
from .effect_search import FLOOR, EffectSearch, Explanation, Model
from .reference_log import PREDICTABLE, Comparison
from .setup import Setup

_WORSE, _WORSE_SPEED = 1.02, 1.05
"""Errors of a model over those of the one given, or over the noise, up to which it is no worse: what numbers fitted on other
data cost; of speeds the noise is known less well."""

_BLOCKS = 16
"""Of held-out data, over which errors are compared: many enough for a standard error, and longer than errors are correlated
in most logs."""


class FittedModel(NamedTuple):
    """A model with some effects, all numbers fitted.

    Attributes:
        names: of the effects.
        experiment: the model.
        free: numbers that were fitted, its own first.
        theta: of these.
        covariance: of theta.
        white: the same if prediction errors are white, as those of a complete model.
    """

    names: tuple[str, ...]
    experiment: Experiment
    free: tuple[Free, ...]
    theta: np.ndarray
    covariance: np.ndarray
    white: np.ndarray

    @property
    def numbers(self) -> dict[str, dict[str, float]]:
        """All numbers of the effects, those that were not free among them."""
        effects = {name: get_leaf(self.experiment, f"effects.{name}") for name in self.names}
        return {name: {leaf: float(get_leaf(one, leaf)) for leaf in leaf_paths(one)} for name, one in effects.items()}

    def errors(self) -> dict[str, float]:
        """Standard errors of the values."""
        deviation = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return {one.path: float(one.slope(self.theta[i])) * deviation[i] for i, one in enumerate(self.free)}


def free_values(free: Sequence[Free], theta: np.ndarray) -> dict[str, float]:
    """Values of free numbers, by path; theta may have others behind them."""
    return {one.path: float(one.value(theta[i])) for i, one in enumerate(free)}


def fit_model(search: EffectSearch, numbers: Mapping[str, Mapping[str, float]], theta: np.ndarray) -> FittedModel:
    """A model with some effects, its own numbers and theirs fitted from given ones."""
    found = search.refitted({name: dict(one) for name, one in numbers.items()}, theta)
    return FittedModel(tuple(numbers), found.experiment, found.linear.free, found.theta, found.covariance, found.white)


class Control(NamedTuple):
    """What must not do as well on what was held out as the model with effects.

    Attributes:
        kind: `wrong`, the best model with another effect in place of the last, or `permuted`, the torque that the effects
            add, shuffled in time.
        errors: rms, by channel.
        z: standard errors by which the errors of the model with effects are smaller.
        effect: the other one.
    """

    kind: str
    errors: dict[str, float]
    z: float
    effect: str = ""


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

    def accepted(self, search: EffectSearch, found: Explanation) -> tuple[FittedModel, Comparison, list[str]]:
        """The model with what was found, how it compares, and the effects that are withdrawn: with them it is
        worse than as given, or no better than without the last of them."""
        names, withdrawn = found.model.names, []
        while True:
            base = found.model if names else found.nominal
            fitted = fit_model(search, {name: base.numbers[name] for name in names}, base.theta)
            after = self.other.compare(fitted.experiment)
            kept = not self._worse(after) and (names or is_better(after.errors, self.before.errors))
            if kept and (len(names) < 2 or self._beaten(self._without_last(search, found, names), after) > 0.0):
                return fitted, after, withdrawn
            if not names:
                break
            withdrawn.append(names[-1])
            names = names[:-1]
        own, known = self.setup.own, np.diag(self.setup.prior**2)
        # if nothing is missing, its numbers are off by as much as the fit says
        off = fitted.white + np.outer(fitted.theta, fitted.theta)
        return FittedModel((), self.setup.nominal, own, np.zeros(len(own)), known, off), self.before, withdrawn

    def _without_last(self, search: EffectSearch, found: Explanation, names: Sequence[str]) -> Comparison:
        """How a model without the last of its effects compares."""
        model = found.model
        fewer = fit_model(search, {name: model.numbers[name] for name in names[:-1]}, model.theta)
        return self.other.compare(fewer.experiment)

    def _worse(self, after: Comparison) -> bool:
        """Whether a model is worse than the one given on what was held out, by more than noise."""
        return any(
            not value
            <= (_WORSE_SPEED if name.startswith("velocity") else _WORSE) * max(self.before.errors[name], self.noise[name])
            for name, value in after.errors.items()
        )

    def controls(self, search: EffectSearch, fitted: FittedModel, after: Comparison, rival: Model | None) -> list[Control]:
        """Controls of a model with effects; `rival`: the best one with a wrong effect, whose numbers are fitted as well."""
        if not fitted.names:
            return []
        found = []
        if rival is not None:
            other = self.other.compare(fit_model(search, rival.numbers, rival.theta).experiment)
            found.append(Control("wrong", other.errors, self._beaten(other, after), rival.names[-1]))
        added = {
            side: [one.torque - left.torque for one, left in zip(pieces, after.torques[side], strict=True)]
            for side, pieces in self.before.torques.items()
        }
        shuffled = self.other.permuted(self.setup.nominal, added)
        if shuffled is not None:
            found.append(Control("permuted", shuffled.errors, self._beaten(shuffled, after)))
        return found

    def _beaten(self, control: Comparison, after: Comparison) -> float:
        """By how many standard errors a model beats a control, block by block, each channel over the model's own noise.

        By logarithms, since a few blocks may have most of the errors; what structure in the noise may bring is no gain.
        """
        costs = np.zeros((2, _BLOCKS))
        for cost, one in zip(costs, (control, after), strict=True):
            floor = self.other.noise_floor(one.torques)
            for name in floor:
                if not name.startswith("velocity"):
                    with np.errstate(invalid="ignore", over="ignore"):
                        blocks = np.array_split(np.square(one.samples[name] / floor[name]).ravel(), _BLOCKS)
                    cost += [float(np.mean(block)) for block in blocks]
        if not np.isfinite(costs[0]).all():
            return np.inf
        gains = np.log(np.maximum(costs, np.finfo(float).tiny))
        gains = gains[0] - gains[1]
        return float(np.mean(gains) / np.hypot(np.std(gains, ddof=1) / np.sqrt(_BLOCKS), 2.0 * FLOOR))

    def gap(self, fitted: FittedModel, after: Comparison) -> dict[str, Any]:
        """Errors on held-out data before and after, and the noise."""
        task, other, nominal = self.setup.task, self.other, self.setup.nominal
        record, part = task.holdout, task.holdout.segments
        found: dict[str, Any] = {
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
            "noise_floor": other.noise_floor(after.torques),
            "free_run": {},
        }
        for name, one in (("before", nominal), ("after", fitted.experiment)):
            errors, growth = other.free_run(one)
            if not growth < PREDICTABLE:
                found["free_run"] = {"why_not": "small changes of the initial speed grow to the size of the motion"}
                break
            found["free_run"][name] = errors
        return found


def is_better(new: Mapping[str, float], old: Mapping[str, float]) -> bool:
    """Whether errors are less, all in all: what new numbers alone have to reach to take the place of those given."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return bool(np.sum(np.log([new[name] for name in old]) - np.log(list(old.values()))) < 0.0)


_UNITS = {"theta": "rad", "velocity": "rad/s", "torque": "N m"}


def _unit(record: Record, name: str) -> str:
    side = "load" if name in ("theta_s", "velocity_load", "torque_load") else "motor"
    return unit_on(record, f"{side}.position", _UNITS[name.split("_")[0]])
