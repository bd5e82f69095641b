"""What a study needs besides a drive's numbers: encoders as measured, tolerances, a map of gains, `[tune]`."""

import math
from contextlib import suppress

from jaxbl.config import Config, read_config
from jaxbl.errors import InputError, NoResult
from jaxbl.json_types import JsonObject
from jaxbl.lines import doubts_among
from jaxbl.records import POSITION_CHANNELS, Record

from .expected_error import ExpectedError, expect_errors
from .pilot import Scenarios, run_pilot

TOLERANCE_FACTOR = 5.0
"""Accepted errors over the rms error to be expected: of normally distributed errors one in 2 million is larger. Three times
the rms, which one in 400 exceeds, no run of thousands of samples would keep."""


def propose_map(f_plus: float) -> JsonObject:
    """Propose `axes` and `figures`: a map of the motor observer's gains about f_plus (rad/s^2) and its root."""
    # from well below what convergence asks for to where the encoders' noise rules
    ranges = (("lambda", math.sqrt(f_plus), 100.0), ("alpha", f_plus, 200.0))
    axes = [
        {
            "path": f"observer.motor.{gain}",
            "start": _round(0.2 * unit),
            "stop": _round(largest * unit),
            "num": 32,
            "scale": "log",
        }
        for gain, unit, largest in ranges
    ]
    figure = {"kind": "heatmap", "x": "observer.motor.alpha", "y": "observer.motor.lambda", "value": "motor.velocity_rmse"}
    return {"axes": axes, "figures": [figure | {"overlays": ["davila_fridman", "seeber_horn", "exact"]}]}


def propose_tolerances(config: Config, expected: dict[str, ExpectedError]) -> dict[str, float]:
    """Propose the keys of `[run]` for the errors that are accepted: of the motor (rad/s, rad), and so that the load's, which
    are accepted divided by the gear ratio, suffice as well."""
    ratios = {side: config.drive.gear_ratio if side == "load" else 1.0 for side in expected}
    return {
        f"{name}_tolerance": _round(
            TOLERANCE_FACTOR * max(ratio * getattr(expected[side], f"largest_{name}") for side, ratio in ratios.items())
        )
        for name in ("velocity", "position")
    }


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
    # what puts the log in doubt puts all that follows from it in doubt
    notes = list(dict.fromkeys([*doubts_among(record.warnings), *data["notes"]]))
    data = data | {"notes": notes, "encoders": data["encoders"] | measure_encoders(record)}
    if written.tune is None:
        data["tune"] = {"objective": "velocity"}
    if "seeds" not in written.sweep.model_fields_set:
        data["sweep"]["seeds"] = 4  # what noise does shows only in several runs
    with suppress(InputError, NoResult):
        scenarios = Scenarios(read_config(data))
        pilot = run_pilot(scenarios)
        tolerances = propose_tolerances(scenarios.config, expect_errors(scenarios))
        data["run"] |= {key: value for key, value in tolerances.items() if key not in written.run.model_fields_set}
        if not written.axes and pilot["motor"]["f_plus"] > 0.0:
            data |= propose_map(pilot["motor"]["f_plus"])
    return data


def _round(value: float) -> float:
    return float(f"{value:.3g}")
