"""Two of the package's studies as they stand beside C++ that does the same work: float64, implicit observers, ten plant
steps a sample, several seeds, every metric of the run. Gain conditions, which follow from the metrics, are left out.

    python benchmarks/studies_in_cpp.py [--steps 10000] [--rounds 7] [--threads 2]

Both give the same figures, or nothing is timed. They take turns, and the least time of each counts.
"""

import argparse
import ctypes
import math
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from jaxbl.workers import count_cores, start_jax

start_jax()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from jaxbl.chain import Experiment, NamedArrays, block_length, unit_noise  # noqa: E402
from jaxbl.config import Config, precision, prepare, read_config  # noqa: E402
from jaxbl.drive import get_leaf  # noqa: E402
from jaxbl.errors import NoResult  # noqa: E402
from jaxbl.json_types import JsonObject  # noqa: E402
from jaxbl.sweeps.metrics import window_start  # noqa: E402
from jaxbl.sweeps.points import Points  # noqa: E402
from jaxbl.sweeps.programs import Layout, Program, compile_program  # noqa: E402
from jaxbl.throughput.rivals.cpp_chain import PADDING, array_pointers, compile_library  # noqa: E402
from jaxbl.throughput.workload import (  # noqa: E402
    DRIVE,
    RANGES,
    SIDES,
    Metrics,
    chain_constants,
    identify_from_sums,
)

STUDIES = "gain_map", "dead_zone_noise"
"""Names of the studies in `sweeps/`."""


class BenchStudy(NamedTuple):
    """One of the studies, with runs of so many samples: what is shared, and each lane's values `(lanes,)` by path."""

    config: Config
    experiment: Experiment
    values: NamedArrays

    @property
    def seeds(self) -> int:
        return self.config.sweep.seeds

    @property
    def lanes(self) -> int:
        """Number of lanes of each seed."""
        return len(next(iter(self.values.values())))


def prepare_study(name: str, steps: int, lanes: int | None = None, identifier_start: float | None = None) -> BenchStudy:
    """Prepare one of :data:`STUDIES` with runs of `steps` samples.

    Args:
        name: of the study.
        steps: samples of a run.
        lanes: number of lanes, spread over all of the study; None for all.
        identifier_start: time at which identifiers begin, s; None for that of the study.
    """
    config = read_config(Path(__file__).parents[1] / "sweeps" / f"{name}.toml")
    config = config.with_keys("run", duration=steps * config.run.sample_period)
    if identifier_start is not None:
        assert config.identifier is not None
        config = config.with_keys("identifier", start=identifier_start)
    points = Points(config)
    with precision(config):
        indices = np.linspace(0, points.group_size - 1, lanes or points.group_size).round().astype(int)
        return BenchStudy(config, prepare(config), points.columns(indices))


class FusedStudy:
    """The program of a sweep on all cores, with a study in one chunk; each call takes other seeds."""

    def __init__(self, study: BenchStudy):
        self._study, self._round = study, 0
        devices, layout = jax.local_devices(backend="cpu"), Layout(study.seeds, study.lanes)
        with precision(study.config):
            self._program: Program = compile_program(
                study.experiment, layout, devices, "fused", study.values, require_backend=True
            )

    def __call__(self) -> Metrics:
        """Figures `(seeds, lanes)` by name."""
        first_seed = self._round * self._study.seeds
        self._round += 1
        with precision(self._study.config):
            metrics, _ = self._program.run(self._study.values, np.arange(first_seed, first_seed + self._study.seeds))
        return metrics


_NUMBER_NAMES = *chain_constants(), "position_tolerance", "velocity_tolerance"
_COUNT_NAMES = "steps", "substeps", "block", "start", "window"
_CARRY = (
    "last", "position", "velocity", "torque", "position_size", "velocity_size", "chatter", "previous", "perturbation",
    "acceleration",
)  # fmt: skip
_SUM_COUNT = 7
"""Results of a lane: carries of the metrics of both sides, and sums of the identifiers."""


class _StudyConstants(ctypes.Structure):
    _fields_ = [(name, ctypes.c_double) for name in _NUMBER_NAMES] + [(name, ctypes.c_int64) for name in _COUNT_NAMES]


class CppStudy:
    """A study, ready to run by so many threads, `vectors` of lanes at a time; the input is given.

    `makes_noise`: True to draw noise in C++, with other seeds at each call; False to take jaxbl's noise.
    """

    def __init__(self, study: BenchStudy, threads: int, folder: Path, vectors: int = 2, *, makes_noise: bool = True):
        self._study, self._threads, self._vectors, self._makes_noise, self._round = study, threads, vectors, makes_noise, 0
        self._function = compile_library(folder, Path(__file__).with_name("studies.cpp")).study
        pointer, number, long_integer = ctypes.c_void_p, ctypes.c_int, ctypes.c_int64
        self._function.argtypes = [*[pointer] * 4, number, number, long_integer, *[pointer] * 2, number, number]
        experiment, run = study.experiment, study.config.run
        law: Any = experiment.transmission
        numbers = {
            "period": run.sample_period,
            **{name: float(getattr(experiment.drive, name)) for name in DRIVE},
            "stiffness": float(law.stiffness),
            "slope": float(law.slope),
            "share": -np.expm1(-run.sample_period / float(experiment.equivalent_control.time_constant)),
            "motor_error": float(experiment.observer.motor.velocity_error),
            "position_tolerance": run.position_tolerance,
            "velocity_tolerance": run.velocity_tolerance,
        }
        assert experiment.identifier is not None
        self._window = window_start(run.steps)
        start = round(float(experiment.identifier.start) / run.sample_period)
        counts = (run.steps, run.substeps, block_length(run.steps), start, self._window)
        self._constants = _StudyConstants(**numbers, **dict(zip(_COUNT_NAMES, counts, strict=True)))
        self._has_lane_plants = any(path.startswith(("transmission.", "drive.")) for path in study.values)
        lanes = -(-study.lanes // PADDING) * PADDING
        # studies.cpp numbers what lanes may differ in as `RANGES` does
        self._values = [
            np.resize(study.values.get(path, [float(get_leaf(experiment, path))]), lanes).astype(float) for path in RANGES
        ]
        self._out = [np.zeros(lanes) for _ in range(2 * len(_CARRY) + _SUM_COUNT)]
        with precision(study.config):
            times = jnp.arange(run.steps, dtype=float) * run.sample_period
            self._torque = np.asarray(jax.vmap(experiment.excitation)(times), float)
        self._noise = np.zeros((-(-run.steps // PADDING) * PADDING, 2))
        self._samples = np.zeros((run.steps, 7))
        self._table = array_pointers(self._values), array_pointers(self._out)

    def __call__(self) -> Metrics:
        """Figures `(seeds, lanes)` by name."""
        first = self._round * self._study.seeds
        self._round += self._makes_noise
        runs = [self._run(seed) for seed in range(first, first + self._study.seeds)]
        return {name: np.stack([run[name] for run in runs]) for name in runs[0]}

    def _run(self, seed: int) -> Metrics:
        if not self._makes_noise:
            noise = unit_noise(jnp.asarray(seed), jnp.arange(self._study.config.run.steps, dtype=jnp.int32), SIDES)
            self._noise[: self._study.config.run.steps] = np.stack([noise[side] for side in SIDES], axis=1)
        self._function(
            ctypes.byref(self._constants), self._torque.ctypes.data, self._noise.ctypes.data, self._samples.ctypes.data,
            len(self._values[0]), int(self._has_lane_plants), seed if self._makes_noise else -1, *self._table, self._threads,
            self._vectors,
        )  # fmt: skip
        study, run = self._study, self._study.config.run
        out = [column[: study.lanes] for column in self._out]
        gap, sums = self._values[4][: study.lanes], out[2 * len(_CARRY) :]
        twist_squares, products, bend_squares = sums[:3]
        correlation = products / (np.sqrt(twist_squares) * np.sqrt(bend_squares))
        identified = identify_from_sums(sums)
        count, metrics = run.steps - self._window, {}
        for i, side in enumerate(SIDES):
            carry = dict(zip(_CARRY, out[i * len(_CARRY) :], strict=False))
            stiffness, dead_zone = identified[side]
            converged = carry["last"] < (self._window - 0.5) * run.sample_period
            entered = np.where(carry["last"] < 0.0, 0.0, carry["last"] + run.sample_period)
            metrics |= {
                f"{side}.converged": converged,
                f"{side}.convergence_time": np.where(converged, entered, np.nan),
                **{f"{side}.{name}_rmse": np.sqrt(carry[name] / count) for name in ("position", "velocity", "torque")},
                **{f"{side}.{name}": np.sqrt(carry[name] / count) for name in ("position_size", "velocity_size")},
                f"{side}.chatter": np.sqrt(0.5 * carry["chatter"] / count),
                f"{side}.f_plus": carry["perturbation"].copy(),
                f"{side}.f_plus_acceleration": 2.0 * carry["acceleration"],
                f"{side}.stiffness_error": stiffness / self._constants.stiffness - 1.0,
                f"{side}.dead_zone_error": dead_zone / gap - 1.0,
                f"{side}.excitation": 1.0 - np.abs(correlation),
            }
        return metrics


def compare_study(name: str, folder: Path, threads: int, steps: int, rounds: int, lanes: int | None = None) -> JsonObject:
    """A study as it stands by this package and in C++, after a look at whether both give the same figures.

    Args:
        name: of the study.
        folder: for the compiled kernel.
        threads: threads.
        steps: samples of a run.
        rounds: that are timed, in turns.
        lanes: left out, all of the study's.

    Raises:
        NoResult: they do not.
    """
    # a noisy observer amplifies rounding: number by number the figures are the same only over a short run
    short_study = prepare_study(name, _SHORT_STEPS, lanes, identifier_start=0.1)
    reference = CppStudy(short_study, threads, folder, makes_noise=False)()
    deviation = check_run_metrics(name, FusedStudy(short_study)(), reference)
    full_study = prepare_study(name, steps, lanes)
    runners = [FusedStudy(full_study), *(CppStudy(full_study, threads, folder, vectors) for vectors in _VECTOR_COUNTS)]
    check_medians(name, *(runner() for runner in runners[:2]))
    best = [math.inf] * len(runners)
    for _ in range(rounds):
        for i, runner in enumerate(runners):
            start = time.perf_counter()
            runner()
            best[i] = min(best[i], time.perf_counter() - start)
    row = {"name": name, "lanes": full_study.lanes, "seeds": full_study.seeds, "steps": steps, "deviation": deviation}
    lane_steps = full_study.lanes * full_study.seeds * steps
    return row | {"jaxbl": lane_steps / best[0], "c++": lane_steps / min(best[1:])}


_TOLERANCE: dict[str, float] = dict.fromkeys(("stiffness_error", "dead_zone_error", "excitation"), 1e-5)
"""Largest median deviation of a figure from the reference, relative, if that is not 1e-8: a short run determines the law's
parameters badly."""
_SHORT_STEPS = 400
"""Samples of the run by which the figures of a study are compared number by number."""
_NAN_SHARE = 1e-3
"""Largest share of runs (1) in which a figure is NaN in only one implementation. At the border of convergence rounding
decides whether a run has a convergence time; it does for 3e-4 of the runs of gain_map."""
_VECTOR_COUNTS = 1, 2, 4
"""That the kernel of a study takes at a time: the fastest counts."""


def check_run_metrics(name: str, metrics: Metrics, reference: Metrics) -> float:
    """Compare the figures of a study with those of the reference, run by run.

    A run in which both are NaN counts as equal. Runs in which only one is NaN are counted, and left out of the median.

    Args:
        name: of the study.
        metrics: by figure, an array with a number for each run.
        reference: the same by the other implementation.

    Returns:
        The largest median deviation of a figure, relative.

    Raises:
        NoResult: a median, or the share of runs in which only one number is NaN, is too large.
    """
    largest = 0.0
    for metric, column in reference.items():
        values, expected = np.asarray(metrics[metric], float), np.asarray(column, float)
        only_one_nan = np.isnan(values) != np.isnan(expected)
        nan_share = float(np.mean(only_one_nan))
        if nan_share > _NAN_SHARE:
            raise NoResult(
                f"{name}: {metric} is NaN in only one implementation in {nan_share:.2g} of the runs, "
                f"more than {_NAN_SHARE:g}; wrong results are not timed"
            )
        deviations = np.abs(values - expected) / np.maximum(np.abs(expected), np.finfo(float).tiny)
        median = float(np.median(np.where(np.isnan(expected), 0.0, deviations)[~only_one_nan]))
        if not median <= _TOLERANCE.get(metric.partition(".")[2], 1e-8):
            raise NoResult(f"{name}: {metric} is off by {median:.2g} of it; wrong results are not timed")
        largest = max(largest, median)
    return largest


def check_medians(name: str, metrics: Metrics, reference: Metrics) -> None:
    """Raises `NoResult` where the median of a figure over all runs is not that of the reference; errors of identified
    parameters, which are about zero, do not count."""
    for metric, expected in reference.items():
        if metric.endswith("_error"):
            continue
        median, expected_median = (float(np.nanmedian(np.asarray(values, float))) for values in (metrics[metric], expected))
        if not abs(median - expected_median) <= 0.05 * abs(expected_median):
            raise NoResult(
                f"{name}: {metric} has a median of {median:.3g}, not {expected_median:.3g}; wrong results are not timed"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--steps", type=int, default=10_000, help="samples of a run; identifiers begin at 5000")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--threads", type=int, default=count_cores())
    args = parser.parse_args()
    print("study, seeds and lanes, lane-steps/s of jaxbl and of C++, and their ratio")
    with TemporaryDirectory() as folder:
        for name in STUDIES:
            row = compare_study(name, Path(folder), args.threads, args.steps, args.rounds)
            ours, theirs = row["jaxbl"], row["c++"]
            print(f"{name:16} {row['seeds']} x {row['lanes']:5d}   {ours:.3g} {theirs:.3g} {ours / theirs:.2f}", flush=True)


if __name__ == "__main__":
    main()
