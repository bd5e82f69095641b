"""A first study for a log, from its columns and a rough fit."""

import numpy as np
import pytest
from measured import INERTIA, VISCOUS, axis, made, real

from jaxbl.config import read_model
from jaxbl.errors import InputError
from jaxbl.records.proposal import guess_log_table, propose


def test_names_and_units_of_columns_are_understood(tmp_path):
    frame = made()
    columns = {"Time (ms)": 1e3 * frame["t"], "Motor current [mA]": frame["u"], "goal_position": 0.5 * frame["theta_e"],
               "position_deg": np.degrees(frame["theta_e"]), "speed [rpm]": frame["u"]}  # fmt: skip
    type(frame)(columns).to_csv(tmp_path / "log.csv", index=False)
    table, guesses = guess_log_table(tmp_path / "log.csv")
    assert table == {
        "t": {"column": "Time (ms)", "unit": "ms"},
        "u": {"column": "Motor current [mA]", "unit": "A", "factor": 1e-3},
        "theta_e": {"column": "position_deg", "unit": "deg"},
    }
    assert guesses == ["u.factor: put in the torque of one mA; 1 is a placeholder for each A or V, and for 100 %."]


def test_a_reversed_torque_and_stamps_in_ms(tmp_path):
    frame = made().drop(columns="theta_s")
    frame.assign(t=1e3 * frame["t"], u=-frame["u"]).to_csv(tmp_path / "log.csv", index=False)
    study, guesses, found = propose(tmp_path / "log.csv")
    assert study["log"]["u"]["sign"] == -1 and study["log"]["t"]["unit"] == "ms"
    assert any("u is reversed" in guess for guess in guesses)
    assert found.record.sample_period == pytest.approx(1e-3)
    config, _ = read_model(study)
    assert config.drive.motor_inertia == pytest.approx(INERTIA, rel=0.02)
    assert config.drive.motor_viscous == pytest.approx(VISCOUS, rel=0.05)


def test_two_encoders_with_a_clock_and_a_zero_of_their_own(tmp_path):
    axis(3.04e-3, 0.379).to_csv(tmp_path / "log.csv", index=False)
    study, _, found = propose(tmp_path / "log.csv")
    config, _ = read_model(study)
    assert config.drive.gear_ratio == 20.0
    assert config.log.theta_e.offset == pytest.approx(-0.379, abs=3e-3)
    assert config.log.theta_s.skew == pytest.approx(3.04e-3, abs=3e-4)
    assert found.record.warnings[0].startswith("theta_s is 3.")


def test_what_cannot_be_guessed_is_refused(tmp_path):
    frame = made()
    frame.to_csv(tmp_path / "bare.csv", index=False, header=False)
    with pytest.raises(InputError, match="--write goes by the names of columns, and the file has none"):
        propose(tmp_path / "bare.csv")
    frame[["t", "u"]].to_csv(tmp_path / "short.csv", index=False)
    with pytest.raises(InputError, match="no column is called like a position or a speed: t, u;"):
        propose(tmp_path / "short.csv")
    frame[["u", "theta_e"]].to_csv(tmp_path / "timeless.csv", index=False)
    with pytest.raises(InputError, match="no column is called like a time"):
        propose(tmp_path / "timeless.csv")


def test_an_export_of_drive_software_gives_a_study():
    study, guesses, _ = propose(real("screw_drives/experiments/driveNo2/start_stop/50.csv"))
    assert study["log"]["omega_e"] == {"column": "Velocity actual value averaged", "unit": "rpm"}
    assert study["log"]["u"]["factor"] == 0.01 and any("of one %" in guess for guess in guesses)
    read_model(study)
