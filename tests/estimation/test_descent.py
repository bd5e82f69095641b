"""The descent of all fits, on a problem whose solution is known."""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.optimize import least_squares

from jaxbl.estimation.descent import descend, linearise


class Point(NamedTuple):
    numbers: np.ndarray
    residual: np.ndarray
    slope: np.ndarray
    deviance: float


def evaluate(numbers, prior=0.0):
    """Rosenbrock's valley; its model ends beyond 3."""
    x, y = numbers
    residual = np.array([10.0 * (y - x**2), 1.0 - x])
    slope = np.array([[-20.0 * x, 10.0], [-1.0, 0.0]])
    deviance = np.sum(residual**2) + prior * np.sum(numbers**2) if x < 3.0 else np.inf
    return Point(numbers, residual, slope, deviance)


def run(start, most_steps=100, prior=0.0, settled=1e-12):
    return descend(
        evaluate(np.array(start), prior),
        lambda point: linearise(point.residual, point.slope, point.numbers, np.full(2, prior)),
        lambda point, change: evaluate(point.numbers + change, prior),
        most_steps,
        lambda _: settled,
    )


@pytest.mark.parametrize("start", [(-1.2, 1.0), (2.9, -4.0)])
def test_it_ends_in_the_valley(start):
    best, ended = run(start)
    assert ended
    np.testing.assert_allclose(best.numbers, 1.0, atol=1e-5)


def test_a_prior_is_part_of_it():
    prior = 0.3
    expected = least_squares(lambda x: np.append(evaluate(x).residual, np.sqrt(prior) * x), [0.1, 0.1], xtol=1e-12).x
    np.testing.assert_allclose(run((-1.2, 1.0), prior=prior)[0].numbers, expected, rtol=1e-4)


def test_steps_that_gain_are_counted_and_a_model_that_diverges_has_none():
    first, ended = run((-1.2, 1.0), most_steps=1)
    assert not ended and first.deviance < evaluate(np.array([-1.2, 1.0])).deviance
    best, ended = run((4.0, 1.0))
    assert not ended and best.numbers[0] == 4.0
