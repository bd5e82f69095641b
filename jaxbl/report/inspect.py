"""Figures, table and report of an inspected log."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import tomli_w

from jaxbl.files import to_jsonable, write_json
from jaxbl.lines import NextStep, format_descriptions, format_table
from jaxbl.records import POSITION_CHANNELS, Inspection, Record
from jaxbl.records.inspection import compute_velocity, main_side
from jaxbl.records.signal_quality import longest_segment, low_pass, power_spectrum
from jaxbl.records.time_stamps import GAP_PERIODS

from .figures import COLOURS, FAINT, Drawn, legend, limits, stacked, style, subplots
from .page import PageTable, write_report

_POINTS = 6000
"""Points of a line: a page is about 1000 pixels wide."""
_LINES, _REMARKS = 25, 3
"""Lines that a terminal shows, about; and lines of remarks that are printed beyond that, too."""
_CHANNELS = {
    "u": ("input u", COLOURS[6]), "theta_e": ("motor θe", COLOURS[0]), "theta_s": ("load θs", COLOURS[1]),
    "transmitted": ("transmitted", COLOURS[2]),
}  # fmt: skip
"""Label and colour of each channel."""


def write_inspection_report(inspection: Inspection, folder: Path, steps: Sequence[NextStep] = ()) -> list[str]:
    """Write `inspection.json`, figures and report into a folder that exists; the page says what to try next (`steps`).

    Returns the lines for the terminal.
    """
    record = inspection.record
    write_json(folder / "inspection.json", to_jsonable(inspection.to_dict()))
    judgements = [(one.quantity, one.answer, one.reason) for one in inspection.identifiability]
    tables = [
        PageTable("What the log can identify", ["quantity", "", "why"], judgements),
        PageTable("Channels", _CHANNEL_COLUMNS, list(_channel_rows(record))),
    ]
    how = tomli_w.dumps({"log": inspection.log.model_dump(exclude_none=True)})
    lead = [*record.warnings, _headline(record), inspection.describe_sizes()]
    write_report(folder, record.path.name, lead, draw_inspection(inspection), tables, how, record.notes, steps)
    return summary(inspection)


def _headline(record: Record) -> str:
    sampling, count = record.statistics.sampling, len(record.segments)
    span = float(sum(record.time[s][-1] - record.time[s][0] for s in record.segments)) + count * record.sample_period
    stamps = "even stamps" if sampling.even else f"uneven stamps (jitter {1e3 * sampling.jitter:.2g} ms rms)"
    parts = "one segment" if count == 1 else f"{count} segments"
    return f"{len(record.time)} samples, {span:.4g} s every {1e3 * record.sample_period:.5g} ms, {stamps}, {parts}"


_CHANNEL_COLUMNS = ("channel", "unit", "least", "largest", "resolution", "noise", "bandwidth", "saturated", "jumps", "skew")


def _channel_rows(record: Record) -> Iterator[tuple[str, ...]]:
    for name, c in record.statistics.channels.items():
        skew = "–" if c.skew is None or c.skew_error is None else f"{1e3 * c.skew:.2g} ± {1e3 * c.skew_error:.1g} ms"
        yield (
            name, c.unit, f"{c.least:.4g}", f"{c.largest:.4g}", f"{c.resolution:.3g}" if c.resolution else "–",
            f"{c.noise:.2g}", f"{c.bandwidth:.3g} Hz" if c.bandwidth else "–",
            f"{100 * c.saturated:.2g} %" if c.saturated else "–", str(c.jumps) if name.startswith("theta") else "–", skew,
        )  # fmt: skip


def summary(inspection: Inspection) -> list[str]:
    """The log: channels and what can be identified, in tables of 80 columns, and as many remarks as there is room for."""
    record = inspection.record
    lines = [*record.warnings, f"{record.path.name}: {_headline(record)}", inspection.describe_sizes(), ""]
    columns = list(zip(_CHANNEL_COLUMNS, *_channel_rows(record), strict=True))
    lines += format_table(zip(*(column for column in columns if {*column[1:]} != {"–"}), strict=True))
    lines += [
        "",
        *format_descriptions(
            [("identifies", "", ""), *((j.quantity, j.answer, j.reason) for j in inspection.identifiability)]
        ),
    ]
    room = max(_LINES - len(lines) - 1, _REMARKS)
    notes = list(record.notes)
    if len(notes) > room:
        notes = [*notes[: room - 1], f"... and {len(notes) - room + 1} more remarks in the report"]
    return [*lines, *([""] if notes else []), *notes]


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
    found = {} if record.torque is None else {"u": record.torque}
    found |= {POSITION_CHANNELS[side]: values for side, values in record.positions.items()}
    return found if record.transmitted is None else found | {"transmitted": record.transmitted}


def _shown(record: Record, segments: Sequence[slice]) -> np.ndarray:
    """Indices of samples: no more than a page shows, in proportion to the segments."""
    every = max(len(record.time) // _POINTS, 1)
    return np.concatenate([np.arange(one.start, one.stop, every) for one in segments])


def _channels(record: Record) -> Drawn:
    values = _values(record)
    side = main_side(record)
    unit = record.statistics.channels[POSITION_CHANNELS[side]].unit
    channels = [(_CHANNELS[n][0], record.statistics.channels[n].unit, v, _CHANNELS[n][1]) for n, v in values.items()]
    rows = [*channels, (f"{side} velocity", f"{unit}/s", compute_velocity(record, side), COLOURS[3])]
    figure, axes = stacked(len(rows), 1.5, width=7.0)
    for ax, (label, unit, signal, colour) in zip(axes, rows, strict=True):
        for segment in record.segments:
            at = _shown(record, [segment])
            ax.plot(record.time[at], signal[at], color=colour, lw=0.9)
        ax.set_ylabel(f"{label}\n({unit})")
    caption = f"The channels over time, and the velocity by differences of the low-passed {side} position."
    return Drawn("channels", figure, caption)


def _spectra(record: Record) -> Drawn:
    values = {n: v for n, v in _values(record).items() if np.ptp(v)}
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
            what = "of velocity's power" if name.startswith("theta") else "of power"
            label = f"95 % {what} below {channel.bandwidth:.3g} Hz"
            ax.axvline(channel.bandwidth, color="#555555", lw=1.0, ls=":", label=label)
        if channel.noise or channel.bandwidth:
            legend(ax, 2)
    caption = "Amplitude spectral densities (Welch), the noise floor, and the bandwidth of each channel."
    return Drawn("spectra", figure, caption)


def _torque_over_velocity(record: Record) -> Drawn:
    assert record.torque is not None
    side = main_side(record)
    channel = record.statistics.channels[POSITION_CHANNELS[side]]
    dynamics = record.statistics.dynamics
    speed = compute_velocity(record, side)
    torque, label, less, edge = record.torque.copy(), "torque u", "", 0
    if dynamics is not None and dynamics.values[0] > 4.0 * dynamics.errors[0] and dynamics.shares[0] > 0.05:
        for s in record.segments:
            # the same low-pass as that of the acceleration
            torque[s] = low_pass(torque[s], 4.0 * channel.bandwidth, record.sample_period)
            torque[s] -= dynamics.values[0] * np.gradient(speed[s], record.sample_period)
        label = "u less inertia torque"
        less = f" Less the torque of an inertia of {dynamics.values[0]:.4g}: a rough estimate, not an identification."
        # transients of the filter
        edge = round(1.0 / (4.0 * channel.bandwidth * record.sample_period))
    figure, (ax,) = subplots(7.0, 3.4)
    inner = [slice(s.start + edge, s.stop - edge) for s in record.segments if s.stop - s.start > 4 * edge]
    at = _shown(record, inner or record.segments)
    ax.plot(speed[at], torque[at], ".", ms=1.6, color=COLOURS[0], alpha=0.5)
    ax.axhline(0.0, color=FAINT, lw=0.8)
    ax.axvline(0.0, color=FAINT, lw=0.8)
    # a few samples at sharp corners of the motion would set the scale
    ends = limits(torque[at], share=0.002, room=0.15)
    torque_unit = record.statistics.channels["u"].unit
    ax.set(xlabel=f"{side} velocity ({channel.unit}/s)", ylabel=f"{label} ({torque_unit})", ylim=ends)
    return Drawn("torque_over_velocity", figure, f"Torque over velocity: friction, as far as this log shows it.{less}")


def _twist(inspection: Inspection) -> Drawn:
    record, twist = inspection.record, inspection.twist
    assert twist is not None
    unit = record.statistics.channels["theta_e"].unit
    torque = record.torque if record.transmitted is None else record.transmitted
    panels = [(record.positions["load"], f"load position θs ({record.statistics.channels['theta_s'].unit})")]
    if torque is not None and np.ptp(torque):
        name = "u" if record.transmitted is None else "transmitted"
        panels.insert(0, (torque, f"{_CHANNELS[name][0]} ({record.statistics.channels[name].unit})"))
    figure, axes = subplots(7.0, 3.6, columns=len(panels), sharey=True)
    at = _shown(record, record.segments)
    gearing = record.statistics.gearing
    if gearing is not None and gearing.flank == "load":
        split, names = "the side that the load pulls to", ("load on its first side", "on the other")
        chosen = np.searchsorted(gearing.flank_times, record.time[at]) % 2 == 0
    else:
        split, names = "the direction of motion", ("forwards", "backwards")
        chosen = compute_velocity(record, "load")[at] > 0.0
    for ax, (x, label) in zip(axes, panels, strict=True):
        for rows, colour, name in zip((at[chosen], at[~chosen]), COLOURS, names, strict=False):
            ax.plot(x[rows], twist[rows], ".", ms=1.8, color=colour, alpha=0.6, label=name)
        ax.set_xlabel(label)
    axes[0].set_ylabel(f"θe − N₀ θs about its median ({unit})")
    legend(axes[-1], 2, markerscale=5)
    caption = (
        f"Twist θe − N₀ θs with N₀ = {inspection.gear_ratio:.5g}, by {split}. Over torque: the loop's "
        "width shows lost motion and friction, its slope compliance. Over position: a periodic twist shows eccentricity of "
        "encoders or gears."
    )
    return Drawn("twist", figure, caption)


def _intervals(record: Record) -> Drawn:
    ends, intervals = np.cumsum(record.intervals), 1e3 * record.intervals
    inside = record.intervals <= GAP_PERIODS * record.statistics.sampling.median_period
    ends, intervals = ends[inside], intervals[inside]
    figure, (left, right) = subplots(7.0, 2.6, columns=2, width_ratios=(3, 1), sharey=True)
    left.plot(ends, intervals, ".", ms=2.0, color=COLOURS[0])
    left.axhline(1e3 * record.statistics.sampling.median_period, color=COLOURS[1], lw=1.0, ls="--", label="median")
    left.set(xlabel="time (s)", ylabel="interval\n(ms)")
    legend(left)
    right.hist(intervals, bins=60, orientation="horizontal", color=COLOURS[0])
    right.set(xlabel="samples (1)")
    return Drawn("intervals", figure, "Intervals between raw time stamps, before resampling; gaps are left out.")
