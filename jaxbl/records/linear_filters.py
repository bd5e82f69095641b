"""Filters. `scipy.signal` is imported where it is used: a command that reads no log need not wait for it.

Reference: A. Savitzky, M. J. E. Golay, Smoothing and differentiation of data, Anal. Chem. 36 (1964).
"""

from collections.abc import Sequence

import numpy as np


def filter_forwards(values: np.ndarray, numerator: Sequence[float], denominator: Sequence[float]) -> np.ndarray:
    """Filter by y_k = b_0 x_k + b_1 x_{k-1} + ... - a_1 y_{k-1} - ..., as if the first value had always been there.

    Args:
        values: x, shape (samples,) or (samples, signals).
        numerator, denominator: b_0, b_1, ... and a_1, a_2, ...; a steady value passes unchanged.
    """
    from scipy.signal import lfilter

    # the deviation from the first value starts from rest
    return lfilter(numerator, [1.0, *denominator], values - values[0], axis=0) + values[0]


def savitzky_golay_slopes(values: np.ndarray, half_width: int) -> np.ndarray:
    """Return the slope a sample of the cubic fitted to `half_width` samples on each side, shape (samples,).

    The slopes within `half_width` samples of an end are wrong.
    """
    from scipy.signal import savgol_filter

    # a cubic's slope does not change with a constant, which would cost digits
    return np.asarray(savgol_filter(values - values[0], 2 * half_width + 1, 3, deriv=1, mode="nearest"))
