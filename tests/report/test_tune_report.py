"""What a tuning leaves behind: gains that can be included, numbers, figures, page."""

import copy
import dataclasses
import json
import tomllib

import matplotlib.pyplot as plt
import numpy as np
import pytest
from browser import check_figures, needs_chromium, open_pages
from panel_parts import names_of, part_named, parts_of
from small_study import small_study
from test_page import Page

from jaxbl.config import read_config
from jaxbl.gains.tune import tune
from jaxbl.report.panels import Line, Map
from jaxbl.report.results import describe, write_report
from jaxbl.report.tune import _size, draw as draw_tuning
from jaxbl.sweeps.trial import run

SLOW_GAINS = {"lambda": 1e-3, "alpha": 0.05}
STUDY = small_study(
    {"title": "two <b> sides", "run.velocity_tolerance": 0.2, "run.position_tolerance": 0.1, "excitation.amplitude": 0.5},
    tune={"num": 4, "refine": 1, "alpha_ratio": {"stop": 20.0}, "lambda_ratio": {"stop": 20.0},
          "compare": [{"name": "slow", "motor": SLOW_GAINS, "load": SLOW_GAINS}]},
)  # fmt: skip


@pytest.fixture(scope="module")
def tuning():
    return tune(STUDY)


@pytest.fixture(scope="module")
def report_folder(tuning, tmp_path_factory):
    path = tmp_path_factory.mktemp("tuned")
    result = write_report(tuning, path)
    path.joinpath("lines").write_text("\n".join([result.headline, *result.remarks, *result.details]))
    return path


def test_gains_can_be_included_and_run(report_folder, tuning):
    text = (report_folder / "gains.toml").read_text(encoding="utf-8")
    # exact numbers, and what they are for
    assert {side: tomllib.loads(text)["observer"][side]["alpha"] for side in ("motor", "load")} == {
        side: gains["alpha"] for side, gains in tuning.summary["gains"].items()
    }
    assert "# Objective: worst velocity_rmse (rad/s) over seeds and scenarios; 1 noise seed and 1 drive." in text
    assert "two <b> sides" in text
    study = small_study({"include": str(report_folder / "gains.toml")}, observer={"motor": {"velocity_error": 0.5}})
    config = read_config(study)
    for side, gains in tuning.summary["gains"].items():
        observer = getattr(config.observer, side)
        assert (observer.lambda_, observer.alpha) == (gains["lambda"], gains["alpha"])
    assert config.observer.motor.velocity_error == 0.5
    assert run(study).summary["conditions"]["motor"]["alpha"] == tuning.summary["gains"]["motor"]["alpha"]


def test_numbers_figures_and_page(report_folder, tuning):
    assert json.loads((report_folder / "tuning.json").read_text(encoding="utf-8")) == tuning.summary
    names = ["tuning_load", "tuning_motor"]
    assert sorted(path.stem for path in (report_folder / "figures").iterdir()) == names
    assert plt.get_fignums() == []
    page = Page((report_folder / "report.html").read_text(encoding="utf-8"))
    assert len(page.images) == 2
    lines = (report_folder / "lines").read_text().splitlines()
    for text in (*lines, "two <b> sides", "usual rule", "slow", "On the study's excitation with other noise"):
        assert text in page.text
    assert f"take λ = {tuning.summary['gains']['motor']['lambda']:.4g} √rad/s, α = " in lines[0].replace("Take", "take")
    assert any("the gains 'slow' converge in only 0 % of the held-out runs" in line for line in lines)


def test_map_has_the_coarse_stage_its_optimum_and_the_others(tuning):
    (panel,) = next(d for d in draw_tuning(tuning) if d.name == "tuning_motor").panels
    (cells,) = parts_of(panel, Map)
    coarse = tuning.candidates["motor"].query("stage == 0").sort_values(["lambda", "alpha"])
    np.testing.assert_allclose(np.ravel(cells.values), coarse["error"])
    np.testing.assert_array_equal(np.ravel(cells.failed), ~coarse["converged"].to_numpy(bool))
    # colours are for what works
    works = coarse[coarse["converged"].astype(bool)]["error"]
    assert cells.scale.low >= 0.5 * works.min() and cells.scale.high <= 1.5 * works.max()
    gains = tuning.summary["gains"]["motor"]
    star = part_named(panel, "tuned")
    assert (star.x, star.y) == ([gains["alpha"]], [gains["lambda"]])
    # in units of f⁺ above and on the right
    bound = tuning.summary["f_plus"]["motor"]
    assert [axis.ratio[0] for axis in (panel.x, panel.y)] == pytest.approx([bound, bound**0.5])
    assert {"not converged in time", "exact, ρ < 1", "usual rule", "config", "slow (off the map)", "tuned"} <= {
        *names_of(panel)
    }
    # nothing below the margins asked for, which lie above the exact condition
    (dotted,) = (line for line in parts_of(panel, Line) if line.dashes == ":")
    margins = tuning.summary["margins"]
    assert np.min(dotted.x) == pytest.approx(margins["alpha"] * bound)
    exact = part_named(panel, "exact, ρ < 1")
    np.testing.assert_allclose(np.asarray(dotted.y)[1:], margins["exact"] * np.asarray(exact.y))
    # on the edge, not outside
    assert part_named(panel, "slow").held


def set_binding(summary, binding):
    """The summary, as if some constraints of the motor had bound."""
    summary = copy.deepcopy(summary)
    motor = summary["limits"]["motor"]
    motor["binding"] = binding
    for name in binding:
        motor["constraints"][name]["binds"] = True
        motor["towards"]["lambda"]["smaller"] = {
            "limit": "constraint",
            "missed": [name],
            "at": 1.0,
            "change": -0.5,
            "by": None,
        }
    return summary


def test_a_sentence_and_a_table_name_the_constraint_that_binds(tuning):
    for binding in ([], ["margin_exact"]):
        result = dataclasses.replace(tuning, summary=set_binding(tuning.summary, binding))
        forbidden = "motor: a smaller error is forbidden by margin_exact."
        assert (forbidden in describe(result).remarks) == bool(binding)
        (row,) = [row for row in describe(result).tables[0].rows if row[0].startswith("motor: λ")]
        assert ("misses margin_exact" in row[3]) == bool(binding)


@pytest.mark.parametrize(
    ("change", "text"),
    [(0.996, "+100 %"), (-0.9999, "-100 %"), (-0.5, "-50 %"), (0.0123, "+1.2 %"), (0.0, "0 %"), (1.0, "× 2")],
)
def test_a_change_has_no_exponent(change, text):
    assert _size(change) == text


@needs_chromium
def test_the_page_in_a_browser(report_folder):
    with open_pages(report_folder / "report.html") as (page,):
        check_figures(page, 2)
