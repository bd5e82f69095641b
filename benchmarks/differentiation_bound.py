"""Bounds of the accuracy with which a velocity can be known from sampled positions with bounded noise.

A signal f with |f''| <= L (rad/s^2) is read every T (s) with a noise of at most N (rad). No causal differentiator can have a
smaller worst-case error of f' at a sample than :func:`least_worst_error`. A difference quotient over the right number of
periods has exactly this error. A differentiator that does not know N, and is to have the least error without noise, has at
least :func:`least_exact_error`; :func:`adaptive_quotient` reaches it for N >= L T^2 / 2. All numbers are in SI units.

References: R. Seeber, H. Haimovich, Optimal robust exact differentiation via linear adaptive techniques, Automatica 148
(2023), for the question, for the continuous bound of exact differentiators, 2 sqrt(2 N L), and for a quotient over a time
that adapts to the noise; E. Landau (1913) for |f'| <= 2 sqrt(N L) on a half line. The sampled forms and their proofs are
our own (docs/theory_appendix.md).
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


def _check_bounds(noise: float, slope: float, period: float) -> None:
    for name, value in (("noise", noise), ("slope", slope), ("period", period)):
        if not (math.isfinite(value) and value >= 0.0):
            raise InputError(f"{name}: the bound of a differentiation error needs a finite {name} >= 0, not {value}")


def difference_error(noise: float, slope: float, period: float, samples: int) -> float:
    """Worst-case error (rad/s) of the difference quotient over so many periods: 2 N / (i T) + L i T / 2.

    Args:
        noise: bound N of the noise, rad.
        slope: bound L of the second derivative, rad/s^2.
        period: sampling period T > 0, s.
        samples: periods i >= 1 that the quotient spans.
    """
    _check_bounds(noise, slope, period)
    if period <= 0.0 or samples < 1:
        raise InputError(f"samples: a difference quotient needs a period > 0 and samples >= 1, not {period} and {samples}")
    return 2.0 * noise / (samples * period) + 0.5 * slope * samples * period


def best_samples(noise: float, slope: float, period: float, most: int | None = None) -> int:
    """Periods that the best difference quotient spans: the least i with i (i + 1) >= 4 N / (L T^2), at most `most`."""
    _check_bounds(noise, slope, period)
    if period <= 0.0:
        raise InputError(f"period: a difference quotient needs a period > 0, not {period}")
    four_noise = 4.0 * noise
    step_reach = slope * period * period
    if step_reach == 0.0 and four_noise > 0.0:
        if most is None:
            raise InputError("slope: without a slope > 0 the best quotient spans all samples; give `most`")
        return most
    ratio = 0.0 if four_noise == 0.0 else four_noise / step_reach
    samples = max(1, math.ceil(0.5 * (math.sqrt(1.0 + 4.0 * ratio) - 1.0) - 1e-12))
    return samples if most is None else min(samples, most)


def least_worst_error(noise: float, slope: float, period: float = 0.0, most: int | None = None) -> float:
    """Least worst-case error (rad/s) of any causal differentiator: min over i of 2 N / (i T) + L i T / 2.

    Without a period (0) that of continuous readings, 2 sqrt(N L). At N = 0 it is L T / 2.

    Args:
        noise: bound N of the noise, rad.
        slope: bound L of the second derivative, rad/s^2.
        period: sampling period T, s.
        most: past samples that the differentiator has seen; None for all.
    """
    _check_bounds(noise, slope, period)
    if period == 0.0:
        return 2.0 * math.sqrt(noise * slope)
    return difference_error(noise, slope, period, best_samples(noise, slope, period, most))


def least_exact_error(noise: float, slope: float, period: float = 0.0) -> float:
    """Least worst-case error (rad/s) of differentiators that know no N and have the least error without noise, L T / 2.

    Such readings may be a signal without noise themselves, to be differentiated within L T / 2, while the true signal
    differs from them by N and in f'' by 2 L. Without a period (0) that of continuous readings, 2 sqrt(2 N L).

    Args:
        noise: bound N of the noise, rad.
        slope: bound L of the second derivative, rad/s^2.
        period: sampling period T, s.
    """
    exact = least_worst_error(noise, 2.0 * slope, period) - 0.5 * slope * period
    return max(exact, least_worst_error(noise, slope, period))


def adaptive_quotient(readings: np.ndarray, slope: float, period: float) -> np.ndarray:
    """Derivative by a difference quotient over as many periods as the noise that the readings show asks for.

    No N is known. That f may be within N of all readings, u(0) newest, needs |Q| <= 2 N + L T^2 s (i - s) / 2 for all
    s < i, where Q is what u(s) is off the line through u(0) and u(i). The least such N is at most the true one; with it,
    m / 2 - 2 N / (m L T^2) = 1 / 2 is solved for the number of periods m, linear between whole ones. Without noise that is
    one period, with an error of at most L T / 2. Under noise the worst-case error is :func:`least_exact_error` for
    N >= L T^2 / 2, and at most 1.21 times that below, if the readings go back by sqrt(2 N / L) + T.

    Args:
        readings: newest first along the last axis, shape (..., samples + 1), rad; samples >= 1.
        slope: bound L > 0 of the second derivative, rad/s^2.
        period: sampling period T > 0, s.

    Returns:
        Derivative at the newest reading, shape (...), rad/s.
    """
    _check_bounds(0.0, slope, period)
    last = readings.shape[-1] - 1
    unit = slope * period * period
    if unit == 0.0 or last < 1:
        raise InputError(
            f"readings: an adaptive quotient needs two readings, a slope > 0 and a period > 0, not {last + 1} reading(s), "
            f"{slope} and {period}"
        )
    rise = readings[..., :1] - readings
    twice_noise = np.zeros(readings.shape[:-1])
    for i in range(2, last + 1):
        s = np.arange(1, i)
        line_distance = np.abs(s / i * rise[..., i, None] - rise[..., 1:i]) / unit - 0.5 * s * (i - s)
        twice_noise = np.maximum(twice_noise, line_distance.max(axis=-1))
    periods = np.arange(1, last + 1)
    level = 0.5 * periods - twice_noise[..., None] / periods
    quotients = rise[..., 1:] / (periods * period)
    # level rises by more than 1/2 per period: a share for each quotient beside where it passes 1/2
    below = np.clip((level <= 0.5).sum(axis=-1) - 1, 0, last - 1)[..., None]
    above = np.minimum(below + 1, last - 1)
    low, high = (np.take_along_axis(level, index, -1)[..., 0] for index in (below, above))
    share = np.clip((0.5 - low) / np.where(high > low, high - low, 1.0), 0.0, 1.0)
    first, second = (np.take_along_axis(quotients, index, -1)[..., 0] for index in (below, above))
    return first + share * (second - first)


def worst_signal(noise: float, slope: float, period: float, samples: int) -> WorstSignal:
    """The least worst-case error by linear programming, and the signal that shows it.

    The largest f'(0) of all f with |f(-i T)| <= N for i = 0 ... samples and |f''| <= L. Signals f and -f may both give the
    reading zero throughout, so that whatever is made of these readings errs by f'(0) for one of them; and the set of signals
    is convex and symmetric, for which no method errs more than that (docs/theory_appendix.md). The unknowns are f(0), f'(0)
    and f'' in each period, constant there: the largest f'(0) is reached by such a signal.
    """
    _check_bounds(noise, slope, period)
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
    solution = linprog(objective, np.vstack([rows, -rows]), limits, bounds=bounds, method="highs")
    if not solution.success:
        raise InputError(f"noise, slope, period: the linear program of the bound was not solved: {solution.message}")
    unit = scale / period
    return WorstSignal(float(solution.x[1]) * unit, rows @ solution.x * scale, solution.x[2:] * unit / period)
