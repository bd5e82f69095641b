"""Savings of a study that requests `converged` alone: `sweeps/gain_map.toml`, time and bytes a point.

    python benchmarks/asked_metrics.py [--study sweeps/gain_map.toml] [--metrics converged] [--lanes 12288] [--rounds 5]

The fused loop takes the study's lanes (evenly spread, if fewer are asked for) through one seed: with all metrics, with those
asked for, and with these where no lane may leave before the end. All cases take turns; the least time of several rounds
counts, and what judges gains is not in it. Columns that two cases have in common are compared, bit for bit. Bytes are those
of the parts that a sweep of the whole study leaves. Then the times again with a tolerance that no lane keeps: the most that
leaving can save.
"""

import argparse
import os
import tempfile
import time
from pathlib import Path

os.environ.setdefault("JAX_NUM_CPU_DEVICES", str(len(os.sched_getaffinity(0))))

import jax
import numpy as np

from jaxbl.config import Config, precision, prepare, read_config
from jaxbl.fused.lane_simulator import HostSimulator
from jaxbl.sweeps.metrics import metrics_reducer
from jaxbl.sweeps.points import Points
from jaxbl.sweeps.sweep import sweep


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--study", default=str(Path(__file__).parents[1] / "sweeps" / "gain_map.toml"))
    parser.add_argument("--metrics", nargs="+", default=["converged"])
    parser.add_argument("--lanes", type=int, default=12_288)
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    config = read_config(args.study)
    names = tuple(sorted(args.metrics))
    seconds(config, names, args.lanes, args.rounds)
    strict = config.run.model_copy(update={"position_tolerance": 1e-12})
    seconds(config.model_copy(update={"run": strict}), names, args.lanes, args.rounds)
    for metric_names in (None, args.metrics):
        print(
            f"{'all metrics' if metric_names is None else ', '.join(metric_names):36s} "
            f"{size(config, metric_names):8.1f} bytes a point"
        )


def seconds(config: Config, names: tuple[str, ...], lanes: int, rounds: int) -> None:
    points, threads = Points(config), len(jax.local_devices())
    chosen = np.linspace(0, points.group_size - 1, min(lanes, points.group_size)).round().astype(int)
    with precision(config):
        experiment, columns = prepare(config), points.columns(chosen)
        asked = metrics_reducer(names)
        reducers = {
            "all metrics": metrics_reducer(),
            ", ".join(names): asked,
            f"{', '.join(names)}, none may leave": asked._replace(done=None),
        }
        simulators = {
            name: HostSimulator(experiment, (reducer,), tuple(columns), len(chosen), threads)
            for name, reducer in reducers.items()
        }
        results = {name: simulator(columns, 0) for name, simulator in simulators.items()}
        all_results = results["all metrics"]
        for figures in results.values():
            assert all(
                np.array_equal(all_results[name], figures[name], equal_nan=True) for name in figures if name != "finite"
            )
        best = dict.fromkeys(simulators, np.inf)
        for _ in range(rounds):
            for name, simulator in simulators.items():
                begun = time.perf_counter()
                simulator(columns, 0)
                best[name] = min(best[name], time.perf_counter() - begun)
    shares = ", ".join(f"{side} {all_results[f'{side}.converged'].mean():.2f}" for side in experiment.sides)
    print(f"{len(chosen)} lanes of {config.run.steps} samples, {threads} threads; converged: {shares}")
    for name, took in best.items():
        print(
            f"{name:36s} {took:8.3f} s   {took / best['all metrics']:.2f}   carried a lane: {simulators[name].carry_count}"
        )


def size(config: Config, names: list[str] | None) -> float:
    """Bytes a point and seed of the parts that a sweep leaves."""
    swept = config.sweep.model_copy(update={"metrics": names})
    with tempfile.TemporaryDirectory() as folder:
        result = sweep(config.model_copy(update={"sweep": swept}), Path(folder) / "study")
        return sum(part.stat().st_size for part in (Path(folder) / "study" / "points").iterdir()) / result.runs


if __name__ == "__main__":
    main()
