"""A first study for a log, from its columns and a rough fit."""

import json

import numpy as np
import pandas as pd
import pytest
from measured import INERTIA, VISCOUS, find_recording, simulate_axis, simulate_log

from jaxbl.config import read_model
from jaxbl.errors import InputError
from jaxbl.records import NominalDrive, read_log_table
from jaxbl.records.proposal import guess_log_table, propose_study


def test_names_and_units_of_columns_are_understood(tmp_path):
    frame = simulate_log()
    columns = {"Time (ms)": 1e3 * frame["t"], "Motor current [mA]": frame["u"], "goal_position": 0.5 * frame["theta_e"],
               "position_deg": np.degrees(frame["theta_e"]), "speed [rpm]": frame["u"]}  # fmt: skip
    type(frame)(columns).to_csv(tmp_path / "log.csv", index=False)
    table, guesses = guess_log_table(tmp_path / "log.csv")
    assert table == {
        "t": {"column": "Time (ms)", "unit": "ms"},
        "u": {"column": "Motor current [mA]", "unit": "A", "factor": 1e-3},
        "theta_e": {"column": "position_deg", "unit": "deg"},
    }
    assert guesses == ["u.factor: put in the torque of one mA of the column; 0.001 N m is a placeholder."]


COLUMNS = {
    "t, torque, motor_temperature, motor_position": {"u": "torque", "theta_e": "motor_position"},
    "t, motor_current, motor_torque, motor_position": {"u": "motor_current", "theta_e": "motor_position"},
    "t, torque, motor temperature [°C], load [N m], motor angle": {"u": "torque", "theta_e": "motor angle"},
    "t, torque, load_torque, theta_m, load_pos": {"u": "torque", "theta_e": "theta_m", "theta_s": "load_pos"},
    "t, load_torque, torque, motor, load": {"u": "torque", "theta_e": "motor", "theta_s": "load"},
    "t, torque, load, load_pos, motor, motor_angle": {"u": "torque", "theta_e": "motor_angle", "theta_s": "load_pos"},
    "t, torque_cmd, position": {"u": "torque_cmd", "theta_e": "position"},
    "t, torque_cmd, current, position_cmd, position": {"u": "current", "theta_e": "position"},
    "t, torque, current_position": {"u": "torque", "theta_e": "current_position"},
    "t, act_pos_deg[0], act_pos_deg[1], torque": {"theta_e": "act_pos_deg[0]", "u": "torque"},
    "t, /joint_states.position[arm], /joint_states.effort[arm]": {
        "theta_s": "/joint_states.position[arm]",
        "u": "/joint_states.effort[arm]",
    },
    "t, position, goal_position, speed, load": {"theta_e": "position", "u": "load"},
    "t, load, pos, temperature": {"theta_e": "pos", "u": "load"},
    "t, force, velocity [counts]": {"u": "force", "omega_e": "velocity [counts]"},
    "Time/s, Torque/Nm, MotorPosition/rad, LoadPosition/rad": {
        "t": "Time/s",
        "u": "Torque/Nm",
        "theta_e": "MotorPosition/rad",
        "theta_s": "LoadPosition/rad",
    },
    "Zeit, Motormoment, Rotorlage, Abtriebswinkel": {
        "t": "Zeit",
        "u": "Motormoment",
        "theta_e": "Rotorlage",
        "theta_s": "Abtriebswinkel",
    },
    "zeit_s, M_soll_Nm, M_ist_Nm, phi_mot_rad, phi_abtrieb_rad": {
        "t": "zeit_s",
        "u": "M_ist_Nm",
        "theta_e": "phi_mot_rad",
        "theta_s": "phi_abtrieb_rad",
    },
    "zeit_s, M_soll_Nm, winkel_rad": {"t": "zeit_s", "u": "M_soll_Nm", "theta_e": "winkel_rad"},
    "ms, ticks, mA": {"t": "ms", "theta_e": "ticks", "u": "mA"},
    "t, DC Voltage [V], Torque In [Nm], Angle In [deg], Angle Out [deg]": {
        "u": "Torque In [Nm]",
        "theta_e": "Angle In [deg]",
        "theta_s": "Angle Out [deg]",
    },
    "t, joint_1.position, joint_2.position, joint_2.effort, joint_1.effort": {
        "theta_s": "joint_1.position",
        "u": "joint_1.effort",
    },
    "t, AngleRef[deg], AngleFbk[deg], Q Current [A]": {"theta_e": "AngleFbk[deg]", "u": "Q Current [A]"},
    "t, Goal Position, Present Position, Present Load": {"theta_e": "Present Position", "u": "Present Load"},
    "t, i_q, motor shaft [deg], output shaft [deg]": {
        "u": "i_q",
        "theta_e": "motor shaft [deg]",
        "theta_s": "output shaft [deg]",
    },
}


@pytest.mark.parametrize("names", COLUMNS)
def test_each_quantity_finds_its_column(names, tmp_path):
    columns = names.split(", ")
    pd.DataFrame({name: 0.01 * np.arange(5) + i for i, name in enumerate(columns)}).to_csv(tmp_path / "log.csv", index=False)
    table, guesses = guess_log_table(tmp_path / "log.csv")
    read_log_table(table)
    assert {channel: keys["column"] for channel, keys in table.items()} == {"t": "t"} | COLUMNS[names]
    assert (table["u"]["column"] in ("torque_cmd", "M_soll_Nm")) == any("the commanded torque" in guess for guess in guesses)
    assert ("[counts]" in names) == any("put in factor" in guess for guess in guesses)


@pytest.mark.parametrize(
    ("name", "unit", "expected"),
    [("act_pos_deg[0]", "deg", "deg"), ("pos[3]", "rad", "rad"), ("pos [turn]", "turn", "turn"), ("pos[mm]", "mm", "mm"),
     ("axis_position_rev(1)", "turn", "turn")],
)  # fmt: skip
def test_an_index_is_no_unit(name, unit, expected, tmp_path):
    pd.DataFrame({"t": 0.01 * np.arange(5), name: 0.1 * np.arange(5)}).to_csv(tmp_path / "log.csv", index=False)
    table, guesses = guess_log_table(tmp_path / "log.csv")
    assert table["theta_e"] == {"column": name, "unit": expected}
    assert any("not given: rad is assumed" in guess for guess in guesses) == (unit == "rad")


def test_dates_are_a_time(tmp_path):
    frame = simulate_log().drop(columns="theta_s")
    frame["t"] = (pd.Timestamp("2026-03-01") + pd.to_timedelta(frame["t"], unit="s")).astype(str)
    frame.to_csv(tmp_path / "log.csv", index=False)
    study, _, inspection = propose_study(tmp_path / "log.csv")
    assert study["log"]["t"] == {"column": "t"}
    assert inspection.record.sample_period == pytest.approx(1e-3)


def wrap_position(frame):
    return frame.assign(theta_e=np.degrees(frame["theta_e"]) % 360.0).rename(columns={"theta_e": "position_deg"})


def write_unsigned_words(frame):
    return frame.assign(load=np.round(1e3 * frame["u"]).astype(int) % 65536).drop(columns="u")


def write_degrees_without_unit(frame):
    return frame.assign(theta_e=np.round(np.degrees(frame["theta_e"]) / 360.0 * 4096.0) * 360.0 / 4096.0)


@pytest.mark.parametrize(
    ("write", "channel", "key", "value"),
    [
        (wrap_position, "theta_e", "wrap", 360),
        (write_unsigned_words, "u", "signed_bits", 16),
        (write_degrees_without_unit, "theta_e", "unit", "deg"),
    ],
)
def test_what_a_refusal_asks_for_is_taken(write, channel, key, value, tmp_path):
    """The remedy stands in the proposed table, with the reason, and the log is read by it."""
    write(simulate_log(count=8000).drop(columns="theta_s")).to_csv(tmp_path / "log.csv", index=False)
    study, guesses, _ = propose_study(tmp_path / "log.csv")
    assert study["log"][channel][key] == value
    assert sum(guess.startswith(f"{channel}.{key} = {json.dumps(value)}: column ") for guess in guesses) == 1
    assert not any("rad is assumed" in guess for guess in guesses) or key != "unit"
    read_model(study)


def test_columns_without_names_are_known_by_how_they_change(tmp_path):
    """An index in front, and a load that counts against the motor."""
    frame = simulate_log(noise=1e-4)
    frame["theta_s"] *= -1.0
    frame.to_csv(tmp_path / "bare.csv", header=False)
    study, guesses, inspection = propose_study(tmp_path / "bare.csv")
    assert {channel: keys["column"] for channel, keys in study["log"].items()} == {
        "t": 1,
        "u": 2,
        "theta_e": 3,
        "theta_s": 4,
    }
    assert study["log"]["theta_s"]["sign"] == -1 and study["drive"]["gear_ratio"] == 20.0
    assert "theta_s.sign = -1: theta_s counts against theta_e." in guesses
    assert inspection.record.sample_period == pytest.approx(1e-3)
    read_model(study)


def test_a_speed_beside_its_position_gives_the_period(tmp_path):
    frame = simulate_log()
    columns = [frame["u"], np.gradient(frame["theta_e"], frame["t"]), frame["theta_e"]]
    np.savetxt(tmp_path / "timeless.txt", np.column_stack(columns))
    study, guesses, _ = propose_study(tmp_path / "timeless.txt")
    assert study["log"] == {
        "t": {"period": pytest.approx(1e-3)}, "theta_e": {"column": 2, "unit": "rad"}, "u": {"column": 0}
    }  # fmt: skip
    assert any("period is taken to be 0.001 s" in guess for guess in guesses)
    # degrees beside rad/s: no usual period
    np.savetxt(tmp_path / "timeless.txt", np.column_stack([*columns[:2], np.degrees(columns[2])]))
    with pytest.raises(InputError, match="no column is called like a time"):
        propose_study(tmp_path / "timeless.txt")


@pytest.mark.parametrize(("ratio", "expected"), [(19.97, 20.0), (99.8, 100.0), (256.9, 256.9), (143.2, 143.2)])
def test_a_large_ratio_is_a_whole_number_only_within_its_errors(ratio, expected, tmp_path):
    frame = simulate_log(noise=1e-6)
    frame["theta_s"] = frame["theta_e"] / ratio
    frame.to_csv(tmp_path / "log.csv", index=False)
    study, guesses, _ = propose_study(tmp_path / "log.csv")
    assert study["drive"]["gear_ratio"] == pytest.approx(expected, rel=1e-3)
    assert any("gear_ratio is" in guess for guess in guesses) == (expected != ratio)


def test_a_speed_beside_a_position_needs_no_offset(tmp_path):
    """The proposed [log] reads the log, although an integral has no zero that it could name."""
    frame = simulate_axis(3.04e-3, 0.379)
    speed = np.gradient(frame["theta_e"], frame["t"])
    frame = frame.rename(columns={"theta_s": "load angle"}).drop(columns="theta_e").assign(**{"motor speed": speed})
    frame.to_csv(tmp_path / "log.csv", index=False)
    study, _, _ = propose_study(tmp_path / "log.csv")
    config, _ = read_model(study)
    assert config.log.omega_e is not None and config.log.theta_e is None
    assert config.log.theta_s.skew == pytest.approx(3.04e-3, abs=5e-4)


def test_the_model_that_is_given_stands(tmp_path):
    simulate_log().to_csv(tmp_path / "log.csv", index=False)
    nominal = NominalDrive(0.004, 0.02, 2.4, 12.0, 20.0, 1234.5)
    study, _, _ = propose_study(tmp_path / "log.csv", {}, gear_ratio=20.0, nominal=nominal)
    assert study["transmission"] == {"law": "linear_shaft", "stiffness": 1234.5}
    assert study["drive"]["load_inertia"] == 2.4 and study["drive"]["gear_ratio"] == 20.0
    with pytest.raises(InputError, match="theta_e moves 20 for each 1 of theta_s, where gear_ratio is 5"):
        propose_study(tmp_path / "log.csv", {}, gear_ratio=5.0, nominal=nominal)
    with pytest.raises(InputError, match="--write proposes a drive; a transmission on a test rig has none"):
        propose_study(tmp_path / "log.csv", {"kind": "element"})


def test_friction_that_does_not_show_is_a_placeholder_of_its_own_unit(tmp_path):
    """A hundredth of the torque, at the rms speed."""
    t = 1e-3 * np.arange(4000)
    position = np.sin(20.0 * t)
    frame = pd.DataFrame({"t": t, "u": 0.01 * -400.0 * position - 1e-3 * 20.0 * np.cos(20.0 * t), "theta_e": position})
    frame.to_csv(tmp_path / "log.csv", index=False)
    study, _, _ = propose_study(tmp_path / "log.csv")
    assert study["drive"]["motor_viscous"] == pytest.approx(0.01 * 4.0 / 20.0, rel=0.05)


def test_a_reversed_torque_and_stamps_in_ms(tmp_path):
    frame = simulate_log().drop(columns="theta_s")
    frame.assign(t=1e3 * frame["t"], u=-frame["u"]).to_csv(tmp_path / "log.csv", index=False)
    study, guesses, inspection = propose_study(tmp_path / "log.csv")
    assert study["log"]["u"]["sign"] == -1 and study["log"]["t"]["unit"] == "ms"
    assert any(guess.startswith("u.sign = -1: ") for guess in guesses)
    assert inspection.record.sample_period == pytest.approx(1e-3)
    config, _ = read_model(study)
    assert config.drive.motor_inertia == pytest.approx(INERTIA, rel=0.02)
    assert config.drive.motor_viscous == pytest.approx(VISCOUS, rel=0.05)


def test_two_encoders_with_a_clock_and_a_zero_of_their_own(tmp_path):
    simulate_axis(3.04e-3, 0.379).to_csv(tmp_path / "log.csv", index=False)
    study, _, inspection = propose_study(tmp_path / "log.csv")
    config, _ = read_model(study)
    assert config.drive.gear_ratio == 20.0
    assert config.log.theta_e.offset == pytest.approx(-0.379, abs=3e-3)
    assert config.log.theta_s.skew == pytest.approx(3.04e-3, abs=3e-4)
    assert inspection.record.warnings[0].startswith("theta_s is 3.")


def test_what_cannot_be_guessed_is_refused(tmp_path):
    frame = simulate_log()
    frame[["t", "u"]].to_csv(tmp_path / "short.csv", index=False)
    with pytest.raises(InputError, match="no column is called like a position or a speed: t, u;"):
        propose_study(tmp_path / "short.csv")
    frame[["u", "theta_e"]].to_csv(tmp_path / "timeless.csv", index=False)
    with pytest.raises(InputError, match="no column is called like a time"):
        propose_study(tmp_path / "timeless.csv")


def test_an_export_of_drive_software_gives_a_study():
    study, guesses, _ = propose_study(find_recording("screw_drives/experiments/driveNo2/start_stop/50.csv"))
    assert study["log"]["omega_e"] == {"column": "Velocity actual value averaged", "unit": "rpm"}
    assert study["log"]["u"]["factor"] == 0.01 and any("of one %" in guess for guess in guesses)
    read_model(study)
