"""Torques on a side that are no friction: constant, of position, of time, of the input; and the error of the inertia."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from ..parameters import Scalar
from .base import EFFECTS, Scales, SideEffect, angle, frequency, harmonic, size

_MOST_COGGING = 40
"""Periods a turn up to which cogging is tried: of slots and magnets, the common ones have at most 36 or so."""
_ARC = 0.5 * np.pi
"""Of a wave of cogging, rad, that the motion must cover for it to be tried."""


_POLE_PAIRS = 1, 2, 3, 4, 5, 7
"""Of common servo motors. A current sensor's offset makes one period of ripple a pole pair, unequal gains of two make two,
and commutation or windings that are not sinusoidal make six."""


def _ripple(log: Scales) -> list[float]:
    if log.torque == 0.0:
        return []
    waves = sorted({float(n * pairs) for n in (1, 2, 6) for pairs in _POLE_PAIRS})
    return [n for n in waves if n * log.travel > _ARC]


def _cogging(log: Scales) -> list[float]:
    return [float(n) for n in range(1, _MOST_COGGING + 1) if n * log.travel > _ARC]


@EFFECTS.add
class ConstantTorque(SideEffect):
    """A constant resisting torque (an offset of the amplifier, a weight on a drum)."""

    kind: ClassVar[str] = "constant_torque"
    torque: Scalar = size("N m", "resisting torque; may be negative")

    def resist(self, state, motion):
        return self.torque


@EFFECTS.add
class Inertia(SideEffect):
    """Error of the nominal inertia."""

    kind: ClassVar[str] = "inertia"
    corrects: ClassVar[str | None] = "inertia"
    inertia: Scalar = size("kg m²", "inertia on top of the nominal one; may be negative")

    def added_inertia(self):
        return self.inertia


@EFFECTS.add
class Gravity(SideEffect):
    """An eccentric mass: m g l sin(theta - phase)."""

    kind: ClassVar[str] = "gravity"
    places: ClassVar[tuple[str, ...]] = ("load",)
    # over a small angle: the torque at position 0
    special_cases: ClassVar = {"constant_torque": lambda one: {"torque": -one["torque"] * np.sin(one["phase"])}}
    torque: Scalar = size("N m", "largest gravity torque m g l")
    phase: Scalar = angle("position at which the mass hangs down")

    def resist(self, state, motion):
        return self.torque * jnp.sin(motion.position - self.phase)


@EFFECTS.add
class PeriodicDisturbance(SideEffect):
    """A torque periodic in time: A sin(2 pi f t + phase)."""

    kind: ClassVar[str] = "periodic_disturbance"
    places: ClassVar[tuple[str, ...]] = ("load",)
    # of vanishing frequency
    special_cases: ClassVar = {"constant_torque": lambda one: {"torque": one["amplitude"] * np.sin(one["phase"])}}
    amplitude: Scalar = size("N m", "amplitude A")
    frequency: Scalar = frequency("frequency f")
    phase: Scalar = angle("phase at t = 0")

    def resist(self, state, motion):
        return self.amplitude * jnp.sin(2.0 * jnp.pi * self.frequency * motion.time + self.phase)


@EFFECTS.add
class Cogging(SideEffect):
    """Cogging of the motor: A sin(n theta + phase)."""

    kind: ClassVar[str] = "cogging"
    places: ClassVar[tuple[str, ...]] = ("motor",)
    amplitude: Scalar = size("N m", "amplitude A")
    harmonic: Scalar = harmonic("periods n a turn", _cogging)
    phase: Scalar = angle("phase at theta = 0")

    def resist(self, state, motion):
        return self.amplitude * jnp.sin(self.harmonic * motion.position + self.phase)


@EFFECTS.add
class TorqueRipple(SideEffect):
    """Ripple of the motor's torque, in proportion to it: u (1 + a sin(n theta + phase))."""

    kind: ClassVar[str] = "torque_ripple"
    places: ClassVar[tuple[str, ...]] = ("motor",)
    amplitude: Scalar = size("", "relative amplitude a")
    harmonic: Scalar = harmonic("periods n a turn", _ripple)
    phase: Scalar = angle("phase at theta = 0")

    def resist(self, state, motion):
        return -motion.torque * self.amplitude * jnp.sin(self.harmonic * motion.position + self.phase)
