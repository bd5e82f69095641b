"""Torques that effects would add along a measured motion, for every effect that a model may lack.

An effect whose torque is proportional to a number gives one column for it. Of numbers that are not linear (frequencies,
harmonics, Stribeck speed, limits, gaps, time constants) several values are tried, each a variant of the candidate. Where
the only number is of that kind, the effect at a trial value is taken as it is, and its slope gives the column.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import ClassVar, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.drive.effects import EFFECTS, AbstractEffect, ActuatorEffect, Motion, Numbers, Scales, make_effect
from jaxbl.drive.parameters import Scalar, as_arrays
from jaxbl.identification.regression import Path, effect_path
from jaxbl.simulate import Experiment, with_effects

from .linearised_segment import Part


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

    def columns(self, signals: "MotionTorques", torques: Sequence[np.ndarray]) -> np.ndarray:
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

    def columns(self, signals: "MotionTorques", torques: Sequence[np.ndarray]) -> np.ndarray:
        """As :meth:`Candidate.columns`."""
        if self.trial is None:
            return np.stack([torque / size for torque, (_, size) in zip(torques, self.unit, strict=True)])
        below, at, above = torques
        return np.stack([(above - below) / (2.0 * _STEP), at])


SHARE = 0.3
"""Prior size of an effect: share of the driving torque's rms."""
_STEP = 0.02
SPACING = 0.3
"""Prior standard deviation of the logarithm of a number about its trial value."""


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def variants_of(experiment: Experiment, lacking: Collection[str], scales: Callable[[str], Scales]) -> list[Variant]:
    """Effects that a model lacks, variant by variant.

    Args:
        experiment: the model.
        lacking: names of the effects.
        scales: of the log, as an effect of a given name sees them.
    """
    found: list[Variant] = []
    for name in lacking:
        log = scales(name)
        # without an input nothing acts on it
        if EFFECTS[name].suits(experiment.transmission) and (log.torque > 0.0 or not name.startswith("actuator.")):
            found += _variants(name, log)
    return found


def _variants(name: str, log: Scales) -> Iterator[Variant]:
    """An effect at all values tried of the numbers that its torque is not proportional to."""
    roles = EFFECTS[name].roles()
    tried = [leaf for leaf, role in roles.items() if role.kind in ("harmonic", "frequency", "shape")]
    for values in itertools.product(*(roles[leaf].trials(log) for leaf in tried)):
        known = dict(zip(tried, values, strict=True))
        yield _proportional(name, known, log) if EFFECTS[name].sizes() else _trial(name, known)


def _proportional(name: str, known: Numbers, log: Scales) -> Variant:
    """An effect with sizes: a column for each direction of them, two a quarter turn apart where its phase is not known."""
    cls = EFFECTS[name]
    roles, directions = cls.roles(), cls.directions()
    phase = next((leaf for leaf, role in roles.items() if role.kind == "angle"), None)
    unit = []
    for direction in directions:
        (size,) = {float(next(iter(roles[leaf].trials(log)))) for leaf in direction}
        numbers = dict.fromkeys(cls.sizes(), 0.0) | {leaf: size * share for leaf, share in direction.items()} | known
        turns = [{}] if phase is None else [{phase: 0.0}, {phase: 0.5 * math.pi}]
        unit += [(_effect(name, numbers | turn), size) for turn in turns]

    def numbers_of(values: Sequence[float]) -> Numbers | None:
        if phase is not None:
            sine, cosine = values
            return {cls.sizes()[0]: math.hypot(sine, cosine)} | known | {phase: math.atan2(cosine, sine)}
        numbers = dict.fromkeys(cls.sizes(), 0.0)
        for value, direction in zip(values, directions, strict=True):
            for leaf, share in direction.items():
                numbers[leaf] += value * share
        return numbers | known if cls.possible(numbers) else None

    return Variant(name, tuple(unit), None, numbers_of)


def _trial(name: str, known: Numbers) -> Variant:
    """An effect without sizes: the first of its numbers about the value tried."""
    leaf, value = next(iter(known.items()))
    below, at, above = (_effect(name, known | {leaf: value * math.exp(step)}) for step in (-_STEP, 0.0, _STEP))

    def numbers_of(values: Sequence[float]) -> Numbers | None:
        (change,) = values
        return known | {leaf: value * math.exp(change)} if abs(change) < 4.0 * SPACING else None

    return Variant(name, (), (below, at, above), numbers_of)


def _effect(name: str, numbers: Numbers) -> AbstractEffect:
    return as_arrays(make_effect(name, **numbers), float)


class _InputGain(ActuatorEffect):
    """The input times a gain."""

    kind: ClassVar[str] = "input_gain"
    gain: Scalar

    def actuate(self, state, torque, step):
        return state, self.gain * torque


def all_of_the_input() -> Variant:
    """The torque of the input once more."""
    twice = _InputGain(jnp.asarray(2.0))
    return Variant(twice.name, ((twice, 1.0),), None, lambda values: {})


class MotionTorques:
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
        self.known: dict[int, tuple[Candidate, np.ndarray]] = {}

    def _direction(self, side: str) -> np.ndarray:
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

    def of(self, effects: Sequence[AbstractEffect]) -> list[np.ndarray]:
        """Torque that each effect adds, shape (samples, sides + 1); on top of what a model without it has."""
        found: list[np.ndarray] = [np.zeros(0)] * len(effects)
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


def forces_of(candidates: Sequence[Candidate], signals: MotionTorques, spare: int = 0) -> np.ndarray:
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
    along = Path(part.time, part.torque, part.position, part.velocity)

    def one(effect: AbstractEffect) -> jax.Array:
        found = jnp.zeros((len(part.time), len(sides) + 1))
        place = drive.place(effect.place)
        if place == "transmission":
            gear = tuple(one for one in experiment.effects if one.place == place and one.name != effect.name)
            both = (with_effects(experiment, some) for some in (gear, (*gear, effect)))
            before, after = (one.plant.transmitted(part.position, part.velocity, effect_path(one, along)[0]) for one in both)
            found = found.at[:, 0].set(before[0] - after[0])
            found = found.at[:, 1].set(after[1] * after[0] - before[1] * before[0])
            return found * part.weight[:, None]
        (state,), acting = effect_path(with_effects(experiment, (effect,)), along)
        if place == "actuator":
            found = found.at[:, -1].set(acting - part.torque)
        else:
            motion = Motion(part.time, part.position[place], part.velocity[place])
            torque = effect.resist(state, motion) + effect.dry_friction(state, motion.velocity) * direction
            torque = torque + effect.added_inertia() * part.modelled[place]
            found = found.at[:, sides.index(place)].set(-torque)
        return found * part.weight[:, None]

    return jax.vmap(one)(effects)


@eqx.filter_jit
def _needed(experiment: Experiment, part: Part) -> dict[str, jax.Array]:
    """Torque on each side that its motion does not take up, dry friction left out, N m."""
    plant = experiment.plant
    states, torque = effect_path(experiment, Path(part.time, part.torque, part.position, part.velocity))
    acting = plant.torques(part.position, part.velocity, states, torque, part.time)
    found = {}
    for side in experiment.sides:
        rest = acting[side][0] - experiment.drive.viscous(side) * part.velocity[side]
        found[side] = jnp.broadcast_to(rest - plant.inertia(side) * part.acceleration[side], part.time.shape)
    return found
