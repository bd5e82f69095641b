"""What an identification found, as in `identification.json`."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.chain import Experiment
from jaxbl.config import Config
from jaxbl.drive.parameters import leaf_paths
from jaxbl.json_types import JsonObject
from jaxbl.quantity import Quantity
from jaxbl.records import Record
from jaxbl.records.least_squares import rms

from .free_parameters import set_free_parameters
from .intervals import NORMAL, Profile, interval
from .logs import LogTask, decimation
from .regression import Kinematics, MotionShare, decimate_balances
from .search import SearchFit, is_noise
from .segments import at_period, long_enough, segments_of, windows_of
from .trajectory import eliminate_starts


def torque_errors(record: Record, experiment: Experiment, parts: Sequence[Kinematics], factor: int) -> dict[str, JsonObject]:
    """Measure how far a model misses the torques of a log after decimation, rms and relative to the driving torque."""
    figures = {}
    for name, equation in decimate_balances(experiment, parts, factor).items():
        left, drive = (rms(np.asarray(torque)) for torque in equation)
        relative = left / drive if drive > 0.0 else float("nan")
        figures[name] = {"rms": left, "relative": relative, "unit": record.unit_of(name, "N m")}
    return figures


def describe_position(record: Record, side: str, noise: float, **errors: float) -> JsonObject:
    """Errors of a side's predicted position, by key, beside the readings' noise, with the unit."""
    return errors | {"noise": noise, "unit": record.unit_of(f"{side}.position", "rad")}


def on_holdout(config: Config, record: Record, nominal: Experiment, fitted: Experiment, samples: int) -> JsonObject:
    """Test the fitted numbers on another log beside the nominal ones, in windows of `samples` where it is so long."""
    rebased = [at_period(model, record.sample_period) for model in (nominal, fitted)]
    at_rest = config.log.initial_state == "rest"
    segments = segments_of(record, nominal.sides, at_rest)
    windows = windows_of(segments, nominal, min(samples, max(map(len, segments))), at_rest)
    left = [eliminate_starts(model, windows).residual for model in rebased]
    position = {}
    for i, side in enumerate(nominal.sides):
        noise = windows.noise[side]
        before, after = (noise * rms(residual[:, :, i]) for residual in left)
        position[side] = describe_position(record, side, noise, rms=after, nominal_rms=before)
    factor = decimation(config, record)
    parts = long_enough(segments, factor)
    before, torque = (torque_errors(record, model, parts, factor) for model in rebased)
    for name, figures in torque.items():
        figures |= {f"nominal_{key}": before[name][key] for key in ("rms", "relative")}
    return {
        "file": str(record.path.resolve()),
        "window": windows.torque.shape[1] * record.sample_period,
        "position": position,
        "torque": torque,
    }


def _derive_numbers(experiment: Experiment, search_fit: SearchFit) -> JsonObject:
    """Derive further numbers of the law (half_gap beside dead_zone), with standard errors by the delta method."""
    if experiment.transmission is None:
        return {}

    paths = leaf_paths(experiment)

    def compute_others(theta: jax.Array) -> JsonObject:
        law: Any = set_free_parameters(experiment, search_fit.free, theta).transmission
        return {name: value for name, value in law.truth().items() if f"transmission.{name}" not in paths}

    values, slopes = (of(jnp.asarray(search_fit.fit.theta)) for of in (compute_others, jax.jacfwd(compute_others)))
    derived = {}
    for name, value in values.items():
        number, error = float(value), float(jnp.sqrt(slopes[name] @ search_fit.spread.covariance @ slopes[name]))
        reach = number - NORMAL * error, number + NORMAL * error
        derived[f"transmission.{name}"] = Quantity(number, error, reach).to_dict()
    return derived


def _parameters(record: Record, search_fit: SearchFit, profiles: Mapping[str, Profile]) -> JsonObject:
    """Values with standard errors and 95 % intervals, and their profiles if they were asked for, by path."""
    entries, fitted = {}, zip(search_fit.free, search_fit.fit.theta, search_fit.spread.deviations, strict=True)
    for parameter, theta, error in fitted:
        value, deviation = float(parameter.value(theta)), float(parameter.slope(theta)) * error
        unit, reach = record.unit_of(parameter.path, parameter.unit), interval(parameter, theta, error)
        entries[parameter.path] = Quantity(value, deviation, reach, unit, parameter.nominal).to_dict()
    for path, profile in profiles.items():
        entries[path]["profile_interval"] = profile.interval
        entries[path]["profile"] = np.column_stack([profile.values, profile.deviance])
    return entries


def _by_trajectories(search_fit: SearchFit, record: Record) -> JsonObject:
    """Describe how the trajectory fit went."""

    def by_path(values: Any) -> JsonObject:
        return dict(zip([parameter.path for parameter in search_fit.free], values, strict=True))

    return {
        "kind": "prediction_error" if search_fit.smoothness else "output_error",
        "window": search_fit.samples * record.sample_period,
        "windows": len(search_fit.windows.rows),
        "converged": search_fit.fit.converged,
        "starts": len(search_fit.starts),
        "starts_agreeing": sum(search_fit.starts),
        "variance_over_noise": search_fit.spread.variance,
        "inflation": by_path(search_fit.spread.inflation),
        "smoothness": search_fit.smoothness,
        "between_windows": {} if search_fit.between is None else by_path(search_fit.between),
    }


def summary_of(
    task: LogTask,
    fitted: Experiment,
    search_fit: SearchFit,
    profiles: Mapping[str, Profile] = {},
    recursive: Mapping[str, Any] = {},
) -> JsonObject:
    """The summary but for `torque`, `gains` and `holdout`; profiles by path, if they were asked for, and what the recursive
    identifier ends with."""
    record, noise, spread = task.record, search_fit.windows.noise, search_fit.spread
    # numbers that are not known have no correlation
    with np.errstate(invalid="ignore"):
        correlation = spread.covariance / np.outer(spread.deviations, spread.deviations)
    finer = (
        f"The fit has {search_fit.steps} plant steps a sample: with {fitted.run.substeps}, as in the study ([run]), numbers "
        "would be off by more than a tenth of their standard errors."
    )
    residual = {
        side: describe_position(record, side, noise[side], rms=noise[side] * rms(search_fit.fit.residual[:, :, i]))
        for i, side in enumerate(side for side in fitted.sides if side in noise)
    }
    return {
        **task.heading,
        "parameters": _parameters(record, search_fit, profiles) | _derive_numbers(fitted, search_fit),
        "correlation": {"parameters": [parameter.path for parameter in search_fit.free], "matrix": correlation},
        "refused": [
            {
                "direction": direction,
                "why": reason or _explain_refusal(direction, deviation),
                "relative_deviation": deviation,
            }
            for direction, deviation, reason in search_fit.refused
        ],
        "held": search_fit.held,
        "condition": search_fit.condition,
        "residual": residual,
        "steps": search_fit.steps,
        "method": {"recursive": recursive, "trajectory": _by_trajectories(search_fit, record)},
        "rejected": None if all(map(is_noise, residual.values())) else {"lacks": None},
        "notes": [*record.notes, *([finer] if search_fit.steps != fitted.run.substeps else [])],
    }


def mark_lacking(summary: JsonObject, lacking: MotionShare | None) -> None:
    """Mark a rejected fit, if it left a torque that goes with the motion: no interval counts what a missing effect does to
    numbers."""
    if lacking is None:
        return
    summary["rejected"] = {"lacks": lacking._asdict()}
    for parameter in summary["parameters"].values():
        parameter["interval"] = [None, None]
        parameter.pop("profile_interval", None)


_SHOWN_BY = {
    "inertia": "faster changes of torque",
    "viscous": "a wider range of speeds",
    "stiffness": "larger torques through the gear, near its resonance",
    "half_gap": "reversals that cross the gap",
    "dead_zone": "reversals that cross the gap",
    "slope": "slow passages through the gap",
    "torque": "slow motion with reversals",
    "relative": "a load or an inertia that is known",
}
"""End of a number's path -> what motion, or what else, would show it."""


def _explain_refusal(direction: dict[str, float], deviation: float) -> str:
    names = list(direction)
    text = f"this log hardly depends on {names[0]}"
    if len(names) > 1:
        text = "this log depends hardly on these changing together, by the shares given"
    shown_by = dict.fromkeys(_SHOWN_BY[key] for path in names for key in _SHOWN_BY if path.endswith(key))
    helps = f"; what would help: {', or '.join(shown_by)}" if shown_by else ""
    size = f"{100.0 * deviation:.0f} %" if deviation < 100.0 else "anything"
    return f"{text}: it leaves {size} open (standard deviation){helps}"
