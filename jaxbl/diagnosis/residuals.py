"""Torques that a model lacks on a record, with their own noise level.

The smoother sees the acceleration through a zero-phase low-pass H of its own: 1 / (1 + (w / w_c)^6) for w well below the
sampling rate, w_c^6 = q / (sigma^2 h). The model's torques pass the same low-pass, so that a complete model leaves nothing
but noise, also where its torques jump (friction at a reversal). What is found is H applied to the missing torque.

Sign: the torque that is missing from the model, J a less all modelled torques; minus the residual of
:func:`jaxbl.estimation.regression.balance`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool
from scipy.ndimage import gaussian_filter1d

from jaxbl.chain import Experiment
from jaxbl.drive.effects import Motion
from jaxbl.estimation.regression import Kinematics, SideSamples, effect_path
from jaxbl.estimation.segments import Segment
from jaxbl.estimation.smoother import JERK_COVARIANCE, TRANSITION, Smoothed, smoothed_accelerations
from jaxbl.fused.compilation import jit
from jaxbl.records.signal_quality import estimate_white_noise

_OPEN, _FREQUENCIES = 6.0, 1024
"""Frequency, over one standard deviation of a Gaussian low-pass, beyond which nothing passes it; those it is looked at."""
_LARGEST = 2**18
"""Frequencies of a response at most, which bounds memory."""


@dataclass(frozen=True)
class Residual:
    """Torque that a model lacks on a side, along a part of a record without gaps.

    Attributes:
        name: of the side.
        time: s, shape (samples,).
        torque: missing torque behind the low-pass, N m; positive where it drives forward.
        deviation: standard deviation of its noise, N m.
        density: of the noise's power over frequencies from 0 to half the sampling rate, evenly, in any unit.
        bandwidth: of the low-pass, Hz: faster torques are not seen.
    """

    name: str
    time: np.ndarray
    torque: np.ndarray
    deviation: np.ndarray
    density: np.ndarray
    bandwidth: float

    @property
    def period(self) -> float:
        """Sampling period, s."""
        return float(self.time[-1] - self.time[0]) / (len(self.time) - 1)

    def density_at(self, frequency: np.ndarray) -> np.ndarray:
        """Density of the noise at frequencies in rad per sample."""
        return np.interp(frequency, np.linspace(0.0, np.pi, len(self.density)), self.density)


SideResiduals = dict[str, list[Residual]]
"""Residuals of each side, segment by segment."""


class _Response(NamedTuple):
    """A smoother away from the ends, over frequencies from 0 to half the sampling rate, in units of noise and period.

    Attributes:
        gain: from readings to position, velocity, acceleration; shape (3, frequencies).
        low_pass: H, from true to smoothed acceleration.
        corner: w_c in rad per sample.
    """

    gain: np.ndarray
    low_pass: np.ndarray
    corner: float


@lru_cache(maxsize=32)
def _response(smoothness: float, size: int) -> _Response:
    """Response by the spectrum of the sampled white-jerk model, x' = F x + w with F = I + N."""
    frequency = np.linspace(0.0, np.pi, size // 2 + 1)
    frequency[0] = 1e-3 * frequency[1]
    d = np.expm1(1j * frequency)
    n = np.array(TRANSITION) - np.eye(3)
    # (dI - N)^-1 d^3, as N^3 = 0
    inverse = d[:, None, None] ** 2 * np.eye(3) + d[:, None, None] * n + n @ n
    spectrum = smoothness * np.einsum("wij,jk,wk->iw", inverse, np.array(JERK_COVARIANCE), inverse[:, 0].conj())
    square = np.abs(d) ** 2
    gain = spectrum / (spectrum[0].real + square**3)
    return _Response(gain, -gain[2].real / square, _corner(smoothness))


def _corner(smoothness: float) -> float:
    return min(smoothness ** (1.0 / 6.0), np.pi)


def mean_density(spectrum: np.ndarray) -> float:
    """Variance of a real signal with a spectral density given from 0 to half the sampling rate."""
    return float(np.trapezoid(spectrum) / (len(spectrum) - 1))


def as_smoothed(values: np.ndarray, smoothed: Smoothed, period: float) -> np.ndarray:
    """Values as if they were accelerations seen through a smoother, its ends included; shape (..., samples)."""
    columns = values.reshape(-1, values.shape[-1]).T
    # a steady acceleration passes unchanged
    steady = np.mean(columns, axis=0)
    # of what a diverging model says nothing is finite
    with np.errstate(invalid="ignore", over="ignore"):
        rate = np.cumsum(columns - steady, axis=0) * period
        # second differences of the position are the values
        position = np.concatenate([np.zeros((1, len(steady))), np.cumsum(rate, axis=0)[:-1] * period])
        accelerations = steady + smoothed_accelerations(position, period, (smoothed.noise, smoothed.jerk))
    return accelerations.T.reshape(values.shape)


class Equation(NamedTuple):
    """Equation of motion of a side along a part, torques in N m.

    Attributes:
        inertia: of the side, kg m^2.
        taken: by it.
        modelled: that the smoother sees.
        beyond: modelled less that of the nominal equation J dv/dt = (input) - B v, the right-hand side that an observer
            (7)-(8) knows; without dry friction.
        friction: dry friction, which is to be subtracted from that.
        by_position, by_velocity: derivatives of the modelled torque by the positions and velocities.
    """

    inertia: Any
    taken: Any
    modelled: Any
    beyond: Any
    friction: Any
    by_position: SideSamples
    by_velocity: SideSamples


@jit
def _equations(experiment: Experiment, part: Kinematics, held: dict[str, Bool[Array, " samples"]]) -> dict[str, Equation]:
    """Equations of all sides along a part; `held`: where a side is not shown to move for a while."""
    states, torque = effect_path(experiment, part)
    drive, equations = experiment.drive, {}
    period = (part.time[-1] - part.time[0]) / (len(part.time) - 1)

    def of(position: dict, velocity: dict, *motion: Any) -> tuple[Any, Any]:
        """All modelled torques on each side; and apart from one another those without set-valued friction, and its level."""
        torques, total, levels = {}, {}, {}
        for side, (acting, level) in experiment.plant.side_torques(position, velocity, *motion).items():
            levels[side] = jnp.asarray(level, velocity[side].dtype)
            total[side] = acting - drive.viscous(side) * velocity[side]
            torques[side] = total[side] - levels[side] * jnp.sign(velocity[side])
        return torques, (total, levels)

    slopes, (totals, levels) = jax.vmap(jax.jacfwd(of, argnums=(0, 1), has_aux=True))(
        part.position, part.velocity, states, torque, part.time, part.transmitted
    )
    for side in experiment.sides:
        total, level, (by_position, by_velocity) = totals[side], levels[side], slopes[side]
        inertia, acceleration, velocity = experiment.plant.inertia(side), part.acceleration[side], part.velocity[side]
        driving = torque if side == "motor" else jnp.zeros_like(torque)
        # the share of the time around a sample in forward motion less that in backward motion, seen as the rest is
        step = jnp.maximum(jnp.abs(acceleration) * period, jnp.finfo(float).tiny)
        passage = jnp.clip(velocity / step, -1.0, 1.0)
        direction = passage * (2.0 - jnp.abs(passage))
        # what is not shown to move for a while may be held: friction is then what is missing, as far as it goes
        motion = Motion(part.time, part.position[side], velocity, driving)
        bent, most = experiment.plant.holding_torque(side, motion, states)
        needed = jnp.clip(total + bent - inertia * acceleration, -(level + most), level + most) - bent
        friction = jnp.where(held[side], needed, level * direction)
        # by the velocity at a reversal, whose time the velocity's noise leaves open
        turning = jnp.where(held[side], 0.0, 2.0 * level * (1.0 - jnp.abs(passage)) / step)
        # the input is a mean around the sample already; of the rest, the mean that the position's second differences see:
        # over the period on either side, weighted by a triangle, to fourth order
        without_input = total - driving
        modelled = driving + without_input.at[1:-1].add(jnp.diff(without_input, n=2) / 12.0) - friction
        added = (inertia - drive.inertia(side)) * acceleration
        nominal = drive.inertia(side) * drive.acceleration(side, velocity, part.torque)
        by_velocity = by_velocity | {side: by_velocity[side] - turning}
        equations[side] = Equation(
            inertia, inertia * acceleration, modelled, total - added - nominal, friction, by_position, by_velocity
        )
    return equations


def evaluate_equations(experiment: Experiment, segment: Segment) -> dict[str, Equation]:
    """Evaluate the equation of motion of each side along a segment."""
    held = {side: smoothed.find_standstill(segment.period) for side, smoothed in segment.smoothed.items()}
    return jax.tree.map(np.asarray, _equations(experiment, segment.kinematics, held))


def residual_torques(experiment: Experiment, segments: Sequence[Segment]) -> SideResiduals:
    """Torques that a model lacks on each side of a record, segment by segment.

    Noise: that of the readings through smoother and equation of motion, of a measured transmitted torque, and of position
    and velocity what the smoother leaves open; by the derivatives of the torques. Not in it: what the model's own numbers
    leave open.
    The model has array leaves, and the sample period of the record.
    """
    residuals: SideResiduals = {side: [] for side in experiment.sides}
    for segment in segments:
        part, responses = segment.kinematics, _responses(segment)
        sensor = 0.0 if part.transmitted is None else estimate_white_noise([np.asarray(part.transmitted)])
        equations = evaluate_equations(experiment, segment)
        for side, pieces in residuals.items():
            equation = equations[side]
            missing = equation.taken - as_smoothed(equation.modelled, segment.smoothed[side], segment.period)
            level = abs(float(experiment.drive.torque_gain(side))) * sensor
            variance, spectrum = _noise(segment, side, equation, level, responses)
            deviation = np.sqrt(np.maximum(variance, np.finfo(float).tiny))
            bandwidth = responses[side].corner / (2.0 * np.pi * segment.period)
            pieces.append(Residual(side, segment.time, missing, deviation, spectrum, bandwidth))
    return residuals


def _responses(segment: Segment) -> dict[str, _Response]:
    """Responses of each side's smoother, over as many frequencies as the slowest of them needs."""
    smoothness = {
        side: float(smoothed.jerk) * segment.period**5 / float(smoothed.noise) ** 2
        for side, smoothed in segment.smoothed.items()
    }
    slowest = _corner(min(smoothness.values()))
    size = int(2 ** np.ceil(np.log2(64.0 * 2.0 * np.pi / slowest)))
    return {side: _response(value, min(max(size, 1024), _LARGEST)) for side, value in smoothness.items()}


def _noise(
    segment: Segment,
    side: str,
    equation: Equation,
    sensor: float,
    responses: Mapping[str, _Response],
) -> tuple[np.ndarray, np.ndarray]:
    """Variance of a torque's noise at each sample, and its mean spectral density, (N m)^2.

    By the derivatives of the torque by all positions and velocities; `sensor`: noise of a measured torque in it, N m.
    """
    low_pass, corner = responses[side].low_pass, responses[side].corner
    inertia, slopes = float(equation.inertia), (equation.by_position, equation.by_velocity)
    # white noise of the sensor
    spectrum = low_pass**2 * sensor**2
    variance = np.full(len(segment), mean_density(spectrum))
    for name, smoothed in segment.smoothed.items():
        if name != side and not any(np.any(slope[name]) for slope in slopes):
            continue
        gain = float(smoothed.noise) * segment.period ** -np.arange(3.0)[:, None] * responses[name].gain
        # deviations of the smoothed states, away from the ends and near them
        variances = np.diagonal(smoothed.covariance, axis1=1, axis2=2).T
        near = variances / np.median(variances, axis=1)[:, None]
        # noise lasts about as long as the low-pass does
        by_position, by_velocity = (gaussian_filter1d(np.asarray(slope[name]), 1.0 / corner) for slope in slopes)
        for order, slope in enumerate((by_position, by_velocity)):
            passed = mean_density(np.abs(low_pass * gain[order]) ** 2)
            share = passed / mean_density(np.abs(gain[order]) ** 2)
            variance = variance + slope**2 * share * variances[order]
            # a slope that comes and goes spreads the noise over all frequencies
            shape = low_pass**2 * passed / mean_density(low_pass**2)
            spectrum = spectrum + np.mean(slope) ** 2 * np.abs(low_pass * gain[order]) ** 2 + np.var(slope) * shape
        if name == side:
            accelerating = inertia**2 * np.abs(gain[2]) ** 2
            cross = -2.0 * inertia * (low_pass * gain[0] * gain[2].conj()).real
            variance = (
                variance
                + near[2] * mean_density(accelerating)
                + np.sqrt(near[0] * near[2]) * by_position * mean_density(cross)
            )
            spectrum = spectrum + accelerating + np.mean(by_position) * cross
    return variance, spectrum


def narrow(residual: Residual, cutoff: float) -> tuple[Residual, np.ndarray]:
    """A residual behind a further zero-phase low-pass (Gaussian), without ends, no more samples than needed; their indices.

    Noise of accelerations grows with the square of the frequency: what is slow shows better without what is fast. At
    `cutoff` (Hz) half of the power passes.
    """
    width, stride, indices = _filter(residual, cutoff)
    # up to where a Gaussian that is sampled lets nothing through
    top, tiny = min(np.pi, _OPEN / width), np.finfo(float).tiny
    frequency, sampled = (np.linspace(0.0, end, _FREQUENCIES) for end in (top, np.pi / stride))
    response = np.exp(-0.5 * (width * (frequency[:, None] + 2.0 * np.pi * np.arange(-2, 3))) ** 2).sum(axis=1)
    passed = residual.density_at(frequency) * (response / response[0]) ** 2
    share = max(top / np.pi * mean_density(passed) / max(mean_density(residual.density), tiny), tiny)
    low = replace(
        residual,
        time=residual.time[indices],
        torque=gaussian_filter1d(residual.torque, width)[indices],
        deviation=np.sqrt(share * gaussian_filter1d(residual.deviation**2, width)[indices]),
        density=np.interp(sampled, frequency, passed, right=0.0),
        bandwidth=min(cutoff, residual.bandwidth),
    )
    return low, indices


def _filter(residual: Residual, cutoff: float) -> tuple[float, int, np.ndarray]:
    """Width of the Gaussian in samples, distance of those that are kept, and their indices."""
    width = np.sqrt(np.log(2.0)) / (2.0 * np.pi * cutoff * residual.period)
    # at the ends smoother and filter find but one side
    cut = min(int(3.0 * width + 0.5 / (residual.bandwidth * residual.period)), len(residual.time) // 4)
    stride = max(int(width), 1)
    return width, stride, np.arange(cut, len(residual.time) - cut, stride)


def low_passed(values: np.ndarray, residual: Residual, cutoff: float) -> np.ndarray:
    """Signals along a residual behind the low-pass of :func:`narrow`; shape (..., samples)."""
    width, _, indices = _filter(residual, cutoff)
    return gaussian_filter1d(values, width, axis=-1)[..., indices]
