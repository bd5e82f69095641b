"""The summary of a search for gains: the numbers of `tuning.json`, and remarks that a reader of them needs."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportReturnType=false

import math

import numpy as np
import pandas as pd

from jaxbl.files import to_jsonable
from jaxbl.json_types import JsonObject
from jaxbl.observer.conditions import judge_gains
from jaxbl.sweeps.metrics import SIDE_METRICS

from .best_gains import NEARLY_AS_GOOD
from .gain_search import GAIN_METRICS, GainSearch, Window
from .limits import LEAST_DIFFERENCE, find_limits


def pareto_front(candidates: pd.DataFrame) -> pd.DataFrame:
    """Select the feasible candidates that no other beats in both convergence time and error, fastest first."""
    feasible = candidates[candidates["feasible"]].sort_values(["convergence_time", "error"], kind="stable")
    return feasible[feasible["error"] < feasible["error"].cummin().shift(fill_value=math.inf)]


class Summary:
    """The summary of a finished search, with runs of the named gains and of the causes of the error."""

    def __init__(self, search: GainSearch):
        self.search, self.table = search, search.table
        self.named_rows, self.held_out_rows = (search.compare_gains(held_out=held_out) for held_out in (False, True))
        self.causes = search.split_error()
        self.limits = {side: find_limits(search, side) for side in search.sides}
        self.held_out = {
            side: {row["name"]: row for row in self.held_out_rows if row["side"] == side} for side in search.sides
        }
        self.factors = {side: self._compare_with_tuned(side) for side in search.sides}

    def to_dict(self) -> JsonObject:
        """The content of `tuning.json`."""
        search, table, sides = self.search, self.table, self.search.sides
        config, stages, best = search.scenarios.config, search.stages, search.best_candidates()
        conditions = {side: judge_gains(row["lambda"], row["alpha"], row["f_plus"]) for side, row in best.items()}
        unit = SIDE_METRICS[f"{table.objective}_rmse"].unit
        keys = ["lambda", "alpha", "lambda_ratio", "alpha_ratio"]
        achieved = [*GAIN_METRICS, "margin_alpha", "margin_exact", "f_plus"]
        return to_jsonable(stages.describe() | {
            "objective_metric": f"worst {table.objective}_rmse ({unit}) over seeds and scenarios",
            "scenarios": search.scenarios.names,
            "f_plus": search.f_plus,
            "pilot": search.pilot,
            "margins": {"exact": table.margin_exact, "alpha": table.margin_alpha},
            "verdict": {side: self._judge_side(side) for side in sides},
            "gains": {side: {key: row[key] for key in keys} for side, row in best.items()},
            "achieved": {
                side: {name: row[name] for name in achieved} | {"peak_ratio": conditions[side]["peak_ratio"]}
                for side, row in best.items()
            },
            "limits": self.limits,
            "conditions": conditions,
            "range": _ratio_ranges(search.limits) | {"num": table.num},
            "resolution": {side: {key: ratio - 1.0 for key, ratio in search.cell_ratios(side).items()} for side in sides},
            "stages": [{side: _ratio_ranges(window) for side, window in windows.items()} for windows in search.windows],
            "named": self.named_rows,
            "holdout": stages.describe_holdout(config.sweep.seeds)
            | {"f_plus": {side: search.pilot[side]["holdout_f_plus"] for side in sides}}
            | {"rows": self.held_out_rows, "factors": self.factors},
            "pareto": {
                side: pareto_front(search.candidates[side])[[*keys, "convergence_time", "error"]].to_dict("records")
                for side in sides
            },
            "remarks": [*config.notes, *self._remarks()],
        })  # fmt: skip

    def _judge_side(self, side: str) -> JsonObject:
        """Judge whether a side's gains matter, what limits the error, and how large the margin is.

        Gains do not matter if all of the coarse map that meet the constraints have nearly the least error.
        """
        search, best = self.search, self.search.find_best(side)
        candidates = search.candidates[side]
        feasible = candidates.query("stage == 0 and feasible")
        factor = float(feasible["error"].max()) / best.least_error
        tolerance = max(NEARLY_AS_GOOD, float(candidates["scatter"].iloc[best.index]))
        word = "range" if best.ends else "yes" if factor > 1.0 + tolerance else "no"
        return {
            "gains_matter": word,
            "worst_over_least": factor,
            "least_error": best.least_error,
            "margin": best.margin,
            "margins": best.margins,
            "causes": self.causes[side],
            "nearly_as_good": best.nearly_as_good,
            "tried": len(candidates),
        }

    def _compare_with_tuned(self, side: str) -> JsonObject:
        """Divide other gains' metrics by the tuned gains', on the held-out input.

        There are no factors for gains that do not always converge.
        """
        rows, factors = dict(self.held_out[side]), {}
        tuned = rows.pop("tuned")
        for name, row in rows.items():
            laggard, share = min((name, row["converged"]), ("tuned", tuned["converged"]), key=lambda pair: pair[1])
            if share < 1.0:
                factors[name] = {"why_none": f"{laggard}: converged in {100.0 * share:.3g} % of the runs"}
                continue
            factors[name] = {
                metric: {key: _divide(row[metric][key], tuned[metric][key]) for key in ("worst", "median")}
                for metric in ("velocity_rmse", "torque_rmse", "convergence_time")
            }
        return factors

    def _remarks(self) -> list[str]:
        search, table = self.search, self.table
        lines = []
        if table.worst_over_uncertainty and len(search.scenarios.names) == 1:
            lines.append("No inertia or viscous friction is uncertain (uncertainty.exact): only the nominal drive was run.")
        elif table.worst_over_uncertainty:
            lines.append(
                f"All metrics are the worst over {len(search.scenarios.names)} drives: {'; '.join(search.scenarios.names)}."
            )
        for side in search.sides:
            pilot = search.pilot[side]
            assumed = "assumed " * pilot["starting_error_assumed"]
            lines.append(
                f"{side}: f⁺ = {search.f_plus[side]:.4g} rad/s². In the pilot run, |acceleration - f(velocity)| is at most "
                f"{pilot['disturbance']:.4g}, and at the start, with viscous friction of the {assumed}starting error of "
                f"{pilot['velocity_error']:.3g} rad/s, {pilot['start']:.4g}{', which does not count' * bool(assumed)}."
            )
            lines += self._optimum_remarks(side)
        if table.holdout is None:
            lines.append(
                "No tune.holdout is given: gains are compared on the study's own excitation, with noise that the search did "
                "not see."
            )
        for side in search.sides:
            lines += self._holdout_remarks(side)
        return lines

    def _optimum_remarks(self, side: str) -> list[str]:
        search, row, lines = self.search, self.search.least_candidate(side), []
        labels = {"alpha": "alpha / f⁺", "lambda": "lambda / √f⁺"}
        for gain, direction in search.find_best(side).ends.items():
            end = search.limits[gain][direction == "larger"]
            lines.append(
                f"{side}: the optimum lies at the end {labels[gain]} = {end:g} of the range searched (tune.{gain}_ratio); "
                "beyond it may be better gains."
            )
        candidates = search.candidates[side]
        met = search.constraints_met(candidates)
        for key in search.rooms(candidates):
            others_met = np.logical_and.reduce([is_met for name, is_met in met.items() if name != key])
            missing_alone = candidates[~met[key] & others_met]
            if len(missing_alone) and missing_alone["error"].min() < (1.0 - LEAST_DIFFERENCE) * row["error"]:
                least = missing_alone.nsmallest(1, "error").iloc[0]
                where = "" if key in self.limits[side]["binding"] else ", if not beside the optimum"
                lines.append(
                    f"{side}: {key} = {getattr(self.table, key):g} forbids better gains{where}: of those tried, lambda = "
                    f"{least['lambda']:.3g}, alpha = {least['alpha']:.3g} miss it alone, with an error of "
                    f"{least['error']:.3g} instead of {row['error']:.3g}."
                )
        return lines

    def _holdout_remarks(self, side: str) -> list[str]:
        lines, tuned = [], self.held_out[side]["tuned"]
        bound, study_bound = self.search.pilot[side]["holdout_f_plus"], self.search.f_plus[side]
        if bound > study_bound:
            lines.append(
                f"{side}: the held-out excitation disturbs more than the study's (f⁺ = {bound:.3g} against "
                f"{study_bound:.3g} rad/s²): the margins there are smaller than asked for."
            )
        if tuned["converged"] < 1.0:
            lines.append(
                f"{side}: the tuned gains converge in only {100 * tuned['converged']:.3g} % of the held-out runs: the "
                "study's excitation is not representative of it."
            )
        for name, factors in self.factors[side].items():
            if "why_none" in factors and tuned["converged"] == 1.0:
                share = 100.0 * self.held_out[side][name]["converged"]
                gains = describe_gains(name)
                lines.append(f"{side}: {gains} converge in only {share:.3g} % of the held-out runs: no factor is stated.")
        return lines


def describe_gains(name: str) -> str:
    """Return what sentences call the gains of this name."""
    return {"usual rule": "the usual rule's gains", "config": "the study's own gains"}.get(name, f"the gains '{name}'")


def _ratio_ranges(window: Window) -> dict[str, list[float]]:
    return {f"{gain}_ratio": list(ends) for gain, ends in window.items()}


def _divide(number: float | None, divisor: float | None) -> float | None:
    return None if number is None or not divisor else number / divisor
