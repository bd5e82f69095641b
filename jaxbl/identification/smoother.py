"""Fixed-interval smoother of one position channel: velocity and acceleration with their covariances.

Model: white jerk of spectral density q acts on position, velocity, acceleration; the position is read with white noise.
Lengths are counted in the noise's standard deviation and times in the period, so that one number is left, q h^5 / sigma^2.
Forward pass: Kalman filter. Backward pass: modified Bryson-Frazier, which inverts nothing.
References: Y. Bar-Shalom, X.-R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), 6.2.3
(white jerk); G. J. Bierman, Fixed interval smoothing with discrete measurements, Int. J. Control 18 (1973).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxbl.drive.parameters import Scalar

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
        return jnp.sqrt(self.covariance[:, order, order])

    def held(self, period: float | Float[Array, ""]) -> Bool[Array, " samples"]:
        """Where the position is not shown to move for a while: dry friction may hold it there.

        Neither velocity nor acceleration stands out of the velocity's noise, the latter over the smoother's time constant.
        """
        corner = (self.jerk / self.noise**2 / period) ** (1.0 / 6.0)
        still = _SHOWN * self.deviation(1)
        return (jnp.abs(self.velocity) < still) & (jnp.abs(self.acceleration) < corner * still)


def running_sum(values: Float[Array, "samples ..."]) -> Float[Array, "samples ..."]:
    """Cumulative sum over samples; on a processor faster than `jnp.cumsum`, to run and to compile."""
    return jax.lax.scan(lambda total, one: (total + one, total + one), jnp.zeros_like(values[0]), values)[1]


class _Forward(NamedTuple):
    """Predictions for each sample, in units of noise and period."""

    state: Float[Array, "samples 3"]
    covariance: Float[Array, "samples 3 3"]
    innovation: Float[Array, " samples"]
    variance: Float[Array, " samples"]


TRANSITION = ((1.0, 1.0, 0.5), (0.0, 1.0, 1.0), (0.0, 0.0, 1.0))
"""Of [x, h v, h^2 a] over one period h, by a Taylor series."""
JERK_COVARIANCE = ((1 / 20, 1 / 8, 1 / 6), (1 / 8, 1 / 3, 1 / 2), (1 / 6, 1 / 2, 1.0))
"""What white jerk of spectral density 1 / h^5 adds to the covariance of [x, h v, h^2 a] in one period h."""


def _filter(
    position: Float[Array, " samples"], smoothness: Float[Array, ""], start: tuple[Array, Array] | None = None
) -> _Forward:
    f, q = jnp.asarray(TRANSITION, position.dtype), smoothness * jnp.asarray(JERK_COVARIANCE, position.dtype)
    if start is None:
        # nothing is known at first but the size of things
        largest = jnp.max(jnp.abs(jnp.diff(position)))
        size = _SPREAD * jnp.array([1.0, largest, largest])
        start = jnp.array([position[0], 0.0, 0.0]), jnp.diag(size**2 + 1.0)

    def sample(carry: tuple[Array, Array], y: Array) -> tuple[tuple[Array, Array], _Forward]:
        x, p = carry
        e, s = y - x[0], p[0, 0] + 1.0
        gain = p[:, 0] / s
        kept = jnp.eye(3, dtype=p.dtype).at[:, 0].add(-gain)
        # Joseph's form stays positive
        updated = kept @ p @ kept.T + jnp.outer(gain, gain)
        return (f @ (x + gain * e), f @ updated @ f.T + q), _Forward(x, p, e, s)

    return jax.lax.scan(sample, start, position)[1]


def _first_state(position: Array, smoothness: Array) -> tuple[Array, Array]:
    """State at the first sample by a filter that runs backwards, as good as unknown: the spread tenfold.

    From an altogether unknown one the backward pass would lose all digits in the covariance of the first samples.
    """
    last = jax.tree.map(lambda x: x[-1], _filter(position[::-1], smoothness))
    gain = last.covariance[:, 0] / last.variance
    turned = jnp.array([1.0, -1.0, 1.0])
    covariance = last.covariance - jnp.outer(gain, gain) * last.variance
    return turned * (last.state + gain * last.innovation), _SPREAD**2 * covariance * jnp.outer(turned, turned)


def _fit(position: Array) -> tuple[Array, Array]:
    """Smoothness q h^5 / sigma^2 and sigma of largest likelihood."""
    # third differences of white noise have variance 20 sigma^2; smooth motion adds little to their median
    third = jnp.diff(position, n=3)
    median = jnp.median(jnp.abs(third)) / 0.6745
    # more than half of a counter's readings may stand still
    guess = jnp.where(median > 0.0, median, jnp.sqrt(jnp.mean(third**2))) / jnp.sqrt(20.0)
    unit = jnp.maximum(guess, 1e-9 * jnp.ptp(position) + jnp.finfo(position.dtype).tiny)
    scaled = (position - position[0]) / unit

    def value(log_smoothness: Array) -> tuple[Array, Array]:
        """Log-likelihood at the best noise, and that noise over the unit."""
        # the filter's gains do not depend on the unit, only its start does
        forward = _filter(scaled, jnp.exp(log_smoothness))
        # the first samples find the state
        e, s = forward.innovation[3:], forward.variance[3:]
        variance = jnp.sum(e**2 / s) / len(e)
        return -0.5 * (len(e) * jnp.log(variance) + jnp.sum(jnp.log(s))), jnp.sqrt(variance)

    def zoom(_: Array, given: tuple[Array, ...]) -> tuple[Array, ...]:
        low, high, _ = given
        points = low + (high - low) * jnp.linspace(0.0, 1.0, _GRID)
        likelihood, noise = jax.vmap(value)(points)
        best = jnp.argmax(likelihood)
        step = (high - low) / (_GRID - 1)
        return points[best] - step, points[best] + step, noise[best]

    low, high = (jnp.log(jnp.asarray(x, position.dtype)) for x in _SMOOTHNESS)
    low, high, noise = jax.lax.fori_loop(0, _ZOOMS, zoom, (low, high, jnp.ones((), position.dtype)))
    return jnp.exp(0.5 * (low + high)), noise * unit


def _smoothed(position: Array, smoothness: Array, noise: Array, period: Array) -> Smoothed:
    scaled = (position - position[0]) / noise
    forward = _filter(scaled, smoothness, _first_state(scaled, smoothness))
    f = jnp.asarray(TRANSITION, position.dtype)
    zero = jnp.zeros(3, position.dtype)

    def sample(carry: tuple[Array, Array], given: _Forward) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        small, large = carry
        e, s, p = given.innovation, given.variance, given.covariance
        kept = jnp.eye(3, dtype=p.dtype).at[:, 0].add(-p[:, 0] / s)
        small = (kept.T @ small).at[0].add(-e / s)
        large = (kept.T @ large @ kept).at[0, 0].add(1.0 / s)
        return (f.T @ small, f.T @ large @ f), (given.state - p @ small, p - p @ large @ p)

    _, (state, covariance) = jax.lax.scan(sample, (zero, jnp.zeros((3, 3), position.dtype)), forward, reverse=True)
    unit = noise * period ** jnp.array([0.0, -1.0, -2.0])
    state = state * unit[None, :]
    state = state.at[:, 0].add(position[0])
    innovations = forward.innovation / jnp.sqrt(forward.variance)
    return Smoothed(state, covariance * jnp.outer(unit, unit)[None], noise, smoothness * noise**2 / period**5, innovations)


@jit
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
    position = jnp.asarray(position, float)
    if known is None:
        smoothness, sigma = _fit(position)
    else:
        sigma, jerk = (jnp.asarray(one, float) for one in known)
        smoothness = jerk * period**5 / sigma**2
    return _smoothed(position, smoothness, sigma, jnp.asarray(period, float))
