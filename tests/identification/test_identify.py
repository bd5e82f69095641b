"""From a log to numbers with intervals: made logs whose truth is known, and a real machine."""

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from measured import EMPS, XL330, real
from small_study import rigid, small

from jaxbl.config import read_config
from jaxbl.errors import InputError
from jaxbl.identification import observer_gains
from jaxbl.identification.identify import identify
from jaxbl.observer.conditions import least_lambda_exact
from jaxbl.report.identify import identification_lines, write_identification_report
from jaxbl.sweeps.trial import run

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


def geared_study(changes=None, **tables):
    tables = {
        "transmission": LAW,
        "effects": FRICTION,
        "excitation": {"kind": "multisine", "amplitude": 5.0, "frequency": 0.5},
        "identify": {"starts": 2, "window": 0.5},
        "observer": OBSERVER,
    } | tables
    return small(SETTINGS | (changes or {}), **tables)


NOMINAL = geared_study(
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
    run(geared_study()).trace[["t", "u", "theta_e", "theta_s"]].to_csv(file, index=False)
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
    truth = run(geared_study()).trace
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
    assert any("times the noise: noise alone." in line for line in lines[1:])
    # what a model lacks is said before numbers whose intervals do not count it
    lacking = identification_lines(found.summary | {"residual": {"motor": {"rms": 2e-4, "noise": 1e-4, "unit": "rad"}}})
    assert lacking[0] == "motor: position residual 0.0002 rad rms, 2 times the noise: the model is incomplete."
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"identification.json", "model.toml", "trace.parquet", "figures", "report.html"}
    drawn = {path.stem for path in (tmp_path / "figures").iterdir()}
    assert drawn == {"intervals", "residuals", "velocities", "torque", "hysteresis", "limit_cycle", "recursive"}
    page = (tmp_path / "report.html").read_text()
    assert all(path in page for path in TRUTH)


def test_a_direction_that_the_log_does_not_show_is_refused(log):
    """Torque, inertias, frictions and stiffness scaled alike."""
    effects = [*FRICTION, {"kind": "actuator.gain_error", "relative": 0.0}]
    summary = identify(log, geared_study(effects=effects)).summary
    (refusal,) = summary["refused"]
    assert "effects.actuator.gain_error.relative" in refusal["direction"]
    assert "transmission.stiffness" in refusal["direction"]
    assert "transmission.half_gap" not in refusal["direction"]
    assert "what would help: " in refusal["why"] and "a load or an inertia that is known" in refusal["why"]
    assert len(summary["held"]) == 1
    assert summary["held"][0] not in summary["parameters"]
    half_gap = summary["parameters"]["transmission.half_gap"]
    assert abs(half_gap["value"] - 0.08) < 4.0 * half_gap["standard_error"]


def open_ended(study):
    """The study without excitation and observers."""
    return {key: value for key, value in study.items() if key not in ("excitation", "observer")}


@pytest.fixture(scope="module")
def sensor_logs(tmp_path_factory):
    """Two logs of the drive with a torque sensor, the second one with another input."""
    folder = tmp_path_factory.mktemp("measured")
    for i, frequency in enumerate((0.5, 0.37)):
        trace = run(geared_study(excitation={"kind": "multisine", "amplitude": 5.0, "frequency": frequency})).trace
        sensor = 0.02 * np.random.default_rng(i).standard_normal(len(trace))
        frame = trace[["t", "u", "theta_e", "theta_s"]].assign(sensor=trace["torque"] + sensor)
        frame.to_csv(folder / f"log{i}.csv", index=False)
    return folder


@pytest.fixture(scope="module")
def everything(sensor_logs):
    """All that can be asked for at once: no excitation, no gains, measured torque, prediction errors, profiles, hold-out."""
    study = open_ended(NOMINAL)
    # the log is sampled twice as often
    study["run"] = {key: 2 * value if key in ("sample_period", "substeps") else value for key, value in study["run"].items()}
    study["log"] = {"transmitted": "sensor", "initial_state": "rest"}
    study["identify"] = {"starts": 2, "window": 0.5, "method": "prediction_error", "parameters": list(TRUTH)[4:]}
    study["drive"] = geared_study()["drive"]
    return identify(sensor_logs / "log0.csv", study, holdout=sensor_logs / "log1.csv", profile=True)


def test_a_measured_torque_is_regressed_directly(everything):
    regression = everything.summary["method"]["regression"]
    assert regression["measured_transmitted_torque"]
    for path in ("transmission.stiffness", "transmission.half_gap"):
        parameters = regression["parameters"][path]
        assert abs(parameters["value"] - TRUTH[path]) < 4.0 * parameters["standard_error"], path
        assert parameters["standard_error"] < 0.01 * TRUTH[path]
    assert regression["torque"]["transmission"]["rms"] < 0.02
    assert np.array_equal(everything.trace["transmitted"], everything.record.transmitted)


def test_prediction_errors_find_the_numbers_too(everything):
    assert everything.summary["method"]["trajectory"]["kind"] == "prediction_error"
    for path, parameter in everything.summary["parameters"].items():
        assert abs(parameter["value"] - TRUTH[path]) < 4.0 * parameter["standard_error"], path
        low, high = parameter["interval"]
        np.testing.assert_allclose(parameter["profile_interval"], parameter["interval"], atol=0.1 * (high - low), rtol=0.0)
        assert len(parameter["profile"]) == 9


def test_gains_are_chosen_on_the_log_where_the_study_has_none(everything):
    for side, tolerance in (("motor", 0.3), ("load", 0.03)):
        gains, table = everything.summary["gains"][side], getattr(everything.model.observer, side)
        assert (table.lambda_, table.alpha) == (gains["lambda_"], gains["alpha"])
        assert table.alpha > gains["f_plus"]
        difference = (everything.trace[f"{side}.velocity_estimate"] - everything.trace[f"{side}.velocity"])[250:]
        assert np.sqrt(np.mean(difference**2)) == pytest.approx(gains["velocity_error"], rel=0.01)
        assert gains["velocity_error"] < tolerance


def test_numbers_are_tried_out_on_another_log(everything):
    holdout = everything.summary["holdout"]
    assert holdout["file"].endswith("log1.csv")
    for side, noise in (("motor", 1e-4), ("load", 2e-5)):
        position = holdout["position"][side]
        assert position["rms"] == pytest.approx(noise, rel=0.1)
        assert position["nominal_rms"] > 5.0 * noise
    torque = holdout["torque"]["transmission"]
    assert torque["relative"] < 0.3 * torque["nominal_relative"]


def test_model_replays_the_log_where_the_study_has_no_excitation(everything, tmp_path):
    lines = "\n".join(write_identification_report(everything, tmp_path))
    assert "On log1.csv, motor: position residual over 0.5 s" in lines
    assert "motor observer: lambda = " in lines
    assert "(transmission)" in lines
    again = run(tmp_path / "model.toml")
    np.testing.assert_allclose(again.trace["u"], everything.trace["u"], atol=1e-12)
    page = (tmp_path / "report.html").read_text()
    assert "by profile from" in page
    assert "with the measured transmitted torque" in page


def test_several_logs_are_one_record(sensor_logs, found, tmp_path):
    """Halves of two logs say as much as one whole log."""
    study = geared_study(identify={"starts": 1, "window": 0.5})
    halves = [tmp_path / "half0.csv", tmp_path / "half1.csv"]
    for i, half in enumerate(halves):
        pd.read_csv(sensor_logs / f"log{i}.csv").iloc[:750].to_csv(half, index=False)
    identification = identify(halves, study)
    assert len(identification.trace) == 1500
    assert identification.summary["method"]["trajectory"]["windows"] == 6
    errors = [x.summary["parameters"]["transmission.half_gap"]["standard_error"] for x in (identification, found)]
    assert errors[0] == pytest.approx(errors[1], rel=0.3)
    with pytest.raises(InputError, match="no log: at least one is needed"):
        identify([], study)


BAD = {
    "no torque, no inertia": (
        geared_study(log={"absent": ["u"]}),
        r"without u a motion shows torques only as multiples of an inertia: put a known one into \[uncertainty\] exact",
    ),
    "no motor encoder": (
        geared_study(log={"absent": ["theta_e"]}),
        "no motor position .theta_e., which a two_inertia drive needs",
    ),
    "unknown number": (
        geared_study(identify={"parameters": ["drive.mass"]}),
        "'drive.mass' is no number of the plant; fitted can be: drive.motor_inertia",
    ),
    "window": (
        geared_study(identify={"window": 60.0}),
        r"identify.window: 60 s are 30000 samples; it should be between 20 ",
    ),
    "far apart": (
        geared_study({"run.sample_period": 1e-6, "run.substeps": 1, "run.duration": 1e-3}),
        r"its samples are 0.002 s apart, more than 1000 plant steps of 1e-06 s \(\[run\]\); where the stamps are not in s",
    ),
    "starts": (geared_study(identify={"starts": 0}), "identify.starts: should be greater than or equal to 1"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line(case, log):
    study, message = BAD[case]
    with pytest.raises(InputError, match=message) as error:
        identify(log, study)
    assert "\n" not in str(error.value)


def test_starts_agree_that_end_where_there_is_no_noise_to_tell_them_apart(tmp_path):
    multisine = {"kind": "multisine", "amplitude": 1.0, "frequency": 0.5}
    study = rigid({"run.duration": 2.0, "encoders.noise": 0.0}, excitation=multisine)
    file = tmp_path / "axis.csv"
    run(study).trace[["t", "u", "theta_e"]].to_csv(file, index=False)
    fit = identify(file, study | {"identify": {"starts": 4}}).summary["method"]["trajectory"]
    assert fit["variance_over_noise"] < 0.5
    assert fit["starts_agreeing"] == 4


def test_emps_agrees_with_what_was_published():
    """A real axis in closed loop, by a rigid model; values of Janot, Gautier, Brunot (2019)."""
    study = rigid(
        {"drive.motor_inertia": 80.0, "drive.motor_viscous": 150.0, "run.substeps": 2},
        effects=[{"kind": "motor.coulomb_friction", "torque": 15.0}, {"kind": "motor.constant_torque", "torque": 0.0}],
        log=EMPS,
        identify={"starts": 1},
    )
    summary = identify(real("emps/DATA_EMPS.mat"), study, holdout=real("emps/DATA_EMPS_PULSES.mat")).summary
    parameters = summary["parameters"]
    published = {
        "drive.motor_inertia": 95.109,
        "drive.motor_viscous": 203.50,
        "effects.motor.coulomb_friction.torque": 20.394,
        "effects.motor.constant_torque.torque": -3.165,
    }
    assert set(parameters) == set(published)
    for path, value in published.items():
        low, high = parameters[path]["interval"]
        assert low <= value <= high, (path, low, high)
        assert high - low < 0.25 * abs(value)
    torque = summary["torque"]["motor"]
    assert torque["relative"] < 0.042
    assert torque["unit"] == "N"
    assert summary["holdout"]["torque"]["motor"]["relative"] < 0.054


def test_xl330_pendulum_swings_freely():
    """Gravity and friction from two free swings with uneven stamps; better than the published 0.018 rad rms."""
    study = rigid(
        {"drive.motor_inertia": 0.0049, "drive.motor_viscous": 0.005, "run.substeps": 2, "run.sample_period": 3.5e-3},
        effects=[{"kind": "load.gravity", "torque": 0.4}, {"kind": "motor.coulomb_friction", "torque": 0.02}],
        uncertainty={"exact": ["drive.motor_inertia"]},
        log={key: XL330[key] for key in ("t", "theta_e")}
        | {"absent": ["u"], "where": {"torque_enable": False}, "resample": 3.5e-3},
        identify={"starts": 1, "window": 3.9},
    )
    logs = [real(f"bam_xl330/2026-01-15_{time}.json") for time in ("10h28m17", "10h29m21")]
    identification = identify(logs, study)
    assert identification.summary["residual"]["motor"]["rms"] < 0.019
    parameters = identification.summary["parameters"]
    assert set(parameters) == {
        "drive.motor_viscous",
        "effects.load.gravity.torque",
        "effects.load.gravity.phase",
        "effects.motor.coulomb_friction.torque",
    }
    low, high = parameters["effects.motor.coulomb_friction.torque"]["interval"]
    assert 0.0 < low < high < 0.02
    assert any("taken to move freely" in note for note in identification.summary["notes"])
    # of the inertia m l² = 0.0049 kg m², a mass point: gravity pulls less, as the servo's own inertia adds to it
    assert 0.3 < parameters["effects.load.gravity.torque"]["value"] < 0.49 * 0.1 * 9.81


def test_the_least_lambda_of_the_gains_that_are_tried_is_that_of_the_condition():
    alpha, bound = 7.3 * observer_gains._ALPHA, 7.3
    least = least_lambda_exact(jnp.asarray(alpha), jnp.full(len(alpha), bound))
    np.testing.assert_allclose(np.sqrt(bound) * observer_gains._LEAST_LAMBDA, least, rtol=1e-13)
