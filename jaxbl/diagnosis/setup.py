"""What a diagnosis begins with: the nominal model on the log that is fitted, and where it lacks torque."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxbl.chain import Experiment
from jaxbl.errors import InputError
from jaxbl.estimation.free_parameters import FreeParameter, make_free_parameters
from jaxbl.estimation.logs import default_paths, on_record
from jaxbl.estimation.segments import Segment, segments_of, signal_sizes
from jaxbl.records import POSITION_CHANNELS, Record
from jaxbl.records.signal_quality import estimate_white_noise

from .coordinates import SideCoordinates, all_coordinates
from .diagnosis_task import DiagnosisTask, input_rms
from .input_noise import smoothed_input, unfelt
from .linearised_model import Linear
from .localise import Localised, localise
from .neutral_effects import candidates, complete
from .reference_log import WINDOW, ReferenceLog
from .residuals import SideResiduals, residual_torques

_DIVERGED = 10.0
"""Departure from the motion on short windows, over its range, from which on a model counts as diverging."""
_NOISY = 1e-3
"""Noise over the input's rms from which on it is asked whether the drive felt it."""
_SHOWN = 3.0
"""Nats from which on it counts as shown that the drive did not: odds of twenty."""
_BELOW = 3.0
"""Standard errors by which a share below zero does not come about by chance."""


class InputNoise(NamedTuple):
    """White noise of the channel that recorded the input.

    Attributes:
        unfelt: what the drive surely did not feel, N m; models are driven by an input without it.
        possible: what it may not have felt, N m.
    """

    unfelt: float
    possible: float


class Setup(NamedTuple):
    """The nominal model and the logs.

    Attributes:
        task: study and logs.
        sliding: sides whose positions are no angles.
        bare: the model as given.
        nominal: the same with all effects without a state at neutral numbers.
        free: its numbers that are not exactly known.
        prior: relative standard deviation of each.
        recorded: segments of the log that numbers are fitted to, with the input as it was recorded.
        fitted: that log, with the input that drives models.
        lacking: torques that the model lacks on the log, by side, segment by segment.
        coordinates: along these torques.
        located: where it lacks them, by side.
        input_noise: of the channel that recorded the input.
    """

    task: DiagnosisTask
    sliding: list[str]
    bare: Experiment
    nominal: Experiment
    free: tuple[FreeParameter, ...]
    prior: np.ndarray
    recorded: Sequence[Segment]
    fitted: ReferenceLog
    lacking: SideResiduals
    coordinates: SideCoordinates
    located: dict[str, Localised]
    input_noise: InputNoise


def set_up(task: DiagnosisTask, noise: InputNoise | None = None) -> Setup:
    """The nominal model on the log that is fitted; what is held out is not opened.

    Models are driven by the recorded input less what the drive did not feel of it, by the nominal model unless its `noise`
    is given.

    Raises:
        InputError: a model that diverges, or whose effects are in an order that others would change.
    """
    config, record = task.config, task.record
    assert record.torque is not None
    bare = on_record(config, record)
    # one structure for all models, so that they share their compiled programs
    nominal = complete(bare)
    _check_order(bare)
    at_rest = config.log.initial_state == "rest"
    recorded = segments_of(record, nominal.sides, at_rest)
    free = make_free_parameters(bare, default_paths(config, bare), signal_sizes(bare, recorded))
    prior = np.full(len(free), config.uncertainty.relative)
    for side, apart in ReferenceLog(recorded, {}, at_rest).largest_departures(nominal).items():
        if not apart < _DIVERGED:
            raise InputError(
                f"{record.path}: the model diverges under this log's input: within {WINDOW:g} s its {side} leaves the "
                f"measured motion by {apart:.2g} times the whole of it; a number of it, or its sign, is wrong"
            )
    noise = noise or _input_noise(record, nominal, recorded)
    channels, segments = record.statistics.channels, quiet(recorded, noise.unfelt)
    lacking = residual_torques(nominal, segments)
    sliding = [side for side in nominal.sides if channels[POSITION_CHANNELS[side]].unit == "m"]
    coordinates = all_coordinates(nominal, segments, lacking, sliding)
    located = localise(nominal, lacking, segments, coordinates)
    fitted = ReferenceLog(segments, {name: place.bandwidth for name, place in located.items()}, at_rest)
    return Setup(task, sliding, bare, nominal, free, prior, recorded, fitted, lacking, coordinates, located, noise)


def doubt_input(setup: Setup, model: Experiment) -> Setup | None:
    """Set up anew if a model shows that noise of the recorded input did not act; None if it does not."""
    if setup.input_noise.unfelt > 0.0:
        return None
    noise = _input_noise(setup.task.record, model, setup.recorded)
    return set_up(setup.task, noise) if noise.unfelt > 0.0 else None


def quiet(segments: Sequence[Segment], noise: float) -> Sequence[Segment]:
    """Segments with their inputs smoothed; `noise`: the inputs' standard deviation that the drive did not feel, N m."""
    if not noise > 0.0:
        return segments
    return [dataclasses.replace(segment, torque=smoothed_input(segment.torque, noise)) for segment in segments]


def _input_noise(record: Record, model: Experiment, segments: Sequence[Segment]) -> InputNoise:
    """Noise of the channel that recorded the input, and whether the drive felt it by a model; where it is small beside the
    input's rms, that is not asked."""
    noise = estimate_white_noise([segment.torque for segment in segments])
    if not _NOISY * input_rms(record) < noise:
        return InputNoise(0.0, noise)
    # at the model's numbers: those that may change would absorb some of the noise
    recorded, smooth = (Linear(model, (), np.zeros(0), np.zeros(0), driven) for driven in (segments, quiet(segments, noise)))
    smoothness = recorded.best_predictor.smoothness
    share, error = unfelt(recorded.find_errors_left(smoothness), smooth.find_errors_left(smoothness))
    # nats that it did not feel it, rather than did
    nats = (share - 0.5) / error**2
    # below none it says nothing: a controller that hands the encoder's noise on, or what the model lacks, hides the share
    possible = 1.0 if share < -_BELOW * error else float(np.sqrt(np.clip(share + 2.0 * error, 0.0, 1.0)))
    return InputNoise(noise if nats > _SHOWN else 0.0, possible * noise)


def _check_order(bare: Experiment) -> None:
    """Refuse a model of which two effects share a name, and are called by positions that others would shift."""
    names = [effect.name for effect in bare.effects]
    twice = next((name for name in names if names.count(name) > 1), None)
    effects = complete(bare, candidates(bare)).effects
    if twice is not None and [effect.name for effect in effects[: len(names)]] != names:
        raise InputError(f"effects: two are {twice}; list them before those of the actuator")
