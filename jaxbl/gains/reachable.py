"""A search over reachable states for errors of an observer that bounded noise and a bounded acceleration can cause.

The errors obey equations of their own, whatever the true motion is. Errors that are reached from rest are sorted into the
cells of a grid. Each cell stores the error that lies farthest out, with the choices that led to it. Every stored error is
continued with extreme choices. If no new errors appear, the cells are made smaller, until enough errors are stored. The
search needs no gradient, which a switching observer lacks, and no horizon. Its result is a lower bound of the worst case.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxbl.observer.base import AbstractObserver, ObserverState

States = Float[np.ndarray, "states size"]
"""Errors of position, velocity and further states of an observer: the true value less the predicted one."""
PerState = Float[np.ndarray, " states"]
"""One number for each of several states."""
Step = Callable[[States, PerState], tuple[States, PerState]]
"""Maps errors before a sample and its noise to the errors before the next sample without acceleration, and to the error of
the velocity estimate."""

_CELLS, _REFINEMENT = 1_000, 4
"""Number of cells at first, and its factor in each refinement."""
_LEAST_ADVANCE = 0.1
"""An error replaces that of its cell if it lies farther out by this part of a cell's width."""
_GRID_ROOM = 1.3
"""Factor by which errors may grow in a new grid."""
_LEAST_VARIANCE = 1e-6
"""Least variance along an axis of the grid, relative to the largest."""
_LANES = 4096


class Reached(NamedTuple):
    """The result of a search.

    The choices lead to the worst error under the rounding of the search. Where noise puts an innovation beside a switch,
    another rounding may switch otherwise: the innovation must then be repeated, not the noise.

    Attributes:
        worst: largest velocity error.
        state_count: number of stored errors.
        noise: choices of noise from rest on; the last sample has the worst error.
        push: index of the acceleration that follows each sample.
        sign: sign of this acceleration, 1 or -1; after the last sample 1.
    """

    worst: float
    state_count: int
    noise: Float[np.ndarray, " samples"]
    push: Int[np.ndarray, " samples"]
    sign: Float[np.ndarray, " samples"]


@jax.jit
def _step_errors(observer: AbstractObserver, states: Any, noise: Any) -> Any:
    # the true motion is zero
    free, period = (lambda velocity: 0.0 * velocity), jnp.ones(())
    before = ObserverState(-states[0], -states[1], tuple(-x for x in states[2:]))
    new, estimate = observer.step(before, noise, free, period)
    return -jnp.stack([new.position, new.velocity, *new.further]), jnp.abs(estimate.velocity)


def build_error_step(observer: AbstractObserver) -> Step:
    """Build the map of errors from an observer's own step at a period of 1 without nominal acceleration.

    x64 must be enabled. The observer's states must be zero at rest, as in super-twisting observers and differentiators.
    """

    def step(states: States, noise: PerState) -> tuple[States, PerState]:
        count = len(noise)
        # batches of one size are compiled once
        padded = np.pad(np.column_stack([states, noise]).T, ((0, 0), (0, -count % _LANES)))
        parts = [_step_errors(observer, part[:-1], part[-1]) for part in np.split(padded, padded.shape[1] // _LANES, axis=1)]
        new, errors = (np.concatenate(x, axis=-1)[..., :count] for x in zip(*parts, strict=True))
        return new.T, errors

    return step


class _Grid:
    """A grid of cells, each with the number of a state. Its coordinates are scaled so that states spread evenly."""

    def __init__(self, states: States, cells: int, room: float = 1.0):
        size = np.abs(states).max(axis=0)
        size = np.where(size > 0.0, size, 1.0)
        scaled = states / size
        spread, transform = np.linalg.eigh(scaled.T @ scaled / len(states))
        transform = transform / np.sqrt(np.maximum(spread, max(_LEAST_VARIANCE * spread[-1], 1e-300))) / size[:, None]
        self.transform = transform / (room * np.maximum(np.abs(states @ transform).max(axis=0), 1e-9))
        self.cells, self.sides = cells, max(2, round(cells ** (1.0 / len(size))))
        self.number = np.full((self.sides + 1) ** len(size), -1)
        self.far = np.full(len(self.number), -np.inf)

    def contains(self, states: States) -> bool:
        return bool((np.abs(states @ self.transform) <= 1.0).all())

    def claim_cells(self, states: States, numbers: int | np.ndarray) -> Int[np.ndarray, " stored"]:
        """Store the states that lie farther out than those in their cells, and return their indices.

        `numbers` are the states' numbers, or the first of consecutive ones.
        """
        coordinates = states @ self.transform
        indices = np.round((0.5 * coordinates + 0.5) * self.sides).astype(int)
        cell, far = indices @ (self.sides + 1) ** np.arange(indices.shape[1]), np.linalg.norm(coordinates, axis=1)
        farther = np.flatnonzero(far > self.far[cell] + 2.0 * _LEAST_ADVANCE / self.sides)
        order = farther[np.argsort(far[farther], kind="stable")]
        # among several states in a cell the last one, which is farthest out, stays
        self.number[cell[order]] = order
        winners = order[self.number[cell[order]] == order]
        self.far[cell[winners]] = far[winners]
        self.number[cell[winners]] = numbers + np.arange(len(winners)) if isinstance(numbers, int) else numbers[winners]
        return winners


def explore(
    step: Step,
    noises: Callable[[States], Float[np.ndarray, "levels states"]],
    pushes: Float[np.ndarray, "pushes size"],
    state_limit: int = 100_000,
) -> Reached:
    """Search for the largest velocity error from rest.

    Args:
        step: map of the errors. It must be odd: all signs reversed, the result is reversed as well.
        noises: returns the noises to try in each state.
        pushes: increments of a state by extreme accelerations within a period. Their negatives are tried as well.
        state_limit: number of errors to store.
    """
    signed_pushes, push_count = np.concatenate([pushes, -pushes]), len(pushes)
    states, state_count = np.zeros((state_limit, pushes.shape[1])), 1
    # number of the state before, noise, push, and the factor (1 or -1) applied after it
    tree = np.zeros((state_limit, 4))
    grid = _Grid(states[:1], _CELLS)
    front, worst = grid.claim_cells(states[:1], 0), (0.0, 0, 0.0)
    while state_count < state_limit:
        if not len(front):
            if grid.cells * _REFINEMENT > state_limit:
                break
            front = grid.number[grid.number >= 0]
            grid = _Grid(states[front], grid.cells * _REFINEMENT)
            grid.claim_cells(states[front], front)
        levels = noises(states[front])
        origins, noise = np.tile(front, len(levels)), levels.ravel()
        new, errors = step(states[origins], noise)
        k = int(errors.argmax())
        if errors[k] > worst[0]:
            worst = float(errors[k]), int(origins[k]), float(noise[k])
        new = (new + signed_pushes[:, None]).reshape(-1, states.shape[1])
        # a state and its negative are equivalent
        flips = np.where(new[:, 0] < 0.0, -1.0, 1.0)
        new *= flips[:, None]
        if not grid.contains(new):
            numbers = grid.number[grid.number >= 0]
            grid = _Grid(np.concatenate([states[numbers], new]), grid.cells, _GRID_ROOM)
            grid.claim_cells(states[numbers], numbers)
        new_states = grid.claim_cells(new, state_count)[: state_limit - state_count]
        front = np.arange(state_count, state_count + len(new_states))
        push, origin = np.divmod(new_states, len(origins))
        states[front] = new[new_states]
        tree[front] = np.column_stack([origins[origin], noise[origin], push, flips[new_states]])
        state_count += len(new_states)
    path, k = [(worst[1], worst[2], 0.0, 1.0)], worst[1]
    while k:
        path.append(tuple(tree[k]))
        k = int(tree[k, 0])
    _, noise, push, flips = np.array(path[::-1]).T
    sign = np.cumprod(np.concatenate([[1.0], flips[:-1]]))
    return Reached(
        worst[0], state_count, noise * sign, push.astype(int) % push_count, np.where(push < push_count, sign, -sign)
    )
