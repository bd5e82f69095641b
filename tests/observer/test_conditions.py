"""Gain conditions against the design's table, quadrature, and independent simulations of the error system (34)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.integrate import quad, solve_ivp
from scipy.linalg import solve_continuous_are

from jaxbl.errors import InputError
from jaxbl.gains.worst_case import half_cycle
from jaxbl.observer import conditions

# alpha / f: least lambda / sqrt(f) by the exact condition, (32) with q -> 0, Seeber and Horn, Levant
TABLE = {
    1.1: (0.991, 9.39, 1.449, 9.17),
    1.5: (0.780, 5.00, 1.581, 4.47),
    2.0: (0.656, 4.24, 1.732, 3.46),
    5.0: (0.404, 4.24, 2.449, 2.45),
}


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_table_of_the_design(dtype):
    alpha, f_plus = jnp.asarray(list(TABLE), dtype), jnp.ones(len(TABLE), dtype)
    limits = {name: least(alpha, f_plus) for name, least in LEAST.items()}
    assert {column.dtype for column in limits.values()} == {jnp.dtype(dtype)}
    exact, davila_fridman, seeber_horn, levant = np.transpose(list(TABLE.values()))
    np.testing.assert_allclose(limits["exact"], exact, atol=6e-4)
    np.testing.assert_allclose(limits["davila_fridman"], davila_fridman, atol=6e-3)
    np.testing.assert_allclose(limits["seeber_horn"], seeber_horn, atol=6e-4)
    np.testing.assert_allclose(limits["levant"], levant, atol=6e-3)


def test_davila_fridman_grows_with_q():
    least = conditions.least_lambda_davila_fridman
    np.testing.assert_allclose(least(2.0, 1.0, 0.5), 3.0 * least(2.0, 1.0))


@pytest.mark.parametrize("q", [-0.1, 1.0, 1.5, float("nan"), float("inf")])
def test_q_outside_of_its_range(q):
    with pytest.raises(InputError, match=f"q: condition .32. needs 0 < q < 1 .*, not {q}"):
        conditions.least_lambda_davila_fridman(2.0, 1.0, q)


def test_levants_usual_gains_converge():
    np.testing.assert_allclose(conditions.peak_ratio(1.5, 1.1, 1.0), 0.54, atol=5e-3)


def ratio_by_quadrature(lambda_, alpha, f_plus):
    c1, c2 = 2.0 * (alpha - f_plus), 2.0 * (alpha + f_plus)
    # p = tan(a): the integrals over a finite range
    first = quad(lambda a: 1.0 / (np.sin(a) ** 2 + lambda_ * np.sin(a) * np.cos(a) + c1 * np.cos(a) ** 2), 0.0, np.pi / 2)
    second = quad(lambda a: 1.0 / (np.sin(a) ** 2 - lambda_ * np.sin(a) * np.cos(a) + c2 * np.cos(a) ** 2), 0.0, np.pi / 2)
    return np.sqrt(c2 / c1) * np.exp(-0.5 * lambda_ * (first[0] + second[0]))


def ratio_by_simulation(lambda_, alpha, f_plus):
    """Follow (34) from (0, 1) with the disturbance that pushes outwards, in the observer's own states, to the next peak."""

    def position_rate(x, velocity):
        return velocity - lambda_ * np.sqrt(max(x, 0.0))

    def derivatives(disturbance):
        return lambda t, s: [position_rate(*s), disturbance - alpha]

    def stops(t, s):
        return position_rate(*s)

    def crosses_zero(t, s):
        return s[0]

    stops.terminal = crosses_zero.terminal = True
    stops.direction = crosses_zero.direction = -1
    settings = {"method": "DOP853", "rtol": 1e-10, "atol": 1e-14}
    outward = solve_ivp(derivatives(f_plus), (0.0, 100.0), [0.0, 1.0], events=stops, **settings)
    inward = solve_ivp(derivatives(-f_plus), (0.0, 100.0), outward.y[:, -1], events=crosses_zero, **settings)
    return -inward.y[1, -1]


# complex and real roots of the first quadrant, below and above the boundary of convergence
CASES = [
    (1.5, 1.1, 1.0),
    (0.7, 1.5, 1.0),
    (2.0, 1.6, 1.0),
    (0.3, 5.0, 1.0),
    (1.2, 1.2, 1.0),
    (3.0, 9.0, 4.0),
    (0.2, 0.3, 0.0),
]


@pytest.mark.parametrize("case", CASES)
def test_peak_ratio_is_that_of_quadrature_and_of_the_simulated_worst_case(case):
    closed = RATIO(*case)
    np.testing.assert_allclose(closed, ratio_by_quadrature(*case), rtol=1e-10)
    np.testing.assert_allclose(closed, ratio_by_simulation(*case), rtol=1e-3)


LANES = 300


def compile_function(function):
    """Compile a function once in each precision, for up to `LANES` cases of any shape."""
    compiled = jax.jit(function)

    def call(*arguments):
        arguments = np.broadcast_arrays(*arguments)
        shape, size = arguments[0].shape, arguments[0].size
        return np.asarray(compiled(*(np.resize(x, LANES) for x in arguments)))[:size].reshape(shape)

    return call


RATIO, BOUND = compile_function(conditions.peak_ratio), compile_function(conditions.convergence_time_bound)
LEAST = {name: compile_function(least) for name, (_, least) in conditions.CONDITIONS.items()}
POSITIVE = st.floats(0.1, 10.0)


@settings(deadline=None, max_examples=50)
@given(lambda_=POSITIVE, ratio=st.floats(1.01, 10.0), f_plus=POSITIVE, scale=st.floats(1e-3, 1e3))
def test_homogeneous(lambda_, ratio, f_plus, scale):
    alpha, root = ratio * f_plus, np.sqrt(scale)
    rho = RATIO(lambda_, alpha, f_plus)
    np.testing.assert_allclose(RATIO(root * lambda_, scale * alpha, scale * f_plus), rho, rtol=1e-8, atol=1e-300)
    for least in LEAST.values():
        np.testing.assert_allclose(least(scale * alpha, scale * f_plus), root * least(alpha, f_plus), rtol=1e-9)
    np.testing.assert_allclose(
        # lengths in rad and times in s: lambda^2, alpha and f all go with the length
        BOUND(root * 40.0, scale * alpha, scale * f_plus, scale * 0.3, scale * 0.7),
        BOUND(40.0, alpha, f_plus, 0.3, 0.7),
        rtol=1e-9,
    )


@settings(deadline=None, max_examples=50)
@given(ratio=st.floats(1.001, 50.0), f_plus=POSITIVE)
def test_least_lambda_exact_is_where_the_ratio_is_one(ratio, f_plus):
    least = LEAST["exact"](ratio * f_plus, f_plus)
    np.testing.assert_allclose(RATIO(least, ratio * f_plus, f_plus), 1.0, rtol=1e-9)


def test_largest_bound_of_the_exact_condition_is_where_it_is_just_met():
    alpha = np.array([1.1, 3.0, 80.0])
    lambdas = np.stack([LEAST["exact"](alpha, np.ones(3)), np.zeros(3), np.full(3, 1e3)])
    largest = conditions.largest_f_plus_exact(jnp.asarray(lambdas), jnp.stack([alpha] * 3))
    # with a large lambda it is alpha that limits, with none nothing is withstood
    np.testing.assert_allclose(largest, [np.ones(3), np.zeros(3), alpha], rtol=1e-9, atol=1e-12)


def test_gains_are_judged_by_every_condition():
    summary = conditions.judge_gains(1.5, 1.1, 1.0)
    # the usual pair, docs/theory.md
    assert [name for name, holds in summary["holds"].items() if holds] == ["seeber_horn", "exact"]
    assert list(summary["least_lambda"]) == list(conditions.CONDITIONS)
    assert summary["peak_ratio"] == pytest.approx(0.54, abs=0.005)
    assert 1.0 < summary["largest_f_plus"] <= 1.1
    failing = conditions.judge_gains(1.5, 1.0, 1.0)
    assert (failing["peak_ratio"], set(failing["least_lambda"].values())) == (None, {None})
    assert not any(failing["holds"].values())


@settings(deadline=None, max_examples=100)
@given(margin=st.floats(1e-3, 1e3), f_plus=POSITIVE)
def test_order_of_the_conditions(margin, f_plus):
    """All others are sufficient, so none may ask for less than the exact one; of each other, what algebra says."""
    alpha = (1.0 + margin) * f_plus
    least = {name: float(least(alpha, f_plus)) for name, least in LEAST.items()}
    exact = least.pop("exact")
    assert 0.0 < exact < min(least.values())
    assert least["moreno_osorio"] < least["levant"] < least["davila_fridman"]
    assert least["seeber_horn"] < least["davila_fridman"]
    # 4 (a - sqrt(a^2 - 1)) = a + 1 at a = (8 sqrt 2 - 3) / 7
    crossing = (8.0 * np.sqrt(2.0) - 3.0) / 7.0
    if abs(1.0 + margin - crossing) > 1e-6:
        assert (least["moreno_osorio"] < least["seeber_horn"]) == (1.0 + margin > crossing)


def extreme_matrices(lambda_, alpha, f_plus):
    """Matrices of zeta' = A zeta / (2 sqrt|x1|), zeta = (sqrt|x1| sign x1, x2), under d = -f and +f where x1 > 0."""
    return [np.array([[-lambda_, 1.0], [-2.0 * (alpha - d), 0.0]]) for d in (-f_plus, f_plus)]


@settings(deadline=None, max_examples=100)
@given(ratio=st.floats(1.01, 50.0), f_plus=POSITIVE, off=st.floats(1e-3, 1.0))
def test_quadratic_lyapunov_functions_end_where_shorten_and_narendra_say(ratio, f_plus, off):
    """Two Hurwitz matrices that differ in rank one share a quadratic Lyapunov function iff their product has no negative
    real eigenvalue (R. Shorten, K. Narendra, 2003)."""
    alpha = ratio * f_plus
    least = float(LEAST["moreno_osorio"](alpha, f_plus))
    for lambda_, shared in ((least * (1.0 + off), True), (least / (1.0 + off), False)):
        first, second = extreme_matrices(lambda_, alpha, f_plus)
        assert max(np.linalg.eigvals(first).real.max(), np.linalg.eigvals(second).real.max()) < 0.0
        assert np.linalg.matrix_rank(first - second) == 1
        eigenvalues = np.linalg.eigvals(first @ second)
        negative = (np.abs(eigenvalues.imag) < 1e-9 * np.abs(eigenvalues)) & (eigenvalues.real < 0.0)
        assert negative.any() != shared


@settings(deadline=None, max_examples=50)
@given(ratio=st.floats(1.02, 20.0), f_plus=POSITIVE, off=st.floats(0.02, 3.0))
def test_moreno_osorio_allows_only_what_a_lyapunov_function_shows(ratio, f_plus, off):
    """The bounded real lemma's Riccati equation, solved, gives V = zeta' P zeta that falls at both extremes of w."""
    alpha = ratio * f_plus
    lambda_ = float(LEAST["moreno_osorio"](alpha, f_plus)) * (1.0 + off)
    a, b = np.array([[-lambda_, 1.0], [-2.0 * alpha, 0.0]]), np.array([[0.0], [2.0]])
    # a little more than f zeta_1 is allowed for, and a little of zeta_2: V' < 0 strictly
    q = np.diag([((1.0 + 1e-3 * off) * f_plus) ** 2, 1e-6 * off**2 * f_plus])
    p = solve_continuous_are(a, b, q, -np.eye(1))
    assert np.linalg.eigvalsh(p).min() > 0.0
    for matrix in extreme_matrices(lambda_, alpha, f_plus):
        assert np.linalg.eigvalsh(matrix.T @ p + p @ matrix).max() < 0.0


@pytest.mark.parametrize(("dtype", "tolerance"), [(jnp.float32, 2e-5), (jnp.float64, 1e-6)])
def test_derivatives_of_the_exact_condition(dtype, tolerance):
    random = np.random.default_rng(3)
    f_plus = np.exp(random.uniform(-2.0, 2.0, 40))
    alpha = f_plus * (1.0 + np.exp(random.uniform(np.log(0.01), np.log(50.0), 40)))
    least = conditions.least_lambda_exact
    change = []
    for d in 1e-6 * np.eye(2):
        above, below = (LEAST["exact"](alpha * np.exp(s * d[0]), f_plus * np.exp(s * d[1])) for s in (1.0, -1.0))
        change.append(np.asarray((above - below) / 2e-6))
    change = np.array(change) / np.array([alpha, f_plus])
    # Euler: the condition is homogeneous of degree 1/2
    np.testing.assert_allclose(change[0] * alpha + change[1] * f_plus, 0.5 * LEAST["exact"](alpha, f_plus), rtol=1e-6)
    slopes = jax.jit(jax.vmap(jax.grad(least, (0, 1))))(jnp.asarray(alpha, dtype), jnp.asarray(f_plus, dtype))
    assert slopes[0].dtype == dtype
    np.testing.assert_allclose(slopes, change, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize(("dtype", "tolerance"), [(jnp.float32, 1e-5), (jnp.float64, 1e-12)])
def test_exact_condition_far_above_the_bound(dtype, tolerance):
    """log rho tends to f / alpha - pi lambda / sqrt(8 alpha) for small f: without cancellation in either precision."""
    ratio = np.logspace(7, 20, 14).astype(dtype)
    limits = LEAST["exact"](ratio, np.ones_like(ratio))
    np.testing.assert_allclose(limits * np.sqrt(ratio), np.sqrt(8.0) / np.pi, rtol=tolerance)


def test_nan_only_where_an_argument_is():
    values = np.array([0.0, 1e-300, 1e-30, 1e-3, 0.5, 1.0, np.nextafter(1.0, 2.0), 1.0 + 1e-9, 2.0, 1e6, 1e30, np.nan])
    alpha, f_plus = (x.ravel() for x in np.meshgrid(values, values))
    unknown = np.isnan(alpha) | np.isnan(f_plus)
    for name, least in LEAST.items():
        limits = np.asarray(least(alpha, f_plus))
        np.testing.assert_array_equal(np.isnan(limits), unknown, err_msg=name)
        np.testing.assert_array_equal(limits[~unknown] == np.inf, (alpha <= f_plus)[~unknown], err_msg=name)
        assert np.all(limits[~unknown] >= 0.0), name


def test_without_a_disturbance():
    """Any lambda > 0 is enough then; Davila-Fridman and Seeber-Horn ask for more all the same."""
    alpha, zero = np.array([0.1, 1.0, 30.0]), np.zeros(3)
    for name in ("exact", "levant", "moreno_osorio"):
        np.testing.assert_array_equal(LEAST[name](alpha, zero), zero)
    np.testing.assert_allclose(LEAST["seeber_horn"](alpha, zero), np.sqrt(alpha))
    np.testing.assert_allclose(LEAST["davila_fridman"](alpha, zero), np.sqrt(2.0 * alpha))
    assert np.all(RATIO(np.full(3, 1e-3), alpha, zero) < 1.0)


@pytest.mark.parametrize("alpha", [0.0, 0.5, 1.0])
def test_no_lambda_is_enough_where_alpha_is_not(alpha):
    for least in LEAST.values():
        assert least(alpha, 1.0) == np.inf
    assert RATIO(5.0, alpha, 1.0) == np.inf
    assert BOUND(5.0, alpha, 1.0, 0.1, 0.1) == np.inf


@pytest.mark.parametrize(("dtype", "tolerance"), [(jnp.float32, 2e-6), (jnp.float64, 1e-10)])
def test_continuous_across_the_double_root(dtype, tolerance):
    """At lambda^2 = 4 c1 the formula changes branch twice, about a series."""
    alpha, f_plus = 1.3, 1.0
    double = 2.0 * np.sqrt(2.0 * (alpha - f_plus))
    steps = np.concatenate([s * np.logspace(-9, -1, 60) for s in (-1.0, 1.0)])
    lambdas = (double * (1.0 + np.sort(steps))).astype(dtype)
    alpha, f_plus = (np.asarray(x, dtype) for x in (alpha, f_plus))
    ratios = jax.vmap(conditions.peak_ratio, (0, None, None))(lambdas, alpha, f_plus)
    true = [ratio_by_quadrature(*(float(x) for x in (lambda_, alpha, f_plus))) for lambda_ in lambdas]
    np.testing.assert_allclose(ratios, true, rtol=tolerance)


@pytest.mark.parametrize("case", [(1.5, 1.1, 1.0), (0.7, 1.5, 1.0), (9.0, 1.5, 1.0), (1.0, 0.5, 1.0)])
def test_derivatives_are_finite_on_every_branch(case):
    gradient = np.asarray(jax.grad(conditions.peak_ratio, (0, 1, 2))(*case))
    assert np.all(np.isfinite(gradient))
    if case[1] > case[2]:
        change = [(RATIO(*(case + d)) - RATIO(*(case - d))) / 2e-6 for d in 1e-6 * np.eye(3)]
        np.testing.assert_allclose(gradient, change, rtol=1e-6, atol=1e-12)


def convergence_times(lambda_, alpha, f_plus, position, velocity, disturbance, duration, step, tolerance=1e-3):
    """Simulate x1' = x2 - lambda sqrt|x1| sign x1, x2' = d - alpha sign x1, for lanes of cases.

    A small step of the set-valued terms taken implicitly, so that rest at the origin is not lost. Returns the time after
    which |x2| stays below 1e-3 of its largest value.
    """
    x, v = position.copy(), velocity.copy()
    last = np.zeros_like(x)
    largest = np.abs(v) + np.sqrt(alpha * np.abs(x))
    for i in range(int(duration / step)):
        speed = v - lambda_ * np.sqrt(np.abs(x)) * np.sign(x)
        d = f_plus * disturbance(i * step, x, speed)
        b = x + step * (v + step * d)
        reach = step * step * alpha
        beyond = np.maximum(np.abs(b) - reach, 0.0)
        x = np.sign(b) * (0.5 * (-step * lambda_ + np.sqrt((step * lambda_) ** 2 + 4.0 * beyond))) ** 2
        v = v + step * d - np.clip(b, -reach, reach) / step
        last = np.where(np.abs(v) > tolerance * largest, (i + 1) * step, last)
    return last


def apply_by_row(family, cases):
    """The disturbance whose row of so many cases is that of a function of the family."""

    def disturbance(t, x, speed):
        columns = zip(family, x.reshape(-1, cases), speed.reshape(-1, cases), strict=True)
        return np.concatenate([d(t, a, b) for d, a, b in columns])

    return disturbance


def switch_at_random(seed):
    phase = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, 40)
    rate = np.random.default_rng(seed + 1).uniform(0.5, 30.0, 40)
    return lambda t, x, speed: np.sign(np.sin(rate * t + phase))


def test_convergence_time_stays_below_the_bound_where_32_holds():
    """Under adversarial, holding, constant and random disturbances."""
    family = [
        lambda t, x, speed: np.sign(speed),
        lambda t, x, speed: np.sign(x),
        lambda t, x, speed: np.ones_like(x),
        switch_at_random(3),
    ]
    random = np.random.default_rng(7)
    f_plus = np.ones(40)
    alpha = random.uniform(1.2, 5.0, 40)
    lambda_ = np.asarray(conditions.least_lambda_davila_fridman(alpha, f_plus)) * np.exp(
        random.uniform(np.log(1.02), np.log(30.0), 40)
    )
    position, velocity = random.uniform(-0.5, 0.5, 40), random.uniform(-1.0, 1.0, 40)
    position[:15] = 0.0
    velocity[15:20] = 0.0
    bound = np.asarray(conditions.convergence_time_bound(lambda_, alpha, f_plus, position, velocity))
    assert np.all(np.isfinite(bound))
    arguments = [np.tile(column, len(family)) for column in (lambda_, alpha, f_plus, position, velocity)]
    times = convergence_times(*arguments, apply_by_row(family, 40), 12.0, 5e-4).reshape(len(family), 40)
    assert np.all(times < 11.0)
    # a thousandth of slack for the simulation's own step
    assert np.all(times <= bound * 1.001 + 1e-3)


def test_bound_is_infinite_where_32_fails():
    assert conditions.convergence_time_bound(4.2, 2.0, 1.0, 0.0, 1.0) == jnp.inf
    assert conditions.convergence_time_bound(4.3, 2.0, 1.0, 0.0, 1.0) < jnp.inf


WORST, SLOWEST = compile_function(conditions.convergence_time_worst), compile_function(conditions.slowest_ray)


def draw_convergent_gains(seed, nearest=1.02, farthest=40.0):
    """Gains from just above the exact condition to far above, with bounds of several sizes."""
    random = np.random.default_rng(seed)
    f_plus = np.exp(random.uniform(-1.0, 1.0, LANES))
    alpha = f_plus * (1.0 + np.exp(random.uniform(np.log(0.02), np.log(20.0), LANES)))
    above = np.exp(random.uniform(np.log(nearest), np.log(farthest), LANES))
    return np.asarray(LEAST["exact"](alpha, f_plus)) * above, alpha, f_plus


def root_ray(lambda_, alpha, f_plus):
    """The slower of the rays along which d = +f leads to the origin; nan where there is none."""
    inside = lambda_**2 - 8.0 * (alpha - f_plus)
    return 0.5 * (np.sqrt(np.where(inside >= 0.0, inside, np.nan)) - lambda_)


def switch_at_ray(ray):
    """The disturbance that pushes outwards until |x1|' = ray sqrt|x1|, and homewards from there on."""

    def disturbance(t, x, speed):
        side = np.where(x == 0.0, np.sign(speed), np.sign(x))
        return np.where(side * speed > ray * np.sqrt(np.abs(x)), side, -side)

    return disturbance


HALF_CYCLE = jax.jit(lambda *arguments, ray, homeward: half_cycle(*arguments, ray=ray, homeward=homeward))


def total_time(cycle):
    """Time of half cycles without end, from the first one at unit speed; nan where they do not converge."""
    ratio = np.asarray(cycle.ratio)
    return np.where(ratio < 1.0, np.asarray(cycle.time) / np.where(ratio < 1.0, 1.0 - ratio, 1.0), np.nan)


def test_worst_time_is_that_of_simulated_half_cycles_and_of_no_other_ray():
    gains = draw_convergent_gains(0)
    zeros, unit = np.zeros(LANES), np.ones(LANES)
    worst, ray, root = np.asarray(WORST(*gains, zeros, unit)), np.asarray(SLOWEST(*gains)), root_ray(*gains)
    at_root = np.isclose(ray, root, rtol=1e-6, atol=0.0)
    assert 50 < at_root.sum() < 250
    assert np.all(ray <= 0.0)
    slowest_cycle = HALF_CYCLE(*gains, ray=np.where(at_root, 0.0, ray), homeward=np.where(at_root, 1.0, -1.0))
    np.testing.assert_allclose(total_time(slowest_cycle), worst, rtol=1e-4)
    # every other ray: as shares of the root's, or of all directions where there is none
    times = [total_time(HALF_CYCLE(*gains, ray=zeros, homeward=unit))]
    for share in np.linspace(0.0, 1.0, 100, endpoint=False):
        rays = np.where(np.isnan(root), -np.sqrt(gains[1]) * share / (1.0 - share), share * root)
        times.append(total_time(HALF_CYCLE(*gains, ray=rays, homeward=-unit)))
    longest = np.nanmax(times, axis=0)
    assert np.all(longest <= worst * (1.0 + 1e-4))
    assert np.all(longest >= worst * (1.0 - 1e-3))


def test_no_disturbance_takes_longer_than_the_worst_and_the_slowest_takes_as_long():
    """The implicit scheme of small steps follows each case from many starts; its error is the allowance."""
    gains, start = draw_convergent_gains(5, nearest=1.3), draw_starts(5)
    columns = (*gains, *start, SLOWEST(*gains), WORST(*gains, *start))
    # each case has its worst time as unit
    lambda_, alpha, f_plus, position, velocity, ray, unit = (np.asarray(c)[::12] for c in columns)
    cases, random = len(unit), np.random.default_rng(11)
    lambda_, alpha, f_plus, velocity = lambda_ * unit, alpha * unit**2, f_plus * unit**2, velocity * unit
    ray = ray * unit
    levels = random.uniform(-1.0, 1.0, (2, 1000, cases))
    signs, phases = np.sign(levels[0]), random.uniform(0.0, 2.0 * np.pi, (2, cases))
    root = root_ray(lambda_, alpha, f_plus)
    at_root = np.isclose(ray, root, rtol=1e-6)
    # where the slowest holds on along the root's ray, starts beyond it go home at once or return to it
    slowest = [switch_at_ray(np.where(at_root, beyond, ray)) for beyond in (1.1 * root, -lambda_ - root)]
    first_side = np.where(position == 0.0, np.sign(velocity), np.sign(position))

    def push_until(until):
        def disturbance(t, x, speed):
            at_first = np.sign(x) == first_side
            return np.where(at_first, first_side if t < until else -first_side, slowest[1](t, x, speed))

        return disturbance

    family = [
        *slowest,
        *(push_until(until) for until in (0.03, 0.1, 0.3)),
        *(switch_at_ray(-share * np.sqrt(alpha)) for share in (0.0, 0.1, 0.3, 1.0, 3.0)),
        lambda t, x, speed: np.sign(x),
        lambda t, x, speed: np.ones_like(x),
        lambda t, x, speed: -np.ones_like(x),
        lambda t, x, speed: levels[1, int(t / 0.02)],
        lambda t, x, speed: signs[int(t / 0.002)],
        lambda t, x, speed: np.sin(2.0 * np.pi * 3.0 * t + phases[0]),
        lambda t, x, speed: np.sin(2.0 * np.pi * 30.0 * t + phases[1]),
    ]
    arguments = [np.tile(column, len(family)) for column in (lambda_, alpha, f_plus, position, velocity)]
    times = convergence_times(*arguments, apply_by_row(family, cases), 1.1, 5e-5, tolerance=1e-4).reshape(len(family), cases)
    # a step too long in one arc lasts as much longer in the next as it is slower
    allowance = 1e-3 + 1e-4 * (alpha + f_plus) / (alpha - f_plus)
    assert np.all(times <= 1.0 + allowance)
    # over many half cycles the scheme's own damping adds up
    few = np.asarray(RATIO(lambda_, alpha, f_plus)) < 0.5
    assert few.sum() > 15
    assert np.all(np.abs(times[:2].max(axis=0) - 1.0)[few] <= 3.0 * allowance[few])


def draw_starts(seed):
    """Errors at t = 0, some of them in position or velocity alone."""
    position, velocity = np.random.default_rng(seed).uniform(-1.0, 1.0, (2, LANES))
    position[:50], velocity[50:100] = 0.0, 0.0
    return position, velocity


@pytest.mark.parametrize("scale", [1e-3, 0.3, 50.0])
def test_worst_time_is_homogeneous_and_odd(scale):
    lambda_, alpha, f_plus = draw_convergent_gains(4)
    position, velocity = draw_starts(4)
    time = WORST(lambda_, alpha, f_plus, position, velocity)
    np.testing.assert_allclose(WORST(lambda_, alpha, f_plus, -position, -velocity), time, rtol=1e-12)
    # lengths go with the square of times
    np.testing.assert_allclose(WORST(lambda_, alpha, f_plus, scale**2 * position, scale * velocity), scale * time, rtol=1e-6)
    root = np.sqrt(scale)
    scaled = WORST(root * lambda_, scale * alpha, scale * f_plus, scale * position, scale * velocity)
    np.testing.assert_allclose(scaled, time, rtol=1e-6)


def test_worst_time_lies_below_the_bound():
    lambda_, alpha, f_plus = draw_convergent_gains(6, farthest=300.0)
    start = draw_starts(6)
    bound, worst = (np.asarray(f(lambda_, alpha, f_plus, *start)) for f in (BOUND, WORST))
    assert np.all(np.isfinite(worst))
    assert 50 < np.isfinite(bound).sum() < 250
    assert np.all(worst <= bound * (1.0 + 1e-9))


def test_worst_time_is_infinite_where_peaks_do_not_fall():
    lambda_, alpha, f_plus = draw_convergent_gains(2, nearest=1.0 + 1e-6, farthest=1.0 + 1e-5)
    start = np.zeros(LANES), np.ones(LANES)
    assert np.all(np.isfinite(WORST(lambda_, alpha, f_plus, *start)))
    assert np.all(np.asarray(WORST(lambda_ * (1.0 - 1e-4), alpha, f_plus, *start)) == np.inf)
    assert np.all(np.asarray(SLOWEST(lambda_ * (1.0 - 1e-4), alpha, f_plus)) == 0.0)
    assert np.all(np.asarray(WORST(lambda_, f_plus, f_plus, *start)) == np.inf)
    # nothing to converge from
    assert np.all(np.asarray(WORST(lambda_, alpha, f_plus, start[0], start[0])) == 0.0)


def test_derivatives_of_the_worst_time():
    position, velocity = np.random.default_rng(1).uniform(-1.0, 1.0, (2, LANES))
    arguments = [*draw_convergent_gains(0), position, velocity]
    derivatives = jax.jit(jax.grad(lambda *x: jnp.sum(conditions.convergence_time_worst(*x)), (0, 1, 2, 3, 4)))(*arguments)
    for k, gradient in enumerate(derivatives):
        step = 1e-6 * np.abs(arguments[k])
        above, below = (WORST(*(x + s * step if i == k else x for i, x in enumerate(arguments))) for s in (1.0, -1.0))
        change = np.asarray(above - below) / (2.0 * step)
        scale = np.asarray(WORST(*arguments)) / np.abs(arguments[k])
        np.testing.assert_allclose(gradient / scale, change / scale, rtol=1e-3, atol=1e-5)


def test_worst_time_in_float32():
    gains = draw_convergent_gains(8, nearest=1.2)
    start = np.zeros(LANES), np.ones(LANES)
    times = WORST(*(jnp.asarray(x, jnp.float32) for x in (*gains, *start)))
    assert times.dtype == jnp.float32
    np.testing.assert_allclose(times, WORST(*gains, *start), rtol=2e-3)
