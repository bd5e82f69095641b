"""Lost motion and its interval, against logs whose gap is known."""

import json

import numpy as np
import pandas as pd
import pytest
from measured import GEAR_RATIO, SERVO, find_recording, simulate_log

from jaxbl.records import inspect, lost_motion
from jaxbl.records.gearing import fit_gearing
from jaxbl.records.resampling import Grid


def fit_frame(frame, expected=GEAR_RATIO):
    times, positions = frame["t"].to_numpy(), {name: frame[name].to_numpy() for name in ("theta_e", "theta_s")}
    grid = Grid(times, positions, [slice(0, len(times))], times[1] - times[0])
    return fit_gearing(grid, expected=expected, turn=2.0 * np.pi)


def simulate_load(seed, *, gap=0.02, drift=0.0, changes=(61.0,), turns_around=False):
    """Simulate a motor that turns to and fro, or on and on, under a load that changes its side at `changes`, s."""
    random = np.random.default_rng(seed)
    t = 0.02 * np.arange(6000)
    to_and_fro = 2.0 * np.abs((t + random.uniform(0.0, 30.0)) / 15.0 % 2.0 - 1.0)
    load = 1.3 * t + 0.3 * np.sin(0.2 * t) if turns_around else to_and_fro
    forwards = np.sign(np.gradient(load))
    side = np.sign(np.prod([t - switch_times for switch_times in changes], axis=0)) * 0.5
    # what repeats with place and direction, and what wanders about a tenth of a second or a place
    errors = 0.01 * np.sin(load + 1.0) + 0.003 * np.sin(7.0 * load) + 0.002 * forwards * np.sin(load)
    wander = np.convolve(random.standard_normal(len(t)), np.ones(10) / 10.0**0.5, "same") * 2e-3
    load = load + 1e-4 * random.standard_normal(len(t))
    motor = load + gap * side + errors + wander + drift * np.cumsum(random.standard_normal(len(t)))
    return pd.DataFrame({"t": t, "theta_e": motor, "theta_s": load})


@pytest.mark.parametrize(
    ("gap", "quality"),
    [(0.1, {"noise": 1e-2}), (0.5, {"noise": 1e-3, "skew": 1.3e-3}), (0.05, {"noise": 1e-3, "resolution": 5e-3})],
)
def test_intervals_by_the_direction_of_motion_cover_the_gap(gap, quality, repeats):
    count = repeats(16, 50)
    fits = [fit_frame(simulate_log(gap=gap, seed=seed, **quality)) for seed in range(count)]
    assert all(f.flank == "motion" and f.flank_changes >= 2 for f in fits)
    covered = sum(f.lost_motion_interval[0] <= gap <= f.lost_motion_interval[1] for f in fits)
    assert covered >= 0.9 * count
    # not by being wide
    spread = np.std([f.lost_motion for f in fits])
    assert np.mean([f.lost_motion_error for f in fits]) < 1.6 * spread + 2e-4 * gap
    assert np.mean([f.lost_motion for f in fits]) == pytest.approx(gap, rel=5e-3)


@pytest.mark.parametrize("options", [{}, {"changes": (31.0, 63.0, 100.0)}, {"turns_around": True}])
def test_intervals_by_the_side_of_the_load_cover_the_gap(options, repeats):
    count = repeats(10, 30)
    fits = [fit_frame(simulate_load(seed, **options), 1.0) for seed in range(count)]
    assert all(f.flank == "load" and f.flank_changes == len(options.get("changes", (61.0,))) for f in fits)
    covered = sum(f.lost_motion_interval[0] <= 0.02 <= f.lost_motion_interval[1] for f in fits)
    assert covered >= 0.9 * count
    spread = np.std([f.lost_motion for f in fits])
    assert np.mean([f.lost_motion_error for f in fits]) < 2.0 * spread
    times = np.array([f.flank_times for f in fits])
    assert np.abs(times - np.array(options.get("changes", (61.0,)))).max() < 2.0


@pytest.mark.parametrize("around", [False, True])
def test_a_load_that_stays_on_one_side_and_a_drift_show_no_lost_motion(around, repeats):
    for seed in range(repeats(4, 10)):
        for options in ({"gap": 0.0}, {"gap": 0.0, "drift": 1e-4}):
            fit = fit_frame(simulate_load(seed, turns_around=around, **options), 1.0)
            assert fit.flank == "motion", (seed, options)
            assert not fit.exceeds_noise(1e-4) or fit.lost_motion < 0.005


def test_places_where_the_load_hardly_pulls_do_not_count():
    """A quarter of the range where only half of the gap is crossed."""
    frame = simulate_load(3)
    after_change = frame["t"] > 61.0
    frame["theta_e"] -= np.where(after_change & (frame["theta_s"] < 0.5), 0.01, 0.0)
    fit = fit_frame(frame, 1.0)
    assert fit.lost_motion == pytest.approx(0.02, rel=0.05)
    assert fit.lost_motion_range[0] < 0.012 and fit.lost_motion_range[1] > 0.019


def test_it_is_told_with_its_interval(tmp_path):
    simulate_load(0).to_parquet(tmp_path / "log.parquet")
    inspection = inspect(tmp_path / "log.parquet", {"absent": ["u"]}, gear_ratio=1.0)
    reason = next(j.reason for j in inspection.identifiability if j.quantity == "lost motion")
    assert reason.startswith("theta_e shifts by 0.0") and reason.endswith("as the load torque changes its sign")
    assert any(
        "after the load torque changed its sign, at 6" in note and "slipped coupling" in note
        for note in inspection.record.notes
    )
    simulate_log(gap=0.1, noise=1e-3).to_parquet(tmp_path / "log.parquet")
    inspection = inspect(tmp_path / "log.parquet", gear_ratio=GEAR_RATIO)
    assert any("changes of the flank by the direction of motion" in note for note in inspection.record.notes)
    data = json.loads(json.dumps(inspection.to_dict(), allow_nan=False))["gearing"]
    assert data["lost_motion"] == pytest.approx(0.1, rel=0.02)
    assert data["lost_motion_interval"][0] < 0.1 < data["lost_motion_interval"][1]
    assert data["flank"] == "motion"


def test_too_little_tells_nothing():
    t = 0.01 * np.arange(400)
    for load in (t, np.sin(t), np.zeros(400)):
        assert lost_motion.fit_lost_motion_by_load(t, 0.1 * np.sign(t - 2.0), load, np.gradient(load, t), np.inf) is None


def test_a_real_servo_whose_load_was_turned_around():
    """Published: the load's direction is reversed at 60 to 66 s, which shifts one encoder by 0.39 to 0.40 degrees."""
    inspection = inspect(find_recording("servoproject_dual_encoder/outputEncoderData.txt"), SERVO, gear_ratio=1.0)
    lost = inspection.record.statistics.gearing
    low, high = np.degrees(lost.lost_motion_interval)
    assert lost.flank == "load" and len(lost.flank_times) == 1
    assert 60.0 < lost.flank_times[0] < 66.0
    assert np.degrees(lost.lost_motion) == pytest.approx(0.395, abs=0.01)
    assert low < 0.39 and high > 0.40 and high - low < 0.15
    assert next(j for j in inspection.identifiability if j.quantity == "lost motion").answer == "yes"
    assert any(note.startswith("Lost motion at the motor: 0.0069") for note in inspection.record.notes)
