"""Standard errors against residuals of known correlation."""

import numpy as np

from jaxbl.records.least_squares import fit_with_jackknife


def test_standard_errors_hold_for_coloured_residuals():
    """Residuals that change slowly: the usual formula would be several times too small."""
    normal = []
    for seed in range(40):
        random = np.random.default_rng(seed)
        x = np.sin(0.02 * np.arange(6000) + random.uniform(0.0, 6.0))
        residual = np.convolve(random.standard_normal(6200), np.ones(60) / 60.0, mode="same")[:6000]
        estimates, errors = fit_with_jackknife(2.0 * x + residual, np.stack([x, np.ones(6000)], axis=1))
        normal.append((estimates[0] - 2.0) / errors[0])
    assert 0.6 < np.std(normal) < 1.6
    estimates, errors = fit_with_jackknife(x, np.stack([x, x], axis=1))
    assert np.isnan(estimates).all() and np.isnan(errors).all()
