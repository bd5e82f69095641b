"""Gap and friction from the motor's encoder alone: drives by a simulator of its own, the load's channel hidden."""

import json
from dataclasses import replace

import numpy as np
import pytest
import tomli_w
from hidden.cases import Log
from hidden.simulator import Machine, Run, simulate
from hidden_log import FRICTIONS, GAP, GEARED, simulate_geared_drive
from typer.testing import CliRunner

from jaxbl import cli
from jaxbl.errors import InputError
from jaxbl.estimation.identify import identify
from jaxbl.records import inspect

STUDY = {
    "title": "motor alone",
    "drive": GEARED | {"motor_inertia": 0.052, "load_inertia": 8.0, "motor_viscous": 0.2, "load_viscous": 12.0},
    "transmission": GAP | {"stiffness": 50.0, "half_gap": 0.03},
    "effects": [FRICTIONS[0] | {"torque": 0.2}, FRICTIONS[1] | {"torque": 3.0}],
    "run": {"sample_period": 2e-3, "duration": 4.0, "substeps": 4},
}
TRUTH = {
    "transmission.half_gap": 0.08,
    "transmission.stiffness": 60.0,
    "drive.motor_inertia": 0.05,
    "drive.load_inertia": 7.0,
    "effects.load.coulomb_friction.torque": 6.0,
}


def write_motor_log(folder, log):
    path = folder / "motor.csv"
    replace(log, theta_s=None).write(path)
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return write_motor_log(tmp_path_factory.mktemp("log"), simulate_geared_drive()[0])


@pytest.fixture(scope="module")
def identification(log):
    return identify(log, STUDY)


def test_gap_and_friction_behind_the_gear_are_found(identification):
    assert identification.summary["backlash"]["shown"]
    assert identification.summary["backlash"]["crossings"] >= 10
    for path, true in TRUTH.items():
        parameters = identification.summary["parameters"][path]
        assert parameters["value"] == pytest.approx(true, rel=0.02), path
        assert parameters["interval"][0] <= true <= parameters["interval"][1], path
        assert parameters["interval"][1] / parameters["interval"][0] < 1.1, path
    assert identification.model.transmission.half_gap == pytest.approx(0.08, rel=1e-3)


def test_the_load_that_the_model_makes_of_it_is_the_true_one(identification):
    log, _ = simulate_geared_drive()
    # an angle that no channel holds: apart by a constant
    error = identification.trace["load.modelled_position"].to_numpy() - log.theta_s
    assert np.std(error[200:]) < 0.01 * np.std(log.theta_s)


def test_a_log_without_torque_says_what_is_missing(tmp_path, log):
    with pytest.raises(InputError, match="neither a load position \\(theta_s\\) nor a torque \\(u\\)"):
        identify(log, STUDY | {"log": {"absent": ["u"]}})


def test_inspect_says_what_needs_the_load(log):
    answers = {judgement.quantity: judgement for judgement in inspect(log).identifiability}
    assert answers["lost motion"].answer == "weak"
    assert "jaxbl identify" in answers["lost motion"].reason


def test_a_drive_without_a_gap_is_refused_and_the_move_written(tmp_path, monkeypatch):
    t = 2e-3 * np.arange(1000)
    shaft = {"law": "linear_shaft", "stiffness": 60.0}
    torque = 5.0 * np.sin(2.0 * np.pi * 1.0 * t)
    (trace,) = simulate([Run(Machine(GEARED, shaft, FRICTIONS), 2e-3, torque, motor_noise=1e-5, seed=2)])
    path = write_motor_log(tmp_path, Log(trace.t, trace.u, trace.theta_e, None))
    law = {"law": "sigmoid_backlash", "stiffness": 50.0, "dead_zone": 0.005, "slope": 200.0}
    study = STUDY | {"transmission": law, "uncertainty": {"exact": ["drive.gear_ratio", "transmission.slope"]}}
    (tmp_path / "axis.toml").write_text(tomli_w.dumps(study))
    monkeypatch.setattr("jaxbl.workers.start_jax", lambda: None)
    monkeypatch.chdir(tmp_path)
    called = CliRunner().invoke(
        cli.app, ["identify", str(path), "--model", "axis.toml", "--out", "out", "--next-experiment", "next.csv"]
    )
    assert called.exit_code == 0, called.output
    assert "No gap is shown  without one the motor's readings are met as well" in called.stdout
    assert "To show a half gap of" in called.stdout
    assert "next.csv" in called.stdout
    content = json.loads((tmp_path / "out" / "identification.json").read_text())
    assert content["backlash"]["at_most"] < 0.01
    assert not {"transmission.dead_zone", "transmission.half_gap"} & set(content["parameters"])
    assert (tmp_path / "next.csv").read_text().startswith("t,u\n")


def test_a_load_that_may_never_be_met_has_no_numbers(tmp_path):
    light = GEARED | {"load_inertia": 0.6, "load_viscous": 1.5}
    torque = 0.8 * np.sin(2.0 * np.pi * 1.0 * 2e-3 * np.arange(1000))
    machine = Machine(light, GAP | {"half_gap": 5.0}, [FRICTIONS[0], FRICTIONS[1] | {"torque": 0.3}])
    (trace,) = simulate([Run(machine, 2e-3, torque, motor_noise=3e-3, seed=2)])
    assert np.ptp(trace.states[2]) == 0.0
    study = STUDY | {"drive": light, "effects": [FRICTIONS[0], FRICTIONS[1] | {"torque": 0.3}]}
    summary = identify(write_motor_log(tmp_path, Log(trace.t, trace.u, trace.theta_e, None)), study).summary
    assert "by a motor that, within a gap, never meets the load" in summary["backlash"]["why"]
    assert {parameter["interval"][1] for parameter in summary["parameters"].values()} == {None}
