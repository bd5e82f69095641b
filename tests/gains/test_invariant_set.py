"""Sets that are never left: against the observer's own step, all sequences of a short horizon, and known bounds."""

import itertools
from decimal import Decimal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differentiation_bound import least_worst_error
from error_steps import step_errors

from jaxbl.errors import NoResult
from jaxbl.gains.adversary import explore_errors
from jaxbl.gains.invariant_set import ErrorSystem, _Rows, prove
from jaxbl.observer.conditions import convergence_time_worst

SYSTEMS = [
    ErrorSystem(implicit, lambda_, alpha, noise, 0.0 if implicit else push)
    for implicit in (True, False)
    for lambda_, alpha, noise, push in (
        (1.5, 1.1, 0.0, 0.0),
        (1.0, 1.84, 1.3, 0.5),
        (2.0, 4.0, 20.0, 2.0),
        (8.0, 60.0, 3.0, 0.0),
    )
]


def draw_pushes(rng, n, parts=64):
    """Mean and moment of accelerations that change at any time within a period."""
    kinds = rng.integers(0, 3, n)
    w = rng.uniform(-1.0, 1.0, (n, parts))
    switch, sign = rng.random(n)[:, None], np.sign(rng.normal(size=n))[:, None]
    points = (np.arange(parts) + 0.5) / parts
    w = np.where(kinds[:, None] == 0, w, np.where(points < switch, sign, -sign))
    w = np.where(kinds[:, None] == 2, sign, w)
    return w.mean(axis=1), (w * (1.0 - points)).mean(axis=1)


@pytest.mark.parametrize("system", SYSTEMS, ids=str)
def test_image_holds_whatever_the_adversary_does(system):
    rng = np.random.default_rng(7)
    rows = _Rows(system, 0.3, 60.0 + 6.0 * system.alpha)
    # any symmetric set: upper bounds that need not agree from row to row
    upper = np.full(2 * rows.half_count, -np.inf)
    middle = rng.uniform(5.0, 80.0, 60)
    upper[rows.half_count - 30 : rows.half_count + 30] = middle
    lower = -upper[::-1]
    image, bound = rows.map_set(upper)
    n = 50_000
    k = rng.integers(rows.half_count - 30, rows.half_count + 30, n)
    share = np.where(rng.random(n) < 0.5, rng.integers(0, 2, n), rng.random(n))
    e = lower[k] + share * (upper[k] - lower[k])
    g = (k - rows.half_count + np.where(rng.random(n) < 0.3, rng.integers(0, 2, n), rng.random(n))) * rows.dg
    noise = system.noise * np.where(rng.random(n) < 0.5, np.sign(rng.normal(size=n)), rng.uniform(-1.0, 1.0, n))
    mean, moment = draw_pushes(rng, n)
    e, g, error = step_errors(system, e, g, noise, mean, moment, system.push * np.sign(rng.normal(size=n)))
    assert error.max() <= bound * (1.0 + 1e-12)
    # ends of rows belong to both
    row = np.floor(g / rows.dg).astype(int) + rows.half_count
    on_end = np.abs(g / rows.dg - np.round(g / rows.dg)) < 1e-9
    inside = np.zeros(n, bool)
    for other in (row, row - 1, row + 1):
        near = (other == row) | on_end
        inside |= near & (e <= image[other] + 1e-9) & (e >= -image[::-1][other] - 1e-9)
    assert inside.all()


def test_rounding_errors_of_large_numbers_stay_inside():
    """Double precision resolves hundredths of the lattice at 1e14: the exact successors are still in the image."""
    system, rng = ErrorSystem(False, 2.0, 4.0, 20.0), np.random.default_rng(5)
    rows = _Rows(system, 0.25, 400.0)
    assert rows.dg == 0.25
    upper = np.full(2 * rows.half_count, -np.inf)
    k = np.arange(rows.half_count - 1500, rows.half_count + 1500)
    upper[k] = rng.uniform(0.5e14, 1.5e14, len(k)).round() * rows.lattice
    image = rows.map_set(upper)[0]
    for row in k:
        # from the upper end of the row, by the least noise and the largest acceleration: u = a
        e, g = Decimal(upper[row]), Decimal(float(row - rows.half_count + 1) * rows.dg)
        exact = e - 2 * (e - 20).sqrt() + g + Decimal("0.5")
        assert Decimal(image[row - rows.alpha + rows.push]) >= exact


@pytest.mark.parametrize("system", SYSTEMS, ids=str)
def test_no_sequence_of_a_short_horizon_exceeds_the_bounds(system):
    proof = prove(system, 2.0, 5.0)
    pushes = ((1.0, 0.5), (-1.0, -0.5), (0.0, 0.25))
    choices = np.array([(n, m, q, c) for n in (-1.0, 1.0) for m, q in pushes for c in (-1.0, 1.0)[: 1 + (system.push > 0)]])
    # other signs are mirror images
    for start in ((0.0, 0.0), (2.0, 5.0), (-2.0, 5.0)):
        e, g = (np.full(1, number) for number in start)
        for k in range(4 if system.push else 5):
            pairs = np.array(list(itertools.product(range(len(e)), range(len(choices)))))
            taken = choices[pairs[:, 1]]
            new_e, new_g, error = step_errors(
                system, e[pairs[:, 0]], g[pairs[:, 0]], system.noise * taken[:, 0], *taken[:, 1:3].T,
                system.push * taken[:, 3],
            )  # fmt: skip
            assert error.max() <= proof.bounds[min(k, len(proof.bounds) - 1)] * (1.0 + 1e-12)
            if start == (0.0, 0.0):
                assert error.max() <= proof.bounds[-1] * (1.0 + 1e-12)
            e, g = new_e, new_g


@pytest.mark.parametrize("system", SYSTEMS, ids=str)
def test_bounds_fall_and_stay_above_what_is_possible_at_all(system):
    proof = prove(system, 0.0, 1.0)
    assert (np.diff(proof.bounds) <= 0.0).all()
    # no differentiator does better than that, whatever its gains
    assert proof.bounds[-1] >= least_worst_error(system.noise, 1.0, 1.0)


@pytest.mark.parametrize(("noise", "ratio"), [(0.0, 1.17), (1.0, 1.47), (10.0, 1.7), (100.0, 1.75)])
def test_bound_is_near_what_is_possible_at_all(noise, ratio):
    bound = prove(ErrorSystem(True, 1.5, 1.1, noise), noise, 0.0).bounds[-1]
    assert bound <= ratio * least_worst_error(noise, 1.0, 1.0)


@pytest.mark.parametrize("noise", [1.0, 100.0])
@pytest.mark.parametrize("implicit", [True, False])
def test_finer_rows_only_tighten(implicit, noise):
    system = ErrorSystem(implicit, 1.2, 1.5, noise)
    coarse, fine = (prove(system, noise, 0.0, finest=finest).bounds[-1] for finest in (0.08, 0.02))
    assert fine <= coarse <= 1.15 * fine


@pytest.mark.parametrize(
    ("lambda_", "alpha", "speed", "within"), [(1.5, 1.1, 100.0, 0.02), (2.0, 4.0, 300.0, 0.05), (1.0, 1.84, 600.0, 0.05)]
)
def test_reaching_time_without_noise_is_that_of_continuous_time(lambda_, alpha, speed, within):
    # at speeds far above f⁺ T; sampling ends the last half cycles earlier
    proof = prove(ErrorSystem(True, lambda_, alpha, 0.0), 0.0, speed, finest=0.05)
    with jax.enable_x64(True):
        time = float(convergence_time_worst(*(jnp.asarray(x) for x in (lambda_, alpha, 1.0, 0.0, speed))))
    reaching_sample = int((proof.bounds <= 1.05 * proof.bounds[-1]).argmax())
    assert reaching_sample == pytest.approx(time, rel=within)


def test_forward_euler_with_a_large_lambda_has_a_set():
    """It swings between ±lambda² / 4, far beyond what the start makes of it."""
    system = ErrorSystem(False, 20.0, 1.5, 0.0)
    bound = prove(system, 1.0, 0.0, finest=0.05).bounds[-1]
    with jax.enable_x64(True):
        worst_errors, _ = explore_errors(system)
    assert 50.0 < worst_errors.worst <= bound <= 1.1 * worst_errors.worst


@pytest.mark.parametrize("implicit", [True, False])
def test_gains_that_do_not_converge_have_no_set(implicit):
    with pytest.raises(NoResult, match="grow without end"):
        prove(ErrorSystem(implicit, 0.1, 2.0, 0.0), 0.0, 20.0, finest=0.1)


def test_sets_of_one_height_cover_those_of_another():
    system, rng = SYSTEMS[1], np.random.default_rng(3)
    coarse, fine = _Rows(system, 0.5, 40.0), _Rows(system, 0.07, 40.0)
    upper = np.full(2 * coarse.half_count, -np.inf)
    upper[coarse.half_count - 20 : coarse.half_count + 20] = rng.uniform(1.0, 9.0, 40)
    covered = fine.cover_set(coarse, upper)
    g = rng.uniform(-19.9, 19.9, 10_000) * coarse.dg
    points = [np.floor(g / rows.dg).astype(int) + rows.half_count for rows in (coarse, fine)]
    assert (covered[points[1]] >= upper[points[0]]).all()
    assert covered.max() <= upper.max() + fine.lattice * (1.0 + 1e-6)
