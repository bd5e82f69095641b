"""Functions of a sample's scalars, taken along a signal by a loop for this machine's processor: one loop for all lengths."""

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from . import Unsupported, program_cache, raising_unsupported, warn_of_scan

SampleFunction = Callable[[list[Any], list[Any], list[Any]], tuple[list[Any], list[Any]]]
"""From numbers that stay the same, what is carried and a sample's inputs, to what is carried on and what is kept."""
_NUMBER = jax.ShapeDtypeStruct((), np.dtype(float))


def scan_signal(
    sample: SampleFunction, values: Sequence[np.ndarray], carry: Sequence[np.ndarray], inputs: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """What a function of a module keeps along a signal, each of shape (samples, lanes); by XLA where it
    cannot be compiled otherwise.

    Args:
        sample: the function.
        values, carry: of each lane, shape (lanes,); the same number of all, or one.
        inputs: of each sample, shape (samples,), or of each sample and lane, shape (samples, lanes).
    """
    lanes, samples = len(carry[0]), len(inputs[0])
    inputs = [one[:, 0] if lanes == 1 and one.ndim == 2 else one for one in map(np.asarray, inputs)]
    loop = _loop(sample, len(values), len(carry), len(inputs), lanes == 1, inputs[0].ndim == 2)
    if loop is None:
        with jax.enable_x64(True):
            given = [[jnp.asarray(one, float) for one in some] for some in (values, carry, inputs)]
            return [np.asarray(one) for one in _scanned(sample, *given)]
    whole = -(-lanes // loop.lanes) * loop.lanes
    given = [np.pad(np.asarray(one, float), (0, whole - lanes), "edge") for one in (*values, *carry)]
    along = [
        np.ascontiguousarray(one if one.ndim == 1 else np.pad(one, ((0, 0), (0, whole - lanes))), float) for one in inputs
    ]
    found = [np.empty((samples, whole)) for one in loop.signature if one.name.startswith("kept")]
    loop([*given, *(np.ascontiguousarray(one, float) for one in along), *found], samples, 0, whole)
    return [one[:, :lanes] for one in found]


@lru_cache(maxsize=64)
def _loop(sample: SampleFunction, values: int, carry: int, inputs: int, alone: bool, own: bool) -> Any:
    """`alone`: for one lane; `own`: each lane has inputs of its own."""
    sizes, lanes, beside = (values, carry, inputs), 1 if alone else None, inputs if own else 0
    key = program_cache.program_key("steps", sample, *sizes, lanes, beside)
    if (found := program_cache.load(key)) is not None:
        return found
    try:
        with raising_unsupported():
            from .jaxprs import trace
            from .llvm import Loop

            with jax.enable_x64(True):
                body = trace(sample, *([_NUMBER] * size for size in sizes))
            loop = Loop(body, np.dtype(float), values=values, carry=carry, beside=beside, lanes=lanes)
            program_cache.save(key, loop)
            return loop
    except Unsupported as why:
        warn_of_scan(str(why))
        return None


@partial(jax.jit, static_argnums=0)
def _scanned(
    sample: SampleFunction, values: list[jax.Array], carry: list[jax.Array], inputs: list[jax.Array]
) -> list[jax.Array]:
    return jax.lax.scan(lambda carry, inputs: sample(values, carry, inputs), carry, inputs)[1]
