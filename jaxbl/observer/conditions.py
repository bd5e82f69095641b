"""Gain conditions of the super-twisting observer, for the error system (34) with the bound f_plus.

    x1' = x2 - lambda sqrt|x1| sign x1,   x2' = d - alpha sign x1,   with any d(t) in [-f_plus, f_plus]

All functions are elementwise over JAX arrays that broadcast, and differentiable inside their domain: lambda >= 0, finite
alpha, f_plus >= 0. `least_lambda_*` return the smallest lambda (rad^0.5/s) that a condition allows at alpha and f_plus
(rad/s^2). It is `inf` if no lambda is allowed (alpha <= f_plus), and `nan` only if an argument is. By homogeneity it is
sqrt(f_plus) times a function of alpha / f_plus.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbl.errors import InputError
from jaxbl.files import to_jsonable

Values = Float[Array, "..."]


def _infinite_unless_above(alpha: Values, f_plus: Values, least: Values) -> Values:
    return jnp.where(alpha > f_plus, least, jnp.where(alpha <= f_plus, jnp.inf, jnp.nan))


def _safe_excess(alpha: Values, f_plus: Values) -> Values:
    """alpha - f_plus if that is positive, else 1, so that it may be a divisor."""
    return jnp.where(alpha > f_plus, alpha - f_plus, 1.0)


def least_lambda_davila_fridman(alpha: Values, f_plus: Values, q: float = 0.0) -> Values:
    """Condition (32): lambda > sqrt(2 / (alpha - f)) (alpha + f) (1 + q) / (1 - q) with 0 < q < 1; q = 0 is the limit.

    Reference: J. Davila, L. Fridman, A. Levant, IEEE Trans. Autom. Control 50 (2005).

    Raises:
        InputError: q outside [0, 1).
    """
    if not 0.0 <= q < 1.0:
        raise InputError(f"q: condition (32) needs 0 < q < 1 (or 0 for the limit), not {q}")
    return _infinite_unless_above(
        alpha, f_plus, jnp.sqrt(2.0 / _safe_excess(alpha, f_plus)) * (alpha + f_plus) * (1.0 + q) / (1.0 - q)
    )


def least_lambda_levant(alpha: Values, f_plus: Values) -> Values:
    """Levant's condition: lambda^2 > 4 f (alpha + f) / (alpha - f). Reference: A. Levant, Automatica 34 (1998)."""
    return _infinite_unless_above(alpha, f_plus, 2.0 * jnp.sqrt(f_plus * (alpha + f_plus) / _safe_excess(alpha, f_plus)))


def least_lambda_seeber_horn(alpha: Values, f_plus: Values) -> Values:
    """Condition of Seeber and Horn: lambda > sqrt(alpha + f). Reference: R. Seeber, M. Horn, Automatica 84 (2017)."""
    return _infinite_unless_above(alpha, f_plus, jnp.sqrt(alpha + f_plus))


def least_lambda_moreno_osorio(alpha: Values, f_plus: Values) -> Values:
    """Best condition of a quadratic strict Lyapunov function: lambda^2 > 4 (alpha - sqrt(alpha^2 - f^2)).

    Moreno and Osorio take V = zeta' P zeta with zeta = (sqrt|x1| sign x1, x2), for which
    zeta' = (A zeta + B w) / (2 sqrt|x1|) with A = [[-lambda, 1], [-2 alpha, 0]], B = (0, 2)' and |w| <= f |zeta_1|.
    A matrix P that makes V fall for all such w solves their linear matrix inequality. By the bounded real lemma it exists
    if and only if |2 / (s^2 + lambda s + 2 alpha)| f < 1 on the imaginary axis (circle criterion). The peak of this gain is
    1 / alpha if lambda^2 >= 4 alpha, else 2 / (lambda sqrt(2 alpha - lambda^2 / 4)), from which the form above follows.

    Reference: J. A. Moreno, M. Osorio, Strict Lyapunov functions for the super-twisting algorithm, IEEE Trans. Autom.
    Control 57 (2012), for V and the inequality. The closed form is derived in docs/theory_appendix.md.
    """
    ratio = jnp.where(alpha > f_plus, f_plus / jnp.where(alpha > f_plus, alpha, 1.0), 0.0)
    # alpha - sqrt(alpha^2 - f^2) without cancellation
    return _infinite_unless_above(
        alpha, f_plus, 2.0 * jnp.sqrt(f_plus * ratio / (1.0 + jnp.sqrt((1.0 - ratio) * (1.0 + ratio))))
    )


def arc_integral(h: Values, y: Values, discriminant: Values) -> Values:
    """Integral of 1 / (q^2 + lambda q + c) over q from v / y to infinity.

    `inf` if a real root of the quadratic lies on the way. Complex, real, and nearly double roots have their own forms.

    Args:
        h: v + lambda y / 2.
        y: positive.
        discriminant: c - lambda^2 / 4; the roots are complex where it is positive.
    """
    near = (jnp.abs(discriminant) * y**2 < 1e-6 * h**2) & (h > 0.0)
    size = jnp.sqrt(jnp.where(near | (discriminant == 0.0), 1.0, jnp.abs(discriminant)))
    for_complex_roots = jnp.arctan2(jnp.where(near, 0.0, size * y), jnp.where(near, 1.0, h)) / size
    clear = h > size * y
    real = ~near & (discriminant < 0.0)
    for_real_roots = jnp.arctanh(jnp.where(real & clear, size * y / jnp.where(real & clear, h, 1.0), 0.0)) / size
    # atan(x) / x and atanh(x) / x are 1 -+ x^2 / 3 about zero
    slope = y / jnp.where(near, h, 1.0)
    for_double_root = slope * (1.0 - discriminant * slope**2 / 3.0)
    blocked = ~near & (discriminant <= 0.0) & ~clear
    integral = jnp.where(real, for_real_roots, jnp.where(blocked, jnp.inf, for_complex_roots))
    return jnp.where(near, for_double_root, integral) + jnp.where(blocked, jnp.inf, 0.0)


@jax.jit
def peak_ratio(lambda_: Values, alpha: Values, f_plus: Values) -> Values:
    """Worst ratio rho of successive velocity peaks, in closed form. The error converges in finite time if and only if
    rho < 1.

    With y = sqrt(x1) the outermost trajectory of (34) is a homogeneous first-order equation in each quadrant:
    rho = sqrt(c2 / c1) exp(-(lambda / 2) (I1 + I2)) with c1 = 2 (alpha - f), c2 = 2 (alpha + f) and, from 0 to infinity,
    I1 = int dp / (p^2 + lambda p + c1), I2 = int dp / (p^2 - lambda p + c2).
    rho is 0 if lambda^2 >= 4 c2, and `inf` if alpha <= f.
    Source: derived for this project (docs/theory_appendix.md), checked against simulation.
    """
    log_ratio = _log_peak_ratio(lambda_, alpha, f_plus)
    overdamped = lambda_**2 >= 8.0 * (alpha + f_plus)
    return _infinite_unless_above(alpha, f_plus, jnp.exp(jnp.where(overdamped, -jnp.inf, log_ratio)))


def _log_peak_ratio(lambda_: Values, alpha: Values, f_plus: Values) -> Values:
    """Logarithm of rho if alpha > f and lambda^2 < 4 c2, else some finite number."""
    c1, c2 = 2.0 * _safe_excess(alpha, f_plus), 2.0 * (alpha + f_plus)
    half, unit = 0.5 * lambda_, jnp.ones_like(0.5 * lambda_)
    below = jnp.where(c2 > half**2, c2 - half**2, 1.0)
    # log(c2 / c1) without cancellation where alpha is far above f_plus
    gain = 0.5 * jnp.log1p(2.0 * f_plus / _safe_excess(alpha, f_plus))
    return gain - half * (arc_integral(half, unit, c1 - half**2) + arc_integral(-half, unit, below))


def bisect(holds: Callable[[Values], Values], high: Values, halvings: int) -> tuple[Values, Values]:
    """Bracket the least number between 0 and `high` from which on `holds` is True, by `halvings` bisections.

    Returns:
        The lower and the upper end of the bracket; at the upper one `holds` is True.
    """

    def halve(bounds: tuple[Values, Values], _: None) -> tuple[tuple[Values, Values], None]:
        low, high = bounds
        middle = 0.5 * (low + high)
        at_middle = holds(middle)
        return (jnp.where(at_middle, low, middle), jnp.where(at_middle, middle, high)), None

    return jax.lax.scan(halve, (jnp.zeros_like(high), high), length=halvings)[0]


_HALVINGS, _NEWTON_STEPS = 12, 2
"""Bisections until Newton's method converges, and Newton steps until rounding; one more step carries the derivatives."""


@jax.jit
def least_lambda_exact(alpha: Values, f_plus: Values) -> Values:
    """Exact condition, rho < 1: the least lambda; zero if f_plus is.

    It is found by bisection on :func:`peak_ratio`, which falls with lambda, then Newton's method.
    """
    # if alpha / f_plus would overflow, lambda is zero to rounding
    least_bound = jnp.finfo(jnp.result_type(alpha, f_plus, float)).tiny * alpha
    regular = (alpha > f_plus) & (f_plus > least_bound)
    ratio = jnp.where(regular, alpha, 2.0) / jnp.where(regular, f_plus, 1.0)
    unit = jnp.ones_like(ratio)
    fixed = jax.lax.stop_gradient(ratio)
    # at lambda^2 = 4 c2 rho is zero, and thus below 1
    low, high = bisect(lambda lambda_: peak_ratio(lambda_, fixed, unit) < 1.0, jnp.sqrt(8.0 * (fixed + 1.0)), _HALVINGS)

    def newton_step(least: Values, ratio: Values) -> Values:
        log_ratio, slope = jax.jvp(lambda lambda_: _log_peak_ratio(lambda_, ratio, unit), (least,), (unit,))
        return least - log_ratio / jax.lax.stop_gradient(slope)

    least = jax.lax.stop_gradient(0.5 * (low + high))
    for _ in range(_NEWTON_STEPS):
        least = jax.lax.stop_gradient(jnp.clip(newton_step(least, fixed), low, high))
    least = newton_step(least, ratio)
    # the derivative of the square root is infinite at zero
    bound = jnp.where(regular, f_plus, 1.0)
    return _infinite_unless_above(alpha, f_plus, jnp.where(regular, jnp.sqrt(bound) * least, 0.0))


def convergence_time_bound(
    lambda_: Values, alpha: Values, f_plus: Values, position_error: Values, velocity_error: Values
) -> Values:
    """Bound (42) on the convergence time, s; `inf` if (32) does not hold.

    By (37) the peaks in (42) fall at least as |x_{i+1}| <= r |x_i|, with r = (1 - q) / (1 + q) at the largest q that (32)
    allows. The sum is then |x_0| / (alpha - f) / (1 - r). A position error counts as the velocity that would reach it on
    the majorant (36).

    Args:
        lambda_, alpha: gains, rad^0.5/s and rad/s^2.
        f_plus: bound of the disturbance, rad/s^2.
        position_error, velocity_error: at t = 0, rad and rad/s.
    """
    r = least_lambda_davila_fridman(alpha, f_plus) / lambda_
    speed = jnp.abs(velocity_error) + lambda_ * jnp.sqrt(jnp.abs(position_error))
    peak = jnp.sqrt(speed**2 + 2.0 * jnp.abs(alpha - f_plus) * jnp.abs(position_error))
    holds = (alpha > f_plus) & (lambda_ > 0.0) & (r < 1.0)
    safe = jnp.where(holds, (alpha - f_plus) * (1.0 - r), 1.0)
    return jnp.where(holds, peak / safe, jnp.inf)


def _half_cycle(lambda_: Values, alpha: Values, f_plus: Values, y: Values, x2: Values, ray: Values) -> tuple[Values, Values]:
    """Time from x1 = y^2 >= 0 to the axis x1 = 0, and the speed |x2| there (0 if the half cycle ends at the origin).

    The disturbance is d = +f until x1' = ray sqrt(x1), and d = -f from there on; ray <= 0 and alpha > f. With v = x1' / y,
    along an arc of constant d, sqrt(v^2 + lambda v y + c y^2) falls by exp(-(lambda / 2) arc), and x2 linearly in time.
    """
    c1, c2 = 2.0 * _safe_excess(alpha, f_plus), 2.0 * (alpha + f_plus)
    half = 0.5 * lambda_
    v = x2 - lambda_ * y
    before = v > ray * y
    # the arc with d = +f, to the ray; along the root's ray it leads to the origin
    eps = jnp.finfo(jnp.result_type(half)).eps
    ends = before & _is_root_ray(lambda_, c1, ray, 64.0)
    turns = before & ~ends
    start, end = (jnp.where(turns, x, 1.0) for x in (v + half * y, ray + half))
    start_y, unit, d1 = jnp.where(turns, y, 0.0), jnp.ones_like(end), jnp.where(turns, c1 - half**2, 1.0)
    # q^2 + lambda q + c = (q + lambda / 2)^2 + c - lambda^2 / 4
    norms = jnp.sqrt((start**2 + d1 * start_y**2) / jnp.maximum(end**2 + d1, eps * end**2))
    y_ray = norms * jnp.exp(-half * (arc_integral(end, unit, d1) - arc_integral(start, start_y, d1)))
    y_turn = jnp.where(turns, y_ray, jnp.where(ends, 0.0, y))
    x2_turn = jnp.where(turns, (ray + lambda_) * y_ray, jnp.where(ends, 0.0, x2))
    # the arc with d = -f, to the axis
    away, d2 = y_turn > 0.0, c2 - half**2
    h = jnp.where(away, half * y_turn - x2_turn, 1.0)
    arc = arc_integral(h, jnp.where(away, y_turn, 0.0), d2)
    crosses = away & jnp.isfinite(arc)
    level = jnp.where(crosses, h**2 + d2 * y_turn**2, 1.0)
    speed = jnp.where(crosses, jnp.sqrt(level) * jnp.exp(-half * jnp.where(crosses, arc, 0.0)), 0.0)
    time = (x2 - x2_turn) / _safe_excess(alpha, f_plus) + (x2_turn + speed) / (alpha + f_plus)
    return time, speed


def _lowest_ray(lambda_: Values, c1: Values) -> Values:
    """The ray along which d = +f leads to the origin: a root of p^2 + lambda p + c1; -inf if the roots are complex."""
    half = 0.5 * lambda_
    real = half**2 >= c1
    return jnp.where(real, -c1 / (half + jnp.sqrt(jnp.where(real, half**2 - c1, 0.0))), -jnp.inf)


def _is_root_ray(lambda_: Values, c1: Values, ray: Values, eps: float) -> Values:
    """True if a ray is the root's ray or below it, to `eps` roundings of the squares whose difference is
    p^2 + lambda p + c1."""
    half = 0.5 * lambda_
    square, least = (ray + half) ** 2, half**2 - c1
    near = square - least <= eps * float(jnp.finfo(jnp.result_type(half)).eps) * square
    return (least >= 0.0) & ((ray <= _lowest_ray(lambda_, c1)) | near)


_GRID_RAYS, _GRID_ROUNDS = 17, 5
"""Rays of a grid, and number of grids. The last grid's step is 1 / 65 536 of the range of rays; the time is stationary at
the slowest ray."""


@jax.jit
def slowest_ray(lambda_: Values, alpha: Values, f_plus: Values) -> Values:
    """The ray p <= 0 (rad^0.5/s) at which the slowest disturbance switches; zero if rho >= 1.

    For x1 > 0 this disturbance is d = +f while x1' > p sqrt(x1), and d = -f afterwards. The disturbance with the largest
    peaks switches at x1' = 0; the one with the longest convergence switches a little later. By Pontryagin's principle it
    switches once in a half cycle: its costates obey l1' = l1 lambda / (2 sqrt x1), l2' = -l1, so that l1 keeps its sign and
    l2 changes sign at most once. By homogeneity it switches on a ray. The ray with the largest time to the origin is found
    by a search on grids, each eight times finer than the one before.
    """
    lambda_, alpha, f_plus = jnp.broadcast_arrays(*(x + 0.0 for x in (lambda_, alpha, f_plus)))
    dtype = lambda_.dtype
    c1 = 2.0 * _safe_excess(alpha, f_plus)
    lowest = _lowest_ray(lambda_, c1)
    real = jnp.isfinite(lowest)
    root = jnp.where(real, lowest, -1.0)
    # near the root's ray, x1 falls as a power of the distance from it: this pace makes even steps of the remaining x1
    pace = jnp.maximum((2.0 * root + lambda_) / -root, 1.0)

    def ray(share: Values) -> Values:
        open_ = jnp.minimum(share, 1.0 - 1e-6)
        depth = open_ / (1.0 - open_)
        near = jnp.where(share < 1.0, root * -jnp.expm1(-pace * depth), root)
        return jnp.where(real, near, -jnp.sqrt(c1) * depth)

    def time(share: Values) -> Values:
        duration, speed = _half_cycle(lambda_, alpha, f_plus, jnp.zeros_like(lambda_), jnp.ones_like(lambda_), ray(share))
        return duration / jnp.maximum(1.0 - speed, jnp.finfo(dtype).tiny)

    grid = jnp.linspace(0.0, 1.0, _GRID_RAYS, dtype=dtype)

    def zoom(bounds: tuple[Values, Values], _: None) -> tuple[tuple[Values, Values], Values]:
        low, high = bounds
        shares, times = jax.vmap(lambda x: ((share := low + (high - low) * x), time(share)))(grid)
        slowest = jnp.argmax(times, axis=0, keepdims=True)
        share = jnp.take_along_axis(shares, slowest, axis=0)[0]
        step = (high - low) / (_GRID_RAYS - 1)
        return (jnp.maximum(share - step, 0.0), jnp.minimum(share + step, 1.0)), share

    ends = jnp.zeros_like(lambda_), jnp.ones_like(lambda_)
    _, slowest_shares = jax.lax.scan(zoom, ends, length=_GRID_ROUNDS)
    # rounding must not decide between the root's ray and a ray close to it, nor between an x1 below exp(-9) and zero
    share = slowest_shares[-1]
    slowest = ray(share)
    slowest = jnp.where(real & ((share > 0.9) | _is_root_ray(lambda_, c1, slowest, 1e3)), root, slowest)
    return jnp.where(peak_ratio(lambda_, alpha, f_plus) < 1.0, slowest, 0.0)


def convergence_time_worst(
    lambda_: Values, alpha: Values, f_plus: Values, position_error: Values, velocity_error: Values
) -> Values:
    """Longest convergence time (s) that a disturbance within f_plus can cause, exactly; `inf` if rho >= 1.

    The durations of half cycles under the slowest disturbance (:func:`slowest_ray`) are proportional to the peak speed |x2|
    at their start. The peaks fall by a constant ratio, so that the sum is geometric. Within a half cycle x2 changes at the
    constant rates alpha -+ f.

    Args:
        lambda_, alpha: gains, rad^0.5/s and rad/s^2.
        f_plus: bound of the disturbance, rad/s^2.
        position_error, velocity_error: x1 and x2 at t = 0, rad and rad/s.

    Source: derived for this project (docs/theory_appendix.md), checked against simulation.
    """
    zero = jnp.zeros_like(jnp.asarray(lambda_ * alpha * f_plus * 1.0))
    ray = jax.lax.stop_gradient(slowest_ray(lambda_, alpha, f_plus))  # the time is stationary in it
    time, speed = _half_cycle(lambda_, alpha, f_plus, zero, zero + 1.0, ray)
    converges = peak_ratio(lambda_, alpha, f_plus) < 1.0
    # from a peak of 1 rad/s to the origin
    time_from_peak = time / jnp.where(converges & (speed < 1.0), 1.0 - speed, 1.0)
    # the half planes mirror each other
    x2 = jnp.where(position_error == 0.0, jnp.abs(velocity_error), jnp.sign(position_error) * velocity_error)
    away = position_error != 0.0
    y = jnp.where(away, jnp.sqrt(jnp.where(away, jnp.abs(position_error), 1.0)), 0.0)
    first, speed = _half_cycle(lambda_, alpha, f_plus, y + zero, x2 + zero, ray)
    # from a start beyond the faster root's ray, x2 = (p + lambda) sqrt(x1), d = +f leads to this ray and along it to the
    # origin; p + lambda is minus the slower root
    slides = x2 + zero > -_lowest_ray(lambda_, 2.0 * _safe_excess(alpha, f_plus)) * y
    longest = jnp.maximum(first + speed * time_from_peak, jnp.where(slides, x2 / _safe_excess(alpha, f_plus), 0.0))
    return jnp.where(converges, jnp.where((x2 != 0.0) | away, longest, 0.0), jnp.inf)


class Condition(NamedTuple):
    """A gain condition: its name in prose, and its least lambda (rad^0.5/s) as a function of alpha and f_plus (rad/s^2)."""

    title: str
    least_lambda: Callable[[Values, Values], Values]


CONDITIONS = {
    "davila_fridman": Condition("Davila-Fridman (32), q → 0", least_lambda_davila_fridman),
    "levant": Condition("Levant 1998", least_lambda_levant),
    "seeber_horn": Condition("Seeber-Horn 2017", least_lambda_seeber_horn),
    "moreno_osorio": Condition("Lyapunov, Moreno-Osorio 2012", least_lambda_moreno_osorio),
    "exact": Condition("exact, ρ < 1", least_lambda_exact),
}
"""Conditions by the names that configs and metrics use."""


@jax.jit
def largest_f_plus_exact(lambda_: Values, alpha: Values) -> Values:
    """Largest f_plus (rad/s^2) for which the gains satisfy rho < 1. It is at most alpha, and zero if lambda is."""
    low, _ = bisect(lambda f_plus: ~(peak_ratio(lambda_, alpha, f_plus) < 1.0), alpha * jnp.ones_like(lambda_), 52)
    return low


@jax.jit
def _evaluate_conditions(lambda_: Values, alpha: Values, f_plus: Values) -> tuple[dict[str, Values], Values, Values]:
    least = {name: condition.least_lambda(alpha, f_plus) for name, condition in CONDITIONS.items()}
    return least, peak_ratio(lambda_, alpha, f_plus), largest_f_plus_exact(lambda_, alpha)


def judge_gains(lambda_: float, alpha: float, f_plus: float) -> dict[str, Any]:
    """Compare an observer's gains with all conditions at a bound f_plus.

    Args:
        lambda_, alpha: gains, rad^0.5/s and rad/s^2.
        f_plus: bound of the disturbance, rad/s^2.

    Returns:
        A dict for JSON: `least_lambda` (rad^0.5/s; None if no lambda is allowed) and `holds` by condition, `peak_ratio`,
        `largest_f_plus` (rad/s^2; :func:`largest_f_plus_exact`), `alpha_exceeds_f_plus`, and the arguments.

    Example:
        >>> judge_gains(1.5, 1.1, 1.0)["holds"]["exact"]
        True
    """
    with jax.enable_x64(True):
        least, rho, largest = to_jsonable(_evaluate_conditions(*(jnp.asarray(float(x)) for x in (lambda_, alpha, f_plus))))
    # a jitted function sorts the names
    least = {name: least[name] for name in CONDITIONS}
    return {
        "lambda": float(lambda_),
        "alpha": float(alpha),
        "f_plus": f_plus,
        "alpha_exceeds_f_plus": float(alpha) > f_plus,
        "least_lambda": least,
        "holds": {name: limit is not None and float(lambda_) > limit for name, limit in least.items()},
        "peak_ratio": rho,
        "largest_f_plus": largest,
    }
