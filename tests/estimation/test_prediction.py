"""The predictor's gain against SciPy's solution of the Riccati equation, and prediction errors where a disturbance acts."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from small_study import rigid_study
from trace_segment import cut

from jaxbl.config import prepare, read_config
from jaxbl.drive.plant import PlantState
from jaxbl.estimation.free_parameters import make_free_parameters
from jaxbl.estimation.intervals import spread
from jaxbl.estimation.prediction import kalman_gain, predictor
from jaxbl.estimation.smoother import smooth
from jaxbl.estimation.trajectory import fit

PERIOD, SAMPLES = 2e-3, 3000


@pytest.mark.parametrize("smoothness", [1e-10, 1e-4, 1.0, 100.0])
def test_gain_is_that_of_a_filter_that_has_run_long(smoothness):
    f = np.array([[1.0, 1.0], [0.0, 1.0]])
    q = smoothness * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
    p = solve_discrete_are(f.T, np.array([[1.0], [0.0]]), q, np.eye(1))
    gain = p[:, 0] / (p[0, 0] + 1.0)
    np.testing.assert_allclose(kalman_gain(smoothness, 0.1), gain * [1.0, 10.0], rtol=1e-6)


def simulate_disturbed_mass(force, seed=0):
    """A mass with viscous friction under a multisine and white random force (N²s), by exact discretisation."""
    random = np.random.default_rng(seed)
    mass, friction = 0.05, 0.15
    t = PERIOD * np.arange(SAMPLES)
    torque = 0.2 * sum(np.sin(2.0 * np.pi * f * t + i) for i, f in enumerate((0.3, 0.9, 2.7)))
    decay = np.exp(-friction / mass * PERIOD)
    moved = mass / friction * (1.0 - decay)
    # of the state by white force, to the order of the period that matters
    noise = np.linalg.cholesky(force / mass**2 * np.array([[PERIOD**3 / 3, PERIOD**2 / 2], [PERIOD**2 / 2, PERIOD]]))
    x, states = np.zeros(2), np.zeros((SAMPLES, 2))
    for i in range(SAMPLES):
        states[i] = x
        x = np.array([
            x[0] + moved * x[1] + torque[i] / friction * (PERIOD - moved),
            decay * x[1] + torque[i] / friction * (1.0 - decay),
        ]) + noise @ random.standard_normal(2)  # fmt: skip
    return torque, states, {"motor": states[:, 0] + 1e-4 * random.standard_normal(SAMPLES)}


def prepare_mass():
    experiment = prepare(read_config(rigid_study({"run.sample_period": PERIOD, "run.substeps": 1})))
    return experiment, make_free_parameters(experiment, ["drive.motor_inertia", "drive.motor_viscous"], 1.0)


def fit_numbers(experiment, free, windows):
    return fit(experiment, free, windows, np.zeros(2))


def cut_windows(torque, readings, samples):
    smoothed = smooth(jnp.asarray(readings["motor"]), PERIOD)
    start = PlantState({"motor": smoothed.state[:, 0]}, {"motor": smoothed.velocity}, ())
    return cut(torque, readings, PERIOD, start, {"motor": 1e-4}, samples)


def test_with_a_disturbance_prediction_errors_tell_more_than_free_runs():
    experiment, free = prepare_mass()
    errors, widths = {"free": [], "predicted": []}, {"free": [], "predicted": []}
    force = 1e-4
    for seed in range(8):
        torque, _, readings = simulate_disturbed_mass(force, seed)
        windows = cut_windows(torque, readings, 500)
        predicted, smoothness = predictor(experiment, windows)
        np.testing.assert_allclose(smoothness["motor"], force / 0.05**2 * PERIOD**3 / 1e-8, rtol=9.0)
        for name, fitted_windows in (("free", windows), ("predicted", predicted)):
            result = fit_numbers(experiment, free, fitted_windows)
            errors[name].append(result.theta)
            widths[name].append(np.sqrt(np.diag(spread(result).covariance)))
    size = {name: np.sqrt(np.mean(np.square(values), axis=0)) for name, values in errors.items()}
    assert np.all(size["predicted"] < 0.7 * size["free"]), size
    # errors are about as large as they say
    np.testing.assert_allclose(size["predicted"], np.mean(widths["predicted"], axis=0), rtol=0.7)


def test_without_a_disturbance_the_predictor_runs_freely():
    experiment, free = prepare_mass()
    torque, _, readings = simulate_disturbed_mass(1e-14)
    windows = cut_windows(torque, readings, 500)
    predicted, smoothness = predictor(experiment, windows)
    assert smoothness["motor"] < 1e-9
    assert float(predicted.noise["motor"]) == pytest.approx(1e-4, rel=0.05)
    result = fit_numbers(experiment, free, predicted)
    np.testing.assert_allclose(result.theta, 0.0, atol=0.005)
