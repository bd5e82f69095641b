"""A part: the file of a chunk, with its rows, a header that names study and chunk, and a checksum of the whole file.

A part is only read if it is what was written, however old it is and wherever it was copied from.
"""

import json
import zlib
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from jaxbl.files import catch_store_errors, is_remote, write_atomic
from jaxbl.json_types import JsonObject

_KEY, _SUM, _NO_SUM = b"jaxbl.part", b"jaxbl.checksum", b"00000000"
"""Keys of the file's metadata: the header as JSON, and the checksum of the file in which eight zeros stand in its place."""


class Damaged(Exception):
    """A part that is not what was written. The message says how."""


class PartHeader(NamedTuple):
    """The header of a part.

    Attributes:
        study: identity of the study for its command and for a single run, and its title
            (:func:`jaxbl.sweeps.store.study_head`).
        layout: seeds and points of a chunk.
        backend: backend that computed the study.
        chunk: index of the chunk.
    """

    study: JsonObject
    layout: dict[str, int]
    backend: str
    chunk: int


def write_part(path: Path, frame: pd.DataFrame, header: PartHeader) -> None:
    """Write a part atomically."""
    # from arrays: pyarrow takes three times as long for a frame
    table = pa.table(
        {str(name): pa.array(values.to_numpy(), from_pandas=True) for name, values in frame.items()},
        metadata={_KEY: json.dumps(header._asdict()).encode(), _SUM: _NO_SUM},
    )
    file = BytesIO()
    # dictionaries of values that hardly repeat would take most of the time
    pq.write_table(table, file, write_page_checksum=True, use_dictionary=False)
    content = bytearray(file.getbuffer())
    place, checksum = _checksum(content)
    content[place : place + len(_NO_SUM)] = checksum
    write_atomic(path, content)


def _checksum(content: bytes | bytearray) -> tuple[int, bytes]:
    """Return the place of a file's checksum and what it should be: CRC-32, which detects damage, not forgery."""
    # after the key come the type and the length of the value
    place = content.rfind(_SUM) + len(_SUM) + 2
    start = zlib.crc32(_NO_SUM, zlib.crc32(memoryview(content)[:place]))
    return place, b"%08x" % zlib.crc32(memoryview(content)[place + len(_NO_SUM) :], start)


def read_part(path: Path, columns: Sequence[str] | None = None, *, check: bool = True) -> tuple[PartHeader, pd.DataFrame]:
    """Read header and rows of a part.

    Args:
        path: the file.
        columns: names of columns; left out, all; with `()`, the header alone is read.
        check: read the whole file first, and compare it with its checksum; otherwise only pages are compared with theirs.

    Raises:
        Damaged: the file is not what was written.
        FileNotFoundError: there is none.
    """
    try:
        # opened here, as the library takes names in UTF-8 alone
        source = BytesIO(_read_checked(path)) if check or is_remote(path) else path.open("rb")
        with source, pq.ParquetFile(source, page_checksum_verification=True) as file:
            header = json.loads((file.schema_arrow.metadata or {})[_KEY])
            frame = pd.DataFrame() if columns == () else file.read(columns=columns).to_pandas()
            return PartHeader(**header), frame
    except FileNotFoundError:
        raise
    except (OSError, ValueError, KeyError, TypeError, MemoryError, pa.ArrowException) as error:
        reason = str(error).strip().partition("\n")[0][:120] or type(error).__name__
        raise Damaged(f"cannot be read ({reason})") from None


def _read_checked(path: Path) -> bytes:
    """Read a file whose checksum is right."""
    if is_remote(path) and not path.exists():
        raise FileNotFoundError(path)
    with catch_store_errors(path, "read"):
        content = path.read_bytes()
    place, checksum = _checksum(content)
    if _SUM not in content:
        raise Damaged("has no header that names its study and chunk")
    if content[place : place + len(checksum)] != checksum:
        raise Damaged("does not agree with its checksum")
    return content
