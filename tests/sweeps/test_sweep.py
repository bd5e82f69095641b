"""The frame of a study as a dataset."""

import numpy as np
import pytest
from small_study import ALPHA, LAMBDA, NOISE, listed_axis, make_result, rigid_study, spaced_axis

from jaxbl.sweeps.sweep import StudyResult, sweep

pytest.importorskip("xarray")


def number_runs(*axes, seeds=2, **sweep) -> StudyResult:
    """A result whose metric tells its point and seed."""
    study = rigid_study(axes=list(axes), sweep={"seeds": seeds, **sweep})
    return make_result(study, motor__velocity_rmse=lambda frame: np.arange(len(frame), dtype=float))


def test_dataset_over_axes_and_seed_with_units():
    result = number_runs(spaced_axis(ALPHA, 1.0, 4.0, 3), listed_axis(NOISE, 1e-4, 0.0))
    dataset = result.to_xarray()
    assert dict(dataset.sizes) == {ALPHA: 3, NOISE: 2, "seed": 2}
    for _, row in result.frame.iterrows():
        value = dataset["motor.velocity_rmse"].sel({name: row[name] for name in (ALPHA, NOISE, "seed")})
        assert value == row["motor.velocity_rmse"]
    assert dataset["motor.velocity_rmse"].attrs["units"] == "rad/s"


def test_zipped_axes_are_coordinates_of_one_dimension():
    result = number_runs(
        listed_axis(ALPHA, 5.0, 5.0, 9.0, zip="gains"),
        listed_axis(NOISE, 0.0, 1e-4),
        listed_axis(LAMBDA, 2.0, 1.0, 1.0, zip="gains"),
    )
    dataset = result.to_xarray()
    assert dict(dataset.sizes) == {"gains": 3, NOISE: 2, "seed": 2}
    assert dataset[ALPHA].dims == dataset[LAMBDA].dims == ("gains",)
    np.testing.assert_array_equal(dataset[ALPHA], [5.0, 5.0, 9.0])
    np.testing.assert_array_equal(dataset[LAMBDA], [2.0, 1.0, 1.0])
    value = dataset["motor.velocity_rmse"].isel(gains=1).sel({NOISE: 1e-4, "seed": 1})
    row = result.frame.query(f"`{ALPHA}` == 5.0 and `{LAMBDA}` == 1.0 and `{NOISE}` == 1e-4 and seed == 1")
    assert value == row["motor.velocity_rmse"].item()
    assert "gains" not in result.frame


def test_a_design_has_no_grid():
    with pytest.raises(ValueError, match="a sobol design has no grid"):
        number_runs(spaced_axis(ALPHA, 1.0, 2.0), design="sobol", points=4).to_xarray()


def test_a_study_of_words_and_of_seeds_alone():
    words = sweep(
        rigid_study(axes=[listed_axis("observer.discretisation", "implicit", "explicit")], sweep={"seeds": 2})
    ).to_xarray()
    assert dict(words.sizes) == {"observer.discretisation": 2, "seed": 2}
    assert words["motor.velocity_rmse"].sel({"observer.discretisation": "explicit"}).shape == (2,)
    assert dict(number_runs(seeds=3).to_xarray().sizes) == {"seed": 3}
