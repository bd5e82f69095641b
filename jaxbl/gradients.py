"""A warning where derivatives are asked for that mean nothing: each sample's is right, but the run amplifies them.

That is so through super-twisting observers, which switch, and where noise is fed back through a gap or dry friction.
"""

import functools
import logging
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
from jax.core import Tracer

from .chain import Experiment
from .drive.effects import AbstractEffect
from .observer import AbstractSuperTwisting

_WITHOUT_MOTION = "identifier", "equivalent_control", "run"
"""What changes no observer's estimates."""
_Function = TypeVar("_Function", bound=Callable[..., Any])


def warn_when_differentiated(function: _Function) -> _Function:
    """Return a function of an experiment and arrays that warns, once, as JAX traces a derivative that means nothing.

    What it computes, and how fast, does not change: the warning is the rule of an identity's derivative.
    """

    @functools.wraps(function)
    def run(experiment: Experiment, *arrays: Any, **options: Any) -> Any:
        numbers, not_numbers = eqx.partition((experiment, arrays), eqx.is_inexact_array)
        if not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(numbers)):
            return function(experiment, *arrays, **options)
        experiment, arrays = eqx.combine(_watch(numbers, functools.partial(_explain, experiment)), not_numbers)
        return function(experiment, *arrays, **options)

    return run  # type: ignore[return-value]


def _watch(numbers: Any, explain: Callable[[list[str]], str]) -> Any:
    """Return the numbers; where they are differentiated, `explain` gets the paths of those that have a tangent."""
    paths = [jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in jax.tree.leaves_with_path(numbers)]

    @jax.custom_jvp
    def same(leaves: list[Any]) -> list[Any]:
        return leaves

    def differentiate(primals: Any, tangents: Any) -> Any:
        zero = jax.custom_derivatives.SymbolicZero
        if reason := explain(
            [path for path, tangent in zip(paths, tangents[0], strict=True) if not isinstance(tangent, zero)]
        ):
            _warn(reason)
        return primals[0], tangents[0]

    same.defjvp(differentiate, symbolic_zeros=True)
    leaves, structure = jax.tree.flatten(numbers)
    return jax.tree.unflatten(structure, same(leaves))


def _explain(experiment: Experiment, paths: list[str]) -> str:
    """Say through what a derivative with respect to numbers at these paths means nothing; "" if it is sound.

    Paths begin with 0 in the experiment, and with another number in the state or the arrays.
    """
    keys = [path.split(".") for path in paths]
    keys = [key[1:] for key in keys if len(key) < 2 or key[1] not in _WITHOUT_MOTION]
    is_closed = experiment.controller is not None
    # another side's observer matters where a controller reads it
    for side in experiment.sides:
        elsewhere = {side} if is_closed else {*experiment.sides} - {side}
        reached = [key for key in keys if is_closed or key[:1] != ["observer"] or key[1] not in elsewhere]
        if reached and isinstance(getattr(experiment.observer, side), AbstractSuperTwisting):
            return f"the super-twisting observer of the {side}"
    fed_back = is_closed or any(path.startswith(("1", "2")) for path in paths)
    return "a gap or dry friction with noise fed back" if keys and fed_back and _is_rough(experiment) else ""


def _is_rough(experiment: Experiment) -> bool:
    """True if noise reaches a gap, or dry friction; a number that is not known as JAX traces counts as one above 0."""
    if _is_zero(experiment.encoders.noise):
        return False
    gap = experiment.transmission is not None and not _is_zero(experiment.transmission.half_gap)
    rough = AbstractEffect.dry_friction, AbstractEffect.free_play
    return gap or any((type(e).dry_friction, type(e).free_play) != rough for e in experiment.effects)


def _is_zero(number: Any) -> bool:
    return not isinstance(number, Tracer) and float(number) == 0.0


@functools.cache
def _warn(reason: str) -> None:
    logging.getLogger("jaxbl").warning(
        f"warning: a derivative through {reason} means nothing: the run amplifies it, where means over the noise do not "
        "change; compare runs, as jaxbl.tune does (docs/functions.md, Gradients)"
    )
