"""The one workload of the benchmark: the paper's chain, its lanes, and the figures that every entry has to reproduce.

Plant, two explicit super-twisting observers, low-pass, and both identifiers; one step of the plant a sample, nothing
recorded. Every lane has a dead zone, a noise level and gains of its own; all share the noise of one seed.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.drive import Encoders, Initial, SigmoidBacklash, TwoInertia, as_arrays
from jaxbl.drive.excitation import Sine
from jaxbl.observer import EquivalentControl, ExplicitSuperTwisting, Identifier, Observers
from jaxbl.simulate import Experiment, Reducer, Run, State, unit_noise
from jaxbl.sweeps.metrics import window_start

SEED = 0
"""Of the encoders' noise: any one, the same for all."""
SIDES = ("motor", "load")
RANGES = {
    "observer.motor.alpha": (8.0, 40.0),
    "observer.motor.lambda": (2.0, 10.0),
    "observer.load.alpha": (0.1, 0.4),
    "observer.load.lambda": (0.2, 1.0),
    "transmission.dead_zone": (0.005, 0.03),
    "encoders.noise": (1e-5, 1e-3),
}
"""What differs from lane to lane, from and to; spread by the logarithm."""
_PERIOD, _MISS = 1e-3, 0.5
"""Sample period (s), velocity error of the motor's observer at t = 0 (rad/s)."""
DRIVE = {"motor_inertia": 0.05, "motor_viscous": 0.15, "load_inertia": 7.0, "load_viscous": 16.0, "gear_ratio": 5.0}
INPUT = {"amplitude": 0.1, "frequency": 0.16}
"""The sine that is the input, N m and Hz."""
_STIFFNESS, _SLOPE, _LOW_PASS = 1.0, 20.0, 0.01
"""The paper's drive and law (N m/rad, 1/rad), and the low-pass of the equivalent control (s)."""


def _rates(experiment: Experiment, total: dict[str, Any], index: Any, signals: Any) -> dict[str, Any]:
    inside = (index >= window_start(experiment.run.steps)).astype(signals.time.dtype)
    new = {}
    for side in SIDES:
        error = signals.side(side).true.velocity - signals.side(side).velocity_estimate
        new[side] = total[side] + inside * error * error
    return new


def _figures(experiment: Experiment, total: dict[str, Any], state: State) -> dict[str, Any]:
    assert experiment.identifier is not None and experiment.transmission is not None and state.identifier is not None
    count = experiment.run.steps - window_start(experiment.run.steps)
    found = experiment.identifier.estimate(state.identifier, experiment.transmission)
    figures = {}
    for side in SIDES:
        figures[f"{side}.velocity_rmse"] = jnp.sqrt(total[side] / count)
        for name in ("stiffness", "dead_zone"):
            figures[f"{side}.{name}"] = found[side][name]
    return figures


FIGURES = Reducer(lambda experiment: dict.fromkeys(SIDES, jnp.zeros_like(experiment.run.sample_period)), _rates, _figures)
"""Rms velocity error over the last quarter (rad/s), and what is identified (N m/rad, rad), of both sides."""
NAMES = tuple(f"{side}.{name}" for side in SIDES for name in ("velocity_rmse", "stiffness", "dead_zone"))


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

    def values(self) -> dict[str, np.ndarray]:
        """By config path, `(lanes,)`: a low-discrepancy sequence over `RANGES`, of which fewer lanes are the first ones.

        Reference: M. Roberts' sequence, powers of the generalised golden ratio.
        """
        golden = 2.0
        for _ in range(64):
            golden = (1.0 + golden) ** (1.0 / (len(RANGES) + 1))
        index = np.arange(1, self.lanes + 1)
        found = {}
        for i, (path, (low, high)) in enumerate(RANGES.items(), 1):
            share = (0.5 + index * golden**-i) % 1.0
            found[path] = (low * (high / low) ** share).astype(self.dtype)
        return found

    def experiment(self) -> Experiment:
        """With array leaves of the precision; lanes set those of `RANGES`."""
        experiment = Experiment(
            drive=TwoInertia(**DRIVE),
            transmission=SigmoidBacklash(_STIFFNESS, 0.02, _SLOPE),
            effects=(),
            initial=Initial(),
            excitation=Sine(**INPUT),
            encoders=Encoders(1e-4),
            observer=Observers(
                ExplicitSuperTwisting(lambda_=4.0, alpha=9.0, velocity_error=_MISS),
                ExplicitSuperTwisting(lambda_=0.5, alpha=0.2),
            ),
            equivalent_control=EquivalentControl(_LOW_PASS),
            identifier=Identifier(self.start * _PERIOD),
            run=Run(_PERIOD, self.steps, 1),
        )
        return as_arrays(experiment, self.dtype)

    def inputs(self) -> tuple[np.ndarray, np.ndarray]:
        """Torque (N m) `(steps,)` and unit noise `(steps, 2)` of motor and load, for entries that do not make them."""
        return _inputs(self.steps, self.precision)


@cache
def _inputs(steps: int, precision: str) -> tuple[np.ndarray, np.ndarray]:
    work = Workload(1, steps, precision)
    experiment = work.experiment()
    indices = jnp.arange(steps, dtype=jnp.int32)
    noise = jax.jit(lambda: unit_noise(jnp.asarray(SEED), indices, SIDES))()
    torque = jax.vmap(experiment.excitation)(indices.astype(work.dtype) * experiment.run.sample_period)
    return np.asarray(torque, work.dtype), np.stack([np.asarray(noise[side], work.dtype) for side in SIDES], 1)


class Chunked:
    """A function of values by path, compiled for chunks of one size; the last one is filled up."""

    def __init__(self, function: Callable[..., Any], workload: Workload, size: int, *rest: Any):
        self._lanes, self._rest = workload.lanes, rest
        count = -(-workload.lanes // size) * size
        padded = {path: np.pad(column, (0, count - len(column)), "edge") for path, column in workload.values().items()}
        self._chunks = [
            {path: jnp.asarray(column[at : at + size]) for path, column in padded.items()} for at in range(0, count, size)
        ]
        self.compiled = jax.jit(function).lower(self._chunks[0], *rest).compile()

    def __call__(self) -> dict[str, np.ndarray]:
        parts = [self.compiled(values, *self._rest) for values in self._chunks]
        return {name: np.concatenate([np.asarray(part[name]) for part in parts])[: self._lanes] for name in parts[0]}


def constants() -> dict[str, float]:
    """The numbers that all lanes share, for those who write the chain themselves."""
    return {
        "period": _PERIOD,
        **DRIVE,
        "stiffness": _STIFFNESS,
        "slope": _SLOPE,
        "share": -math.expm1(-_PERIOD / _LOW_PASS),
        "motor_error": _MISS,
    }


def identified_figures(workload: Workload, sums: list[np.ndarray]) -> dict[str, np.ndarray]:
    """Figures `(lanes,)` from the nine sums over the run that rivals keep: of products of both regressors (3), of regressors
    and torques (2 a side), of squared velocity errors (1 each)."""
    first, both, second, *right = (np.asarray(column, np.float64) for column in sums)
    determinant = first * second - both * both
    figures = {}
    for i, side in enumerate(SIDES):
        one, two = right[2 * i : 2 * i + 2]
        stiffness = (second * one - both * two) / determinant
        figures[f"{side}.velocity_rmse"] = np.sqrt(right[4 + i] / (workload.steps - workload.window))
        figures[f"{side}.stiffness"] = stiffness
        figures[f"{side}.dead_zone"] = (first * two - both * one) / determinant / stiffness
    return figures
