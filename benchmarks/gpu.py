"""The workload on a GPU: the scan, the fused kernel, a kernel by hand as the ceiling; and Lorenz's system.

The chain: lane-steps per second of the scan, of a fused run, of its kernel alone (Pallas, lowered by Triton) and of a CUDA
kernel (CuPy), their figures compared; a fused run makes its input and noise as well, which both kernels are given. Lorenz:
trajectory-steps per second of 1000 steps of the classical Runge-Kutta method, 8 to 8 million of them, as in the DiffEqGPU
benchmark (published on a V100: MPGOS 8.9e10, DiffEqGPU 5.8e10, JAX with diffrax 8.4e8).

Least of several rounds in turns, after a warm-up. Needs a GPU, JAX for it, and CuPy; without a GPU it says so and ends.

    python benchmarks/gpu.py --out results/gpu.json
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jax.extend.core import jaxpr_as_fun

from jaxbl.chain import scan
from jaxbl.drive import set_leaves
from jaxbl.fused.jaxprs import join_multiply_add, trace_inlined
from jaxbl.fused.lane_simulator import DeviceSimulator
from jaxbl.fused.pallas import multiply_add
from jaxbl.throughput.workload import CHAIN_METRICS, METRIC_NAMES, RANGES, SEED, Workload, chain_constants, metrics_from_sums

_THREADS = 128


def cuda(precision: str) -> Any:
    """The kernels by hand, compiled."""
    import cupy

    code = (Path(__file__).parent / "gpu_kernels" / "chain.cu").read_text()
    real = {"float32": "float", "float64": "double"}[precision]
    return cupy.RawModule(code=code, options=(f"-Dreal={real}", "--std=c++17"))


def chain_by_hand(work: Workload) -> Callable[[], dict[str, np.ndarray]]:
    """The chain by the CUDA kernel."""
    import cupy

    kernel = cuda(work.precision).get_function("chain")
    torque, noise = (cupy.asarray(column) for column in work.inputs())
    values = cupy.asarray(np.stack(list(work.values().values())))
    out = cupy.zeros((9, work.lanes), work.dtype)
    numbers = np.array(tuple(chain_constants().values()), np.dtype([(name, "f8") for name in chain_constants()]))

    def run() -> dict[str, np.ndarray]:
        sizes = np.int32(work.steps), np.int32(work.start), np.int32(work.window)
        grid = -(-work.lanes // _THREADS)
        kernel((grid,), (_THREADS,), (numbers, *sizes, torque, noise, np.int32(work.lanes), values, out))
        return metrics_from_sums(work, list(cupy.asnumpy(out)))

    return run


def chain_scanned(work: Workload) -> Callable[[], dict[str, np.ndarray]]:
    """The chain by `lax.scan` and `vmap`."""
    experiment = work.experiment()

    def lane(values: dict[str, Any]) -> dict[str, Any]:
        return scan(set_leaves(experiment, values), jnp.asarray(SEED), (CHAIN_METRICS,))[0]

    values = jax.tree.map(jnp.asarray, work.values())
    compiled = jax.jit(jax.vmap(lane)).lower(values).compile()
    return lambda: jax.tree.map(np.asarray, compiled(values))


def chain_fused(work: Workload) -> Callable[[], dict[str, np.ndarray]]:
    """The chain by the fused kernel."""
    simulator, values = DeviceSimulator(work.experiment(), (CHAIN_METRICS,), tuple(RANGES), work.lanes), work.values()
    return lambda: simulator(values, SEED)


def chain_kernel(work: Workload) -> Callable[[], dict[str, np.ndarray]]:
    """The fused kernel alone, as the CUDA kernel is timed: input and noise lie on the device."""
    simulator = DeviceSimulator(work.experiment(), (CHAIN_METRICS,), tuple(RANGES), work.lanes)
    inputs = jax.device_put((simulator.pad_lanes(work.values()), simulator.join_spans(simulator.compute_inputs(SEED))))
    names = sorted(METRIC_NAMES)
    return lambda: {name: np.asarray(x)[: work.lanes] for name, x in zip(names, simulator.kernel(*inputs), strict=True)}


def _lorenz_rates(x: Any, y: Any, z: Any, rho: Any) -> tuple[Any, Any, Any]:
    return 10.0 * (y - x), rho * x - y - x * z, x * y - (8.0 / 3.0) * z


def _lorenz_step(step: float, rho: Any, state: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
    a = _lorenz_rates(*state, rho)
    b = _lorenz_rates(*(s + 0.5 * step * k for s, k in zip(state, a, strict=True)), rho)
    c = _lorenz_rates(*(s + 0.5 * step * k for s, k in zip(state, b, strict=True)), rho)
    d = _lorenz_rates(*(s + step * k for s, k in zip(state, c, strict=True)), rho)
    new = (s + step / 6.0 * (p + 2.0 * (q + r) + t) for s, p, q, r, t in zip(state, a, b, c, d, strict=True))
    return tuple(new)  # type: ignore[return-value]


def lorenz_scanned(lanes: int, steps: int, step: float) -> Callable[[], np.ndarray]:
    """Lorenz's system by `lax.scan`."""
    rho = jnp.linspace(0.0, 21.0, lanes, dtype=jnp.float32)

    @jax.jit
    def run(rho: Any) -> Any:
        start = jnp.ones_like(rho), jnp.zeros_like(rho), jnp.zeros_like(rho)
        return jnp.stack(jax.lax.fori_loop(0, steps, lambda _, state: _lorenz_step(step, rho, state), start))

    return lambda: np.asarray(run(rho))


def lorenz_fused(lanes: int, steps: int, step: float, interpret: bool = False) -> Callable[[], np.ndarray]:
    """Lorenz's system by a Pallas kernel of the same step."""
    padded = -(-lanes // _THREADS) * _THREADS
    lane = jax.ShapeDtypeStruct((_THREADS,), jnp.float32)

    def advance(r: Any, *state: Any) -> Any:
        return _lorenz_step(step, r, state)

    if not interpret:
        advance = jaxpr_as_fun(join_multiply_add(trace_inlined(advance, *[lane] * 4), multiply_add))
    rho = jnp.pad(jnp.linspace(0.0, 21.0, lanes, dtype=jnp.float32), (0, padded - lanes))

    def kernel(rho: Any, *out: Any) -> None:
        r = rho[...]
        start = jnp.ones_like(r), jnp.zeros_like(r), jnp.zeros_like(r)
        for ref, value in zip(out, jax.lax.fori_loop(0, steps, lambda _, s: tuple(advance(r, *s)), start), strict=True):
            ref[...] = value

    block = pl.BlockSpec((_THREADS,), lambda i: (i,))
    shape = [jax.ShapeDtypeStruct((padded,), jnp.float32)] * 3
    options: Any = {} if interpret else {"compiler_params": triton.CompilerParams(num_warps=_THREADS // 32)}
    call = pl.pallas_call(
        kernel,
        grid=(padded // _THREADS,),
        in_specs=[block],
        out_specs=[block] * 3,
        out_shape=shape,
        interpret=interpret,
        **options,
    )
    run = jax.jit(lambda rho: jnp.stack(call(rho))[:, :lanes])
    return lambda: np.asarray(run(rho))


def lorenz_by_hand(lanes: int, steps: int, step: float) -> Callable[[], np.ndarray]:
    """Lorenz's system by the CUDA kernel."""
    import cupy

    kernel = cuda("float32").get_function("lorenz")
    rho, out = cupy.linspace(0.0, 21.0, lanes, dtype=cupy.float32), cupy.zeros((3, lanes), cupy.float32)

    def run() -> np.ndarray:
        kernel((-(-lanes // _THREADS),), (_THREADS,), (np.int32(steps), np.float32(step), np.int32(lanes), rho, out))
        cupy.cuda.get_current_stream().synchronize()
        return out

    return run


def time_runs(runners: dict[str, Callable[[], Any]], rounds: int) -> dict[str, float]:
    """Least seconds of each, in turns; every one has run before."""
    best = dict.fromkeys(runners, float("inf"))
    for _ in range(rounds):
        for name, run in runners.items():
            begun = time.perf_counter()
            run()
            best[name] = min(best[name], time.perf_counter() - begun)
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lanes", nargs="+", type=int, default=[2**k for k in range(8, 21, 2)] + [32768])
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--trajectories", nargs="+", type=int, default=[8 * 10**k for k in range(7)])
    parser.add_argument("--precision", nargs="+", default=["float32", "float64"])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    if jax.default_backend() != "gpu":
        sys.exit("no GPU that JAX can use: nothing was measured")
    device = jax.devices()[0].device_kind
    print(f"{device}, jax {jax.__version__}")
    rows: list[dict[str, Any]] = []
    for precision in options.precision:
        for lanes in sorted(options.lanes):
            with jax.enable_x64(precision == "float64"):
                work = Workload(lanes, options.steps, precision)
                makers = {"cuda": chain_by_hand, "kernel": chain_kernel, "fused": chain_fused}
                makers |= {"scan": chain_scanned} if lanes <= 2**16 else {}
                runners = {name: make(work) for name, make in makers.items()}
                figures = {name: run() for name, run in runners.items()}
                best = time_runs(runners, options.rounds)
            for name, seconds in best.items():
                apart = max(
                    float(np.median(np.abs(figures[name][key] / figures["cuda"][key] - 1.0))) for key in figures["cuda"]
                )
                rows.append(
                    {"name": name, "precision": precision, "lanes": lanes, "steps": options.steps, "deviation": apart}
                )
                rows[-1]["lane_steps_per_second"] = lanes * options.steps / seconds
                print(
                    f"chain   {name:6} {precision} {lanes:8} {rows[-1]['lane_steps_per_second']:.3g}/s  off by {apart:.1g}"
                )
    for lanes in options.trajectories:
        makers = {"cuda": lorenz_by_hand, "fused": lorenz_fused, "scan": lorenz_scanned}
        runners = {name: make(lanes, 1000, 1e-3) for name, make in makers.items()}
        results = {name: np.asarray(run() if name != "cuda" else run().get()) for name, run in runners.items()}  # type: ignore[attr-defined]
        apart = {name: float(np.max(np.abs(value - results["cuda"]))) for name, value in results.items()}
        for name, seconds in time_runs(runners, options.rounds).items():
            rows.append({"name": f"lorenz {name}", "precision": "float32", "lanes": lanes, "steps": 1000})
            rows[-1] |= {"deviation": apart[name], "lane_steps_per_second": lanes * 1000 / seconds}
            print(f"lorenz  {name:6} float32 {lanes:8} {rows[-1]['lane_steps_per_second']:.3g}/s  off by {apart[name]:.1g}")
    if options.out is not None:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps({"machine": {"device": device, "jax": jax.__version__}, "rows": rows}, indent=2))


if __name__ == "__main__":
    main()
