"""Reading a log file into named columns: text, Parquet, MATLAB (up to 7.2, and 7.3), JSON.

Only columns that are wanted stay in memory; others are loaded if they are asked for after all.
"""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false

import csv
import io
import json
import math
import re
import warnings
from codecs import BOM_UTF8
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import pandas as pd

from jaxbl.errors import InputError, escape_unprintable
from jaxbl.registry import Registry
from jaxbl.validation import LARGEST, check_file, explain_missing_file, suggest_word

from .libraries import Column, Columns, read_bag, read_mcap, read_mdf, read_tdms

_KINDS = "text (CSV and the like), Parquet, MATLAB (.mat), JSON, MDF4, TDMS, MCAP and ROS bags can be read"
_MARKS: tuple[tuple[bytes, str, Callable[..., dict[str | int, Any]]], ...] = (
    (b"TDSm", "TDMS", lambda path, wanted: read_tdms(path)),
    (b"MDF", "MDF", lambda path, wanted: read_mdf(path)),
    (b"\x89MCAP", "MCAP", read_mcap),
    (b"#ROSBAG", "a ROS bag", read_bag),
)
"""First bytes, name and reader of kinds that need a library."""
_ENDINGS = (
    ".csv", ".txt", ".tsv", ".dat", ".parquet", ".mat", ".h5", ".hdf5", ".json", ".mf4", ".mdf", ".tdms", ".mcap", ".bag"
)  # fmt: skip
"""Of the files that are logs by their name, without those of installed packages."""


def _check_reader(name: str, found: Any) -> None:
    if f".{name}" in _ENDINGS:
        raise ValueError(f"files that end in .{name} are read by jaxbl itself")
    if not re.fullmatch(r"[a-z0-9_-]+", name):
        raise ValueError("its name should be the ending of its files, in small letters and without the dot")
    if not callable(found):
        raise TypeError("should be a function of a file's path")


READERS = Registry("jaxbl.readers", _check_reader)
"""Functions of a path that give the columns of a file by name, by the ending of their files without its dot."""

_HEAD = 1 << 18
"""Bytes from which the kind of a file and the form of its rows are seen: hundreds of rows."""
_BAG = "metadata.yaml"
"""What the folder of a ROS 2 bag holds."""
_ROWS = 100_000
"""Rows of text that are in memory with all their columns."""
_MOST_COLUMNS = 10_000
"""Of a text file: exports of whole machines have hundreds."""
_MOST_ROWS = 100_000_000
"""Numbers of a column, a day at 1 kHz: each column that is used is 0.8 GB then."""
_MOST_WHOLE = 128_000_000
"""Bytes of a file that is held whole while it is read, JSON and exports with remarks; Python takes ten times as many."""
_LONGEST_LINE = 1 << 20
"""Bytes of a line of text: ten thousand numbers of full length have a fifth of it."""


class LogFile:
    """A log file as it is being read.

    Attributes:
        path: the file.
        columns: name -> values, one-dimensional; numbers in place of names where the file has none.
        units: those that the file itself says, by column.
        notes: what was done to the log, and what is odd about it, in sentences.
        warnings: those to be said first.
        corrections, contradiction: as of a record.
    """

    def __init__(self, path: Path, columns: dict[str | int, Any]):
        self.path, self.columns = path, columns
        self.units = columns.units if isinstance(columns, Columns) else {}
        self.notes = [*columns.notes] if isinstance(columns, Columns) else []
        self.warnings: list[str] = []
        self.corrections: dict[str, float] = {}
        self.contradiction = ""

    def error(self, text: str) -> InputError:
        """What to raise where something is wrong with the file."""
        return InputError(f"{self.path}: {text}")

    def find_column(self, column: str | int, channel: str = "") -> str | int:
        """The name of a column that is given by name or number; InputError names the nearest where there is none."""
        if column in self.columns:
            return column
        # a hard space or the like, which names have here as messages spell it
        if isinstance(column, str) and escape_unprintable(column) in self.columns:
            return escape_unprintable(column)
        names = list(self.columns)
        if isinstance(column, int):
            if column < len(names):
                return names[column]
            count = f"has {len(names)} columns, numbered 0 to {len(names) - 1}" if len(names) != 1 else "has only column 0"
            raise self.error(f"no column {column}: the file {count}")
        key = f"; [log] {channel} can name another" if channel else ""
        if all(isinstance(name, int) for name in names):
            raise self.error(
                f"no column '{column}': the file has no header; give the column's number, 0 to {len(names) - 1}"
                + (f", as [log] {channel}" if channel else "")
            )
        raise self.error(f"no column '{column}'; {suggest_word(column, map(str, names))}{key}")

    def count_values(self, name: str | int) -> int:
        """Number of values of a column, which is not loaded; InputError where there are too many."""
        if (count := len(self.columns[name])) > _MOST_ROWS:
            raise self.error(f"column {name!r} has {count} values; at most {_MOST_ROWS} can be read")
        return count

    def load_values(self, name: str | int) -> np.ndarray:
        """A column as the file has it, shape (rows,). InputError where it is too long, or cannot be read."""
        self.count_values(name)
        try:
            with _one_line_errors(f"column {name!r}"):
                return np.asarray(self.columns[name])
        except InputError as error:
            raise self.error(str(error)) from None

    def load_seconds(self, column: str | int, unit: float, channel: str = "") -> np.ndarray:
        """A column of time stamps, s, shape (rows,), of numbers of so many seconds each, or of dates, from the first one on.

        InputError as :meth:`load_numbers`.
        """
        name = self.find_column(column, channel)
        stamps = self.load_values(name)
        if stamps.dtype.kind not in "Mm":
            return self.load_numbers(column, channel) * unit
        if unit != 1.0:
            raise self.error(f"column {name!r} holds dates or times, which have a unit of their own; leave [log] t.unit out")
        if np.isnat(stamps).any():
            raise self.error(
                f"column {name!r}, data row {int(np.argmax(np.isnat(stamps))) + 1} is empty; it should be a time"
            )
        if stamps.dtype.kind == "M" and len(stamps):
            self.notes.append(f"Time is counted from {np.datetime_as_string(stamps[0])}.")
        # of whole nanoseconds: seconds since 1970 are rounded to tenths of a microsecond
        return 1e-9 * (stamps - stamps[:1]).astype("timedelta64[ns]").astype(np.int64)

    def load_numbers(self, column: str | int, channel: str = "") -> np.ndarray:
        """A column of finite numbers, shape (rows,); InputError names the first row, counted from 1, that holds none."""
        name = self.find_column(column, channel)
        given = self.load_values(name)
        if given.dtype.kind in "cMm":
            kind = "complex numbers" if given.dtype.kind == "c" else "dates or times"
            raise self.error(f"column {name!r} holds {kind}; it should hold real numbers")
        values = np.asarray(pd.to_numeric(pd.Series(given), errors="coerce"), dtype=float)
        finite = np.abs(values) <= LARGEST
        if not finite.all():
            row = int(np.argmin(finite))
            cell = np.asarray(given, dtype=object)[row]
            if np.isfinite(values[row]):
                raise self.error(
                    f"column {name!r}, data row {row + 1} is {values[row]:g}; a reading should be below {LARGEST:g}"
                )
            empty = cell is None or (isinstance(cell, float) and np.isnan(cell))
            what = "empty or not a number" if empty else repr(cell)
            raise self.error(f"column {name!r}, data row {row + 1} is {what}; it should be a finite number")
        return values

    def check_length(self, name: str | int, length: int) -> None:
        """InputError where the values of a column are not as many as there are time stamps."""
        if (count := self.count_values(name)) != length:
            raise self.error(f"column {name!r} has {count} values and the time {length}; they should be equally many")


def is_log(path: Path) -> bool:
    """Whether a file, or the folder of a ROS 2 bag, is a log by its name; :func:`read_log_file` reads others, too."""
    return (path / _BAG).is_file() or (path.is_file() and path.suffix.lower() in log_suffixes())


def log_suffixes() -> tuple[str, ...]:
    """Of the files that are logs by their name, with those of installed packages."""
    return (*_ENDINGS, *(f".{name}" for name in READERS))


def read_log_file(path: Path, wanted: Collection[str | int] = ()) -> LogFile:
    """Read columns of a log file; the suffix and the first bytes say which kind it is.

    Args:
        path: the file; of a ROS 2 bag its folder.
        wanted: names, or numbers counted from 0, of columns that will be used; left out: all. Others are listed as well.

    Raises:
        InputError: the file is missing, empty, or of no known kind.
    """
    try:
        check_file(path)
        columns = _read_columns(path, wanted)
        if not all(str(name).isprintable() for name in columns):
            named = {escape_unprintable(one) if isinstance(one, str) else one: values for one, values in columns.items()}
            columns.clear()
            columns.update(named)
        return LogFile(path, columns)
    except FileNotFoundError:
        why = explain_missing_file(path, log_suffixes())
    except IsADirectoryError:
        why = "is a folder; a log file is needed"
    except OSError as error:
        why = f"cannot be read: {error.strerror or error}; mend the access to it"
    except InputError as error:
        why = str(error)
    raise InputError(f"{path}: {why}")


def _read_columns(path: Path, wanted: Collection[str | int]) -> dict[str | int, Any]:
    suffix = path.suffix.lower()
    if (path / _BAG).is_file():
        with _one_line_errors("a ROS bag"):
            return read_bag(path, wanted)
    if suffix not in _ENDINGS and suffix[1:] in READERS:
        return _read_with_installed_reader(path, suffix[1:])
    with path.open("rb") as file:
        head = file.read(_HEAD)
        whole = not file.read(1)
    for mark, kind, read in _MARKS:
        if head.startswith(mark):
            with _one_line_errors(kind):
                return read(path, wanted)
    if not head.removeprefix(BOM_UTF8).strip():
        raise InputError(f"is empty; {_KINDS}")
    if head.startswith(b"PAR1"):
        with _one_line_errors("Parquet"):
            return _read_parquet(path)
    # an HDF5 file begins so; MATLAB 7.3 puts half a kilobyte of text before that
    if b"\x89HDF" in (head[:4], head[512:516]):
        return _read_hdf5(path)
    if suffix == ".mat":
        return _read_matlab(path, wanted)
    if head.startswith(b"SQLite format 3"):
        raise InputError("is a database, perhaps of a ROS 2 bag; give the bag's folder, the one with metadata.yaml")
    if b"\0" in head:
        raise InputError(f"is not a log of a known kind; {_KINDS}")
    # whole lines, so that no letter is cut
    head = head if whole else head[: head.rfind(b"\n") + 1] or head
    try:
        return _read_text(path, head.decode("utf-8-sig"), "utf-8-sig", whole, wanted)
    except UnicodeDecodeError:
        # a degree sign in a header of an old program
        return _read_text(path, head.decode("latin-1"), "latin-1", whole, wanted)


def _read_with_installed_reader(path: Path, ending: str) -> Columns:
    """Columns by the reader of an installed package."""
    with _one_line_errors(f"a log by the reader of .{ending} files"):
        found = READERS[ending](path)
    try:
        columns = found if isinstance(found, Columns) else Columns(found)
        fits = all(isinstance(name, str) for name in columns) and all(
            isinstance(values, Column) or np.ndim(values) == 1 for values in columns.values()
        )
    except (TypeError, ValueError):
        fits = False
    if not fits:
        raise InputError(f"the reader of .{ending} files should give columns of one dimension by name")
    return columns


def _read_text(path: Path, head: str, encoding: str, whole: bool, wanted: Collection[str | int]) -> dict[str | int, Any]:
    def text() -> str:
        check_file(path, _MOST_WHOLE)
        return head if whole else path.read_text(encoding=encoding)

    if path.suffix.lower() == ".json" or head.lstrip()[0] in "[{":
        with _one_line_errors("JSON"):
            return _read_json(text())
    _check_lines(path)
    with _one_line_errors("a table", UnicodeDecodeError):
        return _read_table(path, head, encoding, text, wanted)


def _check_lines(path: Path) -> None:
    """Refuse lines that no row has: their cells would take a hundred times their size in memory."""
    count = since = 0
    with path.open("rb") as file:
        while block := file.read(_LONGEST_LINE):
            ends = block.count(b"\n") or block.count(b"\r")
            since = 0 if ends else since + len(block)
            if since >= _LONGEST_LINE:
                raise InputError(
                    f"line {count + 1} has more than {_LONGEST_LINE / 1e6:.0f} MB; a log has a line for each row"
                )
            count += ends


def _read_parquet(path: Path) -> dict[str | int, Any]:
    from pyarrow.parquet import ParquetFile

    with ParquetFile(path) as file:
        names, rows = [str(name) for name in file.schema_arrow.names], file.metadata.num_rows

    def loaded(name: str) -> np.ndarray:
        values = pd.read_parquet(path, columns=[name])[name]
        if isinstance(values.dtype, pd.DatetimeTZDtype):
            values = values.dt.tz_convert(None)
        return values.to_numpy()

    return {name: Column(lambda name=name: loaded(name), rows) for name in names}


@contextmanager
def _one_line_errors(kind: str, *passed: type[Exception]) -> Iterator[None]:
    """Errors of the libraries that read files, which are of many classes, in one line; those of `passed` as they are."""
    try:
        yield
    except (InputError, *passed):
        raise
    except Exception as error:
        first = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"cannot be read as {kind}: {first}; write it anew, or as CSV") from None


_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eEdD][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE)
_NO_ROWS = "has a header and no rows; a log needs rows of numbers"


def _read_table(
    path: Path, head: str, encoding: str, text: Callable[[], str], wanted: Collection[str | int]
) -> dict[str | int, Any]:
    """Comma, semicolon, tab or white space between columns; a header or none; # before remarks."""
    lines = head.splitlines()
    if max(map(len, lines)) == len(head) and len(head) > _HEAD // 2:
        raise InputError(f"has no line break in its first {len(head)} characters; a log has a line for each row")
    if (block := _read_behind_remarks(lines, text)) is not None:
        return block
    form = detect_text_format(lines)

    def rows(wanted: Collection[str | int]) -> tuple[list[str | int], dict[str | int, np.ndarray], int]:
        """Names of all columns, values of those that are wanted (all, if none is), and the number of rows."""
        chunks: Any = pd.read_csv(
            path,
            **form.pandas_options(),
            skiprows=form.first_row,
            low_memory=False,
            encoding=encoding,
            compression=None,
            chunksize=_ROWS,
        )
        parts: dict[str | int, list[np.ndarray]] = {}
        every: list[str | int] = []
        count = 0
        with chunks:
            for frame in chunks:
                count += len(frame)
                every = [name if isinstance(name, str) else int(name) for name in frame.columns]
                for i, name in enumerate(every):
                    if not wanted or name in wanted or i in wanted:
                        # a copy: a view would keep the whole chunk
                        parts.setdefault(name, []).append(np.array(frame[name].to_numpy()))
        return every, {name: np.concatenate(values) for name, values in parts.items()}, count

    # another encoding is tried then: the letter may be far behind the head
    with (
        _one_line_errors("a table", UnicodeDecodeError),
        warnings.catch_warnings(action="error", category=pd.errors.ParserWarning),
    ):
        try:
            every, values, count = rows(wanted)
        except pd.errors.EmptyDataError:
            raise InputError(_NO_ROWS) from None
        except pd.errors.ParserWarning:
            raise InputError(f"rows have more columns than the header; they should have {form.count}") from None
    if not count:
        raise InputError(_NO_ROWS)
    return {
        name: values[name] if name in values else Column(lambda name=name: rows([name])[1][name], count) for name in every
    }


class TextFormat(NamedTuple):
    """How rows of text are written.

    Attributes:
        separator: between cells; white space as a pattern.
        decimal: sign of numbers.
        names: of the columns, or None where there is no header.
        count: of the columns.
        first_row: line in which the rows begin, counted from 0.
    """

    separator: str
    decimal: str
    names: list[str] | None
    count: int
    first_row: int

    def pandas_options(self) -> Any:
        """Those of `pandas.read_csv`."""
        return {
            "sep": self.separator,
            "header": None,
            "names": self.names,
            "comment": "#",
            "skipinitialspace": True,
            "decimal": self.decimal,
            "index_col": False,
        }

    def parse_numbers(self, lines: list[str]) -> np.ndarray:
        """Rows as numbers, shape (rows, columns); NaN for a cell that holds none. Lines of another number of cells are
        left out."""
        lines = [line for line in lines if len(_split_cells(line, self.separator)) == self.count]
        if not lines:
            return np.empty((0, self.count))
        options = self.pandas_options() | {"names": None}
        frame = pd.read_csv(io.StringIO("\n".join(lines)), **options)
        return np.stack([pd.to_numeric(frame[i], errors="coerce").to_numpy(float) for i in range(self.count)], axis=1)


def detect_text_format(lines: list[str]) -> TextFormat:
    """How the rows of a text are written, from its first lines.

    Raises:
        InputError: there are only remarks, too many columns, or two of one name; the message is without the path.
    """
    skipped = next((i for i, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")), None)
    if skipped is None:
        raise InputError("holds only remarks; rows of numbers are needed")
    first = lines[skipped]
    separator = _find_separator(first)
    cells = _split_cells(first, separator)
    if len(cells) > _MOST_COLUMNS:
        raise InputError(f"has {len(cells)} columns; at most {_MOST_COLUMNS} can be read")
    header = not any(_NUMBER.fullmatch(cell) for cell in cells)
    second = next((line for line in lines[skipped + 1 :] if line.strip()), "")
    if header and len(_split_cells(second, separator)) == len(cells) + 1 and second.rstrip(" ").endswith(separator):
        cells = [*cells, ""]  # a separator at the end of the rows
    decimal = _find_decimal_sign(lines[skipped + header :], separator)
    names = _check_names(cells) if header else None
    return TextFormat(separator, decimal, names, len(cells), skipped + header)


_SPACE = r"\s+"


def _find_separator(line: str) -> str:
    """What stands between the cells of a line."""
    return next((c for c in ";\t," if c in line), _SPACE)


def _find_decimal_sign(rows: list[str], separator: str) -> str:
    """The decimal sign of rows: a comma between digits is one where something else separates, and no point is one."""
    text = "\n".join(rows)
    return "," if separator != "," and re.search(r"\d,\d", text) and not re.search(r"\d\.\d", text) else "."


_REMARKS = 100
"""Lines that a program may write before the rows: exports of drive software and of scopes have ten to thirty."""


def _read_behind_remarks(lines: list[str], text: Callable[[], str]) -> Columns | None:
    """Rows behind a block of remarks, as EPOS Studio and TwinCAT Scope write them; None where there is no such block.

    `lines` are the first of the `text`.

    The lines just before the rows hold names and, below, units; TwinCAT's the word Name over each column of times.
    """
    start = next(
        (i for i in range(min(len(lines) - 2, _REMARKS)) if _is_number_row(lines[i]) and _is_number_row(lines[i + 1])), 0
    )
    head = [line for line in lines[:start] if line.strip() and not line.lstrip().startswith("#")]
    if len(head) < 2:
        return None
    separator = _find_separator(lines[start])
    if separator == _SPACE:
        return None
    count = len(_split_cells(lines[start], separator))
    known = any(mark in line for line in head for mark in ("EPOS Studio", "Starttime of export"))
    if not known and len(_split_cells(head[0], separator)) == count:
        return None
    rows = [line for line in text().splitlines()[start:] if line.strip() and line.strip() != "EOF"]
    decimal = _find_decimal_sign(rows, separator)
    with _one_line_errors("a table"):
        frame = pd.read_csv(
            io.StringIO("\n".join(rows)), sep=separator, header=None, decimal=decimal, skipinitialspace=True, index_col=False
        )
    titles = [_split_cells(line, separator) for line in head]
    titles = [cells[:count] for cells in titles if len(cells) >= count]
    scope = [cells for cells in titles if cells[0] == "Name"]
    names = scope[-1] if scope else titles[-2] if len(titles) > 1 else titles[-1] if titles else []
    units = titles[-1] if len(titles) > 1 and not scope else []
    return _name_columns([frame[i].to_numpy() for i in range(count)], names, units)


def _is_number_row(line: str) -> bool:
    """Whether a line holds two numbers or more, and nothing else."""
    separator = _find_separator(line)
    cells = [] if separator == _SPACE else _split_cells(line, separator)
    cells = cells[:-1] if cells and not cells[-1] else cells
    return len(cells) > 1 and all(_NUMBER.fullmatch(cell) for cell in cells)


def _name_columns(values: list[np.ndarray], names: list[str], units: list[str]) -> Columns:
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


def _split_cells(line: str, separator: str) -> list[str]:
    cells = next(csv.reader([line], delimiter=separator), []) if len(separator) == 1 else line.split()
    return [cell.strip() for cell in cells]


def _check_names(cells: list[str]) -> list[str]:
    if cells and not cells[-1]:
        cells = [*cells[:-1], f"column {len(cells) - 1}"]  # a separator at the end of the lines
    if len({*cells}) < len(cells):
        twice = next(cell for i, cell in enumerate(cells) if cell in cells[:i])
        raise InputError(f"two columns are called '{twice}'; names should differ")
    return cells


def _read_json(text: str) -> dict[str | int, Any]:
    """An array of objects or of rows of numbers, an object that holds one array of objects, or arrays by name."""
    try:
        data = json.loads(text)
    except RecursionError:
        raise InputError("is nested too deep; a log holds rows, or arrays by name") from None
    except ValueError as error:
        raise InputError(f"is not valid JSON: {error}") from None
    columns: dict[str | int, Any] = {}
    if isinstance(data, dict):
        rows = [value for value in data.values() if isinstance(value, list) and value and isinstance(value[0], dict)]
        if len(rows) != 1:
            for name, value in data.items():
                _add_json_columns(columns, name, value)
            if not columns:
                raise InputError("holds no array of rows or of numbers; a log needs one")
            return columns
        data = rows[0]
    if _is_matrix(data):
        return dict(enumerate(np.asarray(data, dtype=float).T))
    if not isinstance(data, list) or not data or not all(isinstance(row, dict) for row in data):
        raise InputError("should hold an array of objects, one a row, or of rows of equally many numbers")
    names = dict.fromkeys(name for row in data for name in row)
    return {name: _to_array([row.get(name) for row in data]) for name in names}


def _add_json_columns(columns: dict[str | int, Any], name: str, value: Any) -> None:
    """Arrays, columns of matrices as `name[0]`, and what objects hold as `name.key`."""
    if isinstance(value, dict):
        for key, inner in value.items():
            _add_json_columns(columns, f"{name}.{key}", inner)
    elif _is_matrix(value):
        for i, column in enumerate(np.asarray(value, dtype=float).T):
            columns[f"{name}[{i}]"] = column
    elif isinstance(value, list):
        columns[name] = _to_array(value)


def _is_matrix(value: Any) -> bool:
    """Whether a value is rows of equally many numbers."""
    if not isinstance(value, list) or not value or not all(isinstance(row, list) and row for row in value):
        return False
    plain = all(isinstance(cell, int | float) or cell is None for row in value for cell in row)
    return plain and len({len(row) for row in value}) == 1


def _to_array(values: list[Any]) -> np.ndarray:
    return np.asarray(pd.Series(values, dtype=object).infer_objects())


def _read_matlab(path: Path, wanted: Collection[str | int]) -> dict[str | int, Any]:
    """Vectors, columns of matrices (`name[0]`), fields of structures (`name.field`), and cells (`name[0]`)."""
    from scipy.io import loadmat, whosmat

    def loaded(name: str) -> Any:
        with _one_line_errors("a MATLAB file"):
            return loadmat(path, variable_names=[name], squeeze_me=True, struct_as_record=True)[name]

    with _one_line_errors("a MATLAB file"):
        known = whosmat(path)
    tops = {re.split(r"[.\[]", str(column))[0] for column in wanted}
    columns: dict[str | int, Any] = {}
    others = []
    for name, shape, kind in known:
        if kind in ("cell", "struct"):
            # what is in them shows only once they are loaded
            if not wanted or name in tops:
                _add_matlab_columns(columns, name, loaded(name))
            else:
                others.append(name)
        elif re.fullmatch(r"double|single|logical|u?int\d+", kind):
            _add_vectors(columns, name, shape, lambda name=name: loaded(name))
    # a message that lists columns has to know their names
    for name in others if not any(one in columns for one in wanted) else ():
        _add_matlab_columns(columns, name, loaded(name))
    return _require_columns(columns)


_ColumnsType = TypeVar("_ColumnsType", bound=dict[str | int, Any])


def _add_matlab_columns(columns: dict[str | int, Any], name: str, value: Any) -> None:
    value = np.asarray(value)
    if value.dtype.names:
        if value.ndim == 0:
            for field in value.dtype.names:
                _add_matlab_columns(
                    columns, f"{name}.{field}", value[field].item() if value[field].dtype == object else value[field]
                )
        elif value.ndim == 1:
            for i, one in enumerate(value):
                _add_matlab_columns(columns, f"{name}[{i}]", one)
    elif value.dtype == object:
        for i, one in enumerate(value.ravel() if value.ndim else []):
            _add_matlab_columns(columns, f"{name}[{i}]", one)
    elif value.dtype.kind in "biuf":
        _add_vectors(columns, name, value.shape, lambda: value)


def _add_vectors(columns: dict[str | int, Any], name: str, shape: tuple[int, ...], load: Callable[[], Any]) -> None:
    """A vector, or the columns of a matrix, of which `load` gives the values; `shape` may have ones that are squeezed."""
    shape = tuple(one for one in shape if one != 1)
    if len(shape) == 2 and (min(shape) > _MOST_COLUMNS or math.prod(shape) > _MOST_ROWS):
        return
    if len(shape) == 1:
        columns[name] = Column(lambda: np.squeeze(load()), shape[0])
    elif len(shape) == 2:
        # samples run along the longer side
        along = 1 if shape[0] >= shape[1] else 0
        for i in range(shape[along]):
            columns[f"{name}[{i}]"] = Column(lambda i=i: np.take(np.squeeze(load()), i, axis=along), shape[1 - along])


def _read_hdf5(path: Path) -> dict[str | int, Any]:
    """MATLAB 7.3, or any HDF5 file of vectors. What a file takes from other files is not read: it could be any of them."""
    import h5py

    columns = Columns()
    seen: set[Any] = set()
    elsewhere: list[str] = []

    def loaded(place: str) -> np.ndarray:
        with _one_line_errors("a MATLAB file"), h5py.File(path) as file:
            return np.asarray(file[place])

    def add(name: str, item: Any) -> None:
        # groups may hold one another, or themselves
        place = h5py.h5o.get_info(item.id).addr
        if isinstance(item, h5py.Group):
            if place not in seen:
                seen.add(place)
                add_all(item, f"{name}.")
        elif item.is_virtual or item.external:
            elsewhere.append(name)
        elif item.attrs.get("MATLAB_class") == b"char":
            return
        elif item.dtype.kind in "biuf":
            _add_vectors(columns, name, item.shape, lambda place=item.name: loaded(place))
        elif h5py.check_ref_dtype(item.dtype) is not None:
            # cells, and structures of several entries
            if item.size > _MOST_COLUMNS or place in seen:
                return
            seen.add(place)
            for i, reference in enumerate(np.ravel(item[()])):
                if reference:
                    add(f"{name}[{i}]", item.file[reference])

    def add_all(group: Any, prefix: str) -> None:
        for key in group:
            if not prefix and key.startswith("#"):
                continue
            if isinstance(group.get(key, getlink=True), h5py.ExternalLink):
                elsewhere.append(f"{prefix}{key}")
            elif (item := group.get(key)) is not None:
                add(f"{prefix}{key}", item)

    with _one_line_errors("a MATLAB file"), h5py.File(path) as file:
        seen.add(h5py.h5o.get_info(file.id).addr)
        add_all(file, "")
    if elsewhere:
        columns.notes.append(f"Not read, as the data are in other files: {', '.join(elsewhere[:20])}.")
    return _require_columns(columns)


def _require_columns(columns: _ColumnsType) -> _ColumnsType:
    if not columns:
        raise InputError("holds no vectors of numbers; a log needs them")
    return columns
