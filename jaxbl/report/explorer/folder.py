"""A folder that a browser opens: a page, `data.js` with what it says, and `points.parquet`, which it reads column by column.

A page opened from disk may not read files: for it the same bytes lie in scripts (`points.NNNN.js`), which it loads as it
needs them.
"""

import base64
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from matplotlib import colormaps
from matplotlib.colors import to_hex

from jaxbl.files import Subject, open_results
from jaxbl.json_types import JsonObject

_ROW_GROUP = 1 << 17
"""Rows of a row group of the Parquet file."""
_SCRIPT = 4 << 20
"""Bytes of the Parquet file in a script."""
_FILES = (
    "vendored/hyparquet.js", "vendored/uPlot.js", "shared.js", "chart.js", "explorer/page/common.js",
    "vendored/hyparquet.LICENSE.txt", "vendored/uPlot.LICENSE.txt", "vendored/uPlot.css", "page.css",
    "explorer/page/explore.css",
)  # fmt: skip
"""Of every page."""


def write_points(out: Path, types: Mapping[str, type], parts: Iterable[Any]) -> int:
    """Write columns of rows, part by part and by their NumPy types, to `points.parquet`. Returns the number of rows."""
    schema, rows = pa.schema([(name, pa.from_numpy_dtype(dtype)) for name, dtype in types.items()]), 0
    with pq.ParquetWriter(out / "points.parquet", schema, use_dictionary=False) as writer:
        for part in parts:
            table = pa.table({name: np.asarray(part[name], dtype) for name, dtype in types.items()}, schema)
            writer.write_table(table, row_group_size=_ROW_GROUP)
            rows += len(table)
    return rows


class Source(NamedTuple):
    """Results that are to be explored.

    Attributes:
        identity: what tells them from other results.
        lead: what was found, in sentences.
        write: writes page and data into an empty folder, to be served or not; says whether there is more to come.
        answers: to questions of a page that is served, by name: from what is asked to what is answered, as plain data.
            `InputError` is bad input.
        prepare: takes what time it can off the first answer.
        finish: waits for the answer that is being computed; none is computed after it.
    """

    identity: str
    lead: Sequence[str]
    write: Callable[[Path, bool], bool]
    answers: Mapping[str, Callable[[Any], Mapping[str, Any]]] = {}
    prepare: Callable[[], Any] = lambda: None
    finish: Callable[[], Any] = lambda: None


def write_static(source: Source, out: Path) -> Path:
    """Write a page and its data into a folder that is new, or of an earlier call.

    Args:
        source: what is to be explored.
        out: the folder.

    Returns:
        The page to be opened.

    Raises:
        InputError: the folder holds something else.
    """
    with (
        open_results(out, Subject("page", "of jaxbl explore", source.identity)) as results,
        results.write_files("index.html") as draft,
    ):
        source.write(draft, False)
    return out / "index.html"


def write_page(out: Path, parts: Sequence[str], content: JsonObject, *, served: bool = False) -> None:
    """Write a page into a folder that has `points.parquet`.

    Args:
        out: the folder.
        parts: of the page, by name: each has a script in `page/`; the elements of the first one load all of them.
        content: what it says, as plain data.
        served: whether a server is to give the data; else it can be opened from disk.
    """
    points = out / "points.parquet"
    data = json.dumps(content | {"served": served, "bytes": points.stat().st_size, "script": _SCRIPT})
    (out / "data.js").write_text(f"jaxblData({data});\n", encoding="utf-8")
    if not served:
        with points.open("rb") as file:
            for number, chunk in enumerate(iter(lambda: file.read(_SCRIPT), b"")):
                text = f'jaxblBytes({number}, "{base64.b64encode(chunk).decode()}");\n'
                (out / f"points.{number:04d}.js").write_text(text, encoding="ascii")
    report = files("jaxbl.report")
    for name in [*_FILES, *(f"explorer/page/{part}.js" for part in parts)]:
        original = report.joinpath(name)
        (out / original.name).write_bytes(original.read_bytes())
    page, elements = (report.joinpath(f"explorer/page/{name}.html").read_text("utf-8") for name in ("page", parts[0]))
    (out / "index.html").write_text(page.replace("{parts}", elements), encoding="utf-8")


def colours_of(name: str) -> list[str]:
    """A colour map as pages have it."""
    return [to_hex(colour) for colour in colormaps[name](np.linspace(0.0, 1.0, 256))]


def drawable(values: Any) -> np.ndarray:
    """Numbers that a page draws: what no float32 holds is as good as diverged, nan."""
    values = np.asarray(values, float)
    return np.where(np.abs(values) < np.finfo(np.float32).max, values, np.nan)
