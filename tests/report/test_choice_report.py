"""What a choice of observer leaves behind: sentences, figures, tables that agree with its numbers."""

import copy
import json

import numpy as np
import pytest
from panel_parts import parts_of
from small_study import listed_axis, rigid_study
from test_page import Page

from jaxbl.gains.tune import tune
from jaxbl.report.drawing import save
from jaxbl.report.observer_choice import choice_headline, draw as draw_choice
from jaxbl.report.panels import Line
from jaxbl.report.results import describe, draw, write_report

# points differ in values of lanes alone
pytestmark = pytest.mark.usefixtures("compiled_once")
KINDS = ["super_twisting", "luenberger", "kalman"]


def choose_observer(*axes):
    effects = [{"kind": "motor.constant_torque", "torque": 0.05}]
    table = {"observers": KINDS, "trials": 8, "refine": 0, "axes": list(axes)}
    changes = {"observer.motor.velocity_error": 0.1, "encoders.noise": 1e-5}
    return tune(rigid_study(changes, title="a <b> choice", effects=effects, tune=table))


@pytest.fixture(scope="module")
def point_choice():
    return choose_observer()


@pytest.fixture(scope="module")
def mapped_choice():
    return choose_observer(
        listed_axis("encoders.noise", 1e-6, 1e-5, 1e-4), listed_axis("encoders.motor_resolution", 0.0, 1e-4)
    )


@pytest.fixture(scope="module", params=["point_choice", "mapped_choice"])
def report_folder(request, tmp_path_factory):
    path = tmp_path_factory.mktemp(request.param)
    result = write_report(request.getfixturevalue(request.param), path)
    (path / "lines").write_text("\n".join([result.headline, *result.remarks, *result.details]), encoding="utf-8")
    return path


def test_report_holds_lines_numbers_and_figures(report_folder):
    summary = json.loads((report_folder / "tuning.json").read_text(encoding="utf-8"))
    single = len(summary["points"]) == 1
    assert (report_folder / "gains.toml").exists() == single
    page = Page((report_folder / "report.html").read_text(encoding="utf-8"))
    assert "a <b> choice" in page.text
    assert {path.stem for path in (report_folder / "figures").iterdir()} == {"observers"}
    lines = (report_folder / "lines").read_text(encoding="utf-8").splitlines()
    assert all(line in page.text for line in lines)
    for line in summary["remarks"]:
        assert line in lines


def test_the_table_has_the_numbers_of_the_summary(point_choice):
    motor = point_choice.summary["points"][0]["sides"]["motor"]
    assert choice_headline(point_choice.summary)[0].startswith(f"motor: {motor['best']} is best")
    result = describe(point_choice)
    rows = {row[0]: row for row in result.tables[0].rows}
    for kind, errors in motor["kinds"].items():
        assert rows[kind][1:6] == [errors[key] for key in ("error", "worst", "ratio", "low", "high")]
    assert point_choice.summary["for_both_sides"] in result.headline


def test_kinds_that_are_alike_are_said_first(point_choice):
    summary = copy.deepcopy(point_choice.summary)
    side = summary["points"][0]["sides"]["motor"]
    best, second = list(side["kinds"])[:2]
    side["not_told_apart"] = [second]
    assert choice_headline(summary)[0].startswith(f"motor: {best} is best; not told apart from the best: {second}")
    side["kinds"][second]["ratio"] = None
    assert choice_headline(summary)[0].endswith(f"; diverge somewhere, or are too slow: {second}.")
    side["best"] = None
    assert choice_headline(summary)[0] == "motor: all kinds diverge, or are too slow."


def test_the_point_figure_has_a_dot_at_each_ratio(point_choice):
    (drawing,) = draw_choice(point_choice)
    (panel,) = drawing.panels
    kinds = point_choice.summary["points"][0]["sides"]["motor"]["kinds"]
    assert [name for _, name in panel.y.names] == list(kinds)
    (dots,) = [line for line in parts_of(panel, Line) if line.marker == "o"]
    np.testing.assert_allclose(dots.x, [kind["ratio"] for kind in kinds.values()])
    assert drawing.name == "observers" and "rad/s" in drawing.caption


def test_over_several_points_the_figure_has_the_range_of_each_kind(mapped_choice, tmp_path):
    (drawing,) = draw(mapped_choice)
    (panel,) = drawing.panels
    dots, words = (next(line for line in parts_of(panel, Line) if line.marker == marker) for marker in ("o", " "))
    results = [point["sides"]["motor"] for point in mapped_choice.summary["points"]]
    ratios = {kind: [result["kinds"][kind]["ratio"] for result in results] for kind in KINDS}
    for (_, kind), x, text in zip(panel.y.names, dots.x, words.texts, strict=True):
        assert x == pytest.approx(np.median(ratios[kind]))
        wins = sum(result["best"] == kind for result in results)
        assert text == (f"best at {wins} of 6 points" if wins else "")
    assert (np.diff(dots.x) >= 0.0).all() and "Of 6 points" in drawing.caption
    save(drawing, tmp_path / "ranges.png")


def test_kinds_that_diverge_are_last(mapped_choice):
    choice = copy.deepcopy(mapped_choice)
    sides = [point["sides"]["motor"] for point in choice.summary["points"]]
    for side in sides:
        side["kinds"]["kalman"]["ratio"] = None
    sides[0]["kinds"]["luenberger"]["ratio"] = None
    for side in sides:
        side["best"] = "super_twisting"
    (panel,) = draw_choice(choice)[0].panels
    texts = {name: text for line in parts_of(panel, Line) for text, name in zip(line.texts, line.y, strict=False)}
    assert [name for _, name in panel.y.names][-1] == "kalman" and texts[2] == "diverged, or too slow"
    assert "diverges, or is too slow, at 1" in texts.values()


def test_points_won_are_counted(mapped_choice):
    (line,) = choice_headline(mapped_choice.summary)
    winners = [point["sides"]["motor"]["best"] for point in mapped_choice.summary["points"]]
    for kind in set(winners):
        assert f"{kind} is best at {winners.count(kind)} of 6 points" in line
