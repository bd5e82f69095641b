"""The engine as functions: one experiment as a tree of numbers, and pure functions of it.

They are JAX's kind of function: `jax.jit`, `jax.vmap`, `jax.grad`, `jax.lax.scan` and shardings apply to them and to what
calls them. No files and no folders are needed (docs/functions.md). :func:`sweep_arrays` alone is for NumPy: it compiles its
own loop.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, Literal, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array

from jaxbl import chain
from jaxbl.chain import Experiment, NamedArrays, Sample, Signals, TracedArrays, replay, scan, unit_noise
from jaxbl.config import ConfigSource, read_config
from jaxbl.config.study import suggest_path
from jaxbl.control import CONTROLLERS, REFERENCES, AbstractController, AbstractReference, FunctionReference
from jaxbl.drive import DRIVES, AbstractDrive
from jaxbl.drive.effects import EFFECTS, AbstractEffect
from jaxbl.drive.excitation import EXCITATIONS, AbstractExcitation, FunctionInput
from jaxbl.drive.parameters import as_arrays, get_leaf, leaf_paths, set_leaves
from jaxbl.drive.transmission import TRANSMISSIONS, AbstractTransmission
from jaxbl.errors import InputError
from jaxbl.fused import warn_of_scan
from jaxbl.gradients import warn_when_differentiated
from jaxbl.observer import OBSERVERS, AbstractObserver
from jaxbl.registry import Registry
from jaxbl.sweeps.metrics import (
    SIDE_METRICS,
    Metric,
    add_gain_metrics,
    clear_metrics,
    compute_gain_metrics,
    metric_columns,
    metrics_reducer,
    needs_gain_metrics,
    observer_gains,
)
from jaxbl.sweeps.programs import Backend, Layout, compile_program, computed_metrics


def experiment(study: ConfigSource | Experiment, *, precision: Literal["float64", "float32"] | None = None) -> Experiment:
    """Make the experiment of a study, whose numbers are arrays.

    Args:
        study: TOML file, mapping, config, or an :class:`Experiment` that is put together from classes; its `excitation` and
            `reference` may be plain functions of time (s) that return torque (N m) and position (rad).
        precision: of the numbers; left out, the study's `[run] precision`, which is float64 unless it says otherwise.

    Raises:
        InputError: wrong study, a controller without a reference, or float64 while JAX computes in float32.

    Example:
        >>> axis = jaxbl.experiment("axis.toml")
    """
    if not isinstance(study, Experiment):
        config = read_config(study)
        precision, study = precision or config.run.precision, config.build()
    dtype = jnp.dtype(precision or "float64")
    if jax.dtypes.canonicalize_dtype(dtype) != dtype:
        raise InputError(
            "experiment: its numbers are float64, and JAX computes in float32 here; before the first array add "
            'jax.config.update("jax_enable_x64", True), or ask for precision="float32"'
        )
    if not isinstance(study.excitation, AbstractExcitation):
        study = dataclasses.replace(study, excitation=FunctionInput(study.excitation))
    if (study.controller is None) != (study.reference is None):
        raise InputError("experiment: a controller and the reference that it follows belong together; give both, or none")
    if study.reference is not None and not isinstance(study.reference, AbstractReference):
        study = dataclasses.replace(study, reference=FunctionReference(study.reference))
    return as_arrays(study, dtype)


_REGISTRIES: dict[type, Registry] = {
    AbstractDrive: DRIVES,
    AbstractExcitation: EXCITATIONS,
    AbstractTransmission: TRANSMISSIONS,
    AbstractEffect: EFFECTS,
    AbstractObserver: OBSERVERS,
    AbstractController: CONTROLLERS,
    AbstractReference: REFERENCES,
    Metric: SIDE_METRICS,
}
"""Where a class of a base is registered."""
_Part = TypeVar("_Part", bound=type)


def register(part: _Part) -> _Part:
    """Register a class of one's own under its `name`, for the studies of this process; a decorator.

    Studies then take it as any other drive, input, law, effect, observer, controller, reference or metric, at once and in
    the fused loop. To define it again replaces it. Other processes need a package with an entry point (docs/effects.md).

    Raises:
        InputError: what is wrong with the class.
    """
    cls: Any = part
    for base, registry in _REGISTRIES.items():
        if isinstance(cls, type) and issubclass(cls, base):
            try:
                names = [f"{place}.{cls.kind}" for place in cls.places] if base is AbstractEffect else [cls.name]
                for name in names:
                    registry.register(name, cls)
            except (AttributeError, TypeError, ValueError) as error:
                raise InputError(f"register: {cls.__name__}: {error}") from None
            # traces of before do not know it
            clear_metrics()
            jax.clear_caches()
            return part
    raise InputError(
        f"register: {part!r} should be a class of a drive, input, law, effect, observer, controller, reference or metric"
    )


def with_values(experiment: Experiment, values: Mapping[str, Any]) -> Experiment:
    """Return the experiment with other numbers, or other parts, at some dotted paths.

    Args:
        values: by path, such as `transmission.half_gap`; numbers may be traced. The path of a part (`observer.motor`) takes
            another part.

    Raises:
        InputError: there is no such path; the nearest one is named.
    """
    dtype, cast = jnp.result_type(experiment.run.sample_period), {}
    for path, value in values.items():
        try:
            is_choice = isinstance(get_leaf(experiment, path), int | str)
        except KeyError:
            raise InputError(f"unknown path '{path}'; {suggest_path(path, leaf_paths(experiment))}") from None
        is_number = not is_choice and isinstance(value, int | float | Array | np.ndarray | np.generic)
        cast[path] = jnp.asarray(value, dtype) if is_number else as_arrays(value, dtype)
    return set_leaves(experiment, cast)


def samples(experiment: Experiment, seed: Any = 0) -> Sample:
    """Return the samples of a run, for a loop of one's own over :func:`jaxbl.step`: leaves of shape (samples,).

    `seed` is that of the encoder noise.
    """
    indices = jnp.arange(experiment.run.steps, dtype=jnp.int32)
    period = experiment.run.sample_period
    return Sample(indices.astype(jnp.result_type(period)) * period, unit_noise(seed, indices, experiment.sides))


step = warn_when_differentiated(chain.step)


def _record_signals(state: Any, signals: Signals) -> Signals:
    return signals


@warn_when_differentiated
@eqx.filter_jit
def simulate(experiment: Experiment, seed: Any = 0, *, stride: int = 1) -> Signals:
    """Simulate the experiment with its own input, and return all signals, with a leading time axis.

    Args:
        experiment: of :func:`experiment`.
        seed: of the encoder noise.
        stride: keep one of so many samples.
    """
    return scan(experiment, seed, record=_record_signals, stride=stride)[1]


@warn_when_differentiated
@eqx.filter_jit
def observe(experiment: Experiment, u: Array, y: TracedArrays) -> Signals:
    """Run the observers on a record, which takes the place of the drive, and return their signals.

    Args:
        experiment: its sample period is that of the record.
        u: torque, N m, shape (samples,).
        y: position of each side, rad, shape (samples,): keys "motor" and, on two inertias, "load".
    """
    return replay(experiment, u, y, record=_record_signals)[1]


@warn_when_differentiated
@eqx.filter_jit
def metrics(experiment: Experiment, seed: Any = 0, *, names: tuple[str, ...] | None = None) -> TracedArrays:
    """Compute the metrics of a run, by column such as `motor.velocity_rmse`; memory does not grow with its duration.

    Args:
        experiment: of :func:`experiment`.
        seed: of the encoder noise.
        names: metrics, without a side; left out, all that apply.

    Raises:
        InputError: there is no such metric.
    """
    columns = metric_columns(experiment, names)
    results, _ = scan(experiment, seed, (metrics_reducer(names),))
    if needs_gain_metrics(names):
        for side, gains in observer_gains(experiment).items():
            judged = compute_gain_metrics(*map(jnp.asarray, gains), results[f"{side}.f_plus"])
            results |= {f"{side}.{name}": value for name, value in judged.items()}
    return {name: results[name] for name in columns}


@dataclasses.dataclass(frozen=True, repr=False)
class Grid:
    """Metrics over the product of axes.

    Attributes:
        axes: values by path, in order; the last axis is `seed`.
        metrics: by column, each of the shape of the axes.
    """

    axes: NamedArrays
    metrics: NamedArrays

    def __getitem__(self, column: str) -> np.ndarray:
        return self.metrics[column]

    def __repr__(self) -> str:
        axes = ", ".join(f"{path}: {len(values)}" for path, values in self.axes.items())
        return f"Grid({axes}; {len(self.metrics)} metrics)"

    def to_frame(self) -> pd.DataFrame:
        """A row for each run, indexed by the axes; `to_frame().to_xarray()` has them as dimensions."""
        index = pd.MultiIndex.from_product(list(self.axes.values()), names=list(self.axes))
        return pd.DataFrame({name: values.ravel() for name, values in self.metrics.items()}, index)

    def _repr_html_(self) -> Any:
        return self.to_frame()._repr_html_()


_MOST_LANES = 16_384
"""Points that are computed at once."""


def sweep_arrays(
    experiment: Experiment,
    values: Mapping[str, Any],
    *,
    seeds: int = 1,
    names: tuple[str, ...] | None = None,
    backend: Backend = "fused",
) -> Grid:
    """Compute the metrics of all combinations of values, by the same loops as :func:`jaxbl.sweep`.

    Args:
        experiment: of :func:`experiment`, with concrete numbers.
        values: values of each axis by path, shape (n,).
        seeds: number of noise sequences.
        names: metrics, without a side; left out, all that apply.
        backend: `fused`, or where it cannot run the experiment, and always if asked for, `scan`.

    Raises:
        InputError: a path that is no number of the experiment, or is fixed as the program is compiled; no such metric.

    Example:
        >>> grid = jaxbl.sweep_arrays(axis, {"transmission.half_gap": np.linspace(0.0, 0.01, 50)}, names=("velocity_rmse",))
        >>> grid["load.velocity_rmse"].shape
        (50, 1)
    """
    columns, paths = metric_columns(experiment, names), leaf_paths(experiment)
    for path in values:
        if path not in paths:
            raise InputError(f"'{path}' is no number that may differ between lanes; {suggest_path(path, paths)}")
    dtype = jnp.result_type(experiment.run.sample_period)
    axes = {path: np.atleast_1d(np.asarray(column, dtype)) for path, column in values.items()}
    shape = tuple(len(column) for column in axes.values())
    lanes = dict(zip(axes, (mesh.ravel() for mesh in np.meshgrid(*axes.values(), indexing="ij")), strict=True))
    count = math.prod(shape)
    points, seed_values = min(count, _MOST_LANES), np.arange(seeds, dtype=np.uint32)
    with jax.enable_x64(dtype == jnp.float64):
        devices = jax.local_devices()
        requested = computed_metrics(backend, names)
        first = {path: column[:points] for path, column in lanes.items()}
        program = compile_program(experiment, Layout(seeds, points), devices, backend, first, metric_names=requested)
        if program.fallback_reason:
            warn_of_scan(program.fallback_reason)
        parts = []
        for start in range(0, count, points):
            indices = np.minimum(np.arange(start, start + points), count - 1)
            results, gains = program.run({path: column[indices] for path, column in lanes.items()}, seed_values)
            results = add_gain_metrics(results, gains, names)
            parts.append({name: np.asarray(results[name])[:, : count - start] for name in columns})
    return Grid(
        {**axes, "seed": seed_values},
        {name: np.concatenate([part[name] for part in parts], 1).T.reshape(*shape, seeds) for name in columns},
    )
