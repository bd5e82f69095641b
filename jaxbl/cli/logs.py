"""Commands on measured logs: inspect, identify, diagnose, watch."""

import math
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import jaxbl
from jaxbl import workers
from jaxbl.errors import InputError, escape_unprintable
from jaxbl.files import ResultFolder, log_subject, open_results, run_or_read, to_jsonable, write_atomic
from jaxbl.json_types import JsonObject
from jaxbl.lines import NextStep, doubts_among
from jaxbl.result import KeyFigure
from jaxbl.terminal import STEPS, is_quiet, repeat_call, run_with_progress, watch_for_end_request

from .next_steps import LogCall, after_diagnosis, after_identification, after_inspection, after_proposal, after_watch
from .options import (
    FORMATS,
    ForceOption,
    LogArgument,
    LogOutOption,
    LogOverwriteOption,
    MaxTorqueOption,
    MaxTravelOption,
    SchedulerOption,
    argument,
    check_new,
    flag,
    folder_of,
    option,
)
from .outcome import Outcome

if TYPE_CHECKING:
    from jaxbl.estimation.logs import LogTask
    from jaxbl.monitoring.watch import Watch, WatchTask
    from jaxbl.result import Result

ALARM = 3
"""Exit code of a watch with an alarm."""
BLIND = 4
"""Exit code of a watch that did not see for longer than stated."""


def inspect(
    log: LogArgument,
    model: Annotated[Path | None, option("TOML", "study, or a file with [log] alone: how to read the log")] = None,
    write: Annotated[Path | None, option("NEW.toml", "propose [log] and a nominal model for identify and diagnose")] = None,
    out: LogOutOption = None,
    overwrite: LogOverwriteOption = False,
) -> Outcome:
    """Examine a measured log: channels, sampling, noise, and which parameters it can identify.

    Example: jaxbl inspect log.csv --write axis.toml

    Read on: docs/logs.md
    """
    if write is not None:
        check_new(write, "--write")

    table = gear_ratio = nominal = None
    if model is not None:
        from jaxbl.config import read_log_config

        table, gear_ratio, nominal = read_log_config(model)
    if write is None:
        inspection = jaxbl.inspect(log, table, gear_ratio=gear_ratio, nominal=nominal)
        card = jaxbl.describe(inspection)
    else:
        import tomli_w

        from jaxbl.records.proposal import propose_study

        log_keys = None if table is None else table.model_dump(exclude_unset=True)
        study, guesses, inspection = propose_study(log, log_keys, gear_ratio=gear_ratio, nominal=nominal)
        # what is to be filled in comes first
        guesses.sort(key=lambda guess: "put in" not in guess)
        remarks = [
            f"Proposed by jaxbl inspect --write from {log.name}. Look it through: names, units, and the drive.",
            *guesses,
        ]
        write_atomic(write, "".join(f"# {escape_unprintable(remark)}\n" for remark in remarks) + tomli_w.dumps(study))
        card = jaxbl.describe(inspection)
        # without an input there is nothing to be fitted yet
        steps = [] if "u" in study["log"].get("absent", ()) else after_proposal(log, write)
        card = replace(card, remarks=[f"{write}: a first model.", *guesses, *card.remarks], next_steps=steps)
    folder = folder_of(log, "inspected", out)
    with open_results(folder, log_subject(log), overwrite=overwrite) as results:
        # the terminal has no line left for it
        jaxbl.write_report(inspection, results, replace(card, next_steps=card.next_steps or after_inspection(log, model)))
    return Outcome(card, folder, summary="inspection.json")


def identify(
    context: typer.Context,
    log: Annotated[list[Path], argument("LOG...", f"{FORMATS}s of one machine")],
    model: Annotated[Path, option("TOML", "study with nominal parameters, and [log]")],
    holdout: Annotated[Path | None, option("LOG2", "log of the same machine to test the fit on")] = None,
    profile: Annotated[bool | None, flag("--profile", "add profile-likelihood intervals")] = None,
    next_experiment: Annotated[
        Path | None, option("FILE.csv", "write an input that shows a gap which the motor's encoder alone does not")
    ] = None,
    max_torque: MaxTorqueOption = None,
    max_travel: MaxTravelOption = None,
    force: ForceOption = False,
    out: LogOutOption = None,
    overwrite: LogOverwriteOption = False,
) -> Outcome:
    """Fit a machine's parameters to its logs, with intervals: stiffness, gap, inertias, frictions.

    Example: jaxbl identify log.csv --model axis.toml

    Read on: docs/logs.md
    """
    _check_limits(next_experiment, max_torque, max_travel)
    workers.start_jax()
    from jaxbl.config import read_log_config

    table, gear_ratio, _ = read_log_config(model)
    folder = folder_of(log[0], "identified", out)
    if table.kind == "element":
        if len(log) > 1 or profile or next_experiment is not None:
            raise InputError(
                "identify: of a transmission on a test rig one log is fitted at a time, without --profile (it has intervals "
                "anyway) and --next-experiment (which is for drives); leave these out"
            )
        from jaxbl.estimation.element import read_element_task, run_element
        from jaxbl.report.element import describe

        task, file = read_element_task(log[0], table, gear_ratio, holdout=holdout), folder / "identification.json"
        summary = run_or_read(task, file, run_element, jaxbl.write_report, overwrite=overwrite)
        return Outcome(describe(summary), folder, summary=summary)
    from jaxbl.estimation.identify import read_identification_task, run_identification
    from jaxbl.report.identify import describe

    task = read_identification_task(log, model, holdout=holdout, profile=profile)
    if next_experiment is not None:
        from jaxbl.diagnosis.next_experiment import check_gap_sought

        check_gap_sought(task)
    log_call = LogCall(log, model, holdout, next_experiment, folder, repeat_call(context, folder))
    return _run_task(context, task, log_call, "identification.json", run_identification, describe, after_identification)


def diagnose(
    context: typer.Context,
    log: Annotated[list[Path] | None, argument("[LOG...]", f"{FORMATS}s of one machine")] = None,
    model: Annotated[Path | None, option("TOML", "study with nominal parameters, [uncertainty] and [log]")] = None,
    holdout: Annotated[
        Path | None, option("LOG2", "log of the same machine for the test [default: the last quarter of the log]")
    ] = None,
    batch: Annotated[
        Path | None, option("FOLDER", "diagnose every log of a folder; NAME.toml beside NAME.csv is its model")
    ] = None,
    jobs: Annotated[int | None, option("N", "processes for --batch [default: one a core]", min=1)] = None,
    scheduler: SchedulerOption = None,
    next_experiment: Annotated[
        Path | None, option("FILE.csv", "write an input that separates the effects this log cannot")
    ] = None,
    max_torque: MaxTorqueOption = None,
    max_travel: MaxTravelOption = None,
    force: ForceOption = False,
    out: LogOutOption = None,
    overwrite: LogOverwriteOption = False,
) -> Outcome:
    """Find effects that a model lacks, add them, and test on held-out data that its errors shrink.

    Example: jaxbl diagnose log.csv --model axis.toml --holdout other.csv

    Read on: docs/diagnosis.md
    """
    _check_limits(next_experiment, max_torque, max_travel)
    if batch is not None:
        if log or holdout is not None or next_experiment is not None:
            raise InputError("--batch FOLDER takes no logs, --holdout or --next-experiment; give these one by one")
        workers.start_jax()
        from jaxbl.batch import format_batch, read_batch, run_batch

        folder = out or Path("results") / f"{batch.name}_diagnosed"
        work, skipped = read_batch(batch, model, folder, overwrite=overwrite)
        with run_with_progress(context, model or batch, folder, unit="logs") as progress:
            rows = run_batch(work, folder, jobs, progress, scheduler)
        lines = [f"Skipped, by their names no logs: {', '.join(skipped)}"] if skipped else []
        code = 2 if all(row["refused"] for row in rows) else 0
        return Outcome([*lines, *format_batch(rows)], folder, "batch.csv", {"logs": rows, "skipped": skipped}, code)
    if jobs is not None or scheduler is not None:
        option = "--scheduler" if jobs is None else "--jobs"
        raise InputError(f"{option} goes with --batch: one log is one process's work; leave it out, or give a folder")
    if not log:
        raise InputError("diagnose: no log; give one or several of one machine, or a folder with --batch")
    if model is None:
        raise InputError("diagnose: no model; give a study with nominal parameters: --model TOML")
    workers.start_jax()
    from jaxbl.diagnosis.diagnose import read_diagnosis_task, run_diagnosis
    from jaxbl.report.diagnose import describe

    task = read_diagnosis_task(log, model, holdout=holdout)
    folder = folder_of(log[0], "diagnosed", out)
    log_call = LogCall(log, model, holdout, next_experiment, folder, repeat_call(context, folder))
    return _run_task(context, task, log_call, "diagnosis.json", run_diagnosis, describe, after_diagnosis)


def _run_task(
    context: typer.Context,
    task: "LogTask",
    log_call: LogCall,
    file: str,
    run: Callable[..., Any],
    describe: Callable[[JsonObject], "Result"],
    steps: Callable[..., list[NextStep]],
) -> Outcome:
    """Search what a log says of a machine, unless that is done, and write the next experiment that is asked for."""
    options, folder, experiment = context.params, log_call.folder, log_call.next_experiment
    # a search takes minutes, and its answer would be as doubtful as a unit or a sign of the log
    for record in filter(None, (task.record, task.holdout)):
        if not options["force"] and (doubts := doubts_among(record.warnings)):
            raise InputError(f"{record.path}: {doubts[0]} --force searches all the same")

    def answer(summary: JsonObject) -> "Result":
        return replace(describe(summary), next_steps=steps(task, summary, log_call))

    with run_with_progress(context, log_call.model, folder, unit=STEPS) as progress:
        summary = run_or_read(
            task,
            folder / file,
            lambda task: run(task, progress),
            lambda result, folder: jaxbl.write_report(result, folder, answer(result.summary)),
            overwrite=options["overwrite"],
        )
    card = answer(summary)
    if experiment is not None:
        from jaxbl.diagnosis.next_experiment import write_gap_experiment, write_next_experiment

        write = write_gap_experiment if "backlash" in summary else write_next_experiment
        written = write(folder, summary, task.record, experiment, options["max_torque"], options["max_travel"])
        card = replace(card, key_figures=[KeyFigure("next experiment", written), *card.key_figures[:3]])
    return Outcome(card, folder, summary=summary)


def _check_limits(next_experiment: Path | None, torque: float | None, travel: float | None) -> None:
    """Limits of an experiment need one, and have to be positive."""
    for name, limit in (("--max-torque", torque), ("--max-travel", travel)):
        if limit is not None and next_experiment is None:
            raise InputError(f"{name} limits what --next-experiment FILE.csv asks for; give both")
        if limit is not None and not 0.0 < limit < math.inf:
            raise InputError(f"{name} is {limit:g}; it has to be positive")


def watch(
    context: typer.Context,
    source: Annotated[str, argument("LOG|udp://HOST:PORT", f"{FORMATS}, or where to listen")],
    model: Annotated[Path, option("TOML", "study with the drive's numbers, observers and [log]")],
    alarm_gap: Annotated[
        float | None, option("RAD", "half gap beyond which there is an alarm: rad at the motor (m on a linear axis)")
    ] = None,
    window: Annotated[float, option("S", "seconds that each value is from")] = 10.0,
    interval: Annotated[float, option("S", "seconds between values", "--every")] = 1.0,
    blind: Annotated[
        float | None,
        option("S", "seconds without a number after which the watch is blind: exit code 4 [default: 10 windows]"),
    ] = None,
    follow: Annotated[bool, flag("--follow", "wait for more rows at the end of a text file, until Ctrl+C")] = False,
    out: Annotated[
        Path | None, option("DIR", "folder for the results [default: results/<log name>_watched; of a socket: none]")
    ] = None,
    overwrite: Annotated[
        bool, flag("--overwrite", "write into a folder that holds other results of a log or stream")
    ] = False,
) -> Outcome:
    """Watch a drive's gap, stiffness and friction over a log or a stream; exit code 3 after an alarm, 4 if it did not see.

    Example: jaxbl watch log.csv --model axis.toml --alarm-gap 0.002

    Read on: docs/watch.md
    """
    workers.start_jax()
    from jaxbl.monitoring.watch import read_watch_task

    task = read_watch_task(source, model, alarm_gap=alarm_gap, window=window, interval=interval, blind=blind, follow=follow)
    folder = out if "://" in source or out is not None else folder_of(Path(source), "watched", None)
    with open_results(folder, log_subject(Path(task.name)), overwrite=overwrite) if folder else nullcontext() as results:
        if results is not None and task.record is None:
            _claim_stream(results, overwrite)
        result = _watch_and_print(context, task, folder)
        card = replace(jaxbl.describe(result), next_steps=after_watch(task, result.summary, model))
        if results is not None:
            jaxbl.write_report(result, results, card)
    code = ALARM if result.summary["alarm"] else BLIND if result.summary["blind"]["longest"] else 0
    return Outcome(card, folder, summary=result.summary, code=code)


def _claim_stream(results: ResultFolder, overwrite: bool) -> None:
    from jaxbl.report.watch import VALUES

    if (results.path / VALUES).exists() and not overwrite:
        raise InputError(f"{results.path}: holds values of another stream; choose another with --out, or --overwrite")
    # the folder is this stream's before there are values in it
    results.write_manifest()


def _watch_and_print(context: typer.Context, task: "WatchTask", folder: Path | None) -> "Watch":
    """Print values as they come; those of a stream are in the folder at once, as nobody can give them again."""
    import json

    from jaxbl.monitoring.watch import format_values, run_watch
    from jaxbl.report.watch import open_values

    quiet, as_json = is_quiet(context), context.params.get("json")

    def remark(text: str) -> None:
        if not quiet:
            typer.echo(escape_unprintable(f"jaxbl: {text}"), err=True)

    keep = open_values(folder, task) if folder is not None and task.record is None else None

    def show(values: JsonObject) -> None:
        if keep is not None:
            keep(values)
        if as_json:
            typer.echo(json.dumps(to_jsonable(values), ensure_ascii=False))
        elif not quiet:
            typer.echo(format_values(values, task))

    with watch_for_end_request() if task.record is None else nullcontext() as ended:
        return run_watch(task, on_values=show, on_remark=remark, ended=ended)
