"""The function behind `jaxbl verify`: it compares gain conditions with simulated observers on three levels.

- "normalised": the error system (34) with f_plus = 1 under its worst disturbance, over a plane of alpha / f_plus and
  lambda / sqrt(f_plus);
- "drive": the study's points with ideal encoders and the implicit observer, each judged at the true f_plus of its run;
- "sampled": the study as it is, with its period, quantisation and noise.
"""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from jaxbl.cluster import Scheduler
from jaxbl.config import Config, ConfigSource, read_config
from jaxbl.errors import InputError
from jaxbl.files import to_jsonable, write_json
from jaxbl.json_types import JsonObject
from jaxbl.sweeps.metrics import ROUNDING, no_disturbance_error
from jaxbl.sweeps.points import Points
from jaxbl.sweeps.programs import Backend
from jaxbl.workers import Progress

from .counterexamples import add_causes, run_columns
from .error_system import (
    SWITCHING_LIMIT,
    ErrorSystemMap,
    judge_conditions,
    judge_error_system,
    simulate_error_system,
    summarise_ratios,
)
from .loop_gains import GAIN_SECTIONS, LoopRuns
from .own_disturbance import judge_marks, summarise_converged_below
from .pilot import Scenarios
from .stages import Stages, open_stages

_MOST_LISTED = 200
"""Counterexamples in `verdict.json`, as many as can be looked through; the Parquet file has all."""


@dataclasses.dataclass(frozen=True)
class Verdict:
    """The result of a verification.

    Attributes:
        config: the study.
        summary: content of `verdict.json`.
        error_map: the error system's map and boundaries.
        levels: frames of "drive" and "sampled": the points of a sweep with their metrics.
        counterexamples: runs in which a condition held and the observer failed. Columns are level, side, condition, bound
            ("true" or "claimed") and cause, then all axis values, seed and metrics.
        fallback_reasons: why runs of this call were scanned although the fused backend was asked for.
    """

    config: Config
    summary: JsonObject
    error_map: ErrorSystemMap
    levels: dict[str, pd.DataFrame]
    counterexamples: pd.DataFrame
    fallback_reasons: tuple[str, ...] = ()


def verify(
    study: ConfigSource,
    out: str | Path | None = None,
    *,
    progress: Progress | None = None,
    devices: list[Any] | None = None,
    overwrite: bool = False,
    backend: Backend | None = None,
    scheduler: Scheduler = None,
) -> Verdict:
    """Check every gain condition on three levels, and list the runs in which it held although the observer failed.

    `out`, `progress`, `devices`, `overwrite`, `backend` and `scheduler` are as in :func:`jaxbl.sweep`. They apply to the
    runs of all levels. The folder gets `verdict.json` and `counterexamples.parquet` as well.

    Args:
        study: TOML file, mapping or config, with axes over alpha and lambda of one observer or of both.

    Raises:
        InputError: the config is wrong, it has no axes over the gains, the folder holds something else, or the backend
            cannot run the study.
    """
    config = read_config(study)
    sides = sides_with_gain_axes(config)
    with open_stages(
        config, "verify", out, scheduler, progress=progress, devices=devices, overwrite=overwrite, backend=backend
    ) as stages:
        return _verify_levels(sides, stages)


def _verify_levels(sides: list[str], stages: Stages) -> Verdict:
    stages.write_manifest()
    config = stages.config
    studies = {"drive": _idealise_study(config.to_dict()), "sampled": _strip_study(config.to_dict())}
    stages.total_lanes = sum(len(Points(study)) * study.sweep.seeds for study in studies.values())
    error_map = simulate_error_system(stages)
    levels = {}
    for level, study in studies.items():
        levels[level] = frame = stages.run(study, level).frame
        for side in sides:
            size = frame[f"{side}.f_plus_acceleration"].max()
            if frame[f"{side}.f_plus"].max() <= ROUNDING[config.run.precision] * size:
                raise no_disturbance_error(side)
    summaries, all_counterexamples = [judge_error_system(config, error_map)], []
    for level, frame in levels.items():
        for side in sides:
            summary, counterexamples = _judge_level(config, level, side, frame)
            counterexamples = add_causes(counterexamples, studies[level], level, side, stages)
            runs = counterexamples.drop_duplicates(["bound", *run_columns(studies[level])])
            summary["causes"] = {bound: part.cause.value_counts().to_dict() for bound, part in runs.groupby("bound")}
            if level == "drive":
                summary["below_f_plus"] = summarise_converged_below(studies[level], side, frame)
            summaries.append(summary)
            all_counterexamples.append(counterexamples)
    counterexamples = pd.concat(all_counterexamples, ignore_index=True)
    at_true_bound = counterexamples[counterexamples["bound"] == "true"]
    summary = to_jsonable(
        {
            "title": config.title,
            "q": config.verify.q,
            "levels": summaries,
            "closed_form": {
                "cells": error_map.ratio.size,
                "largest_difference": error_map.difference,
                "switching_limit": SWITCHING_LIMIT,
            },
            "damping": [
                {"damping": damping, "alpha_ratio": error_map.alpha, "least_lambda_ratio": boundary}
                for damping, boundary in error_map.boundary_by_damping.items()
            ],
            "marks": judge_marks(studies["drive"], stages),
            "loop_margins": _find_loop_margins(stages),
            "counterexamples": at_true_bound.head(_MOST_LISTED).to_dict("records"),
            "counterexamples_in_all": len(at_true_bound),
        }
    )
    if stages.results is not None:
        with stages.results.write_files("verify", **stages.manifest) as draft:
            counterexamples.to_parquet(draft / "counterexamples.parquet", index=False)
            write_json(draft / "verdict.json", summary)
    return Verdict(config, summary, error_map, levels, counterexamples, tuple(stages.fallback_reasons))


def _find_loop_margins(stages: Stages) -> JsonObject:
    """Find the margins of a closed loop in the gains that are on axes (:meth:`.loop_gains.LoopRuns.find_margins`)."""
    config = stages.config
    if config.controller is None:
        return {}
    runs = LoopRuns(Scenarios(config), stages)
    gains = runs.read_study_gains([path for path in config.axis_paths if path.startswith(GAIN_SECTIONS)])
    return runs.find_margins({path: gain for path, gain in gains.items() if gain > 0.0})


def sides_with_gain_axes(config: Config) -> list[str]:
    """Return the sides whose gains are both on axes.

    Raises:
        InputError: there is none, or the axes are no grid that `verify` can search.
    """
    sides = [
        side for side in config.sides if {f"observer.{side}.alpha", f"observer.{side}.lambda"} <= set(config.axis_paths)
    ]
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


def _strip_study(data: JsonObject) -> Config:
    """Return the study of these tables without those on which its runs do not depend."""
    data = {key: table for key, table in data.items() if key not in ("figures", "verify")}
    # the verdict needs metrics of its own
    data["sweep"].pop("metrics", None)
    return read_config(data)


def _idealise_study(data: JsonObject) -> Config:
    """Return the study of these tables with ideal encoders and the implicit observer, at one seed."""
    ignored_paths = ("encoders.", "observer.discretisation", "run.sample_period", "run.substeps")
    axes = [axis for axis in data["axes"] if not axis["path"].startswith(ignored_paths)]
    labels = [axis.get("zip") for axis in axes]
    for axis in axes:
        if "zip" in axis and labels.count(axis["zip"]) == 1:
            del axis["zip"]
            if "values" in axis:
                axis["values"] = list(dict.fromkeys(axis["values"]))
    observer, sweep = data["observer"] | {"discretisation": "implicit"}, data["sweep"] | {"seeds": 1}
    return _strip_study(data | {"encoders": {}, "observer": observer, "axes": axes, "sweep": sweep})


def _judge_level(config: Config, level: str, side: str, frame: pd.DataFrame) -> tuple[JsonObject, pd.DataFrame]:
    """Count a level's runs by condition, at the true bound and at the claimed one.

    Returns the summary of the level, and its counterexamples.
    """
    path = f"observer.{side}.lambda"
    lambda_, alpha = (frame[f"observer.{side}.{gain}"].to_numpy(float) for gain in ("lambda", "alpha"))
    converged = frame[f"{side}.converged"].to_numpy(bool)
    bounds = {"true": f"{side}.f_plus", "claimed": f"{side}.f_plus_acceleration"}
    # the least lambda that converged, everything else being equal
    other_columns = [key for key in run_columns(config) if key != path and key in frame]
    least = frame[converged].groupby(other_columns, sort=False)[path].idxmin().to_numpy()
    summaries: dict[str, list[JsonObject]] = {bound: [] for bound in bounds}
    counterexamples = []
    for bound, column in bounds.items():
        judgements = judge_conditions(config.verify.q, lambda_, alpha, frame[column].to_numpy(float), converged)
        for judgement, holds, demanded in judgements:
            if bound == "true":
                with np.errstate(divide="ignore"):
                    ratios = demanded[least] / lambda_[least]
                demands_more = np.isfinite(ratios) & (ratios > 1.0)
                # where the least lambda of the grid converged, the true ratio is larger
                at_least = demands_more & (lambda_[least] <= lambda_.min())
                judgement["conservatism"] = summarise_ratios(ratios[demands_more], int(at_least.sum()))
            summaries[bound].append(judgement)
            rows = np.flatnonzero(holds & ~converged)
            extra = {"level": level, "side": side, "condition": judgement["name"], "bound": bound}
            counterexamples.append(frame.iloc[rows].assign(row=rows, **extra))
    converged_runs = frame[converged]
    true_bound, claimed_bound = (converged_runs[column] for column in bounds.values())
    too_small = true_bound > claimed_bound
    ratio = pd.Series(true_bound / claimed_bound).replace([np.inf, -np.inf], np.nan)
    claimed = {
        "definition": "twice the largest acceleration",
        "converged_runs": len(converged_runs),
        "too_small": too_small.mean(),
        "true_over_claimed": {"median": ratio.median(), "max": ratio.max()},
        "by_input": _summarise_by_input(config, converged_runs.assign(too_small=too_small), bounds),
        "conditions": summaries["claimed"],
    }
    summary = {
        "level": level,
        "side": side,
        "cells": len(frame),
        "converged": len(converged_runs),
        "diverged": int((~frame["finite"].astype(bool)).sum()),
        "conditions": summaries["true"],
        "claimed_bound": claimed,
    }
    return summary, pd.concat(counterexamples, ignore_index=True)


def _summarise_by_input(config: Config, converged_runs: pd.DataFrame, bounds: dict[str, str]) -> list[JsonObject]:
    """Summarise the true and the claimed bound (medians, rad/s^2) of converged runs by input, transmission and drive."""
    kinds = ("excitation.", "transmission.", "drive.")
    keys = [axis.path for axis in config.axes if axis.path.startswith(kinds) and axis.path in converged_runs]
    return [
        {
            "input": dict(zip(keys, values, strict=True)),
            "converged_runs": len(group),
            **{bound: group[column].median() for bound, column in bounds.items()},
            "too_small": float(group["too_small"].mean()),
        }
        for values, group in (converged_runs.groupby(keys, sort=True) if keys else [])
    ]
