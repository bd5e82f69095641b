"""What a model lacks, from the motor's encoder alone."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hidden.cases import Log
from hidden.simulator import Machine, Run, simulate
from hidden_log import FRICTIONS, GAP, GEARED, select_samples, simulate_geared_drive

from jaxbl.config import read_model
from jaxbl.diagnosis.diagnose import diagnose, read_diagnosis_task, run_diagnosis
from jaxbl.diagnosis.motor_alone import list_sought
from jaxbl.diagnosis.next_experiment import with_gap
from jaxbl.drive.effects import DELAY_SAMPLES
from jaxbl.estimation import motor_alone
from jaxbl.report.diagnose import describe as describe_diagnosis
from jaxbl.report.results import write_report

STUDY = {
    "title": "motor alone",
    "drive": GEARED | {"motor_inertia": 0.0505, "load_inertia": 7.1, "motor_viscous": 0.153, "load_viscous": 15.8},
    "transmission": {"law": "linear_shaft", "stiffness": 61.0},
    "run": {"sample_period": 2e-3, "duration": 4.0, "substeps": 4},
    "uncertainty": {"relative": 0.03, "exact": ["drive.gear_ratio"]},
}


def test_a_gap_and_frictions_are_named_and_proved(tmp_path):
    path = tmp_path / "motor.csv"
    replace(simulate_geared_drive()[0], theta_s=None).write(path)
    diagnosis = diagnose(path, STUDY)
    assert diagnosis.summary["verdict"] == "explained"
    numbers = {finding["effect"]: finding["parameters"] for finding in diagnosis.summary["findings"]}
    assert numbers["transmission.backlash"]["half_gap"]["value"] == pytest.approx(0.08, rel=0.01)
    assert numbers["load.coulomb_friction"]["torque"]["value"] == pytest.approx(6.0, rel=0.02)
    assert numbers["motor.coulomb_friction"]["torque"]["value"] == pytest.approx(0.1, rel=0.05)
    before, after = (diagnosis.summary["gap"][f"holdout_rmse_{name}"]["theta_e"] for name in ("before", "after"))
    assert after < 0.01 * before
    lines = write_report(diagnosis, tmp_path).sentences
    assert any(line.startswith("No load position") for line in lines)
    assert any("predicted one sample ahead" in line for line in lines)
    assert json.loads((tmp_path / "diagnosis.json").read_text())["backlash"]["shown"]
    assert {file.name for file in (tmp_path / "figures").iterdir()} == {"hysteresis.png"}
    assert {effect.kind for effect in diagnosis.model.effects} == set(numbers)


SHAFT = {"law": "linear_shaft", "stiffness": 60.0}
EXACT_STUDY = STUDY | {"drive": GEARED, "transmission": SHAFT}
ONE_CYCLE = 5.0 * np.sin(2.0 * np.pi * 0.5 * 2e-3 * np.arange(1000))


def simulate_motor_log(torque, law, noise):
    (trace,) = simulate([Run(Machine(GEARED, law, []), 2e-3, torque, motor_noise=noise, seed=1)])
    return Log(trace.t, trace.u, trace.theta_e, None)


def test_nothing_is_named_where_nothing_is_missing(tmp_path):
    t = 2e-3 * np.arange(1310)
    log = simulate_motor_log(5.0 * (np.sin(2.0 * np.pi * 0.5 * t) + np.sin(2.0 * np.pi * 1.3 * t + 1.0)), SHAFT, 1e-3)
    # the first part is too short to be fitted, and stays in the trace; the other one gives up its beginning
    path, other = tmp_path / "motor.csv", tmp_path / "other.csv"
    select_samples(log, np.r_[0:50, 60:1060]).write(path)
    select_samples(log, np.r_[1060:1310]).write(other)
    done = []
    task = read_diagnosis_task(path, EXACT_STUDY, holdout=other)
    diagnosis = run_diagnosis(task, lambda *counted: done.append(counted))
    assert (diagnosis.summary["verdict"], diagnosis.summary["findings"]) == ("no_discrepancy", [])
    assert diagnosis.summary["explained_share"] is None
    first = 50 + DELAY_SAMPLES
    assert np.isnan(diagnosis.trace["torque"][:first]).all() and np.isfinite(diagnosis.trace["torque"][first:]).all()
    assert done == [(1, 3), (2, 3), (3, 3)]


def test_a_gap_that_the_model_has_is_found_from_afar(tmp_path):
    """Numbers 12 to 20 % off: a plain fit ends beside the least error, and leaves a torque of 0.5 N m."""
    log = simulate_motor_log(
        3.0 * np.sin(2 * np.pi * 0.5 * 2e-3 * np.arange(1000)),
        {"law": "dead_zone", "stiffness": 60.0, "half_gap": 0.08},
        1e-5,
    )
    log.write(tmp_path / "motor.csv")
    study = STUDY | {
        "transmission": {"law": "dead_zone", "stiffness": 50.0, "half_gap": 0.07},
        "uncertainty": {"relative": 0.2, "exact": ["drive.gear_ratio"]},
    }
    summary = diagnose(tmp_path / "motor.csv", study).summary
    assert summary["verdict"] == "no_discrepancy" and summary["backlash"]["shown"]
    assert summary["parameters"]["transmission.half_gap"]["value"] == pytest.approx(0.08, rel=1e-3)


def test_one_crossing_shows_a_gap(tmp_path):
    path = tmp_path / "motor.csv"
    simulate_motor_log(ONE_CYCLE, GAP, 1e-5).write(path)
    summary = diagnose(path, EXACT_STUDY).summary
    assert summary["backlash"]["crossings"] == 1
    (finding,) = summary["findings"]
    assert finding["parameters"]["half_gap"]["value"] == summary["backlash"]["half_gap"] == pytest.approx(0.08, rel=1e-3)
    assert not any("No gap is shown" in line for line in describe_diagnosis(summary).sentences)


def test_a_gap_that_is_not_shown_is_not_named(tmp_path, monkeypatch):
    path = tmp_path / "motor.csv"
    simulate_motor_log(ONE_CYCLE, GAP, 1e-5).write(path)
    monkeypatch.setattr(motor_alone, "why_not", lambda *_: "it may be of any size")
    summary = diagnose(path, EXACT_STUDY).summary
    assert (summary["verdict"], summary["findings"]) == ("unknown_effect", [])
    lines = describe_diagnosis(summary).sentences
    assert lines[0] == "A gap might explain what is missing, but this log does not show it."
    assert "No gap is shown: it may be of any size. model.toml has the one that fits best." in lines


def test_what_a_model_has_is_not_sought():
    bare = read_model(STUDY)[0].build()
    assert list_sought(bare, ["load.coulomb_friction", "drive.gear_ratio"]) == [
        "motor.coulomb_friction",
        "transmission.backlash",
    ]
    assert set(list_sought(bare)) == {"motor.coulomb_friction", "load.coulomb_friction", "transmission.backlash"}
    gap = {"law": "dead_zone", "stiffness": 61.0, "half_gap": 0.05}
    nominal = read_model(STUDY | {"transmission": gap, "effects": [FRICTIONS[1]]})[0].build()
    assert list_sought(nominal) == ["motor.coulomb_friction"]


def test_a_gap_of_a_given_size_in_a_study():
    bare = read_model(STUDY)[0]
    (effect,) = with_gap(bare, "effects.transmission.backlash.half_gap", 0.02).effects
    assert (effect.kind, effect.half_gap) == ("transmission.backlash", 0.02)
    law = read_model(STUDY | {"transmission": {"law": "dead_zone", "stiffness": 61.0, "half_gap": 0.05}})[0]
    assert with_gap(law, "transmission.half_gap", 0.02).transmission.half_gap == 0.02
