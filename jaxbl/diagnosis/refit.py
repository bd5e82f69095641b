"""Numbers of a model to the last digit: least prediction errors of the simulated predictor itself.

What explains a record is sought with the model linearised about the smoothed motion, whose errors cancel to first order
only. Here the predictor runs over the record with the model as it is, and the model is linearised about the predictor's own
path: prediction errors, and their derivatives by all numbers and by the initial state, are then exact: plain
Gauss-Newton with step control. Windows, or a free run that may diverge, are not needed.
Reference: L. Ljung, System Identification (1999), 7.2, 10.2.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxbl.drive.plant import PlantState
from jaxbl.fused import Arrays
from jaxbl.fused.single_plant import simulate_plant
from jaxbl.identification.free_parameters import FreeParameter, set_free_parameters
from jaxbl.identification.intervals import spread_of
from jaxbl.identification.regression import begun
from jaxbl.identification.segments import Segment
from jaxbl.records.least_squares import BlockRegression
from jaxbl.simulate import Experiment

from .blocks import QUARTERS
from .fitted_model import FittedModel
from .linearised_model import Linear, Predictor
from .neutral_effects import lean

_STEPS = 25
"""Of Gauss-Newton at most in a round, rejected ones among them."""
_SETTLED = 0.02
"""Twice the logarithm of the likelihood that a further step may promise, or the last one has gained."""
_ROUNDS = 2
"""Choices of the predictor, each followed by a fit."""


class _Point(NamedTuple):
    """Numbers and initial states tried: the model there, and minus twice the log-likelihood."""

    theta: np.ndarray
    start: Arrays
    linear: Linear
    predictor: Predictor
    cost: float


class _Refiner:
    """Gauss-Newton with step control."""

    def __init__(
        self, experiment: Experiment, free: Sequence[FreeParameter], width: np.ndarray, segments: Sequence[Segment]
    ):
        self.experiment, self.free, self.width, self.segments = experiment, tuple(free), width, segments

    def start(self) -> Arrays:
        """Positions and velocities at the first sample of each segment, as they were smoothed."""
        sides = self.experiment.sides
        first = [{side: np.asarray(segment.smoothed[side].state[0]) for side in sides} for segment in self.segments]
        return [np.array([one[side][order] for order in (0, 1) for side in sides]) for one in first]

    def at(self, theta: np.ndarray, start: Arrays, smoothness: Sequence[float]) -> _Point:
        """Prediction errors along the path of the predictor."""
        path = self._path(theta, start, smoothness)
        linear = Linear(self.experiment, self.free, theta, self.width, path)
        predictor = linear.predictor(smoothness)
        cost = float(linear.count * np.sum(np.log(predictor.given)) + np.sum((theta / self.width) ** 2))
        return _Point(theta, start, linear, predictor, cost if np.isfinite(cost) else np.inf)

    def _path(self, theta: np.ndarray, start: Arrays, smoothness: Sequence[float]) -> list[Segment]:
        """The segments with the filtered motion of a model in place of the smoothed one."""
        sides = self.experiment.sides
        experiment = set_free_parameters(self.experiment, self.free, theta)
        gain = Linear.gain_of(smoothness, self.segments[0].period)
        gains = {side: gain[j] for j, side in enumerate(sides)}
        found = []
        for segment, first in zip(self.segments, start, strict=True):
            position, velocity = (dict(zip(sides, half, strict=True)) for half in np.split(first, 2))
            effects = begun(experiment, segment.torque[:1], segment.before)
            state = PlantState(position, velocity, effects)
            states = simulate_plant(*lean(experiment, state), segment.torque, segment.time[0], segment.readings, gains)
            filtered = {}
            for side in sides:
                own = segment.smoothed[side]
                # of numbers under which the predictor diverges nothing finite is left
                with np.errstate(invalid="ignore", over="ignore"):
                    error = segment.readings[side] - states.position[side]
                    # the first state is that of the predictor before it has seen anything
                    error[0] = 0.0
                    seen = np.stack([states.position[side], states.velocity[side]], axis=1) + error[:, None] * gains[side]
                state = np.concatenate([seen, np.asarray(own.state)[:, 2:]], axis=1)
                filtered[side] = own._replace(state=state)  # type: ignore[arg-type]
            found.append(dataclasses.replace(segment, smoothed=filtered))
        return found

    def run(self, theta: np.ndarray) -> _Point:
        smoothness = Linear(self.experiment, self.free, theta, self.width, self.segments).choose(()).smoothness
        best = self.at(theta, self.start(), smoothness)
        for i in range(_ROUNDS):
            if i:
                smoothness = best.linear.choose(()).smoothness
                best = self.at(best.theta, best.start, smoothness)
            share = 1.0
            for _ in range(_STEPS):
                if best.cost - best.predictor.cost(best.theta, self.width) < _SETTLED or share < 1e-3:
                    break
                by = best.predictor.coefficients
                change = share * np.clip(by[0][1 : 1 + len(self.free)], -1.0, 1.0)
                start = [one + share * at[-best.linear.states :][: len(one)] for one, at in zip(best.start, by, strict=True)]
                tried = self.at(best.theta + change, start, smoothness)
                if not tried.cost < best.cost:
                    share *= 0.25
                    continue
                gained = best.cost - tried.cost
                best, share = tried, min(1.0, 3.0 * share)
                # where errors are not linear in the numbers a step may promise more than there is
                if gained < _SETTLED:
                    break
        return best

    def covariance(self, point: _Point) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Covariance of theta: of the errors, which may be correlated, and the prior together; and if they are not. And how
        theta changes where one quarter of the log after the other is left out."""
        linear, own, sides = point.linear, len(self.free), len(self.experiment.sides)
        if not own:
            return np.zeros((0, 0)), np.zeros((0, 0)), np.zeros((QUARTERS, 0))
        residual, jacobian = [], []
        for errors in linear.errors(point.predictor.smoothness):
            flat = (errors / np.sqrt(point.predictor.given / linear.count)[None, :, None]).reshape(-1, errors.shape[2])
            states = flat[:, -linear.states :]
            size = np.sqrt(np.sum(states**2, axis=0))
            basis = np.linalg.qr(states[:, size > 1e-20 * np.max(size)] / size[size > 1e-20 * np.max(size)])[0]
            rest = flat[:, : 1 + own] - basis @ (basis.T @ flat[:, : 1 + own])
            residual.append(rest[:, 0].reshape(-1, sides))
            jacobian.append(rest[:, 1:].reshape(-1, sides, own))
        errors, slopes = np.concatenate(residual), np.concatenate(jacobian)
        found = spread_of(errors[None], slopes[None], 2 * sides)
        # samples that only fill up
        real = linear.count / len(errors)
        information, sandwich = real * found.information, found.covariance
        prior = np.diag(self.width**-2.0)
        inverse = np.linalg.inv(information + prior)
        changes = leave_quarters_out(errors, slopes, prior)
        return inverse @ (information @ sandwich @ information + prior) @ inverse, inverse, changes


def leave_quarters_out(errors: np.ndarray, slopes: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Find how least-squares numbers change where one quarter of the rows after the other is left out, to first order.

    Args:
        errors: left by the numbers, over their deviation; shape (rows, sides).
        slopes: their derivatives by the numbers; shape (rows, sides, numbers).
        prior: precision of the numbers, shape (numbers, numbers).

    Returns:
        Changes, shape (quarters, numbers).
    """
    products = BlockRegression.of(errors.ravel(), slopes.reshape(errors.size, -1), QUARTERS).products
    precision = products.sum(axis=0)[:-1, :-1] + prior
    # no number moves by more than once its size: beyond that a first order says nothing
    return np.stack(
        [np.clip(np.linalg.lstsq(precision - part[:-1, :-1], part[:-1, -1], rcond=None)[0], -1.0, 1.0) for part in products]
    )


def refined(
    experiment: Experiment, free: Sequence[FreeParameter], theta: np.ndarray, width: np.ndarray, segments: Sequence[Segment]
) -> FittedModel:
    """Refine the numbers of a model from theta; arguments as of :class:`.linearised_model.Linear` (`width`: its `prior`)."""
    refiner = _Refiner(experiment, free, width, segments)
    best = refiner.run(np.asarray(theta))
    model = set_free_parameters(experiment, free, best.theta)
    covariance, white, left_out = refiner.covariance(best)
    return FittedModel((), model, tuple(free), best.theta, covariance, white, best.linear, left_out, -0.5 * best.cost)
