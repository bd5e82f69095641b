"""A log in segments without gaps: input, readings and smoothed motion of each."""

# arrays of numpy go where those of jax are asked for
# pyright: reportArgumentType=false

import dataclasses
from collections.abc import Sequence
from functools import cached_property, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.chain import Experiment
from jaxbl.drive.effects import DELAY_SAMPLES, AbstractEffect, Motion
from jaxbl.drive.plant import EffectStates, PlantState
from jaxbl.fused.compilation import jit
from jaxbl.records import Record
from jaxbl.records.least_squares import rms

from .free_parameters import SignalSizes
from .regression import Kinematics, Path, effect_states
from .smoother import Smoothed, smooth
from .trajectory import Windows

_FEWEST = 50
"""Samples of a segment whose torques are compared: the smoother's ends, some ten samples each, are then a small part. Where
torques are decimated, twice as many as the filter takes."""
_LONG = 10
"""Least length of a segment that gives up its beginning, over what it gives up: it loses a tenth at most."""


@dataclasses.dataclass(frozen=True)
class Segment:
    """A part of a log without gaps.

    Attributes:
        rows: of the log.
        time: s from the log's first sample, shape (samples,).
        period: sampling period, s.
        torque: input, N m, held from each sample to the next, shape (samples,).
        readings: positions of each side, rad, shape (samples,).
        smoothed: the same smoothed, with derivatives.
        transmitted: measured transmitted torque, N m, shape (samples,), or None.
        before: input before the first sample, N m, shape (earlier,); None where that is not known.
    """

    rows: slice
    time: np.ndarray
    period: float
    torque: np.ndarray
    readings: dict[str, np.ndarray]
    smoothed: dict[str, Smoothed]
    transmitted: np.ndarray | None = None
    before: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.time)

    def __getitem__(self, part: slice) -> "Segment":
        """Some of its samples, in a row."""
        columns = self.time, self.torque, self.readings, self.smoothed, self.transmitted
        time, *columns = jax.tree.map(lambda values: values[part] if np.ndim(values) else values, columns)
        first = part.start or 0
        rows = slice(self.rows.start + first, self.rows.start + first + len(time))
        before = self.torque[:first][-DELAY_SAMPLES:] if first else self.before
        return Segment(rows, time, self.period, *columns, before=before)

    @cached_property
    def torques(self) -> dict[Any, Any]:
        """Torques of effects along the motion that do not depend on the model, once they have been asked for
        (:mod:`jaxbl.diagnosis.candidates`)."""
        return {}

    @cached_property
    def kinematics(self) -> Kinematics:
        """The smoothed motion as the equations of motion take it; the input is held from each sample to the next."""
        before = np.empty(0) if self.before is None else self.before
        held = np.concatenate([before, self.torque])
        earlier, mean = np.split(0.5 * (np.append(held[:1], held[:-1]) + held), [len(before)])
        motion = ({side: smoothed.state[:, i].copy() for side, smoothed in self.smoothed.items()} for i in range(3))
        position, velocity, acceleration = motion
        before = earlier if len(earlier) else None
        return Kinematics(self.time, mean, position, velocity, acceleration, self.transmitted, before=before)


def skip_unknown_input(record: Record, at_rest: bool) -> Record:
    """A log whose segments begin later by as many samples as a dead time may last, where what was commanded before them is
    not known; but for short ones. `at_rest`: whether the log begins at rest, with no input before."""
    parts = tuple(
        slice(part.start + DELAY_SAMPLES, part.stop)
        if _before(record, part, at_rest) is None and part.stop - part.start >= _LONG * DELAY_SAMPLES
        else part
        for part in record.segments
    )
    return dataclasses.replace(record, segments=parts)


def _before(record: Record, part: slice, at_rest: bool) -> np.ndarray | None:
    """Input before a part of a log, N m, shape (DELAY_SAMPLES,), where it is known."""
    assert record.torque is not None
    # nothing is commanded of a drive that moves freely
    if not record.torque.any() or (at_rest and any(part.start == rows.start for _, rows in record.logs)):
        return np.zeros(DELAY_SAMPLES)
    first = part.start - DELAY_SAMPLES
    apart = DELAY_SAMPLES * record.sample_period
    if first < 0 or abs(record.time[part.start] - record.time[first] - apart) > 0.5 * record.sample_period:
        return None
    return record.torque[first : part.start]


def segments_of(record: Record, sides: Sequence[str], at_rest: bool = False) -> list[Segment]:
    """Segments of a log, the positions of each side smoothed; `at_rest`: whether the log begins at rest."""
    assert record.torque is not None
    segments = []
    for rows in record.segments:
        readings = {side: record.positions[side][rows] for side in sides}
        smoothed = {side: smooth(values, record.sample_period) for side, values in readings.items()}
        time, torque = record.time[rows] - record.time[0], record.torque[rows]
        transmitted = None if record.transmitted is None else record.transmitted[rows]
        before = _before(record, rows, at_rest)
        segments.append(Segment(rows, time, record.sample_period, torque, readings, smoothed, transmitted, before))
    return segments


def reading_noise(segments: Sequence[Segment]) -> dict[str, float]:
    """Standard deviation of the readings' noise of each side, rad: the mean over the segments."""
    sides = segments[0].smoothed
    return {side: float(np.mean([float(segment.smoothed[side].noise) for segment in segments])) for side in sides}


def signal_sizes(experiment: Experiment, segments: Sequence[Segment]) -> SignalSizes:
    """Standard deviation of the input, rms speed of the motor, and standard deviation of the twist."""
    motion, twist = [segment.kinematics for segment in segments], 0.0
    speed = rms(np.concatenate([part.velocity["motor"] for part in motion]))
    torque = float(np.std(np.concatenate([segment.torque for segment in segments])))
    if "load" in segments[0].readings:
        twist = float(np.std(np.concatenate([experiment.plant.twist(part.position) for part in motion])))
    return SignalSizes(torque, speed, twist)


def long_enough(segments: Sequence[Segment], factor: int) -> list[Kinematics]:
    """Kinematics of the segments that are long enough to be decimated by a factor."""
    return [segment.kinematics for segment in segments if len(segment) >= max(2 * (20 * factor + 1), _FEWEST)]


@jit
def _torques(experiment: Experiment, k: Kinematics, states: EffectStates) -> dict[str, Any]:
    """Torques along a segment, as of :meth:`jaxbl.drive.plant.Plant.side_torques`."""
    return jax.vmap(experiment.plant.side_torques)(k.position, k.velocity, states, k.torque, k.time)


def _hold_frictions(experiment: Experiment, segment: Segment, states: EffectStates) -> EffectStates:
    """States of effects along a segment; where a side is not seen to move, those of frictions with a memory that hold it.

    Their state follows from the way covered, and there that is less than readings show.
    """
    plant, k, new_states = experiment.plant, segment.kinematics, list(states)
    holding = {i: effect for i, effect in enumerate(plant.effects) if type(effect).holds is not AbstractEffect.holds}
    acting = _torques(experiment, k, states) if holding else {}
    for i, effect in holding.items():
        side = plant.drive.resolve_place(effect.place)
        torque = k.torque if side == "motor" else jnp.zeros_like(k.torque)
        held, _ = plant.holding_torque(side, Motion(k.time, k.position[side], k.velocity[side], torque), states)
        balance = acting[side][0] + held - plant.inertia(side) * k.acceleration[side]
        still = segment.smoothed[side].find_standstill(segment.period)
        new_states[i] = jax.tree.map(partial(jnp.where, still), effect.bent(balance), states[i])
    return tuple(new_states)


def at_period(experiment: Experiment, period: float) -> Experiment:
    """A model at the sampling period of another log, s."""
    return eqx.tree_at(lambda e: e.run.sample_period, experiment, np.asarray(period, float))


def windows_of(segments: Sequence[Segment], experiment: Experiment, samples: int, at_rest: bool = False) -> Windows:
    """A log in windows of so many samples, segment by segment.

    Shorter segments are left out; the experiment says how effects begin, `at_rest` whether each segment begins at rest.
    """
    columns = []
    for segment in segments:
        if len(segment) < samples:
            continue
        k, index = segment.kinematics, np.arange(len(segment))
        along = Path(k.time, segment.torque, k.position, k.velocity, before=segment.before)
        effects = _hold_frictions(experiment, segment, effect_states(experiment, along))
        standing = at_rest & (index == 0)
        velocity = {side: np.where(standing, 0.0, speed) for side, speed in k.velocity.items()}
        state, time = PlantState(k.position, velocity, effects), segment.time[0] + segment.period * index
        columns.append((segment.torque, segment.readings, time, state, standing, segment.rows.start + index))

    def cut(*pieces: Any) -> np.ndarray:
        """Cut a column that comes in a piece a segment; shape (windows, samples)."""
        wholes = (np.asarray(piece)[: len(piece) // samples * samples] for piece in pieces)
        return np.concatenate([column.reshape(-1, samples) for column in wholes])

    torque, measured, *by_sample = jax.tree.map(cut, *columns)
    time, start, standing, rows = jax.tree.map(lambda column: column[:, 0], by_sample)
    finer = np.zeros((*torque.shape, len(measured)))
    return Windows(torque, measured, time, start, reading_noise(segments), standing, finer, rows)
