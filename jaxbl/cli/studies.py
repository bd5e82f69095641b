"""Commands on studies: simulate, sweep, status, tune, verify, plot, explore, compare, repair."""

import functools
import math
import sys
import threading
import webbrowser
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import jaxbl
from jaxbl import workers
from jaxbl.errors import InputError, escape_unprintable
from jaxbl.files import FolderInUse, Subject, lock_folder, make_folder, open_results, to_path
from jaxbl.lines import NextStep, format_descriptions, format_duration
from jaxbl.terminal import (
    STEPS,
    is_quiet,
    name_config_in_errors,
    run_with_progress,
    watch_for_end_request,
)

from .next_steps import after_comparison, after_run, after_sweep, after_tuning
from .options import (
    BackendOption,
    ConfigArgument,
    FolderArgument,
    OutOption,
    OverwriteOption,
    ResultsArgument,
    SchedulerOption,
    argument,
    flag,
    folder_of,
    option,
)
from .outcome import Outcome, with_changes

if TYPE_CHECKING:
    from jaxbl.config import Config
    from jaxbl.result import Result
    from jaxbl.sweeps.programs import Backend
    from jaxbl.sweeps.status import Status


@with_changes
def simulate(
    context: typer.Context,
    config: ConfigArgument,
    out: OutOption = None,
    seed: Annotated[int, typer.Option(help="seed of the encoder noise", min=0, max=2**31 - 1)] = 0,
    every: Annotated[int, option("N", "keep every N-th sample of the trace", min=1)] = 1,
    overwrite: OverwriteOption = False,
) -> Outcome:
    """Simulate a study once: trace, figures, summary.

    Example: jaxbl simulate axis.toml --set observer.motor.lambda=30

    Read on: docs/tutorial.md
    """
    workers.start_jax()
    from jaxbl.sweeps.store import claim_study

    study = read_study(context, config)
    folder = folder_of(config, "run", out)
    with run_with_progress(context, config, folder, unit=STEPS, first="simulating"), lock_folder(folder):
        results = claim_study(folder, study, "simulate", overwrite=overwrite)
        trial = jaxbl.run(study, seed=seed, every=every)
        card = jaxbl.describe(trial)
        # the terminal has no line left for it
        jaxbl.write_report(trial, results, replace(card, next_steps=after_run(card, config)))
    return Outcome(card, folder, summary="summary.json", code=0 if trial.summary["metrics"]["finite"] else 1)


@with_changes
def sweep(
    context: typer.Context,
    config: ConfigArgument,
    out: OutOption = None,
    dry_run: Annotated[bool, flag("--dry-run", "print the expected cost, and stop")] = False,
    overwrite: OverwriteOption = False,
    backend: BackendOption = None,
    scheduler: SchedulerOption = None,
    detach: Annotated[bool, flag("--detach", "leave the cluster at work; see 'jaxbl status DIR'")] = False,
    share: Annotated[
        str | None, option("I/N", "compute the I-th of N shares into a folder that other processes write into, too")
    ] = None,
) -> Outcome:
    """Simulate all points of a study: metrics, maps, report. Continues an interrupted sweep.

    Example: jaxbl sweep axis.toml --dry-run

    Read on: docs/tutorial.md
    """
    if (detach or share) and (overwrite or detach == (scheduler is None)):
        raise InputError(
            "sweep: --detach needs the --scheduler of a cluster that stays, --share goes without one; neither goes with "
            "--overwrite, as others may be at work in the folder; choose another one with --out"
        )
    share_numbers = None if share is None else _parse_share(share)
    study, chosen = read_study(context, config), context.params["backend"]
    from jaxbl.report.checks import check_figures
    from jaxbl.sweeps.points import Points

    if not study.axes and study.sweep.seeds == 1:
        raise InputError(f"{config}: axes: the study has none; add [[axes]], or use 'jaxbl simulate'")
    with name_config_in_errors(config):
        check_figures(study, study.figures, Points(study).metrics)
        if dry_run:
            return _estimate_cost(study, chosen)
    collect = functools.partial(compute, context, config, study, jaxbl.sweep, "map", after_sweep)
    if detach or share_numbers is not None:
        folder = folder_of(config, "map", out)
        with run_with_progress(context, config, folder) as progress:
            if share_numbers is None:
                status_now = jaxbl.submit(study, folder, scheduler, backend=chosen)
            else:
                status_now = jaxbl.share(study, folder, share_numbers, progress=progress, backend=chosen)
        if not status_now.complete:
            remark = f"When all parts are there, 'jaxbl sweep {config} --out {folder}' writes the report."
            return _describe_studies([status_now], remark)
        # who is last collects them
        try:
            return collect()
        except FolderInUse:
            return _describe_studies([status_now])
    return collect()


def _parse_share(text: str) -> tuple[int, int]:
    """Parse I/N into the number of a share and of all shares."""
    number, _, count = text.partition("/")
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise InputError(f"--share {text}: should be I/N, such as 2/8: the second of eight")
    return int(number), int(count)


def status(folder: FolderArgument) -> Outcome:
    """Say how far a study is, by the parts that exist.

    Example: jaxbl status results/axis_map

    Read on: docs/which_command.md
    """
    from jaxbl.sweeps.status import list_statuses

    return _describe_studies(list_statuses(folder))


def _describe_studies(studies: "list[Status]", *more: str) -> Outcome:
    """Say how far studies are."""
    data = {"studies": [vars(study) | {"folder": str(study.folder)} for study in studies]}
    return Outcome([*(line for study in studies for line in _describe_study(study)), *more], summary=data)


def _describe_study(study: "Status") -> list[str]:
    share = f"{study.parts} of {study.parts_in_all} parts ({math.floor(1000 * study.parts / study.parts_in_all) / 10:g} %)"
    lines = [f"{study.folder}: '{escape_unprintable(study.title)}', {share} of {study.runs} runs"]
    if study.damaged:
        lines.append(f"  {study.damaged} damaged files are kept in {study.folder / 'damaged'}")
    if study.finished and study.complete:
        return [*lines, "  finished"]
    remaining = study.remaining_seconds
    if study.complete:
        lines.append("  all parts are there; 'jaxbl sweep' on it reads them and writes the report")
    elif study.held_by:
        left = "" if remaining is None else f", {format_duration(remaining)} left"
        lines.append(f"  {study.held_by} is at work{left}")
    else:
        lines.append("  no process is at work in it; 'jaxbl sweep' goes on")
    return lines


def _estimate_cost(study: "Config", backend: "Backend | None") -> Outcome:
    """Estimate what a sweep will take."""
    cost = jaxbl.dry_run(study, backend=backend)
    refined = study.sweep.refine is not None
    rows = [("points", f"{cost.points}{' on the coarse grid' if refined else ''} ({cost.rows} runs with all seeds)")]
    if refined:
        most = f"at most {cost.max_points} points; as many as the borders need, not counted below"
        rows.append(("refinement", most))
    rate = f"{cost.lane_steps_per_second:.2g} lane-steps/s measured, backend {cost.backend}"
    rows += [
        ("chunks", f"{cost.chunks} of {cost.lanes_a_chunk} lanes"),
        ("memory", f"{cost.megabytes:.1f} MB a chunk"),
        ("compilation", f"about {format_duration(cost.compile_seconds)}"),
        ("run", f"about {format_duration(cost.run_seconds)} ({rate})"),
    ]
    lines = format_descriptions(rows)
    return Outcome(lines, summary=vars(cost))


@with_changes
def tune(
    context: typer.Context,
    config: ConfigArgument,
    out: OutOption = None,
    overwrite: OverwriteOption = False,
    backend: BackendOption = None,
    scheduler: SchedulerOption = None,
) -> Outcome:
    """Choose the observers' gains, or their kind: gains.toml, comparison, report. Continues an interrupted search.

    Example: jaxbl tune axis.toml

    Read on: docs/tutorial.md
    """

    def steps(card: "Result", study: "Config", folder: Path):
        # over many points none has gains of its own
        return [] if study.tune and study.tune.axes else after_tuning(card, config, folder)

    return compute(context, config, read_study(context, config), jaxbl.tune, "gains", steps)


@with_changes
def verify(
    context: typer.Context,
    config: ConfigArgument,
    out: OutOption = None,
    overwrite: OverwriteOption = False,
    backend: BackendOption = None,
    scheduler: SchedulerOption = None,
) -> Outcome:
    """Test the gain conditions by simulation: counterexamples, maps, report. Continues an interrupted verification.

    Example: jaxbl verify axis.toml --gains results/axis_gains/gains.toml

    Read on: docs/theory.md
    """
    study = read_study(context, config)
    return compute(context, config, study, jaxbl.verify, "verdict", lambda card, *_: after_run(card, config))


def read_study(context: typer.Context, config: Path) -> "Config":
    """Read a study, with the values of --set and the observers of --gains, and check --backend.

    Raises:
        InputError: one line that names the option, or the file, that is wrong.
    """
    workers.start_jax()
    from jaxbl.config import with_values
    from jaxbl.sweeps.programs import check_backend

    options = context.params
    check_backend(options.get("backend"), "--backend")
    gains, changes = options.get("gains"), options.get("changes") or ()
    try:
        study = jaxbl.read_config(config if gains is None else {"include": [str(config), str(gains)]})
    except InputError as error:
        message = str(error).removeprefix("config: include: ")
        raise InputError(f"--gains {message}" if message.startswith(f"{gains}:") else message) from None
    values = dict(map(_parse_change, changes))
    try:
        return with_values(study, values)
    except InputError as error:
        wrong = [change for change in changes if change.partition("=")[0] in str(error)] or changes
        raise InputError(f"--set {' --set '.join(wrong)}: {error}") from None


def _parse_change(text: str) -> tuple[str, Any]:
    """Parse PATH=VALUE into a path, and a number or a word."""
    path, equals, value = text.partition("=")
    if not (path and equals and value):
        raise InputError(f"--set {text}: should be PATH=VALUE, such as observer.motor.lambda=3")
    with suppress(ValueError):
        return path, float(value)
    return path, value


_SUMMARIES = {"gains": "tuning.json", "verdict": "verdict.json"}
"""Files with the result of a command, by what its folder holds."""


def compute(
    context: typer.Context,
    config: Path,
    study: "Config",
    run: Callable[..., Any],
    content: str,
    steps: Callable[["Result", "Config", Path], Sequence[NextStep]],
) -> Outcome:
    """Run a command on a study that continues where an interrupted call stopped, write its report, and say what it took.

    Folder, --overwrite, --backend and --scheduler are those of the call. `content` ends the folder's name, `steps` says what
    to try next, by what was found, the study and the folder.
    """
    options = context.params
    folder = folder_of(config, content, options["out"])
    with run_with_progress(context, config, folder) as progress:
        passed_on = {name: options[name] for name in ("overwrite", "backend", "scheduler") if name in options}
        result = run(study, folder, progress=progress, **passed_on)
    with run_with_progress(context, config, folder, first="drawing"):
        card = jaxbl.describe(result)
        card = jaxbl.write_report(result, folder, replace(card, next_steps=steps(card, study, folder)))
    summary = _SUMMARIES.get(content) or {
        "title": study.title,
        "runs": result.runs,
        "finished": result.is_finished(result.runs),
    }
    return Outcome(card, folder, summary=summary)


def plot(
    context: typer.Context,
    folder: FolderArgument,
    config: Annotated[Path | None, option("CONFIG", "the study; a sweep's may have another title, notes, figures")] = None,
) -> Outcome:
    """Draw figures and report of a sweep, tune or verify again from its stored points, without simulating.

    Example: jaxbl plot results/axis_map --config axis.toml

    Read on: docs/tutorial.md
    """
    workers.start_jax()
    from jaxbl.sweeps.store import Store, identity

    where = context.params["out"] = to_path(folder)
    for again, file in ((tune, "tuning.json"), (verify, "verdict.json")):
        if (where / file).exists():
            if config is None:
                raise InputError(f"{folder}: no study is kept beside {file}; give it by --config")
            # what is finished is not computed again
            return again(context=context, config=config, changes=(), gains=None)
    result = jaxbl.open_study(folder)
    make_folder(where, "copy it to where you may write, and plot that")
    if config is not None:
        study = jaxbl.read_config(config)
        if identity(study) != Store.open(where).manifest["identity"]:
            raise InputError(f"{config}: is not the study in {folder}; only title, notes and figures may differ")
        result = replace(result, config=study)
    return compute(context, where, result.config, lambda *_, **__: result, "map", after_sweep)


def explore(
    context: typer.Context,
    folder: ResultsArgument,
    static: Annotated[
        Path | None, option("OUT", "write the page into this folder, new or ours, and do not serve it", "--static")
    ] = None,
    port: Annotated[int, option("N", "port to serve on; 0: one that is free", min=0, max=65535)] = 0,
    browser: Annotated[bool | None, flag("--browser/--no-browser", "open the page [default: on a terminal]")] = None,
) -> Outcome:
    """Explore what a command left, a sweep, a run, a diagnosis and others, in the browser; --static: a page without Python.

    Example: jaxbl explore results/axis_map

    Read on: docs/explore.md
    """
    if static is not None and (port or browser is not None):
        raise InputError("--static: writes a page and serves none; --port and --browser do not go with it; leave them out")
    workers.start_jax()
    from jaxbl.report.explorer.folder import write_static
    from jaxbl.report.explorer.sources import open_source

    source = open_source(folder)
    if static is not None:
        with run_with_progress(context, static, static, unit=STEPS, first="writing the page"):
            page = write_static(source, static)
        return Outcome([*source.lead], static, page.name)
    from jaxbl.report.explorer.server import ExplorerServer

    with ExplorerServer(source, port) as server:
        # the address is what was asked for
        for line in (*([] if is_quiet(context) else source.lead), f"Open {server.url}", "Ctrl+C ends it."):
            typer.echo(escape_unprintable(line), err=True)
        if browser if browser is not None else sys.stdout.isatty():
            # a browser in the terminal ends when it is left
            page = server.write_redirect().as_uri()
            threading.Thread(target=webbrowser.open, args=(page,), daemon=True).start()
        with suppress(KeyboardInterrupt), watch_for_end_request(interrupts=True):
            server.serve_forever()
    return Outcome([])


def compare(
    context: typer.Context,
    first: Annotated[Path, argument("DIR1", "folder of a sweep", parser=to_path)],
    second: Annotated[Path, argument("DIR2", "of another one", parser=to_path)],
    out: Annotated[Path | None, option("DIR", "folder for the results [default: results/compare-DIR1-DIR2]")] = None,
) -> Outcome:
    """Compare two sweeps: what changed in the config, and where metrics differ by more than noise.

    Example: jaxbl compare results/before results/after

    Read on: docs/tutorial.md
    """
    workers.start_jax()

    studies = jaxbl.open_study(first), jaxbl.open_study(second)
    folder = out or Path("results") / f"compare-{first.name}-{second.name}"
    with (
        run_with_progress(context, folder, folder, unit=STEPS, first="comparing"),
        open_results(folder, Subject("comparison")) as results,
    ):
        comparison = jaxbl.compare(*studies)
        card = jaxbl.describe(comparison)
        card = jaxbl.write_report(comparison, results, replace(card, next_steps=after_comparison(card, folder)))
    return Outcome(card, folder, summary="comparison.json")


def repair(folder: FolderArgument) -> Outcome:
    """Check a sweep's folder: keep damaged parts aside, and write a manifest that is lost or damaged anew.

    Example: jaxbl repair results/axis_map

    Read on: docs/which_command.md
    """
    workers.start_jax()
    whole_parts, store = jaxbl.repair(folder)
    parts = store.manifest["parts"]
    lines = [*(f"Damaged: {damaged_part}" for damaged_part in store.damaged), f"{whole_parts} of {parts} parts are whole."]
    if whole_parts < parts:
        lines.append(f"'jaxbl sweep STUDY.toml --out {folder}' with the same study computes the others.")
    return Outcome(lines, to_path(folder), "", {"parts": parts, "whole": whole_parts, "damaged": store.damaged})
