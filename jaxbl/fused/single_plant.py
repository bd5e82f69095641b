"""A single plant under a recorded input: its trajectory, and the derivatives of its steps, by compiled loops.

The numbers are those of :func:`jaxbl.chain.plant_trajectory` and of `jax.jvp` of :func:`jaxbl.chain.move_plant`,
many times as fast: XLA starts some twenty kernels for a step of a single plant, and passes what they compute through memory.
What the loops do not support (effects that read tables) is left to XLA. All is in float64, under `jax.enable_x64`.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import compress
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxbl.chain import (
    Experiment,
    NamedArrays,
    begin_sample,
    correct_by_readings,
    move_plant,
)
from jaxbl.drive.parameters import get_leaf
from jaxbl.drive.plant import PlantState
from jaxbl.workers import map_in_threads

from . import Leaves
from .compiled_loop import NUMBER, LoopDefinition, compile_once

_FLOAT = np.dtype(float)
_UNREADABLE = object()
"""In place of leaves that are no numbers, such as tables: loops are not compiled where a step reads one."""


class Direction(NamedTuple):
    """The direction of a derivative of a step.

    Attributes:
        numbers: changes of the experiment's numbers, by path.
        state: changes of the state's leaves; () for none.
        torque: change of the input (N m).
    """

    numbers: Mapping[str, float] = {}
    state: Sequence[float] = ()
    torque: float = 0.0


def simulate_plant(
    experiment: Experiment,
    start: PlantState,
    torque: np.ndarray,
    time: float = 0.0,
    measured: NamedArrays | None = None,
    gain: NamedArrays | None = None,
) -> PlantState:
    """Simulate one plant; arguments as for :func:`jaxbl.chain.plant_trajectory`.

    Returns:
        Its states at the samples, leaves `(samples,)`.
    """
    starts, torques, readings = jax.tree.map(lambda x: np.asarray(x)[None], (start, torque, measured or {}))
    states = simulate_plants(experiment, starts, torques, np.array([time], float), readings, gain)
    return jax.tree.map(lambda x: x[0], states)


def simulate_plants(
    experiment: Experiment,
    starts: PlantState,
    torque: np.ndarray,
    time: np.ndarray,
    measured: NamedArrays | None = None,
    gain: NamedArrays | None = None,
) -> PlantState:
    """Simulate several runs of a plant.

    Args:
        experiment: with array leaves.
        starts: states at the first samples, leaves `(runs,)`.
        torque: input (N m), `(runs, samples)`.
        time: of the first samples (s), `(runs,)`.
        measured: readings of each side (rad), `(runs, samples)`.
        gain: by which readings correct the state, as for :func:`jaxbl.chain.plant_trajectory`.

    Returns:
        States at the samples, leaves `(runs, samples)`.
    """
    simulator = PlantSimulator(experiment, starts, (), gain or {})
    return simulator({}, starts, torque, time, measured or {}, gain or {})


class PlantSimulator:
    """Simulates plants that differ in a few numbers, many times; what is the same is prepared once.

    Args:
        experiment: with array leaves.
        state: an example of a state.
        varied: paths of the numbers that differ.
        sides: whose readings correct the state.
    """

    def __init__(self, experiment: Experiment, state: PlantState, varied: Sequence[str], sides: Iterable[str]):
        self.varied, self.sides = tuple(varied), tuple(sorted(sides))
        structure = _PlantStructure.of(experiment, state)
        self.loop, self.places = _trajectory_loop(structure, self.sides), list(_find_places(structure, self.varied))
        self.numbers, self.tables = structure.split_leaves(experiment)

    def __call__(
        self,
        values: Mapping[str, float],
        starts: PlantState,
        torque: np.ndarray,
        time: np.ndarray,
        measured: NamedArrays,
        gain: NamedArrays,
    ) -> PlantState:
        """Simulate with these values of the varied numbers; other arguments as for :func:`simulate_plants`."""
        numbers = self.numbers.copy()
        numbers[self.places] = [values[path] for path in self.varied]
        # of each sample, torque first
        columns = [np.ascontiguousarray(column, float) for column in (torque, *(measured[side] for side in self.sides))]
        gains = [gain[side] for side in self.sides]
        leaves, structure = jax.tree.flatten(starts)
        index = np.arange(torque.shape[1], dtype=np.int32)

        def simulate_run(i: int) -> np.ndarray:
            carry = [np.asarray(leaf[i : i + 1], float) for leaf in leaves]
            constants, inputs = np.concatenate([numbers, time[i : i + 1], *gains]), [column[i] for column in columns]
            groups = {"carry": carry, "constants": constants, "sample_inputs": [index, *inputs]}
            return self.loop.run(len(index), **groups, tables=self.tables)[1]

        runs = map_in_threads(simulate_run, range(len(torque)))
        return structure.unflatten(np.stack(rows)[..., 0] for rows in zip(*runs, strict=True))


def step_derivatives(
    experiment: Experiment,
    states: PlantState,
    torque: np.ndarray,
    time: np.ndarray,
    directions: Sequence[Direction],
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of the step that follows each sample, and the state after it.

    Args:
        experiment: with array leaves.
        states: at the samples, leaves `(samples,)`; likewise torque (N m) and time (s).
        directions: of change.

    Returns:
        Change of the state along each direction `(directions, states, samples)`, in the order of the state's leaves, and the
        state after the step `(states, samples)`.
    """
    structure, leaves = _PlantStructure.of(experiment, states), jax.tree.leaves(states)
    loop = _derivatives_loop(structure)
    width = loop.whole_vectors(len(torque))
    values = np.pad(np.stack([*leaves, torque, time], dtype=float), ((0, 0), (0, width - len(torque))), "edge")
    (numbers, tables), tangents = structure.split_leaves(experiment), structure.stack_tangents(directions)
    changes, new = np.empty((len(tangents), len(leaves), width)), np.empty((len(leaves), width))

    def differentiate(first: int) -> None:
        together = slice(first, first + _TOGETHER)
        constants = np.concatenate([numbers, *tangents[together]])
        # all write the same new state
        outputs = [*changes[together].reshape(-1, width), *new]
        loop.run(1, width, values=values, constants=constants, tables=tables, outputs=outputs)

    map_in_threads(differentiate, range(0, len(tangents), _TOGETHER))
    return changes[: len(directions), :, : len(torque)], new[:, : len(torque)]


class _PlantStructure(NamedTuple):
    """Structure of the arguments that loops are compiled for.

    Attributes:
        experiment_tree: structure of the experiments.
        is_number: for each leaf of the experiments, whether it is a number that steps may read.
        state_tree: structure of a plant's state.
    """

    experiment_tree: Any
    is_number: tuple[bool, ...]
    state_tree: Any

    @classmethod
    def of(cls, experiment: Experiment, state: PlantState) -> "_PlantStructure":
        leaves, tree = jax.tree.flatten(experiment)
        is_number = tuple(np.shape(leaf) == () and getattr(leaf, "dtype", _FLOAT) == _FLOAT for leaf in leaves)
        return cls(tree, is_number, jax.tree.structure(state))

    @property
    def examples(self) -> tuple[Any, Any]:
        """Experiment and state, with types in place of numbers."""
        leaves = [NUMBER if is_number else None for is_number in self.is_number]
        return self.experiment_tree.unflatten(leaves), self.state_tree.unflatten([NUMBER] * self.state_tree.num_leaves)

    @property
    def number_examples(self) -> Leaves:
        """Types of the numbers of an experiment."""
        return [NUMBER] * sum(self.is_number)

    def split_leaves(self, experiment: Experiment) -> tuple[np.ndarray, Leaves]:
        """The numbers of an experiment, and its other leaves."""
        leaves = jax.tree.leaves(experiment)
        tables = [leaf for leaf, is_number in zip(leaves, self.is_number, strict=True) if not is_number]
        return np.array([np.asarray(leaf) for leaf in compress(leaves, self.is_number)], float), tables

    def stack_tangents(self, directions: Sequence[Direction]) -> np.ndarray:
        """Directions as rows: changes of the numbers, of the state's leaves, of the input."""
        paths = tuple(dict.fromkeys(path for direction in directions for path in direction.numbers))
        places, count = dict(zip(paths, _find_places(self, paths), strict=True)), sum(self.is_number)
        rows = -(-len(directions) // _TOGETHER) * _TOGETHER
        tangents = np.zeros((rows, count + self.state_tree.num_leaves + 1))
        for row, direction in zip(tangents, directions, strict=False):
            for path, change in direction.numbers.items():
                row[places[path]] = change
            if len(direction.state):
                row[count:-1] = direction.state
            row[-1] = direction.torque
        return tangents

    def build_experiment(self, numbers: Sequence[Any], tables: Sequence[Any]) -> Experiment:
        """The experiment from its leaves; without tables, what reads one fails."""
        left, left_tables = iter(numbers), iter(tables)
        leaves = (next(left) if is_number else next(left_tables, _UNREADABLE) for is_number in self.is_number)
        return self.experiment_tree.unflatten(leaves)

    def step(self, experiment: Experiment, state: Sequence[Any], torque: Any, time: Any) -> Leaves:
        """Leaves of the plant's state one sample later."""
        new = move_plant(experiment.plant, experiment.run, self.state_tree.unflatten(state), torque, time)
        return jax.tree.leaves(new)


@lru_cache(maxsize=256)
def _find_places(structure: _PlantStructure, paths: tuple[str, ...]) -> tuple[int, ...]:
    """Places of numbers among those of an experiment, by path."""
    places = structure.experiment_tree.unflatten(np.cumsum(structure.is_number) - 1)
    return tuple(get_leaf(places, path) for path in paths)


@compile_once
def _trajectory_loop(structure: _PlantStructure, sides: tuple[str, ...] = ()) -> LoopDefinition:
    """The loop from state, numbers, first time and gains, and a sample's index, torque and readings."""

    def sample(state: Leaves, constants: Any, inputs: Leaves, tables: Sequence[Any] = ()) -> tuple[Leaves, Leaves]:
        (numbers, start, gains), (index, torque, *readings) = constants, inputs
        experiment = structure.build_experiment(numbers, tables)
        gain = {side: gains[2 * i : 2 * i + 2] for i, side in enumerate(sides)}
        plant_state = correct_by_readings(
            structure.state_tree.unflatten(state), dict(zip(sides, readings, strict=True)), gain
        )
        time = start + index.astype(torque.dtype) * experiment.run.sample_period
        return structure.step(experiment, jax.tree.leaves(plant_state), torque, time), state

    count = structure.state_tree.num_leaves
    constants = structure.number_examples, NUMBER, [NUMBER] * (2 * len(sides))
    inputs = [jax.ShapeDtypeStruct((), np.int32), *[NUMBER] * (1 + len(sides))]
    return sample, {"carry": [NUMBER] * count, "constants": constants, "sample_inputs": inputs}, 1


_TOGETHER = 2
"""Directions of one loop, which take the step itself but once: 0.6 of the time. More take too long to compile."""


@compile_once
def _derivatives_loop(structure: _PlantStructure) -> LoopDefinition:
    """The loop from a lane's state, torque and time, from numbers, and from tangents of numbers, state and torque."""

    def differentiate(values: Any, constants: Any, tables: Sequence[Any] = ()) -> tuple[Leaves, Leaves]:
        (start, torque, time), (numbers, tangents) = values, constants

        def begin(numbers: Leaves, start: Leaves, torque: Any) -> tuple[PlantState, Any]:
            experiment = structure.build_experiment(numbers, tables)
            return begin_sample(experiment.plant, experiment.run, structure.state_tree.unflatten(start), torque, time)

        def advance(index: Any, carry: tuple[Leaves, list[Leaves]]) -> tuple[Leaves, list[Leaves]]:
            def substep(state: Leaves, *sample: Any) -> Leaves:
                return jax.tree.leaves(begin(*sample)[1](index, structure.state_tree.unflatten(state)))

            changed = [(change, *tangent) for change, tangent in zip(carry[1], tangents, strict=True)]
            return _linearise(substep, (carry[0], numbers, start, torque), changed)

        begun = _linearise(lambda *sample: jax.tree.leaves(begin(*sample)[0]), (numbers, start, torque), tangents)
        new, changes = jax.lax.fori_loop(0, structure.build_experiment(numbers, tables).run.substeps, advance, begun)
        return jax.tree.leaves(changes), new

    state, numbers = [NUMBER] * structure.state_tree.num_leaves, structure.number_examples
    constants = numbers, [(numbers, state, NUMBER)] * _TOGETHER
    return differentiate, {"values": (state, NUMBER, NUMBER), "constants": constants}, None


def _linearise(function: Any, primals: tuple[Any, ...], tangents: Sequence[Any]) -> tuple[Leaves, list[Leaves]]:
    """Value of a function, and its changes along several tangents."""
    new, change = jax.linearize(function, *primals)
    return new, [change(*tangent) for tangent in tangents]
