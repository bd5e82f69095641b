"""Linear observers against scipy.signal, closed forms and the Riccati equation of scipy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from scipy.signal import dlsim, lfilter, place_poles

from jaxbl.observer import DirtyDerivative, ExtendedState, Kalman, Luenberger
from jaxbl.observer.base import predict_next

H, FRICTION = 1e-3, 3.0


def nominal_acceleration(velocity):
    return 0.7 - FRICTION * velocity


def observe(observer, measured, acceleration=nominal_acceleration, period=H):
    """Estimates along measured positions, from the first one at rest."""

    dtype, count = measured.dtype, len(measured)
    observer, period = jax.tree.map(lambda x: jnp.asarray(x, dtype), (observer, period))
    # signals of one length share the program of each kind
    return jax.tree.map(lambda x: x[:count], run_observer(observer, np.resize(measured, SAMPLES), acceleration, period))


SAMPLES = 4000


@eqx.filter_jit
def run_observer(observer, measured, acceleration, period):
    start = observer.start(measured[0], jnp.zeros((), measured.dtype), acceleration, period)
    return jax.lax.scan(lambda state, y: observer.step(state, y, acceleration, period), start, measured)[1]


def prediction_matrix(period=H):
    """The prediction of position, velocity and disturbance as a matrix, and what the nominal input adds."""
    offset = np.array([*map(float, predict_next(0.0, 0.0, nominal_acceleration, period)), 0.0])
    columns = [
        np.array([*map(float, predict_next(x, v, nominal_acceleration, period, disturbance=d)), d]) for x, v, d in np.eye(3)
    ]
    return np.stack(columns, axis=1) - np.outer(offset, [1.0, 1.0, 1.0]), offset


def simulate_estimator(shares, measured, states):
    """The estimates of x_hat = x_predicted + L (y - x_predicted), by scipy's simulation of the linear system."""
    a, offset = (part[:states] for part in prediction_matrix())
    a, gain, read = a[:, :states], np.array(shares)[:states, None], np.eye(1, states)
    correct = np.eye(states) - gain @ read
    # inputs are the measurement and one, the state is the predicted one
    system = (a @ correct, np.hstack([a @ gain, offset[:, None]]), correct, np.hstack([gain, np.zeros((states, 1))]), 1.0)
    inputs = np.column_stack([measured, np.ones_like(measured)])
    return dlsim(system, inputs, x0=np.array([measured[0], 0.0, 0.0])[:states])[1]


def noisy_signal(count=2000):
    t = H * np.arange(count)
    return np.sin(5.0 * t) + 0.1 * t + 1e-4 * np.random.default_rng(3).normal(size=count)


@pytest.mark.parametrize("observer", [ExtendedState(150.0), Kalman(1e-4, 30.0), Kalman(1e-4, 30.0, 0.5)])
def test_observers_with_a_disturbance_are_the_linear_system_of_their_shares(observer):
    estimates = observe(observer, noisy_signal())
    expected = simulate_estimator(observer.correction(nominal_acceleration, jnp.asarray(H)), noisy_signal(), 3)
    for estimated, other in zip(estimates, expected.T, strict=True):
        np.testing.assert_allclose(estimated, other, rtol=1e-9, atol=1e-9 * np.abs(other).max())


@pytest.mark.parametrize("damping", [0.5, 1.0, 2.0])
def test_luenberger_is_the_linear_system_of_its_shares(damping):
    """Without friction: with it the prediction makes up for the velocity's lag, which is no state."""

    def free(velocity):
        return 0.0 * velocity

    observer = Luenberger(120.0, damping)
    shares = np.array(observer.correction(free, jnp.asarray(H)), float)
    a = np.array([[1.0, H], [0.0, 1.0]])
    correct = np.eye(2) - np.outer(shares[:2], [1.0, 0.0])
    system = (a @ correct, a @ shares[:2, None], correct, shares[:2, None], 1.0)
    y = noisy_signal()
    expected = dlsim(system, y, x0=np.array([y[0], 0.0]))[1]
    estimates = observe(observer, y, free)
    for estimated, other in zip(estimates, expected.T, strict=False):
        np.testing.assert_allclose(estimated, other, rtol=1e-9, atol=1e-9 * np.abs(other).max())


@pytest.mark.parametrize("damping", [0.4, 0.999999, 1.0, 1.000001, 2.5])
def test_luenberger_has_the_poles_that_were_asked_for(damping):
    bandwidth = 200.0
    shares = Luenberger(bandwidth, damping).correction(nominal_acceleration, jnp.asarray(H))
    a = np.array([[1.0, H], [0.0, 1.0]])
    poles = np.linalg.eigvals((np.eye(2) - np.outer(np.array(shares[:2]), [1.0, 0.0])) @ a)
    asked = np.exp(H * bandwidth * np.roots([1.0, 2.0 * damping, 1.0]))
    np.testing.assert_allclose(np.poly(poles), np.poly(asked), rtol=1e-9, atol=1e-12)
    if damping == 2.5:
        gain = place_poles(a.T, (np.array([[1.0, 0.0]]) @ a).T, asked).gain_matrix[0]
        np.testing.assert_allclose(shares[:2], gain, rtol=1e-9)


def test_extended_state_has_three_poles_at_one_place():
    shares = np.array(ExtendedState(300.0).correction(nominal_acceleration, jnp.asarray(H)), float)
    a = np.array([[1.0, H, 0.5 * H * H], [0.0, 1.0, H], [0.0, 0.0, 1.0]])
    poles = np.poly((np.eye(3) - np.outer(shares, [1.0, 0.0, 0.0])) @ a)
    np.testing.assert_allclose(poles, np.poly([np.exp(-300.0 * H)] * 3), rtol=1e-9)


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-7), (np.float32, 3e-3)])
def test_kalman_shares_are_those_of_scipys_riccati_equation(dtype, tolerance):
    rng = np.random.default_rng(0)

    @jax.jit
    def shares_of(observer, friction, h):
        return observer.correction(lambda velocity: dtype(0.3) - friction * velocity, h)

    for _ in range(20):
        h, noise, friction = 10.0 ** rng.uniform([-4, -6, -2], [-2, -3, 2])
        width = 10.0 ** rng.uniform(-3.0, 0.3) / h
        slow, fast = noise * h**0.5 * width**3, noise * h**0.5 * width**2 * rng.integers(2)

        shares = shares_of(Kalman(*map(dtype, (noise, slow, fast))), dtype(friction), dtype(h))
        still = np.array([*predict_next(0.0, 0.0, lambda v, f=friction: -f * v, h), 0.0])
        assert not still.any()
        a = np.stack(
            [[*predict_next(x, v, lambda v, f=friction: -f * v, h, disturbance=d), d] for x, v, d in np.eye(3)], axis=1
        )
        q = slow**2 * np.array([[h**5 / 20, h**4 / 8, h**3 / 6], [h**4 / 8, h**3 / 3, h**2 / 2], [h**3 / 6, h**2 / 2, h]])
        q += fast**2 * np.array([[h**3 / 3, h**2 / 2, 0.0], [h**2 / 2, h, 0.0], [0.0, 0.0, 0.0]])
        scale = np.diag([1.0, h, h * h]) / noise
        back = np.linalg.inv(scale)
        p = solve_discrete_are((scale @ a @ back).T, np.eye(3, 1), scale @ q @ scale, np.eye(1))
        expected = p[:, 0] / (p[0, 0] + 1.0) / np.array([1.0, h, h * h])
        assert all(share.dtype == dtype for share in shares)
        np.testing.assert_allclose(np.array(shares, float), expected, rtol=tolerance)


def test_dirty_derivative_is_the_filters_of_scipy():
    """Velocity and disturbance of a drive without friction, by scipy's filters of the same difference equations."""
    tau, y = 4e-3, noisy_signal()

    def free(velocity):
        return 0.0 * velocity

    share = H / (tau + H)
    lag = [share], [1.0, share - 1.0]
    moved = np.diff(y, prepend=y[0]) / H
    velocity = lfilter(*lag, moved)
    disturbance = lfilter(*lag, np.diff(velocity, prepend=0.0) / H)
    estimates = observe(DirtyDerivative(tau), y, free)
    np.testing.assert_allclose(estimates.velocity, velocity, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(estimates.control, disturbance, rtol=1e-9, atol=1e-6)
    assert (np.asarray(estimates.position) == y).all()


@pytest.mark.parametrize(
    "observer", [Luenberger(300.0), ExtendedState(300.0), Kalman(1e-4, 300.0), DirtyDerivative(2e-3)], ids=lambda o: o.name
)
def test_a_constant_disturbance_is_found_whatever_friction_and_input(observer):
    """The control settles at the acceleration that is missing in the model. An observer without a state for it has a lag of
    its velocity, whose friction it takes for a part of it: 2 damping / bandwidth, less half a period."""
    t = H * np.arange(4000)
    missing, slope = 1.9, 1.0 / FRICTION
    # x' = v, v' = 0.7 - FRICTION v + missing, in closed form
    end = (0.7 + missing) * slope
    velocity = end * (1.0 - np.exp(-FRICTION * t))
    position = end * t - velocity * slope
    estimates = observe(observer, position)
    lag = FRICTION * (2.0 / 300.0 - 0.5 * H) if observer.name == "luenberger" else 0.0
    np.testing.assert_allclose(estimates.control[-500:], missing / (1.0 + lag), rtol=2e-3)
    if observer.name in ("extended_state", "kalman"):
        np.testing.assert_allclose(estimates.velocity[-500:], velocity[-500:], rtol=1e-5)
