"""The page and figures of a verification."""

import dataclasses
import shutil

import numpy as np
import pytest
import tomli_w
from browser import check_figures, needs_chromium, open_pages
from panel_parts import names_of, part_named
from shared_results import VERIFY_STUDY

from jaxbl.config import read_config
from jaxbl.observer.conditions import judge_gains
from jaxbl.report.results import write_report
from jaxbl.report.verify import describe as describe_verdict, draw as draw_verdict
from jaxbl.sweeps.engine import Engine


@pytest.fixture(scope="module")
def verify_report(verified_study, tmp_path_factory):
    verdict, _ = verified_study
    folder = tmp_path_factory.mktemp("verdict")
    return verdict, folder, write_report(verdict, folder)


def test_figures(verify_report):
    verdict, _, _ = verify_report
    drawings = {drawing.name: drawing for drawing in draw_verdict(verdict)}
    assert list(drawings) == ["atlas"]
    assert all(drawing.caption for drawing in drawings.values())
    (atlas,) = drawings["atlas"].panels
    assert {"exact, ρ < 1", "simulated boundary", "usual pair (1.5, 1.1)", "small gains"} <= {*names_of(atlas)}
    # the boundary's points are those of the bisection
    np.testing.assert_array_equal(part_named(atlas, "simulated boundary").y, verdict.error_map.boundary)


def test_page_and_lines(verify_report):
    verdict, folder, result = verify_report
    page = (folder / "report.html").read_text()
    for text in ("small gains", "Moreno-Osorio"):
        assert text in page
    # the answer is about the study's own gains
    assert result.verdict == "good" and result.headline.startswith("The study's own gains are safe: ")
    assert result.headline.endswith("Of those marked not safe: small gains.")
    bound = verdict.levels["drive"]["motor.f_plus"].max()
    least = judge_gains(4.0, 9.0, bound)["least_lambda"]["exact"]
    assert result.key_figures[0] == (
        f"× {4.0 / least:.3g}", "the study's gains, motor: λ over the least that is safe (exact condition)"
    )  # fmt: skip
    assert result.remarks[0].startswith(
        f"motor: f⁺ = {bound:.3g} rad/s² is the largest of all runs; the exact condition holds."
    )
    # smaller ones are not, which comes first
    data = verdict.config.to_dict()
    data["observer"]["motor"]["lambda"] = 0.5 * least
    weak = describe_verdict(dataclasses.replace(verdict, config=read_config(data)))
    assert weak.verdict == "failed" and weak.headline.startswith("Not safe: the study's gains, motor.")
    assert any("failed although a condition held" in line and "Causes, by experiment" in line for line in result.remarks)
    marks = {row[0]: dict(zip(result.tables[0].columns, row, strict=True)) for row in result.tables[0].rows}
    assert marks["small gains"]["margin to ρ < 1"] < 1.0 < marks["good gains"]["margin to ρ < 1"]
    assert len(list((folder / "figures").glob("*.png"))) == 1


@needs_chromium
def test_the_page_in_a_browser(verify_report):
    with open_pages(verify_report[1] / "report.html") as (page,):
        check_figures(page, 1)


def test_command_leaves_a_verdict_counterexamples_figures_and_report(verified_study, call, tmp_path, monkeypatch):
    folder = tmp_path / "results" / "study_verdict"
    shutil.copytree(verified_study[1], folder)
    for name in ("verdict.json", "counterexamples.parquet"):
        (folder / name).unlink()
    (tmp_path / "study.toml").write_text(tomli_w.dumps(VERIFY_STUDY))
    # all runs are there
    monkeypatch.setattr(Engine, "run", lambda *_: pytest.fail("a finished verification simulates"))
    code, lines, _ = call("verify", "study.toml")
    assert code == 0
    assert {path.stem for path in folder.glob("figures/*.png")} == {"atlas"}
    assert all((folder / name).is_file() for name in ("verdict.json", "counterexamples.parquet", "manifest.json"))
    assert lines[0].startswith("✓ Good: The study's own gains are safe")
    assert lines[-1] == "results/study_verdict/report.html"
    # the second call says the same, and plot draws it again
    assert call("verify", "study.toml")[:2] == (0, lines)
    assert call("plot", "results/study_verdict", "--config", "study.toml")[:2] == (0, lines)
