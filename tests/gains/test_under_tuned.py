"""Gains that miss the exact condition, under known disturbances: against SciPy in the observer's own states, and a drive."""

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from small_study import small_study

from jaxbl.config import read_config
from jaxbl.gains.under_tuned import SINE_LIMIT, Disturbance, SineError, excursion, peak_law, simulate_error
from jaxbl.observer.conditions import least_lambda_exact
from jaxbl.sweeps.trial import run


def simulate_peaks(lambda_, alpha, disturbance, end, damping=0.0, start=(0.0, 1.0), most=10_000, least_peak=0.0):
    """Passages through x1 = 0 in the observer's own states, down to one below `least_peak`: times, and x2 with its sign."""
    time, state, simulated = 0.0, np.array(start), []
    for _ in range(most):
        sign = np.sign(state[0]) or np.sign(state[1])

        def derivatives(t, s, sign=sign):
            root = np.sqrt(max(sign * s[0], 0.0)) * sign
            return [s[1] - lambda_ * root, disturbance(t) - alpha * sign - damping * s[1]]

        def crosses_zero(t, s, sign=sign):
            return sign * s[0]

        crosses_zero.terminal, crosses_zero.direction = True, -1
        size = abs(state[1]) / alpha
        solution = solve_ivp(
            derivatives,
            (time, end),
            state,
            method="DOP853",
            events=crosses_zero,
            rtol=1e-9,
            atol=1e-19,
            first_step=min(1e-4 * size, end - time),
            max_step=0.5 * max(size, 1e-3),
        )
        if solution.status != 1:
            break
        time, state = solution.t[-1], np.array([0.0, solution.y[1, -1]])
        simulated.append((time, state[1]))
        if abs(state[1]) < least_peak:
            break
    return np.array(simulated).reshape(-1, 2).T


TIMES = np.linspace(0.0, 12.0, 6001)
SLOW_SINE = 1.5 * np.sin(TIMES)


@pytest.mark.parametrize(("lambda_", "damping"), [(0.0, 0.0), (0.0, 1.0), (0.01, 0.0), (0.005, 3.0)])
def test_law_of_peaks_under_a_slow_disturbance(lambda_, damping):
    law = peak_law(lambda_, 1.8, Disturbance(TIMES, SLOW_SINE, damping), 0.02)
    times, x2 = simulate_peaks(lambda_, 1.8, lambda t: 1.5 * np.sin(t), 2.0, damping, (0.0, 0.02), least_peak=1.8e-3)
    expected = np.interp(times, TIMES, law)
    is_compared = expected > 2e-3
    assert is_compared.sum() > 30
    np.testing.assert_allclose(np.abs(x2[is_compared]), expected[is_compared], rtol=0.02, atol=1e-4)
    # it does change
    assert expected[is_compared].min() < 0.75 * 0.02


def test_without_losses_peaks_come_back_with_the_disturbance():
    law = peak_law(0.0, 1.8, Disturbance(TIMES, SLOW_SINE, 0.0), 0.02)
    turn = np.interp(0.5 * np.pi, TIMES, law) / 0.02
    assert turn == pytest.approx((1.0 - 1.5**2 / 1.8**2) ** (1.0 / 3.0), rel=1e-5)
    assert np.interp(2.0 * np.pi, TIMES, law) == pytest.approx(0.02, rel=1e-5)


def test_the_law_at_a_disturbance_that_touches_alpha():
    law = peak_law(0.01, 1.5, Disturbance(TIMES, 1.5 * np.sin(TIMES), 1.0), 0.02)
    assert np.isfinite(law).all()
    assert (law >= 0.0).all()


def test_the_law_ends_after_a_finite_time():
    law = peak_law(0.02, 1.8, Disturbance(TIMES, 0.0 * TIMES, 1.5), 0.1)
    # V' = -V b / 3 - k
    rate = 0.25 * np.pi * 0.02 * 1.8 / np.sqrt(2.0 * 1.8)
    end = np.log1p(0.1 * 0.5 / rate) / 0.5
    assert TIMES[np.argmax(law == 0.0)] == pytest.approx(end, abs=0.01)
    simulated = simulate_error(0.02, 1.8, Disturbance(TIMES, 0.0 * TIMES, 1.5), velocity_error=0.1)
    assert simulated.end_time == pytest.approx(end, rel=0.01)


@pytest.mark.parametrize(("lambda_", "damping"), [(0.3, 0.0), (0.05, 1.0), (2.5, 0.0)])
def test_simulated_error_against_scipy_in_other_states(lambda_, damping):
    simulated = simulate_error(lambda_, 1.8, Disturbance(TIMES, SLOW_SINE, damping), velocity_error=0.5)
    times, x2 = simulate_peaks(lambda_, 1.8, lambda t: 1.5 * np.sin(t), 3.0, damping, (0.0, 0.5), most=12)
    assert simulated.largest == 0.5
    assert simulated.peaks[0] == 0.5
    count = min(len(times), len(simulated.times) - 1)
    assert (count > 3) == (lambda_ < 2.0)
    # the disturbance is linear between samples
    np.testing.assert_allclose(simulated.peaks[1 : count + 1], np.abs(x2[:count]), rtol=2e-4)
    np.testing.assert_allclose(simulated.times[1 : count + 1], times[:count], rtol=2e-4)


def test_simulated_error_from_a_position_error():
    simulated = simulate_error(0.3, 1.8, Disturbance(TIMES, SLOW_SINE), position_error=-0.2, velocity_error=0.1)
    times, x2 = simulate_peaks(0.3, 1.8, lambda t: 1.5 * np.sin(t), 3.0, 0.0, (-0.2, 0.1), most=3)
    np.testing.assert_allclose(simulated.peaks[:3], np.abs(x2), rtol=2e-4)
    np.testing.assert_allclose(simulated.times[:3], times, rtol=2e-4)


def test_excursion_of_a_pulse():
    times = np.linspace(0.0, 3.0, 3001)
    pulse = np.where((times > 0.9995) & (times < 1.5005), 2.2, 0.5)
    # edges of a sample's length
    assert excursion(2.0, Disturbance(times, pulse, 0.0)) == pytest.approx(0.2 * 0.5, rel=2e-3)
    assert excursion(2.0, Disturbance(times, -pulse, 1.5)) == pytest.approx(0.2 / 1.5 * -np.expm1(-0.75), rel=2e-3)
    assert excursion(2.3, Disturbance(times, pulse, 0.0)) == 0.0
    sine = 2.0 * np.sin(2.0 * times)
    area, _ = quad(lambda t: max(2.0 * np.sin(2.0 * t) - 1.7, 0.0), 0.0, 1.5, points=[0.5 * np.arcsin(0.85)])
    assert excursion(1.7, Disturbance(times, sine, 0.0)) == pytest.approx(area, rel=1e-4)


@pytest.mark.parametrize(("lambda_", "damping"), [(1.24, 0.0), (1.24, 3.0), (3.0, 0.0)])
def test_excursions_where_the_error_settles_between_pulses(lambda_, damping):
    times = np.linspace(0.0, 12.5, 12501)
    disturbance = Disturbance(times, 1.2 * np.sin(1.005 * times) + 0.4 * np.sin(2.7 * times + 1.0), damping)
    simulated = simulate_error(lambda_, 1.3, disturbance, velocity_error=0.0)
    assert simulated.largest == pytest.approx(excursion(1.3, disturbance), rel=1e-4)


CYCLES = [(1.15, 0.3, 0.0), (5.0, 0.1, 0.0), (1.8, 0.01, 0.3)]


@pytest.mark.parametrize(("alpha", "lambda_", "damping"), CYCLES)
def test_limit_cycle_under_a_sine(alpha, lambda_, damping):
    frequency = 0.5 / np.pi
    error = SineError(lambda_, alpha, 1.0, damping)
    predicted, simulated = error.predict_cycle(frequency), error.simulate_cycle(frequency)
    assert predicted.stable == pytest.approx(simulated.stable, rel=0.06)
    assert predicted.threshold == pytest.approx(simulated.threshold, rel=0.12)
    assert 0.0 < simulated.threshold < simulated.stable
    # errors that begin near it come to it
    _, x2 = simulate_peaks(lambda_, alpha, lambda t: -np.sin(t), 500.0, damping, (0.0, 0.95 * simulated.stable), most=150)
    assert np.abs(np.abs(x2[:4]) / simulated.stable - 1.0).max() > 0.01
    np.testing.assert_allclose(np.abs(x2[-4:]), simulated.stable, rtol=1e-3)


@pytest.mark.parametrize("alpha", [1.15, 10.0])
def test_a_sine_upholds_a_cycle_up_to_a_lambda_below_the_exact_one(alpha):
    limit = SINE_LIMIT / np.sqrt(alpha)
    assert round(SINE_LIMIT, 3) == 0.73
    assert limit < float(least_lambda_exact(alpha, 1.0))
    frequency = 0.5 / np.pi
    assert SineError(1.01 * limit, alpha, 1.0).predict_cycle(frequency) is None
    assert SineError(1.01 * limit, alpha, 1.0).simulate_cycle(frequency) is None
    assert SineError(0.99 * limit, alpha, 1.0).predict_cycle(frequency) is not None
    # without approximation the limit is at most 5 % larger: beyond that errors of any phase go to zero
    phase = np.pi - np.arcsin(0.9)
    start = 0.0, SineError(0.9 * limit, alpha, 1.0).predict_cycle(frequency).stable
    _, lasting = simulate_peaks(0.9 * limit, alpha, lambda t: np.sin(t + phase), 500.0, 0.0, start, most=60)
    assert len(lasting) == 60
    assert np.abs(lasting[-4:]).min() > 0.9 * start[1]
    # cycles have peaks of about pi / 2 alpha: far below that nothing upholds an error
    largest, small = 0.5 * np.pi * alpha, 0.05 * alpha
    for phase in np.arange(3) * 2.0 * np.pi / 3.0:
        _, x2 = simulate_peaks(
            1.08 * limit, alpha, lambda t, p=phase: np.sin(t + p), 500.0, 0.0, (0.0, largest), most=200, least_peak=small
        )
        assert np.abs(x2[-1]) < small


def test_least_frequency_of_a_cycle():
    error = SineError(0.005, 1.8, 1.56, 3.0)
    least = error.predict_least_frequency()
    cycles = [error.predict_cycle(share * least) for share in (0.999, 1.001)]
    assert cycles[0] is None
    assert cycles[1] is not None
    assert SineError(0.005, 1.8, 1.56, 0.0).predict_least_frequency() == 0.0
    assert SineError(1.0, 1.8, 1.56, 3.0).predict_least_frequency() == np.inf


@pytest.mark.parametrize(("alpha", "ratio"), [(1.15, 0.757), (2.0, 0.926)])
def test_least_frequency_without_approximation(monkeypatch, alpha, ratio):
    """Below it errors of any size and phase go to zero; above it not."""
    # a hundredth is small enough: the many half cycles of smaller errors would take long
    monkeypatch.setattr("jaxbl.gains.under_tuned._ZERO_RATIO", 0.01)
    error = SineError(0.005, alpha, 1.0, 3.0)
    least = error.simulate_least_frequency()
    assert least / error.predict_least_frequency() == pytest.approx(ratio, rel=0.01)
    # ends differ by a factor of ten: no digits are needed
    monkeypatch.setattr("jaxbl.gains.under_tuned._TOLERANCE", 1e-6)

    def last_peak(frequency, phase, periods):
        """The last peak over the first one."""
        times = np.linspace(0.0, periods / frequency, round(60 * periods) + 1)
        sine = np.sin(2.0 * np.pi * frequency * times + phase)
        path = simulate_error(0.005, alpha, Disturbance(times, sine, 3.0), velocity_error=0.4 * alpha / frequency)
        return path.peaks[-1] / path.peaks[0]

    assert max(last_peak(0.95 * least, phase, 15.0) for phase in (0.0, 0.7 * np.pi, 1.4 * np.pi)) < 0.02
    assert last_peak(1.1 * least, 0.0, 8.0) > 0.2


TABLE_1 = {"motor": {"lambda": 0.005, "alpha": 1.8}, "load": {"lambda": 0.5, "alpha": 0.4}}


@pytest.mark.parametrize(("amplitude", "frequency"), [(0.9, 2.0), (0.6, 1.43)])
def test_gains_of_table_1_end_in_the_cycle_on_the_papers_drive_at_a_higher_frequency(amplitude, frequency):
    excitation = {"kind": "sine", "amplitude": amplitude, "frequency": frequency}
    timed = {"duration": 10.0, "sample_period": 1e-4}
    study = read_config(small_study(encoders={}, observer=TABLE_1, excitation=excitation, run=timed))
    trace = run(study).trace
    part = trace[trace["t"] >= 10.0 - 8.0 / frequency]
    velocity, acceleration, torque = (part[name].to_numpy() for name in ("motor.velocity", "motor.acceleration", "u"))
    missing = acceleration - (torque - 0.15 * velocity) / 0.05
    # alpha covers all of it
    assert np.abs(missing).max() < 1.8
    turns = np.exp(-2j * np.pi * frequency * part["t"].to_numpy())
    simulated = SineError(0.005, 1.8, 2.0 * abs(np.mean(missing * turns)), 3.0).simulate_cycle(frequency)
    error = np.abs(velocity - part["motor.velocity_estimate"].to_numpy()).max()
    assert error == pytest.approx(simulated.stable, rel=0.02)
