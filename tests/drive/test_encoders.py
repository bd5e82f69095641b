"""Encoders: noise scaled per side, then quantised."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from jaxbl.chain import unit_noise
from jaxbl.drive import Encoders, as_arrays

RATIO = 5.0
SIDES = st.sampled_from(["motor", "load"])


def read_encoder(encoders, side, position, unit_noise=0.0, dtype=jnp.float64):
    arguments = as_arrays((encoders, float(position), float(unit_noise), RATIO), dtype)
    reading = arguments[0].measure(side, *arguments[1:])
    assert reading.dtype == dtype
    return reading


@settings(deadline=None)
@given(SIDES, st.floats(-1e3, 1e3), st.floats(1e-6, 1e-1))
def test_a_reading_is_a_whole_count_at_most_half_a_count_off(side, position, count):
    reading = read_encoder(Encoders(**{f"{side}_resolution": count}), side, position)
    assert abs(reading - position) <= 0.5 * count * (1.0 + 1e-9) + 1e-12
    counts = reading / count
    assert counts == pytest.approx(round(float(counts)), abs=1e-6)


@settings(deadline=None)
@given(SIDES, st.floats(-1e3, 1e3), st.floats(-4.0, 4.0))
def test_an_ideal_encoder_reads_the_position(side, position, unit_noise):
    assert read_encoder(Encoders(), side, position, unit_noise) == position


@pytest.mark.parametrize(
    ("side", "load_noise", "rms"),
    [("motor", None, 1e-2), ("load", None, 1e-2 / RATIO), ("load", 3e-2, 3e-2), ("load", 0.0, 0.0)],
)
def test_noise_of_each_side(side, load_noise, rms):
    encoders = Encoders(noise=1e-2, load_noise=load_noise)
    assert read_encoder(encoders, side, 1.0, -2.0) == pytest.approx(1.0 - 2.0 * rms, rel=1e-14)


def test_noise_dithers_the_counts():
    """Quantisation comes after the noise: the mean over noise finds a position between two counts."""
    encoders = as_arrays(Encoders(noise=1.0, motor_resolution=1.0), jnp.float64)
    readings = encoders.measure("motor", 0.3, jnp.asarray(np.random.default_rng(1).standard_normal(40_000)), RATIO)
    assert set(np.unique(readings)) <= set(range(-8, 9))
    assert readings.mean() == pytest.approx(0.3, abs=0.03)


def test_the_other_side_is_not_quantised_and_float32_stays_float32():
    encoders = Encoders(load_resolution=0.5)
    assert read_encoder(encoders, "motor", 0.3, dtype=jnp.float32) == jnp.float32(0.3)
    assert read_encoder(encoders, "load", 0.3, dtype=jnp.float32) == 0.5


@pytest.mark.parametrize("missed", [0.0, 1e-3, 0.05, 0.3, 1.0])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_readings_are_missed_at_random(missed, dtype):
    count = 200_000
    encoders = as_arrays(Encoders(noise=1.0, missed=missed), dtype)
    draws = unit_noise(3, jnp.arange(count), ("motor", "load"))
    lost = {}
    for side, draw in draws.items():
        readings = np.asarray(encoders.measure(side, dtype(0.0), draw, dtype(1.0)))
        assert readings.dtype == dtype
        lost[side] = np.isnan(readings)
        deviation = np.sqrt(missed * (1.0 - missed) / count)
        assert abs(lost[side].mean() - missed) <= 5.0 * deviation
        # neither the noise of what is read, nor the next sample, nor the other side has to do with it
        kept = np.asarray(draw)[~lost[side]]
        assert (readings[~lost[side]] == kept).all()
        if kept.size:
            assert abs(kept.mean()) < 5.0 / np.sqrt(kept.size) and abs(kept.std() - 1.0) < 5.0 / np.sqrt(2.0 * kept.size)
        assert abs((lost[side][1:] & lost[side][:-1]).mean() - missed**2) <= 5.0 * deviation
    assert abs((lost["motor"] & lost["load"]).mean() - missed**2) <= 5.0 * deviation
