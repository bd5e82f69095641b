"""Whether a log fits what is said of it: motion at all, gear ratio, sign of the torque; and remarks on what is odd."""

import itertools
import math
from collections.abc import Iterator, Mapping

import numpy as np

from .alignment import NominalDrive
from .channels import RawChannel
from .files import LogFile
from .gearing import UNRELATED, Gearing, twist_noise
from .resampling import Grid
from .rigid_body import RigidFit
from .signal_quality import ChannelStatistics, find_resolution
from .table import POSITION_CHANNELS, LogTable
from .time_stamps import SegmentedStamps


def check_motion(file: LogFile, name: str, values: np.ndarray) -> None:
    """Refuse a position that moves by three steps of its resolution or less."""
    step = find_resolution(values)
    if step and np.ptp(values) < 3.5 * step:
        raise file.error(
            f"{name} moves by only {round(np.ptp(values) / step)} steps of its resolution {step:.3g}; a log of a drive in "
            "motion is needed"
        )


def check_distinct(file: LogFile, channels: Mapping[str, RawChannel]) -> None:
    """Refuse a position that is another channel's readings over again."""
    for (name, one), (other, two) in itertools.combinations(channels.items(), 2):
        if not {name, other} & set(POSITION_CHANNELS.values()):
            continue
        if np.array_equal(one.values, two.values, equal_nan=True) and np.any(one.values):
            raise file.error(f"{name} and {other} are the same in every row; each needs a column of its own")


_STANDSTILL_SAMPLES = 20
"""Equal readings in a row from which an encoder stands still: fewer are its resolution, or a reversal."""


def note_standing(file: LogFile, segmented: SegmentedStamps, channels: Mapping[str, RawChannel]) -> None:
    """Remark on an encoder that stands exactly still while the other one moves by a fifth of its range."""
    for name, other in (("theta_e", "theta_s"), ("theta_s", "theta_e")):
        values, moving = channels[name].values, channels[other].values
        # what its resolution hides is no standing
        hidden = 2.0 * find_resolution(values) * np.ptp(moving) / np.ptp(values)
        stays = (stay for part in segmented.segments for stay in _find_standstills(values, part))
        stay = next((one for one in stays if np.ptp(moving[one]) > max(0.2 * np.ptp(moving), hidden)), None)
        if stay is None:
            continue
        begin, end = segmented.times[stay][[0, -1]]
        extreme = values[stay.start] in (values.min(), values.max())
        stands = f"{name} stands still{' at the end of its range' * extreme} from {begin:.4g} to {end:.4g} s"
        moves = f"{other} moves by {np.ptp(moving[stay]):.3g} {channels[other].unit}"
        file.notes.append(f"{stands} while {moves}: readings that are frozen or cut off, or a side that does not follow.")


def _find_standstills(values: np.ndarray, part: slice) -> Iterator[slice]:
    """Where values of a part are equal for long."""
    ends = np.flatnonzero(np.diff(values[part], prepend=np.nan, append=np.nan) != 0.0) + part.start
    yield from (slice(a, b) for a, b in itertools.pairwise(ends.tolist()) if b - a >= _STANDSTILL_SAMPLES)


def check_gear_ratio(
    file: LogFile, table: LogTable, grid: Grid, found: Gearing | None, expected: float | None, tolerance: float, unit: str
) -> None:
    """Compare the ratio of both motions with the gear ratio that is expected, if it is known; `unit` is that of theta_e.

    Up to a relative deviation of `tolerance` the file gets a remark. Beyond, InputError names the most likely mistake.
    """
    if expected is not None and (found is None or found.is_loose or found.residual >= UNRELATED):
        _check_size(file, table, grid, expected)
    if found is None or found.residual >= UNRELATED:
        left = "" if found is None else f" ({100 * found.residual:.0f} % of theta_e is not explained by theta_s)"
        file.notes.append(
            f"theta_e and theta_s are hardly related{left}: they may not belong to one drive, or the load hardly moves "
            "beyond the lost motion."
        )
    elif expected is not None and found.is_loose:
        _check_twist(file, unit, found, expected)
    elif expected is not None:
        _check_ratio(file, table, found, expected, tolerance)


def _check_ratio(file: LogFile, table: LogTable, found: Gearing, expected: float, tolerance: float) -> None:
    relative = found.ratio / expected
    # 2 %: backlash and elasticity change the ratio of a short motion by as much
    uncertain = max(0.02, 3.0 * found.residual, 5.0 * found.ratio_error / abs(expected))
    if abs(relative - 1.0) <= uncertain:
        return
    guess, why = min(_likely_mistakes(table, expected), key=lambda pair: abs(relative / pair[0] - 1.0))
    if abs(relative / guess - 1.0) > uncertain:
        why = "gear_ratio, or a unit in [log], is wrong"
    moves = f"theta_e moves {found.ratio:.4g} for each 1 of theta_s, where gear_ratio is {expected:g}"
    if abs(relative - 1.0) <= tolerance:
        file.notes.append(f"{moves}: effects that the model leaves out may cause this, or gear_ratio is a little wrong.")
        return
    if found.residual < 0.05:
        raise file.error(f"{moves}: {why}")
    file.notes.append(f"{moves}, but the two are related only roughly; perhaps {why}.")


def _likely_mistakes(table: LogTable, expected: float) -> list[tuple[float, str]]:
    """Usual mistakes: the factor that each puts on the ratio of both motions, and what is wrong then."""
    (motor, motor_table), (load, load_table) = table.position_source("theta_e"), table.position_source("theta_s")
    degrees, see = 180.0 / math.pi, "; see unit in [log]"
    motor_text = f"{motor} is not in degrees" if motor_table.unit.startswith("deg") else f"{load} is in degrees"
    load_text = f"{load} is not in degrees" if load_table.unit.startswith("deg") else f"{motor} is in degrees"
    return [
        (-1.0, f"the sign of one of them is wrong; set sign = -1 in [log] {motor} or {load}"),
        (1.0 / expected**2, f"the sides are swapped; exchange the columns in [log] {motor} and {load}"),
        (-1.0 / expected**2, f"the sides are swapped, and one has the wrong sign; see [log] {motor} and {load}"),
        (degrees, load_text + see),
        (1.0 / degrees, motor_text + see),
        (1.0 / expected, f"theta_s is already referred to the motor shaft; set factor = 1 / gear_ratio in [log] {load}"),
    ]


def _check_size(file: LogFile, table: LogTable, grid: Grid, expected: float) -> None:
    """Refuse motions of sizes so different that wrong units or swapped sides explain them better than any gap."""
    motor, load = grid.values["theta_e"], grid.values["theta_s"]

    def relative_twist(ratio: float) -> float:
        """Rms of the twist over that of the motion: far below 1 where load and motor move together."""
        moved = max(float(np.std(motor)), abs(ratio) * float(np.std(load)))
        return float(np.std(motor - ratio * load)) / moved if moved else 0.0

    if relative_twist(expected) < 0.8:
        return
    # load and motor may well move against each other, beyond a resonance or in a gap: no mistake of sign is meant here
    least, why = min(
        (relative_twist(expected * factor), why) for factor, why in _likely_mistakes(table, expected) if factor > 0.0
    )
    if least < 0.7:
        size = float(np.std(motor)) / (abs(expected) * float(np.std(load)))
        raise file.error(f"theta_e moves {size:.3g} times as far as gear_ratio {expected:g} times theta_s: {why}")


def _check_twist(file: LogFile, unit: str, found: Gearing, expected: float) -> None:
    """Where the twist is as large as the motion, so that the log fits many ratios: refuse a twist beyond the motion."""
    ranges = f"theta_e - {expected:g} theta_s ranges over {found.twist:.3g} {unit}, theta_e over {found.motion:.3g} {unit}"
    # a load that a motor moves through a gap moves no farther than the motor
    if found.twist > max(3.0 * found.least_twist, 1.5 * found.motion):
        raise file.error(
            f"{ranges}: gear_ratio, or a unit in [log], is wrong (with {found.ratio:.3g} in place of {expected:g} it "
            f"would be {found.least_twist:.3g} {unit})"
        )
    against = " They mostly move in opposite directions: perhaps the sign of one of them is wrong."
    file.notes.append(
        f"{ranges}: with backlash or wind-up of that size this log hardly confirms gear_ratio."
        + (against if found.ratio * expected < 0.0 else "")
    )


_MAX_RETURNED_WORK = -0.5
"""Work put in, over that which torque and motion exchange, below which no model of a drive can follow."""


def check_torque(file: LogFile, found: RigidFit, grid: Grid, position: np.ndarray) -> None:
    """Refuse a torque of the wrong sign, or remark on it: a passive drive takes energy from its input; inertia is positive.

    `position` is what the torque, `u` of the grid, moves.
    """
    work = total = travel = away = 0.0
    for s in grid.segments:
        torque, steps = grid.values["u"][s][:-1], np.diff(position[s])
        work += float(torque @ steps)
        total += float(np.abs(torque) @ np.abs(steps))
        travel += float(np.abs(steps).sum())
        away += abs(float(position[s][-1] - position[s][0]))
    share = work / total if total else 0.0
    heavy = found.inflation[0] < 10.0 and found.shares[0] > 0.1
    # the wrong sign has to be sure; that it is the right one need only be likely
    backwards, forwards = (
        heavy and sign * found.values[0] > least * found.errors[0] for sign, least in ((-1.0, 8.0), (1.0, 3.0))
    )
    if away > 0.2 * travel:
        # potential energy may pay for the motion
        share = max(share, 0.0)
    if backwards and share < 0.02:
        raise file.error(
            "the torque has the wrong sign: the drive accelerates against it"
            + (f" and returns {-100 * share:.0f} % of the work" if share < -0.02 else "")
            + "; set sign = -1 in [log] u"
        )
    # a driven load returns work as well: no error
    if share < -0.1:
        text = f"the drive returns {-100 * share:.0f} % of the work"
        file.warnings.append(f"Doubtful: {text}: the load drives it, or u has the wrong sign or acts late.")
        # a lag turns the torque of an inertia against the speed; a wrong sign turns it against the acceleration, too
        if share < _MAX_RETURNED_WORK and not forwards:
            file.contradiction = (
                f"{text}, which only a drive does that its load drives: set sign = -1 in [log] u, or take a log in which "
                "the motor drives"
            )
    elif backwards and share < 0.1:
        file.notes.append("The drive seems to accelerate against u: see its sign, unit and column.")


_FAR = 10.0
"""Factor between an inertia and its nominal value from which on a unit is rather wrong: data sheets and CAD know it within a
factor of two."""

_SURE = 30.0
"""Factor from which on it is no longer a rough number: units in place of others make 57 (degrees), 60 or 1000 of it."""
_SURE_FAST = 100.0
"""The same of a motion faster than the antiresonance of the nominal drive: the load stands still there, and of a resonance
the input has to supply only the losses."""
_FAR_TORQUE = 1000.0
"""Factor between the torque and what the nominal inertia needs from which on a unit is rather wrong: mN m for N m. A screw
that turns slowly against dry friction needs six hundred times the torque of its inertia."""


_FAR_WORK = 100.0
"""Factor between the work that friction takes and that of the nominal viscous friction from which on a unit is rather wrong.
Dry friction that a model lacks takes ten times as much; that a drive takes a tenth is seen only in wrong units."""


def check_units(file: LogFile, found: RigidFit, channel: str, nominal: NominalDrive) -> None:
    """Say first that inertia, torque or friction are far from the nominal ones, as a wrong unit makes them.

    Where they are so far that no fit is worth its time, `file.contradiction` says so. Friction takes the work
    <u ω> + J <ω² lost a second> / 2, against f <ω²> of the model: neither noise nor a gap nor a shaft changes that. A model
    without friction says nothing of it.
    """
    expected = nominal.inertia(channel)
    value, error = float(found.values[0]), float(found.errors[0])
    normal = nominal.viscous(channel) * found.square
    taken = found.power + 0.5 * expected * found.slowing
    work = taken / normal if normal > 0.0 and taken > 0.0 else None
    usual = work is not None and 1.0 / _FAR < work < _FAR_WORK
    least = _SURE_FAST if _is_fast(found, nominal) else _SURE
    text, doubtful, surely, ratio = "", False, False, 1.0
    # a coefficient that noise, gravity, a gap or a spring hides says nothing
    if value > 4.0 * error and found.shares[0] > 0.05 and found.inflation[0] < 10.0 and found.residual < 0.5:
        ratio = value / expected
        text = f"u moves {channel} as an inertia of {value:.3g} would, {ratio:.3g} times the nominal {expected:.3g}"
        doubtful, surely = not 1.0 / _FAR < ratio < _FAR, not (usual or 1.0 / least < ratio < _SURE)
    elif value:
        ratio = found.torque / (expected * found.acceleration)
        text = (
            f"u is {found.torque:.3g} rms, {ratio:.3g} times what the nominal inertia {expected:.3g} needs for this motion"
        )
        doubtful = not 1.0 / _FAR < ratio < _FAR_TORQUE
        surely = not (usual or 1.0 / least < ratio < _SURE * _FAR_TORQUE)
    if work is not None and not usual and not doubtful:
        text = f"friction takes {taken:.3g} W, {work:.3g} times what the nominal viscous friction would"
        # a data sheet may say a friction that the machine does not have
        doubtful, surely, ratio = True, False, 1.0 / work
    if doubtful:
        file.warnings.append(f"Doubtful: {text}: check the units of t, u and {channel} in [log], and the model.")
    # two of them that are off in the same direction are no chance
    alike = work is not None and not usual and (work > 1.0) == (ratio > 1.0)
    against, about = float(found.values[1]), nominal.viscous(channel)
    if against < -8.0 * float(found.errors[1]) and found.inflation[1] < 10.0 and -3.0 * about < against < -about / 3.0:
        file.contradiction = (
            f"u falls with the speed as a viscous friction of {against:.3g} would make it, the model's is {about:.3g}: set "
            "sign = -1 in [log] u"
        )
    if doubtful and (surely or alike):
        file.contradiction = f"{text}: a unit of t, u or {channel} in [log] is wrong, or the model's number is"


def _is_fast(found: RigidFit, nominal: NominalDrive) -> bool:
    """Whether the motion is faster than that at which the load stands still on its spring, by the nominal drive."""
    load = nominal.load_inertia / nominal.gear_ratio**2
    # of a rigid drive, or a load that is not known, there is no such motion
    if not (load > 0.0 and found.square > 0.0 and math.isfinite(nominal.stiffness)):
        return False
    return found.acceleration**2 / found.square > nominal.stiffness / load


# remarks


def note_channel(file: LogFile, name: str, figures: ChannelStatistics, fastest: float) -> None:
    """Remark on jumps, saturation and improbable speeds of a channel; `fastest` is its rate of change, unit/s."""
    if figures.jumps:
        file.notes.append(
            f"{name}: {figures.jumps} jump{'s' * (figures.jumps > 1)} that the motion does not explain: "
            "dropped counts or disturbed readings."
        )
    if figures.saturated:
        file.notes.append(f"{name} is saturated in {100 * figures.saturated:.2g} % of the samples.")
    # 1e4 rad/s, about 100 000 rpm, is beyond drives
    if figures.unit == "rad" and fastest > 1e4:
        rpm = fastest * 30.0 / math.pi
        file.warnings.append(f"Doubtful: {name} reaches {fastest:.3g} rad/s, {rpm:.3g} rpm: check its unit, and that of t.")


def note_skew(file: LogFile, found: Gearing, period: float) -> None:
    """Remark on a skew between both encoders that is significant and no tiny part of the period, s."""
    if found.skew is None or found.skew_error is None:
        return
    if abs(found.skew) > 6.0 * found.skew_error and abs(found.skew) > 0.05 * period:
        how = "lags" if found.skew > 0.0 else "leads"
        file.notes.append(
            f"theta_s {how} theta_e by {1e3 * abs(found.skew):.3g} ± {1e3 * found.skew_error:.2g} ms: a skew of the stamps, "
            "or viscous friction of the load that winds up the shaft; this log cannot tell them apart."
        )


def note_lost_motion(file: LogFile, found: Gearing, figures: dict[str, ChannelStatistics]) -> None:
    """Remark on the lost motion where it stands out of the noise of both encoders."""
    unit = figures["theta_e"].unit
    text = f"Lost motion at the motor: {found.describe_lost_motion(unit)}"
    if found.flank == "load":
        times = ", ".join(f"{t:.3g}" for t in found.flank_times[:6]) + (", ..." if len(found.flank_times) > 6 else "")
        low, high = found.lost_motion_range
        one = " With one change only, a slipped coupling or lost counts would look the same."
        file.notes.append(
            f"{text}, from positions passed in the same direction before and after the load torque changed its sign, at "
            f"{times} s; {low:.2g} to {high:.2g} {unit} by position." + (one if len(found.flank_times) == 1 else "")
        )
    elif found.exceeds_noise(twist_noise(found.ratio, figures["theta_e"], figures["theta_s"])) and not found.is_loose:
        file.notes.append(f"{text}, from {found.flank_changes} changes of the flank by the direction of motion.")
