"""A torque that is interpolated in tables, as it was measured."""

import itertools
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..parameters import Scalar, option
from .base import EFFECTS, Number, SideEffect, table

_CHAINED_POINTS = 64
"""Most points of a table that every compiled loop takes; each of them makes a program longer, and 10 000 take minutes."""


@EFFECTS.add
class Tabulated(SideEffect):
    """A torque from tables over position, over speed, or the sum of both. It is linear between points, and constant beyond
    the first and last ones."""

    kind = "tabulated"
    velocity_dependent = True
    positions: tuple[Scalar, ...] = table("rad", "points of the table over position, increasing")
    position_torques: tuple[Scalar, ...] = table("N m", "resisting torque at these positions")
    turn: bool = option("the position within a turn counts, from 0 to 2 pi rad", default=False)
    speeds: tuple[Scalar, ...] = table("rad/s", "points of the table over speed, increasing")
    speed_torques: tuple[Scalar, ...] = table("N m", "resisting torque at these speeds")

    def __post_init__(self):
        for name in ("positions", "position_torques", "speeds", "speed_torques"):
            if len(numbers := getattr(self, name)) > _CHAINED_POINTS:
                setattr(self, name, np.asarray(numbers))

    def resist(self, state, motion):
        position = motion.position
        if self.turn:
            position = position - 2.0 * jnp.pi * jnp.floor(position / (2.0 * jnp.pi))
        position_torque = _interpolate(position, self.positions, self.position_torques)
        return position_torque + _interpolate(motion.velocity, self.speeds, self.speed_torques)

    @classmethod
    def find_fault(cls, numbers: Mapping[str, Any], period: float) -> str:
        for points, torques in (("positions", "position_torques"), ("speeds", "speed_torques")):
            count = len(numbers[points])
            if count != len(numbers[torques]):
                return f"{torques} has {len(numbers[torques])} numbers; it should have one for each of {count} {points}"
            if any(second <= first for first, second in itertools.pairwise(numbers[points])):
                return f"{points} should increase"
        return ""


def _interpolate(x: Number, points: Any, torques: Any) -> Number:
    """Interpolate linearly between points; 0 without points. A long table is an array, which not every loop can index."""
    if not len(points):
        return 0.0
    if not isinstance(points, tuple):
        points, torques = jnp.asarray(points), jnp.asarray(torques)
        i = jnp.searchsorted(points[1:-1], x, side="right", method="scan_unrolled")
        width = points[i + 1] - points[i]
        return torques[i] + (torques[i + 1] - torques[i]) / width * jnp.clip(x - points[i], 0.0, width)
    torque = torques[0]
    for i in range(len(points) - 1):
        width = points[i + 1] - points[i]
        torque = torque + (torques[i + 1] - torques[i]) / width * jnp.clip(x - points[i], 0.0, width)
    return torque
