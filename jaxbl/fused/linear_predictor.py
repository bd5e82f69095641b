"""Errors of a linear predictor along many columns at once, by a loop for this machine's processor: columns are its lanes.

    d_{k+1} = A_k (d_k + K e_k) + w_k,   e_k = y_k - C d_k,

with d the change of a state whose first numbers are read (C), y the readings in the first column (0 in all others), and w
what drives each column.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import jax
import numpy as np

from jaxbl.workers import map_in_threads

from . import Arrays, Leaves, program_cache

_NUMBER = jax.ShapeDtypeStruct((), np.dtype(float))
_NEGLIGIBLE = 1e-60
"""Size below which a change counts as zero: it is added and taken away again, so that what decays becomes 0. Processors take
many times as long for numbers below 1e-308, which squares are from 1e-154 on."""


class LinearPredictor:
    """The recursion above, for a number of states, of sides that are read, and of columns."""

    def __init__(self, states: int, sides: int, width: int):
        self.states, self.sides, self.width = states, sides, width
        self.loop = _compile_loop(states, sides)
        lanes = 1 if self.loop is None else self.loop.lanes
        self.padded_width = -(-width // lanes) * lanes

    @classmethod
    @lru_cache(maxsize=256)
    def of(cls, states: int, sides: int, width: int) -> "LinearPredictor":
        """The predictor of these sizes, made once."""
        return cls(states, sides, width)

    def __call__(
        self,
        changes: Sequence[np.ndarray],
        gains: Sequence[np.ndarray],
        transition: np.ndarray,
        forcing: np.ndarray,
        readings: np.ndarray,
    ) -> tuple[Arrays, Arrays]:
        """Take columns along some samples, once for each gain.

        Args:
            changes: d at the first sample for each gain, shape (states, columns).
            gains: on position (1) and velocity (1/s) of each side, shape (sides, 2).
            transition: A, shape (samples, states, states).
            forcing: w, shape (states, samples, columns).
            readings: y of the first column, shape (samples, sides).

        Returns:
            For each gain, d after the last sample, and the errors e, shape (sides, samples, columns).
        """
        count, padding = len(transition), self.padded_width - self.width
        transition_columns = np.ascontiguousarray(transition.reshape(count, -1).T)
        padded_forcing = np.pad(forcing, ((0, 0), (0, 0), (0, padding)))
        padded_readings = np.zeros((self.sides, count, self.padded_width))
        padded_readings[:, :, 0] = readings.T

        def predict(change: np.ndarray, gain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            carry = np.pad(change, ((0, 0), (0, padding)))
            errors = np.empty((self.sides, count, self.padded_width))
            # positions first, then velocities
            ordered = [np.asarray(number, float) for number in np.ravel(np.transpose(gain))]
            if self.loop is None:
                sample, columns = _sample_function(self.states, self.sides), (padded_forcing, padded_readings)
                for i, step in enumerate(transition.reshape(count, -1)):
                    carry[:], errors[:, i] = sample([*carry.copy()], ordered, [*step], *([*rows[:, i]] for rows in columns))
            else:
                from .llvm import ArrayRows

                arrays = carry, np.array(ordered), transition_columns, padded_forcing, padded_readings, errors
                self.loop([ArrayRows(array) for array in arrays], count, self.padded_width)
            return carry[:, : self.width], errors[:, :, : self.width]

        predictions = [predict(changes[0], gains[0])] if len(gains) == 1 else map_in_threads(predict, changes, gains)
        return [change for change, _ in predictions], [errors for _, errors in predictions]


def _sample_function(states: int, sides: int) -> Any:
    """One sample of the recursion, as a function of scalars."""

    def sample(
        change: Leaves, gains: Leaves, transition: Leaves, forcing: Leaves, readings: Leaves
    ) -> tuple[Leaves, Leaves]:
        errors = [readings[i] - change[i] for i in range(sides)]
        corrected = list(change)
        for i in range(2 * sides):
            corrected[i] = corrected[i] + gains[i] * errors[i % sides]
        new = list(forcing)
        for i in range(states):
            for k in range(states):
                new[i] = new[i] + transition[i * states + k] * corrected[k]
            new[i] = (new[i] + _NEGLIGIBLE) - _NEGLIGIBLE
        return new, errors

    return sample


@program_cache.compile_once
def _compile_loop(states: int, sides: int) -> Any:
    """The recursion as a compiled loop; None if it is not supported."""
    examples = [[_NUMBER] * size for size in (states, 2 * sides, states * states, states, sides)]
    options = {"carry": states, "constants": 2 * sides, "lane_inputs": states + sides}
    return _sample_function(states, sides), examples, options
