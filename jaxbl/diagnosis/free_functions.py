"""What no candidate explains: free functions of time, position and velocity, and friction with a memory.

They are candidates like any other, with many columns and an amplitude that the record chooses (empirical Bayes). None of
them is an effect with a name; if one pays after all effects with names have had their turn, something else is missing.
"""

from collections.abc import Sequence
from functools import partial

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
    functions = []
    for side in signals[0].sides:
        for kind, (name, knots, friction) in _FUNCTIONS.items():
            along = np.concatenate([_coordinate(part, name, side) for part in signals])
            span = float(along.min()), float(along.max())
            hats = partial(_make_hats, name, side, span, knots, friction)
            functions.append(Candidate(f"{side}.{kind}", knots, (), hats))
        functions.append(Candidate(f"{side}.memory", len(_LENGTHS), (), partial(_make_stops, side)))
    return functions


def _coordinate(signals: MotionTorques, name: str, side: str) -> np.ndarray:
    values = getattr(signals.part, name)
    return (values[side] if isinstance(values, dict) else values)[: signals.samples]


def _make_hats(
    name: str, side: str, span: tuple[float, float], count: int, friction: bool, signals: MotionTorques, _: Sequence[Torques]
) -> Torques:
    """Triangles of height 1 about evenly spaced knots, as torques on a side."""
    low, high = span
    index = (_coordinate(signals, name, side) - low) / max(high - low, 1e-300) * (count - 1)
    heights = np.maximum(1.0 - np.abs(index[:, None] - np.arange(count)[None, :]), 0.0)
    columns = heights * signals.direction[side][: signals.samples, None] if friction else heights
    return {signals.sides.index(side): -columns.T}


def _make_stops(side: str, signals: MotionTorques, _: Sequence[Torques]) -> Torques:
    """Elastoplastic elements of several lengths, between -1 and 1, as torques on a side."""
    position = _coordinate(signals, "position", side)
    lengths = np.maximum(np.array(_LENGTHS) * np.std(position), 1e-300)
    way = np.diff(position, prepend=position[0])
    (columns,) = scan_signal(_advance_stop, [lengths], [0.0 * lengths], [way])
    return {signals.sides.index(side): -columns.T}


def _advance_stop(values: Leaves, carry: Leaves, inputs: Leaves) -> tuple[Leaves, Leaves]:
    """A sample of an element: it bends by the way over its length, and slides beyond 1."""
    (length,), (now,), (way,) = values, carry, inputs
    now = jnp.clip(now + way / length, -1.0, 1.0)
    return [now], [now]
