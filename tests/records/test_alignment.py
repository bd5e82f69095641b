"""Clock and zero of one encoder against the other's, beside a gap, friction, wind-up and constant torques."""

import numpy as np
import pandas as pd
import pytest

from jaxbl.records import NominalDrive, inspect, read_record
from jaxbl.report.inspect import summary

NOMINAL = NominalDrive(
    gear_ratio=20.0, stiffness=50.0, half_gap=0.0, motor_inertia=1e-3, motor_viscous=2e-3, load_inertia=0.4, load_viscous=1.0
)


def axis(skew=0.0, offset=0.0, gap=0.0, load_torque=0.0, motor_torque=0.0, stiffness=50.0, count=8000, drift=0.0, seed=0):
    """A geared axis with dry friction at the load in multisine motion: its equations of motion, both encoders with noise."""
    random, t = np.random.default_rng(seed), 1e-3 * np.arange(count)
    frequency, size, phase = np.array([0.5, 0.83, 1.27, 2.1]), np.array([1.0, 0.5, 0.4, 0.2]), random.uniform(0.0, 6.3, 4)

    def motion(times, derivative):
        rate = 2.0 * np.pi * frequency
        return (size * rate**derivative * np.sin(rate * times[:, None] + phase + 0.5 * np.pi * derivative)).sum(axis=1)

    def shaft(times):
        friction = 2.0 * np.tanh(motion(times, 1) / 0.05)
        return (0.4 * motion(times, 2) + 1.0 * motion(times, 1) + friction) / 20.0 + load_torque

    middle = t + 0.5e-3
    twist = shaft(t) / stiffness + 0.5 * gap * np.tanh(shaft(t) / 0.02)
    u = 20.0 * (1e-3 * motion(middle, 2) + 2e-3 * motion(middle, 1)) + shaft(middle) - motor_torque
    motor = 20.0 * motion(t, 0) + twist + offset + 1e-4 * random.standard_normal(count)
    load = motion(t - skew - drift * t, 0) + 5e-6 * random.standard_normal(count)
    return pd.DataFrame({"t": t, "u": u, "theta_e": motor, "theta_s": load})


@pytest.fixture
def read(tmp_path):
    def reading(frame, log=None, nominal=NOMINAL):
        frame.to_parquet(tmp_path / "log.parquet")
        return read_record(tmp_path / "log.parquet", log, gear_ratio=20.0, nominal=nominal)

    return reading


@pytest.mark.parametrize("gap", [0.0, 0.1])
def test_a_drive_without_either_is_left_as_it_is(read, gap):
    frame = axis(gap=gap)
    record = read(frame)
    assert record.warnings == () and record.corrections == {}
    np.testing.assert_array_equal(record.positions["motor"], frame["theta_e"])


@pytest.mark.parametrize("gap", [0.0, 0.1])
@pytest.mark.parametrize(("skew", "offset"), [(3.04e-3, 0.379), (-2e-3, -0.05), (0.0, 37.0), (3.04e-3, 0.0)])
def test_both_are_found_and_corrected(read, gap, skew, offset):
    record = read(axis(skew, offset, gap))
    assert record.corrections.keys() == {name for name, size in (("skew", skew), ("offset", offset)) if size}
    assert len(record.warnings) == len(record.corrections)
    # the load's dry friction winds the shaft up too: by less than is said
    assert record.corrections.get("skew", 0.0) == pytest.approx(skew, abs=1e-4)
    assert record.corrections.get("offset", 0.0) == pytest.approx(-offset, abs=2e-3)
    if skew > 0.0 and offset:
        assert record.warnings[0].startswith("theta_s is 3.0") and "ms later than theta_e" in record.warnings[0]
        assert record.warnings[1].startswith("theta_e - 20 theta_s is 0.37") and "corrected" in record.warnings[1]
    # what was taken for a delay, or for a zero point, is no lost motion
    assert record.findings.gearing.lost_motion == pytest.approx(gap + 4e-3, abs=1e-3 + 0.02 * gap)


def test_what_log_says_holds(read):
    log = {"theta_s": {"skew": 0.0}, "theta_e": {"offset": 0.0}}
    record = read(axis(3.04e-3, 0.379), log)
    assert record.warnings == () and record.corrections == {}
    written = {"theta_s": {"skew": 3.04e-3}, "theta_e": {"offset": -0.379}}
    assert read(axis(3.04e-3, 0.379), written).warnings == ()


def test_a_load_on_one_flank_may_be_an_offset(read):
    """A weight that never lets go: its flank, and what it winds up, look like a zero point."""
    record = read(axis(gap=0.2, load_torque=8.0))
    assert record.corrections == {}
    (warning,) = record.warnings
    assert "this log cannot tell them apart" in warning and "holds the load on one flank of a gap" in warning
    # the nominal gap accounts for it
    assert read(axis(gap=0.2, load_torque=8.0), nominal=NominalDrive(**vars(NOMINAL) | {"half_gap": 0.1})).warnings == ()


def test_a_constant_torque_of_the_motor_is_no_sure_offset(read):
    record = read(axis(motor_torque=0.5))
    assert record.corrections == {}


def test_friction_that_winds_up_a_soft_shaft_is_no_clock(read):
    soft = NominalDrive(**vars(NOMINAL) | {"stiffness": 2.0})
    record = read(axis(stiffness=2.0), nominal=soft)
    assert record.findings.gearing.skew > 1e-3
    assert record.corrections == {} and record.warnings == ()


@pytest.mark.parametrize(("skew", "drift", "gap"), [(3e-3, 5e-5, 0.1), (0.0, -6e-4, 0.0)])
def test_clocks_that_run_apart_are_found_to_a_tenth_of_a_sample(read, skew, drift, gap):
    frame = axis(skew, gap=gap, drift=drift, seed=3)
    record = read(frame)
    ends, found = np.array([0.0, 8.0]), record.corrections
    late = found["skew"] + found["drift"] * ends - skew - drift * ends
    assert np.abs(late).max() < 0.1e-3
    assert any("clocks that run apart: corrected" in warning for warning in record.warnings)
    given = read(frame, {"theta_s": {"skew": found["skew"], "drift": found["drift"]}})
    np.testing.assert_allclose(given.positions["load"], record.positions["load"], atol=1e-12)
    # without a model, on request: with the wind-up by friction, here 0.05 ms
    asked = read(frame, {"theta_s": {"skew": "estimate"}}, None)
    (said,) = [note for note in asked.notes if "growing by" in note]
    assert float(said.split("growing by ")[1].split(" us")[0]) == pytest.approx(1e6 * drift, rel=0.03)


def test_inspect_says_it_first(tmp_path):
    axis(3.04e-3, 0.379).to_parquet(tmp_path / "log.parquet")
    lines = summary(inspect(tmp_path / "log.parquet", gear_ratio=20.0, nominal=NOMINAL))
    assert lines[0].startswith("theta_s is 3.0") and lines[1].startswith("theta_e - 20 theta_s is 0.37")
