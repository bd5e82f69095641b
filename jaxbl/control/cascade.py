"""The cascade of servo drives: a position loop around a speed loop."""

from typing import Literal

import jax.numpy as jnp

from jaxbl.drive.parameters import Scalar, option, parameter

from .base import CONTROLLERS, AbstractController, ControllerState


@CONTROLLERS.add
class Cascade(AbstractController):
    """P-PI cascade: a position gain asks for a motor speed, a PI controller with feed-forward makes the torque.

        v* = N (k_p (x* - x) + c x*')
        u = k_v (v* - v) + (k_v / T_i) integral(v* - v) + N (J x*'' + d x*') + F sign(x*')

    Here x is the position of `side`, N its ratio to the motor, v the motor's speed, c = `velocity_feedforward`, J =
    `inertia_feedforward`, d and F those of friction. Anti-windup is by back-calculation: what the limits cut off the torque
    flows back into the integral, with the time constant T_i. Reference: K. J. Astrom, L. Rundqwist, Proc. American Control
    Conf. (1989).

    `gap_compensation` is the inverse of a gap (rad, half of it, on the motor side): the motor's position is led by it in the
    direction of the reference, and crosses the gap at `gap_speed` where that turns around. From the observed twist, the
    lead follows that at `gap_speed`, up to the gap: also of a load that runs ahead, and of a gap that is smaller.
    """

    name = "cascade"
    position_gain: Scalar = parameter("1/s", "gain of the position loop", minimum=0.0)
    speed_gain: Scalar = parameter("N m s/rad", "gain of the speed loop", minimum=0.0)
    integral_time: Scalar | None = parameter(
        "s", "integral time of the speed loop; left out: no integral", default=None, above=0.0
    )
    speed_from: Literal["observer", "differences"] = option("where the motor's speed comes from", default="observer")
    speed_filter: Scalar = parameter("s", "time constant of the low-pass on differences", default=0.0, minimum=0.0)
    speed_limit: Scalar | None = parameter("rad/s", "largest motor speed asked for; left out: none", default=None, above=0.0)
    velocity_feedforward: Scalar = parameter("", "share of the reference's velocity", default=1.0, minimum=0.0)
    inertia_feedforward: Scalar = parameter("kg m²", "inertia of feed-forward, on the motor side", default=0.0, minimum=0.0)
    viscous_feedforward: Scalar = parameter("N m s/rad", "viscous friction of feed-forward", default=0.0, minimum=0.0)
    friction_feedforward: Scalar = parameter("N m", "dry friction of feed-forward", default=0.0, minimum=0.0)
    gap_compensation: Scalar = parameter("rad", "half gap to compensate, on the motor side", default=0.0, minimum=0.0)
    effects_feedforward: Scalar | None = parameter(
        "", "share of the study's [[effects]] on the sides that is fed forward; left out: none", default=None, minimum=0.0
    )
    gap_from: Literal["reference", "twist"] = option("what says where in the gap the load is", default="reference")
    gap_speed: Scalar = parameter("rad/s", "motor speed at which the gap is crossed", default=10.0, above=0.0)

    @property
    def reads_observers(self):
        return self.speed_from == "observer" or self.gap_from == "twist"

    def start(self, measured):
        zero = jnp.zeros_like(measured["motor"])
        # integral, speed, last reading, lead over the gap
        return ControllerState(zero, (zero, zero, measured["motor"], zero))

    def step(self, state, feedback, target, drive, period):
        integral, speed, last, lead = state.further
        ratio, reading = drive.ratio(self.side), feedback.measured["motor"]
        if self.speed_from == "observer":
            speed = feedback.velocity["motor"]
        else:
            speed = speed + period / (period + self.speed_filter) * ((reading - last) / period - speed)
        goal = jnp.where(target.velocity == 0.0, lead, self.gap_compensation * jnp.sign(target.velocity))
        if self.gap_from == "twist":
            twist = feedback.position["motor"] - drive.ratio("load") * feedback.position["load"]
            goal = jnp.clip(twist, -self.gap_compensation, self.gap_compensation)
        crossing = jnp.clip(goal - lead, -self.gap_speed * period, self.gap_speed * period)
        error = ratio * (target.position - feedback.measured[self.side])
        if self.side == "motor":
            error = error + lead
        speed_goal = (
            self.position_gain * error
            + self.velocity_feedforward * ratio * target.velocity
            + (crossing / period if self.gap_from == "reference" else 0.0)
        )
        if self.speed_limit is not None:
            speed_goal = jnp.clip(speed_goal, -self.speed_limit, self.speed_limit)
        proportional = self.speed_gain * (speed_goal - speed)
        feedforward = ratio * (self.inertia_feedforward * target.acceleration + self.viscous_feedforward * target.velocity)
        torque = proportional + integral + feedforward + self.friction_feedforward * jnp.sign(target.velocity)
        if self.effects_feedforward is not None:
            torque = torque + self.effects_feedforward * self.effect_torque(state, feedback, target, drive, period)
        limited = self.limit(state.torque, torque, period)
        if self.integral_time is not None:
            integral = integral + period / self.integral_time * (proportional + limited - torque)
        return ControllerState(limited, (integral, speed, reading, lead + crossing))
