"""Compilation of programs that run only a few times, as those of identification and diagnosis do.

They compile for longer than they run: options under which XLA compiles fast are worth more here than its fastest code, and
where programs are kept (:mod:`jaxbl.fused.program_cache`) they are not even traced again. The engine of sweeps does not use
them.
"""

import functools
import math
import os
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.experimental.serialize_executable import deserialize_and_load, serialize

from . import program_cache

Result = TypeVar("Result")


_FAST = {"xla_cpu_use_fusion_emitters": False}
"""XLA's former emitters compile in half the time of today's (benchmarks/NOTES.md)."""
_LEAST = "jax_persistent_cache_min_compile_time_secs"
_MOST = 500
"""Programs that a process holds: of some 18 mappings each, a sixth of what the system allows."""


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
    def compile_function() -> Callable[..., Result]:
        # equinox hands what it does not know itself to `jax.jit`
        return eqx.filter_jit(function, compiler_options=_options())  # pyright: ignore[reportCallIssue]

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Result:
        leaves, structure = jax.tree.flatten((args, kwargs))
        if any(isinstance(leaf, Tracer) for leaf in leaves):
            return function(*args, **kwargs)
        if program_cache.cache_folder() is None:
            return compile_function()(*args, **kwargs)
        arrays = [_plain(leaf) for leaf in leaves if eqx.is_array(leaf)]
        shapes = map(_shape, arrays)
        examples = tuple(next(shapes) if eqx.is_array(leaf) else leaf for leaf in leaves)
        compiled, result = _program(function, structure, examples)
        outputs = iter(compiled(*arrays))
        return jax.tree.map(lambda leaf: next(outputs) if _is_shape(leaf) else leaf, result)

    return call


def _plain(leaf: Any) -> Any:
    """An array as a program takes it: of NumPy's as it is, if JAX has such numbers now, as to hand it over is a program."""
    if isinstance(leaf, jax.Array):
        return leaf
    leaf = np.asarray(leaf)
    return leaf if jax.dtypes.canonicalize_dtype(leaf.dtype) == leaf.dtype else jnp.asarray(leaf)


def _shape(array: Any) -> jax.ShapeDtypeStruct:
    """Make what stands in the place of an array. Of NumPy's none is weak."""
    is_weak = isinstance(array, jax.Array) and array.aval.weak_type
    return _make_shape(array.shape, array.dtype, weak_type=is_weak)


_make_shape = functools.lru_cache(jax.ShapeDtypeStruct)
"""Kept, as making one takes longer than to look it up."""


def _is_shape(leaf: Any) -> bool:
    return isinstance(leaf, jax.ShapeDtypeStruct)


@functools.cache
def _initialise() -> None:
    """JAX finds LAPACK's routines when it first lowers one; a program that calls them without crashes."""
    try:
        from jaxlib import lapack

        lapack._lapack.initialize()  # pyright: ignore[reportPrivateImportUsage]
    except (ImportError, AttributeError):  # of another version: by lowering one
        jax.jit(jnp.linalg.cholesky).lower(jnp.eye(2))


@functools.lru_cache(maxsize=_MOST)
def _program(function: Callable[..., Any], structure: Any, examples: tuple) -> tuple[Callable[..., list[jax.Array]], Any]:
    """A program of arrays, from disk, or compiled and put there; and what its result is made of.

    Args:
        function: that is compiled.
        structure, examples: of its arguments, as of the result, with shapes in the places of arrays.
    """
    args, kwargs = structure.unflatten(examples)
    shapes = [leaf for leaf in examples if _is_shape(leaf)]
    key = program_cache.program_key("program", function, args, kwargs)
    stored = program_cache.load(key)
    if stored is not None:
        _initialise()
        code, count, devices, result = stored
        inputs = jax.tree.structure((tuple(shapes), {}))
        try:
            loaded = deserialize_and_load(
                code, inputs, jax.tree.structure([0] * count), execution_devices=jax.local_devices()[:devices]
            )
            return loaded, result
        except Exception:  # whatever another version of JAX, or another machine, makes of it
            pass
    results = []

    def flat(*inputs: Any) -> list[Any]:
        arrays = iter(inputs)
        args, kwargs = structure.unflatten(next(arrays) if _is_shape(leaf) else leaf for leaf in examples)
        out = function(*args, **kwargs)
        results.append(jax.tree.map(lambda leaf: _shape(leaf) if eqx.is_array(leaf) else leaf, out))
        return [leaf for leaf in jax.tree.leaves(out) if eqx.is_array(leaf)]

    flat.__name__ = getattr(function, "__name__", "program")
    least = jax.config.values[_LEAST]
    if key is not None:
        # code that JAX took from its own cache cannot be written once more: a name of its own, and not put there
        flat.__name__ += f"_{os.getpid()}_{time.time_ns()}"
        jax.config.update(_LEAST, math.inf)
    try:
        compiled = jax.jit(flat, compiler_options=_options()).lower(*shapes).compile()
    finally:
        jax.config.update(_LEAST, least)
    shardings = jax.tree.leaves(compiled.output_shardings)
    if key is not None and shardings:
        with suppress(Exception):  # JAX cannot write it: it is compiled anew next time
            program_cache.save(key, (serialize(compiled)[0], len(shardings), len(shardings[0].device_set), results[-1]))
    return compiled, results[-1]
