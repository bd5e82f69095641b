"""Prediction errors that are not white: their spectrum, and what columns are worth beside it.

A predictor knows white noise of the torque and of the readings alone. Where something swings that no effect accounts for,
its errors are correlated, and what is small but steady is worth more, or less, than their variance says. By Whittle's
likelihood, each frequency counts by the power that is left there.
Reference: P. Whittle, Estimation and information in stationary time series, Arkiv foer Matematik 2 (1953).
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

_BANDS, _LEAST_FREQUENCIES = 24, 12
"""Bands of a spectrum, evenly spaced in the logarithm of the frequency; frequencies in one of them."""


class Spectrum(NamedTuple):
    """Power of the errors over frequency, interpolated between bands.

    Attributes:
        frequency: middle of each band, cycles a sample.
        power: variance of a sample, if it were so at all frequencies, by side; rad^2, shape (bands, sides).
    """

    frequency: np.ndarray
    power: np.ndarray

    def at(self, samples: int) -> np.ndarray:
        """Power at the frequencies of that many samples, shape (frequencies, sides)."""
        where = np.log(np.maximum(np.fft.rfftfreq(samples), 0.5 / samples))
        bands = np.log(self.frequency)
        return np.exp(np.stack([np.interp(where, bands, np.log(power)) for power in self.power.T], axis=1))


def spectrum_of(errors: Sequence[np.ndarray]) -> Spectrum:
    """Spectrum of errors, part by part, each of shape (samples, sides)."""
    powers = [np.abs(_transform(part)) ** 2 for part in errors]
    weights = [_weights(len(part)) for part in errors]
    frequency = np.concatenate([np.fft.rfftfreq(len(part)) for part in errors])
    order = np.argsort(frequency, kind="stable")
    frequency, power, weight = frequency[order], np.concatenate(powers)[order], np.concatenate(weights)[order]
    edges = _edges(len(frequency))
    bands = [slice(low, high) for low, high in itertools.pairwise(edges)]
    # parts have a frequency 0 each
    middle = np.maximum([np.mean(frequency[band]) for band in bands], 1e-9)
    level = np.stack([np.average(power[band], axis=0, weights=weight[band]) for band in bands])
    return Spectrum(middle, np.maximum(level, 1e-300))


def weighted_products(errors: np.ndarray, spectrum: Spectrum) -> np.ndarray:
    """Products of columns of errors, shape (samples, sides, columns), with one another, each frequency over its power in the
    spectrum of what they leave; shape (columns, columns)."""
    products = np.zeros((errors.shape[2], errors.shape[2]))
    size = np.sqrt(_weights(len(errors))[:, None] / spectrum.at(len(errors)))
    for side in range(errors.shape[1]):
        transformed = _transform(errors[:, side]) * size[:, side, None]
        products += np.real(transformed.conj().T @ transformed)
    return products


def _transform(errors: np.ndarray) -> np.ndarray:
    return np.fft.rfft(errors, axis=0) / np.sqrt(len(errors))


def _weights(samples: int) -> np.ndarray:
    """Weight of each frequency: all but the first, and the last of an even number, stand for two."""
    weights = np.full(samples // 2 + 1, 2.0)
    weights[0] = 1.0
    if samples % 2 == 0:
        weights[-1] = 1.0
    return weights


def _edges(count: int) -> list[int]:
    """Edges of bands of growing width, none of fewer frequencies than :data:`_LEAST_FREQUENCIES` if there are as many."""
    edges = [0]
    for edge in np.round(np.geomspace(_LEAST_FREQUENCIES, count, _BANDS)).astype(int):
        if edge - edges[-1] >= _LEAST_FREQUENCIES:
            edges.append(int(edge))
    if len(edges) == 1:
        return [0, count]
    edges[-1] = count
    return edges
