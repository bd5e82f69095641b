"""Jobs in processes of their own."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import h5py
import jax
import numpy as np
import pandas as pd
import pytest
import scipy.io
from command_server import Process
from small_study import ALPHA, listed_axis, multisine_study, rigid_study, small_study

import jaxbl
from jaxbl import workers
from jaxbl.config import read_config
from jaxbl.errors import InputError, NoResult
from jaxbl.files import _try_lock_bytes
from jaxbl.records import read_record
from jaxbl.sweeps.engine import Engine
from jaxbl.workers import (
    _find_cache_folder,
    announce,
    check_cost,
    clear_programs_if_needed,
    map_jobs,
    subscribe,
    useful_processes,
)


def square(x):
    return x * x


def raise_error(x):
    raise ValueError(f"not {x}")


def kill_itself(x):
    os.kill(os.getpid(), signal.SIGKILL)


def wait_a_minute(folder):
    try:
        # within: an interrupt may come as soon as the file is there
        (folder / f"{os.getpid()}").touch()
        time.sleep(60.0)
    except KeyboardInterrupt:
        (folder / "interrupted").touch()
        raise


def is_alive(process):
    try:
        state = Path(f"/proc/{process}/stat").read_text()
    except FileNotFoundError:
        return False
    return state.rpartition(")")[2].split()[0] != "Z"


@pytest.mark.parametrize("processes", [1, 2])
def test_results_come_in_order(processes):
    assert list(map_jobs(square, [3, 1, 2], processes)) == [9, 1, 4]
    with pytest.raises(ValueError, match="not 7"):
        list(map_jobs(raise_error, [7], processes))


def test_a_killed_process_is_told():
    with pytest.raises(NoResult, match="a worker process was killed"):
        list(map_jobs(kill_itself, [1, 2], 2))


def test_an_interrupt_reaches_the_jobs_under_way(tmp_path, default_interrupt):
    def interrupt():
        while not any(tmp_path.iterdir()):
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    start = time.monotonic()
    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyboardInterrupt):
        list(map_jobs(wait_a_minute, [tmp_path] * 9, 2))
    assert (tmp_path / "interrupted").exists() and time.monotonic() - start < 50.0
    assert len(list(tmp_path.iterdir())) <= 3


def test_processes_end_with_the_one_they_work_for(tmp_path):
    code = "import sys, pathlib, test_workers as t; list(t.map_jobs(t.wait_a_minute, [pathlib.Path(sys.argv[1])], 2))"
    with Process(["-c", code, str(tmp_path)], Path(__file__).parent, dict(os.environ)) as parent:
        while not (files := list(tmp_path.iterdir())) and parent.poll() is None:
            time.sleep(0.05)
        parent.kill()
    child = int(files[0].name)
    for _ in range(200):
        if not is_alive(child):
            return
        time.sleep(0.05)
    raise AssertionError("it still runs")


def test_there_is_a_process_for_each_core_and_no_more_than_jobs():
    assert useful_processes(1) == 1
    assert 1 <= useful_processes(10_000) <= (os.cpu_count() or 1)


def test_programs_are_forgotten_once_they_are_many(monkeypatch):
    calls = []
    monkeypatch.setattr(jax, "clear_caches", lambda: calls.append(1))
    clear_programs_if_needed()
    monkeypatch.setattr("jaxbl.workers._MAPPING_LIMIT", 10)
    clear_programs_if_needed()
    assert len(calls) == 1


def test_what_is_being_done_is_heard_while_someone_listens():
    announcements = []
    announce("before")
    with subscribe(announcements.append):
        announce("trying load.gravity")
    announce("afterwards")
    assert announcements == ["trying load.gravity"]


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(workers, "_refused_folders", set())
    return tmp_path


@pytest.mark.parametrize("caches", [None, "", "relative"])
def test_compiled_programs_are_kept_in_a_folder_of_the_user_alone(home, monkeypatch, caches):
    """An empty or relative XDG_CACHE_HOME says nothing, least of all the working folder."""
    monkeypatch.chdir(home)
    if caches is not None:
        monkeypatch.setenv("XDG_CACHE_HOME", caches)
    folder = home / ".cache" / "jaxbl"
    assert _find_cache_folder() == folder / sys.implementation.cache_tag
    assert [path.stat().st_mode & 0o777 for path in (folder, _find_cache_folder())] == [0o700, 0o700]
    assert [path.name for path in home.iterdir()] == [".cache"]


@pytest.mark.parametrize("depth", range(3))
@pytest.mark.parametrize("mode", [0o777, 0o757, 0o702, 0o1777, 0o755, 0o711])
def test_compiled_programs_are_not_kept_where_others_can_put_another_folder(home, monkeypatch, capsys, mode, depth):
    """A folder is checked once, and read from later; in a sticky one nobody can move it."""
    caches = home / "a" / "b" / "c"
    monkeypatch.setenv("XDG_CACHE_HOME", str(home / "link"))
    caches.mkdir(parents=True)
    (home / "link").symlink_to(caches)
    place = (caches, *caches.parents)[depth]
    place.chmod(mode)
    if mode & 0o002 and not mode & 0o1000:
        assert _find_cache_folder() is None
        line = f"jaxbl: {place}: can be written to by others; chmod go-w closes it; compiled programs are not stored there"
        assert capsys.readouterr().err == f"{line}\n"
        place.chmod(0o755)
    folder = _find_cache_folder()
    # a link that is turned elsewhere afterwards moves nothing
    assert folder == caches / "jaxbl" / sys.implementation.cache_tag and not capsys.readouterr().err


def test_compiled_programs_of_others_are_not_run(home, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(home / "caches"))
    folder = home / "caches" / "jaxbl"
    assert _find_cache_folder() == folder / sys.implementation.cache_tag
    folder.chmod(0o770)
    assert [_find_cache_folder(), _find_cache_folder()] == [None, None]
    line = (
        f"jaxbl: {folder}: can be written to by others; remove it, to have it made anew; "
        "compiled programs are not stored there"
    )
    assert capsys.readouterr().err == f"{line}\n"
    folder.chmod(0o700)
    monkeypatch.setattr(os, "geteuid", lambda: folder.stat().st_uid + 1)
    assert _find_cache_folder() is None


def test_a_user_without_a_home_keeps_no_programs(home, monkeypatch):
    monkeypatch.delenv("HOME")
    monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError("no home")))
    assert _find_cache_folder() is None


def test_a_program_that_another_process_is_still_writing_is_compiled_in_silence(tmp_path):
    program = "from jaxbl.workers import start_jax; start_jax(); import jax; print(jax.jit(lambda x: 3 * x)(2.0))"
    command = [sys.executable, "-W", "error", "-c", program]
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path)}
    subprocess.run(command, env=environment, check=True, capture_output=True)
    entries = list(tmp_path.glob("*-cache"))
    assert entries
    for entry in entries:
        entry.write_bytes(entry.read_bytes()[:100])
    second = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    assert second.stdout == "6.0\n"
    assert not second.stderr


def test_what_windows_has_not_is_not_needed(tmp_path):
    """Main commands, in a process where the package finds no module, function of `os` or signal of POSIX alone."""
    study = rigid_study(axes=[listed_axis(ALPHA, 5.0, 9.0)])
    (tmp_path / "study.toml").write_text(read_config(study).to_toml())
    (tmp_path / "gap.toml").write_text(read_config(small_study({"run.duration": 1.0})).to_toml())
    commands = (
        "simulate study.toml --out run",
        "sweep study.toml --out map",
        # what is there is found again
        "sweep study.toml --out map",
        "sweep study.toml --share 1/1 --out shared",
        "plot map",
        "status map",
        "explore map --static page",
        "compare map shared --out compared",
        "export study.toml --out code",
        "simulate gap.toml --out gap",
        "inspect gap/trace.parquet --out seen",
        "identify gap/trace.parquet --model gap.toml --out found",
        "watch gap/trace.parquet --model gap.toml --window 0.5 --every 0.2 --out watched",
    )
    program = [sys.executable, Path(__file__).parent / "windows.py", *commands]
    # a folder of programs as a user has it, not that of the tests
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAXBL_")}
    result = subprocess.run(
        program,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        env=environment | {"XDG_CACHE_HOME": str(tmp_path)},
    )
    assert result.returncode == 0, result.stderr
    folders = "run", "map", "shared", "compared", "gap", "seen", "found", "watched"
    assert all((tmp_path / folder / "report.html").is_file() for folder in folders)
    assert not list(tmp_path.rglob(".lock"))


def test_locks_of_windows_exclude_one_another(tmp_path, monkeypatch):
    """By bytes of a file: that of a process that shares the folder lies among those of one that has it for itself."""
    locked = []

    def lock(number, mode, length):
        place = os.lseek(number, 0, os.SEEK_CUR)
        if any(place < end and begin < place + length for begin, end in locked):
            raise OSError
        locked.append((place, place + length))

    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(locking=lock, LK_NBLCK=2))
    with (tmp_path / "lock").open("w+") as file:
        assert _try_lock_bytes(file, shared=True) and not _try_lock_bytes(file, shared=False)
        locked.clear()
        assert _try_lock_bytes(file, shared=False) and not _try_lock_bytes(file, shared=True)


def test_what_memory_cannot_hold_is_refused_and_what_takes_long_is_said(monkeypatch):
    monkeypatch.setattr(workers, "count_memory", lambda: 8_000_000_000)
    with pytest.raises(InputError, match=r"^a trace takes 9 GB of memory; here are 8 GB; make it shorter$"):
        check_cost("a trace", 9e9, "make it shorter", 1e4)
    said = []
    with subscribe(said.append):
        for seconds in (0.0, 9.0, 90.0, 7200.0, 1e6):
            check_cost("it", 7e9, "", seconds)
    assert said == ["it: takes about 90.0 s", "it: takes about 2.0 h", "it: takes about 277.8 h"]


def cost_simulation(folder, scale):
    jaxbl.run(small_study({"run.duration": 1e3 * scale}))


def cost_chunk(folder, scale):
    jaxbl.dry_run(small_study({"sweep.seeds": 10**9, "sweep.chunk": int(4e6 * scale)}))


def cost_list_of_chunks(folder, scale):
    Engine(read_config(small_study({"sweep.seeds": int(2e7 * scale), "sweep.chunk": 2}))).chunk_order()


def cost_window(folder, scale):
    jaxbl.watch("udp://127.0.0.1:1", multisine_study(1.0), window=1e3 * scale, ended=lambda: True)


def cost_parquet(folder, scale):
    log = pd.DataFrame({name: np.zeros(int(1e6 * scale)) for name in ("t", "u", "theta_e", "theta_s")})
    log["t"] = np.arange(len(log)) * 1e-3
    log.to_parquet(folder / "log.parquet")
    read_record(folder / "log.parquet")


def cost_hdf5(folder, scale):
    with h5py.File(folder / "log.h5", "w") as file:
        for name in ("t", "u", "theta_e", "theta_s"):
            file.create_dataset(name, data=np.zeros(int(1e6 * scale)), compression="gzip")
    read_record(folder / "log.h5")


def cost_matlab(folder, scale):
    columns = {name: np.zeros((int(1e6 * scale), 1)) for name in ("t", "u", "theta_e", "theta_s")}
    scipy.io.savemat(folder / "log.mat", columns, do_compression=True)
    read_record(folder / "log.mat")


@pytest.mark.parametrize(
    "task",
    [cost_simulation, cost_chunk, cost_list_of_chunks, cost_window, cost_parquet, cost_hdf5, cost_matlab],
)
def test_each_command_refuses_what_the_machine_cannot_hold(task, tmp_path, monkeypatch):
    """In one line and before it begins; the size is drawn anew for each."""
    scale = np.random.default_rng(len(task.__name__)).uniform(1.0, 2.0)
    monkeypatch.setattr(workers, "count_memory", lambda: 50_000_000)
    monkeypatch.setattr("jaxbl.records.files._VALUE_BYTES", 60.0)
    with pytest.raises(InputError, match=r"takes \d[\d.]* GB of memory; here are 0\.05 GB; ") as error:
        task(tmp_path, scale)
    assert "\n" not in str(error.value)


def test_a_study_of_a_billion_seeds_has_its_chunks_at_once():
    """All seeds, each in one chunk, without a list of them."""
    engine = Engine(read_config(small_study({"sweep.seeds": 10**9, "sweep.first_seed": 5})))
    chunks = [engine.chunk(index) for index in (0, 1, len(engine) - 1)]
    assert chunks[0].seeds[0] == 5
    assert chunks[1].seeds[0] == chunks[0].seeds[-1] + 1
    assert chunks[2].seeds[-1] == 10**9 + 4
