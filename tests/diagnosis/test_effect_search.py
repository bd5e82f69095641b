"""Effects hidden by the bench's own simulator are named; nothing is named where nothing or something unknown is hidden."""

import dataclasses
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from hidden.bristle import Axis, Drive, simulate
from hidden.cases import cases
from hidden_log import nominal_study, simulate_direct_drive, simulate_multisine_log

from jaxbl.diagnosis import effect_search
from jaxbl.diagnosis.candidates import NO_CANDIDATE, Candidate
from jaxbl.diagnosis.confidence import weigh
from jaxbl.diagnosis.effect_search import EffectSearch, _Proposal
from jaxbl.diagnosis.evidence import Products
from jaxbl.diagnosis.reference_log import ReferenceLog
from jaxbl.diagnosis.thresholds import LIMITS
from jaxbl.drive.effects import DELAY_SAMPLES
from jaxbl.estimation.free_parameters import make_free_parameters
from jaxbl.estimation.identify import read_identification_task
from jaxbl.estimation.logs import default_paths, on_record
from jaxbl.estimation.segments import segments_of

SEED = 21
_SIZES = {"torque", "drag", "inertia", "viscous", "relative", "amplitude", "damping", "half_gap", "limit", "time_constant"}


def run_search(case, tmp_path):
    case.log.write(tmp_path / "log.csv")
    return prepare_search(tmp_path / "log.csv", case.model).run()


def prepare_search(log, study):
    task = read_identification_task(log, study)
    nominal = on_record(task.config, task.record)
    free = make_free_parameters(nominal, default_paths(task.config, nominal), float(np.std(task.record.torque)))
    prior = [task.config.uncertainty.relative] * len(free)
    segments = segments_of(task.record, nominal.sides)
    bandwidth = dict.fromkeys(nominal.sides, 0.05 / task.record.sample_period)
    return EffectSearch(nominal, free, prior, ReferenceLog(segments, bandwidth))


def prepare_axis_search(axis, encoder_step, tmp_path):
    """Prepare a search on 4 s of an axis under a position controller."""
    time = 4e-3 * np.arange(1000)
    rate = 1.5 * np.cos(2.0 * np.pi * 0.35 * time) + 0.8 * np.cos(2.0 * np.pi * 0.62 * time)
    drive = Drive(4e-3, 6.0, 0.6, 3.0, 0.5, 2.0, motor_step=encoder_step)
    run = simulate(axis, drive, np.cumsum(rate) * 4e-3, rate, np.ones(len(time), bool))
    table = np.column_stack([time, run.command, run.readings[:, 0]])
    np.savetxt(tmp_path / "log.csv", table, "%.10g", ",", header="t,u,theta_e", comments="")
    return prepare_search(tmp_path / "log.csv", nominal_study(run={"sample_period": 4e-3}))


def test_a_candidate_that_cannot_be_simulated_is_left_out(tmp_path):
    """A dead time of more samples than a model has states for."""
    simulate_multisine_log().write(tmp_path / "axis.csv")
    with jax.enable_x64(True):
        search = prepare_search(tmp_path / "axis.csv", nominal_study())
        nominal = search.fits.fit({}, np.zeros(len(search.fits.prior)))
        delayed = {"actuator.delay": {"delay": 2e-3 * (DELAY_SAMPLES + 1)}}
        fitted = search.fits.fit(delayed, nominal.theta, nominal, tuple(delayed))
        assert search.gain(nominal, fitted)[:2] == (-np.inf, -np.inf)
        # a drive that no input moves can be simulated, and a fit leaves it
        fitted = search.fits.fit({"actuator.gain_error": {"relative": -1.0}}, nominal.theta, nominal)
        assert fitted.numbers["actuator.gain_error"]["relative"] > -0.9


@pytest.mark.parametrize("i", [1, 2, 3])
def test_a_hidden_effect_is_named_with_its_numbers(i, tmp_path):
    """An actuator's lag, drag on a rigid drive, and an inertia, on 1000 samples: one shape for the programs of the file."""
    case = cases(SEED, 4, "single", 2.0)[i]
    explanation = run_search(case, tmp_path)
    (name,) = case.hidden
    assert explanation.largest_gain < LIMITS.unknown and explanation.fitted.names == (name,)
    for key, value in case.truth["effects"][name].items():
        if key in _SIZES:
            # errors of nominal numbers are known no better than these are
            side, _, kind = name.partition(".")
            nominal = case.model["drive"].get(f"{side}_{key}", 1.0 if kind == "gain_error" else 0.0)
            open_to = 0.15 * abs(value) + 2.5 * case.conditions["uncertainty"] * nominal
            assert abs(explanation.fitted.numbers[name][key]) == pytest.approx(abs(value), abs=open_to)


def test_nothing_is_named_on_a_clean_machine(tmp_path):
    explanation = run_search(cases(SEED, 1, "none", 2.0)[0], tmp_path)
    assert explanation.largest_gain < LIMITS.unknown and explanation.fitted.names == ()


def test_what_no_effect_explains_is_said_to_be_unknown(tmp_path):
    explanation = run_search(cases(SEED, 1, "unknown", 1.0)[0], tmp_path)
    assert explanation.largest_gain > LIMITS.unknown


def test_a_log_with_a_pause_is_explained_in_parts(tmp_path):
    """Free functions have knots where there are no samples."""
    log = simulate_multisine_log()
    keep = (log.t < 1.2) | (log.t > 2.0)
    table = np.column_stack([log.t, log.u, log.theta_e])[keep]
    np.savetxt(tmp_path / "log.csv", table, "%.10g", ",", header="t,u,theta_e", comments="")
    effect_search = prepare_search(tmp_path / "log.csv", nominal_study())
    assert len(effect_search.log.segments) == 2
    explanation = effect_search.run()
    # friction that contains it explains as much, and is no alternative
    (finding,) = weigh(explanation)
    assert explanation.largest_gain < LIMITS.unknown and finding.effect == "motor.coulomb_friction"
    assert finding.confidence > 0.99 and finding.alternatives == ()
    # finer laws are fitted in its place, whatever a screening promises of them
    tried = {step.change: step.accepted for step in effect_search.history}
    assert tried["replace motor.coulomb_friction by motor.presliding_friction"] is False


HIDDEN = {
    "motor.presliding_friction": {"torque": 0.06, "length": 0.02},
    "motor.drifting_friction": {"torque": 0.04, "initial_torque": 0.08, "time_constant": 1.0},
    "motor.asymmetric_friction": {"viscous_difference": -0.01},
}


@pytest.mark.parametrize("name", HIDDEN)
def test_friction_beyond_coulombs_is_named_with_its_numbers(name, tmp_path):
    simulate_direct_drive(simulate_multisine_log().u[:1000], [{"kind": name} | HIDDEN[name]], 3e-5, 1).write(
        tmp_path / "log.csv"
    )
    explanation = prepare_search(tmp_path / "log.csv", nominal_study()).run()
    assert explanation.largest_gain < LIMITS.unknown and explanation.fitted.names == (name,)
    for key, value in HIDDEN[name].items():
        assert explanation.fitted.numbers[name][key] == pytest.approx(value, rel=0.02)


def test_a_finer_law_that_is_no_more_than_the_plain_one_gives_way_to_it(tmp_path):
    """So a model with several effects is no worse for a law that one of them need not have."""
    hidden = [{"kind": "motor.coulomb_friction", "torque": 0.06}, {"kind": "motor.constant_torque", "torque": 0.03}]
    simulate_direct_drive(simulate_multisine_log().u[:1000], hidden, 3e-5, 1).write(tmp_path / "log.csv")
    search = prepare_search(tmp_path / "log.csv", nominal_study())
    nominal = search.fits.fit({}, np.zeros(len(search.fits.prior)))
    drifting = {"torque": 0.05, "initial_torque": 0.05, "time_constant": 1.0}
    trial = search._try(nominal, _Proposal({"motor.drifting_friction": drifting, "motor.constant_torque": {"torque": 0.02}}))
    assert set(trial.added) == set(trial.fitted.names) == {effect["kind"] for effect in hidden}
    assert trial.gain.is_accepted


def test_a_number_that_is_off_is_sure_beside_friction(tmp_path):
    """What it is off by and the number itself stand for one another, and that makes it no less sure."""
    hidden = [{"kind": "motor.coulomb_friction", "torque": 0.1}, {"kind": "motor.viscous_friction", "viscous": 0.03}]
    simulate_direct_drive(simulate_multisine_log().u[:1000], hidden, 3e-5, 1).write(tmp_path / "log.csv")
    explanation = prepare_search(tmp_path / "log.csv", nominal_study()).run()
    # what a law of friction misses is a quarter of its own torque
    assert {finding.effect: finding.confidence > 0.9 for finding in weigh(explanation)} == {
        "motor.coulomb_friction": True,
        "motor.viscous_friction": True,
    }


def test_friction_that_bends_and_falls_is_one_law(tmp_path):
    """Without it a drag stands for the fall."""
    axis = Axis(0.02, 0.03, 0.06, rise=1.5, fall=1.0, length=5e-3)
    numbers = prepare_axis_search(axis, 1e-5, tmp_path).run().fitted.numbers
    assert list(numbers) == ["motor.presliding_friction"]
    friction = numbers["motor.presliding_friction"]
    assert friction["torque"] == pytest.approx(axis.friction, rel=0.05)
    assert friction["breakaway_ratio"] == pytest.approx(axis.rise, rel=0.05)


def test_waves_a_turn_are_found_wherever_they_are_and_beside_friction(tmp_path):
    """72 waves: poles times slots; a spectrum over the position proposes them."""
    hidden = [
        {"kind": "motor.coulomb_friction", "torque": 0.06},
        {"kind": "motor.cogging", "amplitude": 0.05, "harmonic": 72.0, "phase": 0.7},
    ]
    simulate_direct_drive(simulate_multisine_log().u[:1000], hidden, 3e-5, 1).write(tmp_path / "log.csv")
    numbers = prepare_search(tmp_path / "log.csv", nominal_study()).run().fitted.numbers
    assert set(numbers) == {effect["kind"] for effect in hidden}
    assert numbers["motor.cogging"]["harmonic"] == 72.0
    for effect in hidden:
        for key in {"torque", "amplitude", "phase"} & set(effect):
            assert numbers[effect["kind"]][key] == pytest.approx(effect[key], rel=0.03)


def test_an_arms_friction_under_load_is_fitted_beside_its_weight(tmp_path):
    axis = Axis(0.02, 0.03, 0.06, length=3e-5, under_load=0.3, gravity=0.5, hangs=0.2)
    search = prepare_axis_search(axis, 1e-4, tmp_path)
    begin = {"load.gravity": {"torque": 0.4, "phase": 0.0}, "motor.coulomb_friction": {"torque": 0.03}}
    begin["transmission.load_friction"] = {"coefficient": 0.1}
    without, fitted = (search.fits.fit(numbers, np.zeros(2)) for numbers in (dict(list(begin.items())[:2]), begin))
    assert search.gain(without, fitted).is_accepted
    assert fitted.numbers["transmission.load_friction"]["coefficient"] == pytest.approx(0.3, rel=0.1)
    assert fitted.numbers["load.gravity"]["torque"] == pytest.approx(0.5, rel=0.02)


@pytest.mark.parametrize(("offset", "first"), [(0.3, True), (0.003, False)])
def test_zeros_of_encoders_that_do_not_agree_are_found(tmp_path, offset, first):
    """No effect stands for an offset which the whole shaft feels; a small one is asked for as effects are."""
    case = next(case for case in cases(SEED, 6, "none", 2.0) if case.log.theta_s is not None)
    dataclasses.replace(case.log, theta_e=case.log.theta_e + offset).write(tmp_path / "log.csv")
    search = prepare_search(tmp_path / "log.csv", case.model | {"log": {"theta_e": {"offset": 0.0}}})
    numbers = search.run().fitted.numbers
    assert search.history[0].change == "add transmission.offset" and search.history[0].accepted == first
    assert numbers == {"transmission.offset": {"offset": pytest.approx(offset, rel=3e-3)}}


def test_numbers_that_are_all_off_are_no_effect(tmp_path):
    case = cases(SEED, 1, "rough", 2.0)[0]
    case.log.write(tmp_path / "log.csv")
    search = prepare_search(tmp_path / "log.csv", case.model)
    explanation = search.run()
    assert explanation.fitted.names == () and search.fits is search.rough
    assert explanation.largest_gain < LIMITS.unknown


def test_a_free_function_without_a_solution_shows_nothing(monkeypatch):
    # no products of real columns: rounding made these of a function that is all but a number of the model
    alike = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 1e9], [0.0, 1e9, 1.0]])
    function = Candidate("motor.time", 1, (), lambda signals, torques: {})
    models = [
        Products(candidate, alike[:count, :count], np.ones(count), np.zeros(count), {})
        for candidate, count in ((NO_CANDIDATE, 2), (function, 3))
    ]
    predictor = SimpleNamespace(smoothness=[1.0], deviation=np.ones(1))
    linear = SimpleNamespace(best_predictor=predictor, products=lambda *_: models, signals=[])
    monkeypatch.setattr(effect_search, "functions_of", lambda _: [function])
    search = SimpleNamespace(floor=0.0)
    assert EffectSearch.find_largest_gain(search, SimpleNamespace(linear=linear)) == 0.0  # type: ignore
