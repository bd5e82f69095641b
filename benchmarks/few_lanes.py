"""Few lanes: the fused loop beside C++ that does the same work, for 64 to 1024 lanes of the bench's workload.

    python benchmarks/few_lanes.py [--steps 1000] [--seconds 1] [--threads 2] [--real-time]

Two comparisons. In the first both make input and noise by themselves, of another seed in each run: C++ by the same
generator, vectorised, samples shared by its threads. In the second both have them: C++ is given them, and the fused loop has
kept them from the run before, as it does for the next lanes of a study. All take turns, several runs in a row; the least
time of some seconds counts. With `--real-time` (Linux, root) nothing else runs meanwhile: on a machine that others use, two
threads are hardly ever on two cores at once otherwise.
"""

import argparse
import os
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from jaxbl.workers import count_cores, start_jax

start_jax()

import jax  # noqa: E402

from jaxbl.throughput.jaxbl_chain import FusedChain  # noqa: E402
from jaxbl.throughput.rivals.cpp_chain import CppChain  # noqa: E402
from jaxbl.throughput.workload import SEED, Workload  # noqa: E402


class Kept(FusedChain):
    """The same lanes of one seed again."""

    def __call__(self):
        return self._simulator(self._values, SEED)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--real-time", action="store_true")
    parser.add_argument("--threads", type=int, default=count_cores())
    args = parser.parse_args()
    print(f"{args.steps} samples, {args.threads} threads; microseconds a run")
    print("precision  lanes   C++ own  fused own  ratio   C++ given  fused kept  ratio")
    with TemporaryDirectory() as folder:
        for precision in ("float32", "float64"):
            for lanes in (64, 128, 256, 512, 1024):
                with jax.enable_x64(precision == "float64"):
                    package_time, ours, has, kept_time = measure_chains(
                        Workload(lanes, args.steps, precision), Path(folder), args
                    )
                print(
                    f"{precision:9s} {lanes:6d} {package_time:9.0f} {ours:10.0f} {package_time / ours:6.2f} "
                    f"{has:11.0f} {kept_time:11.0f} {has / kept_time:6.2f}",
                    flush=True,
                )


def measure_chains(work: Workload, folder: Path, args: argparse.Namespace) -> list[float]:
    """Least time of each, us."""
    runners = [
        CppChain(work, args.threads, folder, makes_inputs=True),
        FusedChain(work, args.threads),
        CppChain(work, args.threads, folder),
        Kept(work, args.threads),
    ]
    best = [float("inf")] * len(runners)
    if args.real_time:
        # before the first run, which starts the threads: they inherit it
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    end = time.perf_counter() + args.seconds
    while time.perf_counter() < end:
        for i, runner in enumerate(runners):
            for _ in range(20):
                start = time.perf_counter()
                runner()
                best[i] = min(best[i], time.perf_counter() - start)
    if args.real_time:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    return [1e6 * least for least in best]


if __name__ == "__main__":
    main()
