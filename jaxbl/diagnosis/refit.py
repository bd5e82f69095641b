"""Numbers of a model to the last digit: least prediction errors of the simulated predictor itself.

What explains a record is sought with the model linearised about the smoothed motion, whose errors cancel to first order
only. Here the predictor runs over the record with the model as it is, and the model is linearised about the predictor's own
path: prediction errors, and their derivatives by all numbers and by the initial state, are then exact, and what is left is
Gauss-Newton with step control. Windows, or a free run that may diverge, are not needed.
Reference: L. Ljung, System Identification (1999), 7.2, 10.2.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxbl.drive.plant import PlantState
from jaxbl.fused.single_plant import path
from jaxbl.identification.intervals import spread
from jaxbl.identification.regression import settled
from jaxbl.identification.smoother import Smoothed
from jaxbl.identification.trajectory import Fit, Free, with_values
from jaxbl.records import Record
from jaxbl.simulate import Experiment

from .linearised_model import Linear, Predictor

Array = np.ndarray

_STEPS = 25
_SETTLED = 0.02
"""Twice the logarithm of the likelihood that a further step may gain."""
_ROUNDS = 2
"""Choices of the predictor, each followed by a fit."""


class Refined(NamedTuple):
    """A model with the numbers of largest likelihood.

    Attributes:
        experiment: with these numbers.
        theta: of the free ones.
        deviation: standard deviation of theta, of data and prior together.
        smoothness: of the predictor, by side.
        start: positions and velocities at the first sample of each part, side by side, rad and rad/s.
        linear: the model along the path of its predictor.
    """

    experiment: Experiment
    theta: Array
    deviation: Array
    smoothness: list[float]
    start: list[Array]
    linear: Linear


class _Point(NamedTuple):
    """Numbers and initial states tried: the model there, and minus twice the log-likelihood."""

    theta: Array
    start: list[Array]
    linear: Linear
    predictor: Predictor
    cost: float


class _Refiner:
    def __init__(
        self,
        experiment: Experiment,
        free: Sequence[Free],
        width: Array,
        record: Record,
        smoothed: Mapping[str, Sequence[Smoothed]],
    ):
        self.experiment, self.free, self.width = experiment, tuple(free), width
        self.record, self.smoothed = record, smoothed

    def start(self) -> list[Array]:
        """Positions and velocities at the first sample of each part, as they were smoothed."""
        count = len(self.record.segments)
        sides = self.experiment.sides
        first = [{side: np.asarray(self.smoothed[side][i].state[0]) for side in sides} for i in range(count)]
        return [np.array([one[side][order] for order in (0, 1) for side in sides]) for one in first]

    def at(self, theta: Array, start: list[Array], smoothness: Sequence[float] | None) -> _Point:
        """Prediction errors along the path of the predictor; of the best, where no smoothness is given."""
        smoothed = self.smoothed
        if smoothness is not None:
            smoothed = self._path(theta, start, smoothness)
        linear = Linear(self.experiment, self.free, theta, self.width, -theta, self.record, smoothed)
        if smoothness is None:
            smoothness, _ = linear.choose(())
            return self.at(theta, start, smoothness)
        predictor = linear.predictor(smoothness)
        cost = float(linear.count * np.sum(np.log(predictor.given)) + np.sum((theta / self.width) ** 2))
        return _Point(theta, start, linear, predictor, cost if np.isfinite(cost) else np.inf)

    def _path(self, theta: Array, start: list[Array], smoothness: Sequence[float]) -> dict[str, list[Smoothed]]:
        """The smoothed motion with the filtered one of a model in its place."""
        record, sides = self.record, self.experiment.sides
        assert record.torque is not None
        experiment = with_values(self.experiment, self.free, jnp.asarray(theta))
        gain = np.asarray(Linear.gain_of(smoothness, record.sample_period))
        gains = {side: gain[j] for j, side in enumerate(sides)}
        found: dict[str, list[Smoothed]] = {side: [] for side in sides}
        for i, rows in enumerate(record.segments):
            torque, first = record.torque[rows], record.time[rows.start] - record.time[0]
            readings = {side: record.positions[side][rows] for side in sides}
            position, velocity = (dict(zip(sides, half, strict=True)) for half in np.split(start[i], 2))
            begun = PlantState(position, velocity, settled(experiment, torque[0]))
            states = path(experiment, begun, torque, first, readings, gains)
            for side in sides:
                own = self.smoothed[side][i]
                # of numbers under which the predictor diverges nothing finite is left
                with np.errstate(invalid="ignore", over="ignore"):
                    error = readings[side] - states.position[side]
                    # the first state is that of the predictor before it has seen anything
                    error[0] = 0.0
                    seen = np.stack([states.position[side], states.velocity[side]], axis=1) + error[:, None] * gains[side]
                state = np.concatenate([seen, np.asarray(own.state)[:, 2:]], axis=1)
                found[side].append(own._replace(state=state))  # type: ignore[arg-type]
        return found

    def run(self, theta: Array) -> _Point:
        best = self.at(theta, self.start(), None)
        for i in range(_ROUNDS):
            if i:
                best = self.at(best.theta, best.start, best.linear.choose(())[0])
            smoothness = best.predictor.smoothness
            share = 1.0
            for _ in range(_STEPS):
                if best.cost - best.predictor.cost(best.theta, self.width) < _SETTLED or share < 1e-3:
                    break
                by = best.predictor.coefficients
                change = share * np.clip(by[0][1 : 1 + len(self.free)], -1.0, 1.0)
                start = [one + share * at[-best.linear.states :][: len(one)] for one, at in zip(best.start, by, strict=True)]
                tried = self.at(best.theta + change, start, smoothness)
                if tried.cost < best.cost:
                    best, share = tried, min(1.0, 3.0 * share)
                else:
                    share *= 0.25
        return best

    def deviation(self, point: _Point) -> Array:
        """Standard deviations of theta: of the errors, which may be correlated, and the prior together."""
        linear, own, sides = point.linear, len(self.free), len(self.experiment.sides)
        residual, jacobian = [], []
        for errors in linear.errors(point.predictor.smoothness):
            flat = (errors / np.sqrt(point.predictor.given / linear.count)[None, :, None]).reshape(-1, errors.shape[2])
            states = flat[:, -linear.states :]
            size = np.sqrt(np.sum(states**2, axis=0))
            basis = np.linalg.qr(states[:, size > 1e-20 * np.max(size)] / size[size > 1e-20 * np.max(size)])[0]
            rest = flat[:, : 1 + own] - basis @ (basis.T @ flat[:, : 1 + own])
            residual.append(rest[:, 0].reshape(-1, sides))
            jacobian.append(rest[:, 1:].reshape(-1, sides, own))
        fit = Fit(
            jnp.asarray(point.theta), PlantState(dict.fromkeys(self.experiment.sides, jnp.zeros(1)), {}, ()),
            jnp.asarray(np.concatenate(residual)[None]), jnp.asarray(np.concatenate(jacobian)[None]),
            jnp.asarray(0.0), jnp.asarray(0), jnp.asarray(True),
        )  # fmt: skip
        found = _spread(fit)
        # samples that only fill up
        real = linear.count / fit.residual[0, :, 0].size
        information, sandwich = real * np.asarray(found.information), np.asarray(found.covariance)
        prior = np.diag(self.width**-2.0)
        inverse = np.linalg.inv(information + prior)
        return np.sqrt(np.maximum(np.diag(inverse @ (information @ sandwich @ information + prior) @ inverse), 0.0))


_spread = eqx.filter_jit(spread)


def refined(
    experiment: Experiment,
    free: Sequence[Free],
    theta: Array,
    width: Array,
    record: Record,
    smoothed: Mapping[str, Sequence[Smoothed]],
) -> Refined:
    """Refine the numbers of a model.

    Args:
        experiment: the model with all effects (:func:`.complete.complete`); its sample period is that of the record.
        free: numbers to be refined.
        theta: where they start, shape (numbers,).
        width: standard deviation of the prior of each theta about 0.
        record: the log.
        smoothed: its positions, part by part.
    """
    refiner = _Refiner(experiment, free, width, record, smoothed)
    best = refiner.run(np.asarray(theta))
    model = with_values(experiment, free, jnp.asarray(best.theta))
    return Refined(model, best.theta, refiner.deviation(best), best.predictor.smoothness, best.start, best.linear)
