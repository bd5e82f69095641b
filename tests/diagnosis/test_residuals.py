"""Residual torques: a known missing torque is found within its stated noise, and a complete model leaves only noise."""

import numpy as np
import pytest
from hidden_log import simulate_study
from small_study import rigid_study, small_study
from trace_segment import make_segment

from jaxbl.config import prepare, read_config
from jaxbl.diagnosis.residuals import Residual, as_smoothed, narrow, residual_torques
from jaxbl.estimation.regression import balance

SETTINGS = {"run.duration": 4.0, "run.substeps": 5}
OBSERVER = {"motor": {"lambda": 20.0, "alpha": 400.0}, "load": {"lambda": 3.0, "alpha": 20.0}}
GAP = {"law": "dead_zone", "stiffness": 60.0, "half_gap": 0.08}
FRICTION = {"kind": "motor.coulomb_friction", "torque": 0.1}


def study(sides, effects=()):
    tables = {"effects": list(effects), "observer": OBSERVER if sides == 2 else {"motor": OBSERVER["motor"]}}
    if sides == 1:
        return rigid_study(SETTINGS, excitation={"kind": "multisine", "amplitude": 1.0, "frequency": 0.5}, **tables)
    excitation = {"kind": "multisine", "amplitude": 5.0, "frequency": 0.5}
    return small_study(SETTINGS, excitation=excitation, transmission=GAP, **tables)


def simulate_record(data, seed=0, transmitted=None):
    """Simulate a study, and return the trace and its segment."""
    trace = simulate_study(data, seed)
    measured = None if transmitted is None else trace["torque"].to_numpy() + transmitted
    return trace, make_segment(trace, transmitted=measured)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def score_residual(residual, cutoff=None):
    if cutoff is not None:
        residual, _ = narrow(residual, cutoff)
    return rms(residual.torque / residual.deviation)


@pytest.mark.parametrize(("sides", "effects"), [(1, [FRICTION]), (2, [])], ids=["friction", "geared"])
def test_a_complete_model_leaves_noise_of_the_stated_size_in_every_band(sides, effects):
    side_scores = {}
    experiment = prepare(read_config(study(sides, effects)))
    for seed in range(3):
        _, segment = simulate_record(study(sides, effects), seed)
        for side, (residual,) in residual_torques(experiment, [segment]).items():
            bands = [score_residual(residual), score_residual(residual, 20.0), score_residual(residual, 8.0)]
            side_scores.setdefault(side, []).append(bands)
    assert set(side_scores) == set(experiment.sides)
    for bands in side_scores.values():
        np.testing.assert_allclose(np.mean(bands, axis=0), [1.0, 1.0, 1.05], atol=0.15)


def test_the_missing_torque_is_found_within_its_noise_and_with_its_sign():
    experiment = prepare(read_config(study(1)))
    errors = []
    for seed in range(3):
        trace, segment = simulate_record(study(1, [FRICTION]), seed)
        (residual,) = residual_torques(experiment, [segment])["motor"]
        missing = -0.1 * np.sign(trace["motor.velocity"].to_numpy())
        smoothed = np.asarray(as_smoothed(missing, segment.smoothed["motor"], 1e-3))
        errors.append(rms((residual.torque - smoothed) / residual.deviation))
        assert score_residual(residual) > 3.0
        # the other way round as the balance
        balance_torque = -np.asarray(balance(experiment, segment.kinematics)["motor"].residual)
        assert np.corrcoef(balance_torque[200:-200], residual.torque[200:-200])[0, 1] > 0.97
    assert np.mean(errors) == pytest.approx(1.0, abs=0.1)


def test_a_measured_torque_takes_the_place_of_the_models():
    noise = 0.02 * np.random.default_rng(0).standard_normal(4000)
    _, segment = simulate_record(study(2), transmitted=noise)
    for stiffness in (60.0, 50.0):
        experiment = prepare(read_config(study(2) | {"transmission": GAP | {"stiffness": stiffness}}))
        residuals = residual_torques(experiment, [segment])
        assert list(residuals) == ["motor", "load"]
        for (residual,) in residuals.values():
            assert score_residual(residual) == pytest.approx(1.0, abs=0.12)


def test_narrowing_keeps_the_noise_level_and_what_is_slow():
    random = np.random.default_rng(2)
    time = 1e-3 * np.arange(20000)
    slow = np.sin(2.0 * np.pi * 0.7 * time)
    white = Residual("motor", time, slow + random.standard_normal(20000), np.ones(20000), np.ones(2), 500.0)
    low, rows = narrow(white, 5.0)
    assert len(low.time) < 2000 and low.bandwidth == 5.0
    np.testing.assert_array_equal(low.time, time[rows])
    assert rms((low.torque - slow[rows]) / low.deviation) == pytest.approx(1.0, abs=0.1)
    narrowed_twice, _ = narrow(low, 2.5)
    narrowed_once, _ = narrow(white, 2.3)
    assert narrowed_twice.deviation[50] == pytest.approx(narrowed_once.deviation[50], rel=0.1)


def test_narrowing_tells_the_noise_that_remains_of_noise_that_grows_with_the_frequency():
    noise = np.diff(np.random.default_rng(3).standard_normal(20002), n=2)
    density = (2.0 * np.sin(0.5 * np.linspace(0.0, np.pi, 513))) ** 4
    blue = Residual("motor", 1e-3 * np.arange(20000), noise, np.full(20000, np.sqrt(6.0)), density, 500.0)
    for cutoff in (200.0, 50.0, 20.0):
        low, _ = narrow(blue, cutoff)
        assert rms(low.torque / low.deviation) == pytest.approx(1.0, abs=0.1)
