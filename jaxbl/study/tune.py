"""Gains chosen for a drive: the function behind `jaxbl tune`.

A pilot run finds the bound f⁺ of each side. Gains are then searched on a map over alpha / f⁺ and lambda / √f⁺, both observers
in the same runs (they do not influence each other), and on zooms around each side's best point. Every stage is a study of
its own, kept in the folder's `tune/`: an interrupted search goes on where it stopped, a finished one is only read.
"""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false, reportReturnType=false

import dataclasses
import itertools
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from jaxbl.drive.parameters import set_leaves
from jaxbl.errors import InputError, NoResult
from jaxbl.observer.conditions import peak_ratio
from jaxbl.simulate import Experiment, Reducer, Signals, scan

from .config import TUNE_NAMES, Config, TuneTable, read_config
from .engine import Progress, precision, prepare
from .store import claim, make_folder, mark, write_atomic
from .sweep import sweep

Gains = dict[str, tuple[float, float]]
"""lambda (rad^0.5/s) and alpha (rad/s^2) of each side."""

USUAL_LAMBDA, USUAL_ALPHA = 1.5, 1.1
"""The usual rule (Levant 1998): lambda = 1.5 sqrt(f_plus), alpha = 1.1 f_plus."""

_FINEST = 1e-6  # relative steps below this are no longer worth a run
_FLAT = 0.05


@dataclasses.dataclass(frozen=True)
class Tuning:
    """Chosen gains, and how they were found.

    Attributes:
        config: the study.
        summary: plain data, as in `tuning.json`.
        candidates: for each side, one row for each pair of gains tried: `stage` (0 is the coarse map), `lambda`, `alpha`,
            `lambda_ratio`, `alpha_ratio`, whether all runs `converged` and are `finite`, worst `velocity_rmse`,
            `torque_rmse` and `convergence_time`, least `margin_alpha` and `margin_exact`, largest `f_plus`, `error` (the
            objective) and `feasible`.
        cost: seconds of compilation and of computing, and lanes computed in this call.
    """

    config: Config
    summary: dict[str, Any]
    candidates: dict[str, pd.DataFrame]
    cost: dict[str, float]


class Scenarios(NamedTuple):
    """Drives that gains must serve: a config that has their effects, their names, and the effects' values by path."""

    config: Config
    names: list[str]
    columns: dict[str, list[float]]


def tune(
    study: str | Path | Mapping[str, Any] | Config,
    out: str | Path | None = None,
    *,
    progress: Progress | None = None,
    devices: list[Any] | None = None,
    overwrite: bool = False,
) -> Tuning:
    """Choose lambda and alpha of both observers for a study.

    Args:
        study: TOML file, mapping or config; its `[tune]` table says what is asked of the gains, its axes are not used.
        out: folder to keep the runs in; a search that was interrupted there goes on where it stopped. Without it nothing
            is written.
        progress: called with finished and total lanes of all stages.
        devices: JAX devices to use; left out, all local ones.
        overwrite: remove the results of another study from `out`.

    Raises:
        InputError: wrong config, or a folder that holds something else.
        NoResult: no gains in the range meet the constraints, or the drive diverges.
    """
    config = read_config(study)
    table = config.tune or TuneTable()
    config = config.model_copy(update={"tune": table})
    scenarios = _scenarios(config, table)
    marker: dict[str, Any] = {}
    if out is not None:
        claim(Path(out), config, "tune", overwrite=overwrite)
        make_folder(Path(out) / "tune")
        path = Path(out) / "tune" / "manifest.json"
        marker = json.loads(path.read_text(encoding="utf-8")) if path.exists() else mark(config, "tune")
        # first of all: it is what makes the folder this study's
        write_atomic(path, json.dumps(marker, indent=2))
    if "pilot" not in marker:
        marker["pilot"] = _pilots(scenarios, table)
        if out is not None:
            write_atomic(Path(out) / "tune" / "manifest.json", json.dumps(marker, indent=2))
    search = _Search(scenarios, table, marker["pilot"], None if out is None else Path(out) / "tune", devices, overwrite)
    search.progress = progress
    search.run()
    summary = _Summary(config, search, search.compare(held_out=False), search.compare(held_out=True)).plain()
    return Tuning(config, summary, search.candidates, search.cost)


def _scenarios(config: Config, table: TuneTable) -> Scenarios:
    """The nominal drive, and the corners of its uncertain inertias and viscous frictions (the same on both sides at once).

    The corners are effects: the plant has them, the observers do not know them.
    """
    if not table.worst_over_uncertainty:
        return Scenarios(config, ["nominal"], {})
    data, relative = config.resolved(), config.uncertainty.relative
    effects: list[dict[str, Any]] = data.setdefault("effects", [])
    found: dict[str, list[tuple[int, str, float]]] = {}
    for number, kind, key in (("inertia", "inertia", "inertia"), ("viscous", "viscous_friction", "viscous")):
        for side in config.build().sides:
            nominal = getattr(config.drive, f"{side}_{number}")
            if f"drive.{side}_{number}" in config.uncertainty.exact or nominal == 0.0:
                continue
            places = [i for i, effect in enumerate(effects) if effect["kind"] == f"{side}.{kind}"]
            total = nominal + sum(effects[i][key] for i in places)
            if number == "inertia" and total - relative * nominal <= 0.0:
                raise InputError(
                    f"uncertainty.relative: {relative:g} leaves no inertia on the {side} at its lower corner; "
                    "it should be smaller, or tune.worst_over_uncertainty false"
                )
            if not places:
                effects.append({"kind": f"{side}.{kind}", key: 0.0})
                places = [len(effects) - 1]
            found.setdefault(number, []).append((places[0], key, relative * nominal))
    if not found:
        return Scenarios(config, ["nominal"], {})
    corners = [
        dict.fromkeys(found, 0),
        *(dict(zip(found, s, strict=True)) for s in itertools.product((-1, 1), repeat=len(found))),
    ]
    kinds = [effect["kind"] for effect in effects]
    columns = {}
    for number, errors in found.items():
        for place, key, size in errors:
            label = kinds[place] if kinds.count(kinds[place]) == 1 else str(place)
            columns[f"effects.{label}.{key}"] = [effects[place][key] + corner[number] * size for corner in corners]
    percent = f"{100.0 * relative:.3g} %"
    names = [", ".join(f"{n} {'+' if sign > 0 else '-'}{percent}" for n, sign in c.items() if sign) for c in corners]
    # paths of numbers known exactly may name effects, whose names have changed
    data.pop("uncertainty")
    return Scenarios(
        read_config(data).model_copy(update={"uncertainty": config.uncertainty}), ["nominal", *names[1:]], columns
    )


class _Seen(NamedTuple):
    """What a pilot run sees of one side: largest |acceleration - f(velocity)| (rad/s^2), that of the first sample, and
    largest |velocity| (rad/s)."""

    disturbance: Any
    at_start: Any
    largest_velocity: Any


def _see(experiment: Experiment, totals: dict[str, _Seen], index: Any, signals: Signals) -> dict[str, _Seen]:
    new = {}
    for side, old in totals.items():
        true = signals.side(side).true
        assert true is not None
        unknown = jnp.abs(true.acceleration - experiment.drive.acceleration(side, true.velocity, signals.input))
        new[side] = _Seen(
            jnp.maximum(old.disturbance, unknown),
            jnp.where(index == 0, unknown, old.at_start),
            jnp.maximum(old.largest_velocity, jnp.abs(true.velocity)),
        )
    return new


_PILOT = Reducer(
    lambda experiment: {side: _Seen(*[jnp.zeros_like(experiment.run.sample_period)] * 3) for side in experiment.sides},
    _see,
    lambda experiment, totals, state: {f"{s}.{n}": v for s, seen in totals.items() for n, v in seen._asdict().items()},
)


def _pilot(scenarios: Scenarios, excitation: Any = None) -> dict[str, dict[str, float]]:
    """What pilot runs see of each side: the largest values over the scenarios."""
    config = scenarios.config
    if excitation is not None:
        config = config.model_copy(update={"excitation": excitation})
    with precision(config):
        experiment = prepare(config)

        def one(values: dict[str, Any]) -> dict[str, Any]:
            return scan(set_leaves(experiment, values), jnp.asarray(0), (_PILOT,))[0]

        columns = {path: jnp.asarray(column, config.run.precision) for path, column in scenarios.columns.items()}
        found = jax.jit(jax.vmap(one) if columns else one)(columns)
        out = {
            side: {name: float(np.max(np.asarray(found[f"{side}.{name}"]))) for name in _Seen._fields}
            for side in experiment.sides
        }
    for side, values in out.items():
        if not all(map(math.isfinite, values.values())):
            raise NoResult(f"{side}: the drive itself diverges in the pilot run, so that there is nothing to observe")
    return out


def _pilots(scenarios: Scenarios, table: TuneTable) -> dict[str, Any]:
    """Bounds that the pilot runs find: of the study's excitation, with the observers' starting errors, and of the holdout's.

    The observers' right-hand side error is the disturbance and what viscous friction makes of the velocity error. The latter
    is largest at the start and gone within some samples, so that f_plus is the larger of the disturbance along the run and
    of both at the start.
    """
    config, found, out = scenarios.config, _pilot(scenarios), {}
    held = found if table.holdout is None else _pilot(scenarios, table.holdout)
    for side, seen in found.items():
        observer = getattr(config.observer, side)
        assumed = observer.position_error == 0.0 and observer.velocity_error == 0.0
        velocity_error = seen["largest_velocity"] if assumed else observer.velocity_error
        friction = getattr(config.drive, f"{side}_viscous") / getattr(config.drive, f"{side}_inertia") * abs(velocity_error)
        bounds = [max(run["disturbance"], run["at_start"] + friction) for run in (seen, held[side])]
        out[side] = seen | {
            "velocity_error": velocity_error,
            "position_error": observer.position_error,
            "starting_error_assumed": assumed,
            "start": seen["at_start"] + friction,
            "f_plus": bounds[0],
            "holdout_f_plus": bounds[1],
        }
    return out


class _Window(NamedTuple):
    """Ends of the ratios searched on one side."""

    alpha: tuple[float, float]
    lambda_: tuple[float, float]

    def around(self, alpha: float, lambda_: float, num: int, limits: "_Window") -> "_Window":
        """One cell each way about a point, inside of `limits`."""
        ends = []
        for (low, high), centre, (least, largest) in zip(self, (alpha, lambda_), limits, strict=True):
            cell = _cell((low, high), num)
            ends.append((max(centre / cell, least), min(centre * cell, largest)))
        return _Window(*ends)


def _cell(ends: tuple[float, float], num: int) -> float:
    """Ratio of neighbouring values."""
    return (ends[1] / ends[0]) ** (1.0 / (num - 1))


class _Search:
    """The stages of a search: coarse map, zooms, comparison."""

    def __init__(
        self,
        scenarios: Scenarios,
        table: TuneTable,
        pilot: dict[str, Any],
        folder: Path | None,
        devices: list[Any] | None,
        overwrite: bool,
    ):
        self.scenarios, self.table, self.pilot = scenarios, table, pilot
        self.folder, self.devices, self.overwrite = folder, devices, overwrite
        self.sides = tuple(pilot)
        self.progress: Progress | None = None
        self.metric = f"{table.objective}_rmse"
        self.f_plus = {side: float(found["f_plus"]) for side, found in pilot.items()}
        for side, bound in self.f_plus.items():
            if not bound > 0.0:
                raise InputError(
                    f"excitation: leaves the {side} undisturbed (f⁺ = 0), so that there is nothing to tune for; "
                    "it should move the drive"
                )
        self.limits = _Window(
            (table.alpha_ratio.start, table.alpha_ratio.stop), (table.lambda_ratio.start, table.lambda_ratio.stop)
        )
        self.windows = [dict.fromkeys(self.sides, self.limits)]
        self.candidates: dict[str, pd.DataFrame] = {}
        self.cost = {"compile_seconds": 0.0, "run_seconds": 0.0, "lanes": 0.0}
        self._done = 0
        seeds, lanes = scenarios.config.sweep.seeds, len(scenarios.names)
        self._total = seeds * lanes * (table.num**2 * (1 + table.refine) + 2 * len(self.gains_to_compare({})))

    def run(self) -> None:
        """Search. Raises `NoResult` where nothing is feasible."""
        for stage in range(self.table.refine + 1):
            if stage:
                last = self.windows[-1]
                if all(_cell(ends, self.table.num) - 1.0 < _FINEST for w in last.values() for ends in w):
                    break
                best = {side: self.best(side) for side in self.sides}
                self.windows.append(
                    {
                        side: last[side].around(
                            best[side]["alpha_ratio"], best[side]["lambda_ratio"], self.table.num, self.limits
                        )
                        for side in self.sides
                    }
                )
            self._map(stage)

    def best(self, side: str) -> pd.Series:
        """The feasible candidate with the least error; of equals, the one that converges first."""
        frame = self.candidates[side]
        return frame[frame["feasible"]].sort_values(["error", "convergence_time"], kind="stable").iloc[0]

    def _map(self, stage: int) -> None:
        """Run the points of a stage and judge them."""
        alphas, lambdas = {}, {}
        for side, window in self.windows[stage].items():
            bound, num = self.f_plus[side], self.table.num
            alphas[f"observer.{side}.alpha"] = (bound * np.geomspace(*window.alpha, num)).tolist()
            lambdas[f"observer.{side}.lambda"] = (math.sqrt(bound) * np.geomspace(*window.lambda_, num)).tolist()
        frame = self._sweep("coarse" if stage == 0 else f"refine-{stage}", [("alpha", alphas), ("lambda", lambdas)])
        for side in self.sides:
            new = self._judge(side, _worst(frame, side)).assign(stage=stage)
            old = self.candidates.get(side)
            self.candidates[side] = new if old is None else pd.concat([old, new], ignore_index=True)
            if not self.candidates[side]["feasible"].any():
                raise NoResult(self._why_none(side))

    def _judge(self, side: str, found: pd.DataFrame) -> pd.DataFrame:
        bound, table = self.f_plus[side], self.table
        kept = self._kept(found)
        return found.assign(
            alpha_ratio=found["alpha"] / bound,
            lambda_ratio=found["lambda"] / math.sqrt(bound),
            error=found[f"{table.objective}_rmse"],
            feasible=np.logical_and.reduce(list(kept.values())),
        )

    def _kept(self, found: pd.DataFrame) -> dict[str, np.ndarray]:
        """Which candidates keep which constraint."""
        table = self.table
        kept = {
            "converged": found["converged"],
            f"alpha over the true f⁺ at least margin_alpha = {table.margin_alpha:g}": found["margin_alpha"]
            >= table.margin_alpha,
            f"lambda over the exact condition's at least margin_exact = {table.margin_exact:g}": found["margin_exact"]
            >= table.margin_exact,
        }
        if table.longest_convergence is not None:
            kept[f"converged within longest_convergence = {table.longest_convergence:g} s"] = (
                found["convergence_time"] <= table.longest_convergence
            )
        return {name: values.to_numpy(bool) for name, values in kept.items()}

    def _why_none(self, side: str) -> str:
        found, limits = self.candidates[side], self.limits
        reached = {"margin_alpha": found["margin_alpha"].max(), "margin_exact": found["margin_exact"].max()}
        counts = "; ".join(
            f"{name}: {int(values.sum())}" + "".join(f" (largest {v:.3g})" for key, v in reached.items() if key in name)
            for name, values in self._kept(found).items()
        )
        return (
            f"{side}: none of the {len(found)} gains with alpha / f⁺ in {limits.alpha[0]:g} ... {limits.alpha[1]:g} and "
            f"lambda / √f⁺ in {limits.lambda_[0]:g} ... {limits.lambda_[1]:g} (f⁺ = {self.f_plus[side]:.3g} rad/s²) keeps all "
            f"constraints in all runs; how many keep each: {counts}"
        )

    def usual(self) -> Gains:
        """Levant's usual rule at the pilot's f_plus."""
        return {side: (USUAL_LAMBDA * math.sqrt(bound), USUAL_ALPHA * bound) for side, bound in self.f_plus.items()}

    def gains_to_compare(self, tuned: Gains) -> dict[str, Gains]:
        """Gains of both sides by name."""
        observers = {side: getattr(self.scenarios.config.observer, side) for side in self.sides}
        own = {side: (float(observer.lambda_), float(observer.alpha)) for side, observer in observers.items()}
        others = {
            other.name: {side: (getattr(other, side).lambda_, getattr(other, side).alpha) for side in self.sides}
            for other in self.table.compare
        }
        return dict(zip(TUNE_NAMES, (tuned, self.usual(), own), strict=True)) | others

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
        frame = self._sweep("holdout" if held_out else "named", [("gains", columns)], held_out=held_out)
        rows = []
        for name, gains in named.items():
            for side, (lambda_, alpha) in gains.items():
                own = (frame[f"observer.{side}.lambda"] == lambda_) & (frame[f"observer.{side}.alpha"] == alpha)
                # another pair may share this side's gains: its runs are the same
                rows.append(
                    _row(name, side, frame[own].drop_duplicates([*self.scenarios.columns, "seed"]), (lambda_, alpha))
                )
        return rows

    def _sweep(self, name: str, axes: list[tuple[str, dict[str, list[float]]]], *, held_out: bool = False) -> pd.DataFrame:
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
        together = [("scenario", self.scenarios.columns), *axes]
        data["axes"] = [
            {"path": path, "values": values, **({"zip": label} if len(columns) > 1 else {})}
            for label, columns in together
            for path, values in columns.items()
        ]
        done = self._done

        def update(finished: int, total: int) -> None:
            self._done = done + finished
            if self.progress:
                self.progress(self._done, max(self._total, self._done))

        folder = None if self.folder is None else self.folder / name
        result = sweep(data, folder, progress=update, devices=self.devices, overwrite=self.overwrite)
        self.cost = {key: value + result.cost[key] for key, value in self.cost.items()}
        names = [f"{side}.{figure}" for side in self.sides for figure in _FIGURES]
        paths = [axis["path"] for axis in data["axes"]]
        return result.read([*paths, "seed", "finite", *names])


_FIGURES = ("converged", "convergence_time", "velocity_rmse", "torque_rmse", "margin_alpha", "margin_exact", "f_plus")


def _worst(frame: pd.DataFrame, side: str) -> pd.DataFrame:
    """One row for each pair of gains: the worst over scenarios and seeds; NaN where a run diverged or did not converge."""
    keys = [f"observer.{side}.lambda", f"observer.{side}.alpha"]
    part = frame[[*keys, "finite"]].assign(**{name: frame[f"{side}.{name}"] for name in _FIGURES})
    groups = part.groupby(keys, sort=True)
    worst = {name: groups[name].max() for name in ("velocity_rmse", "torque_rmse", "convergence_time", "f_plus")}
    least = {name: groups[name].min() for name in ("margin_alpha", "margin_exact", "converged", "finite")}
    found = pd.DataFrame(worst | least)
    found["converged"] = found["converged"].astype(bool)
    found["finite"] = found["finite"].astype(bool)
    # the largest of some is not the largest of all
    found.loc[~found["converged"], "convergence_time"] = np.nan
    numbers = [*worst, "margin_alpha", "margin_exact"]
    found.loc[~found["finite"], numbers] = np.nan
    return found.rename_axis(["lambda", "alpha"]).reset_index()


def pareto_front(candidates: pd.DataFrame) -> pd.DataFrame:
    """The feasible candidates that no other beats in both convergence time and error, fastest first."""
    feasible = candidates[candidates["feasible"]].sort_values(["convergence_time", "error"], kind="stable")
    before = feasible["error"].cummin().shift(fill_value=math.inf)
    return feasible[feasible["error"] < before]


_UNITS = {"velocity": "rad/s", "torque": "N m"}


class _Summary:
    """The numbers of `tuning.json`, and what a reader of them should know."""

    def __init__(self, config: Config, search: _Search, named: list[dict[str, Any]], held_out: list[dict[str, Any]]):
        assert config.tune is not None
        self.config, self.search, self.table = config, search, config.tune
        self.best = {side: search.best(side) for side in search.sides}
        self.named, self.rows = named, held_out
        self.factors = {side: self._factors(side) for side in search.sides}

    def plain(self) -> dict[str, Any]:
        search, table = self.search, self.table
        first, seeds = self.config.sweep.first_seed, self.config.sweep.seeds
        sides = search.sides
        last = search.windows[-1]
        cells = {side: {key: _cell(ends, table.num) - 1.0 for key, ends in zip(("alpha", "lambda"), last[side], strict=True)}
                 for side in sides}  # fmt: skip
        return {
            "title": self.config.title,
            "objective": table.objective,
            "objective_metric": f"worst {search.metric} ({_UNITS[table.objective]}) over seeds and scenarios",
            "seeds": [first, first + seeds - 1],
            "scenarios": search.scenarios.names,
            "f_plus": search.f_plus,
            "pilot": search.pilot,
            "margins": {"exact": table.margin_exact, "alpha": table.margin_alpha},
            "gains": {side: {k: float(self.best[side][k]) for k in ("lambda", "alpha", "lambda_ratio", "alpha_ratio")}
                      for side in sides},
            "achieved": {side: self._achieved(side) for side in sides},
            "range": {"alpha_ratio": list(search.limits.alpha), "lambda_ratio": list(search.limits.lambda_), "num": table.num},
            "resolution": cells,
            "stages": [{side: {"alpha_ratio": list(w.alpha), "lambda_ratio": list(w.lambda_)} for side, w in windows.items()}
                       for windows in search.windows],
            "named": self.named,
            "holdout": {
                "excitation": (table.holdout or self.config.excitation).model_dump(by_alias=True, exclude_none=True),
                "same_excitation": table.holdout is None,
                "seeds": [first + seeds, first + 2 * seeds - 1],
                "f_plus": {side: search.pilot[side]["holdout_f_plus"] for side in sides},
                "rows": self.rows,
                "factors": self.factors,
            },
            "pareto": {side: _records(pareto_front(search.candidates[side])) for side in sides},
            "remarks": [*self.config.notes, *self._remarks()],
        }  # fmt: skip

    def _achieved(self, side: str) -> dict[str, Any]:
        row = self.best[side]
        names = ("velocity_rmse", "torque_rmse", "convergence_time", "margin_alpha", "margin_exact", "f_plus")
        return {name: plain_number(row[name]) for name in names} | {
            "peak_ratio": _peak_ratio(row["lambda"], row["alpha"], row["f_plus"])
        }

    def row(self, name: str, side: str) -> dict[str, Any]:
        return next(row for row in self.rows if (row["name"], row["side"]) == (name, side))

    def _factors(self, side: str) -> dict[str, Any]:
        """Other gains' figures over the tuned ones', on the held-out input; none for gains that do not always converge."""
        tuned, out = self.row("tuned", side), {}
        for row in self.rows:
            if row["side"] != side or row["name"] == "tuned":
                continue
            if row["converged"] < 1.0 or tuned["converged"] < 1.0:
                who = "tuned" if row["converged"] == 1.0 else row["name"]
                out[row["name"]] = {
                    "why_none": f"{who}: converged in {100.0 * min(row['converged'], tuned['converged']):.3g} % of the runs"
                }
                continue
            out[row["name"]] = {
                name: {how: _ratio(row[name][how], tuned[name][how]) for how in ("worst", "median")}
                for name in ("velocity_rmse", "torque_rmse", "convergence_time")
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
                    f"{side}: the study gives the observer no starting error; a convergence time needs one, so that it starts "
                    f"with a velocity error of {pilot['velocity_error']:.3g} rad/s, the largest velocity of the pilot run."
                )
            lines.append(
                f"{side}: f⁺ = {search.f_plus[side]:.4g} rad/s² is the largest |acceleration - f(velocity)| of the pilot run "
                f"({pilot['disturbance']:.4g}), or what it is at the start with viscous friction times the starting error "
                f"({pilot['start']:.4g}), whichever is larger."
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
        search, row, lines = self.search, self.best[side], []
        last = search.windows[-1][side]
        ends = (("alpha / f⁺", "alpha_ratio", search.limits.alpha, last.alpha),
                ("lambda / √f⁺", "lambda_ratio", search.limits.lambda_, last.lambda_))  # fmt: skip
        for label, key, (low, high), window in ends:
            cell = _cell(window, self.table.num) * (1.0 + 1e-9)
            for end, near in ((low, row[key] <= low * cell), (high, row[key] >= high / cell)):
                if near:
                    lines.append(
                        f"{side}: the optimum lies at the end {label} = {end:g} of the range searched (tune.{key}); "
                        "beyond it may be better gains."
                    )
        for key, gain, asked in (("margin_alpha", "alpha", self.table.margin_alpha),
                                 ("margin_exact", "lambda", self.table.margin_exact)):  # fmt: skip
            # a coarse cell away the constraint would be broken
            if row[key] < asked * (_cell(last.alpha if gain == "alpha" else last.lambda_, self.table.num) ** 2):
                lines.append(
                    f"{side}: {key} = {asked:g} holds the optimum back (it reaches {row[key]:.4g}): "
                    f"a smaller {gain} would have less error, and less certainty to converge."
                )
        coarse = search.candidates[side].query("stage == 0 and feasible")
        near = coarse[coarse["error"] <= (1.0 + _FLAT) * row["error"]]
        if len(near) > 1:
            lines.append(
                f"{side}: the optimum is flat: {len(near)} points of the coarse map are within {100 * _FLAT:.0f} % of it, alpha from "
                f"{near['alpha'].min():.3g} to {near['alpha'].max():.3g} and lambda from {near['lambda'].min():.3g} to "
                f"{near['lambda'].max():.3g}."
            )
        return lines

    def _about_holdout(self, side: str) -> list[str]:
        lines, tuned = [], self.row("tuned", side)
        bound, own = self.search.pilot[side]["holdout_f_plus"], self.search.f_plus[side]
        if bound > own:
            lines.append(
                f"{side}: the held-out excitation disturbs more than the study's (f⁺ = {bound:.3g} against {own:.3g} rad/s²): "
                "the margins there are smaller than asked for."
            )
        if tuned["converged"] < 1.0:
            lines.append(
                f"{side}: the tuned gains converge in only {100 * tuned['converged']:.3g} % of the held-out runs: the study's "
                "excitation is not representative of it."
            )
        for name, found in self.factors[side].items():
            if "why_none" in found and tuned["converged"] == 1.0:
                share = 100.0 * self.row(name, side)["converged"]
                lines.append(
                    f"{side}: {_called(name)} do not converge in all held-out runs ({share:.3g} % do): no factor is stated."
                )
        return lines


def _called(name: str) -> str:
    return {"usual rule": "gains by the usual rule", "config": "the study's own gains"}.get(name, f"the gains '{name}'")


def _row(name: str, side: str, runs: pd.DataFrame, gains: tuple[float, float]) -> dict[str, Any]:
    """Figures of some gains over all held-out runs of a side."""
    figures = {figure: runs[f"{side}.{figure}"] for figure in _FIGURES}
    converged, finite = figures["converged"].astype(bool), runs["finite"].astype(bool)
    bound = figures["f_plus"].max() if finite.all() else math.nan
    row: dict[str, Any] = {
        "name": name, "side": side, "lambda": gains[0], "alpha": gains[1], "runs": len(runs),
        "converged": float(converged.mean()), "finite": float(finite.mean()),
    }  # fmt: skip
    for figure in ("velocity_rmse", "torque_rmse", "convergence_time"):
        whole = converged.all() if figure == "convergence_time" else finite.all()
        values = figures[figure]
        row[figure] = {"worst": plain_number(values.max()) if whole else None, "median": plain_number(values.median())}
    for figure in ("margin_alpha", "margin_exact"):
        row[figure] = plain_number(figures[figure].min()) if finite.all() else None
    return row | {"f_plus": plain_number(bound), "peak_ratio": _peak_ratio(*gains, bound)}


def _records(front: pd.DataFrame) -> list[dict[str, Any]]:
    names = ["lambda", "alpha", "lambda_ratio", "alpha_ratio", "convergence_time", "error"]
    return [{name: plain_number(row[name]) for name in names} for _, row in front.iterrows()]


def _peak_ratio(lambda_: float, alpha: float, f_plus: float) -> float | None:
    with jax.enable_x64(True):
        return plain_number(peak_ratio(*(jnp.asarray(float(x)) for x in (lambda_, alpha, f_plus))))


def _ratio(value: float | None, other: float | None) -> float | None:
    return None if value is None or not other else value / other


def plain_number(value: Any) -> float | None:
    """A number that JSON knows: what is not finite becomes None."""
    value = float(value)
    return value if math.isfinite(value) else None
