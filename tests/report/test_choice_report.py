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
from jaxbl.report.observer_choice import choice_headline, draw as draw_choice, short_names
from jaxbl.report.panels import Line, Map
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
    names = {"observers"} if single else {"observers_motor"}
    assert {path.stem for path in (report_folder / "figures").iterdir()} == names
    lines = (report_folder / "lines").read_text(encoding="utf-8").splitlines()
    assert all(line in page.text for line in lines)
    for line in summary["remarks"]:
        assert line in lines


def test_the_table_has_the_numbers_of_the_summary(point_choice):
    motor = point_choice.summary["points"][0]["sides"]["motor"]
    assert next(choice_headline(point_choice.summary)).startswith(f"motor: {motor['best']} is best")
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
    assert next(choice_headline(summary)).startswith(f"motor: {best} is best; not told apart from the best: {second}")
    side["kinds"][second]["ratio"] = None
    assert next(choice_headline(summary)).endswith(f"; diverge somewhere, or are too slow: {second}.")
    side["best"] = None
    assert next(choice_headline(summary)) == "motor: all kinds diverge, or are too slow."


def test_the_point_figure_has_a_dot_at_each_ratio(point_choice):
    (drawing,) = draw_choice(point_choice)
    (panel,) = drawing.panels
    kinds = point_choice.summary["points"][0]["sides"]["motor"]["kinds"]
    assert [name for _, name in panel.y.names] == list(kinds)
    (dots,) = [line for line in parts_of(panel, Line) if line.marker == "o"]
    np.testing.assert_allclose(dots.x, [kind["ratio"] for kind in kinds.values()])
    assert drawing.name == "observers" and "rad/s" in drawing.caption


def test_the_map_names_the_best_kind_in_each_cell(mapped_choice, tmp_path):
    (drawing,) = draw(mapped_choice, "observers_motor")
    (line,) = parts_of(drawing.panels[0], Line)
    short_kinds = short_names(KINDS)
    cells = dict(zip(zip(line.x, line.y, strict=True), line.texts, strict=True))
    assert len(cells) == 6
    for point in mapped_choice.summary["points"]:
        noise, resolution = point["values"].values()
        side = point["sides"]["motor"]
        # x is the last axis
        text = cells[int(resolution > 0.0), [1e-6, 1e-5, 1e-4].index(noise)]
        first, _, second = text.partition("\n")
        assert first == short_kinds[side["best"]] + "=" * bool(side["not_told_apart"])
        assert bool(second) == (side["best"] != "super_twisting")
    save(drawing, tmp_path / "map.png")


def test_over_one_axis_the_map_has_one_row(mapped_choice, tmp_path):
    line_choice = choose_observer(listed_axis("encoders.noise", 1e-6, 1e-5, 1e-4))
    panels = [next(draw_choice(choice)).panels[0] for choice in (line_choice, mapped_choice)]
    one, both = (parts_of(panel, Map)[0].values for panel in panels)
    assert one.shape == (1, 3)
    # the same points are in the map
    np.testing.assert_array_equal(one[0], both[:, 0])
    save(next(draw_choice(line_choice)), tmp_path / "map.png")


def test_points_won_are_counted(mapped_choice):
    (line,) = choice_headline(mapped_choice.summary)
    winners = [point["sides"]["motor"]["best"] for point in mapped_choice.summary["points"]]
    for kind in set(winners):
        assert f"{kind} is best at {winners.count(kind)} of 6 points" in line


def test_short_names_are_different():
    names = ["super_twisting", "differentiator_3", "differentiator_1", "dirty_derivative", "slow_tracker", "steady_twin"]
    short_by_name = short_names(names)
    assert short_by_name["super_twisting"] == "ST"
    assert short_by_name["differentiator_3"] == "D3"
    assert len(set(short_by_name.values())) == len(names)
