"""Inspect a measured log: judge which quantities it can identify, before anything is fitted to it."""

import math
from collections.abc import Iterable, Mapping
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
        """theta_e - gear_ratio theta_s about its median, rad (m), shape (samples,); None with one encoder."""
        if self.gear_ratio is None or len(self.record.positions) < 2:
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
            "segments": [[float(record.time[s][0]), float(record.time[s][-1])] for s in record.segments],
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
    has_both_sides, gearing = len(record.positions) == 2, record.statistics.gearing
    if table.kind == "element":
        ratio = gear_ratio or 1.0 if has_both_sides else None
        element = fit_record_element(record, ratio)
        reversals = 0 if element is None else element.reversals
        return Inspection(record, table, ratio, reversals, tuple(_judge_element(element)), element)
    ratio = gear_ratio if gearing is None or gear_ratio is not None else gearing.ratio
    if not has_both_sides:
        ratio = None
    speed = compute_velocity(record)
    reversals = _count_reversals(record, speed)
    judgements = _judge_rigid_drive(record, speed) + _judge_transmission(record, speed, reversals, ratio)
    return Inspection(record, table, ratio, reversals, tuple(judgements))


def compute_twist(record: Record, gear_ratio: float | None) -> np.ndarray:
    """Return the twist of a transmission, rad (m), shape (samples,); of an element on a test rig its displacement.

    It is the position of one side, less `gear_ratio` times that of the other side if it was recorded.
    """
    motor, load = record.positions["motor"], record.positions.get("load")
    return motor if load is None else motor - (gear_ratio or 1.0) * load


def fit_record_element(record: Record, gear_ratio: float | None) -> Element | None:
    """Fit a transmission on a test rig to its log; None if the log does not show one."""
    return fit_element(make_rig_log(record, gear_ratio), linear=record.statistics.channels["theta_e"].unit == "m")


def make_rig_log(record: Record, gear_ratio: float | None) -> RigLog:
    """Return displacement and torque of an element; the noise is that of its readings with their resolution."""
    assert record.torque is not None
    statistics = record.statistics.channels
    noise = twist_noise(gear_ratio or 1.0, statistics["theta_e"], statistics.get("theta_s"))
    displacement = compute_twist(record, gear_ratio)
    return RigLog(displacement, record.torque, record.segments, record.sample_period, noise)


_ELEMENT_NUMBERS = {"stiffness": "stiffness", "gap": "half_gap", "slip": "slip"} | SIZE_NAMES
"""Quantity of an element -> name of its number."""


def _judge_element(element: Element | None) -> list[Identifiability]:
    if element is None:
        reason = "the displacement never turns back, or hardly moves: load it to and fro, through the gap"
        return _judge_alike(_ELEMENT_NUMBERS, "no", reason)
    judgements = []
    for quantity, key in _ELEMENT_NUMBERS.items():
        answer: _Answer = "no"
        reason = "does not predict the torque better on parts of the log that are left out"
        if (number := element.numbers.get(key)) is not None:
            low, high = number.ends()
            answer, reason = "weak" if key in element.open else "yes", f"{key} = {number}, 95 %: {low:.4g} to {high:.4g}"
        judgements.append(Identifiability(quantity, answer, reason))
    return judgements


def main_side(record: Record) -> str:
    """Return the side whose encoder shows the motion: motor, or load if the motor has none."""
    return "motor" if "motor" in record.positions else "load"


def compute_velocity(record: Record, side: str | None = None) -> np.ndarray:
    """Differentiate the low-passed position of a side, by default the main one; rad/s (m/s), shape (samples,)."""
    side = side or main_side(record)
    cutoff = 4.0 * record.statistics.channels[POSITION_CHANNELS[side]].bandwidth or math.inf
    places = [record.positions[side][segment] for segment in record.segments]
    return np.concatenate([low_pass_motion(place, cutoff, record.sample_period)[1] for place in places])


def _is_moving(speed: np.ndarray) -> np.ndarray:
    return np.abs(speed) > 0.1 * rms(speed)


def _count_reversals(record: Record, speed: np.ndarray) -> int:
    moving = _is_moving(speed)
    return sum(int(np.count_nonzero(np.diff(np.sign(speed[s][moving[s]])))) for s in record.segments)


def _judge_alike(quantities: Iterable[str], answer: _Answer, reason: str) -> list[Identifiability]:
    return [Identifiability(quantity, answer, reason) for quantity in quantities]


_FRICTIONS = "viscous friction", "Coulomb friction"
_INSEPARABLE = 10.0
"""Variance inflation factor from which on a term is hardly told from others: nine tenths of it are in them."""


def _judge_rigid_drive(record: Record, speed: np.ndarray) -> list[Identifiability]:
    names = ("inertia", *_FRICTIONS, "constant torque")
    torque, gearing = record.torque, record.statistics.gearing
    if torque is None:
        return _judge_alike(names, "no", "no torque was recorded: the log shows kinematics only")
    if np.ptp(torque) == 0.0:
        reason = "the input is constant: free motion gives only ratios to the inertia (or to a known gravity torque)"
        return _judge_alike(names, "weak", reason)
    if record.statistics.dynamics is None:
        return _judge_alike(names, "no", "the motion does not exceed the noise")
    share = _minor_share(speed)
    constant = Identifiability(names[3], "yes", f"motion in both directions ({100 * share:.0f} % in the less frequent one)")
    if share < _ONE_WAY:
        constant = Identifiability(names[3], "weak", f"{_ONE_DIRECTION} {names[2]}")
    if gearing is None or not gearing.is_loose:
        return [*_judge_motion(record, record.statistics.dynamics, main_side(record)), constant]
    # the torque moves both sides, whatever lies between them
    fits = {side: _fit_side(record, side) for side in POSITION_CHANNELS}
    return [judgement for side, fit in fits.items() for judgement in _judge_motion(record, fit, side, f"{side} ")] + [
        constant
    ]


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


def _judge_motion(record: Record, rigid_fit: RigidFit | None, side: str, lead: str = "") -> list[Identifiability]:
    """Judge inertia and frictions by a fit of the torque to the motion of a side; `lead` begins their names."""
    inertia, viscous, coulomb = names = [f"{lead}{name}" for name in ("inertia", *_FRICTIONS)]
    if rigid_fit is None:
        return _judge_alike(names, "no", "the motion does not exceed the noise")
    speed = compute_velocity(record, side)
    slow, fast = np.quantile(np.abs(speed[_is_moving(speed)]), [0.05, 0.95])
    width = record.statistics.channels[POSITION_CHANNELS[side]].bandwidth

    def judge(name: str, i: int, evidence: str, similar_term: str) -> Identifiability:
        value, error, inflation, share = (
            float(x[i]) for x in (rigid_fit.values, rigid_fit.errors, rigid_fit.inflation, rigid_fit.shares)
        )
        percent, weakness = f"{100 * share:.0f} % of the torque", ""
        if inflation > _INSEPARABLE:
            weakness = f"hard to separate from {similar_term} here (variance × {inflation:.0f})"
        elif share < 0.05:
            weakness = f"it makes only {percent}"
        elif value < 2.0 * error:
            weakness = f"a rough fit finds no positive value ({percent}): other effects hide it"
        elif error > 0.2 * abs(value):
            weakness = f"a rough fit finds it only to ± {100 * error / value:.0f} % ({percent})"
        return Identifiability(name, "weak" if weakness else "yes", weakness or f"{evidence}: {percent}")

    speeds = f"speeds of {slow:.3g} to {fast:.3g}"
    judgements = [
        judge(inertia, 0, f"motion up to {width:.3g} Hz", "a spring or gravity"),
        judge(viscous, 1, speeds, _FRICTIONS[1]),
        judge(coulomb, 2, f"{_count_reversals(record, speed)} reversals", _FRICTIONS[0]),
    ]
    if _minor_share(speed) < _ONE_WAY:
        judgements[2] = Identifiability(coulomb, "weak", f"{_ONE_DIRECTION} a constant torque")
    if fast < 1.5 * slow:
        judgements[1:] = _judge_alike(names[1:], "weak", f"{speeds} are too close to separate viscous from Coulomb friction")
    return judgements


def _judge_transmission(record: Record, speed: np.ndarray, reversals: int, ratio: float | None) -> list[Identifiability]:
    names = ("gear ratio", "lost motion", "stiffness")
    gearing, channels = record.statistics.gearing, record.statistics.channels
    if len(record.positions) < 2:
        missing_side = "load" if "motor" in record.positions else "motor"
        reason = f"there is no {missing_side} encoder: the transmission in between is not observed"
        if missing_side == "load" and record.torque is not None and reversals >= 2:
            advice = "jaxbl identify with a model of two inertias tries to find it from the motor's encoder alone"
            return [Identifiability(names[0], "no", reason), *_judge_alike(names[1:], "weak", advice)]
        return _judge_alike(names, "no", reason)
    if gearing is None or ratio is None:
        return _judge_alike(names, "no", "the motion does not exceed the noise")
    share = min(gearing.twist, gearing.least_twist) / gearing.motion
    remark = f"{percent(gearing.residual)} of theta_e is not explained"
    if gearing.is_loose:
        remark = f"gap and wind-up take {100 * share:.0f} % of the range of theta_e"
    noise = twist_noise(ratio, channels["theta_e"], channels["theta_s"])
    answer = "yes" if gearing.residual < 0.05 and not gearing.is_loose else "weak"
    return [
        Identifiability("gear ratio", answer, f"{gearing.ratio:.5g} ± {gearing.ratio_error:.1g}; {remark}"),
        _judge_lost_motion(record, gearing, reversals, ratio, noise),
        Identifiability("stiffness", *_judge_stiffness(record, speed, ratio, noise)),
    ]


def _judge_lost_motion(record: Record, gearing: Gearing, reversals: int, ratio: float, noise: float) -> Identifiability:
    unit = record.statistics.channels["theta_e"].unit
    size = gearing.describe_lost_motion(unit)
    answer, reason = "weak", f"shift of theta_e from flank to flank is {size}, noise {noise:.2g} {unit}"
    if gearing.flank == "load":
        answer, reason = "yes", f"theta_e shifts by {size} as the load torque changes its sign"
    elif reversals < 2:
        answer, reason = "no", f"{reversals} reversals: both flanks of the gap must come into contact"
    elif gearing.is_loose and (half := _find_loose_gap(record, ratio)) > max(noise, _BLURRED * gearing.twist):
        answer, reason = "yes", f"the torque in the gear over the twist shows a half gap of about {half:.2g} {unit}"
    elif gearing.is_loose:
        reason = f"shift of {size} includes the wind-up, which this motion does not separate"
    elif gearing.exceeds_noise(noise):
        answer, reason = "yes", f"theta_e shifts by {size} from flank to flank"
    return Identifiability("lost motion", answer, reason)


_BLURRED = 0.01
"""Half gap over the range of the twist that low-passed corners may make where there is none."""


def _find_loose_gap(record: Record, ratio: float) -> float:
    """Roughly find the half gap, rad (m), from the twist and what the motor's own inertia and friction leave of the torque;
    0 where these show none."""
    torque, period = record.torque, record.sample_period
    fit = None if torque is None else _fit_side(record, "motor")
    if torque is None or fit is None or fit.inflation[0] > _INSEPARABLE:
        return 0.0
    cutoff = 4.0 * record.statistics.channels["theta_e"].bandwidth
    motion = [low_pass_motion(record.positions["motor"][segment], cutoff, period)[1:] for segment in record.segments]
    velocity, acceleration = np.concatenate(motion, axis=1)
    through = torque - fit.values[:3] @ np.stack([acceleration, velocity, smooth_sign(velocity)])
    gear = fit_element(make_rig_log(record, ratio)._replace(torque=through), linear=False)
    return (
        0.0 if gear is None or "half_gap" in gear.open or "gap" not in gear.model.terms else gear.numbers["half_gap"].value
    )


def _judge_stiffness(record: Record, speed: np.ndarray, ratio: float, noise: float) -> tuple[_Answer, str]:
    """Judge the stiffness by twist over torque within one direction of motion; `noise` is that of the twist, rms."""
    if record.transmitted is None and (record.torque is None or np.ptp(record.torque) == 0.0):
        return "no", "no varying torque was recorded"
    if record.statistics.channels["theta_e"].bandwidth == 0.0:
        return "no", "the motion does not exceed the noise"
    slope, error, spread = fit_twist(record, speed, ratio)
    if not np.isfinite(slope):
        return "weak", "the log is too short to see how the twist follows the torque"
    windup = abs(slope) * spread
    unit = record.statistics.channels["theta_e"].unit
    if slope < 5.0 * error or windup < noise:
        return "weak", f"the twist hardly follows the torque (it winds up {windup:.2g} {unit} rms)"
    return "yes", f"the twist follows the torque: {windup:.2g} {unit} rms against a noise of {noise:.2g}"


def fit_twist(record: Record, speed: np.ndarray, ratio: float) -> tuple[float, float, float]:
    """Fit the twist at the motor to the measured torque, direction and speed.

    Returns:
        Twist a torque, rad / N m (m / N), its standard error, and the rms of the torque about its mean.
    """
    torque = record.torque if record.transmitted is None else record.transmitted
    assert torque is not None
    twist = compute_twist(record, ratio)
    cutoff = 4.0 * record.statistics.channels["theta_e"].bandwidth or math.inf
    signals = np.stack([twist, torque, np.sign(speed), speed, np.ones(len(twist))], axis=1)
    smooth = np.concatenate([low_pass(signals[segment], cutoff, record.sample_period) for segment in record.segments])
    slopes, errors = fit_with_jackknife(smooth[:, 0], smooth[:, 1:])
    return float(slopes[0]), float(errors[0]), float(np.std(torque))
