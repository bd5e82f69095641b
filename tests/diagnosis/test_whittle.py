"""Spectra of noise that is known, and what columns are worth beside it."""

import numpy as np
import pytest
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter

from jaxbl.diagnosis.whittle import Spectrum, spectrum_of, weighted_products

POLE = 0.8


def correlated_noise(samples, seed):
    """First-order noise in its steady state, of one side."""
    noise = np.random.default_rng(seed).standard_normal(samples + 500)
    return lfilter([1.0], [1.0, -POLE], noise)[500:, None]


@pytest.mark.parametrize("samples", [99, 1000, 4001])
def test_the_spectrum_of_white_noise_is_flat(samples):
    found = [spectrum_of([np.random.default_rng(i).standard_normal((samples, 2))]).at(samples) for i in range(20)]
    np.testing.assert_allclose(np.mean(found, axis=0), 1.0, atol=0.25)


def test_the_spectrum_of_first_order_noise():
    actual = spectrum_of([correlated_noise(20000, 1), correlated_noise(7001, 2)])
    index = actual.at(1000)[:, 0]
    frequency = np.fft.rfftfreq(1000)
    expected = 1.0 / np.abs(1.0 - POLE * np.exp(-2j * np.pi * frequency)) ** 2
    np.testing.assert_allclose(index[2:], expected[2:], rtol=0.25)


def test_a_flat_spectrum_gives_sums_of_products():
    errors = np.random.default_rng(3).standard_normal((301, 2, 4))
    flat = spectrum_of([errors[:, :, 0]])._replace(frequency=np.array([0.1, 0.4]), power=np.array([[4.0, 9.0], [4.0, 9.0]]))
    expected = np.einsum("tsc,s,tsd->cd", errors, [0.25, 1.0 / 9.0], errors)
    np.testing.assert_allclose(weighted_products(errors, flat), expected, rtol=1e-12, atol=1e-12)


def test_products_are_those_of_generalised_least_squares():
    """Against the inverse of the noise's own covariance."""
    samples = 4000
    time = np.arange(samples)
    columns = np.stack([np.sin(0.01 * time), np.sign(np.sin(0.02 * time)), np.ones(samples)], axis=1)
    frequency = np.geomspace(1e-4, 0.5, 400)
    spectrum = Spectrum(frequency, 1.0 / np.abs(1.0 - POLE * np.exp(-2j * np.pi * frequency))[:, None] ** 2)
    covariance = POLE**time / (1.0 - POLE**2)
    expected = columns.T @ solve_toeplitz(covariance, columns)
    actual = weighted_products(columns[:, None], spectrum)
    np.testing.assert_allclose(actual, expected, rtol=0.05, atol=0.01 * expected.max())


def test_a_log_in_many_short_parts():
    result = spectrum_of([np.random.default_rng(i).standard_normal((100, 1)) for i in range(30)])
    np.testing.assert_allclose(result.at(100), 1.0, atol=0.25)
