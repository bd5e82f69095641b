"""Logs as people have them, with the truth beside each: is any read differently without a remark?

    python benchmarks/misread.py --seed 1 --count 300

A log is drawn, written in one of many forms (separators, decimal commas, encodings, units, stamps, gaps, containers),
and read by `read_record`. Allowed are: the same numbers; other numbers with a remark; a refusal of one line. Counted are:
numbers that differ without a remark, tracebacks, readings of more than 20 s or 3 GB.
"""

import argparse
import json
import resource
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import h5py
import numpy as np
import pandas as pd
from scipy.io import savemat

from jaxbl.errors import InputError
from jaxbl.records import read_record

RATIO = 10.0
CHANNELS = ("u", "theta_e", "theta_s")
SECONDS, BYTES = 20.0, 3 * 2**30
_TOLERANCE = 2e-3
"""Of a channel's range: what resampling of jittering stamps and six digits leave."""


class Form(NamedTuple):
    """How a log is written.

    Attributes:
        frame: its columns as they are written, numbers or text.
        log: the `[log]` table that says so.
        words: names of the changes.
    """

    frame: pd.DataFrame
    log: dict[str, Any]
    words: list[str]


def draw_truth(random: np.random.Generator) -> pd.DataFrame:
    """Draw a motion of a geared drive: t, u, theta_e, theta_s in s, N m, rad."""
    count, period = int(random.integers(200, 2000)), float(random.choice([5e-4, 1e-3, 2e-3, 1e-2]))
    t = period * np.arange(count)
    frequency = random.uniform(0.1, 0.6, 3) / (50 * period) * 10 ** random.uniform(-1.0, 0.0)
    size, phase = random.uniform(0.5, 3.0, 3), random.uniform(0.0, 6.28, 3)
    angle = 2 * np.pi * frequency * t[:, None] + phase
    position = (size * np.sin(angle)).sum(axis=1)
    speed = (size * 2 * np.pi * frequency * np.cos(angle)).sum(axis=1)
    acceleration = (-size * (2 * np.pi * frequency) ** 2 * np.sin(angle)).sum(axis=1)
    scale = 1.0 / (acceleration.std() + 1e-9)
    u = 0.3 * scale * acceleration + 0.1 * speed / speed.std() + 0.05 * np.sign(speed)
    return pd.DataFrame({"t": t, "u": u, "theta_e": position, "theta_s": position / RATIO})


# ---- what columns hold ----


def _keep(form: Form, random: np.random.Generator) -> Form:
    return form


def _in_degrees(form: Form, random: np.random.Generator) -> Form:
    if "theta_e" not in form.frame or "theta_e" in form.log:
        return form
    frame = form.frame.assign(theta_e=np.degrees(form.frame["theta_e"]))
    return Form(frame, form.log | {"theta_e": {"unit": "deg"}}, [*form.words, "degrees"])


def _in_counts(form: Form, random: np.random.Generator) -> Form:
    if "theta_e" not in form.frame or "theta_e" in form.log:
        return form
    counts = np.round(form.frame["theta_e"] / (2 * np.pi) * 65536).astype(int)
    bits = random.choice(["plain", "wrapped", "unsigned words"])
    table: dict[str, Any] = {"unit": "counts", "counts_per_turn": 65536}
    if bits == "wrapped":
        counts, table = counts % 65536, table | {"wrap": 65536}
    elif bits == "unsigned words":
        counts, table = counts % 2**20, table | {"signed_bits": 20}
    return Form(form.frame.assign(theta_e=counts), form.log | {"theta_e": table}, [*form.words, f"counts, {bits}"])


def _renamed(form: Form, random: np.random.Generator) -> Form:
    names = {"u": "Torque [Nm]", "theta_e": "pos motor / rad", "theta_s": "Load;position", "t": "Zeit (s)"}
    log = {key: {"column": name} | dict(form.log.get(key, {})) for key, name in names.items()}
    return Form(form.frame.rename(columns=names), form.log | log, [*form.words, "names"])


def _late_start(form: Form, random: np.random.Generator) -> Form:
    return Form(form.frame.assign(t=form.frame["t"] + random.uniform(1.0, 1e5)), form.log, [*form.words, "late start"])


def _in_milliseconds(form: Form, random: np.random.Generator) -> Form:
    unit, size = [("ms", 1e3), ("us", 1e6), ("ns", 1e9)][random.integers(3)]
    t = np.round(form.frame["t"] * size * 1000) / 1000
    first = 0 if unit != "ns" or random.integers(2) else 1_790_000_000_000_000_000
    stamps = (np.round(t).astype(np.int64) + first) if unit == "ns" else t
    return Form(form.frame.assign(t=stamps), form.log | {"t": {"unit": unit}}, [*form.words, f"stamps in {unit}"])


def _dates(form: Form, random: np.random.Generator) -> Form:
    start = pd.Timestamp(f"2026-0{random.integers(1, 9)}-1{random.integers(0, 9)} 2{random.integers(0, 4)}:59:58")
    stamps = start + pd.to_timedelta(np.round(form.frame["t"] * 1e6), unit="us")
    style = str(random.choice(["%Y-%m-%dT%H:%M:%S.%fZ", "%Y-%m-%d %H:%M:%S.%f", "%H:%M:%S.%f", "%Y/%m/%d %H:%M:%S.%f"]))
    return Form(form.frame.assign(t=pd.DatetimeIndex(stamps).strftime(style)), form.log, [*form.words, f"dates {style}"])


def _speed_in_place(form: Form, random: np.random.Generator) -> Form:
    if "theta_e" not in form.frame or "theta_e" in form.log:
        return form
    speed = np.gradient(form.frame["theta_e"], form.frame["t"], edge_order=2)
    frame = form.frame.drop(columns="theta_e").assign(omega=speed * 60 / (2 * np.pi))
    return Form(frame, form.log | {"omega_e": {"column": "omega", "unit": "rpm"}}, [*form.words, "speed"])


def _other_columns(form: Form, random: np.random.Generator) -> Form:
    frame = form.frame.copy()
    frame.insert(int(random.integers(0, 4)), "status", random.choice(["RUN", "ok", "Störung"], len(frame)))
    frame["enabled"] = random.integers(0, 2, len(frame)).astype(bool)
    return Form(frame, form.log, [*form.words, "other columns"])


def _index(form: Form, random: np.random.Generator) -> Form:
    frame = form.frame.copy()
    frame.insert(0, "", np.arange(len(frame)))
    return Form(frame, form.log, [*form.words, "index"])


def _slow_channel(form: Form, random: np.random.Generator) -> Form:
    every, frame = int(random.integers(2, 5)), form.frame.astype({"theta_s": object})
    frame.loc[frame.index % every != 0, "theta_s"] = random.choice(np.array(["", "NaN", "nan"], dtype=object))
    return Form(frame, form.log, [*form.words, "a channel with gaps"])


def _bad_cell(form: Form, random: np.random.Generator) -> Form:
    name, cell = random.choice(CHANNELS), random.choice(["#N/A", "-", "null", "1.2.3", "--", "overflow", "1e400", "0x1F"])
    if name not in form.frame:
        return form
    frame = form.frame.astype({name: object})
    frame.loc[int(random.integers(0, len(frame))), name] = cell
    return Form(frame, form.log, [*form.words, f"cell {cell}"])


def _lost_rows(form: Form, random: np.random.Generator) -> Form:
    start, count = int(random.integers(20, len(form.frame) - 60)), int(random.choice([1, 2, 5, 20]))
    return Form(form.frame.drop(index=range(start, start + count)), form.log, [*form.words, f"{count} rows lost"])


def _repeated_rows(form: Form, random: np.random.Generator) -> Form:
    row = int(random.integers(1, len(form.frame) - 1))
    frame = pd.concat([form.frame[:row], form.frame[row - 1 : row], form.frame[row:]], ignore_index=True)
    return Form(frame, form.log, [*form.words, "a row twice"])


def _swapped_rows(form: Form, random: np.random.Generator) -> Form:
    order, row = np.arange(len(form.frame)), int(random.integers(1, len(form.frame) - 1))
    order[[row, row - 1]] = order[[row - 1, row]]
    return Form(form.frame.iloc[order], form.log, [*form.words, "rows swapped"])


def _jitter(form: Form, random: np.random.Generator) -> Form:
    t = form.frame["t"].to_numpy()
    if t.dtype.kind != "f" or "t" in form.log:
        return form
    period = t[1] - t[0]
    return Form(form.frame.assign(t=np.round(t, 6 if period > 1e-3 else 7)), form.log, [*form.words, "rounded stamps"])


CONTENT: list[Callable[[Form, np.random.Generator], Form]] = [
    _keep, _keep, _in_degrees, _in_counts, _late_start, _speed_in_place, _other_columns, _index,
]  # fmt: skip
CLOCKS = [_keep, _keep, _in_milliseconds, _dates, _jitter]
FAULTS = [_keep, _keep, _keep, _slow_channel, _bad_cell, _lost_rows, _repeated_rows, _swapped_rows]


# ---- how they are written ----


def _write_text(form: Form, path: Path, random: np.random.Generator) -> list[str]:
    """Write a table of text."""
    separator = str(random.choice([",", ";", "\t", " "]))
    names = list(form.frame.columns)
    if separator == " " and any(" " in str(name) or name == "" for name in names):
        separator = "\t"
    if form.frame.astype(str).apply(lambda column: column.str.contains(" ").any()).any() and separator == " ":
        separator = ";"
    comma = separator in ";\t" and bool(random.integers(2))
    digits = str(random.choice(["%.9g", "%.12f", "%.8e", "%+.10E", "%.17g"]))
    thousands = bool(random.integers(8) == 0)

    def format_cell(value: Any) -> str:
        if isinstance(value, (bool, np.bool_, str)):
            return str(value)
        if isinstance(value, (int, np.integer)):
            text = f"{value:,}" if thousands else str(value)
        else:
            text = f"{value:,.9f}" if thousands else digits % value
        if thousands:
            return f'"{text}"' if separator == "," else text
        return text.replace(".", ",") if comma else text

    quote = separator != " " and bool(random.integers(6) == 0)

    def join(cells: list[str]) -> str:
        cells = [cell if not quote or cell.startswith('"') else f'"{cell}"' for cell in cells]
        return separator.join(f'"{cell}"' if separator in cell and not cell.startswith('"') else cell for cell in cells)

    header = join([str(name) for name in names])
    rows = [join([format_cell(value) for value in row]) for row in form.frame.itertuples(index=False)]
    words = [repr(separator), *["decimal comma"] * comma, *["thousands"] * thousands, *["quotes"] * quote, digits]
    top = [header]
    match random.integers(8):
        case 0:
            top, words = ["# recorded by hand", f"# {len(rows)} rows", *top], [*words, "comments"]
        case 1:
            units = {"t": "s", "u": "Nm", "theta_e": "rad", "theta_s": "rad"}
            top, words = [*top, join([units.get(str(name), "-") for name in names])], [*words, "row of units"]
        case 2:
            rows[len(rows) // 2 : len(rows) // 2] = [header]
            words = [*words, "header again"]
        case 3:
            rows, words = [row + separator for row in rows], [*words, "separator at the end"]
        case 4:
            rows, words = [*rows, "", ""], [*words, "blank lines"]
    end = str(random.choice(["\n", "\r\n", "\r"]))
    encoding = str(random.choice(["utf-8", "utf-8", "utf-8-sig", "utf-16", "latin-1"]))
    text = end.join([*top, *rows]) + (end if random.integers(4) else "")
    path.write_bytes(text.encode(encoding))
    return [*words, repr(end), encoding]


def _numeric(form: Form) -> dict[str, np.ndarray]:
    return {str(name) or "index": column.to_numpy() for name, column in form.frame.items() if column.dtype.kind in "fiub"}


def _write_parquet(form: Form, path: Path, random: np.random.Generator) -> list[str]:
    frame, word = form.frame.copy(), str(random.choice(["as it is", "float32", "text", "nullable", "decimal"]))
    for name in set(CHANNELS) & set(frame.columns):
        if frame[name].dtype.kind != "f" or word == "as it is":
            continue
        values: Any = frame[name]
        if word == "float32":
            values = values.astype(np.float32)
        elif word == "text":
            values = values.map(repr)
        elif word == "nullable":
            values = values.astype("Float64")
        else:
            from decimal import Decimal

            values = values.map(lambda value: Decimal(f"{value:.9f}"))
        frame[name] = values
    frame.columns = [str(name) or "index" for name in frame.columns]
    for name in frame:
        if frame[name].dtype == object and word != "decimal":
            frame[name] = frame[name].astype(str)
    frame.to_parquet(path, index=bool(random.integers(2)))
    return ["parquet", word]


def _write_json(form: Form, path: Path, random: np.random.Generator) -> list[str]:
    style = str(random.choice(["records", "list", "lines"]))
    frame = form.frame.astype(object)
    if style == "list":
        path.write_text(json.dumps(frame.to_dict("list"), default=float))
    elif style == "lines":
        path.write_text("\n".join(json.dumps(row, default=float) for row in frame.to_dict("records")))
    else:
        path.write_text(json.dumps(frame.to_dict("records"), default=float))
    return ["json", style]


def _write_mat(form: Form, path: Path, random: np.random.Generator) -> list[str]:
    word = str(random.choice(["row", "column"]))
    savemat(path, _numeric(form) | {"note": "a test"}, oned_as=word)
    return ["mat", word]


def _write_hdf5(form: Form, path: Path, random: np.random.Generator) -> list[str]:
    big = bool(random.integers(2))
    with h5py.File(path, "w") as file:
        for name, values in _numeric(form).items():
            kind = values.dtype.newbyteorder(">") if big and values.dtype.kind in "fiu" else values.dtype
            file.create_dataset(name.replace("/", "|"), data=values.astype(kind), compression="gzip")
    return ["hdf5", *["big-endian"] * big]


WRITERS = {".csv": _write_text, ".txt": _write_text, ".parquet": _write_parquet, ".json": _write_json, ".mat": _write_mat,
           ".h5": _write_hdf5}  # fmt: skip
CHANCES = [0.4, 0.2, 0.15, 0.1, 0.1, 0.05]


# ---- the comparison ----


class Outcome(NamedTuple):
    """What became of a log: "same", "refused", "remark", or a fault; and the words that describe it."""

    kind: str
    words: list[str]
    said: str = ""


def try_log(seed: int, number: int, folder: Path) -> Outcome:
    """Draw, write and read a log."""
    random = np.random.default_rng([seed, number])
    truth = draw_truth(random)
    form = Form(truth, {}, [])
    contents = [CONTENT[i] for i in random.choice(len(CONTENT), 2, replace=False)]
    for change in (*contents, CLOCKS[random.integers(len(CLOCKS))], FAULTS[random.integers(len(FAULTS))]):
        form = change(form, random)
    if random.integers(4) == 0 and not any("speed" in word for word in form.words):
        form = _renamed(form, random)
    suffix = str(random.choice(list(WRITERS), p=CHANCES))
    if suffix in (".mat", ".h5") and len(_numeric(form)) < len(form.frame.columns):
        suffix = ".csv"  # these have no dates, and numbers in all rows
    elif suffix in (".parquet", ".json"):
        form = form._replace(frame=form.frame.map(lambda cell: None if cell in ("", "NaN", "nan") else cell))
    path = folder / f"{number}{suffix}"
    words = [*form.words, *WRITERS[suffix](form, path, random)]
    start = time.process_time()
    try:
        record = read_record(path, form.log, gear_ratio=RATIO)
    except InputError as error:
        line = str(error)
        return Outcome("refused" if "\n" not in line else "lines", words, line.replace(f"{folder}/", ""))
    except Exception:
        return Outcome("traceback", words, traceback.format_exc())
    if time.process_time() - start > SECONDS:
        return Outcome("slow", words)
    if 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss > BYTES:
        return Outcome("memory", words)
    remarks = [*record.warnings, *(note for note in record.notes if not note.startswith("Time is counted from"))]
    return Outcome(*_compare(record, truth, remarks, words))


def _compare(record: Any, truth: pd.DataFrame, remarks: list[str], words: list[str]) -> tuple[str, list[str], str]:
    time_of_record = record.time + (record.start if abs(record.start) < truth["t"].iloc[-1] else 0.0)
    read = {"u": record.torque, "theta_e": record.positions.get("motor"), "theta_s": record.positions.get("load")}
    differing = []
    inside = (time_of_record >= 0.0) & (time_of_record <= truth["t"].iloc[-1])
    for segment in record.segments:
        inside[segment.start : segment.start + 2] = inside[max(segment.stop - 2, 0) : segment.stop] = False
    for name, values in read.items():
        if values is None:
            differing.append(f"{name} is missing")
            continue
        expected = np.interp(time_of_record, truth["t"], truth[name])
        error = (values - expected)[inside]
        if "speed" in words and name == "theta_e":
            error = error - error.mean()
        limit = _TOLERANCE + (0.02 if "speed" in words else 0.0) + (2e-2 if "rounded stamps" in words else 0.0)
        if name == "u":
            # held between stamps, and a step where friction turns over
            error, limit = np.sort(np.abs(error))[: int(0.97 * len(error))], 0.05
        if len(error) and np.abs(error).max() > limit * np.ptp(truth[name]):
            differing.append(f"{name} differs by {np.abs(error).max() / np.ptp(truth[name]):.2g} of its range")
    if abs(record.sample_period / (truth["t"][1] - truth["t"][0]) - 1.0) > 0.01:
        differing.append(f"the period is {record.sample_period:g}")
    if not differing:
        return "same", words, "; ".join(remarks)
    return ("remark" if remarks else "wrong"), words, "; ".join([*differing, *remarks])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--show", action="store_true", help="print what was said of each log")
    asked = parser.parse_args()
    warnings.simplefilter("error")
    warnings.filterwarnings("ignore", module="scipy.io")
    counts: Counter[str] = Counter()
    with TemporaryDirectory() as folder:
        for number in range(asked.first, asked.first + asked.count):
            outcome = try_log(asked.seed, number, Path(folder))
            counts[outcome.kind] += 1
            if asked.show or outcome.kind not in ("same", "refused", "remark"):
                print(f"{number} {outcome.kind}: {', '.join(outcome.words)}: {outcome.said}")
    print(", ".join(f"{kind}: {count}" for kind, count in counts.most_common()))


if __name__ == "__main__":
    main()
