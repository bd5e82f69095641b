import numpy as np

import jaxbl
from jaxbl.control import SineReference, StateFeedback
from jaxbl.drive.effects import make_effect

GAINS = {"motor_position": 30.0, "motor_velocity": 3.0, "load_position": 4.0, "load_velocity": 2.0}


def make_axis(**gains):
    return jaxbl.experiment(
        jaxbl.Experiment(
            drive=jaxbl.TwoInertia(0.05, 0.15, 1.0, 2.0, 5.0),
            transmission=jaxbl.LinearShaft(600.0),
            effects=(make_effect("motor.constant_torque", torque=1.0),),
            observer=jaxbl.Observers(jaxbl.ExtendedState(300.0), jaxbl.ExtendedState(300.0)),
            controller=StateFeedback(side="load", **GAINS | gains),
            reference=SineReference(0.1, 0.5),
            run=jaxbl.Run(1e-3, 4000),
        )
    )


def test_torque_is_that_of_the_law():
    signals = jaxbl.simulate(make_axis())
    target, motor, load = signals.target, signals.motor, signals.load
    torque = (
        30.0 * (5.0 * target.position - motor.position_estimate) + 3.0 * (5.0 * target.velocity - motor.velocity_estimate)
        + 4.0 * (target.position - load.position_estimate) + 2.0 * (target.velocity - load.velocity_estimate)
        - 0.05 * motor.equivalent_control
    )  # fmt: skip
    np.testing.assert_allclose(signals.input[1:], torque[:-1], rtol=1e-9, atol=1e-9)


def test_the_disturbance_is_compensated():
    """A constant torque of 1 N m and the load leave an error of about 1 / 30 rad to the gains alone."""
    alone, compensated = (
        float(jaxbl.metrics(make_axis(disturbance=share), names=("following_rmse",))["motor.following_rmse"])
        for share in (0.0, 1.0)
    )
    assert alone > 0.02
    assert compensated < 0.2 * alone
