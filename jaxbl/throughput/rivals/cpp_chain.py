"""The C++ kernel: compiled here, called through ctypes."""

import ctypes
import os
import shutil
import subprocess
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from ..workload import INPUT, SEED, Workload, constants, identified_figures

_FLAGS = ("-std=c++20", "-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-fopenmp", "-shared", "-fPIC")
"""Fused multiply-add as the compiler likes (GCC's default), but no reordering: sums are compensated."""
SUMS = 9
"""Results of a lane, as chain.cpp numbers them."""


class _Constants(ctypes.Structure):
    _fields_ = [(name, ctypes.c_double) for name in constants() | INPUT]


def compiler() -> str | None:
    """The C++ compiler that `CXX` names, or g++; None without one."""
    return shutil.which(os.environ.get("CXX", "g++"))


class NoCompiler(Exception):
    """There is none, or it cannot compile the kernel."""


@cache
def library(folder: Path, name: str = "chain") -> ctypes.CDLL:
    """A kernel for this machine, compiled into a folder. Raises `NoCompiler`."""
    command = compiler()
    if command is None:
        raise NoCompiler("no C++ compiler; install g++, or name one in CXX")
    source, target = Path(__file__).with_name(f"{name}.cpp"), folder.resolve() / f"{name}.so"
    folder.mkdir(parents=True, exist_ok=True)
    # anew each time: what lies there may be another machine's
    draft = target.with_suffix(f".{os.getpid()}")
    done = subprocess.run([command, *_FLAGS, "-o", str(draft), str(source)], capture_output=True, text=True)
    if done.returncode:
        said = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        raise NoCompiler(f"{command} cannot compile {source.name}: {said[-1]}")
    draft.replace(target)
    return ctypes.CDLL(str(target))


WHOLE = 64
"""Lanes, or samples: whole vectors of the widest registers there are, two of them."""


class CppChain:
    """One workload, ready to run; arrays are the kernel's, so that a run allocates nothing. `own`: it makes input and noise
    by itself, of another seed each time; else they are given."""

    def __init__(self, workload: Workload, threads: int, folder: Path, *, own: bool = False):
        self.workload, self.threads, self._own, self._seeds = workload, threads, own, count(SEED)
        self._function = getattr(library(folder), f"chain_{workload.precision}")
        self._padded = -(-workload.lanes // WHOLE) * WHOLE
        values = [np.resize(column, self._padded) for column in workload.values().values()]
        self._given = [np.ascontiguousarray(column) for column in values]
        self._out = [np.zeros(self._padded, workload.dtype) for _ in range(SUMS)]
        if own:
            samples = -(-workload.steps // WHOLE) * WHOLE
            self._torque, self._noise = np.empty(samples, workload.dtype), np.empty((samples, 2), workload.dtype)
        else:
            self._torque, self._noise = map(np.ascontiguousarray, workload.inputs())
        self._constants = _Constants(**constants(), **INPUT)
        self._table = [pointers(arrays) for arrays in (self._given, self._out)]

    def __call__(self) -> dict[str, np.ndarray]:
        w = self.workload
        self._function(
            ctypes.byref(self._constants), w.steps, w.start, w.window, self._torque.ctypes, self._noise.ctypes,
            self._padded, *self._table, self.threads, self._own, next(self._seeds),
        )  # fmt: skip
        return identified_figures(w, [sums[: w.lanes] for sums in self._out])


def pointers(arrays: list[np.ndarray]) -> Any:
    """Where arrays lie, for a kernel."""
    return (ctypes.c_void_p * len(arrays))(*[array.ctypes.data for array in arrays])
