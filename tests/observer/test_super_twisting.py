"""Super-twisting observers of one side, explicit and implicit, and on recorded positions."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from paper_drive import paper_experiment

from jaxbl.chain import Sample, initial_state, scan, step
from jaxbl.observer import ExplicitSuperTwisting, ImplicitSuperTwisting, ObserverState


def no_acceleration(velocity):
    return 0.0 * velocity


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@settings(deadline=None, max_examples=100)
@given(
    magnitude=st.floats(1e-3, 1e9),
    sign=st.sampled_from([-1.0, 1.0]),
    lambda_=st.one_of(st.just(0.0), st.floats(1e-2, 1e2)),
    alpha=st.floats(1e-2, 1e2),
    h=st.floats(1e-5, 1e-1),
)
def test_implicit_step_solves_its_generalised_equation(dtype, magnitude, sign, lambda_, alpha, h):
    """e + h lambda sqrt|e| sign e + h^2 alpha s = b with s in sign e; velocity and prediction follow from alpha s."""
    # innovations from a thousandth of the sliding set's size to far beyond it
    b = dtype(sign * magnitude * h * h * alpha)
    lambda_, alpha, h = dtype(lambda_), dtype(alpha), dtype(h)
    observer = ImplicitSuperTwisting(jnp.asarray(lambda_), jnp.asarray(alpha))
    # a measurement of zero, so that the estimate is -e without rounding
    state = ObserverState(jnp.asarray(-b), jnp.asarray(dtype(0.0)))
    new, estimate = observer.step(state, jnp.asarray(dtype(0.0)), no_acceleration, jnp.asarray(h))
    assert estimate.control.dtype == dtype
    e, s = -float(estimate.position), float(estimate.control) / float(alpha)
    few = 20 * np.finfo(dtype).eps
    residual = e + float(h * lambda_) * np.sqrt(abs(e)) * np.sign(e) + float(h) ** 2 * float(alpha) * s - float(b)
    assert abs(residual) <= few * abs(b)
    assert abs(s) <= 1.0 + few
    if e != 0.0:
        assert abs(s - np.sign(e)) <= few
    np.testing.assert_allclose(estimate.velocity, h * estimate.control, rtol=few)
    np.testing.assert_allclose(new.velocity, estimate.velocity, rtol=few)
    np.testing.assert_allclose(new.position, estimate.position + h * estimate.velocity, rtol=few, atol=few * abs(b))


SAMPLES = 3000
"""Samples of a block: signals of any length share the program of each observer."""


@eqx.filter_jit
def observe_block(observer, state, measured, acceleration, h):
    return jax.lax.scan(lambda state, y: observer.step(state, y, acceleration, h), state, measured)


def observe(observer, measured, h, acceleration=no_acceleration, state=(0.0, 0.0)):
    """Estimates along measured positions."""
    dtype, count = measured.dtype, len(measured)
    observer, state, h = jax.tree.map(lambda x: jnp.asarray(x, dtype), (observer, ObserverState(*state), h))
    blocks = []
    for block in np.resize(measured, (-(-count // SAMPLES), SAMPLES)):
        state, estimates = observe_block(observer, state, block, acceleration, h)
        blocks.append(estimates)
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:count], *blocks)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_implicit_does_not_chatter(dtype):
    """At rest the estimate stands still; under a constant perturbation z_2 is that perturbation."""
    observer = ImplicitSuperTwisting(4.0, 9.0)
    at_rest = observe(observer, jnp.full(3000, 0.3, dtype), 1e-3)
    # what is left of the velocity no longer moves the position in its own rounding
    assert jnp.all(at_rest.velocity[-500:] == at_rest.velocity[-1])
    assert abs(at_rest.velocity[-1]) <= 0.3 * float(jnp.finfo(dtype).eps) / 1e-3
    assert jnp.all(at_rest.control[-500:] == 0.0)
    t = 1e-3 * np.arange(3000)
    pushed = observe(observer, jnp.asarray(1.5 * t**2), 1e-3)
    np.testing.assert_allclose(pushed.control[-500:], 3.0, rtol=1e-6)
    np.testing.assert_allclose(pushed.velocity[-500:], 3.0 * t[-500:], rtol=1e-3)


def test_explicit_is_forward_euler_of_the_paper():
    lambda_, alpha, h = 1.2, 0.9, 1e-3
    t = h * np.arange(2000)
    measured = np.sin(t) + 1e-4 * np.random.default_rng(0).normal(size=t.size)
    x1, x2, expected = 0.1, -0.2, []
    for y in measured:
        sign = np.sign(y - x1)
        z1, z2 = lambda_ * abs(y - x1) ** 0.5 * sign, alpha * sign
        expected.append((x1, x2, z2))
        x1, x2 = x1 + h * (x2 + z1), x2 + h * (0.3 - 0.5 * x2 + z2)
    estimates = observe(
        ExplicitSuperTwisting(lambda_, alpha), jnp.asarray(measured), h, lambda v: 0.3 - 0.5 * v, state=(0.1, -0.2)
    )
    np.testing.assert_allclose(np.stack(estimates, 1), expected, rtol=1e-9, atol=1e-12)


def fit_order(sizes, errors):
    return np.polyfit(np.log(sizes), np.log(errors), 1)[0]


def largest_errors(observer, h, noise=0.0, duration=6.0):
    """Largest errors of position and velocity over the last third of a run on sin t, whose acceleration is unknown."""
    t = h * np.arange(round(duration / h))
    measured = jnp.asarray(np.sin(t) + noise * np.random.default_rng(1).uniform(-1.0, 1.0, t.size))
    estimates = observe(observer, measured, h, state=(0.05, 0.8))
    late = t > 2.0 / 3.0 * duration
    return [np.abs(x - y)[late].max() for x, y in ((np.sin(t), estimates.position), (np.cos(t), estimates.velocity))]


def test_errors_fall_with_the_period_as_theory_says():
    """Levant (2003): |x_1| ~ h^2 and |x_2| ~ h without noise; the implicit estimate has no position error at all."""
    periods = [4e-3, 2e-3, 1e-3, 5e-4]
    explicit, implicit = (
        np.array([largest_errors(cls(3.0, 2.2), h) for h in periods])
        for cls in (ExplicitSuperTwisting, ImplicitSuperTwisting)
    )
    assert abs(fit_order(periods, explicit[:, 0]) - 2.0) < 0.15
    assert abs(fit_order(periods, explicit[:, 1]) - 1.0) < 0.15
    assert np.all(implicit[:, 0] < 1e-15)
    assert abs(fit_order(periods, implicit[:, 1]) - 1.0) < 0.05
    assert np.all(implicit[:, 1] < 0.5 * explicit[:, 1])


@pytest.mark.parametrize("cls", [ExplicitSuperTwisting, ImplicitSuperTwisting])
def test_errors_grow_with_the_noise_as_theory_says(cls):
    """Levant (2003): |x_1| ~ noise and |x_2| ~ its root."""
    noises = [1e-5, 1e-4, 1e-3]
    errors = np.array([largest_errors(cls(3.0, 2.2), 1e-4, noise) for noise in noises])
    assert abs(fit_order(noises, errors[:, 0]) - 1.0) < 0.15
    assert abs(fit_order(noises, errors[:, 1]) - 0.5) < 0.15


@pytest.mark.parametrize("discretisation", ["explicit", "implicit"])
def test_recorded_positions_give_the_estimates_of_the_run_that_produced_them(discretisation):
    experiment = paper_experiment(discretisation, time_constant=0.01, noise=1e-4, start=0.2, steps=1000, velocity_error=0.5)

    def keep(state, signals):
        numbers = [
            (side.position_estimate, side.velocity_estimate, side.equivalent_control, side.torque_estimate)
            for side in (signals.motor, signals.load)
        ]
        read = {side: signals.side(side).measured for side in experiment.sides}
        information = [total.value(state.identifier.weight) for total in state.identifier.information]
        return (signals.time, signals.input, read), (numbers, information)

    _, ((time, torque, measured), simulated) = eqx.filter_jit(lambda e: scan(e, jnp.asarray(5), record=keep))(experiment)

    def replay(experiment, samples):
        # the simulated observers start from true positions, not from the first noisy reading
        start = eqx.tree_at(lambda s: s.plant, initial_state(experiment), None)

        def replay_sample(state, sample):
            new, signals = step(experiment, state, sample)
            assert signals.motor.true is None and signals.torque is None
            return new, keep(new, signals)[1]

        return jax.lax.scan(replay_sample, start, samples)[1]

    replayed = eqx.filter_jit(replay)(experiment, Sample(time, input=torque, measured=measured))
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-15), replayed, simulated)


def test_a_record_starts_from_its_first_positions_at_standstill():
    experiment = paper_experiment(velocity_error=0.5)
    start = initial_state(experiment, {"motor": jnp.asarray(0.4), "load": jnp.asarray(0.08)})
    assert start.plant is None
    assert start.observer["motor"] == ObserverState(0.4, -0.5)
    assert start.observer["load"] == ObserverState(0.08, 0.0)
