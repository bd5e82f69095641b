"""The search over reachable errors: against a linear worst case, all sequences of a short horizon, and simulation."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbl.gains.reachable import build_error_step, explore
from jaxbl.observer import DIFFERENTIATORS, ExplicitSuperTwisting, ImplicitSuperTwisting, Luenberger, ObserverState

KINDS = [(ImplicitSuperTwisting, (1.5, 1.1)), (ExplicitSuperTwisting, (1.5, 1.1)), (DIFFERENTIATORS[2], (1.0,)),
         (DIFFERENTIATORS[3], (1.0,))]  # fmt: skip
NOISE = 3.0


@pytest.fixture(autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


def list_noises(states):
    spaced = NOISE * np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    return np.concatenate([
        np.repeat(spaced[:, None], len(states), axis=1),
        np.clip(np.array([-1.1, 0.0, 1.1])[:, None] - states[:, 0], -NOISE, NOISE),
    ])  # fmt: skip


@functools.cache
def explore_kind(kind, gains, most=50_000):
    """The observer, its state at rest, and the result of the search."""
    observer, zero = kind(*map(jnp.asarray, gains)), jnp.zeros(())
    rest_state = observer.start(zero, zero, lambda v: v, jnp.ones(()))
    return (
        observer,
        rest_state,
        explore(build_error_step(observer), list_noises, np.array([[0.5, 1.0] + [0.0] * len(rest_state.further)]), most),
    )


def simulate_errors(observer, rest_state, noise, push):
    """Velocity errors at the samples of a double integrator: its own simulation, with true motion."""

    def step_errors(carry, sample_inputs):
        state, position, velocity = carry
        eta, d = sample_inputs
        state, estimate = observer.step(state, position + eta, lambda v: 0.0 * v, jnp.ones(()))
        return (state, position + velocity + 0.5 * d, velocity + d), estimate.velocity - velocity

    zero = jnp.zeros(())
    return jax.lax.scan(step_errors, (rest_state, zero, zero), (jnp.asarray(noise), jnp.asarray(push)))[1]


@pytest.mark.parametrize(("kind", "gains"), KINDS)
def test_the_way_leads_to_the_error_that_is_found(kind, gains):
    observer, rest_state, result = explore_kind(kind, gains)
    assert np.abs(result.noise).max() <= NOISE
    assert set(result.sign) <= {-1.0, 1.0} and not result.push.any()
    errors = simulate_errors(observer, rest_state, result.noise, result.sign)
    assert abs(errors[-1]) == pytest.approx(result.worst, rel=1e-9)
    assert len(errors) <= result.state_count <= 50_000


@pytest.mark.parametrize(("kind", "gains"), KINDS)
def test_it_finds_at_least_what_all_sequences_of_a_short_horizon_do(kind, gains):
    observer, rest_state, result = explore_kind(kind, gains)
    push = np.array(list(itertools.product([-1.0, 1.0], repeat=4)))
    noise = NOISE * np.array([(1.0, *signs) for signs in itertools.product([-1.0, 0.0, 1.0], repeat=4)])
    pairs = np.repeat(noise, len(push), axis=0), np.tile(np.column_stack([push, push[:, -1]]), (len(noise), 1))
    assert result.worst >= np.abs(jax.vmap(lambda n, d: simulate_errors(observer, rest_state, n, d))(*pairs)).max()


@pytest.mark.parametrize(("gains", "share"), [((0.4, 0.7), 0.999), ((0.15, 1.0), 0.995), ((0.1, 0.3), 0.998)])
def test_the_worst_case_of_a_linear_observer_is_almost_reached(gains, share):
    """That is the sum of absolute sensitivities."""
    period, unit = jnp.ones(()), np.eye(3)
    observer = Luenberger(*map(jnp.asarray, gains))
    higher_states = np.zeros(3), *observer.correction(lambda v: 0.0 * v, period)
    next_state, estimate = observer.step(
        ObserverState(-unit[0], -unit[1], higher_states), unit[2], lambda v: 0.0 * v, period
    )
    moved, seen_velocity, push = (
        -np.column_stack([next_state.position, next_state.velocity]),
        np.asarray(estimate.velocity),
        np.array([0.5, 1.0]),
    )

    def step(states, noise):
        sample_inputs = np.column_stack([states, noise])
        return sample_inputs @ moved, np.abs(sample_inputs @ seen_velocity)

    result, worst, row_vector = explore(step, list_noises, push[None]), NOISE * abs(seen_velocity[2]), seen_velocity[:2]
    for _ in range(400):
        worst, row_vector = worst + NOISE * abs(moved[2] @ row_vector) + abs(push @ row_vector), moved[:2] @ row_vector
    assert share * worst <= result.worst <= worst * (1.0 + 1e-9)


def test_more_errors_kept_find_more():
    worst = [explore_kind(ImplicitSuperTwisting, (1.5, 1.1), most)[2].worst for most in (2_000, 100_000)]
    assert worst[0] < worst[1]
