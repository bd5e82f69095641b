"""Figures as a page holds them: the text in their place, and values that can be read back."""

import base64

import numpy as np
import pytest

from jaxbl.report.figures import Drawn, save, subplots
from jaxbl.report.picture import picture

pytestmark = pytest.mark.usefixtures("every_figure_drawn")


def unpack(text):
    return np.frombuffer(base64.b64decode(text), "<f4")


def draw_picture(tmp_path, draw):
    figure, (left, right) = subplots(6.0, 3.0, columns=2)
    draw(left)
    right.barh([0, 1], [3.0, 4.0])
    right.set_yticks([0, 1], ["first", "second"])
    drawing = Drawn("one", figure, "What it shows.")
    save(figure, tmp_path / "one.png")
    return picture(drawing)


def test_lines_bars_names_and_a_description(tmp_path):
    x = np.array([0.0, 1.0, 2.0])

    def draw(ax):
        ax.plot(x, [1.0, np.nan, 1e50], label=r"price in \$")
        ax.axhline(0.5)
        ax.set(xlabel="time (s)", yscale="log")

    picture = draw_picture(tmp_path, draw)
    left, right = picture.panels
    # the line that only marks a place is none of values
    (line,) = left["lines"]
    assert line["name"] == "price in $" and line["sorted"]
    np.testing.assert_array_equal(unpack(line["x"]), x)
    y = unpack(line["y"])
    assert y[0] == 1.0 and np.isnan(y[1]) and y[2] == np.finfo(np.float32).max
    assert left["y"]["log"] and not left["x"]["log"]
    assert right["bars"] == [[0.0, -0.4, 3.0, 0.8], [0.0, 0.6, 4.0, 0.8]]
    assert right["y"]["names"] == [[0.0, "first"], [1.0, "second"]]
    assert picture.described.startswith("What it shows. x time (s) from ") and "Lines: price in $." in picture.described
    assert picture.size == (576, 288) and picture.svg.startswith(b"<?xml")


@pytest.mark.parametrize("bar", [True, False])
def test_cells_have_values_where_a_colour_bar_says_of_what(tmp_path, bar):
    figure, (ax,) = subplots(6.0, 3.0, beside=True)
    mesh = ax.pcolormesh([0.0, 1.0, 2.0, 3.0], [0.0, 1.0, 2.0], np.ma.masked_equal([[1.0, 2.0, 3.0], [4.0, 5.0, 0.0]], 0.0))
    if bar:
        figure.colorbar(mesh, ax=ax, label="error (rad)")
    drawing = Drawn("map", figure, "A map.")
    save(figure, tmp_path / "map.png")
    (panel,) = picture(drawing).panels
    assert ("cells" in panel) == bar
    if bar:
        assert panel["cells"]["name"] == "error (rad)"
        np.testing.assert_array_equal(unpack(panel["cells"]["x"]), [0.0, 1.0, 2.0, 3.0])
        np.testing.assert_array_equal(unpack(panel["cells"]["values"]), [1.0, 2.0, 3.0, 4.0, 5.0, np.nan])


@pytest.mark.parametrize("count", [100, 50_000])
def test_clouds_and_long_lines_stay_small(tmp_path, count):
    values = np.random.default_rng(0).standard_normal((2, count))
    picture = draw_picture(tmp_path, lambda ax: ax.plot(*values, "."))
    assert len(picture.svg) < 200_000
    (line,) = picture.panels[0]["lines"]
    assert 1 < len(unpack(line["x"])) <= 30_000
    assert draw_picture(tmp_path, lambda ax: ax.plot(*values, ".")) == picture
