"""A log from the bench's own simulator, which shares nothing with the package: a direct drive with hidden dry friction."""

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from hidden.cases import Log
from hidden.simulator import Machine, Run, simulate

from jaxbl.records import Record, read_record

DRIVE = {"kind": "rigid", "motor_inertia": 0.02, "motor_viscous": 0.03}
FRICTION = {"kind": "motor.coulomb_friction", "torque": 0.06}
GEARED = {
    "kind": "two_inertia", "motor_inertia": 0.05, "motor_viscous": 0.15, "load_inertia": 7.0, "load_viscous": 16.0,
    "gear_ratio": 5.0,
}  # fmt: skip
GAP = {"law": "dead_zone", "stiffness": 60.0, "half_gap": 0.08}
FRICTIONS = [{"kind": "motor.coulomb_friction", "torque": 0.1}, {"kind": "load.coulomb_friction", "torque": 6.0}]


def nominal_study(**tables: Any) -> dict[str, Any]:
    """The direct drive's nominal study: it lacks the friction, and its numbers are 1 % off."""
    return {
        "title": "direct drive",
        "drive": DRIVE | {"motor_inertia": 0.0202, "motor_viscous": 0.0296},
        "run": {"sample_period": 2e-3, "duration": 4.0},
        "uncertainty": {"relative": 0.02, "exact": []},
        "log": {"initial_state": "unknown"},
    } | tables


@cache
def simulate_multisine_log(
    effects: tuple[str, ...] = ("friction",),
    seed: int = 1,
    noise: float = 3e-5,
    inertia: float = 0.02,
    torque_noise: float = 0.0,
    felt: bool = False,
) -> Log:
    """Simulate 4 s of the direct drive under a multisine.

    `torque_noise` (N m) is of the recorded input; the drive has felt it if `felt`.
    """
    t = 2e-3 * np.arange(2000)
    phases = np.random.default_rng(seed).uniform(-np.pi, np.pi, 6)
    k = np.arange(1, 7)
    torque = 0.3 * np.sum(np.sin(2.0 * np.pi * 0.5 * k[:, None] * t + phases[:, None]), axis=0)
    input_noise = torque_noise * np.random.default_rng(seed + 100).standard_normal(len(t))
    log = simulate_direct_drive(torque + input_noise * felt, [FRICTION] if effects else [], noise, seed, inertia)
    return replace(log, u=log.u + input_noise * (not felt))


def simulate_direct_drive(
    torque: np.ndarray, effects: list[dict[str, Any]], noise: float, seed: int, inertia: float = 0.02, speed: float = 0.0
) -> Log:
    """Simulate the direct drive under a torque (N m, every 2 ms), from a speed (rad/s)."""
    machine, initial = Machine(DRIVE | {"motor_inertia": inertia}, None, effects), (0.0, speed, 0.0, 0.0)
    (trace,) = simulate([Run(machine, 2e-3, torque, initial=initial, motor_noise=noise, seed=seed)])
    return Log(trace.t, trace.u, trace.theta_e, None)


def select_samples(log: Log, rows: Any) -> Log:
    """Select samples of a log without a load encoder."""
    return replace(log, t=log.t[rows], u=log.u[rows], theta_e=log.theta_e[rows])


def simulate_study(study: dict[str, Any], seed: int = 1) -> pd.DataFrame:
    """Simulate a study's drive under its multisine: readings as in the package's trace, true velocities and torque.

    The multisine and the torque of the dead zone are written out here, so that a log shares nothing with the package.
    """
    drive, law, settings, excitation = study["drive"], study.get("transmission"), study["run"], study["excitation"]
    period, harmonics = settings.get("sample_period", 1e-3), np.arange(1, 9)
    t = period * np.arange(round(settings["duration"] / period))
    phases = 2.0 * np.pi * excitation["frequency"] * t[:, None] * harmonics - np.pi * harmonics * (harmonics - 1) / 8.0
    torque = excitation["amplitude"] / np.sqrt(8.0) * np.cos(phases).sum(axis=1)
    noise = study["encoders"]["noise"]
    run = Run(
        Machine(drive, law, study.get("effects", ())), period, torque,
        motor_noise=noise, load_noise=noise / drive.get("gear_ratio", 1.0), seed=seed,
    )  # fmt: skip
    (trace,) = simulate([run])
    columns = {"t": trace.t, "u": trace.u, "theta_e": trace.theta_e, "motor.velocity": trace.states[1]}
    if law is not None:
        half_gap = law.get("half_gap", 0.0)
        twist = trace.states[0] - drive["gear_ratio"] * trace.states[2]
        torque = law["stiffness"] * (twist - np.clip(twist, -half_gap, half_gap))
        columns |= {"theta_s": trace.theta_s, "load.velocity": trace.states[3], "torque": torque}
    return pd.DataFrame(columns)


def record_study(study: dict[str, Any], folder: Path) -> Record:
    """Simulate a study's drive, and read the log of it."""
    file, trace = folder / "log.csv", simulate_study(study)
    trace[[name for name in ("t", "u", "theta_e", "theta_s") if name in trace]].to_csv(file, index=False)
    return read_record(file)


@cache
def simulate_geared_drive() -> tuple[Log, dict[str, np.ndarray]]:
    """Simulate 4 s of a drive with a gap and small hidden frictions; return the log and the true speeds, rad/s."""
    t = 2e-3 * np.arange(2000)
    torque = 5.0 * (np.sin(2.0 * np.pi * 0.5 * t) + np.sin(2.0 * np.pi * 1.3 * t + 1.0))
    machine = Machine(GEARED, GAP, FRICTIONS)
    (trace,) = simulate([Run(machine, 2e-3, torque, motor_noise=1e-5, load_noise=2e-6, seed=1)])
    return Log(trace.t, trace.u, trace.theta_e, trace.theta_s), {"motor": trace.states[1], "load": trace.states[3]}
