"""Diagnosis of all logs of a folder: `jaxbl diagnose --batch`."""

from pathlib import Path
from typing import NamedTuple

import pandas as pd

from .cluster import Scheduler, connect
from .errors import InputError
from .files import Subject, open_results, run_or_read
from .json_types import JsonObject
from .lines import format_descriptions
from .records.files import is_log, log_suffixes
from .workers import Progress, clear_programs_if_needed, map_jobs, useful_processes


class LogJob(NamedTuple):
    """A log of a batch, its model and its hold-out log, and the folder of its results."""

    log: Path
    model: Path
    holdout: Path | None
    folder: Path
    overwrite: bool

    def absolute(self) -> "LogJob":
        """Return the job with absolute paths, for processes in other folders."""
        return self._make(field.absolute() if isinstance(field, Path) else field for field in self)


def read_batch(source: Path, model: Path | None, out: Path, *, overwrite: bool) -> tuple[list[LogJob], list[str]]:
    """List the logs of a folder, each with its model and a folder for its results, and the names of other files.

    `NAME.toml` beside a log is its model (`model` where there is none), `holdout/NAME.*` its hold-out log.

    Raises:
        InputError: there is no log, a log has no model, or two logs have one name.
    """
    if not source.is_dir():
        raise InputError(f"{source}: no such folder; --batch needs one with logs")
    logs = sorted(filter(is_log, source.iterdir()))
    file_names = {file.name for file in source.iterdir() if file.suffix != ".toml" and not file.name.startswith(".")}
    skipped = sorted(file_names - {"holdout", *(file.name for file in logs)})
    if not logs:
        raise InputError(f"{source}: holds no log ({', '.join(log_suffixes())}, or a folder of a ROS 2 bag)")
    stems = [file.stem for file in logs]
    for name in stems:
        if stems.count(name) > 1:
            raise InputError(f"{source}: two logs are called {name}; each needs a name of its own for its results")
    holdouts = {file.stem: file for file in (source / "holdout").glob("*") if is_log(file)}
    jobs = []
    for file in logs:
        beside = file.with_suffix(".toml")
        log_model = beside if beside.exists() else model
        if log_model is None:
            raise InputError(f"{file}: no model; give --model TOML, or {beside.name} beside it")
        jobs.append(LogJob(file, log_model, holdouts.get(file.stem), out / file.stem, overwrite))
    return jobs, skipped


def run_batch(
    jobs: list[LogJob], out: Path, processes: int | None, progress: Progress, scheduler: Scheduler = None
) -> list[JsonObject]:
    """Diagnose logs that are not diagnosed yet, in processes here or by a cluster's workers, and write `batch.csv`.

    Returns its rows.
    """
    count = len(jobs)
    rows = []
    processes = useful_processes(count) if processes is None else min(processes, count)
    with open_results(out, Subject("batch"), overwrite=jobs[0].overwrite) as results, connect(scheduler) as cluster:
        # the folder is a batch's before there are folders of logs in it
        results.write_manifest()
        progress(0, count)
        for row in (
            map_jobs(_diagnose_log, jobs, processes)
            if cluster is None
            else cluster.map_jobs(_diagnose_log, map(LogJob.absolute, jobs))
        ):
            rows.append(row)
            progress(len(rows), count)
        with results.write_files("batch.csv") as draft:
            pd.DataFrame(rows).to_csv(draft / "batch.csv", index=False)
    return rows


def _diagnose_log(job: LogJob) -> JsonObject:
    """Diagnose a log and return its row of a batch."""
    from .diagnosis.diagnose import read_diagnosis_task, run_diagnosis
    from .report.results import write_report

    clear_programs_if_needed()
    try:
        task = read_diagnosis_task(job.log, job.model, holdout=job.holdout)
        return make_batch_row(
            job.log, run_or_read(task, job.folder / "diagnosis.json", run_diagnosis, write_report, overwrite=job.overwrite)
        )
    except InputError as error:
        return make_batch_row(job.log, None, str(error))


def make_batch_row(log: Path, summary: JsonObject | None, refused: str = "") -> JsonObject:
    """Make a row of `batch.csv` from a log's diagnosis, or from the reason why it was refused."""
    row: JsonObject = {"log": log.name, "verdict": "", "findings": "", "confidence": None, "refused": refused}
    if summary is None:
        return row
    findings = summary["findings"]
    row |= {
        "verdict": summary["verdict"],
        "findings": "; ".join(finding["effect"] for finding in findings),
        "confidence": min((finding["confidence"] for finding in findings), default=None),
    }
    for name in summary["gap"]["holdout_rmse_before"]:
        for key, column in (("holdout_rmse_before", "before"), ("holdout_rmse_after", "after"), ("noise_floor", "floor")):
            row[f"{name}_{column}"] = summary["gap"][key][name]
    return row


def format_batch(rows: list[JsonObject]) -> list[str]:
    """Write the rows of a batch as a table for the terminal."""
    return format_descriptions(
        (
            row["log"],
            row["verdict"] or "refused",
            f"{row['findings']} ({row['confidence']:.2g})" if row["findings"] else row["refused"],
        )
        for row in rows
    )
