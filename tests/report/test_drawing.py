"""Figures as matplotlib draws them: files, the text in their place, and what their page can read back."""

import base64

import numpy as np
import pytest

from jaxbl.report.drawing import draw_canvas, picture, save
from jaxbl.report.panels import Axis, Bars, Figure, Line, Map, Panel, Scale, Span, mark, round_ticks

pytestmark = pytest.mark.usefixtures("every_figure_drawn")
SCALE = Scale(1.0, 100.0, "error (rad)", log=True)


def unpack(text):
    return np.frombuffer(base64.b64decode(text), "<f4")


def make_figure(*parts, **axis):
    names = Axis(names=((0, "first"), (1, "second")))
    right = Panel(Axis("length (m)"), names, [Bars([0, 1], [3.0, 4.0], texts=["3", "4"])])
    return Figure("one", [Panel(Axis("time (s)", "t"), Axis("value (m)", **axis), parts), right], "What it shows.", 2)


def test_lines_names_and_a_description(tmp_path):
    x = np.array([0.0, 1.0, 2.0])
    line = Line(x, [1.0, np.nan, 1e50], "price in $")
    shown = picture(make_figure(line, Span(0.5, 0.5, along="y"), log=True), tmp_path / "a" / "one.png")
    assert (tmp_path / "a" / "one.png").stat().st_size > 5000
    left, right = shown.panels
    (drawn,) = left["lines"]
    assert drawn["name"] == "price in $"
    np.testing.assert_array_equal(unpack(drawn["x"]), x)
    y = unpack(drawn["y"])
    assert y[0] == 1.0 and np.isnan(y[1]) and y[2] == np.finfo(np.float32).max
    assert [(span["along"], span["low"]) for span in left["spans"]] == [("y", 0.5)]
    assert left["y"]["log"] and not left["x"]["log"] and left["x"]["key"] == "t"
    assert right["y"]["names"] == [[0, "first"], [1, "second"]]
    assert shown.described.startswith("What it shows. x time (s) from ") and "Lines: price in $." in shown.described
    assert shown.size[0] == 653 and shown.svg.startswith(b"<?xml")


def test_the_same_figure_is_the_same_file_and_follows_the_page_s_colours():
    figure = make_figure(Line([0.0, 1.0], [0.0, 1.0], "a line"))
    svg = picture(figure).svg
    assert picture(figure).svg == svg
    assert b"currentColor" in svg and b"prefers-color-scheme: dark" in svg
    drawn = svg.partition(b"</style>")[2]
    assert b"#000000" not in drawn and b"#ffffff" not in drawn


def test_a_failed_region_is_one_grey_with_one_entry_and_colours_are_for_the_rest():
    values = np.array([[1.0, 2.0, 3.0], [1e9, 5.0, np.nan]])
    failed = np.array([[False, False, False], [True, False, True]])
    cells = Map([0.0, 1.0, 2.0, 3.0], [0.0, 1.0, 2.0], values, SCALE, failed, "failed (2 points)")
    figure = Figure("map", [Panel(Axis("x (m)"), Axis("y (m)"), [cells])], "A map.")
    canvas, (ax,) = draw_canvas(figure)
    grey, colours = (np.ma.masked_invalid(mesh.get_array()) for mesh in ax.collections)
    np.testing.assert_array_equal(~np.ma.getmaskarray(grey), failed)
    np.testing.assert_array_equal(np.ma.getmaskarray(colours), failed)
    assert [text.get_text() for text in canvas.legends[0].get_texts()] == ["failed (2 points)"]
    assert canvas.axes[-1].get_ylabel() == "error (rad)"
    (panel,) = picture(figure).panels
    assert (panel["cells"]["label"], panel["cells"]["log"]) == ("error (rad)", True)
    np.testing.assert_array_equal(unpack(panel["cells"]["values"]), np.float32(values.ravel()))


def test_equal_axes_are_shared_and_named_once():
    time = Axis("time (s)")
    panels = [
        Panel(time, Axis(f"{name} (m)"), [Line([0.0, end], [0.0, 1.0], name)]) for name, end in (("a", 1.0), ("b", 3.0))
    ]
    canvas, (above, below) = draw_canvas(Figure("two", panels, "Two."))
    assert above.get_xlim() == below.get_xlim() and below.get_xlim()[1] > 3.0
    assert (above.get_xlabel(), below.get_xlabel()) == ("", "time (s)")
    # names of their own stand above each
    assert not canvas.legends and [ax.get_legend().get_texts()[0].get_text() for ax in (above, below)] == ["a", "b"]
    assert above.bbox.x0 == pytest.approx(below.bbox.x0)


def test_a_mark_outside_lies_on_the_edge_and_a_name_on_its_line():
    curve = Line([1.0, 10.0], [1.0, 10.0], "the curve", at_line=True)
    axis = Axis("a (1)", log=True, ends=(1.0, 10.0))
    canvas, (ax,) = draw_canvas(Figure("marks", [Panel(axis, axis, [curve, mark(99.0, 2.0, "far")])], "Marks."))
    (star,) = (line for line in ax.lines if line.get_marker() == "*")
    assert star.get_xydata().tolist() == [[10.0, 2.0]]
    assert [text.get_text() for text in ax.texts] == ["the curve"]
    assert [text.get_text() for text in canvas.legends[0].get_texts()] == ["far"]


@pytest.mark.parametrize(
    ("ends", "ticks"),
    [((0.5, 30.0), [0.5, 1, 2, 5, 10, 20]), ((1e-3, 1e2), [1e-3, 1e-2, 0.1, 1, 10, 100]), ((7.0, 3.0), [5])],
)
def test_ticks_of_logarithmic_axes_are_round(ends, ticks):
    assert round_ticks(*ends) == pytest.approx(ticks)
    assert len(round_ticks(1e-30, 1e30)) < 10


@pytest.mark.parametrize("count", [100, 50_000])
def test_clouds_and_long_lines_stay_small(count):
    values = np.random.default_rng(0).standard_normal((2, count))
    for how in ({"width": 0.0, "marker": "."}, {}):
        shown = picture(make_figure(Line(*values, **how)))
        assert len(shown.svg) < 400_000
        (line,) = shown.panels[0]["lines"]
        assert 1 < len(unpack(line["x"])) <= 8000


def test_a_user_s_name_is_drawn_as_it_is(tmp_path):
    """No mathematics, and no warning where the font lacks a letter."""
    names = [r"$\frac{$", r"a\$b$", "漢"]
    figure = make_figure(*(Line([0.0, 1.0], [0.0, 1.0], name) for name in names))
    save(figure, tmp_path / "figure.png")
    legend = draw_canvas(figure)[0].legends[0]
    assert [(text.get_text(), text.get_parse_math()) for text in legend.get_texts()] == [(name, False) for name in names]
