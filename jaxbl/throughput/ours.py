"""The workload by this package: the scan over time, vmapped, and the fused loop."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxbl.drive import set_leaves
from jaxbl.fused.passage import HostPassage
from jaxbl.simulate import scan
from jaxbl.study.engine import LANES_PER_DEVICE

from .workload import FIGURES, RANGES, SEED, Workload


class Scanned:
    """`lax.scan` and `vmap`, in chunks that stay in the caches, devices side by side."""

    def __init__(self, workload: Workload, devices: int):
        experiment = workload.experiment()

        def lane(values: dict[str, Any], seed: Any) -> dict[str, Any]:
            return scan(set_leaves(experiment, values), seed, (FIGURES,))[0]

        lanes, mesh = PartitionSpec("lanes"), Mesh(np.array(jax.local_devices()[:devices]), ("lanes",))
        sweep = jax.shard_map(
            jax.vmap(lane, (0, None)), mesh=mesh, in_specs=(lanes, PartitionSpec()), out_specs=lanes, check_vma=False
        )
        self._lanes = workload.lanes
        self._chunk = min(LANES_PER_DEVICE["scan"] * devices, -(-workload.lanes // devices) * devices)
        values, size = workload.values(), -(-workload.lanes // self._chunk) * self._chunk
        padded = {path: np.pad(column, (0, size - workload.lanes), "edge") for path, column in values.items()}
        self._given = [
            jax.tree.map(lambda column, at=at: jnp.asarray(column[at : at + self._chunk]), padded)
            for at in range(0, size, self._chunk)
        ]
        self.compiled = jax.jit(sweep).lower(self._given[0], jnp.asarray(SEED)).compile()

    def __call__(self) -> dict[str, np.ndarray]:
        parts = [jax.tree.map(np.asarray, self.compiled(values, jnp.asarray(SEED))) for values in self._given]
        return {name: np.concatenate([part[name] for part in parts])[: self._lanes] for name in parts[0]}


class Fused:
    """The loop over time in registers, threads side by side."""

    def __init__(self, workload: Workload, threads: int):
        self._passage = HostPassage(workload.experiment(), (FIGURES,), tuple(RANGES), threads)
        self._values = workload.values()

    def __call__(self) -> dict[str, np.ndarray]:
        return self._passage(self._values, SEED)
