"""Lanes that are done stop costing: nine of ten diverge after a tenth of the run, and leave the fused loop.

    python benchmarks/done_lanes.py [--lanes 8192] [--steps 10000] [--precision float64] [--rounds 5]

The shaft's stiffness is an axis. Above a limit that the step of the plant sets, a lane's numbers grow until they overflow;
the stiffness of these lanes is the least at which that happens within a tenth of the run. All cases take turns; the least
time of several rounds counts. Every case's metrics are compared, bit for bit, with those of the loop that no lane leaves.
"""

import argparse
import os
import time
from typing import Any

os.environ.setdefault("JAX_NUM_CPU_DEVICES", str(len(os.sched_getaffinity(0))))

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.chain import Experiment, Reducer, Run
from jaxbl.drive import Encoders, Initial, LinearShaft, TwoInertia, as_arrays
from jaxbl.drive.excitation import Sine
from jaxbl.fused.lane_simulator import HostSimulator
from jaxbl.observer import EquivalentControl, Identifier, ImplicitSuperTwisting, Observers
from jaxbl.sweeps.metrics import ALL_METRICS

PATH, SANE = "transmission.stiffness", 60.0
SHARE, TIME = 0.9, 0.1
"""Shares of lanes that diverge, and of the run after which they do."""


def experiment(steps: int, dtype: np.dtype) -> Experiment:
    return as_arrays(
        Experiment(
            drive=TwoInertia(0.05, 0.15, 7.0, 16.0, 5.0),
            transmission=LinearShaft(SANE),
            effects=(),
            initial=Initial(),
            excitation=Sine(5.0, 0.8),
            encoders=Encoders(1e-4),
            observer=Observers(ImplicitSuperTwisting(10.0, 90.0), ImplicitSuperTwisting(2.5, 8.2)),
            equivalent_control=EquivalentControl(0.01),
            identifier=Identifier(0.1),
            run=Run(1e-3, steps, 1),
        ),
        dtype,
    )


def _lasting(experiment: Experiment, total: Any, index: Any, signals: Any) -> Any:
    finite = [jnp.isfinite(signals.side(side).true.perturbation) for side in experiment.sides]
    return total + jnp.logical_or(*finite).astype(total.dtype)


LASTED = Reducer(
    lambda experiment: jnp.zeros_like(experiment.run.sample_period),
    _lasting,
    lambda experiment, total, state: {"samples": total},
)
"""Samples until both sides have overflowed."""


def limit(base: Experiment, steps: int) -> float:
    """The least stiffness at which a lane is done before so many samples."""
    simulator, low, high = HostSimulator(base, (LASTED,), (PATH,), 256, 1), SANE, 1e9
    for _ in range(4):
        candidates = np.linspace(low, high, 256)
        last = int(np.flatnonzero(simulator({PATH: candidates}, 0)["samples"] >= steps)[-1])
        low, high = candidates[last], candidates[last + 1]
    return float(high)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--lanes", type=int, default=8192)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--precision", choices=("float32", "float64"), default="float64")
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    with jax.enable_x64(args.precision == "float64"):
        measure(args.lanes, args.steps, np.dtype(args.precision), args.rounds)


def measure(lanes: int, steps: int, dtype: np.dtype, rounds: int) -> None:
    base = experiment(steps, dtype)
    least = limit(base, int(TIME * steps))
    threads = len(jax.local_devices())
    leaving = HostSimulator(base, (ALL_METRICS,), (PATH,), lanes, threads)
    staying = HostSimulator(base, (ALL_METRICS._replace(done=None),), (PATH,), lanes, threads)
    sane, gone = SANE * np.linspace(1.0, 1.1, lanes), np.arange(lanes) < SHARE * lanes
    mixed = np.random.default_rng(0).permutation(gone)
    cases = {
        "none diverges": (leaving, sane),
        "none diverges, none may leave": (staying, sane),
        "nine of ten, one after the other": (leaving, np.where(gone, least, sane)),
        "nine of ten, mixed": (leaving, np.where(mixed, least, sane)),
        "nine of ten, mixed, none may leave": (staying, np.where(mixed, least, sane)),
    }
    best = dict.fromkeys(cases, np.inf)
    for simulator, values in cases.values():
        metrics, expected = simulator({PATH: values}, 0), staying({PATH: values}, 0)
        assert all(np.array_equal(metrics[name], expected[name], equal_nan=True) for name in expected)
    for _ in range(rounds):
        for name, (simulator, values) in cases.items():
            start = time.perf_counter()
            simulator({PATH: values}, 0)
            best[name] = min(best[name], time.perf_counter() - start)
    print(f"{lanes} lanes of {steps} samples, {dtype}, {threads} threads; stiffness {least:.4g} and more diverge")
    for name, seconds in best.items():
        print(f"{name:36s} {seconds:8.3f} s   {seconds / best['none diverges']:.2f}")


if __name__ == "__main__":
    main()
