"""Runs of a model over windows of a log, each from the initial state that suits its readings best.

As :func:`jaxbl.estimation.trajectory.projected_residual`, for a model without derivatives by its numbers: paths and the
derivatives of their steps by loops for this machine's processor, and no more values tried for a window than it needs.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxbl.chain import Experiment
from jaxbl.drive.plant import PlantState
from jaxbl.estimation.trajectory import INFLUENCE, RIDGE, Windows
from jaxbl.fused import Arrays
from jaxbl.fused.single_plant import Direction, simulate_plants, step_derivatives

from .neutral_effects import lean

_SETTLED = 1e-9
"""Share of its sum of squares that a further step of a window's search may promise where it ends: rounding is 1e-15, what
decides is 1e-2."""


SEEN_SHARE = 0.2
"""Share of a window that its initial state is fitted to; the rest is foretold."""
_RANK = 1e-10
"""Influence of a combination of states, over the largest, below which it stays where it is."""
_LEAST_SEEN = 8
"""Samples of a window that are seen at least: twice what the states of a side need."""


def count_seen(samples: int) -> int:
    """Samples of a window that its initial state is fitted to."""
    return min(max(int(np.ceil(SEEN_SHARE * samples)), _LEAST_SEEN), samples - 1)


class Run(NamedTuple):
    """A model on windows of a log.

    Attributes:
        residual: measured less simulated positions over the noise; shape (windows, samples, sides).
        states: simulated, leaves of shape (windows, samples).
        noise: what noise in the samples seen adds to the residual, rms, over that noise; shape (sides,).
    """

    residual: np.ndarray
    states: PlantState
    noise: np.ndarray


class _Model(NamedTuple):
    """A model on windows of a log."""

    experiment: Experiment
    windows: Windows

    def states(self, starts: np.ndarray, indices: np.ndarray) -> Arrays:
        """Along some windows, from starts of shape (windows, states)."""
        start = jax.tree.structure(self.windows.start).unflatten(list(starts.T))
        torque, time = self.windows.torque[indices], self.windows.time[indices]
        return jax.tree.leaves(simulate_plants(self.experiment, start, torque, time))  # type: ignore[arg-type]

    def residual(self, states: Arrays, indices: np.ndarray) -> np.ndarray:
        w = self.windows
        motion = jax.tree.structure(w.start).unflatten(states)
        sides = [(w.measured[side][indices] - motion.position[side]) / w.noise[side] for side in self.experiment.sides]
        return np.stack(sides, axis=-1)

    def slope(self, states: Arrays, indices: np.ndarray) -> np.ndarray:
        """Derivative of the residual by the initial states, shape (windows, samples, sides, states)."""
        w, shape = self.windows, jax.tree.structure(self.windows.start)
        count, (runs, samples) = len(states), states[0].shape
        ways = [Direction(state=row) for row in np.eye(count).tolist()]
        time = w.time[indices][:, None] + float(self.experiment.run.sample_period) * np.arange(samples)
        flat = shape.unflatten([state.ravel() for state in states])
        changes, _ = step_derivatives(self.experiment, flat, np.asarray(w.torque[indices]).ravel(), time.ravel(), ways)
        steps = changes.reshape(count, count, runs, samples).transpose(3, 2, 1, 0)
        places: Any = shape.unflatten(range(count))
        rows = [places.position[side] for side in self.experiment.sides]
        slopes = np.empty((samples, runs, len(rows), count))
        reached = np.broadcast_to(np.eye(count), (runs, count, count))
        for i in range(samples):
            slopes[i] = reached[:, rows]
            reached = steps[i] @ reached
        noise = np.array([float(w.noise[side]) for side in self.experiment.sides])
        return -slopes.transpose(1, 0, 2, 3) / noise[:, None]


def best_runs(
    experiment: Experiment,
    windows: Windows,
    passes: int,
    at_rest: bool,
    indices: np.ndarray | None = None,
) -> Run:
    """Runs from the initial states that suit the first fifth of each window best, found by damped Gauss-Newton.

    Args:
        experiment: the model, at the windows' period.
        windows: without weights.
        passes: initial states that are tried for a window at most.
        rest: whether standstill is one of them.
        which: indices of the windows that are run; left out: all.
    """
    windows = jax.tree.map(np.asarray, windows)
    experiment, start = lean(experiment, windows.start)
    windows = dataclasses.replace(windows, start=start)
    # what was before a window is known where it goes on where another one ends
    steps = np.rint(np.diff(windows.time) / float(experiment.run.sample_period))
    within = np.concatenate([[False], steps == windows.torque.shape[1]]) | windows.at_rest
    if indices is not None:
        windows, within = windows.only(indices), within[indices]
    with np.errstate(invalid="ignore", over="ignore"):
        return _search_starts(_Model(experiment, windows), passes, at_rest, within)


def _search_starts(model: _Model, passes: int, at_rest: bool, within: np.ndarray) -> Run:
    """Find the best start of each window; `within`: where what was before it is known."""
    windows, sides = model.windows, model.experiment.sides
    leaves, shape = jax.tree.flatten(windows.start)
    places: Any = shape.unflatten(range(len(leaves)))
    best = np.stack([np.broadcast_to(leaf, len(windows.time)) for leaf in leaves], axis=1).astype(float)
    runs, count = best.shape
    samples = windows.torque.shape[1]
    scored = count_seen(samples)
    moving = [places.velocity[side] for side in sides]
    still, fitted = best.copy(), np.ones_like(best)
    still[:, moving] = 0.0
    fitted[np.ix_(np.flatnonzero(windows.at_rest), moving)] = 0.0
    for effect, state in zip(model.experiment.effects, places.effects, strict=True):
        columns = jax.tree.leaves(state)
        if columns and (effect.state_from_measurement or effect.state_from_input):
            fitted[np.ix_(np.flatnonzero(within | effect.state_from_input), columns)] = 0.0
    residual, slope = np.zeros((runs, samples, len(sides))), np.zeros((runs, samples, len(sides), count))
    states = [np.zeros((runs, samples)) for _ in leaves]
    if not runs:
        return Run(residual, shape.unflatten(states), np.zeros(len(sides)))
    cost, damping, following = np.full(runs, np.inf), np.full(runs, RIDGE), best.copy()
    going = np.ones(runs, bool)
    for i in range(passes):
        if at_rest and i == passes // 2 + 1:
            # from there nothing leads back: a side that friction holds does not feel a little velocity
            following, going = still.copy(), np.ones(runs, bool)
            damping[:] = RIDGE
        indices = np.flatnonzero(going)
        if not len(indices):
            continue
        new_states = model.states(following[indices], indices)
        value = model.residual(new_states, indices)
        squares = np.sum(value[:, :scored] ** 2, axis=(1, 2))
        better = (squares < cost[indices]) | ~np.isfinite(cost[indices])
        new = indices[better]
        damping[indices] = np.where(
            better, np.maximum(0.01 * damping[indices], RIDGE), np.maximum(30.0 * damping[indices], 1e-2)
        )
        if len(new):
            best[new], cost[new], residual[new] = following[new], squares[better], value[better]
            for stored, new_state in zip(states, new_states, strict=True):
                stored[new] = new_state[better]
            slope[new] = model.slope([new_state[better] for new_state in new_states], new) * fitted[new][:, None, None, :]
        flat = slope[indices][:, :scored].reshape(len(indices), -1, count)
        size = _sizes(flat)
        unit = flat / size[:, None, :]
        towards = np.einsum("wrn,wr->wn", unit, residual[indices][:, :scored].reshape(len(indices), -1))
        matrix = unit.transpose(0, 2, 1) @ unit + damping[indices][:, None, None] * np.eye(count)
        change = np.linalg.solve(matrix, towards[:, :, None])[:, :, 0]
        following[indices] = best[indices] - change / size
        going[indices] = ~(np.einsum("wn,wn->w", change, towards) <= _SETTLED * cost[indices])
    first = slope[:, :scored].reshape(runs, -1, count)
    size = _sizes(first)[:, None, :]
    unit, first = slope / size[:, :, None, :], first / size
    inverse = np.linalg.pinv(np.where(np.isfinite(first), first, 0.0), rcond=_RANK)
    change = np.einsum("wnr,wr->wn", inverse, residual[:, :scored].reshape(runs, -1))
    left = residual - np.einsum("wrsn,wn->wrs", unit, change)
    spread = np.einsum("wrsn,wnm,wrsm->wrs", unit[:, scored:], inverse @ inverse.transpose(0, 2, 1), unit[:, scored:])
    return Run(left, shape.unflatten(states), np.sqrt(np.mean(spread, axis=(0, 1))))


def _sizes(columns: np.ndarray) -> np.ndarray:
    """Influence of each state of a window, shape (windows, states), by columns of shape (windows, rows, states); infinite
    where there is none: what the samples do not show stays where it is, and adds no noise."""
    size = np.sqrt(np.sum(columns**2, axis=1))
    return np.where(size > INFLUENCE * np.max(size, axis=1, keepdims=True), size, np.inf)
