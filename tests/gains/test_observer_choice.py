"""The choice of an observer: against brute force, against runs of its own, and what it says where kinds are alike."""

import math

import numpy as np
import pytest
import tomli_w
from scipy import stats
from small_study import listed_axis, rigid_study, small_study

from jaxbl.config import read_config
from jaxbl.errors import InputError
from jaxbl.gains.observer_choice import SideSearch, list_ties, rank_kinds, runs_are_equal
from jaxbl.gains.tune import tune
from jaxbl.report.observer_choice import observer_toml
from jaxbl.sweeps.sweep import sweep

pytestmark = pytest.mark.usefixtures("compiled_once")

KINDS = ["super_twisting", "luenberger", "kalman", "dirty_derivative"]
SINE = {"kind": "sine", "amplitude": 0.05, "frequency": 5.0}


def study(changes=None, **table):
    """The rigid drive under a constant torque that the observers do not know."""
    base = {"observer.motor.velocity_error": 0.1, "encoders.noise": 1e-5, "run.duration": 0.2}
    effects = [{"kind": "motor.constant_torque", "torque": 0.05}]
    arguments = {"observers": KINDS, "trials": 32, "refine": 1} | table
    return rigid_study(base | (changes or {}), effects=effects, tune=arguments, sweep={"seeds": 2})


@pytest.fixture(scope="module")
def observer_choice():
    return tune(study(holdout=SINE, refine=2))


def test_ratios_have_the_interval_of_a_paired_test():
    rng = np.random.default_rng(0)
    common = rng.uniform(1.0, 5.0, 10)
    errors = {"a": 2.0 * common * np.exp(0.1 * rng.standard_normal(10)), "b": common, "c": np.full(10, np.inf)}
    ranking = rank_kinds(errors)
    assert list(ranking) == ["b", "a", "c"]
    expected = stats.ttest_rel(np.log(errors["a"]), np.log(errors["b"])).confidence_interval()
    np.testing.assert_allclose((ranking["a"]["low"], ranking["a"]["high"]), np.exp(expected))
    assert ranking["a"]["ratio"] == pytest.approx(stats.gmean(errors["a"]) / stats.gmean(errors["b"]))
    assert (ranking["b"]["error"], ranking["b"]["worst"]) == (pytest.approx(stats.gmean(common)), common.max())
    assert [ranking["b"][key] for key in ("ratio", "low", "high")] == [1.0] * 3
    assert set(ranking["c"].values()) == {None}
    assert list_ties(ranking) == []


def test_equal_runs_have_no_interval():
    errors = {kind: np.full(8, 0.1 + 1e-6 * i) for i, kind in enumerate("ab")}
    ranking = rank_kinds(errors)
    assert list_ties(ranking) == []
    assert all(map(runs_are_equal, ranking.values()))
    errors["b"][3] *= 1.01
    assert not runs_are_equal(rank_kinds(errors)["b"])


def test_kinds_that_noise_alone_parts_are_not_told_apart():
    """If noise alone separates two kinds, the second's interval holds 1 in 19 of 20 draws or more: the first
    is the better one by chance, so that its ratio begins above 1."""
    rng = np.random.default_rng(1)
    count = 0
    for _ in range(400):
        errors = {kind: np.exp(0.2 * rng.standard_normal(8)) for kind in "ab"}
        count += not list_ties(rank_kinds(errors))
    assert count / 400 == pytest.approx(0.05, abs=3 * math.sqrt(0.05 * 0.95 / 400))


def test_the_search_agrees_with_brute_force(observer_choice):
    """A sweep of its own over a fine grid finds no gains that are much better."""
    config = read_config(study())
    ranking = observer_choice.summary["points"][0]["sides"]["motor"]["kinds"]["luenberger"]
    data = config.to_dict()
    data.pop("tune")
    data["observer"] = {"kind": "luenberger", "motor": ranking["gains"] | {"velocity_error": 0.1}}
    axes = {"bandwidth": np.geomspace(1.0, 3e3, 32), "damping": np.geomspace(0.003, 10.0, 20)}
    data["axes"] = [listed_axis(f"observer.motor.{key}", *values) for key, values in axes.items()]
    data["sweep"]["metrics"] = ["velocity_rmse"]
    frame = sweep(data).frame
    errors = frame.groupby(list(map("observer.motor.{}".format, axes)))["motor.velocity_rmse"].max()
    # between its values the search may find better ones
    assert 0.85 * errors.min() < ranking["error_in_search"] < 1.02 * errors.min()


def test_held_out_errors_are_those_of_runs_with_these_gains(observer_choice):
    """Checked for every kind, on the other input and with seeds that the search has not seen."""
    point = observer_choice.summary["points"][0]["sides"]["motor"]
    assert observer_choice.summary["seeds"] == [0, 1]
    assert observer_choice.summary["holdout"]["seeds"] == [2, 9]
    logs = {}
    for kind, kind_data in point["kinds"].items():
        data = read_config(study()).to_dict()
        data.pop("tune")
        data |= {"excitation": SINE, "sweep": {"seeds": 8, "first_seed": 2, "metrics": ["velocity_rmse"]}}
        data["observer"] = {"kind": kind, "motor": kind_data["gains"] | {"velocity_error": 0.1}}
        # lanes that differ are quickly compiled
        data["axes"] = [listed_axis("observer.motor.velocity_error", 0.1)]
        errors = sweep(data).frame["motor.velocity_rmse"]
        assert kind_data["worst"] == pytest.approx(errors.max())
        logs[kind] = np.log(errors).mean()
        assert kind_data["error"] == pytest.approx(math.exp(logs[kind]), rel=1e-4)
    assert point["best"] == min(logs, key=logs.__getitem__)
    for kind, kind_data in point["kinds"].items():
        assert kind_data["ratio"] == pytest.approx(math.exp(logs[kind] - logs[point["best"]]), rel=1e-4)
        assert kind_data["low"] <= kind_data["ratio"] <= kind_data["high"]


def test_the_chosen_observer_can_be_included(observer_choice, tmp_path):
    kind = observer_choice.summary["for_both_sides"]
    assert kind == observer_choice.summary["points"][0]["sides"]["motor"]["best"]
    (tmp_path / "gains.toml").write_text(observer_toml(observer_choice.summary), encoding="utf-8")
    data = read_config(study()).to_dict()
    data.pop("tune")
    data.pop("observer")
    (tmp_path / "study.toml").write_text('include = "gains.toml"\n' + tomli_w.dumps(data), encoding="utf-8")
    observer = read_config(tmp_path / "study.toml").build().observer.motor
    assert observer.name == kind
    gains = observer_choice.summary["points"][0]["sides"]["motor"]["kinds"][kind]["gains"]
    assert {key: getattr(observer, key) for key in gains} == gains


def test_a_point_of_a_map_is_what_the_study_there_gives(tmp_path):
    """Also where the point is fixed at compile time; a finished search is only read."""
    axes = [listed_axis("run.sample_period", 1e-3, 2e-3), listed_axis("encoders.noise", 1e-5, 1e-4)]
    table = {"observers": ["super_twisting", "kalman"], "trials": 8, "refine": 0}
    choice = tune(study(**table, axes=axes), tmp_path)
    assert [list(kind_data["values"].values()) for kind_data in choice.summary["points"]] == [
        [1e-3, 1e-5], [1e-3, 1e-4], [2e-3, 1e-5], [2e-3, 1e-4]
    ]  # fmt: skip
    single_choice = tune(study({"run.sample_period": 2e-3, "encoders.noise": 1e-4}, **table))
    for kind, kind_data in single_choice.summary["points"][0]["sides"]["motor"]["kinds"].items():
        point_data = choice.summary["points"][3]["sides"]["motor"]["kinds"][kind]
        assert point_data == {key: pytest.approx(value) for key, value in kind_data.items()}
    second = tune(study(**table, axes=axes), tmp_path)
    assert (second.cost["lanes"], second.summary) == (0.0, choice.summary)
    assert choice.cost["lanes"] == 4 * 2 * (8 * 2 + 8)


def test_the_low_pass_is_searched_with_the_torque_and_each_side_has_its_own():
    ranking = tune(
        small_study(
            tune={"observers": ["super_twisting", "extended_state"], "objective": "torque", "trials": 8, "refine": 0}
        )
    )
    sides = ranking.summary["points"][0]["sides"]
    constants = [sides[side]["kinds"]["extended_state"]["gains"]["equivalent_control.time_constant"] for side in sides]
    assert constants[0] != constants[1]
    kind = ranking.summary["for_both_sides"]
    text = observer_toml(ranking.summary)
    assert f'kind = "{kind}"' in text
    assert "# A study has one equivalent_control.time_constant" in text


def test_drives_of_an_uncertain_model_are_served_at_once():
    """The worst over the corners is not below the nominal drive's error."""
    table = {"observers": ["luenberger", "kalman"], "refine": 0}
    worst, nominal = (tune(study(**table, worst_over_uncertainty=flag)).summary for flag in (True, False))
    assert len(worst["scenarios"]) == 5
    assert "worst over 5 drives" in " ".join(worst["remarks"])
    for kind, kind_data in nominal["points"][0]["sides"]["motor"]["kinds"].items():
        assert worst["points"][0]["sides"]["motor"]["kinds"][kind]["error"] > 0.99 * kind_data["error"]


def test_what_is_too_slow_is_not_chosen():
    ranking = tune(study(observers=["luenberger", "dirty_derivative"], refine=0, longest_convergence=1e-9)).summary
    side = ranking["points"][0]["sides"]["motor"]
    assert (side["best"], ranking["for_both_sides"], observer_toml(ranking)) == (None, None, None)


def test_a_search_zooms_inside_of_its_range_and_says_where_it_ends():
    side = SideSearch({"a": (1.0, 100.0), "b": (2.0, 2.0)})
    trials = side.trial_gains(np.array([[0.0], [0.5], [1.0]]))
    np.testing.assert_allclose([trial["a"] for trial in trials], [1.0, 10.0, 100.0])
    assert {trial["b"] for trial in trials} == {2.0}
    side.zoom_in(trials, np.array([1.0, 2.0, 3.0]))
    assert (side.best, side.error, side.gains_at_ends()) == ({"a": 1.0, "b": 2.0}, 1.0, ["a"])
    low, high = side.window["a"]
    assert (low, high) == (1.0, pytest.approx(100.0 ** (1.0 / 3.0)))
    # trials that are worse change nothing but the window
    side.zoom_in(side.trial_gains(np.array([[0.5]])), np.array([5.0]))
    assert (side.best["a"], side.error_before) == (1.0, 1.0)
    # a kind that diverges everywhere has no best
    lost = SideSearch({"a": (1.0, 100.0)})
    lost.zoom_in(lost.trial_gains(np.array([[0.5]])), np.array([np.inf]))
    assert (lost.best, lost.window["a"]) == ({}, (1.0, 100.0))


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"observers": ["kalmann"]}, r"tune: observers\[0\]: unknown kind 'kalmann'; did you mean 'kalman'\?"),
        ({"observers": ["kalman", "kalman"]}, r"observers\[1\]: 'kalman' is listed already"),
        ({"observers": ["kalman"], "margin_exact": 1.5}, r"margin_exact does not go with observers"),
        (
            {"observers": ["kalman"], "axes": [listed_axis("observer.motor.alpha", 1.0)]},
            r"axes\[0\].path: 'observer.motor.alpha' is",
        ),
        (
            {"observers": ["kalman"], "axes": [{"path": "encoders.noise", "start": 0.0, "stop": 1.0}]},
            r"axes\[0\].num is missing",
        ),
        ({"axes": [listed_axis("encoders.noise", 1.0)]}, r"axes needs observers"),
        ({"trials": 8}, r"trials needs observers"),
    ],
)
def test_wrong_tables_get_one_line(table, message):
    arguments = rigid_study(tune=table)
    with pytest.raises(InputError, match=message) as error:
        tune(arguments)
    assert "\n" not in str(error.value)


def test_an_axis_over_no_path_names_the_nearest():
    with pytest.raises(InputError, match=r"axes\[0\]: unknown path 'encoders.nois'; nearest valid path: 'encoders.noise'"):
        tune(study(axes=[listed_axis("encoders.nois", 1e-5)]))
