"""Filters and spectra of `scipy.signal`, whose import alone takes a second of processor time.

References: A. V. Oppenheim, R. W. Schafer, Discrete-Time Signal Processing (2010), 7.2 (bilinear transform), 7.5 (windows);
F. Gustafsson, Determining the initial states in forward-backward filtering, IEEE Trans. Signal Process. 44 (1996);
A. Savitzky, M. J. E. Golay, Smoothing and differentiation of data, Anal. Chem. 36 (1964);
P. D. Welch, The use of fast Fourier transform for the estimation of power spectra, IEEE Trans. Audio 15 (1967).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np


def filter_forwards(values: np.ndarray, numerator: Sequence[float], denominator: Sequence[float]) -> np.ndarray:
    """Filter by y_k = b_0 x_k + b_1 x_{k-1} + ... - a_1 y_{k-1} - ..., as if the first value had always been there.

    Args:
        values: x, shape (samples,) or (samples, signals).
        numerator, denominator: b_0, b_1, ... and a_1, a_2, ...; a steady value passes unchanged.
    """
    first_value, count = values[0], len(values)
    # the deviation from the first value starts from rest
    deviation = np.asarray(values - first_value, float)
    forced = numerator[0] * deviation
    for lag, factor in enumerate(numerator[1:], 1):
        forced[lag:] += factor * deviation[:-lag]
    # a triangular system of equations with as many diagonals as y has lags
    bands = np.ones((len(denominator) + 1, count), order="F")
    bands[1:] = np.asarray(denominator)[:, None]
    columns = forced.reshape(count, -1).T
    # imported here: a study that reads no log need not wait for it
    from scipy.linalg import blas

    solve: Any = blas.dtbsv  # pyright: ignore[reportAttributeAccessIssue]
    outputs = [solve(len(denominator), bands, np.ascontiguousarray(column), lower=1, diag=1) for column in columns]
    return np.stack(outputs, axis=1).reshape(forced.shape) + first_value


def butterworth_coefficients(cutoff: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return numerator and denominator of a second-order low-pass; cutoff in half sampling rates."""
    warped = np.tan(0.5 * np.pi * cutoff)
    scale = 1.0 + np.sqrt(2.0) * warped + warped**2
    gain = float(warped**2 / scale)
    return (gain, 2.0 * gain, gain), (
        float(2.0 * (warped**2 - 1.0) / scale),
        float((1.0 - np.sqrt(2.0) * warped + warped**2) / scale),
    )


def filter_both_ways(
    values: np.ndarray, numerator: Sequence[float], denominator: Sequence[float], padding: int
) -> np.ndarray:
    """Filter forwards and then backwards, without delay. Each end is extended by `padding` samples, mirrored about it."""
    extensions = 2.0 * values[0] - values[padding:0:-1], 2.0 * values[-1] - values[-2 : -padding - 2 : -1]
    extended = np.concatenate([extensions[0], values, extensions[1]]) if padding else values
    forwards = filter_forwards(extended, numerator, denominator)
    backwards = filter_forwards(forwards[::-1], numerator, denominator)[::-1]
    return backwards[padding : len(backwards) - padding]


def welch_spectrum(values: np.ndarray, length: int) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies (cycles a sample) and the one-sided power spectral density by Welch's method.

    Windows of `length` samples overlap by half; each is without its mean and under a Hann window.
    """
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length)
    windows = np.lib.stride_tricks.sliding_window_view(values, length)[:: length - length // 2]
    windows = windows - np.mean(windows, axis=1, keepdims=True)
    density = np.mean(np.abs(np.fft.rfft(windows * window, axis=1)) ** 2, axis=0) / np.sum(window**2)
    # frequencies other than 0 and half the sampling rate have a negative twin
    density[1 : len(density) - (length % 2 == 0)] *= 2.0
    return np.fft.rfftfreq(length), density


def savitzky_golay_slopes(values: np.ndarray, half_width: int) -> np.ndarray:
    """Return the slope a sample of the cubic fitted to `half_width` samples on each side, shape (samples,).

    The slopes within `half_width` samples of an end are wrong.
    """
    offsets = np.arange(-half_width, half_width + 1)
    taps = np.linalg.pinv(np.vander(offsets / half_width, 4, increasing=True))[1] / half_width
    size = 1 << (len(values) + 2 * half_width).bit_length()
    # a cubic's slope does not change with a constant, which would cost digits
    product = np.fft.rfft(values - values[0], size) * np.fft.rfft(taps[::-1], size)
    return np.fft.irfft(product, size)[half_width : half_width + len(values)]


def low_pass_taps(count: int, cutoff: float) -> np.ndarray:
    """Return `count` symmetric low-pass taps by a Hamming window; cutoff in half sampling rates. A steady value is kept."""
    taps = np.sinc(cutoff * (np.arange(count) - 0.5 * (count - 1))) * np.hamming(count)
    return taps / np.sum(taps)


def parzen_window(count: int) -> np.ndarray:
    """Return Parzen's window for lags 0 to `count` - 1; its spectrum is positive."""
    lag = np.arange(count)
    fraction = lag / (count - 0.5)
    return np.where(lag <= 0.5 * (count - 1), 1.0 - 6.0 * fraction**2 * (1.0 - fraction), 2.0 * (1.0 - fraction) ** 3)
