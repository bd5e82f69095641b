"""Errors of a linear predictor along many columns at once, by a loop for this machine's processor: columns are its lanes.

    d_{k+1} = A_k (d_k + K e_k) + w_k,   e_k = y_k - C d_k,

with d the change of a state whose first numbers are read (C), y what is read in the first column (0 in all others), and w
what drives each column.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import jax
import numpy as np

from jaxbl.workers import map_in_threads

from . import Unsupported, program_cache, raising_unsupported, warn_of_scan

_NUMBER = jax.ShapeDtypeStruct((), np.dtype(float))
_NOTHING = 1e-60
"""What a change has shrunk to when nothing is left of it: added and taken away again, so that what decays becomes 0.
Processors take many times as long for numbers below 1e-308, which squares are from 1e-154 on."""


class LinearPredictor:
    """The recursion for so many states, sides that are read, and columns."""

    def __init__(self, states: int, sides: int, width: int):
        self.states, self.sides, self.width = states, sides, width
        self.loop = _loop(states, sides)
        lanes = 1 if self.loop is None else self.loop.lanes
        self.whole = -(-width // lanes) * lanes

    @classmethod
    @lru_cache(maxsize=256)
    def of(cls, states: int, sides: int, width: int) -> "LinearPredictor":
        return cls(states, sides, width)

    def __call__(
        self,
        changes: Sequence[np.ndarray],
        gains: Sequence[np.ndarray],
        step: np.ndarray,
        known: np.ndarray,
        readings: np.ndarray,
    ) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Take columns along some samples, once for each gain.

        Args:
            changes: where each begins, shape (states, columns).
            gains: on position (1) and velocity (1/s) of each side, shape (sides, 2).
            step: A, shape (samples, states, states).
            known: w, shape (states, samples, columns).
            readings: y of the first column, shape (samples, sides).

        Returns:
            Where each ends, and its errors e, shape (sides, samples, columns).
        """
        count, spare = len(step), self.whole - self.width
        steps = np.ascontiguousarray(step.reshape(count, -1).T)
        driven = np.pad(known, ((0, 0), (0, 0), (0, spare)))
        read = np.zeros((self.sides, count, self.whole))
        read[:, :, 0] = readings.T

        def one(change: np.ndarray, gain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            carry, errors = np.pad(change, ((0, 0), (0, spare))), np.empty((self.sides, count, self.whole))
            # positions first, then velocities
            gains = [np.asarray(value, float) for value in np.ravel(np.transpose(gain))]
            if self.loop is None:
                _slowly(carry, gains, step, driven, read, errors)
            else:
                from .llvm import ArrayRows

                given = carry, np.array(gains), steps, driven, read, errors
                self.loop([ArrayRows(one) for one in given], count, 0, self.whole)
            return carry[:, : self.width], errors[:, :, : self.width]

        found = [one(changes[0], gains[0])] if len(gains) == 1 else map_in_threads(one, changes, gains)
        return [change for change, _ in found], [errors for _, errors in found]


def _sample(states: int, sides: int) -> Any:
    """One sample of the recursion, by scalars."""

    def sample(change: list[Any], gains: list[Any], step: list[Any], known: list[Any], read: list[Any]) -> Any:
        errors, seen = [read[i] - change[i] for i in range(sides)], list(change)
        for i in range(2 * sides):
            seen[i] = seen[i] + gains[i] * errors[i % sides]
        new = list(known)
        for i in range(states):
            for k in range(states):
                new[i] = new[i] + step[i * states + k] * seen[k]
            new[i] = (new[i] + _NOTHING) - _NOTHING
        return new, errors

    return sample


@lru_cache(maxsize=64)
def _loop(states: int, sides: int) -> Any:
    key = program_cache.program_key("recursion", states, sides)
    if (found := program_cache.load(key)) is not None:
        return found
    try:
        with raising_unsupported():
            from .jaxprs import trace
            from .llvm import Loop

            sizes = states, 2 * sides, states * states, states, sides
            with jax.enable_x64(True):
                body = trace(_sample(states, sides), *([_NUMBER] * size for size in sizes))
            loop = Loop(body, np.dtype(float), carry=states, fixed=2 * sides, beside=states + sides)
            program_cache.save(key, loop)
            return loop
    except Unsupported as why:
        warn_of_scan(str(why))
        return None


def _slowly(
    change: np.ndarray, gains: Sequence[Any], step: np.ndarray, known: np.ndarray, read: np.ndarray, errors: np.ndarray
) -> None:
    """As the loop, which overwrites the change and the errors."""
    sample = _sample(len(change), len(read))
    for i in range(len(step)):
        new, errors[:, i] = sample(
            list(change.copy()), list(gains), list(step[i].ravel()), list(known[:, i]), list(read[:, i])
        )
        change[:] = new
