"""Runs that converge although alpha is below their true f_plus: how long the disturbance exceeds alpha, and which error it
causes."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false

from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from jaxbl.config import Config, with_values
from jaxbl.json_types import JsonObject
from jaxbl.sweeps.elementwise import call_in_float64
from jaxbl.sweeps.trial import run

from .under_tuned import Disturbance, excursion, simulate_error

_MOST_INPUTS = 32
"""Combinations of inputs and plants, evenly spread, that are run once more for their disturbance."""


def read_disturbance(drive: Any, side: str, trace: pd.DataFrame) -> Disturbance:
    """Return what disturbs the error of a side along a trace: the acceleration that the nominal model lacks.

    It is taken at the true velocity, and does not depend on the observer: f_plus contains the observer's velocity error as
    well.
    """
    velocity, torque, acceleration = (trace[name].to_numpy() for name in (f"{side}.velocity", "u", f"{side}.acceleration"))
    missing = acceleration - call_in_float64(partial(drive.acceleration, side), velocity, torque)
    return Disturbance(trace["t"].to_numpy(), missing, float(drive.viscous(side)) / float(drive.inertia(side)))


def summarise_converged_below(study: Config, side: str, frame: pd.DataFrame) -> JsonObject | None:
    """Summarise the converged runs of a level (`frame`) whose alpha is at most f_plus; None if there are none.

    Returns the number of `converged_runs`, and of the `runs` that were repeated. For the latter: how many have a disturbance
    that exceeds alpha, the largest share of time in which it does, and the largest excursion (rad/s) from zero, predicted
    and simulated, with the axis values of its run.
    """
    runs_below = frame[frame[f"{side}.converged"].astype(bool) & (frame[f"{side}.margin_alpha"] <= 1.0)]
    if not len(runs_below):
        return None
    paths = study.axis_paths
    inputs = [path for path in paths if not path.startswith(("observer.", "equivalent_control.", "identifier."))]
    groups = [group for _, group in runs_below.groupby(inputs, sort=True)] if inputs else [runs_below]
    rows = []
    for index in np.unique(np.linspace(0, len(groups) - 1, _MOST_INPUTS).astype(int)):
        group = groups[index]
        config = with_values(study, {path: group[path].iloc[0] for path in inputs})
        disturbance = read_disturbance(config.build().drive, side, run(config, backend="scan").trace)
        for alpha, runs in group.groupby(f"observer.{side}.alpha"):
            rows.append((excursion(float(alpha), disturbance), disturbance.share_above(alpha), runs, disturbance))
    predicted, _, runs, disturbance = max(rows, key=lambda row: row[0])
    # the least lambda damps the error least
    worst_run = runs.loc[runs[f"observer.{side}.lambda"].idxmin()]
    lambda_, alpha = (float(worst_run[f"observer.{side}.{gain}"]) for gain in ("lambda", "alpha"))
    return {
        "converged_runs": len(runs_below),
        "runs": sum(len(row[2]) for row in rows),
        "disturbance_exceeds": sum(len(row[2]) for row in rows if row[1] > 0.0),
        "share_above_alpha": max(row[1] for row in rows),
        "excursion_predicted": predicted,
        "excursion_simulated": simulate_error(lambda_, alpha, disturbance, velocity_error=0.0).largest,
        "at": {path: worst_run[path] for path in paths},
    }
