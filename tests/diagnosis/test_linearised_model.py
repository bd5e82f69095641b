"""The linearised model: its columns are what changes of numbers and effects do to the prediction errors."""

import dataclasses
import functools
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import numpy as np
import pytest
from hidden_log import simulate_study
from small_study import rigid_study, small_study
from trace_segment import make_segment

from jaxbl.config import prepare, read_config
from jaxbl.diagnosis import linearised_model as module
from jaxbl.diagnosis.candidates import Forces, MotionTorques, columns_of, variants_of
from jaxbl.diagnosis.linearised_model import Linear, find_gains
from jaxbl.drive.effects import EFFECTS, Scales, make_effect
from jaxbl.drive.parameters import as_arrays
from jaxbl.estimation.free_parameters import make_free_parameters
from jaxbl.estimation.smoother import Smoothed

OBSERVER = {"motor": {"lambda": 20.0, "alpha": 400.0}, "load": {"lambda": 3.0, "alpha": 20.0}}
SHAFT = {"law": "linear_shaft", "stiffness": 60.0}
PATHS = {1: ["drive.motor_inertia", "drive.motor_viscous"], 2: ["drive.load_inertia", "transmission.stiffness"]}


@functools.cache
def simulate_segment(sides):
    """Return an experiment, and the segment of a log of it."""
    settings = {"run.duration": 2.0, "run.substeps": 5}
    excitation = {"kind": "multisine", "amplitude": 5.0 if sides == 2 else 1.0, "frequency": 0.7}
    if sides == 2:
        data = small_study(settings, excitation=excitation, transmission=SHAFT, observer=OBSERVER)
    else:
        data = rigid_study(settings, excitation=excitation, observer={"motor": OBSERVER["motor"]})
    return prepare(read_config(data)), make_segment(simulate_study(data, seed=8))


def linearise(sides, change=lambda e: e, theta=0.0, disturbed=0.0, idle=0):
    """Linearise the model along a log, and `idle` times along the same without an input."""
    experiment, segment = simulate_segment(sides)
    free = make_free_parameters(experiment, PATHS[sides], 1.0)
    rng, smoothed = np.random.default_rng(3), {}
    for side, motion in segment.smoothed.items():
        wave = disturbed * np.cumsum(rng.standard_normal((len(segment), 3)), axis=0)
        smoothed[side] = motion._replace(state=motion.state + wave * np.array([1e-7, 1e-6, 1e-5]))
    segment = dataclasses.replace(segment, smoothed=smoothed)
    point = np.full(len(free), theta)
    segments = [segment, *([dataclasses.replace(segment, torque=np.zeros(len(segment)))] * idle)]
    return Linear(change(experiment), free, point, np.full(len(free), 0.02), segments)


@pytest.fixture(scope="module")
def geared_model():
    """The model of two sides at its nominal numbers, for tests that change nothing of it."""
    return linearise(2)


def prediction_errors(model, forces=None):
    """Prediction errors over the noise, initial states eliminated: constant, own numbers, forces."""
    predicted = model.steps[0].errors(find_gains([1e-6] * len(model.sides), model.period), forces or Forces([]))
    flat = predicted.reshape(-1, predicted.shape[2])
    basis = np.linalg.qr(flat[:, -model.states :])[0]
    remainder = flat[:, : -model.states]
    return remainder - basis @ (basis.T @ remainder)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("sides", [1, 2])
def test_errors_of_the_smoothed_motion_cancel(sides):
    plain, disturbed = (prediction_errors(linearise(sides, disturbed=x))[:, 0] for x in (0.0, 1.0))
    assert rms(disturbed - plain) < 1e-3 * rms(plain)


@pytest.mark.parametrize("sides", [1, 2])
def test_own_columns_are_derivatives(sides):
    step = 1e-4
    errors_above, errors_below = (prediction_errors(linearise(sides, theta=x))[:, 0] for x in (step, -step))
    columns = prediction_errors(linearise(sides))[:, 1 : 1 + len(PATHS[sides])]
    expected = (errors_above - errors_below) / (2.0 * step)
    assert rms(columns.sum(axis=1) - expected) < 1e-3 * rms(expected)


LOG = Scales(
    5.0, 1e-3, 10.0, 0.1, 0.3, 1.0, 0.2, travel=2.0, noise=1e-5, frequencies=(2.0,), waves=tuple(range(1, 41)), wave_count=40
)  # fmt: skip
SMALL_NUMBERS = {
    "motor.coulomb_friction": {"torque": 1e-3},
    "motor.viscous_friction": {"viscous": 1e-4},
    "motor.inertia": {"inertia": 1e-5},
    "load.constant_torque": {"torque": 1e-3},
    "load.gravity": {"torque": 1e-2, "phase": 0.3},
    "load.periodic_disturbance": {"amplitude": 1e-2, "frequency": 2.0, "phase": 0.4},
    "motor.cogging": {"amplitude": 1e-3, "harmonic": 8.0, "phase": 0.2},
    "motor.torque_ripple": {"amplitude": 1e-3, "harmonic": 4.0, "phase": -0.5},
    "transmission.damping": {"damping": 1e-4},
    "transmission.hardening": {"cubic_stiffness": 1.0},
    "transmission.eccentricity": {"amplitude": 1e-5, "harmonic": 2.0, "phase": 0.1},
    "actuator.gain_error": {"relative": 1e-3},
    "actuator.lag": {"time_constant": 1e-4},
}


@pytest.mark.parametrize("name", SMALL_NUMBERS)
def test_a_candidates_torque_does_what_the_effect_does(geared_model, name):
    """The effect in the simulated step, against its torque along the measured motion through the linear recursion."""
    effect = as_arrays(make_effect(name, **SMALL_NUMBERS[name]), float)

    def with_effect(experiment):
        return eqx.tree_at(lambda e: e.effects, experiment, (*experiment.effects, effect))

    columns = prediction_errors(geared_model, Forces(geared_model.signals[0].of([effect])))
    expected = prediction_errors(linearise(2, with_effect))[:, 0] - columns[:, 0]
    actual = columns[:, -1]
    assert rms(expected) > 0.0
    assert rms(actual - expected) < 0.03 * rms(expected)


def test_friction_under_load_of_one_inertia_follows_what_its_load_takes():
    gravity = as_arrays(make_effect("load.gravity", torque=0.5, phase=0.3), float)
    rubbing = as_arrays(make_effect("transmission.load_friction", coefficient=0.1), float)
    (loaded,) = linearise(1, lambda experiment: eqx.tree_at(lambda e: e.effects, experiment, (gravity,))).signals
    (torques,) = loaded.of([rubbing])
    position, direction = loaded.part.position["motor"], loaded.direction["motor"]
    expected = -0.1 * np.abs(0.5 * np.sin(position - 0.3)) * direction
    np.testing.assert_allclose(torques[0], expected[: loaded.samples], atol=1e-12)
    # without a torque on the load there is none
    assert not linearise(1).signals[0].of([rubbing])[0][0].any()


def test_a_lag_begins_with_what_had_lasted_or_at_rest(geared_model):
    (signals,), lag = geared_model.signals, as_arrays(make_effect("actuator.lag", time_constant=0.01), float)
    steps, torque = geared_model.period / 0.01, signals.part.torque[: signals.samples]
    settled, rested = (signals.of([lag], from_rest)[0][-1] for from_rest in (False, True))
    assert torque[0] != 0.0 and settled[0] == pytest.approx(0.0, abs=1e-12)
    # what the state at the first sample leaves until later
    decay = torque[0] * np.exp(-steps * np.arange(len(torque))) * -np.expm1(-steps) / steps
    np.testing.assert_allclose(settled - rested, decay, atol=1e-12)
    variants = variants_of(geared_model.experiment, ["actuator.lag", "actuator.saturation"], geared_model.scales)
    assert sorted({(variant.name, variant.from_rest) for variant in variants}) == [
        ("actuator.lag", False), ("actuator.lag", True), ("actuator.saturation", False)
    ]  # fmt: skip


def test_numbers_of_waves_are_those_of_the_effect(geared_model):
    """A wave's two columns make up the effect that its numbers describe."""
    signals = geared_model.signals[0]
    values = (0.3e-3, -0.4e-3)
    waves = (
        "load.gravity",
        "load.periodic_disturbance",
        "motor.cogging",
        "motor.torque_ripple",
        "transmission.eccentricity",
    )
    names = set()
    for variant in variants_of(geared_model.experiment, waves, lambda name: LOG):
        if variant.name in waves:
            (columns,) = columns_of([variant], signals)
            effect = as_arrays(make_effect(variant.name, **variant.numbers(values)), float)
            (expected,) = signals.of([effect])
            assert columns.keys() == expected.keys()
            for point, torque in expected.items():
                assert rms(np.tensordot(values, columns[point], 1) - torque) < 0.02 * rms(torque)
            names.add(variant.name)
    assert names == set(waves)


@pytest.mark.parametrize("sides", [1, 2])
def test_products_are_those_of_the_errors(sides):
    """Summed block by block, initial states eliminated, against a decomposition of all errors at once."""
    model = linearise(sides)
    predictor: Any = SimpleNamespace(smoothness=[1e-6] * sides, deviation=np.ones(sides))
    (alone,) = model.products((), predictor)
    columns = prediction_errors(model)
    assert alone.products == pytest.approx(columns.T @ columns, rel=1e-6, abs=1e-9 * np.max(alone.products))


def test_products_of_candidates_are_those_of_their_errors(geared_model):
    """Candidates are taken some at a time: those beside one another are the same as all at once."""
    model = geared_model
    variants = variants_of(model.experiment, list(SMALL_NUMBERS), lambda name: LOG)
    model_columns, smoothness = 1 + len(model.free), [1e-6] * 2
    noise = np.array([2e-5, 3e-5])
    models = model.products(variants, SimpleNamespace(smoothness=smoothness, deviation=noise))
    assert sum(variant.width for variant in variants) > 2 * module._TOGETHER
    forces = Forces(columns_of(variants, model.signals[0]))
    predicted = model.steps[0].errors(find_gains(smoothness, model.period), forces)
    gram = np.einsum("s,tsc,tsd->cd", noise**-2.0, predicted, predicted)
    expected = module._eliminate(gram, model.states)[0]
    size = np.sqrt(np.diag(expected))
    begin = end = model_columns
    assert [products.candidate for products in models[1:]] == variants
    for products in models:
        begin, end = end, end + len(products.scale) - products.shared_count
        point = np.array([*range(model_columns), *range(begin, end)])
        difference = (products.products - expected[np.ix_(point, point)]) / np.outer(size[point], size[point])
        assert np.max(np.abs(difference), where=np.isfinite(difference), initial=0.0) < 1e-9


@pytest.mark.parametrize("held", [False, True])
def test_torques_that_models_share_are_those_of_each(monkeypatch, held):
    """A second model along the log, whose numbers are others, with what the first one has left and from scratch."""
    if held:
        monkeypatch.setattr(Smoothed, "find_standstill", lambda self, period: np.arange(len(self.state)) % 500 < 100)
    first = linearise(2)
    names = [name for name in EFFECTS if EFFECTS[name].neutral() and not name.startswith("encoder")]
    variants = variants_of(first.experiment, names, lambda name: LOG)
    columns_of(variants, first.signals[0])
    model = linearise(2, theta=0.1)
    (signals,), segment = model.signals, first.signals[0].segment
    assert len(segment.torques) > 100
    shared = MotionTorques(model.experiment, signals.part, segment)
    for variant, shared_torques, own_torques in zip(
        variants, columns_of(variants, shared), columns_of(variants, signals), strict=True
    ):
        assert shared_torques.keys() == own_torques.keys()
        for point, torque in own_torques.items():
            np.testing.assert_allclose(
                shared_torques[point], torque, rtol=1e-9, atol=1e-12 * np.max(np.abs(torque)), err_msg=variant.name
            )


def test_a_candidate_may_act_in_one_part_only():
    model = linearise(1, idle=1)
    variants = variants_of(model.experiment, ["actuator.gain_error"], model.scales)
    driven_part, idle_part = model.choose(variants).coefficients
    assert np.isfinite(driven_part).all()
    assert len(driven_part) == len(idle_part)
    # one gain for both parts
    np.testing.assert_array_equal(driven_part[: -model.states], idle_part[: -model.states])


@pytest.mark.parametrize("growth", [0.0, 5.0, 10.0, 15.0, 20.0, 25.0])
def test_what_rounding_takes_is_known(growth):
    """Initial states whose influence grows e-fold `growth` times, eliminated from products and by a QR of the columns."""
    count, states = 2000, 4
    rng = np.random.default_rng(5)
    time = np.linspace(0.0, 1.0, count)[:, None]
    # what grows is one motion, which all states take part in
    state_columns = np.exp(growth * time) * rng.standard_normal(states) + rng.standard_normal((count, states))
    columns = np.concatenate([rng.standard_normal((count, 3)) + np.exp(growth * time), state_columns], axis=1)
    gram = columns.T @ columns
    basis = np.linalg.qr(state_columns / np.linalg.norm(state_columns, axis=0))[0]
    remainder = columns[:, :3] - basis @ (basis.T @ columns[:, :3])
    true = float(remainder[:, 0] @ remainder[:, 0])
    rest, _, loss_estimate = module._eliminate(gram, states)
    error = abs(rest[0, 0] - true)
    assert error < max(30.0 * loss_estimate, 1e-9 * true)
    assert loss_estimate < module._LOST or growth > 5.0
    assert loss_estimate > module._LOST or growth < 20.0


def test_a_gain_under_which_rounding_would_decide_is_left_out(monkeypatch):
    model = linearise(1)
    smoothness = model.best_predictor.smoothness
    assert np.isfinite(model.predictor(smoothness).squares).all()
    monkeypatch.setattr(module, "_LOST", 0.0)
    assert not np.isfinite(model.predictor(smoothness).squares).any()


def test_eccentricity_is_tried_once_a_turn_however_small_the_motion(geared_model):
    travel = float(np.ptp(np.asarray(geared_model.signals[0].part.position["load"])))
    least = int(np.floor(0.5 / travel)) + 1
    assert least < 10  # twice a motor turn, with a gear ratio of 5
    trials = (
        EFFECTS["transmission.eccentricity"].roles()["harmonic"].trials(geared_model.scales("transmission.eccentricity"))
    )
    assert tuple(trials) == (1.0, *(float(n) for n in range(max(least, 2), 9)), 10.0)


@pytest.mark.parametrize(("damping", "shown"), [(0.02, True), (0.16, True), (0.6, False), (0.9, False)])
def test_a_flexible_part_that_hardly_swings_is_none(geared_model, damping, shown):
    numbers = {"inertia": 0.01, "frequency": 5.0, "damping_ratio": damping}
    assert geared_model.shows("load.flexibility", numbers) == shown


@pytest.mark.parametrize(("part", "shown"), [(1e-3, True), (0.2, True), (0.5, False)])
def test_contacts_that_bend_over_the_motion_are_no_friction(geared_model, part, shown):
    spread = geared_model.scales("motor.presliding_friction").spread
    numbers = {"torque": 0.1, "length": part * spread, "breakaway_ratio": 1.0, "stribeck_velocity": 1.0, "damping": 0.0}
    assert geared_model.shows("motor.presliding_friction", numbers) == shown


def test_a_finer_law_adds_what_parts_it_from_the_plain_one(geared_model):
    plain = make_effect("motor.coulomb_friction", torque=0.1)
    speed = geared_model.scales(plain.name).speed
    finer = [
        make_effect("motor.stribeck_friction", torque=0.1, breakaway_torque=0.1 + more, stribeck_velocity=0.5 * speed)
        for more in (0.0, 0.01, 0.02)
    ]
    none, little, more = (geared_model.torque_share(effect, plain) for effect in finer)
    assert none < 1e-6 and more == pytest.approx(2.0 * little, rel=1e-6)
    assert little < geared_model.torque_share(finer[1]) / 5.0
