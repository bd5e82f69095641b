"""What `jaxbl identify` leaves to be read: numbers with intervals, and what the log shows of motion, torque and gap."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxbl.identification.identify import Identification
from jaxbl.identification.search import is_noise
from jaxbl.json_types import JsonObject
from jaxbl.lines import DOUBT, Lines, NextStep

from .figures import SIDES
from .identify_figures import draw_identification
from .page import PageTable, write_results


def write_identification_report(found: Identification, folder: Path, steps: Sequence[NextStep] = ()) -> Lines:
    """Write `identification.json`, `model.toml`, `trace.parquet`, figures and report into a folder that exists.

    They are put there together when all are drawn; the page says what to try next (`steps`). Returns the lines for the
    terminal.
    """
    tables = [_parameter_table(found.summary)]
    if "regression" in found.summary["method"]:
        tables.append(_regression_table(found.summary["method"]["regression"]))
    if found.summary["method"]["recursive"]:
        tables.append(_recursive_table(found))
    lead, remarks = _headline(found.summary), _remarks(found.summary)
    title = found.config.title or f"Identification from {found.record.path.name}"
    return write_results(found, folder, "identification", title, lead, draw_identification(found), tables, remarks, steps)


def identification_lines(summary: JsonObject) -> Lines:
    """The lines for the terminal, from an `identification.json`."""
    return [*_headline(summary), *_remarks(summary)]


_FAR = 10.0
"""Factor between an inertia or a stiffness and its nominal value from which on a unit is rather wrong: data sheets and CAD
know them within a factor of two."""


def _headline(summary: JsonObject) -> Lines:
    far = [
        f"{path} is {one['value'] / one['nominal']:.3g} times its nominal value"
        for path, one in summary["parameters"].items()
        if path.endswith(("inertia", ".stiffness"))
        and one["nominal"]
        and one["value"] is not None
        and not 1.0 / _FAR < one["value"] / one["nominal"] < _FAR
    ]
    lines = [f"{DOUBT}{', '.join(far)}: a unit, a factor or a sign in [log] may be wrong."] if far else []
    # intervals do not count what a model lacks: that it does is said before them
    lines = [
        *summary["warnings"],
        *lines,
        *(line for complete, line in _residuals(summary) if not complete),
        *_backlash(summary),
    ]
    rejected = summary.get("rejected")
    if rejected and rejected["lacks"]:
        lines.append(_lacking(**rejected["lacks"]))
    for path, one in summary["parameters"].items():
        low, high = one["interval"]
        if None in (one["value"], one["standard_error"]):
            lines.append(f"{path}: not identifiable from this log.")
            continue
        unit = f" {one['unit']}" if one.get("unit") else ""
        reach = "for noise alone" if low is None else f"95 %: {low:.5g} to {high:.5g}"
        if rejected and low is not None:
            reach += ", if only a disturbance is missing"
        lines.append(f"{path} = {one['value']:.5g} ± {one['standard_error']:.2g}{unit}, {reach}.")
    return lines


def _lacking(equation: str, channel: str, share: float) -> str:
    """Say with what motion the torque goes that a model lacks."""
    return (
        f"{DOUBT}{100.0 * share:.0f} % of the torque that the model leaves over on the {equation} goes with its {channel}: "
        "an effect is missing. What it does to the numbers is not known: they have no 95 % intervals."
    )


def _backlash(summary: JsonObject) -> Lines:
    """What a log without the load's encoder says of a gap."""
    said = summary.get("backlash")
    if said is None:
        return []
    unit = summary["residual"]["motor"]["unit"]
    if not said["shown"]:
        return [f"No gap is shown: {said['why']}."]
    times = "1 crossing" if said["crossings"] == 1 else f"{said['crossings']} crossings"
    return [
        f"There is a gap: a half gap of {said['half_gap']:.4g} {unit} at the motor, from {times}; "
        "without it the motor's readings cannot be met."
    ]


def _remarks(summary: JsonObject) -> Lines:
    lines, unseen = [], (summary.get("backlash") or {}).get("why")
    for refusal in summary["refused"]:
        if refusal["why"] == unseen:
            continue
        shares = ", ".join(f"{path} {share:+.2f}" for path, share in refusal["direction"].items())
        lines.append(f"Not identifiable: {shares}: {refusal['why']}.")
    if summary["held"]:
        lines.append(f"Held at the nominal value, which the other numbers depend on: {', '.join(summary['held'])}.")
    lines += (line for complete, line in _residuals(summary) if complete)
    fit = summary["method"]["trajectory"]
    lines.append(
        "Fitted to the prediction errors of the motor over all of the log; the load moves as the model says."
        if "backlash" in summary
        else f"{fit['windows']} windows of {fit['window']:.3g} s with free initial states; {fit['starts_agreeing']} of "
        f"{fit['starts']} starts agree."
    )
    if not fit["converged"]:
        lines.append("The fit stopped before it reached its tolerance.")
    if summary["torque"]:
        lines.append(f"Torque error of the model, rms: {_shares(summary['torque'])}.")
    for side, one in summary.get("gains", {}).items():
        error = one["velocity_error"]
        lines.append(
            f"{side} observer: no gains that were tried follow the log; those in model.toml do not, either."
            if error is None
            else f"{side} observer: lambda = {one['lambda_']:.3g}, alpha = {one['alpha']:.3g}, chosen on the log for "
            f"f⁺ = {one['f_plus']:.3g}; its velocity differs from the smoothed one by {error:.2g} rms."
        )
    if "holdout" in summary:
        lines += _on_holdout(summary["holdout"])
    return [*lines, *summary["notes"]]


def _residuals(summary: JsonObject) -> list[tuple[bool, str]]:
    """Of each side, whether no more than noise is left of its positions, and a sentence that says so."""
    found = []
    for side, residual in summary["residual"].items():
        ratio = residual["rms"] / residual["noise"]
        lacking = (
            "noise of the torque, or something that the model lacks" if "backlash" in summary else "the model is incomplete"
        )
        meaning = "noise alone" if (complete := is_noise(residual)) else lacking
        size = f"{residual['rms']:.2g} {residual['unit']} rms"
        found.append((complete, f"{side}: position residual {size}, {ratio:.3g} times the noise: {meaning}."))
    return found


def _shares(torque: JsonObject) -> str:
    return ", ".join(f"{_share(one)} ({name})" for name, one in torque.items())


def _share(one: JsonObject, which: str = "") -> str:
    """A torque error as a share of the driving torque, or in its unit where nothing drives."""
    relative = one[f"{which}relative"]
    return f"{one[f'{which}rms']:.2g} {one['unit']} rms" if relative is None else f"{100.0 * relative:.2g} %"


def _on_holdout(holdout: JsonObject) -> Lines:
    name = Path(holdout["file"]).name
    lines = [
        f"On {name}, {side}: position residual over {holdout['window']:.3g} s {one['rms']:.2g} {one['unit']} rms, "
        f"{one['rms'] / one['noise']:.3g} times the noise; with the nominal numbers {one['nominal_rms']:.2g}."
        for side, one in holdout["position"].items()
    ]
    if holdout["torque"]:
        before = ", ".join(_share(one, "nominal_") for one in holdout["torque"].values())
        lines.append(f"On {name}, torque error rms: {_shares(holdout['torque'])}; with the nominal numbers {before}.")
    return lines


_COLUMNS = ["path", "value", "standard error", "95 % from", "to"]


def _row(path: str, one: JsonObject) -> list[Any]:
    return [path, one["value"], one["standard_error"], *one["interval"]]


def _parameter_table(summary: JsonObject) -> PageTable:
    parameters = summary["parameters"]
    rows = [[*_row(path, one), one.get("unit", ""), one.get("nominal")] for path, one in parameters.items()]
    columns = [*_COLUMNS, "unit", "nominal"]
    if any("profile_interval" in one for one in parameters.values()):
        columns += ["by profile from", "to"]
        rows = [row + one.get("profile_interval", [None, None]) for row, one in zip(rows, parameters.values(), strict=True)]
    title = "Parameters of a fit that leaves more than noise" if summary.get("rejected") else "Parameters"
    return PageTable(title, columns, rows)


def _regression_table(regression: JsonObject) -> PageTable:
    by = "with the measured transmitted torque" if regression["measured_transmitted_torque"] else "at smoothed motion"
    title = f"Least squares on the equations of motion, {by}, up to {regression['bandwidth']:.3g} Hz"
    return PageTable(title, _COLUMNS, [_row(path, one) for path, one in regression["parameters"].items()])


def _recursive_table(found: Identification) -> PageTable:
    rows = [[name, *(sides[side] for side in SIDES)] for name, sides in found.summary["method"]["recursive"].items()]
    return PageTable("Recursive identification, at the end of the log", ["", *(f"by the {side}" for side in SIDES)], rows)
