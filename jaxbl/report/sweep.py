"""What `jaxbl sweep` and `jaxbl plot` leave to be read: maps and lines, accuracy laws, tables."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false

import math
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd

from jaxbl.config import Config
from jaxbl.files import write_json
from jaxbl.gains.accuracy_laws import AGREEMENT, END_OF_SWEEP, Law, accuracy_laws
from jaxbl.gains.best_gains import NEARLY_AS_GOOD, BestGains, describe_margins
from jaxbl.lines import Lines, NextStep
from jaxbl.sweeps.metrics import SIDE_METRICS
from jaxbl.sweeps.points import Points
from jaxbl.sweeps.sweep import StudyResult

from .aggregates import Distinct, Groups, Rows, spread
from .figures import SIDES
from .maps import best_gains, draw, slope_text, unit_of, worst_runs
from .page import PageTable, write_report


def write_sweep_report(result: StudyResult, folder: Path, steps: Sequence[NextStep] = ()) -> Lines:
    """Write figures, `report.html`, and `laws.json` if figures ask for laws, into a study's folder.

    Args:
        result: the study.
        folder: that exists.
        steps: what the page says of what to try next.

    Returns:
        The lines for the terminal.
    """
    config, laws = result.config, accuracy_laws(result)
    drawn = draw(result, laws)
    survey = _Survey(result)
    axes = [
        [path, len(values), *((values.min(), values.max()) if pd.api.types.is_numeric_dtype(values) else "––")]
        for path, values in survey.values.items()
    ]
    tables = [PageTable("Axes", ["path", "values", "least", "largest"], axes), _metric_table(result)]
    if laws:
        write_json(folder / "laws.json", [law.to_dict() for law in laws])
        tables.insert(0, _law_table(laws))
    else:
        (folder / "laws.json").unlink(missing_ok=True)
    answer, *more = lead = [*headline(result, survey), *_law_lines(laws)]
    lines = [answer, _describe_study(config, survey), *more]
    write_report(folder, "Study", lines, drawn, tables, config, config.notes, steps)
    return lead


_DRIVES = {"two_inertia": "a drive of two inertias", "rigid": "a rigid drive"}


def _describe_study(config: Config, survey: "_Survey") -> str:
    """Say what was varied, in a sentence."""
    varied = []
    for path, values in survey.values.items():
        if not pd.api.types.is_numeric_dtype(values):
            varied.append(f"{path} ({', '.join(map(str, values))})")
        elif len(values) > 1:
            ends = f"{values.min():.4g} to {values.max():.4g} {unit_of(config, path)}"
            varied.append(f"{path} ({len(values)} values, {ends})")
    over = f", over {', '.join(varied)}" if varied else ""
    seeds = f", each with {config.sweep.seeds} sequences of encoder noise" if config.sweep.seeds > 1 else ""
    run = f"{config.run.duration:g} s, sampled every {1e3 * config.run.sample_period:g} ms"
    return f"Studied: {_DRIVES[config.drive.kind]} in runs of {run}{over}{seeds}."


class _Survey:
    """The numbers behind the sentences and the table of axes, found in one reading.

    Attributes:
        runs: their number; `even` those on points that are always simulated; `diverged`.
        converged: how many of the even ones converged, by side; none where the study does not say.
        best: the best gains, by side, and the worst runs with each pair of gains; none where the study does not say.
        values: all values of each axis.
    """

    def __init__(self, result: StudyResult):
        config = result.config
        paths = config.axis_paths
        metrics = [f"{side}.{name}" for side in SIDES for name in ("converged", "velocity_rmse", "margin_alpha")]
        metrics = [name for name in metrics if name in result.columns]
        self.sides = [side for side in SIDES if f"{side}.converged" in metrics]
        # a refined study has most of its runs at the boundary: a share of all runs would depend on the refinement
        points = Points(config) if config.sweep.refine is not None else None
        self.runs = self.even = self.diverged = 0
        self.converged = dict.fromkeys(self.sides, 0)
        self.best: dict[str, tuple[BestGains | None, pd.DataFrame]] = {}
        distinct = {path: Distinct() for path in paths}
        for frame in result.batches([*paths, "seed", "finite", *metrics]):
            even = frame if points is None else frame[points.on_coarse_grid(frame)]
            self.runs += len(frame)
            self.even += len(even)
            self.diverged += int((~frame["finite"].astype(bool)).sum())
            for path in paths:
                distinct[path].add(frame[[path]])
            for side in self.sides:
                self.converged[side] += int(even[f"{side}.converged"].sum())
        self.values = {path: values.frame()[path] for path, values in distinct.items()}
        for side in self.sides if config.sweep.design == "grid" else []:
            gains = [path for path in paths if path.startswith(f"observer.{side}.") and len(self.values[path]) > 1]
            if gains and f"{side}.velocity_rmse" in metrics:
                columns = [*paths, "finite", *(name for name in metrics if name.startswith(side))]
                groups = Groups(Rows(result, columns), gains, paths)
                runs = worst_runs(groups, f"{side}.velocity_rmse", f"{side}.margin_alpha" in metrics)
                self.best[side] = best_gains(runs), runs


def headline(result: StudyResult, survey: _Survey | None = None) -> Lines:
    """Say what a study found, in sentences."""
    survey = survey or _Survey(result)
    count, runs, so_far = f"{survey.runs} runs.", "them", ""
    if result.config.sweep.refine is not None:
        points = len(Points(result.config))
        simulated = survey.runs // result.config.sweep.seeds
        count = f"{simulated} of {points} grid points simulated ({100 * simulated / points:.2g} %), {count}"
        runs, so_far = "those on the coarse grid", " so far"
    if survey.sides:
        even = survey.even or math.nan
        shares = ", ".join(f"{100 * survey.converged[side] / even:.1f} % ({side})" for side in survey.sides)
        count += f" The observers converged in {shares} of {runs}."
    lines = [count]
    if not result.is_finished(survey.runs):
        lines.append(f"The study is not finished: it has {result.runs} runs{so_far}. Go on with 'jaxbl sweep'.")
    if survey.diverged:
        lines.append(f"{survey.diverged} runs diverged: finite = false in the table, grey in the figures.")
    return [*lines, *(f"{side}: {_best_line(*best)}" for side, best in survey.best.items())]


def _best_line(best: BestGains | None, runs: pd.DataFrame) -> str:
    """The best gains of a side, their margin, and how many others are as good."""
    if best is None:
        return "no gains converged in all runs with α above f⁺."
    row = runs.reset_index().iloc[best.index]
    place = ", ".join(f"{name} = {row[name]:.3g}" for name in runs.index.names)
    ends = (f" Its {gain} is the {way.replace('er', 'est')} of its axis." for gain, way in best.ends.items())
    return (
        f"best gains {place}: velocity error {row['error']:.3g} rad/s rms, the worst of their runs (least: "
        f"{best.least_error:.3g}). {describe_margins(best.margins)} {best.nearly_as_good} of {len(runs)} gains are as good "
        f"within {100 * NEARLY_AS_GOOD:g} %.{''.join(ends)}"
    )


def _law_lines(laws: list[Law]) -> Lines:
    """Say how many laws agree with theory, and each that does not."""
    if not laws:
        return []
    count = sum(law.agrees for law in laws)
    lines = [f"Accuracy laws: {count} of {len(laws)} have a slope within {AGREEMENT:g} of theory."]
    for law in laws:
        if not law.agrees:
            slope = "no power law" if law.fit is None else f"slope {slope_text(law.fit)}, theory {law.theory:g}"
            lines.append(f"{law.value} over {law.x} ({_place(law)}): {slope}; {_explain_ends(law)}.")
    return lines


def _explain_ends(law: Law) -> str:
    """Why a law ends below and above; the end of the sweep is named only where both ends are that."""
    if law.stops["below"] == law.stops["above"]:
        return law.stops["below"]
    return "; ".join(f"{end}: {law.stops[end]}" for end in ("below", "above") if law.stops[end] != END_OF_SWEEP)


def _place(law: Law) -> str:
    """The values that a line of a law is for; a word stands without its path."""
    pairs = {**law.series, **law.where}.items()
    return ", ".join(value if isinstance(value, str) else f"{path} = {value:g}" for path, value in pairs) or "all points"


def _law_table(laws: list[Law]) -> PageTable:
    rows = []
    for law in laws:
        line, slope, halves, ends = f"{law.value} over {law.x}", "no law", "–", "–"
        if law.fit is not None:
            slope, halves = slope_text(law.fit), f"{law.fit.half_slopes[0]:.2f}, {law.fit.half_slopes[1]:.2f}"
        if law.range is not None:
            ends = f"{law.range[0]:g} to {law.range[1]:g} ({law.in_range.sum()})"
        slope, halves, ends = (text.replace(" ", "\u00a0") for text in (slope, halves, ends))
        rows.append([line, _place(law), law.theory, slope, halves, law.agrees, ends, _explain_ends(law)])
    columns = ["error", "where", "theory", "slope", "halves", "agrees", "range (points)", "why it ends there"]
    return PageTable("Accuracy laws", columns, rows)


def _metric_table(result: StudyResult) -> PageTable:
    metrics = {f"{side}.{name}": metric for side, (name, metric) in product(SIDES, SIDE_METRICS.items())}
    metrics = {column: metric for column, metric in metrics.items() if column in result.columns}
    rows = Rows(result, metrics)

    def numbers() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for frame in rows:
            for i, column in enumerate(metrics):
                values = frame[column].to_numpy(float)
                values = values[np.isfinite(values)]
                yield np.full(len(values), i), values

    quantiles = spread(numbers, len(metrics), (0.05, 0.5, 0.95)).quantiles.T
    table = [
        [column, *(None if np.isnan(value) else value for value in row), metric.unit, metric.doc]
        for (column, metric), row in zip(metrics.items(), quantiles, strict=True)
    ]
    return PageTable("Metrics over all runs", ["metric", "5 %", "median", "95 %", "unit", "meaning"], table)
