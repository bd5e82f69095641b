"""Who differentiates through what has no useful derivative is told so once; values and other derivatives are as before."""

import dataclasses
import logging

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbl
from jaxbl import chain, gradients
from jaxbl.drive import make_effect
from jaxbl.drive.parameters import get_leaf
from jaxbl.observer.super_twisting import ImplicitSuperTwisting

SWITCHING = ImplicitSuperTwisting(30.0, 400.0)
LOOP = {
    "controller": jaxbl.Cascade(8.0, 2.0, integral_time=0.1, torque_limit=20.0, side="load"),
    "reference": jaxbl.StepsReference(0.0, 1.0),
}


def make_experiment(noise=1e-5, motor=None, **tables):
    linear = jaxbl.ExtendedState(300.0)
    return jaxbl.experiment(
        jaxbl.Experiment(
            drive=jaxbl.TwoInertia(0.05, 0.15, 1.0, 2.0, 5.0),
            transmission=jaxbl.DeadZone(60.0, 0.08),
            encoders=jaxbl.Encoders(noise),
            excitation=lambda time: jnp.sin(5.0 * time),
            observer=jaxbl.Observers(motor or linear, linear),
            run=jaxbl.Run(steps=100),
            **tables,
        )
    )


def mean_speed(experiment):
    return jnp.mean(jaxbl.simulate(experiment).motor.velocity_estimate ** 2)


def own_loop(experiment):
    def advance(carry, sample):
        state, torque = carry
        state, signals = jaxbl.step(experiment, state, sample._replace(input=torque))
        return (state, 2.0 * (1.0 - signals.motor.velocity_estimate)), signals.motor.velocity_estimate

    start = jaxbl.initial_state(experiment), jnp.zeros(())
    return jnp.mean(jax.lax.scan(advance, start, jaxbl.samples(experiment))[1])


def on_a_record(experiment):
    positions = {side: jnp.linspace(0.0, 1.0, 50) for side in ("motor", "load")}
    return jnp.mean(jaxbl.observe(experiment, jnp.zeros(50), positions).motor.velocity_estimate)


def errors(experiment):
    return sum(jaxbl.metrics(experiment, names=("velocity_rmse",)).values())


SUPER_TWISTING, FED_BACK = "the super-twisting observer of the motor", "a gap or dry friction with noise fed back"
CASES = {
    "linear observer": (mean_speed, make_experiment(), "observer.motor.bandwidth", ""),
    "gap in open loop": (mean_speed, make_experiment(), "transmission.half_gap", ""),
    "super-twisting": (mean_speed, make_experiment(motor=SWITCHING), "observer.motor.alpha", SUPER_TWISTING),
    "drive under it": (errors, make_experiment(motor=SWITCHING), "drive.motor_inertia", SUPER_TWISTING),
    "other side": (mean_speed, make_experiment(motor=SWITCHING), "observer.load.bandwidth", ""),
    "filter behind it": (mean_speed, make_experiment(motor=SWITCHING), "equivalent_control.time_constant", ""),
    "closed loop": (mean_speed, make_experiment(**LOOP), "controller.speed_gain", FED_BACK),
    "closed loop without noise": (mean_speed, make_experiment(0.0, **LOOP), "controller.speed_gain", ""),
    "own loop": (own_loop, make_experiment(), "observer.motor.bandwidth", FED_BACK),
    "own loop without noise": (own_loop, make_experiment(0.0), "observer.motor.bandwidth", ""),
    "own loop, super-twisting": (own_loop, make_experiment(0.0, SWITCHING), "observer.motor.alpha", SUPER_TWISTING),
    "record": (on_a_record, make_experiment(motor=SWITCHING), "observer.motor.alpha", SUPER_TWISTING),
}


@pytest.mark.parametrize("name", CASES)
def test_what_means_nothing_is_told_once(name, caplog):
    function, experiment, path, reason = CASES[name]
    gradients._warn.cache_clear()
    start = float(get_leaf(experiment, path))

    def at(value):
        return function(jaxbl.with_values(experiment, {path: value}))

    with caplog.at_level(logging.WARNING, "jaxbl"):
        slope = jax.grad(at)(start)
        assert np.isfinite(slope)
        np.testing.assert_allclose(jax.jit(jax.jacfwd(at))(start), slope, rtol=1e-6, atol=1e-12)
    told = [record.getMessage() for record in caplog.records]
    assert len(told) == bool(reason)
    assert all(f"a derivative through {reason} means nothing" in line and "\n" not in line for line in told)


def test_without_a_derivative_nothing_is_said_and_nothing_changes(caplog):
    experiment = make_experiment(motor=SWITCHING, **LOOP)
    gradients._warn.cache_clear()
    with caplog.at_level(logging.WARNING, "jaxbl"):
        gaps = jnp.linspace(0.0, 0.1, 3)
        jax.vmap(lambda gap: mean_speed(jaxbl.with_values(experiment, {"transmission.half_gap": gap})))(gaps)
        state, sample = jaxbl.initial_state(experiment), jax.tree.map(lambda column: column[0], jaxbl.samples(experiment))
        steps = [jax.jit(step)(experiment, state, sample) for step in (jaxbl.step, chain.step)]
    assert not caplog.records
    for new, old in zip(*map(jax.tree.leaves, steps), strict=True):
        np.testing.assert_array_equal(new, old)


def test_dry_friction_counts_as_a_gap(caplog):
    friction = make_effect("load.coulomb_friction", torque=0.1)
    experiment = dataclasses.replace(make_experiment(**LOOP), transmission=jaxbl.LinearShaft(60.0))
    for effects, count in (((), 0), ((friction,), 1)):
        caplog.clear()
        gradients._warn.cache_clear()
        rough = dataclasses.replace(experiment, effects=effects)
        with caplog.at_level(logging.WARNING, "jaxbl"):
            jax.grad(lambda gain, rough=rough: mean_speed(jaxbl.with_values(rough, {"controller.speed_gain": gain})))(2.0)
        assert len(caplog.records) == count
