"""The descent of all fits: Levenberg and Marquardt's."""

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

Point = TypeVar("Point", bound=Any)

_MOST_REJECTED = 8
"""Steps in a row that make a fit worse, after which no better one is expected: damping has grown 8^8 times."""
_LEAST = 1e-9
"""Damping, over the diagonal of the normal matrix, at least: above rounding."""


# far from the solution errors may be so large that their squares are not finite: no step gains there
@np.errstate(all="ignore")
def descend(
    best: Point,
    linearise: Callable[[Point], tuple[np.ndarray, np.ndarray]],
    move: Callable[[Point, np.ndarray], Point],
    most_steps: int,
    settled: Callable[[Point], float],
) -> tuple[Point, bool]:
    """Descend from a point to the least `deviance`, by steps that are damped until they gain.

    Args:
        best: where it begins; points have a `deviance`, such as a sum of squares, infinite where a model diverges.
        linearise: the normal matrix at a point and half the derivative of the deviance.
        move: the point after a change of the numbers, shape (numbers,).
        most_steps: steps that gain, at most.
        settled: gain below which a descent has ended there.

    Returns:
        The best point, and whether the descent ended by itself.
    """
    damping = 1e-3
    for _ in range(most_steps):
        if not np.isfinite(best.deviance):
            return best, False
        matrix, towards = linearise(best)
        size = np.diag(matrix) ** -0.5
        for _ in range(_MOST_REJECTED):
            following = move(best, -np.linalg.solve(matrix + damping * np.diag(size**-2.0), towards))
            gained = best.deviance - following.deviance
            if gained > 0.0:
                best, damping = following, max(0.1 * damping, _LEAST)
                break
            damping *= 8.0
        if not gained >= settled(best):
            return best, True
    return best, False


def linearise(
    residual: np.ndarray, slope: np.ndarray, numbers: np.ndarray, precision: np.ndarray, variance: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal matrix of least squares and half the derivative of their sum.

    Args:
        residual: any shape.
        slope: its derivative, shape (..., numbers).
        numbers: off the mean of their prior, shape (numbers,).
        precision: of their prior, shape (numbers,).
        variance: of a residual.
    """
    slope = slope.reshape(residual.size, len(numbers))
    towards = slope.T @ residual.ravel() / variance + precision * numbers
    return slope.T @ slope / variance + np.diag(precision), towards
