"""A log from the bench's own simulator, which shares nothing with the package: a direct drive with hidden dry friction."""

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from hidden.cases import Log
from hidden.simulator import Machine, Run, simulate

DRIVE = {"kind": "rigid", "motor_inertia": 0.02, "motor_viscous": 0.03}
FRICTION = {"kind": "motor.coulomb_friction", "torque": 0.06}
GEARED = {
    "kind": "two_inertia", "motor_inertia": 0.05, "motor_viscous": 0.15, "load_inertia": 7.0, "load_viscous": 16.0,
    "gear_ratio": 5.0,
}  # fmt: skip
GAP = {"law": "dead_zone", "stiffness": 60.0, "half_gap": 0.08}
FRICTIONS = [{"kind": "motor.coulomb_friction", "torque": 0.1}, {"kind": "load.coulomb_friction", "torque": 6.0}]


def model(**tables: Any) -> dict[str, Any]:
    """The study of someone who does not know of the friction, and whose numbers are a little off."""
    return {
        "title": "direct drive",
        "drive": DRIVE | {"motor_inertia": 0.0202, "motor_viscous": 0.0296},
        "run": {"sample_period": 2e-3, "duration": 4.0},
        "uncertainty": {"relative": 0.02, "exact": []},
        "log": {"initial_state": "unknown"},
    } | tables


@cache
def logged(
    effects: tuple[str, ...] = ("friction",),
    seed: int = 1,
    noise: float = 3e-5,
    inertia: float = 0.02,
    torque_noise: float = 0.0,
    felt: bool = False,
) -> Log:
    """4 s of a multisine; `torque_noise`: of the recorded input, N m, which the drive has felt or not."""
    t = 2e-3 * np.arange(2000)
    phases = np.random.default_rng(seed).uniform(-np.pi, np.pi, 6)
    k = np.arange(1, 7)
    torque = 0.3 * np.sum(np.sin(2.0 * np.pi * 0.5 * k[:, None] * t + phases[:, None]), axis=0)
    shaking = torque_noise * np.random.default_rng(seed + 100).standard_normal(len(t))
    log = driven(torque + shaking * felt, [FRICTION] if effects else [], noise, seed, inertia)
    return replace(log, u=log.u + shaking * (not felt))


def driven(torque: np.ndarray, effects: list[dict[str, Any]], noise: float, seed: int, inertia: float = 0.02) -> Log:
    """The direct drive under a torque (N m, every 2 ms)."""
    machine = Machine(DRIVE | {"motor_inertia": inertia}, None, effects)
    (trace,) = simulate([Run(machine, 2e-3, torque, motor_noise=noise, seed=seed)])
    return Log(trace.t, trace.u, trace.theta_e, None)


def part(log: Log, rows: Any) -> Log:
    """Some samples of a log of a motor."""
    return replace(log, t=log.t[rows], u=log.u[rows], theta_e=log.theta_e[rows])


@cache
def geared() -> tuple[Log, dict[str, np.ndarray]]:
    """4 s of a drive with a gap and hidden frictions, a small part of what is transmitted; and its true speeds, rad/s."""
    t = 2e-3 * np.arange(2000)
    torque = 5.0 * (np.sin(2.0 * np.pi * 0.5 * t) + np.sin(2.0 * np.pi * 1.3 * t + 1.0))
    machine = Machine(GEARED, GAP, FRICTIONS)
    (trace,) = simulate([Run(machine, 2e-3, torque, motor_noise=1e-5, load_noise=2e-6, seed=1)])
    return Log(trace.t, trace.u, trace.theta_e, trace.theta_s), {"motor": trace.states[1], "load": trace.states[3]}
