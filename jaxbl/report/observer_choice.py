"""What `jaxbl tune` with `tune.observers` leaves to be read: how many times the best observer's error each kind has."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false

from collections import Counter
from pathlib import Path

import numpy as np
import tomli_w

from jaxbl.config import Config
from jaxbl.gains.observer_choice import TIME_CONSTANT, ObserverChoice, runs_are_equal
from jaxbl.json_types import JsonObject
from jaxbl.lines import Lines
from jaxbl.result import Result, ResultTable

from .maps import axis_label
from .panels import (
    SIDE_COLOURS,
    Axis,
    Figure,
    Panel,
    Part,
    Span,
    intervals,
    name_rows,
    place_words,
)
from .tune import error_label, for_title, write_gains


def draw(choice: ObserverChoice) -> list[Figure]:
    """Draw each kind's error over the best one's with its interval, over all points, a panel for each side."""
    summary, panels = choice.summary, []
    points = summary["points"]
    for side in points[0]["sides"]:
        results = [point["sides"][side] for point in points]
        wins, rows, lost = Counter(result["best"] for result in results), {}, []
        for kind in summary["observers"]:
            compared = [result["kinds"][kind] for result in results if result["kinds"][kind]["ratio"] is not None]
            if not compared:
                lost.append(kind)
                continue
            low, ratio, high = (np.array([result[key] for result in compared]) for key in ("low", "ratio", "high"))
            text = _ratio(compared[0]) if len(points) == 1 else ""
            if wins[kind]:
                text = "best" if len(points) == 1 else f"best at {wins[kind]} of {len(points)} points"
            elif len(compared) < len(points):
                text = f"diverges, or is too slow, at {len(points) - len(compared)}"
            rows[kind] = np.median(ratio), low.min(), high.max(), text
        rows = dict(sorted(rows.items(), key=lambda row: row[1][0]))
        ratio, low, high, texts = zip(*rows.values(), strict=True) if rows else ((),) * 4
        names = [*rows, *lost]
        parts: list[Part] = [
            Span(1.0, 1.0, width=0.8, dashes="-"),
            *intervals(range(len(rows)), low, ratio, high, colour=SIDE_COLOURS[side]),
            place_words(high, range(len(rows)), texts),
            place_words([0.9] * len(lost), range(len(rows), len(names)), ["diverged, or too slow"] * len(lost)),
        ]
        x = Axis("times the best one's error", log=True, ends=(0.9, 1.2 * (2.0 + max(high, default=1.0)) ** 1.5))
        panels.append(Panel(x, name_rows(names), parts, side))
    caption = (
        f"{error_label(summary)} of each kind over the best one's, {_where(summary)}: geometric mean over noise seeds, with "
        "its 95 % interval where they differ."
    )
    if len(points) > 1:
        caption += f" Of {len(points)} points the median, and the range of their intervals."
    height = 0.9 + 0.34 * len(summary["observers"])
    return [Figure("observers", panels, caption, len(panels), 5.2 * len(panels), height)]


_RATIO = "ratio", "low", "high"


def _ratio(result: JsonObject) -> str:
    """The ratio, with its interval if runs differ; more digits where it would read as one."""
    ratio, low, high = (f"{result[key]:.{3 if abs(result[key] - 1.0) > 0.005 else 6}g}" for key in _RATIO)
    return ratio if runs_are_equal(result) else f"{ratio} ({low} to {high})"


def write(choice: ObserverChoice, folder: Path) -> str:
    """Write `tuning.json`, and of a single point `gains.toml`. Returns the study's TOML."""
    return write_gains(choice, folder, observer_toml(choice.summary))


def describe(choice: ObserverChoice) -> Result:
    """Say which kind of observer is best, and by how much."""
    config, summary = choice.config, choice.summary
    points, kind = summary["points"], summary.get("for_both_sides")
    verdict, headline = "good", f"Take {kind}: gains.toml has its gains."
    if not any(result["best"] for point in points for result in point["sides"].values()):
        verdict, headline = "failed", "All kinds of observers diverge, or are too slow."
    elif kind is None:
        headline = "Which observer is best depends on the point; the tables show where."
        if len(points) == 1:
            verdict, headline = "doubtful", "No kind converges on both sides."
    title, remarks = config.title or "Observers", choice_headline(summary)
    return Result(title, verdict, headline, (), remarks, summary["remarks"], _tables(config, summary))


def observer_toml(summary: JsonObject) -> str | None:
    """The kind that is best on both sides together, with its gains, as TOML that a study can `include`; None where several
    points were compared, or no kind converges on both sides."""
    kind = summary.get("for_both_sides")
    if kind is None:
        return None
    sides = {side: result["kinds"][kind] for side, result in summary["points"][0]["sides"].items()}
    lines = [
        f"# Observer chosen by 'jaxbl tune'{for_title(summary)}",
        f"# Objective: {summary['objective_metric']}, among {', '.join(summary['observers'])}.",
        '# To use it, put include = "gains.toml" at the top of a study and leave its own [observer] out.',
        "",
    ]
    gains = {side: dict(result["gains"]) for side, result in sides.items()}
    constants = {side: gains[side].pop(TIME_CONSTANT) for side in sides if TIME_CONSTANT in gains[side]}
    data: JsonObject = {"observer": {"kind": kind, **gains}}
    if constants:
        data["equivalent_control"] = {"time_constant": constants.get("motor")}
        if len(constants) > 1:
            times = ", ".join(f"{side}: {value:.3g} s" for side, value in constants.items())
            lines[-1:] = [f"# A study has one equivalent_control.time_constant; the best of each side: {times}.", ""]
    return "\n".join(lines) + tomli_w.dumps(data)


def _where(summary: JsonObject) -> str:
    """Which runs were compared."""
    runs = summary["holdout"]
    first, last = runs["seeds"]
    input_ = "the study's excitation, other noise" if runs["same_excitation"] else f"held out: {runs['excitation']['kind']}"
    return f"{input_}, {last - first + 1} seeds"


def choice_headline(summary: JsonObject) -> Lines:
    """Which kind is best on each side, at how many points, and what fails; the table has by how much."""
    lines = []
    for side in summary["points"][0]["sides"]:
        results = [point["sides"][side] for point in summary["points"]]
        counts = Counter(result["best"] for result in results if result["best"] is not None)
        shared = Counter(kind for result in results for kind in result["not_told_apart"])
        kinds = [
            f"{kind} is best at {count} of {len(results)} points" if len(results) > 1 else f"{kind} is best"
            for kind, count in counts.most_common()
        ]
        line = f"{side}: {', '.join(kinds) or 'all kinds diverge, or are too slow'}"
        if counts and shared:
            line += f"; not told apart from the best: {', '.join(shared)}"
        lost = dict.fromkeys(
            kind for result in results for kind, numbers in result["kinds"].items() if numbers["ratio"] is None
        )
        lines.append(f"{line}; diverge somewhere, or are too slow: {', '.join(lost)}." if counts and lost else f"{line}.")
    return lines


def _tables(config: Config, summary: JsonObject) -> list[ResultTable]:
    """A table for each side: every kind at every point."""
    tables, axes = [], summary["axes"] if len(summary["points"]) > 1 else []
    head = [*(axis_label(config, path) for path in axes), "observer", error_label(summary), "worst run", "times the best",
            "from", "to", "gains"]  # fmt: skip
    for side in summary["points"][0]["sides"]:
        rows = [
            [*(point["values"][path] for path in axes), kind, *(numbers[key] for key in ("error", "worst", *_RATIO)),
             ", ".join(f"{key} = {value:.4g}" for key, value in numbers["gains"].items())]
            for point in summary["points"]
            for kind, numbers in point["sides"][side]["kinds"].items()
        ]  # fmt: skip
        tables.append(ResultTable(f"{side}, {_where(summary)}", head, rows))
    return tables
