"""The observers over rows as they come: `jaxbl.chain.step` with recorded input and positions, in blocks of one size."""

import dataclasses
from functools import partial
from operator import itemgetter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.chain import Experiment, NamedArrays, Sample, State, TracedArrays, initial_state, step
from jaxbl.fused.compilation import jit

BLOCKS = (256, 2048, 16_384)
"""Samples of a call: few for rows as they come, at 1 or 10 kHz, and many for a recording."""


@jit
def _run_block(
    experiment: Experiment, state: State, torque: jax.Array, measured: TracedArrays, count: jax.Array
) -> tuple[State, TracedArrays]:
    """Take `count` samples of a padded block. Returns the state after them, and signals of each sample."""

    def sample(state: State, inputs: tuple[Any, ...]) -> tuple[State, TracedArrays]:
        index, torque, measured = inputs
        # time matters to excitation and identifier alone
        new, signals = step(experiment, state, Sample(jnp.zeros_like(torque), input=torque, measured=measured))
        row = {"twist": jnp.asarray(signals.twist)}
        row |= {f"{side}.torque": signals.side(side).torque_estimate for side in experiment.sides}
        return jax.tree.map(lambda new, old: jnp.where(index < count, new, old), new, state), row

    return jax.lax.scan(sample, state, (jnp.arange(len(torque)), torque, measured))


class LiveChain:
    """Observers and filter of a study; the identifier works on what they give (:mod:`.window`).

    Args:
        experiment: with leaves in float64.
    """

    def __init__(self, experiment: Experiment):
        self._experiment = dataclasses.replace(experiment, identifier=None)
        self._state: State | None = None

    def take(self, torque: np.ndarray, measured: NamedArrays, restarts: bool) -> NamedArrays:
        """Take in samples.

        Args:
            torque: input, N m, shape (samples,).
            measured: positions of both sides, rad, shape (samples,).
            restarts: True if they do not continue the samples before.

        Returns:
            `twist` (rad); by side `SIDE.position` (rad), as measured, and `SIDE.torque`, the observer's transmitted torque
            (N m).
        """
        if self._state is None or restarts:
            first = {side: jnp.asarray(values[0]) for side, values in measured.items()}
            self._state = initial_state(self._experiment, first)
        blocks: list[NamedArrays] = []
        for start in range(0, len(torque), BLOCKS[-1]):
            count = min(len(torque) - start, BLOCKS[-1])
            size = next(block for block in BLOCKS if count <= block)
            part = jax.tree.map(itemgetter(slice(start, start + count)), (torque, measured))
            padded = jax.tree.map(partial(np.pad, pad_width=(0, size - count)), part)
            self._state, rows = _run_block(self._experiment, self._state, *padded, jnp.asarray(count))
            blocks.append({name: np.asarray(values)[:count] for name, values in rows.items()})
        motion = {f"{side}.position": values for side, values in measured.items()}
        return jax.tree.map(lambda *values: np.concatenate(values), *blocks) | motion

    def compile(self) -> None:
        """Compile what rows will need, before any come."""
        sides = self._experiment.sides
        for size in BLOCKS[:-1]:
            self.take(np.zeros(size), {side: np.zeros(size) for side in sides}, restarts=True)
        self._state = None
