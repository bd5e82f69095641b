"""Refined numbers are those of least prediction errors: against an optimiser that knows nothing of the linearisation."""

import jax.numpy as jnp
import numpy as np
import pytest
from hidden_log import FRICTION, nominal_study, simulate_multisine_log
from scipy.optimize import minimize

from jaxbl.chain import plant_trajectory, with_effects
from jaxbl.diagnosis.diagnosis_task import read_diagnosis_task
from jaxbl.diagnosis.linearised_model import find_gains
from jaxbl.diagnosis.refit import ModelFits, _Fit, leave_quarters_out
from jaxbl.drive.plant import PlantState
from jaxbl.estimation.free_parameters import make_free_parameters, set_free_parameters
from jaxbl.estimation.logs import default_paths, on_record
from jaxbl.estimation.regression import settle_states
from jaxbl.estimation.segments import segments_of
from jaxbl.fused.compilation import jit

NAME = "motor.coulomb_friction"


def prepare_fits(log):
    task = read_diagnosis_task(log, nominal_study())
    bare = on_record(task.config, task.record)
    free = make_free_parameters(bare, default_paths(task.config, bare), float(np.std(task.record.torque)))
    prior = np.full(len(free), task.config.uncertainty.relative)
    return ModelFits(bare, free, prior, segments_of(task.record, bare.sides))


@pytest.fixture(scope="module")
def fits(tmp_path_factory):
    log = tmp_path_factory.mktemp("log") / "axis.csv"
    simulate_multisine_log().write(log)
    return prepare_fits(log)


def test_prediction_errors_are_least(fits):
    """A search without derivatives that begins elsewhere finds none smaller of the same predictor."""
    (segment,) = fits.segments
    fit = _Fit(fits, {NAME: {"torque": 1.1 * FRICTION["torque"]}})
    found = fit.run(np.zeros(len(fits.free)), None)
    # without the effects that do nothing
    plain = with_effects(fit.experiment, tuple(effect for effect in fit.experiment.effects if effect.name == NAME))
    gain = {"motor": find_gains(found.predictor.smoothness, segment.period)[0]}
    torque, reading = jnp.asarray(segment.torque), jnp.asarray(segment.readings["motor"])

    @jit
    def predict(inputs):
        candidate = set_free_parameters(plain, fit.free, inputs[2:] * 0.01)
        start = PlantState({"motor": inputs[0]}, {"motor": inputs[1]}, settle_states(candidate, torque[0]))
        return plant_trajectory(candidate, start, torque, 0.0, {"motor": reading}, gain).position["motor"]

    def cost(inputs):
        errors = np.asarray(reading - predict(jnp.asarray(inputs)))
        return len(errors) * np.log(np.sum(errors**2)) + np.sum((inputs[2:] * 0.01 / fit.width) ** 2)

    optimum = np.concatenate([found.start[0], 100.0 * found.theta])
    options = {"xatol": 1e-5, "fatol": 1e-4, "maxfev": 2000, "adaptive": True}
    best = minimize(cost, optimum + np.array([1e-6, 1e-4, 0.3, -0.3, 0.3]), method="Nelder-Mead", options=options)
    # twice the logarithm of the likelihood: far less than what the noise leaves open
    assert cost(optimum) - best.fun < 0.1
    assert cost(optimum) < cost(optimum + np.array([0.0, 0.0, 0.1, -0.1, 0.1])) - 1.0


def test_deviations_are_those_of_repetitions(tmp_path):
    """The friction's error over many noise realisations, against what is said of each."""
    errors = []
    for seed in range(12):
        log = tmp_path / f"{seed}.csv"
        simulate_multisine_log(seed=seed).write(log)
        fits = prepare_fits(log)
        fitted = fits.fit({NAME: {"torque": FRICTION["torque"]}}, np.zeros(len(fits.free)))
        error = fitted.numbers[NAME]["torque"] - FRICTION["torque"]
        errors.append(error / fitted.errors()[f"effects.{NAME}.torque"])
    assert 0.6 < np.sqrt(np.mean(np.square(errors))) < 1.5
    assert np.max(np.abs(errors)) < 3.5


def test_numbers_under_which_the_predictor_diverges_are_not_taken(fits):
    """Errors that are not finite have no likelihood, and nothing is said of them."""
    # the model's viscous friction is known: its error is an effect like any other
    known = ModelFits(fits.nominal, [], np.zeros(0), fits.segments)
    fit = _Fit(known, {"motor.viscous_friction": {"viscous": -5.0}})
    start = [np.array([float(segment.smoothed["motor"].state[0][i]) for i in (0, 1)]) for segment in fits.segments]
    (path,) = fit._path(fit.added, start, [1e-11])
    assert not np.isfinite(path.smoothed["motor"].state[:, :2]).all()
    assert fit.at(fit.added, start, [1e-11]).cost == np.inf


def test_the_error_of_a_number_is_what_the_number_is_off_by(fits):
    """The log tells their sum; what is known of the number, and how far it may be off, tells the two apart."""
    name = "motor.inertia"
    both = fits.fit({NAME: {"torque": FRICTION["torque"]}, name: {"inertia": 0.0}}, np.zeros(len(fits.free)))
    one = fits.fit({NAME: {"torque": FRICTION["torque"]}}, np.zeros(len(fits.free)))
    i = next(i for i, number in enumerate(fits.free) if number.path == "drive.motor_inertia")
    number, off = fits.free[i], both.numbers[name]["inertia"]
    assert both.theta[i] == 0.0 and number.nominal + off == pytest.approx(number.value(one.theta[i]), rel=1e-3)
    # the sum is known as well as the number alone is
    slope = both.free[-1].slope(0.0)
    variance = [both.covariance[i, i] * number.scale**2, both.covariance[-1, -1] * slope**2]
    together = sum(variance) + 2.0 * both.covariance[i, -1] * number.scale * slope
    assert together == pytest.approx(number.slope(one.theta[i]) ** 2 * one.covariance[i, i], rel=0.1)
    assert np.sqrt(variance[0]) == pytest.approx(fits.prior[i] * number.scale)


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
        # sixteen blocks of 25 rows: 0 1 2 3, 1 2 3 0, 2 3 0 1, 3 0 1 2
        block = np.arange(400) // 25
        rest = np.flatnonzero((block + block // 4) % 4 != quarter)
        np.testing.assert_allclose(best + change, fit(rest), rtol=1e-9)


@pytest.mark.parametrize("torque", [1e4, -0.3])
def test_a_fit_with_more_effects_never_ends_above_the_one_without(fits, torque):
    """However far from what the log shows it begins."""
    less = fits.fit({NAME: {"torque": FRICTION["torque"]}}, np.zeros(len(fits.free)))
    more = {NAME: less.numbers[NAME], "motor.constant_torque": {"torque": torque}}
    found = fits.fit(more, less.theta[: len(fits.free)], less, ("motor.constant_torque",))
    assert found.end.cost <= less.end.cost
    assert abs(found.numbers["motor.constant_torque"]["torque"]) < 0.01 * FRICTION["torque"]
