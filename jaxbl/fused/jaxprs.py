"""Rewriting of traced functions: calls opened, operations replaced, products joined with sums."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal, Var

_CALLS = ("jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call", "checkpoint")
"""Primitives that only call another jaxpr."""
Functions = Mapping[str, Callable[..., Any]]
"""By the name of the primitive that they replace."""


def flat(function: Callable[..., Any], *examples: Any) -> ClosedJaxpr:
    """Trace a function of pytrees, without calls inside."""
    return substituted(jax.make_jaxpr(function)(*examples), {})


def substituted(closed: ClosedJaxpr, functions: Functions) -> ClosedJaxpr:
    """The same without calls, and with functions in place of primitives of floating-point numbers, by their names."""
    leaves = [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in closed.in_avals]
    found = jax.make_jaxpr(partial(_inlined, closed, functions))(*leaves)
    # a function may itself call others
    return found if not any(_callee(eqn) for eqn in found.jaxpr.eqns) else substituted(found, functions)


class MultiplyAdd(Protocol):
    """`a * b + c` in one operation, product or rest with the other sign."""

    def __call__(self, a: Any, b: Any, c: Any, *, minus_product: bool, minus_rest: bool) -> Any: ...


def contracted(closed: ClosedJaxpr, multiply_add: MultiplyAdd) -> ClosedJaxpr:
    """The same with a product that one sum or difference alone reads joined with it."""
    jaxpr = closed.jaxpr
    reads = Counter(v for eqn in jaxpr.eqns for v in eqn.invars if isinstance(v, Var))
    reads.update(v for v in jaxpr.outvars if isinstance(v, Var))
    products: dict[Var, JaxprEqn] = {}
    joined: dict[Var, Var] = {}
    """Product by the sum that reads it."""
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        if name == "mul" and reads[eqn.outvars[0]] == 1 and str(eqn.outvars[0].aval.dtype) in ("float32", "float64"):
            products[eqn.outvars[0]] = eqn
        elif name in ("add", "add_any", "sub"):
            taken = next((v for v in eqn.invars if isinstance(v, Var) and v in products), None)
            if taken is not None:
                joined[eqn.outvars[0]] = taken
    inside = set(joined.values())

    def evaluated(*arguments: Any) -> list[Any]:
        env = _given(closed, arguments)
        for eqn in jaxpr.eqns:
            out = next(iter(eqn.outvars), None)
            if out in joined:
                a, b = (value_of(env, v) for v in products[joined[out]].invars)
                first = eqn.invars[0] is joined[out]
                c = value_of(env, eqn.invars[1 if first else 0])
                minus = eqn.primitive.name == "sub"
                env[out] = multiply_add(a, b, c, minus_product=minus and not first, minus_rest=minus and first)
            elif eqn.primitive.name == "scan":
                inner = contracted(eqn.params["jaxpr"], multiply_add)
                evaluate([eqn.replace(params=eqn.params | {"jaxpr": inner})], env)
            elif out not in inside:
                evaluate([eqn], env)
        return [value_of(env, v) for v in jaxpr.outvars]

    return jax.make_jaxpr(evaluated)(*(jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in closed.in_avals))


def _callee(eqn: JaxprEqn) -> ClosedJaxpr | None:
    """What an equation calls, if it does nothing else."""
    if eqn.primitive.name not in _CALLS:
        return None
    inner = eqn.params["jaxpr" if "jaxpr" in eqn.params else "call_jaxpr"]
    return inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())


def _inlined(closed: ClosedJaxpr, functions: Functions, *arguments: Any) -> list[Any]:
    jaxpr = closed.jaxpr
    env = _given(closed, arguments)
    for eqn in jaxpr.eqns:
        given = [value_of(env, v) for v in eqn.invars]
        called, name = _callee(eqn), eqn.primitive.name
        if called is not None:
            results = _inlined(called, functions, *given)
        elif name in functions and jnp.issubdtype(eqn.outvars[0].aval.dtype, jnp.floating):
            results = [functions[name](*given)]
        else:
            params = eqn.params
            if name == "scan":
                params = params | {"jaxpr": substituted(params["jaxpr"], functions)}
            results = eqn.primitive.bind(*given, **params)
            results = results if eqn.primitive.multiple_results else [results]
        env |= dict(zip(eqn.outvars, results, strict=True))
    return [value_of(env, v) for v in jaxpr.outvars]


def _given(closed: ClosedJaxpr, arguments: Sequence[Any]) -> dict[Var, Any]:
    """What the first equations read."""
    jaxpr = closed.jaxpr
    return dict(zip([*jaxpr.constvars, *jaxpr.invars], [*closed.consts, *arguments], strict=True))


def evaluate(eqns: Iterable[JaxprEqn], env: dict[Var, Any]) -> None:
    """Evaluate equations one after the other; `env` has what they read, and gets what they make."""
    for eqn in eqns:
        results = eqn.primitive.bind(*[value_of(env, v) for v in eqn.invars], **eqn.params)
        env |= dict(zip(eqn.outvars, results if eqn.primitive.multiple_results else [results], strict=True))


def value_of(env: dict[Var, Any], v: Var | Literal) -> Any:
    """A value of an equation."""
    return v.val if isinstance(v, Literal) else env[v]
