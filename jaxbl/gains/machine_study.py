"""What a study needs besides a drive's numbers: encoders as measured, tolerances, a map of gains, `[tune]`."""

import math
from contextlib import suppress

from jaxbl.config import Config, TuneTable, read_config
from jaxbl.errors import InputError, NoResult
from jaxbl.json_types import JsonObject
from jaxbl.records import POSITION_CHANNELS, Record

from .expected_error import expect_errors
from .pilot import Scenarios, run_pilot

TOLERANCE_FACTOR = 5.0
"""Accepted errors over the rms error to be expected: of normally distributed errors one in 2 million is larger. Three times
the rms, which one in 400 exceeds, no run of thousands of samples would keep."""


def propose_map(f_plus: float) -> JsonObject:
    """Propose `axes` and `figures`: a map of the motor observer's gains about f_plus (rad/s^2) and its root."""
    ranges = (("lambda", math.sqrt(f_plus), (0.3, 50.0)), ("alpha", f_plus, (0.5, 100.0)))
    axes = [
        {"path": f"observer.motor.{gain}"}
        | {name: _round(end * scale) for name, end in zip(("start", "stop"), ends, strict=True)}
        | {"num": 32, "scale": "log"}
        for gain, scale, ends in ranges
    ]
    figure = {"kind": "heatmap", "x": "observer.motor.alpha", "y": "observer.motor.lambda", "value": "motor.velocity_rmse"}
    return {"axes": axes, "figures": [figure | {"overlays": ["davila_fridman", "seeber_horn", "exact"]}]}


def measure_encoders(record: Record) -> JsonObject:
    """Return `[encoders]` as a record shows them: counts, and the noise (rms) that its counts do not explain."""
    encoders: JsonObject = {}
    for side, noise_key in (("motor", "noise"), ("load", "load_noise")):
        if side in record.positions:
            channel = record.statistics.channels[POSITION_CHANNELS[side]]
            # rounding to counts q adds q²/12 to the square of the noise
            encoders[noise_key] = _round(math.sqrt(max(channel.noise**2 - channel.resolution**2 / 12.0, 0.0)))
            encoders[f"{side}_resolution"] = float(f"{channel.resolution:.6g}")
    return encoders


def complete_study(data: JsonObject, record: Record, written: Config) -> JsonObject:
    """Complete the study of a machine: encoders as the record shows them, tolerances, a map, `[tune]`.

    Args:
        data: the study with the numbers that were found.
        record: the log of the machine.
        written: the study as it was given; what it sets stays, but for the encoders.

    Returns:
        The study. Its map and tolerances are left out if it does not run, as where no torque disturbs the observers.
    """
    data = data | {"encoders": data["encoders"] | measure_encoders(record)}
    if written.tune is None:
        data["tune"] = {"objective": "velocity"}
    if "seeds" not in written.sweep.model_fields_set:
        data["sweep"]["seeds"] = 4  # what noise does shows only in several runs
    with suppress(InputError, NoResult):
        config = read_config(data)
        pilot = run_pilot(Scenarios(config, ["nominal"], {}), TuneTable())
        expected = expect_errors(config, list(pilot))["motor"]
        for name, error in (("velocity", expected.velocity), ("position", expected.position)):
            if f"{name}_tolerance" not in written.run.model_fields_set:
                data["run"][f"{name}_tolerance"] = _round(TOLERANCE_FACTOR * error)
        if not written.axes and pilot["motor"]["f_plus"] > 0.0:
            data |= propose_map(pilot["motor"]["f_plus"])
    return data


def _round(value: float) -> float:
    return float(f"{value:.3g}")
