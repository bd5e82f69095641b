"""Errors of two models beside one another, block by block of a log."""

import numpy as np

from .reference_log import BLOCKS, Comparison, ReferenceLog
from .thresholds import LIMITS

QUARTERS = 4
"""Parts of a log that numbers are fitted without, one after the other: four blocks, as much as is held out. In a row they
would part a chirp's slow motion from its fast one, and neither foretells the other."""


def standard_errors_better(log: ReferenceLog, control: Comparison, model: Comparison) -> float:
    """Count the standard errors by which a model beats a control, block by block, each channel over its noise.

    All channels together, by the mean of their logarithms, or the channel that shows the difference best if none says
    otherwise: a ripple is seen in the torque, and hardly in windows of the position. Torques are referred to the input: a
    model that multiplies all of them, and the input, by one factor misses the same.
    """
    pair = (control, model)
    # of fewer samples than blocks nothing can be said
    channels = [
        name for name, errors in control.samples.items() if not name.startswith("velocity") and errors.size >= BLOCKS
    ]
    scales = [{name: comparison.gain if name.startswith("torque") else 1.0 for name in channels} for comparison in pair]
    floors = [log.noise_floor(comparison.torques) for comparison in pair]
    noise = {name: np.sqrt(np.prod([floors[i][name] / scales[i][name] for i in range(2)])) for name in channels}
    costs = [
        np.array([mean_squares(comparison.samples[name], scale[name] * noise[name]) for name in channels])
        for comparison, scale in zip(pair, scales, strict=True)
    ]
    together = standard_errors_between(*costs)
    by_channel = [standard_errors_between(*channel) for channel in zip(*costs, strict=True)]
    return max(together, *by_channel) if -min(by_channel) < LIMITS.difference < max(by_channel) else together


def mean_squares(errors: np.ndarray, noise: float | np.ndarray) -> np.ndarray:
    """Mean squared errors over their noise, by blocks; errors in the order of time, shape (samples, ...)."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.array([np.mean(block) for block in np.array_split(np.square(errors / noise).ravel(), BLOCKS)])


def standard_errors_between(control: np.ndarray, model: np.ndarray) -> float:
    """Count the standard errors by which squared errors of a model over their noise, block by block, are below those of a
    control; shapes (..., blocks), in front channels.

    By logarithms, since a few blocks may have most of the errors, of noise and errors together: what is less than the noise
    counts for nothing, as on a drive that stands still. What structure in the noise may bring is no gain.
    """
    if not (np.isfinite(control).all() and np.isfinite(model).all()):
        return -np.inf if np.isfinite(control).all() else np.inf
    gains = np.mean(np.atleast_2d(np.log1p(control) - np.log1p(model)), axis=0)
    return float(np.mean(gains) / np.hypot(np.std(gains, ddof=1) / np.sqrt(BLOCKS), 2.0 * LIMITS.noise_structure))
