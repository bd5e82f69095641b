"""Gain conditions against what observers do: the function behind `jaxbl verify`.

Three levels. "normalised": the error system (34) with f_plus = 1 under its worst disturbance, over a plane of alpha / f_plus
and lambda / sqrt(f_plus). "drive": the study's points with ideal encoders and the implicit observer, each judged at the
true f_plus along its run. "sampled": the study as it stands, with its period, quantisation and noise.
"""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false
# pyright: reportReturnType=false

import copy
import dataclasses
import json
from collections.abc import Callable, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from jaxbl.config import Config, read_config
from jaxbl.errors import InputError
from jaxbl.files import plain, write_atomic
from jaxbl.observer.conditions import CONDITIONS, Condition, least_lambda_davila_fridman, peak_ratio
from jaxbl.observer.worst_case import half_cycle, least_lambda_simulated
from jaxbl.sweeps.metrics import NOTHING, undisturbed
from jaxbl.sweeps.pieces import in_pieces
from jaxbl.sweeps.points import Points
from jaxbl.sweeps.programs import Backend, backend_of
from jaxbl.sweeps.store import backend_kept, claim, mark
from jaxbl.sweeps.sweep import sweep
from jaxbl.workers import Progress

SWITCHING_LIMIT = 0.02
"""Relative distance from lambda^2 = 4 c2, the switching limit of the closed form, within which the two are not compared."""

_MOST_EXPLAINED = 4096
_MOST_LISTED = 200


@dataclasses.dataclass(frozen=True)
class Normalised:
    """The error system with f_plus = 1 under its worst disturbance.

    Attributes:
        alpha: alpha / f_plus, shape (alphas,).
        lambda_: lambda / sqrt(f_plus), shape (lambdas,).
        ratio: simulated ratio of successive velocity peaks, shape (lambdas, alphas).
        closed_form: the same by the closed form.
        boundary: least lambda at which the simulated peaks fall, by bisection, shape (alphas,).
        damped: such boundaries under viscous damping, by damping (friction / inertia x speed / f_plus).
    """

    alpha: np.ndarray
    lambda_: np.ndarray
    ratio: np.ndarray
    closed_form: np.ndarray
    boundary: np.ndarray
    damped: dict[float, np.ndarray]

    @property
    def difference(self) -> float:
        """Largest difference of simulated and closed-form ratio away from the switching limit."""
        edge = np.sqrt(8.0 * (self.alpha + 1.0))
        far = np.abs(self.lambda_[:, None] / edge - 1.0) > SWITCHING_LIMIT
        return float(np.abs(self.ratio - self.closed_form)[far].max())


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What a verification found.

    Attributes:
        config: the study.
        summary: as in `verdict.json`.
        normalised: the error system's map and boundaries.
        levels: frames of "drive" and "sampled": the points of a sweep with their metrics.
        counterexamples: runs in which a condition held and the observer failed: level, side, condition, bound ("true" or
            "claimed"), cause, then all axis values, seed and metrics.
        scanned: what the fused loop did not know of runs that this call scanned in its place.
    """

    config: Config
    summary: dict[str, Any]
    normalised: Normalised
    levels: dict[str, pd.DataFrame]
    counterexamples: pd.DataFrame
    scanned: tuple[str, ...] = ()


def verify(
    study: str | Path | Mapping[str, Any] | Config,
    out: str | Path | None = None,
    *,
    progress: Progress | None = None,
    devices: list[Any] | None = None,
    overwrite: bool = False,
    backend: Backend | None = None,
) -> Verdict:
    """Check every gain condition on three levels, and list where it held and the observer failed all the same.

    Args:
        study: TOML file, mapping or config, with axes over alpha and lambda of an observer or both.
        out: folder to keep `verdict.json`, `counterexamples.parquet` and the runs in; what is there is not run again.
        progress: called with finished and total runs of the study's levels.
        devices: JAX devices to use; left out, all local ones.
        overwrite: remove the results of another study from `out`.
        backend: `fused` or `scan` (:func:`jaxbl.sweep`) for the runs of the study's levels; left out, the faster one here.

    Raises:
        InputError: wrong config, no axes over the gains, a folder that holds something else, or a backend that cannot run
            the study.
    """
    config, backend = read_config(study), backend_of(backend)
    sides = judged_sides(config)
    folder = None if out is None else Path(out)
    if folder is not None:
        claim(folder, config, "verify", overwrite=overwrite)
        (folder / "verify").mkdir(exist_ok=True)
        marker = folder / "verify" / "manifest.json"
        backend = backend_kept(marker, backend)
        write_atomic(marker, json.dumps(mark(config, "verify") | {"backend": backend}, indent=2))
    work = None if folder is None else folder / "verify"
    studies = {"drive": _ideal(config), "sampled": _only(config)}
    rows = {level: len(Points(study)) * study.sweep.seeds for level, study in studies.items()}
    normalised = _normalised(config, work, devices or jax.local_devices())
    levels, scanned, done = {}, {}, 0
    for level, study in studies.items():
        report = None if progress is None else partial(_shifted, progress, done, sum(rows.values()))
        place = None if work is None else work / level
        result = sweep(study, place, progress=report, devices=devices, backend=backend)
        levels[level] = result.frame
        scanned |= dict.fromkeys(result.scanned)
        for side in sides:
            size = levels[level][f"{side}.f_plus_acceleration"].max()
            if levels[level][f"{side}.f_plus"].max() <= NOTHING[config.run.precision] * size:
                raise undisturbed(side)
        done += rows[level]
    summaries = [_judge_normalised(config, normalised)]
    found = []
    for level, frame in levels.items():
        for side in sides:
            summary, counterexamples = _judge(config, level, side, frame)
            if len(counterexamples):
                explain = partial(_causes, studies[level], level, side, work=work, devices=devices)
                counterexamples = _explained(counterexamples, studies[level], explain)
                summary["causes"] = {
                    bound: part.drop_duplicates(_keys(studies[level])).cause.value_counts().to_dict()
                    for bound, part in counterexamples.groupby("bound")
                }
            summaries.append(summary)
            found.append(counterexamples)
    every = pd.concat(found, ignore_index=True)
    true = every[every["bound"] == "true"]
    summary = plain(
        {
            "title": config.title,
            "q": config.verify.q,
            "levels": summaries,
            "closed_form": {
                "cells": normalised.ratio.size,
                "largest_difference": normalised.difference,
                "switching_limit": SWITCHING_LIMIT,
            },
            "damping": [
                {"damping": damping, "alpha_ratio": normalised.alpha, "least_lambda_ratio": boundary}
                for damping, boundary in normalised.damped.items()
            ],
            "marks": _marks(config, work, devices),
            "counterexamples": true.head(_MOST_LISTED).to_dict("records"),
            "counterexamples_in_all": len(true),
        }
    )
    if folder is not None:
        draft = folder / "verify" / "counterexamples.draft"
        every.to_parquet(draft, index=False)
        draft.replace(folder / "counterexamples.parquet")
        write_atomic(folder / "verdict.json", json.dumps(summary, indent=1, ensure_ascii=False))
    return Verdict(config, summary, normalised, levels, every, tuple(scanned))


def judged_sides(config: Config) -> list[str]:
    """The sides whose gains are both on axes. Raises `InputError` where there is none."""
    paths = {axis.path for axis in config.axes}
    sides = [side for side in ("motor", "load") if {f"observer.{side}.alpha", f"observer.{side}.lambda"} <= paths]
    if not sides:
        raise InputError(
            "axes: verify needs axes over both gains of an observer, such as observer.motor.alpha and observer.motor.lambda"
        )
    if config.sweep.design != "grid" or config.sweep.refine is not None:
        key = "refine" if config.sweep.refine is not None else "design"
        raise InputError(f"sweep.{key}: verify seeks the least lambda that works in every column of a whole grid; remove it")
    for i, axis in enumerate(config.axes):
        if axis.zip is not None and axis.path in {f"observer.{side}.lambda" for side in sides}:
            raise InputError(
                f"axes[{i}].zip: verify seeks the least lambda that works, everything else being equal; "
                f"{axis.path} should not be zipped"
            )
    return sides


def _shifted(progress: Progress, before: int, total: int, done: int, _: int) -> None:
    progress(before + done, total)


def _only(config: Config, **updates: Any) -> Config:
    """The study without what its runs do not depend on, and with other tables."""
    data = config.resolved()
    for key in ("figures", "verify"):
        data.pop(key, None)
    return read_config(data | updates)


def _ideal(config: Config) -> Config:
    """The study with ideal encoders and the implicit observer, at one seed."""
    observer = config.resolved()["observer"] | {"discretisation": "implicit"}
    dropped = ("encoders.", "observer.discretisation", "run.sample_period", "run.substeps")
    axes = [axis.model_dump(exclude_none=True) for axis in config.axes if not axis.path.startswith(dropped)]
    labels = [axis.get("zip") for axis in axes]
    for axis in axes:
        if "zip" in axis and labels.count(axis["zip"]) == 1:
            del axis["zip"]
            if "values" in axis:
                axis["values"] = list(dict.fromkeys(axis["values"]))
    swept = config.resolved()["sweep"] | {"seeds": 1}
    return _only(config, encoders={}, observer=observer, axes=axes, sweep=swept)


# normalised level


@jax.jit
def _plane(lambda_: Any, alpha: Any) -> Any:
    one = jnp.ones_like(lambda_)
    return half_cycle(lambda_, alpha, one).ratio, peak_ratio(lambda_, alpha, one)


@jax.jit
def _border(alpha: Any, damping: Any) -> Any:
    return least_lambda_simulated(alpha, jnp.ones_like(alpha), damping=damping)


def _normalised(config: Config, work: Path | None, devices: list[Any]) -> Normalised:
    """Simulate the error system over the plane, or take it from the folder."""
    settings = config.verify
    alpha, lambda_ = settings.alpha_ratio.values(), settings.lambda_ratio.values()
    cells = [c.ravel() for c in np.meshgrid(lambda_, alpha, indexing="ij")]
    shape = (len(lambda_), len(alpha))
    dampings = [0.0, *settings.damping]

    def plane() -> pd.DataFrame:
        ratio, closed = in_pieces(_plane, cells, devices)
        return pd.DataFrame({"lambda_ratio": cells[0], "alpha_ratio": cells[1], "ratio": ratio, "closed_form": closed})

    def borders() -> pd.DataFrame:
        # by bisection: as sharp on a coarse map as on a fine one
        columns = [np.tile(alpha, len(dampings)), np.repeat(dampings, len(alpha))]
        least = in_pieces(_border, columns, devices)
        return pd.DataFrame({"alpha_ratio": columns[0], "damping": columns[1], "least_lambda_ratio": least})

    with jax.enable_x64(True):
        map_ = _kept(work and work / "normalised.parquet", plane)
        boundary = _kept(work and work / "boundaries.parquet", borders)["least_lambda_ratio"].to_numpy()
    ratio, closed = (map_[name].to_numpy().reshape(shape) for name in ("ratio", "closed_form"))
    boundaries = dict(zip(dampings, boundary.reshape(len(dampings), -1), strict=True))
    return Normalised(alpha, lambda_, ratio, closed, boundaries.pop(0.0), boundaries)


def _kept(path: Path | None, compute: Callable[[], pd.DataFrame]) -> pd.DataFrame:
    """A table from its file, or computed and kept there."""
    if path is not None and path.exists():
        return pd.read_parquet(path)
    table = compute()
    if path is not None:
        draft = path.with_suffix(".draft")
        table.to_parquet(draft, index=False)
        draft.replace(path)
    return table


@cache
def _conditions(q: float | None) -> dict[str, Condition]:
    if q is None:
        return CONDITIONS
    return CONDITIONS | {
        "davila_fridman": Condition(f"Davila-Fridman (32), q = {q:g}", partial(least_lambda_davila_fridman, q=q))
    }


def conditions_of(config: Config) -> dict[str, Condition]:
    """The gain conditions, with the study's q in (32)."""
    return _conditions(config.verify.q)


@cache
def _demands(q: float | None) -> Callable[..., Any]:
    return jax.jit(lambda alpha, f_plus: {name: one.least_lambda(alpha, f_plus) for name, one in _conditions(q).items()})


def demanded_lambda(config: Config, alpha: np.ndarray, f_plus: np.ndarray) -> dict[str, np.ndarray]:
    """Least lambda (rad^0.5/s) that each condition asks for at alpha and f_plus (rad/s^2), with the study's q in (32)."""
    with jax.enable_x64(True):
        found = in_pieces(_demands(config.verify.q), [np.asarray(alpha, float), np.asarray(f_plus, float)])
    return {name: found[name] for name in conditions_of(config)}


def _judge_normalised(config: Config, found: Normalised) -> dict[str, Any]:
    converged = found.ratio < 1.0
    least = demanded_lambda(config, found.alpha, np.ones_like(found.alpha))
    conditions = []
    for name, demanded in least.items():
        holds = found.lambda_[:, None] > demanded
        ratios = demanded / found.boundary
        conditions.append(
            {
                "name": name,
                "title": conditions_of(config)[name].title,
                "holds": int(holds.sum()),
                "counterexamples": int((holds & ~converged).sum()),
                "fails_but_converged": int((~holds & converged).sum()),
                "conservatism": {"median": np.median(ratios), "max": ratios.max(), "columns": len(ratios), "at_least": 0},
            }
        )
    return {
        "level": "normalised",
        "cells": found.ratio.size,
        "converged": int(converged.sum()),
        "conditions": conditions,
    }


# levels of the drive


def _keys(config: Config) -> list[str]:
    return [*(axis.path for axis in config.axes), "seed"]


def _judge(config: Config, level: str, side: str, frame: pd.DataFrame) -> tuple[dict[str, Any], pd.DataFrame]:
    """Count a level's runs by condition, at the true bound and at the claimed one; and the counterexamples."""
    path = f"observer.{side}.lambda"
    lambda_, alpha = (frame[f"observer.{side}.{gain}"].to_numpy(float) for gain in ("lambda", "alpha"))
    converged = frame[f"{side}.converged"].to_numpy(bool)
    bounds = {"true": f"{side}.f_plus", "claimed": f"{side}.f_plus_acceleration"}
    # the least lambda that worked, everything else being equal
    others = [key for key in _keys(config) if key != path and key in frame]
    first = frame[converged].groupby(others, sort=False)[path].idxmin().to_numpy()
    position = frame.index.get_indexer(first)
    smallest = lambda_.min()
    summaries: dict[str, list[dict[str, Any]]] = {}
    counterexamples = []
    for bound, column in bounds.items():
        summaries[bound] = []
        for name, demanded in demanded_lambda(config, alpha, frame[column].to_numpy(float)).items():
            holds = lambda_ > demanded
            failed = holds & ~converged
            with np.errstate(divide="ignore"):
                ratios = demanded[position] / lambda_[position]
            strict = np.isfinite(ratios) & (ratios > 1.0)
            entry = {
                "name": name,
                "title": conditions_of(config)[name].title,
                "holds": int(holds.sum()),
                "counterexamples": int(failed.sum()),
                "fails_but_converged": int((~holds & converged).sum()),
            }
            if bound == "true":
                entry["conservatism"] = {
                    "median": np.median(ratios[strict]) if strict.any() else None,
                    "max": ratios[strict].max() if strict.any() else None,
                    "columns": int(strict.sum()),
                    # the least lambda of the grid worked: the true ratio is larger
                    "at_least": int((strict & (lambda_[position] <= smallest)).sum()),
                }
            summaries[bound].append(entry)
            if failed.any():
                extra = {"level": level, "side": side, "condition": name, "bound": bound}
                counterexamples.append(frame[failed].assign(row=np.flatnonzero(failed), **extra))
    worked = frame[converged]
    too_small = worked[bounds["true"]] > worked[bounds["claimed"]]
    ratio = (worked[bounds["true"]] / worked[bounds["claimed"]]).replace([np.inf, -np.inf], np.nan).dropna()
    claimed = {
        "definition": "twice the largest acceleration",
        "converged_runs": len(worked),
        "too_small": float(too_small.mean()) if len(worked) else None,
        "true_over_claimed": {"median": ratio.median(), "max": ratio.max()},
        "by_input": _by_input(config, worked.assign(too_small=too_small), bounds),
        "conditions": summaries["claimed"],
    }
    summary = {
        "level": level,
        "side": side,
        "cells": len(frame),
        "converged": int(converged.sum()),
        "diverged": int((~frame["finite"].astype(bool)).sum()),
        "conditions": summaries["true"],
        "claimed_bound": claimed,
    }
    found = pd.concat(counterexamples, ignore_index=True) if counterexamples else pd.DataFrame({"bound": [], "row": []})
    return summary, found


def _by_input(config: Config, worked: pd.DataFrame, bounds: dict[str, str]) -> list[dict[str, Any]]:
    """True and claimed bound (medians, rad/s^2) for each combination of what excites the drive, over runs that converged."""
    kinds = ("excitation.", "transmission.", "drive.")
    keys = [axis.path for axis in config.axes if axis.path.startswith(kinds) and axis.path in worked]
    found = []
    for values, part in worked.groupby(keys, sort=True) if keys else []:
        found.append(
            {
                "input": dict(zip(keys, values, strict=True)),
                "converged_runs": len(part),
                **{bound: part[column].median() for bound, column in bounds.items()},
                "too_small": float(part["too_small"].mean()),
            }
        )
    return found


def _explained(found: pd.DataFrame, study: Config, explain: Callable[[pd.DataFrame], pd.Series]) -> pd.DataFrame:
    """Counterexamples with a column that says what made the observer fail."""
    # a claimed bound that the true one exceeds, with the condition failing at the true one, is cause enough
    true = set(zip(found["condition"][found["bound"] == "true"], found["row"][found["bound"] == "true"], strict=True))
    excused = np.array(
        [
            bound == "claimed" and (condition, row) not in true
            for bound, condition, row in zip(found["bound"], found["condition"], found["row"], strict=True)
        ],
        dtype=bool,
    )
    rest = found[~excused].drop_duplicates("row")
    causes = explain(rest) if len(rest) else pd.Series(dtype=object)
    cause = found["row"].map(dict(zip(rest["row"], causes, strict=True)))
    cause = cause.where(~excused, "f_plus underestimated")
    keys = _keys(study)
    lead = ["level", "side", "condition", "bound", "cause", *keys]
    return (
        found.assign(cause=cause)
        .drop(columns="row")[[*lead, *(c for c in found.columns if c not in (*lead, "row"))]]
        .sort_values(["condition", "bound", *keys], ignore_index=True)
    )


def _mended(run: dict[str, Any], level: str) -> dict[str, dict[str, Any]]:
    """What can make a run fail, with the keys that mend it; `run` as it stands in those runs."""
    long, fine = 4.0 * run["duration"], run["sample_period"] / 4.0
    mended: dict[str, dict[str, Any]] = {"run too short": {"run.duration": long}}
    mended["period too long"] = {"run.sample_period": fine, "run.substeps": max(-(-run["substeps"] // 4), 1)}
    if level == "sampled":
        mended["noise"] = {"encoders.noise": 0.0, "encoders.load_noise": None}
        mended["quantisation"] = {"encoders.motor_resolution": 0.0, "encoders.load_resolution": 0.0}
        mended["explicit discretisation"] = {"observer.discretisation": "implicit"}
    return mended


def _with(tables: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """A config's tables with some dotted keys set; None removes one."""
    data = copy.deepcopy(tables)
    for path, value in values.items():
        *names, key = path.split(".")
        table = data
        for name in names:
            table = table.setdefault(name, {})
        if value is None:
            table.pop(key, None)
        else:
            table[key] = value.item() if isinstance(value, np.generic) else value
    return data


def _causes(
    study: Config, level: str, side: str, rows: pd.DataFrame, *, work: Path | None, devices: list[Any] | None
) -> pd.Series:
    """What made some runs fail, by experiment: each is run again with one thing mended at a time, then with all of them.

    The cause is what mended it (all such, joined by "or"), or "several" if only all together did. "f_plus underestimated":
    that did not mend it either, but showed a bound that alpha does not exceed. Else "unexplained".
    """
    kept = rows.iloc[np.unique(np.linspace(0, len(rows) - 1, _MOST_EXPLAINED).astype(int))]
    structural = list(Points(study).groups[0].structural)
    causes = pd.Series("not tried", index=rows.index, dtype=object)

    def repeat(part: pd.DataFrame, fixed: dict[str, Any], change: dict[str, Any], name: str) -> pd.DataFrame | None:
        """The runs with some keys changed; None where that changes nothing."""
        again = _again(study, part, fixed, change)
        if again is None:
            return None
        place = None if work is None else work / "causes" / name.replace(" ", "_")
        frame = sweep(again.study, place, devices=devices, overwrite=True).frame
        return frame.iloc[again.positions(frame)]

    for number, (_, part) in enumerate(kept.groupby(structural, sort=False) if structural else [((), kept)]):
        name = f"{level}-{side}-{number}"
        fixed = {path: part[path].iloc[0] for path in structural}
        mended = _mended(_with(study.resolved(), fixed)["run"], level)
        together = {path: value for change in mended.values() for path, value in change.items()}
        frames = {cause: repeat(part, fixed, change, f"{name}-{cause}") for cause, change in mended.items()}
        mends = {cause: frame[f"{side}.converged"].to_numpy(bool) for cause, frame in frames.items() if frame is not None}
        alone = pd.Series(
            [" or ".join(cause for cause in mends if mends[cause][i]) for i in range(len(part))],
            index=part.index,
            dtype=object,
        )
        rest = part[alone == ""]
        if len(rest) and (frame := repeat(rest, fixed, together, f"{name}-several")) is not None:
            # an observer that fails can drag its own f_plus down; where it works, alpha turns out to be too small
            low = np.where(frame[f"{side}.margin_alpha"] <= 1.0, "f_plus underestimated", "unexplained")
            alone[rest.index] = np.where(frame[f"{side}.converged"].to_numpy(bool), "several", low)
        causes[part.index] = alone
    return causes


@dataclasses.dataclass(frozen=True)
class _Again:
    """Some runs of a study once more, as a study of listed points."""

    study: Config
    point: np.ndarray
    seed: np.ndarray

    def positions(self, frame: pd.DataFrame) -> np.ndarray:
        """Rows of the new study's frame that belong to the runs."""
        found = {}
        points = self.point.max() + 1
        for position, seed in enumerate(frame["seed"].to_numpy()):
            found[seed, position % points] = position
        return np.array([found[seed, point] for seed, point in zip(self.seed, self.point, strict=True)])


def _again(study: Config, rows: pd.DataFrame, fixed: dict[str, Any], change: dict[str, Any]) -> _Again | None:
    """The runs with some keys changed; None where that changes nothing."""
    unchanged = _with(study.resolved(), fixed)
    data = _with(unchanged, change)
    paths = [axis.path for axis in study.axes if axis.path not in fixed and axis.path not in change]
    dropped = [axis.path for axis in study.axes if axis.path in change and axis.path not in fixed]
    before, after = (read_config({**tables, "axes": []}).resolved() for tables in (unchanged, data))
    if not dropped and before == after:
        return None
    points = rows[paths].drop_duplicates(ignore_index=True)
    index = {tuple(row): i for i, row in enumerate(points.itertuples(index=False, name=None))}
    data["axes"] = [{"path": path, "values": points[path].tolist(), "zip": "runs"} for path in paths]
    data["sweep"] = {key: data["sweep"][key] for key in ("seeds", "first_seed")}
    numbers = np.array([index[row] for row in rows[paths].itertuples(index=False, name=None)])
    return _Again(read_config(data), numbers, rows["seed"].to_numpy())


# marks


def _marks(config: Config, work: Path | None, devices: list[Any] | None) -> list[dict[str, Any]]:
    """The marked gains on the study's drive (ideal encoders): bounds, margins, peak ratios."""
    found = []
    base = _ideal(config).resolved()
    drive = config.build().drive
    for side in ("motor", "load"):
        marks = [given for given in config.verify.marks if given.side == side]
        if not marks:
            continue
        gains = {"lambda": [given.lambda_ for given in marks], "alpha": [given.alpha for given in marks]}
        pairs = list(zip(*gains.values(), strict=True))
        points = list(dict.fromkeys(pairs))
        axes = [
            {"path": f"observer.{side}.{name}", "values": list(values), "zip": "marks"}
            for name, values in zip(gains, zip(*points, strict=True), strict=True)
        ]
        place = None if work is None else work / "marks" / side
        frame = sweep(base | {"axes": axes, "sweep": {}}, place, devices=devices, overwrite=True).frame
        frame = frame.iloc[[points.index(pair) for pair in pairs]]
        error = abs(float(base["observer"][side]["velocity_error"]))
        friction = float(drive.viscous(side)) / float(drive.inertia(side))
        bounds = frame[f"{side}.f_plus"].to_numpy(float)
        with jax.enable_x64(True):
            given = (jnp.asarray(x, float) for x in (gains["lambda"], gains["alpha"], bounds))
            ratios = jax.jit(_ratios)(*given, jnp.asarray(friction, float), jnp.asarray(error, float))
        for i, (given, bound) in enumerate(zip(marks, bounds, strict=True)):
            row = {name.partition(".")[2]: frame[name].iloc[i] for name in frame.columns if name.startswith(side)}
            found.append(
                {
                    "name": given.name,
                    "side": side,
                    "lambda": given.lambda_,
                    "alpha": given.alpha,
                    "f_plus": bound,
                    "alpha_ratio": given.alpha / bound,
                    "lambda_ratio": given.lambda_ / np.sqrt(bound),
                    "velocity_error": error,
                    "damping": friction * error / bound,
                    **{name: np.asarray(values)[i] for name, values in ratios.items()},
                    **{f"margin_{name}": row[f"margin_{name}"] for name in CONDITIONS},
                    "converged": bool(row["converged"]),
                    "convergence_time": row["convergence_time"],
                }
            )
    return found


def _ratios(lambda_: Any, alpha: Any, f_plus: Any, friction: Any, error: Any) -> dict[str, Any]:
    """Peak ratios of some gains: in closed form, with the drive's friction at the starting error, and under a disturbance
    that never changes; and the velocity error (rad/s) that the worst disturbance upholds against friction."""

    def damped(speed: Any) -> Any:
        return half_cycle(lambda_, alpha, f_plus, damping=friction, speed=speed).ratio

    def halve(bounds: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], None]:
        low, high = bounds
        middle = jnp.sqrt(low * high)
        grows = damped(middle) >= 1.0
        return (jnp.where(grows, middle, low), jnp.where(grows, high, middle)), None

    rest = (alpha + f_plus) / jnp.maximum(friction, 1e-12)  # friction alone brakes harder than alpha beyond this speed
    (upheld, _), _ = jax.lax.scan(halve, (1e-6 * rest, 10.0 * rest), length=40)
    undamped = peak_ratio(lambda_, alpha, f_plus)
    start = jnp.where(error > 0.0, error, 1e-6 * rest)
    still = [
        half_cycle(lambda_, alpha, f_plus, damping=friction, speed=start, outward=d, homeward=d).ratio for d in (1.0, -1.0)
    ]
    return {
        "peak_ratio": undamped,
        "peak_ratio_damped": damped(start),
        "peak_ratio_constant": jnp.sqrt(still[0] * still[1]),
        "upheld_velocity_error": jnp.where(undamped < 1.0, 0.0, upheld),
    }
