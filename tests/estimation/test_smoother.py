import inspect

import numpy as np
import pytest

from jaxbl.estimation.smoother import smooth, smoothed_accelerations
from jaxbl.fused import signal_scan
from jaxbl.fused.compiled_loop import ScannedLoop

PERIOD, NOISE, JERK = 2e-3, 1e-4, 3e3
F = np.array([[1.0, PERIOD, 0.5 * PERIOD**2], [0.0, 1.0, PERIOD], [0.0, 0.0, 1.0]])
Q = JERK * np.array(
    [
        [PERIOD**5 / 20, PERIOD**4 / 8, PERIOD**3 / 6],
        [PERIOD**4 / 8, PERIOD**3 / 3, PERIOD**2 / 2],
        [PERIOD**3 / 6, PERIOD**2 / 2, PERIOD],
    ]
)


def simulate_motion(seed, samples):
    """A motion under white jerk, and its readings."""
    random = np.random.default_rng(seed)
    steps = random.standard_normal((samples, 3)) @ np.linalg.cholesky(Q).T
    state = np.zeros((samples, 3))
    for i in range(1, samples):
        state[i] = F @ state[i - 1] + steps[i]
    return state, state[:, 0] + NOISE * random.standard_normal(samples)


def smooth_by_least_squares(readings):
    """Smooth by one least-squares problem over all states, without a filter."""
    samples = len(readings)
    size = np.array([1.0, 1.0 / PERIOD, 1.0 / PERIOD**2]) * NOISE
    root = np.linalg.inv(np.linalg.cholesky(Q))
    rows = np.zeros((4 * samples - 3, 3 * samples))
    right = np.zeros(4 * samples - 3)
    for i in range(samples):
        rows[i, 3 * i] = 1.0 / NOISE
        right[i] = readings[i] / NOISE
    for i in range(1, samples):
        index = samples + 3 * (i - 1)
        rows[index : index + 3, 3 * i : 3 * i + 3] = root
        rows[index : index + 3, 3 * i - 3 : 3 * i] = -root @ F
    rows = rows * np.tile(size, samples)
    triangle = np.linalg.qr(rows, mode="r")
    solution = np.linalg.lstsq(rows, right, rcond=None)[0].reshape(samples, 3) * size
    inverse = np.linalg.inv(triangle)
    covariance = (inverse @ inverse.T).reshape(samples, 3, samples, 3)
    return solution, np.stack([covariance[i, :, i] * np.outer(size, size) for i in range(samples)])


def test_agrees_with_least_squares_over_all_states():
    _, readings = simulate_motion(1, 120)
    result = smooth(readings, PERIOD, noise_and_jerk=(NOISE, JERK))
    state, covariance = smooth_by_least_squares(readings)
    deviation = np.sqrt(np.einsum("tii->ti", covariance))
    # a hundredth of the backward filter's information counts twice at the first sample
    assert np.abs((result.state - state) / deviation).max() < 0.02
    assert np.abs((result.state - state) / deviation)[40:].max() < 1e-4
    np.testing.assert_allclose(np.sqrt(np.einsum("tii->ti", result.covariance)), deviation, rtol=0.01)
    np.testing.assert_allclose(np.einsum("tii->ti", result.covariance)[40:], deviation[40:] ** 2, rtol=1e-4)
    outer = np.outer(deviation[60], deviation[60])
    np.testing.assert_allclose(result.covariance[60] / outer, covariance[60] / outer, atol=1e-4)


def predict_one_ahead(readings, noise, jerk):
    """Prediction errors of a Kalman filter over their standard deviations."""
    state, covariance, errors = np.array([readings[0], 0.0, 0.0]), np.diag([noise**2, 1.0, 1e3]), []
    for reading in readings[1:]:
        state, covariance = F @ state, F @ covariance @ F.T + jerk / JERK * Q
        error, variance = reading - state[0], covariance[0, 0] + noise**2
        gain = covariance[:, 0] / variance
        state, covariance = state + gain * error, covariance - np.outer(gain, covariance[0])
        errors.append(error / np.sqrt(variance))
    return np.array(errors)


def test_finds_noise_and_jerk_and_knows_its_errors():
    state, readings = simulate_motion(2, 6000)
    result = smooth(readings, PERIOD)
    white = predict_one_ahead(readings, float(result.noise), float(result.jerk))[100:]
    assert abs(np.mean(white[1:] * white[:-1])) < 0.05
    assert np.mean(white**2) == pytest.approx(1.0, abs=0.06)
    assert float(result.noise) == pytest.approx(NOISE, rel=0.05)
    assert float(result.jerk) == pytest.approx(JERK, rel=0.5)
    for order in range(3):
        errors = (np.asarray(result.state)[:, order] - state[:, order]) / np.asarray(result.deviation(order))
        assert 0.85 < np.sqrt(np.mean(errors**2)) < 1.15


@pytest.mark.parametrize("noise", [1e-8, 1e-5])
def test_covariance_stays_positive_where_readings_are_fine(noise):
    t = PERIOD * np.arange(2000)
    result = smooth(np.sin(5.0 * t) + noise * np.random.default_rng(0).standard_normal(2000), PERIOD)
    assert np.all(
        np.linalg.eigvalsh(np.asarray(result.covariance) / np.asarray(result.covariance).max(axis=(1, 2), keepdims=True))
        > -1e-12
    )
    assert np.all(np.asarray(result.deviation(2)) > 0.0)
    errors = np.asarray(result.velocity) - 5.0 * np.cos(5.0 * t)
    # a sine is smoother than white jerk
    assert 0.1 < np.sqrt(np.mean((errors / np.asarray(result.deviation(1))) ** 2)) < 1.3


def test_units_and_offsets_do_not_matter():
    _, readings = simulate_motion(3, 400)
    result = smooth(readings, PERIOD)
    other = smooth(7.0 + 1e3 * readings, PERIOD)
    np.testing.assert_allclose(
        other.velocity, 1e3 * result.velocity, rtol=1e-6, atol=1e-6 * 1e3 * np.abs(result.velocity).max()
    )
    np.testing.assert_allclose(other.deviation(1), 1e3 * result.deviation(1), rtol=1e-5)


def test_quantised_readings():
    t = PERIOD * np.arange(3000)
    step = 1e-3
    readings = step * np.round(np.stack([np.sin(4.0 * t), np.cos(3.0 * t)]) / step)
    smoothed_readings = [smooth(reading, PERIOD) for reading in readings]
    np.testing.assert_allclose([reading.noise for reading in smoothed_readings], step / np.sqrt(12.0), rtol=0.2)
    assert np.sqrt(np.mean((smoothed_readings[0].velocity - 4.0 * np.cos(4.0 * t)) ** 2)) < 0.02


@pytest.mark.parametrize(("columns", "machine_code"), [(1, True), (3, True), (21, True), (3, False)])
def test_channels_side_by_side_are_those_one_by_one(columns, machine_code, monkeypatch):
    if not machine_code:
        define = inspect.unwrap(signal_scan.compile_signal_loop)

        def scanned_loop(*sizes):
            return ScannedLoop(*define(*sizes)[:2])

        monkeypatch.setattr(signal_scan, "compile_signal_loop", scanned_loop)
    readings = np.stack([(1.0 + seed) * simulate_motion(seed, 300)[1] for seed in range(columns)], axis=1)
    result = smoothed_accelerations(readings, PERIOD, (NOISE, JERK))
    for channel, position in zip(result.T, readings.T, strict=True):
        alone = smooth(position, PERIOD, noise_and_jerk=(NOISE, JERK)).acceleration
        np.testing.assert_allclose(channel, alone, rtol=1e-9, atol=1e-9 * np.max(np.abs(alone)))
