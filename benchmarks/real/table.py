"""Rows of the bench as Markdown, JSON and a figure."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxbl.report.drawing import save_canvas, style
from jaxbl.report.panels import COLOURS

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
    for finding in summary["findings"]:
        numbers = ", ".join(f"{name} {_value(number)}" for name, number in finding["parameters"].items())
        lines.append(f"{finding['effect']} ({finding['confidence']:.2f}): {numbers}")
    for path, number in summary["parameters"].items():
        lines.append(f"{path} {_value(number)} (nominal {number['nominal']:.3g})")
    return lines or ["nothing"]


def _value(number: Mapping[str, Any]) -> str:
    error = f" ± {number['standard_error']:.1g}" if number["standard_error"] else ""
    return f"{number['value']:.4g}{error} {number['unit']}".rstrip()


def _rival(result: Mapping[str, Any]) -> str:
    if result["note"]:
        return result["note"]
    lines = []
    for name in result["names"]:
        gain = f" (-{result['gains'][name]:.0%} of rms)" if name in result["gains"] else ""
        lines.append(
            f"{name} {', '.join(f'{factor:.3g}' for factor in result['factors'][name])} {result['units'][name]}{gain}"
        )
    return "<br>".join(lines) or "nothing"


def _errors(row: Row, kind: str) -> str:
    """Held-out errors of positions or torques: before, after, limit, noise; a line a channel."""
    gap, lines = row.summary["gap"], []
    for name, before in gap["holdout_rmse_before"].items():
        if name.startswith(kind):
            limit = (gap["expected"].get(name) or {}).get("limit")
            after, noise = gap["holdout_rmse_after"][name], gap["noise_floor"][name]
            mark = " **fails**" if name in _failed_checks(gap["test"]) else ""
            lines.append(
                f"{name}: {_number(before)} → {_number(after)}, limit {_number(limit)}{mark}, noise {_number(noise)} "
                f"{gap['units'][name]}"
            )
    return "<br>".join(lines)


_REASONS = {
    "remainder": "search: a rest", "worse": "the model as given predicts better",
    "little": "less than half of the missing torque", "contradicting": "logs contradict each other",
}  # fmt: skip
"""Reasons against a verdict, beside errors."""


def _failed_checks(test: Mapping[str, Any]) -> list[str]:
    """Channels that failed at any bandwidth."""
    return list(dict.fromkeys(name.partition(" ")[0] for name in test["failed"]))


def markdown(rows: Sequence[Row], rivals: bool) -> str:
    """All rows as tables."""
    lines = ["| recordings | verdict | explained | named by jaxbl, and its numbers | known | s |"]
    lines += ["|---|---|---:|---|---|---:|"]
    for row in rows:
        where = f"{row.name}<br>{row.split}"
        if row.error:
            status = "has no torque" if row.expected else "no diagnosis"
            lines.append(f"| {where} | {status} | – | {row.error} | {row.published} | {row.seconds:.0f} |")
            continue
        share = row.summary["explained_share"]
        lines.append(
            f"| {where} | {row.summary['verdict']} | {'–' if share is None else f'{share:.1%}'} | "
            f"{'<br>'.join(findings(row.summary))} | {row.published} | {row.seconds:.0f} |"
        )
    done = [row for row in rows if not row.error]
    if not done:
        return "\n".join(lines if rows else ["no recordings"])
    lines += [
        "",
        "Held-out errors by jaxbl's own account, rms (before → after; a complete model stays below the limit):",
        "",
    ]
    lines += ["| recordings | positions | torques | failed tests |", "|---|---|---|---|"]
    for row in done:
        test = row.summary["gap"]["test"]
        reasons = [*_failed_checks(test), *test["far"]]
        reasons += [text for key, text in _REASONS.items() if test[key]]
        lines.append(f"| {row.name} | {_errors(row, 'theta')} | {_errors(row, 'torque')} | {', '.join(reasons) or 'none'} |")
    lines += ["", *_compare_torques(rows, rivals)]
    return "\n".join(lines)


def _compare_torques(rows: Sequence[Row], rivals: bool) -> list[str]:
    compared = [row for row in rows if row.torques]
    tools = TOOLS if rivals else TOOLS[:2]
    lines = ["Held-out torque error of the motor side behind one low-pass, rms, and its share of the driving torque:", ""]
    margin = [" against the best other |", "---:|"] if rivals else ["", ""]
    lines += [f"| recordings | low-pass | {' | '.join(tools)} |{margin[0]}", f"|---|---:|{'---:|' * len(tools)}{margin[1]}"]
    for row in compared:
        cells = []
        for tool in tools:
            value = row.torques.get(tool)
            cells.append("–" if value is None else f"{value:.4g} {row.unit} ({value / row.driving:.1%})")
        if rivals:
            cells.append("–" if row.margin is None else f"{row.margin:+.1f} standard errors")
        lines.append(f"| {row.name} | {row.cutoff:g} Hz | {' | '.join(cells)} |")
    if rivals:
        lines += ["", "| recordings | stepwise least squares | pysindy | mujoco |", "|---|---|---|---|"]
        lines += [f"| {row.name} | {' | '.join(_rival(row.rivals[tool]) for tool in TOOLS[2:])} |" for row in compared]
    return lines


def write(rows: Sequence[Row], text: str, folder: Path) -> list[Path]:
    """Leave the tables, JSON of each row, and the figure."""
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / "scores.md"]
    files[0].write_text(text + "\n", encoding="utf-8")
    for row in rows:
        files.append(folder / f"{row.name}.json")
        files[-1].write_text(json.dumps(asdict(row), indent=1), encoding="utf-8")
    drawn = [row for row in rows if row.torques and not row.error]
    if drawn:
        with style():
            files.append(save_canvas(_figure(drawn), folder / "torque_errors.png"))
    return files


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
    for i, row in enumerate(rows):
        gap = row.summary["gap"]
        scale = gap["driving"]["motor"] or row.driving
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
            value = row.torques.get(tool)
            if value is not None:
                label, colour, marker = _LOOKS[tool]
                share = 100.0 * value / row.driving
                right.plot(
                    min(share, _MOST), i + 0.15 * (j - 2.0), marker if share <= _MOST else ">", color=colour,
                    label=label if first else "",
                )  # fmt: skip
    left.set_yticks(range(len(rows)), [row.name for row in rows])
    left.invert_yaxis()
    for axes, title in ((left, "by jaxbl's own account"), (right, "all tools behind one low-pass")):
        axes.set_xscale("log")
        axes.set_xlabel("held-out torque error, rms (% of the driving torque)")
        axes.set_title(title)
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16 if len(rows) > 4 else -0.3), ncols=2)
    return figure
