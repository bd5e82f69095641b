"""Linear observers of one side: Luenberger, steady-state Kalman, extended state, and the filtered difference of most drives.

Those with a model correct the predicted position, velocity and disturbance (an acceleration, held between samples) by fixed
shares of the innovation: x_hat = x_predicted + L (y - x_predicted). Their shares follow from gains before the first sample.
"""

import abc
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from jaxbl.drive.parameters import Scalar, parameter

from .base import OBSERVERS, AbstractObserver, Acceleration, Estimate, ObserverState, OperatingConditions, predict_next

_SLOWEST, _FASTEST = 1e-3, 3.0
"""Bandwidths worth a search, rad/s times the sampling period: poles at 0.999 and 0.05."""


class Correction(NamedTuple):
    """What a unit of innovation (rad) adds: to the position in rad, to the velocity in rad/s, to the disturbance in
    rad/s^2."""

    position: Scalar
    velocity: Scalar
    disturbance: Scalar


class AbstractLinearObserver(AbstractObserver):
    """An observer whose correction is linear in the innovation and the same at all samples."""

    @abc.abstractmethod
    def correction(self, acceleration: Acceleration, period: Scalar) -> Correction:
        """Shares of the innovation."""

    def start(self, position, velocity, acceleration, period):
        shares = self.correction(acceleration, period)
        return ObserverState(position, velocity, (jnp.zeros_like(jnp.asarray(position + velocity)), *shares))

    def step(self, state, measured, acceleration, period):
        disturbance, *shares = state.extra_states
        share = Correction(*shares)
        innovation = measured - state.position
        position = state.position + share.position * innovation
        velocity = state.velocity + share.velocity * innovation
        disturbance = disturbance + share.disturbance * innovation
        if self.has_disturbance:
            control = disturbance
            new = predict_next(position, velocity, acceleration, period, held=disturbance)
        else:
            control = share.velocity * innovation / period
            new = predict_next(position, velocity, acceleration, period, missing=control)
        return ObserverState(*new, (disturbance, *share)), Estimate(position, velocity, control)

    has_disturbance: ClassVar[bool] = True
    """Whether the observer has the disturbance as a state of its own."""


@OBSERVERS.add
class Luenberger(AbstractLinearObserver):
    """Observer of position and velocity with two poles; the missing acceleration is what corrects its velocity.

    Reference: D. G. Luenberger, IEEE Trans. Mil. Electron. 8 (1964); the shares place the poles of z^2 + p_1 z + p_2 of the
    double integrator: 1 - p_2 and (1 + p_1 + p_2) / h.
    """

    name: ClassVar[str] = "luenberger"
    has_disturbance: ClassVar[bool] = False
    bandwidth: Scalar = parameter("rad/s", "natural frequency of the observer's poles", above=0.0)
    damping: Scalar = parameter("", "damping ratio of the observer's poles", default=1.0, above=0.0)

    @classmethod
    def gain_ranges(cls, conditions: OperatingConditions) -> Mapping[str, tuple[float, float]]:
        return {"bandwidth": (_SLOWEST / conditions.period, _FASTEST / conditions.period), "damping": (0.003, 10.0)}

    def correction(self, acceleration, period):
        reach = self.bandwidth * period
        decay = jnp.exp(-self.damping * reach)
        beside = 1.0 - self.damping * self.damping
        turn = reach * jnp.sqrt(jnp.abs(beside))
        # two real poles where the damping is above one: exp(-d + t) and exp(-d - t), neither of which overflows
        real = jnp.exp(turn - self.damping * reach) + jnp.exp(-turn - self.damping * reach)
        poles = jnp.where(beside > 0.0, 2.0 * decay * jnp.cos(turn), real)
        product = decay * decay
        return Correction(1.0 - product, (1.0 - poles + product) / period, jnp.zeros_like(product))


@OBSERVERS.add
class ExtendedState(AbstractLinearObserver):
    """Linear extended-state observer: the disturbance is a third state, all three poles are at one place.

    Reference: Z. Gao, Proc. American Control Conf. (2003); R. Miklosovic, A. Radke, Z. Gao, Proc. American Control Conf.
    (2006) for the discrete form whose estimate includes the measurement: with beta = exp(-bandwidth h) the shares are
    1 - beta^3, 3/2 (1 - beta)^2 (1 + beta) / h and (1 - beta)^3 / h^2.
    """

    name: ClassVar[str] = "extended_state"
    bandwidth: Scalar = parameter("rad/s", "natural frequency of the observer's poles", above=0.0)

    @classmethod
    def gain_ranges(cls, conditions: OperatingConditions) -> Mapping[str, tuple[float, float]]:
        return {"bandwidth": (_SLOWEST / conditions.period, _FASTEST / conditions.period)}

    def correction(self, acceleration, period):
        left = -jnp.expm1(-self.bandwidth * period)
        beta = 1.0 - left
        rate = left / period
        return Correction(left * (1.0 + beta + beta * beta), 1.5 * rate * left * (1.0 + beta), left * rate * rate)


@OBSERVERS.add
class Kalman(AbstractLinearObserver):
    """Steady-state Kalman filter of position, velocity and a disturbance that is a random walk.

    Its shares are those of the Riccati equation of the nominal model with friction, solved by doubling: E. K.-W. Chu et al.,
    Int. J. Control 77 (2004). Only the ratios of the three noises matter.
    """

    name: ClassVar[str] = "kalman"
    position_noise: Scalar = parameter("rad", "rms error of the measured position", above=0.0)
    disturbance_noise: Scalar = parameter(
        "rad/s³/√Hz", "density of the white noise whose integral is the disturbance", above=0.0
    )
    acceleration_noise: Scalar = parameter(
        "rad/s²/√Hz", "density of the white noise beside the disturbance", default=0.0, minimum=0.0
    )

    @classmethod
    def gain_ranges(cls, conditions: OperatingConditions) -> Mapping[str, tuple[float, float]]:
        # only ratios matter: an ideal encoder may have any noise. Without the other noise, a bandwidth w needs a density of
        # position_noise sqrt(h) w^3, or w^2
        noise = max(conditions.noise, 1e-9)
        size, slow, fast = noise * conditions.period**0.5, _SLOWEST / conditions.period, _FASTEST / conditions.period
        return {
            "position_noise": (noise, noise),
            "disturbance_noise": (size * slow**3, size * fast**3),
            "acceleration_noise": (size * slow**2, size * fast**2),
        }

    def correction(self, acceleration, period):
        zero = jnp.zeros_like(jnp.asarray(period + self.position_noise))
        still = predict_next(zero, zero, acceleration, period)

        def column(velocity: Any, control: Any) -> list[Any]:
            # states are position, velocity times h, disturbance times h^2, over the position's noise: numbers near one
            moved = predict_next(zero, velocity / period, acceleration, period, held=control / (period * period))
            return [moved[0] - still[0], (moved[1] - still[1]) * period, control]

        one = zero + 1.0
        turned = [[one, zero, zero], column(one, zero), column(zero, one)]
        noise = self.position_noise
        slow = (self.disturbance_noise / noise) ** 2 * period**5
        fast = (self.acceleration_noise / noise) ** 2 * period**3
        # white noise integrated over a period, once and twice more
        q = [
            [slow / 20.0 + fast / 3.0, slow / 8.0 + fast / 2.0, slow / 6.0],
            [slow / 8.0 + fast / 2.0, slow / 3.0 + fast, slow / 2.0],
            [slow / 6.0, slow / 2.0, slow],
        ]
        covariance = _solve_riccati(turned, q)
        total = covariance[0][0] + 1.0
        return Correction(
            covariance[0][0] / total, covariance[1][0] / (total * period), covariance[2][0] / (total * period * period)
        )


Matrix = list[list[Any]]
"""Three rows of three numbers: loops compiled for lanes know no arrays."""

_DOUBLINGS = 32
"""2^32 samples: any filter that is of use is stationary by then."""


def _solve_riccati(turned: Matrix, q: Matrix) -> Matrix:
    """Covariance p of the predicted state, of x' = a x + w with covariance q of w, whose first number is measured with unit
    noise: the solution of p = a p (1 + g p)^-1 a' + q, by doubling. `turned` is a'."""
    zero = 0.0 * q[0][0]
    g = [[zero + 1.0, zero, zero], [zero, zero, zero], [zero, zero, zero]]

    def doubled(_: Any, carry: tuple[Matrix, Matrix, Matrix]) -> tuple[Matrix, Matrix, Matrix]:
        b, g, p = carry
        shrunk = _invert(_add(_identity(zero), _multiply(g, p)))
        back, forward = _transpose(b), _multiply(b, shrunk)
        return (
            _multiply(forward, b),
            _symmetrise(_add(g, _multiply(_multiply(forward, g), back))),
            _symmetrise(_add(p, _multiply(_multiply(_multiply(back, p), shrunk), b))),
        )

    return jax.lax.fori_loop(0, _DOUBLINGS, doubled, (turned, g, q))[2]


def _identity(zero: Any) -> Matrix:
    return [[zero + float(i == j) for j in range(3)] for i in range(3)]


def _multiply(a: Matrix, b: Matrix) -> Matrix:
    return [[sum((a[i][k] * b[k][j] for k in range(1, 3)), a[i][0] * b[0][j]) for j in range(3)] for i in range(3)]


def _add(a: Matrix, b: Matrix) -> Matrix:
    return [[x + y for x, y in zip(left, right, strict=True)] for left, right in zip(a, b, strict=True)]


def _transpose(a: Matrix) -> Matrix:
    return [list(row) for row in zip(*a, strict=True)]


def _symmetrise(a: Matrix) -> Matrix:
    """Rounding would make it lopsided, more with each doubling."""
    return [[0.5 * (a[i][j] + a[j][i]) for j in range(3)] for i in range(3)]


def _invert(a: Matrix) -> Matrix:
    """By cofactors."""

    def cofactor(i: int, j: int) -> Any:
        rows, columns = ([(k + 1) % 3, (k + 2) % 3] for k in (i, j))
        return a[rows[0]][columns[0]] * a[rows[1]][columns[1]] - a[rows[0]][columns[1]] * a[rows[1]][columns[0]]

    cofactors = [[cofactor(i, j) for j in range(3)] for i in range(3)]
    determinant = sum((a[0][j] * cofactors[0][j] for j in range(1, 3)), a[0][0] * cofactors[0][0])
    return [[cofactors[j][i] / determinant for j in range(3)] for i in range(3)]


@OBSERVERS.add
class DirtyDerivative(AbstractObserver):
    """Filtered difference, as in most drives: velocity s / (T s + 1) of the measured position, without a model.

    The missing acceleration is the filtered difference of that velocity, less the nominal acceleration behind the same
    filters (a disturbance observer: K. Ohnishi et al., IEEE/ASME Trans. Mechatronics 1 (1996)). Backward Euler.
    """

    name: ClassVar[str] = "dirty_derivative"
    time_constant: Scalar = parameter("s", "time constant of the low-pass on each difference", minimum=0.0)

    @classmethod
    def gain_ranges(cls, conditions: OperatingConditions) -> Mapping[str, tuple[float, float]]:
        return {"time_constant": (conditions.period / _FASTEST, conditions.period / _SLOWEST)}

    def start(self, position, velocity, acceleration, period):
        zero = jnp.zeros_like(jnp.asarray(position + velocity))
        # as if it had moved so before
        return ObserverState(position, velocity, (position - period * velocity, velocity + zero, zero, zero, zero, zero))

    def step(self, state, measured, acceleration, period):
        before, velocity_before, earlier, last, given, disturbance = state.extra_states
        share = period / (self.time_constant + period)
        velocity = velocity_before + share * ((measured - before) / period - velocity_before)
        # a difference of two differences spans two periods: the input is the mean of theirs, behind the velocity's low-pass
        given = given + share * (0.5 * (earlier + last) - given)
        still = acceleration(jnp.zeros_like(velocity))
        friction = acceleration(0.5 * (velocity + velocity_before)) - still
        disturbance = disturbance + share * ((velocity - velocity_before) / period - given - friction - disturbance)
        new = predict_next(measured, velocity, acceleration, period, held=disturbance)
        further = measured, velocity, last, still, given, disturbance
        return ObserverState(*new, further), Estimate(measured, velocity, disturbance)
