"""What `jaxbl diagnose` leaves to be read: missing effects, their probability, and model errors before and after."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from jaxbl.diagnosis.diagnose import Diagnosis
from jaxbl.json_types import JsonObject
from jaxbl.lines import DOUBT, Lines, NextStep

from .figures import COLOURS, FAINT, MISSING, Drawn, decades, legend, stacked, style, subplots, with_unit
from .motor_alone_figures import draw_motor_alone
from .page import PageTable, write_results
from .residuals import draw_residuals, missing_quantity, plot_torque

_BEFORE, _AFTER, _FLOOR, _HELD = COLOURS[1], COLOURS[0], COLOURS[6], COLOURS[4]
_CHANNELS = {
    "theta_e": "motor position", "theta_s": "load position", "velocity_motor": "motor speed", "velocity_load": "load speed",
    "torque_motor": "motor: missing torque", "torque_load": "load: missing torque",
}  # fmt: skip


def write_diagnosis_report(found: Diagnosis, folder: Path, steps: Sequence[NextStep] = ()) -> Lines:
    """Write `diagnosis.json`, `model.toml`, `trace.parquet`, figures and report into a folder that exists.

    They are put there together when all are drawn; the page says what to try next (`steps`). Returns the lines for the
    terminal.
    """
    summary = found.summary
    tables = [*_finding_tables(summary), *_history_tables(summary), _gap_table(summary["gap"]), _number_table(summary)]
    lead, remarks = _headline(found.summary), _remarks(found.summary)
    title = found.config.title or f"Diagnosis of {found.record.path.name}"
    return write_results(found, folder, "diagnosis", title, lead, draw_diagnosis(found), tables, remarks, steps)


def diagnosis_lines(summary: JsonObject) -> Lines:
    """The lines for the terminal, from a `diagnosis.json`."""
    return [*_headline(summary), *_remarks(summary)]


_FAR = 10.0
"""Factor between the torque and what [log] u says from which a unit is rather wrong: torque constants are known better."""


def _headline(summary: JsonObject) -> Lines:
    gains = [1.0 + one["parameters"]["relative"]["value"] for one in summary["findings"] if "relative" in one["parameters"]]
    lines = [
        f"{DOUBT}the torque would be {gain:.3g} times what u says: a unit, a factor or a sign in [log] may be wrong."
        for gain in gains
        if not 1.0 / _FAR < gain < _FAR
    ]
    lines = [*_contradiction_lines(summary), *summary["warnings"], *lines, verdict_sentence(summary)]
    for one in summary["findings"]:
        numbers = ", ".join(_number(leaf, number) for leaf, number in one["parameters"].items())
        lines.append(
            f"{one['effect']} (confidence {probability(one['confidence'])}): {numbers}; {_percent(one['share'])} of the "
            "driving torque."
        )
        if one["alternatives"]:
            others = ", ".join(f"{other['effect']} ({probability(other['confidence'])})" for other in one["alternatives"])
            lines.append(f"  Not ruled out by this log: {others}.")
    return [*lines, *_reasons(summary), *_gap_lines(summary["gap"]), *_table_lines(summary)]


def _contradiction_lines(summary: JsonObject) -> Lines:
    """Numbers that the logs do not agree on."""
    found = []
    for one in summary["contradictions"]:
        unit = f" {one['unit']}" if one["unit"] else ""
        said = [f"{by['value']:.3g} ± {by['standard_error']:.1g}{unit} by {by['log']}" for by in one["logs"]]
        found.append(f"{one['parameter']} is {' and '.join(said)}")
    if not found:
        return []
    return [
        f"The logs contradict each other: {'; '.join(found)}. One model cannot hold for both: was the load, the controller "
        "(a feedforward that u does not contain) or a unit another one?"
    ]


_NO_MORE = "no more is left on data not used for the fit than noise and the uncertainty of the model's numbers account for"


def verdict_sentence(summary: JsonObject) -> str:
    """The verdict in one sentence."""
    names = _listed([one["effect"] for one in summary["findings"]])
    them = "it" if len(summary["findings"]) == 1 else "them"
    if summary["verdict"] == "explained":
        return f"Explained: the model lacks {names}; with {them}, {_NO_MORE}."
    if summary["verdict"] == "no_discrepancy":
        return f"No discrepancy: {_NO_MORE}."
    if summary["verdict"] == "not_tested":
        return _not_tested(summary)
    where = "; ".join(one["sentence"] for one in summary.get("where_after", summary["where"]).values())
    alone, test = summary.get("backlash"), summary["gap"]["test"]
    complete = not test["failed"] and not test["remainder"]
    gap = alone and alone["why"] and (alone["gain"] >= alone["needed"] or alone["unmet"])
    if not names and gap and complete:
        return f"Unknown: a gap might explain what is missing, but this log does not show it: {where}."
    if not names:
        return f"Unknown: no known effect explains what is missing: {where}."
    if test["worse"]:
        return (
            f"Contradicted: by the log the model lacks {names}; data not used for the fit are predicted worse with {them}."
        )
    share, rest = _share(summary["explained_share"]), ", but not in a way that can be right"
    if not complete:
        rest = f". The rest is none of the known effects: {where}"
    what = "missing torque" if "backlash" not in summary else "squared prediction error of the motor beyond noise"
    return (
        f"Partly explained: the model lacks {names}; with {them}, {share} of the {what} is explained on data not "
        f"used for the fit{rest}."
    )


def _not_tested(summary: JsonObject) -> str:
    """What the proof could not test, and what to record."""
    gap = summary["gap"]
    names, units = [one["effect"] for one in summary["findings"]], gap["units"]
    found = f"by the log the model lacks {_listed(names)}" if names else "the log shows nothing that the model lacks"
    effects = {name: torque for name, torque in gap["test"]["untested"].items() if torque}
    torques = [
        f"{name} is {rms_text(torque['torque'])} {units['torque_motor']} rms there, {rms_text(torque['on_log'])} on the log"
        for name, torque in effects.items()
    ]
    found = f"Not tested: {found}; data not used for the fit cannot show it"
    # it acts there, but less than a complete model may leave
    if effects and all(torque["torque"] > 0.5 * torque["on_log"] for torque in effects.values()):
        more = "Hold out a motion in which it is a larger part of the torque, or one that is read with less noise"
        return f"{found} (a model without it would pass, too; {'; '.join(torques)}). {more}."
    why = "a model without it would pass, too" if torques else "even a complete model may leave as much as moves there"
    reached = ", ".join(
        f"{_CHANNELS[name].removesuffix(': missing torque')}{' torque' if name.startswith('torque') else ''} "
        f"{rms_text(reach['log'])} {units[name]} (there {rms_text(reach['proof'])})"
        for name, reach in gap["range"].items()
    )
    return f"{found} ({'; '.join([why, *torques])}). Hold out a log that reaches as far: {reached}."


def _percent(share: float) -> str:
    return f"{100.0 * share:.2g} %" if share < 0.1 else f"{100.0 * share:.0f} %"


_OVER = {"position": "position", "turn": "position within a turn", "speed": "speed"}


def _table_lines(summary: JsonObject) -> Lines:
    """What tables of torques without a name add."""
    if "torque_tables" not in summary:
        return []
    found, gap = summary["torque_tables"], summary["gap"]
    which = _listed(
        [f"{side} torque over {_listed([_OVER[one['over']] for one in tables])}" for side, tables in found["tables"].items()]
    )
    errors = "; ".join(
        f"{name} {rms_text(gap['holdout_rmse_after'][name])} -> {rms_text(value)} {gap['units'][name]}"
        for name, value in found["holdout_rmse"].items()
        if not name.startswith("velocity")
    )
    than = "" if found["holdout_z"] > 0.0 else ", which is no better"
    return [f"Not named, but added to model.toml as a table: {which}. On held-out data it takes {errors}{than}."]


def _share(value: float | None) -> str:
    if value is None or value < 0.005:
        return "none"
    return "more than 99.9 %" if value > 0.999 else f"{100.0 * value:.{0 if value < 0.99 else 1}f} %"


def _listed(words: Sequence[str]) -> str:
    """As in a sentence: a, b and c."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def _reasons(summary: JsonObject) -> Lines:
    """Why a model does not count as complete, one line each."""
    gap, test, lines = summary["gap"], summary["gap"]["test"], []
    if test["failed"]:
        over = [
            f"{name} {rms_text(value)} {gap['units'][name.partition(' ')[0]]} (at most {rms_text(limit)})"
            for name, value, limit in _plainest(gap)
        ]
        lines.append(
            "More is left than noise, the uncertainty of the numbers and torques too small to be named account for "
            f"({100.0 * test['level']:.0f} % test): {'; '.join(over)}."
        )
    for path, z in test["far"].items():
        number = summary["parameters"][path]
        change = f" by {number['value'] / number['nominal'] - 1.0:+.0%}" if number["nominal"] else ""
        lines.append(
            f"{path} had to change{change}, {abs(z):.0f} times its [uncertainty]: findings and it may compensate each "
            "other. Noise of the torque channel does it, or too small a relative."
        )
    if test["little"] and not test["failed"]:
        lines.append("It takes away less than half of the torque that is missing on the data not used for the fit.")
    if test["chance"]:
        lines.append("Shuffled in time, the torque that was added does as well.")
    return lines


def _plainest(gap: JsonObject) -> list[tuple[str, float | None, float | None]]:
    """Of each channel the failed test that shows it best, its error and limit: a torque may fail at several bandwidths."""
    slow = gap.get("slow_torques", {})
    tested = {name: (slow[name]["after"], slow[name]["limit"]) for name in slow}
    tested |= {name: (gap["holdout_rmse_after"][name], one["limit"]) for name, one in gap["expected"].items()}

    def excess(name: str) -> float:
        value, limit = tested[name]
        # of a model that diverges one of them is not finite
        return value / limit if value is not None and limit else float("inf")

    best: dict[str, str] = {}
    for name in sorted(gap["test"]["failed"], key=excess, reverse=True):
        best.setdefault(name.partition(" ")[0], name)
    return [(name, *tested[name]) for name in best.values()]


def _number(leaf: str, one: JsonObject) -> str:
    unit = f" {one['unit']}" if one.get("unit") else ""
    error = f" ± {one['standard_error']:.2g}" if one["standard_error"] else ""
    return f"{leaf} = {one['value']:.5g}{error}{unit}"


def probability(value: float) -> str:
    """A probability in text: more digits near 1."""
    return "> 0.999" if value > 0.999 else f"{value:.3f}" if value > 0.99 else f"{value:.2f}"


def _gap_lines(gap: JsonObject) -> Lines:
    before, after, floor, units = (gap[key] for key in ("holdout_rmse_before", "holdout_rmse_after", "noise_floor", "units"))
    if gap["holdout"]["separate"]:
        place = f"On {Path(gap['holdout']['file']).name}"
    else:
        place = f"On the last part of the log ({gap['holdout']['from']:.4g} to {gap['holdout']['to']:.4g} s), held out"

    def change(name: str, before: Mapping[str, float | None], after: Mapping[str, float | None]) -> str:
        return f"{name} {rms_text(before[name])} -> {rms_text(after[name])} {units[name]}"

    errors = [
        f"{change(name, before, after)} ({rms_text(floor[name])}; {rms_text(gap['expected'][name]['limit'])})"
        for name in before
        if not name.startswith("velocity")
    ]
    window = gap["holdout"]["window"]
    how = "predicted one sample ahead" if window is None else f"over windows of {window:.2g} s"
    lines = [f"{place}, {how}, rms (noise; most that a complete model leaves): {', '.join(errors)}."]
    run = gap["free_run"]
    if "after" in run:
        changes = [change(name, run["before"], run["after"]) for name in run["after"] if not name.startswith("velocity")]
        lines.append(f"In one free run: {'; '.join(changes)}.")
    elif run:
        lines.append(f"No free run is compared: {run['why_not']}.")
    return lines


def rms_text(value: float | None) -> str:
    """An rms value in text; None is a run that diverged."""
    return "diverges" if value is None else f"{value:.3g}"


def _remarks(summary: JsonObject) -> Lines:
    lines = []
    if summary["verdict"] != "unknown_effect" or summary["findings"]:
        lines += [f"Residual of the model as given: {one['sentence']}." for one in summary["where"].values()]
    observed = [text for name, one in summary["where"].items() if (text := _by_observer(name, one, summary["gap"]["units"]))]
    if observed:
        lines.append(f"By the observers' equivalent control: {'; '.join(observed)}.")
    left = {name: one for name, one in summary["rest"].items() if one["evidence"] is not None and one["evidence"] > 0.0}
    for name, one in sorted(left.items(), key=lambda pair: -pair[1]["evidence"]):
        side, _, kind = name.partition(".")
        lines.append(
            f"Remaining: {_FREE.get(kind, kind)} on the {side} side ({100.0 * one['share']:.2g} % of the driving torque, "
            f"evidence {one['evidence']:.3g} nats)."
        )
    after = summary["gap"]["holdout_rmse_after"]
    for name, control in summary["gap"]["controls"].items():
        effect = f" ({control['effect']})" if "effect" in control else ""
        channel = max(summary["gap"]["expected"], key=lambda name: _worse(control["rmse"], after, name))
        what = {"wrong": "the best model with another effect", "permuted": "the missing torque shuffled in time"}[name]
        left = control["rmse"][channel]
        error = "diverges"
        if left is not None:
            beaten = f"{abs(control['z']):.1f} standard errors {'worse' if control['z'] > 0.0 else 'better'}"
            unit = summary["gap"]["units"][channel]
            error = f"leaves {rms_text(left)} {unit} in {channel} in place of {rms_text(after[channel])}; it is {beaten}"
        lines.append(f"Control: {what}{effect} {error}.")
    return [*lines, *summary["notes"]]


def _worse(control: Mapping[str, float | None], after: Mapping[str, float | None], name: str) -> float:
    """How much larger a control's error is; most where it diverges."""
    one, other = control[name], after[name]
    return np.inf if one is None or other is None else one / max(other, np.finfo(float).tiny)


def _by_observer(side: str, where: JsonObject, units: Mapping[str, str]) -> str:
    """The residual by a side's observer; empty where there is none or it does not converge."""
    one = where.get("observed")
    if not one or not one["converged"]:
        return ""
    unit = units[f"torque_{side}"]
    if one["rms"] < _BEYOND * one["noise"]:
        return f"{side} side, no more than its noise ({rms_text(one['noise'])} {unit} rms)"
    return (
        f"{side} side, {rms_text(one['rms'])} {unit} rms (its noise {rms_text(one['noise'])}), correlation "
        f"{one['correlation']:.2f} with the smoother's"
    )


_BEYOND = 1.5
"""Ratio of an observer's residual to its noise up to which it counts as noise: above 1, as that noise is an estimate."""
_FREE = {
    "time": "a torque over time", "drift": "a drifting friction", "position": "a torque over position",
    "place": "a friction over position", "velocity": "a torque over velocity", "memory": "a presliding friction",
}  # fmt: skip


def _finding_tables(summary: JsonObject) -> list[PageTable]:
    rows: list[list[object]] = []
    for one in summary["findings"]:
        for leaf, number in one["parameters"].items():
            error = number["standard_error"] or None
            rows.append([one["effect"], probability(one["confidence"]), leaf, number["value"], error, number["unit"]])
        for other in one["alternatives"]:
            rows.append([f"or {other['effect']}", probability(other["confidence"]), "", "", "", ""])
    if not rows:
        return []
    return [PageTable("Missing effects", ["effect", "confidence", "parameter", "value", "standard error", "unit"], rows)]


def _history_tables(summary: JsonObject) -> list[PageTable]:
    """Every model that was tried, in order."""
    rows: list[list[object]] = [
        [number, step["tried"], step["nats"], step["standard_errors"], "kept" if step["kept"] else "dropped", step["why"]]
        for number, step in enumerate(summary["history"], 1)
    ]
    if not rows:
        return []
    head = ["step", "tried", "gain on the log (nats)", "by blocks of the log (standard errors)", "", "why"]
    return [PageTable("How the name was found", head, rows)]


def _gap_table(gap: JsonObject) -> PageTable:
    controls = gap["controls"]
    rows: list[list[Any]] = [
        [_CHANNELS[name], gap["units"][name], before, gap["holdout_rmse_after"][name], gap["noise_floor"][name]]
        + [gap["expected"].get(name, {}).get("limit")]
        + [one["rmse"].get(name) for one in controls.values()]
        for name, before in gap["holdout_rmse_before"].items()
    ]
    for name, one in gap.get("slow_torques", {}).items():
        channel, _, below = name.partition(" ")
        row = [f"{_CHANNELS[channel]}, {below}", gap["units"][channel], one["before"], one["after"], one["noise"]]
        rows.append([*row, one["limit"], *(None for _ in controls)])
    head = ["channel", "unit", "before", "after", "noise", "complete model at most", *controls]
    return PageTable("Held-out data, rms", head, rows)


def _number_table(summary: JsonObject) -> PageTable:
    rows = [
        [path, one["nominal"], one["value"], one["standard_error"], one["unit"]]
        for path, one in summary["parameters"].items()
    ]
    return PageTable("Parameters of the model", ["parameter", "as given", "fitted", "standard error", "unit"], rows)


@style()
def draw_diagnosis(found: Diagnosis) -> list[Drawn]:
    """All figures of a diagnosis."""
    if not found.located:
        return [_verdict(found.summary), *draw_motor_alone(found)]
    unit = found.record.unit_of("motor.torque", "N m")
    residuals = draw_residuals(found.residuals, found.coordinates, found.located, unit, found.observed)
    tables = [_tables(found)] if "torque_tables" in found.summary else []
    return [_verdict(found.summary), _over_time(found), *tables, *residuals]


def _tables(found: Diagnosis) -> Drawn:
    """Torques without a name, over position and speed, with their standard errors."""
    sides = found.summary["torque_tables"]["tables"]
    each = [(side, one) for side, tables in sides.items() for one in tables]
    figure, axes = subplots(11.0, 3.6, columns=len(each))
    for ax, (side, one) in zip(axes, each, strict=True):
        kind = "velocity" if one["over"] == "speed" else "position"
        points, torques, errors = (np.array(one[key]) for key in ("points", "torques", "errors"))
        ax.fill_between(points, torques - 2.0 * errors, torques + 2.0 * errors, color=FAINT, alpha=0.35, lw=0.0)
        ax.plot(points, torques, "o-", color=_AFTER, ms=4, lw=1.4)
        ax.axhline(0.0, color=FAINT, lw=0.8)
        unit = found.record.unit_of(f"{side}.{kind}", "rad/s" if kind == "velocity" else "rad")
        force = found.record.unit_of(f"{side}.torque", "N m")
        ax.set(
            xlabel=with_unit(f"{side} {_OVER[one['over']]}", unit),
            ylabel=with_unit(f"{side}: resisting {missing_quantity(force)}", force),
        )
    caption = (
        "What none of the known effects explains, as tables in model.toml: the torque that resists motion "
        "beside the named effects. Band: two standard errors. Held-out data are predicted better with it."
    )
    return Drawn("torque_tables", figure, caption)


def _verdict(summary: JsonObject) -> Drawn:
    """Each channel's error over its noise, before and after, with the controls; and the probability of each effect."""
    gap = summary["gap"]
    names = list(gap["holdout_rmse_before"])
    bars = _bars(summary)
    height = max(0.55 * len(names) + 1.9, 0.42 * len(bars) + 1.9)
    figure, (left, right) = subplots(11.0, height, columns=2, width_ratios=[2.3, 1.0])
    _gap_panel(left, gap, names)
    _chances_panel(right, bars)
    caption = (
        f"{verdict_sentence(summary)} Left: rms error on held-out data over the channel's noise; arrows lead from the model "
        "as given to the model with the missing effects. Black line: noise; bars: the most that noise, the uncertainty of "
        "the numbers and torques too small to be named leave of a complete model. Controls, which must do worse: "
        "another effect at its best, and the added torque shuffled in time. Right: probability of each effect, and of those "
        "that this log does not rule out instead."
    )
    return Drawn("gap", figure, caption)


def _gap_panel(ax: Axes, gap: JsonObject, names: list[str]) -> None:
    floor = np.array([gap["noise_floor"][name] for name in names])

    def over(errors: Mapping[str, float | None]) -> np.ndarray:
        return np.array([errors.get(name) for name in names], float) / floor

    rows = np.arange(len(names))
    before, after = over(gap["holdout_rmse_before"]), over(gap["holdout_rmse_after"])
    for row, start, stop in zip(rows, before, after, strict=True):
        # an arrow for a change of less than 25 % would be shorter than its head
        if np.isfinite([start, stop]).all() and abs(np.log(start / stop)) > 0.25:
            ax.annotate("", (stop, row), (start, row), arrowprops={"arrowstyle": "-|>", "color": FAINT, "lw": 1.2})
    ax.plot(before, rows, "D", color=_BEFORE, ms=7, ls="none", label="before", zorder=4)
    ax.plot(after, rows, "o", color=_AFTER, ms=7, ls="none", label="after", zorder=5)
    ax.axvline(1.0, color=_FLOOR, lw=1.6, label="noise")
    limits = np.array([gap["expected"].get(name, {}).get("limit", np.nan) for name in names], float) / floor
    ax.plot(limits, rows, "|", color=_FLOOR, ms=16, mew=2.0, ls="none", label="a complete model at most", zorder=3)
    markers = {"wrong": ("x", "another effect"), "permuted": ("+", "shuffled in time")}
    every = [before, after, limits]
    for name, control in gap["controls"].items():
        marker, label = markers[name]
        if "effect" in control:
            label = f"{label} ({control['effect']})"
        every.append(over(control["rmse"]))
        ax.plot(every[-1], rows + 0.24, marker, color=FAINT, ms=7, mew=1.6, ls="none", label=f"control: {label}")
    values = np.concatenate(every)
    values = values[np.isfinite(values) & (values > 0.0)]
    ax.set(
        xscale="log",
        xlim=(0.5 * min(float(values.min(initial=1.0)), 1.0), 2.0 * max(float(values.max(initial=1.0)), 3.0)),
        ylim=(len(names) - 0.4, -0.6),
        xlabel="rms error on held-out data over noise",
    )
    decades(ax, "x")
    labels = [
        f"{_CHANNELS[name]}\n{rms_text(start)} → {rms_text(gap['holdout_rmse_after'][name])} {gap['units'][name]}"
        for name, start in gap["holdout_rmse_before"].items()
    ]
    ax.set_yticks(rows, labels, fontsize=9)
    legend(ax, 3, loc="lower left", bbox_to_anchor=(-0.02, 1.0), borderaxespad=0.2)


def _bars(summary: JsonObject) -> list[tuple[str, float, bool]]:
    """Effects, their probabilities, and whether they are findings."""
    bars: list[tuple[str, float, bool]] = []
    for one in summary["findings"]:
        bars.append((one["effect"], one["confidence"], True))
        bars += [(f"or {other['effect']}", other["confidence"], False) for other in one["alternatives"]]
    return bars


def _chances_panel(ax: Axes, bars: list[tuple[str, float, bool]]) -> None:
    ax.set_xlim(0.0, 1.0)
    ax.set_xlabel("confidence")
    if not bars:
        ax.set_yticks([])
        ax.text(0.5, 0.5, "no effect named", transform=ax.transAxes, ha="center", va="center", color=FAINT)
        return
    rows = np.arange(len(bars))
    ax.barh(rows, [chance for _, chance, _ in bars], 0.3, color=[_AFTER if sure else MISSING for _, _, sure in bars])
    for row, (name, chance, _) in zip(rows, bars, strict=True):
        ax.text(0.0, row - 0.22, f" {name}: {probability(chance)}", ha="left", va="bottom", fontsize=9)
    ax.set_yticks([])
    ax.set_ylim(max(len(bars), 3) - 0.4, -0.8)
    ax.grid(visible=False, axis="y")


def _over_time(found: Diagnosis) -> Drawn:
    """Missing torque of each side, before and after."""
    figure, axes = stacked(len(found.pairs), 2.4)
    for ax, (side, pieces) in zip(axes, found.pairs.items(), strict=True):
        unit = found.record.unit_of(f"{side}.torque", "N m")
        bandwidth = found.located[side].bandwidth
        for before, after, held in pieces:
            plot_torque(ax, before, bandwidth, noise=False, color=_BEFORE, lw=2.6, alpha=0.6, label="before")
            plot_torque(ax, after, bandwidth, color=_AFTER, lw=0.9, label="after")
            if held and not all(other for _, _, other in pieces):
                ax.axvspan(before.time[0], before.time[-1], color=_HELD, alpha=0.18, lw=0.0, zorder=0, label="held out")
        ax.set_ylabel(with_unit(f"{side}:\nmissing {missing_quantity(unit)}", unit))
        legend(ax, 4)
    which = f"Held-out log {found.holdout.path.name}: t" if found.summary["gap"]["holdout"]["separate"] else "T"
    caption = (
        f"{which}orque that the model lacks, as given and with the missing effects added, after the low-pass that shows it "
        "most clearly. A complete model stays within the grey band."
    )
    return Drawn("before_after", figure, caption)
