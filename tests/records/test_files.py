"""Columns out of files of every kind."""

import json
import os
import struct
import sys
from contextlib import suppress
from types import SimpleNamespace

import h5py
import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings, strategies as st
from mcap_log import write_mcap
from scipy.io import savemat

from jaxbl.errors import InputError
from jaxbl.records import files, read_record
from jaxbl.records.files import read_log_file
from jaxbl.records.libraries import Column, Columns

T, U = np.arange(5) * 0.1, np.array([1.5, -2.0, 3e-7, 4e12, 0.0])


def write_matlab73(path, **columns):
    """Write a file like MATLAB's -v7.3: HDF5 behind a block of text, with row vectors as columns."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in columns.items():
            data = file.create_dataset(name, data=np.atleast_2d(values))
            data.attrs["MATLAB_class"] = np.bytes_("double")
        title = file.create_dataset("title", data=np.array([[72], [105]], dtype=np.uint16))
        title.attrs["MATLAB_class"] = np.bytes_("char")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")


def write_text(separator, decimal=".", header=True):
    def write(path):
        frame = pd.DataFrame({"t": T, "u": U})
        frame.to_csv(path, sep=separator, decimal=decimal, header=header, index=False)

    return write


WRITERS = {
    "comma.csv": write_text(","),
    "semicolon.csv": write_text(";"),
    "german.csv": write_text(";", ","),
    "tab.tsv": write_text("\t"),
    "german_tab.txt": write_text("\t", ","),
    "blank.txt": write_text(" "),
    "bare.txt": write_text(" ", header=False),
    "bare.csv": write_text(",", header=False),
    "remarks.csv": lambda p: p.write_text(
        "# a remark\n\n" + pd.DataFrame({"t": T, "u": U}).to_csv(index=False).replace("\n0.2", "\n# another\n0.2")
    ),
    "trailing.csv": lambda p: p.write_text(
        "t,u\n" + "".join(f"{t},{u},\n" for t, u in zip(T.tolist(), U.tolist(), strict=True))
    ),
    "bom.csv": lambda p: p.write_text(pd.DataFrame({"t": T, "u": U}).to_csv(index=False), encoding="utf-8-sig"),
    "windows.csv": lambda p: p.write_bytes(
        b'"t";"u"\r\n' + b"".join(f"{t!r}; {u!r}\r\n".encode() for t, u in zip(T.tolist(), U.tolist(), strict=True))
    ),
    "table.parquet": lambda p: pd.DataFrame({"t": T, "u": U}).to_parquet(p),
    "old.mat": lambda p: savemat(p, {"t": T, "u": U[:, None], "gain": 3.0, "note": "hi"}),
    "new.mat": lambda p: write_matlab73(p, t=T, u=U),
    "rows.json": lambda p: p.write_text(json.dumps(pd.DataFrame({"t": T, "u": U}).to_dict("records"))),
    "entries.json": lambda p: p.write_text(
        json.dumps({"mass": 1.0, "entries": pd.DataFrame({"t": T, "u": U}).to_dict("records")})
    ),
    "columns.json": lambda p: p.write_text(json.dumps({"mass": 1.0, "t": T.tolist(), "u": U.tolist()})),
}


@pytest.mark.parametrize("name", WRITERS)
def test_every_kind_of_file_gives_the_same_columns(name, tmp_path):
    path = tmp_path / name
    WRITERS[name](path)
    columns = read_log_file(path)
    keys = (0, 1) if name.startswith("bare") else ("t", "u")
    assert set(keys) <= set(columns.columns)
    for key, number, values in zip(keys, (0, 1), (T, U), strict=True):
        np.testing.assert_array_equal(columns.load_numbers(key), values)
        if not name.endswith(".json"):
            np.testing.assert_array_equal(columns.load_numbers(number), values)


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.floats(-1e12, 1e12, width=64), min_size=2, max_size=30),
    st.sampled_from([",", ";", "\t", " ", " ; "]),
    st.booleans(),
)
def test_numbers_survive_text(tmp_path_factory, values, separator, header):
    path = tmp_path_factory.mktemp("text") / "log.txt"
    rows = [separator.join(repr(v) for v in (value, -value)) for value in values]
    path.write_text("\n".join([separator.join("ab")] * header + rows))
    columns = read_log_file(path)
    np.testing.assert_array_equal(columns.load_numbers("a" if header else 0), values)
    np.testing.assert_array_equal(columns.load_numbers(1), np.negative(values))


def test_structures_and_matrices_of_matlab_have_columns_of_their_own(tmp_path):
    savemat(tmp_path / "a.mat", {"log": {"t": T, "inner": {"u": U}}, "both": np.stack([T, U], axis=1)})
    with h5py.File(tmp_path / "b.mat", "w") as file:
        file["log/t"], file["log/inner/u"] = T[None], U[None]
        file["both"] = np.stack([T, U])
    for name in ("a.mat", "b.mat"):
        columns = read_log_file(tmp_path / name)
        for column, values in {"log.t": T, "log.inner.u": U, "both[0]": T, "both[1]": U}.items():
            np.testing.assert_array_equal(columns.load_numbers(column), values)


def test_cells_of_matlab_and_matrices_of_json(tmp_path):
    cells = np.empty(2, dtype=object)
    cells[0], cells[1] = T, np.stack([T, U], axis=1)
    savemat(tmp_path / "a.mat", {"runs": cells, "gain": 2.0})
    with h5py.File(tmp_path / "b.mat", "w") as file:
        file["#refs#/a"], file["#refs#/b"] = T[None], np.stack([T, U])
        file.create_dataset("runs", data=[[file["#refs#/a"].ref], [file["#refs#/b"].ref]], dtype=h5py.ref_dtype)
    rows = np.stack([T, U], axis=1).tolist()
    (tmp_path / "c.json").write_text(json.dumps({"runs": {"first": T.tolist()}, "x": rows}))
    (tmp_path / "d.json").write_text(json.dumps(rows))
    names = {"a.mat": ("runs[0]", "runs[1][1]"), "b.mat": ("runs[0]", "runs[1][1]"), "c.json": ("runs.first", "x[1]")}
    for name, columns in (names | {"d.json": (0, 1)}).items():
        file = read_log_file(tmp_path / name, {"runs[0]"})
        for column, values in zip(columns, (T, U), strict=True):
            np.testing.assert_array_equal(file.load_numbers(column), values)


def write_objects(path, objects, columns):
    """Write vectors, and objects (class by name) as MATLAB does: in a v7 file, or as `-v7.3` (suffix .h5)."""
    if path.suffix == ".h5":
        write_matlab73(path, **columns)
        with h5py.File(path, "r+") as file:
            for name, kind in objects.items():
                file[name] = np.array([[3707764736, 2, 1, 1, 1, 1]], dtype=np.uint32)
                file[name].attrs.update({"MATLAB_class": np.bytes_(kind), "MATLAB_object_decode": np.int32(3)})
        return

    def element(code, content):
        return struct.pack("<II", code, len(content)) + content + bytes(-len(content) % 8)

    savemat(path, columns)
    with path.open("ab") as file:
        for name, kind in objects.items():
            reference = np.array([3707764736, 2, 1, 1, 1, 1], dtype="<u4").tobytes()
            matrix = element(6, struct.pack("<II", 13, 0)) + element(5, struct.pack("<ii", 6, 1)) + element(1, b"")
            texts = b"".join(element(1, text.encode()) for text in (name, "MCOS", kind))
            file.write(
                element(14, element(6, struct.pack("<II", 17, 0)) + texts + element(14, matrix + element(6, reference)))
            )


OBJECT_CLASSES = ("table", "timetable", "timeseries", "datetime", "duration", "string", "categorical", "containers.Map")


@pytest.mark.parametrize("ending", [".mat", ".h5"])
@pytest.mark.parametrize("seed", range(5))
def test_vectors_beside_objects_of_matlab_are_read_and_the_objects_named(tmp_path, seed, ending):
    random = np.random.default_rng(seed)
    kinds = random.choice(OBJECT_CLASSES, random.integers(1, 4), replace=False)
    objects = {f"object{i}": str(kind) for i, kind in enumerate(kinds)}
    columns = {f"x{i}": random.standard_normal(70) for i in range(random.integers(1, 4))}
    write_objects(tmp_path / f"log{ending}", objects, columns)
    file = read_log_file(tmp_path / f"log{ending}")
    assert list(file.columns) == list(columns)
    for name, values in columns.items():
        np.testing.assert_array_equal(file.load_numbers(name), values)
    (note,) = file.notes
    assert all(f"{name} ({kind})" in note for name, kind in objects.items()) and "save" in note
    with pytest.raises(InputError, match=r"no column 'theta'.*object0"):
        file.find_column("theta")
    write_objects(tmp_path / f"alone{ending}", objects, {})
    with pytest.raises(InputError, match=r"holds no vectors of numbers.*object0"):
        read_log_file(tmp_path / f"alone{ending}")


@pytest.mark.parametrize("seed", range(10))
def test_links_of_hdf5_that_end_in_other_files_are_not_followed(tmp_path, seed):
    """A soft link may lead to an external one, or through it, at any depth; none is followed."""
    random = np.random.default_rng(seed)
    with h5py.File(tmp_path / "secret.h5", "w") as secret:
        secret["group/u"] = secret["u"] = U
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["t"] = T
        is_dataset, depth, inside = random.integers(0, 2), random.integers(1, 4), random.integers(0, 2) * "run/"
        target = "/u" if is_dataset else "/group"
        file[f"{inside}link"] = h5py.ExternalLink(tmp_path / "secret.h5", target)
        place = f"/{inside}link"
        for i in range(depth):
            file[f"soft{i}"] = h5py.SoftLink(place if i or is_dataset else f"{place}/u")
            place = f"/soft{i}"
        file["own"] = h5py.SoftLink("/t")
    log = read_log_file(tmp_path / "log.h5")
    assert set(log.columns) == {"t"}
    assert all(f"soft{i}" in log.notes[0] for i in range(depth)) and "links are not followed" in log.notes[0]


def test_lines_of_json_and_objects_within_rows(tmp_path):
    rows = [{"t": t, "motor": {"u": u, "q": [u, t]}} for t, u in zip(T.tolist(), U.tolist(), strict=True)]
    (tmp_path / "log.jsonl").write_text("\n".join(map(json.dumps, rows)) + "\n")
    (tmp_path / "log.json").write_text(json.dumps(rows))
    for name in ("log.jsonl", "log.json"):
        file = read_log_file(tmp_path / name)
        for column, values in {"t": T, "motor.u": U, "motor.q[0]": U, "motor.q[1]": T}.items():
            np.testing.assert_array_equal(file.load_numbers(column), values)


def test_columns_that_are_not_wanted_are_read_only_if_asked_for(tmp_path, monkeypatch):
    frame = pd.DataFrame({"t": T, "u": U, "other": 2.0 * U})
    frame.to_csv(tmp_path / "log.csv", index=False)
    frame.to_parquet(tmp_path / "log.parquet")
    monkeypatch.setattr(files, "_CHUNK_ROWS", 2)  # in three chunks
    for name in ("log.csv", "log.parquet"):
        file = read_log_file(tmp_path / name, {"t", 1})
        assert list(file.columns) == ["t", "u", "other"] and isinstance(file.columns["other"], Column)
        assert len(file.columns["other"]) == 5
        np.testing.assert_array_equal(file.load_numbers("u"), U)
        np.testing.assert_array_equal(file.load_numbers("other"), 2.0 * U)


BAD_FILES = {
    "missing": (None, "no such file"),
    "empty.csv": (b"", "is empty; text .* can be read"),
    "blank.csv": (b" \n\n", "is empty"),
    "mark.csv": (b"\xef\xbb\xbf", "is empty"),
    "mark and space.csv": (b"\xef\xbb\xbf \n", "is empty"),
    "remarks.csv": (b"# hello\n", "holds only remarks; rows of numbers are needed"),
    "header.csv": (b"t,u\n", "has a header and no rows"),
    "twice.csv": (b"t,u,u\n1,2,3\n", "two columns are called 'u'; names should differ"),
    "wide.csv": (b"t,u\n1,2,3\n", "rows have more columns than the header; they should have 2"),
    "ragged.csv": (b"t,u\n1,2\n1,2,3\n", "cannot be read as a table: .* line 3"),
    "photo.png": (b"\x89PNG\0\0\0", "is not a log of a known kind"),
    "broken.json": (b'{"t": [1, 2', "is not valid JSON"),
    "scalars.json": (b'{"t": 1}', "holds no vectors of numbers"),
    "list.json": (b"[1, 2]", "should hold an array of objects, one a row, or of rows of equally many numbers"),
    "ragged.json": (b"[[1, 2], [3]]", "should hold an array of objects"),
    "log.csv.gz": (b"\x1f\x8b\x08", "is compressed; unpack it first"),
    "log.xlsx": (b"PK\x03\x04", "is a workbook or an archive; save"),
    "log.xls": (b"\xd0\xcf\x11\xe0", "is a workbook; save the sheet as CSV"),
    "log.npy": (b"\x93NUMPY\x01", "is an array of NumPy; save it"),
    "bag.db3": (b"SQLite format 3\0", "perhaps of a ROS 2 bag; give the bag's folder"),
    "broken.parquet": (b"PAR1 no", "cannot be read as Parquet"),
    "broken.mat": (b"no matlab at all" * 20, "cannot be read as a MATLAB file"),
    "broken73.mat": (b"\x89HDF\r\n\x1a\n no", "cannot be read as a MATLAB file"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_unreadable_files_are_named_in_one_line(name, tmp_path):
    content, message = BAD_FILES[name]
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=message) as error:
        read_log_file(path)
    assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value)


def test_a_column_named_like_an_archive_is_text(tmp_path):
    (tmp_path / "log.csv").write_text("PK,u\n1,2\n3,4\n")
    assert list(read_log_file(tmp_path / "log.csv").columns) == ["PK", "u"]


def test_a_folder_and_a_file_without_vectors(tmp_path):
    with pytest.raises(InputError, match="is a folder; a log file is needed"):
        read_log_file(tmp_path)
    savemat(tmp_path / "a.mat", {"x": 1.0, "name": "hi"})
    with pytest.raises(InputError, match="holds no vectors of numbers"):
        read_log_file(tmp_path / "a.mat")


COLUMNS = {
    "near": ("t,theta_e\n1,2\n", "thetae", "no column 'thetae'; did you mean 'theta_e'\\?"),
    "far": ("t,x\n1,2\n", "theta_e", "no column 'theta_e'; valid: t, x"),
    "number": ("t,x\n1,2\n", 2, "no column 2: the file has 2 columns, numbered 0 to 1"),
    "only one": ("1\n2\n", 1, "no column 1: the file has only column 0"),
    "no header": ("1,2\n3,4\n", "u", "no column 'u': the file has no header; give the column's number, 0 to 1"),
    "text": ("t,u\n1,2\n2,on\n", "u", "column 'u', data row 2 is 'on'; it should be a finite number"),
    "hole": ("t,u\n1,\n2,3\n", "u", "column 'u', data row 1 is empty or not a number"),
    "nan": ("t,u\n1,2\n2,nan\n", "u", "column 'u', data row 2 is empty or not a number"),
    "infinite": ("t,u\n1,2\n2,inf\n", "u", "column 'u', data row 2 is inf"),
    "truncated": ("t,u\n1,2\n3", "u", "column 'u', data row 2 is empty"),
}


@pytest.mark.parametrize("case", COLUMNS)
def test_columns_that_are_not_there_or_not_numbers(case, tmp_path):
    content, column, message = COLUMNS[case]
    (tmp_path / "log.csv").write_text(content)
    with pytest.raises(InputError, match=message):
        read_log_file(tmp_path / "log.csv").load_numbers(column)


EPOS = """Date:;2020-07-09 22:31:10
EPOS Studio Version:;3.6.1.0
Sampling period:;40.000
"Trigger:;1;0.000000;""Channel 1"";x"
;Velocity actual value averaged;Torque actual value averaged
ms;rpm;%
0.000;0;0.5
40.000;-3;1.5
80.000;7;2.5
"""
SCOPE = """Name\tproject
File\tlog.csv
Starttime of export\t132959733843760000\tMontag, 2. Mai 2022\t15:56:24.376


Name\tposition\tcurrent\tName\tfast
Data-Type\tREAL64\tREAL64\tData-Type\tREAL32
SampleTime[ms]\t2\t2\tSampleTime[ms]\t1

0\t0,5\t1\t0\t0
2\t1,5\t2\t1\t10
4\t2,5\t3\t2\t20
EOF
"""


def test_exports_with_remarks_before_their_rows(tmp_path):
    (tmp_path / "epos.csv").write_bytes(EPOS.replace("\n", "\r\n").encode())
    file = read_log_file(tmp_path / "epos.csv")
    assert list(file.columns) == ["t", "Velocity actual value averaged", "Torque actual value averaged"]
    np.testing.assert_array_equal(file.load_numbers(1), [0.0, -3.0, 7.0])
    assert file.units["t"] == "ms" and file.units["Torque actual value averaged"] == "%"
    assert file.notes == [
        "The file gives these units, which [log] should repeat: t ms, Velocity actual value averaged rpm, Torque actual "
        "value averaged %."
    ]
    (tmp_path / "scope.csv").write_text(SCOPE)
    file = read_log_file(tmp_path / "scope.csv")
    assert list(file.columns) == ["t", "position", "current", "fast"]
    np.testing.assert_array_equal(file.load_numbers("position"), [0.5, 1.5, 2.5])
    # sampled at times of its own: the last is before those of the others
    np.testing.assert_array_equal(np.asarray(file.columns["fast"], float), [0.0, 20.0, np.nan])
    assert file.notes == ["'fast' was sampled at other times: it is interpolated to those of the first column."]


def test_tdms_by_its_library(tmp_path):
    library = pytest.importorskip("nptdms", reason="the extra logs is not installed")
    channels = [library.ChannelObject("drive", name, x, {"wf_increment": 0.1}) for name, x in (("u", U), ("theta_e", T))]
    with library.TdmsWriter(tmp_path / "log.tdms") as writer:
        writer.write_segment(channels)
    file = read_log_file(tmp_path / "log.tdms")
    assert list(file.columns) == ["u", "theta_e", "t"]
    np.testing.assert_array_equal(file.load_numbers("u"), U)
    np.testing.assert_allclose(file.load_numbers("t"), T)


@pytest.mark.filterwarnings("ignore")  # of the library
def test_mdf_by_its_library(tmp_path):
    library = pytest.importorskip("asammdf", reason="the extra logs is not installed")
    with library.MDF() as mdf:
        mdf.append([library.Signal(U, T, name="u"), library.Signal(2.0 * U, T, name="theta_e")])
        mdf.append([library.Signal(np.array([0.0, 4.0]), T[[0, -1]], name="slow")])
        mdf.save(tmp_path / "log.mf4")
    file = read_log_file(tmp_path / "log.mf4")
    assert set(file.columns) == {"t", "u", "theta_e", "slow"}
    np.testing.assert_array_equal(file.load_numbers("theta_e"), 2.0 * U)
    np.testing.assert_allclose(file.load_numbers("t"), T)
    np.testing.assert_allclose(file.load_numbers("slow"), [0.0, 1.0, 2.0, 3.0, 4.0])


def write_mcap_log(path):
    """A topic in JSON at times of recording, another, slower one."""
    axis = [(t, {"u": u, "angles": [t, u], "name": "x"}) for t, u in zip(T.tolist(), U.tolist(), strict=True)]
    write_mcap(path, {"axis": axis, "slow": [(t, {"v": 10.0 * t}) for t in T[[0, 4]].tolist()]})


def write_bag(path):
    """Joint states, stamped in their headers, recorded 5 ms late."""
    library = pytest.importorskip("rosbags.rosbag2", reason="the extra logs is not installed")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    state, header, stamp = (
        store.types[f"{n}/msg/{m}"]
        for n, m in (("sensor_msgs", "JointState"), ("std_msgs", "Header"), ("builtin_interfaces", "Time"))
    )
    with library.Writer(path, version=9) as writer:
        topic = writer.add_connection("/joint_states", state.__msgtype__, typestore=store)
        for t, u in zip(T, U, strict=True):
            time = round(1e9 * t)
            head = header(stamp(*divmod(time, 10**9)), "")
            message = state(head, ["a"], np.array([t]), np.array([]), np.array([u]))
            writer.write(topic, time + 5_000_000, store.serialize_cdr(message, state.__msgtype__))


@pytest.mark.parametrize("folder", [b"b\xffd", b"\xe9", b"a\xc3", b"\xed\xa0\x80"])
def test_a_folder_may_have_a_name_that_is_no_utf8(tmp_path, folder):
    """Parquet's library takes none: "cannot be read as Parquet, write it anew" was said of a sound log."""
    place = tmp_path / os.fsdecode(folder)
    place.mkdir()
    pd.DataFrame({"t": T, "u": U}).to_parquet(tmp_path / "log.parquet")
    (tmp_path / "log.parquet").rename(place / "log.parquet")
    file = read_log_file(place / "log.parquet")
    np.testing.assert_array_equal([file.load_numbers(name) for name in "tu"], [T, U])


@pytest.mark.parametrize("member", ['"u": 2', '"x": {"y": 1, "z": 2, "y": 3}', '"x": [{"y": 1, "y": 1}]'])
def test_two_members_of_one_name_in_a_message_are_refused(tmp_path, monkeypatch, member):
    """The last one would be taken without a word."""
    monkeypatch.setattr("mcap_log.json.dumps", lambda message: f'{{"u": 1, {member}}}')
    write_mcap(tmp_path / "log.mcap", {"s": [(t, {}) for t in T.tolist()]})
    with pytest.raises(InputError, match=r"log\.mcap: two members of an object are called '[uy]'; names should differ"):
        read_log_file(tmp_path / "log.mcap")


def test_mcap_and_ros_bags_by_their_libraries(tmp_path):
    write_mcap_log(tmp_path / "log.mcap")
    file = read_log_file(tmp_path / "log.mcap", {"t", "/axis.u", "/slow.v"})
    assert list(file.columns) == ["t", "/axis.u", "/axis.angles[0]", "/axis.angles[1]", "/slow.v"]
    for column, values in {"t": T, "/axis.u": U, "/axis.angles[0]": T, "/slow.v": 10.0 * T}.items():
        np.testing.assert_allclose(file.load_numbers(column), values, atol=1e-7)
    assert file.notes == ["/slow is interpolated to the times of /axis, which has the most messages."]
    write_bag(tmp_path / "bag")
    file = read_log_file(tmp_path / "bag", {"t", "/joint_states.position[a]"})
    for column, values in {"t": T, "/joint_states.position[a]": T, "/joint_states.effort[a]": U}.items():
        np.testing.assert_allclose(file.load_numbers(column), values, atol=1e-9)


STAMPS = {
    "ros 2": lambda s, n: {"header": {"stamp": {"sec": s, "nanosec": n}}},
    "ros 1": lambda s, n: {"header": {"stamp": {"secs": s, "nsecs": n}}},
    "short": lambda s, n: {"header": {"stamp": {"sec": s, "nsec": n}}},
    "protobuf": lambda s, n: {"timestamp": {"seconds": s, "nanos": n}},
    "beside": lambda s, n: {"stamp": {"sec": s, "nsec": n}},
    "text": lambda s, n: {"timestamp": f"{np.datetime64(s, 's')}.{n:09d}Z"},
}


@pytest.mark.parametrize("form", STAMPS)
@pytest.mark.parametrize("seed", [0, 1])
def test_joints_are_read_by_name_at_the_stamps_of_their_messages(tmp_path, form, seed):
    """Another publisher writes first, and now and then, to the same topic; the order of names changes."""
    random = np.random.default_rng(seed)
    joints = [f"joint{i}" for i in range(random.integers(1, 5))]
    positions = random.standard_normal((200, len(joints)))
    messages = []
    for i in range(200):
        stamp = STAMPS[form](1_700_000_000, 5_000_000 * i)
        if i % 50 == 0:
            messages.append((0.005 * i, stamp | {"name": ["gripper"], "position": [9.0]}))
        order = random.permutation(len(joints)).tolist()
        state = {"name": [joints[k] for k in order], "position": [float(positions[i, k]) for k in order], "effort": []}
        # recorded late, by a time that changes
        messages.append((0.005 * i + 0.001 + 0.002 * random.random(), stamp | state))
    write_mcap(tmp_path / "log.mcap", {"state": messages})
    names = [f"/state.position[{joint}]" for joint in joints]
    file = read_log_file(tmp_path / "log.mcap", ["t", *names])
    is_arm = ~np.isnan(file.load_values(names[0]))
    np.testing.assert_allclose(file.load_numbers("t")[is_arm], 0.005 * np.arange(200), atol=1e-9)
    for name, values in zip(names, positions.T, strict=True):
        np.testing.assert_array_equal(file.load_values(name)[is_arm], values)
    assert "/state.position[gripper]" in read_log_file(tmp_path / "log.mcap").columns


def test_names_of_joints_reach_into_what_is_beside_them(tmp_path):
    values = [{"names": ["position", "effort"], "values": [t, u]} for t, u in zip(T.tolist(), U.tolist(), strict=True)]
    state = {"joint_names": ["a", "b"], "interfaces": values[:2], "desired": {"q": [1.0, 2.0]}, "twins": ["x", "x", "x"]}
    write_mcap(tmp_path / "log.mcap", {"s": [(t, state | {"three": [1, 2, 3]}) for t in T.tolist()]})
    file = read_log_file(tmp_path / "log.mcap")
    assert [column for column in file.columns if column != "t"] == [
        "/s.interfaces[a].values[position]",
        "/s.interfaces[a].values[effort]",
        "/s.interfaces[b].values[position]",
        "/s.interfaces[b].values[effort]",
        "/s.desired.q[a]",
        "/s.desired.q[b]",
        "/s.three[0]",
        "/s.three[1]",
        "/s.three[2]",
    ]


DATES = {
    "iso": "%Y-%m-%dT%H:%M:%S.%fZ",
    "blank": "%Y-%m-%d %H:%M:%S.%f",
    "zone": "%Y-%m-%d %H:%M:%S.%f+02:00",
    "time": "%H:%M:%S.%f",
    "slashes": "%Y/%m/%d %H:%M:%S.%f",
}


@pytest.mark.parametrize("form", DATES)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "utf-16-sig"])
@pytest.mark.parametrize("units", ["", "[s];;[deg]", ";N m;deg"])
def test_dates_encodings_and_units_of_text(tmp_path, form, encoding, units):
    stamps = pd.Timestamp("2026-03-01 08:00:58") + pd.to_timedelta(np.arange(4000) * 0.001, unit="s")
    texts = [text.replace(".", ",") for text in stamps.strftime(DATES[form])]
    rows = [f"{text};{i},5;{2 * i}" for i, text in enumerate(texts)]
    path, mark = tmp_path / "log.csv", "\ufeff" * encoding.endswith("sig")
    text = "\r\n".join(["time;u;q\u00b0", *[units] * bool(units), *rows]) + "\r\n"
    path.write_bytes((mark + text).encode(encoding.removesuffix("-sig") + "-le" * bool(mark)))
    file = read_log_file(path, ["time", "u"])
    np.testing.assert_allclose(file.load_seconds("time", 1.0), np.arange(4000) * 0.001, atol=1e-9)
    np.testing.assert_array_equal(file.load_numbers("u"), np.arange(4000) + 0.5)
    assert list(file.columns) == ["time", "u", "q\u00b0"] and (file.units.get("q\u00b0") == "deg") == bool(units)


@pytest.mark.parametrize("options", [{"chunk_size": 2000}, {"compression": 0}])
def test_a_flipped_bit_of_an_mcap_file_is_found(tmp_path, options, repeats):
    random = np.random.default_rng(0)
    path, names = tmp_path / "log.mcap", ("t", "/axis.u", "/axis.x")
    pytest.importorskip("mcap")
    if "compression" in options:
        from mcap.writer import CompressionType

        options = {"compression": CompressionType.NONE}
    messages = [(0.01 * i, {"u": u, "x": x}) for i, (u, x) in enumerate(random.standard_normal((100, 2)).tolist())]
    write_mcap(path, {"axis": messages}, **options)
    content, file = path.read_bytes(), read_log_file(path, names)
    truth = [file.load_numbers(name) for name in names]
    for _ in range(repeats(40, 400)):
        damaged = bytearray(content)
        damaged[random.integers(len(content))] ^= 1 << random.integers(8)
        path.write_bytes(damaged)
        with suppress(InputError):
            file = read_log_file(path, names)
            np.testing.assert_array_equal([file.load_numbers(name) for name in names], truth)


@pytest.mark.parametrize(
    ("mark", "package"),
    [(b"TDSm", "nptdms"), (b"MDF     4.10    ", "asammdf"), (b"\x89MCAP0\r\n", "mcap"), (b"#ROSBAG V2.0", "rosbags")],
)
def test_a_missing_library_names_the_extra(tmp_path, monkeypatch, mark, package):
    for module in (package, "mcap.reader", "rosbags.highlevel"):
        monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / "log").write_bytes(mark + bytes(64))
    with pytest.raises(InputError, match=rf"needs the package {package}: pip install 'jaxbl\[logs\]'"):
        read_log_file(tmp_path / "log")


def test_names_within_a_structure_are_told(tmp_path):
    """Nothing wanted is in the file: its user learns what is."""
    savemat(tmp_path / "log.mat", {"log": {"time": T, "u": U}, "rate": T[:3]})
    with pytest.raises(InputError, match=r"no column 'theta_e'; valid: rate, log.time, log.u"):
        read_log_file(tmp_path / "log.mat", {"t", "u", "theta_e"}).find_column("theta_e")
    with pytest.raises(InputError, match=r"log.mat: no column 't'; .*log\.u"):
        read_record(tmp_path / "log.mat")


def test_a_letter_of_another_encoding_far_behind_the_head(tmp_path):
    rows = "".join(f"{i},{2 * i},a\n" for i in range(40_000))
    (tmp_path / "log.csv").write_bytes(f"t,u,note\n{rows}1,2,5 \u00b0C\n".encode("latin-1"))
    assert len(rows) > files._HEAD_BYTES
    assert read_log_file(tmp_path / "log.csv", {"t", "u"}).load_numbers("u")[-1] == 2.0


def test_a_decimal_comma_that_comes_late(tmp_path):
    """A drive that stands still at first writes whole numbers."""
    rows = [*(f"{i};0;0" for i in range(60)), "60,500;1,5;2"]
    (tmp_path / "log.csv").write_text("t;u;x\n" + "\n".join(rows))
    file = read_log_file(tmp_path / "log.csv")
    assert file.load_numbers("t")[-1] == 60.5 and file.load_numbers("u")[-1] == 1.5


def test_a_period_in_place_of_stamps_counts_the_channels_that_are_read(tmp_path):
    values = np.cumsum(np.random.default_rng(0).standard_normal((2, 400)), axis=1)
    savemat(tmp_path / "log.mat", {"u": values[0], "theta_e": values[1], "scope": np.arange(900.0)})
    record = read_record(tmp_path / "log.mat", {"t": {"period": 1e-3}})
    assert len(record.time) == 400
    savemat(tmp_path / "other.mat", {"torque": values[0], "theta": values[1]})
    with pytest.raises(InputError, match=r"no column 'theta_e' or 'theta_s'; columns: torque, theta"):
        read_record(tmp_path / "other.mat", {"t": {"period": 1e-3}})


@pytest.mark.parametrize("name", ["torque\xa0(Nm)", "\u202eu", "u\x1b[0m"])
def test_columns_are_found_by_the_name_that_the_file_has_and_by_the_one_that_messages_spell(name, tmp_path):
    pd.DataFrame({"t": T, name: U}).to_csv(tmp_path / "log.csv", index=False)
    file = read_log_file(tmp_path / "log.csv", ("t", name))
    for column in (name, repr(name)[1:-1]):
        np.testing.assert_array_equal(file.load_numbers(column), U)


def read_blocks(path):
    words = np.fromfile(path).reshape(-1, 2)
    return {"t": words[:, 0], "u": words[:, 1]}


def read_blocks_lazily(path):
    columns = Columns(
        {name: Column(lambda i=i: np.fromfile(path).reshape(-1, 2)[:, i], len(T)) for i, name in enumerate("tu")}
    )
    columns.notes.append("Read block by block.")
    return columns


@pytest.fixture
def install_readers(monkeypatch):
    """Readers as of installed packages, by ending."""

    def install(**readers):
        monkeypatch.setattr(files.READERS, "_members", {})
        monkeypatch.setattr(files.READERS, "_loaded", False)
        entries = [SimpleNamespace(name=name, value="a:b", load=lambda read=read: read) for name, read in readers.items()]
        monkeypatch.setattr("jaxbl.registry.entry_points", lambda group: entries if group == "jaxbl.readers" else [])

    return install


@pytest.mark.parametrize("read", [read_blocks, read_blocks_lazily, lambda path: pd.DataFrame(read_blocks(path))])
def test_readers_of_installed_packages_read_the_files_of_their_ending(read, install_readers, tmp_path):
    np.stack([T, U], axis=1).tofile(tmp_path / "log.REC")
    assert not files.is_log(tmp_path / "log.REC")
    install_readers(rec=read)
    assert files.is_log(tmp_path / "log.REC") and files.log_suffixes()[-1] == ".rec"
    columns = read_log_file(tmp_path / "log.REC", ("t", "u"))
    for name, values in {"t": T, "u": U}.items():
        np.testing.assert_array_equal(columns.load_numbers(name), values)
    assert columns.notes == (["Read block by block."] if read is read_blocks_lazily else [])


@pytest.mark.parametrize(
    ("read", "message"),
    [
        (lambda path: [1.0, 2.0], "the reader of .rec files should give columns of one dimension by name"),
        (lambda path: None, "the reader of .rec files should give columns of one dimension by name"),
        (lambda path: {"t": np.zeros((2, 2))}, "the reader of .rec files should give columns of one dimension by name"),
        (lambda path: {0: T}, "the reader of .rec files should give columns of one dimension by name"),
        (lambda path: {}["t"], "cannot be read as a log by the reader of .rec files: 't'; write it anew, or as CSV"),
    ],
)
def test_what_a_reader_of_a_package_does_wrong_is_one_line(read, message, install_readers, tmp_path):
    (tmp_path / "log.rec").write_bytes(b"x")
    install_readers(rec=read)
    with pytest.raises(InputError) as error:
        read_log_file(tmp_path / "log.rec")
    assert str(error.value) == f"{tmp_path / 'log.rec'}: {message}"


def test_readers_cannot_take_the_endings_of_others(install_readers, caplog):
    install_readers(csv=read_blocks, **{".Rec": read_blocks, "rec": 3})
    assert list(files.READERS) == []
    assert [message.partition("left out: ")[2] for message in caplog.messages] == [
        "ValueError: files that end in .csv are read by jaxbl itself",
        "ValueError: its name should be the ending of its files, in small letters and without the dot",
        "TypeError: should be a function of a file's path",
    ]


FORMS = {
    "thousands": 't,u\n1,"1,234.5"\n2,"-2,234,567.25"\n3,7\n',
    "thousands with points": "t;u\n1;1.234,5\n2;-2.234.567,25\n3;7\n",
    "units and words": "t;state;u\ns;-;N m\n1;RUN;1234.5\n2;RUN;-2234567.25\n3;ok;7\n",
    "units between blanks": "t u\ns Nm\n1 1234.5\n2 -2234567.25\n3 7\n",
    "units and a comma": "t;u\n[s];[N m]\n1;1234,5\n2;-2234567,25\n3;7\n",
    "dates and a comma": "date;u\n2026-03-01 10:00:00.1;1234,5\n2026-03-01 10:00:00.2;-2234567,25\n2026-03-01 10:00:01;7\n",
    "a separator in a name": 't,"speed; rpm",u\n1,3,1234.5\n2,3,-2234567.25\n3,3,7\n',
    "another in a name": "t\tspeed; rpm\tu\n1\t3\t1234.5\n2\t3\t-2234567.25\n3\t3\t7\n",
    "the header again": "t,u,state\n1,1234.5,on\nt,u,state\n2,-2234567.25,on\n3,7,off\n",
    "the header again, a comma": "t;u\n1;1234,5\nt;u\n2;-2234567,25\n3;7\n",
}


@pytest.mark.parametrize("form", FORMS)
def test_forms_of_text(form, tmp_path):
    (tmp_path / "log.csv").write_text(FORMS[form])
    file = read_log_file(tmp_path / "log.csv")
    np.testing.assert_array_equal(file.load_numbers("u"), [1234.5, -2234567.25, 7.0])
    assert any("repeat the header are left out (data row 2 first)" in note for note in file.notes) == ("again" in form)
    assert ("u" in file.units) == ("units" in form)


def test_a_wrong_cell_beside_decimal_commas_is_named(tmp_path):
    (tmp_path / "log.csv").write_text("t;u\n1;1,5\n2;off\n3;2,5\n")
    with pytest.raises(InputError, match="column 'u', data row 2 is 'off'"):
        read_log_file(tmp_path / "log.csv").load_numbers("u")


LONG = "1" + "0" * 400


def json_log(**members):
    """An object of vectors as JSON; text in place of a vector stands as it is."""
    vectors = {"t": T.tolist(), "u": U.tolist()} | members
    return "{" + ", ".join(f'"{name}": {values}' for name, values in vectors.items()) + "}"


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (json_log(u=f"[1, {LONG}, 3, 4, 5]"), "data row 2 is inf"),
        (json_log(u=f"[1, {'7' * 5000}, 3, 4, 5]"), "data row 2 is inf"),
        (json_log(u=f"[1, -{LONG}, 3, 4, 5]"), "data row 2 is -inf"),
        (f"[[0, 1], [1, {LONG}], [2, 3]]", "data row 2 is inf"),
        (f'[{{"t": 0, "u": 1}}, {{"t": 1, "u": {LONG}}}]', "data row 2 is inf"),
        (json_log(u="[1, 36893488147419103232, 3, 4, 5]"), ""),
        (json_log()[:-1] + ', "u": [1, 2, 3, 4, 5]}', "two members of an object are called 'u'"),
        ('[{"t": 0, "u": 1, "u": 2}, {"t": 1, "u": 2, "u": 3}]', "two members of an object are called 'u'"),
        ('{"t": 0, "u": 1, "t": 2}\n{"t": 1, "u": 2, "t": 3}', "two members of an object are called 't'"),
        ('{"axis": {"u": [1, 2], "u": [1, 2]}}', "two members of an object are called 'u'"),
        ('[{"a": {"b": 1, "b": 2}}]', "two members of an object are called 'b'"),
    ],
)
def test_numbers_of_any_length_and_double_names_in_json(text, fault, tmp_path):
    """A whole number beyond all floats is no finite number, and two values of one name are not chosen from."""
    (tmp_path / "log.json").write_text(text)

    def load():
        log = read_log_file(tmp_path / "log.json")
        return log.load_numbers(list(log.columns)[-1])

    if not fault:
        assert load()[1] == 2.0**65
        return
    with pytest.raises(InputError, match=fault) as error:
        load()
    assert len(str(error.value)) < 500


@pytest.mark.parametrize("kind", ["f", "i8", "S4", "u1"])
def test_datasets_without_a_value_are_left_out(kind, tmp_path):
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["t"], file["u"], file["option"] = T, U, h5py.Empty(kind)
        file.create_group("deeper")["option"] = h5py.Empty(kind)
    assert list(read_log_file(tmp_path / "log.h5").columns) == ["t", "u"]


@pytest.mark.parametrize("kind", ["csv", "parquet", "json"])
@pytest.mark.parametrize("unit", [1, 1000])
def test_stamps_since_1970_keep_their_nanoseconds(kind, unit, tmp_path):
    """As float64 they would be rounded to 256 ns, a thirtieth of this period."""
    stamps = 1_700_000_000_123_456_789 + 7_919 * np.arange(50)
    frame = pd.DataFrame({"t": stamps // unit, "u": np.zeros(50)})
    path = tmp_path / f"log.{kind}"
    frame.to_parquet(path) if kind == "parquet" else path.write_text(
        frame.to_csv(index=False) if kind == "csv" else json.dumps(frame.to_dict("list"))
    )
    log = read_log_file(path)
    seconds = log.load_seconds("t", unit * 1e-9)
    exact = (stamps // unit - stamps[0] // unit) * unit
    tolerance = 1e-12 if unit == 1 else 1e-6
    np.testing.assert_allclose(seconds - seconds[0], 1e-9 * exact, rtol=0.0, atol=tolerance)
