"""The experiment that would part effects that a log does not: what `jaxbl diagnose --next-experiment` writes.

It is the input on which the two models differ most, within given limits.
References: G. Box, W. Hill, Discrimination among mechanistic models, Technometrics 9 (1967); W. Hunter, A. Reiner, Designs
for discriminating between two rival models, Technometrics 7 (1965).
"""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, Float
from scipy.signal import detrend

from jaxbl.chain import Experiment, plant_trajectory
from jaxbl.config import Config, read_config, with_values
from jaxbl.drive.effects import Backlash
from jaxbl.drive.excitation import AbstractExcitation, Chirp, Multisine, Prbs, Sine
from jaxbl.drive.plant import PlantState
from jaxbl.errors import InputError
from jaxbl.estimation.logs import LogTask, default_paths, on_record
from jaxbl.estimation.segments import reading_noise, segments_of
from jaxbl.estimation.unseen_load import GAPS
from jaxbl.fused.compilation import jit
from jaxbl.json_types import JsonObject
from jaxbl.records import Record

from .diagnosis_summary import find_tie
from .neutral_effects import with_added

_SHARES = 0.01, 0.03, 0.1, 0.25, 0.5, 0.75, 1.0
"""Amplitudes, over the largest torque allowed."""
_FREQUENCIES = 6
"""Tried of each kind, evenly spaced in their logarithm."""
_DECADE, _BITS = 10.0, 7
"""Last frequency of a chirp over its first; bits of the register that makes the steps."""
_LONGEST = 10.0
"""Duration at most, s."""
_DECISIVE = 10.0
"""Nats from which on an experiment decides between two effects: refitted numbers cost some of them."""


class Input(NamedTuple):
    """An input that was tried.

    Attributes:
        kind: sine, multisine, chirp or steps.
        amplitude: largest torque, off the mean, N m.
        frequency: Hz; of a multisine the lowest, of a chirp the first, of steps one over twice their length.
        torque: shape (samples,).
        apart: nats by which readings of it favour one model over the other: half the sum of squares of the difference of
            their positions, over the variance of the readings' noise.
        mean: of the torque, N m.
    """

    kind: str
    amplitude: float
    frequency: float
    torque: np.ndarray
    apart: float
    mean: float = 0.0


def write_next_experiment(
    folder: Path, summary: JsonObject, record: Record, path: Path, torque: float | None = None, travel: float | None = None
) -> str:
    """Write the input as CSV with columns t (s) and u (N m). Returns a sentence on it.

    Args:
        folder: results of the diagnosis.
        summary: its `diagnosis.json`.
        record: the log.
        path: the file to be written.
        torque, travel: as of :func:`next_experiment`.

    Raises:
        InputError: the file cannot be written.
    """
    pair = find_tie(summary)
    if pair is None:
        return "Nothing is tied: no experiment is needed to part effects, and none was written."
    experiment = next_experiment(summary, read_config(folder / "model.toml"), record, torque, travel)
    if experiment is None:
        return f"No input stays within the torque and travel allowed that would part {pair[0]} from {pair[1]}."
    return f"To part {pair[0]} from {pair[1]}: {_write_input(experiment, record, path)}"


def check_gap_sought(task: LogTask) -> None:
    """Refuse to seek a move that shows a gap to the motor alone where an identification does not seek one by it.

    Raises:
        InputError: a log with both encoders, or a model without a gap among the numbers to be found.
    """
    record, config = task.record, task.config
    if "load" in record.positions:
        raise InputError(
            f"{record.path}: --next-experiment writes a move that shows a gap to the motor's encoder alone, but this log "
            "has theta_s; jaxbl diagnose --next-experiment parts effects"
        )
    with jax.enable_x64(True):
        paths = config.identify.parameters or default_paths(config, on_record(config, record))
    if not any(path.endswith(GAPS) for path in paths):
        raise InputError(
            f"{record.path}: --next-experiment writes a move that shows a gap, and none is among the numbers to be found; a "
            "half_gap (or dead_zone) in [transmission] gives one to begin with"
        )


def write_gap_experiment(
    folder: Path, summary: JsonObject, record: Record, path: Path, torque: float | None = None, travel: float | None = None
) -> str:
    """Write the move that would show a gap to the motor alone, where a log does not. Returns a sentence on it.

    It is the input on which the model without a gap differs most from one with the largest gap that the log leaves open, or
    with the nominal one if that is smaller. Arguments as of :func:`write_next_experiment`; `summary` has `backlash`.
    """
    backlash = summary["backlash"]
    if backlash is None:
        return (
            "No gap is sought: the model has one, or [uncertainty] exact says that it has none; no experiment was written."
        )
    if backlash["shown"]:
        return "No gap is in doubt: no experiment is needed to show one, and none was written."
    half, model = float(min(backlash["at_most"], backlash["nominal"] or np.inf)), read_config(folder / "model.toml")
    assert record.torque is not None
    with jax.enable_x64(True):
        pair = model, with_gap(model, backlash["path"], half)
        experiment = _find_parting_input(pair, record, torque, travel, float(np.mean(record.torque)))
    aim = f"a half gap of {half:.3g} {record.unit_of('motor.position', 'rad')}"
    if experiment is None:
        return f"No input stays within the torque and travel allowed that would show {aim}: --max-torque, --max-travel."
    return f"To show {aim}: {_write_input(experiment, record, path)}"


def with_gap(model: Config, path: str, half: float) -> Config:
    """A study with a half gap, rad, in the number that a path names."""
    if path.startswith("effects."):
        data = model.to_dict()
        gap = f"transmission.{Backlash.kind}"
        effects = [effect for effect in data.get("effects", []) if effect["kind"] != gap]
        data["effects"] = with_added(effects, [{"kind": gap, "half_gap": half}])
        return read_config(data)
    return with_values(model, {path: half / (4.0 if path.endswith("dead_zone") else 1.0)})


def _write_input(experiment: Input, record: Record, path: Path) -> str:
    """Write an input as CSV; what it is, and where."""
    time = record.sample_period * np.arange(len(experiment.torque))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        pd.DataFrame({"t": time, "u": experiment.torque}).to_csv(path, index=False, float_format="%.9g")
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}; name another file") from None
    clear = "" if experiment.apart > _DECISIVE else ": too little; --max-torque and --max-travel allow for more"
    unit = record.unit_of("motor.torque", "N m")
    mean = f" about a mean of {experiment.mean:.3g} {unit}" if experiment.mean else ""
    return (
        f"{experiment.kind} of {experiment.amplitude:.3g} {unit}{mean}, {experiment.frequency:.3g} Hz, "
        f"{time[-1] + record.sample_period:.3g} s; it would separate them by up to {experiment.apart:.2g} nats{clear}: "
        f"{path}"
    )


def next_experiment(
    summary: JsonObject, model: Config, record: Record, torque: float | None = None, travel: float | None = None
) -> Input | None:
    """The input on which the last finding and its best alternative differ most; None where no input stays within limits.

    Args:
        summary: of a diagnosis that has a tie (:func:`find_tie`).
        model: the extended model.
        record: the log.
        torque: largest that is allowed, N m; left out: that of the log.
        travel: of the motor that is allowed, rad (the load may move as far over the gear); left out: those of the log.
    """
    data = model.to_dict() | summary["rival"]
    del data["effect"]
    with jax.enable_x64(True):
        return _find_parting_input((model, read_config(data)), record, torque, travel)


def _find_parting_input(
    pair: tuple[Config, Config], record: Record, torque: float | None, travel: float | None, bias: float = 0.0
) -> Input | None:
    """Find the input on which two models' positions differ most, within torque and travel; None where all go beyond.

    Sides that the log has count. Both begin at rest in the middle of the log's motion; `bias` is added to all inputs, N m.
    What another initial position or speed would make of the difference does not count.
    """
    assert record.torque is not None
    models = [on_record(config, record) for config in pair]
    first_model = models[0]
    sides = [side for side in first_model.sides if side in record.positions]
    segments = segments_of(record, sides)
    noise = reading_noise(segments)
    largest = np.max(np.abs(record.torque)) if torque is None else torque
    inputs = _inputs(record, max(largest - abs(bias), 0.0), bias)
    torques = jnp.asarray(np.stack([trial.torque for trial in inputs]))
    start = {side: jnp.median(np.concatenate([segment.readings[side] for segment in segments])) for side in sides}
    if len(first_model.sides) == 2:
        ratio = jnp.asarray(float(first_model.drive.ratio("load")))
        start.setdefault("load", start["motor"] / ratio)
        start["motor"] = start["load"] * ratio
    paths = [_runs(model, start, torques) for model in models]
    apart, inside = np.zeros(len(inputs)), np.ones(len(inputs), bool)
    for side in sides:
        if travel is None:
            reach = max(np.ptp(segment.readings[side]) for segment in segments)
        else:
            reach = travel / abs(float(first_model.drive.ratio(side)))
        # of a path that diverges nothing is finite, and it is not inside
        with np.errstate(invalid="ignore", over="ignore"):
            first, second = (np.asarray(path[side]) for path in paths)
            for path in (first, second):
                inside &= np.ptp(path, axis=1) <= reach
            left = detrend(np.where(inside[:, None], second - first, 0.0))
        apart += 0.5 * np.sum((left / noise[side]) ** 2, axis=1)
    if not inside.any():
        return None
    best = int(np.argmax(np.where(inside, apart, -1.0)))
    return inputs[best]._replace(apart=float(apart[best]))


def _inputs(record: Record, largest: float, mean: float) -> list[Input]:
    """Inputs of up to a torque about a mean (N m), at the period of a log: kinds, amplitudes and frequencies."""
    period = record.sample_period
    # gaps of a log are no part of it
    duration = min(sum(part.stop - part.start for part in record.segments) * period, _LONGEST)
    time = period * jnp.arange(round(duration / period))
    top = min(0.02 / period, 10.0)
    inputs = []
    for frequency in np.geomspace(min(2.0 / duration, 0.5 * top), top, _FREQUENCIES).tolist():
        waves: dict[str, AbstractExcitation] = {
            "sine": Sine(1.0, frequency),
            "multisine": Multisine(1.0, frequency),
            "chirp": Chirp(1.0, frequency, _DECADE * frequency, duration),
            "steps": Prbs(1.0, 0.5 / frequency, _BITS),
        }
        for kind, excitation in waves.items():
            wave = np.asarray(jax.vmap(excitation)(time))
            wave = wave / np.max(np.abs(wave))
            amplitudes = [share * largest for share in _SHARES]
            inputs += [Input(kind, most, frequency, mean + most * wave, 0.0, mean) for most in amplitudes]
    return inputs


@jit
def _runs(
    experiment: Experiment, position: dict[str, Array], torques: Float[Array, "inputs samples"]
) -> dict[str, Float[Array, "inputs samples"]]:
    still = jax.tree.map(jnp.zeros_like, position)
    start = PlantState(position, still, experiment.plant.init(experiment.initial).effects)
    return jax.vmap(lambda torque: plant_trajectory(experiment, start, torque).position)(torques)
