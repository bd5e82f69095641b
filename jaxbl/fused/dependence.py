"""Split a traced function of one lane into what all lanes share and what each has to do by itself.

`vmap` leaves what no axis touches unbatched, and computes it once; so does this. A value is *fixed* if it depends on
neither lane nor time, *shared* if it depends on time alone, a *lane's* otherwise.
"""

import enum
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from . import Unsupported
from .jaxprs import ClosedJaxpr, JaxprEqn, Literal, Var, evaluate_equations, jaxpr_as_fun, read_variable, trace_inlined

NUMBERS = ("float32", "float64", "int32", "uint32", "int64", "bool")
"""Types that lanes may read."""


class Dependence(enum.IntFlag):
    """What a value depends on."""

    FIXED = 0
    SHARED = 1
    LANE = 2


class LaneSplit(NamedTuple):
    """A function `f(values, carry, given) -> results` of one lane in two parts, and which results are the lanes'.

    `shared`: its part of the carry, `given` -> its results, and what the lanes' part reads of it.
    `lane`: values, its part of the carry, what it reads -> its results. Fixed numbers stand in it, for compilers to see.
    """

    shared: Callable[[Sequence[Any], Any], tuple[list[Any], list[Any]]]
    lane: ClosedJaxpr
    of_lane: list[bool]


class LoopHooks(NamedTuple):
    """What is done around the loop over a block of samples, jaxprs of scalars of one lane: before the first block (values ->
    carry), after each (values, carry, inputs -> carry, and marks that are kept of each block), and to finish (values, carry,
    inputs -> results)."""

    before: ClosedJaxpr
    after: ClosedJaxpr
    finish: ClosedJaxpr


def carry_dependences(
    start: Callable[..., Any], functions: Iterable[tuple[Callable[..., Any], Any]], values: Any
) -> list[Dependence]:
    """Kinds of the leaves of a carry that `start(values)` begins and `functions`, each with an example of what it is given,
    take further: `f(values, carry, given)`."""
    made = trace_inlined(start, values)
    kinds = _kinds(made.jaxpr, [Dependence.LANE] * len(made.jaxpr.invars))
    found = [_kind(kinds, out) for out in made.jaxpr.outvars]
    count = len(jax.tree.leaves(values))
    example = jax.eval_shape(start, values)
    traced = [(trace_inlined(f, values, example, given), len(jax.tree.leaves(given))) for f, given in functions]
    while True:
        before = list(found)
        for closed, shared in traced:
            jaxpr = closed.jaxpr
            kinds = _kinds(jaxpr, [Dependence.LANE] * count + found + [Dependence.SHARED] * shared)
            for i, (old, new) in enumerate(zip(jaxpr.invars[count:], jaxpr.outvars, strict=False)):
                if new is not old:
                    found[i] |= _kind(kinds, new) | Dependence.SHARED
        if found == before:
            return [Dependence.LANE if kind & Dependence.LANE else Dependence.SHARED for kind in found]


def split_by_lane(
    function: Callable[..., Any],
    values: Any,
    carry: Any,
    given: Any,
    kinds: Sequence[Dependence],
    results: Sequence[Dependence] | None = None,
) -> LaneSplit:
    """The two parts of a function of one lane, from examples of its arguments and the kinds of the carry's leaves.

    `results` are the kinds that the results are to have; left out, those that they come to have. `Unsupported` where lanes
    read something that is no number: an array, or the state of a random number generator.
    """
    closed = trace_inlined(function, values, carry, given)
    jaxpr = closed.jaxpr
    count = len(jax.tree.leaves(values))
    carried, rest = jaxpr.invars[count : count + len(kinds)], jaxpr.invars[count + len(kinds) :]
    carried_by_lane = [kind == Dependence.LANE for kind in kinds]
    known = _kinds(jaxpr, [Dependence.LANE] * count + list(kinds) + [Dependence.SHARED] * len(rest))
    live = _live(jaxpr)
    lanes = [eqn for eqn in live if any(known[out] & Dependence.LANE for out in eqn.outvars)]
    others = [eqn for eqn in live if not any(known[out] & Dependence.LANE for out in eqn.outvars)]
    constants = dict(zip(jaxpr.constvars, closed.consts, strict=True))

    of_lane = [bool(kind & Dependence.LANE) for kind in results or [_kind(known, out) for out in jaxpr.outvars]]
    own = [out for out, lane in zip(jaxpr.outvars, of_lane, strict=True) if lane]
    read = dict.fromkeys(v for eqn in lanes for v in eqn.invars if isinstance(v, Var))
    read |= dict.fromkeys(v for v in own if isinstance(v, Var))
    outside = [v for v in read if not known[v] & Dependence.LANE]
    fixed = [v for v in outside if known[v] == Dependence.FIXED]
    crossing = [v for v in outside if known[v] == Dependence.SHARED]
    lane_in = [*jaxpr.invars[:count], *(v for v, lane in zip(carried, carried_by_lane, strict=True) if lane)]
    shared_in = [v for v, lane in zip(carried, carried_by_lane, strict=True) if not lane]

    def shared(state: Sequence[Any], given: Any) -> tuple[list[Any], list[Any]]:
        env = constants | dict(zip(shared_in, state, strict=True))
        env |= dict(zip(rest, jax.tree.leaves(given), strict=True))
        evaluate_equations(others, env)
        new = [read_variable(env, out) for out, lane in zip(jaxpr.outvars, of_lane, strict=True) if not lane]
        return new, [env[v] for v in crossing]

    def once() -> list[Any]:
        env = dict(constants)
        evaluate_equations([eqn for eqn in others if all(known[out] == Dependence.FIXED for out in eqn.outvars)], env)
        return [env[v] for v in fixed]

    for v in [*lane_in, *fixed, *crossing]:
        if v.aval.shape or str(v.aval.dtype) not in NUMBERS:
            raise Unsupported(f"lanes that read {v.aval.dtype}{list(v.aval.shape) or ''}")
    numbers = [np.asarray(value)[()] for value in (jax.jit(once)() if fixed else [])]

    def lane(*arguments: Any) -> list[Any]:
        env = dict(zip([*fixed, *lane_in, *crossing], [*numbers, *arguments], strict=True))
        evaluate_equations(lanes, env)
        return [read_variable(env, out) for out in own]

    examples = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in [*lane_in, *crossing]]
    return LaneSplit(shared, jax.make_jaxpr(lane)(*examples), of_lane)


class StateSplit(NamedTuple):
    """A function `f(state, given) -> (state, handed)` of one sample in two parts.

    `direct` says of each number handed over whether it needs no state. `ahead`: `given` -> these, and what `step` reads.
    `step`: state, what it reads -> state, and the rest of what is handed over.
    """

    direct: list[bool]
    ahead: Callable[[Any], tuple[list[Any], list[Any]]]
    step: ClosedJaxpr


def split_by_state(function: Callable[..., tuple[list[Any], list[Any]]], state: Sequence[Any], given: Any) -> StateSplit:
    """What needs the state of the sample before, and what may be computed for all samples at once. `Unsupported` where the
    former reads something that is no number."""
    count = len(state)
    jaxpr = trace_inlined(function, list(state), given).jaxpr
    known = _kinds(jaxpr, [Dependence.LANE] * count + [Dependence.SHARED] * (len(jaxpr.invars) - count))
    direct = [not _kind(known, out) & Dependence.LANE for out in jaxpr.outvars[count:]]
    kinds = [Dependence.LANE] * count + [Dependence.SHARED if one else Dependence.LANE for one in direct]

    def joined(values: Any, carry: list[Any], given: Any) -> list[Any]:
        new, handed = function(carry[:count], given)
        return [*new, *handed]

    # what is handed over stands among the carry, which nothing reads it from
    spare = [jax.ShapeDtypeStruct(out.aval.shape, out.aval.dtype) for out in jaxpr.outvars[count:]]
    parts = split_by_lane(joined, [], [*state, *spare], given, kinds, kinds)
    unread = [jnp.zeros(one.shape, one.dtype) for one, alone in zip(spare, direct, strict=True) if not alone]

    def step(state: list[Any], read: list[Any]) -> list[Any]:
        return jaxpr_as_fun(parts.lane)(*state, *unread, *read)

    read = parts.lane.jaxpr.invars[count + len(unread) :]
    examples = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in read]
    return StateSplit(direct, partial(parts.shared, [None] * sum(direct)), trace_inlined(step, list(state), examples))


def _kind(kinds: dict[Var, Dependence], v: Var | Literal) -> Dependence:
    return Dependence.FIXED if isinstance(v, Literal) else kinds[v]


def _kinds(jaxpr: Any, given: Sequence[Dependence]) -> dict[Var, Dependence]:
    kinds = dict.fromkeys(jaxpr.constvars, Dependence.FIXED) | dict(zip(jaxpr.invars, given, strict=True))
    for eqn in jaxpr.eqns:
        kind = Dependence.FIXED
        for v in eqn.invars:
            kind |= _kind(kinds, v)
        kinds |= dict.fromkeys(eqn.outvars, Dependence.LANE if kind & Dependence.LANE else kind)
    return kinds


def _live(jaxpr: Any) -> list[JaxprEqn]:
    """Equations that an output needs."""
    needed = {v for v in jaxpr.outvars if isinstance(v, Var)}
    kept = []
    for eqn in reversed(jaxpr.eqns):
        if any(out in needed for out in eqn.outvars):
            kept.append(eqn)
            needed |= {v for v in eqn.invars if isinstance(v, Var)}
    return kept[::-1]
