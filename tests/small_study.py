"""Studies small enough to run in a test: the paper's drive for 0.2 s, as mappings."""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from jaxbl.config import read_config
from jaxbl.sweeps.metrics import metric_columns
from jaxbl.sweeps.points import Points
from jaxbl.sweeps.sweep import StudyResult

ALPHA, LAMBDA, NOISE = "observer.motor.alpha", "observer.motor.lambda", "encoders.noise"

_BASE: dict[str, Any] = {
    "title": "small",
    "drive": {
        "kind": "two_inertia",
        "motor_inertia": 0.05,
        "motor_viscous": 0.15,
        "load_inertia": 7.0,
        "load_viscous": 16.0,
        "gear_ratio": 5.0,
    },
    "transmission": {"law": "sigmoid_backlash", "stiffness": 1.0, "dead_zone": 0.02, "slope": 20.0},
    "excitation": {"kind": "sine", "amplitude": 0.1, "frequency": 2.0},
    "encoders": {"noise": 1e-4},
    "observer": {
        "motor": {"lambda": 4.0, "alpha": 9.0, "velocity_error": 0.5},
        "load": {"lambda": 0.5, "alpha": 0.2},
    },
    "run": {"duration": 0.2, "substeps": 1},
}


def small_study(changes: dict[str, Any] | None = None, **tables: Any) -> dict[str, Any]:
    """The paper's drive for 0.2 s: `changes` sets dotted keys (None removes one), `tables` replaces whole tables."""
    data = copy.deepcopy(_BASE | tables)
    for path, value in (changes or {}).items():
        *names, key = path.split(".")
        table = data
        for name in names:
            table = table.setdefault(name, {})
        if value is None:
            table.pop(key, None)
        else:
            table[key] = value
    return data


def thirty_run_study(**tables: Any) -> dict[str, Any]:
    """Thirty runs of one inertia in eight chunks: 2 seeds of 15 points, 4 at once."""
    axes = [spaced_axis(ALPHA, 5.0, 20.0, 5), listed_axis(LAMBDA, 0.3, 1.0, 5.0)]
    return rigid_study(**{"axes": axes, "sweep": {"seeds": 2, "chunk": 4}} | tables)


def read_parts(folder: Path) -> dict[str, bytes]:
    """Read a sweep's parts: bytes by file name."""
    return {path.name: path.read_bytes() for path in (folder / "points").iterdir()}


def multisine_study(duration: float, **tables: Any) -> dict[str, Any]:
    """The paper's drive under a multisine that moves it well, for a log of `duration` seconds."""
    observer = {"motor": {"lambda": 20.0, "alpha": 400.0}, "load": {"lambda": 3.0, "alpha": 20.0}}
    excitation = {"kind": "multisine", "amplitude": 5.0, "frequency": 0.7}
    changes = {"run.duration": duration, "run.substeps": 5}
    return small_study(changes, **{"excitation": excitation, "observer": observer} | tables)


def rigid_study(changes: dict[str, Any] | None = None, **tables: Any) -> dict[str, Any]:
    """The small study with a single inertia, without a transmission and a load observer."""
    tables = {"drive": {"kind": "rigid", "motor_inertia": 0.05, "motor_viscous": 0.15}} | tables
    removals = {path: None for path in ("transmission", "observer.load") if path not in tables}
    return small_study(removals | (changes or {}), **tables)


def listed_axis(path: str, *values: Any, **keys: Any) -> dict[str, Any]:
    """An axis of listed values."""
    return {"path": path, "values": list(values), **keys}


def spaced_axis(
    path: str, start: float, stop: float, num: int | None = None, scale: str = "log", **keys: Any
) -> dict[str, Any]:
    """An axis between two ends."""
    return {"path": path, "start": start, "stop": stop, "scale": scale, **({} if num is None else {"num": num}), **keys}


def make_result(data: dict[str, Any], **columns: Any) -> StudyResult:
    """Make a result without a run: `columns` are functions of the frame of points; other metrics are all 1 and true."""
    config = read_config(data)
    points, seeds = Points(config), config.sweep.seeds
    rows = []
    for group in points.groups:
        lanes = points.columns(np.arange(points.group_size))
        values = {path: lanes.get(path, np.full(points.group_size, group.structural.get(path))) for path in points.paths}
        rows += [pd.DataFrame(values | {"seed": np.full(points.group_size, seed)}) for seed in range(seeds)]
    frame = pd.concat(rows, ignore_index=True)
    for name in metric_columns(config.build(), config.sweep.metrics):
        frame[name] = True if name.endswith(("finite", "converged")) else 1.0
    for name, column in columns.items():
        frame[name.replace("__", ".")] = column(frame)
    return StudyResult(config, frame)
