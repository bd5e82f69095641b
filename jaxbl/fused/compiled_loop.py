"""Loops of float64 over samples: compiled for this machine's processor once, or loaded; where that fails, XLA scans."""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from . import ArrayGroup, Leaves, Unsupported, program_cache, raising_unsupported, warn_of_scan
from .dependence import EXTENTS

NUMBER = jax.ShapeDtypeStruct((), np.dtype(float))
"""An example of a number."""
LoopDefinition = tuple[Callable[..., Any], Mapping[str, Any], int | None]
"""A function of one sample, examples of its arguments by their group in a :class:`jaxbl.fused.llvm.Loop`, and its lanes."""


def compile_once(define: Callable[..., LoopDefinition]) -> Any:
    """Make a function that returns the defined loop for some arguments: compiled once, or loaded.

    Where a loop is not supported, it returns a :class:`ScannedLoop`, with a message. An argument that has `examples` is
    described by them.
    """

    @functools.lru_cache(maxsize=64)
    @functools.wraps(define)
    def compile_loop(*arguments: Any) -> Any:
        key = program_cache.program_key("loop", define, *(getattr(argument, "examples", argument) for argument in arguments))
        if (loop := program_cache.load(key)) is not None:
            return loop
        sample, examples, lanes = define(*arguments)
        try:
            with raising_unsupported(), jax.enable_x64(True):
                from .llvm import Loop

                counts: Any = {group: len(jax.tree.leaves(numbers)) for group, numbers in examples.items()}
                loop = Loop(jax.make_jaxpr(sample)(*examples.values()), np.dtype(float), lanes=lanes, **counts)
                program_cache.save(key, loop)
                return loop
        except Unsupported as reason:
            warn_of_scan(str(reason))
            return ScannedLoop(sample, examples)

    return compile_loop


class ScannedLoop:
    """A loop by XLA, with those methods of :class:`jaxbl.fused.llvm.Loop` that loops without blocks need.

    Args:
        sample: function of a sample of one lane; its argument `tables`, if it has one, takes arrays of any shape.
        examples: of its other arguments, by group.
    """

    def __init__(self, sample: Callable[..., Any], examples: Mapping[str, Any]):
        self._sample, self._examples = sample, examples
        self._program = jax.jit(self._scan, static_argnames=("steps", "lanes"))

    def whole_vectors(self, lanes: int) -> int:
        """The number of lanes."""
        return lanes

    def run(self, steps: int, lanes: int = 1, **inputs: ArrayGroup) -> tuple[ArrayGroup, ArrayGroup, ArrayGroup]:
        """Take lanes through all samples, as a compiled loop does."""
        buffers = inputs.pop("outputs", ())
        with jax.enable_x64(True):
            groups = {name: [*map(jnp.asarray, arrays)] for name, arrays in inputs.items()}
            carry, outputs = self._program(groups, steps=steps, lanes=lanes)
        for array, output in zip(buffers, outputs, strict=False):
            array[...] = output
        return np.asarray(carry), np.asarray(outputs), ()

    def _scan(self, groups: dict[str, Leaves], steps: int, lanes: int) -> tuple[Leaves, Leaves]:
        tables = {name: arrays for name, arrays in groups.items() if name not in EXTENTS}
        scanned = {name: arrays for name, arrays in groups.items() if "samples" in EXTENTS.get(name, "")}
        axes = [0 if "lanes" in EXTENTS[name] else None for name in self._examples]
        move_lanes = jax.vmap(functools.partial(self._sample, **tables), axes, axis_size=lanes)

        def advance(carry: Leaves, inputs: dict[str, Leaves]) -> tuple[Leaves, Leaves]:
            arrays = groups | inputs | {"carry": carry}
            arguments = [jax.tree.structure(numbers).unflatten(arrays[name]) for name, numbers in self._examples.items()]
            leaves = jax.tree.leaves(move_lanes(*arguments))
            return leaves[: len(carry)], leaves[len(carry) :]

        return jax.lax.scan(advance, groups.get("carry", []), scanned, steps)
