"""Cost of Dask's own scheduler with as many bundles and workers as a large study has, on one machine.

The scheduler is a process of its own, as on a cluster. Workers are Dask's, of one thread each, many of them in each of a few
processes; their jobs sleep, or return at once, and give back what a bundle of ten parts gives. The client is
`jaxbl.cluster.Cluster.run_jobs`, or `submit_jobs` with --leave. Rows are of one pass, at so many bundles done. Processor
time is read from the system for each process: on a machine of few cores, which workers share, that is the steadier figure,
and its inverse what scheduler or client could do at best.

    python benchmarks/scheduler.py --workers 10 100 1000 --bundles 1000 10000 100000
    python benchmarks/scheduler.py --workers 10 --bundles 100000 --leave          # all known at once, none done
    python benchmarks/scheduler.py --workers 1000 --bundles 10000 --heartbeat 60  # where idle workers take all cores

Needs the extra `distributed`; open files: 12 for each worker (`ulimit -n`).
"""

import argparse
import asyncio
import contextlib
import multiprocessing
import os
import resource
import tempfile
import threading
import time
from collections.abc import Iterator
from typing import NamedTuple

# for this process and those that it starts: no log lines; and what each worker does 50 times a second while it waits would,
# in a thousand of them, be all that these cores do
os.environ |= {
    "DASK_LOGGING__DISTRIBUTED": "error",
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    "DASK_DISTRIBUTED__ADMIN__SYSTEM_MONITOR__INTERVAL": "10s",
    "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "10s",
    "DASK_DISTRIBUTED__ADMIN__TICK__LIMIT": "60s",
    "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "120s",
    "DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": "1h",
}

import distributed.scheduler
import psutil
from distributed import Client, Scheduler, Worker

from jaxbl import cluster
from jaxbl.cluster import Cluster

_PARTS = 10
"""Parts of a bundle."""
_PROCESSES = 4
"""Processes that the workers share."""


class Job(NamedTuple):
    """A bundle: strings and numbers (:class:`jaxbl.sweeps.bundles.Bundle`)."""

    folder: str
    identity: str
    layout: tuple[int, int]
    chunks: tuple[int, ...]
    seconds: float


def jobs(count: int, seconds: float) -> Iterator[Job]:
    for index in range(count):
        chunks = tuple(range(_PARTS * index, _PARTS * (index + 1)))
        yield Job("/scratch/study", "0123456789abcdef", (4, 4096), chunks, seconds)


def done(job: Job) -> tuple[dict[int, str], float, str]:
    """Return a worker's result of a bundle: a checksum for each part."""
    time.sleep(job.seconds)
    return dict.fromkeys(job.chunks, "0123456789abcdef" * 2), 1.0, "host"


def schedule(heartbeat: float | None, channel) -> None:
    """A scheduler, until it is told to stop."""
    if heartbeat is not None:
        distributed.scheduler.heartbeat_interval = lambda workers: heartbeat

    async def run() -> None:
        async with Scheduler(host="127.0.0.1", port=0, dashboard=False, dashboard_address="127.0.0.1:0") as scheduler:
            channel.send(scheduler.address)
            while not channel.poll():
                await asyncio.sleep(0.2)

    asyncio.run(run())


def work(address: str, count: int, folder: str, channel) -> None:
    """So many workers, until they are told to stop."""
    # jobs of one process take turns elsewhere, as each takes all its cores; here they stand for machines of their own
    cluster._ONE_AT_A_TIME = contextlib.nullcontext()  # pyright: ignore[reportAttributeAccessIssue]
    cluster.start_jax = lambda devices: None

    async def run() -> None:
        async with contextlib.AsyncExitStack() as stack:
            options = {"nthreads": 1, "memory_limit": 0, "dashboard": False, "local_directory": folder}
            for first in range(0, count, 25):
                workers = (
                    stack.enter_async_context(Worker(address, **options)) for _ in range(first, min(first + 25, count))
                )
                await asyncio.gather(*workers)
            channel.send(count)
            while not channel.poll():
                await asyncio.sleep(0.2)
            os._exit(0)

    asyncio.run(run())


def megabytes(process: int) -> float:
    return psutil.Process(process).memory_info().rss / 1e6


class Peaks(threading.Thread):
    """The largest memory of some processes from now on, MB, by their ids."""

    def __init__(self, *processes: int):
        super().__init__(daemon=True)
        self.most = dict.fromkeys(processes, 0.0)
        self.stop = threading.Event()
        self.start()

    def run(self) -> None:
        while not self.stop.wait(0.1):
            self.most = {process: max(most, megabytes(process)) for process, most in self.most.items()}


def seconds_of(process: int) -> float:
    times = psutil.Process(process).cpu_times()
    return times.user + times.system


_HEAD = "bundles", "s", "first, s", "bundles/s", "sched. ms", "client ms", "worker ms", "sched. MB", "client MB"


class Pass:
    """One pass: prints a row whenever so many bundles are done."""

    def __init__(self, scheduler: int, workers: list[int]):
        self.scheduler, self.workers, self.here = scheduler, workers, os.getpid()
        self.peaks = Peaks(scheduler, self.here)
        self.used = self._read_usage()
        self.start = time.perf_counter()
        self.first = 0.0
        print(f"  before it: scheduler {megabytes(scheduler):.0f} MB, client {megabytes(self.here):.0f} MB")
        print("".join(f"{name:>10}" for name in _HEAD))

    def _read_usage(self) -> list[float]:
        return [seconds_of(self.scheduler), seconds_of(self.here), sum(map(seconds_of, self.workers))]

    def row(self, bundles: int) -> None:
        wall = time.perf_counter() - self.start
        milliseconds = [1e3 * (now - old) / bundles for now, old in zip(self._read_usage(), self.used, strict=True)]
        row = f"{bundles:10d}{wall:10.1f}{self.first:10.2f}{bundles / wall:10.0f}" + "".join(
            f"{number:10.2f}" for number in milliseconds
        )
        print(row + "".join(f"{number:10.0f}" for number in self.peaks.most.values()), flush=True)

    def by_client(self, client: Client, marks: list[int], seconds: float) -> None:
        count = 0
        for count, _ in enumerate(Cluster(client, local=False).run_jobs(done, jobs(max(marks), seconds)), 1):
            self.first = self.first or time.perf_counter() - self.start
            if count in marks:
                self.row(count)
        assert count == max(marks)
        self.peaks.stop.set()

    def submit_unending(self, client: Client, bundles: int) -> None:
        """Hand over bundles of which none ends, until the scheduler knows them all."""
        Cluster(client, local=False).submit_jobs(done, list(jobs(bundles, 1e6)))
        self.first = time.perf_counter() - self.start
        while client.run_on_scheduler(lambda dask_scheduler: len(dask_scheduler.tasks)) < bundles:
            time.sleep(0.5)
        self.row(bundles)
        self.peaks.stop.set()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, nargs="+", default=[10, 100, 1000])
    parser.add_argument("--bundles", type=int, nargs="+", default=[1000, 10_000, 100_000])
    parser.add_argument("--sleep", type=float, default=0.0, help="seconds of a bundle")
    parser.add_argument("--heartbeat", type=float, help="of a worker, s [default: Dask's, 1 + workers / 200]")
    parser.add_argument("--leave", action="store_true", help="hand all over at once; none is done")
    args = parser.parse_args()
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    for count in args.workers:
        with tempfile.TemporaryDirectory() as folder:
            run(count, args, folder)


def run(count: int, args: argparse.Namespace, folder: str) -> None:
    """All passes with so many workers."""
    context = multiprocessing.get_context("spawn")
    channels, processes = [], []

    def begin(function, *arguments) -> None:
        ours, theirs = context.Pipe()
        channels.append(ours)
        processes.append(context.Process(target=function, args=(*arguments, theirs), daemon=True))
        processes[-1].start()

    begin(schedule, args.heartbeat)
    address = channels[0].recv()
    start = time.perf_counter()
    for number in range(min(_PROCESSES, count)):
        begin(work, address, count // _PROCESSES + (number < count % _PROCESSES), folder)
    assert sum(channel.recv() for channel in channels[1:]) == count
    started = time.perf_counter() - start
    scheduler, *workers = (process.pid for process in processes)
    before = seconds_of(scheduler)
    time.sleep(10.0)
    idle = (seconds_of(scheduler) - before) / 10.0
    print(
        f"{count} workers in {len(workers)} processes of {sum(map(megabytes, workers)):.0f} MB, there after {started:.1f} s;"
        f" scheduler {megabytes(scheduler):.0f} MB, {100 * idle:.0f} % of a core while they are idle"
    )
    with Client(address, set_as_default=False, timeout=120) as client:
        if args.leave:
            Pass(scheduler, workers).submit_unending(client, max(args.bundles))
        else:
            Pass(scheduler, workers).by_client(client, args.bundles, args.sleep)
    for channel in channels[::-1]:
        channel.send("stop")
    for process in processes[::-1]:
        process.join(20)
        process.kill()


if __name__ == "__main__":
    main()
