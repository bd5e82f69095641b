"""Numbers of least missing torque."""

import jax
import numpy as np
import pytest
from hidden_log import FRICTION, nominal_study, simulate_multisine_log

from jaxbl.diagnosis.choice import Choice
from jaxbl.diagnosis.diagnosis_task import read_diagnosis_task
from jaxbl.diagnosis.setup import set_up
from jaxbl.diagnosis.torque_fit import fit_to_torque
from jaxbl.identification.free_parameters import set_free_parameters

KIND, TORQUE = FRICTION["kind"], FRICTION["torque"]


def test_a_complete_model_has_the_same_numbers_by_torque_wherever_the_fit_begins(tmp_path):
    simulate_multisine_log(("friction",)).write(tmp_path / "axis.csv")
    task = read_diagnosis_task(tmp_path / "axis.csv", nominal_study())
    with jax.enable_x64(True):
        setup = set_up(task)
        fits = Choice(setup).search.fits
        fitted = fits.fit({KIND: {"torque": TORQUE}}, np.zeros(len(setup.own)))
        by_torque = fit_to_torque(fits, fitted, setup.fitted)
        assert by_torque.numbers[KIND]["torque"] == pytest.approx(TORQUE, rel=0.05)
        deviation = np.sqrt(np.diag(by_torque.covariance))
        assert np.all(
            np.abs(by_torque.theta - fitted.theta) < 4.0 * np.hypot(deviation, np.sqrt(np.diag(fitted.covariance)))
        )
        assert np.all(deviation > 0.0) and by_torque.linear is not fitted.linear
        theta = fitted.theta + np.array([0.03, -0.03, 0.3])
        shifted_fit = fitted._replace(theta=theta, experiment=set_free_parameters(fitted.experiment, fitted.free, theta))
        torque_fit = fit_to_torque(fits, shifted_fit, setup.fitted)
    # the prior weighs more where more torque is missing at first
    np.testing.assert_allclose(torque_fit.theta, by_torque.theta, atol=3.0 * np.max(deviation))
    missing = [np.std(setup.fitted.missing(fitted.experiment)["motor"]) for fitted in (shifted_fit, torque_fit)]
    assert missing[1] < 0.5 * missing[0]
