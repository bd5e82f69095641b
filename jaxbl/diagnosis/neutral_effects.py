"""A model with every effect in it: those that it lacks are there at numbers with which they do nothing.

The models that a diagnosis tries then have one structure, and one compiled program serves them all: which effects act is a
matter of numbers. An effect with a state of its own, though, would make every linearisation larger: it is in the model only
where it acts. Loops for this machine's processor, which compile fast, get the model without those that do nothing.
"""

import dataclasses
from collections.abc import Collection, Iterable
from functools import cache, lru_cache
from typing import Any

import jax
import numpy as np

from jaxbl.chain import Experiment, with_effects
from jaxbl.drive.effects import EFFECTS, AbstractEffect, ConstantTorque, make_effect
from jaxbl.drive.parameters import as_arrays
from jaxbl.drive.plant import PlantState


def candidates(experiment: Experiment) -> list[str]:
    """Names of the effects that a model's drive can have and that the model lacks."""
    present = {effect.name for effect in experiment.effects}
    places = {*experiment.sides, "load", "actuator", "transmission"}
    names = []
    for name, cls in EFFECTS.items():
        place = name.partition(".")[0]
        # on a rigid drive the motor has all that both sides may have; only a load has the others
        twice = place == "load" and place not in experiment.sides and "motor" in cls.places
        possible = experiment.transmission is not None or cls.suits(None)
        if cls.neutral() and place in places and possible and name not in present and not twice:
            names.append(name)
    return names


def find_corrected(name: str) -> str | None:
    """Return the dotted path of the drive's number that an effect is the error of; None where it is of none."""
    number = EFFECTS[name].corrects if name in EFFECTS else None
    return None if number is None else f"drive.{name.partition('.')[0]}_{number}"


def _neutral(name: str) -> AbstractEffect:
    return _neutral_of(name, EFFECTS[name], jax.dtypes.canonicalize_dtype(float))


@lru_cache(maxsize=256)
def _neutral_of(name: str, cls: type[AbstractEffect], dtype: Any) -> AbstractEffect:
    return as_arrays(make_effect(name, **cls.neutral()), dtype)


@cache
def has_state(name: str) -> bool:
    """Tell whether an effect has a state of its own."""
    return bool(jax.tree.leaves(jax.eval_shape(_neutral(name).init)))


def complete(experiment: Experiment, acting: Collection[str] = ()) -> Experiment:
    """A model with all effects that it lacks at neutral numbers; array leaves.

    Of those with a state of their own it has the ones that are `acting`.
    """
    added = [_neutral(name) for name in candidates(experiment) if name in acting or not has_state(name)]
    if not added:
        return experiment
    effects = with_added(experiment.effects, added)
    kinds = list(EFFECTS)
    if len({effect.name for effect in effects}) == len(effects):
        # one order whatever was given, so that models share their programs; that of the actuator's matters
        effects.sort(key=lambda effect: len(kinds) if effect.place == "actuator" else kinds.index(effect.name))
    return with_effects(experiment, tuple(effects))


def without(experiment: Experiment, name: str) -> Experiment:
    """Return a model with one of its effects at neutral numbers."""
    return with_effects(
        experiment, tuple(_neutral(name) if effect.name == name else effect for effect in experiment.effects)
    )


def lean(experiment: Experiment, state: PlantState, free: Collection[str] = ()) -> tuple[Experiment, PlantState]:
    """A model and its state without the effects that do nothing, and may not by their `free` numbers.

    Loops for this machine's processor are compiled anew for each set of effects, which takes as long as three linearisations
    along a log with all of them (benchmarks/NOTES.md).
    """
    may = {path.rpartition(".")[0].removeprefix("effects.") for path in free if path.startswith("effects.")}
    pairs = [
        (effect, state)
        for effect, state in zip(experiment.effects, state.effects, strict=True)
        if effect.name in may or jax.tree.leaves(state) or not _is_neutral(effect)
    ]
    experiment = with_effects(experiment, tuple(effect for effect, _ in pairs))
    return experiment, dataclasses.replace(state, effects=tuple(own_state for _, own_state in pairs))


def _is_neutral(effect: AbstractEffect) -> bool:
    if effect.name not in EFFECTS or not EFFECTS[effect.name].neutral():
        return False
    pairs = zip(jax.tree.leaves(effect), jax.tree.leaves(_neutral(effect.name)), strict=True)
    return all(np.array_equal(leaf, other) for leaf, other in pairs)


class _AddedTorque(ConstantTorque):
    """A torque on a side, beside what the model has there; a name of its own."""

    kind = "added_torque"


def with_torques(experiment: Experiment) -> tuple[Experiment, dict[str, str]]:
    """Return a model with a further resisting torque on each side, of zero, and its dotted path by side."""
    added = [_AddedTorque(side=side, torque=np.zeros(())) for side in experiment.sides]  # type: ignore[arg-type]
    paths = {effect.side: f"effects.{effect.name}.torque" for effect in added}
    return with_effects(experiment, (*experiment.effects, *added)), paths


def with_added(present: Iterable[Any], added: Iterable[Any]) -> list[Any]:
    """Effects that a model has, or a study as tables, in their order, and others behind them; effects of the actuator before
    those given of a higher rank (:class:`jaxbl.drive.effects.ActuatorEffect`)."""

    def rank(effect: Any) -> int:
        return getattr(EFFECTS[effect["kind"]] if isinstance(effect, dict) else effect, "rank", -1)

    effects = list(present)
    for effect in added:
        place = next((i for i, other in enumerate(effects) if 0 <= rank(effect) < rank(other)), len(effects))
        effects.insert(place, effect)
    return effects


def bucket(count: int, least: int) -> int:
    """The next number with three binary digits: shapes of arrays are few then, and so are compiled programs."""
    size = least
    while size < count:
        size += 1 << (size.bit_length() - 3)
    return size
