"""Noise of a recorded input: its size, and what is left of a known input when it is smoothed away."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from jaxbl.diagnosis.input_noise import _smooth_curve, input_jumps, smoothed_input, unfelt
from jaxbl.records.signal_quality import estimate_white_noise

PERIOD, SAMPLES = 1e-3, 8000
TIME = PERIOD * np.arange(SAMPLES)
INPUTS = {
    "sine": np.sin(2.0 * np.pi * 0.8 * TIME),
    "chirp": np.sin(2.0 * np.pi * (0.3 + 0.3 * TIME) * TIME),
    "steps": np.repeat((-1.0) ** np.arange(20) * np.linspace(0.3, 1.0, 20), SAMPLES // 20),
}


@pytest.fixture(params=INPUTS)
def true_input(request):
    return INPUTS[request.param]


@pytest.mark.parametrize("noise", [3e-3, 1e-2, 3e-2])
def test_noise_is_measured_and_smoothed_away(true_input, noise):
    noisy = true_input + noise * np.random.default_rng(1).standard_normal(SAMPLES)
    assert estimate_white_noise([noisy]) == pytest.approx(noise, rel=0.05)
    remainder = smoothed_input(noisy, estimate_white_noise([noisy])) - true_input
    assert np.sqrt(np.mean(remainder**2)) < 0.3 * noise


def test_an_input_without_noise_has_none(true_input):
    assert estimate_white_noise([true_input]) < 1e-6


def test_jumps_stay_where_they_are():
    noise = 0.01
    noisy = INPUTS["steps"] + noise * np.random.default_rng(2).standard_normal(SAMPLES)
    true = (1 + np.flatnonzero(np.abs(np.diff(INPUTS["steps"])) > 10.0 * noise)).tolist()
    assert [input_jump for input_jump in input_jumps(noisy, noise) if input_jump in true] == true
    smooth = smoothed_input(noisy, noise)
    for index in true:
        assert (
            abs(smooth[index] - INPUTS["steps"][index]) < 3.0 * noise
            and abs(smooth[index - 1] - INPUTS["steps"][index - 1]) < 3.0 * noise
        )


def test_an_input_without_jumps_is_one_curve_and_a_short_one_stays():
    noisy = INPUTS["sine"] + 0.01 * np.random.default_rng(3).standard_normal(SAMPLES)
    np.testing.assert_array_equal(smoothed_input(noisy[:3000], 0.01), _smooth_curve(noisy[:3000]))
    np.testing.assert_array_equal(smoothed_input(noisy[:5], 0.01), noisy[:5])


def test_the_smooth_curve_is_one_of_least_penalised_squares():
    """Against a dense solve, the penalty found by a search that knows the truth: as good but for a few per cent."""
    count, noise = 400, 0.02
    true = INPUTS["sine"][:count]
    noisy = true + noise * np.random.default_rng(4).standard_normal(count)
    third = np.diff(np.eye(count), n=3, axis=0)

    def score_weight(log_weight: float) -> float:
        solution = np.linalg.solve(np.eye(count) + 10.0**log_weight * third.T @ third, noisy)
        return float(np.sqrt(np.mean((solution - true) ** 2)))

    best = minimize_scalar(score_weight, bounds=(0.0, 11.0), method="bounded").fun
    assert np.sqrt(np.mean((_smooth_curve(noisy) - true) ** 2)) < 1.5 * best
    # what has no curvature is let through untouched
    line = 0.3 + 1e-3 * np.arange(count)
    np.testing.assert_allclose(_smooth_curve(line), line, atol=1e-5)


@pytest.mark.parametrize("felt", [False, True])
def test_noise_is_found_in_the_errors_under_what_is_slow(felt):
    """The torque that the model lacks is a hundred times larger; the error is known where the noise alone is there."""
    rng = np.random.default_rng(6)
    lacking = 1e-2 * np.stack(
        [np.sin(2.0 * np.pi * TIME), np.cos(4.0 * np.pi * TIME)], axis=1
    )  # whole periods of both parts
    reading = 1e-4 * rng.standard_normal((SAMPLES, 2))
    effect = np.convolve(1e-4 * rng.standard_normal(SAMPLES), [0.2, 0.5, 0.3], "same")[:, None] * np.array([1.0, 0.0])
    prediction_errors = lacking + reading + effect * (not felt)
    errors_without = prediction_errors - effect
    least_error = 1e-4 / np.sqrt(np.sum(effect**2))
    parts = slice(0, 3000), slice(3000, SAMPLES)
    share, error = unfelt([prediction_errors[part] for part in parts], [errors_without[part] for part in parts])
    assert share == pytest.approx(0.0 if felt else 1.0, abs=3.0 * error)
    # the given errors' spectrum holds the effect too, where that is not felt
    assert 0.9 < error / least_error < 1.6
