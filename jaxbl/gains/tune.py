"""Gains chosen for a drive: the function behind `jaxbl tune`.

A pilot run finds the bound f⁺ of each side. Gains are then searched on a map over alpha / f⁺ and lambda / √f⁺, both
observers in the same runs (they do not influence each other), and on zooms around each side's best point. Every stage is a
study of its own, kept in the folder's `tune/`: an interrupted search goes on where it stopped, a finished one is only read.
"""

# pandas' own annotations are wider than what its methods return
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from jaxbl.cluster import Scheduler
from jaxbl.config import Config, TuneTable, read_config
from jaxbl.errors import InputError
from jaxbl.observer import AbstractSuperTwisting
from jaxbl.sweeps.programs import Backend
from jaxbl.workers import Progress

from .certificate import certificates, choose_certified
from .gain_search import GainSearch
from .observer_choice import ObserverChoice, choose_observer
from .pilot import Scenarios, pilot, scenarios_of
from .stages import Stages, stages_in
from .tune_summary import Summary


@dataclasses.dataclass(frozen=True)
class Tuning:
    """Chosen gains, and how they were found.

    Attributes:
        config: the study.
        summary: plain data, as in `tuning.json`.
        candidates: for each side, one row for each pair of gains tried: `stage` (0 is the coarse map), `lambda`, `alpha`,
            `lambda_ratio`, `alpha_ratio`, whether all runs `converged` and are `finite`, largest `velocity_rmse`,
            `torque_rmse`, `convergence_time`, `convergence_time_worst` and `f_plus`, least `margin_alpha` and
            `margin_exact`, `error` (the objective), `chatter` of the run that has it, and `feasible`.
        cost: seconds of compilation and of computing, and lanes computed in this call.
        scanned: what the fused loop did not know of runs that this call scanned in its place.
    """

    config: Config
    summary: dict[str, Any]
    candidates: dict[str, pd.DataFrame]
    cost: dict[str, float]
    fallback_reasons: tuple[str, ...] = ()


def tune(
    study: str | Path | Mapping[str, Any] | Config,
    out: str | Path | None = None,
    *,
    progress: Progress | None = None,
    devices: list[Any] | None = None,
    overwrite: bool = False,
    backend: Backend | None = None,
    scheduler: Scheduler = None,
) -> Tuning | ObserverChoice:
    """Choose lambda and alpha of both observers for a study, or with `tune.observers` a kind of observer and its gains.

    `out`, `progress`, `devices`, `overwrite`, `backend` and `scheduler` are as in :func:`jaxbl.sweep`, over all runs of the
    search.

    Args:
        study: TOML file, mapping or config; its `[tune]` table says what is asked of the gains, its axes are not used.

    Raises:
        InputError: wrong config, a folder that holds something else, or a backend that cannot run the study.
        NoResult: no gains in the range meet the constraints, or the drive diverges.
    """
    config = read_config(study)
    table = config.tune or TuneTable()
    if config.observer.kind != AbstractSuperTwisting.name and not table.observers:
        raise InputError(
            f"observer.kind: tune chooses lambda and alpha of kind '{AbstractSuperTwisting.name}'; for the gains of "
            f"'{config.observer.kind}', put observers = [\"{config.observer.kind}\"] into [tune]"
        )
    config = config.model_copy(update={"tune": table})
    given = {"progress": progress, "devices": devices, "overwrite": overwrite, "backend": backend}
    if table.observers:
        with stages_in(config, "tune", out, scheduler, **given) as stages:
            return choose_observer(config, table, stages)
    scenarios = scenarios_of(config, table)
    with stages_in(config, "tune", out, scheduler, **given) as stages:
        return _tuned(config, table, scenarios, stages)


def _tuned(config: Config, table: TuneTable, scenarios: Scenarios, stages: Stages) -> Tuning:
    found = stages.found.get("pilot")
    search = GainSearch(scenarios, table, found or pilot(scenarios, table), stages)
    if found is None:
        stages.keep(pilot=search.pilot)
    search.run()
    passed_over = {} if table.certificate is None else choose_certified(search)
    summary = Summary(search, search.compare_gains(held_out=False), search.compare_gains(held_out=True)).data()
    if table.certificate is not None:
        summary["certificates"] = certificates(search, stages.place("certificate.json"))
        summary["passed_over"] = passed_over
    return Tuning(config, summary, search.candidates, stages.cost, tuple(stages.fallback_reasons))
