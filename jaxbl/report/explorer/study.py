"""A study as maps in a browser: what its page needs, and single runs of it.

Rows of `points.parquet` are in the order of the axes, which need not be stored then.
"""

import math
import threading
from collections.abc import Mapping, Sequence
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

from jaxbl.config import Config, is_boolean, numeric_paths, with_values
from jaxbl.errors import InputError
from jaxbl.files import plain
from jaxbl.observer.conditions import CONDITIONS
from jaxbl.report.error_plane import error_path
from jaxbl.report.figures import MAP
from jaxbl.report.maps import drawn_values, value_label
from jaxbl.report.sweep import headline
from jaxbl.sweeps.metrics import is_magnitude
from jaxbl.sweeps.points import AxisColumns, Points
from jaxbl.sweeps.sweep import StudyResult, open_study
from jaxbl.sweeps.trial import run

from .folder import Source, encoded, write_page

_GROUP = 1 << 17
"""Rows of a row group."""
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


def check_grid(config: Config) -> list[AxisColumns]:
    """The dimensions of a study that can be drawn as maps. Raises `InputError` where it is no grid of at least two axes."""
    dims = _dimensions(config)
    if sum(_length(one) > 1 for one in dims[:-1]) < 2:
        raise InputError("explore: draws maps over two axes of a grid; this study varies fewer")
    return dims


def study_source(folder: str | Path) -> Source:
    """A study's folder, to be explored. Raises `InputError` where it is no grid of at least two axes, or no study."""
    result = open_study(folder)
    dims = check_grid(result.config)
    # single runs share the machine's cores with one another already
    one_at_a_time = threading.Lock()

    def write(out: Path, served: bool) -> bool:
        now = open_study(folder)
        return write_study(now, out, headline(now), served=served)

    def answer(asked: Any) -> dict[str, Any]:
        with one_at_a_time:
            return simulated(result.config, dims, asked["at"] if isinstance(asked, dict) and "at" in asked else ())

    return Source(headline(result), write, {"run": answer}, lambda: answer({"at": [0] * len(dims)}))


def write_study(result: StudyResult, out: Path, lead: Sequence[str], *, served: bool = False) -> bool:
    """Write the page of a study and its data into a folder.

    Args:
        result: a study over a grid; of an unfinished one, what is there.
        out: an empty folder.
        lead: what was found, in sentences.
        served: whether a server is to give the data, and simulates runs.

    Returns:
        Whether runs are still to come.

    Raises:
        InputError: the study is no grid of at least two axes.
    """
    config, dims = result.config, check_grid(result.config)
    about = _about(config, dims, result.columns) | {"lead": list(lead), "served": served} | _write_points(result, out, dims)
    (out / "study.toml").write_text(config.to_toml(), encoding="utf-8")
    write_page(out, "study.html", about, ("map.js", "runs.js"), scripts=not served)
    return about["found"] < about["rows"]


_MOST_SAMPLES = 20_000
"""Samples of a trace that a page draws: more than it has pixels, fewer than take time to be sent."""
_COLUMNS = (
    *("t", "u", "z", "torque"),
    *(f"{side}.{name}" for side in ("motor", "load") for name in (
        "position", "velocity", "position_estimate", "velocity_estimate", "torque_estimate")),
)  # fmt: skip


def point_at(config: Config, dims: list[AxisColumns], at: Sequence[int]) -> tuple[Config, int]:
    """The study of one point without axes and figures, and the seed, by indices along :func:`check_grid`'s dimensions.
    Raises `InputError` for indices that there are none of."""
    sizes = [_length(one) for one in dims]
    at = at if isinstance(at, list) else []
    if len(at) != len(sizes) or not all(isinstance(i, int) and 0 <= i < size for i, size in zip(at, sizes, strict=False)):
        raise InputError(f"at: should be {len(sizes)} whole numbers, each from 0 and below {sizes}")
    values = {path: plain(column[i]) for one, i in zip(dims, at, strict=True) for path, column in one.items()}
    seed = int(values.pop("seed"))
    return with_values(config, values).model_copy(update={"axes": [], "figures": []}), seed


def simulated(config: Config, dims: list[AxisColumns], at: Sequence[int]) -> dict[str, Any]:
    """One run of a study, for its page: metrics, traces (float32 in base64), the path of each error, the point as TOML.

    Args:
        config, dims: the study, and what :func:`check_grid` gives for it.
        at: index along each dimension, the seed last.

    Raises:
        InputError: indices that there are none of.
    """
    point, seed = point_at(config, dims, at)
    trial = run(point, seed=seed, backend="scan")
    every = -(-len(trial.trace) // _MOST_SAMPLES)
    trace = trial.trace.iloc[::every]
    planes = {side: error_path(trial.trace, side, found) for side, found in trial.summary["conditions"].items()}
    varied = [(path, column[i]) for one, i in zip(dims, at, strict=True) if _length(one) > 1 for path, column in one.items()]
    return {
        "name": ", ".join(f"{path.removeprefix('observer.')} {value:.4g}" if isinstance(value, float | np.floating)
                          else f"{path} {value}" for path, value in varied),
        "seed": seed,
        "every": every,
        "metrics": trial.summary["metrics"],
        "columns": {name: encoded(trace[name]) for name in _COLUMNS if name in trace},
        "planes": {
            side: {"error": encoded(one.error), "slope": encoded(one.slope),
                   "majorant": [encoded(part) for part in one.majorant] if len(one.majorant[0]) else None}
            for side, one in planes.items()
        },
        "config": point.to_toml(),
    }  # fmt: skip


def _about(config: Config, dims: list[AxisColumns], columns: list[str]) -> dict[str, Any]:
    """What the page says of a study and its columns."""
    units = numeric_paths(config)

    def axis(path: str, values: np.ndarray) -> dict[str, Any]:
        return {"path": path, "unit": units[path].unit if path in units else "", "values": plain(values)}

    return {
        "title": config.title or "Study",
        "axes": [{"paths": [axis(path, values) for path, values in one.items()]} for one in dims],
        "metrics": [
            {"name": name, "label": value_label(name), "yes": is_boolean(name), "size": is_magnitude(name)}
            for name in _metrics(config, columns)
        ],
        "config": config.to_toml(),
        "colours": [to_hex(one) for one in colormaps[MAP](np.linspace(0.0, 1.0, 256))],
        "conditions": _conditions(),
        "gains": _gains(config),
    }


def _gains(config: Config) -> dict[str, Any]:
    """Gains of each side's observer, where no axis changes them."""
    experiment = config.build()
    sides = {side: getattr(experiment.observer, side) for side in experiment.sides}
    return {side: {"lambda": float(one.lambda_), "alpha": float(one.alpha)} for side, one in sides.items()}


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
    return {"rows": rows, "found": found, "first": first, "overview": overview}


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
    cells = pd.DataFrame(seeds.reshape(-1, shape[-1])).median(axis=1).to_numpy().reshape(seeds.shape[:-1])
    return {"x": x, "y": y, "shape": list(cells.shape), "values": encoded(cells)}


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
