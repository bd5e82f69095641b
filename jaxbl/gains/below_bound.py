"""Runs that converge though alpha is below their true f_plus: how long their disturbance exceeds alpha, and what that makes
of an error that is zero."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from jaxbl.config import Config, with_values
from jaxbl.sweeps.trial import run

from .under_tuned import excursion, simulate_error

_MOST_INPUTS = 32
"""Combinations of what drives the plant that are run once more, for their disturbance; spread evenly."""


def disturbance(drive: Any, side: str, trace: pd.DataFrame) -> np.ndarray:
    """The acceleration (rad/s^2) that the nominal model lacks at the true velocity, at the samples of a run's trace: f_plus
    without the observer's own velocity error. It does not depend on the observer."""
    with jax.enable_x64(True):
        nominal = drive.acceleration(side, *(jnp.asarray(trace[name].to_numpy()) for name in (f"{side}.velocity", "u")))
    return trace[f"{side}.acceleration"].to_numpy() - np.asarray(nominal)


def friction_of(drive: Any, side: str) -> float:
    """Viscous friction of a side over its inertia, 1/s."""
    return float(drive.viscous(side)) / float(drive.inertia(side))


def share_above(alpha: float, values: np.ndarray) -> float:
    """Part of the time in which a disturbance (rad/s^2), evenly sampled, exceeds alpha."""
    return float(np.mean(np.abs(values) > alpha))


def converged_below(study: Config, side: str, frame: pd.DataFrame) -> dict[str, Any] | None:
    """Converged runs of a level (`frame`) with alpha at most f_plus: None where there is none.

    Their count, and those looked at (`runs`); of the latter how many have a disturbance above alpha at any time, the largest
    share of the time in which it is, the largest `excursion` (rad/s) predicted from zero, and the same simulated for the run
    that has it, with its values.
    """
    found = frame[frame[f"{side}.converged"].astype(bool) & (frame[f"{side}.margin_alpha"] <= 1.0)]
    if not len(found):
        return None
    paths = [axis.path for axis in study.axes]
    inputs = [path for path in paths if not path.startswith(("observer.", "equivalent_control.", "identifier."))]
    groups = [part for _, part in found.groupby(inputs, sort=True)] if inputs else [found]
    rows = []
    for at in np.unique(np.linspace(0, len(groups) - 1, _MOST_INPUTS).astype(int)):
        part = groups[at]
        config = with_values(study, {path: part[path].iloc[0] for path in inputs})
        trace = run(config, backend="scan").trace
        drive = config.build().drive
        values, times, friction = disturbance(drive, side, trace), trace["t"].to_numpy(), friction_of(drive, side)
        for alpha, same in part.groupby(f"observer.{side}.alpha"):
            predicted = excursion(float(alpha), times, values, friction)
            rows.append((predicted, share_above(float(alpha), values), same, times, values, friction))
    predicted, _, same, times, values, friction = max(rows, key=lambda row: row[0])
    # the least lambda has the least to hold it back
    one = same.loc[same[f"observer.{side}.lambda"].idxmin()]
    path = simulate_error(
        float(one[f"observer.{side}.lambda"]),
        float(one[f"observer.{side}.alpha"]),
        times,
        values,
        damping=friction,
        velocity_error=0.0,
    )
    return {
        "converged_runs": len(found),
        "runs": sum(len(row[2]) for row in rows),
        "disturbance_exceeds": sum(len(row[2]) for row in rows if row[1] > 0.0),
        "share_above_alpha": max(row[1] for row in rows),
        "excursion_predicted": predicted,
        "excursion_simulated": path.largest,
        "at": {path: one[path] for path in paths},
    }
