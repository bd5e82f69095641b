"""What `jaxbl watch` leaves: values over time as CSV, a summary, one figure, and a page."""

import csv
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path

import numpy as np
import tomli_w

from jaxbl.files import catch_write_errors, json_with_checksum, open_draft, write_atomic
from jaxbl.json_types import JsonObject
from jaxbl.lines import DOUBT, doubts_among
from jaxbl.monitoring.watch import INTERVAL, Watch, WatchTask, describe_counts, watch_columns
from jaxbl.result import KeyFigure, Result, ResultTable

from .figures import SIDE_COLOURS, SIDES, VERMILION, Drawn, legend, limits, outline, stacked, stretches, style
from .numbers import lead_with_doubt

VALUES = "watch.csv"
SUMMARY = "watch.json"
_LABELS = {
    "half_gap": "half gap", "stiffness": "stiffness", "coulomb": "Coulomb friction", "viscous": "viscous friction",
}  # fmt: skip


def write_watch(watch: Watch, folder: Path) -> str:
    """Write `watch.csv` and `watch.json`. Returns the study's TOML."""
    with open_draft(folder / VALUES) as draft:
        watch.values.to_csv(draft, index=False)
    write_atomic(folder / SUMMARY, json_with_checksum(watch.summary))
    return tomli_w.dumps(watch.task.config.to_dict())


def describe_watch(watch: Watch) -> Result:
    """Say whether the gap has grown beyond its limit, and how large gap and stiffness are."""
    summary, task = watch.summary, watch.task
    last, limit, alarm = (summary[key] for key in ("last", "alarm_gap", "alarm"))
    units, count = summary["units"]["motor"], summary["values"]
    verdict, headline = "good", f"Watched: the numbers were determined at {summary['determined']} of {count} times."
    if limit is not None and alarm is not None:
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
        headline = f"No alarm: at none of {count} values was the half gap surely beyond {limit:g} {units['half_gap']}."
    ends = [summary[end] or {} for end in ("first", "last")]
    rows = [
        [f"{side}: {label}", *(values.get(f"{side}.{name}{kind}") for values in ends for kind in ("", "_error")),
         task.units[side][name]]
        for side, (name, label) in product(SIDES, _LABELS.items())
        if f"{side}.{name}" in watch.values
    ]  # fmt: skip
    columns = ["number", "first value", "standard error", "last value", "standard error", "unit"]
    figures = [
        KeyFigure(
            f"{end[name]:.4g} {units[name]}",
            f"{_LABELS[name]} at {end['t']:.1f} s (95 %: {end[f'{name}_from']:.4g} to {end[f'{name}_to']:.4g})",
        )
        for name in ("half_gap", "stiffness")
        if last is not None and name in last
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
    tables = [ResultTable("Numbers", columns, rows)]
    result = Result(title, verdict, headline, figures, remarks, summary["notes"], tables)
    return result if verdict == "failed" else lead_with_doubt(result)


@contextmanager
def values_file(folder: Path, task: WatchTask) -> Iterator[Callable[[JsonObject], None]]:
    """`watch.csv` while it grows, from the first values on: a function that adds values, which others can read at once."""
    mode = "w"

    def add(values: JsonObject) -> None:
        nonlocal mode
        nothing = {name: "" for name, value in values.items() if isinstance(value, float) and np.isnan(value)}
        with catch_write_errors(folder), (folder / VALUES).open(mode, newline="", encoding="utf-8") as file:
            out = csv.DictWriter(file, watch_columns(task))
            if mode == "w":
                out.writeheader()
            out.writerow(dict(values) | nothing)
        mode = "a"

    yield add


@style()
def draw_watch(watch: Watch) -> list[Drawn]:
    """Gap, stiffness and friction over time."""
    values, task = watch.values, watch.task
    law = [name for name in ("half_gap", "stiffness") if f"motor.{name}" in values]
    # friction of each side acts on a shaft of its own
    panels = [(name, SIDES) for name in law] + [(name, (side,)) for name in ("coulomb", "viscous") for side in SIDES]
    if not len(values):
        return []
    figure, axes = stacked(len(panels), 1.5)
    time = values["t"].to_numpy(float)
    for ax, (name, sides) in zip(axes, panels, strict=True):
        curves, inside = [], []
        for side in sides:
            middle, error = (values[f"{side}.{name}{kind}"].to_numpy(float) for kind in ("", "_error"))
            low, high = middle - INTERVAL * error, middle + INTERVAL * error
            samples, colour = outline(middle), SIDE_COLOURS[side]
            ax.fill_between(time[samples], low[samples], high[samples], color=colour, alpha=0.2, lw=0.0)
            ax.plot(time[samples], middle[samples], color=colour, label=f"by the {side}'s observer")
            curves += [middle, low, high]
        ax.set_ylabel(f"{_LABELS[name]}\n{f'{side} ' if len(sides) == 1 else ''}({task.units[sides[0]][name]})")
        if name == "half_gap" and task.alarm_gap is not None:
            inside = [task.alarm_gap]
            ax.axhline(task.alarm_gap, color="black", ls="--", lw=1.2, label="limit")
            for start, end in stretches(values["alarm"].to_numpy(bool)):
                ends = time[start] - 0.5 * task.interval, time[end - 1] + 0.5 * task.interval
                ax.axvspan(*ends, color=VERMILION, alpha=0.12, lw=0.0, label="alarm")
        # the first values of a stream may be wide
        ax.set_ylim(limits(*curves, share=0.02, shown=inside))
    axes[0].set_xlim(time[0] - 0.5 * task.interval, time[-1] + 0.5 * task.interval)
    legend(axes[0], 4)
    caption = f"Numbers of the last {task.window:g} s by both observers, with 95 % intervals."
    if task.alarm_gap is not None:
        caption += " The alarm is on where the gap is beyond the limit with a probability of 99.9 %."
    return [Drawn("watch", figure, caption)]
