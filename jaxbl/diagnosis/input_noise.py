"""Noise of the channel that recorded the input, which did not act on the drive.

The model is driven by the recorded torque. Where that carries noise of its own the model shakes, and the machine did not;
fits then prefer whatever shakes less: a lag, a larger motor inertia. A recorded input is smoothed between its jumps
(penalised third differences, generalised cross-validation); its motion shows which of the two drove the machine.
References: P. Eilers, A perfect smoother, Analytical Chemistry 75 (2003); P. Craven, G. Wahba, Smoothing noisy data with
spline functions, Numerische Mathematik 31 (1979).
"""

import itertools
from collections.abc import Sequence

import numpy as np
from scipy.linalg import solveh_banded

from .whittle import spectrum_of, weighted_products

_JUMP = 5.0
"""Standard deviations of the noise that a jump must stand out by."""
_LEAST_BETWEEN_JUMPS = 8
"""Samples between two jumps that can be smoothed."""
_ORDER = 3
"""Of the differences that are penalised: what has no third difference, a parabola, stays as it is."""
_CUTOFFS = np.geomspace(0.015, 2.0, 30)
"""Corner frequencies tried, rad a sample."""


def unfelt(recorded: Sequence[np.ndarray], smooth: Sequence[np.ndarray]) -> tuple[float, float]:
    """Share of the noise of the input, in its power, that did not drive the motion, and its standard error.

    What both inputs' prediction errors differ by is what that noise does to them. It is in the errors of the recorded input
    if the drive has not felt it; each frequency counts by the power that is there, so that what the model lacks, which is
    slow, does not matter.

    Args:
        recorded, smooth: errors under the input as recorded and smoothed, part by part, rad; shape (samples, sides).
    """
    spectrum = spectrum_of(recorded)
    pairs = [np.stack([errors, errors - other], axis=2) for errors, other in zip(recorded, smooth, strict=True)]
    products = np.sum([weighted_products(pair, spectrum) for pair in pairs], axis=0)
    size = max(float(products[1, 1]), np.finfo(float).tiny)
    return float(products[0, 1]) / size, size**-0.5


def smoothed_input(torque: np.ndarray, noise: float) -> np.ndarray:
    """The input of a segment smoothed between jumps; `noise`: its standard deviation, N m."""
    smooth = torque.copy()
    ends = [0, *input_jumps(torque, noise), len(torque)]
    for first, last in itertools.pairwise(ends):
        if last - first >= _LEAST_BETWEEN_JUMPS:
            smooth[first:last] = _smooth_curve(torque[first:last])
    return smooth


def input_jumps(torque: np.ndarray, noise: float) -> list[int]:
    """First samples after jumps: differences that stand out from those beside them."""
    change = np.diff(torque)
    beside = np.pad(change, 1, mode="edge")
    beyond = np.abs(change - 0.5 * (beside[:-2] + beside[2:]))
    least = _JUMP * np.sqrt(5.0) * noise
    highest = (beyond >= np.append(beyond[1:], 0.0)) & (beyond > np.insert(beyond[:-1], 0, 0.0))
    return (1 + np.flatnonzero(highest & (beyond > least))).tolist()


def _smooth_curve(values: np.ndarray) -> np.ndarray:
    """The smooth curve that generalised cross-validation chooses."""
    count = len(values)
    # products of third differences, as lower bands
    stencil = np.diff(np.eye(_ORDER + 1), n=_ORDER, axis=0)[0]
    penalty = np.zeros((_ORDER + 1, count))
    for apart in range(_ORDER + 1):
        products = stencil[apart:] * stencil[: len(stencil) - apart]
        penalty[apart, : count - apart] = np.convolve(np.ones(count - _ORDER), products)
    frequency = np.linspace(0.0, np.pi, 4096)
    best, least = values, np.inf
    for cutoff in _CUTOFFS:
        # half of a wave of this frequency is let through
        weight = (2.0 * np.sin(0.5 * cutoff)) ** (-2.0 * _ORDER)
        matrix = weight * penalty
        matrix[0] += 1.0
        curve = solveh_banded(matrix, values, lower=True)
        freedom = np.mean(1.0 / (1.0 + weight * (2.0 * np.sin(0.5 * frequency)) ** (2 * _ORDER))) + _ORDER / count
        score = np.mean((values - curve) ** 2) / max(1.0 - freedom, 1e-3) ** 2
        if score < least:
            best, least = curve, score
    return best
