"""Figures and reports of any result, by two functions."""

import inspect
from typing import Any

import numpy as np
import pytest
from small_study import ALPHA, LAMBDA, make_result, rigid_study, spaced_axis

import jaxbl
from jaxbl.json_types import JsonObject
from jaxbl.report import results


@pytest.fixture(scope="module")
def study():
    axes = [spaced_axis(ALPHA, 1.0, 50.0, 5), spaced_axis(LAMBDA, 1.0, 20.0, 4)]
    figures = [
        {"kind": "heatmap", "x": ALPHA, "y": LAMBDA, "value": f"motor.{name}"} for name in ("chatter", "velocity_rmse")
    ]
    return make_result(rigid_study(axes=axes, figures=figures))


def test_a_notebook_shows_figures_with_captions_and_texts(study):
    figures, heatmap = jaxbl.draw(study), jaxbl.draw(study, "heatmap_motor_chatter")
    assert len(figures) == 2 and [drawing.name for drawing in heatmap] == ["heatmap_motor_chatter"]
    html = heatmap._repr_html_()
    assert html.count("<figure>") == 1 and f"<figcaption>{heatmap[0].caption}</figcaption>" in html
    assert "x α, switching gain (rad/s²) from " in html.partition('alt="')[2].partition('"')[0]


def test_a_report_makes_its_folder_and_says_its_lines(study, tmp_path):
    result = jaxbl.write_report(study, str(tmp_path / "a" / "b"))
    assert result.headline.startswith("20 runs: ") and result.sentences[0] == result.headline
    assert sorted(file.name for file in (tmp_path / "a" / "b").iterdir()) == ["figures", "manifest.json", "report.html"]


def test_a_sweep_that_asks_for_other_metrics_says_where_they_go(study, tmp_path):
    """Without convergence among the metrics the first sentence is on those that the figures show."""
    tables = {"axes": study.config.to_dict()["axes"], "figures": study.config.to_dict()["figures"]}
    result = jaxbl.describe(make_result(rigid_study({"sweep.metrics": ["chatter", "velocity_rmse"]}, **tables)))
    assert result.verdict == "no answer" and " In 20 runs, motor: " in result.headline and " goes from " in result.headline
    (error,) = result.key_figures
    assert error.meaning == "motor: velocity error, rms" and error.value.endswith(" rad/s") and " to " in error.value
    study = rigid_study({"sweep.metrics": ["chatter", "velocity_rmse"]}, **tables)
    empty = dict.fromkeys(("motor__chatter", "motor__velocity_rmse"), lambda frame: np.nan)
    nothing = jaxbl.describe(make_result(study, finite=lambda frame: False, **empty))
    assert nothing.verdict == "failed" and nothing.headline.endswith(" In 20 runs, no figure has a number.")


def test_each_kind_of_result_goes_to_its_own_functions():
    for kind, functions in results._KINDS.items():
        calls = (getattr(functions.report, name) for name in ("describe", "draw", "write"))
        first = [next(iter(inspect.signature(call).parameters.values())).annotation for call in calls]
        # logs are described by their summary alone, and one function writes every fit to one
        assert first[0] in (kind, JsonObject) and first[1] == kind and first[2] in (kind, Any)


def test_what_is_no_result_or_no_figure_is_said(study, tmp_path):
    with pytest.raises(jaxbl.InputError, match="no figure 'heatmap_motor_chater'; did you mean 'heatmap_motor_chatter'"):
        jaxbl.draw(study, "heatmap_motor_chater")
    with pytest.raises(jaxbl.InputError, match="no report of dict; a result should be one of Trial, StudyResult"):
        jaxbl.draw({})
    (tmp_path / "file").write_text("")
    with pytest.raises(jaxbl.InputError, match="file: is a file; --out should name a folder"):
        jaxbl.write_report(study, tmp_path / "file")
