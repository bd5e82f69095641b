"""What a row of the bench holds, as Markdown, JSON and a figure."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxbl.report.figures import COLOURS, save, style

from .machines import Case

TOOLS = ("nominal", "jaxbl", "stepwise", "pysindy", "mujoco")


@dataclass
class Row:
    """A case and what the tools say of it.

    Attributes:
        summary: of the diagnosis; empty where there is none.
        error: why there is none.
        expected: whether that error is what the bench expects of a recording that the package cannot read.
        seconds: of the diagnosis, compiling included.
        torques: held-out torque errors of all tools behind one low-pass, rms, N m (N).
        driving: what they are compared with: rms of the input on the held-out part, or of inertia times acceleration.
        rivals: what they say.
        margin: standard errors (16 blocks of held-out data) by which the squared error of jaxbl is below the best other's.
    """

    name: str
    split: str
    published: str
    cutoff: float
    unit: str = "N m"
    summary: dict[str, Any] = field(default_factory=dict)
    error: str = ""
    expected: bool = False
    seconds: float = 0.0
    torques: dict[str, float | None] = field(default_factory=dict)
    driving: float = 0.0
    rivals: dict[str, Any] = field(default_factory=dict)
    margin: float | None = None


def row_of(case: Case) -> Row:
    """A row with nothing in it yet."""
    return Row(case.name, case.split, case.published, case.cutoff)


def _number(value: float | None, digits: int = 3) -> str:
    return "–" if value is None or not np.isfinite(value) else f"{value:.{digits}g}"


def findings(summary: Mapping[str, Any]) -> list[str]:
    """Effects with confidence and numbers, and the model's own numbers."""
    lines = []
    for one in summary["findings"]:
        numbers = ", ".join(f"{name} {_value(about)}" for name, about in one["parameters"].items())
        lines.append(f"{one['effect']} ({one['confidence']:.2f}): {numbers}")
    for path, about in summary["parameters"].items():
        lines.append(f"{path} {_value(about)} (nominal {about['nominal']:.3g})")
    return lines or ["nothing"]


def _value(about: Mapping[str, Any]) -> str:
    error = f" ± {about['standard_error']:.1g}" if about["standard_error"] else ""
    return f"{about['value']:.4g}{error} {about['unit']}".rstrip()


def _rival(said: Mapping[str, Any]) -> str:
    if said["note"]:
        return said["note"]
    lines = []
    for name in said["names"]:
        gain = f" (-{said['gains'][name]:.0%} of rms)" if name in said["gains"] else ""
        lines.append(f"{name} {', '.join(f'{one:.3g}' for one in said['factors'][name])} {said['units'][name]}{gain}")
    return "<br>".join(lines) or "nothing"


def _errors(row: Row, kind: str) -> str:
    """Held-out errors of positions or torques: before, after, limit, noise; a line a channel."""
    gap, lines = row.summary["gap"], []
    for name, before in gap["holdout_rmse_before"].items():
        if name.startswith(kind):
            limit = (gap["expected"].get(name) or {}).get("limit")
            after, noise = gap["holdout_rmse_after"][name], gap["noise_floor"][name]
            mark = " **fails**" if name in _failed(gap["test"]) else ""
            lines.append(
                f"{name}: {_number(before)} → {_number(after)}, limit {_number(limit)}{mark}, noise {_number(noise)} "
                f"{gap['units'][name]}"
            )
    return "<br>".join(lines)


_REASONS = {
    "chance": "control: shuffled torque", "remainder": "search: a rest", "powerless": "the model as given passes",
    "little": "less than half of the missing torque", "contradicting": "logs contradict each other",
}  # fmt: skip
"""Reasons against a verdict, beside errors."""


def _failed(test: Mapping[str, Any]) -> list[str]:
    """Channels that failed at any bandwidth."""
    return list(dict.fromkeys(name.partition(" ")[0] for name in test["failed"]))


def markdown(rows: Sequence[Row], rivals: bool) -> str:
    """All rows as tables."""
    lines = ["| recordings | verdict | explained | named by jaxbl, and its numbers | known | s |"]
    lines += ["|---|---|---:|---|---|---:|"]
    for one in rows:
        where = f"{one.name}<br>{one.split}"
        if one.error:
            said = "has no torque" if one.expected else "no diagnosis"
            lines.append(f"| {where} | {said} | – | {one.error} | {one.published} | {one.seconds:.0f} |")
            continue
        share = one.summary["explained_share"]
        lines.append(
            f"| {where} | {one.summary['verdict']} | {'–' if share is None else f'{share:.1%}'} | "
            f"{'<br>'.join(findings(one.summary))} | {one.published} | {one.seconds:.0f} |"
        )
    done = [one for one in rows if not one.error]
    if not done:
        return "\n".join(lines if rows else ["no recordings"])
    lines += [
        "",
        "Held-out errors by jaxbl's own account, rms (before → after; a complete model stays below the limit):",
        "",
    ]
    lines += ["| recordings | positions | torques | failed tests |", "|---|---|---|---|"]
    for one in done:
        test = one.summary["gap"]["test"]
        why = [*_failed(test), *test["far"]]
        why += [text for key, text in _REASONS.items() if test[key]]
        lines.append(f"| {one.name} | {_errors(one, 'theta')} | {_errors(one, 'torque')} | {', '.join(why) or 'none'} |")
    lines += ["", *_compared(rows, rivals)]
    return "\n".join(lines)


def _compared(rows: Sequence[Row], rivals: bool) -> list[str]:
    some = [one for one in rows if one.torques]
    tools = TOOLS if rivals else TOOLS[:2]
    lines = ["Held-out torque error of the motor side behind one low-pass, rms, and its share of the driving torque:", ""]
    margin = [" against the best other |", "---:|"] if rivals else ["", ""]
    lines += [f"| recordings | low-pass | {' | '.join(tools)} |{margin[0]}", f"|---|---:|{'---:|' * len(tools)}{margin[1]}"]
    for one in some:
        cells = []
        for tool in tools:
            value = one.torques.get(tool)
            cells.append("–" if value is None else f"{value:.4g} {one.unit} ({value / one.driving:.1%})")
        if rivals:
            cells.append("–" if one.margin is None else f"{one.margin:+.1f} standard errors")
        lines.append(f"| {one.name} | {one.cutoff:g} Hz | {' | '.join(cells)} |")
    if rivals:
        lines += ["", "| recordings | stepwise least squares | pysindy | mujoco |", "|---|---|---|---|"]
        lines += [f"| {one.name} | {' | '.join(_rival(one.rivals[tool]) for tool in TOOLS[2:])} |" for one in some]
    return lines


def write(rows: Sequence[Row], text: str, folder: Path) -> list[Path]:
    """Leave the tables, JSON of each row, and the figure."""
    folder.mkdir(parents=True, exist_ok=True)
    made = [folder / "scores.md"]
    made[0].write_text(text + "\n", encoding="utf-8")
    for one in rows:
        made.append(folder / f"{one.name}.json")
        made[-1].write_text(json.dumps(asdict(one), indent=1), encoding="utf-8")
    some = [one for one in rows if one.torques and not one.error]
    if some:
        with style():
            made.append(save(_figure(some), folder / "torque_errors.png"))
    return made


_LOOKS = {
    "nominal": ("nominal model", COLOURS[6], "o"),
    "jaxbl": ("jaxbl", COLOURS[0], "D"),
    "stepwise": ("stepwise least squares", COLOURS[1], "s"),
    "pysindy": ("pysindy", COLOURS[3], "^"),
    "mujoco": ("mujoco.sysid", COLOURS[4], "v"),
}


_MOST = 300.0
"""Error in the figure at most, % of the driving torque: three times that of no model. A larger one is an arrow there."""


def _figure(rows: Sequence[Row]) -> Figure:
    figure = Figure(figsize=(9.6, 1.6 + 0.42 * len(rows)))
    left, right = figure.subplots(1, 2, sharey=True)
    for i, one in enumerate(rows):
        gap = one.summary["gap"]
        scale = gap["driving"]["motor"] or one.driving
        before, after = (100.0 * gap[f"holdout_rmse_{when}"]["torque_motor"] / scale for when in ("before", "after"))
        limit = 100.0 * gap["expected"]["torque_motor"]["limit"] / scale
        noise = 100.0 * gap["noise_floor"]["torque_motor"] / scale
        first = i == 0
        left.plot([before, after], [i, i], color="#BBBBBB", zorder=1)
        left.plot(before, i, "o", color=COLOURS[6], label="before" if first else "")
        left.plot(after, i, "D", color=COLOURS[0], label="after" if first else "")
        left.plot(
            [limit, limit],
            [i - 0.3, i + 0.3],
            color=COLOURS[1],
            linewidth=2.0,
            label="limit, full bandwidth" if first else "",
        )
        left.plot([noise, noise], [i - 0.3, i + 0.3], color="#999999", linestyle=":", label="noise" if first else "")
        for j, tool in enumerate(TOOLS):
            value = one.torques.get(tool)
            if value is not None:
                label, colour, marker = _LOOKS[tool]
                share = 100.0 * value / one.driving
                right.plot(
                    min(share, _MOST), i + 0.15 * (j - 2.0), marker if share <= _MOST else ">", color=colour,
                    label=label if first else "",
                )  # fmt: skip
    left.set_yticks(range(len(rows)), [one.name for one in rows])
    left.invert_yaxis()
    for axes, title in ((left, "by jaxbl's own account"), (right, "all tools behind one low-pass")):
        axes.set_xscale("log")
        axes.set_xlabel("held-out torque error, rms (% of the driving torque)")
        axes.set_title(title)
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16 if len(rows) > 4 else -0.3), ncols=2)
    return figure
