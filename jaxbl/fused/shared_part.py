"""The part of a run that all lanes share: input, noise, and the whole plant where no lane differs in it.

It is computed ahead of the lanes, some blocks of samples (a span) at a time.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from . import Leaves, Unsupported
from .dependence import Dependence, LoopHooks, split_by_lane
from .jaxprs import trace_inlined
from .llvm import Loop
from .noise import LONGEST_SPAN, draw_noise

SharedValues = tuple[Leaves, Leaves, Leaves]
"""State of the shared part after a span, outputs of each block `(blocks,)`, and outputs of each sample `(samples,)`."""


class SharedPart(NamedTuple):
    """The computation that all lanes share, as functions of its state.

    Attributes:
        step: state, index and noise of a sample -> state, outputs that lanes read at the sample.
        end_block: state, () -> state, outputs that lanes read after the block.
        state: shapes and types of the state's numbers.
        sides: whose noise is drawn.
        steps: samples of a run.
        block_length: samples of a block.
    """

    step: Callable[[Sequence[Any], Any], tuple[Leaves, Leaves]]
    end_block: Callable[[Sequence[Any], Any], tuple[Leaves, Leaves]]
    state: list[jax.ShapeDtypeStruct]
    sides: tuple[str, ...]
    steps: int
    block_length: int

    @property
    def span_length(self) -> int:
        """Samples of a span; the last one may be shorter."""
        return min(LONGEST_SPAN // self.block_length * self.block_length, self.steps)

    def sample_inputs(self, seed: int, first: int, count: int) -> tuple[Any, Any]:
        """Indices and noise of samples, `(count,)` each."""
        noise = draw_noise(seed, first, count, self.sides)
        return np.arange(first, first + count, dtype=np.int32), {side: noise[side] for side in self.sides}

    def input_shapes(self, *shape: int) -> tuple[Any, Any]:
        """Shapes and types of `sample_inputs`."""
        noise = jax.ShapeDtypeStruct(shape, jnp.float32)
        return jax.ShapeDtypeStruct(shape, jnp.int32), dict.fromkeys(self.sides, noise)


class SharedPartScan:
    """Runs a shared part by XLA, sample by sample."""

    def __init__(self, part: SharedPart):
        def run_block(state: Leaves, inputs: Any) -> SharedValues:
            state, sample_outputs = jax.lax.scan(part.step, state, inputs)
            return *part.end_block(state, ()), sample_outputs

        self._part = part
        lengths = {min(part.block_length, part.steps), part.steps % part.block_length} - {0}
        self._programs = {n: jax.jit(run_block).lower(part.state, part.input_shapes(n)).compile() for n in lengths}

    def __call__(self, state: Leaves, seed: int, first: int, count: int) -> SharedValues:
        outputs = []
        for start in range(0, count, self._part.block_length):
            length = min(self._part.block_length, count - start)
            inputs = self._part.sample_inputs(seed, first + start, length)
            state, *block_and_sample_outputs = self._programs[length](state, inputs)
            outputs.append(block_and_sample_outputs)
        of_blocks, of_samples = zip(*outputs, strict=True)
        block_outputs = [np.stack(column) for column in zip(*of_blocks, strict=True)]
        sample_outputs = [np.concatenate(column) for column in zip(*of_samples, strict=True)]
        return state, block_outputs, sample_outputs


class SharedPartLoop:
    """Runs a shared part faster: what needs no state by XLA, for all samples of a span at once; the rest by a compiled loop.

    Raises:
        Unsupported: the rest reads something that is no number, or needs an operation that loops lack.
    """

    def __init__(self, part: SharedPart):
        # what needs the state stands in the part of lanes
        needing = [Dependence.LANE] * len(part.state)
        split = split_by_lane(
            lambda _, state, inputs: part.step(state, inputs), [], part.state, part.input_shapes(), needing, needing
        )
        self._part, self._needs_state = part, split.is_lane_result[len(part.state) :]
        # one program for all spans: what it computes beyond the last sample is not read. Numbers of one type are stacked,
        # as each array takes XLA and NumPy some microseconds
        inputs, compute_stateless = part.input_shapes(part.span_length), jax.vmap(lambda inputs: split.shared((), inputs))
        dtypes = [leaf.dtype for leaf in jax.tree.leaves(jax.eval_shape(compute_stateless, inputs))]
        self._groups = [[i for i, other in enumerate(dtypes) if other == dtype] for dtype in dict.fromkeys(dtypes)]

        def compute_stacked(inputs: Any) -> Leaves:
            leaves = jax.tree.leaves(compute_stateless(inputs))
            return [jnp.stack([leaves[i] for i in group]) for group in self._groups]

        self._compute_stacked = jax.jit(compute_stacked).lower(inputs).compile()
        self._loop = None
        if part.state:
            hooks = LoopHooks(
                after_block=trace_inlined(lambda *state: jax.tree.leaves(part.end_block(state, ())), *part.state)
            )
            self._loop = Loop(split.lane, np.dtype(float), carry=len(part.state), hooks=hooks, lanes=1)

    def __call__(self, state: Leaves, seed: int, first: int, count: int) -> SharedValues:
        part = self._part
        stacks = self._compute_stacked(part.sample_inputs(seed, first, part.span_length))
        columns: dict[int, np.ndarray] = {}
        for group, rows in zip(self._groups, stacks, strict=True):
            columns |= zip(group, np.asarray(rows)[:, :count], strict=True)
        stateless_count, ordered = self._needs_state.count(False), [columns[i] for i in range(len(columns))]
        stateless, loop_inputs = iter(ordered[:stateless_count]), ordered[stateless_count:]
        columns_by_role = (), (), ()
        if self._loop is not None:
            carry = [np.array([leaf]) for leaf in state]
            columns_by_role = self._loop.run(count, block_length=part.block_length, carry=carry, sample_inputs=loop_inputs)
        state, loop_outputs, block_outputs = ([column[..., 0] for column in columns] for columns in columns_by_role)
        stateful = iter(loop_outputs)
        sample_outputs = [next(stateful if needs_state else stateless) for needs_state in self._needs_state]
        return state, block_outputs, sample_outputs


def compile_shared_part(part: SharedPart) -> SharedPartLoop | SharedPartScan:
    """Compile a shared part: by the loop if that supports it, otherwise by XLA.

    Returns what computes a span from the state before it, the seed, its first sample and its number of samples.
    """
    try:
        return SharedPartLoop(part)
    except Unsupported:
        return SharedPartScan(part)
