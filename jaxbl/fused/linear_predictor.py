"""Errors of a linear predictor along many columns at once, by a loop for this machine's processor: columns are its lanes.

    d_{k+1} = A_k (d_k + K e_k) + w_k,   e_k = y_k - C d_k,

with d the change of a state whose first numbers are read (C), y the readings in the first column (0 in all others), and w
what drives each column.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxbl.workers import map_in_threads

from . import Arrays, Leaves
from .signal_scan import compile_signal_loop

_NEGLIGIBLE = 1e-60
"""Size below which a change counts as zero: it is added and taken away again, so that what decays becomes 0. Processors take
many times as long for numbers below 1e-308, which squares are from 1e-154 on."""


class LinearPredictor(NamedTuple):
    """The recursion above, for a number of states, of sides that are read, and of columns."""

    states: int
    sides: int
    width: int

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
        states, sides, count = self.states, self.sides, len(transition)
        loop = compile_signal_loop(_predict_sample, 2 * sides, states, states**2, states + sides, self.width == 1)
        # filled here, once for all gains
        width = loop.whole_vectors(self.width)
        padding = (0, width - self.width)
        lane_inputs = np.zeros((states + sides, count, width))
        lane_inputs[:states, :, : self.width] = forcing
        lane_inputs[states:, :, 0] = readings.T
        inputs = {"sample_inputs": np.ascontiguousarray(transition.reshape(count, -1).T), "lane_inputs": lane_inputs}

        def predict(change: np.ndarray, gain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            # positions first, then velocities
            values = np.repeat(np.transpose(gain).reshape(-1, 1), width, axis=1)
            carry = np.pad(change, ((0, 0), padding))
            carry, errors, _ = loop.run(count, width, values=values, carry=carry, **inputs)
            return np.asarray(carry)[:, : self.width], np.asarray(errors)[:, :, : self.width]

        predictions = [predict(changes[0], gains[0])] if len(gains) == 1 else map_in_threads(predict, changes, gains)
        return [change for change, _ in predictions], [errors for _, errors in predictions]


def _predict_sample(gains: Leaves, change: Leaves, inputs: Leaves) -> tuple[Leaves, Leaves]:
    """One sample of the recursion. Inputs are the transition's rows, the forcing, and the readings."""
    states, sides = len(change), len(gains) // 2
    transition, forcing, readings = inputs[: states**2], inputs[states**2 : -sides], inputs[-sides:]
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
