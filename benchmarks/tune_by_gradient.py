"""Bandwidths of extended-state observers by gradients of the engine's functions, beside the search of `jaxbl tune`.

    python benchmarks/tune_by_gradient.py [--studies 10]

Drawn drives with a gap. Both see two noise sequences; four others judge: mean over sides of the logarithm of the rms
velocity error. The gradient minimises the same mean by L-BFGS-B from 200 rad/s.
"""

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

import jaxbl

jax.config.update("jax_enable_x64", True)
SIDES, SEEDS, JUDGES = ("motor", "load"), (0, 1), (10, 11, 12, 13)


def draw_study(rng: np.random.Generator) -> dict:
    """A study of a drawn drive, in SI units."""
    drive = {"kind": "two_inertia", "motor_inertia": 0.05 * 10.0 ** rng.uniform(-0.3, 0.3), "motor_viscous": 0.15,
             "load_inertia": 1.0, "load_viscous": 2.0, "gear_ratio": 5.0}  # fmt: skip
    return {
        "drive": drive,
        "transmission": {"law": "dead_zone", "stiffness": 60.0, "half_gap": rng.uniform(0.01, 0.08)},
        "excitation": {"kind": "sine", "amplitude": 2.0, "frequency": rng.uniform(0.5, 2.0)},
        "encoders": {"noise": 10.0 ** rng.uniform(-5.0, -3.5)},
        "observer": {"kind": "extended_state"} | {side: {"bandwidth": 200.0} for side in SIDES},
        "run": {"duration": 2.0, "substeps": 4},
        "sweep": {"seeds": len(SEEDS)},
    }


@jax.jit
@jax.value_and_grad
def log_error(logarithms, experiment, seed):
    bandwidths = {f"observer.{side}.bandwidth": jnp.exp(logarithms[i]) for i, side in enumerate(SIDES)}
    found = jaxbl.metrics(jaxbl.with_values(experiment, bandwidths), seed, names=("velocity_rmse",))
    return sum(jnp.log(found[f"{side}.velocity_rmse"]) for side in SIDES) / len(SIDES)


def mean_error(logarithms, experiment, seeds):
    values, slopes = zip(*(log_error(jnp.asarray(logarithms), experiment, seed) for seed in seeds), strict=True)
    return float(np.mean(values)), np.mean(slopes, axis=0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--studies", type=int, default=10)
    rng = np.random.default_rng(0)
    for i in range(parser.parse_args().studies):
        study = draw_study(rng)
        experiment, start = jaxbl.experiment(study), time.perf_counter()
        sides = jaxbl.tune(study | {"tune": {"observers": ["extended_state"]}}).summary["points"][0]["sides"]
        searched, middle = (
            [sides[side]["kinds"]["extended_state"]["gains"]["bandwidth"] for side in SIDES],
            time.perf_counter(),
        )
        descent = minimize(
            mean_error, np.log([200.0, 200.0]), (experiment, SEEDS), method="L-BFGS-B", jac=True, bounds=[(0.0, 9.0)] * 2
        )
        end = time.perf_counter()
        errors = [np.exp(mean_error(point, experiment, JUDGES)[0]) for point in (np.log(searched), descent.x)]
        print(
            f"{i}: tune {middle - start:.1f} s {np.round(searched, 1)} error {errors[0]:.6g}; gradient {end - middle:.1f} s "
            f"{np.round(np.exp(descent.x), 1)} error {errors[1]:.6g}",
            flush=True,
        )


if __name__ == "__main__":
    main()
