"""What `jaxbl identify` leaves to be read: numbers with intervals, and what the log shows of motion, torque and gap."""

from collections.abc import Mapping
from pathlib import Path

from jaxbl.estimation.identify import Identification
from jaxbl.estimation.search import is_noise
from jaxbl.json_types import JsonObject
from jaxbl.lines import DOUBT, Lines, percent
from jaxbl.quantity import Quantity, read_quantities
from jaxbl.result import KeyFigure, Result, ResultTable

from .identify_figures import draw as draw
from .numbers import lead_with_doubt, number_figures, number_table, write_fit


def write(result: Identification, folder: Path) -> str:
    """Write `identification.json`, `model.toml` and `trace.parquet`. Returns the model's TOML."""
    return write_fit(result, folder, "identification")


def describe(summary: JsonObject) -> Result:
    """Say whether the model explains the log, and which numbers it has, from an `identification.json`."""
    parameters = read_quantities(summary["parameters"])
    numbers = {path: number for path, number in parameters.items() if number.is_finite}
    complete = all(is_complete for is_complete, _ in _residuals(summary))
    size = "; ".join(f"{side}: {_size(residual)}" for side, residual in summary["residual"].items())
    verdict, headline = "good", f"The model explains the log: no more than noise is left of the positions ({size})."
    if not numbers:
        verdict, headline = "no answer", "This log identifies none of the model's numbers."
    elif not complete:
        verdict = "doubtful"
        headline = f"The model does not explain the log, so its numbers may be wrong: more than noise is left ({size})."
    tables = [_parameter_table(summary, parameters)]
    remarks = [*summary["warnings"], *_far_off(parameters)]
    if lacks := (summary.get("rejected") or {}).get("lacks"):
        remarks.append(
            f"{percent(lacks['share'])} of the torque left over on the {lacks['equation']} goes with its "
            f"{lacks['channel']}: an effect is missing."
        )
    remarks += [f"{path}: not identifiable from this log." for path in parameters if path not in numbers]
    title = summary["title"] or f"Identification from {Path(summary['file']).name}"
    figures = [*_backlash(summary), *number_figures(numbers)][:4]
    return lead_with_doubt(Result(title, verdict, headline, figures, remarks, _remarks(summary), tables))


_FAR = 10.0
"""Factor between an inertia or a stiffness and its nominal value from which on a unit is rather wrong: data sheets and CAD
know them within a factor of two."""


def _far_off(parameters: Mapping[str, Quantity]) -> Lines:
    """Say which inertias and stiffnesses cannot be what was given."""
    far = [
        f"{path} is {number.factor:.3g} times its nominal value"
        for path, number in parameters.items()
        if path.endswith(("inertia", ".stiffness")) and (number.factor <= 1.0 / _FAR or number.factor >= _FAR)
    ]
    return [f"{DOUBT}{', '.join(far)}: a unit, a factor or a sign in [log] may be wrong."] if far else []


def _backlash(summary: JsonObject) -> list[KeyFigure]:
    """Say what a log without the load's encoder shows of a gap."""
    gap = summary.get("backlash")
    if gap is None:
        return []
    if not gap["shown"]:
        return [KeyFigure("No gap is shown", gap["why"])]
    unit, count = summary["residual"]["motor"]["unit"], gap["crossings"]
    meaning = f"half gap at the motor, from {count} crossings; without it its readings cannot be met"
    return [KeyFigure(f"{gap['half_gap']:.4g} {unit}", meaning)]


def _remarks(summary: JsonObject) -> Lines:
    lines, unseen = [], (summary.get("backlash") or {}).get("why")
    for refusal in summary["refused"]:
        if refusal["why"] == unseen:
            continue
        shares = ", ".join(f"{path} {share:+.2f}" for path, share in refusal["direction"].items())
        lines.append(f"Not identifiable: {shares}: {refusal['why']}.")
    if summary["held"]:
        lines.append(f"Held at the nominal value, which the other numbers depend on: {', '.join(summary['held'])}.")
    lines += (line for _, line in _residuals(summary))
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
    for side, gains in summary.get("gains", {}).items():
        error = gains["velocity_error"]
        lines.append(
            f"{side} observer: no gains that were tried follow the log; those in model.toml do not, either."
            if error is None
            else f"{side} observer: lambda = {gains['lambda_']:.3g}, alpha = {gains['alpha']:.3g}, chosen on the log for "
            f"f⁺ = {gains['f_plus']:.3g}; its velocity differs from the smoothed one by {error:.2g} rms."
        )
    if "holdout" in summary:
        lines += _on_holdout(summary["holdout"])
    return [*lines, *summary["notes"]]


def _residuals(summary: JsonObject) -> list[tuple[bool, str]]:
    """For each side, whether no more than noise is left of its positions, and a sentence that says so."""
    meanings = [
        "noise of the torque, or something that the model lacks" if "backlash" in summary else "the model is incomplete",
        "noise alone",
    ]
    return [
        (complete := is_noise(residual), f"{side}: position residual {_size(residual)}: {meanings[complete]}.")
        for side, residual in summary["residual"].items()
    ]


def _size(residual: JsonObject) -> str:
    return f"{residual['rms']:.2g} {residual['unit']} rms, {residual['rms'] / residual['noise']:.3g} times the noise"


def _shares(torque: JsonObject) -> str:
    return ", ".join(f"{_share(error)} ({name})" for name, error in torque.items())


def _share(error: JsonObject, model: str = "") -> str:
    """A torque error as a share of the driving torque, or in its unit where nothing drives."""
    relative = error[f"{model}relative"]
    return f"{error[f'{model}rms']:.2g} {error['unit']} rms" if relative is None else percent(relative)


def _on_holdout(holdout: JsonObject) -> Lines:
    name = Path(holdout["file"]).name
    lines = [
        f"On {name}, {side}: position residual over {holdout['window']:.3g} s {_size(residual)}; with the nominal numbers "
        f"{residual['nominal_rms']:.2g}."
        for side, residual in holdout["position"].items()
    ]
    if holdout["torque"]:
        before = ", ".join(_share(error, "nominal_") for error in holdout["torque"].values())
        lines.append(f"On {name}, torque error rms: {_shares(holdout['torque'])}; with the nominal numbers {before}.")
    return lines


def _parameter_table(summary: JsonObject, parameters: Mapping[str, Quantity]) -> ResultTable:
    title = "Parameters of a fit that leaves more than noise" if summary.get("rejected") else "Parameters"
    table = number_table(title, parameters)
    profiles = [number.get("profile_interval") for number in summary["parameters"].values()]
    if not any(profiles):
        return table
    rows = [[*row, *(profile or (None, None))] for row, profile in zip(table.rows, profiles, strict=True)]
    return ResultTable(title, [*table.columns, "by profile from", "to"], rows)
