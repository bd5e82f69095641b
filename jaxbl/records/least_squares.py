"""Least squares with standard errors that hold for correlated residuals."""

from collections.abc import Sequence

import numpy as np

BLOCKS = 12
"""Parts of a log, each left out in turn: enough for a standard error within 20 %, each longer than correlations last."""


def rms(values: np.ndarray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def column_rms(columns: np.ndarray) -> np.ndarray:
    """Return the root mean square of each column."""
    return np.sqrt(np.mean(columns**2, axis=0))


def scale_columns(columns: np.ndarray) -> np.ndarray:
    """Divide each column by its largest magnitude, so that least squares are well conditioned."""
    return columns / (np.abs(columns).max(axis=0) + 1e-300)


def fit_with_jackknife(target: np.ndarray, regressors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit coefficients of regressors, shape (samples, terms), by least squares.

    Returns:
        Coefficients and standard errors (delete-a-block jackknife), shape (terms,); NaN if they are not determined. The
        errors hold for residuals of any correlation in time.
    """
    scale = column_rms(regressors)
    scale[scale == 0.0] = 1.0
    scaled = regressors / scale
    _, grams, moments = sum_over_blocks(target, scaled, BLOCKS)
    gram, moment = grams.sum(axis=0), moments.sum(axis=0)
    if np.linalg.cond(gram) > 1e13:
        return np.full(len(scale), np.nan), np.full(len(scale), np.nan)
    best = np.linalg.solve(gram, moment)
    return best / scale, np.sqrt(jackknife_variance(fit_without_blocks(grams, moments))) / scale


def sum_over_blocks(
    target: np.ndarray, regressors: np.ndarray, count: int
) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Return the rows of each of `count` blocks, its normal matrix and its right-hand side."""
    blocks = np.array_split(np.arange(len(target)), count)
    grams = np.array([regressors[b].T @ regressors[b] for b in blocks])
    return blocks, grams, np.array([regressors[b].T @ target[b] for b in blocks])


def fit_without_blocks(grams: np.ndarray, moments: np.ndarray) -> list[np.ndarray]:
    """Fit the coefficients without each of the blocks of :func:`sum_over_blocks`."""
    matrices, sides = grams.sum(axis=0) - grams, moments.sum(axis=0) - moments
    return [np.linalg.lstsq(matrix, side, rcond=1e-12)[0] for matrix, side in zip(matrices, sides, strict=True)]


def jackknife_variance(without: Sequence[np.ndarray] | Sequence[float]) -> np.ndarray:
    """Return the variance of estimates, each of them without one of the blocks of a log."""
    deviations = np.array(without) - np.mean(without, axis=0)
    return (len(deviations) - 1) / len(deviations) * np.sum(deviations**2, axis=0)


def residual_mean_square(target: np.ndarray, regressors: np.ndarray) -> float:
    """Return the mean square that a fit of regressors, shape (samples, terms), leaves."""
    scaled = scale_columns(regressors)
    return float(np.mean((target - scaled @ np.linalg.lstsq(scaled, target, rcond=1e-10)[0]) ** 2))
