"""Prediction errors: how strongly a predictor should follow the readings, where disturbances act that no model knows.

Each side's predictor is the drive's own model, corrected by the steady-state Kalman gain of a position whose velocity is
driven by white noise of density q; what is open is q h^3 / sigma^2 alone. Of all, the gain with the least prediction errors
is the one of largest likelihood, since their scale is free. The super-twisting correction (8) is no such predictor: it
brings all noise of a reading into the next prediction, and noise in a prediction biases the numbers fitted to it.
References: L. Ljung, System Identification (1999), 7.4, 7.5; Y. Bar-Shalom, X.-R. Li, T. Kirubarajan (2001), 6.5.
"""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from scipy.linalg import solve_discrete_are

from jaxbl.chain import Experiment, NamedArrays
from jaxbl.drive.effects import Numbers

from .trajectory import Windows, eliminate_starts

_COARSE = 10.0 ** np.arange(-12.0, 1.0)
"""Smoothness q h^3 / sigma^2 tried for all sides alike, from a free run to following every reading."""
_FINE = 10.0 ** np.arange(-2.0, 2.1, 0.5)
"""Factors on it tried for each side."""
_MOST_WINDOWS = 40
"""Windows, spread over the record, that the choice is made on: which bounds its time."""


@cache
def kalman_gain(smoothness: float, period: float) -> np.ndarray:
    """Steady-state gain on position (1) and velocity (1/s) for a smoothness q h^3 / sigma^2; shape (2,)."""
    f = np.array([[1.0, 1.0], [0.0, 1.0]])
    q = smoothness * np.array([[1.0 / 3.0, 0.5], [0.5, 1.0]])
    covariance = solve_discrete_are(f.T, np.array([[1.0], [0.0]]), q, np.eye(1))
    return covariance[:, 0] / (covariance[0, 0] + 1.0) * np.array([1.0, 1.0 / period])


def _sizes(experiment: Experiment, windows: Windows, gain: NamedArrays) -> np.ndarray:
    """Rms prediction error of each side in rad under a gain."""
    residual = eliminate_starts(experiment, replace(windows, gain=gain)).residual
    return np.array([windows.noise[side] for side in experiment.sides]) * np.sqrt(np.mean(residual**2, axis=(0, 1)))


def predictor(experiment: Experiment, windows: Windows) -> tuple[Windows, Numbers]:
    """The windows with the gain whose prediction errors are least, and their size as noise; each side's q h^3 / sigma^2."""
    period = float(experiment.run.sample_period)
    count = len(windows.time)
    # of an earlier choice
    windows = replace(windows, gain=None)
    few = windows.only(np.unique(np.linspace(0, count - 1, min(count, _MOST_WINDOWS)).astype(int)))

    def gains_of(smoothness: Numbers) -> dict[str, Any]:
        return {side: kalman_gain(value, period) for side, value in smoothness.items()}

    def best(candidates: list[Numbers]) -> Numbers:
        sizes = np.array([_sizes(experiment, few, gains_of(smoothness)) for smoothness in candidates])
        with np.errstate(divide="ignore"):
            total = np.sum(np.log(sizes), axis=1)
        return candidates[int(np.argmin(np.where(np.isfinite(total), total, np.inf)))]

    chosen = best([dict.fromkeys(experiment.sides, float(x)) for x in _COARSE])
    for side in experiment.sides:
        chosen = best([chosen | {side: float(chosen[side] * x)} for x in _FINE])
    gain = gains_of(chosen)
    size = _sizes(experiment, windows, gain)
    return replace(windows, gain=gain, noise=dict(zip(experiment.sides, size, strict=True))), chosen
