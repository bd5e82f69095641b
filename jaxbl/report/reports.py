"""What the commands leave behind: figures, summary and report of a sweep and of a single run."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false
# pyright: reportReturnType=false

import json
import os
from pathlib import Path
from typing import Any

import pandas as pd

from jaxbl.study.laws import AGREEMENT, END_OF_SWEEP, Law, accuracy_laws
from jaxbl.study.metrics import SIDE_METRICS
from jaxbl.study.store import Store, write_atomic
from jaxbl.study.sweep import StudyResult
from jaxbl.study.trial import Trial
from jaxbl.study.tune import Tuning
from jaxbl.study.tune_summary import called_gains

from .maps import SIDES, Drawn, draw
from .page import Picture, TableOf, html
from .style import save
from .traces import draw_trial
from .tuning import draw_tuning


def write_sweep_report(result: StudyResult, folder: Path) -> list[str]:
    """Draw the figures of a study and write `report.html` into its folder, and `laws.json` if figures ask for laws.

    Returns the headline's lines.
    """
    pictures = _save(draw(result), folder)
    laws = accuracy_laws(result)
    if laws:
        write_atomic(folder / "laws.json", json.dumps([law.to_dict() for law in laws], indent=2, ensure_ascii=False))
    else:
        (folder / "laws.json").unlink(missing_ok=True)
    lead = [*headline(result), *_law_lines(laws)]
    page = html(
        result.config.title or "Study",
        lead,
        result.config.notes,
        pictures,
        [*([_law_table(laws)] if laws else []), _axes_table(result), _metric_table(result)],
        result.config.to_toml(),
    )
    write_atomic(folder / "report.html", page)
    return lead


def headline(result: StudyResult) -> list[str]:
    """What a study found, in sentences."""
    sides = [side for side in SIDES if f"{side}.converged" in result.columns]
    figures = [f"{side}.{name}" for side in sides for name in ("converged", "velocity_rmse")]
    frame = result.read([*(axis.path for axis in result.config.axes), "finite", *figures])
    shares = ", ".join(f"{100 * frame[f'{side}.converged'].mean():.1f} % ({side})" for side in sides)
    lines = [f"{len(frame)} runs. The observers converged in {shares} of them."]
    if isinstance(result.source, Store) and len(frame) < result.source.manifest["rows"]:
        lines.append(f"The study is not finished: it has {result.source.manifest['rows']} runs. Go on with 'jaxbl sweep'.")
    diverged = int((~frame["finite"].astype(bool)).sum())
    if diverged:
        lines.append(f"{diverged} runs diverged: they are in the table with finite = false, and grey in the figures.")
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
    """What was found of the laws: how many agree, and each that does not."""
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
    """The reasons at the ends; the end of the sweep only where nothing else ends the law."""
    below, above = law.stops["below"], law.stops["above"]
    if below == above:
        return below
    ends = {"below": below, "above": above}.items()
    return "; ".join(f"{end}: {reason}" for end, reason in ends if reason != END_OF_SWEEP)


def _slope_of(law: Law) -> str:
    assert law.fit is not None
    return f"{law.fit.slope:.3f} ± {law.fit.standard_error:.1g}"


def _place(law: Law) -> str:
    """What a law's line fixes; a word speaks for itself."""
    pairs = {**law.series, **law.where}.items()
    return ", ".join(value if isinstance(value, str) else f"{path} = {value:g}" for path, value in pairs) or "all points"


def _law_table(laws: list[Law]) -> TableOf:
    rows: list[list[object]] = []
    for law in laws:
        fit = law.fit
        ends = (
            "–" if law.range is None else f"{law.range[0]:g} to {law.range[1]:g} ({law.inside.sum()})".replace(" ", "\u00a0")
        )
        slope = "no law" if fit is None else _slope_of(law).replace(" ", "\u00a0")
        halves = "–" if fit is None else f"{fit.halves[0]:.2f}, {fit.halves[1]:.2f}".replace(" ", "\u00a0")
        line = f"{law.value} over {law.x}"
        rows.append([line, _place(law), law.theory, slope, halves, law.agrees, ends, _why(law)])
    columns = ["error", "where", "theory", "slope", "halves", "agrees", "range (points)", "why it ends there"]
    return TableOf("Accuracy laws", columns, rows)


def write_trial_report(trial: Trial, folder: Path) -> list[str]:
    """Write trace, summary, figures and report of a run into a folder that exists. Returns the lines for the terminal."""
    # the summary first: it is what makes the folder this study's
    write_atomic(folder / "summary.json", json.dumps(trial.summary, indent=2, ensure_ascii=False))
    draft = folder / f".trace.{os.getpid()}.draft"
    trial.trace.to_parquet(draft, index=False)
    draft.replace(folder / "trace.parquet")
    pictures = _save(draw_trial(trial), folder)
    metrics = trial.summary["metrics"]
    sides = [side for side in SIDES if f"{side}.converged" in metrics]
    tables = [
        TableOf(
            "Metrics",
            ["", *sides, "unit", "meaning"],
            [
                [name, *(metrics.get(f"{side}.{name}") for side in sides), about.unit, about.doc]
                for name, about in SIDE_METRICS.items()
                if f"motor.{name}" in metrics
            ],
        )
    ]
    lead = []
    if identified := trial.summary["identified"]:
        rows = [[name, values["true"], *(values[side] for side in sides)] for name, values in identified.items()]
        tables.insert(0, TableOf("Identified", ["", "true", *sides], rows))
        for name, values in identified.items():
            found = ", ".join(f"{_number(values[side])} ({side})" for side in sides)
            lead.append(f"{name}: {found}; true {values['true']:.4g}")
    remarks = trial.summary["remarks"]
    page = html(trial.config.title or "Run", lead, remarks, pictures, tables, trial.config.to_toml())
    write_atomic(folder / "report.html", page)
    return [*lead, *remarks]


def write_tune_report(tuning: Tuning, folder: Path) -> list[str]:
    """Write `gains.toml`, `tuning.json`, figures and report into a folder that exists. Returns lines for the terminal."""
    summary = tuning.summary
    lead = _tune_headline(summary)
    write_atomic(folder / "gains.toml", gains_toml(summary))
    write_atomic(folder / "tuning.json", json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False))
    pictures = _save(draw_tuning(tuning), folder)
    page = html(
        tuning.config.title or "Gains",
        lead,
        summary["remarks"],
        pictures,
        [
            _gains_table(summary),
            _comparison_table(f"{_holdout_title(summary)}, worst and median of all runs", summary["holdout"]["rows"]),
            _comparison_table("On the study's own excitation, worst and median of all runs", summary["named"]),
            *_pareto_tables(summary),
        ],
        tuning.config.to_toml(),
    )
    write_atomic(folder / "report.html", page)
    return [*lead, *summary["remarks"]]


def gains_toml(summary: dict[str, Any]) -> str:
    """The chosen gains as TOML that a study can `include`; what they were chosen for stands in comments."""
    margins, lines = summary["margins"], []
    title = " ".join(summary["title"].split())
    lines.append(f"# Gains chosen by 'jaxbl tune'{f' for: {title}' if title else ''}")
    lines.append(f"# Objective: {summary['objective_metric']}; {_runs_behind(summary)}.")
    asked = f"alpha / f+ {margins['alpha']:g}, lambda over the least of the exact condition {margins['exact']:g}"
    lines.append(f"# Margins asked for: {asked}.")
    lines.append('# To use them, put include = "gains.toml" at the top of a study and leave its own gains out.')
    for side, gains in summary["gains"].items():
        found = summary["achieved"][side]
        lines += [
            "",
            f"# f+ = {summary['f_plus'][side]:.4g} rad/s^2. Reached, the worst of all runs: velocity error "
            f"{found['velocity_rmse']:.3g} rad/s rms,",
            f"# torque error {found['torque_rmse']:.3g} N m rms, converged after {found['convergence_time']:.3g} s; "
            f"margins {found['margin_alpha']:.3g} (alpha), {found['margin_exact']:.3g} (exact).",
            f"[observer.{side}]",
            f"lambda = {gains['lambda']!r}",
            f"alpha = {gains['alpha']!r}",
        ]
    return "\n".join(lines) + "\n"


def _runs_behind(summary: dict[str, Any]) -> str:
    first, last = summary["seeds"]
    seeds, drives = last - first + 1, len(summary["scenarios"])
    parts = [f"{seeds} noise seed{'s' * (seeds > 1)}", f"{drives} drive{'s' * (drives > 1)}"]
    return " and ".join(parts)


def _holdout_title(summary: dict[str, Any]) -> str:
    held = summary["holdout"]
    if held["same_excitation"]:
        return "On the study's excitation with other noise"
    return f"On the held-out excitation ({held['excitation']['kind']})"


def _tune_headline(summary: dict[str, Any]) -> list[str]:
    """Gains, and what they are worth on the held-out runs, in sentences."""
    lines, metric = [], f"{summary['objective']}_rmse"
    unit = SIDE_METRICS[metric].unit
    for side, gains in summary["gains"].items():
        found = summary["achieved"][side]
        lines.append(
            f"{side}: lambda = {gains['lambda']:.4g} √rad/s, alpha = {gains['alpha']:.4g} rad/s² "
            f"({gains['lambda_ratio']:.3g} √f⁺, {gains['alpha_ratio']:.3g} f⁺): {summary['objective']} error "
            f"{found[metric]:.3g} {unit} rms, converged after "
            f"{found['convergence_time']:.3g} s, the worst of {_runs_behind(summary)}."
        )
    where = _holdout_title(summary)
    where = where[0].lower() + where[1:]
    rows = {(row["name"], row["side"]): row for row in summary["holdout"]["rows"]}
    for side, others in summary["holdout"]["factors"].items():
        parts = []
        for name, factors in others.items():
            called, row = called_gains(name), rows[name, side]
            if "why_none" in factors:
                parts.append(f"{called} converge in {100 * row['converged']:.3g} % of the runs")
            else:
                error, time = factors[metric]["worst"], row["convergence_time"]["worst"]
                times = "as much" if error is None or f"{error:.3g}" == "1" else f"{error:.3g} times as much"
                parts.append(f"{times} with {called} (converged after {time:.3g} s)")
        tuned = rows["tuned", side]
        error, time = tuned[metric]["worst"], tuned["convergence_time"]["worst"]
        own = "none: runs diverge" if error is None else f"{error:.3g} {unit} rms"
        after = "not converged in all runs" if time is None else f"converged after {time:.3g} s"
        lines.append(f"{side}, {where}: worst {summary['objective']} error {own} ({after}); {'; '.join(parts)}.")
    return lines


def _gains_table(summary: dict[str, Any]) -> TableOf:
    rows: list[list[object]] = []
    for side, gains in summary["gains"].items():
        found, step = summary["achieved"][side], summary["resolution"][side]
        rows.append(
            [side, gains["lambda"], gains["alpha"], gains["lambda_ratio"], gains["alpha_ratio"], summary["f_plus"][side],
             found["velocity_rmse"], found["torque_rmse"], found["convergence_time"], found["margin_alpha"],
             found["margin_exact"], found["peak_ratio"], 100 * max(step.values())]
        )  # fmt: skip
    columns = ["side", "λ (√rad/s)", "α (rad/s²)", "λ/√f⁺", "α/f⁺", "f⁺ (rad/s²)", "velocity error (rad/s)",
               "torque error (N m)", "convergence (s)", "margin α", "margin exact", "ρ", "last step (%)"]  # fmt: skip
    return TableOf("Chosen gains, worst of all runs", columns, rows)


def _comparison_table(heading: str, found: list[dict[str, Any]]) -> TableOf:
    rows: list[list[object]] = [
        [row["side"], row["name"], row["lambda"], row["alpha"], 100.0 * row["converged"],
         *(row[name][how] for name in ("velocity_rmse", "torque_rmse") for how in ("worst", "median")),
         row["convergence_time"]["worst"], row["margin_alpha"], row["margin_exact"], row["peak_ratio"]]
        for row in sorted(found, key=lambda row: SIDES.index(row["side"]))
    ]  # fmt: skip
    columns = ["side", "gains", "λ", "α", "converged (%)", "velocity error (rad/s)", "median", "torque error (N m)",
               "median", "convergence (s)", "margin α", "margin exact", "ρ"]  # fmt: skip
    return TableOf(heading, columns, rows)


def _pareto_tables(summary: dict[str, Any]) -> list[TableOf]:
    unit = SIDE_METRICS[f"{summary['objective']}_rmse"].unit
    columns = ["λ", "α", "λ/√f⁺", "α/f⁺", "convergence time (s)", f"{summary['objective']} error ({unit})"]
    return [
        TableOf(
            f"No gains beat these in both convergence time and error: {side}", columns, [list(row.values()) for row in rows]
        )
        for side, rows in summary["pareto"].items()
    ]


def _number(value: float | None) -> str:
    return "undetermined" if value is None else f"{value:.4g}"


def _save(drawn: list[Drawn], folder: Path) -> list[Picture]:
    return [Picture(save(d.figure, folder / "figures" / f"{d.name}.png"), d.caption) for d in drawn]


def _axes_table(result: StudyResult) -> TableOf:
    rows: list[list[object]] = []
    for axis in result.config.axes:
        column = result.read([axis.path])[axis.path]
        ends = ["–", "–"] if not pd.api.types.is_numeric_dtype(column) else [column.min(), column.max()]
        rows.append([axis.path, int(column.nunique()), *ends])
    return TableOf("Axes", ["path", "values", "least", "largest"], rows)


def _metric_table(result: StudyResult) -> TableOf:
    rows: list[list[object]] = []
    for side in SIDES:
        for name, about in SIDE_METRICS.items():
            column = f"{side}.{name}"
            if column in result.columns:
                values = result.read([column])[column].astype(float)
                values = values[values.abs() < float("inf")]
                quantiles = [values.quantile(q) if len(values) else None for q in (0.05, 0.5, 0.95)]
                rows.append([column, *quantiles, about.unit, about.doc])
    return TableOf("Metrics over all runs", ["metric", "5 %", "median", "95 %", "unit", "meaning"], rows)
