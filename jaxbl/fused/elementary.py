"""Elementary functions from arithmetic alone, for a compiler of vectors that has no others.

They are accurate to a few units in the last place: within `LIMIT` of them against NumPy (tests). Minimax coefficients are
from S. L. Moshier's Cephes library, for tanh in float32 from XLA, and for the exponential function in float64 our own
(relative error 1.8e-17 of e^r - 1 for |r| <= ln 2 / 2).
"""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

Number = Float[Array, ""]

LIMIT = 4.0
"""Units in the last place that the tests allow."""


def _polynomial(x: Number, coefficients: Sequence[float]) -> Number:
    """Horner's rule, highest power first."""
    total = jnp.full_like(x, coefficients[0])
    for coefficient in coefficients[1:]:
        total = total * x + coefficient
    return total


def _is_double(x: Number) -> bool:
    return x.dtype == jnp.float64


def _power_of_two(n: Number) -> Number:
    """2^n for an integer n within the exponent's range."""
    integer, bias, bits = (jnp.int64, 1023, 52) if _is_double(n) else (jnp.int32, 127, 23)
    exponent = lax.shift_left(lax.convert_element_type(n, integer) + integer(bias), integer(bits))
    return lax.bitcast_convert_type(exponent, n.dtype)


def _expm1_and_power(x: Number) -> tuple[Number, Number]:
    """e^r - 1 and 2^n with x = r + n ln 2."""
    n = lax.round(x * 1.4426950408889634, lax.RoundingMethod.TO_NEAREST_EVEN)
    if _is_double(x):
        r = (x - n * 6.93145751953125e-1) - n * 1.42860682030941723212e-6
        series = (2.5053924629252286e-08, 2.7626042389919065e-07, 2.7557407082504333e-06, 2.480150526060296e-05,
                  0.00019841269719503187, 0.0013888888931578205, 0.008333333333389335, 0.0416666666665767,
                  0.1666666666666659, 0.5000000000000006)  # fmt: skip
    else:
        r = (x - n * 0.693359375) - n * -2.12194440e-4
        series = (1.9875691500e-4, 1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1)
    return _polynomial(r, series) * r * r + r, _power_of_two(n)


def _clamp_to_range(x: Number) -> tuple[Number, float, float]:
    """x clamped to the range in which e^x is a normal number, and that range."""
    low, high = (-708.0, 709.0) if _is_double(x) else (-87.0, 88.0)
    return lax.clamp(jnp.full_like(x, low), x, jnp.full_like(x, high)), low, high


def exp(x: Number) -> Number:
    """e^x; infinite above 88 (float32) or 709, zero below -87 or -708, a little before it has to be."""
    clamped, low, high = _clamp_to_range(x)
    expm1_r, power = _expm1_and_power(clamped)
    result = expm1_r * power + power
    result = lax.select(x > high, jnp.full_like(x, jnp.inf), lax.select(x < low, jnp.zeros_like(x), result))
    return lax.select(x != x, x, result)


def expm1(x: Number) -> Number:
    """e^x - 1."""
    clamped, _, high = _clamp_to_range(x)
    expm1_r, power = _expm1_and_power(clamped)
    result = lax.select(x > high, jnp.full_like(x, jnp.inf), expm1_r * power + (power - 1.0))
    return lax.select(x != x, x, result)


def tanh(x: Number) -> Number:
    """tanh x: float32 by one rational function, float64 from e^(2 |x|) - 1. A division takes as long as ten products."""
    if not _is_double(x):
        edge = jnp.full_like(x, 7.90531110763549805)
        a = lax.clamp(-edge, x, edge)
        z = a * a
        numerator = (-2.76076847742355e-16, 2.00018790482477e-13, -8.60467152213735e-11, 5.12229709037114e-08,
              1.48572235717979e-05, 6.37261928875436e-04, 4.89352455891786e-03)  # fmt: skip
        denominator = (1.19825839466702e-06, 1.18534705686654e-04, 2.26843463243900e-03, 4.89352518554385e-03)
        return a * _polynomial(z, numerator) / _polynomial(z, denominator)
    expm1_r, power = _expm1_and_power(2.0 * lax.min(lax.abs(x), jnp.full_like(x, 22.0)))
    expm1_2x = expm1_r * power + (power - 1.0)
    result = expm1_2x / (expm1_2x + 2.0)
    return lax.select(x != x, x, lax.select(x < 0.0, -result, result))


def _reduce_to_quadrant(x: Number) -> tuple[Number, Number]:
    """x minus the nearest n pi / 2, and n modulo 4; for |x| up to 1e4 (float32), 1e8 (float64)."""
    n = lax.round(x * 0.6366197723675814, lax.RoundingMethod.TO_NEAREST_EVEN)
    # pi / 2 in parts of few digits: their products with n are exact
    if _is_double(x):
        parts = (1.57079625129699707031, 7.54978941586159635335e-8, 5.39030252995776476554e-15)
    else:
        parts = (1.5703125, 4.837512969970703125e-4, 7.54978995489188216e-8)
    for part in parts:
        x = x - n * part
    return x, n - 4.0 * lax.floor(n * 0.25)


def _sine_of_remainder(x: Number) -> Number:
    """sin x for |x| <= pi / 4."""
    z = x * x
    if _is_double(x):
        series = (1.58962301576546568060e-10, -2.50507477628578072866e-8, 2.75573136213857245213e-6,
                  -1.98412698295895385996e-4, 8.33333333332211858878e-3, -1.66666666666666307295e-1)  # fmt: skip
    else:
        series = (-1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1)
    return x + x * z * _polynomial(z, series)


def _cosine_of_remainder(x: Number) -> Number:
    """cos x for |x| <= pi / 4."""
    z = x * x
    if _is_double(x):
        series = (-1.13585365213876817300e-11, 2.08757008419747316778e-9, -2.75573141792967388112e-7,
                  2.48015872888517045348e-5, -1.38888888888730564116e-3, 4.16666666666665929218e-2)  # fmt: skip
    else:
        series = (2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2)
    return 1.0 - 0.5 * z + z * z * _polynomial(z, series)


def _sine_after_quarters(x: Number, quarters: float) -> Number:
    """sin(x + quarters pi / 2)."""
    r, n = _reduce_to_quadrant(x)
    n = n + quarters
    n = lax.select(n > 3.5, n - 4.0, n)
    is_cosine = (n == 1.0) | (n == 3.0)
    result = lax.select(is_cosine, _cosine_of_remainder(r), _sine_of_remainder(r))
    return lax.select(n > 1.5, -result, result)


def sin(x: Number) -> Number:
    """sin x."""
    return _sine_after_quarters(x, 0.0)


def cos(x: Number) -> Number:
    """cos x."""
    return _sine_after_quarters(x, 1.0)


def logistic(x: Number) -> Number:
    """1 / (1 + e^-x)."""
    return 1.0 / (1.0 + exp(-x))


def round_half_even(x: Number) -> Number:
    """The nearest integer; of two that are equally near, the even."""
    below = lax.floor(x)
    is_odd = below - 2.0 * lax.floor(0.5 * below)
    # every difference is exact; adding and subtracting a large number is not safe from compilers
    remainder = x - below
    return below + lax.select(remainder == 0.5, is_odd, lax.convert_element_type(remainder > 0.5, x.dtype))


FUNCTIONS: dict[str, Callable[[Number], Number]] = {
    function.__name__: function for function in (exp, expm1, tanh, sin, cos, logistic)
}
"""The functions by the names of the primitives that they replace."""
