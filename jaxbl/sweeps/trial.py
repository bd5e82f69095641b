"""One experiment with its whole trace: the function behind `jaxbl simulate` (`jaxbl.run` in Python)."""

from collections import OrderedDict
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from jaxbl.chain import Experiment, Reducer, Signals, State, TracedArrays, scan
from jaxbl.config import Config, ConfigSource, precision, prepare, read_config, with_values
from jaxbl.errors import InputError
from jaxbl.files import to_jsonable
from jaxbl.fused import Unsupported, raising_unsupported, warn_of_scan
from jaxbl.json_types import JsonObject
from jaxbl.observer.conditions import CONDITIONS, judge_gains
from jaxbl.records import POSITION_CHANNELS
from jaxbl.workers import check_cost

from .metrics import ALL_METRICS, add_gain_metrics, identified_parameters, observer_gains
from .programs import Backend
from .store import identity

_ROW_BYTES, _STEP_SECONDS = 600.0, 2e-7
"""Bytes that a row of the trace takes with its copies, and least seconds of a plant step."""


class Trial(NamedTuple):
    """A run of one experiment.

    Attributes:
        config: the study (its axes are not used).
        trace: one row a sample: `t`, `u`, `theta_e`, `theta_s` as in a measured log, true values and estimates by side, and
            identified parameters (columns and units: docs/api.md).
        summary: metrics, identified parameters, gain conditions and remarks, as in `summary.json`.
    """

    config: Config
    trace: pd.DataFrame
    summary: JsonObject


def run(study: ConfigSource, *, seed: int = 0, every: int = 1, backend: Backend | None = None) -> Trial:
    """Run the experiment of a study once, without its axes.

    Args:
        study: TOML file, mapping or config.
        seed: seed of the encoder noise.
        every: keep every N-th sample of the trace.
        backend: `scan` compiles for all values of the study's numbers, which is faster where many runs follow one another;
            `fused` is faster for one run; left out, `fused` where it can run the study.

    Raises:
        InputError: wrong config, or a study that `fused` cannot run.

    Example:
        >>> trial = jaxbl.run("study.toml", seed=1)
        >>> trial.summary["metrics"]["motor.velocity_rmse"]
    """
    config = read_config(study)
    if not 1 <= every <= config.run.steps:
        raise InputError(f"every: should be between 1 and the number of samples {config.run.steps}, not {every}")
    rows = config.run.steps // every
    check_cost(
        f"a trace of {rows} rows",
        _ROW_BYTES * rows,
        "--every N keeps fewer of them",
        _STEP_SECONDS * config.run.steps * config.run.substeps,
    )
    with precision(config):
        experiment = prepare(config)
        if backend == "scan":
            results, columns = _run_scan(experiment, seed, every)
        else:
            results, columns = _run_fused(experiment, seed, every, require_backend=backend == "fused")
        results = add_gain_metrics(results, observer_gains(experiment))
        trace = pd.DataFrame({name: np.asarray(column, float) for name, column in columns.items()})
    last = {name: to_jsonable(results.pop(name)) for name in list(results) if name.startswith("last.")}
    return Trial(config, trace, _summarise(config, last, to_jsonable(results), seed))


def run_perturbed(study: Config, seed: int, count: int) -> list[JsonObject]:
    """Run a study `count` times with gains λ and motor inertia changed in their last digits, and return the metrics.

    Their spread shows how far rounding changes the metrics: noise and a gap may amplify it.
    """
    experiment = study.build()
    numbers: JsonObject = {f"observer.{side}.lambda": gains.lambda_ for side, gains in observer_gains(experiment).items()}
    numbers["drive.motor_inertia"] = experiment.drive.inertia("motor")
    # eight units in the last place: the first product may lose one bit
    step = 8.0 * float(np.finfo(study.run.precision).eps)
    all_metrics = []
    for k in range(1, count + 1):
        changed = with_values(study, {path: float(number) * (1.0 + k * step) for path, number in numbers.items()})
        all_metrics.append(run(changed, seed=seed, backend="scan").summary["metrics"])
    return all_metrics


def _run_fused(experiment: Experiment, seed: int, stride: int, *, require_backend: bool) -> tuple[Any, Any]:
    """Run the fused loop; if it does not support the experiment, the scan, unless `require_backend`."""
    try:
        with raising_unsupported():
            from jaxbl.fused.single_run import record_run

            return record_run(experiment, seed, _REDUCERS, partial(_trace_row, experiment), stride)
    except Unsupported as reason:
        if require_backend:
            raise InputError(f"backend: the fused loop does not support {reason}; use 'scan', or leave it out") from None
        warn_of_scan(str(reason))
        return _run_scan(experiment, seed, stride)


@partial(jax.jit, static_argnums=2)
def _run_scan(experiment: Experiment, seed: Any, stride: int) -> tuple[TracedArrays, Any]:
    return scan(experiment, seed, _REDUCERS, partial(_trace_row, experiment), stride)


def _last_results(experiment: Experiment, largest: Any, state: State) -> TracedArrays:
    results = {"last.largest_torque": largest}
    for side, parameters in identified_parameters(experiment, state).items():
        results |= {f"last.{side}.{name}": parameter for name, parameter in parameters.items()}
    return results


# a reducer sees all samples, also those that the trace leaves out
_LAST_RESULTS = Reducer(
    lambda experiment: jnp.zeros_like(experiment.run.sample_period),
    lambda experiment, largest, index, signals: jnp.maximum(largest, jnp.abs(signals.torque)),
    _last_results,
)
_REDUCERS = ALL_METRICS, _LAST_RESULTS


def _trace_row(experiment: Experiment, state: State, signals: Signals) -> TracedArrays:
    """The trace's row of a sample, by column."""
    row = {"t": signals.time, "u": signals.input}
    row |= {POSITION_CHANNELS.get(side, f"theta_{side}"): signals.side(side).measured for side in experiment.sides}
    if signals.twist is not None:
        row["z"] = signals.twist
    row["torque"] = signals.torque
    if signals.target is not None:
        row["reference"] = signals.target.position
    for side in experiment.sides:
        s = signals.side(side)
        true = {f"{side}.{name}": getattr(s.true, name) for name in ("position", "velocity", "acceleration")}
        estimates = "position_estimate", "velocity_estimate", "equivalent_control", "torque_estimate"
        row |= true | {f"{side}.{name}": getattr(s, name) for name in estimates}
    parameters = identified_parameters(experiment, state)
    for side in experiment.sides:
        row |= {f"{side}.{name}": parameter for name, parameter in parameters.get(side, {}).items()}
    # a compiled program would return a plain dict with its names sorted
    return OrderedDict(row)


def _summarise(config: Config, last: JsonObject, metrics: JsonObject, seed: int) -> JsonObject:
    experiment = config.build()
    parameters: JsonObject = {}
    if experiment.transmission is not None:
        for name, true in experiment.transmission.truth().items():
            sides = {side: last[f"last.{side}.{name}"] for side in experiment.sides}
            parameters[name] = {"true": true, **sides}
    conditions = {}
    for side, gains in observer_gains(experiment).items():
        f_plus = metrics[f"{side}.f_plus"]
        if f_plus is not None:
            conditions[side] = judge_gains(float(gains.lambda_), float(gains.alpha), f_plus)
    return {
        "title": config.title,
        "single_run": identity(config, "simulate"),
        "seed": seed,
        "metrics": metrics,
        "identified": parameters,
        "conditions": conditions,
        "remarks": [*config.notes, *_remarks(experiment, last, metrics, conditions)],
    }


def _remarks(experiment: Experiment, last: JsonObject, metrics: JsonObject, conditions: JsonObject) -> list[str]:
    """Sentences about convergence, and about the gains beside the gain conditions; adds `torque_bound` to `conditions`."""
    if not metrics["finite"]:
        return ["The run diverged: its metrics are not finite. Check the units; more [run] substeps make it more stable."]
    remarks = []
    torque_name = "disturbance torques" if experiment.transmission is None else "transmitted torques |C|"
    largest = last["last.largest_torque"]
    for side, judgement in conditions.items():
        alpha, lambda_, f_plus = judgement["alpha"], judgement["lambda"], judgement["f_plus"]
        inertia = float(experiment.drive.inertia(side))
        limit = alpha * inertia / abs(float(experiment.drive.torque_gain(side)))
        verdict = "large enough" if largest < limit else "too small"
        remarks.append(
            f"{side}: alpha = {alpha:g} rad/s² is {verdict}: it allows {torque_name} up to {limit:.3g} N m, and the run "
            f"reached {largest:.3g} N m. The true bound along the run, which includes the observer's own velocity error, is "
            f"f⁺ = {f_plus:.3g} rad/s²; twice the largest acceleration would be "
            f"{metrics[f'{side}.f_plus_acceleration']:.3g} rad/s²."
        )
        if not judgement["alpha_exceeds_f_plus"]:
            remarks.append(f"{side}: alpha is below the true f⁺, so that no condition on lambda can hold.")
            # alpha may still exceed the bound that follows from the torque alone: the conditions on lambda at that bound
            torque_bound = largest * abs(float(experiment.drive.torque_gain(side))) / inertia
            if alpha > torque_bound:
                judgement["torque_bound"] = judge_gains(lambda_, alpha, torque_bound)
        for label, at_bound in (("the true f⁺", judgement), ("f⁺ = max |C| / J", judgement.get("torque_bound"))):
            if at_bound is None or at_bound["least_lambda"]["exact"] is None:
                continue
            unmet = [
                f"{CONDITIONS[name].title} needs more than {least:.4g}{_factor(least, lambda_)}"
                for name, least in at_bound["least_lambda"].items()
                if lambda_ <= least
            ]
            if unmet:
                remarks.append(f"{side}: lambda = {lambda_:g} is too small at {label}: {'; '.join(unmet)}.")
        if metrics[f"{side}.converged"] and not judgement["holds"]["exact"]:
            remarks.append(
                f"{side}: the observer converged nevertheless: the conditions assume the worst disturbance, which this run "
                "may not contain, and neglect viscous friction, which can make the error decay."
            )
    run = experiment.run
    for side in experiment.sides:
        if not metrics[f"{side}.converged"]:
            ratio = float(experiment.drive.ratio(side))
            remarks.append(
                f"{side}: the observer did not stay within {run.position_tolerance / ratio:.2g} rad and "
                f"{run.velocity_tolerance / ratio:.2g} rad/s over the last quarter of the run "
                "(run.position_tolerance, run.velocity_tolerance; on the load divided by the gear ratio)."
            )
    return remarks


def _factor(least: float, lambda_: float) -> str:
    """The factor by which lambda is too small, in words; empty for a lambda of zero."""
    return f", a factor of {least / lambda_:.4g}" if lambda_ > 0.0 else ""
