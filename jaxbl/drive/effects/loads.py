"""Torques on a side that are no friction: constant, of position, of time, of the input; and the error of the inertia."""

import math
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from ..parameters import Scalar
from .base import EFFECTS, Numbers, Scales, SideEffect, angle, frequency, harmonic, shape, size

_MOST_COGGING = 40
"""Periods a turn up to which cogging is tried: of slots and magnets, the common ones have at most 36 or so."""
_ARC = 0.5 * np.pi
"""Of a wave of cogging, rad, that the motion must cover for it to be tried."""


_POLE_PAIRS = 1, 2, 3, 4, 5, 7
"""Of common servo motors. A current sensor's offset makes one period of ripple a pole pair, unequal gains of two make two,
and commutation or windings that are not sinusoidal make six."""


MAX_DAMPING_RATIO = 0.95
"""Damping ratio from which on an inertia behind a spring hardly swings, and its frequency says nothing."""


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
    in_time: ClassVar[bool] = True
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


def _multiples(log: Scales) -> list[float]:
    """Bases of the waves that are known: each may be the first, second or third multiple."""
    bases = {n / k for n in log.harmonics for k in (1, 2, 3)}
    return sorted(n for n in bases if n == round(n) and n * log.travel > _ARC)


def _largest(numbers: Numbers) -> Numbers:
    """The largest of three waves on its own."""
    waves = [(numbers[f"sine{k}"], numbers[f"cosine{k}"]) for k in ("", "_2", "_3")]
    k, (sine, cosine) = max(enumerate(waves, 1), key=lambda wave: math.hypot(*wave[1]))
    return {"amplitude": math.hypot(sine, cosine), "harmonic": k * numbers["harmonic"], "phase": math.atan2(cosine, sine)}


@EFFECTS.add
class CoggingHarmonics(SideEffect):
    """Cogging that is no pure wave, with its multiples: the sum of s_k sin(k n theta) + c_k cos(k n theta), k = 1, 2, 3."""

    kind: ClassVar[str] = "cogging_harmonics"
    places: ClassVar[tuple[str, ...]] = ("motor",)
    special_cases: ClassVar = {"cogging": _largest}
    # a diagnosis comes from one wave that it has found
    harmonic: Scalar = harmonic("periods n a turn", _multiples, sought=lambda log: len(_cogging(log)))
    sine: Scalar = size("N m", "s_1", default=0.0)
    cosine: Scalar = size("N m", "c_1", default=0.0)
    sine_2: Scalar = size("N m", "s_2", default=0.0)
    cosine_2: Scalar = size("N m", "c_2", default=0.0)
    sine_3: Scalar = size("N m", "s_3", default=0.0)
    cosine_3: Scalar = size("N m", "c_3", default=0.0)

    def resist(self, state, motion):
        turn = self.harmonic * motion.position
        return (
            self.sine * jnp.sin(turn)
            + self.cosine * jnp.cos(turn)
            + self.sine_2 * jnp.sin(2.0 * turn)
            + self.cosine_2 * jnp.cos(2.0 * turn)
            + self.sine_3 * jnp.sin(3.0 * turn)
            + self.cosine_3 * jnp.cos(3.0 * turn)
        )


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


@EFFECTS.add
class Flexibility(SideEffect):
    """A further inertia J behind a spring and a damper, J d²phi/dt² = -J (w² q + 2 D w dq/dt) with q = phi - theta and
    w = 2 pi f, which acts back on its side; at t = 0 it stands still, the spring relaxed."""

    kind: ClassVar[str] = "flexibility"
    places: ClassVar[tuple[str, ...]] = ("load",)
    velocity_dependent: ClassVar[bool] = True
    state_from_measurement: ClassVar[bool] = True
    # behind a stiff spring
    special_cases: ClassVar = {"inertia": lambda one: {"inertia": one["inertia"]}}
    inertia: Scalar = size("kg m²", "inertia J behind the spring", minimum=0.0)
    frequency: Scalar = frequency("frequency f at which it swings while the side stands still")
    # from a welded frame to a belt
    damping_ratio: Scalar = shape(
        "", "damping ratio D", lambda log: [0.02, 0.1], default=0.02, above=0.0, maximum=MAX_DAMPING_RATIO
    )

    @property
    def _rates(self):
        """w, and D w."""
        rate = 2.0 * jnp.pi * self.frequency
        return rate, jnp.minimum(self.damping_ratio, MAX_DAMPING_RATIO) * rate

    def init(self):
        # twist of the spring, rad, and velocity of the inertia, rad/s
        return (jnp.zeros_like(self.frequency), jnp.zeros_like(self.frequency))

    def set_in_motion(self, state, velocity):
        return (state[0], state[1] + velocity)

    def advance(self, state, motion, step):
        # exact at a steady velocity
        twist, velocity = state
        rate, decay = self._rates
        swing = jnp.sqrt(rate**2 - decay**2)
        # sin(swing * step) / swing, and its limit; not by `jnp.sinc`, whose primitives not every loop knows
        turns = jnp.where(swing == 0.0, 1.0, swing)
        cosine, sine = jnp.cos(swing * step), jnp.where(swing == 0.0, step, jnp.sin(turns * step) / turns)
        slip = velocity - motion.velocity
        left = jnp.exp(-decay * step)
        twist, slip = (
            left * (cosine * twist + sine * (slip + decay * twist)),
            left * (cosine * slip - sine * (rate**2 * twist + decay * slip)),
        )
        return twist, slip + motion.velocity

    def resist(self, state, motion):
        twist, velocity = state
        rate, decay = self._rates
        return -self.inertia * (rate**2 * twist + 2.0 * decay * (velocity - motion.velocity))
