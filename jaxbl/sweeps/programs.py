"""Compiled programs for the chunks of a study: the scan by XLA, or the fused loop."""

import math
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeVar, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxbl.drive.parameters import set_leaves
from jaxbl.errors import InputError
from jaxbl.fused import Unsupported, raising_unsupported
from jaxbl.simulate import Experiment, scan

from .metrics import ALL_METRICS, MetricNames, ObserverGains, metric_columns, metrics_reducer, observer_gains

if TYPE_CHECKING:
    from jaxbl.fused.lane_simulator import LaneSimulator

Backend = Literal["fused", "scan"]
BACKENDS: tuple[Backend, ...] = get_args(Backend)


def check_backend(name: str | None, source: str = "backend") -> Backend | None:
    """A backend by its name, None for none. Raises `InputError` for another; `source` is what it was given as."""
    if name is not None and name not in BACKENDS:
        raise InputError(f"{source}: there is no {name!r}; one of {', '.join(BACKENDS)}")
    return name


def computed_metrics(backend: Backend, names: MetricNames) -> MetricNames:
    """The metrics that a backend computes where some are asked for. XLA rounds otherwise where it computes less: the scan
    computes all, so that those asked for are to the bit what they are beside the others."""
    return names if backend == "fused" else None


Result = TypeVar("Made")

_MAX_SHARED = 16
"""Programs that studies share, at most."""
_shared_results: ContextVar[OrderedDict[Any, Any] | None] = ContextVar("shared", default=None)


@contextmanager
def share_programs() -> Iterator[None]:
    """Studies that are run inside share their programs, as those of the stages of one search: what differs in nothing but
    the values of its lanes is compiled once."""
    before = _shared_results.set(OrderedDict())
    try:
        yield
    finally:
        _shared_results.reset(before)


def share_result(experiment: Experiment, paths: Iterable[str], arguments: Any, build: Callable[[], Result]) -> Result:
    """What `build` makes of an experiment whose leaves at `paths` may have any values, and of other hashable arguments
    `arguments`; inside :func:`sharing`, what it has made of them before."""
    results = _shared_results.get()
    if results is None:
        return build()
    leaves, structure = jax.tree.flatten(set_leaves(experiment, dict.fromkeys(paths, np.zeros(()))))
    arrays = [np.asarray(leaf) for leaf in leaves]
    key = arguments, tuple(paths), structure, tuple((array.dtype, array.shape, array.tobytes()) for array in arrays)
    if key not in results:
        results[key] = build()
    results.move_to_end(key)
    while len(results) > _MAX_SHARED:
        results.popitem(last=False)
    return results[key]


class Layout(NamedTuple):
    """Shape of a chunk: seeds and points."""

    seeds: int
    points: int


class Program(NamedTuple):
    """What runs a chunk: `run` maps values by path `(points,)` and seeds `(seeds,)` to figures `(seeds, points)` and gains,
    which have these axes or fit them; it takes `megabytes` of memory. Where the scan takes the fused loop's place, `instead`
    says what the loop does not support."""

    run: Callable[[dict[str, np.ndarray], np.ndarray], tuple[dict[str, Any], dict[str, ObserverGains]]]
    megabytes: float
    fallback_reason: str | None = None


@contextmanager
def without_cache_writes() -> Iterator[None]:
    """What is compiled inside is not put into JAX's cache of programs, and taken from it if it is there: compiling takes as
    long as it would without."""
    least = "jax_persistent_cache_min_compile_time_secs"
    before = jax.config.values[least]
    jax.config.update(least, math.inf)
    try:
        yield
    finally:
        jax.config.update(least, before)


def compile_program(
    experiment: Experiment,
    layout: Layout,
    devices: list[Any],
    backend: Backend,
    columns: dict[str, np.ndarray],
    *,
    metric_names: MetricNames = None,
    require_backend: bool = False,
) -> Program:
    """Compile a program for chunks of a study, or take one that studies share; call inside :func:`jaxbl.config.precision`.

    Args:
        experiment: experiment of all lanes, but for the values that differ between them.
        layout: shape of the chunks.
        devices: JAX devices to use.
        backend: if the fused loop cannot run the experiment, the scan takes its place.
        columns: an example of the values by path, `(points,)`.
        metric_names: requested metrics; the program may compute others as well.
        require_backend: refuse an experiment that the fused loop cannot run.

    Raises:
        InputError: the fused loop is required and cannot run the experiment.
    """

    def compiled() -> Program:
        if backend == "fused":
            try:
                with raising_unsupported():
                    return _fused(experiment, layout, devices, tuple(columns), metric_names)
            except Unsupported as why:
                if require_backend:
                    raise InputError(f"--backend fused: the fused loop does not support {why}; use --backend scan") from None
                return _scanned(experiment, layout, devices, columns)._replace(fallback_reason=str(why))
        return _scanned(experiment, layout, devices, columns)

    dtypes = tuple(column.dtype for column in columns.values())
    return share_result(
        experiment, columns, (layout, tuple(devices), backend, dtypes, metric_names, require_backend), compiled
    )


def _fused(
    experiment: Experiment, layout: Layout, devices: list[Any], paths: tuple[str, ...], names: MetricNames
) -> Program:
    if not paths:
        raise Unsupported("lanes that differ only in their seed")
    from jaxbl.fused.lane_simulator import DeviceSimulator, HostSimulator

    if devices[0].platform == "cpu":
        passage: LaneSimulator = HostSimulator(experiment, (metrics_reducer(names),), paths, layout.points, len(devices))
    elif devices[0].platform == "gpu" and len(devices) == 1:
        with jax.default_device(devices[0]):
            passage = DeviceSimulator(experiment, (metrics_reducer(names),), paths, layout.points)
    else:
        raise Unsupported(f"{len(devices)} devices of platform {devices[0].platform}")

    with jax.default_device(devices[0]):
        # what draws the noise is compiled at its first use
        next(passage.stretches(0))

    def run(values: dict[str, np.ndarray], seeds: np.ndarray) -> tuple[dict[str, Any], dict[str, ObserverGains]]:
        with jax.default_device(devices[0]):
            # seeds that only fill up the last chunk are copies of one; those of a chunk are likely those of the next
            different = dict.fromkeys(int(seed) for seed in seeds)
            passage.keep(different)
            found = {seed: passage(values, seed) for seed in different}
        stacked = {name: np.stack([found[int(seed)][name] for seed in seeds]) for name in found[int(seeds[0])]}
        return stacked, observer_gains(set_leaves(experiment, values))

    size = jnp.result_type(experiment.run.sample_period).itemsize
    figures = len(metric_columns(experiment, names)) * layout.seeds
    return Program(run, (passage.carried + len(paths) + figures) * layout.points * size / 1e6)


def _scanned(experiment: Experiment, layout: Layout, devices: list[Any], columns: dict[str, np.ndarray]) -> Program:
    def lane(values: dict[str, Any], seed: Any) -> tuple[dict[str, Any], Any]:
        experiment_of_lane = set_leaves(experiment, values)
        figures, _ = scan(experiment_of_lane, seed, (ALL_METRICS,))
        return figures, observer_gains(experiment_of_lane)

    # shards along the longer side that divides evenly; one device does the rest
    seeds, points = layout
    count = len(devices)
    by_points, by_seeds = points % count == 0, points % count != 0 and seeds % count == 0
    mesh = Mesh(np.array(devices if by_points or by_seeds else devices[:1]), ("lanes",))
    over_points = PartitionSpec("lanes" if by_points else None)
    over_seeds = PartitionSpec("lanes" if by_seeds else None)
    local_points = points // count if by_points else points
    chunk = jax.shard_map(
        jax.vmap(jax.vmap(lane, in_axes=(0, None), axis_size=local_points), in_axes=(None, 0)),
        mesh=mesh,
        in_specs=(over_points, over_seeds),
        out_specs=PartitionSpec(*over_seeds, *over_points),
        check_vma=False,
    )
    example = {path: np.zeros(points, column.dtype) for path, column in columns.items()}, np.zeros(seeds, np.uint32)
    program = jax.jit(chunk).lower(*example).compile()
    memory = program.memory_analysis()
    size = 0 if memory is None else memory.temp_size_in_bytes + memory.output_size_in_bytes
    return Program(program, size / 1e6)
