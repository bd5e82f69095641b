"""Gain conditions of the super-twisting observer, for the error system (34) with bound f_plus.

The error system is x1' = x2 - lambda sqrt|x1| sign x1, x2' = d - alpha sign x1 with any d(t) in [-f_plus, f_plus].
All functions are elementwise over JAX arrays that broadcast, and differentiable away from their limits. Their domain is
lambda >= 0, finite alpha and f_plus >= 0. `least_lambda_*` return the smallest lambda (rad^0.5/s) that a condition allows
for given alpha and f_plus (rad/s^2); where no lambda does (alpha <= f_plus) that is `inf`, and `nan` only where an argument
is. By homogeneity all of them are sqrt(f_plus) times a function of alpha / f_plus.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbl.errors import InputError
from jaxbl.files import to_jsonable

Values = Float[Array, "..."]


def _infinite_unless_above(alpha: Values, f_plus: Values, value: Values) -> Values:
    return jnp.where(alpha > f_plus, value, jnp.where(alpha <= f_plus, jnp.inf, jnp.nan))


def _safe_excess(alpha: Values, f_plus: Values) -> Values:
    """alpha - f_plus where that is positive, else one: what stands below a fraction."""
    return jnp.where(alpha > f_plus, alpha - f_plus, 1.0)


def least_lambda_davila_fridman(alpha: Values, f_plus: Values, q: float = 0.0) -> Values:
    """Condition (32): lambda > sqrt(2 / (alpha - f)) (alpha + f) (1 + q) / (1 - q), 0 < q < 1; q = 0 stands for the limit.

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
    """lambda^2 > 4 f (alpha + f) / (alpha - f). Reference: A. Levant, Automatica 34 (1998)."""
    return _infinite_unless_above(alpha, f_plus, 2.0 * jnp.sqrt(f_plus * (alpha + f_plus) / _safe_excess(alpha, f_plus)))


def least_lambda_seeber_horn(alpha: Values, f_plus: Values) -> Values:
    """lambda > sqrt(alpha + f). Reference: R. Seeber, M. Horn, Automatica 84 (2017)."""
    return _infinite_unless_above(alpha, f_plus, jnp.sqrt(alpha + f_plus))


def least_lambda_moreno_osorio(alpha: Values, f_plus: Values) -> Values:
    """lambda^2 > 4 (alpha - sqrt(alpha^2 - f^2)): all that a quadratic strict Lyapunov function can show.

    Moreno and Osorio take V = zeta' P zeta with zeta = (sqrt|x1| sign x1, x2), for which
    zeta' = (A zeta + B w) / (2 sqrt|x1|) with A = [[-lambda, 1], [-2 alpha, 0]], B = (0, 2)' and |w| <= f |zeta_1|.
    A matrix P that makes V fall for all such w solves their linear matrix inequality; by the bounded real lemma there is one
    exactly if |2 / (s^2 + lambda s + 2 alpha)| f < 1 on the imaginary axis (circle criterion). The peak of that is 1 / alpha
    if lambda^2 >= 4 alpha, else 2 / (lambda sqrt(2 alpha - lambda^2 / 4)): hence the form above.

    Reference: J. A. Moreno, M. Osorio, Strict Lyapunov functions for the super-twisting algorithm, IEEE Trans. Autom.
    Control 57 (2012), for V and the inequality; its elimination is ours (docs/theory.md).
    """
    ratio = jnp.where(alpha > f_plus, f_plus / jnp.where(alpha > f_plus, alpha, 1.0), 0.0)
    # alpha - sqrt(alpha^2 - f^2) without cancellation
    return _infinite_unless_above(
        alpha, f_plus, 2.0 * jnp.sqrt(f_plus * ratio / (1.0 + jnp.sqrt((1.0 - ratio) * (1.0 + ratio))))
    )


def arc_integral(h: Values, y: Values, discriminant: Values) -> Values:
    """int dq / (q^2 + lambda q + c) from p = v / y to infinity, with h = v + lambda y / 2 and discriminant c - lambda^2 / 4.

    `inf` where a real root lies on the way. Complex, real, and nearly double roots.
    """
    near = (jnp.abs(discriminant) * y**2 < 1e-6 * h**2) & (h > 0.0)
    size = jnp.sqrt(jnp.where(near | (discriminant == 0.0), 1.0, jnp.abs(discriminant)))
    complex_roots = jnp.arctan2(jnp.where(near, 0.0, size * y), jnp.where(near, 1.0, h)) / size
    passes = h > size * y
    real = ~near & (discriminant < 0.0)
    real_roots = jnp.arctanh(jnp.where(real & passes, size * y / jnp.where(real & passes, h, 1.0), 0.0)) / size
    # atan(x) / x and atanh(x) / x are 1 -+ x^2 / 3 about zero
    slope = y / jnp.where(near, h, 1.0)
    double = slope * (1.0 - discriminant * slope**2 / 3.0)
    blocked = ~near & (discriminant <= 0.0) & ~passes
    return jnp.where(near, double, jnp.where(real, real_roots, jnp.where(blocked, jnp.inf, complex_roots))) + jnp.where(
        blocked, jnp.inf, 0.0
    )


@jax.jit
def peak_ratio(lambda_: Values, alpha: Values, f_plus: Values) -> Values:
    """Worst-case ratio rho of successive velocity peaks, in closed form; the error converges in finite time iff rho < 1.

    With y = sqrt(x) the outermost trajectory of (34) is a homogeneous first-order equation in each quadrant:
    rho = sqrt(c2 / c1) exp(-(lambda / 2) (I1 + I2)) with c1 = 2 (alpha - f), c2 = 2 (alpha + f) and, from 0 to infinity,
    I1 = int dp / (p^2 + lambda p + c1), I2 = int dp / (p^2 - lambda p + c2).
    rho is 0 where lambda^2 >= 4 c2, and `inf` where alpha <= f.
    Source: derived for this project (docs/theory.md), checked against simulation.
    """
    log = _log_peak_ratio(lambda_, alpha, f_plus)
    direct = lambda_**2 >= 8.0 * (alpha + f_plus)
    return _infinite_unless_above(alpha, f_plus, jnp.where(direct, 0.0, jnp.exp(jnp.where(direct, 0.0, log))))


def _log_peak_ratio(lambda_: Values, alpha: Values, f_plus: Values) -> Values:
    """log rho where alpha > f and lambda^2 < 4 c2; any finite number elsewhere."""
    c1, c2 = 2.0 * _safe_excess(alpha, f_plus), 2.0 * (alpha + f_plus)
    half, one = 0.5 * lambda_, jnp.ones_like(0.5 * lambda_)
    below = jnp.where(c2 > half**2, c2 - half**2, 1.0)
    # log(c2 / c1) without cancellation where alpha is far above f_plus
    gain = 0.5 * jnp.log1p(2.0 * f_plus / _safe_excess(alpha, f_plus))
    return gain - half * (arc_integral(half, one, c1 - half**2) + arc_integral(-half, one, below))


def bisect(holds: Callable[[Values], Values], high: Values, halvings: int) -> tuple[Values, Values]:
    """Bounds of the least number between 0 and `high` from which on something holds, after so many halvings."""

    def halve(bounds: tuple[Values, Values], _: None) -> tuple[tuple[Values, Values], None]:
        low, high = bounds
        middle = 0.5 * (low + high)
        good = holds(middle)
        return (jnp.where(good, low, middle), jnp.where(good, middle, high)), None

    return jax.lax.scan(halve, (jnp.zeros_like(high), high), length=halvings)[0]


_HALVINGS, _NEWTON_STEPS = 12, 2
"""Bisection until Newton's method converges, and its steps up to rounding; a last one carries the derivatives."""


@jax.jit
def least_lambda_exact(alpha: Values, f_plus: Values) -> Values:
    """Least lambda with rho < 1; zero where f_plus is.

    By bisection on :func:`peak_ratio`, which falls with lambda, then Newton's method; its last step carries the derivatives.
    """
    # where alpha / f_plus would overflow, the root is nothing
    least_bound = jnp.finfo(jnp.result_type(alpha, f_plus, float)).tiny * alpha
    known = (alpha > f_plus) & (f_plus > least_bound)
    ratio = jnp.where(known, alpha, 2.0) / jnp.where(known, f_plus, 1.0)
    one = jnp.ones_like(ratio)
    fixed = jax.lax.stop_gradient(ratio)
    # rho is zero, so below one, at lambda^2 = 4 c2
    low, high = bisect(lambda one_lambda: peak_ratio(one_lambda, fixed, one) < 1.0, jnp.sqrt(8.0 * (fixed + 1.0)), _HALVINGS)

    def newton(least: Values, ratio: Values) -> Values:
        value, slope = jax.jvp(lambda x: _log_peak_ratio(x, ratio, one), (least,), (one,))
        return least - value / jax.lax.stop_gradient(slope)

    least = jax.lax.stop_gradient(0.5 * (low + high))
    for _ in range(_NEWTON_STEPS):
        least = jax.lax.stop_gradient(jnp.clip(newton(least, fixed), low, high))
    least = newton(least, ratio)
    # the root's derivative is infinite at zero
    bound = jnp.where(known, f_plus, 1.0)
    return _infinite_unless_above(alpha, f_plus, jnp.where(known, jnp.sqrt(bound) * least, 0.0))


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
    holds = (alpha > f_plus) & (lambda_ > 0.0) & (r < 1.0)
    safe = jnp.where(holds, (alpha - f_plus) * (1.0 - r), 1.0)
    return jnp.where(holds, peak / safe, jnp.inf)


def _half_cycle(lambda_: Values, alpha: Values, f_plus: Values, y: Values, x2: Values, ray: Values) -> tuple[Values, Values]:
    """Time from x1 = y^2 to the axis x = 0, and speed |x2| there (0 where it ends at the origin); ray <= 0, alpha > f.

    d = +f until x1' = ray sqrt(x1), and d = -f from there on. Along an arc of constant d, sqrt(v^2 + lambda v y + c y^2)
    falls by exp(-(lambda / 2) arc), and x2 linearly in time.
    """
    c1, c2 = 2.0 * _safe_excess(alpha, f_plus), 2.0 * (alpha + f_plus)
    half = 0.5 * lambda_
    v = x2 - lambda_ * y
    before = v > ray * y
    # out to the ray, if the point lies before it; at the root's ray, d = +f holds on to the origin
    eps = jnp.finfo(jnp.result_type(half)).eps
    ends = before & _is_root_ray(lambda_, c1, ray, 64.0)
    turns = before & ~ends
    start, end = (jnp.where(turns, x, 1.0) for x in (v + half * y, ray + half))
    start_y, one, d1 = jnp.where(turns, y, 0.0), jnp.ones_like(end), jnp.where(turns, c1 - half**2, 1.0)
    # q^2 + lambda q + c = (q + lambda / 2)^2 + c - lambda^2 / 4
    norms = jnp.sqrt((start**2 + d1 * start_y**2) / jnp.maximum(end**2 + d1, eps * end**2))
    y_ray = norms * jnp.exp(-half * (arc_integral(end, one, d1) - arc_integral(start, start_y, d1)))
    y_turn = jnp.where(turns, y_ray, jnp.where(ends, 0.0, y))
    x2_turn = jnp.where(turns, (ray + lambda_) * y_ray, jnp.where(ends, 0.0, x2))
    # home
    away, d2 = y_turn > 0.0, c2 - half**2
    h = jnp.where(away, half * y_turn - x2_turn, 1.0)
    arc = arc_integral(h, jnp.where(away, y_turn, 0.0), d2)
    homes = away & jnp.isfinite(arc)
    level = jnp.where(homes, h**2 + d2 * y_turn**2, 1.0)
    speed = jnp.where(homes, jnp.sqrt(level) * jnp.exp(-half * jnp.where(homes, arc, 0.0)), 0.0)
    time = (x2 - x2_turn) / _safe_excess(alpha, f_plus) + (x2_turn + speed) / (alpha + f_plus)
    return time, speed


def _lowest_ray(lambda_: Values, c1: Values) -> Values:
    """The ray along which d = +f leads to the origin: a root of p^2 + lambda p + c1; -inf where it is complex."""
    half = 0.5 * lambda_
    real = half**2 >= c1
    return jnp.where(real, -c1 / (half + jnp.sqrt(jnp.where(real, half**2 - c1, 0.0))), -jnp.inf)


def _is_root_ray(lambda_: Values, c1: Values, ray: Values, eps: float) -> Values:
    """Whether a ray is the root's or below, to some eps of the squares whose difference p^2 + lambda p + c1 is."""
    half = 0.5 * lambda_
    square, least = (ray + half) ** 2, half**2 - c1
    near = square - least <= eps * float(jnp.finfo(jnp.result_type(half)).eps) * square
    return (least >= 0.0) & ((ray <= _lowest_ray(lambda_, c1)) | near)


_GRID_RAYS, _GRID_ROUNDS = 17, 5
"""Of a grid, and grids: the last one's step is 1 / 65 536 of the range of rays, and the time is stationary in them."""


def slowest_ray(lambda_: Values, alpha: Values, f_plus: Values) -> Values:
    """The ray p <= 0 (rad^0.5/s) of the slowest disturbance: d = +f while x1' > p sqrt(x1), -f after it (for x1 > 0).

    The disturbance that makes the largest peaks turns where x1' = 0, but the one that lasts longest holds on a little.
    By Pontryagin's principle it switches once in a half cycle: its costates obey l1' = l1 lambda / (2 sqrt x1), l2' = -l1,
    so that l1 keeps its sign and l2 changes sign at most once; by homogeneity it switches on a ray. Found by search over
    rays for the largest time to the origin (grids, each eight times finer). Zero where rho >= 1.
    """
    shape = jnp.broadcast_shapes(jnp.shape(lambda_), jnp.shape(alpha), jnp.shape(f_plus))
    dtype = jnp.result_type(lambda_, alpha, f_plus, float)
    lambda_, alpha, f_plus = (jnp.broadcast_to(jnp.asarray(x, dtype), shape) for x in (lambda_, alpha, f_plus))
    c1 = 2.0 * _safe_excess(alpha, f_plus)
    lowest = _lowest_ray(lambda_, c1)
    real = jnp.isfinite(lowest)
    root = jnp.where(real, lowest, -1.0)
    # near the root's ray, x falls as a power of the distance from it: even steps of what is left of x
    pace = jnp.maximum((2.0 * root + lambda_) / -root, 1.0)

    def ray(share: Values) -> Values:
        open_ = jnp.minimum(share, 1.0 - 1e-6)
        depth = open_ / (1.0 - open_)
        near = jnp.where(share < 1.0, root * -jnp.expm1(-pace * depth), root)
        return jnp.where(real, near, -jnp.sqrt(c1) * depth)

    def time(share: Values) -> Values:
        time, speed = _half_cycle(lambda_, alpha, f_plus, jnp.zeros_like(lambda_), jnp.ones_like(lambda_), ray(share))
        return time / jnp.maximum(1.0 - speed, jnp.finfo(dtype).tiny)

    grid = jnp.linspace(0.0, 1.0, _GRID_RAYS, dtype=dtype)

    def zoom(bounds: tuple[Values, Values], _: None) -> tuple[tuple[Values, Values], Values]:
        low, high = bounds
        shares, times = jax.vmap(lambda at: ((share := low + (high - low) * at), time(share)))(grid)
        best = jnp.argmax(times, axis=0, keepdims=True)
        found = jnp.take_along_axis(shares, best, axis=0)[0]
        step = (high - low) / (_GRID_RAYS - 1)
        return (jnp.maximum(found - step, 0.0), jnp.minimum(found + step, 1.0)), found

    ends = jnp.zeros(shape, dtype), jnp.ones(shape, dtype)
    _, found = jax.lax.scan(zoom, ends, length=_GRID_ROUNDS)
    # rounding must not choose between the root's ray and what lies by it, nor what is left of x below exp(-9) and nothing
    share, near = found[-1], ray(found[-1])
    near = jnp.where(real & ((share > 0.9) | _is_root_ray(lambda_, c1, near, 1e3)), root, near)
    return jnp.where(peak_ratio(lambda_, alpha, f_plus) < 1.0, near, 0.0)


def convergence_time_worst(
    lambda_: Values, alpha: Values, f_plus: Values, position_error: Values, velocity_error: Values
) -> Values:
    """Longest convergence time in s that any disturbance within f_plus can cause, exactly; `inf` where rho >= 1.

    From the errors x1 (rad) and x2 (rad/s) at t = 0. Half cycles under the slowest disturbance (:func:`slowest_ray`) take
    times in proportion to the peak speed |x2| they start with, and the peaks fall by a ratio r: a geometric sum. Within a
    half cycle x2 changes at the constant rates alpha -+ f.
    Source: derived for this project (docs/theory.md), checked against simulation.
    """
    zero = jnp.zeros_like(jnp.asarray(lambda_ * alpha * f_plus * 1.0))
    ray = jax.lax.stop_gradient(slowest_ray(lambda_, alpha, f_plus))  # the time is stationary in it
    time, speed = _half_cycle(lambda_, alpha, f_plus, zero, zero + 1.0, ray)
    converges = peak_ratio(lambda_, alpha, f_plus) < 1.0
    a_peak = time / jnp.where(converges & (speed < 1.0), 1.0 - speed, 1.0)
    # the half planes mirror each other
    x2 = jnp.where(position_error == 0.0, jnp.abs(velocity_error), jnp.sign(position_error) * velocity_error)
    away = position_error != 0.0
    y = jnp.where(away, jnp.sqrt(jnp.where(away, jnp.abs(position_error), 1.0)), 0.0)
    first, speed = _half_cycle(lambda_, alpha, f_plus, y + zero, x2 + zero, ray)
    # a start beyond the faster root's ray, x2 = (p + lambda) sqrt(x1), returns to it under d = +f, and holds on to the
    # origin; p + lambda is minus the slower one's root
    slides = x2 + zero > -_lowest_ray(lambda_, 2.0 * _safe_excess(alpha, f_plus)) * y
    longest = jnp.maximum(first + speed * a_peak, jnp.where(slides, x2 / _safe_excess(alpha, f_plus), 0.0))
    moving = (x2 != 0.0) | away
    return jnp.where(converges, jnp.where(moving, longest, 0.0), jnp.inf)


class Condition(NamedTuple):
    """A gain condition: its name in prose, and the least lambda (rad^0.5/s) it allows at alpha and f_plus (rad/s^2)."""

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
    """Largest f_plus (rad/s^2) up to which rho < 1, which gains withstand. At most alpha; zero where lambda is."""
    found, _ = bisect(lambda f_plus: ~(peak_ratio(lambda_, alpha, f_plus) < 1.0), alpha * jnp.ones_like(lambda_), 52)
    return found


@jax.jit
def _evaluate_conditions(lambda_: Values, alpha: Values, f_plus: Values) -> tuple[dict[str, Values], Values, Values]:
    least = {name: condition.least_lambda(alpha, f_plus) for name, condition in CONDITIONS.items()}
    return least, peak_ratio(lambda_, alpha, f_plus), largest_f_plus_exact(lambda_, alpha)


def judge_gains(lambda_: float, alpha: float, f_plus: float) -> dict[str, Any]:
    """Gains of an observer against what each condition asks at a bound f_plus (rad/s^2), as plain data for JSON.

    `least_lambda` (rad^0.5/s; None where no lambda does) and `holds` by condition, `peak_ratio`, and `largest_f_plus`
    (rad/s^2), up to which the exact condition holds.
    """
    with jax.enable_x64(True):
        found = _evaluate_conditions(*(jnp.asarray(float(x)) for x in (lambda_, alpha, f_plus)))
        least, rho, largest = to_jsonable(found)
    # a jitted function sorts the names
    least = {name: least[name] for name in CONDITIONS}
    return {
        "lambda": float(lambda_),
        "alpha": float(alpha),
        "f_plus": f_plus,
        "alpha_exceeds_f_plus": float(alpha) > f_plus,
        "least_lambda": least,
        "holds": {name: value is not None and float(lambda_) > value for name, value in least.items()},
        "peak_ratio": rho,
        "largest_f_plus": largest,
    }
