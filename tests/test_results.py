"""Results of a log in a folder: found again by the same call, unless another command has written over them."""

from types import SimpleNamespace

import pytest

from jaxbl.errors import InputError
from jaxbl.files import json_with_checksum, lock_folder, read_json, run_or_read


@pytest.fixture
def count_runs(tmp_path):
    """Return a function that asks for a task's result, and returns how often the task was run."""
    tasks = []
    task = SimpleNamespace(record=SimpleNamespace(path=tmp_path / "axis.csv"), identity="abc")

    def write(result, folder):
        (folder / "report.html").write_text("its own")
        (folder / "identification.json").write_text(json_with_checksum(result.summary))

    def call():
        def run(task):
            tasks.append(task)
            return SimpleNamespace(summary={"identity": "abc", "file": str(task.record.path)})

        file = tmp_path / "out" / "identification.json"
        assert run_or_read(task, file, run, write, overwrite=False)["identity"] == "abc"
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


def test_results_that_do_not_agree_with_their_checksum_are_made_again(count_runs, tmp_path):
    count_runs()
    file = tmp_path / "out" / "identification.json"
    file.write_text(file.read_text().replace("abc", "abd"))
    with pytest.raises(InputError, match="does not agree with its checksum"):
        read_json(file)
    assert count_runs() == 2 and read_json(file)["identity"] == "abc"
    # of which log they were is not known
    file.write_text("{")
    with pytest.raises(InputError, match=r"holds results of another log \(an unreadable one\).* or --overwrite"):
        count_runs()


def test_one_process_writes_into_a_folder(count_runs, tmp_path):
    with lock_folder(tmp_path / "out"), pytest.raises(InputError, match="is writing into it; wait until it has ended"):
        count_runs()
    assert count_runs() == 1
    assert not (tmp_path / "out" / ".lock").exists()
