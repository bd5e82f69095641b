"""The workload by this package: the scan over time, vmapped, and the fused loop."""

from itertools import count
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxbl.chain import TracedArrays, scan
from jaxbl.drive import set_leaves
from jaxbl.fused.lane_simulator import HostSimulator

from .workload import CHAIN_METRICS, RANGES, SEED, ChunkedProgram, Metrics, Workload

LANES = 2**12
"""That a device scans at once: what they carry then stays in a core's cache (benchmarks/NOTES.md)."""


class ScanChain(ChunkedProgram):
    """`lax.scan` and `vmap`, in chunks that stay in the caches, devices side by side."""

    def __init__(self, workload: Workload, devices: int):
        experiment = workload.experiment()

        def lane(values: TracedArrays, seed: Any) -> TracedArrays:
            return scan(set_leaves(experiment, values), seed, (CHAIN_METRICS,))[0]

        lanes, mesh = PartitionSpec("lanes"), Mesh(np.array(jax.local_devices(backend="cpu")[:devices]), ("lanes",))
        sweep = jax.shard_map(
            jax.vmap(lane, (0, None)), mesh=mesh, in_specs=(lanes, PartitionSpec()), out_specs=lanes, check_vma=False
        )
        chunk = min(LANES * devices, -(-workload.lanes // devices) * devices)
        super().__init__(sweep, workload, chunk, jnp.asarray(SEED))


class FusedChain:
    """The loop over time in registers, threads side by side; input and noise by itself, of another seed each time."""

    def __init__(self, workload: Workload, threads: int):
        self._simulator = HostSimulator(workload.experiment(), (CHAIN_METRICS,), tuple(RANGES), workload.lanes, threads)
        self._values, self._seeds = workload.values(), count(SEED)

    def __call__(self) -> Metrics:
        # nothing is kept for the next lanes
        self._simulator.keep_seeds(())
        return self._simulator(self._values, next(self._seeds))
