"""What a study takes on either backend, before anything of it is compiled: how much its step does, counted in its traced
form, times what this machine takes for that, measured once and kept with the compiled programs.

Backends differ in roundings. Numbers that are counted and remembered choose the same one each time; a short run of the study
itself would not, where the two are close.
"""

import functools
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.config import Config, precision, prepare, read_config
from jaxbl.drive.parameters import get_leaf, set_leaves
from jaxbl.fused import program_cache
from jaxbl.simulate import Experiment, scan
from jaxbl.workers import announce

from .metrics import MetricNames, metrics_reducer
from .programs import BACKENDS, Backend, Layout, compile_program, without_cache_writes


class Operations(NamedTuple):
    """What a sample takes, in operations that count as much as a sum: those that all lanes share, and each lane's own; the
    bytes that a lane carries from sample to sample; and how many equations there are to compile."""

    shared: float
    lane: float
    carried: float
    equations: int


class Cost(NamedTuple):
    """Seconds that a backend takes for a sample, for each operation of it whatever the number of lanes, and for each
    operation of each lane; and to compile an equation."""

    sample: float
    operation: float
    lane: float
    equation: float


class Costs(NamedTuple):
    """Of both backends; `cache`: bytes that the lanes of a device may carry where the scan is fastest."""

    fused: Cost
    scan: Cost
    cache: float

    def of(self, backend: Backend) -> Cost:
        """Of a backend."""
        return self.fused if backend == "fused" else self.scan

    def compile_seconds(self, backend: Backend, work: Operations) -> float:
        """Seconds to compile a program."""
        return self.of(backend).equation * work.equations

    def sample(self, backend: Backend, work: Operations, layout: Layout) -> float:
        """Seconds of a sample of a chunk. The fused loop takes seed after seed, and does for each what its lanes share; the
        scan has all lanes side by side, and starts kernels for all operations."""
        seeds, points = layout
        cost = self.of(backend)
        lanes = cost.lane * work.lane * seeds * points
        if backend == "fused":
            return seeds * (cost.sample + cost.operation * work.shared) + lanes
        return cost.sample + cost.operation * (work.shared + work.lane) + lanes

    def lanes(self, backend: Backend, work: Operations, devices: int) -> int:
        """Lanes that a device computes at once: by the scan as many as its cache holds, by the fused loop so many that what
        they share counts little."""
        if backend == "scan":
            wanted = self.cache / max(work.carried, 1.0)
        else:
            shared = self.fused.sample + self.fused.operation * work.shared
            wanted = shared / (_SHARE * self.fused.lane * max(work.lane, 1.0)) / devices
        return 2 ** round(math.log2(min(max(wanted, _LANES[0]), _LANES[1])))


_SHARE = 0.03
"""Of a sample's time, what lanes share."""
_LANES = 2**10, 2**16
"""The fewest and the most that a processor's core computes at once."""
_LANES_ON_A_GPU = 2**18
"""By either backend: some 2000 lanes for each of its processors, which is what keeps all of it busy."""

_CPU = Costs(Cost(0.5e-6, 2e-9, 0.02e-9, 3e-4), Cost(0.0, 4e-9, 0.05e-9, 2e-3), 1e6)
"""Where nothing is kept: two cores of an AMD EPYC with AVX-512 (benchmarks/NOTES.md)."""
_GPU = Costs(Cost(1e-6, 0.0, 0.0, 0.0), Cost(8e-6, 0.0, 0.0, 0.0), 0.0)
"""What a sample takes, published for a scan by XLA; not measured here."""


def load_costs(devices: Sequence[Any]) -> Costs:
    """Of these devices. Of a processor's cores they are measured, once for this machine and what is installed on it, where
    programs are kept."""
    if devices[0].platform != "cpu":
        return _GPU
    key = program_cache.program_key("costs", len(devices))
    if key is None:
        return _CPU
    found = program_cache.load(key)
    if found is None:
        announce("measuring this machine")
        found = measure_costs(list(devices))
        program_cache.save(key, found)
        announce("running")
    return found


def lanes_at_once(devices: Sequence[Any], backend: Backend, work: Operations) -> int:
    """Lanes that a device computes at once where nothing else is asked for."""
    return _LANES_ON_A_GPU if devices[0].platform == "gpu" else load_costs(devices).lanes(backend, work, len(devices))


def choose_backend(
    devices: Sequence[Any],
    works: Mapping[Backend, Operations],
    layouts: Mapping[Backend, Layout],
    samples: Mapping[Backend, int],
    programs: int,
) -> Backend:
    """The backend that takes less time to compile so many programs, and to take chunks of these shapes through so many
    samples in all."""
    if devices[0].platform not in ("cpu", "gpu") or (devices[0].platform == "gpu" and len(devices) > 1):
        # the fused loop knows neither
        return "scan"
    known = load_costs(devices)

    def total(backend: Backend) -> float:
        running = samples[backend] * known.sample(backend, works[backend], layouts[backend])
        return programs * known.compile_seconds(backend, works[backend]) + running

    return min(BACKENDS, key=total)


def count_operations(config: Config, paths: Sequence[str], names: MetricNames = None) -> Operations:
    """Count what a sample takes where these paths differ from lane to lane, and some metrics are computed, or all."""
    with precision(config):
        experiment = prepare(config)
        key = program_cache.hash_program("work", experiment, tuple(paths), names)
        # a study of many sweeps asks for the same one, also where nothing is kept on disk
        found = _works.get(key) or program_cache.load(key)
        if found is None:
            found = _count_traced_operations(experiment, paths, names)
            program_cache.save(key, found)
        if key is not None:
            _works[key] = found
    return found


_works: dict[str | None, Operations] = {}


_COUNTED = 1009
"""Lanes of the program that is counted: a length that no other array has."""
_FREE = ("broadcast_in_dim", "reshape", "squeeze", "convert_element_type", "slice", "copy", "copy_p", "transpose", "iota")
_WEIGHTS = {
    **dict.fromkeys(_FREE, 0.0),
    **dict.fromkeys(("div", "sqrt", "rsqrt", "rem"), 5.0),
    **dict.fromkeys(("exp", "expm1", "exp2", "log", "log1p", "logistic", "tanh", "sin", "cos", "tan", "atan2", "pow"), 20.0),
    **dict.fromkeys(("erf_inv", "random_bits", "threefry2x32"), 40.0),
}
"""What an operation takes of a processor, about, where that is not as much as a sum."""


def _count_traced_operations(experiment: Experiment, paths: Sequence[str], names: MetricNames) -> Operations:
    def lane(values: dict[str, Any], seed: Any) -> dict[str, Any]:
        return scan(set_leaves(experiment, values), seed, (metrics_reducer(names),))[0]

    one = jax.ShapeDtypeStruct((_COUNTED,), jnp.result_type(experiment.run.sample_period))
    traced = jax.make_jaxpr(jax.vmap(lane, (0, None), axis_size=_COUNTED))(
        dict.fromkeys(paths, one), jax.ShapeDtypeStruct((), np.uint32)
    )
    shared = own = carried = 0.0
    equations = 0
    for times, eqn in _equations(traced.jaxpr, 1.0):
        by_lane = [v.aval for v in eqn.outvars if _COUNTED in v.aval.shape]
        if times == 0.0:
            carried = max(carried, sum(aval.size * aval.dtype.itemsize for aval in by_lane) / _COUNTED)
            continue
        equations += 1
        work = times * _WEIGHTS.get(eqn.primitive.name, 1.0) * max((v.aval.size for v in eqn.outvars), default=0)
        if by_lane:
            own += work / _COUNTED
        else:
            shared += work
    steps = experiment.run.steps
    return Operations(shared / steps, own / steps, carried, equations)


def _equations(jaxpr: Any, times: float) -> Iterator[tuple[float, Any]]:
    """How often each equation is evaluated; a loop itself with a zero, before what is in it."""
    for eqn in jaxpr.eqns:
        inner = [one for value in eqn.params.values() for one in _jaxprs(value)]
        if not inner:
            yield times, eqn
            continue
        loop = eqn.primitive.name == "scan"
        if loop:
            yield 0.0, eqn
        for one in inner:
            yield from _equations(one, times * (eqn.params["length"] if loop else 1))


def _jaxprs(value: Any) -> list[Any]:
    if isinstance(value, tuple | list):
        return [one for each in value for one in _jaxprs(each)]
    value = getattr(value, "jaxpr", value)
    return [value] if hasattr(value, "eqns") else []


_STUDY = {
    "drive": {"kind": "rigid", "motor_inertia": 0.05, "motor_viscous": 0.15},
    "excitation": {"kind": "sine", "amplitude": 1.0, "frequency": 1.0},
    "encoders": {"noise": 1e-4},
    "observer": {"motor": {"lambda": 20.0, "alpha": 400.0}},
    "run": {"duration": 0.512, "sample_period": 1e-3, "substeps": 10},
}
"""What is measured: small, as it is compiled for several numbers of lanes."""
_PATHS = "observer.motor.lambda", "drive.motor_inertia"
"""What differs from lane to lane: a gain, so that lanes share the plant, or an inertia, so that each has its own."""
_FEW, _MANY, _MORE = 16, 2**12, 2**14
"""Lanes of a device."""
_ROUNDS = 5

Tried = tuple[Backend, str, int]
"""Backend, path, and number of lanes."""


def measure_costs(devices: list[Any]) -> Costs:
    """Costs of this machine, from short runs of a small study."""
    # here, as it takes a quarter of a second, once
    from scipy.optimize import nnls

    config, count = read_config(_STUDY), len(devices)
    works = {path: count_operations(config, [path]) for path in _PATHS}
    few, many, more = _FEW * count, _MANY * count, _MORE * count
    # few scans: XLA compiles longer than they run
    fused: list[Tried] = [("fused", path, lanes) for path in _PATHS for lanes in (few, many)]
    scans: list[Tried] = [("scan", _PATHS[0], lanes) for lanes in (few, many, more)]
    took, compiling = _time_programs(config, devices, [*fused, *scans, ("scan", _PATHS[1], many)])

    def cost(backend: Backend) -> Cost:
        rows = []
        for (which, path, lanes), seconds in took.items():
            if which == backend and lanes != more:
                work = works[path]
                fixed = [1.0, work.shared] if backend == "fused" else [0.0, work.shared + work.lane]
                rows.append(np.array([*fixed, work.lane * lanes]) / seconds)
        # by their ratio to what was measured, each counts as much
        table, size = np.stack(rows), np.max(rows, axis=0)
        size[size == 0.0] = 1.0
        found, _ = nnls(table / size, np.ones(len(rows)))
        sample, operation, lane = (found / size).tolist()
        return Cost(sample, operation, lane, compiling[backend] / works[_PATHS[0]].equations)

    fits = took["scan", _PATHS[0], more] / more < 1.15 * took["scan", _PATHS[0], many] / many
    return Costs(cost("fused"), cost("scan"), (_MORE if fits else _MANY) * works[_PATHS[0]].carried)


def _time_programs(
    config: Config, devices: list[Any], wanted: Sequence[Tried]
) -> tuple[dict[Tried, float], dict[Backend, float]]:
    """Seconds that a sample takes, the least of some rounds in turns; and those that a backend takes to compile."""
    runs, compiling = {}, dict.fromkeys(BACKENDS, math.inf)
    with precision(config), without_cache_writes():
        experiment = prepare(config)
        for backend, path, count in wanted:
            columns = {path: np.full(count, get_leaf(experiment, path))}
            begun = time.perf_counter()
            program = compile_program(experiment, Layout(1, count), devices, backend, columns)
            # the least: the first one also loads what compiles
            compiling[backend] = min(compiling[backend], time.perf_counter() - begun)
            runs[backend, path, count] = functools.partial(program.run, columns, np.zeros(1, np.uint32))
        least = dict.fromkeys(runs, math.inf)
        for _ in range(_ROUNDS):
            for one, run in runs.items():
                begun = time.perf_counter()
                jax.block_until_ready(run())
                least[one] = min(least[one], (time.perf_counter() - begun) / config.run.steps)
    return least, compiling
