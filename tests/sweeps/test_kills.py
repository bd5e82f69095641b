"""Studies whose processes are killed at any moment: gone on with, they end in the bytes of one that was left alone, no chunk
is computed twice once its part was whole, and nothing else is left in the folder."""

import multiprocessing
import random
import signal
import socket
import sys
import time
from contextlib import contextmanager
from importlib import import_module

import dask
import pytest
from small_study import read_parts, spaced_axis, thirty_run_study

from small_study import ALPHA, LAMBDA  # isort: skip

from jaxbl.errors import NoResult
from jaxbl.sweeps.sweep import share, sweep

# a process that has loaded everything and started nothing: its children begin at once
CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["jaxbl.sweeps.sweep", "distributed.cli.dask_worker", "distributed.cli.dask_scheduler"])


def study(points=120):
    """Runs in as many chunks, of some milliseconds each, without the metrics that take longest to compile."""
    axes = [spaced_axis(ALPHA, 5.0, 20.0, points // 10), spaced_axis(LAMBDA, 0.3, 5.0, 10)]
    sweep = {"seeds": 4, "chunk": 4, "metrics": ["converged", "velocity_rmse"]}
    return thirty_run_study(axes=axes, sweep=sweep, run={"duration": 1.0, "substeps": 1})


def _sweep(folder, scheduler=None):
    try:
        sweep(study(), folder, scheduler=scheduler, backend="fused")
    except NoResult:
        sys.exit(1)


def _share(folder, position):
    share(study(), folder, position)


@pytest.fixture(scope="module")
def undisturbed_run(tmp_path_factory):
    """Parts of the study that was left alone, and the seconds that it took."""
    folder = tmp_path_factory.mktemp("alone") / "study"
    times = []
    for _ in range(2):
        # the second time all is compiled
        start = time.monotonic()
        run = start_process(_sweep, folder)
        run.join()
        assert run.exitcode == 0
        times.append(time.monotonic() - start)
        result = read_parts(folder)
        for path in (folder / "points").iterdir():
            path.unlink()
    return result, times[1]


def start_process(function, *inputs):
    process = CONTEXT.Process(target=function, args=inputs)
    process.start()
    return process


def expected_frame(folder, expected):
    """Parts that are whole, with what changes when one is written again."""
    actual = {path.name: path for path in (folder / "points").glob("part-*")} if (folder / "points").is_dir() else {}
    return {
        name: (path.stat().st_ino, path.stat().st_mtime_ns)
        for name, path in actual.items()
        if path.read_bytes() == expected[name]
    }


def check_completion(folder, expected):
    """The study goes on to its end, and is what it would have been."""
    sweep(study(), folder)
    assert read_parts(folder) == expected
    assert not list(folder.rglob(".*")) and not (folder / "damaged").exists()


def test_killed_at_random_moments(tmp_path, undisturbed_run, repeats):
    expected, seconds = undisturbed_run
    rng = random.Random(0)
    kills = rounds = 0
    while kills < repeats(4, 200):
        folder, rounds, before = tmp_path / f"{rounds}", rounds + 1, {}
        while True:
            process = start_process(_sweep, folder)
            process.join(rng.uniform(0.1, 1.0) * seconds)
            if process.exitcode is None:
                process.kill()
                process.join()
                kills += 1
            parts_after = expected_frame(folder, expected)
            assert before.items() <= parts_after.items(), "a chunk was computed twice"
            before = parts_after
            if process.exitcode == 0:
                break
        check_completion(folder, expected)


def test_shares_of_which_one_is_killed(tmp_path, undisturbed_run):
    expected, seconds = undisturbed_run
    processes = [start_process(_share, tmp_path / "study", (number, 3)) for number in (1, 2, 3)]
    time.sleep(0.7 * seconds)
    processes[1].kill()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0, -signal.SIGKILL, 0]
    before = expected_frame(tmp_path / "study", expected)
    assert 2 * len(expected) // 3 <= len(before) < len(expected)
    check_completion(tmp_path / "study", expected)
    assert before.items() <= expected_frame(tmp_path / "study", expected).items()


def _run_dask(module, words):
    """The command of Dask in this module; a process that is killed is not the fault of the work that it had."""
    dask.config.set({"distributed.scheduler.allowed-failures": 10})
    import_module(module).main(words)


@contextmanager
def run_dask(module, *words):
    """A process of a cluster."""
    process = start_process(_run_dask, module, words)
    try:
        yield process
    finally:
        process.kill()
        process.join()


def run_worker(address, folder):
    words = ("--no-nanny", "--nthreads", "1", "--no-dashboard", "--local-directory", str(folder), "--death-timeout", "60")
    return run_dask("distributed.cli.dask_worker", address, *words)


def run_scheduler(port):
    return run_dask("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard")


def wait_until(condition, seconds=120.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def count_parts(folder):
    return len(list((folder / "points").glob("part-*"))) if (folder / "points").is_dir() else 0


def test_a_worker_the_client_and_the_scheduler_are_killed(tmp_path, undisturbed_run):
    expected, _ = undisturbed_run
    folder = tmp_path / "study"
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    with run_worker(address, tmp_path / "a") as first, run_worker(address, tmp_path / "b"):
        with run_scheduler(port):
            client = start_process(_sweep, folder, address)
            wait_until(lambda: count_parts(folder) >= 8)
            # a worker, wherever it is, and a late one is welcome
            first.kill()
            with run_worker(address, tmp_path / "c"):
                wait_until(lambda: count_parts(folder) >= 30)
                client.kill()
                client.join()
                before = expected_frame(folder, expected)
                client = start_process(_sweep, folder, address)
                wait_until(lambda: count_parts(folder) >= 40)
        # the scheduler is gone
        client.join(60.0)
        assert client.exitcode == 1
        parts_after = expected_frame(folder, expected)
        assert before.items() <= parts_after.items() and len(parts_after) < len(expected)
    with run_scheduler(port), run_worker(address, tmp_path / "d"):
        client = start_process(_sweep, folder, address)
        client.join(120.0)
        assert client.exitcode == 0
    assert parts_after.items() <= expected_frame(folder, expected).items()
    check_completion(folder, expected)
