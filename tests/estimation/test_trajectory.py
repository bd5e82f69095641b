"""Trajectory fits against truth from another integrator, and against one joint least-squares problem by SciPy."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hidden.simulator import Machine, Run, simulate
from hidden_log import GAP, GEARED
from scipy.optimize import least_squares
from small_study import rigid_study, small_study
from trace_segment import cut

from jaxbl.chain import plant_trajectory
from jaxbl.config import prepare, read_config
from jaxbl.drive.plant import PlantState
from jaxbl.errors import InputError
from jaxbl.estimation.free_parameters import SignalSizes, make_free_parameters, set_free_parameters
from jaxbl.estimation.intervals import refusals, spread
from jaxbl.estimation.smoother import smooth
from jaxbl.estimation.trajectory import Fit, fit
from jaxbl.fused.compilation import jit

TRUE = {
    "drive.motor_inertia": 0.05,
    "drive.motor_viscous": 0.15,
    "drive.load_inertia": 7.0,
    "drive.load_viscous": 16.0,
    "transmission.stiffness": 60.0,
    "transmission.half_gap": 0.08,
}
PERIOD = 2e-3
LANES, WINDOWS, SAMPLES = 100, 4, 300
"""Realisations of the noise, and the windows of each: all fits of two sides share their program."""


def prepare_drive(substeps, period=PERIOD, **changes):
    law = {"law": "dead_zone", "stiffness": TRUE["transmission.stiffness"], "half_gap": TRUE["transmission.half_gap"]}
    settings = {"run.sample_period": period, "run.substeps": substeps, "run.duration": 50 * period}
    return prepare(read_config(small_study(settings, transmission=law, **changes)))


def simulate_motion(kind, samples, period=PERIOD):
    """Return input and true states (of both sides) by the bench's simulator: hard gap, input held over each sample."""
    t = period * np.arange(samples)
    torque = {
        "multisine": 2.0 * sum(np.sin(2.0 * np.pi * f * t + i) for i, f in enumerate((0.3, 0.7, 1.9, 4.1))),
        "steps": 6.0 * np.sign(np.sin(2.0 * np.pi * 0.9 * t + 0.1)),
    }[kind]
    (trace,) = simulate([Run(Machine(GEARED, GAP), period, torque)])
    return torque, trace.states.T


def cut_windows(torque, readings, noise, samples, period=PERIOD):
    motions = {side: smooth(values, period) for side, values in readings.items()}
    start = PlantState({s: x.state[:, 0] for s, x in motions.items()}, {s: x.velocity for s, x in motions.items()}, ())
    return cut(torque, readings, period, start, noise, samples)


def add_noise(states, noise, key):
    keys = jax.random.split(key)
    return {
        side: states[:, 2 * i] + noise[side] * jax.random.normal(keys[i], (len(states),)) for i, side in enumerate(noise)
    }


def fit_lanes(experiment, torque, states, noise, period=PERIOD):
    """Return numbers, windows under several realisations of the noise, with a leading axis, and their fits."""
    free = make_free_parameters(experiment, list(TRUE), 1.0)
    keys = jax.random.split(jax.random.key(7), LANES)
    states = jnp.asarray(states)
    readings = {side: np.asarray(x) for side, x in jax.vmap(lambda key: add_noise(states, noise, key))(keys).items()}
    # initial states are guessed by the first
    first = cut_windows(torque, {side: x[0] for side, x in readings.items()}, noise, SAMPLES, period)
    windows = jax.tree.map(lambda x: np.broadcast_to(x, (LANES, *np.shape(x))), first)
    measured = {side: x.reshape(LANES, WINDOWS, SAMPLES) for side, x in readings.items()}
    windows = dataclasses.replace(windows, measured=measured)
    starts = 0.03 * jax.vmap(lambda key: jax.random.normal(jax.random.fold_in(key, 1), (len(free),)))(keys)
    lanes = [jax.tree.map(lambda leaf, i=i: leaf[i], windows) for i in range(LANES)]
    ends = [fit(experiment, free, lane, np.asarray(start), 25) for lane, start in zip(lanes, starts, strict=True)]
    return free, windows, jax.tree.map(lambda *leaves: np.stack(leaves), *ends)


@functools.cache
def fit_motion(kind):
    """Return model, numbers, windows and fits; the truth has a hard gap and another integrator."""
    experiment = prepare_drive(3)
    return experiment, *fit_lanes(experiment, *simulate_motion(kind, WINDOWS * SAMPLES), {"motor": 3e-4, "load": 6e-5})


def test_agrees_with_one_least_squares_problem_over_parameters_and_states():
    """SciPy's own over the parameters and the states of all windows at once, derivatives by differences."""
    experiment, free, *lanes = fit_motion("multisine")
    windows, first = (jax.tree.map(lambda x: x[0], tree) for tree in lanes)
    noise = windows.noise
    assert bool(first.converged)

    @jit
    def residual(numbers):
        candidate = set_free_parameters(experiment, free, numbers[:6])
        starts = numbers[6:].reshape(WINDOWS, 4)

        def window_residual(x, u, motor, load):
            start = PlantState({"motor": x[0], "load": x[1]}, {"motor": x[2], "load": x[3]}, ())
            simulated = plant_trajectory(candidate, start, u).position
            return jnp.stack([(motor - simulated["motor"]) / noise["motor"], (load - simulated["load"]) / noise["load"]], -1)

        residuals = jax.vmap(window_residual)(starts, windows.torque, windows.measured["motor"], windows.measured["load"])
        return jnp.concatenate([residuals.ravel(), numbers[:6] / 3.0])

    guess = windows.start
    states = np.stack([guess.position["motor"], guess.position["load"], guess.velocity["motor"], guess.velocity["load"]], -1)
    start = np.concatenate([0.1 * np.ones(6), states.ravel()])
    joint = least_squares(residual, start, method="lm")
    covariance = np.linalg.inv(joint.jac[:-6].T @ joint.jac[:-6])[:6, :6]
    deviation = np.sqrt(np.diag(covariance))
    assert np.abs((first.theta - joint.x[:6]) / deviation).max() < 0.02
    plain = np.linalg.inv(np.einsum("wtsp,wtsq->pq", first.jacobian, first.jacobian))
    np.testing.assert_allclose(np.sqrt(np.diag(plain)), deviation, rtol=0.02)


@pytest.mark.parametrize("kind", ["multisine", "steps"])
def test_intervals_are_as_wide_as_errors_are_large(kind):
    """An error is 1 standard deviation rms, which 100 runs tell to 7 %; 95 of 100 lie within 1.96."""
    *_, fits = fit_motion(kind)
    theta = np.asarray(fits.theta)
    covariance = np.stack([spread(jax.tree.map(lambda x, i=i: x[i], fits)).covariance for i in range(LANES)])
    scores = theta / np.sqrt(np.einsum("rii->ri", covariance))
    np.testing.assert_allclose(np.sqrt(np.mean(scores**2, axis=0)), 1.0, atol=0.15)
    covered = np.mean(np.abs(scores) < 1.96, axis=0)
    assert np.all(covered >= 0.9), covered
    # without bias, within what the runs can tell
    assert np.all(np.abs(np.mean(theta, axis=0)) < 4.0 * np.std(theta, axis=0) / np.sqrt(LANES))


def test_the_gap_at_1_khz():
    """Noise of 1e-4 rad, 1.2 s, a hard gap: half gap (4 j_0) within 0.5 % every time."""
    period = 1e-3
    motion = simulate_motion("multisine", WINDOWS * SAMPLES, period)
    *_, fits = fit_lanes(prepare_drive(3, period), *motion, {"motor": 1e-4, "load": 2e-5}, period)
    errors = np.expm1(fits.theta)
    assert np.abs(errors[:, 5]).max() < 0.005, errors[:, 5]


def test_scales_that_one_record_cannot_part_are_refused():
    """Torque gain, inertia and friction scaled alike give the same motion."""
    effects = [{"kind": "actuator.gain_error", "relative": 0.0}, {"kind": "motor.coulomb_friction", "torque": 0.01}]
    experiment = prepare(read_config(rigid_study({"run.sample_period": PERIOD, "run.substeps": 1}, effects=effects)))
    t = PERIOD * np.arange(1000)
    torque = 0.1 * np.sin(9.0 * t) + 0.05 * np.sin(31.0 * t)
    state = experiment.plant.init(experiment.initial)
    simulated = jit(plant_trajectory)(experiment, state, jnp.asarray(torque)).position["motor"]
    readings = {"motor": simulated + 1e-5 * jax.random.normal(jax.random.key(2), (1000,))}
    paths = ["drive.motor_inertia", "drive.motor_viscous", "effects.motor.coulomb_friction.torque"]
    paths.append("effects.actuator.gain_error.relative")
    free = make_free_parameters(experiment, paths, 0.1)
    smoothed = smooth(readings["motor"], PERIOD)
    start = PlantState({"motor": smoothed.state[:, 0]}, {"motor": smoothed.velocity}, ((), ()))
    windows = cut(torque, readings, PERIOD, start, {"motor": 1e-5}, 250)
    result = fit(experiment, free, windows, np.zeros(len(free)))
    refused, condition = refusals(free, spread(result))
    assert condition > 1e4
    (direction,) = refused
    assert set(direction.direction) == set(paths)
    np.testing.assert_allclose(list(direction.direction.values()), 1.0, rtol=0.05)
    # without the gain's column
    columns = np.arange(3)
    refused, condition = refusals(free[:3], spread(result._replace(jacobian=result.jacobian[..., columns])))
    assert refused == []
    assert condition < 1e3
    np.testing.assert_allclose(result.theta[columns], np.log1p(result.theta[3]), rtol=0.0, atol=0.05)


def test_residual_correlation_widens_intervals():
    """Residuals of an AR(1) process on a constant regressor: the factor is known, (1 + rho) / (1 - rho) in variance."""
    rho, samples = 0.8, 20_000
    draws = np.random.default_rng(4).standard_normal(samples)
    residual = np.zeros(samples)
    for i in range(1, samples):
        residual[i] = rho * residual[i - 1] + draws[i]
    group = np.ones((10, samples // 10, 1, 1))
    plant_state = PlantState({"motor": jnp.zeros(10)}, {"motor": jnp.zeros(10)}, ())
    result = spread(Fit(np.zeros(1), plant_state, residual.reshape(10, -1, 1), group, True))
    np.testing.assert_allclose(result.inflation, np.sqrt((1.0 + rho) / (1.0 - rho)), rtol=0.1)
    white = spread(Fit(np.zeros(1), plant_state, draws.reshape(10, -1, 1), group, True))
    np.testing.assert_allclose(white.inflation, 1.0, rtol=0.05)


@pytest.mark.parametrize(
    ("paths", "message"),
    [
        (["drive.motor_mass"], r"'drive\.motor_mass' is no number of the plant; fitted can be: drive\.motor_inertia, "),
        (["observer.motor.alpha"], r"'observer\.motor\.alpha' is no number of the plant"),
        (["drive.motor_inertia"] * 2, "'drive.motor_inertia' is named twice"),
    ],
)
def test_what_cannot_be_fitted(paths, message):
    with pytest.raises(InputError, match=message):
        make_free_parameters(read_config(small_study()).build(), paths, 1.0)


def test_what_is_nominally_0_gets_its_size_from_the_log():
    law = {"law": "dead_zone", "stiffness": 1.0, "half_gap": 0.0}
    effects = [{"kind": "load.coulomb_friction", "torque": 0.0}, {"kind": "load.gravity", "torque": 0.0}]
    changes = {"drive.motor_viscous": 0.0, "drive.load_viscous": 0.0, "drive.gear_ratio": 5.0}
    expected = {
        "drive.motor_viscous": 0.2 / 4.0,
        "drive.load_viscous": 25.0 * 0.2 / 4.0,
        "effects.load.coulomb_friction.torque": 5.0 * 0.2,
        "effects.load.gravity.torque": 5.0 * 0.2,
        "transmission.half_gap": 0.03,
    }
    experiment = read_config(small_study(changes, transmission=law, effects=effects)).build()
    free = make_free_parameters(experiment, list(expected), SignalSizes(torque=0.2, speed=4.0, twist=0.03))
    np.testing.assert_allclose([one.scale for one in free], list(expected.values()))
    # a fit goes through 0; what it tells does not, where a study may not
    np.testing.assert_array_equal([one.value(0.0) for one in free], 0.0)
    assert [float(one.value(-0.1)) < 0.0 for one in free] == [one.path.startswith("effects.load.gravity") for one in free]
    assert all(float(one.value(jnp.asarray(-0.1))) < 0.0 for one in free)
    assert [one.theta(float(one.value(0.3))) for one in free] == pytest.approx([0.3] * len(free))


def test_a_number_stays_within_what_a_study_may_say():
    """A fit may ask for more damping than the effect has."""
    damped = {"kind": "load.flexibility", "inertia": 0.01, "frequency": 5.0, "damping_ratio": 0.5}
    (damping_ratio,) = make_free_parameters(
        prepare_drive(6, effects=[damped]), ["effects.load.flexibility.damping_ratio"], 1.0
    )
    assert damping_ratio.value(0.1) == pytest.approx(0.5 * np.exp(0.1))
    assert float(damping_ratio.value(1.0)) == float(damping_ratio.value(jnp.asarray(1.0))) == 0.95
