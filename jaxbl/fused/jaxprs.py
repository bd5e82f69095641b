"""Reading and rewriting of traced functions: calls inlined, primitives replaced, products joined with sums.

JAX's versions write jaxprs differently. Only this module reads what differs: other modules take its types, and the
parameters of equations, from here.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import PurePath
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import JaxprEqn, Literal, Var, jaxpr_as_fun as jaxpr_as_fun

from . import Leaves

ClosedJaxpr = Any
"""What `jax.make_jaxpr` returns: constants and a jaxpr until JAX 0.10, a jaxpr with them inside from 0.11 on."""
_CALLS = ("jit", "closed_call", "custom_jvp_call", "custom_vjp_call")
"""Primitives that only call another jaxpr."""


class UnknownForm(Exception):
    """JAX writes an equation in a way that is not known here."""


def trace_inlined(function: Callable[..., Any], *examples: Any) -> ClosedJaxpr:
    """Trace a function of pytrees, and inline its calls."""
    return replace_primitives(jax.make_jaxpr(function)(*examples), {})


@lru_cache(maxsize=64)
def trace_scalar_function(function: Callable[[Any], Any], dtype: Any) -> ClosedJaxpr:
    """Trace a function of one number, once for each type."""
    return jax.make_jaxpr(function)(jax.ShapeDtypeStruct((), dtype))


def replace_primitives(closed: ClosedJaxpr, functions: Mapping[str, Callable[..., Any]]) -> ClosedJaxpr:
    """Inline the calls of a jaxpr, and put functions in place of primitives of floating-point numbers, by their names."""
    leaves = [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in closed.in_avals]
    replaced = jax.make_jaxpr(partial(_evaluate_replaced, closed, functions))(*leaves)
    # a function may itself call others
    has_calls = any(callee(eqn) for eqn in replaced.jaxpr.eqns)
    return replace_primitives(replaced, functions) if has_calls else replaced


def join_multiply_add(closed: ClosedJaxpr, multiply_add: Callable[..., Any]) -> ClosedJaxpr:
    """Join each product that is read only once, by a sum or difference, with that sum.

    Args:
        closed: the jaxpr.
        multiply_add: `multiply_add(a, b, c, minus_product=..., minus_rest=...)` is a b + c, with the other sign of a b or c
            where that is true.
    """
    jaxpr = closed.jaxpr
    reads = Counter(v for eqn in jaxpr.eqns for v in eqn.invars if isinstance(v, Var))
    reads.update(v for v in jaxpr.outvars if isinstance(v, Var))
    products: dict[Var, JaxprEqn] = {}
    product_of_sum: dict[Var, Var] = {}
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        if name == "mul" and reads[eqn.outvars[0]] == 1 and str(eqn.outvars[0].aval.dtype) in ("float32", "float64"):
            products[eqn.outvars[0]] = eqn
        elif name in ("add", "add_any", "sub"):
            product = next((v for v in eqn.invars if isinstance(v, Var) and v in products), None)
            if product is not None:
                product_of_sum[eqn.outvars[0]] = product
    joined = set(product_of_sum.values())

    def evaluate_joined(*arguments: Any) -> Leaves:
        env = _bind_arguments(closed, arguments)
        for eqn in jaxpr.eqns:
            out = next(iter(eqn.outvars), None)
            if out in product_of_sum:
                product = product_of_sum[out]
                a, b = (read_variable(env, v) for v in products[product].invars)
                is_first = eqn.invars[0] is product
                c = read_variable(env, eqn.invars[1 if is_first else 0])
                is_difference = eqn.primitive.name == "sub"
                minus_product, minus_rest = is_difference and not is_first, is_difference and is_first
                env[out] = multiply_add(a, b, c, minus_product=minus_product, minus_rest=minus_rest)
            elif out not in joined:
                evaluate_equations([eqn], env, lambda body: join_multiply_add(body, multiply_add))
        return [read_variable(env, v) for v in jaxpr.outvars]

    examples = (jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in closed.in_avals)
    return jax.make_jaxpr(evaluate_joined)(*examples)


def callee(eqn: JaxprEqn) -> ClosedJaxpr | None:
    """The jaxpr that an equation calls; None if the equation is no call."""
    return equation_parameter(eqn, "jaxpr", "call_jaxpr") if eqn.primitive.name in _CALLS else None


def equation_parameter(eqn: JaxprEqn, *names: str) -> Any:
    """The first parameter of an equation that it has among these names."""
    for name in names:
        if name in eqn.params:
            return eqn.params[name]
    raise UnknownForm(f"{eqn.primitive.name} without {' or '.join(names)}")


def scan_parameters(eqn: JaxprEqn) -> tuple[int, ClosedJaxpr, int]:
    """Length and body of a scan of scalars, and the number of its first arguments that stay the same.

    An input or output of each step has an axis outside of the body, so that scalars are constants or carried. So nothing
    depends on how JAX counts them, which is not the same in 0.10 and 0.11.
    """
    body, constants = equation_parameter(eqn, "jaxpr"), len(eqn.invars) - len(eqn.outvars)
    if constants < 0 or (len(body.in_avals), len(body.out_avals)) != (len(eqn.invars), len(eqn.outvars)):
        raise UnknownForm("scan that reads or makes others than its body")
    return equation_parameter(eqn, "length"), body, constants


def cond_branches(eqn: JaxprEqn) -> Sequence[ClosedJaxpr]:
    """The branches of a `jax.lax.cond`, by its index 0, 1, ..."""
    return equation_parameter(eqn, "branches")


def equation_source(eqn: JaxprEqn) -> str:
    """The file and function of the package that asked for an equation, such as `observer/recursive.py: step`.

    "" where JAX does not say. Functions of the drive and the export itself only pass equations on.
    """
    frames = getattr(getattr(eqn.source_info, "traceback", None), "frames", ())
    for frame in frames:
        if path := _path_in_package(frame.file_name):
            return f"{path}: {frame.function_name}"
    return ""


@lru_cache(1024)
def _path_in_package(file: str) -> str:
    """A file's path in the package, "" outside; cached, as each frame of each equation asks for one of few files."""
    parts = PurePath(file).parts
    return "/".join(parts[len(parts) - parts[::-1].index("jaxbl") :]) if "jaxbl" in parts else ""


def _evaluate_replaced(closed: ClosedJaxpr, functions: Mapping[str, Callable[..., Any]], *arguments: Any) -> Leaves:
    jaxpr = closed.jaxpr
    env = _bind_arguments(closed, arguments)
    for eqn in jaxpr.eqns:
        operands = [read_variable(env, v) for v in eqn.invars]
        called, name = callee(eqn), eqn.primitive.name
        if called is not None:
            env |= dict(zip(eqn.outvars, _evaluate_replaced(called, functions, *operands), strict=True))
        elif name in functions and jnp.issubdtype(eqn.outvars[0].aval.dtype, jnp.floating):
            env[eqn.outvars[0]] = functions[name](*operands)
        else:
            evaluate_equations([eqn], env, lambda body: replace_primitives(body, functions))
    return [read_variable(env, v) for v in jaxpr.outvars]


def _bind_arguments(closed: ClosedJaxpr, arguments: Sequence[Any]) -> dict[Var, Any]:
    """Constants and arguments by the variables of a jaxpr."""
    return dict(zip([*closed.jaxpr.constvars, *closed.jaxpr.invars], [*closed.consts, *arguments], strict=True))


def evaluate_equations(
    eqns: Iterable[JaxprEqn], env: dict[Var, Any], rewrite_body: Callable[[ClosedJaxpr], ClosedJaxpr] | None = None
) -> None:
    """Evaluate equations one after the other.

    Args:
        eqns: the equations.
        env: what they read, by variable; what they make is added.
        rewrite_body: changes the bodies of scans.
    """
    for eqn in eqns:
        params = eqn.params
        if rewrite_body is not None and eqn.primitive.name == "scan":
            params = params | {"jaxpr": rewrite_body(equation_parameter(eqn, "jaxpr"))}
        results = eqn.primitive.bind(*[read_variable(env, v) for v in eqn.invars], **params)
        env |= dict(zip(eqn.outvars, results if eqn.primitive.multiple_results else [results], strict=True))


def read_variable(env: dict[Var, Any], v: Var | Literal) -> Any:
    """The number of a variable or literal."""
    return v.val if isinstance(v, Literal) else env[v]
