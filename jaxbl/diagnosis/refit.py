"""Numbers of a model to the last digit: least prediction errors of the simulated predictor itself, and their evidence.

The predictor runs over the log with the model as it is, and the model is linearised about the predictor's own path:
prediction errors, and their derivatives by all numbers and by the initial states, are then exact: plain Gauss-Newton with
step control. Windows, or a free run that may diverge, are not needed. Amplitudes of effects have a prior about zero, as wide
as a good part of the driving torque, and are fitted as they are, through zero; other numbers by their logarithm.
References: L. Ljung, System Identification (1999), 7.2, 10.2; R. Kass, A. Raftery, Bayes factors, J. American Statistical
Association 90 (1995).
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxbl.chain import Experiment
from jaxbl.drive.effects import EFFECTS, Numbers, make_effect
from jaxbl.drive.parameters import get_leaf, leaf_paths, set_leaves
from jaxbl.drive.plant import PlantState
from jaxbl.estimation.free_parameters import FreeParameter, make_free_parameters, set_free_parameters
from jaxbl.estimation.intervals import spread_of
from jaxbl.estimation.logs import arrays
from jaxbl.estimation.regression import begin_states
from jaxbl.estimation.segments import Segment
from jaxbl.fused import Arrays
from jaxbl.fused.single_plant import simulate_plant
from jaxbl.records.least_squares import BlockRegression, fit_residual

from .blocks import QUARTERS
from .candidates import ZERO_SPREAD, EffectNumbers, is_finer_law, owner_of
from .linearised_model import Linear, Predictor, find_gains
from .neutral_effects import complete, lean
from .reference_log import BLOCKS, parts_of_blocks
from .thresholds import LIMITS

_STEPS = 25
"""Of Gauss-Newton at most under one predictor, rejected ones among them."""
_SETTLED = 0.02
"""Twice the logarithm of the likelihood that a further step may promise, or the last one has gained."""
_LEAST_STEP = 0.05
"""Share of a Gauss-Newton step below which no other is tried: friction and gaps make errors rough (benchmarks/NOTES.md)."""
_ROUNDS = 4
"""Choices of the predictor at most, each followed by a fit."""
_LEAST_LEFT = 0.05
"""Share of a positive number that is left of it at least where it is moved."""


class FitPoint(NamedTuple):
    """Numbers and initial states that a fit of prediction errors has tried.

    Attributes:
        theta: of all numbers.
        start: initial positions and velocities of each segment.
        linear: the model there, along the path of its predictor.
        predictor: of it.
        cost: minus twice the log-likelihood, with the prior.
    """

    theta: np.ndarray
    start: Arrays
    linear: Linear
    predictor: Predictor
    cost: float


class FittedModel(NamedTuple):
    """A model with some effects, all numbers fitted.

    Attributes:
        names: of the effects.
        experiment: the model.
        free: numbers that were fitted, its own first.
        theta: of these.
        covariance: of theta.
        white: the same if prediction errors are white, as those of a complete model.
        inflation: of their variances, by not knowing the other numbers; of what is wrong with a number, that of the number.
        end: where the fit ended: another one begins there.
        left_out: changes of theta where one quarter of the log after the other is left out; shape (quarters, theta).
        log_odds: of the effects before the log is seen, nats.
        log_evidence: nats, by Laplace's method (D. MacKay, Neural Computation 4, 1992); only differences count.
        foretold: prediction errors, each quarter by numbers fitted without it, rad, shape (samples, sides).
    """

    names: tuple[str, ...]
    experiment: Experiment
    free: tuple[FreeParameter, ...]
    theta: np.ndarray
    covariance: np.ndarray
    white: np.ndarray
    end: FitPoint
    left_out: np.ndarray | None = None
    log_odds: float = 0.0
    log_evidence: float = -np.inf
    foretold: np.ndarray | None = None
    inflation: np.ndarray = np.ones(0)

    @property
    def linear(self) -> Linear:
        """The model along the log; of the model as given, with its own numbers fitted."""
        return self.end.linear

    def share(self, name: str) -> float:
        """Torque of an effect along the log, rms over the driving torque's."""
        return self.linear.torque_share(get_leaf(self.experiment, f"effects.{name}"))

    def own_share(self, name: str) -> float:
        """Torque of an effect that no other number of the model makes up for, as :meth:`share`."""
        sizes = {f"effects.{name}.{leaf}" for leaf in EFFECTS[name].sizes()}
        inflation = [factor for number, factor in zip(self.free, self.inflation, strict=True) if number.path in sizes]
        return self.share(name) / float(np.sqrt(min(inflation, default=1.0)))

    def missed_share(self, name: str) -> float:
        """Torque that laws of the other effects may miss, as :meth:`share`."""
        laws = [effect for effect in self.experiment.effects if effect.law_error and effect.name != name]
        return float(np.linalg.norm([effect.law_error * self.linear.torque_share(effect) for effect in laws]))

    def counts(self, name: str) -> bool:
        """Tell whether the log shows an effect, and its torque is large enough to be named; of a finer law, what parts it
        from the plain one has to be, too."""
        effect, place, numbers = get_leaf(self.experiment, f"effects.{name}"), name.partition(".")[0], self.numbers[name]
        plain = [make_effect(f"{place}.{kind}", **law) for kind, law in EFFECTS[name].plainer(numbers).items()]
        return self.linear.shows(name, numbers) and all(
            self.linear.torque_share(effect, *less) > LIMITS.least_torque for less in [(), *zip(plain)]
        )

    @property
    def numbers(self) -> dict[str, Numbers]:
        """All numbers of the effects, those that were not free among them."""
        effects = {name: get_leaf(self.experiment, f"effects.{name}") for name in self.names}
        return {
            name: {leaf: float(get_leaf(effect, leaf)) for leaf in leaf_paths(effect)} for name, effect in effects.items()
        }

    def errors(self) -> Numbers:
        """Standard errors of the values."""
        deviation = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return {number.path: float(number.slope(self.theta[i])) * deviation[i] for i, number in enumerate(self.free)}

    def move_by(self, change: np.ndarray) -> Experiment:
        """The model with a change of theta, to first order: a number that the log hardly shows may change by several times
        its size, and by no more; what must stay positive stays so."""
        values = {}
        for number, theta, step in zip(self.free, self.theta, change, strict=True):
            value, slope = float(number.value(theta)), float(number.slope(theta))
            values[number.path] = max(value + slope * step, _LEAST_LEFT * value) if number.positive else value + slope * step
        return set_leaves(self.experiment, arrays(values))


class ModelFits:
    """Fits of models with effects to a log.

    Attributes:
        nominal: the model as given, with every effect at neutral numbers.
        free, prior: its own numbers that are not exactly known, and the standard deviation of each theta.
        segments: of the log.
        log_odds: of that prior, nats.
        given: the model as given along the log.
    """

    def __init__(
        self,
        experiment: Experiment,
        free: Sequence[FreeParameter],
        prior: np.ndarray,
        segments: Sequence[Segment],
        log_odds: float = 0.0,
    ):
        self.nominal, self.free, self.prior, self.segments = complete(experiment), tuple(free), prior, segments
        self.log_odds = log_odds
        self.given = self.linearise({}, 0.0 * prior)
        self._units: dict[tuple[str, ...], float] = {}

    def linearise(self, numbers: EffectNumbers, theta: np.ndarray) -> Linear:
        """Linearise a model with some effects about the motion of the log."""
        experiment = with_numbers(self.nominal, numbers)
        size = float(np.std(np.concatenate([segment.torque for segment in self.segments])))
        added = make_free_parameters(experiment, paths_of(numbers), size)
        widths = [EFFECTS[name].roles()[leaf].width for name, leaf in map(owner_of, added)]
        start, prior = np.concatenate([theta, np.zeros(len(added))]), np.concatenate([self.prior, widths])
        return Linear(experiment, (*self.free, *added), start, prior, self.segments)

    def fit(
        self,
        numbers: EffectNumbers,
        theta: np.ndarray,
        begin: FittedModel | None = None,
        new: Sequence[str] = (),
        promise: float = 0.0,
    ) -> FittedModel:
        """Fit a model with some effects.

        Args:
            numbers: of the effects, to begin with.
            theta: of the model's own numbers, to begin with.
            begin: a model nearby, whose initial states are begun with.
            new: effects that it has not.
            promise: nats that these may gain: if a fit gains less than half, another begins at none of them, as the way
                to a dry friction may lead over a hill.
        """
        end = None if begin is None else begin.end
        before = theta if end is None else end.theta[: len(self.free)]

        def fit_from(numbers: EffectNumbers, theta: np.ndarray, begin: FitPoint | None) -> tuple[_Fit, FitPoint]:
            fit = _Fit(self, numbers)
            return fit, fit.run(theta, begin)

        ends = [fit_from(numbers, theta, end)]
        if new and end is not None and not end.cost - ends[0][1].cost >= promise:
            none = {name: {**numbers[name], **dict.fromkeys(EFFECTS[name].sizes(), 0.0)} for name in new}
            ends.append(fit_from({**numbers, **none}, before, end))
        if np.any(np.abs(before) > LIMITS.far * self.prior):
            # numbers that are far from what is known of them stand for what is missing: no step may lead back from there
            ends.append(fit_from(numbers, 0.0 * theta, None))
        fit, point = min(ends, key=lambda pair: pair[1].cost)
        return fit.finish(point)

    def unit(self, name: str, leaf: str, effects: EffectNumbers) -> float:
        """Find the value of a size of one of some effects at which its torque is as large as effects are."""
        # a torque of the gear hangs on the gap that is there, or on what the load takes
        near = "load." if self.nominal.transmission is None else "transmission."
        beside = effects if name.startswith("transmission.") else {}
        gear = {effect: numbers for effect, numbers in beside.items() if effect.startswith(near) and effect != name}
        key = name, leaf, *sorted(gear)
        if key not in self._units:
            along = self.linearise(gear, 0.0 * self.prior) if gear else self.given
            sizes = EFFECTS[name].sizes()
            single = {key: 0.0 if key in sizes else value for key, value in effects[name].items()} | {leaf: 1.0}
            unit = LIMITS.effect_size / max(along.torque_share(make_effect(name, **single)), 1e-12)
            nominal = self.given.nominal(name)
            unit = unit if nominal is None else min(unit, LIMITS.number_error * nominal)
            self._units[key] = ZERO_SPREAD if EFFECTS[name].in_log else unit
        return self._units[key]


class _Fit:
    """Gauss-Newton with step control for one set of effects."""

    def __init__(self, fits: ModelFits, numbers: EffectNumbers):
        self.fits, self.numbers, self.segments = fits, numbers, fits.segments
        # the error of a number that is free anyway: the number alone is fitted, and less is known of it
        self.released = {name: i for name in numbers if (i := fits.given.same(name)) is not None}
        added = {name: values for name, values in numbers.items() if name not in self.released}
        self.experiment = with_numbers(fits.nominal, added)
        prior, released = fits.prior.copy(), list(self.released.values())
        prior[released] = np.hypot(prior[released], LIMITS.number_error)
        free, theta, width = [], [], []
        for number in make_free_parameters(self.experiment, paths_of(added), 1.0):
            name, leaf = owner_of(number)
            if number.role == "size":
                unit = fits.unit(name, leaf, numbers)
                free.append(number._replace(nominal=0.0, scale=unit, positive=False))
                theta.append(numbers[name][leaf] / unit)
                width.append(1.0)
            else:
                free.append(number)
                theta.append(0.0)
                width.append(EFFECTS[name].roles()[leaf].width)
        self.free, self.added = (*fits.free, *free), np.array(theta)
        self.width = np.concatenate([prior, width])
        choices = sum(fits.given.choices(name) for name in numbers)
        general = sum(is_finer_law(name) + bool(EFFECTS[name].list_released(numbers[name])) for name in numbers)
        self.log_odds = fits.log_odds + LIMITS.effect_odds * len(numbers) + LIMITS.general_odds * general - choices

    def at(self, theta: np.ndarray, start: Arrays, smoothness: Sequence[float]) -> FitPoint:
        """Find the prediction errors along the path of the predictor."""
        path = self._path(theta, start, smoothness)
        linear = Linear(self.experiment, self.free, theta, self.width, path)
        predictor = linear.predictor(smoothness)
        # where all is rounding, squares may come out below zero
        with np.errstate(invalid="ignore"):
            cost = float(linear.count * np.sum(np.log(predictor.given)) + np.sum((theta / self.width) ** 2))
        return FitPoint(theta, start, linear, predictor, cost if np.isfinite(cost) else np.inf)

    def run(self, theta: np.ndarray, begin: FitPoint | None) -> FitPoint:
        """Fit from the model's own numbers; the predictor is chosen anew until that gains nothing."""
        theta = theta.copy()
        for name, i in self.released.items():
            number = self.fits.free[i]
            theta[i] = number.theta(
                max(number.nominal + next(iter(self.numbers[name].values())), _LEAST_LEFT * number.nominal)
            )
        theta = np.concatenate([theta, self.added])
        if begin is None:
            sides = self.experiment.sides
            start = [
                np.array([segment.smoothed[side].state[0, order] for order in (0, 1) for side in sides])
                for segment in self.segments
            ]
        else:
            start = begin.start
        best = self._descend(self.at(theta, start, self._choose(theta) if begin is None else begin.predictor.smoothness))
        for turn in range(_ROUNDS):
            if not np.isfinite(best.cost):
                break
            near = best.linear.choose((), best.predictor.smoothness).smoothness
            # along the smoothed motion what is chosen does not hang on what was chosen before
            first = [self._choose(best.theta)] if turn == 0 else []
            options = [*first, best.linear.best_predictor.smoothness, near]
            points = [
                self.at(best.theta, best.start, smoothness)
                for i, smoothness in enumerate(options)
                if smoothness != best.predictor.smoothness and smoothness not in options[:i]
            ]
            # the one that promises most is followed
            other = min(points, key=lambda point: point.predictor.promise, default=best)
            if not other.predictor.promise < best.cost - _SETTLED:
                break
            other = self._descend(other)
            if not other.cost < best.cost - _SETTLED:
                break
            best = other
        return best

    def _choose(self, theta: np.ndarray) -> Sequence[float]:
        """Choose the predictor along the smoothed motion."""
        return Linear(self.experiment, self.free, theta, self.width, self.segments).best_predictor.smoothness

    def _descend(self, best: FitPoint) -> FitPoint:
        share = 1.0
        for _ in range(_STEPS):
            if best.cost - best.predictor.promise < _SETTLED or share < _LEAST_STEP:
                break
            coefficients = best.predictor.coefficients
            # a size that is far too large may go back to none at once
            none = np.where([number.role == "size" for number in self.free], -best.theta, 0.0)
            change = share * np.clip(coefficients[0][1 : 1 + len(self.free)], np.minimum(-1.0, none), np.maximum(1.0, none))
            start = [
                state + share * vector[-best.linear.states :][: len(state)]
                for state, vector in zip(best.start, coefficients, strict=True)
            ]
            following = self.at(best.theta + change, start, best.predictor.smoothness)
            if not following.cost < best.cost:
                share *= 0.25
                continue
            gained = best.cost - following.cost
            best, share = following, min(1.0, 3.0 * share)
            # where errors are not linear in the numbers a step may promise more than there is
            if gained < _SETTLED:
                break
        return best

    def _path(self, theta: np.ndarray, start: Arrays, smoothness: Sequence[float]) -> list[Segment]:
        """Return the segments with the filtered motion of a model in place of the smoothed one."""
        sides = self.experiment.sides
        experiment = set_free_parameters(self.experiment, self.free, theta)
        gains = dict(zip(sides, find_gains(smoothness, self.segments[0].period), strict=True))
        path = []
        for segment, first in zip(self.segments, start, strict=True):
            position, velocity = (dict(zip(sides, half, strict=True)) for half in np.split(first, 2))
            effects = begin_states(experiment, segment.torque[:1], segment.before)
            state = PlantState(position, velocity, effects)
            states = simulate_plant(*lean(experiment, state), segment.torque, segment.time[0], segment.readings, gains)
            filtered = {}
            for side in sides:
                smoothed = segment.smoothed[side]
                # of numbers under which the predictor diverges nothing finite is left
                with np.errstate(invalid="ignore", over="ignore"):
                    error = segment.readings[side] - states.position[side]
                    # the first state is that of the predictor before it has seen anything
                    error[0] = 0.0
                    corrected = (
                        np.stack([states.position[side], states.velocity[side]], axis=1) + error[:, None] * gains[side]
                    )
                state = np.concatenate([corrected, smoothed.state[:, 2:]], axis=1)
                filtered[side] = smoothed._replace(state=state)  # type: ignore[arg-type]
            path.append(dataclasses.replace(segment, smoothed=filtered))
        return path

    def finish(self, point: FitPoint) -> FittedModel:
        """Make the model, its covariance, and its errors; each quarter's by numbers fitted without it."""
        linear, pieces = point.linear, []
        count, sides = len(self.free), len(self.experiment.sides)
        none, changes = np.full((count, count), np.inf), np.zeros((QUARTERS, count))
        fitted = FittedModel(
            tuple(self.numbers), linear.experiment, self.free, point.theta, none, none, point, changes, self.log_odds
        )
        if not np.isfinite(point.cost):
            return fitted
        size = np.sqrt(point.predictor.given / linear.count)
        for errors in linear.errors(point.predictor.smoothness):
            flat = (errors / size[None, :, None]).reshape(-1, errors.shape[2])
            pieces.append(fit_residual(flat[:, : 1 + count], flat[:, -linear.states :]).reshape(-1, sides, 1 + count))
        errors, slopes = np.split(np.concatenate(pieces), [1], axis=2)
        foretold = errors[:, :, 0].copy()
        covariance = inverse = precision = np.zeros((0, 0))
        if count:
            prior = np.diag(self.width**-2.0)
            spread = spread_of(errors[None, :, :, 0], slopes[None], 2 * sides)
            precision = spread.information + prior
            inverse = np.linalg.inv(precision)
            middle = spread.information @ spread.covariance @ spread.information + prior
            covariance, changes = inverse @ middle @ inverse, leave_quarters_out(errors[:, :, 0], slopes, prior)
            for rows, part in zip(np.array_split(np.arange(len(errors)), BLOCKS), parts_of_blocks(QUARTERS), strict=True):
                foretold[rows] += slopes[rows] @ changes[part]
        return self._release(
            fitted._replace(
                covariance=covariance, white=inverse, left_out=changes, foretold=size * foretold,
                inflation=np.diag(precision) * np.diag(inverse),
                log_evidence=fitted.log_odds - 0.5 * point.cost
                + 0.5 * float(np.linalg.slogdet(inverse)[1]) - float(np.sum(np.log(self.width))),
            )
        )  # fmt: skip

    def _release(self, fitted: FittedModel) -> FittedModel:
        """Give effects what is wrong with numbers that are free; the log tells their sums alone."""
        for name, i in self.released.items():
            number, (path,) = self.fits.free[i], paths_of({name: self.numbers[name]})
            value, slope = (float(of(fitted.theta[i])) for of in (number.value, number.slope))
            numbers = {path: value - number.nominal, number.path: number.nominal}
            experiment = set_leaves(complete(fitted.experiment, [name]), arrays(numbers))
            (added,) = make_free_parameters(experiment, [path], 1.0)
            added = added._replace(nominal=0.0, scale=number.slope(0.0), positive=False)
            variance, factor = self.fits.prior[i] ** 2, slope / float(added.scale)
            rows = np.eye(len(fitted.theta) + 1)[:, :-1]
            rows[-1, i], rows[i, i] = factor, 0.0
            spread = np.zeros(len(rows))
            spread[i], spread[-1] = 1.0, -1.0
            shared = variance * np.outer(spread, spread)
            assert fitted.left_out is not None
            theta = rows @ fitted.theta
            theta[-1] = (value - number.nominal) / float(added.scale)
            fitted = fitted._replace(
                experiment=experiment, free=(*fitted.free, added), theta=theta, left_out=fitted.left_out @ rows.T,
                covariance=rows @ fitted.covariance @ rows.T + shared, white=rows @ fitted.white @ rows.T + shared,
                inflation=np.append(fitted.inflation, fitted.inflation[i]),
            )  # fmt: skip
        return fitted


def leave_quarters_out(errors: np.ndarray, slopes: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Find how least-squares numbers change where one quarter of the rows after the other is left out, to first order.

    Args:
        errors: left by the numbers, over their deviation; shape (rows, sides).
        slopes: their derivatives by the numbers; shape (rows, sides, numbers).
        prior: precision of the numbers, shape (numbers, numbers).

    Returns:
        Changes, shape (quarters, numbers).
    """
    blocks = BlockRegression.of(errors.ravel(), slopes.reshape(errors.size, -1), BLOCKS).products
    products = np.stack([blocks[parts_of_blocks(QUARTERS) == part].sum(axis=0) for part in range(QUARTERS)])
    precision = products.sum(axis=0)[:-1, :-1] + prior
    # no number moves by more than once its size: beyond that a first order says nothing
    return np.stack(
        [np.clip(np.linalg.lstsq(precision - part[:-1, :-1], part[:-1, -1], rcond=None)[0], -1.0, 1.0) for part in products]
    )


def paths_of(effects: EffectNumbers) -> list[str]:
    """Return the dotted paths of the numbers of effects that are fitted: a harmonic is a whole number, and some are held."""
    return [
        f"effects.{name}.{leaf}"
        for name, numbers in effects.items()
        for leaf, role in EFFECTS[name].roles().items()
        if role.kind not in ("harmonic", "held") or leaf in EFFECTS[name].list_released(numbers)
    ]


def with_numbers(experiment: Experiment, values: EffectNumbers) -> Experiment:
    """A model with all effects (:func:`.neutral_effects.complete`), some of them with these numbers."""
    leaves = {f"effects.{name}.{leaf}": value for name, numbers in values.items() for leaf, value in numbers.items()}
    return set_leaves(complete(experiment, values), arrays(leaves))
