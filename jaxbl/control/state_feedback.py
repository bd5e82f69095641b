"""State feedback with the disturbance that the motor's observer finds."""

import jax.numpy as jnp

from jaxbl.drive.parameters import Scalar, parameter

from .base import CONTROLLERS, AbstractController, ControllerState


@CONTROLLERS.add
class StateFeedback(AbstractController):
    """State feedback: u = sum over sides of k_x (x* - x_hat) + k_v (v* - v_hat), minus the disturbance found on the motor.

    The disturbance is J_e times the filtered equivalent control: with an extended-state observer this is active disturbance
    rejection. Reference: J. Han, IEEE Trans. Ind. Electron. 56 (2009).
    """

    name = "state_feedback"
    motor_position: Scalar = parameter("N m/rad", "gain of the motor's position error")
    motor_velocity: Scalar = parameter("N m s/rad", "gain of the motor's velocity error")
    load_position: Scalar = parameter("N m/rad", "gain of the load's position error", default=0.0)
    load_velocity: Scalar = parameter("N m s/rad", "gain of the load's velocity error", default=0.0)
    disturbance: Scalar = parameter("", "share of the disturbance that is compensated", default=1.0)

    def start(self, measured):
        return ControllerState(jnp.zeros_like(measured["motor"]))

    def step(self, state, feedback, target, drive, period):
        torque = -self.disturbance * drive.inertia("motor") * feedback.control["motor"]
        for side in ("motor", "load")[: len(drive.sides)]:
            turns = drive.ratio(self.side) / drive.ratio(side)
            torque = torque + getattr(self, f"{side}_position") * (turns * target.position - feedback.position[side])
            torque = torque + getattr(self, f"{side}_velocity") * (turns * target.velocity - feedback.velocity[side])
        return ControllerState(self.limit(state.torque, torque, period))
