"""The audit of discretisations: the errors of its paths, the bounds' signals, a linear worst case, and schemes."""

import discretisation as audit
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differentiation_bound import least_exact_error, least_worst_error

from jaxbl.observer import ImplicitSuperTwisting, Luenberger


@pytest.fixture(autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


def largest_error(kind, gains, noise, paths):
    return float(jax.vmap(lambda x: audit.simulate_errors(kind, gains, noise, x))(paths).max())


def test_the_worst_error_is_the_larger_of_search_and_pairs():
    kind, gains, noise = ImplicitSuperTwisting, (1.5, 1.1), 2.0
    pairs = [largest_error(kind, gains, noise, x[None]) for x in audit.pairs(noise, audit.horizon(noise))]
    worst = audit.search_worst(kind, gains, noise)
    assert worst > max(pairs)
    assert audit.worst(kind, gains, noise, audit.horizon(noise)) == worst


def test_pairs_make_super_twisting_err_by_the_bounds():
    noise, gains = 10.0, (1.8 * 1.1**0.5, 1.1)
    samples = audit.horizon(noise)
    plain, exact = (
        float(audit.simulate_errors(ImplicitSuperTwisting, gains, noise, x)) for x in audit.pairs(noise, samples)
    )
    assert plain == pytest.approx(least_worst_error(noise, 1.0, 1.0), rel=1e-6)
    assert exact == pytest.approx(least_exact_error(noise, 1.0, 1.0), rel=1e-6)


def test_a_linear_observer_has_its_worst_case_in_closed_form():
    kind, gains, noise, samples = Luenberger, (0.4, 0.7), 3.0, 60
    worst_linear = float(audit.worst_linear(kind, gains, noise, samples))
    sensitivity = jax.grad(lambda x: audit.error(kind(*gains), noise, x))(jnp.zeros((2, samples)))
    assert worst_linear == pytest.approx(float(audit.simulate_errors(kind, gains, noise, jnp.sign(sensitivity))), rel=1e-9)
    random = np.random.default_rng(0).choice([-1.0, 1.0], (500, 2, samples))
    assert largest_error(kind, gains, noise, jnp.asarray(random)) < worst_linear


@pytest.mark.parametrize("order", range(1, 6))
def test_schemes_without_noise(order):
    """Only exact outputs have neither bias nor chatter; backward Euler's own states lag by half a period of f''."""
    h, lipschitz = 0.02, 2.0 ** (order + 1)
    t = h * np.arange(1500)
    unit = h**order * lipschitz
    bias, chatter = {}, {}
    for name, scheme in audit.SCHEMES.items():
        y = 0.5 * t**2 if order >= 2 else t
        start = [0.0, 0.0 if order >= 2 else 1.0, 1.0, *[0.0] * 3][: order + 1]
        velocity = t if order >= 2 else 0.0 * t + 1.0
        late_velocity = audit.late_velocity(scheme, order, lipschitz, h, y, start)
        bias[name] = np.abs(late_velocity - velocity[-late_velocity.size :]).max()
        estimates_at_rest = audit.late_velocity(scheme, order, lipschitz, h, 0.0 * t, [1e-3, *[0.0] * order])
        chatter[name] = np.abs(np.diff(estimates_at_rest)).max()
    rounding = 2**order * np.finfo(float).eps * 450.0 / h
    first, correction_alone, own_states, exact = audit.SCHEMES
    assert bias[exact] <= 4.0 * rounding
    assert chatter[exact] <= 1e-12 * unit
    assert bias[own_states] == pytest.approx(0.5 * h if order >= 2 else 0.0, abs=4.0 * rounding)
    assert chatter[own_states] <= 1e-12 * unit
    assert min(chatter[first], chatter[correction_alone]) > 0.1 * unit
