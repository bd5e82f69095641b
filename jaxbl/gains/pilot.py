"""Before gains are chosen: the drives that they must serve, and pilot runs that find what disturbs the observers."""

import itertools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.config import Config, TuneTable, precision, prepare, read_config
from jaxbl.drive.effects import correction_of
from jaxbl.drive.parameters import set_leaves
from jaxbl.errors import InputError, NoResult
from jaxbl.simulate import Experiment, Reducer, Signals, scan
from jaxbl.sweeps.metrics import ROUNDING


class Scenarios(NamedTuple):
    """Drives that gains must serve: a config that has their effects, their names, and the effects' values by path."""

    config: Config
    names: list[str]
    columns: dict[str, list[float]]


def scenarios_of(config: Config, table: TuneTable) -> Scenarios:
    """The nominal drive, and the corners of its uncertain inertias and viscous frictions (the same on both sides at once).

    The corners are effects: the plant has them, the observers do not know them.
    """
    if not table.worst_over_uncertainty:
        return Scenarios(config, ["nominal"], {})
    data, relative = config.to_dict(), config.uncertainty.relative
    effects: list[dict[str, Any]] = data.setdefault("effects", [])
    found: dict[str, list[tuple[int, str, float]]] = {}
    for number, side in itertools.product(("inertia", "viscous"), config.build().sides):
        nominal = getattr(config.drive, f"{side}_{number}")
        if f"drive.{side}_{number}" in config.uncertainty.exact or nominal == 0.0:
            continue
        kind, key = correction_of(number, side)
        places = [i for i, effect in enumerate(effects) if effect["kind"] == kind]
        total = nominal + sum(effects[i][key] for i in places)
        if number == "inertia" and total - relative * nominal <= 0.0:
            raise InputError(
                f"uncertainty.relative: {relative:g} leaves no inertia on the {side} at its lower corner; "
                "it should be smaller, or tune.worst_over_uncertainty false"
            )
        if not places:
            effects.append({"kind": kind, key: 0.0})
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
    largest_acceleration: Any


def _see(experiment: Experiment, totals: dict[str, _Seen], index: Any, signals: Signals) -> dict[str, _Seen]:
    new = {}
    for side, old in totals.items():
        true = signals.side(side).true
        assert true is not None
        known = experiment.drive.acceleration(side, true.velocity, signals.input)
        unknown = jnp.abs(true.acceleration - known)
        new[side] = _Seen(
            jnp.maximum(old.disturbance, unknown),
            jnp.where(index == 0, unknown, old.at_start),
            jnp.maximum(old.largest_velocity, jnp.abs(true.velocity)),
            jnp.maximum(old.largest_acceleration, jnp.abs(true.acceleration)),
        )
    return new


_PILOT = Reducer(
    lambda experiment: {side: _Seen(*[jnp.zeros_like(experiment.run.sample_period)] * 4) for side in experiment.sides},
    _see,
    lambda experiment, totals, state: {f"{s}.{n}": v for s, seen in totals.items() for n, v in seen._asdict().items()},
)


def _seen(scenarios: Scenarios, excitation: Any = None) -> dict[str, dict[str, float]]:
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
        for name in ("disturbance", "at_start"):
            if values[name] <= ROUNDING[config.run.precision] * values["largest_acceleration"]:
                values[name] = 0.0
    return out


def pilot(scenarios: Scenarios, table: TuneTable) -> dict[str, Any]:
    """Bounds that the pilot runs find: of the study's excitation, with the observers' starting errors, and of the holdout's.

    The observers' right-hand side error is the disturbance and what viscous friction makes of the velocity error. The latter
    is largest at the start and gone within some samples, so that f_plus is the larger of the disturbance along the run and
    of both at the start.
    """
    config, found, out = scenarios.config, _seen(scenarios), {}
    held = found if table.holdout is None else _seen(scenarios, table.holdout)
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
