"""The encoders' unit noise of many samples, number by number that of :func:`jaxbl.simulate.unit_noise`.

Its random bits come from a loop with samples side by side: XLA takes four times as long for them as for all the rest, and
half a second less to compile what is left. JAX's own code makes normal numbers of them.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.random import define_prng_impl

from jaxbl.simulate import LONGEST_BLOCK, unit_noise

from . import Unsupported, raising_unsupported
from .jaxprs import trace
from .llvm import Loop

LONGEST_SPAN = 4 * LONGEST_BLOCK
"""Samples whose noise is drawn at once, at most: a call of XLA takes some 30 us, whatever their number."""
SIDES = ("motor", "load")
_TURNS = (13, 15, 26, 6), (17, 29, 16, 24)
"""Rotations of Threefry-2x32 in its rounds, four at a time (Salmon et al., Parallel random numbers, 2011)."""
_PARITY = 0x1BD11BDA
_WORD = jax.ShapeDtypeStruct((), jnp.uint32)


def host_device() -> Any:
    """This machine's processor; where JAX has been told to leave it alone, the device that there is."""
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        return jax.local_devices()[0]


def draw_noise(seed: int, first: int, count: int) -> dict[str, np.ndarray]:
    """Noise of each side `(count,)`, of at most `LONGEST_STRETCH` samples from `first` on."""
    size = max(LONGEST_SPAN // 4, 1 << (count - 1).bit_length())
    return dict(zip(SIDES, np.asarray(_drawing(size)(seed, first, count))[:, :count], strict=True))


@cache
def _drawing(size: int) -> Callable[[int, int, int], Any]:
    """For at most so many samples; compiled once for all studies."""
    with jax.default_device(host_device()):
        try:
            return _by_loop(size)
        except Unsupported:
            return _by_xla(size)


def _by_xla(size: int) -> Callable[[int, int, int], Any]:
    def noise(seed: Any, first: Any) -> Any:
        drawn = unit_noise(seed, first + jnp.arange(size, dtype=jnp.int32), SIDES)
        return jnp.stack([drawn[side] for side in SIDES])

    program = jax.jit(noise).lower(np.uint32(0), np.int32(0)).compile()
    return lambda seed, first, count: program(np.uint32(seed), np.int32(first))


def _by_loop(size: int) -> Callable[[int, int, int], Any]:
    """`Unsupported` where JAX draws otherwise."""
    settings: Any = jax.config
    if settings.jax_default_prng_impl != "threefry2x32" or not settings.jax_threefry_partitionable:
        raise Unsupported("random bits by another generator")
    with raising_unsupported():
        loop = _random()
        bits = jax.ShapeDtypeStruct((2, size), jnp.uint32)
        program = jax.jit(jax.vmap(jax.vmap(_normal))).lower(bits).compile()

    def noise(seed: int, first: int, count: int) -> Any:
        whole = -(-count // loop.lanes) * loop.lanes
        found = np.zeros((2, size), np.uint32)
        samples = np.arange(first, first + whole, dtype=np.uint32)
        loop([np.array(seed, np.uint32), samples, *found[:, :whole]], 1, 0, whole)
        return program(found)

    return noise


@cache
def _random() -> Loop:
    return Loop(trace(_bits, _WORD, _WORD), np.dtype(np.float32), fixed=1, beside=1)


def _bits(seed: Any, index: Any) -> tuple[Any, Any]:
    """Random bits of a sample's two numbers."""
    zero = jnp.zeros_like(seed)
    key = _threefry((zero, seed), (zero, index))
    one, two = (_threefry(key, (zero, zero + jnp.uint32(i))) for i in range(2))
    return one[0] ^ one[1], two[0] ^ two[1]


def _threefry(key: tuple[Any, Any], block: tuple[Any, Any]) -> tuple[Any, Any]:
    keys = *key, key[0] ^ key[1] ^ jnp.uint32(_PARITY)
    a, b = block[0] + keys[0], block[1] + keys[1]
    for i in range(5):
        for turn in _TURNS[i % 2]:
            a = a + b
            b = ((b << jnp.uint32(turn)) | (b >> jnp.uint32(32 - turn))) ^ a
        a, b = a + keys[(i + 1) % 3], b + keys[(i + 2) % 3] + jnp.uint32(i + 1)
    return a, b


def _normal(bits: Any) -> Any:
    """JAX's normal number of random bits, which a generator gives that knows no others."""
    return jax.random.normal(jax.random.wrap_key_data(bits[None], impl=_GIVEN), (), jnp.float32)


def _none(*_: Any) -> Any:
    raise NotImplementedError


_GIVEN = define_prng_impl(
    key_shape=(1,), seed=_none, split=_none, fold_in=_none, name="given bits", tag="given",
    random_bits=lambda key, width, shape: jnp.reshape(key, shape),
)  # fmt: skip
