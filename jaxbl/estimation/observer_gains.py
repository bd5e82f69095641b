"""Gains of the observers from a record itself: its disturbance and its noise.

The smoother gives velocity and disturbance without the delay that an observer has. Gains are tried on the record, all at
once, and those are taken whose velocity comes nearest to the smoothed one, of those that keep a margin to the exact
convergence condition (:func:`jaxbl.observer.conditions.least_lambda_exact`) for the largest disturbance seen.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.chain import Experiment, Signals, State, TracedArrays, replay
from jaxbl.drive.parameters import set_leaves
from jaxbl.fused.compilation import jit

from .regression import Kinematics
from .segments import Segment

_ALPHA = np.geomspace(1.1, 6.0, 10)
"""Tried, over the largest disturbance: alpha must exceed it."""
_LEAST_LAMBDA = np.array([
    0.99121979323499, 0.846816465249442, 0.747579903703347, 0.668441411663471, 0.601665665672052,
    0.543670341246327, 0.492453446343278, 0.446755440769939, 0.405712627502788, 0.368691656240434,
])  # fmt: skip
"""Least lambda that converges with each of them, over the root of the largest disturbance: of
:func:`jaxbl.observer.conditions.least_lambda_exact`, which takes longer to compile than all that follows (a test)."""
_LAMBDA = np.geomspace(1.1, 12.0, 12)
"""Tried, over the least lambda that converges with that alpha."""
_MOST = 20_000
"""Samples that gains are tried on at most, which bounds time and memory."""


class ChosenGains(NamedTuple):
    """Gains chosen for one observer.

    Attributes:
        lambda_: √(rad/s).
        alpha: rad/s^2.
        f_plus: largest disturbance of the record, rad/s^2.
        velocity_error: rms difference to the smoothed velocity, rad/s.
    """

    lambda_: float
    alpha: float
    f_plus: float
    velocity_error: float


@jit
def _misses(experiment: Experiment, kinematics: Kinematics, gains: TracedArrays, readings: TracedArrays) -> TracedArrays:
    """Rms difference of each observer's velocity to the smoothed one, for several gains."""

    def velocity(state: State, signals: Signals) -> dict[str, Any]:
        return {side: signals.side(side).velocity_estimate for side in experiment.sides}

    def miss(values: TracedArrays) -> TracedArrays:
        _, velocities = replay(set_leaves(experiment, values), kinematics.torque, readings, record=velocity)
        settled = slice(len(kinematics.time) // 4, None)
        return {
            side: jnp.sqrt(jnp.mean((velocities[side][settled] - smooth[settled]) ** 2))
            for side, smooth in kinematics.velocity.items()
        }

    return jax.vmap(miss)(gains)


def gains_for(
    missing: frozenset[str], experiment: Experiment, segments: Sequence[Segment]
) -> tuple[dict[str, ChosenGains], dict[str, float]]:
    """Gains of the observers that the study leaves open (`missing`), by side and by dotted path, chosen on the longest
    segment of a log."""
    sides = [side for side in experiment.sides if f"observer.{side}" in missing]
    if not sides:
        return {}, {}
    part = max(segments, key=len)[:_MOST]
    k, end = part.kinematics, min(20, len(part) // 10)
    alpha, lambda_ = np.tile(_ALPHA, len(_LAMBDA)), np.outer(_LAMBDA, _LEAST_LAMBDA).ravel()
    # of NumPy: arithmetic alone is no program then
    drive = jax.tree.map(np.asarray, experiment.drive)
    f_plus, candidates = {}, {}
    for side in experiment.sides:
        # acceleration that the observer's nominal model does not explain
        disturbance = k.acceleration[side] - drive.acceleration(side, k.velocity[side], k.torque)
        f_plus[side] = float(np.max(np.abs(disturbance[end : len(part) - end])))
        bound = max(f_plus[side], np.finfo(float).tiny)
        candidates[f"observer.{side}.lambda"] = lambda_ * np.sqrt(bound)
        candidates[f"observer.{side}.alpha"] = alpha * bound

    missed = _misses(experiment, k, candidates, part.readings)
    gains, values = {}, {}
    for side in sides:
        size = np.asarray(missed[side])
        size = np.where(np.isfinite(size), size, np.inf)
        # several do exactly the same where noise is fine: the first of them, whatever rounding says
        best = int(np.argmax(size <= (1.0 + 1e-9) * np.min(size)))
        chosen = {path: float(candidates[path][best]) for path in (f"observer.{side}.lambda", f"observer.{side}.alpha")}
        gains[side] = ChosenGains(*chosen.values(), f_plus=f_plus[side], velocity_error=float(size[best]))
        values |= chosen
    return gains, values
