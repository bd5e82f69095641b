"""Studies on a cluster: the table that one process gives, parts that are there left out, and what goes wrong in one line."""

import contextlib
import itertools
import socket
import time
from contextlib import ExitStack
from threading import Event, Thread, Timer

import jax
import pandas as pd
import pytest
from distributed import Client, LocalCluster, Security
from small_study import ALPHA, LAMBDA, read_parts, spaced_axis, thirty_run_study

from jaxbl import cluster
from jaxbl.cluster import Cluster, connect
from jaxbl.config import read_config
from jaxbl.errors import InputError, NoResult
from jaxbl.files import FolderInUse, lock_folder
from jaxbl.gains.stages import open_stages
from jaxbl.sweeps.bundles import _bundle_size, compute_bundle
from jaxbl.sweeps.status import status
from jaxbl.sweeps.sweep import submit, sweep
from jaxbl.workers import subscribe

pytestmark = pytest.mark.usefixtures("compiled_once")

_submit = Cluster._submit


def test_the_same_table_by_workers_of_which_each_chunk_is_computed_once(tmp_path, client, computed_chunks):
    expected = sweep(thirty_run_study(), tmp_path / "alone")
    count = len(computed_chunks)
    computed_chunks.clear()
    calls = []
    result = sweep(thirty_run_study(), tmp_path / "cluster", scheduler=client, progress=lambda *done: calls.append(done))
    assert sorted(computed_chunks) == list(range(count)) and count == 8
    assert read_parts(tmp_path / "cluster") == read_parts(tmp_path / "alone")
    pd.testing.assert_frame_equal(result.frame, expected.frame, check_exact=True)
    assert result.cost["lanes"] == 30 and result.cost["run_seconds"] > 0.0
    assert calls[-1] == (30, 30) and calls == sorted(calls)
    # what is there is left out
    lost = tmp_path / "cluster" / "points" / "part-00003.parquet"
    lost.unlink()
    computed_chunks.clear()
    # the last points of the first seed
    assert sweep(thirty_run_study(), tmp_path / "cluster", scheduler=client).cost["lanes"] == 3
    assert computed_chunks == [3]
    assert read_parts(tmp_path / "cluster") == read_parts(tmp_path / "alone")
    # what is damaged is told by whom it was found
    lost.write_bytes(lost.read_bytes()[:-100])
    assert len(sweep(thirty_run_study(), tmp_path / "cluster", scheduler=client).damaged) == 1
    assert read_parts(tmp_path / "cluster") == read_parts(tmp_path / "alone")
    assert not list(tmp_path.rglob(".*"))


def test_processes_of_this_machine_give_the_same_table(tmp_path):
    lanes = {"seeds": 2, "metrics": ["velocity_rmse"]}
    data = thirty_run_study(sweep=lanes | {"chunk": 4})
    sweep(data, tmp_path / "alone")
    full_frame = sweep(thirty_run_study(sweep=lanes | {"chunk": 256}), tmp_path / "whole", devices=jax.devices()[:1]).frame
    study = sweep(data, tmp_path / "study", scheduler="local:2")
    assert read_parts(tmp_path / "study") == read_parts(tmp_path / "alone")
    # in other chunks, on one device
    points = [ALPHA, LAMBDA, "seed"]
    frames = [frame.sort_values(points, ignore_index=True) for frame in (study.frame, full_frame)]
    pd.testing.assert_frame_equal(*frames, check_exact=True)


def test_workers_of_a_client_that_was_lost_are_waited_for(tmp_path, client):
    with ExitStack() as stack:
        stack.enter_context(lock_folder(tmp_path / "study", shared=True))
        with pytest.raises(FolderInUse):
            sweep(thirty_run_study(), tmp_path / "study")
        Timer(1.0, stack.pop_all().close).start()
        assert sweep(thirty_run_study(), tmp_path / "study", scheduler=client).cost["lanes"] == 30


def test_a_refined_study_on_a_cluster(tmp_path, client):
    axes = [spaced_axis(ALPHA, 5.0, 20.0, 9), spaced_axis(LAMBDA, 0.3, 5.0, 9)]
    refined_data = thirty_run_study(axes=axes, sweep={"seeds": 2, "chunk": 16, "refine": 2})
    expected = sweep(refined_data, tmp_path / "alone")
    sweep(refined_data, tmp_path / "cluster", scheduler=client)
    assert read_parts(tmp_path / "cluster") == read_parts(tmp_path / "alone")
    # grids of 9 x 9 and 33 x 33
    assert 2 * 9**2 < len(expected.frame) < 2 * 33**2


def test_stages_of_verify_and_tune_on_a_cluster(tmp_path, client, computed_chunks, monkeypatch):
    submitted = []
    monkeypatch.setattr(Cluster, "_submit", lambda self, *inputs: submitted.append(inputs) or _submit(self, *inputs))
    with open_stages(read_config(thirty_run_study()), "verify", tmp_path, client) as stages:
        stages.write_manifest()
        assert len(stages.run(thirty_run_study(), "drive").frame) == 30
        assert stages.cost["lanes"] == 30 and len(computed_chunks) == 8
    # the first chunk a worker, then the rest
    assert sum(len(jobs) for _, jobs in submitted) == 8
    assert len(list((tmp_path / "verify" / "drive" / "points").iterdir())) == 8


def test_a_study_that_is_handed_over_goes_on_without_who_did_it(tmp_path, client, computed_chunks):
    folder = tmp_path / "study"
    first = submit(thirty_run_study(), folder, client)
    assert first.parts_in_all == 8 and not first.finished
    deadline = time.monotonic() + 60.0
    while not status(folder).complete and time.monotonic() < deadline:
        time.sleep(0.1)
    assert sorted(computed_chunks) == list(range(8))
    assert not status(folder).finished
    assert sweep(thirty_run_study(), folder).cost["lanes"] == 0
    assert status(folder).finished
    # nothing is left to be done
    assert submit(thirty_run_study(), folder, client).complete
    assert sorted(computed_chunks) == list(range(8))


def test_bundles_take_workers_long_enough_and_are_not_too_many():
    # chunks of 0.1 s, many of them; few of them, four bundles a worker; so many that a scheduler would suffer; unknown time
    assert _bundle_size(0.1, 100_000, 10) == 200
    assert _bundle_size(0.1, 400, 10) == 10
    assert _bundle_size(30.0, 1_000_000, 10) == 20
    assert _bundle_size(0.0, 3, 10) == 1


def test_bad_input(tmp_path, client, monkeypatch):
    with pytest.raises(InputError, match="--scheduler local:none: local:N needs the number of processes"):
        sweep(thirty_run_study(), tmp_path / "a", scheduler="local:none")
    monkeypatch.setattr(cluster, "_ANSWER_SECONDS", 0.3)
    with pytest.raises(InputError, match=r"--scheduler tcp://127.0.0.1:1: no Dask scheduler answers there"):
        sweep(thirty_run_study(), tmp_path / "a", scheduler="tcp://127.0.0.1:1")
    with pytest.raises(InputError, match="its workers write into a folder; name it with --out"):
        sweep(thirty_run_study(), scheduler=client)
    with pytest.raises(InputError, match="--detach: needs the --scheduler of a cluster that stays"):
        submit(thirty_run_study(), tmp_path / "a", None)
    refined = thirty_run_study(
        axes=[spaced_axis(ALPHA, 5.0, 20.0, 9), spaced_axis(LAMBDA, 0.3, 5.0, 9)], sweep={"refine": 2}
    )
    with pytest.raises(InputError, match=r"--detach: sweep.refine makes points depend on one another"):
        submit(refined, tmp_path / "a", client)
    assert not (tmp_path / "a").exists()
    with pytest.raises(InputError, match=r"nowhere: is not seen by worker .*; --out should name a folder that all machines"):
        compute_bundle(str(tmp_path / "nowhere"), "", False, ())


def _raise_error(job):
    raise {"input": InputError("the job's line"), "module": ModuleNotFoundError("No module named 'x'")}[job]


def test_errors_of_workers_reach_who_asked(client, monkeypatch):
    with connect(client) as workers:
        assert isinstance(workers, Cluster) and workers.workers == 2 and not workers.local
        assert list(workers.map_jobs(abs, [-3, -2, -1])) == [3, 2, 1]
        with pytest.raises(InputError, match="the job's line"):
            list(workers.map_jobs(_raise_error, ["input"]))
        with pytest.raises(InputError, match="its workers lack a module"):
            list(workers.map_jobs(_raise_error, ["module"]))
        requests = [cluster.version("jaxbl")]
        monkeypatch.setattr(cluster, "version", lambda name: requests.pop() if requests else "0.0.1")
        with pytest.raises(InputError, match=r"worker .* has jaxbl 0\.0\.1; install .* there"):
            list(workers.map_jobs(abs, [1]))


def test_jobs_are_taken_as_they_are_needed(client):
    taken_jobs = []
    with connect(client) as workers:
        results = workers.map_jobs(abs, (taken_jobs.append(number) or number for number in itertools.count()))
        assert [next(results) for _ in range(40)] == list(range(40))
        # in flight, and done but not yet asked for
        assert len(taken_jobs) <= 40 + 2 * cluster._FEWEST_AHEAD
        results.close()


_GO_ON = Event()


def _wait_to_go_on(job):
    return job and _GO_ON.wait(60.0)


def test_a_scheduler_that_is_lost_is_said():
    # one thread, so that the job that waits begins after the other
    options = {"n_workers": 1, "threads_per_worker": 1, "processes": False, "dashboard_address": "127.0.0.1:0"}
    with (
        LocalCluster(**options) as cluster,
        Client(cluster, set_as_default=False) as connection,
        connect(connection) as workers,
    ):
        results = workers.map_jobs(_wait_to_go_on, [False, True])
        assert next(results) is False
        connection.close()
        try:
            with pytest.raises(NoResult, match="the connection to the scheduler is lost"):
                next(results)
        finally:
            _GO_ON.set()


def test_workers_are_waited_for_and_not_for_ever(monkeypatch):
    monkeypatch.setattr("jaxbl.cluster._WORKERS_SECONDS", 0.5)
    said = []
    with (
        LocalCluster(n_workers=0, processes=False, dashboard_address="127.0.0.1:0") as cluster,
        Client(cluster, set_as_default=False) as connection,
        connect(connection) as workers,
        subscribe(said.append),
    ):
        with pytest.raises(NoResult, match=r"^no worker has come for 0\.5 s; what is finished is kept"):
            list(workers.map_jobs(_wait_to_go_on, [False]))
        assert set(said) == {"waiting for workers: the scheduler has none"}
        # one that comes late is welcome
        monkeypatch.setattr("jaxbl.cluster._WORKERS_SECONDS", 60.0)
        results = workers.map_jobs(_wait_to_go_on, [False])
        Timer(1.0, cluster.scale, [1]).start()
        assert list(results) == [False]


def listen_silently(folder):
    server = socket.create_server(("127.0.0.1", 0))
    return f"tcp://127.0.0.1:{server.getsockname()[1]}", server


def listen_as_a_web_server(folder):
    server = socket.create_server(("127.0.0.1", 0))

    def answer():
        with contextlib.suppress(OSError):
            while True:
                connection, _ = server.accept()
                connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")
                connection.close()

    Thread(target=answer, daemon=True).start()
    return f"tcp://127.0.0.1:{server.getsockname()[1]}", server


def write_file(text):
    def write(folder):
        (folder / "scheduler.json").write_text(text)
        return str(folder / "scheduler.json"), None

    return write


WRONG_SCHEDULERS = {
    "silent port": listen_silently,
    "web server": listen_as_a_web_server,
    "nobody": lambda folder: ("tcp://127.0.0.1:1", None),
    "no file": lambda folder: (str(folder / "absent.json"), None),
    "folder": lambda folder: ((folder / "scheduler.json").mkdir() or str(folder / "scheduler.json"), None),
    "empty file": write_file(""),
    "file without an address": write_file('{"id": 1}'),
    "file of a list": write_file("[1]"),
    "file of another kind of address": write_file('{"address": {"a": 1}}'),
    "no address": lambda folder: ("scheduler", None),
    "unknown protocol": lambda folder: ("gopher://127.0.0.1:1", None),
    "too many processes": lambda folder: ("local:999", None),
}


@pytest.mark.parametrize("place", WRONG_SCHEDULERS.values(), ids=list(WRONG_SCHEDULERS))
def test_a_wrong_scheduler_is_one_line_and_no_wait_without_end(place, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "_ANSWER_SECONDS", 0.5)
    address, server = place(tmp_path)
    said, begin = [], time.monotonic()
    with subscribe(said.append), pytest.raises(InputError, match=r"^--scheduler ") as error, connect(address):
        pass
    assert "\n" not in str(error.value)
    assert time.monotonic() - begin < 30.0
    assert address.startswith("local:") or said == [f"waiting for the scheduler {address}"]
    if server is not None:
        server.close()


def test_no_other_user_can_have_local_workers_run_code():
    """Who knows the port, and not the keys, is refused."""
    with connect("local:1") as workers:
        address = workers._client.scheduler.address
        assert address.startswith("tls://127.0.0.1:")
        with pytest.raises(OSError, match=r"\w"):
            Client(address.replace("tls", "tcp"), timeout=2.0, set_as_default=False)
        with pytest.raises(OSError, match=r"\w"):
            Client(address, timeout=2.0, set_as_default=False, security=Security.temporary())
        assert list(workers.map_jobs(abs, [-1, -2])) == [1, 2]
