"""Jobs in processes of their own."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import pytest

from jaxbl.errors import NoResult
from jaxbl.workers import doing, each, forget_programs, listening, worth


def square(x):
    return x * x


def fails(x):
    raise ValueError(f"not {x}")


def is_killed(x):
    os.kill(os.getpid(), signal.SIGKILL)


def lasts(folder):
    try:
        # within: an interrupt may come as soon as the file is there
        (folder / f"{os.getpid()}").touch()
        time.sleep(60.0)
    except KeyboardInterrupt:
        (folder / "interrupted").touch()
        raise


def alive(process):
    try:
        state = Path(f"/proc/{process}/stat").read_text()
    except FileNotFoundError:
        return False
    return state.rpartition(")")[2].split()[0] != "Z"


@pytest.mark.parametrize("processes", [1, 2])
def test_results_come_in_order(processes):
    assert list(each(square, [3, 1, 2], processes)) == [9, 1, 4]
    with pytest.raises(ValueError, match="not 7"):
        list(each(fails, [7], processes))


def test_a_killed_process_is_told():
    with pytest.raises(NoResult, match="a process was killed"):
        list(each(is_killed, [1, 2], 2))


@pytest.fixture
def heeded():
    """Interrupts, which a test runner's own processes may ignore."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_an_interrupt_reaches_the_jobs_under_way(tmp_path, heeded):
    def interrupt():
        while not any(tmp_path.iterdir()):
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    start = time.monotonic()
    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyboardInterrupt):
        list(each(lasts, [tmp_path] * 9, 2))
    assert (tmp_path / "interrupted").exists() and time.monotonic() - start < 50.0
    assert len(list(tmp_path.iterdir())) <= 3


def test_processes_end_with_the_one_they_work_for(tmp_path):
    code = "import sys, pathlib, test_workers as t; list(t.each(t.lasts, [pathlib.Path(sys.argv[1])], 2))"
    paths = os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], env=os.environ | {"PYTHONPATH": paths}) as parent:
        while not (found := list(tmp_path.iterdir())):
            time.sleep(0.05)
        parent.kill()
    child = int(found[0].name)
    for _ in range(200):
        if not alive(child):
            return
        time.sleep(0.05)
    raise AssertionError("it still runs")


def test_there_is_a_process_for_each_core_and_no_more_than_jobs():
    assert worth(1) == 1
    assert 1 <= worth(10_000) <= (os.cpu_count() or 1)


def test_programs_are_forgotten_once_they_are_many(monkeypatch):
    calls = []
    monkeypatch.setattr(jax, "clear_caches", lambda: calls.append(1))
    forget_programs()
    monkeypatch.setattr("jaxbl.workers._MOST_MAPPINGS", 10)
    forget_programs()
    assert len(calls) == 1


def test_what_is_being_done_is_heard_while_someone_listens():
    heard = []
    doing("before")
    with listening(heard.append):
        doing("trying load.gravity")
    doing("afterwards")
    assert heard == ["trying load.gravity"]
