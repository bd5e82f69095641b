"""Maps of refined studies: filled from the nearest vertex, and nothing counted that was not simulated."""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from panel_parts import names_of, parts_of
from small_study import ALPHA, LAMBDA, NOISE, listed_axis, rigid_study, spaced_axis

from jaxbl.config import read_config
from jaxbl.report.drawing import save
from jaxbl.report.maps import Filling, draw
from jaxbl.report.panels import Line, Map
from jaxbl.report.results import describe
from jaxbl.sweeps.metrics import metric_columns
from jaxbl.sweeps.points import Points
from jaxbl.sweeps.refine import refine_boundary
from jaxbl.sweeps.sweep import StudyResult

RMSE = "motor.velocity_rmse"
GAINS = [spaced_axis(LAMBDA, 1.0, 16.0, 5), spaced_axis(ALPHA, 1.0, 9.0, 5, "linear")]
HEATMAP = {"kind": "heatmap", "x": ALPHA, "y": LAMBDA, "value": RMSE}


def make_refined_study(function, *axes, figures=(HEATMAP,), depth=3, seeds=1):
    """A refined study without runs: `function` of a frame of points says what converges; the error is lambda."""
    config = read_config(rigid_study(axes=[*axes, *GAINS], figures=list(figures), sweep={"refine": depth, "seeds": seeds}))
    points = Points(config)

    def make_rows(vertices):
        frame = pd.DataFrame(points.columns(vertices))
        return frame.assign(**dict.fromkeys(metric_columns(config.build()), 1.0) | {"seed": 0, "finite": True})

    vertices, _ = refine_boundary(
        points.refinement.grid, lambda v: function(make_rows(v)).to_numpy(float), lambda a, b: a != b
    )
    frame = make_rows(vertices)
    frame["motor.converged"] = function(frame)
    frame[RMSE] = frame[LAMBDA]
    frame["motor.margin_alpha"], frame["motor.margin_exact"] = 2.0 * frame[ALPHA], 2.0
    frames = [frame.assign(seed=seed) for seed in range(seeds)]
    return StudyResult(config, pd.concat(frames, ignore_index=True).sample(frac=1.0, random_state=0, ignore_index=True))


def converges_in_disc(frame):
    return (np.log2(frame[LAMBDA]) - 2.0) ** 2 + ((frame[ALPHA] - 5.0) / 2.0) ** 2 < 1.3


def drawn_map(panel):
    (cells,) = parts_of(panel, Map)
    return cells


def test_the_map_is_whole_and_sharp_at_the_boundary(tmp_path):
    result = make_refined_study(converges_in_disc, figures=[HEATMAP | {"value": "motor.converged"}, HEATMAP])
    assert len(result.frame) < 0.5 * 33**2
    converged, error = draw(result)
    cells = drawn_map(converged.panels[0])
    values = cells.values
    assert values.shape == (33, 33)
    assert not cells.failed.any() and np.isfinite(values).all()
    alphas, lambdas = np.linspace(1.0, 9.0, 33), np.geomspace(1.0, 16.0, 33)
    grid = pd.DataFrame({LAMBDA: np.repeat(lambdas, 33), ALPHA: np.tile(alphas, 33)})
    np.testing.assert_array_equal(values, converges_in_disc(grid).to_numpy(float).reshape(33, 33))
    assert names_of(*converged.panels) == []
    # far from the boundary a vertex of the coarse grid stands for the block around it
    blocks = drawn_map(error.panels[0]).values
    np.testing.assert_allclose(blocks[:4, :4], 1.0)
    np.testing.assert_allclose(blocks[4:6, :2], 2.0)
    np.testing.assert_allclose(blocks[-4:, :4], 16.0)
    inside = result.frame[result.frame["motor.converged"]]
    count = len(result.frame) - len(inside)
    assert names_of(*error.panels) == [f"not converged ({count} points)", "best"]
    assert f"best ★ {inside[LAMBDA].min():.2g} rad/s" in error.panels[0].title
    for drawing in (converged, error):
        assert save(drawing, tmp_path / f"{drawing.name}.png").stat().st_size > 5000
    assert plt.get_fignums() == []


def test_only_what_was_simulated_is_counted_as_missing():
    result = make_refined_study(converges_in_disc)
    frame = result.frame
    frame["finite"] = (frame[LAMBDA] < 16.0) | (frame[ALPHA] < 9.0)
    frame["motor.converged"] = frame["finite"]
    (drawing,) = draw(result)
    cells = drawn_map(drawing.panels[0])
    assert cells.name == "diverged (1 points)"
    assert cells.failed.sum() == 5 * 5  # its block, cut by the edges of the map


def test_panels_medians_and_lines_over_what_is_not_drawn():
    noise = listed_axis(NOISE, 0.0, 1e-4, 1e-3)

    def converges_in_half_disc(frame):
        return converges_in_disc(frame) & (frame[ALPHA] < 7.0 - 2000.0 * frame[NOISE])

    figures = [
        HEATMAP | {"value": "motor.converged", "facet": NOISE},
        HEATMAP | {"value": "motor.converged"},
        {"kind": "heatmap", "x": ALPHA, "y": NOISE, "value": "motor.converged"},
        {"kind": "line", "x": ALPHA, "value": RMSE, "series": LAMBDA},
    ]
    result = make_refined_study(converges_in_half_disc, noise, figures=figures, seeds=2)
    by_panel, together, of_noise, lines = draw(result)
    panel_values = np.array([drawn_map(panel).values for panel in by_panel.panels])
    assert panel_values.shape == (3, 33, 33)
    # a share over noise levels is one over all of them, also where only one has its boundary
    np.testing.assert_allclose(drawn_map(together.panels[0]).values, panel_values.mean(axis=0))
    assert drawn_map(of_noise.panels[0]).values.shape == (3, 33)
    np.testing.assert_allclose(drawn_map(of_noise.panels[0]).values, panel_values[:, ::8].mean(axis=1), atol=0.2)
    # one line for each value of the coarse grid
    assert len(parts_of(lines.panels[0], Line)) == 5


def test_filling_is_exact_where_every_vertex_is_known():
    result = make_refined_study(lambda frame: frame[ALPHA] > 0.0)
    points = Points(result.config)
    frame = pd.DataFrame(points.columns(np.arange(points.group_size)))
    table = frame.assign(value=np.arange(len(frame))).set_index([LAMBDA, ALPHA])[["value"]]
    grid = Filling(points, frame, ALPHA, LAMBDA).fill(table)["value"].unstack()
    np.testing.assert_array_equal(grid, np.arange(33**2).reshape(33, 33))
    np.testing.assert_array_equal(grid.columns, points.axis_values(ALPHA))
    np.testing.assert_array_equal(grid.index, points.axis_values(LAMBDA))


def test_a_map_shows_no_more_places_than_can_be_seen():
    result = make_refined_study(lambda frame: frame[ALPHA] > 3.3, depth=10)
    drawing = draw(result)[0]
    assert drawn_map(drawing.panels[0]).values.shape == (1025, 1025)


@pytest.mark.parametrize("seeds", [1, 3])
def test_headline_counts_points_and_takes_shares_from_the_coarse_grid(seeds):
    result = make_refined_study(converges_in_disc, seeds=seeds)
    points = Points(result.config)
    coarse = converges_in_disc(pd.DataFrame(points.columns(points.coarse_points(np.arange(25))))).mean()
    simulated = len(result.frame) // seeds
    lead, reserve, _ = describe(result).headline.partition(" Little reserve until they fail or err twice as much: motor")
    assert reserve and lead == (
        f"{len(result.frame)} runs at {simulated} of 1089 grid points ({100 * simulated / 1089:.0f} %): the motor observer "
        f"converges in {100 * coarse:.1f} % on the coarse grid, with the best gains in every run."
    )


def test_an_unfinished_study_is_drawn_as_far_as_it_goes():
    result = make_refined_study(converges_in_disc, figures=[HEATMAP, HEATMAP | {"value": "motor.converged"}])
    part = result.frame.iloc[:40]
    for drawing in draw(StudyResult(result.config, part)):
        assert drawing.panels
