"""Compiled programs for the chunks of a study: the scan by XLA, or the fused loop."""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxbl.drive.parameters import set_leaves
from jaxbl.errors import InputError
from jaxbl.fused.llvm import Unsupported
from jaxbl.fused.passage import DevicePassage, HostPassage, Passage
from jaxbl.simulate import Experiment, scan

from .metrics import METRICS, Gains, observer_gains

Backend = Literal["fused", "scan"]
BACKENDS: tuple[Backend, ...] = ("fused", "scan")


def backend_of(name: str | None) -> Backend | None:
    """A backend by its name. Raises `InputError` for another."""
    for backend in BACKENDS:
        if backend == name:
            return backend
    if name is not None:
        raise InputError(f"--backend {name}: there is none; one of {', '.join(BACKENDS)}")
    return None


class Layout(NamedTuple):
    """Shape of a chunk: seeds and points."""

    seeds: int
    points: int


class Program(NamedTuple):
    """What runs a chunk.

    Attributes:
        run: from values by path `(points,)` and seeds `(seeds,)` to figures and gains, `(seeds, points)` each.
        megabytes: of memory that it takes.
    """

    run: Callable[[dict[str, np.ndarray], np.ndarray], tuple[dict[str, Any], dict[str, Gains]]]
    megabytes: float


def default_backend(devices: list[Any]) -> Backend:
    """The faster one on such devices."""
    return "fused" if devices[0].platform in ("cpu", "gpu") else "scan"


def compile_program(
    experiment: Experiment,
    layout: Layout,
    devices: list[Any],
    backend: Backend,
    columns: dict[str, np.ndarray],
    *,
    insist: bool = False,
) -> Program:
    """Compile one. Call inside :func:`jaxbl.study.engine.precision`.

    Args:
        experiment: with array leaves.
        layout: of its chunks.
        devices: that share a chunk.
        backend: where the fused loop has no instruction for something in the step, or no lane differs from another, the scan
            takes its place.
        columns: example of the values.
        insist: refuse that in place of it.

    Raises:
        InputError: the fused loop was insisted on and cannot be had.
    """
    if backend == "fused":
        try:
            if not columns:
                raise Unsupported("lanes that differ in nothing but their seed")
            return _fused(experiment, layout, devices, tuple(columns))
        except Unsupported as why:
            if insist:
                raise InputError(f"--backend fused: the fused loop does not know {why}; use --backend scan") from None
    return _scanned(experiment, layout, devices, columns)


def _fused(experiment: Experiment, layout: Layout, devices: list[Any], paths: tuple[str, ...]) -> Program:
    if devices[0].platform == "cpu":
        passage: Passage = HostPassage(experiment, (METRICS,), paths, len(devices))
    else:
        passage = DevicePassage(experiment, (METRICS,), paths)
    gains = jax.jit(jax.vmap(lambda values: observer_gains(set_leaves(experiment, values))))

    def run(values: dict[str, np.ndarray], seeds: np.ndarray) -> tuple[dict[str, Any], dict[str, Gains]]:
        figures = [passage(values, int(seed)) for seed in seeds]
        stacked = {name: jnp.asarray(np.stack([one[name] for one in figures])) for name in figures[0]}
        return stacked, gains(values)

    size = jnp.result_type(experiment.run.sample_period).itemsize
    return Program(run, (passage.carried + len(paths)) * layout.points * size / 1e6)


def _scanned(experiment: Experiment, layout: Layout, devices: list[Any], columns: dict[str, np.ndarray]) -> Program:
    def lane(values: dict[str, Any], seed: Any) -> tuple[dict[str, Any], Any]:
        experiment_of_lane = set_leaves(experiment, values)
        figures, _ = scan(experiment_of_lane, seed, (METRICS,))
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
