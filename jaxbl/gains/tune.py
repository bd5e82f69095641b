"""Gains chosen for a drive: the function behind `jaxbl tune`.

A pilot run finds the bound f⁺ of each side. Gains are then searched on a map over alpha / f⁺ and lambda / √f⁺, both
observers in the same runs (they do not influence each other), and on zooms around each side's best point. Every stage is a
study of its own, kept in the folder's `tune/`: an interrupted search goes on where it stopped, a finished one is only read.
"""

# pandas' own annotations are wider than what its methods return
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from jaxbl.cluster import Scheduler
from jaxbl.config import TUNE_NAMES, Config, TuneTable, read_config
from jaxbl.errors import InputError, NoResult
from jaxbl.observer import AbstractSuperTwisting
from jaxbl.sweeps.metrics import undisturbed
from jaxbl.sweeps.programs import Backend
from jaxbl.workers import Progress

from .certificate import certificates, choose_certified
from .observer_choice import ObserverChoice, choose_observer
from .pilot import Scenarios, pilot, scenarios_of
from .stages import Stages, stages_in
from .tune_summary import COMPARED, Summary, compared_figures

Gains = dict[str, tuple[float, float]]
"""lambda (rad^0.5/s) and alpha (rad/s^2) of each side."""

Window = dict[str, tuple[float, float]]
"""Ends of the ratios searched on one side: alpha / f⁺ under `alpha`, lambda / √f⁺ under `lambda`."""


_FINEST = 1e-6  # relative steps below this are no longer worth a run


def usual_rule(f_plus: float) -> tuple[float, float]:
    """The usual rule (Levant 1998): lambda = 1.5 sqrt(f_plus) (rad^0.5/s) and alpha = 1.1 f_plus (rad/s^2)."""
    return 1.5 * math.sqrt(f_plus), 1.1 * f_plus


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
    scanned: tuple[str, ...] = ()


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
    search = Search(scenarios, table, found or pilot(scenarios, table), stages)
    if found is None:
        stages.keep(pilot=search.pilot)
    search.run()
    passed_over = {} if table.certificate is None else choose_certified(search)
    summary = Summary(search, search.compare(held_out=False), search.compare(held_out=True)).data()
    if table.certificate is not None:
        summary["certificates"] = certificates(search, stages.place("certificate.json"))
        summary["passed_over"] = passed_over
    return Tuning(config, summary, search.candidates, stages.cost, tuple(stages.scanned))


def _cell(ends: tuple[float, float], num: int) -> float:
    """Ratio of neighbouring values."""
    return (ends[1] / ends[0]) ** (1.0 / (num - 1))


class Search:
    """The stages of a search: coarse map, zooms, comparison."""

    def __init__(self, scenarios: Scenarios, table: TuneTable, pilot: dict[str, Any], stages: Stages):
        self.scenarios, self.table, self.pilot, self.stages = scenarios, table, pilot, stages
        self.sides = tuple(pilot)
        self.f_plus = {side: float(found["f_plus"]) for side, found in pilot.items()}
        for side, bound in self.f_plus.items():
            if not bound > 0.0:
                raise undisturbed(side)
        self.limits: Window = {
            gain: (span.start, span.stop) for gain, span in (("alpha", table.alpha_ratio), ("lambda", table.lambda_ratio))
        }
        self.windows = [dict.fromkeys(self.sides, self.limits)]
        self.candidates: dict[str, pd.DataFrame] = {}
        seeds, lanes = scenarios.config.sweep.seeds, len(scenarios.names)
        stages.total = seeds * lanes * (table.num**2 * (1 + table.refine) + 2 * len(self.gains_to_compare({})))

    def run(self) -> None:
        """Search. Raises `NoResult` where nothing is feasible."""
        for stage in range(self.table.refine + 1):
            if stage:
                if all(ratio - 1.0 < _FINEST for side in self.sides for ratio in self.cells(side).values()):
                    break
                self.windows.append({side: self._zoomed(side) for side in self.sides})
            self._map(stage)

    def best(self, side: str) -> dict[str, Any]:
        """The feasible candidate with the least error; of equals, the one that converges first."""
        frame = self.candidates[side]
        return frame[frame["feasible"]].sort_values(["error", "convergence_time"], kind="stable").iloc[0].to_dict()

    def cells(self, side: str) -> dict[str, float]:
        """Ratio of neighbouring values of each gain in the last stage."""
        return {gain: _cell(ends, self.table.num) for gain, ends in self.windows[-1][side].items()}

    def coarse_cell(self, gain: str) -> float:
        """Ratio of neighbouring values of a gain in the coarse map."""
        return _cell(self.limits[gain], self.table.num)

    def _zoomed(self, side: str) -> Window:
        """One cell each way about the best point so far, inside of the limits."""
        best, window = self.best(side), {}
        for gain, cell in self.cells(side).items():
            centre, (least, largest) = best[f"{gain}_ratio"], self.limits[gain]
            window[gain] = (max(centre / cell, least), min(centre * cell, largest))
        return window

    def _map(self, stage: int) -> None:
        """Run the points of a stage and judge them."""
        axes: dict[str, dict[str, list[float]]] = {"alpha": {}, "lambda": {}}
        for side, window in self.windows[stage].items():
            bound = self.f_plus[side]
            for gain, scale in (("alpha", bound), ("lambda", math.sqrt(bound))):
                values = scale * np.geomspace(*window[gain], self.table.num)
                axes[gain][f"observer.{side}.{gain}"] = values.tolist()
        frame = self._sweep("coarse" if stage == 0 else f"refine-{stage}", axes)
        for side in self.sides:
            new = self._judge(side, _worst(frame, side, self.table.objective)).assign(stage=stage)
            old = self.candidates.get(side)
            self.candidates[side] = new if old is None else pd.concat([old, new], ignore_index=True)
            if not self.candidates[side]["feasible"].any():
                raise NoResult(self._why_none(side))

    def _judge(self, side: str, found: pd.DataFrame) -> pd.DataFrame:
        bound = self.f_plus[side]
        return found.assign(
            alpha_ratio=found["alpha"] / bound,
            lambda_ratio=found["lambda"] / math.sqrt(bound),
            error=found[f"{self.table.objective}_rmse"],
            feasible=np.logical_and.reduce(list(self.kept(found).values())),
        )

    def kept(self, found: pd.DataFrame) -> dict[str, np.ndarray]:
        """Which candidates keep which constraint, by its key in `[tune]`, and `converged`."""
        table = self.table
        kept = {
            "converged": found["converged"],
            "margin_alpha": found["margin_alpha"] >= table.margin_alpha,
            "margin_exact": found["margin_exact"] >= table.margin_exact,
        }
        if table.longest_convergence is not None:
            kept["longest_convergence"] = found["convergence_time"] <= table.longest_convergence
        return {name: values.to_numpy(bool) for name, values in kept.items()}

    def _why_none(self, side: str) -> str:
        found, alpha, lambda_ = self.candidates[side], self.limits["alpha"], self.limits["lambda"]
        run = self.scenarios.config.run
        least = {
            "converged": f" (least velocity error {found['velocity_rmse'].min():.3g} rad/s rms, "
            f"run.velocity_tolerance = {run.velocity_tolerance:g}, run.position_tolerance = {run.position_tolerance:g})",
            "margin_alpha": f" (largest {found['margin_alpha'].max():.3g})",
            "margin_exact": f" (largest {found['margin_exact'].max():.3g})",
            "longest_convergence": f" (fastest {found['convergence_time'].min():.3g} s)",
        }
        counts = "; ".join(
            f"{'converged' if key == 'converged' else f'{key} = {getattr(self.table, key):g}'}: "
            f"{int(values.sum())}{least.get(key, '')}"
            for key, values in self.kept(found).items()
        )
        return (
            f"{side}: none of the {len(found)} gains with alpha / f⁺ in {alpha[0]:g} ... {alpha[1]:g} and "
            f"lambda / √f⁺ in {lambda_[0]:g} ... {lambda_[1]:g} (f⁺ = {self.f_plus[side]:.3g} rad/s²) keeps "
            f"all constraints in all runs; how many keep each: {counts}"
        )

    def gains_to_compare(self, tuned: Gains) -> dict[str, Gains]:
        """Gains of both sides by name."""
        usual = {side: usual_rule(bound) for side, bound in self.f_plus.items()}
        observers = {side: getattr(self.scenarios.config.observer, side) for side in self.sides}
        own = {side: (float(observer.lambda_), float(observer.alpha)) for side, observer in observers.items()}
        others = {
            other.name: {side: (getattr(other, side).lambda_, getattr(other, side).alpha) for side in self.sides}
            for other in self.table.compare
        }
        return dict(zip(TUNE_NAMES, (tuned, usual, own), strict=True)) | others

    def compare(self, *, held_out: bool) -> list[dict[str, Any]]:
        """Figures of all named gains, one row for each name and side: on the study's own runs, or on the held-out input with
        noise that the search has not seen."""
        best = {side: self.best(side) for side in self.sides}
        named = self.gains_to_compare({side: (float(row["lambda"]), float(row["alpha"])) for side, row in best.items()})
        # gains of two names may be the same, points of a study may not
        unique = list({tuple(gains.values()): gains for gains in named.values()}.values())
        columns = {
            f"observer.{side}.{key}": [gains[side][i] for gains in unique]
            for side in self.sides
            for i, key in enumerate(("lambda", "alpha"))
        }
        frame = self._sweep("holdout" if held_out else "named", {"gains": columns}, held_out=held_out)
        rows = []
        for name, gains in named.items():
            for side, (lambda_, alpha) in gains.items():
                own = (frame[f"observer.{side}.lambda"] == lambda_) & (frame[f"observer.{side}.alpha"] == alpha)
                # another pair may share this side's gains: its runs are the same
                runs = frame[own].drop_duplicates([*self.scenarios.columns, "seed"])
                rows.append(compared_figures(name, side, runs, (lambda_, alpha)))
        return rows

    def _sweep(self, name: str, axes: dict[str, dict[str, list[float]]], *, held_out: bool = False) -> pd.DataFrame:
        """Run one stage over scenarios and some axes that advance together."""
        config = self.scenarios.config
        data = config.resolved()
        for key in ("notes", "figures", "tune", "uncertainty", "axes"):
            data.pop(key, None)
        data["title"] = f"{config.title} ({name})" if config.title else name
        for side in self.sides:
            data["observer"][side]["velocity_error"] = self.pilot[side]["velocity_error"]
        seeds, chunk = config.sweep.seeds, config.sweep.chunk
        data["sweep"] = {"seeds": seeds, "first_seed": config.sweep.first_seed + (seeds if held_out else 0)}
        data["sweep"] |= {} if chunk is None else {"chunk": chunk}
        if held_out and self.table.holdout is not None:
            data["excitation"] = self.table.holdout.model_dump(by_alias=True, exclude_none=True)
        data["axes"] = [
            {"path": path, "values": values, **({"zip": label} if len(columns) > 1 else {})}
            for label, columns in ({"scenario": self.scenarios.columns} | axes).items()
            for path, values in columns.items()
        ]
        result = self.stages.run(data, name)
        names = [f"{side}.{figure}" for side in self.sides for figure in COMPARED]
        paths = [axis["path"] for axis in data["axes"]]
        return result.read([*paths, "seed", "finite", *names])


_WORST = {
    **dict.fromkeys(("velocity_rmse", "torque_rmse", "convergence_time", "convergence_time_worst", "f_plus"), "max"),
    **dict.fromkeys(("margin_alpha", "margin_exact", "converged", "finite"), "min"),
}
"""How figures of several runs become one."""


def _worst(frame: pd.DataFrame, side: str, objective: str) -> pd.DataFrame:
    """One row for each pair of gains: the worst over scenarios and seeds; NaN where a run diverged or did not converge.
    `chatter` is that of the run with the largest error."""
    keys = [f"observer.{side}.lambda", f"observer.{side}.alpha"]
    part = frame[[*keys, "finite"]].assign(**{name: frame[f"{side}.{name}"] for name in COMPARED})
    found = part.groupby(keys, sort=True).agg(_WORST).astype({"converged": bool, "finite": bool})
    # a part of the worst run's error
    worst = part.sort_values(f"{objective}_rmse", kind="stable").groupby(keys, sort=True)["chatter"].last()
    found["chatter"] = worst
    # the largest of some is not the largest of all
    found.loc[~found["converged"], "convergence_time"] = np.nan
    found.loc[~found["finite"], [*(name for name in _WORST if name not in ("converged", "finite")), "chatter"]] = np.nan
    return found.rename_axis(["lambda", "alpha"]).reset_index()
