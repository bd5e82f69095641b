"""A study as a folder that a browser opens: `jaxbl explore DIR --static OUT`.

Beside the page lie `study.js` (axes, metrics, a first picture) and `points.parquet`, which the page reads column by column.
Rows are in the order of the axes, which need not be stored then. A page opened from disk may not read files: for it the same
bytes lie in scripts (`points.NNNN.js`), which it loads as it needs them.
"""

import base64
import json
import math
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from matplotlib import colormaps
from matplotlib.colors import to_hex

from jaxbl.config import Config, is_boolean, numeric_paths
from jaxbl.errors import InputError
from jaxbl.files import is_empty, json_text, make_folder, plain, writing
from jaxbl.observer.conditions import CONDITIONS
from jaxbl.sweeps.points import AxisColumns, Points
from jaxbl.sweeps.sweep import StudyResult

from .figures import MAP
from .maps import drawn_values, value_label

_GROUP = 1 << 17
"""Rows of a row group."""
_SCRIPT = 4 << 20
"""Bytes of the Parquet file in a script."""
_MARKER = "jaxbl-explorer.json"
"""Says that a folder is one of ours, which may be written anew."""
_OVERVIEW = 512
"""Cells of the overview along each axis, at most."""


def _dimensions(config: Config) -> list[AxisColumns]:
    """Axes of a grid, those that advance together as one, the seed last. Raises `InputError` where a study is none."""
    if config.sweep.refine is not None or config.sweep.design != "grid":
        kind = "refined" if config.sweep.refine is not None else "a quasi-random design"
        raise InputError(f"explore: draws maps over two axes of a grid; this study is {kind}, which 'jaxbl plot' draws")
    first = config.sweep.first_seed
    return [*Points(config).blocks, {"seed": np.arange(first, first + config.sweep.seeds)}]


def _length(dim: AxisColumns) -> int:
    return len(next(iter(dim.values())))


def _places(dim: AxisColumns, frame: pd.DataFrame) -> np.ndarray:
    """Where rows of a frame lie along a dimension."""
    if len(dim) == 1:
        ((path, values),) = dim.items()
        return pd.Index(values).get_indexer(pd.Index(frame[path]))
    return pd.MultiIndex.from_arrays([*dim.values()]).get_indexer(pd.MultiIndex.from_arrays([frame[path] for path in dim]))


def write_static(result: StudyResult, out: Path, lead: list[str]) -> Path:
    """Write the folder.

    Args:
        result: a study over a grid; of an unfinished one, what is there.
        out: folder, new or of an earlier call.
        lead: what was found, in sentences.

    Returns:
        The page to be opened.

    Raises:
        InputError: the study is no grid of at least two axes, or the folder holds something else.
    """
    config = result.config
    dims = _dimensions(config)
    if sum(_length(one) > 1 for one in dims[:-1]) < 2:
        raise InputError("explore: draws maps over two axes of a grid; this study varies fewer")
    make_folder(out)
    if not is_empty(out) and not (out / _MARKER).exists():
        raise InputError(f"{out}: is not empty, and was not written by jaxbl explore; choose another folder")
    with writing(out):
        (out / _MARKER).write_text(json_text({"made_by": "jaxbl explore"}), encoding="utf-8")
        for old in out.glob("points.*"):
            old.unlink()
        about = _about(config, dims, result.columns) | {"lead": lead} | _write_points(result, out, dims)
        (out / "study.toml").write_text(config.to_toml(), encoding="utf-8")
        (out / "study.js").write_text(f"jaxblStudy({json.dumps(about)});\n", encoding="utf-8")
        with (out / "points.parquet").open("rb") as file:
            for number, content in enumerate(iter(lambda: file.read(_SCRIPT), b"")):
                text = f'jaxblBytes({number}, "{base64.b64encode(content).decode()}");\n'
                (out / f"points.{number:04d}.js").write_text(text, encoding="ascii")
        package = files("jaxbl.report")
        for one in (package.joinpath("page.css"), *package.joinpath("explorer").iterdir()):
            (out / one.name).write_bytes(one.read_bytes())
    return out / "index.html"


def _about(config: Config, dims: list[AxisColumns], columns: list[str]) -> dict[str, Any]:
    """What the page says of a study and its columns."""
    units = numeric_paths(config)

    def axis(path: str, values: np.ndarray) -> dict[str, Any]:
        return {"path": path, "unit": units[path].unit if path in units else "", "values": plain(values)}

    return {
        "title": config.title or "Study",
        "axes": [{"paths": [axis(path, values) for path, values in one.items()]} for one in dims],
        "metrics": [
            {"name": name, "label": value_label(name), "yes": is_boolean(name)} for name in _metrics(config, columns)
        ],
        "config": config.to_toml(),
        "colours": [to_hex(one) for one in colormaps[MAP](np.linspace(0.0, 1.0, 256))],
        "conditions": _conditions(),
        "script": _SCRIPT,
    }


def _metrics(config: Config, columns: list[str]) -> list[str]:
    known = {axis.path for axis in config.axes} | {"seed"}
    return [name for name in columns if name not in known]


def _write_points(result: StudyResult, out: Path, dims: list[AxisColumns]) -> dict[str, Any]:
    """Write `points.parquet`: metrics as float32, rows in the order of the axes, nan where none is; in the memory of a part.
    Returns what the page needs to read it, and its first picture."""
    metrics = _metrics(result.config, result.columns)
    shape = [_length(one) for one in dims]
    rows, found = math.prod(shape), 0
    with TemporaryDirectory(dir=out, prefix=".draft.") as place:
        kept = {name: np.memmap(Path(place) / str(i), np.float32, "w+", shape=(rows,)) for i, name in enumerate(metrics)}
        for values in kept.values():
            values[:] = np.nan
        for frame in result.batches():
            at = np.ravel_multi_index([_places(one, frame) for one in dims], shape)
            found += len(frame)
            for name, values in kept.items():
                # what no float32 holds is as good as diverged
                shown = drawn_values(frame, name)
                values[at] = shown.where(shown.abs() < np.finfo(np.float32).max)
        _write_table(out, kept, rows)
        first = next((name for name in metrics if name.endswith(".velocity_rmse")), metrics[0])
        overview = _overview(kept[first], shape)
    size = (out / "points.parquet").stat().st_size
    return {"rows": rows, "found": found, "first": first, "overview": overview, "bytes": size}


def _write_table(out: Path, columns: Mapping[str, np.ndarray], rows: int) -> None:
    schema = pa.schema([(name, pa.float32()) for name in columns])
    with pq.ParquetWriter(out / "points.parquet", schema, use_dictionary=False) as writer:
        for start in range(0, rows, _GROUP):
            part = {name: pa.array(np.array(values[start : start + _GROUP])) for name, values in columns.items()}
            writer.write_table(pa.table(part, schema=schema), row_group_size=_GROUP)


def _overview(values: np.ndarray, shape: list[int]) -> dict[str, Any]:
    """The first picture: the map over the last two axes that vary, at the first value of the others, median over seeds."""
    y, x = [i for i, size in enumerate(shape[:-1]) if size > 1][-2:]
    index: list[Any] = [0] * len(shape)
    for i in (y, x):
        index[i] = slice(None, None, -(-shape[i] // _OVERVIEW))
    index[-1] = slice(None)
    seeds = values.reshape(shape)[tuple(index)]
    cells = pd.DataFrame(seeds.reshape(-1, shape[-1])).median(axis=1).to_numpy("<f4").reshape(seeds.shape[:-1])
    return {"x": x, "y": y, "shape": list(cells.shape), "values": base64.b64encode(cells.tobytes()).decode()}


def _conditions() -> list[dict[str, Any]]:
    """Each condition as a curve: it is homogeneous, lambda / sqrt(f) over alpha / f."""
    ratios = np.geomspace(1.0005, 2000.0, 600)
    curves = []
    for name, one in CONDITIONS.items():
        with jax.enable_x64(True):
            least = np.asarray(one.least_lambda(jnp.asarray(ratios), jnp.asarray(1.0)))
        alpha, lambda_ = ([float(f"{number:.6g}") for number in values] for values in (ratios, least))
        curves.append({"name": name, "title": one.title, "alpha": alpha, "lambda": lambda_})
    return curves
