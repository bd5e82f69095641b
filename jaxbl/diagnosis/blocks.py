"""Errors of two models beside one another, block by block of a log."""

from collections.abc import Sequence

import numpy as np

from jaxbl.records.least_squares import as_normal, rms

from .reference_log import BELOW, BLOCKS, Comparison, ReferenceLog
from .thresholds import LIMITS

QUARTERS = 4
"""Parts of a log that numbers are fitted without, one after the other: four blocks, as much as is held out. In a row they
would part a chirp's slow motion from its fast one, and neither foretells the other."""


def standard_errors_better(log: ReferenceLog, control: Comparison, model: Comparison) -> float:
    """Count the standard errors by which a model beats a control, block by block, each channel over its noise, or over the
    size of both models' errors where that is more.

    All channels together, or the channel that shows the difference best if none says
    otherwise: a ripple is seen in the torque, and hardly in windows of the position. Torques are referred to the input: a
    model that multiplies all of them, and the input, by one factor misses the same.
    """
    pair = (control, model)
    # of fewer samples than blocks nothing can be said
    channels = [
        name
        for name, errors in control.samples.items()
        if not name.startswith("velocity") and BELOW not in name and errors.size >= BLOCKS
    ]
    floors = [log.noise_floor(comparison.torques) for comparison in pair]
    before, after = [], []
    for name in channels:
        scales = [comparison.gain if name.startswith("torque") else 1.0 for comparison in pair]
        noise = np.sqrt(np.prod([floor[name] / scale for floor, scale in zip(floors, scales, strict=True)]))
        errors = [comparison.samples[name].ravel() / (scale * noise) for comparison, scale in zip(pair, scales, strict=True)]
        size = np.sqrt(np.prod([max(rms(values), 1.0) for values in errors]))
        before.append(errors[0] / size)
        after.append(errors[1] / size)
    together = standard_errors_between(before, after)
    by_channel = [standard_errors_between([old], [new]) for old, new in zip(before, after, strict=True)]
    return max(together, *by_channel) if -min(by_channel) < LIMITS.difference < max(by_channel) else together


def standard_errors_between(control: Sequence[np.ndarray], model: Sequence[np.ndarray]) -> float:
    """Count the standard errors by which a model errs less than a control, by blocks of a log.

    What one model foretells otherwise than the other comes true by a share: of 1 where the model is right, 0 where the
    control is, and half of it where both err as much (H. White's errors by clusters; C. Granger, R. Ramanathan, Improved
    methods of combining forecasts, J. Forecasting 3, 1984). A block in which the two foretell the same says nothing, and
    one in which they differ much says no more than that the share is the same there. What structure in the noise may
    bring is no gain.

    Args:
        control, model: errors of each channel in the order of time, shape (samples,).
    """
    if not all(np.isfinite(errors).all() for errors in (*control, *model)):
        return -np.inf if all(np.isfinite(errors).all() for errors in control) else np.inf
    agreed, apart = np.zeros(BLOCKS), np.zeros(BLOCKS)
    for before, after in zip(control, model, strict=True):
        for i, (old, new) in enumerate(zip(*(np.array_split(x, BLOCKS) for x in (before, after)), strict=True)):
            agreed[i] += 0.5 * (np.mean(old**2) - np.mean(new**2))
            apart[i] += np.mean((old - new) ** 2)
    total = np.sum(apart)
    if not total > 0.0:
        return 0.0
    # that comes true, less a half
    share = np.sum(agreed) / total
    freedom = max(total**2 / np.sum(apart**2) - 1.0, 0.5)
    scatter = np.sqrt(np.sum((agreed - share * apart) ** 2) * (freedom + 1.0) / freedom) / total
    floor = LIMITS.noise_structure * sum(np.mean(np.square(errors)) + 1.0 for errors in model) * BLOCKS / total
    return float(as_normal(share / np.hypot(scatter, floor), freedom))
