"""The cascade: limit cycles beside an event-driven simulation, limits, anti-windup, and what takes a gap's error off."""

import jax.numpy as jnp
import limit_cycles
import numpy as np
import pytest

import jaxbl
from jaxbl.control import Cascade, Moves, SineReference, StepsReference
from jaxbl.drive.effects import make_effect
from jaxbl.sweeps.engine import Engine

STUDY = {
    "drive": {
        "kind": "two_inertia", "motor_inertia": 0.05, "motor_viscous": 0.15, "load_inertia": 1.0, "load_viscous": 2.0,
        "gear_ratio": 5.0,
    },
    "transmission": {"law": "dead_zone", "stiffness": 60.0, "half_gap": 0.08},
    "initial": {"motor_position": 0.5, "load_position": 0.1},
    "encoders": {"noise": 1e-4, "missed": 0.01},
    "observer": {"kind": "extended_state", "motor": {"bandwidth": 300.0}, "load": {"bandwidth": 300.0}},
    "controller": {
        "kind": "cascade", "side": "load", "position_gain": 8.0, "speed_gain": 2.0, "integral_time": 0.1,
        "torque_limit": 20.0,
    },
    "reference": {"kind": "steps", "size": 0.0, "hold": 1.0},
    "run": {"duration": 4.0},
    "axes": [
        {"path": "controller.position_gain", "values": [5.0, 8.0]}, {"path": "transmission.half_gap", "values": [0.02, 0.1]},
    ],
}  # fmt: skip


def make_axis(controller, reference, **parts):
    return jaxbl.experiment(
        jaxbl.Experiment(
            drive=jaxbl.TwoInertia(0.05, 0.15, 1.0, 2.0, 5.0),
            observer=jaxbl.Observers(jaxbl.ExtendedState(300.0), jaxbl.ExtendedState(300.0)),
            controller=controller,
            reference=reference,
            **{"transmission": jaxbl.DeadZone(600.0, 0.02), "run": jaxbl.Run(1e-3, 3000)} | parts,
        )
    )


def test_limit_cycle_beside_events():
    rng = np.random.default_rng(5)
    loops = (limit_cycles.draw_loop(rng) for _ in range(20))
    cycles = ((loop, limit_cycles.simulate_events(loop)) for loop in loops)
    loop, by_events = next((loop, cycle) for loop, cycle in cycles if not limit_cycles.is_at_border(loop, cycle))
    by_chain = limit_cycles.simulate_chain(loop)
    np.testing.assert_allclose(by_chain.amplitude, by_events.amplitude, rtol=1e-3)
    np.testing.assert_allclose(by_chain.frequency, by_events.frequency, rtol=1e-3)
    assert by_chain.impact_rate == by_events.impact_rate > 2.0 * by_events.frequency - 1.0
    np.testing.assert_allclose(by_chain.impact_speed, by_events.impact_speed, rtol=0.02)


KNOWING = {
    "controller": STUDY["controller"] | {
        "side": "motor", "gap_compensation": 0.1, "gap_from": "twist", "effects_feedforward": 0.8
    },
    "reference": {"kind": "sine", "amplitude": 2.0, "frequency": 0.47},
    "effects": [
        {"kind": "motor.cogging", "amplitude": 0.1, "harmonic": 6.0, "phase": 0.3},
        {"kind": "load.coulomb_friction", "torque": 0.5},
    ],
    "axes": [STUDY["axes"][1], {"path": "controller.effects_feedforward", "values": [0.0, 1.0]}],
}  # fmt: skip
"""A loop that knows its effects and observes its twist."""


def test_fused_loop_and_scan_agree_where_effects_are_known():
    frames = {}
    for backend in ("fused", "scan"):
        frames[backend] = jaxbl.sweep(STUDY | KNOWING, backend=backend).frame
    columns = frames["fused"].filter(regex="following|torque_rms$|reversals|impact").columns
    assert len(columns) == 12
    np.testing.assert_allclose(frames["fused"][columns], frames["scan"][columns], rtol=1e-7)


def test_fused_loop_and_scan_agree():
    config = jaxbl.read_config(STUDY)
    frames = {}
    for backend in ("fused", "scan"):
        engine = Engine(config, backend=backend)
        frames[backend] = engine.run(engine.chunk(0))
    assert frames["fused"].filter(regex="limit_cycle|following|torque_r|settling|impact").shape == (4, 20)
    np.testing.assert_allclose(
        frames["fused"].to_numpy(float), frames["scan"][frames["fused"].columns].to_numpy(float), rtol=1e-9
    )
    # a wider gap has a larger limit cycle of the same frequency
    amplitude = frames["fused"]["load.limit_cycle_amplitude"].to_numpy().reshape(2, 2)
    np.testing.assert_allclose(amplitude[:, 1] / amplitude[:, 0], 5.0, rtol=0.1)
    single = jaxbl.run(config).summary["metrics"]
    np.testing.assert_allclose(
        single["load.limit_cycle_amplitude"],
        jaxbl.metrics(jaxbl.experiment(config), names=("limit_cycle_amplitude",))["load.limit_cycle_amplitude"],
        rtol=1e-9,
    )


def test_torque_is_that_of_the_law():
    cascade = Cascade(20.0, 3.0, 0.05, inertia_feedforward=0.09, viscous_feedforward=0.1, friction_feedforward=0.2)
    signals = jaxbl.simulate(make_axis(cascade, SineReference(0.5, 1.0)))
    target = signals.target
    error = 3.0 * (20.0 * (target.position - signals.motor.measured) + target.velocity - signals.motor.velocity_estimate)
    torque = error + np.concatenate([[0.0], np.cumsum(1e-3 / 0.05 * error)[:-1]])
    torque = torque + 0.09 * target.acceleration + 0.1 * target.velocity + 0.2 * np.sign(target.velocity)
    np.testing.assert_allclose(signals.input[1:], torque[:-1], rtol=1e-9, atol=1e-9)
    assert signals.input[0] == 0.0


def test_known_effects_are_fed_forward():
    """Each effect as it is written in docs/effects.md, at the readings and at the target."""
    effects = (
        make_effect("motor.cogging", amplitude=0.3, harmonic=6.0, phase=0.4),
        make_effect("load.stribeck_friction", torque=1.0, breakaway_torque=1.5, stribeck_velocity=0.2),
        make_effect("load.gravity", torque=2.0),
        make_effect("motor.inertia", inertia=0.02),
        make_effect("motor.viscous_friction", viscous=0.05),
        # not of a side, with a memory, with a clock: left out
        make_effect("actuator.gain_error", relative=0.1),
        make_effect("load.presliding_friction", torque=0.2, length=0.01),
        make_effect("load.periodic_disturbance", amplitude=0.1, frequency=1.0),
    )
    parts = {"effects": effects, "encoders": jaxbl.Encoders(noise=1e-4)}
    signals, ratio = {}, 5.0
    for share in (None, 0.7):
        cascade = Cascade(0.0, 0.0, effects_feedforward=share)
        signals[share] = jaxbl.simulate(make_axis(cascade, SineReference(2.0, 0.5), **parts))
    assert not signals[None].input.any()
    found = signals[0.7]
    velocity, acceleration = found.target.velocity, found.target.acceleration
    motor = found.motor.measured + 1.5e-3 * velocity
    load = found.load.measured + 1.5e-3 * velocity / ratio
    friction = 1.0 + 0.5 * np.exp(-((velocity / ratio / 0.2) ** 2))
    expected = 0.3 * np.sin(6.0 * motor + 0.4) + 0.02 * acceleration + 0.05 * velocity
    expected = expected + (np.sign(velocity) * friction + 2.0 * np.sin(load)) / ratio
    np.testing.assert_allclose(found.input[1:], 0.7 * expected[:-1], rtol=1e-9, atol=1e-12)


def test_known_cogging_and_friction_leave_no_following_error():
    study = STUDY | {
        "drive": {"kind": "rigid", "motor_inertia": 0.05, "motor_viscous": 0.15}, "transmission": None, "initial": {},
        "observer": {"kind": "extended_state", "motor": {"bandwidth": 300.0}},
        "controller": {
            "kind": "cascade", "position_gain": 8.0, "speed_gain": 1.0, "inertia_feedforward": 0.05,
            "viscous_feedforward": 0.15,
        },
        "effects": [
            {"kind": "motor.cogging", "amplitude": 0.2, "harmonic": 12.0}, {"kind": "motor.coulomb_friction", "torque": 0.3},
        ],
        "reference": KNOWING["reference"],
        "axes": [{"path": "controller.effects_feedforward", "values": [0.0, 1.0]}],
        "sweep": {"metrics": ["following_rmse"]},
    }  # fmt: skip
    without, known = jaxbl.sweep({k: v for k, v in study.items() if v is not None}).frame["motor.following_rmse"]
    assert known < 0.05 * without


def test_limits_of_torque_and_rate():
    cascade = Cascade(20.0, 3.0, 0.05, torque_limit=2.0, torque_rate=100.0)
    torque = jaxbl.simulate(make_axis(cascade, StepsReference(1.0, 0.5))).input
    assert 1.99 < jnp.abs(torque).max() <= 2.0
    assert 0.099 < jnp.abs(jnp.diff(torque)).max() <= 0.1 + 1e-12


def test_anti_windup_keeps_the_overshoot_small():
    """An integral that winds up overshoots three times as far."""
    limited = Cascade(8.0, 3.0, 0.1, torque_limit=1.0, velocity_feedforward=0.0)
    experiment = make_axis(limited, StepsReference(-3.0, 10.0), initial=jaxbl.Initial(motor_position=3.0, load_position=0.6))
    position = jaxbl.simulate(experiment).motor.true.position
    assert position.min() > -0.35

    # the same law without it, on one inertia
    theta, speed, integral, lowest = 3.0, 0.0, 0.0, 0.0
    for _ in range(3000):
        proportional = 3.0 * (-8.0 * theta - speed)
        torque = np.clip(proportional + integral, -1.0, 1.0)
        integral += 1e-3 / 0.1 * proportional
        speed += 1e-3 * (torque - 0.23 * speed) / 0.09
        theta += 1e-3 * speed
        lowest = min(lowest, theta)
    assert lowest < -1.0


@pytest.mark.parametrize("speed_from", ["observer", "differences"])
def test_position_settles_after_moves(speed_from):
    cascade = Cascade(15.0, 3.0, 0.1, speed_from=speed_from, speed_filter=1e-3, inertia_feedforward=0.09, side="motor")
    experiment = make_axis(cascade, Moves(1.0, 0.5, 1.0), transmission=jaxbl.LinearShaft(600.0))
    found = jaxbl.metrics(experiment, names=("following_rmse", "settling_time"))
    assert found["motor.following_rmse"] < 1e-3
    assert 0.0 < found["motor.settling_time"] < 2.5


def test_gap_compensation_takes_the_gap_off_the_load():
    """A motor loop leaves the load half a gap behind in each direction; led over the gap, it does not."""
    errors = {}
    for lead in (0.0, 0.1):
        cascade = Cascade(30.0, 3.0, 0.1, gap_compensation=lead, gap_speed=20.0)
        experiment = make_axis(
            cascade,
            SineReference(2.0, 0.2),
            transmission=jaxbl.DeadZone(600.0, 0.1),
            # the load is dragged: it touches the face in the direction of motion
            effects=(make_effect("load.coulomb_friction", torque=5.0),),
            run=jaxbl.Run(1e-3, 10_000),
        )
        # the reference is the motor's; the load's share is one fifth of it
        errors[lead] = jaxbl.metrics(experiment, names=("following_rmse",))["load.following_rmse"]
    assert errors[0.0] == pytest.approx(0.1 / 5.0, rel=0.15)
    assert errors[0.1] < 0.5 * errors[0.0]


def test_observed_twist_compensates_where_the_load_runs_ahead():
    """With little friction the load coasts to the other face before the reference turns around."""
    errors = {}
    for source in ("reference", "twist"):
        cascade = Cascade(30.0, 3.0, 0.1, gap_compensation=0.1, gap_speed=1.0, gap_from=source)
        axis = make_axis(
            cascade,
            SineReference(2.0, 0.5),
            transmission=jaxbl.DeadZone(600.0, 0.1),
            effects=(make_effect("load.coulomb_friction", torque=0.5),),
            run=jaxbl.Run(1e-3, 10_000),
        )
        errors[source] = jaxbl.metrics(axis, names=("following_rmse",))["load.following_rmse"]
    assert errors["twist"] < 0.5 * errors["reference"]
    # the lead is the observed twist, up to the gap and at the gap's speed
    signals = jaxbl.simulate(axis)
    twist = np.clip(signals.motor.position_estimate - 5.0 * signals.load.position_estimate, -0.1, 0.1)
    lead, error = np.zeros(10_001), np.zeros(10_000)
    for k, target in enumerate(twist):
        lead[k + 1] = lead[k] + np.clip(target - lead[k], -1e-3, 1e-3)
    reference = signals.target
    error = 30.0 * (reference.position - signals.motor.measured + lead[:-1])
    error = 3.0 * (error + reference.velocity - signals.motor.velocity_estimate)
    torque = error + np.concatenate([[0.0], np.cumsum(1e-3 / 0.1 * error)[:-1]])
    np.testing.assert_allclose(signals.input[1:], torque[:-1], rtol=1e-7, atol=1e-7)


def test_no_gap_has_no_impacts():
    found = jaxbl.metrics(
        make_axis(Cascade(8.0, 2.0), SineReference(1.0, 1.0), transmission=jaxbl.LinearShaft(600.0)),
        names=("impact_rate", "impact_speed"),
    )
    assert not any(found[f"load.{name}"] for name in ("impact_rate", "impact_speed"))


def test_a_missed_sample_leaves_the_loop_finite():
    assert jaxbl.run(STUDY).summary["metrics"]["finite"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"reference": None}, r"\[reference\] is missing: a controller and the reference that it follows belong together"),
        ({"controller": None}, r"\[controller\] is missing"),
        ({"controller": {"kind": "cascade", "speed_gain": 1.0}}, "controller.position_gain: this key is missing"),
        ({"reference": {"kind": "stairs"}}, "reference.kind: unknown kind 'stairs'; valid: sine, ramp, steps, moves"),
        ({"controller": STUDY["controller"] | {"side": "gear"}}, "controller.side"),
    ],
)
def test_bad_tables_are_told_in_one_line(change, message):
    study = {key: value for key, value in (STUDY | change).items() if value is not None}
    if "controller" not in study:
        study["excitation"] = {"kind": "sine", "amplitude": 1.0, "frequency": 1.0}
    with pytest.raises(jaxbl.InputError, match=message) as caught:
        jaxbl.read_config(study)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({}, "side: 'load' has no meaning on a rigid drive"),
        ({"side": "motor", "gap_from": "twist"}, "gap_from: a rigid drive"),
    ],
)
def test_a_load_loop_needs_a_load(keys, message):
    study = {
        "drive": {"kind": "rigid", "motor_inertia": 0.05, "motor_viscous": 0.1},
        "observer": {"motor": {"lambda": 10.0, "alpha": 100.0}},
        "controller": STUDY["controller"] | keys,
        "reference": STUDY["reference"],
    }
    with pytest.raises(jaxbl.InputError, match=rf"controller\.{message}"):
        jaxbl.read_config(study)
