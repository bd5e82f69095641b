"""The simulated worst case against closed forms and SciPy; no gains that a condition allows let the peaks grow."""

import jax
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from jaxbl.gains.worst_case import HalfCycle, half_cycle, least_lambda_simulated
from jaxbl.observer import conditions

HALF_CYCLE, LEAST_LAMBDA = jax.jit(half_cycle), jax.jit(least_lambda_simulated)
RATIO = jax.jit(conditions.peak_ratio)
LIMITS = {name: jax.jit(limit) for name, (_, limit) in conditions.CONDITIONS.items()}


# few shapes, so that little is compiled; test_conditions.py has the same lanes
LANES, CELLS = 300, 16_384


def half_cycles_of(lambda_, alpha, f_plus=1.0, damping=0.0, speed=1.0, outward=1.0, homeward=-1.0, ray=0.0):
    arguments = np.broadcast_arrays(lambda_, alpha, f_plus, damping, speed, outward, homeward, ray)
    shape, size = arguments[0].shape, arguments[0].size
    *gains, damping, speed, outward, homeward, ray = (np.resize(x, LANES if size <= LANES else CELLS) for x in arguments)
    half_cycles = HALF_CYCLE(*gains, damping=damping, speed=speed, outward=outward, homeward=homeward, ray=ray)
    return HalfCycle(*(np.asarray(x)[:size].reshape(shape) for x in half_cycles))


def find_least_lambda(alpha, f_plus=1.0, damping=0.0, speed=1.0):
    arguments = np.broadcast_arrays(alpha, f_plus, damping, speed)
    *gains, damping, speed = (np.resize(x, LANES) for x in arguments)
    return np.asarray(LEAST_LAMBDA(*gains, damping=damping, speed=speed))[: arguments[0].size].reshape(arguments[0].shape)


def demand_lambda(name, alpha, f_plus):
    """Least lambda by a condition, for up to `LANES` pairs."""
    return np.asarray(LIMITS[name](np.resize(alpha, LANES), np.resize(f_plus, LANES)))[: np.size(alpha)]


def integrate_half_cycle(lambda_, alpha, f_plus, damping=0.0, speed=1.0, outward=1.0, homeward=-1.0, ray=0.0):
    """Ratio and time of a half cycle in the observer's own states."""

    def velocity(x1, x2):
        return x2 - lambda_ * np.sqrt(abs(x1)) * np.sign(x1)

    def derivatives(push):
        return lambda t, s: [velocity(*s), push * f_plus - alpha - damping * s[1]]

    def crosses_ray(t, s):
        return velocity(*s) - ray * np.sqrt(abs(s[0]))

    def crosses_zero(t, s):
        return s[0]

    crosses_ray.terminal = crosses_zero.terminal = True
    crosses_ray.direction = crosses_zero.direction = -1
    settings = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-15}
    # not so long that rounding at rest makes it turn
    outward_solution = solve_ivp(derivatives(outward), (0.0, 20.0), [0.0, speed], events=crosses_ray, **settings)
    if outward_solution.status != 1:
        return np.inf, np.inf
    inward_solution = solve_ivp(
        derivatives(homeward), (0.0, 200.0), outward_solution.y[:, -1], events=crosses_zero, **settings
    )
    assert inward_solution.status == 1
    return -inward_solution.y[1, -1] / speed, outward_solution.t[-1] + inward_solution.t[-1]


@pytest.fixture(scope="module")
def gain_plane():
    """Gains over f_plus = 1, with simulated and closed-form ratio; about the sweep's range, but between its points."""
    alpha = 1.0 + np.geomspace(1e-3, 19.0, 128)
    lambda_ = np.geomspace(0.05, 60.0, 513)[1:]
    cells = [x.reshape(-1, CELLS) for x in np.meshgrid(lambda_, alpha)]
    waves = [(half_cycles_of(*piece).ratio, RATIO(*piece, np.ones(CELLS))) for piece in zip(*cells, strict=True)]
    ratio, closed = (np.concatenate(wave) for wave in zip(*waves, strict=True))
    return *(x.ravel() for x in cells), ratio, closed


def test_ratio_is_the_closed_form_over_a_plane(gain_plane):
    lambda_, alpha, ratio, closed = gain_plane
    np.testing.assert_allclose(ratio, closed, rtol=1e-6, atol=1e-6)
    # what that covers: growing and falling peaks, and both double roots
    assert np.all(np.isfinite(ratio)) and ratio.max() > 10.0
    assert np.sum(closed == 0.0) > 15_000 and np.sum((closed > 0.0) & (closed < 1.0)) > 15_000
    for c in (alpha - 1.0, alpha + 1.0):
        assert np.sum(np.abs(lambda_ / np.sqrt(8.0 * c) - 1.0) < 0.01) > 90


def test_no_counterexample_to_any_condition(gain_plane):
    lambda_, alpha, ratio, _ = gain_plane
    assert len(ratio) == 65_536
    alphas, index = np.unique(alpha, return_inverse=True)
    for name in LIMITS:
        holds = lambda_ > demand_lambda(name, alphas, 1.0)[index]
        assert holds.sum() > 15_000, name
        assert np.all(ratio[holds] < 1.0), name
    assert np.sum(~holds) > 15_000
    # the exact one, last, is necessary too
    assert name == "exact"
    assert np.all(ratio[~holds] >= 1.0 - 1e-6)


def test_exact_condition_is_sharp_and_others_hold_at_their_limits():
    alpha, f_plus = 1.0 + np.geomspace(1e-3, 19.0, LANES), np.ones(LANES)
    limits = {name: demand_lambda(name, alpha, f_plus) for name in LIMITS}
    for name, limit in limits.items():
        assert np.all(half_cycles_of(limit * (1.0 + 1e-5), alpha, f_plus).ratio < 1.0), name
    assert np.all(half_cycles_of(limits["exact"] * (1.0 - 1e-5), alpha, f_plus).ratio > 1.0)


def draw_gains(seed):
    """lambda, alpha and f_plus of several sizes, on both sides of the exact condition."""
    random = np.random.default_rng(seed)
    f_plus = np.exp(random.uniform(-3.0, 3.0, LANES))
    alpha = f_plus * (1.0 + np.exp(random.uniform(np.log(0.02), np.log(20.0), LANES)))
    return demand_lambda("exact", alpha, f_plus) * np.exp(random.uniform(-2.0, 3.0, LANES)), alpha, f_plus


@pytest.mark.parametrize("share", [-1.0, -0.3, 0.0, 0.8, 1.0])
def test_a_constant_disturbance_only_changes_alpha(share):
    """x2 then falls at the constant rate alpha - d through the whole half cycle."""
    lambda_, alpha, f_plus = draw_gains(1)
    speed = np.exp(np.random.default_rng(2).uniform(-3.0, 3.0, LANES))
    half_cycles = half_cycles_of(lambda_, alpha, f_plus, speed=speed, outward=share, homeward=share)
    rate = alpha - share * f_plus
    closed = np.asarray(RATIO(lambda_, rate, np.zeros(LANES)))
    assert 40 < np.sum(closed == 0.0) < 260
    np.testing.assert_allclose(half_cycles.ratio, closed, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(half_cycles.time, (1.0 + closed) * speed / rate, rtol=2e-6)


def test_without_lambda_x2_turns_where_x1_does():
    _, alpha, f_plus = draw_gains(3)
    half_cycles = half_cycles_of(0.0, alpha, f_plus, speed=2.0)
    ratio = np.sqrt((alpha + f_plus) / (alpha - f_plus))
    np.testing.assert_allclose(half_cycles.ratio, ratio, rtol=1e-6)
    np.testing.assert_allclose(half_cycles.time, 2.0 / (alpha - f_plus) + 2.0 * ratio / (alpha + f_plus), rtol=1e-6)


def random_case(seed, friction=(-3.0, 2.0)):
    """lambda, alpha, f_plus, damping, speed; the logarithm of the friction number is between the ends of `friction`."""
    random = np.random.default_rng(seed)
    f_plus, speed = np.exp(random.uniform(-1.5, 1.5, 2))
    alpha = f_plus * (1.0 + np.exp(random.uniform(-2.5, 2.0)))
    damping = f_plus / speed * np.exp(random.uniform(*friction))
    return np.sqrt(8.0 * (alpha + f_plus)) * np.exp(random.uniform(-3.0, -0.3)), alpha, f_plus, damping, speed


def assert_like_scipy(case, **changes):
    lambda_, alpha, f_plus, damping, speed = case
    half_cycles = half_cycles_of(lambda_, alpha, f_plus, damping=damping, speed=speed, **changes)
    ratio, time = integrate_half_cycle(*case, **changes)
    assert 0.0 < ratio < np.inf
    np.testing.assert_allclose(half_cycles.ratio, ratio, rtol=1e-6, atol=5e-7)
    np.testing.assert_allclose(half_cycles.time, time, rtol=1e-6)


@pytest.mark.parametrize("seed", range(10))
def test_with_damping_as_scipy(seed):
    assert_like_scipy(random_case(seed))


@pytest.mark.parametrize("seed", range(10, 14))
def test_with_strong_damping_as_scipy(seed):
    assert_like_scipy(random_case(seed, (3.0, 6.0)))


@pytest.mark.parametrize("seed", range(20, 26))
def test_other_disturbances_as_scipy(seed):
    case = random_case(seed)
    outward, homeward, share = np.random.default_rng(seed).uniform((0.0, -1.0, 0.0), (1.0, 0.0, 0.9))
    # where d = outward leads past every such ray
    lowest = -0.5 * min(case[0], np.sqrt(8.0 * (case[1] - outward * case[2])))
    assert_like_scipy(case, outward=outward, homeward=homeward, ray=share * lowest)


def test_damped_time_to_the_origin():
    """Straight home under no disturbance, x2' = -alpha - damping x2 throughout."""
    damping = np.geomspace(1e-3, 1e3, 30)
    half_cycles = half_cycles_of(20.0, 2.0, 1.0, damping=damping, speed=0.7, outward=0.0, homeward=0.0)
    np.testing.assert_array_equal(half_cycles.ratio, 0.0)
    np.testing.assert_allclose(half_cycles.time, np.log1p(damping * 0.7 / 2.0) / damping, rtol=1e-6)


@pytest.mark.parametrize(("lambda_", "alpha", "damping"), [(30.0, 1.02, 0.1), (30.0, 2.0, 30.0), (60.0, 1.5, 1.0)])
def test_with_large_lambda_as_scipy(lambda_, alpha, damping):
    """The way home along the ray is then many of the steps that lambda asks for."""
    half_cycles = half_cycles_of(lambda_, alpha, 1.0, damping=damping)
    assert half_cycles.ratio == 0.0
    ratio, time = integrate_half_cycle(lambda_, alpha, 1.0, damping)
    assert abs(ratio) < 5e-6
    np.testing.assert_allclose(half_cycles.time, time, rtol=5e-6)


def test_with_lambda_without_end_x2_falls_by_the_second_arc_alone():
    lambda_, damping = (x.ravel() for x in np.meshgrid(np.geomspace(1e3, 1e5, 10), [1e-3, 1.0, 30.0, 1e3]))
    half_cycles = half_cycles_of(lambda_, 2.0, 1.0, damping=damping, speed=0.5)
    np.testing.assert_array_equal(half_cycles.ratio, 0.0)
    np.testing.assert_allclose(half_cycles.time, np.log1p(damping * 0.5 / 3.0) / damping, rtol=1e-3)


def test_ratio_depends_on_three_numbers_only():
    lambda_, alpha, f_plus = draw_gains(5)
    speed, friction = np.exp(np.random.default_rng(6).uniform(-3.0, 3.0, (2, LANES)))
    half_cycles = half_cycles_of(lambda_, alpha, f_plus, damping=friction * f_plus / speed, speed=speed)
    scaled = half_cycles_of(lambda_ / np.sqrt(f_plus), alpha / f_plus, np.ones(LANES), damping=friction)
    np.testing.assert_allclose(half_cycles.ratio, scaled.ratio, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(half_cycles.time, scaled.time * speed / f_plus, rtol=1e-9)
    # and on the friction number indeed
    assert np.abs(half_cycles.ratio - half_cycles_of(lambda_, alpha, f_plus).ratio).max() > 0.5


@pytest.fixture(scope="module")
def ratio_cube():
    """Ratios over alpha, damping and lambda at f_plus = 1 and unit speed."""
    alpha = 1.0 + np.geomspace(1e-2, 50.0, 20)
    damping = np.append(0.0, np.geomspace(1e-3, 100.0, 25))
    lambda_ = np.append(0.0, np.geomspace(0.01, 25.0, 29))
    shape = np.meshgrid(alpha, damping, lambda_, indexing="ij")
    return half_cycles_of(shape[2], shape[0], 1.0, damping=shape[1]).ratio


def test_ratio_falls_with_lambda(ratio_cube):
    step = np.diff(ratio_cube, axis=2)
    assert np.all(step <= 0.0)
    assert np.all(step[ratio_cube[:, :, 1:] > 0.1] < 0.0)
    # all the way down to the origin
    assert np.all(ratio_cube[:, :, -1] == 0.0)


def test_ratio_falls_with_damping_where_it_is_not_small(ratio_cube):
    """Peaks that fall to a tenth anyway are slightly larger with damping, which turns the error back earlier."""
    before, after = ratio_cube[:, :-1], ratio_cube[:, 1:]
    assert np.sum(before > 0.1) > 5000
    assert np.all((after < before)[before > 0.1])
    assert np.all((after < 0.1)[before <= 0.1])
    np.testing.assert_array_less(
        integrate_half_cycle(10.0, 31.0, 1.0, 0.0)[0], integrate_half_cycle(10.0, 31.0, 1.0, 0.1)[0]
    )


@pytest.mark.parametrize(("lambda_", "alpha"), [(0.0, 1.0), (1.0, 1.0), (50.0, 0.5), (1.0, 0.0)])
def test_peaks_do_not_come_back_where_alpha_does_not_exceed_the_disturbance(lambda_, alpha):
    half_cycles = half_cycles_of(lambda_, alpha, 1.0)
    assert half_cycles.ratio == np.inf and half_cycles.time == np.inf


def test_least_lambda_without_damping_is_the_exact_one():
    f_plus = np.repeat([0.01, 1.0, 300.0], 60)
    alpha = f_plus * (1.0 + np.tile(np.geomspace(1e-4, 19.0, 60), 3))
    root = np.sqrt(f_plus)
    np.testing.assert_allclose(
        find_least_lambda(alpha, f_plus) / root, demand_lambda("exact", alpha, f_plus) / root, rtol=0.0, atol=1e-6
    )


def test_no_least_lambda_where_alpha_does_not_exceed_the_disturbance():
    alpha = np.array([0.0, 0.5, 1.0 - 1e-6, 1.0, 1.0 + 1e-6])
    np.testing.assert_array_equal(np.isinf(find_least_lambda(alpha)), [True, True, True, True, False])


def test_least_lambda_falls_with_damping():
    alpha = 1.0 + np.geomspace(1e-3, 19.0, 15)
    damping = np.append(0.0, np.geomspace(0.01, 10.0, 16))
    shape = np.meshgrid(alpha, damping, indexing="ij")
    half_cycles = find_least_lambda(shape[0], damping=shape[1])
    before, after = half_cycles[:, :-1], half_cycles[:, 1:]
    assert np.all((after < before)[before > 0.0])
    assert np.all(after[before == 0.0] == 0.0)
    assert np.all(half_cycles[:, -1] == 0.0)


def enough_damping(alpha):
    """Damping at which peaks of unit speed return at unit speed for lambda = 0 and f_plus = 1, by the closed arcs."""
    slow, fast = alpha - 1.0, alpha + 1.0

    def excess_time(damping):
        outward_time = 1.0 / damping - slow / damping**2 * np.log1p(damping / slow)
        return outward_time + 1.0 / damping + fast / damping**2 * np.log1p(-damping / fast)

    return brentq(excess_time, 1e-3, fast * (1.0 - 1e-12))


def test_least_lambda_is_zero_exactly_where_damping_alone_is_enough():
    alpha = 1.0 + np.geomspace(0.01, 19.0, 20)
    enough = np.array([enough_damping(a) for a in alpha])
    above, below = find_least_lambda(alpha, damping=np.stack([enough * 1.001, enough * 0.999]))
    assert np.all(above == 0.0)
    assert np.all(below > 0.0)


def test_with_damping_alpha_may_be_smaller_than_f_plus_by_what_friction_takes_up():
    """Under d = +f, x2 falls from the start exactly if damping * speed > f - alpha; only then the error can turn."""
    alpha, speed = np.array([0.01, 0.3, 0.7, 0.99]), 3.0
    limit = (1.0 - alpha) / speed
    below, above = find_least_lambda(alpha, damping=np.stack([limit * 0.99, limit * 1.01]), speed=speed)
    assert np.all(np.isinf(below))
    assert np.all(np.isfinite(above))


@pytest.mark.parametrize(
    ("alpha", "f_plus", "damping", "speed"),
    [(1.1, 1.0, 0.3, 1.0), (2.0, 1.0, 0.5, 0.5), (6.0, 3.0, 2.0, 0.7), (0.9, 1.0, 0.4, 1.0), (0.5, 1.0, 1.2, 0.8)],
)
def test_least_lambda_with_damping_is_where_scipys_peaks_stop_falling(alpha, f_plus, damping, speed):
    least_lambda = float(find_least_lambda(alpha, f_plus, damping, speed))
    assert 0.0 < least_lambda < np.inf
    assert integrate_half_cycle(least_lambda * 1.001, alpha, f_plus, damping, speed)[0] < 1.0
    assert integrate_half_cycle(least_lambda * 0.999, alpha, f_plus, damping, speed)[0] > 1.0


def test_columns_broadcast():
    lambda_, alpha = np.array([0.5, 1.0, 2.0])[:, None], np.array([1.5, 3.0])
    half_cycles = HALF_CYCLE(lambda_, alpha, 1.0, damping=0.3)
    assert half_cycles.ratio.shape == half_cycles.time.shape == (3, 2)
    for computed, padded in zip(half_cycles, half_cycles_of(lambda_, alpha, damping=0.3), strict=True):
        np.testing.assert_allclose(computed, padded, rtol=1e-12)
