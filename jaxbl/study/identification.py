"""Parameters of a machine from its log: the function behind `jaxbl identify`.

A trajectory fit with intervals, and beside it the paper's chain: the study's observers run on the recorded positions, and
the recursive identifier (27)-(28) on their equivalent control.
"""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from jaxbl.drive.parameters import get_leaf, leaf_paths, set_leaves
from jaxbl.drive.plant import PlantState
from jaxbl.errors import InputError
from jaxbl.identify.intervals import Refusal, Spread, interval, refusals, spread
from jaxbl.identify.smoother import Smoothed, smooth
from jaxbl.identify.trajectory import PHYSICAL, Fit, Free, Windows, cut, fit, free_parameters, is_positive
from jaxbl.records import Record, read_record
from jaxbl.simulate import Experiment, Signals, State, replay

from .config import Config, IdentifyTable, read_config, with_values
from .engine import prepare
from .store import plain

_LONG, _SHORT = 500, 50
"""Samples of the windows that are tried where the study gives none."""
_MOST_COARSE = 100
_FEWEST = 20
_LOG_NAMES = {"motor": "theta_e", "load": "theta_s"}


@dataclasses.dataclass(frozen=True)
class Identification:
    """What a log says of a machine.

    Attributes:
        config: the study, with its nominal numbers.
        model: the study with the numbers found.
        record: the log.
        summary: as in `identification.json`.
        trace: one row a sample: `t`, `u`, positions, smoothed velocities and accelerations with standard deviations,
            residuals of the fit (rad), and what the observers and the recursive identifier make of the record.
    """

    config: Config
    model: Config
    record: Record
    summary: dict[str, Any]
    trace: pd.DataFrame


def identify(
    log: str | Path | Record,
    model: str | Path | Mapping[str, Any] | Config,
    *,
    parameters: Sequence[str] | None = None,
) -> Identification:
    """Identify a machine from its log.

    Args:
        log: the file, read as the study's `[log]` table says, or a record.
        model: study with nominal numbers: TOML file, mapping or config.
        parameters: dotted paths of the numbers to find, in place of `[identify] parameters`.

    Raises:
        InputError: unfit log or study, or a number that cannot be fitted.
    """
    config = read_config(model)
    settings = config.identify
    record = log if isinstance(log, Record) else record_for(config, log)
    assert record.torque is not None
    with jax.enable_x64(True):
        experiment = _on_record(config, record)
        paths = list(parameters or settings.parameters or _default_paths(config, experiment))
        free = free_parameters(experiment, paths, float(np.std(record.torque)))
        smoothed = {side: [smooth(record.positions[side][part], record.sample_period) for part in record.segments]
                    for side in experiment.sides}  # fmt: skip
        noise = {side: float(np.mean([float(one.noise) for one in parts])) for side, parts in smoothed.items()}
        search = _Search(experiment, record, smoothed, noise, settings)
        found = search.run(free)
        values = {one.path: float(one.value(found.fit.theta[i])) for i, one in enumerate(found.free)}
        experiment = set_leaves(experiment, {path: jnp.asarray(value) for path, value in values.items()})
        chain, recursive = _chain(experiment, record)
        trace = pd.DataFrame(
            {"t": record.time, "u": record.torque}
            | {_LOG_NAMES[side]: record.positions[side] for side in experiment.sides}
            | _smoothed_columns(smoothed)
            | _residual_columns(found, record, noise, experiment.sides)
            | chain
        )
        summary = _summary(config, record, experiment, found, search, noise, recursive)
    return Identification(config, with_values(config, values), record, summary, trace)


def record_for(config: Config, log: str | Path) -> Record:
    """Read a log as a study says, with the channels that its identification needs.

    Raises:
        InputError: unfit log.
    """
    ratio = config.drive.gear_ratio if config.drive.kind == "two_inertia" else None
    record = read_record(log, config.log, gear_ratio=ratio)
    sides = ("motor", "load") if config.drive.kind == "two_inertia" else ("motor",)
    for side in sides:
        if side not in record.positions:
            raise InputError(
                f"{record.path}: no {side} position ({_LOG_NAMES[side]}), which a {config.drive.kind} drive needs; "
                f"the log has {', '.join(record.positions)}"
            )
    if record.torque is None:
        raise InputError(f"{record.path}: no input torque (u), which identification needs")
    return record


def _on_record(config: Config, record: Record) -> Experiment:
    """The study's experiment at the record's period, with plant steps no longer than the study's."""
    step = config.run.sample_period / config.run.substeps
    substeps = max(int(np.ceil(record.sample_period / step * (1.0 - 1e-9))), 1)
    experiment = prepare(config.model_copy(update={"run": config.run.model_copy(update={"precision": "float64"})}))
    return eqx.tree_at(
        lambda e: e.run,
        experiment,
        dataclasses.replace(
            experiment.run,
            sample_period=jnp.asarray(record.sample_period),
            steps=len(record.time),
            substeps=substeps,
        ),
    )


def _default_paths(config: Config, experiment: Experiment) -> list[str]:
    """All numbers of the plant that are not known exactly and have a value to start from."""
    return [
        path
        for path, about in leaf_paths(experiment).items()
        if path.split(".")[0] in PHYSICAL
        and path not in config.uncertainty.exact
        and not (is_positive(about) and float(get_leaf(experiment, path)) <= 0.0)
    ]


@dataclasses.dataclass(frozen=True)
class _Found:
    """The fit that was kept."""

    free: tuple[Free, ...]
    fit: Fit
    spread: Spread
    window: int
    windows: Windows
    firsts: np.ndarray
    refused: list[Refusal]
    held: list[str]
    condition: float


class _Search:
    """Multi-start on short windows, then fits to the whole record in windows of one or two lengths."""

    def __init__(
        self,
        experiment: Experiment,
        record: Record,
        smoothed: dict[str, list[Smoothed]],
        noise: dict[str, float],
        settings: IdentifyTable,
    ):
        self.experiment, self.record, self.smoothed, self.noise, self.settings = (
            experiment,
            record,
            smoothed,
            noise,
            settings,
        )
        shortest = min(part.stop - part.start for part in record.segments)
        asked = None if settings.window is None else round(settings.window / record.sample_period)
        if asked is not None and not _FEWEST <= asked <= shortest:
            raise InputError(
                f"identify.window: {settings.window:g} s are {asked} samples; it should be between {_FEWEST} samples "
                f"({_FEWEST * record.sample_period:g} s) and the log's shortest part ({shortest * record.sample_period:g} s)"
            )
        lengths = {_SHORT, _LONG} if asked is None else {asked}
        self.lengths = sorted({min(length, shortest // 2 if asked is None else shortest) for length in lengths})
        self.starts: list[dict[str, Any]] = []
        self._fit = eqx.filter_jit(fit)
        self._fits = eqx.filter_jit(lambda e, free, w, thetas: jax.vmap(lambda theta: fit(e, free, w, theta, 30))(thetas))

    def windows(self, samples: int) -> tuple[Windows, np.ndarray]:
        """The record in windows, segment by segment, and the row that each begins with."""
        record, pieces, firsts = self.record, [], []
        assert record.torque is not None
        for i, part in enumerate(record.segments):
            found = {side: parts[i] for side, parts in self.smoothed.items()}
            count = part.stop - part.start
            start = PlantState(
                {side: one.position for side, one in found.items()},
                {side: one.velocity for side, one in found.items()},
                jax.tree.map(
                    lambda x, count=count: jnp.full(count, x), self.experiment.plant.init(self.experiment.initial).effects
                ),
            )
            measured = {side: record.positions[side][part] for side in found}
            pieces.append(cut(record.torque[part], measured, record.sample_period, start, self.noise, samples))
            firsts.append(part.start + samples * np.arange(count // samples))
        noise = pieces[0].noise
        joined = jax.tree.map(lambda *x: jnp.concatenate(x), *(dataclasses.replace(p, noise={}) for p in pieces))
        first = np.concatenate(firsts)
        time = jnp.asarray(record.time[first] - record.time[0])
        return dataclasses.replace(joined, noise=noise, time=time), first

    def run(self, free: tuple[Free, ...]) -> _Found:
        """Fit; directions that the record does not show are taken out one number at a time."""
        theta = self._coarse(free)
        everything, refused, held = free, [], []
        while True:
            found = self._whole(free, theta)
            shown, condition = refusals(free, found[1])
            if not refused:
                first_condition = condition
            if not shown or len(free) == 1:
                break
            refused = refused or shown
            worst = max(shown, key=lambda one: one.deviation)
            out = max(worst.direction, key=lambda path: abs(worst.direction[path]))
            held.append(out)
            keep = [i for i, one in enumerate(free) if one.path != out]
            free, theta = tuple(free[i] for i in keep), theta[jnp.asarray(keep)]
        assert len(everything) == len(free) + len(held)
        return _Found(free, *found, refused, held, first_condition)

    def _coarse(self, free: tuple[Free, ...]) -> jax.Array:
        """Best of several starts, on short windows from all over the record."""
        windows, _ = self.windows(self.lengths[0])
        if len(windows.time) > _MOST_COARSE:
            pick = np.linspace(0, len(windows.time) - 1, _MOST_COARSE).astype(int)
            noise = windows.noise
            chosen = jax.tree.map(lambda x: x[pick], dataclasses.replace(windows, noise={}))
            windows = dataclasses.replace(chosen, noise=noise)
        random = np.random.default_rng(self.settings.seed)
        reach = np.log(self.settings.spread)
        thetas = np.zeros((self.settings.starts, len(free)))
        thetas[1:] = random.uniform(-reach, reach, thetas[1:].shape)
        found = self._fits(self.experiment, free, windows, jnp.asarray(thetas))
        cost = np.where(np.isfinite(np.asarray(found.cost)), np.asarray(found.cost), np.inf)
        if not np.isfinite(cost).any():
            raise InputError(
                f"{self.record.path}: the model diverges from every start; its nominal numbers should be nearer"
            )
        best = int(np.argmin(cost))
        self.starts = [
            {"cost": float(c), "agrees": bool(c <= cost[best] * 1.01), "theta": t.tolist()}
            for c, t in zip(cost, np.asarray(found.theta), strict=True)
        ]
        return found.theta[best]

    def _whole(self, free: tuple[Free, ...], theta: jax.Array) -> tuple[Fit, Spread, int, Windows, np.ndarray]:
        """The fit to all of the record; of the windows tried, those with the narrower intervals on the whole.

        Long windows tell more where noise alone disturbs; where the model does not explain everything, errors grow along
        them, and the intervals, which know correlated residuals, become wider than those of short windows.
        """
        best = None
        for samples in self.lengths:
            windows, firsts = self.windows(samples)
            found = self._fit(self.experiment, free, windows, theta)
            width = spread(found)
            size = float(jnp.sum(jnp.log(jnp.diag(width.covariance))))
            if np.isfinite(size) and (best is None or size < best[0]):
                best = size, (found, width, samples, windows, firsts)
        if best is None:
            raise InputError(f"{self.record.path}: the model diverges on this log; its nominal numbers should be nearer")
        return best[1]


def _smoothed_columns(smoothed: dict[str, list[Smoothed]]) -> dict[str, np.ndarray]:
    columns = {}
    for side, parts in smoothed.items():
        for order, name in ((1, "velocity"), (2, "acceleration")):
            columns[f"{side}.{name}"] = np.concatenate([np.asarray(one.state[:, order]) for one in parts])
            columns[f"{side}.{name}_deviation"] = np.concatenate([np.asarray(one.deviation(order)) for one in parts])
    return columns


def _residual_columns(
    found: _Found, record: Record, noise: dict[str, float], sides: tuple[str, ...]
) -> dict[str, np.ndarray]:
    columns = {}
    rows = (found.firsts[:, None] + np.arange(found.window)).ravel()
    for i, side in enumerate(sides):
        column = np.full(len(record.time), np.nan)
        column[rows] = noise[side] * np.asarray(found.fit.residual[:, :, i]).ravel()
        columns[f"{side}.residual"] = column
    return columns


def _chain(experiment: Experiment, record: Record) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The paper's chain on the record's longest part: columns over time (NaN elsewhere), and what it finds at the end."""
    names: list[str] = []

    def keep(state: State, signals: Signals) -> dict[str, Any]:
        row: dict[str, Any] = {}
        if signals.twist is not None:
            row["twist"] = signals.twist
        for side in experiment.sides:
            row[f"{side}.velocity_estimate"] = signals.side(side).velocity_estimate
            row[f"{side}.torque_estimate"] = signals.side(side).torque_estimate
        if state.identifier is not None:
            assert experiment.identifier is not None and experiment.transmission is not None
            path = experiment.identifier.estimate(state.identifier, experiment.transmission)
            row |= {f"{side}.{name}": value for side, values in path.items() for name, value in values.items()}
        names[:] = row
        return row

    part = max(record.segments, key=lambda one: one.stop - one.start)
    assert record.torque is not None
    given = jnp.asarray(record.torque[part]), {side: jnp.asarray(record.positions[side][part]) for side in experiment.sides}
    _, kept = eqx.filter_jit(partial(replay, record=keep))(experiment, *given)
    columns = {}
    for name in names:
        columns[name] = np.full(len(record.time), np.nan)
        columns[name][part] = np.asarray(kept[name])
    found: dict[str, Any] = {}
    if experiment.transmission is not None:
        for name in experiment.transmission.truth():
            found[name] = {side: float(columns[f"{side}.{name}"][part][-1]) for side in experiment.sides}
    return columns, found


def _derived(experiment: Experiment, found: _Found) -> dict[str, Any]:
    """What else the law's numbers say (half_gap beside dead_zone), with standard errors by the delta method."""
    if experiment.transmission is None:
        return {}

    def others(theta: jax.Array) -> dict[str, Any]:
        at = set_leaves(experiment, {one.path: one.value(theta[i]) for i, one in enumerate(found.free)})
        assert at.transmission is not None
        known = {path.rpartition(".")[2] for path in leaf_paths(at) if path.startswith("transmission.")}
        return {name: value for name, value in at.transmission.truth().items() if name not in known}

    values, slopes = others(found.fit.theta), jax.jacfwd(others)(found.fit.theta)
    derived = {}
    for name, value in values.items():
        error = float(jnp.sqrt(slopes[name] @ found.spread.covariance @ slopes[name]))
        derived[f"transmission.{name}"] = {
            "value": float(value), "standard_error": error,
            "interval": [float(value) - 1.96 * error, float(value) + 1.96 * error],
        }  # fmt: skip
    return derived


def _summary(
    config: Config,
    record: Record,
    experiment: Experiment,
    found: _Found,
    search: _Search,
    noise: dict[str, float],
    recursive: dict[str, Any],
) -> dict[str, Any]:
    theta, width = np.asarray(found.fit.theta), np.asarray(found.spread.covariance)
    deviation = np.sqrt(np.diag(width))
    parameters = {}
    for i, one in enumerate(found.free):
        low, high = interval(one, theta[i], deviation[i])
        parameters[one.path] = {
            "value": float(one.value(theta[i])),
            "standard_error": float(one.slope(theta[i])) * deviation[i],
            "interval": [low, high],
            "unit": one.unit,
            "nominal": one.nominal,
        }
    parameters |= _derived(experiment, found)
    residual = {
        side: {
            "rms": noise[side] * float(jnp.sqrt(jnp.mean(found.fit.residual[:, :, i] ** 2))),
            "noise": noise[side],
        }
        for i, side in enumerate(experiment.sides)
    }
    agreeing = sum(start["agrees"] for start in search.starts)
    return plain(
        {
            "title": config.title,
            "file": str(record.path.resolve()),
            "samples": len(record.time),
            "sample_period": record.sample_period,
            "parameters": parameters,
            "correlation": {
                "parameters": [one.path for one in found.free],
                "matrix": width / np.outer(deviation, deviation),
            },
            "refused": [
                {"direction": one.direction, "why": _why(one), "relative_deviation": one.deviation} for one in found.refused
            ],
            "held": found.held,
            "condition": found.condition,
            "residual": residual,
            "method": {
                "recursive": recursive,
                "trajectory": {
                    "window": found.window * record.sample_period,
                    "windows": len(found.firsts),
                    "converged": found.fit.converged,
                    "starts": len(search.starts),
                    "starts_agreeing": agreeing,
                    "variance_over_noise": found.spread.variance,
                    "inflation": dict(zip([one.path for one in found.free], found.spread.inflation, strict=True)),
                },
            },
            "notes": list(record.notes),
        }
    )


_HELP = {
    "inertia": "faster changes of torque",
    "viscous": "a wider range of speeds",
    "stiffness": "larger torques through the gear, near its resonance",
    "half_gap": "reversals that cross the gap",
    "dead_zone": "reversals that cross the gap",
    "slope": "slow passages through the gap",
    "torque": "slow motion with reversals",
    "relative": "a load or an inertia that is known",
}


def _why(refusal: Refusal) -> str:
    names = list(refusal.direction)
    if len(names) == 1:
        text = f"this log hardly depends on {names[0]}"
    else:
        text = "this log depends hardly on these changing together, by the shares given"
    keys = dict.fromkeys(_HELP[key] for path in names for key in _HELP if path.endswith(key))
    helps = f"; what would help: {', or '.join(keys)}" if keys else ""
    size = f"{100.0 * refusal.deviation:.0f} %" if refusal.deviation < 100.0 else "anything"
    return f"{text}: it leaves {size} open (standard deviation){helps}"
