"""What `jaxbl diagnose` leaves to be read: missing effects, their probability, and model errors before and after."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxbl.diagnosis.coordinates import CoordinateValues
from jaxbl.diagnosis.diagnose import Diagnosis
from jaxbl.diagnosis.judgement import CHECKS
from jaxbl.diagnosis.localise import Coordinate, Localised
from jaxbl.diagnosis.proof import ACTS
from jaxbl.diagnosis.residuals import Residual, narrow
from jaxbl.diagnosis.sentences import sentence_of
from jaxbl.json_types import JsonObject
from jaxbl.lines import DOUBT, percent
from jaxbl.quantity import Quantity, read_quantities
from jaxbl.records.least_squares import rms
from jaxbl.result import KeyFigure, Result, ResultTable

from .identify import draw_motor_alone
from .numbers import lead_with_doubt, number_table, write as write
from .panels import (
    BLUE,
    MISSING,
    ORANGE,
    SIDE_COLOURS,
    TIME,
    VERMILION,
    Axis,
    Band,
    Figure,
    Line,
    Panel,
    Span,
    cloud,
    intervals,
    missing_label,
    with_unit,
)

_CHANNELS = {
    "theta_e": "motor position", "theta_s": "load position", "velocity_motor": "motor speed", "velocity_load": "load speed",
    "torque_motor": "motor: missing torque", "torque_load": "load: missing torque",
}  # fmt: skip


def describe(summary: JsonObject) -> Result:
    """Say what the model lacks, how sure that is, and how much better it is with it, from a `diagnosis.json`."""
    verdict, headline = _verdict(summary)
    tables = [
        *[_history_table(summary)] * bool(summary["history"]),
        _gap_table(summary["gap"]),
        number_table("Parameters of the model", summary["parameters"]),
    ]
    title = summary["title"] or f"Diagnosis of {Path(summary['file']).name}"
    where = summary["where"] if summary["verdict"] != "unknown_effect" or summary["findings"] else {}
    residuals = (f"Residual of the model as given: {side['sentence']}." for side in where.values())
    details = [_held_out_sentence(summary["gap"]["holdout"]), *residuals, *summary["notes"]]
    figures, remarks = [*_key_figures(summary)], [*_reasons(summary)]
    return lead_with_doubt(Result(title, verdict, headline, figures, remarks, details, tables))


_FAR = 10.0
"""Torque over what [log] u says, from which on a unit is rather wrong."""


def _key_figures(summary: JsonObject) -> Iterator[KeyFigure]:
    """Errors of torque and position on held-out data, and the least certain of the likely effects."""
    gap = summary["gap"]
    errors = _errors_of_channels(gap)
    for channels in (("torque_motor", "torque_load"), ("theta_e", "theta_s")):
        if there := [name for name in channels if name in errors]:
            name = max(there, key=lambda name: _ratio(errors[name][0], errors[name][2]))
            before, after, _, limit = errors[name]
            change = f"{rms_text(before)} → {rms_text(after)} {gap['units'][name]}"
            yield KeyFigure(change, f"{_CHANNELS[name]}: rms error on held-out data (limit {rms_text(limit)})")
    if summary["findings"]:
        finding = min(summary["findings"], key=lambda finding: (not finding["likely"], finding["confidence"]))
        leaf, number = next(iter(read_quantities(finding["parameters"]).items()))
        yield KeyFigure(str(number), f"{finding['effect']}: {leaf}")
        yield KeyFigure(probability(finding["confidence"]), f"confidence that it is {finding['effect']}")
    elif summary.get("numbers_off"):
        numbers = {path: number for path, number in read_quantities(summary["parameters"]).items() if number.factor > 0.0}
        if numbers:
            path, number = max(numbers.items(), key=lambda named: abs(np.log(named[1].factor)))
            yield KeyFigure(str(number), f"{path}, {number.nominal:g} in the model: furthest off")


def _reasons(summary: JsonObject) -> Iterator[str]:
    """Say what stands against the answer, and what each effect is like."""
    if summary["contradictions"]:
        yield _contradiction_sentence(summary["contradictions"])
    yield from summary["warnings"]
    for finding in summary["findings"]:
        change = finding["parameters"].get("relative")
        if change and not 1.0 / _FAR < (gain := 1.0 + Quantity.read(change).value) < _FAR:
            doubt = f"{DOUBT}the torque would be {gain:.3g} times what u says"
            yield f"{doubt}: a unit, a factor or a sign in [log] may be wrong."
    if left := _sentence_on_the_rest(summary):
        yield left
    for finding in summary["findings"]:
        texts = ", ".join(f"{leaf} = {number}" for leaf, number in read_quantities(finding["parameters"]).items())
        support = ""
        if (z := finding.get("holdout_z")) is not None:
            way = "better" if z > 0.0 else "worse"
            support = f"; held-out data are predicted {way} with it, by {abs(z):.1f} standard errors"
        yield (
            f"{finding['effect']} (confidence {probability(finding['confidence'])}): {texts}; "
            f"{finding.get('in_log') or percent(finding['share']) + ' of the driving torque'}{support}."
        )
        if alternatives := finding["alternatives"]:
            names = ", ".join(f"{other['effect']} ({probability(other['confidence'])})" for other in alternatives)
            yield f"Not ruled out by this log in place of {finding['effect']}: {names}."
    yield from _failed_checks(summary)
    if added := summary.get("torque_tables"):
        yield _tables_sentence(added)


def _contradiction_sentence(contradictions: list[JsonObject]) -> str:
    """Name the numbers that the logs do not agree on."""
    numbers = []
    for number in contradictions:
        values = [f"{Quantity.read(by_log | {'unit': number['unit']})} by {by_log['log']}" for by_log in number["logs"]]
        numbers.append(f"{number['parameter']} is {' and '.join(values)}")
    return (
        f"By the logs {'; '.join(numbers)}. Was the load, the controller (a feedforward that u does not contain) or a unit "
        "another one?"
    )


_AS_WELL = "predicts new data as well as noise and the stated uncertainties allow"


def _verdict(summary: JsonObject) -> tuple[str, str]:
    """The verdict and the answer in one sentence."""
    findings, verdict = sorted(summary["findings"], key=lambda finding: not finding["likely"]), summary["verdict"]
    # what may as well be something unknown is there perhaps
    names = _join_words([f"{'' if finding['likely'] else 'perhaps '}{finding['effect']}" for finding in findings])
    them = "it" if len(findings) == 1 else "them"
    if summary["contradictions"]:
        return "no answer", "The logs contradict each other: one model cannot hold for all of them."
    if summary.get("numbers_off"):
        word, answer = _verdict(summary | {"numbers_off": 0})
        lead = "The numbers are further off than stated"
        if verdict == "no_discrepancy":
            return word, f"{lead}; no effect is needed. With fitted ones the model {_AS_WELL}."
        return word, f"{lead}. {answer}"
    if verdict == "no_discrepancy":
        return "good", f"Nothing is missing: the model {_AS_WELL}."
    if verdict == "explained":
        return "good", f"The model lacks {names}; with {them}, it {_AS_WELL}."
    if verdict == "not_tested":
        lead = f"By the log the model lacks {names}" if names else "The log shows nothing that the model lacks"
        return "doubtful", f"{lead}, but the held-out data cannot test that."
    alone, test = summary.get("backlash"), summary["gap"]["test"]
    if not names:
        gap = alone and alone["why"] and (alone["gain"] >= alone["needed"] or alone["unmet"])
        if gap and not test["failed"] and not test["remainder"]:
            return "no answer", "A gap might explain what is missing, but this log does not show it."
        return "no answer", "Something is missing that none of the known effects explains."
    if test["worse"]:
        return "failed", f"By the log the model lacks {names}, but it predicts the held-out data worse with {them}."
    quantity = "missing torque" if "backlash" not in summary else "motor's squared prediction error beyond noise"
    share = summary["explained_share"] or 0.0
    text = f"{100.0 * share:.{0 if share < 0.99 else 1}f} %" if share <= 0.999 else "more than 99.9 %"
    return "doubtful", (
        f"The model lacks {names}, but that is not all: on held-out data {'none' if share < 0.005 else text} of the "
        f"{quantity} is explained."
    )


def _sentence_on_the_rest(summary: JsonObject) -> str:
    """Say where something is left, or what to record where the proof could not test the model."""
    gap = summary["gap"]
    if summary["verdict"] == "unknown_effect":
        where = summary.get("where_after", summary["where"])
        return f"What is left: {'; '.join(side['sentence'] for side in where.values())}."
    if summary["verdict"] != "not_tested":
        return ""
    units = gap["units"]
    effects = {name: torque for name, torque in gap["test"]["untested"].items() if torque}
    torques = [
        f"{name} is {rms_text(torque['torque'])} {units['torque_motor']} rms there, {rms_text(torque['on_log'])} on the log"
        for name, torque in effects.items()
    ]
    lead = "Even a complete model may leave as much as moves there."
    if effects:
        lead = f"The held-out data would pass without it, too ({'; '.join(torques)})."
        # it acts there, but less than a complete model may leave
        if all(torque["torque"] > ACTS * torque["on_log"] for torque in effects.values()):
            way = "a motion in which it is a larger part of the torque, or one that is read with less noise"
            return f"{lead} Hold out {way}."
    reached = ", ".join(
        f"{_CHANNELS[name].removesuffix(': missing torque')}{' torque' if name.startswith('torque') else ''} "
        f"{rms_text(reach['log'])} {units[name]} (there {rms_text(reach['proof'])})"
        for name, reach in gap["range"].items()
    )
    return f"{lead} Hold out a log that reaches as far: {reached}."


def _tables_sentence(added: JsonObject) -> str:
    """Say what tables of torques without a name add."""
    torques = [
        f"{side} torque over {_join_words([table['over'].replace('turn', 'position within a turn') for table in tables])}"
        for side, tables in added["tables"].items()
    ]
    than = "" if added["holdout_z"] > 0.0 else ", which predict held-out data no better"
    return f"Not named, but in model.toml as tables: {_join_words(torques)}{than}."


def _join_words(words: Sequence[str]) -> str:
    """Join words as in a sentence: a, b and c."""
    return ", ".join([*words[:-2], " and ".join(words[-2:])])


def _failed_checks(summary: JsonObject) -> Iterator[str]:
    """Say why a model does not count as complete, one line each."""
    gap, test, over = summary["gap"], summary["gap"]["test"], {}
    left = {name: (after, limit) for name, (_, after, _, limit) in _errors_of_channels(gap).items()}
    # of each channel the test that shows it best
    for name in sorted(test["failed"], key=lambda name: -_ratio(*left[name])):
        channel, (error, limit) = name.split()[0], map(rms_text, left[name])
        over.setdefault(channel, f"{name} {error} {gap['units'][channel]} (at most {limit})")
    if over:
        yield (
            "More is left than noise, the uncertainty of the numbers and torques too small to be named account for "
            f"({100.0 * test['level']:.0f} % test): {'; '.join(over.values())}."
        )
    for path, z in test["far"].items():
        number = Quantity.read(summary["parameters"][path])
        change = f" to {number.factor:.3g} times its nominal value" if number.nominal else ""
        yield (
            f"{path} had to change{change}, {abs(z):.0f} times its [uncertainty]; this number and the effects found may "
            "offset each other. Check the noise of u, or raise [uncertainty] relative."
        )
    if test["little"]:
        yield f"{CHECKS['little']}."


def probability(value: float) -> str:
    """A probability in text: more digits near 1."""
    return "> 0.999" if value > 0.999 else f"{value:.3f}" if value > 0.99 else f"{value:.2f}"


def _held_out_sentence(holdout: JsonObject) -> str:
    place = f"On the last part of the log ({holdout['from']:.4g} to {holdout['to']:.4g} s), held out"
    if holdout["separate"]:
        place = f"On {Path(holdout['file']).name}"
    how = f"over windows of {holdout['window']:.2g} s" if holdout["window"] else "one sample ahead"
    return f"{place}, the motion is predicted {how}."


def rms_text(value: float | None) -> str:
    """An rms value in text; None is a run that diverged."""
    return "diverges" if value is None else f"{value:.3g}"


def _ratio(error: float | None, other: float | None) -> float:
    """Say how many times an error is larger than another one; infinitely many where a model diverges."""
    return np.inf if error is None or other is None else error / max(other, np.finfo(float).tiny)


def _history_table(summary: JsonObject) -> ResultTable:
    """Every model that was tried, in order."""
    rows = [
        [number, step["tried"], step["nats"], step["standard_errors"], "kept" if step["kept"] else "dropped", step["why"]]
        for number, step in enumerate(summary["history"], 1)
    ]
    head = ["step", "tried", "gain on the log (nats)", "by blocks of the log (standard errors)", "", "why"]
    return ResultTable("How the name was found", head, rows)


def _errors_of_channels(gap: JsonObject) -> dict[str, list[Any]]:
    """Held-out error before and after, noise, and the limit of a complete model, of each channel, and of slow torques."""
    errors = {
        name: [before, gap["holdout_rmse_after"][name], gap["noise_floor"][name], gap["expected"].get(name, {}).get("limit")]
        for name, before in gap["holdout_rmse_before"].items()
    }
    slow = gap.get("slow_torques", {}).items()
    return errors | {name: [torque[key] for key in ("before", "after", "noise", "limit")] for name, torque in slow}


def _gap_table(gap: JsonObject) -> ResultTable:
    rows = []
    for name, numbers in _errors_of_channels(gap).items():
        channel, *below = name.split(maxsplit=1)
        rows.append([", ".join([_CHANNELS[channel], *below]), gap["units"][channel], *numbers])
    return ResultTable("Held-out data, rms", ["channel", "unit", "before", "after", "noise", "complete model at most"], rows)


def draw(diagnosis: Diagnosis) -> Iterator[Figure]:
    """All figures of a diagnosis."""
    if not diagnosis.located:
        yield draw_motor_alone(diagnosis)
        return
    yield _over_time(diagnosis)
    unit = diagnosis.record.unit_of("motor.torque", "N m")
    for side, parts in diagnosis.residuals.items():
        yield draw_residual(parts, diagnosis.coordinates[side], diagnosis.located[side], unit)


def _over_time(diagnosis: Diagnosis) -> Figure:
    """Missing torque of each side, before and after."""
    panels, separate = [], diagnosis.summary["gap"]["holdout"]["separate"]
    for side, pieces in diagnosis.pairs.items():
        unit, bandwidth, parts = diagnosis.record.unit_of(f"{side}.torque", "N m"), diagnosis.located[side].bandwidth, []
        for before, after, held in pieces:
            if held and not separate:
                parts.append(Span(before.time[0], before.time[-1], "held out", ORANGE, opacity=0.18))
            # behind the low-pass that the analysis used
            (first, _), (last, _) = narrow(before, bandwidth), narrow(after, bandwidth)
            parts += [
                Line(first.time, first.torque, "before", VERMILION, 2.6, opacity=0.6),
                Band(last.time, -2.0 * last.deviation, 2.0 * last.deviation, "± 2 noise", MISSING, 0.75),
                Line(last.time, last.torque, "after", BLUE, 0.9),
            ]
        panels.append(Panel(TIME, Axis(missing_label(f"{side}:\n", unit)), parts))
    lead = f"Held-out log {diagnosis.holdout.path.name}: t" if separate else "T"
    caption = (
        f"{lead}orque that the model lacks, as given and with what was found, behind the low-pass that shows it most "
        "clearly. Of a complete model 19 in 20 samples lie within the grey band."
    )
    return Figure("before_after", panels, caption, height=2.4)


_SHOWN = ("speed", "turn", "load turn", "position", "load position", "twist", "acceleration")
_PANELS = 3
"""Coordinates that are drawn: as many as are wide enough side by side."""


def draw_residual(
    parts: Sequence[Residual], coordinates: Sequence[Mapping[str, CoordinateValues]], located: Localised, unit: str
) -> Figure:
    """Draw the residual torque of a side over the coordinates that explain most of it.

    Args:
        parts: of the record.
        coordinates: of each part, by name.
        located: what was found of these torques.
        unit: theirs.
    """
    by_name = located.coordinates
    names = [name for name in _SHOWN if name in by_name]
    # those that explain most, speed always
    drawn = sorted(names, key=lambda name: (name != "speed", -by_name[name].explained))[:_PANELS]
    lows, rows = zip(*(narrow(part, located.bandwidth) for part in parts), strict=True)
    torque = np.concatenate([low.torque for low in lows])
    noise = rms(np.concatenate([low.deviation for low in lows]))
    limit = 1.15 * max(np.quantile(np.abs(torque), 0.998), 2.5 * noise)
    y, panels = Axis(missing_label(f"{located.name}: ", unit), ends=(-limit, limit)), []
    for name in sorted(drawn, key=names.index):
        coordinate = by_name[name]
        values = np.concatenate([part[name].values[row] for part, row in zip(coordinates, rows, strict=True)])
        band = Span(-2.0 * noise, 2.0 * noise, "± 2 noise", MISSING, "y", 0.6)
        dots = cloud(values, torque, colour=SIDE_COLOURS[located.name])
        x = Axis(with_unit(f"{name} {coordinate.symbol}", coordinate.unit))
        panels.append(Panel(x, y, [band, dots, *_means(coordinate)], f"explains {100.0 * coordinate.explained:.0f} %"))
    sentence = sentence_of(located, unit)
    caption = (
        f"{sentence[:1].upper()}{sentence[1:]}. Dots are samples, marks with strokes the means of bins "
        "with twice their standard errors; hollow where a mean does not differ significantly from zero. Above: share of the "
        "power beyond the noise that a function of this coordinate alone explains, on data that it was not fitted to."
    )
    return Figure(f"residual_{located.name}", panels, caption, len(panels), max(3.2 * len(panels), 4.4))


def _means(coordinate: Coordinate) -> list[Line]:
    rows = [(0.5 * (bin_.low + bin_.high), bin_.mean, bin_.mean_error, bin_.mean_z) for bin_ in coordinate.regions]  # pyright: ignore
    x, y, error, z = np.transpose(rows)
    ends, points = intervals(x, y - 2.0 * error, y, y + 2.0 * error, "bin mean", upright=True, size=4.0)
    unsure = np.abs(z) <= 3.0
    hollow = points._replace(x=x[unsure], y=y[unsure], name="", fill="#FFFFFF")
    return [Line(x, y, width=1.0, opacity=0.7), ends, points, hollow]
