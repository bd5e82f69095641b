"""What no candidate explains: free functions of time, position and velocity, and friction with a memory.

They are candidates like any other, with many columns and an amplitude that the record chooses (empirical Bayes). None of
them is an effect with a name; if one pays after all effects with names have had their turn, something else is missing.
"""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np

from jaxbl.fused import Leaves
from jaxbl.fused.signal_scan import scan_signal

from .candidates import Candidate, MotionTorques, Torques

_FUNCTIONS = {
    "time": ("time", 120, False), "drift": ("time", 8, True), "position": ("position", 24, False),
    "place": ("position", 24, True), "velocity": ("velocity", 12, False),
}  # fmt: skip
"""Coordinate of each function, its knots there, and whether it is a friction, against the direction of motion."""
_LENGTHS = 1e-3, 1e-2, 0.1, 0.3, 0.6, 1.2
"""Pre-sliding distances of the friction with a memory, over the standard deviation of the position."""


def functions_of(signals: Sequence[MotionTorques]) -> list[Candidate]:
    """All of them, side by side, for a record in parts."""
    found = []
    for side in signals[0].sides:
        for kind, (name, knots, friction) in _FUNCTIONS.items():
            along = np.concatenate([_coordinate(one, name, side)[one.real] for one in signals])
            span = float(along.min()), float(along.max())

            def hats(one: MotionTorques, name=name, span=span, knots=knots, friction=friction, side=side) -> np.ndarray:
                found = _hats(_coordinate(one, name, side), span, knots)
                return found * one.direction[side][:, None] if friction else found

            found.append(_candidate(side, kind, knots, hats))

        def stops(one: MotionTorques, side=side) -> np.ndarray:
            position = _coordinate(one, "position", side)
            return _stops(position, np.array(_LENGTHS) * np.std(position[one.real]))

        found.append(_candidate(side, "memory", len(_LENGTHS), stops))
    return found


def _candidate(side: str, kind: str, width: int, shape: Callable[[MotionTorques], np.ndarray]) -> Candidate:
    """A torque on a side that is a sum of columns, shape (samples, width), each of height 1."""

    def columns(signals: MotionTorques, _: Sequence[Torques]) -> Torques:
        return {signals.sides.index(side): -shape(signals)[: signals.samples].T}

    return Candidate(f"{side}.{kind}", width, (), columns, lambda values: {})


def _coordinate(signals: MotionTorques, name: str, side: str) -> np.ndarray:
    values = getattr(signals.part, name)
    return np.asarray(values[side] if isinstance(values, dict) else values)


def _hats(values: np.ndarray, span: tuple[float, float], count: int) -> np.ndarray:
    """Triangles of height 1 about evenly spaced knots, shape (samples, count)."""
    low, high = span
    at = (values - low) / max(high - low, 1e-300) * (count - 1)
    return np.maximum(1.0 - np.abs(at[:, None] - np.arange(count)[None, :]), 0.0)


def _stops(position: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Elastoplastic elements of several lengths, between -1 and 1, shape (samples, lengths)."""
    way, longest = np.diff(position, prepend=position[0]), np.maximum(lengths, 1e-300)
    (found,) = scan_signal(_stopped, [longest], [0.0 * lengths], [way])
    return found


def _stopped(values: Leaves, carry: Leaves, inputs: Leaves) -> tuple[Leaves, Leaves]:
    """A sample of an element: it bends by the way over its length, and slides beyond 1."""
    (length,), (now,), (way,) = values, carry, inputs
    now = jnp.clip(now + way / length, -1.0, 1.0)
    return [now], [now]
