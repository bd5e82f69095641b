"""A plant alone under a recorded input: its path, and the derivatives of its steps, by loops for this machine's processor.

The same as :func:`jaxbl.simulate.plant_trajectory` and `jax.jvp` of :func:`jaxbl.simulate.move_plant` compute, many times
as fast: XLA starts some twenty kernels for a step of a single plant, and passes what they compute through memory. What the
loops cannot do (effects that read tables) is left to XLA. In float64, under `jax.enable_x64`.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, wraps
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.drive.parameters import get_leaf, set_leaves
from jaxbl.drive.plant import PlantState
from jaxbl.simulate import Experiment, correct_by_readings, move_plant
from jaxbl.workers import map_in_threads

from . import Unsupported, program_cache, raising_unsupported, warn_of_scan

_FLOAT = np.dtype(float)
_NUMBER = jax.ShapeDtypeStruct((), _FLOAT)


class Direction(NamedTuple):
    """In which a step's derivative is sought: changes of the experiment's numbers, by dotted paths, of the state's leaves
    (left out: none), and of the input (N m)."""

    numbers: Mapping[str, float] = {}
    state: Sequence[float] = ()
    torque: float = 0.0


def simulate_plant(
    experiment: Experiment,
    start: PlantState,
    torque: np.ndarray,
    time: float = 0.0,
    measured: dict[str, np.ndarray] | None = None,
    gain: dict[str, np.ndarray] | None = None,
) -> PlantState:
    """The plant's states at the samples, with a leading time axis; arguments of :func:`jaxbl.simulate.plant_trajectory`."""
    starts, torques, readings = jax.tree.map(lambda x: np.asarray(x)[None], (start, torque, measured or {}))
    found = simulate_plants(experiment, starts, torques, np.array([time], float), readings, gain)
    return jax.tree.map(lambda x: x[0], found)


def simulate_plants(
    experiment: Experiment,
    starts: PlantState,
    torque: np.ndarray,
    time: np.ndarray,
    measured: Mapping[str, np.ndarray] | None = None,
    gain: Mapping[str, np.ndarray] | None = None,
    varying: Mapping[str, np.ndarray] | None = None,
) -> PlantState:
    """As :func:`path`, for several runs: starts and times `(runs,)`, input and readings `(runs, samples)`.

    Numbers of the experiment that differ from sample to sample are `varying`, by dotted paths, `(runs, samples)`.
    """
    plant, varying = _PlantStructure.of(experiment, starts), varying or {}
    sides = () if gain is None else tuple(sorted(gain))
    loop = _path_loop(plant, sides, plant.places(tuple(varying)))
    if loop is None:
        given = starts, torque, time, dict(measured or {}), dict(varying)
        rows = [jax.tree.map(lambda x, i=i: jnp.asarray(x[i]), given) for i in range(len(torque))]
        each = [_scanned(experiment, gain, *one) for one in rows]  # pyright: ignore[reportCallIssue]
        return jax.tree.map(lambda *x: np.stack(x), *each)
    gains = [float(value) for side in sides for value in (gain or {})[side]]
    others = [*((measured or {})[side] for side in sides), *varying.values()]
    return _run(loop, plant.numbers(experiment), plant.shape, starts, torque, time, others, gains)


def _run(
    loop: Any,
    numbers: np.ndarray,
    shape: Any,
    starts: PlantState,
    torque: np.ndarray,
    time: np.ndarray,
    others: Sequence[np.ndarray],
    gains: Sequence[float],
) -> PlantState:
    """Several runs of a loop; `others`: what there is of each sample beside its torque, `(runs, samples)` each."""
    from .llvm import ArrayRows

    runs, samples = torque.shape
    columns = [np.ascontiguousarray(column, float) for column in (torque, *others)]
    fixed = np.concatenate([numbers, [0.0], gains])
    at = len(fixed) - len(gains) - 1
    leaves = [np.asarray(leaf, float) for leaf in jax.tree.leaves(starts)]
    kept, index = [np.empty((runs, samples)) for _ in leaves], np.arange(samples, dtype=np.int32)

    def one(i: int) -> None:
        carry, own = [np.array([leaf[i]]) for leaf in leaves], fixed.copy()
        own[at] = time[i]
        given = ArrayRows(own), index, *(column[i] for column in columns), *(rows[i] for rows in kept)
        loop([*carry, *given], samples, 0, 1)

    map_in_threads(one, range(runs))
    return shape.unflatten(kept)


class PlantSimulator:
    """:func:`paths` of experiments that differ in a few numbers, many times: what is the same is found once.

    Args:
        experiment: with array leaves.
        state: one of any values.
        varied: dotted paths of the numbers that differ.
        sides: that readings correct.
    """

    def __init__(self, experiment: Experiment, state: PlantState, varied: Sequence[str], sides: Sequence[str]):
        self.experiment, self.varied, self.sides = experiment, tuple(varied), tuple(sorted(sides))
        plant = _PlantStructure.of(experiment, state)
        self.shape = plant.shape
        self.loop = _path_loop(plant, self.sides, ())
        if self.loop is not None:
            self.numbers, read = np.array(plant.numbers(experiment), float), _read(plant)
            self.places = [read.index(i) if i in read else -1 for i in plant.places(self.varied)]

    def __call__(
        self,
        values: Mapping[str, float],
        starts: PlantState,
        torque: np.ndarray,
        time: np.ndarray,
        measured: Mapping[str, np.ndarray],
        gain: Mapping[str, np.ndarray],
    ) -> PlantState:
        """With these values of the varied numbers; other arguments as of :func:`paths`."""
        if self.loop is None:
            experiment = set_leaves(self.experiment, {path: np.asarray(values[path], float) for path in self.varied})
            return simulate_plants(experiment, starts, torque, time, measured, gain)
        numbers = self.numbers.copy()
        for place, path in zip(self.places, self.varied, strict=True):
            if place >= 0:
                numbers[place] = values[path]
        return _run(self.loop, numbers, self.shape, starts, torque, time, [measured[side] for side in self.sides],
                    [float(value) for side in self.sides for value in gain[side]])  # fmt: skip


def step_derivatives(
    experiment: Experiment,
    states: PlantState,
    torque: np.ndarray,
    time: np.ndarray,
    directions: Sequence[Direction],
    varying: Mapping[str, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of the step that follows each sample, and where it leads.

    Args:
        experiment: with array leaves.
        states: at the samples, leaves `(samples,)`; likewise torque (N m) and time (s).
        directions: of change.
        varying: numbers of the experiment that differ from sample to sample, by dotted paths, `(samples,)`.

    Returns:
        Change of the state along each direction `(directions, states, samples)`, in the order of the state's leaves, and the
        state after the step `(states, samples)`.
    """
    plant, varying = _PlantStructure.of(experiment, states), varying or {}
    leaves = jax.tree.leaves(states)
    loop = _slopes_loop(plant, plant.places(tuple(varying)))
    if loop is None:
        # numbers as arrays: one program for all directions
        zeros, given = jax.tree.map(np.zeros_like, experiment), (states, torque, time, dict(varying))
        found = []
        for one in directions:
            state = jax.tree.structure(states).unflatten(np.array(one.state, float) if one.state else np.zeros(len(leaves)))
            ways = set_leaves(zeros, _arrays(one.numbers)), state, np.asarray(one.torque, float)
            found.append(_pushed(experiment, *jax.tree.map(jnp.asarray, (*given, ways))))  # pyright: ignore[reportCallIssue]
        changes, new = [jax.tree.leaves(change) for change, _ in found], jax.tree.leaves(found[0][1])
        return np.array(changes, float), np.array(new, float)
    from .llvm import ArrayRows

    count = len(torque)
    whole = -(-count // loop.lanes) * loop.lanes
    values = [
        np.pad(np.asarray(column, float), (0, whole - count), "edge")
        for column in (*leaves, torque, time, *varying.values())
    ]
    numbers, ways = plant.numbers(experiment), plant.ways(directions)
    changes, new = np.empty((len(directions), len(leaves), whole)), np.empty((len(leaves), whole))

    def along(way: np.ndarray, change: np.ndarray) -> None:
        # all find the same new state
        loop([*values, ArrayRows(numbers), ArrayRows(way), ArrayRows(change), ArrayRows(new)], 1, 0, whole)

    map_in_threads(along, ways, changes)
    return changes[:, :, :count], new[:, :count]


def _arrays(numbers: Mapping[str, float]) -> dict[str, np.ndarray]:
    return {path: np.asarray(value, float) for path, value in numbers.items()}


@eqx.filter_jit
def _scanned(
    experiment: Experiment,
    gain: Any,
    start: PlantState,
    torque: jax.Array,
    time: jax.Array,
    measured: dict[str, jax.Array],
    varying: dict[str, jax.Array],
) -> PlantState:
    def sample(state: PlantState, given: Any) -> tuple[PlantState, PlantState]:
        index, torque, readings, numbers = given
        at, one = time + index * experiment.run.sample_period, set_leaves(experiment, numbers)
        return move_plant(one.plant, one.run, correct_by_readings(state, readings, gain or {}), torque, at), state

    samples = jnp.arange(len(torque)).astype(float), torque, measured, varying
    return jax.lax.scan(sample, jax.tree.map(lambda x: jnp.asarray(x, float), start), samples)[1]


@eqx.filter_jit
def _pushed(
    experiment: Experiment,
    states: PlantState,
    torque: jax.Array,
    time: jax.Array,
    varying: dict[str, jax.Array],
    direction: tuple[Experiment, PlantState, jax.Array],
) -> tuple[PlantState, PlantState]:
    def step(state: PlantState, torque: jax.Array, time: jax.Array, numbers: Any) -> tuple[PlantState, PlantState]:
        def moved(experiment: Experiment, state: PlantState, torque: jax.Array) -> PlantState:
            return move_plant(experiment.plant, experiment.run, state, torque, time)

        given = set_leaves(experiment, numbers), state, torque
        changes = jax.tree.map(lambda one, change: jnp.broadcast_to(change, one.shape).astype(one.dtype), given, direction)
        new, change = jax.jvp(moved, given, changes)
        return change, new

    return jax.vmap(step)(states, torque, time, varying)


class _PlantStructure(NamedTuple):
    """What loops are compiled for: experiments of one structure, shapes and types of their leaves, structure of a state."""

    structure: Any
    kinds: tuple[tuple[tuple[int, ...], np.dtype], ...]
    shape: Any

    @classmethod
    def of(cls, experiment: Experiment, state: PlantState) -> "_PlantStructure":
        leaves, structure = jax.tree.flatten(experiment)
        kinds = tuple((np.shape(leaf), getattr(leaf, "dtype", None) or np.dtype(jnp.result_type(leaf))) for leaf in leaves)
        return cls(structure, kinds, jax.tree.structure(state))

    @property
    def described(self) -> tuple[Any, Any]:
        """Experiment and state, of numbers and arrays their types alone."""
        leaves = [jax.ShapeDtypeStruct(size, dtype) for size, dtype in self.kinds]
        return self.structure.unflatten(leaves), self.shape.unflatten([_NUMBER] * self.shape.num_leaves)

    def numbers(self, experiment: Experiment) -> np.ndarray:
        """Those that a step reads."""
        leaves = jax.tree.leaves(experiment)
        return np.array([float(leaves[i]) for i in _read(self)])

    def ways(self, directions: Sequence[Direction]) -> np.ndarray:
        """Changes along each direction: of the numbers that a step reads, the state's leaves, the input."""
        paths = tuple(dict.fromkeys(path for one in directions for path in one.numbers))
        places, read = dict(zip(paths, self.places(paths), strict=True)), {at: i for i, at in enumerate(_read(self))}
        found = np.zeros((len(directions), len(read) + self.shape.num_leaves + 1))
        for row, one in zip(found, directions, strict=True):
            for path, change in one.numbers.items():
                if places[path] in read:
                    row[read[places[path]]] = change
            if len(one.state):
                row[len(read) : -1] = one.state
            row[-1] = one.torque
        return found

    def places(self, paths: tuple[str, ...]) -> tuple[int, ...]:
        """Places of numbers among the experiment's leaves, by their dotted paths."""
        return _places(self, paths)

    def put(self, numbers: Sequence[Any], others: Mapping[int, Any]) -> Experiment:
        """The experiment with these, and with others in their places; what no step reads is zero."""
        # of NumPy, so that they leave no trace
        leaves: list[Any] = [np.zeros(size, dtype) for size, dtype in self.kinds]
        for i, number in zip(_read(self), numbers, strict=True):
            leaves[i] = others.get(i, number)
        return self.structure.unflatten(leaves)

    def step(self, experiment: Experiment, state: Sequence[Any], torque: Any, time: Any) -> list[Any]:
        new = move_plant(experiment.plant, experiment.run, self.shape.unflatten(state), torque, time)
        return jax.tree.leaves(new)


@lru_cache(maxsize=256)
def _places(plant: _PlantStructure, paths: tuple[str, ...]) -> tuple[int, ...]:
    order = plant.structure.unflatten(range(len(plant.kinds)))
    return tuple(get_leaf(order, path) for path in paths)


@lru_cache(maxsize=64)
def _read(plant: _PlantStructure) -> tuple[int, ...]:
    """Places of the experiment's leaves that a step reads. Raises `Unsupported` if one of them is no number."""
    key = program_cache.program_key("numbers read", *plant.described)
    found = program_cache.load(key)
    if found is None:
        found = _found_read(plant)
        program_cache.save(key, found)
    return found


def _found_read(plant: _PlantStructure) -> tuple[int, ...]:
    from .jaxprs import trace_inlined

    def step(leaves: list[Any], state: list[Any], torque: Any, time: Any) -> list[Any]:
        return plant.step(plant.structure.unflatten(leaves), state, torque, time)

    leaves = [jax.ShapeDtypeStruct(size, dtype) for size, dtype in plant.kinds]
    closed = trace_inlined(step, leaves, [_NUMBER] * plant.shape.num_leaves, _NUMBER, _NUMBER)
    used = {id(v) for eqn in closed.jaxpr.eqns for v in eqn.invars} | {id(v) for v in closed.jaxpr.outvars}
    read = tuple(i for i, v in enumerate(closed.jaxpr.invars[: len(leaves)]) if id(v) in used)
    for i in read:
        if plant.kinds[i] != ((), _FLOAT):
            raise Unsupported(f"steps that read {plant.kinds[i]}")
    return read


def _or_none(written: Callable[..., tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]]) -> Any:
    """Compiles a loop once, from a function of a sample, examples of its arguments, and options; None where it cannot."""

    @lru_cache(maxsize=64)
    @wraps(written)
    def found(plant: _PlantStructure, *given: Any) -> Any:
        key = program_cache.program_key(f"loop of {written.__qualname__}", *plant.described, given)
        if (loop := program_cache.load(key)) is not None:
            return loop
        try:
            with raising_unsupported():
                from .jaxprs import trace
                from .llvm import Loop

                sample, examples, numbers = written(plant, *given)
                loop = Loop(trace(sample, *examples), _FLOAT, **numbers)
                program_cache.save(key, loop)
                return loop
        except Unsupported as why:
            warn_of_scan(str(why))
            return None

    return found


@_or_none
def _path_loop(plant: _PlantStructure, sides: tuple[str, ...] = (), varying: tuple[int, ...] = ()) -> Any:
    """From state, numbers, first time and gains, and a sample's index, torque, readings and varying numbers."""

    def sample(state: list[Any], numbers: list[Any], first: Any, gains: list[Any], index: Any, inputs: list[Any]) -> Any:
        torque, *readings = inputs[: 1 + len(sides)]
        experiment = plant.put(numbers, dict(zip(varying, inputs[1 + len(sides) :], strict=True)))
        gain = {side: gains[2 * i : 2 * i + 2] for i, side in enumerate(sides)}
        seen = correct_by_readings(plant.shape.unflatten(state), dict(zip(sides, readings, strict=True)), gain)
        time = first + index.astype(torque.dtype) * experiment.run.sample_period
        return plant.step(experiment, jax.tree.leaves(seen), torque, time), state

    count = plant.shape.num_leaves
    fixed = [_NUMBER] * len(_read(plant)), _NUMBER, [_NUMBER] * (2 * len(sides))
    index, inputs = jax.ShapeDtypeStruct((), np.int32), [_NUMBER] * (1 + len(sides) + len(varying))
    examples = [_NUMBER] * count, *fixed, index, inputs
    return sample, examples, {"carry": count, "lanes": 1, "fixed": len(jax.tree.leaves(fixed))}


@_or_none
def _slopes_loop(plant: _PlantStructure, varying: tuple[int, ...] = ()) -> Any:
    """From state, torque, time and varying numbers of a lane, numbers, and changes of numbers, state and torque."""

    def slope(state: list[Any], torque: Any, time: Any, own: list[Any], numbers: list[Any], changes: tuple[Any, ...]) -> Any:
        def step(numbers: list[Any], state: list[Any], torque: Any) -> list[Any]:
            return plant.step(plant.put(numbers, {}), state, torque, time)

        at = dict(zip(varying, own, strict=True))
        numbers = [at.get(i, number) for i, number in zip(_read(plant), numbers, strict=True)]
        new, change = jax.jvp(step, (numbers, state, torque), changes)
        return change, new

    count = plant.shape.num_leaves
    state, numbers, own = [_NUMBER] * count, [_NUMBER] * len(_read(plant)), [_NUMBER] * len(varying)
    examples = state, _NUMBER, _NUMBER, own, numbers, (numbers, state, _NUMBER)
    return slope, examples, {"values": count + 2 + len(varying), "fixed": 2 * len(numbers) + count + 1}
