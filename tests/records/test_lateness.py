"""Lateness of u against the motion: a torque that is sampled in place of held, and stamps that are late."""

import numpy as np
import pytest
from measured import LATE_PERIOD, move, simulate_late_log

from jaxbl.records import NominalDrive, read_record

NOMINAL = NominalDrive(4e-4, 8e-3)
ALONE = {"absent": ["theta_s"]}


@pytest.fixture
def read_frame(tmp_path):
    def write_and_read(frame, log=ALONE, nominal=NOMINAL):
        frame.to_parquet(tmp_path / "log.parquet")
        return read_record(tmp_path / "log.parquet", log, nominal=nominal)

    return write_and_read


@pytest.mark.parametrize("late", [-1.0, -0.5, 0.5, 1.0, 1.5, 2.0])
def test_a_late_or_early_torque_is_moved_to_its_motion(read_frame, late):
    record = read_frame(simulate_late_log(late))
    is_sampled = late % 1.0 == 0.5
    assert record.corrections["u.sampled"] == is_sampled
    assert record.corrections["u.skew"] == pytest.approx(LATE_PERIOD * (late - 0.5 * is_sampled), abs=3e-4)
    (warning,) = record.warnings
    assert warning.startswith("u is ") and ("later" if late > 0.0 else "earlier") in warning
    assert "This was corrected." in warning and "u.skew = 0 corrects nothing" in warning
    assert ("dead time or lag of the actuator" in warning) == (late < 0.0)
    found = record.statistics.channels["u"]
    assert found.skew is not None and abs(found.skew) < 3e-4
    # the keys of the warning do the same
    keys = warning.split("[log] ")[1].split(" corrects the same")[0]
    hold, skew = (part.split(" = ")[1].strip('"') for part in keys.split(" and "))
    named = read_frame(simulate_late_log(late), ALONE | {"hold": hold, "u": {"skew": float(skew)}})
    assert named.corrections == {} and named.warnings == ()
    count = min(len(named.torque), len(record.torque))
    np.testing.assert_allclose(named.torque[:count], record.torque[:count], atol=1e-3)
    uncorrected = read_frame(simulate_late_log(late), ALONE | {"u": {"skew": 0.0}})
    np.testing.assert_array_equal(uncorrected.torque, simulate_late_log(late)["u"])


def test_a_held_torque_stays_as_it_is(read_frame):
    record = read_frame(simulate_late_log(0.0))
    assert record.corrections == {} and record.warnings == ()
    np.testing.assert_array_equal(record.torque, simulate_late_log(0.0)["u"])


def test_without_a_model_it_is_only_said(read_frame):
    record = read_frame(simulate_late_log(0.5), nominal=None)
    assert record.corrections == {} and "Nothing was corrected" in record.warnings[0]
    assert record.statistics.channels["u"].skew == pytest.approx(0.5 * LATE_PERIOD, abs=3e-4)


@pytest.mark.parametrize(("late", "dead_time", "corrects"), [
    (-1.0, "sought", False), (-1.0, "modelled", False), (1.0, "sought", True), (1.0, "modelled", False),
])  # fmt: skip
def test_a_dead_time_is_not_hidden(read_frame, late, dead_time, corrects):
    record = read_frame(simulate_late_log(late), nominal=NominalDrive(4e-4, 8e-3, dead_time=dead_time))
    assert bool(record.corrections) == corrects and len(record.warnings) == 1


def test_what_clocks_do_not_cause_is_not_corrected(read_frame):
    record = read_frame(simulate_late_log(0.27))
    assert record.corrections == {} and record.warnings == ()
    (note,) = (note for note in record.notes if note.startswith("u is "))
    assert "no multiple of half a period" in note and "u.skew = 0.002" in note

    # friction of a load on a soft shaft: 5 ms
    def motor(times):
        return move(times) + (2e-4 * move(times, 2) + 8e-3 * move(times, 1)) / 1.6

    def soft_torque(times):
        twisting = (2e-4 * move(times, 4) + 8e-3 * move(times, 3)) / 1.6
        return 4e-4 * move(times, 2) + 8e-3 * move(times, 1) + 2e-4 * twisting

    assert read_frame(simulate_late_log(0.0, soft_torque, motor, noise=1e-5)).corrections == {}


def test_a_sampled_torque_moves_an_inertia_as_a_smooth_one(read_frame):
    frame = simulate_late_log(0.0, noise=0.0).assign(u=lambda frame: move(frame["t"].to_numpy(), 2))
    record = read_frame(frame, ALONE | {"hold": "sampled"}, NominalDrive(1.0, 0.0))
    torque, position = record.torque, record.positions["motor"]
    # the second difference of the positions of an inertia under a held torque
    predicted = 0.5 * LATE_PERIOD**2 * (torque[1:] + torque[:-1])
    errors = (np.diff(position, n=2) - predicted[:-1])[5:-5] / LATE_PERIOD**2
    assert np.sqrt(np.mean(errors**2)) < 1e-3 * np.std(torque)


def test_a_test_rig_has_no_hold(tmp_path):
    frame = simulate_late_log(0.0)
    frame.to_parquet(tmp_path / "rig.parquet")
    record = read_record(tmp_path / "rig.parquet", ALONE | {"kind": "element", "hold": "sampled"})
    np.testing.assert_array_equal(record.torque, frame["u"])
