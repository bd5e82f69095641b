"""What `jaxbl identify` leaves to be read: intervals, residuals, the recursive identifier's path, the hysteresis."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from matplotlib.figure import Figure

from jaxbl.study.identification import Identification
from jaxbl.study.store import write_atomic

from .maps import SIDES, Drawn
from .page import TableOf, html
from .reports import save_all
from .style import COLOURS, style

_POINTS = 6000
_COLOUR = {"motor": COLOURS[0], "load": COLOURS[1]}


def write_identification_report(found: Identification, folder: Path) -> list[str]:
    """Write `identification.json`, `model.toml`, `trace.parquet`, figures and report into a folder that exists.

    Returns the lines for the terminal.
    """
    pictures = save_all(draw_identification(found), folder)
    draft = folder / "trace.draft"
    found.trace.to_parquet(draft, index=False)
    draft.replace(folder / "trace.parquet")
    model = found.model.resolved()
    if found.replays:
        model["excitation"] = {"kind": "recorded", "file": "trace.parquet", "time_column": "t", "torque_column": "u"}
    text = tomli_w.dumps(model)
    write_atomic(folder / "model.toml", text)
    lead, remarks = _headline(found.summary), _remarks(found.summary)
    tables = [_parameter_table(found)]
    if found.summary["method"]["recursive"]:
        tables.append(_recursive_table(found))
    title = found.config.title or f"Identification from {found.record.path.name}"
    page = html(title, lead, remarks, pictures, tables, text)
    write_atomic(folder / "report.html", page)
    # last: it marks the folder as finished
    write_atomic(folder / "identification.json", json.dumps(found.summary, indent=1, ensure_ascii=False))
    return [*lead, *remarks]


def identification_lines(summary: dict[str, Any]) -> list[str]:
    """What the terminal says of an `identification.json`."""
    return [*_headline(summary), *_remarks(summary)]


def _headline(summary: dict[str, Any]) -> list[str]:
    lines = []
    for path, one in summary["parameters"].items():
        low, high = one["interval"]
        unit = f" {one['unit']}" if one.get("unit") else ""
        lines.append(f"{path} = {one['value']:.5g} ± {one['standard_error']:.2g}{unit}, 95 %: {low:.5g} to {high:.5g}.")
    return lines


def _remarks(summary: dict[str, Any]) -> list[str]:
    lines = []
    for refusal in summary["refused"]:
        shares = ", ".join(f"{path} {share:+.2f}" for path, share in refusal["direction"].items())
        lines.append(f"Refused: {shares}: {refusal['why']}.")
    if summary["held"]:
        lines.append(f"Held at the nominal value, on which the others depend: {', '.join(summary['held'])}.")
    for side, residual in summary["residual"].items():
        ratio = residual["rms"] / residual["noise"]
        told = "the model leaves nothing but noise" if ratio < 1.1 else "the model does not explain all of it"
        lines.append(f"{side}: positions are met to {residual['rms']:.2g} rms, {ratio:.3g} times the noise; {told}.")
    fit = summary["method"]["trajectory"]
    lines.append(
        f"{fit['windows']} windows of {fit['window']:.3g} s with free initial states; {fit['starts_agreeing']} of "
        f"{fit['starts']} starts agree."
    )
    if not fit["converged"]:
        lines.append("The fit stopped before it met its tolerance.")
    return [*lines, *summary["notes"]]


def draw_identification(found: Identification) -> list[Drawn]:
    """All figures of an identification."""
    with style():
        drawn = [_intervals(found), _residuals(found)]
        if found.summary["method"]["recursive"]:
            drawn += [_path(found), _hysteresis(found)]
    return drawn


def _intervals(found: Identification) -> Drawn:
    fitted = {path: one for path, one in found.summary["parameters"].items() if "nominal" in one}
    figure = Figure(figsize=(7.0, 1.2 + 0.42 * len(fitted)), layout="constrained")
    ax = figure.subplots()
    for i, one in enumerate(fitted.values()):
        size = abs(one["nominal"]) or abs(one["value"]) or 1.0
        low, high = (100.0 * (end - one["nominal"]) / size for end in one["interval"])
        ax.plot([low, high], [i, i], color=COLOURS[0], lw=2.4, solid_capstyle="butt")
        ax.plot(100.0 * (one["value"] - one["nominal"]) / size, i, "o", color=COLOURS[0], ms=6)
    ax.axvline(0.0, color="black", lw=0.8)
    ax.set_yticks(range(len(fitted)), list(fitted))
    ax.set(xlabel="difference from the nominal value (% of it)", ylim=(len(fitted) - 0.5, -0.5))
    caption = "Values found with their 95 % intervals, correlation of the residuals counted; the line is the nominal value."
    return Drawn("intervals", figure, caption)


def _shown(found: Identification) -> Any:
    return found.trace.iloc[:: max(len(found.trace) // _POINTS, 1)]


def _residuals(found: Identification) -> Drawn:
    trace, residual = _shown(found), found.summary["residual"]
    figure = Figure(figsize=(7.0, 2.2 * len(residual) + 0.6), layout="constrained")
    axes = figure.subplots(len(residual), 1, sharex=True, squeeze=False).ravel()
    for ax, (side, one) in zip(axes, residual.items(), strict=True):
        ax.plot(trace["t"], trace[f"{side}.residual"], color=_COLOUR[side], lw=0.7)
        for sign in (-2.0, 2.0):
            ax.axhline(sign * one["noise"], color="black", lw=0.9, ls="--", label="± 2 noise" if sign > 0.0 else None)
        ax.set_ylabel(f"{side}: measured − model (rad)")
        ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1)
    axes[-1].set_xlabel("time (s)")
    return Drawn("residuals", figure, "What the fitted model leaves of the positions, window by window.")


def _path(found: Identification) -> Drawn:
    trace, names = _shown(found), list(found.summary["method"]["recursive"])
    figure = Figure(figsize=(7.0, 2.2 * len(names) + 0.4), layout="constrained")
    axes = figure.subplots(len(names), 1, sharex=True, squeeze=False).ravel()
    for ax, name in zip(axes, names, strict=True):
        for side in SIDES:
            ax.plot(trace["t"], trace[f"{side}.{name}"], color=_COLOUR[side], label=f"recursive, {side}")
        fitted = found.summary["parameters"].get(f"transmission.{name}")
        last = [trace[f"{side}.{name}"].to_numpy()[len(trace) // 4 :] for side in SIDES]
        ends = np.nanquantile(np.concatenate(last), [0.02, 0.98])
        if fitted is not None:
            ax.axhspan(*fitted["interval"], color=COLOURS[2], alpha=0.3)
            ax.axhline(fitted["value"], color=COLOURS[2], label="trajectory fit")
            ends = np.array([min(ends[0], fitted["interval"][0]), max(ends[1], fitted["interval"][1])])
        room = 0.25 * (ends[1] - ends[0]) + 1e-12
        ax.set(ylabel=name.replace("_", " "), ylim=(ends[0] - room, ends[1] + room))
    axes[0].legend(ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1)
    axes[-1].set_xlabel("time (s)")
    caption = (
        "The paper's recursive identification (27)-(28) by the equivalent control of both sides, beside the trajectory fit."
    )
    return Drawn("recursive", figure, caption)


def _hysteresis(found: Identification) -> Drawn:
    trace = _shown(found)
    figure = Figure(figsize=(6.0, 4.2), layout="constrained")
    ax = figure.subplots()
    for side in SIDES:
        ax.plot(trace["twist"], trace[f"{side}.torque_estimate"], ".", ms=1.8, color=_COLOUR[side], label=f"by the {side}")
    ax.set(xlabel="twist θe − N₀ θs (rad)", ylabel="transmitted torque, observed (N m)")
    ax.legend(markerscale=5)
    return Drawn("hysteresis", figure, "Transmitted torque by the equivalent control of each side over the measured twist.")


def _parameter_table(found: Identification) -> TableOf:
    rows: list[list[object]] = [
        [path, one["value"], one["standard_error"], *one["interval"], one.get("unit", ""), one.get("nominal")]
        for path, one in found.summary["parameters"].items()
    ]
    return TableOf("Parameters", ["path", "value", "standard error", "95 % from", "to", "unit", "nominal"], rows)


def _recursive_table(found: Identification) -> TableOf:
    rows: list[list[object]] = [
        [name, *(sides[side] for side in SIDES)] for name, sides in found.summary["method"]["recursive"].items()
    ]
    return TableOf("Recursive identification, at the end of the log", ["", *(f"by the {side}" for side in SIDES)], rows)
