"""Transmission laws and effects in a MuJoCo model: the elements that each needs, and how well MuJoCo has it."""

import math
from functools import singledispatch
from typing import Any

import numpy as np

from jaxbl.drive.effects import (
    AsymmetricFriction,
    BackEmf,
    Backlash,
    Cogging,
    CoggingHarmonics,
    ConstantTorque,
    CoulombFriction,
    Damping,
    Delay,
    DriftingFriction,
    Eccentricity,
    EncoderEffect,
    Flexibility,
    GainError,
    Gravity,
    Hardening,
    Hysteresis,
    Inertia,
    Lag,
    LoadFriction,
    PeriodicDisturbance,
    PreslidingFriction,
    QuadraticDrag,
    Saturation,
    StribeckFriction,
    Tabulated,
    TorqueRipple,
    TwistOffset,
    ViscousFriction,
)
from jaxbl.drive.effects.loads import MAX_DAMPING_RATIO
from jaxbl.drive.transmission import DeadZone, LinearShaft, SigmoidBacklash

from .mujoco_parts import IMPEDANCE, Answer, Bristles, FlexibleInertia, MujocoParts, Pendulum, exactly, nearly, unsaid

_NO_SLIDING = "the friction of the dcmotor (LuGre) needs a sliding torque above 0"

# Bristles stand for dry friction. Stiffer ones lag behind at high speed, and damped ones would need much shorter steps.
_BRISTLE_RATE = 0.06
"""Largest rate at which bristles swing times the time step."""
_BRISTLE_BEND = 0.15
"""Smallest bend of bristles, over the way of a time step at the Stribeck speed."""
_BRISTLE_STEPS = 4.0
"""Factor by which bristles shorten the time step."""


def to_mujoco(part: Any, parts: MujocoParts, *side: str) -> Answer:
    """Add a law or an effect to the parts of a MuJoCo model, and say how well the model has it.

    A class of another package is asked by its method `to_mujoco`, if it has one.

    Args:
        part: a transmission law or an effect; its numbers are Python floats.
        parts: parts of the model.
        side: side on which an effect acts; of one in the gear or the actuator, the motor. None for a law.
    """
    method = getattr(part, "to_mujoco", None)
    return _add(part, parts, *side) if method is None else method(parts, *side)


@singledispatch
def _add(part: Any, parts: MujocoParts, *side: str) -> Answer:
    return unsaid("its class does not say how")


# transmission laws


@_add.register(SigmoidBacklash)
def _(law, parts):
    # springs in parallel, each slack up to its corner
    corners, slopes, error = _approximate_tanh()
    softening = 2.0 * law.slope * law.dead_zone * law.stiffness
    parts.add_gear_spring(law.stiffness - softening * slopes[0])
    for corner, before, after in zip(corners[1:], slopes, [*slopes[1:], 0.0], strict=True):
        parts.add_gear_spring(softening * (before - after), slack=2.0 / law.slope * corner)
    return nearly(
        f"{len(corners)} springs in parallel, with dead bands: the torque is at most "
        f"{4.0 * law.dead_zone * law.stiffness * error:.2g} N m off, {error:.1g} of 4 j_0 K"
    )


def _approximate_tanh() -> tuple[list[float], list[float], float]:
    """Corners and slopes of chords of tanh over x > 0, of which the last ends at 1, and their largest error."""
    x = np.linspace(0.0, 4.0, 4001)
    # the error of a chord goes with the second derivative and the square of its length
    density = np.cumsum(np.sqrt(np.tanh(x)) / np.cosh(x))
    corners = np.interp(np.linspace(0.0, 1.0, 25), density / density[-1], x)
    heights = np.append(np.tanh(corners[:-1]), 1.0)
    error = np.max(np.abs(np.interp(x, corners, heights) - np.tanh(x)))
    return corners.tolist(), (np.diff(heights) / np.diff(corners)).tolist(), float(error)


@_add.register(LinearShaft)
def _(law, parts):
    parts.add_gear_spring(law.stiffness)
    return exactly("spring of a tendon between the joints")


@_add.register(DeadZone)
def _(law, parts):
    parts.half_gap += law.half_gap
    parts.add_gear_spring(law.stiffness)
    return exactly("spring of a tendon between the joints, slack within the gap (springlength)")


# friction


@_add.register(CoulombFriction)
def _(effect, parts, side):
    parts.sides[side].dry += effect.torque
    # MuJoCo leaves a friction row at rest (1 - impedance) of the free acceleration, against the damping 1 / step
    creep = (1.0 - IMPEDANCE) * parts.step * effect.torque / parts.sides[side].inertia
    return nearly(
        f"frictionloss of the joint: exact while it slides; where it should stick it creeps by up to {creep:.2g} rad/s"
    )


@_add.register(StribeckFriction)
def _(effect, parts, side):
    if effect.torque <= 0.0:
        return unsaid(_NO_SLIDING)
    step, torque, speed = parts.shorten_step(_BRISTLE_STEPS), effect.torque, effect.stribeck_velocity
    stiffness = min(parts.sides[side].inertia * (_BRISTLE_RATE / step) ** 2, torque / (_BRISTLE_BEND * step * speed))
    parts.add_bristles(side, Bristles(stiffness, 0.0, torque, effect.breakaway_torque, speed))
    bend = max(torque, effect.breakaway_torque) / stiffness
    return nearly(f"LuGre friction of a passive dcmotor: contacts bend by up to {bend:.2g} rad before they slide")


@_add.register(PreslidingFriction)
def _(effect, parts, side):
    if effect.torque <= 0.0:
        return unsaid(_NO_SLIDING)
    stiffness, breakaway = effect.torque / effect.length, effect.torque * effect.breakaway_ratio
    parts.add_bristles(side, Bristles(stiffness, effect.damping, effect.torque, breakaway, effect.stribeck_velocity))
    return exactly("LuGre friction of a passive dcmotor, while it moves by less than the length within a time step")


@_add.register(ViscousFriction)
def _(effect, parts, side):
    parts.sides[side].viscous += effect.viscous
    return exactly("damping of the joint")


@_add.register(AsymmetricFriction)
def _(effect, parts, side):
    if effect.viscous_difference:
        return unsaid("the damping of a joint is odd in the velocity; no element has a torque in proportion to |v|")
    parts.add_constant_torque(side, 0.5 * effect.torque_difference)
    return exactly("constant torque of a passive dcmotor")


@_add.register(QuadraticDrag)
def _(effect, parts, side):
    parts.sides[side].drag += effect.drag
    return exactly("damping of the joint, its second coefficient")


# other loads


@_add.register(ConstantTorque)
def _(effect, parts, side):
    parts.add_constant_torque(side, effect.torque)
    return exactly("constant torque of a passive dcmotor")


@_add.register(Gravity)
def _(effect, parts, side):
    if parts.sides[side].slides:
        parts.add_wave(side, effect.torque, 1.0, -effect.phase)
        return exactly("cogging of a passive dcmotor, one wave")
    if effect.torque:
        phase = effect.phase if effect.torque >= 0.0 else effect.phase + math.pi
        parts.sides[side].pendulums.append(Pendulum(abs(effect.torque), phase))
        parts.resolve_rate(math.sqrt(abs(effect.torque) / parts.sides[side].inertia))
    return exactly("an eccentric mass that gravity pulls down")


@_add.register(Cogging)
def _(effect, parts, side):
    parts.add_wave(side, effect.amplitude, effect.harmonic, effect.phase)
    return exactly("cogging of a passive dcmotor")


@_add.register(CoggingHarmonics)
def _(effect, parts, side):
    waves = (effect.sine, effect.cosine), (effect.sine_2, effect.cosine_2), (effect.sine_3, effect.cosine_3)
    for k, (sine, cosine) in enumerate(waves, 1):
        parts.add_wave(side, math.hypot(sine, cosine), k * effect.harmonic, math.atan2(cosine, sine))
    return exactly("cogging of passive dcmotors, one a wave")


@_add.register(Flexibility)
def _(effect, parts, side):
    if effect.inertia:
        rate, ratio = float(2.0 * np.pi * effect.frequency), float(min(effect.damping_ratio, MAX_DAMPING_RATIO))
        stiffness, damping = effect.inertia * rate**2, 2.0 * ratio * rate * effect.inertia
        parts.sides[side].flexible_inertias.append(FlexibleInertia(effect.inertia, stiffness, damping))
        parts.resolve_rate(rate * math.sqrt(1.0 + effect.inertia / parts.sides[side].inertia))
    return exactly("a further body on the side, its joint with stiffness and damping")


@_add.register(Tabulated)
def _(effect, parts, side):
    if len(effect.speeds):
        return unsaid("the damping of a joint is a cubic in the velocity, no table")
    if len(effect.positions) and effect.turn:
        return unsaid("springs know no turns: a table within a turn does not repeat")
    if len(effect.positions):
        parts.add_piecewise_torque(side, effect.positions, effect.position_torques)
    return exactly("springs of the joint, slack up to the points of a table over position; one over speed is not said")


# gear


@_add.register(Backlash)
def _(effect, parts, side):
    parts.half_gap += effect.half_gap
    return exactly("the springs of the gear are slack within the gap (springlength)")


@_add.register(Hardening)
def _(effect, parts, side):
    parts.add_gear_spring(0.0, effect.cubic_stiffness)
    return exactly("cubic stiffness of a tendon")


@_add.register(Damping)
def _(effect, parts, side):
    parts.damping += effect.damping
    if not parts.half_gap:
        return exactly("damping of the tendon; with a gap its limits, which is only near")
    return nearly("limits of the tendon that act as spring and damper: as the law, but the flanks do not pull as they part")


# actuator


@_add.register(Delay)
def _(effect, parts, side):
    parts.actuator.delay += effect.delay
    return nearly(f"delay of the actuator: exact to one time step, at most {parts.step:.2g} s")


@_add.register(GainError)
def _(effect, parts, side):
    parts.actuator.scale(1.0 + effect.relative)
    return exactly("gain of the actuator")


@_add.register(Saturation)
def _(effect, parts, side):
    parts.actuator.clip(effect.limit)
    return exactly("ctrlrange or forcerange of the actuator")


@_add.register(Lag)
def _(effect, parts, side):
    if parts.actuator.lag is not None:
        return unsaid("an actuator has one lag, and there is one already")
    parts.actuator.lag = effect.time_constant
    parts.resolve_rate(1.0 / effect.time_constant)
    return exactly("filter of the actuator (dyntype)")


@_add.register(BackEmf)
def _(effect, parts, side):
    parts.actuator.scale(effect.torque_constant / effect.resistance)
    parts.sides[side].viscous += effect.torque_constant**2 / effect.resistance
    return exactly("gain of the actuator, whose input is a voltage, and damping of the joint")


# effects that add no element


for _cls, _answer in (
    (DriftingFriction, unsaid("no friction of MuJoCo changes with time; set dof_frictionloss while it runs")),
    (Inertia, exactly("inertia of the body")),
    (PeriodicDisturbance, unsaid("a model has no torque of time alone; add it to data.qfrc_applied while it runs")),
    (TorqueRipple, unsaid("the gain of an actuator is at most affine in the position")),
    (
        Hysteresis,
        unsaid("a spring that yields (springyield) breaks sharply: it would be up to 24 % of the hysteretic torque off"),
    ),
    (Eccentricity, unsaid("tendons between joints are linear in the positions")),
    (TwistOffset, unsaid("joints have zeros of their own")),
    (LoadFriction, unsaid("the friction of a joint does not depend on what its tendon carries")),
    (EncoderEffect, unsaid("the sensors of a model read true positions; it changes no motion")),
):
    _add.register(_cls, lambda *_, answer=_answer: answer)
