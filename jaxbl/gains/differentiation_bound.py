"""How well a velocity can be known at all from sampled positions with bounded noise.

A signal f with |f''| <= L (rad/s^2) is read every T (s) with a noise of at most N (rad). No causal differentiator can have a
smaller worst-case error of f' at a sample than :func:`least_worst_error`, and a difference quotient over the right number of
periods has just that. All functions take and return plain numbers in SI units.

References: R. Seeber, H. Haimovich, Optimal robust exact differentiation via linear adaptive techniques, Automatica 148
(2023), for the question and for the continuous bound of exact differentiators, 2 sqrt(2 N L); E. Landau (1913) for
|f'| <= 2 sqrt(N L) on a half line. The proof of the sampled form is in docs/theory.md.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import linprog

from jaxbl.errors import InputError


class WorstSignal(NamedTuple):
    """The signal that no differentiator tells from its negative: both give the reading zero at every sample.

    Attributes:
        error: its derivative at the newest sample, rad/s: the least worst-case error.
        signal: its values at the samples, newest first, shape (samples + 1,), rad.
        acceleration: its second derivative in each period, newest first, shape (samples,), rad/s^2.
    """

    error: float
    signal: np.ndarray
    acceleration: np.ndarray


def _checked(noise: float, slope: float, period: float) -> None:
    for name, value, least in (("noise", noise, 0.0), ("slope", slope, 0.0), ("period", period, 0.0)):
        if not (math.isfinite(value) and value >= least):
            raise InputError(f"{name}: the bound of a differentiation error needs a finite {name} >= 0, not {value}")


def difference_error(noise: float, slope: float, period: float, samples: int) -> float:
    """Worst-case error (rad/s) of the difference quotient over so many periods: 2 N / (i T) + L i T / 2.

    Args:
        noise: bound N of the noise, rad.
        slope: bound L of the second derivative, rad/s^2.
        period: sampling period T > 0, s.
        samples: periods i >= 1 that the quotient spans.
    """
    _checked(noise, slope, period)
    if period <= 0.0 or samples < 1:
        raise InputError(f"samples: a difference quotient needs a period > 0 and samples >= 1, not {period} and {samples}")
    return 2.0 * noise / (samples * period) + 0.5 * slope * samples * period


def best_samples(noise: float, slope: float, period: float, most: int | None = None) -> int:
    """Periods that the best difference quotient spans: the least i with i (i + 1) >= 4 N / (L T^2), at most `most`."""
    _checked(noise, slope, period)
    if period <= 0.0:
        raise InputError(f"period: a difference quotient needs a period > 0, not {period}")
    wanted = 4.0 * noise
    reach = slope * period * period
    if reach == 0.0 and wanted > 0.0:
        if most is None:
            raise InputError("slope: without a slope > 0 the best quotient spans all samples; give `most`")
        return most
    ratio = 0.0 if wanted == 0.0 else wanted / reach
    found = max(1, math.ceil(0.5 * (math.sqrt(1.0 + 4.0 * ratio) - 1.0) - 1e-12))
    return found if most is None else min(found, most)


def least_worst_error(noise: float, slope: float, period: float = 0.0, most: int | None = None) -> float:
    """Least worst-case error (rad/s) of any causal differentiator: min over i of 2 N / (i T) + L i T / 2.

    Without a period (0) that of continuous readings, 2 sqrt(N L). At N = 0 it is L T / 2.

    Args:
        noise: bound N of the noise, rad.
        slope: bound L of the second derivative, rad/s^2.
        period: sampling period T, s.
        most: past samples that the differentiator has seen; None for all.
    """
    _checked(noise, slope, period)
    if period == 0.0:
        return 2.0 * math.sqrt(noise * slope)
    return difference_error(noise, slope, period, best_samples(noise, slope, period, most))


def least_exact_error(noise: float, slope: float) -> float:
    """Least worst-case error (rad/s) of differentiators that know no N and are exact without noise: 2 sqrt(2 N L).

    For continuous readings. Readings that are a signal with |f''| <= L themselves must be differentiated exactly, while the
    true signal may differ from them by N and in f'' by 2 L. Reference: R. Seeber, H. Haimovich, Automatica 148 (2023).
    """
    _checked(noise, slope, 0.0)
    return 2.0 * math.sqrt(2.0 * noise * slope)


def worst_signal(noise: float, slope: float, period: float, samples: int) -> WorstSignal:
    """The least worst-case error by linear programming, and the signal that shows it.

    The largest f'(0) of all f with |f(-i T)| <= N for i = 0 ... samples and |f''| <= L. Signals f and -f may both give the
    reading zero throughout, so that whatever is made of these readings errs by f'(0) for one of them; and the set of signals
    is convex and symmetric, for which no method errs more than that (docs/theory.md). The unknowns are f(0), f'(0) and
    f'' in each period, constant there: the largest f'(0) is reached by such a signal.
    """
    _checked(noise, slope, period)
    if period <= 0.0 or samples < 1:
        raise InputError(f"samples: the linear program needs a period > 0 and samples >= 1, not {period} and {samples}")
    # times in periods, lengths in L T^2 or N: what the solver sees is of order one
    scale = max(noise, slope * period * period)
    if scale == 0.0:
        return WorstSignal(0.0, np.zeros(samples + 1), np.zeros(samples))
    level, push = noise / scale, slope * period * period / scale
    back = np.arange(samples + 1)
    # f(-i) = f(0) - i f'(0) + sum over periods j < i of (i - j - 1/2) f''_j
    weights = np.maximum(back[:, None] - np.arange(samples)[None, :] - 0.5, 0.0)
    rows = np.hstack([np.ones((samples + 1, 1)), -back[:, None], weights])
    bounds = [(None, None), (None, None), *[(-push, push)] * samples]
    objective = np.zeros(samples + 2)
    objective[1] = -1.0
    limits = np.full(2 * (samples + 1), level)
    found = linprog(objective, np.vstack([rows, -rows]), limits, bounds=bounds, method="highs")
    if not found.success:
        raise InputError(f"noise, slope, period: the linear program of the bound was not solved: {found.message}")
    unit = scale / period
    return WorstSignal(float(found.x[1]) * unit, rows @ found.x * scale, found.x[2:] * unit / period)
