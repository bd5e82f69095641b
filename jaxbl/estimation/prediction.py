"""Prediction errors: how strongly a predictor should follow the readings, where disturbances act that no model knows.

Each side's predictor is the drive's own model, corrected by the steady-state Kalman gain of a position whose velocity is
driven by white noise of density q; what is open is q h^3 / sigma^2 alone. Of all, the gain with the least prediction errors
is the one of largest likelihood, since their scale is free. The super-twisting correction (8) is no such predictor: it
brings all noise of a reading into the next prediction, and noise in a prediction biases the numbers fitted to it.
References: L. Ljung, System Identification (1999), 7.4, 7.5; Y. Bar-Shalom, X.-R. Li, T. Kirubarajan (2001), 6.5.
"""

from dataclasses import replace
from functools import cache

import numpy as np
from scipy.linalg import solve_discrete_are

from jaxbl.chain import Experiment
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


def _predict(experiment: Experiment, windows: Windows, smoothness: Numbers) -> Windows:
    """The windows with the gain of each side's smoothness, and the rms prediction errors under it, rad, as noise."""
    period = float(experiment.run.sample_period)
    gain = {side: kalman_gain(value, period) for side, value in smoothness.items()}
    residual = eliminate_starts(experiment, replace(windows, gain=gain)).residual
    errors = np.sqrt(np.mean(residual**2, axis=(0, 1)))
    noise = {side: windows.noise[side] * error for side, error in zip(experiment.sides, errors, strict=True)}
    return replace(windows, gain=gain, noise=noise)


def predictor(experiment: Experiment, windows: Windows) -> tuple[Windows, Numbers]:
    """The windows with the gain whose prediction errors are least, and their size as noise; each side's q h^3 / sigma^2."""
    few = windows.some(_MOST_WINDOWS)

    @np.errstate(divide="ignore")
    def measure(smoothness: Numbers) -> float:
        total = np.sum(np.log([*_predict(experiment, few, smoothness).noise.values()]))
        return total if np.isfinite(total) else np.inf

    chosen = min((dict.fromkeys(experiment.sides, float(x)) for x in _COARSE), key=measure)
    for side in experiment.sides:
        chosen = min([chosen | {side: float(chosen[side] * x)} for x in _FINE], key=measure)
    return _predict(experiment, windows, chosen), chosen
