"""Real machines, nominal models without friction: what is known of them is found again."""

import numpy as np
import pytest
from measured import EMPS, XL330, find_recording
from small_study import rigid_study

from jaxbl.diagnosis import effect_search
from jaxbl.diagnosis.diagnose import diagnose, read_diagnosis_task
from jaxbl.diagnosis.effect_search import EffectSearch
from jaxbl.diagnosis.reference_log import ReferenceLog
from jaxbl.diagnosis.residuals import narrow
from jaxbl.estimation.free_parameters import make_free_parameters
from jaxbl.estimation.logs import default_paths, on_record
from jaxbl.estimation.segments import segments_of

COULOMB = {"kind": "motor.coulomb_friction", "torque": 20.0}
VISCOUS = {"kind": "motor.viscous_friction", "viscous": 206.0}
OFFSET = {"kind": "motor.constant_torque", "torque": -3.2}


def emps_study(*effects):
    """The positioning system as a mass, with some of its effects; linear: kg, N, m."""
    study = rigid_study(
        {"drive.motor_inertia": 95.0, "drive.motor_viscous": 0.0, "run.substeps": 2},
        effects=[*effects],
        log=EMPS,
        uncertainty={"relative": 0.02},
    )
    return {key: table for key, table in study.items() if key not in ("observer", "excitation")}


def search_effects(log, study):
    task = read_diagnosis_task(log, study)
    nominal = on_record(task.config, task.record)
    free = make_free_parameters(nominal, default_paths(task.config, nominal), float(np.std(task.record.torque)))
    prior = [task.config.uncertainty.relative] * len(free)
    log = ReferenceLog(segments_of(task.record, nominal.sides), {"motor": 0.02 / task.record.sample_period})
    return EffectSearch(nominal, free, prior, log).run().fitted


def test_emps_friction_of_each_direction_is_named_and_the_force_error_falls():
    """Published: M 95.1 kg, F_v 203.5 N s/m, F_c 20.39 N, and F_v 166.7 N s/m forwards, 240.4 backwards; force error 66 %
    with the mass alone, 4.7 % with all of these."""
    diagnosis = diagnose(
        find_recording("emps/DATA_EMPS.mat"), emps_study(), holdout=find_recording("emps/DATA_EMPS_PULSES.mat")
    )
    summary = diagnosis.summary
    numbers = {finding["effect"]: finding["parameters"] for finding in summary["findings"]}
    assert set(numbers) == {"motor.viscous_friction", "motor.presliding_friction", "motor.asymmetric_friction"}
    assert numbers["motor.viscous_friction"]["viscous"]["value"] == pytest.approx(203.5, rel=0.04)
    # its contacts bend by some micrometres before they slide
    assert numbers["motor.presliding_friction"]["torque"]["value"] == pytest.approx(20.39, rel=0.04)
    assert 1e-6 < numbers["motor.presliding_friction"]["length"]["value"] < 1e-4
    assert numbers["motor.asymmetric_friction"]["viscous_difference"]["value"] == pytest.approx(166.7 - 240.4, rel=0.1)
    assert summary["parameters"]["drive.motor_inertia"]["value"] == pytest.approx(95.1, rel=0.01)
    # behind the 100 Hz of the published figures
    driving = summary["gap"]["driving"]["motor"]
    ((before, after, is_held_out),) = diagnosis.pairs["motor"]
    error = [np.sqrt(np.mean(narrow(finding, 100.0)[0].torque ** 2)) / driving for finding in (before, after)]
    assert is_held_out
    assert error[0] == pytest.approx(0.66, abs=0.03)
    assert error[1] < 0.058
    assert summary["verdict"] == "unknown_effect"
    assert summary["where_after"]["motor"]["sentence"]
    # what remains is no known effect; a table of it is better by blocks of the log, and in force on the other input
    tables = summary["torque_tables"]
    assert tables["z"] > 2.0
    assert tables["holdout_rmse"]["torque_motor"] < summary["gap"]["holdout_rmse_after"]["torque_motor"]


def test_emps_an_effect_that_is_taken_out_is_named_again(monkeypatch):
    monkeypatch.setattr(effect_search, "_MOST", 1)
    found = search_effects(find_recording("emps/DATA_EMPS.mat"), emps_study(VISCOUS, OFFSET))
    assert found.numbers["motor.presliding_friction"]["torque"] == pytest.approx(COULOMB["torque"], rel=0.1)


def test_xl330_gravity_and_then_dry_friction_are_named():
    """A pendulum released, neither gravity nor friction in the model."""
    study = rigid_study(
        {"drive.motor_inertia": 0.0049, "drive.motor_viscous": 0.0, "run.substeps": 2, "run.sample_period": 3.5e-3},
        effects=[],
        uncertainty={"exact": ["drive.motor_inertia"]},
        log={key: XL330[key] for key in ("t", "theta_e")}
        | {"absent": ["u"], "where": {"torque_enable": False}, "resample": 3.5e-3},
    )
    logs = [find_recording(f"bam_xl330/2026-01-15_{time}.json") for time in ("10h28m17", "10h29m21")]
    numbers = search_effects(logs, study).numbers
    assert set(numbers) == {"load.gravity", "motor.coulomb_friction"}
    # of the inertia m l² = 0.0049 kg m², a mass point: gravity pulls less, as the servo's own inertia adds to it
    assert 0.25 < numbers["load.gravity"]["torque"] < 0.49 * 0.1 * 9.81
    # small beside a swing of 10 to 20 Hz that no effect accounts for; all of the friction, as the model has no viscous one
    assert 0.005 < numbers["motor.coulomb_friction"]["torque"] < 0.02
