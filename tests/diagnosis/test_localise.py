"""Where a residual lives: what is there is found where it is, and noise, correlated or not, is found nowhere."""

import dataclasses
import json

import numpy as np
import pytest
from hidden_log import simulate_study
from scipy.signal import lfilter
from small_study import rigid_study, small_study
from trace_segment import make_segment

from jaxbl.config import prepare, read_config
from jaxbl.diagnosis.coordinates import CoordinateValues, all_coordinates, coordinates_of
from jaxbl.diagnosis.localise import localise, locate
from jaxbl.diagnosis.residuals import Residual, residual_torques
from jaxbl.diagnosis.sentences import sentence_of
from jaxbl.diagnosis.thresholds import LIMITS

PERIOD, COUNT = 5e-3, 4000
TIME = PERIOD * np.arange(COUNT)
RATE = 2.0 * np.pi * np.array([0.31, 0.53, 0.97])
SIZE = np.array([6.0, 2.0, 0.7])
POSITION = np.sum(SIZE * np.sin(RATE * TIME[:, None] + [0.0, 1.0, 2.0]), axis=1)
VELOCITY = np.sum(SIZE * RATE * np.cos(RATE * TIME[:, None] + [0.0, 1.0, 2.0]), axis=1)
POLE = 0.9


def make_coordinates(**further_coordinates):
    crossing = np.flatnonzero(np.diff(np.sign(VELOCITY)))
    reversal_class = np.zeros(COUNT, int)
    for row in crossing:
        reversal_class[max(row - 12, 0) : row + 12] = 1 if VELOCITY[row + 1] > 0.0 else 2
    values = {
        "all": CoordinateValues(np.zeros(COUNT, int), classes=("everywhere",)),
        "direction": CoordinateValues((VELOCITY > 0.0).astype(int), classes=("backward", "forward")),
        "reversals": CoordinateValues(
            reversal_class, classes=("away from reversals", "reversals to forward", "reversals to backward")
        ),
        "|speed|": CoordinateValues(np.abs(VELOCITY), "rad/s", symbol="|ω|"),
        "speed": CoordinateValues(VELOCITY, "rad/s", symbol="ω"),
        "turn": CoordinateValues(np.mod(POSITION, 2.0 * np.pi), "rad", symbol="θe mod 2π"),
        "position": CoordinateValues(POSITION, "rad", symbol="θe"),
        "time": CoordinateValues(TIME, "s", symbol="t"),
    }
    return values | further_coordinates


def draw_noise(seed, pole=0.0):
    random = np.random.default_rng(seed)
    white = random.standard_normal(COUNT + 500)
    return lfilter([np.sqrt(1.0 - pole**2)], [1.0, -pole], white)[500:]


def make_residual(torque, pole=0.0, level=0.1):
    density = (1.0 - pole**2) / np.abs(1.0 - pole * np.exp(1j * np.linspace(0.0, np.pi, 1025))) ** 2
    return Residual("motor", TIME, torque, np.full(COUNT, level), density, 0.5 / PERIOD)


def locate_torque(torque, seed=0, pole=0.0, **further_coordinates):
    return locate([make_residual(torque + 0.1 * draw_noise(seed, pole), pole)], [make_coordinates(**further_coordinates)])


@pytest.mark.parametrize("pole", [0.0, POLE], ids=["white", "correlated"])
def test_noise_is_found_nowhere(pole, repeats):
    """A false region in sixty logs would be chance; z-scores have the spread that they claim."""
    count, false, z, excess, explained = repeats(15, 60), 0, [], [], []
    for seed in range(count):
        location = locate_torque(np.zeros(COUNT), seed, pole)
        false += location.significant
        for name in ("speed", "position", "time"):
            z += [region.mean_z for region in location.coordinates[name].regions]
            excess += [region.excess_z for region in location.coordinates[name].regions]
        explained += [coordinate.explained for coordinate in location.coordinates.values()]
        assert location.significant or sentence_of(location).startswith("motor side: nothing beyond noise")
    assert false <= count // 60
    assert 0.75 < np.std(z) < 1.1
    assert 0.7 < np.std(excess) < 1.15 and abs(np.mean(excess)) < 0.2
    assert max(explained) == 0.0


def test_a_slow_disturbance_is_no_function_of_the_motion(repeats):
    """Noise that the stated level does not know of, over half a second: power is missing, but at no place of the motion."""
    count, false = repeats(6, 20), 0
    for seed in range(count):
        location = locate_torque(0.2 * draw_noise(100 + seed, 0.99), seed)
        assert location.significant and location.excess_z > LIMITS.significant
        for name in ("direction", "reversals", "|speed|", "speed", "turn"):
            assert location.coordinates[name].explained < 0.25
            false += any(abs(region.mean_z) > LIMITS.significant for region in location.coordinates[name].regions)
    assert false <= count // 20


CASES = {
    "everywhere": ("all", np.full(COUNT, 0.2), "alike everywhere"),
    "coulomb": ("direction", -0.3 * np.sign(VELOCITY), "by the direction of motion"),
    "viscous": ("speed", -0.03 * VELOCITY, "a function of speed"),
    "fast": ("|speed|", 0.05 * np.abs(VELOCITY), "by the size of the speed"),
    "cogging": ("turn", 0.3 * np.sin(6.0 * POSITION), "a function of the position within a turn"),
    "spring": ("position", -0.05 * POSITION, "a function of position"),
}


@pytest.mark.parametrize("case", CASES)
def test_each_coordinate_is_found_for_what_lives_there(case):
    name, torque, words = CASES[case]
    location = locate_torque(torque)
    assert location.significant
    assert location.coordinates[name].explained > 0.9
    assert words in sentence_of(location)
    assert location.missing == pytest.approx(np.sqrt(np.mean(torque**2)), rel=0.1)
    assert sum(region.power_share for region in location.coordinates[name].regions) == pytest.approx(1.0, abs=0.05)


def test_reversals_low_speed_places_and_times_are_told():
    slow = np.where(np.abs(VELOCITY) < 1.0, -0.6 * np.sign(VELOCITY), 0.0)
    location = locate_torque(slow)
    near = [region for region in location.coordinates["reversals"].regions if region.label.startswith("reversals")]
    assert sum(region.power_share for region in near) > 0.6 and sum(region.time_share for region in near) < 0.3
    sentence = sentence_of(location)
    assert sentence.startswith("motor side, at ") and "of the residual power lies" in sentence
    dent = np.where(np.abs(POSITION - 2.0) < 0.3, 0.8, 0.0)
    assert "< θe <" in sentence_of(locate_torque(dent))
    knock = np.where(np.abs(TIME - 12.0) < 0.4, 1.0, 0.0) * np.sin(40.0 * TIME)
    assert "for a while" in sentence_of(locate_torque(knock))


def test_the_gap_is_told():
    inside = (np.abs(np.sin(3.0 * TIME)) < 0.2).astype(int)
    gap = CoordinateValues(inside, classes=("outside", "inside of the gap"))
    location = locate_torque(0.4 * inside * np.sign(np.sin(7.3 * TIME)), gap=gap)
    assert "inside of the gap" in sentence_of(location)


def test_a_disturbance_of_its_own_frequency_is_a_narrow_peak():
    location = locate_torque(0.2 * np.sin(2.0 * np.pi * 7.3 * TIME))
    peak = location.peaks[0]
    assert peak.frequency == pytest.approx(7.3, abs=0.05)
    assert peak.amplitude == pytest.approx(0.2, rel=0.1)
    assert not peak.in_motion and "7.3 Hz" in sentence_of(location)
    # friction has peaks, too, but where the motion has them
    friction = locate_torque(-0.3 * np.sign(VELOCITY))
    assert friction.peaks[0].in_motion and "Hz" not in sentence_of(friction)


def test_weak_torques_are_found_below_the_noise_of_a_sample():
    location = locate_torque(-0.03 * np.sign(VELOCITY))
    assert location.significant and location.coordinates["direction"].explained > 0.7
    backward, forward = location.coordinates["direction"].regions
    assert backward.mean == pytest.approx(0.03, abs=4.0 * backward.mean_error)
    assert forward.mean == pytest.approx(-0.03, abs=4.0 * forward.mean_error)
    # a torque below the floor is not spoken of
    torque = -0.03 * np.sign(VELOCITY) + 0.1 * draw_noise(0)
    assert not locate([make_residual(torque)], [make_coordinates()], floor=0.1).significant


def test_parts_of_a_record_are_counted_together():
    torque = -0.1 * np.sign(VELOCITY) + 0.1 * draw_noise(3)
    full_residual = make_residual(torque)
    rows = slice(0, 1500), slice(1700, COUNT)
    parts = [
        dataclasses.replace(full_residual, time=TIME[r], torque=torque[r], deviation=full_residual.deviation[r])
        for r in rows
    ]  # fmt: skip
    part_coordinates = [
        {name: location._replace(values=location.values[r]) for name, location in make_coordinates().items()} for r in rows
    ]
    location = locate(parts, part_coordinates)
    assert location.coordinates["direction"].explained > 0.85
    assert sum(region.time_share for region in location.coordinates["speed"].regions) == pytest.approx(1.0)


SETTINGS = {"run.duration": 4.0, "run.substeps": 5}
LAW = {"law": "dead_zone", "stiffness": 60.0, "half_gap": 0.08}
GEARED = {
    "transmission": LAW,
    "excitation": {"kind": "multisine", "amplitude": 5.0, "frequency": 0.5},
    "observer": {"motor": {"lambda": 20.0, "alpha": 400.0}, "load": {"lambda": 3.0, "alpha": 20.0}},
}


def simulate_residuals(true, model):
    segment = make_segment(simulate_study(true))
    experiment = prepare(read_config(model))
    return experiment, residual_torques(experiment, [segment]), segment


def test_a_geared_drive_with_hidden_friction_on_its_load():
    hidden = [{"kind": "load.coulomb_friction", "torque": 0.8}]
    experiment, residuals, segment = simulate_residuals(
        small_study(SETTINGS, effects=hidden, **GEARED), small_study(SETTINGS, **GEARED)
    )
    location = localise(experiment, residuals, [segment], all_coordinates(experiment, [segment], residuals, ()))
    assert not location["motor"].significant
    assert "by the direction of motion" in sentence_of(location["load"])
    backward, *_, forward = location["load"].coordinates["direction"].regions
    assert backward.mean == pytest.approx(0.8, rel=0.15) and forward.mean == pytest.approx(-0.8, rel=0.15)
    assert {"gap", "load sign", "twist", "twist rate"} <= set(location["motor"].coordinates)
    assert json.loads(json.dumps(dataclasses.asdict(location["load"])))["name"] == "load"


def test_coordinates_know_turning_from_sliding():
    moving = rigid_study(SETTINGS, excitation={"kind": "multisine", "amplitude": 3.0, "frequency": 0.2})
    experiment, residuals, segment = simulate_residuals(moving, moving)
    turning = coordinates_of(experiment, segment, residuals["motor"][0])
    sliding = coordinates_of(experiment, segment, residuals["motor"][0], ["motor"])
    assert turning["speed"].unit == "rad/s" and sliding["speed"].unit == "m/s"
    assert "turn" in turning and "turn" not in sliding and "gap" not in turning
    assert np.ptp(turning["turn"].values) <= 2.0 * np.pi
    assert experiment.plant.half_gap == 0.0
    added = [{"kind": "transmission.backlash", "half_gap": 0.02}]
    assert prepare(read_config(small_study(SETTINGS, effects=added, **GEARED))).plant.half_gap == pytest.approx(0.1)
    assert segment.time.shape == turning["time"].values.shape
