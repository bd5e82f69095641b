"""What a model lacks, from the motor's encoder alone."""

import json
from dataclasses import replace

import pytest
from hidden_log import FRICTIONS, GEARED, geared

from jaxbl.config import read_model
from jaxbl.diagnosis.diagnose import diagnose
from jaxbl.diagnosis.motor_alone import sought
from jaxbl.diagnosis.next_experiment import with_gap
from jaxbl.report.diagnose import write_diagnosis_report

STUDY = {
    "title": "motor alone",
    "drive": GEARED | {"motor_inertia": 0.0505, "load_inertia": 7.1, "motor_viscous": 0.153, "load_viscous": 15.8},
    "transmission": {"law": "linear_shaft", "stiffness": 61.0},
    "run": {"sample_period": 2e-3, "duration": 4.0, "substeps": 4},
    "uncertainty": {"relative": 0.03, "exact": ["drive.gear_ratio"]},
}


def test_a_gap_and_frictions_are_named_and_proved(tmp_path):
    path = tmp_path / "motor.csv"
    replace(geared()[0], theta_s=None).write(path)
    found = diagnose(path, STUDY)
    assert found.summary["verdict"] == "explained"
    numbers = {one["effect"]: one["parameters"] for one in found.summary["findings"]}
    assert numbers["transmission.backlash"]["half_gap"]["value"] == pytest.approx(0.08, rel=0.01)
    assert numbers["load.coulomb_friction"]["torque"]["value"] == pytest.approx(6.0, rel=0.02)
    assert numbers["motor.coulomb_friction"]["torque"]["value"] == pytest.approx(0.1, rel=0.05)
    before, after = (found.summary["gap"][f"holdout_rmse_{which}"]["theta_e"] for which in ("before", "after"))
    assert after < 0.01 * before
    lines = write_diagnosis_report(found, tmp_path)
    assert lines[0].startswith("No load position")
    assert any("predicted one sample ahead" in line for line in lines)
    assert json.loads((tmp_path / "diagnosis.json").read_text())["backlash"]["shown"]
    assert {one.name for one in (tmp_path / "figures").iterdir()} == {"gap.png", "half_gaps.png", "hysteresis.png"}
    assert {effect.kind for effect in found.model.effects} == set(numbers)


def test_what_a_model_has_is_not_sought():
    bare = read_model(STUDY)[0].build()
    assert set(sought(bare)) == {"motor.coulomb_friction", "load.coulomb_friction", "transmission.backlash"}
    gap = {"law": "dead_zone", "stiffness": 61.0, "half_gap": 0.05}
    known = read_model(STUDY | {"transmission": gap, "effects": [FRICTIONS[1]]})[0].build()
    assert sought(known) == ["motor.coulomb_friction"]


def test_a_gap_of_a_given_size_in_a_study():
    bare = read_model(STUDY)[0]
    (effect,) = with_gap(bare, "effects.transmission.backlash.half_gap", 0.02).effects
    assert (effect.kind, effect.half_gap) == ("transmission.backlash", 0.02)
    law = read_model(STUDY | {"transmission": {"law": "dead_zone", "stiffness": 61.0, "half_gap": 0.05}})[0]
    assert with_gap(law, "transmission.half_gap", 0.02).transmission.half_gap == 0.02
