"""The maps of a study over a grid: its points as an array over the axes, for a page.

Rows of `points.parquet` are in the order of the axes, which need not be stored then.
"""

import math
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd

from jaxbl.config import Config
from jaxbl.files import to_jsonable
from jaxbl.json_types import JsonObject
from jaxbl.observer.conditions import CONDITIONS
from jaxbl.report.gain_plane import least_lambdas
from jaxbl.report.maps import unit_of
from jaxbl.report.panels import packed
from jaxbl.sweeps.points import AxisColumns, Points
from jaxbl.sweeps.sweep import StudyResult

from .folder import ROW_GROUP, page_values, points_writer

Array = np.ndarray

_OVERVIEW = 512
"""Cells of the overview along each axis, at most."""


def dimensions(config: Config) -> list[AxisColumns] | None:
    """Axes of a grid, those that advance together as one, the seed last; None of a study that has no map: of fewer than two
    axes that vary, refined, or a quasi-random design."""
    if config.sweep.refine is not None or config.sweep.design != "grid":
        return None
    first = config.sweep.first_seed
    dims = [*Points(config).dimensions, {"seed": np.arange(first, first + config.sweep.seeds)}]
    return dims if sum(_length(dim) > 1 for dim in dims[:-1]) >= 2 else None


def _length(dim: AxisColumns) -> int:
    return len(next(iter(dim.values())))


def _places(dim: AxisColumns, frame: pd.DataFrame) -> Array:
    """The places of a frame's rows along a dimension."""
    if len(dim) == 1:
        ((path, values),) = dim.items()
        return pd.Index(values).get_indexer(pd.Index(frame[path]))
    values, rows = (pd.MultiIndex.from_arrays([table[path] for path in dim]) for table in (dim, frame))
    return values.get_indexer(rows)


def write_grid(result: StudyResult, metrics: list[str], first: str, out: Path) -> JsonObject:
    """Write `points.parquet`, and return what the page says of it.

    Args:
        result: a study over a grid; of an unfinished one, what is there.
        metrics: columns that are kept.
        first: the one that is drawn first.
        out: folder.
    """
    dims = dimensions(result.config)
    assert dims is not None
    axes = [
        {
            "paths": [
                {"path": path, "unit": unit_of(result.config, path), "values": to_jsonable(values)}
                for path, values in dim.items()
            ]
        }
        for dim in dims
    ]
    return {"axes": axes, "conditions": _conditions()} | _write_points(result, metrics, first, out, dims)


def _write_points(result: StudyResult, metrics: list[str], first: str, out: Path, dims: list[AxisColumns]) -> JsonObject:
    """Write `points.parquet`: metrics as float32, rows in the order of the axes, nan where none is; in the memory of a part.
    Returns what the page needs to read it, and its first picture."""
    shape = [_length(dim) for dim in dims]
    rows, runs = math.prod(shape), 0
    with (
        TemporaryDirectory(dir=out, prefix=".draft.") as place,
        points_writer(out, dict.fromkeys(metrics, np.float32)) as write,
    ):
        columns = {name: np.memmap(Path(place) / str(i), np.float32, "w+", shape=(rows,)) for i, name in enumerate(metrics)}
        for values in columns.values():
            values[:] = np.nan
        for frame in result.batches():
            places = np.ravel_multi_index([_places(dim, frame) for dim in dims], shape)
            runs += len(frame)
            for name, values in columns.items():
                values[places] = page_values(frame, name)
        for start in range(0, rows, ROW_GROUP):
            write({name: values[start : start + ROW_GROUP] for name, values in columns.items()})
        overview = _overview(columns[first], shape)
    return {"rows": rows, "found": runs, "overview": overview}


def _overview(values: Array, shape: list[int]) -> JsonObject:
    """The first picture: the map over the last two axes that vary, at the first value of the others, median over seeds."""
    y, x = [i for i, size in enumerate(shape[:-1]) if size > 1][-2:]
    index: list[Any] = [0] * len(shape)
    for i in (y, x):
        index[i] = slice(None, None, -(-shape[i] // _OVERVIEW))
    index[-1] = slice(None)
    seeds = values.reshape(shape)[tuple(index)]
    cells = pd.DataFrame(seeds.reshape(-1, shape[-1])).median(axis=1).to_numpy().reshape(seeds.shape[:-1])
    return {"x": x, "y": y, "shape": list(cells.shape), "values": packed(cells)}


def _conditions() -> list[JsonObject]:
    """Each condition as a curve: it is homogeneous, lambda / sqrt(f) over alpha / f."""
    ratios = np.geomspace(1.0005, 2000.0, 600)
    curves = []
    for name, condition in CONDITIONS.items():
        values = ratios, least_lambdas(condition, ratios, 1.0)
        alpha, lambda_ = ([float(f"{number:.6g}") for number in numbers] for numbers in values)
        curves.append({"name": name, "title": condition.title, "alpha": alpha, "lambda": lambda_})
    return curves
