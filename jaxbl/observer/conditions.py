"""Gain conditions of the super-twisting observer, for the error system (34) with bound f_plus.

All functions are elementwise over JAX arrays that broadcast, and differentiable away from their limits, but for
`least_lambda_exact` (a bisection). `least_lambda_*` return the smallest lambda (rad^0.5/s) that a condition allows for given
alpha and f_plus (rad/s^2); where no lambda does (alpha <= f_plus) that is `inf`. By homogeneity all of them are sqrt(f_plus)
times a function of alpha / f_plus.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Values = Float[Array, "..."]


def _above(alpha: Values, f_plus: Values, value: Values) -> Values:
    return jnp.where(alpha > f_plus, value, jnp.inf)


def least_lambda_davila_fridman(alpha: Values, f_plus: Values, q: float = 0.0) -> Values:
    """Condition (32): lambda > sqrt(2 / (alpha - f)) (alpha + f) (1 + q) / (1 - q), 0 <= q < 1.

    Reference: J. Davila, L. Fridman, A. Levant, IEEE Trans. Autom. Control 50 (2005).
    """
    margin = jnp.where(alpha > f_plus, alpha - f_plus, 1.0)
    return _above(alpha, f_plus, jnp.sqrt(2.0 / margin) * (alpha + f_plus) * (1.0 + q) / (1.0 - q))


def least_lambda_seeber_horn(alpha: Values, f_plus: Values) -> Values:
    """lambda > sqrt(alpha + f). Reference: R. Seeber, M. Horn, Automatica 84 (2017)."""
    return _above(alpha, f_plus, jnp.sqrt(alpha + f_plus))


def peak_ratio(lambda_: Values, alpha: Values, f_plus: Values) -> Values:
    """Worst-case ratio rho of successive velocity peaks, in closed form; the error converges in finite time iff rho < 1.

    With y = sqrt(x) the outermost trajectory of (34) is a homogeneous first-order equation in each quadrant:
    rho = sqrt(c2 / c1) exp(-(lambda / 2) (I1 + I2)) with c1 = 2 (alpha - f), c2 = 2 (alpha + f) and, from 0 to infinity,
    I1 = int dp / (p^2 + lambda p + c1), I2 = int dp / (p^2 - lambda p + c2).
    rho is 0 where lambda^2 >= 4 c2, and `inf` where alpha <= f.
    Source: derived for this project (docs/theory.md), checked against simulation.
    """
    possible = alpha > f_plus
    c1 = jnp.where(possible, 2.0 * (alpha - f_plus), 1.0)
    c2 = 2.0 * (alpha + f_plus)
    direct = lambda_**2 >= 4.0 * c2
    half2 = jnp.sqrt(jnp.where(direct, 1.0, c2 - 0.25 * lambda_**2))
    second = (0.5 * jnp.pi + jnp.arctan(0.5 * lambda_ / half2)) / half2
    exponent = -0.5 * lambda_ * (_first_integral(lambda_, c1) + second)
    rho = jnp.where(direct, 0.0, jnp.sqrt(c2 / c1) * jnp.exp(exponent))
    return jnp.where(possible, rho, jnp.inf)


def _first_integral(lambda_: Values, c1: Values) -> Values:
    """int_0^inf dp / (p^2 + lambda p + c1), over the complex, double and real root cases."""
    half = 0.5 * lambda_
    discriminant = c1 - half**2
    # the series about the double root: atan(x) / x and atanh(x) / x are 1 -+ x^2 / 3 there
    near = jnp.abs(discriminant) < 1e-6 * c1
    size = jnp.sqrt(jnp.where(near, 1.0, jnp.abs(discriminant)))
    complex_roots = jnp.arctan2(size, half) / size
    real = jnp.where(near | (discriminant > 0.0), 0.0, size / jnp.where(half > 0.0, half, 1.0))
    real_roots = jnp.arctanh(real) / size
    double = (1.0 - discriminant / (3.0 * c1)) / jnp.where(near, half, 1.0)
    return jnp.where(near, double, jnp.where(discriminant > 0.0, complex_roots, real_roots))


def least_lambda_exact(alpha: Values, f_plus: Values) -> Values:
    """Least lambda with rho < 1, by bisection on :func:`peak_ratio` (which falls with lambda)."""
    ratio = jnp.where(alpha > f_plus, alpha / jnp.where(f_plus > 0.0, f_plus, 1.0), 2.0)
    one = jnp.ones_like(ratio)

    def halve(bounds: tuple[Values, Values], _: None) -> tuple[tuple[Values, Values], None]:
        low, high = bounds
        middle = 0.5 * (low + high)
        converges = peak_ratio(middle, ratio, one) < 1.0
        return (jnp.where(converges, low, middle), jnp.where(converges, middle, high)), None

    # rho is zero, so below one, at lambda^2 = 4 c2
    upper = jnp.sqrt(8.0 * (ratio + 1.0))
    # each halving gives a bit
    length = jnp.finfo(ratio.dtype).nmant + 4
    (_, least), _ = jax.lax.scan(halve, (jnp.zeros_like(ratio), upper), length=length)
    return _above(alpha, f_plus, jnp.where(f_plus > 0.0, jnp.sqrt(f_plus) * least, 0.0))


def convergence_time_bound(
    lambda_: Values, alpha: Values, f_plus: Values, position_error: Values, velocity_error: Values
) -> Values:
    """Bound (42) on the convergence time in s, from the errors (rad, rad/s) at t = 0; `inf` where (32) does not hold.

    The peaks of (42) fall at least as (37) says, |x_{i+1}| <= r |x_i| with r = (1 - q) / (1 + q) at the largest q that (32)
    allows, so that the sum is |x_0| / (alpha - f) / (1 - r). A position error counts as the velocity that would reach
    it on the majorant (36).
    """
    r = least_lambda_davila_fridman(alpha, f_plus) / lambda_
    speed = jnp.abs(velocity_error) + lambda_ * jnp.sqrt(jnp.abs(position_error))
    peak = jnp.sqrt(speed**2 + 2.0 * jnp.abs(alpha - f_plus) * jnp.abs(position_error))
    holds = (alpha > f_plus) & (r < 1.0)
    safe = jnp.where(holds, (alpha - f_plus) * (1.0 - r), 1.0)
    return jnp.where(holds, peak / safe, jnp.inf)


LEAST_LAMBDA = {
    "davila_fridman": least_lambda_davila_fridman,
    "seeber_horn": least_lambda_seeber_horn,
    "exact": least_lambda_exact,
}
"""Conditions by the names that configs and metrics use."""
