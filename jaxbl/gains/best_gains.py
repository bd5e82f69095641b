"""The best of the gains that were tried: of those with nearly the least error, the ones furthest from where they fail.

`jaxbl tune`, the sentence on a sweep and the stars of its maps share this definition.
"""

from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.spatial import KDTree

AS_GOOD = 0.02
"""Relative difference of two errors that does not count; a larger scatter over noise seeds takes its place."""
NEARLY_AS_GOOD = 0.05
"""Relative difference of errors that rarely matters in practice: gains within it are counted."""
_DOUBLED = 2.0
"""An error of so many times the least one is too large."""


class BestGains(NamedTuple):
    """The best of several gains.

    Attributes:
        index: their row.
        least_error: of all gains that work.
        margins: factors that the gains may change by: `f_plus`, alpha over f⁺, by which alpha may fall; `failure`, to the
            nearest gains that do not work, or the end of those tried; `error`, to the nearest with twice the least error,
            or the end.
        nearly_as_good: number of gains that work with an error within `NEARLY_AS_GOOD` of the least.
        ends: gains that are at an end of those tried, as are all that are as good: "smaller" or "larger" by gain.
    """

    index: int
    least_error: float
    margins: dict[str, float]
    nearly_as_good: int
    ends: dict[str, str]

    @property
    def margin(self) -> float:
        """The smallest of the margins."""
        return min(self.margins.values())


def find_best_gains(
    gains: pd.DataFrame,
    error: np.ndarray,
    works: np.ndarray,
    *,
    allowed: np.ndarray,
    scatter: np.ndarray,
    alpha_ratio: np.ndarray | None = None,
) -> BestGains | None:
    """Find the best gains, or None if none are allowed.

    Args:
        gains: a row for each of n candidates; the columns are `lambda`, `alpha` or others.
        error: shape (n,), the worst of all runs with these gains; NaN if one diverged.
        works: shape (n,), whether they converge in all runs.
        allowed: shape (n,), whether they may be chosen.
        scatter: shape (n,), relative standard error of their mean over noise seeds.
        alpha_ratio: shape (n,), alpha over f⁺, which has to be above 1; not known if left out.
    """
    works = works & np.isfinite(error)
    if alpha_ratio is not None:
        works = works & (alpha_ratio > 1.0)
    allowed = works & allowed
    if not allowed.any():
        return None
    # a gain of 0 is far from all others
    place = np.log(np.maximum(gains.to_numpy(float), np.finfo(float).tiny))
    least = int(np.argmin(np.where(allowed, error, np.inf)))
    tolerance = max(AS_GOOD, scatter[least])
    as_good = np.flatnonzero(allowed & (error <= (1.0 + tolerance) * error[least]))
    good, low, high = place[as_good], place.min(axis=0), place.max(axis=0)
    is_varied = high > low
    # below the smallest alpha, its ratio to f⁺ is the margin
    counts_below = is_varied & ((gains.columns != "alpha") | (alpha_ratio is None))
    to_ends = np.minimum(np.where(is_varied, high - good, np.inf), np.where(counts_below, good - low, np.inf)).min(axis=1)
    margins = {"f_plus": np.full(len(good), np.inf) if alpha_ratio is None else alpha_ratio[as_good]}
    for name, too_far in (("failure", ~works), ("error", works & (error >= _DOUBLED * error[least]))):
        # infinite without such gains
        nearest = KDTree(place[too_far]).query(good, p=np.inf)[0] if too_far.any() else np.inf
        margins[name] = np.exp(np.minimum(nearest, to_ends))
    # of equal margins that with the smaller error
    margin = np.minimum.reduce(list(margins.values()))
    chosen = int(np.lexsort((error[as_good], -margin))[0])
    ends = {
        str(name): way
        for i, name in enumerate(gains)
        for way, end in (("smaller", low), ("larger", high))
        if is_varied[i] and (good[:, i] == end[i]).all()
    }
    return BestGains(
        index=int(as_good[chosen]),
        least_error=float(error[least]),
        margins={name: float(values[chosen]) for name, values in margins.items() if np.isfinite(values[chosen])},
        nearly_as_good=int((works & (error <= (1.0 + NEARLY_AS_GOOD) * error[least])).sum()),
        ends=ends,
    )
