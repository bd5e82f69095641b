"""Faults of single samples in a log's columns: dropouts of the torque, jumps of a counter, stamps of a host."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings, strategies as st
from measured import simulate_log

from jaxbl.records import read_record

STEP = 2.0 * np.pi / 16384


@pytest.fixture
def read_frame(tmp_path):
    def write_and_read(frame: pd.DataFrame, log=None):
        frame.to_parquet(tmp_path / "log.parquet")
        return read_record(tmp_path / "log.parquet", log)

    return write_and_read


@pytest.mark.parametrize(("filler", "runs"), [(0.0, 1), (0.0, 3), (-327.68, 1)])
def test_dropouts_of_the_torque_are_left_out(read_frame, filler, runs):
    frame = simulate_log()
    truth = frame["u"].to_numpy().copy()
    rows = np.random.default_rng(3).choice(np.arange(5, 3990, 5), 60, replace=False)
    for run in range(runs):
        frame.loc[rows + run, "u"] = filler
    record = read_frame(frame)
    np.testing.assert_allclose(record.torque, truth, atol=0.01 * np.abs(truth).max())
    (warning,) = record.warnings
    assert warning.startswith(f"u is {filler:g} in ") and "dropouts, which were left out" in warning
    assert f"(data row {rows.min() + 1} first)" in warning


def draw_inputs() -> dict[str, np.ndarray]:
    """Inputs that are 0, or at an end of their range, now and then, and mean it."""
    random, count = np.random.default_rng(1), 4000
    noise = random.standard_normal(count)
    return {
        "three levels": random.integers(-1, 2, count) * 1.0,
        "two levels": random.choice([-1.0, 1.0], count),
        "steps": np.repeat(random.uniform(-1.0, 1.0, 100), 40) * (np.arange(4000) // 400 % 2),
        "pulses": (np.arange(count) % 3 > 0) * 1.0,
        "noise": np.round(noise, 1),
        "quantised": np.round(np.sin(0.01 * np.arange(count)), 2),
        "clipped": np.clip(1.2 * np.sin(0.3 * np.arange(count)), -1.0, 1.0),
    }


@pytest.mark.parametrize("name", draw_inputs())
def test_an_input_that_steps_has_no_dropouts(read_frame, name):
    u = draw_inputs()[name]
    record = read_frame(simulate_log().assign(u=u), {"absent": ["theta_s"]})
    np.testing.assert_array_equal(record.torque, u)


@settings(max_examples=15, deadline=None)
@given(bits=st.sampled_from([8, 16, 24]), sign=st.sampled_from([1, -1]), length=st.sampled_from([1, 2, 20, 2000]))
def test_counter_jumps_are_undone_and_said(tmp_path_factory, bits, sign, length):
    path = tmp_path_factory.mktemp("logs") / "log.parquet"
    frame = simulate_log(resolution=STEP)
    # slow enough for its steps to show
    frame["theta_e"] = np.round(frame["theta_s"] / STEP) * STEP
    truth = frame["theta_e"].to_numpy().copy()
    frame.loc[1500 : 1500 + length - 1, "theta_e"] += sign * 2.0**bits * STEP
    frame.to_parquet(path)
    record = read_record(path)
    np.testing.assert_allclose(record.positions["motor"], truth, atol=1e-6)
    (warning,) = record.warnings
    counts = f"{sign * 2**bits:+d} (data row 1501), {-sign * 2**bits:+d} (data row {1501 + length})"
    assert warning.startswith("theta_e: 2 counter jumps") and counts in warning


def test_lost_counts_are_no_counter_jumps(read_frame):
    frame = simulate_log(resolution=STEP)
    frame.loc[2500:, "theta_e"] -= 3000.0 * STEP
    record = read_frame(frame)
    assert record.warnings == () and record.statistics.channels["theta_e"].jumps == 1


@pytest.mark.parametrize("jitter", [0.05, 0.3])
def test_stamps_of_a_host_are_named(read_frame, jitter):
    frame = simulate_log(resolution=STEP)
    times = frame["t"].to_numpy()
    delay = 1e-3 * jitter * np.random.default_rng(2).random(4000)
    record = read_frame(frame.assign(t=times + delay))
    (warning,) = record.warnings
    assert warning.startswith("The samples fit even stamps ") and "[log] t = { period = 0.001 }" in warning
    assert read_frame(frame.assign(t=times + delay), {"t": {"period": 1e-3}}).warnings == ()
    # stamps that the readings follow
    assert read_frame(simulate_log(times + delay, resolution=STEP)).warnings == ()


def test_a_segment_that_is_too_short_for_the_period_is_left_out(read_frame):
    frame = simulate_log()
    frame = frame[~frame.index.isin([*range(2000, 2020), *range(2080, 2100)])]
    record = read_frame(frame, {"resample": 2e-3})
    assert len(record.segments) == 2
    (note,) = (note for note in record.notes if note.startswith("Left out are "))
    assert "1 of 3 segments: less than 32 samples" in note and "from 2.02 s on, has 30" in note
