"""Fixed-interval smoother of one position channel: velocity and acceleration with their covariances.

Model: white jerk of spectral density q acts on position, velocity, acceleration; the position is read with white noise.
Lengths are counted in the noise's standard deviation and times in the period, so that one number is left, q h^5 / sigma^2.
Forward pass: Kalman filter. Backward pass: modified Bryson-Frazier, which inverts nothing.
References: Y. Bar-Shalom, X.-R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), 6.2.3
(white jerk); G. J. Bierman, Fixed interval smoothing with discrete measurements, Int. J. Control 18 (1973).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxbl.fused import Arrays, Leaves
from jaxbl.fused.signal_scan import scan_signal

_SMOOTHNESS = 1e-14, 1e4
"""Range of q h^5 / sigma^2 that is searched: time constants of the smoother from 200 periods to a fraction of one."""
_GRID = 19
"""Values in a round of the search: a decade apart in the first."""
_ZOOMS = 3
"""Rounds, each over a ninth of the range before: the last leaves 3 % of the smoothness open."""
_SPREAD = 10.0
"""Factor on what is known of the first state: it counts for a hundredth then."""
_TOGETHER = 16
"""Channels that are smoothed side by side: what is kept of them stays small."""
_SHOWN = 3.0
"""Standard deviations from which on a velocity is shown."""


class Smoothed(NamedTuple):
    """Position (rad), velocity (rad/s) and acceleration (rad/s^2) at the samples, from all of the record.

    Attributes:
        state: shape (samples, 3).
        covariance: shape (samples, 3, 3), of the reading noise and of what the jerk's noise leaves open.
        noise: standard deviation of the position readings, rad.
        jerk: spectral density q of the jerk, rad^2/s^5.
    """

    state: np.ndarray
    covariance: np.ndarray
    noise: float | np.floating
    jerk: float | np.floating

    @property
    def velocity(self) -> np.ndarray:
        return self.state[:, 1]

    @property
    def acceleration(self) -> np.ndarray:
        return self.state[:, 2]

    def deviation(self, order: int) -> np.ndarray:
        """Standard deviation of the position (0), velocity (1) or acceleration (2)."""
        return self.covariance[:, order, order] ** 0.5

    def find_standstill(self, period: float) -> np.ndarray:
        """Find samples at which the position is not shown to move for a while: dry friction may hold it there.

        Neither velocity nor acceleration stands out of the velocity's noise, the latter over the smoother's time constant.
        """
        corner = (self.jerk / self.noise**2 / period) ** (1.0 / 6.0)
        still = _SHOWN * self.deviation(1)
        return (abs(self.velocity) < still) & (abs(self.acceleration) < corner * still)


TRANSITION = ((1.0, 1.0, 0.5), (0.0, 1.0, 1.0), (0.0, 0.0, 1.0))
"""Of [x, h v, h^2 a] over one period h, by a Taylor series."""
JERK_COVARIANCE = ((1 / 20, 1 / 8, 1 / 6), (1 / 8, 1 / 3, 1 / 2), (1 / 6, 1 / 2, 1.0))
"""What white jerk of spectral density 1 / h^5 adds to the covariance of [x, h v, h^2 a] in one period h."""
_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Places of a symmetric matrix of which the numbers are kept."""
_FULL = ((0, 1, 2), (1, 3, 4), (2, 4, 5))
"""Where they stand in it."""


def _unpack(columns: Leaves) -> tuple[Leaves, list[Leaves]]:
    """A vector, and the symmetric matrix of which the numbers in its upper triangle follow."""
    return columns[:3], [[columns[3 + i] for i in row] for row in _FULL]


def _predict(values: Leaves, carry: Leaves, inputs: Leaves) -> tuple[Leaves, Leaves]:
    """A sample of the Kalman filter, in units of noise and period; kept: state and covariance of the prediction, its error
    and that one's variance."""
    (smoothness,), (x, p), (y,) = values, _unpack(carry), inputs
    e, s = y - x[0], p[0][0] + 1.0
    gain = [p[i][0] / s for i in range(3)]
    # Joseph's form stays positive: (1 - K C) P (1 - K C)' + K K'
    left = [[p[i][j] - gain[i] * p[0][j] for j in range(3)] for i in range(3)]
    u = [[left[i][j] - left[i][0] * gain[j] + gain[i] * gain[j] for j in range(3)] for i in range(3)]
    a, b, c = (x[i] + gain[i] * e for i in range(3))
    moved = _transform(_advance, u)
    new = [moved[i][j] + smoothness * JERK_COVARIANCE[i][j] for i, j in _UPPER]
    return [*_advance(a, b, c), *new], [*carry, e, s]


def _advance(a: Any, b: Any, c: Any) -> Leaves:
    """Advance a state by one period."""
    return [a + b + 0.5 * c, b + c, c]


def _advance_transposed(a: Any, b: Any, c: Any) -> Leaves:
    """The transposed transition."""
    return [a, a + b, 0.5 * a + b + c]


def _transform(function: Callable[[Any, Any, Any], Leaves], matrix: Any) -> list[Leaves]:
    """Apply a function to each column, and to each row of what that makes."""
    return [function(*row) for row in zip(*(function(*column) for column in zip(*matrix, strict=True)), strict=True)]


def _innovation(values: Leaves, carry: Leaves, inputs: Leaves) -> tuple[Leaves, Leaves]:
    """Predict as :func:`_predict` does; kept: error and variance alone."""
    new, columns = _predict(values, carry, inputs)
    return new, columns[-2:]


def _correct(values: Leaves, carry: Leaves, inputs: Leaves) -> tuple[Leaves, Leaves]:
    """A sample of the backward pass, from what the filter kept there; kept: smoothed state and covariance."""
    (x, p), (e, s), (small, large) = _unpack(inputs), inputs[9:], _unpack(carry)
    gain = [p[i][0] / s for i in range(3)]

    def dot(a: Leaves, b: Leaves) -> Any:
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

    # with C = 1 - K C: C' small, less the error; C' large C, and the precision of the reading
    small = [small[0] - dot(gain, small) - e / s, *small[1:]]
    w = [dot(row, gain) for row in large]
    first = [large[0][0] - 2.0 * w[0] + dot(gain, w) + 1.0 / s, large[0][1] - w[1], large[0][2] - w[2]]
    large = [first, [first[1], *large[1][1:]], [first[2], *large[2][1:]]]
    products = [[dot(p[i], large[j]) for j in range(3)] for i in range(3)]
    state = [x[i] - dot(p[i], small) for i in range(3)]
    covariance = [p[i][j] - dot(products[i], p[j]) for i, j in _UPPER]
    moved = _transform(_advance_transposed, large)
    return [*_advance_transposed(*small), *(moved[i][j] for i, j in _UPPER)], [*state, *covariance]


def _along(sample: Any, values: Leaves, carry: Leaves, inputs: Leaves) -> Arrays:
    """Run a function of a sample along a signal, or along several side by side; numbers are one lane."""
    columns = scan_signal(sample, [np.ravel(value) for value in values], [np.ravel(number) for number in carry], inputs)
    return [column if np.ndim(carry[0]) else column[:, 0] for column in columns]


def _start(position: Any) -> Leaves:
    """Nothing is known at first but the size of things."""
    largest = np.max(np.abs(np.diff(position, axis=0)), axis=0)
    spread = [_SPREAD**2 * size**2 + 1.0 for size in (1.0, largest, largest)]
    zero = 0.0 * position[0]
    return [position[0], zero, zero, spread[0] + zero, zero, zero, spread[1], zero, spread[2]]


def _first(position: Any, smoothness: Any) -> Leaves:
    """State and covariance at the first sample by a filter that runs backwards, as good as unknown: the spread tenfold.

    From an altogether unknown one the backward pass would lose all digits in the covariance of the first samples.
    """
    start = _start(position)
    *last, e, s = (column[-1] for column in _along(_predict, [smoothness + 0.0 * start[0]], start, [position[::-1]]))
    x, p = _unpack(last)
    gain, turned = [number / s for number in p[0]], (1.0, -1.0, 1.0)
    covariance = [_SPREAD**2 * turned[i] * turned[j] * (p[i][j] - gain[i] * gain[j] * s) for i, j in _UPPER]
    return [*(turned[i] * (x[i] + gain[i] * e) for i in range(3)), *covariance]


def _unit(position: Any) -> Any:
    """A guess of the noise."""
    # third differences of white noise have variance 20 sigma^2; smooth motion adds little to their median
    third = np.diff(position, n=3)
    median = np.median(np.abs(third)) / 0.6745
    # more than half of a counter's readings may stand still
    guess = np.where(median > 0.0, median, np.sqrt(np.mean(third**2))) / 20.0**0.5
    return np.maximum(guess, 1e-9 * np.ptp(position) + np.finfo(position.dtype).tiny)


def _passes(scaled: Any, smoothness: Any) -> Arrays:
    """Run filter and backward pass along a position, or along several side by side, from the first sample on."""
    zero = 0.0 * scaled[0]
    forward = _along(_predict, [smoothness + zero], _first(scaled, smoothness), [scaled])
    return [column[::-1] for column in _along(_correct, [], [zero] * 9, [column[::-1] for column in forward])]


def _fit(position: np.ndarray) -> tuple[Any, Any]:
    """Smoothness q h^5 / sigma^2 and sigma of largest likelihood, each at its best noise: ninth by ninth of the range."""
    unit = _unit(position)
    # positions may have any unit, as the filter's gains do not depend on it
    scaled = (position - position[0]) / unit
    low, high = np.log(_SMOOTHNESS)
    variance, best = np.ones(1), 0
    for _ in range(_ZOOMS):
        points = low + (high - low) * np.linspace(0.0, 1.0, _GRID)
        start = [number + 0.0 * points for number in _start(scaled)]
        # the first samples find the state
        e, s = (column[3:] for column in _along(_innovation, [np.exp(points)], start, [scaled]))
        variance = np.sum(e**2 / s, axis=0) / len(e)
        best = np.argmin(len(e) * np.log(variance) + np.sum(np.log(s), axis=0))
        step = (high - low) / (_GRID - 1)
        low, high = points[best] - step, points[best] + step
    return np.exp(0.5 * (low + high)), np.sqrt(variance[best]) * unit


def smooth(position: np.ndarray, period: float, *, noise_and_jerk: tuple[Any, Any] | None = None) -> Smoothed:
    """Smooth one evenly sampled position channel.

    Args:
        position: readings in rad (or m), at least 8 of them.
        period: sampling period in s.
        noise_and_jerk: standard deviation of the readings' noise, quantisation included, in rad, and spectral density of
            the jerk in rad^2/s^5; left out, both are found by maximum likelihood.
    """
    values, h = np.asarray(position, float), np.float64(period)
    # of what is not finite nothing is
    with np.errstate(all="ignore"):
        if noise_and_jerk is None:
            smoothness, sigma = _fit(values)
        else:
            sigma, jerk = (np.float64(number) for number in noise_and_jerk)
            smoothness = jerk * h**5 / sigma**2
        columns = np.stack(_passes((values - values[0]) / sigma, smoothness), axis=1)
        unit = np.stack([sigma, sigma / h, sigma / h**2])
        state = columns[:, :3] * unit
        # the position counts from the first one
        state[:, 0] += values[0]
        covariance = columns[:, 3:][:, _FULL] * np.outer(unit, unit)
        return Smoothed(state, covariance, sigma, smoothness * sigma**2 / h**5)


def smoothed_accelerations(positions: np.ndarray, period: float, noise_and_jerk: tuple[Any, Any]) -> np.ndarray:
    """Accelerations of several channels, shape (samples, channels), each smoothed as :func:`smooth` does with the same noise
    and jerk."""
    sigma, jerk = noise_and_jerk
    smoothness, accelerations = np.float64(jerk * period**5 / sigma**2), np.empty_like(positions)
    with np.errstate(all="ignore"):
        for first in range(0, positions.shape[1], _TOGETHER):
            channels = positions[:, first : first + _TOGETHER]
            acceleration = _passes((channels - channels[0]) / sigma, smoothness)[2]
            accelerations[:, first : first + _TOGETHER] = acceleration * sigma / period**2
    return accelerations
