"""The chain in diffrax: fixed steps of Euler's method, vmapped over lanes.

Its right-hand side is the package's own step, divided by the period: Euler's method then takes exactly the chain's steps.
"""

# of the extra `bench`, which need not be there
# pyright: reportMissingImports=false

from typing import Any

import jax
import jax.numpy as jnp

from jaxbl.chain import TracedArrays, advance_sample, compute_metrics, initial_carry
from jaxbl.drive import set_leaves

from ..jaxbl_chain import LANES
from ..workload import CHAIN_METRICS, ChunkedProgram, Workload


class DiffraxChain(ChunkedProgram):
    """One workload, compiled."""

    def __init__(self, workload: Workload):
        import diffrax

        experiment, dtype = workload.experiment(), workload.dtype
        _, noise = workload.inputs()
        units = jnp.asarray(noise)
        period = experiment.run.sample_period

        def lane(values: TracedArrays) -> TracedArrays:
            lane_experiment = set_leaves(experiment, values)
            start, tree = jax.tree.flatten(initial_carry(lane_experiment, (CHAIN_METRICS,)))

            def rates(t: Any, y: tuple[Any, ...], args: Any) -> tuple[Any, ...]:
                index = jnp.round(t / period).astype(jnp.int32)
                noise = dict(zip(lane_experiment.sides, units[index], strict=True))
                new, _ = advance_sample(lane_experiment, (CHAIN_METRICS,), tree.unflatten(y), index, noise)
                return tuple((after - before) / period for after, before in zip(jax.tree.leaves(new), y, strict=True))

            solution = diffrax.diffeqsolve(
                diffrax.ODETerm(rates),
                diffrax.Euler(),
                0.0,
                workload.steps * float(period),
                float(period),
                tuple(jnp.asarray(x, dtype) for x in start),
                saveat=diffrax.SaveAt(t1=True),
                max_steps=workload.steps + 1,
                adjoint=diffrax.ForwardMode(),
            )
            last: Any = solution.ys
            return compute_metrics(lane_experiment, (CHAIN_METRICS,), tree.unflatten([x[0] for x in last]))

        super().__init__(jax.vmap(lane), workload, LANES)
