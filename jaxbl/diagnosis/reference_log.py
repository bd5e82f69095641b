"""How well a model predicts a log that it was not fitted to: positions, speeds and missing torques, and their noise.

Positions by short windows and by one free run: the state at the beginning of each is fitted to its first fifth, and the rest
is foretold. Torques by the equations of motion at the smoothed motion, behind one low-pass for all models.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import jax
import numpy as np

from jaxbl.chain import Experiment, NamedArrays
from jaxbl.drive.effects import ConstantTorque
from jaxbl.estimation.segments import Segment, at_period, reading_noise, windows_of
from jaxbl.estimation.smoother import smooth
from jaxbl.fused.single_plant import simulate_plants
from jaxbl.records import POSITION_CHANNELS
from jaxbl.records.least_squares import rms
from jaxbl.records.signal_quality import estimate_white_noise

from .free_starts import Run, best_runs, count_seen
from .neutral_effects import lean, with_torques
from .residuals import Residual, SideResiduals, as_smoothed, low_passed, narrow, residual_torques

BLOCKS = 16
"""Of a log, over which errors are compared: enough for a standard error, and longer than errors are correlated in most
logs."""
WINDOW = 0.5
"""Length of the short windows, s: several periods of a drive's resonance, and too short to drift far."""
_LEAST_IN_WINDOW = 20
"""Samples of a window at least: ten times the states that are fitted to it."""
_SLOW = (2.0, 4.0, 8.0)
"""Factors between the bandwidth and those below which missing torques are looked at once more: noise of torques falls with
the bandwidth to the power 2.5, so that slow ones show better there."""
BELOW = " below "
"""In the names of their channels."""
_LEAST_VALUES = 8
"""Independent values of a slow torque on the log at least."""
_BEFORE = 512
"""Samples before a window whose inputs its model may remember: several time constants of most lags."""
_STATES = 8
"""Initial states tried for each window."""


Errors = dict[str, float]
"""Rms errors by channel: `theta_e`, `velocity_motor`, `torque_motor`, of slow torques `torque_motor below 12 Hz`, and so
on."""
_Part = tuple[int, int]
"""Number of a part of a log, and of how many."""


class Comparison(NamedTuple):
    """A model beside a log.

    Attributes:
        errors: rms, by channel.
        torques: that the model lacks, by side, segment by segment.
        samples: the errors one by one, in the order of time; of positions and speeds shape (windows, samples), of torques
            behind the low-pass (samples,).
        gain: torque on the motor for one unit of the input.
        noise: what noise of the readings adds by way of the initial states, over that noise, by position.
    """

    errors: Errors
    torques: SideResiduals
    samples: NamedArrays
    gain: float
    noise: Errors


@dataclass(frozen=True)
class ReferenceLog:
    """A log that models are compared with.

    Attributes:
        segments: of the log.
        bandwidth: of the low-pass that missing torques are looked at behind, Hz, by side.
        at_rest: whether each segment begins at rest.
    """

    segments: Sequence[Segment]
    bandwidth: Mapping[str, float]
    at_rest: bool = False

    @property
    def period(self) -> float:
        """Sampling period, s."""
        return self.segments[0].period

    @cached_property
    def noise(self) -> dict[str, float]:
        """Standard deviation of the readings' noise of each side, rad."""
        return reading_noise(self.segments)

    @property
    def samples(self) -> int:
        """Length of a window."""
        return min(max(round(WINDOW / self.period), _LEAST_IN_WINDOW), max(map(len, self.segments)))

    def noise_floor(self, torques: SideResiduals) -> Errors:
        """Noise of each channel: what a perfect model would leave."""
        floor = {POSITION_CHANNELS[side]: noise for side, noise in self.noise.items()}
        deviations = {
            f"velocity_{side}": np.concatenate([segment.smoothed[side].deviation(1) for segment in self.segments])
            for side in self.noise
        }
        return floor | _all_rms(deviations | self._narrow_torques(torques, "deviation"))

    def noise_of(self, compared: Comparison) -> Errors:
        """Noise of each channel: what the smoother finds or, where that is more, the white part of a model's errors.

        Of a rough motion the smoother takes noise for motion; what a torque does to a position is never white.
        """
        noises = self.noise_floor(compared.torques)
        for side, noise in self.noise.items():
            position = POSITION_CHANNELS[side]
            more = max(1.0, estimate_white_noise(list(compared.samples[position])) / noise)
            for name in noises:
                if name == position or name.partition(" ")[0].endswith(f"_{side}"):
                    noises[name] *= more
            noises[position] *= np.hypot(1.0, compared.noise.get(position, 0.0))
        return noises

    def _narrow_torques(self, torques: SideResiduals, name: str = "torque") -> NamedArrays:
        """Missing torques, or their noise, N m: behind the low-pass by `torque_motor` and so on, and slow ones behind
        narrower low-passes by `torque_motor below 12 Hz`."""
        narrowed = {}
        for side, pieces in torques.items():
            narrowed[f"torque_{side}"] = _join_narrow(pieces, self.bandwidth[side], name)
            duration = sum(len(piece.time) * piece.period for piece in pieces)
            for cutoff in (self.bandwidth[side] / factor for factor in _SLOW):
                if 2.0 * cutoff * duration >= _LEAST_VALUES:
                    narrowed[f"torque_{side}{BELOW}{cutoff:.3g} Hz"] = _join_narrow(pieces, cutoff, name)
        return narrowed

    def largest_departures(self, experiment: Experiment) -> Errors:
        """Measure how far a model departs from each side's motion on short windows from the smoothed states, over its range.

        Or over the way on which the input would move a free motor within a window, where that is more: a model that lacks
        the friction of a slow drive goes as far.
        """
        force = max(np.max(np.abs(segment.torque)) for segment in self.segments) * float(experiment.plant.input_gain)
        free = 0.5 * abs(force) / float(experiment.plant.inertia("motor")) * (self.samples * self.period) ** 2
        experiment, _ = with_torques(experiment)
        windows = jax.tree.map(np.asarray, windows_of(self.segments, experiment, self.samples, self.at_rest))
        simulated = simulate_plants(*lean(experiment, windows.start), windows.torque, windows.time).position
        departures = {}
        for side in experiment.sides:
            apart = float(np.max(np.abs(simulated[side] - windows.measured[side])))
            span = max(
                *(np.ptp(segment.readings[side]) for segment in self.segments), free / float(experiment.drive.ratio(side))
            )
            departures[side] = apart / span if np.isfinite(apart) else np.inf
        return departures

    def compare(self, experiment: Experiment, models: Sequence[Experiment] = ()) -> Comparison:
        """Errors of a model at this log's period on short windows, and the torques that it lacks.

        Args:
            experiment: the model.
            models: one for each part of the log (:func:`parts_of_blocks`), such as ones whose numbers were fitted without
                it, whose errors there are taken in place of the model's.
        """
        torques, parts, noises = self.find_lacking(experiment), [], []
        for i, model in enumerate(models or [experiment]):
            part = i, len(models) or 1
            samples, noise = self._samples(model, part)
            narrowed = self._narrow_torques(self.find_lacking(model) if models else torques)
            parts.append(samples | {name: torque[_rows_of(len(torque), part)] for name, torque in narrowed.items()})
            noises.append(noise)
        samples = {}
        for name in parts[0]:
            errors = np.concatenate([part[name] for part in parts])
            rows = np.concatenate([_rows_of(len(errors), (i, len(parts))) for i in range(len(parts))])
            samples[name] = errors[np.argsort(rows)]
        noise = {name: rms(np.array([added_noise[name] for added_noise in noises])) for name in noises[0]}
        return Comparison(_all_rms(samples), torques, samples, float(experiment.plant.input_gain), noise)

    def find_lacking(self, experiment: Experiment) -> SideResiduals:
        """Torques that a model lacks, by side, segment by segment."""
        return residual_torques(at_period(experiment, self.period), self.segments)

    def readings(self) -> NamedArrays:
        """Positions as they were read, rad, by channel."""
        return {
            POSITION_CHANNELS[side]: np.concatenate([segment.readings[side] for segment in self.segments])
            for side in self.noise
        }

    def rounding(self, experiment: Experiment) -> Errors:
        """Torques that a model seems to lack along its own motion, rms, N m, by channel, since a smoother rounds jumps of
        friction, and with them the motion on both sides of a spring.

        On the short windows, each smoothed as the log was. Nothing of a model with a memory, since a window does not show
        what was before; its friction does not jump.
        """
        experiment = at_period(experiment, self.period)
        if experiment.plant.has_memory or any(segment.transmitted is not None for segment in self.segments):
            return {}
        run, firsts = self._runs(experiment, (0, 1))
        pieces = []
        for i, first in enumerate(firsts):
            segment = next(segment for segment in self.segments if segment.rows.start <= first < segment.rows.stop)
            readings = {side: np.asarray(run.states.position[side])[i] for side in experiment.sides}
            smoothed = {
                side: smooth(values, self.period, noise_and_jerk=(segment.smoothed[side].noise, segment.smoothed[side].jerk))
                for side, values in readings.items()
            }
            start = int(first) - segment.rows.start
            earlier = segment.torque[:1] if segment.before is None else segment.before
            before = np.concatenate([np.repeat(earlier[:1], _BEFORE), earlier, segment.torque[:start]])[-_BEFORE:]
            window = segment[start : start + self.samples]
            pieces.append(replace(window, readings=readings, smoothed=smoothed, before=before))
        torques = residual_torques(experiment, pieces)
        return _all_rms(self._narrow_torques(torques))

    def missing(self, experiment: Experiment, name: str = "torque") -> NamedArrays:
        """Torques that a model lacks behind the low-pass, or their noise (`deviation`), N m, by side."""
        torques = self.find_lacking(experiment)
        return {side: _join_narrow(pieces, self.bandwidth[side], name) for side, pieces in torques.items()}

    def lacking_friction(self, experiment: Experiment, side: str) -> tuple[np.ndarray, np.ndarray]:
        """A dry friction and a steady torque of 1 N m on a side, behind the low-pass as in :meth:`missing`, shape
        (2, samples), 0 where the model has one; and where the side moves, shape (samples,)."""
        effects = [effect for effect in experiment.effects if effect.place == side]
        dry = not any(effect.exclusive for effect in effects)
        steady = not any(isinstance(effect, ConstantTorque) for effect in effects)
        pieces, columns = self.find_lacking(experiment)[side], []
        for segment, piece in zip(self.segments, pieces, strict=True):
            smoothed = segment.smoothed[side]
            moving = ~smoothed.find_standstill(self.period)
            signals = np.stack([dry * np.sign(smoothed.velocity), steady * np.ones(len(segment)), moving])
            columns.append(low_passed(as_smoothed(signals, smoothed, self.period), piece, self.bandwidth[side]))
        friction = np.concatenate(columns, axis=1)
        return friction[:2], np.rint(friction[2]) > 0

    def _samples(self, experiment: Experiment, part: _Part) -> tuple[NamedArrays, Errors]:
        """Errors of positions and speeds on the windows of a part, where these are foretold; shape (windows, samples). And
        what noise adds by way of the initial states, as of a comparison."""
        run, firsts = self._runs(experiment, part)
        rows = firsts[:, None] + np.arange(self.samples)
        errors_of = {
            POSITION_CHANNELS[side]: self.noise[side] * run.residual[:, :, i] for i, side in enumerate(experiment.sides)
        }
        for side in experiment.sides:
            smoothed = np.full(self.segments[-1].rows.stop, np.nan)
            for segment in self.segments:
                smoothed[segment.rows] = segment.smoothed[side].velocity
            errors_of[f"velocity_{side}"] = np.asarray(run.states.velocity[side]) - smoothed[rows]
        noise = {POSITION_CHANNELS[side]: float(run.noise[i]) for i, side in enumerate(experiment.sides)}
        return {name: errors[:, count_seen(self.samples) :] for name, errors in errors_of.items()}, noise

    def _runs(self, experiment: Experiment, part: _Part) -> tuple[Run, np.ndarray]:
        """Runs on the windows of a part, and the row that each begins with."""
        # the loop of steps is that of linearisations, which have these torques
        experiment, _ = with_torques(at_period(experiment, self.period))
        windows = windows_of(self.segments, experiment, self.samples, self.at_rest)
        indices = _rows_of(len(windows.rows), part)
        return best_runs(experiment, windows, _STATES, self.at_rest, indices), windows.rows[indices]


def parts_of_blocks(parts: int) -> np.ndarray:
    """Tell to which of so many parts each block of a log belongs, shape (blocks,): 0 1 2 3, 1 2 3 0, 2 3 0 1, 3 0 1 2 of
    four. Each part has slow and fast motion of a chirp, and all of a motion that repeats."""
    blocks = np.arange(BLOCKS)
    return (blocks + blocks // parts) % parts


def _rows_of(count: int, part: _Part) -> np.ndarray:
    """Find the rows of a part of a log, in order."""
    return np.flatnonzero(parts_of_blocks(part[1])[BLOCKS * np.arange(count) // count] == part[0])


def _join_narrow(pieces: Sequence[Residual], cutoff: float, name: str) -> np.ndarray:
    """Missing torques, or their noise, behind a low-pass (Hz), one piece after the other, N m."""
    return np.concatenate([getattr(narrow(piece, cutoff)[0], name) for piece in pieces])


def _all_rms(samples: NamedArrays) -> Errors:
    return {name: rms(errors) if np.isfinite(errors).all() else np.inf for name, errors in samples.items()}
