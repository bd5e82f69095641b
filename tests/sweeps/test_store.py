"""A study's folder: what belongs to it, restart, and nothing overwritten."""

import json
import os
import shutil
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from random import Random

import pandas as pd
import pyarrow.parquet as pq
import pytest
from small_study import ALPHA, listed_axis, rigid_study
from upath import UPath

from jaxbl.config import read_config
from jaxbl.errors import InputError, NoResult
from jaxbl.files import MANIFEST, json_with_checksum, make_folder
from jaxbl.sweeps.engine import Engine
from jaxbl.sweeps.store import Store, claim_study, identity
from jaxbl.sweeps.sweep import StudyResult, open_study, repair, sweep

pytestmark = pytest.mark.usefixtures("compiled_once")

FIGURE = {"kind": "line", "x": ALPHA, "value": "motor.velocity_rmse"}


def study(changes=None, **tables):
    """Nine runs in three chunks: 3 seeds of 3 points, padded to 4."""
    return rigid_study(changes, **{"axes": [listed_axis(ALPHA, 5.0, 9.0, 20.0)], "sweep": {"seeds": 3, "chunk": 2}} | tables)


def read_files(folder):
    """Every file of a folder with its content."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def finished_study(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished") / "study"
    return folder, sweep(study(), folder)


@pytest.fixture
def study_copy(finished_study, tmp_path):
    """A copy of the finished study's folder."""
    for name, content in read_files(finished_study[0]).items():
        (tmp_path / "study" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "study" / name).write_bytes(content)
    return tmp_path / "study"


def test_what_a_study_leaves(finished_study):
    folder, result = finished_study
    assert set(read_files(folder)) == {"study.toml", MANIFEST, *(f"points/part-0000{i}.parquet" for i in range(3))}
    manifest = json.loads((folder / MANIFEST).read_text())["results"]["sweep"]
    assert manifest["finished"]
    assert (manifest["parts"], manifest["rows"]) == (3, 9)
    assert read_config(folder / "study.toml").to_dict() == read_config(study()).to_dict()
    parts = [pd.read_parquet(folder / "points" / f"part-0000{i}.parquet") for i in range(3)]
    assert list(parts[0].columns[:3]) == [ALPHA, "seed", "finite"]
    pd.testing.assert_frame_equal(pd.concat(parts, ignore_index=True), result.frame)
    # the same as without a folder
    pd.testing.assert_frame_equal(sweep(study()).frame, result.frame)


def test_a_study_is_read_from_a_folder_whose_name_is_no_utf8(tmp_path, finished_study, study_copy):
    """Sound parts were called damaged."""
    folder = study_copy.rename(tmp_path / os.fsdecode(b"b\xffd"))
    pd.testing.assert_frame_equal(open_study(folder).read(), open_study(finished_study[0]).read())


def test_finished_study_is_only_read(study_copy, finished_study, computed_chunks):
    before = read_files(study_copy)
    result = sweep(study(), study_copy)
    assert computed_chunks == []
    assert result.cost["lanes"] == 0
    assert read_files(study_copy) == before
    pd.testing.assert_frame_equal(result.frame, finished_study[1].frame)
    pd.testing.assert_frame_equal(open_study(study_copy).frame, finished_study[1].frame)


def test_interrupted_study_goes_on_where_it_stopped(tmp_path, finished_study, computed_chunks):
    def interrupt(done, total):
        assert total == 9
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sweep(study(), tmp_path / "study", progress=interrupt)
    # the second one was computed while the first was written, and is kept
    assert computed_chunks == [0, 1]
    calls = []
    # with other chunks asked for: those of the folder stay
    result = sweep(study(sweep={"seeds": 3, "chunk": 100}), tmp_path / "study", progress=lambda *done: calls.append(done))
    assert computed_chunks == [0, 1, 2]
    assert calls == [(3, 9), (6, 9), (9, 9)]
    assert result.cost["lanes"] == 3
    pd.testing.assert_frame_equal(result.frame, finished_study[1].frame)


@pytest.mark.parametrize("damage", ["missing", "truncated", "empty", "draft only"])
def test_a_chunk_that_is_not_whole_is_computed_again(study_copy, finished_study, computed_chunks, damage):
    part = study_copy / "points" / "part-00001.parquet"
    content = part.read_bytes()
    part.unlink()
    if damage == "truncated":
        part.write_bytes(content[: len(content) // 2])
    elif damage == "empty":
        part.touch()
    elif damage == "draft only":
        part.with_name(f".draft.1.{part.name}").write_bytes(content[:100])
    if damage in ("truncated", "empty"):
        with pytest.raises(InputError, match=r"part-00001\.parquet: is damaged \(.*\); run 'jaxbl sweep' again"):
            _ = open_study(study_copy).frame
    else:
        assert len(open_study(study_copy).frame) == 6
    result = sweep(study(), study_copy)
    assert computed_chunks == [1]
    if damage in ("truncated", "empty"):
        (reason,) = result.damaged
        assert reason.startswith("points/part-00001.parquet") and reason.endswith("it is kept as damaged/part-00001.parquet")
        assert len(list((study_copy / "damaged").iterdir())) == 1
    # drafts of processes that were killed are gone
    assert not list(study_copy.rglob(".*"))
    pd.testing.assert_frame_equal(result.frame, finished_study[1].frame)


OTHER_STUDIES = {
    "other number": {"changes": {"drive.motor_inertia": 0.06}},
    "other axis": {"axes": [listed_axis(ALPHA, 5.0, 9.0, 21.0)]},
    "more seeds": {"sweep": {"seeds": 4, "chunk": 2}},
    "other precision": {"changes": {"run.precision": "float32"}},
    "some metrics": {"sweep": {"metrics": ["converged"]}},
}


@pytest.mark.parametrize("case", OTHER_STUDIES)
def test_another_study_in_the_folder_stays_as_it_is(study_copy, case):
    before = read_files(study_copy)
    with pytest.raises(InputError, match=r"holds results of another study \(small\)") as error:
        sweep(study(**OTHER_STUDIES[case]), study_copy)
    assert str(study_copy) in str(error.value)
    assert read_files(study_copy) == before


def test_only_title_notes_and_figures_changed_is_the_same_study(study_copy, computed_chunks):
    config = read_config(study({"title": "other", "notes": ["a"]}, figures=[FIGURE]))
    sweep(config, study_copy)
    assert computed_chunks == []
    assert open_study(study_copy).config.to_dict() == config.to_dict()


def test_overwriting_is_asked_for(study_copy, computed_chunks):
    result = sweep(study(OTHER_STUDIES["other number"]["changes"]), study_copy, overwrite=True)
    assert computed_chunks == [0, 1, 2]
    assert len(open_study(study_copy).frame) == len(result.frame) == 9
    sweep(study(OTHER_STUDIES["other number"]["changes"]), study_copy, overwrite=True)
    assert computed_chunks == [0, 1, 2]


MANIFESTS = {
    "lost": None, "empty": "", "cut off": "{", "a list": "[]", "a number": "3",
    "no layout": lambda data: data.pop("layout"),
    "another layout": lambda data: data["layout"].update(points=6),
    "other rows": lambda data: data.update(rows=2560),
}  # fmt: skip


@pytest.mark.parametrize("case", MANIFESTS)
def test_a_manifest_that_is_lost_or_damaged_is_written_anew_by_what_the_parts_say(
    study_copy, finished_study, computed_chunks, case
):
    file, content = study_copy / MANIFEST, MANIFESTS[case]
    if content is None:
        file.unlink()
    elif isinstance(content, str):
        file.write_text(content)
    else:
        data = json.loads(file.read_text())
        content(data["results"]["sweep"])
        file.write_text(json.dumps(data))
    before = read_files(study_copy)
    with pytest.raises(InputError, match=r"has (lost its|a damaged) manifest\.json; 'jaxbl repair") as error:
        open_study(study_copy)
    assert "\n" not in str(error.value)
    assert read_files(study_copy) == before
    # as many chunks as there were, whatever is asked for now
    result = sweep(study(sweep={"seeds": 3, "chunk": 100}), study_copy)
    assert computed_chunks == [] and result.damaged == ()
    pd.testing.assert_frame_equal(open_study(study_copy).frame, finished_study[1].frame)
    assert len(list((study_copy / "points").iterdir())) == 3


def test_a_damaged_manifest_without_parts(study_copy):
    (study_copy / MANIFEST).write_text("{")
    for part in (study_copy / "points").iterdir():
        part.unlink()
    with pytest.raises(InputError, match=r"manifest\.json: is damaged \(.*\); begin anew with --overwrite"):
        sweep(study(), study_copy)
    assert len(sweep(study(), study_copy, overwrite=True).frame) == 9


def test_manifest_of_another_version(study_copy):
    text = json.dumps(json.loads((study_copy / MANIFEST).read_text()) | {"format": 99})
    data = json.loads(text)
    del data["checksum"]
    (study_copy / MANIFEST).write_text(json_with_checksum(data))
    with pytest.raises(InputError, match="has format 99; this version reads 5"):
        open_study(study_copy)
    # parts of format 4 had other headers
    for part in (study_copy / "points").iterdir():
        part.write_bytes(b"PAR1")
    for overwrite in (False, True):
        with pytest.raises(InputError, match=r"has format 99; .* or make the results anew in another folder"):
            sweep(study(), study_copy, overwrite=overwrite)
    (study_copy / MANIFEST).unlink()
    with pytest.raises(InputError, match=r"is not empty and holds no results with a manifest\.json \(an earlier jaxbl"):
        sweep(study(), study_copy, overwrite=True)


def flip_bit(folder, random):
    """Flip a bit of one of a folder's files, which is returned."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    sizes = [path.stat().st_size for path in paths]
    path = random.choices(paths, sizes)[0]
    content = path.read_bytes()
    index = random.randrange(len(content) * 8)
    path.write_bytes(bytes(byte ^ (1 << index % 8 if i == index // 8 else 0) for i, byte in enumerate(content)))
    return path


def test_flipped_bits_are_noticed_and_healed(study_copy, finished_study, repeats):
    """None gives other numbers in silence, and one more sweep makes all well."""
    random, damaged_count, flips = Random(7), 0, repeats(20, 1000)
    before = read_files(study_copy)
    for _ in range(flips):
        path = flip_bit(study_copy, random)
        with suppress(InputError):
            pd.testing.assert_frame_equal(open_study(study_copy).frame, finished_study[1].frame)
        result = sweep(study(), study_copy)
        pd.testing.assert_frame_equal(result.frame, finished_study[1].frame)
        damaged_count += len(result.damaged)
        shutil.rmtree(study_copy / "damaged", ignore_errors=True)
        contents = read_files(study_copy)
        assert contents.keys() == before.keys()
        assert {name for name in contents if contents[name] != before[name]} <= {MANIFEST}, path
    assert damaged_count > flips / 2


def test_parts_that_changed_places_are_computed_anew(study_copy, finished_study, computed_chunks):
    first, third = (study_copy / "points" / f"part-0000{i}.parquet" for i in (0, 2))
    content = first.read_bytes(), third.read_bytes()
    first.write_bytes(content[1])
    third.write_bytes(content[0])
    with pytest.raises(InputError, match=r"part-00000\.parquet: is damaged \(is part 2 of this study\)"):
        _ = open_study(study_copy).frame
    assert len(sweep(study(), study_copy).damaged) == 2
    assert computed_chunks == [0, 2]
    pd.testing.assert_frame_equal(open_study(study_copy).frame, finished_study[1].frame)


def test_an_edited_part_is_kept_aside(study_copy, finished_study, computed_chunks):
    part = study_copy / "points" / "part-00001.parquet"
    frame = pd.read_parquet(part)
    frame["motor.velocity_rmse"] *= 1.01
    frame.to_parquet(part, index=False)
    with pytest.raises(InputError, match=r"part-00001\.parquet: is damaged \(has no (header|checksum)"):
        _ = open_study(study_copy).frame
    sweep(study(), study_copy)
    assert computed_chunks == [1]
    stored_frame = pd.read_parquet(study_copy / "damaged" / "part-00001.parquet")
    pd.testing.assert_frame_equal(stored_frame, frame)


def test_a_part_of_another_study_is_refused(study_copy, tmp_path):
    sweep(study({"drive.motor_inertia": 0.06}), tmp_path / "other")
    part = study_copy / "points" / "part-00001.parquet"
    part.write_bytes((tmp_path / "other" / "points" / part.name).read_bytes())
    before = read_files(study_copy)
    for read in (lambda: sweep(study(), study_copy), lambda: open_study(study_copy).frame, lambda: repair(study_copy)):
        with pytest.raises(InputError, match=r"part-00001\.parquet: is of another study \('small', other numbers\)"):
            read()
    assert read_files(study_copy) == before


@pytest.mark.parametrize("name", ["part-00099.parquet", "part-3.parquet", "part-copy.parquet"])
def test_a_part_too_many_is_refused(study_copy, computed_chunks, name):
    (study_copy / "points" / name).write_bytes((study_copy / "points" / "part-00001.parquet").read_bytes())
    for read in (lambda: open_study(study_copy).frame, lambda: sweep(study(), study_copy)):
        with pytest.raises(InputError, match=f"{name}: is no part of this study, which has 3; move it away"):
            read()
    assert computed_chunks == []


def test_repair_keeps_damaged_parts_aside_and_says_what_is_missing(study_copy, computed_chunks):
    (study_copy / MANIFEST).unlink()
    (study_copy / "points" / "part-00000.parquet").write_bytes(b"PAR1")
    whole_part_count, store = repair(study_copy)
    assert whole_part_count == 2 and len(store.damaged) == 1 and computed_chunks == []
    assert not open_study(study_copy).source.manifest["finished"]
    assert len(open_study(study_copy).frame) == 6
    sweep(study_copy / "study.toml", study_copy)
    assert computed_chunks == [0]
    with pytest.raises(InputError, match=r"holds no study \(no study\.toml\)"):
        repair(study_copy / "points")


def test_a_refined_study_whose_manifest_is_lost_keeps_its_parts(tmp_path, computed_chunks):
    """Only its parts say how many they are in the end."""
    axes = [{"path": ALPHA, "start": 1.0, "stop": 40.0, "num": 5, "scale": "log"}]
    refined = study(axes=axes, sweep={"seeds": 1, "chunk": 2, "refine": 3})
    result = sweep(refined, tmp_path / "study")
    parts, points = list(computed_chunks), read_files(tmp_path / "study" / "points")
    coarse = len(Engine(read_config(refined)))
    assert len(parts) > coarse
    (tmp_path / "study" / MANIFEST).unlink()
    whole_part_count, store = repair(tmp_path / "study")
    assert (whole_part_count, store.manifest["parts"], store.damaged) == (len(parts), len(parts), [])
    second = sweep(refined, tmp_path / "study")
    assert computed_chunks == parts and read_files(tmp_path / "study" / "points") == points
    pd.testing.assert_frame_equal(second.frame, result.frame)


def test_two_processes_do_not_write_into_one_folder(study_copy):
    program = (
        "import sys, pathlib\nfrom jaxbl.files import lock_folder\nwith lock_folder(pathlib.Path(sys.argv[1])):\n"
        "    print('has it', flush=True)\n    sys.stdin.readline()\n"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", program, str(study_copy)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert other.stdout.readline() == "has it\n"
    with pytest.raises(InputError, match=rf"process {other.pid} on .* is writing into it; wait until it has ended"):
        sweep(study(), study_copy)
    # a process that is killed leaves no lock
    other.kill()
    other.communicate()
    assert (study_copy / ".lock").exists()
    sweep(study(), study_copy)
    assert not (study_copy / ".lock").exists()


def test_a_full_disk_is_said_in_one_line(tmp_path, monkeypatch, finished_study):
    write = Path.write_bytes

    def fill_disk(path, content):
        write(path, content[:1] if path.suffix != ".json" and "part" in path.name else content)
        if "part" in path.name:
            raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_bytes", fill_disk)
        with pytest.raises(NoResult, match=r"No space left on device\); what was written before is whole, and the same"):
            sweep(study(), tmp_path / "study")
    assert {*read_files(tmp_path / "study")} == {"study.toml", MANIFEST}
    pd.testing.assert_frame_equal(sweep(study(), tmp_path / "study").frame, finished_study[1].frame)


def test_folder_with_other_files_stays_as_it_is(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(InputError, match=r"is not empty and holds no results with a manifest\.json"):
        sweep(study(), tmp_path, overwrite=True)
    assert read_files(tmp_path) == {"thesis.tex": b"mine"}


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


def test_folders_without_a_study_or_without_points(tmp_path, study_copy):
    for folder in (tmp_path, tmp_path / "none"):
        with pytest.raises(InputError, match="holds no study"):
            Store.open(folder)
    for part in (study_copy / "points").iterdir():
        part.unlink()
    with pytest.raises(InputError, match="holds no points yet"):
        _ = open_study(study_copy).frame


def test_a_record_is_known_by_its_content(tmp_path):
    def identity_of(text, name="a.csv"):
        (tmp_path / name).write_text(text)
        return identity(read_config(rigid_study(excitation={"kind": "recorded", "file": str(tmp_path / name)})))

    first = identity_of("t,u\n0,1\n1,2\n")
    assert identity_of("t,u\n0,1\n1,3\n") != first
    assert identity_of("t,u\n0,1.0\n1,2.0\n", "b.csv") == first


def test_files_of_others_are_never_removed(tmp_path):
    (tmp_path / "summary.json").write_text('{"mine": 1}')
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "mine.png").write_bytes(b"x")
    with pytest.raises(InputError, match="is not empty and holds no results"):
        claim_study(tmp_path, read_config(rigid_study()), overwrite=True)
    assert (tmp_path / "figures" / "mine.png").exists()


def test_rows_are_read_as_they_are_asked_for(finished_study):
    folder, result = finished_study
    stored_study, full_frame = open_study(folder), result.frame
    assert len(list(stored_study.batches(["seed"]))) == 3
    columns = ["motor.f_plus", ALPHA]
    pd.testing.assert_frame_equal(stored_study.read(columns), full_frame[columns])
    selected = full_frame[(full_frame["seed"] > 0) & (full_frame[ALPHA] < 20.0)]
    content = stored_study.read(columns, [("seed", ">", 0), (ALPHA, "<", 20.0)])
    pd.testing.assert_frame_equal(content, selected[columns].reset_index(drop=True))
    either_condition = stored_study.read(["seed"], [[("seed", "==", 0)], [(ALPHA, "in", [5.0, 9.0])]])
    assert len(either_condition) == ((full_frame["seed"] == 0) | full_frame[ALPHA].isin([5.0, 9.0])).sum()
    # the same of a result in memory
    memory = StudyResult(stored_study.config, full_frame)
    pd.testing.assert_frame_equal(memory.read(columns, [("seed", ">", 0), (ALPHA, "<", 20.0)]), content)


@pytest.mark.parametrize("check", [True, False])
def test_a_dataset_of_the_rows(finished_study, check):
    import pyarrow.compute as pc

    folder, result = finished_study
    dataset = open_study(folder).dataset(check=check)
    assert dataset.count_rows() == 9
    table = dataset.to_table(columns=["seed", "motor.f_plus"], filter=pc.field(ALPHA) == 9.0).to_pandas()
    expected = result.frame.loc[result.frame[ALPHA] == 9.0, ["seed", "motor.f_plus"]]
    pd.testing.assert_frame_equal(
        table.sort_values("seed", ignore_index=True), expected.sort_values("seed", ignore_index=True)
    )
    memory = StudyResult(result.config, result.frame).dataset()
    assert memory.to_table().to_pandas().equals(result.frame)


def test_a_dataset_of_damaged_or_foreign_parts_is_refused(study_copy, tmp_path):
    part = study_copy / "points" / "part-00001.parquet"
    content = bytearray(part.read_bytes())
    column = pq.read_metadata(part).row_group(0).column(4)
    # the last byte of the column's values
    content[column.data_page_offset + column.total_compressed_size - 1] ^= 1
    part.write_bytes(content)
    with pytest.raises(InputError, match=r"part-00001\.parquet: is damaged \(does not agree with its checksum\)"):
        open_study(study_copy).dataset()
    # what is not looked at first is found where it is read
    dataset = open_study(study_copy).dataset(check=False)
    with pytest.raises(OSError, match=r"CRC|checksum|corrupt"):
        dataset.to_table()
    sweep(study({"drive.motor_inertia": 0.06}), tmp_path / "other")
    shutil.copy(tmp_path / "other" / "points" / part.name, part)
    for check in (True, False):
        with pytest.raises(InputError, match=r"is of another study|is damaged"):
            open_study(study_copy).dataset(check=check)


def test_parts_are_in_order_beyond_five_digits(tmp_path, finished_study):
    engine = Engine(read_config(study()), backend="scan")
    store = Store.create(tmp_path, engine)
    rows = next(finished_study[1].source.batches())
    for index in (99_999, 100_000, 2):
        store.write_part(index, rows.assign(seed=index))
    store.update_manifest(parts=100_001)
    stored_study = open_study(tmp_path)
    assert stored_study.frame["seed"].drop_duplicates().tolist() == [2, 99_999, 100_000]
    assert (
        stored_study.dataset().to_table(columns=["seed"]).to_pandas()["seed"].tolist() == stored_study.frame["seed"].tolist()
    )
    assert open_study(tmp_path).source.read_part(100_000, ()) is not None


def test_a_study_in_an_object_store_is_read_alike(finished_study):
    address = UPath("memory://reading/study")
    for name, content in read_files(finished_study[0]).items():
        (address / name).write_bytes(content)
    stored_study = open_study("memory://reading/study")
    pd.testing.assert_frame_equal(stored_study.frame, finished_study[1].frame)
    for check in (True, False):
        table = stored_study.dataset(check=check).to_table(columns=[ALPHA, "seed"]).to_pandas()
        pd.testing.assert_frame_equal(table, finished_study[1].frame[[ALPHA, "seed"]])


def test_a_store_that_does_not_answer_has_no_damage(finished_study, monkeypatch):
    """It was taken for damage, and moving the part aside ended in a traceback."""
    address = UPath("memory://silent/study")
    for name, content in read_files(finished_study[0]).items():
        (address / name).write_bytes(content)
    read = type(address).read_bytes

    def refuse_parts(path):
        if path.suffix == ".parquet":
            raise ConnectionError("timed out")
        return read(path)

    with monkeypatch.context() as patched:
        patched.setattr(type(address), "read_bytes", refuse_parts)
        for call in (lambda: sweep(study(), str(address)), lambda: open_study(str(address)).frame):
            with pytest.raises(InputError, match=r"part-00000\.parquet: cannot be read \(timed out\); name another folder"):
                call()
    assert not (address / "damaged").exists()
    pd.testing.assert_frame_equal(open_study(str(address)).frame, finished_study[1].frame)


def test_the_metrics_asked_for_are_a_sweeps_own():
    def of(command, *names):
        return identity(read_config(rigid_study(sweep={"metrics": list(names)} if names else {})), command)

    assert of("sweep", "converged", "chatter") == of("sweep", "chatter", "converged") != of("sweep", "converged")
    for command in ("simulate", "verify", "tune"):
        assert of(command, "converged") == of(command)
    # folders that are there stay what they are
    assert "metrics" not in read_config(rigid_study()).to_dict()["sweep"]
