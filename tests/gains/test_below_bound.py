"""Runs that converge with alpha below their bound: how far the disturbance throws an error off zero."""

import numpy as np
import pytest
from small_study import ALPHA, LAMBDA, listed_axis, rigid_study

from jaxbl.config import read_config, with_values
from jaxbl.gains.own_disturbance import read_disturbance, summarise_converged_below
from jaxbl.sweeps.sweep import sweep
from jaxbl.sweeps.trial import run

AMPLITUDE = "excitation.amplitude"
AXES = [listed_axis(AMPLITUDE, 0.1, 0.3), listed_axis(LAMBDA, 1.5, 3.0), listed_axis(ALPHA, 1.8, 1.95, 4.0)]
# friction that the observer does not know
STUDY = read_config(
    rigid_study(
        {"observer.motor.velocity_error": 0.05, "encoders.noise": 0.0, "run.duration": 6.0, "run.sample_period": 1e-3},
        effects=[{"kind": "motor.coulomb_friction", "torque": 0.1}],
        axes=AXES,
    )
)


@pytest.fixture(scope="module")
def sweep_frame():
    return sweep(STUDY).frame


def test_runs_below_their_bound_are_counted_and_explained(sweep_frame):
    below = sweep_frame[sweep_frame["motor.converged"] & (sweep_frame["motor.margin_alpha"] <= 1.0)]
    assert 2 <= len(below) < len(sweep_frame)
    summary = summarise_converged_below(STUDY, "motor", sweep_frame)
    assert summary["converged_runs"] == summary["runs"] == len(below)
    shares, areas = [], []
    for _, row in below.iterrows():
        trace = run(with_values(STUDY, {AMPLITUDE: row[AMPLITUDE]})).trace
        missing = np.abs(trace["motor.acceleration"] - (trace["u"] - 0.15 * trace["motor.velocity"]) / 0.05).to_numpy()
        shares.append((missing > row[ALPHA]).mean())
        areas.append(np.clip(missing - row[ALPHA], 0.0, None).sum() * 1e-3)
    assert summary["disturbance_exceeds"] == sum(share > 0.0 for share in shares) > 0
    assert summary["share_above_alpha"] == pytest.approx(max(shares))
    assert 0.0 < summary["excursion_predicted"] < max(areas)
    assert summary["excursion_predicted"] == pytest.approx(summary["excursion_simulated"], rel=1e-3)
    # that is why they count as converged
    assert summary["excursion_predicted"] < STUDY.run.velocity_tolerance
    axis_values = summary["at"]
    assert set(axis_values) == {AMPLITUDE, LAMBDA, ALPHA}
    assert axis_values[ALPHA] == 1.8


def test_no_run_is_below_its_bound(sweep_frame):
    assert summarise_converged_below(STUDY, "motor", sweep_frame[sweep_frame[ALPHA] == 4.0]) is None


def test_the_disturbance_is_what_the_model_lacks():
    study = with_values(STUDY, {AMPLITUDE: 0.3})
    trace = run(study).trace
    missing, velocity = read_disturbance(study.build().drive, "motor", trace).values, trace["motor.velocity"].to_numpy()
    slips = np.abs(velocity) > 0.05
    assert 0.2 < slips.mean() < 1.0
    # dry friction of 0.1 N m at 0.05 kg m^2; velocity and acceleration are half a period apart
    np.testing.assert_allclose(missing[slips], -2.0 * np.sign(velocity[slips]), rtol=0.01)
