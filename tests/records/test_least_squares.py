"""Standard errors against residuals of known correlation."""

import numpy as np
from numpy.testing import assert_allclose

from jaxbl.records.least_squares import BlockRegression, fit_with_jackknife


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


def draw_regression(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A target and three columns of very different sizes, 403 rows."""
    random = np.random.default_rng(seed)
    columns = random.standard_normal((403, 3)) * [1.0, 1e-4, 1e5]
    return columns @ [2.0, 3e3, -1e-5] + random.standard_normal(403), columns


def test_a_regression_by_blocks_is_least_squares_with_and_without_blocks():
    target, columns = draw_regression(1)
    regression = BlockRegression.of(target, columns, 7)
    rows = np.array_split(np.arange(403), 7)
    for left_out in ([], [2], [0, 5]):
        kept = np.concatenate([block for i, block in enumerate(rows) if i not in left_out])
        assert_allclose(regression.fit(left_out), np.linalg.lstsq(columns[kept], target[kept])[0], rtol=1e-7)
    without_each = regression.fit_without_each()
    errors = [np.mean((target[block] - columns[block] @ fit) ** 2) for block, fit in zip(rows, without_each, strict=True)]
    assert_allclose(regression.held_out(), errors, rtol=1e-9)
    assert_allclose(regression.errors(), np.std(without_each, axis=0) * np.sqrt(6.0), rtol=1e-9)


def test_a_known_column_is_taken_off_the_target():
    target, columns = draw_regression(2)
    expected = BlockRegression.of(target - columns[:, 0], columns[:, 1:])
    chosen = BlockRegression.of(target, columns).select([1, 2], [0])
    assert_allclose(chosen.fit(), expected.fit(), rtol=1e-9)
    assert_allclose(chosen.held_out(), expected.held_out(), rtol=1e-9)


def test_a_penalty_draws_coefficients_to_zero_and_a_column_of_zeros_has_none():
    target, columns = draw_regression(3)
    penalised = BlockRegression.of(target, columns, penalty=np.diag([1e9, 0.0, 0.0])).fit()
    assert abs(penalised[0]) < 1e-5
    columns[:, 1] = 0.0
    assert BlockRegression.of(target, columns).fit()[1] == 0.0
