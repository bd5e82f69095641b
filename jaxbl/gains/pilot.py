"""Pilot runs before a search for gains: the drives that gains must serve, and the bounds of what disturbs the observers."""

import itertools
import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxbl.chain import Experiment, Reducer, Signals, scan
from jaxbl.config import Config, precision, prepare, read_config
from jaxbl.drive.effects import correction_of
from jaxbl.drive.parameters import set_leaves
from jaxbl.errors import InputError, NoResult
from jaxbl.json_types import JsonObject
from jaxbl.sweeps.metrics import ROUNDING


class Scenarios(NamedTuple):
    """The drives that gains must serve: a config with their effects, their names, and the effects' values by path."""

    config: Config
    names: Sequence[str] = ("nominal",)
    columns: Mapping[str, list[float]] = MappingProxyType({})


def list_scenarios(config: Config, worst_over_uncertainty: bool) -> Scenarios:
    """List the nominal drive and, if asked, the corners of its uncertain inertias and viscous frictions.

    In a corner both sides err alike. The corners are effects: the plant has them, the observers do not know them.
    """
    if not worst_over_uncertainty:
        return Scenarios(config)
    data, relative = config.to_dict(), config.uncertainty.relative
    effects, errors = data["effects"], []
    for number, side in itertools.product(("inertia", "viscous"), config.build().sides):
        nominal = getattr(config.drive, f"{side}_{number}")
        if f"drive.{side}_{number}" in config.uncertainty.exact or nominal == 0.0:
            continue
        kind, key = correction_of(number, side)
        indices = [i for i, effect in enumerate(effects) if effect["kind"] == kind]
        total = nominal + sum(effects[i][key] for i in indices)
        if number == "inertia" and total - relative * nominal <= 0.0:
            raise InputError(
                f"uncertainty.relative: {relative:g} leaves no inertia on the {side} at its lower corner; "
                "it should be smaller, or tune.worst_over_uncertainty false"
            )
        if not indices:
            effects.append({"kind": kind, key: 0.0})
            indices = [len(effects) - 1]
        errors.append((number, indices[0], key, relative * nominal))
    if not errors:
        return Scenarios(config)
    numbers = dict.fromkeys((number for number, *_ in errors), 0)
    signs_by_corner = itertools.product((-1, 1), repeat=len(numbers))
    corners = [numbers, *(dict(zip(numbers, signs, strict=True)) for signs in signs_by_corner)]
    kinds = [effect["kind"] for effect in effects]
    columns = {}
    for number, index, key, size in errors:
        label = kinds[index] if kinds.count(kinds[index]) == 1 else str(index)
        columns[f"effects.{label}.{key}"] = [effects[index][key] + corner[number] * size for corner in corners]
    percent = f"{100.0 * relative:.3g} %"
    names = tuple(
        ", ".join(f"{number} {'+' if sign > 0 else '-'}{percent}" for number, sign in corner.items() if sign) or "nominal"
        for corner in corners
    )
    # uncertainty.exact may name effects by labels that have changed
    data.pop("uncertainty")
    config = read_config(data).model_copy(update={"uncertainty": config.uncertainty})
    return Scenarios(config, names, columns)


def list_axes(columns_by_label: Mapping[str, Mapping[str, Sequence[Any]]]) -> list[JsonObject]:
    """List axes of a study from columns of values by path: those of one label advance together."""
    return [
        {"path": path, "values": values, **({"zip": label} if len(columns) > 1 else {})}
        for label, columns in columns_by_label.items()
        for path, values in columns.items()
    ]


class _Extremes(NamedTuple):
    """Extremes of one side along a pilot run.

    Attributes:
        disturbance: largest |acceleration - f(velocity)|, rad/s^2.
        at_start: the same at the first sample.
        largest_velocity: largest |velocity|, rad/s.
        largest_acceleration: largest |acceleration|, rad/s^2.
    """

    disturbance: Any
    at_start: Any
    largest_velocity: Any
    largest_acceleration: Any


def _update_extremes(
    experiment: Experiment, extremes_by_side: dict[str, _Extremes], index: Any, signals: Signals
) -> dict[str, _Extremes]:
    sizes = {}
    for side in extremes_by_side:
        true = signals.side(side).true
        assert true is not None
        nominal = experiment.drive.acceleration(side, true.velocity, signals.input)
        missing = jnp.abs(true.acceleration - nominal)
        at_start = jnp.where(index == 0, missing, 0.0)
        sizes[side] = _Extremes(missing, at_start, jnp.abs(true.velocity), jnp.abs(true.acceleration))
    return jax.tree.map(jnp.maximum, extremes_by_side, sizes)


_EXTREMES = Reducer(
    lambda experiment: {side: _Extremes(*[jnp.zeros_like(experiment.run.sample_period)] * 4) for side in experiment.sides},
    _update_extremes,
    lambda experiment, totals, state: totals,
)


def _find_extremes(scenarios: Scenarios, excitation: Any = None) -> dict[str, dict[str, float]]:
    """Simulate all scenarios, and return the extremes of each side over them."""
    config = scenarios.config
    if excitation is not None:
        config = config.model_copy(update={"excitation": excitation})
    with precision(config):
        experiment = prepare(config)

        def run_scenario(values: dict[str, Any]) -> dict[str, Any]:
            return scan(set_leaves(experiment, values), jnp.asarray(0), (_EXTREMES,))[0]

        columns = {path: jnp.asarray(column, config.run.precision) for path, column in scenarios.columns.items()}
        extremes = jax.jit(jax.vmap(run_scenario) if columns else run_scenario)(columns)
        largest = jax.tree.map(lambda values: float(values.max()), extremes)
        extremes_by_side = {side: largest[side]._asdict() for side in experiment.sides}
    for side, extremes in extremes_by_side.items():
        if not all(map(math.isfinite, extremes.values())):
            raise NoResult(f"{side}: the drive itself diverges in the pilot run: there is nothing to observe")
        for name in ("disturbance", "at_start"):
            if extremes[name] <= ROUNDING[config.run.precision] * extremes["largest_acceleration"]:
                extremes[name] = 0.0
    return extremes_by_side


def run_pilot(scenarios: Scenarios, holdout: Any = None) -> JsonObject:
    """Find f_plus (rad/s^2) by side from pilot runs: for the study's excitation and for the held-out one, if another.

    The acceleration that an observer's model lacks is the disturbance, plus viscous friction times the velocity error. The
    latter is largest at the start and vanishes within some samples. So f_plus is the larger of two numbers: the largest
    disturbance along the run, and the sum of both at the start. Of a starting error that is only assumed the friction does
    not count: it brakes the error, and gains for it would suit a drive that nobody has.
    """
    config, study_extremes, pilot_by_side = scenarios.config, _find_extremes(scenarios), {}
    holdout_extremes = study_extremes if holdout is None else _find_extremes(scenarios, holdout)
    for side, extremes in study_extremes.items():
        observer = getattr(config.observer, side)
        assumed = observer.position_error == 0.0 and observer.velocity_error == 0.0
        velocity_error = extremes["largest_velocity"] if assumed else observer.velocity_error
        friction = getattr(config.drive, f"{side}_viscous") / getattr(config.drive, f"{side}_inertia") * abs(velocity_error)
        bounds = [
            max(run["disturbance"], run["at_start"] + (0.0 if assumed else friction))
            for run in (extremes, holdout_extremes[side])
        ]
        pilot_by_side[side] = extremes | {
            "velocity_error": velocity_error,
            "position_error": observer.position_error,
            "starting_error_assumed": assumed,
            "start": extremes["at_start"] + friction,
            "f_plus": bounds[0],
            "holdout_f_plus": bounds[1],
        }
    return pilot_by_side
