"""One experiment with its whole trace: the function behind `jaxbl simulate` (`jaxbl.run` in Python)."""

from collections import OrderedDict
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from jaxbl.config import Config, precision, prepare, read_config, with_values
from jaxbl.errors import InputError
from jaxbl.files import to_jsonable
from jaxbl.fused import Unsupported, raising_unsupported, warn_of_scan
from jaxbl.observer.conditions import CONDITIONS, judge_gains
from jaxbl.records import POSITION_CHANNELS
from jaxbl.simulate import Experiment, Reducer, Signals, State, scan

from .metrics import ALL_METRICS, add_gain_metrics, identified_parameters, observer_gains
from .programs import Backend
from .store import identity


class Trial(NamedTuple):
    """One run.

    Attributes:
        config: the study (its axes are not used).
        trace: one row a sample; `t`, `u`, `theta_e`, `theta_s` as a measured log has them, true values and estimates by
            side, path of the identified parameters (columns and units: README).
        summary: metrics, identified parameters, gain conditions and remarks, as in `summary.json`.
    """

    config: Config
    trace: pd.DataFrame
    summary: dict[str, Any]


def run(
    study: str | Path | Mapping[str, Any] | Config, *, seed: int = 0, every: int = 1, backend: Backend | None = None
) -> Trial:
    """Run the experiment of a study once, without its axes.

    Args:
        study: TOML file, mapping or config.
        seed: seed of the encoder noise.
        every: keep every N-th sample of the trace.
        backend: `scan` compiles for all values of the study's numbers, which is faster where many runs follow one another;
            `fused` is faster for one run; left out, `fused` where it can run the study.

    Raises:
        InputError: wrong config, or a study that `fused` cannot run.
    """
    config = read_config(study)
    if not 1 <= every <= config.run.steps:
        raise InputError(f"every: should be between 1 and the number of samples {config.run.steps}, not {every}")
    with precision(config):
        experiment = prepare(config)
        if backend == "scan":
            figures, kept = _scanned(experiment, seed, every)
        else:
            figures, kept = _recorded(experiment, seed, every, insist=backend == "fused")
        figures = add_gain_metrics(figures, observer_gains(experiment))
        trace = pd.DataFrame({name: np.asarray(column, float) for name, column in kept.items()})
    last = {name: to_jsonable(figures.pop(name)) for name in list(figures) if name.startswith("last.")}
    metrics = {name: to_jsonable(value) for name, value in figures.items()}
    return Trial(config, trace, _summary(config, last, metrics, seed))


def run_perturbed(study: Config, seed: int, count: int) -> list[dict[str, Any]]:
    """Metrics of runs whose gains λ and motor inertia differ from a study's in their last digits: how far figures come apart
    by rounding, which an observer may amplify under noise, and a plant with a gap."""
    experiment = study.build()
    numbers: dict[str, Any] = {f"observer.{side}.lambda": one.lambda_ for side, one in observer_gains(experiment).items()}
    numbers["drive.motor_inertia"] = experiment.drive.inertia("motor")
    # the last decimal that its precision has: one bit may be lost in the first product
    last = 8.0 * float(np.finfo(study.run.precision).eps)
    changes = ({path: float(value) * (1.0 + k * last) for path, value in numbers.items()} for k in range(1, count + 1))
    return [run(with_values(study, one), seed=seed, backend="scan").summary["metrics"] for one in changes]


def _recorded(experiment: Experiment, seed: int, every: int, *, insist: bool) -> tuple[dict[str, Any], Any]:
    """By the fused loop; if that cannot, by XLA's own, unless one insists."""
    try:
        with raising_unsupported():
            from jaxbl.fused.single_run import record_run

            return record_run(experiment, seed, _REDUCERS, partial(_row, experiment), every)
    except Unsupported as why:
        if insist:
            raise InputError(f"backend: the fused loop does not support {why}; use 'scan', or leave it out") from None
        warn_of_scan(str(why))
        return _scanned(experiment, seed, every)


@partial(jax.jit, static_argnums=2)
def _scanned(experiment: Experiment, seed: Any, every: int) -> tuple[dict[str, Any], Any]:
    return scan(experiment, seed, _REDUCERS, partial(_row, experiment), every)


def _last(experiment: Experiment, largest: Any, state: State) -> dict[str, Any]:
    figures = {"last.largest_torque": largest}
    for side, found in identified_parameters(experiment, state).items():
        figures |= {f"last.{side}.{name}": value for name, value in found.items()}
    return figures


# over all samples, whatever the trace keeps of them
_LAST = Reducer(
    lambda experiment: jnp.zeros_like(experiment.run.sample_period),
    lambda experiment, largest, index, signals: jnp.maximum(largest, jnp.abs(signals.torque)),
    _last,
)
_REDUCERS = ALL_METRICS, _LAST


def _row(experiment: Experiment, state: State, signals: Signals) -> dict[str, Any]:
    """Columns of the trace at one sample."""
    row = {"t": signals.time, "u": signals.input}
    row |= {POSITION_CHANNELS[side]: signals.side(side).measured for side in experiment.sides}
    if signals.twist is not None:
        row["z"] = signals.twist
    row["torque"] = signals.torque
    for side in experiment.sides:
        s = signals.side(side)
        true = {f"{side}.{name}": getattr(s.true, name) for name in ("position", "velocity", "acceleration")}
        estimates = "position_estimate", "velocity_estimate", "equivalent_control", "torque_estimate"
        row |= true | {f"{side}.{name}": getattr(s, name) for name in estimates}
    found = identified_parameters(experiment, state)
    for side in experiment.sides:
        row |= {f"{side}.{name}": value for name, value in found.get(side, {}).items()}
    # compiled programs sort the names of other dicts
    return OrderedDict(row)


def _summary(config: Config, last: dict[str, Any], metrics: dict[str, Any], seed: int) -> dict[str, Any]:
    experiment = config.build()
    parameters: dict[str, Any] = {}
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


def _remarks(experiment: Experiment, last: dict[str, Any], metrics: dict[str, Any], conditions: dict[str, Any]) -> list[str]:
    """What a reader of the figures should know, in sentences."""
    if not metrics["finite"]:
        return ["The run diverged: its figures are not finite. Look at units; more [run] substeps are more stable."]
    remarks = []
    what = "the disturbance torque" if experiment.transmission is None else "the transmitted torque |C|"
    largest = last["last.largest_torque"]
    for side, found in conditions.items():
        inertia = float(experiment.drive.inertia(side))
        limit = found["alpha"] * inertia / abs(float(experiment.drive.torque_gain(side)))
        verdict = "holds" if largest < limit else "fails"
        remarks.append(
            f"{side}: alpha = {found['alpha']:g} rad/s² covers {what} while it is below {limit:.3g} N m; "
            f"the largest here is {largest:.3g} N m, so that this {verdict}. The true bound along the run, with the "
            f"observer's own velocity error in it, is f⁺ = {found['f_plus']:.3g} rad/s²; twice the largest acceleration "
            f"would be {metrics[f'{side}.f_plus_acceleration']:.3g} rad/s²."
        )
        if not found["alpha_exceeds_f_plus"]:
            remarks.append(f"{side}: alpha is below the true f⁺, so that no condition on lambda can hold.")
            # what lambda would have to be where alpha does cover the torque
            torque_bound = largest * abs(float(experiment.drive.torque_gain(side))) / inertia
            if found["alpha"] > torque_bound:
                found["torque_bound"] = judge_gains(found["lambda"], found["alpha"], torque_bound)
        for label, values in (("the true f⁺", found), ("f⁺ = max |C| / J", found.get("torque_bound"))):
            if values is None or values["least_lambda"]["exact"] is None:
                continue
            missed = [
                f"{CONDITIONS[name].title}{_factor(least, found['lambda'])} (more than {least:.4g})"
                for name, least in values["least_lambda"].items()
                if found["lambda"] <= least
            ]
            if missed:
                remarks.append(f"{side}: lambda = {found['lambda']:g} misses, at {label}: {'; '.join(missed)}.")
        if metrics[f"{side}.converged"] and not found["holds"]["exact"]:
            remarks.append(
                f"{side}: the observer converged all the same: the conditions are for the worst disturbance, which this run "
                "need not contain, and they leave out viscous friction, which can shrink the error asymptotically."
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
    """By what factor lambda is too small; of zero there is none."""
    return f" by a factor of {least / lambda_:.4g}" if lambda_ > 0.0 else ""
