"""Which kind of observer suits a drive best, and by how much: `jaxbl tune` with `tune.observers`.

Each kind is tuned by the same search on the same runs: quasi-random gains over the range that its class gives, then over
zooms about the best of them, each side by its own error. The tuned observers are then compared on held-out runs, pair by
pair under the same noise. With `tune.axes` that is done at each point of a grid.
"""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from jaxbl.config import Config, TuneTable, with_values
from jaxbl.files import to_jsonable
from jaxbl.observer import OBSERVERS, OperatingConditions
from jaxbl.sweeps.metrics import SIDE_METRICS, no_disturbance_error
from jaxbl.sweeps.points import Points

from .pilot import Scenarios, list_scenarios, run_pilot
from .stages import Stages

TIME_CONSTANT = "equivalent_control.time_constant"
"""Searched with the gains where the torque is the objective: its estimate is behind this low-pass."""
_FEWEST = 8
"""Held-out seeds: an interval from fewer is wide."""
_CONFIDENCE = 0.95
_UNFINISHED = 0.02
"""Relative gain of the last zoom beyond which a search had better go on."""
_WHITE = 1.0 / math.sqrt(12.0)
"""Rms error of rounding to a resolution of one."""

Values = dict[str, float]
"""Of gains by config path."""


@dataclasses.dataclass(frozen=True)
class ObserverChoice:
    """Kinds of observer compared, each with tuned gains.

    Attributes:
        config: the study.
        summary: plain data, as in `tuning.json`.
        cost: seconds of compilation and of computing, and lanes computed in this call.
        scanned: what the fused loop did not know of runs that this call scanned in its place.
    """

    config: Config
    summary: dict[str, Any]
    cost: dict[str, float]
    fallback_reasons: tuple[str, ...] = ()


class Place(NamedTuple):
    """A point of the map: its values by path, the drives to serve there, and what the pilot run finds of each side."""

    values: dict[str, Any]
    scenarios: Scenarios
    pilot: dict[str, Any]


class Group(NamedTuple):
    """Points that share what is fixed at compile time, under a config that has it, and their values of other paths."""

    config: Config
    places: list[Place]
    lanes: list[dict[str, float]]


@dataclasses.dataclass
class Side:
    """The search for the gains of one kind on one side at one point.

    Attributes:
        limits: ends of the range of each gain, by config path.
        window: the part of it that is searched next.
        best: gains with the least error so far, and that error.
        before: the error before the last zoom.
    """

    limits: dict[str, tuple[float, float]]
    window: dict[str, tuple[float, float]]
    best: Values
    error: float = math.inf
    before: float = math.inf

    def trials(self, unit: np.ndarray) -> dict[str, np.ndarray]:
        """Values of each gain at points `(trials, free gains)` of the unit cube."""
        found, column = {}, 0
        for path, (low, high) in self.window.items():
            if low == high:
                found[path] = np.full(len(unit), low)
                continue
            found[path] = low * (high / low) ** unit[:, column]
            column += 1
        return found

    def take(self, tried: dict[str, np.ndarray], errors: np.ndarray) -> None:
        """Keep the best of some trials, and zoom in on it: two cells wide, if trials filled the window as a grid."""
        self.before, i = self.error, int(np.argmin(errors))
        if errors[i] < self.error:
            self.error, self.best = float(errors[i]), {path: float(values[i]) for path, values in tried.items()}
        if not self.best:
            return
        free = [path for path, (low, high) in self.window.items() if low < high]
        for path in free:
            (low, high), (least, largest) = self.window[path], self.limits[path]
            cell = (high / low) ** (len(errors) ** (-1.0 / len(free)))
            self.window[path] = max(self.best[path] / cell, least), min(self.best[path] * cell, largest)

    def ends(self) -> list[str]:
        """Gains whose best value is at an end of their range."""
        return [
            path for path, (low, high) in self.limits.items()
            if low < high and min(self.best[path] / low, high / self.best[path]) < (high / low) ** 0.01
        ]  # fmt: skip


def choose_observer(config: Config, table: TuneTable, stages: Stages) -> ObserverChoice:
    """Tune and compare the kinds `table.observers`; arguments as of :func:`.tune.tune`."""
    search = _Search(config, table, stages)
    for kind in table.observers:
        search.tune(kind)
    held_out = {kind: search.held_out(kind) for kind in table.observers}
    return ObserverChoice(config, _summary(search, held_out), stages.cost, tuple(stages.fallback_reasons))


class _Search:
    """Searches of all kinds at all points."""

    def __init__(self, config: Config, table: TuneTable, stages: Stages):
        self.config, self.table, self.stages = config, table, stages
        self.sides = config.build().sides
        self.seeds = config.sweep.seeds
        self.held_out_seeds = max(self.seeds, _FEWEST)
        self.groups = _groups(config, table, stages)
        self.searches: dict[str, list[list[dict[str, Side]]]] = {}
        """By kind: for each group and point, the sides' searches."""
        rows = sum(len(place.scenarios.names) for group in self.groups for place in group.places)
        runs = len(table.observers) * rows * len(self._shares())
        stages.total_lanes = runs * (table.trials * (1 + table.refine) * self.seeds + self.held_out_seeds)

    def _shares(self) -> list[tuple[str, ...]]:
        """Sides that are searched in the same runs: they share no gain but the low-pass on the equivalent control."""
        return [(side,) for side in self.sides] if self.table.objective == "torque" else [self.sides]

    def _joined(self, sides: Mapping[str, Mapping[str, Any]], share: tuple[str, ...]) -> dict[str, Any]:
        """Gains of both sides in one run; what they share is as the sides say that the run is for."""
        return {path: value for side in reversed((*share, *self.sides)) for path, value in sides[side].items()}

    def tune(self, kind: str) -> None:
        """Find the gains of a kind on both sides, at all points."""
        self.searches[kind] = [[self._begun(kind, place, group.config) for place in group.places] for group in self.groups]
        for number, group in enumerate(self.groups):
            searches = self.searches[kind][number]
            free = sum(low < high for low, high in searches[0][self.sides[0]].limits.values())
            for stage in range(1 + self.table.refine):
                unit = _quasi_random(free, self.table.trials, stage)
                tried = [{side: one.trials(unit) for side, one in sides.items()} for sides in searches]
                for share in self._shares():
                    rows = []
                    for i, sides in enumerate(tried):
                        columns = self._joined(sides, share)
                        rows += [(i, {path: float(v[j]) for path, v in columns.items()}) for j in range(len(unit))]
                    name = f"{kind}-{'-'.join(share)}-{number}-{stage}"
                    errors = self._errors(kind, group, rows, name, share)
                    for side in share:
                        worst = errors[side].max(axis=1).reshape(len(searches), len(unit))
                        for sides, trial, found in zip(searches, tried, worst, strict=True):
                            sides[side].take(trial[side], found)

    def held_out(self, kind: str) -> list[list[dict[str, np.ndarray]]]:
        """Errors of the tuned observers of a kind by side, for each group and point, shape (held-out seeds,); the worst over
        scenarios."""
        out = []
        for number, group in enumerate(self.groups):
            places: list[dict[str, np.ndarray]] = [{} for _ in group.places]
            for share in self._shares():
                rows = []
                for i, sides in enumerate(self.searches[kind][number]):
                    best = {side: sides[side].best for side in self.sides}
                    rows += [(i, self._joined(best, share))] if all(best.values()) else []
                if not rows:
                    continue
                name = f"{kind}-{'-'.join(share)}-{number}-holdout"
                errors = self._errors(kind, group, rows, name, share, held_out=True)
                for row, (i, _) in enumerate(rows):
                    places[i] |= {side: errors[side][row] for side in share}
            out.append(places)
        return out

    def _begun(self, kind: str, place: Place, config: Config) -> dict[str, Side]:
        """Ranges of a kind's gains at a point."""
        at, found = with_values(config, place.values), {}
        for side in self.sides:
            bound = place.pilot[side]["f_plus"]
            if not bound > 0.0:
                raise no_disturbance_error(side)
            encoders = at.encoders
            noise = math.hypot(encoders.noise, _WHITE * getattr(encoders, f"{side}_resolution"))
            period = at.run.sample_period
            ranges = OBSERVERS[kind].gain_ranges(OperatingConditions(bound, period, noise))
            limits = {f"observer.{side}.{gain}": ends for gain, ends in ranges.items()}
            if self.table.objective == "torque":
                limits[TIME_CONSTANT] = period / 3.0, 1e3 * period
            found[side] = Side(limits, dict(limits), {})
        return found

    def _errors(
        self,
        kind: str,
        group: Group,
        rows: Sequence[tuple[int, Values]],
        name: str,
        sides: tuple[str, ...],
        *,
        held_out: bool = False,
    ) -> dict[str, np.ndarray]:
        """Errors of some sides of runs with some gains, each at a point of a group, shape (rows, seeds): the worst over
        scenarios, infinite where a run diverged or took too long to converge."""
        columns: dict[str, list[float]] = {}
        for i, gains in rows:
            place = group.places[i]
            starts = {f"observer.{side}.velocity_error": place.pilot[side]["velocity_error"] for side in self.sides}
            corners = place.scenarios.columns or {}
            for corner in range(len(place.scenarios.names)):
                values = group.lanes[i] | starts | gains | {path: column[corner] for path, column in corners.items()}
                for path, value in values.items():
                    columns.setdefault(path, []).append(value)
        seeds = self.held_out_seeds if held_out else self.seeds
        first = self.config.sweep.first_seed + (self.seeds if held_out else 0)
        # gains that were rounded to the same number are run once
        keys = list(zip(*columns.values(), strict=True))
        unique = {key: i for i, key in enumerate(dict.fromkeys(keys))}
        data = group.places[0].scenarios.config.to_dict()
        for key in ("notes", "figures", "tune", "uncertainty", "axes"):
            data.pop(key, None)
        data["title"] = f"{self.config.title} ({name})" if self.config.title else name
        data["observer"] = _observer(kind, data["observer"], columns)
        data["sweep"] = {"seeds": seeds, "first_seed": first} | (
            {} if self.config.sweep.chunk is None else {"chunk": self.config.sweep.chunk}
        )
        if held_out and self.table.holdout is not None:
            data["excitation"] = self.table.holdout.model_dump(by_alias=True, exclude_none=True)
        data["axes"] = [
            {"path": path, "values": [key[i] for key in unique], "zip": "trial"} for i, path in enumerate(columns)
        ]
        wanted = [f"{side}.{self.table.objective}_rmse" for side in sides]
        late = [f"{side}.convergence_time" for side in sides] if self.table.longest_convergence is not None else []
        frame = self.stages.run(data, name).read([*columns, "seed", *wanted, *late])
        points = pd.DataFrame(list(unique), columns=list(columns)).assign(row=range(len(unique)))
        frame = points.merge(frame, on=list(columns), validate="one_to_many").sort_values(["row", "seed"])
        assert len(frame) == len(unique) * seeds
        found = {}
        for i, side in enumerate(sides):
            values = frame[wanted[i]].to_numpy(float)
            kept = np.isfinite(values)
            if late:
                kept &= frame[late[i]].to_numpy(float) <= self.table.longest_convergence
            errors = np.where(kept, values, np.inf).reshape(len(unique), seeds)[[unique[key] for key in keys]]
            found[side] = errors.reshape(len(rows), -1, seeds).max(axis=1)
        return found


def _observer(kind: str, own: Mapping[str, Any], columns: Mapping[str, Sequence[float]]) -> dict[str, Any]:
    """Table of a kind of observer; the first trial's gains stand for those that the study's own lack."""
    data: dict[str, Any] = {key: value for key, value in own.items() if not isinstance(value, Mapping)} | {"kind": kind}
    for path, values in columns.items():
        section, _, rest = path.partition(".")
        if section == "observer":
            side, key = rest.split(".")
            data.setdefault(side, {"position_error": own[side]["position_error"]})[key] = values[0]
    return data


def _quasi_random(free: int, count: int, stage: int) -> np.ndarray:
    """Points `(count, free)` of the unit cube; other ones in each stage."""
    power = math.ceil(math.log2(count))
    from scipy.stats import qmc  # slow to load, as below

    return qmc.Sobol(free, rng=np.random.default_rng(stage)).random_base2(power)[:count]


def _groups(config: Config, table: TuneTable, stages: Stages) -> list[Group]:
    """Points of the map, with pilot runs where the plant differs."""
    grid = config.sweep.model_copy(update={"design": "grid", "points": None, "refine": None, "metrics": None})
    points = Points(config.model_copy(update={"axes": table.axes, "sweep": grid}))
    known: dict[str, Any] = dict(stages.manifest.get("pilots", {}))
    groups, pilots = [], {}
    for group in points.groups:
        columns = points.columns(np.arange(points.group_size))
        places, lanes = [], []
        for i in range(points.group_size):
            lane = {path: to_jsonable(column[i]) for path, column in columns.items()}
            at = with_values(group.config, lane)
            scenarios = list_scenarios(at, table)
            # encoders change nothing of the plant
            key = repr({path: v for path, v in (group.structural | lane).items() if not path.startswith("encoders.")})
            if key not in pilots:
                pilots[key] = known.get(key) or run_pilot(scenarios, table)
            values = group.structural | lane
            places.append(Place({axis.path: values[axis.path] for axis in table.axes}, scenarios, pilots[key]))
            lanes.append(lane)
        groups.append(Group(group.config, places, lanes))
    if known != pilots:
        stages.write_manifest(pilots=pilots)
    return groups


def ranked(errors: Mapping[str, np.ndarray]) -> dict[str, dict[str, Any]]:
    """Kinds by their error, least first: how many times the best one's, with an interval.

    Args:
        errors: by kind, shape (runs,), the same runs of all: positive, or infinite.

    Returns:
        by kind: `error` (geometric mean over the runs), `worst`, and of the ratios to the best kind's error in the same
        run the geometric mean `ratio` with its 95 % interval `low` ... `high` (Student's t on their logarithms); None where
        a run is infinite.
    """
    logs = {kind: np.log(np.maximum(one, np.finfo(float).tiny)) for kind, one in errors.items() if np.isfinite(one).all()}
    order = sorted(logs, key=lambda kind: float(logs[kind].mean()))
    found: dict[str, dict[str, Any]] = {}
    for kind in order:
        beside = logs[kind] - logs[order[0]]
        half = 0.0
        if len(beside) > 1:
            from scipy.stats import t

            quantile = float(t.ppf(0.5 * (1.0 + _CONFIDENCE), len(beside) - 1))
            half = quantile * float(beside.std(ddof=1)) / math.sqrt(len(beside))
        mean = float(beside.mean())
        found[kind] = {
            "error": math.exp(float(logs[kind].mean())),
            "worst": float(errors[kind].max()),
            "ratio": math.exp(mean),
            "low": math.exp(mean - half),
            "high": math.exp(mean + half),
        }
    for kind in errors:
        found.setdefault(kind, dict.fromkeys(("error", "worst", "ratio", "low", "high")))
    return found


def not_told_apart(found: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Kinds whose error may be as small as the best one's (:func:`ranked`), without the best."""
    return [kind for kind, one in list(found.items())[1:] if one["low"] is not None and one["low"] <= 1.0]


def runs_are_equal(one: Mapping[str, Any]) -> bool:
    """Whether a kind's ratio (:func:`ranked`) is the same in all runs, but for rounding: no noise, and no interval."""
    return one["high"] - one["low"] < 1e-9 * one["ratio"]


def _summary(search: _Search, held_out: Mapping[str, list[list[dict[str, np.ndarray]]]]) -> dict[str, Any]:
    """What `tuning.json` holds."""
    config, table, places = search.config, search.table, []
    none = np.full(search.held_out_seeds, np.inf)
    for number, group in enumerate(search.groups):
        for i, place in enumerate(group.places):
            sides = {}
            for side in search.sides:
                found = ranked({kind: held_out[kind][number][i].get(side, none) for kind in table.observers})
                for kind, one in found.items():
                    one |= _searched(search.searches[kind][number][i][side], side)
                best = next(iter(found))
                sides[side] = {
                    "best": best if found[best]["ratio"] is not None else None,
                    "not_told_apart": not_told_apart(found),
                    "f_plus": place.pilot[side]["f_plus"],
                    "kinds": found,
                }
            places.append({"values": place.values, "sides": sides})
    first = config.sweep.first_seed + search.seeds
    summary = {
        "title": config.title,
        "objective": table.objective,
        "objective_metric": f"{table.objective}_rmse ({SIDE_METRICS[f'{table.objective}_rmse'].unit})",
        "observers": table.observers,
        "trials": table.trials * (1 + table.refine),
        "seeds": [config.sweep.first_seed, first - 1],
        "scenarios": search.groups[0].places[0].scenarios.names,
        "axes": [axis.path for axis in table.axes],
        "holdout": {
            "excitation": (table.holdout or config.excitation).model_dump(by_alias=True, exclude_none=True),
            "same_excitation": table.holdout is None,
            "seeds": [first, first + search.held_out_seeds - 1],
        },
        "points": places,
    }
    if len(places) == 1:
        summary["for_both_sides"] = _for_both_sides(places[0]["sides"], table.observers)
    return to_jsonable(summary) | {"remarks": [*config.notes, *_remarks(search, places)]}


def _searched(side: Side, name: str) -> dict[str, Any]:
    """Chosen gains of a kind by key, its error in the search, and what a reader should know of that."""
    gains = {path.removeprefix(f"observer.{name}."): value for path, value in side.best.items()}
    last = (side.before - side.error) / side.before if math.isfinite(side.before) and side.before else None
    return {
        "gains": gains,
        "error_in_search": side.error,
        "gained_by_last_zoom": last,
        "at_range_end": [path.removeprefix(f"observer.{name}.") for path in side.ends()] if side.best else [],
    }


def _for_both_sides(sides: Mapping[str, Any], observers: Sequence[str]) -> str | None:
    """The kind with the least product of errors: a study has one kind for both sides."""
    total = {
        kind: sum(math.log(one["kinds"][kind]["ratio"]) for one in sides.values())
        for kind in observers
        if all(one["kinds"][kind]["ratio"] is not None for one in sides.values())
    }
    return min(total, key=lambda kind: total[kind]) if total else None


def _remarks(search: _Search, places: Sequence[Mapping[str, Any]]) -> list[str]:
    table, lines = search.table, []
    names = search.groups[0].places[0].scenarios.names
    if table.worst_over_uncertainty:
        drives = "only the nominal drive was run" if len(names) == 1 else f"the worst over {len(names)} drives"
        lines.append(f"tune.worst_over_uncertainty: {drives}: {'; '.join(names)}.")
    if table.holdout is None:
        lines.append("No tune.holdout is given: kinds are compared on the study's own excitation, under other noise.")
    kinds = [one for place in places for side in place["sides"].values() for one in side["kinds"].values()]
    if all(one["ratio"] is None or runs_are_equal(one) for one in kinds):
        how = "Without noise the runs of all seeds are the same: ratios have no interval."
    else:
        how = (
            f"Intervals ({100 * _CONFIDENCE:g} %) are over {search.held_out_seeds} noise seeds of the held-out runs, kinds "
            "compared under the same noise."
        )
    lines.append(f"{how} Another input or drive may rank otherwise.")
    for side in search.sides:
        ends: dict[tuple[str, str], int] = {}
        unfinished: dict[str, tuple[int, float]] = {}
        for place in places:
            for kind, one in place["sides"][side]["kinds"].items():
                for key in one["at_range_end"]:
                    ends[kind, key] = ends.get((kind, key), 0) + 1
                if (one["gained_by_last_zoom"] or 0.0) > _UNFINISHED:
                    count, most = unfinished.get(kind, (0, 0.0))
                    unfinished[kind] = count + 1, max(most, one["gained_by_last_zoom"])
        of = f"of {len(places)} points" if len(places) > 1 else ""
        if ends:
            said = ", ".join(f"{kind}.{key}{f' ({n} {of})' if of else ''}" for (kind, key), n in ends.items())
            lines.append(f"{side}: best values at an end of the range searched: {said}. Beyond it may be better ones.")
        if unfinished:
            said = ", ".join(
                f"{kind} ({f'{n} {of}, ' if of else ''}{100 * most:.2g} %)" for kind, (n, most) in unfinished.items()
            )
            lines.append(
                f"{side}: the last zoom still made errors smaller by more than {100 * _UNFINISHED:g} %: {said}. More "
                "tune.refine or tune.trials may help these kinds."
            )
    return lines
