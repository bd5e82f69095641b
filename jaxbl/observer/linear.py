"""Linear observers of one side: Luenberger, steady-state Kalman, extended state, and filtered differences.

Observers with a model correct the predicted position, velocity and disturbance (an acceleration, held between samples) by
fixed shares L of the innovation: x_hat = x_predicted + L (y - x_predicted). The shares are computed once, from the gains.
"""

import abc
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.drive.parameters import Scalar, parameter

from .base import (
    OBSERVERS,
    AbstractObserver,
    Acceleration,
    Estimate,
    GainRanges,
    ObserverState,
    OperatingConditions,
    predict_next,
)

_SLOWEST, _FASTEST = 1e-3, 3.0
"""Range of bandwidths for a search of gains, rad/s times the sampling period: poles at 0.999 and 0.05."""


class Correction(NamedTuple):
    """Shares of the innovation (rad) that are added to position (1), velocity (1/s) and disturbance (1/s^2)."""

    position: Scalar
    velocity: Scalar
    disturbance: Scalar


class AbstractLinearObserver(AbstractObserver):
    """An observer whose correction is linear in the innovation, with the same shares at all samples.

    Attributes:
        has_disturbance: True if the disturbance is a state; otherwise it is what corrects the velocity.
    """

    has_disturbance: ClassVar[bool] = True

    @abc.abstractmethod
    def correction(self, acceleration: Acceleration, period: Scalar) -> Correction:
        """Shares of the innovation, for the nominal acceleration and the sampling period (s)."""

    def start(self, position, velocity, acceleration, period):
        shares = self.correction(acceleration, period)
        return ObserverState(position, velocity, (jnp.zeros_like(jnp.asarray(position + velocity)), *shares))

    def step(self, state, measured, acceleration, period):
        disturbance, *shares = state.further
        share = Correction(*shares)
        innovation = measured - state.position
        position = state.position + share.position * innovation
        velocity = state.velocity + share.velocity * innovation
        disturbance = disturbance + share.disturbance * innovation
        if self.has_disturbance:
            control = disturbance
            new = predict_next(position, velocity, acceleration, period, disturbance=disturbance)
        else:
            control = share.velocity * innovation / period
            new = predict_next(position, velocity, acceleration, period, missing_acceleration=control)
        return ObserverState(*new, (disturbance, *share)), Estimate(position, velocity, control)


@OBSERVERS.add
class Luenberger(AbstractLinearObserver):
    """Observer of position and velocity with two poles; the missing acceleration is what corrects its velocity.

    The shares 1 - p_2 and (1 + p_1 + p_2) / h of the innovation give a double integrator the characteristic polynomial
    z^2 + p_1 z + p_2, whose roots are exp(s h) with s^2 + 2 damping bandwidth s + bandwidth^2 = 0.
    Reference: D. G. Luenberger, IEEE Trans. Mil. Electron. 8 (1964).
    """

    name = "luenberger"
    has_disturbance = False
    bandwidth: Scalar = parameter("rad/s", "natural frequency of the observer's poles", above=0.0)
    damping: Scalar = parameter("", "damping ratio of the observer's poles", default=1.0, above=0.0)

    @classmethod
    def gain_ranges(cls, conditions: OperatingConditions) -> GainRanges:
        return {"bandwidth": (_SLOWEST / conditions.period, _FASTEST / conditions.period), "damping": (0.003, 10.0)}

    def correction(self, acceleration, period):
        angle = self.bandwidth * period
        decay = jnp.exp(-self.damping * angle)
        discriminant = 1.0 - self.damping * self.damping
        turn = angle * jnp.sqrt(jnp.abs(discriminant))
        # a damping above 1 makes two real poles, exp(-d + t) and exp(-d - t), of which neither overflows
        sum_of_real = jnp.exp(turn - self.damping * angle) + jnp.exp(-turn - self.damping * angle)
        sum_of_poles = jnp.where(discriminant > 0.0, 2.0 * decay * jnp.cos(turn), sum_of_real)
        product = decay * decay
        return Correction(1.0 - product, (1.0 - sum_of_poles + product) / period, jnp.zeros_like(product))


@OBSERVERS.add
class ExtendedState(AbstractLinearObserver):
    """Linear extended-state observer: the disturbance is a third state, and the three poles are equal.

    With beta = exp(-bandwidth h) the shares of the innovation are 1 - beta^3, 3/2 (1 - beta)^2 (1 + beta) / h and
    (1 - beta)^3 / h^2; the estimate includes the measurement.
    References: Z. Gao, Proc. American Control Conf. (2003); for the discrete form, R. Miklosovic, A. Radke, Z. Gao, Proc.
    American Control Conf. (2006).
    """

    name = "extended_state"
    bandwidth: Scalar = parameter("rad/s", "natural frequency of the observer's poles", above=0.0)

    @classmethod
    def gain_ranges(cls, conditions: OperatingConditions) -> GainRanges:
        return {"bandwidth": (_SLOWEST / conditions.period, _FASTEST / conditions.period)}

    def correction(self, acceleration, period):
        share = -jnp.expm1(-self.bandwidth * period)  # 1 - beta
        beta = 1.0 - share
        rate = share / period
        return Correction(share * (1.0 + beta + beta * beta), 1.5 * rate * share * (1.0 + beta), share * rate * rate)


@OBSERVERS.add
class Kalman(AbstractLinearObserver):
    """Steady-state Kalman filter of position, velocity and a disturbance that is a random walk.

    The shares of the innovation follow from the Riccati equation of the nominal model with friction; only the ratios of the
    three noises matter. It is solved by doubling: E. K.-W. Chu et al., Int. J. Control 77 (2004).
    """

    name = "kalman"
    position_noise: Scalar = parameter("rad", "rms error of the measured position", above=0.0)
    disturbance_noise: Scalar = parameter(
        "rad/s³/√Hz", "density of the white noise whose integral is the disturbance", above=0.0
    )
    acceleration_noise: Scalar = parameter(
        "rad/s²/√Hz", "density of the white noise beside the disturbance", default=0.0, minimum=0.0
    )

    @classmethod
    def gain_ranges(cls, conditions: OperatingConditions) -> GainRanges:
        # since only ratios matter, the noise of an ideal encoder is arbitrary. A bandwidth w needs a disturbance noise of
        # position_noise sqrt(h) w^3, or an acceleration noise of position_noise sqrt(h) w^2
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

        def transition_column(velocity: Any, disturbance: Any) -> list[Any]:
            # states are position, velocity times h, disturbance times h^2, over the position's noise: numbers near 1
            acting = disturbance / (period * period)
            new_position, new_velocity = predict_next(zero, velocity / period, acceleration, period, disturbance=acting)
            return [new_position - still[0], (new_velocity - still[1]) * period, disturbance]

        unit = zero + 1.0
        transposed = _matrix([[unit, zero, zero], transition_column(unit, zero), transition_column(zero, unit)])
        noise = self.position_noise
        slow = (self.disturbance_noise / noise) ** 2 * period**5
        fast = (self.acceleration_noise / noise) ** 2 * period**3
        # covariance of white noise that is integrated over a period, once, twice and three times
        q = [
            [slow / 20.0 + fast / 3.0, slow / 8.0 + fast / 2.0, slow / 6.0],
            [slow / 8.0 + fast / 2.0, slow / 3.0 + fast, slow / 2.0],
            [slow / 6.0, slow / 2.0, slow],
        ]
        variance, covariance, disturbance = _solve_riccati(transposed, _matrix(q))[:, 0]
        total = variance + 1.0
        return Correction(variance / total, covariance / (total * period), disturbance / (total * period * period))


Matrix = np.ndarray
"""Three rows of three numbers of JAX, as objects: compiled loops over lanes have no arrays."""


def _matrix(rows: Sequence[Sequence[Any]]) -> Matrix:
    matrix = np.empty((3, 3), object)
    for i, j in np.ndindex(3, 3):
        matrix[i, j] = rows[i][j]
    return matrix


_DOUBLINGS = 32
"""Doublings, for 2^32 samples: every useful filter is stationary by then."""


def _solve_riccati(transposed: Matrix, q: Matrix) -> Matrix:
    """Solve the Riccati equation p = a p (1 + g p)^-1 a' + q by doubling, with g = diag(1, 0, 0).

    p is the covariance of the predicted state of x' = a x + w, where w has the covariance q, and the first component of x is
    measured with unit noise.

    Args:
        transposed: the transpose a' of the transition matrix.
        q: covariance of the process noise over a period.
    """
    zero = 0.0 * q[0, 0]

    def double(_: Any, carry: list[list[list[Any]]]) -> list[list[list[Any]]]:
        # b is the transposed transition over 2^k samples
        b, g, p = map(_matrix, carry)
        inverse = _invert(_unit_diagonal(zero, 3) + g @ p)
        b_inverse = b @ inverse
        new = b_inverse @ b, _symmetrise(g + b_inverse @ g @ b.T), _symmetrise(p + b.T @ p @ inverse @ b)
        return [matrix.tolist() for matrix in new]

    start = [matrix.tolist() for matrix in (transposed, _unit_diagonal(zero, 1), q)]
    return _matrix(jax.lax.fori_loop(0, _DOUBLINGS, double, start)[2])


def _unit_diagonal(zero: Any, size: int) -> Matrix:
    return _matrix([[zero + float(i == j < size) for j in range(3)] for i in range(3)])


def _symmetrise(a: Matrix) -> Matrix:
    """Make a matrix symmetric again; rounding would distort it more with each doubling."""
    return 0.5 * (a + a.T)


def _invert(a: Matrix) -> Matrix:
    """Invert a matrix by its cofactors."""

    def cofactor(i: int, j: int) -> Any:
        rows, columns = ([(k + 1) % 3, (k + 2) % 3] for k in (i, j))
        minor = a[np.ix_(rows, columns)]
        return minor[0, 0] * minor[1, 1] - minor[0, 1] * minor[1, 0]

    cofactors = _matrix([[cofactor(i, j) for j in range(3)] for i in range(3)])
    determinant = a[0] @ cofactors[0]
    return _matrix([[number / determinant for number in column] for column in cofactors.T])


@OBSERVERS.add
class DirtyDerivative(AbstractObserver):
    """Filtered difference, as in most drives: velocity s / (T s + 1) of the measured position, without a model.

    The missing acceleration is the filtered difference of this velocity, less the nominal acceleration behind the same
    filters: a disturbance observer, K. Ohnishi et al., IEEE/ASME Trans. Mechatronics 1 (1996). The filters are discretised
    by backward Euler.
    """

    name = "dirty_derivative"
    time_constant: Scalar = parameter("s", "time constant of the low-pass on each difference", minimum=0.0)

    @classmethod
    def gain_ranges(cls, conditions: OperatingConditions) -> GainRanges:
        return {"time_constant": (conditions.period / _FASTEST, conditions.period / _SLOWEST)}

    def start(self, position, velocity, acceleration, period):
        zero = jnp.zeros_like(jnp.asarray(position + velocity))
        # as if the side had moved with this velocity before
        return ObserverState(position, velocity, (position - period * velocity, velocity + zero, zero, zero, zero, zero))

    def step(self, state, measured, acceleration, period):
        old_position, old_velocity, older_input, old_input, filtered_input, disturbance = state.further
        share = period / (self.time_constant + period)
        velocity = old_velocity + share * ((measured - old_position) / period - old_velocity)
        # the second difference spans two periods: the input's acceleration is the mean over both, behind the low-pass
        filtered_input = filtered_input + share * (0.5 * (older_input + old_input) - filtered_input)
        present_input = acceleration(jnp.zeros_like(velocity))
        friction = acceleration(0.5 * (velocity + old_velocity)) - present_input
        difference = (velocity - old_velocity) / period
        disturbance = disturbance + share * (difference - filtered_input - friction - disturbance)
        new = predict_next(measured, velocity, acceleration, period, disturbance=disturbance)
        extra_states = measured, velocity, old_input, present_input, filtered_input, disturbance
        return ObserverState(*new, extra_states), Estimate(measured, velocity, disturbance)
