"""Measured logs for tests: made ones whose truth is known, and where the real ones lie."""

import dataclasses
import os
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from jaxbl.records import NominalDrive, Record, read_record

GEAR_RATIO, INERTIA, VISCOUS, COULOMB = 20.0, 0.01, 0.05, 0.1


def follow_with_play(positions: np.ndarray, width: float) -> np.ndarray:
    """Positions behind a gap."""
    load_positions, load_position = np.empty_like(positions), positions[0]
    for i, position in enumerate(positions):
        load_position = min(max(load_position, position - 0.5 * width), position + 0.5 * width)
        load_positions[i] = load_position
    return load_positions


def simulate_log(
    times: np.ndarray | None = None,
    *,
    count: int = 4000,
    period: float = 1e-3,
    skew: float = 0.0,
    gap: float = 0.0,
    noise: float = 0.0,
    resolution: float = 0.0,
    seed: int = 0,
) -> pd.DataFrame:
    """A log of a geared drive in multisine motion: t, u, theta_e, theta_s.

    Args:
        times: stamps, s; left out: even ones.
        count: of the even ones.
        period: of the even ones, s; torques are means over it from each stamp on.
        skew: by how much the load's stamps are late, s.
        gap: lost motion, rad at the motor.
        noise: of both encoders, rad rms at the motor.
        resolution: of both encoders, rad at the motor.
        seed: of phases and noise.
    """
    random = np.random.default_rng(seed)
    t = period * np.arange(count) if times is None else np.asarray(times)
    frequency, size = np.array([0.5, 0.83, 1.27, 2.1]), np.array([20.0, 10.0, 8.0, 4.0])
    phase = random.uniform(0.0, 2.0 * np.pi, 4)

    def motion(times: np.ndarray, derivative: int) -> np.ndarray:
        rate = 2.0 * np.pi * frequency
        angle = rate * times[:, None] + phase + 0.5 * np.pi * derivative
        return (size * rate**derivative * np.sin(angle)).sum(axis=1)

    middle = t + 0.5 * period
    u = INERTIA * motion(middle, 2) + VISCOUS * motion(middle, 1) + COULOMB * np.tanh(motion(middle, 1) / 0.5)
    motor = motion(t, 0) + noise * random.standard_normal(len(t))
    load = follow_with_play(motion(t - skew, 0), gap) + noise * random.standard_normal(len(t))
    if resolution:
        motor, load = (np.round(x / resolution) * resolution for x in (motor, load))
    return pd.DataFrame({"t": t, "u": u, "theta_e": motor, "theta_s": load / GEAR_RATIO})


LATE_PERIOD = 0.01


def move(times: np.ndarray, derivative: int = 0) -> np.ndarray:
    """A multisine motion, rad, or a derivative of it."""
    rate = 2.0 * np.pi * np.array([0.17, 0.31, 0.53, 0.94, 1.7, 2.9])
    size, phase = np.array([8.0, 5.0, 3.0, 1.6, 0.8, 0.4]), np.arange(6.0) ** 2
    return (size * rate**derivative * np.sin(rate * times[:, None] + phase + 0.5 * np.pi * derivative)).sum(axis=1)


def drive_torque(times: np.ndarray) -> np.ndarray:
    """Inertia 4e-4, viscous friction 8e-3, Coulomb friction 0.03."""
    return 4e-4 * move(times, 2) + 8e-3 * move(times, 1) + 0.03 * np.sign(move(times, 1))


def simulate_late_log(late: float, torque=drive_torque, motor=move, noise: float = 1e-4) -> pd.DataFrame:
    """A log whose u lies `late` periods after a torque that is held from each stamp on, by the mean over a period."""
    times = LATE_PERIOD * np.arange(3000)
    offsets = (np.arange(20) + 0.5) / 20.0 - late
    u = np.mean([torque(times + LATE_PERIOD * offset) for offset in offsets], axis=0)
    position = motor(times) + noise * np.random.default_rng(5).standard_normal(3000)
    return pd.DataFrame({"t": times, "u": u, "theta_e": position})


NOMINAL = NominalDrive(
    gear_ratio=20.0, stiffness=50.0, half_gap=0.0, motor_inertia=1e-3, motor_viscous=2e-3, load_inertia=0.4, load_viscous=1.0
)


def simulate_axis(
    skew=0.0, offset=0.0, gap=0.0, load_torque=0.0, motor_torque=0.0, stiffness=50.0, count=8000, drift=0.0, seed=0
):
    """A geared axis with dry friction at the load in multisine motion: its equations of motion, both encoders with noise."""
    random, t = np.random.default_rng(seed), 1e-3 * np.arange(count)
    frequency, size, phase = np.array([0.5, 0.83, 1.27, 2.1]), np.array([1.0, 0.5, 0.4, 0.2]), random.uniform(0.0, 6.3, 4)

    def motion(times, derivative):
        rate = 2.0 * np.pi * frequency
        return (size * rate**derivative * np.sin(rate * times[:, None] + phase + 0.5 * np.pi * derivative)).sum(axis=1)

    def shaft(times):
        friction = 2.0 * np.tanh(motion(times, 1) / 0.05)
        return (0.4 * motion(times, 2) + 1.0 * motion(times, 1) + friction) / 20.0 + load_torque

    middle = t + 0.5e-3
    twist = shaft(t) / stiffness + 0.5 * gap * np.tanh(shaft(t) / 0.02)
    u = 20.0 * (1e-3 * motion(middle, 2) + 2e-3 * motion(middle, 1)) + shaft(middle) - motor_torque
    motor = 20.0 * motion(t, 0) + twist + offset + 1e-4 * random.standard_normal(count)
    load = motion(t - skew - drift * t, 0) + 5e-6 * random.standard_normal(count)
    return pd.DataFrame({"t": t, "u": u, "theta_e": motor, "theta_s": load})


def find_recording(name: str) -> Path:
    """A real recording; the test skips where the folder with them is absent."""
    folder = Path(os.environ.get("JAXBL_DATA", Path(__file__).parents[1] / ".." / "shared" / "data"))
    if not (folder / name).exists():
        pytest.skip(f"no recording {name} (the folder with them is named by JAXBL_DATA)")
    return folder / name


def read_stretch(name: str, table: dict[str, Any], seconds: float) -> Record:
    """Read the first seconds of a real recording."""
    record = read_record(find_recording(name), table)
    count = round(seconds / record.sample_period)
    positions = {side: values[:count] for side, values in record.positions.items()}
    torque = None if record.torque is None else record.torque[:count]
    return dataclasses.replace(
        record, time=record.time[:count], torque=torque, positions=positions, segments=(slice(0, count),)
    )


EMPS: dict[str, Any] = {
    "u": {"column": "vir", "unit": "V", "factor": 35.1507},
    "theta_e": {"column": "qm", "unit": "m"},
    "closed_loop": True,
}
XL330: dict[str, Any] = {
    "t": "timestamp",
    # the duty is not known in N m: 1 is full duty
    "u": {"column": "load", "unit": "counts", "factor": 1.0 / 885.0, "signed_bits": 16, "saturation": 885.0},
    "theta_e": "position",
    "closed_loop": True,
}
SERVO: dict[str, Any] = {
    "t": 0,
    "theta_s": {"column": 1, "unit": "deg", "factor": 220.0 / 4096.0},
    "theta_e": {"column": 1, "minus": 2, "unit": "deg", "factor": 220.0 / 4096.0},
    "absent": ["u"],
}


def simulate_band(
    random: np.random.Generator, count: int = 3000, period: float = 0.01
) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
    """Displacement (m) and force (N) of play, spring and slip in series; and the truth."""
    time, reach = period * np.arange(count), 10.0 ** random.uniform(-3.0, -1.5)
    play, windup, stiffness = (
        reach * random.uniform(0.03, 0.3),
        reach * random.uniform(0.05, 0.3),
        10.0 ** random.uniform(4, 7),
    )
    x = reach * (0.7 * np.sin(2.0 * np.pi * 0.2 * time) + 0.3 * np.sin(2.0 * np.pi * 0.47 * time + random.uniform(0.0, 6.0)))
    band, force = x[0], np.empty(count)  # one that begins wound up is found less exactly: up to 11 % off
    for i, position in enumerate(x):
        band = np.clip(band, position - play - windup, position + play + windup)
        twist = position - band
        force[i] = stiffness * (twist - np.clip(twist, -play, play))
    slip = stiffness * windup
    force += 10.0 ** random.uniform(-2.5, -1.3) * slip * random.standard_normal(count)
    return x, force, {"stiffness": stiffness, "half_gap": play, "slip": slip}
