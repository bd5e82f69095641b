"""Equations of motion at known kinematics: exact ones leave nothing over, whatever the law and the effects."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from filtered_derivatives import differentiate
from inverse_dynamics import regress
from measured import EMPS, find_recording
from scipy import signal
from small_study import rigid_study, small_study

from jaxbl.config import prepare, read_config
from jaxbl.estimation.free_parameters import make_free_parameters, set_free_parameters
from jaxbl.estimation.identification_summary import torque_errors
from jaxbl.estimation.intervals import interval, spread
from jaxbl.estimation.regression import (
    Kinematics,
    balance,
    decimate,
    model_torques,
)
from jaxbl.estimation.segments import segments_of
from jaxbl.records import read_record

T = jnp.linspace(0.0, 2.0, 4001)
LAW = {"law": "dead_zone", "stiffness": 60.0, "half_gap": 0.08}


def sine_motion(amplitude, rate):
    return (
        {"motor": amplitude[0] * jnp.sin(rate[0] * T), "load": amplitude[1] * jnp.sin(rate[1] * T)},
        {"motor": amplitude[0] * rate[0] * jnp.cos(rate[0] * T), "load": amplitude[1] * rate[1] * jnp.cos(rate[1] * T)},
        {
            "motor": -amplitude[0] * rate[0] ** 2 * jnp.sin(rate[0] * T),
            "load": -amplitude[1] * rate[1] ** 2 * jnp.sin(rate[1] * T),
        },
    )


def test_balance_is_the_equations_of_motion():
    """Against (1)-(2) written out, with friction, gravity and a damped shaft."""
    effects = [
        {"kind": "motor.coulomb_friction", "torque": 0.3},
        {"kind": "load.gravity", "torque": 2.0, "phase": 0.1},
        {"kind": "transmission.damping", "damping": 0.5},
        {"kind": "load.inertia", "inertia": 0.7},
        {"kind": "actuator.gain_error", "relative": 0.1},
    ]
    experiment = prepare(read_config(small_study(transmission=LAW, effects=effects)))
    position, velocity, acceleration = sine_motion((1.0, 0.2), (5.0, 4.0))
    u = jnp.cos(3.0 * T)
    result = balance(experiment, Kinematics(T, u, position, velocity, acceleration))
    ratio = experiment.drive.gear_ratio
    z, rate = position["motor"] - ratio * position["load"], velocity["motor"] - ratio * velocity["load"]
    touching = jnp.abs(z) > 0.08
    c = touching * (60.0 * (z - jnp.sign(z) * 0.08) + 0.5 * rate)
    j_e, f_e, j_s, f_s = (
        getattr(experiment.drive, n) for n in ("motor_inertia", "motor_viscous", "load_inertia", "load_viscous")
    )
    motor = 1.1 * u - c - f_e * velocity["motor"] - 0.3 * jnp.sign(velocity["motor"]) - j_e * acceleration["motor"]
    load = ratio * c - f_s * velocity["load"] - 2.0 * jnp.sin(position["load"] - 0.1) - (j_s + 0.7) * acceleration["load"]
    np.testing.assert_allclose(result["motor"].residual, motor, atol=1e-10)
    np.testing.assert_allclose(result["load"].residual, load, atol=1e-9)
    np.testing.assert_allclose(result["motor"].drive, 1.1 * u)
    np.testing.assert_allclose(result["load"].drive, ratio * c, atol=1e-9)
    # a measured torque takes the place of the law's, and has an equation of its own
    measured = c + 0.01
    with_it = balance(experiment, Kinematics(T, u, position, velocity, acceleration, measured))
    np.testing.assert_allclose(with_it["transmission"].residual, 0.01, atol=1e-9)
    np.testing.assert_allclose(with_it["motor"].residual, motor - 0.01, atol=1e-9)
    torques = model_torques(
        experiment, Kinematics(T, u, position, velocity, acceleration), {s: jnp.full_like(T, 1e-9) for s in velocity}
    )
    np.testing.assert_allclose(torques["torque"], c, atol=1e-9)
    moving = jnp.abs(velocity["motor"]) > 1e-6
    np.testing.assert_allclose(
        (torques["motor.effects"] - 0.3 * jnp.sign(velocity["motor"]) + 0.1 * u)[moving], 0.0, atol=1e-9
    )
    np.testing.assert_allclose(
        torques["load.effects"], 2.0 * jnp.sin(position["load"] - 0.1) + 0.7 * acceleration["load"], atol=1e-9
    )


def test_a_lag_of_the_actuator_is_followed():
    effects = [{"kind": "actuator.lag", "time_constant": 0.05}]
    experiment = prepare(read_config(rigid_study({"run.sample_period": 5e-4}, effects=effects)))
    still = {"motor": jnp.zeros_like(T)}
    result = balance(experiment, Kinematics(T, jnp.ones_like(T), still, still, still, before=jnp.zeros(1)))
    np.testing.assert_allclose(result["motor"].residual, 1.0 - jnp.exp(-T / 0.05), atol=0.011)


@pytest.mark.parametrize("factor", [1, 4, 10])
def test_decimation_keeps_what_is_slow(factor):
    slow, fast = np.sin(2.0 * np.pi * 2.0 * T), 0.3 * np.sin(2.0 * np.pi * 900.0 * T)
    decimated = decimate(jnp.asarray(slow + fast), factor)
    edge = 0 if factor == 1 else 10 * factor
    expected = (slow + (fast if factor == 1 else 0.0))[edge : len(T) - edge : factor]
    np.testing.assert_allclose(decimated, expected, atol=2e-3)
    reference = signal.decimate(np.asarray(slow), factor, ftype="fir") if factor > 1 else slow
    np.testing.assert_allclose(decimate(jnp.asarray(slow), factor)[5:-5].mean(), np.mean(reference), atol=0.02)


def geared_record(noise, seed=0):
    """The equations of (1) integrated by jaxbl's plant would be no test: forces are computed for a prescribed motion."""
    random = np.random.default_rng(seed)
    t = 1e-3 * np.arange(8000)
    load = 0.4 * np.sin(4.0 * t) + 0.2 * np.sin(9.1 * t + 1.0)
    v = 1.6 * np.cos(4.0 * t) + 1.82 * np.cos(9.1 * t + 1.0)
    a = -6.4 * np.sin(4.0 * t) - 16.562 * np.sin(9.1 * t + 1.0)
    c = (7.0 * a + 16.0 * v) / 5.0
    z = c / 60.0 + 0.08 * np.sign(c)  # the gap is crossed at once
    return t, load, z, c, random


def test_a_measured_torque_gives_stiffness_and_gap_directly():
    """No observer: torque over twist. The truth is a hard gap; 40 realisations of the noise."""
    t, load, z, c, random = geared_record(1e-4)
    experiment = prepare(read_config(small_study(transmission=LAW | {"stiffness": 40.0, "half_gap": 0.06})))
    free = make_free_parameters(experiment, ["transmission.stiffness", "transmission.half_gap"], 1.0)
    in_contact = np.abs(c) > 0.5
    hits = np.zeros(2)
    for _ in range(40):
        position = {"motor": jnp.asarray(z + 5.0 * load), "load": jnp.asarray(load)}
        none = {side: jnp.zeros_like(x) for side, x in position.items()}
        measured = c + 0.05 * random.standard_normal(len(t))
        part = Kinematics(jnp.asarray(t), jnp.zeros(len(t)), position, none, none, jnp.asarray(measured))
        part = jax.tree.map(lambda x: x[in_contact], part)
        result = regress(experiment, free, [part], 1)
        width = spread(result)
        for i, true in enumerate((60.0, 0.08)):
            low, high = interval(free[i], float(result.theta[i]), float(jnp.sqrt(width.covariance[i, i])))
            hits[i] += low <= true <= high
            assert (high - low) < 0.01 * true
    assert np.all(hits >= 34), hits


def test_emps_by_the_published_method_and_measure():
    """Values and errors of Janot, Gautier, Brunot (2019): 4.08 % on the estimation record, 5.4 % on the other."""
    study = rigid_study(
        {"drive.motor_inertia": 80.0, "drive.motor_viscous": 150.0, "run.sample_period": 1e-3},
        effects=[{"kind": "motor.coulomb_friction", "torque": 15.0}, {"kind": "motor.constant_torque", "torque": 0.0}],
        log=EMPS,
    )
    config = read_config(study)
    experiment = prepare(config)
    paths = ["drive.motor_inertia", "drive.motor_viscous", "effects.motor.coulomb_friction.torque",
             "effects.motor.constant_torque.torque"]  # fmt: skip
    free = make_free_parameters(experiment, paths, 50.0)
    records = [read_record(find_recording(f"emps/DATA_EMPS{name}.mat"), config.log) for name in ("", "_PULSES")]
    parts = [differentiate(r.time, r.torque, r.positions, 100.0) for r in records]
    result = regress(experiment, free, parts[:1], 10)
    values = [float(number.value(result.theta[i])) for i, number in enumerate(free)]
    np.testing.assert_allclose(values, [95.1, 205.7, 20.2, -3.17], rtol=0.03)
    fitted = set_free_parameters(experiment, free, result.theta)
    assert torque_errors(records[0], fitted, parts[:1], 10)["motor"]["relative"] < 0.042
    assert torque_errors(records[1], fitted, parts[1:], 10)["motor"]["relative"] < 0.054
    # the smoother in place of the filter says the same
    (segment, *_) = segments_of(records[0], ["motor"])
    assert torque_errors(records[0], fitted, [segment.kinematics], 10)["motor"]["relative"] < 0.042
