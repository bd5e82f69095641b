"""The observers' equivalent control beside the smoother: the same missing torque, with noise of the size that is told."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hidden_log import DRIVE, FRICTION, FRICTIONS, GAP, GEARED, nominal_study, simulate_geared_drive, simulate_multisine_log
from scipy.signal import lfilter

import jaxbl.diagnosis.observer_residual as under_test
from jaxbl.diagnosis.diagnosis_task import read_diagnosis_task
from jaxbl.diagnosis.observer_residual import compare_observers, observed_torques
from jaxbl.diagnosis.residuals import narrow, residual_torques
from jaxbl.drive.effects import DELAY_SAMPLES
from jaxbl.drive.parameters import set_leaves
from jaxbl.estimation.logs import on_record
from jaxbl.estimation.segments import segments_of

GAINS = {
    "direct": {"motor": (2.0, 6.3)},
    "geared": {"motor": (15.0, 345.0), "load": (2.85, 12.3)},
}
"""lambda and alpha, as chosen on these logs."""
TIME_CONSTANT = 0.01
"""Time constant of the equivalent control, s."""


@pytest.fixture(autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Logs of a direct drive and of a geared one, and the speeds of the latter."""
    folder = tmp_path_factory.mktemp("logs")
    simulate_multisine_log().write(folder / "direct.csv")
    log, speeds = simulate_geared_drive()
    log.write(folder / "geared.csv")
    return folder, speeds


def read_residuals(logs, name, study, gains=None):
    """The experiment with gains, the smoother's residuals of its log, and the observers'."""
    task = read_diagnosis_task(logs[0] / f"{name}.csv", study)
    nominal = on_record(task.config, task.record)
    segments = segments_of(task.record, nominal.sides)
    values = {
        f"observer.{side}.{gain}": jnp.asarray(value)
        for side, pair in (gains or GAINS[name]).items()
        for gain, value in zip(("lambda", "alpha"), pair, strict=True)
    }
    nominal = set_leaves(nominal, values)
    return nominal, residual_torques(nominal, segments), observed_torques(nominal, segments)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def low_pass(torque, period):
    """Filter a torque by the equivalent control's low-pass."""
    share = -np.expm1(-period / TIME_CONSTANT)
    return lfilter([share], [1.0, share - 1.0], torque)


def test_observers_see_what_the_smoother_sees_on_both_sides(logs):
    experiment, residuals, observed = read_residuals(logs, "geared", nominal_study(drive=GEARED, transmission=GAP))
    for side, friction in zip(("motor", "load"), FRICTIONS, strict=True):
        (witness,) = observed[side]
        assert witness.has_converged and witness.stuck < 0.02
        assert len(witness.residual.time) + witness.skipped == 1500 - DELAY_SAMPLES and 50 <= witness.skipped < 60
        description = compare_observers(experiment, observed[side], residuals[side], 30.0)
        assert description["correlation"] > 0.99
        assert (
            description["rms"] == pytest.approx(description["smoother_rms"], rel=0.03)
            and description["rms"] > 10.0 * description["noise"]
        )
        assert description["bandwidth"] == pytest.approx(1.0 / (2.0 * np.pi * TIME_CONSTANT))
        # what is missing, with its sign and late by the low-pass: the truth that neither of them knows
        missing = low_pass(-friction["torque"] * np.sign(logs[1][side]), 2e-3)[DELAY_SAMPLES + witness.skipped : 1500]
        low, _ = narrow(witness.residual, 10.0)
        true, _ = narrow(replace(witness.residual, torque=missing), 10.0)
        assert np.corrcoef(low.torque, true.torque)[0, 1] > 0.99
        assert rms(low.torque) == pytest.approx(rms(true.torque), rel=0.05)


@pytest.mark.parametrize(("drive", "discretisation"), [("geared", "implicit"), ("direct", "explicit")])
def test_a_complete_model_leaves_noise_of_the_stated_size(logs, drive, discretisation):
    tables = {"drive": DRIVE, "effects": [FRICTION]}
    if drive == "geared":
        tables = {"drive": GEARED, "transmission": GAP, "effects": FRICTIONS}
    _, _, observed = read_residuals(logs, drive, nominal_study(observer={"discretisation": discretisation}, **tables))
    for side, (witness,) in observed.items():
        scores = [rms(witness.residual.torque / witness.residual.deviation)]
        for cutoff in (40.0, 20.0, 10.0):
            low, _ = narrow(witness.residual, cutoff)
            scores.append(rms(low.torque / low.deviation))
        # the explicit one has a lag of its own, which shows behind narrow low-passes
        if discretisation == "implicit":
            np.testing.assert_allclose(scores, 1.0, atol=0.3, err_msg=side)
        else:
            np.testing.assert_allclose(scores[:2], 1.0, atol=0.45, err_msg=side)


def test_a_rigid_drive_has_one_witness(logs):
    experiment, residuals, observed = read_residuals(logs, "direct", nominal_study())
    assert list(observed) == ["motor"]
    description = compare_observers(experiment, observed["motor"], residuals["motor"], 30.0)
    assert description["correlation"] > 0.98 and description["rms"] == pytest.approx(FRICTION["torque"], rel=0.1)


@pytest.mark.parametrize("alpha", [1.0, 2.5])
def test_an_observer_with_too_little_gain_is_told_apart(logs, alpha):
    """The torque that is missing makes 3 rad/s^2."""
    experiment, residuals, observed = read_residuals(logs, "direct", nominal_study(), {"motor": (2.0, alpha)})
    (witness,) = observed["motor"]
    assert witness.stuck > 0.5 and not witness.has_converged
    description = compare_observers(experiment, observed["motor"], residuals["motor"], 30.0)
    assert description["converged"] is False and {description[name] for name in ("rms", "noise", "correlation")} == {None}


def test_an_observer_that_overflows_says_nothing(logs, monkeypatch):
    compute_controls = under_test._controls

    def controls(*inputs):
        return {side: values.at[0, -1].set(np.inf) for side, values in compute_controls(*inputs).items()}

    monkeypatch.setattr(under_test, "_controls", controls)
    _, _, observed = read_residuals(logs, "direct", nominal_study())
    assert not observed["motor"][0].has_converged and np.isnan(observed["motor"][0].residual.deviation).all()
