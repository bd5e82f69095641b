"""A part of a record, and a model's step along it."""

import equinox as eqx
from jaxtyping import Array, Float


class Part(eqx.Module):
    """A part of a record without gaps, and the model along it.

    Attributes:
        time: s, shape (samples,).
        torque: input, N m, held from each sample to the next.
        readings: position over its smoothed value, rad, shape (samples, sides).
        position, velocity, acceleration: smoothed, of each side.
        modelled: mean acceleration over the next period by the model, of each side: free of the readings' noise.
        deviation: standard deviation of the smoothed velocity, of each side.
        held: 1 where a side is not shown to move for a while, else 0.
        step: A, shape (samples, states, states).
        force: B, by torque on each side and by the input, shape (samples, states, sides + 1).
        own: change of a step by each free number (theta), padded with zeros, shape (samples, states, numbers).
        defect: model's step less the smoothed one, shape (samples, states).
        weight: 1, or 0 where samples are padding.
    """

    time: Float[Array, " samples"]
    torque: Float[Array, " samples"]
    readings: Float[Array, "samples sides"]
    position: dict[str, Float[Array, " samples"]]
    velocity: dict[str, Float[Array, " samples"]]
    acceleration: dict[str, Float[Array, " samples"]]
    modelled: dict[str, Float[Array, " samples"]]
    deviation: dict[str, Float[Array, " samples"]]
    held: dict[str, Float[Array, " samples"]]
    step: Float[Array, "samples states states"]
    force: Float[Array, "samples states inputs"]
    own: Float[Array, "samples states numbers"]
    defect: Float[Array, "samples states"]
    weight: Float[Array, " samples"]

    def moving(self) -> "Part":
        """Without the model's step: what torques along the motion need, of one shape whatever numbers are free."""
        return eqx.tree_at(lambda part: (part.step, part.force, part.own, part.defect), self, (None,) * 4)
