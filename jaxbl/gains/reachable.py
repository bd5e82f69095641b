"""Errors of an observer that bounded noise and a bounded acceleration can cause: a search over reachable states.

The errors of all states obey equations of their own, whatever the true motion. Of those reached from rest one is kept in
each cell of a grid, the farthest out, with the choices that led to it, and each is carried on by extreme choices. Where
nothing is left to carry on, the cells are made smaller, until enough errors were kept. It needs no gradient, which a
switching observer does not have, and no horizon. What it finds is real: a lower bound of the worst case.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxbl.observer.base import AbstractObserver, ObserverState

States = Float[np.ndarray, "many size"]
"""Errors of position, velocity and what else an observer carries: the true value less the predicted one."""
Step = Callable[[States, Float[np.ndarray, " many"]], tuple[States, Float[np.ndarray, " many"]]]
"""Errors before a sample and its noise -> those before the next one without acceleration, and the estimate's error."""

_CELLS, _FINER = 1_000, 4
"""Cells at first, and how many times more with each refinement."""
_BETTER = 0.1
"""Of a cell's width: by so much an error must lie farther out to take another one's place."""
_ROOM = 1.3
"""Room for errors to grow in a new grid."""
_FLAT = 1e-6
"""Least variance along an axis of the grid, relative to the largest."""
_LANES = 4096


class Reached(NamedTuple):
    """What a search found.

    Choices lead there under the rounding of the search. An adversary who sees the errors gets there under any: where noise
    puts an innovation beside a switch, it must be the innovation that is repeated.

    Attributes:
        worst: largest velocity error.
        kept: errors that were kept.
        noise: choices of noise from rest on; the last one's sample has the worst error.
        push: which of the accelerations follows each sample.
        sign: that it has, 1 or -1; of the last sample, after the worst error, 1.
    """

    worst: float
    kept: int
    noise: Float[np.ndarray, " samples"]
    push: Int[np.ndarray, " samples"]
    sign: Float[np.ndarray, " samples"]


@jax.jit
def _stepped(observer: AbstractObserver, states: Any, noise: Any) -> Any:
    # the true motion is zero
    free, one = (lambda velocity: 0.0 * velocity), jnp.ones(())
    before = ObserverState(-states[0], -states[1], tuple(-x for x in states[2:]))
    new, estimate = observer.step(before, noise, free, one)
    return -jnp.stack([new.position, new.velocity, *new.further]), jnp.abs(estimate.velocity)


def step_of(observer: AbstractObserver) -> Step:
    """The observer's own step at a period of 1, without nominal acceleration, on errors; for use with x64 enabled.

    Of observers that carry nothing at rest: super-twisting ones and differentiators.
    """

    def step(states: States, noise: Float[np.ndarray, " many"]) -> tuple[States, Float[np.ndarray, " many"]]:
        many = len(noise)
        # batches of one size are compiled once
        padded = np.pad(np.column_stack([states, noise]).T, ((0, 0), (0, -many % _LANES)))
        parts = [_stepped(observer, part[:-1], part[-1]) for part in np.split(padded, padded.shape[1] // _LANES, axis=1)]
        new, errors = (np.concatenate(x, axis=-1)[..., :many] for x in zip(*parts, strict=True))
        return new.T, errors

    return step


class _Grid:
    """Cells over a region in coordinates in which states spread alike, and in each the number of a state."""

    def __init__(self, states: States, cells: int, room: float = 1.0):
        size = np.abs(states).max(axis=0)
        size = np.where(size > 0.0, size, 1.0)
        scaled = states / size
        spread, turn = np.linalg.eigh(scaled.T @ scaled / len(states))
        turn = turn / np.sqrt(np.maximum(spread, max(_FLAT * spread[-1], 1e-300))) / size[:, None]
        self.turn = turn / (room * np.maximum(np.abs(states @ turn).max(axis=0), 1e-9))
        self.cells, self.sides = cells, max(2, round(cells ** (1.0 / len(size))))
        self.number = np.full((self.sides + 1) ** len(size), -1)
        self.far = np.full(len(self.number), -np.inf)

    def holds(self, states: States) -> bool:
        return bool((np.abs(states @ self.turn) <= 1.0).all())

    def take(self, states: States, number: int | np.ndarray) -> Int[np.ndarray, " taken"]:
        """Which states find a place; they get these numbers, or those from this one on."""
        places = states @ self.turn
        at = np.round((0.5 * places + 0.5) * self.sides).astype(int)
        cell, far = at @ (self.sides + 1) ** np.arange(at.shape[1]), np.linalg.norm(places, axis=1)
        better = np.flatnonzero(far > self.far[cell] + 2.0 * _BETTER / self.sides)
        order = better[np.argsort(far[better], kind="stable")]
        # of several for one cell the last one stays
        self.number[cell[order]] = order
        taken = order[self.number[cell[order]] == order]
        self.far[cell[taken]] = far[taken]
        self.number[cell[taken]] = number + np.arange(len(taken)) if isinstance(number, int) else number[taken]
        return taken


def explore(
    step: Step,
    noises: Callable[[States], Float[np.ndarray, "levels many"]],
    pushes: Float[np.ndarray, "pushes size"],
    most: int = 100_000,
) -> Reached:
    """Search for the largest velocity error from rest.

    Args:
        step: of the errors; with all signs turned, it must do the same.
        noises: to try in each state.
        pushes: what extreme accelerations add to a state until the next sample; their negatives are tried, too.
        most: errors to keep.
    """
    signed, many = np.concatenate([pushes, -pushes]), len(pushes)
    states, kept = np.zeros((most, pushes.shape[1])), 1
    # number of the state before, noise, push, and whether all signs were turned after it
    tree = np.zeros((most, 4))
    grid = _Grid(states[:1], _CELLS)
    fresh, worst = grid.take(states[:1], 0), (0.0, 0, 0.0)
    while kept < most:
        if not len(fresh):
            if grid.cells * _FINER > most:
                break
            fresh = grid.number[grid.number >= 0]
            grid = _Grid(states[fresh], grid.cells * _FINER)
            grid.take(states[fresh], fresh)
        levels = noises(states[fresh])
        who, noise = np.tile(fresh, len(levels)), levels.ravel()
        new, errors = step(states[who], noise)
        k = int(errors.argmax())
        if errors[k] > worst[0]:
            worst = float(errors[k]), int(who[k]), float(noise[k])
        new = (new + signed[:, None]).reshape(-1, states.shape[1])
        # a state and its negative are one
        turned = np.where(new[:, 0] < 0.0, -1.0, 1.0)
        new *= turned[:, None]
        if not grid.holds(new):
            here = grid.number[grid.number >= 0]
            grid = _Grid(np.concatenate([states[here], new]), grid.cells, _ROOM)
            grid.take(states[here], here)
        taken = grid.take(new, kept)[: most - kept]
        fresh = np.arange(kept, kept + len(taken))
        push, before = np.divmod(taken, len(who))
        states[fresh] = new[taken]
        tree[fresh] = np.column_stack([who[before], noise[before], push, turned[taken]])
        kept += len(taken)
    way, k = [(worst[1], worst[2], 0.0, 1.0)], worst[1]
    while k:
        way.append(tuple(tree[k]))
        k = int(tree[k, 0])
    _, noise, push, turned = np.array(way[::-1]).T
    sign = np.cumprod(np.concatenate([[1.0], turned[:-1]]))
    return Reached(worst[0], kept, noise * sign, push.astype(int) % many, np.where(push < many, sign, -sign))
