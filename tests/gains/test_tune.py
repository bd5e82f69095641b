"""The choice of gains: against brute force, against its own constraints, and what it says where there is none."""

import json
import math

import numpy as np
import pandas as pd
import pytest
from small_study import listed_axis, rigid_study, small_study

import jaxbl
from jaxbl.config import read_config
from jaxbl.errors import InputError, NoResult
from jaxbl.gains.best_gains import AS_GOOD
from jaxbl.gains.tune import tune
from jaxbl.gains.tune_summary import pareto_front
from jaxbl.sweeps.engine import Engine
from jaxbl.sweeps.sweep import sweep

pytestmark = pytest.mark.usefixtures("compiled_once")

TABLE = {"num": 5, "refine": 1, "alpha_ratio": {"start": 1.2, "stop": 20.0}, "lambda_ratio": {"start": 0.5, "stop": 20.0}}
DISTURBANCE = [{"kind": "motor.constant_torque", "torque": 0.05}]
"""f_plus = 0.05 / 0.05 = 1 rad/s^2 at all times."""


def rigid_tune_study(changes=None, **tables):
    """The rigid drive under a constant torque, its observer starting 0.1 rad/s off."""
    study = {"effects": DISTURBANCE, "tune": TABLE, "sweep": {"seeds": 2}} | tables
    base = {"observer.motor.velocity_error": 0.1, "run.velocity_tolerance": 0.05, "run.position_tolerance": 0.01,
            "encoders.noise": 1e-5, "run.duration": 0.4}  # fmt: skip
    return rigid_study(base | (changes or {}), **study)


@pytest.fixture(scope="module")
def tuned_study():
    return tune(rigid_tune_study(tune=TABLE | {"compare": [{"name": "loud", "motor": {"lambda": 50.0, "alpha": 500.0}}]}))


def test_the_bound_is_the_largest_of_the_run_and_of_the_start(tuned_study):
    pilot = tuned_study.summary["pilot"]["motor"]
    assert pilot["disturbance"] == pytest.approx(1.0, rel=2e-3)
    assert pilot["start"] == pytest.approx(1.0 + 3.0 * 0.1, rel=2e-3)
    assert tuned_study.summary["f_plus"]["motor"] == pilot["start"]
    assert not pilot["starting_error_assumed"]


CASCADE = {"kind": "cascade", "position_gain": 10.0, "speed_gain": 1.0, "speed_from": "differences", "speed_filter": 0.01}
LOOP = {"controller": CASCADE, "reference": {"kind": "sine", "amplitude": 0.1, "frequency": 1.0}}


def test_a_loop_that_reads_no_observer_changes_no_gains(tuned_study):
    """The disturbance is the same constant torque along another motion."""
    closed = tune(rigid_tune_study(**LOOP))
    assert closed.summary["f_plus"]["motor"] == pytest.approx(tuned_study.summary["f_plus"]["motor"], rel=1e-3)
    gains, usual = (result.summary["gains"]["motor"] for result in (closed, tuned_study))
    assert gains["alpha"] == pytest.approx(usual["alpha"], rel=1e-2)


def test_optimum_agrees_with_brute_force_over_a_fine_grid(tuned_study):
    """A sweep of its own over 11 x 11 gains finds none that is feasible and much better."""
    bound = tuned_study.summary["f_plus"]["motor"]
    axes = [
        listed_axis("observer.motor.alpha", *(bound * np.geomspace(1.2, 20.0, 11))),
        listed_axis("observer.motor.lambda", *(math.sqrt(bound) * np.geomspace(0.5, 20.0, 11))),
    ]
    metrics = ["velocity_rmse", "converged", "margin_alpha", "margin_exact"]
    study = rigid_tune_study(axes=axes, sweep={"seeds": 2, "metrics": metrics})
    study.pop("tune")
    frame = sweep(study).frame
    groups = frame.groupby(["observer.motor.alpha", "observer.motor.lambda"])
    error = groups["motor.velocity_rmse"].max()
    meets_all = groups["motor.converged"].min() & (groups["motor.margin_alpha"].min() >= 1.1)
    least = error[meets_all & (groups["motor.margin_exact"].min() >= 1.1)].min()
    achieved = tuned_study.summary["achieved"]["motor"]
    # two stages of five values each way reach a step of 1.4 in lambda and alpha
    assert achieved["velocity_rmse"] <= 1.1 * least
    assert achieved["velocity_rmse"] >= 0.98 * least
    assert achieved["margin_alpha"] >= 1.1
    assert achieved["margin_exact"] >= 1.1


def test_candidates_are_judged_by_their_worst_run(tuned_study):
    frame = tuned_study.candidates["motor"]
    assert len(frame) == 2 * 25
    assert set(frame["stage"]) == {0, 1}
    meets_all = frame["converged"] & (frame["margin_alpha"] >= 1.1) & (frame["margin_exact"] >= 1.1)
    pd.testing.assert_series_equal(frame["feasible"], meets_all, check_names=False)
    gains, verdict = (tuned_study.summary[key]["motor"] for key in ("gains", "verdict"))
    best = frame[(frame["lambda"] == gains["lambda"]) & (frame["alpha"] == gains["alpha"])].iloc[0]
    assert best["feasible"] and verdict["least_error"] == frame[frame["feasible"]]["error"].min()
    assert best["error"] <= (1.0 + max(AS_GOOD, frame["scatter"].max())) * verdict["least_error"]
    bound = tuned_study.summary["f_plus"]["motor"]
    np.testing.assert_allclose(frame["alpha_ratio"] * bound, frame["alpha"])
    np.testing.assert_allclose(frame["lambda_ratio"] * math.sqrt(bound), frame["lambda"])


def test_a_zoom_lies_about_the_best_cell_and_inside_of_the_range(tuned_study):
    coarse, zoom = (stage["motor"] for stage in tuned_study.summary["stages"])
    for key, best in (("alpha_ratio", "alpha_ratio"), ("lambda_ratio", "lambda_ratio")):
        assert coarse[key][0] <= zoom[key][0] < zoom[key][1] <= coarse[key][1]
        frame = tuned_study.candidates["motor"].query("stage == 0 and feasible")
        centre = frame.loc[frame["error"].idxmin(), best]
        assert zoom[key][0] <= centre <= zoom[key][1]
    step = (zoom["alpha_ratio"][1] / zoom["alpha_ratio"][0]) ** 0.25
    assert tuned_study.summary["resolution"]["motor"]["alpha"] == pytest.approx(step - 1.0)


def test_pareto_front_has_what_none_beats():
    frame = pd.DataFrame({
        "convergence_time": [1.0, 2.0, 2.0, 3.0, 4.0, 0.5],
        "error": [5.0, 4.0, 3.0, 3.0, 1.0, 0.1],
        "feasible": [True, True, True, True, True, False],
    })  # fmt: skip
    front = pareto_front(frame)
    assert list(zip(front["convergence_time"], front["error"], strict=True)) == [(1.0, 5.0), (2.0, 3.0), (4.0, 1.0)]


def test_pareto_front_of_a_search_ends_at_the_tuned_gains(tuned_study):
    front = tuned_study.summary["pareto"]["motor"]
    errors, times = ([point[key] for point in front] for key in ("error", "convergence_time"))
    assert sorted(errors, reverse=True) == errors
    assert sorted(times) == times
    assert front[-1]["error"] == tuned_study.summary["verdict"]["motor"]["least_error"]


def test_comparison_is_on_noise_that_the_search_has_not_seen(tuned_study):
    holdout = tuned_study.summary["holdout"]
    assert tuned_study.summary["seeds"] == [0, 1]
    assert holdout["seeds"] == [2, 3]
    assert holdout["same_excitation"]
    assert any("No tune.holdout is given" in line for line in tuned_study.summary["remarks"])
    rows = {row["name"]: row for row in holdout["rows"]}
    assert list(rows) == ["tuned", "usual rule", "config", "loud"]
    bound = tuned_study.summary["f_plus"]["motor"]
    assert rows["usual rule"]["alpha"] == pytest.approx(1.1 * bound)
    assert rows["usual rule"]["lambda"] == pytest.approx(1.5 * math.sqrt(bound))
    assert (rows["config"]["lambda"], rows["config"]["alpha"]) == (4.0, 9.0)
    # the same as a sweep of these gains with these seeds
    study = rigid_tune_study({"observer.motor.lambda": 50.0, "observer.motor.alpha": 500.0, "sweep.first_seed": 2})
    frame = sweep(study).frame
    assert list(frame["seed"]) == [2, 3]
    assert rows["loud"]["velocity_rmse"]["worst"] == pytest.approx(frame["motor.velocity_rmse"].max(), rel=1e-9)
    assert rows["loud"]["runs"] == 2
    factor = holdout["factors"]["motor"]["loud"]["velocity_rmse"]["worst"]
    assert factor == pytest.approx(rows["loud"]["velocity_rmse"]["worst"] / rows["tuned"]["velocity_rmse"]["worst"])
    assert factor > 2.0


def test_summary_is_json_and_public_names_resolve(tuned_study):
    assert json.loads(json.dumps(tuned_study.summary, allow_nan=False)) == tuned_study.summary
    assert jaxbl.tune is tune
    for key in (
        "objective",
        "f_plus",
        "margins",
        "gains",
        "achieved",
        "limits",
        "conditions",
        "holdout",
        "pareto",
        "remarks",
        "range",
        "resolution",
    ):
        assert key in tuned_study.summary


UNCERTAINTY_TABLE = {"num": 3, "refine": 1, "worst_over_uncertainty": True, "margin_exact": 1.0, "margin_alpha": 1.05}


def test_both_sides_at_once_over_uncertain_drives_and_a_restart(tmp_path, monkeypatch):
    study = small_study(
        {"observer.motor.velocity_error": None, "run.velocity_tolerance": 5.0, "run.position_tolerance": 0.1,
         "uncertainty.relative": 0.1, "excitation.amplitude": 0.5},
        effects=[{"kind": "motor.inertia", "inertia": 0.001}],
        tune=UNCERTAINTY_TABLE | {
            "objective": "torque",
            "holdout": {"kind": "chirp", "amplitude": 0.5, "start_frequency": 1.0, "stop_frequency": 3.0, "sweep_time": 0.2},
        },
    )  # fmt: skip
    calls = []
    first = tune(study, tmp_path / "out", progress=lambda done, total: calls.append((done, total)))
    summary = first.summary
    assert set(summary["gains"]) == {"motor", "load"}
    assert len(summary["scenarios"]) == 5
    # 9 points a map, 5 drives: a map, a wider one, a zoom, three gains twice, the tuned ones with and without the gap
    assert calls[-1] == (5 * (3 * 9 + 2 * 3 + 2), 5 * (3 * 9 + 2 * 3 + 2))
    row = summary["holdout"]["rows"][0]
    assert (row["name"], row["side"], row["runs"]) == ("tuned", "motor", 5)
    assert summary["pilot"]["motor"]["starting_error_assumed"]
    assert summary["holdout"]["excitation"]["kind"] == "chirp"
    # the effect that the study has is kept, and varied by the uncertainty of the nominal number
    axes = read_config(tmp_path / "out" / "tune" / "coarse" / "study.toml").axes
    inertias = next(axis.values for axis in axes if axis.path == "effects.motor.inertia.inertia")
    np.testing.assert_allclose(inertias, [0.001, -0.004, -0.004, 0.006, 0.006], atol=1e-15)
    # a second call simulates nothing
    monkeypatch.setattr(Engine, "run", lambda *_: pytest.fail("a finished search simulates"))
    second = tune(study, tmp_path / "out")
    assert second.summary == summary
    assert second.cost["lanes"] == 0


def test_an_interrupted_search_goes_on_where_it_stopped(tmp_path, monkeypatch):
    study = rigid_tune_study()
    run_chunks, run = [], Engine.run

    def count_lanes(engine, chunk):
        if len(run_chunks) == 2:
            raise KeyboardInterrupt
        run_chunks.append(chunk)
        return run(engine, chunk)

    monkeypatch.setattr(Engine, "run", count_lanes)
    with pytest.raises(KeyboardInterrupt):
        tune(study, tmp_path, backend="scan")
    with pytest.raises(InputError, match="was begun with --backend scan; go on with that, or choose another folder"):
        tune(study, tmp_path, backend="fused")
    monkeypatch.setattr(Engine, "run", lambda engine, chunk: run_chunks.append(chunk) or run(engine, chunk))
    # by the same without being told
    resumed = tune(study, tmp_path)
    # maps of both stages, the named gains twice, and the tuned ones with ideal encoders: each once
    assert len(run_chunks) == 5
    assert resumed.summary == tune(study, backend="scan").summary


def test_a_range_that_ends_too_early_is_said():
    table = TABLE | {"alpha_ratio": {"start": 4.0, "stop": 20.0}, "refine": 0}
    summary = tune(rigid_tune_study(tune=table)).summary
    assert any(
        "the optimum lies at the end alpha / f⁺ = 4 of the range searched (tune.alpha_ratio)" in remark
        for remark in summary["remarks"]
    )
    limits = summary["limits"]["motor"]
    assert limits["range_ends"] == ["smaller alpha"]
    assert limits["binding"] == []
    assert limits["towards"]["alpha"]["smaller"]["limit"] == "range"


def test_a_constraint_that_holds_the_optimum_back_is_said():
    table = TABLE | {"margin_exact": 5.0, "refine": 0}
    summary = tune(rigid_tune_study(tune=table)).summary
    assert summary["achieved"]["motor"]["margin_exact"] >= 5.0
    assert any("margin_exact = 5 forbids better gains" in remark for remark in summary["remarks"])
    limits = summary["limits"]["motor"]
    assert limits["binding"] == ["margin_exact"]
    assert limits["constraints"]["margin_exact"]["binds"]
    assert not limits["constraints"]["margin_alpha"]["binds"]


def test_limits_are_those_of_the_candidates(tuned_study):
    limits, achieved = (tuned_study.summary[key]["motor"] for key in ("limits", "achieved"))
    assert list(limits["constraints"]) == ["converged", "margin_alpha", "margin_exact"]
    for name in ("margin_alpha", "margin_exact"):
        constraint = limits["constraints"][name]
        assert constraint["value"] == achieved[name]
        assert constraint["room"] == pytest.approx(achieved[name] / 1.1)
        assert constraint["binds"] == (name in limits["binding"])
    gains, frame = tuned_study.summary["gains"]["motor"], tuned_study.candidates["motor"]
    for gain, other in (("lambda", "alpha"), ("alpha", "lambda")):
        line = pd.DataFrame(limits["profiles"][gain])
        assert line[gain].is_monotonic_increasing
        # where the zoom was run, its own runs
        neighbours = frame[(frame["stage"] == 1) & np.isclose(frame[other], gains[other], rtol=1e-9)].sort_values(gain)
        shown_line = line[line[gain].between(neighbours[gain].min() * 0.999, neighbours[gain].max() * 1.001)]
        np.testing.assert_allclose(shown_line[gain], neighbours[gain])
        np.testing.assert_allclose(shown_line["error"], neighbours["error"])
        assert [not names for names in shown_line["missed"]] == neighbours["feasible"].to_list()
        # and the whole range
        ends = pytest.approx(tuned_study.summary["range"][f"{gain}_ratio"], rel=5e-3)
        assert line[f"{gain}_ratio"].iloc[[0, -1]].to_list() == ends
    conditions = tuned_study.summary["conditions"]["motor"]
    assert conditions["lambda"] / conditions["least_lambda"]["exact"] == pytest.approx(achieved["margin_exact"], rel=1e-6)
    assert conditions["f_plus"] == achieved["f_plus"]


def test_gains_that_do_not_converge_have_no_factor():
    slow = {"name": "slow", "motor": {"lambda": 0.001, "alpha": 1.5}}
    summary = tune(rigid_tune_study(tune=TABLE | {"compare": [slow], "refine": 0})).summary
    assert summary["holdout"]["factors"]["motor"]["slow"] == {"why_none": "slow: converged in 0 % of the runs"}
    assert "motor: the gains 'slow' converge in only 0 % of the held-out runs: no factor is stated." in summary["remarks"]


def test_same_gains_by_two_names_are_compared_once_and_shown_twice():
    summary = tune(
        rigid_tune_study(
            tune=TABLE | {"refine": 0, "compare": [{"name": "as it is", "motor": {"lambda": 4.0, "alpha": 9.0}}]}
        )
    )
    rows = {row["name"]: row for row in summary.summary["holdout"]["rows"]}
    assert {**rows["as it is"], "name": "config"} == rows["config"]


def test_without_a_table_the_defaults_are_taken():
    study = rigid_tune_study()
    study.pop("tune")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxbl.gains.gain_search.GainSearch.run", lambda search: pytest.skip(f"{search.table.num}"))
        with pytest.raises(pytest.skip.Exception, match="16"):
            tune(study)


INFEASIBLE = {
    "no time": ({"longest_convergence": 1e-3}, {}, "longest_convergence = 0.001: 0 (fastest"),
    "margin out of reach": ({"margin_exact": 1e3}, {}, "margin_exact = 1000: 0 (largest"),
    "tolerance out of reach": (
        {},
        {"run.position_tolerance": 1e-9},
        "run.velocity_tolerance = 0.05, run.position_tolerance = 1e-09); margin_alpha",
    ),
}


@pytest.mark.parametrize("case", INFEASIBLE)
def test_no_feasible_gains_is_no_result_and_names_the_constraint(case):
    table, changes, message = INFEASIBLE[case]
    with pytest.raises(NoResult, match=r"motor: none of the 25 gains with alpha / f⁺ in 1\.2 \.\.\. 20 ") as error:
        tune(rigid_tune_study(changes, tune=TABLE | table))
    assert message in str(error.value), error.value
    assert "\n" not in str(error.value)


def test_a_drive_that_diverges_is_no_result():
    effects = [{"kind": "motor.viscous_friction", "viscous": 1e4}, *DISTURBANCE]
    with pytest.raises(NoResult, match="motor: the drive itself diverges in the pilot run"):
        tune(rigid_tune_study(effects=effects))


PAIR = {"lambda": 1.0, "alpha": 1.0}
BAD = {
    "at rest": (
        rigid_tune_study(effects=[], excitation={"kind": "sine", "amplitude": 0.0, "frequency": 1.0})
        | {"observer": {"motor": {"lambda": 1.0, "alpha": 1.0}}},
        "motor: f⁺ = 0: ",
    ),
    "all known": (
        rigid_tune_study({"drive.motor_viscous": 0.0}, effects=[]),
        "motor: f⁺ = 0: ",
    ),
    "margin_alpha": (rigid_tune_study(tune={"margin_alpha": 1.0}), "tune.margin_alpha: should be greater than 1, not 1.0"),
    "margin_exact": (
        rigid_tune_study(tune={"margin_exact": 0.9}),
        "tune.margin_exact: should be greater than or equal to 1",
    ),
    "alpha range": (
        rigid_tune_study(tune={"alpha_ratio": {"start": 1.0}}),
        "tune.alpha_ratio.start: should be greater than 1",
    ),
    "empty range": (
        rigid_tune_study(tune={"lambda_ratio": {"start": 3.0, "stop": 3.0}}),
        "tune.lambda_ratio: start 3.0 should be less than stop 3.0",
    ),
    "range below the margin": (
        rigid_tune_study(tune={"margin_alpha": 3.0, "alpha_ratio": {"stop": 2.0}}),
        "tune: alpha_ratio: stop 2.0 is below margin_alpha 3.0",
    ),
    "endless gain": (
        rigid_tune_study(tune={"compare": [{"name": "a", "motor": {"lambda": math.inf, "alpha": 1.0}}]}),
        "tune.compare[0].motor.lambda: should be a finite number, not inf",
    ),
    "name twice": (
        rigid_tune_study(tune={"compare": [{"name": "tuned", "motor": PAIR}]}),
        "tune: compare[0].name: 'tuned' is taken",
    ),
    "load on one inertia": (
        rigid_tune_study(tune={"compare": [{"name": "a", "motor": PAIR, "load": PAIR}]}),
        "tune.compare[0].load has no meaning on a rigid drive",
    ),
    "no load": (
        small_study(tune={"compare": [{"name": "a", "motor": PAIR}]}),
        "tune.compare[0].load is missing",
    ),
    "kind of the holdout": (
        rigid_tune_study(tune={"holdout": {"kind": "sinus"}}),
        "tune.holdout.kind: unknown kind 'sinus'; did",
    ),
    "key of the holdout": (rigid_tune_study(tune={"holdout": {"kind": "sine", "a": 1}}), "tune.holdout: unknown key 'a'"),
    "loop that reads the observer": (
        rigid_tune_study(**LOOP | {"controller": CASCADE | {"speed_from": "observer"}}),
        "tune.objective: 'velocity' does not go with a controller that reads the observers",
    ),
    "no inertia left": (
        rigid_tune_study({"uncertainty.relative": 1.5}, tune={"worst_over_uncertainty": True}),
        "uncertainty.relative: 1.5 leaves no inertia on the motor",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line_and_leaves_nothing(case, tmp_path):
    study, message = BAD[case]
    with pytest.raises(InputError) as error:
        tune(study, tmp_path / "out")
    assert message in str(error.value), error.value
    assert "\n" not in str(error.value)
    assert list(tmp_path.rglob("*.*")) == []
