"""Inputs that nobody should give, and what becomes of them: a script, so that its process has limits of its own.

`python bad_inputs.py listed|toml|logs FOLDER COUNT` reads inputs (COUNT of those that are generated) and writes what was
said of each as JSON. It ends with an error where one takes over 10 s of processor time, waits for long, takes over 2 GB, or
ends in anything but a result or one line.
"""

import copy
import faulthandler
import json
import math
import os
import resource
import sys
import warnings
from pathlib import Path

import h5py
import hypothesis.strategies as st
import numpy as np
import pandas as pd
import tomli_w
from hypothesis import HealthCheck, given, reject, settings
from measured import simulate_log
from scipy.io import savemat
from small_study import ALPHA, LAMBDA, listed_axis, rigid_study, small_study, spaced_axis

from jaxbl.config import read_config, read_log_config
from jaxbl.errors import InputError
from jaxbl.records import read_record
from jaxbl.report.checks import check_figures
from jaxbl.sweeps.metrics import metric_columns
from jaxbl.sweeps.points import Points

SECONDS, BYTES = 10, 2 * 2**30
ESC = "\x1b[31mred"
STUDY = small_study(axes=[listed_axis(ALPHA, 5.0, 9.0)])


def check_study(path: Path) -> str:
    """Check a study as a command does before it computes; return the line that refuses it, or ""."""
    try:
        config = read_config(path)
        check_figures(config, config.figures, metric_columns(config.build()))
        len(Points(config))
        config.to_toml()
        return ""
    except InputError as error:
        return str(error)


def check_log(path: Path, model: Path | None = None) -> str:
    """Read a log as a command does before it computes; return the line that refuses it, or its remarks."""
    try:
        table = None if model is None else read_log_config(model)[0]
        return " ".join(read_record(path, table).notes)
    except InputError as error:
        return str(error)


def format_toml(data, old="", new="") -> str:
    return tomli_w.dumps(data).replace(old, new)


def write_include_chain(folder: Path, count: int, times: int) -> str:
    """Write `count` files that include the next one `times` times, and a study; return what includes the first."""
    for i in range(count):
        (folder / f"{i}.toml").write_text(f"include = {[f'{i + 1}.toml'] * times}\n")
    (folder / f"{count}.toml").write_text(format_toml(STUDY))
    return 'include = "0.toml"\n'


def sine_input(frequency: float):
    return {"kind": "sine", "amplitude": 0.1, "frequency": frequency}


def recorded_input_study(file: str):
    return small_study(excitation={"kind": "recorded", "file": file})


def make_pipe(folder: Path) -> str:
    os.mkfifo(folder / "pipe.csv")
    return "pipe.csv"


def write_short_record(folder: Path) -> str:
    pd.DataFrame({"t": [0.0, 0.05], "u": [1.0, 2.0]}).to_csv(folder / "short.csv", index=False)
    return "short.csv"


# name -> text of the study, or its data
STUDIES = {
    "inertia": lambda folder: small_study({"drive.motor_inertia": 5e-324}),
    "substeps of 1e30": lambda folder: small_study({"run.substeps": 10**30}),
    "substeps of 1e9": lambda folder: small_study({"run.substeps": 10**9}),
    "nested": lambda folder: f"notes = {'[' * 900}{']' * 900}\n{format_toml(STUDY)}",
    "nested tables": lambda folder: f"a.{'.'.join(['b'] * 49)} = 1\n{format_toml(STUDY)}",
    "dotted": lambda folder: f"a.{'.'.join(['b'] * 900)} = 1\n{format_toml(STUDY)}",
    "nested far": lambda folder: f"notes = {'[' * 100000}{']' * 100000}\n{format_toml(STUDY)}",
    "long kind": lambda folder: small_study(effects=[{"kind": "x" * 5000}]),
    "long key": lambda folder: small_study({f"drive.{'x' * 5000}": 1.0}),
    "long title": lambda folder: small_study(title="x" * 5000),
    "long path": lambda folder: small_study(axes=[listed_axis("o" * 5000, 1.0, 2.0)]),
    "chained": lambda folder: write_include_chain(folder, 2000, 1),
    "doubled": lambda folder: write_include_chain(folder, 30, 2),
    "pipe included": lambda folder: f'include = "{make_pipe(folder)}"\n',
    "device included": lambda folder: 'include = "/dev/zero"\n',
    "pipe recorded": lambda folder: recorded_input_study(make_pipe(folder)),
    "device recorded": lambda folder: recorded_input_study("/dev/zero"),
    "harmonics": lambda folder: small_study(
        excitation={"kind": "multisine", "amplitude": 1.0, "frequency": 1.0, "count": 10**9}
    ),
    "values": lambda folder: format_toml(STUDY).replace("5.0,\n", ",".join(["5.0"] * 3_000_000) + ","),
    "fewer values": lambda folder: format_toml(STUDY).replace("5.0,\n", ",".join(["5.0"] * 400_000) + ","),
    "sine at the rate": lambda folder: small_study(excitation=sine_input(1000.0)),
    "short steps": lambda folder: small_study(excitation={"kind": "steps", "amplitude": 0.1, "hold": 1e-12}),
    "short record": lambda folder: recorded_input_study(write_short_record(folder)),
    "gear ratio": lambda folder: small_study({"drive.gear_ratio": 1e-12}),
    "escape": lambda folder: small_study(title=ESC),
}


def write_hdf5(folder: Path, more) -> Path:
    path = folder / "log.h5"
    with h5py.File(path, "w") as file:
        for name, values in simulate_log(count=400).items():
            file[name] = values.to_numpy()
        more(file)
    return path


def compressed_dataset(name: str, *shape: int, dtype="f8"):
    def add(file):
        file.pop(name, None)
        options = {"chunks": (1,) * (len(shape) - 1) + (1_000_000,), "compression": "gzip"}
        file.create_dataset(name, shape=shape, dtype=dtype, **options)

    return add


def store_elsewhere(file):
    del file["theta_s"]
    file.create_dataset("theta_s", shape=(400,), dtype="u1", external=[(__file__, 0, 400)])


def link_elsewhere(file):
    del file["theta_s"]
    file["theta_s"] = h5py.ExternalLink("other.h5", "x")


def link_to_itself(file):
    file.create_group("g")["again"] = file["/"]


def write_table(folder: Path, name="log.csv", change=lambda frame: None, **columns) -> Path:
    frame = simulate_log(count=4000)
    for column, function in columns.items():
        frame[column] = function(frame[column])
    frame = frame if (new := change(frame)) is None else new
    path = folder / name
    frame.to_parquet(path) if path.suffix == ".parquet" else frame.to_csv(path, index=False)
    return path


def write_text(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder / name


def write_table_and_model(folder: Path, model: str) -> tuple[Path, Path]:
    return write_table(folder), write_text(folder, "model.toml", model)


def write_complex_matlab(folder: Path) -> Path:
    columns = {name: values.to_numpy() for name, values in simulate_log(count=400).items()}
    savemat(folder / "log.mat", columns | {"theta_s": columns["theta_s"] * (1.0 + 1.0j)})
    return folder / "log.mat"


def freeze_values(values: pd.Series) -> pd.Series:
    values = values.copy()
    values[1000:3000] = values[1000]
    return values


LOGS = {
    "number": lambda folder: write_text(folder, "log.json", "3"),
    "deep array": lambda folder: write_text(folder, "log.json", "[" * 100_000 + "]" * 100_000),
    "deep object": lambda folder: write_text(folder, "log.json", '{"a":' * 50_000 + "1" + "}" * 50_000),
    "one line": lambda folder: write_text(folder, "log.csv", "1," * 25_000_000),
    "one line of text": lambda folder: write_text(folder, "log.txt", "a " * 25_000_000),
    "one cell": lambda folder: write_text(folder, "log.csv", '"' * 50_000_000),
    "a long row": lambda folder: write_text(folder, "log.csv", "t,u,theta_e\n" + "1," * 25_000_000),
    "late stamps": lambda folder: write_table(folder, t=lambda t: t * 1e300),
    "early stamps": lambda folder: write_table(folder, t=lambda t: t * 1e-300),
    "far positions": lambda folder: write_table(folder, theta_e=lambda x: x * 1e300),
    "no motion": lambda folder: write_table(folder, theta_e=lambda x: x * 1e-300),
    "no torque": lambda folder: write_table(folder, u=lambda x: x * 1e-300),
    "resampled": lambda folder: write_table_and_model(folder, "[log]\nresample = 1e-12\n"),
    "drifting": lambda folder: write_table_and_model(folder, "[log]\ntheta_s = { drift = -1e9 }\n"),
    "unpacks": lambda folder: write_hdf5(folder, compressed_dataset("junk", 2_000_000_000)),
    "unpacks twice": lambda folder: write_hdf5(folder, compressed_dataset("junk", 2, 2_000_000_000)),
    "unpacks in use": lambda folder: write_hdf5(folder, compressed_dataset("u", 2_000_000_000_000)),
    "unpacks less": lambda folder: write_hdf5(folder, compressed_dataset("u", 90_000_000)),
    "unpacks cells": lambda folder: write_hdf5(folder, compressed_dataset("cells", 2_000_000_000, dtype=h5py.ref_dtype)),
    "external": lambda folder: write_hdf5(folder, store_elsewhere),
    "external link": lambda folder: write_hdf5(folder, link_elsewhere),
    "loop": lambda folder: write_hdf5(folder, link_to_itself),
    "complex": write_complex_matlab,
    "dates": lambda folder: write_table(
        folder, "log.parquet", t=lambda t: pd.Timestamp("2026-01-01", tz="Europe/Berlin") + pd.to_timedelta(t, unit="s")
    ),
    "frozen": lambda folder: write_table(folder, theta_s=freeze_values),
    "clipped": lambda folder: write_table(folder, theta_s=lambda x: x.clip(upper=x.quantile(0.6))),
    "escape": lambda folder: write_table(
        folder, change=lambda frame: frame.rename(columns={"theta_e": ESC, "theta_s": "b"})
    ),
    "pipe": lambda folder: folder / make_pipe(folder),
    "device": lambda folder: Path("/dev/zero"),
}


FLOATS = [5e-324, 1e-310, 1e-30, 1e-12, 0.0, -1.0, 0.3, 1e9, 1e30, 1e300, math.inf, math.nan]
INTEGERS = [0, -1, 1, 7, 10**5, 2**31, 10**9, 2**63, 10**30]
TEXTS = ["", "x", "x" * 5000, ESC, "$\\frac{$", "a\nb", "\u202e", "/dev/zero", "..", "Ω", "a.b.c", "sine", "load", ALPHA]
ODD = st.one_of(
    st.sampled_from([*FLOATS, *INTEGERS, *TEXTS, True, [], {}, [[]], [1.0] * 1000, ["a", 1.0], {"x" * 300: 1}]),
    st.floats(),
    st.integers(-(10**20), 10**20),
    st.text(max_size=20),
    st.recursive(st.just(1.0), lambda inner: st.lists(inner, min_size=1, max_size=2), max_leaves=40),
)
NUMBERS = st.one_of(st.sampled_from(FLOATS), st.floats(-30.0, 30.0).map(lambda power: 10.0**power))
FULL_STUDIES = [
    small_study(
        axes=[spaced_axis(ALPHA, 5.0, 20.0, 3), listed_axis(LAMBDA, 1.0, 2.0)],
        figures=[{"kind": "heatmap", "x": ALPHA, "y": LAMBDA, "value": "motor.velocity_rmse"}],
        effects=[{"kind": "motor.coulomb_friction", "torque": 0.02}, {"kind": "actuator.delay", "delay": 0.01}],
        log={"t": {"unit": "ms"}, "theta_e": {"column": "x", "wrap": 6.0}, "where": {"mode": 1}},
        notes=["a remark"],
        uncertainty={"relative": 0.1, "exact": ["drive.gear_ratio"]},
        tune={"num": 3, "compare": [{"name": "old", "motor": {"lambda": 1.0, "alpha": 2.0},
                                     "load": {"lambda": 1.0, "alpha": 2.0}}]},
    ),
    rigid_study(
        axes=[spaced_axis(ALPHA, 5.0, 20.0, None), spaced_axis(LAMBDA, 1.0, 5.0, None)],
        sweep={"design": "sobol", "points": 16, "seeds": 2},
        excitation={"kind": "prbs", "amplitude": 1.0, "hold": 0.01, "order": 5},
        verify={"q": 0.5, "marks": [{"name": "usual", "lambda": 4.0, "alpha": 9.0}], "damping": [0.1]},
        figures=[{"kind": "line", "x": ALPHA, "value": "motor.velocity_rmse"}],
    ),
    small_study(
        excitation={"kind": "chirp", "amplitude": 1.0, "start_frequency": 1.0, "stop_frequency": 9.0, "sweep_time": 1.0}
    ),
    small_study(excitation={"kind": "multisine", "amplitude": 1.0, "frequency": 1.0, "count": 4}, title="another"),
]  # fmt: skip


def list_paths(data, parents=()):
    """Yield the keys that lead to each table, array and value."""
    pairs = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for name, value in pairs:
        yield (*parents, name)
        yield from list_paths(value, (*parents, name))


def mutate_tables(draw, data):
    """Replace, remove or misplace one to three values, keys or tables of a study."""
    data = json.loads(json.dumps(data))
    for _ in range(draw(st.integers(1, 3))):
        *parents, last = draw(st.sampled_from(list(list_paths(data))))
        container = data
        for name in parents:
            container = container[name]
        mutation = draw(st.sampled_from([*["number"] * 8, *["replace"] * 3, "remove", "add"]))
        if mutation == "remove":
            del container[last]
        elif mutation == "add" and isinstance(container, dict):
            value = copy.deepcopy(draw(ODD))
            key = draw(st.one_of(st.sampled_from([text for text in TEXTS if text]), st.text(min_size=1, max_size=9)))
            container[key] = value
        elif mutation == "number" and isinstance(container[last], str):
            container[last] = draw(st.sampled_from(TEXTS))
        elif mutation == "number" and isinstance(container[last], int | float):
            container[last] = draw(NUMBERS) if isinstance(container[last], float) else draw(st.sampled_from(INTEGERS))
        elif mutation != "number":
            container[last] = copy.deepcopy(draw(ODD))
        if not data:
            break
    return data


def scramble_bytes(draw, content: bytes) -> bytes:
    """Cut a file short, repeat it, or change some of its bytes."""
    fault = draw(st.sampled_from([*["no"] * 9, "cut", "bytes", "again"]))
    if fault == "cut":
        return content[: draw(st.integers(0, len(content)))]
    if fault == "again":
        return content * draw(st.integers(2, 4))
    array = bytearray(content)
    for _ in range(draw(st.integers(1, 20)) if fault == "bytes" and content else 0):
        array[draw(st.integers(0, len(content) - 1))] = draw(st.integers(0, 255))
    return bytes(array)


@st.composite
def studies(draw) -> bytes:
    data = mutate_tables(draw, draw(st.sampled_from(FULL_STUDIES)))
    try:
        content = tomli_w.dumps(data).encode()
    except UnicodeEncodeError:
        content = b""
    return scramble_bytes(draw, content)


KINDS = ["csv", "csv", "txt", "json", "parquet", "mat", "h5"]
COLUMNS = {
    "huge": lambda x: x * 1e300,
    "large": lambda x: x * 1e20,
    "tiny": lambda x: x * 1e-300,
    "small": lambda x: x * 1e-12,
    "constant": lambda x: 0.0 * x + 1.0,
    "zero": lambda x: 0.0 * x,
    "backwards": lambda x: x[::-1],
    "missing": lambda x: np.where(np.arange(len(x)) % 7 == 3, np.nan, x),
    "nothing": lambda x: x * np.nan,
    "endless": lambda x: np.where(np.arange(len(x)) == 99, np.inf, x),
    "words": lambda x: np.array([f"{number:.3g} V" for number in x], dtype=object),
    "switch": lambda x: x > np.median(x),
    "counts": lambda x: np.round(x * 1e3).astype(np.int64),
    "unsigned": lambda x: np.round(x * 1e3).astype(np.int64).astype(np.uint16),
    "complex": lambda x: x * (1.0 + 1.0j),
    "dates": lambda x: np.datetime64("2026-01-01", "ns") + (1e9 * np.cumsum(np.abs(x))).astype("timedelta64[ns]"),
    "stuck": lambda x: np.where(np.arange(len(x)) > len(x) // 2, x[len(x) // 2], x),
    "coarse": lambda x: np.round(x, 1),
    "spikes": lambda x: x + 1e6 * (np.arange(len(x)) % 50 == 1),
    "noise": lambda x: np.random.default_rng(0).standard_normal(len(x)),
    "repeated": lambda x: np.repeat(x[::5], 5)[: len(x)],
}
TABLES = [
    {},
    {},
    {"resample": 2e-3},
    {"theta_e": {"unit": "deg"}, "u": {"saturation": 1.0}},
    {"theta_s": {"skew": "estimate"}, "start": 0.1},
    {"theta_s": {"skew": 1e-3, "drift": 1e-4}, "t": {"unit": "ms"}},
    {"t": {"period": 1e-3}, "absent": ["u"]},
    {"theta_e": {"column": 2, "wrap": 6.3, "signed_bits": 16}, "where": {"u": 1.0}},
]


def write_log(path: Path, columns: dict) -> None:
    frame = pd.DataFrame(columns)
    if path.suffix == ".parquet":
        frame.astype({name: str for name, column in columns.items() if column.dtype.kind == "c"}).to_parquet(path)
    elif path.suffix == ".mat":
        savemat(path, {name: column for name, column in columns.items() if column.dtype.kind not in "MmO"})
    elif path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            for name, column in columns.items():
                if column.dtype.kind not in "MmO":
                    file[name] = column
    elif path.suffix == ".json":
        path.write_text(frame.to_json(orient="records", default_handler=str))
    else:
        frame.to_csv(path, index=False, sep="," if path.suffix == ".csv" else "\t")


@st.composite
def logs(draw, path: Path) -> tuple[Path, bytes]:
    """A log of some kind with columns that are odd, and the text of a `[log]` table."""
    columns = {
        name: values.to_numpy() for name, values in simulate_log(count=draw(st.sampled_from([3, 70, 400, 400, 400]))).items()
    }
    with np.errstate(all="ignore"):
        for _ in range(draw(st.integers(0, 2))):
            name = draw(st.sampled_from(list(columns)))
            if columns[name].dtype.kind == "f":
                columns[name] = COLUMNS[draw(st.sampled_from(list(COLUMNS)))](columns[name])
    if draw(st.integers(0, 4)) == 0:
        old = draw(st.sampled_from(list(columns)))
        columns[draw(st.sampled_from([" ", ESC, "x" * 5000, "a b", "theta_e", "0", "Ω", "a,b"]))] = columns.pop(old)
    path = path.with_suffix(f".{draw(st.sampled_from(KINDS))}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # names that MATLAB would not take
        try:
            write_log(path, columns)
        except UnicodeEncodeError:
            reject()
    path.write_bytes(scramble_bytes(draw, path.read_bytes()))
    model = draw(st.sampled_from(TABLES))
    if model and draw(st.booleans()):
        model = mutate_tables(draw, model)
    try:
        return path, tomli_w.dumps({"log": model}).encode()
    except UnicodeEncodeError:
        return path, b""


def check_output(read, *inputs) -> str:
    """Return the line about an input; raise an error if it is no line, or took too much."""
    # of the processor's time: a crowded machine is no failure; and what waits is ended after a while
    before = sum(os.times()[:2])
    faulthandler.dump_traceback_later(10 * SECONDS, exit=True)
    output = read(*inputs)
    faulthandler.cancel_dump_traceback_later()
    assert sum(os.times()[:2]) - before < SECONDS, "took too long"
    assert 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < BYTES, "took too much memory"
    assert "allocate" not in output and "MemoryError" not in output
    assert output.isprintable() and len(output) <= 2500, output
    return output


def main(kind: str, folder: Path) -> None:
    output: dict[str, str] = {}
    size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    # that a failure of this test is no failure of the machine
    resource.setrlimit(resource.RLIMIT_AS, (size + 3 * BYTES, size + 3 * BYTES))
    warnings.simplefilter("error")
    if kind == "listed":
        for prefix, cases in (("study", STUDIES), ("log", LOGS)):
            for name, make in cases.items():
                case_folder = folder / f"{prefix} {name}"
                case_folder.mkdir()
                case_input = make(case_folder)
                if prefix == "study":
                    text = case_input if isinstance(case_input, str) else format_toml(case_input)
                    line = check_output(check_study, write_text(case_folder, "study.toml", text))
                else:
                    line = check_output(check_log, *(case_input if isinstance(case_input, tuple) else (case_input,)))
                output[f"{prefix} {name}"] = line
    else:
        path, model = folder / "study.toml", folder / "model.toml"
        generation = settings(max_examples=int(sys.argv[3]), database=None, derandomize=True, deadline=None,
                             suppress_health_check=list(HealthCheck))  # fmt: skip

        @generation
        @given(studies())
        def try_study(data):
            path.write_bytes(data)
            output[str(len(output))] = check_output(check_study, path)

        @generation
        @given(logs(folder / "log"))
        def try_log(log_input):
            log_path, model_text = log_input
            model.write_bytes(model_text)
            output[str(len(output))] = check_output(check_log, log_path, model)

        try_study() if kind == "toml" else try_log()
    (folder / "said.json").write_text(json.dumps(output))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
