"""The error system (34) of the super-twisting observer under the worst disturbance, simulated.

x1' = x2 - lambda sqrt|x1| sign x1, x2' = d - alpha sign x1 - damping x2, with d in [-f_plus, f_plus]. Unlike the closed
forms of :mod:`jaxbl.observer.conditions` the simulation allows viscous damping (viscous friction over inertia of the drive),
for which no closed form is known. A half cycle begins and ends at x1 = 0; the next one is its mirror image.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxbl.observer.conditions import Values, bisect

_STEP_SHARE = 0.1
"""Step over the fastest time constant: the error of the peak ratio is then about 1e-7."""
_MOST_STEPS = 20_000
"""Most steps of a quarter cycle, two thousand time constants: it has then ended, or nears the origin along a ray."""
_ORIGIN_RATIO = 1e-6
"""Below this error, relative to the start, the remaining time to the origin is added in closed form."""
_HALVINGS = 28
"""The last interval is 4 / 2^28 = 1.5e-8 of sqrt(alpha + f)."""


class HalfCycle(NamedTuple):
    """The ratio of the speed |x2| at the end of a half cycle to that at its start, and its duration in s.

    The ratio is 0 if the error reaches the origin within the half cycle, and `inf` if it does not come back.
    """

    ratio: Values
    time: Values


class _State(NamedTuple):
    """y = sqrt(x1), x2 and time; d time = 2 y d(tau) takes the root's infinite slope out of the equations."""

    y: Values
    x2: Values
    time: Values


def half_cycle(
    lambda_: Values,
    alpha: Values,
    f_plus: Values,
    *,
    damping: Values | float = 0.0,
    speed: Values | float = 1.0,
    outward: Values | float = 1.0,
    homeward: Values | float = -1.0,
    ray: Values | float = 0.0,
) -> HalfCycle:
    """Simulate half cycles of the error system (34), elementwise over arrays that broadcast.

    Runge-Kutta of order four in tau, d time = 2 sqrt(x1) d(tau); events are met by Newton's method on the last step.

    Args:
        lambda_: gain, rad^0.5/s.
        alpha: gain, rad/s^2.
        f_plus: bound of the disturbance, rad/s^2.
        damping: viscous damping of x2, 1/s. With it the ratio depends on the speed, through damping * speed / f_plus only.
        speed: x2 at the start, rad/s.
        outward: d / f_plus until x1' = ray sqrt(x1).
        homeward: d / f_plus from there on. The defaults are the worst case, which makes the next peak the largest.
        ray: where d changes, rad^0.5/s; 0 is the turning point.
    """
    lambda_, alpha, f_plus, damping, speed, ray = jnp.broadcast_arrays(
        *(jnp.asarray(number, float) for number in (lambda_, alpha, f_plus, damping, speed, ray))
    )
    zero = jnp.zeros_like(lambda_)

    def field_under(push: Values) -> Callable[[_State], _State]:
        def slope(s: _State) -> _State:
            return _State(s.x2 - lambda_ * s.y, 2.0 * s.y * (push - damping * s.x2), 2.0 * s.y)

        return slope

    def step_size(s: _State) -> Values:
        # y begins at zero: the root is what the damping will be one step on
        fastest = jnp.sqrt(2.0 * (alpha + f_plus)) + jnp.sqrt(2.0 * damping * jnp.abs(s.x2)) + 2.0 * damping * s.y
        return _STEP_SHARE / (lambda_ + fastest)

    def nears_origin(s: _State) -> Values:
        """True at the origin, or where the state nears it along a ray that no trajectory crosses."""
        c = 2.0 * (alpha - homeward * f_plus)
        turning = s.x2 * (s.x2 - lambda_ * s.y) + c * s.y**2  # Q(p) y^2 for p = x1' / y
        along = (jnp.abs(turning) < _ORIGIN_RATIO**2 * (lambda_ * s.y) ** 2) & (s.x2 > 0.0)
        # with damping p' = -(p^2 + lambda p + c + 2 damping x2): the roots part as x2 falls, p stays above the lower
        above = (2.0 * s.x2 >= lambda_ * s.y) & (lambda_**2 >= 4.0 * (c + 2.0 * damping * s.x2))
        held = (damping > 0.0) & (c > 0.0) & (s.x2 > 0.0) & above
        return (jnp.abs(s.x2) + jnp.sqrt(jnp.abs(c)) * s.y < _ORIGIN_RATIO * speed) | along | held

    start = _State(zero, speed, zero)
    turning_state, has_turned = _march(
        field_under(outward * f_plus - alpha), step_size, lambda s: s.x2 - (lambda_ + ray) * s.y, start, lambda s: zero > 0.0
    )
    last_state, is_back = _march(
        field_under(homeward * f_plus - alpha), step_size, lambda s: s.y, turning_state, nears_origin, has_turned
    )
    ends = nears_origin(last_state) & ~is_back
    # on the ray to the origin x2 falls at the rate alpha - d + damping x2
    rate = alpha - homeward * f_plus
    remaining_time = jnp.where(ends, jnp.abs(last_state.x2) / jnp.where(rate > 0.0, rate, 1.0), 0.0)
    damped_time = damping * remaining_time
    remaining_time = remaining_time * jnp.where(
        damped_time > 0.0, jnp.log1p(damped_time) / jnp.where(damped_time > 0.0, damped_time, 1.0), 1.0
    )
    ratio = jnp.where(ends, 0.0, -last_state.x2 / speed)
    returns = has_turned & (is_back | ends)
    return HalfCycle(jnp.where(returns, ratio, jnp.inf), jnp.where(returns, last_state.time + remaining_time, jnp.inf))


def _runge_kutta(slope: Callable[[_State], _State], s: _State, h: Values) -> _State:
    def shift_state(step: Values, k: _State) -> _State:
        return jax.tree.map(lambda x, d: x + step * d, s, k)

    k1 = slope(s)
    k2 = slope(shift_state(0.5 * h, k1))
    k3 = slope(shift_state(0.5 * h, k2))
    k4 = slope(shift_state(h, k3))
    return jax.tree.map(lambda x, a, b, c, d: x + h / 6.0 * (a + 2.0 * b + 2.0 * c + d), s, k1, k2, k3, k4)


def _march(
    slope: Callable[[_State], _State],
    step_size: Callable[[_State], Values],
    event: Callable[[_State], Values],
    state: _State,
    nears_origin: Callable[[_State], Values],
    starts_moving: Values | bool = True,
) -> tuple[_State, Values]:
    """Integrate until `event` falls through zero. Returns the state there, and True where it does."""
    zero = jnp.zeros_like(state.y)

    def advance(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        state, going, met, count = carry
        new = _runge_kutta(slope, state, step_size(state))
        crosses = event(new) <= 0.0
        moves = going & ~crosses
        state = jax.tree.map(partial(jnp.where, moves), new, state)
        return state, moves & ~nears_origin(state), met | (going & crosses), count + 1

    begin = state, jnp.asarray(starts_moving) & (zero == 0.0), zero > 0.0, jnp.asarray(0)
    state, _, has_event, _ = jax.lax.while_loop(lambda carry: jnp.any(carry[1]) & (carry[3] < _MOST_STEPS), advance, begin)

    # the last step ends at the event
    def newton_step(_: int, h: Values) -> Values:
        event_value, rate = jax.jvp(lambda h: event(_runge_kutta(slope, state, h)), (h,), (jnp.ones_like(h),))
        return jnp.clip(h - event_value / jnp.where(rate < 0.0, rate, -jnp.inf), 0.0, step_size(state))

    h = jax.lax.fori_loop(0, 6, newton_step, 0.5 * step_size(state))
    return jax.tree.map(partial(jnp.where, has_event), _runge_kutta(slope, state, h), state), has_event


def least_lambda_simulated(
    alpha: Values, f_plus: Values, *, damping: Values | float = 0.0, speed: Values | float = 1.0
) -> Values:
    """Return the least lambda (rad^0.5/s) at which an error of this speed (rad/s) shrinks in the simulated worst case.

    It is found by bisection on :func:`half_cycle` to 1.5e-8 of sqrt(alpha + f). It is 0 if damping alone is enough, and
    `inf` if no lambda up to 4 sqrt(alpha + f) is.
    """
    numbers = (jnp.asarray(number, float) for number in (alpha, f_plus, damping, speed))
    alpha, f_plus, damping, speed = jnp.broadcast_arrays(*numbers)
    high = 4.0 * jnp.sqrt(alpha + f_plus)

    def shrinks(lambda_: Values) -> Values:
        return half_cycle(lambda_, alpha, f_plus, damping=damping, speed=speed).ratio < 1.0

    low, least_lambda = bisect(shrinks, high, _HALVINGS)
    least_lambda = jnp.where((low == 0.0) & shrinks(jnp.zeros_like(high)), 0.0, least_lambda)
    return jnp.where(shrinks(high), least_lambda, jnp.inf)
