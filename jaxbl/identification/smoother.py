"""Fixed-interval smoother of one position channel: velocity and acceleration with their covariances.

Model: white jerk of spectral density q acts on position, velocity, acceleration; the position is read with white noise.
Lengths are counted in the noise's standard deviation and times in the period, so that one number is left, q h^5 / sigma^2.
Forward pass: Kalman filter. Backward pass: modified Bryson-Frazier, which inverts nothing.
References: Y. Bar-Shalom, X.-R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), 6.2.3
(white jerk); G. J. Bierman, Fixed interval smoothing with discrete measurements, Int. J. Control 18 (1973).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from jaxbl.drive.parameters import Scalar
from jaxbl.fused.steps import stepped

from .compilation import jit

_SMOOTHNESS = 1e-14, 1e4
"""Range of q h^5 / sigma^2 that is searched: time constants of the smoother from 200 periods to a fraction of one."""
_GRID = 19
"""Values in a round of the search: a decade apart in the first."""
_ZOOMS = 3
"""Rounds, each over a ninth of the range before: the last leaves 3 % of the smoothness open."""
_SPREAD = 10.0
"""Factor on what is known of the first state: it counts for a hundredth then."""
_SHOWN = 3.0
"""Standard deviations from which on a velocity is shown."""


class Smoothed(NamedTuple):
    """Position (rad), velocity (rad/s) and acceleration (rad/s^2) at the samples, from all of the record.

    Attributes:
        state: shape (samples, 3).
        covariance: shape (samples, 3, 3), of the reading noise and of what the jerk's noise leaves open.
        noise: standard deviation of the position readings, rad.
        jerk: spectral density q of the jerk, rad^2/s^5.
        innovations: one-step prediction errors over their standard deviations; white where the model holds.
    """

    state: Float[Array, "samples 3"]
    covariance: Float[Array, "samples 3 3"]
    noise: Float[Array, ""]
    jerk: Float[Array, ""]
    innovations: Float[Array, " samples"]

    @property
    def position(self) -> Float[Array, " samples"]:
        return self.state[:, 0]

    @property
    def velocity(self) -> Float[Array, " samples"]:
        return self.state[:, 1]

    @property
    def acceleration(self) -> Float[Array, " samples"]:
        return self.state[:, 2]

    def deviation(self, order: int) -> Float[Array, " samples"]:
        """Standard deviation of the position (0), velocity (1) or acceleration (2)."""
        return self.covariance[:, order, order] ** 0.5

    def held(self, period: float | Float[Array, ""]) -> Bool[Array, " samples"]:
        """Where the position is not shown to move for a while: dry friction may hold it there.

        Neither velocity nor acceleration stands out of the velocity's noise, the latter over the smoother's time constant.
        """
        corner = (self.jerk / self.noise**2 / period) ** (1.0 / 6.0)
        still = _SHOWN * self.deviation(1)
        return (abs(self.velocity) < still) & (abs(self.acceleration) < corner * still)


def running_sum(values: Float[Array, "samples ..."]) -> Float[Array, "samples ..."]:
    """Cumulative sum over samples; on a processor faster than `jnp.cumsum`, to run and to compile."""
    return jax.lax.scan(lambda total, one: (total + one, total + one), jnp.zeros_like(values[0]), values)[1]


TRANSITION = ((1.0, 1.0, 0.5), (0.0, 1.0, 1.0), (0.0, 0.0, 1.0))
"""Of [x, h v, h^2 a] over one period h, by a Taylor series."""
JERK_COVARIANCE = ((1 / 20, 1 / 8, 1 / 6), (1 / 8, 1 / 3, 1 / 2), (1 / 6, 1 / 2, 1.0))
"""What white jerk of spectral density 1 / h^5 adds to the covariance of [x, h v, h^2 a] in one period h."""
_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Places of a symmetric matrix of which the numbers are kept."""
_FULL = ((0, 1, 2), (1, 3, 4), (2, 4, 5))
"""Where they stand in it."""


def _predicted(values: list[Any], carry: list[Any], inputs: list[Any]) -> tuple[list[Any], list[Any]]:
    """A sample of the Kalman filter, in units of noise and period; kept: state and covariance of the prediction, its error
    and that one's variance."""
    (smoothness,), x, (y,) = values, carry[:3], inputs
    p = [[carry[3 + i] for i in row] for row in _FULL]
    e, s = y - x[0], p[0][0] + 1.0
    gain = [p[i][0] / s for i in range(3)]
    # Joseph's form stays positive: (1 - K C) P (1 - K C)' + K K'
    left = [[p[i][j] - gain[i] * p[0][j] for j in range(3)] for i in range(3)]
    u = [[left[i][j] - left[i][0] * gain[j] + gain[i] * gain[j] for j in range(3)] for i in range(3)]
    a, b, c = (x[i] + gain[i] * e for i in range(3))
    # of a state [a, b, c] what a period makes of it, and so of each row and column
    rows = [[u[0][j] + u[1][j] + 0.5 * u[2][j] for j in range(3)], [u[1][j] + u[2][j] for j in range(3)], u[2]]
    moved = [[row[0] + row[1] + 0.5 * row[2], row[1] + row[2], row[2]] for row in rows]
    new = [moved[i][j] + smoothness * JERK_COVARIANCE[i][j] for i, j in _UPPER]
    return [a + b + 0.5 * c, b + c, c, *new], [*carry, e, s]


def _innovation(values: list[Any], carry: list[Any], inputs: list[Any]) -> tuple[list[Any], list[Any]]:
    """As :func:`_predicted`; kept: error and variance alone."""
    new, found = _predicted(values, carry, inputs)
    return new, found[-2:]


def _corrected(values: list[Any], carry: list[Any], inputs: list[Any]) -> tuple[list[Any], list[Any]]:
    """A sample of the backward pass, from what the filter kept there; kept: smoothed state and covariance."""
    x, (e, s) = inputs[:3], inputs[9:]
    p = [[inputs[3 + i] for i in row] for row in _FULL]
    large = [[carry[3 + i] for i in row] for row in _FULL]
    gain = [p[i][0] / s for i in range(3)]

    def dot(some: list[Any], others: list[Any]) -> Any:
        return some[0] * others[0] + some[1] * others[1] + some[2] * others[2]

    # with C = 1 - K C: C' small, less the error; C' large C, and the precision of the reading
    small = [carry[0] - dot(gain, carry[:3]) - e / s, carry[1], carry[2]]
    w = [dot(row, gain) for row in large]
    large = [
        [large[0][0] - 2.0 * w[0] + dot(gain, w) + 1.0 / s, large[0][1] - w[1], large[0][2] - w[2]],
        [large[0][1] - w[1], large[1][1], large[1][2]],
        [large[0][2] - w[2], large[1][2], large[2][2]],
    ]
    products = [[dot(p[i], large[j]) for j in range(3)] for i in range(3)]
    state = [x[i] - dot(p[i], small) for i in range(3)]
    covariance = [p[i][j] - dot(products[i], p[j]) for i, j in _UPPER]
    # the transposed transition
    rows = [
        large[0],
        [large[0][j] + large[1][j] for j in range(3)],
        [0.5 * large[0][j] + large[1][j] + large[2][j] for j in range(3)],
    ]
    moved = [[row[0], row[0] + row[1], 0.5 * row[0] + row[1] + row[2]] for row in rows]
    a, b, c = small
    return [a, a + b, 0.5 * a + b + c, *(moved[i][j] for i, j in _UPPER)], [*state, *covariance]


def _along(sample: Any, values: list[Any], carry: list[Any], inputs: list[Any]) -> list[Any]:
    """What a function of a sample keeps along a signal: by XLA, inside of compiled programs and where no loop is."""
    return jax.lax.scan(lambda carry, inputs: sample(values, carry, inputs), carry, inputs)[1]


def _looped(sample: Any, values: list[Any], carry: list[Any], inputs: list[Any]) -> list[Any]:
    """The same by a loop, of arrays."""
    found = stepped(sample, [np.ravel(one) for one in values], [np.ravel(one) for one in carry], inputs)
    if found is None:
        raise _NoLoop
    return [one if np.ndim(carry[0]) else one[:, 0] for one in found]


class _NoLoop(Exception):
    """This machine has none."""


class _Smoother(NamedTuple):
    """Both passes, by XLA (`np` is `jax.numpy` then) or by loops."""

    np: Any
    along: Any

    def start(self, position: Any) -> list[Any]:
        """Nothing is known at first but the size of things."""
        largest = self.np.max(self.np.abs(self.np.diff(position)))
        spread = [_SPREAD**2 * size**2 + 1.0 for size in (1.0, largest, largest)]
        zero = 0.0 * position[0]
        return [position[0], zero, zero, spread[0] + zero, zero, zero, spread[1], zero, spread[2]]

    def first(self, position: Any, smoothness: Any) -> list[Any]:
        """State and covariance at the first sample by a filter that runs backwards, as good as unknown: the spread tenfold.

        From an altogether unknown one the backward pass would lose all digits in the covariance of the first samples.
        """
        *last, e, s = (one[-1] for one in self.along(_predicted, [smoothness], self.start(position), [position[::-1]]))
        x, p = last[:3], last[3:]
        gain = [p[i] / s for i in _FULL[0]]
        turned = 1.0, -1.0, 1.0
        covariance = [p[_FULL[i][j]] - gain[i] * gain[j] * s for i, j in _UPPER]
        return [
            *(sign * (one + by * e) for sign, one, by in zip(turned, x, gain, strict=True)),
            *(_SPREAD**2 * turned[i] * turned[j] * one for (i, j), one in zip(_UPPER, covariance, strict=True)),
        ]

    def likelihood(self, scaled: Any, logs: Any) -> tuple[Any, Any]:
        """Log-likelihood of several smoothnesses at their best noise, and that noise; positions in any unit, as the filter's
        gains do not depend on it."""
        values, start = [self.np.exp(logs)], [one + 0.0 * logs for one in self.start(scaled)]
        # the first samples find the state
        e, s = (one[3:] for one in self.along(_innovation, values, start, [scaled]))
        variance = self.np.sum(e**2 / s, axis=0) / len(e)
        return -0.5 * (len(e) * self.np.log(variance) + self.np.sum(self.np.log(s), axis=0)), self.np.sqrt(variance)

    def zoomed(self, scaled: Any, low: Any, high: Any) -> tuple[Any, Any, Any]:
        """Ends of a ninth of a range about the logarithm of the smoothness of largest likelihood, and the noise there."""
        points = low + (high - low) * self.np.linspace(0.0, 1.0, _GRID)
        likelihood, noise = self.likelihood(scaled, points)
        best = self.np.argmax(likelihood)
        step = (high - low) / (_GRID - 1)
        return points[best] - step, points[best] + step, noise[best]

    def unit(self, position: Any) -> Any:
        """A guess of the noise."""
        # third differences of white noise have variance 20 sigma^2; smooth motion adds little to their median
        third = self.np.diff(position, n=3)
        median = self.np.median(self.np.abs(third)) / 0.6745
        # more than half of a counter's readings may stand still
        guess = self.np.where(median > 0.0, median, self.np.sqrt(self.np.mean(third**2))) / 20.0**0.5
        return self.np.maximum(guess, 1e-9 * self.np.ptp(position) + self.np.finfo(position.dtype).tiny)

    def smoothed(self, position: Any, smoothness: Any, noise: Any, period: Any) -> Smoothed:
        scaled = (position - position[0]) / noise
        forward = self.along(_predicted, [smoothness], self.first(scaled, smoothness), [scaled])
        zero = [0.0 * scaled[0]] * 9
        found = [one[::-1] for one in self.along(_corrected, [], zero, [one[::-1] for one in forward])]
        unit = self.np.stack([noise, noise / period, noise / period**2])
        state = self.np.stack(found[:3], axis=1) * unit[None, :]
        # the position counts from the first one
        state = self.np.concatenate([state[:, :1] + position[0], state[:, 1:]], axis=1)
        covariance = self.np.stack([self.np.stack([found[3 + i] for i in row], axis=1) for row in _FULL], axis=1)
        innovations = forward[9] / self.np.sqrt(forward[10])
        jerk = smoothness * noise**2 / period**5
        return Smoothed(state, covariance * self.np.outer(unit, unit)[None], noise, jerk, innovations)


def _fit(position: Array) -> tuple[Array, Array]:
    """Smoothness q h^5 / sigma^2 and sigma of largest likelihood."""
    by = _Smoother(jnp, _along)
    unit = by.unit(position)
    scaled = (position - position[0]) / unit
    low, high = (jnp.log(jnp.asarray(x, position.dtype)) for x in _SMOOTHNESS)
    first = low, high, jnp.ones((), position.dtype)
    low, high, noise = jax.lax.fori_loop(0, _ZOOMS, lambda _, at: by.zoomed(scaled, *at[:2]), first)
    return jnp.exp(0.5 * (low + high)), noise * unit


@jit
def _scanned(position: Array, period: Any, known: tuple[Any, Any] | None) -> Smoothed:
    """As :func:`smooth`, by XLA."""
    position, period = jnp.asarray(position, float), jnp.asarray(period, float)
    if known is None:
        smoothness, sigma = _fit(position)
    else:
        sigma, jerk = (jnp.asarray(one, float) for one in known)
        smoothness = jerk * period**5 / sigma**2
    return _Smoother(jnp, _along).smoothed(position, smoothness, sigma, period)


def smooth(
    position: Float[Array, " samples"], period: float | Scalar, *, known: tuple[Scalar, Scalar] | None = None
) -> Smoothed:
    """Smooth one evenly sampled position channel.

    Args:
        position: readings in rad (or m), at least 8 of them.
        period: sampling period in s.
        known: standard deviation of the readings' noise, quantisation included, in rad, and spectral density of the jerk in
            rad^2/s^5; left out, both are found by maximum likelihood.
    """
    if any(isinstance(one, Tracer) for one in jax.tree.leaves((position, period, known))):
        return _scanned(position, period, known)
    by, values, h = _Smoother(np, _looped), np.asarray(position, float), np.float64(period)
    try:
        with np.errstate(all="ignore"):
            if known is None:
                unit = by.unit(values)
                scaled = (values - values[0]) / unit
                low, high = np.log(_SMOOTHNESS)
                noise = np.float64(1.0)
                for _ in range(_ZOOMS):
                    low, high, noise = by.zoomed(scaled, low, high)
                smoothness, sigma = np.exp(0.5 * (low + high)), noise * unit
            else:
                sigma, jerk = (np.float64(one) for one in known)
                smoothness = jerk * h**5 / sigma**2
            return by.smoothed(values, smoothness, sigma, h)
    except _NoLoop:
        return _scanned(jnp.asarray(position), jnp.asarray(period), known)
