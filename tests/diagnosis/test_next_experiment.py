"""What is said of the next experiment, and where none can be written."""

from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from jaxbl.config import read_model
from jaxbl.diagnosis.next_experiment import Input, _write_input, check_gap_sought, write_gap_experiment
from jaxbl.errors import InputError
from jaxbl.records.reader import Record

DRIVE = {
    "kind": "two_inertia", "motor_inertia": 0.05, "motor_viscous": 0.15, "load_inertia": 7.0, "load_viscous": 16.0,
    "gear_ratio": 5.0,
}  # fmt: skip
STUDY = {"drive": DRIVE, "transmission": {"law": "dead_zone", "stiffness": 60.0, "half_gap": 0.01}}


def make_task(transmission=STUDY["transmission"], sides=("motor",)):
    record = SimpleNamespace(path=Path("log.csv"), positions=dict.fromkeys(sides), sample_period=1e-3)
    return SimpleNamespace(config=read_model(STUDY | {"transmission": transmission})[0], record=record)


def test_a_move_that_shows_a_gap_is_for_the_motor_alone_and_a_model_with_one():
    check_gap_sought(make_task())  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"log\.csv: .* this log has theta_s; jaxbl diagnose --next-experiment"):
        check_gap_sought(make_task(sides=("motor", "load")))  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"log\.csv: .* a half_gap \(or dead_zone\) in \[transmission\]"):
        check_gap_sought(make_task({"law": "linear_shaft", "stiffness": 60.0}))  # type: ignore[arg-type]


def test_a_diagnosis_that_seeks_no_gap_writes_no_experiment(tmp_path):
    line = write_gap_experiment(tmp_path, {"backlash": None}, SimpleNamespace(), tmp_path / "next.csv")  # type: ignore[arg-type]
    assert line.startswith("No gap is sought: the model has one")


@pytest.mark.parametrize(("unit", "torque_unit"), [("rad", "N m"), ("m", "N")])
def test_the_amplitude_said_is_about_the_mean_of_the_file_and_in_its_unit(tmp_path, unit, torque_unit):
    channels = {"theta_e": SimpleNamespace(unit=unit)}
    record = SimpleNamespace(sample_period=1e-2, statistics=SimpleNamespace(channels=channels))
    record.unit_of = partial(Record.unit_of, record)
    torque = 1.5 + 2.0 * np.sin(2.0 * np.pi * 1e-2 * np.arange(100))
    path = tmp_path / "next.csv"
    line = _write_input(Input("sine", 2.0, 1.0, torque, 20.0, 1.5), record, path)  # type: ignore[arg-type]
    assert line.startswith(f"sine of 2 {torque_unit} about a mean of 1.5 {torque_unit}, 1 Hz, 1 s;")
    assert np.ptp(pd.read_csv(path)["u"]) == pytest.approx(4.0, rel=1e-6)
