"""Columns that are known by how they move."""

import numpy as np
import pytest
from measured import simulate_log

from jaxbl.records.unnamed_columns import find_latest, find_moving_columns, find_stamps, rises_evenly

PERIOD = 1e-3


@pytest.mark.parametrize("lag", [1, 5, 40])
@pytest.mark.parametrize("shape", [np.sin, lambda angle: np.sign(np.sin(angle + 0.1))])
def test_what_follows_is_measured(lag, shape):
    """The order of columns does not matter, nor does noise; a column of another size is no reference."""
    reference = shape(2e-3 * np.pi * np.arange(4000))
    signals = {"reference": reference, "measured": np.roll(reference, lag) + 1e-4 * np.cos(1e3 * np.arange(4000))}
    assert find_latest(signals) == find_latest(dict(reversed(signals.items()))) == "measured"
    assert find_latest({"motor": reference, "load": 0.5 * signals["measured"]}) == "motor"
    # what overshoots its reference is measured all the same
    assert find_latest({"commanded": reference, "measured": 1.2 * signals["measured"]}) == "measured"


def test_stamps_rise_evenly_and_a_counter_is_none():
    t, count = PERIOD * np.arange(100), np.arange(100)
    assert find_stamps({"row": count, "angle": np.sin(100.0 * t), "time": t + 1e-4 * np.sin(1e6 * t)}) == "time"
    assert find_stamps({"row": count, "date": np.array(["2026-03-01 10:00:00.1"] * 100, dtype=object)}) == "date"
    assert find_stamps({"row": count, "angle": np.sin(100.0 * t)}) is None
    assert not rises_evenly(np.exp(0.1 * count)) and not rises_evenly(np.array(["a", "b"]))


@pytest.mark.parametrize("resolution", [0.0, 2.0 * np.pi / 4096])
def test_a_position_is_smoother_than_its_torque(resolution):
    frame = simulate_log(resolution=resolution, noise=1e-5)
    drift = np.cumsum(np.random.default_rng(0).standard_normal(len(frame)))
    signals = {"temperature": drift, "torque": frame["u"], "load": frame["theta_s"], "motor": frame["theta_e"]}
    channels, period = find_moving_columns(
        {name: np.asarray(values) for name, values in signals.items()}, np.asarray(frame["t"])
    )
    assert channels == {"theta_e": "motor", "theta_s": "load", "u": "torque"} and period is None
    del signals["torque"]
    channels, _ = find_moving_columns({name: np.asarray(values) for name, values in signals.items()}, np.asarray(frame["t"]))
    assert "u" not in channels
