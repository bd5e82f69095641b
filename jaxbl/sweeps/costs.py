"""Predicted run time of a study on either backend, before anything of it is compiled.

The operations of a sample are counted in its traced step; what an operation costs on this machine is measured once, and
stored with the compiled programs.

Backends round differently, so that the same study should always get the same backend. Counts and stored costs do not change;
a short run of the study would choose at random where the backends are equally fast.
"""

import functools
import math
import time
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.chain import Experiment, TracedArrays, scan
from jaxbl.config import Config, precision, prepare, read_config
from jaxbl.drive.parameters import get_leaf, set_leaves
from jaxbl.fused import program_cache
from jaxbl.workers import announce

from .metrics import MetricNames, metrics_reducer
from .programs import BACKENDS, Backend, Layout, compile_program, without_cache_writes


class Operations(NamedTuple):
    """Operations of a sample, in units of an addition.

    Attributes:
        shared: operations that all lanes share.
        lane: operations of each lane.
        carried: bytes that a lane carries from sample to sample.
        equations: number of equations to compile.
    """

    shared: float
    lane: float
    carried: float
    equations: int


class Cost(NamedTuple):
    """Seconds that a backend takes.

    Attributes:
        sample: for a sample.
        operation: for an operation of a sample, apart from the number of lanes.
        lane: for an operation of one lane.
        equation: to compile an equation.
    """

    sample: float
    operation: float
    lane: float
    equation: float


class Costs(NamedTuple):
    """Costs of both backends; with up to `cache` bytes carried by the lanes of a device the scan is fastest."""

    fused: Cost
    scan: Cost
    cache: float

    def of(self, backend: Backend) -> Cost:
        """The cost of a backend."""
        return getattr(self, backend)

    def study_seconds(self, backend: Backend, operations: Operations, layout: Layout, samples: int, programs: int) -> float:
        """Seconds to compile the programs of a study, and for the samples of all its chunks."""
        compile_seconds = programs * self.of(backend).equation * operations.equations
        return compile_seconds + samples * self.sample_seconds(backend, operations, layout)

    def sample_seconds(self, backend: Backend, operations: Operations, layout: Layout) -> float:
        """Seconds for a sample of a chunk.

        The fused loop takes one seed after the other, and computes for each what its lanes share. The scan has all lanes
        side by side, and starts kernels for all operations.
        """
        seeds, points = layout
        cost = self.of(backend)
        lane_seconds = cost.lane * operations.lane * seeds * points
        if backend == "fused":
            return seeds * (cost.sample + cost.operation * operations.shared) + lane_seconds
        return cost.sample + cost.operation * (operations.shared + operations.lane) + lane_seconds

    def best_lanes(self, backend: Backend, operations: Operations, devices: int) -> int:
        """Number of lanes that a device should compute at once.

        For the scan, as many as its cache holds. For the fused loop, so many that the operations that they share take little
        of the time.
        """
        if backend == "scan":
            lanes = self.cache / max(operations.carried, 1.0)
        else:
            shared_seconds = self.fused.sample + self.fused.operation * operations.shared
            lanes = shared_seconds / (_SHARED_TIME * self.fused.lane * max(operations.lane, 1.0)) / devices
        return 2 ** round(math.log2(min(max(lanes, _MIN_LANES), _MAX_LANES)))


_SHARED_TIME = 0.03
"""Share of a sample's time that operations shared by all lanes may take."""
_MIN_LANES, _MAX_LANES = 2**10, 2**16
"""Limits of the lanes that a processor's core computes at once."""
_GPU_LANES = 2**18
"""Lanes for either backend: some 2000 for each of the GPU's processors keep all of them busy."""

_CPU = Costs(Cost(0.5e-6, 2e-9, 0.02e-9, 3e-4), Cost(0.0, 4e-9, 0.05e-9, 2e-3), 1e6)
"""Costs if none can be stored: two cores of an AMD EPYC with AVX-512 (benchmarks/NOTES.md)."""
_GPU = Costs(Cost(1e-6, 0.0, 0.0, 0.0), Cost(8e-6, 0.0, 0.0, 0.0), 0.0)
"""Costs of a sample as published for scans by XLA; not measured here."""


def load_costs(devices: Sequence[Any]) -> Costs:
    """The costs of devices: for a processor's cores as measured on this machine, if programs are stored; else typical ones.

    They are measured once for this machine and the versions that are installed.
    """
    if devices[0].platform != "cpu":
        return _GPU
    key = program_cache.program_key("costs", len(devices))
    if key is None:
        return _CPU
    costs = program_cache.load(key)
    if costs is None:
        announce("measuring the speed of this computer")
        costs = measure_costs(list(devices))
        program_cache.save(key, costs)
        announce("running")
    return costs


def lanes_at_once(devices: Sequence[Any], backend: Backend, operations: Operations) -> int:
    """Number of lanes that a device computes at once unless the study sets it."""
    return _GPU_LANES if devices[0].platform == "gpu" else load_costs(devices).best_lanes(backend, operations, len(devices))


def count_operations(config: Config, paths: Sequence[str], names: MetricNames = None) -> Operations:
    """Count the operations of a sample.

    Args:
        config: the study.
        paths: paths whose values differ from lane to lane.
        names: metrics that are computed; None for all.
    """
    with precision(config):
        experiment = prepare(config)
        key = program_cache.hash_program("work", experiment, tuple(paths), names)
        # a search runs many sweeps with the same operations; this also helps if nothing is stored on disk
        operations = _counted_operations.get(key) or program_cache.load(key)
        if operations is None:
            operations = _trace_operations(experiment, paths, names)
            program_cache.save(key, operations)
        if key is not None:
            _counted_operations[key] = operations
    return operations


_counted_operations: dict[str | None, Operations] = {}


_TRACED_LANES = 1009
"""Lanes of the traced program: a prime, so that arrays with an axis of lanes are told from others by their shape."""
_WEIGHTS = {
    **dict.fromkeys(
        (
            "broadcast_in_dim",
            "reshape",
            "squeeze",
            "convert_element_type",
            "slice",
            "copy",
            "copy_p",
            "transpose",
            "iota",
        ),
        0.0,
    ),
    **dict.fromkeys(("div", "sqrt", "rsqrt", "rem"), 5.0),
    **dict.fromkeys(("exp", "expm1", "exp2", "log", "log1p", "logistic", "tanh", "sin", "cos", "tan", "atan2", "pow"), 20.0),
    **dict.fromkeys(("erf_inv", "random_bits", "threefry2x32"), 40.0),
}
"""Rough cost of operations on a processor, in units of an addition; 1 if not listed."""


def _trace_operations(experiment: Experiment, paths: Sequence[str], names: MetricNames) -> Operations:
    """Trace a run of many lanes, and count its operations for each sample."""

    def run_lane(values: TracedArrays, seed: Any) -> TracedArrays:
        return scan(set_leaves(experiment, values), seed, (metrics_reducer(names),))[0]

    column = jax.ShapeDtypeStruct((_TRACED_LANES,), jnp.result_type(experiment.run.sample_period))
    traced = jax.make_jaxpr(jax.vmap(run_lane, (0, None), axis_size=_TRACED_LANES))(
        dict.fromkeys(paths, column), jax.ShapeDtypeStruct((), np.uint32)
    )
    shared = per_lane = carried = 0.0
    equations = 0
    for repetitions, eqn in _equations(traced.jaxpr, 1.0):
        lane_avals = [v.aval for v in eqn.outvars if _TRACED_LANES in v.aval.shape]
        if repetitions == 0.0:
            carried = max(carried, sum(aval.size * aval.dtype.itemsize for aval in lane_avals) / _TRACED_LANES)
            continue
        equations += 1
        size = max((v.aval.size for v in eqn.outvars), default=0)
        operations = repetitions * _WEIGHTS.get(eqn.primitive.name, 1.0) * size
        if lane_avals:
            per_lane += operations / _TRACED_LANES
        else:
            shared += operations
    steps = experiment.run.steps
    return Operations(shared / steps, per_lane / steps, carried, equations)


def _equations(jaxpr: Any, repetitions: float) -> Iterator[tuple[float, Any]]:
    """Yield each equation with the number of times that it is evaluated; a loop with 0, before the equations in it."""
    for eqn in jaxpr.eqns:
        inner_jaxprs = [
            jaxpr for param in jax.tree.leaves(eqn.params) if hasattr(jaxpr := getattr(param, "jaxpr", param), "eqns")
        ]
        if not inner_jaxprs:
            yield repetitions, eqn
            continue
        is_loop = eqn.primitive.name == "scan"
        if is_loop:
            yield 0.0, eqn
        for inner in inner_jaxprs:
            yield from _equations(inner, repetitions * (eqn.params["length"] if is_loop else 1))


_STUDY = {
    "drive": {"kind": "rigid", "motor_inertia": 0.05, "motor_viscous": 0.15},
    "excitation": {"kind": "sine", "amplitude": 1.0, "frequency": 1.0},
    "encoders": {"noise": 1e-4},
    "observer": {"motor": {"lambda": 20.0, "alpha": 400.0}},
    "run": {"duration": 0.512, "sample_period": 1e-3, "substeps": 10},
}
"""The study that is timed: small, since it is compiled for several numbers of lanes."""
_PATHS = "observer.motor.lambda", "drive.motor_inertia"
"""The path that differs from lane to lane: a gain, so that lanes share the plant, or an inertia, so that none do."""
_FEW_LANES, _CACHED_LANES, _MORE_LANES = 16, 2**12, 2**14
"""Lanes of a device in timed programs: few, as many as are taken to fit its cache, and more."""
_ROUNDS = 5

TimedCase = tuple[Backend, str, int]
"""Backend, path, and number of lanes of a program that is timed."""


def measure_costs(devices: list[Any]) -> Costs:
    """Measure the costs of this machine by short runs of a small study."""
    # imported here, as it takes a quarter of a second and is needed once
    from scipy.optimize import nnls

    config, count = read_config(_STUDY), len(devices)
    operations = {path: count_operations(config, [path]) for path in _PATHS}
    few, cached, more = _FEW_LANES * count, _CACHED_LANES * count, _MORE_LANES * count
    # few scans: XLA compiles longer than they run
    cases: list[TimedCase] = [
        *(("fused", path, lanes) for path in _PATHS for lanes in (few, cached)),
        *(("scan", _PATHS[0], lanes) for lanes in (few, cached, more)),
        ("scan", _PATHS[1], cached),
    ]
    sample_seconds, compile_seconds = _time_programs(config, devices, cases)

    def fit_cost(backend: Backend) -> Cost:
        rows = []
        for (case_backend, path, lanes), seconds in sample_seconds.items():
            if case_backend == backend and lanes != more:
                shared, per_lane = operations[path].shared, operations[path].lane
                fixed = [1.0, shared] if backend == "fused" else [0.0, shared + per_lane]
                # divided by the time, so that relative errors are fitted
                rows.append(np.array([*fixed, per_lane * lanes]) / seconds)
        scale = np.max(rows, axis=0)
        scale[scale == 0.0] = 1.0
        solution, _ = nnls(np.stack(rows) / scale, np.ones(len(rows)))
        sample, operation, lane = (solution / scale).tolist()
        return Cost(sample, operation, lane, compile_seconds[backend] / operations[_PATHS[0]].equations)

    more_seconds, cached_seconds = (sample_seconds["scan", _PATHS[0], lanes] / lanes for lanes in (more, cached))
    more_fit = more_seconds < 1.15 * cached_seconds
    cache = (_MORE_LANES if more_fit else _CACHED_LANES) * operations[_PATHS[0]].carried
    return Costs(fit_cost("fused"), fit_cost("scan"), cache)


def _time_programs(
    config: Config, devices: list[Any], cases: Sequence[TimedCase]
) -> tuple[dict[TimedCase, float], dict[Backend, float]]:
    """Seconds of a sample for each case, the least of several rounds in turns; and seconds to compile for each backend."""
    runs, compile_seconds = {}, dict.fromkeys(BACKENDS, math.inf)
    with precision(config), without_cache_writes():
        experiment = prepare(config)
        for backend, path, lanes in cases:
            columns = {path: np.full(lanes, get_leaf(experiment, path))}
            start = time.perf_counter()
            program = compile_program(experiment, Layout(1, lanes), devices, backend, columns)
            # the least: the first compilation also loads the compiler
            compile_seconds[backend] = min(compile_seconds[backend], time.perf_counter() - start)
            runs[backend, path, lanes] = functools.partial(program.run, columns, np.zeros(1, np.uint32))
        sample_seconds = dict.fromkeys(runs, math.inf)
        for _ in range(_ROUNDS):
            for case, run in runs.items():
                start = time.perf_counter()
                jax.block_until_ready(run())
                sample_seconds[case] = min(sample_seconds[case], (time.perf_counter() - start) / config.run.steps)
    return sample_seconds, compile_seconds
