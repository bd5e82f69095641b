"""Elementwise functions of columns of any length by programs of few shapes, as compiling takes longer than computing."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

_SIZES = 1024, 8192
"""Of the pieces: one piece of the first where that is enough, else as many of the second as it takes."""


def in_pieces(function: Callable[..., Any], columns: Sequence[np.ndarray], devices: Sequence[Any] | None = None) -> Any:
    """Apply an elementwise function to columns, piece by piece.

    Args:
        function: of arrays of one shape, to any pytree of such; compiled (`jax.jit`) once for all calls.
        columns: shape (n,) each.
        devices: that take turns; all local ones if left out.

    Returns:
        What the function gives, of NumPy arrays of shape (n,).
    """
    count = len(columns[0])
    size = _SIZES[0] if count <= _SIZES[0] else _SIZES[1]
    pieces = max(-(-count // size), 1)
    padded = [np.pad(np.asarray(one), (0, pieces * size - count), "edge").reshape(pieces, size) for one in columns]
    devices = jax.local_devices() if devices is None else devices
    found = []
    for i in range(pieces):
        found.append(function(*(jax.device_put(one[i], devices[i % len(devices)]) for one in padded)))
    return jax.tree.map(lambda *some: np.concatenate([np.asarray(one) for one in some])[:count], *found)
