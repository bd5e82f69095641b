"""A transmission alone on a test rig: what its torque over displacement says, and where it says nothing."""

import numpy as np
import pytest
from measured import simulate_band

from jaxbl.records import element
from jaxbl.records.element import RigLog, fit_element

PERIOD, STIFFNESS, GAP, CENTRE, FRICTION, TORQUE, LENGTH = 0.01, 500.0, 0.02, 0.005, 0.8, 2.0, 0.01


def simulate_rig(count=2400, seed=1, gap=GAP):
    """Displacement (rad) and torque (N m) of a shaft with a gap, hysteresis and dry friction; noise on both."""
    random, fine = np.random.default_rng(seed), 20
    t = PERIOD / fine * np.arange(count * fine)
    x = 0.06 * np.sin(2.0 * np.pi * 0.4 * t) * (0.5 + 0.5 * t / t[-1])
    deflection = x - CENTRE
    deflection = deflection - np.clip(deflection, -gap, gap)
    h = np.zeros(len(t))
    for i, step in enumerate(np.diff(deflection) / LENGTH):
        h[i + 1] = h[i] + step * (1.0 - h[i] ** 2 if h[i] * step > 0.0 else 1.0)
    u = STIFFNESS * deflection + TORQUE * h + FRICTION * np.sign(np.gradient(x, t)) + 0.3
    x, u = x[::fine], u[::fine]
    return x + 1e-5 * random.standard_normal(count), u + 0.1 * random.standard_normal(count)


def test_a_gap_hysteresis_and_friction_are_told_apart():
    x, u = simulate_rig()
    fit = fit_element(RigLog(x, u, [slice(0, 1300), slice(1300, 2400)], PERIOD, 1e-5))
    assert set(fit.model.terms) == {"gap", "dry friction", "hysteresis"}
    truth = {
        "stiffness": STIFFNESS, "half_gap": GAP, "centre": CENTRE, "dry_friction": FRICTION, "hysteresis": TORQUE,
        "length": LENGTH, "offset": 0.3,
    }  # fmt: skip
    assert set(fit.numbers) == set(truth)
    for name, value in truth.items():
        number = fit.numbers[name]
        # 3.5 standard errors of eleven degrees of freedom: one in two hundred
        assert abs(number.value - value) < 3.5 * number.standard_error, (name, number)
        assert name == "offset" or abs(number.value / value - 1.0) < 0.05, (name, number)
    assert fit.residual == pytest.approx(0.1, rel=0.1)
    assert fit.numbers["stiffness"].unit == "N m/rad"
    assert np.isnan(fit.torque[:20]).all() and np.nanstd(fit.torque - u) < 0.11


def test_play_spring_and_slip_in_series(repeats):
    random = np.random.default_rng(46)
    for _ in range(repeats(3, 30)):
        x, force, truth = simulate_band(random)
        fit = fit_element(RigLog(x, force, [slice(0, len(x))], PERIOD, 0.0, "m"))
        assert set(fit.model.terms) == {"gap", "slip"} and not fit.open
        for name, value in truth.items():
            number = fit.numbers[name]
            assert abs(number.value / value - 1.0) < 0.05, (name, number, value)
            assert abs(number.value - value) < 5.0 * number.standard_error + 2e-3 * value, (name, number, value)
        assert fit.numbers["slip"].unit == "N" and "centre" not in fit.numbers


def test_a_shaft_is_a_shaft_and_one_way_says_nothing():
    random = np.random.default_rng(2)
    x = 0.01 * np.sin(2.0 * np.pi * 0.3 * PERIOD * np.arange(2000))
    u = 3.0e4 * x + random.standard_normal(2000)
    fit = fit_element(RigLog(x, u, [slice(0, 2000)], PERIOD, 0.0, "m"))
    assert fit.model.terms == () and fit.numbers["stiffness"].unit == "N/m"
    low, high = fit.numbers["stiffness"].interval
    assert low < 3.0e4 < high < 1.01 * 3.0e4
    one_way = RigLog(0.001 * np.arange(500.0), np.arange(500.0), [slice(0, 500)], PERIOD, 0.0)
    assert fit_element(one_way) is None


def test_a_rest_behind_a_gap_of_a_long_log_is_left_out(monkeypatch):
    """A long log is averaged: a short part behind a gap then has a single sample, or none."""
    monkeypatch.setattr(element, "_MAX_SAMPLES", 500)
    x = 0.01 * np.sin(2.0 * np.pi * 0.3 * PERIOD * np.arange(4003))
    u = 3.0e4 * x + np.random.default_rng(2).standard_normal(4003)
    for parts in ([slice(0, 4000), slice(4000, 4003)], [slice(0, 3), slice(3, 4003)]):
        fit = fit_element(RigLog(x, u, parts, PERIOD, 0.0, "m"))
        assert fit is not None and fit.numbers["stiffness"].value == pytest.approx(3.0e4, rel=0.01)
