"""The error in its phase plane: peaks, the worst path against SciPy, the majorant of the proof."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jaxbl.gains.phase_plane import error_peaks, error_slope, majorant
from jaxbl.observer.conditions import arc_integral, least_lambda_davila_fridman, peak_ratio
from jaxbl.sweeps.elementwise import call_in_float64


def worst_half_cycle(lambda_: float, alpha: float, f_plus: float, points: int = 1001) -> tuple[np.ndarray, np.ndarray]:
    """The outermost path of (34) from e = 0 with slope 1 rad/s to e = 0 again: e (rad) and its slope (rad/s).

    With y = sqrt(e) and a slope of p y, y sqrt(p^2 + lambda p + c) falls by exp(-(lambda / 2) arc)
    (docs/theory_appendix.md); c is 2 (alpha - f) on the way out and 2 (alpha + f) on the way back. It ends with the ratio of
    :func:`jaxbl.observer.conditions.peak_ratio`. Needs alpha > f.
    """
    half, size, es, slopes = 0.5 * lambda_, 1.0, [], []
    c1, c2 = 2.0 * (alpha - f_plus), 2.0 * (alpha + f_plus)
    # out and back, by the angle of p
    for c, first, last in ((c1, 0.5 * np.pi, 0.0), (c2, 0.0, -0.5 * np.pi)):
        angle = np.linspace(first, last, points)
        sine, cosine = np.sin(angle), np.cos(angle)
        arc = call_in_float64(arc_integral, sine + half * cosine, cosine, c - half**2)
        # the first point out has an arc of zero; where the arc is endless, the path has ended at the origin
        level = size * np.exp(-half * (arc - arc[0]))
        form = np.where(level > 0.0, sine**2 + lambda_ * sine * cosine + c * cosine**2, 1.0)
        es.append((level * cosine) ** 2 / form)
        slopes.append(level * sine / np.sqrt(form))
        size = level[-1] * np.sqrt(c2 / c1)
    return np.concatenate(es), np.concatenate(slopes)


def test_peaks_of_a_damped_error_and_none_of_its_chatter():
    t, turns = np.arange(0.0, 6.0, 1e-3), 8.0
    error = np.exp(-t) * np.sin(turns * t)
    rate = np.exp(-t) * (turns * np.cos(turns * t) - np.sin(turns * t))
    crossings, peaks = error_peaks(error, rate, 40)
    # slopes at the zeros k pi / turns; those of the last quarter's size are left out
    zeros = np.arange(len(peaks)) * np.pi / turns
    np.testing.assert_allclose(peaks, turns * np.cos(turns * zeros) * np.exp(-zeros), rtol=1e-3)
    np.testing.assert_allclose(t[crossings], zeros, atol=1e-3)
    assert 6 < len(peaks) < 14
    assert len(error_peaks(error, rate, 5)[1]) == 5


def test_the_slope_has_the_square_root_term():
    np.testing.assert_allclose(error_slope(np.array([0.0, 4.0, -9.0]), np.ones(3), 2.0), [1.0, -3.0, 7.0])


@pytest.mark.parametrize(("lambda_", "alpha"), [(0.9, 1.5), (0.01, 1.2), (2.0, 9.0), (4.0, 1.5)])
def test_the_worst_path_is_that_of_its_equation_and_ends_at_its_ratio(lambda_, alpha):
    x, v = worst_half_cycle(lambda_, alpha, 1.0)
    assert -v[-1] == pytest.approx(float(peak_ratio(lambda_, alpha, 1.0)), rel=1e-12)

    # down from the largest error, where the square root is no trouble
    def derivatives(t, state):
        return [state[1], -alpha - 1.0 - 0.5 * lambda_ * state[1] / np.sqrt(state[0])]

    def reaches_half(t, state):
        return state[0] - x[half]

    reaches_half.terminal = True
    turn = int(np.argmax(x))
    half = turn + np.flatnonzero(x[turn:] < 0.5 * x[turn])[0]
    solved = solve_ivp(derivatives, (0.0, 10.0), [x[turn], 0.0], rtol=1e-11, atol=1e-14, events=reaches_half, max_step=0.01)
    assert solved.y_events[0][0, 1] == pytest.approx(v[half], rel=1e-8)


def test_a_path_along_a_ray_ends_at_the_origin():
    x, v = worst_half_cycle(6.0, 2.0, 1.0)
    assert float(peak_ratio(6.0, 2.0, 1.0)) == x[-1] == v[-1] == 0.0
    assert np.all(np.isfinite(x)) and np.all(np.isfinite(v)) and np.all(x >= 0.0)


@pytest.mark.parametrize("lambda_", [2.0, 9.0])
def test_the_majorant_lies_outside_of_the_worst_path(lambda_):
    alpha, f_plus, peak = 3.0, 1.0, 0.5
    e, slope = majorant(peak, lambda_, alpha, f_plus)
    ratio = float(least_lambda_davila_fridman(alpha, f_plus)) / lambda_
    # (36) on the way out, then down to (37), and the same from there
    np.testing.assert_allclose(slope[:100] ** 2, 2.0 * (alpha - f_plus) * (e[:100].max() - e[:100]), atol=1e-12)
    assert slope[0] == peak and slope[101] == pytest.approx(-ratio * peak) and e[101] == 0.0
    assert slope[203] == pytest.approx(ratio**2 * peak) and e[102:].max() <= 0.0
    x, v = (
        size * coordinate for size, coordinate in zip((peak**2, peak), worst_half_cycle(lambda_, alpha, f_plus), strict=True)
    )
    assert x.max() < e.max() and v.min() > slope[:102].min()
