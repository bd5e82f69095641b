"""Gains against the conditions in the units of a drive: what is drawn, and what is said of it."""

import numpy as np
import pytest
from panel_parts import names_of, part_named, parts_of

from jaxbl.observer.conditions import CONDITIONS, judge_gains
from jaxbl.report.drawing import draw_canvas
from jaxbl.report.gain_plane import condition_curves, describe_conditions, draw_gain_plane
from jaxbl.report.panels import Band

GAINS = {
    "exact holds": (1.24, 2.84, 1.97, "the exact condition holds. λ may fall to "),
    "all hold": (12.0, 3.1, 1.5, "the exact condition holds. λ may fall to "),
    "none holds": (0.005, 1.8, 1.59, "λ = 0.005 √rad/s is too small: it has to exceed 1.21 (exact condition)."),
    "no lambda": (0.0, 1.8, 1.59, "λ = 0 √rad/s is too small: it has to exceed 1.21 (exact condition)."),
    "alpha too small": (4.0, 1.0, 1.5, "α = 1 rad/s² is too small, as it has to exceed f⁺."),
    "no gains": (0.0, 0.0, 1.5, "α = 0 rad/s² is too small, as it has to exceed f⁺."),
}  # fmt: skip


@pytest.mark.usefixtures("every_figure_drawn")
@pytest.mark.parametrize("case", GAINS)
def test_plane_and_sentence_agree_with_the_numbers(case):
    lambda_, alpha, bound, text = GAINS[case]
    result = judge_gains(lambda_, alpha, bound)
    (line,) = describe_conditions({"motor": result}, "of a test")
    assert line.startswith(f"motor: f⁺ = {bound:g} rad/s² is of a test; ")
    assert text in line
    drawing = draw_gain_plane("motor", result)
    (panel,) = drawing.panels
    star = part_named(panel, "the observer's gains")
    assert (star.x, star.y, star.held) == ([alpha], [lambda_], True)
    # what fails is shaded below the exact condition
    (band,) = parts_of(panel, Band)
    at = np.asarray(band.x) > 1.01 * bound
    least = [judge_gains(1.0, x, bound)["least_lambda"]["exact"] for x in np.asarray(band.x)[at][::80]]
    np.testing.assert_allclose(np.asarray(band.high)[at][::80], least, rtol=1e-6)
    assert {"fails", "exact, ρ < 1", "usual rule"} <= {*names_of(panel)}
    # a star outside lies on the edge, and above and on the right are the same axes in units of f⁺
    canvas, (ax,) = draw_canvas(drawing)
    canvas.draw_without_rendering()
    (x,), (y,) = next(line for line in ax.lines if line.get_marker() == "*").get_data()
    low, high = ax.get_ylim()
    assert (x, y) == (max(alpha, ax.get_xlim()[0]), max(lambda_, low))
    assert high > low > 0.0
    top, right = ax.child_axes
    np.testing.assert_allclose(top.get_xlim(), np.array(ax.get_xlim()) / bound)
    np.testing.assert_allclose(right.get_ylim(), np.array(ax.get_ylim()) / np.sqrt(bound))


@pytest.mark.parametrize("alpha_is_x", [True, False])
def test_curves_are_those_of_the_conditions_and_carry_their_names(alpha_is_x):
    curves = [curve for curve in condition_curves(CONDITIONS, 1.5, (1.0, 20.0), alpha_is_x) if curve.name]
    for curve, (name, condition) in zip(curves, CONDITIONS.items(), strict=True):
        assert curve.name == condition.title and curve.at_line
        alphas, least = (curve.x, curve.y) if alpha_is_x else (curve.y, curve.x)
        assert least[200] == pytest.approx(judge_gains(1.0, alphas[200], 1.5)["least_lambda"][name], rel=1e-6), name


def test_undisturbed_the_exact_condition_alone_asks_for_no_more_than_a_lambda():
    result = judge_gains(0.1, 1.0, 0.0)
    (line,) = describe_conditions({"motor": result}, "of a test")
    assert line.endswith("nothing disturbs the observer, and any λ > 0 is enough.")
    assert result["holds"]["exact"] and not result["holds"]["seeber_horn"]


def test_factors_lead_to_where_the_exact_condition_fails():
    result = judge_gains(1.24, 2.84, 1.97)
    (line,) = describe_conditions({"motor": result}, "of a test")
    factor = float(line.partition(" √rad/s (")[2].partition(" ")[0])
    growth = float(line.partition(" rad/s² (")[2].partition(" ")[0])
    for share, holds in ((0.999, True), (1.001, False)):
        assert judge_gains(1.24 / (factor * share), 2.84, 1.97)["holds"]["exact"] == holds
        assert judge_gains(1.24, 2.84, 1.97 * growth * share)["holds"]["exact"] == holds


def test_without_a_disturbance_no_condition_asks_for_anything():
    (line,) = describe_conditions({"load": judge_gains(1.0, 2.0, 0.0)}, "of a test")
    assert "nothing disturbs the observer" in line
