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
from jaxbl.workers import Progress, count_cores

from .jaxbl_chain import FusedChain, ScanChain
from .rivals.cpp_chain import CppChain, NoCompiler, compiler, library
from .rivals.cpp_studies import CppStudy
from .rivals.diffrax_chain import DiffraxChain
from .rivals.numba_chain import NumbaChain, forget
from .rivals.python_chain import PythonChain
from .studies import STUDIES, FusedStudy, study
from .workload import Workload

Runner = Callable[[], dict[str, np.ndarray]]

CEILING, OURS, SCAN = "c++, all cores", "jaxbl fused, all cores", "jaxbl scan, all devices"
PRECISIONS = ("float32", "float64")
_REFERENCE_LANES = 64
"""Lanes, spread over all, that are compared with the reference: it is slow."""
_TOLERANCE = {
    "float64": dict.fromkeys(("velocity_rmse", "stiffness", "dead_zone"), 1e-8),
    # rounding decides some signs of a switching term; an error of one sample follows
    "float32": {"velocity_rmse": 1e-3, "stiffness": 0.02, "dead_zone": 0.05},
}
"""Largest median deviation of a figure from the reference, relative."""


class Entry(NamedTuple):
    """Who runs the workload, by its name in `bench.json` and on charts."""

    name: str
    make: Callable[[Workload], Runner]
    lanes: int  # that it is given, as many as it can bear
    needs: str | None = None  # a module it cannot do without
    tolerance: float = 0.0  # of its own method, where it does not take the reference's steps


def entries(folder: Path, count: int, devices: int) -> list[Entry]:
    """All of them; `folder` keeps the compiled kernel, `count` are cores, `devices` JAX's."""
    many, few = 2**17, 2**14
    return [
        Entry(CEILING, lambda w: CppChain(w, count, folder), many),
        Entry("c++, one core", lambda w: CppChain(w, 1, folder), many),
        Entry(OURS, lambda w: FusedChain(w, count), many),
        Entry("jaxbl fused, one core", lambda w: FusedChain(w, 1), many),
        Entry(SCAN, lambda w: ScanChain(w, devices), few),
        Entry("jaxbl scan, one device", lambda w: ScanChain(w, 1), few),
        Entry("numba, blocks of lanes", lambda w: NumbaChain(w, count, blocked=True), many, "numba"),
        Entry("numba, prange", lambda w: NumbaChain(w, count, blocked=False), few, "numba"),
        Entry("diffrax, Euler, one device", DiffraxChain, few, "diffrax"),
        Entry("NumPy, lane arrays", PythonChain, 2**12),
        Entry("NumPy, one lane", PythonChain, 1),
        Entry("Python numbers, one lane", partial(PythonChain, numbers=True), 1),
        Entry("OpenSMC, one lane", partial(PythonChain, numbers=True, library=True), 1, "opensmc"),
        Entry("SciPy RK45, one lane", partial(PythonChain, numbers=True, solver="RK45"), 1, tolerance=1e-3),
        Entry("SciPy LSODA, one lane", partial(PythonChain, numbers=True, solver="LSODA"), 1, tolerance=1e-3),
    ]


@dataclass
class Row:
    """What an entry took for a workload.

    Attributes:
        first_seconds: of making it and calling it once: tracing and compilation included.
        deviation: largest median deviation of its figures from the reference, relative.
        seconds: of each round.
        lane_steps_per_second, median_lane_steps_per_second: by the least of them, and by their median.
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
        studies: lane-steps per second of studies as they stand: {"name", "lanes", "seeds", "steps", "deviation", "jaxbl",
            "c++"}.
        left_out: entries that this machine cannot run, and what they need.
        failures: a sentence for each entry or study whose results are wrong; its time is not taken.
    """

    machine: dict[str, Any]
    rows: list[Row]
    curve: list[dict[str, Any]]
    study: list[dict[str, Any]]
    studies: list[dict[str, Any]]
    left_out: dict[str, str]
    failures: list[str] = field(default_factory=list)

    def speed(self, name: str, precision: str) -> float | None:
        """Lane-steps per second of an entry, None if it did not run."""
        found = [row.lane_steps_per_second for row in self.rows if (row.name, row.precision) == (name, precision)]
        return found[0] if found else None


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
        found = _bench(Path(folder), count_cores(), quick, progress)
    found.machine["load"] = load
    return found


def _bench(folder: Path, count: int, quick: bool, progress: Progress | None) -> BenchResult:
    devices = len(jax.local_devices(backend="cpu"))
    able, left_out = _able(entries(folder, count, devices), folder)
    steps, rounds = (1500, 3) if quick else (4000, 7)
    jobs = [(entry, precision) for precision in PRECISIONS for entry in able if _is_run(entry, precision, quick)]
    lanes = [2**k for k in (range(6, 19, 3) if quick else range(6, 21))]
    compared = list(STUDIES) if any(entry.name == CEILING for entry in able) else []
    parts, done = (1 + rounds) * len(jobs) + len(lanes) + 1 + len(compared), 0

    def tick(count: int = 1) -> None:
        nonlocal done
        done += count
        if progress is not None:
            progress(done, parts)

    checked: list[tuple[Any, ...]] = []
    runners: list[Runner] = []
    failures: list[str] = []
    wrong: set[str] = set()
    reference = cache(_reference)
    for precision in PRECISIONS:
        with _in(precision):
            Workload(1, steps, precision).inputs()
    for entry, precision in jobs:
        work = Workload(entry.lanes // (8 if quick and entry.lanes > 1 else 1), steps, precision)
        with _in(precision):
            start = time.perf_counter()
            runner = entry.make(work)
            figures = runner()
            first = time.perf_counter() - start
        try:
            deviation = _check(entry, precision, figures, reference(work.lanes, steps))
        except NoResult as error:
            failures.append(str(error))
            wrong.add(entry.name)
            tick(1 + rounds)
            continue
        runners.append(runner)
        checked.append((entry.name, precision, work.lanes, steps, first, deviation))
        tick()
    if not checked:
        raise NoResult(failures[0])
    seconds: list[list[float]] = [[] for _ in checked]
    for _ in range(rounds):
        for (_, precision, *_), runner, durations in zip(checked, runners, seconds, strict=True):
            with _in(precision):
                durations.append(_seconds(runner))
            tick()
    del runners, runner
    rows = [Row(*columns, seconds=durations) for columns, durations in zip(checked, seconds, strict=True)]
    right = [entry for entry in able if entry.name not in wrong]
    curve = []
    for many in lanes:
        curve += _curve(right, many, 500 if quick else 1000, ("float32",) if quick else PRECISIONS)
        tick()
    small = _small_study(count, devices, {entry.name for entry in right}, 1000)
    tick()
    studies = []
    for name in compared:
        try:
            studies.append(compare(name, folder, count, 6000 if quick else 10_000, rounds))
        except NoResult as error:
            failures.append(str(error))
        tick()
    return BenchResult(_machine(count), rows, curve, small, studies, left_out, failures)


def _is_run(entry: Entry, precision: str, quick: bool) -> bool:
    # one lane in float32 proves nothing: rounding decides signs, and there are no others to take the median of
    if entry.lanes == 1:
        return precision == "float64"
    return not quick or precision == "float32" or entry.name.startswith(("c++", "jaxbl fused"))


def _seconds(runner: Callable[[], Any]) -> float:
    begun = time.perf_counter()
    runner()
    return time.perf_counter() - begun


def _in(precision: str) -> Any:
    return jax.enable_x64(precision == "float64")


def _able(found: Sequence[Entry], folder: Path) -> tuple[list[Entry], dict[str, str]]:
    left_out = {}
    try:
        library(folder)
    except NoCompiler as why:
        left_out = {entry.name: str(why) for entry in found if entry.name.startswith("c++")}
    for entry in found:
        if entry.needs is not None and importlib.util.find_spec(entry.needs) is None:
            left_out[entry.name] = f"no {entry.needs}; pip install 'jaxbl[bench]'"
    return [entry for entry in found if entry.name not in left_out], left_out


def _spread(lanes: int) -> np.ndarray:
    """Lanes from all over, the first and the last among them."""
    return np.unique(np.linspace(0, lanes - 1, _REFERENCE_LANES).round().astype(int))


def _reference(lanes: int, steps: int) -> dict[str, np.ndarray]:
    """Figures of some of so many lanes by the plainest entry, in float64."""
    with _in("float64"):
        return PythonChain(Workload(lanes, steps, "float64"), chosen=_spread(lanes))()


def _check(entry: Entry, precision: str, figures: dict[str, np.ndarray], reference: dict[str, np.ndarray]) -> float:
    worst = 0.0
    for name, values in figures.items():
        found, true = np.asarray(values, float)[_spread(len(values))], reference[name]
        apart = float(np.median(np.abs(found / true - 1.0)))
        if not apart <= max(entry.tolerance, _TOLERANCE[precision][name.partition(".")[2]]):
            raise NoResult(f"{entry.name}, {precision}: {name} is off by {apart:.2g} of it; wrong results are not timed")
        worst = max(worst, apart)
    return worst


def _curve(able: Sequence[Entry], lanes: int, steps: int, precisions: Sequence[str]) -> list[dict[str, Any]]:
    points = []
    for precision in precisions:
        chosen = [e for e in able if e.name in (CEILING, OURS, SCAN) and (e.name != SCAN or lanes <= 2**17)]
        with _in(precision):
            runners = [entry.make(Workload(lanes, steps, precision)) for entry in chosen]
            best = [float("inf")] * len(chosen)
            # short ones are repeated, and several times in a row: threads that wait for more work disturb the next entry
            short = round(1e8 / lanes / steps)
            for _ in range(max(5, min(15, short))):
                for i, runner in enumerate(runners):
                    best[i] = min(best[i], *(_seconds(runner) for _ in range(max(1, min(4, short)))))
        for entry, least in zip(chosen, best, strict=True):
            point = {"name": entry.name, "precision": precision, "lanes": lanes, "steps": steps}
            points.append(point | {"lane_steps_per_second": lanes * steps / least})
    return points


def _small_study(count: int, devices: int, able: set[str], lanes: int) -> list[dict[str, Any]]:
    """A small study from nothing: what was compiled before is forgotten."""
    rows = []
    work = Workload(lanes, 3000, "float32")
    with _in(work.precision), TemporaryDirectory() as folder:
        work.inputs()
        for entry in entries(Path(folder), count, devices):
            if (
                entry.name not in able
                or entry.lanes <= lanes
                or entry.name in ("c++, one core", "jaxbl fused, one core", "jaxbl scan, one device")
            ):
                continue
            jax.clear_caches()
            forget()
            library.cache_clear()
            row = {"name": entry.name, "precision": work.precision, "lanes": lanes, "steps": work.steps}
            rows.append(row | {"seconds": _seconds(lambda entry=entry: entry.make(work)())})
    return rows


def compare(name: str, folder: Path, count: int, steps: int, rounds: int, lanes: int | None = None) -> dict[str, Any]:
    """A study as it stands by this package and in C++, after a look at whether both give the same figures.

    Args:
        name: of the study.
        folder: for the compiled kernel.
        count: threads.
        steps: samples of a run.
        rounds: that are timed, in turns.
        lanes: left out, all of the study's.

    Raises:
        NoResult: they do not.
    """
    # a noisy observer amplifies rounding: number by number the figures are the same only over a short run
    short = study(name, _SHORT, lanes, start=0.1)
    deviation = check_study(name, FusedStudy(short)(), CppStudy(short, count, folder, own=False)())
    work = study(name, steps, lanes)
    runners = [FusedStudy(work), *(CppStudy(work, count, folder, vectors) for vectors in _VECTORS)]
    check_medians(name, *(runner() for runner in runners[:2]))
    least = [float("inf")] * len(runners)
    for _ in range(rounds):
        for i, runner in enumerate(runners):
            least[i] = min(least[i], _seconds(runner))
    row = {"name": name, "lanes": work.lanes, "seeds": work.seeds, "steps": steps, "deviation": deviation}
    return row | {"jaxbl": work.lane_steps / least[0], "c++": work.lane_steps / min(least[1:])}


_SHORT = 400
"""Samples of the run by which the figures of a study are compared number by number."""
_NAN_SHARE = 1e-3
"""Largest share of runs (1) in which a figure is NaN in only one implementation. At the border of convergence rounding
decides whether a run has a convergence time; it does for 3e-4 of the runs of gain_map."""
_VECTORS = 1, 2, 4
"""That the kernel of a study takes at a time: the fastest counts."""


def check_study(name: str, found: dict[str, Any], reference: dict[str, np.ndarray]) -> float:
    """Compare the figures of a study with those of the reference, run by run.

    A run in which both are NaN counts as equal. Runs in which only one is NaN are counted, and left out of the median.

    Args:
        name: of the study.
        found: by figure, an array with a number for each run.
        reference: the same by the other implementation.

    Returns:
        The largest median deviation of a figure, relative.

    Raises:
        NoResult: a median, or the share of runs in which only one number is NaN, is too large.
    """
    largest = 0.0
    for figure, column in reference.items():
        values, true = np.asarray(found[figure], float), np.asarray(column, float)
        both_nan = np.isnan(values) & np.isnan(true)
        only_one_nan = np.isnan(values) ^ np.isnan(true)
        nan_share = float(np.mean(only_one_nan))
        if nan_share > _NAN_SHARE:
            raise NoResult(
                f"{name}: {figure} is NaN in only one implementation in {nan_share:.2g} of the runs, "
                f"more than {_NAN_SHARE:g}; wrong results are not timed"
            )
        deviations = np.abs(values - true) / np.maximum(np.abs(true), np.finfo(float).tiny)
        median = float(np.median(np.where(both_nan, 0.0, deviations)[~only_one_nan]))
        # a short run determines the law's parameters badly
        if not median <= (1e-5 if figure.endswith(("_error", "excitation")) else _TOLERANCE["float64"]["velocity_rmse"]):
            raise NoResult(f"{name}: {figure} is off by {median:.2g} of it; wrong results are not timed")
        largest = max(largest, median)
    return largest


def check_medians(name: str, found: dict[str, Any], reference: dict[str, np.ndarray]) -> None:
    """Raises `NoResult` where the median of a figure over all runs is not that of the reference; errors of identified
    parameters, which are about zero, do not count."""
    for figure, true in reference.items():
        if figure.endswith("_error"):
            continue
        one, other = (float(np.nanmedian(np.asarray(values, float))) for values in (found[figure], true))
        if not abs(one - other) <= 0.05 * abs(other):
            raise NoResult(f"{name}: {figure} has a median of {one:.3g}, not {other:.3g}; wrong results are not timed")


def _machine(count: int) -> dict[str, Any]:
    packages = ["jax", "numpy", "scipy", "llvmlite", "numba", "diffrax", "opensmc"]
    lines: list[str] = []
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "processor": names[0] if names else platform.processor(),
        "cores": count,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": {name: version(name) for name in packages if importlib.util.find_spec(name) is not None},
        "compiler": Path(found).name if (found := compiler()) else None,
    }
