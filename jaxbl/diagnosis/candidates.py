"""Torques that effects would add along a measured motion, for every effect that a model may lack.

An effect whose torque is proportional to a number gives one column for it. Of numbers that are not linear (frequencies,
harmonics, Stribeck speed, limits, gaps, time constants) several values are tried, each a variant of the candidate. Where
the only number is of that kind, the effect at a trial value is taken as it is, and its slope gives the column.
"""

# arrays of numpy go where those of jax are asked for
# pyright: reportArgumentType=false

import dataclasses
import itertools
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxbl.chain import Experiment, with_effects
from jaxbl.drive.effects import EFFECTS, AbstractEffect, Motion, Numbers, Scales, make_effect
from jaxbl.estimation.free_parameters import FreeParameter
from jaxbl.estimation.regression import Path, SideSamples, effect_path, remembers_input
from jaxbl.estimation.segments import Segment
from jaxbl.fused.compilation import jit

EffectNumbers = Mapping[str, Numbers]
"""Numbers of effects, by the name of each."""


class Part(Path):
    """Motion along a part of a record without gaps, and of the model there; its torque is held from each sample to the next.
    Behind the last sample there is filling, so that parts of about one length share their compiled programs.

    Attributes:
        position, velocity, acceleration: smoothed, of each side.
        modelled: mean acceleration over the next period by the model, of each side: free of the readings' noise.
        deviation: standard deviation of the smoothed velocity, of each side.
        held: whether a side is not shown to move for a while.
    """

    acceleration: SideSamples
    modelled: SideSamples
    deviation: SideSamples
    held: dict[str, Bool[Array, " samples"]]


Torques = dict[int, np.ndarray]
"""Torques in N m by where they act: index of the side, or -1 for the input; shape (samples,), or (columns, samples). Nothing
acts elsewhere."""


@dataclasses.dataclass(frozen=True, eq=False)
class Candidate:
    """Torques that may be missing: columns with a coefficient each.

    Attributes:
        name: of the effect, e.g. `load.coulomb_friction`.
        width: number of columns.
        effects: effects whose torques the columns are made of.
        columns: columns from a motion and the torque of each effect along it; behind them what is there at coefficients of
            0, if anything is.
        numbers: the effect's numbers from the coefficients, none of what is no effect; None where they are not allowed.
        offset: whether something is there at coefficients of 0.
        from_rest: whether nothing had happened before the first input known; else that one had lasted.
        spread: prior standard deviation of the coefficients; 0 where their torque sets it.
    """

    name: str
    width: int
    effects: tuple[AbstractEffect, ...]
    columns: Callable[["MotionTorques", Sequence[Torques]], Torques]
    numbers: Callable[[Sequence[float]], Numbers | None] = lambda values: {}
    offset: bool = False
    from_rest: bool = False
    spread: float = 0.0


NO_CANDIDATE = Candidate("", 0, (), lambda signals, torques: {})


def owner_of(number: FreeParameter) -> tuple[str, str]:
    """Return the effect that a number is of, and its name there."""
    name, _, leaf = number.path.removeprefix("effects.").rpartition(".")
    return name, leaf


def are_possible(effects: EffectNumbers, period: float) -> bool:
    """Tell whether effects may have these numbers, and can be simulated with them; `period`: sampling period, s."""
    return all(
        EFFECTS[name].possible(numbers) and not EFFECTS[name].find_fault(numbers, period)
        for name, numbers in effects.items()
    )


def replaces(other: str, name: str) -> bool:
    """Tell whether an effect gives way to another one: its special case, or of the same word at one place, as of dry
    friction a side has one law."""
    word, place = EFFECTS[name].exclusive, name.partition(".")[0]
    is_alike = word is not None and EFFECTS[other].exclusive == word and other.partition(".")[0] == place
    return is_alike or contains(other, name)


def contains(general: str, name: str) -> bool:
    """Tell whether an effect has another one at the same place as its special case."""
    place, _, kind = name.partition(".")
    return general.partition(".")[0] == place and kind in EFFECTS[general].special_cases


def is_finer_law(name: str) -> bool:
    """Tell whether an effect is a finer law of the torque of its special case, as friction that bends is one of friction:
    gravity is not one of a constant torque, which has another cause."""
    words = set(name.partition(".")[2].split("_"))
    return any(words.intersection(kind.split("_")) for kind in EFFECTS[name].special_cases)


_make_effect = lru_cache(maxsize=4096)(make_effect)
"""Screening after screening asks for the same ones."""
_AT_ONCE = 6
"""Effects of one name whose torques one compiled program computes."""
_STEP = 0.02
"""Change of the logarithm of a number by which the slope at a trial value is found."""
ZERO_SPREAD = 1.8
"""Prior standard deviation of an encoder's zero, rad: it may lie anywhere in a turn."""
SPACING = 0.3
"""Prior standard deviation of the logarithm of a number about its trial value."""
REACH = 4.0 * SPACING
"""Change of that logarithm from which on another trial value would be nearer; above the largest, the log shows the number no
longer."""


def variants_of(experiment: Experiment, lacking: Collection[str], scales: Callable[[str], Scales]) -> list[Candidate]:
    """Effects that a model lacks, variant by variant; `scales` of the log as an effect of a given name sees them."""
    variants: list[Candidate] = []
    for name in lacking:
        log = scales(name)
        # without an input nothing acts on it
        if EFFECTS[name].suits(experiment.transmission) and (log.torque > 0.0 or not name.startswith("actuator.")):
            variants += _variants(name, log)
    return variants


def _variants(name: str, log: Scales) -> Iterator[Candidate]:
    """An effect at all values tried of the numbers that its torque is not proportional to."""
    held = EFFECTS[name].neutral("held")
    for values in _combine_trials(name, log, "harmonic", "frequency", "shape"):
        fixed = held | values
        if EFFECTS[name].sizes():
            yield _proportional(name, fixed, log)
            continue
        # of one that remembers its input the first samples are the clearest mark on many a log; not where all that it
        # remembers is known
        remembers = remembers_input(_make_effect(name, **fixed)) and not EFFECTS[name].state_from_input
        for from_rest in (False, True) if remembers else (False,):
            yield _trial(name, fixed, from_rest)


def release(name: str, numbers: Numbers, log: Scales) -> list[Candidate]:
    """An effect that a model has, at the trial values of numbers that it holds."""
    if EFFECTS[name].list_released(numbers):
        return []
    fixed = {leaf: value for leaf, value in numbers.items() if leaf not in EFFECTS[name].sizes()}
    finer = [fixed | values for values in _combine_trials(name, log, "held")]
    return [_proportional(name, law, log) for law in finer if EFFECTS[name].list_released(law)]


def _combine_trials(name: str, log: Scales, *kinds: str) -> Iterator[Numbers]:
    """Yield all combinations of the trial values of an effect's numbers of some kinds."""
    trials = {leaf: role.trials(log) for leaf, role in EFFECTS[name].roles(*kinds).items()}
    for values in itertools.product(*trials.values()):
        yield dict(zip(trials, values, strict=True))


def _proportional(name: str, fixed: Numbers, log: Scales) -> Candidate:
    """An effect with sizes: a column for each direction of them, two a quarter turn apart where its phase is not known."""
    cls = EFFECTS[name]
    roles, directions = cls.roles(), cls.directions()
    phase = next(iter(cls.roles("angle")), None)
    effects, sizes = [], []
    for direction in directions:
        (size,) = {float(next(iter(roles[leaf].trials(log)))) for leaf in direction}
        numbers = dict.fromkeys(cls.sizes(), 0.0) | {leaf: size * share for leaf, share in direction.items()} | fixed
        turns = [{}] if phase is None else [{phase: 0.0}, {phase: 0.5 * math.pi}]
        effects += [_make_effect(name, **numbers, **turn) for turn in turns]
        sizes += [size] * len(turns)

    def columns(_: MotionTorques, torques: Sequence[Torques]) -> Torques:
        return {
            place: np.stack([torque[place] / size for torque, size in zip(torques, sizes, strict=True)])
            for place in torques[0]
        }

    def numbers_of(values: Sequence[float]) -> Numbers | None:
        if phase is not None:
            sine, cosine = values
            return {cls.sizes()[0]: math.hypot(sine, cosine)} | fixed | {phase: math.atan2(cosine, sine)}
        numbers = dict.fromkeys(cls.sizes(), 0.0) | fixed
        for value, direction in zip(values, directions, strict=True):
            for leaf, share in direction.items():
                numbers[leaf] += value * share
        return numbers if cls.possible(numbers) else None

    return Candidate(name, len(effects), tuple(effects), columns, numbers_of, spread=ZERO_SPREAD if cls.in_log else 0.0)


def _trial(name: str, fixed: Numbers, from_rest: bool) -> Candidate:
    """An effect without sizes: the first of its numbers about the value tried."""
    leaf, value = next(iter(fixed.items()))
    effects = tuple(_make_effect(name, **(fixed | {leaf: value * math.exp(step)})) for step in (-_STEP, 0.0, _STEP))

    def columns(_: MotionTorques, torques: Sequence[Torques]) -> Torques:
        below, middle, above = torques
        return {place: np.stack([(above[place] - below[place]) / (2.0 * _STEP), middle[place]]) for place in middle}

    def numbers_of(values: Sequence[float]) -> Numbers | None:
        (change,) = values
        return fixed | {leaf: value * math.exp(change)} if abs(change) < REACH else None

    return Candidate(name, 1, effects, columns, numbers_of, offset=True, from_rest=from_rest, spread=SPACING)


class Forces:
    """Columns of torques side by side.

    Attributes:
        width: number of columns.
        runs: where columns act (as of :data:`Torques`), which, and their torques; neighbours that act alike in one piece.
    """

    def __init__(self, columns: Sequence[Torques]):
        """Put columns beside one another."""
        self.width, self.runs = 0, list[tuple[int, slice, np.ndarray]]()
        for places, alike in itertools.groupby(filter(None, columns), key=tuple):
            pieces = list(alike)
            joined = {place: np.concatenate([np.atleast_2d(piece[place]) for piece in pieces]) for place in places}
            here = slice(self.width, self.width + len(joined[places[0]]))
            self.runs += [(place, here, torques) for place, torques in joined.items()]
            self.width = here.stop

    def driving(self, force: np.ndarray, rows: slice) -> np.ndarray:
        """Add up the columns' effect on the states in some samples, shape (states, rows, columns); `force`: B there, shape
        (rows, states, sides + 1)."""
        count, states, _ = force.shape
        driven = np.zeros((states, count, self.width))
        for place, columns, torques in self.runs:
            driven[:, :, columns] += force[:, :, place].T[:, :, None] * torques[:, rows].T
        return driven

    def squares(self, over: Mapping[int, float]) -> np.ndarray:
        """Sum of squares of each column, over those of a number for each place; shape (columns,)."""
        sums = np.zeros(self.width)
        for place, columns, torques in self.runs:
            sums[columns] += np.einsum("ct,ct->c", torques, torques) / over[place] ** 2
        return sums

    def on(self, place: int, samples: int) -> np.ndarray:
        """All columns at one place, shape (columns, samples)."""
        rows = np.zeros((self.width, samples))
        for other, columns, torques in self.runs:
            if other == place:
                rows[columns] = torques
        return rows


class MotionTorques:
    """Torques of effects along one part of a record."""

    def __init__(self, experiment: Experiment, part: Part, segment: Segment):
        """Prepare to ask for torques along a segment, which keeps those that are the same for all models."""
        self.experiment, self.part, self.segment = experiment, part, segment
        self.sides, self.samples = experiment.sides, len(segment)
        needed = _find_needed(experiment, part) if any(samples.any() for samples in part.held.values()) else None
        self.direction = {side: self._direction(side, needed) for side in self.sides}
        self.own: dict[tuple, Torques] = {}

    def _direction(self, side: str, needed: Mapping[str, jax.Array] | None) -> np.ndarray:
        """Direction of motion of a side, between -1 and 1; where it stands still, of the torque that holds it (`needed`)."""
        velocity, deviation = self.part.velocity[side], self.part.deviation[side]
        period = float(self.part.time[1] - self.part.time[0])
        # the share of the time around a sample in forward motion less that in backward motion
        step = np.maximum(np.abs(self.part.acceleration[side]) * period, np.finfo(float).tiny)
        # along a path that diverges
        with np.errstate(over="ignore"):
            passage = np.clip(velocity / np.maximum(step, deviation), -1.0, 1.0)
        moving = passage * (2.0 - np.abs(passage))
        held = self.part.held[side]
        if needed is None or not held.any():
            return moving
        # a side that is held takes what it needs, up to the level
        holding = np.asarray(needed[side])
        level = max(float(np.quantile(np.abs(holding[held]), 0.95)), np.finfo(float).tiny)
        return np.where(held, np.clip(holding / level, -1.0, 1.0), moving)

    def of(self, effects: Sequence[AbstractEffect], from_rest: bool = False) -> list[Torques]:
        """Torque that each effect adds, on top of what a model without it has. Before the first input known that one had
        lasted, or with `from_rest` nothing had happened."""
        places = [(self._store(effect), _key(effect, from_rest)) for effect in effects]
        asked: dict[str, list[AbstractEffect]] = {}
        for effect, (store, key) in zip(effects, places, strict=True):
            if key not in store:
                asked.setdefault(effect.name, []).append(effect)
        for name, alike in asked.items():
            place = self.experiment.drive.resolve_place(alike[0].place)
            # of the model's own only those in the gear matter (of one inertia those on the load), and only for others there:
            # one structure, and one program
            near = "load" if self.experiment.transmission is None else "transmission"
            gear = [
                other
                for other in self.experiment.effects
                if place == "transmission" and other.place == near and other.name != name
            ]
            bare = with_effects(self.experiment, tuple(gear))
            # friction of the gear is on the motor's side; an effect on the input needs none
            direction = self.direction.get("motor" if place == "transmission" else place, self.part.torque)
            for first in range(0, len(alike), _AT_ONCE):
                batch = alike[first : first + _AT_ONCE]
                # as many at once each time, so that one compiled program serves
                members = (*batch, *[batch[-1]] * (_AT_ONCE - len(batch)))
                stack = jax.tree.map(lambda *x: np.array([float(leaf) for leaf in x]), *members)
                torques = _torques(bare, stack, self.part, direction, from_rest)
                rows = {side: np.asarray(torque)[:, : self.samples] for side, torque in torques.items()}
                for k, effect in enumerate(batch):
                    self._store(effect)[_key(effect, from_rest)] = {side: torque[k] for side, torque in rows.items()}
        return [store[key] for store, key in places]

    def _store(self, effect: AbstractEffect) -> dict[tuple, Torques]:
        """Return where torques of an effect are kept: with the segment if they follow from motion and input alone.

        They do not in the gear, where the model has torques of its own, nor where the model says how it moves, or what
        holds it at rest.
        """
        place, kind = self.experiment.drive.resolve_place(effect.place), type(effect)
        held = place in self.sides and self.part.held[place].any()
        hooks = ("added_inertia", *(("dry_friction", "holds") if held else ()))
        depends = any(getattr(kind, hook) is not getattr(AbstractEffect, hook) for hook in hooks)
        shared = place == "actuator" or (place != "transmission" and not depends)
        return self.segment.torques if shared else self.own


def _key(effect: AbstractEffect, from_rest: bool) -> tuple:
    return effect.name, from_rest, *(float(leaf) for leaf in jax.tree.leaves(effect))


def columns_of(candidates: Sequence[Candidate], signals: MotionTorques) -> list[Torques]:
    """Columns of each candidate."""
    columns: dict[Candidate, Torques] = {}
    for from_rest in (False, True):
        alike = [candidate for candidate in candidates if candidate.from_rest == from_rest]
        torques = iter(signals.of([effect for candidate in alike for effect in candidate.effects], from_rest))
        for candidate in alike:
            columns[candidate] = candidate.columns(signals, [next(torques) for _ in candidate.effects])
    return [columns[candidate] for candidate in candidates]


@jit
def _torques(
    experiment: Experiment, effects: AbstractEffect, part: Part, direction: jax.Array, from_rest: bool
) -> dict[int, jax.Array]:
    """Torques of effects of one name, leaves of shape (effects,), in a model that has those in the gear alone; shape
    (effects, samples) by side, -1 being the input."""
    drive, sides = experiment.drive, experiment.sides

    def act(effect: AbstractEffect) -> dict[int, jax.Array]:
        place = drive.resolve_place(effect.place)
        if place == "transmission" and experiment.transmission is None:
            motion = Motion(part.time, part.position["motor"], part.velocity["motor"])
            carried = experiment.plant.load_torque(effect_path(experiment, part)[0], motion)
            return {0: -effect.gear_friction((), carried) * direction}
        if place == "transmission":
            models = (experiment, with_effects(experiment, (*experiment.effects, effect)))
            motion = part.position, part.velocity
            states_of = [(model.plant, effect_path(model, part)[0]) for model in models]
            before, after = (plant.transmitted_torque(*motion, states) for plant, states in states_of)
            rubbed = [
                plant.gear_friction(states, c) for (plant, states), (c, _) in zip(states_of, (before, after), strict=True)
            ]
            return {
                0: before[0] - after[0] + (rubbed[0] - rubbed[1]) * direction,
                1: after[1] * after[0] - before[1] * before[0],
            }
        (state,), acting = effect_path(with_effects(experiment, (effect,)), part, from_rest)
        if place == "actuator":
            return {-1: acting - part.torque}
        driving = part.torque if place == "motor" else 0.0
        motion = Motion(part.time, part.position[place], part.velocity[place], driving)
        resisting = effect.resist(state, motion)
        if type(effect).holds is not AbstractEffect.holds:
            resisting = jnp.where(part.held[place], effect.holds() * direction, resisting)
        resisting = resisting + effect.dry_friction(state, motion) * direction
        resisting = resisting + effect.added_inertia() * part.modelled[place]
        return {sides.index(place): -resisting}

    def fill(torque: jax.Array) -> jax.Array:
        return jnp.broadcast_to(torque, part.time.shape)

    return jax.vmap(lambda effect: {place: fill(torque) for place, torque in act(effect).items()})(effects)


@jit
def _find_needed(experiment: Experiment, part: Part) -> dict[str, jax.Array]:
    """Torque on each side that its motion does not take up, dry friction left out, N m."""
    plant = experiment.plant
    states, torque = effect_path(experiment, part)
    acting = plant.side_torques(part.position, part.velocity, states, torque, part.time)
    torques = {}
    for side in experiment.sides:
        remaining = acting[side][0] - experiment.drive.viscous(side) * part.velocity[side]
        torques[side] = jnp.broadcast_to(remaining - plant.inertia(side) * part.acceleration[side], part.time.shape)
    return torques
