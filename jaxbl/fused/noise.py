"""The encoders' unit noise of many samples; the numbers are those of :func:`jaxbl.chain.unit_noise`.

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

from jaxbl.chain import LONGEST_BLOCK, NamedArrays, unit_noise

from . import Unsupported, raising_unsupported
from .llvm import Loop

LONGEST_SPAN = 4 * LONGEST_BLOCK
"""Most samples whose noise is drawn at once: a call of XLA takes some 30 us, whatever their number."""
SIDES = ("motor", "load")
_ROTATIONS = (13, 15, 26, 6), (17, 29, 16, 24)
"""Rotations of Threefry-2x32 in its rounds, four at a time (Salmon et al., Parallel random numbers, 2011)."""
_PARITY = 0x1BD11BDA
_WORD = jax.ShapeDtypeStruct((), jnp.uint32)


def host_device() -> Any:
    """This machine's processor; where JAX has been told to leave it alone, the device that there is."""
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        return jax.local_devices()[0]


def draw_noise(seed: int, first: int, count: int, sides: tuple[str, ...] = SIDES) -> NamedArrays:
    """Draw the noise of each side `(count,)` for at most `LONGEST_SPAN` samples from `first` on."""
    drawn = SIDES if {*SIDES}.issuperset(sides) else sides
    return dict(zip(drawn, np.asarray(_compile_noise(drawn)(seed, first, count))[:, :count], strict=True))


@cache
def _compile_noise(sides: tuple[str, ...]) -> Callable[[int, int, int], Any]:
    """A function that draws the noise of at most `LONGEST_SPAN` samples; compiled once for all studies."""
    with jax.default_device(host_device()):
        try:
            return _compile_noise_by_loop(sides)
        except Unsupported:
            return _compile_noise_by_xla(sides)


def _compile_noise_by_xla(sides: tuple[str, ...]) -> Callable[[int, int, int], Any]:
    def draw(seed: Any, first: Any) -> Any:
        by_side = unit_noise(seed, first + jnp.arange(LONGEST_SPAN, dtype=jnp.int32), sides)
        return jnp.stack([by_side[side] for side in sides])

    program = jax.jit(draw).lower(np.uint32(0), np.int32(0)).compile()
    return lambda seed, first, count: program(np.uint32(seed), np.int32(first))


def _compile_noise_by_loop(sides: tuple[str, ...]) -> Callable[[int, int, int], Any]:
    """The same by a loop for the random bits. Raises `Unsupported` for other sides, or where JAX draws them otherwise."""
    settings: Any = jax.config
    if sides != SIDES or settings.jax_default_prng_impl != "threefry2x32" or not settings.jax_threefry_partitionable:
        raise Unsupported("random bits of other sides, or by another generator")
    with raising_unsupported():
        loop = Loop(jax.make_jaxpr(_random_bits)(_WORD, _WORD), np.dtype(np.float32), constants=1, lane_inputs=1)
        bits = jax.ShapeDtypeStruct((2, LONGEST_SPAN), jnp.uint32)
        program = jax.jit(jax.vmap(jax.vmap(_normal_number))).lower(bits).compile()

    def draw(seed: int, first: int, count: int) -> Any:
        samples, bits = np.arange(first, first + count, dtype=np.uint32), np.zeros((2, LONGEST_SPAN), np.uint32)
        drawn = loop.run(1, count, constants=[np.array(seed, np.uint32)], lane_inputs=[samples])[1]
        bits[:, :count] = np.concatenate(drawn)
        return program(bits)

    return draw


def _random_bits(seed: Any, index: Any) -> tuple[Any, Any]:
    """Random bits of a sample's two numbers."""
    zero = jnp.zeros_like(seed)
    key = _threefry((zero, seed), (zero, index))
    motor, load = (_threefry(key, (zero, zero + jnp.uint32(i))) for i in range(2))
    return motor[0] ^ motor[1], load[0] ^ load[1]


def _threefry(key: tuple[Any, Any], block: tuple[Any, Any]) -> tuple[Any, Any]:
    keys = *key, key[0] ^ key[1] ^ jnp.uint32(_PARITY)
    a, b = block[0] + keys[0], block[1] + keys[1]
    for i in range(5):
        for rotation in _ROTATIONS[i % 2]:
            a = a + b
            b = ((b << jnp.uint32(rotation)) | (b >> jnp.uint32(32 - rotation))) ^ a
        a, b = a + keys[(i + 1) % 3], b + keys[(i + 2) % 3] + jnp.uint32(i + 1)
    return a, b


def _normal_number(bits: Any) -> Any:
    """JAX's normal number from random bits, by a generator that returns just these bits."""
    return jax.random.normal(jax.random.wrap_key_data(bits[None], impl=_BITS_GENERATOR), (), jnp.float32)


def _raise_not_implemented(*_: Any) -> Any:
    raise NotImplementedError


_BITS_GENERATOR = define_prng_impl(
    key_shape=(1,),
    seed=_raise_not_implemented,
    split=_raise_not_implemented,
    fold_in=_raise_not_implemented,
    random_bits=lambda key, width, shape: jnp.reshape(key, shape),
    name="given bits",
    tag="given",
)
