"""Which effects explain a record, and how surely: the evidence of sets of candidates.

Prediction errors are linear in everything (:mod:`.linearised_model`), so that a set of candidates costs one small linear
solve. The model's own numbers take part with their prior; amplitudes have a broad one, which is the price of each column
(Laplace's method; the model is linear, so that it is exact). References: D. MacKay, Bayesian interpolation, Neural
Computation 4 (1992); R. Kass, A. Raftery, Bayes factors, JASA 90 (1995).
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from .candidates import Candidate, Numbers


@dataclasses.dataclass(frozen=True)
class Products:
    """Everything that prediction errors are linear in, as products.

    Attributes:
        products: of all columns with one another, over the errors' variance, initial states eliminated; shape
            (columns, columns). Order: constant, own numbers, then each variant's columns and offset.
        own: number of the model's own numbers.
        places: columns of each variant.
        offsets: column of each variant's offset, or -1.
        scale: prior standard deviation of each column's coefficient; infinite where it does nothing along this record.
        centre: prior mean of each.
        bound: standard deviations of its prior that each of the model's own numbers may be off at most; shape (own,).
        twins: columns that are a multiple of one of the model's own, which is always there: that one, and the factor. Only
            their priors part the two, so that these are joined: the data's precision may be too large for them to be seen.
    """

    products: np.ndarray
    own: int
    places: tuple[tuple[int, ...], ...]
    offsets: tuple[int, ...]
    scale: np.ndarray
    centre: np.ndarray
    bound: np.ndarray
    twins: Mapping[int, tuple[int, float]] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Set:
    """Some candidates together.

    Attributes:
        which: indices of variants.
        log_evidence: of the set, nats; only differences count.
        misfit: sum of squared errors over their variance.
        numbers: of each candidate's effect.
        own: change of the model's own numbers (theta).
    """

    which: tuple[int, ...]
    log_evidence: float
    misfit: float
    numbers: tuple[Numbers, ...]
    own: np.ndarray


class Scorer:
    """Evidence of sets, computed once each."""

    def __init__(self, columns: Products, variants: Sequence[Candidate]):
        self.columns, self.variants = columns, variants
        self.base = np.arange(1, 1 + columns.own)
        self.known: dict[tuple[int, ...], Set | None] = {}

    def __call__(self, which: tuple[int, ...]) -> Set | None:
        which = tuple(sorted(which))
        if which not in self.known:
            self.known[which] = self._score(which)
        return self.known[which]

    def _score(self, which: tuple[int, ...]) -> Set | None:
        c = self.columns
        chosen = np.concatenate([self.base, *(np.asarray(c.places[i]) for i in which)]).astype(int)
        fixed = np.array([0, *(c.offsets[i] for i in which if c.offsets[i] >= 0)])
        # what has no torque along this record has no coefficient either
        values = np.zeros(len(c.scale))
        variance, middle = c.scale**2, c.centre.copy()
        alive = [int(k) for k in chosen if np.isfinite(c.scale[k])]
        joined = [k for k in alive if k in c.twins]
        for k in joined:
            of, factor = c.twins[k]
            variance[of] += factor**2 * variance[k]
            middle[of] += factor * middle[k]
        places, chosen = chosen, np.array([k for k in alive if k not in joined], int)
        inner = c.products[np.ix_(chosen, chosen)]
        towards = c.products[np.ix_(chosen, fixed)].sum(axis=1)
        total = c.products[np.ix_(fixed, fixed)].sum()
        spread, centre = np.sqrt(variance[chosen]), middle[chosen]
        bound = np.where(chosen <= c.own, np.append(c.bound, np.inf)[np.minimum(chosen - 1, c.own)], np.inf)
        free, coefficients = np.ones(len(chosen), bool), np.zeros(len(chosen))
        while True:
            known = np.where(free, 0.0, coefficients)
            at = np.ix_(free, free)
            rest = total + float(2.0 * towards @ known + known @ inner @ known)
            solved = _solved(inner[at], (towards + inner @ known)[free], rest, spread[free], centre[free])
            if solved is None:
                return None
            coefficients = known
            coefficients[free] = solved.coefficients
            away = (coefficients - centre) / spread
            over = free & (np.abs(away) > bound)
            if not over.any():
                break
            # what is beyond its bound stays at it
            coefficients[over] = (centre + np.clip(away, -bound, bound) * spread)[over]
            free &= ~over
        values[chosen] = coefficients
        # the sum's distance from its mean is shared out by the variances
        away = values - middle
        for k in joined:
            of, factor = c.twins[k]
            values[k] = c.centre[k] + factor * c.scale[k] ** 2 / variance[of] * away[of]
            values[of] -= factor * values[k]
        given = values[places]
        numbers, place = [], len(self.base)
        for i in which:
            width = len(c.places[i])
            found = self.variants[i].numbers(given[place : place + width].tolist())
            if found is None:
                return None
            numbers.append(found)
            place += width
        held = float(np.sum(((coefficients - centre) / spread)[~free] ** 2))
        evidence = -0.5 * (solved.cost + held + solved.determinant + 2.0 * float(np.sum(np.log(spread[free]))))
        misfit = solved.cost - float(np.sum(((coefficients - centre) / spread)[free] ** 2))
        return Set(which, evidence, misfit, tuple(numbers), values[self.base])


class _Solved(NamedTuple):
    """Coefficients of least squares with a prior, the least cost, and the logarithm of the determinant of the precision."""

    coefficients: np.ndarray
    cost: float
    determinant: float


def _solved(inner: np.ndarray, towards: np.ndarray, total: float, spread: np.ndarray, centre: np.ndarray) -> _Solved | None:
    precision = spread**-2.0
    matrix = inner + np.diag(precision)
    towards = towards - precision * centre
    total = total + float(precision @ centre**2)
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    with np.errstate(over="ignore"):
        root = _root(matrix / np.outer(size, size))
    if root is None:
        return None
    inside = solve_triangular(root, towards / size, lower=True)
    coefficients = -solve_triangular(root, inside, lower=True, trans=1) / size
    determinant = 2.0 * float(np.sum(np.log(np.diag(root)))) + 2.0 * float(np.sum(np.log(size)))
    return _Solved(coefficients, total - float(inside @ inside), determinant)


def _root(unit: np.ndarray) -> np.ndarray | None:
    """Cholesky factor of a matrix with ones on its diagonal, whose columns may be all but alike; None if it is none."""
    for ridge in (1e-12, 1e-11, 1e-10, 1e-9, 1e-8):
        try:
            return np.linalg.cholesky(unit + ridge * np.eye(len(unit)))
        except np.linalg.LinAlgError:
            continue
    return None
