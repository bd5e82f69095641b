"""Clock and zero of one encoder against the other's, beside a gap, friction, wind-up and constant torques."""

import numpy as np
import pytest
from measured import NOMINAL, simulate_axis

from jaxbl.records import NominalDrive, inspect, read_record
from jaxbl.report.inspect import describe as describe_inspection


@pytest.fixture
def read_frame(tmp_path):
    def write_and_read(frame, log=None, nominal=NOMINAL):
        frame.to_parquet(tmp_path / "log.parquet")
        return read_record(tmp_path / "log.parquet", log, gear_ratio=20.0, nominal=nominal)

    return write_and_read


@pytest.mark.parametrize("gap", [0.0, 0.1])
def test_a_drive_without_either_is_left_as_it_is(read_frame, gap):
    frame = simulate_axis(gap=gap)
    record = read_frame(frame)
    assert record.warnings == () and record.corrections == {}
    np.testing.assert_array_equal(record.positions["motor"], frame["theta_e"])


@pytest.mark.parametrize(
    ("skew", "offset", "gap"), [(3.04e-3, 0.379, 0.1), (-2e-3, -0.05, 0.0), (0.0, 37.0, 0.1), (3.04e-3, 0.0, 0.0)]
)
def test_both_are_found_and_corrected(read_frame, skew, offset, gap):
    record = read_frame(simulate_axis(skew, offset, gap))
    assert record.corrections.keys() == {name for name, size in (("skew", skew), ("offset", offset)) if size}
    assert len(record.warnings) == len(record.corrections)
    # the load's dry friction winds the shaft up too: by less than is said
    assert record.corrections.get("skew", 0.0) == pytest.approx(skew, abs=1e-4)
    assert record.corrections.get("offset", 0.0) == pytest.approx(-offset, abs=2e-3)
    if skew > 0.0 and offset:
        assert record.warnings[0].startswith("theta_s is 3.0") and "ms later than theta_e" in record.warnings[0]
        assert record.warnings[1].startswith("theta_e - 20 theta_s is 0.37") and "corrected" in record.warnings[1]
    # what was taken for a delay, or for a zero point, is no lost motion
    assert record.statistics.gearing.lost_motion == pytest.approx(gap + 4e-3, abs=1e-3 + 0.02 * gap)


@pytest.mark.parametrize("gap", [0.0, 0.1])
@pytest.mark.parametrize("offset", [0.0, 0.385])
def test_an_eccentric_encoder_has_its_offset_too(read_frame, gap, offset):
    frame = simulate_axis(offset=offset, gap=gap)
    # over two thirds of a turn its mean is not 0
    frame["theta_e"] += 0.05 * np.sin(frame["theta_s"] + 0.8)
    record = read_frame(frame)
    assert record.corrections.get("offset", 0.0) == pytest.approx(-offset, abs=5e-3)
    assert len(record.warnings) == bool(offset)


def test_corrections_of_the_log_table_hold(read_frame):
    log = {"theta_s": {"skew": 0.0}, "theta_e": {"offset": 0.0}}
    record = read_frame(simulate_axis(3.04e-3, 0.379), log)
    assert record.warnings == () and record.corrections == {}
    written = {"theta_s": {"skew": 3.04e-3}, "theta_e": {"offset": -0.379}}
    assert read_frame(simulate_axis(3.04e-3, 0.379), written).warnings == ()


def test_a_load_on_one_flank_may_be_an_offset(read_frame):
    """A weight that never lets go: its flank, and what it winds up, look like a zero point."""
    record = read_frame(simulate_axis(gap=0.2, load_torque=8.0))
    assert record.corrections == {}
    (warning,) = record.warnings
    assert "this log cannot tell them apart" in warning and "holds the load on one flank of a gap" in warning
    # the nominal gap accounts for it
    assert (
        read_frame(
            simulate_axis(gap=0.2, load_torque=8.0), nominal=NominalDrive(**vars(NOMINAL) | {"half_gap": 0.1})
        ).warnings
        == ()
    )


@pytest.mark.parametrize(("half_gap", "sure"), [(0.025, True), (0.06, False)])
def test_a_twist_that_never_covers_the_gap_has_no_sure_offset(read_frame, half_gap, sure):
    """A motor that moves in one half of a wide gap looks like an offset and a narrow one."""
    record = read_frame(simulate_axis(offset=0.3, gap=0.05), nominal=NominalDrive(**vars(NOMINAL) | {"half_gap": half_gap}))
    assert bool(record.corrections) == sure


def test_a_constant_torque_of_the_motor_is_no_sure_offset(read_frame):
    record = read_frame(simulate_axis(motor_torque=0.5))
    assert record.corrections == {}


def test_friction_that_winds_up_a_soft_shaft_is_no_clock(read_frame):
    soft = NominalDrive(**vars(NOMINAL) | {"stiffness": 2.0})
    record = read_frame(simulate_axis(stiffness=2.0), nominal=soft)
    assert record.statistics.gearing.skew > 1e-3
    assert record.corrections == {} and record.warnings == ()


@pytest.mark.parametrize(("skew", "drift", "gap"), [(3e-3, 5e-5, 0.1), (0.0, -6e-4, 0.0)])
def test_clocks_that_run_apart_are_found_to_a_tenth_of_a_sample(read_frame, skew, drift, gap):
    frame = simulate_axis(skew, gap=gap, drift=drift, seed=3)
    record = read_frame(frame)
    ends, corrections = np.array([0.0, 8.0]), record.corrections
    errors = corrections["skew"] + corrections["drift"] * ends - skew - drift * ends
    assert np.abs(errors).max() < 0.1e-3
    (warning,) = record.warnings
    assert "The clocks drift apart" in warning
    keys = f"theta_s.skew = {corrections['skew']:.4g} (at the first stamp) and theta_s.drift = {corrections['drift']:.4g}"
    assert f"[log] {keys} corrects" in warning and warning.count("[log]") == 1
    corrected = read_frame(frame, {"theta_s": {"skew": corrections["skew"], "drift": corrections["drift"]}})
    np.testing.assert_allclose(corrected.positions["load"], record.positions["load"], atol=1e-12)
    # without a model, on request: with the wind-up by friction, here 0.05 ms
    estimated = read_frame(frame, {"theta_s": {"skew": "estimate"}}, None)
    (sentence,) = [note for note in estimated.notes if "growing by" in note]
    assert float(sentence.split("growing by ")[1].split(" us")[0]) == pytest.approx(1e6 * drift, rel=0.03)


def test_the_zero_of_an_integral_is_none_and_its_clock_is_its_own(read_frame):
    """A speed in place of a position has a skew, but no offset that [log] could name."""
    frame = simulate_axis(3.04e-3, 0.379)
    frame["omega_e"], frame["omega_s"] = (np.gradient(frame[name], frame["t"]) for name in ("theta_e", "theta_s"))
    motor = read_frame(frame.drop(columns="theta_e"), {"omega_e": "omega_e"})
    load = read_frame(frame.drop(columns="theta_s"), {"omega_s": "omega_s"})
    for record, name in ((motor, "theta_s"), (load, "omega_s")):
        assert set(record.corrections) == {"skew"}
        (warning,) = (warning for warning in record.warnings if "corrected" in warning)
        assert f"[log] {name}.skew = {record.corrections['skew']:.4g} corrects the same" in warning
        assert not any(".offset" in warning for warning in record.warnings)
        twist = record.positions["motor"] - 20.0 * record.positions["load"]
        assert abs(np.mean(twist)) < 0.05
    corrected = read_frame(frame.drop(columns="theta_s"), {"omega_s": {"skew": load.corrections["skew"]}})
    assert corrected.corrections == {}
    np.testing.assert_allclose(corrected.positions["load"], load.positions["load"], atol=1e-9)


def test_a_screw_twists_in_radians(read_frame):
    """A turning motor and a carriage in mm: the twist is the motor's."""
    frame = simulate_axis(gap=0.3)
    frame["theta_s"] *= 1e3
    frame = frame.iloc[:4000]
    record = read_frame(frame, {"theta_s": {"unit": "mm"}})
    assert record.statistics.channels["theta_s"].unit == "m"
    (note,) = (warning for warning in record.notes if warning.startswith("Lost motion"))
    assert " rad (95 %" in note


def test_inspect_says_it_first(tmp_path):
    simulate_axis(3.04e-3, 0.379).to_parquet(tmp_path / "log.parquet")
    lines = describe_inspection(inspect(tmp_path / "log.parquet", gear_ratio=20.0, nominal=NOMINAL)).remarks
    assert lines[0].startswith("theta_s is 3.0") and lines[1].startswith("theta_e - 20 theta_s is 0.37")
