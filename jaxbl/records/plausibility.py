"""Checks of a log against its study: motion, gear ratio, sign of the torque, units; and remarks on what is odd."""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from jaxbl.lines import DOUBT, percent

from .alignment import NominalDrive
from .channels import RawChannel
from .files import LogFile
from .gearing import UNRELATED, Gearing, twist_noise
from .least_squares import rms
from .resampling import Grid
from .rigid_body import RigidFit
from .signal_quality import ChannelStatistics, find_resolution, find_runs
from .table import POSITION_CHANNELS, LogTable
from .time_stamps import SegmentedStamps, fit_even_stamps


def check_position_moves(file: LogFile, name: str, values: np.ndarray) -> None:
    """Refuse a position that moves by at most three steps of its resolution."""
    step = find_resolution(values)
    if step and np.ptp(values) < 3.5 * step:
        raise file.error(
            f"{name} moves by only {round(np.ptp(values) / step)} steps of its resolution {step:.3g}; a log of a drive in "
            "motion is needed"
        )


def check_channels_differ(file: LogFile, channels: Mapping[str, RawChannel]) -> None:
    """Refuse two channels with the same readings, of which one is a position."""
    for (name, first), (other, second) in itertools.combinations(channels.items(), 2):
        has_position = {name, other} & {*POSITION_CHANNELS.values()}
        if has_position and np.array_equal(first.values, second.values, equal_nan=True) and np.any(first.values):
            raise file.error(f"{name} and {other} are the same in every row; each needs a column of its own")


_STANDSTILL_SAMPLES = 20
"""Equal readings in a row that count as a standstill: fewer are a matter of resolution, or a reversal."""


def note_standstill(file: LogFile, segmented: SegmentedStamps, channels: Mapping[str, RawChannel]) -> None:
    """Remark on an encoder that stands exactly still while the other one moves by more than a fifth of its range."""
    for name, other in (("theta_e", "theta_s"), ("theta_s", "theta_e")):
        values, moving = channels[name].values, channels[other].values
        # motion of the other side within two steps of the resolution is not a standstill
        hidden_motion = 2.0 * find_resolution(values) * np.ptp(moving) / np.ptp(values)
        least = max(0.2 * np.ptp(moving), hidden_motion)
        for standstill in _find_standstills(values, segmented.segments):
            if np.ptp(moving[standstill]) > least:
                begin, end = segmented.times[standstill][[0, -1]]
                is_extreme = values[standstill.start] in (values.min(), values.max())
                stands = f"{name} stands still{' at the end of its range' * is_extreme} from {begin:.4g} to {end:.4g} s"
                moves = f"{other} moves by {np.ptp(moving[standstill]):.3g} {channels[other].unit}"
                file.note(f"{stands} while {moves}: readings that are frozen or cut off, or a side that does not follow.")
                break


def _find_standstills(values: np.ndarray, segments: Sequence[slice]) -> Iterator[slice]:
    """Yield the rows of segments in which the values are equal for at least `_STANDSTILL_SAMPLES`."""
    for segment in segments:
        for start, stop in zip(*find_runs(np.diff(values[segment]) == 0.0), strict=True):
            if stop - start >= _STANDSTILL_SAMPLES - 1:
                yield slice(segment.start + start, segment.start + stop + 1)


GEAR_TOLERANCE = 0.25
"""A missing effect (a soft shaft, a gap) shifts the ratio of both motions, on a short log by a fifth."""


def check_gear_ratio(
    file: LogFile,
    table: LogTable,
    grid: Grid,
    gearing: Gearing | None,
    expected: float | None,
    unit: str,
    shaft: NominalDrive | None,
) -> None:
    """Compare the ratio of both motions with the expected gear ratio, if there is one.

    A ratio that is off by at most `GEAR_TOLERANCE` puts the log in doubt. `unit` is that of theta_e; `shaft` the drive, if
    its stiffness is known.

    Raises:
        InputError: the ratio is further off; the message names the most likely mistake.
    """
    if expected is not None and (gearing is None or gearing.is_loose or gearing.residual >= UNRELATED):
        _check_motion_sizes(file, table, grid, expected)
    if gearing is None or gearing.residual >= UNRELATED:
        unexplained = "" if gearing is None else f" ({100 * gearing.residual:.0f} % of theta_e is not explained by theta_s)"
        file.note(
            f"theta_e and theta_s are hardly related{unexplained}: they may belong to different drives, or the load hardly "
            "moves beyond the lost motion."
        )
    elif expected is not None and gearing.is_loose:
        _check_twist_range(file, unit, gearing, expected)
    elif expected is not None:
        windup = 0.0 if shaft is None else _largest_windup(grid, shaft)
        _check_ratio(file, table, gearing, expected, windup)


_SLOW_SAMPLES = 10
"""Samples over which the load's velocity is measured: noise counts for little, and motion is slow."""


def _largest_windup(grid: Grid, shaft: NominalDrive) -> float:
    """Return the share of its motion by which the load's inertia may wind the shaft up."""
    load = grid.values["theta_s"]
    velocity = (load[_SLOW_SAMPLES:] - load[:-_SLOW_SAMPLES]) / (_SLOW_SAMPLES * grid.period)
    # inertia and stiffness of a rough fit may both be off by half
    return 3.0 * shaft.load_inertia * velocity.var() / load.var() / (shaft.gear_ratio**2 * shaft.stiffness)


def _check_ratio(file: LogFile, table: LogTable, gearing: Gearing, expected: float, windup: float) -> None:
    relative_ratio = gearing.ratio / expected
    # 2 %: backlash and elasticity change the ratio of a short motion by as much
    tolerated = max(0.02, min(windup, GEAR_TOLERANCE), 3.0 * gearing.residual, 5.0 * gearing.ratio_error / abs(expected))
    if abs(relative_ratio - 1.0) <= tolerated:
        return
    likely_factor, mistake = min(_likely_mistakes(table, expected), key=lambda pair: abs(relative_ratio / pair[0] - 1.0))
    if abs(relative_ratio / likely_factor - 1.0) > tolerated:
        mistake = "gear_ratio, or a unit in [log], is wrong"
    comparison = f"theta_e moves {gearing.ratio:.4g} for each 1 of theta_s, where gear_ratio is {expected:g}"
    if abs(relative_ratio - 1.0) <= GEAR_TOLERANCE:
        file.warn(f"{DOUBT}{comparison}: wind-up of a soft shaft may cause this, or gear_ratio is a little wrong.")
        return
    if gearing.residual < 0.05:
        raise file.error(f"{comparison}: {mistake}")
    file.note(f"{comparison}, but the two are related only roughly; perhaps {mistake}.")


def _likely_mistakes(table: LogTable, expected: float) -> list[tuple[float, str]]:
    """Return the usual mistakes: the factor by which each changes the ratio of both motions, and a sentence on it."""
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


def _check_motion_sizes(file: LogFile, table: LogTable, grid: Grid, expected: float) -> None:
    """Refuse a log if wrong units or swapped sides explain the sizes of both motions better than a gap does."""
    motor, load = grid.values["theta_e"], grid.values["theta_s"]

    def relative_twist(ratio: float) -> float:
        """Return the rms twist over the rms motion: far below 1 if load and motor move together."""
        moved = max(np.std(motor), abs(ratio) * np.std(load))
        return float(np.std(motor - ratio * load) / moved) if moved else 0.0

    if relative_twist(expected) < 0.8:
        return
    # load and motor may well move against each other, beyond a resonance or in a gap: no mistake of sign is meant here
    smallest_twist, mistake = min(
        (relative_twist(expected * factor), mistake) for factor, mistake in _likely_mistakes(table, expected) if factor > 0.0
    )
    if smallest_twist < 0.7:
        relative_motion = np.std(motor) / (abs(expected) * np.std(load))
        raise file.error(
            f"theta_e moves {relative_motion:.3g} times as far as gear_ratio {expected:g} times theta_s: {mistake}"
        )


def _check_twist_range(file: LogFile, unit: str, gearing: Gearing, expected: float) -> None:
    """Refuse a twist larger than the motion; remark on any other, as a loose load hardly shows the gear ratio."""
    ranges = (
        f"theta_e - {expected:g} theta_s ranges over {gearing.twist:.3g} {unit}, theta_e over {gearing.motion:.3g} {unit}"
    )
    # a load that a motor moves through a gap moves no farther than the motor
    if gearing.twist > max(3.0 * gearing.least_twist, 1.5 * gearing.motion):
        raise file.error(
            f"{ranges}: gear_ratio, or a unit in [log], is wrong (with {gearing.ratio:.3g} in place of {expected:g} it "
            f"would be {gearing.least_twist:.3g} {unit})"
        )
    opposite_sign = " They mostly move in opposite directions: perhaps the sign of one of them is wrong."
    file.note(
        f"{ranges}: with backlash or wind-up of that size this log hardly confirms gear_ratio."
        + (opposite_sign if gearing.ratio * expected < 0.0 else "")
    )


def _shows_inertia(rigid_fit: RigidFit, standard_errors: float) -> bool:
    """Return True if the torque clearly shows an inertia beyond so many standard errors; a negative one, if these are.

    A positive one shows that the sign of the torque is right, whatever else is odd: a lag turns the torque of an inertia
    against the speed; a wrong sign turns it against the acceleration, too.
    """
    is_clear = rigid_fit.inflation[0] < 10.0 and rigid_fit.shares[0] > 0.1
    inertia = math.copysign(1.0, standard_errors) * rigid_fit.values[0]
    return bool(is_clear and inertia > abs(standard_errors) * rigid_fit.errors[0])


_MAX_RETURNED_WORK = -0.5
"""Share of the exchanged work, below which more comes back than any model of a drive can return."""


def check_torque_sign(file: LogFile, rigid_fit: RigidFit, grid: Grid, position: np.ndarray) -> None:
    """Refuse a torque of the wrong sign, or remark on a doubtful one.

    A passive drive takes energy from its input, and its inertia is positive. `position` is that of the encoder which the
    torque `u` moves, rad (m), shape (samples,).
    """
    moves = [np.diff(position[segment]) for segment in grid.segments]
    displacement, steps = sum(abs(move.sum()) for move in moves), np.concatenate(moves)
    torque = np.concatenate([grid.values["u"][segment][:-1] for segment in grid.segments])
    exchanged = np.abs(torque) @ np.abs(steps)
    work_share = torque @ steps / exchanged if exchanged else 0.0
    # 8 standard errors prove the wrong sign
    accelerates_against_torque = _shows_inertia(rigid_fit, -8.0)
    if displacement > 0.2 * np.abs(steps).sum():
        # potential energy may pay for the motion
        work_share = max(work_share, 0.0)
    if accelerates_against_torque and work_share < 0.02:
        raise file.error(
            "the torque has the wrong sign: the drive accelerates against it"
            + (f" and returns {-100 * work_share:.0f} % of the work" if work_share < -0.02 else "")
            + "; set sign = -1 in [log] u"
        )
    # a load that drives the motor returns work as well: no error
    if work_share < -0.1:
        returned_text = f"the drive returns {-100 * work_share:.0f} % of the work"
        file.warn(f"{DOUBT}{returned_text}: the load drives it, or u has the wrong sign or acts late.")
        if work_share < _MAX_RETURNED_WORK and not _shows_inertia(rigid_fit, 3.0):
            file.contradiction = (
                f"{returned_text}, as only a drive with a driving load does: set sign = -1 in [log] u, or take a log in "
                "which the motor drives"
            )
    elif accelerates_against_torque and work_share < 0.1:
        file.note("The drive seems to accelerate against u: see its sign, unit and column.")


_DOUBTFUL_INERTIA = 10.0
"""Factor between an inertia and its nominal value that makes a unit doubtful: data sheets and CAD are right within 2."""

_SURE_FACTOR = 30.0
"""Factor that only a wrong unit makes: degrees for radians make 57, minutes for seconds 60, milli 1000."""
_SURE_FACTOR_FAST = 100.0
"""The same for a motion faster than the antiresonance of the nominal drive: there the load stands still, and at a
resonance the input supplies only the losses."""
_DOUBTFUL_TORQUE = 1000.0
"""Factor between the torque and the torque for the nominal inertia that makes a unit doubtful, as mN m for N m. A screw that
turns slowly against dry friction needs six hundred times the torque of its inertia."""
_DOUBTFUL_FRICTION = 100.0
"""Factor between the friction's work and that of the nominal viscous friction that makes a unit doubtful, where the rough
fit shows viscous friction. Dry friction may take any multiple, as on a drive that turns slowly; a tenth is seen only with
wrong units."""


def flag_wrong_units(file: LogFile, rigid_fit: RigidFit, channel: str, nominal: NominalDrive) -> None:
    """Warn if inertia, torque or friction are as far from the nominal drive as a wrong unit makes them.

    `file.contradiction` is set if no fit would be worth its time. Friction takes the power <u ω> + J <fall of ω² a second>
    / 2, the model's f <ω²>; noise, gaps and shafts do not change this. Without nominal friction this part is left out.
    """
    nominal_inertia, nominal_viscous = nominal.refer_to(channel)
    inertia, viscous = rigid_fit.values[:2].tolist()
    shows_viscous = abs(viscous) > 8.0 * rigid_fit.errors[1] and rigid_fit.inflation[1] < 10.0
    nominal_power = nominal_viscous * rigid_fit.square
    friction_power = rigid_fit.power + 0.5 * nominal_inertia * rigid_fit.slowing
    power_ratio = friction_power / nominal_power if min(nominal_power, friction_power) > 0.0 else math.nan
    if power_ratio >= _DOUBTFUL_FRICTION:
        power_ratio = max(viscous / nominal_viscous, 1.0) if shows_viscous else math.nan
    has_usual_friction = 1.0 / _DOUBTFUL_INERTIA < power_ratio < _DOUBTFUL_FRICTION
    # faster than the antiresonance of the nominal drive; a rigid drive, or one without a load, has none
    is_fast = nominal.load_inertia / nominal.gear_ratio**2 * rigid_fit.acceleration**2 > nominal.stiffness * rigid_fit.square
    sure_factor = _SURE_FACTOR_FAST if is_fast else _SURE_FACTOR
    text, ratio, doubtful_ratio, sure_ratio = "", 1.0, math.inf, math.inf
    # a coefficient that noise, gravity, a gap or a spring hides says nothing
    if (
        inertia > 4.0 * rigid_fit.errors[0]
        and rigid_fit.shares[0] > 0.05
        and rigid_fit.inflation[0] < 10.0
        and rigid_fit.residual < 0.5
    ):
        ratio = inertia / nominal_inertia
        text = f"u moves {channel} as an inertia of {inertia:.3g} would, {ratio:.3g} times the nominal {nominal_inertia:.3g}"
        doubtful_ratio, sure_ratio = _DOUBTFUL_INERTIA, _SURE_FACTOR
    elif inertia:
        ratio = rigid_fit.torque / (nominal_inertia * rigid_fit.acceleration)
        text = (
            f"u is {rigid_fit.torque:.3g} rms, {ratio:.3g} times what the nominal inertia {nominal_inertia:.3g} needs for "
            "this motion"
        )
        doubtful_ratio, sure_ratio = _DOUBTFUL_TORQUE, _SURE_FACTOR * _DOUBTFUL_TORQUE
    is_doubtful = not 1.0 / _DOUBTFUL_INERTIA < ratio < doubtful_ratio
    is_surely_wrong = not (has_usual_friction or 1.0 / sure_factor < ratio < sure_ratio)
    has_odd_friction = not (has_usual_friction or math.isnan(power_ratio))
    if has_odd_friction and not is_doubtful:
        multiple = f"in what is viscous {power_ratio:.3g} times the nominal"
        if power_ratio < 1.0:
            multiple = f"{power_ratio:.3g} times what the nominal viscous friction would"
        text = f"friction takes {friction_power:.3g} W, {multiple}"
        # the nominal friction may be wrong, so this alone is not sure
        is_doubtful, is_surely_wrong, ratio = True, False, 1.0 / power_ratio
    if is_doubtful:
        file.warn(f"{DOUBT}{text}: check the units of t, u and {channel} in [log], and the model.")
    # friction and inertia that are off in the same direction are no coincidence
    same_direction = has_odd_friction and (power_ratio > 1.0) == (ratio > 1.0)
    # friction that falls with the speed takes work none the less
    is_reversed = friction_power < 0.0 and shows_viscous and not _shows_inertia(rigid_fit, 3.0)
    if is_reversed and -3.0 * nominal_viscous < viscous < -nominal_viscous / 3.0:
        file.contradiction = (
            f"u falls with the speed as a viscous friction of {viscous:.3g} would make it, the model's is "
            f"{nominal_viscous:.3g}: set sign = -1 in [log] u"
        )
    if is_doubtful and (is_surely_wrong or same_direction):
        file.contradiction = f"{text}: a unit of t, u or {channel} in [log] is wrong, or the model's number is"


# remarks


def note_channel_faults(file: LogFile, name: str, statistics: ChannelStatistics, rate: float) -> None:
    """Remark on jumps, saturation and improbable speeds of a channel; `rate` is its rate of change, unit/s."""
    if statistics.jumps:
        file.note(
            f"{name}: {statistics.jumps} jump{'s' * (statistics.jumps > 1)} that the motion does not explain: "
            "dropped counts or disturbed readings."
        )
    if statistics.saturated:
        file.note(f"{name} is saturated in {percent(statistics.saturated)} of the samples.")
    # 1e4 rad/s, about 100 000 rpm, is beyond drives
    if statistics.unit == "rad" and rate > 1e4:
        rpm = rate * 30.0 / math.pi
        file.warn(f"{DOUBT}{name} reaches {rate:.3g} rad/s, {rpm:.3g} rpm: check its unit, and that of t.")


_CLEAR_STAMP_FAULT = 5.0
"""Factor by which even samples have to be smoother than their stamps make them: resampling changes noise by at most two."""


def note_host_stamps(file: LogFile, segmented: SegmentedStamps, readings: np.ndarray, resampled: np.ndarray) -> None:
    """Warn of stamps that make a motion rougher than even samples do: a host's, with the delays of its bus and system."""
    even_noise, stamped_noise = (rms(np.diff(values, n=4)) for values in (readings[segmented.segments[0]], resampled))
    if stamped_noise > _CLEAR_STAMP_FAULT * even_noise:
        period = fit_even_stamps(segmented.times[segmented.segments[0]]).period
        times_better = stamped_noise / max(even_noise, 1e-300)
        file.warn(
            f"The samples fit even stamps {times_better:.2g} times better than their own: these are a host's, not "
            f"the drive's. [log] t = {{ period = {period:.4g} }} reads them as even, if no row was lost."
        )


def note_gearing(file: LogFile, gearing: Gearing, statistics: dict[str, ChannelStatistics], period: float) -> None:
    """Remark on a significant skew of more than 5 % of the `period`, s, and on a lost motion that exceeds the noise."""
    skew, error = gearing.skew or 0.0, gearing.skew_error or 0.0
    if abs(skew) > max(6.0 * error, 0.05 * period):
        direction = "lags" if skew > 0.0 else "leads"
        file.note(
            f"theta_s {direction} theta_e by {1e3 * abs(skew):.3g} ± {1e3 * error:.2g} ms: a skew of "
            "the stamps, or viscous friction of the load that winds up the shaft; this log cannot tell them apart."
        )
    unit = statistics["theta_e"].unit
    text = f"Lost motion at the motor: {gearing.describe_lost_motion(unit)}"
    if gearing.flank == "load":
        times = ", ".join(f"{t:.3g}" for t in gearing.flank_times[:6]) + (", ..." if len(gearing.flank_times) > 6 else "")
        low, high = gearing.lost_motion_range
        single_change = " With one change only, a slipped coupling or lost counts would look the same."
        file.note(
            f"{text}, from positions passed in the same direction before and after the load torque changed its sign, at "
            f"{times} s; {low:.2g} to {high:.2g} {unit} by position."
            + (single_change if len(gearing.flank_times) == 1 else "")
        )
    elif gearing.exceeds_noise(twist_noise(gearing.ratio, statistics)) and not gearing.is_loose:
        file.note(f"{text}, from {gearing.flank_changes} changes of the flank by the direction of motion.")
