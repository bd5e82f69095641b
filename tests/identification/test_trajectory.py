"""Trajectory fits against truth from another integrator, and against one joint least-squares problem by SciPy."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares
from small_study import rigid, small

from jaxbl.config import prepare, read_config
from jaxbl.drive.plant import PlantState
from jaxbl.errors import InputError
from jaxbl.identification.compilation import jit
from jaxbl.identification.free_parameters import make_free_parameters, set_free_parameters
from jaxbl.identification.intervals import refusals, spread
from jaxbl.identification.smoother import smooth
from jaxbl.identification.trajectory import Fit, _Point, _solve, cut, fit
from jaxbl.simulate import plant_trajectory, replay

TRUE = {
    "drive.motor_inertia": 0.05,
    "drive.motor_viscous": 0.15,
    "drive.load_inertia": 7.0,
    "drive.load_viscous": 16.0,
    "transmission.stiffness": 60.0,
    "transmission.half_gap": 0.08,
}
RATIO = 5.0
PERIOD = 2e-3


def drive(substeps, period=PERIOD, **changes):
    law = {"law": "dead_zone", "stiffness": TRUE["transmission.stiffness"], "half_gap": TRUE["transmission.half_gap"]}
    settings = {"run.sample_period": period, "run.substeps": substeps, "run.duration": 0.1}
    return prepare(read_config(small(settings, transmission=law, **changes)))


def recorded(kind, samples, period=PERIOD):
    """Input and true states (positions and velocities of both sides) from SciPy, hard gap, input held over each sample."""
    t = period * np.arange(samples)
    torque = {
        "multisine": 2.0 * sum(np.sin(2.0 * np.pi * f * t + i) for i, f in enumerate((0.3, 0.7, 1.9, 4.1))),
        "steps": 6.0 * np.sign(np.sin(2.0 * np.pi * 0.9 * t + 0.1)),
        "chirp": 5.0 * np.sin(2.0 * np.pi * (0.4 + 0.6 * t) * t + 0.3),
    }[kind]
    j_e, f_e, j_s, f_s, k, gap = TRUE.values()

    def slope(_, x, u):
        z = x[0] - RATIO * x[2]
        c = k * (z - np.clip(z, -gap, gap))
        return [x[1], (u - f_e * x[1] - c) / j_e, x[3], (RATIO * c - f_s * x[3]) / j_s]

    states, x = np.zeros((samples, 4)), np.zeros(4)
    for i in range(samples):
        states[i] = x
        x = solve_ivp(slope, (0.0, period), x, "DOP853", args=(torque[i],), rtol=1e-10, atol=1e-13).y[:, -1]
    return torque, states


def windows_of(torque, readings, noise, samples, period=PERIOD):
    result = {side: smooth(values, period) for side, values in readings.items()}
    start = PlantState({s: x.position for s, x in result.items()}, {s: x.velocity for s, x in result.items()}, ())
    return cut(torque, readings, period, start, noise, samples)


def noisy(states, noise, key):
    keys = jax.random.split(key)
    return {
        side: states[:, 2 * i] + noise[side] * jax.random.normal(keys[i], (len(states),)) for i, side in enumerate(noise)
    }


def realisations(torque, states, noise, keys, samples, period=PERIOD):
    """Windows of one motion under several realisations of the noise, with a leading axis."""
    calls = {side: np.asarray(x) for side, x in jax.vmap(lambda key: noisy(states, noise, key))(keys).items()}
    # initial states are guessed by the first
    one = windows_of(torque, {side: x[0] for side, x in calls.items()}, noise, samples, period)
    tree = jax.tree.map(lambda x: np.broadcast_to(x, (len(keys), *np.shape(x))), one)
    return dataclasses.replace(tree, measured={side: x.reshape(len(keys), -1, samples) for side, x in calls.items()})


@jit
def _fits(experiment, free, windows, starts, steps):
    return jax.vmap(lambda one, start: fit(experiment, free, one, start, steps))(windows, starts)


@functools.cache
def fitted(kind):
    """Model, numbers, and 200 noise realisations with their fits in one vmapped run; the truth has a hard gap and another
    integrator."""
    experiment = drive(3)
    torque, states = map(jnp.asarray, recorded(kind, 600))
    free = make_free_parameters(experiment, list(TRUE), 1.0)
    keys = jax.random.split(jax.random.key(7), 200)
    windows = realisations(torque, states, {"motor": 3e-4, "load": 6e-5}, keys, 300)
    starts = 0.03 * jax.vmap(lambda key: jax.random.normal(jax.random.fold_in(key, 1), (len(free),)))(keys)
    return experiment, free, windows, _fits(experiment, free, windows, starts, 25)


def test_agrees_with_one_least_squares_problem_over_parameters_and_states():
    """SciPy's own over the parameters and the states of all windows at once, derivatives by JAX."""
    experiment, free, *each_ = fitted("multisine")
    windows, result = (jax.tree.map(lambda x: x[0], one) for one in each_)
    noise = windows.noise
    assert bool(result.converged)

    @jit
    def residual(pair):
        candidate = set_free_parameters(experiment, free, pair[:6])
        starts = pair[6:].reshape(2, 4)

        def one(x, u, motor, load):
            start = PlantState({"motor": x[0], "load": x[1]}, {"motor": x[2], "load": x[3]}, ())
            simulated = plant_trajectory(candidate, start, u).position
            return jnp.stack([(motor - simulated["motor"]) / noise["motor"], (load - simulated["load"]) / noise["load"]], -1)

        each_ = jax.vmap(one)(starts, windows.torque, windows.measured["motor"], windows.measured["load"])
        return jnp.concatenate([each_.ravel(), pair[:6] / 3.0])

    guess = windows.start
    first = np.stack([guess.position["motor"], guess.position["load"], guess.velocity["motor"], guess.velocity["load"]], -1)
    jacobian = jit(jax.jacfwd(residual))
    joint = least_squares(
        residual, np.concatenate([0.1 * np.ones(6), first.ravel()]), jacobian, method="lm", xtol=1e-12, ftol=1e-12
    )
    covariance = np.linalg.inv(joint.jac[:-6].T @ joint.jac[:-6])[:6, :6]
    deviation = np.sqrt(np.diag(covariance))
    assert np.abs((result.theta - joint.x[:6]) / deviation).max() < 0.02
    plain = np.linalg.inv(np.einsum("wtsp,wtsq->pq", result.jacobian, result.jacobian))
    np.testing.assert_allclose(np.sqrt(np.diag(plain)), deviation, rtol=0.02)


@pytest.mark.parametrize("kind", ["multisine", "steps"])
def test_intervals_cover_the_truth_as_often_as_they_say(kind):
    *_, result = fitted(kind)
    theta, covariance = (
        result.theta,
        np.stack([spread(jax.tree.map(lambda x, i=i: x[i], result)).covariance for i in range(200)]),
    )
    deviation = np.sqrt(np.einsum("rii->ri", covariance))
    covered = np.mean(np.abs(theta / deviation) < 1.96, axis=0)
    assert np.all((covered >= 0.92) & (covered <= 0.98)), covered
    # without bias, within what 200 runs can tell
    assert np.all(np.abs(np.mean(theta, axis=0)) < 4.0 * np.std(theta, axis=0) / np.sqrt(200.0))


def test_the_gap_at_1_khz_by_the_fit_and_by_the_chain_of_the_paper():
    """Noise of 1e-4 rad: half gap (4 j_0) within 0.5 % by the fit every time; 40 realisations each, hard gap by SciPy."""
    noise, period = {"motor": 1e-4, "load": 2e-5}, 1e-3
    torque, states = recorded("multisine", 4000, period)
    gains = {"motor": {"lambda": 20.0, "alpha": 400.0}, "load": {"lambda": 3.0, "alpha": 20.0}}
    tables = {"observer": gains, "equivalent_control": {"time_constant": 0.01}, "identifier": {"start": 0.5}}
    experiment = drive(3, period, **tables)
    free = make_free_parameters(experiment, list(TRUE), 1.0)

    def by_chain(key):
        def last(state, signals):
            return experiment.identifier.estimate(state.identifier, experiment.transmission)

        return replay(experiment, jnp.asarray(torque), noisy(states, noise, key), record=last, stride=len(torque) - 1)[1]

    keys = jax.random.split(jax.random.key(11), 40)
    windows = realisations(torque, states, noise, keys, 500, period)
    fitted = jnp.exp(_fits(experiment, free, windows, jnp.zeros((40, 6)), 20).theta) - 1.0
    assert np.abs(fitted[:, 5]).max() < 0.005, fitted[:, 5]
    chain = jax.tree.map(lambda x: x[:, -1], jit(jax.vmap(by_chain))(keys))
    size = {
        side: {name: float(jnp.sqrt(jnp.mean((chain[side][name] / true - 1.0) ** 2))) for name, true in
               (("stiffness", 60.0), ("half_gap", 0.08))} for side in chain
    }  # fmt: skip
    rms = np.sqrt(np.mean(fitted**2, axis=0))
    for side in size:
        # the chain is biased by what its low-pass and discretisation leave; the fit is not
        assert 3.0 * rms[4] < size[side]["stiffness"] < 0.05, (size, rms)
        assert 3.0 * rms[5] < size[side]["half_gap"] < 0.05, (size, rms)


def test_scales_that_one_record_cannot_part_are_refused():
    """Torque gain, inertia and friction scaled alike give the same motion."""
    effects = [{"kind": "actuator.gain_error", "relative": 0.0}, {"kind": "motor.coulomb_friction", "torque": 0.01}]
    experiment = prepare(read_config(rigid({"run.sample_period": PERIOD, "run.substeps": 1}, effects=effects)))
    t = PERIOD * np.arange(1000)
    torque = 0.1 * np.sin(9.0 * t) + 0.05 * np.sin(31.0 * t)
    state = experiment.plant.init(experiment.initial)
    simulated = plant_trajectory(experiment, state, jnp.asarray(torque)).position["motor"]
    readings = {"motor": simulated + 1e-5 * jax.random.normal(jax.random.key(2), (1000,))}
    paths = ["drive.motor_inertia", "drive.motor_viscous", "effects.motor.coulomb_friction.torque"]
    paths.append("effects.actuator.gain_error.relative")
    free = make_free_parameters(experiment, paths, 0.1)
    smoothed = smooth(readings["motor"], PERIOD)
    start = PlantState({"motor": smoothed.position}, {"motor": smoothed.velocity}, ((), ()))
    windows = cut(torque, readings, PERIOD, start, {"motor": 1e-5}, 250)
    result = jit(fit)(experiment, free, windows, jnp.zeros(len(free)))
    refused, condition = refusals(free, spread(result))
    assert condition > 1e4
    (direction,) = refused
    assert set(direction.direction) == set(paths)
    np.testing.assert_allclose(list(direction.direction.values()), 1.0, rtol=0.05)
    # without the gain's column
    known = np.arange(3)
    refused, condition = refusals(free[:3], spread(result.only(known)))
    assert refused == []
    assert condition < 1e3
    np.testing.assert_allclose(result.theta[known], np.log1p(result.theta[3]), rtol=0.0, atol=0.05)


def test_residual_correlation_widens_intervals():
    """Residuals of an AR(1) process on a constant regressor: the factor is known, (1 + rho) / (1 - rho) in variance."""
    rho, samples = 0.8, 20_000
    draws = np.random.default_rng(4).standard_normal(samples)
    residual = np.zeros(samples)
    for i in range(1, samples):
        residual[i] = rho * residual[i - 1] + draws[i]
    group = jnp.ones((10, samples // 10, 1, 1))
    plant_state = PlantState({"motor": jnp.zeros(10)}, {"motor": jnp.zeros(10)}, ())
    result = spread(
        Fit(jnp.zeros(1), plant_state, jnp.asarray(residual).reshape(10, -1, 1), group, jnp.zeros(()), jnp.ones(()))
    )
    np.testing.assert_allclose(result.inflation, np.sqrt((1.0 + rho) / (1.0 - rho)), rtol=0.1)
    white = spread(Fit(jnp.zeros(1), plant_state, jnp.asarray(draws).reshape(10, -1, 1), group, jnp.zeros(()), jnp.ones(())))
    np.testing.assert_allclose(white.inflation, 1.0, rtol=0.05)


@pytest.mark.parametrize(
    ("paths", "message"),
    [
        (["drive.motor_mass"], r"'drive\.motor_mass' is no number of the plant; fitted can be: drive\.motor_inertia, "),
        (["observer.motor.alpha"], r"'observer\.motor\.alpha' is no number of the plant"),
        (["drive.motor_inertia"] * 2, "'drive.motor_inertia' is named twice"),
        (["transmission.half_gap"], "'transmission.half_gap' must stay positive, and its nominal value is 0; give one"),
    ],
)
def test_what_cannot_be_fitted(paths, message):
    law = {"law": "dead_zone", "stiffness": 1.0, "half_gap": 0.0}
    with pytest.raises(InputError, match=message):
        make_free_parameters(read_config(small(transmission=law)).build(), paths, 1.0)


def test_the_solver_takes_the_steps_of_levenberg_and_marquardt():
    """Those of optimistix, on Rosenbrock's valley; steps that are rejected are counted."""

    def residual(theta, _=None):
        return jnp.array([10.0 * (theta[1] - theta[0] ** 2), 1.0 - theta[0]])

    def point(theta, guess):
        return _Point(residual(theta), jax.jacfwd(residual)(theta), guess, jnp.sum(residual(theta) ** 2)[None], ())

    start, nothing = jnp.array([-1.2, 1.0]), PlantState({}, {}, ())
    for steps in (2, 5, 9):
        solver = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-4)
        other = optx.least_squares(residual, solver, start, max_steps=steps, throw=False)
        solution = _solve(point, start, nothing, jnp.asarray(steps), 2)
        assert int(solution.steps) == steps
        np.testing.assert_allclose(solution.theta, other.value, rtol=1e-12)
    solution = _solve(point, start, nothing, jnp.asarray(100), 2)
    assert bool(solution.converged) and int(solution.steps) < 100
    np.testing.assert_allclose(solution.theta, 1.0, atol=1e-4)


def test_a_number_stays_within_what_a_study_may_say():
    """A fit may ask for more damping than the effect has."""
    damped = {"kind": "load.flexibility", "inertia": 0.01, "frequency": 5.0, "damping_ratio": 0.5}
    (one,) = make_free_parameters(drive(6, effects=[damped]), ["effects.load.flexibility.damping_ratio"], 1.0)
    assert one.value(0.1) == pytest.approx(0.5 * np.exp(0.1))
    assert float(one.value(1.0)) == float(one.value(jnp.asarray(1.0))) == 0.95
