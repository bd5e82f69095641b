"""Bias by feedback: logs of a simulated loop with a disturbance that u does not have, beside instruments in NumPy."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import jaxbl
from jaxbl.control import Cascade, FunctionReference
from jaxbl.estimation.feedback_bias import find_feedback_bias

INERTIA, VISCOUS, STEPS = 0.05, 0.15, 20_000
MODEL = {
    "drive": {"kind": "rigid", "motor_inertia": INERTIA, "motor_viscous": VISCOUS},
    "uncertainty": {"relative": 0.5},
    "log": {"reference": {}},
}


def simulate_log(path, disturbance, seed=0):
    """A log of a loop whose drive feels a random torque (N m rms) beside the controller's; only that one is recorded."""
    levels = jnp.asarray(np.random.default_rng(seed).standard_normal(STEPS // 20 + 1) * disturbance)
    added = lambda time: levels[jnp.floor(time / 0.02 + 1e-6).astype(int)]  # noqa: E731
    waves = lambda time: 0.3 * jnp.sin(2.0 * jnp.pi * 0.7 * time) + 0.1 * jnp.sin(2.0 * jnp.pi * 2.3 * time)  # noqa: E731
    experiment = jaxbl.experiment(
        jaxbl.Experiment(
            drive=jaxbl.Rigid(INERTIA, VISCOUS),
            excitation=added,
            encoders=jaxbl.Encoders(noise=1e-5),
            observer=jaxbl.Observers(jaxbl.ExtendedState(300.0)),
            controller=Cascade(20.0, 3.0, speed_from="differences", speed_filter=2e-3),
            reference=FunctionReference(waves),
            run=jaxbl.Run(1e-3, STEPS),
        )
    )
    signals = jaxbl.simulate(experiment)
    torque = np.asarray(signals.input) - np.asarray(jax.vmap(added)(signals.time))
    columns = {"t": signals.time, "u": torque, "theta_e": signals.motor.measured, "reference": signals.target.position}
    pd.DataFrame({name: np.asarray(column) for name, column in columns.items()}).to_csv(path, index=False)
    return path


def fit_by_instruments(log):
    """Inertia and viscous friction at differences of readings, by least squares and with the reference as instrument."""
    frame = pd.read_csv(log)

    def derive(position):
        # over 20 ms, which noise does not reach
        speed = (position[40:] - position[:-40]) / 0.04
        return np.stack([(speed[40:] - speed[:-40]) / 0.04, speed[20:-20]], axis=1)

    motion, instruments = derive(frame["theta_e"].to_numpy()), derive(frame["reference"].to_numpy())
    kernel = np.convolve(np.ones(40) / 40, np.ones(40) / 40)
    torque = np.convolve(frame["u"], kernel, "valid")[: len(motion)]
    return np.linalg.solve(motion.T @ motion[: len(torque)], motion.T @ torque), np.linalg.solve(
        instruments.T @ motion, instruments.T @ torque
    )


@pytest.mark.parametrize("disturbance", [0.0, 1.0])
def test_bias_is_found_where_the_disturbance_is(tmp_path, disturbance):
    log = simulate_log(tmp_path / "log.csv", disturbance)
    result = jaxbl.identify(log, MODEL)
    found, drive = result.summary["feedback"]["motor"], result.model.drive
    assert result.summary["notes"][0] == found["sentence"]
    assert found["biased"] == (disturbance > 0.0)
    words = "biased by feedback" if disturbance else "no bias by feedback is seen"
    assert words in found["sentence"]
    # moved by the shifts, the numbers are the true ones, and those by instruments in NumPy
    _, by_instruments = fit_by_instruments(log)
    for key, number, true, other in zip(
        ("inertia", "viscous"), (drive.motor_inertia, drive.motor_viscous), (INERTIA, VISCOUS), by_instruments, strict=True
    ):
        error = found[key]["standard_error"]
        assert abs(number + found[key]["value"] - true) < 3.0 * error
        assert number + found[key]["value"] == pytest.approx(other, abs=0.7 * error + 0.02 * true)
    if disturbance:
        assert abs(drive.motor_inertia - INERTIA) > 5.0 * found["inertia"]["standard_error"]


def test_diagnose_says_it_as_well(tmp_path):
    summary = jaxbl.diagnose(simulate_log(tmp_path / "log.csv", 0.0), MODEL).summary
    assert summary["feedback"]["motor"]["biased"] is False
    assert summary["feedback"]["motor"]["sentence"] in summary["notes"]


def test_a_reference_at_rest_tests_nothing(tmp_path):
    log = simulate_log(tmp_path / "log.csv", 0.0)
    frame = pd.read_csv(log).assign(reference=0.0)
    frame.to_csv(log, index=False)
    found = jaxbl.identify(log, MODEL).summary["feedback"]["motor"]
    assert found["biased"] is None
    assert found["sentence"].startswith("motor: the reference does not move")


def test_without_a_reference_nothing_is_said(tmp_path):
    log = simulate_log(tmp_path / "log.csv", 0.0)
    assert jaxbl.identify(log, MODEL | {"log": {}}).summary["feedback"] == {}


def test_pieces_of_a_few_samples_test_nothing():
    record, pieces = SimpleNamespace(reference=np.zeros(60)), [np.zeros(30), np.zeros(30)]
    assert find_feedback_bias(record, pieces, None) == {}
