"""Cost of a study per point beside its computing, from 10^4 to 10^6 points of short runs: `jaxbl sweep` as a process.

    python benchmarks/large_study.py [--points 1e4 1e5 1e6] [--chunk N]

The process is that of the command, with clocks around the functions that compute chunks (and make frames of them), store,
schedule and report. Times are processor time of all threads: other work on the machine does not count, nor does waiting for
the disk.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import tomli_w

_STUDY = {
    "title": "Short runs",
    "drive": {"kind": "two_inertia", "motor_inertia": 0.05, "motor_viscous": 0.15, "load_inertia": 7.0,
              "load_viscous": 16.0, "gear_ratio": 5.0},
    "transmission": {"law": "sigmoid_backlash", "stiffness": 1.0, "dead_zone": 0.02, "slope": 20.0},
    "excitation": {"kind": "sine", "amplitude": 0.1, "frequency": 2.0},
    "encoders": {"noise": 1e-4},
    "observer": {"motor": {"lambda": 4.0, "alpha": 9.0}, "load": {"lambda": 0.5, "alpha": 0.2}},
    "run": {"duration": 1.0, "substeps": 2},
}  # fmt: skip
_RUN = """
import functools, json, resource, sys, time
from collections import defaultdict

from jaxbl.workers import start_jax

start_jax()
import jaxbl.report.results
from jaxbl.cli import main
from jaxbl.sweeps import engine, run, store, sweep

spent = defaultdict(lambda: [0.0, 0.0])
now = lambda processor=time.process_time: (processor(), time.perf_counter())


def clock(owner, name, phase, processor=time.process_time):
    of = getattr(owner, name)

    @functools.wraps(of)
    def timed(*given, **named):
        before = now(processor)
        try:
            return of(*given, **named)
        finally:
            for i, (a, b) in enumerate(zip(before, now(processor))):
                spent[phase][i] += b - a

    setattr(owner, name, timed)


clock(engine.Engine, "run", "chunks")
clock(engine.Engine, "_compile", "compile")
clock(engine.Engine, "row_labels", "labels")
clock(engine.Engine, "__init__", "points")
clock(engine.Engine, "chunk_order", "order")
# parts are written by a thread of their own
clock(store.Store, "write_part", "write", time.thread_time)
clock(store.Store, "read_part", "look")
clock(run.StudyRun, "mark_finished", "finish")
clock(sweep, "sweep", "sweep")
clock(jaxbl.report.results, "write_report", "report")
sys.argv = ["jaxbl", *sys.argv[1:]]
try:
    main()
finally:
    spent["all"] = list(now())
    spent["all"][1] = 0.0
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(json.dumps({"memory": memory, "seconds": spent}), file=sys.stderr)
"""


def study(points: int, chunk: int | None) -> str:
    """A map of so many points, about, as TOML."""
    side = round(points**0.5)
    axes = [
        {"path": f"observer.motor.{gain}", "start": 1.0, "stop": 100.0, "num": side, "scale": "log"}
        for gain in ("alpha", "lambda")
    ]
    return tomli_w.dumps(_STUDY | {"axes": axes, "sweep": {} if chunk is None else {"chunk": chunk}})


def run(*words: str) -> tuple[dict[str, list[float]], float, str]:
    """Processor and wall seconds of each phase of a command, its peak memory (MB), and what it said."""
    done = subprocess.run(
        [sys.executable, "-c", _RUN, *words], check=True, capture_output=True, text=True, env=dict(os.environ)
    )
    usage = json.loads(done.stderr.splitlines()[-1])
    return usage["seconds"], usage["memory"] / 1024.0, done.stdout


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=float, nargs="+", default=[1e4, 1e5, 1e6])
    parser.add_argument("--chunk", type=int, help="lanes of a chunk [default: the engine's]")
    arguments = parser.parse_args()
    steps = round(_STUDY["run"]["duration"] / 1e-3)
    print(f"{steps} samples a run; processor time in µs a point, share of that of the sweep, peak memory")
    print("   points   parts    compute  storage  scheduling   share   report  memory")
    with tempfile.TemporaryDirectory() as name:
        for points in map(int, arguments.points):
            config, out = Path(name) / f"{points}.toml", Path(name) / str(points)
            config.write_text(study(points, arguments.chunk))
            spent, memory, _ = run("sweep", str(config), "--out", str(out))
            parts = len(list((out / "points").iterdir()))
            of = {phase: cost[0] for phase, cost in spent.items()}
            storage = of["write"] + of["look"] + of["finish"]
            # loading, compiling and one look at the folder are the same for any number of points
            scheduling = of["order"] + of["points"]
            # but for the last one, parts are written while chunks are computed
            compute = of["chunks"] - of["compile"] - of["labels"] - of["write"] * (1.0 - 1.0 / parts)
            scheduling += of["labels"]
            microseconds = [1e6 * cost / points for cost in (compute, storage, scheduling)]
            share = 100.0 * (storage + scheduling) / (compute + storage + scheduling)
            print(
                f"{points:>9} {parts:>7} {microseconds[0]:>10.1f} {microseconds[1]:>8.1f} {microseconds[2]:>11.1f} "
                f"{share:>5.1f} % "
                f"{1e6 * of['report'] / points:>8.1f} {memory:>4.0f} MB",
                flush=True,
            )


if __name__ == "__main__":
    main()
