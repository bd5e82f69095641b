"""Torques that a model lacks on a record, with their own noise level.

The smoother sees the acceleration through a zero-phase low-pass H of its own: 1 / (1 + (w / w_c)^6) for w well below the
sampling rate, w_c^6 = q / (sigma^2 h). The model's torques pass the same low-pass, so that a complete model leaves nothing
but noise, also where its torques jump (friction at a reversal). What is found is H applied to the missing torque.

Sign: the torque that is missing from the model, J a less all modelled torques; minus the residual of
:func:`jaxbl.identification.regression.balance`.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.ndimage import gaussian_filter1d

from jaxbl.drive.plant import States
from jaxbl.identification.regression import Kinematics, effect_path
from jaxbl.identification.segments import Segment
from jaxbl.identification.smoother import JERK_COVARIANCE, TRANSITION, Smoothed, running_sum, smooth
from jaxbl.simulate import Experiment

_REACH = 60.0
"""Length of the noise's correlation, over 1 / w_c: what is slow is a small rest of what is fast, and needs all of it."""
_LARGEST = 2**18
"""Frequencies of a response at most, which bounds memory."""


@dataclasses.dataclass(frozen=True)
class Residual:
    """Torque that a model lacks in one equation, along a part of a record without gaps.

    Attributes:
        name: `motor`, `load` or `transmission`.
        time: s, shape (samples,).
        torque: missing torque behind the low-pass, N m; positive where it drives forward.
        deviation: standard deviation of its noise, N m.
        correlation: of the noise, from lag 0 on; zero beyond.
        bandwidth: of the low-pass, Hz: faster torques are not seen.
    """

    name: str
    time: np.ndarray
    torque: np.ndarray
    deviation: np.ndarray
    correlation: np.ndarray
    bandwidth: float

    @property
    def period(self) -> float:
        """Sampling period, s."""
        return float(self.time[-1] - self.time[0]) / (len(self.time) - 1)


@dataclasses.dataclass(frozen=True)
class _Response:
    """A smoother away from the ends, over frequencies from 0 to half the sampling rate, in units of noise and period.

    Attributes:
        frequency: rad per sample.
        gain: from readings to position, velocity, acceleration; shape (3, frequencies).
        low_pass: H, from true to smoothed acceleration.
        corner: w_c in rad per sample.
    """

    frequency: np.ndarray
    gain: np.ndarray
    low_pass: np.ndarray
    corner: float


def _response(smoothness: float, size: int) -> _Response:
    """By the spectrum of the sampled white-jerk model, x' = F x + w with F = I + N."""
    frequency = np.linspace(0.0, np.pi, size // 2 + 1)
    frequency[0] = 1e-3 * frequency[1]
    d = np.expm1(1j * frequency)
    n = np.array(TRANSITION) - np.eye(3)
    # (dI - N)^-1 d^3, as N^3 = 0
    inverse = d[:, None, None] ** 2 * np.eye(3) + d[:, None, None] * n + n @ n
    spectrum = smoothness * np.einsum("wij,jk,wk->iw", inverse, np.array(JERK_COVARIANCE), inverse[:, 0].conj())
    square = np.abs(d) ** 2
    gain = spectrum / (spectrum[0].real + square**3)
    return _Response(frequency, gain, -gain[2].real / square, _corner(smoothness))


def _corner(smoothness: float) -> float:
    return min(smoothness ** (1.0 / 6.0), np.pi)


def _smoothness(smoothed: Smoothed, period: float) -> float:
    return float(smoothed.jerk) * period**5 / float(smoothed.noise) ** 2


def _mean(spectrum: np.ndarray) -> float:
    """Variance of a real signal with a spectral density given from 0 to half the sampling rate."""
    return float(np.trapezoid(spectrum) / (len(spectrum) - 1))


def as_smoothed(
    values: Float[Array, " samples"], smoothed: Smoothed, period: float | Float[Array, ""]
) -> Float[Array, " samples"]:
    """Values as if they were accelerations seen through a smoother, its ends included."""
    # a steady acceleration passes unchanged
    steady = jnp.mean(values)
    rate = running_sum(values - steady) * period
    position = jnp.concatenate([jnp.zeros(1), running_sum(rate)[:-1] * period])
    # second differences of the position are the values
    return steady + smooth(position, period, noise=smoothed.noise, jerk=smoothed.jerk).acceleration  # type: ignore[arg-type]


def _mean_around(values: Float[Array, " samples"]) -> Float[Array, " samples"]:
    """Mean over the sampling period on either side of each sample, weighted by a triangle, to fourth order."""
    return values.at[1:-1].add(jnp.diff(values, n=2) / 12.0)


def _torque(
    experiment: Experiment,
    side: str,
    position: dict,
    velocity: dict,
    states: States,
    torque: Array,
    time: Array,
    transmitted: Array | None,
) -> tuple[Array, Array]:
    """All modelled torques on a side but for set-valued friction, and the level of that, N m."""
    total, level = experiment.plant.torques(position, velocity, states, torque, time, transmitted)[side]
    return total - experiment.drive.viscous(side) * velocity[side], jnp.asarray(level, torque.dtype)


class _Acting(NamedTuple):
    """Modelled torques on a side along a part, N m.

    Attributes:
        total: all but dry friction.
        friction: dry friction, where it is shown.
        level: the most that friction can be.
        held: where friction may hold the side.
        passage: velocity over its change within a sampling period, within -1 and 1.
        step: that change, rad/s.
    """

    total: Array
    friction: Array
    level: Array
    held: Array
    passage: Array
    step: Array


def _acting(experiment: Experiment, side: str, part: Kinematics, smoothed: Smoothed) -> _Acting:
    states, torque = effect_path(experiment, part, from_rest=True)
    given = part.position, part.velocity, states, torque, part.time, part.transmitted
    total, level = jax.vmap(lambda *at: _torque(experiment, side, *at))(*given)
    inertia, velocity, acceleration = experiment.plant.inertia(side), part.velocity[side], part.acceleration[side]
    period = (part.time[-1] - part.time[0]) / (len(part.time) - 1)
    # the share of the time around a sample in forward motion less that in backward motion, seen as the rest is
    step = jnp.maximum(jnp.abs(acceleration) * period, jnp.finfo(float).tiny)
    passage = jnp.clip(velocity / step, -1.0, 1.0)
    direction = passage * (2.0 - jnp.abs(passage))
    # what is not shown to move for a while may be held: friction is then what is missing, as far as it goes
    held = smoothed.held(period)
    friction = jnp.where(held, jnp.clip(total - inertia * acceleration, -level, level), level * direction)
    return _Acting(total, friction, level, held, passage, step)


@eqx.filter_jit
def beyond_nominal(
    experiment: Experiment, side: str, part: Kinematics, smoothed: Smoothed
) -> tuple[Float[Array, " samples"], Float[Array, " samples"]]:
    """Modelled torque on a side less that of its nominal equation, in which the inertia is the nominal one, N m.

    What transmission and effects add to J dv/dt = (input) - B v, the right-hand side that an observer (7)-(8) knows; and,
    on its own, the dry friction that is to be subtracted.
    """
    drive, velocity = experiment.drive, part.velocity[side]
    acting = _acting(experiment, side, part, smoothed)
    added = (experiment.plant.inertia(side) - drive.inertia(side)) * part.acceleration[side]
    nominal = drive.inertia(side) * drive.acceleration(side, velocity, part.torque)
    return acting.total - added - nominal, acting.friction


@eqx.filter_jit
def _side(
    experiment: Experiment, side: str, part: Kinematics, smoothed: dict[str, Smoothed]
) -> tuple[Array, dict[str, Array], dict[str, Array]]:
    """Missing torque, and the derivatives of the modelled torque by the positions and velocities, along a part."""
    states, torque = effect_path(experiment, part, from_rest=True)
    given = part.position, part.velocity, states, torque, part.time, part.transmitted
    acting = _acting(experiment, side, part, smoothed[side])
    period = (part.time[-1] - part.time[0]) / (len(part.time) - 1)
    # the input is a mean around the sample already; of the rest, the mean that the position's second differences see
    driving = torque if side == "motor" else jnp.zeros_like(torque)
    modelled = driving + _mean_around(acting.total - driving) - acting.friction
    missing = experiment.plant.inertia(side) * part.acceleration[side] - as_smoothed(modelled, smoothed[side], period)

    def of(position: dict, velocity: dict, *rest: Any) -> Array:
        total, level = _torque(experiment, side, position, velocity, *rest)
        return total - level * jnp.sign(velocity[side])

    by_position, by_velocity = jax.vmap(jax.jacfwd(of, argnums=(0, 1)))(*given)
    # when a reversal is, the velocity's noise leaves open
    turning = jnp.where(acting.held, 0.0, 2.0 * acting.level * (1.0 - jnp.abs(acting.passage)) / acting.step)
    by_velocity[side] = by_velocity[side] - turning
    return missing, by_position, by_velocity


@eqx.filter_jit
def _transmission(
    experiment: Experiment, part: Kinematics, smoothed: dict[str, Smoothed]
) -> tuple[Array, dict[str, Array], dict[str, Array]]:
    assert part.transmitted is not None

    def of(position: dict, velocity: dict, states: States) -> Array:
        return experiment.plant.transmitted(position, velocity, states)[0]

    given = part.position, part.velocity, effect_path(experiment, part, from_rest=True)[0]
    slopes = jax.vmap(jax.jacfwd(of, argnums=(0, 1)))(*given)
    return part.transmitted - jax.vmap(of)(*given), *slopes


def white_noise(parts: Sequence[np.ndarray]) -> float:
    """Standard deviation of white noise on a signal in parts, by its fourth differences: what is smooth is not in them, nor
    are jumps, of which there are few."""
    fourth = np.concatenate([np.diff(part, n=4) for part in parts])
    return float(np.median(np.abs(fourth)) / 0.6745 / np.sqrt(70.0))


def residual_torques(
    experiment: Experiment,
    segments: Sequence[Segment],
    *,
    torque_noise: float = 0.0,
    transmitted_noise: float | None = None,
) -> dict[str, list[Residual]]:
    """Torques that a model lacks on a record, by equation (each side; `transmission` where its torque was measured).

    Noise: that of the readings through smoother and equation of motion, and of the position and velocity what the smoother
    leaves open; by the derivatives of the torques. Not in it: what the model's own numbers leave open.

    Args:
        experiment: the model, with array leaves; its sample period is that of the record.
        segments: of the record.
        torque_noise: standard deviation of the input's noise from sample to sample, N m.
        transmitted_noise: of the measured transmitted torque, N m; left out, by its fourth differences.
    """
    found: dict[str, list[Residual]] = {}
    for segment in segments:
        part, sensor = segment.kinematics, 0.0
        if part.transmitted is not None:
            sensor = white_noise([np.asarray(part.transmitted)]) if transmitted_noise is None else transmitted_noise
        if part.transmitted is not None and experiment.transmission is not None:
            missing, by_position, by_velocity = _transmission(experiment, part, segment.smoothed)
            noise = _Noise(segment, by_position, by_velocity)
            found.setdefault("transmission", []).append(noise.of("transmission", missing, None, 0.0, sensor))
        for side in experiment.sides:
            missing, by_position, by_velocity = _side(experiment, side, part, segment.smoothed)
            noise = _Noise(segment, by_position, by_velocity)
            inertia = float(experiment.plant.inertia(side))
            level = abs(float(experiment.drive.torque_gain(side))) * sensor
            driving = torque_noise if side == "motor" else 0.0
            found.setdefault(side, []).append(noise.of(side, missing, inertia, driving, level))
    return found


class _Noise:
    """Noise of torques along a segment, from the derivatives by positions and velocities."""

    def __init__(self, segment: Segment, by_position: Mapping[str, Array], by_velocity: Mapping[str, Array]):
        smoothed = segment.smoothed
        self.time = segment.time
        self.period = float(self.time[-1] - self.time[0]) / (len(self.time) - 1)
        self.smoothed = smoothed
        self.slopes = {
            side: (np.asarray(by_position[side]), np.asarray(by_velocity[side]))
            for side in smoothed
            if np.any(by_position[side]) or np.any(by_velocity[side])
        }
        smoothness = {side: _smoothness(one, self.period) for side, one in smoothed.items()}
        slowest = min(_corner(one) for one in smoothness.values())
        size = int(2 ** np.ceil(np.log2(64.0 * 2.0 * np.pi / slowest)))
        size = min(max(size, 1024), _LARGEST)
        self.responses = {side: _response(one, size) for side, one in smoothness.items()}
        # deviations of the smoothed states, away from the ends and near them
        self.variance = {side: np.diagonal(np.asarray(one.covariance), axis1=1, axis2=2).T for side, one in smoothed.items()}

    def of(self, side: str, missing: Array, inertia: float | None, driving: float, sensor: float) -> Residual:
        """The residual of an equation: of a side with its inertia, or of the transmission (None)."""
        any_response = next(iter(self.responses.values()))
        low_pass = np.ones_like(any_response.frequency) if inertia is None else self.responses[side].low_pass
        # white noise of the input, mean of two samples; of the sensor
        spectrum = low_pass**2 * ((driving * np.cos(0.5 * any_response.frequency)) ** 2 + sensor**2)
        variance = np.full(len(self.time), _mean(spectrum))
        for name in {side, *self.slopes} & set(self.smoothed):
            response, noise = self.responses[name], float(self.smoothed[name].noise)
            unit = noise * self.period ** -np.arange(3.0)
            gain = unit[:, None] * response.gain
            inside = np.median(self.variance[name], axis=1)
            near = self.variance[name] / inside[:, None]
            zero = np.zeros(len(self.time))
            by_position, by_velocity = self.slopes.get(name, (zero, zero))
            if inertia is not None:
                # noise lasts about as long as the low-pass does
                width = 1.0 / self.responses[side].corner
                by_position, by_velocity = (gaussian_filter1d(slope, width) for slope in (by_position, by_velocity))
            for order, slope in enumerate((by_position, by_velocity)):
                passed = _mean(np.abs(low_pass * gain[order]) ** 2)
                share = passed / _mean(np.abs(gain[order]) ** 2)
                variance = variance + slope**2 * share * self.variance[name][order]
                # a slope that comes and goes spreads the noise over all frequencies
                shape = low_pass**2 * passed / _mean(low_pass**2)
                spectrum = spectrum + np.mean(slope) ** 2 * np.abs(low_pass * gain[order]) ** 2 + np.var(slope) * shape
            if name == side and inertia is not None:
                own, cross = inertia**2 * np.abs(gain[2]) ** 2, -2.0 * inertia * (low_pass * gain[0] * gain[2].conj()).real
                variance = variance + near[2] * _mean(own) + np.sqrt(near[0] * near[2]) * by_position * _mean(cross)
                spectrum = spectrum + own + np.mean(by_position) * cross
        lags = min(int(_REACH / min(one.corner for one in self.responses.values())) + 2, len(self.time))
        correlation = np.fft.irfft(spectrum)[:lags]
        corner = np.pi if inertia is None else self.responses[side].corner
        tiny = np.finfo(float).tiny
        return Residual(
            side, self.time, np.asarray(missing), np.sqrt(np.maximum(variance, tiny)),
            correlation / max(correlation[0], tiny), corner / (2.0 * np.pi * self.period),
        )  # fmt: skip


def narrowed(residual: Residual, cutoff: float) -> tuple[Residual, np.ndarray]:
    """A residual behind a further zero-phase low-pass (Gaussian), without ends, no more samples than needed; their indices.

    Noise of accelerations grows with the square of the frequency: what is slow shows better without what is fast.

    Args:
        residual: of a part.
        cutoff: frequency at which half of the power passes, Hz.
    """
    width = np.sqrt(np.log(2.0)) / (2.0 * np.pi * cutoff * residual.period)
    stride = max(int(width), 1)
    # at the ends smoother and filter find but one side
    cut = min(int(3.0 * width + 0.5 / (residual.bandwidth * residual.period)), len(residual.time) // 4)
    at = np.arange(cut, len(residual.time) - cut, stride)
    reach = len(residual.correlation) + int(8.0 * width)
    size = 2 ** int(np.ceil(np.log2(2 * reach)))
    spectrum = noise_spectrum(residual.correlation, size)
    impulse = np.zeros(size)
    impulse[size // 2] = 1.0
    passed = np.fft.irfft(spectrum * np.abs(np.fft.rfft(gaussian_filter1d(impulse, width))) ** 2)
    share = max(passed[0], np.finfo(float).tiny)
    low = dataclasses.replace(
        residual,
        time=residual.time[at],
        torque=gaussian_filter1d(residual.torque, width)[at],
        deviation=np.sqrt(share * gaussian_filter1d(residual.deviation**2, width)[at]),
        correlation=passed[:reach:stride] / share,
        bandwidth=min(cutoff, residual.bandwidth),
    )
    return low, at


def noise_spectrum(correlation: np.ndarray, size: int) -> np.ndarray:
    """Spectral density over the variance, from 0 to half the sampling rate, of noise with a correlation from lag 0 on."""
    both = np.zeros(size)
    lags = min(len(correlation), size // 2)
    both[:lags] = correlation[:lags]
    both[size - lags + 1 :] = correlation[lags - 1 : 0 : -1]
    return np.maximum(np.fft.rfft(both).real, 0.0)
