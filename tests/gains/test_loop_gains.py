"""Gains of a closed loop: beside a linear loop written out in NumPy, its covariance, its poles, and an optimiser."""

import copy

import numpy as np
import pytest
from scipy.optimize import brentq, minimize

import jaxbl
from jaxbl.errors import InputError
from jaxbl.report.results import write_report

pytestmark = pytest.mark.usefixtures("compiled_once")

J, D, H, NOISE = 0.05, 0.15, 1e-3, 1e-4
AMPLITUDE, FREQUENCY = 0.02, 1.0
BANDWIDTH, POSITION, SPEED = "observer.motor.bandwidth", "controller.position_gain", "controller.speed_gain"
STUDY = {
    "drive": {"kind": "rigid", "motor_inertia": J, "motor_viscous": D},
    "encoders": {"noise": NOISE},
    "observer": {"kind": "extended_state", "motor": {"bandwidth": 100.0}},
    "controller": {"kind": "cascade", "position_gain": 10.0, "speed_gain": 1.0, "velocity_feedforward": 0.0},
    "reference": {"kind": "sine", "amplitude": AMPLITUDE, "frequency": FREQUENCY},
    "run": {"duration": 12.0, "sample_period": H, "substeps": 4},
    "sweep": {"seeds": 2},
    "tune": {
        "objective": "following", "trials": 128, "refine": 3,
        "gains": [{"path": POSITION, "start": 3.0, "stop": 3000.0}, {"path": SPEED, "start": 0.3, "stop": 30.0}],
    },
}  # fmt: skip


def loop_matrices(bandwidth, position_gain, speed_gain):
    """The loop x+ = A x + B r + E n of position, velocity, torque, and predicted position, velocity and disturbance."""
    decay = np.exp(-D / J * H)
    plant = np.array([[1.0, (1.0 - decay) * J / D], [0.0, decay]])
    torque = np.array([(H - (1.0 - decay) * J / D) / D, (1.0 - decay) / D])
    beta = np.exp(-bandwidth * H)
    shares = np.array([1 - beta**3, 1.5 * (1 - beta) ** 2 * (1 + beta) / H, (1 - beta) ** 3 / H**2])
    reading = np.array([1.0, 0, 0, 0, 0, 0])
    corrected = np.hstack([np.zeros((3, 3)), np.eye(3)]) + np.outer(shares, reading - [0, 0, 0, 1.0, 0, 0])
    accelerates = (np.array([0, 0, 1.0, 0, 0, 0]) - D * corrected[1]) / J + corrected[2]
    a = np.zeros((6, 6))
    a[:2, :2], a[:2, 2] = plant, torque
    a[2] = -speed_gain * (position_gain * reading + corrected[1])
    a[3], a[4], a[5] = (
        corrected[0] + H * corrected[1] + 0.5 * H**2 * accelerates,
        corrected[1] + H * accelerates,
        corrected[2],
    )
    b, e = np.zeros(6), np.zeros(6)
    b[2] = speed_gain * position_gain
    accelerates = -D / J * shares[1] + shares[2]
    e[2] = -speed_gain * (position_gain + shares[1])
    e[3:] = shares[0] + H * shares[1] + 0.5 * H**2 * accelerates, shares[1] + H * accelerates, shares[2]
    return a, b, e


def following_rms(bandwidth, position_gain, speed_gain):
    """Rms following error: of the sine, and of the encoder's noise."""
    a, b, e = loop_matrices(bandwidth, position_gain, speed_gain)
    if np.abs(np.linalg.eigvals(a)).max() >= 1.0:
        return np.inf
    response = np.linalg.solve(np.exp(2j * np.pi * FREQUENCY * H) * np.eye(6) - a, b)[0]
    covariance, power = NOISE**2 * np.outer(e, e), a
    for _ in range(16):
        covariance, power = covariance + power @ covariance @ power.T, power @ power
    return np.sqrt(0.5 * AMPLITUDE**2 * abs(1.0 - response) ** 2 + covariance[0, 0])


@pytest.fixture(scope="module")
def tuning():
    return jaxbl.tune(STUDY)


def test_errors_are_those_of_the_linear_loop(tuning):
    tried = tuning.candidates[::20]
    tried = tried[tried["error"] < 0.01]
    assert len(tried) > 10
    expected = [following_rms(100.0, *gains) for gains in tried[[POSITION, SPEED]].to_numpy()]
    np.testing.assert_allclose(tried["error"], expected, rtol=0.06)


def test_tuned_gains_are_as_good_as_the_optimum(tuning):
    best = minimize(lambda logs: following_rms(100.0, *np.exp(logs)), np.log([10.0, 1.0]), method="Nelder-Mead")
    found = following_rms(100.0, *tuning.summary["gains"].values())
    assert best.fun <= found < 1.05 * best.fun
    assert found < 0.2 * following_rms(100.0, 10.0, 1.0)
    ranking = tuning.summary["ranking"]
    assert ranking["study"]["low"] > 5.0
    assert ranking["tuned"]["error"] == pytest.approx(found, rel=0.06)


def test_observer_and_controller_are_searched_together():
    study = copy.deepcopy(STUDY)
    study["tune"]["gains"] = [{"path": BANDWIDTH}, *study["tune"]["gains"]]
    bounds = np.log([[10.0, 1000.0], [3.0, 3000.0], [0.3, 30.0]])
    best = minimize(
        lambda logs: following_rms(*np.exp(logs)), np.log([100.0, 10.0, 1.0]), method="Nelder-Mead", bounds=bounds
    )
    assert following_rms(*jaxbl.tune(study).summary["gains"].values()) < 1.1 * best.fun


def test_margins_are_those_of_the_poles():
    study = copy.deepcopy(STUDY) | {"encoders": {}, "initial": {"motor_position": 0.02}}
    study["reference"]["amplitude"] = 0.0
    ranges = [{"path": POSITION, "start": 90.0, "stop": 110.0}, {"path": SPEED, "start": 2.5, "stop": 3.5}]
    study["tune"] |= {"trials": 8, "refine": 0, "gains": ranges}
    summary = jaxbl.tune(study).summary
    gains = np.array(list(summary["gains"].values()))
    for i, path in enumerate(summary["gains"]):

        def growth(log, i=i):
            factors = np.ones(2)
            factors[i] = np.exp(log)
            return np.abs(np.linalg.eigvals(loop_matrices(100.0, *(factors * gains))[0])).max() - 1.0

        border = np.exp(brentq(growth, 0.0, np.log(64.0)))
        assert summary["margins"][path]["up"] == pytest.approx(border, rel=0.02)


def test_verify_has_the_loop_s_margins(tmp_path):
    """A loop that takes the speed from differences; its observers are judged beside it."""
    study = copy.deepcopy(STUDY) | {
        "encoders": {},
        "initial": {"motor_position": 0.02},
        "effects": [{"kind": "motor.constant_torque", "torque": 0.01}],
        "observer": {"motor": {"lambda": 2.0, "alpha": 2.0, "velocity_error": 0.1}},
        "axes": [
            {"path": "observer.motor.lambda", "values": [1.0, 2.0]}, {"path": "observer.motor.alpha", "values": [1.0, 2.0]},
            {"path": SPEED, "values": [5.0, 6.0]},
        ],
        "verify": {
            "damping": [], "alpha_ratio": {"start": 1.1, "stop": 4.0, "num": 3},
            "lambda_ratio": {"start": 0.3, "stop": 3.0, "num": 3},
        },
    }  # fmt: skip
    study["controller"] = {"kind": "cascade", "position_gain": 10.0, "speed_gain": 5.0, "speed_from": "differences"}
    del study["tune"]
    verdict = jaxbl.verify(study, tmp_path / "out")
    margins = verdict.summary["loop_margins"]
    assert list(margins) == ["observer.motor.lambda", "observer.motor.alpha", SPEED]
    assert margins["observer.motor.lambda"] == {"down": None, "up": None}

    def growth(factor):
        a = np.zeros((4, 4))  # position, velocity, torque, last position
        decay = np.exp(-D / J * H)
        a[0, :3] = 1.0, (1.0 - decay) * J / D, (H - (1.0 - decay) * J / D) / D
        a[1, 1:3] = decay, (1.0 - decay) / D
        a[2, [0, 3]] = -5.0 * factor * (10.0 + 1.0 / H), 5.0 * factor / H
        a[3, 0] = 1.0
        return np.abs(np.linalg.eigvals(a)).max() - 1.0

    assert margins[SPEED]["up"] == pytest.approx(brentq(growth, 1.0, 64.0), rel=0.02)
    assert jaxbl.describe(verdict).tables[-1].rows[-1] == [SPEED, *margins[SPEED].values()]


def test_a_limit_that_none_keeps_is_said():
    study = copy.deepcopy(STUDY)
    study["tune"] |= {"trials": 8, "refine": 0, "largest_limit_cycle": 1e-7}
    with pytest.raises(jaxbl.NoResult, match="no gains of the loop stay finite and keep longest_settling"):
        jaxbl.tune(study)


def test_files_can_be_included(tuning, tmp_path):
    card = write_report(tuning, tmp_path / "out")
    assert (card.verdict, len(card.key_figures)) == ("good", 2)
    again = jaxbl.read_config({**STUDY, "controller": {"kind": "cascade", **STUDY["controller"]}})
    study = tmp_path / "study.toml"
    study.write_text(again.to_toml(), encoding="utf-8")
    merged = jaxbl.read_config({"include": [str(study), str(tmp_path / "out" / "gains.toml")]})
    assert merged.controller.position_gain == tuning.summary["gains"][POSITION]
    assert merged.controller.velocity_feedforward == 0.0


BAD = {
    "path": ({"gains": [{"path": "controller.gain"}]}, {}, "tune.gains[0].path: unknown path 'controller.gain'; nearest"),
    "zero": (
        {"gains": [{"path": "controller.inertia_feedforward"}]},
        {},
        "tune.gains: controller.inertia_feedforward is 0 in the study; give its start and stop in [[tune.gains]]",
    ),
    "twice": ({"gains": [{"path": POSITION}, {"path": POSITION}]}, {}, f"gains[1].path: '{POSITION}' is listed already"),
    "range": ({"gains": [{"path": POSITION, "start": 2.0, "stop": 1.0}]}, {}, "start 2.0 should be less than stop 1.0"),
    "objective": ({"objective": "velocity"}, {}, "tune: gains needs an objective of the loop: following, settling"),
    "observers": ({"observers": ["luenberger"]}, {}, "observers does not go with objective = 'following'"),
    "open": ({}, {"controller": None, "reference": None}, "tune.objective: 'following' is that of a loop; add [controller]"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line(case):
    table, tables, message = BAD[case]
    study = copy.deepcopy(STUDY) | tables
    study["tune"] |= table
    study = {name: value for name, value in study.items() if value is not None} | {
        "excitation": {"kind": "sine", "amplitude": 0.1, "frequency": 1.0}
    }
    with pytest.raises(InputError) as error:
        jaxbl.tune(study)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
