"""Elementwise functions of columns of any length by programs of two shapes, as compiling takes longer than computing."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec


def call_in_float64(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function of JAX in float64 with numbers or arrays, and return what it returns as NumPy's."""
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, function(*(jnp.asarray(argument, float) for argument in arguments)))


@functools.lru_cache(maxsize=64)
def _map_over_devices(function: Callable[..., Any], devices: tuple[Any, ...]) -> tuple[Callable[..., Any], NamedSharding]:
    """Compile a function that takes a row of its arguments on each device, and return it with the sharding of the rows.

    The devices do not communicate: two such programs that run at the same time would otherwise wait for each other.
    """
    mesh, spec = Mesh(np.array(devices), ("devices",)), PartitionSpec("devices")
    map_rows = jax.shard_map(function, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    return jax.jit(map_rows), NamedSharding(mesh, spec)


_PIECE_SIZES = 64, 1024
"""A device computes one piece at a time. Small pieces are for few numbers: a chunk of 4 lanes takes 6.5 ms with them,
17.8 ms with the large ones (benchmarks/NOTES.md)."""


def apply_elementwise(
    function: Callable[..., Any], columns: Sequence[np.ndarray], devices: Sequence[Any] | None = None, largest: int = 0
) -> Any:
    """Apply an elementwise function to columns, piece by piece.

    Args:
        function: takes arrays of one shape, and returns a pytree of such arrays; wrap it in `jax.jit`.
        columns: its arguments, each `(n,)`.
        devices: devices to use; left out, all local ones.
        largest: the largest n of other calls that should share the compiled program.

    Returns:
        The function's pytree with NumPy arrays `(n,)`.
    """
    count = len(columns[0])
    devices = list(jax.local_devices() if devices is None else devices)
    size = next((size for size in _PIECE_SIZES if max(count, largest) <= size * len(devices)), _PIECE_SIZES[-1])
    shape = max(-(-count // (size * len(devices))), 1), len(devices), size
    padded = [np.pad(np.asarray(column), (0, math.prod(shape) - count), "edge").reshape(shape) for column in columns]
    program, rows = _map_over_devices(function, tuple(devices))
    results = [program(*(jax.device_put(piece, rows) for piece in pieces)) for pieces in zip(*padded, strict=True)]
    return jax.tree.map(lambda *parts: np.concatenate([np.asarray(part).ravel() for part in parts])[:count], *results)
