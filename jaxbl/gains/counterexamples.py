"""Runs in which a gain condition held and the observer failed: what made it fail, found by repeating them."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false

import copy
from typing import Any

import numpy as np
import pandas as pd

from jaxbl.config import Config, read_config
from jaxbl.files import to_jsonable
from jaxbl.sweeps.points import Points

from .stages import Stages

_MOST_EXPLAINED = 4096
"""Runs of a level that are repeated, spread evenly: one chunk of the scan on one device."""


def keys_of(config: Config) -> list[str]:
    """Columns that tell runs of a study apart."""
    return [*(axis.path for axis in config.axes), "seed"]


def explained(found: pd.DataFrame, study: Config, level: str, side: str, stages: Stages) -> pd.DataFrame:
    """Counterexamples of a level with a column that says what made the observer fail."""
    # a claimed bound that the true one exceeds, with the condition failing at the true one, is cause enough
    true = (found["bound"] == "true").to_numpy()
    runs = pd.MultiIndex.from_frame(found[["condition", "row"]])
    excused = ~true & ~runs.isin(runs[true])
    rest = found[~excused].drop_duplicates("row")
    causes = _causes(study, level, side, rest, stages) if len(rest) else pd.Series(dtype=object)
    cause = found["row"].map(dict(zip(rest["row"], causes, strict=True)))
    cause = cause.where(~excused, "f_plus underestimated")
    keys = keys_of(study)
    lead = ["level", "side", "condition", "bound", "cause", *keys]
    return (
        found.assign(cause=cause)
        .drop(columns="row")[[*lead, *(c for c in found.columns if c not in (*lead, "row"))]]
        .sort_values(["condition", "bound", *keys], ignore_index=True)
    )


def _mended(run: dict[str, Any], level: str) -> dict[str, dict[str, Any]]:
    """What can make a run fail, with the keys that mend it; `run` as it stands in those runs."""
    # a factor of four: enough for an error that follows duration or period to change clearly
    long, fine = 4.0 * run["duration"], run["sample_period"] / 4.0
    mended: dict[str, dict[str, Any]] = {"run too short": {"run.duration": long}}
    mended["period too long"] = {"run.sample_period": fine, "run.substeps": max(-(-run["substeps"] // 4), 1)}
    if level == "sampled":
        mended["noise"] = {"encoders.noise": 0.0, "encoders.load_noise": None}
        mended["quantisation"] = {"encoders.motor_resolution": 0.0, "encoders.load_resolution": 0.0}
        mended["explicit discretisation"] = {"observer.discretisation": "implicit"}
    return mended


def _with(tables: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """A config's tables with some dotted keys set; None removes one."""
    data = copy.deepcopy(tables)
    for path, value in values.items():
        *names, key = path.split(".")
        table = data
        for name in names:
            table = table.setdefault(name, {})
        if value is None:
            table.pop(key, None)
        else:
            table[key] = to_jsonable(value)
    return data


def _causes(study: Config, level: str, side: str, rows: pd.DataFrame, stages: Stages) -> pd.Series:
    """What made some runs fail, by experiment: each is run again with one thing mended at a time, then with all of them.

    The cause is what mended it (all such, joined by "or"), or "several" if only all together did. "f_plus underestimated":
    that did not mend it either, but showed a bound that alpha does not exceed. Else "unexplained".
    """
    kept = rows.iloc[np.unique(np.linspace(0, len(rows) - 1, _MOST_EXPLAINED).astype(int))]
    structural = list(Points(study).groups[0].structural)
    causes = pd.Series("not tried", index=rows.index, dtype=object)
    for number, (_, part) in enumerate(kept.groupby(structural, sort=False) if structural else [((), kept)]):
        name = f"{level}-{side}-{number}"
        fixed = {path: part[path].iloc[0] for path in structural}
        mended = _mended(_with(study.to_dict(), fixed)["run"], level)
        together = {path: value for change in mended.values() for path, value in change.items()}
        frames = {cause: repeated(study, part, fixed, change, stages, f"{name}-{cause}") for cause, change in mended.items()}
        mends = {cause: frame[f"{side}.converged"].to_numpy(bool) for cause, frame in frames.items() if frame is not None}
        alone = pd.Series(
            [" or ".join(cause for cause in mends if mends[cause][i]) for i in range(len(part))],
            index=part.index,
            dtype=object,
        )
        rest = part[alone == ""]
        if len(rest) and (frame := repeated(study, rest, fixed, together, stages, f"{name}-several")) is not None:
            # an observer that fails can drag its own f_plus down; where it works, alpha turns out to be too small
            low = np.where(frame[f"{side}.margin_alpha"] <= 1.0, "f_plus underestimated", "unexplained")
            alone[rest.index] = np.where(frame[f"{side}.converged"].to_numpy(bool), "several", low)
        causes[part.index] = alone
    return causes


def repeated(
    study: Config, rows: pd.DataFrame, fixed: dict[str, Any], change: dict[str, Any], stages: Stages, name: str
) -> pd.DataFrame | None:
    """Some runs once more with some keys changed, as a study of listed points; None where that changes nothing."""
    unchanged = _with(study.to_dict(), fixed)
    data = _with(unchanged, change)
    paths = [axis.path for axis in study.axes if axis.path not in fixed and axis.path not in change]
    dropped = [axis.path for axis in study.axes if axis.path in change and axis.path not in fixed]
    before, after = (read_config({**tables, "axes": []}).to_dict() for tables in (unchanged, data))
    if not dropped and before == after:
        return None
    points = rows[paths].drop_duplicates()
    data["axes"] = [{"path": path, "values": points[path].tolist(), "zip": "runs"} for path in paths]
    data["sweep"] = {key: data["sweep"][key] for key in ("seeds", "first_seed")}
    frame = stages.rerun(read_config(data), "causes", name.replace(" ", "_"))
    labels, asked = (pd.MultiIndex.from_frame(runs[[*paths, "seed"]]) for runs in (frame, rows))
    places = labels.get_indexer(asked)
    assert (places >= 0).all(), "every run was asked for"
    return frame.iloc[places]
