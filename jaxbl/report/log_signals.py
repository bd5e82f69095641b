"""Signals that the figures of `jaxbl identify` compare: the log, its observers and the fitted model."""

import dataclasses
from collections.abc import Iterator
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.identification.identify import Identification
from jaxbl.records import POSITION_CHANNELS
from jaxbl.records.least_squares import rms
from jaxbl.records.linear_filters import filter_forwards

from .figures import SIDES

Array = np.ndarray

_CYCLES = 2.5
"""Cycles of motion shown in detail: one whole cycle is always among them."""
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

    def __init__(self, found: Identification):
        self.found, self.trace, self.record = found, found.trace, found.record
        self.time = self.trace["t"].to_numpy()
        self.sides = [side for side in SIDES if f"{side}.velocity" in self.trace]
        self.geared = "twist" in self.trace
        channels = self.record.statistics.channels
        self.unit = {side: channels[POSITION_CHANNELS[side]].unit for side in self.sides}
        self.torque_unit = "N" if self.unit["motor"] == "m" else "N m"
        self.experiment = found.model.build()
        self.plant = self.experiment.plant
        self.observed = max(self.record.segments, key=lambda one: one.stop - one.start)
        first, last = self.observed.start, self.observed.stop
        self.settled = slice(first + int(_SETTLING * (last - first)), last)

    def __getitem__(self, name: str) -> Array:
        """A column of the trace."""
        return self.trace[name].to_numpy(dtype=float)

    @cached_property
    def detail(self) -> slice:
        """A few cycles where the motion is largest; all of the observed part where that is hardly longer."""
        rows, period = self.settled, self.record.sample_period
        velocity = self["motor.velocity"][rows]
        count = len(velocity)
        away = velocity[np.abs(velocity) > 0.1 * np.max(np.abs(velocity), initial=0.0)]
        reversals = int(np.count_nonzero(np.diff(np.sign(away))))
        length = int(_CYCLES * 2.0 * len(away) / reversals) if reversals > 2 else count // 4
        length = max(length, 200, round(20.0 * float(self.experiment.equivalent_control.time_constant) / period))
        if 1.5 * length > count:
            return self.observed
        sums = [np.concatenate([[0.0], np.cumsum(velocity**power)]) for power in (1, 2)]
        mean, square = ((one[length:] - one[:-length]) / length for one in sums)
        start = rows.start + int(np.argmax(square - mean**2))
        return slice(start, start + length)

    @property
    def whole(self) -> bool:
        """Whether the part shown in detail is the whole observed part."""
        return self.detail == self.observed

    @property
    def line(self) -> slice:
        """What is drawn as a line over the other points: the part shown in detail, without the observers' beginning."""
        return self.settled if self.whole else self.detail

    @cached_property
    def span(self) -> tuple[float, float]:
        """Begin and end of the part shown in detail, s."""
        return float(self.time[self.detail][0]), float(self.time[self.detail][-1])

    def low_passed(self, values: Array) -> Array:
        """Values behind the low-pass of the equivalent control, for the same lag; NaN outside the observed part."""
        constant = float(self.experiment.equivalent_control.time_constant)
        found, part = np.full(len(values), np.nan), values[self.observed]
        if constant > 0.0 and np.isfinite(part).all():
            share = -np.expm1(-self.record.sample_period / constant)
            part = filter_forwards(part, [share], [share - 1.0])
        found[self.observed] = part
        return found

    @cached_property
    def twist(self) -> Array:
        """Twist behind the low-pass, motor side."""
        return self.low_passed(self["twist"])

    @cached_property
    def rate(self) -> Array:
        """Rate of the twist by the smoothed velocities."""
        return self["motor.velocity"] - float(self.plant.drive.ratio("load")) * self["load.velocity"]

    @cached_property
    def law(self) -> Array:
        """Torque of the fitted transmission at the measured motion, low-passed like the observed one."""
        return self.low_passed(self["torque"])

    def law_at(self, twist: Array) -> Array:
        """Torque of the fitted transmission at rest, without transmission errors."""
        # without a transmission error an effect answers the number 0.0, whatever the position
        known = [(one, one.transmission_error(one.init(), jnp.zeros(()))) for one in self.plant.effects]
        effects = tuple(one for one, error in known if not isinstance(error, jax.Array))
        plant = dataclasses.replace(self.plant, effects=effects)
        with jax.enable_x64(True):
            rest = {side: jnp.asarray(0.0) for side in SIDES}
            states = tuple(effect.init() for effect in effects)
            position = {"motor": jnp.asarray(twist), "load": jnp.zeros(len(twist))}
            found, _ = jax.vmap(lambda at: plant.transmitted_torque(at, rest, states))(position)
        return np.asarray(found)

    def effects(self, side: str) -> Array | None:
        """Torque of the model's effects on a side (motor: and on the input), low-passed; None if there are none."""
        name = f"{side}.effects"
        return self.low_passed(self[name]) if name in self.trace else None

    @cached_property
    def torques(self) -> dict[str, Array]:
        """Transmitted torque by each side: its observer's estimate less the fitted effects on that side."""
        found = {side: self[f"{side}.torque_estimate"] for side in self.sides}
        for side in self.sides:
            if (effects := self.effects(side)) is not None:
                found[side] = found[side] + effects / float(self.plant.drive.torque_gain(side))
        return found

    @cached_property
    def measured(self) -> Array | None:
        """Measured transmitted torque, low-passed like the observed one."""
        return self.low_passed(self["transmitted"]) if "transmitted" in self.trace else None

    def parts(self, rows: slice | None = None) -> Iterator[slice]:
        """Contiguous parts of some rows."""
        for one in self.record.segments:
            part = one if rows is None else slice(max(one.start, rows.start), min(one.stop, rows.stop))
            if part.start < part.stop:
                yield part

    def rms(self, values: Array) -> float:
        """Root mean square of the finite values of the settled part; NaN if there is none."""
        finite = values[self.settled][np.isfinite(values[self.settled])]
        return rms(finite) if len(finite) else float("nan")
