"""Torque from tables: what was measured, or what has no name."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import jax.numpy as jnp

from ..mujoco_parts import exactly, unsaid
from ..parameters import Scalar, option
from .base import EFFECTS, SideEffect, Value, table


@EFFECTS.add
class Tabulated(SideEffect):
    """A torque from tables over position, speed, or both (the sum): linear between points, constant beyond the last ones."""

    kind: ClassVar[str] = "tabulated"
    velocity_dependent: ClassVar[bool] = True
    positions: tuple[Scalar, ...] = table("rad", "points of the table over position, increasing")
    position_torques: tuple[Scalar, ...] = table("N m", "resisting torque at these positions")
    turn: bool = option("the position within a turn counts, from 0 to 2 pi rad", default=False)
    speeds: tuple[Scalar, ...] = table("rad/s", "points of the table over speed, increasing")
    speed_torques: tuple[Scalar, ...] = table("N m", "resisting torque at these speeds")

    def resist(self, state, motion):
        position = motion.position
        if self.turn:
            position = position - 2.0 * jnp.pi * jnp.floor(position / (2.0 * jnp.pi))
        of_position = _interpolated(position, self.positions, self.position_torques)
        return of_position + _interpolated(motion.velocity, self.speeds, self.speed_torques)

    def to_mujoco(self, parts, side):
        if self.speeds:
            return unsaid("the damping of a joint is a cubic in the velocity, no table")
        if self.positions and self.turn:
            return unsaid("springs know no turns: a table within a turn does not repeat")
        if self.positions:
            parts.piecewise(side, self.positions, self.position_torques)
        return exactly("springs of the joint, slack up to the points of a table over position; one over speed is not said")

    @classmethod
    def find_fault(cls, numbers: Mapping[str, Any], period: float) -> str:
        for points, torques in (("positions", "position_torques"), ("speeds", "speed_torques")):
            given = numbers[points]
            if len(given) != len(numbers[torques]):
                return f"{torques} has {len(numbers[torques])} numbers; it should have one for each of {len(given)} {points}"
            if any(later <= one for one, later in itertools.pairwise(given)):
                return f"{points} should increase"
        return ""


def _interpolated(at: Value, points: Sequence[Scalar], values: Sequence[Scalar]) -> Value:
    """Piecewise linear through points, written out so that it runs in every loop."""
    if not points:
        return 0.0
    total = values[0]
    for i in range(len(points) - 1):
        width = points[i + 1] - points[i]
        total = total + (values[i + 1] - values[i]) / width * jnp.clip(at - points[i], 0.0, width)
    return total
