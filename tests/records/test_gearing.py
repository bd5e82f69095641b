"""Motor against load position where the gap is as large as the motion."""

import numpy as np
import pandas as pd
import pytest
from measured import GEAR_RATIO, simulate_log

from jaxbl.errors import InputError
from jaxbl.records import inspect, read_record
from jaxbl.records.rigid_body import fit_rigid_drive


def simulate_wide_twist(torque, count=20_000):
    """Table 1 of the paper: the twist ranges as far as the motor moves."""
    period = 1e-3
    position, speed, load, load_speed = 0.0, 0.0, 0.0, 0.0
    rows = []
    for i in range(count):
        u = torque(period * i)
        rows.append((period * i, u, position, load))
        z = position - 5.0 * load
        through = z - 4.0 * 0.02 * np.tanh(10.0 * z)
        speed += period * (u - 0.15 * speed - through) / 0.05
        load_speed += period * (5.0 * through - 16.0 * load_speed) / 7.0
        position += period * speed
        load += period * load_speed
    frame = pd.DataFrame(rows, columns=["t", "u", "theta_e", "theta_s"])
    random = np.random.default_rng(0)
    for name, noise in (("theta_e", 1e-4), ("theta_s", 2e-5)):
        frame[name] += noise * random.standard_normal(count)
    return frame


@pytest.fixture(scope="module")
def wide_twist_log():
    return simulate_wide_twist(lambda t: 0.08 * np.sin(2.0 * np.pi * 0.16 * t))


def inspect_frame(tmp_path, frame, gear_ratio, log=None):
    frame.to_parquet(tmp_path / "log.parquet")
    return inspect(tmp_path / "log.parquet", log, gear_ratio=gear_ratio)


def test_a_gap_as_large_as_the_motion_is_no_wrong_ratio_and_no_skew(tmp_path, wide_twist_log):
    inspection = inspect_frame(tmp_path, wide_twist_log, 5.0)
    gearing = inspection.record.statistics.gearing
    assert gearing.is_loose and gearing.skew is None
    assert abs(gearing.ratio - 5.0) < 2.0 * gearing.ratio_error
    assert len(inspection.record.notes) == 1
    assert inspection.record.notes[0].startswith("theta_e - 5 theta_s ranges over 0.3")
    assert inspection.record.notes[0].endswith("with backlash or wind-up of that size this log hardly confirms gear_ratio.")
    # asymptotically 4 j0 either way, if nothing is known of the wind-up
    assert gearing.lost_motion_interval[0] < 0.14 and gearing.lost_motion_interval[1] > 0.16
    answers = {j.quantity: j for j in inspection.identifiability}
    assert answers["gear ratio"].answer == answers["lost motion"].answer == "weak"
    assert "gap and wind-up take" in answers["gear ratio"].reason
    # one sine does not part what is proportional to acceleration, speed and position
    for quantity in ("inertia", "viscous friction", "Coulomb friction"):
        for side in ("motor", "load"):
            judgement = answers[f"{side} {quantity}"]
            assert judgement.answer == "weak" and "hard to separate" in judgement.reason
    assert inspect_frame(tmp_path, wide_twist_log, None).record.notes == ()


def test_the_torque_moves_both_sides_whatever_lies_between_them(tmp_path):
    frame = simulate_wide_twist(
        lambda t: 0.3 * sum(np.sin(2.0 * np.pi * f * t + 5.0 * f) for f in (0.3, 0.7, 1.1, 1.9)), 10_000
    )
    inspection = inspect_frame(tmp_path, frame, 5.0)
    assert inspection.record.statistics.gearing.is_loose
    answers = {j.quantity: j.answer for j in inspection.identifiability}
    shown = ("motor inertia", "motor viscous friction", "load inertia", "load viscous friction", "lost motion")
    assert {name for name, answer in answers.items() if answer == "yes"} >= {*shown}
    # no side has dry friction
    assert answers["motor Coulomb friction"] == answers["load Coulomb friction"] == "weak"
    record = inspection.record
    motor, load = (record.positions[side] for side in ("motor", "load"))
    for place, other, truth in ((motor, load, (0.05, 0.15)), (load, motor, (7.0 / 5.0, 16.0 / 5.0))):
        fit = fit_rigid_drive(record.torque, place, record.segments, record.sample_period, other)
        np.testing.assert_allclose(fit.values[:2], truth, rtol=0.05)


def test_what_cannot_be_is_refused_even_then(tmp_path, wide_twist_log):
    with pytest.raises(InputError, match=r"theta_e - 50 theta_s ranges over 1.9\d rad, .*: gear_ratio, or a unit") as error:
        inspect_frame(tmp_path, wide_twist_log, 50.0)
    assert "\n" not in str(error.value)
    with pytest.raises(InputError, match="gear_ratio, or a unit in"):
        inspect_frame(tmp_path, wide_twist_log, 5.0, {"theta_s": {"column": "theta_s", "unit": "turn"}})
    notes = inspect_frame(tmp_path, wide_twist_log, -5.0).record.notes
    assert any("perhaps the sign of one of them is wrong" in note for note in notes)


@pytest.mark.parametrize("gap", [0.0, 0.5])
@pytest.mark.parametrize("factor", [0.1, 10.0, -1.0])
def test_a_wrong_ratio_is_refused(tmp_path, gap, factor):
    with pytest.raises(InputError, match=r"theta_e moves -?(20|19\.9)"):
        inspect_frame(tmp_path, simulate_log(gap=gap, noise=1e-3), factor * GEAR_RATIO)


def test_a_gap_of_a_good_part_of_the_motion_leaves_the_ratio(tmp_path):
    for gap in (5.0, 20.0, 40.0):
        inspection = inspect_frame(tmp_path, simulate_log(gap=gap, noise=1e-3, count=8000), GEAR_RATIO)
        assert not any("moves" in note or "against" in note for note in inspection.record.notes), inspection.record.notes


SLIPS = {
    "swapped": (lambda e, s: (s, e), r"theta_e moves 0\.0\d+ times as far .*: the sides are swapped"),
    "motor in degrees": (
        lambda e, s: (np.degrees(e), s),
        r"theta_e moves .*: theta_e is in degrees; see unit",
    ),
    "load in degrees": (lambda e, s: (e, np.degrees(s)), r"theta_e moves .*: theta_s is in degrees; see unit"),
    "at the motor": (lambda e, s: (e, 20.0 * s), r"theta_s is already referred to the motor shaft"),
}


@pytest.mark.parametrize("slip", SLIPS)
def test_slips_are_named_where_the_gap_is_as_large_as_the_motion(tmp_path, slip):
    change, message = SLIPS[slip]
    log = simulate_log(gap=15.0, noise=1e-3)
    log["theta_e"], log["theta_s"] = change(log["theta_e"], log["theta_s"])
    log.to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(InputError, match=message):
        read_record(tmp_path / "log.csv", gear_ratio=20.0)
