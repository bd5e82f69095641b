"""The maps of a study over a grid: its points as an array over the axes, for a page.

Rows of `points.parquet` are in the order of the axes, which need not be stored then.
"""

import math
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np
import pandas as pd

from jaxbl.config import Config
from jaxbl.files import to_jsonable
from jaxbl.json_types import JsonObject
from jaxbl.observer.conditions import CONDITIONS
from jaxbl.report.aggregates import Groups
from jaxbl.report.gain_plane import least_lambdas
from jaxbl.report.maps import MARGINS, axis_words, best_gains, drawn_values, worst_runs
from jaxbl.report.panels import Array, pack_numbers
from jaxbl.sweeps.points import AxisColumns, Points
from jaxbl.sweeps.sweep import StudyResult

from .folder import drawable, write_points

_OVERVIEW = 512
"""Cells of the overview along each axis, at most."""


def dimensions(config: Config) -> list[AxisColumns] | None:
    """Axes of a grid, those that advance together as one, the seed last; None of a study that has no map: of fewer than two
    axes that vary, refined, or a quasi-random design."""
    if config.sweep.refine is not None or config.sweep.design != "grid":
        return None
    dims = [*Points(config).dimensions, {"seed": config.sweep.first_seed + np.arange(config.sweep.seeds)}]
    return dims if sum(_length(dim) > 1 for dim in dims[:-1]) >= 2 else None


def _length(dim: AxisColumns) -> int:
    return len(next(iter(dim.values())))


def _places(dim: AxisColumns, frame: pd.DataFrame) -> Array:
    """The places of a frame's rows along a dimension."""
    paths = [*dim]
    return pd.DataFrame(dim).set_index(paths).index.get_indexer(frame.set_index(paths).index)


def write_grid(result: StudyResult, metrics: list[str], first: str, out: Path, dims: list[AxisColumns]) -> JsonObject:
    """Write `points.parquet`: metrics as float32, rows in the order of the axes, nan where none is; in the memory of a part.
    Returns what the page says of it, and shows first.

    Args:
        result: a study over a grid; of an unfinished one, what is there.
        metrics: columns that are kept.
        first: the one that is drawn first.
        out: folder.
        dims: as of :func:`dimensions`.
    """
    axes = [
        {"paths": [axis_words(result.config, path) | {"values": to_jsonable(values)} for path, values in dim.items()]}
        for dim in dims
    ]
    shape = [_length(dim) for dim in dims]
    rows, runs = math.prod(shape), 0
    with TemporaryFile(dir=out) as file:
        numbers = np.memmap(file, np.float32, "w+", shape=(len(metrics), rows))
        numbers[:] = np.nan
        columns = dict(zip(metrics, numbers, strict=True))
        for frame in result.batches():
            places = np.ravel_multi_index([_places(dim, frame) for dim in dims], shape)
            runs += len(frame)
            for name, values in columns.items():
                values[places] = drawable(drawn_values(frame, name))
        write_points(out, dict.fromkeys(metrics, np.float32), [columns])
        x, y = _first_axes(result.config, dims)
        cells = {name: np.moveaxis(values.reshape(shape), (y, x), (-2, -1)) for name, values in columns.items()}
        telling = _most_telling(cells, first)
        return {
            "grid": True,
            "axes": axes,
            "conditions": _conditions(),
            "rows": rows,
            "found": runs,
            "total": rows,
            "start": {"x": x, "y": y, "at": _place_in_all(telling, x, y).tolist()},
            "overview": _overview(cells[first][telling]),
            "stars": _stars(cells, first, dims, x, y, telling),
        }


def _first_axes(config: Config, dims: list[AxisColumns]) -> tuple[int, int]:
    """The dimensions along x and y of the first map: those of the study's first map, gains of one side, or the last two."""
    varied = [i for i, dim in enumerate(dims[:-1]) if _length(dim) > 1]
    numbers = {path: i for i in varied for path in dims[i]}
    pairs = [(figure.x, figure.y) for figure in config.figures]
    pairs += [(f"observer.{side}.alpha", f"observer.{side}.lambda") for side in config.sides]
    for x, y in pairs:
        if x in numbers and y in numbers and numbers[x] != numbers[y]:
            return numbers[x], numbers[y]
    return varied[-1], varied[-2]


_MOST_JUDGED = 4096
"""Cells of a slice by which it is judged how telling it is."""


def _most_telling(cells: dict[str, Array], first: str) -> tuple[int, ...]:
    """The slice (places along the other dimensions, without the seed) with the clearest border between what works and what
    fails; where none has a border, that with the largest spread of the metric."""
    metric = cells[first]
    values = cells.get(f"{first.partition('.')[0]}.converged", metric)

    def rate_slice(index: tuple[int, ...]) -> tuple[float, float]:
        part = [array[(*index, 0)].reshape(-1) for array in (values, metric)]
        works, sizes = (array[:: max(array.size // _MOST_JUDGED, 1)] for array in part)
        works, sizes = works[np.isfinite(works)], np.abs(sizes[np.isfinite(sizes) & (sizes != 0.0)])
        share = float(np.mean(works)) if works.size and values is not metric else 0.0
        spread = float(np.std(np.log(sizes))) if sizes.size else 0.0
        # tenths: of slices with about the same border that with the larger spread
        return round(10.0 * min(share, 1.0 - share)), spread

    return max(np.ndindex(*values.shape[:-3]), key=rate_slice)


_MOST_STARRED = 1 << 16
"""Runs of a slice whose best gains are looked for, and slices: more would take longer than all the rest."""


def _stars(
    cells: dict[str, Array], first: str, dims: list[AxisColumns], x: int, y: int, telling: tuple[int, ...]
) -> list[list[int]]:
    """The best gains of each slice, the most telling one first: places along all dimensions; none where the first map is not
    over gains."""
    side = first.partition(".")[0]
    paths, values = zip(*(next(iter(dims[i].items())) for i in (y, x)), strict=True)
    shape = cells[first].shape
    needed = [name for name in (first, "finite", *(f"{side}.{key}" for key in ("converged", *MARGINS))) if name in cells]
    gains = {f"observer.{side}.alpha", f"observer.{side}.lambda"}
    if {*paths} != gains or not {"finite", f"{side}.converged"} <= {*needed} or math.prod(shape[-3:]) > _MOST_STARRED:
        return []
    runs = pd.MultiIndex.from_product([range(shape[-3]), *values], names=["seed", *paths]).to_frame(index=False)
    stars = []
    for index in sorted(np.ndindex(*shape[:-3]), key=lambda index: index != telling)[:64]:
        frame = runs.assign(**{name: cells[name][index].ravel() for name in needed})
        if frame[["finite", f"{side}.converged"]].isna().to_numpy().any():
            continue
        worst = worst_runs(Groups([frame], paths, [*paths, "seed"]), first)
        if (best := best_gains(worst)) is not None:
            place = _place_in_all(index, x, y)
            gains_there = zip(values, worst.index[best.index], strict=True)
            place[[y, x]] = [np.flatnonzero(axis == value)[0] for axis, value in gains_there]
            stars.append(place.tolist())
    return stars


def _place_in_all(index: tuple[int, ...], x: int, y: int) -> Array:
    """The place along all dimensions of the first run of a slice."""
    return np.insert([*index, 0], [min(x, y), max(x, y) - 1], 0)


def _overview(values: Array) -> JsonObject:
    """The first picture: a map over the last two of three dimensions, median over the first, the seeds."""
    steps = [-(-size // _OVERVIEW) for size in values.shape[1:]]
    samples = np.array(values[:, :: steps[0], :: steps[1]])
    cells = pd.DataFrame(samples.reshape(len(samples), -1)).median().to_numpy().reshape(samples.shape[1:])
    return {"shape": list(cells.shape), "values": pack_numbers(cells)}


def _conditions() -> list[JsonObject]:
    """Each condition as a curve: it is homogeneous, lambda / sqrt(f) over alpha / f."""
    ratios = np.geomspace(1.0005, 2000.0, 600)
    return [
        {
            "name": name,
            "title": condition.title,
            "alpha": pack_numbers(ratios),
            "lambda": pack_numbers(least_lambdas(condition, ratios, 1.0)),
        }
        for name, condition in CONDITIONS.items()
    ]
