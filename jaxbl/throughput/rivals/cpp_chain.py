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

from ..workload import SEED, SINE, Metrics, Workload, chain_constants, metrics_from_sums

_COMPILER_FLAGS = (
    "-std=c++20",
    "-O3",
    "-march=native",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fopenmp",
    "-shared",
    "-fPIC",
)
"""Fused multiply-add as the compiler likes (GCC's default), but no reordering: sums are compensated."""
_KERNEL = Path(__file__).with_name("chain.cpp")
SUMS = 9
"""Results of a lane, as chain.cpp numbers them."""


class _Constants(ctypes.Structure):
    _fields_ = [(name, ctypes.c_double) for name in chain_constants() | SINE]


def find_compiler() -> str | None:
    """The C++ compiler that `CXX` names, or g++; None without one."""
    return shutil.which(os.environ.get("CXX", "g++"))


class NoCompiler(Exception):
    """There is none, or it cannot compile the kernel."""


@cache
def compile_library(folder: Path, source: Path = _KERNEL) -> ctypes.CDLL:
    """Compile a kernel for this machine into a folder. Raises `NoCompiler`."""
    command = find_compiler()
    if command is None:
        raise NoCompiler("no C++ compiler; install g++, or name one in CXX")
    target = folder.resolve() / f"{source.stem}.so"
    folder.mkdir(parents=True, exist_ok=True)
    # anew each time: what lies there may be another machine's
    draft = target.with_suffix(f".{os.getpid()}")
    arguments = [*_COMPILER_FLAGS, f"-I{Path(__file__).parent}", "-o", str(draft), str(source)]
    process = subprocess.run([command, *arguments], capture_output=True, text=True)
    if process.returncode:
        messages = process.stderr.strip().splitlines() or [f"exit code {process.returncode}"]
        raise NoCompiler(f"{command} cannot compile {source.name}: {messages[-1]}")
    draft.replace(target)
    return ctypes.CDLL(str(target))


PADDING = 64
"""Lanes, or samples: whole vectors of the widest registers there are, two of them."""


class CppChain:
    """A workload, ready to run. The arrays are the kernel's, so that a run allocates nothing.

    `makes_inputs`: True to make input and noise in C++, with another seed each time; False to take jaxbl's.
    """

    def __init__(self, workload: Workload, threads: int, folder: Path, *, makes_inputs: bool = False):
        self.workload, self.threads, self._makes_inputs, self._seeds = workload, threads, makes_inputs, count(SEED)
        self._function = getattr(compile_library(folder), f"chain_{workload.precision}")
        self._padded = -(-workload.lanes // PADDING) * PADDING
        values = [np.resize(column, self._padded) for column in workload.values().values()]
        self._values = [np.ascontiguousarray(column) for column in values]
        self._out = [np.zeros(self._padded, workload.dtype) for _ in range(SUMS)]
        if makes_inputs:
            samples = -(-workload.steps // PADDING) * PADDING
            self._torque, self._noise = np.empty(samples, workload.dtype), np.empty((samples, 2), workload.dtype)
        else:
            self._torque, self._noise = map(np.ascontiguousarray, workload.inputs())
        self._constants = _Constants(**chain_constants(), **SINE)
        self._table = [array_pointers(arrays) for arrays in (self._values, self._out)]

    def __call__(self) -> Metrics:
        workload = self.workload
        self._function(
            ctypes.byref(self._constants), workload.steps, workload.start, workload.window, self._torque.ctypes,
            self._noise.ctypes, self._padded, *self._table, self.threads, self._makes_inputs, next(self._seeds),
        )  # fmt: skip
        return metrics_from_sums(workload, [sums[: workload.lanes] for sums in self._out])


def array_pointers(arrays: list[np.ndarray]) -> Any:
    """Return the addresses of arrays for a kernel."""
    return (ctypes.c_void_p * len(arrays))(*[array.ctypes.data for array in arrays])
