"""Records cut into windows: what each begins with."""

import jax.numpy as jnp
import numpy as np
import pytest
from hidden.cases import Log
from hidden.simulator import Machine, Run, simulate
from hidden_log import GAP, GEARED, driven, model
from scipy.signal import lfilter

from jaxbl.config import read_model
from jaxbl.diagnosis.reference_log import ReferenceLog
from jaxbl.identification.logs import on_record
from jaxbl.identification.segments import reading_noise, segments_of, windows_of
from jaxbl.records import read_record

LAG = {"kind": "actuator.lag", "time_constant": 0.05}


@pytest.fixture(scope="module")
def setting(tmp_path_factory):
    t = 2e-3 * np.arange(2000)
    path = tmp_path_factory.mktemp("log") / "axis.csv"
    driven(0.5 * np.sin(2.0 * np.pi * 1.3 * t), [LAG], 3e-5, 1).write(path)
    record = read_record(path)
    true = model(drive={"kind": "rigid", "motor_inertia": 0.02, "motor_viscous": 0.03}, effects=[LAG])
    experiment = on_record(read_model(true)[0], record)
    return record, experiment, segments_of(record, experiment.sides)


def test_windows_begin_with_the_torque_that_the_actuator_makes_then(setting):
    record, experiment, segments = setting
    windows, firsts = windows_of(segments, experiment, 250)
    keep = np.exp(-2e-3 / LAG["time_constant"])
    made = lfilter([0.0, 1.0 - keep], [1.0, -keep], record.torque, zi=[record.torque[0] * keep])[0]
    made[0] = record.torque[0]
    ((found,),) = windows.start.effects
    np.testing.assert_allclose(found, made[firsts], atol=1e-3 * np.max(np.abs(made)))
    np.testing.assert_allclose(windows.start.position["motor"], segments[0].smoothed["motor"].position[jnp.asarray(firsts)])


def test_the_true_model_of_a_lag_before_a_hard_gap_leaves_noise(tmp_path):
    """From an actuator without torque the search for the windows' initial states ends a thousand times as far off."""
    torque = 5.0 * np.sin(2.0 * np.pi * 0.9 * 2e-3 * np.arange(2000))
    (trace,) = simulate([Run(Machine(GEARED, GAP, [LAG]), 2e-3, torque, motor_noise=1e-5, load_noise=2e-6, seed=1)])
    Log(trace.t, trace.u, trace.theta_e, trace.theta_s).write(tmp_path / "axis.csv")
    config, _ = read_model(model(drive=GEARED, transmission=GAP, effects=[LAG]))
    record = read_record(tmp_path / "axis.csv", gear_ratio=GEARED["gear_ratio"])
    experiment = on_record(config, record)
    segments = segments_of(record, experiment.sides)
    noise = reading_noise(segments)
    errors = ReferenceLog(segments, {"motor": 30.0, "load": 30.0}).compare(experiment).errors
    assert errors["theta_e"] < 1.2 * noise["motor"] and errors["theta_s"] < 1.2 * noise["load"]
