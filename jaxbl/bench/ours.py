"""The workload by this package: `lax.scan` through time, `vmap` over lanes, devices side by side."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxbl.drive import set_leaves
from jaxbl.simulate import Reducer, scan

from .workload import FIGURES, SEED, Workload


class Ours:
    """One workload, compiled."""

    def __init__(self, workload: Workload, devices: list[Any], reducer: Reducer = FIGURES):
        experiment = workload.experiment()

        def lane(values: dict[str, Any], seed: Any) -> dict[str, Any]:
            return scan(set_leaves(experiment, values), seed, (reducer,))[0]

        lanes, mesh = PartitionSpec("lanes"), Mesh(np.array(devices), ("lanes",))
        sweep = jax.shard_map(
            jax.vmap(lane, (0, None)), mesh=mesh, in_specs=(lanes, PartitionSpec()), out_specs=lanes, check_vma=False
        )
        self._given = (jax.tree.map(jnp.asarray, workload.values()), jnp.asarray(SEED))
        self.compiled = jax.jit(sweep).lower(*self._given).compile()

    def __call__(self) -> dict[str, np.ndarray]:
        return jax.tree.map(np.asarray, jax.block_until_ready(self.compiled(*self._given)))
