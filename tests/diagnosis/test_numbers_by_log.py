"""Logs of one machine that do not agree on its numbers, on torques that are known in closed form."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from jaxbl.config import prepare, read_model
from jaxbl.diagnosis.numbers_by_log import contradictions
from jaxbl.estimation.free_parameters import make_free_parameters

INERTIA, VISCOUS, SAMPLES = 4e-5, 1e-4, 4000


@dataclasses.dataclass(frozen=True)
class Torques:
    """A log that knows the torque of its machine; `truth`: inertia of each part; `noise` of torques, N m,
    and how much of it is there."""

    segments: tuple
    truth: tuple
    motion_scale: float = 1.0
    noise: float = 1e-4
    noise_scale: float = 1.0
    friction: float = 0.0
    is_beside: bool = True

    def missing(self, experiment, name="torque"):
        if name == "deviation":
            return {"motor": np.full(len(self.segments) * SAMPLES, self.noise)}
        result = []
        for segment in self.segments:
            i = segment.rows.start // SAMPLES
            time = 1e-3 * np.arange(SAMPLES)
            # where dry friction is, the second log moves by half as much
            scale = self.motion_scale / (1 + i * bool(self.friction))
            speed, change = scale * 30.0 * np.sin(5.0 * time + i), scale * 150.0 * np.cos(5.0 * time + i)
            noise = self.noise_scale * self.noise * np.random.default_rng(i).standard_normal(SAMPLES)
            drive = experiment.drive
            result.append(
                (self.truth[i] - float(drive.motor_inertia)) * change
                + (VISCOUS - float(drive.motor_viscous)) * speed
                + self.friction * np.sign(speed)
                + noise
            )
        return {"motor": np.concatenate(result)}

    def lacking_friction(self, experiment, side):
        time, count = 1e-3 * np.arange(SAMPLES), len(self.segments) * SAMPLES
        phases = [segment.rows.start // SAMPLES for segment in self.segments]
        direction = np.concatenate([np.sign(np.sin(5.0 * time + i)) for i in phases])
        return self.is_beside * np.stack([direction, np.ones(count)]), np.full(count, True)


def compare_logs(
    first: float,
    second: float,
    motion_scale: float = 1.0,
    files: tuple = ("a.csv", "b.csv"),
    noise: float = 1e-4,
    noise_scale: float = 1.0,
    friction: float = 0.0,
    is_beside: bool = True,
):
    rows = [slice(0, SAMPLES), slice(SAMPLES, 2 * SAMPLES)]
    names = list(zip(map(Path, files), rows, strict=True))
    segments = tuple(SimpleNamespace(rows=row) for row in rows)
    task = SimpleNamespace(record=SimpleNamespace(logs=names, unit_of=lambda path, unit: unit))
    config, _ = read_model({"drive": {"kind": "rigid", "motor_inertia": INERTIA, "motor_viscous": VISCOUS}})
    with jax.enable_x64(True):
        experiment = prepare(config.with_keys("run", precision="float64"))
        free = make_free_parameters(experiment, ["drive.motor_inertia", "drive.motor_viscous"], 1.0)
        fitted = SimpleNamespace(experiment=experiment, free=free, theta=np.zeros(2))
        log = Torques(segments, (first, second), motion_scale, noise, noise_scale, friction, is_beside)
        return contradictions(task, fitted, log, 5e-3)  # type: ignore[arg-type]


def test_an_inertia_that_two_logs_show_to_differ():
    (contradiction,) = compare_logs(INERTIA, 1.5 * INERTIA)
    least, most = contradiction["logs"]
    assert contradiction["parameter"] == "drive.motor_inertia" and (least["log"], most["log"]) == ("a.csv", "b.csv")
    assert least["value"] == pytest.approx(INERTIA, abs=4.0 * least["standard_error"])
    assert most["value"] == pytest.approx(1.5 * INERTIA, rel=0.01)


def test_logs_of_one_name_are_two():
    (contradiction,) = compare_logs(INERTIA, 1.5 * INERTIA, files=("data/run1/log.csv", "data/run2/log.csv"))
    assert [of_log["log"] for of_log in contradiction["logs"]] == ["run1/log.csv", "run2/log.csv"]


def test_logs_of_one_machine_agree():
    assert compare_logs(INERTIA, INERTIA) == []


def test_a_friction_that_the_model_lacks_is_no_contradiction():
    """Dry friction of one machine would be a viscous friction, a larger one where the drive moves less."""
    (contradiction,) = compare_logs(INERTIA, INERTIA, friction=5e-3, is_beside=False)
    assert contradiction["parameter"] == "drive.motor_viscous"
    assert compare_logs(INERTIA, INERTIA, friction=5e-3) == []
    # another inertia shows beside it
    assert compare_logs(INERTIA, 1.5 * INERTIA, friction=5e-3) != []


def test_a_difference_without_torque_is_no_contradiction():
    assert compare_logs(INERTIA, 1.5 * INERTIA, motion_scale=0.05) == []


def test_a_motion_that_noise_all_but_hides_says_nothing_of_an_inertia():
    # of a load that stands still the acceleration is noise, and so is what a log says of its inertia
    assert compare_logs(INERTIA, 1.5 * INERTIA, noise=1e-3) != []
    assert compare_logs(INERTIA, 1.5 * INERTIA, noise=2e-3) == []


def test_blocks_that_agree_beyond_what_noise_allows_have_measured_nothing():
    # of a drive that stands still a model says both sides of the equation
    assert compare_logs(INERTIA, 1.5 * INERTIA, noise_scale=0.1) != []
    assert compare_logs(INERTIA, 1.5 * INERTIA, noise_scale=1e-5) == []
