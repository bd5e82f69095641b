"""The experiment that would part effects that a log does not: what `jaxbl diagnose --next-experiment` writes."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pandas as pd

from jaxbl.config import Config, read_config
from jaxbl.diagnosis.discriminating_input import Input, parting
from jaxbl.errors import InputError
from jaxbl.identification.logs import on_record
from jaxbl.identification.segments import reading_noise, segments_of
from jaxbl.records import Record

_CLEAR = 10.0
"""Nats from which on an experiment decides between two effects: refitted numbers cost some of them."""


class Limits(NamedTuple):
    """What an experiment may ask of the machine; None: no more than the log.

    Attributes:
        torque: largest, N m.
        travel: of the motor, rad.
    """

    torque: float | None = None
    travel: float | None = None


_LOGS = Limits()


def next_experiment(summary: Mapping[str, Any], model: Config, record: Record, limits: Limits = _LOGS) -> Input | None:
    """The input on which the first finding and its best alternative differ most; None where no input stays within limits.

    Args:
        summary: of a diagnosis that has a tie (:func:`tied`).
        model: the extended model.
        record: the log.
        limits: of the machine.
    """
    rival = summary["rival"]
    data = model.resolved() | {key: rival[key] for key in ("drive", "transmission", "effects") if key in rival}
    with jax.enable_x64(True):
        one, other = (on_record(each, record) for each in (model, read_config(data)))
        noise = reading_noise(segments_of(record, one.sides))
        return parting(one, other, record, noise, limits.torque, limits.travel)


def tied(summary: Mapping[str, Any]) -> tuple[str, str] | None:
    """The last finding that has an alternative, and that; None where nothing is tied."""
    findings = summary["findings"]
    if not findings or "rival" not in summary or not findings[-1]["alternatives"]:
        return None
    return findings[-1]["effect"], summary["rival"]["effect"]


def write_next_experiment(
    folder: Path, summary: Mapping[str, Any], record: Record, path: Path, limits: Limits = _LOGS
) -> list[str]:
    """Write the input as CSV with columns t (s) and u (N m). Returns lines for the terminal.

    Args:
        folder: results of the diagnosis.
        summary: its `diagnosis.json`.
        record: the log.
        path: the file to be written.
        limits: of the machine.

    Raises:
        InputError: the file cannot be written.
    """
    pair = tied(summary)
    if pair is None:
        return ["Nothing is tied: no experiment is needed to part effects, and none was written."]
    found = next_experiment(summary, read_config(folder / "model.toml"), record, limits)
    if found is None:
        return [f"No input stays within the torque and travel allowed that would part {pair[0]} from {pair[1]}."]
    time = record.sample_period * np.arange(len(found.torque))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        pd.DataFrame({"t": time, "u": found.torque}).to_csv(path, index=False, float_format="%.9g")
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
    clear = "" if found.apart > _CLEAR else ": too little; --max-torque and --max-travel allow for more"
    return [
        f"To part {pair[0]} from {pair[1]}: {found.kind} of {found.amplitude:.3g} N m, {found.frequency:.3g} Hz, "
        f"{time[-1] + record.sample_period:.3g} s; it would separate them by up to {found.apart:.2g} nats{clear}: {path}"
    ]
