"""Figures of a run, computed in the loop over time: observation errors, convergence, gain margins, identification.

RMS figures are over the last quarter of the run, in SI units. Position and velocity tolerances of the load are those of
the motor divided by the gear ratio.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbl.errors import InputError
from jaxbl.observer import conditions
from jaxbl.simulate import Experiment, Reducer, Signals, State

from .pieces import in_pieces

Number = Float[Array, ""]


class Metric(NamedTuple):
    """What a column holds: unit, short name for axis labels, meaning."""

    unit: str
    label: str
    doc: str


SIDE_METRICS: dict[str, Metric] = {
    "converged": Metric("", "converged", "position and velocity errors stay within tolerance over the last quarter"),
    "convergence_time": Metric(
        "s", "convergence time", "time from which both errors stay within tolerance; NaN where not converged"
    ),
    "convergence_time_bound": Metric(
        "s", "bound on convergence time", "bound (42) on it for the noise-free observer; inf where (32) fails"
    ),
    "convergence_time_worst": Metric(
        "s", "worst convergence time", "longest convergence time that a disturbance within f_plus can cause; inf where ρ ≥ 1"
    ),
    "position_rmse": Metric("rad", "position error, rms", "rms position error"),
    "velocity_rmse": Metric("rad/s", "velocity error, rms", "rms velocity error"),
    "torque_rmse": Metric(
        "N m", "torque error, rms", "rms error of the transmitted torque from this side's equivalent control"
    ),
    "position_size": Metric("rad", "position, rms", "rms true position: the size that its errors compare with"),
    "velocity_size": Metric("rad/s", "velocity, rms", "rms true velocity: the size that its errors compare with"),
    "chatter": Metric(
        "rad/s", "chatter of the velocity", "rms sample-to-sample change of the velocity error, divided by √2"
    ),
    "f_plus": Metric("rad/s²", "true bound f⁺", "largest true right-hand side error |f(x₂) − f(x̂₂) + ξ| along the run"),
    "f_plus_acceleration": Metric(
        "rad/s²", "twice the largest acceleration", "twice the largest acceleration: the paper's text for f⁺"
    ),
    "margin_alpha": Metric("", "α / f⁺", "gain alpha over the true bound f_plus"),
    **{
        f"margin_{name}": Metric("", f"margin to {condition.title}", f"λ over the least λ of {condition.title}")
        for name, condition in conditions.CONDITIONS.items()
    },
    "stiffness_error": Metric("", "error of K", "relative error of the identified stiffness"),
    "dead_zone_error": Metric(
        "", "error of the dead zone", "relative error of the identified dead zone (half gap of law dead_zone)"
    ),
    "excitation": Metric("", "excitation", "smallest eigenvalue of the normalised information matrix"),
}


class _Totals(NamedTuple):
    """Carry of one side."""

    last_outside: Number
    position: Number
    velocity: Number
    torque: Number
    true_position: Number
    true_velocity: Number
    change: Number
    previous: Number
    f_plus: Number
    acceleration: Number


def window_start(steps: int) -> int:
    """First sample of the last quarter."""
    return steps - max(steps // 4, 1)


def _init(experiment: Experiment) -> dict[str, _Totals]:
    zero = jnp.zeros_like(experiment.run.sample_period)
    return {side: _Totals(zero - 1.0, *[zero] * 9) for side in experiment.sides}


def _update(
    experiment: Experiment, totals: dict[str, _Totals], index: Int[Array, ""], signals: Signals
) -> dict[str, _Totals]:
    run = experiment.run
    inside = (index >= window_start(run.steps)).astype(signals.time.dtype)
    new = {}
    for side, old in totals.items():
        s = signals.side(side)
        true = s.true
        assert true is not None
        ratio = experiment.drive.ratio(side)
        position = true.position - s.position_estimate
        velocity = true.velocity - s.velocity_estimate
        torque = signals.torque - s.torque_estimate
        within = (jnp.abs(position) * ratio <= run.position_tolerance) & (
            jnp.abs(velocity) * ratio <= run.velocity_tolerance
        )
        change = velocity - old.previous
        new[side] = _Totals(
            jnp.where(within, old.last_outside, signals.time),
            old.position + inside * position * position,
            old.velocity + inside * velocity * velocity,
            old.torque + inside * torque * torque,
            old.true_position + inside * true.position * true.position,
            old.true_velocity + inside * true.velocity * true.velocity,
            old.change + inside * change * change,
            velocity,
            jnp.maximum(old.f_plus, jnp.abs(true.perturbation)),
            jnp.maximum(old.acceleration, jnp.abs(true.acceleration)),
        )
    return new


def _result(experiment: Experiment, totals: dict[str, _Totals], state: State) -> dict[str, Array]:
    run = experiment.run
    count = run.steps - window_start(run.steps)
    start = window_start(run.steps) * run.sample_period
    identified = {}
    if state.identifier is not None:
        assert experiment.identifier is not None and experiment.transmission is not None
        identified = experiment.identifier.estimate(state.identifier, experiment.transmission)
    figures: dict[str, Array] = {}
    finite = jnp.asarray(True)
    for side, total in totals.items():
        converged = total.last_outside < start - 0.5 * run.sample_period
        entered = jnp.where(total.last_outside < 0.0, 0.0, total.last_outside + run.sample_period)
        out = {
            "converged": converged,
            "convergence_time": jnp.where(converged, entered, jnp.nan),
            "position_rmse": jnp.sqrt(total.position / count),
            "velocity_rmse": jnp.sqrt(total.velocity / count),
            "torque_rmse": jnp.sqrt(total.torque / count),
            "position_size": jnp.sqrt(total.true_position / count),
            "velocity_size": jnp.sqrt(total.true_velocity / count),
            "chatter": jnp.sqrt(0.5 * total.change / count),
            "f_plus": total.f_plus,
            "f_plus_acceleration": 2.0 * total.acceleration,
        }
        if state.identifier is not None:
            assert experiment.transmission is not None and experiment.identifier is not None
            truth, found = experiment.transmission.truth(), identified[side]
            out["stiffness_error"] = found["stiffness"] / truth["stiffness"] - 1.0
            if "half_gap" in truth:
                out["dead_zone_error"] = found["half_gap"] / truth["half_gap"] - 1.0
            out["excitation"] = experiment.identifier.excitation(state.identifier)
        # sums overflow with the lane: they tell whether it stayed finite
        ok = jnp.isfinite(total.position + total.velocity + total.torque + total.f_plus + total.acceleration)
        out = {name: jnp.where(ok, value, False if name == "converged" else jnp.nan) for name, value in out.items()}
        finite = finite & ok
        figures |= {f"{side}.{name}": value for name, value in out.items()}
    return {"finite": finite, **figures}


METRICS = Reducer(_init, _update, _result)
"""The metrics of every sweep."""


class Gains(NamedTuple):
    """What the gain conditions ask of an observer: its gains and its errors at t = 0."""

    lambda_: Array
    alpha: Array
    position_error: Array
    velocity_error: Array


def observer_gains(experiment: Experiment) -> dict[str, Gains]:
    """Gains of the experiment's observers by side."""
    observers = {side: getattr(experiment.observer, side) for side in experiment.sides}
    return {side: Gains(*(getattr(observer, name) for name in Gains._fields)) for side, observer in observers.items()}


def with_conditions(figures: Mapping[str, Any], gains: dict[str, Gains]) -> dict[str, np.ndarray]:
    """Figures together with those that follow from gains and f_plus alone: margins to conditions, convergence times.

    Apart from the loop over time, by programs that serve all studies.
    """
    found = {name: np.asarray(value) for name, value in figures.items()}
    f_plus = np.stack([found[f"{side}.f_plus"] for side in gains])
    columns = [
        np.stack([np.broadcast_to(np.asarray(x, f_plus.dtype), f_plus.shape[1:]) for x in given])
        for given in zip(*gains.values(), strict=True)
    ]
    judged = in_pieces(_judged, [one.ravel() for one in (*columns, f_plus)])
    for name, value in judged.items():
        found |= {f"{side}.{name}": one for side, one in zip(gains, value.reshape(f_plus.shape), strict=True)}
    return found


@jax.jit
def _judged(lambda_: Array, alpha: Array, position_error: Array, velocity_error: Array, f_plus: Array) -> dict[str, Array]:
    given, errors = (lambda_, alpha, f_plus), (position_error, velocity_error)
    out = {
        "convergence_time_bound": conditions.convergence_time_bound(*given, *errors),
        "convergence_time_worst": conditions.convergence_time_worst(*given, *errors),
        "margin_alpha": alpha / f_plus,
    }
    for name, condition in conditions.CONDITIONS.items():
        out[f"margin_{name}"] = lambda_ / condition.least_lambda(alpha, f_plus)
    # a lane that overflowed has no bound
    return {name: jnp.where(jnp.isnan(f_plus), jnp.nan, value) for name, value in out.items()}


def describe(column: str) -> Metric:
    """Unit and meaning of a metric column such as `motor.velocity_rmse`."""
    if column == "finite":
        return Metric("", "finite", "no number of the lane overflowed")
    return SIDE_METRICS[column.partition(".")[2]]


def metric_columns(experiment: Experiment) -> list[str]:
    """The columns that :data:`METRICS` and :func:`with_conditions` give for this experiment."""
    names = list(SIDE_METRICS)
    if experiment.identifier is None or experiment.transmission is None:
        names = [n for n in names if n not in ("stiffness_error", "dead_zone_error", "excitation")]
    elif "half_gap" not in experiment.transmission.truth():
        names.remove("dead_zone_error")
    return ["finite", *(f"{side}.{name}" for side in experiment.sides for name in names)]


NOTHING = {"float64": 1e-9, "float32": 1e-4}
"""By precision: a right-hand side error this small against the acceleration is rounding."""


def undisturbed(side: str) -> InputError:
    """What to say where f_plus is zero."""
    return InputError(
        f"{side}: nothing acts on it that its observer does not know (f⁺ = 0), so that gains have nothing to meet; "
        "add a transmission, an effect, or an excitation that moves the drive"
    )
