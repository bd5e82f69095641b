"""Results of a log in a folder: found again by the same call, unless another command has written over them."""

import json
from types import SimpleNamespace

import pytest

from jaxbl.files import results_of


@pytest.fixture
def found(tmp_path):
    """Calls a task's results, and says how often it was done."""
    done = []
    task = SimpleNamespace(record=SimpleNamespace(path=tmp_path / "axis.csv"), identity="abc")

    def write(result, folder):
        (folder / "report.html").write_text("its own")
        (folder / "identification.json").write_text(json.dumps(result.summary))

    def call():
        def run(task):
            done.append(task)
            return SimpleNamespace(summary={"identity": "abc", "file": str(task.record.path)})

        file = tmp_path / "out" / "identification.json"
        assert results_of(task, file, run, write, overwrite=False)["identity"] == "abc"
        return len(done)

    return call


def test_the_same_call_computes_nothing(found):
    assert (found(), found()) == (1, 1)


@pytest.mark.parametrize("how", ["another report", "none"])
def test_results_that_another_command_wrote_over_are_made_again(found, tmp_path, how):
    found()
    report = tmp_path / "out" / "report.html"
    if how == "none":
        report.unlink()
    else:
        report.write_text("of another command")
    assert found() == 2 and report.read_text() == "its own"
