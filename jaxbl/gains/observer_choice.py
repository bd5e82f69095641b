"""The choice of the kind of observer for a drive: `jaxbl tune` with `tune.observers`.

Each kind is tuned by the same search on the same runs: quasi-random gains over the range of its class, then over zooms
around the best ones. Each side is searched by its own error. The tuned observers are then compared on held-out runs under
the same noise. With `tune.axes` this is done at each point of a grid.
"""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false

import dataclasses
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from jaxbl.chain import NamedArrays
from jaxbl.config import with_values
from jaxbl.files import to_jsonable
from jaxbl.json_types import JsonObject
from jaxbl.lines import percent
from jaxbl.observer import OBSERVERS, OperatingConditions
from jaxbl.sweeps.metrics import SIDE_METRICS, no_disturbance_error
from jaxbl.sweeps.points import Points, draw_sobol

from .pilot import Scenarios, list_scenarios, run_pilot
from .stages import GainChoice, Stages, set_keys

TIME_CONSTANT = "equivalent_control.time_constant"
"""Searched together with the gains if the torque is the objective: its estimate is behind this low-pass."""
LEAST_HELD_OUT_SEEDS = 8
"""Least number of held-out seeds: fewer give a wide interval."""
_CONFIDENCE = 0.95
_UNFINISHED_SHARE = 0.02
"""Relative gain of the last zoom beyond which a search is reported as unfinished."""
_ROUNDING_RMS = 1.0 / math.sqrt(12.0)
"""Rms error of rounding to a resolution of one."""

GainValues = dict[str, float]
"""Values of gains by config path."""


class ObserverChoice(GainChoice):
    """Kinds of observer compared, each with tuned gains."""


@dataclasses.dataclass
class SideSearch:
    """The search for the gains of one kind on one side at one point.

    Attributes:
        limits: ends of the range of each gain, by config path.
        widest_cell: most half width of the next window, as a share of the last one on a log scale.
        window: the part of the ranges that is searched next.
        best: gains with the least error so far.
        error: the least error so far.
        error_before: the error before the last zoom.
        held_out: errors of the best gains on held-out runs, the worst over the scenarios, shape (held-out seeds,);
            infinite if there are none.
    """

    limits: dict[str, tuple[float, float]]
    widest_cell: float = 1.0
    best: GainValues = dataclasses.field(default_factory=dict)
    error: float = math.inf
    error_before: float = math.inf
    held_out: Any = math.inf

    def __post_init__(self):
        self.window = dict(self.limits)

    def trial_gains(self, unit: np.ndarray) -> list[GainValues]:
        """Return the gains at points of the unit cube, shape (trials, free gains)."""
        columns = iter(unit.T)
        gains = {
            path: low * (high / low) ** next(columns) if low < high else np.full(len(unit), low)
            for path, (low, high) in self.window.items()
        }
        return pd.DataFrame(gains).to_dict("records")

    def zoom_in(self, trials: Sequence[GainValues], errors: np.ndarray) -> None:
        """Store the best of the trials, and zoom in on it: to two cells of a grid with as many points."""
        self.error_before, best_trial = self.error, int(np.argmin(errors))
        if errors[best_trial] < self.error:
            self.error, self.best = float(errors[best_trial]), trials[best_trial]
        if not self.best:
            return
        free = [path for path, (low, high) in self.window.items() if low < high]
        for path in free:
            (low, high), (least, largest) = self.window[path], self.limits[path]
            cell = (high / low) ** min(len(errors) ** (-1.0 / len(free)), self.widest_cell)
            self.window[path] = max(self.best[path] / cell, least), min(self.best[path] * cell, largest)

    def gains_at_ends(self) -> list[str]:
        """Return the gains whose best value is at an end of their range."""
        return [
            path
            for path, value in self.best.items()
            for low, high in [self.limits[path]]
            if low < high and min(value / low, high / value) < (high / low) ** 0.01
        ]


class MapPoint(NamedTuple):
    """A point of the map.

    Attributes:
        values: by path.
        lane: those of them that differ within a group.
        scenarios: drives that the observers must serve.
        pilot: results of the pilot run by side.
        searches: by kind, the sides' searches.
    """

    values: JsonObject
    lane: dict[str, float]
    scenarios: Scenarios
    pilot: JsonObject
    searches: dict[str, dict[str, SideSearch]]


def choose_observer(stages: Stages) -> ObserverChoice:
    """Tune and compare the kinds `tune.observers`."""
    search = _KindSearch(stages)
    for kind in stages.table.observers:
        search.tune(kind)
    return ObserverChoice(stages.config, _summary(search), stages.cost, tuple(stages.fallback_reasons))


class _KindSearch:
    """Searches of all kinds at all points."""

    def __init__(self, stages: Stages):
        self.stages, self.table, self.sides = stages, stages.table, stages.config.sides
        seeds = stages.config.sweep.seeds
        self.held_out_seeds = max(seeds, LEAST_HELD_OUT_SEEDS)
        self.groups = _group_points(stages)
        self.trials = self.table.trials * (1 + self.table.refine)
        rows = sum(len(point.scenarios.names) for point in chain.from_iterable(self.groups))
        runs = len(self.table.observers) * rows * len(self._side_sets())
        stages.total_lanes = runs * (self.trials * seeds + self.held_out_seeds)

    def _side_sets(self) -> list[tuple[str, ...]]:
        """Return the sets of sides that are searched in the same runs.

        Sides share no gain except the time constant of the low-pass on the equivalent control.
        """
        return [(side,) for side in self.sides] if self.table.objective == "torque" else [self.sides]

    def tune(self, kind: str) -> None:
        """Find the gains of a kind on both sides, and their held-out errors, at all points."""
        for number, points in enumerate(self.groups):
            searches = [self._start_searches(kind, point) for point in points]
            free = sum(low < high for low, high in searches[0][self.sides[0]].limits.values())
            for stage in range(1 + self.table.refine):
                unit = draw_sobol(free, self.table.trials, stage)
                trials = [{side: search.trial_gains(unit) for side, search in sides.items()} for sides in searches]
                rows = [
                    (point, {side: gains[j] for side, gains in sides.items()})
                    for point, sides in zip(points, trials, strict=True)
                    for j in range(len(unit))
                ]
                for side, errors in self._run_trials(kind, f"{number}-{stage}", rows).items():
                    worst = errors.max(axis=1).reshape(len(searches), len(unit))
                    for sides, trial, trial_errors in zip(searches, trials, worst, strict=True):
                        sides[side].zoom_in(trial[side], trial_errors)
            rows = [
                (point, {side: search.best for side, search in sides.items()})
                for point, sides in zip(points, searches, strict=True)
                if all(search.best for search in sides.values())
            ]
            errors_by_side = self._run_trials(kind, f"{number}-holdout", rows, held_out=True) if rows else {}
            for side, errors in errors_by_side.items():
                for (point, _), held_out in zip(rows, errors, strict=True):
                    point.searches[kind][side].held_out = held_out

    def _start_searches(self, kind: str, point: MapPoint) -> dict[str, SideSearch]:
        """Start the searches of a kind at a point, one per side, with the ranges of its gains."""
        config = point.scenarios.config
        encoders, period = config.encoders.build(), config.run.sample_period
        searches = point.searches[kind] = {}
        for side in self.sides:
            noise = math.hypot(encoders.noise, _ROUNDING_RMS * encoders.resolution_of(side))
            ranges = OBSERVERS[kind].gain_ranges(OperatingConditions(point.pilot[side]["f_plus"], period, noise))
            limits = {f"observer.{side}.{gain}": ends for gain, ends in ranges.items()}
            if self.table.objective == "torque":
                limits[TIME_CONSTANT] = period / 3.0, 1e3 * period
            searches[side] = SideSearch(limits)
        return searches

    def _run_trials(
        self,
        kind: str,
        name: str,
        rows: Sequence[tuple[MapPoint, Mapping[str, GainValues]]],
        *,
        held_out: bool = False,
    ) -> NamedArrays:
        """Run trials (`rows`: point of a group, gains by side), and return errors by side, shape (rows, seeds).

        They are the worst over the scenarios, and infinite if a run diverged or took too long to converge.
        """
        longest, errors_by_side = self.table.longest_convergence, {}
        names = [f"{self.table.objective}_rmse", *(["convergence_time"] if longest is not None else [])]
        for sides in self._side_sets():
            trials = pd.DataFrame([
                point.lane
                | {f"observer.{side}.velocity_error": point.pilot[side]["velocity_error"] for side in self.sides}
                # a gain that sides share is taken from those that the runs are for
                | {path: value for side in reversed((*sides, *self.sides)) for path, value in gains[side].items()}
                | {path: column[corner] for path, column in point.scenarios.columns.items()}
                for point, gains in rows
                for corner in range(len(point.scenarios.names))
            ])  # fmt: skip
            stage = f"{kind}-{'-'.join(sides)}-{name}"
            config, seeds = rows[0][0].scenarios.config, self.held_out_seeds if held_out else None
            tables = self.stages.tables_of(config, stage, seeds)
            starts = {side: {"position_error": tables["observer"][side]["position_error"]} for side in self.sides}
            tables["observer"] |= {"kind": kind} | starts
            # gains of the kind, in place of the study's
            first = {path: value for path, value in trials.iloc[0].items() if path.startswith("observer.")}
            tables = set_keys(tables, first)
            columns = [f"{side}.{metric}" for side in sides for metric in names]
            metrics = self.stages.run_trials(tables, stage, trials, columns)
            for side in sides:
                errors = metrics[f"{side}.{names[0]}"]
                is_good = np.isfinite(errors)
                if longest is not None:
                    is_good &= metrics[f"{side}.convergence_time"] <= longest
                errors = np.where(is_good, errors, np.inf)
                errors_by_side[side] = errors.reshape(len(rows), -1, errors.shape[1]).max(axis=1)
        return errors_by_side


def _group_points(stages: Stages) -> list[list[MapPoint]]:
    """Group the points of the map by what is fixed at compile time, with a pilot run for each plant."""
    config, table = stages.config, stages.table
    grid = config.sweep.model_copy(update={"design": "grid", "points": None, "refine": None, "metrics": None})
    points = Points(config.model_copy(update={"axes": table.axes, "sweep": grid}))
    stored_pilots: JsonObject = dict(stages.manifest.get("pilots", {}))
    groups, pilots = [], {}
    for group in points.groups:
        columns = points.columns(np.arange(points.group_size))
        map_points = []
        for i in range(points.group_size):
            lane = {path: to_jsonable(column[i]) for path, column in columns.items()}
            scenarios = list_scenarios(with_values(group.config, lane), table.worst_over_uncertainty)
            values = group.structural | lane
            # encoders change nothing of the plant
            key = repr({path: value for path, value in values.items() if not path.startswith("encoders.")})
            if key not in pilots:
                pilots[key] = stored_pilots.get(key) or run_pilot(scenarios, table.holdout)
                for side, pilot in pilots[key].items():
                    if not pilot["f_plus"] > 0.0:
                        raise no_disturbance_error(side)
            point_values = {axis.path: values[axis.path] for axis in table.axes}
            map_points.append(MapPoint(point_values, lane, scenarios, pilots[key], {}))
        groups.append(map_points)
    if stored_pilots != pilots:
        stages.write_manifest(pilots=pilots)
    return groups


def rank_kinds(errors: Mapping[str, np.ndarray]) -> dict[str, JsonObject]:
    """Rank kinds by their error, least first, with the ratio to the best kind's error.

    Args:
        errors: errors by kind, shape (runs,), from the same two runs or more; positive or infinite.

    Returns:
        By kind: `error` (geometric mean over the runs), `worst`, and `ratio`, the geometric mean of the ratios to the best
        kind's error in the same run, with its 95 % interval `low` ... `high` (Student's t on the logarithms). All are None
        for a kind with an infinite error.
    """
    from scipy.stats import t  # slow to load

    logs = {
        kind: np.log(np.maximum(kind_errors, np.finfo(float).tiny))
        for kind, kind_errors in errors.items()
        if np.isfinite(kind_errors).all()
    }
    order = sorted(logs, key=lambda kind: float(logs[kind].mean()))
    ranking: dict[str, JsonObject] = {}
    for kind in order:
        log_ratios = logs[kind] - logs[order[0]]
        quantile = float(t.ppf(0.5 * (1.0 + _CONFIDENCE), len(log_ratios) - 1))
        half = quantile * float(log_ratios.std(ddof=1)) / math.sqrt(len(log_ratios))
        mean = float(log_ratios.mean())
        ranking[kind] = {
            "error": math.exp(float(logs[kind].mean())),
            "worst": float(errors[kind].max()),
            "ratio": math.exp(mean),
            "low": math.exp(mean - half),
            "high": math.exp(mean + half),
        }
    for kind in errors:
        ranking.setdefault(kind, dict.fromkeys(("error", "worst", "ratio", "low", "high")))
    return ranking


def list_ties(ranking: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """List the kinds whose error may be as small as the best one's (:func:`rank_kinds`), without the best."""
    return [kind for kind, rank in list(ranking.items())[1:] if rank["low"] is not None and rank["low"] <= 1.0]


def runs_are_equal(rank: Mapping[str, Any]) -> bool:
    """True if a kind's ratio (:func:`rank_kinds`) is the same in all runs, but for rounding: there is no interval then."""
    return rank["high"] - rank["low"] < 1e-9 * rank["ratio"]


def _summary(search: _KindSearch) -> JsonObject:
    """Return the content of `tuning.json`."""
    stages, table, points = search.stages, search.table, []
    for point in chain.from_iterable(search.groups):
        sides = {}
        for side in search.sides:
            ranking = rank_kinds({kind: searches[side].held_out for kind, searches in point.searches.items()})
            for kind, rank in ranking.items():
                rank |= _describe_search(point.searches[kind][side], side)
            best = next(iter(ranking))
            sides[side] = {
                "best": best if ranking[best]["ratio"] is not None else None,
                "not_told_apart": list_ties(ranking),
                "f_plus": point.pilot[side]["f_plus"],
                "kinds": ranking,
            }
        points.append({"values": point.values, "sides": sides})
    summary = stages.describe() | {
        "objective_metric": f"{table.objective}_rmse ({SIDE_METRICS[f'{table.objective}_rmse'].unit})",
        "observers": table.observers,
        "trials": search.trials,
        "scenarios": search.groups[0][0].scenarios.names,
        "axes": [axis.path for axis in table.axes],
        "holdout": stages.describe_holdout(search.held_out_seeds),
        "points": points,
        "remarks": [*stages.config.notes, *_remarks(search, points)],
    }
    if len(points) == 1:
        summary["for_both_sides"] = _for_both_sides(points[0]["sides"], table.observers)
    return to_jsonable(summary)


def _describe_search(side: SideSearch, name: str) -> JsonObject:
    """Describe the search of a kind: its gains by key, its error, the gain by the last zoom, and gains at range ends."""
    return {
        "gains": {path.removeprefix(f"observer.{name}."): value for path, value in side.best.items()},
        "error_in_search": side.error,
        "gained_by_last_zoom": 1.0 - side.error / side.error_before if 0.0 < side.error_before < math.inf else None,
        "at_range_end": [path.removeprefix(f"observer.{name}.") for path in side.gains_at_ends()],
    }


def _for_both_sides(sides: Mapping[str, Any], observers: Sequence[str]) -> str | None:
    """Return the kind with the least product of errors, as a study has one kind for both sides."""
    ratios = {kind: [summary["kinds"][kind]["ratio"] for summary in sides.values()] for kind in observers}
    products = {kind: math.prod(by_side) for kind, by_side in ratios.items() if None not in by_side}
    return min(products, key=products.__getitem__, default=None)


def _remarks(search: _KindSearch, points: Sequence[Mapping[str, Any]]) -> list[str]:
    table, lines = search.table, []
    names = search.groups[0][0].scenarios.names
    if table.worst_over_uncertainty:
        drives = "only the nominal drive was run" if len(names) == 1 else f"the worst over {len(names)} drives"
        lines.append(f"tune.worst_over_uncertainty: {drives}: {'; '.join(names)}.")
    if table.holdout is None:
        lines.append("No tune.holdout is given: kinds are compared on the study's own excitation, under other noise.")
    kinds = [rank for point in points for side in point["sides"].values() for rank in side["kinds"].values()]
    if all(rank["ratio"] is None or runs_are_equal(rank) for rank in kinds):
        intervals = "Without noise the runs of all seeds are the same: ratios have no interval."
    else:
        intervals = (
            f"Intervals ({100 * _CONFIDENCE:g} %) are over {search.held_out_seeds} noise seeds of the held-out runs, kinds "
            "compared under the same noise."
        )
    lines.append(f"{intervals} Another input or drive may rank otherwise.")
    for side in search.sides:
        ranks = [(kind, rank) for point in points for kind, rank in point["sides"][side]["kinds"].items()]
        ends = Counter((kind, key) for kind, rank in ranks for key in rank["at_range_end"])
        unfinished: dict[str, list[float]] = {}
        for kind, rank in ranks:
            gained = rank["gained_by_last_zoom"]
            if gained is not None and gained > _UNFINISHED_SHARE:
                unfinished.setdefault(kind, []).append(gained)
        share = f"of {len(points)} points" if len(points) > 1 else ""
        if ends:
            gains = ", ".join(f"{kind}.{key}{f' ({n} {share})' if share else ''}" for (kind, key), n in ends.items())
            lines.append(f"{side}: best values at an end of the range searched: {gains}. Beyond it may be better ones.")
        if unfinished:
            kind_list = ", ".join(
                f"{kind} ({f'{len(shares)} {share}, ' if share else ''}{percent(max(shares))})"
                for kind, shares in unfinished.items()
            )
            lines.append(
                f"{side}: the last zoom still made errors smaller by more than {100 * _UNFINISHED_SHARE:g} %: {kind_list}. "
                "More tune.refine or tune.trials may help these kinds."
            )
    return lines
