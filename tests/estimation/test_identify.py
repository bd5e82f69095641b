"""From a log to numbers with intervals: made logs whose truth is known, and a real machine."""

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from hidden_log import simulate_study
from measured import EMPS, XL330, find_recording, read_stretch
from small_study import rigid_study, small_study
from trace_segment import make_segment

from jaxbl.chain import plant_trajectory
from jaxbl.config import prepare, read_config
from jaxbl.errors import InputError
from jaxbl.estimation import observer_gains
from jaxbl.estimation.free_parameters import make_free_parameters
from jaxbl.estimation.identify import identify
from jaxbl.estimation.logs import default_paths
from jaxbl.estimation.search import ParameterSearch
from jaxbl.fused.compilation import jit
from jaxbl.observer.conditions import least_lambda_exact
from jaxbl.report.identify import describe as describe_identification
from jaxbl.report.results import write_report

LAW = {"law": "dead_zone", "stiffness": 60.0, "half_gap": 0.08}
FRICTION = [{"kind": "load.coulomb_friction", "torque": 0.4}]
OBSERVER = {"motor": {"lambda": 20.0, "alpha": 400.0}, "load": {"lambda": 3.0, "alpha": 20.0}}
SWING = {"kind": "multisine", "amplitude": 1.0, "frequency": 0.5}
INERTIA = "drive.motor_inertia"
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
    return small_study(SETTINGS | (changes or {}), **tables)


NOMINAL = geared_study(
    {
        "drive.motor_inertia": 0.055,
        "drive.load_viscous": 14.0,
        "transmission": LAW | {"stiffness": 50.0, "half_gap": 0.07},
    },
    effects=[{"kind": "load.coulomb_friction", "torque": 0.6}],
)


@pytest.fixture(scope="module")
def trace():
    """A run of the drive: its readings and what no encoder tells."""
    return simulate_study(geared_study())


@pytest.fixture(scope="module")
def log(trace, tmp_path_factory):
    return write_log(trace, tmp_path_factory.mktemp("log") / "axis.csv")


def write_log(trace, file):
    trace[[name for name in ("t", "u", "theta_e", "theta_s", "sensor") if name in trace]].to_csv(file, index=False)
    return file


@pytest.fixture(scope="module")
def identification(log):
    return identify(log, NOMINAL)


def test_numbers_are_those_of_the_machine_within_their_errors(identification):
    parameters = identification.summary["parameters"]
    assert list(parameters) == list(TRUTH)
    for path, true in TRUTH.items():
        parameter = parameters[path]
        assert abs(parameter["value"] - true) < 4.0 * parameter["standard_error"], path
        assert parameter["interval"][0] < parameter["value"] < parameter["interval"][1]
        assert parameter["standard_error"] < 0.02 * true
    assert identification.summary["refused"] == [] and identification.summary["held"] == []
    for side, noise in (("motor", 1e-4), ("load", 2e-5)):
        residual = identification.summary["residual"][side]
        assert residual["noise"] == pytest.approx(noise, rel=0.1)
        assert residual["rms"] == pytest.approx(noise, rel=0.1)
    assert identification.summary["method"]["trajectory"]["window"] == pytest.approx(0.5)


def test_recursive_identifier_ends_nearby(identification):
    """It is biased by what its low-pass and discretisation leave; the fit is not."""
    recursive, parameters = identification.summary["method"]["recursive"], identification.summary["parameters"]
    for side in ("motor", "load"):
        for name, true in (("stiffness", 60.0), ("half_gap", 0.08)):
            fit_error = abs(parameters[f"transmission.{name}"]["value"] / true - 1.0)
            assert 3.0 * fit_error < abs(recursive[name][side] / true - 1.0) < 0.05
        assert identification.trace[f"{side}.stiffness"].iloc[-1] == pytest.approx(recursive["stiffness"][side])


def test_trace_holds_what_the_log_says(identification, trace):
    columns = identification.trace
    assert len(columns) == 1500
    errors = (columns["motor.velocity"] - trace["motor.velocity"]) / columns["motor.velocity_deviation"]
    assert 0.5 < np.sqrt(np.mean(errors**2)) < 1.5
    assert np.sqrt(np.nanmean(columns["motor.residual"] ** 2)) == pytest.approx(1e-4, rel=0.1)


def test_model_runs_with_the_numbers_found(identification, tmp_path):
    for path in ("motor_inertia", "load_viscous"):
        assert getattr(identification.model.drive, path) == identification.summary["parameters"][f"drive.{path}"]["value"]
    (tmp_path / "model.toml").write_text(identification.model.to_toml())
    model = read_config(tmp_path / "model.toml")
    assert model == identification.model
    assert model.effects[0].torque == identification.summary["parameters"]["effects.load.coulomb_friction.torque"]["value"]


def test_report_has_every_number_and_figure(identification, tmp_path):
    result = write_report(identification, tmp_path)
    assert result.verdict == "good" and result.headline.startswith("The model explains the log: no more than noise is left")
    assert any(value.startswith("0.04999") and path == "drive.motor_inertia" for value, path in result.key_figures)
    assert any("times the noise: noise alone." in line for line in result.details)
    # what a model lacks is said before numbers whose intervals do not count it
    lacking = describe_identification(
        identification.summary | {"residual": {"motor": {"rms": 2e-4, "noise": 1e-4, "unit": "rad"}}}
    )
    assert lacking.verdict == "doubtful" and "(motor: 0.0002 rad rms, 2 times the noise)" in lacking.headline
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"identification.json", "model.toml", "trace.parquet", "figures", "manifest.json", "report.html"}
    drawn = {path.stem for path in (tmp_path / "figures").iterdir()}
    assert drawn == {"residuals", "hysteresis"}
    page = (tmp_path / "report.html").read_text().replace("<wbr>", "")
    assert [path for path in TRUTH if path not in page] == []


def drop_excitation_and_gains(study):
    """The study without excitation and observers."""
    return {key: value for key, value in study.items() if key not in ("excitation", "observer")}


@pytest.fixture(scope="module")
def sensor_logs(tmp_path_factory):
    """Two logs of the drive with a torque sensor, the second one with another input."""
    folder = tmp_path_factory.mktemp("measured")
    for i, frequency in enumerate((0.5, 0.37)):
        trace = simulate_study(geared_study(excitation={"kind": "multisine", "amplitude": 5.0, "frequency": frequency}))
        noise = 0.02 * np.random.default_rng(i).standard_normal(len(trace))
        write_log(trace.assign(sensor=trace["torque"] + noise), folder / f"log{i}.csv")
    return folder


@pytest.fixture(scope="module")
def full_identification(sensor_logs):
    """All that can be asked for at once: no excitation, no gains, measured torque, prediction errors, profiles, hold-out."""
    study = drop_excitation_and_gains(NOMINAL)
    # the log is sampled twice as often
    study["run"] = {key: 2 * value if key in ("sample_period", "substeps") else value for key, value in study["run"].items()}
    study["log"] = {"transmitted": "sensor", "initial_state": "rest"}
    study["identify"] = {"starts": 2, "window": 0.5, "method": "prediction_error", "parameters": list(TRUTH)[4:]}
    study["drive"] = geared_study()["drive"]
    return identify(sensor_logs / "log0.csv", study, holdout=sensor_logs / "log1.csv", profile=True)


def test_prediction_errors_find_the_numbers_too(full_identification):
    assert full_identification.summary["method"]["trajectory"]["kind"] == "prediction_error"
    assert np.array_equal(full_identification.trace["transmitted"], full_identification.record.transmitted)
    for path, parameter in full_identification.summary["parameters"].items():
        assert abs(parameter["value"] - TRUTH[path]) < 4.0 * parameter["standard_error"], path
        low, high = parameter["interval"]
        np.testing.assert_allclose(parameter["profile_interval"], parameter["interval"], atol=0.1 * (high - low), rtol=0.0)
        assert len(parameter["profile"]) == 9


def test_gains_are_chosen_on_the_log_where_the_study_has_none(full_identification):
    for side, tolerance in (("motor", 0.3), ("load", 0.03)):
        gains, table = full_identification.summary["gains"][side], getattr(full_identification.model.observer, side)
        assert (table.lambda_, table.alpha) == (gains["lambda_"], gains["alpha"])
        assert table.alpha > gains["f_plus"]
        difference = (
            full_identification.trace[f"{side}.velocity_estimate"] - full_identification.trace[f"{side}.velocity"]
        )[250:]
        assert np.sqrt(np.mean(difference**2)) == pytest.approx(gains["velocity_error"], rel=0.01)
        assert gains["velocity_error"] < tolerance


def test_numbers_are_tried_out_on_another_log(full_identification):
    holdout = full_identification.summary["holdout"]
    assert holdout["file"].endswith("log1.csv")
    for side, noise in (("motor", 1e-4), ("load", 2e-5)):
        position = holdout["position"][side]
        assert position["rms"] == pytest.approx(noise, rel=0.1)
        assert position["nominal_rms"] > 5.0 * noise
    torque = holdout["torque"]["transmission"]
    assert torque["relative"] < 0.3 * torque["nominal_relative"]


def test_model_replays_the_log_where_the_study_has_no_excitation(full_identification, tmp_path):
    lines = "\n".join(write_report(full_identification, tmp_path).sentences)
    assert "On log1.csv, motor: position residual over 0.5 s" in lines
    assert "motor observer: lambda = " in lines
    assert "(transmission)" in lines
    excitation = prepare(read_config(tmp_path / "model.toml")).excitation
    torque = jax.vmap(excitation)(jnp.asarray(full_identification.trace["t"]))
    np.testing.assert_allclose(torque, full_identification.trace["u"], atol=1e-12)
    page = (tmp_path / "report.html").read_text().replace("<wbr>", "")
    assert "by profile from" in page


def test_several_logs_are_one_record(sensor_logs, identification, tmp_path):
    """Halves of two logs say as much as one whole log."""
    halves = [tmp_path / "half0.csv", tmp_path / "half1.csv"]
    for i, half in enumerate(halves):
        pd.read_csv(sensor_logs / f"log{i}.csv").iloc[:750].to_csv(half, index=False)
    together = identify(halves, NOMINAL)
    assert len(together.trace) == 1500
    assert together.summary["method"]["trajectory"]["windows"] == 6
    errors = [x.summary["parameters"]["transmission.half_gap"]["standard_error"] for x in (together, identification)]
    assert errors[0] == pytest.approx(errors[1], rel=0.3)
    with pytest.raises(InputError, match="no log: at least one is needed"):
        identify([], NOMINAL)


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
    "nothing to find": (
        rigid_study(uncertainty={"exact": ["drive.motor_inertia", "drive.motor_viscous"]}),
        r"model: no number to identify: all are in \[uncertainty\] exact; take one out",
    ),
    "starts": (geared_study(identify={"starts": 0}), "identify.starts: should be greater than or equal to 1"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line(case, log):
    study, message = BAD[case]
    with pytest.raises(InputError, match=message) as error:
        identify(log, study)
    assert "\n" not in str(error.value)


def test_a_direction_that_the_log_does_not_show_is_refused(tmp_path):
    """Torque, inertia and frictions scaled alike."""
    effects = [
        {"kind": "motor.coulomb_friction", "torque": 0.05},
        {"kind": "load.gravity", "torque": 0.2, "phase": 0.3},
        {"kind": "actuator.gain_error", "relative": 0.0},
    ]
    study = rigid_study({"run.duration": 2.0}, excitation=SWING, effects=effects, identify={"starts": 1, "window": 0.5})
    summary = identify(write_log(simulate_study(study), tmp_path / "axis.csv"), study).summary
    (refusal,) = summary["refused"]
    torques = {"effects.motor.coulomb_friction.torque", "effects.load.gravity.torque"}
    scaled = {"drive.motor_inertia", "drive.motor_viscous", *torques, "effects.actuator.gain_error.relative"}
    assert set(refusal["direction"]) == scaled
    np.testing.assert_allclose([refusal["direction"][path] for path in torques], refusal["direction"][INERTIA], rtol=0.05)
    assert "what would help: " in refusal["why"] and "a load or an inertia that is known" in refusal["why"]
    (group,) = summary["held"]
    assert group in scaled and set(summary["parameters"]) == {*scaled, "effects.load.gravity.phase"} - {group}
    # with that number held, the log shows all others
    for parameter in summary["parameters"].values():
        assert parameter["standard_error"] < 0.02
    phase = summary["parameters"]["effects.load.gravity.phase"]
    assert abs(phase["value"] - 0.3) < 4.0 * phase["standard_error"]


def test_starts_agree_that_end_where_there_is_no_noise_to_tell_them_apart():
    study = rigid_study(
        {"run.duration": 2.0, "encoders.noise": 0.0}, excitation=SWING, identify={"starts": 4, "window": 0.5}
    )
    trace, experiment = simulate_study(study), prepare(read_config(study))
    # an exact model: by its own integrator
    start = experiment.plant.init(experiment.initial)
    positions = jit(plant_trajectory)(experiment, start, jnp.asarray(trace["u"])).position["motor"]
    segment = make_segment(trace.assign(theta_e=positions))
    free = make_free_parameters(experiment, default_paths(read_config(study), experiment), 1.0)
    settings = read_config(study).identify
    search = ParameterSearch(experiment, [segment], settings, at_rest=False, name="log").run(free)
    assert float(search.spread.variance) < 0.5
    assert search.starts == [True] * 4


def test_emps_agrees_with_what_was_published():
    """A real axis in closed loop, by a rigid model; values of Janot, Gautier, Brunot (2019)."""
    study = rigid_study(
        {"drive.motor_inertia": 80.0, "drive.motor_viscous": 150.0, "run.substeps": 2},
        effects=[{"kind": "motor.coulomb_friction", "torque": 15.0}, {"kind": "motor.constant_torque", "torque": 0.0}],
        log=EMPS,
        identify={"starts": 1},
    )
    log, holdout = (read_stretch(f"emps/DATA_EMPS{name}.mat", EMPS, 12.4) for name in ("", "_PULSES"))
    summary = identify(log, study, holdout=holdout).summary
    parameters = summary["parameters"]
    published = {
        "drive.motor_inertia": 95.109,
        "drive.motor_viscous": 203.50,
        "effects.motor.coulomb_friction.torque": 20.394,
        "effects.motor.constant_torque.torque": -3.165,
    }
    assert set(parameters) == set(published)
    for path, value in published.items():
        reach = 1.96 * parameters[path]["standard_error"]
        assert abs(parameters[path]["value"] - value) <= reach, (path, value)
        assert 2.0 * reach < 0.25 * abs(value)
        assert parameters[path]["interval"] == [None, None]
    # Coulomb friction is not all that resists: its level changes with speed
    assert summary["rejected"]["lacks"]["channel"] == "velocity"
    torque = summary["torque"]["motor"]
    assert torque["relative"] < 0.042
    assert torque["unit"] == "N"
    assert summary["holdout"]["torque"]["motor"]["relative"] < 0.054


def test_xl330_pendulum_swings_freely():
    """Gravity and friction from two free swings with uneven stamps; better than the published 0.018 rad rms."""
    study = rigid_study(
        {"drive.motor_inertia": 0.0049, "drive.motor_viscous": 0.005, "run.substeps": 2, "run.sample_period": 3.5e-3},
        effects=[{"kind": "load.gravity", "torque": 0.4}, {"kind": "motor.coulomb_friction", "torque": 0.02}],
        uncertainty={"exact": ["drive.motor_inertia"]},
        log={key: XL330[key] for key in ("t", "theta_e")}
        | {"absent": ["u"], "where": {"torque_enable": False}, "resample": 3.5e-3},
        identify={"starts": 1, "window": 3.9},
    )
    logs = [find_recording(f"bam_xl330/2026-01-15_{time}.json") for time in ("10h28m17", "10h29m21")]
    identification = identify(logs, study)
    assert identification.summary["residual"]["motor"]["rms"] < 0.019
    parameters = identification.summary["parameters"]
    assert set(parameters) == {
        "drive.motor_viscous",
        "effects.load.gravity.torque",
        "effects.load.gravity.phase",
        "effects.motor.coulomb_friction.torque",
    }
    friction = parameters["effects.motor.coulomb_friction.torque"]
    assert 1.96 * friction["standard_error"] < friction["value"] < 0.02 - 1.96 * friction["standard_error"]
    assert any("taken to move freely" in note for note in identification.summary["notes"])
    # of the inertia m l² = 0.0049 kg m², a mass point: gravity pulls less, as the servo's own inertia adds to it
    assert 0.3 < parameters["effects.load.gravity.torque"]["value"] < 0.49 * 0.1 * 9.81


def test_the_least_lambda_of_the_gains_that_are_tried_is_that_of_the_condition():
    alpha, bound = 7.3 * observer_gains._ALPHA, 7.3
    least = least_lambda_exact(jnp.asarray(alpha), jnp.full(len(alpha), bound))
    np.testing.assert_allclose(np.sqrt(bound) * observer_gains._LEAST_LAMBDA, least, rtol=1e-13)


@pytest.mark.parametrize("ratio", [1.0, 2.2, 2.5, 4.0])
def test_a_drive_that_friction_stops_within_a_period_gives_numbers(ratio, tmp_path):
    """Geared servos at 50 to 100 Hz: nothing overflows, and one line says that observers cannot run."""
    inertia, period, count = 1e-3, 0.01, 1500
    viscous = ratio * inertia / period
    rng = np.random.default_rng(int(10 * ratio))
    time = np.arange(count) * period
    u = sum(np.sin(2.0 * np.pi * f * time + rng.uniform(0.0, 6.0)) for f in (0.4, 1.3, 3.1, 7.7, 14.0))
    # exactly, with the input held over each period
    decay = np.exp(-ratio)
    velocity, position = np.zeros(count), np.zeros(count)
    for k in range(count - 1):
        final = u[k] / viscous
        velocity[k + 1] = final + (velocity[k] - final) * decay
        position[k + 1] = position[k] + final * period + (velocity[k] - final) * (1.0 - decay) * inertia / viscous
    log = pd.DataFrame({"t": time, "u": u, "theta_e": position + 2e-5 * rng.normal(size=count)})
    log.to_csv(tmp_path / "log.csv", index=False)
    model = {
        "drive": {"kind": "rigid", "motor_inertia": 1.2 * inertia, "motor_viscous": 0.9 * viscous},
        "uncertainty": {"relative": 0.3},
        "run": {"substeps": 20},
        "log": {"absent": ["theta_s"]},
    }
    summary = identify(tmp_path / "log.csv", model).summary
    numbers = {name: number["value"] for name, number in summary["parameters"].items()}
    assert numbers["drive.motor_viscous"] == pytest.approx(viscous, rel=0.01)
    assert numbers["drive.motor_inertia"] == pytest.approx(inertia, rel=0.03)
    lines = [note for note in summary["notes"] if "observers cannot run at this period" in note]
    assert len(lines) == (ratio >= 2.0)
