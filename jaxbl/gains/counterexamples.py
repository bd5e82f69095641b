"""Causes of counterexamples (a gain condition held, and the observer failed), found by repeating the runs."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false

import numpy as np
import pandas as pd

from jaxbl.config import Config, read_config
from jaxbl.json_types import JsonObject
from jaxbl.sweeps.points import Points

from .stages import Stages, set_keys

_MOST_REPEATED = 4096
"""Runs of a level that are repeated, evenly spread: one chunk of the scan on one device."""


def run_columns(config: Config) -> list[str]:
    """Return the columns that tell runs of a study apart."""
    return [*config.axis_paths, "seed"]


def add_causes(counterexamples: pd.DataFrame, study: Config, level: str, side: str, stages: Stages) -> pd.DataFrame:
    """Add a column with the cause of failure to the counterexamples of a level."""
    # a claimed bound below the true one is the cause if the condition fails at the true one
    is_true_bound = (counterexamples["bound"] == "true").to_numpy()
    runs = pd.MultiIndex.from_frame(counterexamples[["condition", "row"]])
    is_excused = ~is_true_bound & ~runs.isin(runs[is_true_bound])
    unexcused = counterexamples[~is_excused].drop_duplicates("row")
    causes = _find_causes(study, level, side, unexcused, stages) if len(unexcused) else pd.Series(dtype=object)
    cause = counterexamples["row"].map(dict(zip(unexcused["row"], causes, strict=True)))
    cause = cause.where(~is_excused, "f_plus underestimated")
    keys = run_columns(study)
    lead = ["level", "side", "condition", "bound", "cause", *keys]
    columns = [*lead, *counterexamples.columns.difference(["row", *lead], sort=False)]
    return counterexamples.assign(cause=cause)[columns].sort_values(["condition", "bound", *keys], ignore_index=True)


def _list_remedies(run: JsonObject, level: str) -> dict[str, JsonObject]:
    """List the possible causes of a failed run, each with the keys that remove it; `run` is the run's own table."""
    # a factor of four clearly changes an error that depends on the duration or the period
    long, short_period = 4.0 * run["duration"], run["sample_period"] / 4.0
    remedies: dict[str, JsonObject] = {"run too short": {"run.duration": long}}
    remedies["period too long"] = {"run.sample_period": short_period, "run.substeps": max(-(-run["substeps"] // 4), 1)}
    if level == "sampled":
        remedies["noise"] = {"encoders.noise": 0.0, "encoders.load_noise": None}
        remedies["quantisation"] = {"encoders.motor_resolution": 0.0, "encoders.load_resolution": 0.0}
        remedies["explicit discretisation"] = {"observer.discretisation": "implicit"}
    return remedies


def _find_causes(study: Config, level: str, side: str, rows: pd.DataFrame, stages: Stages) -> pd.Series:
    """Find the cause of each failed run: it is repeated with one possible cause removed at a time, then with all of them.

    The cause is the one whose removal lets the run converge (several are joined by "or"), or "several" if only removing all
    of them does. Otherwise it is "f_plus underestimated" if the repeated run shows a bound that alpha does not exceed, else
    "unexplained".
    """
    repeated_rows = rows.iloc[np.unique(np.linspace(0, len(rows) - 1, _MOST_REPEATED).astype(int))]
    structural = list(Points(study).groups[0].structural)
    paths = [path for path in study.axis_paths if path not in structural]
    causes = pd.Series("not tried", index=rows.index, dtype=object)
    groups = repeated_rows.groupby(structural, sort=False) if structural else [((), repeated_rows)]
    for number, (_, group) in enumerate(groups):
        name = f"{level}-{side}-{number}"
        tables = set_keys(study.to_dict(), {path: group[path].iloc[0] for path in structural})
        remedies = _list_remedies(tables["run"], level)
        helps = {}
        for cause, remedy in remedies.items():
            frame = repeat_with_change(tables, paths, group, remedy, stages, f"{name}-{cause}")
            if frame is not None:
                helps[cause] = frame[f"{side}.converged"].to_numpy(bool)
        causes[group.index] = [" or ".join(cause for cause in helps if helps[cause][i]) for i in range(len(group))]
        failing = group[causes[group.index] == ""]
        if not len(failing):
            continue
        all_remedies = {path: value for remedy in remedies.values() for path, value in remedy.items()}
        frame = repeat_with_change(tables, paths, failing, all_remedies, stages, f"{name}-several")
        assert frame is not None, "a longer run has an effect"
        # a failing observer can lower its own f_plus; once it works, alpha turns out to be too small
        other_causes = np.where(frame[f"{side}.margin_alpha"] <= 1.0, "f_plus underestimated", "unexplained")
        causes[failing.index] = np.where(frame[f"{side}.converged"].to_numpy(bool), "several", other_causes)
    return causes


def repeat_with_change(
    tables: JsonObject, paths: list[str], rows: pd.DataFrame, change: JsonObject, stages: Stages, name: str
) -> pd.DataFrame | None:
    """Repeat runs with changed keys, as a study of listed points. Returns None if the change has no effect.

    Args:
        tables: the study's.
        paths: axes whose values `rows` has; those that the change sets are left out.
        rows: the runs.
        change: values by path, as of :func:`set_keys`.
        stages: runs the study.
        name: of the study, in the folder of the causes.
    """
    data, unchanged_paths = set_keys(tables, change), [path for path in paths if path not in change]
    before, after = (read_config(study | {"axes": []}).to_dict() for study in (tables, data))
    if unchanged_paths == paths and before == after:
        return None
    data["sweep"] = {key: data["sweep"][key] for key in ("seeds", "first_seed")}
    return stages.repeat_runs(data, rows[[*unchanged_paths, "seed"]], "causes", name.replace(" ", "_"))
