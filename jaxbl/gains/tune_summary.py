"""What a search for gains found: the numbers of `tuning.json`, and what a reader of them should know."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportReturnType=false

import math
from typing import Any

import numpy as np
import pandas as pd

from jaxbl.files import to_jsonable
from jaxbl.observer.conditions import judge_gains
from jaxbl.sweeps.metrics import SIDE_METRICS

from .gain_search import GAIN_METRICS, GainSearch, Window
from .limits import WORTH, limits_of

_FLAT = 0.05  # errors that differ by less are as good in practice


def pareto_front(candidates: pd.DataFrame) -> pd.DataFrame:
    """The feasible candidates that no other beats in both convergence time and error, fastest first."""
    feasible = candidates[candidates["feasible"]].sort_values(["convergence_time", "error"], kind="stable")
    before = feasible["error"].cummin().shift(fill_value=math.inf)
    return feasible[feasible["error"] < before]


class Summary:
    """Plain data of a finished search, as in `tuning.json`.

    Args:
        search: the finished search.
        named: comparison of the named gains on the study's own runs: rows of :func:`.gain_search.summarise_runs`.
        held_out: the same on the held-out runs.
    """

    def __init__(self, search: GainSearch, named: list[dict[str, Any]], held_out: list[dict[str, Any]]):
        self.search, self.table, self.config = search, search.table, search.scenarios.config
        self.best_candidates = {side: search.best_candidate(side) for side in search.sides}
        self.conditions = {
            side: judge_gains(row["lambda"], row["alpha"], row["f_plus"]) for side, row in self.best_candidates.items()
        }
        self.limits = {side: limits_of(search, side) for side in search.sides}
        self.named, self.rows = named, held_out
        self.held_out = {side: {row["name"]: row for row in held_out if row["side"] == side} for side in search.sides}
        self.factors = {side: self._factors(side) for side in search.sides}

    def data(self) -> dict[str, Any]:
        """What `tuning.json` holds."""
        search, table, sides = self.search, self.table, self.search.sides
        first, seeds = self.config.sweep.first_seed, self.config.sweep.seeds
        unit = SIDE_METRICS[f"{table.objective}_rmse"].unit
        keys = ("lambda", "alpha", "lambda_ratio", "alpha_ratio")
        return {
            "title": self.config.title,
            "objective": table.objective,
            "objective_metric": f"worst {table.objective}_rmse ({unit}) over seeds and scenarios",
            "seeds": [first, first + seeds - 1],
            "scenarios": search.scenarios.names,
            "f_plus": search.f_plus,
            "pilot": search.pilot,
            "margins": {"exact": table.margin_exact, "alpha": table.margin_alpha},
            "gains": {side: {key: float(self.best_candidates[side][key]) for key in keys} for side in sides},
            "achieved": {side: self._achieved(side) for side in sides},
            "limits": self.limits,
            "conditions": self.conditions,
            "range": _ratios(search.limits) | {"num": table.num},
            "resolution": {side: {key: ratio - 1.0 for key, ratio in search.cell_ratios(side).items()} for side in sides},
            "stages": [{side: _ratios(window) for side, window in windows.items()} for windows in search.windows],
            "named": self.named,
            "holdout": {
                "excitation": (table.holdout or self.config.excitation).model_dump(by_alias=True, exclude_none=True),
                "same_excitation": table.holdout is None,
                "seeds": [first + seeds, first + 2 * seeds - 1],
                "f_plus": {side: search.pilot[side]["holdout_f_plus"] for side in sides},
                "rows": self.rows,
                "factors": self.factors,
            },
            "pareto": {side: self._front(side) for side in sides},
            "remarks": [*self.config.notes, *self._remarks()],
        }

    def _achieved(self, side: str) -> dict[str, Any]:
        names, rho = (name for name in GAIN_METRICS if name != "converged"), self.conditions[side]["peak_ratio"]
        return to_jsonable({name: self.best_candidates[side][name] for name in names} | {"peak_ratio": rho})

    def _front(self, side: str) -> list[dict[str, Any]]:
        names = ["lambda", "alpha", "lambda_ratio", "alpha_ratio", "convergence_time", "error"]
        return to_jsonable(pareto_front(self.search.candidates[side])[names].to_dict("records"))

    def _factors(self, side: str) -> dict[str, Any]:
        """Other gains' figures over the tuned ones', on the held-out input; none for gains that do not always converge."""
        tuned, out = self.held_out[side]["tuned"], {}
        for name, row in self.held_out[side].items():
            if name == "tuned":
                continue
            if row["converged"] < 1.0 or tuned["converged"] < 1.0:
                who, share = min((name, row["converged"]), ("tuned", tuned["converged"]), key=lambda pair: pair[1])
                out[name] = {"why_none": f"{who}: converged in {100.0 * share:.3g} % of the runs"}
                continue
            out[name] = {
                figure: {how: _ratio(row[figure][how], tuned[figure][how]) for how in ("worst", "median")}
                for figure in ("velocity_rmse", "torque_rmse", "convergence_time")
            }
        return out

    def _remarks(self) -> list[str]:
        search, table = self.search, self.table
        lines = []
        if table.worst_over_uncertainty and len(search.scenarios.names) == 1:
            lines.append("No inertia or viscous friction is uncertain (uncertainty.exact): only the nominal drive was run.")
        elif table.worst_over_uncertainty:
            lines.append(
                f"All figures are the worst over {len(search.scenarios.names)} drives: {'; '.join(search.scenarios.names)}."
            )
        for side in search.sides:
            pilot = search.pilot[side]
            if pilot["starting_error_assumed"]:
                lines.append(
                    f"{side}: the study gives the observer no starting error, which a convergence time needs: it starts "
                    f"with a velocity error of {pilot['velocity_error']:.3g} rad/s, the largest velocity of the pilot run."
                )
            lines.append(
                f"{side}: f⁺ = {search.f_plus[side]:.4g} rad/s², the larger of two figures of the pilot run: the largest "
                f"|acceleration - f(velocity)| along it, {pilot['disturbance']:.4g}, and that at the start with viscous "
                f"friction times the starting error, {pilot['start']:.4g}."
            )
            lines += self._about_optimum(side)
        if table.holdout is None:
            lines.append(
                "No tune.holdout is given: gains are compared on the study's own excitation, with noise that the search did "
                "not see."
            )
        for side in search.sides:
            lines += self._about_holdout(side)
        return lines

    def _about_optimum(self, side: str) -> list[str]:
        search, row, lines = self.search, self.best_candidates[side], []
        labels = {"alpha": "alpha / f⁺", "lambda": "lambda / √f⁺"}
        for way, gain in map(str.split, self.limits[side]["range_ends"]):
            end = search.limits[gain][way == "larger"]
            lines.append(
                f"{side}: the optimum lies at the end {labels[gain]} = {end:g} of the range searched (tune.{gain}_ratio); "
                "beyond it may be better gains."
            )
        found = search.candidates[side]
        kept = search.constraints_met(found)
        for key in kept:
            # gains that miss this constraint alone
            missed = found[~kept[key] & np.logical_and.reduce([values for name, values in kept.items() if name != key])]
            if key != "converged" and len(missed) and missed["error"].min() < (1.0 - WORTH) * row["error"]:
                least = missed.nsmallest(1, "error").iloc[0]
                where = "" if key in self.limits[side]["binding"] else ", if not beside the optimum"
                lines.append(
                    f"{side}: {key} = {getattr(self.table, key):g} forbids better gains{where}: of those tried, lambda = "
                    f"{least['lambda']:.3g}, alpha = {least['alpha']:.3g} miss it alone, with an error of "
                    f"{least['error']:.3g} instead of {row['error']:.3g}."
                )
        coarse = found.query("stage == 0 and feasible")
        near = coarse[coarse["error"] <= (1.0 + _FLAT) * row["error"]]
        if len(near) > 1:
            ends = ", ".join(f"{gain} from {near[gain].min():.3g} to {near[gain].max():.3g}" for gain in ("alpha", "lambda"))
            share = f"{len(near)} points of the coarse map are within {100 * _FLAT:.0f} % of it"
            lines.append(f"{side}: the optimum is flat: {share}, {ends}.")
        return lines

    def _about_holdout(self, side: str) -> list[str]:
        lines, tuned = [], self.held_out[side]["tuned"]
        bound, own = self.search.pilot[side]["holdout_f_plus"], self.search.f_plus[side]
        if bound > own:
            lines.append(
                f"{side}: the held-out excitation disturbs more than the study's (f⁺ = {bound:.3g} against {own:.3g} "
                "rad/s²): the margins there are smaller than asked for."
            )
        if tuned["converged"] < 1.0:
            lines.append(
                f"{side}: the tuned gains converge in only {100 * tuned['converged']:.3g} % of the held-out runs: the "
                "study's excitation is not representative of it."
            )
        for name, found in self.factors[side].items():
            if "why_none" in found and tuned["converged"] == 1.0:
                share = 100.0 * self.held_out[side][name]["converged"]
                lines.append(
                    f"{side}: {called_gains(name)} converge in only {share:.3g} % of the held-out runs: no factor is stated."
                )
        return lines


def called_gains(name: str) -> str:
    """How sentences call some gains of a comparison."""
    return {"usual rule": "the usual rule's gains", "config": "the study's own gains"}.get(name, f"the gains '{name}'")


def _ratios(window: Window) -> dict[str, list[float]]:
    return {f"{gain}_ratio": list(ends) for gain, ends in window.items()}


def _ratio(value: float | None, other: float | None) -> float | None:
    return None if value is None or not other else value / other
