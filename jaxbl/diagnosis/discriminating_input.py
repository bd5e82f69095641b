"""The input on which two models differ most, within given limits: the experiment that parts them.

References: G. Box, W. Hill, Discrimination among mechanistic models, Technometrics 9 (1967); W. Hunter, A. Reiner, Designs
for discriminating between two rival models, Technometrics 7 (1965).
"""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.signal import max_len_seq

from jaxbl.drive.plant import PlantState
from jaxbl.records import Record
from jaxbl.simulate import Experiment, trajectory

INPUT_KINDS = "sine", "multisine", "chirp", "steps"
_SHARES = 0.01, 0.03, 0.1, 0.25, 0.5, 0.75, 1.0
"""Amplitudes, over the largest torque allowed."""
_FREQUENCIES = 6
"""Tried of each kind, evenly spaced in their logarithm."""
_HARMONICS = 8
"""Of a multisine, with Schroeder's phases (IEEE Trans. Information Theory 16, 1970)."""
_LONGEST = 10.0
"""Duration at most, s."""


class Input(NamedTuple):
    """An input that was tried.

    Attributes:
        kind: one of :data:`INPUT_KINDS`.
        amplitude: largest torque, N m.
        frequency: Hz; of a multisine the lowest, of a chirp the first, of steps one over twice their length.
        torque: shape (samples,).
        apart: nats by which readings of it favour one model over the other: half the sum of squares of the difference of
            their positions, over the variance of the readings' noise.
    """

    kind: str
    amplitude: float
    frequency: float
    torque: np.ndarray
    apart: float


def inputs(record: Record, largest: float) -> list[Input]:
    """Inputs of up to a torque (N m), at the period of a log: kinds, amplitudes and frequencies."""
    period = record.sample_period
    # gaps of a log are no part of it
    duration = min(sum(part.stop - part.start for part in record.segments) * period, _LONGEST)
    time = period * np.arange(round(duration / period))
    top = min(0.02 / period, 10.0)
    found = []
    for frequency in np.geomspace(min(2.0 / duration, 0.5 * top), top, _FREQUENCIES):
        for kind in INPUT_KINDS:
            wave = _wave(kind, time, float(frequency))
            wave = wave / np.max(np.abs(wave))
            found += [Input(kind, share * largest, float(frequency), share * largest * wave, 0.0) for share in _SHARES]
    return found


def _wave(kind: str, time: np.ndarray, frequency: float) -> np.ndarray:
    if kind == "sine":
        return np.sin(2.0 * np.pi * frequency * time)
    if kind == "multisine":
        k = np.arange(1, _HARMONICS + 1)
        phases = -np.pi * k * (k - 1.0) / _HARMONICS
        return np.sum(np.cos(2.0 * np.pi * frequency * k[:, None] * time[None, :] + phases[:, None]), axis=0)
    if kind == "chirp":
        # over a decade
        return np.sin(2.0 * np.pi * frequency * (1.0 + 4.5 * time / time[-1]) * time)
    bits, _ = max_len_seq(7)
    return 2.0 * bits[np.floor(2.0 * frequency * time + 1e-9).astype(int) % len(bits)] - 1.0


def parting(
    one: Experiment,
    other: Experiment,
    record: Record,
    noise: Mapping[str, float],
    torque: float | None = None,
    travel: float | None = None,
) -> Input | None:
    """The input on which two models' positions differ most, within torque and travel; None where all go beyond.

    Both begin at rest in the middle of the log's motion. What another initial position or speed would make of the
    difference does not count.

    Args:
        one, other: the models, with array leaves; the sample period is that of the record.
        record: the log.
        noise: of its readings, by side, rad.
        torque: largest that is allowed, N m; left out: that of the log.
        travel: of the motor that is allowed, rad (the load may move as far over the gear); left out: those of the log.
    """
    assert record.torque is not None
    tried = inputs(record, float(np.max(np.abs(record.torque))) if torque is None else torque)
    torques = jnp.asarray(np.stack([each.torque for each in tried]))
    start = {
        side: jnp.asarray(float(np.median(np.concatenate([values[part] for part in record.segments]))))
        for side, values in record.positions.items()
        if side in one.sides
    }
    if len(start) == 2:
        start["motor"] = start["load"] * jnp.asarray(float(one.drive.ratio("load")))
    paths = [_runs(model, start, torques) for model in (one, other)]
    apart, inside = np.zeros(len(tried)), np.ones(len(tried), bool)
    for side in one.sides:
        if travel is None:
            reach = max(float(np.ptp(record.positions[side][part])) for part in record.segments)
        else:
            reach = travel / (abs(float(one.drive.ratio(side))) if side != "motor" else 1.0)
        first, second = (np.asarray(path[side]) for path in paths)
        for path in (first, second):
            finite = np.isfinite(path).all(axis=1)
            inside &= finite & (np.ptp(np.where(np.isfinite(path), path, 0.0), axis=1) <= reach)
        difference = np.where(np.isfinite(second - first), second - first, 0.0)
        line = np.vander(np.linspace(-1.0, 1.0, difference.shape[1]), 2)
        basis, _ = np.linalg.qr(line)
        left = difference - (difference @ basis) @ basis.T
        apart += 0.5 * np.sum((left / noise[side]) ** 2, axis=1)
    if not inside.any():
        return None
    best = int(np.argmax(np.where(inside, apart, -1.0)))
    return tried[best]._replace(apart=float(apart[best]))


@eqx.filter_jit
def _runs(
    experiment: Experiment, position: dict[str, Array], torques: Float[Array, "inputs samples"]
) -> dict[str, Float[Array, "inputs samples"]]:
    rest = experiment.plant.init(experiment.initial)
    still = jax.tree.map(jnp.zeros_like, position)
    start = PlantState(position, still, rest.effects)
    return jax.vmap(lambda torque: trajectory(experiment, start, torque).position)(torques)
