"""The studies in C++: every sum of a run by the kernel, and the metrics that follow from them here."""

import ctypes
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.chain import block_length, unit_noise
from jaxbl.config import precision
from jaxbl.drive import get_leaf
from jaxbl.sweeps.metrics import window_start

from ..studies import BenchStudy
from ..workload import DRIVE, RANGES, SIDES, Metrics, chain_constants, identify_from_sums
from .cpp_chain import PADDING, array_pointers, compile_library

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
        self._function = compile_library(folder, "studies").study
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
