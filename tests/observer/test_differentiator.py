"""Differentiators of orders 1 to 5: their set-valued equation, exactness, no chatter, and the accuracy laws."""

from functools import partial
from math import factorial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.optimize import brentq

from jaxbl.observer import COEFFICIENTS, DIFFERENTIATORS, ObserverState
from jaxbl.observer.differentiator import solve_correction

ORDERS = sorted(DIFFERENTIATORS)


def no_acceleration(velocity):
    return 0.0 * velocity


@jax.jit
def observe_block(observer, state, measured, accelerations, h):
    """The state after a block, and for each sample the estimate and the state predicted from it."""

    def step(state, sample):
        state, estimate = observer.step(state, sample[0], lambda _: sample[1], h)
        return state, (estimate, state)

    return jax.lax.scan(step, state, (measured, accelerations))


BLOCK = 8000
"""Samples that the one program observes which all signals share: to compile it takes longer than to run it."""


def observe(observer, measured, h, acceleration=0.0, velocity=0.0, higher_states=None):
    """Estimates, and states predicted from them, along measured positions under known accelerations.

    `higher_states` are the states at the start beyond position and velocity.
    """
    dtype, count = measured.dtype, len(measured)
    higher_states = [0.0] * (observer.order - 1) if higher_states is None else higher_states
    state = ObserverState(*(np.asarray(x, dtype) for x in (measured[0], velocity)), tuple(np.asarray(higher_states, dtype)))
    length = -(-count // BLOCK) * BLOCK
    signals = (
        np.resize(np.broadcast_to(x, count).astype(dtype), length).reshape(-1, BLOCK) for x in (measured, acceleration)
    )
    blocks = []
    for signals_of_block in zip(*signals, strict=True):
        state, block_estimates = observe_block(observer, state, *signals_of_block, np.asarray(h, dtype))
        blocks.append(block_estimates)
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:count], *blocks)


@pytest.mark.parametrize(("dtype", "few"), [(np.float64, 1e-14), (np.float32, 5e-6)])
@pytest.mark.parametrize("order", ORDERS[1:])
def test_root_of_the_correction(order, dtype, few):
    reach = 20 if dtype == np.float64 else 12
    value = np.append(0.0, 10.0 ** np.linspace(-reach, reach, 4001))
    rho = np.asarray(jax.jit(partial(solve_correction, COEFFICIENTS[order]))(jnp.asarray(value, dtype)), float)
    assert (rho >= 0.0).all()
    np.testing.assert_allclose(np.polyval([1.0, *COEFFICIENTS[order][:order], 0.0], rho), value, rtol=few)
    assert rho[0] == 0.0


@jax.jit
def estimate_of_zero(observer, position, h):
    """The estimate of a position measured to be zero, after one step from another position at rest."""
    zero = jnp.zeros(())
    return observer.step(observer.start(position, zero, no_acceleration, h), zero, no_acceleration, h)[1].position


@pytest.mark.parametrize("order", ORDERS)
@settings(deadline=None, max_examples=50)
@given(
    innovation=st.floats(1e-3, 1e6),
    sign=st.sampled_from([-1.0, 1.0]),
    lipschitz=st.floats(1e-2, 1e4),
    h=st.floats(1e-4, 1e-2),
)
def test_a_step_solves_its_set_valued_equation(order, innovation, sign, lipschitz, h):
    """e + sum_j h^j k_j L^(j/(n+1)) |e|^((n+1-j)/(n+1)) s = b with s in sign e."""
    n, k = order, COEFFICIENTS[order]
    b = sign * innovation * h ** (n + 1) * lipschitz
    e = -float(estimate_of_zero(DIFFERENTIATORS[order](jnp.asarray(lipschitz)), jnp.asarray(-b), jnp.asarray(h)))

    def powers(size):
        terms = (h**j * k[j - 1] * lipschitz ** (j / (n + 1)) * size ** ((n + 1 - j) / (n + 1)) for j in range(1, n + 1))
        return sum(terms)

    reach = h ** (n + 1) * k[n] * lipschitz
    if abs(b) <= reach:
        assert abs(e) <= 1e-12 * abs(b)
    else:
        # the estimate has the rounding of b, which the roots of a small e magnify
        rounding = 8.0 * np.finfo(float).eps * abs(b)
        low, high = (max(abs(e) + shift, 0.0) for shift in (-rounding, rounding))
        assert low + powers(low) <= abs(b) - reach + 1e-12 * abs(b)
        assert high + powers(high) >= abs(b) - reach - 1e-12 * abs(b)
        assert e * sign >= 0.0


def backward_euler(order, lipschitz, h, measured):
    """Outputs of Levant's differentiator by backward Euler, shape (samples, order + 1), in plain NumPy.

    States z_i = z_i + h (correction i + z_(i+1)), all at the new sample; outputs y_i = (D^i z)_0 with D = -ln(1 - B) / h,
    where B^m stands for h^m z_m: powers of the logarithm's series, cut off behind B^order.
    """
    n, j = order, np.arange(1, order + 2)
    gains = np.array(COEFFICIENTS[n]) * lipschitz ** (j / (n + 1))
    logarithm = np.array([0.0, *(1.0 / np.arange(1, n + 1))])
    series = [np.eye(n + 1)[0]]
    for _ in range(n):
        series.append(np.convolve(series[-1], logarithm)[: n + 1])
    outputs = np.array([[series[i][m] * h ** (m - i) for m in range(n + 1)] for i in range(n + 1)])
    z, rows = np.zeros(n + 1), []
    for y in measured:
        innovation = y - h ** np.arange(n + 1) @ z
        reach = h ** (n + 1) * gains[n]
        corrections = np.zeros(n + 1)
        corrections[n] = np.clip(innovation, -reach, reach) / h ** (n + 1)
        if abs(innovation) > reach:
            # the root of e + sum_j h^j gain_j e^((n + 1 - j)/(n + 1)) = |b|, in r = e^(1 / (n + 1))
            polynomial = np.polynomial.Polynomial([reach - abs(innovation), *(h**j * gains)[:n][::-1], 1.0])
            root = brentq(polynomial, 0.0, abs(innovation) ** (1 / (n + 1)), xtol=1e-300, rtol=1e-15)
            corrections = gains * root ** (n + 1 - j) * np.sign(innovation)
        next_derivative = 0.0
        for i in range(n, -1, -1):
            next_derivative = z[i] = z[i] + h * (corrections[i] + next_derivative)
        rows.append(outputs @ z)
    return np.array(rows)


@pytest.mark.parametrize("order", ORDERS)
def test_the_scheme_is_backward_euler_with_exact_outputs(order):
    """In and out of the sliding set: the states are linear combinations of those of backward Euler."""
    h = 1e-2
    t = h * np.arange(600)
    noise = np.where(t > 3.0, 1e-2 * np.random.default_rng(0).normal(size=t.size), 0.0)
    y = np.sin(3.0 * t) + noise
    lipschitz = 3.0 ** (order + 1)
    estimate, _ = observe(DIFFERENTIATORS[order](np.asarray(lipschitz)), y, h)
    expected = backward_euler(order, lipschitz, h, y)
    estimates = [estimate.position, estimate.velocity, *([estimate.control] if order >= 2 else [])]
    # the roots of order 5 differ by rounding, which its gains magnify
    for estimated, other in zip(estimates, expected.T, strict=False):
        np.testing.assert_allclose(estimated, other, atol=1e-7 * np.abs(other).max())


@pytest.mark.parametrize("order", ORDERS)
def test_known_accelerations_leave_it_exact(order):
    """A polynomial, and beside it any known acceleration that is held over each period."""
    h, count = 1e-2, 3000
    t = h * np.arange(count)
    acceleration = np.random.default_rng(2).uniform(-30.0, 30.0, count)
    # what the known acceleration makes of velocity and position at the samples
    speed = np.concatenate([[0.0], h * np.cumsum(acceleration)[:-1]])
    position = np.concatenate([[0.0], np.cumsum(h * speed + 0.5 * h * h * acceleration)[:-1]])
    polynomial = np.polynomial.Polynomial(0.5 ** np.arange(order + 1) / [factorial(i) for i in range(order + 1)])
    # acceleration of polynomials of degree 1 is zero: all of it is known
    y = polynomial(t) + position
    estimate, _ = observe(DIFFERENTIATORS[order](np.asarray(40.0)), y, h, acceleration, velocity=0.3)
    late = slice(-300, None)
    rounding = np.finfo(float).eps * np.abs(y).max()
    velocity = polynomial.deriv()(t) + speed
    np.testing.assert_allclose(estimate.velocity[late], velocity[late], atol=2**order * 40.0 * rounding / h)
    disturbance = polynomial.deriv(2)(t) if order >= 2 else 0.0 * t
    np.testing.assert_allclose(estimate.control[late], disturbance[late], atol=4**order * 40.0 * rounding / h**2)


@pytest.mark.parametrize("order", ORDERS)
def test_any_start_leads_into_the_sliding_set(order):
    """Errors up to 40^(n+1-i) times those of a period, while the highest derivative jumps between its bounds."""
    n, h, lanes, count = order, 1.0, 64, 10_000
    rng = np.random.default_rng(3)
    observer = DIFFERENTIATORS[n](1.0)
    size = 10.0 ** rng.uniform(-1.0, np.log10(40.0), lanes)
    error = rng.normal(size=(n + 1, lanes)) * size ** np.arange(n + 1, 0, -1)[:, None]
    # signs that stay for long, for a while, and for one period
    length = rng.choice([1, 10, 100, 10_000], lanes)
    top = np.sign(np.sin(np.pi * (np.arange(count)[:, None] + rng.uniform(0.0, 1.0, lanes) * length) / length + 1e-3))
    taylor = np.array([[1.0 / factorial(j - i) if j >= i else 0.0 for j in range(n + 1)] for i in range(n + 1)])
    push = np.array([1.0 / factorial(n + 1 - i) for i in range(n + 1)])

    def step(state, top):
        # the error is observed: true states zero, but for what the highest derivative does over the period
        new, estimate = jax.vmap(lambda s: observer.step(s, jnp.zeros(()), no_acceleration, jnp.asarray(h)))(state)
        position, velocity, *further = (
            x - p * top for x, p in zip([new.position, new.velocity, *new.further], push, strict=True)
        )
        return ObserverState(position, velocity, tuple(further)), estimate.position

    position, velocity, *further = jnp.asarray(taylor @ error)
    errors = np.asarray(jax.lax.scan(step, ObserverState(position, velocity, tuple(further)), jnp.asarray(top))[1])
    assert np.abs(errors[0]).max() > 1e2
    assert np.abs(errors[-2000:]).max() == 0.0


@pytest.mark.parametrize("order", ORDERS)
def test_polynomials_are_differentiated_exactly_and_without_chatter(order):
    """In the sliding set the states follow the polynomial through the last n + 1 samples, to rounding."""
    h, count = 1e-2, 3000
    t = h * np.arange(count)
    powers = np.arange(order + 1)
    coefficients = 0.5**powers / np.array([1.0, *np.cumprod(powers[1:])])
    polynomial = np.polynomial.Polynomial(coefficients)
    y = polynomial(t)
    estimate, _ = observe(DIFFERENTIATORS[order](np.asarray(40.0)), y, h, velocity=0.3)
    late = slice(-300, None)
    rounding = np.finfo(float).eps * np.abs(y).max()
    np.testing.assert_allclose(estimate.position[late], y[late], atol=8.0 * rounding)
    # a backward difference of the last n + 1 samples magnifies rounding by 2^n / h at most, per derivative
    np.testing.assert_allclose(estimate.velocity[late], polynomial.deriv()(t)[late], atol=2**order * 40.0 * rounding / h)
    if order >= 2:
        expected = polynomial.deriv(2)(t)[late]
        np.testing.assert_allclose(estimate.control[late], expected, atol=4**order * 40.0 * rounding / h**2)


@pytest.mark.parametrize(
    ("order", "dtype", "h"), [*((order, np.float64, 5e-3) for order in ORDERS), (2, np.float32, 0.2), (5, np.float32, 0.2)]
)
def test_a_smooth_signal_never_leaves_the_sliding_set_again(order, dtype, h):
    """|y^(n+1)| <= L: the position has no error at all, and the velocity that of interpolation, h^n L / (n + 1)."""
    t = h * np.arange(8000)
    rounding = float(np.finfo(dtype).eps)
    estimate, _ = observe(DIFFERENTIATORS[order](np.asarray(1.0, dtype)), np.sin(t).astype(dtype), h, velocity=1.0)
    assert estimate.velocity.dtype == dtype
    late = slice(-2000, None)
    assert np.abs(estimate.position - np.sin(t))[late].max() <= 9.0 * rounding
    bound = 1.01 * h**order / (order + 1) + 2**order * 20.0 * rounding / h
    assert np.abs(estimate.velocity - np.cos(t))[late].max() <= bound


@pytest.mark.parametrize("order", ORDERS)
def test_errors_grow_with_the_noise_as_theory_says(order):
    """Levant (2003): the error of derivative i grows with the noise to the power (n + 1 - i) / (n + 1); within 0.05.

    Noise is scaled with time as the differentiator is homogeneous: the worst of many signs of noise that changes slowly
    enough for the sampling period to play no part.
    """
    n, observer = order, DIFFERENTIATORS[order](np.asarray(1.0))
    sizes = 10.0 ** np.linspace(-8.0, -3.0, 6)
    pace = sizes ** (1.0 / (n + 1))
    h = pace / 400.0
    t = h[:, None] * np.arange(24_000)
    # square waves about the differentiator's own time
    waves = np.sign(np.sin(2.0 * np.pi * t / (pace[:, None] * 6.0) + np.random.default_rng(5).uniform(0.0, 6.0)))
    true = [np.sin(0.9 * t + i * np.pi / 2) * 0.9**i for i in range(n + 1)]

    lanes = zip(true[0] + sizes[:, None] * waves, h, *(x[:, 0] for x in true[2:]), strict=True)
    runs = [observe(observer, y, period, velocity=0.9, higher_states=further) for y, period, *further in lanes]
    estimate, state = jax.tree.map(lambda *lanes: np.stack(lanes), *runs)
    estimates = [estimate.position, estimate.velocity]
    if n >= 2:
        estimates.append(estimate.control)
    # further states are predicted for the coming sample, a period that is short beside their own time
    estimates += [np.roll(x, 1, axis=1) for x in state.further[1:]]
    late = slice(-12_000, None)
    errors = [np.abs(x - y)[:, late].max(axis=1) for x, y in zip(estimates, true, strict=False)]
    slopes = [np.polyfit(np.log(sizes), np.log(column), 1)[0] for column in errors]
    expected = [(n + 1 - i) / (n + 1) for i in range(len(slopes))]
    np.testing.assert_allclose(slopes, expected, atol=0.05)
