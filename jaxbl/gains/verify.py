"""Gain conditions against what observers do: the function behind `jaxbl verify`.

Three levels. "normalised": the error system (34) with f_plus = 1 under its worst disturbance, over a plane of alpha / f_plus
and lambda / sqrt(f_plus). "drive": the study's points with ideal encoders and the implicit observer, each judged at the
true f_plus along its run. "sampled": the study as it stands, with its period, quantisation and noise.
"""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from jaxbl.cluster import Scheduler
from jaxbl.config import Config, read_config
from jaxbl.errors import InputError
from jaxbl.files import to_jsonable, write_atomic, write_table
from jaxbl.sweeps.metrics import ROUNDING, no_disturbance_error
from jaxbl.sweeps.points import Points
from jaxbl.sweeps.programs import Backend
from jaxbl.workers import Progress

from .below_bound import converged_below
from .counterexamples import explained, keys_of
from .error_system import (
    SWITCHING_LIMIT,
    Normalised,
    counted,
    demanded_lambda,
    judge_error_system,
    simulate_error_system,
)
from .marks import judge_marks
from .rules import judge_rules
from .stages import Stages, stages_in

_MOST_LISTED = 200
"""Counterexamples in `verdict.json`: what a reader may look through; the Parquet file has all."""


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What a verification found.

    Attributes:
        config: the study.
        summary: as in `verdict.json`.
        normalised: the error system's map and boundaries.
        levels: frames of "drive" and "sampled": the points of a sweep with their metrics.
        counterexamples: runs in which a condition held and the observer failed: level, side, condition, bound ("true" or
            "claimed"), cause, then all axis values, seed and metrics.
        scanned: what the fused loop did not know of runs that this call scanned in its place.
    """

    config: Config
    summary: dict[str, Any]
    normalised: Normalised
    levels: dict[str, pd.DataFrame]
    counterexamples: pd.DataFrame
    fallback_reasons: tuple[str, ...] = ()


def verify(
    study: str | Path | Mapping[str, Any] | Config,
    out: str | Path | None = None,
    *,
    progress: Progress | None = None,
    devices: list[Any] | None = None,
    overwrite: bool = False,
    backend: Backend | None = None,
    scheduler: Scheduler = None,
) -> Verdict:
    """Check every gain condition on three levels, and list where it held and the observer failed all the same.

    `out`, `progress`, `devices`, `overwrite`, `backend` and `scheduler` are as in :func:`jaxbl.sweep`, over the runs of the
    study's levels; the folder gets `verdict.json` and `counterexamples.parquet` as well.

    Args:
        study: TOML file, mapping or config, with axes over alpha and lambda of an observer or both.

    Raises:
        InputError: wrong config, no axes over the gains, a folder that holds something else, or a backend that cannot run
            the study.
    """
    config = read_config(study)
    sides = judged_sides(config)
    given = {"progress": progress, "devices": devices, "overwrite": overwrite, "backend": backend}
    with stages_in(config, "verify", out, scheduler, **given) as stages:
        return _verified(config, sides, stages)


def _verified(config: Config, sides: list[str], stages: Stages) -> Verdict:
    stages.keep()
    studies = {"drive": _ideal(config), "sampled": _only(config)}
    stages.total = sum(len(Points(study)) * study.sweep.seeds for study in studies.values())
    normalised = simulate_error_system(config, stages)
    levels = {}
    for level, study in studies.items():
        levels[level] = frame = stages.run(study, level).frame
        for side in sides:
            size = frame[f"{side}.f_plus_acceleration"].max()
            if frame[f"{side}.f_plus"].max() <= ROUNDING[config.run.precision] * size:
                raise no_disturbance_error(side)
    summaries, found = [judge_error_system(config, normalised)], []
    for level, frame in levels.items():
        for side in sides:
            summary, counterexamples = _judge(config, level, side, frame)
            if len(counterexamples):
                counterexamples = explained(counterexamples, studies[level], level, side, stages)
                runs = counterexamples.drop_duplicates(["bound", *keys_of(studies[level])])
                summary["causes"] = {bound: part.cause.value_counts().to_dict() for bound, part in runs.groupby("bound")}
            if level == "drive":
                summary["below_f_plus"] = converged_below(studies[level], side, frame)
            summaries.append(summary)
            found.append(counterexamples)
    every = pd.concat(found, ignore_index=True)
    true = every[every["bound"] == "true"]
    summary = to_jsonable(
        {
            "title": config.title,
            "q": config.verify.q,
            "levels": summaries,
            "closed_form": {
                "cells": normalised.ratio.size,
                "largest_difference": normalised.difference,
                "switching_limit": SWITCHING_LIMIT,
            },
            "damping": [
                {"damping": damping, "alpha_ratio": normalised.alpha, "least_lambda_ratio": boundary}
                for damping, boundary in normalised.damped.items()
            ],
            "rules": judge_rules(normalised.alpha, normalised.lambda_, normalised.ratio),
            "marks": judge_marks(config, studies["drive"], stages),
            "counterexamples": true.head(_MOST_LISTED).to_dict("records"),
            "counterexamples_in_all": len(true),
        }
    )
    if stages.folder is not None:
        write_table(stages.folder.parent / "counterexamples.parquet", every)
        write_atomic(stages.folder.parent / "verdict.json", json.dumps(summary, indent=1, ensure_ascii=False))
    return Verdict(config, summary, normalised, levels, every, tuple(stages.fallback_reasons))


def judged_sides(config: Config) -> list[str]:
    """The sides whose gains are both on axes. Raises `InputError` where there is none."""
    paths = {axis.path for axis in config.axes}
    sides = [side for side in ("motor", "load") if {f"observer.{side}.alpha", f"observer.{side}.lambda"} <= paths]
    if not sides:
        raise InputError(
            "axes: verify needs axes over both gains of an observer, such as observer.motor.alpha and observer.motor.lambda"
        )
    if config.sweep.design != "grid" or config.sweep.refine is not None:
        key = "refine" if config.sweep.refine is not None else "design"
        raise InputError(f"sweep.{key}: verify seeks the least lambda that works in every column of a whole grid; remove it")
    for i, axis in enumerate(config.axes):
        if axis.zip is not None and axis.path in {f"observer.{side}.lambda" for side in sides}:
            raise InputError(
                f"axes[{i}].zip: verify seeks the least lambda that works, everything else being equal; "
                f"{axis.path} should not be zipped"
            )
    return sides


def _only(config: Config, **updates: Any) -> Config:
    """The study without what its runs do not depend on, and with other tables."""
    data = config.to_dict()
    for key in ("figures", "verify"):
        data.pop(key, None)
    data |= updates
    # what is judged needs metrics of its own
    data["sweep"].pop("metrics", None)
    return read_config(data)


def _ideal(config: Config) -> Config:
    """The study with ideal encoders and the implicit observer, at one seed."""
    observer = config.to_dict()["observer"] | {"discretisation": "implicit"}
    dropped = ("encoders.", "observer.discretisation", "run.sample_period", "run.substeps")
    axes = [axis.model_dump(exclude_none=True) for axis in config.axes if not axis.path.startswith(dropped)]
    labels = [axis.get("zip") for axis in axes]
    for axis in axes:
        if "zip" in axis and labels.count(axis["zip"]) == 1:
            del axis["zip"]
            if "values" in axis:
                axis["values"] = list(dict.fromkeys(axis["values"]))
    swept = config.to_dict()["sweep"] | {"seeds": 1}
    return _only(config, encoders={}, observer=observer, axes=axes, sweep=swept)


def _judge(config: Config, level: str, side: str, frame: pd.DataFrame) -> tuple[dict[str, Any], pd.DataFrame]:
    """Count a level's runs by condition, at the true bound and at the claimed one; and the counterexamples."""
    path = f"observer.{side}.lambda"
    lambda_, alpha = (frame[f"observer.{side}.{gain}"].to_numpy(float) for gain in ("lambda", "alpha"))
    converged = frame[f"{side}.converged"].to_numpy(bool)
    bounds = {"true": f"{side}.f_plus", "claimed": f"{side}.f_plus_acceleration"}
    # the least lambda that worked, everything else being equal
    others = [key for key in keys_of(config) if key != path and key in frame]
    first = frame[converged].groupby(others, sort=False)[path].idxmin().to_numpy()
    position = frame.index.get_indexer(first)
    smallest = lambda_.min()
    summaries: dict[str, list[dict[str, Any]]] = {}
    counterexamples = []
    for bound, column in bounds.items():
        summaries[bound] = []
        for name, demanded in demanded_lambda(config, alpha, frame[column].to_numpy(float)).items():
            holds = lambda_ > demanded
            failed = holds & ~converged
            with np.errstate(divide="ignore"):
                ratios = demanded[position] / lambda_[position]
            strict = np.isfinite(ratios) & (ratios > 1.0)
            entry = counted(config, name, holds, converged)
            if bound == "true":
                columns = pd.Series(ratios[strict])
                # the least lambda of the grid worked: the true ratio is larger
                at_least = int((strict & (lambda_[position] <= smallest)).sum())
                entry["conservatism"] = {"median": columns.median(), "max": columns.max(), "columns": len(columns)}
                entry["conservatism"]["at_least"] = at_least
            summaries[bound].append(entry)
            if failed.any():
                extra = {"level": level, "side": side, "condition": name, "bound": bound}
                counterexamples.append(frame[failed].assign(row=np.flatnonzero(failed), **extra))
    worked = frame[converged]
    too_small = worked[bounds["true"]] > worked[bounds["claimed"]]
    ratio = pd.Series(worked[bounds["true"]] / worked[bounds["claimed"]]).replace([np.inf, -np.inf], np.nan).dropna()
    claimed = {
        "definition": "twice the largest acceleration",
        "converged_runs": len(worked),
        "too_small": float(too_small.mean()) if len(worked) else None,
        "true_over_claimed": {"median": ratio.median(), "max": ratio.max()},
        "by_input": _by_input(config, worked.assign(too_small=too_small), bounds),
        "conditions": summaries["claimed"],
    }
    summary = {
        "level": level,
        "side": side,
        "cells": len(frame),
        "converged": int(converged.sum()),
        "diverged": int((~frame["finite"].astype(bool)).sum()),
        "conditions": summaries["true"],
        "claimed_bound": claimed,
    }
    found = pd.concat(counterexamples, ignore_index=True) if counterexamples else pd.DataFrame({"bound": [], "row": []})
    return summary, found


def _by_input(config: Config, worked: pd.DataFrame, bounds: dict[str, str]) -> list[dict[str, Any]]:
    """True and claimed bound (medians, rad/s^2) for each combination of what excites the drive, over runs that converged."""
    kinds = ("excitation.", "transmission.", "drive.")
    keys = [axis.path for axis in config.axes if axis.path.startswith(kinds) and axis.path in worked]
    return [
        {
            "input": dict(zip(keys, values, strict=True)),
            "converged_runs": len(part),
            **{bound: part[column].median() for bound, column in bounds.items()},
            "too_small": float(part["too_small"].mean()),
        }
        for values, part in (worked.groupby(keys, sort=True) if keys else [])
    ]
