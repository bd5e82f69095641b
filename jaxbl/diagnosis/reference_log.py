"""How well a model predicts a log that it was not fitted to: positions, speeds and missing torques, and their noise.

Positions by short windows and by one free run, each from the best initial state: what an initial state can explain is no
error of the model. Torques by the equations of motion at the smoothed motion, behind one low-pass for all models.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbl.drive.effects import SideEffect
from jaxbl.drive.parameters import Scalar
from jaxbl.drive.plant import PlantState
from jaxbl.fused.single_plant import path
from jaxbl.identification.segments import Segment, reading_noise, windows_of
from jaxbl.identification.trajectory import Windows, projected_residual
from jaxbl.records import POSITION_CHANNELS
from jaxbl.simulate import Experiment, trajectory, with_effects

from .neutral_effects import bucket
from .residuals import Residual, narrowed, residual_torques

WINDOW = 0.5
"""Length of the short windows, s: several periods of a drive's resonance, and too short to drift far."""
_FEWEST = 20
"""Samples of a window at least: ten times the states that are fitted to it."""
_BLOCK = 0.5
"""Length of the blocks that a permuted residual is made of, s: longer than a torque's own changes last."""
_PREDICTABLE = 0.02
"""Share of the motion that the initial speed's uncertainty may grow to where a free run is to say anything."""
_STATES, _STATES_OF_ONE_RUN = 8, 3
"""Initial states tried for each window, and for a free run, which determines its own much better."""


class Comparison(NamedTuple):
    """A model beside a log.

    Attributes:
        errors: rms, by channel (`theta_e`, `theta_s`, `velocity_motor`, ..., `torque_motor`, ...).
        torques: that the model lacks, by side, segment by segment.
    """

    errors: dict[str, float]
    torques: dict[str, list[Residual]]


@dataclasses.dataclass(frozen=True)
class ReferenceLog:
    """A log that models are compared with.

    Attributes:
        segments: of the log.
        bandwidth: of the low-pass that missing torques are looked at behind, Hz, by side.
        rest: whether each segment begins at rest.
    """

    segments: Sequence[Segment]
    bandwidth: Mapping[str, float]
    rest: bool = False

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
        return min(max(round(WINDOW / self.period), _FEWEST), max(map(len, self.segments)))

    def noise_floor(self, torques: Mapping[str, Sequence[Residual]]) -> dict[str, float]:
        """Noise of each channel: what a perfect model would leave."""
        found = {POSITION_CHANNELS[side]: noise for side, noise in self.noise.items()}
        for side in self.noise:
            found[f"velocity_{side}"] = _rms([np.asarray(one.smoothed[side].deviation(1)) for one in self.segments])
        for side, pieces in torques.items():
            found[f"torque_{side}"] = _rms([narrowed(one, self.bandwidth[side])[0].deviation for one in pieces])
        return found

    def torque_errors(self, torques: Mapping[str, Sequence[Residual]]) -> dict[str, float]:
        """Rms missing torque of each side behind the low-pass, N m."""
        return {
            f"torque_{side}": _rms([narrowed(one, self.bandwidth[side])[0].torque for one in pieces])
            for side, pieces in torques.items()
        }

    def torques(self, experiment: Experiment) -> dict[str, list[Residual]]:
        """Torques that a model lacks on each side."""
        found = residual_torques(experiment, self.segments)
        return {side: found[side] for side in experiment.sides if side in found}

    def windows(self, experiment: Experiment, samples: int) -> tuple[Windows, np.ndarray]:
        """The log in windows, some of them only to fill up, and the row that each of the others begins with."""
        windows, firsts = windows_of(self.segments, experiment, samples, self.rest)
        return windows.padded(bucket(len(firsts), 1)), firsts

    def largest_departures(self, experiment: Experiment) -> dict[str, float]:
        """How far a model departs from each side's motion on short windows from the smoothed states, over its range."""
        windows, _ = self.windows(experiment, self.samples)
        apart = _largest_departures(experiment, windows)
        ranges = {side: max(float(np.ptp(one.readings[side])) for one in self.segments) for side in apart}
        return {side: float(np.nan_to_num(float(one), nan=np.inf)) / ranges[side] for side, one in apart.items()}

    def compare(self, experiment: Experiment) -> Comparison:
        """Errors of a model on short windows, and the torques that it lacks."""
        driven = self._driven(experiment, {})
        windows, firsts = self.windows(driven, self.samples)
        torques = self.torques(experiment)
        errors = self._errors(driven, windows, firsts, _STATES)
        return Comparison(errors | self.torque_errors(torques), torques)

    def _driven(self, experiment: Experiment, tables: Mapping[str, np.ndarray]) -> Experiment:
        """A model with known torques on its sides, sample by sample; none where there is no table."""
        begin, end = self.segments[0].time[0], self.segments[-1].time[-1]
        period, first = (jnp.asarray(float(one)) for one in (self.period, begin))
        count = round(float(end - begin) / self.period) + 1
        known = []
        for side in experiment.sides:
            table = np.zeros(bucket(count, 256))
            given = tables.get(side, np.zeros(0))
            table[: len(given)] = given
            known.append(_KnownTorque(side=side, torque=jnp.asarray(table), first=first, period=period))  # type: ignore[arg-type]
        return with_effects(experiment, (*known, *experiment.effects))

    def free_run(self, experiment: Experiment) -> tuple[dict[str, float], float]:
        """Errors of one run over the longest segment, and what a standard deviation of the initial speed would do to it.

        The latter over the motion's; large where a free run cannot be predicted. Up to a ninth at the end may be left out,
        so that compiled programs serve logs of several lengths.
        """
        longest = max(map(len, self.segments))
        spare = max(longest.bit_length() - 4, 0)
        windows, firsts = windows_of(self.segments, experiment, longest >> spare << spare, self.rest)
        windows, firsts = windows.only(np.arange(1)).padded(1), firsts[:1]
        errors = self._errors(experiment, windows, firsts, _STATES_OF_ONE_RUN, alone=True)
        first = next(one for one in self.segments if one.rows.start == firsts[0])
        deviation = {side: float(np.median(np.asarray(one.deviation(1)))) for side, one in first.smoothed.items()}
        return errors, _growth(experiment, windows, deviation)

    def _errors(
        self, experiment: Experiment, windows: Windows, firsts: np.ndarray, passes: int, *, alone: bool = False
    ) -> dict[str, float]:
        rows = firsts[:, None] + np.arange(windows.torque.shape[1])[None, :]
        residual, start = _residuals(experiment, windows, passes, self.rest)
        residual = np.asarray(residual)[: len(firsts)]
        if alone:
            velocity = {side: one[None] for side, one in _run(experiment, windows, start).velocity.items()}
        else:
            velocity = {
                side: np.asarray(one)[: len(firsts)] for side, one in _velocities(experiment, windows, start).items()
            }
        found = {}
        for i, side in enumerate(experiment.sides):
            found[POSITION_CHANNELS[side]] = self.noise[side] * _rms([residual[:, :, i]])
        for side in experiment.sides:
            smoothed = np.full(self.segments[-1].rows.stop, np.nan)
            for one in self.segments:
                smoothed[one.rows] = np.asarray(one.smoothed[side].velocity)
            found[f"velocity_{side}"] = _rms([np.asarray(velocity[side]) - smoothed[rows]])
        return found

    def permuted(self, experiment: Experiment, added: Mapping[str, Sequence[np.ndarray]], seed: int = 0) -> Comparison:
        """Errors of a model with a known torque that is the right one in the wrong order: blocks of time, shuffled.

        Args:
            experiment: the nominal model.
            added: torque that the extended model adds on each side, segment by segment, N m.
            seed: of the order.
        """
        time = np.concatenate([one.time for one in self.segments])
        at = np.round((time - time[0]) / self.period).astype(int)
        size = max(round(_BLOCK / self.period), 1)
        order = _order(len(time), size, np.random.default_rng(seed))
        tables, torques = {}, {}
        before = self.torques(experiment)
        for side in experiment.sides:
            shuffled = np.concatenate(list(added[side]))[order]
            tables[side] = np.zeros(at[-1] + 1)
            tables[side][at] = shuffled
            ends = np.cumsum([len(one.time) for one in before[side]])[:-1]
            torques[side] = [
                dataclasses.replace(one, torque=one.torque - piece)
                for one, piece in zip(before[side], np.split(shuffled, ends), strict=True)
            ]
        model = self._driven(experiment, tables)
        windows, firsts = self.windows(model, self.samples)
        return Comparison(self._errors(model, windows, firsts, _STATES) | self.torque_errors(torques), torques)


def predictable(growth: float) -> bool:
    """Whether a free run with this growth (:meth:`ReferenceLog.free_run`) says anything."""
    return bool(growth < _PREDICTABLE)


class _KnownTorque(SideEffect):
    """A torque along time that drives a side."""

    kind: ClassVar[str] = "known_torque"
    torque: Float[Array, " samples"]
    first: Scalar
    period: Scalar

    def resist(self, state: Any, motion: Any) -> Any:
        at = jnp.floor((motion.time - self.first) / self.period + 1e-6).astype(jnp.int32)
        return -self.torque[jnp.clip(at, 0, len(self.torque) - 1)]


def _order(count: int, size: int, random: np.random.Generator) -> np.ndarray:
    """Indices in which blocks have changed places: none stays."""
    blocks = np.array_split(np.arange(count), max(count // size, 2))
    places = random.permutation(len(blocks))
    source = np.empty(len(blocks), int)
    # a cycle through all of them
    source[places] = np.roll(places, 1)
    return np.concatenate([blocks[i] for i in source])[:count]


@eqx.filter_jit
def _residuals(experiment: Experiment, windows: Windows, passes: int, rest: bool) -> tuple[Array, PlantState]:
    """Position residuals over the noise from the best initial states, and these."""
    return projected_residual(experiment, windows, passes, rest)


@eqx.filter_jit
def _velocities(experiment: Experiment, windows: Windows, start: PlantState) -> dict[str, Array]:
    def one(start: PlantState, torque: Array, time: Array) -> dict[str, Array]:
        return trajectory(experiment, start, torque, time).velocity

    return jax.vmap(one)(start, windows.torque, windows.time)


def _run(experiment: Experiment, windows: Windows, start: PlantState) -> PlantState:
    """Path of the first window alone."""
    start, torque, time = jax.tree.map(lambda x: np.asarray(x)[0], (start, windows.torque, windows.time))
    return path(experiment, start, torque, time)


@eqx.filter_jit
def _largest_departures(experiment: Experiment, windows: Windows) -> dict[str, Array]:
    def one(start: PlantState, torque: Array, time: Array) -> dict[str, Array]:
        return trajectory(experiment, start, torque, time).position

    simulated = jax.vmap(one)(windows.start, windows.torque, windows.time)
    return {side: jnp.max(jnp.abs(simulated[side] - windows.measured[side])) for side in experiment.sides}


def _growth(experiment: Experiment, windows: Windows, deviation: dict[str, float]) -> float:
    """Change of the positions by a standard deviation of the initial speeds, over the motion; the larger of the sides."""
    start, step = windows.start, 1e-3
    moved = {side: value + step * deviation[side] for side, value in start.velocity.items()}
    begun = start, PlantState(start.position, moved, start.effects)
    one, other = (_run(experiment, windows, state).position for state in begun)
    # of what diverges, or of a side that never moved, nothing can be predicted
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        change = {side: _rms([np.asarray(other[side] - one[side])]) / step for side in experiment.sides}
        return float(np.max([change[side] / np.std(windows.measured[side][0]) for side in experiment.sides]))


def _rms(pieces: Sequence[np.ndarray]) -> float:
    values = np.concatenate([np.ravel(one) for one in pieces])
    return float(np.sqrt(np.mean(values**2))) if np.isfinite(values).all() else float("inf")
