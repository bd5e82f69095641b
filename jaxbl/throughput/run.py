"""`jaxbl bench`: every entry on the same work, checked against one reference, then timed in turns."""

import importlib.util
import os
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxbl.errors import NoResult
from jaxbl.json_types import JsonObject
from jaxbl.workers import Progress, count_cores, make_stage_counter

from .jaxbl_chain import FusedChain, ScanChain
from .rivals.cpp_chain import CppChain, NoCompiler, compile_library, find_compiler
from .rivals.diffrax_chain import DiffraxChain
from .rivals.numba_chain import NumbaChain, compile_block_loop
from .rivals.numpy_chain import NumpyChain
from .workload import Metrics, Workload

Runner = Callable[[], Metrics]

CPP_NAME, FUSED_NAME, SCAN_NAME = "c++, all cores", "jaxbl fused, all cores", "jaxbl scan, all devices"
PRECISIONS = ("float32", "float64")
_REFERENCE_LANES = 64
"""Lanes, spread over all, that are compared with the reference: it is slow."""
_TOLERANCE: dict[str, dict[str, float]] = {
    "float64": {},
    # rounding decides some signs of a switching term; an error of one sample follows
    "float32": {"velocity_rmse": 1e-3, "stiffness": 0.02, "dead_zone": 0.05},
}
"""Largest median deviation of a figure from the reference, relative, if that is not 1e-8."""


class Entry(NamedTuple):
    """Who runs the workload, by its name in `bench.json` and on charts."""

    name: str
    make: Callable[[Workload], Runner]
    lanes: int  # that it is given, as many as it can bear
    module: str | None = None  # a module it cannot do without

    def prepare(self, workload: Workload) -> Runner:
        """Make the entry for a workload; it is made and called in the workload's precision."""
        enable_precision = partial(jax.enable_x64, workload.precision == "float64")
        with enable_precision():
            runner = self.make(workload)

        def run() -> Metrics:
            with enable_precision():
                return runner()

        return run


def make_entries(folder: Path, threads: int, devices: int) -> list[Entry]:
    """All of them; `folder` keeps the compiled kernel, `threads` are cores, `devices` JAX's."""
    many_lanes, few_lanes = 2**17, 2**14
    return [
        Entry(CPP_NAME, lambda w: CppChain(w, threads, folder), many_lanes),
        Entry("c++, one core", lambda w: CppChain(w, 1, folder), many_lanes),
        Entry(FUSED_NAME, lambda w: FusedChain(w, threads), many_lanes),
        Entry("jaxbl fused, one core", lambda w: FusedChain(w, 1), many_lanes),
        Entry(SCAN_NAME, lambda w: ScanChain(w, devices), few_lanes),
        Entry("jaxbl scan, one device", lambda w: ScanChain(w, 1), few_lanes),
        Entry("numba, blocks of lanes", lambda w: NumbaChain(w, threads), many_lanes, "numba"),
        Entry("diffrax, Euler, one device", DiffraxChain, few_lanes, "diffrax"),
        Entry("NumPy, lane arrays", NumpyChain, 2**12),
    ]


@dataclass
class BenchRow:
    """Times of an entry for a workload.

    Attributes:
        first_seconds: to make the entry and call it once, with tracing and compilation.
        deviation: largest relative median deviation of its metrics from the reference.
        seconds: time of each round.
        lane_steps_per_second, median_lane_steps_per_second: from the least and from the median time.
    """

    name: str
    precision: str
    lanes: int
    steps: int
    first_seconds: float
    deviation: float
    seconds: list[float]
    lane_steps_per_second: float = field(init=False)
    median_lane_steps_per_second: float = field(init=False)

    def __post_init__(self) -> None:
        work = self.lanes * self.steps
        self.lane_steps_per_second = work / min(self.seconds)
        self.median_lane_steps_per_second = work / statistics.median(self.seconds)


@dataclass(frozen=True)
class BenchResult:
    """All figures of a benchmark.

    Attributes:
        machine: processor, cores, versions.
        rows: of every entry and precision.
        curve: lane-steps per second over the number of lanes: {"name", "precision", "lanes", "lane_steps_per_second"}.
        study: seconds of a whole small study from nothing: {"name", "precision", "lanes", "steps", "seconds"}.
        left_out: entries that this machine cannot run, and what they need.
        failures: a sentence for each entry whose results are wrong; its time is not taken.
    """

    machine: JsonObject
    rows: list[BenchRow]
    curve: list[JsonObject]
    study: list[JsonObject]
    left_out: dict[str, str]
    failures: list[str] = field(default_factory=list)

    def find_speed(self, name: str, precision: str) -> float | None:
        """Return the lane-steps per second of an entry, None if it did not run."""
        speeds = [row.lane_steps_per_second for row in self.rows if (row.name, row.precision) == (name, precision)]
        return speeds[0] if speeds else None


def bench(*, quick: bool = False, progress: Progress | None = None) -> BenchResult:
    """Measure this machine: the paper's chain by everyone, in turns, each checked against one reference.

    Wrong results are not timed: the other entries are, and `failures` of the result says which are wrong.

    Args:
        quick: fewer rounds, shorter runs, rivals in one precision alone.
        progress: called with finished and all parts.

    Raises:
        NoResult: the results of every entry are wrong.
    """
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    with TemporaryDirectory() as folder, jax.default_device(jax.local_devices(backend="cpu")[0]):
        result = _measure(Path(folder), count_cores(), quick, progress)
    result.machine["load"] = load
    return result


def _measure(folder: Path, threads: int, quick: bool, progress: Progress | None) -> BenchResult:
    devices = len(jax.local_devices(backend="cpu"))
    runnable, left_out = _select_runnable(make_entries(folder, threads, devices), folder)
    steps, rounds = (1500, 3) if quick else (4000, 7)
    jobs = [(entry, precision) for precision in PRECISIONS for entry in runnable if _is_timed(entry, precision, quick)]
    curve_lanes = [2**k for k in (range(6, 19, 3) if quick else range(6, 21))]
    tick = make_stage_counter((1 + rounds) * len(jobs) + len(curve_lanes) + 1, progress)
    runners: list[Runner] = []
    untimed_rows: list[Callable[..., BenchRow]] = []
    failures: list[str] = []
    wrong_names: set[str] = set()
    reference = cache(_reference_metrics)
    for precision in PRECISIONS:
        Workload(1, steps, precision).inputs()
    for entry, precision in jobs:
        workload = Workload(entry.lanes // (8 if quick else 1), steps, precision)
        start_time = time.perf_counter()
        runner = entry.prepare(workload)
        metrics = runner()
        first_seconds = time.perf_counter() - start_time
        try:
            deviation = _check_entry(entry, precision, metrics, reference(workload.lanes, steps))
        except NoResult as error:
            failures.append(str(error))
            wrong_names.add(entry.name)
            for _ in range(1 + rounds):
                tick()
            continue
        runners.append(runner)
        untimed_rows.append(partial(BenchRow, entry.name, precision, workload.lanes, steps, first_seconds, deviation))
        tick()
    if not runners:
        raise NoResult(failures[0])
    seconds = _time_in_turns(runners, rounds, after_each=tick)
    del runners, runner
    rows = [make_row(durations) for make_row, durations in zip(untimed_rows, seconds, strict=True)]
    right_entries = [entry for entry in runnable if entry.name not in wrong_names]
    curve = []
    for lanes in curve_lanes:
        curve += _measure_curve(right_entries, lanes, 500 if quick else 1000, ("float32",) if quick else PRECISIONS)
        tick()
    small_study = _time_small_study(threads, devices, {entry.name for entry in right_entries}, 1000)
    tick()
    return BenchResult(_describe_machine(threads), rows, curve, small_study, left_out, failures)


def _is_timed(entry: Entry, precision: str, quick: bool) -> bool:
    return not quick or precision == "float32" or entry.name.startswith(("c++", "jaxbl fused"))


def _time_in_turns(
    runners: Sequence[Callable[[], Any]], rounds: int, in_a_row: int = 1, after_each: Callable[[], None] = lambda: None
) -> list[list[float]]:
    """Seconds of each runner's calls: in each round so many in a row, then `after_each`."""
    seconds: list[list[float]] = [[] for _ in runners]
    for _ in range(rounds):
        for runner, durations in zip(runners, seconds, strict=True):
            for _ in range(in_a_row):
                start = time.perf_counter()
                runner()
                durations.append(time.perf_counter() - start)
            after_each()
    return seconds


def _select_runnable(entries: Sequence[Entry], folder: Path) -> tuple[list[Entry], dict[str, str]]:
    left_out = {}
    try:
        compile_library(folder)
    except NoCompiler as reason:
        left_out = {entry.name: str(reason) for entry in entries if entry.name.startswith("c++")}
    for entry in entries:
        if entry.module is not None and importlib.util.find_spec(entry.module) is None:
            left_out[entry.name] = f"no {entry.module}; pip install 'jaxbl[bench]'"
    return [entry for entry in entries if entry.name not in left_out], left_out


def _spread_lanes(lanes: int) -> np.ndarray:
    """Lanes from all over, the first and the last among them."""
    return np.unique(np.linspace(0, lanes - 1, _REFERENCE_LANES).round().astype(int))


def _reference_metrics(lanes: int, steps: int) -> Metrics:
    """Figures of some of so many lanes by the plainest entry, in float64."""
    return NumpyChain(Workload(lanes, steps, "float64"), lanes=_spread_lanes(lanes))()


def _check_entry(entry: Entry, precision: str, metrics: Metrics, reference: Metrics) -> float:
    """Return the largest relative median deviation of a figure from the reference. Raises `NoResult` if it is too large."""
    deviations = {}
    for metric, expected in reference.items():
        values = np.asarray(metrics[metric], float)
        deviations[metric] = float(np.median(np.abs(values[_spread_lanes(len(values))] / expected - 1.0)))
        if not deviations[metric] <= _TOLERANCE[precision].get(metric.partition(".")[2], 1e-8):
            raise NoResult(
                f"{entry.name}, {precision}: {metric} is off by {deviations[metric]:.2g} of it; wrong results are not timed"
            )
    return max(deviations.values())


def _measure_curve(entries: Sequence[Entry], lanes: int, steps: int, precisions: Sequence[str]) -> list[JsonObject]:
    points = []
    curve_entries = [
        e for e in entries if e.name in (CPP_NAME, FUSED_NAME, SCAN_NAME) and (e.name != SCAN_NAME or lanes <= 2**17)
    ]
    # short ones are repeated, and several times in a row: threads that wait for more work disturb the next entry
    repeats = round(1e8 / lanes / steps)
    for precision in precisions:
        runners = [entry.prepare(Workload(lanes, steps, precision)) for entry in curve_entries]
        seconds = _time_in_turns(runners, max(5, min(15, repeats)), max(1, min(4, repeats)))
        for entry, durations in zip(curve_entries, seconds, strict=True):
            point = {"name": entry.name, "precision": precision, "lanes": lanes, "steps": steps}
            points.append(point | {"lane_steps_per_second": lanes * steps / min(durations)})
    return points


def _time_small_study(threads: int, devices: int, names: set[str], lanes: int) -> list[JsonObject]:
    """A small study from nothing: what was compiled before is forgotten."""
    rows = []
    workload = Workload(lanes, 3000, "float32")
    workload.inputs()
    with TemporaryDirectory() as folder:
        for entry in make_entries(Path(folder), threads, devices):
            if (
                entry.name not in names
                or entry.lanes <= lanes
                or entry.name.endswith(("one core", "jaxbl scan, one device"))
            ):
                continue
            jax.clear_caches()
            compile_block_loop.cache_clear()
            compile_library.cache_clear()
            ((seconds,),) = _time_in_turns([lambda entry=entry: entry.prepare(workload)()], 1)
            row = {"name": entry.name, "precision": workload.precision, "lanes": lanes, "steps": workload.steps}
            rows.append(row | {"seconds": seconds})
    return rows


def _describe_machine(threads: int) -> JsonObject:
    packages = ["jax", "numpy", "scipy", "llvmlite", "numba", "diffrax"]
    lines: list[str] = []
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "processor": names[0] if names else platform.processor(),
        "cores": threads,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": {name: version(name) for name in packages if importlib.util.find_spec(name) is not None},
        "compiler": Path(path).name if (path := find_compiler()) else None,
    }
