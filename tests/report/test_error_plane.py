"""The error in its phase plane, beside the majorant of the proof."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from small_study import small

from jaxbl.observer.conditions import peak_ratio
from jaxbl.report.error_plane import error_peaks, error_plane, worst_half_cycle
from jaxbl.sweeps.trial import run


def test_peaks_of_a_damped_error_and_none_of_its_chatter():
    t, turns = np.arange(0.0, 6.0, 1e-3), 8.0
    error = np.exp(-t) * np.sin(turns * t)
    rate = np.exp(-t) * (turns * np.cos(turns * t) - np.sin(turns * t))
    at, peaks = error_peaks(error, rate)
    # slopes at the zeros k pi / turns; those of the last quarter's size are left out
    np.testing.assert_allclose(
        peaks, turns * (-1.0) ** np.arange(len(peaks)) * np.exp(-np.arange(len(peaks)) * np.pi / turns), rtol=1e-3
    )
    np.testing.assert_allclose(t[at], np.arange(len(peaks)) * np.pi / turns, atol=1e-3)
    assert 6 < len(peaks) < 14


def test_the_majorant_is_drawn_with_its_ratio_and_the_error_stays_inside():
    trial = run(
        small(
            {
                "observer.motor": {"lambda": 6.0, "alpha": 9.0, "velocity_error": 0.5},
                "encoders.noise": 0.0,
                "run.duration": 1.0,
            }
        )
    )
    found = trial.summary["conditions"]["motor"]
    left, right = error_plane(trial.trace, "motor", found).figure.axes
    error, majorant = left.get_lines()
    # a half cycle drops from its largest error to the next peak (37)
    y = majorant.get_ydata()
    assert y[0] == pytest.approx(0.5, rel=0.05)
    assert -y[101] / y[0] == pytest.approx(found["least_lambda"]["davila_fridman"] / found["lambda"], rel=1e-6)
    assert np.abs(error.get_xdata()).max() <= np.abs(majorant.get_xdata()).max()
    labels = [line.get_label() for line in right.get_lines()]
    assert labels[2] == f"exact worst case: ratio {found['peak_ratio']:.3g}"
    assert labels[0].startswith("run: ")


@pytest.mark.parametrize(("lambda_", "alpha"), [(0.9, 1.5), (0.01, 1.2), (2.0, 9.0)])
def test_the_worst_path_is_that_of_its_equation_and_ends_at_its_ratio(lambda_, alpha):
    x, v = worst_half_cycle(lambda_, alpha, 1.0)
    assert -v[-1] == pytest.approx(float(peak_ratio(lambda_, alpha, 1.0)), rel=1e-6)

    # down from the largest error, where the square root is no trouble
    def slope(t, state):
        return [state[1], -alpha - 1.0 - 0.5 * lambda_ * state[1] / np.sqrt(state[0])]

    def there(t, state):
        return state[0] - x[half]

    there.terminal = True
    turn = int(np.argmax(x))
    half = turn + np.flatnonzero(x[turn:] < 0.5 * x[turn])[0]
    solved = solve_ivp(slope, (0.0, 10.0), [x[turn], 0.0], rtol=1e-10, atol=1e-14, events=there, max_step=0.01)
    assert solved.y_events[0][0, 1] == pytest.approx(v[half], rel=1e-6)


def test_a_path_along_a_ray_ends_at_the_origin():
    x, v = worst_half_cycle(6.0, 2.0, 1.0)
    assert float(peak_ratio(6.0, 2.0, 1.0)) == 0.0
    assert x[-1] < 1e-6 and abs(v[-1]) < 1e-3
