"""The bench's cases and scores, on short logs and with made-up diagnoses."""

import json
import tomllib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from blind_diagnosis import fail_to_reach, see_nothing
from hidden.cases import _PLANTS, ALONE, KINDS, _add_known_effect, _targets, cases, plant_numbers, save
from hidden.effects import APART, EFFECTS, LEVELS, NEW, PINION, UNKNOWN, error_of, on_rigid
from hidden.outcomes import FIRST_LINE, NEXT_STEP
from hidden.proof import foretold, proofs
from hidden.scoring import calibration, calibration_error, confusion, markdown, outcome, run, scores, write
from hidden.simulator import Machine
from hidden_effects import read_outcomes

from jaxbl.chain import Run, move_plant
from jaxbl.config import read_model
from jaxbl.drive import Initial, Plant, as_arrays, effects
from jaxbl.records import read_record

DURATION = 0.6
GAP = {
    "holdout_rmse_before": {"theta_e": 1.0},
    "holdout_rmse_after": {"theta_e": 0.1},
    "noise_floor": {"theta_e": 0.0},
}


@pytest.fixture(scope="module")
def hidden_cases():
    return cases(4, 32, "all", DURATION) + cases(4, len(NEW), "new", DURATION) + cases(4, 2, "clutter", DURATION)


@pytest.fixture(scope="module")
def oracle(hidden_cases):
    """A diagnosis that knows the truth."""
    truths = {case.name: case for case in hidden_cases}

    def diagnose(logs, model, holdout):
        case = truths[model["title"]]
        findings = [{"effect": name, "confidence": 1.0, "parameters": {}} for name in case.truth["effects"]]
        findings = findings if case.hidden else []
        return {"verdict": case.truth["verdict"], "findings": findings, "gap": GAP, "model": case.oracle}

    return diagnose


def test_all_effects_of_the_package_are_hidden_at_all_sizes():
    assert {*EFFECTS, *NEW} - {PINION} == {name for name, cls in effects.EFFECTS.items() if cls.roles() and not cls.in_log}
    new = _targets(0, len(NEW) * len(LEVELS), "new")
    assert {(effect, level) for _, ((effect, level),) in new} == {(e, s) for e in NEW for s in LEVELS}
    targets = _targets(0, 66, "single")
    assert {(effect, level) for _, ((effect, level),) in targets} == {(e, s) for e in EFFECTS for s in LEVELS}
    assert all(on_rigid(effect) for plant, hidden in _targets(1, 200, "pairs") for effect, _ in hidden if plant == "direct")
    assert {effect for _, ((effect, _),) in _targets(0, 8, "unknown")} == set(UNKNOWN)


def test_clutter_is_there_and_small_and_its_name_is_not_spurious(hidden_cases):
    for case in hidden_cases:
        assert bool(case.truth["clutter"]) == (case.kind == "clutter")
        assert not set(case.truth["clutter"]) & set(case.truth["effects"])
    case = hidden_cases[-1]
    findings = [{"effect": name, "confidence": 0.9} for name in (*case.truth["effects"], "motor.cogging", "motor.inertia")]
    case_outcome = outcome(case, {"verdict": "unknown_effect", "findings": findings})
    assert case_outcome.is_right and case_outcome.spurious_effects == ["motor.inertia"]
    assert sum(row["right"] * row["count"] for row in calibration([case_outcome])) == 2


def test_a_machine_may_have_no_place_for_an_effect_that_the_model_knows():
    direct_plant = _PLANTS["direct"]
    machine = Machine(direct_plant["drive"], None)
    hidden = ["motor.coulomb_friction", "load.gravity"]
    drawn_effects = [_add_known_effect(machine, hidden, direct_plant, np.random.default_rng(seed)) for seed in range(20)]
    assert drawn_effects == [()] * 20
    machines = [_add_known_effect(machine, hidden[:1], direct_plant, np.random.default_rng(seed)) for seed in range(20)]
    assert {effects[0]["kind"] for effects in machines if effects} == {"load.gravity"}


def test_same_seed_same_cases():
    case, other, third = cases(9, 1, "hard", 0.2)[0], cases(9, 1, "hard", 0.2)[0], cases(10, 1, "hard", 0.2)[0]
    np.testing.assert_array_equal(case.log.theta_e, other.log.theta_e)
    assert case.truth == other.truth
    assert case.model == other.model != third.model


def test_kinds_come_in_their_shares_and_logs_are_whole(hidden_cases):
    assert [sum(case.kind == kind for case in hidden_cases) for kind in (*KINDS, *ALONE)] == [16, 4, 4, 4, 4, len(NEW), 2, 0]
    for case in hidden_cases:
        for log in (case.log, case.holdout):
            columns = log.columns()
            assert ("theta_s" in columns) == (case.conditions["plant"] != "direct")
            assert all(np.isfinite(values).all() and len(values) == len(log.t) for values in columns.values())
        assert case.conditions["excitation"] != case.conditions["holdout"]


def test_sizes_are_as_asked_or_say_so(hidden_cases):
    for case in hidden_cases:
        for (name, size), level in zip(case.truth["sizes"].items(), [case.truth["level"]], strict=False):
            if case.kind in ("single", "new", "hard") and name.split(".")[1] not in (
                "inertia",
                "viscous_friction",
                "gain_error",
                "damping",
                "delay",
                "asymmetric_friction",
                "load_friction",
            ):
                assert size == pytest.approx(level, rel=0.01)


def test_nominal_numbers_are_off_as_the_model_says_and_nominal_effects_stand_apart(hidden_cases):
    for case in hidden_cases:
        relative = case.model["uncertainty"]["relative"]
        assert 0.01 <= relative <= 0.06
        for table in ("drive", "transmission"):
            for key, true in case.oracle.get(table, {}).items():
                if isinstance(true, float) and key != "gear_ratio":
                    assert abs(case.model[table][key] / true - 1.0) <= 2.0 * relative + 1e-3
        for name, parameters in case.truth["effects"].items():
            side, kind = name.split(".")
            if kind == "inertia":
                assert abs(parameters["inertia"]) >= 0.99 * APART * relative * case.oracle["drive"][f"{side}_inertia"]


def test_models_are_studies_of_the_package_and_the_true_one_makes_the_truth(hidden_cases):
    counts = {"single": 0, "new": 0}
    for case in hidden_cases:
        read_model(case.model)
        config, _ = read_model(case.oracle)
        if counts.get(case.kind, 4) == 4 or case.truth["growth"] > 1.0:
            continue
        law = None if config.transmission is None else config.transmission.build()
        plant = Plant(config.drive.build(), law, tuple(effect.build() for effect in config.effects))
        package_positions = _simulate_positions(
            plant, case.runs[0].initial, case.traces[0].command, case.conditions["period"]
        )
        truth = case.traces[0].states[0]
        assert np.abs(package_positions - truth).max() < 2e-3 * np.ptp(truth), case.name
        counts[case.kind] += 1
    assert counts == {"single": 4, "new": min(len(NEW), 4)}


def _simulate_positions(plant, initial, torques, period, substeps=20):
    """Motor position by the package's own plant."""
    plant, state = as_arrays((plant, Initial(*(initial[i] for i in range(4)))), jnp.float64)

    @eqx.filter_jit
    def move_samples(plant, state, torques):
        def move_sample(carry, torque):
            state, start = carry
            next_state = move_plant(plant, Run(jnp.asarray(period), 1, substeps), state, torque, start)
            return (next_state, start + period), state.position["motor"]

        return jax.lax.scan(move_sample, (plant.init(state), jnp.asarray(0.0)), torques)[1]

    return np.asarray(move_samples(plant, state, jnp.asarray(torques)))


def test_rough_cases_lack_nothing_and_their_numbers_are_further_off_than_stated():
    rough, again = cases(4, 6, "rough", DURATION), cases(4, 1, "rough", DURATION)[0]
    assert again.model == rough[0].model and again.truth == rough[0].truth
    np.testing.assert_array_equal(again.log.theta_e, rough[0].log.theta_e)
    for case in rough:
        assert case.truth["verdict"] == "rough_numbers" and not case.truth["effects"] and not case.hidden
        assert list(case.runs[0].machine.effects) == case.oracle["effects"]
        assert [effect["kind"] for effect in case.model["effects"]] == [effect["kind"] for effect in case.oracle["effects"]]
        true_numbers, offsets = plant_numbers(case.oracle), case.truth["offsets"]
        assert case.model["drive"]["gear_ratio"] == true_numbers.pop("drive.gear_ratio")
        assert set(offsets) == {path for path, value in true_numbers.items() if value}
        stated = case.model["uncertainty"]["relative"]
        assert all(abs(offset) > 2.9 * stated for offset in offsets.values())
        read_model(case.model)
    signs = {np.sign(offset) for case in rough for offset in case.truth["offsets"].values()}
    assert signs == {-1.0, 1.0}


def test_a_rough_case_wants_no_effect_but_the_first_line_and_the_next_step():
    (case,) = cases(4, 1, "rough", DURATION)
    right = {"verdict": "unknown_effect", "first_line": FIRST_LINE, "next_step": f".venv/bin/{NEXT_STEP} --out results"}
    finding = {"effect": "motor.viscous_friction", "confidence": 0.9}
    answers = [
        right,
        right | {"findings": [finding]},
        right | {"first_line": "Unknown."},
        right | {"next_step": "jaxbl explore"},
    ]
    outcomes = [outcome(case, answer) for answer in answers]
    assert [case_outcome.is_right for case_outcome in outcomes] == [True, False, False, False]
    outcomes[0].identified = {"drive.motor_inertia": (0.001, 0.002), "transmission.half_gap": (-0.3, 0.1)}
    figures = scores(outcomes)
    for key, value in {"rough": 0.25, "rough_named": 0.25, "rough_line": 0.75, "rough_step": 0.75}.items():
        assert figures[key]["value"] == value
    assert figures["rough_identified"]["value"] == 0.0 and figures["rough_worst"] == {"value": 0.3, "count": 2}
    assert "| transmission.half_gap | -30 ± 10 % |" in markdown(outcomes)
    assert confusion(outcomes)[0] == ["rough_numbers"]


def test_an_oracle_gets_full_marks(hidden_cases, oracle):
    outcomes = run(hidden_cases, oracle, oracle=lambda case: {"theta_e": 0.1})
    figures = scores(outcomes)
    for key in ("single", "new", "clutter", "hard", "pairs", "abstentions"):
        assert figures[key]["value"] == 1.0
    for key in (
        "false_alarms",
        "pairs_spurious",
        "clutter_spurious",
        "confidently_wrong",
        "worse",
        "proved_worse",
        "calibration_error",
        "failed",
    ):
        assert figures[key]["value"] == 0.0
    assert figures["gap_reduction"]["value"] == pytest.approx(0.9)
    assert figures["reachable"]["value"] == pytest.approx(0.9)
    assert figures["oracle_ratio"]["value"] == pytest.approx(1.0)
    assert figures["proved"]["value"] == pytest.approx(1.0)
    rows, columns, counts = confusion(outcomes)
    assert all(counts[i, columns.index(row)] for i, row in enumerate(rows) if not row.startswith("unknown."))


def test_who_never_sees_anything_raises_no_alarm_and_finds_nothing(hidden_cases):
    outcomes = run(hidden_cases, lambda logs, model, holdout: {"verdict": "no_discrepancy", "findings": [], "model": model})
    figures = scores(outcomes)
    assert figures["false_alarms"]["value"] == figures["confidently_wrong"]["value"] == 0.0
    assert figures["single"]["value"] == figures["pairs"]["value"] == figures["abstentions"]["value"] == 0.0
    assert figures["unknown_missed"]["value"] == 1.0
    assert figures["calibration_error"] is None
    assert figures["proved"]["value"] == 0.0
    assert "**not met**" in markdown(outcomes)


def test_a_wrong_answer_is_counted_where_it_belongs(hidden_cases):
    pair = next(case for case in hidden_cases if case.kind == "pairs")
    wrong_effect = next(name for name in EFFECTS if name not in pair.hidden)
    findings = [{"effect": name, "confidence": 0.8} for name in (*pair.hidden, wrong_effect)]
    gap = {"holdout_rmse_before": {"theta_e": 1.0}, "holdout_rmse_after": {"theta_e": 1.1}, "noise_floor": {"theta_e": 0.1}}
    case_outcome = outcome(pair, {"verdict": "explained", "findings": findings, "gap": gap})
    assert case_outcome.is_right and case_outcome.spurious_effects == [wrong_effect] and case_outcome.worse
    assert case_outcome.reduction < 0.0 and case_outcome.reachable is None
    assert outcome(pair, {"verdict": "explained", "gap": gap}, {"theta_e": 0.1}).reachable == pytest.approx(1.0)
    assert outcome(pair, {"verdict": "explained", "gap": gap}, {}).reachable is None
    curve = calibration([case_outcome])
    assert curve == [{"confidence": pytest.approx(0.8), "right": pytest.approx(2 / 3), "count": 3}]
    assert calibration_error(curve) == pytest.approx(0.8 - 2 / 3)
    unknown = next(case for case in hidden_cases if case.kind == "unknown")
    case_outcome = outcome(unknown, {"verdict": "explained", "findings": [{"effect": wrong_effect, "confidence": 0.95}]})
    assert scores([case_outcome])["confidently_wrong"]["value"] == 1.0
    with pytest.raises(ValueError, match="verdict 'maybe'"):
        outcome(unknown, {"verdict": "maybe"})


def test_a_diagnosis_that_fails_is_an_outcome(hidden_cases, capsys):
    def fail_to_diagnose(logs, model, holdout):
        raise RuntimeError("no")

    outcomes = run(hidden_cases[:2], fail_to_diagnose)
    assert scores(outcomes)["failed"]["value"] == 1.0
    assert "RuntimeError: no" in markdown(outcomes)


def test_the_error_of_a_nominal_number_is_the_effect_and_nothing_else():
    selection = [case for case in cases(4, 44, "single", duration=2.0) if error_of(*case.hidden) is not None]
    assert selection
    for case in selection:
        (name,) = case.hidden
        added = sum(case.truth["effects"][name].values())
        key = error_of(name)
        assert case.model["drive"][key] == pytest.approx(case.oracle["drive"][key], rel=1e-3)
        assert abs(added) > 0.99 * APART * case.conditions["uncertainty"] * case.model["drive"][key]


def test_processes_share_the_cases_and_an_oracle_may_fail(hidden_cases, capsys):
    selection = [case for case in hidden_cases if case.hidden][:3]
    outcomes = run(selection, see_nothing, fail_to_reach, jobs=2)
    assert [case_outcome.name for case_outcome in outcomes] == [case.name for case in selection]
    assert all(case_outcome.ratio is None and case_outcome.reduction == 0.0 for case_outcome in outcomes)
    messages = [line for line in capsys.readouterr().err.splitlines() if " of 3: " in line]
    assert len(messages) == 3 and all("WRONG" in line for line in messages)


def test_the_proof_parts_true_from_nominal_model(hidden_cases):
    case = next(case for case in hidden_cases if case.kind == "single")
    nominal, true = foretold([(case, case.model), (case, case.oracle)])
    assert true["theta_e"] < 1e-6 * nominal["theta_e"]
    worse_model = {**case.model, "effects": [{"kind": "motor.constant_torque", "torque": 100.0}]}
    foreign_model = {**case.model, "effects": [{"kind": "motor.of_another_package"}]}
    results = proofs([(case, case.oracle), (case, worse_model), (case, foreign_model)])
    assert results[0] == (pytest.approx(1.0), False)
    assert results[1][1]
    assert results[2] == (None, None)


@pytest.mark.parametrize("name", ["load.flexibility", "load.presliding_friction"])
def test_windows_begin_with_what_the_motion_before_has_left(hidden_cases, name, monkeypatch):
    monkeypatch.setattr("hidden.proof.WINDOW", 0.1)
    case = next(case for case in hidden_cases if list(case.hidden) == [name])
    nominal, true = foretold([(case, case.model), (case, case.oracle)])
    assert true["theta_s"] < 0.01 * nominal["theta_s"]


def test_files_are_read_by_the_package_and_scored_from_a_batch(hidden_cases, oracle, tmp_path):
    selection = hidden_cases[:3]
    save(selection, tmp_path / "logs")
    for case in selection:
        model = tomllib.loads((tmp_path / "logs" / f"{case.name}.toml").read_text())
        assert model == case.model
        record = read_record(tmp_path / "logs" / f"{case.name}.csv")
        np.testing.assert_allclose(record.torque, case.log.u, rtol=1e-8, atol=1e-12)
        folder = tmp_path / "found" / case.name
        folder.mkdir(parents=True)
        (folder / "diagnosis.json").write_text(json.dumps(oracle(None, case.model, None)))
    truth = json.loads((tmp_path / "logs" / "truth.json").read_text())
    assert set(truth) == {case.name for case in selection}
    outcomes = read_outcomes(hidden_cases[:4], tmp_path / "found")
    assert [case_outcome.is_right for case_outcome in outcomes] == [True, True, True, False]
    figure_files = write(outcomes, tmp_path / "out", "A seed")
    assert {path.name for path in figure_files} == {"confusion.png", "calibration.png", "sizes.png", "gap.png"}
    assert (tmp_path / "out" / "scores.md").read_text().startswith("## A seed")
