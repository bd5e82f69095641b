"""The whole chain: the figures it has to reach, its noise, lanes, records, derivatives, and an independent copy of it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from paper_drive import DRIVE, paper_experiment
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.signal import lfilter

from jaxbl.chain import Reducer, initial_state, plant_trajectory, replay, scan, unit_noise
from jaxbl.drive import Encoders, Initial, Rigid, set_leaves
from jaxbl.drive.effects import ConstantTorque, CoulombFriction
from jaxbl.fused.compilation import jit
from jaxbl.observer import ExplicitSuperTwisting, ImplicitSuperTwisting, Observers
from jaxbl.sweeps.metrics import ALL_METRICS

SEED = jnp.asarray(3)


def record_signals(state, signals):
    return signals


@jit
def scan_metrics(experiment, seed=SEED):
    return scan(experiment, seed, (ALL_METRICS,))[0]


@jit
def run_whole(experiment, seed=SEED):
    """Figures and trace by one program."""
    return scan(experiment, seed, (ALL_METRICS,), record=record_signals)


draw_noise = jax.jit(unit_noise, static_argnums=2)


@jit
def scan_trace(experiment, seed=SEED, stride=1):
    return scan(experiment, seed, record=record_signals, stride=stride)[1]


def identification_errors(result):
    return {
        name: [abs(float(result[f"{side}.{name}"])) for side in ("motor", "load")]
        for name in ("stiffness_error", "dead_zone_error")
    }


def test_torque_of_the_implicit_observer_needs_no_low_pass():
    result, torque = jit(lambda e: scan(e, SEED, (ALL_METRICS,), record=lambda s, g: g.torque))(paper_experiment())
    rms = np.sqrt(np.mean(np.square(torque[15_000:])))
    assert result["motor.torque_rmse"] < 0.01 * rms
    assert result["load.torque_rmse"] < 0.01 * rms


@pytest.mark.parametrize(("discretisation", "time_constant"), [("implicit", 0.0), ("implicit", 0.02), ("explicit", 0.02)])
def test_stiffness_and_dead_zone_by_both_sides(discretisation, time_constant):
    errors = identification_errors(scan_metrics(paper_experiment(discretisation, time_constant=time_constant)))
    assert max(errors["stiffness_error"]) < 0.01
    assert max(errors["dead_zone_error"]) < 0.005


@pytest.mark.parametrize("discretisation", ["implicit", "explicit"])
def test_matched_regressor_beats_none_in_the_dead_zone(discretisation):
    matched, without = (
        identification_errors(scan_metrics(paper_experiment(discretisation, time_constant=0.02, regressor_filter=kind)))
        for kind in ("matched", "none")
    )
    for matched_error, paper_error in zip(matched["dead_zone_error"], without["dead_zone_error"], strict=True):
        assert 5.0 * matched_error < paper_error


def simulate_independently(experiment, noise, steps):
    """The implicit chain again, of SciPy's parts: integrator on the smooth law, root finder, filter, least squares."""
    h, time_constant, start = 1e-3, 0.01, 100
    je, fe, js, fs, n0 = 0.05, 0.15, 7.0, 16.0, 5.0

    def law(z):
        return z - 0.08 * (1.0 - np.exp(-20.0 * z)) / (1.0 + np.exp(-20.0 * z))

    def right(u):
        def f(t, s):
            c = law(s[0] - n0 * s[2])
            return [s[1], (u - c - fe * s[1]) / je, s[3], (n0 * c - fs * s[3]) / js]

        return f

    def correction(b, lambda_, alpha):
        reach = h * h * alpha
        if abs(b) <= reach:
            return 0.0, b / (h * h)
        size = brentq(lambda e: e + h * lambda_ * np.sqrt(e) + reach - abs(b), 0.0, abs(b), xtol=1e-18, rtol=1e-14)
        return np.sign(b) * size, np.sign(b) * alpha

    plant = np.array([0.05, -0.2, 0.004, 0.03])
    truth, measured, estimates = [], [], {"motor": [], "load": []}
    predicted = {"motor": [plant[0] - 0.01, plant[1] - 0.5], "load": [plant[2], plant[3]]}
    parts = {"motor": (4.0, 9.0, fe / je), "load": (0.5, 0.2, fs / js)}
    for i in range(steps):
        u = 0.1 * np.sin(2.0 * np.pi * 0.16 * i * h)
        truth.append(plant)
        measured.append(plant[[0, 2]] + np.array([1e-4, 2e-5]) * noise[i])
        for j, (side, (lambda_, alpha, damping)) in enumerate(parts.items()):
            drive = u / je if side == "motor" else 0.0
            x, v = predicted[side]
            e, z2 = correction(measured[-1][j] - x, lambda_, alpha)
            x, v = measured[-1][j] - e, v + h * z2
            estimates[side].append([x, v, z2])
            # nominal acceleration at the mean velocity over the coming step
            mean = drive - damping * (v + h * (z2 + 0.5 * (drive - damping * v)))
            predicted[side] = [x + h * (v + 0.5 * h * mean), v + h * mean]
        plant = solve_ivp(right(u), (0.0, h), plant, method="DOP853", rtol=1e-11, atol=1e-13).y[:, -1]
    truth, measured = np.array(truth), np.array(measured)
    share = -np.expm1(-h / time_constant)

    def low_pass(x):
        return lfilter([share], [1.0, share - 1.0], x, axis=0)

    z = measured[:, 0] - n0 * measured[:, 1]
    phi = low_pass(np.stack([z, -4.0 * np.tanh(10.0 * z)], 1))
    signals = {}
    for side, scale in (("motor", -je), ("load", js / n0)):
        estimate = np.array(estimates[side])
        torque = scale * low_pass(estimate[:, 2])
        # the equivalent control of a sample belongs to the twist of the one before
        theta, *_ = np.linalg.lstsq(phi[start - 1 : -1], torque[start:])
        signals[side] = estimate, torque, (theta[0], theta[1] / theta[0])
    return truth, measured, law(truth[:, 0] - n0 * truth[:, 2]), signals


def test_whole_trace_against_an_independent_copy():
    steps = 400
    experiment = paper_experiment(
        time_constant=0.01,
        start=0.1,
        steps=steps,
        initial=Initial(0.05, -0.2, 0.004, 0.03),
        encoders=Encoders(1e-4),
        observer=Observers(
            ImplicitSuperTwisting(4.0, 9.0, position_error=0.01, velocity_error=0.5), ImplicitSuperTwisting(0.5, 0.2)
        ),
    )
    result, signals = run_whole(experiment)
    noise = draw_noise(SEED, jnp.arange(steps), experiment.sides)
    truth, measured, torque, expected = simulate_independently(
        experiment, np.stack([noise["motor"], noise["load"]], 1), steps
    )
    np.testing.assert_allclose(signals.time, 1e-3 * np.arange(steps), rtol=1e-14)
    np.testing.assert_allclose(signals.input, 0.1 * np.sin(2.0 * np.pi * 0.16 * signals.time), rtol=1e-12)
    # the plant's own second order, at 0.1 ms, is what differs
    np.testing.assert_allclose(signals.torque, torque, atol=1e-9)
    np.testing.assert_allclose(signals.twist, measured[:, 0] - 5.0 * measured[:, 1], atol=1e-9)
    for j, side in enumerate(("motor", "load")):
        side_signals = signals.side(side)
        estimate, reconstructed, (stiffness, dead_zone) = expected[side]
        position, velocity = truth[:, 2 * j], truth[:, 2 * j + 1]
        np.testing.assert_allclose(side_signals.measured, measured[:, j], atol=1e-9)
        np.testing.assert_allclose(side_signals.true.position, position, atol=1e-9)
        np.testing.assert_allclose(side_signals.true.velocity, velocity, atol=1e-7)
        np.testing.assert_allclose(side_signals.true.acceleration[:-1], np.diff(velocity) / 1e-3, atol=2e-5)
        np.testing.assert_allclose(side_signals.position_estimate, estimate[:, 0], atol=1e-8)
        np.testing.assert_allclose(side_signals.velocity_estimate, estimate[:, 1], atol=1e-6)
        np.testing.assert_allclose(side_signals.torque_estimate, reconstructed, atol=1e-3 * np.abs(reconstructed).max())
        nominal = (signals.input if side == "motor" else 0.0) - DRIVE.viscous(side) * side_signals.velocity_estimate
        np.testing.assert_allclose(
            side_signals.true.perturbation, side_signals.true.acceleration - nominal / DRIVE.inertia(side), atol=1e-12
        )
        np.testing.assert_allclose(result[f"{side}.stiffness_error"], stiffness / 1.0 - 1.0, atol=1e-4)
        np.testing.assert_allclose(result[f"{side}.dead_zone_error"], dead_zone / 0.02 - 1.0, atol=1e-4)


def test_unit_noise_is_a_function_of_seed_and_index():
    sides = ("motor", "load")
    noise = draw_noise(SEED, jnp.arange(20_000), sides)
    part = draw_noise(SEED, jnp.arange(777, 1000), sides)
    for side in sides:
        np.testing.assert_array_equal(noise[side][777:1000], part[side])
        # standard normal: 5 sigma of mean, variance and kurtosis
        np.testing.assert_allclose(np.mean(noise[side]), 0.0, atol=5.0 / np.sqrt(2e4))
        np.testing.assert_allclose(np.var(noise[side]), 1.0, atol=5.0 * np.sqrt(2.0 / 2e4))
        np.testing.assert_allclose(np.mean(noise[side] ** 4), 3.0, atol=5.0 * np.sqrt(96.0 / 2e4))
        assert abs(np.corrcoef(noise[side][1:], noise[side][:-1])[0, 1]) < 5.0 / np.sqrt(2e4)
    assert abs(np.corrcoef(noise["motor"], noise["load"])[0, 1]) < 5.0 / np.sqrt(2e4)
    assert not np.any(np.asarray(draw_noise(jnp.asarray(4), jnp.arange(223), sides)["motor"]) == noise["motor"][:223])


def test_noise_is_the_same_in_runs_of_any_length_precision_and_level():
    def noise_of(steps, dtype, level):
        signals = scan_trace(paper_experiment(noise=level, steps=steps, substeps=1, dtype=dtype))
        return [
            np.asarray(signals.side(s).measured - signals.side(s).true.position, float) * gain / level
            for s, gain in (("motor", 1.0), ("load", 5.0))
        ]

    # a prime number of samples: two kinds of blocks
    reference = noise_of(523, jnp.float64, 1e-4)
    drawn = draw_noise(SEED, jnp.arange(523), ("motor", "load"))
    np.testing.assert_allclose(reference, [drawn["motor"], drawn["load"]], atol=1e-10)
    # a level at which float32 positions do not round it away
    shorter = noise_of(130, jnp.float32, 10.0)
    np.testing.assert_allclose(shorter, [side[:130] for side in reference], rtol=1e-5, atol=1e-5)


def lane_values(count):
    return {
        "observer.motor.alpha": jnp.linspace(2.0, 40.0, count),
        "observer.motor.lambda": jnp.linspace(1.0, 10.0, count),
        "encoders.noise": jnp.logspace(-6, -3, count),
        "transmission.dead_zone": jnp.linspace(0.0, 0.03, count),
    }


def test_lanes_equal_single_runs():
    """Also where a plant that no axis varies is simulated once for all lanes."""
    experiment = paper_experiment(time_constant=0.01, start=0.2, steps=600, velocity_error=0.5)
    for values in (lane_values(7), dict(list(lane_values(7).items())[:3])):
        lanes = jit(jax.vmap(lambda v: scan(set_leaves(experiment, v), SEED, (ALL_METRICS,))[0]))(values)
        for i in (0, 3, 6):
            single = scan_metrics(set_leaves(experiment, {path: value[i] for path, value in values.items()}))
            for name, value in single.items():
                # so short a run hardly determines the parameters: their rounding errors are magnified
                tolerance = 1e-5 if name.endswith(("stiffness_error", "dead_zone_error")) else 1e-6
                np.testing.assert_allclose(lanes[name][i], value, rtol=tolerance, atol=1e-9, err_msg=name)


def test_a_diverging_lane_leaves_its_neighbours_alone():
    experiment = paper_experiment(time_constant=0.01, start=0.1, steps=300, noise=1e-4)
    stiffness = jnp.asarray([1.0, 1e9, 2.0])
    run = jit(jax.vmap(lambda k: scan(set_leaves(experiment, {"transmission.stiffness": k}), SEED, (ALL_METRICS,))[0]))
    lanes, stable_lanes = run(stiffness), run(jnp.asarray([1.0, 1.5, 2.0]))
    np.testing.assert_array_equal(lanes["finite"], [True, False, True])
    assert np.all(stable_lanes["finite"])
    assert not lanes["motor.converged"][1]
    assert not lanes["load.converged"][1]
    for name, values in lanes.items():
        np.testing.assert_array_equal(values[::2], stable_lanes[name][::2], err_msg=name)


@pytest.mark.parametrize("discretisation", ["implicit", "explicit"])
def test_rigid_drive_observes_what_resists_beyond_the_model(discretisation):
    observer = {"implicit": ImplicitSuperTwisting, "explicit": ExplicitSuperTwisting}[discretisation]
    experiment = paper_experiment(
        time_constant=0.02,
        steps=4000,
        substeps=1,
        drive=Rigid(0.05, 0.15),
        transmission=None,
        identifier=None,
        effects=(ConstantTorque(0.015, side="motor"), CoulombFriction(0.02, side="motor")),
        observer=Observers(observer(4.0, 9.0)),
    )
    result, signals = run_whole(experiment)
    assert signals.load is None
    assert signals.twist is None
    moving = np.abs(signals.motor.true.velocity) > 0.02
    # 0.015 + 0.02 sign(v) resists, and nothing else
    resisting = 0.015 + 0.02 * np.sign(signals.motor.true.velocity)
    np.testing.assert_allclose(np.asarray(signals.torque)[moving], resisting[moving], atol=2e-4)
    # the median: friction jumps at each reversal
    error = np.median(np.abs(signals.motor.torque_estimate - signals.torque)[1000:])
    assert error < (1e-4 if discretisation == "implicit" else 2e-2)
    assert result["finite"]
    assert result["motor.converged"]
    assert not any(name.startswith("load.") or "stiffness" in name for name in result)


@pytest.mark.parametrize("stride", [7, 64, 100, 1000])
def test_record_keeps_every_so_many_samples(stride):
    experiment = paper_experiment(time_constant=0.01, noise=1e-4, steps=523, substeps=1)
    full, thin = scan_trace(experiment), scan_trace(experiment, stride=stride)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(y, x[::stride], rtol=1e-9, atol=1e-12), full, thin)


def test_reducers_see_every_sample_whatever_is_recorded():
    count = Reducer(
        lambda experiment: jnp.asarray(0),
        lambda experiment, carry, index, signals: carry + index,
        lambda experiment, carry, state: {"sum": carry},
    )
    experiment = paper_experiment(steps=523, substeps=1)
    for record, stride in ((None, 1), (record_signals, 10)):
        out, _ = jit(lambda e, record=record, stride=stride: scan(e, SEED, (count,), record, stride))(experiment)
        assert out == {"sum": 523 * 522 // 2}


@pytest.mark.parametrize("discretisation", ["implicit", "explicit"])
def test_derivatives_through_the_run(discretisation):
    """Forward and reverse, finite from the first sample, where every error is zero, and right on the plant."""
    experiment = paper_experiment(discretisation, time_constant=0.01, steps=200, substeps=2)

    def run(stiffness):
        signals = scan(set_leaves(experiment, {"transmission.stiffness": stiffness}), SEED, record=record_signals)[1]
        motor = signals.motor
        return motor.true.position, motor.position_estimate, motor.velocity_estimate, motor.torque_estimate

    unit = jnp.asarray(1.0)
    differentiate = jit(lambda stiffness: jax.jvp(run, (stiffness,), (unit,)))
    _, slopes = differentiate(unit)
    assert all(np.all(np.isfinite(slope)) for slope in slopes)
    change = (differentiate(unit + 1e-5)[0][0] - differentiate(unit - 1e-5)[0][0]) / 2e-5
    np.testing.assert_allclose(slopes[0], change, rtol=1e-5, atol=1e-12)
    gradient = jit(jax.grad(lambda k: run(k)[0][-1] + run(k)[2][-1]))(unit)
    np.testing.assert_allclose(gradient, slopes[0][-1] + slopes[2][-1], rtol=1e-9)


def test_one_compilation_serves_all_values():
    traces = 0

    def count_and_scan(experiment):
        nonlocal traces
        traces += 1
        return scan(experiment, SEED)[0]

    compiled = jit(count_and_scan)
    for noise in (0.0, 1e-4, 1e-3):
        compiled(paper_experiment(noise=noise, steps=64, substeps=1))
    assert traces == 1


@pytest.mark.parametrize(("stride", "missed"), [(1, None), (7, None), (1, 0.2)])
def test_a_replayed_record_gives_what_the_observers_gave(stride, missed):
    experiment = paper_experiment(noise=1e-4, start=0.1, steps=700)
    encoders = dataclasses.replace(experiment.encoders, missed=None if missed is None else jnp.asarray(missed))
    experiment = dataclasses.replace(experiment, encoders=encoders)
    signals = scan_trace(experiment)
    measured = {side: signals.side(side).measured for side in experiment.sides}
    run = jit(lambda *columns: replay(*columns, record=record_signals, stride=stride, state=initial_state(experiment)))
    _, replayed = run(experiment, signals.input, measured)
    for side in experiment.sides:
        replayed_side, original_side = replayed.side(side), signals.side(side)
        np.testing.assert_allclose(
            replayed_side.velocity_estimate, original_side.velocity_estimate[::stride], rtol=1e-12, atol=1e-12
        )
        np.testing.assert_allclose(
            replayed_side.torque_estimate, original_side.torque_estimate[::stride], rtol=1e-12, atol=1e-12
        )
        assert replayed_side.true is None
    np.testing.assert_allclose(replayed.time, signals.time[::stride])


def test_what_observers_are_told_is_not_in_their_equivalent_control():
    experiment = paper_experiment(noise=0.0, steps=2000)
    signals = scan_trace(experiment)
    measured = {side: signals.side(side).measured for side in experiment.sides}
    # of the true acceleration, its mean over each sampling period
    perturbations = {side: signals.side(side).true.perturbation for side in experiment.sides}
    run = jit(
        lambda *columns: replay(
            *columns, record=record_signals, state=initial_state(experiment), added_accelerations=perturbations
        )
    )
    _, with_perturbations = run(experiment, signals.input, measured)
    for side in experiment.sides:
        plain = signals.side(side).equivalent_control[500:]
        assert np.std(with_perturbations.side(side).equivalent_control[500:]) < 0.02 * np.std(plain)


def test_a_trajectory_is_the_plant_of_the_whole_chain():
    experiment = paper_experiment(steps=300)
    signals = scan_trace(experiment)
    states = jit(lambda u: plant_trajectory(experiment, experiment.plant.init(experiment.initial), u))(signals.input)
    for side in experiment.sides:
        np.testing.assert_allclose(states.position[side], signals.side(side).true.position, rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(states.velocity[side], signals.side(side).true.velocity, rtol=1e-12, atol=1e-14)
