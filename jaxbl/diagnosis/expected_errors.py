"""What a complete model would leave on held-out data, and whether a model leaves more.

A complete model is off by the noise of the readings, by noise of the input that the drive did not feel, by what the fit
leaves open of its numbers, by torques too small to be named, and by what smoothing makes of jumps. The second and third are
drawn at random, and the model compared with itself: a posterior predictive check. Torques are tested at several bandwidths,
since noise of accelerations hides what is slow.
Reference: A. Gelman et al., Bayesian Data Analysis (2013), 6.3.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import gammaincinv

from .reference_log import Comparison, Errors, ReferenceLog
from .refit import FittedModel
from .setup import InputNoise, quiet
from .thresholds import LIMITS

_DRAWS = 6
"""Of numbers and input noise: their mean square is then known within a factor of two, which is a small part of the error of
most logs."""
_NOISE_ERROR, _TORQUE_NOISE_ERROR = 0.25, 1.0
"""Relative error of a channel's noise. That of positions, and of the input, is estimated from the readings, some of which
are coarse. That of torques goes with the bandwidth to the power 2.5, which is an estimate, too; the smoother rounds jumps
of friction."""


class Expected(NamedTuple):
    """Error of a complete model in a channel, in the channel's unit.

    Attributes:
        noise: rms by the readings' noise.
        open: rms by the numbers that the fit leaves open, and by noise of the input.
        least: rms by a torque of `least_torque` of the driving torque, which is too small to be named; of slow torques the
            least that counts.
        limit: rms that a complete model exceeds with probability `failing`, shared out among all channels.
        rounding: rms by smoothing of the model's own motion; 0 where the rest is enough to account for the errors.
    """

    noise: float
    open: float
    least: float
    limit: float
    rounding: float = 0.0


def expected_errors(
    log: ReferenceLog, fitted: FittedModel, base: Comparison, noise: InputNoise, driving: float
) -> dict[str, Expected]:
    """Errors of a model if it is complete, in positions and missing torques; speeds are the positions' over again.

    Args:
        log: held out.
        fitted, base: the model, and how it compares.
        noise: of the input.
        driving: torque that drives the machine, rms, N m.
    """
    random, floor = np.random.default_rng(0), log.noise_of(base)
    values, vectors = np.linalg.eigh(fitted.white)
    root = vectors * np.sqrt(np.maximum(values, 0.0))

    def apart(other: Comparison) -> Errors:
        return {name: float(np.mean((errors - base.samples[name]) ** 2)) for name, errors in other.samples.items()}

    drawn = []
    for _ in range(_DRAWS):
        model = fitted.move_by(root @ random.standard_normal(len(root)))
        segments = [
            replace(segment, torque=segment.torque + noise.possible * random.standard_normal(len(segment)))
            for segment in log.segments
        ]
        # smoothed as the input was
        drawn.append(apart(replace(log, segments=quiet(segments, noise.unfelt)).compare(model)))
    least = LIMITS.least_torque * driving
    segments = [replace(segment, torque=segment.torque + least) for segment in log.segments]
    small = apart(replace(log, segments=segments).compare(fitted.experiment))
    for side in fitted.experiment.sides:
        ratio = float(fitted.experiment.drive.ratio(side))
        small |= {name: (LIMITS.slow_torque * driving * ratio) ** 2 for name in floor if name.startswith(f"torque_{side}")}
        small[f"torque_{side}"] = (least * ratio) ** 2
    expected, names = {}, [name for name in floor if not name.startswith("velocity")]
    for name in names:
        squares = np.array([squares_of[name] for squares_of in drawn])
        unsure = _TORQUE_NOISE_ERROR if name.startswith("torque") else _NOISE_ERROR
        drawn_most = (1.0 + _NOISE_ERROR) ** 2 * _quantile(squares, LIMITS.failing / len(names))
        limit = (1.0 + unsure) ** 2 * floor[name] ** 2 + drawn_most + small[name]
        expected[name] = Expected(floor[name], float(np.sqrt(np.mean(squares))), small[name] ** 0.5, limit**0.5)
    if any(name.startswith("torque") for name in list_failed(base.errors, expected)):
        for name, rounding in log.rounding(fitted.experiment).items():
            if name in expected:
                limit = np.hypot(expected[name].limit, (1.0 + _NOISE_ERROR) * rounding)
                expected[name] = expected[name]._replace(rounding=rounding, limit=float(limit))
    return expected


def list_failed(errors: Errors, expected: Mapping[str, Expected]) -> list[str]:
    """List channels in which a model leaves more than a complete one would, or in which nobody can say: draws diverge."""
    return [name for name, channel in expected.items() if not errors[name] <= channel.limit < np.inf]


def _quantile(squares: np.ndarray, chance: float) -> float:
    """Value that a sum of squares exceeds with some probability, from a few of them: by the gamma distribution of the same
    mean and variance (Satterthwaite)."""
    mean, variance = float(np.mean(squares)), float(np.var(squares, ddof=1))
    if not 0.0 < mean < np.inf or variance == 0.0:
        return mean
    # never wider than with one degree of freedom, the square of one normal number
    shape = max(mean**2 / variance, 0.5)
    return mean / shape * float(gammaincinv(shape, 1.0 - chance))
