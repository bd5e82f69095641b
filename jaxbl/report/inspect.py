"""Figures, table and report of an inspected log."""

from collections.abc import Iterator
from dataclasses import astuple
from pathlib import Path

import numpy as np
import tomli_w

from jaxbl.records import POSITION_CHANNELS, Inspection, Record
from jaxbl.records.inspection import compute_velocity, main_side
from jaxbl.result import KeyFigure, Result, ResultTable

from .numbers import lead_with_doubt
from .panels import BLACK, BLUE, COLOURS, GREEN, PURPLE, VERMILION, Array, Axis, Figure, Panel, cloud, draw_signals

_LOOKS = {
    "u": ("input u", BLACK), "theta_e": ("motor θe", BLUE), "theta_s": ("load θs", VERMILION),
    "transmitted": ("transmitted", GREEN),
}  # fmt: skip
"""Label and colour of each channel."""


def write(inspection: Inspection, folder: Path) -> str:
    """Return the `[log]` table as TOML."""
    return tomli_w.dumps({"log": inspection.log.model_dump(exclude_none=True)})


def describe(inspection: Inspection) -> Result:
    """Say what the log can identify, and what is wrong with it."""
    record = inspection.record
    judgements = [*map(astuple, inspection.identifiability)]
    parts, verdict = [], "no answer"
    # the best answer last: it decides
    for answer, lead, word in _ANSWERS:
        if quantities := [quantity for quantity, judged, _ in judgements if judged == answer]:
            parts.insert(0, f"{lead} {', '.join(quantities)}")
            verdict = word
    sampling = record.statistics.sampling
    stamps = "even stamps" if sampling.even else f"uneven stamps (jitter {1e3 * sampling.jitter:.2g} ms rms)"
    count = len(record.segments)
    span = sum(np.ptp(record.time[part]) for part in record.segments) + count * record.sample_period
    samples = f"{len(record.time)} samples every {1e3 * record.sample_period:.5g} ms, {stamps}"
    figures = [KeyFigure(f"{span:.4g} s", f"{samples}, {count} segment{'s' * (count > 1)}")]
    figures += [
        KeyFigure(
            f"{channel.noise:.2g} {channel.unit}",
            f"noise of {name}, rms; the motion spans {channel.largest - channel.least:.3g} {channel.unit}",
        )
        for name, channel in record.statistics.channels.items()
        if name.startswith("theta")
    ]
    tables = [ResultTable("What the log can identify", ["quantity", "", "why"], judgements), _channel_table(record)]
    remarks, headline = [*record.warnings, inspection.describe_sizes()], f"The log {'; it '.join(parts)}."
    return lead_with_doubt(Result(record.path.name, verdict, headline, figures, remarks, record.notes, tables))


_ANSWERS = ("no", "does not show", "no answer"), ("weak", "hardly shows", "doubtful"), ("yes", "shows", "good")
"""What a log can say of a quantity, in words, and the verdict if that is the best of its answers."""


def _channel_table(record: Record) -> ResultTable:
    columns = ["channel", "unit", "least", "largest", "resolution", "noise", "bandwidth (Hz)", "saturated (share)", "jumps",
               "skew (ms)", "standard error (ms)"]  # fmt: skip
    rows = []
    for name, channel in record.statistics.channels.items():
        *statistics, jumps, skew, skew_error = astuple(channel)
        times = [None if seconds is None else 1e3 * seconds for seconds in (skew, skew_error)]
        rows.append([name, *statistics, jumps if name.startswith("theta") else None, *times])
    return ResultTable("Channels", columns, rows)


def draw(inspection: Inspection) -> Iterator[Figure]:
    """All figures of an inspected log."""
    yield _channels(inspection.record)
    if inspection.twist is not None:
        yield _twist(inspection, inspection.twist)


def _channels(record: Record) -> Figure:
    side, channels = main_side(record), record.statistics.channels
    positions = {POSITION_CHANNELS[side]: values for side, values in record.positions.items()}
    values = {"u": record.torque, **positions, "transmitted": record.transmitted}
    signals = [
        (signal, _LOOKS[name][0], channels[name].unit, _LOOKS[name][1])
        for name, signal in values.items()
        if signal is not None
    ]
    unit = f"{channels[POSITION_CHANNELS[side]].unit}/s"
    signals.append((compute_velocity(record, side), f"{side} velocity", unit, PURPLE))
    caption = f"The channels over time, and the velocity by differences of the low-passed {side} position."
    return Figure("channels", draw_signals(record.time, record.segments, signals), caption, height=1.5)


def _twist(inspection: Inspection, twist: Array) -> Figure:
    record, channels = inspection.record, inspection.record.statistics.channels
    gearing = record.statistics.gearing
    over = [(record.positions["load"], f"load position θs ({channels['theta_s'].unit})")]
    name, torque = ("u", record.torque) if record.transmitted is None else ("transmitted", record.transmitted)
    if torque is not None and np.ptp(torque):
        over.insert(0, (torque, f"{_LOOKS[name][0]} ({channels[name].unit})"))
    rows = np.r_[*record.segments]
    if gearing is not None and gearing.flank == "load":
        split, names = "the side that the load pulls to", ("load on its first side", "on the other")
        chosen = np.searchsorted(gearing.flank_times, record.time[rows]) % 2 == 0
    else:
        split, names = "the direction of motion", ("forwards", "backwards")
        chosen = compute_velocity(record, "load")[rows] > 0.0
    halves = list(zip((rows[chosen], rows[~chosen]), names, COLOURS, strict=False))
    y = Axis(f"θe − N₀ θs about its median ({channels['theta_e'].unit})")
    panels = [
        Panel(Axis(label), y, [cloud(x[half], twist[half], name, colour) for half, name, colour in halves])
        for x, label in over
    ]
    return Figure(
        "twist",
        panels,
        f"Twist θe − N₀ θs with N₀ = {inspection.gear_ratio:.5g}, by {split}. Over torque: the loop's "
        "width shows lost motion and friction, its slope compliance. Over position: a periodic twist shows eccentricity of "
        "encoders or gears.",
        columns=len(panels),
    )
