"""What an identification found, as in `identification.json`."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.config import Config
from jaxbl.drive.parameters import leaf_paths, set_leaves
from jaxbl.json_types import JsonObject
from jaxbl.records import Record
from jaxbl.simulate import Experiment

from .compilation import jit
from .free_parameters import FreeParameter, set_free_parameters
from .intervals import NORMAL, UNSEEN, Profile, Refusal, Spread, interval, spread
from .logs import LogTask, decimation
from .regression import Kinematics, MotionShare, errors, regress
from .search import Found, is_noise
from .segments import at_period, long_enough, reading_noise, segments_of, windows_of
from .trajectory import Fit, projected_residual


def torque_errors(record: Record, experiment: Experiment, parts: Sequence[Kinematics], factor: int) -> dict[str, JsonObject]:
    """How far a model misses the torques of a log after decimation, by equation, with units."""
    found = errors(experiment, parts, factor) if parts else {}
    return {name: one | {"unit": record.unit_of(name, "N m")} for name, one in found.items()}


def describe_position(record: Record, side: str, noise: float, **errors: float) -> JsonObject:
    """Errors of a side's predicted position, by key, beside the readings' noise, with the unit."""
    return errors | {"noise": noise, "unit": record.unit_of(f"{side}.position", "rad")}


def on_holdout(config: Config, record: Record, nominal: Experiment, fitted: Experiment, samples: int) -> JsonObject:
    """How well the numbers found serve another log, beside the nominal ones, in windows of `samples` where it is so long."""
    rebased = [at_period(one, record.sample_period) for one in (nominal, fitted)]
    rest = config.log.initial_state == "rest"
    segments = segments_of(record, nominal.sides, rest)
    noise = reading_noise(segments)
    longest = max(map(len, segments))
    windows, _ = windows_of(segments, nominal, min(samples, longest), rest)
    left = [jit(projected_residual)(one, windows)[0] for one in rebased]
    position = {}
    for i, side in enumerate(nominal.sides):
        before, after = (noise[side] * float(jnp.sqrt(jnp.mean(one[:, :, i] ** 2))) for one in left)
        position[side] = describe_position(record, side, noise[side], rms=after, nominal_rms=before)
    factor = decimation(config, record)
    parts = long_enough(segments, factor)
    before, torque = (torque_errors(record, one, parts, factor) for one in rebased)
    for name, one in torque.items():
        one["nominal_rms"], one["nominal_relative"] = before[name]["rms"], before[name]["relative"]
    return {
        "file": str(record.path.resolve()),
        "window": windows.torque.shape[1] * record.sample_period,
        "position": position,
        "torque": torque,
    }


def _derived(experiment: Experiment, found: Found) -> JsonObject:
    """What else the law's numbers say (half_gap beside dead_zone), with standard errors by the delta method."""
    if experiment.transmission is None:
        return {}

    def others(theta: jax.Array) -> JsonObject:
        at = set_free_parameters(experiment, found.free, theta)
        assert at.transmission is not None
        known = {path.rpartition(".")[2] for path in leaf_paths(at) if path.startswith("transmission.")}
        return {name: value for name, value in at.transmission.truth().items() if name not in known}

    values, slopes = others(found.fit.theta), jax.jacfwd(others)(found.fit.theta)
    derived = {}
    for name, value in values.items():
        error = float(jnp.sqrt(slopes[name] @ found.spread.covariance @ slopes[name]))
        reach = [float(value) - NORMAL * error, float(value) + NORMAL * error]
        derived[f"transmission.{name}"] = {"value": float(value), "standard_error": error, "interval": reach}
    return derived


def _parameters(record: Record, free: Sequence[FreeParameter], fit: Fit, width: Spread) -> dict[str, JsonObject]:
    """Values with standard errors and 95 % intervals, by path."""
    theta, deviation = np.asarray(fit.theta), np.sqrt(np.diag(width.covariance))
    return {
        parameter.path: {
            "value": float(parameter.value(theta[i])),
            "standard_error": float(parameter.slope(theta[i])) * deviation[i],
            "interval": interval(parameter, theta[i], deviation[i]),
            "unit": record.unit_of(parameter.path, parameter.unit),
            "nominal": parameter.nominal,
        }
        for i, parameter in enumerate(free)
    }


def by_regression(
    nominal: Experiment, free: Sequence[FreeParameter], parts: Sequence[Kinematics], factor: int, record: Record
) -> JsonObject:
    """Least squares on the equations of motion; numbers that they do not show are left out."""
    found = regress(nominal, free, parts, factor)
    information = np.einsum("wtsp,wtsq->pq", found.jacobian, found.jacobian)
    values, vectors = np.linalg.eigh(information)
    blind = values < 1.0 / UNSEEN**2
    seen = [i for i in range(len(free)) if not np.any(np.abs(vectors[i, blind]) > 0.1)]
    parameters = _parameters(record, free, found, spread(found))
    at = {path: jnp.asarray(one["value"]) for path, one in parameters.items()}
    return {
        "parameters": {free[i].path: parameters[free[i].path] for i in seen},
        "measured_transmitted_torque": record.transmitted is not None,
        "bandwidth": 0.5 / (factor * record.sample_period),
        "torque": torque_errors(record, set_leaves(nominal, at), parts, factor),
        "converged": found.converged,
    }


def by_trajectories(found: Found, record: Record) -> JsonObject:
    """How the trajectory fit went."""

    def by_path(values: Any) -> JsonObject:
        return dict(zip([one.path for one in found.free], values, strict=True))

    return {
        "kind": "prediction_error" if found.smoothness else "output_error",
        "window": found.samples * record.sample_period,
        "windows": len(found.firsts),
        "converged": found.fit.converged,
        "starts": len(found.starts),
        "starts_agreeing": sum(start["agrees"] for start in found.starts),
        "variance_over_noise": found.spread.variance,
        "inflation": by_path(found.spread.inflation),
        "smoothness": found.smoothness,
        "between_windows": {} if found.between is None else by_path(found.between),
    }


def summary_of(task: LogTask, fitted: Experiment, found: Found, profiles: Mapping[str, Profile]) -> JsonObject:
    """The summary but for `method`, `torque`, `gains` and `holdout`; profiles by path, if they were asked for."""
    noise = {side: float(one) for side, one in found.windows.noise.items()}
    record, width = task.record, found.spread.covariance
    deviation = np.sqrt(np.diag(width))
    # numbers that are not known have no correlation
    with np.errstate(invalid="ignore"):
        correlation = width / np.outer(deviation, deviation)
    parameters = _parameters(record, found.free, found.fit, found.spread)
    for path, one in profiles.items():
        parameters[path] |= {"profile_interval": one.interval, "profile": np.column_stack([one.values, one.deviance])}
    parameters |= _derived(fitted, found)
    residual = {
        side: describe_position(
            record, side, noise[side], rms=noise[side] * float(jnp.sqrt(jnp.mean(found.fit.residual[:, :, i] ** 2)))
        )
        for i, side in enumerate(side for side in fitted.sides if side in noise)
    }
    return {
        **task.heading,
        "parameters": parameters,
        "correlation": {
            "parameters": [one.path for one in found.free],
            "matrix": correlation,
        },
        "refused": [
            {"direction": one.direction, "why": _why(one), "relative_deviation": one.deviation} for one in found.refused
        ],
        "held": found.held,
        "condition": found.condition,
        "residual": residual,
        "steps": found.steps,
        "rejected": None if all(map(is_noise, residual.values())) else {"lacks": None},
        "notes": [*record.notes, *_step_note(found, fitted.run.substeps)],
    }


def _step_note(found: Found, study_steps: int) -> list[str]:
    """A sentence about plant steps that are finer than the study's."""
    if found.steps == study_steps:
        return []
    return [
        f"The fit has {found.steps} plant steps a sample: with {study_steps}, as in the study ([run]), numbers would be off "
        "by more than a tenth of their standard errors."
    ]


def mark_lacking(summary: JsonObject, lacking: MotionShare | None) -> None:
    """Mark a fit that left a torque that goes with the motion: no interval counts what a missing effect does to numbers."""
    if summary["rejected"] is None or lacking is None:
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


def _why(refusal: Refusal) -> str:
    names = list(refusal.direction)
    if len(names) == 1:
        text = f"this log hardly depends on {names[0]}"
    else:
        text = "this log depends hardly on these changing together, by the shares given"
    shown_by = dict.fromkeys(_SHOWN_BY[key] for path in names for key in _SHOWN_BY if path.endswith(key))
    helps = f"; what would help: {', or '.join(shown_by)}" if shown_by else ""
    size = f"{100.0 * refusal.deviation:.0f} %" if refusal.deviation < 100.0 else "anything"
    return f"{text}: it leaves {size} open (standard deviation){helps}"
