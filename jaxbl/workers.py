"""Independent jobs on all cores, in processes of their own: progress, interrupts, and memory of compiled programs."""

import gc
import multiprocessing
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from threadpoolctl import threadpool_limits

from .errors import NoResult, printable

Job = TypeVar("Job")
Result = TypeVar("Result")

Progress = Callable[[int, int], None]
"""Called with the number of finished and of all lanes."""

_listeners: list[Callable[[str], None]] = []

_MEMORY = 5 * 2**30
"""Bytes that a process is granted: after twenty logs of many lengths one held 4.7e9."""
_MOST_MAPPINGS = 30_000
"""Half of what Linux allows a process by default."""


@contextmanager
def listening(listener: Callable[[str], None]) -> Iterator[None]:
    """Hear what is being done (:func:`doing`)."""
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


def doing(what: str) -> None:
    """Say what is being done now, in a few words: the progress line of a terminal shows it."""
    for listener in _listeners:
        listener(what)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Keep BLAS to one thread: matrices are small here, and where cores are shared threads wait longer for one another than
    they compute."""
    with threadpool_limits(1, "blas"):
        yield


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def worth(jobs: int) -> int:
    """Processes that so many jobs are worth: one a core, as memory allows; an accelerator serves one alone."""
    import jax

    if jax.default_backend() != "cpu":
        return 1
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return max(min(cores(), memory // _MEMORY, jobs), 1)


def each(function: Callable[[Job], Result], jobs: Sequence[Job], processes: int) -> Iterator[Result]:
    """Results of a function (importable by name), in the order of its arguments, by so many processes; 1 is this one.

    An interrupt reaches the jobs under way, and no further ones begin.

    Raises:
        NoResult: a process was killed.
    """
    if processes == 1:
        yield from map(function, jobs)
        return
    import jax

    # a process that was forked would share the locks of this one's compiler
    context = multiprocessing.get_context("spawn")
    cache = jax.config.values["jax_compilation_cache_dir"], jax.config.values["jax_persistent_cache_min_compile_time_secs"]
    with ProcessPoolExecutor(processes, context, _prepare, cache) as pool:
        futures = [pool.submit(_interruptible, function, job) for job in jobs]
        try:
            for one in futures:
                yield one.result()
        except BrokenProcessPool:
            raise NoResult("a process was killed, perhaps for want of memory; --jobs 1 takes least of it") from None
        finally:
            if not all(one.done() for one in futures):
                for one in futures:
                    one.cancel()
                for child in multiprocessing.active_children():
                    with suppress(ProcessLookupError):
                        os.kill(child.pid, signal.SIGINT)  # pyright: ignore[reportArgumentType]


_busy = _stopped = False


def _interrupted(number: int, frame: object) -> None:
    """Between two jobs an interrupt would end the process with a traceback; jobs that wait in its queue must not begin."""
    global _stopped
    _stopped = True
    if _busy:
        raise KeyboardInterrupt


PROGRAMS = "JAXBL_PROGRAMS"
"""Name of the environment variable with the folder of compiled programs (:mod:`jaxbl.fused.program_cache`). Without it, or
where it is empty, no program is kept."""


def start_jax(devices: int | None = None) -> None:
    """Use every core as a device, or so many, and keep compiled programs between runs."""
    # matrices are small here: threads of BLAS would wait for one another longer than they compute; before NumPy is loaded
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    import jax

    collect_rarely()
    _ignore_cache_warnings()
    if "xla_force_host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        # it has begun already: a later job of one worker
        with suppress(RuntimeError):
            jax.config.update("jax_num_cpu_devices", cores() if devices is None else devices)
    # every program's results are waited for: to hand each to another thread takes longer than many of them run
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    if jax.config.values["jax_compilation_cache_dir"] is None:
        # of this Python's own: another one packs programs otherwise
        cache = _cache()
        if cache is not None:
            jax.config.update("jax_compilation_cache_dir", str(cache))
        # also what takes less than a second: a study has many of them
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    # and what was compiled is found without tracing it; processes that this one starts do so, too
    folder = jax.config.values["jax_compilation_cache_dir"]
    os.environ.setdefault(PROGRAMS, f"{folder}/programs" if folder else "")


def _cache() -> Path | None:
    """The folder of compiled programs among the user's caches; None where it cannot be had, or is not only this user's."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    # an empty or relative one says nothing, by the XDG base directory specification
    try:
        folder = (Path(given) if Path(given).is_absolute() else Path.home() / ".cache") / "jaxbl"
    except RuntimeError:
        return None  # a user without a home
    own = folder / sys.implementation.cache_tag
    return own if own_folder(folder) and own_folder(own) else None


def own_folder(folder: Path) -> bool:
    """Make a folder for what will be run as code, with access for its user alone if it is new.

    Returns whether it is there, this user's, and nobody else may write into it; one line says so where it is not.
    """
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.stat()
    except OSError:
        return False
    why = ""
    if found.st_uid != os.geteuid():
        why = "is another user's"
    elif found.st_mode & 0o022:
        why = "can be written to by others; remove it, to have it made anew"
    if why and folder not in _refused:
        _refused.add(folder)
        print(f"jaxbl: {printable(str(folder))}: {why}; compiled programs are not kept there", file=sys.stderr)
    return not why


_refused: set[Path] = set()
"""Folders of which that was said."""


def collect_rarely() -> None:
    """Look for unreachable objects less often: what JAX makes while it traces lives on, and searching it takes a tenth of a
    command's time (benchmarks/NOTES.md)."""
    gc.set_threshold(200_000, 50, 100)


def _ignore_cache_warnings() -> None:
    """JAX warns of a kept program that another process is still writing, and compiles it."""
    warnings.filterwarnings("ignore", "Error reading persistent compilation cache entry", UserWarning)


def _prepare(cache: str | None, least: float) -> None:
    import jax

    collect_rarely()
    _ignore_cache_warnings()
    signal.signal(signal.SIGINT, _interrupted)
    # nothing else tells a process that the one it works for was killed
    threading.Thread(target=_end_with_parent, daemon=True).start()
    jax.config.update("jax_compilation_cache_dir", cache)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", least)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _interruptible(function: Callable[[Job], Result], job: Job) -> Result:
    global _busy
    if _stopped:
        raise KeyboardInterrupt
    _busy = True
    try:
        return function(job)
    finally:
        _busy = False


def forget_programs() -> None:
    """Let go of compiled programs before those of logs of many lengths use up the mappings that the system allows."""
    import jax

    with suppress(OSError):
        count = Path("/proc/self/maps").read_bytes().count(b"\n")
        if count > _MOST_MAPPINGS:
            jax.clear_caches()
