"""A log as filtered derivatives, and the torques and terms of its equation of motion behind the same low-pass."""

import dataclasses
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
from scipy import signal

from jaxbl.config import Config
from jaxbl.estimation.logs import on_record
from jaxbl.estimation.regression import Kinematics, balance
from jaxbl.records import Record

sys.path.append(str(Path(__file__).parents[1]))
from filtered_derivatives import differentiate

_ENDS = 4.0
"""Left out at either end of a part, in periods of the cutoff: there the filter has readings on one side only. With 1.5 the
ends of a made log err by 300 times as much as its middle, with 4 by as much."""
_LEAST = 2.5
"""Length of a part at least, over what is left out at one end."""
_RATE = 4.0
"""Samples that are kept, per period of the cutoff: twice what the low-pass leaves."""
_SEEN = 5.0
"""Standard deviations of its noise that a speed has to exceed, or the drive may be at rest: dry friction then takes what it
has to, and no equation of motion says how much."""
_HARMONICS = 40
"""Most periods a turn that are tried: more than the poles, teeth and balls of small drives make."""
_SLOW = (0.01, 0.03, 0.1, 0.3)
"""Stribeck velocities that are tried, over the largest speed."""


@dataclass(frozen=True)
class Part:
    """A log, or a part of it, without gaps.

    Attributes:
        kinematics: by Butterworth low-pass forth and back and central differences.
        period: sampling period, s.
        cutoff: of the low-pass, Hz.
        moving: whether the motor moves, shape (samples,).
    """

    kinematics: Kinematics
    period: float
    cutoff: float
    moving: np.ndarray

    def low_passed(self, values: np.ndarray) -> np.ndarray:
        """Values in motion behind the low-pass of the positions, without ends, and no more of them than needed; rows are
        samples."""
        sections = signal.butter(4, min(2.0 * self.cutoff * self.period, 0.99), output="sos")
        cut = round(_ENDS / (self.cutoff * self.period))
        stride = max(int(1.0 / (_RATE * self.cutoff * self.period)), 1)
        rows = slice(cut, len(values) - cut, stride)
        return signal.sosfiltfilt(sections, values, axis=0)[rows][self.moving[rows]]


def parts_of(record: Record, sides: Sequence[str], cutoff: float) -> list[Part]:
    """All parts of a log that are longer than what is left out at their ends."""
    assert record.torque is not None
    parts = []
    for rows in record.segments:
        if (rows.stop - rows.start) * record.sample_period < _LEAST * _ENDS / cutoff:
            continue
        positions = {side: record.positions[side][rows] for side in sides}
        with jax.enable_x64(True):
            motion = differentiate(record.time[rows], record.torque[rows], positions, cutoff)
        least = _SEEN * _speed_noise(record, cutoff)
        moving = np.abs(np.asarray(motion.velocity["motor"])) > least
        parts.append(Part(motion, record.sample_period, cutoff, moving))
    return parts


def _speed_noise(record: Record, cutoff: float) -> float:
    """Standard deviation of the motor's speed behind an ideal low-pass, by the noise of the readings and their steps."""
    channel, h = record.statistics.channels["theta_e"], record.sample_period
    noise = np.hypot(channel.noise, channel.resolution / np.sqrt(12.0))
    return float(2.0 * np.pi * noise * np.sqrt(2.0 * h * min(cutoff, 0.5 / h) ** 3 / 3.0))


def driving(parts: Sequence[Part], inertia: float) -> float:
    """Rms of the input, or where there is none of the inertia's torque, N m."""
    torque = np.concatenate([part.low_passed(np.asarray(part.kinematics.torque)) for part in parts])
    if np.any(torque):
        return float(np.sqrt(np.mean(torque**2)))
    speeding = np.concatenate([part.low_passed(np.asarray(part.kinematics.acceleration["motor"])) for part in parts])
    return float(inertia * np.sqrt(np.mean(speeding**2)))


_MORE = 0.01
"""Share by which the input is raised to see what of it acts: small enough to be a derivative."""


def torque_error(model: Config, record: Record, parts: Sequence[Part]) -> np.ndarray:
    """Torque on the motor side by which a model misses the equation of motion, behind the low-pass, N m.

    Referred to the input: a model that multiplies all its torques, and the input by a gain, by one factor misses the same.
    """
    missed, acting, torques = [], [], []
    with jax.enable_x64(True):
        experiment = on_record(model, record)
        for part in parts:
            k = part.kinematics
            raised = dataclasses.replace(k, torque=(1.0 + _MORE) * k.torque)
            left, more = (np.asarray(balance(experiment, motion)["motor"].residual) for motion in (k, raised))
            missed.append(part.low_passed(left))
            acting.append(part.low_passed((more - left) / _MORE))
            torques.append(part.low_passed(np.asarray(k.torque)))
    torque = np.concatenate(torques)
    gain = np.concatenate(acting) @ torque / (torque @ torque) if np.any(torque) else 1.0
    return np.concatenate(missed) / gain


@dataclass(frozen=True)
class Terms:
    """The equation of motion of the motor side as a sum of terms with unknown factors.

    Attributes:
        target: input less the torques that are known, N m, shape (samples,).
        names: of the terms; several columns may share a name, and are kept or left out together.
        units: of each column's factor.
        columns: behind the low-pass, shape (samples, columns).
        base: names that are in the equation from the beginning, those of the nominal model.
        exclusive: names of which the equation has one at most.
    """

    target: np.ndarray
    names: tuple[str, ...]
    units: tuple[str, ...]
    columns: np.ndarray
    base: tuple[str, ...]
    exclusive: tuple[str, ...]

    def of(self, names: Sequence[str]) -> np.ndarray:
        """Indices of the columns of some terms."""
        return np.array([i for i, name in enumerate(self.names) if name in names], dtype=int)


def terms_of(
    parts: Sequence[Part], model: Config, linear: bool, spans: tuple[float, float], harmonics: int = _HARMONICS
) -> Terms:
    """Terms of a log.

    Args:
        parts: of the log.
        model: nominal; says which terms are there from the beginning, and which inertia is known.
        linear: whether positions are in m: a place then has no angle.
        spans: largest speed and travel of the log that is fitted, which say what is tried.
        harmonics: most periods a turn; with more than those of small drives, what a gear has besides is tried, too.
    """
    drive = model.drive
    exact_inertia = drive.motor_inertia if "drive.motor_inertia" in model.uncertainty.exact else None
    rigid = drive.kind == "rigid"
    target, rows, names, units = [], [], [], []
    force = "N" if linear else "N m"
    for part in parts:
        k = part.kinematics
        q, v, a = (np.asarray(column["motor"]) for column in (k.position, k.velocity, k.acceleration))
        columns = _columns(q, v, a, linear, spans, harmonics)
        if not rigid:
            twist = q - np.asarray(k.position["load"]) * float(drive.gear_ratio)
            rate = v - np.asarray(k.velocity["load"]) * float(drive.gear_ratio)
            columns += [
                ("twist", "N m/rad", twist),
                ("twist rate", "N m s/rad", rate),
                ("twist cubed", "N m/rad³", twist**3),
            ]
            if harmonics > _HARMONICS:
                load = np.asarray(k.position["load"])
                columns.append(("friction under load", "1", np.sign(v) * np.abs(twist)))
                for n in (1, 2):
                    columns += [(f"{n} a load turn", "N m", wave(n * load)) for wave in (np.sin, np.cos)]
        if exact_inertia is not None:
            columns = columns[1:]
        torque = np.asarray(k.torque) - (exact_inertia or 0.0) * a
        target.append(part.low_passed(torque))
        rows.append(part.low_passed(np.stack([column for _, _, column in columns], axis=1)))
        names, units = [column for column, _, _ in columns], [column.replace("N m", force) for _, column, _ in columns]
    base = ([] if exact_inertia is not None else ["inertia"]) + (["viscous"] if drive.motor_viscous > 0.0 else [])
    base += [] if rigid else ["twist"]
    slow = tuple(column for column in names if column.startswith("Stribeck"))
    return Terms(np.concatenate(target), tuple(names), tuple(units), np.concatenate(rows), tuple(base), slow)


def _columns(
    q: np.ndarray, v: np.ndarray, a: np.ndarray, linear: bool, spans: tuple[float, float], harmonics: int
) -> list[tuple[str, str, np.ndarray]]:
    fastest, travel = spans
    columns = [
        ("inertia", "kg m²" if not linear else "kg", a),
        ("viscous", "N m s/rad" if not linear else "N s/m", v),
        ("Coulomb", "N m", np.sign(v)),
        ("constant", "N m", np.ones_like(v)),
        ("quadratic drag", "N m s²/rad²" if not linear else "N s²/m²", v * np.abs(v)),
        ("viscous by direction", "N m s/rad" if not linear else "N s/m", np.abs(v)),
    ]
    for share in _SLOW:
        columns.append((f"Stribeck at {share * fastest:.2g}", "N m", np.sign(v) * np.exp(-((v / (share * fastest)) ** 2))))
    if not linear:
        for n in range(1, harmonics + 1):
            # one whole wave, or it cannot be told from the slower terms; of gravity a pendulum shows less
            if n == 1 or travel >= 2.0 * np.pi / n:
                columns += [(f"{n} a turn", "N m", np.sin(n * q)), (f"{n} a turn", "N m", np.cos(n * q))]
    return columns
