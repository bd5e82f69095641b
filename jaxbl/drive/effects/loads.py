"""Torques on a side other than friction: constant, over position, over time, over the input; and errors of the inertia."""

import math
from collections.abc import Iterable
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from ..parameters import Scalar
from .base import EFFECTS, Numbers, Scales, SideEffect, angle, frequency, harmonic, shape, size

_POLE_PAIRS, _RIPPLE_HARMONICS = (1, 2, 3, 4, 5, 7), (1, 2, 6)
"""Pole pairs of common servo motors, and periods of ripple a pole pair: 1 from the offset of a current sensor, 2 from
unequal gains of two sensors, 6 from commutation or windings that are not sinusoidal."""
TRIAL_ARC = 3.0 * np.pi
"""Part of a wave that the motion must cover for its harmonic to be tried, rad: over less it does not repeat."""
MAX_DAMPING_RATIO = 0.95
"""Largest damping ratio that is simulated: the exact step is that of a swing, and from 1 on nothing swings."""


def _select_covered(harmonics: Iterable[float], log: Scales) -> list[float]:
    """The harmonics of which the motion covers enough, in increasing order."""
    return sorted(float(n) for n in harmonics if n * log.travel > TRIAL_ARC)


def _ripple_harmonics(log: Scales) -> list[float]:
    return _select_covered({n * pairs for n in _RIPPLE_HARMONICS for pairs in _POLE_PAIRS}, log) if log.torque else []


def _base_harmonics(log: Scales) -> list[float]:
    """Whole harmonics of which a wave in the model may be the first, second or third multiple."""
    return _select_covered({n / k for n in log.harmonics for k in (1, 2, 3) if n % k == 0}, log)


@EFFECTS.add
class ConstantTorque(SideEffect):
    """Constant resisting torque, e.g. an offset of the amplifier or a weight on a drum."""

    kind = "constant_torque"
    torque: Scalar = size("N m", "resisting torque; may be negative")

    def resist(self, state, motion):
        return self.torque


@EFFECTS.add
class Inertia(SideEffect):
    """Error of the nominal inertia, which is added to it."""

    kind = "inertia"
    corrects = "inertia"
    inertia: Scalar = size("kg m²", "inertia on top of the nominal one; may be negative")

    def added_inertia(self):
        return self.inertia


@EFFECTS.add
class Gravity(SideEffect):
    """Eccentric mass: torque m g l sin(theta - phase)."""

    kind = "gravity"
    places = ("load",)
    # over a small angle it is the torque at position 0
    special_cases: ClassVar = {"constant_torque": lambda numbers: {"torque": -numbers["torque"] * np.sin(numbers["phase"])}}
    torque: Scalar = size("N m", "largest gravity torque m g l")
    phase: Scalar = angle("position at which the mass hangs down")

    def resist(self, state, motion):
        return self.torque * jnp.sin(motion.position - self.phase)


@EFFECTS.add
class PeriodicDisturbance(SideEffect):
    """Torque that is periodic in time: A sin(2 pi f t + phase)."""

    kind = "periodic_disturbance"
    in_time = True
    places = ("load",)
    # at frequency 0
    special_cases: ClassVar = {
        "constant_torque": lambda numbers: {"torque": numbers["amplitude"] * np.sin(numbers["phase"])}
    }
    amplitude: Scalar = size("N m", "amplitude A")
    frequency: Scalar = frequency("frequency f")
    phase: Scalar = angle("phase at t = 0")

    def resist(self, state, motion):
        return self.amplitude * jnp.sin(2.0 * jnp.pi * self.frequency * motion.time + self.phase)


@EFFECTS.add
class Cogging(SideEffect):
    """Cogging of the motor: torque A sin(n theta + phase)."""

    kind = "cogging"
    places = ("motor",)
    amplitude: Scalar = size("N m", "amplitude A")
    harmonic: Scalar = harmonic("periods n a turn", lambda log: log.waves, among_waves=True)
    phase: Scalar = angle("phase at theta = 0")

    def resist(self, state, motion):
        return self.amplitude * jnp.sin(self.harmonic * motion.position + self.phase)


def _largest_wave(numbers: Numbers) -> Numbers:
    """Numbers of the largest of the three waves, as cogging."""
    waves = [(numbers[f"sine{k}"], numbers[f"cosine{k}"]) for k in ("", "_2", "_3")]
    k, (sine, cosine) = max(enumerate(waves, 1), key=lambda wave: math.hypot(*wave[1]))
    return {"amplitude": math.hypot(sine, cosine), "harmonic": k * numbers["harmonic"], "phase": math.atan2(cosine, sine)}


@EFFECTS.add
class CoggingHarmonics(SideEffect):
    """Cogging with multiples: torque sum_k s_k sin(k n theta) + c_k cos(k n theta), k = 1, 2, 3."""

    kind = "cogging_harmonics"
    places = ("motor",)
    special_cases: ClassVar = {"cogging": _largest_wave}
    # a diagnosis tries it after a single wave, whose harmonic was chosen among those of cogging
    harmonic: Scalar = harmonic("periods n a turn", _base_harmonics, among_waves=True)
    sine: Scalar = size("N m", "s_1", default=0.0)
    cosine: Scalar = size("N m", "c_1", default=0.0)
    sine_2: Scalar = size("N m", "s_2", default=0.0)
    cosine_2: Scalar = size("N m", "c_2", default=0.0)
    sine_3: Scalar = size("N m", "s_3", default=0.0)
    cosine_3: Scalar = size("N m", "c_3", default=0.0)

    def resist(self, state, motion):
        angle = self.harmonic * motion.position
        return (
            self.sine * jnp.sin(angle)
            + self.cosine * jnp.cos(angle)
            + self.sine_2 * jnp.sin(2.0 * angle)
            + self.cosine_2 * jnp.cos(2.0 * angle)
            + self.sine_3 * jnp.sin(3.0 * angle)
            + self.cosine_3 * jnp.cos(3.0 * angle)
        )


@EFFECTS.add
class TorqueRipple(SideEffect):
    """Ripple in proportion to the motor's torque: u (1 + a sin(n theta + phase))."""

    kind = "torque_ripple"
    places = ("motor",)
    rotary = True
    amplitude: Scalar = size("", "relative amplitude a")
    harmonic: Scalar = harmonic("periods n a turn", _ripple_harmonics)
    phase: Scalar = angle("phase at theta = 0")

    def resist(self, state, motion):
        return -motion.torque * self.amplitude * jnp.sin(self.harmonic * motion.position + self.phase)


@EFFECTS.add
class Flexibility(SideEffect):
    """Further inertia J behind a spring and a damper: J d²phi/dt² = -J (w² q + 2 D w dq/dt) with q = phi - theta and
    w = 2 pi f. The opposite torque acts on its side. At t = 0 it stands still, and the spring is relaxed."""

    kind = "flexibility"
    places = ("load",)
    velocity_dependent = True
    state_from_measurement = True
    # behind a stiff spring
    special_cases: ClassVar = {"inertia": lambda numbers: {"inertia": numbers["inertia"]}}
    inertia: Scalar = size("kg m²", "inertia J behind the spring", minimum=0.0)
    frequency: Scalar = frequency("frequency f at which it swings while the side stands still")
    # from a welded frame to a belt; rubber couplings reach 0.16 (relative damping 2, DIN 740-2)
    damping_ratio: Scalar = shape(
        "", "damping ratio D", lambda log: [0.02, 0.1], default=0.02, above=0.0, maximum=MAX_DAMPING_RATIO
    )

    @property
    def _rates(self):
        """Undamped rate w and decay rate D w, rad/s."""
        rate = 2.0 * jnp.pi * self.frequency
        return rate, jnp.minimum(self.damping_ratio, MAX_DAMPING_RATIO) * rate

    def init(self):
        # twist q of the spring, rad, and velocity of the inertia, rad/s
        return (jnp.zeros_like(self.frequency), jnp.zeros_like(self.frequency))

    def set_in_motion(self, state, velocity):
        return (state[0], state[1] + velocity)

    def advance(self, state, motion, step):
        # exact at a steady velocity
        twist, velocity = state
        rate, decay = self._rates
        swing = jnp.sqrt(rate**2 - decay**2)
        # sin(swing * step) / swing and its limit; not every compiled loop has the primitives of `jnp.sinc`
        safe_swing = jnp.where(swing == 0.0, 1.0, swing)
        cosine, sine = jnp.cos(swing * step), jnp.where(swing == 0.0, step, jnp.sin(safe_swing * step) / safe_swing)
        twist_rate = velocity - motion.velocity
        damping = jnp.exp(-decay * step)
        twist, twist_rate = (
            damping * (cosine * twist + sine * (twist_rate + decay * twist)),
            damping * (cosine * twist_rate - sine * (rate**2 * twist + decay * twist_rate)),
        )
        return twist, twist_rate + motion.velocity

    def resist(self, state, motion):
        twist, velocity = state
        rate, decay = self._rates
        return -self.inertia * (rate**2 * twist + 2.0 * decay * (velocity - motion.velocity))
