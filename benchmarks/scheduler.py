"""What Dask's own scheduler costs with as many bundles and workers as a large study has, on one machine.

The scheduler is a process of its own, as on a cluster. Workers are Dask's, of one thread each, many of them in each of a few
processes; their jobs sleep, or return at once, and give back what a bundle of ten parts gives. The client is
`jaxbl.cluster.Cluster.done`, or `leave` with --leave. Processor time is read from the system for each process: on a machine
of few cores, which workers share, that is the steadier figure, and its inverse what scheduler or client could do at best.

    python benchmarks/scheduler.py --workers 10 100 1000 --bundles 1000 10000 100000
    python benchmarks/scheduler.py --workers 1000 --bundles 10000 --sleep 2       # as many at work as there are workers

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

import psutil
from distributed import Client, Scheduler, Worker

from jaxbl import cluster
from jaxbl.cluster import Cluster

_PARTS = 10
"""Parts of a bundle."""
_PROCESSES = 4
"""Of workers."""


class Job(NamedTuple):
    """What a bundle is: some strings and numbers (:class:`jaxbl.sweeps.bundles.Bundle`)."""

    folder: str
    identity: str
    layout: tuple[int, int]
    chunks: tuple[int, ...]
    seconds: float


def done(job: Job) -> tuple[dict[int, str], float, str]:
    """What a worker gives back of a bundle: a checksum for each part."""
    time.sleep(job.seconds)
    return dict.fromkeys(job.chunks, "0123456789abcdef" * 2), 1.0, "host"


def schedule(channel) -> None:
    """A scheduler, until it is told to stop."""

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
            given = {"nthreads": 1, "memory_limit": 0, "dashboard": False, "local_directory": folder}
            for first in range(0, count, 25):
                some = (stack.enter_async_context(Worker(address, **given)) for _ in range(first, min(first + 25, count)))
                await asyncio.gather(*some)
            channel.send(count)
            while not channel.poll():
                await asyncio.sleep(0.2)
            os._exit(0)

    asyncio.run(run())


class Peak(threading.Thread):
    """The largest memory of some processes while it runs, MB, by their ids."""

    def __init__(self, *processes: int):
        super().__init__(daemon=True)
        self.processes = [psutil.Process(process) for process in processes]
        self.most = [0.0] * len(processes)
        self.stop = threading.Event()
        self.start()

    def run(self) -> None:
        while not self.stop.wait(0.1):
            self.most = [
                max(most, process.memory_info().rss / 1e6) for most, process in zip(self.most, self.processes, strict=True)
            ]


def seconds_of(process: int) -> float:
    times = psutil.Process(process).cpu_times()
    return times.user + times.system


def measure(client: Client, scheduler: int, workers: list[int], bundles: int, given: argparse.Namespace) -> str:
    jobs = [
        (
            index,
            Job(
                "/scratch/study",
                "0123456789abcdef",
                (4, 4096),
                tuple(range(_PARTS * index, _PARTS * (index + 1))),
                given.sleep,
            ),
        )
        for index in range(bundles)
    ]
    here = os.getpid()
    ids = [scheduler, here, *workers]
    before = [seconds_of(one) for one in ids]
    memory = [psutil.Process(one).memory_info().rss / 1e6 for one in ids[:2]]
    peak = Peak(scheduler, here)
    start = time.perf_counter()
    first = None
    connection = Cluster(client, local=False)
    if given.leave:
        connection.leave(done, [job for _, job in jobs])
        first = time.perf_counter() - start
        while client.run_on_scheduler(lambda dask_scheduler: len(dask_scheduler.tasks)):
            time.sleep(0.2)
        count = bundles
    else:
        count = 0
        for _ in connection.done(done, jobs):
            first = first or time.perf_counter() - start
            count += 1
    wall = time.perf_counter() - start
    used = [seconds_of(one) - old for one, old in zip(ids, before, strict=True)]
    peak.stop.set()
    assert count == bundles
    each = [1e3 * seconds / bundles for seconds in (used[0], used[1], sum(used[2:]))]
    rate = f"{bundles:10d}{wall:10.1f}{first:10.2f}{bundles / wall:10.0f}"
    sizes = memory[0], peak.most[0], memory[1], peak.most[1]
    return rate + "".join(f"{one:10.2f}" for one in each) + "".join(f"{one:10.0f}" for one in sizes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, nargs="+", default=[10, 100, 1000])
    parser.add_argument("--bundles", type=int, nargs="+", default=[1000, 10_000, 100_000])
    parser.add_argument("--sleep", type=float, default=0.0, help="seconds of a bundle")
    parser.add_argument("--leave", action="store_true", help="hand bundles over, and wait for the scheduler to be empty")
    given = parser.parse_args()
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    context = multiprocessing.get_context("spawn")
    head = (
        "bundles",
        "s",
        "first, s",
        "bundles/s",
        "sched. ms",
        "client ms",
        "worker ms",
        "sched. MB",
        "peak MB",
        "client MB",
        "peak MB",
    )
    for count in given.workers:
        with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
            ours, theirs = context.Pipe()
            scheduler = context.Process(target=schedule, args=(theirs,), daemon=True)
            scheduler.start()
            address = ours.recv()
            channels, processes = [ours], [scheduler]
            start = time.perf_counter()
            for number in range(min(_PROCESSES, count)):
                one, other = context.Pipe()
                share = count // _PROCESSES + (number < count % _PROCESSES)
                process = context.Process(target=work, args=(address, share, folder, other), daemon=True)
                process.start()
                processes.append(process)
                channels.append(one)
            assert sum(channel.recv() for channel in channels[1:]) == count
            client = stack.enter_context(Client(address, set_as_default=False, timeout=120))
            ids = [process.pid for process in processes[1:]]
            started = time.perf_counter() - start
            memory = (
                psutil.Process(scheduler.pid).memory_info().rss / 1e6,
                sum(psutil.Process(one).memory_info().rss / 1e6 for one in ids),
            )
            idle = seconds_of(scheduler.pid)
            time.sleep(5.0)
            idle = (seconds_of(scheduler.pid) - idle) / 5.0
            print(
                f"{count} workers in {len(ids)} processes of {memory[1]:.0f} MB, there after {started:.1f} s: scheduler "
                f"{memory[0]:.0f} MB, {100 * idle:.0f} % of a core while idle",
                flush=True,
            )
            print("".join(f"{name:>10}" for name in head))
            for bundles in given.bundles:
                print(measure(client, scheduler.pid, ids, bundles, given), flush=True)
            client.close()
            for channel in channels[::-1]:
                channel.send("stop")
            for process in processes[::-1]:
                process.join(20)
                process.kill()


if __name__ == "__main__":
    main()
