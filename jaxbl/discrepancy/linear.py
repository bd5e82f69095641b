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

from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxbl.drive.effects import ConstantTorque
from jaxbl.drive.plant import PlantState
from jaxbl.identification.prediction import kalman_gain
from jaxbl.identification.smoother import Smoothed
from jaxbl.identification.trajectory import Free, with_values
from jaxbl.records import Record
from jaxbl.simulate import Experiment, move

from .candidates import SHARE, SPACING, Candidate, Grids, Signals, rms
from .evidence import Columns
from .part import Part

_PAD = 1024
"""Samples are padded to a multiple, so that records of about one length share their compiled programs."""


_HELD = 3.0


def linearise(
    experiment: Experiment,
    free: Sequence[Free],
    theta: Float[Array, " numbers"],
    record: Record,
    smoothed: Mapping[str, Sequence[Smoothed]],
) -> list[Part]:
    """The model along each part of a record.

    Args:
        experiment: the model, with array leaves; its sample period is that of the record.
        free: its own numbers.
        theta: their values.
        record: the log.
        smoothed: its positions, part by part.
    """
    assert record.torque is not None
    parts = []
    for i, rows in enumerate(record.segments):
        one = {side: smoothed[side][i] for side in experiment.sides}
        time = record.time[rows] - record.time[0]
        readings = {side: record.positions[side][rows] for side in experiment.sides}
        parts.append(_part(experiment, tuple(free), theta, time, record.torque[rows], readings, one))
    return parts


def _part(
    experiment: Experiment,
    free: tuple[Free, ...],
    theta: Array,
    time: np.ndarray,
    torque: np.ndarray,
    readings: dict[str, np.ndarray],
    smoothed: dict[str, Smoothed],
) -> Part:
    count = len(time)
    size = -(-count // _PAD) * _PAD

    def padded(values: np.ndarray) -> Array:
        return jnp.asarray(np.concatenate([values, np.repeat(values[-1:], size - count, axis=0)]))

    sides = experiment.sides
    states = {side: padded(np.asarray(smoothed[side].state)) for side in sides}
    deviation = {side: padded(np.asarray(smoothed[side].deviation(1))) for side in sides}
    held = {side: padded(_held(smoothed[side], experiment, states[side][:count])) for side in sides}
    read = jnp.stack([padded(readings[side]) - states[side][:, 0] for side in sides], axis=1)
    weight = jnp.asarray((np.arange(size) < count).astype(float))
    # as arrays, so that one compiled program serves all numbers
    free = tuple(one._replace(nominal=jnp.asarray(one.nominal), scale=jnp.asarray(one.scale)) for one in free)
    return _derivatives(experiment, free, theta, padded(time), padded(torque), read, states, deviation, held, weight)


def _held(smoothed: Smoothed, experiment: Experiment, state: Array) -> np.ndarray:
    period = float(experiment.run.sample_period)
    corner = float((smoothed.jerk / smoothed.noise**2 / period) ** (1.0 / 6.0))
    still = _HELD * np.asarray(smoothed.deviation(1))
    velocity, acceleration = np.asarray(state[:, 1]), np.asarray(state[:, 2])
    return ((np.abs(velocity) < still) & (np.abs(acceleration) < corner * still)).astype(float)


@eqx.filter_jit
def _derivatives(
    experiment: Experiment,
    free: tuple[Free, ...],
    theta: Array,
    time: Array,
    torque: Array,
    readings: Array,
    states: dict[str, Array],
    deviation: dict[str, Array],
    held: dict[str, Array],
    weight: Array,
) -> Part:
    sides = experiment.sides
    at = with_values(experiment, free, theta)
    effects = actuator_states(at, torque)
    motion = PlantState({side: states[side][:, 0] for side in sides}, {side: states[side][:, 1] for side in sides}, effects)
    _, unravel = ravel_pytree(jax.tree.map(lambda x: x[0], motion.effects))

    def pack(state: PlantState) -> Array:
        own, _ = ravel_pytree(state.effects)
        return jnp.concatenate([jnp.stack([x[side] for x in (state.position, state.velocity) for side in sides]), own])

    def unpack(vector: Array) -> PlantState:
        position, velocity = (dict(zip(sides, vector[i * len(sides) :], strict=False)) for i in range(2))
        return PlantState(position, velocity, unravel(vector[2 * len(sides) :]))

    vectors = jax.vmap(pack)(motion)

    def step(vector: Array, theta: Array, force: Array, torque: Array, time: Array) -> Array:
        added = tuple(ConstantTorque(side=side, torque=-force[i]) for i, side in enumerate(sides))  # type: ignore[arg-type]
        model = with_values(experiment, free, theta)
        model = eqx.tree_at(lambda e: e.effects, model, (*model.effects, *added))
        state = unpack(vector)
        extended = PlantState(state.position, state.velocity, (*state.effects, *(() for _ in sides)))
        new = move(model.plant, model.run, extended, torque + force[len(sides)], time)
        return pack(PlantState(new.position, new.velocity, new.effects[: len(state.effects)]))

    none = jnp.zeros(len(sides) + 1)

    def one(vector: Array, torque: Array, time: Array) -> tuple[Array, Array, Array, Array]:
        def of(vector: Array, theta: Array, force: Array) -> tuple[Array, Array]:
            value = step(vector, theta, force, torque, time)
            return value, value

        (a, f, b), value = jax.jacfwd(of, argnums=(0, 1, 2), has_aux=True)(vector, theta, none)
        return a, f, b, value

    a, f, b, value = jax.vmap(one)(vectors, torque, time)
    period = experiment.run.sample_period
    modelled = {side: (value[:, len(sides) + i] - vectors[:, len(sides) + i]) / period for i, side in enumerate(sides)}
    defect = value - jnp.concatenate([vectors[1:], value[-1:]])
    # nothing happens from the last reading on
    going = jnp.concatenate([weight[1:], jnp.zeros(1)])
    defect = jnp.where(going[:, None] > 0.0, defect, 0.0)
    return Part(
        time, torque, readings,
        motion.position, motion.velocity, {side: states[side][:, 2] for side in sides}, modelled, deviation, held,
        a, b, f, defect, weight,
    )  # fmt: skip


def actuator_states(experiment: Experiment, torque: Float[Array, " samples"]) -> tuple:
    """The effects' own states along an input, from one that has lasted."""
    period = experiment.run.sample_period

    def sample(states: list, torque: Array) -> tuple[list, list]:
        new, acting = [], torque
        for effect, state in zip(experiment.effects, states, strict=True):
            state, acting = effect.actuate(state, acting, period)
            new.append(state)
        return new, states

    start = [
        jax.tree.map(lambda x: jnp.asarray(x, torque.dtype) * 0.0 + torque[0], effect.init())
        for effect in experiment.effects
    ]
    return tuple(jax.lax.scan(sample, start, torque)[1])


def gain_matrix(gain: Array, states: int) -> Array:
    """Gain of the whole state, shape (states, sides): positions, velocities, and nothing on the effects' own states."""
    sides = len(gain)
    gains = jnp.zeros((states, sides)).at[jnp.arange(sides), jnp.arange(sides)].set(gain[:, 0])
    return gains.at[sides + jnp.arange(sides), jnp.arange(sides)].set(gain[:, 1])


def _recursion(part: Part, gain: Array, forces: Array) -> Array:
    """Prediction errors, rad; columns: constant, own numbers, forces, initial states; shape (samples, sides, columns)."""
    states = part.defect.shape[1]
    sides, numbers, columns = part.readings.shape[1], part.own.shape[2], forces.shape[2]
    width = 1 + numbers + columns + states
    start = jnp.zeros((states, width)).at[:, 1 + numbers + columns :].set(jnp.eye(states))
    gains = gain_matrix(gain, states)

    def sample(change: Array, given: tuple[Array, ...]) -> tuple[Array, Array]:
        a, b, own, defect, reading, force, weight = given
        error = -change[:sides].at[:, 0].add(-reading)
        corrected = change + gains @ error
        known = jnp.concatenate([defect[:, None], own, b @ force, jnp.zeros((states, states))], axis=1)
        return a @ corrected + known, error * weight

    given = part.step, part.force, part.own, part.defect, part.readings, forces, part.weight
    return jax.lax.scan(sample, start, given)[1]


_errors = jax.jit(_recursion)
_errors_over = jax.jit(jax.vmap(_recursion, in_axes=(None, 0, None)))


@jax.jit
def _gradient(part: Part, gain: Array, left: Array) -> Array:
    """Derivative of the sum of products of errors with `left` by the torque at each sample, shape (samples, sides + 1)."""
    states, sides = part.defect.shape[1], left.shape[1]
    gains = gain_matrix(gain, states)

    def sample(adjoint: Array, given: tuple[Array, ...]) -> tuple[Array, Array]:
        a, b, left, weight = given
        back = a.T @ adjoint
        return back.at[:sides].add(-left * weight - gains.T @ back), b.T @ adjoint

    given = part.step, part.force, left, part.weight
    return jax.lax.scan(sample, jnp.zeros(states), given, reverse=True)[1]


_SMOOTHNESS = 10.0 ** np.arange(-11.0, 1.0)
_LEAST = 1e-11
_FINE = 10.0 ** np.array([-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0])
OFF = 0.5
"""Prior size of the error of an inertia or a viscous friction, relative."""
_FREQUENCIES, _COARSE, _HARMONICS = 8, 16, 40


class Linear:
    """A model along a record, linear in everything that may change."""

    def __init__(
        self,
        experiment: Experiment,
        free: Sequence[Free],
        theta: Float[Array, " numbers"],
        prior: np.ndarray,
        centre: np.ndarray,
        record: Record,
        smoothed: Mapping[str, Sequence[Smoothed]],
    ):
        """Args as of :func:`linearise`; `prior` and `centre` are of the change of each number from theta."""
        self.free, self.theta, self.prior, self.centre = tuple(free), np.asarray(theta), prior, centre
        self.experiment = with_values(experiment, free, theta)
        self.period, self.sides = record.sample_period, experiment.sides
        self.parts = linearise(experiment, free, theta, record, smoothed)
        self.signals = [Signals(self.experiment, part) for part in self.parts]
        self.count = sum(int(np.asarray(one.weight).sum()) for one in self.parts)
        self.states = self.parts[0].defect.shape[1]
        self.drive = rms(np.concatenate([one.torque[one.real] for one in self.signals]))
        self.left: list[np.ndarray] = []

    def grids(self, frequencies: Sequence[float]) -> Grids:
        """Values to be tried of numbers that are not linear."""

        def joined(of) -> np.ndarray:
            return np.concatenate([np.asarray(of(one))[np.asarray(one.weight) > 0.0] for one in self.parts])

        speed = {side: rms(joined(lambda part, side=side: part.velocity[side])) for side in self.sides}
        travel = {side: float(np.ptp(joined(lambda part, side=side: part.position[side]))) for side in self.sides}
        twist = np.zeros(1)
        if len(self.sides) == 2:
            ratio = float(self.experiment.drive.ratio("load"))
            twist = joined(lambda part: part.position["motor"] - ratio * part.position["load"])
        return Grids(
            float(np.max(np.abs(joined(lambda part: part.torque)))),
            self.period,
            (rms(twist), float(np.max(np.abs(twist)))),
            speed,
            tuple(frequencies),
            tuple(float(n) for n in range(1, _HARMONICS + 1) if n * travel["motor"] > np.pi),
            tuple(float(n) for n in range(1, 9) if n * travel.get("load", 0.0) > 0.5),
        )

    def choices(self, name: str) -> float:
        """Logarithm of the number of values that an effect was sought with, where each could be told from the next."""
        if name == "load.periodic_disturbance":
            return float(np.log(max(self.count * self.period * min(0.25 / self.period, 50.0), 1.0)))
        grids = self.grids(())
        if name == "motor.cogging":
            return float(np.log(max(len(grids.motor_harmonics), 1)))
        if name == "transmission.eccentricity":
            return float(np.log(max(len(grids.load_harmonics), 1)))
        return 0.0

    def gain(self, smoothness: Sequence[float]) -> Array:
        return jnp.asarray(np.stack([kalman_gain(q, self.period) for q in smoothness]))

    def choose(self, variants: Sequence[Candidate]) -> tuple[list[float], np.ndarray]:
        """The predictor with the least errors, some candidates taken in: smoothness of each side, and errors' rms, rad."""
        forces = []
        for signals in self.signals:
            pieces = [_flat(*one.torques(signals)) for one in variants]
            forces.append(np.concatenate([np.zeros((signals.count, len(self.sides) + 1, 0)), *pieces], axis=2))

        def tried(options: list[list[float]]) -> tuple[list[float], np.ndarray]:
            gains = jnp.stack([self.gain(one) for one in options])
            every = [
                np.asarray(_errors_over(part, gains, jnp.asarray(force)))
                for part, force in zip(self.parts, forces, strict=True)
            ]
            squares = np.stack([self._squares([one[i] for one in every]) for i in range(len(options))])
            value = np.sum(np.log(squares), axis=1)
            best = int(np.argmin(np.where(np.isfinite(value), value, np.inf)))
            self._squares([one[best] for one in every])
            return options[best], np.sqrt(squares[best] / self.count)

        smoothness, deviation = tried([[float(q)] * len(self.sides) for q in _SMOOTHNESS])
        if len(self.sides) > 1:
            for i in range(len(self.sides)):
                smoothness, deviation = tried(
                    [[max(float(q * f), _LEAST) if j == i else q for j, q in enumerate(smoothness)] for f in _FINE]
                )
        return smoothness, deviation

    def deviation(self, smoothness: Sequence[float]) -> np.ndarray:
        """Rms of the prediction errors, rad, by side, with a given predictor."""
        none = np.zeros((1, len(self.sides) + 1, 0))
        errors = []
        for part, signals in zip(self.parts, self.signals, strict=True):
            errors.append(np.asarray(_errors(part, self.gain(smoothness), jnp.asarray(np.repeat(none, signals.count, 0)))))
        return np.sqrt(self._squares(errors) / self.count)

    def _squares(self, errors: list[np.ndarray]) -> np.ndarray:
        """Sums of squared prediction errors by side, after least squares on all columns."""
        sides, own, width = len(self.sides), len(self.free), errors[0].shape[2] - 1 - self.states
        weight, squares = np.ones(sides), np.zeros(sides)
        for turn in range(2):
            total = np.zeros((width + 1, width + 1))
            pieces = []
            for one in errors:
                rest = _without((one * weight[None, :, None]).reshape(-1, one.shape[2]), self.states)
                total += rest.T @ rest
                pieces.append(rest)
            variance = 1.0 if turn else max(total[0, 0] / (self.count * sides), 1e-300)
            precision, centre = np.zeros(width), np.zeros(width)
            precision[:own], centre[:own] = variance / self.prior**2, self.centre
            matrix = total[1:, 1:] + np.diag(precision)
            size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
            towards = (total[1:, 0] - precision * centre) / size
            found = -np.linalg.lstsq(matrix / np.outer(size, size), towards, rcond=1e-12)[0] / size
            self.left = [(rest[:, 0] + rest[:, 1:] @ found).reshape(-1, sides) / weight[None, :] for rest in pieces]
            squares = np.sum([np.sum(one**2, axis=0) for one in self.left], axis=0)
            weight = 1.0 / np.sqrt(np.maximum(squares / self.count, 1e-300))
        return squares

    def frequencies(self, smoothness: Sequence[float], deviation: np.ndarray) -> list[float]:
        """Frequencies (Hz) at which a disturbance of the load explains most, by the gradient of the errors' squares.

        Of the longest part, at what the last call of :meth:`choose` left over.
        """
        i = int(np.argmax([float(one.weight.sum()) for one in self.parts]))
        part, side = self.parts[i], self.sides.index(self.experiment.drive.place("load"))
        time, real = np.asarray(part.time), int(np.asarray(part.weight).sum())
        span, top = real * self.period, min(0.25 / self.period, 50.0)
        few = np.geomspace(1.0 / span, top, _COARSE)
        phase = 2.0 * np.pi * few[None, :] * time[:, None]
        forces = np.zeros((len(time), len(self.sides) + 1, 2 * _COARSE))
        forces[:, side] = np.concatenate([np.sin(phase), np.cos(phase)], axis=1)
        gain = self.gain(smoothness)
        responses = np.asarray(_errors(part, gain, jnp.asarray(forces)))[:, :, 1 + len(self.free) : -self.states]
        power = np.sum((responses / deviation[None, :, None]) ** 2, axis=(0, 1)).reshape(2, -1).mean(axis=0)
        slope = np.asarray(_gradient(part, gain, jnp.asarray(self.left[i] / deviation[None, :] ** 2)))[:real, side]
        size = 4 * 2 ** int(np.ceil(np.log2(real)))
        frequency = np.fft.rfftfreq(size, self.period)
        inside = (frequency >= 0.5 / span) & (frequency <= top)
        expected = np.exp(np.interp(np.log(np.maximum(frequency, 1e-9)), np.log(few), np.log(power)))
        score = np.where(inside, np.abs(np.fft.rfft(slope, size)) ** 2 / expected, 0.0)
        peaks = np.flatnonzero((score[1:-1] >= score[:-2]) & (score[1:-1] > score[2:])) + 1
        found: list[float] = []
        for k in peaks[np.argsort(-score[peaks])]:
            if all(abs(frequency[k] - known) > 1.0 / span for known in found):
                found.append(float(frequency[k]))
            if len(found) == _FREQUENCIES:
                break
        return found

    def columns(self, variants: Sequence[Candidate], smoothness: Sequence[float], deviation: np.ndarray) -> Columns:
        """Products of everything that the prediction errors are linear in, initial states eliminated."""
        gain, own = self.gain(smoothness), len(self.free)
        places, offsets, at = [], [], 1 + own
        for one in variants:
            places.append(tuple(range(at, at + one.width)))
            at += one.width
            offsets.append(at if one.offset else -1)
            at += one.offset
        total, power = np.zeros((at, at)), np.zeros(at - 1 - own)
        for part, signals in zip(self.parts, self.signals, strict=True):
            pieces = [_flat(*one.torques(signals)) for one in variants]
            every = np.concatenate([np.zeros((signals.count, len(self.sides) + 1, 0)), *pieces], axis=2)
            power += self._power(every, signals)
            errors = np.asarray(_errors(part, gain, jnp.asarray(every))) / deviation[None, :, None]
            for one, place in zip(variants, places, strict=True):
                # the error of a number that is free acts as that number does, dry friction or not
                if (i := self.same(one.name)) is not None:
                    errors[:, :, place[0]] = errors[:, :, 1 + i] / float(self.free[i].slope(self.theta[i]))
            flat = errors.reshape(-1, errors.shape[2])
            inside = _basis(flat[:, -self.states :]).T @ flat[:, : -self.states]
            total += flat[:, : -self.states].T @ flat[:, : -self.states] - inside.T @ inside
        size = SHARE * self.drive / np.sqrt(np.maximum(power / self.count, 1e-300))
        scale = np.concatenate([[np.inf], self.prior, size])
        for one, place in zip(variants, places, strict=True):
            if one.offset:
                scale[list(place)] = SPACING
            elif (nominal := self.nominal(one.name)) is not None:
                scale[list(place)] = np.minimum(scale[list(place)], OFF * nominal)
        centre = np.zeros(at)
        centre[1 : 1 + own] = self.centre
        return Columns(total, own, tuple(places), tuple(offsets), scale, centre)

    def _power(self, torques: np.ndarray, signals: Signals) -> np.ndarray:
        """Sums of squares of torques, referred to the motor."""
        over = np.array([*(signals.over(side) for side in self.sides), 1.0])
        return np.sum((torques / over[None, :, None]) ** 2, axis=(0, 1))

    def sizes(self, names: Sequence[str]) -> dict[str, float]:
        """Prior relative standard deviation of the amplitudes of effects that the model has."""
        found = {}
        for name in names:
            (effect,) = (one for one in self.experiment.effects if one.name == name)
            power = sum(self._power(signals.of(effect, True)[:, :, None], signals)[0] for signals in self.signals)
            found[name] = SHARE * self.drive / np.sqrt(max(power / self.count, 1e-300))
            if (nominal := self.nominal(name)) is not None:
                (value,) = (abs(float(getattr(effect, leaf))) for leaf in ("inertia", "viscous") if hasattr(effect, leaf))
                found[name] = min(found[name], OFF * nominal / max(value, 1e-300))
        return found

    def same(self, name: str) -> int | None:
        """Index of the model's own number that an effect is the error of."""
        side, _, kind = name.partition(".")
        path = f"drive.{side}_{kind.removesuffix('_friction')}" if kind in ("inertia", "viscous_friction") else ""
        return next((i for i, one in enumerate(self.free) if one.path == path), None)

    def nominal(self, name: str) -> float | None:
        """The number of the drive that an effect is the error of, if it is one and is not zero."""
        side, _, kind = name.partition(".")
        if kind not in ("inertia", "viscous_friction"):
            return None
        drive = self.experiment.drive
        value = float(drive.inertia(side) if kind == "inertia" else drive.viscous(side))
        return value if value > 0.0 else None


def _flat(columns: np.ndarray, offset: np.ndarray | None) -> np.ndarray:
    return columns if offset is None else np.concatenate([columns, offset[:, :, None]], axis=2)


def _basis(values: np.ndarray) -> np.ndarray:
    size = np.sqrt(np.sum(values**2, axis=0))
    return np.linalg.qr(values / np.where(size > 0.0, size, 1.0))[0]


def _without(values: np.ndarray, states: int) -> np.ndarray:
    """The first columns less what the last, the initial states, explain."""
    basis = _basis(values[:, -states:])
    return values[:, :-states] - basis @ (basis.T @ values[:, :-states])
