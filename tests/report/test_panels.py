"""Figures as data: thinned lines, ends of axes, and a base that is loaded without JAX or matplotlib."""

import subprocess
import sys

import numpy as np
import pytest

from jaxbl.report.panels import Band, Line, intervals, join, limits, literal, thin, tick_text


@pytest.mark.parametrize(("modules", "unwanted"), [("panels", "matplotlib"), ("page, jaxbl.report.inspect", "jax")])
def test_the_base_and_the_report_of_inspect_load_little(modules, unwanted):
    code = f"import sys, jaxbl.report.{modules}; print('{unwanted}' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"


def test_a_long_signal_keeps_its_extremes_its_order_and_its_breaks():
    values = np.random.default_rng(0).standard_normal(100_003)
    values[7] = 50.0
    values[99_999] = -60.0
    values[2000:9000] = np.nan
    time = 1e-3 * np.arange(len(values))
    line = thin(Line(time, values))
    assert len(line.x) < 2500 and np.all(np.diff(line.x) >= 0)
    assert np.nanmax(line.y) == 50.0 and np.nanmin(line.y) == -60.0
    assert np.isnan(line.y).any()
    band = thin(Band(time, values - 1.0, values + 1.0))
    assert len(band.x) < 1300 and np.nanmax(band.high) == 51.0 and np.nanmin(band.low) == -61.0
    short = Line(time[:100], values[:100])
    assert thin(short) is short


def test_a_path_is_thinned_along_itself():
    turns = np.linspace(0.0, 40.0, 50_000)
    path = thin(Line(np.cos(turns), np.sin(turns)))
    assert 4000 < len(path.x) <= 8000
    np.testing.assert_allclose(np.hypot(path.x, path.y), 1.0)


def test_parts_of_a_signal_are_joined_with_breaks():
    time, values = join(np.arange(10.0), [slice(0, 3), slice(6, 10)], np.arange(10.0) ** 2)
    np.testing.assert_array_equal(time, [0, 1, 2, 2, 6, 7, 8, 9, 9])
    np.testing.assert_array_equal(values, [0, 1, 4, np.nan, 36, 49, 64, 81, np.nan])


@pytest.mark.parametrize("upright", [False, True])
def test_intervals_are_strokes_with_a_point(upright):
    strokes, points = intervals([1.0, 2.0], [3.0, 5.0], [4.0, 6.0], [8.0, 9.0], "found", upright=upright)
    along, across = ("y", "x") if upright else ("x", "y")
    np.testing.assert_array_equal(getattr(strokes, along), [3.0, 8.0, np.nan, 5.0, 9.0, np.nan])
    np.testing.assert_array_equal(getattr(strokes, across), [1, 1, 1, 2, 2, 2])
    assert (getattr(points, along), points.name, points.width) == ([4.0, 6.0], "found", 0.0)


def test_a_few_outliers_do_not_set_the_ends_of_an_axis():
    values = np.sin(np.arange(10_000))
    values[5] = 1e6
    ends = limits(values, inside=[2.0])
    assert ends is not None
    assert -1.5 < ends[0] < -1.0 and 2.0 < ends[1] < 2.5
    assert limits(np.array([np.nan])) is None
    assert limits(np.array([3.0, 3.0])) == pytest.approx((2.7, 3.3))


def test_a_user_s_name_is_one_short_line():
    assert literal("\x1b[31m\n") == r"\x1b[31m\n" and literal("漢") == "漢"
    assert len(literal("x" * 5000)) == 40


@pytest.mark.parametrize(
    ("value", "text"), [(0.0, "0"), (0.002, "0.002"), (1e-5, "10⁻⁵"), (-2e-4, "-2·10⁻⁴"), (2e5, "2·10⁵"), (50.0, "50")]
)
def test_numbers_of_axes_are_plain_or_powers_of_ten(value, text):
    assert tick_text(value) == text
