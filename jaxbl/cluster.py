"""Jobs on the workers of a Dask cluster: one that is there already, or processes of this machine (`local:N`).

Needs the extra `distributed`. Functions that workers call are found by name: they have the same version of jaxbl installed.
"""

import json
import os
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, Union

from .errors import InputError, NoResult, shorten
from .lines import format_duration
from .workers import announce, check_cost, count_cores, start_jax

if TYPE_CHECKING:
    from distributed import Client

Job = TypeVar("Job")
Result = TypeVar("Result")

Scheduler = Union[str, "Client", "Cluster", None]
"""How a cluster is given (:func:`connect`)."""

_ANSWER_SECONDS = 15.0
"""Longest time in which a scheduler has to answer."""
_LOCAL_A_CORE, _FEWEST_LOCAL = 2, 8
"""Most local workers a core, and most on a machine with few: a job takes all cores of its worker."""
_WORKER_BYTES = 6e8
"""Bytes of a local worker that has imported JAX and compiled a study."""
_WORKERS_SECONDS = 3600.0
"""Longest time without any worker: a queue of a cluster may start the first ones late."""
_POLL_SECONDS = 0.05
"""Time between two looks at which jobs have ended."""
_AHEAD, _FEWEST_AHEAD = 4, 16
"""Jobs a worker, and in all at least, that the scheduler knows at once: workers never wait for the next one, and neither
scheduler nor client grows with the number of jobs (docs/speed.md)."""
_COUNT_SECONDS = 2.0
"""Time between two counts of the workers."""
_ONE_AT_A_TIME = threading.Lock()
"""A job uses all cores of its worker, whatever number of threads takes jobs there."""


class Cluster:
    """A connection to a Dask scheduler.

    Attributes:
        local: True if its workers end with this process.
    """

    def __init__(self, client: "Client", *, local: bool):
        self.local = local
        self._client = client

    @property
    def workers(self) -> int:
        """Number of workers; 0 where a cluster starts them as they are needed."""
        try:
            threads: Any = self._client.nthreads()
        except OSError:
            raise NoResult(_LOST) from None
        return len(threads)

    def map_jobs(self, function: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[Result]:
        """Results of a function (importable by name), in the order of its arguments."""
        results: dict[int, Result] = {}
        following = 0
        for index, _, result in self.run_jobs(function, jobs):
            results[index] = result
            while following in results:
                yield results.pop(following)
                following += 1

    def run_jobs(self, function: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[tuple[int, Job, Result]]:
        """Run jobs on the workers, and yield the number, argument and result of each job that has ended.

        Jobs begin in their order; if a worker is lost, another one runs its job again. `jobs` is read as workers become
        free.

        Raises:
            InputError, NoResult: of a job, of workers that cannot run one, or where the scheduler is lost.
        """
        from distributed import as_completed

        waiting = enumerate(jobs)
        begun: dict[Any, tuple[int, Job]] = {}
        finished = as_completed(loop=self._client.loop)
        most, next_count, last_worker = 0, 0.0, time.monotonic()
        try:
            while True:
                if self._client.status != "running":
                    raise NoResult(_LOST)
                if (now := time.monotonic()) >= next_count:
                    workers, next_count = self.workers, now + _COUNT_SECONDS
                    most = max(_AHEAD * workers, _FEWEST_AHEAD)
                    if workers:
                        last_worker = now
                    elif now - last_worker > _WORKERS_SECONDS:
                        raise NoResult(f"no worker has come for {format_duration(_WORKERS_SECONDS)}; {_KEPT}")
                    else:
                        announce("waiting for workers: the scheduler has none")
                more = list(islice(waiting, max(most - len(begun), 0)))
                futures = self._submit(function, [job for _, job in more])
                begun.update(zip(futures, more, strict=True))
                finished.update(futures)
                # what is not referred to any more, the scheduler forgets
                del futures
                if not begun:
                    return
                batch = list(finished.next_batch(block=False))
                for future in batch:
                    if future.status == "lost":
                        # with its worker, after it had ended: another one does it again
                        finished.add(future)
                    else:
                        yield *begun.pop(future), self._result(future)
                if not batch:
                    time.sleep(_POLL_SECONDS)
        finally:
            if begun and self._client.status == "running":
                self._client.cancel([*begun], force=True)

    def submit_jobs(self, function: Callable[[Job], Result], jobs: Sequence[Job]) -> None:
        """Have jobs done without waiting for them, also when this process has ended."""
        from distributed import fire_and_forget

        fire_and_forget(self._submit(function, jobs))

    def _submit(self, function: Callable[[Job], Result], jobs: Sequence[Job]) -> list[Any]:
        if not jobs:
            return []
        # a name of its own for each call: an earlier one may have been given up; Dask takes equal priorities in their order
        token = f"jaxbl-{socket.gethostname()}-{os.getpid()}-{time.time_ns()}"
        keys = [f"{token}-{index:07d}" for index in range(len(jobs))]
        return self._client.map(partial(_call, function, version("jaxbl")), jobs, key=keys, pure=False, batch_size=1000)

    def _result(self, future: Any) -> Any:
        from distributed import KilledWorker

        if future.status in ("cancelled", "lost"):
            raise NoResult(_LOST)
        try:
            return future.result()
        except KilledWorker as error:
            raise NoResult(
                f"a job has ended {error.allowed_failures + 1} workers, perhaps for want of memory (the last one: "
                f"{error.last_worker.address}); what is finished is kept; go on with fewer lanes at once, "
                "[sweep] chunk, or workers with more memory"
            ) from None
        except ModuleNotFoundError as error:
            raise InputError(
                f"--scheduler: its workers lack a module ({error}); install jaxbl {version('jaxbl')} there"
            ) from None


_KEPT = "what is finished is kept, and the same command goes on from there"
_LOST = f"the connection to the scheduler is lost; {_KEPT}"


def _call(function: Callable[[Job], Result], asking: str, job: Job) -> Result:
    """Call a function on a worker, which has to have the version of jaxbl that is `asking`."""
    here = version("jaxbl")
    if here != asking:
        raise InputError(f"--scheduler: worker {socket.gethostname()} has jaxbl {here}; install {asking} there")
    from distributed import get_worker

    with _ONE_AT_A_TIME:
        start_jax(get_worker().state.nthreads)
        return function(job)


@contextmanager
def connect(scheduler: Scheduler) -> Iterator[Cluster | None]:
    """A cluster by its scheduler: an address (`tcp://host:8786`), a scheduler's file (`….json`), `local:N` for N processes
    of this machine, or a client that is connected already; None for None.

    Raises:
        InputError: no scheduler is there, or Dask is not installed.
    """
    if scheduler is None or isinstance(scheduler, Cluster):
        yield scheduler
        return
    if find_spec("distributed") is None:
        raise InputError("--scheduler: needs Dask; install it with: pip install 'jaxbl[distributed]'")
    if not isinstance(scheduler, str):
        yield Cluster(scheduler, local=False)
        return
    local = scheduler.partition(":")[0] == "local"
    with _start_local(scheduler) if local else _open_client(scheduler) as client:
        yield Cluster(client, local=local)


def _open_client(scheduler: str) -> "Client":
    """Connect to a scheduler by its address or file.

    Dask waits for a file, and for the first word of whatever listens at a port, for ever: in a thread, which is left alone.
    """
    from distributed import Client

    announce(f"waiting for the scheduler {scheduler}")
    client: Future[Client] = Future()

    def open_client() -> None:
        try:
            address = str(json.loads(Path(scheduler).read_text())["address"]) if scheduler.endswith(".json") else scheduler
            client.set_result(Client(address, timeout=_ANSWER_SECONDS, set_as_default=False))
        except Exception as error:
            client.set_exception(error)

    threading.Thread(target=open_client, name="jaxbl-connect", daemon=True).start()
    try:
        return client.result(_ANSWER_SECONDS + 3.0)
    # whatever answers there, it is no scheduler
    except Exception as error:
        fault = repr(error) if isinstance(error, KeyError) else str(error) or "nothing for as long as a scheduler takes"
        raise InputError(
            f"--scheduler {scheduler}: no Dask scheduler answers there ({shorten(fault.partition(chr(10))[0], 120)}); "
            "it should be an address (tcp://host:8786), a scheduler's file (….json), or local:N"
        ) from None


@contextmanager
def _start_local(scheduler: str) -> "Iterator[Client]":
    """Start processes of this machine as workers; they share its cores, and keys that no other user of the machine has.

    A scheduler runs the code that it is sent: without keys, that of whoever reaches its port.
    """
    from dask import config
    from distributed import Client, LocalCluster, Security

    number = scheduler.removeprefix("local:")
    if not number.isdecimal() or not 1 <= (count := int(number)) <= 1024:
        raise InputError(f"--scheduler {scheduler}: local:N needs the number of processes, 1 to 1024")
    if count > (most := max(_LOCAL_A_CORE * count_cores(), _FEWEST_LOCAL)):
        raise InputError(f"--scheduler {scheduler}: {count_cores()} cores keep at most {most} processes busy")
    check_cost(f"--scheduler {scheduler}", count * _WORKER_BYTES, "it should be fewer processes")
    try:
        security = Security.temporary()
    except ImportError:
        raise InputError(
            "--scheduler local:N: needs cryptography; install it with: pip install 'jaxbl[distributed]'"
        ) from None
    announce("starting workers")
    # a process that was forked would share the locks of this one's compiler
    with (
        config.set({"distributed.worker.multiprocessing-method": "spawn"}),
        LocalCluster(
            n_workers=count,
            threads_per_worker=max(count_cores() // count, 1),
            processes=True,
            # any free port: with None it would be 8787, open to the network
            dashboard_address="127.0.0.1:0",
            memory_limit=0,
            silence_logs=50,
            security=security,
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client
