"""Reading a log file into named columns: text, Parquet, MATLAB (up to 7.2, and 7.3), JSON."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false

import csv
import io
import json
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from jaxbl.errors import InputError
from jaxbl.validation import nearest

from .libraries import read_mdf, read_tdms

_KINDS = "text (CSV and the like), Parquet, MATLAB (.mat), JSON, MDF4 and TDMS can be read"


class Columns(dict[str | int, Any]):
    """Columns of a file by name, with the units that the file says, and remarks on how it was read."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.units: dict[str | int, str] = {}
        self.notes: list[str] = []


class LogFile:
    """A log file as it is being read.

    Attributes:
        path: the file.
        columns: name -> values, one-dimensional; numbers in place of names where the file has none.
        units: those that the file itself says, by column.
        notes: what was done to the log, and what is odd about it, in sentences.
        warnings: those to be said first.
        corrections: as of a record.
    """

    def __init__(self, path: Path, columns: dict[str | int, Any]):
        self.path, self.columns = path, columns
        self.units = columns.units if isinstance(columns, Columns) else {}
        self.notes = [*columns.notes] if isinstance(columns, Columns) else []
        self.warnings: list[str] = []
        self.corrections: dict[str, float] = {}

    def wrong(self, text: str) -> InputError:
        """What to raise where something is wrong with the file."""
        return InputError(f"{self.path}: {text}")

    def name(self, column: str | int, channel: str = "") -> str | int:
        """The name of a column that is given by name or number; InputError names the nearest where there is none."""
        if column in self.columns:
            return column
        names = list(self.columns)
        if isinstance(column, int):
            if column < len(names):
                return names[column]
            count = f"has {len(names)} columns, numbered 0 to {len(names) - 1}" if len(names) != 1 else "has only column 0"
            raise self.wrong(f"no column {column}: the file {count}")
        key = f"; [log] {channel} can name another" if channel else ""
        if all(isinstance(name, int) for name in names):
            raise self.wrong(
                f"no column '{column}': the file has no header; give the column's number, 0 to {len(names) - 1}"
                + (f", as [log] {channel}" if channel else "")
            )
        raise self.wrong(f"no column '{column}'; {nearest(column, map(str, names))}{key}")

    def numbers(self, column: str | int, channel: str = "") -> np.ndarray:
        """A column of finite numbers, shape (rows,); InputError names the first row, counted from 1, that holds none."""
        name = self.name(column, channel)
        given = np.asarray(self.columns[name])
        values = np.asarray(pd.to_numeric(pd.Series(given), errors="coerce"), dtype=float)
        finite = np.isfinite(values)
        if not finite.all():
            row = int(np.argmin(finite))
            cell = np.asarray(given, dtype=object)[row]
            empty = cell is None or (isinstance(cell, float) and np.isnan(cell))
            what = "empty or not a number" if empty else repr(cell)
            raise self.wrong(f"column {name!r}, data row {row + 1} is {what}; it should be a finite number")
        return values

    def same_length(self, values: np.ndarray, length: int, column: str | int) -> np.ndarray:
        """The values of a column; InputError where they are not as many as there are time stamps."""
        if len(values) != length:
            raise self.wrong(
                f"column {column!r} has {len(values)} values and the time {length}; they should be equally many"
            )
        return values


def read_log_file(path: Path) -> LogFile:
    """Read all columns of a log file; the suffix and the first bytes say which kind it is.

    Raises:
        InputError: the file is missing, empty, or of no known kind.
    """
    try:
        return LogFile(path, _columns(path))
    except FileNotFoundError:
        why = "no such file"
    except IsADirectoryError:
        why = "is a folder; a log file is needed"
    except OSError as error:
        why = f"cannot be read: {error.strerror}"
    except InputError as error:
        why = str(error)
    raise InputError(f"{path}: {why}")


def _columns(path: Path) -> dict[str | int, Any]:
    suffix = path.suffix.lower()
    with path.open("rb") as file:
        first = file.read(8)
    for mark, kind, read in ((b"TDSm", "TDMS", read_tdms), (b"MDF", "MDF", read_mdf)):
        if first.startswith(mark):
            with _reading(kind):
                return read(path)
    content = path.read_bytes()
    if not content.strip():
        raise InputError(f"is empty; {_KINDS}")
    if content.startswith(b"PAR1"):
        with _reading("Parquet"):
            frame = pd.read_parquet(path)
        return {str(name): frame[name].to_numpy() for name in frame.columns}
    # an HDF5 file begins so; MATLAB 7.3 puts half a kilobyte of text before that
    if b"\x89HDF" in (content[:4], content[512:516]):
        return _hdf5(path)
    if suffix == ".mat":
        return _matlab(path)
    if b"\0" in content:
        raise InputError(f"is not a log of a known kind; {_KINDS}")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")  # a degree sign in a header of an old program
    return _json(text) if suffix == ".json" or text.lstrip()[0] in "[{" else _text(text)


@contextmanager
def _reading(kind: str) -> Iterator[None]:
    """Errors of the libraries that read files, which are of many classes, in one line."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        first = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"cannot be read as {kind}: {first}") from None


_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eEdD][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE)
_NO_ROWS = "has a header and no rows; a log needs rows of numbers"


def _text(text: str) -> dict[str | int, Any]:
    """Comma, semicolon, tab or white space between columns; a header or none; # before remarks."""
    lines = text.splitlines()
    if (block := _behind_remarks(lines)) is not None:
        return block
    skipped = next((i for i, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")), None)
    if skipped is None:
        raise InputError("holds only remarks; rows of numbers are needed")
    first = lines[skipped]
    # a comma between digits may be a decimal one, but not where nothing else separates
    separator = next((c for c in ";\t," if c in first), r"\s+")
    cells = _cells(first, separator)
    header = not any(_NUMBER.fullmatch(cell) for cell in cells)
    second = next((line for line in lines[skipped + 1 :] if line.strip()), "")
    if header and len(_cells(second, separator)) == len(cells) + 1 and second.rstrip(" ").endswith(separator):
        cells = [*cells, ""]  # a separator at the end of the rows
    sample = "\n".join(lines[skipped + header : skipped + header + 50])
    decimal = "," if separator != "," and re.search(r"\d,\d", sample) and not re.search(r"\d\.\d", sample) else "."
    with _reading("a table"), warnings.catch_warnings(action="error", category=pd.errors.ParserWarning):
        try:
            frame = pd.read_csv(
                io.StringIO(text),
                sep=separator,
                header=None,
                names=_names(cells) if header else None,
                skiprows=skipped + header,
                comment="#",
                skipinitialspace=True,
                decimal=decimal,
                index_col=False,
                low_memory=False,
            )
        except pd.errors.EmptyDataError:
            raise InputError(_NO_ROWS) from None
        except pd.errors.ParserWarning:
            raise InputError(f"rows have more columns than the header; they should have {len(cells)}") from None
    if not len(frame):
        raise InputError(_NO_ROWS)
    return {name if isinstance(name, str) else int(name): frame[name].to_numpy() for name in frame.columns}


_REMARKS = 100
"""Lines that a program may write before the rows: exports of drive software and of scopes have ten to thirty."""


def _behind_remarks(lines: list[str]) -> Columns | None:
    """Rows behind a block of remarks, as EPOS Studio and TwinCAT Scope write them; None where there is no such block.

    The lines just before the rows hold names and, below, units; TwinCAT's the word Name over each column of times.
    """
    start = next((i for i in range(min(len(lines) - 2, _REMARKS)) if _is_row(lines[i]) and _is_row(lines[i + 1])), 0)
    head = [line for line in lines[:start] if line.strip() and not line.lstrip().startswith("#")]
    if len(head) < 2:
        return None
    separator = next((c for c in ";\t," if c in lines[start]), None)
    if separator is None:
        return None
    count = len(_cells(lines[start], separator))
    known = any(mark in line for line in head for mark in ("EPOS Studio", "Starttime of export"))
    if not known and len(_cells(head[0], separator)) == count:
        return None
    rows = [line for line in lines[start:] if line.strip() and line.strip() != "EOF"]
    sample = "\n".join(rows[:50])
    decimal = "," if separator != "," and re.search(r"\d,\d", sample) and not re.search(r"\d\.\d", sample) else "."
    with _reading("a table"):
        frame = pd.read_csv(
            io.StringIO("\n".join(rows)), sep=separator, header=None, decimal=decimal, skipinitialspace=True, index_col=False
        )
    titles = [_cells(line, separator) for line in head]
    titles = [cells[:count] for cells in titles if len(cells) >= count]
    scope = [cells for cells in titles if cells[0] == "Name"]
    names = scope[-1] if scope else titles[-2] if len(titles) > 1 else titles[-1] if titles else []
    units = titles[-1] if len(titles) > 1 and not scope else []
    return _together([frame[i].to_numpy() for i in range(count)], names, units)


def _is_row(line: str) -> bool:
    """Whether a line holds two numbers or more, and nothing else."""
    separator = next((c for c in ";\t," if c in line), None)
    cells = [] if separator is None else _cells(line, separator)
    cells = cells[:-1] if cells and not cells[-1] else cells
    return len(cells) > 1 and all(_NUMBER.fullmatch(cell) for cell in cells)


def _together(values: list[np.ndarray], names: list[str], units: list[str]) -> Columns:
    """Columns with their names; those with times of their own at the times of the first."""
    found, times = Columns(), values[0]
    own = times
    for i, column in enumerate(values):
        name = names[i] if i < len(names) else ""
        if i == 0 or name == "Name":
            own = column
            if i:
                continue
            name = "t"
        elif not np.array_equal(own, times, equal_nan=True):
            inside = np.isfinite(own) & np.isfinite(column)
            column = np.interp(times, own[inside], column[inside])
            found.notes.append(f"'{name}' has times of its own; its values are interpolated to the others' times.")
        name = name or f"column {i}"
        found[name] = column
        if i < len(units) and units[i]:
            found.units[name] = units[i]
    if found.units:
        said = ", ".join(f"{name} {unit}" for name, unit in found.units.items())
        found.notes.append(f"Units by the file itself, which [log] has to repeat: {said}.")
    return found


def _cells(line: str, separator: str) -> list[str]:
    cells = next(csv.reader([line], delimiter=separator), []) if len(separator) == 1 else line.split()
    return [cell.strip() for cell in cells]


def _names(cells: list[str]) -> list[str]:
    if cells and not cells[-1]:
        cells = [*cells[:-1], f"column {len(cells) - 1}"]  # a separator at the end of the lines
    for i, cell in enumerate(cells):
        if cell in cells[:i]:
            raise InputError(f"two columns are called '{cell}'; names should differ")
    return cells


def _json(text: str) -> dict[str | int, Any]:
    """An array of objects, an object that holds one, or an object of arrays."""
    try:
        data = json.loads(text)
    except ValueError as error:
        raise InputError(f"is not valid JSON: {error}") from None
    if isinstance(data, dict):
        rows = [value for value in data.values() if isinstance(value, list) and value and isinstance(value[0], dict)]
        if len(rows) != 1:
            columns: dict[str | int, Any] = {name: _plain(value) for name, value in data.items() if isinstance(value, list)}
            if not columns:
                raise InputError("holds no array of rows or of numbers; a log needs one")
            return columns
        data = rows[0]
    if not data or not all(isinstance(row, dict) for row in data):
        raise InputError("should hold an array of objects, one a row")
    names = dict.fromkeys(name for row in data for name in row)
    return {name: _plain([row.get(name) for row in data]) for name in names}


def _plain(values: list[Any]) -> np.ndarray:
    return np.asarray(pd.Series(values, dtype=object).infer_objects())


def _matlab(path: Path) -> dict[str | int, Any]:
    """Vectors, columns of matrices, and fields of structures (`name.field`)."""
    from scipy.io import loadmat

    with _reading("a MATLAB file"):
        data = loadmat(path, squeeze_me=True, struct_as_record=True)
    columns: dict[str | int, Any] = {}
    for name, value in data.items():
        if not name.startswith("__"):
            _add(columns, name, value)
    return _some(columns)


def _add(columns: dict[str | int, Any], name: str, value: Any) -> None:
    value = np.asarray(value)
    if value.dtype.names:
        if value.ndim == 0:
            for field in value.dtype.names:
                _add(columns, f"{name}.{field}", value[field].item() if value[field].dtype == object else value[field])
        return
    if value.dtype.kind not in "biuf":
        return
    if value.ndim == 1:
        columns[name] = value
    elif value.ndim == 2:
        # samples run along the longer side
        for i, column in enumerate(value.T if value.shape[0] >= value.shape[1] else value):
            columns[f"{name}[{i}]"] = column


def _hdf5(path: Path) -> dict[str | int, Any]:
    """MATLAB 7.3, or any HDF5 file of vectors."""
    import h5py

    columns: dict[str | int, Any] = {}

    def visit(name: str, item: Any) -> None:
        named = isinstance(item, h5py.Dataset) and not name.startswith("#")
        if named and item.attrs.get("MATLAB_class") != b"char" and item.dtype.kind in "biuf":
            _add(columns, name.replace("/", "."), np.squeeze(item[()]))

    with _reading("a MATLAB file"), h5py.File(path) as file:
        file.visititems(visit)
    return _some(columns)


def _some(columns: dict[str | int, Any]) -> dict[str | int, Any]:
    if not columns:
        raise InputError("holds no vectors of numbers; a log needs them")
    return columns
