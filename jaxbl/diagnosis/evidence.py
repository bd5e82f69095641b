"""Which effect explains a record, and how surely: the evidence of candidates.

Prediction errors are linear in everything (:mod:`.linearised_model`), so that a candidate costs one small linear solve. The
model's own numbers take part with their prior; amplitudes have a broad one, which is the price of each column (Laplace's
method; the model is linear, so that it is exact).
References: D. MacKay, Bayesian interpolation, Neural Computation 4 (1992); R. Kass, A. Raftery, Bayes factors, J. American
Statistical Association 90 (1995).
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from .candidates import Candidate, Numbers


class Products(NamedTuple):
    """Everything that the prediction errors of a model with a candidate are linear in, as products.

    Attributes:
        candidate: what is added to the model.
        products: of all columns with one another, over the errors' variance, initial states eliminated; shape
            (columns, columns). Order: constant, own numbers, the candidate's columns, and what is there without them.
        scale: prior standard deviation of each column's coefficient; infinite where it does nothing along this record.
        centre: prior mean of each.
        twins: columns that are a multiple of one of the model's own, which is always there: that one, and the factor. Only
            their priors part the two, so that these are joined: the data's precision may be too large for them to be seen.
    """

    candidate: Candidate
    products: np.ndarray
    scale: np.ndarray
    centre: np.ndarray
    twins: Mapping[int, tuple[int, float]]

    @property
    def shared_count(self) -> int:
        """Number of columns that are there without a candidate."""
        return len(self.scale) - self.candidate.width - self.candidate.offset


class Evidence(NamedTuple):
    """Evidence in favour of a candidate, or of none.

    Attributes:
        log_evidence: nats; only differences count.
        misfit: sum of squared errors over their variance.
        numbers: of the candidate's effect.
        own_change: change of the model's own numbers (theta).
    """

    log_evidence: float
    misfit: float
    numbers: Numbers
    own_change: np.ndarray


def evidence_of(columns: Products) -> Evidence | None:
    """Evidence of a model with its candidate; None where the numbers are not allowed.

    A candidate that is linear about a value that was tried is left at this value where it would have to go too far.
    """
    evidence = _evidence(columns, columns.candidate.width)
    return _evidence(columns, 0) if evidence is None and columns.candidate.offset else evidence


def _evidence(c: Products, width: int) -> Evidence | None:
    """Find the same with so many of the candidate's columns."""
    fixed = np.array([0, -1] if c.candidate.offset else [0])
    # what has no torque along this record has no coefficient either
    alive = [k for k in range(1, c.shared_count + width) if np.isfinite(c.scale[k])]
    variance, middle = c.scale**2, c.centre.copy()
    joined = [k for k in alive if k in c.twins]
    for k in joined:
        of, factor = c.twins[k]
        variance[of] += factor**2 * variance[k]
        middle[of] += factor * middle[k]
    chosen = np.array([k for k in alive if k not in joined], int)
    # coefficients of these, with their prior, beside the fixed columns, whose coefficient is 1
    spread, centre = np.sqrt(variance[chosen]), middle[chosen]
    precision = spread**-2.0
    matrix = c.products[np.ix_(chosen, chosen)] + np.diag(precision)
    towards = c.products[np.ix_(chosen, fixed)].sum(axis=1) - precision * centre
    total = c.products[np.ix_(fixed, fixed)].sum() + float(precision @ centre**2)
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    with np.errstate(over="ignore"):
        root = _root(matrix / np.outer(size, size))
    if root is None:
        return None
    inside = solve_triangular(root, towards / size, lower=True)
    values = np.zeros(len(c.scale))
    values[chosen] = -solve_triangular(root, inside, lower=True, trans=1) / size
    determinant = 2.0 * float(np.sum(np.log(np.diag(root)) + np.log(size) + np.log(spread)))
    cost = total - float(inside @ inside)
    misfit = cost - float(np.sum(((values[chosen] - centre) / spread) ** 2))
    # the sum's distance from its mean is shared out by the variances
    away = values - middle
    for k in joined:
        of, factor = c.twins[k]
        values[k] = c.centre[k] + factor * c.scale[k] ** 2 / variance[of] * away[of]
        values[of] -= factor * values[k]
    numbers = c.candidate.numbers(values[c.shared_count : c.shared_count + c.candidate.width].tolist())
    return None if numbers is None else Evidence(-0.5 * (cost + determinant), misfit, numbers, values[1 : c.shared_count])


def _root(unit: np.ndarray) -> np.ndarray | None:
    """Cholesky factor of a matrix with ones on its diagonal, whose columns may be all but alike; None if it is none."""
    for ridge in (1e-12, 1e-11, 1e-10, 1e-9, 1e-8):
        try:
            return np.linalg.cholesky(unit + ridge * np.eye(len(unit)))
        except np.linalg.LinAlgError:
            continue
    return None
