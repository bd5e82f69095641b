"""The points of a study that has no map: refined, a quasi-random design, or of a single axis."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxbl.report.checks import has_words
from jaxbl.report.maps import axis_words
from jaxbl.sweeps.sweep import StudyResult

from .folder import page_values, points_writer


def write_cloud(result: StudyResult, metrics: list[str], out: Path) -> dict[str, Any]:
    """Write `points.parquet`, part by part, and return what the page says of it: axes as float64, of words their place in
    `words`; metrics as float32.

    Args:
        result: a study; of an unfinished one, what is there.
        metrics: columns that are kept.
        out: folder.
    """
    config, rows = result.config, 0
    words = {axis.path: list(axis.values or ()) for axis in config.axes if has_words(axis)}
    types = dict.fromkeys([*config.axis_paths, "seed"], np.float64) | dict.fromkeys(metrics, np.float32)
    with points_writer(out, types) as write:
        for frame in result.batches():
            places = {path: frame[path].map(values.index) for path, values in words.items()}
            metric_values = {name: page_values(frame, name) for name in metrics}
            write(frame.assign(**places, **metric_values))
            rows += len(frame)
    descriptions = [
        axis_words(config, axis.path) | {"words": words.get(axis.path), "log": axis.scale == "log"} for axis in config.axes
    ]
    sampled = config.sweep.design != "grid"
    return {"axes": descriptions, "rows": rows, "found": rows, "total": result.runs, "sampled": sampled}
