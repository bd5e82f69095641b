"""A study as a folder that a browser opens: `jaxbl explore DIR --static OUT`.

Beside the page lie `study.json` (axes, metrics, an overview for the first picture) and `points.parquet`, which the page reads
column by column. Of a grid the rows are in the order of its axes, so that these need not be stored. A page opened from disk
may not read files; for it the same bytes lie in scripts (`points.NNNN.js`), which it loads as it needs them.
"""

import base64
import json
import math
import shutil
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from jaxbl.config import Config, is_boolean, numeric_paths
from jaxbl.errors import InputError
from jaxbl.files import is_empty, json_text, make_folder, plain
from jaxbl.observer.conditions import CONDITIONS
from jaxbl.sweeps.metrics import metric_of
from jaxbl.sweeps.sweep import StudyResult

_GROUP = 1 << 17
"""Rows of a row group."""
_SCRIPT = 4 << 20
"""Bytes of the Parquet file in a script."""
_MARKER = "jaxbl-explorer.json"
"""Says that a folder is one of ours, which may be written anew."""
_OVERVIEW = 512
"""Cells of the overview along each axis, at most."""


class Dimension(NamedTuple):
    """Axes of a grid that advance together, and their values."""

    values: dict[str, np.ndarray]

    @property
    def size(self) -> int:
        return len(next(iter(self.values.values())))

    def index(self, frame: Any) -> np.ndarray:
        """Where rows of a frame lie along it."""
        names = list(self.values)
        known = {key: i for i, key in enumerate(zip(*(self.values[name].tolist() for name in names), strict=True))}
        return np.array([known[key] for key in zip(*(frame[name].tolist() for name in names), strict=True)])


def dimensions(config: Config) -> list[Dimension]:
    """Those of a grid, seeds last."""
    found: dict[str, dict[str, np.ndarray]] = {}
    for axis in config.axes:
        found.setdefault(axis.zip or axis.path, {})[axis.path] = np.asarray(axis.grid())
    first = config.sweep.first_seed
    seeds = np.arange(first, first + config.sweep.seeds)
    return [Dimension(values) for values in (*found.values(), {"seed": seeds})]


def write_static(result: StudyResult, out: Path, title: str, lead: list[str]) -> list[Path]:
    """Write the folder. Returns its page and the files beside it.

    Raises:
        InputError: the folder holds something else.
    """
    make_folder(out)
    if not is_empty(out) and not (out / _MARKER).exists():
        raise InputError(f"{out}: is not empty, and no folder of jaxbl explore; choose another one")
    (out / _MARKER).write_text(json_text({"made_by": "jaxbl explore"}), encoding="utf-8")
    for old in out.glob("points.*"):
        old.unlink()
    about = write_data(result, out, title, lead)
    (out / "study.js").write_text(f"jaxblStudy({json.dumps(about, ensure_ascii=True)});\n", encoding="utf-8")
    with (out / "points.parquet").open("rb") as file:
        for number, content in enumerate(iter(lambda: file.read(_SCRIPT), b"")):
            text = f'jaxblBytes({number}, "{base64.b64encode(content).decode()}");\n'
            (out / f"points.{number:04d}.js").write_text(text, encoding="ascii")
    for one in files("jaxbl.explorer").joinpath("web").iterdir():
        shutil.copyfile(str(one), out / one.name)
    return [out / "index.html", *sorted(out.glob("points.*"))]


def write_data(result: StudyResult, out: Path, title: str, lead: list[str]) -> dict[str, Any]:
    """Write `points.parquet`. Returns what the page needs to know of it."""
    config = result.config
    gridded = config.sweep.design == "grid" and config.sweep.refine is None
    paths = [axis.path for axis in config.axes]
    metrics = [name for name in result.columns if name not in (*paths, "seed")]
    units = numeric_paths(config)
    dims = dimensions(config)
    about: dict[str, Any] = {
        "title": title,
        "lead": lead,
        "grid": gridded,
        "axes": [
            {
                "paths": [
                    {"path": path, "unit": units[path].unit if path in units else "", "values": plain(values)}
                    for path, values in one.values.items()
                ]
            }
            for one in dims
        ],
        "metrics": [_metric(name) for name in metrics],
        "config": config.to_toml(),
        "colours": _colours(),
        "conditions": _conditions(),
        "script": _SCRIPT,
    }
    if gridded:
        about |= _write_grid(result, out, dims, metrics)
    else:
        about |= _write_points(result, out, [*paths, "seed"], metrics)
    about["bytes"] = (out / "points.parquet").stat().st_size
    return about


def _metric(name: str) -> dict[str, Any]:
    about = metric_of(name)
    side, _, _ = name.rpartition(".")
    return {"name": name, "label": f"{side}: {about.label}" if side else about.label, "unit": about.unit, "yes": is_boolean(name)}


def _write_grid(result: StudyResult, out: Path, dims: list[Dimension], metrics: list[str]) -> dict[str, Any]:
    """Rows in the order of the axes, a point that is not there yet as nan; in the memory of one part."""
    shape = [one.size for one in dims]
    rows = math.prod(shape)
    with TemporaryDirectory(dir=out, prefix=".draft.") as place:
        kept = {name: np.memmap(Path(place) / str(i), np.float32, "w+", shape=(rows,)) for i, name in enumerate(metrics)}
        for values in kept.values():
            values[:] = np.nan
        found = 0
        for frame in result.batches():
            at = np.ravel_multi_index([one.index(frame) for one in dims], shape)
            found += len(frame)
            for name, values in kept.items():
                values[at] = frame[name].to_numpy(float)
        _write_table(out, ((name, kept[name]) for name in metrics), rows)
        first = next((name for name in metrics if name.endswith(".velocity_rmse")), metrics[0])
        overview = _overview(kept[first], shape)
    return {"rows": rows, "found": found, "first": first, "overview": overview}


def _write_points(result: StudyResult, out: Path, paths: list[str], metrics: list[str]) -> dict[str, Any]:
    """Rows as they are stored, with the axes as columns; words by their number."""
    frame = result.read([*paths, *metrics])
    columns = [(name, frame[name].to_numpy()) for name in paths if frame[name].dtype != object]
    columns += [(name, frame[name].to_numpy(np.float32)) for name in metrics]
    _write_table(out, iter(columns), len(frame))
    first = next((name for name in metrics if name.endswith(".velocity_rmse")), metrics[0])
    return {"rows": len(frame), "found": len(frame), "first": first, "overview": None}


def _write_table(out: Path, columns: Iterator[tuple[str, np.ndarray]], rows: int) -> None:
    arrays = dict(columns)
    schema = pa.schema([(name, pa.from_numpy_dtype(values.dtype)) for name, values in arrays.items()])
    with pq.ParquetWriter(out / "points.parquet", schema, use_dictionary=False) as writer:
        for start in range(0, rows, _GROUP):
            part = {name: pa.array(np.asarray(values[start : start + _GROUP])) for name, values in arrays.items()}
            writer.write_table(pa.table(part, schema=schema), row_group_size=_GROUP)


def _overview(values: np.ndarray, shape: list[int]) -> dict[str, Any] | None:
    """The map over the last two axes at the first value of the others and the first seed: the first picture."""
    axes = [i for i, size in enumerate(shape[:-1]) if size > 1]
    if len(axes) < 2:
        return None
    y, x = axes[-2:]
    whole = values.reshape(shape)
    index: list[Any] = [0] * len(shape)
    index[y] = slice(None, None, -(-shape[y] // _OVERVIEW))
    index[x] = slice(None, None, -(-shape[x] // _OVERVIEW))
    cells = np.asarray(whole[tuple(index)], np.float32)
    return {"x": x, "y": y, "shape": list(cells.shape), "values": base64.b64encode(cells.astype("<f4").tobytes()).decode()}


def _colours() -> list[str]:
    return [mpl.colors.to_hex(one) for one in mpl.colormaps["viridis"](np.linspace(0.0, 1.0, 256))]


def _conditions() -> list[dict[str, Any]]:
    """Each condition as a curve: it is homogeneous, lambda / sqrt(f) over alpha / f."""
    import jax
    import jax.numpy as jnp

    ratios = np.geomspace(1.0005, 2000.0, 600)
    with jax.enable_x64(True):
        return [
            {
                "name": name,
                "title": one.title,
                "alpha": [float(f"{ratio:.6g}") for ratio in ratios],
                "lambda": [float(f"{least:.6g}") for least in np.asarray(one.least_lambda(jnp.asarray(ratios), jnp.asarray(1.0)))],
            }
            for name, one in CONDITIONS.items()
        ]
