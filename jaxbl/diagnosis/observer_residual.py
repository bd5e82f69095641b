"""The torques that a model lacks as the observers see them: a second estimate beside the smoother's residual.

The paper's perturbation identification: once a super-twisting observer (7)-(8) has converged, its equivalent control (15)
is the perturbation, all that the right-hand side it knows leaves out. Here that right-hand side holds all that the model
has, transmission and effects at the smoothed motion, besides its nominal equation: J z_2 is then what the model lacks.
Otherwise the whole transmitted torque would go through the observer, whose lag on it would be taken for missing torque.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.ndimage import gaussian_filter1d, uniform_filter1d

from jaxbl.chain import Experiment, Signals, State, TracedArrays, initial_observer_state, replay
from jaxbl.estimation.regression import Kinematics
from jaxbl.estimation.segments import Segment
from jaxbl.fused.compilation import jit
from jaxbl.observer import AbstractSuperTwisting
from jaxbl.records.least_squares import rms
from jaxbl.records.linear_filters import filter_forwards

from .neutral_effects import complete
from .residuals import Equation, Residual, evaluate_equations, low_passed, narrow

_DRAWS = 6
"""Runs over the smoothed motion with drawn noise, by which the observers' own is measured: its deviation to a tenth."""
_SETTLING = 10.0
"""Time constants of the equivalent control's low-pass that are left out at the beginning of a part."""
_LEAST_SKIPPED = 20
"""Samples that are left out at least, where there is no low-pass: the observer's own reaching phase."""
_STUCK = 0.9
"""Share of alpha: a mean control beyond is a switching term that does not switch."""
_OFTEN = 0.1
"""Share of the time in which it does not switch from which on an observer counts as not converged."""
_MEMORY = 20.0
"""Time constants over which the observers' noise is correlated. No more, so that what is slow has a share of what is fast:
the error of the smoothed motion, which is slow, is in all draws alike."""


class Observed(NamedTuple):
    """Torque that the observer of a side sees along a part of a record.

    Attributes:
        residual: torque that the model lacks behind the equivalent control's low-pass (causal: late by its time constant),
            without the beginning, while the observer converges; its noise is one level for all of the part.
        skipped: samples of the part that are left out at its beginning.
        stuck: share of the time in which the switching term does not switch: alpha is less than what is missing, over J.
    """

    residual: Residual
    skipped: int
    stuck: float

    @property
    def has_converged(self) -> bool:
        """True if the equivalent control says anything: it does not where the observer is not on its sliding surface."""
        return bool(np.isfinite(self.residual.torque).all()) and self.stuck < _OFTEN


SideObserved = dict[str, list[Observed]]
"""What the observer of each side sees, part by part."""


def observed_torques(experiment: Experiment, segments: Sequence[Segment]) -> SideObserved:
    """Torques that a model lacks on each side by its observers' equivalent control, N m.

    The observers begin each part at the smoothed position and velocity. Their own noise is found by runs of the same
    observers over the smoothed motion with independent white noise of the readings' size: they are not linear, and their
    noise depends on the motion. What differs between these runs is noise.

    The model has array leaves, the observers' gains, and the sample period of the record.
    """
    observed: SideObserved = {side: [] for side in experiment.sides}
    bare = eqx.tree_at(lambda e: e.identifier, experiment, None, is_leaf=lambda x: x is None)
    for i, segment in enumerate(segments):
        random, part = np.random.default_rng(i), segment.kinematics
        # a structure for which there is a program
        equations = evaluate_equations(complete(experiment), segment)
        modelled, readings = {}, {}
        for side in experiment.sides:
            smoothed = segment.smoothed[side]
            modelled[side] = _hold_torque(equations[side]) / float(experiment.drive.inertia(side))
            drawn = float(smoothed.noise) * random.standard_normal((_DRAWS, len(segment)))
            readings[side] = np.concatenate([segment.readings[side][None], part.position[side] + drawn])
        controls = _controls(bare, segment.torque, readings, modelled, part)
        for side in experiment.sides:
            observed[side].append(_observe_side(experiment, side, part, np.asarray(controls[side])))
    return observed


def _hold_torque(equation: Equation) -> np.ndarray:
    """Torque to be held from each sample to the next, so that the implicit observer's position moves as under the true one.

    Held from sample k on, p_k moves the observer's positions by second differences of h^2 (p_{k-1} + p_k) / (2 J), where
    the true torque moves them by that of its mean around sample k, weighted by a triangle: tau + h^2 tau'' / 12. With the
    mean of two samples for p_k the former is tau + h^2 tau'' / 4, hence the sixth that is subtracted; not of friction,
    which jumps. The explicit observer's own lag of half a period remains.
    """
    torque = equation.beyond - equation.friction
    torque[1:-1] -= np.diff(equation.beyond, n=2) / 6.0
    return np.append(0.5 * (torque[:-1] + torque[1:]), torque[-1])


@jit
def _controls(
    experiment: Experiment, torque: Array, readings: TracedArrays, added: TracedArrays, part: Kinematics
) -> dict[str, Float[Array, "runs samples"]]:
    """Filtered equivalent control of each side, rad/s^2, for several readings of one motion."""

    def keep(state: State, signals: Signals) -> dict[str, Any]:
        return {side: signals.side(side).equivalent_control for side in experiment.sides}

    def run(measured: TracedArrays) -> TracedArrays:
        observers = {
            side: initial_observer_state(experiment, side, part.position[side][0], part.velocity[side][0])
            for side in experiment.sides
        }
        state = State(None, observers, dict.fromkeys(experiment.sides, jnp.zeros(())), None)
        return replay(experiment, torque, measured, record=keep, state=state, added_accelerations=added)[1]

    return jax.vmap(run)(readings)


def _share(experiment: Experiment) -> float:
    """Share of the difference that the equivalent control's low-pass takes in at each sample."""
    constant, period = float(experiment.equivalent_control.time_constant), float(experiment.run.sample_period)
    return -math.expm1(-period / constant) if constant > 0.0 else 1.0


def _observe_side(experiment: Experiment, side: str, part: Kinematics, controls: np.ndarray) -> Observed:
    share, period = _share(experiment), float(experiment.run.sample_period)
    constant = float(experiment.equivalent_control.time_constant)
    skipped = min(max(math.ceil(_SETTLING / share), _LEAST_SKIPPED), len(part.time) // 4)
    torque = float(experiment.drive.inertia(side)) * controls[:, skipped:]
    if not np.isfinite(torque).all():
        torque = np.full_like(torque, np.nan)
    # the mean takes its share of each
    noise = np.sqrt(_DRAWS / (_DRAWS - 1.0)) * (torque[1:] - np.mean(torque[1:], axis=0))
    count = noise.shape[1]
    deviation = float(np.sqrt(np.maximum(np.mean(noise**2), np.finfo(float).tiny)))
    lags = min(_MEMORY / share, count)
    power = np.mean(np.abs(np.fft.rfft(noise)) ** 2, axis=0)
    # as wide as the spectrum of Parzen's window
    density = gaussian_filter1d(power, np.sqrt(12.0) / (2.0 * np.pi) * count / lags)
    residual = Residual(
        side, np.asarray(part.time)[skipped:], torque[0], np.full(count, deviation), density,
        0.5 / max(np.pi * constant, period),
    )  # fmt: skip
    width = max(math.ceil(5.0 / share), _LEAST_SKIPPED)
    observer = getattr(experiment.observer, side)
    stuck = 0.0
    # of a switching term, whose size is bounded
    if isinstance(observer, AbstractSuperTwisting):
        mean = np.abs(uniform_filter1d(controls[0, skipped:], width))
        stuck = float(np.mean(mean > _STUCK * float(observer.alpha)))
    return Observed(residual, skipped, stuck)


def compare_observers(
    experiment: Experiment, observed: Sequence[Observed], residuals: Sequence[Residual], cutoff: float
) -> dict[str, Any]:
    """The observers' residual of a side beside the smoother's, both behind both low-passes: the observers' and a common one
    (`cutoff`, Hz); part by part.

    Returns:
        `converged`; `rms` of the observers' residual and of its `noise`, N m; `correlation` (about zero) with the
        smoother's, and `smoother_rms`, that one behind the same low-passes, N m; `bandwidth` of the narrower low-pass, Hz.
        Numbers are None where the observers do not converge.
    """
    if not all(piece.has_converged for piece in observed):
        return {"converged": False} | dict.fromkeys(("rms", "noise", "correlation", "smoother_rms", "bandwidth"))
    share = _share(experiment)
    seen_torques, other, noise, bandwidth = [], [], [], cutoff
    for piece, smooth in zip(observed, residuals, strict=True):
        late = filter_forwards(smooth.torque, [share], [share - 1.0])
        low, _ = narrow(piece.residual, cutoff)
        seen_torques.append(low.torque)
        noise.append(low.deviation)
        other.append(low_passed(late[piece.skipped :], piece.residual, cutoff))
        bandwidth = low.bandwidth
    mine, theirs = np.concatenate(seen_torques), np.concatenate(other)
    size = math.sqrt(np.mean(mine**2) * np.mean(theirs**2))
    return {
        "converged": True,
        "rms": rms(mine),
        "noise": rms(np.concatenate(noise)),
        "correlation": np.mean(mine * theirs) / size if size > 0.0 else None,
        "smoother_rms": rms(theirs),
        "bandwidth": bandwidth,
    }
