"""Runs of a model over windows of a log, each from the initial state that suits its first readings best."""

import dataclasses
from typing import NamedTuple

import jax
import numpy as np

from jaxbl.chain import Experiment
from jaxbl.drive.plant import PlantState
from jaxbl.estimation.trajectory import Windows, over_size, seek_starts

from .neutral_effects import lean

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


# of a model that diverges nothing is finite
@np.errstate(invalid="ignore", over="ignore")
def best_runs(experiment: Experiment, windows: Windows, passes: int, at_rest: bool, indices: np.ndarray) -> Run:
    """Runs from the initial states that suit the first fifth of each window best.

    Args:
        experiment: the model, at the windows' period.
        windows: without weights.
        passes: initial states that are tried for a window at most.
        at_rest: whether standstill is one of them.
        indices: of the windows that are run.
    """
    windows = jax.tree.map(np.asarray, windows)
    experiment, start = lean(experiment, windows.start)
    windows = dataclasses.replace(windows, start=start)
    # what was before a window is known where it goes on where another one ends
    steps = np.rint(np.diff(windows.time) / float(experiment.run.sample_period))
    within = np.concatenate([[False], steps == windows.torque.shape[1]]) | windows.at_rest
    windows, within = windows.only(indices), within[indices]
    if not len(within):
        states = jax.tree.map(lambda _: windows.torque, start)
        return Run(windows.finer, states, np.zeros(len(experiment.sides)))
    first = count_seen(windows.torque.shape[1])
    starts = seek_starts(experiment, windows, passes, at_rest, first, within)
    (columns, size), later = over_size(starts.slope[:, :first]), starts.slope[:, first:]
    inverse = np.linalg.pinv(np.where(np.isfinite(columns), columns, 0.0), rcond=_RANK)
    change = (inverse @ starts.residual[:, :first].reshape(len(columns), -1, 1))[:, :, 0] / size
    left = starts.residual - np.einsum("wrsn,wn->wrs", starts.slope, change)
    unit = later / size[:, None, None]
    spread = np.einsum("wrsn,wnm,wrsm->wrs", unit, inverse @ inverse.swapaxes(1, 2), unit)
    return Run(left, starts.states, np.sqrt(np.mean(spread, axis=(0, 1))))
