"""Inverse dynamics: ordinary least squares on the equations of motion, as is commonly done with a log.

Numbers of trajectory fits are compared with it. Equations and step control are the package's.
Reference: M. Gautier, Dynamic identification of robots with power model, ICRA (1997).
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxbl.chain import Experiment
from jaxbl.drive.plant import PlantState
from jaxbl.estimation.descent import descend, linearise
from jaxbl.estimation.free_parameters import PRIOR_DEVIATION, FreeParameter, set_free_parameters
from jaxbl.estimation.regression import Kinematics, decimate_balances
from jaxbl.estimation.trajectory import Fit
from jaxbl.fused.compilation import jit
from jaxbl.records.least_squares import column_rms

_PASSES = 3
"""Fits, each with the weights of the residuals of the one before."""
_MOST_STEPS, _SETTLED = 200, 1e-9
"""Of each fit, and the share of its squares that a step gains which is its last."""


class _Point(NamedTuple):
    """Torques that are left over at a theta, weighted, shape (samples, equations), their derivative, and their squares."""

    theta: np.ndarray
    residual: np.ndarray
    slope: np.ndarray
    deviance: float


@jit
def _miss_torques(
    experiment: Experiment, free: Sequence[FreeParameter], parts: Sequence[Kinematics], factor: int, theta: Array
) -> tuple[Array, Array]:
    """Torques that the equations of motion leave over after decimation, shape (samples, equations), and their derivative."""

    def miss(theta: Array) -> tuple[Array, Array]:
        balances = decimate_balances(set_free_parameters(experiment, free, theta), parts, factor)
        missed = jnp.stack([equation.residual for equation in balances.values()], axis=-1)
        return missed, missed

    slope, missed = jax.jacfwd(miss, has_aux=True)(theta)
    return missed, slope


def regress(experiment: Experiment, free: Sequence[FreeParameter], parts: Sequence[Kinematics], factor: int) -> Fit:
    """Least squares on all equations of motion from the nominal values, each equation weighted by what it leaves over.

    Parts shorter than the filter of :func:`decimate` must be left out. Residuals and derivatives of the fit have shape
    (1, samples, equations, ...), for :func:`jaxbl.estimation.intervals.spread`.
    """
    precision = np.full(len(free), PRIOR_DEVIATION**-2.0)

    def evaluate(theta: np.ndarray, weights: np.ndarray | float = 1.0) -> _Point:
        missed, slope = map(np.asarray, _miss_torques(experiment, free, parts, factor, jnp.asarray(theta)))
        missed = missed * weights
        deviance = float(np.sum(missed**2) + np.sum(precision * theta**2))
        return _Point(theta, missed, slope * np.expand_dims(weights, -1), deviance)

    best, ended = evaluate(np.zeros(len(free))), True
    for _ in range(_PASSES):
        left = column_rms(evaluate(best.theta).residual)
        weights = 1.0 / np.maximum(left, np.finfo(float).tiny)
        best, ended = descend(
            evaluate(best.theta, weights),
            lambda point: linearise(point.residual, point.slope, point.theta, precision),
            lambda point, change, weights=weights: evaluate(point.theta + change, weights),
            _MOST_STEPS,
            lambda point: _SETTLED * point.deviance,
        )
    residual, slope = best.residual[None], best.slope[None]
    return Fit(best.theta, PlantState({}, {}, ()), residual, slope, ended)
