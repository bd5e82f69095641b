"""The search for lambda and alpha behind `jaxbl tune`: a coarse map of both gains, then zooms around the best point."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false

import math

import numpy as np
import pandas as pd

from jaxbl.chain import NamedArrays
from jaxbl.config import TUNE_NAMES, TuneTable
from jaxbl.errors import NoResult
from jaxbl.files import to_jsonable
from jaxbl.json_types import JsonObject
from jaxbl.observer.conditions import CONDITIONS, judge_gains
from jaxbl.sweeps.elementwise import apply_elementwise
from jaxbl.sweeps.metrics import no_disturbance_error

from .best_gains import BestGains, find_best_gains
from .expected_error import list_causes
from .pilot import Scenarios, list_axes
from .stages import Stages, stage_tables

Gains = dict[str, tuple[float, float]]
"""lambda (rad^0.5/s) and alpha (rad/s^2) of each side."""

Window = dict[str, tuple[float, float]]
"""Ends of the ratios searched on one side: alpha / f⁺ under `alpha`, lambda / √f⁺ under `lambda`."""


GAIN_METRICS = (
    "converged",
    "convergence_time",
    "convergence_time_worst",
    "velocity_rmse",
    "torque_rmse",
    "chatter",
    "margin_alpha",
    "margin_exact",
    "f_plus",
)
"""Metrics of a side by which gains are judged."""

_LEAST_STEP = 0.02
"""Relative step of a gain below which another zoom is not worth its runs: gains are tried, and given, with three digits."""

_WIDEST = {"alpha": (1.1, 1e4), "lambda": (0.03, 500.0)}
"""Bounds of the ratios up to which a range is widened that the study leaves at its default."""


def usual_rule(f_plus: float) -> tuple[float, float]:
    """The usual rule (Levant 1998): lambda = 1.5 sqrt(f_plus) (rad^0.5/s) and alpha = 1.1 f_plus (rad/s^2)."""
    return 1.5 * math.sqrt(f_plus), 1.1 * f_plus


def grid_ratio(ends: tuple[float, float], num: int) -> float:
    """Ratio of neighbouring values among `num` from end to end, evenly spaced on a logarithmic scale."""
    return (ends[1] / ends[0]) ** (1.0 / (num - 1))


class GainSearch:
    """The stages of a search for gains: coarse map, zooms, comparison.

    Args:
        scenarios: the drives that the gains must serve.
        table: what is asked of the gains.
        pilot: results of the pilot run by side (:func:`.pilot.run_pilot`).
        stages: runs each stage as a study of its own.

    Attributes:
        f_plus: bound of the disturbance by side, rad/s^2.
        limits: the whole range of each ratio.
        windows: ranges searched in each stage, by side.
        candidates: table of the gains tried, by side, as in :class:`.tune.Tuning`.
    """

    def __init__(self, scenarios: Scenarios, table: TuneTable, pilot: JsonObject, stages: Stages):
        self.scenarios, self.table, self.pilot, self.stages = scenarios, table, pilot, stages
        self.sides = tuple(pilot)
        self.f_plus = {side: float(pilot_values["f_plus"]) for side, pilot_values in pilot.items()}
        for side, bound in self.f_plus.items():
            if not bound > 0.0:
                raise no_disturbance_error(side)
        self.limits = self._read_limits(table)
        self.windows = [dict.fromkeys(self.sides, self.limits)]
        self.candidates: dict[str, pd.DataFrame] = {}
        seeds, lanes = scenarios.config.sweep.seeds, len(scenarios.names)
        causes = 1 + len(list_causes(scenarios.config).names)
        stages.total_lanes = (
            seeds * lanes * (table.num**2 * (1 + table.refine) + 2 * len(self.list_named_gains({})) + causes)
        )

    def run(self) -> None:
        """Run the coarse map, a wider one where the best gains lie at its end, and the zooms.

        Raises:
            NoResult: no candidate meets all constraints.
        """
        self._run_map(0, "coarse")
        if self._widen_limits():
            self._run_map(0, "wide")
        for stage in range(1, self.table.refine + 1):
            windows = {side: self._zoom_in(side) for side in self.sides}
            steps = [grid_ratio(ends, self.table.num) - 1.0 for window in windows.values() for ends in window.values()]
            if min(steps) < _LEAST_STEP:
                break
            self.windows.append(windows)
            self._run_map(stage, f"refine-{stage}")

    @staticmethod
    def _read_limits(table: TuneTable) -> Window:
        return {"alpha": (table.alpha_ratio.start, table.alpha_ratio.stop),
                "lambda": (table.lambda_ratio.start, table.lambda_ratio.stop)}  # fmt: skip

    def _widen_limits(self) -> bool:
        """Widen ranges at whose end the best gains lie, unless the study gives them. Returns whether there are such."""
        defaults, limits = self._read_limits(TuneTable()), dict(self.limits)
        for side in self.sides:
            for gain, way in self.find_best(side).ends.items():
                if self.limits[gain] == defaults[gain]:
                    limits[gain] = (
                        (_WIDEST[gain][0], limits[gain][1]) if way == "smaller" else (limits[gain][0], _WIDEST[gain][1])
                    )
        if limits == self.limits:
            return False
        self.limits, self.windows = limits, [dict.fromkeys(self.sides, limits)]
        return True

    def find_best(self, side: str) -> BestGains:
        """Find the best gains of a side among its candidates."""
        frame = self.candidates[side]
        best = find_best_gains(
            frame[["lambda", "alpha"]],
            frame["error"].to_numpy(),
            frame["converged"].to_numpy(bool),
            allowed=frame["feasible"].to_numpy(bool),
            alpha_ratio=frame["margin_alpha"].to_numpy(),
            scatter=frame["scatter"].to_numpy(),
        )
        assert best is not None
        return best

    def best_candidate(self, side: str) -> JsonObject:
        """Return the best feasible candidate of a side."""
        return self.candidates[side].iloc[self.find_best(side).index].to_dict()

    def least_candidate(self, side: str) -> JsonObject:
        """Return the feasible candidate of a side with the least error; of equal ones that which converges first."""
        frame = self.candidates[side]
        return frame[frame["feasible"]].sort_values(["error", "convergence_time"], kind="stable").iloc[0].to_dict()

    def cell_ratios(self, side: str) -> dict[str, float]:
        """Ratio of neighbouring values of each gain in the last stage."""
        return {gain: grid_ratio(ends, self.table.num) for gain, ends in self.windows[-1][side].items()}

    def _zoom_in(self, side: str) -> Window:
        """The next window: one cell to each side of the candidate with the least error, inside of the limits."""
        least, window = self.least_candidate(side), {}
        for gain, cell in self.cell_ratios(side).items():
            centre, (low, high) = least[f"{gain}_ratio"], self.limits[gain]
            window[gain] = (max(centre / cell, low), min(centre * cell, high))
        return window

    def _run_map(self, stage: int, name: str) -> None:
        """Run a stage's map of gains, and append its candidates; those of stage 0 take the place of earlier ones."""
        axes: dict[str, dict[str, list[float]]] = {"alpha": {}, "lambda": {}}
        for side, window in self.windows[stage].items():
            bound, ratios = self.f_plus[side], {}
            for gain, scale in (("alpha", bound), ("lambda", math.sqrt(bound))):
                values = scale * np.geomspace(*window[gain], self.table.num)
                # a map that is finer than three digits keeps more
                digits = 3 if grid_ratio(window[gain], self.table.num) - 1.0 >= _LEAST_STEP else 16
                axes[gain][f"observer.{side}.{gain}"] = values = [float(f"{value:.{digits}g}") for value in values]
                ratios[gain] = values[0] / scale, values[-1] / scale
            self.windows[stage][side] = ratios
        frame = self._run_study(name, axes)
        for side in self.sides:
            worst = _reduce_to_worst(frame, side, self.table.objective, list(self.scenarios.columns))
            new = self._mark_feasible(side, worst).assign(stage=stage)
            self.candidates[side] = pd.concat([self.candidates[side], new], ignore_index=True) if stage else new
            if not self.candidates[side]["feasible"].any():
                raise NoResult(self._explain_failure(side))

    def _mark_feasible(self, side: str, candidates: pd.DataFrame) -> pd.DataFrame:
        bound = self.f_plus[side]
        return candidates.assign(
            alpha_ratio=candidates["alpha"] / bound,
            lambda_ratio=candidates["lambda"] / math.sqrt(bound),
            error=candidates[f"{self.table.objective}_rmse"],
            feasible=np.logical_and.reduce(list(self.constraints_met(candidates).values())),
        )

    def constraints_met(self, candidates: pd.DataFrame) -> NamedArrays:
        """For each constraint (`converged`, or its key in `[tune]`) an array: True for the candidates that meet it."""
        table = self.table
        met = {
            "converged": candidates["converged"],
            "margin_alpha": candidates["margin_alpha"] >= table.margin_alpha,
            "margin_exact": candidates["margin_exact"] >= table.margin_exact,
        }
        if table.longest_convergence is not None:
            met["longest_convergence"] = candidates["convergence_time"] <= table.longest_convergence
        return {name: values.to_numpy(bool) for name, values in met.items()}

    def _explain_failure(self, side: str) -> str:
        candidates, alpha, lambda_ = self.candidates[side], self.limits["alpha"], self.limits["lambda"]
        run = self.scenarios.config.run
        best_reached = {
            "converged": f" (least velocity error {candidates['velocity_rmse'].min():.3g} rad/s rms, "
            f"run.velocity_tolerance = {run.velocity_tolerance:g}, run.position_tolerance = {run.position_tolerance:g})",
            "margin_alpha": f" (largest {candidates['margin_alpha'].max():.3g})",
            "margin_exact": f" (largest {candidates['margin_exact'].max():.3g})",
            "longest_convergence": f" (fastest {candidates['convergence_time'].min():.3g} s)",
        }
        counts = "; ".join(
            f"{'converged' if key == 'converged' else f'{key} = {getattr(self.table, key):g}'}: "
            f"{int(met.sum())}{best_reached.get(key, '')}"
            for key, met in self.constraints_met(candidates).items()
        )
        return (
            f"{side}: none of the {len(candidates)} gains with alpha / f⁺ in {alpha[0]:g} ... {alpha[1]:g} and "
            f"lambda / √f⁺ in {lambda_[0]:g} ... {lambda_[1]:g} (f⁺ = {self.f_plus[side]:.3g} rad/s²) keeps "
            f"all constraints in all runs; how many keep each: {counts}"
        )

    def list_named_gains(self, tuned: Gains) -> dict[str, Gains]:
        """Gains to compare by name: the tuned ones, the usual rule's, the study's, and those of `tune.compare`."""
        usual = {side: usual_rule(bound) for side, bound in self.f_plus.items()}
        observers = {side: getattr(self.scenarios.config.observer, side) for side in self.sides}
        study_gains = {side: (float(observer.lambda_), float(observer.alpha)) for side, observer in observers.items()}
        table_gains = {
            gains.name: {side: (getattr(gains, side).lambda_, getattr(gains, side).alpha) for side in self.sides}
            for gains in self.table.compare
        }
        return dict(zip(TUNE_NAMES, (tuned, usual, study_gains), strict=True)) | table_gains

    def compare_gains(self, *, held_out: bool) -> list[JsonObject]:
        """Compare all named gains: one row (:func:`summarise_runs`) for each name and side.

        The runs have the study's own excitation and seeds, or if `held_out` the held-out excitation and other seeds.
        """
        best = {side: self.best_candidate(side) for side in self.sides}
        gains_by_name = self.list_named_gains(
            {side: (float(row["lambda"]), float(row["alpha"])) for side, row in best.items()}
        )
        # gains of two names may be the same, points of a study may not
        unique = list({tuple(gains.values()): gains for gains in gains_by_name.values()}.values())
        columns = {
            f"observer.{side}.{key}": [gains[side][i] for gains in unique]
            for side in self.sides
            for i, key in enumerate(("lambda", "alpha"))
        }
        frame = self._run_study("holdout" if held_out else "named", {"gains": columns}, held_out=held_out)
        rows = []
        for name, gains in gains_by_name.items():
            for side, (lambda_, alpha) in gains.items():
                is_pair = (frame[f"observer.{side}.lambda"] == lambda_) & (frame[f"observer.{side}.alpha"] == alpha)
                # another pair may share this side's gains: its runs are the same
                runs = frame[is_pair].drop_duplicates([*self.scenarios.columns, "seed"])
                rows.append(summarise_runs(name, side, runs, (lambda_, alpha)))
        return rows

    def split_error(self) -> dict[str, dict[str, float]]:
        """Split the mean square error of the best gains by its causes (:class:`.expected_error.Causes`), by side."""
        causes = list_causes(self.scenarios.config)
        best = {side: self.best_candidate(side) for side in self.sides}
        gains = {f"observer.{side}.{gain}": [row[gain]] for side, row in best.items() for gain in ("lambda", "alpha")}
        frame = self._run_study("causes", {"gains": gains, "causes": causes.columns})
        return {side: causes.split(frame, f"{side}.{self.table.objective}_rmse")[1] for side in self.sides}

    def _run_study(self, name: str, axes: dict[str, dict[str, list[float]]], *, held_out: bool = False) -> pd.DataFrame:
        """Run one stage. Its axes are the scenarios' columns and `axes`: columns by label, which advance together."""
        config = self.scenarios.config
        data = stage_tables(config, name, self.table, config.sweep.seeds if held_out else None)
        for side in self.sides:
            data["observer"][side]["velocity_error"] = self.pilot[side]["velocity_error"]
        data["axes"] = list_axes({"scenario": self.scenarios.columns} | axes)
        result = self.stages.run(data, name)
        names = [f"{side}.{metric}" for side in self.sides for metric in GAIN_METRICS]
        frame = result.read([*(axis["path"] for axis in data["axes"]), "seed", "finite", *names])
        for side, pilot in self.pilot.items():
            # along a run f⁺ may have the friction of an assumed starting error, and none of what other machines add
            alpha, lambda_ = (frame[f"observer.{side}.{gain}"].to_numpy(float) for gain in ("alpha", "lambda"))
            bound = np.full(len(frame), pilot["holdout_f_plus" if held_out else "f_plus"])
            least = apply_elementwise(CONDITIONS["exact"].least_lambda, [alpha, bound])
            for name, values in {"f_plus": bound, "margin_alpha": alpha / bound, "margin_exact": lambda_ / least}.items():
                frame[f"{side}.{name}"] = np.where(frame["finite"], values, np.nan)
        return frame


_WORST_BY_METRIC = {
    **dict.fromkeys(("velocity_rmse", "torque_rmse", "convergence_time", "convergence_time_worst", "f_plus"), "max"),
    **dict.fromkeys(("margin_alpha", "margin_exact", "converged", "finite"), "min"),
}
"""Reduction of each metric to its worst over several runs."""


def _reduce_to_worst(frame: pd.DataFrame, side: str, objective: str, scenario_columns: list[str]) -> pd.DataFrame:
    """Reduce runs to one row for each pair of gains: the worst over scenarios and seeds.

    Metrics are NaN if a run diverged, and the convergence time if one did not converge. `chatter` is that of the run with
    the largest error, `scatter` the relative standard error of its mean over the seeds.
    """
    keys = [f"observer.{side}.lambda", f"observer.{side}.alpha"]
    runs = frame[[*keys, "finite"]].assign(**{name: frame[f"{side}.{name}"] for name in GAIN_METRICS})
    worst = runs.groupby(keys, sort=True).agg(_WORST_BY_METRIC).astype({"converged": bool, "finite": bool})
    # chatter is a part of the error: it belongs to the run with the largest one
    worst["chatter"] = runs.sort_values(f"{objective}_rmse", kind="stable").groupby(keys, sort=True)["chatter"].last()
    seeds = frame.groupby([*keys, *scenario_columns])[f"{side}.{objective}_rmse"].agg(["mean", "sem"])
    # one seed has none
    worst["scatter"] = (seeds["sem"] / seeds["mean"]).groupby(level=[0, 1]).max().fillna(0.0)
    # a maximum that leaves out failed runs is not the worst
    worst.loc[~worst["converged"], "convergence_time"] = np.nan
    worst.loc[~worst["finite"], worst.columns.difference(["converged", "finite", "scatter"])] = np.nan
    return worst.rename_axis(["lambda", "alpha"]).reset_index()


def summarise_runs(gains_name: str, side: str, runs: pd.DataFrame, gains: tuple[float, float]) -> JsonObject:
    """Summarise the runs of a side with the same gains (lambda, alpha): a row of `named` in `tuning.json`."""
    metrics = {metric: runs[f"{side}.{metric}"] for metric in GAIN_METRICS}
    converged, finite = metrics["converged"].astype(bool), runs["finite"].astype(bool)
    bound = metrics["f_plus"].max() if finite.all() else math.nan
    row: JsonObject = {
        "name": gains_name, "side": side, "lambda": gains[0], "alpha": gains[1], "runs": len(runs),
        "converged": float(converged.mean()), "finite": float(finite.mean()),
    }  # fmt: skip
    for metric in ("velocity_rmse", "torque_rmse", "convergence_time"):
        is_complete = converged.all() if metric == "convergence_time" else finite.all()
        row[metric] = {"worst": metrics[metric].max() if is_complete else None, "median": metrics[metric].median()}
    worst = {name: metrics[name].min() for name in ("margin_alpha", "margin_exact")}
    worst["convergence_time_worst"] = metrics["convergence_time_worst"].max()
    row |= worst if finite.all() else dict.fromkeys(worst)
    return to_jsonable(row | {"f_plus": bound, "peak_ratio": judge_gains(*gains, bound)["peak_ratio"]})
