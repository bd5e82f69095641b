"""How two models are compared, block by block of a log, and which effects are withdrawn."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxbl.diagnosis.blocks import standard_errors_better, standard_errors_between, take_folds
from jaxbl.diagnosis.choice import Choice, Chosen
from jaxbl.diagnosis.fitted_model import FittedModel, special_case
from jaxbl.diagnosis.reference_log import Comparison
from jaxbl.drive import make_effect

POSITION, TORQUE = 1e-4, 1e-2


def compare_errors(position, torque, *, gain=1.0, floor=TORQUE):
    """A model whose errors are so many times the noise; `floor`: noise of the torques by its own inertia, N m."""
    samples = {"theta_e": POSITION * position, "torque_motor": gain * TORQUE * torque}
    return Comparison({name: float(np.std(sample)) for name, sample in samples.items()}, {"motor": floor}, samples, gain, {})


LOG = SimpleNamespace(noise_floor=lambda torques: {"theta_e": POSITION, "torque_motor": torques["motor"]})


@pytest.fixture
def draw_errors():
    random = np.random.default_rng(0)
    return lambda size: size * random.standard_normal(1600)


def test_a_ripple_that_only_the_torque_shows_counts(draw_errors):
    # windows of the position go wrong by something else, which is far larger
    control, better = (
        compare_errors(draw_errors(500.0), draw_errors(4.0)),
        compare_errors(draw_errors(500.0), draw_errors(2.0)),
    )
    assert standard_errors_better(LOG, control, better) > 5.0
    assert standard_errors_better(LOG, better, control) < -2.0
    # or one channel against the other: all together
    assert (
        abs(
            standard_errors_better(
                LOG, compare_errors(draw_errors(4.0), draw_errors(2.0)), compare_errors(draw_errors(2.0), draw_errors(4.0))
            )
        )
        < 3.0
    )


def test_one_factor_on_all_torques_and_the_input_makes_no_model_better(draw_errors):
    position, torque = draw_errors(3.0), draw_errors(3.0)
    scaled = compare_errors(position, torque, gain=0.6, floor=0.6 * TORQUE)
    assert standard_errors_better(LOG, compare_errors(position, torque), scaled) == pytest.approx(0.0, abs=1e-9)
    # nor does a smaller inertia, by which readings make less noise of torque
    assert (
        standard_errors_better(LOG, compare_errors(position, torque, floor=0.6 * TORQUE), compare_errors(position, torque))
        == 0.0
    )


def test_blocks_in_which_both_models_err_by_less_than_noise_count_for_nothing():
    """A drive that stands still for a while: one model leaves exactly nothing there, the other a tenth of the noise."""
    moving = np.linspace(20.0, 60.0, 13)
    control, better = np.append(moving, np.zeros(3)), np.append(0.25 * moving, np.full(3, 0.01))
    assert standard_errors_between(control, better) > 5.0
    assert standard_errors_between(better, control) < -5.0
    # few blocks have nearly all of the errors
    few = np.append(np.full(15, 4.0), 1e6)
    assert standard_errors_between(few, few / 3.0) > 5.0
    assert standard_errors_between(np.full(16, np.inf), moving[:1].repeat(16)) == np.inf


def choose_effects(monkeypatch, errors, shares, gain):
    """Return the model that blocks leave, and the history; `gain(name, names)` is the gain of each, `shares` its torque."""
    choice = Choice.__new__(Choice)
    choice.before, choice.noise, choice.history = (
        compare_errors(errors(9.0), errors(9.0)),
        LOG.noise_floor({"motor": TORQUE}),
        [],
    )
    compared = compare_errors(errors(1.0), errors(1.0))
    fit = lambda numbers, theta: SimpleNamespace(experiment=None, names=tuple(numbers), share=shares.get, numbers={})  # noqa: E731
    monkeypatch.setattr(Choice, "compare", lambda self, fitted: compared)
    monkeypatch.setattr(Choice, "_rival", lambda *_: None)
    monkeypatch.setattr(Choice, "_gain", lambda self, search, model, after, name: (gain(name, model.names), 7.0))
    result = SimpleNamespace(model=SimpleNamespace(names=list(shares), numbers=dict.fromkeys(shares), theta=None))
    search = SimpleNamespace(without=lambda found, names: found, fit=fit, period=1e-3)
    return choice._withdraw(search, result), choice.history  # type: ignore[arg-type]


def test_a_wave_in_time_has_to_go_on_in_another_part(monkeypatch, draw_errors):
    shares = {"load.periodic_disturbance": 0.002, "motor.cogging": 0.01}
    chosen, history = choose_effects(monkeypatch, draw_errors, shares, lambda name, names: 1.4)
    assert chosen.withdrawn == ["load.periodic_disturbance"] and chosen.fitted.names == ("motor.cogging",)
    # every model that was tried is in the history, with what it loses
    assert [(step.tried, step.kept) for step in history] == [
        ("remove load.periodic_disturbance", True), ("remove motor.cogging", False), ("remove motor.cogging", False),
    ]  # fmt: skip
    assert all(step.nats == -7.0 and step.standard_errors == -1.4 and "asked" in step.why for step in history)


def test_of_needless_effects_the_one_of_least_torque_goes_first(monkeypatch, draw_errors):
    """Beside a delay that stands for it a ripple seems needless."""
    shares = {"actuator.delay": 0.01, "motor.cogging": 0.2, "motor.coulomb_friction": 0.9}

    def gain_of_effect(name, names):
        alone = "actuator.delay" not in names
        return {"actuator.delay": -1.0, "motor.cogging": 3.0 if alone else -2.0, "motor.coulomb_friction": 9.0}[name]

    chosen, _ = choose_effects(monkeypatch, draw_errors, shares, gain_of_effect)
    assert chosen.withdrawn == ["actuator.delay"]
    assert chosen.fitted.names == ("motor.cogging", "motor.coulomb_friction")


def test_each_quarter_is_compared_by_the_numbers_that_were_fitted_without_it(monkeypatch):
    log = SimpleNamespace(compare=lambda number: compare_errors(np.full(160, float(number)), np.full(8, float(number))))
    choice = Choice.__new__(Choice)
    choice.log = log
    fitted = FittedModel((), 9.0, (), np.zeros(1), None, None, None, np.arange(4.0))  # type: ignore[arg-type]
    monkeypatch.setattr(FittedModel, "move_by", lambda self, change: change)
    compared = choice.compare(fitted)
    np.testing.assert_allclose(compared.samples["theta_e"] / POSITION, np.repeat(np.arange(4.0), 40))
    np.testing.assert_allclose(compared.samples["torque_motor"] / TORQUE, np.repeat(np.arange(4.0), 2))
    assert compared.errors["theta_e"] == pytest.approx(POSITION * np.sqrt(14.0 / 4.0))
    # the torques that are missing stay those of all of it
    assert take_folds(log.compare(5), [log.compare(1)]).torques == log.compare(5).torques


@pytest.mark.parametrize(("error", "apart"), [(0.02, True), (0.2, False)])
def test_an_effect_may_be_its_special_case_where_the_number_that_parts_them_is_open(error, apart):
    name = "motor.presliding_friction"
    fitted = SimpleNamespace(
        experiment=SimpleNamespace(effects=(make_effect(name, torque=0.1, length=0.1),)),
        errors=lambda: {f"effects.{name}.torque": 1e-3, f"effects.{name}.length": error},
    )
    assert special_case(fitted, name) == (None if apart else "motor.coulomb_friction")  # type: ignore[arg-type]


@pytest.mark.parametrize(("noise", "apart"), [(0.05, True), (0.2, False)])
def test_a_way_shorter_than_the_noise_of_its_position_is_not_known(noise, apart):
    name = "load.presliding_friction"
    fitted = SimpleNamespace(
        experiment=SimpleNamespace(effects=(make_effect(name, torque=0.1, length=0.1),)),
        errors=lambda: {f"effects.{name}.length": 1e-3},
    )
    result = special_case(fitted, name, {"motor": 1.0, "load": noise})  # type: ignore[arg-type]
    assert result == (None if apart else "load.coulomb_friction")


@pytest.mark.parametrize(("z", "named"), [(-1.5, False), (-0.5, True)])
def test_a_special_case_is_named_where_blocks_do_not_part_it_either(z, named, monkeypatch):
    general, plain = "motor.presliding_friction", "motor.coulomb_friction"
    effect = make_effect(general, torque=0.1, length=0.1)
    fitted = SimpleNamespace(
        names=(general,), numbers={general: {"torque": 0.1, "length": 0.1}}, theta=np.zeros(1), log_likelihood=0.0,
        experiment=SimpleNamespace(effects=(effect,)), errors=lambda: {f"effects.{general}.length": 0.2},
    )  # fmt: skip
    less = lambda numbers, theta: SimpleNamespace(numbers=numbers, experiment=0, log_likelihood=-1.0)  # noqa: E731
    for name, value in (("standard_errors_better", lambda *_: z), ("_rename", lambda *_: None)):
        monkeypatch.setattr(f"jaxbl.diagnosis.choice.{name}", value)
    monkeypatch.setattr("jaxbl.diagnosis.choice.is_worse", lambda *_: False)
    choice = Choice.__new__(Choice)
    choice.setup, choice.before, choice.noise, choice.history = SimpleNamespace(prior=[0.02]), None, {}, []  # type: ignore[assignment]
    choice.log = SimpleNamespace(noise={"motor": 1e-3})  # type: ignore[assignment]
    monkeypatch.setattr(Choice, "compare", lambda *_: "compared")
    monkeypatch.setattr(Choice, "_gain", lambda *_: (7.0, 1.0))
    monkeypatch.setattr(Choice, "_rival", lambda *_: None)
    before = Chosen(SimpleNamespace(lacking=[plain], fit=less), None, fitted, "general", [], {general: 9.0})  # type: ignore[arg-type]
    chosen = choice._simplify(before, general)
    assert (chosen is not before) == named and [step.kept for step in choice.history] == [named]
    if named:
        assert chosen.fitted.numbers == {plain: {"torque": 0.1}} and chosen.gains == {plain: 7.0}
