"""What `jaxbl tune` leaves to be read of a closed loop: tuned gains, their margins, and the error over each gain."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false

from pathlib import Path

import tomli_w

from jaxbl.files import write_atomic
from jaxbl.gains.loop_gains import LoopTuning
from jaxbl.gains.stages import set_keys
from jaxbl.json_types import JsonObject
from jaxbl.result import KeyFigure, Result, ResultTable
from jaxbl.sweeps.metrics import Metric, find_metric

from .maps import axis_label
from .panels import BLUE, Axis, Figure, Panel, arrange, cloud, mark, with_unit
from .tune import for_title


def draw(tuning: LoopTuning) -> list[Figure]:
    """Draw the error of all candidates over each gain."""
    summary, candidates, metric, panels = tuning.summary, tuning.candidates, _find_objective(tuning), []
    for path, gain in summary["gains"].items():
        parts = [
            cloud(candidates[path], candidates["error"], "tried", BLUE, marker="o", size=3.0),
            mark(gain, summary["error_in_search"], "tuned"),
        ]
        axes = Axis(axis_label(tuning.config, path), path, log=True), Axis(with_unit(metric.label, metric.unit), log=True)
        panels.append(Panel(*axes, parts))
    columns = arrange(len(panels))
    caption = "Error of the gains tried, the worst over all runs, over each of the gains searched together."
    return [Figure("loop_gains", panels, caption, columns, 3.6 * columns, 3.2)]


def _find_objective(tuning: LoopTuning) -> type[Metric]:
    return find_metric(tuning.summary["objective_metric"].split()[0])


def write(tuning: LoopTuning, folder: Path) -> None:
    """Write `gains.toml`."""
    summary = tuning.summary
    head = (
        f"# Gains of a loop chosen by 'jaxbl tune'{for_title(summary)}\n# Objective: {summary['objective_metric']}.\n"
        '# To use them, put include = "gains.toml" at the top of a study and leave its own gains out.\n\n'
    )
    write_atomic(folder / "gains.toml", head + tomli_w.dumps(set_keys({}, summary["gains"])))


def describe(tuning: LoopTuning) -> Result:
    """Say by how much the loop is better, and how far each gain is from where it no longer holds."""
    summary, compared, metric = tuning.summary, tuning.summary["compared"], _find_objective(tuning)
    # the study's own gains are not compared where they are the best ones
    tuned, study, remarks = summary["ranking"]["tuned"], summary["ranking"].get("study"), []
    if tuned["error"] is None:
        verdict, headline = "failed", "The gains fail under other noise: the loop diverges or does not settle in some run."
    elif study is None or tuned["ratio"] > 1.0:
        verdict, headline = "doubtful", "No gains tried are better than the study's own."
    else:
        verdict, headline = "good", f"Take these gains of the loop: {metric.label} {tuned['error']:.3g} {metric.unit}."
        if study["error"] is None:
            headline += " With the study's own the loop diverges or does not settle."
    if study and study["error"] and tuned["error"]:
        remarks.append(f"With the study's own gains it is {study['ratio']:.3g} times as much.")
    if ends := summary["at_range_end"]:
        remarks.append(f"Best at an end of the range searched: {', '.join(ends)}. Beyond it may be better ones.")
    figures = [KeyFigure(f"{gain:.4g}", path) for path, gain in list(summary["gains"].items())[:4]]
    numbers = [row["gains"] | row for row in compared.values()]
    rows = [[key, *(row[key] for row in numbers)] for key in numbers[0] if key != "gains"]
    tables = [
        ResultTable("Gains, and the worst of held-out runs", ["", *compared], rows), margin_table(summary["margins"])
    ]  # fmt: skip
    return Result(tuning.config.title or "Closed loop", verdict, headline, figures, remarks, tuning.config.notes, tables)


def margin_table(margins: JsonObject) -> ResultTable:
    """Make a table of the factors by which each gain of a loop may fall and rise."""
    rows = [[path, *(margin[way] or "64 and more" for way in ("down", "up"))] for path, margin in margins.items()]
    heading = "Factors by which a gain alone may change until the following error's range is twice as wide"
    return ResultTable(heading, ["gain", "divided by", "multiplied by"], rows)
