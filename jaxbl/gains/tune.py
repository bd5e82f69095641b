"""The function behind `jaxbl tune`: it chooses gains for a drive.

A pilot run finds the bound f⁺ of each side. Gains are then searched on a map over alpha / f⁺ and lambda / √f⁺, and on zooms
around each side's best point. Both observers are searched in the same runs, as they do not influence each other. Every stage
is a study of its own, stored in the folder's `tune/`: an interrupted search continues there, a finished one is only read.
"""

# pandas' own annotations are wider than what its methods return
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false

import dataclasses
from pathlib import Path
from typing import Any

import pandas as pd

from jaxbl.cluster import Scheduler
from jaxbl.config import LOOP_OBJECTIVES, ConfigSource, TuneTable, read_config
from jaxbl.errors import InputError
from jaxbl.observer import AbstractSuperTwisting
from jaxbl.sweeps.programs import Backend
from jaxbl.workers import Progress

from .certificate import certify_best_gains, choose_certified_gains
from .gain_search import GainSearch
from .loop_gains import LoopTuning, tune_loop
from .observer_choice import ObserverChoice, choose_observer
from .pilot import list_scenarios, run_pilot
from .stages import GainChoice, Stages, open_stages
from .tune_summary import Summary


@dataclasses.dataclass(frozen=True)
class Tuning(GainChoice):
    """Tuned gains, and the candidates of their search.

    Attributes:
        config: the study.
        summary: plain data, as in `tuning.json`.
        cost: seconds of compilation and of computing, and lanes computed in this call.
        fallback_reasons: why runs of this call were scanned although the fused backend was asked for.
        candidates: for each side, one row for each pair of gains tried: `stage` (0 is the coarse map), `lambda`, `alpha`,
            `lambda_ratio`, `alpha_ratio`, whether all runs `converged` and are `finite`, largest `velocity_rmse`,
            `torque_rmse`, `convergence_time`, `convergence_time_worst` and `f_plus`, least `margin_alpha` and
            `margin_exact`, `error` (the objective), `chatter` of the run that has it, its `scatter` (relative standard
            error of the mean over noise seeds), and `feasible`.
    """

    candidates: dict[str, pd.DataFrame]


def tune(
    study: ConfigSource,
    out: str | Path | None = None,
    *,
    progress: Progress | None = None,
    devices: list[Any] | None = None,
    overwrite: bool = False,
    backend: Backend | None = None,
    scheduler: Scheduler = None,
) -> Tuning | ObserverChoice | LoopTuning:
    """Choose lambda and alpha of both observers for a study, with `tune.observers` a kind of observer and its gains,
    or with an objective of the loop the gains of observers and controller together.

    `out`, `progress`, `devices`, `overwrite`, `backend` and `scheduler` are as in :func:`jaxbl.sweep`. They apply to all
    runs of the search.

    Args:
        study: TOML file, mapping or config. Its `[tune]` table holds the objective and the constraints; its axes are unused.

    Raises:
        InputError: the config is wrong, or its objective not that of its loop; the folder holds something else, or the
            backend cannot run the study.
        NoResult: no gains in the range meet the constraints, or the drive diverges.

    Example:
        >>> tuning = jaxbl.tune("sweeps/tune_paper_drive.toml", "results/paper_drive")
        >>> tuning.summary["gains"]["motor"]
    """
    config = read_config(study)
    table = config.tune or TuneTable()
    in_loop = table.objective in LOOP_OBJECTIVES
    if in_loop and config.controller is None:
        raise InputError(f"tune.objective: '{table.objective}' is that of a loop; add [controller] and [reference]")
    if config.observer.kind != AbstractSuperTwisting.name and not table.observers and not in_loop:
        raise InputError(
            f"observer.kind: tune chooses lambda and alpha of kind '{AbstractSuperTwisting.name}'; for the gains of "
            f"'{config.observer.kind}', put observers = [\"{config.observer.kind}\"] into [tune]"
        )
    if config.controller is not None and config.controller.build().reads_observers and not in_loop:
        raise InputError(
            f"tune.objective: '{table.objective}' does not go with a controller that reads the observers, as each gain "
            f"makes another motion; choose {', '.join(LOOP_OBJECTIVES)}, by which the loop is tuned as a whole"
        )
    config = config.model_copy(update={"tune": table})
    with open_stages(
        config, "tune", out, scheduler, progress=progress, devices=devices, overwrite=overwrite, backend=backend
    ) as stages:
        if in_loop:
            return tune_loop(stages)
        return choose_observer(stages) if table.observers else _search_gains(stages)


def _search_gains(stages: Stages) -> Tuning:
    pilot_before, table = stages.manifest.get("pilot"), stages.table
    scenarios = list_scenarios(stages.config, table.worst_over_uncertainty)
    search = GainSearch(scenarios, pilot_before or run_pilot(scenarios, table.holdout), stages)
    if pilot_before is None:
        stages.write_manifest(pilot=search.pilot)
    search.run()
    passed_over = {} if table.certificate is None else choose_certified_gains(search)
    summary = Summary(search).to_dict()
    if table.certificate is not None:
        summary["certificates"] = certify_best_gains(search, stages.path_of("certificate.json"))
        summary["passed_over"] = passed_over
    return Tuning(stages.config, summary, stages.cost, tuple(stages.fallback_reasons), search.candidates)
