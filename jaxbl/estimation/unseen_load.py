"""A drive whose load has no encoder: its numbers, the gap above all, from the motor's encoder and torque alone.

While the gap is crossed the motor turns nothing but its own inertia; then it hits the load, which has gone on with the speed
that its own friction left it, and from there on turns both. So the model of both inertias runs along the log and the motor's
readings correct the motor's side alone; the load moves by what the model transmits to it. Prediction errors of the motor are
least where the numbers are right.

Over the half gap the likelihood has several maxima. So the fit begins at half gaps from what the encoder resolves to what
the motor travels: frictions first, inertias and stiffness as given, with a predictor that follows the readings closely and
so remembers little; then all numbers, with one that remembers more; from the best on with the one of the least errors.
References: L. Ljung, System Identification (1999), 7.2; M. Nordin, P.-O. Gutman, Controlling mechanical systems with
backlash: a survey, Automatica 38 (2002), 4 (what a motor's side shows of a gap).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.special import chdtri

from jaxbl.chain import Experiment
from jaxbl.drive.effects import AbstractEffect
from jaxbl.drive.parameters import get_leaf
from jaxbl.drive.plant import EffectStates, PlantState
from jaxbl.fused.single_plant import PlantSimulator
from jaxbl.records.least_squares import rms
from jaxbl.records.signal_quality import estimate_white_noise
from jaxbl.workers import announce

from .descent import descend, linearise
from .free_parameters import PRIOR_DEVIATION, FreeParameter, free_values
from .intervals import LIMIT, Spread, spread_of, step_at_limit
from .prediction import kalman_gain
from .regression import begin_states
from .segments import Segment, reading_noise

_STEP, _SHORTEST = 1e-2, 1e-6
"""Largest and least change of theta, or of a start, for derivatives."""
_SHARE = 0.3
"""Of a standard error: change of a number for its derivative. Impacts and standstill make corners in what a number does,
finer than its standard error; a derivative has to see over them."""
_FOLLOWING = 1e-2, 1e-4
"""Smoothness q h^3 / sigma^2 of the predictors that a fit begins with: they remember some 3 and 10 samples."""
_SMOOTHNESS = 10.0 ** np.arange(-13.0, 0.1)
"""Values tried for the last predictor, from a free run to one that follows every reading."""
_SHARES = np.array([0.2, 0.5, 0.85])
"""Of the load in the frictions that a fit begins with."""
_STARTS = 12
"""Half gaps that a fit begins at."""
_FEW, _MORE = 7, 12
"""Steps of the fit: at each half gap it begins at, and with each predictor."""
_BACK = 4
"""Back from a fit beside it."""
_CHOICES = 4
"""Of the predictor that suits the fit, at most."""
_FINALISTS = 6
"""Half gaps of which the fit goes on."""
_PART = 4000
"""Samples that the first fits are made to."""
_SETTLED = 0.01
"""Gain in minus twice the log-likelihood below which a fit has ended: a tenth of a standard error."""
_RESOLVED = 0.15
"""Of a plant step times the fastest frequency of the drive: Moreau's rule is then off by a thousandth of it."""
SHOWN = float(chdtri(1.0, 1e-3))
"""Gain in minus twice the log-likelihood over the model without a gap from which on a gap is shown: 1 in 1000 by chance."""
_SKIPPED = 0.15
"""Share of each part of a log in which the load finds its way: where it begins is not known, and many places would fit."""
_APART = 0.2
"""Prior standard deviation of the load's first speed about the motor's, over the motor's rms speed."""
_STATES = 4
"""Numbers that a part of a log begins with: positions and velocities of both sides."""
_IN_CONTACT = np.array([0.0, 0.0, 1.0, 0.0])
"""Size of these by the prior: at a flank of the gap, the load as fast as the motor."""
GAPS = "half_gap", "dead_zone"
"""Ends of the paths of numbers that make a gap."""


class Point(NamedTuple):
    """Numbers tried.

    Attributes:
        theta: of the free numbers.
        start: of each segment: motor position and velocity off the smoothed ones, in their standard deviations; twist over
            what half gap and wind-up make; load speed off the motor's. Shape (segments, 4).
        smoothness: of the predictor.
        errors: prediction errors of the motor, all segments one after the other without their beginnings, rad, shape
            (count,); none before they are computed.
        deviance: minus twice the log-likelihood, the noise that suits it best, with the priors; up to a constant.
    """

    theta: np.ndarray
    start: np.ndarray
    smoothness: float
    errors: np.ndarray = np.empty(0)
    deviance: float = np.inf

    @property
    @np.errstate(all="ignore")
    def variance(self) -> float:
        """Mean square of the prediction errors, rad^2; infinite where the model diverges."""
        return float(np.nan_to_num(np.mean(self.errors**2), nan=np.inf))

    @property
    def away(self) -> np.ndarray:
        """Theta, and starts off the mean of their prior: in contact on the flank that each is at; shape (numbers,)."""
        return np.concatenate([self.theta, (self.start - np.sign(self.start) * _IN_CONTACT).ravel()])


@dataclass(eq=False)
class UnseenLoad:
    """Fits of a model with two inertias to the motor's readings.

    Attributes:
        experiment: the model, with array leaves, at the log's period.
        free: numbers to be fitted.
        width: prior standard deviation of each one's theta, shape (free,).
        segments: of the log, with the motor's motion.
        at_rest: whether each begins at rest.
        held: places of free numbers that stay where a fit begins.
    """

    experiment: Experiment
    free: tuple[FreeParameter, ...]
    width: np.ndarray
    segments: Sequence[Segment]
    at_rest: bool
    held: list[int] = field(default_factory=list)

    def __post_init__(self):
        # half gaps are sought over decades
        self.free = tuple(number._replace(positive=number.positive or is_gap(number)) for number in self.free)
        self.period = float(self.experiment.run.sample_period)
        self.skipped = [int(_SKIPPED * len(segment)) for segment in self.segments]
        # segment of each error
        self.owner = np.repeat(np.arange(len(self.segments)), np.subtract([*map(len, self.segments)], self.skipped))
        self.count = len(self.owner)
        self.precision = np.concatenate([self.width**-2.0, np.ones(_STATES * len(self.segments))])
        self._speed = rms(np.concatenate([segment.smoothed["motor"].velocity for segment in self.segments]))
        self.torque = rms(np.concatenate([segment.torque for segment in self.segments]))
        self.noise = reading_noise(self.segments)["motor"]

    @cached_property
    def torque_noise(self) -> float:
        """White noise of the recorded torque, N m."""
        return estimate_white_noise([segment.torque for segment in self.segments])

    @property
    def gap(self) -> int | None:
        """Place of the number that makes the gap, if it is one of the free ones."""
        return next((i for i, number in enumerate(self.free) if is_gap(number)), None)

    @property
    def travel(self) -> float:
        """Range of the motor's positions in the part with the largest, rad."""
        return float(max(np.ptp(segment.readings["motor"]) for segment in self.segments))

    def beginnings(self) -> list[np.ndarray]:
        """Theta to begin at, shape (free,): frictions that together are what the log shows of a drive without gap, mostly
        the motor's and mostly the load's.

        From a friction that is too large no way leads back: the load sticks, and nothing depends on it.
        """
        motions = [segment.kinematics for segment in self.segments]
        rows = np.concatenate([[k.torque, k.acceleration["motor"], k.velocity["motor"]] for k in motions], axis=1)
        torque, acceleration, speed = rows[:, np.abs(rows[2]) > 0.1 * self._speed]
        columns = np.stack([acceleration, speed, np.sign(speed), np.ones_like(speed)], axis=1)
        coefficients = np.linalg.lstsq(columns, torque, rcond=None)[0]
        least = np.array([1e-2 * self.torque / self._speed, 1e-2 * self.torque])
        total, thetas = np.maximum(coefficients[1:3], least), np.zeros((len(_SHARES), len(self.free)))
        viscous = {"drive.motor_viscous": "motor", "drive.load_viscous": "load"}
        dry = {
            f"effects.{effect.name}.torque": effect.place
            for effect in self.experiment.effects
            if type(effect).dry_friction is not AbstractEffect.dry_friction
        }
        # friction at the load counts by a power of the gear at the motor
        for size, power, side_of in zip(total, (2, 1), (viscous, dry), strict=True):
            places = [i for i, number in enumerate(self.free) if number.path in side_of]
            shares = [1.0 - _SHARES, _SHARES] if len(places) > 1 else [np.ones_like(_SHARES)]
            for i, share in zip(places, shares, strict=False):
                factor = float(self.experiment.drive.ratio(side_of[self.free[i].path])) ** -power
                thetas[:, i] = [self.free[i].theta(part * size / factor) for part in share]
        return list(thetas)

    def coarse(self) -> "UnseenLoad":
        """The same with plant steps just short enough for the drive's fastest oscillation."""
        plant = self.experiment.plant
        assert plant.transmission is not None
        ratio = float(plant.drive.ratio("load"))
        inverse = 1.0 / float(plant.inertia("motor")) + ratio**2 / float(plant.inertia("load"))
        # numbers may grow on the way
        fastest = np.sqrt(2.0 * float(plant.transmission.stiffness) * inverse)
        return self._with_steps(int(np.clip(np.ceil(self.period * fastest / _RESOLVED), 1, self.experiment.run.substeps)))

    def _with_steps(self, steps: int) -> "UnseenLoad":
        """The same with so many plant steps a sample."""
        return replace(self, experiment=replace(self.experiment, run=replace(self.experiment.run, substeps=steps)))

    @np.errstate(over="ignore")
    def numbers(self, theta: np.ndarray) -> dict[str, float]:
        """Values by path."""
        return free_values(self.free, theta)

    def number(self, path: str, theta: np.ndarray) -> float:
        """Value of a number of the model, free or not."""
        return self.numbers(theta).get(path, float(get_leaf(self.experiment, path)))

    def half_gap(self, theta: np.ndarray) -> float:
        """Half gap, rad."""
        if self.gap is None:
            return self.experiment.plant.half_gap
        number = self.free[self.gap]
        return half_gap_of(number) * self.numbers(theta)[number.path]

    def with_gap(self, half: float, theta: np.ndarray) -> np.ndarray:
        """Theta with a half gap, rad."""
        place: Any = self.gap
        number = self.free[place]
        return np.where(np.arange(len(theta)) == place, number.theta(half / half_gap_of(number)), theta)

    def states(self, point: Point) -> list[PlantState]:
        """The predictor's states before it has seen each sample's reading, by segment, leaves of shape (samples,)."""
        numbers, gain = self.numbers(point.theta), {"motor": kalman_gain(float(point.smoothness), self.period)}
        ratio = self.number("drive.gear_ratio", point.theta)
        largest = self.half_gap(point.theta) + self.torque / self.number("transmission.stiffness", point.theta)
        states_of = []
        for segment, effects, offset in zip(self.segments, self._first_states, point.start, strict=True):
            motion, still = segment.smoothed["motor"], float(not self.at_rest)
            position, velocity = (motion.state[0, i] + motion.deviation(i)[0] * offset[i] for i in (0, 1))
            load = velocity + _APART * self._speed * offset[3]
            state = PlantState(
                {"motor": position, "load": (position - largest * offset[2]) / ratio},
                {"motor": still * velocity, "load": still * load / ratio},
                effects,
            )
            arguments = state, segment.torque, segment.time[0], segment.readings
            states = self._model(numbers, *jax.tree.map(lambda x: np.asarray(x)[None], arguments), gain=gain)
            states_of.append(jax.tree.map(lambda x: x[0], states))
        return states_of

    # a model that diverges is given up by its errors
    @np.errstate(all="ignore")
    def evaluate(self, point: Point) -> Point:
        """A point with its prediction errors by this model."""
        pieces = zip(self.segments, self.states(point), self.skipped, strict=True)
        errors = [(segment.readings["motor"] - state.position["motor"])[skip:] for segment, state, skip in pieces]
        point = point._replace(errors=np.concatenate(errors))
        deviance = float(self.count * np.log(point.variance) + np.sum(self.precision * point.away**2))
        return point._replace(deviance=deviance if np.isfinite(deviance) else np.inf)

    def twists(self, point: Point) -> list[Any]:
        """Twist by segment, rad, shape (samples,)."""
        ratio = self.number("drive.gear_ratio", point.theta)
        return [state.position["motor"] - ratio * state.position["load"] for state in self.states(point)]

    def count_turns(self, point: Point, size: float) -> int:
        """Count changes of sign of the twist between values of at least some size, rad: of flanks, if it is the half gap."""
        return sum(int(np.count_nonzero(np.diff(np.sign(twist[np.abs(twist) >= size])))) for twist in self.twists(point))

    @cached_property
    def _first_states(self) -> list[EffectStates]:
        """States of effects that each segment begins with."""
        return jax.tree.map(
            float, [begin_states(self.experiment, segment.torque[:1], segment.before) for segment in self.segments]
        )

    @cached_property
    def _model(self) -> PlantSimulator:
        zero: Any = {"motor": 0.0, "load": 0.0}
        example = PlantState(zero, zero, self._first_states[0])
        return PlantSimulator(self.experiment, example, [number.path for number in self.free], ["motor"])

    def begin(self, theta: np.ndarray, smoothness: float) -> Point:
        """With each segment beginning where in the gap, and with which speed of the load, suits it best."""
        none = Point(theta, np.zeros((len(self.segments), _STATES)), smoothness)
        tries = [(0.0, 0.0, twist, speed) for twist in (1.0, -1.0, 1e-3) for speed in (0.0, 2.0, -2.0)]
        squares = [
            np.bincount(self.owner, self.evaluate(none._replace(start=none.start + start)).errors ** 2) for start in tries
        ]
        best = np.argmin(np.nan_to_num(squares, nan=np.inf), axis=0)
        return self.evaluate(none._replace(start=np.array(tries)[best]))

    def predict(self, theta: np.ndarray, smoothness: float) -> Point:
        """Prediction errors of given numbers; initial states alone are fitted, first with predictors that follow closely."""
        model = replace(self, held=list(range(len(self.free))))
        point = model.begin(theta, _FOLLOWING[0])
        for following in (*_FOLLOWING, smoothness):
            point = model.resume(point, _FEW, following)
        return point

    def slopes(self, point: Point, size: np.ndarray | None = None) -> np.ndarray:
        """Derivatives of the errors by theta and by the starts, rad, shape (samples, free + 4 segments); 0 where held.

        `size`: standard errors, all else known; shape (free + 4 segments,).
        """
        count, rows = len(self.free), np.arange(self.count)
        step = np.full(count + point.start.size, 1e-2 * _STEP) if size is None else np.clip(_SHARE * size, _SHORTEST, _STEP)
        columns = np.zeros((self.count, len(step)))
        # a start acts in its own segment: those of all segments at once
        for i in {*range(count + _STATES)} - {*self.held}:
            column = np.full(self.count, i) if i < count else i + _STATES * self.owner
            change = np.zeros(len(step))
            change[column] = step[column]
            columns[rows, column] = (self.evaluate(self._move(point, change)).errors - point.errors) / step[column]
        return np.where(np.isfinite(columns), columns, 0.0)

    def _move(self, point: Point, change: np.ndarray) -> Point:
        """A point whose theta and starts are changed."""
        theta, start = np.split(change, [len(self.free)])
        return point._replace(theta=point.theta + theta, start=point.start + start.reshape(point.start.shape))

    def solve(self, point: Point, steps: int) -> Point:
        """Levenberg-Marquardt from a point, with its predictor."""
        size = None

        def linearise_here(point: Point) -> tuple[np.ndarray, np.ndarray]:
            nonlocal size
            slope = self.slopes(point, size)
            matrix, towards = linearise(point.errors, slope, point.away, self.precision, point.variance)
            towards[self.held] = 0.0
            size = np.diag(matrix) ** -0.5
            return matrix, towards

        return descend(
            point,
            linearise_here,
            lambda point, change: self.evaluate(self._move(point, np.clip(change, -1.0, 1.0))),
            steps,
            lambda _: _SETTLED,
        )[0]

    def resume(self, point: Point, steps: int, smoothness: float | None = None) -> Point:
        """Go on from the numbers of a point, of another model or with another predictor; as :meth:`solve`."""
        return self.solve(self.evaluate(point._replace(smoothness=smoothness or point.smoothness)), steps)

    def finish(self, point: Point) -> Point:
        """Fit with the predictor that suits it best: the one whose errors are least is chosen, fitted, and so on."""
        for _ in range(_CHOICES):
            before = point.smoothness
            predictors = [self.evaluate(point._replace(smoothness=float(smoothness))) for smoothness in _SMOOTHNESS]
            point = self.solve(_likeliest([point, *predictors]), _MORE)
            if point.smoothness == before:
                break
        return point

    def fit(self, thetas: Sequence[np.ndarray] = ()) -> Point:
        """The best fit from some numbers, by default :meth:`beginnings`: from a predictor that follows the readings closely
        to the one that suits the model."""
        coarse = self.coarse()
        begun = [coarse.begin(theta, _FOLLOWING[-1]) for theta in thetas or self.beginnings()]
        return self.finish(_likeliest([coarse.finish(coarse.solve(point, _MORE)) for point in begun]))

    def measure_unexplained(self, point: Point) -> float:
        """Torque that moves the motor beside the model's by the predictor that suits best, white, N m rms a sample."""
        inertia = self.number("drive.motor_inertia", point.theta)
        return inertia * point.smoothness**0.5 * self.noise / self.period**2

    def settle(self, point: Point) -> tuple[Point, Spread]:
        """Find the best of a point and of fits beside it, and the covariance there.

        Impacts make the likelihood rough over less than its standard errors, and plant steps are finite: what predictors
        with a longer and a shorter memory, and one with twice the plant steps, find differently counts as an error; so does
        what noise in the recorded torque, once more as much, changes.
        """
        announce("standard errors")
        neighbours = [self._with_steps(2 * self.experiment.run.substeps).resume(point, _FEW)]
        neighbours += [self.resume(point, _FEW, factor * point.smoothness) for factor in _OTHERS]
        best = _likeliest([point, *(self.resume(other, _BACK, point.smoothness) for other in neighbours)])
        for seed in range(_DRAWS if self.torque_noise > _QUIET * self.torque else 0):
            draw = partial(np.random.default_rng(seed).normal, 0.0, self.torque_noise)
            noisier = [replace(segment, torque=segment.torque + draw(len(segment))) for segment in self.segments]
            neighbours.append(replace(self, segments=noisier).resume(best, _FEW))
        # not their mean: some end in the valley that they came from, and say nothing
        changes = [other.theta - best.theta for other in neighbours if np.isfinite(other.deviance)]
        return best, self.spread(best).with_error(*changes)

    def spread(self, point: Point) -> Spread:
        """Covariance of theta, of data and priors together."""
        precision, size = self.precision.copy(), None
        precision[self.held] = 1e12
        for _ in range(2):
            slope = self.slopes(point, size)
            size = (np.sum(slope**2, axis=0) / point.variance + precision) ** -0.5
        joint = spread_of(point.errors[None, :, None], slope[None, :, None], 0, precision=precision)
        return joint.only(np.arange(len(self.free)))


_QUIET = 1e-4
"""Noise of the recorded torque over its rms that changes nothing."""
_DRAWS = 2
"""Of that noise."""
_OTHERS = 10.0, 0.1
"""Factors on the smoothness of predictors whose numbers are compared with the best one's."""


class Gap(NamedTuple):
    """The gap as the motor shows it.

    Attributes:
        best: the fit with all numbers.
        without: the best fit without a gap.
        spread: covariance of the best fit's theta.
        gain: of minus twice the log-likelihood by the gap, correlation of the errors counted.
        crossings: of the gap from flank to flank; of changes of sign of the transmitted torque without a gap.
        at_most: the largest half gap that the log does not rule out, where it does not show one (95 %), rad.
        unmet: whether a load that is never met, in a gap wider than the motor's travel, meets the readings as well as none.
    """

    best: Point
    without: Point
    spread: Spread
    gain: float
    crossings: int
    at_most: float
    unmet: bool = False

    @property
    def is_needed(self) -> bool:
        """True if the readings cannot be met without a gap."""
        return self.gain >= SHOWN


def _likeliest(points: Sequence[Point]) -> Point:
    """The point with the least deviance."""
    return min(points, key=lambda point: point.deviance)


def is_gap(number: FreeParameter) -> bool:
    """Return True if a number makes a gap."""
    return number.path.endswith(GAPS)


def half_gap_of(number: FreeParameter) -> float:
    """Half gap for 1 of the number that makes it."""
    return 4.0 if number.path.endswith("dead_zone") else 1.0


def is_known(number: FreeParameter) -> bool:
    """Return True if data sheets and CAD know a number within a small factor."""
    return number.path.endswith(("inertia", ".stiffness"))


def widths(free: Sequence[FreeParameter], factor: float) -> np.ndarray:
    """Prior standard deviations of theta: inertias and stiffness are known within a factor, a gap not at all."""
    return np.array([_ANY if is_gap(number) else np.log(factor) if is_known(number) else PRIOR_DEVIATION for number in free])


_ANY = 100.0
"""Prior standard deviation of a gap's theta: none."""
_NONE = 1e-9
"""Half gap over the motor's travel that stands for none."""


def find_gap(model: UnseenLoad) -> Gap:
    """Search for a gap, which is among a model's free numbers: fits from many half gaps, and without one."""
    place: Any = model.gap
    coarse, held, travel = model.coarse(), replace(model, held=[place]), model.travel
    stated = [i for i, number in enumerate(model.free) if is_known(number)]
    part = replace(coarse, held=[*stated, place], segments=[max(model.segments, key=len)[:_PART]])

    def begin(half: float) -> Point:
        """A short fit of frictions at a half gap, inertias and stiffness as given."""
        starts = [part.begin(model.with_gap(half, theta), _FOLLOWING[0]) for theta in model.beginnings()]
        return min((part.solve(start, _FEW) for start in starts), key=lambda point: point.variance)

    announce("trying half gaps")
    # from the encoder's noise to more than the motor's travel, where the load is never met
    low = max(2.0 * model.noise, 1e-4 * travel)
    starts = [begin(float(half)) for half in (*np.geomspace(low, 0.5 * travel, _STARTS - 1), 2.0 * travel)]
    announce("fitting the gap")
    likely = sorted(starts, key=lambda point: point.variance)[:_FINALISTS]
    fits = [coarse.solve(coarse.begin(point.theta, _FOLLOWING[-1]), _MORE) for point in likely]
    best, spread = model.settle(model.fit([_likeliest(fits).theta]))
    announce("fitting without a gap")
    none = _NONE * travel
    without = held.fit([begin(none).theta, model.with_gap(none, best.theta)])
    # what neighbouring fits find differently makes numbers uncertain, and rules out less; it is no correlation of errors
    correlated, worth = (max(float(width.inflation[place]) ** 2, 1.0) for width in (model.spread(best), spread))
    gain = max(without.deviance - best.deviance, 0.0) / correlated
    gap = Gap(best, without, spread, gain, 0, travel)
    if gap.is_needed:
        return gap._replace(crossings=model.count_turns(best, model.half_gap(best.theta)))
    if _is_unmet(held, without, starts[-1], worth):
        return gap._replace(unmet=True)
    # of the torque in the gear, by a twentieth of the input's rms on either side
    wound = 0.05 * model.torque / model.number("transmission.stiffness", without.theta)
    return gap._replace(at_most=_find_at_most(held, without, worth), crossings=model.count_turns(without, wound))


def _is_unmet(held: UnseenLoad, without: Point, begun: Point, worth: float) -> bool:
    """Tell if the motor alone meets the readings as both do without a gap, with a model in which the gap is held; `begun`
    at more than its travel."""
    # the load in the middle of the gap
    middle = begun._replace(start=np.zeros_like(without.start))
    point = held.finish(held.coarse().resume(middle, _MORE, _FOLLOWING[-1]))
    # a fit may end with another predictor than the one without a gap did: the same one is tried, too
    point = _likeliest([point, held.resume(point, _MORE, without.smoothness)])
    # on one flank, where a weight may hold the load, the load is met
    half = held.half_gap(point.theta)
    met = any(np.any(np.abs(twist) >= half) for twist in held.twists(point))
    return not met and (point.deviance - without.deviance) / worth < SHOWN


def _find_at_most(held: UnseenLoad, without: Point, worth: float) -> float:
    """Find the largest half gap that fits about as well as none; the motor's travel where all do."""
    half = max(0.5 * held.noise, 1e-5 * held.travel)
    point, deviances = without, [(half, 0.0)]
    while half < held.travel:
        point = held.resume(point._replace(theta=held.with_gap(half, point.theta)), _FEW, without.smoothness)
        deviances.append((half, (point.deviance - without.deviance) / worth))
        if deviances[-1][1] > LIMIT:
            return step_at_limit(deviances)
        half *= 1.6
    return held.travel
