"""What `jaxbl watch` leaves: values over time as CSV, a summary, one figure, and a page."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pandas as pd

from jaxbl.files import catch_write_errors
from jaxbl.json_types import JsonObject
from jaxbl.lines import DOUBT, doubts_among
from jaxbl.monitoring.watch import INTERVAL, Watch, WatchTask, describe_counts
from jaxbl.records.signal_quality import find_runs
from jaxbl.result import KeyFigure, Result

from .numbers import lead_with_doubt
from .panels import SIDE_COLOURS, SIDES, VERMILION, Axis, Band, Figure, Line, Panel, Span, limits

VALUES = "watch.csv"
LABELS = {
    "half_gap": "half gap", "stiffness": "stiffness", "coulomb": "Coulomb friction", "viscous": "viscous friction",
}  # fmt: skip


def write(watch: Watch, folder: Path) -> str:
    """Write `watch.csv`. Returns the study's TOML."""
    watch.values.to_csv(folder / VALUES, index=False)
    return watch.task.config.to_toml()


def describe(watch: Watch) -> Result:
    """Say whether the gap has grown beyond its limit, and how large gap and stiffness are."""
    summary, task = watch.summary, watch.task
    last, limit, alarm = (summary[key] for key in ("last", "alarm_gap", "alarm"))
    units, count = summary["units"]["motor"], summary["values"]
    verdict, headline = "good", f"Watched: the numbers were determined at {summary['determined']} of {count} times."
    if alarm:
        verdict = "failed"
        headline = (
            f"ALARM from {alarm['t']:.1f} s on: the half gap is beyond {limit:g} {units['half_gap']}, "
            f"{alarm['half_gap']:.4g} ({alarm['half_gap_from']:.4g} to {alarm['half_gap_to']:.4g}) then."
        )
    elif summary["blind"]["longest"]:
        verdict = "failed"
        headline = (
            f"BLIND: no number for {summary['blind']['longest']:.4g} s, more than the {summary['blind']['limit']:g} s "
            f"stated; {summary['determined']} of {count} values were determined."
        )
    elif last is None:
        verdict = "no answer"
        headline = (
            f"Nothing was determined ({count} values): too little motion, too few ways through the gap, or less than "
            f"the window of {summary['window']:g} s."
        )
    elif limit is not None:
        gap = f"{last['half_gap']:.4g} {units['half_gap']} (95 %: at most {last['half_gap_to']:.4g})"
        headline = f"No alarm: the half gap, {gap}, is below the limit of {limit:g} {units['half_gap']}."
    figures = [
        KeyFigure(
            f"{end[name]:.4g} {units[name]}",
            f"{LABELS[name]} at {end['t']:.1f} s (95 %: {end[f'{name}_from']:.4g} to {end[f'{name}_to']:.4g})",
        )
        for name in ("half_gap", "stiffness")
        if last and name in last
        for end in (summary["first"], last)
    ]
    remarks = doubts_among(summary["notes"])
    if summary["contradictions"]:
        # before figures that it puts in doubt
        remarks.append(
            f"{DOUBT}motor and load give different gaps or stiffnesses at {summary['contradictions']} of {count} values: an "
            "inertia or a gain of the model is wrong, or something acts on one side that it lacks. The smaller gap counts."
        )
    if summary["left_out"]:
        remarks.append(f"Of the stream: {describe_counts(summary['left_out'])}.")
    title = task.config.title or f"Watch of {Path(task.name).name}"
    result = Result(title, verdict, headline, figures, remarks, summary["notes"])
    return result if verdict == "failed" else lead_with_doubt(result)


def open_values(folder: Path, task: WatchTask) -> Callable[[JsonObject], None]:
    """Return a function that adds values to `watch.csv`, which others can read at once; the first ones begin it anew."""
    mode = "w"

    def add(values: JsonObject) -> None:
        nonlocal mode
        row = pd.DataFrame([values], columns=task.columns)
        with catch_write_errors(folder):
            row.to_csv(folder / VALUES, mode=mode, header=mode == "w", index=False)
        mode = "a"

    return add


def draw(watch: Watch) -> Iterator[Figure]:
    """Gap, stiffness and friction over time."""
    if not len(watch.values):
        return
    task = watch.task
    caption = f"Numbers of the {task.window:g} s before each time by both observers, with 95 % intervals."
    if task.alarm_gap is not None:
        caption += " The alarm is on where the gap is beyond the limit with a probability of 99.9 %."
    # gap and stiffness are seen at once; friction, below, acts on a shaft of its own on each side
    law = [_panel(watch, name, *SIDES) for name in ("half_gap", "stiffness") if f"motor.{name}" in watch.values]
    friction = [_panel(watch, name, side) for name in ("coulomb", "viscous") for side in SIDES]
    if law:
        yield Figure("watch", law, caption, height=1.5)
    yield Figure("watch_friction", friction, caption, height=1.5)


def _panel(watch: Watch, name: str, *sides: str) -> Panel:
    """A number over time, by the observers of some sides."""
    values, limit, half = watch.values, watch.task.alarm_gap, 0.5 * watch.task.interval
    time, parts, curves, inside = values["t"].to_numpy(float), [], [], []
    if name == "half_gap" and limit is not None:
        inside = [limit]
        starts, ends = find_runs(values["alarm"].to_numpy(bool))
        parts += [
            Span(start, end, "alarm", VERMILION, opacity=0.12)
            for start, end in zip(time[starts] - half, time[ends - 1] + half, strict=True)
        ]
        parts.append(Span(limit, limit, "limit", along="y", width=1.2))
    for side in sides:
        middle, error = (values[f"{side}.{name}{kind}"].astype(float) for kind in ("", "_error"))
        low, high = middle - INTERVAL * error, middle + INTERVAL * error
        colour = SIDE_COLOURS[side]
        parts += [Band(time, low, high, "", colour), Line(time, middle, f"by the {side}'s observer", colour)]
        # what is hardly determined would set the scale of all else
        sure = error <= 3.0 * error.median()
        curves += [middle[sure], low[sure], high[sure]]
    lead = f"{sides[0]} " if len(sides) == 1 else ""
    y = Axis(f"{LABELS[name]}\n{lead}({watch.task.units[sides[0]][name]})", ends=limits(*curves, inside=inside))
    return Panel(Axis("time (s)", ends=(time[0] - half, time[-1] + half)), y, parts)
