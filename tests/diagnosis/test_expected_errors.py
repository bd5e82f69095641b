"""What a complete model leaves on held-out data: truth from the bench's own simulator."""

import dataclasses

import jax
import numpy as np
import pytest
from hidden_log import FRICTION, nominal_study, simulate_multisine_log
from scipy import stats

from jaxbl.diagnosis.choice import Choice
from jaxbl.diagnosis.diagnosis_task import read_diagnosis_task
from jaxbl.diagnosis.expected_errors import _quantile, expected_errors, list_failed
from jaxbl.diagnosis.proof import open_held_out
from jaxbl.diagnosis.setup import set_up
from jaxbl.diagnosis.thresholds import LIMITS


def compare_with_expected(folder, log, effects, noise=None):
    """Errors of a model with some effects on the last quarter of a log, and what is expected of a complete one; `noise`: of
    the readings as a smoother would have it, rad."""
    log.write(folder / "axis.csv")
    task = read_diagnosis_task(folder / "axis.csv", nominal_study())
    with jax.enable_x64(True):
        setup = set_up(task)
        fitted = Choice(setup).search.fits.fit(effects, np.zeros(len(setup.free)))
        _, holdout = open_held_out(setup)
        if noise is not None:
            segments = []
            for segment in holdout.segments:
                motions = {side: motion._replace(noise=noise) for side, motion in segment.smoothed.items()}
                segments.append(dataclasses.replace(segment, smoothed=motions))
            holdout = dataclasses.replace(holdout, segments=segments)
        after = holdout.compare(fitted.experiment)
        expected = expected_errors(holdout, fitted, after, setup.input_noise, 0.5)
        return after.errors, expected


@pytest.mark.parametrize("torque_noise", [0.0, 0.02])
def test_a_complete_model_passes_and_an_incomplete_one_fails(torque_noise, tmp_path):
    log = simulate_multisine_log(torque_noise=torque_noise)
    errors, expected = compare_with_expected(tmp_path, log, {"motor.coulomb_friction": {"torque": FRICTION["torque"]}})
    assert {name.partition(" below ")[0] for name in expected} == {"theta_e", "torque_motor"}
    assert list_failed(errors, expected) == []
    # an input with noise that the drive has not felt moves the model, by as much as is expected
    position = expected["theta_e"]
    if torque_noise:
        assert errors["theta_e"] > 3.0 * position.noise
        assert errors["theta_e"] == pytest.approx(position.open, rel=0.6)
    errors, expected = compare_with_expected(tmp_path, log, {})
    assert "torque_motor" in list_failed(errors, expected)


def test_torques_too_small_to_be_named_do_not_fail_a_model(tmp_path):
    errors, expected = compare_with_expected(
        tmp_path, simulate_multisine_log(), {"motor.coulomb_friction": {"torque": FRICTION["torque"]}}
    )
    # of the 0.5 N m that drive it
    assert expected["torque_motor"].least == pytest.approx(0.5 * LIMITS.least_torque)
    more = errors | {"torque_motor": 1.05 * expected["torque_motor"].limit}
    assert list_failed(more, expected) == ["torque_motor"]
    assert list_failed(errors | {"theta_e": np.inf}, expected) == ["theta_e"]
    # a limit that is none excuses nothing
    assert list_failed(errors, expected | {"theta_e": expected["theta_e"]._replace(limit=np.inf)}) == ["theta_e"]


@pytest.mark.parametrize("freedom", [1, 4, 30])
def test_the_quantile_is_that_of_sums_of_squares(freedom):
    drawn = stats.chi2.rvs(freedom, scale=3.0, size=4000, random_state=1)
    assert _quantile(drawn, LIMITS.failing) == pytest.approx(
        stats.chi2.ppf(1.0 - LIMITS.failing, freedom, scale=3.0), rel=0.1
    )
    assert _quantile(np.full(6, 2.0), LIMITS.failing) == 2.0 and _quantile(np.zeros(6), LIMITS.failing) == 0.0


def test_a_slow_torque_that_noise_hides_at_full_bandwidth_is_seen(tmp_path):
    log = simulate_multisine_log(noise=3e-4)
    slow = 0.03 * np.sin(2.0 * np.pi * 0.4 * log.t)
    errors, expected = compare_with_expected(
        tmp_path, dataclasses.replace(log, u=log.u - slow), {"motor.coulomb_friction": {"torque": FRICTION["torque"]}}
    )
    failures = list_failed(errors, expected)
    assert "torque_motor" not in failures and any(name.startswith("torque_motor below ") for name in failures)


def test_noise_that_a_smoother_takes_for_motion_is_seen_in_the_errors(tmp_path):
    """A smoother finds too little noise of a rough motion; the errors of the model have no motion in them."""
    friction = {"motor.coulomb_friction": {"torque": FRICTION["torque"]}}
    log = simulate_multisine_log(noise=1e-4)
    _, known = compare_with_expected(tmp_path, log, friction, noise=1e-4)
    _, expected = compare_with_expected(tmp_path, log, friction, noise=2e-5)
    assert expected["theta_e"].noise == pytest.approx(known["theta_e"].noise, rel=0.15)
    # windows are foretold from a state that noise makes uncertain
    assert 1e-4 < known["theta_e"].noise < 2e-4
