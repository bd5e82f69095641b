"""Folders of every command are explored: what their pages hold, and that they draw it."""

import dataclasses
import json
import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest
from browser import check_figures, needs_chromium, open_pages
from shared_results import VERIFY_STUDY
from small_study import ALPHA, LAMBDA, NOISE, listed_axis, make_result, rigid_study, small_study, spaced_axis

from jaxbl.errors import InputError
from jaxbl.files import ResultFolder
from jaxbl.gains.tune import tune
from jaxbl.monitoring.watch import watch
from jaxbl.report.explorer.folder import write_static
from jaxbl.report.explorer.sources import open_source
from jaxbl.report.results import write_report
from jaxbl.sweeps.compare import compare
from jaxbl.sweeps.trial import run

pytestmark = pytest.mark.usefixtures("compiled_once")


def read_page(folder, out):
    """What a page says of a folder's results, its points, and where it is."""
    page = write_static(open_source(folder), out)
    data = json.loads((out / "data.js").read_text().removeprefix("jaxblData(").rstrip().removesuffix(");"))
    return data, pq.read_table(out / "points.parquet").to_pandas(), page


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    trial = run(small_study({"run.duration": 1.5}))
    return folder, trial, write_report(trial, folder)


def test_a_simulated_run_has_the_errors_of_its_observers(run_folder, tmp_path):
    folder, trial, card = run_folder
    data, table, _ = read_page(folder, tmp_path / "page")
    names = [group["name"] for group in data["groups"]]
    assert names[:2] == ["motor: velocity error", "motor: position error"] and "torque in the transmission" in names
    error = trial.trace["motor.velocity"] - trial.trace["motor.velocity_estimate"]
    np.testing.assert_allclose(table["motor.velocity_error"], error, rtol=1e-5, atol=1e-6)
    assert data["period"] == pytest.approx(1e-3) and "twist" in {one["column"] for one in data["coordinates"]}
    assert (data["title"], data["lead"]) == (card.title, dataclasses.replace(card, details=()).sentences)


def test_a_watch_has_both_observers_values(run_folder, tmp_path):
    folder, *_ = run_folder
    seen = watch(folder / "trace.parquet", small_study(), window=0.5, interval=0.2)
    card = write_report(seen, tmp_path / "watch")
    data, table, _ = read_page(tmp_path / "watch", tmp_path / "page")
    assert data["lead"] == dataclasses.replace(card, details=()).sentences and data["file"] == "watch.json"
    for group in data["groups"]:
        for line in group["lines"]:
            np.testing.assert_allclose(table[line["column"]], seen.values[line["column"]].astype(float), rtol=1e-5)
    assert len(table) == len(seen.values)


@pytest.fixture(scope="module")
def compared_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compared")
    axes = [listed_axis(NOISE, 1e-5, 1e-4), spaced_axis(ALPHA, 2.0, 50.0, 4), spaced_axis(LAMBDA, 1.0, 20.0, 3)]
    study = rigid_study(axes=axes, sweep={"seeds": 3})
    first = make_result(study, motor__velocity_rmse=lambda frame: frame[ALPHA] * (1.0 + 1e-3 * frame["seed"]))
    second = make_result(study, motor__velocity_rmse=lambda frame: frame[ALPHA] * (2.0 + 1e-3 * frame["seed"]))
    write_report(compare(first, second), folder)
    return folder


def test_a_comparison_is_a_map_of_factors(compared_folder, tmp_path):
    data, table, _ = read_page(compared_folder, tmp_path / "page")
    assert data["first"] == "motor.velocity_rmse.factor" and not data["served"] and data["grid"]
    ends = [metric["name"].removeprefix("motor.velocity_rmse.") for metric in data["metrics"]]
    assert ends[:3] == ["factor", "first", "second"]
    np.testing.assert_allclose(table["motor.velocity_rmse.factor"], 2.0, rtol=2e-3)
    (compared_folder / "comparison.parquet").rename(compared_folder / "kept")
    with pytest.raises(
        InputError, match=r"comparison\.parquet: is missing, damaged or edited; run the command that wrote it"
    ):
        write_static(open_source(compared_folder), tmp_path / "again")
    (compared_folder / "kept").rename(compared_folder / "comparison.parquet")


def test_a_comparison_without_a_common_point_has_nothing_to_show(tmp_path):
    first, second = (make_result(rigid_study(axes=[listed_axis(NOISE, noise)])) for noise in (1e-5, 1e-4))
    write_report(compare(first, second), tmp_path)
    with pytest.raises(InputError, match="no point is in both studies: there is nothing to show"):
        open_source(tmp_path)


def test_a_verdict_has_the_runs_of_the_sampled_observers(verified_study, tmp_path):
    verdict, folder = verified_study[0], tmp_path / "verified"
    shutil.copytree(verified_study[1], folder)
    card = write_report(verdict, folder)
    data, table, _ = read_page(folder, tmp_path / "page")
    assert len(table) == len(verdict.levels["sampled"]) and data["title"] == "small"
    assert data["lead"][:3] == [
        card.headline,
        "Shown: sampled.",
        f"Others: drive; such as jaxbl explore {folder}/verify/drive.",
    ]
    shutil.copytree(folder, tmp_path / "empty", ignore=shutil.ignore_patterns("verify"))
    with pytest.raises(InputError, match="verify: holds no runs; run the command that wrote it again"):
        open_source(tmp_path / "empty")
    assert VERIFY_STUDY["title"] == "small"


def test_tuned_gains_have_the_map_of_the_search(tmp_path):
    ends = {"start": 1.2, "stop": 8.0}
    study = rigid_study({"tune.num": 3, "tune.refine": 0, "tune.alpha_ratio": ends, "tune.lambda_ratio": ends})
    tuning = tune(study, tmp_path / "tuned")
    card = write_report(tuning, tmp_path / "tuned")
    data, table, _ = read_page(tmp_path / "tuned", tmp_path / "page")
    assert data["lead"][0] == card.headline
    assert {axis["paths"][0]["path"] for axis in data["axes"]} == {ALPHA, LAMBDA, "seed"} and len(table) == 9


@needs_chromium
def test_pages_of_runs_and_comparisons_draw(run_folder, compared_folder, tmp_path):
    files = [read_page(folder, tmp_path / name)[2] for name, folder in (("a", run_folder[0]), ("b", compared_folder))]
    with open_pages(*files) as (signals, factors):
        signals.wait_for_selector("body[data-drawn^='motor: velocity error motor.velocity ']")
        factors.wait_for_selector(f"body[data-drawn='motor.velocity_rmse.factor {ALPHA} {LAMBDA}']")
        for page in (signals, factors):
            check_figures(page, 0)
            assert page.locator(".plane .uplot").count() >= 1


def test_the_newest_results_of_a_folder_count(run_folder, tmp_path):
    folder, *_ = run_folder
    shutil.copytree(folder, tmp_path / "both")
    with ResultFolder.read(tmp_path / "both").write_files("comparison.json") as draft:
        (draft / "comparison.json").write_text("{}")
    with pytest.raises(InputError, match=r"both/study\.toml: is missing"):
        open_source(tmp_path / "both")
