"""Cost of large studies, from small ones measured here: processor time, disk, start-up; then hours and money.

Three kinds of study are run in a few thousand lanes: `gain_map` and `dead_zone_noise` as they stand (float64, implicit, ten
steps of the plant a sample), and a lean chain (gain_map in float32, explicit, one step). Time is processor time, which other
programs on this machine disturb least; the price of a core-hour is an assumption (--price).

    python benchmarks/scale.py
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import psutil

from jaxbl.workers import start_jax

start_jax()

from jaxbl.config import read_config  # noqa: E402
from jaxbl.sweeps.engine import Engine  # noqa: E402
from jaxbl.sweeps.store import Store  # noqa: E402

ROOT = Path(__file__).parents[1]


class Cost(NamedTuple):
    """Cost of a run: samples, core-seconds of computing and of storing, bytes."""

    samples: int
    computing: float
    storing: float
    size: float


def study(name: str, num: int, **run: Any) -> dict[str, Any]:
    """A study with so many values on each axis that has a number of them."""
    data = tomllib.loads((ROOT / "sweeps" / f"{name}.toml").read_text())
    data.pop("figures", None)
    for axis in data["axes"]:
        if "num" in axis:
            axis["num"] = num
    data["run"] |= run
    return data


def lean() -> dict[str, Any]:
    data = study("gain_map", 64, precision="float32", substeps=1)
    data["observer"]["discretisation"] = "explicit"
    return data


def measure(data: dict[str, Any], folder: Path) -> Cost:
    """Cost of a run, by all chunks of a study after a first one."""
    config = read_config(data)
    engine = Engine(config)
    store = Store.create(folder, engine)
    store.write_part(0, engine.run(engine.chunk(0)))
    start = time.process_time()
    frames = [engine.run(engine.chunk(index)) for index in range(len(engine))]
    between = time.process_time()
    for index, frame in enumerate(frames):
        store.write_part(index, frame)
    end = time.process_time()
    size = sum(path.stat().st_size for path in store.list_part_files())
    return Cost(config.run.steps, *(amount / engine.rows for amount in (between - start, end - between, size)))


_COMMAND = """
import sys, time

begun = float(sys.argv.pop(1))
from jaxbl.__main__ import program
from jaxbl.sweeps import engine

compile_program = engine.compile_program


def clocked(*given, **named):
    program = compile_program(*given, **named)

    def run(*given):
        print(time.time() - begun, time.process_time(), file=sys.stderr, flush=True)
        return program.run(*given)

    return program._replace(run=run)


engine.compile_program = clocked
sys.argv[0] = "jaxbl"
program()
"""


def measure_process(folder: Path) -> list[float]:
    """Seconds, and processor seconds, of the command until its first lanes begin, and until its first part is there."""
    small = (
        f'include = "{ROOT}/sweeps/gain_map.toml"\n[sweep]\nchunk = 64\n[run]\nduration = 0.1\n[identifier]\nstart = 0.05\n'
    )
    (folder / "study.toml").write_text(small)
    for out in ("first", "second"):
        start = time.time()
        words = [sys.executable, "-c", _COMMAND, str(start), "sweep", "study.toml", "--out", out]
        process = psutil.Popen(words, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        while process.poll() is None and not list((folder / out).glob("points/part-*")):
            time.sleep(0.01)
        times = process.cpu_times()
        wall = time.time() - start
        process.kill()
        _, output = process.communicate()
    return [*map(float, output.split()[:2]), wall, times.user + times.system]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--price", type=float, default=0.04, help="of a core-hour, in dollars")
    parser.add_argument("--cores", type=int, nargs="+", default=[64, 10_000])
    args = parser.parse_args()
    kinds = {
        "lean": lean(),
        "gain_map": study("gain_map", 32),
        "dead_zone_noise": study("dead_zone_noise", 16),
    }
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    costs = {}
    for name, data in kinds.items():
        with tempfile.TemporaryDirectory() as folder:
            cost = costs[name] = measure(data, Path(folder))
        print(
            f"{name:16} {1e9 * cost.computing / cost.samples:6.2f} ns of a core a lane-step, {cost.samples} samples: "
            f"{1e3 * cost.computing:.3f} ms a run; storing {1e6 * cost.storing:.1f} us, {cost.size:.0f} bytes a run"
        )
    with tempfile.TemporaryDirectory() as folder:
        begun, used, there, used_there = measure_process(Path(folder))
    print(
        f"programs kept: start to first lane-step {begun:.1f} s, {used:.1f} s of processor time; "
        f"to first part {there:.1f} s, {used_there:.1f} s"
    )
    print(
        f"\n{'runs':>8} {'study':16} {'core-hours':>11} {'dollars':>10}"
        + "".join(f"{n:>9} cores" for n in args.cores)
        + f"{'TB':>9}"
    )
    for runs in (1e9, 1e12):
        for name, cost in costs.items():
            hours = runs * (cost.computing + cost.storing) / 3600.0
            row = f"{runs:8.0e} {name:16} {hours:11.3g} {args.price * hours:10.3g}"
            print(row + "".join(f"{hours / n:13.3g} h" for n in args.cores) + f"{runs * cost.size / 1e12:9.3g}")


if __name__ == "__main__":
    main()
