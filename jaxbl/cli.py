"""The command line: parse, call, print. JAX is imported only once a command has work for it."""

import dataclasses
import functools
import math
import os
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .errors import InputError, NoResult, printable
from .files import Busy, place
from .terminal import duration, naming, running
from .workers import start_jax

if TYPE_CHECKING:
    from jaxbl.sweeps.programs import Backend
    from jaxbl.sweeps.status import Status

    from .config import Config
    from .records import LogTable

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Drives with backlash: sliding-mode observers, gain maps, identification and diagnosis from logs.",
)

ConfigArgument = Annotated[Path, typer.Argument(metavar="CONFIG", help="TOML study", show_default=False)]
OutOption = Annotated[
    str | None,
    typer.Option(metavar="DIR", help="folder for the results, or s3://BUCKET/FOLDER [default: results/<config name>]"),
]
FolderArgument = Annotated[str, typer.Argument(metavar="DIR", help="folder of a sweep, verify or tune", show_default=False)]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="remove the results of another study from the folder")]
BackendOption = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="fused: one compiled loop; scan: XLA's own loop [default: the faster here]"),
]
SchedulerOption = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS", help="Dask cluster that computes: tcp://HOST:PORT, its scheduler's .json file, or local:N"
    ),
]
_FORMATS = "CSV, Parquet, MATLAB or JSON file"
LogArgument = Annotated[Path, typer.Argument(metavar="LOG", help=_FORMATS, show_default=False)]
LogOutOption = Annotated[
    Path | None, typer.Option(metavar="DIR", help="folder for the results [default: results/<log name>]")
]
MaxTorqueOption = Annotated[
    float | None, typer.Option(metavar="N·m", help="limit of the next experiment's input [default: the log's]")
]
MaxTravelOption = Annotated[
    float | None, typer.Option(metavar="RAD", help="limit of its motor travel (m on a linear axis) [default: the log's]")
]
LogOverwriteOption = Annotated[
    bool, typer.Option("--overwrite", help="write into a folder that holds results of another log")
]


def _say_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        typer.echo(f"jaxbl {version('jaxbl')}")
        raise typer.Exit


@app.callback()
def _main(
    version: Annotated[
        bool, typer.Option("--version", callback=_say_version, is_eager=True, help="say which version this is, and stop")
    ] = False,
) -> None:
    pass


@app.command()
def simulate(
    config: ConfigArgument,
    out: OutOption = None,
    seed: Annotated[int, typer.Option(help="seed of the encoder noise", min=0, max=2**31 - 1)] = 0,
    every: Annotated[int, typer.Option(help="keep every N-th sample of the trace", min=1, metavar="N")] = 1,
    overwrite: OverwriteOption = False,
) -> None:
    """Simulate a study once: trace, figures, summary."""
    start_jax()
    from jaxbl.sweeps.store import claim
    from jaxbl.sweeps.trial import run

    from .files import locked, removed_if_empty
    from .report.simulate import write_trial_report

    study = _read(config)
    folder = _folder(config, out)
    with removed_if_empty(folder), locked(folder):
        claim(folder, study, "simulate", overwrite=overwrite)
        trial = run(study, seed=seed, every=every)
        lines = write_trial_report(trial, folder)
    _print(lines, folder)
    if not trial.summary["metrics"]["finite"]:
        raise typer.Exit(1)


@app.command()
def sweep(
    context: typer.Context,
    config: ConfigArgument,
    out: OutOption = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="print the expected cost, and stop")] = False,
    overwrite: OverwriteOption = False,
    backend: BackendOption = None,
    verify_store: Annotated[
        bool, typer.Option("--verify-store", help="read every stored part first, and compute damaged ones anew")
    ] = False,
    scheduler: SchedulerOption = None,
    detach: Annotated[bool, typer.Option("--detach", help="leave the cluster at work; see 'jaxbl status DIR'")] = False,
    share: Annotated[
        str | None,
        typer.Option(metavar="I/N", help="compute the I-th of N shares into a folder that other processes write into, too"),
    ] = None,
) -> None:
    """Simulate all points of a study: metrics, maps, report. Continues an interrupted sweep."""
    which = _share(share, {"--overwrite": overwrite, "--verify-store": verify_store, "--scheduler": scheduler is not None})
    if detach and scheduler is None:
        raise InputError("--detach: needs the --scheduler of a cluster that stays when this command has ended")
    if detach and (overwrite or verify_store):
        raise InputError("--detach: does not go with --overwrite or --verify-store; choose another folder with --out")
    study, chosen = _study(config, backend)
    from jaxbl.sweeps.metrics import metric_columns
    from jaxbl.sweeps.points import Points
    from jaxbl.sweeps.sweep import sweep as run_sweep

    from .report.checks import check_figures

    if not study.axes and study.sweep.seeds == 1:
        raise InputError(f"{config}: axes: the study has none; add [[axes]], or use 'jaxbl simulate'")
    with naming(config):
        Points(study)
        check_figures(study, study.figures, metric_columns(study.build()))
        if dry_run:
            _print_cost(study, chosen)
            return
    run = functools.partial(run_sweep, verify_store=verify_store, scheduler=scheduler)
    collect = functools.partial(_compute, context, config, study, out, overwrite, chosen, run, "sweep")
    if detach or which is not None:
        from jaxbl.sweeps.sweep import share as run_share
        from jaxbl.sweeps.sweep import submit

        folder = _folder(config, out)
        with running(context, config, folder) as progress:
            if which is None:
                found = submit(study, folder, scheduler, backend=chosen)
            else:
                found = run_share(study, folder, which, progress=progress, backend=chosen)
        if not found.complete:
            _print_status(found)
            typer.echo(f"When all parts are there, 'jaxbl sweep {config} --out {folder}' writes the report.")
            return
        # who is last collects them
        try:
            collect()
        except Busy:
            _print_status(found)
        return
    collect()


def _share(text: str | None, others: dict[str, bool]) -> tuple[int, int] | None:
    """Number of a share, and of all; `others` are options that do not go with it."""
    if text is None:
        return None
    for name, given in others.items():
        if given:
            raise InputError(f"--share: does not go with {name}: other processes may be at work in the folder")
    number, _, count = text.partition("/")
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise InputError(f"--share {text}: should be I/N, such as 2/8: the second of eight")
    return int(number), int(count)


@app.command()
def status(folder: FolderArgument) -> None:
    """Say how far a study is, by the parts that exist."""
    from jaxbl.sweeps.status import statuses

    for one in statuses(folder):
        _print_status(one)


def _print_status(found: "Status") -> None:
    share = f"{found.parts} of {found.parts_in_all} parts ({math.floor(1000 * found.parts / found.parts_in_all) / 10:g} %)"
    typer.echo(f"{found.folder}: '{printable(found.title)}', {share} of {found.runs} runs")
    if found.damaged:
        typer.echo(f"  {found.damaged} damaged files are kept in {found.folder / 'damaged'}")
    if found.finished and found.complete:
        typer.echo("  finished")
        return
    rate, left = found.parts_per_second, found.remaining
    speed = f", {60.0 * rate:.3g} parts a minute" if rate else ""
    if found.complete:
        typer.echo("  all parts are there; 'jaxbl sweep' on it reads them and writes the report")
    elif found.held_by:
        typer.echo(f"  {found.held_by} is at work{speed}{'' if left is None else f', {duration(left)} left'}")
    else:
        typer.echo(f"  no process is at work in it{speed and f' (it went at{speed[1:]})'}; 'jaxbl sweep' goes on")


def _print_cost(study: "Config", backend: "Backend | None") -> None:
    """What a sweep will take."""
    from jaxbl.sweeps.sweep import dry_run

    cost = dry_run(study, backend=backend)
    refined = study.sweep.refine is not None
    typer.echo(f"points       {cost.points}{' on the coarse grid' if refined else ''} ({cost.rows} runs with all seeds)")
    if refined:
        typer.echo(f"refinement   at most {cost.most_points} points; as many as the boundaries need, not counted below")
    typer.echo(f"chunks       {cost.chunks} of {cost.lanes_a_chunk} lanes")
    typer.echo(f"memory       {cost.megabytes:.1f} MB a chunk")
    typer.echo(f"compilation  about {duration(cost.compile_seconds)}")
    rate = f"{cost.lane_steps_per_second:.2g} lane-steps/s measured, backend {cost.backend}"
    typer.echo(f"run          about {duration(cost.run_seconds)} ({rate})")


@app.command()
def tune(
    context: typer.Context,
    config: ConfigArgument,
    out: OutOption = None,
    overwrite: OverwriteOption = False,
    backend: BackendOption = None,
    scheduler: SchedulerOption = None,
) -> None:
    """Choose lambda and alpha of both observers: gains.toml, comparison, report. Continues an interrupted search."""
    study, chosen = _study(config, backend)
    from jaxbl.gains.tune import tune as run_tune

    run = functools.partial(run_tune, scheduler=scheduler)
    _compute(context, config, study, out, overwrite, chosen, run, "tune")


@app.command()
def verify(
    context: typer.Context,
    config: ConfigArgument,
    out: OutOption = None,
    overwrite: OverwriteOption = False,
    backend: BackendOption = None,
    scheduler: SchedulerOption = None,
) -> None:
    """Test the gain conditions by simulation: counterexamples, maps, report. Continues an interrupted verification."""
    study, chosen = _study(config, backend)
    from jaxbl.gains.verify import verify as run_verify

    run = functools.partial(run_verify, scheduler=scheduler)
    _compute(context, config, study, out, overwrite, chosen, run, "verify")


def _study(config: Path, backend: str | None) -> tuple["Config", "Backend | None"]:
    """A study, and the backend that is asked for."""
    start_jax()
    from jaxbl.sweeps.programs import backend_of

    chosen = backend_of(backend, "--backend")
    return _read(config), chosen


def _read(config: Path) -> "Config":
    """A study; what is valid in it and perhaps not meant is said first."""
    from .config import read_config

    study = read_config(config)
    for remark in study.remarks():
        typer.echo(printable(f"jaxbl: {config}: {remark}"), err=True)
    return study


def _compute(
    context: typer.Context,
    config: Path,
    study: "Config",
    out: str | None,
    overwrite: bool,
    backend: "Backend | None",
    run: Callable[..., Any],
    command: str,
) -> None:
    """Run a command on a study that continues where an interrupted call stopped, write its report, and say what it took."""
    folder = _folder(config, out)
    with running(context, config, folder) as progress:
        result = run(study, folder, progress=progress, overwrite=overwrite, backend=backend)
    from .fused import SCANNED

    # what draws is loaded when there is something to be drawn
    report = import_module(f".report.{command}", __package__)
    lines = getattr(report, f"write_{command}_report")(result, folder)
    cost = getattr(result, "cost", None)
    if cost and cost["lanes"]:
        compiling, computing = duration(cost["compile_seconds"]), duration(cost["run_seconds"])
        lines.append(f"Compiled in {compiling}, ran {cost['lanes']:.0f} lanes in {computing}.")
    lines += (SCANNED % what for what in result.scanned)
    _print([*lines, *(f"Damaged, and computed anew: {what}" for what in getattr(result, "damaged", ()))], folder)


@app.command()
def inspect(
    log: LogArgument,
    model: Annotated[
        Path | None, typer.Option(metavar="TOML", help="study, or a file with [log] alone: how to read the log")
    ] = None,
    write: Annotated[
        Path | None, typer.Option(metavar="NEW.toml", help="propose [log] and a nominal model for identify and diagnose")
    ] = None,
    out: LogOutOption = None,
    overwrite: LogOverwriteOption = False,
) -> None:
    """Examine a measured log: channels, sampling, noise, and which parameters it can identify."""
    if write is not None and write.exists():
        raise InputError(f"{write}: is there already; --write needs a new name")
    if write is not None and not write.parent.is_dir():
        raise InputError(f"{write}: there is no folder {write.parent}")
    from .files import claim_log_folder
    from .records import inspect as inspect_log
    from .report.inspect import write_inspection_report

    table = gear_ratio = nominal = None
    if model is not None:
        from .config import read_log_config

        table, gear_ratio, nominal = read_log_config(model)
    guesses: list[str] = []
    if write is None:
        found = inspect_log(log, table, gear_ratio=gear_ratio, nominal=nominal)
    else:
        from .records.proposal import propose

        given = None if table is None else table.model_dump(exclude_unset=True)
        study, guesses, found = propose(log, given, gear_ratio=gear_ratio, nominal=nominal)
    folder = _folder(log, out)
    claim_log_folder(folder, log, overwrite=overwrite)
    lines = write_inspection_report(found, folder)
    if write is not None:
        import tomli_w

        from .files import write_atomic

        remarks = [
            f"Proposed by jaxbl inspect --write from {log.name}. Look it through: names, units, and the drive.",
            *guesses,
        ]
        write_atomic(write, "".join(f"# {remark}\n" for remark in remarks) + tomli_w.dumps(study))
        lines += ["", f"{write}: a first model. Run: jaxbl identify {log} --model {write}", *guesses]
    _print(lines, folder)


@app.command()
def identify(
    context: typer.Context,
    log: Annotated[list[Path], typer.Argument(metavar="LOG...", help=f"{_FORMATS}s of one machine", show_default=False)],
    model: Annotated[
        Path, typer.Option(metavar="TOML", help="study with nominal parameters, and [log]", show_default=False)
    ],
    holdout: Annotated[Path | None, typer.Option(metavar="LOG2", help="log of the same machine to test the fit on")] = None,
    profile: Annotated[
        bool | None, typer.Option("--profile", help="add profile-likelihood intervals", show_default=False)
    ] = None,
    next_experiment: Annotated[
        Path | None,
        typer.Option(metavar="FILE.csv", help="write an input that shows a gap which the motor's encoder alone does not"),
    ] = None,
    max_torque: MaxTorqueOption = None,
    max_travel: MaxTravelOption = None,
    out: LogOutOption = None,
    overwrite: LogOverwriteOption = False,
) -> None:
    """Fit a machine's parameters to its logs, with intervals: stiffness, gap, inertias, frictions."""
    _check_limits(next_experiment, max_torque, max_travel)
    start_jax()
    from .config import read_log_config

    table, gear_ratio, _ = read_log_config(model)
    if table.kind == "element":
        if len(log) > 1:
            raise InputError("identify: several logs; of a transmission on a test rig one log is fitted at a time")
        if profile:
            raise InputError(
                "identify: --profile is for drives; intervals of a transmission on a test rig are by a jackknife"
            )
        if next_experiment is not None:
            raise InputError("identify: --next-experiment is for drives; a transmission on a test rig is loaded to and fro")
        _identify_element(log[0], table, gear_ratio, holdout, _folder(log[0], out), overwrite)
        return
    from jaxbl.identification.identify import read_identification_task, run_identification

    from .files import results_of
    from .report.identify import identification_lines, write_identification_report

    task = read_identification_task(log, model, holdout=holdout, profile=profile)
    if next_experiment is not None:
        from jaxbl.diagnosis.next_experiment import check_gap_sought

        check_gap_sought(task)
    folder = _folder(log[0], out)
    with running(context, model, folder, unit="steps", kept=False) as progress:
        file = folder / "identification.json"
        summary = results_of(
            task, file, lambda task: run_identification(task, progress), write_identification_report, overwrite=overwrite
        )
    lines = identification_lines(summary)
    if next_experiment is not None:
        from jaxbl.diagnosis.next_experiment import write_gap_experiment

        lines += write_gap_experiment(folder, summary, task.record, next_experiment, max_torque, max_travel)
    _print(lines, folder)


def _identify_element(
    log: Path, table: "LogTable", gear_ratio: float | None, holdout: Path | None, folder: Path, overwrite: bool
) -> None:
    from jaxbl.identification.element import read_element_task, run_element

    from .files import results_of
    from .report.element import element_lines, write_element_report

    task = read_element_task(log, table, gear_ratio, holdout=holdout)
    file = folder / "identification.json"
    _print(element_lines(results_of(task, file, run_element, write_element_report, overwrite=overwrite)), folder)


@app.command()
def diagnose(
    context: typer.Context,
    log: Annotated[
        list[Path] | None, typer.Argument(metavar="[LOG...]", help=f"{_FORMATS}s of one machine", show_default=False)
    ] = None,
    model: Annotated[
        Path | None, typer.Option(metavar="TOML", help="study with nominal parameters, [uncertainty] and [log]")
    ] = None,
    holdout: Annotated[
        Path | None,
        typer.Option(metavar="LOG2", help="log of the same machine for the test [default: the last quarter of the log]"),
    ] = None,
    batch: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="diagnose every log of a folder; NAME.toml beside NAME.csv is its model"),
    ] = None,
    jobs: Annotated[int | None, typer.Option(metavar="N", min=1, help="processes for --batch [default: one a core]")] = None,
    scheduler: SchedulerOption = None,
    next_experiment: Annotated[
        Path | None, typer.Option(metavar="FILE.csv", help="write an input that separates the effects this log cannot")
    ] = None,
    max_torque: MaxTorqueOption = None,
    max_travel: MaxTravelOption = None,
    out: LogOutOption = None,
    overwrite: LogOverwriteOption = False,
) -> None:
    """Find effects that a model lacks, add them, and test on held-out data that its errors shrink."""
    _check_limits(next_experiment, max_torque, max_travel)
    if batch is not None:
        if log or holdout is not None or next_experiment is not None:
            raise InputError("--batch FOLDER takes no logs, --holdout or --next-experiment; give these one by one")
        start_jax()
        folder = out if out is not None else Path("results") / batch.name
        _diagnose_batch(context, batch, model, folder, jobs, overwrite, scheduler)
        return
    if jobs is not None or scheduler is not None:
        raise InputError(f"{'--scheduler' if jobs is None else '--jobs'} goes with --batch: one log is one process's work")
    if not log:
        raise InputError("diagnose: no log; give one or several of one machine, or a folder with --batch")
    if model is None:
        raise InputError("diagnose: no model; give a study with nominal parameters: --model TOML")
    start_jax()
    from jaxbl.diagnosis.diagnose import read_diagnosis_task, run_diagnosis

    from .files import results_of
    from .report.diagnose import diagnosis_lines, write_diagnosis_report

    task = read_diagnosis_task(log, model, holdout=holdout)
    folder = _folder(log[0], out)
    with running(context, model, folder, unit="steps", kept=False) as progress:
        file = folder / "diagnosis.json"
        summary = results_of(
            task, file, lambda task: run_diagnosis(task, progress), write_diagnosis_report, overwrite=overwrite
        )
    lines = diagnosis_lines(summary)
    if next_experiment is not None:
        from jaxbl.diagnosis.next_experiment import write_gap_experiment, write_next_experiment

        write = write_gap_experiment if "backlash" in summary else write_next_experiment
        lines += write(folder, summary, task.record, next_experiment, max_torque, max_travel)
    _print(lines, folder)


def _check_limits(next_experiment: Path | None, torque: float | None, travel: float | None) -> None:
    """Limits of an experiment need one, and have to be positive."""
    for name, limit in (("--max-torque", torque), ("--max-travel", travel)):
        if limit is not None and next_experiment is None:
            raise InputError(f"{name} limits what --next-experiment FILE.csv asks for; give both")
        if limit is not None and not 0.0 < limit < math.inf:
            raise InputError(f"{name} is {limit:g}; it has to be positive")


def _diagnose_batch(
    context: typer.Context,
    source: Path,
    model: Path | None,
    out: Path,
    jobs: int | None,
    overwrite: bool,
    scheduler: str | None,
) -> None:
    from .batch import batch_lines, read_batch, run_batch

    work, skipped = read_batch(source, model, out, overwrite=overwrite)
    with running(context, model or source, out, unit="logs") as progress:
        rows = run_batch(work, out, jobs, progress, scheduler)
    if skipped:
        typer.echo(printable(f"Skipped, by their names no logs: {', '.join(skipped)}"))
    for line in batch_lines(rows):
        typer.echo(printable(line))
    typer.echo(f"{out / 'batch.csv'}")
    if all(row["refused"] for row in rows):
        raise typer.Exit(2)


@app.command()
def plot(
    folder: FolderArgument,
    config: Annotated[
        Path | None, typer.Option(metavar="CONFIG", help="take title, notes and figures from this study")
    ] = None,
) -> None:
    """Draw figures and report of a sweep again from its stored points, without simulating."""
    start_jax()
    from jaxbl.sweeps.store import Store, identity
    from jaxbl.sweeps.sweep import open_study

    from .config import read_config
    from .files import make_folder
    from .report.sweep import write_sweep_report

    where, result = place(folder), open_study(folder)
    make_folder(where, "copy it to where you may write, and plot that")
    if config is not None:
        study = read_config(config)
        if identity(study) != Store.open(where).manifest["identity"]:
            raise InputError(f"{config}: is not the study in {folder}; only title, notes and figures may differ")
        result = dataclasses.replace(result, config=study)
    _print(write_sweep_report(result, where), where)


@app.command()
def compare(
    first: Annotated[Path, typer.Argument(metavar="DIR1", parser=place, help="folder of a sweep", show_default=False)],
    second: Annotated[Path, typer.Argument(metavar="DIR2", parser=place, help="of another one", show_default=False)],
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="folder for the results [default: results/compare-DIR1-DIR2]")
    ] = None,
) -> None:
    """Compare two sweeps: what changed in the config, and where metrics differ by more than noise."""
    start_jax()
    from jaxbl.sweeps.compare import compare as run_compare
    from jaxbl.sweeps.sweep import open_study

    from .files import is_empty, make_folder, removed_if_empty
    from .report.compare import write_comparison

    studies = open_study(first), open_study(second)
    folder = out if out is not None else Path("results") / f"compare-{first.name}-{second.name}"
    make_folder(folder)
    if not is_empty(folder) and not (folder / "comparison.json").exists():
        raise InputError(f"{folder}: is not empty and holds no comparison; choose another folder with --out")
    with removed_if_empty(folder):
        lines = write_comparison(run_compare(*studies), studies[0].config, folder)
    for line in [*lines, str(folder / "comparison.json")]:
        typer.echo(line)


@app.command()
def repair(folder: FolderArgument) -> None:
    """Check a sweep's folder: keep damaged parts aside, and write a manifest that is lost or damaged anew."""
    start_jax()
    from jaxbl.sweeps.sweep import repair as run_repair

    whole, store = run_repair(folder)
    for what in store.damaged:
        typer.echo(f"Damaged: {what}")
    parts = store.manifest["parts"]
    typer.echo(f"{whole} of {parts} parts are whole.")
    if whole < parts:
        typer.echo(f"'jaxbl sweep STUDY.toml --out {folder}' with the same study computes the others.")


@app.command()
def bench(
    context: typer.Context,
    quick: Annotated[
        bool, typer.Option("--quick", help="take less than a minute: shorter runs, the others in one precision")
    ] = False,
    out: Annotated[Path, typer.Option(metavar="DIR", help="folder for the results")] = Path("results/bench"),
) -> None:
    """Time the same work by jaxbl, C++, numba, diffrax, NumPy, SciPy and OpenSMC: table, chart, bench.json."""
    start_jax()
    import jax

    from .files import make_folder, removed_if_empty
    from .report.bench import write_bench_report
    from .throughput import bench as run_bench

    # the time of compiling is measured, so that nothing may come from the cache
    jax.config.update("jax_enable_compilation_cache", False)
    make_folder(out)
    if any(out.iterdir()) and not (out / "bench.json").exists():
        raise InputError(f"{out}: is not empty and holds no benchmark; choose another folder with --out")
    with removed_if_empty(out), running(context, out, out, unit="parts", kept=False) as progress:
        result = run_bench(quick=quick, progress=progress)
    for line in write_bench_report(result, out):
        typer.echo(line)


def _folder(config: Path, out: str | Path | None) -> Path:
    return place(out) if out is not None else Path("results") / config.stem


def _print(lines: list[str], folder: Path) -> None:
    """Print what was found, and where the report is."""
    for line in [*lines, str(folder / "report.html")]:
        typer.echo(printable(line))


def main(run: Callable[[], object] = app) -> None:
    """Run a command: exit 0 done, 1 failed, 2 bad input (one line), 130 interrupted."""
    try:
        run()
    except (InputError, NoResult) as error:
        typer.echo(f"jaxbl: {error}", err=True)
        sys.exit(2 if isinstance(error, InputError) else 1)
    except KeyboardInterrupt:
        typer.echo("interrupted", err=True)
        sys.exit(130)


def program() -> None:
    """Entry point: as :func:`main`, and an interrupt ends the process without taking down the interpreter.

    Threads of XLA may still compute then, and would crash when their memory is freed.
    """
    try:
        main()
    except SystemExit as end:
        if end.code != 130:
            raise
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(130)
