"""What a log can identify."""

import json
import re

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings, strategies as st
from measured import EMPS, GEAR_RATIO, SERVO, XL330, find_recording, simulate_log

from jaxbl.errors import InputError
from jaxbl.records import inspect


def judge_log(tmp_path, frame, log=None, gear_ratio=GEAR_RATIO):
    frame.to_parquet(tmp_path / "log.parquet")
    return {
        j.quantity: (j.answer, j.reason)
        for j in inspect(tmp_path / "log.parquet", log, gear_ratio=gear_ratio).identifiability
    }


QUANTITIES = ["inertia", "viscous friction", "Coulomb friction", "constant torque", "gear ratio", "lost motion", "stiffness"]


def test_a_rich_log_identifies_all_but_what_it_does_not_show(tmp_path):
    judgements = judge_log(tmp_path, simulate_log(count=6000, gap=0.1, noise=1e-4))
    assert list(judgements) == QUANTITIES
    for quantity in QUANTITIES[:2] + QUANTITIES[3:6]:
        assert judgements[quantity][0] == "yes", quantity
    assert re.match(r"theta_e shifts by (0\.09|0\.1)", judgements["lost motion"][1])
    # the load follows the motor whatever the torque
    assert judgements["stiffness"][0] == "weak"


def test_a_gap_whose_flank_is_chosen_by_inertia(tmp_path):
    frame = simulate_log(count=6000)
    acceleration = np.gradient(np.gradient(frame["theta_e"]))
    frame["theta_s"] -= 0.05 * np.sign(acceleration) / GEAR_RATIO
    frame.to_parquet(tmp_path / "log.parquet")
    inspection = inspect(tmp_path / "log.parquet", gear_ratio=GEAR_RATIO)
    gearing = inspection.record.statistics.gearing
    assert gearing.lost_motion == pytest.approx(0.1, rel=0.1)
    assert gearing.ratio == pytest.approx(GEAR_RATIO, rel=1e-3)
    assert inspection.identifiability[5].answer == "yes"


def test_a_load_that_moves_on_its_own_tells_no_skew(tmp_path):
    t = 1e-3 * np.arange(6000)
    frame = simulate_log(count=6000).assign(theta_s=0.5 * np.sin(5.0 * t) + 0.3 * np.sin(11.0 * t))
    frame.to_parquet(tmp_path / "log.parquet")
    record = inspect(tmp_path / "log.parquet", gear_ratio=GEAR_RATIO).record
    assert any(note.startswith("theta_e and theta_s are hardly related") for note in record.notes)
    assert record.statistics.channels["theta_s"].skew is None


def test_a_compliant_transmission_shows_its_stiffness(tmp_path):
    frame = simulate_log(count=6000, noise=1e-4)
    frame["theta_s"] -= frame["u"] / 50.0 / GEAR_RATIO
    assert judge_log(tmp_path, frame)["stiffness"][0] == "yes"
    frame["sensor"] = frame["u"]
    judgements = judge_log(tmp_path, frame.drop(columns="u"), {"absent": ["u"], "transmitted": "sensor"})
    assert judgements["inertia"] == ("no", "no torque was recorded: the log shows kinematics only")


def test_one_encoder_says_nothing_of_the_transmission(tmp_path):
    for side, other in (("theta_e", "load"), ("theta_s", "motor")):
        judgements = judge_log(tmp_path, simulate_log()[["t", "u", side]])
        for quantity in ("gear ratio", "lost motion", "stiffness"):
            if side == "theta_e" and quantity != "gear ratio":
                # moves back and forth with their torque: a model can tell
                assert judgements[quantity][0] == "weak"
                assert "jaxbl identify" in judgements[quantity][1]
                continue
            assert judgements[quantity] == (
                "no",
                f"there is no {other} encoder: the transmission in between is not observed",
            )
        assert judgements["inertia"][0] == "yes"


def test_free_motion_tells_ratios(tmp_path):
    judgements = judge_log(tmp_path, simulate_log().assign(u=0.0))
    assert judgements["inertia"][0] == "weak" and "only ratios" in judgements["inertia"][1]
    assert judgements["stiffness"] == ("no", "no varying torque was recorded")


def test_one_direction_one_speed_and_one_frequency(tmp_path):
    t = 1e-3 * np.arange(6000)
    forwards = 10.0 * t + 0.5 * np.sin(3.0 * t) + 0.2 * np.sin(11.0 * t)

    def make_log(position):
        velocity = np.gradient(position, t)
        u = 0.01 * np.gradient(velocity, t) + 0.05 * velocity + 0.1 * np.sign(velocity)
        return pd.DataFrame({"t": t, "u": u, "theta_e": position, "theta_s": position / GEAR_RATIO})

    judgements = judge_log(tmp_path, make_log(forwards))
    assert judgements["constant torque"] == ("weak", "motion in one direction only: hard to separate from Coulomb friction")
    assert judgements["Coulomb friction"][0] == "weak"
    assert judgements["lost motion"] == ("no", "0 reversals: both flanks of the gap must come into contact")
    triangle = 4.0 * np.abs((t / 2.0) % 1.0 - 0.5) + 1e-5 * np.random.default_rng(0).standard_normal(6000)
    judgements = judge_log(tmp_path, make_log(np.convolve(np.pad(triangle, 25, "edge"), np.ones(51) / 51.0, "valid")))
    for quantity in ("viscous friction", "Coulomb friction"):
        assert (
            judgements[quantity][0] == "weak"
            and "too close to separate viscous from Coulomb friction" in judgements[quantity][1]
        )
    judgements = judge_log(tmp_path, make_log(np.sin(6.0 * t)))
    assert judgements["inertia"][0] == "weak" and "hard to separate from a spring or gravity" in judgements["inertia"][1]


def test_noise_identifies_nothing(tmp_path):
    random = np.random.default_rng(0)
    frame = simulate_log()
    frame["theta_e"], frame["theta_s"] = random.standard_normal(4000), random.standard_normal(4000)
    judgements = judge_log(tmp_path, frame)
    assert {answer for answer, _ in judgements.values()} == {"no"}


def draw_odd_signal(random, count):
    """Draw a signal that may stand in a column, however odd."""
    time = np.arange(count) / count
    return random.choice([
        random.standard_normal(count), np.cumsum(random.standard_normal(count)), np.sin(40.0 * random.random() * time),
        time, np.round(time), np.zeros(count), random.integers(-3, 4, count) * 1.0, np.round(20.0 * np.sin(9.0 * time)),
        np.where(random.random(count) < 0.02, 1e3, 0.0) + np.sin(20.0 * time),
    ]) * random.choice([1.0, 1e-9, 1e9])  # fmt: skip


@settings(max_examples=50, deadline=None)
@given(
    st.integers(0, 2**20),
    st.sampled_from([64, 65, 100, 300]),
    st.sampled_from([{}, {"resample": 2e-3}, {"theta_s": {"skew": "estimate"}}, {"u": {"skew": 0.007}}]),
)
def test_any_log_is_inspected_or_refused_in_one_line(tmp_path_factory, seed, count, log):
    random = np.random.default_rng(seed)
    period = 1e-3
    stamps = [period * np.arange(count), period * np.cumsum(random.uniform(0.5, 1.5, count)),
              period * np.cumsum(random.integers(0, 3, count)), period * 4.0 * np.floor(np.arange(count) / 4.0),
              period * np.cumsum(random.exponential(1.0, count) ** 3)][random.integers(5)]  # fmt: skip
    frame = pd.DataFrame({"t": stamps} | {name: draw_odd_signal(random, count) for name in ("u", "theta_e", "theta_s")})
    path = tmp_path_factory.mktemp("odd") / "log.parquet"
    frame.to_parquet(path)
    inspection, refusal = None, ""
    try:
        inspection = inspect(path, log, gear_ratio=None if seed % 2 else 7.0)
    except InputError as error:
        refusal = str(error)
    if inspection is None:
        assert refusal.startswith(f"{path}: ") and "\n" not in refusal
        return
    json.dumps(inspection.to_dict())
    for segment in inspection.record.segments:
        np.testing.assert_allclose(np.diff(inspection.record.time[segment]), inspection.record.sample_period, rtol=1e-5)
    assert all(np.isfinite(values).all() for values in inspection.record.positions.values())


def test_the_whole_as_plain_data(tmp_path):
    simulate_log(count=2000).drop(index=range(800, 900)).to_parquet(tmp_path / "log.parquet")
    inspection = inspect(tmp_path / "log.parquet")
    data = json.loads(json.dumps(inspection.to_dict(), allow_nan=False))
    assert data["file"] == str((tmp_path / "log.parquet").resolve())
    assert data["gear_ratio"] == pytest.approx(GEAR_RATIO, rel=1e-4)
    assert len(data["segments"]) == 2 and data["sampling"]["gaps"] == 1
    assert set(data["channels"]) == {"u", "theta_e", "theta_s"}
    assert data["dynamics"]["terms"]["inertia"]["value"] == pytest.approx(0.01, rel=0.05)
    assert len(data["identifiable"]) == 7
    assert inspection.twist is not None and np.abs(inspection.twist).max() < 1e-3


def test_real_machines(tmp_path):
    inspection = {j.quantity: j.answer for j in inspect(find_recording("emps/DATA_EMPS.mat"), EMPS).identifiability}
    assert [inspection[q] for q in QUANTITIES] == ["yes"] * 4 + ["no"] + ["weak"] * 2
    inspection = inspect(find_recording("servoproject_dual_encoder/outputEncoderData.txt"), SERVO, gear_ratio=1.0)
    assert [j.answer for j in inspection.identifiability[:5]] == ["no"] * 4 + ["yes"]
    assert np.ptp(np.degrees(inspection.twist)) == pytest.approx(2.9, abs=0.5)
    free = inspect(find_recording("bam_xl330/2026-01-15_10h28m17.json"), XL330 | {"where": {"torque_enable": False}})
    assert free.identifiability[0].answer == "weak"


def test_a_measured_transmitted_torque_shows_the_stiffness_without_an_input(tmp_path):
    frame = simulate_log(noise=1e-5)
    torque = 0.2 * np.gradient(np.gradient(frame["theta_s"], frame["t"]), frame["t"])
    frame = frame.assign(torque=torque, theta_e=frame["theta_e"] + torque / 50.0).drop(columns="u")
    judgements = judge_log(tmp_path, frame, {"absent": ["u"], "transmitted": "torque"})
    assert judgements["stiffness"][0] == "yes", judgements["stiffness"]
