"""Profile-likelihood intervals: those of the covariance where the fit is quadratic, and the right ones where it is not."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from small_study import rigid_study
from trace_segment import cut

from jaxbl.config import prepare, read_config
from jaxbl.drive.parameters import set_leaves
from jaxbl.drive.plant import PlantState
from jaxbl.estimation.free_parameters import make_free_parameters
from jaxbl.estimation.intervals import interval, profile, spread
from jaxbl.estimation.trajectory import fit

PERIOD, SAMPLES, NOISE = 2e-3, 400, 1e-3


def simulate_mass(seed=0, size=0.2, drag=0.15):
    """A mass with viscous friction, exact discretisation, from a known start."""
    mass = 0.05
    t = PERIOD * np.arange(SAMPLES)
    torque = size * np.sin(2.0 * np.pi * 2.0 * t)
    decay = np.exp(-drag / mass * PERIOD)
    moved = mass / drag * (1.0 - decay)
    x, positions = np.zeros(2), np.zeros(SAMPLES)
    for i in range(SAMPLES):
        positions[i] = x[0]
        x = np.array([x[0] + moved * x[1] + torque[i] / drag * (PERIOD - moved),
                      decay * x[1] + torque[i] / drag * (1.0 - decay)])  # fmt: skip
    readings = {"motor": positions + NOISE * np.random.default_rng(seed).standard_normal(SAMPLES)}
    plant_state = PlantState({"motor": jnp.zeros(SAMPLES)}, {"motor": jnp.zeros(SAMPLES)}, ())
    return cut(torque, readings, PERIOD, plant_state, {"motor": NOISE}, SAMPLES)


def fit_numbers(paths, windows):
    experiment = prepare(read_config(rigid_study({"run.sample_period": PERIOD, "run.substeps": 1})))
    free = make_free_parameters(experiment, paths, 1.0)
    result = fit(experiment, free, windows, np.zeros(len(free)))
    return experiment, free, result


def test_where_the_fit_is_quadratic_both_intervals_agree():
    windows = simulate_mass(size=2.0)
    experiment, free, result = fit_numbers(["drive.motor_inertia", "drive.motor_viscous"], windows)
    width = spread(result)
    profiles = profile(experiment, free, windows, result, width)
    for i, number in enumerate(free):
        theta, deviation = float(result.theta[i]), float(jnp.sqrt(width.covariance[i, i]))
        low, high = interval(number, theta, deviation)
        np.testing.assert_allclose(profiles[number.path].interval, (low, high), atol=0.05 * (high - low), rtol=0.0)
        assert np.all(np.diff(profiles[number.path].values) >= 0.0)
        assert profiles[number.path].deviance.min() == 0.0


def test_the_profile_of_a_number_alone_is_that_of_its_own_fit():
    windows = simulate_mass(size=2.0)
    experiment, free, result = fit_numbers(["drive.motor_inertia"], windows)
    width = spread(result)
    low, high = interval(free[0], float(result.theta[0]), float(np.sqrt(width.covariance[0, 0])))
    (ends,) = (numbers.interval for numbers in profile(experiment, free, windows, result, width).values())
    np.testing.assert_allclose(ends, (low, high), atol=0.05 * (high - low), rtol=0.0)


def test_where_it_is_not_the_profile_follows_the_likelihood():
    """Weak excitation: the friction is hardly seen. The reference is a root of the cost with all else fitted anew."""
    windows = simulate_mass(size=0.003, seed=3)
    paths = ["drive.motor_inertia", "drive.motor_viscous"]
    experiment, free, result = fit_numbers(paths, windows)
    width = spread(result)
    ends = profile(experiment, free, windows, result, width)["drive.motor_viscous"].interval
    scale = float(width.variance) * float(width.inflation[1]) ** 2

    def excess_cost(value):
        bound = set_leaves(experiment, {paths[1]: value})
        bound_fit = fit(bound, free[:1], windows, result.theta[:1], 60)
        return 2.0 * (float(bound_fit.cost) - float(result.cost)) / scale - 3.841

    best = 0.15 * np.exp(float(result.theta[1]))
    assert ends[1] == pytest.approx(brentq(excess_cost, best, 20.0 * best, xtol=1e-6), rel=0.03)
    low = brentq(excess_cost, best * np.exp(-2.99), best, xtol=1e-6) if excess_cost(best * np.exp(-2.99)) > 0.0 else 0.0
    assert ends[0] == pytest.approx(low, rel=0.03)
    # far from symmetric: here the covariance's interval is another one
    theta, deviation = float(result.theta[1]), float(jnp.sqrt(width.covariance[1, 1]))
    wald = interval(free[1], theta, deviation)
    assert abs(wald[1] / ends[1] - 1.0) > 0.05
