"""A part: the file of a chunk, with its rows, a header that names study and chunk, and a checksum of the whole file.

A part is only read if it is what was written, however old it is and wherever it was copied from.
"""

import json
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from jaxbl.errors import InputError
from jaxbl.files import DamagedFile, catch_store_errors, checksum, is_remote, write_atomic
from jaxbl.json_types import JsonObject

_KEY, _SUM, _NO_SUM = b"jaxbl.part", b"jaxbl.checksum", b"00000000"
"""Keys of the file's metadata: the header as JSON, and the checksum of the file in which eight zeros stand in its place."""


RECOMPUTE = "run 'jaxbl sweep' again, which moves it to damaged/ and computes it anew"
"""What mends a damaged part."""


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
    place, expected = _find_checksum(content)
    content[place] = expected
    write_atomic(path, content)


def _find_checksum(content: bytes | bytearray) -> tuple[slice, bytes]:
    """Return the place of a file's checksum, and what it should be."""
    # after the key come the type and the length of the value
    start = content.rfind(_SUM) + len(_SUM) + 2
    place, view = slice(start, start + len(_NO_SUM)), memoryview(content)
    return place, checksum(view[: place.start], _NO_SUM, view[place.stop :]).encode()


def read_part(path: Path, columns: Sequence[str] | None = None, *, check: bool = True) -> tuple[PartHeader, pd.DataFrame]:
    """Read header and rows of a part.

    Args:
        path: the file.
        columns: names of columns; left out, all; with `()`, the header alone is read.
        check: read the whole file first, and compare it with its checksum; otherwise only pages are compared with theirs.

    Raises:
        DamagedFile: the file is not what was written.
        FileNotFoundError: there is none.
        InputError: an object store does not answer.
    """
    try:
        # opened here, as the library takes names in UTF-8 alone
        source = BytesIO(read_checked(path)) if check or is_remote(path) else path.open("rb")
        with source, pq.ParquetFile(source, page_checksum_verification=True) as file:
            header = json.loads((file.schema_arrow.metadata or {})[_KEY])
            return PartHeader(**header), file.read(columns=columns).to_pandas()
    except (FileNotFoundError, InputError):
        raise
    except (OSError, ValueError, KeyError, TypeError, MemoryError, pa.ArrowException) as error:
        reason = str(error).strip().partition("\n")[0][:120] or type(error).__name__
        raise DamagedFile(path, f"cannot be read ({reason})", RECOMPUTE) from None


def read_checked(path: Path) -> bytes:
    """Read a file whose checksum is right. Raises as :func:`read_part`."""
    if is_remote(path) and not path.exists():
        raise FileNotFoundError(path)
    with catch_store_errors(path, "read"):
        content = path.read_bytes()
    if _SUM not in content:
        raise DamagedFile(path, "has no header that names its study and chunk", RECOMPUTE)
    place, expected = _find_checksum(content)
    if content[place] != expected:
        raise DamagedFile(path, "does not agree with its checksum", RECOMPUTE)
    return content
