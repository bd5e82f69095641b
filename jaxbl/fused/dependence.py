"""Split a traced function by what its values depend on: the lane, time, and the state of the sample before.

`vmap` leaves what no axis touches unbatched, and computes it once; so does this. A value is *fixed* if it depends on
neither lane nor time, *shared* if it depends on time alone, and a *lane's* otherwise.
"""

import enum
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from . import Leaves, Unsupported
from .jaxprs import ClosedJaxpr, JaxprEqn, Literal, Var, evaluate_equations, read_variable, trace_inlined

LANE_DTYPES = ("float32", "float64", "int32", "uint32", "int64", "bool")
"""Types of numbers that lanes may read."""


class Dependence(enum.IntFlag):
    """The kind of a value, by what it depends on."""

    FIXED = 0
    SHARED = 1
    LANE = 2


class LaneSplit(NamedTuple):
    """A function `f(values, carry, inputs) -> results` of one lane in two parts.

    Attributes:
        shared: takes its part of the carry and `inputs`; returns its results, and what the lanes' part reads of it.
        lane: takes values, its part of the carry, and what it reads; returns its results. Fixed numbers stand in it as
            literals, for compilers to see.
        is_lane_result: for each result, True if the lanes' part makes it.
    """

    shared: Callable[[Sequence[Any], Any], tuple[Leaves, Leaves]]
    lane: ClosedJaxpr
    is_lane_result: list[bool]


class LoopHooks(NamedTuple):
    """Jaxprs of scalars of one lane that run around the loop over the samples of a block; None: nothing runs there.

    Attributes:
        start: before the first block, values -> carry.
        after_block: after each block, values, carry, inputs -> carry, and flags that are stored for each block.
        finish: after the last block, values, carry, inputs -> results.
    """

    start: ClosedJaxpr = None
    after_block: ClosedJaxpr = None
    finish: ClosedJaxpr = None


NO_HOOKS = LoopHooks()
EXTENTS = {
    "values": "lanes", "carry": "lanes", "constants": "scalar", "sample_inputs": "samples",
    "lane_inputs": "samples and lanes", "block_inputs": "blocks", "final_inputs": "scalar",
    "outputs": "samples and lanes", "flags": "blocks and lanes", "results": "lanes",
}  # fmt: skip
"""Groups of a loop's arrays in their order, and what each of their arrays has a number for."""


def find_carry_dependences(
    start: Callable[..., Any], functions: Iterable[tuple[Callable[..., Any], Any]], values: Any
) -> list[Dependence]:
    """Find what each leaf of a carry depends on.

    Args:
        start: makes the carry from a lane's values.
        functions: `f(values, carry, inputs)` that take the carry further, each with an example of its inputs.
        values: an example of a lane's values.

    Returns:
        `SHARED` or `LANE` for each leaf of the carry.
    """
    start_jaxpr = trace_inlined(start, values).jaxpr
    dependences = _propagate_dependences(start_jaxpr, [Dependence.LANE] * len(start_jaxpr.invars))
    carried = [_read_dependence(dependences, out) for out in start_jaxpr.outvars]
    count = len(jax.tree.leaves(values))
    example = jax.eval_shape(start, values)
    traced = [(trace_inlined(f, values, example, inputs), len(jax.tree.leaves(inputs))) for f, inputs in functions]
    while True:
        before = list(carried)
        for closed, input_count in traced:
            jaxpr = closed.jaxpr
            arguments = [Dependence.LANE] * count + carried + [Dependence.SHARED] * input_count
            dependences = _propagate_dependences(jaxpr, arguments)
            for i, (old, new) in enumerate(zip(jaxpr.invars[count:], jaxpr.outvars, strict=False)):
                if new is not old:
                    carried[i] |= _read_dependence(dependences, new) | Dependence.SHARED
        if carried == before:
            return [Dependence.LANE if leaf & Dependence.LANE else Dependence.SHARED for leaf in carried]


def split_by_lane(
    function: Callable[..., Any],
    values: Any,
    carry: Any,
    inputs: Any,
    carry_dependences: Sequence[Dependence],
    result_dependences: Sequence[Dependence] = (),
) -> LaneSplit:
    """Split a function `f(values, carry, inputs)` of one lane into what all lanes share and what each lane does.

    Args:
        function: to be split.
        values, carry, inputs: examples of its arguments.
        carry_dependences: of the carry's leaves.
        result_dependences: that the first results are to have; the others have those that follow.

    Raises:
        Unsupported: lanes read something that is no number: an array, or the state of a random number generator.
    """
    closed = trace_inlined(function, values, carry, inputs)
    jaxpr = closed.jaxpr
    count = len(jax.tree.leaves(values))
    carry_end = count + len(carry_dependences)
    carry_vars, input_vars = jaxpr.invars[count:carry_end], jaxpr.invars[carry_end:]
    is_lane_carry = [dependence == Dependence.LANE for dependence in carry_dependences]
    arguments = [Dependence.LANE] * count + list(carry_dependences) + [Dependence.SHARED] * len(input_vars)
    dependences = _propagate_dependences(jaxpr, arguments)
    live = _live_equations(jaxpr)
    lane_equations = [eqn for eqn in live if any(dependences[out] & Dependence.LANE for out in eqn.outvars)]
    shared_equations = [eqn for eqn in live if not any(dependences[out] & Dependence.LANE for out in eqn.outvars)]
    constants = dict(zip(jaxpr.constvars, closed.consts, strict=True))

    following = [_read_dependence(dependences, out) for out in jaxpr.outvars[len(result_dependences) :]]
    is_lane_result = [bool(dependence & Dependence.LANE) for dependence in (*result_dependences, *following)]
    lane_results = [out for out, is_lane in zip(jaxpr.outvars, is_lane_result, strict=True) if is_lane]
    read = dict.fromkeys(v for eqn in lane_equations for v in eqn.invars if isinstance(v, Var))
    read |= dict.fromkeys(v for v in lane_results if isinstance(v, Var))
    from_outside = [v for v in read if not dependences[v] & Dependence.LANE]
    fixed = [v for v in from_outside if dependences[v] == Dependence.FIXED]
    handed_over = [v for v in from_outside if dependences[v] == Dependence.SHARED]
    lane_vars = [*jaxpr.invars[:count], *(v for v, is_lane in zip(carry_vars, is_lane_carry, strict=True) if is_lane)]
    shared_vars = [v for v, is_lane in zip(carry_vars, is_lane_carry, strict=True) if not is_lane]

    def compute_shared(state: Sequence[Any], inputs: Any) -> tuple[Leaves, Leaves]:
        env = constants | dict(zip(shared_vars, state, strict=True))
        env |= dict(zip(input_vars, jax.tree.leaves(inputs), strict=True))
        evaluate_equations(shared_equations, env)
        results = [
            read_variable(env, out) for out, is_lane in zip(jaxpr.outvars, is_lane_result, strict=True) if not is_lane
        ]
        return results, [env[v] for v in handed_over]

    def compute_fixed() -> Leaves:
        env = dict(constants)
        fixed_equations = [
            eqn for eqn in shared_equations if all(dependences[out] == Dependence.FIXED for out in eqn.outvars)
        ]
        evaluate_equations(fixed_equations, env)
        return [env[v] for v in fixed]

    for v in [*lane_vars, *fixed, *handed_over]:
        if v.aval.shape or str(v.aval.dtype) not in LANE_DTYPES:
            raise Unsupported(f"lanes that read {v.aval.dtype}{list(v.aval.shape) or ''}")
    fixed_numbers = [np.asarray(number)[()] for number in (jax.jit(compute_fixed)() if fixed else [])]

    def compute_lane(*arguments: Any) -> Leaves:
        env = dict(zip([*fixed, *lane_vars, *handed_over], [*fixed_numbers, *arguments], strict=True))
        evaluate_equations(lane_equations, env)
        return [read_variable(env, out) for out in lane_results]

    examples = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in [*lane_vars, *handed_over]]
    return LaneSplit(compute_shared, jax.make_jaxpr(compute_lane)(*examples), is_lane_result)


def _read_dependence(dependences: dict[Var, Dependence], v: Var | Literal) -> Dependence:
    return Dependence.FIXED if isinstance(v, Literal) else dependences[v]


def _propagate_dependences(jaxpr: Any, arguments: Sequence[Dependence]) -> dict[Var, Dependence]:
    """Dependence of every variable, from those of the arguments."""
    dependences = dict.fromkeys(jaxpr.constvars, Dependence.FIXED) | dict(zip(jaxpr.invars, arguments, strict=True))
    for eqn in jaxpr.eqns:
        dependence = Dependence.FIXED
        for v in eqn.invars:
            dependence |= _read_dependence(dependences, v)
        dependence = Dependence.LANE if dependence & Dependence.LANE else dependence
        dependences |= dict.fromkeys(eqn.outvars, dependence)
    return dependences


def _live_equations(jaxpr: Any) -> list[JaxprEqn]:
    """The equations that an output needs, in their order."""
    needed = {v for v in jaxpr.outvars if isinstance(v, Var)}
    live = []
    for eqn in reversed(jaxpr.eqns):
        if any(out in needed for out in eqn.outvars):
            live.append(eqn)
            needed |= {v for v in eqn.invars if isinstance(v, Var)}
    return live[::-1]
