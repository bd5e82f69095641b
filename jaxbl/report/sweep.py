"""What `jaxbl sweep` and `jaxbl plot` leave to be read: maps and lines, accuracy laws, tables."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false

import math
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd

from jaxbl.config import Config, numeric_paths
from jaxbl.files import write_json
from jaxbl.gains.accuracy_laws import AGREEMENT, END_OF_SWEEP, Law, accuracy_laws
from jaxbl.gains.best_gains import NEARLY_AS_GOOD, BestGains, describe_margins
from jaxbl.lines import Lines, NextStep
from jaxbl.sweeps.metrics import SIDE_METRICS
from jaxbl.sweeps.points import Points
from jaxbl.sweeps.sweep import StudyResult

from .aggregates import Distinct, Groups, Rows, spread
from .figures import SIDES
from .maps import best_gains, draw, worst_runs
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
    laws = accuracy_laws(result)
    drawn = draw(result, laws)
    survey = _Survey(result)
    if laws:
        write_json(folder / "laws.json", [law.to_dict() for law in laws])
    else:
        (folder / "laws.json").unlink(missing_ok=True)
    lead = [*_headline(result, survey), *_law_lines(laws)]
    tables = [*([_law_table(laws)] if laws else []), _axes_table(survey), _metric_table(result)]
    config = result.config
    answer, *more = lead
    shown = [answer, _studied(config, survey), *more]
    write_report(folder, config.title or "Study", shown, drawn, tables, config.to_toml(), config.notes, steps)
    return lead


_DRIVES = {"two_inertia": "a drive of two inertias", "rigid": "a rigid drive"}


def _studied(config: Config, found: "_Survey") -> str:
    """What was varied, in a sentence."""
    units, varied = numeric_paths(config), []
    for path, values in found.values.items():
        if not pd.api.types.is_numeric_dtype(values):
            varied.append(f"{path} ({', '.join(map(str, values))})")
        elif len(values) > 1:
            unit = f" {units[path].unit}" if path in units else ""
            varied.append(f"{path} ({len(values)} values, {values.min():.4g} to {values.max():.4g}{unit})".rstrip())
    over = f", over {', '.join(varied)}" if varied else ""
    seeds = f", each with {config.sweep.seeds} sequences of encoder noise" if config.sweep.seeds > 1 else ""
    run = f"{config.run.duration:g} s, sampled every {1e3 * config.run.sample_period:g} ms"
    return f"Studied: {_DRIVES[config.drive.kind]} in runs of {run}{over}{seeds}."


class _Survey:
    """What the sentences and the table of axes say of a study, found in one reading.

    Attributes:
        runs: their number; `even` those on points that are always simulated; `diverged`.
        converged: how many of the even ones converged, by side; none where the study does not say.
        best: the best gains, by side, and the worst runs with each pair of gains; none where the study does not say.
        values: all values of each axis.
    """

    def __init__(self, result: StudyResult):
        paths = [axis.path for axis in result.config.axes]
        wanted = {side: [f"{side}.{name}" for name in ("converged", "velocity_rmse", "margin_alpha")] for side in SIDES}
        figures = [name for names in wanted.values() for name in names if name in result.columns]
        self.sides = [side for side in SIDES if f"{side}.converged" in figures]
        # a refined study has most of its runs at the boundary: a share of all runs would depend on the refinement
        points = Points(result.config) if result.config.sweep.refine is not None else None
        self.runs = self.even = self.diverged = 0
        self.converged = dict.fromkeys(self.sides, 0)
        self.best: dict[str, tuple[BestGains | None, pd.DataFrame]] = {}
        distinct = {path: Distinct() for path in paths}
        for frame in result.batches([*paths, "seed", "finite", *figures]):
            even = frame if points is None else frame[points.on_coarse_grid(frame)]
            self.runs += len(frame)
            self.even += len(even)
            self.diverged += int((~frame["finite"].astype(bool)).sum())
            for path in paths:
                distinct[path].add(frame[[path]])
            for side in self.sides:
                self.converged[side] += int(even[f"{side}.converged"].sum())
        self.values = {path: one.frame()[path] for path, one in distinct.items()}
        for side in self.sides if result.config.sweep.design == "grid" else []:
            gains = [path for path in paths if path.startswith(f"observer.{side}.") and len(self.values[path]) > 1]
            if gains and f"{side}.velocity_rmse" in figures:
                names = [name for name in wanted[side] if name in figures]
                groups = Groups(Rows(result, [*paths, "finite", *names]), gains, paths)
                runs = worst_runs(groups, f"{side}.velocity_rmse", f"{side}.margin_alpha" in figures)
                self.best[side] = best_gains(runs), runs


def headline(result: StudyResult) -> Lines:
    """What a study found, in sentences."""
    return _headline(result, _Survey(result))


def _headline(result: StudyResult, found: _Survey) -> Lines:
    refined = result.config.sweep.refine is not None
    even = found.even or math.nan
    shares = ", ".join(f"{100 * found.converged[side] / even:.1f} % ({side})" for side in found.sides)
    counted, of = f"{found.runs} runs.", "them"
    if refined:
        points = len(Points(result.config))
        simulated = found.runs // result.config.sweep.seeds
        share = 100 * simulated / points
        counted = f"{simulated} of {points} grid points simulated ({share:.2g} %), {found.runs} runs."
        of = "those on the coarse grid"
    lines = [f"{counted} The observers converged in {shares} of {of}." if found.sides else counted]
    if not result.is_finished(found.runs):
        more = " so far" if refined else ""
        lines.append(f"The study is not finished: it has {result.runs} runs{more}. Go on with 'jaxbl sweep'.")
    if found.diverged:
        lines.append(f"{found.diverged} runs diverged: finite = false in the table, grey in the figures.")
    return [*lines, *(f"{side}: {_best_line(best, runs)}" for side, (best, runs) in found.best.items())]


def _best_line(best: BestGains | None, runs: pd.DataFrame) -> str:
    """The best gains of a side, their margin, and how many others are as good."""
    if best is None:
        return "no gains converged in all runs with α above f⁺."
    row, names = runs.iloc[best.index], runs.index.names
    place = ", ".join(f"{name} = {runs.index.get_level_values(name)[best.index]:.3g}" for name in names)
    ends = (f" Its {gain} is the {way.replace('er', 'est')} of its axis." for gain, way in best.ends.items())
    return (
        f"best gains {place}: velocity error {row['error']:.3g} rad/s rms, the worst of their runs (least: "
        f"{best.least_error:.3g}). {describe_margins(best.margins)} {best.nearly_as_good} of {len(runs)} gains are as good "
        f"within {100 * NEARLY_AS_GOOD:g} %.{''.join(ends)}"
    )


def _law_lines(laws: list[Law]) -> Lines:
    """How many laws agree with theory, and each that does not."""
    if not laws:
        return []
    count = sum(law.agrees for law in laws)
    lines = [f"Accuracy laws: {count} of {len(laws)} have a slope within {AGREEMENT:g} of theory."]
    for law in laws:
        if not law.agrees:
            found = "no power law" if law.fit is None else f"slope {_slope_of(law)}, theory {law.theory:g}"
            lines.append(f"{law.value} over {law.x} ({_place(law)}): {found}; {_why(law)}.")
    return lines


def _why(law: Law) -> str:
    """Why a law ends below and above; the end of the sweep is named only where both ends are that."""
    if law.stops["below"] == law.stops["above"]:
        return law.stops["below"]
    return "; ".join(f"{end}: {law.stops[end]}" for end in ("below", "above") if law.stops[end] != END_OF_SWEEP)


def _slope_of(law: Law) -> str:
    assert law.fit is not None
    return f"{law.fit.slope:.3f} ± {law.fit.standard_error:.1g}"


def _place(law: Law) -> str:
    """The values that a line of a law is for; a word stands without its path."""
    pairs = {**law.series, **law.where}.items()
    return ", ".join(value if isinstance(value, str) else f"{path} = {value:g}" for path, value in pairs) or "all points"


def _law_table(laws: list[Law]) -> PageTable:
    rows = []
    for law in laws:
        line, slope, halves, ends = f"{law.value} over {law.x}", "no law", "–", "–"
        if law.fit is not None:
            slope, halves = _slope_of(law), f"{law.fit.half_slopes[0]:.2f}, {law.fit.half_slopes[1]:.2f}"
        if law.range is not None:
            ends = f"{law.range[0]:g} to {law.range[1]:g} ({law.in_range.sum()})"
        slope, halves, ends = (text.replace(" ", "\u00a0") for text in (slope, halves, ends))
        rows.append([line, _place(law), law.theory, slope, halves, law.agrees, ends, _why(law)])
    columns = ["error", "where", "theory", "slope", "halves", "agrees", "range (points)", "why it ends there"]
    return PageTable("Accuracy laws", columns, rows)


def _axes_table(found: _Survey) -> PageTable:
    rows = []
    for path, values in found.values.items():
        ends = ["–", "–"] if not pd.api.types.is_numeric_dtype(values) else [values.min(), values.max()]
        rows.append([path, len(values), *ends])
    return PageTable("Axes", ["path", "values", "least", "largest"], rows)


def _metric_table(result: StudyResult) -> PageTable:
    about = {f"{side}.{name}": metric for side, (name, metric) in product(SIDES, SIDE_METRICS.items())}
    shown = [column for column in about if column in result.columns]
    rows = Rows(result, shown)

    def numbers() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for frame in rows:
            for i, column in enumerate(shown):
                values = frame[column].to_numpy(float)
                values = values[np.isfinite(values)]
                yield np.full(len(values), i), values

    quantiles = spread(numbers, len(shown), (0.05, 0.5, 0.95)).quantiles.T
    table = [
        [column, *(None if np.isnan(q) else q for q in row), about[column].unit, about[column].doc]
        for column, row in zip(shown, quantiles, strict=True)
    ]
    return PageTable("Metrics over all runs", ["metric", "5 %", "median", "95 %", "unit", "meaning"], table)
