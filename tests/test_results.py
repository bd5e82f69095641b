"""Results of a log in a folder: found again by the same call, unless another command has written over them."""

import json
import os
import pickle
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import pytest

from jaxbl.errors import InputError
from jaxbl.files import MANIFEST, DamagedFile, ResultFolder, lock_folder, read_result, run_or_read


@pytest.fixture
def count_runs(tmp_path):
    """Return a function that asks for a task's result, and returns how often the task was run."""
    tasks = []
    task = SimpleNamespace(record=SimpleNamespace(path=tmp_path / "axis.csv"), identity="abc")

    def write(result, results):
        with results.write_files("identification.json", identity=result.summary["identity"]) as draft:
            for name in ("report.html", "model.toml", "trace.parquet"):
                (draft / name).write_text("its own")
            (draft / "identification.json").write_text(json.dumps(result.summary))

    def call(overwrite=False):
        def run(task):
            tasks.append(task)
            return SimpleNamespace(summary={"identity": "abc", "file": str(task.record.path)})

        file = tmp_path / "out" / "identification.json"
        assert run_or_read(task, file, run, write, overwrite=overwrite)["identity"] == "abc"
        return len(tasks)

    return call


def test_the_same_call_computes_nothing(count_runs):
    assert (count_runs(), count_runs()) == (1, 1)


@pytest.mark.parametrize("how", ["another report", "none"])
def test_results_that_another_command_wrote_over_are_made_again(count_runs, tmp_path, how):
    count_runs()
    report = tmp_path / "out" / "report.html"
    if how == "none":
        report.unlink()
    else:
        report.write_text("of another command")
    assert count_runs() == 2 and report.read_text() == "its own"


@pytest.mark.parametrize("name", ["identification.json", "model.toml", "trace.parquet"])
@pytest.mark.parametrize("damage", ["changed", "removed", "a folder"])
def test_results_that_do_not_agree_with_their_checksum_are_made_again(count_runs, tmp_path, name, damage):
    count_runs()
    file = tmp_path / "out" / name
    before = file.read_bytes()
    if damage == "changed":
        file.write_bytes(before[:-1] + b"?")
    else:
        file.unlink()
        if damage == "a folder":
            (file / "inside").mkdir(parents=True)
    summary = tmp_path / "out" / "identification.json"
    if file == summary:
        with pytest.raises(InputError, match="is missing, damaged or edited; run the command that wrote it again"):
            read_result(summary)
    assert count_runs() == 2 and file.read_bytes() == before
    assert read_result(summary)["identity"] == "abc" and count_runs() == 2


MANIFESTS = {
    "cut off": lambda text: text[: len(text) // 2],
    "empty": lambda text: "",
    "a list": lambda text: "[]",
    "nested": lambda text: "[" * 100_000,
    "no checksum": lambda text: json.dumps({name: value for name, value in json.loads(text).items() if name != "checksum"}),
    "a digit": lambda text: text.replace("abc", "abd"),
    "binary": lambda text: "\udcff",
}


@pytest.mark.parametrize("case", MANIFESTS)
def test_a_damaged_manifest_is_made_anew_or_refused(count_runs, tmp_path, case):
    count_runs()
    file, summary = tmp_path / "out" / MANIFEST, tmp_path / "out" / "identification.json"
    for damaged_summary in (False, True):
        count = count_runs()
        file.write_text(MANIFESTS[case](file.read_text()), errors="surrogateescape")
        if damaged_summary:
            # nothing is left that names the log
            summary.write_text("{")
        for read in (count_runs, lambda: read_result(summary))[1 - damaged_summary :]:
            with pytest.raises(
                InputError, match=r"manifest\.json: is damaged \(.*\); begin anew with --overwrite, or choose"
            ):
                read()
        assert count_runs(overwrite=damaged_summary) == count + 1 == count_runs()


def test_damage_is_told_by_other_processes_too():
    fault = DamagedFile(Path("a"), "cut off", "write it again")
    copy = pickle.loads(pickle.dumps(fault))
    assert str(copy) == str(fault) == "a: is damaged (cut off); write it again" and copy.reason == "cut off"


def test_a_folder_in_place_of_the_manifest_is_refused(count_runs, tmp_path):
    count_runs()
    (tmp_path / "out" / MANIFEST).unlink()
    (tmp_path / "out" / MANIFEST).mkdir()
    (tmp_path / "out" / "identification.json").unlink()
    with pytest.raises(InputError, match=r"manifest\.json: is damaged \(.*directory"):
        count_runs()


def test_a_manifest_may_not_name_files_elsewhere(count_runs, tmp_path):
    count_runs()
    mine = tmp_path / "mine"
    mine.write_text("mine")
    for name in ("../mine", str(mine)):
        results = ResultFolder.read(tmp_path / "out")
        results.entries["identification.json"]["files"][name] = ""
        results.write_manifest()
        with pytest.raises(InputError, match="names files in other folders"):
            read_result(tmp_path / "out" / "identification.json")
        assert count_runs(overwrite=True) and mine.exists()


def test_drafts_of_a_killed_process_do_not_make_a_folder_anothers(count_runs, tmp_path):
    out = tmp_path / "out"
    (out / ".draft.x" / "figures").mkdir(parents=True)
    (out / ".draft.123.manifest.json").write_text("{")
    (out / ".lock").touch()
    assert count_runs() == 1
    assert not list(out.rglob(".*"))


@pytest.mark.parametrize("moved", range(5))
def test_killed_while_files_appear(count_runs, tmp_path, monkeypatch, moved):
    """The folder is known again, and what is not whole is made again."""
    counts = iter(range(moved))

    def move(path, target):
        if next(counts, None) is None:
            raise SystemExit
        path.replace(target)

    with monkeypatch.context() as patched, suppress(SystemExit):
        patched.setattr("jaxbl.files.move_file", move)
        count_runs()
    assert count_runs() == 1 + (moved < 4)
    assert (tmp_path / "out" / "model.toml").read_text() == "its own"


LINKS = {"a link": lambda lock, mine: lock.symlink_to(mine), "a pipe": lambda lock, mine: os.mkfifo(lock)}


@pytest.mark.parametrize("kind", LINKS)
def test_a_lock_is_a_regular_file(count_runs, tmp_path, kind):
    """A file that a link leads to would be emptied."""
    mine, lock = tmp_path / "mine", tmp_path / "out" / ".lock"
    mine.write_text("mine")
    lock.parent.mkdir()
    LINKS[kind](lock, mine)
    with pytest.raises(InputError, match=r"\.lock: is no lock of jaxbl \(.*\); remove it"):
        count_runs()
    assert mine.read_text() == "mine"
    lock.unlink()
    assert count_runs() == 1


def test_one_process_writes_into_a_folder(count_runs, tmp_path):
    with lock_folder(tmp_path / "out"), pytest.raises(InputError, match="is writing into it; wait until it has ended"):
        count_runs()
    assert count_runs() == 1
    assert not (tmp_path / "out" / ".lock").exists()
