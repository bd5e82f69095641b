"""Differentiators of orders 1 to 5: their set-valued equation, exactness, no chatter, and the accuracy laws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxbl.observer import COEFFICIENTS, DIFFERENTIATORS
from jaxbl.observer.differentiator import solve_correction

ORDERS = sorted(DIFFERENTIATORS)


def free(velocity):
    return 0.0 * velocity


def observed(observer, measured, h, acceleration=free, velocity=0.0, further=None):
    """Estimates, and states predicted from them, along measured positions; `further` states at the start."""

    def one(state, y):
        state, estimate = observer.step(state, y, acceleration, h)
        return state, (estimate, state)

    dtype = measured.dtype
    start = observer.start(jnp.asarray(measured[0]), jnp.asarray(velocity, dtype), acceleration, jnp.asarray(h, dtype))
    if further is not None:
        start = start._replace(further=tuple(jnp.asarray(x, dtype) for x in further))
    return jax.jit(lambda y: jax.lax.scan(one, start, y)[1])(jnp.asarray(measured))


@pytest.mark.parametrize(("dtype", "few"), [(np.float64, 1e-14), (np.float32, 5e-6)])
@pytest.mark.parametrize("order", ORDERS[1:])
def test_root_of_the_correction(order, dtype, few):
    reach = 20 if dtype == np.float64 else 12
    value = 10.0 ** np.linspace(-reach, reach, 4001)
    rho = np.asarray(solve_correction(COEFFICIENTS[order], jnp.asarray(value, dtype)), float)
    assert (rho >= 0.0).all()
    np.testing.assert_allclose(np.polyval([1.0, *COEFFICIENTS[order][:order], 0.0], rho), value, rtol=few)
    assert float(solve_correction(COEFFICIENTS[order], jnp.asarray(dtype(0.0)))) == 0.0


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
    observer = DIFFERENTIATORS[order](jnp.asarray(lipschitz))
    zero = jnp.zeros(())
    start = observer.start(jnp.asarray(-b), zero, free, jnp.asarray(h))
    _, estimate = observer.step(start, zero, free, jnp.asarray(h))
    # a measurement of zero: the estimate is -e
    e = -float(estimate.position)

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


@pytest.mark.parametrize("order", ORDERS)
def test_polynomials_are_differentiated_exactly_and_without_chatter(order):
    """In the sliding set the states follow the polynomial through the last n + 1 samples, to rounding."""
    h, count = 1e-2, 3000
    t = h * np.arange(count)
    powers = np.arange(order + 1)
    coefficients = 0.5**powers / np.array([1.0, *np.cumprod(powers[1:])])
    own = np.polynomial.Polynomial(coefficients)
    y = own(t)
    estimate, _ = observed(DIFFERENTIATORS[order](40.0), y, h, velocity=0.3)
    late = slice(-300, None)
    rounding = np.finfo(float).eps * np.abs(y).max()
    np.testing.assert_allclose(estimate.position[late], y[late], atol=8.0 * rounding)
    # a backward difference of the last n + 1 samples magnifies rounding by 2^n / h at most, per derivative
    np.testing.assert_allclose(estimate.velocity[late], own.deriv()(t)[late], atol=2**order * 40.0 * rounding / h)
    if order >= 2:
        expected = own.deriv(2)(t)[late]
        np.testing.assert_allclose(estimate.control[late], expected, atol=4**order * 40.0 * rounding / h**2)


@pytest.mark.parametrize("order", ORDERS)
def test_a_smooth_signal_never_leaves_the_sliding_set_again(order):
    """|y^(n+1)| <= L: the position has no error at all, and the velocity that of interpolation, h^n L / (n + 1)."""
    h = 5e-3
    t = h * np.arange(8000)
    estimate, _ = observed(DIFFERENTIATORS[order](1.0), np.sin(t), h, velocity=1.0)
    late = slice(-2000, None)
    assert np.abs(estimate.position - np.sin(t))[late].max() <= 2e-15
    assert np.abs(estimate.velocity - np.cos(t))[late].max() <= 1.01 * h**order / (order + 1) + 1e-12 * 2**order


@pytest.mark.slow
@pytest.mark.parametrize("order", ORDERS)
def test_errors_grow_with_the_noise_as_theory_says(order):
    """Levant (2003): the error of derivative i grows with the noise to the power (n + 1 - i) / (n + 1); within 0.05.

    Noise is scaled with time as the differentiator is homogeneous: the worst of many signs of noise that changes slowly
    enough for the sampling period to play no part.
    """
    n, lipschitz = order, 1.0
    sizes = 10.0 ** np.linspace(-8.0, -3.0, 6)
    errors = []
    for size in sizes:
        pace = size ** (1.0 / (n + 1))
        h = pace / 400.0
        t = h * np.arange(40_000)
        rng = np.random.default_rng(5)
        # square waves of several lengths about the differentiator's own time
        noise = size * np.sign(np.sin(2.0 * np.pi * t / (pace * 6.0) + rng.uniform(0.0, 6.0)))
        true = [np.sin(0.9 * t + i * np.pi / 2) * 0.9**i for i in range(n + 1)]
        estimate, state = observed(
            DIFFERENTIATORS[n](lipschitz), true[0] + noise, h, velocity=0.9, further=[x[0] for x in true[2:]]
        )
        late = slice(-20_000, None)
        found = [estimate.position, estimate.velocity]
        if n >= 2:
            found.append(estimate.control)
        # further states are predicted for the coming sample, a period that is short beside their own time
        found += [np.append(0.0, x[:-1]) for x in state.further[1:]]
        errors.append([np.abs(x - y)[late].max() for x, y in zip(found, true, strict=False)])
    slopes = [np.polyfit(np.log(sizes), np.log(column), 1)[0] for column in np.transpose(errors)]
    expected = [(n + 1 - i) / (n + 1) for i in range(len(slopes))]
    np.testing.assert_allclose(slopes, expected, atol=0.05)
