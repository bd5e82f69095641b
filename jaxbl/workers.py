"""Independent jobs in worker processes, on all cores: progress, interrupts, and memory of compiled programs."""

import gc
import itertools
import multiprocessing
import os
import signal
import stat
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from .errors import InputError, NoResult, escape_unprintable
from .lines import format_duration

Job = TypeVar("Job")
Result = TypeVar("Result")

Progress = Callable[[int, int], None]
"""A function called with the number of finished lanes and of all lanes."""

_listeners: list[Callable[[str], None]] = []

_PROCESS_MEMORY = 5 * 2**30
"""Bytes for each process: after twenty logs of many lengths one held 4.7e9."""
_LONG = 10.0
"""Seconds from which on it is said beforehand how long a task takes."""
_MAPPING_LIMIT = 30_000
"""Memory mappings of a process: half of what Linux allows by default."""


@contextmanager
def subscribe(listener: Callable[[str], None]) -> Iterator[None]:
    """Call `listener` with each text that is announced (:func:`announce`) inside the `with` block."""
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


def announce(activity: str) -> None:
    """Tell all listeners what is being done now, in a few words; the progress line of a terminal shows it."""
    for listener in _listeners:
        listener(activity)


@contextmanager
def limit_blas_threads() -> Iterator[None]:
    """Keep BLAS to one thread inside the `with` block.

    Matrices are small here: on shared cores its threads wait for one another longer than they compute.
    """
    with threadpool_limits(1, "blas"):
        yield


def count_cores() -> int:
    """Count the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def count_memory() -> int:
    """Count the bytes of memory that this process may have: the machine's, or what its container leaves it."""
    import psutil

    limits = [psutil.virtual_memory().total]
    for file in ("memory.max", "memory/memory.limit_in_bytes"):
        # "max" is no limit
        with suppress(OSError, ValueError):
            limits.append(int(Path("/sys/fs/cgroup", file).read_text()))
    return min(limits)


def check_cost(task: str, memory: float, remedy: str, seconds: float = 0.0) -> None:
    """Refuse a task that memory cannot hold, and announce how long one takes, before it begins.

    Args:
        task: what is to be done, the subject of a sentence.
        memory: bytes that it takes, about.
        remedy: how it takes less.
        seconds: that it takes, about; 0 if not known.

    Raises:
        InputError: it takes more than there is.
    """
    if memory > (available := count_memory()):
        raise InputError(f"{task} takes {memory / 1e9:.3g} GB of memory; here are {available / 1e9:.3g} GB; {remedy}")
    if seconds > _LONG:
        announce(f"{task}: takes about {format_duration(seconds)}")


def useful_processes(jobs: int) -> int:
    """Return how many processes to start for some jobs: one a core, as memory allows, but one in all on an accelerator."""
    import jax

    if jax.default_backend() != "cpu":
        return 1
    return max(min(count_cores(), count_memory() // _PROCESS_MEMORY, jobs), 1)


def map_jobs(function: Callable[[Job], Result], jobs: Sequence[Job], processes: int) -> Iterator[Result]:
    """Yield the results of `function` for each job, in their order, as `map` does.

    After an interrupt no further jobs begin, and those under way are interrupted, too.

    Args:
        function: importable by name, as other processes call it.
        jobs: its arguments, one a call.
        processes: number of worker processes; with 1, this process does all jobs.

    Raises:
        NoResult: a worker process was killed.
    """
    if processes == 1:
        yield from map(function, jobs)
        return
    import jax

    # a process that was forked would share the locks of this one's compiler
    context = multiprocessing.get_context("spawn")
    cache = jax.config.values["jax_compilation_cache_dir"], jax.config.values["jax_persistent_cache_min_compile_time_secs"]
    with ProcessPoolExecutor(processes, context, _start_process, cache) as pool:
        with _block_interrupts():
            futures = [pool.submit(_run_job, function, job) for job in jobs]
        try:
            for future in futures:
                yield future.result()
        except BrokenProcessPool:
            raise NoResult("a worker process was killed, perhaps because memory ran out; --jobs 1 needs the least") from None
        finally:
            if not all(future.done() for future in futures):
                for future in futures:
                    future.cancel()
                # on Windows, Ctrl+C has reached all processes of the terminal by itself
                children: Any = () if os.name == "nt" else multiprocessing.active_children()
                for child in children:
                    with suppress(ProcessLookupError):
                        os.kill(child.pid, signal.SIGINT)


@contextmanager
def _block_interrupts() -> Iterator[None]:
    """Let interrupts wait inside the `with` block; processes that begin in it hear none before :func:`_start_process`."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def map_in_threads(function: Callable[..., Any], *arguments: Iterable[Any]) -> list[Any]:
    """Return the results of a function for each of its arguments, as `map` does, in one thread a device.

    The function should spend its time in compiled loops, which do not hold the interpreter.
    """
    import jax

    devices = len(jax.local_devices())
    return list((map if devices == 1 else _thread_pool(devices).map)(function, *arguments))


@cache
def _thread_pool(threads: int) -> ThreadPoolExecutor:
    """Threads that stay: to start one takes as long as a short loop."""
    return ThreadPoolExecutor(threads, "jaxbl-loop")


def make_stage_counter(stages: int, progress: Progress | None) -> Callable[[], None]:
    """Return a function to be called after each stage: it tells `progress` how many stages are finished."""
    finished = itertools.count(1)
    return lambda: progress(next(finished), stages) if progress is not None else None


_job_running = _interrupted = False


def _handle_interrupt(number: int, frame: object) -> None:
    """Interrupt the running job, and let no further one begin.

    Between two jobs nothing is raised, since that would end the process with a traceback.
    """
    global _interrupted
    _interrupted = True
    if _job_running:
        raise KeyboardInterrupt


PROGRAMS_VARIABLE = "JAXBL_PROGRAMS"
"""Environment variable with the folder of compiled programs (:mod:`jaxbl.fused.program_cache`). Without it, or
where it is empty, programs are not stored."""


def start_jax(devices: int | None = None) -> None:
    """Prepare JAX: `devices` CPU devices (left out: one a core), and compiled programs stored between runs."""
    # as limit_blas_threads does; it has to be set before NumPy is loaded
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    import jax

    collect_garbage_rarely()
    _ignore_cache_warnings()
    if "xla_force_host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        # JAX has started already in a worker process that does a second job
        with suppress(RuntimeError):
            jax.config.update("jax_num_cpu_devices", count_cores() if devices is None else devices)
    # the results of every program are awaited anyway, and handing it to another thread takes longer than many programs run
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    if jax.config.values["jax_compilation_cache_dir"] is None:
        # a folder for each version of Python: each packs programs in its own way
        cache = _find_cache_folder()
        if cache is not None:
            jax.config.update("jax_compilation_cache_dir", str(cache))
        # store programs that compile in less than a second, too: a study has many of them
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    # the package's own store finds programs without tracing them; worker processes read the same variable
    folder = jax.config.values["jax_compilation_cache_dir"]
    os.environ.setdefault(PROGRAMS_VARIABLE, f"{folder}/programs" if folder else "")


def _find_cache_folder() -> Path | None:
    """The folder of compiled programs among the user's caches; None if it cannot be made private to this user."""
    caches = Path(os.environ.get("XDG_CACHE_HOME", ""))
    # the XDG base directory specification ignores an empty or relative path
    try:
        folder = (caches if caches.is_absolute() else Path.home() / ".cache") / "jaxbl"
    except RuntimeError:
        return None  # a user without a home
    private = make_private_folder(folder)
    return private and make_private_folder(private / sys.implementation.cache_tag)


def make_private_folder(folder: Path) -> Path | None:
    """Make a folder for compiled code, readable by this user alone if it is new.

    Returns its place without links if it belongs to this user, nobody else may write into it, and nobody else can put
    another folder in its place. Otherwise one line is printed.
    """
    try:
        folder = folder.resolve()
        folder.parent.mkdir(parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        fault = _find_fault(folder)
    except (OSError, RuntimeError):  # a circle of links
        return None
    if fault and folder not in _refused_folders:
        _refused_folders.add(folder)
        print(f"jaxbl: {escape_unprintable(fault)}; compiled programs are not stored there", file=sys.stderr)
    return None if fault else folder


def _find_fault(folder: Path) -> str:
    """Say through which folder others could change what is stored in this one; "" if they cannot."""
    if not hasattr(os, "geteuid"):  # on Windows a user's own folders are closed to others
        return ""
    user, group, system = os.geteuid(), os.getegid(), Path(folder.anchor).stat().st_uid
    for place in (folder, *folder.parents):
        status, above = place.stat(), place != folder
        if status.st_uid != user and not (above and status.st_uid == system):
            return f"{place}: is another user's"
        # a sticky folder lets nobody move what is another's; where users have groups of their own, these may write
        write_bits = 0o002 if above and status.st_gid == group else 0o022
        if status.st_mode & write_bits and not (above and status.st_mode & stat.S_ISVTX):
            remedy = "chmod go-w closes it" if above else "remove it, to have it made anew"
            return f"{place}: can be written to by others; {remedy}"
    return ""


_refused_folders: set[Path] = set()
"""Folders for which the line was printed."""


def collect_garbage_rarely() -> None:
    """Collect garbage less often: what JAX makes while it traces stays reachable, and searching it takes a tenth of a
    command's time (benchmarks/NOTES.md)."""
    gc.set_threshold(200_000, 50, 100)


def _ignore_cache_warnings() -> None:
    """Silence JAX's warning about a stored program that another process is still writing; it compiles the program itself."""
    warnings.filterwarnings("ignore", "Error reading persistent compilation cache entry", UserWarning)


def _start_process(cache: str | None, compile_time: float) -> None:
    """Prepare a worker process; programs that compile in less than `compile_time` (s) are not stored in the cache."""
    import jax

    collect_garbage_rarely()
    _ignore_cache_warnings()
    signal.signal(signal.SIGINT, _handle_interrupt)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    # nothing else tells a worker that its parent was killed
    threading.Thread(target=_end_with_parent, daemon=True).start()
    jax.config.update("jax_compilation_cache_dir", cache)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", compile_time)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _run_job(function: Callable[[Job], Result], job: Job) -> Result:
    global _job_running
    if _interrupted:
        raise KeyboardInterrupt
    _job_running = True
    try:
        return function(job)
    finally:
        _job_running = False


def clear_programs_if_needed() -> None:
    """Clear JAX's caches if this process is near the system's limit of memory mappings.

    Each length of a log has programs of its own, and each program some mappings.
    """
    import jax

    with suppress(OSError):
        count = Path("/proc/self/maps").read_bytes().count(b"\n")
        if count > _MAPPING_LIMIT:
            jax.clear_caches()
