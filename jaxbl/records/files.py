"""Read a log file into named columns: text, Parquet, MATLAB (up to 7.2, and 7.3), JSON.

Only the selected columns stay in memory; any other is loaded when it is used.
"""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false

import csv
import io
import itertools
import json
import math
import re
import warnings
from codecs import BOM_UTF8, BOM_UTF16_BE, BOM_UTF16_LE, getincrementaldecoder
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from pandas.api.types import is_numeric_dtype

from jaxbl.errors import InputError, escape_unprintable
from jaxbl.registry import Registry
from jaxbl.validation import LARGEST, check_file, explain_missing_file, suggest_word
from jaxbl.workers import check_cost

from .libraries import (
    Column,
    ColumnName,
    Columns,
    Selection,
    name_members,
    read_at,
    read_bag,
    read_mcap,
    read_mdf,
    read_tdms,
)

_READABLE_KINDS = "text (CSV and the like), Parquet, MATLAB (.mat), JSON, MDF4, TDMS, MCAP and ROS bags can be read"
_SUFFIXES = (
    ".csv", ".txt", ".tsv", ".dat", ".parquet", ".mat", ".h5", ".hdf5", ".json", ".jsonl", ".mf4", ".mdf", ".tdms", ".mcap",
    ".bag",
)  # fmt: skip
"""Suffixes of log files that this package reads by itself."""


def _check_reader(name: str, reader: Any) -> None:
    if f".{name}" in _SUFFIXES:
        raise ValueError(f"files that end in .{name} are read by jaxbl itself")
    if not re.fullmatch(r"[a-z0-9_-]+", name):
        raise ValueError("its name should be the ending of its files, in small letters and without the dot")
    if not callable(reader):
        raise TypeError("should be a function of a file's path")


READERS = Registry("jaxbl.readers", _check_reader)
"""Suffix of a file without its dot -> function of its path that returns its columns by name."""

_HEAD_BYTES = 1 << 18
"""Bytes from which the kind of a file and the format of its rows are detected: hundreds of rows."""
_BAG_METADATA = "metadata.yaml"
"""File in the folder of a ROS 2 bag."""
_CHUNK_ROWS = 100_000
"""Rows of text that are in memory with all their columns."""
_MAX_COLUMNS = 10_000
"""Columns of a text file: exports of whole machines have hundreds."""
_NANOSECOND, _EXACT = 1e-9, 2**53
"""Whole numbers above it are rounded as float64: stamps in ns since 1970 to 256 ns."""
_VALUE_BYTES = 40.0
"""Bytes of a value that is loaded: four columns of it as they are in the file, and as float64."""
_MAX_WHOLE_BYTES = 128_000_000
"""Bytes of a file that is read at once, JSON and exports with remarks; Python takes ten times as many."""
MAX_LINE_BYTES = 1 << 20
"""Bytes of a line of text: ten thousand numbers of full length have a fifth of it."""


class LogFile:
    """A log file that is being read.

    Attributes:
        path: the file.
        columns: name -> values, one-dimensional; numbers in place of names if the file has none.
        units: units that the file itself gives, by column.
        notes: sentences on changes to the log, and on its oddities.
        warnings: sentences to be said first.
        corrections, contradiction: the attributes of a record with these names.
        date: that times are counted from, ns, where stamps are dates or times.
    """

    def __init__(self, path: Path, columns: Columns):
        self.path, self.columns = path, columns
        self.units, self.notes = columns.units, [*columns.notes, *columns.describe_unread()]
        self.warnings: list[str] = []
        self.corrections: dict[str, float] = {}
        self.contradiction = ""
        self.date: int | None = None

    def note(self, sentence: str) -> None:
        """Add a sentence on a change to the log, or on its oddities."""
        self.notes.append(sentence)

    def warn(self, sentence: str) -> None:
        """Add a sentence to be said first."""
        self.warnings.append(sentence)

    def error(self, text: str) -> InputError:
        """Return the error to be raised for a fault of the file."""
        return InputError(f"{self.path}: {text}")

    def find_column(self, column: ColumnName, channel: str = "") -> ColumnName:
        """Return the name of a column, by its name or number.

        Raises:
            InputError: there is no such column; the message names the most similar one.
        """
        if column in self.columns:
            return column
        # columns have their unprintable characters escaped, as messages spell them
        if isinstance(column, str) and escape_unprintable(column) in self.columns:
            return escape_unprintable(column)
        names = list(self.columns)
        if isinstance(column, int):
            if column < len(names):
                return names[column]
            count = f"has {len(names)} columns, numbered 0 to {len(names) - 1}" if len(names) != 1 else "has only column 0"
            raise self.error(f"no column {column}: the file {count}")
        if all(isinstance(name, int) for name in names):
            raise self.error(
                f"no column '{column}': the file has no header; give the column's number, 0 to {len(names) - 1}"
                + (f", as [log] {channel}" if channel else "")
            )
        key = f"; [log] {channel} can name another, and 'jaxbl inspect LOG --write NEW.toml' guesses all" if channel else ""
        unread = " ".join(["", *self.columns.describe_unread()])
        raise self.error(f"no column '{column}'; {suggest_word(column, map(str, names))}{key}{unread and '.' + unread}")

    def count_values(self, name: ColumnName) -> int:
        """Count the values of a column without loading it; InputError if there are too many."""
        count = len(self.columns[name])
        check_cost(f"{self.path}: column {name!r} of {count} values", _VALUE_BYTES * count, "cut the log into parts")
        return count

    def load_values(self, name: ColumnName) -> np.ndarray:
        """Load a column as it is in the file, shape (rows,); InputError if it is too long or cannot be read."""
        self.count_values(name)
        with name_file_in_errors(self.path), _report_errors(f"column {name!r}"):
            return np.asarray(self.columns[name])

    def load_seconds(self, column: ColumnName, unit: float, channel: str = "") -> np.ndarray:
        """Load a column of time stamps, s, shape (rows,); dates are counted from the first one.

        `unit` is the unit of stamps that are numbers, s. Errors are those of :meth:`load_numbers`.
        """
        name = self.find_column(column, channel)
        stamps = self.load_values(name)
        if stamps.dtype.kind not in "biufcMm":
            # a decimal comma; hours, minutes and seconds are those of any day
            texts = pd.Series(stamps).astype(str).str.replace(",", ".")
            if pd.to_numeric(texts, errors="coerce").isna().all() and texts.str.contains(r"\d[:/-]\d").any():
                stamps = pd.to_datetime(texts, errors="coerce", format="mixed", utc=True).dt.tz_convert(None).to_numpy()
        if stamps.dtype.kind in "iu" and unit == _NANOSECOND and stamps.max(initial=0) > _EXACT:
            stamps, unit = stamps.astype("M8[ns]"), 1.0
        if stamps.dtype.kind not in "Mm":
            return self.load_numbers(column, channel) * unit
        if unit != 1.0:
            raise self.error(f"column {name!r} holds dates or times, which have their own unit; remove [log] t.unit")
        if np.isnat(stamps).any():
            row = np.argmax(np.isnat(stamps)) + 1
            raise self.error(f"column {name!r}, data row {row} is no time, or empty")
        if stamps.dtype.kind == "M" and len(stamps):
            self.note(f"Time is counted from {np.datetime_as_string(stamps[0])}.")
        # whole nanoseconds: seconds since 1970 are rounded to tenths of a microsecond
        nanoseconds = stamps.astype(f"{stamps.dtype.kind}8[ns]").astype(np.int64)
        self.date = int(nanoseconds[0]) if len(stamps) else None
        return 1e-9 * (nanoseconds - nanoseconds[:1])

    def load_numbers(self, column: ColumnName, channel: str = "", rows: np.ndarray | None = None) -> np.ndarray:
        """Load a column of finite numbers, or some `rows` of it, shape (rows,).

        Raises:
            InputError: a row, counted from 1, holds no finite number.
        """
        name = self.find_column(column, channel)
        cells = self.load_values(name)
        rows = np.arange(len(cells)) if rows is None else rows
        cells = cells[rows]
        if cells.dtype.kind in "cMm":
            kind = "complex numbers" if cells.dtype.kind == "c" else "dates or times"
            raise self.error(f"column {name!r} holds {kind}; it should hold real numbers")
        values = np.asarray(pd.to_numeric(pd.Series(cells), errors="coerce"), dtype=float)
        is_finite = np.abs(values) <= LARGEST
        if not is_finite.all():
            row = np.argmin(is_finite)
            cell, place = np.asarray(cells, dtype=object)[row], f"column {name!r}, data row {rows[row] + 1} is"
            if np.isfinite(values[row]):
                raise self.error(f"{place} {values[row]:g}; a reading should be below {LARGEST:g}")
            # of a cell that holds a list pandas says it element by element
            fault = "empty or not a number" if pd.isna(cell) is True else repr(cell)
            raise self.error(f"{place} {fault}; it should be a finite number, as 1234.5")
        return values

    def check_length(self, name: ColumnName, length: int) -> None:
        """Refuse a column with another number of values than there are time stamps."""
        if (count := self.count_values(name)) != length:
            raise self.error(f"column {name!r} has {count} values and the time {length}; they should be equally many")


def is_log(path: Path) -> bool:
    """Return True if a file, or the folder of a ROS 2 bag, is a log by its name."""
    return (path / _BAG_METADATA).is_file() or (path.is_file() and path.suffix.lower() in log_suffixes())


def log_suffixes() -> tuple[str, ...]:
    """Return the suffixes of log files, with those of installed readers."""
    return (*_SUFFIXES, *(f".{name}" for name in READERS))


def read_log_file(path: Path, selection: Selection = ()) -> LogFile:
    """Read columns of a log file. Suffix and first bytes tell its kind.

    Args:
        path: the file, or the folder of a ROS 2 bag.
        selection: names, or numbers from 0, of the columns that will be used; all if left out. Others are listed, too.

    Raises:
        InputError: the file is missing, empty, or of no known kind.
    """
    with name_file_in_errors(path):
        check_file(path)
        try:
            columns = _read_columns(path, selection)
        except IsADirectoryError:
            raise InputError("is a folder; a log file is needed") from None
        printable_columns = {
            escape_unprintable(name) if isinstance(name, str) else name: values for name, values in columns.items()
        }
        columns.clear()
        columns.update(printable_columns)
        return LogFile(path, columns)


@contextmanager
def name_file_in_errors(path: Path | str, remedy: str = "check its permissions") -> Iterator[None]:
    """Begin an InputError with the name of a file; make one of it that the file is missing or cannot be read."""
    try:
        yield
        return
    except FileNotFoundError:
        fault = explain_missing_file(Path(path), log_suffixes())
    except OSError as error:
        fault = f"cannot be read: {error.strerror or error}; {remedy}"
    except InputError as error:
        fault = str(error)
    raise InputError(f"{path}: {fault}")


def _read_columns(path: Path, selection: Selection) -> Columns:
    suffix = path.suffix.lower()
    if (path / _BAG_METADATA).is_file():
        with _report_errors("a ROS bag"):
            return read_bag(path, selection)
    if suffix not in _SUFFIXES and suffix[1:] in READERS:
        return _read_with_installed_reader(path, suffix[1:])
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
        is_complete = not file.read(1)
    if not head.removeprefix(BOM_UTF8).strip():
        raise InputError(f"is empty; {_READABLE_KINDS}")
    for start, ending, kind, read in _BINARY_READERS:
        if re.match(start, head, re.DOTALL) and suffix.endswith(ending):
            with _report_errors(kind):
                return read(path, selection)
    for first_bytes, remedy in _REMEDIES.items():
        if head.startswith(first_bytes):
            raise InputError(remedy)
    read_as = partial(_read_text, path, head, is_complete, selection)
    if head.startswith((BOM_UTF16_LE, BOM_UTF16_BE)):
        # Excel and LabVIEW
        return read_as("utf-16")
    if b"\0" in head:
        raise InputError(f"is not a log of a known kind; {_READABLE_KINDS}")
    try:
        return read_as("utf-8-sig")
    except UnicodeDecodeError:
        # a degree sign in a header of an old program
        return read_as("latin-1")


_REMEDIES = {
    b"SQLite format 3": "is a database, perhaps of a ROS 2 bag; give the bag's folder, the one with metadata.yaml",
    b"\x93NUMPY": "is an array of NumPy; save it by numpy.savetxt",
    b"\x1f\x8b": "is compressed; unpack it first, as by gunzip",
    b"PK\x03\x04": "is a workbook or an archive; save its sheet or arrays as CSV",
    b"\xd0\xcf\x11\xe0": "is a workbook; save the sheet as CSV",
}
"""First bytes of a kind that is not read -> fault and remedy."""


def _read_with_installed_reader(path: Path, suffix: str) -> Columns:
    with _report_errors(f"a log by the reader of .{suffix} files"):
        result = READERS[suffix](path)
    with suppress(TypeError, ValueError):
        columns = result if isinstance(result, Columns) else Columns(result)
        if all(
            isinstance(name, str) and (isinstance(values, Column) or np.ndim(values) == 1)
            for name, values in columns.items()
        ):
            return columns
    raise InputError(f"the reader of .{suffix} files should give columns of one dimension by name")


def _read_text(path: Path, start: bytes, is_complete: bool, selection: Selection, encoding: str) -> Columns:
    """Read JSON or a table. `start` is the beginning of the file, or all of it (`is_complete`)."""
    # whole lines and letters
    head = getincrementaldecoder(encoding)().decode(start, is_complete)
    head = head if is_complete else head[: head.rfind("\n") + 1] or head

    def load_text() -> str:
        check_file(path, _MAX_WHOLE_BYTES)
        return head if is_complete else path.read_text(encoding=encoding)

    if path.suffix.lower() == ".json" or head.lstrip()[0] in "[{":
        with _report_errors("JSON"):
            return _read_json(load_text())
    _check_lines(path)
    # after a wrong letter, which may be far behind the head, the caller tries another encoding
    with _report_errors("a table", UnicodeDecodeError):
        lines = head.splitlines()
        return _read_after_remarks(lines, load_text) or _read_table(path, lines, encoding, selection)


def _check_lines(path: Path) -> None:
    """Refuse lines that are too long for a row: their cells would take a hundred times their size in memory."""
    line_count = line_bytes = 0
    with path.open("rb") as file:
        while block := file.read(MAX_LINE_BYTES):
            line_ends = block.count(b"\n") or block.count(b"\r")
            line_bytes = 0 if line_ends else line_bytes + len(block)
            if line_bytes >= MAX_LINE_BYTES:
                raise InputError(
                    f"line {line_count + 1} has more than {MAX_LINE_BYTES / 1e6:.0f} MB; a log has a line for each row"
                )
            line_count += line_ends


def _read_parquet(path: Path, _: Selection) -> Columns:
    from pyarrow.parquet import ParquetFile

    # opened here, as the library takes names in UTF-8 alone
    with path.open("rb") as opened, ParquetFile(opened) as file:
        names, rows = file.schema_arrow.names, file.metadata.num_rows

    def load_column(name: str) -> np.ndarray:
        with path.open("rb") as opened:
            values = pd.read_parquet(opened, columns=[name])[name]
        if isinstance(values.dtype, pd.DatetimeTZDtype):
            values = values.dt.tz_convert(None)
        return values.to_numpy()

    return Columns({name: Column(partial(load_column, name), rows) for name in names})


@contextmanager
def _report_errors(kind: str, *unchanged: type[Exception]) -> Iterator[None]:
    """Turn errors of the libraries that read files into an InputError of one line; `unchanged` are passed on."""
    try:
        yield
    except (InputError, *unchanged):
        raise
    except Exception as error:
        first_line = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"cannot be read as {kind}: {first_line}; write it anew, or as CSV") from None


_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eEdD][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE)
_VALUE = re.compile(rf"{_NUMBER.pattern}|.*\d[:-]\d.*", re.IGNORECASE)
"""A number, a date or a time."""
_NO_ROWS = "has a header and no rows; a log needs rows of numbers"


def _read_table(path: Path, lines: list[str], encoding: str, selection: Selection) -> Columns:
    """Read columns separated by comma, semicolon, tab or white space; a header or none; # before remarks.

    `lines` are the first ones of the text.
    """
    text_format, headers = detect_text_format(lines), list[int]()

    def load_rows(selection: Selection) -> tuple[list[ColumnName], dict[ColumnName, np.ndarray], int]:
        """Return the names of all columns, the values of the selected ones, and the number of rows."""
        chunks: Any = pd.read_csv(
            path,
            sep=text_format.separator,
            header=None,
            names=text_format.names,
            comment="#",
            skipinitialspace=True,
            decimal=text_format.decimal,
            thousands=text_format.thousands,
            index_col=False,
            skiprows=text_format.first_row,
            low_memory=False,
            encoding=encoding,
            compression=None,
            chunksize=_CHUNK_ROWS,
        )
        pieces: dict[ColumnName, list[np.ndarray]] = {}
        names: list[ColumnName] = []
        count = 0
        with chunks:
            for frame in chunks:
                names = frame.columns.tolist()
                texts = [name for name in names if not is_numeric_dtype(frame[name])]
                if texts and text_format.names is not None:
                    is_header = (frame[texts] == texts).all(axis=1)
                    headers.extend(frame.index[is_header])
                    frame = frame[~is_header]
                count += len(frame)
                for i, name in enumerate(names):
                    if not selection or name in selection or i in selection:
                        column = frame[name]
                        if name in texts and text_format.decimal == ",":
                            column = column.str.replace(_DECIMAL_COMMA, ".", regex=True)
                        # a copy: a view would keep the whole chunk
                        pieces.setdefault(name, []).append(np.array(column.to_numpy()))
        return names, {name: np.concatenate(values) for name, values in pieces.items()}, count

    with warnings.catch_warnings(action="error", category=pd.errors.ParserWarning):
        try:
            names, values, count = load_rows(selection)
        except pd.errors.EmptyDataError:
            raise InputError(_NO_ROWS) from None
        except pd.errors.ParserWarning:
            raise InputError(f"rows have more columns than the header; they should have {text_format.count}") from None
    if not count:
        raise InputError(_NO_ROWS)
    columns = Columns(
        {name: values.get(name, Column(lambda name=name: load_rows([name])[1][name], count)) for name in names}
    )
    if headers:
        columns.notes.append(f"{len(headers)} rows that repeat the header are left out (data row {headers[0] + 1} first).")
    _note_units(columns, text_format.units)
    return columns


_DECIMAL_COMMA = re.compile(r"(?<=\d),(?=\d+([eE][+-]?\d+)?$)")
"""That of a number beside which the column has other text."""


class TextFormat(NamedTuple):
    """Format of rows of text.

    Attributes:
        separator: between cells; a pattern for white space.
        decimal: decimal sign of numbers.
        thousands: sign between thousands, or None.
        names: of the columns; None if there is no header.
        count: of the columns.
        first_row: line in which the rows begin, counted from 0.
        units: in a row below the header, if there is one.
    """

    separator: str
    decimal: str
    thousands: str | None
    names: list[str] | None
    count: int
    first_row: int
    units: Sequence[str] = ()

    def parse_row(self, line: str) -> list[float] | None:
        """Parse a row into numbers, NaN for a cell that is none; None if there are more cells or fewer."""
        cells = _split_cells(line.partition("#")[0], self.separator)
        if len(cells) != self.count:
            return None
        return [_parse_number(cell.replace(self.thousands or "", "").replace(self.decimal, ".")) for cell in cells]


def _parse_number(cell: str) -> float:
    # Python reads 1_000 as well
    with suppress(ValueError):
        return math.nan if "_" in cell else float(cell)
    return math.nan


def has_cells(line: str) -> bool:
    """Return True if a line is neither blank nor a comment."""
    return line.strip()[:1] not in ("", "#")


def detect_text_format(lines: list[str]) -> TextFormat:
    """Detect the format of rows from the first lines of a text.

    Raises:
        InputError: only remarks, too many columns, or two with the same name; the message is without the path.
    """
    places = [i for i, line in enumerate(lines) if has_cells(line)]
    if not places:
        raise InputError("holds only remarks; rows of numbers are needed")
    separator = _find_separator([lines[i] for i in places[:_FORMAT_ROWS]])
    cells, *rows = (_split_cells(lines[i], separator) for i in places[:3])
    if len(cells) > _MAX_COLUMNS:
        raise InputError(f"has {len(cells)} columns; at most {_MAX_COLUMNS} can be read")
    has_header = not any(map(_VALUE.fullmatch, cells))
    if has_header and rows and len(rows[0]) == len(cells) + 1 and not rows[0][-1]:
        cells = [*cells, ""]  # a separator at the end of the rows
    has_units = has_header and len(rows) == 2 and [any(map(_VALUE.fullmatch, row)) for row in rows] == [False, True]
    first_row = places[has_units] + has_header
    decimal, thousands = _find_number_signs(lines[first_row:], separator)
    names = _check_names(cells) if has_header else None
    return TextFormat(separator, decimal, thousands, names, len(cells), first_row, rows[0] if has_units else ())


_FORMAT_ROWS = 40
"""Rows that show which separator there is."""
_WHITE_SPACE = r"\s+"


def _find_separator(rows: Sequence[str]) -> str:
    """Return the separator between cells: one that makes about as many of most rows as of the first one."""
    candidates = [c for c in ";\t," if c in rows[0]]
    for separator in candidates:
        first, *counts = (len(_split_cells(row, separator)) for row in rows)
        if 2 * sum(first <= count <= first + 1 for count in counts) >= len(counts):
            return separator
    return candidates[0] if candidates else _WHITE_SPACE


_GROUPED = re.compile(r"[+-]?[1-9]\d{0,2}(?:(?:,\d{3})+\.\d*|(?:\.\d{3})+,\d*)")
"""A number with signs between thousands, and a decimal sign."""


def _find_number_signs(rows: Sequence[str], separator: str) -> tuple[str, str | None]:
    """Return the decimal sign and that between thousands, if there is one.

    A comma is decimal if it stands between digits, does not separate cells, and no number has a point.
    """
    cells = (cell for row in rows for cell in _split_cells(row, separator))
    if grouped := next(filter(_GROUPED.fullmatch, cells), ""):
        decimal = max(",.", key=grouped.rfind)
        return decimal, ",.".replace(decimal, "")
    text = "\n".join(rows)
    # points of dates and of times aside
    has_point = re.search(r"(?<![\d:.])\d+\.\d+(?![\d.])", text)
    return "," if separator != "," and re.search(r"\d,\d", text) and not has_point else ".", None


_MAX_REMARK_LINES = 100
"""Lines that a program may write before the rows: exports of drive software and of scopes have ten to thirty."""


def _read_after_remarks(lines: list[str], load_text: Callable[[], str]) -> Columns | None:
    """Read rows behind a block of remarks, as EPOS Studio and TwinCAT Scope write them; None if there is no such block.

    The last lines of the block hold names and, below them, units; TwinCAT writes Name over each column of times.
    `lines` are the first ones of the text.
    """
    pairs = itertools.pairwise(lines[:-1][: _MAX_REMARK_LINES + 1])
    start = next((i for i, pair in enumerate(pairs) if all(map(_is_number_row, pair))), 0)
    remarks = [line for line in lines[:start] if has_cells(line)]
    if len(remarks) < 2:
        return None
    separator = _find_separator(lines[start : start + 1])
    count = len(_split_cells(lines[start], separator))
    is_known_program = any(title in line for line in remarks for title in ("EPOS Studio", "Starttime of export"))
    titles = [_split_cells(line, separator) for line in remarks]
    if len(titles[0]) == count and not is_known_program:
        return None
    rows = [line for line in load_text().splitlines()[start:] if line.strip() and line.strip() != "EOF"]
    decimal, thousands = _find_number_signs(rows, separator)
    frame = pd.read_csv(
        io.StringIO("\n".join(rows)),
        sep=separator,
        header=None,
        skipinitialspace=True,
        decimal=decimal,
        thousands=thousands,
        index_col=False,
    )
    titles = [cells[:count] for cells in titles if len(cells) >= count]
    scope_names = [cells for cells in titles if cells[0] == "Name"]
    names, units, *_ = [*(scope_names[-1:] or titles[-2:]), [], []]
    return _name_columns([frame[i].to_numpy() for i in range(count)], names, units)


def _is_number_row(line: str) -> bool:
    """Return True if a line holds two numbers or more, and nothing else."""
    separator = _find_separator([line])
    cells = [] if separator == _WHITE_SPACE else _split_cells(line, separator)
    cells = cells[:-1] if cells and not cells[-1] else cells
    return len(cells) > 1 and all(map(_VALUE.fullmatch, cells))


def _name_columns(values: list[np.ndarray], names: list[str], units: list[str]) -> Columns:
    """Name the columns, and interpolate those that have their own times to the times of the first one."""
    columns, times = Columns(), values[0]
    own_times = times
    for i, (name, column) in enumerate(itertools.zip_longest(names, values, fillvalue="")):
        if i and name == "Name":
            own_times = column
            continue
        if not np.array_equal(own_times, times, equal_nan=True):
            column = read_at(times, own_times, column)
            columns.notes.append(f"'{name}' was sampled at other times: it is interpolated to those of the first column.")
        if name in ("", "Name"):
            name = f"column {i}" if i else "t"
        columns[name] = column
    _note_units(columns, units)
    return columns


def _note_units(columns: Columns, units: Sequence[str]) -> None:
    """Keep the units that a file gives for its columns, with a remark."""
    pairs = zip(columns, (unit.strip("[]()") for unit in units), strict=False)
    columns.units |= {name: unit for name, unit in pairs if unit}
    if columns.units:
        units_text = ", ".join(f"{name} {unit}" for name, unit in columns.units.items())
        columns.notes.append(f"The file gives these units, which [log] should repeat: {units_text}.")


def _split_cells(line: str, separator: str) -> list[str]:
    # a lone carriage return, or a cell without an end, makes the line one cell
    cells = [line]
    with suppress(csv.Error):
        cells = next(csv.reader([line], delimiter=separator), []) if len(separator) == 1 else line.split()
    return [cell.strip() for cell in cells]


def _check_names(cells: list[str]) -> list[str]:
    if not cells[-1]:
        cells = [*cells[:-1], f"column {len(cells) - 1}"]  # a separator at the end of the lines
    if len({*cells}) < len(cells):
        duplicate = next(cell for i, cell in enumerate(cells) if cell in cells[:i])
        raise InputError(f"two columns are called '{duplicate}'; names should differ")
    return cells


def _read_json(text: str) -> Columns:
    """Read an array of objects or of rows of numbers, an object that holds one, objects line by line, or arrays by name."""
    # NumPy has no whole numbers of more digits than stamps in ns, and Python reads none of thousands
    load = partial(
        json.loads, parse_int=lambda digits: (int if len(digits) < 20 else float)(digits), object_pairs_hook=name_members
    )
    try:
        content = load(text)
    except RecursionError:
        raise InputError("is nested too deep; a log holds rows, or arrays by name") from None
    except ValueError as error:
        try:
            content = [load(line) for line in text.splitlines() if line.strip()]
        except (RecursionError, ValueError):
            raise InputError(f"is not valid JSON: {error}") from None
    if isinstance(content, dict):
        arrays = [value for value in content.values() if isinstance(value, list) and value and isinstance(value[0], dict)]
        content = arrays[0] if len(arrays) == 1 else content
    columns = Columns()
    if _is_matrix(content):
        columns.update(enumerate(np.asarray(content, dtype=float).T))
    elif isinstance(content, dict):
        _add_columns(columns, "", content)
    elif content and isinstance(content, list) and all(isinstance(row, dict) for row in content):
        _add_columns(columns, "", pd.json_normalize(content))
    else:
        raise InputError("should hold an array of objects, one a row, or of rows of equally many numbers")
    return _require_columns(columns)


def _is_matrix(value: Any) -> bool:
    """Return True for a list of rows of equally many numbers."""
    if not isinstance(value, list) or not all(isinstance(row, list) and row for row in value):
        return False
    has_numbers = all(isinstance(cell, int | float) or cell is None for row in value for cell in row)
    return has_numbers and len({len(row) for row in value}) == 1


def _add_columns(columns: Columns, name: str, value: Any) -> None:
    """Add a vector, the columns of a matrix (`name[0]`), members of a structure (`name.key`) or of cells (`name[0]`)."""
    if isinstance(value, pd.DataFrame):
        value = {column: cells.tolist() if cells.dtype == object else cells for column, cells in value.items()}
    elif isinstance(value, list):
        value = np.asarray(value, float) if _is_matrix(value) else pd.Series(value, dtype=object).infer_objects()
    if not isinstance(value, dict):
        value = np.squeeze(np.asarray(value))
        if "s2" in (value.dtype.names or ()):
            columns.unread[_MATLAB_OBJECTS].append(f"{name} ({value['s2'].item().decode()})")
            return
        if value.dtype.names and not value.ndim:
            value = {field: value[field] for field in value.dtype.names}
    if isinstance(value, dict):
        for key, member in value.items():
            _add_columns(columns, f"{name}.{key}" if name else key, member)
    elif value.dtype == object and not value.ndim:
        if isinstance(value.item(), np.ndarray):
            _add_columns(columns, name, value.item())
    elif value.dtype.names or (value.dtype == object and any(isinstance(cell, np.ndarray | dict) for cell in value.flat)):
        for i, member in enumerate(value.flat):
            _add_columns(columns, f"{name}[{i}]", member)
    elif value.dtype.kind in "biufO":
        _add_vectors(columns, name, value.shape, lambda: value)


def _read_matlab(path: Path, selection: Selection) -> Columns:
    """Read vectors, columns of matrices (`name[0]`), fields of structures (`name.field`), and cells (`name[0]`)."""
    from scipy.io import loadmat

    def load_variable(name: str) -> Any:
        return loadmat(path, variable_names=[name], squeeze_me=True, struct_as_record=True)[name]

    selected_variables = {re.split(r"[.\[]", str(column))[0] for column in selection}
    columns = Columns()
    postponed = []
    for name, shape, kind in _list_matlab_variables(path):
        if kind in ("cell", "struct"):
            # the columns in them are not known before they are loaded
            if not selection or name in selected_variables:
                _add_columns(columns, name, load_variable(name))
            else:
                postponed.append(name)
        elif re.fullmatch(r"double|single|logical|u?int\d+", kind):
            _add_vectors(columns, name, shape, partial(load_variable, name))
        elif kind != "char":
            columns.unread[_MATLAB_OBJECTS].append(f"{name} ({kind})")
    # a message that lists columns has to know their names
    for name in postponed if not any(column in columns for column in selection) else ():
        _add_columns(columns, name, load_variable(name))
    return _require_columns(columns)


_MATLAB_OBJECTS = "objects of MATLAB; save their vectors, as t = seconds(T.Time); u = T.u"


def _list_matlab_variables(path: Path) -> list[tuple[str, tuple[int, ...], str]]:
    """Return name, shape and class of the variables of a MATLAB file; SciPy lists none where one is an object."""
    from scipy.io import loadmat, matlab, whosmat

    with suppress(TypeError):
        return whosmat(path)
    variables = []
    with path.open("rb") as file:
        for _, stream in matlab.varmats_from_mat(file):
            try:
                variables += whosmat(stream)
            except TypeError:
                stream.seek(0)
                opaque = loadmat(stream)["None"][0]
                variables.append((opaque["s0"].decode(), (), opaque["s2"].decode()))
    # of objects, without a name
    return [variable for variable in variables if not variable[0].startswith("__")]


def _add_vectors(columns: Columns, name: str, shape: tuple[int, ...], load: Callable[[], Any]) -> None:
    """Add a vector, or the columns of a matrix, whose values `load` returns; lengths of 1 in `shape` do not count."""
    shape = tuple(length for length in shape if length != 1)
    if len(shape) == 1:
        columns[name] = Column(lambda: np.squeeze(load()), shape[0])
    elif len(shape) == 2 and min(shape) <= _MAX_COLUMNS:
        # samples run along the longer side
        axis = 1 if shape[0] >= shape[1] else 0
        for i in range(shape[axis]):
            columns[f"{name}[{i}]"] = Column(lambda i=i: np.take(np.squeeze(load()), i, axis=axis), shape[1 - axis])


def _read_hdf5(path: Path, _: Selection) -> Columns:
    """Read MATLAB 7.3, or any HDF5 file of vectors. Links are not followed: they could name any file."""
    import h5py

    columns = Columns()
    referring_nodes: set[Any] = set()

    def load_dataset(place: str) -> np.ndarray:
        with h5py.File(path) as file:
            return np.asarray(file[place])

    def add_node(name: str, node: Any) -> None:
        if not isinstance(node, h5py.Group):
            return add_dataset(name, node)

        def add_member(place: str, link: Any) -> None:
            member = f"{name}.{place}".strip(".").replace("/", ".")
            if isinstance(link, h5py.HardLink):
                add_dataset(member, node[place])
            else:
                columns.unread[_LINKS].append(member)

        return node.visititems_links(add_member)

    def add_dataset(name: str, node: Any) -> None:
        # some programs write a dataset without a value for an option that is not set
        if isinstance(node, h5py.Group) or name.startswith("#") or node.shape is None:
            return
        matlab_class = node.attrs.get("MATLAB_class", b"").decode()
        if node.is_virtual or node.external:
            columns.unread[_LINKS].append(name)
        elif "MATLAB_object_decode" in node.attrs:
            columns.unread[_MATLAB_OBJECTS].append(f"{name} ({matlab_class})")
        elif node.dtype.kind in "biuf" and matlab_class != "char":
            _add_vectors(columns, name, node.shape, partial(load_dataset, node.name))
        # cells, and structures with several elements; they may hold one another
        elif h5py.check_ref_dtype(node.dtype) is not None and node.size <= _MAX_COLUMNS and node not in referring_nodes:
            referring_nodes.add(node)
            for i, reference in enumerate(np.ravel(node[()])):
                if reference:
                    add_node(f"{name}[{i}]", node.file[reference])

    with h5py.File(path) as file:
        add_node("", file)
    return _require_columns(columns)


_LINKS = "links are not followed; copy the data into the file"
_BINARY_READERS: tuple[tuple[bytes, str, str, Callable[[Path, Selection], Columns]], ...] = (
    (rb"TDSm", "", "TDMS", read_tdms),
    (rb"MDF", "", "MDF", read_mdf),
    (rb"\x89MCAP", "", "MCAP", read_mcap),
    (rb"#ROSBAG", "", "a ROS bag", read_bag),
    (rb"PAR1", "", "Parquet", _read_parquet),
    # MATLAB 7.3 puts half a kilobyte of text before HDF5
    (rb"(.{512})?\x89HDF", "", "a MATLAB file", _read_hdf5),
    (rb"", ".mat", "a MATLAB file", _read_matlab),
)
"""First bytes, a pattern, and ending of files of a kind, the kind as messages call it, and its reader."""


def _require_columns(columns: Columns) -> Columns:
    if not columns:
        raise InputError(
            " ".join(["holds no vectors of numbers; a log needs them.", *columns.describe_unread()]).rstrip(".")
        )
    return columns
