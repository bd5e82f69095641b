"""Input signals: values, power, levels, and the same samples in either precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.signal import chirp

from jaxbl.drive import EXCITATIONS, as_arrays
from jaxbl.drive.excitation import Chirp, Multisine, Prbs, Recorded, Sine, Steps

DTYPES = pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
# the last ones are multiples of no power of two or ten: time stamps fall on either side of the edge in float32
PERIODS = pytest.mark.parametrize("period", [1e-3, 7e-4, 1.0 / 3000.0])


@jax.jit
def _sample_compiled(excitation, times):
    return jax.vmap(excitation)(times)


def sample(excitation, times, dtype=jnp.float64):
    values = _sample_compiled(as_arrays(excitation, dtype), jnp.asarray(times, dtype))
    assert values.dtype == dtype and values.shape == np.shape(times)
    return np.asarray(values)


def sample_times(samples, period, dtype):
    """Time as the simulation counts it."""
    return jnp.arange(samples).astype(dtype) * jnp.asarray(period, dtype)


@settings(deadline=None, max_examples=25)
@given(st.floats(-5.0, 5.0), st.floats(0.0, 50.0), st.floats(-3.0, 3.0), st.floats(-1.0, 1.0), st.floats(0.0, 20.0))
def test_sine(amplitude, frequency, phase, offset, time):
    value = Sine(amplitude, frequency, phase, offset)(jnp.asarray(time))
    assert value == pytest.approx(offset + amplitude * np.sin(2.0 * np.pi * frequency * time + phase), abs=1e-10)


@pytest.mark.parametrize("count", [1, 2, 8, 31])
def test_multisine_has_the_power_of_a_sine_flat_lines_and_a_low_crest(count):
    samples = 4096
    u = sample(Multisine(amplitude=0.3, frequency=0.5, count=count), np.arange(samples) * 2.0 / samples)
    assert np.mean(u**2) == pytest.approx(0.3**2 / 2.0)
    lines = 2.0 * np.abs(np.fft.rfft(u)) / samples
    np.testing.assert_allclose(lines[1 : count + 1], 0.3 / np.sqrt(count))
    np.testing.assert_allclose(np.delete(lines, range(1, count + 1)), 0.0, atol=1e-12)
    # in phase the harmonics would add up to 0.3 sqrt(count)
    assert np.abs(u).max() < 1.25 * 0.3 * np.sqrt(2.0)


def test_chirp_against_scipy_and_steady_afterwards():
    excitation = Chirp(amplitude=2.0, start_frequency=0.5, stop_frequency=5.0, sweep_time=4.0)
    inside, after = np.linspace(0.0, 4.0, 401), np.linspace(4.0, 6.0, 201)
    expected = 2.0 * chirp(inside, 0.5, 4.0, 5.0, method="linear", phi=-90.0)
    np.testing.assert_allclose(sample(excitation, inside), expected, atol=1e-12)
    turns = 0.5 * (0.5 + 5.0) * 4.0 + 5.0 * (after - 4.0)
    np.testing.assert_allclose(sample(excitation, after), 2.0 * np.sin(2.0 * np.pi * turns), atol=1e-12)


@pytest.fixture(scope="module")
def long_bits():
    """Bits of a sequence that repeats only after the run, so that each tells its own index."""
    return sample(Prbs(amplitude=1.0, hold=1.0, order=16), np.arange(60_000))


@DTYPES
@PERIODS
@pytest.mark.parametrize("samples_per_hold", [1, 7, 50])
def test_levels_change_at_the_sample_of_the_edge(long_bits, dtype, period, samples_per_hold):
    """Whatever the precision rounds to, over a minute of samples."""
    expected = long_bits[np.arange(long_bits.size) // samples_per_hold]
    prbs = Prbs(amplitude=1.0, hold=samples_per_hold * period, order=16)
    np.testing.assert_array_equal(sample(prbs, sample_times(long_bits.size, period, dtype), dtype), expected)


@pytest.mark.parametrize("order", [2, 5, 10])
def test_prbs_is_balanced_periodic_and_white(order):
    length = 2**order - 1
    u = sample(Prbs(amplitude=0.2, hold=0.1, order=order), (np.arange(2 * length) + 0.5) * 0.1)
    np.testing.assert_allclose(np.unique(u), [-0.2, 0.2])
    np.testing.assert_array_equal(u[:length], u[length:])
    levels = np.sign(u[:length])
    assert levels.sum() == 1
    correlation = np.fft.ifft(np.abs(np.fft.fft(levels)) ** 2).real
    np.testing.assert_allclose(correlation, [length] + [-1] * (length - 1), atol=1e-9)


def test_steps_are_uniform_levels_fixed_by_the_seed_in_either_precision():
    excitation = Steps(amplitude=0.5, hold=0.02, seed=3)
    u = sample(excitation, sample_times(40_000, 1e-3, jnp.float64)).reshape(-1, 20)
    assert (u == u[:, :1]).all()
    levels = u[:, 0]
    assert len(np.unique(levels)) == len(levels)
    assert np.abs(levels).max() <= 0.5
    assert levels.mean() == pytest.approx(0.0, abs=0.03) and levels.var() == pytest.approx(0.25 / 3.0, rel=0.1)
    single = sample(excitation, sample_times(40_000, 1e-3, jnp.float32), jnp.float32)
    np.testing.assert_allclose(single, u.ravel(), rtol=1e-6)
    assert not np.array_equal(sample(Steps(amplitude=0.5, hold=0.02, seed=4), np.arange(2000) * 0.02), levels)


@DTYPES
@PERIODS
def test_recorded_samples_come_back_at_their_own_times(dtype, period):
    torques = np.random.default_rng(0).uniform(-1.0, 1.0, 60_000).astype(np.float32)
    record = Recorded(times=jnp.arange(60_000) * period, torques=jnp.asarray(torques, dtype), gain=2.0)
    np.testing.assert_array_equal(sample(record, sample_times(60_000, period, dtype), dtype), 2.0 * torques)


def test_recorded_is_held_between_and_beyond_uneven_stamps():
    record = Recorded(times=jnp.asarray([0.1, 0.2, 0.5]), torques=jnp.asarray([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(sample(record, [0.0, 0.1, 0.19, 0.2, 0.49, 0.5, 9.0]), [1, 1, 1, 2, 2, 3, 3])


@DTYPES
def test_every_signal_scales_with_its_amplitude_as_a_grid_axis(dtype):
    numbers = {
        "sine": {"frequency": 1.0},
        "multisine": {"frequency": 1.0},
        "chirp": {"start_frequency": 0.0, "stop_frequency": 2.0, "sweep_time": 1.0},
        "steps": {"hold": 0.1},
        "prbs": {"hold": 0.1},
    }
    assert set(numbers) | {"recorded"} == set(EXCITATIONS)

    def scale(amplitude):
        signals = (EXCITATIONS[name](amplitude=amplitude, **other_numbers) for name, other_numbers in numbers.items())
        return [as_arrays(signal, dtype)(jnp.asarray(0.37, dtype)) for signal in signals]

    for values in jax.jit(jax.vmap(scale))(jnp.asarray([0.0, 1.0, -3.0], dtype)):
        assert values.dtype == dtype
        assert values[0] == 0.0 and values[1] != 0.0
        assert values[2] == pytest.approx(float(-3.0 * values[1]), rel=1e-6)


def test_steps_are_independent_of_encoder_noise():
    from scipy.stats import norm

    from jaxbl.chain import unit_noise

    steps = Steps(1.0, 1.0, seed=3)
    levels = sample(steps, np.arange(40) + 0.5)
    noises = jax.jit(unit_noise, static_argnums=2)(jnp.asarray(3), jnp.arange(40), ("motor", "load"))
    for noise in noises.values():
        assert abs(np.corrcoef(levels, 2.0 * norm.cdf(np.asarray(noise)) - 1.0)[0, 1]) < 0.5
