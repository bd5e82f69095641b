"""Exported FMUs against `jaxbl simulate`: free runs of every study in sweeps/, of hard impacts, and time for a sample.

`python benchmarks/fmu.py` prints the figures of docs/fmu.md. Needs cc and the extra `fmu`.
"""

import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pandas as pd

import jaxbl
from jaxbl.config import read_config

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from small_study import small_study

SWEEPS = Path(__file__).parents[1] / "sweeps"
IMPACTS = {
    "drive": {
        "kind": "two_inertia",
        "motor_inertia": 0.05,
        "motor_viscous": 0.01,
        "load_inertia": 0.5,
        "load_viscous": 0.02,
        "gear_ratio": 2.0,
    },
    "transmission": {"law": "dead_zone", "stiffness": 30.0, "half_gap": 0.05},
    "excitation": {"kind": "sine", "amplitude": 1.0, "frequency": 1.3},
}
"""A light load behind a stiff gear with a gap: impacts amplify the last digit."""
SAMPLES = 200_000


def write_fmu(study: Any, folder: str) -> tuple[str, float]:
    """Path of the FMU, and its sample period in s."""
    export = jaxbl.export(study, folder, "fmu", name="drive")
    return str(export.folder / "drive.fmu"), export.summary["sample_period"]


def free_run(study: Any, trace: pd.DataFrame) -> Any:
    """Outputs of the FMU under the input of a trace."""
    with tempfile.TemporaryDirectory() as folder:
        path, period = write_fmu(study, folder)
        inputs = np.zeros(len(trace), [("time", float), ("u", float)])
        inputs["time"], inputs["u"] = np.arange(len(trace)) * period, trace.u
        return fmpy.simulate_fmu(path, input=inputs, stop_time=inputs["time"][-1], step_size=period, output_interval=period)


def difference(outputs: Any, trace: pd.DataFrame) -> float:
    """Largest difference of positions, velocities and transmitted torque over all samples, over the range of each."""
    names = [name for name in ("motor.position", "motor.velocity", "load.position", "load.velocity") if name in trace]
    names += ["torque"] if "z" in trace else []
    return max(float(np.max(np.abs(np.asarray(outputs[name]) - trace[name])) / np.ptp(trace[name])) for name in names)


def nanoseconds(study: Any) -> float:
    """For a sample, plant steps included: of one long step of the FMU."""
    with tempfile.TemporaryDirectory() as place:
        path, period = write_fmu(study, f"{place}/made")
        description = fmpy.read_model_description(path)
        unit: Any = fmpy.instantiate_fmu(fmpy.extract(path, f"{place}/there"), description, "CoSimulation")
        unit.enterInitializationMode()
        unit.exitInitializationMode()
        start = time.perf_counter()
        unit.doStep(currentCommunicationPoint=0.0, communicationStepSize=SAMPLES * period)
        took = time.perf_counter() - start
        unit.freeInstance()
        return took / SAMPLES * 1e9


def main() -> None:
    print("study, s of motion, plant steps a sample: largest difference over range; ns a sample")
    for file in sorted(SWEEPS.glob("*.toml")):
        run = read_config(file).run
        trace = jaxbl.run(file).trace
        off = difference(free_run(file, trace), trace)
        print(f"{file.stem:22} {run.duration:5g} s {run.substeps:3d}  {off:.1e}  {nanoseconds(file):6.0f} ns", flush=True)
    print("impacts: largest difference over range of the FMU, and of jaxbl's loop by XLA, to its fused loop")
    for duration in (2.0, 5.0, 10.0, 20.0):
        study = small_study({"run.duration": duration, "run.substeps": 10}, **IMPACTS)
        fused, scanned = (jaxbl.run(study, backend=backend).trace for backend in ("fused", "scan"))
        print(
            f"{duration:5g} s  {difference(free_run(study, fused), fused):.1e}  {difference(scanned, fused):.1e}", flush=True
        )


if __name__ == "__main__":
    main()
