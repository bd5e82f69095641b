"""Figures of a study."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from panel_parts import names_of, part_named, parts_of
from small_study import ALPHA, LAMBDA, NOISE, listed_axis, make_result, rigid_study, small_study, spaced_axis

from jaxbl.config import read_config
from jaxbl.errors import InputError
from jaxbl.observer.conditions import least_lambda_seeber_horn
from jaxbl.report.checks import check_figures
from jaxbl.report.drawing import save
from jaxbl.report.maps import draw
from jaxbl.report.panels import Band, Line, Map
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
    assert save(drawing, tmp_path / "a" / f"{drawing.name}.png").stat().st_size > 5000
    assert plt.get_fignums() == []  # nothing is left in pyplot's own list
    return drawing


def find_map(panel):
    (cells,) = parts_of(panel, Map)
    return cells


def test_heatmap_has_each_value_in_its_cell_with_units_on_its_axes(tmp_path):
    drawing = draw_only_figure(
        tmp_path,
        small_study(axes=GAINS, figures=[heatmap_figure()]),
        motor__velocity_rmse=product_error,
        motor__margin_alpha=lambda frame: 2.0 * frame[ALPHA],
        motor__margin_exact=lambda frame: 2.0,
    )
    (panel,) = drawing.panels
    cells, alphas, lambdas = find_map(panel), np.geomspace(1.0, 50.0, 5), np.geomspace(1.0, 20.0, 4)
    np.testing.assert_allclose(cells.values, lambdas[:, None] * alphas)
    np.testing.assert_allclose(np.sqrt(cells.x[:-1] * cells.x[1:]), alphas)
    np.testing.assert_allclose(np.sqrt(cells.y[:-1] * cells.y[1:]), lambdas)
    assert panel.x.log and panel.y.log
    assert (panel.x.label, panel.x.key) == ("α, switching gain (rad/s²)", ALPHA)
    assert (panel.y.label, panel.y.key) == ("λ, correction gain (√rad/s)", LAMBDA)
    # from 1 to 1000: a logarithmic colour scale, and the best point marked
    assert cells.scale == (1.0, 1000.0, "motor: velocity error, rms (rad/s)", True, "viridis")
    assert "best ★ 1 rad/s" in panel.title
    assert drawing.caption == "motor: velocity error, rms (rad/s) over α, switching gain and λ, correction gain."


def test_panels_share_one_colour_scale(tmp_path):
    data = small_study(axes=[*GAINS, listed_axis(NOISE, 1e-4, 1e-5)], figures=[heatmap_figure(facet=NOISE)])
    drawing = draw_only_figure(tmp_path, data, motor__velocity_rmse=lambda frame: frame[NOISE] * 1e5)
    low, high = drawing.panels
    assert low.title.startswith("encoder noise 10 µrad")
    assert high.title.startswith("encoder noise 100 µrad")
    assert find_map(low).scale == find_map(high).scale
    np.testing.assert_allclose([find_map(low).values.min(), find_map(high).values.max()], [1.0, 10.0])


def test_median_over_seeds_and_share_of_what_is_true(tmp_path):
    data = small_study(axes=GAINS, sweep={"seeds": 5}, figures=[heatmap_figure()])
    drawing = draw_only_figure(tmp_path, data, motor__velocity_rmse=lambda frame: frame["seed"] ** 3.0)
    assert (find_map(drawing.panels[0]).values == 8.0).all()
    assert drawing.caption.endswith("; median over 5 seeds.")
    data = small_study(axes=GAINS, sweep={"seeds": 5}, figures=[heatmap_figure(value="motor.converged")])
    drawing = draw_only_figure(tmp_path, data, motor__converged=lambda frame: frame["seed"] < 2)
    cells = find_map(drawing.panels[0])
    np.testing.assert_allclose(cells.values, 0.4)
    assert (cells.scale.low, cells.scale.high) == (0.0, 1.0)
    assert drawing.caption.endswith("; share over 5 seeds.")


def test_errors_with_a_sign_are_drawn_by_size(tmp_path):
    data = small_study(axes=GAINS, figures=[heatmap_figure(value="motor.dead_zone_error")])
    drawing = draw_only_figure(tmp_path, data, motor__dead_zone_error=lambda frame: -product_error(frame))
    assert find_map(drawing.panels[0]).values.min() > 0.0
    assert drawing.caption.startswith("motor: |error of the dead zone|")


@pytest.mark.parametrize("value", [RMSE, "motor.converged"])
def test_diverged_points_are_left_grey_and_counted(tmp_path, value):
    data = small_study(axes=GAINS, figures=[heatmap_figure(value=value)])
    columns = {"motor__velocity_rmse": product_error, "motor__converged": lambda frame: frame[ALPHA] < 40.0}
    drawing = draw_only_figure(tmp_path, data, finite=lambda frame: frame[ALPHA] < 40.0, **columns)
    cells = find_map(drawing.panels[0])
    assert cells.failed[:, -1].all()
    assert not cells.failed[:, :-1].any()
    assert cells.name == "diverged (4 points)"


def test_what_did_not_converge_is_grey_and_sets_no_colour(tmp_path):
    data = small_study(axes=GAINS, figures=[heatmap_figure()])
    columns = {"motor__velocity_rmse": product_error, "motor__margin_alpha": lambda frame: frame[ALPHA]}
    columns["motor__margin_exact"] = lambda frame: 1.01
    whole = draw_only_figure(tmp_path, data, **columns)
    partly = draw_only_figure(tmp_path, data, motor__converged=lambda frame: frame[ALPHA] > 5.0, **columns)
    nothing = draw_only_figure(tmp_path, data, motor__converged=lambda frame: frame[ALPHA] < 0.0, **columns)
    assert names_of(*whole.panels) == ["best"]
    assert names_of(*partly.panels) == ["not converged (8 points)", "best"]
    assert names_of(*nothing.panels) == ["not converged (20 points)"]
    cells = find_map(partly.panels[0])
    np.testing.assert_array_equal(cells.failed, np.broadcast_to(np.geomspace(1.0, 50.0, 5) < 5.0, (4, 5)))
    assert cells.scale.low == pytest.approx(cells.values[~cells.failed].min())
    # the best is sought among those that converged, and by the exact condition do so at other inputs
    assert "best ★ 7.1" in partly.panels[0].title
    columns["motor__margin_exact"] = lambda frame: 0.3 * frame[LAMBDA]
    assert "best ★ 20 rad/s" in draw_only_figure(tmp_path, data, **columns).panels[0].title


def test_conditions_are_drawn_for_the_median_bound_of_the_panel(tmp_path):
    data = small_study(axes=GAINS, figures=[heatmap_figure(overlays=["davila_fridman", "seeber_horn", "exact"])])
    drawing = draw_only_figure(tmp_path, data, motor__f_plus=lambda frame: np.full(len(frame), 2.0))
    (panel,) = drawing.panels
    assert "f⁺ = 2 rad/s²" in panel.title
    assert names_of(panel)[:3] == ["Davila-Fridman (32), q → 0", "Seeber-Horn 2017", "exact, ρ < 1"]
    curve = part_named(panel, "Seeber-Horn")
    np.testing.assert_allclose(curve.y, least_lambda_seeber_horn(curve.x, 2.0))
    # as far as the axis goes
    assert (curve.x[0], curve.x[-1]) == (pytest.approx(2.0, rel=1e-3), pytest.approx(panel.x.ends[1]))


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
    assert draw_only_figure(tmp_path, data, **columns).panels


def test_a_study_of_words_alone_has_no_default_figure():
    assert draw(make_result(rigid_study(axes=[listed_axis("observer.discretisation", "implicit", "explicit")]))) == []


def test_words_as_panels(tmp_path):
    axes = [*GAINS, listed_axis("observer.discretisation", "implicit", "explicit")]
    drawing = draw_only_figure(tmp_path, rigid_study(axes=axes, figures=[heatmap_figure(facet="observer.discretisation")]))
    assert [panel.title.split("\n")[0] for panel in drawing.panels] == ["discretisation explicit", "discretisation implicit"]


def test_quasi_random_points_are_drawn_by_bins_and_diverged_ones_counted(tmp_path):
    axes = [spaced_axis(ALPHA, 1.0, 50.0), spaced_axis(LAMBDA, 1.0, 20.0)]
    sweep = {"design": "sobol", "points": 1024}
    wild = {"finite": lambda frame: frame[ALPHA] < 10.0}
    study = small_study(axes=axes, sweep=sweep, figures=[heatmap_figure()])
    drawing = draw_only_figure(tmp_path, study, motor__velocity_rmse=product_error, **wild)
    cells = find_map(drawing.panels[0])
    assert cells.values.shape == (16, 16)
    alphas, lambdas = (np.sqrt(edges[1:] * edges[:-1]) for edges in (cells.x, cells.y))
    works = (cells.x[1:] < 10.0)[None, :] & np.isfinite(cells.values)
    # each cell shows points that lie in it
    product = lambdas[:, None] * alphas
    np.testing.assert_allclose(cells.values[works], product[works], rtol=0.25)
    assert cells.failed[:, alphas > 12.0].all() and not cells.failed[works].any()
    assert cells.name.startswith("diverged (")
    # over one of its axes, medians over the others
    study = small_study(axes=axes, sweep=sweep, figures=[line_figure()])
    drawing = draw_only_figure(tmp_path, study, motor__velocity_rmse=product_error)
    line, band = (parts_of(drawing.panels[0], kind)[0] for kind in (Line, Band))
    assert len(line.x) == 16 and (band.low < line.y).all() and (line.y < band.high).all()
    assert "median over λ" in drawing.caption


def test_lines_have_a_median_a_band_and_a_legend_with_units(tmp_path):
    data = small_study(axes=GAINS, sweep={"seeds": 3}, figures=[line_figure(series=LAMBDA)])
    drawing = draw_only_figure(
        tmp_path, data, motor__velocity_rmse=lambda frame: product_error(frame) * (1.0 + frame["seed"])
    )
    (panel,) = drawing.panels
    line, band = (parts_of(panel, kind)[0] for kind in (Line, Band))
    np.testing.assert_allclose(line.y, 2.0 * np.geomspace(1.0, 50.0, 5))
    assert (band.low.min(), band.high.max()) == pytest.approx((1.0, 150.0))
    assert line.name == "λ, correction gain 1 √rad/s"
    assert panel.x.log and panel.y.log
    assert panel.y.label == "motor: velocity error, rms (rad/s)"
    assert drawing.caption.endswith("; median over 3 seeds; band: least to largest.")


def test_where_leaves_the_other_points_out(tmp_path):
    data = rigid_study(axes=GAINS, figures=[line_figure(where={LAMBDA: "largest"})])
    drawing = draw_only_figure(tmp_path, data, motor__velocity_rmse=product_error)
    np.testing.assert_allclose(drawing.panels[0].parts[0].y, 20.0 * np.geomspace(1.0, 50.0, 5))
    assert drawing.caption.endswith("over α, switching gain where λ, correction gain 20 √rad/s.")


def test_lines_with_a_theory_show_fit_range_and_slope(tmp_path):
    axes = [spaced_axis(ALPHA, 1.0, 1e4, 9), listed_axis(LAMBDA, 1.0, 2.0)]
    data = rigid_study(axes=axes, figures=[line_figure(series=LAMBDA, theory=1.0)])
    drawing = draw_only_figure(
        tmp_path, data, motor__velocity_rmse=lambda f: np.where(f[LAMBDA] == 1.0, 1e-5 * np.maximum(f[ALPHA], 30.0), 0.0)
    )
    (panel,) = drawing.panels
    points, fitted, zeros, none = panel.parts
    np.testing.assert_allclose(points.x, np.geomspace(1.0, 1e4, 9))
    np.testing.assert_allclose(fitted.x, np.geomspace(1.0, 1e4, 9)[[3, -1]])
    np.testing.assert_allclose(fitted.y, 1e-5 * fitted.x)
    assert "theory's slope is 1." in drawing.caption
    assert np.isnan(zeros.y).all() and len(none.x) == 0
    first, second = names_of(panel)
    assert first.startswith("1: 1.000 ± ") and second == "2: no law"
    assert panel.x.log and panel.y.log
    # one panel a value, and nothing to draw in one of them
    data = rigid_study(axes=axes, figures=[line_figure(facet=LAMBDA, theory=1.0)])
    drawing = draw_only_figure(
        tmp_path, data, motor__velocity_rmse=lambda f: np.where(f[LAMBDA] == 1.0, 1e-5 * f[ALPHA], 0.0)
    )
    assert [panel.title for panel in drawing.panels] == ["λ, correction gain 1 √rad/s", "λ, correction gain 2 √rad/s"]
    assert names_of(drawing.panels[1]) == ["no law"]


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
    assert drawing.caption.endswith("median over encoder noise.")


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
