"""Memory and time of `jaxbl plot` over the number of runs: made-up studies of one map, with more and more seeds.

    python benchmarks/large_report.py [--rows 1e5 1e6 1e7]

Parts are written directly, with the columns that figures and tables need. Each report is drawn by a process of its own; the
system says its peak memory.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd

from jaxbl.config import read_config
from jaxbl.sweeps.engine import Engine
from jaxbl.sweeps.store import Store

SIDE = 100
"""Values of both axes of the map."""
_STUDY = {
    "title": "Made up",
    "drive": {"kind": "rigid", "motor_inertia": 0.05, "motor_viscous": 0.15},
    "excitation": {"kind": "sine", "amplitude": 0.1, "frequency": 2.0},
    "observer": {"motor": {"lambda": 4.0, "alpha": 9.0}},
    "run": {"duration": 0.2, "substeps": 1},
    "axes": [
        {"path": "observer.motor.alpha", "start": 1.0, "stop": 100.0, "num": SIDE, "scale": "log"},
        {"path": "observer.motor.lambda", "start": 1.0, "stop": 100.0, "num": SIDE, "scale": "log"},
    ],
    "figures": [
        {"kind": "heatmap", "x": "observer.motor.alpha", "y": "observer.motor.lambda", "value": "motor.velocity_rmse",
         "overlays": ["exact"]},
        {"kind": "line", "x": "observer.motor.alpha", "value": "motor.velocity_rmse"},
    ],
}  # fmt: skip
_PLOT = """
import resource, sys
from jaxbl.cli import main
sys.argv = ["jaxbl", "plot", sys.argv[1]]
try:
    main()
finally:
    used = resource.getrusage(resource.RUSAGE_SELF)
    print(used.ru_utime + used.ru_stime, used.ru_maxrss, file=sys.stderr)
"""


def make(folder: Path, rows: int) -> int:
    """Write a study of so many rows, to the next whole seed. Returns its rows."""
    config = read_config(_STUDY | {"sweep": {"seeds": -(-rows // SIDE**2), "chunk": 32768}})
    engine = Engine(config, backend="fused")
    store = Store.create(folder, engine)
    rng = np.random.default_rng(0)
    for index in range(len(engine)):
        labels = engine.row_labels(engine.chunk(index))
        count = len(labels["seed"])
        alpha, lambda_ = labels["observer.motor.alpha"], labels["observer.motor.lambda"]
        noise = rng.normal(size=count)
        columns = {
            "finite": np.ones(count, bool),
            "motor.converged": lambda_**2 > alpha * (1.0 + 0.1 * noise),
            "motor.velocity_rmse": np.sqrt(alpha) * np.exp(0.1 * noise) / lambda_,
            "motor.f_plus": np.exp(0.3 * noise),
        }
        store.write_part(index, pd.DataFrame(labels | columns))
    store.update_manifest(finished=True)
    return engine.rows


def measure(folder: Path) -> tuple[float, float]:
    """Processor seconds and peak memory (MB) of a process that draws a study's report."""
    done = subprocess.run(
        [sys.executable, "-c", _PLOT, str(folder)], check=True, capture_output=True, text=True, env=dict(os.environ)
    )
    seconds, memory = map(float, done.stderr.split()[-2:])
    return seconds, memory / 1024.0


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=float, nargs="+", default=[1e5, 1e6, 1e7])
    arguments = parser.parse_args()
    print(f"a map of {SIDE} x {SIDE} and a line; processor time and peak memory of the process that draws")
    for rows in map(int, arguments.rows):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name) / "study"
            count = make(folder, rows)
            size = sum(part.stat().st_size for part in (folder / "points").iterdir()) / 1e6
            seconds, memory = measure(folder)
            parts = json.loads((folder / "manifest.json").read_text())["results"]["sweep"]["parts"]
        print(f"{count:>10} runs  {parts:>5} parts  {size:7.0f} MB  {seconds:6.1f} s  {memory:6.0f} MB", flush=True)


if __name__ == "__main__":
    main()
