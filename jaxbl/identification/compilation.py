"""Compilation of programs that run only a few times, as those of identification and diagnosis do.

They compile for longer than they run: options under which XLA compiles fast are worth more here than its fastest code.
The engine of sweeps does not use them.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
from jax.core import Tracer

Result = TypeVar("Result")


_FAST = {"xla_cpu_use_fusion_emitters": False}
"""XLA's former emitters compile in half the time of today's (benchmarks/NOTES.md)."""


@functools.cache
def _options() -> dict[str, bool]:
    """The fast options where JAX has them (0.12 has not), else none."""
    try:
        jax.jit(lambda x: x + 1.0, compiler_options=_FAST)(0.0)
    except jax.errors.JaxRuntimeError:
        return {}
    return _FAST


def jit(function: Callable[..., Result]) -> Callable[..., Result]:
    """`equinox.filter_jit` that compiles fast. Inside `jax.jit`, `vmap` or a derivative it is the function as it is: call
    these from within a compiled function."""

    @functools.cache
    def compiled() -> Callable[..., Result]:
        # equinox hands what it does not know itself to `jax.jit`
        return eqx.filter_jit(function, compiler_options=_options())  # pyright: ignore[reportCallIssue]

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Result:
        inside = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((args, kwargs)))
        return (function if inside else compiled())(*args, **kwargs)

    return call
