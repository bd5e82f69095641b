"""References: the position that a controlled side is to follow; velocity and acceleration are its derivatives.

Installed packages add references by the entry-point group `jaxbl.references`; the entry point's name is the reference's.
"""

import abc
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbl.drive.excitation import rounding_bound
from jaxbl.drive.parameters import Scalar, ScalarArray, parameter
from jaxbl.registry import Registry, check_module


class Target(NamedTuple):
    """Says what a side is to do at a sample: position (rad), velocity (rad/s), acceleration (rad/s^2)."""

    position: Any
    velocity: Any
    acceleration: Any


class AbstractReference(eqx.Module):
    """A reference of the controlled side; `name` is the key `kind` of the config."""

    name: ClassVar[str]

    @abc.abstractmethod
    def position(self, time: ScalarArray) -> Any:
        """Return the position (rad) at a time (s)."""

    def target(self, time: ScalarArray) -> Target:
        """Return position and its derivatives at a time (s); at a jump the derivatives are those beside it."""
        unit = jnp.ones_like(time)

        def move(moment: ScalarArray) -> Any:
            return jax.jvp(self.position, (moment,), (unit,))

        (position, velocity), (_, acceleration) = jax.jvp(move, (time,), (unit,))
        return Target(position, velocity, acceleration)


class FunctionReference(AbstractReference):
    """A plain function of time (s) that returns the position (rad); JAX traces it, and differentiates it."""

    name = "function"
    function: Callable[[ScalarArray], Any] = eqx.field(static=True)

    def position(self, time):
        return self.function(time)


REFERENCES = Registry("jaxbl.references", partial(check_module, base=AbstractReference))
"""References by name, those of installed packages included."""


@REFERENCES.add
class SineReference(AbstractReference):
    """Sine: offset + amplitude sin(2 pi frequency t)."""

    name = "sine"
    amplitude: Scalar = parameter("rad", "amplitude")
    frequency: Scalar = parameter("Hz", "frequency", minimum=0.0)
    offset: Scalar = parameter("rad", "constant part", default=0.0)

    def position(self, time):
        return self.offset + self.amplitude * jnp.sin(2.0 * jnp.pi * self.frequency * time)


@REFERENCES.add
class Ramp(AbstractReference):
    """Ramp: a constant speed from `start` on."""

    name = "ramp"
    speed: Scalar = parameter("rad/s", "speed")
    start: Scalar = parameter("s", "time at which the ramp begins", default=0.0, minimum=0.0)

    def position(self, time):
        return self.speed * jnp.maximum(time - self.start, 0.0)


@REFERENCES.add
class StepsReference(AbstractReference):
    """Steps between 0 and `size`, each level held for `hold` seconds; the first is 0. A size of 0 holds the axis still."""

    name = "steps"
    size: Scalar = parameter("rad", "size of the steps")
    hold: Scalar = parameter("s", "time that each level is held", above=0.0)

    def position(self, time):
        # times are rounded: a step must not come a sample late
        return self.size * jnp.mod(jnp.floor(time / self.hold + 1e-4), 2.0)


@REFERENCES.add
class Moves(AbstractReference):
    """Moves from 0 to `distance` and back by S-curves of least jerk, x = 10 s^3 - 15 s^4 + 6 s^5, with a pause after each.

    Reference: T. Flash, N. Hogan, J. Neuroscience 5 (1985).
    """

    name = "moves"
    distance: Scalar = parameter("rad", "distance of a move")
    duration: Scalar = parameter("s", "duration of a move", above=0.0)
    pause: Scalar = parameter("s", "pause after each move", default=0.5, minimum=0.0)

    def position(self, time):
        cycles = time / (self.duration + self.pause)
        move = jnp.floor(cycles)
        s = jnp.minimum((cycles - move) * (self.duration + self.pause) / self.duration, 1.0)
        rise = s * s * s * (10.0 + s * (6.0 * s - 15.0))
        return self.distance * jnp.where(jnp.mod(move, 2.0) == 0.0, rise, 1.0 - rise)


@REFERENCES.add
class RecordedReference(AbstractReference):
    """Recorded positions at times (s), joined by a cubic spline, which overshoots at steps; first and last one are held.

    `cubics` are the coefficients of each interval, the highest power first.
    """

    name = "recorded"
    times: Float[Array, " samples"]
    cubics: Float[Array, "4 intervals"]
    gain: Scalar = parameter("", "factor on the recorded position", default=1.0)

    @classmethod
    def through(cls, times: Any, positions: Any, gain: Scalar = 1.0) -> "RecordedReference":
        """Make the reference that goes through positions (rad) at increasing times (s), two or more."""
        from scipy.interpolate import CubicSpline  # slow to load

        # JAX may compute in float32 here
        return cls(times, CubicSpline(times, positions).c, gain)

    def position(self, time):
        index = jnp.searchsorted(jnp.asarray(self.times), time + 5e-7 + rounding_bound(time), side="right") - 1
        index = jnp.clip(index, 0, self.cubics.shape[1] - 1)
        s = jnp.clip(time, self.times[0], self.times[-1]) - jnp.asarray(self.times)[index]
        cubic, square, slope, start = jnp.asarray(self.cubics)[:, index]
        return self.gain * (start + s * (slope + s * (square + s * cubic)))
