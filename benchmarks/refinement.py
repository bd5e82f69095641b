"""Savings of boundary refinement: a refined study against the full grid of its finest level, in one run.

The refined study runs as `jaxbl sweep` runs it, in memory. The full grid is the same study without `refine`, with as many
values as the fine grid has, in the chunks that suit such a study. Unless `--full` is given only some of its chunks are run,
evenly spread, between rounds of the refined study; that of all is extrapolated from their mean. Compilation counts apart.

With `--full` all chunks are run, and the two are compared: values bit by bit, and the cells at the boundary that the
refined study has not simulated.

    python benchmarks/refinement.py
    python benchmarks/refinement.py --full
"""

import argparse
import itertools
import time
from pathlib import Path

import jax

jax.config.update("jax_num_cpu_devices", 2)

import numpy as np  # noqa: E402
import pandas as pd  # noqa: E402

from jaxbl.config import read_config  # noqa: E402
from jaxbl.sweeps.engine import Engine, Layout  # noqa: E402
from jaxbl.sweeps.sweep import sweep  # noqa: E402

STUDY = Path(__file__).parents[1] / "sweeps" / "gain_boundary.toml"


def full_grid(config):
    """The study of the fine grid."""
    data = config.to_dict()
    depth = data["sweep"].pop("refine")
    for axis in data["axes"]:
        if "num" in axis:
            axis["num"] = (axis["num"] - 1 << depth) + 1
    return read_config(data)


def count_missed(config, full, frame):
    """Cells at the boundary on the full grid, and those of them that have a corner which was not simulated."""
    paths = [axis.path for axis in config.axes]
    converged = full.sort_values(paths)["motor.converged"].to_numpy()
    shape = [full[path].nunique() for path in paths]
    keys = np.ravel_multi_index([np.searchsorted(np.unique(full[p]), frame[p]) for p in paths], shape)
    simulated = np.zeros(len(full), bool)
    simulated[keys] = True

    def corners(values):
        grid = values.reshape(shape)
        ends = (slice(None, -1), slice(1, None))
        return np.array([grid[corner] for corner in itertools.product(ends, repeat=len(shape))])

    boundary = corners(converged).any(axis=0) & ~corners(converged).all(axis=0)
    return int(boundary.sum()), int((boundary & ~corners(simulated).all(axis=0)).sum())


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path, default=STUDY, help="a study with sweep.refine")
    parser.add_argument("--chunks", type=int, default=6, help="chunks of the full grid that are run")
    parser.add_argument("--rounds", type=int, default=3, help="rounds of the refined study; the mean counts")
    parser.add_argument("--full", action="store_true", help="run the whole full grid and compare")
    parser.add_argument("--layouts", type=int, nargs="*", default=[], help="also time chunks of so many points")
    options = parser.parse_args()
    config = read_config(options.config)
    engine = Engine(full_grid(config))
    chunks = list(engine.chunks())
    chosen = np.unique(np.linspace(0, len(chunks) - 1, len(chunks) if options.full else options.chunks).astype(int))
    engine.run(chunks[0])  # compiles
    engine.cost["run_seconds"] = 0.0
    parts, rounds = [], []
    for i in range(options.rounds):
        start = time.perf_counter()
        result = sweep(config)
        rounds.append({"wall": time.perf_counter() - start, **result.cost})
        parts += [engine.run(chunks[k]) for k in chosen[i :: options.rounds]]
    whole_run = engine.cost["run_seconds"] / len(chosen) * len(chunks)
    points = len(engine.points)
    print(f"points: {len(result.frame)} of {points} ({100 * len(result.frame) / points:.2f} %)")
    # everything but compilation: choosing points, frames
    refined_run = np.mean([r["wall"] - r["compile_seconds"] for r in rounds])
    compile_seconds = np.mean([r["compile_seconds"] for r in rounds])
    kind = "" if options.full else f", from {len(chosen)} of {len(chunks)} chunks of {engine.layout.points}"
    print(f"full grid: {whole_run:.1f} s{kind}; compilation {engine.cost['compile_seconds']:.1f} s")
    print(
        f"refined:   {refined_run:.2f} s, of which in the program {np.mean([r['run_seconds'] for r in rounds]):.2f}; "
        f"compilation {compile_seconds:.1f} s"
    )
    together = (whole_run + engine.cost["compile_seconds"]) / (refined_run + compile_seconds)
    print(f"ratio: {whole_run / refined_run:.1f}; with compilation {together:.1f}")
    if options.full:
        full = pd.concat(parts, ignore_index=True)
        paths = [axis.path for axis in config.axes]
        same = result.frame.merge(full, on=paths, suffixes=("", "/full"))
        print(f"points found again on the full grid: {len(same)}")
        for name in ("motor.converged", "motor.velocity_rmse"):
            equal = (same[name] == same[f"{name}/full"]) | (same[name].isna() & same[f"{name}/full"].isna())
            print(f"{name}: {int((~equal).sum())} differ")
        print("cells at the boundary: {}, with a corner not simulated: {}".format(*count_missed(config, full, result.frame)))
    for size in options.layouts:
        other = Engine(config, Layout(1, size))
        (chunk, *_) = other.split_points(0, other.points.coarse_points(np.arange(other.points.coarse_size)))
        other.run(chunk)
        seconds = []
        for _ in range(4):
            before = other.cost["run_seconds"]
            other.run(chunk)
            seconds.append(other.cost["run_seconds"] - before)
        print(f"chunk of {size}: {min(seconds):.3f} s, {1e9 * min(seconds) / size / config.run.steps:.1f} ns a lane-step")


if __name__ == "__main__":
    main()
