"""Trajectory fit: parameters of an experiment from a record, through the simulator.

Output error on windows, each with a free initial state (multiple shooting), so that integrating plants and records made in
closed loop are handled alike. Initial states are eliminated within each window by Gauss-Newton, and what they could explain
is projected out of the residuals: variable projection with Kaufman's derivative. Levenberg-Marquardt (:mod:`.descent`) then
sees the parameters alone. Trajectories and the derivatives of their steps come from loops for this machine's processor.
References: G. Golub, V. Pereyra, Separable nonlinear least squares, Inverse Problems 19 (2003); L. Kaufman, BIT 15 (1975);
H. G. Bock, Recent advances in parameter identification techniques for ODE (1983).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from jaxbl.chain import Experiment, PlantState, correct_by_readings
from jaxbl.fused.single_plant import Direction, simulate_plants, step_derivatives

from .descent import descend, linearise
from .free_parameters import PRIOR_DEVIATION, FreeParameter, set_free_parameters

_INNER, _OUTER = 2, 12
"""Initial states tried for a window at each step of the fit; and where they are sought anew."""
RIDGE = 1e-10
"""Least damping of a search for initial states, over the columns' squares: above rounding, below what it changes."""
INFLUENCE = 1e-20
"""Of a state, over that of the one with the most: what is below is none (an effect that does nothing)."""
_SETTLED = 1e-9
"""Share of its sum of squares that a further step of a window's search may promise where it ends: rounding is 1e-15, what
decides is 1e-2."""
_ENOUGH = 2e-3
"""A fit has ended where a step takes less than this off the sum of squares, in units of the residuals' variance."""
_GAINED = 1.0
"""Residuals' variances that new initial states must gain in a window for the solver to start again."""
_AT_ONCE = 200_000
"""Samples whose derivatives are computed at once, which bounds memory."""


class Windows(eqx.Module):
    """A record cut into windows of equal length.

    Attributes:
        torque: input in N m, shape (windows, samples).
        measured: positions of each side in rad, shape (windows, samples).
        time: of each window's first sample, s, shape (windows,).
        start: a guess of the state at each window's first sample, leaves of shape (windows,).
        noise: standard deviation of each side's readings (of its prediction errors, with a gain), rad.
        at_rest: whether a window begins at rest: velocities as guessed, not fitted; shape (windows,).
        finer: what finer plant steps than the experiment's add to the simulated positions, over the noise
            (:mod:`.plant_steps`), shape (windows, samples, sides).
        rows: of the log that the windows begin with, shape (windows,).
        gain: of the predictor (:func:`jaxbl.chain.plant_trajectory`) of each side, shape (2,);
            None: free runs, output error.
    """

    torque: np.ndarray
    measured: dict[str, np.ndarray]
    time: np.ndarray
    start: PlantState
    noise: dict[str, float]
    at_rest: np.ndarray
    finer: np.ndarray
    rows: np.ndarray
    gain: dict[str, np.ndarray] | None = None

    def only(self, places: np.ndarray | slice) -> "Windows":
        """Some of the windows."""
        # by NumPy: without a compiled program for each length
        columns = jax.tree.map(lambda leaf: np.asarray(leaf)[places] if np.ndim(leaf) else leaf, replace(self, gain=None))
        return replace(columns, gain=self.gain)

    def some(self, most: int) -> "Windows":
        """At most so many of the windows, spread over the record."""
        count = len(self.time)
        return self.only(np.linspace(0, count - 1, min(count, most)).astype(int))


class Fit(NamedTuple):
    """Result of a fit from one start.

    Attributes:
        theta: shape (parameters,).
        start: initial state of each window, leaves of shape (windows,).
        residual: measured minus simulated position over the noise, shape (windows, samples, sides).
        jacobian: its derivative by theta, what initial states could explain projected out;
            shape (windows, samples, sides, parameters).
        converged: whether the solver met its tolerance.
    """

    theta: np.ndarray
    start: PlantState
    residual: np.ndarray
    jacobian: np.ndarray
    converged: bool

    @property
    @np.errstate(over="ignore")
    def cost(self) -> float:
        """Half the sum of squared residuals."""
        return 0.5 * float(np.sum(self.residual**2))


def simulate_windows(experiment: Experiment, windows: Windows, start: PlantState) -> PlantState:
    """Simulate windows from some initial states; states at the samples, leaves of shape (windows, samples)."""
    return simulate_plants(experiment, start, windows.torque, windows.time, windows.measured, windows.gain)


def positions_over_noise(experiment: Experiment, windows: Windows, positions: Mapping[str, Any]) -> np.ndarray:
    """Positions of the sides over the noise, shape (windows, samples, sides)."""
    return np.stack([positions[side] / windows.noise[side] for side in experiment.sides], axis=-1)


def _differentiate(
    experiment: Experiment, free: Sequence[FreeParameter], theta: np.ndarray, windows: Windows, states: PlantState
) -> np.ndarray:
    """Derivative of the residuals by theta and the initial states, shape (windows, samples, sides, parameters + states)."""
    runs, samples = windows.torque.shape
    most = max(_AT_ONCE // samples, 1)
    if runs > most:
        parts = [slice(first, first + most) for first in range(0, runs, most)]
        pieces = [(windows.only(part), jax.tree.map(lambda leaf, part=part: leaf[part], states)) for part in parts]
        return np.concatenate([_differentiate(experiment, free, theta, *piece) for piece in pieces])
    shape, count = jax.tree.structure(states), len(jax.tree.leaves(states))
    ways = [Direction(numbers={number.path: float(number.slope(x))}) for number, x in zip(free, theta, strict=False)]
    ways += [Direction(state=row) for row in np.eye(count).tolist()]
    time = windows.time[:, None] + float(experiment.run.sample_period) * np.arange(samples)
    readings: Any = windows.measured
    flat = jax.tree.map(np.ravel, correct_by_readings(states, readings, windows.gain or {}))
    changes, _ = step_derivatives(experiment, flat, np.ravel(windows.torque), time.ravel(), ways)
    steps = changes.reshape(len(ways), count, runs, samples).transpose(3, 2, 1, 0)
    places: Any = shape.unflatten(range(count))
    feedback = np.eye(count)
    for side, gain in (windows.gain or {}).items():
        feedback[[places.position[side], places.velocity[side]], places.position[side]] -= gain
    by_state = steps[..., len(free) :] @ feedback
    rows = [places.position[side] for side in experiment.sides]
    slopes = np.empty((samples, runs, len(rows), len(ways)))
    reached = np.zeros((runs, count, len(ways)))
    reached[:, :, len(free) :] = np.eye(count)
    for i in range(samples):
        slopes[i] = reached[:, rows]
        reached = by_state[i] @ reached
        reached[:, :, : len(free)] += steps[i, :, :, : len(free)]
    noise = np.array([windows.noise[side] for side in experiment.sides])
    return -slopes.transpose(1, 0, 2, 3) / noise[:, None]


class Starts(NamedTuple):
    """Windows of a model from the initial states that suit them best.

    Attributes:
        residual: from there over the noise, shape (windows, samples, sides).
        slope: its derivative by the initial states that are fitted, 0 by others; shape (windows, samples, sides, states).
        states: along the windows, leaves of shape (windows, samples).
    """

    residual: np.ndarray
    slope: np.ndarray
    states: PlantState


def seek_starts(
    experiment: Experiment,
    windows: Windows,
    passes: int,
    at_rest: bool,
    fitted_samples: int | None = None,
    known_before: np.ndarray | bool = False,
) -> Starts:
    """Seek the initial states of windows by damped Gauss-Newton.

    The best of all states tried counts: at a hard gap, or where dry friction holds, a full step often makes things worse.

    Args:
        experiment: with as many plant steps in a sample as it needs.
        windows: with a guess.
        passes: initial states that are tried for a window at most.
        at_rest: whether standstill is one of them.
        fitted_samples: of a window that they are fitted to; all if left out.
        known_before: whether what was before a window is known, so that an effect's state follows; shape (windows,).
    """
    leaves, shape = jax.tree.flatten(windows.start)
    places: Any = shape.unflatten(range(len(leaves)))
    (runs, samples), count = windows.torque.shape, len(leaves)
    best = np.stack([np.broadcast_to(leaf, runs) for leaf in leaves], axis=1).astype(float)
    moving = [places.velocity[side] for side in experiment.sides]
    still, fitted = best.copy(), np.ones(best.shape, bool)
    still[:, moving] = 0.0
    fitted[:, moving] = ~windows.at_rest[:, None]
    for effect, state in zip(experiment.effects, places.effects, strict=True):
        # others follow from numbers that are still to be fitted
        is_known = effect.state_from_input | (known_before & effect.state_from_measurement)
        fitted[:, jax.tree.leaves(state)] = ~np.reshape(is_known, (-1, 1))
    residual = np.zeros((runs, samples, len(moving)))
    slope, states = np.zeros((*residual.shape, count)), np.zeros((count, runs, samples))
    following, going = best.copy(), np.ones(runs, bool)
    damping, cost = np.full(runs, RIDGE), np.full(runs, np.inf)
    for i in range(passes):
        if at_rest and i == passes // 2 + 1:
            # from there nothing leads back: a side that friction holds does not feel a little velocity
            following, damping, going = still, np.full(runs, RIDGE), np.ones(runs, bool)
        indices = np.flatnonzero(going)
        if not len(indices):
            continue
        part = windows.only(indices)
        along = simulate_windows(experiment, part, shape.unflatten(list(following[indices].T)))
        measured, simulated = (positions_over_noise(experiment, part, x) for x in (part.measured, along.position))
        value = measured - simulated - part.finer
        squares = np.sum(value[:, :fitted_samples] ** 2, axis=(1, 2))
        better = (squares < cost[indices]) | ~np.isfinite(cost[indices])
        damping[indices] *= np.where(better, 0.01, 30.0)
        damping[indices] = np.maximum(damping[indices], np.where(better, RIDGE, 1e-2))
        new, along = indices[better], jax.tree.map(lambda leaf, better=better: leaf[better], along)
        if len(new):
            best[new], cost[new], residual[new] = following[new], squares[better], value[better]
            states[:, new] = jax.tree.leaves(along)
            slope[new] = _differentiate(experiment, (), np.empty(0), part.only(better), along) * fitted[new][:, None, None]
        unit, size = over_size(slope[indices][:, :fitted_samples])
        towards = unit.swapaxes(1, 2) @ residual[indices][:, :fitted_samples].reshape(len(indices), -1, 1)
        matrix = unit.swapaxes(1, 2) @ unit + damping[indices][:, None, None] * np.eye(count)
        change = np.linalg.solve(matrix, towards)
        following[indices] = best[indices] - change[:, :, 0] / size
        going[indices] = ~(np.sum(change * towards, axis=(1, 2)) <= _SETTLED * cost[indices])
    return Starts(residual, slope, shape.unflatten(list(states)))


def over_size(slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return columns of windows' initial states over their sizes, shape (windows, rows, states), and these, shape
    (windows, states): infinite for a state without influence, which stays where it is."""
    flat = slope.reshape(len(slope), -1, slope.shape[-1])
    size = np.sqrt(np.sum(flat**2, axis=1))
    size = np.where(size > INFLUENCE * np.max(size, axis=1, keepdims=True), size, np.inf)
    return flat / size[:, None], size


class Eliminated(NamedTuple):
    """Windows from the initial states that suit them.

    Attributes:
        states: along the windows, leaves of shape (windows, samples).
        basis: orthonormal, of what their initial states can explain; shape (windows, samples times sides, states).
        residual: over the noise without that, shape (windows, samples, sides).
    """

    states: PlantState
    basis: np.ndarray
    residual: np.ndarray

    @property
    def start(self) -> PlantState:
        """Initial states, leaves of shape (windows,)."""
        return jax.tree.map(lambda leaf: leaf[:, 0], self.states)


@np.errstate(all="ignore")
def eliminate_starts(experiment: Experiment, windows: Windows, passes: int = _OUTER, at_rest: bool = True) -> Eliminated:
    """Seek the initial states of windows, and a basis of what they can explain; arguments as of :func:`seek_starts`."""
    starts = seek_starts(experiment, windows, passes, at_rest)
    unit, size = over_size(starts.slope)
    # of a column of zeros the decomposition makes any direction
    basis = np.where(np.isfinite(size)[:, None], np.linalg.qr(unit)[0], 0.0)
    return Eliminated(starts.states, basis, _without(basis, starts.residual))


def _without(basis: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the part of values, shape (windows, samples, sides, ...), outside the windows' bases."""
    flat = values.reshape(*basis.shape[:2], -1)
    return (flat - basis @ (basis.swapaxes(1, 2) @ flat)).reshape(values.shape)


class _Point(NamedTuple):
    """Least squares at a theta.

    Attributes:
        theta: shape (parameters,).
        model: with these numbers.
        eliminated: the windows there.
        deviance: sum of squares, that of the prior included.
    """

    theta: np.ndarray
    model: Experiment
    eliminated: Eliminated
    deviance: float

    @property
    def squares(self) -> np.ndarray:
        """Sum of squared residuals of each window."""
        return np.sum(self.eliminated.residual**2, axis=(1, 2))


@np.errstate(all="ignore")
def fit(
    experiment: Experiment,
    free: Sequence[FreeParameter],
    windows: Windows,
    theta: np.ndarray,
    most_steps: int = 100,
    rounds: int = 3,
) -> Fit:
    """Fit from one start.

    A weak pull to the nominal values (a factor of e^3 each) keeps what a record does not show from running away.

    Args:
        experiment: with array leaves; its sample period is that of the record.
        free: what is fitted.
        windows: the record.
        theta: the start, shape (parameters,); zeros are the nominal values.
        most_steps: of each descent.
        rounds: descents at most, again where initial states sought anew are better ones; one is not followed by a search.
    """
    precision, count = np.full(len(theta), PRIOR_DEVIATION**-2.0), windows.torque.size * len(windows.measured)
    # through zero, so that what is 0 is found without bias
    unbounded = [number._replace(minimum=None) for number in free]

    def evaluate(theta: np.ndarray, start: PlantState, passes: int = _INNER, at_rest: bool = False) -> _Point:
        model = set_free_parameters(experiment, unbounded, theta)
        eliminated = eliminate_starts(model, replace(windows, start=start), passes, at_rest)
        squares = float(np.sum(eliminated.residual**2) + np.sum(precision * theta**2))
        return _Point(theta, model, eliminated, squares if np.isfinite(squares) else np.inf)

    def slope(point: _Point) -> np.ndarray:
        """Kaufman's derivative of the residuals by theta, shape (windows, samples, sides, parameters)."""
        slopes = _differentiate(point.model, free, point.theta, windows, point.eliminated.states)
        return _without(point.eliminated.basis, slopes[..., : len(free)])

    best, converged = evaluate(np.asarray(theta, float), windows.start, _OUTER, True), False
    for _ in range(rounds):
        best, converged = descend(
            best,
            lambda point: linearise(point.eliminated.residual, slope(point), point.theta, precision),
            lambda point, change: evaluate(point.theta + change, point.eliminated.start),
            most_steps,
            lambda point: _ENOUGH * point.deviance / count,
        )
        if rounds == 1:
            break
        # a window's initial state may be the best of its neighbourhood only: they are sought anew, from the guess
        anew = evaluate(best.theta, windows.start, _OUTER, True)
        gains = best.squares - anew.squares
        start = jax.tree.map(partial(np.where, gains > 0.0), anew.eliminated.start, best.eliminated.start)
        best = evaluate(best.theta, start)
        if not np.any(gains > _GAINED * np.sum(best.squares) / count):
            break
    return Fit(best.theta, best.eliminated.start, best.eliminated.residual, slope(best), converged)
