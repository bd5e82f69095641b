"""Two other ways to find what a model lacks, on terms of filtered derivatives: stepwise least squares, and SINDy."""

import itertools
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .derivatives import Terms

_BLOCKS = 10
"""Blocks of consecutive samples, each left out once: a standard error needs more than eight."""
_GAIN = 0.03
"""Share of the rms that a term has to take away."""
_SHARES = (0.003, 0.01, 0.03, 0.1, 0.3)
"""Thresholds of SINDy that are tried: share of the torque below which a term is left out."""
_RIDGES = (1e-8, 1e-4, 1e-2)
"""Ridge penalties of SINDy per sample, for terms of size 1: none, and enough to separate terms that are nearly alike."""


@dataclass(frozen=True)
class Found:
    """Result of another tool.

    Attributes:
        names: of the terms, in the order in which they were added; those of the nominal model first.
        factors: of each column, and its unit.
        gains: share of the rms that each added term took away.
        left: held-out torque error behind the low-pass, N m, shape (samples,).
        note: why there is nothing, or "".
    """

    names: list[str]
    factors: dict[str, list[float]] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    gains: dict[str, float] = field(default_factory=dict)
    left: np.ndarray = field(default_factory=lambda: np.zeros(0))
    note: str = ""

    def to_dict(self) -> dict[str, Any]:
        """The result as plain data for JSON."""
        return {
            "names": self.names, "factors": self.factors, "units": self.units, "gains": self.gains, "rms": self.rms,
            "note": self.note,
        }  # fmt: skip

    @property
    def rms(self) -> float | None:
        """RMS of the held-out torque error, N m."""
        return float(np.sqrt(np.mean(self.left**2))) if len(self.left) else None


def _solve(columns: np.ndarray, target: np.ndarray) -> np.ndarray:
    size = np.sqrt(np.mean(columns**2, axis=0))
    size[size == 0.0] = 1.0
    return np.linalg.lstsq(columns / size, target, rcond=1e-9)[0] / size


def _cross_validate(columns: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Mean squared error on each block by a fit to the others."""
    if columns.shape[1] == 0:
        return np.array([np.mean(block**2) for block in np.array_split(target, _BLOCKS)])
    squares = []
    for rows in np.array_split(np.arange(len(target)), _BLOCKS):
        training = np.ones(len(target), bool)
        training[rows] = False
        squares.append(np.mean((target[rows] - columns[rows] @ _solve(columns[training], target[training])) ** 2))
    return np.array(squares)


def stepwise(fitted: Terms, held: Terms) -> Found:
    """Forward selection: a term is kept if by cross-validation it takes away enough of the rms, and more than one standard
    error of the blocks' gains."""
    names, gains = list(fitted.base), {}
    squares = _cross_validate(fitted.columns[:, fitted.of(names)], fitted.target)
    while True:
        best = None
        for name in dict.fromkeys(fitted.names):
            if name in names or (name in fitted.exclusive and set(names) & set(fitted.exclusive)):
                continue
            less = _cross_validate(fitted.columns[:, fitted.of([*names, name])], fitted.target)
            change = squares - less
            gain = 1.0 - np.sqrt(np.mean(less) / np.mean(squares))
            sure = np.mean(change) > np.std(change, ddof=1) / np.sqrt(_BLOCKS)
            if gain >= _GAIN and sure and (best is None or gain > best[0]):
                best = gain, name, less
        if best is None:
            break
        gains[best[1]], squares = float(best[0]), best[2]
        names.append(best[1])
    return _result(fitted, held, names, gains)


def _result(fitted: Terms, held: Terms, names: Sequence[str], gains: dict[str, float]) -> Found:
    indices = fitted.of(names)
    factors = _solve(fitted.columns[:, indices], fitted.target) if len(indices) else np.zeros(0)
    values: dict[str, list[float]] = {}
    for i, value in zip(indices, factors, strict=True):
        values.setdefault(fitted.names[i], []).append(float(value))
    units = {fitted.names[i]: fitted.units[i] for i in indices}
    left = held.target - held.columns[:, indices] @ factors
    return Found(list(names), {name: values[name] for name in names}, units, gains, left)


def sindy(fitted: Terms, held: Terms) -> Found:
    """Sequentially thresholded ridge regression of pysindy; of all thresholds and ridges within one standard error of the
    best by cross-validation, those that leave the fewest terms."""
    try:
        import pysindy  # type: ignore[import-not-found]
    except ImportError:
        return Found([], note="pysindy is not installed")

    size = np.sqrt(np.mean(fitted.columns**2, axis=0))
    scale = np.sqrt(np.mean(fitted.target**2))

    def sparse_factors(rows: np.ndarray, share: float, ridge: float) -> np.ndarray:
        optimizer = pysindy.STLSQ(threshold=share, alpha=ridge * len(rows), max_iter=50)
        with warnings.catch_warnings():
            # a threshold that leaves no term, or one that does not settle in so many rounds, loses by its errors
            warnings.simplefilter("ignore")
            optimizer.fit(fitted.columns[rows] / size, (fitted.target[rows] / scale)[:, None])
        return np.ravel(optimizer.coef_) * scale / size

    all_rows, candidates = np.arange(len(fitted.target)), []
    for share, ridge in itertools.product(_SHARES, _RIDGES):
        squares = []
        for rows in np.array_split(all_rows, _BLOCKS):
            factors = sparse_factors(np.setdiff1d(all_rows, rows), share, ridge)
            squares.append(np.mean((fitted.target[rows] - fitted.columns[rows] @ factors) ** 2))
        candidates.append(
            (sparse_factors(all_rows, share, ridge), np.mean(squares), np.std(squares, ddof=1) / np.sqrt(_BLOCKS))
        )
    _, least, error = min(candidates, key=lambda candidate: candidate[1])
    factors = min((candidate for candidate, mean, _ in candidates if mean <= least + error), key=np.count_nonzero)
    active = np.flatnonzero(factors)
    order = sorted(active, key=lambda i: -abs(factors[i]) * size[i])
    names = list(dict.fromkeys(fitted.names[i] for i in order))
    values = {name: [float(factors[i]) for i in active if fitted.names[i] == name] for name in names}
    units = {fitted.names[i]: fitted.units[i] for i in active}
    return Found(names, values, units, {}, held.target - held.columns @ factors)
