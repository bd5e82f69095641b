"""The kind `workshop`: its bristle against SciPy, its cases, its table of names, runs that go on where they were stopped."""

import json
import math
import sys
import tomllib

import hidden_effects
import numpy as np
import pytest
from hidden import contest
from hidden.bristle import EFFECTS, Axis, Drive, simulate
from hidden.named import admissible_names, findings_of_terms, is_named, score, tables
from hidden.workshop import RECIPES, WAVES, draw_case, make_cases, save_case
from scipy.integrate import solve_ivp

from jaxbl.config import read_model
from jaxbl.records import read_record

FREE = Drive(1e-3, 0.0, 0.0, 0.0, 1.0, 0.0, motor_step=1e-9, load_step=1e-9)
MASS = Axis(
    4e-4, 8e-3, 0.03, rise=1.4, fall=0.5, length=1e-3, under_load=0.2, waves=12.0, amplitude=0.01, phase=0.3, double=0.4,
    gravity=0.05, hangs=0.3, offset=0.005,
)  # fmt: skip
GEARED = Axis(
    4e-4, 8e-3, 0.03, length=1e-3, under_load=0.1, load_inertia=0.04, load_viscous=0.1, ratio=10.0, stiffness=2.0,
    damping=2e-3, gravity=0.2, eccentric=0.02, eccentric_phase=0.5,
)  # fmt: skip


def run_free(axis, torque, **options):
    """Run an axis without its drive under a torque at each sample."""
    nought = np.zeros(len(torque))
    return simulate(axis, FREE, nought, nought, nought > 0.0, kicks=torque, start=(0.0, 0.0, 0.0, 0.0), **options)


def solve(axis, torque):
    """The same by LSODA at tight tolerances, the equations written out once more; states at the samples."""
    hard = axis.friction / axis.length
    damping = 0.6 * math.sqrt(hard * axis.inertia)

    def rates(_t, y, u):
        x, v, q, w, z = y
        elastic = axis.stiffness * (x - axis.ratio * q + axis.eccentric * math.sin(q + axis.eccentric_phase))
        elastic += axis.damping * (v - (axis.ratio - axis.eccentric * math.cos(q + axis.eccentric_phase)) * w)
        weight = axis.gravity * math.sin((q if axis.geared else x) - axis.hangs)
        spring = axis.stiffness * (x - axis.ratio * q + axis.eccentric * math.sin(q + axis.eccentric_phase))
        most = axis.friction * (1.0 + (axis.rise - 1.0) * math.exp(-((v / axis.fall) ** 2)))
        most = (most + axis.under_load * abs(spring if axis.geared else weight)) / hard
        share = np.clip((abs(z) / most - 0.7) / 0.3, 0.0, 1.0) if z * v > 0.0 else 0.0
        slip = 0.5 - 0.5 * math.cos(math.pi * share)
        bend = v * (1.0 - slip * abs(z) / most)
        turn = axis.waves * x + axis.phase
        total = u - axis.viscous * v - hard * z - damping * bend - axis.offset
        total -= axis.amplitude * (math.sin(turn) + axis.double * math.sin(2.0 * turn))
        if not axis.geared:
            return [v, (total - weight) / axis.inertia, w, 0.0, bend]
        pull = (axis.ratio - axis.eccentric * math.cos(q + axis.eccentric_phase)) * elastic
        return [v, (total - elastic) / axis.inertia, w, (pull - axis.load_viscous * w - weight) / axis.load_inertia, bend]

    y, states = np.zeros(5), []
    for u in torque:
        states.append(y[:4])
        y = solve_ivp(rates, (0.0, 1e-3), y, "LSODA", args=(u,), rtol=1e-9, atol=1e-12).y[:, -1]
    return np.array(states)


@pytest.mark.parametrize("axis", [MASS, GEARED], ids=["mass", "geared"])
def test_an_axis_moves_as_by_scipy(axis):
    torque = 0.12 * np.sin(2.0 * np.pi * 2.0 * np.arange(400) * 1e-3)
    exact, run = solve(axis, torque), run_free(axis, torque)
    columns = (0, 1, 2, 3) if axis.geared else (0, 1)
    for column in columns:
        spread = np.ptp(exact[:, column])
        assert np.max(np.abs(run.states[:, column] - exact[:, column])) < 2e-4 * spread


def test_friction_holds_without_creep_up_to_break_away():
    axis = Axis(4e-4, 8e-3, 0.03, length=1e-3)
    slowly = np.minimum(1.0, np.arange(4000) / 500.0) * axis.friction
    held = run_free(axis, 0.6 * slowly).states[:, 0]
    # the contacts bend by their stiffness, and not a bit more in seconds
    assert held[1000] == pytest.approx(0.6 * axis.length, rel=1e-3)
    assert abs(held[-1] - held[1000]) < 1e-9
    # a little more than friction moves it in the end
    assert run_free(axis, 1.05 * slowly).states[-1, 1] > 0.1
    assert run_free(axis, 0.95 * slowly).states[-1, 1] < 1e-6


def test_steady_sliding_costs_friction_offset_and_viscous_torque():
    axis = Axis(4e-4, 8e-3, 0.03, rise=1.3, fall=0.5, offset=0.004)
    steady = run_free(axis, np.full(2000, 0.1))
    assert steady.states[-1, 1] == pytest.approx((0.1 - 0.03 - 0.004) / 8e-3, rel=1e-6)
    assert steady.torques[-1, EFFECTS.index("dry")] == pytest.approx(0.03, rel=1e-6)


def test_torques_add_up_to_what_moves_the_axis():
    torque = 0.2 * np.sin(2.0 * np.pi * 2.0 * np.arange(1500) * 1e-3)
    run = run_free(MASS, torque)
    speed = run.states[:, 1]
    acceleration = (speed[2:] - speed[:-2]) / 2e-3
    mean = 0.5 * (torque[:-2] + torque[1:-1])  # held from sample to sample
    left = mean - MASS.viscous * speed[1:-1] - np.sum(run.torques, axis=1)[1:-1] - MASS.inertia * acceleration
    smooth = np.abs(speed[1:-1]) > 1.0
    assert np.sqrt(np.mean(left[smooth] ** 2)) < 0.02 * np.sqrt(np.mean(torque**2))


@pytest.fixture(scope="module")
def cases():
    return [draw_case(5, i) for i in range(12)]


def test_cases_are_those_of_their_seed_and_number(cases):
    again = draw_case(5, 3)
    assert again.model == cases[3].model and again.truth == cases[3].truth
    np.testing.assert_array_equal(
        again.logs[0]["t" if "t" in again.logs[0] else "time_ms"], next(iter(cases[3].logs[0].values()))
    )
    assert draw_case(6, 3).model != cases[3].model
    assert [case.truth["recipe"] for case in cases] == list(RECIPES)


def test_truth_has_the_rms_of_each_effect_over_the_fitted_logs(cases):
    for case in cases:
        fitted = case.runs[: len(case.logs)]
        torques = np.concatenate([run.torques for run in fitted])
        effects = case.truth["effects"]
        assert [effect["rms"] for effect in effects] == sorted((effect["rms"] for effect in effects), reverse=True)
        for effect in effects:
            column = torques[:, EFFECTS.index(effect["effect"])]
            assert effect["rms"] == pytest.approx(np.sqrt(np.mean(column**2)))
            assert effect["names"]
        assert bool(effects) == (case.truth["recipe"] != "numbers_alone")
        assert "dry" in [effect["effect"] for effect in effects] + case.truth["known"]


def test_models_read_the_logs_as_they_are(cases, tmp_path):
    for case in cases:
        folder = save_case(case, tmp_path)
        config, _ = read_model(folder / "model.toml")
        ratio = case.truth["axis"]["ratio"] if case.truth["axis"]["stiffness"] else None
        record = read_record(folder / "log0.csv", config.log, gear_ratio=ratio)
        drive = case.truth["drive"]
        share = 0.75 if not case.holdout else 1.0
        # a jittered log is read at the median of its stamps
        assert len(record.time) * share == pytest.approx(len(case.plain[0]["t"]), rel=0.01)
        swing = np.ptp(case.plain[0]["theta_e"])
        assert np.ptp(record.positions["motor"]) > 0.9 * swing > 10.0 * drive["motor_step"]


def test_recipes_look_like_themselves(cases):
    by_recipe = {case.truth["recipe"]: case for case in cases}
    standing = np.abs(by_recipe["pendulum"].runs[0].states[:, 1])
    assert 0.3 < np.mean(standing < 0.02 * standing.max()) < 0.7
    assert len(by_recipe["constant_speeds"].logs) >= 4 and by_recipe["constant_speeds"].holdout
    jitter = np.diff(next(iter(by_recipe["host_stamps"].logs[0].values())))
    assert np.ptp(jitter) > 0.01 * np.median(jitter) and (jitter > 0.0).all()
    assert by_recipe["coarse"].truth["drive"]["motor_step"] == pytest.approx(2.0 * np.pi / 4096)
    assert {"theta_s"} <= set(by_recipe["two_encoders"].logs[0])
    spinning = by_recipe["spin_downs"]
    off = spinning.runs[0].command == 0.0
    assert np.mean(off) > 0.2 and np.max(np.abs(spinning.runs[0].states[off, 1])) > 1.0
    table = by_recipe["counts"].model["log"]["u"]
    command = by_recipe["counts"].logs[0][table["column"]]
    np.testing.assert_allclose(command, np.round(command), atol=1e-6)
    assert min(WAVES) == 3 and max(WAVES) == 250


def finding(effect, confidence=0.99, **numbers):
    return {
        "effect": effect,
        "confidence": confidence,
        "parameters": {key: {"value": value} for key, value in numbers.items()},
    }


def test_the_table_says_which_names_are_right():
    drive = Drive(1e-3, 0.0, 1.0, 0.0, 1.0, 1.0)
    falling, flat = (Axis(1e-3, 1e-3, 0.1, rise=rise) for rise in (1.3, 1.0))
    assert is_named(admissible_names("dry", flat, drive), finding("motor.presliding_friction"))
    assert is_named(admissible_names("dry", falling, drive), finding("motor.stribeck_friction"))
    assert not is_named(admissible_names("dry", flat, drive), finding("motor.stribeck_friction"))
    assert not is_named(admissible_names("dry", flat, drive), finding("load.coulomb_friction"))
    waves = admissible_names("cogging", Axis(1e-3, 1e-3, 0.1, waves=84.0, amplitude=0.1), drive)
    assert is_named(waves, finding("motor.cogging", harmonic=84.0))
    assert is_named(waves, finding("motor.cogging_harmonics", harmonic=42.0))
    assert not is_named(waves, finding("motor.cogging", harmonic=83.0))
    assert not is_named(waves, finding("motor.cogging", harmonic=168.0))
    gravity = admissible_names("gravity", flat, drive)
    assert is_named(gravity, finding("load.gravity")) and is_named(gravity, finding("motor.cogging", harmonic=1.0))
    assert is_named(admissible_names("under_load", flat, drive), finding("motor.coulomb_friction"))
    geared = Axis(1e-3, 1e-3, 0.1, stiffness=1.0, ratio=10.0)
    assert not is_named(admissible_names("under_load", geared, drive), finding("motor.coulomb_friction"))
    assert is_named(admissible_names("under_load", geared, drive), finding("transmission.load_friction"))
    stiff = Axis(1e-3, 1e-3, 0.1, stiffness=1e4, ratio=10.0)
    assert is_named(admissible_names("dry", stiff, drive), finding("load.coulomb_friction"))


DRY = {"effect": "dry", "rms": 1.0, "share": 0.5, "names": ["motor.coulomb_friction"]}
WAVE = {"effect": "cogging", "rms": 0.5, "share": 0.2, "names": ["motor.cogging"], "waves": [12]}
TRUTH = {"recipe": "slow_turns", "effects": [DRY, WAVE], "optional": ["motor.viscous_friction"]}
ALONE = {"recipe": "numbers_alone", "effects": [], "optional": []}


def test_answers_are_scored():
    right = score(TRUTH, {"findings": [finding("motor.coulomb_friction"), finding("motor.cogging", harmonic=12)]})
    assert right["main"] and right["all"] and not right["wrong"] and not right["missed"]
    half = score(TRUTH, {"findings": [finding("motor.coulomb_friction"), finding("motor.cogging", 0.6, harmonic=24)]})
    assert half["main"] and not half["all"] and half["wrong"] == [1] and half["missed"] == ["cogging"]
    assert half["bets"] == [(0.99, True), (0.6, False)]
    falling = score(TRUTH, {"findings": [finding("motor.stribeck_friction")]})
    assert falling["main"] and falling["wrong"] == [0] and falling["bets"] == [(0.99, False)]
    optional = score(TRUTH, {"findings": [finding("motor.viscous_friction")]})
    assert not optional["wrong"] and not optional["bets"] and not optional["main"]
    assert not score(TRUTH, {"failure": "refused", "error": "no"})["main"]
    assert score(ALONE, {"findings": [], "lines": ["Unknown."]})["all"]
    assert not score(ALONE, {"failure": "refused", "error": "no"})["all"]
    alarm = {"findings": [finding("motor.inertia")], "lines": ["An effect."]}
    assert not score(ALONE, alarm)["all"]
    said = alarm | {"lines": ["The numbers are further off than stated; no effect is needed."]}
    assert score(ALONE, said)["all"] and not score(ALONE, said)["wrong"]


def test_terms_of_regressions_have_the_names_of_effects():
    findings = findings_of_terms(
        ["inertia", "Coulomb", "Stribeck at 0.3", "1 a turn", "12 a turn", "viscous"], ["inertia"], False
    )
    names = [found["effect"] for found in findings]
    assert names == [
        "motor.coulomb_friction", "motor.stribeck_friction", "load.gravity", "motor.cogging", "motor.viscous_friction",
    ]  # fmt: skip
    assert score(TRUTH, {"findings": findings[:1] + findings[3:]})["all"]
    assert findings_of_terms(["Coulomb", "1 a turn"], [], False, ["dry", "gravity"]) == []


def test_tables_compare_tools_on_the_cases_that_all_have_answered():
    truths = {"a": TRUTH, "b": TRUTH, "c": ALONE}
    good = {"findings": [finding("motor.coulomb_friction"), finding("motor.cogging", harmonic=12)], "seconds": 3.0}
    bad = {"findings": [finding("motor.inertia", 0.97)], "seconds": 5.0}
    refused = {"failure": "refused", "error": "a unit is wrong"}
    tools = {"new": {"a": good, "b": good, "c": {"findings": []}}, "old": {"a": good, "b": bad, "c": refused}}
    left = {"a": {"new": 1.0, "old": 2.0, "stepwise": 1.5, "mujoco": 3.0}, "b": {"new": 1.0, "stepwise": 2.0}}
    text = tables(truths, tools, left, ("stepwise", "mujoco"), "Trial")
    assert "| mujoco | - | - | - | - | - | - | - | 2.00 (0 of 1 less) | - |" in text
    assert "| new | 2 of 2 (34-100 %) | 2 of 2 (34-100 %) | 1 of 1 (21-100 %) | 0 in 0 of 3" in text
    assert "| old | 1 of 2 (9-91 %) | 1 of 2 (9-91 %) | 0 of 1 (0-79 %) | 1 in 1 of 3 (6-79 %) | 1 | 1 + 0 |" in text
    assert "0.58 (2 of 2 less)" in text and "| old | 1, 2, 0, 0 | 1, 2, 0, 0 |" in text
    fewer = tables(truths, {"new": tools["new"], "old": {"a": good}}, left, ("stepwise",), "Trial")
    assert "1 cases that all tools have answered" in fewer


def test_a_stopped_run_goes_on_where_it_was(tmp_path, monkeypatch):
    tree, cases = tmp_path / "tree", tmp_path / "cases"
    (tree / "jaxbl" / "report").mkdir(parents=True)
    (tree / "jaxbl" / "__init__.py").write_text(
        "import os\nfrom types import SimpleNamespace\n"
        "def diagnose(log, model, holdout=None):\n"
        "    if os.environ.get('DIES') == model.parent.name: os._exit(3)\n"
        "    if model.parent.name == 'second': raise ZeroDivisionError('here')\n"
        "    summary = {'verdict': 'explained', 'findings': [{'effect': 'motor.inertia', 'confidence': 1.0}]}\n"
        "    return SimpleNamespace(summary=summary, model=SimpleNamespace(to_toml=str))\n"
    )
    (tree / "jaxbl" / "errors.py").write_text("class InputError(Exception): pass\n")
    (tree / "jaxbl" / "report" / "__init__.py").touch()
    (tree / "jaxbl" / "report" / "diagnose.py").write_text("def diagnosis_lines(summary): return [summary['verdict']]\n")
    folders = []
    for name in ("first", "second", "third"):
        folders.append(cases / name)
        folders[-1].mkdir(parents=True)
        (folders[-1] / "log0.csv").touch()
    out = tmp_path / "answers"
    out.mkdir()
    (out / "first.json").write_text('{"kept": true}')
    monkeypatch.setenv("DIES", "third")
    contest.answer_cases(tree, folders, out)
    first, second, third = (json.loads((out / f"{name}.json").read_text()) for name in ("first", "second", "third"))
    assert first == {"kept": True}
    assert second["failure"] == "traceback" and "ZeroDivisionError: here" in second["error"]
    assert third == {"failure": "traceback", "error": "the process ended with 3"}
    (out / "third.json").unlink()
    monkeypatch.setenv("DIES", "nobody")
    contest.answer_cases(tree, folders, out)
    assert json.loads((out / "third.json").read_text())["lines"] == ["explained"]


def test_cases_that_are_there_are_not_made_again(tmp_path):
    made = []
    (folder,) = make_cases(5, [0], tmp_path, made.append)
    (folder / "truth.json").write_text("{}")
    assert make_cases(5, [0], tmp_path, made.append) == [folder]
    assert made == ["workshop-5-000 made"] and (folder / "truth.json").read_text() == "{}"
    assert tomllib.loads((folder / "model.toml").read_text())["title"] == folder.name


def test_final_runs_are_logged_and_finished_once(tmp_path, monkeypatch, capsys):
    path = tmp_path / "final_runs.csv"
    assert contest.final_seed("abc") == contest.final_seed("abc") != contest.final_seed("abd")
    contest.log_final_run("started", "abc", 1, 120, path=path)
    contest.log_final_run("started", "abc", 1, 120, path=path)  # it was stopped
    contest.log_final_run("finished", "abc", 1, 120, '{"abc": 3}', path)
    with pytest.raises(SystemExit, match="are run once"):
        contest.log_final_run("started", "abc", 1, 120, path=path)
    contest.log_final_run("started", "abd", 2, 120, path=path)
    assert len(path.read_text().splitlines()) == 5
    monkeypatch.setattr(sys, "argv", ["hidden_effects.py", "--kind", "workshop"])
    with pytest.raises(SystemExit):
        hidden_effects.main()
    assert "--seed is missing" in capsys.readouterr().err
