"""What no candidate explains: free functions of time, position and velocity, and friction with a memory.

They are candidates like any other, with many columns and an amplitude that the record chooses (empirical Bayes). None of
them is an effect with a name; if one pays after all effects with names have had their turn, something else is missing.
"""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.drive.effects import AbstractEffect

from .candidates import MotionTorques, Numbers

KINDS = "time", "drift", "position", "place", "velocity", "memory"
"""Torque over time; friction over time; torque over position; friction over position; torque over velocity; friction that
yields before it slides."""
_KNOTS = {"time": 120, "drift": 8, "position": 24, "place": 24, "velocity": 12, "memory": 4}
_LENGTHS = 0.1, 0.3, 0.6, 1.2
"""Pre-sliding distances, over the standard deviation of the position."""


@dataclasses.dataclass(frozen=True)
class Function:
    """A free function of `kind` on a side, over a span of its coordinate."""

    side: str
    kind: str
    span: tuple[float, float]

    @property
    def name(self) -> str:
        return f"{self.side}.{self.kind}"

    @property
    def offset(self) -> bool:
        return False

    @property
    def width(self) -> int:
        return _KNOTS[self.kind]

    def numbers(self, values: Sequence[float]) -> Numbers:
        return {}

    @property
    def effects(self) -> tuple[AbstractEffect, ...]:
        return ()

    def columns(self, signals: MotionTorques, torques: Sequence[np.ndarray]) -> np.ndarray:
        """As :meth:`.candidates.Candidate.columns`; N m."""
        part, side = signals.part, self.side
        position, velocity = np.asarray(part.position[side]), np.asarray(part.velocity[side])
        direction = signals.direction[side]
        match self.kind:
            case "time":
                columns = _hats(np.asarray(part.time), self.span, self.width)
            case "drift":
                columns = _hats(np.asarray(part.time), self.span, self.width) * direction[:, None]
            case "position":
                columns = _hats(position, self.span, self.width)
            case "place":
                columns = _hats(position, self.span, self.width) * direction[:, None]
            case "velocity":
                columns = _hats(velocity, self.span, self.width)
            case _:
                columns = _stops(position, np.array(_LENGTHS) * np.std(position[signals.real]))
        found = np.zeros((self.width, signals.count, len(signals.sides) + 1))
        found[:, :, signals.sides.index(side)] = -(columns * signals.real[:, None]).T
        return found


def functions_of(signals: Sequence[MotionTorques]) -> list[Function]:
    """All of them, for a record in parts."""
    found = []
    for side in signals[0].sides:
        position, velocity, time = (
            np.concatenate([np.asarray(of(one))[one.real] for one in signals])
            for of in (
                lambda s, side=side: s.part.position[side],
                lambda s, side=side: s.part.velocity[side],
                lambda s: s.part.time,
            )
        )
        spans = {"position": position, "place": position, "velocity": velocity, "time": time, "drift": time}
        for kind in KINDS:
            values = spans.get(kind, position)
            found.append(Function(side, kind, (float(values.min()), float(values.max()))))
    return found


def _hats(values: np.ndarray, span: tuple[float, float], count: int) -> np.ndarray:
    """Triangles of height 1 about evenly spaced knots, shape (samples, count)."""
    low, high = span
    at = (values - low) / max(high - low, 1e-300) * (count - 1)
    return np.maximum(1.0 - np.abs(at[:, None] - np.arange(count)[None, :]), 0.0)


def _stops(position: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Elastoplastic elements of several lengths, between -1 and 1, shape (samples, lengths)."""
    steps = np.diff(position, prepend=position[0])[:, None] / np.maximum(lengths, 1e-300)[None, :]
    return np.asarray(_stopped(jnp.asarray(steps)))


@jax.jit
def _stopped(steps: jax.Array) -> jax.Array:
    def sample(now: jax.Array, step: jax.Array) -> tuple[jax.Array, jax.Array]:
        now = jnp.clip(now + step, -1.0, 1.0)
        return now, now

    return jax.lax.scan(sample, jnp.zeros(steps.shape[1]), steps)[1]
