"""Torques that effects would add along a measured motion, for every effect that a model may lack.

An effect whose torque is proportional to a number gives one column for it. Of numbers that are not linear (frequencies,
harmonics, Stribeck speed, limits, gaps, time constants) several values are tried, each a variant of the candidate. Where
the only number is of that kind, the effect at a trial value is taken as it is, and its slope gives the column.
"""

import dataclasses
import math
from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.drive.effects import AbstractEffect, Motion, effect_class, effect_kinds
from jaxbl.drive.parameters import as_arrays, parameters
from jaxbl.identification.regression import lasting_path
from jaxbl.simulate import Experiment

from .linearised_segment import Part

Array = np.ndarray
Numbers = dict[str, float]


class Candidate(Protocol):
    """Torques that may be missing: some columns, and what is there without any of them."""

    @property
    def name(self) -> str:
        """Of the effect."""
        ...

    @property
    def width(self) -> int:
        """Number of columns."""
        ...

    @property
    def offset(self) -> bool:
        """Whether something is there at coefficients of 0."""
        ...

    @property
    def numbers(self) -> Callable[[Sequence[float]], Numbers | None]:
        """The effect's numbers from the columns' coefficients; None where they are not allowed."""
        ...

    @property
    def effects(self) -> tuple[AbstractEffect, ...]:
        """Effects whose torques :meth:`columns` needs."""
        ...

    def columns(self, signals: "Signals", torques: Sequence[Array]) -> Array:
        """Columns in N m, shape (width, samples, sides + 1), and behind them what is there at coefficients of 0, if
        anything is."""
        ...


@dataclasses.dataclass(frozen=True)
class Variant:
    """A candidate at given values of its numbers that are not linear.

    Attributes:
        name: of the effect, e.g. `load.coulomb_friction`.
        unit: for each column an effect and its size: the column is its torque over that size.
        trial: in place of these, the effect at a trial value, and at values a little below and above.
        numbers: the effect's numbers from the columns' coefficients; None where they are not allowed.
    """

    name: str
    unit: tuple[tuple[AbstractEffect, float], ...]
    trial: tuple[AbstractEffect, AbstractEffect, AbstractEffect] | None
    numbers: Callable[[Sequence[float]], Numbers | None]

    @property
    def width(self) -> int:
        return len(self.unit) if self.trial is None else 1

    @property
    def offset(self) -> bool:
        return self.trial is not None

    @property
    def effects(self) -> tuple[AbstractEffect, ...]:
        """As of :class:`Candidate`."""
        return tuple(effect for effect, _ in self.unit) if self.trial is None else self.trial

    def columns(self, signals: "Signals", torques: Sequence[Array]) -> Array:
        """As :meth:`Candidate.columns`."""
        if self.trial is None:
            return np.stack([torque / size for torque, (_, size) in zip(torques, self.unit, strict=True)])
        below, at, above = torques
        return np.stack([(above - below) / (2.0 * _STEP), at])


class Grids(NamedTuple):
    """Values tried, and the size of things.

    Attributes:
        torque: largest input, N m.
        period: s.
        twist: rms of the twist z, rad; largest twist.
        speed: rms, of each side, rad/s.
        frequencies: of a periodic disturbance, Hz.
        motor_harmonics, load_harmonics: of a turn.
    """

    torque: float
    period: float
    twist: tuple[float, float]
    speed: dict[str, float]
    frequencies: tuple[float, ...] = ()
    motor_harmonics: tuple[float, ...] = ()
    load_harmonics: tuple[float, ...] = ()


SHARE = 0.3
"""Prior size of an effect: share of the driving torque's rms."""
_STRIBECK = 0.05, 0.1, 0.2, 0.3, 0.45, 0.7, 1.0
_LIMITS = 0.98, 0.95, 0.92, 0.88, 0.84, 0.8, 0.75, 0.7, 0.65, 0.6, 0.55, 0.5, 0.45, 0.4, 0.35, 0.3
_LAGS = 0.3, 0.6, 1.2, 2.4, 5.0, 10.0, 20.0, 40.0, 80.0, 160.0
_GAPS = 0.01, 0.02, 0.04, 0.08, 0.12, 0.18, 0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 0.85, 0.92
_STEP = 0.02
SPACING = 0.3
"""Prior standard deviation of the logarithm of a number about its trial value."""


def rms(values: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def variants_of(experiment: Experiment, lacking: Collection[str], grids: Grids) -> list[Variant]:
    """Effects that a model lacks, variant by variant."""
    sides = experiment.sides
    found: list[Variant] = []
    for side in sides:
        for kind, leaf in _LINEAR:
            found.append(_single(f"{side}.{kind}", leaf))
        for share in _STRIBECK:
            found.append(_stribeck(side, share * grids.speed[side]))
    found.append(_wave("load.gravity", "torque", {}, -1.0))
    for frequency in grids.frequencies:
        found.append(_wave("load.periodic_disturbance", "amplitude", {"frequency": frequency}))
    for harmonic in grids.motor_harmonics:
        found.append(_wave("motor.cogging", "amplitude", {"harmonic": harmonic}))
    if experiment.transmission is not None:
        for harmonic in grids.load_harmonics:
            found.append(_wave("transmission.eccentricity", "amplitude", {"harmonic": harmonic}, size=0.02 * grids.twist[0]))
        found.append(_single("transmission.damping", "damping"))
        found.append(_single("transmission.hardening", "cubic_stiffness"))
        if "half_gap" not in experiment.transmission.truth():
            found += [_trial("transmission.backlash", "half_gap", share * grids.twist[1]) for share in _GAPS]
    if grids.torque > 0.0:
        found.append(_single("actuator.gain_error", "relative"))
        found += [_trial("actuator.saturation", "limit", share * grids.torque) for share in _LIMITS]
        found += [_trial("actuator.lag", "time_constant", samples * grids.period) for samples in _LAGS]
    return [one for one in found if one.name in lacking]


_LINEAR = (
    ("coulomb_friction", "torque"),
    ("viscous_friction", "viscous"),
    ("quadratic_drag", "drag"),
    ("constant_torque", "torque"),
    ("inertia", "inertia"),
)


def _effect(name: str, numbers: Numbers) -> AbstractEffect:
    return as_arrays(effect_kinds()[name](**numbers), float)


def _single(name: str, leaf: str) -> Variant:
    (about,) = (about for field, about in parameters(effect_class(name)) if field.name == leaf)

    def numbers(values: Sequence[float]) -> Numbers | None:
        (value,) = values
        return None if about.minimum is not None and value <= about.minimum else {leaf: value}

    return Variant(name, ((_effect(name, {leaf: 1.0}), 1.0),), None, numbers)


def all_of_the_input() -> Variant:
    """The torque of the input once more."""
    return _single("actuator.gain_error", "relative")


def _stribeck(side: str, speed: float) -> Variant:
    name = f"{side}.stribeck_friction"
    sliding = _effect(name, {"torque": 1.0, "breakaway_torque": 1.0, "stribeck_velocity": speed})
    excess = _effect(name, {"torque": 0.0, "breakaway_torque": 1.0, "stribeck_velocity": speed})

    def numbers(values: Sequence[float]) -> Numbers | None:
        low, more = values
        if low < 0.0 or more <= 0.0:
            return None
        return {"torque": low, "breakaway_torque": low + more, "stribeck_velocity": speed}

    return Variant(name, ((sliding, 1.0), (excess, 1.0)), None, numbers)


def _wave(name: str, leaf: str, known: Numbers, turn: float = 1.0, size: float = 1.0) -> Variant:
    """A sinusoid of unknown phase: two of them, a quarter of a period apart."""
    pair = tuple((_effect(name, known | {leaf: size, "phase": phase}), size) for phase in (0.0, 0.5 * turn * math.pi))

    def numbers(values: Sequence[float]) -> Numbers:
        sine, cosine = values
        return {leaf: math.hypot(sine, cosine), "phase": turn * math.atan2(cosine, sine)} | known

    return Variant(name, pair, None, numbers)


def _trial(name: str, leaf: str, value: float) -> Variant:
    effects = tuple(_effect(name, {leaf: value * math.exp(step)}) for step in (-_STEP, 0.0, _STEP))

    def numbers(values: Sequence[float]) -> Numbers | None:
        (change,) = values
        return {leaf: value * math.exp(change)} if abs(change) < 4.0 * SPACING else None

    return Variant(name, (), effects, numbers)  # type: ignore[arg-type]


class Signals:
    """Torques of effects along one part of a record."""

    def __init__(self, experiment: Experiment, part: Part):
        self.experiment, self.part = experiment, part
        self.sides = experiment.sides
        self.count = len(part.time)
        self.real = np.asarray(part.weight) > 0.0
        self.torque = np.asarray(part.torque)
        # what must be held where a side stands still
        self.needed = {side: np.asarray(values) for side, values in _needed(experiment, part.moving()).items()}
        self.direction = {side: self._direction(side) for side in self.sides}
        self.known: dict[int, tuple[Candidate, Array]] = {}

    def _direction(self, side: str) -> Array:
        velocity, deviation = np.asarray(self.part.velocity[side]), np.asarray(self.part.deviation[side])
        period = float(self.part.time[1] - self.part.time[0])
        # the share of the time around a sample in forward motion less that in backward motion
        step = np.maximum(np.abs(np.asarray(self.part.acceleration[side])) * period, np.finfo(float).tiny)
        passage = np.clip(velocity / np.maximum(step, deviation), -1.0, 1.0)
        moving = passage * (2.0 - np.abs(passage))
        held = (np.asarray(self.part.held[side]) > 0.0) & self.real
        if not held.any():
            return moving
        # a side that is held takes what it needs, up to the level
        level = max(float(np.quantile(np.abs(self.needed[side][held]), 0.95)), np.finfo(float).tiny)
        return np.where(held, np.clip(self.needed[side] / level, -1.0, 1.0), moving)

    def over(self, side: str) -> float:
        """Torque on a side for 1 N m at the motor."""
        return float(self.experiment.drive.ratio(side))

    def of(self, effects: Sequence[AbstractEffect]) -> list[Array]:
        """Torque that each effect adds, shape (samples, sides + 1); on top of what a model without it has."""
        found: list[Array] = [np.zeros(0)] * len(effects)
        for name in dict.fromkeys(effect.name for effect in effects):
            which = [i for i, effect in enumerate(effects) if effect.name == name]
            place = self.experiment.drive.place(effects[which[0]].place)
            direction = jnp.asarray(self.direction.get(place, self.torque))
            for first in range(0, len(which), _AT_ONCE):
                some = which[first : first + _AT_ONCE]
                # as many at once each time, so that one compiled program serves
                spare = [effects[some[-1]]] * (_AT_ONCE - len(some))
                members = (*(effects[i] for i in some), *spare)
                stack = jax.tree.map(lambda *x: jnp.asarray(np.array([float(one) for one in x])), *members)
                torques = np.asarray(_torques(self.experiment, stack, self.part.moving(), direction))
                for i, torque in zip(some, torques, strict=False):
                    found[i] = torque
        return found


_AT_ONCE = 6


def forces_of(candidates: Sequence[Candidate], signals: Signals, spare: int = 0) -> Array:
    """Columns of candidates, one after the other, N m, and columns of zeros; shape (columns, samples, sides + 1)."""
    widths = [one.width + one.offset for one in candidates]
    found = np.zeros((sum(widths) + spare, signals.count, len(signals.sides) + 1))
    new = [one for one in candidates if id(one) not in signals.known]
    torques = iter(signals.of([effect for one in new for effect in one.effects]))
    at = 0
    for one, width in zip(candidates, widths, strict=True):
        # with the candidate itself, so that no other one gets its identity
        _, columns = signals.known.get(id(one), (one, None))
        if columns is None:
            columns = one.columns(signals, [next(torques) for _ in one.effects])
            signals.known[id(one)] = one, columns
        found[at : at + width] = columns
        at += width
    return found


@eqx.filter_jit
def _torques(experiment: Experiment, effects: AbstractEffect, part: Part, direction: jax.Array) -> jax.Array:
    """Torques of effects of one name, leaves of shape (effects,); shape (effects, samples, sides + 1)."""
    drive, sides = experiment.drive, experiment.sides

    def one(effect: AbstractEffect) -> jax.Array:
        found = jnp.zeros((len(part.time), len(sides) + 1))
        place = drive.place(effect.place)
        if place == "actuator":
            alone = eqx.tree_at(lambda e: e.effects, experiment, (effect,))
            found = found.at[:, -1].set(lasting_path(alone, part.torque)[1] - part.torque)
        elif place == "transmission":
            others = tuple(one for one in experiment.effects if one.name != effect.name)
            both = (eqx.tree_at(lambda e: e.effects, experiment, some) for some in (others, (*others, effect)))
            before, after = (one.plant.transmitted(part.position, part.velocity) for one in both)
            found = found.at[:, 0].set(before[0] - after[0])
            found = found.at[:, 1].set(after[1] * after[0] - before[1] * before[0])
        else:
            motion = Motion(part.time, part.position[place], part.velocity[place])
            torque = effect.resist(motion) + effect.dry_friction(motion.velocity) * direction
            torque = torque + effect.added_inertia() * part.modelled[place]
            found = found.at[:, sides.index(place)].set(-torque)
        return found * part.weight[:, None]

    return jax.vmap(one)(effects)


@eqx.filter_jit
def _needed(experiment: Experiment, part: Part) -> dict[str, jax.Array]:
    """Torque on each side that its motion does not take up, dry friction left out, N m."""
    plant = experiment.plant
    acting = plant.torques(part.position, part.velocity, lasting_path(experiment, part.torque)[1], part.time)
    found = {}
    for side in experiment.sides:
        rest = acting[side][0] - experiment.drive.viscous(side) * part.velocity[side]
        found[side] = jnp.broadcast_to(rest - plant.inertia(side) * part.acceleration[side], part.time.shape)
    return found
