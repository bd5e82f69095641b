"""Excitations: the input torque u(t), evaluated once a sample and held until the next (zero-order hold, as in a drive).

Installed packages add excitations by the entry-point group `jaxbl.excitations`; the entry point's name is the
excitation's.
"""

import abc
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbl.registry import Registry, check_module

from .parameters import Scalar, ScalarArray, option, parameter


class AbstractExcitation(eqx.Module):
    """An input signal; `name` is the key `kind` of the config."""

    name: ClassVar[str]

    @abc.abstractmethod
    def __call__(self, time: ScalarArray) -> ScalarArray:
        """Torque u, N m, at a time in s."""

    @classmethod
    def find_fault(cls, numbers: Mapping[str, Any], period: float) -> str:
        """Say what is wrong with a study's `numbers`, of which each is in its range, and what would be right.

        Args:
            numbers: of this excitation, by config key.
            period: sampling period, s.

        Returns:
            One line, or "" if nothing is wrong.
        """
        return ""


def _aliasing_fault(name: str, frequency: float, period: float) -> str:
    # from half the sampling rate on, the samples of a wave are those of a slower one
    if frequency * period < 0.5:
        return ""
    return f"{name} {frequency:g} Hz has to be below half the sampling rate, {0.5 / period:g} Hz; run.sample_period sets it"


class FunctionInput(AbstractExcitation):
    """Input by a plain function of time (s) that returns the torque (N m); JAX traces it."""

    name = "function"
    function: Callable[[ScalarArray], Any] = eqx.field(static=True)

    def __call__(self, time):
        return jnp.asarray(self.function(time), jnp.result_type(time))


EXCITATIONS = Registry("jaxbl.excitations", partial(check_module, base=AbstractExcitation))
"""Excitations by name, those of installed packages included."""


@EXCITATIONS.add
class Sine(AbstractExcitation):
    """Sine: u = offset + amplitude sin(2 pi frequency t + phase)."""

    name = "sine"
    amplitude: Scalar = parameter("N m", "amplitude")
    frequency: Scalar = parameter("Hz", "frequency", minimum=0.0)
    phase: Scalar = parameter("rad", "phase at t = 0", default=0.0)
    offset: Scalar = parameter("N m", "constant part", default=0.0)

    @classmethod
    def find_fault(cls, numbers, period):
        return _aliasing_fault("frequency", numbers["frequency"], period)

    def __call__(self, time):
        return self.offset + self.amplitude * jnp.sin(2.0 * jnp.pi * self.frequency * time + self.phase)


@EXCITATIONS.add
class Multisine(AbstractExcitation):
    """Multisine: u = amplitude / sqrt(n) sum_k cos(2 pi k frequency t - pi k (k - 1) / n), k = 1 ... n, with n = `count`.

    Its power is that of a sine with this amplitude. The phases are Schroeder's, which keep peaks low.
    Reference: M. R. Schroeder, IEEE Trans. Inf. Theory 16 (1970).
    """

    name = "multisine"
    amplitude: Scalar = parameter("N m", "amplitude of the sine of equal power")
    frequency: Scalar = parameter("Hz", "fundamental frequency", above=0.0)
    # every harmonic is computed at every sample of every lane; an input with more harmonics should be recorded
    count: int = option("number of harmonics", default=8, minimum=1, maximum=10_000)

    @classmethod
    def find_fault(cls, numbers, period):
        return _aliasing_fault("the highest harmonic,", numbers["count"] * numbers["frequency"], period)

    def __call__(self, time):
        k = jnp.arange(1, self.count + 1, dtype=jnp.result_type(time))
        phases = -jnp.pi * k * (k - 1.0) / self.count
        waves = jnp.cos(2.0 * jnp.pi * self.frequency * time * k + phases)
        return self.amplitude / jnp.sqrt(float(self.count)) * jnp.sum(waves)


@EXCITATIONS.add
class Chirp(AbstractExcitation):
    """Chirp: a sine whose frequency moves linearly from `start_frequency` to `stop_frequency` in `sweep_time` and stays."""

    name = "chirp"
    amplitude: Scalar = parameter("N m", "amplitude")
    start_frequency: Scalar = parameter("Hz", "frequency at t = 0", minimum=0.0)
    stop_frequency: Scalar = parameter("Hz", "frequency at the end of the sweep", minimum=0.0)
    sweep_time: Scalar = parameter("s", "length of the sweep", above=0.0)

    @classmethod
    def find_fault(cls, numbers, period):
        return _aliasing_fault("the highest frequency,", max(numbers["start_frequency"], numbers["stop_frequency"]), period)

    def __call__(self, time):
        sweep = jnp.minimum(time, self.sweep_time)
        rate = (self.stop_frequency - self.start_frequency) / self.sweep_time
        turns = (self.start_frequency + 0.5 * rate * sweep) * sweep + self.stop_frequency * (time - sweep)
        return self.amplitude * jnp.sin(2.0 * jnp.pi * turns)


def rounding_bound(time: ScalarArray) -> ScalarArray:
    """Bound on the rounding error of a time (or a ratio of times) that is a multiple of a rounded period."""
    return 4.0 * float(jnp.finfo(jnp.result_type(time)).eps) * time


class _HeldLevels(AbstractExcitation):
    amplitude: Scalar = parameter("N m", "largest level")
    hold: Scalar = parameter("s", "time that each level is held", above=0.0)

    @classmethod
    def find_fault(cls, numbers, period):
        # most levels that are shorter than a sample are never applied
        hold = numbers["hold"]
        too_short = f"hold {hold:g} s has to be at least run.sample_period, {period:g} s"
        return "" if hold > (1.0 - 1e-6) * period else too_short

    def find_index(self, time: ScalarArray) -> Array:
        """Index of the hold interval at a time; at an edge a little early, since rounding must not make it a sample late."""
        holds = time / self.hold
        return jnp.floor(holds + 1e-4 + rounding_bound(holds)).astype(jnp.int32)


@EXCITATIONS.add
class Steps(_HeldLevels):
    """Random steps: levels that are uniform in [-amplitude, amplitude], each held for `hold` seconds."""

    name = "steps"
    seed: int = option("seed of the levels", default=0, minimum=0)

    def __call__(self, time):
        # 0x57E9 separates the levels from encoder noise of the same seed
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(self.seed), 0x57E9), self.find_index(time))
        level = jax.random.uniform(key, (), jnp.float32, -1.0, 1.0)
        return self.amplitude * level.astype(jnp.result_type(time))


@EXCITATIONS.add
class Prbs(_HeldLevels):
    """Pseudo-random binary sequence +-amplitude: a maximum-length shift register of `order` bits, one bit per `hold`."""

    name = "prbs"
    order: int = option("bits of the shift register; the sequence has 2^order - 1 bits", default=10, minimum=2, maximum=20)

    def __call__(self, time):
        from scipy.signal import max_len_seq  # its import takes half a second, which only this excitation needs

        bits, _ = max_len_seq(self.order)
        levels = 2.0 * jnp.asarray(bits, jnp.result_type(time)) - 1.0
        return self.amplitude * levels[self.find_index(time) % len(levels)]


@EXCITATIONS.add
class Recorded(AbstractExcitation):
    """Recorded torque with zero-order hold; the last sample is held on. `times` are in s, `torques` in N m."""

    name = "recorded"
    times: Float[Array, " samples"]
    torques: Float[Array, " samples"]
    gain: Scalar = parameter("", "factor on the recorded torque", default=1.0)

    def __call__(self, time):
        # half a microsecond of slack, as time stamps are rounded decimal numbers
        index = jnp.searchsorted(self.times, time + 5e-7 + rounding_bound(time), side="right") - 1
        return self.gain * self.torques[jnp.clip(index, 0)]
