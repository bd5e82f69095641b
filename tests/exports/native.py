"""Exported C compiled for this machine and called from Python; tests are skipped where a compiler is missing."""

import ctypes
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import pytest

from jaxbl.files import read_result

STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wdouble-promotion", "-Wconversion", "-Werror")
UNCONTRACTED = ("-ffp-contract=off",)
_CTYPES = {"float64": ctypes.c_double, "float32": ctypes.c_float, "int32": ctypes.c_int32, "bool": ctypes.c_bool}
_C_NAMES = {"float64": "double", "float32": "float"}

COMPILERS = [pytest.param(compiler, marks=pytest.mark.program(compiler)) for compiler in ("gcc", "clang")]


def run_program(*command, cwd=None, **options):
    """Run a program; what it says is shown where it fails."""
    result = subprocess.run(list(map(str, command)), cwd=cwd, capture_output=True, text=True, check=False, **options)
    assert result.returncode == 0, f"{' '.join(map(str, command))}\n{result.stdout[-4000:]}\n{result.stderr[-4000:]}"
    return result


def write_harness(summary, header=True):
    """C that runs many samples, with outputs as rows of real numbers."""
    name, real = summary["name"], "double"
    inputs, outputs = len(summary["inputs"]), len(summary["outputs"])
    casts = {key: [f"({_C_NAMES[port['type']]})" for port in summary[key]] for key in ("inputs", "first")}
    return "\n".join(
        [
            f'#include "{name}.h"',
            "#include <stddef.h>",
            f"size_t size_of_state(void); void begin({name}_state *s, const {real} *in);",
            f"void go({name}_state *s, long n, const {real} *in, {real} *out);",
            f"size_t size_of_state(void) {{ return sizeof({name}_state); }}",
            f"void begin({name}_state *s, const {real} *in)",
            f"{{ {name}_init(s, {', '.join(f'{cast}in[{i}]' for i, cast in enumerate(casts['first']))}); }}",
            f"void go({name}_state *s, long n, const {real} *in, {real} *out)",
            f"{{ long i; {name}_outputs o; for (i = 0; i < n; i++) {{",
            f"  {name}_step(s, {', '.join(f'{cast}in[i * {inputs} + {k}]' for k, cast in enumerate(casts['inputs']))}, &o);",
            *(f"  out[i * {outputs} + {k}] = (double)o.{output['name']};" for k, output in enumerate(summary["outputs"])),
            "} }",
            "",
        ]
    )


class Native:
    """Exported code of a folder, compiled; its state is a structure of ctypes."""

    def __init__(self, folder: Path, compiler="gcc", flags=("-O2", *UNCONTRACTED)):
        self.summary = read_result(folder / "export.json")
        name = self.summary["name"]
        build = Path(tempfile.mkdtemp(dir=folder))
        (build / "harness.c").write_text(write_harness(self.summary))
        objects = ["-I", folder, folder / f"{name}.c", build / "harness.c"]
        run_program(compiler, *STRICT, *flags, "-fPIC", "-shared", *objects, "-o", build / "code.so", "-lm")
        self._library = ctypes.CDLL(str(build / "code.so"))
        self._library.size_of_state.restype = ctypes.c_size_t
        self.dtype = np.dtype(np.float32 if self.summary["precision"] == "float" else np.float64)
        fields = [(quantity["name"], _CTYPES[quantity["type"]]) for quantity in self.summary["state"]]
        self.state = type("State", (ctypes.Structure,), {"_fields_": fields})()
        self.size = self._library.size_of_state()

    def start(self, first):
        first = np.asarray(first, self.dtype).astype(float)
        self._library.begin(ctypes.byref(self.state), first.ctypes.data_as(ctypes.c_void_p))

    def run(self, inputs):
        """Outputs (samples, outputs) of inputs (samples, inputs)."""
        inputs = np.ascontiguousarray(np.asarray(inputs, self.dtype), float)
        outputs = np.empty((len(inputs), len(self.summary["outputs"])))
        pointers = (array.ctypes.data_as(ctypes.c_void_p) for array in (inputs, outputs))
        self._library.go(ctypes.byref(self.state), ctypes.c_long(len(inputs)), *pointers)
        return outputs.astype(self.dtype)


def draw_samples(count, sides, period=1e-3, seed=0):
    """Inputs (samples, 1 + sides): a torque and positions with noise, as of a drive that swings through its gap."""
    time, noise = np.arange(count) * period, np.random.default_rng(seed)
    motor = 0.4 * np.sin(9.0 * time) + 0.2 * np.sin(23.0 * time) + 1e-4 * noise.standard_normal(count)
    load = (motor - 0.08 * np.tanh(8.0 * motor)) / 5.0 + 2e-5 * noise.standard_normal(count)
    torque = 0.3 * np.sin(9.0 * time + 0.5)
    return np.stack([torque, motor, load][: 1 + sides], axis=1)


def to_integers(values):
    """Numbers as integers, so that zeros of both signs differ."""
    return np.ascontiguousarray(values).view(f"i{values.dtype.itemsize}")
