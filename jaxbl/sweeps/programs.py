"""Compiled programs for the chunks of a study: the scan by XLA, or the fused loop."""

import math
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxbl.chain import Experiment, NamedArrays, TracedArrays, scan
from jaxbl.drive.parameters import set_leaves
from jaxbl.errors import InputError
from jaxbl.fused import Unsupported, raising_unsupported

from .metrics import ALL_METRICS, MetricNames, ObserverGains, metric_columns, metrics_reducer, observer_gains

if TYPE_CHECKING:
    from jaxbl.fused.lane_simulator import LaneSimulator

Backend = Literal["fused", "scan"]
BACKENDS: tuple[Backend, ...] = get_args(Backend)


def check_backend(name: str | None, source: str = "backend") -> Backend | None:
    """Return the name if it is a backend or None; otherwise raise `InputError` that begins with `source`, the option."""
    if name is not None and name not in BACKENDS:
        raise InputError(f"{source}: there is no {name!r}; it should be one of {', '.join(BACKENDS)}")
    return name


def computed_metrics(backend: Backend, names: MetricNames) -> MetricNames:
    """The metrics that a backend computes if `names` are requested.

    XLA rounds differently if it computes less. The scan therefore computes all metrics: a metric has the same bits whichever
    others are requested.
    """
    return names if backend == "fused" else None


class Layout(NamedTuple):
    """Shape of a chunk: seeds and points."""

    seeds: int
    points: int


class Program(NamedTuple):
    """A compiled program for chunks of one shape.

    Attributes:
        run: maps values by path `(points,)` and seeds `(seeds,)` to metrics by column `(seeds, points)`, and to gains by
            side that broadcast to these axes.
        megabytes: memory that it takes.
        fallback_reason: what the fused loop does not support, if the scan takes its place.
    """

    run: Callable[[NamedArrays, np.ndarray], tuple[NamedArrays, dict[str, ObserverGains]]]
    megabytes: float
    fallback_reason: str | None = None


MAX_PROGRAMS = 16
"""Number of compiled programs in memory, for each study and for studies that share them."""


class RecentPrograms(OrderedDict[Any, Program]):
    """The last compiled programs by key."""

    def take(self, key: Any, build: Callable[[], Program]) -> Program:
        """Return the program of a key; if it is not there, it is built, and the oldest one may be forgotten."""
        if key not in self:
            self[key] = build()
        self.move_to_end(key)
        if len(self) > MAX_PROGRAMS:
            self.popitem(last=False)
        return self[key]


_shared_programs: ContextVar[RecentPrograms | None] = ContextVar("shared", default=None)


@contextmanager
def share_programs() -> Iterator[None]:
    """Let studies that run inside share programs: studies that differ only in the values of their lanes compile once.

    The stages of a search for gains are such studies. Inside another such context they share its programs.
    """
    shared = _shared_programs.get()
    before = _shared_programs.set(RecentPrograms() if shared is None else shared)
    try:
        yield
    finally:
        _shared_programs.reset(before)


@contextmanager
def without_cache_writes() -> Iterator[None]:
    """Write no program that is compiled inside to JAX's cache, so that a later compilation takes as long as without this."""
    threshold = "jax_persistent_cache_min_compile_time_secs"
    before = jax.config.values[threshold]
    jax.config.update(threshold, math.inf)
    try:
        yield
    finally:
        jax.config.update(threshold, before)


def compile_program(
    experiment: Experiment,
    layout: Layout,
    devices: list[Any],
    backend: Backend,
    columns: NamedArrays,
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

    def compile_backend() -> Program:
        if backend == "scan":
            return _compile_scan(experiment, layout, devices, columns)
        try:
            with raising_unsupported():
                return _compile_fused(experiment, layout, devices, tuple(columns), metric_names)
        except Unsupported as reason:
            if require_backend:
                raise InputError(f"--backend fused: the fused loop does not support {reason}; use --backend scan") from None
            return _compile_scan(experiment, layout, devices, columns)._replace(fallback_reason=str(reason))

    shared = _shared_programs.get()
    if shared is None:
        return compile_backend()
    # a program does not depend on the values of the lanes
    leaves, structure = jax.tree.flatten(set_leaves(experiment, dict.fromkeys(columns, np.zeros(()))))
    arrays = [np.asarray(leaf) for leaf in leaves]
    values = tuple((array.dtype, array.shape, array.tobytes()) for array in arrays)
    dtypes = tuple((path, column.dtype) for path, column in columns.items())
    key = layout, tuple(devices), backend, dtypes, metric_names, require_backend, structure, values
    return shared.take(key, compile_backend)


def can_run_fused(devices: Sequence[Any]) -> bool:
    """True if the fused loop supports some devices."""
    return devices[0].platform == "cpu" or (devices[0].platform == "gpu" and len(devices) == 1)


def _compile_fused(
    experiment: Experiment, layout: Layout, devices: list[Any], paths: tuple[str, ...], names: MetricNames
) -> Program:
    if not paths:
        raise Unsupported("lanes that differ only in their seed")
    platform = devices[0].platform
    if not can_run_fused(devices):
        raise Unsupported(f"{len(devices)} devices of platform {platform}")
    from jaxbl.fused.lane_simulator import DeviceSimulator, HostSimulator

    arguments = experiment, (metrics_reducer(names),), paths, layout.points
    with jax.default_device(devices[0]):
        on_host = platform == "cpu"
        simulator: LaneSimulator = HostSimulator(*arguments, len(devices)) if on_host else DeviceSimulator(*arguments)
        # compile the program that draws the noise, now and not with the first chunk
        next(simulator.compute_inputs(0))

    def run(values: NamedArrays, seeds: np.ndarray) -> tuple[NamedArrays, dict[str, ObserverGains]]:
        with jax.default_device(devices[0]):
            # seeds may repeat, as padding of the last chunk; the next chunk has probably the same ones
            unique_seeds = dict.fromkeys(int(seed) for seed in seeds)
            simulator.keep_seeds(unique_seeds)
            metrics = {seed: simulator(values, seed) for seed in unique_seeds}
        columns = {name: np.stack([metrics[int(seed)][name] for seed in seeds]) for name in metrics[int(seeds[0])]}
        return columns, observer_gains(set_leaves(experiment, values))

    item_size = jnp.result_type(experiment.run.sample_period).itemsize
    column_count = len(metric_columns(experiment, names)) * layout.seeds
    return Program(run, (simulator.carry_count + len(paths) + column_count) * layout.points * item_size / 1e6)


def _compile_scan(experiment: Experiment, layout: Layout, devices: list[Any], columns: NamedArrays) -> Program:
    def run_lane(values: TracedArrays, seed: Any) -> tuple[TracedArrays, Any]:
        lane_experiment = set_leaves(experiment, values)
        metrics, _ = scan(lane_experiment, seed, (ALL_METRICS,))
        return metrics, observer_gains(lane_experiment)

    # devices share the points, or else the seeds, if their number divides evenly; otherwise one device computes all
    seeds, points = layout
    count = len(devices)
    shape = (1, count) if points % count == 0 else (count, 1) if seeds % count == 0 else (1, 1)
    run_chunk = jax.shard_map(
        jax.vmap(jax.vmap(run_lane, in_axes=(0, None), axis_size=points // shape[1]), in_axes=(None, 0)),
        mesh=Mesh(np.array(devices[: math.prod(shape)]).reshape(shape), ("seeds", "points")),
        in_specs=(PartitionSpec("points"), PartitionSpec("seeds")),
        out_specs=PartitionSpec("seeds", "points"),
        check_vma=False,
    )
    example = {path: np.zeros(points, column.dtype) for path, column in columns.items()}, np.zeros(seeds, np.uint32)
    program = jax.jit(run_chunk).lower(*example).compile()
    memory = program.memory_analysis()
    byte_count = 0 if memory is None else memory.temp_size_in_bytes + memory.output_size_in_bytes
    return Program(program, byte_count / 1e6)
