"""Reading and rewriting of traced functions: calls opened, operations replaced, products joined with sums.

JAX's versions write jaxprs differently. What differs is read here alone: other modules take its types, and the parameters
of equations, from here.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import PurePath
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import JaxprEqn, Literal, Var
from jax.extend.core import jaxpr_as_fun as jaxpr_as_fun

ClosedJaxpr = Any
"""What `jax.make_jaxpr` gives: constants and a jaxpr until JAX 0.10, a jaxpr with them inside from 0.11 on."""
_CALLS = ("jit", "closed_call", "custom_jvp_call", "custom_vjp_call")
"""Primitives that only call another jaxpr."""


class UnknownForm(Exception):
    """JAX writes an equation in a way that is not known here."""


def trace_inlined(function: Callable[..., Any], *examples: Any) -> ClosedJaxpr:
    """Trace a function of pytrees, without calls inside."""
    return replace_primitives(jax.make_jaxpr(function)(*examples), {})


def replace_primitives(closed: ClosedJaxpr, functions: Mapping[str, Callable[..., Any]]) -> ClosedJaxpr:
    """The same without calls, and with functions in place of primitives of floating-point numbers, by their names."""
    leaves = [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in closed.in_avals]
    found = jax.make_jaxpr(partial(_inlined, closed, functions))(*leaves)
    # a function may itself call others
    return found if not any(callee(eqn) for eqn in found.jaxpr.eqns) else replace_primitives(found, functions)


def join_multiply_add(closed: ClosedJaxpr, multiply_add: Callable[..., Any]) -> ClosedJaxpr:
    """The same with a product that one sum or difference alone reads joined with it.

    `multiply_add(a, b, c, minus_product=..., minus_rest=...)` is a * b + c, the product or the rest with the other sign.
    """
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
                a, b = (read_variable(env, v) for v in products[joined[out]].invars)
                first = eqn.invars[0] is joined[out]
                c = read_variable(env, eqn.invars[1 if first else 0])
                minus = eqn.primitive.name == "sub"
                env[out] = multiply_add(a, b, c, minus_product=minus and not first, minus_rest=minus and first)
            elif out not in inside:
                evaluate_equations([eqn], env, lambda body: join_multiply_add(body, multiply_add))
        return [read_variable(env, v) for v in jaxpr.outvars]

    return jax.make_jaxpr(evaluated)(*(jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in closed.in_avals))


def trace(function: Callable[..., Any], *examples: Any) -> ClosedJaxpr:
    """Trace a function of pytrees; calls inside stay calls, which takes half the time of opening them."""
    return jax.make_jaxpr(function)(*examples)


@lru_cache(maxsize=64)
def trace_scalar_function(function: Callable[[Any], Any], dtype: Any) -> ClosedJaxpr:
    """The same of a function of one number, once."""
    return trace(function, jax.ShapeDtypeStruct((), dtype))


def callee(eqn: JaxprEqn) -> ClosedJaxpr | None:
    """What an equation calls, if it does nothing else."""
    return equation_parameter(eqn, "jaxpr", "call_jaxpr") if eqn.primitive.name in _CALLS else None


def equation_parameter(eqn: JaxprEqn, *names: str) -> Any:
    """Of an equation, by the first of these names that it has."""
    for name in names:
        if name in eqn.params:
            return eqn.params[name]
    raise UnknownForm(f"{eqn.primitive.name} without {' or '.join(names)}")


def scan_parameters(eqn: JaxprEqn) -> tuple[int, ClosedJaxpr, int]:
    """Of a scan of scalars: how often it does what, and how many of those that it reads stay the same.

    What a scan reads or writes once a step has an axis outside; scalars alone are fixed or carried. So nothing depends on
    how JAX counts them, which is not the same in 0.10 and 0.11.
    """
    body, fixed = equation_parameter(eqn, "jaxpr"), len(eqn.invars) - len(eqn.outvars)
    if fixed < 0 or (len(body.in_avals), len(body.out_avals)) != (len(eqn.invars), len(eqn.outvars)):
        raise UnknownForm("scan that reads or makes others than its body")
    return equation_parameter(eqn, "length"), body, fixed


def cond_branches(eqn: JaxprEqn) -> Sequence[ClosedJaxpr]:
    """Of a choice (`jax.lax.cond`), what it does where its index is 0, 1, ..."""
    return equation_parameter(eqn, "branches")


def equation_source(eqn: JaxprEqn) -> str:
    """File and function of the package that asked for an equation, such as `observer/recursive.py: step`; "" where JAX does
    not say. Functions of the drive and the export itself only pass it on."""
    frames = getattr(getattr(eqn.source_info, "traceback", None), "frames", ())
    for frame in frames:
        if inside := _inside(frame.file_name):
            return f"{inside}: {frame.function_name}"
    return ""


@lru_cache(1024)
def _inside(file: str) -> str:
    """A file's path in the package; "" for one of others. Asked for each frame of each equation, of which there are few."""
    where = PurePath(file).parts
    return "/".join(where[len(where) - where[::-1].index("jaxbl") :]) if "jaxbl" in where else ""


def _inlined(closed: ClosedJaxpr, functions: Mapping[str, Callable[..., Any]], *arguments: Any) -> list[Any]:
    jaxpr = closed.jaxpr
    env = _given(closed, arguments)
    for eqn in jaxpr.eqns:
        given = [read_variable(env, v) for v in eqn.invars]
        called, name = callee(eqn), eqn.primitive.name
        if called is not None:
            env |= dict(zip(eqn.outvars, _inlined(called, functions, *given), strict=True))
        elif name in functions and jnp.issubdtype(eqn.outvars[0].aval.dtype, jnp.floating):
            env[eqn.outvars[0]] = functions[name](*given)
        else:
            evaluate_equations([eqn], env, lambda body: replace_primitives(body, functions))
    return [read_variable(env, v) for v in jaxpr.outvars]


def _given(closed: ClosedJaxpr, arguments: Sequence[Any]) -> dict[Var, Any]:
    """What the first equations read."""
    return dict(zip([*closed.jaxpr.constvars, *closed.jaxpr.invars], [*closed.consts, *arguments], strict=True))


def evaluate_equations(
    eqns: Iterable[JaxprEqn], env: dict[Var, Any], rewritten: Callable[[ClosedJaxpr], ClosedJaxpr] | None = None
) -> None:
    """Evaluate equations one after the other; `env` has what they read, and gets what they make.

    `rewritten` is what scans do in place of what they did.
    """
    for eqn in eqns:
        params = eqn.params
        if rewritten is not None and eqn.primitive.name == "scan":
            params = params | {"jaxpr": rewritten(equation_parameter(eqn, "jaxpr"))}
        results = eqn.primitive.bind(*[read_variable(env, v) for v in eqn.invars], **params)
        env |= dict(zip(eqn.outvars, results if eqn.primitive.multiple_results else [results], strict=True))


def read_variable(env: dict[Var, Any], v: Var | Literal) -> Any:
    """A value of an equation."""
    return v.val if isinstance(v, Literal) else env[v]
