"""The one workload of the benchmark: the paper's chain, its lanes, and the figures that every entry has to reproduce.

Plant, two explicit super-twisting observers, low-pass, and both identifiers; one step of the plant a sample, nothing
recorded. Every lane has a dead zone, a noise level and gains of its own; all share the noise of one seed.
"""

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.chain import Experiment, NamedArrays, Reducer, Run, State, TracedArrays, unit_noise
from jaxbl.drive import Encoders, Initial, SigmoidBacklash, TwoInertia, as_arrays
from jaxbl.drive.excitation import Sine
from jaxbl.observer import EquivalentControl, ExplicitSuperTwisting, Identifier, Observers
from jaxbl.sweeps.metrics import window_start

SEED = 0
"""Of the encoders' noise: any one, the same for all."""
SIDES = ("motor", "load")
Metrics = dict[str, np.ndarray]
"""Metrics of the lanes, `(lanes,)` each, by name."""
RANGES = {
    "observer.motor.alpha": (8.0, 40.0),
    "observer.motor.lambda": (2.0, 10.0),
    "observer.load.alpha": (0.1, 0.4),
    "observer.load.lambda": (0.2, 1.0),
    "transmission.dead_zone": (0.005, 0.03),
    "encoders.noise": (1e-5, 1e-3),
}
"""What differs from lane to lane, from and to; spread by the logarithm."""
_SAMPLE_PERIOD, _VELOCITY_ERROR = 1e-3, 0.5
"""Sample period (s), velocity error of the motor's observer at t = 0 (rad/s)."""
DRIVE = {"motor_inertia": 0.05, "motor_viscous": 0.15, "load_inertia": 7.0, "load_viscous": 16.0, "gear_ratio": 5.0}
SINE = {"amplitude": 0.1, "frequency": 0.16}
"""The sine that is the input, N m and Hz."""
_STIFFNESS, _SLOPE, _LOW_PASS = 1.0, 20.0, 0.01
"""The paper's drive and law (N m/rad, 1/rad), and the low-pass of the equivalent control (s)."""


def _update_sums(experiment: Experiment, sums: TracedArrays, index: Any, signals: Any) -> TracedArrays:
    counts = (index >= window_start(experiment.run.steps)).astype(signals.time.dtype)
    updated = {}
    for side in SIDES:
        error = signals.side(side).true.velocity - signals.side(side).velocity_estimate
        updated[side] = sums[side] + counts * error * error
    return updated


def _metrics(experiment: Experiment, sums: TracedArrays, state: State) -> TracedArrays:
    assert experiment.identifier is not None and experiment.transmission is not None and state.identifier is not None
    count = experiment.run.steps - window_start(experiment.run.steps)
    identified = experiment.identifier.estimate(state.identifier, experiment.transmission)
    metrics = {}
    for side in SIDES:
        metrics[f"{side}.velocity_rmse"] = jnp.sqrt(sums[side] / count)
        for name in ("stiffness", "dead_zone"):
            metrics[f"{side}.{name}"] = identified[side][name]
    return metrics


CHAIN_METRICS = Reducer(
    lambda experiment: dict.fromkeys(SIDES, jnp.zeros_like(experiment.run.sample_period)), _update_sums, _metrics
)
"""Rms velocity error over the last quarter (rad/s), and what is identified (N m/rad, rad), of both sides."""
METRIC_NAMES = tuple(f"{side}.{name}" for side in SIDES for name in ("velocity_rmse", "stiffness", "dead_zone"))


class Workload(NamedTuple):
    """So many lanes over so many samples (steps), in `float32` or `float64`."""

    lanes: int
    steps: int
    precision: str

    @property
    def dtype(self) -> Any:
        return np.dtype(self.precision)

    @property
    def start(self) -> int:
        """First sample that the identifiers count: the observers have converged."""
        return self.steps // 4

    @property
    def window(self) -> int:
        """First sample of which errors count."""
        return window_start(self.steps)

    def values(self) -> NamedArrays:
        """Draw the values of the lanes by config path, `(lanes,)`: a low-discrepancy sequence over `RANGES`.

        Fewer lanes have the first values of more lanes.

        Reference: M. Roberts' sequence, powers of the generalised golden ratio.
        """
        golden = 2.0
        for _ in range(64):
            golden = (1.0 + golden) ** (1.0 / (len(RANGES) + 1))
        index = np.arange(1, self.lanes + 1)
        values = {}
        for i, (path, (low, high)) in enumerate(RANGES.items(), 1):
            share = (0.5 + index * golden**-i) % 1.0
            values[path] = (low * (high / low) ** share).astype(self.dtype)
        return values

    def experiment(self) -> Experiment:
        """With array leaves of the precision; lanes set those of `RANGES`."""
        experiment = Experiment(
            drive=TwoInertia(**DRIVE),
            transmission=SigmoidBacklash(_STIFFNESS, 0.02, _SLOPE),
            effects=(),
            initial=Initial(),
            excitation=Sine(**SINE),
            encoders=Encoders(1e-4),
            observer=Observers(
                ExplicitSuperTwisting(lambda_=4.0, alpha=9.0, velocity_error=_VELOCITY_ERROR),
                ExplicitSuperTwisting(lambda_=0.5, alpha=0.2),
            ),
            equivalent_control=EquivalentControl(_LOW_PASS),
            identifier=Identifier(self.start * _SAMPLE_PERIOD),
            run=Run(_SAMPLE_PERIOD, self.steps, 1),
        )
        return as_arrays(experiment, self.dtype)

    def inputs(self) -> tuple[np.ndarray, np.ndarray]:
        """Torque (N m) `(steps,)` and unit noise `(steps, 2)` of motor and load, for entries that do not make them."""
        return _make_inputs(self.steps, self.precision)


@cache
def _make_inputs(steps: int, precision: str) -> tuple[np.ndarray, np.ndarray]:
    work = Workload(1, steps, precision)
    with jax.enable_x64(precision == "float64"):
        experiment = work.experiment()
        indices = jnp.arange(steps, dtype=jnp.int32)
        noise = jax.jit(lambda: unit_noise(jnp.asarray(SEED), indices, SIDES))()
        torque = jax.vmap(experiment.excitation)(indices.astype(work.dtype) * experiment.run.sample_period)
    return np.asarray(torque, work.dtype), np.stack([np.asarray(noise[side], work.dtype) for side in SIDES], 1)


class ChunkedProgram:
    """A function of values by path, compiled for chunks of one size; the last one is filled up."""

    def __init__(self, function: Callable[..., Any], workload: Workload, size: int, *shared_arguments: Any):
        self._lanes, self._shared_arguments = workload.lanes, shared_arguments
        shape = -(-workload.lanes // size), size
        columns = {path: jnp.asarray(np.resize(column, shape)) for path, column in workload.values().items()}
        self._chunks = [{path: column[i] for path, column in columns.items()} for i in range(shape[0])]
        self.compiled = jax.jit(function).lower(self._chunks[0], *shared_arguments).compile()

    def __call__(self) -> Metrics:
        chunks = [self.compiled(values, *self._shared_arguments) for values in self._chunks]
        return {name: np.concatenate([np.asarray(chunk[name]) for chunk in chunks])[: self._lanes] for name in chunks[0]}


def chain_constants() -> dict[str, float]:
    """The numbers that all lanes share, for those who write the chain themselves."""
    return {
        "period": _SAMPLE_PERIOD,
        **DRIVE,
        "stiffness": _STIFFNESS,
        "slope": _SLOPE,
        "share": -math.expm1(-_SAMPLE_PERIOD / _LOW_PASS),
        "motor_error": _VELOCITY_ERROR,
    }


def identify_from_sums(sums: Sequence[np.ndarray]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Stiffness and dead zone `(lanes,)` by side, from seven sums over the run: of products of both regressors (3), of
    regressors and torques (2 a side)."""
    twist_squares, products, bend_squares, *moments = (np.asarray(column, np.float64) for column in sums)
    determinant = twist_squares * bend_squares - products * products
    identified = {}
    for i, side in enumerate(SIDES):
        twist_torque, bend_torque = moments[2 * i : 2 * i + 2]
        stiffness = (bend_squares * twist_torque - products * bend_torque) / determinant
        dead_zone = (twist_squares * bend_torque - products * twist_torque) / determinant / stiffness
        identified[side] = stiffness, dead_zone
    return identified


def metrics_from_sums(workload: Workload, sums: list[np.ndarray]) -> Metrics:
    """Figures `(lanes,)` from the nine sums over the run that rivals keep: those of :func:`identify_from_sums`, and of
    squared velocity errors (1 a side)."""
    identified, metrics = identify_from_sums(sums[:7]), {}
    for side, squares in zip(SIDES, sums[7:], strict=True):
        metrics[f"{side}.velocity_rmse"] = np.sqrt(np.asarray(squares, np.float64) / (workload.steps - workload.window))
        metrics[f"{side}.stiffness"], metrics[f"{side}.dead_zone"] = identified[side]
    return metrics
