"""Figures of a study, looked at as matplotlib objects."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.collections import PathCollection, QuadMesh
from matplotlib.colors import LogNorm
from small_study import ALPHA, LAMBDA, NOISE, listed_axis, make_result, rigid_study, small_study, spaced_axis

from jaxbl.config import read_config
from jaxbl.errors import InputError
from jaxbl.observer.conditions import least_lambda_seeber_horn
from jaxbl.report.checks import check_figures
from jaxbl.report.figures import save
from jaxbl.report.maps import draw
from jaxbl.report.results import write_report

RMSE = "motor.velocity_rmse"
GAINS = [spaced_axis(ALPHA, 1.0, 50.0, 5), spaced_axis(LAMBDA, 1.0, 20.0, 4)]


def heatmap_figure(**keys):
    return {"kind": "heatmap", "x": ALPHA, "y": LAMBDA, "value": RMSE} | keys


def line_figure(**keys):
    return {"kind": "line", "x": ALPHA, "value": RMSE} | keys


def product_error(frame):
    return frame[ALPHA] * frame[LAMBDA]


def draw_only_figure(tmp_path, data, **columns):
    """The one figure of a study, drawn to the end."""
    (drawing,) = draw(make_result(data, **columns))
    assert save(drawing.figure, tmp_path / "a" / f"{drawing.name}.png").stat().st_size > 5000
    assert plt.get_fignums() == []  # nothing is left in pyplot's own list
    return drawing


def panels(drawing):
    """Axes of the panels, the colour bar left out."""
    return [ax for ax in drawing.figure.axes if ax.get_visible() and ax.get_xlabel()]


def find_mesh(ax):
    # the next one is the grey of what is undefined
    return next(c for c in ax.collections if isinstance(c, QuadMesh))


def legend_texts(drawing):
    return [text.get_text() for legend in drawing.figure.legends for text in legend.get_texts()]


def test_heatmap_has_each_value_in_its_cell_with_units_on_its_axes(tmp_path):
    drawing = draw_only_figure(
        tmp_path,
        small_study(axes=GAINS, figures=[heatmap_figure()]),
        motor__velocity_rmse=product_error,
        motor__margin_alpha=lambda frame: 2.0 * frame[ALPHA],
    )
    (ax,) = panels(drawing)
    values, corners = find_mesh(ax).get_array(), find_mesh(ax).get_coordinates()
    alphas, lambdas = np.geomspace(1.0, 50.0, 5), np.geomspace(1.0, 20.0, 4)
    np.testing.assert_allclose(values, lambdas[:, None] * alphas)
    np.testing.assert_allclose(np.sqrt(corners[0, :-1, 0] * corners[0, 1:, 0]), alphas)
    np.testing.assert_allclose(np.sqrt(corners[:-1, 0, 1] * corners[1:, 0, 1]), lambdas)
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    assert ax.get_xlabel() == "observer.motor.alpha (rad/s²)"
    assert ax.get_ylabel() == "observer.motor.lambda (√rad/s)"
    assert drawing.figure.axes[-1].get_ylabel() == "motor: velocity error, rms (rad/s)"
    # from 1 to 1000: a logarithmic colour scale, and the best point marked
    assert isinstance(find_mesh(ax).norm, LogNorm)
    assert "best ★ 1 rad/s" in ax.get_title()
    assert drawing.caption == "motor: velocity error, rms (rad/s) over observer.motor.alpha and observer.motor.lambda."


def test_panels_share_one_colour_scale(tmp_path):
    data = small_study(axes=[*GAINS, listed_axis(NOISE, 1e-4, 1e-5)], figures=[heatmap_figure(facet=NOISE)])
    drawing = draw_only_figure(tmp_path, data, motor__velocity_rmse=lambda frame: frame[NOISE] * 1e5)
    low, high = panels(drawing)
    assert low.get_title().startswith("encoders.noise = 1e-05 rad")
    assert high.get_title().startswith("encoders.noise = 0.0001 rad")
    assert find_mesh(low).norm is find_mesh(high).norm
    np.testing.assert_allclose([find_mesh(low).get_array().min(), find_mesh(high).get_array().max()], [1.0, 10.0])


def test_median_over_seeds_and_share_of_what_is_true(tmp_path):
    data = small_study(axes=GAINS, sweep={"seeds": 5}, figures=[heatmap_figure()])
    drawing = draw_only_figure(tmp_path, data, motor__velocity_rmse=lambda frame: frame["seed"] ** 3.0)
    assert (find_mesh(panels(drawing)[0]).get_array() == 8.0).all()
    assert drawing.caption.endswith("; median over 5 seeds.")
    data = small_study(axes=GAINS, sweep={"seeds": 5}, figures=[heatmap_figure(value="motor.converged")])
    drawing = draw_only_figure(tmp_path, data, motor__converged=lambda frame: frame["seed"] < 2)
    np.testing.assert_allclose(find_mesh(panels(drawing)[0]).get_array(), 0.4)
    assert find_mesh(panels(drawing)[0]).get_clim() == (0.0, 1.0)
    assert drawing.caption.endswith("; share over 5 seeds.")


def test_errors_with_a_sign_are_drawn_by_size(tmp_path):
    data = small_study(axes=GAINS, figures=[heatmap_figure(value="motor.dead_zone_error")])
    drawing = draw_only_figure(tmp_path, data, motor__dead_zone_error=lambda frame: -product_error(frame))
    assert find_mesh(panels(drawing)[0]).get_array().min() > 0.0
    assert drawing.caption.startswith("motor: |error of the dead zone|")


@pytest.mark.parametrize("value", [RMSE, "motor.converged"])
def test_diverged_points_are_left_grey_and_counted(tmp_path, value):
    data = small_study(axes=GAINS, figures=[heatmap_figure(value=value)])
    columns = {"motor__velocity_rmse": product_error, "motor__converged": lambda frame: frame[ALPHA] < 0.0}
    drawing = draw_only_figure(tmp_path, data, finite=lambda frame: frame[ALPHA] < 40.0, **columns)
    (ax,) = panels(drawing)
    gone = np.ma.getmaskarray(find_mesh(ax).get_array())
    assert gone[:, -1].all()
    assert not gone[:, :-1].any()
    assert legend_texts(drawing)[-1] == "diverged (4 points)"


def test_what_did_not_converge_is_hatched(tmp_path):
    data = small_study(axes=GAINS, figures=[heatmap_figure()])
    plain_drawing = draw_only_figure(tmp_path, data, motor__velocity_rmse=product_error)
    partly_hatched = draw_only_figure(
        tmp_path,
        data,
        motor__velocity_rmse=product_error,
        motor__converged=lambda frame: frame[ALPHA] > 5.0,
        motor__margin_alpha=lambda frame: frame[ALPHA],
    )
    fully_hatched = draw_only_figure(
        tmp_path, data, motor__velocity_rmse=product_error, motor__converged=lambda frame: frame[ALPHA] < 0.0
    )
    assert legend_texts(plain_drawing) == []
    assert legend_texts(partly_hatched) == legend_texts(fully_hatched) == ["motor not converged"]
    # the best is sought among those that converged
    assert "best ★ 7.1" in panels(partly_hatched)[0].get_title()


def test_conditions_are_drawn_for_the_median_bound_of_the_panel(tmp_path):
    data = small_study(axes=GAINS, figures=[heatmap_figure(overlays=["davila_fridman", "seeber_horn", "exact"])])
    drawing = draw_only_figure(tmp_path, data, motor__f_plus=lambda frame: np.full(len(frame), 2.0))
    (ax,) = panels(drawing)
    assert "f⁺ = 2 rad/s²" in ax.get_title()
    assert legend_texts(drawing) == ["Davila-Fridman (32), q → 0", "Seeber-Horn 2017", "exact, ρ < 1"]
    alpha, least = next(curve for curve in ax.lines if curve.get_linestyle() == "--").get_data()
    np.testing.assert_allclose(least, least_lambda_seeber_horn(alpha, 2.0))
    assert alpha[0] == pytest.approx(2.0, rel=1e-3)
    assert alpha[-1] == pytest.approx(50.0)


ODD_FIGURES = {
    "all NaN": (
        small_study(axes=GAINS, figures=[heatmap_figure()]),
        {"motor__velocity_rmse": lambda frame: frame[ALPHA] * np.nan},
    ),
    "all inf": (
        small_study(axes=GAINS, figures=[heatmap_figure()]),
        {"motor__velocity_rmse": lambda frame: frame[ALPHA] * np.inf},
    ),
    "all zero": (
        small_study(axes=GAINS, figures=[heatmap_figure()]),
        {"motor__velocity_rmse": lambda frame: frame[ALPHA] * 0.0},
    ),
    "log of zeros": (
        small_study(axes=GAINS, figures=[heatmap_figure(scale="log")]),
        {"motor__velocity_rmse": lambda frame: 1.0 * (frame[ALPHA] > 40.0)},
    ),
    "one row": (
        small_study(axes=[GAINS[0], listed_axis(LAMBDA, 3.0)], figures=[heatmap_figure()]),
        {"motor__velocity_rmse": product_error},
    ),
    "one cell": (small_study(axes=[listed_axis(ALPHA, 3.0), listed_axis(LAMBDA, 0.0)], figures=[heatmap_figure()]), {}),
    "bound above all gains": (
        small_study(axes=GAINS, figures=[heatmap_figure(overlays=["exact"])]),
        {"motor__f_plus": lambda frame: 99.0 * frame[ALPHA]},
    ),
    "no bound": (
        small_study(axes=GAINS, figures=[heatmap_figure(overlays=["exact"])]),
        {"motor__f_plus": lambda f: f[ALPHA] * np.nan},
    ),
    "zipped": (
        small_study(axes=[listed_axis(p, 1.0, 2.0, 4.0, zip="g") for p in (ALPHA, LAMBDA)], figures=[heatmap_figure()]),
        {},
    ),
    "lines of NaN": (
        small_study(axes=GAINS, figures=[line_figure()]),
        {"motor__velocity_rmse": lambda frame: frame[ALPHA] * np.nan},
    ),
    "default of three axes": (small_study(axes=[listed_axis(NOISE, 0.0, 1e-4), *GAINS]), {}),
    "default of one": (rigid_study(axes=[listed_axis("observer.discretisation", "implicit", "explicit"), GAINS[0]]), {}),
    "seven panels": (
        small_study(axes=[*GAINS, spaced_axis(NOISE, 1e-5, 1e-3, 7)], figures=[line_figure(facet=NOISE, series=LAMBDA)]),
        {},
    ),
}


@pytest.mark.parametrize("case", ODD_FIGURES)
def test_odd_studies_are_drawn(tmp_path, case):
    data, columns = ODD_FIGURES[case]
    assert panels(draw_only_figure(tmp_path, data, **columns))


def test_a_study_of_words_alone_has_no_default_figure():
    assert draw(make_result(rigid_study(axes=[listed_axis("observer.discretisation", "implicit", "explicit")]))) == []


def test_words_as_panels(tmp_path):
    axes = [*GAINS, listed_axis("observer.discretisation", "implicit", "explicit")]
    drawing = draw_only_figure(tmp_path, rigid_study(axes=axes, figures=[heatmap_figure(facet="observer.discretisation")]))
    assert [ax.get_title().split("\n")[0] for ax in panels(drawing)] == [
        "observer.discretisation = explicit",
        "observer.discretisation = implicit",
    ]


def test_quasi_random_points_are_dots_and_diverged_ones_crosses(tmp_path):
    axes = [spaced_axis(ALPHA, 1.0, 50.0), spaced_axis(LAMBDA, 1.0, 20.0)]
    sweep = {"design": "sobol", "points": 32}
    wild = {"finite": lambda frame: frame[ALPHA] < 10.0}
    drawing = draw_only_figure(
        tmp_path, small_study(axes=axes, sweep=sweep, figures=[heatmap_figure()]), motor__velocity_rmse=product_error, **wild
    )
    (ax,) = panels(drawing)
    (dots,) = (c for c in ax.collections if isinstance(c, PathCollection))
    x, y = dots.get_offsets().T
    assert (x < 10.0).all()
    np.testing.assert_allclose(dots.get_array(), x * y)
    assert len(dots.get_offsets()) + len(ax.lines[0].get_xdata()) == 32
    assert legend_texts(drawing) == [f"diverged ({len(ax.lines[0].get_xdata())} points)"]
    # over one of its axes a design has no line
    drawing = draw_only_figure(
        tmp_path, small_study(axes=axes, sweep=sweep, figures=[line_figure()]), motor__velocity_rmse=product_error
    )
    assert panels(drawing)[0].lines[0].get_linestyle() == "None"
    assert "median" not in drawing.caption


def test_lines_have_a_median_a_band_and_a_legend_with_units(tmp_path):
    data = small_study(axes=GAINS, sweep={"seeds": 3}, figures=[line_figure(series=LAMBDA)])
    drawing = draw_only_figure(
        tmp_path, data, motor__velocity_rmse=lambda frame: product_error(frame) * (1.0 + frame["seed"])
    )
    (ax,) = panels(drawing)
    np.testing.assert_allclose(ax.lines[0].get_ydata(), 2.0 * np.geomspace(1.0, 50.0, 5))
    band = ax.collections[0].get_paths()[0].vertices[:, 1]
    assert (band.min(), band.max()) == pytest.approx((1.0, 150.0))
    assert ax.get_legend().get_title().get_text() == "observer.motor.lambda (√rad/s)"
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    assert ax.get_ylabel() == "motor: velocity error, rms (rad/s)"
    assert drawing.caption.endswith("; median over 3 seeds; band: least to largest.")


def test_where_leaves_the_other_points_out(tmp_path):
    data = rigid_study(axes=GAINS, figures=[line_figure(where={LAMBDA: "largest"})])
    drawing = draw_only_figure(tmp_path, data, motor__velocity_rmse=product_error)
    np.testing.assert_allclose(panels(drawing)[0].lines[0].get_ydata(), 20.0 * np.geomspace(1.0, 50.0, 5))
    assert drawing.caption.endswith(f"over {ALPHA} where {LAMBDA} = 20 √rad/s.")


def test_lines_with_a_theory_show_fit_range_and_slope(tmp_path):
    axes = [spaced_axis(ALPHA, 1.0, 1e4, 9), listed_axis(LAMBDA, 1.0, 2.0)]
    data = rigid_study(axes=axes, figures=[line_figure(series=LAMBDA, theory=1.0)])
    drawing = draw_only_figure(
        tmp_path, data, motor__velocity_rmse=lambda f: np.where(f[LAMBDA] == 1.0, 1e-5 * np.maximum(f[ALPHA], 30.0), 0.0)
    )
    (ax,) = panels(drawing)
    hollow, filled, fitted, theory, *_ = ax.lines
    assert (hollow.get_markerfacecolor(), len(hollow.get_xdata())) == ("none", 3)
    np.testing.assert_allclose(filled.get_xdata(), np.geomspace(1.0, 1e4, 9)[3:])
    np.testing.assert_allclose(fitted.get_ydata(), 1e-5 * fitted.get_xdata())
    assert theory.get_linestyle() == "--"
    assert ax.get_ylim()[0] > 1e-5  # theory's line does not stretch the axis
    texts = [text.get_text() for text in ax.get_legend().get_texts()]
    assert texts[0].startswith("1: 1.000 ± ")
    assert texts[1] == "2: no law (float resolution)"
    assert ax.get_legend().get_title().get_text() == "slope (theory 1, dashed)"
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    # one panel a value, and nothing to draw in one of them
    data = rigid_study(axes=axes, figures=[line_figure(facet=LAMBDA, theory=1.0)])
    drawing = draw_only_figure(
        tmp_path, data, motor__velocity_rmse=lambda f: np.where(f[LAMBDA] == 1.0, 1e-5 * f[ALPHA], 0.0)
    )
    assert [ax.get_title() for ax in panels(drawing)] == [f"{LAMBDA} = 1 √rad/s", f"{LAMBDA} = 2 √rad/s"]
    assert panels(drawing)[1].texts[0].get_text() == "nothing above zero to draw"


def test_figures_of_one_metric_get_names_of_their_own():
    names = [
        d.name
        for d in draw(
            make_result(small_study(axes=GAINS, figures=[heatmap_figure(), line_figure(), line_figure(series=LAMBDA)]))
        )
    ]
    assert names == ["heatmap_motor_velocity_rmse", "line_motor_velocity_rmse", "line_motor_velocity_rmse-2"]


WORDS = "observer.discretisation"
BAD = {
    "unknown axis": (
        line_figure(x="observer.motor.alfa"),
        f"figures[0].x: 'observer.motor.alfa' is not an axis of this study; did you mean '{ALPHA}'?",
    ),
    "no axis": (heatmap_figure(facet=NOISE), "figures[0].facet: 'encoders.noise' is not an axis of this study; valid: "),
    "unknown metric": (
        line_figure(value="motor.velocity_rms"),
        f"figures[0].value: 'motor.velocity_rms' is no metric; did you mean '{RMSE}'?",
    ),
    "axis as metric": (line_figure(value=ALPHA), "is no metric"),
    "metric of no load": (line_figure(value="load.velocity_rmse"), "is no metric; did you mean 'motor.velocity_rmse'?"),
    "words as x": (line_figure(x=WORDS), f"figures[0].x: '{WORDS}' has no numeric values; use it as facet or series"),
    "words as y": (heatmap_figure(y=WORDS), f"figures[0].y: '{WORDS}' has no numeric values; use it as facet"),
}


@pytest.mark.parametrize("case", BAD)
def test_figure_of_what_is_not_there(case):
    figure, message = BAD[case]
    result = make_result(rigid_study(axes=[*GAINS, listed_axis(WORDS, "implicit", "explicit")], figures=[figure]))
    with pytest.raises(InputError) as error:
        draw(result)
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("figure", "key", "part"),
    [(heatmap_figure, "facet", "panel"), (line_figure, "facet", "panel"), (line_figure, "series", "line")],
)
def test_more_parts_than_a_figure_can_have(figure, key, part):
    axes = [*GAINS, spaced_axis(NOISE, 1e-6, 1e-3, 61)]
    with pytest.raises(InputError) as error:
        draw(make_result(rigid_study(axes=axes, figures=[figure(**{key: NOISE})])))
    message = f"figures[0].{key}: '{NOISE}' has 61 values, each of which would be a {part}; at most 60 "
    message += "can be drawn; name another axis, or give it fewer values"
    assert str(error.value) == message
    # a study that asks for no figures gets one all the same
    (drawing,) = draw(make_result(rigid_study(axes=axes[::-1])))
    assert drawing.caption.endswith(f"median over {NOISE}.")


@pytest.mark.parametrize(
    ("figure", "message"),
    [
        (line_figure(), f"figures[0].value: '{RMSE}' is not computed; add 'velocity_rmse' to sweep.metrics"),
        (
            line_figure(value="motor.chatter", theory=1.0, where={LAMBDA: "least"}),
            "figures[0].theory: 'motor.position_size' is not",
        ),
        (
            heatmap_figure(value="motor.chatter", overlays=["exact"]),
            "figures[0].overlays: 'motor.converged' is not computed; add 'converged' to sweep.metrics",
        ),
    ],
)
def test_figure_of_what_the_study_does_not_compute(figure, message):
    with pytest.raises(InputError) as error:
        draw(make_result(rigid_study(axes=GAINS, figures=[figure], sweep={"metrics": ["chatter"]})))
    assert message in str(error.value)


@pytest.mark.parametrize("metrics", [["chatter"], ["converged"], ["convergence_time", "margin_exact"]])
def test_default_figure_and_report_of_some_metrics(tmp_path, metrics):
    result = make_result(rigid_study(axes=GAINS, sweep={"metrics": metrics}))
    (drawing,) = draw(result)
    assert drawing.name == f"heatmap_motor_{metrics[0]}"
    headline = write_report(result, tmp_path).headline
    assert ("the motor observer converges in 100.0 %" in headline) == ("converged" in metrics)


def test_figures_of_a_study_without_axes():
    config = read_config(rigid_study(figures=[line_figure()]))
    with pytest.raises(InputError, match="the study has no axes"):
        check_figures(config, config.figures, [RMSE])
