"""The studies in C++: every sum of a run by the kernel, and the metrics that follow from them here."""

import ctypes
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.config import precision
from jaxbl.drive import get_leaf
from jaxbl.simulate import block_length, unit_noise
from jaxbl.sweeps.metrics import window_start

from ..studies import Study
from ..workload import SIDES
from .cpp_chain import WHOLE, library, pointers

_NUMBERS = (
    "period", "motor_inertia", "motor_viscous", "load_inertia", "load_viscous", "gear_ratio", "stiffness", "slope", "share",
    "motor_error", "position_tolerance", "velocity_tolerance",
)  # fmt: skip
_COUNTS = "steps", "substeps", "block", "start", "window"
_GIVEN = (
    "observer.motor.alpha", "observer.motor.lambda", "observer.load.alpha", "observer.load.lambda", "transmission.dead_zone",
    "encoders.noise",
)  # fmt: skip
"""What lanes may differ in, as studies.cpp numbers it."""
_CARRIED = (
    "last", "position", "velocity", "torque", "position_size", "velocity_size", "chatter", "previous", "perturbation",
    "acceleration",
)  # fmt: skip
_SUMS = 7
"""Results of a lane: carries of the metrics of both sides, and sums of the identifiers."""


class _Study(ctypes.Structure):
    _fields_ = [(name, ctypes.c_double) for name in _NUMBERS] + [(name, ctypes.c_int64) for name in _COUNTS]


class CppStudy:
    """A study, ready to run by so many threads, `vectors` of lanes at a time; the input is given.

    `own`: it makes noise by itself, of other seeds at each call; else it is given jaxbl's, of the study's seeds.
    """

    def __init__(self, of: Study, threads: int, folder: Path, vectors: int = 2, *, own: bool = True):
        self._study, self._threads, self._vectors, self._own_noise, self._round = of, threads, vectors, own, 0
        self._function = library(folder, "studies").study
        pointer, number, whole = ctypes.c_void_p, ctypes.c_int, ctypes.c_int64
        self._function.argtypes = [*[pointer] * 4, number, number, whole, *[pointer] * 2, number, number]
        e, run = of.experiment, of.config.run
        law: Any = e.transmission
        numbers = {
            "period": run.sample_period,
            **{name: float(getattr(e.drive, name)) for name in _NUMBERS[1:6]},
            "stiffness": float(law.stiffness),
            "slope": float(law.slope),
            "share": -np.expm1(-run.sample_period / float(e.equivalent_control.time_constant)),
            "motor_error": float(e.observer.motor.velocity_error),
            "position_tolerance": run.position_tolerance,
            "velocity_tolerance": run.velocity_tolerance,
        }
        assert e.identifier is not None
        self._window = window_start(run.steps)
        start = round(float(e.identifier.start) / run.sample_period)
        counts = (run.steps, run.substeps, block_length(run.steps), start, self._window)
        self._constants = _Study(**numbers, **dict(zip(_COUNTS, counts, strict=True)))
        self._own_plant = any(path.startswith(("transmission.", "drive.")) for path in of.values)
        lanes = -(-of.lanes // WHOLE) * WHOLE
        self._given = [np.resize(of.values.get(path, [float(get_leaf(e, path))]), lanes).astype(float) for path in _GIVEN]
        self._out = [np.zeros(lanes) for _ in range(2 * len(_CARRIED) + _SUMS)]
        with precision(of.config):
            times = jnp.arange(run.steps, dtype=float) * run.sample_period
            self._torque = np.asarray(jax.vmap(e.excitation)(times), float)
        self._noise = np.zeros((-(-run.steps // WHOLE) * WHOLE, 2))
        self._samples = np.zeros((run.steps, 7))
        self._table = pointers(self._given), pointers(self._out)

    def __call__(self) -> dict[str, np.ndarray]:
        """Figures `(seeds, lanes)` by name."""
        first = self._round * self._study.seeds
        self._round += self._own_noise
        runs = [self._run(seed) for seed in range(first, first + self._study.seeds)]
        return {name: np.stack([run[name] for run in runs]) for name in runs[0]}

    def _run(self, seed: int) -> dict[str, np.ndarray]:
        if not self._own_noise:
            noise = unit_noise(jnp.asarray(seed), jnp.arange(self._study.config.run.steps, dtype=jnp.int32), SIDES)
            self._noise[: self._study.config.run.steps] = np.stack([noise[side] for side in SIDES], axis=1)
        self._function(
            ctypes.byref(self._constants), self._torque.ctypes.data, self._noise.ctypes.data, self._samples.ctypes.data,
            len(self._given[0]), int(self._own_plant), seed if self._own_noise else -1, *self._table, self._threads,
            self._vectors,
        )  # fmt: skip
        of, run = self._study, self._study.config.run
        out = [column[: of.lanes] for column in self._out]
        gap, (first, both, second) = self._given[4][: of.lanes], out[2 * len(_CARRIED) : 2 * len(_CARRIED) + 3]
        size = np.sqrt(first) * np.sqrt(second)
        correlation = both / size
        determinant = 1.0 - correlation * correlation
        count, figures = run.steps - self._window, {}
        for i, side in enumerate(SIDES):
            carried = dict(zip(_CARRIED, out[i * len(_CARRIED) :], strict=False))
            one, two = (out[2 * len(_CARRIED) + 3 + 2 * i + j] / np.sqrt(root) for j, root in enumerate((first, second)))
            stiffness = (one - correlation * two) / (determinant * np.sqrt(first))
            product = (two - correlation * one) / (determinant * np.sqrt(second))
            converged = carried["last"] < (self._window - 0.5) * run.sample_period
            entered = np.where(carried["last"] < 0.0, 0.0, carried["last"] + run.sample_period)
            figures |= {
                f"{side}.converged": converged,
                f"{side}.convergence_time": np.where(converged, entered, np.nan),
                **{f"{side}.{name}_rmse": np.sqrt(carried[name] / count) for name in ("position", "velocity", "torque")},
                **{f"{side}.{name}": np.sqrt(carried[name] / count) for name in ("position_size", "velocity_size")},
                f"{side}.chatter": np.sqrt(0.5 * carried["chatter"] / count),
                f"{side}.f_plus": carried["perturbation"].copy(),
                f"{side}.f_plus_acceleration": 2.0 * carried["acceleration"],
                f"{side}.stiffness_error": stiffness / self._constants.stiffness - 1.0,
                f"{side}.dead_zone_error": product / stiffness / gap - 1.0,
                f"{side}.excitation": 1.0 - np.abs(correlation),
            }
        return figures
