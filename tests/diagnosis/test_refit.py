"""Refined numbers are those of least prediction errors: against an optimiser that knows nothing of the linearisation."""

import jax.numpy as jnp
import numpy as np
import pytest
from hidden_log import FRICTION, nominal_study, simulate_multisine_log
from scipy.optimize import minimize

from jaxbl.diagnosis.diagnosis_task import read_diagnosis_task
from jaxbl.diagnosis.effect_search import paths_of, with_numbers
from jaxbl.diagnosis.linearised_model import Linear
from jaxbl.diagnosis.neutral_effects import complete
from jaxbl.diagnosis.refit import _Refiner, leave_quarters_out, refined
from jaxbl.drive.plant import PlantState
from jaxbl.identification.compilation import jit
from jaxbl.identification.free_parameters import make_free_parameters, set_free_parameters
from jaxbl.identification.logs import default_paths, on_record
from jaxbl.identification.regression import settled
from jaxbl.identification.segments import segments_of
from jaxbl.simulate import plant_trajectory, with_effects

NAME = "motor.coulomb_friction"


@pytest.fixture(scope="module")
def refit_inputs(tmp_path_factory):
    log = tmp_path_factory.mktemp("log") / "axis.csv"
    simulate_multisine_log().write(log)
    task = read_diagnosis_task(log, nominal_study())
    bare = on_record(task.config, task.record)
    experiment = with_numbers(complete(bare), {NAME: {"torque": 1.1 * FRICTION["torque"]}})
    torque = float(np.std(task.record.torque))
    free_parameters = make_free_parameters(bare, default_paths(task.config, bare), torque)
    free = (*free_parameters, *make_free_parameters(experiment, paths_of([NAME]), torque))
    width = np.array([*[task.config.uncertainty.relative] * len(free_parameters), 3.0])
    return experiment, free, width, segments_of(task.record, bare.sides)


def test_prediction_errors_are_least(refit_inputs):
    """A search without derivatives that begins elsewhere finds none smaller of the same predictor."""
    experiment, free, width, segments = refit_inputs
    (segment,) = segments
    # without the effects that do nothing
    plain = with_effects(experiment, tuple(effect for effect in experiment.effects if effect.name == NAME))
    fit = _Refiner(experiment, free, width, segments).run(np.zeros(len(free)))
    gain = {"motor": Linear.gain_of(fit.predictor.smoothness, segment.period)[0]}
    torque, reading = jnp.asarray(segment.torque), jnp.asarray(segment.readings["motor"])

    @jit
    def predict(inputs):
        candidate = set_free_parameters(plain, free, inputs[2:] * 0.01)
        start = PlantState({"motor": inputs[0]}, {"motor": inputs[1]}, settled(candidate, torque[0]))
        return plant_trajectory(candidate, start, torque, 0.0, {"motor": reading}, gain).position["motor"]

    def cost(inputs):
        errors = np.asarray(reading - predict(jnp.asarray(inputs)))
        return len(errors) * np.log(np.sum(errors**2)) + np.sum((inputs[2:] * 0.01 / width) ** 2)

    optimum = np.concatenate([fit.start[0], 100.0 * fit.theta])
    options = {"xatol": 1e-5, "fatol": 1e-4, "maxfev": 2000, "adaptive": True}
    best = minimize(cost, optimum + np.array([1e-6, 1e-4, 0.3, -0.3, 0.3]), method="Nelder-Mead", options=options)
    # twice the logarithm of the likelihood: far less than what the noise leaves open
    assert cost(optimum) - best.fun < 0.1
    assert cost(optimum) < cost(optimum + np.array([0.0, 0.0, 0.1, -0.1, 0.1])) - 1.0


def test_deviations_are_those_of_repetitions(tmp_path):
    """The friction's error over many noise realisations, against what is said of each."""
    values, deviations = [], []
    for seed in range(12):
        log = tmp_path / f"{seed}.csv"
        simulate_multisine_log(seed=seed).write(log)
        task = read_diagnosis_task(log, nominal_study())
        bare = on_record(task.config, task.record)
        experiment = with_numbers(complete(bare), {NAME: {"torque": FRICTION["torque"]}})
        torque = float(np.std(task.record.torque))
        free_parameters = make_free_parameters(bare, default_paths(task.config, bare), torque)
        free = (*free_parameters, *make_free_parameters(experiment, paths_of([NAME]), torque))
        width = np.array([*[task.config.uncertainty.relative] * len(free_parameters), 3.0])
        fit = refined(experiment, free, np.zeros(len(free)), width, segments_of(task.record, bare.sides))
        values.append(fit.theta[-1])
        deviations.append(fit.deviation[-1])
    errors = np.array(values) / np.array(deviations)
    assert 0.6 < np.sqrt(np.mean(errors**2)) < 1.5
    assert np.max(np.abs(errors)) < 3.5


def test_numbers_under_which_the_predictor_diverges_are_not_taken(refit_inputs):
    """Errors that are not finite have no likelihood, and nothing is said of them."""
    experiment, free, width, segments = refit_inputs
    diverging = with_numbers(experiment, {"motor.viscous_friction": {"viscous": -5.0}})
    refiner = _Refiner(diverging, free, width, segments)
    theta = np.zeros(len(free))
    (path,) = refiner._path(theta, refiner.start(), [1e-11])
    assert not np.isfinite(path.smoothed["motor"].state[:, :2]).all()
    assert refiner.at(theta, refiner.start(), [1e-11]).cost == np.inf


def test_numbers_without_a_quarter_are_those_of_a_fit_to_the_rest():
    """Least squares in closed form: a first order is exact where errors are linear in the numbers."""
    random = np.random.default_rng(3)
    slopes, prior = random.standard_normal((400, 2, 3)), np.diag([0.0, 5.0, 50.0])
    truth = np.array([0.2, -0.1, 0.05])
    data = slopes @ truth + 0.3 * random.standard_normal((400, 2))

    def fit(rows):
        flat = slopes[rows].reshape(-1, 3)
        return np.linalg.solve(flat.T @ flat + prior, flat.T @ data[rows].ravel())

    best = fit(np.arange(400))
    # errors grow with the numbers
    changes = leave_quarters_out(slopes @ best - data, slopes, prior)
    for quarter, change in enumerate(changes):
        rest = np.delete(np.arange(400), slice(100 * quarter, 100 * (quarter + 1)))
        np.testing.assert_allclose(best + change, fit(rest), rtol=1e-9)
