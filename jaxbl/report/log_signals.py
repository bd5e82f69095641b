"""Signals that the figures of `jaxbl identify` compare: the log, its observers and the fitted model."""

import dataclasses
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.estimation.identify import Identification
from jaxbl.records import POSITION_CHANNELS
from jaxbl.records.linear_filters import filter_forwards
from jaxbl.records.signal_quality import longest_segment

from .panels import SIDES, Array

_SETTLING = 0.1
"""Share of the record left to the observers to converge: shown, but not in rms values and scales."""


class LogSignals:
    """Signals of a log, of the observers that ran on it and of the fitted model, as the figures compare them.

    Attributes:
        sides: that have an observer.
        geared: whether there is a load with an encoder of its own.
        unit: of positions, by side.
        observed: the longest part without gaps, which the observers ran on.
        settled: the observed part without its beginning, in which the observers converge.
    """

    def __init__(self, result: Identification):
        self.result, self.trace, self.record = result, result.trace, result.record
        self.time = self.trace["t"].to_numpy()
        self.sides = [side for side in SIDES if f"{side}.velocity" in self.trace]
        self.geared = "twist" in self.trace
        channels = self.record.statistics.channels
        self.unit = {side: channels[POSITION_CHANNELS[side]].unit for side in self.sides}
        self.torque_unit = "N" if self.unit["motor"] == "m" else "N m"
        experiment = result.model.build()
        self.plant, self.time_constant = experiment.plant, float(experiment.equivalent_control.time_constant)
        self.observed = longest_segment(self.record.segments)
        first, last = self.observed.start, self.observed.stop
        self.settled = slice(first + int(_SETTLING * (last - first)), last)

    def __getitem__(self, name: str) -> Array:
        """A column of the trace."""
        return self.trace[name].to_numpy(dtype=float)

    def low_passed(self, values: Array) -> Array:
        """Values behind the low-pass of the equivalent control, for the same lag; NaN outside the observed part."""
        filtered, part = np.full(len(values), np.nan), values[self.observed]
        if self.time_constant > 0.0 and np.isfinite(part).all():
            share = -np.expm1(-self.record.sample_period / self.time_constant)
            part = filter_forwards(part, [share], [share - 1.0])
        filtered[self.observed] = part
        return filtered

    @cached_property
    def rate(self) -> Array:
        """Rate of the twist by the smoothed velocities."""
        return self["motor.velocity"] - float(self.plant.drive.ratio("load")) * self["load.velocity"]

    def law_at(self, twist: Array) -> Array:
        """Torque of the fitted transmission at rest, without transmission errors."""
        # without a transmission error an effect answers the number 0.0, whatever the position
        effects = tuple(
            effect
            for effect in self.plant.effects
            if not isinstance(effect.transmission_error(effect.init(), jnp.zeros(())), jax.Array)
        )
        plant = dataclasses.replace(self.plant, effects=effects)
        with jax.enable_x64(True):
            still = {side: jnp.asarray(0.0) for side in SIDES}
            states = tuple(effect.init() for effect in effects)
            position = {"motor": jnp.asarray(twist), "load": jnp.zeros(len(twist))}
            torque, _ = jax.vmap(lambda angles: plant.transmitted_torque(angles, still, states))(position)
        return np.asarray(torque)

    def effects(self, side: str) -> Array | None:
        """Torque of the model's effects on a side (motor: and on the input), low-passed; None if there are none."""
        name = f"{side}.effects"
        return self.low_passed(self[name]) if name in self.trace else None

    @cached_property
    def torques(self) -> dict[str, Array]:
        """Transmitted torque by each side: its observer's estimate less the fitted effects on that side."""
        torques = {side: self[f"{side}.torque_estimate"] for side in self.sides}
        for side in self.sides:
            if (effects := self.effects(side)) is not None:
                torques[side] = torques[side] + effects / float(self.plant.drive.torque_gain(side))
        return torques

    @cached_property
    def measured_torque(self) -> Array | None:
        """Measured transmitted torque, low-passed like the observed one."""
        return self.low_passed(self["transmitted"]) if "transmitted" in self.trace else None
