"""Cost of one lane-step of the compiled chain: plant, encoders, both observers, filter, identifier, metrics.

Two workloads on the paper's drive. `gains` sweeps motor gains and noise: no axis varies the plant, and vmap leaves it
unbatched, simulated once for all lanes. `dead_zone` sweeps the dead zone and the noise: every lane has a plant of its own.

All variants are compiled first, then run in turn, several rounds; the least of each counts. Wall time is per lane-step over
all devices; processor time is summed over threads, and is the steadier figure on a machine that others use too. Compare
figures within one run only.

    python benchmarks/lane_step.py --lanes 2048 8192 --devices 1 2 --precision 32 64
    XLA_FLAGS=--xla_cpu_prefer_vector_width=512 python benchmarks/lane_step.py
"""

import argparse
import collections
import itertools
import re
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 2)

from jax.sharding import Mesh, PartitionSpec  # noqa: E402

from jaxbl import chain  # noqa: E402
from jaxbl.drive import Encoders, Initial, SigmoidBacklash, TwoInertia, as_arrays, set_leaves  # noqa: E402
from jaxbl.drive.excitation import Sine  # noqa: E402
from jaxbl.observer import DISCRETISATIONS, EquivalentControl, Identifier, Observers  # noqa: E402
from jaxbl.sweeps.metrics import ALL_METRICS  # noqa: E402


class Variant(NamedTuple):
    """A variant that is compared."""

    workload: str
    observer: str
    precision: int
    lanes: int
    devices: int
    substeps: int
    loop: str


def compile_variant(variant: Variant, steps: int):
    """The compiled sweep of one block, and its arguments."""
    dtype = {32: jnp.float32, 64: jnp.float64}[variant.precision]
    observer = DISCRETISATIONS[variant.observer]
    experiment = chain.Experiment(
        drive=TwoInertia(0.05, 0.15, 7.0, 16.0, 5.0),
        transmission=SigmoidBacklash(1.0, 0.02, 20.0),
        effects=(),
        initial=Initial(),
        excitation=Sine(0.1, 0.16),
        encoders=Encoders(1e-4),
        observer=Observers(observer(4.0, 9.0, velocity_error=0.5), observer(0.5, 0.2)),
        equivalent_control=EquivalentControl(0.01),
        identifier=Identifier(0.1),
        run=chain.Run(1e-3, steps, variant.substeps),
    )
    experiment = as_arrays(experiment, dtype)
    n = variant.lanes * variant.devices
    values = {"encoders.noise": jnp.linspace(1e-5, 1e-3, n, dtype=dtype)}
    if variant.workload == "gains":
        values["observer.motor.alpha"] = jnp.linspace(2.0, 40.0, n, dtype=dtype)
        values["observer.motor.lambda"] = jnp.linspace(1.0, 10.0, n, dtype=dtype)
    else:
        values["transmission.dead_zone"] = jnp.linspace(0.001, 0.03, n, dtype=dtype)

    def lane(values, seed):
        return chain.scan(set_leaves(experiment, values), seed, (ALL_METRICS,))[0]

    sweep = jax.vmap(jax.vmap(lane, (0, None)), (None, 0))
    if variant.devices > 1:
        lanes = PartitionSpec("lanes")
        mesh = Mesh(np.array(jax.devices()[: variant.devices]), ("lanes",))
        sweep = jax.shard_map(
            sweep, mesh=mesh, in_specs=(lanes, PartitionSpec()), out_specs=PartitionSpec(None, "lanes"), check_vma=False
        )
    arguments = (values, jnp.arange(1, dtype=jnp.int32))
    unroll, chain.UNROLL_SUBSTEPS = chain.UNROLL_SUBSTEPS, variant.loop == "unrolled"
    compiled = jax.jit(sweep).lower(*arguments).compile()
    chain.UNROLL_SUBSTEPS = unroll
    return compiled, arguments


def body_operations(text: str) -> collections.Counter:
    """Operations of the compiled loop over samples: the loop body of most operations."""
    bodies = []
    for computation in re.split(r"\n(?=(?:ENTRY )?%?[\w.\-]+ \()", text):
        if not computation.startswith("ENTRY") and "fused_computation" not in computation.split("(")[0]:
            bodies.append(collections.Counter(re.findall(r"= (?:\([^=]*?\)|\S+) ([\w\-]+)\(", computation)))
    return max(bodies, key=lambda c: c["fusion"] + c["copy"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workload", nargs="+", default=["gains", "dead_zone"])
    parser.add_argument("--observer", nargs="+", default=["implicit"])
    parser.add_argument("--precision", nargs="+", type=int, default=[32])
    parser.add_argument("--lanes", nargs="+", type=int, default=[1024, 4096, 16384], help="lanes per device")
    parser.add_argument("--devices", nargs="+", type=int, default=[1])
    parser.add_argument("--substeps", nargs="+", type=int, default=[10])
    parser.add_argument("--loop", nargs="+", default=["rolled"], help="substeps: unrolled, rolled")
    parser.add_argument("--steps", type=int, default=4096, help="many, so that what a run costs once does not count")
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    steps = options.steps

    runs = []
    for choice in itertools.product(
        options.workload,
        options.observer,
        options.precision,
        options.lanes,
        options.devices,
        options.substeps,
        options.loop,
    ):
        variant = Variant(*choice)
        start = time.perf_counter()
        compiled, arguments = compile_variant(variant, steps)
        seconds = time.perf_counter() - start
        text = compiled.as_text()
        if variant.precision == 32:
            assert "f64[" not in text, "float64 slipped into a float32 program"
        runs.append((variant, seconds, compiled, arguments, body_operations(text)))
        jax.block_until_ready(compiled(*arguments))
    least = {run[0]: (float("inf"), float("inf")) for run in runs}
    for _ in range(options.rounds):
        for variant, _, compiled, arguments, _ in runs:
            wall, cpu = time.perf_counter(), time.process_time()
            jax.block_until_ready(compiled(*arguments))
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            least[variant] = (min(least[variant][0], wall), min(least[variant][1], cpu))

    print("workload   observer  bits    lanes dev sub loop      wall ns  cpu ns  lane-steps/s  compile s  kernels copies")
    for variant, seconds, _, _, operations in runs:
        work = steps * variant.lanes * variant.devices
        wall, cpu = least[variant]
        print(
            f"{variant.workload:10} {variant.observer:9} {variant.precision:4} {variant.lanes:8} {variant.devices:3} "
            f"{variant.substeps:3} {variant.loop:9} {wall / work * 1e9:7.2f} {cpu / work * 1e9:7.2f} {work / wall:13.3g} "
            f"{seconds:10.1f} {operations['fusion']:8} {operations['copy']:6}"
        )


if __name__ == "__main__":
    main()
