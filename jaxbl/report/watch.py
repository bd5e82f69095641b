"""What `jaxbl watch` leaves: values over time as CSV, a summary, one figure, and a page."""

import csv
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from jaxbl.files import catch_write_errors, json_with_checksum, open_draft, write_atomic
from jaxbl.json_types import JsonObject
from jaxbl.lines import Lines, NextStep, doubts_among
from jaxbl.monitoring.watch import INTERVAL, Watch, WatchTask, describe_counts, watch_columns

from .figures import COLOURS, SIDE_COLOURS, SIDES, Drawn, legend, limits, outline, stacked, style
from .page import PageTable, write_report

VALUES = "watch.csv"
SUMMARY = "watch.json"
_LABELS = {
    "half_gap": "half gap", "stiffness": "stiffness", "coulomb": "Coulomb friction", "viscous": "viscous friction",
}  # fmt: skip


def write_watch_report(found: Watch, folder: Path, steps: list[NextStep] | None = None) -> Lines:
    """Write `watch.csv`, `watch.json`, figures and report into a folder that exists. Returns the lines for the terminal."""
    with open_draft(folder / VALUES) as draft:
        found.values.to_csv(draft, index=False)
    units = found.task.units
    rows = []
    for side in SIDES:
        for name, label in _LABELS.items():
            if f"{side}.{name}" in found.values:
                first, last = (_at(one, side, name) for one in (found.summary["first"], found.summary["last"]))
                rows.append([f"{side}: {label}", *first, *last, units[side][name]])
    columns = ["number", "first value", "standard error", "last value", "standard error", "unit"]
    config = tomli_w.dumps(found.task.config.to_dict())
    lead, remarks = watch_lines(found.summary), found.summary["notes"]
    title = found.task.config.title or f"Watch of {Path(found.task.name).name}"
    lines = write_report(
        folder, title, lead, draw_watch(found), [PageTable("Numbers", columns, rows)], config, remarks, steps or []
    )
    write_atomic(folder / SUMMARY, json_with_checksum(found.summary))
    return lines


def _at(values: JsonObject | None, side: str, name: str) -> list[float | None]:
    return [(values or {}).get(f"{side}.{name}{end}") for end in ("", "_error")]


@contextmanager
def values_file(folder: Path, task: WatchTask) -> Iterator[Callable[[JsonObject], None]]:
    """`watch.csv` while it grows, from the first values on: a function that adds values, which others can read at once."""
    with ExitStack() as stack:
        out: csv.DictWriter[str] | None = None
        file: Any = None

        def add(values: JsonObject) -> None:
            nonlocal out, file
            nothing = {name: "" for name, value in values.items() if isinstance(value, float) and np.isnan(value)}
            with catch_write_errors(folder):
                if out is None:
                    file = stack.enter_context((folder / VALUES).open("w", newline="", encoding="utf-8"))
                    out = csv.DictWriter(file, watch_columns(task))
                    out.writeheader()
                out.writerow(dict(values) | nothing)
                file.flush()

        yield add


def watch_lines(summary: JsonObject) -> Lines:
    """The lines for the terminal, from a `watch.json`."""
    first, last, limit = summary["first"], summary["last"], summary["alarm_gap"]
    units, count = summary["units"]["motor"], summary["values"]
    lines = doubts_among(summary["notes"])
    if limit is not None and summary["alarm"] is not None:
        one = summary["alarm"]
        lines.append(
            f"ALARM from {one['t']:.1f} s on: the half gap is beyond {limit:g} {units['half_gap']}, "
            f"{one['half_gap']:.4g} ({one['half_gap_from']:.4g} to {one['half_gap_to']:.4g}) then."
        )
    elif limit is not None and last is not None:
        lines.append(f"No alarm: at none of {count} values was the half gap surely beyond {limit:g} {units['half_gap']}.")
    if last is None:
        lines.append(
            f"Nothing was determined ({count} values): too little motion, too few ways through the gap, or less than the "
            f"window of {summary['window']:g} s."
        )
        return [*lines, *_left_out(summary)]
    for name in ("half_gap", "stiffness"):
        if name in last:
            said = ", ".join(
                f"{one[name]:.4g} {units[name]} ({one[f'{name}_from']:.4g} to {one[f'{name}_to']:.4g}) at {one['t']:.1f} s"
                for one in ([first, last] if first["t"] < last["t"] else [last])
            )
            lines.append(f"{_LABELS[name].capitalize()}: {said}; 95 % intervals in brackets.")
    if summary["determined"] < count:
        lines.append(f"Not determined at {count - summary['determined']} of {count} values.")
    if summary["contradictions"]:
        # before figures that it puts in doubt
        lines.insert(
            0,
            f"Motor and load give different gaps or stiffnesses at {summary['contradictions']} of {count} values: an "
            "inertia or a gain of the model is wrong, or something acts on one side that it lacks. The smaller gap counts.",
        )
    return [*lines, *_left_out(summary)]


def _left_out(summary: JsonObject) -> Lines:
    return [f"Of the stream: {describe_counts(summary['left_out'])}."] if summary["left_out"] else []


@style()
def draw_watch(found: Watch) -> list[Drawn]:
    """Gap, stiffness and friction over time."""
    values, task = found.values, found.task
    law = [name for name in ("half_gap", "stiffness") if f"motor.{name}" in values]
    # friction of each side acts on a shaft of its own
    panels = [(name, SIDES) for name in law] + [(name, (side,)) for name in ("coulomb", "viscous") for side in SIDES]
    if not len(values):
        return []
    figure, axes = stacked(len(panels), 1.5)
    time = values["t"].to_numpy(float)
    for ax, (name, sides) in zip(axes, panels, strict=True):
        ends, inner = [], []
        for side in sides:
            middle = values[f"{side}.{name}"].to_numpy(float)
            half = INTERVAL * values[f"{side}.{name}_error"].to_numpy(float)
            at = outline(middle)
            ax.fill_between(time[at], (middle - half)[at], (middle + half)[at], color=SIDE_COLOURS[side], alpha=0.2, lw=0.0)
            ax.plot(time[at], middle[at], color=SIDE_COLOURS[side], label=f"by the {side}'s observer")
            inner.append(middle)
            ends += [middle - half, middle + half]
        label = f"{_LABELS[name]}\n" if len(sides) > 1 else f"{_LABELS[name]}\n{sides[0]} "
        ax.set_ylabel(f"{label}({task.units[sides[0]][name]})")
        beyond = task.alarm_gap if name == "half_gap" else None
        if beyond is not None:
            ax.axhline(beyond, color="black", ls="--", lw=1.2, label="limit")
            _mark_alarms(ax, time, values["alarm"].to_numpy(bool), task.interval)
        # the first values of a stream may be wide
        ax.set_ylim(limits(*inner, *ends, share=0.02, shown=() if beyond is None else (beyond,)))
    axes[0].set_xlim(time[0] - 0.5 * task.interval, time[-1] + 0.5 * task.interval)
    legend(axes[0], 4)
    caption = f"Numbers of the last {task.window:g} s by both observers, with 95 % intervals."
    if task.alarm_gap is not None:
        caption += " The alarm is on where the gap is beyond the limit with a probability of 99.9 %."
    return [Drawn("watch", figure, caption)]


def _mark_alarms(ax: Any, time: np.ndarray, alarm: np.ndarray, every: float) -> None:
    """Shade the times of an alarm."""
    edges = np.diff(np.concatenate([[0], alarm.astype(int), [0]]))
    starts, ends = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
    for i, (start, end) in enumerate(zip(starts, ends, strict=True)):
        label = "alarm" if i == 0 else None
        ax.axvspan(time[start] - 0.5 * every, time[end - 1] + 0.5 * every, color=COLOURS[1], alpha=0.12, lw=0.0, label=label)
