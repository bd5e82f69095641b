"""Inspect a measured log: judge which quantities it can identify, before anything is fitted to it."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from jaxbl.lines import percent

from .alignment import NominalDrive
from .element import SIZE_NAMES, Element, RigLog, fit_element
from .gearing import Gearing, twist_noise
from .least_squares import fit_with_jackknife, rms
from .reader import Record, read_log_table, read_record
from .rigid_body import RigidFit, fit_rigid_drive, smooth_sign
from .signal_quality import low_pass, low_pass_motion
from .table import POSITION_CHANNELS, LogTable

_Answer = Literal["yes", "weak", "no"]
_Judgement = tuple[_Answer, str]
"""An answer and its reason, as in :class:`Identifiability`."""
_Judgements = dict[str, _Judgement]
"""Judgements by quantity."""


@dataclass(frozen=True)
class Identifiability:
    """Answer to the question if a log can identify a quantity of the drive.

    Attributes:
        quantity: name of the quantity.
        answer: yes; weak: with large uncertainty, or only together with another quantity; no.
        reason: a sentence.
    """

    quantity: str
    answer: _Answer
    reason: str


@dataclass(frozen=True)
class Inspection:
    """A log, and the quantities that it can identify.

    Attributes:
        record: the log as read.
        log: its `[log]` table.
        gear_ratio: motor over load motion: the expected one, else that of the log; None with one encoder.
        reversals: number of changes of the direction of motion.
        identifiability: an answer for each quantity.
        element: fit of a transmission on a test rig; None for a drive, or if the log shows no transmission.
    """

    record: Record
    log: LogTable
    gear_ratio: float | None
    reversals: int
    identifiability: tuple[Identifiability, ...]
    element: Element | None = None

    def describe_sizes(self) -> str:
        """Describe the log by sizes that its user knows, in one sentence: a wrong unit shows in them."""
        record, side = self.record, main_side(self.record)
        channel = record.statistics.channels[POSITION_CHANNELS[side]]
        is_rotary = channel.unit == "rad"
        if self.log.kind == "element":
            displacement, torque = np.ptp(compute_twist(record, self.gear_ratio)), record.torque
            assert torque is not None
            return (
                f"As read: displacement over {displacement:.3g} {channel.unit}, u over {np.ptp(torque):.3g} "
                f"{record.statistics.channels['u'].unit}. If the rig is another, see the units in [log]."
            )
        top_speed = np.quantile(np.abs(compute_velocity(record)), 0.999)
        sizes = [f"{side} up to " + (f"{top_speed * 30.0 / math.pi:.3g} rpm" if is_rotary else f"{top_speed:.3g} m/s")]
        if record.torque is not None and np.ptp(record.torque):
            sizes.append(f"u up to {np.abs(record.torque).max():.3g} {record.statistics.channels['u'].unit}")
            fit = record.statistics.dynamics
            if fit is not None and 0.0 < 4.0 * fit.errors[0] < fit.values[0] and fit.inflation[0] < 10.0:
                sizes.append(f"inertia about {fit.values[0]:.2g} {'kg m²' if is_rotary else 'kg'}")
        return f"As read: {', '.join(sizes)}. If the machine is another, see the units in [log]."

    @property
    def twist(self) -> np.ndarray | None:
        """theta_e - gear_ratio theta_s about its median, rad (m), shape (samples,); None without a ratio."""
        if self.gear_ratio is None:
            return None
        twist = compute_twist(self.record, self.gear_ratio)
        return twist - np.median(twist)

    def to_dict(self) -> dict[str, Any]:
        """Return the content of `inspection.json`."""
        record, statistics = self.record, self.record.statistics
        return {
            "file": str(record.path.resolve()),
            "samples": len(record.time),
            "sample_period": record.sample_period,
            "start": record.start,
            "closed_loop": record.closed_loop,
            "segments": [record.time[s][[0, -1]].tolist() for s in record.segments],
            "gear_ratio": self.gear_ratio,
            **asdict(statistics),
            "dynamics": None if statistics.dynamics is None else statistics.dynamics.to_dict(),
            "reversals": self.reversals,
            "element": None if self.element is None else self.element.to_dict(),
            "identifiable": [
                {"quantity": judgement.quantity, "answer": judgement.answer, "why": judgement.reason}
                for judgement in self.identifiability
            ],
            "warnings": list(record.warnings),
            "notes": list(record.notes),
        }


def inspect(
    path: str | Path,
    log: LogTable | Mapping[str, Any] | None = None,
    *,
    gear_ratio: float | None = None,
    nominal: NominalDrive | None = None,
) -> Inspection:
    """Read a measured log and judge what it can identify; arguments and errors are those of :func:`read_record`."""
    table = read_log_table(log)
    record = read_record(path, table, gear_ratio=gear_ratio, nominal=nominal)
    gearing, element, ratio = record.statistics.gearing, None, None
    if len(record.positions) == 2:
        ratio = gear_ratio or (1.0 if table.kind == "element" else gearing and gearing.ratio)
    if table.kind == "element":
        element = fit_element(make_rig_log(record, ratio))
        reversals, judgements = 0 if element is None else element.reversals, _judge_element(element)
    else:
        speed = compute_velocity(record)
        reversals = _count_reversals(record, speed)
        judgements = _judge_rigid_drive(record, speed) | _judge_transmission(record, reversals, ratio)
    identifiability = tuple(Identifiability(quantity, *judgement) for quantity, judgement in judgements.items())
    return Inspection(record, table, ratio, reversals, identifiability, element)


def compute_twist(record: Record, gear_ratio: float | None) -> np.ndarray:
    """Return the twist of a transmission, rad (m), shape (samples,); of an element on a test rig its displacement.

    It is the position of one side, less `gear_ratio` times that of the other side if it was recorded.
    """
    motor, load = record.positions["motor"], record.positions.get("load")
    return motor if load is None else motor - (gear_ratio or 1.0) * load


def make_rig_log(record: Record, gear_ratio: float | None) -> RigLog:
    """Return displacement and torque of an element; the noise is that of its readings with their resolution."""
    assert record.torque is not None
    channels, displacement = record.statistics.channels, compute_twist(record, gear_ratio)
    noise, unit = twist_noise(gear_ratio or 1.0, channels), channels["theta_e"].unit
    return RigLog(displacement, record.torque, record.segments, record.sample_period, noise, unit)


_ELEMENT_NUMBERS = {"stiffness": "stiffness", "gap": "half_gap", "slip": "slip"} | SIZE_NAMES
"""Quantity of an element -> name of its number."""


def _judge_element(element: Element | None) -> _Judgements:
    if element is None:
        reason = "the displacement never turns back, or hardly moves: load it to and fro, through the gap"
        return dict.fromkeys(_ELEMENT_NUMBERS, ("no", reason))
    reason = "does not predict the torque better on parts of the log that are left out"
    judgements: _Judgements = dict.fromkeys(_ELEMENT_NUMBERS, ("no", reason))
    for quantity, key in _ELEMENT_NUMBERS.items():
        if (number := element.numbers.get(key)) is not None:
            low, high = number.ends()
            answer = "weak" if key in element.open else "yes"
            judgements[quantity] = answer, f"{key} = {number}, 95 %: {low:.4g} to {high:.4g}"
    return judgements


def main_side(record: Record) -> str:
    """Return the side whose encoder shows the motion: motor, or load if the motor has none."""
    return "motor" if "motor" in record.positions else "load"


def compute_velocity(record: Record, side: str | None = None) -> np.ndarray:
    """Differentiate the low-passed position of a side, by default the main one; rad/s (m/s), shape (samples,)."""
    return _compute_motion(record, side or main_side(record))[1]


def _compute_motion(record: Record, side: str) -> np.ndarray:
    """Return the low-passed position of a side, its velocity and acceleration, shape (3, samples)."""
    cutoff = _choose_cutoff(record, POSITION_CHANNELS[side])
    places = [record.positions[side][segment] for segment in record.segments]
    return np.concatenate([low_pass_motion(place, cutoff, record.sample_period) for place in places], axis=1)


def _choose_cutoff(record: Record, channel: str) -> float:
    """Choose the cutoff of a low-pass, Hz, that keeps the motion of an encoder; infinite if that is hidden by noise."""
    return 4.0 * record.statistics.channels[channel].bandwidth or math.inf


def _is_moving(speed: np.ndarray) -> np.ndarray:
    return np.abs(speed) > 0.1 * rms(speed)


def _count_reversals(record: Record, speed: np.ndarray) -> int:
    moving = _is_moving(speed)
    return sum(int(np.count_nonzero(np.diff(np.sign(speed[s][moving[s]])))) for s in record.segments)


_INSEPARABLE = 10.0
"""Variance inflation factor from which on a term is hardly told from others: nine tenths of it are in them."""


def _judge_rigid_drive(record: Record, speed: np.ndarray) -> _Judgements:
    names = ("inertia", "viscous friction", "Coulomb friction", "constant torque")
    torque, gearing = record.torque, record.statistics.gearing
    if torque is None:
        return dict.fromkeys(names, ("no", "no torque was recorded: the log shows kinematics only"))
    if np.ptp(torque) == 0.0:
        reason = "the input is constant: free motion gives only ratios to the inertia (or to a known gravity torque)"
        return dict.fromkeys(names, ("weak", reason))
    if record.statistics.dynamics is None:
        return dict.fromkeys(names, _HIDDEN)
    share, judgements = _minor_share(speed), _Judgements()
    if gearing is None or not gearing.is_loose:
        judgements |= _judge_motion(record, record.statistics.dynamics, main_side(record))
    else:
        # the torque moves both sides, whatever lies between them
        for side in POSITION_CHANNELS:
            motion = _judge_motion(record, _fit_side(record, side), side)
            judgements |= {f"{side} {name}": judgement for name, judgement in motion.items()}
    judgements["constant torque"] = "yes", f"motion in both directions ({100 * share:.0f} % in the less frequent one)"
    if share < _ONE_WAY:
        judgements["constant torque"] = "weak", f"{_ONE_DIRECTION} Coulomb friction"
    return judgements


_HIDDEN: _Judgement = "no", "the motion does not exceed the noise"


def _fit_side(record: Record, side: str) -> RigidFit | None:
    """Fit the torque to the motion of a side, that of the other one beside it."""
    assert record.torque is not None
    (other,) = record.positions.keys() - {side}
    return fit_rigid_drive(
        record.torque, record.positions[side], record.segments, record.sample_period, record.positions[other]
    )


_ONE_WAY, _ONE_DIRECTION = 0.05, "motion in one direction only: hard to separate from"
"""Share of the motion in the less frequent direction that is too little, and what is said then."""


def _minor_share(speed: np.ndarray) -> float:
    moving = speed[_is_moving(speed)]
    return float(min((moving > 0).mean(), (moving < 0).mean()))


def _judge_motion(record: Record, rigid_fit: RigidFit | None, side: str) -> _Judgements:
    """Judge inertia and frictions by a fit of the torque to the motion of a side."""
    if rigid_fit is None:
        return dict.fromkeys(("inertia", "viscous friction", "Coulomb friction"), _HIDDEN)
    speed = compute_velocity(record, side)
    slow, fast = np.quantile(np.abs(speed[_is_moving(speed)]), [0.05, 0.95])
    width = record.statistics.channels[POSITION_CHANNELS[side]].bandwidth
    speeds = f"speeds of {slow:.3g} to {fast:.3g}"
    evidence_and_similar_term = {
        "inertia": (f"motion up to {width:.3g} Hz", "a spring or gravity"),
        "viscous friction": (speeds, "Coulomb friction"),
        "Coulomb friction": (f"{_count_reversals(record, speed)} reversals", "viscous friction"),
    }
    judgements = _Judgements()
    terms = zip(rigid_fit.values, rigid_fit.errors, rigid_fit.inflation, rigid_fit.shares, strict=True)
    for (name, (evidence, similar_term)), term in zip(evidence_and_similar_term.items(), terms, strict=False):
        value, error, inflation, share = term
        percent, weakness = f"{100 * share:.0f} % of the torque", ""
        if inflation > _INSEPARABLE:
            weakness = f"hard to separate from {similar_term} here (variance × {inflation:.0f})"
        elif share < 0.05:
            weakness = f"it makes only {percent}"
        elif value < 2.0 * error:
            weakness = f"a rough fit finds no positive value ({percent}): other effects hide it"
        elif error > 0.2 * abs(value):
            weakness = f"a rough fit finds it only to ± {100 * error / value:.0f} % ({percent})"
        judgements[name] = ("weak" if weakness else "yes"), weakness or f"{evidence}: {percent}"
    if _minor_share(speed) < _ONE_WAY:
        judgements["Coulomb friction"] = "weak", f"{_ONE_DIRECTION} a constant torque"
    if fast < 1.5 * slow:
        reason = f"{speeds} are too close to separate viscous from Coulomb friction"
        judgements |= dict.fromkeys(("viscous friction", "Coulomb friction"), ("weak", reason))
    return judgements


def _judge_transmission(record: Record, reversals: int, ratio: float | None) -> _Judgements:
    names = ("gear ratio", "lost motion", "stiffness")
    gearing = record.statistics.gearing
    if len(record.positions) < 2:
        missing_side = "load" if "motor" in record.positions else "motor"
        reason = f"there is no {missing_side} encoder: the transmission in between is not observed"
        judgements: _Judgements = dict.fromkeys(names, ("no", reason))
        if missing_side == "load" and record.torque is not None and reversals >= 2:
            advice = "jaxbl identify with a model of two inertias tries to find it from the motor's encoder alone"
            judgements |= dict.fromkeys(names[1:], ("weak", advice))
        return judgements
    if gearing is None or ratio is None:
        return dict.fromkeys(names, _HIDDEN)
    remark = f"{percent(gearing.residual)} of theta_e is not explained"
    if gearing.is_loose:
        share = min(gearing.twist, gearing.least_twist) / gearing.motion
        remark = f"gap and wind-up take {100 * share:.0f} % of the range of theta_e"
    noise = twist_noise(ratio, record.statistics.channels)
    answer = "yes" if gearing.residual < 0.05 and not gearing.is_loose else "weak"
    return {
        "gear ratio": (answer, f"{gearing.ratio:.5g} ± {gearing.ratio_error:.1g}; {remark}"),
        "lost motion": _judge_lost_motion(record, gearing, reversals, ratio, noise),
        "stiffness": _judge_stiffness(record, ratio, noise),
    }


def _judge_lost_motion(record: Record, gearing: Gearing, reversals: int, ratio: float, noise: float) -> _Judgement:
    unit = record.statistics.channels["theta_e"].unit
    size = gearing.describe_lost_motion(unit)
    if gearing.flank == "load":
        return "yes", f"theta_e shifts by {size} as the load torque changes its sign"
    if reversals < 2:
        return "no", f"{reversals} reversals: both flanks of the gap must come into contact"
    if gearing.is_loose:
        if (half := _find_loose_gap(record, ratio)) > max(noise, _BLURRED * gearing.twist):
            return "yes", f"the torque in the gear over the twist shows a half gap of about {half:.2g} {unit}"
        return "weak", f"shift of {size} includes the wind-up, which this motion does not separate"
    if gearing.exceeds_noise(noise):
        return "yes", f"theta_e shifts by {size} from flank to flank"
    return "weak", f"shift of theta_e from flank to flank is {size}, noise {noise:.2g} {unit}"


_BLURRED = 0.01
"""Half gap over the range of the twist that low-passed corners may make where there is none."""


def _find_loose_gap(record: Record, ratio: float) -> float:
    """Roughly find the half gap, rad (m), from the twist and what the motor's own inertia and friction leave of the torque;
    0 where these show none."""
    torque = record.torque
    fit = None if torque is None else _fit_side(record, "motor")
    if torque is None or fit is None or fit.inflation[0] > _INSEPARABLE:
        return 0.0
    _, velocity, acceleration = _compute_motion(record, "motor")
    through = torque - fit.values[:3] @ np.stack([acceleration, velocity, smooth_sign(velocity)])
    gear = fit_element(make_rig_log(record, ratio)._replace(torque=through))
    return (
        0.0 if gear is None or "half_gap" in gear.open or "gap" not in gear.model.terms else gear.numbers["half_gap"].value
    )


def _judge_stiffness(record: Record, ratio: float, noise: float) -> _Judgement:
    """Judge the stiffness by twist over torque within one direction of motion; `noise` is that of the twist, rms."""
    if record.transmitted is None and (record.torque is None or np.ptp(record.torque) == 0.0):
        return "no", "no varying torque was recorded"
    if record.statistics.channels["theta_e"].bandwidth == 0.0:
        return _HIDDEN
    slope, error, spread = fit_twist(record, ratio)
    if not np.isfinite(slope):
        return "weak", "the log is too short to see how the twist follows the torque"
    windup = abs(slope) * spread
    unit = record.statistics.channels["theta_e"].unit
    if slope < 5.0 * error or windup < noise:
        return "weak", f"the twist hardly follows the torque (it winds up {windup:.2g} {unit} rms)"
    return "yes", f"the twist follows the torque: {windup:.2g} {unit} rms against a noise of {noise:.2g}"


def fit_twist(record: Record, ratio: float) -> tuple[float, float, float]:
    """Fit the twist at the motor to the measured torque, direction and speed.

    Returns:
        Twist a torque, rad / N m (m / N), its standard error, and the rms of the torque about its mean.
    """
    torque = record.torque if record.transmitted is None else record.transmitted
    assert torque is not None
    twist, speed = compute_twist(record, ratio), compute_velocity(record)
    cutoff = _choose_cutoff(record, "theta_e")
    signals = np.stack([twist, torque, np.sign(speed), speed, np.ones(len(twist))], axis=1)
    smooth = np.concatenate([low_pass(signals[segment], cutoff, record.sample_period) for segment in record.segments])
    slopes, errors = fit_with_jackknife(smooth[:, 0], smooth[:, 1:])
    return float(slopes[0]), float(errors[0]), float(np.std(torque))
