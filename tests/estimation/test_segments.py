"""Records cut into windows: what each begins with."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from hidden.cases import Log
from hidden.simulator import Machine, Run, simulate
from hidden_log import GAP, GEARED, nominal_study, simulate_direct_drive
from scipy.signal import lfilter

from jaxbl.config import read_model
from jaxbl.diagnosis.reference_log import ReferenceLog
from jaxbl.drive.effects import DELAY_SAMPLES
from jaxbl.estimation.logs import on_record
from jaxbl.estimation.regression import Path, effect_path
from jaxbl.estimation.segments import reading_noise, segments_of, skip_unknown_input, windows_of
from jaxbl.records import read_record

LAG = {"kind": "actuator.lag", "time_constant": 0.05}


@pytest.fixture(scope="module")
def lagged_log(tmp_path_factory):
    t = 2e-3 * np.arange(2000)
    path = tmp_path_factory.mktemp("log") / "axis.csv"
    simulate_direct_drive(0.5 * np.sin(2.0 * np.pi * 1.3 * t), [LAG], 3e-5, 1).write(path)
    record = read_record(path)
    true = nominal_study(drive={"kind": "rigid", "motor_inertia": 0.02, "motor_viscous": 0.03}, effects=[LAG])
    experiment = on_record(read_model(true)[0], record)
    return record, experiment, segments_of(record, experiment.sides)


def test_windows_begin_with_the_torque_that_the_actuator_makes_then(lagged_log):
    record, experiment, segments = lagged_log
    windows = windows_of(segments, experiment, 250)
    keep = np.exp(-2e-3 / LAG["time_constant"])
    actuator_torque = lfilter([0.0, 1.0 - keep], [1.0, -keep], record.torque, zi=[record.torque[0] * keep])[0]
    actuator_torque[0] = record.torque[0]
    ((result,),) = windows.start.effects
    np.testing.assert_allclose(result, actuator_torque[windows.rows], atol=1e-3 * np.max(np.abs(actuator_torque)))
    np.testing.assert_allclose(windows.start.position["motor"], segments[0].smoothed["motor"].state[windows.rows, 0])


def test_a_segment_gives_up_its_beginning_for_the_inputs_before_it(lagged_log):
    full, _, _ = lagged_log
    record = replace(full, segments=(slice(0, 100), slice(100, 900), slice(1000, 2000)))
    # nothing is known before the first part, which is too short to give up any; the others follow on known inputs
    assert skip_unknown_input(record, False).segments == record.segments
    record = replace(record, time=full.time + 0.5 * (np.arange(2000) >= 1000))
    led = skip_unknown_input(record, False)
    assert (
        led.segments
        == (slice(0, 100), slice(100, 900), slice(1000 + DELAY_SAMPLES, 2000))
        == skip_unknown_input(led, False).segments
    )
    first, second, third = segments_of(led, ["motor"])
    assert first.before is None and record.torque is not None
    np.testing.assert_array_equal(second.before, record.torque[100 - DELAY_SAMPLES : 100])
    np.testing.assert_array_equal(third.before, record.torque[1000 : 1000 + DELAY_SAMPLES])
    # at rest nothing had been commanded
    assert skip_unknown_input(full, True).segments == full.segments and skip_unknown_input(full, False).segments == (
        slice(DELAY_SAMPLES, 2000),
    )
    np.testing.assert_array_equal(segments_of(full, ["motor"], True)[0].before, np.zeros(DELAY_SAMPLES))
    free = replace(full, torque=np.zeros(2000))
    assert skip_unknown_input(free, False).segments == full.segments


def test_effects_begin_with_what_the_inputs_before_left(lagged_log):
    """A dead time and a lag along a part of an input act as along the whole of it."""
    record, _, _ = lagged_log
    delays = [{"kind": "actuator.delay", "delay": 0.0246}, {"kind": "actuator.lag", "time_constant": 0.05}]
    experiment = on_record(read_model(nominal_study(effects=delays))[0], record)
    standstill = {"motor": np.zeros(200)}
    time, torque = record.time[:200], np.cos(30.0 * record.time[:200])
    states, acting_torques = effect_path(experiment, Path(time, torque, standstill, standstill))
    for first in (5, 40):
        standstill_after = {"motor": np.zeros(200 - first)}
        later_states, torques = effect_path(
            experiment, Path(time[first:], torque[first:], standstill_after, standstill_after, before=torque[:first])
        )
        np.testing.assert_allclose(torques, acting_torques[first:], atol=1e-12)
        np.testing.assert_allclose(
            jax.tree.leaves(later_states), [leaf[first:] for leaf in jax.tree.leaves(states)], atol=1e-12
        )


def test_the_true_model_of_a_lag_before_a_hard_gap_leaves_noise(tmp_path):
    """The search for the windows' initial states from an actuator without torque ends a thousand times as far off."""
    torque = 5.0 * np.sin(2.0 * np.pi * 0.9 * 2e-3 * np.arange(2000))
    (trace,) = simulate([Run(Machine(GEARED, GAP, [LAG]), 2e-3, torque, motor_noise=1e-5, load_noise=2e-6, seed=1)])
    Log(trace.t, trace.u, trace.theta_e, trace.theta_s).write(tmp_path / "axis.csv")
    config, _ = read_model(nominal_study(drive=GEARED, transmission=GAP, effects=[LAG]))
    record = read_record(tmp_path / "axis.csv", gear_ratio=GEARED["gear_ratio"])
    experiment = on_record(config, record)
    segments = segments_of(record, experiment.sides)
    noise = reading_noise(segments)
    compared = ReferenceLog(segments, {"motor": 30.0, "load": 30.0}).compare(experiment)
    for side, name in (("motor", "theta_e"), ("load", "theta_s")):
        # windows are foretold from states that noise makes uncertain
        assert compared.errors[name] < 1.2 * noise[side] * np.hypot(1.0, compared.noise[name])
