"""From a log to what is missing: the truth comes from a simulator that shares nothing with the package."""

import dataclasses

import jax
import numpy as np
import pytest
from browser import check_figures, needs_chromium, open_pages
from hidden.cases import cases
from hidden_log import FRICTION, nominal_study, select_samples, simulate_direct_drive, simulate_multisine_log

import jaxbl.diagnosis.diagnosis_summary as summary_module
from jaxbl.config import read_config
from jaxbl.diagnosis.choice import Choice
from jaxbl.diagnosis.diagnose import diagnose, run_diagnosis
from jaxbl.diagnosis.diagnosis_summary import find_tie
from jaxbl.diagnosis.diagnosis_task import read_diagnosis_task, split_off_last_quarter
from jaxbl.diagnosis.next_experiment import next_experiment, write_next_experiment
from jaxbl.diagnosis.observer_residual import observed_torques
from jaxbl.diagnosis.proof import open_held_out
from jaxbl.diagnosis.refit import ModelFits
from jaxbl.diagnosis.setup import set_up
from jaxbl.drive.effects import DELAY_SAMPLES
from jaxbl.drive.parameters import get_leaf, set_leaves
from jaxbl.errors import InputError
from jaxbl.estimation.logs import SealedRecord
from jaxbl.files import read_result
from jaxbl.records import read_record
from jaxbl.report.diagnose import describe as describe_diagnosis
from jaxbl.report.results import write_report

FIRST_PART, LAST_PART = slice(1500), slice(1500 - DELAY_SAMPLES, 2000)


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    simulate_multisine_log().write(folder / "axis.csv")
    # parts as long as those that are split off the whole
    select_samples(simulate_multisine_log(), FIRST_PART).write(folder / "first.csv")
    select_samples(simulate_multisine_log(), LAST_PART).write(folder / "last.csv")
    simulate_multisine_log(seed=2).write(folder / "other.csv")
    return folder


@pytest.fixture(scope="module")
def diagnosis(logs):
    return diagnose(logs / "axis.csv", nominal_study())


def test_the_missing_effect_is_named_with_its_number(diagnosis):
    summary = diagnosis.summary
    assert summary["verdict"] == "explained"
    (finding,) = summary["findings"]
    assert finding["effect"] == "motor.coulomb_friction" and finding["confidence"] > 0.5
    torque = finding["parameters"]["torque"]
    assert torque["value"] == pytest.approx(FRICTION["torque"], rel=0.02)
    assert abs(torque["value"] - FRICTION["torque"]) < 5.0 * torque["standard_error"]
    assert torque["unit"] == "N m"
    assert finding["where"]["place"] == "motor" and "motor side" in finding["where"]["sentences"]["motor"]
    for path, true in (("drive.motor_inertia", 0.02), ("drive.motor_viscous", 0.03)):
        assert summary["parameters"][path]["value"] == pytest.approx(true, rel=0.02)


def test_noise_of_the_input_that_was_not_felt_does_not_drive_the_model(tmp_path):
    log = simulate_multisine_log(torque_noise=0.02)
    log.write(tmp_path / "axis.csv")
    diagnosis = diagnose(tmp_path / "axis.csv", nominal_study())
    (finding,) = diagnosis.summary["findings"]
    assert finding["effect"] == "motor.coulomb_friction"
    assert finding["parameters"]["torque"]["value"] == pytest.approx(FRICTION["torque"], rel=0.02)
    (note,) = (note for note in diagnosis.summary["notes"] if "does not show" in note)
    assert note.startswith("The channel u carries noise of 0.02")
    np.testing.assert_allclose(diagnosis.trace["u"], log.u, rtol=1e-9)


def test_noise_of_the_input_is_asked_for_again_once_a_model_explains_more(tmp_path):
    # the friction that is missing hides from the model as given that the drive did not feel this noise
    simulate_multisine_log(torque_noise=0.004).write(tmp_path / "axis.csv")
    task = read_diagnosis_task(tmp_path / "axis.csv", nominal_study())
    with jax.enable_x64(True):
        assert set_up(task).input_noise.unfelt == 0.0
    summary = diagnose(tmp_path / "axis.csv", nominal_study()).summary
    first = summary["history"][0]
    assert first["tried"] == "drive models without noise of the input" and "motor.coulomb_friction" in first["why"]
    assert [finding["effect"] for finding in summary["findings"]] == ["motor.coulomb_friction"]
    assert any(note.startswith("The channel u carries noise of 0.004") for note in summary["notes"])


@pytest.mark.parametrize("felt", [False, True])
def test_the_motion_tells_whether_noise_of_the_input_was_felt(felt, tmp_path):
    simulate_multisine_log(torque_noise=0.02, felt=felt).write(tmp_path / "axis.csv")
    task = read_diagnosis_task(tmp_path / "axis.csv", nominal_study())
    with jax.enable_x64(True):
        setup = set_up(task)
    assert setup.input_noise.unfelt == (0.0 if felt else pytest.approx(0.02, rel=0.1))
    # where it was felt, by twice the standard error of the share that was not, 0.11; that share is known to one of them
    low, high = 0.02 * np.sqrt([0.11, 0.33]) if felt else (0.018, 0.022)
    assert low < setup.input_noise.possible < high
    with jax.enable_x64(True):
        held_out = open_held_out(setup)
    for record, log in ((task.record, setup.fitted), held_out):
        ((segment,), (rows,)) = log.segments, record.segments
        assert np.array_equal(segment.torque, record.torque[rows]) is felt


def test_the_gap_shrinks_to_the_noise_on_what_was_held_out(diagnosis):
    gap = diagnosis.summary["gap"]
    assert gap["holdout"]["separate"] is False and gap["holdout"]["from"] == pytest.approx(3.0)
    before, after, floor = (gap[key] for key in ("holdout_rmse_before", "holdout_rmse_after", "noise_floor"))
    assert set(before) == set(after) == set(floor) == {"theta_e", "velocity_motor", "torque_motor"}
    assert before["theta_e"] > 20.0 * floor["theta_e"]
    assert after["theta_e"] < 1.5 * floor["theta_e"]
    assert after["torque_motor"] < 0.5 * before["torque_motor"]


def test_what_is_held_out_keeps_its_times_and_is_not_fitted(logs, diagnosis):
    full_record = read_record(logs / "axis.csv")
    task = read_diagnosis_task(logs / "axis.csv", nominal_study())
    assert len(task.record.time) == 1500 and task.record.segments == (slice(DELAY_SAMPLES, 1500),)
    held_out = task.holdout.open()
    assert held_out.segments == (slice(1500, 2000),)
    np.testing.assert_array_equal(held_out.time, full_record.time)
    parts = dataclasses.replace(full_record, segments=(slice(0, 700), slice(800, 1200), slice(1300, 2000)))
    first, last = split_off_last_quarter(parts)
    assert first.segments == (slice(0, 700), slice(800, 1200), slice(1300, 1550))
    assert last.segments == (slice(1550, 2000),) and len(first.time) == 1550
    trace = diagnosis.trace
    assert trace["held_out"].sum() == 500 and trace["motor.missing_before"][DELAY_SAMPLES:].notna().all()
    assert trace["motor.missing_after"].std() < trace["motor.missing_before"].std()


def test_what_an_effect_takes_off_is_its_torque(diagnosis):
    trace = diagnosis.trace[DELAY_SAMPLES:]
    taken = trace["motor.missing_without.motor.coulomb_friction"] - trace["motor.missing_after"]
    # away from reversals, where the smoother rounds the jump
    fast = trace["motor.velocity"].abs() > 0.5 * trace["motor.velocity"].abs().max()
    friction = -FRICTION["torque"] * np.sign(trace["motor.velocity"])
    np.testing.assert_allclose(taken[fast].median(), friction[fast].median(), rtol=0.1)
    assert np.corrcoef(taken[fast], friction[fast])[0, 1] > 0.98


def test_the_observers_are_a_second_witness(diagnosis):
    description = diagnosis.summary["where"]["motor"]["observed"]
    assert description["converged"] is True and description["correlation"] > 0.95
    assert (
        description["rms"] == pytest.approx(description["smoother_rms"], rel=0.05)
        and description["rms"] > 5.0 * description["noise"]
    )
    assert (
        set(description["gains"]) == {"lambda", "alpha"}
        and description["time_constant"] == 0.01
        and description["bandwidth"] < 16.0
    )
    trace, (witness,) = diagnosis.trace, diagnosis.observed["motor"]
    is_observed = trace["motor.observed_before"].notna()
    # the beginnings of both parts are left out
    first = DELAY_SAMPLES + witness.skipped
    assert not is_observed[:first].any() and is_observed[first:1500].all()
    assert not is_observed[1500 : 1500 + witness.skipped].any() and is_observed[1500 + witness.skipped :].all()
    assert (trace["motor.observed_noise"].notna() == is_observed).all()
    np.testing.assert_array_equal(trace["motor.observed_before"][first:1500], witness.residual.torque)
    assert trace["motor.observed_before"][is_observed].std() == pytest.approx(trace["motor.missing_before"].std(), rel=0.1)
    assert not any("observer" in note for note in diagnosis.summary["notes"])


def test_an_observer_that_does_not_converge_is_noted(logs):
    task = read_diagnosis_task(logs / "axis.csv", nominal_study(observer={"motor": {"lambda": 2.0, "alpha": 1.0}}))
    assert "observer.motor" not in task.missing
    with jax.enable_x64(True):
        setup = set_up(task)
        observed = observed_torques(setup.bare, setup.fitted.segments)
        description, (note,) = summary_module.describe_observers(setup.bare, observed, setup)
    assert description["motor"]["converged"] is False and description["motor"]["rms"] is None
    assert note.startswith("The motor's observer does not converge on this log (lambda = 2, alpha = 1)")


def test_the_extended_model_runs_and_the_report_says_what_was_found(diagnosis, tmp_path):
    result = write_report(diagnosis, tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"diagnosis.json", "model.toml", "trace.parquet", "figures", "manifest.json", "report.html"}
    assert result.verdict == "good" and result.headline.startswith("The model lacks motor.coulomb_friction; with it, it ")
    assert any(line.startswith("motor.coulomb_friction (confidence") and "± " in line for line in result.remarks)
    model = read_config(tmp_path / "model.toml")
    assert [effect.kind for effect in model.effects] == ["motor.coulomb_friction"]
    summary = read_result(tmp_path / "diagnosis.json")
    assert summary == diagnosis.summary and describe_diagnosis(summary) == result
    assert model.effects[0].torque == summary["findings"][0]["parameters"]["torque"]["value"]


@needs_chromium
def test_the_page_in_a_browser(diagnosis, tmp_path):
    write_report(diagnosis, tmp_path)
    with open_pages(tmp_path / "report.html") as (page,):
        check_figures(page, len(list((tmp_path / "figures").iterdir())))
        assert page.locator(".answer").inner_text().startswith("The model lacks motor.coulomb_friction;")


def test_the_model_that_was_found_lacks_nothing_on_another_log(logs, diagnosis, tmp_path):
    """The model is read as written, with the record of the first log for its excitation."""
    write_report(diagnosis, tmp_path)
    second = diagnose(logs / "other.csv", tmp_path / "model.toml")
    assert second.config.excitation.kind == "recorded"
    assert second.summary["verdict"] == "no_discrepancy" and second.summary["findings"] == []
    (friction,) = second.model.effects
    assert friction.torque == pytest.approx(FRICTION["torque"], rel=0.02)


def test_what_is_known_exactly_is_no_candidate(logs):
    uncertainty = {"relative": 0.02, "exact": ["drive.motor_inertia", "actuator.gain_error"]}
    task = read_diagnosis_task(logs / "axis.csv", nominal_study(uncertainty=uncertainty))
    with jax.enable_x64(True):
        lacking = Choice(set_up(task)).search.lacking
    assert not {"motor.inertia", "actuator.gain_error"} & set(lacking)
    assert {"motor.viscous_friction", "motor.coulomb_friction"} <= set(lacking)


def test_what_is_expected_is_fitted_from_the_first_and_stays(logs):
    """Of a friction that is not there, too, as far as the log shows one at all."""
    uncertainty = {"relative": 0.02, "expected": ["motor.coulomb_friction"]}
    found = diagnose(logs / "axis.csv", nominal_study(uncertainty=uncertainty))
    first = found.summary["history"][0]
    assert (first["tried"], first["kept"], first["why"]) == ("add motor.coulomb_friction", True, "known to act")
    removals = [step for step in found.summary["history"] if step["tried"] == "remove motor.coulomb_friction"]
    assert removals and not any(step["kept"] for step in removals)
    assert "motor.coulomb_friction" in [one["effect"] for one in found.summary["findings"]]


def test_what_is_expected_can_be_on_the_drive(logs):
    study = nominal_study(uncertainty={"expected": ["load.gravitation"]})
    with pytest.raises(
        InputError, match=r"uncertainty\.expected: 'load\.gravitation' is no effect that is sought on this drive"
    ):
        diagnose(logs / "axis.csv", study)


def test_another_log_counts_from_zeros_of_its_own(tmp_path):
    """The proof takes those of the two encoders from its first fifth, which is not scored."""
    case = next(case for case in cases(3, 6, "none", 2.0) if case.log.theta_s is not None)
    for name, offset in (("log", 0.3), ("other", 0.7)):
        dataclasses.replace(case.log, theta_e=case.log.theta_e + offset).write(tmp_path / f"{name}.csv")
    study = case.model | {"log": {"theta_e": {"offset": 0.0}}}
    found = diagnose(tmp_path / "log.csv", study, holdout=tmp_path / "other.csv")
    assert [one["effect"] for one in found.summary["findings"]] == ["transmission.offset"]
    assert found.summary["verdict"] == "explained"
    assert found.summary["gap"]["holdout"]["from"] == pytest.approx(0.2 * case.log.t[-1], rel=0.05)


def test_an_effect_that_predicts_worse_is_not_named(logs, monkeypatch):
    """The fit is made to end at a number that is far off."""
    right = ModelFits.fit

    def spoil_sizes(*inputs):
        fit = right(*inputs)
        sizes = [number.path for number in fit.free if number.path.startswith("effects.") and number.role == "size"]
        spoilt_experiment = set_leaves(fit.experiment, {path: 4.0 * get_leaf(fit.experiment, path) for path in sizes})
        return fit._replace(experiment=spoilt_experiment, left_out=None)

    monkeypatch.setattr(ModelFits, "fit", spoil_sizes)
    task = read_diagnosis_task(logs / "first.csv", nominal_study(), holdout=logs / "last.csv")
    stages = []
    diagnosis = run_diagnosis(task, lambda *counts: stages.append(counts))
    assert stages == [(i, 6) for i in range(1, 7)]
    summary = diagnosis.summary
    assert summary["findings"] == [] and summary["verdict"] == "unknown_effect"
    tried = [step for step in summary["history"] if step["tried"] == "add motor.coulomb_friction"]
    assert tried and not any(step["kept"] for step in tried)
    gap = summary["gap"]
    assert gap["holdout"]["separate"] is True
    for name in ("theta_e", "torque_motor"):
        assert gap["holdout_rmse_after"][name] <= 1.02 * gap["holdout_rmse_before"][name]
    # new numbers alone take the model's place only where they are better
    after, before = gap["holdout_rmse_after"], gap["holdout_rmse_before"]
    assert sum(np.log(after[name] / before[name]) for name in before) <= 0.0
    # the numbers may be further off than stated; what has no name is a table
    assert summary["numbers_off"] and {effect.kind for effect in diagnosis.model.effects} <= {"motor.tabulated"}


def test_what_is_held_out_is_read_once_when_the_model_stands(logs, monkeypatch):
    """Neither model nor history depend on it: they are the same if its samples are others."""
    task = read_diagnosis_task(logs / "axis.csv", nominal_study())
    opened = []
    read = SealedRecord.open

    def count(sealed):
        opened.append(sealed.path.name)
        return read(sealed)

    monkeypatch.setattr(SealedRecord, "open", count)
    first = run_diagnosis(task)
    assert opened == ["axis.csv"]
    with pytest.raises(RuntimeError, match=r"axis\.csv: what is held out has been read"):
        task.holdout.open()
    # another machine in the same motion: half of its friction, and a wave
    record = first.holdout
    torque = np.where(np.arange(len(record.torque)) < 1500, record.torque, record.torque + 0.1 * np.sin(0.1 * record.time))
    other = dataclasses.replace(task, holdout=SealedRecord(dataclasses.replace(record, torque=torque)))
    second = run_diagnosis(other)
    assert second.model == first.model and second.summary["history"] == first.summary["history"]
    (before,), (after,) = first.summary["findings"], second.summary["findings"]
    assert before["effect"] == after["effect"] and before["z"] == after["z"]
    # a name is no surer than what is held out makes it
    assert before["holdout_z"] > 5.0 and before["confidence"] > 0.99
    assert after["holdout_z"] < before["holdout_z"] and after["confidence"] <= before["confidence"]
    assert first.summary["verdict"] == "explained" and second.summary["verdict"] == "unknown_effect"


def test_a_proof_that_does_not_move_tests_nothing(logs):
    """The hold-out log stands still: friction is named by the log, and neither explained nor denied."""
    task = read_diagnosis_task(logs / "axis.csv", nominal_study())
    record = task.holdout.open()
    still = np.random.default_rng(0).normal(0.0, 3e-5, len(record.time))
    quiet = dataclasses.replace(record, torque=0.0 * record.torque, positions={"motor": still})
    summary = run_diagnosis(dataclasses.replace(task, holdout=SealedRecord(quiet))).summary
    assert [finding["effect"] for finding in summary["findings"]] == ["motor.coulomb_friction"]
    assert summary["verdict"] == "not_tested"
    result = describe_diagnosis(summary)
    assert result.headline == "By the log the model lacks motor.coulomb_friction, but the held-out data cannot test that."
    assert any("Hold out a log that reaches as far: motor position " in line for line in result.remarks)


def test_a_drive_that_coasts_is_tested_by_its_torque(tmp_path):
    """Without an input a torque is large or small beside what the motion takes: a friction that the log has not fails."""
    for name, effects in (("plain", []), ("rubbing", [FRICTION])):
        simulate_direct_drive(np.zeros(1000), effects, 3e-5, 1, speed=20.0).write(tmp_path / f"{name}.csv")
    uncertainty = {"relative": 0.02, "exact": ["drive.motor_inertia"]}
    model = nominal_study(log={"initial_state": "unknown", "absent": ["u"]}, uncertainty=uncertainty)
    summary = diagnose(tmp_path / "plain.csv", model, holdout=tmp_path / "rubbing.csv").summary
    assert summary["verdict"] == "unknown_effect"
    test = summary["gap"]["test"]
    assert "torque_motor" in test["failed"] and not any(name.startswith("torque") for name in test["weak"])


def test_the_history_leads_from_log_to_name(diagnosis):
    """Each line says what was tried, what it gained, and why it was kept or dropped; what is kept is what is named."""
    history = diagnosis.summary["history"]
    assert {"tried", "nats", "standard_errors", "kept", "why"} == set(history[0])
    added = [step for step in history if step["tried"] == "add motor.coulomb_friction" and step["kept"]]
    assert added and added[0]["nats"] > 100.0 and added[0]["standard_errors"] > 5.0
    assert any(step["tried"].startswith("add ") and not step["kept"] for step in history)
    (removed,) = (step for step in history if step["tried"] == "remove motor.coulomb_friction")
    assert not removed["kept"] and removed["nats"] < -100.0 and removed["standard_errors"] < -5.0


def test_a_tie_has_an_experiment(logs, diagnosis, tmp_path):
    record = read_record(logs / "axis.csv")
    assert find_tie({"findings": []}) is None
    line = write_next_experiment(tmp_path, {"findings": []}, record, tmp_path / "next.csv")
    assert line.startswith("Nothing is tied") and not (tmp_path / "next.csv").exists()
    other = [{"kind": "motor.quadratic_drag", "drag": 0.004}]
    rival = {"effect": "motor.quadratic_drag", "drive": nominal_study()["drive"], "effects": other}
    finding = {"effect": "motor.coulomb_friction", "alternatives": [{"effect": "motor.quadratic_drag", "confidence": 0.3}]}
    summary = {"findings": [finding], "rival": rival}
    largest = np.max(np.abs(record.torque))
    best = next_experiment(summary, diagnosis.model, record)
    assert best is not None and best.apart > 10.0
    assert np.max(np.abs(best.torque)) <= largest + 1e-12
    less = next_experiment(summary, diagnosis.model, record, torque=0.1 * largest, travel=0.5)
    assert less is not None and less.apart < best.apart and np.max(np.abs(less.torque)) <= 0.1 * largest + 1e-12
    assert next_experiment(summary, diagnosis.model, record, travel=1e-9) is None
    write_report(diagnosis, tmp_path)
    line = write_next_experiment(tmp_path, summary, record, tmp_path / "new" / "next.csv")
    assert line.startswith(f"To part motor.coulomb_friction from motor.quadratic_drag: {best.kind} of ")
    columns = np.genfromtxt(tmp_path / "new" / "next.csv", delimiter=",", names=True)
    np.testing.assert_allclose(columns["u"], best.torque, atol=1e-8)


def test_what_is_tied_is_parted_by_the_experiment_that_is_asked_for(tmp_path):
    """Dry friction of 1 % of the torque looks viscous at 5 Hz and under that noise; a slower motion tells them apart."""
    friction = {"kind": "motor.coulomb_friction", "torque": 0.004}
    fast = 0.3 * np.sin(2.0 * np.pi * 5.0 * 2e-3 * np.arange(2000))
    log, other, holdout = (tmp_path / name for name in ("log.csv", "next_log.csv", "holdout.csv"))
    select_samples(simulate_direct_drive(fast, [friction], 1e-3, 1), FIRST_PART).write(log)
    select_samples(simulate_direct_drive(0.8 * fast, [friction], 1e-3, 2), LAST_PART).write(holdout)
    task = read_diagnosis_task(log, nominal_study(), holdout=holdout)
    diagnosis = run_diagnosis(task)
    pair = find_tie(diagnosis.summary)
    assert pair is not None and set(pair) == {"motor.coulomb_friction", "motor.viscous_friction"}
    best = next_experiment(diagnosis.summary, diagnosis.model, task.record, travel=6.0)
    assert best is not None and best.apart > 100.0
    simulate_direct_drive(best.torque, [friction], 1e-3, 3).write(other)
    (finding,) = diagnose([log, other], nominal_study(), holdout=holdout).summary["findings"]
    # what is held out is fast, and shows it by some three standard errors
    assert finding["effect"] == "motor.coulomb_friction" and finding["confidence"] > 0.9
    assert not finding["alternatives"]
    assert finding["parameters"]["torque"]["value"] == pytest.approx(0.004, rel=0.05)


def expect_refusal(logs, *arguments, **keywords):
    with pytest.raises(InputError) as error:
        read_diagnosis_task(*arguments, **keywords)
    message = str(error.value)
    assert "\n" not in message
    return message


def test_logs_of_unequal_periods_are_read_at_the_longest(logs, tmp_path):
    log, axis = simulate_multisine_log(seed=2), logs / "axis.csv"
    coarse, fine = tmp_path / "coarse.csv", tmp_path / "again.csv"
    means = log.u.reshape(-1, 2).mean(axis=1)
    dataclasses.replace(log, t=log.t[::2], u=means, theta_e=log.theta_e[::2]).write(coarse)
    log.write(fine)
    for inputs, holdout in ((axis, coarse), (coarse, axis), ([coarse, axis], fine)):
        task = read_diagnosis_task(inputs, nominal_study(), holdout=holdout)
        records = task.record, task.holdout.open()
        for record in records:
            assert record.sample_period == pytest.approx(0.004)
        notes = [note for record in records for note in record.notes if "every 4 ms, in the log every 2" in note]
        assert notes


def test_a_holdout_of_another_machine_is_refused(logs, tmp_path):
    axis = logs / "axis.csv"
    assert "is the log itself" in expect_refusal(logs, axis, nominal_study(), holdout=axis)
    log = simulate_multisine_log(seed=2)
    simulate_multisine_log(seed=2, inertia=0.1).write(tmp_path / "heavy.csv")
    assert "shows an inertia of 0.1" in expect_refusal(logs, axis, nominal_study(), holdout=tmp_path / "heavy.csv")
    dataclasses.replace(log, theta_e=-log.theta_e).write(tmp_path / "sign.csv")
    assert "sign" in expect_refusal(logs, axis, nominal_study(), holdout=tmp_path / "sign.csv")


def test_a_log_that_is_too_short_is_refused(logs, tmp_path):
    select_samples(simulate_multisine_log(), slice(150)).write(tmp_path / "short.csv")
    assert "too few to hold a quarter of them out" in expect_refusal(logs, tmp_path / "short.csv", nominal_study())


def test_a_log_whose_noise_hides_everything_is_refused(tmp_path):
    """The log is not called complete, because friction of a third of the input goes unseen."""
    torque = 2e-3 * simulate_multisine_log().u
    simulate_direct_drive(torque, [FRICTION | {"torque": 0.3 * float(np.std(torque))}], 3e-2, 1).write(tmp_path / "axis.csv")
    message = (
        r"axis\.csv: noise hides everything: with readings as noisy as 0\.03 rad \(theta_e\), no torque of less than "
        r"2\d\d % of the input would be seen; noise 7 times smaller, or torques as many times larger, are needed$"
    )
    with pytest.raises(InputError, match=message):
        diagnose(tmp_path / "axis.csv", nominal_study())


def test_effects_of_one_name_behind_an_actuator_are_refused(logs):
    """They are called by their positions, which effects that are tried before that of the actuator would shift."""
    waves = [{"kind": "motor.cogging", "amplitude": 1e-4, "harmonic": n} for n in (3.0, 5.0)]
    with pytest.raises(InputError, match=r"effects: two are motor\.cogging; list them before those of the actuator"):
        diagnose(logs / "axis.csv", nominal_study() | {"effects": [{"kind": "actuator.lag", "time_constant": 1e-3}, *waves]})


def test_a_slow_drive_whose_friction_is_missing_is_not_refused(tmp_path):
    """Nearly all of the torque overcomes friction: without it the model goes far beyond the motion."""
    t = 2e-3 * np.arange(4000)
    speed = 0.1 * np.sin(2.0 * np.pi * 0.25 * t)
    torque = 0.02 * 0.1 * 0.5 * np.pi * np.cos(2.0 * np.pi * 0.25 * t) + 0.03 * speed + 0.6 * np.sign(speed)
    simulate_direct_drive(torque, [FRICTION | {"torque": 0.6}], 3e-5, 1).write(tmp_path / "axis.csv")
    task = read_diagnosis_task(tmp_path / "axis.csv", nominal_study())
    with jax.enable_x64(True):
        setup = set_up(task)
    apart = setup.fitted.compare(setup.nominal).errors["theta_e"]
    assert apart > 2.0 * np.ptp(task.record.positions["motor"])


def test_a_model_that_diverges_is_refused(logs):
    unstable = nominal_study(effects=[{"kind": "motor.viscous_friction", "viscous": -2.0}])
    with pytest.raises(InputError, match=r"axis\.csv: the model diverges under this log's input"):
        diagnose(logs / "axis.csv", unstable)
