"""Parameters of a machine from its log: the function behind `jaxbl identify`.

A trajectory fit with intervals, and beside it what else a log allows: the equations of motion at smoothed kinematics (and
the measured transmitted torque, if there is one), and the paper's chain, the study's observers run on the recorded positions
with the recursive identifier (27)-(28) on their equivalent control.
"""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from jaxbl.config import Config, read_model, with_values
from jaxbl.drive.parameters import leaf_paths, set_leaves
from jaxbl.files import plain
from jaxbl.identification.intervals import LIMIT, Refusal, Spread, interval, spread
from jaxbl.identification.profile import Profile, profile
from jaxbl.identification.regression import Kinematics, errors, from_smoothed, model_torques, regress
from jaxbl.identification.search import Channels, Found, Search, Settings, smoothed_channels, windows_of
from jaxbl.identification.trajectory import Fit, Free, free_parameters, projected_residual
from jaxbl.records import POSITION_CHANNELS, Record
from jaxbl.simulate import Experiment, Signals, State, replay
from jaxbl.workers import Progress

from .logs import (
    Logs,
    arrays,
    decimation,
    default_paths,
    gains_for,
    identity_of,
    kinematics_of,
    on_record,
    read_logs,
    unit_on,
)


@dataclasses.dataclass(frozen=True)
class Identification:
    """What a log says of a machine.

    Attributes:
        config: the study, with its nominal numbers.
        model: the study with the numbers found.
        record: the log, or the logs one after the other.
        summary: as in `identification.json`.
        trace: one row a sample: `t`, `u`, positions, `transmitted` where it was measured, smoothed velocities and
            accelerations with standard deviations, residuals of the fit (rad), torques by the fitted model at the smoothed
            motion (`torque` of the law, `motor.effects`, `load.effects`), and what the observers and the recursive
            identifier make of the record.
        replays: whether the model's excitation is to be the log's, for want of one in the study.
    """

    config: Config
    model: Config
    record: Record
    summary: dict[str, Any]
    trace: pd.DataFrame
    replays: bool


@dataclasses.dataclass(frozen=True)
class Task:
    """A study, its log, and what is asked of them: everything that decides the result.

    Attributes:
        config: the study.
        missing: tables that the study does not have (`excitation`, `observer.motor`, `observer.load`).
        record: the log.
        holdout: another log, on which the numbers are tried out; or None.
    """

    config: Config
    missing: frozenset[str]
    record: Record
    holdout: Record | None

    @property
    def identity(self) -> str:
        """Hash of everything that decides the result."""
        return identity_of(self.config, self.missing, self.record, self.holdout)


def read_task(
    log: Logs,
    model: str | Path | Mapping[str, Any] | Config,
    *,
    parameters: Sequence[str] | None = None,
    holdout: Logs | None = None,
    profile: bool | None = None,
) -> Task:
    """Read study and logs; arguments as of :func:`identify`.

    Raises:
        InputError: unfit log or study.
    """
    config, missing = read_model(model)
    asked = {"parameters": None if parameters is None else list(parameters), "profile": profile}
    given = {key: value for key, value in asked.items() if value is not None}
    config = config.model_copy(update={"identify": config.identify.model_copy(update=given)})
    return Task(config, missing, read_logs(config, log), None if holdout is None else read_logs(config, holdout))


def identify(
    log: Logs,
    model: str | Path | Mapping[str, Any] | Config,
    *,
    parameters: Sequence[str] | None = None,
    holdout: Logs | None = None,
    profile: bool | None = None,
) -> Identification:
    """Identify a machine from its log.

    Args:
        log: the file, read as the study's `[log]` table says, or a record; or several of them, of one machine.
        model: study with nominal numbers: TOML file, mapping or config. `[excitation]` and `[observer]` may be missing: the
            input is the log's, and gains are chosen on it.
        parameters: dotted paths of the numbers to find, in place of `[identify] parameters`.
        holdout: another log (or several) of the machine, on which the model found is tried out.
        profile: whether to compute profile-likelihood intervals, in place of `[identify] profile`.

    Raises:
        InputError: unfit log or study, or a number that cannot be fitted.
    """
    return run_task(read_task(log, model, parameters=parameters, holdout=holdout, profile=profile))


_STAGES = 6


def run_task(task: Task, progress: Progress | None = None) -> Identification:
    """Do what :func:`read_task` read.

    Args:
        task: what to do.
        progress: called with finished and total stages after each.

    Raises:
        InputError: a number that cannot be fitted, or a log that the model cannot follow.
    """
    config, record, settings = task.config, task.record, task.config.identify
    assert record.torque is not None
    stages = iter(range(1, _STAGES + 1))

    def done() -> None:
        stage = next(stages)
        if progress is not None:
            progress(stage, _STAGES)

    with jax.enable_x64(True):
        nominal = on_record(config, record)
        paths = list(settings.parameters or default_paths(config, nominal))
        free = free_parameters(nominal, paths, float(np.std(record.torque)))
        channels = smoothed_channels(record, nominal.sides)
        done()
        rest = config.log.initial_state == "rest"
        how = Settings(settings.method, settings.window, settings.starts, settings.spread, settings.seed, rest)
        found = Search(nominal, record, channels, how).run(free)
        done()
        values = {one.path: float(one.value(found.fit.theta[i])) for i, one in enumerate(found.free)}
        fitted = set_leaves(nominal, {path: jnp.asarray(value) for path, value in values.items()})
        profiles = {}
        if settings.profile:
            profiles = profile(nominal, found.free, found.windows, found.fit, found.spread)
        done()
        factor = decimation(config, record)
        parts = kinematics_of(record, channels, factor)
        gains, gain_values = gains_for(task.missing, fitted, record, channels)
        chain, recursive = _chain(set_leaves(fitted, arrays(gain_values)), record)
        done()
        noise = {side: float(one) for side, one in found.windows.noise.items()}
        trace = pd.DataFrame(
            {"t": record.time, "u": record.torque}
            | {POSITION_CHANNELS[side]: record.positions[side] for side in nominal.sides}
            | ({} if record.transmitted is None else {"transmitted": record.transmitted})
            | _smoothed_columns(channels)
            | _residual_columns(found, record, noise, nominal.sides)
            | _model_columns(fitted, record, channels)
            | chain
        )
        method: dict[str, Any] = {"recursive": recursive, "trajectory": _trajectory(found, record)}
        if parts:
            method["regression"] = _regression(nominal, found.free, parts, factor, record)
        done()
        summary = _summary(task, fitted, found, profiles, noise) | {"method": method}
        summary["torque"] = _torque_errors(record, fitted, parts, factor)
        if gains:
            summary["gains"] = {side: one._asdict() for side, one in gains.items()}
        if task.holdout is not None:
            summary["holdout"] = _on_holdout(task, nominal, fitted, found.samples)
        done()
    model = with_values(config, values | gain_values)
    return Identification(config, model, record, plain(summary), trace, "excitation" in task.missing)


def _torque_errors(
    record: Record, experiment: Experiment, parts: Sequence[Kinematics], factor: int
) -> dict[str, dict[str, Any]]:
    found = errors(experiment, parts, factor) if parts else {}
    return {name: one | {"unit": unit_on(record, name, "N m")} for name, one in found.items()}


def _model_columns(fitted: Experiment, record: Record, channels: Channels) -> dict[str, np.ndarray]:
    """Torques by the fitted model at the smoothed motion, N m: the law's, and what effects take on each side."""
    assert record.torque is not None
    pieces: dict[str, list[np.ndarray]] = {}
    for i, part in enumerate(record.segments):
        smoothed = {side: parts[i] for side, parts in channels.smoothed.items()}
        kinematics = from_smoothed(record.time[part] - record.time[0], record.torque[part], smoothed)
        found = model_torques(fitted, kinematics, {side: one.deviation(1) for side, one in smoothed.items()})
        for name, values in found.items():
            pieces.setdefault("torque" if name == "transmission" else f"{name}.effects", []).append(np.asarray(values))
    return {name: np.concatenate(values) for name, values in pieces.items()}


def _on_holdout(task: Task, nominal: Experiment, fitted: Experiment, samples: int) -> dict[str, Any]:
    """How well the numbers found serve another log, beside the nominal ones."""
    config, record = task.config, task.holdout
    assert record is not None
    period = jnp.asarray(record.sample_period)
    rebased = [eqx.tree_at(lambda e: e.run.sample_period, one, period) for one in (nominal, fitted)]
    channels = smoothed_channels(record, nominal.sides)
    longest = max(part.stop - part.start for part in record.segments)
    windows, _ = windows_of(record, channels, nominal, min(samples, longest), config.log.initial_state == "rest")
    left = [eqx.filter_jit(projected_residual)(one, windows)[0] for one in rebased]
    position = {}
    for i, side in enumerate(nominal.sides):
        before, after = (channels.noise[side] * float(jnp.sqrt(jnp.mean(one[:, :, i] ** 2))) for one in left)
        unit = record.findings.channels[POSITION_CHANNELS[side]].unit
        position[side] = {"rms": after, "nominal_rms": before, "noise": channels.noise[side], "unit": unit}
    factor = decimation(config, record)
    parts = kinematics_of(record, channels, factor)
    before, torque = (_torque_errors(record, one, parts, factor) for one in rebased)
    for name, one in torque.items():
        one["nominal_rms"], one["nominal_relative"] = before[name]["rms"], before[name]["relative"]
    return {
        "file": str(record.path.resolve()),
        "window": windows.torque.shape[1] * record.sample_period,
        "position": position,
        "torque": torque,
    }


def _smoothed_columns(channels: Channels) -> dict[str, np.ndarray]:
    columns = {}
    for side, parts in channels.smoothed.items():
        for order, name in ((1, "velocity"), (2, "acceleration")):
            columns[f"{side}.{name}"] = np.concatenate([np.asarray(one.state[:, order]) for one in parts])
            columns[f"{side}.{name}_deviation"] = np.concatenate([np.asarray(one.deviation(order)) for one in parts])
    return columns


def _residual_columns(
    found: Found, record: Record, noise: dict[str, float], sides: tuple[str, ...]
) -> dict[str, np.ndarray]:
    columns = {}
    rows = (found.firsts[:, None] + np.arange(found.samples)[None, :]).ravel()
    for i, side in enumerate(sides):
        column = np.full(len(record.time), np.nan)
        column[rows] = noise[side] * np.asarray(found.fit.residual[:, :, i]).ravel()
        columns[f"{side}.residual"] = column
    return columns


@eqx.filter_jit
def _replayed(experiment: Experiment, torque: jax.Array, measured: dict[str, jax.Array]) -> dict[str, jax.Array]:
    def keep(state: State, signals: Signals) -> dict[str, Any]:
        row: dict[str, Any] = {}
        if signals.twist is not None:
            row["twist"] = signals.twist
        for side in experiment.sides:
            row[f"{side}.velocity_estimate"] = signals.side(side).velocity_estimate
            row[f"{side}.torque_estimate"] = signals.side(side).torque_estimate
        if state.identifier is not None:
            assert experiment.identifier is not None and experiment.transmission is not None
            path = experiment.identifier.estimate(state.identifier, experiment.transmission)
            row |= {f"{side}.{name}": value for side, values in path.items() for name, value in values.items()}
        return row

    return replay(experiment, torque, measured, record=keep)[1]


def _chain(experiment: Experiment, record: Record) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The paper's chain on the record's longest part: columns over time (NaN elsewhere), and what it finds at the end."""
    part = max(record.segments, key=lambda one: one.stop - one.start)
    assert record.torque is not None
    given = jnp.asarray(record.torque[part]), {side: jnp.asarray(record.positions[side][part]) for side in experiment.sides}
    kept = _replayed(experiment, *given)
    estimates = ("velocity_estimate", "torque_estimate")
    leading = ["twist", *(f"{side}.{name}" for side in experiment.sides for name in estimates)]
    columns = {}
    for name in [*(name for name in leading if name in kept), *(name for name in kept if name not in leading)]:
        columns[name] = np.full(len(record.time), np.nan)
        columns[name][part] = np.asarray(kept[name])
    found: dict[str, Any] = {}
    if experiment.transmission is not None:
        for name in experiment.transmission.truth():
            found[name] = {side: float(columns[f"{side}.{name}"][part][-1]) for side in experiment.sides}
    return columns, found


def _derived(experiment: Experiment, found: Found) -> dict[str, Any]:
    """What else the law's numbers say (half_gap beside dead_zone), with standard errors by the delta method."""
    if experiment.transmission is None:
        return {}

    def others(theta: jax.Array) -> dict[str, Any]:
        at = set_leaves(experiment, {one.path: one.value(theta[i]) for i, one in enumerate(found.free)})
        assert at.transmission is not None
        known = {path.rpartition(".")[2] for path in leaf_paths(at) if path.startswith("transmission.")}
        return {name: value for name, value in at.transmission.truth().items() if name not in known}

    values, slopes = others(found.fit.theta), jax.jacfwd(others)(found.fit.theta)
    derived = {}
    for name, value in values.items():
        error = float(jnp.sqrt(slopes[name] @ found.spread.covariance @ slopes[name]))
        derived[f"transmission.{name}"] = {
            "value": float(value), "standard_error": error,
            "interval": [float(value) - 1.96 * error, float(value) + 1.96 * error],
        }  # fmt: skip
    return derived


def _parameters(record: Record, free: Sequence[Free], fit: Fit, width: Spread) -> dict[str, dict[str, Any]]:
    """Values with standard errors and 95 % intervals, by path."""
    theta, deviation = np.asarray(fit.theta), np.sqrt(np.diag(np.asarray(width.covariance)))
    return {
        one.path: {
            "value": float(one.value(theta[i])),
            "standard_error": float(one.slope(theta[i])) * deviation[i],
            "interval": list(interval(one, theta[i], deviation[i])),
            "unit": unit_on(record, one.path, one.unit),
            "nominal": one.nominal,
        }
        for i, one in enumerate(free)
    }


def _regression(
    nominal: Experiment, free: Sequence[Free], parts: Sequence[Kinematics], factor: int, record: Record
) -> dict[str, Any]:
    """Least squares on the equations of motion; numbers that they do not show are left out."""
    found = regress(nominal, free, parts, factor)
    information = np.einsum("wtsp,wtsq->pq", found.jacobian, found.jacobian)
    values, vectors = np.linalg.eigh(information)
    blind = values < 1.0 / LIMIT**2
    seen = [i for i in range(len(free)) if not np.any(np.abs(vectors[i, blind]) > 0.1)]
    all_of_it = _parameters(record, free, found, spread(found))
    at = {free[i].path: jnp.asarray(all_of_it[free[i].path]["value"]) for i in range(len(free))}
    return {
        "parameters": {free[i].path: all_of_it[free[i].path] for i in seen},
        "measured_transmitted_torque": record.transmitted is not None,
        "bandwidth": 0.5 / (factor * record.sample_period),
        "torque": _torque_errors(record, set_leaves(nominal, at), parts, factor),
        "converged": found.converged,
    }


def _trajectory(found: Found, record: Record) -> dict[str, Any]:
    agreeing = sum(start["agrees"] for start in found.starts)
    return {
        "kind": "prediction_error" if found.smoothness else "output_error",
        "window": found.samples * record.sample_period,
        "windows": len(found.firsts),
        "converged": found.fit.converged,
        "starts": len(found.starts),
        "starts_agreeing": agreeing,
        "variance_over_noise": found.spread.variance,
        "inflation": dict(zip([one.path for one in found.free], found.spread.inflation, strict=True)),
        "smoothness": found.smoothness,
        "between_windows": {}
        if found.between is None
        else dict(zip([one.path for one in found.free], found.between, strict=True)),
    }


def _summary(
    task: Task, fitted: Experiment, found: Found, profiles: Mapping[str, Profile], noise: Mapping[str, float]
) -> dict[str, Any]:
    record, width = task.record, np.asarray(found.spread.covariance)
    deviation = np.sqrt(np.diag(width))
    parameters = _parameters(record, found.free, found.fit, found.spread)
    for path, one in profiles.items():
        points = [list(point) for point in zip(one.values.tolist(), one.deviance.tolist(), strict=True)]
        parameters[path] |= {"profile_interval": list(one.interval), "profile": points}
    parameters |= _derived(fitted, found)
    residual = {
        side: {
            "rms": noise[side] * float(jnp.sqrt(jnp.mean(found.fit.residual[:, :, i] ** 2))),
            "noise": noise[side],
            "unit": record.findings.channels[POSITION_CHANNELS[side]].unit,
        }
        for i, side in enumerate(fitted.sides)
    }
    return {
        "title": task.config.title,
        "identity": task.identity,
        "file": str(record.path.resolve()),
        "samples": len(record.time),
        "sample_period": record.sample_period,
        "parameters": parameters,
        "correlation": {
            "parameters": [one.path for one in found.free],
            "matrix": width / np.outer(deviation, deviation),
        },
        "refused": [
            {"direction": one.direction, "why": _why(one), "relative_deviation": one.deviation} for one in found.refused
        ],
        "held": found.held,
        "condition": found.condition,
        "residual": residual,
        "notes": list(record.notes),
    }


_HELP = {
    "inertia": "faster changes of torque",
    "viscous": "a wider range of speeds",
    "stiffness": "larger torques through the gear, near its resonance",
    "half_gap": "reversals that cross the gap",
    "dead_zone": "reversals that cross the gap",
    "slope": "slow passages through the gap",
    "torque": "slow motion with reversals",
    "relative": "a load or an inertia that is known",
}


def _why(refusal: Refusal) -> str:
    names = list(refusal.direction)
    if len(names) == 1:
        text = f"this log hardly depends on {names[0]}"
    else:
        text = "this log depends hardly on these changing together, by the shares given"
    keys = dict.fromkeys(_HELP[key] for path in names for key in _HELP if path.endswith(key))
    helps = f"; what would help: {', or '.join(keys)}" if keys else ""
    size = f"{100.0 * refusal.deviation:.0f} %" if refusal.deviation < 100.0 else "anything"
    return f"{text}: it leaves {size} open (standard deviation){helps}"
