"""A model linearised about the measured motion: what any torque that it lacks would do to its prediction errors.

The smoothed motion x_k is measured, the model's step F(x, u) is known. With x^_k = x_k + d_k the one-step predictor with
gain L obeys, to first order,

    d_{k+1} = A_k (d_k + L e_k) + F(x_k, u_k) - x_{k+1} + B_k w_k,   e_k = y_k - C x^_k,

with A, B the derivatives of one step by state and torque, and w whatever torque is missing. Prediction errors are then
linear in the initial state, in changes of the model's numbers and in all amplitudes of missing effects, exactly as those of
the simulated predictor to first order; errors of the smoothed motion cancel. Nothing diverges, as a free run over a whole
record would, and a thousand candidate torques cost one recursion with a thousand columns.
References: L. Ljung, System Identification (1999), 7.4; M. Basseville, Detecting changes in signals and systems,
Automatica 24 (1988), for the local approach.
"""

# arrays of numpy go where those of jax are asked for
# pyright: reportArgumentType=false

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from scipy.signal import find_peaks

from jaxbl.chain import Experiment
from jaxbl.drive.effects import EFFECTS, AbstractEffect, Numbers, Scales
from jaxbl.drive.effects.loads import TRIAL_ARC
from jaxbl.drive.parameters import get_leaf
from jaxbl.drive.plant import PlantState
from jaxbl.estimation.free_parameters import FreeParameter, set_free_parameters
from jaxbl.estimation.prediction import kalman_gain
from jaxbl.estimation.regression import Path, effect_states
from jaxbl.estimation.segments import Segment, reading_noise
from jaxbl.fused import Arrays
from jaxbl.fused.compilation import jit
from jaxbl.fused.linear_predictor import LinearPredictor
from jaxbl.fused.single_plant import Direction, step_derivatives
from jaxbl.records.least_squares import rms
from jaxbl.workers import map_in_threads

from .candidates import NO_CANDIDATE, REACH, Candidate, Forces, MotionTorques, Part, columns_of, owner_of
from .evidence import Products
from .neutral_effects import bucket, find_corrected, lean, with_torques
from .thresholds import LIMITS

_SAMPLES = 1024
"""Least padded length of a part, so that records of about one length share their compiled programs."""


class _Steps(NamedTuple):
    """A model's steps along a part of a record, linear in everything that may change.

    Attributes:
        step: A, shape (samples, states, states).
        force: B, by torque on each side and by the input, shape (samples, states, sides + 1).
        by_number: change of a step by each free number (theta), shape (samples, states, numbers).
        defect: model's step less the smoothed one, shape (samples, states).
        readings: position over its smoothed value, rad, shape (samples, sides).
    """

    step: np.ndarray
    force: np.ndarray
    by_number: np.ndarray
    defect: np.ndarray
    readings: np.ndarray

    def _errors_along(self, gains: Sequence[np.ndarray], forces: Forces) -> Iterator[Arrays]:
        """Prediction errors under each gain, rad, some samples after the others; shape (sides, samples, columns). Columns:
        constant, own numbers, forces, initial states."""
        count, states = self.defect.shape
        own_width = 1 + self.by_number.shape[2]
        width = own_width + forces.width + states
        recursion = LinearPredictor(states, self.readings.shape[1], width)
        begun = np.zeros((states, width))
        begun[:, -states:] = np.eye(states)
        changes = [begun] * len(gains)
        length = max(_VALUES // width, 64)
        for first in range(0, count, length):
            rows = slice(first, min(first + length, count))
            driven = np.zeros((states, rows.stop - first, width))
            driven[:, :, 0] = self.defect[rows].T
            driven[:, :, 1:own_width] = self.by_number[rows].transpose(1, 0, 2)
            driven[:, :, own_width:-states] = forces.driving(self.force[rows], rows)
            changes, errors = recursion(changes, gains, self.step[rows], driven, self.readings[rows])
            yield errors

    def errors(self, gain: np.ndarray, forces: Forces) -> np.ndarray:
        """All prediction errors under a gain, rad, shape (samples, sides, columns)."""
        return np.concatenate([errors.transpose(1, 0, 2) for (errors,) in self._errors_along([gain], forces)])

    def grams(self, gains: Sequence[np.ndarray], forces: Forces) -> np.ndarray:
        """Products of the columns of the prediction errors with one another, rad^2, for several gains, by side;
        shape (gains, sides, columns, columns)."""
        total = np.zeros(())
        # of a gain under which errors diverge
        with np.errstate(invalid="ignore", over="ignore"):
            for errors_by_gain in self._errors_along(gains, forces):
                total = total + [np.matmul(errors.transpose(0, 2, 1), errors) for errors in errors_by_gain]
        return total

    def gradient(self, gain: np.ndarray, left: np.ndarray) -> np.ndarray:
        """Derivative of the sum of products of errors with `left` by the torque at each sample, shape
        (samples, sides + 1)."""
        sides, adjoints = left.shape[1], np.zeros_like(self.defect)
        # nothing of the gain is on the effects' own states
        gains = np.zeros((self.defect.shape[1], sides))
        gains[: 2 * sides] = np.concatenate([np.diag(column) for column in gain.T])
        for k in range(len(left) - 1, 0, -1):
            adjoint = adjoints[k] @ self.step[k]
            adjoint[:sides] -= adjoint @ gains + left[k]
            adjoints[k - 1] = adjoint
        return np.einsum("tij,ti->tj", self.force, adjoints)


def _linearise(
    experiment: Experiment, free: Sequence[FreeParameter], theta: np.ndarray, segment: Segment
) -> tuple[Part, _Steps]:
    """A model along a segment, where its free numbers are at theta."""
    sides, smoothed = experiment.sides, segment.smoothed
    experiment, added = with_torques(experiment)
    count = len(segment)
    # behind the last sample, that one again
    rows = np.minimum(np.arange(bucket(count, _SAMPLES)), count - 1)
    states = {side: smoothed[side].state[rows] for side in sides}
    deviation = {side: smoothed[side].deviation(1)[rows] for side in sides}
    period = float(experiment.run.sample_period)
    held = {side: np.pad(smoothed[side].find_standstill(period), (0, len(rows) - count)) for side in sides}
    read = np.stack([segment.readings[side] - smoothed[side].state[:, 0] for side in sides], axis=1)
    time, torque = segment.time[rows], segment.torque[rows]
    position, velocity, acceleration = ({side: states[side][:, i] for side in sides} for i in range(3))
    effects = effect_states(experiment, Path(time, torque, position, velocity, before=segment.before))
    motion = PlantState(position, velocity, jax.tree.map(np.asarray, effects))
    experiment, motion = lean(experiment, motion, [number.path for number in free])
    # by side, not by name
    names, side_count = sorted(sides), len(sides)
    order = [names.index(side) + i * side_count for i in range(2) for side in sides]
    state_count = 2 * side_count
    for effect, state in zip(experiment.effects, motion.effects, strict=True):
        states_of = len(jax.tree.leaves(state))
        # what is known has no error that a predictor could have
        order += [] if effect.state_from_input else range(state_count, state_count + states_of)
        state_count += states_of
    # each state, torque on each side, input, each free number
    ways = [
        *(Direction(state=row) for row in np.eye(state_count)[order].tolist()),
        *(Direction({path: -1.0}) for path in added.values()),
        Direction(torque=1.0),
        *(Direction({number.path: float(number.slope(now))}) for number, now in zip(free, theta, strict=True)),
    ]
    slope, value = step_derivatives(experiment, motion, torque, time, ways)
    slope, value = slope[:, order, :count].transpose(2, 1, 0), value[order].T
    vectors = np.stack(jax.tree.leaves(motion), axis=1)[:, order]
    defect = np.zeros((count, len(order)))
    # a path along which a model diverges has nothing finite
    with np.errstate(invalid="ignore", over="ignore"):
        modelled = {side: (value[:, side_count + i] - vectors[:, side_count + i]) / period for i, side in enumerate(sides)}
        # nothing happens from the last reading on
        defect[:-1] = value[: count - 1] - vectors[1:count]
    step, force, by_number = np.split(slope, (len(order), len(order) + side_count + 1), axis=2)
    part = Part(time, torque, position, velocity, acceleration, modelled, deviation, held, before=segment.before)
    return part, _Steps(step, force, by_number, defect, read)


_COARSE_SMOOTHNESS = 10.0 ** np.arange(-11.0, 1.0)
"""Ratios of process to reading noise, tried for all sides at once: from a filter over thousands of samples to none."""
_FINE_SMOOTHNESS = 10.0 ** np.array([-3.0, -2.0, -1.0, 1.0, 2.0, 3.0])
"""Factors on the best of them, side by side."""
_FREQUENCIES, _COARSE = 8, 16
"""Peaks of the spectrum that are tried; frequencies at which the response to a torque is computed, smooth in between."""
_LEAST_PERIODS = 3.0
"""Of a periodic torque in a log: with fewer it is a constant or a drift."""
_MOST_WAVES, _PLACES = 400, 8192
"""Periods a turn that are tried at most: more than poles times slots of most motors. Places of a turn, told apart."""
_HIGHEST = 50.0
"""Hz: a torque of a higher frequency hardly moves a drive."""
_NO_INPUT = 1e-3
"""Input over the torque that the motion takes, rms, below which the drive moves freely."""
DIVERGED = 1e30
"""Products of prediction errors, over their variance or in rad^2, from which on a model diverges: squares soon overflow."""
_SILENT = 1e-20
"""Influence of an initial state over that of others, squared, below which it has none (the state of a neutral effect):
rounding is 1e-16."""
_ALIKE = 1e-12
"""Influence of a combination of initial states over the largest, squared, below which two of them are one."""
_LOST = 0.01
"""Nats that rounding may take (benchmarks/NOTES.md): under too low a gain the influence of an initial state grows."""
_VALUES = 65536
"""Samples times columns that the recursion takes at once: what it knows and finds of them stays in the cache."""
_TOGETHER = 64
"""Columns from which on further candidates are taken through the recursion by themselves, by another thread if there is one:
no two candidates are in a model at once."""


class Predictor:
    """Prediction errors under one gain: sums of squares, and the coefficients that leave the least.

    Attributes:
        smoothness: of each side.
        given: sum of squared errors of each side as the model stands, the effects' own initial states at their best, rad^2;
            shape (sides,).
        squares: the least that changes of all numbers leave; as `given`.
        deviation: rms of the errors that these leave, rad; as `given`.
        coefficients: of all columns, part by part; 1 first.
    """

    def __init__(self, linear: "Linear", smoothness: list[float], grams: Arrays):
        self.smoothness, self.count, self.theta, self.prior = smoothness, linear.count, linear.theta, linear.prior
        sides, own_count, states, count = len(linear.sides), len(linear.free), linear.states, linear.count
        self.given = np.sum([_as_it_stands(gram, states - 2 * sides) for gram in grams], axis=0)
        width = grams[0].shape[1] - 1 - states
        # of a gain under which errors diverge, or all but: what is left is smaller than the rounding of their products
        self.squares, self.coefficients = np.full(sides, np.inf), [np.zeros(gram.shape[1]) for gram in grams]
        if not np.max([np.max(np.abs(gram)) for gram in grams]) < DIVERGED:
            return
        weight = np.ones(sides)
        prior, centre = np.full(width, np.inf), np.zeros(width)
        prior[:own_count], centre[:own_count] = self.prior, -self.theta
        for turn in range(2):
            eliminated = [_eliminate(np.einsum("s,scd->cd", weight, gram), states) for gram in grams]
            total = np.sum([products for products, _, _ in eliminated], axis=0)
            variance = 1.0 if turn else max(total[0, 0] / (count * sides), 1e-300)
            lost = sum(loss for _, _, loss in eliminated) / variance
            if lost > _LOST or total[0, 0] < 0.0 or np.min(np.diag(total)[1:], initial=0.0) < 0.0:
                return
            free = np.concatenate([[1.0], _least_squares(total, variance / prior**2, centre)])
            coefficients = [np.concatenate([free, -response @ free]) for _, response, _ in eliminated]
            left = [np.einsum("c,scd,d->s", vector, gram, vector) for vector, gram in zip(coefficients, grams, strict=True)]
            squares = np.sum(left, axis=0)
            if not (squares > 0.0).all():
                return
            weight = count / squares
        self.squares, self.coefficients = squares, coefficients

    @property
    def deviation(self) -> np.ndarray:
        return np.sqrt(self.squares / self.count)

    @property
    def log_square(self) -> float:
        """Sum of the logarithms of the squares; infinite where the errors of a side diverge."""
        return float(np.sum(np.log(self.squares)))

    @property
    def promise(self) -> float:
        """Minus twice the log-likelihood, with the prior's, that a step from theta promises."""
        moved = self.theta + self.coefficients[0][1 : 1 + len(self.theta)]
        return self.count * self.log_square + float(np.sum((moved / self.prior) ** 2))


@jit
def _figures(experiment: Experiment) -> tuple[Any, dict[str, Any]]:
    """Gain of the input, and inertia of each side over its ratio, kg m^2: as one program."""
    plant = experiment.plant
    return plant.input_gain, {side: plant.inertia(side) / plant.drive.ratio(side) for side in plant.drive.sides}


def find_driving_torque(experiment: Experiment, segments: Sequence[Segment]) -> tuple[float, bool]:
    """Find the size of the torques along a log, N m rms at the motor: the input's; where there is none, what the motion
    takes. And whether it is the input's."""
    gain, inertia = _figures(experiment)
    driving = float(gain) * rms(np.concatenate([segment.torque for segment in segments]))
    taken = [float(inertia[side]) * segment.smoothed[side].acceleration for segment in segments for side in experiment.sides]
    inertial = rms(np.concatenate(taken))
    return (driving, True) if driving > _NO_INPUT * inertial else (inertial, False)


class Linear:
    """A model along a record, linear in everything that may change."""

    def __init__(
        self,
        experiment: Experiment,
        free: Sequence[FreeParameter],
        theta: Float[np.ndarray, " numbers"],
        prior: np.ndarray,
        segments: Sequence[Segment],
    ):
        """Linearise a model about the motion of a log.

        Args:
            experiment: the model (:func:`.neutral_effects.complete`); its sample period is that of the log.
            free, theta: numbers that may change, and where they are.
            prior: standard deviation of each theta about 0.
            segments: of the log.
        """
        self.free, self.theta, self.prior = tuple(free), np.asarray(theta), prior
        self.experiment = set_free_parameters(experiment, free, self.theta)
        self.period, self.sides = segments[0].period, experiment.sides
        self.steps, self.signals = list[_Steps](), list[MotionTorques]()
        for segment in segments:
            part, steps = _linearise(self.experiment, free, self.theta, segment)
            self.steps.append(steps)
            self.signals.append(MotionTorques(self.experiment, part, segment))
        self.count, self.states = sum(map(len, segments)), self.steps[0].defect.shape[1]
        self.input_gain = float(_figures(self.experiment)[0])
        self.drive, self.driven = find_driving_torque(self.experiment, segments)
        self._noise, self._scales = reading_noise(segments), dict[str, Scales]()

    def scales(self, name: str) -> Scales:
        """Measure how large things are on the record, as an effect sees them; frequencies and waves only if it has some."""
        place, roles = self._place_of(name), EFFECTS[name].roles
        scales = self._scales_at(place)
        if roles("frequency") and not scales.frequencies:
            scales = scales._replace(frequencies=tuple(self.frequencies(place)))
        if roles("harmonic") and place in self.sides and not scales.waves:
            scales = scales._replace(waves=tuple(self.waves(place)))
        self._scales[place] = scales
        return scales

    def _place_of(self, name: str) -> str:
        """Return where an effect of a full name acts."""
        return self.experiment.drive.resolve_place(name.partition(".")[0])

    def _scales_at(self, place: str) -> Scales:
        if place in self._scales:
            return self._scales[place]

        def join(of) -> np.ndarray:
            return np.concatenate([of(signals.part)[: signals.samples] for signals in self.signals])

        side = place if place in self.sides else "motor"
        speed = join(lambda part: part.velocity[side])
        # samples tell waves apart where the side moves as fast as in a quarter of the log
        slow = float(np.quantile(np.abs(speed), 0.25))
        position = join(lambda part: part.position[self.sides[-1] if place == "transmission" else side])
        ratio, twist = float(self.experiment.drive.ratio("load")), np.zeros(1)
        if len(self.sides) == 2:
            twist = join(lambda part: part.position["motor"] - ratio * part.position["load"])
        harmonics: list[float] = []
        for effect in self.experiment.effects:
            acts = any(float(getattr(effect, leaf)) != 0.0 for leaf in effect.sizes())
            if acts and self.experiment.drive.resolve_place(effect.place) == side:
                harmonics += [float(getattr(effect, leaf)) for leaf in effect.roles("harmonic")]
        self._scales[place] = Scales(
            torque=float(np.max(np.abs(join(lambda part: part.torque)))),
            period=self.period,
            duration=self.count * self.period,
            twist=rms(twist),
            largest_twist=float(np.max(np.abs(twist))),
            speed=rms(speed),
            spread=float(np.std(position)),
            travel=float(np.ptp(position)),
            noise=self._noise[side],
            ratio=ratio,
            harmonics=tuple(harmonics),
            wave_count=int(np.clip(0.5 * np.pi / max(slow * self.period, 1e-9), 1, _MOST_WAVES)),
        )
        return self._scales[place]

    def choices(self, name: str) -> float:
        """Logarithm of the number of values that an effect was sought with, where each could be told from the next."""
        count = 1.0
        for role in EFFECTS[name].roles().values():
            if role.kind == "frequency":
                count *= max(self.count * self.period * self._highest, 1.0)
            elif role.kind == "harmonic":
                log = self._scales_at(self._place_of(name))
                count *= max(log.wave_count if role.among_waves else len(role.trials(log)), 1)
        return float(np.log(count))

    @property
    def _highest(self) -> float:
        """Frequency up to which a disturbance is sought, Hz: half of what the samples show, and what a drive passes on."""
        return min(0.25 / self.period, _HIGHEST)

    def predictor(self, smoothness: Sequence[float]) -> Predictor:
        """Prediction errors under a given gain."""
        (predictor,) = self._predictors([list(smoothness)], [Forces(())] * len(self.steps))
        return predictor

    def errors(self, smoothness: Sequence[float]) -> Arrays:
        """Prediction errors under a given gain, part by part, rad; shape (samples, sides, columns)."""
        return [steps.errors(find_gains(smoothness, self.period), Forces(())) for steps in self.steps]

    @cached_property
    def best_predictor(self) -> Predictor:
        """The predictor with the least errors, without candidates."""
        return self.choose(())

    def choose(self, variants: Sequence[Candidate], near: Sequence[float] | None = None) -> Predictor:
        """The predictor with the least errors, some candidates taken in; the search begins at a smoothness of each side."""
        forces = [Forces(columns_of(variants, signals)) for signals in self.signals]
        begin = [[float(q)] * len(self.sides) for q in _COARSE_SMOOTHNESS] if near is None else [list(near)]
        chosen = min(self._predictors(begin, forces), key=lambda predictor: predictor.log_square)
        for i in range(len(self.sides)) if len(self.sides) > 1 or near is not None else ():
            now, least = chosen.smoothness, _COARSE_SMOOTHNESS[0]
            options = [[max(float(q * f), least) if j == i else q for j, q in enumerate(now)] for f in _FINE_SMOOTHNESS]
            chosen = min(chosen, *self._predictors(options, forces), key=lambda predictor: predictor.log_square)
        return chosen

    def _predictors(self, options: list[list[float]], forces: list[Forces]) -> list[Predictor]:
        gains = [find_gains(smoothness, self.period) for smoothness in options]
        grams = [steps.grams(gains, force) for steps, force in zip(self.steps, forces, strict=True)]
        return [Predictor(self, smoothness, [gram[i] for gram in grams]) for i, smoothness in enumerate(options)]

    def frequencies(self, place: str) -> list[float]:
        """Frequencies (Hz) at which a disturbance of a side explains most, of the longest part."""
        i = int(np.argmax([signals.samples for signals in self.signals]))
        span, top = self.signals[i].samples * self.period, self._highest
        few = np.geomspace(min(1.0 / span, 0.5 * top), top, _COARSE)
        slope, power = self._answer(i, place, few, 2.0 * np.pi * self.signals[i].part.time)
        size = 4 * 2 ** int(np.ceil(np.log2(len(slope))))
        frequency = np.fft.rfftfreq(size, self.period)
        inside = (frequency >= _LEAST_PERIODS / span) & (frequency <= top)
        return _peaks(frequency, np.abs(np.fft.rfft(slope, size)) ** 2, few, power, inside, size // len(slope) + 1)

    def waves(self, place: str) -> list[float]:
        """Periods a turn at which a torque over the position of a side explains most."""
        log = self._scales_at(place)
        few = np.unique(np.round(np.geomspace(1.0, max(log.wave_count, 2), _COARSE)))
        by_place, power = np.zeros(_PLACES), 0.0 * few
        for i, signals in enumerate(self.signals):
            position = signals.part.position[place]
            slope, more = self._answer(i, place, few, position)
            where = np.mod(position[: len(slope)] / (2.0 * np.pi), 1.0) * _PLACES
            by_place += np.bincount(np.minimum(where.astype(int), _PLACES - 1), slope, _PLACES)
            power += more
        number = np.arange(_PLACES // 2 + 1.0)
        inside = (number * log.travel > TRIAL_ARC) & (number <= log.wave_count)
        return _peaks(number, np.abs(np.fft.rfft(by_place)) ** 2, few, power, inside, 1)

    def _answer(self, i: int, place: str, few: np.ndarray, phase: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Tell what a torque on a side does to the prediction errors of a part under the :attr:`best_predictor`, at what
        that leaves over: their derivative by the torque at each sample, shape (samples,); and the power of the response to
        waves of `few` periods along a `phase`, shape (waves,)."""
        steps, side, predictor = self.steps[i], self.sides.index(place), self.best_predictor
        gain, deviation = find_gains(predictor.smoothness, self.period), predictor.deviation
        if not np.isfinite(deviation).all():
            # no predictor follows this model
            return np.zeros(self.signals[i].samples), np.ones(len(few))
        left = steps.errors(gain, Forces(())) @ predictor.coefficients[i]
        along = few[:, None] * phase[None, :]
        waves = Forces([{side: np.concatenate([np.sin(along), np.cos(along)])}])
        responses = steps.errors(gain, waves)[:, :, 1 + len(self.free) : -self.states]
        power = np.sum((responses / deviation[None, :, None]) ** 2, axis=(0, 1)).reshape(2, -1).mean(axis=0)
        return steps.gradient(gain, left / deviation[None, :] ** 2)[:, side], power

    def find_errors_left(self, smoothness: Sequence[float]) -> Arrays:
        """Errors that are left under a given gain when all numbers are at their best, part by part, rad; shape
        (samples, sides)."""
        parts = self.errors(smoothness), self.predictor(smoothness).coefficients
        return [errors @ coefficients for errors, coefficients in zip(*parts, strict=True)]

    def products(self, variants: Sequence[Candidate], predictor: Predictor) -> list[Products]:
        """Products of everything that the prediction errors under a predictor's gain are linear in, over what it leaves of
        them, initial states eliminated: of the model alone, and then with each candidate."""
        gain, groups = find_gains(predictor.smoothness, self.period), _groups([NO_CANDIDATE, *variants])
        forces_of_all = [[Forces(columns_of(group, signals)) for signals in self.signals] for group in groups]

        def multiply(forces: list[Forces]) -> tuple[np.ndarray, np.ndarray]:
            grams = [
                np.einsum("s,scd->cd", predictor.deviation**-2.0, steps.grams([gain], force)[0])
                for steps, force in zip(self.steps, forces, strict=True)
            ]
            power = np.sum([self._power(force) for force in forces], axis=0)
            return np.sum([_eliminate(gram, self.states)[0] for gram in grams], axis=0), power

        # the constant and the own numbers come first
        shared, models = 1 + len(self.free), list[Products]()
        for group, (gram, power) in zip(groups, map_in_threads(multiply, forces_of_all), strict=True):
            end = shared
            for variant in group:
                begin, end = end, end + variant.width + variant.offset
                rows = [*range(shared), *range(begin, end)]
                spread = self._spread(variant, power[begin - shared : end - shared])
                scale, centre = np.concatenate([[np.inf], self.prior, spread]), np.zeros(len(rows))
                centre[1:shared] = -self.theta
                models.append(Products(variant, gram[np.ix_(rows, rows)], scale, centre, self._twins(variant.name)))
        return models

    def _spread(self, variant: Candidate, power: np.ndarray) -> np.ndarray:
        """Prior standard deviation of each coefficient of a candidate, and of what is there without."""
        if variant.spread:
            return np.full(len(power), variant.spread)
        with np.errstate(divide="ignore"):
            # what has no torque along this motion cannot be found
            size = LIMITS.effect_size * self.drive / np.sqrt(power / self.count)
        nominal = self.nominal(variant.name)
        return size if nominal is None else np.minimum(size, LIMITS.number_error * nominal)

    def _twins(self, candidate: str) -> dict[int, tuple[int, float]]:
        """Columns that are those of other numbers: the error of a number that is free acts as that number does."""
        slopes = [*(float(number.slope(now)) for number, now in zip(self.free, self.theta, strict=True)), 1.0]
        owners = [*(owner_of(number)[0] for number in self.free), candidate]
        return {1 + k: (1 + i, slopes[k] / slopes[i]) for k, name in enumerate(owners) if (i := self.same(name)) is not None}

    def _power(self, torques: Forces) -> np.ndarray:
        """Sums of squares of torques, referred to the motor."""
        over = {i: float(self.experiment.drive.ratio(side)) for i, side in enumerate(self.sides)}
        return torques.squares(over | {-1: 1.0 / self.input_gain})

    def find_input_significance(self) -> float:
        """Standard deviations by which the prediction errors show the input; infinite where the record has none."""
        if not self.driven:
            return np.inf
        # the torque of the input once more
        again = Candidate("input", 1, (), lambda signals, _: {-1: signals.part.torque[None, : signals.samples]})
        _, with_input = self.products([again], self.best_predictor)
        return float(np.sqrt(with_input.products[-1, -1]))

    def shows(self, name: str, numbers: Numbers) -> bool:
        """Tell whether the log can show an effect with these numbers: a gap three times as wide as any twist, or contacts
        that bend over a third of the motion, would look like another effect."""
        log = self._scales_at(self._place_of(name))
        return all(
            numbers[leaf] <= np.exp(REACH) * max(role.trials(log), default=np.inf)
            for leaf, role in EFFECTS[name].roles().items()
            if role.kind == "shape" or leaf in EFFECTS[name].list_released(numbers)
        )

    def torque_share(self, effect: AbstractEffect, *plain: AbstractEffect) -> float:
        """Torque of an effect along the log, less that of a plain law of it, rms over the driving torque's."""
        power = 0.0
        for signals in self.signals:
            torques, *plain_torques = signals.of([effect, *plain])
            apart = {place: torque - sum(law.get(place, 0.0) for law in plain_torques) for place, torque in torques.items()}
            power += self._power(Forces([apart]))[0]
        return float(np.sqrt(power / self.count)) / self.drive

    def same(self, name: str) -> int | None:
        """Index of the model's own number that an effect is the error of."""
        path = find_corrected(name)
        return next((i for i, number in enumerate(self.free) if number.path == path), None)

    def nominal(self, name: str) -> float | None:
        """The number of the drive that an effect is the error of, if it is one and is not zero."""
        path = find_corrected(name)
        value = 0.0 if path is None else float(get_leaf(self.experiment, path))
        return value if value > 0.0 else None


def _peaks(
    waves: np.ndarray, score: np.ndarray, few: np.ndarray, power: np.ndarray, inside: np.ndarray, distance: int
) -> list[float]:
    """Waves at which a score, over the power that noise gives it (known at a `few`), has its highest peaks, so many
    waves of the list apart. Neither the first nor the last wave is `inside`."""
    expected = np.exp(np.interp(np.log(np.maximum(waves, 1e-9)), np.log(few), np.log(np.maximum(power, 1e-300))))
    score = np.where(inside, score / expected, 0.0)
    peaks, _ = find_peaks(score, distance=distance)
    return waves[peaks[np.argsort(-score[peaks])][:_FREQUENCIES]].tolist()


def find_gains(smoothness: Sequence[float], period: float) -> np.ndarray:
    """Find the steady-state gains of both sides, shape (sides, 2)."""
    return np.stack([kalman_gain(q, period) for q in smoothness])


def _groups(variants: Sequence[Candidate]) -> list[list[Candidate]]:
    """Neighbours whose columns are taken through the recursion together; one empty group if there are none."""
    groups: list[list[Candidate]] = [[]]
    for variant in variants:
        if sum(other.width + other.offset for other in groups[-1]) >= _TOGETHER:
            groups.append([])
        groups[-1].append(variant)
    return groups


def _least_squares(total: np.ndarray, precision: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Find the coefficients of the columns behind the first, with a prior."""
    matrix = total[1:, 1:] + np.diag(precision)
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    towards = total[1:, 0] - precision * centre
    return -np.linalg.lstsq(matrix / np.outer(size, size), towards / size, rcond=1e-12)[0] / size


def _as_it_stands(grams: np.ndarray, states: int) -> np.ndarray:
    """Squares of the first column by side, some last states at their best."""
    if states == 0 or not np.isfinite(grams).all():
        return grams[:, 0, 0]
    weight = 1.0 / np.maximum(grams[:, 0, 0], 1e-300)
    total = np.einsum("s,scd->cd", weight, grams)
    vector = np.zeros(total.shape[0])
    vector[0] = 1.0
    vector[-states:] = -_eliminate(total, states)[1][:, 0]
    return np.einsum("c,scd,d->s", vector, grams, vector)


def _eliminate(gram: np.ndarray, states: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Take the initial states, the last columns, which may be all but alike, off the others.

    Returns:
        Products of the others without what the states explain, coefficients of the states for each of the others, and what
        rounding may take off the square of the first column.
    """
    inner, across, lost = gram[-states:, -states:], gram[-states:, :-states], 0.0
    # of a model that diverges
    if not np.isfinite(inner).all():
        response = np.zeros_like(across)
        return gram[:-states, :-states] - gram[:-states, -states:] @ response, response, lost
    # infinite where a state does nothing
    size = np.sqrt(np.maximum(np.diag(inner), 0.0))
    size = np.where(size > _SILENT * np.max(size), size, np.inf)
    values, vectors = np.linalg.eigh(inner / np.outer(size, size))
    largest = np.max(np.abs(values))
    significant = np.abs(values) > _ALIKE * largest
    inverse = (vectors * np.where(significant, 1.0 / np.where(significant, values, 1.0), 0.0)) @ vectors.T
    response = (inverse @ (across / size[:, None])) / size[:, None]
    # a state without influence has a zero of its own among these
    least = np.sort(np.abs(values))[np.sum(~np.isfinite(size))] if np.isfinite(size).any() else largest
    if largest > 0.0:
        lost = float(np.finfo(float).eps * gram[0, 0] / max(least / largest, _SILENT))
    return gram[:-states, :-states] - gram[:-states, -states:] @ response, response, lost
