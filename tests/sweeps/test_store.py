"""A study's folder: what belongs to it, restart, and nothing overwritten."""

import json

import pandas as pd
import pytest
from small_study import ALPHA, listed, rigid

from jaxbl.config import read_config
from jaxbl.errors import InputError
from jaxbl.files import make_folder
from jaxbl.sweeps.engine import Engine
from jaxbl.sweeps.store import Store, claim, identity
from jaxbl.sweeps.sweep import load, sweep

FIGURE = {"kind": "line", "x": ALPHA, "value": "motor.velocity_rmse"}


def study(changes=None, **tables):
    """Nine runs in three chunks: 3 seeds of 3 points, padded to 4."""
    return rigid(changes, **{"axes": [listed(ALPHA, 5.0, 9.0, 20.0)], "sweep": {"seeds": 3, "chunk": 2}} | tables)


@pytest.fixture
def computed(monkeypatch):
    """Indices of the chunks that are computed."""
    indices, compute = [], Engine.run
    monkeypatch.setattr(Engine, "run", lambda engine, chunk: indices.append(chunk.index) or compute(engine, chunk))
    return indices


def files(folder):
    """Every file of a folder with its content."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished") / "study"
    return folder, sweep(study(), folder)


@pytest.fixture
def copy(finished, tmp_path):
    """A copy of the finished study's folder."""
    for name, content in files(finished[0]).items():
        (tmp_path / "study" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "study" / name).write_bytes(content)
    return tmp_path / "study"


def test_what_a_study_leaves(finished):
    folder, result = finished
    assert set(files(folder)) == {"study.toml", "manifest.json", *(f"points/part-0000{i}.parquet" for i in range(3))}
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["finished"]
    assert (manifest["parts"], manifest["rows"]) == (3, 9)
    assert read_config(folder / "study.toml").resolved() == read_config(study()).resolved()
    parts = [pd.read_parquet(folder / "points" / f"part-0000{i}.parquet") for i in range(3)]
    assert list(parts[0].columns[:3]) == [ALPHA, "seed", "finite"]
    pd.testing.assert_frame_equal(pd.concat(parts, ignore_index=True), result.frame)
    # the same as without a folder
    pd.testing.assert_frame_equal(sweep(study()).frame, result.frame)


def test_finished_study_is_only_read(copy, finished, computed):
    before = files(copy)
    result = sweep(study(), copy)
    assert computed == []
    assert result.cost["lanes"] == 0
    assert files(copy) == before
    pd.testing.assert_frame_equal(result.frame, finished[1].frame)
    pd.testing.assert_frame_equal(load(copy).frame, finished[1].frame)


def test_interrupted_study_goes_on_where_it_stopped(tmp_path, finished, computed):
    def interrupt(done, total):
        assert total == 9
        if done == 6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sweep(study(), tmp_path / "study", progress=interrupt)
    assert computed == [0, 1]
    seen = []
    # with other chunks asked for: those of the folder stay
    result = sweep(study(sweep={"seeds": 3, "chunk": 100}), tmp_path / "study", progress=lambda *done: seen.append(done))
    assert computed == [0, 1, 2]
    assert seen == [(3, 9), (6, 9), (9, 9)]
    assert result.cost["lanes"] == 3
    pd.testing.assert_frame_equal(result.frame, finished[1].frame)


@pytest.mark.parametrize("damage", ["missing", "truncated", "empty", "draft only"])
def test_a_chunk_that_is_not_whole_is_computed_again(copy, finished, computed, damage):
    part = copy / "points" / "part-00001.parquet"
    content = part.read_bytes()
    part.unlink()
    if damage == "truncated":
        part.write_bytes(content[: len(content) // 2])
    elif damage == "empty":
        part.touch()
    elif damage == "draft only":
        part.with_name(f".{part.name}.1").write_bytes(content[:100])
    if damage in ("truncated", "empty"):
        with pytest.raises(InputError, match=r"part-00001\.parquet: is damaged; run 'jaxbl sweep' again"):
            _ = load(copy).frame
    else:
        assert len(load(copy).frame) == 6
    result = sweep(study(), copy)
    assert computed == [1]
    pd.testing.assert_frame_equal(result.frame, finished[1].frame)


OTHER = {
    "other number": {"changes": {"drive.motor_inertia": 0.06}},
    "other axis": {"axes": [listed(ALPHA, 5.0, 9.0, 21.0)]},
    "more seeds": {"sweep": {"seeds": 4, "chunk": 2}},
    "other precision": {"changes": {"run.precision": "float32"}},
}


@pytest.mark.parametrize("case", OTHER)
def test_another_study_in_the_folder_stays_as_it_is(copy, case):
    before = files(copy)
    with pytest.raises(InputError, match=r"holds another study \('small'") as error:
        sweep(study(**OTHER[case]), copy)
    assert str(copy) in str(error.value)
    assert files(copy) == before


def test_only_title_notes_and_figures_changed_is_the_same_study(copy, computed):
    config = read_config(study({"title": "other", "notes": ["a"]}, figures=[FIGURE]))
    sweep(config, copy)
    assert computed == []
    assert load(copy).config.resolved() == config.resolved()


def test_overwriting_is_asked_for(copy, computed):
    result = sweep(study(OTHER["other number"]["changes"]), copy, overwrite=True)
    assert computed == [0, 1, 2]
    assert len(load(copy).frame) == len(result.frame) == 9
    sweep(study(OTHER["other number"]["changes"]), copy, overwrite=True)
    assert computed == [0, 1, 2]


@pytest.mark.parametrize("content", ["", "{", "[]", "3"])
def test_damaged_manifest(copy, content):
    (copy / "manifest.json").write_text(content)
    before = files(copy)
    for read in (lambda: sweep(study(), copy), lambda: load(copy)):
        with pytest.raises(InputError, match=r"manifest\.json: is") as error:
            read()
        assert "\n" not in str(error.value)
    assert files(copy) == before
    assert len(sweep(study(), copy, overwrite=True).frame) == 9


def test_manifest_of_another_version(copy):
    manifest = json.loads((copy / "manifest.json").read_text()) | {"format": 99}
    (copy / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(InputError, match="has format 99; this version reads 2"):
        load(copy)


def test_folder_with_other_files_stays_as_it_is(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(InputError, match="is not empty and holds no study"):
        sweep(study(), tmp_path, overwrite=True)
    assert files(tmp_path) == {"thesis.tex": b"mine"}


def test_a_file_in_place_of_the_folder(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="is a file"):
        make_folder(tmp_path / "file")
    with pytest.raises(InputError, match="lies under a file"):
        make_folder(tmp_path / "file" / "study")


def test_unwritable_folder(tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("pathlib.Path.touch", refuse)
    with pytest.raises(InputError, match=r"cannot be written to \(Permission denied\); choose another folder"):
        sweep(study(), tmp_path / "study")


def test_folders_without_a_study_or_without_points(tmp_path, copy):
    for folder in (tmp_path, tmp_path / "none"):
        with pytest.raises(InputError, match="holds no study"):
            Store.open(folder)
    for part in (copy / "points").iterdir():
        part.unlink()
    with pytest.raises(InputError, match="holds no points yet"):
        _ = load(copy).frame


def test_a_record_is_known_by_its_content(tmp_path):
    def of(text, name="a.csv"):
        (tmp_path / name).write_text(text)
        return identity(read_config(rigid(excitation={"kind": "recorded", "file": str(tmp_path / name)})))

    first = of("t,u\n0,1\n1,2\n")
    assert of("t,u\n0,1\n1,3\n") != first
    assert of("t,u\n0,1.0\n1,2.0\n", "b.csv") == first


def test_files_of_others_are_never_removed(tmp_path):
    (tmp_path / "summary.json").write_text('{"mine": 1}')
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "mine.png").write_bytes(b"x")
    with pytest.raises(InputError, match="not of a study"):
        claim(tmp_path, read_config(rigid()), overwrite=True)
    assert (tmp_path / "figures" / "mine.png").exists()
