"""The search for lambda and alpha behind `jaxbl tune`: a coarse map of both gains, then zooms around the best point."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false

import math
from typing import Any

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
from .stages import Stages

Gains = dict[str, tuple[float, float]]
"""lambda (rad^0.5/s) and alpha (rad/s^2) of each side."""

Window = dict[str, tuple[float, float]]
"""Ends of the ratios searched on one side: alpha / f⁺ under `alpha`, lambda / √f⁺ under `lambda`."""

GAIN_METRICS = ("convergence_time", "convergence_time_worst", "velocity_rmse", "torque_rmse", "chatter")
"""Metrics of a side by which gains are judged, besides whether runs converge, and the margins; of all less is better."""

LIMITED_COLUMNS = {
    "margin_alpha": "margin_alpha",
    "margin_exact": "margin_exact",
    "longest_convergence": "convergence_time",
}
"""For each constraint with a number, by its key in `[tune]`, the column of the candidates that it limits."""

_LEAST_STEP = 0.02
"""Relative step of a gain below which another zoom is not worth its runs: gains are tried, and given, with three digits."""

_WIDEST = {"alpha": (1.1, 1e4), "lambda": (0.03, 500.0)}
"""Bounds of the ratios up to which a range is widened that the study leaves at its default."""


def usual_rule(f_plus: float) -> tuple[float, float]:
    """The usual rule (Levant 1998): lambda = 1.5 sqrt(f_plus) (rad^0.5/s) and alpha = 1.1 f_plus (rad/s^2)."""
    return 1.5 * math.sqrt(f_plus), 1.1 * f_plus


def gain_units(f_plus: float) -> dict[str, float]:
    """The sizes that f_plus (rad/s^2) gives the gains: ratios of gains are to these."""
    return {"alpha": f_plus, "lambda": math.sqrt(f_plus)}


def grid_ratio(ends: tuple[float, float], num: int) -> float:
    """Ratio of neighbouring values among `num` from end to end, evenly spaced on a logarithmic scale."""
    return (ends[1] / ends[0]) ** (1.0 / (num - 1))


class GainSearch:
    """The stages of a search for gains: coarse map, zooms, comparison.

    Args:
        scenarios: the drives that the gains must serve.
        pilot: results of the pilot run by side (:func:`.pilot.run_pilot`).
        stages: runs each stage as a study of its own.

    Attributes:
        table: what is asked of the gains.
        f_plus: bound of the disturbance by side, rad/s^2.
        limits: the whole range of each ratio.
        windows: ranges searched in each stage, by side.
        candidates: table of the gains tried, by side, as in :class:`.tune.Tuning`.
    """

    def __init__(self, scenarios: Scenarios, pilot: JsonObject, stages: Stages):
        self.scenarios, self.pilot, self.stages, self.table = scenarios, pilot, stages, stages.table
        self.sides, table = tuple(pilot), stages.table
        self.f_plus = {side: float(pilot_values["f_plus"]) for side, pilot_values in pilot.items()}
        for side, bound in self.f_plus.items():
            if not bound > 0.0:
                raise no_disturbance_error(side)
        self.limits = self._read_limits(table)
        self.windows = [dict.fromkeys(self.sides, self.limits)]
        self.candidates: dict[str, pd.DataFrame] = {}
        named, causes = len(TUNE_NAMES) + len(table.compare), 1 + len(list_causes(scenarios.config).names)
        gain_pairs = table.num**2 * (1 + table.refine) + 2 * named + causes
        stages.total_lanes = scenarios.config.sweep.seeds * len(scenarios.names) * gain_pairs

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
                    (low, high), (least, largest) = limits[gain], _WIDEST[gain]
                    limits[gain] = (least, high) if way == "smaller" else (low, largest)
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

    def best_candidates(self) -> dict[str, JsonObject]:
        """Return the best feasible candidate of each side."""
        return {side: self.best_candidate(side) for side in self.sides}

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
            ratios = {}
            for gain, unit in gain_units(self.f_plus[side]).items():
                values = unit * np.geomspace(*window[gain], self.table.num)
                # a map that is finer than three digits keeps more
                digits = 3 if grid_ratio(window[gain], self.table.num) - 1.0 >= _LEAST_STEP else 16
                axes[gain][f"observer.{side}.{gain}"] = values = [float(f"{value:.{digits}g}") for value in values]
                ratios[gain] = values[0] / unit, values[-1] / unit
            self.windows[stage][side] = ratios
        frame = self._run_study(name, axes)
        for side in self.sides:
            new = self._mark_feasible(side, self._reduce_to_worst(frame, side, self.f_plus[side])).assign(stage=stage)
            self.candidates[side] = pd.concat([self.candidates[side], new], ignore_index=True) if stage else new
            if not self.candidates[side]["feasible"].any():
                raise NoResult(self._explain_failure(side))

    def _reduce_to_worst(self, frame: pd.DataFrame, side: str, bound: float) -> pd.DataFrame:
        """Reduce runs to one row for each pair of gains: the worst over scenarios and seeds, and the margins at a bound f⁺.

        The bound is a pilot run's: along a run f⁺ may have the friction of an assumed starting error, and none of what other
        machines add. Metrics are NaN if a run diverged, and the convergence time if one did not converge. `chatter` is that
        of the run with the largest error, `scatter` the relative standard error of its mean over the seeds.
        """
        keys, error = [f"observer.{side}.lambda", f"observer.{side}.alpha"], f"{self.table.objective}_rmse"
        runs = frame[[*keys, "finite"]].assign(**{name: frame[f"{side}.{name}"] for name in ("converged", *GAIN_METRICS)})
        groups = runs.groupby(keys, sort=True)
        worst = pd.DataFrame(groups[[*GAIN_METRICS]].max()).join(groups[["converged", "finite"]].all())
        # chatter is a part of the error: it belongs to the run with the largest one
        worst["chatter"] = runs.sort_values(error, kind="stable").groupby(keys, sort=True)["chatter"].last()
        seeds = frame.groupby([*keys, *self.scenarios.columns])[f"{side}.{error}"].agg(["mean", "sem"])
        # one seed has none
        worst["scatter"] = (seeds["sem"] / seeds["mean"]).groupby(level=[0, 1]).max().fillna(0.0)
        worst = worst.rename_axis(["lambda", "alpha"]).reset_index()
        least = apply_elementwise(CONDITIONS["exact"].least_lambda, [worst["alpha"], np.full(len(worst), bound)])
        worst = worst.assign(f_plus=bound, margin_alpha=worst["alpha"] / bound, margin_exact=worst["lambda"] / least)
        # a maximum that leaves out failed runs is not the worst
        worst.loc[~worst["converged"], "convergence_time"] = np.nan
        columns = ["lambda", "alpha", "converged", "finite", "scatter"]
        worst.loc[~worst["finite"], worst.columns.difference(columns)] = np.nan
        return worst

    def _mark_feasible(self, side: str, candidates: pd.DataFrame) -> pd.DataFrame:
        ratios = {f"{gain}_ratio": candidates[gain] / unit for gain, unit in gain_units(self.f_plus[side]).items()}
        return candidates.assign(
            **ratios,
            error=candidates[f"{self.table.objective}_rmse"],
            feasible=np.logical_and.reduce(list(self.constraints_met(candidates).values())),
        )

    def rooms(self, candidates: pd.DataFrame) -> dict[str, pd.Series]:
        """For each constraint with a number, by its key in `[tune]`, the factors between candidates and limit: 1 at it."""
        rooms = {key: candidates[key] / getattr(self.table, key) for key in ("margin_alpha", "margin_exact")}
        if self.table.longest_convergence is not None:
            rooms["longest_convergence"] = self.table.longest_convergence / candidates["convergence_time"]
        return rooms

    def constraints_met(self, candidates: pd.DataFrame) -> NamedArrays:
        """For each constraint (`converged`, or its key in `[tune]`) an array: True for the candidates that meet it."""
        met = {key: (room >= 1.0).to_numpy() for key, room in self.rooms(candidates).items()}
        return {"converged": candidates["converged"].to_numpy(bool)} | met

    def _explain_failure(self, side: str) -> str:
        candidates, alpha, lambda_ = self.candidates[side], self.limits["alpha"], self.limits["lambda"]
        run = self.scenarios.config.run
        best_reached = {
            "converged": f"least velocity error {candidates['velocity_rmse'].min():.3g} rad/s rms, "
            f"run.velocity_tolerance = {run.velocity_tolerance:g}, run.position_tolerance = {run.position_tolerance:g}",
            "margin_alpha": f"largest {candidates['margin_alpha'].max():.3g}",
            "margin_exact": f"largest {candidates['margin_exact'].max():.3g}",
            "longest_convergence": f"fastest {candidates['convergence_time'].min():.3g} s",
        }
        counts = "; ".join(
            f"{key if key == 'converged' else f'{key} = {getattr(self.table, key):g}'}: {met.sum()} ({best_reached[key]})"
            for key, met in self.constraints_met(candidates).items()
        )
        return (
            f"{side}: none of the {len(candidates)} gains with alpha / f⁺ in {alpha[0]:g} ... {alpha[1]:g} and "
            f"lambda / √f⁺ in {lambda_[0]:g} ... {lambda_[1]:g} (f⁺ = {self.f_plus[side]:.3g} rad/s²) keeps "
            f"all constraints in all runs; how many keep each: {counts}"
        )

    def _list_named_gains(self) -> dict[str, Gains]:
        """Gains to compare by name: the tuned ones, the usual rule's, the study's, and those of `tune.compare`."""

        def read(table: Any) -> Gains:
            observers = {side: getattr(table, side) for side in self.sides}
            return {side: (float(observer.lambda_), float(observer.alpha)) for side, observer in observers.items()}

        tuned = {side: (float(row["lambda"]), float(row["alpha"])) for side, row in self.best_candidates().items()}
        usual = {side: usual_rule(bound) for side, bound in self.f_plus.items()}
        named = dict(zip(TUNE_NAMES, (tuned, usual, read(self.scenarios.config.observer)), strict=True))
        return named | {gains.name: read(gains) for gains in self.table.compare}

    def compare_gains(self, *, held_out: bool) -> list[JsonObject]:
        """Compare all named gains: a row for each name and side.

        The runs have the study's own excitation and seeds, or if `held_out` the held-out excitation and other seeds.
        """
        gains_by_name = self._list_named_gains()
        # gains of two names may be the same, points of a study may not
        unique = list({tuple(gains.values()): gains for gains in gains_by_name.values()}.values())
        frame = self._run_study("holdout" if held_out else "named", {"gains": _gain_columns(unique)}, held_out=held_out)
        rows = []
        for name, gains in gains_by_name.items():
            for side, (lambda_, alpha) in gains.items():
                is_pair = (frame[f"observer.{side}.lambda"] == lambda_) & (frame[f"observer.{side}.alpha"] == alpha)
                # another pair may share this side's gains: its runs are the same
                runs = frame[is_pair].drop_duplicates([*self.scenarios.columns, "seed"])
                bound = self.pilot[side]["holdout_f_plus" if held_out else "f_plus"]
                worst = self._reduce_to_worst(runs, side, bound).iloc[0]
                rows.append({
                    "name": name, "side": side, "lambda": lambda_, "alpha": alpha, "runs": len(runs),
                    "converged": runs[f"{side}.converged"].mean(), "finite": runs["finite"].mean(),
                    **{
                        metric: {"worst": worst[metric], "median": runs[f"{side}.{metric}"].median()}
                        for metric in ("velocity_rmse", "torque_rmse", "convergence_time")
                    },
                    **worst[["margin_alpha", "margin_exact", "convergence_time_worst", "f_plus"]],
                    "peak_ratio": judge_gains(lambda_, alpha, worst["f_plus"])["peak_ratio"],
                })  # fmt: skip
        return to_jsonable(rows)

    def split_error(self) -> dict[str, dict[str, float]]:
        """Split the mean square error of the best gains by its causes (:class:`.expected_error.Causes`), by side."""
        causes, gains = list_causes(self.scenarios.config), _gain_columns([self._list_named_gains()["tuned"]])
        frame = self._run_study("causes", {"gains": gains, "causes": causes.columns})
        return {side: causes.split(frame, f"{side}.{self.table.objective}_rmse")[1] for side in self.sides}

    def _run_study(self, name: str, axes: dict[str, dict[str, list[float]]], *, held_out: bool = False) -> pd.DataFrame:
        """Run one stage. Its axes are the scenarios' columns and `axes`: columns by label, which advance together."""
        config = self.scenarios.config
        data = self.stages.tables_of(config, name, config.sweep.seeds if held_out else None)
        for side in self.sides:
            data["observer"][side]["velocity_error"] = self.pilot[side]["velocity_error"]
        data["axes"] = list_axes({"scenario": self.scenarios.columns} | axes)
        result = self.stages.run(data, name)
        names = [f"{side}.{metric}" for side in self.sides for metric in ("converged", *GAIN_METRICS)]
        return result.read([*(axis["path"] for axis in data["axes"]), "seed", "finite", *names])


def _gain_columns(pairs: list[Gains]) -> dict[str, list[float]]:
    """Return columns of an axis, by path, whose rows are these gains."""
    return {
        f"observer.{side}.{key}": [gains[side][i] for gains in pairs]
        for side in pairs[0]
        for i, key in enumerate(("lambda", "alpha"))
    }
