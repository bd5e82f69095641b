"""Gain conditions against the design's table, quadrature, and independent simulations of the error system (34)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad, solve_ivp

from jaxbl.observer import conditions

# alpha / f: least lambda / sqrt(f) by the exact condition, (32) with q -> 0, Seeber and Horn
TABLE = {
    1.1: (0.991, 9.39, 1.449),
    1.5: (0.780, 5.00, 1.581),
    2.0: (0.656, 4.24, 1.732),
    5.0: (0.404, 4.24, 2.449),
}


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("ratio", TABLE)
def test_table_of_the_design(ratio, dtype):
    alpha, one = jnp.asarray(ratio, dtype), jnp.asarray(1.0, dtype)
    exact, davila_fridman, seeber_horn = TABLE[ratio]
    np.testing.assert_allclose(conditions.least_lambda_exact(alpha, one), exact, atol=6e-4)
    np.testing.assert_allclose(conditions.least_lambda_davila_fridman(alpha, one), davila_fridman, atol=6e-3)
    np.testing.assert_allclose(conditions.least_lambda_seeber_horn(alpha, one), seeber_horn, atol=6e-4)


def test_davila_fridman_grows_with_q():
    least = conditions.least_lambda_davila_fridman
    np.testing.assert_allclose(least(2.0, 1.0, 0.5), 3.0 * least(2.0, 1.0))


def test_levants_usual_gains_converge():
    np.testing.assert_allclose(conditions.peak_ratio(1.5, 1.1, 1.0), 0.54, atol=5e-3)


def ratio_by_quadrature(lambda_, alpha, f_plus):
    c1, c2 = 2.0 * (alpha - f_plus), 2.0 * (alpha + f_plus)
    # p = tan(a): the integrals over a finite range
    first = quad(lambda a: 1.0 / (np.sin(a) ** 2 + lambda_ * np.sin(a) * np.cos(a) + c1 * np.cos(a) ** 2), 0.0, np.pi / 2)
    second = quad(lambda a: 1.0 / (np.sin(a) ** 2 - lambda_ * np.sin(a) * np.cos(a) + c2 * np.cos(a) ** 2), 0.0, np.pi / 2)
    return np.sqrt(c2 / c1) * np.exp(-0.5 * lambda_ * (first[0] + second[0]))


def ratio_by_simulation(lambda_, alpha, f_plus):
    """Follow (34) from (0, 1) with the disturbance that pushes outwards, in the observer's own states, to the next peak."""

    def speed(x, velocity):
        return velocity - lambda_ * np.sqrt(max(x, 0.0))

    def right(disturbance):
        return lambda t, s: [speed(*s), disturbance - alpha]

    def turns(t, s):
        return speed(*s)

    def returns(t, s):
        return s[0]

    turns.terminal = returns.terminal = True
    turns.direction = returns.direction = -1
    settings = {"method": "DOP853", "rtol": 1e-10, "atol": 1e-14}
    out = solve_ivp(right(f_plus), (0.0, 100.0), [0.0, 1.0], events=turns, **settings)
    back = solve_ivp(right(-f_plus), (0.0, 100.0), out.y[:, -1], events=returns, **settings)
    return -back.y[1, -1]


# complex and real roots of the first quadrant, below and above the boundary of convergence
CASES = [
    (1.5, 1.1, 1.0),
    (0.7, 1.5, 1.0),
    (2.0, 1.6, 1.0),
    (0.3, 5.0, 1.0),
    (1.2, 1.2, 1.0),
    (3.0, 9.0, 4.0),
    (0.2, 0.3, 0.0),
]


@pytest.mark.parametrize("case", CASES)
def test_peak_ratio_is_that_of_quadrature_and_of_the_simulated_worst_case(case):
    closed = conditions.peak_ratio(*case)
    np.testing.assert_allclose(closed, ratio_by_quadrature(*case), rtol=1e-10)
    np.testing.assert_allclose(closed, ratio_by_simulation(*case), rtol=1e-3)


# compiled once for the many cases below
RATIO, BOUND = jax.jit(conditions.peak_ratio), jax.jit(conditions.convergence_time_bound)
LEAST = {name: jax.jit(least) for name, (_, least) in conditions.CONDITIONS.items()}
POSITIVE = st.floats(0.1, 10.0)


@settings(deadline=None, max_examples=50)
@given(lambda_=POSITIVE, ratio=st.floats(1.01, 10.0), f_plus=POSITIVE, scale=st.floats(1e-3, 1e3))
def test_homogeneous(lambda_, ratio, f_plus, scale):
    alpha, root = ratio * f_plus, np.sqrt(scale)
    rho = RATIO(lambda_, alpha, f_plus)
    np.testing.assert_allclose(RATIO(root * lambda_, scale * alpha, scale * f_plus), rho, rtol=1e-8, atol=1e-300)
    for least in LEAST.values():
        np.testing.assert_allclose(least(scale * alpha, scale * f_plus), root * least(alpha, f_plus), rtol=1e-9)
    np.testing.assert_allclose(
        # lengths in rad and times in s: lambda^2, alpha and f all go with the length
        BOUND(root * 40.0, scale * alpha, scale * f_plus, scale * 0.3, scale * 0.7),
        BOUND(40.0, alpha, f_plus, 0.3, 0.7),
        rtol=1e-9,
    )


@settings(deadline=None, max_examples=50)
@given(ratio=st.floats(1.001, 50.0), f_plus=POSITIVE)
def test_least_lambda_exact_is_where_the_ratio_is_one(ratio, f_plus):
    least = LEAST["exact"](ratio * f_plus, f_plus)
    np.testing.assert_allclose(RATIO(least, ratio * f_plus, f_plus), 1.0, rtol=1e-9)


@pytest.mark.parametrize("alpha", [0.0, 0.5, 1.0])
def test_no_lambda_is_enough_where_alpha_is_not(alpha):
    for _, least in conditions.CONDITIONS.values():
        assert least(alpha, 1.0) == jnp.inf
    assert conditions.peak_ratio(5.0, alpha, 1.0) == jnp.inf
    assert conditions.convergence_time_bound(5.0, alpha, 1.0, 0.1, 0.1) == jnp.inf


@pytest.mark.parametrize(("dtype", "tolerance"), [(jnp.float32, 2e-6), (jnp.float64, 1e-10)])
def test_continuous_across_the_double_root(dtype, tolerance):
    """At lambda^2 = 4 c1 the formula changes branch twice, about a series."""
    alpha, f_plus = 1.3, 1.0
    double = 2.0 * np.sqrt(2.0 * (alpha - f_plus))
    steps = np.concatenate([s * np.logspace(-9, -1, 60) for s in (-1.0, 1.0)])
    lambdas = (double * (1.0 + np.sort(steps))).astype(dtype)
    alpha, f_plus = (np.asarray(x, dtype) for x in (alpha, f_plus))
    found = jax.vmap(conditions.peak_ratio, (0, None, None))(lambdas, alpha, f_plus)
    true = [ratio_by_quadrature(*(float(x) for x in (lambda_, alpha, f_plus))) for lambda_ in lambdas]
    np.testing.assert_allclose(found, true, rtol=tolerance)


@pytest.mark.parametrize("case", [(1.5, 1.1, 1.0), (0.7, 1.5, 1.0), (9.0, 1.5, 1.0), (1.0, 0.5, 1.0)])
def test_derivatives_are_finite_on_every_branch(case):
    gradient = np.asarray(jax.grad(conditions.peak_ratio, (0, 1, 2))(*case))
    assert np.all(np.isfinite(gradient))
    if case[1] > case[2]:
        change = [(conditions.peak_ratio(*(case + d)) - conditions.peak_ratio(*(case - d))) / 2e-6 for d in 1e-6 * np.eye(3)]
        np.testing.assert_allclose(gradient, change, rtol=1e-6, atol=1e-12)


def convergence_times(lambda_, alpha, f_plus, position, velocity, disturbance, duration, step):
    """Simulate x1' = x2 - lambda sqrt|x1| sign x1, x2' = d - alpha sign x1, for lanes of cases.

    A small step of the set-valued terms taken implicitly, so that rest at the origin is not lost. Returns the time after
    which |x2| stays below 1e-3 of its largest value.
    """
    x, v = position.copy(), velocity.copy()
    last = np.zeros_like(x)
    largest = np.abs(v) + np.sqrt(alpha * np.abs(x))
    for i in range(int(duration / step)):
        speed = v - lambda_ * np.sqrt(np.abs(x)) * np.sign(x)
        d = f_plus * disturbance(i * step, x, speed)
        b = x + step * (v + step * d)
        reach = step * step * alpha
        beyond = np.maximum(np.abs(b) - reach, 0.0)
        x = np.sign(b) * (0.5 * (-step * lambda_ + np.sqrt((step * lambda_) ** 2 + 4.0 * beyond))) ** 2
        v = v + step * d - np.clip(b, -reach, reach) / step
        last = np.where(np.abs(v) > 1e-3 * largest, (i + 1) * step, last)
    return last


def random_switching(seed):
    phase = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, 40)
    rate = np.random.default_rng(seed + 1).uniform(0.5, 30.0, 40)
    return lambda t, x, speed: np.sign(np.sin(rate * t + phase))


@pytest.mark.parametrize(
    "disturbance",
    [
        lambda t, x, speed: np.sign(speed),
        lambda t, x, speed: np.sign(x),
        lambda t, x, speed: np.ones_like(x),
        random_switching(3),
    ],
    ids=["adversarial", "holding", "constant", "random"],
)
def test_convergence_time_stays_below_the_bound_where_32_holds(disturbance):
    random = np.random.default_rng(7)
    f_plus = np.ones(40)
    alpha = random.uniform(1.2, 5.0, 40)
    lambda_ = np.asarray(conditions.least_lambda_davila_fridman(alpha, f_plus)) * np.exp(
        random.uniform(np.log(1.02), np.log(30.0), 40)
    )
    position, velocity = random.uniform(-0.5, 0.5, 40), random.uniform(-1.0, 1.0, 40)
    position[:15] = 0.0
    velocity[15:20] = 0.0
    bound = np.asarray(conditions.convergence_time_bound(lambda_, alpha, f_plus, position, velocity))
    assert np.all(np.isfinite(bound))
    times = convergence_times(lambda_, alpha, f_plus, position, velocity, disturbance, 12.0, 5e-4)
    assert np.all(times < 11.0)
    # a thousandth of slack for the simulation's own step
    assert np.all(times <= bound * 1.001 + 1e-3)


def test_bound_is_infinite_where_32_fails():
    assert conditions.convergence_time_bound(4.2, 2.0, 1.0, 0.0, 1.0) == jnp.inf
    assert conditions.convergence_time_bound(4.3, 2.0, 1.0, 0.0, 1.0) < jnp.inf
