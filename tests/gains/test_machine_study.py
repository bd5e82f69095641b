"""The study of a machine from its log: encoders as measured, and the rest of what a run needs."""

import dataclasses

import numpy as np
import pandas as pd
import pytest
from small_study import listed_axis, rigid_study

import jaxbl
from jaxbl.config import read_config
from jaxbl.gains.machine_study import TOLERANCE_FACTOR, complete_study, measure_encoders
from jaxbl.records import read_record

pytestmark = pytest.mark.usefixtures("compiled_once")

NOISE, COUNT = 2e-4, 5e-4


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    """A log of a coarse and noisy encoder."""
    time = 1e-3 * np.arange(4000)
    torque = np.cos(20.0 * time)
    noisy = -0.05 * torque + NOISE * np.random.default_rng(0).normal(size=len(time))
    file = tmp_path_factory.mktemp("log") / "log.csv"
    pd.DataFrame({"t": time, "u": torque, "theta_e": COUNT * np.round(noisy / COUNT)}).to_csv(file, index=False)
    return read_record(file)


def test_encoders_are_those_of_the_log(record):
    encoders = measure_encoders(record)
    assert encoders["motor_resolution"] == pytest.approx(COUNT)
    # what rounding adds is not counted twice
    assert encoders["noise"] == pytest.approx(NOISE, rel=0.2)
    assert set(encoders) == {"noise", "motor_resolution"}


def test_a_study_without_them_gets_tolerances_a_map_and_seeds(record):
    written = read_config(rigid_study({"run.velocity_tolerance": None, "run.position_tolerance": None}))
    data = complete_study(written.to_dict(), record, written)
    study = read_config(data)
    assert [axis.path for axis in study.axes] == ["observer.motor.lambda", "observer.motor.alpha"]
    assert study.tune is not None and study.sweep.seeds == 4
    # tolerances follow from the noise: of a run with it
    frame = jaxbl.sweep(data | {"axes": [], "figures": []}).frame
    for name in ("velocity", "position"):
        expected = TOLERANCE_FACTOR * frame[f"motor.{name}_rmse"].max()
        assert data["run"][f"{name}_tolerance"] == pytest.approx(expected, rel=0.01)


def test_what_the_study_sets_stays(record):
    axes = [listed_axis("observer.motor.alpha", 5.0, 9.0)]
    written = read_config(rigid_study({"run.velocity_tolerance": 0.7}, axes=axes, sweep={"seeds": 2}, tune={"num": 5}))
    data = complete_study(written.to_dict(), record, written)
    assert (data["run"]["velocity_tolerance"], data["sweep"]["seeds"], data["tune"]["num"]) == (0.7, 2, 5)
    assert [axis["path"] for axis in data["axes"]] == ["observer.motor.alpha"]
    assert data["notes"] == []
    # a doubt about the log stays with what follows from it
    doubt = "Doubtful: u is small."
    assert complete_study(written.to_dict(), dataclasses.replace(record, warnings=(doubt, "other")), written)["notes"] == [
        doubt
    ]
    # but for the encoders, which were measured
    assert data["encoders"]["motor_resolution"] == pytest.approx(COUNT)
