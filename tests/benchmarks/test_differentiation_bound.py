"""The best possible error of a differentiator: linear program, closed form and a brute force over quotients agree."""

import math

import numpy as np
import pytest
from differentiation_bound import (
    adaptive_quotient,
    best_samples,
    difference_error,
    least_exact_error,
    least_worst_error,
    worst_signal,
)

from jaxbl.errors import InputError

CASES = [(1e-5, 8.0, 1e-3), (0.0, 8.0, 1e-3), (1.0, 1.0, 1.0), (3e-4, 2.0, 2e-3), (1e-6, 100.0, 1e-4), (0.2, 1.0, 1.0)]


@pytest.mark.parametrize(("noise", "slope", "period"), CASES)
def test_the_linear_program_agrees_with_the_closed_form_and_its_signal_is_admitted(noise, slope, period):
    samples = 2 * best_samples(noise, slope, period) + 5
    worst = worst_signal(noise, slope, period, samples)
    assert worst.error == pytest.approx(least_worst_error(noise, slope, period), rel=1e-7)
    assert np.abs(worst.signal).max() <= noise + 1e-9 * slope * period**2
    assert np.abs(worst.acceleration).max() <= slope * (1.0 + 1e-9)
    # the signal's values are those that its own second derivative makes
    velocity, value, values = worst.error, worst.signal[0], [worst.signal[0]]
    for acceleration in worst.acceleration:
        value += -period * velocity + 0.5 * period**2 * acceleration
        velocity -= period * acceleration
        values.append(value)
    np.testing.assert_allclose(values, worst.signal, atol=1e-9 * (noise + slope * period**2))


@pytest.mark.parametrize(("noise", "slope", "period"), CASES)
def test_no_quotient_is_better_and_the_best_one_reaches_it(noise, slope, period):
    errors = [difference_error(noise, slope, period, i) for i in range(1, 400)]
    assert least_worst_error(noise, slope, period) == pytest.approx(min(errors), rel=1e-12)
    assert errors[best_samples(noise, slope, period) - 1] == pytest.approx(min(errors), rel=1e-12)


def test_a_short_history_costs_accuracy():
    noise, slope, period = 1e-3, 1.0, 1e-3
    for samples in (1, 5, 30):
        expected = least_worst_error(noise, slope, period, most=samples)
        assert worst_signal(noise, slope, period, samples).error == pytest.approx(expected, rel=1e-7)
        assert expected > least_worst_error(noise, slope, period)


def test_limits():
    assert least_worst_error(0.0, 8.0, 1e-3) == pytest.approx(4e-3)  # L T / 2
    assert least_worst_error(1e-4, 4.0) == pytest.approx(2.0 * math.sqrt(4e-4))
    # 4 N / (L T^2) = i^2: the continuous bound at a window of i periods
    assert least_worst_error(1e-4, 4.0, 1e-4) == pytest.approx(least_worst_error(1e-4, 4.0))
    assert least_exact_error(1e-4, 4.0) == pytest.approx(math.sqrt(2.0) * least_worst_error(1e-4, 4.0))
    # sampled ones lose L T / 2 less, and without noise nothing
    assert least_exact_error(1e-4, 4.0, 1e-6) == pytest.approx(least_exact_error(1e-4, 4.0), rel=1e-3)
    assert least_exact_error(0.0, 8.0, 1e-3) == pytest.approx(4e-3)
    assert worst_signal(0.0, 0.0, 1e-3, 5).error == 0.0
    assert least_worst_error(1.0, 0.0, 1e-3, most=4) == pytest.approx(2.0 / 4e-3)


def climb_errors(noise, samples, starts=200):
    """Largest error of the adaptive quotient (T = L = 1) found by changes of single values of noise and f''.

    From random signs, and from the pair of signals behind the bound, one of which is the reading and the other one true.
    """
    rng = np.random.default_rng(0)
    choice = rng.choice([-1.0, 1.0], (starts, 2 * samples + 1))
    pair = worst_signal(noise, 2.0, 1.0, samples)
    choice[::2, :samples] = 0.5 * pair.acceleration
    choice[::2, samples:] = -(pair.signal - pair.signal[0]) / max(noise, 1e-300) - 1.0
    choice = np.clip(choice, -1.0, 1.0)
    periods = np.arange(samples + 1)
    weights = np.maximum(periods[:, None] - np.arange(samples)[None, :] - 0.5, 0.0)

    def errors(choice):
        # f(0) = f'(0) = 0
        readings = choice[:, :samples] @ weights.T + noise * choice[:, samples:]
        return np.abs(adaptive_quotient(readings, 1.0, 1.0))

    best = errors(choice)
    for j in [*rng.permutation(2 * samples + 1)] * 4:
        candidates = choice.copy()
        candidates[:, j] = np.where(rng.random(starts) < 0.5, -candidates[:, j], rng.uniform(-1.0, 1.0, starts))
        candidate_errors = errors(candidates)
        is_better = candidate_errors > best
        choice[is_better], best = candidates[is_better], np.maximum(best, candidate_errors)
    return best.max()


@pytest.mark.parametrize("noise", [0.5, 1.0, 3.0, 10.0, 40.0])
def test_the_adaptive_quotient_has_the_least_worst_error_of_those_that_know_no_noise(noise):
    """The pair of signals behind the bound makes it err by just that, and no search finds more."""
    least = least_exact_error(noise, 1.0, 1.0)
    assert least >= least_worst_error(noise, 1.0, 1.0)
    largest = climb_errors(noise, math.ceil(math.sqrt(2.0 * noise)) + 1)
    assert largest == pytest.approx(least, rel=1e-6)


def prove_bound(noise):
    """The bound proved in docs/theory_appendix.md (T = L = 1): the larger one over all noises that the readings may show."""
    periods = np.arange(1, int(4.0 * math.sqrt(noise)) + 10)
    worst = 0.0
    for shown_noise in np.linspace(0.0, noise, 1001):
        level = 0.5 * periods - 2.0 * shown_noise / periods
        m = int((level <= 0.5 + 1e-12).sum())
        share = max((0.5 - level[m - 1]) / (level[m] - level[m - 1]), 0.0)
        errors_by_period = 0.5 * periods + 2.0 * noise / periods
        direct = (1.0 - share) * errors_by_period[m - 1] + share * errors_by_period[m]
        longer = periods[m if share > 1e-12 else m - 1 :]
        worst = max(worst, min(direct, (longer + 2.0 * noise / longer).min() - 0.5))
    return worst


@pytest.mark.parametrize(
    "noise", [0.0, 0.05, 0.145, 0.25, 0.4, 0.5, 0.6, 0.7, 0.9, 1.0, 1.3, 2.0, 4.0, 10.0, 33.0, 100.0, 1000.0]
)
def test_the_proof_gives_the_bound(noise):
    ratio = prove_bound(noise) / least_exact_error(noise, 1.0, 1.0)
    assert 1.0 - 1e-9 <= ratio <= (1.21 if 0.0 < noise < 0.5 else 1.0 + 1e-9)


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.145, 0.2, 0.4])
def test_the_adaptive_quotient_under_little_noise(noise):
    ratio = climb_errors(noise, 4) / least_exact_error(noise, 1.0, 1.0)
    assert ratio <= (1.21 if noise else 1.0 + 1e-12)
    # every noise that it takes for granted is there
    assert ratio >= 0.999


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_the_adaptive_quotient_scales_with_units_and_takes_many_rows(dtype):
    rng = np.random.default_rng(1)
    rows = rng.normal(size=(3, 4, 20)).astype(dtype)
    plain = adaptive_quotient(rows, 1.0, 1.0)
    assert plain.shape == (3, 4)
    other = adaptive_quotient(dtype(1e-4) * rows, 100.0, 1e-3)
    np.testing.assert_allclose(other, 0.1 * plain, rtol=1e-10 if dtype == np.float64 else 1e-3)
    np.testing.assert_allclose(adaptive_quotient(rows + dtype(2.0), 1.0, 1.0), plain, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    "call",
    [
        lambda: least_worst_error(-1.0, 1.0),
        lambda: least_worst_error(1.0, math.inf),
        lambda: worst_signal(1.0, 1.0, 0.0, 5),
        lambda: worst_signal(1.0, 1.0, 1.0, 0),
        lambda: best_samples(1.0, 0.0, 1.0),
        lambda: adaptive_quotient(np.zeros(5), 0.0, 1.0),
        lambda: adaptive_quotient(np.zeros(1), 1.0, 1.0),
    ],
)
def test_wrong_bounds_are_input_errors(call):
    with pytest.raises(InputError, match=r"^(noise|slope|period|samples|readings):"):
        call()
