"""From a log to numbers with intervals: made logs whose truth is known, and a real machine."""

import numpy as np
import pytest
from measured import EMPS, real
from small_study import rigid, small

from jaxbl.errors import InputError
from jaxbl.report import write_identification_report
from jaxbl.study.config import read_config
from jaxbl.study.identification import identify
from jaxbl.study.trial import run

LAW = {"law": "dead_zone", "stiffness": 60.0, "half_gap": 0.08}
FRICTION = [{"kind": "load.coulomb_friction", "torque": 0.4}]
OBSERVER = {"motor": {"lambda": 20.0, "alpha": 400.0}, "load": {"lambda": 3.0, "alpha": 20.0}}
SETTINGS = {"equivalent_control.time_constant": 0.01, "run.duration": 3.0, "run.sample_period": 2e-3, "run.substeps": 4}
TRUTH = {
    "drive.motor_inertia": 0.05,
    "drive.motor_viscous": 0.15,
    "drive.load_inertia": 7.0,
    "drive.load_viscous": 16.0,
    "transmission.stiffness": 60.0,
    "transmission.half_gap": 0.08,
    "effects.load.coulomb_friction.torque": 0.4,
}


def geared(changes=None, **tables):
    tables = {
        "transmission": LAW,
        "effects": FRICTION,
        "excitation": {"kind": "multisine", "amplitude": 5.0, "frequency": 0.5},
        "identify": {"starts": 2, "window": 0.5},
        "observer": OBSERVER,
    } | tables
    return small(SETTINGS | (changes or {}), **tables)


NOMINAL = geared(
    {
        "drive.motor_inertia": 0.055,
        "drive.load_viscous": 14.0,
        "transmission": LAW | {"stiffness": 50.0, "half_gap": 0.07},
    },
    effects=[{"kind": "load.coulomb_friction", "torque": 0.6}],
)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    file = tmp_path_factory.mktemp("log") / "axis.csv"
    run(geared()).trace[["t", "u", "theta_e", "theta_s"]].to_csv(file, index=False)
    return file


@pytest.fixture(scope="module")
def found(log):
    return identify(log, NOMINAL)


def test_numbers_are_those_of_the_machine_within_their_errors(found):
    parameters = found.summary["parameters"]
    assert list(parameters) == list(TRUTH)
    for path, true in TRUTH.items():
        one = parameters[path]
        assert abs(one["value"] - true) < 4.0 * one["standard_error"], path
        assert one["interval"][0] < one["value"] < one["interval"][1]
        assert one["standard_error"] < 0.02 * true
    assert found.summary["refused"] == [] and found.summary["held"] == []
    for side, noise in (("motor", 1e-4), ("load", 2e-5)):
        residual = found.summary["residual"][side]
        assert residual["noise"] == pytest.approx(noise, rel=0.1)
        assert residual["rms"] == pytest.approx(noise, rel=0.1)
    assert found.summary["method"]["trajectory"]["window"] == pytest.approx(0.5)


def test_recursive_identifier_ends_nearby(found):
    recursive = found.summary["method"]["recursive"]
    for side in ("motor", "load"):
        assert recursive["stiffness"][side] == pytest.approx(60.0, rel=0.1)
        assert recursive["half_gap"][side] == pytest.approx(0.08, rel=0.1)
        assert found.trace[f"{side}.stiffness"].iloc[-1] == pytest.approx(recursive["stiffness"][side])


def test_trace_holds_what_the_log_says(found):
    trace = found.trace
    assert len(trace) == 1500
    truth = run(geared()).trace
    errors = (trace["motor.velocity"] - truth["motor.velocity"]) / trace["motor.velocity_deviation"]
    assert 0.5 < np.sqrt(np.mean(errors**2)) < 1.5
    assert np.sqrt(np.nanmean(trace["motor.residual"] ** 2)) == pytest.approx(1e-4, rel=0.1)


def test_model_runs_with_the_numbers_found(found, tmp_path):
    for path in ("motor_inertia", "load_viscous"):
        assert getattr(found.model.drive, path) == found.summary["parameters"][f"drive.{path}"]["value"]
    (tmp_path / "model.toml").write_text(found.model.to_toml())
    again = read_config(tmp_path / "model.toml")
    assert again == found.model
    assert again.effects[0].torque == found.summary["parameters"]["effects.load.coulomb_friction.torque"]["value"]


def test_report_has_every_number_and_figure(found, tmp_path):
    lines = write_identification_report(found, tmp_path)
    assert lines[0].startswith("drive.motor_inertia = 0.05")
    assert any("the model leaves nothing but noise" in line for line in lines)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"identification.json", "model.toml", "trace.parquet", "figures", "report.html"}
    drawn = {path.stem for path in (tmp_path / "figures").iterdir()}
    assert drawn == {"intervals", "residuals", "velocities", "torque", "hysteresis", "limit_cycle", "recursive"}
    page = (tmp_path / "report.html").read_text()
    assert all(path in page for path in TRUTH)


def test_a_direction_that_the_log_does_not_show_is_refused(log):
    """Torque, inertias, frictions and stiffness scaled alike."""
    effects = [*FRICTION, {"kind": "actuator.gain_error", "relative": 0.0}]
    found = identify(log, geared(effects=effects)).summary
    (refusal,) = found["refused"]
    assert "effects.actuator.gain_error.relative" in refusal["direction"]
    assert "transmission.stiffness" in refusal["direction"]
    assert "transmission.half_gap" not in refusal["direction"]
    assert "what would help: " in refusal["why"] and "a load or an inertia that is known" in refusal["why"]
    assert len(found["held"]) == 1
    assert found["held"][0] not in found["parameters"]
    half_gap = found["parameters"]["transmission.half_gap"]
    assert abs(half_gap["value"] - 0.08) < 4.0 * half_gap["standard_error"]


BAD = {
    "no load encoder": (geared(log={"absent": ["theta_s"]}), "no load position .theta_s., which a two_inertia drive needs"),
    "unknown number": (
        geared(identify={"parameters": ["drive.mass"]}),
        "'drive.mass' is no number of the plant; fitted can be: drive.motor_inertia",
    ),
    "window": (geared(identify={"window": 60.0}), r"identify.window: 60 s are 30000 samples; it should be between 20 "),
    "starts": (geared(identify={"starts": 0}), "identify.starts: should be greater than or equal to 1"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line(case, log):
    study, message = BAD[case]
    with pytest.raises(InputError, match=message) as error:
        identify(log, study)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_emps_agrees_with_what_was_published():
    """A real axis in closed loop, by a rigid model; values of Janot, Gautier, Brunot (2019)."""
    study = rigid(
        {"drive.motor_inertia": 80.0, "drive.motor_viscous": 150.0, "run.substeps": 2},
        effects=[{"kind": "motor.coulomb_friction", "torque": 15.0}, {"kind": "motor.constant_torque", "torque": 0.0}],
        log=EMPS,
        identify={"starts": 3},
    )
    parameters = identify(real("emps/DATA_EMPS.mat"), study).summary["parameters"]
    published = {
        "drive.motor_inertia": 95.109,
        "drive.motor_viscous": 203.50,
        "effects.motor.coulomb_friction.torque": 20.394,
        "effects.motor.constant_torque.torque": -3.165,
    }
    assert set(parameters) == set(published)
    for path, value in published.items():
        low, high = parameters[path]["interval"]
        # an estimate too, whose standard error is about as large (jaxbl.identification.regression gives the same values)
        assert abs(value - 0.5 * (low + high)) < np.sqrt(2.0) * 0.5 * (high - low), (path, low, high)
        assert high - low < 0.25 * abs(value)
