"""Elementwise functions of columns of any length by programs of two shapes, as compiling takes longer than computing."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec


@functools.lru_cache(maxsize=64)
def _program(function: Callable[..., Any], devices: tuple[Any, ...]) -> tuple[Callable[..., Any], NamedSharding]:
    """A function for all devices at once, and where rows of arguments lie. Each device does its own row, without a word to
    the others: two such programs at the same time would wait for each other otherwise."""
    mesh, rows = Mesh(np.array(devices), ("devices",)), PartitionSpec("devices")
    own = jax.shard_map(function, mesh=mesh, in_specs=rows, out_specs=rows, check_vma=False)
    return jax.jit(own), NamedSharding(mesh, rows)


_SIZES = 64, 1024
"""Of the pieces; each device has one at a time. For few values the small ones: a chunk of 4 lanes takes 6.5 ms with them,
17.8 ms with the large ones (benchmarks/NOTES.md)."""


def in_pieces(
    function: Callable[..., Any], columns: Sequence[np.ndarray], devices: Sequence[Any] | None = None, most: int = 0
) -> Any:
    """Apply an elementwise function to columns `(n,)`, piece by piece, on some devices (all local ones if left out).

    The function takes arrays of one shape and gives any pytree of such; wrap it in `jax.jit`: all pieces of a call have
    one shape, that of `most` values where calls with fewer should take the same program. The result has NumPy arrays
    `(n,)` in their place.
    """
    count = len(columns[0])
    devices = list(jax.local_devices() if devices is None else devices)
    size = next((size for size in _SIZES if max(count, most) <= size * len(devices)), _SIZES[-1])
    shape = max(-(-count // (size * len(devices))), 1), len(devices), size
    padded = [np.pad(np.asarray(one), (0, math.prod(shape) - count), "edge").reshape(shape) for one in columns]
    program, rows = _program(function, tuple(devices))
    found = [program(*(jax.device_put(piece, rows) for piece in pieces)) for pieces in zip(*padded, strict=True)]
    return jax.tree.map(lambda *some: np.concatenate([np.asarray(one).ravel() for one in some])[:count], *found)
