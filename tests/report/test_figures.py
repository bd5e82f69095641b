"""What figures share: thinned lines, ends of axes, and a base that is loaded without JAX."""

import subprocess
import sys

import numpy as np
import pytest

from jaxbl.report.figures import limits, literal, outline, save, subplots

pytestmark = pytest.mark.usefixtures("every_figure_drawn")


def test_the_base_and_the_report_of_inspect_need_no_jax():
    modules = ["page", "figures", "inspect"]
    code = f"import sys, {', '.join('jaxbl.report.' + name for name in modules)}; print('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"


def test_outline_keeps_the_extremes_and_the_order():
    values = np.random.default_rng(0).standard_normal(100_003)
    values[7] = 50.0
    values[99_999] = -60.0
    values[2000:9000] = np.nan
    index = outline(values, 2400)
    assert len(index) < 2500
    assert np.all(np.diff(index) >= 0)
    assert np.nanmax(values[index]) == 50.0 and np.nanmin(values[index]) == -60.0
    assert np.isnan(values[index]).any()


def test_a_few_outliers_do_not_set_the_ends_of_an_axis():
    values = np.sin(np.arange(10_000))
    values[5] = 1e6
    ends = limits(values, shown=[2.0])
    assert ends is not None
    assert -1.5 < ends[0] < -1.0 and 2.0 < ends[1] < 2.5
    assert limits(np.array([np.nan])) is None
    assert limits(np.array([3.0, 3.0])) == pytest.approx((2.7, 3.3))


def test_a_user_s_name_is_drawn_as_it_is(tmp_path):
    """No mathematics, no line breaks, no warning where the font lacks a letter, and not longer than a legend is wide."""
    figure, (ax,) = subplots(3.0, 2.0)
    for name in (r"$\frac{$", r"a\$b$", "\x1b[31m\n", "漢", "x" * 5000):
        ax.plot([0.0, 1.0], label=literal(name))
    ax.legend()
    save(figure, tmp_path / "figure.png")
    labels = [text.get_text().replace(r"\$", "$") for text in ax.get_legend().get_texts()]
    assert labels[:4] == [r"$\frac{$", r"a\$b$", r"\x1b[31m\n", "漢"]
    assert len(labels[4]) == 40
