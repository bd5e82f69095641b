"""Points of a study: order, spacing, zipped and quasi-random axes, structural groups."""

import numpy as np
import pytest
from small_study import ALPHA, LAMBDA, NOISE, listed_axis, small_study, spaced_axis

from jaxbl.config import read_config
from jaxbl.sweeps.points import Points


def make_points(*axes, **sweep):
    return Points(read_config(small_study(axes=list(axes), sweep=sweep)))


def all_columns(study):
    return study.columns(np.arange(study.group_size))


def test_grid_has_the_last_axis_fastest():
    study = make_points(
        listed_axis(NOISE, 1e-5, 1e-4), spaced_axis(ALPHA, 1.0, 100.0, 3), spaced_axis(LAMBDA, 1.0, 2.0, 3, "linear")
    )
    assert study.paths == [NOISE, ALPHA, LAMBDA]
    assert len(study) == study.group_size == 18
    expected = np.meshgrid([1e-5, 1e-4], [1.0, 10.0, 100.0], [1.0, 1.5, 2.0], indexing="ij")
    for path, values in zip(study.paths, expected, strict=True):
        np.testing.assert_allclose(all_columns(study)[path], values.ravel(), rtol=1e-14)


def test_zipped_axes_advance_together_and_may_repeat_a_value():
    study = make_points(
        listed_axis(ALPHA, 1.0, 1.0, 3.0, zip="g"),
        listed_axis(NOISE, 0.0, 1e-3),
        listed_axis(LAMBDA, 4.0, 5.0, 5.0, zip="g"),
    )
    result = all_columns(study)
    np.testing.assert_array_equal(result[ALPHA], [1.0, 1.0, 1.0, 1.0, 3.0, 3.0])
    np.testing.assert_array_equal(result[LAMBDA], [4.0, 4.0, 5.0, 5.0, 5.0, 5.0])
    np.testing.assert_array_equal(result[NOISE], [0.0, 1e-3] * 3)


def test_slices_are_parts_of_the_whole():
    study = make_points(listed_axis(NOISE, 1e-5, 1e-4), spaced_axis(ALPHA, 1.0, 100.0, 7), spaced_axis(LAMBDA, 1.0, 2.0, 5))
    full_columns = all_columns(study)
    for first in range(0, study.group_size, 11):
        part = study.columns(np.arange(first, min(first + 11, study.group_size)))
        for path, values in part.items():
            np.testing.assert_array_equal(values, full_columns[path][first : first + 11])


@pytest.mark.parametrize("design", ["sobol", "latin_hypercube"])
def test_quasi_random_points_fill_the_ranges_evenly_and_repeat(design):
    axes = [spaced_axis(ALPHA, 1.0, 100.0), spaced_axis(LAMBDA, 2.0, 4.0, scale="linear")]
    study = make_points(*axes, design=design, points=64)
    result = all_columns(study)
    unit = [np.log(result[ALPHA]) / np.log(100.0), (result[LAMBDA] - 2.0) / 2.0]
    for u in unit:
        # one point in each of 64 slices of either axis, in its own scale
        assert sorted(np.floor(64 * u).astype(int)) == list(range(64))
    again = all_columns(make_points(*axes, design=design, points=64))
    other = all_columns(make_points(*axes, design=design, points=64, design_seed=1))
    for path, values in result.items():
        np.testing.assert_array_equal(values, again[path])
        assert (values != other[path]).all()


def test_fewer_sobol_points_are_the_first_of_more():
    axis = spaced_axis(ALPHA, 1.0, 100.0)
    first_points, more_points = (all_columns(make_points(axis, design="sobol", points=n)) for n in (11, 16))
    np.testing.assert_array_equal(first_points[ALPHA], more_points[ALPHA][:11])


def test_a_design_is_crossed_with_the_axes_that_are_listed():
    study = make_points(
        spaced_axis(ALPHA, 1.0, 9.0), listed_axis(NOISE, 0.0, 1e-3), spaced_axis(LAMBDA, 2.0, 4.0), design="sobol", points=5
    )
    result = all_columns(study)
    assert len(study) == 10
    np.testing.assert_array_equal(result[NOISE], [0.0, 1e-3] * 5)
    for path in (ALPHA, LAMBDA):
        np.testing.assert_array_equal(result[path][::2], result[path][1::2])
        assert len(set(result[path])) == 5


def test_axes_over_structure_are_groups_outside_of_the_lanes():
    study = make_points(
        spaced_axis(ALPHA, 1.0, 9.0, 3),
        listed_axis("run.sample_period", 1e-3, 2e-3),
        listed_axis("observer.discretisation", "explicit", "implicit"),
    )
    assert (len(study.groups), study.group_size, len(study)) == (4, 3, 12)
    assert list(all_columns(study)) == [ALPHA]
    chosen = [(g.config.run.sample_period, g.config.observer.discretisation) for g in study.groups]
    assert chosen == [(1e-3, "explicit"), (1e-3, "implicit"), (2e-3, "explicit"), (2e-3, "implicit")]
    assert [tuple(g.structural.values()) for g in study.groups] == [pair[::-1] for pair in chosen]


def test_a_leaf_zipped_with_structure_goes_with_its_group():
    study = make_points(listed_axis(ALPHA, 1.0, 2.0, zip="g"), spaced_axis("run.substeps", 1, 3, 2, "linear", zip="g"))
    assert (len(study.groups), study.group_size) == (2, 1)
    assert [(g.config.observer.motor.alpha, g.config.run.substeps) for g in study.groups] == [(1.0, 1), (2.0, 3)]


def test_a_number_that_is_left_out_may_be_an_axis():
    study = make_points(listed_axis("encoders.load_noise", 0.0, 1e-3))
    assert list(all_columns(study)) == ["encoders.load_noise"]
    assert study.groups[0].config.encoders.load_noise == 0.0


def test_no_axes_is_one_point():
    assert len(make_points()) == 1
