"""Figures, table and report of an inspected log."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import tomli_w

from jaxbl.files import to_jsonable, write_json
from jaxbl.lines import percent
from jaxbl.records import POSITION_CHANNELS, Inspection, Record
from jaxbl.records.inspection import compute_velocity, main_side
from jaxbl.records.signal_quality import longest_segment, low_pass, power_spectrum
from jaxbl.records.time_stamps import GAP_PERIODS
from jaxbl.result import KeyFigure, Result, ResultTable

from .figures import (
    BLACK,
    BLUE,
    COLOURS,
    FAINT,
    GREEN,
    PURPLE,
    VERMILION,
    Drawn,
    draw_zero,
    legend,
    limits,
    stacked,
    style,
    subplots,
)
from .numbers import lead_with_doubt

_POINTS = 6000
"""Points of a line: a page is about 1000 pixels wide."""
_CHANNELS = {
    "u": ("input u", BLACK), "theta_e": ("motor θe", BLUE), "theta_s": ("load θs", VERMILION),
    "transmitted": ("transmitted", GREEN),
}  # fmt: skip
"""Label and colour of each channel."""


def write_inspection(inspection: Inspection, folder: Path) -> str:
    """Write `inspection.json`. Returns the `[log]` table as TOML."""
    write_json(folder / "inspection.json", to_jsonable(inspection.to_dict()))
    return tomli_w.dumps({"log": inspection.log.model_dump(exclude_none=True)})


def describe_inspection(inspection: Inspection) -> Result:
    """Say what the log can identify, and what is wrong with it."""
    record, by_answer = inspection.record, {}
    for judged in inspection.identifiability:
        by_answer.setdefault(judged.answer, []).append(judged.quantity)
    parts = [
        f"{lead} {', '.join(by_answer[answer])}"
        for answer, lead in (("yes", "shows"), ("weak", "hardly shows"), ("no", "does not show"))
        if answer in by_answer
    ]
    verdict = "good" if "yes" in by_answer else "doubtful" if by_answer.keys() - {"no"} else "no answer"
    (head, *rows), sampling = _channel_table(record), record.statistics.sampling
    stamps = "even stamps" if sampling.even else f"uneven stamps (jitter {1e3 * sampling.jitter:.2g} ms rms)"
    count = len(record.segments)
    span = float(sum(np.ptp(record.time[part]) for part in record.segments)) + count * record.sample_period
    samples = f"{len(record.time)} samples every {1e3 * record.sample_period:.5g} ms, {stamps}"
    figures = [KeyFigure(f"{span:.4g} s", f"{samples}, {count} segment{'s' * (count > 1)}")]
    figures += [
        KeyFigure(
            f"{channel.noise:.2g} {channel.unit}",
            f"noise of {name}, rms; its motion is over {channel.largest - channel.least:.3g}",
        )
        for name, channel in record.statistics.channels.items()
        if name.startswith("theta")
    ]
    tables = [
        ResultTable("What the log can identify", ["quantity", "", "why"], _judgements(inspection)),
        ResultTable("Channels", head, rows),
    ]
    remarks, headline = [*record.warnings, inspection.describe_sizes()], f"The log {'; it '.join(parts)}."
    return lead_with_doubt(Result(record.path.name, verdict, headline, figures, remarks, record.notes, tables))


def _judgements(inspection: Inspection) -> list[tuple[str, str, str]]:
    return [(judged.quantity, judged.answer, judged.reason) for judged in inspection.identifiability]


def _channel_table(record: Record) -> list[tuple[str, ...]]:
    """Header and rows of the table of channels."""
    rows = [("channel", "unit", "least", "largest", "resolution", "noise", "bandwidth", "saturated", "jumps", "skew")]
    for name, c in record.statistics.channels.items():
        skew = "–" if c.skew is None or c.skew_error is None else f"{1e3 * c.skew:.2g} ± {1e3 * c.skew_error:.1g} ms"
        rows.append((
            name, c.unit, f"{c.least:.4g}", f"{c.largest:.4g}", f"{c.resolution:.3g}" if c.resolution else "–",
            f"{c.noise:.2g}", f"{c.bandwidth:.3g} Hz" if c.bandwidth else "–",
            percent(c.saturated) if c.saturated else "–", str(c.jumps) if name.startswith("theta") else "–", skew,
        ))  # fmt: skip
    return rows


@style()
def draw_inspection(inspection: Inspection) -> list[Drawn]:
    """All figures of an inspected log."""
    record = inspection.record
    drawn = [_channels(record), _spectra(record)]
    if record.torque is not None and np.ptp(record.torque):
        drawn.append(_torque_over_velocity(record))
    if inspection.twist is not None:
        drawn.append(_twist(inspection))
    if not record.statistics.sampling.even:
        drawn.append(_intervals(record))
    return drawn


def _values(record: Record) -> dict[str, np.ndarray]:
    positions = {POSITION_CHANNELS[side]: values for side, values in record.positions.items()}
    values = {"u": record.torque, **positions, "transmitted": record.transmitted}
    return {name: signal for name, signal in values.items() if signal is not None}


def _thin(record: Record, segments: Sequence[slice]) -> np.ndarray:
    """Indices of samples: no more than a page shows, in proportion to the segments."""
    step = max(len(record.time) // _POINTS, 1)
    return np.concatenate([np.arange(segment.start, segment.stop, step) for segment in segments])


def _channels(record: Record) -> Drawn:
    side, channels = main_side(record), record.statistics.channels
    panels = [(signal, *_CHANNELS[name], channels[name].unit) for name, signal in _values(record).items()]
    unit = f"{channels[POSITION_CHANNELS[side]].unit}/s"
    panels.append((compute_velocity(record, side), f"{side} velocity", PURPLE, unit))
    figure, axes = stacked(len(panels), 1.5, width=7.0)
    for ax, (signal, label, colour, unit) in zip(axes, panels, strict=True):
        for segment in record.segments:
            samples = _thin(record, [segment])
            ax.plot(record.time[samples], signal[samples], color=colour, lw=0.9)
        ax.set_ylabel(f"{label}\n({unit})")
    return Drawn(
        "channels", figure, f"The channels over time, and the velocity by differences of the low-passed {side} position."
    )


def _spectra(record: Record) -> Drawn:
    values = {name: signal for name, signal in _values(record).items() if np.ptp(signal)}
    part = longest_segment(record.segments)
    figure, axes = stacked(len(values), 2.1, "frequency (Hz)", width=7.0)
    for ax, (name, signal) in zip(axes, values.items(), strict=True):
        channel = record.statistics.channels[name]
        frequency, density = power_spectrum(signal[part], record.sample_period)
        label, colour = _CHANNELS[name]
        ax.loglog(frequency, np.sqrt(density), color=colour, lw=1.0)
        ax.set_ylabel(f"{label}\n({channel.unit}/√Hz)")
        if channel.noise:
            floor = channel.noise * np.sqrt(2.0 * record.sample_period)
            ax.axhline(floor, color="#555555", lw=1.0, ls="--", label=f"noise {channel.noise:.2g} {channel.unit} rms")
        if channel.bandwidth:
            power = "of velocity's power" if name.startswith("theta") else "of power"
            label = f"95 % {power} below {channel.bandwidth:.3g} Hz"
            ax.axvline(channel.bandwidth, color="#555555", lw=1.0, ls=":", label=label)
        if channel.noise or channel.bandwidth:
            legend(ax, 2)
    return Drawn(
        "spectra", figure, "Amplitude spectral densities (Welch), the noise floor, and the bandwidth of each channel."
    )


def _torque_over_velocity(record: Record) -> Drawn:
    assert record.torque is not None
    side, channels, dynamics = main_side(record), record.statistics.channels, record.statistics.dynamics
    channel, period = channels[POSITION_CHANNELS[side]], record.sample_period
    speed = compute_velocity(record, side)
    torque, label, edge = record.torque.copy(), "torque u", 0
    caption = "Torque over velocity: friction, as far as this log shows it."
    if dynamics is not None and dynamics.values[0] > 4.0 * dynamics.errors[0] and dynamics.shares[0] > 0.05:
        inertia, bandwidth = dynamics.values[0], 4.0 * channel.bandwidth
        for segment in record.segments:
            # the same low-pass as that of the acceleration
            torque[segment] = low_pass(torque[segment], bandwidth, period)
            torque[segment] -= inertia * np.gradient(speed[segment], period)
        label = "u less inertia torque"
        caption += f" Less the torque of an inertia of {inertia:.4g}: a rough estimate, not an identification."
        # transients of the filter
        edge = round(1.0 / (bandwidth * period))
    figure, (ax,) = subplots(7.0, 3.4)
    inner = [slice(part.start + edge, part.stop - edge) for part in record.segments if part.stop - part.start > 4 * edge]
    samples = _thin(record, inner or record.segments)
    ax.plot(speed[samples], torque[samples], ".", ms=1.6, color=BLUE, alpha=0.5)
    draw_zero(ax)
    ax.axvline(0.0, color=FAINT, lw=0.8)
    # a few samples at sharp corners of the motion would set the scale
    ends = limits(torque[samples], share=0.002, room=0.15)
    ax.set(xlabel=f"{side} velocity ({channel.unit}/s)", ylabel=f"{label} ({channels['u'].unit})", ylim=ends)
    return Drawn("torque_over_velocity", figure, caption)


def _twist(inspection: Inspection) -> Drawn:
    record, twist = inspection.record, inspection.twist
    assert twist is not None
    channels = record.statistics.channels
    panels = [(record.positions["load"], f"load position θs ({channels['theta_s'].unit})")]
    name = "u" if record.transmitted is None else "transmitted"
    torque = _values(record).get(name)
    if torque is not None and np.ptp(torque):
        panels.insert(0, (torque, f"{_CHANNELS[name][0]} ({channels[name].unit})"))
    figure, axes = subplots(7.0, 3.6, columns=len(panels), sharey=True)
    samples = _thin(record, record.segments)
    gearing = record.statistics.gearing
    if gearing is not None and gearing.flank == "load":
        split, names = "the side that the load pulls to", ("load on its first side", "on the other")
        chosen = np.searchsorted(gearing.flank_times, record.time[samples]) % 2 == 0
    else:
        split, names = "the direction of motion", ("forwards", "backwards")
        chosen = compute_velocity(record, "load")[samples] > 0.0
    for ax, (x, label) in zip(axes, panels, strict=True):
        for rows, colour, name in zip((samples[chosen], samples[~chosen]), COLOURS, names, strict=False):
            ax.plot(x[rows], twist[rows], ".", ms=1.8, color=colour, alpha=0.6, label=name)
        ax.set_xlabel(label)
    axes[0].set_ylabel(f"θe − N₀ θs about its median ({channels['theta_e'].unit})")
    legend(axes[-1], 2, markerscale=5)
    return Drawn(
        "twist",
        figure,
        f"Twist θe − N₀ θs with N₀ = {inspection.gear_ratio:.5g}, by {split}. Over torque: the loop's "
        "width shows lost motion and friction, its slope compliance. Over position: a periodic twist shows eccentricity of "
        "encoders or gears.",
    )


def _intervals(record: Record) -> Drawn:
    median = record.statistics.sampling.median_period
    inside = record.intervals <= GAP_PERIODS * median
    ends, intervals = np.cumsum(record.intervals)[inside], 1e3 * record.intervals[inside]
    figure, (left, right) = subplots(7.0, 2.6, columns=2, width_ratios=(3, 1), sharey=True)
    left.plot(ends, intervals, ".", ms=2.0, color=BLUE)
    left.axhline(1e3 * median, color=VERMILION, lw=1.0, ls="--", label="median")
    left.set(xlabel="time (s)", ylabel="interval\n(ms)")
    legend(left)
    right.hist(intervals, bins=60, orientation="horizontal", color=BLUE)
    right.set(xlabel="samples (1)")
    return Drawn("intervals", figure, "Intervals between raw time stamps, before resampling; gaps are left out.")
