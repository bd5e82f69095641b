"""A study in shares, by processes that know nothing of one another, in any order, into one folder."""

import pandas as pd
import pytest
from small_study import ALPHA, LAMBDA, read_parts, spaced_axis, thirty_run_study

from jaxbl.config import read_config
from jaxbl.errors import InputError
from jaxbl.files import lock_folder
from jaxbl.sweeps import run
from jaxbl.sweeps.engine import Engine
from jaxbl.sweeps.status import list_statuses, status
from jaxbl.sweeps.sweep import share, sweep

pytestmark = pytest.mark.usefixtures("compiled_once")


def test_shares_are_the_whole_study(tmp_path, computed_chunks):
    expected = sweep(thirty_run_study(), tmp_path / "alone")
    computed_chunks.clear()
    folder, calls = tmp_path / "shares", []
    last = share(thirty_run_study(), folder, (3, 3), progress=lambda *done: calls.append(done))
    assert len(computed_chunks) == 2 and not last.complete
    # progress of a share is of its own lanes
    assert calls[-1][0] == calls[-1][1] == sum(Engine(expected.config).chunk(index).lanes for index in computed_chunks)
    assert (status(folder).parts, status(folder).parts_in_all, status(folder).finished) == (2, 8, False)
    with lock_folder(folder, shared=True):
        # another one is at work
        share(thirty_run_study(), folder, (1, 3))
        assert status(folder).held_by.startswith("process")
    done = share(thirty_run_study(), folder, (2, 3))
    assert sorted(computed_chunks) == list(range(8))
    assert done.complete and done.remaining_seconds == 0.0 and not done.finished
    # a share that is there, and who collects them, compute nothing
    share(thirty_run_study(), folder, (2, 3))
    result = sweep(thirty_run_study(), folder)
    assert sorted(computed_chunks) == list(range(8))
    assert read_parts(folder) == read_parts(tmp_path / "alone")
    pd.testing.assert_frame_equal(result.frame, expected.frame, check_exact=True)
    assert status(folder).finished
    assert not list(folder.rglob(".*"))
    # more shares than chunks
    assert share(thirty_run_study(), folder, (99, 100)).complete


def test_a_share_leaves_the_folder_of_others_alone(tmp_path, computed_chunks, monkeypatch):
    share(thirty_run_study(), tmp_path / "study", (1, 2))
    before = read_parts(tmp_path / "study")
    with pytest.raises(InputError, match="holds results of another study"):
        share(thirty_run_study(sweep={"seeds": 3, "chunk": 4}), tmp_path / "study", (2, 2))
    monkeypatch.setattr(run, "_PREPARATION_SECONDS", 0.2)
    with (
        lock_folder(tmp_path / "study"),
        pytest.raises(InputError, match="is writing into it; wait until it has ended"),
    ):
        share(thirty_run_study(), tmp_path / "study", (2, 2))
    assert read_parts(tmp_path / "study") == before
    refined = thirty_run_study(
        axes=[spaced_axis(ALPHA, 5.0, 20.0, 9), spaced_axis(LAMBDA, 0.3, 5.0, 9)], sweep={"refine": 2}
    )
    with pytest.raises(InputError, match=r"--share: sweep\.refine makes points depend on one another"):
        share(refined, tmp_path / "other", (1, 2))
    assert not (tmp_path / "other").exists()


def test_status_of_folders(tmp_path):
    with pytest.raises(InputError, match="holds no study"):
        list_statuses(tmp_path)
    for name in ("verify/drive", "verify/sampled"):
        sweep(thirty_run_study(), tmp_path / name)
    assert [status.folder.name for status in list_statuses(tmp_path)] == ["drive", "sampled"]


def test_chunks_cover_the_grid_coarsely_first():
    """Whenever it is stopped, a study has points all over its map."""
    axes = [spaced_axis(ALPHA, 5.0, 20.0, 32), spaced_axis(LAMBDA, 0.3, 5.0, 32)]
    engine = Engine(read_config(thirty_run_study(axes=axes, sweep={"seeds": 2, "chunk": 8})))
    order = engine.chunk_order()
    assert sorted(order) == list(range(len(engine))) and len(engine) == 256
    # the first seed of all points before the second
    assert {engine.chunk(index).seeds[0] for index in order[:128]} == {0}
    for count in (8, 16, 32, 64):
        points = [point for index in order[:count] for point in engine.chunk(index).points]
        # of the rows of the map, each as wide as there are blocks in it
        rows = {point // 32 for point in points}
        assert len(rows) >= 0.5 * min(32, count)
        gaps = [b - a for a, b in zip(sorted(rows), sorted(rows)[1:], strict=False)]
        assert max(gaps) <= 2 * 32 / min(32, count) + 1
    assert {point // 32 for index in order[:64] for point in engine.chunk(index).points} == set(range(32))
