"""A model with every effect in it: those that it lacks are there at numbers with which they do nothing.

All models that a diagnosis tries then have one structure, and one compiled program serves them all: which effects act is a
matter of numbers. Free numbers are named by their place among all of the model's (:class:`Chosen`), so that the choice of
what is free is a matter of numbers too.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxbl.drive.effects import effect_class, effect_kinds
from jaxbl.drive.parameters import as_arrays, get_leaf, leaf_paths, set_leaves
from jaxbl.identification.trajectory import PHYSICAL, Free
from jaxbl.simulate import Experiment

Effect = TypeVar("Effect")

ACTUATOR_ORDER = ("actuator.gain_error", "actuator.saturation", "actuator.lag")
"""In which effects of the actuator act, unless the config says otherwise."""


def candidates(experiment: Experiment) -> list[str]:
    """Names of the effects that a model's drive can have and that the model lacks."""
    known = {effect.name for effect in experiment.effects}
    places = {*experiment.sides, "load", "actuator"}
    if experiment.transmission is not None:
        places.add("transmission")
    names = []
    for name in effect_kinds():
        place, _, kind = name.partition(".")
        # on a rigid drive the motor has all that both sides may have; only a load has the others
        twice = place == "load" and place not in experiment.sides and f"motor.{kind}" in effect_kinds()
        if effect_class(name).neutral and place in places and name not in known and not twice:
            names.append(name)
    return names


def complete(experiment: Experiment) -> Experiment:
    """A model with all effects that it lacks at neutral numbers; array leaves."""
    added = [as_arrays(effect_kinds()[name](**effect_class(name).neutral), float) for name in candidates(experiment)]
    effects = joined(experiment.effects, added, lambda one: one.name)
    kinds = list(effect_kinds())
    if len({one.name for one in effects}) == len(effects):
        # one order whatever was given, so that models share their programs; that of the actuator's matters
        effects.sort(key=lambda one: len(kinds) if one.place == "actuator" else kinds.index(one.name))
    return eqx.tree_at(lambda e: e.effects, experiment, tuple(effects))


def joined(given: Iterable[Effect], added: Iterable[Effect], name_of: Callable[[Effect], str]) -> list[Effect]:
    """Effects that a model has, in their order, and others behind them; effects of the actuator before those given that
    come later in :data:`ACTUATOR_ORDER`."""
    effects = list(given)
    for one in added:
        later = ACTUATOR_ORDER[ACTUATOR_ORDER.index(name_of(one)) + 1 :] if name_of(one) in ACTUATOR_ORDER else ()
        at = next((i for i, other in enumerate(effects) if name_of(other) in later), len(effects))
        effects.insert(at, one)
    return effects


def numbers_of(experiment: Experiment) -> tuple[str, ...]:
    """Dotted paths of all numbers of a model's plant."""
    return tuple(path for path in leaf_paths(experiment) if path.split(".")[0] in PHYSICAL)


_WIDTH = 4


class Chosen(eqx.Module):
    """Free numbers, by their place among all of a model's; shapes (numbers,), padded to a multiple of four.

    Attributes:
        paths: of all numbers of the model's plant.
        index: which of them each one is; their count where there is none.
        nominal, scale, positive: as of :class:`jaxbl.identification.trajectory.Free`.
    """

    paths: tuple[str, ...] = eqx.field(static=True)
    index: Int[Array, " numbers"]
    nominal: Float[Array, " numbers"]
    scale: Float[Array, " numbers"]
    positive: Bool[Array, " numbers"]

    @classmethod
    def of(cls, experiment: Experiment, free: Sequence[Free]) -> "Chosen":
        """Numbers of a model with all effects."""
        paths = numbers_of(experiment)
        spare = -len(free) % _WIDTH
        return cls(
            paths,
            jnp.asarray([*(paths.index(one.path) for one in free), *[len(paths)] * spare], int),
            jnp.asarray([*(one.nominal for one in free), *[0.0] * spare], float),
            jnp.asarray([*(one.scale for one in free), *[1.0] * spare], float),
            jnp.asarray([*(one.positive for one in free), *[False] * spare], bool),
        )

    def put(self, experiment: Experiment, theta: Float[Array, " numbers"]) -> Experiment:
        """The model with these numbers."""
        values = jnp.where(self.positive, self.scale * jnp.exp(theta), self.nominal + self.scale * theta)
        every = jnp.stack([jnp.asarray(get_leaf(experiment, path), float) for path in self.paths])
        every = every.at[self.index].set(values, mode="drop")
        return set_leaves(experiment, {path: every[i] for i, path in enumerate(self.paths)})

    def padded(self, values: np.ndarray, rest: float) -> Array:
        """Values of the free numbers, with `rest` for those that are none."""
        return jnp.asarray(np.concatenate([values, np.full(len(self.index) - len(values), rest)]))


def bucket(count: int, least: int, digits: int = 3) -> int:
    """The next number with so many binary digits: shapes of arrays are few then, and so are compiled programs."""
    size = least
    while size < count:
        size += max(least >> (digits - 1), 1 << max(size.bit_length() - digits, 0))
    return size
