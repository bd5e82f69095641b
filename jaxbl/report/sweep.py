"""What `jaxbl sweep` and `jaxbl plot` leave to be read: maps and lines, accuracy laws, tables."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false

import json
from itertools import product
from pathlib import Path

import pandas as pd

from jaxbl.files import write_atomic
from jaxbl.gains.accuracy_laws import AGREEMENT, END_OF_SWEEP, Law, accuracy_laws
from jaxbl.sweeps.metrics import SIDE_METRICS
from jaxbl.sweeps.points import Points
from jaxbl.sweeps.store import Store
from jaxbl.sweeps.sweep import StudyResult

from .figures import SIDES
from .maps import draw
from .page import PageTable, write_report


def write_sweep_report(result: StudyResult, folder: Path) -> list[str]:
    """Write figures, `report.html`, and `laws.json` if figures ask for laws, into a study's folder.

    Returns the lines for the terminal.
    """
    drawn = draw(result)
    laws = accuracy_laws(result)
    if laws:
        write_atomic(folder / "laws.json", json.dumps([law.to_dict() for law in laws], indent=2, ensure_ascii=False))
    else:
        (folder / "laws.json").unlink(missing_ok=True)
    lead = [*headline(result), *_law_lines(laws)]
    tables = [*([_law_table(laws)] if laws else []), _axes_table(result), _metric_table(result)]
    config = result.config
    write_report(folder, config.title or "Study", lead, drawn, tables, config.to_toml(), config.notes)
    return lead


def headline(result: StudyResult) -> list[str]:
    """What a study found, in sentences."""
    sides = [side for side in SIDES if f"{side}.converged" in result.columns]
    figures = [f"{side}.{name}" for side in sides for name in ("converged", "velocity_rmse")]
    frame = result.read([*(axis.path for axis in result.config.axes), "seed", "finite", *figures])
    # a refined study has most of its runs at the boundary: a share of all runs would depend on the refinement
    refined = result.config.sweep.refine is not None
    points = Points(result.config) if refined else None
    even = frame if points is None else frame[points.always_simulated(frame)]
    shares = ", ".join(f"{100 * even[f'{side}.converged'].mean():.1f} % ({side})" for side in sides)
    lines = [f"{len(frame)} runs. The observers converged in {shares} of them."]
    if points is not None:
        simulated = len(frame) // result.config.sweep.seeds
        share = 100 * simulated / len(points)
        lines = [
            f"{simulated} of {len(points)} grid points simulated ({share:.2g} %), {len(frame)} runs. "
            f"The observers converged in {shares} of those on the coarse grid."
        ]
    if isinstance(result.source, Store) and not result.is_finished(len(frame)):
        more = " so far" if refined else ""
        lines.append(
            f"The study is not finished: it has {result.source.manifest['rows']} runs{more}. Go on with 'jaxbl sweep'."
        )
    diverged = int((~frame["finite"].astype(bool)).sum())
    if diverged:
        lines.append(f"{diverged} runs diverged: finite = false in the table, grey in the figures.")
    for side in sides:
        best = frame[frame[f"{side}.converged"].astype(bool)]
        varied = [
            a.path for a in result.config.axes if frame[a.path].nunique() > 1 and a.path.startswith(f"observer.{side}")
        ]
        if len(best) and varied:
            row = best.loc[best[f"{side}.velocity_rmse"].idxmin()]
            where = ", ".join(f"{path} = {row[path]:.3g}" for path in varied)
            lines.append(f"Least {side} velocity error {row[f'{side}.velocity_rmse']:.3g} rad/s rms, at {where}.")
    return lines


def _law_lines(laws: list[Law]) -> list[str]:
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
            slope, halves = _slope_of(law), f"{law.fit.halves[0]:.2f}, {law.fit.halves[1]:.2f}"
        if law.range is not None:
            ends = f"{law.range[0]:g} to {law.range[1]:g} ({law.inside.sum()})"
        slope, halves, ends = (text.replace(" ", "\u00a0") for text in (slope, halves, ends))
        rows.append([line, _place(law), law.theory, slope, halves, law.agrees, ends, _why(law)])
    columns = ["error", "where", "theory", "slope", "halves", "agrees", "range (points)", "why it ends there"]
    return PageTable("Accuracy laws", columns, rows)


def _axes_table(result: StudyResult) -> PageTable:
    rows = []
    for axis in result.config.axes:
        column = result.read([axis.path])[axis.path]
        ends = ["–", "–"] if not pd.api.types.is_numeric_dtype(column) else [column.min(), column.max()]
        rows.append([axis.path, int(column.nunique()), *ends])
    return PageTable("Axes", ["path", "values", "least", "largest"], rows)


def _metric_table(result: StudyResult) -> PageTable:
    rows = []
    for side, (name, about) in product(SIDES, SIDE_METRICS.items()):
        column = f"{side}.{name}"
        if column in result.columns:
            values = result.read([column])[column].astype(float)
            values = values[values.abs() < float("inf")]
            quantiles = [values.quantile(q) if len(values) else None for q in (0.05, 0.5, 0.95)]
            rows.append([column, *quantiles, about.unit, about.doc])
    return PageTable("Metrics over all runs", ["metric", "5 %", "median", "95 %", "unit", "meaning"], rows)
