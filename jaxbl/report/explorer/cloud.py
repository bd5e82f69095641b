"""The points of a study that has no map: refined, a quasi-random design, or of a single axis."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from jaxbl.config import numeric_paths
from jaxbl.sweeps.sweep import StudyResult

from .folder import ROW_GROUP, page_values


def write_cloud(result: StudyResult, metrics: list[str], out: Path) -> dict[str, Any]:
    """Write `points.parquet`, part by part, and return what the page says of it: axes as float64, of words their place in
    `words`; metrics as float32.

    Args:
        result: a study; of an unfinished one, what is there.
        metrics: columns that are kept.
        out: folder.
    """
    config, units = result.config, numeric_paths(result.config)
    words = {
        axis.path: list(axis.values)
        for axis in config.axes
        if axis.values is not None and any(isinstance(value, str) for value in axis.values)
    }
    axes = [axis.path for axis in config.axes]
    schema = pa.schema([*((name, pa.float64()) for name in (*axes, "seed")), *((name, pa.float32()) for name in metrics)])
    found = 0
    with pq.ParquetWriter(out / "points.parquet", schema, use_dictionary=False) as writer:
        for frame in result.batches():
            columns = {
                path: [words[path].index(one) for one in frame[path]] if path in words else frame[path] for path in axes
            }
            columns |= {"seed": frame["seed"]} | {name: page_values(frame, name) for name in metrics}
            arrays = {
                name: np.asarray(values, float).astype(schema.field(name).type.to_pandas_dtype())
                for name, values in columns.items()
            }
            writer.write_table(pa.table(arrays, schema=schema), row_group_size=ROW_GROUP)
            found += len(frame)
    told = [
        {"path": one.path, "unit": units[one.path].unit if one.path in units else "", "words": words.get(one.path),
         "log": one.scale == "log"}
        for one in config.axes
    ]  # fmt: skip
    sampled = config.sweep.design != "grid"
    return {"axes": told, "rows": found, "found": found, "total": result.runs, "sampled": sampled}
