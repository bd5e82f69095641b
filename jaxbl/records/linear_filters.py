"""Filters and spectra as `scipy.signal` has them, whose import alone takes a second of processor time.

References: A. V. Oppenheim, R. W. Schafer, Discrete-Time Signal Processing (2010), 7.2 (bilinear transform), 7.5 (windows);
F. Gustafsson, Determining the initial states in forward-backward filtering, IEEE Trans. Signal Process. 44 (1996);
A. Savitzky, M. J. E. Golay, Smoothing and differentiation of data, Anal. Chem. 36 (1964);
P. D. Welch, The use of fast Fourier transform for the estimation of power spectra, IEEE Trans. Audio 15 (1967).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np


def filter_forwards(values: np.ndarray, numerator: Sequence[float], denominator: Sequence[float]) -> np.ndarray:
    """Values behind y_k = b_0 x_k + b_1 x_{k-1} + ... - a_1 y_{k-1} - a_2 y_{k-2} - ..., as if the first value had always
    been there.

    Args:
        values: x, shape (samples,) or (samples, signals).
        numerator, denominator: b_0, b_1, ... and a_1, a_2, ...; a steady value passes unchanged.
    """
    steady, count = values[0], len(values)
    # only what differs from the first value starts from rest
    away = np.asarray(values - steady, float)
    driven = numerator[0] * away
    for lag, factor in enumerate(numerator[1:], 1):
        driven[lag:] += factor * away[:-lag]
    # a triangular system of equations with as many diagonals as y has lags
    bands = np.ones((len(denominator) + 1, count), order="F")
    bands[1:] = np.asarray(denominator)[:, None]
    columns = driven.reshape(count, -1).T
    # here, as a study that reads no log need not wait for it
    from scipy.linalg import blas

    solve: Any = blas.dtbsv  # pyright: ignore[reportAttributeAccessIssue]
    solved = [solve(len(denominator), bands, np.ascontiguousarray(one), lower=1, diag=1) for one in columns]
    return np.stack(solved, axis=1).reshape(driven.shape) + steady


def butterworth_coefficients(cutoff: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Low-pass of second order for :func:`filter_forwards`; cutoff in half sampling rates."""
    warped = np.tan(0.5 * np.pi * cutoff)
    whole = 1.0 + np.sqrt(2.0) * warped + warped**2
    first = float(warped**2 / whole)
    return (first, 2.0 * first, first), (
        float(2.0 * (warped**2 - 1.0) / whole),
        float((1.0 - np.sqrt(2.0) * warped + warped**2) / whole),
    )


def filter_both_ways(
    values: np.ndarray, numerator: Sequence[float], denominator: Sequence[float], padding: int
) -> np.ndarray:
    """Values behind a filter forwards and then backwards, without delay; before either end they go on for so many samples as
    their own image, turned about the end."""
    ends = 2.0 * values[0] - values[padding:0:-1], 2.0 * values[-1] - values[-2 : -padding - 2 : -1]
    longer = np.concatenate([ends[0], values, ends[1]]) if padding else values
    there = filter_forwards(longer, numerator, denominator)
    back = filter_forwards(there[::-1], numerator, denominator)[::-1]
    return back[padding : len(back) - padding]


def welch_spectrum(values: np.ndarray, length: int) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (cycles a sample) and one-sided power spectral density of values: mean over pieces of a length that
    overlap by half, each without its mean and under a Hann window."""
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length)
    pieces = np.lib.stride_tricks.sliding_window_view(values, length)[:: length - length // 2]
    pieces = pieces - np.mean(pieces, axis=1, keepdims=True)
    density = np.mean(np.abs(np.fft.rfft(pieces * window, axis=1)) ** 2, axis=0) / np.sum(window**2)
    # frequencies other than 0 and half the sampling rate have a negative twin
    density[1 : len(density) - (length % 2 == 0)] *= 2.0
    return np.fft.rfftfreq(length), density


def savitzky_golay_slopes(values: np.ndarray, half: int) -> np.ndarray:
    """Slope, a sample, of the cubic that fits best the values up to so many samples to each side of each one, shape
    (samples,); those nearer to an end than that are wrong."""
    at = np.arange(-half, half + 1)
    taps = np.linalg.pinv(np.vander(at / half, 4, increasing=True))[1] / half
    size = 1 << (len(values) + 2 * half).bit_length()
    # a cubic's slope does not change with a constant, which would cost digits
    product = np.fft.rfft(values - values[0], size) * np.fft.rfft(taps[::-1], size)
    return np.fft.irfft(product, size)[half : half + len(values)]


def low_pass_taps(count: int, cutoff: float) -> np.ndarray:
    """Symmetric low-pass of so many taps by a Hamming window; cutoff in half sampling rates. A steady value passes
    unchanged."""
    taps = np.sinc(cutoff * (np.arange(count) - 0.5 * (count - 1))) * np.hamming(count)
    return taps / np.sum(taps)


def parzen_window(lags: int) -> np.ndarray:
    """Parzen's window from lag 0 on, over so many lags: its spectrum is positive."""
    at = np.arange(lags)
    along = at / (lags - 0.5)
    return np.where(at <= 0.5 * (lags - 1), 1.0 - 6.0 * along**2 * (1.0 - along), 2.0 * (1.0 - along) ** 3)
