"""A part: the file of a chunk, with its rows, a header that names study and chunk, and a checksum of each column.

A part is only read if it is what was written, however old it is and wherever it was copied from.
"""

import json
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from jaxbl.files import catch_store_errors, checksum, has_file, is_remote, open_draft
from jaxbl.json_types import JsonObject

_KEY, _SUM = b"jaxbl.part", b"jaxbl.checksum"
"""Keys of the file's metadata: the header as JSON, and its checksum."""


class Damaged(Exception):
    """A part that is not what was written. The message says how."""


class PartHeader(NamedTuple):
    """The header of a part.

    Attributes:
        study: head of the study's manifest (:func:`jaxbl.sweeps.store.manifest_head`).
        layout: seeds and points of a chunk.
        backend: backend that computed the study.
        chunk: index of the chunk.
        rows: number of runs.
        columns: checksum of each column.
    """

    study: JsonObject
    layout: dict[str, int]
    backend: str
    chunk: int
    rows: int
    columns: dict[str, str]


def write_part(path: Path, frame: pd.DataFrame, header: PartHeader) -> None:
    """Write a part atomically; number of rows and checksums of its header are those of the frame."""
    columns = {str(name): values.to_numpy() for name, values in frame.items()}
    checksums = {name: _checksum(values) for name, values in columns.items()}
    text = json.dumps(header._replace(rows=len(frame), columns=checksums)._asdict()).encode()
    # from arrays: pyarrow takes three times as long for a frame
    table = pa.table(
        {name: pa.array(values, from_pandas=True) for name, values in columns.items()},
        metadata={_KEY: text, _SUM: checksum(text).encode()},
    )
    with open_draft(path) as draft:
        # dictionaries of values that hardly repeat would take most of the time
        pq.write_table(table, draft, write_page_checksum=True, use_dictionary=False)


def read_header(path: Path) -> PartHeader:
    """Read the header of a part. Raises `Damaged` if it cannot be read, or is not what was written."""
    try:
        with _open_source(path) as file:
            metadata = pq.read_schema(file).metadata or {}
    except FileNotFoundError:
        raise
    except (OSError, ValueError, MemoryError, pa.ArrowException) as error:
        raise Damaged(f"cannot be read ({_first_line(error)})") from None
    text = metadata.get(_KEY)
    if text is None:
        raise Damaged("has no header that names its study and chunk")
    if metadata.get(_SUM) != checksum(text).encode():
        raise Damaged("its header does not agree with its checksum")
    return PartHeader(**json.loads(text))


def read_part(path: Path, columns: Sequence[str] | None = None) -> tuple[PartHeader, pd.DataFrame]:
    """Read header and rows of a part; all columns, or only those named. Raises `Damaged` where they changed since."""
    header = read_header(path)
    try:
        with _open_source(path) as source, pq.ParquetFile(source, page_checksum_verification=True) as file:
            frame = file.read(columns=columns).to_pandas()
    except (OSError, ValueError, KeyError, TypeError, MemoryError, pa.ArrowException) as error:
        raise Damaged(f"cannot be read ({_first_line(error)})") from None
    expected = [*header.columns] if columns is None else [name for name in columns if name in header.columns]
    if [*frame.columns] != expected or len(frame) != header.rows:
        raise Damaged(f"has {len(frame)} rows and {len(frame.columns)} columns, not {header.rows} and {len(expected)}")
    for name in frame.columns:
        if _checksum(frame[name].to_numpy()) != header.columns[name]:
            raise Damaged(f"column '{name}' does not agree with its checksum")
    return header, frame


@contextmanager
def _open_source(path: Path) -> Iterator[Any]:
    """The source that pyarrow reads a file from: its path, or its bytes if it is in an object store."""
    if is_remote(path):
        if not has_file(path.parent, path.name):
            raise FileNotFoundError(path)
        with catch_store_errors(path, "read"):
            content = path.read_bytes()
        yield BytesIO(content)
    else:
        yield path


def _checksum(values: np.ndarray) -> str:
    """CRC-32 of type and values: it detects damage, not forgery, in a fifth of the time of a cryptographic hash."""
    if values.dtype == object:
        return _crc(json.dumps([str(value) for value in values]).encode())
    return _crc(np.ascontiguousarray(values).view(np.uint8).data, zlib.crc32(str(values.dtype).encode()))


def file_checksum(path: Path) -> str:
    """CRC-32 of a whole file."""
    return _crc(path.read_bytes())


def _crc(content: bytes | memoryview, start: int = 0) -> str:
    return f"{zlib.crc32(content, start):08x}"


def _first_line(error: BaseException) -> str:
    return str(error).strip().partition("\n")[0][:120] or type(error).__name__
