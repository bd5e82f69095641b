"""Figures on the samples of a log, against signals whose truth is known."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from jaxbl.records import signal_quality

RANDOM = np.random.default_rng(3)


@settings(max_examples=60, deadline=None)
@given(st.floats(1e-7, 1e3), st.integers(2, 400), st.floats(-10.0, 10.0))
def test_resolution_of_stepped_values(step, levels, offset):
    values = (np.random.default_rng(levels).integers(0, levels, 2000) + offset) * step
    assert signal_quality.find_resolution(values) == pytest.approx(step, rel=1e-6)


def test_continuous_values_have_no_resolution():
    for values in (RANDOM.standard_normal(3000), np.sin(0.01 * np.arange(3000)), np.zeros(10), np.zeros(0)):
        assert signal_quality.find_resolution(values) == 0.0
    # steps that are there, under noise of floating-point arithmetic
    values = 0.1 * RANDOM.integers(0, 50, 3000) * (1.0 + 1e-15 * RANDOM.standard_normal(3000))
    assert signal_quality.find_resolution(values) == pytest.approx(0.1)


@pytest.mark.parametrize("noise", [1e-5, 1e-2])
@pytest.mark.parametrize("period", [1e-4, 1e-2])
def test_noise_floor_under_a_large_slow_motion(noise, period):
    time = period * np.arange(8000)
    values = 10.0 * np.sin(2.0 * np.pi * 0.004 / period * time) + noise * RANDOM.standard_normal(len(time))
    floor = signal_quality.noise_floor(*signal_quality.power_spectrum(values, period))
    assert np.sqrt(floor * 0.5 / period) == pytest.approx(noise, rel=0.1)


def test_spectrum_has_the_power_of_the_signal():
    period = 2e-3
    time = period * np.arange(20000)
    values = 3.0 * np.sin(2.0 * np.pi * 20.0 * time)
    frequency, density = signal_quality.power_spectrum(values, period)
    for spectrum, power in ((density, 4.5), (density * (2.0 * np.pi * frequency) ** 2, 4.5 * (2.0 * np.pi * 20.0) ** 2)):
        assert spectrum.sum() * frequency[0] == pytest.approx(power, rel=0.03)
        assert frequency[np.argmax(spectrum)] == pytest.approx(20.0, abs=frequency[0])


def test_bandwidth_leaves_noise_and_steps_out():
    time = 1e-3 * np.arange(10000)
    motion = np.sin(2.0 * np.pi * 1.5 * time) + 0.2 * np.sin(2.0 * np.pi * 9.0 * time)
    for values in (motion, motion + 1e-3 * RANDOM.standard_normal(10000), np.round(motion / 1e-3) * 1e-3):
        # velocity: 1.5² against (0.2 · 9)²
        assert signal_quality.find_bandwidth(values, 1e-3, differentiate=True) == pytest.approx(9.0, abs=0.6)
        assert signal_quality.find_bandwidth(values, 1e-3, differentiate=False) == pytest.approx(1.5, abs=0.6)
    assert signal_quality.find_bandwidth(RANDOM.standard_normal(10000), 1e-3, differentiate=False) == 0.0


def test_stays_at_an_extreme_value():
    values = np.clip(2.0 * np.sin(0.01 * np.arange(5000)), -1.0, 1.0)
    assert signal_quality.saturated_share(values, 0.0) == pytest.approx(2.0 / 3.0, abs=0.03)
    assert signal_quality.saturated_share(np.sin(0.01 * np.arange(5000)), 0.0) == 0.0
    # a rest before the start is no saturation
    assert signal_quality.saturated_share(np.concatenate([np.zeros(100), 0.01 * np.arange(1000)]), 0.0) == 0.0
    assert signal_quality.saturated_share(np.ones(10), 0.0) == 0.0


@pytest.mark.parametrize("step", [0.0, 1e-3])
def test_jumps_stand_out_of_the_motion(step):
    time = 1e-3 * np.arange(6000)
    motion = np.sin(2.0 * np.pi * 1.5 * time) + 0.2 * np.sin(2.0 * np.pi * 9.0 * time)
    # corners of the speed and a rest are motion
    motion = np.where(time < 2.0, motion, motion[2000] + 2.0 * np.abs((time - 2.0) % 1.0 - 0.5) - 1.0)
    motion[5500:] = motion[5500]
    stepped = np.round(motion / step) * step if step else motion
    assert signal_quality.count_jumps(stepped, step, time) == 0
    for rows, size in ((700, 0.3), (1500, -0.2), (5800, 0.05)):
        stepped[rows] += size
    stepped[3300:] += 0.2
    assert signal_quality.count_jumps(stepped, step, time) == 4


def test_low_pass_has_no_delay():
    time = 1e-3 * np.arange(5000)
    slow, fast = np.sin(2.0 * np.pi * time), np.sin(2.0 * np.pi * 200.0 * time)
    filtered = signal_quality.low_pass(slow + fast, 20.0, 1e-3)
    np.testing.assert_allclose(filtered[500:-500], slow[500:-500], atol=2e-3)
    assert signal_quality.low_pass(fast, 450.0, 1e-3) is fast
