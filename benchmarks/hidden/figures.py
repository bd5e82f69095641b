"""Figures of the bench: confusions, calibration, rates by size, and the gap on held-out data."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from jaxbl.report.drawing import save_canvas, style
from jaxbl.report.panels import COLOURS

from .effects import LEVELS
from .outcomes import TARGETS, Outcome, calibration, calibration_error, confusion, wilson_interval


def draw(outcomes: Sequence[Outcome], folder: Path) -> list[Path]:
    """Draw what the outcomes give reason to."""
    files = []
    with style():
        for name, figure in (
            ("confusion", _confusion(outcomes)),
            ("calibration", _calibration(outcomes)),
            ("sizes", _sizes(outcomes)),
            ("gap", _gap(outcomes)),
        ):
            if figure is not None:
                files.append(save_canvas(figure, folder / f"{name}.png"))
    return files


def _confusion(outcomes: Sequence[Outcome]) -> Figure | None:
    rows, columns, counts = confusion(outcomes)
    if not rows:
        return None
    figure = Figure(figsize=(2.6 + 0.3 * len(columns), 2.2 + 0.26 * len(rows)))
    axes = figure.subplots()
    share = counts / counts.sum(1, keepdims=True)
    axes.imshow(np.ma.masked_equal(share, 0.0), cmap="Blues", vmin=0.0, vmax=1.3, aspect="auto")
    for i, j in zip(*np.nonzero(counts), strict=True):
        axes.text(j, i, str(counts[i, j]), ha="center", va="center", fontsize=8)
    for i, name in enumerate(rows):  # frames where it is right
        target = "unknown_effect" if name.startswith("unknown.") else name
        if target in columns:
            axes.add_patch(
                _frame(columns.index(target) - 0.5, i - 0.5, COLOURS[2] if counts[i, columns.index(target)] else "#999999")
            )
    axes.set_xticks(range(len(columns)), columns, rotation=90, fontsize=8)
    axes.set_yticks(range(len(rows)), rows, fontsize=8)
    axes.set_xticks(np.arange(-0.5, len(columns)), minor=True)
    axes.set_yticks(np.arange(-0.5, len(rows)), minor=True)
    axes.grid(False)
    axes.grid(which="minor", color="#EEEEEE", linewidth=0.5)
    axes.tick_params(which="both", length=0)
    axes.set_xlabel("said")
    axes.set_ylabel("hidden")
    axes.set_title("What is hidden and what is said (single, hard, none, unknown); frames: right")
    return figure


def _frame(x: float, y: float, colour: str):
    return Rectangle((x, y), 1.0, 1.0, fill=False, edgecolor=colour, linewidth=1.2, zorder=3)


def _calibration(outcomes: Sequence[Outcome]) -> Figure | None:
    rows = calibration(outcomes)
    if not rows:
        return None
    figure = Figure(figsize=(5.2, 5.4))
    axes, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    axes.plot([0, 1], [0, 1], color="#888888", linestyle="--", label="calibrated")
    x = [row["confidence"] for row in rows]
    y = np.array([row["right"] for row in rows])
    bounds = np.array([wilson_interval(round(row["right"] * row["count"]), int(row["count"])) for row in rows])
    errors = np.maximum([y - bounds[:, 0], bounds[:, 1] - y], 0.0)
    axes.errorbar(x, y, errors, marker="o", capsize=3, color=COLOURS[0], label="findings, 95 %")
    axes.set_ylabel("share that is right")
    axes.set_ylim(-0.02, 1.02)
    axes.legend(loc="upper left")
    axes.set_title(f"Confidence: expected calibration error {calibration_error(rows):.3f}")
    below.bar(x, [row["count"] for row in rows], width=0.05, color=COLOURS[5])
    below.set_xlabel("confidence")
    below.set_ylabel("findings")
    below.set_xlim(0.0, 1.02)
    return figure


def _sizes(outcomes: Sequence[Outcome]) -> Figure | None:
    names = {"single": "single", "new": "new", "hard": "hard", "pairs": "pairs, both", "unknown": "unknown, abstains"}
    groups = {kind: [outcome for outcome in outcomes if outcome.kind == kind] for kind in names}
    groups = {kind: kind_outcomes for kind, kind_outcomes in groups.items() if kind_outcomes}
    if not groups:
        return None
    aims = {kind: kind for kind in names} | {"unknown": "abstentions"}
    figure = Figure(figsize=(7.0, 3.6))
    axes = figure.subplots()
    width = 0.8 / len(LEVELS)
    for k, level in enumerate(LEVELS):
        for i, kind_outcomes in enumerate(groups.values()):
            group = [outcome for outcome in kind_outcomes if outcome.level == level]
            if not group:
                continue
            hits = sum(outcome.is_right for outcome in group)
            low, high = wilson_interval(hits, len(group))
            x, rate = i + (k - 1) * width, hits / len(group)
            colour = (COLOURS[5], COLOURS[0], COLOURS[6])[k]
            axes.bar(x, rate, 0.9 * width, color=colour, label=f"{100 * level:g} % of the torque" if not i else None)
            axes.errorbar(x, rate, [[max(rate - low, 0)], [max(high - rate, 0)]], color="#888888", capsize=2, linewidth=1)
            axes.text(x, 0.02, str(len(group)), ha="center", color="white", fontsize=8)
    for i, kind in enumerate(groups):
        target = TARGETS[aims[kind]][0]
        axes.plot([i - 0.45, i + 0.45], [target, target], color=COLOURS[1], label="asked for" if not i else None)
    axes.set_xticks(range(len(groups)), [names[kind] for kind in groups])
    axes.set_ylim(0.0, 1.02)
    axes.set_ylabel("share that is right")
    axes.grid(axis="x", visible=False)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def _gap(outcomes: Sequence[Outcome]) -> Figure | None:
    measured = [outcome for outcome in outcomes if outcome.hidden and outcome.reduction is not None]
    if not measured:
        return None
    figure = Figure(figsize=(6.4, 3.6))
    axes = figure.subplots()
    for i, kind in enumerate(("single", "hard", "pairs", "new")):
        left = np.sort(
            [
                max(1.0 - outcome.reduction, 1e-4)
                for outcome in measured
                if outcome.kind == kind and outcome.reduction is not None
            ]
        )
        if len(left):
            axes.step(
                left, np.arange(1, len(left) + 1) / len(left), where="post", color=COLOURS[i], label=f"{kind} ({len(left)})"
            )
    axes.axvline(1.0 - TARGETS["gap_reduction"][0], color="#888888", linestyle="--", label="asked for, median")
    axes.axvline(1.0, color=COLOURS[6], linewidth=0.8)
    axes.set_xscale("log")
    axes.set_xlabel("gap that is left on held-out data, share of the one before")
    axes.set_ylabel("share of cases")
    axes.set_ylim(0.0, 1.02)
    axes.legend(loc="upper left")
    return figure
