"""A study in a browser: what its page needs, and single runs of it."""

import re
import threading
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from jaxbl.config import Config, is_boolean, read_config, with_values
from jaxbl.errors import InputError
from jaxbl.files import check_result, checksum, read_result
from jaxbl.json_types import JsonObject
from jaxbl.report.checks import has_words
from jaxbl.report.maps import axis_words, drawn_values, value_label
from jaxbl.report.panels import MAP, pack_numbers
from jaxbl.report.simulate import error_path
from jaxbl.report.sweep import answer_sweep
from jaxbl.sweeps.metrics import is_magnitude
from jaxbl.sweeps.store import Store, identity
from jaxbl.sweeps.sweep import StudyResult, open_study
from jaxbl.sweeps.trial import run, run_perturbed

from .folder import Source, colours_of, drawable, write_page, write_points
from .grid import dimensions, write_grid
from .log import observer_errors


def study_source(folder: str | Path, sentences: Sequence[str] = ()) -> Source:
    """A study's folder, to be explored. Raises `InputError` where it holds no study.

    Args:
        folder: as `jaxbl sweep` left it.
        sentences: those that stand before the study's own.
    """
    result = open_study(folder)
    # single runs share the machine's cores with one another already
    one_at_a_time = threading.Lock()

    def write(out: Path, served: bool) -> bool:
        now = open_study(folder)
        return write_study(now, out, [*sentences, *_lead(now)], served=served)

    def answer(to: Callable[[Config, Any], JsonObject], asked: Any) -> JsonObject:
        with one_at_a_time:
            return to(result.config, asked)

    answers = {"simulated": partial(answer, simulate_point), "nearby": partial(answer, simulate_nearby)}
    first = {axis.path: axis.start if axis.values is None else axis.values[0] for axis in result.config.axes}
    return Source(
        identity(result.config),
        [*sentences, *_lead(result)],
        write,
        answers,
        partial(answers["simulated"], {"values": first, "seed": 0}),
        one_at_a_time.acquire,
    )


def comparison_source(file: Path, _: str, sentences: Sequence[str]) -> Source:
    """Two sweeps at their common points, by `comparison.json`: both, and what the second one is of the first; with the
    sentences of its page.

    Raises:
        InputError: files are damaged or missing, or no point is common.
    """
    summary, folder = read_result(file), file.parent
    config = read_config(check_result(folder / "study.toml"))
    if not summary["points"]["both"]:
        raise InputError(f"{folder}: no point is in both studies: there is nothing to show")
    config = config.with_keys("sweep", seeds=1)
    names = [Path(name).name for name in summary["names"]]

    def write(out: Path, served: bool) -> bool:
        frame = pd.read_parquet(check_result(folder / "comparison.parquet")).assign(
            seed=config.sweep.first_seed, finite=True
        )
        return write_study(StudyResult(config, frame), out, sentences, studies=names)

    return Source(checksum(file.read_bytes()), sentences, write)


def _lead(result: StudyResult) -> list[str]:
    """The answer, and the study's notes; of a sweep at work no figures, which would be out of date on the page."""
    if not isinstance(result.source, Store) or result.source.manifest["finished"]:
        return answer_sweep(result).sentences
    return ["This sweep is unfinished: the page shows the runs so far.", *result.config.notes]


def write_study(
    result: StudyResult, out: Path, lead: Sequence[str], *, served: bool = False, studies: Sequence[str] = ()
) -> bool:
    """Write the page of a study and its data into a folder: maps of a grid, points of other studies.

    Args:
        result: a study; of an unfinished one, what is there.
        out: an empty folder.
        lead: what was found, in sentences.
        served: whether a server is to give the data, and simulates runs.
        studies: names of two studies that are compared, whose columns end with `.first`, `.second` and `.factor`.

    Returns:
        Whether runs are still to come.
    """
    config = result.config
    content: JsonObject = _about(config, result.columns, studies) | {"lead": lead}
    names = [metric["name"] for metric in content["metrics"]]
    dims = dimensions(config)
    content |= write_cloud(result, names, out) if dims is None else write_grid(result, names, content["first"], out, dims)
    (out / "study.toml").write_text(content["config"], encoding="utf-8")
    write_page(out, ("study", "runs", "views"), content, served=served)
    return not result.is_finished(content["found"])


def write_cloud(result: StudyResult, metrics: list[str], out: Path) -> JsonObject:
    """Write `points.parquet`, part by part, and return what the page says of it: axes as float64, of words their place in
    `words`; metrics as float32.

    Args:
        result: a study; of an unfinished one, what is there.
        metrics: columns that are kept.
        out: folder.
    """
    config = result.config
    words = {axis.path: list(axis.values or ()) for axis in config.axes if has_words(axis)}
    types = dict.fromkeys([*config.axis_paths, "seed"], np.float64) | dict.fromkeys(metrics, np.float32)

    def page_columns(frame: pd.DataFrame) -> pd.DataFrame:
        places = {path: frame[path].map(values.index) for path, values in words.items()}
        return frame.assign(**places, **{name: drawable(drawn_values(frame, name)) for name in metrics})

    rows = write_points(out, types, map(page_columns, result.batches()))
    return {
        "axes": [
            axis_words(config, axis.path) | {"words": words.get(axis.path), "log": axis.scale == "log"}
            for axis in config.axes
        ],
        "rows": rows,
        "found": rows,
        "total": result.runs,
        "sampled": config.sweep.design != "grid",
    }


_MOST_SAMPLES = 20_000
"""Samples of a trace that a page draws: more than it has pixels, fewer than take time to be sent."""
_COLUMNS = (
    *("t", "u", "z", "torque"),
    *(f"{side}.{name}" for side in ("motor", "load") for name in (
        "position", "velocity", "position_estimate", "velocity_estimate", "torque_estimate", "velocity_error")),
)  # fmt: skip


def point_of(config: Config, asked: Any) -> tuple[Config, int]:
    """The study of one point without axes, figures and notes, and the seed.

    Args:
        config: the whole study.
        asked: `values`, by path of each axis, and `seed`.

    Raises:
        InputError: other values than those, or such as the study may not have.
    """
    question = asked if isinstance(asked, dict) else {}
    values, seed = question.get("values"), question.get("seed")
    paths = {*config.axis_paths}
    if not isinstance(values, dict) or set(values) != paths:
        raise InputError(f"values: should have a value of each axis: {', '.join(sorted(paths))}")
    # true is a number of Python's
    if type(seed) is not int or not 0 <= seed < 2**31:
        raise InputError("seed: should be a whole number from 0 and below 2^31")
    return with_values(config, values).model_copy(update={"axes": [], "figures": [], "notes": []}), seed


def simulate_point(config: Config, asked: Any) -> JsonObject:
    """One run of a study, for its page: metrics, traces (float32 in base64), the path of each error, the point as TOML.
    Arguments and errors as of :func:`point_of`."""
    point, seed = point_of(config, asked)
    trial = run(point, seed=seed, backend="scan")
    step = -(-len(trial.trace) // _MOST_SAMPLES)
    trace = trial.trace.assign(**observer_errors(trial.trace)).iloc[::step]
    planes = {}
    for side, judged in trial.summary["conditions"].items():
        path = error_path(trial.trace, side, judged)
        planes[side] = {
            "error": pack_numbers(drawable(path.error)),
            "slope": pack_numbers(drawable(path.slope)),
            "reach": path.reach,
            "majorant": [*map(pack_numbers, path.majorant)],
        }
    return {
        "every": step,
        "metrics": trial.summary["metrics"],
        "columns": {name: pack_numbers(drawable(trace[name])) for name in _COLUMNS if name in trace},
        "planes": planes,
        "config": point.to_toml(),
    }


_NEARBY = 6
"""Runs that show how far apart rounding brings figures."""


def simulate_nearby(config: Config, asked: Any) -> JsonObject:
    """Metrics of runs whose numbers differ from a point's in their last digits. Arguments and errors as of
    :func:`point_of`."""
    return {"metrics": run_perturbed(*point_of(config, asked), _NEARBY)}


def _about(config: Config, columns: list[str], studies: Sequence[str]) -> JsonObject:
    """The page's account of a study and its columns."""
    experiment, names = config.build(), [name for name in columns if name not in ("seed", *config.axis_paths)]
    return {
        "title": config.title or "Study",
        "metrics": [
            {"name": name, "label": _label(name, studies), "yes": is_boolean(name), "size": is_magnitude(name)}
            for name in names
        ],
        "first": next((name for name in names if re.search(r"\.velocity_rmse(\.factor)?$", name)), names[0]),
        "config": config.to_toml(),
        "file": "study.toml",
        "colours": colours_of(MAP),
        # where no axis changes them
        "gains": {side: getattr(experiment.observer, side).gains() for side in experiment.sides},
        "effects": None if studies else config.to_dict()["effects"],
    }


def _label(name: str, studies: Sequence[str]) -> str:
    """A metric in words; of two studies that are compared, which one's."""
    metric, _, end = name.rpartition(".")
    if not studies or name == "finite":
        return value_label(name)
    words = {"first": f"in {studies[0]}", "second": f"in {studies[1]}", "factor": f"{studies[1]} over {studies[0]}"}
    return f"{value_label(metric)}, {words[end]}"
