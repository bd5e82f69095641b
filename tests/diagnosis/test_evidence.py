"""Evidence against closed forms."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from jaxbl.diagnosis.candidates import NO_CANDIDATE, Candidate
from jaxbl.diagnosis.evidence import Products, evidence_of
from jaxbl.diagnosis.linearised_model import _least_squares

ONE_COLUMN = Candidate("", 1, (), lambda signals, torques: {}, lambda values: {"value": values[0]})


def make_products(design, errors, scale, centre, twins=None):
    """Two own numbers, one candidate or none; errors of unit variance are `errors` plus the columns."""
    full = np.column_stack([errors, design])
    candidate = ONE_COLUMN if len(scale) == 3 else NO_CANDIDATE
    return Products(candidate, full.T @ full, np.r_[np.inf, scale], np.r_[0.0, centre], twins or {})


def draw_regression(size=1.0):
    random = np.random.default_rng(5)
    design = size * random.standard_normal((40, 3))
    return design, design @ [0.3, -0.2, 0.5] + random.standard_normal(40)


@pytest.mark.parametrize("count", [2, 3])
def test_evidence_is_that_of_a_gaussian(count):
    design, errors = draw_regression()
    scale, centre = np.array([0.4, 0.2, 0.7]), np.array([0.1, 0.0, -0.1])
    used_columns = design[:, :count]
    covariance = np.eye(40) + used_columns @ np.diag(scale[:count] ** 2) @ used_columns.T
    exact = multivariate_normal(-used_columns @ centre[:count], covariance).logpdf(errors)
    evidence = evidence_of(make_products(used_columns, errors, scale[:count], centre[:count]))
    assert evidence.log_evidence + -0.5 * 40 * np.log(2.0 * np.pi) == pytest.approx(exact, rel=1e-9)


@pytest.mark.parametrize("size", [1.0, 1e8])
def test_twins_are_parted_by_their_priors(size):
    """However precise the data are: at 1e8 the product matrix tells nothing of priors any more."""
    design, errors = draw_regression(size)
    factor, scale, centre = -2.5, np.array([0.02, 0.2, 0.7]), np.array([0.1, 0.0, 0.05])
    design[:, 2] = factor * design[:, 0]
    evidence = evidence_of(make_products(design, errors, scale, centre, twins={3: (1, factor)}))
    joint_scale = np.array([np.hypot(scale[0], factor * scale[2]), scale[1]])
    joint_centre = np.array([centre[0] + factor * centre[2], centre[1]])
    joint_evidence = evidence_of(make_products(design[:, :2], errors, joint_scale, joint_centre))
    assert evidence.log_evidence == pytest.approx(joint_evidence.log_evidence, rel=1e-9)
    assert evidence.misfit == pytest.approx(joint_evidence.misfit, rel=1e-6)
    value = evidence.numbers["value"]
    assert evidence.own_change[0] + factor * value == pytest.approx(joint_evidence.own_change[0], rel=1e-9)
    # each is as far from its mean as its variance allows
    assert (evidence.own_change[0] - centre[0]) / scale[0] ** 2 == pytest.approx(
        (value - centre[2]) / (factor * scale[2] ** 2)
    )
    if size == 1.0:
        direct_evidence = evidence_of(make_products(design, errors, scale, centre))
        assert evidence.log_evidence == pytest.approx(direct_evidence.log_evidence, rel=1e-6)
        np.testing.assert_allclose(evidence.own_change, direct_evidence.own_change, atol=1e-6)
        assert value == pytest.approx(direct_evidence.numbers["value"], abs=1e-6)


def test_the_predictor_solves_the_same_problem():
    """Against stacked least squares."""
    design, errors = draw_regression()
    scale, centre = np.array([0.05, 0.5, 0.7]), np.array([0.01, 0.0, 0.0])
    products = make_products(design, errors, scale, centre)
    evidence = evidence_of(products)
    stacked, targets = np.vstack([design, np.diag(1.0 / scale)]), np.concatenate([-errors, centre / scale])
    expected = np.linalg.lstsq(stacked, targets, rcond=None)[0]
    np.testing.assert_allclose([*evidence.own_change, evidence.numbers["value"]], expected, atol=1e-6)
    assert evidence.misfit == pytest.approx(np.sum((errors + design @ expected) ** 2), rel=1e-6)
    np.testing.assert_allclose(_least_squares(np.asarray(products.products), scale**-2.0, centre), expected, atol=1e-9)
