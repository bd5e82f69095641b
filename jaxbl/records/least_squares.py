"""Least squares with standard errors that hold for correlated residuals."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

BLOCKS = 12
"""Parts of a log, each left out in turn: enough for a standard error within 20 %, each longer than correlations last."""


def as_normal(t: np.ndarray, freedom: np.ndarray | float) -> np.ndarray:
    """Return normal numbers as unlikely as Student's t (D. Wallace, Annals of Mathematical Statistics 30, 1959)."""
    return np.sign(t) * (8.0 * freedom + 1.0) / (8.0 * freedom + 3.0) * np.sqrt(freedom * np.log1p(t**2 / freedom))


# of what diverges
@np.errstate(over="ignore")
def rms(values: np.ndarray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def column_rms(columns: np.ndarray) -> np.ndarray:
    """Return the root mean square of each column."""
    return np.sqrt(np.mean(columns**2, axis=0))


def mean_error(values: np.ndarray) -> float:
    """Return the standard error of the mean of independent values, such as those of blocks of a log."""
    return float(np.std(values, ddof=1)) / len(values) ** 0.5


@dataclass(frozen=True)
class BlockRegression:
    """Least squares of a target on columns, by products over blocks of consecutive rows.

    A block that is left out tells how well the others predict it. How far the coefficients scatter without one block after
    the other is their standard error, whatever the correlation of the residuals within a block.
    References: S. Arlot, A. Celisse, A survey of cross-validation procedures, Statistics Surveys 4 (2010), section 8;
    B. Efron, C. Stein, The jackknife estimate of variance, Annals of Statistics 9 (1981).

    Attributes:
        products: of the columns and, last, the target with one another, shape (blocks, columns + 1, columns + 1).
        counts: rows of each block, shape (blocks,).
        penalty: quadratic form of the coefficients that is added to the sum of squares, shape (columns, columns).
    """

    products: np.ndarray
    counts: np.ndarray
    penalty: np.ndarray | float = 0.0

    @classmethod
    def of(
        cls, target: np.ndarray, columns: np.ndarray, blocks: int = BLOCKS, penalty: np.ndarray | float = 0.0
    ) -> "BlockRegression":
        """Prepare the regression of a target, shape (rows,), on columns, shape (rows, columns)."""
        parts = np.array_split(np.column_stack([columns, target]), blocks)
        return cls(np.array([part.T @ part for part in parts]), np.array([len(part) for part in parts]), penalty)

    def select(self, columns: Sequence[int] | np.ndarray, fixed: Sequence[int] = ()) -> "BlockRegression":
        """Keep some columns; those whose coefficient is `fixed` at 1 are taken off the target."""
        index, fixed_columns = [*columns, *fixed, -1], slice(len(columns), -1)
        products = self.products[:, index][:, :, index]
        # each new column as a sum of these
        sums = np.eye(len(index))
        sums[fixed_columns, -1] = -1.0
        sums = np.delete(sums, fixed_columns, axis=1)
        return BlockRegression(sums.T @ products @ sums, self.counts)

    def fit(self, left_out: Sequence[int] | np.ndarray = ()) -> np.ndarray:
        """Fit the coefficients without some blocks; 0 of a column of zeros, the least ones where columns are alike."""
        total = self.products.sum(axis=0) - self.products[list(left_out)].sum(axis=0)
        unit, size = _scale_matrix(total[:-1, :-1] + self.penalty)
        return np.linalg.lstsq(unit, total[:-1, -1] / size, rcond=1e-12)[0] / size

    @property
    def unit_matrix(self) -> tuple[np.ndarray, np.ndarray]:
        """Products of the columns over their sizes, and these; infinite of a column of zeros."""
        return _scale_matrix(self.products.sum(axis=0)[:-1, :-1] + self.penalty)

    def fit_without_each(self) -> np.ndarray:
        """Fit the coefficients without each of the blocks, shape (blocks, columns)."""
        return np.array([self.fit([block]) for block in range(len(self.products))])

    def errors(self) -> np.ndarray:
        """Return the standard errors of the coefficients (delete-a-block jackknife)."""
        return np.sqrt(jackknife_variance(self.fit_without_each()))

    def held_out(self, without_each: np.ndarray | None = None) -> np.ndarray:
        """Return the mean squared error on each block by the others' coefficients, or by those given, shape (blocks,)."""
        fits = self.fit_without_each() if without_each is None else without_each
        weights = np.column_stack([-fits, np.ones(len(fits))])
        squares = np.einsum("bi,bij,bj->b", weights, self.products, weights) / self.counts
        # squares below zero are rounding
        return np.maximum(squares, np.finfo(float).tiny)


def _scale_matrix(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Divide a matrix by the sizes of its columns, the roots of its diagonal; infinite of a column of zeros."""
    size = np.sqrt(np.diag(matrix))
    size[size <= 0.0] = np.inf
    return matrix / np.outer(size, size), size


def fit_with_jackknife(target: np.ndarray, regressors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit coefficients of regressors, shape (samples, terms), by least squares.

    Returns:
        Coefficients and standard errors of :class:`BlockRegression`, shape (terms,); NaN if they are not determined.
    """
    regression = BlockRegression.of(target, regressors)
    unit, size = regression.unit_matrix
    if not np.linalg.cond(unit) <= 1e13:
        unknown = np.full(len(size), np.nan)
        return unknown, unknown
    return regression.fit(), regression.errors()


def jackknife_variance(without: np.ndarray | Sequence[float]) -> np.ndarray:
    """Return the variance of estimates, each of them without one of the blocks of a log."""
    return (len(without) - 1) * np.var(without, axis=0)


def fit_residual(target: np.ndarray, regressors: np.ndarray) -> np.ndarray:
    """Return what a fit of regressors, shape (samples, terms), leaves of a target, or of several in columns."""
    # so that least squares are well conditioned
    scaled = regressors / (np.abs(regressors).max(axis=0) + 1e-300)
    return target - scaled @ np.linalg.lstsq(scaled, target, rcond=1e-10)[0]


def student_interval(value: float, error: float, freedom: int = BLOCKS - 1) -> tuple[float, float]:
    """Return the ends of the 95 % interval of an estimate whose standard error has so many degrees of freedom."""
    from scipy.special import stdtrit

    reach = float(stdtrit(max(freedom, 1), 0.975)) * error
    return value - reach, value + reach
