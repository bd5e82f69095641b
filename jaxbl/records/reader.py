"""Read measured logs: from a file to evenly spaced channels in SI units, with statistics and remarks on its quality."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import ValidationError

from jaxbl.errors import InputError
from jaxbl.lines import DOUBT
from jaxbl.units import on_a_line
from jaxbl.validation import check_sizes, explain_first_error

from .alignment import NominalDrive, find_clock_skew, find_encoder_offset, max_windup_delay
from .channels import RawChannel, read_channels
from .files import LogFile, read_log_file
from .gearing import Drift, Gearing, fit_drift, fit_gearing
from .lateness import Lateness, estimate_lateness
from .plausibility import (
    check_channels_differ,
    check_gear_ratio,
    check_position_moves,
    check_torque_sign,
    flag_wrong_units,
    note_channel_faults,
    note_gearing,
    note_host_stamps,
    note_standstill,
)
from .resampling import Grid, resample_channels
from .rigid_body import RigidFit, fit_rigid_drive
from .signal_quality import (
    ChannelStatistics,
    count_jumps,
    find_bandwidth,
    find_resolution,
    longest_segment,
    noise_floor,
    power_spectrum,
    saturated_share,
)
from .table import ELEMENT_NEEDS, POSITION_CHANNELS, LogTable
from .time_stamps import Sampling, SegmentedStamps, join_file, read_time_stamps, split_at_gaps


@dataclass(frozen=True)
class LogStatistics:
    """Statistics of a log.

    Attributes:
        sampling: statistics of the time stamps.
        channels: channel -> its statistics; channels are u, theta_e, theta_s, transmitted, if they were recorded.
        gearing: relation of motor and load motion; None with a single encoder or too little motion.
        dynamics: rough rigid-drive regression of the torque; None without torque or with too little motion.
    """

    sampling: Sampling
    channels: dict[str, ChannelStatistics]
    gearing: Gearing | None
    dynamics: RigidFit | None


@dataclass(frozen=True)
class Record:
    """A measured log in SI units, evenly spaced within each segment.

    Attributes:
        path: the file.
        time: s from the first sample, shape (samples,).
        sample_period: s.
        torque: input at the motor shaft, held from each sample to the next, N m (N on a linear axis), shape (samples,); None
            if it was not recorded.
        positions: "motor" and "load", if recorded -> rad (m on a linear axis), shape (samples,).
        transmitted: measured transmitted torque, N m (N), shape (samples,), or None.
        reference: position that a controller was given, rad (m), shape (samples,), or None.
        closed_loop: True if a controller chose the input from the positions; None if not known.
        start: time of the first sample by the stamps of the log, s.
        segments: samples of each segment; between them the log has gaps.
        notes: sentences on changes to the log, and on its oddities.
        warnings: sentences to be said first: corrected clocks or zero points of encoders, doubtful units.
        corrections: "skew" of theta_s, s, its "drift", s/s, "offset" of theta_e, rad (m), "zero" of all positions, rad,
            "u.skew", s, and "u.sampled" (1 if u was sampled at its stamps, 0 if it is held from them on), if applied.
        contradiction: reason for which the nominal drive cannot be fitted, such as a wrong unit; "" if there is none.
        statistics: of its stamps, channels, gearing and torque.
        intervals: between the raw stamps that were used, s, shape (raw samples - 1,).
        logs: file and rows of each log that it was joined from.
    """

    path: Path
    time: np.ndarray
    sample_period: float
    torque: np.ndarray | None
    positions: dict[str, np.ndarray]
    transmitted: np.ndarray | None
    reference: np.ndarray | None
    closed_loop: bool | None
    start: float
    segments: tuple[slice, ...]
    notes: tuple[str, ...]
    warnings: tuple[str, ...]
    corrections: dict[str, float]
    contradiction: str
    statistics: LogStatistics
    intervals: np.ndarray
    logs: tuple[tuple[Path, slice], ...]

    def unit_of(self, path: str, unit: str) -> str:
        """Return the unit of a number of one side in this log: N and m for N m and rad, if the side moves along a line."""
        side = "load" if any(name.startswith("load") for name in path.split(".")) else "motor"
        channel = self.statistics.channels.get(POSITION_CHANNELS[side])
        return on_a_line(unit) if channel is not None and channel.unit == "m" else unit


def read_log_table(log: LogTable | Mapping[str, Any] | None, name: str = "") -> LogTable:
    """Validate a `[log]` table, None for defaults; messages begin with `name`, the file that it is from.

    Raises:
        InputError: unknown key, wrong type or range; one line that names the key.
    """
    if isinstance(log, LogTable):
        return log
    try:
        check_sizes(log)
        return LogTable.model_validate({} if log is None else dict(log))
    except InputError as error:
        fault = f"log.{error}"
    except ValidationError as error:
        fault = explain_first_error(error, ["log", *error.errors()[0]["loc"]])[1]
    raise InputError(f"{name}: {fault}" if name else fault)


def read_record(
    path: str | Path,
    log: LogTable | Mapping[str, Any] | None = None,
    *,
    gear_ratio: float | None = None,
    nominal: NominalDrive | None = None,
    share: float = 1.0,
) -> Record:
    """Read a measured log.

    Columns become SI units as the `[log]` table says. Samples at uneven stamps are resampled to their median period:
    positions by cubic splines, torques so that their integral over time stays the same. Gaps split the log into segments.

    Args:
        path: CSV or other text, Parquet, MATLAB (.mat up to 7.3), or JSON file.
        log: the `[log]` table of a study, or its keys; if left out, columns t, u, theta_e, theta_s in s, N m, rad, rad.
        gear_ratio: expected ratio of motor over load motion, which is compared with that of the log.
        nominal: nominal drive of the log. It is needed to correct a skew and an offset between the encoders that no
            friction or gap can cause, if the `[log]` table does not give them.
        share: of the samples, from the first on, by which clocks and zero points are found; the rest is cleaned by these.

    Raises:
        InputError: the file or a column is missing or unfit, or the log contradicts the `[log]` table or `gear_ratio`.
    """
    table = read_log_table(log)
    file = read_log_file(Path(path), table.list_columns())
    for name in table.join or ():
        join_file(file, table, name)
    # columns become SI channels at the time stamps of the log
    stamps = read_time_stamps(file, table)
    channels = read_channels(file, table, stamps)
    check_channels_differ(file, channels)
    segmented = split_at_gaps(file, stamps)
    channels = {name: raw._replace(values=raw.values[segmented.distinct]) for name, raw in channels.items()}
    encoders = [name for name in POSITION_CHANNELS.values() if name in channels]
    is_drive = table.kind == "drive"
    if not is_drive:
        if "theta_e" not in encoders:
            raise file.error(f"has no theta_e: {ELEMENT_NEEDS}; [log] theta_e can name its column")
        # the sides of an element move on their own, if they move
        encoders = ["theta_e"]
    for name in encoders:
        check_position_moves(file, name, channels[name].values)
    has_both_encoders = len(encoders) == 2
    if has_both_encoders:
        note_standstill(file, segmented, channels)
    # these become evenly spaced samples
    shaft = nominal if nominal is not None and math.isfinite(nominal.stiffness) and has_both_encoders else None
    grid, gearing, regular, lateness = _resample_and_align(
        file, table, segmented, channels, encoders, gear_ratio, nominal, shaft, share
    )
    if shaft is not None:
        _correct_offset(file, table, grid, channels, shaft, share)
    if not regular and table.resample is None and len(segmented.segments) == 1:
        note_host_stamps(file, segmented, channels[encoders[0]].values, grid.values[encoders[0]])
    # the motion is compared with the drive
    if has_both_encoders:
        check_gear_ratio(file, table, grid, gearing, gear_ratio, channels["theta_e"].unit, shaft)
    position, is_driven = grid.values[encoders[0]], is_drive and "u" in channels
    dynamics = fit_rigid_drive(grid.values["u"], position, grid.segments, grid.period) if is_driven else None
    if dynamics is not None:
        check_torque_sign(file, dynamics, grid, position)
        if nominal is not None:
            flag_wrong_units(file, dynamics, encoders[0], nominal)
    # values at uneven stamps, read as even ones, would look noisy
    source = Grid(
        segmented.times, {channel: raw.values for channel, raw in channels.items()}, segmented.segments, grid.period
    )
    statistics = {
        name: _measure_channel(file, name, raw, segmented, source if regular else grid) for name, raw in channels.items()
    }
    if gearing is not None:
        gearing = replace(gearing, flank_times=tuple(t - float(grid.time[0]) for t in gearing.flank_times))
        statistics["theta_s"] = replace(statistics["theta_s"], skew=gearing.skew, skew_error=gearing.skew_error)
        note_gearing(file, gearing, statistics, grid.period)
    if lateness is not None and lateness.error < segmented.period:
        statistics["u"] = replace(statistics["u"], skew=lateness.value, skew_error=lateness.error)
    return Record(
        path=file.path,
        time=grid.time - grid.time[0],
        sample_period=grid.period,
        torque=grid.values.get("u"),
        positions={side: grid.values[name] for side, name in POSITION_CHANNELS.items() if name in channels},
        transmitted=grid.values.get("transmitted"),
        reference=grid.values.get("reference"),
        closed_loop=table.closed_loop,
        start=stamps.start + float(grid.time[0]),
        segments=tuple(grid.segments),
        notes=tuple(file.notes),
        # doubts come before corrections
        warnings=tuple(sorted(file.warnings, key=lambda warning: not warning.startswith(DOUBT))),
        corrections=file.corrections,
        contradiction=file.contradiction,
        statistics=LogStatistics(segmented.sampling, statistics, gearing, dynamics),
        intervals=np.diff(segmented.times),
        logs=((file.path, slice(0, len(grid.time))),),
    )


def _resample_and_align(
    file: LogFile,
    table: LogTable,
    segmented: SegmentedStamps,
    channels: dict[str, RawChannel],
    encoders: Sequence[str],
    gear_ratio: float | None,
    nominal: NominalDrive | None,
    shaft: NominalDrive | None,
    share: float,
) -> tuple[Grid, Gearing | None, bool, Lateness | None]:
    """Resample the channels to even spacing and remove skews, which are found by a share of the samples.

    Returns:
        The samples, the relation of both encoders, True if the stamps had that spacing already, and the lateness of u.
    """
    channels, period = {**channels}, table.resample or segmented.period
    regular = segmented.sampling.even and math.isclose(period, segmented.period, rel_tol=1e-9)

    def resample(changed: str = "", **changes: Any) -> tuple[Grid, Gearing | None]:
        """Resample the channels, one of them with changes."""
        if changed:
            channels[changed] = channels[changed]._replace(**changes)
        grid = resample_channels(file, segmented, channels, period, interpolate=not regular)
        if len(encoders) < 2:
            return grid, None
        turn = math.inf if channels["theta_s"].unit == "m" else 2.0 * math.pi
        return grid, fit_gearing(grid.first(share), expected=gear_ratio, turn=turn)

    grid, gearing = resample()
    lateness = None
    if "u" in channels and table.kind == "drive":
        lateness = estimate_lateness(grid.first(share), encoders, segmented.period)
        if lateness is not None and (keys := _find_torque_keys(file, table, lateness, nominal, segmented.period)):
            hold, skew = keys
            file.corrections |= {"u.skew": skew, "u.sampled": float(hold == "sampled")}
            late = skew + (0.5 * segmented.period if hold == "sampled" else 0.0)
            lateness = lateness._replace(value=lateness.value - late)
            grid, gearing = resample("u", hold=hold, skew=skew)
    is_estimated = table.theta_s is not None and table.theta_s.skew == "estimate"
    shaft = shaft if _is_left_out(table, "skew") else None
    sentences = []
    if gearing is not None and (is_estimated or shaft is not None) and _is_left_out(table, "drift"):
        drift = _find_clock_drift(gearing, grid.first(share), shaft)
        if drift is not None:
            middle = 0.5 * float(grid.time[0] + grid.time[-1])
            grid, gearing = resample("theta_s", skew=-drift.value * middle, drift=drift.value)
            sentences.append(
                f"The clocks drift apart: theta_s becomes later than theta_e by {1e6 * drift.value:.4g} ± "
                f"{1e6 * drift.error:.1g} us each second. This was corrected."
            )
    skew = 0.0
    if is_estimated:
        skew = _estimate_skew(file, gearing, period)
    elif shaft is not None and gearing is not None:
        clock_skew = find_clock_skew(gearing, grid.first(share), shaft)
        if clock_skew is not None:
            skew = clock_skew.value
            place = " in the middle of the log" if sentences else ""
            sentences.append(
                f"theta_s is {_describe_delay(skew, clock_skew.error)} than theta_e{place}. Friction can cause at most "
                f"{1e3 * clock_skew.max_windup_delay:.2g} ms, so this was corrected."
            )
    if skew:
        grid, gearing = resample("theta_s", skew=channels["theta_s"].skew + skew)
    if sentences:
        load, (name, _) = channels["theta_s"], table.position_source("theta_s")
        drift_key = f" (at the first stamp) and {name}.drift = {load.drift:.4g}" if load.drift else ""
        keys = f"[log] {name}.skew = {load.skew:.4g}{drift_key} corrects the same; 0 corrects nothing."
        file.warn(" ".join([*sentences, keys]))
    if shaft is not None:
        load = channels["theta_s"]
        file.corrections |= {key: value for key, value in (("skew", load.skew), ("drift", load.drift)) if value}
    if not regular:
        purpose = "to the period of [log] resample, or of the other logs" if table.resample else "from uneven stamps"
        file.note(
            f"Resampled {purpose}: every {1e3 * period:.6g} ms, in the log every {1e3 * segmented.period:.6g} ms; positions "
            "by cubic splines, torques by means that keep their integral."
        )
    for name, raw in channels.items():
        if raw.skew or raw.drift:
            growth = f", growing by {1e6 * raw.drift:.4g} us each second" if raw.drift else ""
            file.note(f"{name}: shifted by its skew of {1e3 * raw.skew:.4g} ms{growth}.")
    return grid, gearing, regular, lateness


def _find_torque_keys(
    file: LogFile, table: LogTable, lateness: Lateness, nominal: NominalDrive | None, period: float
) -> tuple[Literal["zoh", "sampled"], float] | None:
    """Return hold and skew (s) of u that undo its lateness, and say so; None if it stays, which is said, too."""
    is_left_out = table.hold is None and (table.u is None or table.u.skew is None)
    half_periods = lateness.half_periods
    if not (lateness.is_known and is_left_out and abs(lateness.value) > 3.0 * lateness.error) or half_periods == 0:
        return None
    text = f"u is {_describe_delay(lateness.value, lateness.error)} than the motion that it causes"
    if half_periods is None:
        file.note(
            f"{text}, which is no multiple of half a period: a filter of u, a soft shaft or a lag may cause it. Nothing was "
            f"corrected; [log] u.skew = {lateness.value:.3g} does so."
        )
        return None
    # a command is late by whole periods; what samples a current may have another period, so that some of it is left
    hold = "sampled" if half_periods % 2 else "zoh"
    skew = lateness.value - 0.5 * period if half_periods % 2 else 0.5 * half_periods * period
    keys = f'hold = "{hold}" and u.skew = {skew:.3g}'
    cause = "late stamps" if half_periods > 1 else "it was measured at its stamps, not held from them on"
    if half_periods < 0:
        cause = "early stamps, or a dead time or lag of the actuator; this log cannot tell them apart"
    dead_time = "modelled" if nominal is None else nominal.dead_time
    if dead_time == "modelled" or (dead_time == "sought" and half_periods < 0):
        file.warn(f"{text}: {cause}. Nothing was corrected; [log] {keys} does so.")
        return None
    file.warn(f"{text}: {cause}. This was corrected. [log] {keys} corrects the same; u.skew = 0 corrects nothing.")
    return hold, skew


def _find_clock_drift(gearing: Gearing, grid: Grid, shaft: NominalDrive | None) -> Drift | None:
    """Find a drift between the clocks of both encoders; None if friction of the nominal `shaft` may cause it."""
    drift = None if gearing.is_loose else fit_drift(grid, gearing.skew or 0.0)
    # as the machine warms up, friction and wind-up change, at most by the whole wind-up
    if drift is None or (
        shaft is not None
        and drift.reach < max_windup_delay(grid, shaft) + 6.0 * drift.reach * drift.error / abs(drift.value)
    ):
        return None
    return drift


def _estimate_skew(file: LogFile, gearing: Gearing | None, period: float) -> float:
    if gearing is None or gearing.skew is None or gearing.skew_error is None:
        raise file.error("theta_s.skew = 'estimate': this motion does not show a skew; give it in s, or leave it out")
    estimate = f"{1e3 * gearing.skew:.4g} ± {1e3 * gearing.skew_error:.2g} ms"
    if not gearing.skew_error < 0.5 * period:
        raise file.error(
            f"theta_s.skew = 'estimate': the estimate is {estimate}; its error should be less than half the period of "
            f"{1e3 * period:.4g} ms; give the skew in s, or leave it out"
        )
    file.note(f"The skew of theta_s was estimated against theta_e: {estimate}.")
    return gearing.skew


def _is_left_out(table: LogTable, key: str) -> bool:
    """Return True if `[log]` leaves a key of theta_e and theta_s out; False if a speed in place of theta_s lacks the key."""
    motor, load = table.position_source("theta_e")[1], table.position_source("theta_s")[1]
    return getattr(motor, key, None) is None and getattr(load, key, 0.0) is None


def _describe_delay(value: float, error: float) -> str:
    return f"{1e3 * abs(value):.3g} ± {1e3 * error:.1g} ms {'later' if value > 0.0 else 'earlier'}"


def _correct_offset(
    file: LogFile, table: LogTable, grid: Grid, channels: dict[str, RawChannel], nominal: NominalDrive, share: float
) -> None:
    """Subtract a sure offset between the encoders from theta_e; warn of a possible one."""
    integrals = [name for name in POSITION_CHANNELS.values() if table.position_source(name)[0] != name]
    may_correct = integrals or _is_left_out(table, "offset")
    if not may_correct or (offset := find_encoder_offset(grid.first(share), nominal)) is None:
        return
    # an integral may begin at any position
    name = integrals[0] if integrals else "theta_e"
    change = -offset.value if name == "theta_e" else offset.value / nominal.gear_ratio
    if integrals or offset.is_sure:
        grid.values[name] = grid.values[name] + change
        channels[name] = channels[name]._replace(values=channels[name].values + change)
    if integrals:
        file.note(
            f"{name} is an integral: {change:.4g} {channels[name].unit} were added, so that it fits the other encoder."
        )
        return
    size = f"{offset.value:.4g} ± {offset.error:.1g} {channels['theta_e'].unit}"
    twist = f"theta_e - {nominal.gear_ratio:g} theta_s"
    if offset.is_sure:
        file.corrections["offset"] = change
        file.warn(
            f"{twist} is {size} without torque. This offset between the encoders was corrected. [log] theta_e.offset = "
            f"{change:.4g} corrects the same; 0 corrects nothing."
        )
        return
    cause = f"a constant torque {'in the shaft' if offset.both_flanks else 'that holds the load on one flank of a gap'}"
    file.warn(
        f"{twist} is {size} in the mean: an offset between the encoders, or {cause}; this log cannot tell them apart. "
        f"[log] theta_e.offset = {change:.4g} corrects it as an offset; 0 corrects nothing."
    )


def _measure_channel(
    file: LogFile, name: str, raw: RawChannel, segmented: SegmentedStamps, source: Grid
) -> ChannelStatistics:
    """Measure a channel, with remarks; noise and bandwidth are those of the longest segment of `source`."""
    segment = longest_segment(source.segments)
    values, times = source.values[name][segment], source.time[segment]
    period = (times[-1] - times[0]) / (len(values) - 1)
    readings = np.concatenate([raw.values[rows] for rows in segmented.segments])
    step = find_resolution(readings)
    is_position = name.startswith("theta")
    jumps, saturated = 0, raw.saturated
    if is_position:
        jumps = sum(count_jumps(raw.values[rows], step, segmented.times[rows]) for rows in segmented.segments)
    elif not saturated:
        saturated = saturated_share(readings, step)
    statistics = ChannelStatistics(
        unit=raw.unit,
        least=float(readings.min()),
        largest=float(readings.max()),
        resolution=step,
        noise=float(np.sqrt(noise_floor(*power_spectrum(values, period)) * 0.5 / period)),
        bandwidth=find_bandwidth(values, period, differentiate=is_position),
        saturated=saturated,
        jumps=jumps,
    )
    note_channel_faults(file, name, statistics, np.quantile(np.abs(np.diff(values)), 0.99) / period)
    return statistics


def check_positions(log: Record, other: Record) -> None:
    """Refuse another log of the same machine that lacks a position of the first one."""
    _require_channels(other, {f"{side} position" for side in log.positions}, log)


_PAUSE_PERIODS = 10
"""Periods between logs that are joined."""


def join_records(records: Sequence[Record]) -> Record:
    """Join several logs of one machine to a record, one after the other, with statistics and units of the first.

    Raises:
        InputError: other channels or another sampling period than the first one's.
    """
    first = records[0]
    if len(records) == 1:
        return first
    period, end = first.sample_period, 0.0
    times, segments, logs = [], [], []
    for record in records:
        if not math.isclose(record.sample_period, period, rel_tol=1e-6):
            raise InputError(
                f"{record.path}: is sampled every {record.sample_period:.6g} s, {first.path} every {period:.6g} s; "
                f"set [log] resample = {period:.6g} to read both at the same period"
            )
        _require_channels(record, _list_channels(first), first)
        _require_channels(first, _list_channels(record), record)
        count = sum(map(len, times))
        times.append(record.time - record.time[0] + end)
        end = times[-1][-1] + _PAUSE_PERIODS * period
        segments += [slice(segment.start + count, segment.stop + count) for segment in record.segments]
        logs += [(path, slice(rows.start + count, rows.stop + count)) for path, rows in record.logs]
    names = ", ".join(record.path.name for record in records)
    joined = {name: np.concatenate([_list_channels(record)[name] for record in records]) for name in _list_channels(first)}
    return replace(
        first,
        time=np.concatenate(times),
        torque=joined.get("torque"),
        positions={side: joined[f"{side} position"] for side in first.positions},
        transmitted=joined.get("transmitted torque"),
        reference=joined.get("reference"),
        segments=tuple(segments),
        notes=(
            f"{len(records)} logs, one after the other: {names}.",
            *(f"{record.path.name}: {note}" for record in records for note in record.notes),
        ),
        warnings=tuple(f"{record.path.name}: {warning}" for record in records for warning in record.warnings),
        intervals=np.concatenate([record.intervals for record in records]),
        logs=tuple(logs),
    )


def _require_channels(record: Record, names: Iterable[str], other: Record) -> None:
    if missing := {*names} - {*_list_channels(record)}:
        raise InputError(
            f"{record.path}: has no {min(missing)}, which {other.path} has; logs of one machine should be alike"
        )


def _list_channels(record: Record) -> dict[str, np.ndarray]:
    channels = {f"{side} position": values for side, values in record.positions.items()}
    channels |= {"torque": record.torque, "transmitted torque": record.transmitted, "reference": record.reference}
    return {name: values for name, values in channels.items() if values is not None}
