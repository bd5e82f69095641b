"""Plant steps are as fine as the standard errors of the numbers need."""

import jax.numpy as jnp
import numpy as np
import pytest
from small_study import rigid_study
from trace_segment import cut

from jaxbl.chain import PlantState, plant_trajectory
from jaxbl.config import prepare, read_config
from jaxbl.estimation.free_parameters import make_free_parameters
from jaxbl.estimation.intervals import spread
from jaxbl.estimation.plant_steps import refine_steps
from jaxbl.estimation.trajectory import fit

PERIOD, SAMPLES = 2e-2, 400
PATHS = ["drive.motor_inertia", "drive.motor_viscous", "effects.load.gravity.torque"]
TRUE = [0.05, 0.15, 5.0]


def prepare_pendulum(substeps):
    """A pendulum that swings with 1.6 Hz, at 50 Hz."""
    effects = [{"kind": "load.gravity", "torque": TRUE[2], "phase": 0.0}]
    changes = {"run.sample_period": PERIOD, "run.substeps": substeps, "run.precision": "float64"}
    return prepare(read_config(rigid_study(changes, effects=effects)))


def refine(noise, made_with, steps=2):
    """Fit a swing that was simulated with `made_with` steps with `steps`, before and after these are refined."""
    truth, experiment = prepare_pendulum(made_with), prepare_pendulum(steps)
    torque = 2.0 * np.sign(np.sin(3.0 * PERIOD * np.arange(SAMPLES)))
    start = PlantState({"motor": jnp.asarray(0.5)}, {"motor": jnp.asarray(0.0)}, ((),))
    states = plant_trajectory(truth, start, jnp.asarray(torque))
    readings = {"motor": np.asarray(states.position["motor"]) + noise * np.random.default_rng(1).standard_normal(SAMPLES)}
    windows = cut(torque, readings, PERIOD, states, {"motor": noise}, 100)
    free = make_free_parameters(experiment, PATHS, 1.0)

    first = fit(experiment, free, windows, np.zeros(3))
    _, refined, errors, steps = refine_steps(experiment, free, windows, first)
    deviation = np.sqrt(np.diag(spread(refined).with_error(*errors).covariance))
    away = [
        np.array([one.value(x) for one, x in zip(free, np.asarray(each.theta), strict=True)]) for each in (first, refined)
    ]
    return [np.max(np.abs(np.log(values / TRUE)) / deviation) for values in away], steps, first, refined


def test_fine_readings_need_fine_steps():
    (before, after), steps, first, refined = refine(noise=1e-4, made_with=400)
    assert before > 10.0 and after < 3.0
    assert steps > 20
    assert float(refined.cost) < 0.9 * float(first.cost)


def test_coarse_readings_keep_the_steps_of_the_study():
    (before, after), steps, first, refined = refine(noise=0.05, made_with=400)
    assert steps == 2 and refined is first
    assert before == after < 3.0


@pytest.mark.parametrize("noise", [1e-6, 1e-5])
def test_a_simulation_with_the_steps_of_the_study_is_best_with_them(noise):
    (before, _), steps, first, refined = refine(noise, made_with=2)
    assert steps == 2 and refined is first and before < 4.0
